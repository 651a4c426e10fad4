"""Tie point to refined orientation from processor times, for machines that others use as well: see `tie_latency.py`.

Each message comes at its stamp, a tie point is worked on when the next pose has come (which its order takes), and the
adjuster works on one message after another, each for as long as it takes the processor. What the bus adds is not in it.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from pathlib import Path
from typing import Any

import numpy as np

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.garbage_collection import RareCollections
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec


def computed(path: Path, topics: list[str], settings: dict[str, Any], full_s: float, until_s: float) -> dict:
    """Latency of tie points and processor time of updates, of the time from which on the window is full.

    Parameters
    ----------
    topics : that the adjuster gets
    settings : of the adjuster
    full_s, until_s : seconds after the first message
    """
    messages = list(RecordingReader(path).sorted_messages(topics))
    begin_ns = messages[0].stamp_ns
    poses_ns = [m.stamp_ns for m in messages if m.topic == "trajectory/filtered"]
    adjuster = Adjuster(**settings)
    RareCollections()
    published: dict[str, float] = {}
    solved: list[str] = []
    latency, steps = [], []
    free_s = 0.0  # when the adjuster has done what came before
    for message in messages:
        come_s = ready_s = (message.stamp_ns - begin_ns) * 1e-9
        if come_s > until_s:
            break
        if message.topic == "observation/tie":
            after = bisect_right(poses_ns, message.stamp_ns)
            ready_s = (poses_ns[min(after, len(poses_ns) - 1)] - begin_ns) * 1e-9
            published.setdefault(message.body.point, come_s)
        data = codec.encode(message.body)
        begun = time.process_time()
        codec.decode(message.topic, data)
        outputs = list(adjuster.step(message))
        for output in outputs:
            codec.encode(output.body)
        took_s = time.process_time() - begun
        free_s = max(ready_s, free_s) + took_s
        for output in outputs:
            if output.topic == "point/object":
                solved.append(output.body.point)
            elif output.topic == "orientation/live":
                then = [published.pop(name) for name in solved if name in published]
                latency += [free_s - t for t in then if t > full_s]
                solved.clear()
            elif output.topic == "adjustment/report" and come_s > full_s:
                steps.append(took_s)
    ms = 1e3 * np.percentile(latency, [50, 90, 99, 100])
    names = ("p50_ms", "p90_ms", "p99_ms", "max_ms")
    return {
        "tie points": len(latency),
        **{name: round(float(value), 1) for name, value in zip(names, ms, strict=True)},
        "update processor time p50, p99, ms": (1e3 * np.percentile(steps, [50, 99])).round(1).tolist(),
        "updates a second": round(len(steps) / (until_s - full_s), 1),
        "share of a core": round(sum(steps) / (until_s - full_s), 2),
    }
