"""Parameters of a frame image, interior and exterior, and their estimation from control by the mixed model.

The ground coordinates of a control point are a function of its pixel, its height and the parameters [D 5.20]. Pixel and
height are observed with random errors, so every condition holds observations and parameters (Gauss-Helmert).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimation.mixed_model import MixedModel, MixedSolution, estimate
from ..geometry.ellipsoid import WGS84
from ..geometry.frames import LocalFrame
from ..geometry.rotation import angles_from_matrix, angles_jacobian, matrix_from_angles
from ..location.frame_camera import FrameCamera
from .sampled import metres_a_radian

Array = NDArray[np.floating]

#: Parameter -> sigma of what is known of it beforehand: mm, mm^-2 .. mm^-1, rad, m.
PRIOR = {
    "f": 0.1, "dx": 0.05, "dy": 0.05, "c": 1e-5, "k1": 1e-5, "k2": 1e-7, "p1": 1e-5, "p2": 1e-5, "omega": 3.5e-4,
    "phi": 3.5e-4, "kappa": 3.5e-4, "X": 100.0, "Y": 100.0, "Z": 100.0,
}  # fmt: skip
#: Those of the second set; latitude and longitude stand for X and Y, in radians.
TWELVE = ("f", "dx", "dy", "k1", "k2", "p1", "p2", "omega", "phi", "kappa", "lat", "lon")
#: The second set with the height of the perspective centre above the ellipsoid, which from an aircraft is no small part
#: of the scale; for images whose metadata state how well all of their place is known.
THIRTEEN = (*TWELVE, "h")
_PRIOR_PLACE = {"lat": 100.0 / 6.37e6, "lon": 100.0 / 6.37e6, "h": 100.0}
#: Units of the parameters.
UNITS = {
    "f": "mm", "dx": "mm", "dy": "mm", "c": "mm", "k1": "mm^-2", "k2": "mm^-4", "p1": "mm^-1", "p2": "mm^-1",
    "omega": "rad", "phi": "rad", "kappa": "rad", "X": "m", "Y": "m", "Z": "m", "lat": "rad", "lon": "rad", "h": "m",
}  # fmt: skip
#: Size of a change of a parameter, in its sigmas, from which the steps of derivatives follow. Derived: 1e-5 of it moves
#: the ground by much more than rounding, and by much less than it bends.
_SCALE = 1e3
#: Derived: places are known to a nanometre beside the radius of the Earth, which leaves 3e-8 of a sigma.
_LAST_STEP = 1e-6
_NOTHING_FITS = "no camera fits the points"


def names_of(parameters: int) -> tuple[str, ...]:
    """Names of 14 or 12 parameters.

    Raises
    ------
    ValueError : another number
    """
    if parameters not in (14, 12):
        raise ValueError(f"{parameters} parameters, wanted 14 or 12")
    return tuple(PRIOR) if parameters == 14 else TWELVE


def prior_sigmas(parameters: int) -> Array:
    """(d,) of the parameters."""
    return _priors(names_of(parameters))


def _priors(names: tuple[str, ...]) -> Array:
    return np.array([(PRIOR | _PRIOR_PLACE)[name] for name in names])


def stated_priors(camera: FrameCamera, position_m: ArrayLike, attitude_rad: ArrayLike) -> Array:
    """(13,) sigmas of `THIRTEEN`, those of place and attitude as they are stated.

    Parameters
    ----------
    position_m, attitude_rad : (3,) east, north, up, and of small turns about them; where one is 0 nothing is stated
    """
    lat, lon, h = camera.ellipsoid.geodetic(camera.position_e)
    east, north = metres_a_radian(lat, h, camera.ellipsoid)
    R_el = LocalFrame(float(np.degrees(lat)), float(np.degrees(lon)), 0.0).R_el
    by_turn = angles_jacobian(angles_from_matrix(R_el.T @ camera.R_ec))
    angles = np.sqrt(np.square(by_turn) @ np.square(attitude_rad))
    position = np.asarray(position_m, dtype=float)[[1, 0, 2]] / [north, east, 1.0]
    names = ("omega", "phi", "kappa", "lat", "lon", "h")
    stated: dict[str, float] = dict(zip(names, [*angles, *position], strict=True))
    usual = _priors(THIRTEEN)
    sigma = np.array([stated.get(name, 0.0) for name in THIRTEEN])
    return np.where(sigma > 0, sigma, usual)


def changed(camera: FrameCamera, changes: Mapping[str, float]) -> FrameCamera:
    """The camera with parameters changed.

    Parameters
    ----------
    changes : change of each parameter by its name, one of `PRIOR` or `THIRTEEN`, or ``k3``; angles are those in the
        local frame at the place of ``camera``

    Raises
    ------
    KeyError : another name
    """
    by = dict.fromkeys((*PRIOR, *_PRIOR_PLACE, "k3"), 0.0)
    if not changes.keys() <= by.keys():
        raise KeyError(f"{min(changes.keys() - by.keys())} is no parameter of a frame camera")
    by |= changes
    C, R = camera.position_e, camera.R_ec
    if any(by[name] for name in ("omega", "phi", "kappa", "lat", "lon", "h")):
        lat, lon, h = WGS84.geodetic(C)
        R_el = LocalFrame(float(np.degrees(lat)), float(np.degrees(lon)), 0.0).R_el
        if by["omega"] or by["phi"] or by["kappa"]:
            R = R_el @ matrix_from_angles(
                *(angles_from_matrix(R_el.T @ R) + np.array([by["omega"], by["phi"], by["kappa"]]))
            )
        if by["lat"] or by["lon"] or by["h"]:
            C = WGS84.cartesian(lat + by["lat"], lon + by["lon"], h + by["h"])
    lens = [by[name] for name in ("k1", "k2", "k3", "p1", "p2")]
    return FrameCamera(
        C + np.array([by["X"], by["Y"], by["Z"]]), R, camera.focal_length_mm + by["f"], camera.pixel_mm + by["c"],
        camera.lines, camera.samples, principal_point_mm=camera.principal_point_mm + np.array([by["dx"], by["dy"]]),
        distortion=camera.distortion + np.array(lens), ellipsoid=camera.ellipsoid, refraction=camera.refraction,
    )  # fmt: skip


@dataclass(frozen=True)
class FrameFit:
    """A frame camera as control has it.

    Attributes
    ----------
    camera : with the estimated parameters
    names : of the parameters
    prior_sigma : of the parameters, as they were known beforehand
    found : parameters (changes against the start); corrections of line, sample (pixels), height, east and north
        (metres) with their sigmas, and two columns of zeros; points that the outlier test left out
    """

    camera: FrameCamera
    names: tuple[str, ...]
    prior_sigma: Array
    found: MixedSolution

    @property
    def w(self) -> Array:
        """Changes of the parameters over their sigmas, by what was known beforehand; 0 where nothing was."""
        spread = np.sqrt(np.maximum(self.prior_sigma**2 - self.found.sigma**2, 0.0))
        known = np.isfinite(spread) & (spread > 1e-6 * self.prior_sigma)
        return np.where(known, self.found.parameters / np.where(known, spread, 1.0), 0.0)


@dataclass(frozen=True)
class FrameControl:
    """Control points of a frame image; m of them.

    Attributes
    ----------
    line, sample : (m,) as measured, pixels
    lat, lon : (m,) radians
    height_m : (m,) above the ellipsoid
    """

    line: Array
    sample: Array
    lat: Array
    lon: Array
    height_m: Array


def fit_frame(
    camera: FrameCamera,
    control: FrameControl,
    names: tuple[str, ...],
    *,
    pixel_sigma: float,
    height_sigma_m: float,
    ground_sigma_m: float,
    prior_sigma: ArrayLike,
    constraints: Mapping[str, float] | None = None,
    snoop: bool = True,
) -> FrameFit:
    """Estimate parameters of a frame camera from control with errors in pixel, height and ground coordinates.

    Parameters
    ----------
    camera : to start from; its values are what is known beforehand
    names : of the parameters, see `names_of` and `THIRTEEN`
    pixel_sigma, height_sigma_m, ground_sigma_m : of the observations
    prior_sigma : (d,) of what is known beforehand, infinite where nothing is
    constraints : parameter -> change that it has to have
    snoop : leave out points with corrections that are too large

    Raises
    ------
    ValueError : too few points, parameters that are not determined, no convergence, a point without ground
    """
    seen = np.isfinite(camera.direct(control.line, control.sample, control.height_m)).all(axis=1)
    if not seen.all():
        raise ValueError(f"control point {int(np.argmin(seen))} (counted from 0): its pixel sees no ground")
    prior = np.asarray(prior_sigma, dtype=float)

    def conditions(beta: Array, observed: Array) -> Array:
        changes = dict(zip(names, beta.tolist(), strict=True))
        line, sample, height, e, n, lat, lon = observed.T
        if camera.focal_length_mm + changes.get("f", 0.0) <= 0.0:
            raise ValueError(_NOTHING_FITS)
        other = changed(camera, changes)
        located = other.direct(line, sample, height)
        if not np.isfinite(located).all():
            raise ValueError(_NOTHING_FITS)
        east, north = metres_a_radian(lat, height, other.ellipsoid)
        return np.column_stack([(located[:, 1] - lon) * east - e, (located[:, 0] - lat) * north - n])

    held = constraints or {}
    matrix = np.array([[float(name == wanted) for name in names] for wanted in held])
    zero = np.zeros(len(control.line))
    model = MixedModel(
        conditions,
        np.column_stack([control.line, control.sample, control.height_m, zero, zero, control.lat, control.lon]),
        [pixel_sigma, pixel_sigma, height_sigma_m, ground_sigma_m, ground_sigma_m, 0.0, 0.0],
        np.zeros(len(names)),
        np.where(np.isfinite(prior), _SCALE * prior, 1.0),
        matrix if held else None,
        list(held.values()) if held else None,
        np.zeros(len(names)),
        prior,
        _LAST_STEP,
    )
    found = estimate(model, snoop)
    return FrameFit(changed(camera, dict(zip(names, found.parameters.tolist(), strict=True))), names, prior, found)
