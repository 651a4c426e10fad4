"""Simulated blocks of satellite scenes: true corrections and lenses drawn from their a-priori sigmas, noisy pixels.

The scenes as given are those of `orbital_scene.overpass`; the truth is the same scenes with drawn corrections. A
simulated block finds what was put in: it shows that estimates and sigmas belong together, not that the models are those
of a real satellite.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration
from ..camera.sensors import lens_rotation
from ..geometry.rotation import R_BC_NOMINAL
from ..location.pushbroom import PushbroomSensor
from ..models.base import Extent, ModelOptions, PseudoObservations
from ..scene_adjustment.block import ImagePoints, KnownGround, Layout, SceneBlock
from ..scene_adjustment.functional import R_e_enu
from ..scene_adjustment.rigorous import CorrectionSet, RigorousImage, calibration_of, flight_axes_b, lens_view_of
from .orbital_scene import OrbitalScene

Array = NDArray[np.floating]


@dataclass(frozen=True)
class SimulatedBlock:
    """A block with its truth.

    Attributes
    ----------
    block : as an adjustment gets it
    position_e : (p, 3) true points, metres
    values : (u,) true unknowns of the images
    """

    block: SceneBlock
    position_e: Array
    values: Array = field(repr=False)


def rigorous_images(
    scenes: Sequence[OrbitalScene],
    model: ModelOptions,
    self_calibration: Callable[[LineCamera], SelfCalibration] | None = None,
    *,
    per_lens: bool = True,
) -> tuple[RigorousImage, ...]:
    """Images of overpasses, named ``k/line``, with a correction set a lens, or one an overpass.

    Lenses of the same id share their additional parameters over all overpasses.
    """
    images = []
    for number, scene in enumerate(scenes, start=1):
        camera = scene.sensor.camera
        spans = {id: _span(sensor) for id, sensor in scene.sensors.items()}
        whole = min(s for s, _ in spans.values()), max(e for _, e in spans.values())
        shared = CorrectionSet(
            str(number),
            model.build(Extent(f"strip {number}", *whole)),
            flight_axes_b(next(iter(scene.sensors.values())), 0.5 * sum(whole)),
        )
        for id, sensor in scene.sensors.items():
            name, span = f"{number}/{id}", spans[id]
            corrections = shared
            if per_lens:
                built = model.build(Extent(f"strip {name}", *span))
                corrections = CorrectionSet(name, built, flight_axes_b(sensor, 0.5 * sum(span)))
            calibration = None
            if self_calibration is not None:
                lens = camera.lines[camera.line_index[id]].lens
                view = lens_view_of(camera, id, R_BC_NOMINAL @ lens_rotation(scene.sensor.view_deg[lens]))
                calibration = calibration_of(f"{camera.name}/{id}", sensor, view, self_calibration)
            images.append(RigorousImage(name, sensor, corrections, calibration))
    return tuple(images)


def simulate_block(
    images: Sequence[RigorousImage],
    position_e: ArrayLike,
    control: Sequence[int],
    check: Sequence[int],
    rng: np.random.Generator,
    *,
    image_sigma_px: float = 0.3,
    control_sigma_m: tuple[float, float, float] = (0.5, 0.5, 0.5),
    values: ArrayLike | None = None,
) -> SimulatedBlock:
    """Image points of true points (p, 3) in all images that see them, with noise.

    Parameters
    ----------
    control, check : indices of points with known coordinates; those of check points are true
    control_sigma_m : east, north, up
    values : true unknowns (u,); None to draw them from their a-priori sigmas
    """
    P = np.asarray(position_e, dtype=float)
    n = len(P)
    layout = Layout.of(images)
    if values is None:
        drawn = [draw(group.prior, len(group), rng) for group in layout.groups]
        values = np.concatenate(drawn) if drawn else np.empty(0)
    values = np.asarray(values, dtype=float)
    parts: list[tuple[NDArray[Any], ...]] = []
    for k, (image, columns) in enumerate(zip(images, layout.columns, strict=True)):
        pixel = image.located(values[columns]).ground_to_pixel(P)
        pixel = pixel + rng.normal(0.0, image_sigma_px, pixel.shape)
        ends = np.array([image.sensor.lines, image.sensor.samples]) - 1.0
        seen = np.flatnonzero(((pixel >= 0.0) & (pixel <= ends)).all(axis=1))
        parts.append((np.full(len(seen), k), seen, *pixel[seen].T))
    image_of, point, line, sample = (np.concatenate([part[i] for part in parts]) for i in range(4))
    rays = ImagePoints(
        image_of.astype(np.int64), point.astype(np.int64), line, sample, np.full(len(line), image_sigma_px)
    )
    fixed, held_back = np.asarray(control, dtype=np.int64), np.asarray(check, dtype=np.int64)
    lat, lon, _ = images[0].sensor.ellipsoid.geodetic(P).T
    error = rng.normal(size=(len(fixed), 3)) * control_sigma_m
    given = P[fixed] + np.einsum("pij,pj->pi", R_e_enu(lat[fixed], lon[fixed]), error)
    covariance = np.tile(np.diag(np.square(control_sigma_m)), (len(fixed), 1, 1))
    known = KnownGround(
        np.concatenate([fixed, held_back]),
        np.concatenate([given, P[held_back]]),
        np.concatenate([covariance, np.zeros((len(held_back), 3, 3))]),
        ("control",) * len(fixed) + ("check",) * len(held_back),
    )
    ids = tuple(f"P{i}" for i in range(n))
    return SimulatedBlock(SceneBlock(tuple(images), ids, rays, known), P, values)


def draw(prior: PseudoObservations | None, n: int, rng: np.random.Generator) -> Array:
    """Unknowns (n,) drawn from what is known of them beforehand, continuity included.

    Raises
    ------
    ValueError : unknowns of which nothing is known
    """
    if prior is None:
        raise ValueError("unknowns of which nothing is known cannot be drawn")
    A = np.zeros((len(prior), n + 1))
    np.add.at(A, (np.arange(len(prior))[:, None], prior.columns), prior.coefficients)
    A = A[:, :-1] / prior.sigma[:, None]
    scale = 1.0 / np.linalg.norm(A, axis=0)
    factor = np.linalg.cholesky((A * scale).T @ (A * scale))
    return scale * np.linalg.solve(factor.T, rng.standard_normal(n))


def scattered_points(
    images: Sequence[RigorousImage],
    n: int,
    rng: np.random.Generator,
    height_m: tuple[float, float] = (0.0, 1500.0),
    inside_px: float | tuple[float, float] = 50.0,
) -> Array:
    """Ground points (n, 3), Earth-fixed, evenly over what the first image sees and within all others.

    Parameters
    ----------
    height_m : between which they lie
    inside_px : lines and samples at the edges of every image in which none lies

    Raises
    ------
    ValueError : images that do not see the same ground
    """  # fmt: skip
    found: list[Array] = []
    first, margin = images[0].sensor, np.broadcast_to(inside_px, 2)
    for _ in range(20):
        u, v = rng.uniform(0.0, first.lines - 1.0, n), rng.uniform(0.0, first.samples - 1.0, n)
        P = first.ground(u, v, rng.uniform(*height_m, n))
        inside = np.isfinite(P).all(axis=1)
        for image in images:
            pixel = image.sensor.ground_to_pixel(P)
            ends = np.array([image.sensor.lines, image.sensor.samples]) - 1.0 - margin
            inside &= ((pixel >= margin) & (pixel <= ends)).all(axis=1)
        found.append(P[inside])
        if sum(map(len, found)) >= n:
            return np.concatenate(found)[:n]
    raise ValueError(f"only {sum(map(len, found))} of {n} points lie in all images")


def _span(sensor: PushbroomSensor) -> tuple[float, float]:
    ends = np.sort(sensor.line_times.time_of(np.array([0.0, sensor.lines - 1.0])))
    return float(ends[0]), float(ends[1])
