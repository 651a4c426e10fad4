"""What the adjuster publishes: final and whole orientation, points, the report, and what an operator reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...solver.geometry.rotation import quaternion_from_angles
from ...solver.window.output import WindowReport, WindowUpdate
from ...solver.window.quality.light import kind
from ...solver.window.results import TAKEN_BACK, AdjustedPoint, RefinedOrientation, Refusal
from .. import convert
from ..node import Message
from .pace import Pace
from .poses import OrientationStore, PoseBuffer

#: A reason that has become another one, under a light of the same colour, is told after so long, s.
REASON_S = 10.0
_STATUS = dict(m.ObjectPoint.Status.items())


class AdjusterOutputs:
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

    def begin_window(self, reference_ns: int, another_frame: bool) -> None:
        """Times of a window count from another moment; orientation in another frame is not handed out any more."""
        self.reference_ns = reference_ns
        self._invalid.clear()
        if another_frame:
            self.store = OrientationStore()

    def live(self, orientation: RefinedOrientation, stamp_ns: int) -> list[Message]:
        """Live orientation."""
        return orientations("orientation/live", orientation, self.reference_ns, stamp_ns, self._poses.validity)

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
            messages = orientations("orientation/final", orientation, self.reference_ns, stamp_ns, self._poses.validity)
            self.store.add_final([message.body for message in messages])
            times = zip(orientation.time_s.tolist(), messages, strict=True)
            self._invalid |= {t: message.body.reason for t, message in times if not message.body.valid}
            outputs += messages
        if update.whole is not None:
            for orientation in update.whole.orientation:
                messages = orientations(
                    "orientation/whole", orientation, self.reference_ns, stamp_ns, self._validity_at_end
                )
                self.store.add_whole([message.body for message in messages])
                outputs += messages
        outputs += [object_point(point, stamp_ns) for point in update.points]
        if update.whole is not None:
            outputs += [object_point(point, stamp_ns) for point in update.whole.points]
        if update.report is not None:
            outputs.append(
                report(
                    update.report, refusals, self._rejected_total, self._returned_total, self._updates,
                    self.reference_ns, stamp_ns,
                )
            )  # fmt: skip
            body = outputs[-1].body
            body.update_interval_s = interval_ns / convert.SECOND_NS
            body.kept_share, body.left_out_total = pace.kept, left_out_total
            self._updates += 1
            watched, before = update.report.quality, (self.light[0], self._sources)
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
        return log(self._node, text, stamp_ns, warning)


def orientations(
    topic: str,
    orientation: RefinedOrientation,
    reference_ns: int,
    stamp_ns: int,
    validity: Callable[[float], tuple[bool, str]],
) -> list[Message]:
    """Pose messages, one a time; ``validity`` says of a time whether its measured pose is to be relied on."""
    quaternion = quaternion_from_angles(orientation.angles)
    n, result = len(orientation.time_s), []
    columns = (
        orientation.time_s, orientation.position_l, orientation.angles, orientation.covariance.reshape(n, 36),
        quaternion, orientation.correction,
    )  # fmt: skip
    protection = [None] * n if orientation.protection is None else orientation.protection.tolist()
    for time_s, position, angles, covariance, q, correction, protected in zip(
        *(column.tolist() for column in columns), protection, strict=True
    ):
        valid, reason = validity(time_s)
        body = convert.pose_message(
            reference_ns + round(time_s * convert.SECOND_NS), position, angles, covariance, quaternion=q, valid=valid,
            reason=reason, strip=orientation.strip, correction=correction, protection=protected,
        )  # fmt: skip
        result.append(Message(topic, stamp_ns, body))
    return result


def object_point(point: AdjustedPoint, stamp_ns: int) -> Message:
    """An adjusted object point, with the residuals of its looks unless it comes from the backward pass."""
    x, y, z = point.xyz_l.tolist()
    status = _STATUS["WHOLE" if point.whole else "FINAL" if point.final else "LIVE"]
    body = grouped(m.ObjectPoint)(
        point=point.name, x=x, y=y, z=z, covariance=point.covariance.ravel().tolist(), rays=point.rays, role=point.role,
        status=status, checked=point.checked,
    )  # fmt: skip
    add = body.residuals.add
    for r in () if point.whole else point.residuals:
        look, residual = r.look, add()  # one field after the other is faster than all by name
        residual.strip, residual.ccd, residual.line, residual.sample = look.strip, look.ccd, look.line, look.sample
        residual.v_line, residual.v_sample, residual.w, residual.rejected = r.v_line, r.v_sample, r.w, r.rejected
    return Message("point/object", stamp_ns, body)


def report(
    figures: WindowReport,
    refusals: Sequence[Refusal],
    rejected_total: int,
    returned_total: int,
    number: int,
    reference_ns: int,
    stamp_ns: int,
) -> Message:
    """The report of one update; sigma0 is 0 while there is no redundancy."""

    def at(time_s: float) -> int:
        return reference_ns + round(time_s * convert.SECOND_NS) if np.isfinite(time_s) else 0

    newest = at(figures.end_s)
    watched = figures.quality
    body = m.AdjustmentReport(
        update=number,
        sigma0=_number(figures.sigma0),
        redundancy=figures.redundancy,
        observations=figures.observations,
        unknowns=figures.unknowns,
        iterations=figures.iterations,
        window_start_ns=at(figures.start_s),
        window_end_ns=newest,
        rays=figures.rays,
        points=figures.points,
        control=figures.control,
        data_latency_s=(stamp_ns - newest) / convert.SECOND_NS if newest else 0.0,
        sigma0_total=_number(figures.sigma0_total),
        redundancy_total=figures.redundancy_total,
        rejected_total=rejected_total,
        strip=figures.strip,
        rejected=[_refusal(r) for r in refusals if r.reason != TAKEN_BACK],
        returned=[_refusal(r) for r in refusals if r.reason == TAKEN_BACK],
        returned_total=returned_total,
        parameters=[
            m.ParameterEstimate(
                name=p.name, unit=p.unit, value=p.value, sigma=p.sigma, t=p.t, status=p.status, reason=p.reason,
                correlation=p.correlation, partner=p.partner,
            )
            for p in figures.parameters
        ],
        light=watched.light,
        light_reason=watched.reason,
        sources=[
            m.BiasedSource(
                source=s.source, ccd=s.ccd, line=s.line_px, sample=s.sample_px, line_rate=s.line_px_s,
                sample_rate=s.sample_px_s, test=s.test, limit=s.limit, since_ns=at(s.since_s),
                rivals=[f"{source}/{ccd}" for source, ccd in s.rivals],
            )
            for s in watched.sources
        ],
    )  # fmt: skip
    if watched.exposure is not None:
        body.protection.extend(watched.protection.tolist())
        body.sigma.extend(watched.sigma.tolist())
        body.exposed = watched.exposure.observation
        body.ground_protection.extend(watched.ground_protection_m.tolist())
    body.alert_limit_m = _number(watched.alert_limit_m)
    return Message("adjustment/report", stamp_ns, body)


def _refusal(r: Refusal) -> Any:
    return m.RejectedObservation(
        point=r.point, strip=r.look.strip, ccd=r.look.ccd, line=r.look.line, sample=r.look.sample, w=r.w,
        reason=r.reason, coordinate=r.coordinate, off=r.off_m,
    )  # fmt: skip


def log(node: str, text: str, stamp_ns: int, warning: bool = False) -> Message:
    """A line for the operator."""
    return Message("event/log", stamp_ns, convert.log_line(node, text, stamp_ns, warning))


def _number(value: float) -> float:
    return value if np.isfinite(value) else 0.0
