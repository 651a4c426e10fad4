"""Object points that were eliminated, as functions of the unknowns: what they are for other values of these.

With whitened equations ``A theta + J (point - origin) = r`` of a point, known coordinates of weight P, and
``J^T J + P = L L^T``, the point given the unknowns is ``L^T (point - origin) + D theta = y + noise(1)`` with
``D = L^-1 J^T A`` and ``y = L^-1 (J^T r + P (known - origin))``; the unknowns alone keep ``A^T A - D^T D`` and
``A^T r - D^T y`` (Schur complement, as in `normal_equations`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, IntArray

#: Equations of one point: numbers (u,) of the unknowns, A (m, u), J (m, 3), r (m,).
Rows = tuple[IntArray, Array, Array, Array]

#: Smallest eigenvalue that a point's normal matrix is given, as a share of its largest one: a point that one ray alone
#: sees can then be eliminated too, with a variance along the ray that says nothing. Far below that of any two rays.
LEAST_EIGENVALUE = 1e-13


@dataclass(frozen=True)
class EliminatedPoints:
    """Points (p,) as functions of unknowns (u,); see the module.

    Attributes
    ----------
    columns : (u,) numbers of the unknowns
    origin_l : (p, 3) m
    factor, y, coupling : (p, 3, 3) ``L^-1``, (p, 3), (p, 3, u) ``D``
    """

    columns: IntArray
    origin_l: Array
    factor: Array
    y: Array
    coupling: Array

    def at(self, theta: Array, Q: Array) -> tuple[Array, Array]:
        """Coordinates (p, 3) and covariance (p, 3, 3) for values (u,) and cofactors (u, u) of the unknowns."""
        D = self.coupling
        return self.given(theta, (D.reshape(-1, len(theta)) @ Q).reshape(D.shape))

    def given(self, theta: Array, through: Array) -> tuple[Array, Array]:
        """The same, if the product (p, 3, u) of ``D`` and the cofactors is there."""
        D, back = self.coupling, np.swapaxes(self.factor, 1, 2)
        xyz_l = self.origin_l + np.einsum("pij,pj->pi", back, self.y - D @ theta)
        return xyz_l, back @ (through @ np.swapaxes(D, 1, 2) + np.eye(3)) @ self.factor

    def rows(self, place: int, origin_l: Array) -> Rows:
        """Three equations that say the same of a point as all those it was eliminated from, for an origin (3,)."""
        root = np.linalg.inv(self.factor[place]).T
        return self.columns, self.coupling[place], root, self.y[place] - root @ (origin_l - self.origin_l[place])


def eliminated(
    rows: Sequence[Rows], weight: Array, xyz_l: Array, origin_l: Array
) -> tuple[EliminatedPoints, Array, Array, float]:
    """Eliminate one point: the point, and normal equations (u, u), (u,) and square sum of what is left.

    Parameters
    ----------
    rows : equations for an origin
    weight, xyz_l : (3, 3), (3,) known coordinates and their weight matrix, which may be negative to take weight back
    origin_l : (3,)
    """
    columns = np.unique(np.concatenate([own for own, *_ in rows]))
    A = np.concatenate([spread(part, own, columns) for own, part, _, _ in rows])
    J, r = np.concatenate([J for _, _, J, _ in rows]), np.concatenate([r for *_, r in rows])
    off = xyz_l - origin_l
    normal = J.T @ J + weight
    values, vectors = np.linalg.eigh(normal)
    if values[0] < LEAST_EIGENVALUE * values[2]:
        normal = vectors * np.maximum(values, LEAST_EIGENVALUE * values[2]) @ vectors.T
    factor = np.linalg.inv(np.linalg.cholesky(normal))
    D, y = factor @ (J.T @ A), factor @ (J.T @ r + weight @ off)
    point = EliminatedPoints(columns, origin_l[None], factor[None], y[None], D[None])
    return point, A.T @ A - D.T @ D, A.T @ r - D.T @ y, float(r @ r + off @ weight @ off - y @ y)


def spread(part: Array, columns: IntArray, wanted: IntArray) -> Array:
    """Rows (m, u) of unknowns with these numbers over others (v,), sorted, that contain them."""
    result = np.zeros((len(part), len(wanted)))
    result[:, np.searchsorted(wanted, columns)] = part
    return result
