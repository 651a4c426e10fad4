"""Aerial testfields of the dissertation, simulated: sensors, heights, strips, points, a-priori sigmas [K ch. 5].

What the publication does not give is assumed and said here: where the points lie (at random over the block), the
relief, how the strips of Pavia are arranged, and what is wrong with camera and trajectory. Trajectory errors are drawn
from the a-priori sigmas of the tables unless said otherwise; the image noise is the published sigma0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.job import Job
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration, tls
from ..camera.sensors import preset
from ..models.base import ModelOptions
from ..models.dgr import DgrOptions
from ..models.lim import LimOptions
from .network import FlightLine, Noise, SimulatedNetwork, parallel_and_cross, scatter_points, simulate_network

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Published:
    """Figures of the publication, metres; NaN where it gives none.

    Attributes
    ----------
    rmse_xy, rmse_z : of check points
    sigma_xy, sigma_z : theoretical
    sigma0_px : range of sigma0
    """

    rmse_xy: float
    rmse_z: float
    sigma_xy: float = np.nan
    sigma_z: float = np.nan
    sigma0_px: tuple[float, float] = (np.nan, np.nan)


@dataclass(frozen=True)
class Configuration:
    """One adjustment of a testfield.

    Attributes
    ----------
    label : "DGR SC", "LIM-45"
    control : number of control points; the other signalised points are check points
    job : what is done; None for direct georeferencing alone
    published : beside what
    reason : why ours differs, one line
    """

    label: str
    control: int
    job: Job | None
    published: Published
    reason: str


@dataclass(frozen=True)
class Testfield:
    """A block and what is adjusted on it.

    Attributes
    ----------
    name, key : in full, and for the command line
    gsd_m : ground sample distance
    signalised, tie : numbers of points
    extent_m : of the block along and across
    relief_m : amplitude of the ground
    noise : image, control, and trajectory errors beside those of `errors`
    errors : model whose a-priori sigmas the trajectory errors are drawn with
    camera : as calibrated
    calibration : additional parameters of the true camera, and `camera_errors` their values
    lines : what is flown
    configurations : what is adjusted
    """

    name: str
    key: str
    gsd_m: float
    signalised: int
    tie: int
    extent_m: tuple[float, float]
    relief_m: float
    noise: Noise
    errors: ModelOptions
    camera: LineCamera
    calibration: SelfCalibration
    camera_errors: dict[str, float]
    lines: tuple[FlightLine, ...]
    configurations: tuple[Configuration, ...]

    def simulate(self, rng: np.random.Generator) -> SimulatedNetwork:
        """The testfield measured once; every signalised point is a check point with its true coordinates."""
        a, b = self.extent_m[0] / 2, self.extent_m[1] / 2
        wave = max(self.extent_m) / 8

        def relief(x: Array, y: Array) -> Array:
            return self.relief_m * np.sin(x / wave) * np.cos(0.7 * y / wave)

        signalised = scatter_points(self.signalised, (-0.95 * a, 0.95 * a, -0.95 * b, 0.95 * b), relief, rng)
        points = np.concatenate([signalised, scatter_points(self.tie, (-a, a, -b, b), relief, rng)])
        check = np.arange(self.signalised)
        return simulate_network(
            self.camera, self.lines, points, {}, check, self.errors, rng, self.noise, self.calibration,
            self.camera_errors, pose_rate_hz=50.0,
        )  # fmt: skip


def _dgr(position: tuple[float, float], shift: tuple[float, float], drift: tuple[float, float]) -> DgrOptions:
    """DGR with sigmas as the tables give them: X and Y, Z; omega and phi, kappa (degrees)."""
    x, z = position
    return DgrOptions((x, x, z), (shift[0], shift[0], shift[1]), (drift[0], drift[0], drift[1]))


#: What is wrong with an aerial camera: about half a pixel to a pixel each.
_AERIAL_ERRORS = {"xp_F": 0.004, "yp_F": -0.003, "xp_B": -0.003, "sy_F": 5e-5, "k1": 3e-7}


def vaihingen() -> Testfield:
    """ADS40 Vaihingen/Enz [K 5.2.1.1]: 6 strips (here 4 and 2 across), 201 points, all signalised; Table 5.11."""
    camera = preset("ads40")
    model = _dgr((0.11, 0.20), (0.004, 0.008), (0.004, 0.008))
    parameters = tls(camera)
    calibrated = Job(model, self_calibration=parameters)
    smaller = {name: 0.4 * value for name, value in _AERIAL_ERRORS.items()}
    return Testfield(
        "ADS40 Vaihingen/Enz, 1500 m above ground", "vaihingen", 0.156, 201, 0, (7500.0, 4800.0), 60.0,
        Noise(0.18, (0.02, 0.02, 0.02), jitter_deg=0.05), model, camera, parameters, smaller,
        parallel_and_cross(camera, 1505.0, 4, 2, 7500.0, sidelap=0.46),
        (
            Configuration("direct georeferencing", 0, None, Published(0.125, 0.18),
                          "camera errors as assumed here, unknown to the sigma"),
            Configuration("DGR", 4, Job(model), Published(0.048, 0.064),
                          "camera errors as assumed here, unknown to the sigma"),
            Configuration("DGR SC", 4, calibrated, Published(0.033, 0.058, sigma0_px=(0.18, 0.18)),
                          "published: errors of check points and of point definition; simulation has 2 cm and none"),
            Configuration("LIM-8 SC", 12, replace(calibrated, then=_lim(8, (0.03, 0.03), 0.001)),
                          Published(np.nan, np.nan, sigma0_px=(0.18, 0.18)), "no RMSE published as a number"),
        ),
    )  # fmt: skip


def _lim(fixes: int, position: tuple[float, float], shift: float) -> LimOptions:
    return LimOptions(fixes, True, (position[0], position[0], position[1]), (shift, shift, shift))


def pavia(height_m: float) -> Testfield:
    """ADS40 Pavia [K 5.2.1.2], 2000 or 4000 m: 897 points with 46 or 50 signalised; Table 5.13.

    Seven strips at three heights are published, not which: here 3 and 1 across at 2000 m, 2 at 4000 m.
    """
    camera = preset("ads40-pavia")
    model = _dgr((0.10, 0.20), (0.0054, 0.0081), (0.0054, 0.0081))
    parameters = tls(camera)
    low = height_m < 3000
    above = 0.20 / 0.0065 * 62.77 if low else 0.39 / 0.0065 * 62.77
    gsd, signalised, sigma0 = (0.20, 46, 0.43) if low else (0.39, 50, 0.48)
    lines = parallel_and_cross(camera, above, 3 if low else 2, 1 if low else 0, 6500.0, sidelap=0.35 if low else 0.5)
    noise = Noise(sigma0, (0.015, 0.015, 0.02), jitter_deg=0.05)
    if low:
        direct, calibrated = Published(0.110, 0.65, 0.10, 0.22), Published(0.04, 0.05, sigma0_px=(0.38, 0.48))
        control, mean = 12, "-0.57 m"
    else:
        direct, calibrated = Published(0.462, 1.79, 0.166, 0.39), Published(0.08, 0.12, sigma0_px=(0.44, 0.52))
        control, mean = 5, "-1.78 m"
    return Testfield(
        f"ADS40 Pavia, {height_m:.0f} m", "pavia2000" if low else "pavia4000", gsd, signalised, 897 - signalised,
        (6500.0, 5500.0), 30.0, noise, model, camera, parameters, _AERIAL_ERRORS, lines,
        (
            Configuration("direct georeferencing", 0, None, direct,
                          f"camera errors, published (mean Z {mean}) and assumed here; the sigma does not know them"),
            Configuration("DGR SC", control, Job(model, self_calibration=parameters), calibrated,
                          "strips as assumed here; signalised points are measured better than sigma0 of all says"),
        ),
    )  # fmt: skip


def yoriichio_si290() -> Testfield:
    """SI-290 Yoriichio [K 5.1.1.1]: 2 parallel and 2 cross strips, 39 GCP, 550 tie points; Table 5.3.

    The trajectory has, beside DGR errors, a wander that only the LIM can follow. Its size, which is not published, is
    chosen so that DGR comes out as published; the LIM's figures then follow.
    """
    camera = preset("si-290")
    model = _dgr((20.0, 5.0), (0.2, 3.0), (0.2, 0.2))
    actual = _dgr((10.0, 5.0), (0.15, 1.0), (0.1, 0.2))
    noise = Noise(1.0, (0.03, 0.03, 0.03), jitter_deg=0.02, wander_m=0.28, wander_deg=0.011)
    lim = _lim(45, (2.0, 2.0), 0.1)
    return Testfield(
        "SI-290 Yoriichio, 1800 m", "si290", 0.10, 39, 550, (8500.0, 2300.0), 60.0, noise, actual, camera, tls(camera),
        {}, parallel_and_cross(camera, 1800.0, 2, 2, 8500.0, speed_m_s=50.0, sidelap=0.3),
        (
            Configuration("DGR", 20, Job(model, reweight=True), Published(0.33, 0.58, 0.19, 0.61),
                          "wander of the trajectory chosen for this row"),
            Configuration("LIM-45", 20, Job(model, lim, reweight=True),
                          Published(0.12, 0.21, 0.08, 0.28, (1.0, 1.0)),
                          "control of poor image quality (1-2 px) in the publication, 1 px here"),
        ),
    )  # fmt: skip


def yoriichio_si100() -> Testfield:
    """SI-100 Yoriichio [K 5.1.1.2]: 3 strips, 61 GCP, 182 tie points; Table 5.8."""
    camera = preset("si-100")
    model = _dgr((1.2, 1.0), (0.1, 0.1), (0.05, 0.05))
    parameters = tls(camera)
    noise = Noise(1.0, (0.03, 0.03, 0.03), jitter_deg=0.02, wander_m=0.1, wander_deg=0.005)
    job = Job(model, _lim(30, (1.2, 1.0), 0.1), parameters, reweight=True)
    return Testfield(
        "SI-100 Yoriichio, 600 m", "si100", 0.07, 61, 182, (10000.0, 1300.0), 25.0, noise, model, camera, parameters,
        _AERIAL_ERRORS, parallel_and_cross(camera, 600.0, 3, 0, 10000.0, speed_m_s=35.0, sidelap=0.5),
        (
            Configuration("LIM-30 SC", 30, job, Published(0.07, 0.14, sigma0_px=(1.0, 1.0)),
                          "wander of the trajectory as assumed here; what 30 fixes cannot follow stays in the points"),
        ),
    )  # fmt: skip


#: Testfields by key, made when they are asked for.
TESTFIELDS: dict[str, Callable[[], Testfield]] = {
    "vaihingen": vaihingen,
    "pavia2000": lambda: pavia(2000.0),
    "pavia4000": lambda: pavia(4000.0),
    "si290": yoriichio_si290,
    "si100": yoriichio_si100,
}
