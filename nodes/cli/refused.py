"""Inputs of a flight of which nodes could use nothing at all, by what they say of themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from ..monitor.monitor import TopicSums, topic_sums

#: What a node is given for one purpose: of each, one message that is of use is enough.
PURPOSES = (("sensor/gnss",), ("sensor/imu", "sensor/attitude"), ("sensor/lines/",), ("observation/tie",))
#: Counters of messages that are used, or were before.
NOT_REFUSED = ("late", "duplicate")


def refused_inputs(
    statuses: Mapping[str, Any], nodes: Iterable[str], earlier: Mapping[str, TopicSums] | None = None
) -> list[str]:
    """A line for each input of nodes of which they refused every message; none of what did not come.

    Parameters
    ----------
    statuses : the newest of each node
    earlier : what became of messages before a node was started again
    """
    told = []
    for name in nodes:
        status = statuses.get(name)
        if status is None:
            continue
        sums = topic_sums(status) + (earlier or {}).get(name, Counter())
        for topics in PURPOSES:
            own = {key: number for key, number in sums.items() if key[0].startswith(topics)}
            received, refused, twice = (
                sum(number for (_, kind), number in own.items() if kind == what)
                for what in ("received", "refused", "duplicates")
            )
            if received and refused + twice >= received and refused:
                came = sorted(topic for topic, kind in own if kind == "received")
                what = f"{topics[0]}*" if len(came) > 1 and len(topics) == 1 else " and ".join(came)
                told.append(f"{name} used none of the {received} messages on {what}{_why(status, topics)}")
    return told


def _why(status: Any, topics: tuple[str, ...]) -> str:
    """The last problem of what was refused most often of these topics, else the last one that the node had."""
    refusing = (counter for counter in status.counters if counter.name not in NOT_REFUSED)
    named = [c for c in refusing if any(topic in c.last_problem for topic in topics)]
    if not named:
        return f": {status.last_problem}" if status.last_problem else ""
    most = max(named, key=lambda counter: counter.value)
    return f": {most.name}: {most.last_problem}"
