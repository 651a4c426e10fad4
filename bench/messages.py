"""What it costs to read and make messages beside arrays that come and go: one by one, and in groups that share memory.

    python bench/messages.py [--messages 300000] [--megabytes 60]

As in a node that adjusts, arrays are made and let go after every 1000 messages. Once for every 10 000 pieces of memory
that are let go, the protobuf library has all free memory handed back to the system, and the arrays get theirs again
page by page. Both ways in turn, three times, and the least of each; time of a processor, that for the arrays included.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import frame
import numpy as np

from triline.nodes import convert
from triline.schemas import messages as m
from triline.schemas.groups import grouped

EVERY, ROUNDS = 1000, 3
COVARIANCE = [float(i) for i in range(36)]
PAYLOAD = convert.pose_message(10**18, [1.0, 2.0, 3.0], [0.1, 0.2, 0.3], COVARIANCE).SerializeToString()


def made(new: Callable[..., Any]) -> Any:
    """An object point as the adjuster publishes it."""
    body = new(point="p", x=1.0, y=2.0, z=3.0, covariance=COVARIANCE[:9], rays=3)
    for _ in range(3):
        body.residuals.add().v_line = 0.1
    return body


def cost(work: Callable[[], Any], messages: int, megabytes: float) -> tuple[float, float]:
    """Microseconds and page faults a message."""
    size, arrays = 5000, list[np.ndarray]()
    begun, faults = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for i in range(messages):
        work()
        if i % EVERY == 0:
            arrays = [*arrays[-1:], *(np.ones(size) for _ in range(round(megabytes * 1e6 / 8 / size)))]
    used, later = time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    return used / messages * 1e6, (later - faults) / messages


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--messages", type=int, default=300_000, help="of each kind (300000)")
    parser.add_argument("--megabytes", type=float, default=60.0, help="of arrays (60)")
    args = parser.parse_args()
    print("us and page faults a message       one by one       in groups")
    for name, of, work in (
        ("read a pose", m.PoseInFrame, lambda new: lambda: new.from_bytes(PAYLOAD)),
        ("make an object point", m.ObjectPoint, lambda new: partial(made, new)),
    ):
        ways = (partial(of.FromString, PAYLOAD) if "read" in name else partial(made, of), work(grouped(of)))
        runs = [[cost(way, args.messages, args.megabytes) for way in ways] for _ in range(ROUNDS)]
        one, group = (min(run[i] for run in runs) for i in range(2))
        print(f"{name:28} {one[0]:10.2f} {one[1]:6.2f} {group[0]:8.2f} {group[1]:6.2f}")


if __name__ == "__main__":
    main()
