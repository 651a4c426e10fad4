"""Strips of the adjuster: begin, wait for a pose that says how good the trajectory is, and follow how good it stays."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from ...solver.models.slow_errors import SlowErrors
from ...solver.models.wander import Wander
from ...solver.window.results import Look
from ...solver.window.window import AHEAD_S, Window
from .poses import PoseBuffer, SlowHistory, least_noise

#: A pose so long before the first line of a strip, s, still says how good the trajectory is there.
NEAR_START_S = 1.0
#: Smoothed poses reach back so far behind the first filtered one, s; where there is none a strip is joined later.
REACHED_BACK_S = 10.0
#: A strip whose end nobody tells is over when there has been no image point of it for so long, s, and another one has
#: begun at least ``LEFT_S`` after the last. Two cameras that image at once begin together; a turn takes longer. Tuned.
SILENT_S, LEFT_S = 30.0, 10.0
#: An image point is refused whose line is imaged only so long after the newest message, s: clocks of programs differ
#: by less. Tuned.
AHEAD_OF_NOW_S = 60.0
#: Why such a point is refused, where it is counted.
NOT_IMAGED = "not imaged yet"
#: What the window says ("" where it takes it) of an image point that shows that its strip goes on.
GOES_ON = "", "too late", "point is final", "duplicate"


class AdjustedStrips:
    """The strips of a flight on their way into the window.

    Parameters
    ----------
    by_poses : weights of slow errors may be larger than what is known beforehand, where the poses say so
    counters : of the node
    smoothed_only : filtered poses say how good the trajectory is, but are not handed over where there are smoothed ones

    Attributes
    ----------
    bodies : strip messages by name
    held_ties : tie points of strips that wait for a pose, with their source
    poses : measured poses since the last hand-over
    events : lines for the operator since they were taken last
    """

    def __init__(self, by_poses: bool, counters: Counter[str], smoothed_only: bool = False) -> None:
        self._by_poses, self._counters = by_poses, counters
        self.bodies: dict[str, Any] = {}
        self.poses = PoseBuffer(known_only=by_poses, smoothed_only=smoothed_only)
        self.held_ties: list[tuple[Any, str]] = []
        self.events: list[str] = []
        self._held: dict[str, Any] = {}
        self._looked: dict[str, float] = {}  # newest line with an image point, of strips that go on
        self._ahead: set[str] = set()  # strips of which an image point has been told that is not imaged yet
        self._slow = SlowHistory()
        self._stated: dict[str, tuple[SlowErrors, SlowErrors]] = {}  # of each strip: of the whole, and now
        self._handed_s = self._used_to_s = -np.inf

    def begin_window(self, window: Window) -> None:
        """A window begins with nothing in it."""
        self._slow = SlowHistory(least_noise(window.camera))
        self._slow.add(-np.inf, window.slow)
        self._stated.clear()
        self._handed_s = self._used_to_s = -np.inf
        self.poses.clear()
        self._held.clear()
        self._looked.clear()
        self._ahead.clear()
        self.held_ties.clear()

    @property
    def any_held(self) -> bool:
        """Whether a strip waits for a pose."""
        return bool(self._held)

    def is_held(self, tie: Any) -> bool:
        """Whether a tie point has a look in a strip that waits."""
        return bool(self._held) and any(image.strip in self._held for image in tie.images)

    def begin(self, body: Any, first_s: float, window: Window) -> None:
        """A strip begins, or ends, or waits for a pose."""
        self._held.pop(body.id, None)
        slow, joined_s = window.slow, -np.inf
        if self._by_poses and body.id not in window.strips:
            covariance = self.poses.covariance_after(first_s - NEAR_START_S)
            if covariance is not None:
                slow = slow.widened(covariance, self.poses.learnt)
            elif not body.ended:
                self._held[body.id] = body
                return
            self._slow.add(first_s, slow)
            late_s = self.poses.first_known_s - first_s
            if REACHED_BACK_S < late_s < np.inf:
                joined_s = self.poses.first_known_s - REACHED_BACK_S
                self.events.append(
                    f"strip {body.id} is joined {late_s:.0f} s after its first line: what was flown before that is "
                    "not adjusted, neither final nor whole"
                )
        known = body.id in window.strips
        window.begin_strip(body.id, first_s, body.line_rate_hz, int(body.lines), slow, joined_s)
        if self._by_poses and not known:  # a strip that the window refused is not followed
            self._stated[body.id] = slow, slow
        if body.ended:
            window.end_strip(body.id, int(body.lines), first_s + body.lines / body.line_rate_hz)

    def add_look(self, name: str, look: Look, now_s: float, window: Window) -> str:
        """Give the window an image point; returns why it is refused, "" if it is taken.

        One that has not been imaged yet is refused: it would wait for its orientation, and keep its strip going.

        Parameters
        ----------
        now_s : platform time of the newest message, s
        """
        strip = window.strips.get(look.strip)
        if strip is None or not strip.contains(look.line):
            return window.add_look(name, look)
        known = np.isfinite(look.time_s)
        ahead_s = (look.time_s if known else strip.first_line_time_s + look.line / strip.line_rate_hz) - now_s
        if ahead_s > AHEAD_OF_NOW_S:
            self._counters[NOT_IMAGED] += 1
            if look.strip not in self._ahead:
                self._ahead.add(look.strip)
                where = f"an image point of {name} in line {look.line:.6g}, which is imaged {ahead_s:.6g} s from now"
                self.events.append(
                    f"strip {look.strip}: {where}, is left out, as are others of the kind; lines count from the first "
                    "of the strip, and a message has the time by which they had been imaged"
                )
            return NOT_IMAGED
        reason = window.add_look(name, look)
        if reason in GOES_ON and not strip.ended:
            imaged = (now_s - strip.first_line_time_s) * strip.line_rate_hz
            self._looked[look.strip] = max(self._looked.get(look.strip, -1.0), min(look.line, imaged))
        return reason

    def end_forgotten(self, now_s: float, window: Window) -> None:
        """End strips whose end nobody has told: as long as one goes on, nothing is made whole, and no strip learns from
        another one."""
        for id, line in list(self._looked.items()):
            strip = window.strips[id]
            if strip.ended:
                del self._looked[id]
                continue
            newest_s = strip.first_line_time_s + line / strip.line_rate_hz
            if now_s < newest_s + SILENT_S:
                continue
            if not any(newest_s + LEFT_S < s.first_line_time_s <= now_s for s in window.strips.values()):
                continue
            # lines behind the last image point may have been seen by one view alone
            lines = int(line + LEFT_S * strip.line_rate_hz) + 1
            body = type(self.bodies[id])()
            body.CopyFrom(self.bodies[id])  # messages are shared with others
            body.lines, body.ended = min(lines, strip.lines) if strip.lines else lines, True
            self.bodies[id] = body
            window.end_strip(id, int(body.lines))
            self._counters["strip end not told"] += 1
            self.events.append(
                f"strip {id}: another one has begun, and nobody has told its end: over since its last image point, "
                f"{newest_s - strip.first_line_time_s:.0f} s after its first line; "
                "what images it has to send configuration/strip with ended"
            )

    def held(self) -> list[Any]:
        """Strips that wait."""
        return list(self._held.values())

    def take_events(self) -> list[str]:
        """Lines for the operator since the last call."""
        events, self.events = self.events, []
        return events

    def use_to(self, time_s: float) -> None:
        """The window is about to be updated: its models are in use for times up to this and a little beyond."""
        self._used_to_s = time_s + AHEAD_S

    def hand_over(self, window: Window) -> int:
        """Give the window the poses that wait; returns how many came twice or too late."""
        if self._stated and self.poses.leading is not None:
            self._follow_covariance(window, *self.poses.leading)
        return sum(window.trajectory.add(*poses) for poses in self.poses.take(self._slow))

    def _follow_covariance(self, window: Window, time_s: float, covariance: Any) -> None:
        """Where the trajectory becomes clearly less certain in the middle of a strip, or certain again, the wander does
        too: while GNSS is out, after the navigator has started again, be that when the strip is over but not final."""
        another, left_out_s = self.poses.started_anew(), -np.inf
        anew = window.slow
        if another and (any(self.poses.learnt) or anew.grown(covariance) is not anew):
            anew = anew.with_taken_back()
        for id, (first, now) in list(self._stated.items()):
            strip = window.strips[id]
            if strip.final_to_s >= strip.end_s:
                del self._stated[id]
                continue
            model, slow = strip.model, (anew if another else first).grown(covariance)
            changed = another or (time_s <= strip.end_s and now.differs(slow))
            if not isinstance(model, Wander) or not changed:
                continue
            if another and self._handed_s < model.extent.start_s and first.grown(covariance) is first:
                continue  # begun with the new filter
            used_s = max(self._handed_s, self._used_to_s, model.borders[0])
            border_s = strip.restate(used_s, slow, another)
            if another:  # of the new filter, what the model still takes for the old one's error is no use
                left_out_s = max(left_out_s, min(border_s, model.extent.end_s, strip.end_s + NEAR_START_S))
                first = anew
            self._stated[id] = first, slow
            if np.isfinite(border_s):
                self._slow.add(border_s, slow)
            self._counters["wander restated"] += 1
        if another:
            self.poses.leave_out(self._handed_s, left_out_s)
        self._handed_s = max(self._handed_s, time_s)
