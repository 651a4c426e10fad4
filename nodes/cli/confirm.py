"""``triline confirm``: a surveyor's verdict on a signalised point, sent to a running system."""

from __future__ import annotations

import argparse
import getpass
import json
import threading
import time
from typing import Any

from ...schemas import codec
from ...schemas import messages as m
from ...schemas.envelope import RawMessage
from ...schemas.topics import Family, find
from ..errors import UserError
from ..node import Message
from .bus_options import add_bus_arguments

EXAMPLE = """triline confirm GCP3 --port 17447
  triline confirm GCP3 --reject"""

#: The verdict takes effect so long after the newest platform time that was heard: everybody has it by then.
AHEAD_NS = 500_000_000
#: Time to hear of ground points and of platform time, and to hear what came of the verdict, s.
LISTEN_S, NOBODY_S, ANSWER_S = 1.0, 4.0, 6.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("point", metavar="POINT", help="name of the ground point")
    parser.add_argument(
        "--reject", action="store_true", help="neither its looks nor its coordinates are used (default: looks are used)"
    )
    parser.add_argument("--by", metavar="NAME", default=_user(), help="who says so (default: %(default)s)")
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from ..bus import Bus

    with Bus(args.platform, source="surveyor", port=args.port, file=args.bus) as bus:
        heard = _Heard(args.point)
        for name in ("status/*", "trajectory/filtered", "observation/control", "observation/target", "event/log"):
            bus.subscribe(name, heard.take)
        bus.prepare(["observation/verdict"])
        _wait(lambda: heard.stamp_ns > 0, NOBODY_S)
        time.sleep(LISTEN_S)
        if not heard.stamp_ns:
            raise UserError(f"nobody speaks on the bus of platform {args.platform}")
        if heard.points and args.point not in heard.points:
            raise UserError(f"{args.point} is no ground point of this flight, there are {_few(heard.points)}")
        verdict = m.Verdict(point=args.point, accepted=not args.reject, by=args.by)
        heard.sent.set()
        bus.publish(Message("observation/verdict", heard.stamp_ns + AHEAD_NS, verdict))
        answered = _wait(lambda: heard.answer != "", ANSWER_S)
    if args.json:
        result = {"point": args.point, "accepted": not args.reject, "answer": heard.answer, "looks": heard.looks}
        print(json.dumps(result, indent=2))
    elif answered:
        print(heard.answer + (f"; {heard.looks} looks that were held" if heard.looks else ""))
    if not answered:
        raise UserError(f"{args.point}: the verdict was sent, but no adjuster answers")
    return 0


class _Heard:
    """What is heard of a point, and of time."""

    def __init__(self, point: str) -> None:
        self._point = point
        self.sent = threading.Event()
        self.stamp_ns = 0
        self.points: set[str] = set()
        self.answer = ""
        self.looks = 0

    def take(self, raw: RawMessage) -> None:
        if find(raw.topic).family is not Family.OBSERVATION:
            self.stamp_ns = max(self.stamp_ns, raw.envelope.stamp_ns)
        if raw.topic.startswith(("status/", "trajectory/")):
            return
        try:
            body: Any = codec.decode(raw.topic, raw.data)
        except ValueError:
            return
        if raw.topic == "observation/control":
            self.points.add(body.point)
        elif not self.sent.is_set():
            return
        elif raw.topic == "event/log" and body.message.startswith(f"{self._point} is "):
            self.answer = body.message
        elif raw.topic == "observation/target" and body.point == self._point:
            self.looks += body.state in (body.CONFIRMED, body.REJECTED)


def _wait(done: Any, seconds: float) -> bool:
    until = time.monotonic() + seconds
    while not done() and time.monotonic() < until:
        time.sleep(0.05)
    return bool(done())


def _few(names: set[str]) -> str:
    shown = sorted(names)
    return ", ".join(shown[:12]) + (f" and {len(shown) - 12} more" if len(shown) > 12 else "")


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "surveyor"
