"""Which unknown stands where: correction sets, additional parameters, and the columns each ray touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, IntArray
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import CameraDesign, SelfCalibration
from ..models.base import CorrectionModel, Design, Extent, ModelOptions, PseudoObservations, join_observations
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from .network import Network, Strip
from .surface_control import SurfaceControl

#: The shift of a surface that points lie on, as an unknown in words.
SURFACE_SHIFT = "shift of the surface"

#: Up to so many rays all terms of the corrections are formed at once.
FEW_RAYS = 512


@dataclass(frozen=True)
class CorrectionSet:
    """A model at its place among the unknowns.

    Attributes
    ----------
    strip : index of the strip
    lens : index of the lens where lenses look separately, else None
    model : its correction functions
    first_column : column of its first unknown
    """

    strip: int
    lens: int | None
    model: CorrectionModel
    first_column: int

    @property
    def columns(self) -> slice:
        return slice(self.first_column, self.first_column + self.model.n_unknowns)


@dataclass(frozen=True)
class RayShift:
    """Where rays are by what is known of them, less where they were measured; n rays.

    Attributes
    ----------
    orientation : (n, 6) of another line, and of less noise, m and rad
    image_mm : (2, n) by how much the image moves with it
    """

    orientation: Array
    image_mm: Array


@dataclass(frozen=True)
class Layout:
    """Unknowns of the reduced system (all but the object points) and what each ray has to do with them; n rays.

    The effect of unknowns ``theta`` on the orientation of ray i: correction ``component[t]`` gets
    ``coefficients[node[t], i] * theta[columns[t, i]]`` from every term t.

    Attributes
    ----------
    sets : correction sets
    set_of_ray : (n,)
    node, component : (T,) of the terms
    columns : (T, n) int32; -1 where a ray has no such term
    coefficients : (K, n)
    camera : effect of the additional parameters, where they act on the rays (`linearisation.fit_rays`; before there is
        a solution, at the measured coordinates); columns counted from `n_model`; None without self-calibration
    n_model, n_camera : numbers of unknowns; those of the model count the platform's, which come last of these
    names : (n_unknowns,) in words
    prior : a-priori knowledge of all unknowns
    heading : kappa's correction is one of heading, about the vertical: it turns the measured omega and phi as well
    shift : of the rays to where they are linearised; None if that is where they were measured
    n_surface : 1 where points lie on a surface, whose shift is the last unknown; else 0
    platform : constant errors of the platform among the unknowns; their terms come last
    assumed : (m,) additional parameters by their columns whose a-priori sigmas nobody stated
    """

    sets: tuple[CorrectionSet, ...]
    set_of_ray: IntArray
    node: IntArray
    component: IntArray
    columns: NDArray[np.int32]
    coefficients: Array
    camera: CameraDesign | None
    n_model: int
    n_camera: int
    names: tuple[str, ...]
    prior: PseudoObservations
    heading: bool = False
    shift: RayShift | None = None
    n_surface: int = 0
    platform: PlatformErrors = NO_PLATFORM_ERRORS
    assumed: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def n_of_sets(self) -> int:
        """Number of unknowns of the correction sets."""
        return self.n_model - self.platform.n_unknowns

    @property
    def platform_columns(self) -> IntArray:
        """(m,) of the platform's unknowns."""
        return np.arange(self.n_of_sets, self.n_model)

    @property
    def n_unknowns(self) -> int:
        return self.n_model + self.n_camera + self.n_surface

    @property
    def shift_column(self) -> int:
        """Column of the shift of the surface that points lie on."""
        return self.n_model + self.n_camera

    def shift_of(self, theta: Array) -> float:
        """Shift of the surface, m; 0 without one."""
        return float(theta[self.shift_column]) if self.n_surface else 0.0

    def corrections(self, theta: Array, rays: slice = slice(None)) -> Array:
        """Orientation corrections (6, n) of the rays, or of a range of them."""
        padded = np.zeros(self.n_model + 1)  # at the end what does not act
        padded[:-1] = theta[: self.n_model]
        if not padded.any():
            return np.zeros((6, self.columns[:, rays].shape[1]))
        coefficients = self.coefficients[:, rays]
        if coefficients.shape[1] <= FEW_RAYS:  # one product costs less than many calls
            sums = (self.component == np.arange(6)[:, None]).astype(float)
            return sums @ (padded.take(self.columns[:, rays]) * coefficients.take(self.node, axis=0))
        total = np.zeros((6, coefficients.shape[1]))
        for node, component, columns in zip(self.node, self.component, self.columns, strict=True):
            value = padded.take(columns[rays])
            value *= coefficients[node]
            total[component] += value
        return total

    def displacement(self, theta: Array, rays: slice = slice(None)) -> Array | float:
        """Image displacement (2, n) in mm by the additional parameters; 0.0 without self-calibration."""
        return self.camera.evaluate(theta[self.n_model :], rays) if self.camera else 0.0

    def fitted(self, xy_mm: Array, shift: RayShift | None) -> Layout:
        """The same unknowns, additional parameters that act at image coordinates (2, n), and rays elsewhere."""
        assert self.camera is not None
        return replace(self, camera=replace(self.camera, xy_mm=xy_mm), shift=shift)


def build_layout(
    network: Network,
    options: ModelOptions,
    self_calibration: SelfCalibration | None = None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
) -> Layout:
    """Correction sets for all strips (and lenses) that have rays, then the platform, then additional parameters."""
    _, present, set_of_ray = sets_of_rays(network)
    is_control = np.zeros(network.n_points, dtype=bool)
    is_control[network.control.point] = True
    rays = network.rays
    own = [set_of_ray == s for s in range(len(present))]
    sets = correction_sets(
        network.camera,
        network.strips,
        present,
        [rays.time_s[mine] for mine in own],
        [rays.time_s[mine & is_control[rays.point]] for mine in own],
        options,
        self_calibration is not None,
    )
    return layout_of(network, sets, set_of_ray, self_calibration, platform)


def sets_of_rays(network: Network) -> tuple[IntArray, IntArray, IntArray]:
    """Number of the correction set of each ray (n,), those that are present, and which of these each ray has (n,).

    Numbers count strips, or lenses of strips where lenses look separately.
    """
    rays, lenses = network.rays, len(network.camera.lenses)
    key = rays.strip if lenses <= 1 else rays.strip * lenses + network.camera.lens_of_line[rays.ccd]
    present, set_of_ray = np.unique(key, return_inverse=True)
    return key, present, set_of_ray


def correction_sets(
    camera: LineCamera,
    strips: Sequence[Strip],
    present: IntArray,
    ray_time_s: Sequence[Array],
    control_time_s: Sequence[Array],
    options: ModelOptions,
    self_calibration: bool,
) -> tuple[CorrectionSet, ...]:
    """Correction sets with these numbers (see `sets_of_rays`), given the times of their rays, and of those to control
    points."""
    lenses = len(camera.lenses)
    sets: list[CorrectionSet] = []
    first = 0
    for k, times, of_control in zip(present.tolist(), ray_time_s, control_time_s, strict=True):
        strip_index, lens_index = divmod(k, lenses) if lenses > 1 else (k, None)
        strip = strips[strip_index]
        name = f"strip {strip.id}"
        if lens_index is not None and strip.lens is None:
            name += f", lens {camera.lenses[lens_index].id}"
        limits = strip.trajectory.start_s, strip.trajectory.end_s
        extent = Extent(name, *limits, times, of_control, self_calibration, strip.id)
        model = options.build(extent)
        sets.append(CorrectionSet(strip_index, lens_index, model, first))
        first += model.n_unknowns
    return tuple(sets)


def layout_of(
    network: Network,
    sets: Sequence[CorrectionSet],
    set_of_ray: IntArray,
    self_calibration: SelfCalibration | None = None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
) -> Layout:
    """The layout of correction sets that are known, with the one (n,) of each ray; sets may be without rays here."""
    rays, unknowns = network.rays, unknowns_of(sets, self_calibration, platform, network.surface)
    places = ((np.flatnonzero(set_of_ray == s), item) for s, item in enumerate(sets))
    designs = [(mine, item) for mine, item in places if len(mine)]
    parts = [(mine, item.first_column, item.model.design(rays.time_s[mine])) for mine, item in designs]
    node, component, columns, coefficients = _terms(parts, len(rays))
    if platform.n_unknowns:
        first = sets[-1].columns.stop
        own = [
            (mine, first, platform_design(network.strips[item.strip], rays.time_s[mine], platform, network.heading))
            for mine, item in designs
        ]
        more = _terms(own, len(rays))
        node, component = np.append(node, len(coefficients) + more[0]), np.append(component, more[1])
        columns, coefficients = np.concatenate([columns, more[2]]), np.concatenate([coefficients, more[3]])
    camera = None
    if self_calibration is not None and self_calibration.n_unknowns:
        camera = self_calibration.design(rays.ccd, rays.sample, rays.xy_mm, rays.focal_length_mm)
    return Layout(
        tuple(sets),
        set_of_ray.astype(np.int64),
        node,
        component,
        columns,
        coefficients,
        camera,
        unknowns.n_model,
        unknowns.n_camera,
        unknowns.names,
        unknowns.prior,
        network.heading,
        n_surface=int(network.surface is not None),
        platform=platform,
        assumed=unknowns.assumed,
    )


@dataclass(frozen=True)
class Unknowns:
    """Unknowns of the reduced system without the rays: see `Layout`."""

    n_model: int
    n_camera: int
    names: tuple[str, ...]
    prior: PseudoObservations
    assumed: IntArray


def unknowns_of(
    sets: Sequence[CorrectionSet],
    self_calibration: SelfCalibration | None,
    platform: PlatformErrors,
    surface: SurfaceControl | None,
) -> Unknowns:
    """Names of the unknowns in the order of their columns, and what is known of them beforehand."""
    first = sets[-1].columns.stop
    names = [name for s in sets for name in s.model.unknown_names]
    prior = [_shifted(s.model.pseudo_observations(), s.first_column) for s in sets]
    if platform.n_unknowns:
        names += platform.unknown_names
        prior.append(_shifted(platform.pseudo_observations(), first))
        first += platform.n_unknowns
    assumed = np.empty(0, dtype=np.int64)
    if self_calibration is not None and self_calibration.n_unknowns:
        assumed = first + np.flatnonzero(self_calibration.assumed)
        names += self_calibration.unknown_names
        m = self_calibration.n_unknowns
        prior.append(
            PseudoObservations(
                np.arange(first, first + m, dtype=np.int32)[:, None],
                np.ones((m, 1)),
                np.zeros(m),
                self_calibration.apriori_sigma,
                self_calibration.unknown_names,
            )
        )
    n_camera = len(names) - first
    if surface is not None:
        names.append(SURFACE_SHIFT)
        sigma = np.array([surface.shift_sigma_m])
        column = np.array([[first + n_camera]], dtype=np.int32)
        prior.append(PseudoObservations(column, np.ones((1, 1)), np.zeros(1), sigma, (SURFACE_SHIFT,)))
    return Unknowns(first, n_camera, tuple(names), join_observations(prior), assumed)


def platform_design(strip: Strip, time_s: Array, platform: PlatformErrors, heading: bool) -> Design:
    """Corrections of a strip at times (n,) by constant errors of the platform, columns counted from 0."""
    return platform.design(strip.trajectory.at(time_s), strip.trajectory, heading)


def _terms(
    designs: Sequence[tuple[IntArray, int, Design]], n: int
) -> tuple[IntArray, IntArray, NDArray[np.int32], Array]:
    """Terms (node, component) that any of n rays has, their columns (T, n) and the coefficients (K, n).

    Parameters
    ----------
    designs : places of rays, first of their columns, and their design
    """
    nodes = max(d.coefficients.shape[1] for _, _, d in designs)
    present = np.zeros((nodes, 6), dtype=bool)
    # a model without segments has the same columns for all rays, which are one row in memory then
    distinct = [d.columns[:1] if d.columns.strides[0] == 0 else d.columns for _, _, d in designs]
    for own in distinct:
        present[: own.shape[1]] |= own.max(axis=0) >= 0
    node, component = np.nonzero(present)
    columns = np.full((len(node), n), -1, dtype=np.int32)
    coefficients = np.zeros((nodes, n))
    for (mine, first, d), of_rays in zip(designs, distinct, strict=True):
        width = of_rays.shape[1]
        coefficients[:width, mine] = d.coefficients.T
        own = np.flatnonzero(node < width)
        of_set = np.full((len(node), len(of_rays)), -1, dtype=np.int32)
        of_set[own] = of_rays[:, node[own], component[own]].T
        of_set[of_set >= 0] += first
        columns[:, mine] = of_set
    return node, component, columns, coefficients


def _shifted(prior: PseudoObservations, first: int) -> PseudoObservations:
    return replace(prior, columns=np.where(prior.columns >= 0, prior.columns + first, -1).astype(np.int32))
