"""Freezes nodes around the lease of their links, and counts those that hear nothing afterwards.

A publisher sends attitudes at 200 Hz to nodes in processes of their own. Again and again some of them (or the
publisher's session with them) are stopped with SIGSTOP for 4.4 to 5.2 s, in which the links of the bus expire at one
end, at both or at none, and are let go on. Printed for each freeze that left somebody deaf: who, and for how long;
at the end how many freezes there were, how many nodes were deaf ``WAIT_S`` later, how often sessions were opened anew,
and the longest time from SIGCONT until all heard again.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from triline.nodes import convert
from triline.nodes.bus.live import BusRunner
from triline.nodes.bus.program import stop_on_signals
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message, Node
from triline.schemas import codec

#: After so long without hearing the publisher a node that goes on counts as deaf, s.
WAIT_S = 60.0
EPOCH_NS = 1_790_000_000_000_000_000


class Listener(Node):
    inputs = ("sensor/attitude", "event/log")
    outputs = ("event/log",)

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name  # pyrefly: ignore[read-only]  # several of one class

    def step(self, message: Message) -> tuple[()]:
        return ()


def listen(name: str, port: int) -> None:
    """One node, until it is told to stop."""
    stop = threading.Event()
    stop_on_signals(stop)
    with Bus(source=name, port=port) as bus:
        BusRunner(Listener(name), bus, lambda text: print(text, file=sys.stderr), stop=stop).run()


def publish(port: int) -> None:
    """Attitudes at 200 Hz until told to stop."""
    stop = threading.Event()
    stop_on_signals(stop)
    with Bus(source="simulator", port=port) as bus:
        begun, i = time.monotonic(), 0
        while not stop.wait(0.005):
            stamp = EPOCH_NS + round((time.monotonic() - begun) * 1e9)
            body = convert.attitude_message(stamp, (0.1, 0.2, 0.3), (1e-4, 1e-4, 2e-4))
            bus.publish(Message("sensor/attitude", stamp, body))
            i += 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--freezes", type=int, default=20)
    parser.add_argument("--nodes", type=int, default=6)
    parser.add_argument("--least", type=float, default=4.4, help="shortest freeze, s")
    parser.add_argument("--most", type=float, default=5.2, help="longest freeze, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--port", type=int, default=18777)
    parser.add_argument("--role", default="")
    args = parser.parse_args()
    if args.role:
        (publish(args.port) if args.role == "simulator" else listen(args.role, args.port))
        return 0
    return campaign(args)


def campaign(args: argparse.Namespace) -> int:
    rng = random.Random(args.seed)
    names = [f"n{i}" for i in range(args.nodes)]
    command = [sys.executable, __file__, "--port", str(args.port), "--role"]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    programs = {name: subprocess.Popen([*command, name], env=environment) for name in (*names, "simulator")}
    received: dict[str, tuple[int, float]] = {}
    status: dict[str, Any] = {}

    def hear(raw: Any) -> None:
        body = codec.decode(raw.topic, raw.data)
        status[body.node] = body
        for topic in body.topics:
            if topic.topic == "sensor/attitude" and received.get(body.node, (-1, 0))[0] != topic.received:
                received[body.node] = topic.received, time.monotonic()

    def deaf(since: float) -> list[str]:
        return [name for name in names if received.get(name, (0, 0.0))[1] < since]

    failures, worst = 0, 0.0
    try:
        with Bus(source="campaign", port=args.port) as bus:
            bus.subscribe("status/*", hear)
            until = time.monotonic() + 30
            while deaf(1.0) and time.monotonic() < until:
                time.sleep(0.1)
            for turn in range(args.freezes):
                chosen = rng.sample([*names, "simulator"], rng.choice((1, 1, 1, 2, 3)))
                seconds = rng.uniform(args.least, args.most)
                for name in chosen:
                    programs[name].send_signal(signal.SIGSTOP)
                time.sleep(seconds)
                for name in chosen:
                    programs[name].send_signal(signal.SIGCONT)
                moment = time.monotonic() + 1.5
                while deaf(moment) and time.monotonic() < moment + WAIT_S:
                    time.sleep(0.1)
                took = time.monotonic() - moment + 1.5
                left = deaf(moment)
                if left:
                    failures += 1
                    print(f"{turn}: {', '.join(chosen)} frozen for {seconds:.2f} s: {', '.join(left)} deaf", flush=True)
                    for name in left:  # start again, so that the next freeze finds all of them hearing
                        programs[name].kill()
                        programs[name].wait()
                        programs[name] = subprocess.Popen([*command, name], env=environment)
                    again = time.monotonic()
                    while deaf(again) and time.monotonic() < again + 20:
                        time.sleep(0.1)
                else:
                    worst = max(worst, took)
            anew = sum(c.value for s in status.values() for c in s.counters if c.name == "session opened anew")
    finally:
        for program in programs.values():
            program.kill()
            program.wait()
    print(f"{args.freezes} freezes of {args.least:g} to {args.most:g} s: deaf after {failures}; "
          f"{anew} sessions opened anew; all heard again within {worst:.1f} s")  # fmt: skip
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
