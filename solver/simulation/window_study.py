"""A simulated flight through filter and window, without messages: for studies, benchmarks and tests of consistency."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from numpy.typing import NDArray

from ..adjustment.surface_control import SurfaceControl
from ..camera.self_calibration import SelfCalibration
from ..geometry.space_intersection import ImageRays, intersect
from ..geometry.trajectory import Trajectory
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from ..models.slow_errors import SlowErrors
from ..navigation.kinematic import KinematicFilter
from ..navigation.kinematic_model import KinematicOptions
from ..navigation.pose import NavigationPose
from ..window.output import WindowReport, WindowUpdate
from ..window.results import AdjustedPoint, Look, RefinedOrientation, Refusal, WindowOptions
from ..window.window import Window
from .error_models import ErrorModel
from .scenario import Simulation

Array = NDArray[np.floating]

Event = NavigationPose | Callable[[Window], None]

#: Platform time between updates, s.
UPDATE_S = 0.2
#: Longer than any flight.
NEVER_S = 1e6


def slow_errors_of(errors: ErrorModel) -> SlowErrors:
    """What an estimator is told of the slow errors that a simulator draws."""

    def rad(values: tuple[float, float, float]) -> tuple[float, float, float]:
        a, b, c = np.radians(values).tolist()
        return (a, b, c)

    return SlowErrors(
        errors.offset_sigma_m,
        rad(errors.shift_sigma_deg),
        rad(errors.drift_sigma_deg),
        errors.wander_sigma_m,
        rad(errors.wander_sigma_deg),
        errors.wander_time_s,
        errors.attitude_wander_time_s,
    )


@dataclass(frozen=True)
class TimedPose:
    """A pose and when it became known."""

    known_s: float
    pose: NavigationPose


def navigate(simulation: Simulation, options: KinematicOptions | None = None) -> list[TimedPose]:
    """All poses of the kinematic filter over a simulated flight, in the order they become known."""
    slow = slow_errors_of(simulation.errors)
    options = options or KinematicOptions(
        lever_arm_b=np.array(simulation.mounting.lever_arm_m),
        R_bc=simulation.mounting.R_bc,
        offset_sigma_m=np.array(slow.offset_m),
        wander_sigma_m=np.array(slow.wander_m),
        wander_time_s=slow.wander_time_s,
        attitude_sigma=slow.attitude_sigma,
    )
    engine = KinematicFilter(simulation.flight.frame, options)
    attitude_cov = np.diag(np.square(np.radians(simulation.errors.attitude_noise_deg)))
    gnss_cov = np.diag(np.square(simulation.errors.gnss_noise_m))
    antenna = simulation.flight.frame.from_geodetic(*simulation.gnss_geodetic.T)
    samples = [(float(t), 0, i) for i, t in enumerate(simulation.attitude_time_s)]
    samples += [(float(t), 1, i) for i, t in enumerate(simulation.gnss_time_s)]
    result: list[TimedPose] = []
    time = 0.0
    for time, is_fix, i in sorted(samples):
        if is_fix:
            poses = engine.add_gnss(time, antenna[i], gnss_cov)
        else:
            poses = engine.add_attitude(time, simulation.attitude_rpy[i], attitude_cov)
        result += [TimedPose(time, p) for p in poses]
    return result + [TimedPose(time, p) for p in engine.finish()]


@dataclass
class OnlineResult:
    """What came out of a flight.

    Attributes
    ----------
    live, final, whole : orientation, in the order of publication; the last from the backward pass, the newest of each
        time
    events : what the window said
    live_points, final_points, whole_points : by name; the first answer, the last, that of the backward pass
    final_known_s, points_known_s : when each of `final`, and each point last, became final
    update_s : processor time of each update
    window : as it was at the end
    """

    live: list[RefinedOrientation] = field(default_factory=list)
    final: list[RefinedOrientation] = field(default_factory=list)
    whole: list[RefinedOrientation] = field(default_factory=list)
    live_points: dict[str, AdjustedPoint] = field(default_factory=dict)
    final_points: dict[str, AdjustedPoint] = field(default_factory=dict)
    whole_points: dict[str, AdjustedPoint] = field(default_factory=dict)
    final_known_s: list[float] = field(default_factory=list)
    points_known_s: dict[str, float] = field(default_factory=dict)
    refused: list[Refusal] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    reports: list[WindowReport] = field(default_factory=list)
    update_s: list[float] = field(default_factory=list)
    window: Window | None = None


def adjust_online(
    simulation: Simulation,
    poses: Iterable[TimedPose],
    options: WindowOptions | None = None,
    self_calibration: SelfCalibration | None = None,
    live: bool = True,
    watch: Callable[[float, Window], None] | None = None,
    update_s: float = UPDATE_S,
    so_far: Callable[[float, OnlineResult], None] | None = None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
    surface: SurfaceControl | None = None,
) -> OnlineResult:
    """Fly a simulation through the window as an on-line system would.

    Parameters
    ----------
    live : whether the live orientation is asked for on the grid
    watch : called after every update with time and window
    update_s : platform time between updates
    so_far : called after every update with time and what has come out so far
    platform : constant errors of the platform that are unknowns
    surface : on which tie points lie
    """
    slow = slow_errors_of(simulation.errors)
    window = _window(simulation, options or WindowOptions(), self_calibration, platform, surface)
    events = _events(simulation, poses)
    result = OnlineResult(window=window)
    now, waiting = update_s, {False: [], True: []}
    for time, _, what in events:
        while time > now:
            _update(window, waiting, slow, now, result, update_s if live else 0.0)
            if watch is not None:
                watch(now, window)
            if so_far is not None:
                so_far(now, result)
            now = round(now + update_s, 9)
        if isinstance(what, NavigationPose):
            waiting[what.smoothed].append(what)
        else:
            what(window)
    _update(window, waiting, slow, now, result, update_s if live else 0.0)
    _collect(window.finish(), result, now)
    return result


def adjust_at_once(
    simulation: Simulation,
    poses: Iterable[TimedPose],
    options: WindowOptions | None = None,
    self_calibration: SelfCalibration | None = None,
    until_s: float = np.inf,
    surface: SurfaceControl | None = None,
) -> OnlineResult:
    """The batch adjustment of what was known at a time: one update with all of it, nothing let go before.

    Without a time, everything is made final at the end: the batch adjustment of the whole flight.
    """
    slow = slow_errors_of(simulation.errors)
    options = replace(options or WindowOptions(), window_s=NEVER_S, settle_s=NEVER_S)
    window = _window(simulation, options, self_calibration, surface=surface)
    waiting: dict[bool, list[NavigationPose]] = {False: [], True: []}
    result = OnlineResult(window=window)
    now = 0.0
    for time, _, what in _events(simulation, poses):
        if time > until_s:
            break
        now = time
        if isinstance(what, NavigationPose):
            waiting[what.smoothed].append(what)
        else:
            what(window)
    _update(window, waiting, slow, now, result, 0.0)
    if until_s == np.inf:
        _collect(window.finish(), result, now)
    return result


def _window(
    simulation: Simulation,
    options: WindowOptions,
    self_calibration: SelfCalibration | None,
    platform: PlatformErrors = NO_PLATFORM_ERRORS,
    surface: SurfaceControl | None = None,
) -> Window:
    """A window that knows the control points."""
    slow = slow_errors_of(simulation.errors)
    window = Window(simulation.flight.camera, slow, options, self_calibration, platform, surface=surface)
    for i, role in enumerate(simulation.points.role):
        if role != "tie":
            given = simulation.observation_plan.control_sigma_m
            sigma = np.array(given) if role == "control" else np.full(3, np.inf)
            window.add_control(str(simulation.points.id[i]), simulation.surveyed_l[i], sigma, str(role))
    return window


def _events(simulation: Simulation, poses: Iterable[TimedPose]) -> list[tuple[float, int, Event]]:
    """Poses, strips and points with the times they become known, in order."""
    flight, images = simulation.flight, simulation.images
    looks = images.looks
    events: list[tuple[float, int, Event]] = [(p.known_s, 1, p.pose) for p in poses]
    delay = simulation.observation_plan.matching_delay_s
    for strip in flight.strips:
        args = strip.id, strip.first_line_time_s, strip.line_rate_hz, strip.lines
        events.append((strip.first_line_time_s, 0, lambda w, args=args: w.begin_strip(*args)))
        end = float(strip.time_of(strip.lines - 1)) + delay + 0.05
        events.append((end, 3, lambda w, args=args: w.end_strip(args[0], args[3])))
    sigma = simulation.observation_plan.image_sigma_px
    ids = [line.id for line in flight.camera.lines]
    groups = np.split(np.arange(len(looks)), np.flatnonzero(np.diff(looks.point) | np.diff(looks.strip)) + 1)
    for mine in groups if len(looks) else ():
        name = str(simulation.points.id[looks.point[mine[0]]])
        of_point = [
            Look(
                flight.strips[looks.strip[j]].id, ids[looks.ccd[j]],
                float(images.line[j]), float(images.sample[j]), sigma, sigma,
            )
            for j in mine
        ]  # fmt: skip

        def add(window: Window, name: str = name, of_point: list[Look] = of_point) -> None:
            for look in of_point:
                window.add_look(name, look)

        events.append((float(looks.time_s[mine].max()) + delay, 2, add))
    return sorted(events, key=lambda e: e[:2])


def _update(
    window: Window,
    waiting: dict[bool, list[NavigationPose]],
    slow: SlowErrors,
    now: float,
    result: OnlineResult,
    live_s: float,
) -> None:
    for smoothed, poses in waiting.items():
        if poses:
            covariance = slow.without(np.array([p.covariance for p in poses]))
            window.trajectory.add(
                [p.time_s for p in poses],
                np.array([p.position_l for p in poses]),
                np.array([p.quaternion for p in poses]),
                covariance,
                smoothed,
                poses[-1].noise_time_s,
            )
            poses.clear()
    begun = process_time()
    update = window.update(now)
    result.update_s.append(process_time() - begun)
    _collect(update, result, now)
    for time in window.options.grid(now - live_s + 1e-6, now + 1e-6) if live_s else ():
        orientation = window.live(float(time))
        if orientation is not None:
            result.live.append(orientation)


def _collect(update: WindowUpdate, result: OnlineResult, now: float) -> None:
    result.final += update.final
    result.final_known_s += [now] * len(update.final)
    result.refused += update.refused
    result.events += update.warnings + update.events
    if update.whole is not None:
        again = {(o.strip, float(o.time_s[0])) for o in update.whole.orientation}
        result.whole = [o for o in result.whole if (o.strip, float(o.time_s[0])) not in again]
        result.whole += update.whole.orientation
        result.whole_points |= {p.name: p for p in update.whole.points}
    for point in update.points:
        if point.final:
            result.final_points[point.name] = point
            result.points_known_s[point.name] = now
        else:
            result.live_points.setdefault(point.name, point)
    if update.report is not None:
        result.reports.append(update.report)


@dataclass(frozen=True)
class Errors:
    """Errors against the truth with their covariance: (n, k) and (n, k, k), at times (n,) for orientation."""

    error: Array
    covariance: Array
    time_s: Array

    @property
    def rmse(self) -> Array:
        """(k,)"""
        return np.sqrt(np.mean(self.error**2, axis=0))

    @property
    def nees(self) -> Array:
        """(n,) normalised error squared, 1 on average where errors and covariance agree."""
        solved = np.linalg.solve(self.covariance, self.error[:, :, None])[:, :, 0]
        return np.einsum("nk,nk->n", self.error, solved) / self.error.shape[1]


def orientation_errors(simulation: Simulation, orientations: list[RefinedOrientation]) -> Errors:
    """Errors of refined orientation."""
    time = np.concatenate([o.time_s for o in orientations])
    truth = simulation.flight.truth.at(time)
    turn = np.concatenate([o.angles for o in orientations]) - truth.angles
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    error = np.hstack([np.concatenate([o.position_l for o in orientations]) - truth.position_l, turn])
    return Errors(error, np.concatenate([o.covariance for o in orientations]), time)


def measured_errors(simulation: Simulation, poses: Iterable[TimedPose], smoothed: bool) -> Errors:
    """Errors of the measured trajectory over the strips."""
    strips = simulation.flight.strip_times_s
    chosen = [p.pose for p in poses if p.pose.smoothed == smoothed]
    time = np.array([p.time_s for p in chosen])
    inside = np.flatnonzero(((time[:, None] >= strips[:, 0]) & (time[:, None] <= strips[:, 1])).any(axis=1))
    truth = simulation.flight.truth.at(time[inside])
    turn = np.array([chosen[i].angles for i in inside]) - truth.angles
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    error = np.hstack([np.array([chosen[i].position_l for i in inside]) - truth.position_l, turn])
    return Errors(error, np.array([chosen[i].covariance for i in inside]), time[inside])


def point_errors(
    simulation: Simulation, points: dict[str, AdjustedPoint], roles: tuple[str, ...] = ("tie", "check"), rays: int = 2
) -> Errors:
    """Errors of object points with at least so many rays."""
    place = {str(id): i for i, id in enumerate(simulation.points.id)}
    chosen = [p for p in points.values() if p.role in roles and p.rays >= rays]
    error = np.array([p.xyz_l - simulation.points.xyz_l[place[p.name]] for p in chosen]).reshape(-1, 3)
    covariance = np.array([p.covariance for p in chosen]).reshape(-1, 3, 3)
    return Errors(error, covariance, np.zeros(len(chosen)))


def rays_of(simulation: Simulation, orientation: Trajectory) -> ImageRays:
    """All looks of a flight with an orientation: as it was measured, or the true one."""
    flight, images = simulation.flight, simulation.images
    looks = images.looks
    period = np.array([1.0 / s.line_rate_hz for s in flight.strips])[looks.strip]
    first_s = np.array([s.first_line_time_s for s in flight.strips])[looks.strip]
    at = orientation.at(first_s + images.line * period)
    xy, pitch = flight.camera.image_coordinates(looks.ccd, images.sample)
    sigma = np.full(len(looks), simulation.observation_plan.image_sigma_px)
    return ImageRays(
        looks.point, at.time_s, period, at.position_l, at.angles, at.velocity_l, at.angle_rate, xy, pitch,
        flight.camera.focal_length_mm[looks.ccd], sigma, sigma,
    )  # fmt: skip


def direct_points(simulation: Simulation, poses: Iterable[TimedPose]) -> Errors:
    """Errors of object points by direct georeferencing: space intersection with the smoothed measured trajectory."""
    chosen = [p.pose for p in poses if p.pose.smoothed]
    measured = Trajectory([p.time_s for p in chosen], [p.position_l for p in chosen], [p.quaternion for p in chosen])
    found = intersect(rays_of(simulation, measured), len(simulation.points))
    use = found.known & (simulation.points.role != "control")
    return Errors(found.xyz_l[use] - simulation.points.xyz_l[use], found.covariance[use], np.zeros(int(use.sum())))
