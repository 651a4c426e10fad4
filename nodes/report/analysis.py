"""The analysis of a recording: all numbers that a report shows."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from ...schemas import topics
from ...solver.window.quality.determinability import ESTIMATED
from .. import convert
from ..formats.json_text import plain
from ..recording.summary import Holdings, TopicSummary
from .evaluation import evaluate_flight
from .flight import Flight, updates_with_new_rays
from .integrity import integrity
from .source import WANTED
from .tracks import tracks

_LARGEST_REJECTED = 200


def analyse(flight: Flight, held: Holdings) -> dict[str, Any]:
    """Numbers of the report.

    Parameters
    ----------
    flight : the contents of its messages
    held : counts and times of what the recording holds, see `recording.summary.holdings`

    Returns
    -------
    the result of `evaluate_flight`, and ``recording`` (file, bytes, start, seconds, messages, project, camera, strips),
    ``damage`` (one line each), ``not_used`` (messages that nodes did not use, a line a topic), ``topics`` (messages,
    rate, gaps, unusable, by topic), ``nodes`` (newest status), ``parameters`` (of the newest report that has any),
    ``rejected_observations`` (the largest first), ``latency_s`` (median, max), ``integrity`` (see
    `integrity.integrity`; absent where no report has a light), ``tracks`` (see `tracks.tracks`), ``events``
    """
    result: dict[str, Any] = {"recording": _recording(flight, held), "damage": held.damage, "not_used": flight.not_used}
    result |= evaluate_flight(flight)
    result["topics"] = {
        row.topic: {
            "messages": row.messages,
            "rate_hz": row.rate_hz,
            "gaps": row.gaps,
            "unusable": _unusable(flight, row),
        }
        for row in held.topics
    }
    result["nodes"] = {name: _node(status) for name, status in sorted(flight.status.items())}
    newest = next((r for _, r in reversed(flight.reports) if r.parameters), None)
    since = _estimated_since(flight)
    result["parameters"] = [] if newest is None else [_parameter(p, since.get(p.name)) for p in newest.parameters]
    ranked = sorted(flight.rejected, key=lambda r: (-abs(r.w), r.point, r.ccd))
    result["rejected_observations"] = [_rejected(r) for r in ranked[:_LARGEST_REJECTED]]
    reports = [r for _, r in flight.reports]
    latency = [r.data_latency_s for r, new in zip(reports, updates_with_new_rays(reports), strict=True) if new]
    if latency:
        result["latency_s"] = {"median": median(latency), "max": max(latency)}
    sound = integrity(flight)
    if sound is not None:
        result["integrity"] = sound
    result["tracks"] = tracks(flight)
    result["events"] = [
        {"time_s": float(flight.seconds(stamp)), "level": _level(body), "node": body.name, "text": body.message}
        for stamp, body in flight.events
    ]
    return plain(result)


def _unusable(flight: Flight, row: TopicSummary) -> int | None:
    """Messages of a topic that could not be decoded or hold no usable value; None for topics that are not decoded."""
    try:
        looked_at = topics.find(row.topic).name in WANTED
    except KeyError:
        looked_at = False
    return row.messages - flight.counts[row.topic] + flight.refused[row.topic] if looked_at else None


def _recording(flight: Flight, held: Holdings) -> dict[str, Any]:
    start = datetime.fromtimestamp((held.span_ns[0] if held.span_ns else flight.start_ns) / convert.SECOND_NS, UTC)
    roles = [convert.role_of(g) for id, g in flight.ground.items() if id not in flight.refused_ground]
    return {
        "file": Path(held.file).name,
        "bytes": held.size_bytes,
        "start": start.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "seconds": held.duration_s,
        "messages": held.messages,
        "project": flight.project.name if flight.project is not None else None,
        "camera": flight.camera.name if flight.camera is not None else None,
        "strips": len(flight.strips),
        "tie_points": len({look.point for look in flight.looks} - flight.ground.keys()),
        "rays": len(flight.looks),
        "control_points": sum(role != "check" for role in roles),
        "check_points": sum(role == "check" for role in roles),
    }


def _node(status: Any) -> dict[str, Any]:
    losses = {
        f"{topic.topic} {kind}": int(getattr(topic, kind))
        for topic in status.topics
        for kind in ("gaps", "duplicates", "late", "malformed", "dropped")
        if getattr(topic, kind)
    }
    counters = {counter.name: int(counter.value) for counter in status.counters}
    last = {counter.name: counter.last_problem for counter in status.counters if counter.last_problem}
    return {
        "state": status.state, "counters": counters | losses,
        "last_problem": status.last_problem, "last_problems": last,
    }  # fmt: skip


def _parameter(p: Any, since_s: float | None) -> dict[str, Any]:
    names = ("name", "unit", "value", "sigma", "t", "status", "reason", "correlation", "partner")
    return {name: getattr(p, name) for name in names} | {"estimated_since_s": since_s}


def _estimated_since(flight: Flight) -> dict[str, float]:
    """Time in the flight, s, from which on each parameter was estimated until the end, by name.

    Parameters that were not estimated at the end are absent.
    """
    since: dict[str, float] = {}
    over: set[str] = set()
    for stamp, report in reversed(flight.reports):
        for p in report.parameters:
            if p.status != ESTIMATED:
                over.add(p.name)
            elif p.name not in over:
                since[p.name] = float(flight.seconds(stamp))
    return since


def _rejected(r: Any) -> dict[str, Any]:
    names = ("point", "strip", "ccd", "line", "sample", "w", "reason", "coordinate")
    return {name: getattr(r, name) for name in names}


def _level(log: Any) -> str:
    return log.DESCRIPTOR.fields_by_name["level"].enum_type.values_by_number[log.level].name.lower()
