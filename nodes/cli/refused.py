"""Inputs of a flight of which nodes could use nothing at all, by what they say of themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

#: What a node is given for one purpose: of each, one message that is of use is enough.
PURPOSES = (("sensor/gnss",), ("sensor/imu", "sensor/attitude"), ("sensor/lines/",), ("observation/tie",))


def refused_inputs(statuses: Mapping[str, Any], nodes: Iterable[str]) -> list[str]:
    """A line for each input of nodes of which they refused every message; none of what did not come."""
    told = []
    for name in nodes:
        status = statuses.get(name)
        if status is None:
            continue
        for topics in PURPOSES:
            rows = [row for row in status.topics if row.topic.startswith(topics)]
            received, refused = (sum(getattr(row, what) for row in rows) for what in ("received", "refused"))
            if received and refused + sum(row.duplicates for row in rows) >= received and refused:
                came = sorted(row.topic for row in rows if row.received)
                what = f"{topics[0]}*" if len(came) > 1 and len(topics) == 1 else " and ".join(came)
                told.append(f"{name} used none of the {received} messages on {what}{_why(status, topics)}")
    return told


def _why(status: Any, topics: tuple[str, ...]) -> str:
    """The last problem of what was refused most often of these topics, else the last one that the node had."""
    named = [c for c in status.counters if any(topic in c.last_problem for topic in topics)]
    if not named:
        return f": {status.last_problem}" if status.last_problem else ""
    most = max(named, key=lambda counter: counter.value)
    return f": {most.name}: {most.last_problem}"
