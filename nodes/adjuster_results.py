"""What the adjuster tells of an update: final and whole orientation, points, the report, and what an operator reads."""

from __future__ import annotations

from collections import Counter

from ..solver.window.lamp import kind
from ..solver.window.results import TAKEN_BACK, RefinedOrientation, Refusal, WindowUpdate
from . import adjuster_messages as out
from . import convert
from .adjuster_pace import Pace
from .adjuster_poses import OrientationStore, PoseBuffer
from .node import Message

#: A reason that has become another one, under a light of the same colour, is told after so long, s.
REASON_S = 10.0


class Teller:
    """Messages from the window's updates, with the counts that go on from one to the next.

    Parameters
    ----------
    node : name of the node
    counters : of the node
    poses : say whether a measured pose is to be relied on

    Attributes
    ----------
    store : refined orientation for those who ask
    light : the operator's light and its reason
    refusals : what was refused since the last update
    """

    def __init__(self, node: str, counters: Counter[str], poses: PoseBuffer) -> None:
        self._node, self._counters, self._poses = node, counters, poses
        self.store = OrientationStore()
        self.light = ("good", "no strip is flown")
        self.refusals: list[Refusal] = []
        self.reference_ns = 0
        self._invalid: dict[float, str] = {}  # final orientation that is not to be relied on, and why
        self._rejected_total = self._returned_total = 0
        self._updates = 0
        self._sources: frozenset[tuple[str, str]] = frozenset()
        self._told_ns, self._told_kind = 0, ""  # the last word about the light
        self._strip = ""

    def live(self, orientation: RefinedOrientation, stamp_ns: int) -> list[Message]:
        """Live orientation."""
        return out.orientations("orientation/live", orientation, self.reference_ns, stamp_ns, self._poses.validity)

    def results(
        self, update: WindowUpdate, stamp_ns: int, pace: Pace, left_out_total: int, interval_ns: int
    ) -> list[Message]:
        """Messages of an update.

        Parameters
        ----------
        update : of the window
        stamp_ns : of the messages
        pace, left_out_total : in force, and image points left out so far
        interval_ns : platform time between updates
        """
        for refusal in update.refused:
            self._counters["observations rejected" if refusal.reason == "snooping" else refusal.reason] += 1
        refusals, self.refusals = self.refusals + update.refused, []
        back = sum(r.reason == TAKEN_BACK for r in refusals)
        self._returned_total += back
        self._rejected_total += len(refusals) - back
        outputs: list[Message] = []
        for orientation in update.final:
            messages = out.orientations(
                "orientation/final", orientation, self.reference_ns, stamp_ns, self._poses.validity
            )
            self.store.add_final([message.body for message in messages])
            times = zip(orientation.time_s.tolist(), messages, strict=True)
            self._invalid |= {t: message.body.reason for t, message in times if not message.body.valid}
            outputs += messages
        if update.whole is not None:
            for orientation in update.whole.orientation:
                messages = out.orientations(
                    "orientation/whole", orientation, self.reference_ns, stamp_ns, self._validity_at_end
                )
                self.store.add_whole([message.body for message in messages])
                outputs += messages
        outputs += [out.object_point(point, stamp_ns) for point in update.points]
        if update.whole is not None:
            outputs += [out.object_point(point, stamp_ns) for point in update.whole.points]
        if update.report is not None:
            outputs.append(
                out.report(
                    update.report, refusals, self._rejected_total, self._returned_total, self._updates,
                    self.reference_ns, stamp_ns,
                )
            )  # fmt: skip
            body = outputs[-1].body
            body.update_interval_s = interval_ns / convert.SECOND_NS
            body.kept_share, body.left_out_total = pace.kept, left_out_total
            self._updates += 1
            watched, before = update.report.watched, (self.light[0], self._sources)
            self.light, self._sources = (watched.light, watched.reason), watched.names
            other = kind(self.light[1]) != self._told_kind and self.light[0] != "good"
            settled = stamp_ns - self._told_ns >= REASON_S * convert.SECOND_NS
            over, self._strip = self._strip and not update.report.strip, update.report.strip
            if before != (self.light[0], self._sources) or over or (other and settled):
                self._told_ns, self._told_kind = stamp_ns, kind(self.light[1])
                outputs.append(self._log(": ".join(filter(None, self.light)), stamp_ns, self.light[0] != "good"))
        outputs += [self._log(text, stamp_ns, warning=True) for text in update.warnings]
        outputs += [self._log(text, stamp_ns) for text in update.events]
        return outputs

    def _validity_at_end(self, time_s: float) -> tuple[bool, str]:
        """What the final orientation said of a time; a backward pass comes long after its measured poses are gone."""
        reason = self._invalid.get(time_s)
        return reason is None, reason or ""

    def _log(self, text: str, stamp_ns: int, warning: bool = False) -> Message:
        return out.log(self._node, text, stamp_ns, warning)
