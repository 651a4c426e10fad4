"""The matcher: image lines and the orientation of now in, tie points out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ...schemas.topics import CONFIGURATION, POSES, find
from ...solver.geometry.rotation import quaternion_multiply
from ...solver.matching.line_times import LineTimes
from ...solver.matching.options import MatchedTie, MatchingOptions
from ...solver.matching.round_earth import above_sphere
from ...solver.matching.strip_matcher import StripMatcher
from ...solver.matching.tie_matcher import TieMatcher
from .. import convert
from ..governor import Announced, Governor
from ..node import Message, Node
from .found_strips import FoundStrips
from .moving_poses import MovingPoses
from .pace import PARTS, WINDOW_S, MatcherPace
from .side_by_side import SideBySide
from .strip_clock import StripClock
from .targets import DoubtfulTargets

DEFAULTS = MatchingOptions()
PACES = ("load", "normal")
#: Observations are stamped so long after what completed them, s: time to make them while the adjuster already goes on.
DELAY_S = 0.8
#: So many places of a strip that came to nothing, without any tie point, are told, and so many when it is over; the
#: counters of those places. Tuned.
PLACES_WITHOUT_TIES, PLACES_AT_END = 60, 20
FAILED = ("too few looks", "looks never came", "contradiction", "ground not found")
#: No ground is lower above the ellipsoid, m, than the shore of the Dead Sea.
LOWEST_GROUND_M = -450.0
#: Platform time between two words on how far the matcher is, ns.
PROGRESS_NS = 40_000_000

#: Quaternions that turn about z by no, one, two and three quarters of a turn, from y to x.
_BACK = np.array([(0.0, 0.0, -np.sin(a), np.cos(a)) for a in 0.25 * np.pi * np.arange(4)])

#: Topics that follow from what the matcher says: they tell nothing of time, and when one comes depends on how a flight
#: ends.
FOLLOW = ("orientation/live", "adjustment/report", "matching/pace")


class Matcher(Node):
    """Runs a `TieMatcher`, or a `StripMatcher` for cameras with several lenses or with one line.

    A tie point is completed by a message: the block of lines with its last look, or the pose that told where that look
    was taken from. A strip that nobody has announced is found from its image lines, and announced. Signalised control
    and check points are measured as well, see `DoubtfulTargets`.

    Parameters
    ----------
    points_per_s, window_rays, window_points, largest_sigma_px, least_score, least_reach_px, largest_reach_px,
    relief_sigma_m, image_sigma_px, least_rays, budget_mb, chips_mb, full_scale : as in `MatchingOptions`
    ground_m : height of the ground about which the search begins, local frame; without it that of control and check
        points with a height; without these it is looked for, first about 0
    delay_s : observations are stamped so long after the message that completed them. The adjuster works them in at
        that time, so they may be so long on their way: live and from a recording it sees them at the same place.
    pace : "load", fewer places where the machine is too slow, and in `process` where it was in flight; "normal", all of
        them, however long it takes
    """

    name = "matcher"
    inputs = (
        *CONFIGURATION,
        "sensor/lines/*",
        *POSES,
        "orientation/live",
        "adjustment/report",
        "observation/control",
        "observation/verdict",
    )
    outputs = ("configuration/strip", "observation/tie", "observation/target", "observation/progress", "event/log")
    decisions = ("matching/pace",)

    def __init__(
        self,
        *,
        points_per_s: float = DEFAULTS.points_per_s,
        window_rays: float = DEFAULTS.window_rays,
        window_points: float = DEFAULTS.window_points,
        largest_sigma_px: float = DEFAULTS.largest_sigma_px,
        least_score: float = DEFAULTS.least_score,
        least_reach_px: float = DEFAULTS.least_reach_px,
        largest_reach_px: float = DEFAULTS.largest_reach_px,
        relief_sigma_m: float = DEFAULTS.relief_sigma_m,
        image_sigma_px: float = DEFAULTS.image_sigma_px,
        least_rays: int = DEFAULTS.least_rays,
        budget_mb: float = DEFAULTS.budget_mb,
        chips_mb: float = DEFAULTS.chips_mb,
        full_scale: int = DEFAULTS.full_scale,
        ground_m: float | None = None,
        delay_s: float = DELAY_S,
        pace: str = "load",
    ) -> None:
        super().__init__()
        if ground_m is not None and not np.isfinite(ground_m):
            raise ValueError(f"ground_m: wanted a height in metres, got {ground_m}")
        if pace not in PACES:
            raise ValueError(f"pace: {pace!r} is not known, wanted one of {', '.join(PACES)}")
        if not 0 <= delay_s <= 10:
            raise ValueError(f"delay_s: wanted 0 to 10, got {delay_s}")
        self.options = MatchingOptions(
            points_per_s=points_per_s, window_rays=window_rays, window_points=window_points, chips_mb=chips_mb,
            largest_sigma_px=largest_sigma_px, least_score=least_score,
            least_reach_px=least_reach_px, largest_reach_px=largest_reach_px, relief_sigma_m=relief_sigma_m,
            image_sigma_px=image_sigma_px, least_rays=least_rays, budget_mb=budget_mb, full_scale=full_scale,
        )  # fmt: skip
        self._targets = DoubtfulTargets()
        self._by_load, self._pace = pace == "load", MatcherPace()
        self._announced: Announced[MatcherPace] = Announced()
        self._governor = Governor(PARTS)
        self._ground_m = ground_m
        self._heights: dict[str, tuple[float, float, float]] = {}  # control and check points with a height
        self._refused: set[str] = set()  # of which an operator said that they do not count
        self._frame_of: Any = None  # the project whose local frame poses and control are in
        self._origin_m = 0.0  # height of the local frame's origin
        self._mounting: tuple[int, np.ndarray] = 0, np.eye(3)  # of the camera, as `convert.mounting_of` tells it
        self._failed = 0  # places of the strip that came to nothing; -1 once a tie is found or it has been told
        self._ground_unknown = False  # when they were counted
        self._delay_ns = round(delay_s * convert.SECOND_NS)
        self._matcher: TieMatcher | StripMatcher | None = None
        self._camera: Any = None
        self._strips: dict[str, Any] = {}
        self._times: dict[str, LineTimes] = {}
        self._found = FoundStrips()
        self._flown = SideBySide()
        self._reference_ns = 0
        self._stamp_ns = self._told_ns = 0
        self._filtered_seen = False
        self._moving = MovingPoses()

    def step(self, message: Message) -> Iterable[Message]:
        if message.source == self.name and message.topic == "configuration/strip":
            return ()
        out: list[Message] = []
        if message.stamp_ns >= self._told_ns + PROGRESS_NS and self._keeps_time(message.topic):
            # all that is older has been worked off; what has the same stamp as this message has not
            self._told_ns = message.stamp_ns
            progress = m.Progress(time_ns=message.stamp_ns - 1)
            out.append(Message("observation/progress", message.stamp_ns - 1 + self._delay_ns, progress))
        if message.topic not in FOLLOW:
            self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        out += self._begin_pace(message.stamp_ns)
        if self._keeps_time(message.topic):
            out += self._ended(self._found.ended(message.stamp_ns))
        try:
            if message.topic.startswith("sensor/lines/") and self._matcher is not None:
                out += self._find_strip(message.body)
            out += self._take(message)
        except ValueError as error:
            self.refuse("malformed", f"{message.topic}: {error}")
        return out

    def finish(self) -> Iterable[Message]:
        out = self._ended(self._found.finish())
        if self._matcher is not None:
            out += self._ties(self._matcher.finish(), "")
        return out + [self._log(text, warning=True) for text in self._strip_over()]

    def behind(self, lag_s: float, now_s: float, busy_s: float) -> Iterable[Message]:
        if self._matcher is None or not self._by_load:
            return ()
        if not self._governor.look(lag_s, now_s, busy_s, self._stamp_ns / convert.SECOND_NS, WINDOW_S):
            return ()
        pace = MatcherPace(self._governor.level, lag_s)
        self._announced.add(self._stamp_ns + 1, pace)
        return [Message("matching/pace", self._stamp_ns, pace.message(self._stamp_ns + 1))]

    def _begin_pace(self, stamp_ns: int) -> list[Message]:
        pace = self._announced.take(stamp_ns)
        if pace is None:
            return []
        self._pace = pace
        if self._matcher is not None:
            self._matcher.keep(pace.share)
        return [self._log(pace.words(), warning=pace.level > 0)]

    @staticmethod
    def _keeps_time(topic: str) -> bool:
        """Whether a message tells how far the flight is."""
        return topic not in FOLLOW and not find(topic).latched

    def state(self) -> str:
        if self._matcher is None:
            return "waiting for configuration/camera"
        return f"running, {self._pace.words()}" if self._pace.level else "running"

    def _take(self, message: Message) -> list[Message]:
        topic, body = message.topic, message.body
        if topic == "configuration/project":
            return self._project_came(body, message.stamp_ns)
        if topic == "configuration/camera":
            return self._configure(body, message.stamp_ns)
        if topic == "configuration/strip":
            convert.check_strip(body, message.stamp_ns)
            self._strips[body.id] = body
            if body.ended and self._matcher is not None:
                return self._ties(self._matcher.end_strip(body.id), body.id)
        elif topic.startswith("sensor/lines/"):
            return self._lines(topic.rpartition("/")[2], body)
        elif topic.startswith("trajectory/"):
            return self._pose(body, topic == "trajectory/smoothed")
        elif topic == "orientation/live":
            self._correction(body)
        elif topic == "adjustment/report" and self._matcher is not None:
            self._matcher.window_holds(int(body.points), int(body.rays))
        elif topic == "matching/pace":
            if self._by_load:
                self._announced.add(body.start_ns, MatcherPace(body.level, body.lag_s))
        elif topic == "observation/control":
            self._targets.ground_point(body)
            if convert.role_of(body) != "planimetric" and np.isfinite(body.z):
                self._heights[body.point] = (float(body.x), float(body.y), float(body.z))
                self._set_ground()
        elif topic == "observation/verdict":
            # those about who speaks on a topic, or its clock, are not the matcher's
            if body.topic:
                return []
            (self._refused.discard if body.accepted else self._refused.add)(body.point)
            if body.point in self._heights:
                self._set_ground()
            return self._targets.verdict(body, self._observed_ns)
        return []

    def _project_came(self, body: Any, stamp_ns: int) -> list[Message]:
        another_frame = self._frame_of is not None and not convert.same_frame(body, self._frame_of)
        mounted, self._mounting = self._mounting, convert.mounting_of(body)
        self._frame_of = body
        self._targets.project(body)
        if np.isfinite(body.origin_height) and body.origin_height != self._origin_m:
            self._origin_m = float(body.origin_height)
            self._set_ground()
        if another_frame:
            self._heights.clear()  # they have to be stated again in the new frame, and poses so far are not in it
            self._targets.forget()
            self._moving.begin()
        elif self._mounting[0] == mounted[0]:
            return []
        return [] if self._camera is None else self._begin(self._camera, stamp_ns)

    def _configure(self, body: Any, stamp_ns: int) -> list[Message]:
        return [] if body == self._camera else self._begin(body, stamp_ns)

    def _begin(self, body: Any, stamp_ns: int) -> list[Message]:
        """Begin, or begin again, with a camera."""
        again = self._matcher is not None
        # matching wants the x axis to go along the flight; of omega, phi and kappa the turn changes kappa alone
        turns, R_fi = self._mounting
        camera = convert.camera_from(body).turned(turns)
        self._camera, self._matcher = body, None
        self._reference_ns = stamp_ns // convert.SECOND_NS * convert.SECOND_NS
        self._times.clear()
        # lines of one lens see the ground in the same strip; several lenses, or one line, in one strip after another
        in_strip = len(camera.lenses) == 1 and len(camera.lines) > 1
        self._matcher = TieMatcher(camera, self.options, R_fi) if in_strip else StripMatcher(camera, self.options)
        self._matcher.keep(self._pace.share)
        self._set_ground()
        self._targets.configure(camera, self._matcher.orientation)
        return [self._log("configuration changed: matching starts again", warning=True)] if again else []

    def _set_ground(self) -> None:
        """What is known of the ground's height before any tie point is."""
        if self._matcher is None or self._matcher.ground_found:
            return
        self._matcher.search_ground(LOWEST_GROUND_M - self._origin_m)
        if self._ground_m is not None:
            self._matcher.set_mean_height(self._ground_m)
        elif counting := [xyz for name, xyz in self._heights.items() if name not in self._refused]:
            known = np.array(counting)
            round_earth = isinstance(self._matcher, StripMatcher)
            heights = [above_sphere(xyz) for xyz in known] if round_earth else known[:, 2]
            self._matcher.set_mean_height(float(np.median(heights)))

    def _without_ties(self, failed: int, ties: int) -> list[str]:
        """A line for the operator where a strip gives no tie points though many places were tried; once a strip.

        While the ground is looked for there are none yet: the line waits until all heights have been tried.
        """
        assert self._matcher is not None
        if ties:
            self._failed = -1
        if self._failed < 0:
            return []
        ground_m = self._matcher.ground_m
        if self._ground_unknown and ground_m is not None:
            self._failed = 0  # just found: places that were given up before tell nothing of it
        self._ground_unknown = ground_m is None
        self._failed += failed
        if ground_m is None and not self._matcher.ground_missing:
            return []
        return self._told_without_ties(ground_m)

    def _strip_over(self) -> list[str]:
        """The same for a strip that has ended."""
        return [] if self._matcher is None else self._told_without_ties(self._matcher.ground_m, PLACES_AT_END)

    def _told_without_ties(self, ground_m: float | None, places: int = PLACES_WITHOUT_TIES) -> list[str]:
        if self._failed < places:
            return []
        assert self._matcher is not None
        strip, tried, self._failed = self._matcher.strip, self._failed, -1
        if ground_m is None and not self._matcher.ground_missing:
            return [
                f"{strip}: no tie point at {tried} places; the strip ended before the ground was looked for at all "
                "heights. If its height is known, give ground_m in [matcher]"
            ]
        if ground_m is None:
            where = "the ground was looked for at all heights and not found: wrong camera, orientation or line times? "
            return [
                f"{strip}: no tie point at {tried} places; {where}If its height is known, give ground_m in [matcher]"
            ]
        return [
            f"{strip}: no tie point at {tried} places; the ground is taken to be at {round(ground_m)} m in the "
            "local frame: if it is not, give ground_m in [matcher]"
        ]

    def _pose(self, body: Any, smoothed: bool) -> list[Message]:
        self._filtered_seen |= not smoothed
        # without a filter (an imported trajectory) the smoothed poses lead
        if self._matcher is None or (smoothed and self._filtered_seen):
            return []
        sample, out = convert.pose_sample(body), list[Message]()
        if sample.covariance is None:
            raise ValueError("pose without covariance")
        if not smoothed:
            if not self._moving.takes(sample):
                self.counters["poses without motion"] += bool(self._matcher.strip)  # before a strip nobody misses them
                return []
            if self._moving.left_out and self._matcher.strip:
                n, why = self._moving.left_out, "the navigator did not know how fast it flies"
                out = [self._log(f"{self._matcher.strip}: {n} poses are left out: {why}", warning=True)]
            self._moving.left_out = 0
        time_s = (sample.time_ns - self._reference_ns) * 1e-9
        turns, quaternion = self._mounting[0], sample.quaternion
        if turns:
            quaternion = quaternion_multiply(quaternion, _BACK[turns])
        if not self._matcher.add_pose(time_s, sample.position_l, quaternion, sample.covariance):
            self.problem("pose out of order", f"pose of {time_s:.3f} s came twice or too late")
        return out

    def _correction(self, body: Any) -> None:
        orientation = None if self._matcher is None else self._matcher.orientation_of(body.strip)
        if orientation is None:
            return
        sample = convert.pose_sample(body)
        if sample.correction is None or sample.covariance is None:
            return
        if sample.correction.shape != (6,) or not np.isfinite(sample.correction).all():
            raise ValueError(f"correction {sample.correction.tolist()}, wanted 6 finite values")
        time_s = (sample.time_ns - self._reference_ns) * 1e-9
        orientation.add_correction(time_s, sample.correction, sample.covariance)

    def _lines(self, ccd: str, block: LineBlock) -> list[Message]:
        matcher = self._matcher
        if matcher is None:
            self.refuse("before configuration", f"sensor/lines/{ccd} came before configuration/camera")
            return []
        if block.ccd and block.ccd != ccd:
            raise ValueError(f"a block of CCD line {block.ccd!r}")
        strip, out = self._strips[block.strip], list[Message]()
        times = self._clock(strip).times
        if block.line_times_ns is not None:
            times.add(int(block.first_line), (block.line_times_ns - self._reference_ns) * 1e-9)
        one_by_one = isinstance(matcher, TieMatcher)
        beside, other = self._flown.lines(block, self._stamp_ns, self._strips)
        if other and (one_by_one or self._targets.some):
            what = "they are left out" if one_by_one else "targets are not looked for in them"
            out.append(self._log(f"{other}: {what}; cameras that look at once want a recording each", warning=True))
        if beside and one_by_one:
            self.counters["lines beside another strip"] += len(block.pixels)
            return out
        if matcher.strip != strip.id:
            out += [self._log(text, warning=True) for text in self._strip_over()]
            matcher.begin_strip(strip.id, times, int(block.first_line))
            self._failed, self._ground_unknown = 0, matcher.ground_m is None
        if self._targets.strip != strip.id and not beside:
            self._targets.begin_strip(self._clock(strip), matcher.orientation)
        if self._pace.blind:
            self.counters["lines gone by"] += len(block.pixels)
            return out
        usable = matcher.add_lines(ccd, int(block.first_line), block.pixels)
        out += self._ties(matcher.match(), strip.id)
        if beside:
            return out
        targets, words = self._targets.lines(ccd, int(block.first_line), block.pixels, self._observed_ns, usable)
        out += targets
        out += [self._log(f"{strip.id}: {text}", warning=True) for text in words]
        self.counters.update(self._targets.take_counters())
        return out

    def _clock(self, strip: Any) -> StripClock:
        """Times of the lines of a strip, which may have begun or not."""
        times = self._times.get(strip.id)
        if times is None:
            first_s = (strip.first_line_time_ns - self._reference_ns) * 1e-9
            times = self._times[strip.id] = LineTimes(first_s, strip.line_rate_hz)
        return StripClock(strip, times, self._reference_ns)

    def _ties(self, ties: list[MatchedTie], strip: str) -> list[Message]:
        """Ties that the lines of a strip gave, and what is to be told of it."""
        matcher = self._matcher
        assert matcher is not None
        out = [self._tie(strip, tie) for tie in ties]
        out += [self._log(f"{strip}: {text}", warning=True) for text in matcher.take_events()]
        failed = sum(matcher.counters[name] for name in FAILED)
        tied = sum(tie.again or len(tie.rays) > 1 for tie in ties)  # else another strip may see its place
        out += [self._log(text, warning=True) for text in self._without_ties(failed, tied)]
        self.counters.update(matcher.counters)
        matcher.counters.clear()
        return out

    def _find_strip(self, block: LineBlock) -> list[Message]:
        """Begin the strip of a block if nobody has announced it, and tell how it goes on."""
        out: list[Message] = []
        if block.strip not in self._strips:
            strip = self._strips[block.strip] = self._found.begin(block)
            out += self._ended(self._found.ended(self._stamp_ns, block))
            out += [self._strip(strip), self._log(f"{strip.id}: nobody announced it, found from its image lines")]
        if self._matcher is not None and len(self._camera.lenses) == 1:  # else strips overlap in time
            for id in self._found.left_open(block.strip, self._stamp_ns):
                if not self._strips[id].ended:
                    out += self._ties(self._matcher.end_strip(id), id)
                    words = f"{id}: lines of {block.strip} come, none of its own do, and nobody has told its end"
                    out.append(self._log(f"{words}: matched as if it were over", warning=True))
        off = self._found.note(block, self._stamp_ns, self._strips[block.strip])
        return out + ([self._log(off, warning=True)] if off else [])

    def _ended(self, strips: list[Any]) -> list[Message]:
        """Strips that were found and are over."""
        out: list[Message] = []
        for strip in strips:
            if self._matcher is not None:
                out += self._ties(self._matcher.end_strip(strip.id), strip.id)
            out.append(self._strip(strip))
        return out

    def _strip(self, strip: Any) -> Message:
        """A strip that was found; stamped as observations are, so that what the matcher says stays in order."""
        return Message("configuration/strip", self._observed_ns, strip)

    def _tie(self, strip_id: str, tie: MatchedTie) -> Message:
        images = []
        for ray in tie.rays:
            strip = self._strips[ray.strip or strip_id]
            images.append(
                {
                    "strip": strip.id,
                    "ccd": ray.ccd,
                    "line": ray.line,
                    "sample": ray.sample,
                    "sigma_line": ray.sigma_line,
                    "sigma_sample": ray.sigma_sample,
                    "time_ns": self._clock(strip).time_ns(ray.line),
                }
            )
        return Message("observation/tie", self._observed_ns, convert.tie_message(tie.name, images))

    @property
    def _observed_ns(self) -> int:
        """Stamp of observations that follow from the newest message."""
        return self._stamp_ns + self._delay_ns

    def _log(self, text: str, warning: bool = False) -> Message:
        return Message("event/log", self._stamp_ns, convert.log_line(self.name, text, self._stamp_ns, warning))
