"""Check points that an image measures and nothing else determines: where they lie in it, and where they should.

A point of one ray has no place of its own, but where it is known beforehand the adjusted image says where it must be
seen. Neither the ray nor the given place took part in the adjustment, so that measured minus computed, ``v``, has the
covariance ``s0^2 (C_l + A Q A') + B C_p B'`` with the cofactors Q of the unknowns and C_p of the given place. At the
given height the ground that was measured lies ``(B_en)^-1 v`` beside the given one, east and north: what an orthoimage
is off there. Source: propagation of errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .solution import SceneSolution, State

Array = NDArray[np.floating]

#: Rays that see the plane of their point under a smaller share of its scale than this say nothing of a place in it.
_FLAT = 1e-6


@dataclass(frozen=True)
class SingleLooks:
    """Rays of check points that are not determined.

    Attributes
    ----------
    rays : (k,) places of the image points
    residual_px, sigma_px : (k, 2) measured minus computed line and sample, and sigmas with those of the given place
    difference_m : (k, 2) measured minus given place at the given height, east and north
    sigma_m, expected_m : (k, 2) sigmas of these, without and with those of the given place
    """

    rays: NDArray[np.int64]
    residual_px: Array
    sigma_px: Array
    difference_m: Array
    sigma_m: Array
    expected_m: Array

    @property
    def test(self) -> Array:
        """(k, 2) normalised residuals."""
        return self.residual_px / self.sigma_px


def single_looks(solution: SceneSolution, sigma0: float, state: State | None = None) -> SingleLooks:
    """The rays of check points that the adjustment did not determine.

    Parameters
    ----------
    sigma0 : of unit weight, a posteriori
    state : whose values of the unknowns are taken; None for the adjusted ones
    """
    problem, block = solution.problem, solution.problem.block
    values = (solution.state if state is None else state).values
    place, survey = np.full((len(block.point_ids), 3), np.nan), np.zeros((len(block.point_ids), 3, 3))
    known = block.known
    check = np.array([role == "check" for role in known.role], dtype=bool)
    at = known.point[check]
    place[at], survey[at] = known.position_e[check], np.nan_to_num(known.covariance_enu[check])
    place[solution.determined] = np.nan
    alone = np.asarray(np.isfinite(place).all(axis=1))
    place = np.where(alone[:, None], place, solution.state.position_e)
    rays: list[NDArray[np.int64]] = []
    parts: list[tuple[Array, ...]] = []
    for image, mine, columns in zip(problem.rays, block.rays_of, block.layout.columns, strict=True):
        p = block.rays.point[mine]
        equations = image.equations(place[p], values[columns])
        v, A = equations.misclosure_px, equations.by_unknown
        B = equations.by_point @ problem.R_e_enu[p]
        plane = B[:, :, :2]
        size = np.einsum("nij,nij->n", plane, plane)
        seen = alone[p] & np.isfinite(v).all(axis=1) & np.isfinite(B).all(axis=(1, 2))
        seen &= np.abs(np.linalg.det(np.nan_to_num(plane))) > _FLAT * np.nan_to_num(size)
        if not seen.any():
            continue
        v, A, B, plane, p = v[seen], A[seen], B[seen], plane[seen], p[seen]
        Q = solution.values_covariance[np.ix_(columns, columns)]
        noise = np.square(block.rays.sigma_px[mine][seen])[:, None, None] * np.eye(2)
        own = sigma0**2 * (noise + A @ Q @ np.swapaxes(A, -1, -2))
        both = own + B @ survey[p] @ np.swapaxes(B, -1, -2)
        ground = np.linalg.inv(plane)
        rays.append(mine[seen])
        parts.append((v, _sigmas(both), np.einsum("nij,nj->ni", ground, v), *(
            _sigmas(ground @ C @ np.swapaxes(ground, -1, -2)) for C in (own, both)
        )))  # fmt: skip
    if not rays:
        none = np.empty((0, 2))
        return SingleLooks(np.empty(0, dtype=np.int64), none, none, none, none, none)
    order = np.argsort(np.concatenate(rays), kind="stable")
    return SingleLooks(np.concatenate(rays)[order], *(np.concatenate(c)[order] for c in zip(*parts, strict=True)))


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
