"""Messages of the adjuster from the window's results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..schemas import messages as m
from ..solver.rotation import matrix_from_angles, quaternion_from_matrix
from ..solver.window.results import TAKEN_BACK, AdjustedPoint, RefinedOrientation, Refusal, WindowReport
from . import convert
from .node import Message


def orientations(
    topic: str,
    orientation: RefinedOrientation,
    reference_ns: int,
    stamp_ns: int,
    validity: Callable[[float], tuple[bool, str]],
) -> list[Message]:
    """Pose messages, one a time; ``validity`` says of a time whether its measured pose is to be relied on."""
    quaternion = quaternion_from_matrix(matrix_from_angles(*orientation.angles.T))
    result = []
    for i, time_s in enumerate(orientation.time_s):
        valid, reason = validity(float(time_s))
        body = convert.pose_message(
            reference_ns + round(float(time_s) * convert.SECOND_NS),
            orientation.position_l[i],
            orientation.angles[i],
            orientation.covariance[i],
            quaternion=quaternion[i],
            valid=valid,
            reason=reason,
            strip=orientation.strip,
            correction=orientation.correction[i],
            protection=None if orientation.protection is None else orientation.protection[i],
        )
        result.append(Message(topic, stamp_ns, body))
    return result


def object_point(point: AdjustedPoint, stamp_ns: int) -> Message:
    """An adjusted object point, with the residuals of its looks unless it comes from the backward pass."""
    x, y, z = (float(v) for v in point.xyz_l)
    status = m.ObjectPoint.Status.Value("WHOLE" if point.whole else "FINAL" if point.final else "LIVE")
    body = m.ObjectPoint(
        point=point.name, x=x, y=y, z=z, covariance=point.covariance.ravel().tolist(), rays=point.rays, role=point.role,
        status=status, checked=point.checked,
        residuals=[
            m.RayResidual(
                strip=r.look.strip, ccd=r.look.ccd, line=r.look.line, sample=r.look.sample, v_line=r.v_line,
                v_sample=r.v_sample, w=r.w, rejected=r.rejected,
            )
            for r in (() if point.whole else point.residuals)
        ],
    )  # fmt: skip
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
    watched = figures.watched
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
    body = m.Log(name=node, message=text, level=m.Log.Level.Value("WARNING" if warning else "INFO"))
    convert.set_time(body.timestamp, stamp_ns)
    return Message("event/log", stamp_ns, body)


def _number(value: float) -> float:
    return value if np.isfinite(value) else 0.0
