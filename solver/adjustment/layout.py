"""Which unknown stands where: correction sets, additional parameters, and the columns each ray touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera.self_calibration import CameraDesign, SelfCalibration
from ..models.base import CorrectionModel, Extent, ModelOptions, PseudoObservations, join_observations
from .network import Network

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

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
    n_model, n_camera : numbers of unknowns
    names : (n_model + n_camera,) in words
    prior : a-priori knowledge of all unknowns
    heading : kappa's correction is one of heading, about the vertical: it turns the measured omega and phi as well
    shift : of the rays to where they are linearised; None if that is where they were measured
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

    @property
    def n_unknowns(self) -> int:
        return self.n_model + self.n_camera

    def corrections(self, theta: Array, rays: slice = slice(None)) -> Array:
        """Orientation corrections (6, n) of the rays, or of a range of them."""
        padded = np.append(theta[: self.n_model], 0.0)
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

    def fitted(self, coefficients: Array, shift: RayShift) -> Layout:
        """The same unknowns, additional parameters with coefficients (2, slots, n), and rays elsewhere."""
        assert self.camera is not None
        return replace(self, camera=replace(self.camera, coefficients=coefficients), shift=shift)


def build_layout(network: Network, options: ModelOptions, self_calibration: SelfCalibration | None = None) -> Layout:
    """Correction sets for all strips (and lenses) that have rays, additional parameters behind them."""
    rays = network.rays
    lens = network.camera.lens_of_line[rays.ccd]
    separate = len(network.camera.lenses) > 1
    key = rays.strip * (len(network.camera.lenses) if separate else 1) + (lens if separate else 0)
    present, set_of_ray = np.unique(key, return_inverse=True)
    is_control = np.zeros(network.n_points, dtype=bool)
    is_control[network.control.point] = True
    sets: list[CorrectionSet] = []
    first = 0
    for s, k in enumerate(present):
        strip_index, lens_index = divmod(int(k), len(network.camera.lenses)) if separate else (int(k), None)
        strip = network.strips[strip_index]
        mine = set_of_ray == s
        name = f"strip {strip.id}"
        if lens_index is not None and strip.lens is None:
            name += f", lens {network.camera.lenses[lens_index].id}"
        extent = Extent(
            name,
            strip.trajectory.start_s,
            strip.trajectory.end_s,
            rays.time_s[mine],
            rays.time_s[mine & is_control[rays.point]],
            self_calibration is not None,
        )
        model = options.build(extent)
        sets.append(CorrectionSet(strip_index, lens_index, model, first))
        first += model.n_unknowns
    node, component, columns, coefficients = _terms(sets, set_of_ray, rays.time_s)
    camera = None
    names = [name for s in sets for name in s.model.unknown_names]
    prior = [_shifted(s.model.pseudo_observations(), s.first_column) for s in sets]
    if self_calibration is not None and self_calibration.n_unknowns:
        camera = self_calibration.design(rays.ccd, rays.sample, rays.xy_mm, rays.focal_length_mm)
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
    return Layout(
        tuple(sets),
        set_of_ray.astype(np.int64),
        node,
        component,
        columns,
        coefficients,
        camera,
        first,
        len(names) - first,
        tuple(names),
        join_observations(prior),
        network.heading,
    )


def _terms(sets: Sequence[CorrectionSet], set_of_ray: IntArray, time_s: Array):
    """Terms (node, component) that any ray has, their columns (T, n) and the coefficients (K, n)."""
    n = len(time_s)
    designs = []
    for s, item in enumerate(sets):
        mine = np.flatnonzero(set_of_ray == s)
        designs.append((mine, item.first_column, item.model.design(time_s[mine])))
    nodes = max(d.coefficients.shape[1] for _, _, d in designs)
    present = np.zeros((nodes, 6), dtype=bool)
    for _, _, d in designs:
        present[: d.columns.shape[1]] |= (d.columns >= 0).any(axis=0)
    node, component = np.nonzero(present)
    columns = np.full((len(node), n), -1, dtype=np.int32)
    coefficients = np.zeros((nodes, n))
    for mine, first, d in designs:
        width = d.columns.shape[1]
        coefficients[:width, mine] = d.coefficients.T
        for t in np.flatnonzero(node < width):
            local = d.columns[:, node[t], component[t]]
            columns[t, mine] = np.where(local >= 0, local + first, -1)
    return node, component, columns, coefficients


def _shifted(prior: PseudoObservations, first: int) -> PseudoObservations:
    return replace(prior, columns=np.where(prior.columns >= 0, prior.columns + first, -1).astype(np.int32))
