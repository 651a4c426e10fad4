"""Rectification by transforms of the plane, by rational polynomials and by the differential method, on the same points.

The scene is a frame image like BILSAT's [D 3]: 2048 x 2048 pixels of 27.6 m from 686 km. Control and check points are
measured in the image; transforms take pixels straight to the map, rational polynomials and the differential method go
through the height of each point. The differential method estimates the six orientation parameters from the control.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimation.plane_transforms import fit_transform
from ..geometry.ellipsoid import WGS84
from ..geometry.frames import LocalFrame
from ..geometry.rotation import matrix_from_angles
from ..location.frame_camera import FrameCamera
from ..location.rpc_fit import fit_to_points
from .grid import MapGrid, default_crs

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: Methods, in the order of the table; the number of a polynomial is its order.
METHODS = (
    "helmert", "affine", "pseudo-affine", "projective", "conformal", "polynomial 2", "polynomial 3", "rpc",
    "differential",
)  # fmt: skip
#: Place of the scene (around Ankara), and the height of its middle above the ellipsoid, m.
PLACE_DEG, MIDDLE_M = (39.9, 32.8), 1000.0
#: Orientation parameters are drawn to their start with these sigmas: east, north, up (m), turns (rad). Tuned: weak
#: against nine control points, so that starts may be off by as much, strong against the correlation of shift and tilt.
START_SIGMA = np.array([2e4, 2e4, 2e4, 0.15, 0.15, 0.15])
#: Two-sided level of the test of one point is 0.001.
CRITICAL = 3.29
_MOST_STEPS, _WHOLE_STEPS, _CONVERGED_PX, _ROBUST_PX = 100, 10, 1e-3, 0.1


def bilsat_camera(tilt_deg: tuple[float, float] = (4.0, -6.0)) -> FrameCamera:
    """A frame camera like BILSAT's over the scene, tilted a little."""
    lat, lon = PLACE_DEG
    frame = LocalFrame(lat, lon, 0.0)
    omega, phi = np.radians(tilt_deg)
    R = frame.R_el @ matrix_from_angles(omega, phi, np.radians(12.0))
    C = WGS84.cartesian(np.radians(lat), np.radians(lon), 686e3)
    return FrameCamera(C, R, 150.0, 150.0 * 27.6 / 685e3, 2048, 2048, distortion=(2e-7, 0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Points:
    """Points of a scene; n of them.

    Attributes
    ----------
    pixel : (n, 2) line and sample as measured
    lat, lon : (n,) radians, as known on the ground
    height_m : (n,) of the terrain model
    map_m : (n, 2) east and north
    blunder : (n,) points measured wrongly on purpose
    """

    pixel: Array
    lat: Array
    lon: Array
    height_m: Array
    map_m: Array
    blunder: Mask


@dataclass(frozen=True)
class Noise:
    """Standard deviations, and blunders.

    Attributes
    ----------
    pixel : of a measured line or sample
    ground_m : of the horizontal place of control, each way
    height_m : of the terrain model
    blunders : share of control points that are wrong by 20 to 60 pixels
    """

    pixel: float = 0.3
    ground_m: float = 5.0
    height_m: float = 5.0
    blunders: float = 0.0


def scene_points(camera: FrameCamera, n: int, relief_m: float, noise: Noise, rng: np.random.Generator) -> Points:
    """Points all over the image, on waves of a height from top to bottom; the map is the UTM zone."""
    u, v = rng.uniform(0, camera.lines - 1, n), rng.uniform(0, camera.samples - 1, n)
    h = np.full(n, MIDDLE_M)
    located = camera.direct(u, v, h)
    for _ in range(20):  # the waves are gentler than the rays
        h = MIDDLE_M + waves(located[:, 0], located[:, 1], relief_m)
        located = camera.direct(u, v, h)
    lat, lon = located[:, 0].copy(), located[:, 1].copy()
    lat += noise.ground_m / 6.37e6 * rng.normal(size=n)
    lon += noise.ground_m / 6.37e6 / np.cos(lat) * rng.normal(size=n)
    pixel = np.stack([u, v], axis=1) + noise.pixel * rng.normal(size=(n, 2))
    wrong = np.zeros(n, dtype=bool)
    wrong[: round(noise.blunders * n)] = True
    way = rng.uniform(0, 2 * np.pi, n)
    size = rng.uniform(20.0, 60.0, n) * wrong
    pixel += size[:, None] * np.stack([np.sin(way), np.cos(way)], axis=1)
    grid = MapGrid(default_crs(*np.radians(PLACE_DEG)), 0.0, 0.0, 1.0, 1, 1)
    east, north = grid.map(lat, lon)
    height = h + noise.height_m * rng.normal(size=n)
    return Points(pixel, lat, lon, height, np.stack([east, north], axis=1), wrong)


def waves(lat: ArrayLike, lon: ArrayLike, relief_m: float) -> Array:
    """Heights (n,) of waves every 20 km, half of ``relief_m`` up and down."""
    y, x = np.asarray(lat) * 6.37e6, np.asarray(lon) * 6.37e6 * np.cos(np.radians(PLACE_DEG[0]))
    return 0.5 * relief_m * np.sin(2 * np.pi * x / 20e3) * np.cos(2 * np.pi * y / 20e3)


@dataclass(frozen=True)
class Resection:
    """An orientation from control.

    Attributes
    ----------
    camera : oriented
    rejected : (n,) points that data snooping left out
    sigma0 : 1 where the sigmas are right
    iterations : of all adjustments together
    converged : whether the last one came to rest
    """

    camera: FrameCamera
    rejected: Mask
    sigma0: float
    iterations: int
    converged: bool


def resection(
    camera: FrameCamera,
    points: Points,
    sigma_px: ArrayLike,
    *,
    snoop: bool = True,
    start_sigma: ArrayLike = START_SIGMA,
) -> Resection:
    """Position and attitude of a frame camera from control, by least squares with fictitious observations of the start.

    Gross errors are first weighted down (Huber's weights), since they would bend the start of a test of single points,
    then the points are tested one by one, the worst first, and left out.

    Raises
    ------
    ValueError : fewer than three points
    """
    n = len(points.lat)
    if n < 3:
        raise ValueError(f"{n} control points, wanted at least 3")
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=float), n)
    prior = np.diag(1.0 / np.square(np.asarray(start_sigma, dtype=float)))
    lat, lon, _ = camera.ellipsoid.geodetic(camera.position_e)
    axes = LocalFrame(float(np.degrees(lat)), float(np.degrees(lon)), 0.0).R_el
    used = np.ones(n, dtype=bool)
    x, steps = np.zeros(6), 0
    for steps in range(1, _WHOLE_STEPS + 1):  # from afar, whole steps go further
        good, r, J = _residuals(camera, axes, x, points, sigma, used)
        if good.sum() < 3:
            return Resection(camera, ~used, float("nan"), steps, False)
        step = np.linalg.solve(np.einsum("nki,nkj->ij", J, J) + prior, np.einsum("nki,nk->i", J, r) - prior @ x)
        x = x + step
        if np.abs(np.einsum("nki,i->nk", J, step) * sigma[good, None]).max() < _ROBUST_PX:
            break
    for robust in (True, False) if snoop else (False,):
        while True:
            found = _adjusted(camera, axes, x, points, sigma, prior, used, robust)
            steps += found.steps
            if not found.converged:
                return Resection(camera, ~used, float("nan"), steps, False)
            x = found.x
            good, r, J = found.good, found.residual, found.design
            size = np.linalg.norm(r, axis=1)
            if robust:  # then with full weights, without what is far off
                far = size > 6.0 * _scale(size)
                if good.sum() - far.sum() >= 4:
                    used[np.flatnonzero(good)[far]] = False
                break
            Q = np.linalg.inv(np.einsum("nki,nkj->ij", J, J) + prior)
            w = np.abs(r) / np.sqrt(np.maximum(1.0 - np.einsum("nki,ij,nkj->nk", J, Q, J), 1e-6))
            worst = int(np.argmax(w.max(axis=1)))
            if not snoop or w[worst].max() <= CRITICAL or good.sum() <= 4:
                redundancy = max(2 * int(good.sum()) - 6, 1)
                sigma0 = float(np.sqrt(np.sum(r**2) / redundancy))
                # a solution that most of the points contradict is none
                return Resection(_moved(camera, axes, x), ~used, sigma0, steps, bool(used.sum() > 0.5 * n))
            used[np.flatnonzero(good)[worst]] = False
    raise AssertionError("the last round returns")


@dataclass(frozen=True)
class _Adjusted:
    """One adjustment: corrections, points that were seen, their whitened residuals (k, 2) and design (k, 2, 6)."""

    x: Array
    good: Mask
    residual: Array
    design: Array
    steps: int
    converged: bool


def _scale(size: Array) -> float:
    """Robust sigma of whitened residuals of one coordinate, from their lengths; at least 1."""
    return max(float(np.median(size)) / 1.1774, 1.0)


def _adjusted(
    camera: FrameCamera, axes: Array, x: Array, points: Points, sigma: Array, prior: Array, used: Mask, robust: bool
) -> _Adjusted:
    """Gauss and Newton's method with steps that are halved until they help."""
    state = _residuals(camera, axes, x, points, sigma, used)
    for steps in range(1, _MOST_STEPS + 1):
        good, r, J = state
        if good.sum() < 3:
            return _Adjusted(x, good, r, J, steps, False)
        size = np.linalg.norm(r, axis=1)
        limit = 2.0 * _scale(size) if robust else np.inf
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-9))
        N = np.einsum("nki,n,nkj->ij", J, weight, J) + prior
        right = np.einsum("nki,n,nk->i", J, weight, r) - prior @ x
        cost = _cost(size, limit, x, prior)
        step = np.linalg.solve(N, right)
        while True:  # shift and tilt of a narrow image are nearly the same: a whole step may go too far
            tried = _residuals(camera, axes, x + step, points, sigma, used)
            if tried[0].sum() >= good.sum():
                new = _cost(np.linalg.norm(tried[1], axis=1), limit, x + step, prior)
                if new <= cost * (1.0 + 1e-9) + 1e-12:
                    break
            step = 0.5 * step
            if np.abs(np.einsum("nki,i->nk", J, step) * sigma[good, None]).max() < 0.01 * _CONVERGED_PX:
                return _Adjusted(x, good, r, J, steps, True)  # no step makes it better
        x, state = x + step, tried
        # the robust round only has to find what is far off
        still = np.abs(np.einsum("nki,i->nk", J, step) * sigma[good, None]).max()
        if still < (_ROBUST_PX if robust else _CONVERGED_PX):
            return _Adjusted(x, *state, steps, True)
    return _Adjusted(x, *state, _MOST_STEPS, False)


def _cost(size: Array, limit: float, x: Array, prior: Array) -> float:
    """Huber's, of lengths of whitened residuals, and the fictitious observations."""
    far = size > limit
    return float(np.sum(np.where(far, 2.0 * limit * size - limit**2 if far.any() else 0.0, size**2)) + x @ prior @ x)


def _residuals(
    camera: FrameCamera, axes: Array, x: Array, points: Points, sigma: Array, used: Mask
) -> tuple[Mask, Array, Array]:
    """Points that take part, their whitened residuals (k, 2) and derivatives (k, 2, 6)."""
    now = _moved(camera, axes, x)
    seen = now.inverse(points.lat, points.lon, points.height_m, 1e7)
    good = used & np.isfinite(seen[:, 0])
    r = (points.pixel - seen)[good] / sigma[good, None]
    J = now.image_derivatives(seen[good, 0], seen[good, 1], points.height_m[good]) / sigma[good, None, None]
    return good, r, J


def _moved(camera: FrameCamera, axes: Array, x: Array) -> FrameCamera:
    """The camera shifted by ``x[:3]`` along axes (columns) and turned by ``x[3:]`` about them."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(axes @ x[3:]).as_matrix() @ camera.R_ec
    return camera.with_orientation(camera.position_e + axes @ x[:3], R)


def rectified(method: str, control: Points, pixel: Array, height_m: Array, start: FrameCamera, noise: Noise) -> Array:
    """East and north (n, 2) of pixels (n, 2) by a method, from control.

    Raises
    ------
    ValueError : an unknown method, too few points
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r}, wanted one of {', '.join(METHODS)}")
    grid = MapGrid(default_crs(*np.radians(PLACE_DEG)), 0.0, 0.0, 1.0, 1, 1)
    if method == "rpc":
        fit = fit_to_points(control.lat, control.lon, control.height_m, control.pixel[:, 0], control.pixel[:, 1])
        located = fit.rpc.direct(pixel[:, 0], pixel[:, 1], height_m)
    elif method == "differential":
        sigma = np.hypot(noise.pixel, np.hypot(noise.ground_m, 0.15 * noise.height_m) / 27.6)
        found = resection(start, control, sigma)
        if not found.converged:
            raise ValueError("the differential method found no orientation that most control points agree with")
        located = found.camera.direct(pixel[:, 0], pixel[:, 1], height_m)
    else:
        kind, _, order = method.partition(" ")
        return fit_transform(kind, control.pixel, control.map_m, order=int(order or 2)).at(pixel)
    return np.stack(grid.map(located[:, 0], located[:, 1]), axis=1)


@dataclass(frozen=True)
class Compared:
    """One method on one scene.

    Attributes
    ----------
    rmse_m : (2,) east and north, of the check points, over all draws; NaN where the method failed
    control_rmse_m : (2,) of the control
    seconds : of one estimation and its check points, the median
    failed : draws in which the method gave nothing
    """

    rmse_m: Array
    control_rmse_m: Array
    seconds: float
    failed: int


def compare(
    methods: tuple[str, ...], n_control: int, n_check: int, relief_m: float, noise: Noise, seeds: int,
    start_error: Callable[[np.random.Generator], Array] | None = None,
) -> dict[str, Compared]:  # fmt: skip
    """Every method on the same drawn points.

    Parameters
    ----------
    relief_m : from the lowest to the highest ground
    seeds : number of draws
    start_error : errors of the first orientation, six numbers as in `START_SIGMA`; None for those of a satellite with
        star tracker (100 m, 0.02 degrees)
    """
    square: dict[str, list[list[Array]]] = {name: [[], []] for name in methods}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    failed = dict.fromkeys(methods, 0)
    for seed in range(1, seeds + 1):
        rng = np.random.default_rng(seed)
        camera = bilsat_camera()
        control = scene_points(camera, n_control, relief_m, noise, rng)
        exact = Noise(noise.pixel, 0.0, noise.height_m)
        check = scene_points(camera, n_check, relief_m, exact, rng)
        usual = rng.normal(size=6) * np.array([100.0, 100.0, 100.0, 3.5e-4, 3.5e-4, 3.5e-4])
        error = usual if start_error is None else start_error(rng)
        axes = LocalFrame(*PLACE_DEG, 0.0).R_el
        start = _moved(camera, axes, error)
        for name in methods:
            begun = time.perf_counter()
            try:
                got = rectified(name, control, check.pixel, check.height_m, start, noise)
                own = rectified(name, control, control.pixel, control.height_m, start, noise)
            except ValueError:
                failed[name] += 1
                continue
            seconds[name].append(0.5 * (time.perf_counter() - begun))
            if not np.isfinite(got).all():
                failed[name] += 1
                continue
            square[name][0].append((got - check.map_m) ** 2)
            square[name][1].append((own - control.map_m)[~control.blunder] ** 2)
    out = {}
    for name in methods:
        both = [np.sqrt(np.concatenate(part).mean(axis=0)) if part else np.full(2, np.nan) for part in square[name]]
        time_s = float(np.median(seconds[name])) if seconds[name] else float("nan")
        out[name] = Compared(both[0], both[1], time_s, failed[name])
    return out
