"""Published results of real testfields, and the networks they came from [K ch. 5], [P].

A row is one adjustment of a table (`published_tables`): its model, number of control points and figures. A network
gives for a row the sigma that its geometry and weights promise, before anything is measured: satellite scenes on the
round Earth, aerial blocks in their local frame. Weights are those of the tables; as there, they belong to a unit weight
of the a-priori image sigma, and sigmas are multiplied by the published sigma0 over it [K 4.2.3, 4.2.4]. No error is
drawn: image points and control are exact. What a publication leaves unsaid stands in the network's `unsaid`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..adjustment.adjustment import adjust as adjust_aerial
from ..adjustment.covariance import point_cofactors
from ..adjustment.direct_georeferencing import georeference
from ..adjustment.network import Control
from ..adjustment.statistics import planimetric
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions, same
from ..models.dgr import DgrOptions
from ..scene_adjustment.block import SceneBlock
from ..scene_adjustment.solution import SceneSolution, adjust, linearise, prepare
from .orbital_scene import ORBITAL_SENSORS, overpass
from .satellite_block import rigorous_images, scattered_points, simulate_block
from .testfield_study import choose_control
from .testfields import Published, Testfield

Array = NDArray[np.floating]

#: Errors of image points of networks that are free of errors, pixels: small enough to leave no trace.
_NONE_PX = 1e-7


@dataclass(frozen=True)
class PublishedRow:
    """One adjustment of a published table.

    Attributes
    ----------
    label : "DGR SC", "LIM-45 T.12"
    model : of the trajectory
    control, check : numbers of points
    published : its figures
    image_px : a-priori image sigma
    sigma0_px : sigma of unit weight that the sigmas are taken with
    calibrated : with additional parameters
    adjusted : False for direct georeferencing
    """

    label: str
    model: ModelOptions
    control: int
    check: int
    published: Published
    image_px: float
    sigma0_px: float
    calibrated: bool = True
    adjusted: bool = True


class PublishedNetwork(Protocol):
    """A testfield with rows.

    Attributes
    ----------
    key, name : for the command line, and in full
    rows : published
    unsaid : one sentence: what the publication leaves unsaid, and what is assumed
    """

    @property
    def key(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def rows(self) -> tuple[PublishedRow, ...]: ...
    @property
    def unsaid(self) -> str: ...

    def sigma_m(self, row: PublishedRow, rng: np.random.Generator) -> Array:
        """Root of the mean variances (3,) in X, Y, Z (scenes: east, north, up) of the points that were compared."""
        ...


@dataclass(frozen=True)
class SceneNetwork:
    """One overpass of a satellite on the round Earth; lenses have correction functions of their own.

    Attributes
    ----------
    sensor : a name of `ORBITAL_SENSORS`
    lat_deg, lon_deg : that the satellite passes over
    known, tie : points with given coordinates, and others
    height_m : between which the ground lies
    margin_px : (lines, samples) of every image in which no point lies
    control_m : sigma of given coordinates
    calibration : additional parameters of a lens; None for none
    of_control : the published differences are those of the control points themselves
    """

    key: str
    name: str
    sensor: str
    lat_deg: float
    lon_deg: float
    known: int
    tie: int
    height_m: tuple[float, float]
    margin_px: tuple[float, float]
    control_m: float
    calibration: Callable[[LineCamera], SelfCalibration] | None
    rows: tuple[PublishedRow, ...]
    unsaid: str
    of_control: bool = False

    def block(self, row: PublishedRow, rng: np.random.Generator) -> SceneBlock:
        """The network with points at random and control well spread, free of errors."""
        scene = overpass(ORBITAL_SENSORS[self.sensor], self.lat_deg, self.lon_deg)
        images = rigorous_images([scene], row.model, self.calibration if row.calibrated else None)
        P = scattered_points(images, self.known + self.tie, rng, self.height_m, self.margin_px)
        lat, lon, _ = images[0].sensor.ellipsoid.geodetic(P[: self.known]).T
        chosen = choose_control(np.column_stack([lon * np.cos(lat.mean()), lat]), row.control)
        rest = np.setdiff1d(np.arange(self.known), chosen)
        unknowns = sum(len(group) for image in images for group in image.groups)
        block = simulate_block(
            images, P, chosen.tolist(), rest.tolist(), rng,
            image_sigma_px=_NONE_PX, control_sigma_m=same(self.control_m), values=np.zeros(unknowns),
        ).block  # fmt: skip
        rays = replace(block.rays, sigma_px=np.full(len(block.rays), row.image_px))
        known = replace(block.known, position_e=P[block.known.point])
        return replace(block, rays=rays, known=known)

    def sigma_m(self, row: PublishedRow, rng: np.random.Generator) -> Array:
        solution = adjust(prepare(self.block(row, rng)))
        points = np.flatnonzero(solution.problem.given.any(axis=1))
        if self.of_control:
            C = control_differences(solution, points)
        else:
            C = solution.points_covariance[np.setdiff1d(np.arange(self.known), points)]
        return row.sigma0_px / row.image_px * np.sqrt(np.einsum("pii->pi", C).mean(axis=0))


def control_differences(solution: SceneSolution, points: NDArray[np.int64]) -> Array:
    """Covariance (k, 3, 3) of rays' intersections with the adjusted orientation minus given coordinates of control.

    The adjusted point weighs both: ``(N + W) p = N p_rays + W g``, so that ``p_rays - g = (1 + N^-1 W) (p - g)``, and
    the covariance of ``p - g`` is that of residuals, ``W^-1 - C``.
    """
    nothing = np.zeros_like(solution.problem.given)
    N = linearise(solution.problem, solution.state, solution.ray_weight, nothing).N_pp[points]
    given = solution.problem.covariance_enu[points]
    M = np.eye(3) + np.linalg.solve(N, np.linalg.inv(given))
    return M @ (given - solution.points_covariance[points]) @ np.swapaxes(M, -1, -2)


@dataclass(frozen=True)
class AerialNetwork:
    """A simulated testfield (`testfields`) with its published rows; no errors of trajectory and camera are drawn."""

    field: Testfield
    rows: tuple[PublishedRow, ...]
    unsaid: str

    @property
    def key(self) -> str:
        return self.field.key

    @property
    def name(self) -> str:
        return self.field.name

    def sigma_m(self, row: PublishedRow, rng: np.random.Generator) -> Array:
        tiny = same(1e-9)
        noise = replace(self.field.noise, image_px=_NONE_PX, wander_m=0.0, wander_deg=0.0)
        exact = replace(self.field, noise=noise, errors=DgrOptions(tiny, tiny, tiny), camera_errors={})
        network = exact.simulate(rng).network
        known, xyz = network.check.point, network.check.xyz_l
        chosen = choose_control(xyz[:, :2], row.control)
        rest = np.setdiff1d(np.arange(len(known)), chosen)
        spread = np.asarray(self.field.noise.control_m, dtype=float)
        sigma = np.full(len(network.rays), row.image_px)
        network = replace(
            network,
            control=Control(known[chosen], xyz[chosen], np.tile(spread, (len(chosen), 1))),
            check=Control(known[rest], xyz[rest], np.tile(spread, (len(rest), 1))),
            rays=replace(network.rays, sigma_line_px=sigma, sigma_sample_px=sigma),
        )
        if row.adjusted:
            parameters = self.field.calibration if row.calibrated else None
            Q = point_cofactors(adjust_aerial(network, row.model, parameters))[known[rest]]
            variance = np.einsum("pii->pi", Q)
        else:
            variance = georeference(network, row.model).sigma_m[known[rest]] ** 2
        return row.sigma0_px / row.image_px * np.sqrt(np.nanmean(variance, axis=0))


@dataclass(frozen=True)
class NetworkSigma:
    """A row with what its network promises, metres.

    Attributes
    ----------
    sigma_m : (placements, 3) X, Y, Z
    """

    network: PublishedNetwork
    row: PublishedRow
    sigma_m: Array

    @property
    def sigma_xy(self) -> float:
        """Median over the placements."""
        return float(np.median([planimetric(sigma) for sigma in self.sigma_m]))

    @property
    def sigma_z(self) -> float:
        """Median over the placements."""
        return float(np.median(self.sigma_m[:, 2]))


def network_sigmas(
    networks: Sequence[PublishedNetwork], placements: int, progress: Callable[[float], None] | None = None
) -> list[NetworkSigma]:
    """Sigmas of all rows of some networks, with points placed at random so many times."""
    total, rows = sum(len(network.rows) for network in networks), []
    for network in networks:
        for row in network.rows:
            sigma = [network.sigma_m(row, np.random.default_rng(seed)) for seed in range(placements)]
            rows.append(NetworkSigma(network, row, np.array(sigma)))
            if progress:
                progress(len(rows) / total)
    return rows
