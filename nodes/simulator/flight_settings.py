"""The settings of a simulated flight, as command line and configuration files name them, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.camera.line_camera import LineCamera
from ...solver.camera.sensors import with_pixels
from ...solver.navigation.inertial_data import MEMS, TACTICAL
from ...solver.simulation.error_models import ErrorModel
from ...solver.simulation.flight import FlightPlan
from ...solver.simulation.imagery import ImagingPlan, LineImager, imager_of
from ...solver.simulation.inertial_sensors import InertialPlan
from ...solver.simulation.misstated import World
from ...solver.simulation.real_motion import HIGH_ALTITUDE_ERRORS, RealMotion, control_for
from ...solver.simulation.scenario import ObservationPlan, Simulation, simulate, simulate_real_motion
from .. import convert
from ..errors import UserError, flag
from ..formats.named_camera import camera_named
from .motion_track import motion_of
from .world_settings import world_from

GRADES = {"tactical": TACTICAL, "mems": MEMS}
DEFAULT_SENSOR = "ads40"
#: When a simulated flight begins that nobody dates.
DEFAULT_EPOCH = "2026-05-01T10:00:00Z"
DEFAULT_EPOCH_NS = int(datetime.fromisoformat(DEFAULT_EPOCH).timestamp()) * convert.SECOND_NS
#: Of a real motion: height of the ground above the ellipsoid, and height above it from which camera and errors are
#: those of high altitude, m.
GROUND_M, HIGH_M = 200.0, 5000.0


@dataclass(frozen=True)
class Option:
    """A setting.

    Attributes
    ----------
    name : as in a configuration file; with dashes on the command line
    kind : int, float, str or bool (a flag)
    text : one line of help
    group : plan, motion, imagery, observations, errors, world, or general
    field : attribute of the plan, the error model or the observation plan it sets; empty if it is treated by itself
    count : how many values; 0 for any number
    """

    name: str
    kind: type
    text: str
    group: str
    field: str = ""
    count: int = 1


OPTIONS: tuple[Option, ...] = (
    Option("seed", int, "the same seed gives the same flight (default 1)", "general"),
    Option("seconds", float, "duration of a strip (default 60; of a real motion: all of it)", "general"),
    Option(
        "relief",
        float,
        "heights of the ground lie within +- this, m (default 75; real motion up to 150)",
        "general",
    ),
    Option(
        "sensor",
        str,
        "camera: a preset, or its camera.json (default ads40; real motion above 5 km: one for 20 km)",
        "general",
    ),
    Option("strips", int, "parallel strips", "plan", "strips"),
    Option("cross", int, "strips across them", "plan", "cross_strips"),
    Option("height", float, "above mean ground, m", "plan", "height_m"),
    Option("speed", float, "over ground, m/s", "plan", "speed_m_s"),
    Option("sidelap", float, "share of the swath that neighbours have in common", "plan", "sidelap"),
    Option("heading", float, "of the first strip, deg", "plan", "heading_deg"),
    Option("turbulence", float, "factor on the jitter of attitude and position", "plan", "turbulence"),
    Option("lead_in", float, "straight flight before the first strip, s", "plan", "lead_in_s"),
    Option("lead_out", float, "straight flight after the last one, s", "plan", "lead_out_s"),
    Option("no_turns", bool, "leave turns out: nothing is measured between two strips", "plan"),
    Option("unstabilised", bool, "no stabilised mount: 0.4 deg of jitter, not 0.05", "plan"),
    Option("imu", str, "give inertial data (tactical, mems) and GNSS velocities, not attitude", "plan"),
    Option("imu_rate", float, "inertial samples a second (default 200)", "plan"),
    Option(
        "motion",
        str,
        "any trajectory that `triline import` reads, or a recording: put the camera on this flight (above 5 km with a "
        "camera for 20 km, and errors of 8 8 12 m, 0.005 deg ...)",
        "motion",
    ),
    Option("from", float, "first second of it (default 0)", "motion"),
    Option("ground", float, "height of the ground under it above the ellipsoid, m (default 200)", "motion"),
    Option("as_sensors", bool, "give attitude and GNSS, not a degraded trajectory", "motion"),
    Option("images", bool, "render image lines; then no tie points are simulated unless --ties says so", "imagery"),
    Option("pixels", int, "of a CCD line, over the same field (line rate and ground sample follow)", "imagery"),
    Option("image_noise", float, "grey values, 1 sigma", "imagery", "noise"),
    Option("cars", float, "speed of cars on the roads, m/s, 0 for none", "imagery", "cars_m_s"),
    Option("clouds", float, "share of the view that clouds cover, 0 for a clear sky", "imagery", "clouds"),
    Option("ties", float, "new tie points a second", "observations", "tie_points_per_s"),
    Option("image_sigma", float, "noise of a line and of a sample, px", "observations", "image_sigma_px"),
    Option("outliers", float, "share of the tie rays that are blunders", "observations", "outlier_share"),
    Option("outlier_px", float, "least and largest blunder, px", "observations", "outlier_px", 2),
    Option("control", int, "control points (real motion: a pair a minute)", "observations", "control"),
    Option("control_sigma", float, "of control, X Y Z, m", "observations", "control_sigma_m", 3),
    Option("check", int, "check points", "observations", "check"),
    Option("offset", float, "constant position error, X Y Z, m", "errors", "offset_sigma_m", 3),
    Option("wander", float, "slow position error, X Y Z, m", "errors", "wander_sigma_m", 3),
    Option("shift", float, "constant attitude error, omega phi kappa, deg", "errors", "shift_sigma_deg", 3),
    Option("drift", float, "its change over a strip, deg", "errors", "drift_sigma_deg", 3),
    Option("wander_attitude", float, "slow attitude error, deg", "errors", "wander_sigma_deg", 3),
    Option("wander_time", float, "correlation time of the slow errors, s", "errors", "wander_time_s"),
    Option(
        "wander_attitude_time",
        float,
        "that of the slow attitude error; 0: the same",
        "errors",
        "attitude_wander_time_s",
    ),
    Option("noise", float, "white noise of positions, X Y Z, m", "errors", "gnss_noise_m", 3),
    Option("noise_attitude", float, "white noise of roll, pitch, heading, deg", "errors", "attitude_noise_deg", 3),
    Option("gnss_rate", float, "positions a second", "errors", "gnss_rate_hz"),
    Option("attitude_rate", float, "attitudes a second", "errors", "attitude_rate_hz"),
    Option("true", str, "an error that the flight has and nothing states; may be repeated", "world", count=0),
)
BY_NAME = {option.name: option for option in OPTIONS}
#: Setting -> the one without which it has no effect.
_GOES_WITH = {
    **dict.fromkeys(("image_noise", "cars", "clouds"), "images"),
    "imu_rate": "imu",
    "outlier_px": "outliers",
}
#: Setting -> those that have no effect beside it: an inertial unit measures no attitude, a real motion has its times.
_GOES_NOT_WITH = {"imu": ("attitude_rate", "noise_attitude"), "motion": ("gnss_rate", "attitude_rate")}
_DEFAULTS = {
    "plan": FlightPlan(),
    "observations": ObservationPlan(),
    "errors": ErrorModel(),
    "imagery": ImagingPlan(),
}


def default(option: Option) -> Any:
    """What a setting is where nothing is said; None for those that are treated by themselves."""
    return getattr(_DEFAULTS[option.group], option.field) if option.field else None


@dataclass(frozen=True)
class SimulatedFlight:
    """A simulation, when it begins (None: whenever its user wants), its real motion and its imagery, if any."""

    simulation: Simulation
    epoch_ns: int | None = None
    motion: RealMotion | None = None
    imager: LineImager | None = None


def simulated_flight(settings: Mapping[str, Any]) -> SimulatedFlight:
    """The flight of some settings; what is not there keeps its default.

    Raises
    ------
    UserError : a setting that is not known or cannot be
    """
    values = checked(settings)
    try:
        if values.get("images"):
            values.setdefault("ties", 0.0)
        flight = _real(values) if values.get("motion") else _planned(values)
        return replace(flight, imager=_imager(flight.simulation, values)) if values.get("images") else flight
    except ValueError as error:
        raise UserError(str(error)) from None


def checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the kinds that the settings have.

    Raises
    ------
    UserError : a setting that is not known, a value of another kind
    """
    return {name: _checked(name, value) for name, value in settings.items()}


def _refuse_without_effect(values: Mapping[str, Any]) -> None:
    """Raise UserError for a setting that changes nothing, given the others."""
    given = {name for name, value in values.items() if value is not False}
    for name, other in _GOES_WITH.items():
        if name in given and not values.get(other):
            raise UserError(f"simulation: {flag(name)} goes with {flag(other)}")
    for other, names in _GOES_NOT_WITH.items():
        for name in names:
            if name in given and values.get(other):
                raise UserError(f"simulation: {flag(name)} does not go with {flag(other)}")
    if "outliers" in given and not values.get("ties", default(BY_NAME["ties"])):
        raise UserError("simulation: --outliers goes with --ties above 0: blunders are those of simulated tie points")
    strips, cross = values.get("strips", 1), values.get("cross", 0)
    if "sidelap" in given and strips == 1:
        raise UserError("simulation: --sidelap goes with --strips, of at least 2")
    if "no_turns" in given and strips + cross == 1:
        raise UserError("simulation: --no-turns goes with --strips or --cross: a strip alone has no turns")


def _checked(name: str, value: Any) -> Any:
    """A value of the option's kind; numbers may come as text."""
    option = BY_NAME.get(name)
    if option is None:
        raise UserError(f"simulation: {name} is not known, wanted one of {', '.join(BY_NAME)}")
    if option.kind is bool:
        if not isinstance(value, bool):
            raise UserError(f"simulation: {name} is {value!r}, wanted true or false")
        return value
    if option.count == 0:
        return list(value) if isinstance(value, (list, tuple)) else [value]
    if option.count == 1 and isinstance(value, (list, tuple)):
        raise UserError(f"simulation: {name} is {value!r}, wanted one value")
    parts = list(value) if isinstance(value, (list, tuple)) else [value] * option.count
    try:
        numbers = tuple(option.kind(part) for part in parts)
    except (TypeError, ValueError):
        raise UserError(f"simulation: {name} is {value!r}, wanted {_wanted(option)}") from None
    if option.kind is float and not np.isfinite(numbers).all():
        raise UserError(f"simulation: {name} is {value!r}, wanted {_wanted(option)}")
    if len(numbers) != option.count:
        raise UserError(f"simulation: {name} has {len(numbers)} values, wanted {option.count}")
    return numbers if option.count > 1 else numbers[0]


def _wanted(option: Option) -> str:
    kind = {int: "a whole number", float: "a number", str: "a text"}[option.kind]
    return kind if option.count == 1 else f"{option.count} numbers"


def _fields(values: Mapping[str, Any], group: str) -> dict[str, Any]:
    return {o.field: values[o.name] for o in OPTIONS if o.group == group and o.field and o.name in values}


def _camera(values: Mapping[str, Any], sensor: str) -> LineCamera:
    camera = camera_named(values.get("sensor", sensor), "simulation: sensor")
    return with_pixels(camera, values["pixels"]) if "pixels" in values else camera


def _imager(simulation: Simulation, values: Mapping[str, Any]) -> LineImager:
    """Control and check points are signalised."""
    points = simulation.points
    plan = ImagingPlan(**_fields(values, "imagery"))
    return imager_of(simulation.seen_flight, values.get("seed", 1), points.xyz_l[points.role != "tie"], plan)


def _world(values: Mapping[str, Any]) -> World:
    """What is not stated; noise of image measurements wants simulated ones."""
    world = world_from(values.get("true", ()))
    if values.get("images") and not values.get("ties") and (world.heavy_tails or world.noise_factor != 1.0):
        raise UserError("simulation: true tie-noise is one of simulated tie points: with images it wants ties as well")
    return world


def _planned(values: Mapping[str, Any]) -> SimulatedFlight:
    for name, value in values.items():
        if BY_NAME[name].group == "motion" and name != "motion" and value is not False:
            raise UserError(f"simulation: {name.replace('_', '-')} belongs to a real motion, wanted motion as well")
    _refuse_without_effect(values)
    plan = _fields(values, "plan")
    for name, field in (("seconds", "strip_s"), ("relief", "relief_m")):
        if name in values:
            plan[field] = values[name]
    camera = _camera(values, DEFAULT_SENSOR)
    turns, stabilised = not values.get("no_turns", False), not values.get("unstabilised", False)
    inertial = None
    if "imu" in values:
        if values["imu"] not in GRADES:
            raise UserError(f"simulation: imu is {values['imu']!r}, wanted one of {', '.join(GRADES)}")
        inertial = InertialPlan(GRADES[values["imu"]], values.get("imu_rate", 200.0))
    simulation = simulate(
        FlightPlan(camera=camera, turns=turns, stabilised=stabilised, **plan),
        values.get("seed", 1),
        replace(ErrorModel(), **_fields(values, "errors")),
        ObservationPlan(**_fields(values, "observations")),
        inertial=inertial,
        world=_world(values),
    )
    return SimulatedFlight(simulation)


def _real(values: Mapping[str, Any]) -> SimulatedFlight:
    for name in values:
        if BY_NAME[name].group == "plan" and values[name] is not False:
            raise UserError(f"simulation: {name.replace('_', '-')} belongs to a planned flight, not to a real motion")
    _refuse_without_effect(values)
    if "pixels" in values and "sensor" not in values:
        raise UserError("simulation: pixels of a real motion's camera wants a sensor as well")
    start, duration = values.get("from", 0.0), values.get("seconds")
    ground = values.get("ground", GROUND_M)
    motion, epoch_ns = motion_of(Path(values["motion"]), ground, start, duration)
    above = float(np.median(motion.trajectory.position_l[:, 2]))
    if not above > 0:
        raise UserError(f"simulation: the motion lies {-above:.0f} m below the ground at {ground:g} m, wanted ground")
    high = above > HIGH_M
    observed: dict[str, Any] = {"control": control_for(motion.trajectory.end_s)}
    observed.update(_fields(values, "observations"))
    simulation = simulate_real_motion(
        motion,
        values.get("seed", 1),
        replace(HIGH_ALTITUDE_ERRORS if high else ErrorModel(), **_fields(values, "errors")),
        ObservationPlan(**observed),
        camera=None if high and "sensor" not in values else _camera(values, DEFAULT_SENSOR),
        relief_m=values.get("relief", min(150.0, 0.1 * above)),
        as_sensors=values.get("as_sensors", False),
        world=_world(values),
    )
    return SimulatedFlight(simulation, epoch_ns, motion)


def shown_default(option: Option) -> str:
    """The default as help texts show it, empty where the help says it itself."""
    value = default(option)
    return "" if value is None else " ".join(f"{v:g}" for v in np.atleast_1d(value))
