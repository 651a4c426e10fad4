"""How well window and batch do in worlds that are not as they are told: one flight, and a row of flights over seeds.

Each flight goes through navigation and the sliding window as whoever calls `fly` says (`through_window`: without nodes,
with updates at fixed times), and through the batch adjustment with and without variance components; all of them are
told what `ErrorModel` and `ObservationPlan` state and nothing of the `World`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from numpy.typing import NDArray

from ..adjustment.drift_hypotheses import ALL
from ..adjustment.job import Job, NotAdjustableError
from ..adjustment.job import run as run_batch
from ..camera.self_calibration import left_by_calibration
from ..models.platform import USUAL_PLATFORM
from ..models.wander import WanderOptions
from ..window.quality.light import GOOD
from ..window.results import TAKEN_BACK, AdjustedPoint, RefinedOrientation, Refusal, WindowOptions
from .error_models import ErrorModel
from .flight import FlightPlan
from .flight_network import batch_errors, network_of
from .misstated import AS_STATED, Sine, Step, World
from .real_motion import RealMotion
from .scenario import ObservationPlan, Simulation, simulate, simulate_real_motion
from .window_study import (
    Errors,
    TimedPose,
    adjust_online,
    direct_points,
    navigate,
    orientation_errors,
    point_errors,
)

Array = NDArray[np.floating]
#: Point, strip, CCD line, coordinate: what is refused; the last is "" for a look, strip and line are for a coordinate.
Refused = tuple[str, str, str, str]

#: What is stated: the demo's a-priori, and that of a carrier-phase GNSS with a good inertial system. Attitude comes at
#: 100 Hz: half the work, and the window interpolates either.
SETTINGS: dict[str, ErrorModel] = {
    "def": ErrorModel(attitude_rate_hz=100.0),
    "rtk": ErrorModel(
        offset_sigma_m=(0.03, 0.03, 0.05),
        wander_sigma_m=(0.01, 0.01, 0.02),
        shift_sigma_deg=(0.005, 0.005, 0.01),
        drift_sigma_deg=(0.002, 0.002, 0.002),
        wander_sigma_deg=(0.002, 0.002, 0.002),
        attitude_rate_hz=100.0,
    ),
}
OBSERVED = ObservationPlan(tie_points_per_s=8.0, control=6, control_sigma_m=(0.02, 0.02, 0.02))
#: Rate at which the orientation is compared, Hz.
GRID_HZ = 5.0
#: Limits: on-line RMSE of points over that of the batch with variance components, and over that of the world as stated.
OVER_BATCH, OVER_STATED = 1.1, 1.5
#: Limits of mean normalised errors squared, and that up to which a flight may be shown as good.
NEES_LOW, NEES_HIGH, NEES_GOOD = 0.6, 1.6, 2.0
#: Largest share of looks that may be rejected where none is wrong.
MOST_REJECTED = 0.02


@dataclass(frozen=True)
class Row:
    """A world, and what is wanted in it.

    Attributes
    ----------
    name, title : for the command line, and in words
    world : what is not stated
    over_stated : largest RMSE of points over that of the world as stated; inf for no limit
    over_batch : the same over the batch with variance components
    looks_wrong : whether looks may be rejected without limit
    unknowable : nobody can know what is wrong: no flight may be shown as good, and control's datum is the one judged
    """

    name: str
    title: str
    world: World
    over_stated: float = OVER_STATED
    over_batch: float = OVER_BATCH
    looks_wrong: bool = False
    unknowable: bool = False


ROWS: dict[str, Row] = {
    row.name: row
    for row in (
        Row("stated", "as stated", AS_STATED),
        Row("wander", "wander sigma x 2", World(wander_factor=2.0)),
        Row("wander-time", "correlation time / 3", World(wander_time_factor=1.0 / 3.0)),
        Row("random-walk", "random walk 3 cm/sqrt(s)", World(random_walk_m=(0.03, 0.03, 0.03))),
        Row("step", "GNSS step 0.3 m", World(steps=(Step((0.3, 0.3, 0.3)),))),
        Row("sine-slow", "attitude 0.02 deg, 0.1 Hz", World(sines=(Sine((0.02, 0.02, 0.02), 0.1),))),
        Row(
            "sine-fast", "attitude 0.01 deg, 3 Hz", World(sines=(Sine((0.01, 0.01, 0.01), 3.0),)),
            over_stated=np.inf, over_batch=np.inf,
        ),
        Row("boresight", "boresight 0.05 deg", World(boresight_deg=(0.05, 0.05, 0.05))),
        Row("lever-arm", "lever arm 0.2 m", World(lever_arm_m=(0.2, 0.2, 0.2))),
        Row("focal-length", "focal length 20 um", World(focal_length_um=20.0)),
        Row("distortion", "lens distortion 3 px", World(distortion_px=3.0)),
        Row("clock", "clock 5 ms", World(clock_s=0.005)),
        Row("noise-t3", "tie noise t(3)", World(heavy_tails=True), looks_wrong=True),
        Row("noise", "tie noise x 2", World(noise_factor=2.0), over_stated=2.0),
        Row("gnss-datum", "GNSS datum + 0.5 m", World(gnss_datum_m=(0.5, 0.5, 0.5))),
        Row("control-datum", "control + 0.5 m", World(control_datum_m=(0.5, 0.5, 0.5)), unknowable=True),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Quality:
    """Errors of points and orientation against truth.

    Attributes
    ----------
    points_m : root mean square of the 3D error of object points
    points_nees : mean normalised error squared of them, 1 expected; NaN where none is computed
    check_m : as ``points_m``, of check points alone
    position_m, attitude_deg : (3,) RMSE of X, Y, Z and of omega, phi, kappa; () where it is not computed
    orientation_nees : of all six
    """

    points_m: float
    points_nees: float = np.nan
    check_m: float = np.nan
    position_m: tuple[float, ...] = ()
    attitude_deg: tuple[float, ...] = ()
    orientation_nees: float = np.nan


@dataclass(frozen=True)
class OnlineAnswer:
    """What an on-line system says of a flight in the end.

    Attributes
    ----------
    orientation, points : of whole strips; final ones where there are none
    sigma0 : over the flight
    refused : looks and known coordinates that were left out in the end, see `still_refused`
    accused : CCD lines, or "all", that were said to drift or to be the one that may, at any time
    light, words : in the end
    good_share : share of updates with rays whose light was good
    events : what it told the operator
    """

    orientation: list[RefinedOrientation]
    points: dict[str, AdjustedPoint]
    sigma0: float
    refused: set[Refused]
    accused: list[str]
    light: str
    words: str
    good_share: float
    events: list[str]


Online = Callable[[Simulation, list[TimedPose]], OnlineAnswer]


@dataclass(frozen=True)
class FlightFigures:
    """What came out of one flight.

    Attributes
    ----------
    seed, seconds : of the flight; processor time of all of it
    online : whole strips from the window; in the datum of control, which is that of the truth unless control is off
    online_in_truth : the same against truth
    direct_m : 3D RMSE of points by direct georeferencing
    batch, components : the batch adjustment without and with variance components
    component_factors : what the latter multiplied the a-priori sigmas by
    sigma0 : over the flight
    rejected : share of looks that were left out in the end
    control_refused : known coordinates that did not count in the end, as "GCP1 X"
    accused : CCD lines, or "all", that were said to drift or to be the one that may, at any time
    light, words : in the end
    good_share : share of updates with rays whose light was good
    events : what the window said
    """

    seed: int
    seconds: float
    online: Quality
    online_in_truth: Quality
    direct_m: float
    batch: Quality
    components: Quality
    component_factors: dict[str, float]
    sigma0: float
    rejected: float
    control_refused: list[str]
    accused: list[str]
    light: str
    words: str
    good_share: float
    events: list[str] = field(default_factory=list)


def through_window(simulation: Simulation, poses: list[TimedPose]) -> OnlineAnswer:
    """The window without nodes. Its updates come at fixed times alone, so that it is not all that `process` does."""
    result = adjust_online(simulation, poses, WindowOptions(grid_hz=GRID_HZ), live=False, platform=USUAL_PLATFORM)
    last, with_rays = result.reports[-1].quality, [r for r in result.reports if r.rays]
    return OnlineAnswer(
        result.whole or result.final,
        result.whole_points or result.final_points,
        result.reports[-1].sigma0_total,
        still_refused(result.refused),
        sorted({named(*group) for r in result.reports for group in r.quality.names}),
        last.light,
        last.reason,
        float(np.mean([r.quality.light == GOOD for r in with_rays])) if with_rays else 0.0,
        list(result.events),
    )


def fly(
    setting: str,
    row: str,
    seed: int,
    strips: int = 1,
    strip_s: float = 60.0,
    online: Online = through_window,
    motion: RealMotion | None = None,
    told: bool = False,
) -> FlightFigures:
    """One flight of a row, navigated, adjusted on line and in batch.

    Parameters
    ----------
    setting, row : keys of `SETTINGS` and `ROWS`
    strips, strip_s : parallel strips, each so long
    online : the on-line system
    motion : what is flown instead of these strips
    told : whether the true sigmas and correlation times of the wander are stated, to see what the data allow at best
    """
    begun = process_time()
    if motion is None:
        plan = FlightPlan(strips=strips, strip_s=strip_s, turns=False, gap_s=8.0, lead_in_s=5.0, lead_out_s=3.0)
        simulation = simulate(plan, seed, SETTINGS[setting], OBSERVED, world=ROWS[row].world)
    else:
        simulation = simulate_real_motion(
            motion, seed, SETTINGS[setting], OBSERVED, as_sensors=True, world=ROWS[row].world
        )
    if told:
        simulation = replace(simulation, errors=simulation.world.errors(simulation.errors))
    poses = navigate(simulation)
    answer = online(simulation, poses)
    batch, _ = adjust_in_batch(simulation, poses, answer, components=False)
    components, factors = adjust_in_batch(simulation, poses, answer, components=True)
    return FlightFigures(
        seed=seed,
        seconds=process_time() - begun,
        online=online_quality(simulation, answer, np.array(simulation.world.control_datum_m)),
        online_in_truth=online_quality(simulation, answer, np.zeros(3)),
        direct_m=_spatial(direct_points(simulation, poses).error),
        batch=batch,
        components=components,
        component_factors=factors,
        sigma0=answer.sigma0,
        rejected=sum(not coordinate for *_, coordinate in answer.refused) / max(len(simulation.images), 1),
        control_refused=sorted(f"{point} {coordinate}" for point, _, _, coordinate in answer.refused if coordinate),
        accused=answer.accused,
        light=answer.light,
        words=answer.words,
        good_share=answer.good_share,
        events=answer.events,
    )


def still_refused(refusals: Sequence[Refusal]) -> set[Refused]:
    """What was refused and not taken back: point, strip, CCD line, coordinate; the last is "" for a look."""
    found: dict[Refused, bool] = {}
    for r in refusals:
        found[r.point, r.look.strip, r.look.ccd, r.coordinate] = r.reason != TAKEN_BACK
    return {key for key, out in found.items() if out}


def online_quality(simulation: Simulation, answer: OnlineAnswer, datum_m: Array) -> Quality:
    """An answer against truth moved by a datum (3,)."""
    points, check = point_errors(simulation, answer.points), point_errors(simulation, answer.points, ("check",))
    orientation = orientation_errors(simulation, answer.orientation)
    moved = Errors(points.error - datum_m, points.covariance, points.time_s)
    turned = Errors(orientation.error - [*datum_m, 0, 0, 0], orientation.covariance, orientation.time_s)
    rmse = turned.rmse
    return Quality(
        _spatial(moved.error),
        float(moved.nees.mean()),
        _spatial(check.error - datum_m),
        tuple(rmse[:3].tolist()),
        tuple(np.degrees(rmse[3:]).tolist()),
        float(turned.nees.mean()),
    )


def adjust_in_batch(
    simulation: Simulation, poses: list[TimedPose], online: OnlineAnswer, components: bool
) -> tuple[Quality, dict[str, float]]:
    """What ``triline adjust`` does with the same data, and the factors on a-priori sigmas; NaN where it gives up.

    Points and times of orientation are those of the on-line answer; in the datum of control.
    """
    errors = simulation.errors
    model = WanderOptions.from_settings({key: getattr(errors, key) for key in _STATED})
    try:
        network, job = network_of(simulation, poses), Job(model)
        if components:
            camera = left_by_calibration(network.camera)
            job = Job(model, self_calibration=camera, components=True, platform=USUAL_PLATFORM)
        found = run_batch(network, job)
    except (NotAdjustableError, ValueError):
        return Quality(np.nan), {}
    datum = np.array(simulation.world.control_datum_m)
    place = {name: i for i, name in enumerate(found.network.point_ids)}
    truth = {str(id): xyz for id, xyz in zip(simulation.points.id, simulation.points.xyz_l, strict=True)}
    xyz, covariance = found.adjusted_points(), found.point_covariance
    chosen = [p for p in online.points.values() if p.role in ("tie", "check") and p.rays >= 2 and p.name in place]
    wanted, check = [p.name for p in chosen], np.array([p.role == "check" for p in chosen], dtype=bool)
    index = np.array([place[name] for name in wanted], dtype=int)
    error = xyz[index] - [truth[name] for name in wanted] - datum
    sure = np.isfinite(error).all(axis=1) & np.isfinite(covariance[index]).all(axis=(1, 2))
    points = Errors(error[sure], covariance[index][sure], np.zeros(int(sure.sum())))
    turned = []
    for strip in simulation.flight.strips:
        times = [o.time_s for o in online.orientation if o.strip == strip.id]
        if times:
            turned.append(batch_errors(simulation, found, strip.id, np.concatenate(times)))
    rmse = np.sqrt(np.mean(np.square(np.concatenate(turned) - [*datum, 0, 0, 0]), axis=0))
    factors = {c.group: float(c.factor) for c in found.components if c.estimated}
    position, attitude = tuple(rmse[:3].tolist()), tuple(np.degrees(rmse[3:]).tolist())
    nees, of_check = float(points.nees.mean()), _spatial(error[sure & check])
    return Quality(_spatial(points.error), nees, of_check, position, attitude), factors


_STATED = (
    "offset_sigma_m", "shift_sigma_deg", "drift_sigma_deg", "wander_sigma_m", "wander_sigma_deg", "wander_time_s",
    "attitude_wander_time_s",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """A row in a setting over seeds; RMSE are root mean squares over flights, NEES and shares means.

    Attributes
    ----------
    online_m, in_truth_m, direct_m, batch_m, components_m : 3D RMSE of points
    batch_nees, components_nees, points_nees, orientation_nees : of points of the two batches, and on line
    position_m, attitude_deg : 3D RMSE of orientation on line
    sigma0, rejected : means
    control_refused : coordinates a flight, mean
    accused : flights in which a source was accused
    lights : flights by light in the end
    false_good : flights that are shown as good with a NEES of points or orientation of `NEES_GOOD` or more
    worst_m, worst_seed, worst_words : the flight with the largest RMSE of points
    limits : whether each limit holds, by name
    """

    setting: str
    row: str
    flights: int
    online_m: float
    in_truth_m: float
    direct_m: float
    batch_m: float
    components_m: float
    batch_nees: float
    components_nees: float
    points_nees: float
    orientation_nees: float
    position_m: float
    attitude_deg: float
    sigma0: float
    rejected: float
    control_refused: float
    accused: int
    lights: dict[str, int]
    false_good: int
    worst_m: float
    worst_seed: int
    worst_words: str
    seconds: float
    limits: dict[str, bool]


def cell_of(setting: str, row: str, flights: Sequence[FlightFigures], stated_m: float) -> Cell:
    """Flights of a row together.

    Parameters
    ----------
    stated_m : RMSE of points on line in the world as stated, NaN if that was not flown
    """
    worst = max(flights, key=lambda f: f.online.points_m)
    rms = {
        name: float(np.sqrt(np.mean(np.square([getattr(f, name).points_m for f in flights]))))
        for name in ("online", "online_in_truth", "batch", "components")
    }
    nees = {name: float(np.mean([getattr(f, name).points_nees for f in flights])) for name in ("batch", "components")}
    points = float(np.mean([f.online.points_nees for f in flights]))
    orientation = float(np.mean([f.online.orientation_nees for f in flights]))
    direct = float(np.sqrt(np.mean(np.square([f.direct_m for f in flights]))))
    rejected = float(np.mean([f.rejected for f in flights]))
    refused = float(np.mean([len(f.control_refused) for f in flights]))
    accused = sum(bool(f.accused) for f in flights)
    lights: dict[str, int] = {}
    for f in flights:
        lights[f.light] = lights.get(f.light, 0) + 1
    untrue = sum(f.light == GOOD and max(f.online.points_nees, f.online.orientation_nees) >= NEES_GOOD for f in flights)
    what = ROWS[row]
    limits = {
        "as batch": not rms["online"] > what.over_batch * rms["components"],
        "as stated": not rms["online"] > what.over_stated * stated_m,
        "NEES points": NEES_LOW <= points <= NEES_HIGH,
        "NEES orientation": NEES_LOW <= orientation <= NEES_HIGH,
        "as direct": what.unknowable or rms["online_in_truth"] <= direct,
        "rejected": what.looks_wrong or rejected <= MOST_REJECTED,
        "no source accused": not accused,
        "no control refused": what.unknowable or not refused,
        "light": not untrue and not (what.unknowable and lights.get(GOOD)),
    }
    return Cell(
        setting, row, len(flights), rms["online"], rms["online_in_truth"], direct, rms["batch"], rms["components"],
        nees["batch"], nees["components"], points, orientation,
        float(np.sqrt(np.mean([np.sum(np.square(f.online.position_m)) for f in flights]))),
        float(np.sqrt(np.mean([np.sum(np.square(f.online.attitude_deg)) for f in flights]))),
        float(np.mean([f.sigma0 for f in flights])), rejected, refused, accused, lights, untrue,
        worst.online.points_m, worst.seed, worst.words, sum(f.seconds for f in flights), limits,
    )  # fmt: skip


def cells_of(flights: Mapping[tuple[str, str], Sequence[FlightFigures]]) -> list[Cell]:
    """All rows of all settings, by (setting, row)."""
    stated = {
        setting: float(np.sqrt(np.mean([f.online.points_m**2 for f in found])))
        for (setting, row), found in flights.items()
        if row == "stated"
    }
    return [cell_of(s, row, found, stated.get(s, np.nan)) for (s, row), found in flights.items()]


def named(source: str, ccd: str) -> str:
    """A CCD line as a report names it, with whoever measured it if there is more than one."""
    parts = ("all sources" if source == ALL else source, "all" if ccd == ALL else ccd)
    return " ".join(part for part in parts if part)


def _spatial(error: Array) -> float:
    """Root mean square of the length of errors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) if len(error) else np.nan
