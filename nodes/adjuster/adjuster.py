"""The adjuster: measured trajectory, tie points and control in; refined orientation, object points and reports out."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import numpy as np

from ...solver.adjustment.surface_control import SurfaceControl
from ...solver.camera.line_camera import finest_pixel
from ...solver.camera.self_calibration import LEFT, SELF_CALIBRATIONS
from ...solver.models.platform import MOST_CLOCK_S, MOST_LEVER_ARM_M, USUAL_PLATFORM, PlatformErrors
from ...solver.window.output import WindowUpdate
from ...solver.window.results import DivergedError, Look, Refusal, WindowOptions
from ...solver.window.window import Window
from .. import convert
from ..errors import UserError
from ..governor import Governor
from ..node import Message, Node
from .elevation import Elevation
from .outputs import AdjusterOutputs, log
from .pace import LOSSLESS, PARTS, Pace, Pacing, pace_message
from .stated_control import StatedControl
from .strips import GOES_ON, NOT_IMAGED, AdjustedStrips

#: Image sigma where neither measurement nor project gives one, px.
DEFAULT_IMAGE_SIGMA_PX = 0.3
APRIORI = ("trajectory", "project")
PACES = ("load", "normal", "throughput")
#: Platform time between updates at the pace for throughput, s, and while sigmas are in doubt there: what is wrong has
#: to be known before the next looks are judged. Tuned: with updates 5 s apart a flight takes a sixth more time, and is
#: no more accurate. In doubt 0.2 s give the same; with 1 s a vibration is found later (ten phases of it, few looks:
#: 0.43 m and a NEES of points of 1.7, in place of 0.40 m and 1.3).
THROUGHPUT_S, IN_DOUBT_S = 10.0, 0.5
#: Where so many image points a second come there is an update as soon as the oldest has waited for ``WAIT_S``, with
#: half of ``update_rays`` at least: waiting for others was the longest part of the time to an answer, and where more
#: come, each update takes more of them instead of following sooner. Tuned with `bench/tie_latency.py --computed`, 500 a
#: second: 99 % of the answers come within 32 ms instead of 44, for a tenth more processor time; with 10 ms a third more
#: gains nothing, and 15 and 20 ms give 34 and 39.
FAST_HZ, WAIT_S = 240.0, 0.012
#: How far the time of a pose can be after the stamp of its message, s: what goes beyond is no flight, and unknowns for
#: all of it would take the memory and the time of the others.
POSE_AHEAD_S = 60.0
#: A strip that has ended and begins so much earlier or later than before, s, has been flown again. Definition.
FLOWN_AGAIN_S = 1.0
#: Length of the window while it is not known, s.
DEFAULT_WINDOW_S = 25.0


class Adjuster(Node):
    """Runs the sliding window.

    The window is updated when the first message comes whose stamp lies beyond the next multiple of ``update_s`` of
    platform time, with what came before it, and as soon as ``update_rays`` new image points wait; where 240 or more
    a second come, as soon as half as many or more have waited for 12 ms. So batches depend on the messages alone. The
    live orientation follows every pose on its grid, and every update for waiting image points.

    Where updates take longer than the data allows, a live adjuster takes larger batches, then leaves out tie points
    (`pace`); it never falls behind by a window.

    Parameters
    ----------
    model : trajectory model: wander, dgr, ppm, lim
    segment_s : longest segment of the model, s; without it a fifteenth of the correlation time of the wander
    window_s, window_looks, grid_hz, settle_s, snoop : as in `WindowOptions`
    update_s : platform time between updates
    update_rays : waiting image points after which an update does not wait for its time
    pace : "load", larger batches and fewer tie points where updates take too long, and in `process` where they did when
        the flight was recorded; "normal", everything at its time, however long it takes; "throughput", for `process`
        of long flights: an update every 10 s with what came till then, each half second while sigmas are in doubt, from
        smoothed poses alone where there are any, and the live orientation with the update
    self_calibration : set of additional parameters, or "none"; "calibrated" is what a calibration leaves open, and more
        where the data contradict it; "focal" the focal length alone
    camera_sigma : what is known of them beforehand, as a share of their usual a-priori sigmas (0.1 mm at the edge of
        the image): 0.03 for a camera that a calibration left half a pixel off
    clock_sigma_s : what is known beforehand of the difference between the clocks of poses and image lines, which is an
        unknown all along; 0 = they agree
    lever_arm_sigma_m : what is known beforehand of each component of the lever arm, an unknown all along; 0 = right
    apriori : what is known beforehand of the slow errors of a strip: "project", what the project says; "trajectory",
        that, and more where the covariance of the pose at the start of the strip is clearly larger. A strip then waits
        for a pose with a known attitude.
    alert_limit_m : what an error on the ground must stay below for the light to be good; 0 = 25 ground sample
        distances, and no more than 2.5 per mille of the height of flight
    datum : "control" or "gnss": whose datum is published where control agrees with itself and differs from GNSS
    dem : raster of heights on which tie points lie; "" for none
    dem_sigma_m, dem_shift_sigma_m : of a height, independent from place to place, and of the error that all heights
        share (0: as large)
    dem_crs : what its heights count from, where it does not say: "ellipsoid", or a vertical CRS
    """

    name = "adjuster"
    inputs = (
        "configuration/project",
        "configuration/camera",
        "configuration/strip",
        "trajectory/filtered",
        "trajectory/smoothed",
        "observation/control",
        "observation/verdict",
        "observation/tie",
        "observation/progress",  # for the order of ties alone
    )
    outputs = (
        "orientation/live",
        "orientation/final",
        "orientation/whole",
        "point/object",
        "adjustment/report",
        "event/log",
    )

    decisions = ("adjustment/pace",)

    def __init__(
        self,
        *,
        model: str = WindowOptions.model,
        segment_s: float | None = None,
        window_s: float = WindowOptions.window_s,
        window_looks: float = WindowOptions.window_looks,
        grid_hz: float = WindowOptions.grid_hz,
        settle_s: float = WindowOptions.settle_s,
        snoop: bool = True,
        update_s: float = 0.2,
        update_rays: int = 12,
        pace: str = "load",
        self_calibration: str = LEFT,
        camera_sigma: float = 1.0,
        clock_sigma_s: float = USUAL_PLATFORM.clock_sigma_s,
        lever_arm_sigma_m: float = USUAL_PLATFORM.lever_arm_sigma_m,
        apriori: str = "trajectory",
        alert_limit_m: float = 0.0,
        datum: str = "control",
        dem: str = "",
        dem_sigma_m: float = 0.0,
        dem_shift_sigma_m: float = 0.0,
        dem_crs: str = "",
    ) -> None:
        super().__init__()
        if not update_s > 0:
            raise ValueError(f"update_s: wanted more than 0, got {update_s}")
        if segment_s is not None and not segment_s > 0:
            raise ValueError(f"segment_s is {segment_s:g}, wanted more than 0 s (leave it out for the default)")
        if not update_rays > 0:
            raise ValueError(f"update_rays: wanted more than 0, got {update_rays}")
        if self_calibration != "none" and self_calibration not in SELF_CALIBRATIONS:
            known = ", ".join(("none", *SELF_CALIBRATIONS))
            raise ValueError(f"self_calibration: {self_calibration!r} is not known, wanted one of {known}")
        if not camera_sigma > 0:
            raise ValueError(f"camera_sigma: wanted more than 0, got {camera_sigma}")
        if not 0 <= clock_sigma_s < MOST_CLOCK_S:
            raise ValueError(f"clock_sigma_s: wanted 0 or more, and less than {MOST_CLOCK_S:g} s, got {clock_sigma_s}")
        if not 0 <= lever_arm_sigma_m < MOST_LEVER_ARM_M:
            raise ValueError(
                f"lever_arm_sigma_m: wanted 0 or more, and less than {MOST_LEVER_ARM_M:g} m, got {lever_arm_sigma_m}"
            )
        if pace not in PACES:
            raise ValueError(f"pace: {pace!r} is not known, wanted one of {', '.join(PACES)}")
        if apriori not in APRIORI:
            raise ValueError(f"apriori: {apriori!r} is not known, wanted one of {', '.join(APRIORI)}")
        self.options = WindowOptions(
            model=model, segment_s=segment_s or 0.0, window_s=window_s, window_looks=window_looks, grid_hz=grid_hz,
            settle_s=settle_s, snoop=snoop, alert_limit_m=alert_limit_m, datum=datum,
        )  # fmt: skip
        self._early = pace != "throughput"  # whether answers are wanted early
        self._update_ns = round((update_s if self._early else max(update_s, THROUGHPUT_S)) * convert.SECOND_NS)
        self._in_doubt_ns = round(IN_DOUBT_S * convert.SECOND_NS)
        self._update_rays = update_rays if self._early else sys.maxsize
        self._by_load = pace == "load"
        self._rays_waiting, self._waiting_since_ns = 0, 0
        self._rays_come, self._fast = 0, False  # since the last update on time; whether many came before it
        self._pacing, self._governor = Pacing(), Governor(PARTS, LOSSLESS)
        self._self_calibration, self._camera_sigma = self_calibration, camera_sigma
        self._elevation = Elevation.stated(dem, dem_crs, dem_sigma_m, dem_shift_sigma_m)
        self._platform = PlatformErrors(clock_sigma_s, lever_arm_sigma_m)
        self._window: Window | None = None
        self._project: Any = None
        self._camera: Any = None
        self._control = StatedControl()
        self._reference_ns = 0
        self._next_update_ns: int | None = None
        self._stamp_ns = 0
        self._strips = AdjustedStrips(apriori == "trajectory", self.counters, smoothed_only=not self._early)
        self._poses = self._strips.poses
        self._outputs = AdjusterOutputs(self.name, self.counters, self._poses)
        self._next_live = -np.inf
        self._newest_pose_s: float | None = None

    # -- node ----------------------------------------------------------------------------------------------------------

    def step(self, message: Message) -> Iterable[Message]:
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        outputs = self._begin_pace(message.stamp_ns)
        try:
            outputs += self._update_if_due(message.stamp_ns)
        except DivergedError as error:
            outputs += self._begin_anew(str(error))
        try:
            outputs += self._take(message)
            outputs += self._update_for_waiting(message.stamp_ns)
        except ValueError as error:
            self.refuse("malformed", f"{message.topic}: {error}")
        except DivergedError as error:
            outputs += self._begin_anew(str(error))
        return outputs

    def behind(self, lag_s: float, now_s: float, busy_s: float) -> Iterable[Message]:
        if self._window is None or self._next_update_ns is None or not self._by_load:
            return ()
        waits_s = max(lag_s - self._interval_ns / convert.SECOND_NS, 0.0)  # for an update, none is due before
        flown_s, window_s = self._stamp_ns / convert.SECOND_NS, self._window.length_s or DEFAULT_WINDOW_S
        if not self._governor.look(waits_s, now_s, busy_s, flown_s, window_s):
            return ()
        body = pace_message(self._governor.level, lag_s, max(self._next_update_ns, self._stamp_ns + 1))
        self._pacing.announce(body)
        return [Message("adjustment/pace", self._stamp_ns, body)]

    def finish(self) -> Iterable[Message]:
        if self._window is None:
            return ()
        outputs: list[Message] = []
        if self._early:
            self._hand_over_poses()
            self._take_ties()
        try:
            if not self._early:  # what the smoother still held reaches further than the last update
                outputs += self._update(self._stamp_ns)
            return outputs + self._results(self._window.finish())
        except DivergedError as error:
            return outputs + self._begin_anew(str(error))

    def state(self) -> str:
        if self._window is not None:
            pace = self._pacing.pace
            return f"running, {pace.words(self._update_ns / convert.SECOND_NS)}" if pace.level else "running"
        missing = [n for n, c in (("project", self._project), ("camera", self._camera)) if c is None]
        return "waiting for " + ", ".join(f"configuration/{n}" for n in missing)

    def light(self) -> tuple[str, str]:
        return self._outputs.light if self._window is not None else ("", "")

    def query(self, name: str, parameters: dict[str, str]) -> Message | None:
        """Refined orientation at a time: ``query/orientation?t=..``, seconds (or nanoseconds) since the Unix epoch.

        The best answer for that time: of the whole strip once it is over (the backward pass), else final, else live.
        None for a time without one.
        """
        if name != "orientation":
            return None
        try:
            t = float(parameters.get("t", ""))
        except ValueError:
            self.problem("malformed", f"query/orientation: t={parameters.get('t')!r} is not a time")
            return None
        if not np.isfinite(t):
            return None
        time_ns = int(parameters["t"]) if parameters["t"].isdigit() and t > 1e15 else round(t * convert.SECOND_NS)
        body = self._outputs.store.at(time_ns)
        return None if body is None else Message("query/orientation", self._stamp_ns, body)

    # -- input ---------------------------------------------------------------------------------------------------------

    def _take(self, message: Message) -> list[Message]:
        topic, body = message.topic, message.body
        if topic.startswith("trajectory/"):
            return self._pose(body, topic == "trajectory/smoothed", message.stamp_ns)
        if topic == "observation/tie":
            self._tie_came(body, message.source, message.stamp_ns)
        elif topic == "adjustment/pace":
            if self._by_load:
                self._pacing.announce(body)
        elif topic == "observation/control":
            self._control.take(body, self._window)
        elif topic == "observation/verdict":
            return self._verdict(body)
        elif topic == "configuration/strip":
            return self._strip(body, message.stamp_ns)
        elif topic in ("configuration/project", "configuration/camera"):
            return self._configure(topic, body, message.stamp_ns)
        return []

    def _configure(self, topic: str, body: Any, stamp_ns: int) -> list[Message]:
        another_frame, given_up = False, 0
        if topic == "configuration/project":
            if body == self._project:
                return []
            convert.slow_errors_of(body)
            another_frame = self._project is not None and not convert.same_frame(body, self._project)
            self._project = body
            given_up = self._control.forget() if another_frame else 0
        else:
            if body == self._camera:
                return []
            convert.camera_from(body)
            self._camera = body
        if self._project is None or self._camera is None:
            return []
        again = self._window is not None
        told = self._begin_window(stamp_ns, another_frame)
        if not again:
            return told
        words = "configuration changed: the window starts again"
        if another_frame:
            self.counters["another local frame"] += 1
            words += (
                "; its local frame has another origin or CRS than before, so results from now on do not go with those "
                "before, and control has to be stated in it"
            )
            if given_up:
                words += f" ({given_up} ground points do not count until they are stated again)"
        return [*told, self._log(words, warning=True)]

    def _begin_window(self, stamp_ns: int, another_frame: bool = False) -> list[Message]:
        """A window with nothing in it but the strips and the control that are known; what there is to say of it."""
        self._reference_ns = stamp_ns // convert.SECOND_NS * convert.SECOND_NS
        camera = convert.camera_from(self._camera)
        parameters = None
        if self._self_calibration != "none":
            parameters = SELF_CALIBRATIONS[self._self_calibration](camera).scaled(self._camera_sigma)
        surface, told = self._surface()
        slow = convert.slow_errors_of(self._project)
        if not (self._project.wander_sigma_m or self._project.wander_sigma_deg):
            slow = slow.with_some_wander(finest_pixel(camera))
        self._window = Window(camera, slow, self.options, parameters, self._platform, surface=surface)
        self._strips.begin_window(self._window)
        self._outputs.begin_window(self._reference_ns, another_frame)
        self._next_live, self._newest_pose_s = -np.inf, None
        for strip in self._strips.bodies.values():
            self._begin(strip)
        for point in self._control.bodies.values():
            self._control.take(point, self._window)
        return told

    def _begin_anew(self, why: str) -> list[Message]:
        """The window has diverged: what is final stays, what is not is given up."""
        self.problem("diverged", why)
        words = f"{why}: the window begins anew without what was in it; are many of the tie points or poses wrong?"
        return [*self._begin_window(self._stamp_ns), self._log(words, warning=True)]

    def _surface(self) -> tuple[SurfaceControl | None, list[Message]]:
        """The elevation model that tie points lie on, if there is one, in the frame of the project; what there is to
        say of it."""
        if self._elevation is None:
            return None, []
        try:
            surface = self._elevation.surface(convert.local_frame(self._project))
        except UserError as error:
            self.problem("no heights", str(error))
            return None, [self._log(f"tie points take no heights: {error}", warning=True)]
        said = f"tie points lie on {self._elevation.path.name} +- {surface.sigma_m:g} m"
        return surface, [self._log(f"{said}, all of it +- {surface.shift_sigma_m:g} m")]

    def _strip(self, body: Any, stamp_ns: int) -> list[Message]:
        convert.check_strip(body, stamp_ns)
        known = self._strips.bodies.get(body.id)
        if known is not None and known.ended and body.ended:
            return []
        if known is not None and known.ended:
            later_s = (body.first_line_time_ns - known.first_line_time_ns) / convert.SECOND_NS
            if abs(later_s) > FLOWN_AGAIN_S:
                self.counters["strip flown again"] += 1
                words = f"strip {body.id} has ended and begins once more, {later_s:.0f} s after its first line: what is"
                return [self._log(f"{words} flown now is left out; it wants the name of another strip", warning=True)]
        self._strips.bodies[body.id] = body
        if self._window is None:
            return []
        self._begin(body)
        return [self._log(f"strip {body.id} {'ended' if body.ended else 'began'}")]

    def _begin(self, body: Any) -> None:
        assert self._window is not None
        self._strips.begin(body, self._seconds(body.first_line_time_ns), self._window)

    def _begin_held(self) -> None:
        """Strips that waited for a pose begin if there is one, and get the tie points that came meanwhile."""
        for strip in self._strips.held():
            self._begin(strip)
        if not self._strips.any_held:
            ties, self._strips.held_ties = self._strips.held_ties, []
            for body, source in ties:
                self._tie(body, source, waited=True)

    def _verdict(self, body: Any) -> list[Message]:
        if body.topic:  # about who speaks on a topic, or its clock
            return []
        self._control.judge(body, self._window)
        verdict = "confirmed" if body.accepted else "rejected: its coordinates do not count"
        words = f"{body.point} is {verdict} ({body.by or 'a surveyor'})"
        stated = body.point in self._control
        if not stated:
            words += "; it is no ground point so far, and the verdict counts when it is stated"
        return [self._log(words, warning=not (body.accepted and stated))]

    def _tie_came(self, body: Any, source: str, stamp_ns: int) -> None:
        """Take a tie point, or let it wait for the choice."""
        if self._window is None:
            self.refuse("before configuration", "observation/tie came before configuration/project and camera")
            return
        if not self._rays_waiting:
            self._waiting_since_ns = stamp_ns
        self._rays_waiting += len(body.images)
        self._rays_come += len(body.images)
        if self._pacing.pace.kept < 1.0 and body.point not in self._control:
            self._pacing.waiting.append((body, source))
        else:
            self._tie(body, source)

    def _take_ties(self) -> None:
        """Of the tie points that wait because of the load, take those that tell most."""
        if not self._pacing.waiting:
            return
        rates = {id: s.line_rate_hz for id, s in self._strips.bodies.items()}
        starts = {id: s.first_line_time_ns for id, s in self._strips.bodies.items()}
        pixels = {line.id: len(line.x_mm) for line in self._camera.lines}
        before = self._pacing.left_out_total
        for body, source in self._pacing.take_waiting(rates, starts, pixels):
            self._tie(body, source, waited=True)
        if self._pacing.left_out_total > before:
            self.counters["left out because of the load"] += self._pacing.left_out_total - before

    def _tie(self, body: Any, source: str, waited: bool = False) -> None:
        assert self._window is not None
        if self._strips.is_held(body):
            self._strips.held_ties.append((body, source))
            return
        sigma, now_s = self._project.image_sigma_px or DEFAULT_IMAGE_SIGMA_PX, self._seconds(self._stamp_ns)
        used = False
        for image in body.images:
            look = Look(
                image.strip, image.ccd, image.line, image.sample, image.sigma_line or sigma,
                image.sigma_sample or sigma, source, self._seconds(image.time_ns) if image.time_ns else np.nan,
            )  # fmt: skip
            if body.point:
                reason = self._strips.add_look(body.point, look, now_s, self._window)
                if reason == NOT_IMAGED:
                    self._outputs.refusals.append(Refusal(body.point, look, NOT_IMAGED))
            else:
                reason = "point without a name"
                self._outputs.refusals.append(Refusal("", look, reason))
            used |= reason in GOES_ON
            if reason not in GOES_ON:
                where = f"strip {look.strip!r}, CCD line {look.ccd!r}, line {look.line:.6g}, sample {look.sample:.6g}"
                self.keep_problem(reason, f"observation/tie: point {body.point!r} in {where}")
        if not used and waited:  # for a pose or for the choice: the message of now is of use
            self.refused_later["observation/tie"] += 1
        elif not used:
            self.refusals += 1

    def _pose(self, body: Any, smoothed: bool, stamp_ns: int) -> list[Message]:
        if self._window is None:
            self.refuse("before configuration", "a pose came before configuration/project and camera")
            return []
        pose = convert.plain_pose(body)
        ahead_s = (pose.time_ns - stamp_ns) * 1e-9
        if ahead_s > POSE_AHEAD_S:  # a window that long would not be solved in a day
            raise ValueError(f"pose of a time {ahead_s:g} s after the stamp of its message")
        time_s = self._seconds(pose.time_ns)
        self._poses.add(time_s, pose, smoothed, body.reason)
        if self._strips.any_held:
            self._begin_held()
        if not (smoothed and self._poses.filtered_seen):
            self._newest_pose_s = time_s
        if not self._early:
            return []
        # without a filter (an imported trajectory) the smoothed poses lead
        if smoothed and self._poses.filtered_seen:
            return []
        return self._live(time_s)

    # -- output --------------------------------------------------------------------------------------------------------

    def _live(self, time_s: float, at_once: bool = False) -> list[Message]:
        """Live orientation on the grid up to a pose, or at the time of the pose at once."""
        assert self._window is not None
        hz = self.options.grid_hz
        if at_once:
            due = np.array([time_s])
        elif time_s < self._next_live:
            return []
        else:
            due = self.options.grid(max(self._next_live, time_s - 1.0), time_s + 2e-6 / hz)
            self._next_live = (np.floor(time_s * hz + 1e-6) + 1) / hz - 1e-6
        if not len(due) or self._window.strip_at(time_s) is None:
            return []
        self._hand_over_poses()
        outputs = []
        for t in due:
            orientation = self._window.live(float(t))
            if orientation is not None:
                outputs += self._outputs.live(orientation, self._stamp_ns)
        self._outputs.store.add_live([message.body for message in outputs])
        return outputs

    def _live_since(self) -> list[Message]:
        """Live orientation on the grid up to the newest pose that the window has, since the last one."""
        assert self._window is not None
        begin_s, end_s = self._next_live, self._window.trajectory.end_s
        outputs = []
        for orientation in self._window.live_between(begin_s, end_s):
            outputs += self._outputs.live(orientation, self._stamp_ns)
        self._next_live = max(begin_s, end_s)
        self._outputs.store.add_live([message.body for message in outputs])
        return outputs

    def _update_if_due(self, stamp_ns: int) -> list[Message]:
        if self._window is None:
            return []
        interval = self._interval_ns
        if not self._early and self._window.in_doubt:
            interval = min(interval, self._in_doubt_ns)
        if self._next_update_ns is None:
            self._next_update_ns = (stamp_ns // interval + 1) * interval
        if stamp_ns < self._next_update_ns:
            return []
        now_ns = stamp_ns // interval * interval
        self._next_update_ns = now_ns + interval
        self._fast = self._rays_come * convert.SECOND_NS >= FAST_HZ * interval
        self._rays_come = 0
        return self._update(now_ns)

    def _update_for_waiting(self, stamp_ns: int) -> list[Message]:
        """An update and the live orientation, if enough image points wait."""
        factor = self._pacing.pace.factor
        if self._fast:
            waited_s = (stamp_ns - self._waiting_since_ns) / convert.SECOND_NS
            due = 2 * self._rays_waiting >= self._update_rays * factor and waited_s >= WAIT_S * factor
        else:
            due = self._rays_waiting >= self._update_rays * factor
        if not due or self._pacing.pace.kept < 1.0:
            return []
        outputs = self._update(stamp_ns)
        if self._newest_pose_s is not None:
            outputs += self._live(self._newest_pose_s, at_once=True)
        return outputs

    def _update(self, now_ns: int) -> list[Message]:
        assert self._window is not None
        self._rays_waiting = 0
        self._hand_over_poses()
        now_s = self._seconds(now_ns)
        if not self._early and np.isfinite(self._window.trajectory.end_s):  # its length counts from the newest pose
            now_s = min(now_s, self._window.trajectory.end_s)
        self._strips.use_to(now_s)
        self._take_ties()
        if len(self._camera.lenses) == 1:  # lenses of one scene see it in strips that overlap in time
            self._strips.end_forgotten(now_s, self._window)
        outputs = [self._log(text, warning=True) for text in self._strips.take_events()]
        outputs += [self._log(text) for text in self._control.take_news()]
        outputs += self._results(self._window.update(now_s))
        return outputs if self._early else outputs + self._live_since()

    @property
    def _interval_ns(self) -> int:
        """Platform time between updates at the present pace."""
        return self._update_ns * self._pacing.pace.factor

    def _begin_pace(self, stamp_ns: int) -> list[Message]:
        """Go over to a pace that was announced, and say so."""
        pace: Pace | None = self._pacing.follow(stamp_ns)
        if pace is None:
            return []
        words = pace.words(self._update_ns / convert.SECOND_NS)
        return [self._log(words, warning=pace.level > 0 and not pace.eased)]

    def _hand_over_poses(self) -> None:
        assert self._window is not None
        late = self._strips.hand_over(self._window)
        if late:
            self.problem("pose out of order", f"{late} poses came twice or too late")

    def _results(self, update: WindowUpdate) -> list[Message]:
        pacing = self._pacing
        return self._outputs.results(update, self._stamp_ns, pacing.pace, pacing.left_out_total, self._interval_ns)

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._reference_ns) * 1e-9

    def _log(self, text: str, warning: bool = False) -> Message:
        return log(self.name, text, self._stamp_ns, warning)
