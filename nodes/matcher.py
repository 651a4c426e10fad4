"""The matcher: image lines and the orientation of now in, tie points out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..schemas import messages as m
from ..schemas.image_lines import LineBlock
from ..schemas.topics import CONFIGURATION, POSES, find
from ..solver.matching.options import MatchedTie, MatchingOptions
from ..solver.matching.tie_matcher import TieMatcher
from . import convert
from .governor import Announced, Governor
from .matcher_pace import BEHIND_S, CAUGHT_UP_S, DOWN_S, PATIENCE_S, SHARES, WINDOW_S, MatcherPace
from .node import Message, Node
from .target_desk import TargetDesk

DEFAULTS = MatchingOptions()
PACES = ("load", "normal")
#: Observations are stamped so long after what completed them, s: time to make them while the adjuster already goes on.
DELAY_S = 0.8
#: Platform time between two words on how far the matcher is, ns.
PROGRESS_NS = 40_000_000


class Matcher(Node):
    """Runs a `TieMatcher`.

    A tie point is completed by a message: the block of lines with its last look, or the pose that told where that look
    was taken from. Signalised control and check points are measured as well, see `TargetDesk`.

    Parameters
    ----------
    points_per_s, window_rays, window_points, largest_sigma_px, least_score, least_reach_px, largest_reach_px,
    relief_sigma_m, least_rays, budget_mb, chips_mb, full_scale : as in `MatchingOptions`
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
    outputs = ("observation/tie", "observation/target", "observation/progress", "event/log")
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
        least_rays: int = DEFAULTS.least_rays,
        budget_mb: float = DEFAULTS.budget_mb,
        chips_mb: float = DEFAULTS.chips_mb,
        full_scale: int = DEFAULTS.full_scale,
        delay_s: float = DELAY_S,
        pace: str = "load",
    ) -> None:
        super().__init__()
        if pace not in PACES:
            raise ValueError(f"pace: {pace!r} is not known, wanted one of {', '.join(PACES)}")
        if not 0 <= delay_s <= 10:
            raise ValueError(f"delay_s: wanted 0 to 10, got {delay_s}")
        self.options = MatchingOptions(
            points_per_s=points_per_s, window_rays=window_rays, window_points=window_points, chips_mb=chips_mb,
            largest_sigma_px=largest_sigma_px, least_score=least_score,
            least_reach_px=least_reach_px, largest_reach_px=largest_reach_px, relief_sigma_m=relief_sigma_m,
            least_rays=least_rays, budget_mb=budget_mb, full_scale=full_scale,
        )  # fmt: skip
        self._targets = TargetDesk()
        self._by_load, self._pace = pace == "load", MatcherPace()
        self._announced: Announced[MatcherPace] = Announced()
        self._governor = Governor(len(SHARES), BEHIND_S, CAUGHT_UP_S, DOWN_S, PATIENCE_S)
        self._delay_ns = round(delay_s * convert.SECOND_NS)
        self._matcher: TieMatcher | None = None
        self._camera: Any = None
        self._strips: dict[str, Any] = {}
        self._reference_ns = 0
        self._stamp_ns = self._told_ns = 0
        self._filtered_seen = False

    def step(self, message: Message) -> Iterable[Message]:
        out: list[Message] = []
        if message.stamp_ns >= self._told_ns + PROGRESS_NS and self._keeps_time(message.topic):
            # all that is older has been worked off; what has the same stamp as this message has not
            self._told_ns = message.stamp_ns
            progress = m.Progress(time_ns=message.stamp_ns - 1)
            out.append(Message("observation/progress", message.stamp_ns - 1 + self._delay_ns, progress))
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        out += self._begin_pace(message.stamp_ns)
        try:
            out += self._take(message)
        except ValueError as error:
            self.problem("malformed", f"{message.topic}: {error}")
        return out

    def behind(self, lag_s: float, now_s: float) -> Iterable[Message]:
        if self._matcher is None or not self._by_load or not self._governor.look(lag_s, now_s, 0.0, WINDOW_S):
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
        """Whether a message tells how far the flight is; not those of the adjuster, which goes by the matcher."""
        told_by_others = "orientation/live", "adjustment/report", *Matcher.decisions
        return topic not in told_by_others and not find(topic).latched

    def state(self) -> str:
        if self._matcher is None:
            return "waiting for configuration/camera"
        return f"running, {self._pace.words()}" if self._pace.level else "running"

    def _take(self, message: Message) -> list[Message]:
        topic, body = message.topic, message.body
        if topic == "configuration/camera":
            return self._configure(body, message.stamp_ns)
        if topic == "configuration/strip":
            if not body.id or not (np.isfinite(body.line_rate_hz) and body.line_rate_hz > 0):
                raise ValueError(f"strip {body.id!r} with {body.line_rate_hz} lines a second")
            self._strips[body.id] = body
        elif topic.startswith("sensor/lines/"):
            return self._lines(topic.rpartition("/")[2], body)
        elif topic.startswith("trajectory/"):
            self._pose(body, topic == "trajectory/smoothed")
        elif topic == "orientation/live":
            self._correction(body)
        elif topic == "adjustment/report" and self._matcher is not None:
            self._matcher.window_holds(int(body.points), int(body.rays))
        elif topic == "matching/pace":
            if self._by_load:
                self._announced.add(body.start_ns, MatcherPace(body.level, body.lag_s))
        elif topic == "observation/control":
            self._targets.ground_point(body)
        elif topic == "observation/verdict":
            return self._targets.verdict(body, self._observed_ns)
        return []

    def _configure(self, body: Any, stamp_ns: int) -> list[Message]:
        if body == self._camera:
            return []
        again = self._matcher is not None
        camera = convert.camera_from(body)
        self._camera, self._matcher = body, None
        self._reference_ns = stamp_ns // convert.SECOND_NS * convert.SECOND_NS
        self._matcher = TieMatcher(camera, self.options)
        self._matcher.keep(self._pace.share)
        self._targets.configure(camera, self._matcher.orientation)
        return [self._log("configuration changed: matching starts again", warning=True)] if again else []

    def _pose(self, body: Any, smoothed: bool) -> None:
        self._filtered_seen |= not smoothed
        # without a filter (an imported trajectory) the smoothed poses lead
        if self._matcher is None or (smoothed and self._filtered_seen):
            return
        sample = convert.pose_sample(body)
        if sample.covariance is None:
            raise ValueError("pose without covariance")
        time_s = (sample.time_ns - self._reference_ns) * 1e-9
        if not self._matcher.orientation.add_pose(time_s, sample.position_l, sample.quaternion, sample.covariance):
            self.problem("pose out of order", f"pose of {time_s:.3f} s came twice or too late")

    def _correction(self, body: Any) -> None:
        if self._matcher is None or body.strip != self._matcher.strip:
            return
        sample = convert.pose_sample(body)
        if sample.correction is None or sample.covariance is None:
            return
        if sample.correction.shape != (6,) or not np.isfinite(sample.correction).all():
            raise ValueError(f"correction {sample.correction.tolist()}, wanted 6 finite values")
        time_s = (sample.time_ns - self._reference_ns) * 1e-9
        self._matcher.orientation.add_correction(time_s, sample.correction, sample.covariance)

    def _lines(self, ccd: str, block: LineBlock) -> list[Message]:
        matcher = self._matcher
        if matcher is None:
            self.problem("before configuration", f"lines of {ccd} came before configuration/camera")
            return []
        if block.ccd and block.ccd != ccd:
            raise ValueError(f"a block of CCD line {block.ccd!r}")
        strip = self._strips.get(block.strip)
        if strip is None:
            self.problem("unknown strip", f"lines of {ccd} name strip {block.strip!r}")
            return []
        if matcher.strip != strip.id:
            first_s = (strip.first_line_time_ns - self._reference_ns) * 1e-9
            matcher.begin_strip(strip.id, first_s, strip.line_rate_hz)
            self._targets.begin_strip(strip, first_s)
        if self._pace.blind:
            self.counters["lines gone by"] += len(block.pixels)
            return []
        usable = matcher.add_lines(ccd, int(block.first_line), block.pixels)
        ties = matcher.match()
        out = [self._tie(strip, tie) for tie in ties]
        targets, words = self._targets.lines(ccd, int(block.first_line), block.pixels, self._observed_ns, usable)
        out += targets
        out += [self._log(f"{strip.id}: {text}", warning=True) for text in (*matcher.take_events(), *words)]
        self.counters.update(self._targets.take_counters())
        self.counters.update(matcher.counters)
        matcher.counters.clear()
        return out

    def _tie(self, strip: Any, tie: MatchedTie) -> Message:
        period_ns = convert.SECOND_NS / strip.line_rate_hz
        images = [
            {
                "strip": strip.id,
                "ccd": ray.ccd,
                "line": ray.line,
                "sample": ray.sample,
                "sigma_line": ray.sigma_line,
                "sigma_sample": ray.sigma_sample,
                "time_ns": strip.first_line_time_ns + round(ray.line * period_ns),
            }
            for ray in tie.rays
        ]
        return Message("observation/tie", self._observed_ns, convert.tie_message(tie.name, images))

    @property
    def _observed_ns(self) -> int:
        """Stamp of observations that follow from the newest message."""
        return self._stamp_ns + self._delay_ns

    def _log(self, text: str, warning: bool = False) -> Message:
        body = m.Log(name=self.name, message=text, level=3 if warning else 2)
        convert.set_time(body.timestamp, self._stamp_ns)
        return Message("event/log", self._stamp_ns, body)
