"""One voice a topic: configuration, sensors and control belong to the source that spoke first.

Whoever reaches the bus can send in any name. What decides about a flight must not change unseen: a second source of a
topic is named and not used, and neither is another camera or project once the flight has begun, until an operator says
so with a verdict on the topic (``triline confirm TOPIC``). The decision depends on the messages in their order alone,
so `process` comes to the same one as the live run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from ..schemas import topics
from ..schemas.topics import Family
from .node import Message

VERDICT, CONTROL = "observation/verdict", "observation/control"
#: What cannot change in flight without an operator's word.
FIXED = ("configuration/project", "configuration/camera")
_SECOND_NS = 1_000_000_000
#: A program that was started again takes over from the run before it when that one has been silent for so long, s.
SILENT_S = 0.5
#: ... and for so many of its messages.
SILENT_PERIODS = 2.0
#: Why messages are not used of which no operator is told.
AGAIN = "their program was started again, and the run before it may have gone on"
#: What was refused is said again after so long at the earliest, and is an alarm until so long after the last, s.
AGAIN_S, ALARM_S = 10.0, 30.0


@dataclass
class _Voice:
    """Who speaks on a topic (for control: of a point).

    Attributes
    ----------
    source, start : program, and the run of it
    latest_ns : newest stamp
    body : what it said, where that counts
    rival, rival_ns : a later run with earlier stamps that has spoken since this one did, and the first of these stamps
    later : newest of the later runs whose messages were not used
    beside : whether this run has spoken on after a later one had begun: then they are two programs
    """

    source: str
    start: int
    latest_ns: int
    body: Any = None
    rival: int = 0
    rival_ns: int = 0
    later: int = 0
    beside: bool = False


@dataclass(slots=True)
class Heard:
    """What follows from a message.

    Attributes
    ----------
    pass_on : messages that the node is given, none where the message is not used
    alarms : lines for the operator
    notes : lines of what an operator decided
    """

    pass_on: tuple[Message, ...] = ()
    alarms: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass
class _Refused:
    """What is not used on a topic: by whom, since when it was told, the newest message."""

    text: str
    told_ns: int
    latest_ns: int
    message: Message
    count: int = 1
    stays: bool = False


@dataclass
class Voices:
    """Decides which messages a node is given.

    Attributes
    ----------
    refused : messages that were not used, by topic
    """

    refused: dict[str, int] = field(default_factory=dict)
    _voices: dict[tuple[str, str], _Voice] = field(default_factory=dict)
    _held: dict[tuple[str, str], _Refused] = field(default_factory=dict)
    _flying: bool = False
    _chosen: dict[str, str] = field(default_factory=dict)  # topic -> source an operator has named

    def hear(self, message: Message) -> Heard:
        """Whether a message is used, and what an operator has to know of it."""
        if message.topic == VERDICT:
            about_voice = message.body.topic and not message.body.HasField("clock_s")
            return self._verdict(message) if about_voice else Heard((message,))
        family = topics.find(message.topic).family
        if family not in (Family.CONFIGURATION, Family.SENSOR) and message.topic != CONTROL:
            self._flying = self._flying or family is not Family.STATUS
            return Heard((message,))
        self._flying = self._flying or family is Family.SENSOR
        return self._voiced(message, family)

    def chosen(self, topic: str) -> str:
        """The source of a topic that an operator has named; "" where nobody has."""
        return self._chosen.get(topic, "")

    def alarm(self, now_ns: int) -> str:
        """The newest reason for alarm at a platform time; "" without one."""
        if not self._held:
            return ""
        told = [r for r in self._held.values() if r.stays or now_ns - r.latest_ns < ALARM_S * _SECOND_NS]
        return max(told, key=lambda r: r.told_ns).text if told else ""

    def _voiced(self, message: Message, family: Family) -> Heard:
        key = message.topic, message.body.point if message.topic == CONTROL else ""
        keeps = family is not Family.SENSOR  # what it said, to tell saying it again from something else
        voice = self._voices.get(key)
        chosen = self._chosen.get(message.topic)
        if voice is None:
            if chosen not in (None, message.source):
                return self._refuse(key, message, f"an operator chose {chosen!r}")
            self._voices[key] = _Voice(message.source, message.start, message.stamp_ns, message.body if keeps else None)
            return Heard((message,))
        if keeps and _same(message.body, voice.body):
            if message.source == voice.source:
                voice.start = max(voice.start, message.start)
                self._held.pop((message.topic, message.source), None)  # what it began with holds again
            return Heard((message,))
        if message.source != voice.source:
            return self._refuse(key, message, f"{message.topic} belongs to {voice.source!r}")
        if message.start != voice.start and not self._takes_over(message, voice, keeps):
            if message.start > voice.start and not voice.beside:  # as well this program, started again a moment ago
                voice.later = message.start
                self._count(message.topic)
                return Heard()
            return self._refuse(key, message, f"two programs speak as {voice.source!r}")
        if message.topic in FIXED and self._flying:
            return self._hold_change(key, message)
        if message.start != voice.start:
            self._held.pop((message.topic, message.source), None)
        same = message.start == voice.start
        voice.beside, voice.later = same and (voice.beside or voice.later > 0), 0
        voice.latest_ns = max(voice.latest_ns, message.stamp_ns) if same else message.stamp_ns
        voice.start, voice.rival = message.start, 0
        if keeps:
            voice.body = message.body
        return Heard((message,))

    @staticmethod
    def _takes_over(message: Message, voice: _Voice, keeps: bool) -> bool:
        """Whether a program that was started again goes on where the run before it fell silent.

        A run with earlier stamps begins another flight if it speaks for so long and the one before says nothing.
        """
        if message.start < voice.start:
            return False
        if keeps:
            return True
        rate_hz = topics.find(message.topic).rate_hz
        silent_ns = round((SILENT_S + (SILENT_PERIODS / rate_hz if rate_hz else 0.0)) * _SECOND_NS)
        if message.stamp_ns > voice.latest_ns:
            return message.stamp_ns - voice.latest_ns > silent_ns
        if voice.rival != message.start:
            voice.rival, voice.rival_ns = message.start, message.stamp_ns
        return message.stamp_ns - voice.rival_ns > silent_ns

    def _refuse(self, key: tuple[str, str], message: Message, why: str) -> Heard:
        what = f" of {key[1]}" if key[1] else ""
        text = (
            f"{message.topic}{what} also comes from {message.source!r} and is not used: {why}; "
            f"'triline confirm {message.topic} --source {message.source}' changes that"
        )
        if why.startswith("two programs"):
            text = f"{message.topic}{what} comes twice and one is not used: {why}; stop one of them"
        # one alarm a topic and source, whatever number of points it names
        return self._note((message.topic, message.source), message, text, stays=False)

    def _hold_change(self, key: tuple[str, str], message: Message) -> Heard:
        text = (
            f"{message.topic} of {message.source!r} is another one than the flight began with and is not used; "
            f"'triline confirm {message.topic}' changes that"
        )
        held = self._held.get((message.topic, message.source))
        again = held is None or not _same(held.message.body, message.body)
        return self._note((message.topic, message.source), message, text, stays=True, again=again)

    def _note(self, key: tuple[str, str], message: Message, text: str, *, stays: bool, again: bool = False) -> Heard:
        self._count(message.topic)
        voices = (voice.latest_ns for (topic, _), voice in self._voices.items() if topic == message.topic)
        now, held = max(message.stamp_ns, *voices, 0), self._held.get(key)
        if held is None:
            self._held[key] = _Refused(text, now, now, message, stays=stays)
            return Heard(alarms=(text,))
        told = again or abs(now - held.told_ns) >= AGAIN_S * _SECOND_NS
        if not stays:
            again = told
        held.text, held.message, held.stays, held.count = text, message, stays, held.count + 1
        held.latest_ns = max(held.latest_ns, now)
        if not again:
            return Heard()
        held.told_ns = now
        return Heard(alarms=(f"{text} ({held.count} messages)",))

    def _count(self, topic: str) -> None:
        self.refused[topic] = self.refused.get(topic, 0) + 1

    # ---- the operator's word

    def _verdict(self, message: Message) -> Heard:
        """An operator decides about a topic: whose messages count, or that a change is wanted."""
        topic, by = message.body.topic, message.body.by or "an operator"
        waiting = {key: refused for key, refused in self._held.items() if key[0] == topic}
        source = message.body.publisher or next((key[1] for key in reversed(waiting)), "")
        if not source:
            known = any(key[0] == topic for key in self._voices)  # the others do not know what waits there
            return Heard(notes=(f"{topic}: nothing waits for a decision",) if known else ())
        for key in [key for key in waiting if key[1] == source or message.body.accepted]:
            del self._held[key]
        if not message.body.accepted:
            return Heard(notes=(f"{topic} of {source!r} stays refused ({by})",))
        self._chosen[topic] = source
        for key in [key for key, voice in self._voices.items() if key[0] == topic and voice.source != source]:
            del self._voices[key]
        passed: list[Message] = []
        refused = waiting.get((topic, source))
        if refused is not None and topics.find(topic).family is not Family.SENSOR:
            held = refused.message
            now = Message(topic, message.stamp_ns, held.body, held.source, held.sequence, held.start)
            key = topic, held.body.point if topic == CONTROL else ""
            self._voices[key] = _Voice(held.source, held.start, held.stamp_ns, held.body)
            passed.append(now)
        return Heard(tuple(passed), notes=(f"{topic} of {source!r} is used from now on ({by})",))


class RecordedVoices:
    """Which messages of a recording nodes use, for who reads it without running one.

    Attributes
    ----------
    left_out : how many of a topic are not used, and the newest line that says why
    """

    def __init__(self) -> None:
        self._voices = Voices()
        self.left_out: dict[str, tuple[int, str]] = {}

    def used(self, message: Message) -> tuple[Message, ...]:
        """What nodes use because of a message, in the order of `order_key`: itself, nothing, or what an operator's
        verdict lets in."""
        if topics.find(message.topic).family is Family.TRUTH:  # no node that decides hears it
            return (message,)
        heard = self._voices.hear(message)
        if not heard.pass_on and message.topic != VERDICT:
            n, text = self.left_out.get(message.topic, (0, AGAIN))
            self.left_out[message.topic] = n + 1, (heard.alarms or (text,))[-1]
        elif message.topic == VERDICT:  # what it lets in was left out before
            for topic in {used.topic for used in heard.pass_on} & self.left_out.keys():
                n, text = self.left_out.pop(topic)
                if n > 1:
                    self.left_out[topic] = n - 1, text
        return heard.pass_on

    def chosen(self, topic: str) -> str:
        """The source of a topic that an operator has named; "" where nobody has."""
        return self._voices.chosen(topic)

    def all_used(self, messages: Iterable[Message]) -> Iterator[Message]:
        """The same for many messages."""
        for message in messages:
            yield from self.used(message)

    def lines(self) -> list[str]:
        """What is not used, a line a topic."""
        return [f"{topic}: {n} not used by the nodes: {why}" for topic, (n, why) in self.left_out.items()]


def _same(one: Any, other: Any) -> bool:
    return other is not None and one == other


def is_voiced(topic: str) -> bool:
    """Whether a topic (a name of the table) belongs to the source that spoke first."""
    return topics.find(topic).family in (Family.CONFIGURATION, Family.SENSOR) or topic == CONTROL
