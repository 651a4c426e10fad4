"""The sliding-window adjustment: triangulation while the strip is flown.

Tie points are adjusted as they arrive, with the same residuals, models, weights and statistics as the batch adjustment.
Object points are eliminated batch by batch; what is older than the window is marginalised into a prior on the rest.

What is known of the slow errors beforehand makes the problem regular without any control; the window never refuses, it
says how uncertain it is.

A point that is seen again in a later strip after it has become final ties both strips, on line by what the earlier ones
know of it (`block.ties`), and after each strip by a solution of the block as a whole (`block.block`).
"""

from __future__ import annotations

from heapq import nsmallest

import numpy as np
from numpy.typing import ArrayLike

from ..adjustment.pose_noise import of_vibration, ray_information
from ..adjustment.surface_control import SurfaceControl
from ..arrays import Array
from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from ..models.slow_errors import SlowErrors
from .block.block import Block
from .datum.control import ControlTests
from .datum.drift_monitor import DriftMonitor
from .datum.surface import SurfaceTests
from .leaving import Leaving
from .output import CostHistory, OrientationOutput, WindowReport, WindowUpdate, parameters
from .quality.light import Fit
from .quality.quality_control import QualityControl
from .results import DivergedError, Look, RefinedOrientation, WindowOptions
from .screening.arriving import SINGLE_VIEW_WINDOW_S, Arrivals, usual_length
from .screening.consensus import ConsensusSchedule, consensus_weights
from .screening.disagreement import Disagreement
from .screening.first_ground import has_one_view
from .screening.sigma_check import SigmaCheck
from .screening.snooping import reweigh, snoop
from .state.batch import Batch
from .state.lens_sets import lens_of
from .state.network import LiveNetwork
from .state.points import ControlPoint
from .state.relinearisation import Relinearisation
from .state.strip import WindowStrip, segment_length

#: Unknowns become present so long before a time needs them, s.
AHEAD_S = 1.0
#: They do not so long after the newest pose, s: what is said to be now may be wrong, and unknowns for all of a time
#: without poses would take the memory and the time of the others.
UNKNOWNS_AHEAD_S = 60.0
#: So long after its last look a point is in the window, s; later it is late.
USUAL_DELAY_S = 2.0
#: Where a strip of a camera with one view has earlier ones to be tied to, the window waits for looks that come late as
#: long as so many lines take, but no longer than so many seconds: a matcher looks for the first places of such a strip
#: in a wide search, with that many lines around them, which is long where few lines a second come. Tuned: with 80 px of
#: reach a strip was found within 320 lines; the seconds bound the work of an update.
WAITED_LINES, MOST_WAITED_S = 400, 60.0
#: A solution that turns the measured attitude by more, rad, beside so many times what is stated of its slow errors, has
#: diverged: no attitude is measured so badly, and equations that are linear in its correction hold no more. Tuned:
#: where a quarter of the looks is wrong it went from 5 to 60 deg in three seconds, and did not come back.
MOST_TURNED, STATED_COUNTS = 0.5, 5.0
#: Rays tested again in one update at most, if there is more than one batch.
MOST_RETESTED = 100
#: Time between two looks at what corrections leave of the noise of poses, s.
LEARNT_S = 2.0
#: Updates that follow each other faster than this, s, share the work that can wait: each does one part of it.
HURRIED_S = 0.1
#: Parts of the work that can wait: linearise what has moved, question the sigmas, test old batches again, judge the
#: quality, test sources of tie points for drifts.
LOOK_AFTER, QUESTION, RETEST, WATCH, SOURCES = "look after", "question", "retest", "watch", "sources"
#: Time between two turns of each part, s; it is done in the first update after that. Tuned: a drift of tie
#: points that matters takes more than a second to grow.
TURN_S = {LOOK_AFTER: 0.1, QUESTION: 1.0, RETEST: 0.1, WATCH: 0.3, SOURCES: 1.0}
#: Where an update comes late and what was found has changed sigmas, they are questioned again, as often as updates in
#: quick succession would have done it, but no more than this.
MOST_QUESTIONS = 5
#: An update that has other work to do leaves a part to the next one unless it is overdue by more than this share of the
#: time between its turns.
PUT_OFF = 1.0
_SMALL_S = 1e-6


class Duties:
    """Shares out work that can wait among the updates, by platform time, so that results do not depend on how many
    updates a second there are.

    Attributes
    ----------
    turns : of each part, how many turns have passed since it was done, when it was taken last; 1 at first
    """

    def __init__(self) -> None:
        self._now_s = float("-inf")
        self._done_s = dict.fromkeys(TURN_S, float("-inf"))
        self.turns: dict[str, int] = dict.fromkeys(TURN_S, 1)

    def take(self, now_s: float, busy: bool = False) -> set[str]:
        """The parts that an update does.

        Parameters
        ----------
        now_s : platform time of the update
        busy : it has other work that does not come with every update
        """
        hurried = now_s - self._now_s < HURRIED_S
        self._now_s = max(self._now_s, now_s)
        late = {part: (now_s - done_s) / TURN_S[part] - 1.0 for part, done_s in self._done_s.items()}
        due = {part for part, share in late.items() if share >= -_SMALL_S}
        if hurried and due:
            most = max(TURN_S, key=lambda part: late[part])
            due = set() if busy and late[most] < PUT_OFF else {most}
        for part in due:
            self.turns[part] = 1 + max(int(late[part] + _SMALL_S), 0) if np.isfinite(late[part]) else 1
            self._done_s[part] = now_s
        return due


class Window:
    """The window; see the module.

    Parameters
    ----------
    camera : line camera
    slow : a-priori slow errors of the measured trajectory
    options : settings
    self_calibration : additional parameters to estimate all along
    platform : constant errors of the platform that are unknowns, with what is known of them beforehand
    surface : on which tie points lie, for example a digital elevation model; None for none

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
        platform: PlatformErrors = NO_PLATFORM_ERRORS,
        surface: SurfaceControl | None = None,
    ):
        self.camera, self.slow, self.options = camera, slow, options
        network = self.network = LiveNetwork(camera, self_calibration, platform, surface)
        self.trajectory, self.state, self.strips = network.trajectory, network.state, network.strips
        self._block = Block(network)
        step_s = segment_length(slow, options)
        self._disagreement = Disagreement(network.sigmas)
        self._sigma_check = SigmaCheck(network, self._disagreement, constants=options.datum == "control")
        self._arrivals = Arrivals(network, self._block, self._disagreement, step_s, options.snoop)
        self._relinearisation = Relinearisation(network, step_s)
        self._consensus = ConsensusSchedule()
        self._sources = DriftMonitor(network, follows=options.follows_wander)
        self._control = ControlTests(network, self._sources, options.critical, options.datum)
        self._surface = SurfaceTests(network, options.critical)
        self._quality = QualityControl(network, self._control, options, self._surface)
        self._orientation = OrientationOutput(network, self._sources)
        self._leaving = Leaving(options, network, self._block, self._control, self._quality, self._orientation)
        self._history = CostHistory()
        self._duties = Duties()
        self._length_s = options.window_s
        self._now_s = self._newest_ray_s = self._learnt_s = -np.inf
        self._number = 0

    # -- input ---------------------------------------------------------------------------------------------------------

    @property
    def length_s(self) -> float:
        """Length of the window; 0 while it is not known yet."""
        return self._length_s

    @property
    def in_doubt(self) -> bool:
        """Whether new looks disagree more than the sigmas say or are too few to tell, or sigmas are just changing."""
        return self.options.snoop and (self._disagreement.in_doubt or not self._sigma_check.settled(self._now_s))

    def begin_strip(
        self,
        id: str,
        first_line_time_s: float,
        line_rate_hz: float,
        lines: int = 0,
        slow: SlowErrors | None = None,
        joined_s: float = -np.inf,
    ) -> None:
        """A strip begins.

        Parameters
        ----------
        id : its name
        first_line_time_s : platform time of its first line, s
        line_rate_hz : lines a second
        lines : how many there are; 0 while that is not known
        slow : its slow errors, if they are not those of the window
        joined_s : what was flown of it before this platform time is not adjusted: there is no orientation for it

        Raises
        ------
        ValueError : a line rate that is not positive
        """
        if not line_rate_hz > 0:
            raise ValueError(f"strip {id}: line rate {line_rate_hz} Hz, wanted more than 0")
        if id in self.strips:
            return
        self.strips[id] = WindowStrip(
            id, first_line_time_s, line_rate_hz, lines, slow or self.slow, self.options, self.state, joined_s,
            self.network.sigmas.apriori, self.network.sigmas.attitude_at_most_s, self.network.platform,
        )  # fmt: skip
        self._block.begin(self.strips[id])

    def end_strip(self, id: str, lines: int = 0, end_s: float | None = None) -> None:
        """A strip is over; ``lines`` as counted, and when that was, where it is not as its rate says."""
        if id in self.strips:
            self.strips[id].end(lines, end_s)

    def add_control(self, name: str, xyz_l: ArrayLike, sigma_m: ArrayLike, role: str) -> None:
        """Known coordinates of a point.

        Parameters
        ----------
        xyz_l, sigma_m : (3,) local frame, m; infinite sigma where a coordinate is not given
        role : as in the messages; "check" for a point that is compared only

        They may come before or after the point's looks, and after it has become final: then they count in the backward
        pass, and as soon as the strips that saw it are over also for the strip that is flown. What was said of the
        point before counts no more.
        """
        point = ControlPoint(np.asarray(xyz_l, dtype=float), np.asarray(sigma_m, dtype=float), role)
        old, counts = self.network.intake.control.get(name), self._block.knows(name)
        changed = old is None or not old.says(point)
        if changed:
            self._control.restated(name)
            self._quality.integrity.restated(name)
        if changed if counts else name not in self.network.intake.points:
            self._block.add_control(name, point)
        self.network.intake.add_control(name, point)

    def add_look(self, name: str, look: Look) -> str:
        """A look at a point; returns why it is refused, "" if it is taken."""
        return self.network.intake.add_look(name, look)

    # -- update --------------------------------------------------------------------------------------------------------

    def update(self, now_s: float) -> WindowUpdate:
        """Work in what has arrived, let go what is older than the window.

        Parameters
        ----------
        now_s : platform time, s; one that lies before the last counts as the last

        Raises
        ------
        DivergedError : the solution has left what is plausible; nothing can be done with this window any more
        """
        self._now_s = max(self._now_s, now_s)
        self._number += 1
        result = WindowUpdate(self._now_s, self._number)
        self._extend_strips()
        fresh = self._arrive(result)
        joined = self._relinearisation.replace_filtered()
        duties = self._duties.take(self._now_s, busy=bool(joined))
        if LOOK_AFTER in duties:
            self._relinearisation.look_after(self._now_s)
        iterations = self._solve(fresh) + self._weigh_surface(fresh + joined, RETEST in duties, result)
        if self.options.snoop:
            # what leaves is tested once more in this update
            self.state.expect([batch.columns for batch in self.network.batches.older_than(self._limit_s())])
            iterations += self._question_sigmas(QUESTION in duties, result)
            due = joined or (self._due_for_test() if RETEST in duties else [])
            iterations += self._screen(fresh, fresh + due, result)
            iterations += self._weigh_control(fresh, result)
        self._refuse_nonsense(fresh)
        self._judge(joined)
        self._learn_noise()
        self._publish(fresh, result)
        self._leaving.let_go(result, self._limit_s(), self._length_s)
        result.report = self._report(iterations, fresh + joined, duties, result)
        return result

    def finish(self) -> WindowUpdate:
        """Everything that is left becomes final.

        The phases of `update` but those that only matter while the flight goes on: no sigma is questioned, no noise is
        learnt, and what leaves is final at once.
        """
        result = WindowUpdate(self._now_s, self._number)
        fresh = self._arrive(result)
        joined = self._relinearisation.replace_filtered(all_at_once=True)
        iterations = self._solve(fresh) + self._weigh_surface(fresh, True, result)
        if self.options.snoop:
            due = joined or self._due_for_test()
            iterations += self._screen(fresh, fresh + due, result) + self._weigh_control(fresh, result)
        self._judge(joined)
        for strip in self.strips.values():
            strip.end(0)
        self._leaving.let_go(result, np.inf, self._length_s, at_the_end=True)
        result.report = self._report(iterations, joined, set(TURN_S), result)
        return result

    # -- the phases of an update ---------------------------------------------------------------------------------------

    def _extend_strips(self) -> None:
        """Unknowns that the strips need by now become present."""
        for strip in self.strips.values():
            if not strip.is_over(self.state):
                known_s = max(self.trajectory.end_s, strip.first_line_time_s) + UNKNOWNS_AHEAD_S
                strip.activate(min(self._now_s + AHEAD_S, strip.end_s + AHEAD_S, known_s), self.state)

    def _arrive(self, result: WindowUpdate) -> list[Batch]:
        """Points with new looks become batches."""
        fresh = self._arrivals.take(result)
        result.tell_alone()
        for batch in fresh:
            self._newest_ray_s = max(self._newest_ray_s, batch.newest_s)
        if not self._length_s and self.strips:
            if has_one_view(self.camera, self.strips):
                self._length_s = SINGLE_VIEW_WINDOW_S
            elif fresh and not any(lens_of(self.camera, id) for id in self.strips):
                self._length_s = usual_length(self.camera, fresh[0], self.options.window_looks)
        return fresh

    def _solve(self, fresh: list[Batch]) -> int:
        """One or two Gauss-Newton steps from the warm state; number of solutions computed."""
        self.state.solve()
        for batch in fresh:
            batch.back_substitute(self.state.values(batch.columns))
        if not self._relinearisation.follow(fresh):
            return 1
        # a third solution has shown no gain, even where control turns the orientation
        self.state.solve()
        return 2

    def _weigh_surface(self, fresh: list[Batch], everything: bool, result: WindowUpdate) -> int:
        """Heights of the surface that points lie on: which count, and whether it agrees; number of solutions
        computed."""
        solutions, change = self._surface.weigh(fresh, everything, result)
        self._block.reweigh_surface(change)
        if solutions:
            self._orientation.forget()
        return solutions

    def _question_sigmas(self, due: bool, result: WindowUpdate) -> int:
        """Variance components, before any look is thrown out; number of solutions computed."""
        solutions = 0
        turns = min(self._duties.turns[QUESTION], MOST_QUESTIONS) if due else 1
        for turn in range(turns):
            of_slow, of_image = self._sigma_check.look(self._now_s, due, turns - turn)
            if of_image:
                self._relinearisation.reweigh()
                self.state.solve()
            solutions += int(of_slow) + int(of_image)
            if of_image or not of_slow:
                break
        result.events += self._sigma_check.take_events()
        if solutions:
            self._orientation.forget()
            self._history.restart()
        return solutions

    def _screen(self, fresh: list[Batch], due: list[Batch], result: WindowUpdate) -> int:
        """Data snooping, and the robust start of a young strip; number of solutions computed."""
        solutions = self._snoop(due, result)
        young = self._consensus.due(self.network.batches, fresh)
        weights = consensus_weights(young, self.state) if young else None
        if weights is not None:
            result.refused += reweigh(young, weights, self.network)
            self._relinearisation.follow(young)
            self.state.solve()
            solutions += self._snoop(young, result) + 2
        return solutions

    def _snoop(self, batches: list[Batch], result: WindowUpdate) -> int:
        """Test batches; number of solutions computed."""
        solutions = snoop(batches, self.network, self._control, self._block, result)
        result.tell_alone()
        return solutions

    def _weigh_control(self, fresh: list[Batch], result: WindowUpdate) -> int:
        """Weigh all control where there is news of it; number of solutions computed."""
        changed = False
        if self._control.is_due(self._now_s, fresh):
            changed, of_final = self._control.weigh(result)
            self._block.reweigh_control(of_final)
        result.warnings += self._control.take_warnings()
        return int(changed)

    def _judge(self, joined: list[Batch]) -> None:
        """Residuals of batches that came about anew, at the solution that this update arrives at."""
        for batch in joined:
            batch.judge(self.state)
        self._orientation.forget()

    def _learn_noise(self) -> None:
        """What the corrections of the strip that is flown leave of the noise of poses, now and then."""
        if self._now_s < self._learnt_s + LEARNT_S or not self.trajectory.noise_time_s:
            return
        strip = next((s for s in reversed(self.strips.values()) if not s.is_over(self.state)), None)
        if strip is None:
            return
        self._learnt_s = self._now_s
        pose_noise = self.network.pose_noise
        for batch in self.network.batches:
            if not (batch.provisional or batch.counted):
                information = ray_information(batch.lin, batch.normals, batch.rays.point, batch.weight)
                pose_noise.count(batch.rays.time_s, information)
                batch.counted = True
        if pose_noise.learn(strip.followed, self._now_s):
            self._relinearisation.reweigh()
            self.state.solve()
            self._orientation.forget()

    def _refuse_nonsense(self, fresh: list[Batch]) -> None:
        """Whether the attitude has been turned by more than any measured one can be wrong.

        Raises
        ------
        DivergedError : it has
        """
        strip = self.strip_at(self._newest_ray_s) if fresh else None
        if strip is None or not self.trajectory.covers([self._newest_ray_s])[0]:
            return
        stated = float(np.linalg.norm(strip.slow.attitude_sigma))
        turn = self._orientation.turn(strip, self._newest_ray_s)
        if turn > MOST_TURNED + STATED_COUNTS * stated:
            raise DivergedError(f"the solution turns the measured attitude by {np.degrees(turn):.0f} deg")

    def _publish(self, fresh: list[Batch], result: WindowUpdate) -> None:
        """The points of new batches, as they come out at once."""
        for batch in fresh:
            result.points += self._orientation.points_of(batch, final=False)

    def _limit_s(self) -> float:
        """What is older leaves. Where looks come late, as the first ones of a matcher that has to find its way, the
        window waits for their partners."""
        if not self._length_s:
            return -np.inf
        late_s = self._now_s - self._newest_ray_s - USUAL_DELAY_S
        return self._now_s - self._length_s - min(max(late_s, 0.0), self._longest_wait_s())

    def _longest_wait_s(self) -> float:
        """How long the window waits for looks that come late: its own length, or what some lines take; see
        `WAITED_LINES`."""
        if len(self.strips) < 2 or not has_one_view(self.camera, self.strips):
            return self._length_s
        newest = next(reversed(self.strips.values()))
        return max(self._length_s, min(WAITED_LINES / newest.line_rate_hz, MOST_WAITED_S))

    def _due_for_test(self) -> list[Batch]:
        """Batches tested longest ago; the more rays they have, the fewer."""
        first = self._quality.integrity.most_exposed
        tested = [b for b in self.network.batches if b.tested >= 0]
        waiting = nsmallest(self.options.retest, tested, key=lambda b: (b is not first, b.tested))
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
        orientation = self._ahead(strip, np.array([time_s]))
        exposure = self._quality.last.exposure if self._quality.last is not None else None
        return orientation if exposure is None else exposure.protected(orientation)

    def live_between(self, from_s: float, to_s: float) -> list[RefinedOrientation]:
        """Live orientation at the grid times from one (or where it is not final yet) to another, by strip."""
        found = []
        for strip in self.strips.values():
            first_s = max(from_s, strip.final_to_s, strip.first_line_time_s)
            last_s = min(to_s, strip.end_s)
            if first_s >= last_s or strip.is_over(self.state):
                continue
            times = self.options.grid(first_s, last_s)
            times = times[self.trajectory.covers(times)] if len(times) else times
            if len(times):
                found.append(self._quality.protected(strip, self._ahead(strip, times)))
        return found

    def _ahead(self, strip: WindowStrip, times: Array) -> RefinedOrientation:
        """Orientation at times (n,), the last of which may need unknowns that are not present yet."""
        if strip.activate(float(times[-1]), self.state):
            self.state.solve()
            self._orientation.forget()
        return self._orientation.at(strip, times)

    def orientation_at(self, strip: str, times: ArrayLike) -> RefinedOrientation:
        """Orientation at times of a strip, none of them final, that have a measured one."""
        return self._orientation.at(self.strips[strip], np.asarray(times, dtype=float))

    def strip_at(self, time_s: float) -> WindowStrip | None:
        """The strip a time belongs to, if its orientation there is not final."""
        for strip in self.strips.values():
            inside = max(strip.final_to_s, strip.first_line_time_s) <= time_s <= strip.end_s
            if inside and not strip.is_over(self.state):
                return strip
        return None

    def _report(self, iterations: int, changed: list[Batch], duties: set[str], result: WindowUpdate) -> WindowReport:
        """Judge the window as it is now, and count what is in it."""
        state, batches, quality = self.state, self.network.batches, self._quality
        fit = self._fit()
        flown = self.network.flown
        newest = flown[-1] if flown else None
        quality.integrity.note([b for b in changed if b in batches])  # what left at once is no more exposed
        findings, solution = quality.last, state.solution
        look = WATCH in duties or findings is None or findings.strip != (newest.id if newest else "")
        test = SOURCES in duties
        suspicious = test and self._sources.is_suspicious
        wander = self._sigma_check.gain_of_wanders(newest) if suspicious and newest else 0.0
        changed_sources = quality.watch_sources(self._now_s, look, test, wander)
        if look or changed_sources or findings is None:
            noise = self._noise(newest) if newest else np.zeros((6, 6))
            findings = quality.look(self._now_s, self._length_s, fit, noise)
            self._block.drifts = self._sources.named()
        if changed_sources or state.solution != solution:
            self._orientation.forget()
        result.events += findings.events
        counts = batches.counts
        unknowns = len(state) + counts.determined
        return WindowReport(
            **vars(fit),
            observations=unknowns + counts.redundancy,
            unknowns=unknowns,
            iterations=iterations,
            start_s=min((s.final_to_s for s in flown), default=self._now_s),
            end_s=self._newest_ray_s,
            rays=counts.rays,
            points=counts.points,
            control=counts.control,
            strip=newest.id if newest else "",
            parameters=parameters(self.network, newest, findings.standing) if newest else (),
            quality=findings,
        )

    def _fit(self) -> Fit:
        """How well observations and sigmas agree over the length of the window, and since the start."""
        state, length = self.state, max(self._length_s, 1.0)
        cost = state.cost()
        sigma0, gained = self._history.over(self._now_s, length, cost, state.redundancy)
        total = float(np.sqrt(cost / state.redundancy)) if state.redundancy > 0 else float("nan")
        return Fit(sigma0, gained, total, state.redundancy)

    def _noise(self, strip: WindowStrip) -> Array:
        """Covariance (6, 6) of the noise of its newest orientation; 0 where there is none."""
        times = np.array([min(self._now_s, strip.end_s, self.trajectory.end_s)])
        if not np.isfinite(times[0]) or not self.trajectory.covers(times)[0]:
            return np.zeros((6, 6))
        return self._orientation.noise(strip, times)[0] + of_vibration(self.network.vibrations.since(times))[0]
