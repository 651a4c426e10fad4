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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera import LineCamera
from ..measured_trajectory import MeasuredTrajectory
from ..models.base import Design
from ..selfcalibration import SelfCalibration
from ..slow_errors import SlowErrors
from .backward import LeftPoints, Step
from .batch import Batch
from .block import Block
from .determinability import Standing
from .intake import Intake
from .output import CostHistory, Orienter, adjusted_points, parameters
from .points import BatchMaker, ControlPoint
from .results import (
    Look,
    Parameter,
    RefinedOrientation,
    WindowOptions,
    WindowReport,
    WindowUpdate,
)
from .settle import Settler, settle
from .snooping import admit, reweigh, snoop
from .state import WindowState
from .strip import WindowStrip, segment_length
from .tie_snooping import admit_ties, snoop_ties
from .watch import Watch

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Unknowns become present so long before a time needs them, s.
AHEAD_S = 1.0
#: Change of a correction, m and rad, beyond which a batch is linearised again. What the linear equations then miss goes
#: with its square, over the flying height: a hundredth of a pixel.
MOVED_M, MOVED_RAD = 1.5, 1e-3
#: Every so many updates it is looked whether a batch has moved, if new data did not move far.
LOOKED_AFTER = 16
#: Rays tested again in one update at most, if there is more than one batch.
MOST_RETESTED = 100
#: So many batches at most are linearised again in one update; where new data moved far, so many rays, the oldest first,
#: which leave first, the others in the updates after it.
MOST_AGAIN, MOST_RAYS_AGAIN = 6, 2500
#: Rays of a strip that is over which leave in one update, about; the others follow in the next ones.
MOST_LEAVING = 1000
#: Steps kept for the backward pass of a strip too long for a block; of one that never ends the earliest part is not
#: refined again.
MOST_STEPS = 600


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
        self._steps: list[Step] = []
        self._left: list[LeftPoints] = []
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
        self._maker = BatchMaker(
            camera, self.trajectory, self.strips, self.state, self._control, self_calibration, self._camera_columns
        )
        self._batches: list[Batch] = []
        self._suspects: dict[int, Batch] = {}  # batches that may have moved, by id, the oldest first
        self._following = False  # whether they are what was left when new data moved far
        self._history = CostHistory()
        self._settler = Settler()
        self._now_s = -np.inf
        self._serial = 0
        self._newest_ray_s = -np.inf
        self._length_s = options.window_s
        self._orienter = Orienter(self.state, self.trajectory)
        self._watch = Watch(
            camera, options.critical, self._points, self_calibration, self._camera_columns, self.state,
            options.determine,
        )  # fmt: skip

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def length_s(self) -> float:
        """Length of the window; 0 while it is not known yet."""
        return self._length_s

    def begin_strip(
        self, id: str, first_line_time_s: float, line_rate_hz: float, lines: int = 0, slow: SlowErrors | None = None
    ) -> None:
        """A strip begins; ``slow`` are its slow errors if they are not those of the window.

        Raises
        ------
        ValueError : a line rate that is not positive
        """
        if not line_rate_hz > 0:
            raise ValueError(f"strip {id}: line rate {line_rate_hz} Hz, wanted more than 0")
        if id in self.strips:
            return
        self.strips[id] = WindowStrip(
            id, first_line_time_s, line_rate_hz, lines, slow or self.slow, self.options, self.state
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
        self._replace_filtered()
        iterations = self._solve(fresh, result)
        for batch in fresh:
            result.points += adjusted_points(batch, self.state, self._points, self._control, final=False)
        self._let_go(self._now_s - self._length_s if self._length_s else -np.inf, result)
        result.refused += self._intake.take_refused()
        result.report = self._report(iterations, fresh, result)
        return result

    def finish(self) -> WindowUpdate:
        """Everything that is left becomes final."""
        result = WindowUpdate()
        fresh = self._take_arrived(result)
        iterations = self._solve(fresh, result)
        for strip in self.strips.values():
            strip.end(0)
        self._let_go(np.inf, result, at_the_end=True)
        result.refused += self._intake.take_refused()
        result.report = self._report(iterations, [], result)
        return result

    def _take_arrived(self, result: WindowUpdate) -> list[Batch]:
        """Batches of the points that have new looks with a measured orientation; others wait."""
        ready: dict[tuple[int, bool], list[str]] = {}
        step = segment_length(self.slow, self.options)
        again: list[Batch] = []
        for name in self._intake.ready(self._now_s):
            point = self._points[name]
            if point.batch is not None:
                again.append(point.batch)
                continue
            if point.looks:
                ready.setdefault(self._share(name, step), []).append(name)
        known: dict[str, Array] = {}
        for batch in {id(b): b for b in again}.values():
            known |= dict(zip(batch.names, batch.points_l, strict=True))
            self._remove(batch)
            for name in batch.names:
                self._intake.place(name, None)
                ready.setdefault(self._share(name, step), []).append(name)
        fresh = []
        for (_, tied), names in ready.items():
            few = [n for n in names if len(self._points[n].looks) < 2 and not tied]
            few = [n for n in few if n not in self._control or self._points[n].spent]
            names = [n for n in names if n not in few]
            if not names:
                continue
            batch, _ = self._maker.make(
                names, [self._points[n] for n in names], known, self._block.earlier if tied else None
            )
            if batch is None:
                continue
            for name in batch.names:
                self._intake.place(name, batch)
            fresh.append(batch)
        if self.options.snoop and fresh:
            self.state.solve()
            for batch in fresh:
                result.refused += admit(batch, self.state, self._points)
                self._apart(admit_ties(batch, self.state), result)
        for batch in fresh:
            self._batches.append(batch)
            self.state.add(batch.columns, batch.information)
            self._newest_ray_s = max(self._newest_ray_s, batch.newest_s)
        if not self._length_s and fresh:
            self._length_s = self.options.window_looks * self._look_time(fresh[0])
        return fresh

    def _share(self, name: str, step_s: float) -> tuple[int, bool]:
        """Which points go into a batch together: those of a time, and those that tie strips apart."""
        point, earlier = self._points[name], self._block.earlier.points.get(name)
        point.spent = earlier is not None and earlier.with_control and not point.alone
        tied = not point.alone and self._block.earlier.enter(name, max(point.time_s))
        return int(min(point.time_s) // step_s), tied

    def _apart(self, names: list[str], result: WindowUpdate) -> None:
        """Points that do not agree with earlier strips are points of their own."""
        for name in names:
            self._points[name].alone, self._points[name].spent = True, False
        if names:
            result.events.append(f"do not agree with earlier strips: {', '.join(names)}")

    def _look_time(self, batch: Batch) -> float:
        """Time between the first and the last look at a point, from view angles, height and speed."""
        rays = batch.rays
        tangent = np.array([line.centre_mm[0] for line in self.camera.lines]) - self.camera.principal_point_mm[:, 0]
        tangent = tangent / self.camera.focal_length_mm
        height = float(np.median(rays.position_l[:, 2] - batch.points_l[rays.point, 2]))
        speed = float(np.median(np.linalg.norm(rays.velocity_l, axis=1)))
        return float(np.ptp(tangent)) * height / max(speed, 1.0)

    def _replace_filtered(self) -> None:
        """Put smoothed orientation under batches that had to do with the filtered one."""
        smoothed_s = self.trajectory.smoothed_to_s
        due = [b for b in self._batches if b.provisional and b.newest_s <= smoothed_s]
        if due:
            self._maker.refresh(due)
            for batch in due:
                before = batch.information
                batch.linearise(self.state.values(batch.columns), reweigh=True)
                self.state.exchange(batch.columns, before, batch.information)

    def _solve(self, fresh: list[Batch], result: WindowUpdate) -> int:
        """Gauss-Newton from the warm state, then tests; number of solutions computed."""
        iterations = 1
        self.state.solve()
        for batch in fresh:
            batch.back_substitute(self.state.values(batch.columns))
        if self._follow(fresh):
            self.state.solve()
            iterations += 1
        if self.options.snoop:
            due = self._due_for_test()
            refused, rounds = snoop(fresh + due, self.state, self._points, self.options.critical, self._serial)
            iterations += rounds
            result.refused += refused
            iterations += self._settle(fresh, result)
        self._orienter.forget()
        return iterations

    def _settle(self, fresh: list[Batch], result: WindowUpdate) -> int:
        """Ask a young strip again which of its points agree; number of solutions computed."""
        due = self._settler.due(self._batches, fresh)
        weights = settle(due, self.state) if due else None
        if weights is None:
            return 0
        result.refused += reweigh(due, weights, self.state, self._points)
        self._follow(due)
        self.state.solve()
        refused, rounds = snoop(due, self.state, self._points, self.options.critical, self._serial)
        result.refused += refused
        return rounds + 2

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

    def _follow(self, fresh: list[Batch]) -> bool:
        """Linearise batches again whose unknowns or points have moved far; whether there were any.

        New batches tell whether anything moved at all; if not, the others are looked after in turn.
        """
        values = [self.state.values(batch.columns) for batch in fresh]
        far = any(b.has_moved(theta, MOVED_M, MOVED_RAD) for b, theta in zip(fresh, values, strict=True))
        due = [(b, theta) for b, theta in zip(fresh, values, strict=True) if far or b.points_moved() > MOVED_M]
        new = {id(b) for b in fresh}
        if far:
            self._suspects = {id(b): b for b in self._batches if id(b) not in new}
            self._following = True
        elif not self._suspects:
            self._following = False
            turn = self._batches[self._serial % LOOKED_AFTER :: LOOKED_AFTER]
            self._suspects = {id(b): b for b in turn if id(b) not in new}
        rays = 0
        for key, batch in list(self._suspects.items()):
            if rays > MOST_RAYS_AGAIN if self._following else len(due) >= MOST_AGAIN:
                break
            del self._suspects[key]
            theta = self.state.values(batch.columns)
            if batch.has_moved(theta, MOVED_M, MOVED_RAD):
                batch.back_substitute(theta)
                due.append((batch, theta))
                rays += len(batch.rays)
        for batch, theta in due:
            before = batch.information
            batch.linearise(theta, reweigh=False)
            self.state.exchange(batch.columns, before, batch.information)
        return bool(due)

    def _remove(self, batch: Batch) -> None:
        self.state.add(batch.columns, batch.information, -1)
        self._batches = [b for b in self._batches if b is not batch]
        self._watch.drop(batch)
        self._suspects.pop(id(batch), None)

    # -- what leaves ---------------------------------------------------------------------------------------------------

    def _let_go(self, limit_s: float, result: WindowUpdate, at_the_end: bool = False) -> None:
        """Batches and unknowns older than the limit, and those of strips that are over, become final."""
        limits = {}
        for strip in self.strips.values():
            settled = strip.ended and self._now_s >= strip.end_s + self.options.settle_s
            limits[strip.id] = max(self._settled_to(strip), limit_s) if settled else limit_s
        by_index = [limits[id] for id in self.strips]
        latest = max(by_index, default=-np.inf)
        old = [b for b in self._batches if b.oldest_s <= latest]
        leaving = [b for b in old if b.oldest_s <= max(by_index[i] for i in b.strips)]
        if self.options.snoop and leaving:
            refused, rounds = snoop(leaving, self.state, self._points, self.options.critical, self._serial)
            result.refused += refused
            failed = snoop_ties([b for b in leaving if b.ties is not None], self.state)
            self._apart(failed, result)
            if failed:
                self.state.solve()
            if rounds or failed:
                self._orienter.forget()
        for batch in leaving:
            points = adjusted_points(batch, self.state, self._points, self._control, final=True)
            result.points += points
            self._left.append(LeftPoints.of(batch, points))
            self._block.leave(batch, points)
        self._watch.leaving(leaving, limit_s - self._length_s)
        for batch in leaving:
            self.state.fix(batch.columns, batch.information)
            self._intake.finish(batch)
        if leaving:
            gone = {id(b) for b in leaving}
            self._batches = [b for b in self._batches if id(b) not in gone]
            self._suspects = {key: b for key, b in self._suspects.items() if key not in gone}
        for strip in self.strips.values():
            numbers, to_s = strip.leaving(limits[strip.id], self.state)
            if not len(numbers):
                continue
            final = self._final(strip, to_s)
            design = noise = None
            if final is not None:
                result.final.append(final)
                design, noise = strip.design(final.time_s), self._orienter.noise(strip, final.time_s)
                self._block.orientation(strip, final, design, noise)
            strip.final_to_s = to_s
            self._step(numbers, final, design, noise)
            if strip.ended and strip.is_gone(self.state):
                self._block.gone(strip)
                strip.release()
        over = min(limits.values(), default=limit_s)
        modes = self._block.earlier.leaving(max(over, limit_s), (b.columns for b in self._batches))
        if len(modes):
            self._step(modes)
        if self._block.quiet:
            result.whole = self._block.refined(self._steps, at_the_end)
            result.events += self._block.take_events()
            if result.whole is not None:
                self._steps = []
        del self._steps[: max(len(self._steps) - MOST_STEPS, 0)]
        self._forget(limit_s, result)

    def _settled_to(self, strip: WindowStrip) -> float:
        """Up to when a strip that is over may leave now: all of it, or as much as one update can bear."""
        index = list(self.strips).index(strip.id)
        rays = 0
        for batch in sorted((b for b in self._batches if index in b.strips), key=lambda b: b.oldest_s):
            rays += len(batch.rays)
            if rays > MOST_LEAVING:
                return batch.oldest_s
        return np.inf

    def _step(
        self,
        numbers: IntArray,
        final: RefinedOrientation | None = None,
        design: Design | None = None,
        noise: Array | None = None,
    ) -> None:
        """Marginalise unknowns, and keep what leads back to them."""
        marginal = self.state.marginalise(numbers)
        self._watch.marginalised(marginal)
        self._steps.append(Step(marginal, final, design, noise, self._left))
        self._left = []
        self._orienter.forget()

    def _final(self, strip: WindowStrip, to_s: float) -> RefinedOrientation | None:
        """Orientation at the grid times that become final now."""
        end = self.trajectory.end_s
        if not np.isfinite(end):
            return None
        times = self.grid(strip.final_to_s, min(to_s, strip.end_s, end + 1e-3))
        times = times[self.trajectory.covers(times)] if len(times) else times
        return self._protected(strip, self._orienter.at(strip, times)) if len(times) else None

    def _protected(self, strip: WindowStrip, orientation: RefinedOrientation) -> RefinedOrientation:
        """With protection levels as the middle of the times is exposed."""
        exposure = self._watch.exposure_at(strip, float(orientation.time_s[len(orientation.time_s) // 2]))
        if exposure is None:
            return orientation
        sigma = np.sqrt(np.einsum("nii->ni", orientation.covariance))
        return replace(orientation, protection=exposure.protection(sigma))

    def grid(self, from_s: float, to_s: float) -> Array:
        """Times of the published orientation in [from, to)."""
        hz = self.options.grid_hz
        return np.arange(np.ceil(from_s * hz - 1e-6), np.ceil(to_s * hz - 1e-6)) / hz

    def _forget(self, limit_s: float, result: WindowUpdate) -> None:
        """Drop what nothing can need any more: single looks that found no partner, old poses, strips that are over."""
        if not np.isfinite(limit_s) and limit_s < 0:
            return
        result.refused += self._intake.forget(limit_s, limit_s - self._length_s)
        used = min((b.oldest_s for b in self._batches), default=np.inf)
        waiting = self._intake.oldest_waiting_s
        finals = min((s.final_to_s for s in self.strips.values() if not s.is_gone(self.state)), default=np.inf)
        self.trajectory.forget(min(limit_s - self._length_s, used, waiting, finals) - 1.0)

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
                found.append(self._protected(strip, self._orienter.at(strip, times)))
        return found

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

    def _report(self, iterations: int, changed: list[Batch], result: WindowUpdate) -> WindowReport:
        state, length = self.state, max(self._length_s, 1.0)
        cost = state.cost()
        sigma0, gained = self._history.over(self._now_s, length, cost, state.redundancy)
        total = float(np.sqrt(cost / state.redundancy)) if state.redundancy > 0 else float("nan")
        active = [s for s in self.strips.values() if not s.is_gone(state)]
        watched = self._watch.look(
            self._now_s, self._length_s, active[-1] if active else None, self._batches, changed, sigma0, gained,
            (total, state.redundancy), active[-1].slow.position_sigma if active else np.ones(3),
        )  # fmt: skip
        if watched.events:
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
