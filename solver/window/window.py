"""The sliding-window adjustment: triangulation while the strip is flown.

Tie points are adjusted as they arrive, with the same residuals, models, weights and statistics as the batch adjustment.
Object points are eliminated batch by batch; what is older than the window is marginalised into a prior on the rest.

What is known of the slow errors beforehand makes the problem regular without any control; the window never refuses, it
says how uncertain it is.

A point that is seen again in a later strip after it has become final ties both strips, on line by what the earlier ones
know of it (`ties`), and after each strip by a solution of the block as a whole (`block`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera import LineCamera
from ..measured_trajectory import MeasuredTrajectory
from ..selfcalibration import SelfCalibration
from ..slow_errors import SlowErrors
from .arriving import Arrivals, look_time
from .batch import Batch
from .batches import Batches
from .block import Block
from .control import ControlDesk
from .determinability import Standing
from .duties import LOOK_AFTER, RETEST, WATCH, Duties
from .following import Follower
from .intake import Intake
from .leaving import Leaver, grid
from .output import CostHistory, Orienter, adjusted_points, parameters
from .points import BatchMaker, ControlPoint
from .pose_noise import PoseNoise
from .results import Look, Parameter, RefinedOrientation, WindowOptions, WindowReport, WindowUpdate
from .settle import Settler, settle
from .single_looks import SingleLooks
from .snooping import reweigh, snoop
from .sources import SourceMonitor
from .state import WindowState
from .strip import WindowStrip, segment_length
from .watch import Watch

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Unknowns become present so long before a time needs them, s.
AHEAD_S = 1.0
#: So long after its last look a point is in the window, s; later it is late.
USUAL_DELAY_S = 2.0
#: Rays tested again in one update at most, if there is more than one batch.
MOST_RETESTED = 100
#: Time between two looks at what corrections leave of the noise of poses, s.
LEARNT_S = 2.0


class Window:
    """The window; see the module.

    Parameters
    ----------
    camera : line camera
    slow : a-priori slow errors of the measured trajectory
    options : settings
    self_calibration : additional parameters to estimate all along

    Attributes
    ----------
    trajectory : the measured trajectory; its covariance is that of the white noise alone
    """

    def __init__(
        self,
        camera: LineCamera,
        slow: SlowErrors,
        options: WindowOptions = WindowOptions(),  # noqa: B008  (frozen)
        self_calibration: SelfCalibration | None = None,
    ):
        self.camera, self.slow, self.options = camera, slow, options
        self.trajectory = MeasuredTrajectory()
        self.state = WindowState()
        self.strips: dict[str, WindowStrip] = {}
        self._self_calibration = self_calibration
        self._camera_columns = np.empty(0, dtype=np.int64)
        if self_calibration is not None:
            self._camera_columns = self.state.new_numbers(self_calibration.n_unknowns)
            self.state.enter(self._camera_columns)
            m = len(self._camera_columns)
            columns = self._camera_columns[:, None].astype(np.int32)
            self.state.observe(columns, np.ones((m, 1)), np.zeros(m), self_calibration.apriori_sigma)
        sigma = self_calibration.apriori_sigma if self_calibration is not None else np.empty(0)
        self._block = Block(self.state, self.strips, self._camera_columns, sigma)
        self._intake = Intake(camera, self.strips, self.trajectory)
        self._points, self._control = self._intake.points, self._intake.control
        self._pose_noise = PoseNoise(self.trajectory)
        self._maker = BatchMaker(
            camera, self.trajectory, self.strips, self.state, self._control, self_calibration, self._camera_columns,
            self._pose_noise,
        )  # fmt: skip
        self._batches = Batches(self.state)
        self._history = CostHistory()
        self._settler = Settler()
        self._now_s = -np.inf
        self._serial = 0
        self._newest_ray_s = self._learnt_s = -np.inf
        self._duties = Duties()
        self._length_s = options.window_s
        sources = SourceMonitor(
            self._intake.sources_of, lambda: self.trajectory.noise_time_s, follows=options.follows_wander
        )
        self._control_desk = ControlDesk(
            self.state, self.strips, self._batches, self._intake, self._block, options.critical, sources
        )
        self._watch = Watch(
            camera, options.critical, self_calibration, self._camera_columns, self.state, options.determine,
            self._control_desk, sources, options.alert_limit_m,
        )  # fmt: skip
        self._orienter = Orienter(
            self.state, self.trajectory, self._pose_noise, lambda: self._watch.compensation(self._batches)
        )
        self._block.drifts = sources.named
        step_s = segment_length(slow, options)
        self._arrivals = Arrivals(
            self._batches, self.state, self._maker, self._intake, self._block, step_s, options.snoop, self._watch.drop
        )
        self._follower = Follower(
            self._batches, self.state, self._maker, self.trajectory, self._intake, step_s, self._watch.drop
        )
        single = SingleLooks(
            self.state, self.strips, self.trajectory, self._intake, self._maker, self._batches, self._block, self._watch
        )
        self._leaver = Leaver(
            options, self.state, self.strips, self._batches, self._intake, self.trajectory, self._block, self._watch,
            self._orienter, self._control_desk, self._arrivals.apart, single,
        )  # fmt: skip

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def length_s(self) -> float:
        """Length of the window; 0 while it is not known yet."""
        return self._length_s

    def begin_strip(
        self,
        id: str,
        first_line_time_s: float,
        line_rate_hz: float,
        lines: int = 0,
        slow: SlowErrors | None = None,
        joined_s: float = -np.inf,
    ) -> None:
        """A strip begins; ``slow`` are its slow errors if they are not those of the window.

        What was flown of it before ``joined_s`` is not adjusted: there is no orientation for it.

        Raises
        ------
        ValueError : a line rate that is not positive
        """
        if not line_rate_hz > 0:
            raise ValueError(f"strip {id}: line rate {line_rate_hz} Hz, wanted more than 0")
        if id in self.strips:
            return
        self.strips[id] = WindowStrip(
            id, first_line_time_s, line_rate_hz, lines, slow or self.slow, self.options, self.state, joined_s
        )
        self._block.begin(self.strips[id])

    def end_strip(self, id: str, lines: int = 0) -> None:
        """A strip is over; ``lines`` as counted."""
        if id in self.strips:
            self.strips[id].end(lines)

    def add_control(self, name: str, xyz_l: ArrayLike, sigma_m: ArrayLike, role: str) -> None:
        """Known coordinates (3,); sigma infinite where a coordinate is not given.

        They may come before or after the point's looks, and after it has become final: then they count in the backward
        pass, and as soon as the strips that saw it are over also for the strip that is flown.
        """
        point = ControlPoint(np.asarray(xyz_l, dtype=float), np.asarray(sigma_m, dtype=float), role)
        if name not in self._points:
            self._block.add_control(name, point)
        self._intake.add_control(name, point)

    def add_look(self, name: str, look: Look) -> str:
        """A look at a point; returns why it is refused, "" if it is taken."""
        return self._intake.add_look(name, look)

    # -- update --------------------------------------------------------------------------------------------------------

    def update(self, now_s: float) -> WindowUpdate:
        """Work in what has arrived, let go what is older than the window."""
        self._now_s = max(self._now_s, now_s)
        self._serial += 1
        result = WindowUpdate()
        for strip in self.strips.values():
            if not strip.is_over(self.state):
                strip.activate(min(self._now_s + AHEAD_S, strip.end_s + AHEAD_S), self.state)
        fresh = self._take_arrived(result)
        joined = self._follower.replace_filtered()
        duties = self._duties.take(self._now_s, busy=bool(joined))
        if LOOK_AFTER in duties:
            self._follower.look_after(self._now_s)
        iterations = self._solve(fresh, joined, RETEST in duties, result)
        self._learn_noise()
        for batch in fresh:
            drift = self._watch.on_points(batch, self._orienter.drift)
            result.points += adjusted_points(batch, self.state, self._points, self._control, False, drift)
        self._let_go(self._limit_s(), result)
        result.report = self._report(iterations, fresh + joined, WATCH in duties, result)
        return result

    def finish(self) -> WindowUpdate:
        """Everything that is left becomes final."""
        result = WindowUpdate()
        fresh = self._take_arrived(result)
        joined = self._follower.replace_filtered(all_at_once=True)
        iterations = self._solve(fresh, joined, True, result)
        for strip in self.strips.values():
            strip.end(0)
        self._let_go(np.inf, result, at_the_end=True)
        result.report = self._report(iterations, joined, True, result)
        return result

    def _take_arrived(self, result: WindowUpdate) -> list[Batch]:
        fresh = self._arrivals.take(self._now_s, result)
        for batch in fresh:
            self._newest_ray_s = max(self._newest_ray_s, batch.newest_s)
        if not self._length_s and fresh:
            self._length_s = self.options.window_looks * look_time(self.camera, fresh[0])
        return fresh

    def _limit_s(self) -> float:
        """What is older leaves. Where looks come late, as the first ones of a matcher that has to find its way, the
        window waits for their partners, by its own length at most."""
        if not self._length_s:
            return -np.inf
        late_s = self._now_s - self._newest_ray_s - USUAL_DELAY_S
        return self._now_s - self._length_s - min(max(late_s, 0.0), self._length_s)

    def _let_go(self, limit_s: float, result: WindowUpdate, at_the_end: bool = False) -> None:
        self._leaver.let_go(self._now_s, limit_s, self._length_s, self._serial, result, at_the_end)
        result.refused += self._intake.take_refused()

    def _solve(self, fresh: list[Batch], joined: list[Batch], retest: bool, result: WindowUpdate) -> int:
        """One or two Gauss-Newton steps from the warm state, then tests; number of solutions computed."""
        iterations = 1
        self.state.solve()
        for batch in fresh:
            batch.back_substitute(self.state.values(batch.columns))
        if self._follower.follow(fresh):  # more than once has shown no gain, even where control turns the orientation
            self.state.solve()
            iterations += 1
        if self.options.snoop:
            due = joined or (self._due_for_test() if retest else [])
            iterations += self._snoop(fresh + due, result)
            iterations += self._settle(fresh, result)
            if self._control_desk.is_due(self._now_s, fresh) and self._control_desk.look(self._now_s, result.refused):
                iterations += 1
            result.warnings += self._control_desk.take_warnings()
        for batch in joined:
            batch.judge(self.state)
        self._orienter.forget()
        return iterations

    def _learn_noise(self) -> None:
        """What the corrections of the strip that is flown leave of the noise of poses, now and then."""
        if self._now_s < self._learnt_s + LEARNT_S or not self.trajectory.noise_time_s:
            return
        strip = next((s for s in reversed(self.strips.values()) if not s.is_over(self.state)), None)
        if strip is None:
            return
        self._learnt_s = self._now_s
        for batch in self._batches:
            if not (batch.provisional or batch.counted):
                self._pose_noise.count(batch)
                batch.counted = True
        if self._pose_noise.learn(strip.followed, self._now_s):
            self._follower.reweigh()
            self.state.solve()
            self._orienter.forget()

    def _settle(self, fresh: list[Batch], result: WindowUpdate) -> int:
        """Ask a young strip again which of its points agree; number of solutions computed."""
        due = self._settler.due(list(self._batches), fresh)
        weights = settle(due, self.state) if due else None
        if weights is None:
            return 0
        result.refused += reweigh(due, weights, self.state, self._points)
        self._follower.follow(due)
        self.state.solve()
        return self._snoop(due, result) + 2

    def _snoop(self, batches: list[Batch], result: WindowUpdate) -> int:
        """Test batches; number of solutions computed."""
        refused, rounds = snoop(
            batches, self.state, self._points, self.options.critical, self._serial,
            partial(self._control_desk.look, self._now_s), lambda names: self._arrivals.apart(names, result),
        )  # fmt: skip
        result.refused += refused
        return rounds

    def _due_for_test(self) -> list[Batch]:
        """Batches tested longest ago; the more rays they have, the fewer."""
        first = self._watch.most_exposed
        waiting = sorted((b for b in self._batches if b.tested >= 0), key=lambda b: (b is not first, b.tested))
        waiting = waiting[: self.options.retest]
        due, rays = [], 0
        for batch in waiting:
            if due and rays + len(batch.rays) > MOST_RETESTED:
                break
            due.append(batch)
            rays += len(batch.rays)
        return due

    # -- output --------------------------------------------------------------------------------------------------------

    def live(self, time_s: float) -> RefinedOrientation | None:
        """Orientation at a time that is not final yet; None where no strip or no measured orientation is."""
        strip = self.strip_at(time_s)
        if strip is None or not self.trajectory.covers([time_s])[0]:
            return None
        if strip.activate(time_s, self.state):
            self.state.solve()
            self._orienter.forget()
        orientation = self._orienter.at(strip, np.array([time_s]))
        if self._watch.exposure is None:
            return orientation
        sigma = np.sqrt(np.einsum("nii->ni", orientation.covariance))
        return replace(orientation, protection=self._watch.exposure.protection(sigma))

    def live_between(self, from_s: float, to_s: float) -> list[RefinedOrientation]:
        """Live orientation at the grid times from one (or where it is not final yet) to another, by strip."""
        found = []
        for strip in self.strips.values():
            first_s = max(from_s, strip.final_to_s, strip.first_line_time_s)
            last_s = min(to_s, strip.end_s)
            if first_s >= last_s or strip.is_over(self.state):
                continue
            times = self.grid(first_s, last_s)
            times = times[self.trajectory.covers(times)] if len(times) else times
            if len(times):
                if strip.activate(float(times[-1]), self.state):
                    self.state.solve()
                    self._orienter.forget()
                found.append(self._leaver.protected(strip, self._orienter.at(strip, times)))
        return found

    def grid(self, from_s: float, to_s: float) -> Array:
        """Times of the published orientation in [from, to)."""
        return grid(self.options.grid_hz, from_s, to_s)

    def orientation_at(self, strip: str, times: ArrayLike) -> RefinedOrientation:
        """Orientation at times of a strip, none of them final, that have a measured one."""
        return self._orienter.at(self.strips[strip], np.asarray(times, dtype=float))

    def strip_at(self, time_s: float) -> WindowStrip | None:
        """The strip a time belongs to, if its orientation there is not final."""
        for strip in self.strips.values():
            inside = max(strip.final_to_s, strip.first_line_time_s) <= time_s <= strip.end_s
            if inside and not strip.is_over(self.state):
                return strip
        return None

    def _report(self, iterations: int, changed: list[Batch], look: bool, result: WindowUpdate) -> WindowReport:
        state, length = self.state, max(self._length_s, 1.0)
        cost = state.cost()
        sigma0, gained = self._history.over(self._now_s, length, cost, state.redundancy)
        total = float(np.sqrt(cost / state.redundancy)) if state.redundancy > 0 else float("nan")
        active = [s for s in self.strips.values() if not s.is_gone(state)]
        self._watch.note([b for b in changed if b in self._batches])  # what left at once is no more exposed
        watched = self._watch.last
        if look or watched is None or self._watch.strip != (active[-1].id if active else ""):
            solution = state.solution
            watched = self._watch.look(
                self._now_s, self._length_s, active[-1] if active else None, list(self._batches), sigma0, gained,
                (total, state.redundancy), active[-1].slow.position_sigma if active else np.ones(3),
                self._noise(active[-1]) if active else np.zeros((6, 6)),
            )  # fmt: skip
            if state.solution != solution:
                self._orienter.forget()
        result.events += watched.events
        determined = rows = rays = points = control = 0
        for batch in self._batches:
            determined += batch.determined
            rows += batch.information.rows
            rays += batch.active_rays
            points += len(batch.names)
            control += batch.active_control
        unknowns = len(state) + determined
        return WindowReport(
            sigma0=sigma0,
            redundancy=gained,
            sigma0_total=total,
            redundancy_total=state.redundancy,
            observations=unknowns + rows,
            unknowns=unknowns,
            iterations=iterations,
            start_s=min((s.final_to_s for s in active), default=self._now_s),
            end_s=self._newest_ray_s,
            rays=rays,
            points=points,
            control=control,
            strip=active[-1].id if active else "",
            parameters=self.parameters(active[-1], watched.standing) if active else (),
            watched=watched,
        )

    def _noise(self, strip: WindowStrip) -> Array:
        """Covariance (6, 6) of the noise of its newest orientation; 0 where there is none."""
        times = np.array([min(self._now_s, strip.end_s, self.trajectory.end_s)])
        if not np.isfinite(times[0]) or not self.trajectory.covers(times)[0]:
            return np.zeros((6, 6))
        return self._orienter.noise(strip, times)[0]

    def parameters(self, strip: WindowStrip, standing: tuple[Standing, ...] = ()) -> tuple[Parameter, ...]:
        """Offset, shift and drift of a strip where its model has them, and the additional parameters."""
        slow = strip.slow
        return parameters(
            self.state,
            strip.numbers[:9],
            np.concatenate([slow.offset_m, slow.shift, slow.drift]),
            self._self_calibration,
            self._camera_columns,
            standing,
        )
