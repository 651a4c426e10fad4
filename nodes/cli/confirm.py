"""``triline confirm``: an operator's verdict on a signalised point or on who speaks on a topic, in a running system."""

from __future__ import annotations

import argparse
import getpass
import threading
import time
from typing import TYPE_CHECKING, Any

from google.protobuf.message import DecodeError

from ...schemas import codec
from ...schemas import messages as m
from ...schemas.envelope import RawMessage
from ...schemas.topics import Family, find
from ..errors import UserError
from ..first_of import first_of
from ..formats.json_text import json_text
from ..node import Message
from ..voices import is_voiced
from .bus_options import add_bus_arguments, bus_of

if TYPE_CHECKING:
    from ..bus.session import Bus

EXAMPLE = """triline confirm GCP3 --port 17447
  triline confirm GCP3 --reject
  triline confirm configuration/camera              # another camera than the flight began with
  triline confirm sensor/gnss --source receiver2    # its messages count from now on
  triline confirm sensor/gnss --clock 0.1           # add 0.1 s to its times from now on"""

#: Largest correction of GNSS times, s, as the navigator takes it.
LARGEST_CLOCK_S = 100.0
#: Longest wait for ground points and platform time, and for the answer to the verdict, s.
LISTEN_S, NOBODY_S, ANSWER_S = 1.0, 4.0, 6.0
#: So much longer for both where nodes live that are not heard: over a full downlink all comes late, s.
SLOW_S = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "point", metavar="POINT", help="name of the ground point, or topic of configuration, sensors or control"
    )
    parser.add_argument("--source", default="", metavar="NAME", help="of the topic (default: what was refused last)")
    parser.add_argument("--clock", type=float, metavar="S", help="of sensor/gnss: seconds to be added to its times")
    parser.add_argument(
        "--reject",
        action="store_true",
        help="of a point use neither its image points nor its coordinates; of a source, nothing",
    )
    parser.add_argument(
        "--by", metavar="NAME", default=_user(), help="name of the person who decides (default: %(default)s)"
    )
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from ..bus.downlink import VERDICT_AHEAD_NS
    from ..bus.session import Bus

    topic = args.point if _is_topic(args.point) else ""
    if args.source and not topic:
        raise UserError(f"--source {args.source}: wanted a topic before it, as in sensor/gnss, not {args.point}")
    if args.clock is not None and (topic != "sensor/gnss" or args.reject or not abs(args.clock) <= LARGEST_CLOCK_S):
        raise UserError(f"--clock {args.clock:g}: wanted sensor/gnss and at most {LARGEST_CLOCK_S:g} s, to be added")
    with Bus(source="surveyor", file=args.bus, **bus_of(args)) as bus:
        heard = _Heard(args.point, not args.reject, args.by)
        for name in ("status/*", "trajectory/filtered", "observation/control", "observation/target", "event/log"):
            bus.subscribe(name, heard.take)
        if args.source:
            bus.subscribe(topic, heard.take_source)
        bus.prepare(["observation/verdict"])
        slow_s = 0.0
        if not _wait(lambda: heard.stamp_ns > 0, NOBODY_S) and bus.alive():
            slow_s = SLOW_S
            _wait(lambda: heard.stamp_ns > 0, slow_s)
        time.sleep(LISTEN_S)
        if not heard.stamp_ns:
            raise UserError(f"no node sends on the bus of platform {bus.platform}")
        if args.source:  # GNSS may come once a second
            _wait(lambda: bool(heard.sources), NOBODY_S + slow_s)
        if not topic and heard.points and args.point not in heard.points:
            raise UserError(f"{args.point} is no ground point of this flight, there are {_few(heard.points)}")
        if args.source and not args.reject and args.source not in heard.sources:
            _refuse_unheard(args.source, topic, heard, bus)
        verdict = m.Verdict(point=args.point, accepted=not args.reject, by=args.by)
        if topic:
            verdict = m.Verdict(topic=topic, publisher=args.source, accepted=not args.reject, by=args.by)
        if args.clock is not None:
            verdict.clock_s = args.clock
        heard.sent.set()
        counts_ns = heard.stamp_ns + VERDICT_AHEAD_NS
        bus.publish(Message("observation/verdict", counts_ns, verdict))
        _wait(lambda: heard.answer != "" or heard.nothing != "", ANSWER_S + slow_s)
        answered = _wait(lambda: heard.answer != "", LISTEN_S if heard.nothing else 0.0)
    if args.json:
        result = {"point": args.point, "accepted": not args.reject, "answer": heard.answer, "looks": heard.looks}
        print(json_text(result))
    elif answered:
        print(heard.answer + (f"; {heard.looks} looks that were held" if heard.looks else ""))
    if answered:
        return 0
    if heard.nothing:
        raise UserError(heard.nothing)
    if heard.stamp_ns <= counts_ns:  # a recorder has the verdict itself as the newest
        raise UserError(f"{args.point}: the verdict was sent, but no data come; it counts when they do")
    raise UserError(f"{args.point}: the verdict was sent, but no {'node' if topic else 'adjuster'} answers")


def _refuse_unheard(source: str, topic: str, heard: _Heard, bus: Bus) -> None:
    """Raise UserError where a source has not spoken on a topic, as far as that can be told.

    On the ground not every topic is heard, and one that is silent now may have been spoken on before: then the recorder
    knows by whom, and nodes whether at all.
    """
    if heard.sources:
        raise UserError(f"--source {source}: does not speak on {topic}; heard {_few(heard.sources)}")
    recorded = _recorded_sources(topic, bus)
    if source in recorded:
        return
    if recorded:
        raise UserError(f"--source {source}: has not spoken on {topic}; recorded {_few(recorded)}")
    if topic not in heard.received:
        raise UserError(f"--source {source}: nobody has spoken on {topic}")


def _recorded_sources(topic: str, bus: Bus) -> set[str]:
    """Who has spoken on a topic, by the recorder; nobody where none answers."""
    from ..bus.downlink import INVENTORY

    try:
        answers = [raw for raw in bus.ask("inventory", NOBODY_S) if raw.topic == INVENTORY]
        streams = [stream for raw in answers for stream in m.Inventory.FromString(bytes(raw.data)).streams]
    except (ValueError, DecodeError):  # it has no disk, or is gone
        return set()
    return {stream.source for stream in streams if stream.topic == topic}


class _Heard:
    """Messages about the point or by whom the topic is spoken on, and the newest platform time.

    Attributes
    ----------
    sources, received : who speaks on the topic, and topics of which nodes have received something
    answer : to the verdict; another desk's about the same is another one
    nothing : a node's word that nothing waits on the topic; another node may know of something
    """

    def __init__(self, point: str, accepted: bool = True, by: str = "") -> None:
        self._point, self._accepted, self._by = point, accepted, by
        self.sent = threading.Event()
        self.stamp_ns = 0
        self.points: set[str] = set()
        self.sources: set[str] = set()
        self.received: set[str] = set()
        self.answer = self.nothing = ""
        self.looks = 0

    def take_source(self, raw: RawMessage) -> None:
        """Who speaks on the topic."""
        self.sources.add(raw.envelope.source)

    def take(self, raw: RawMessage) -> None:
        if find(raw.topic).family is not Family.OBSERVATION:
            self.stamp_ns = max(self.stamp_ns, raw.envelope.stamp_ns)
        if raw.topic.startswith("trajectory/"):
            return
        try:
            body: Any = codec.decode(raw.topic, raw.data)
        except ValueError:
            return
        if raw.topic.startswith("status/"):
            self.received.update(counts.topic for counts in body.topics if counts.received)
        elif raw.topic == "observation/control":
            self.points.add(body.point)
        elif not self.sent.is_set():
            return
        elif raw.topic == "event/log" and self._answers(body.message):
            self.answer = body.message
        elif raw.topic == "event/log" and body.message.startswith(f"{self._point}: nothing waits"):
            self.nothing = body.message
        elif raw.topic == "observation/target" and body.point == self._point:
            self.looks += body.state in (body.CONFIRMED, body.REJECTED)

    def _answers(self, text: str) -> bool:
        """Whether a node's word is about this verdict."""
        if not text.startswith((f"{self._point} is ", f"{self._point} of ")):
            return False
        refused = " is rejected" in text or " stays refused" in text
        return refused is not self._accepted and (not self._by or f"({self._by})" in text)


def _is_topic(name: str) -> bool:
    """Whether a name is a topic that belongs to one source.

    Raises
    ------
    UserError : another topic
    """
    try:
        find(name)
    except KeyError:
        return False
    if not is_voiced(name):
        raise UserError(f"{name}: anybody may speak on it, wanted a topic of configuration, sensors or control")
    return True


def _wait(done: Any, seconds: float) -> bool:
    until = time.monotonic() + seconds
    while not done() and time.monotonic() < until:
        time.sleep(0.05)
    return bool(done())


def _few(names: set[str]) -> str:
    return first_of(sorted(names), 12)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "surveyor"
