"""The player: recorded inputs onto the bus, with the timing they were recorded with."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage
from ...schemas.image_lines import LineBlock
from ...schemas.topics import Family
from .. import registry
from ..bus.pacing import SETTLE_S, Pacer
from ..bus.program import ProgramOptions
from ..convert import iso
from ..errors import UserError
from ..node import Message
from ..recording.reader import RecordingReader
from ..recording.runner import active_nodes, is_remade
from ..recording.summary import time_span_ns
from ..voices import FIXED, VERDICT, RecordedVoices

SECOND_NS = 1_000_000_000
#: Settings of the player beside the recording (``input``), and their defaults.
SETTINGS: dict[str, float | bool | None] = {"rate": 1.0, "from": None, "to": None, "loop": False, "all": False}
#: Between the end of a recording and its next round, platform time.
LOOP_PAUSE_NS = SECOND_NS
STRIP = "configuration/strip"
#: Tells a message from all others: topic, source, start and sequence.
_Key = tuple[str, str, int, int]


@dataclass
class PlayResult:
    """What was played.

    Attributes
    ----------
    counts : messages by topic
    left_out : recorded messages by topic, of the part that was played, that nodes make anew
    rounds : how often
    worst_late_s, mean_late_s : how late messages were put on the bus, s
    """

    counts: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    rounds: int = 0
    worst_late_s: float = 0.0
    mean_late_s: float = 0.0


def regenerated(reader: RecordingReader) -> set[int]:
    """Channels of a recording that the estimating nodes make anew from the rest of it."""
    known = [channel for channel in reader.channels.values() if channel.known]
    classes = []
    for name in registry.ESTIMATING:
        try:
            classes.append(registry.node_class(name))
        except UserError:  # not installed: what it made stays in
            continue
    active = active_nodes(classes, {channel.topic for channel in known})
    made = {output for node in active for output in node.outputs}
    makers = {node.name for node in active}
    return {channel.id for channel in known if is_remade(channel.topic, channel.source, made, makers)}


def play(
    reader: RecordingReader,
    publish: Callable[[RawMessage], None],
    stop: threading.Event,
    *,
    rate: float = 1.0,
    from_ns: int | None = None,
    to_ns: int | None = None,
    loop: bool = False,
    everything: bool = False,
    start: int = 0,
    settle_s: float = SETTLE_S,
    progress: Callable[[float], None] | None = None,
    hold: Callable[[], float] | None = None,
) -> PlayResult:
    """Publish the messages of a recording at the pace of their times of reception.

    Parameters
    ----------
    reader : the recording
    publish : puts a message on the bus
    stop : ends it
    rate : speed, 0 = as fast as it goes
    from_ns, to_ns : platform time to play, ends included; of what was said before, what holds then is played always:
        configuration, control, and an operator's verdicts; and a project or camera that waited for a verdict of the
        part comes with it
    loop : again and again; stamps, times inside messages are shifted in later rounds, strips and points get new names;
        a strip whose end is not played ends with the round
    everything : also what nodes make anew
    start : tells this run from others in the envelopes
    settle_s : waiting time after configuration and control, s
    hold : called before each message; it may wait, and returns for how long, s (see `Brake.wait`)
    """
    result = PlayResult()
    leave_out = set() if everything else regenerated(reader)
    numbers = reader.select()
    channel = reader.index.channel[numbers]
    left = np.isin(channel, list(leave_out))
    asked = np.ones(len(numbers), dtype=bool)
    if from_ns is not None:
        asked &= reader.index.stamp_ns[numbers] >= from_ns
    if to_ns is not None:
        asked &= reader.index.stamp_ns[numbers] <= to_ns
    for id, count in zip(*np.unique(channel[left & asked], return_counts=True), strict=True):
        result.left_out[reader.channels[int(id)].topic] += int(count)
    before, body = _split(reader, numbers[~left], from_ns, to_ns)
    head, told = _holding(reader, before, body)
    if not len(head) and not len(body):
        raise UserError(f"{reader.path}: nothing to play")
    if from_ns is not None and to_ns is not None and from_ns > to_ns:
        raise UserError(f"{reader.path}: the time asked for begins {iso(from_ns)} and ends {iso(to_ns)}, before that")
    if not len(body) and (loop or from_ns is not None or to_ns is not None):
        span = time_span_ns(reader)
        of = "" if span is None else f"; it is of {iso(span[0])} to {iso(span[1])} ({(span[1] - span[0]) / 1e9:.1f} s)"
        raise UserError(f"{reader.path}: nothing but configuration in the time asked for{of}")
    stamps, channel_of = reader.index.stamp_ns[body], reader.index.channel
    strips = _Strips(head, [reader.raw(int(n)) for n in body if reader.channels[int(channel_of[n])].topic == STRIP])
    span_ns = int(stamps.max()) - min(int(stamps.min()), strips.begin_ns) + LOOP_PAUSE_NS if len(body) else 0
    starts = _Starts(start)
    while not stop.is_set():
        shift_ns = result.rounds * span_ns
        for raw in strips.without_over(head) if result.rounds else head:
            _publish(raw, publish, starts, shift_ns, result)
        stop.wait(settle_s if result.rounds == 0 else 0.0)
        times = reader.index.receive_ns[body]
        pacer = Pacer(rate, stop)
        for i, number in enumerate(body):
            if hold is not None:
                pacer.postpone(hold())
            if not pacer.wait(float(times[i] - times[0]) / SECOND_NS):
                break
            for raw in told.get(int(number)) or (reader.raw(int(number)),):
                _publish(raw, publish, starts, shift_ns, result)
            if progress is not None and i % 256 == 0:
                progress(i / len(body))
        for raw in strips.ends(int(stamps.max())) if loop and len(body) and not stop.is_set() else ():
            _publish(raw, publish, starts, shift_ns, result)
        result.rounds += 1
        result.worst_late_s = max(result.worst_late_s, pacer.worst_late_s)
        result.mean_late_s = pacer.mean_late_s
        if not loop or not len(body):
            break
        stop.wait(LOOP_PAUSE_NS / SECOND_NS / (rate or 1.0))
    return result


class _Strips:
    """Strips of a part of a flight that is played again and again: a round flies none of another one.

    Parameters
    ----------
    before, inside : messages, those of strips among them, that are sent at once and that come in the part

    Attributes
    ----------
    begin_ns : when the first one begins that is flown when the part does
    """

    def __init__(self, before: Sequence[RawMessage], inside: Sequence[RawMessage]) -> None:
        told = self._by_name(before)
        self._over = {id for id, (_, body) in told.items() if body.ended}
        self.begin_ns = min((body.first_line_time_ns for _, body in told.values() if not body.ended), default=2**62)
        self._unended = [raw for raw, body in (told | self._by_name(inside)).values() if not body.ended]

    @staticmethod
    def _by_name(messages: Sequence[RawMessage]) -> dict[str, tuple[RawMessage, Any]]:
        """Strips as they were told last; what cannot be decoded tells none."""
        strips = {}
        for raw in messages:
            with suppress(ValueError):
                if raw.topic == STRIP:
                    body = codec.decode(raw.topic, raw.data)
                    strips[body.id] = raw, body
        return strips

    def without_over(self, before: Sequence[RawMessage]) -> list[RawMessage]:
        """What is sent at once, without strips that are over when the part begins."""
        return [raw for raw in before if self._over.isdisjoint(self._by_name([raw]))]

    def ends(self, at_ns: int) -> list[RawMessage]:
        """Messages by which strips end at a time whose end does not come."""
        messages = []
        for raw, body in self._by_name(self._unended).values():
            body.ended = True
            lines = max(int((at_ns - body.first_line_time_ns) / SECOND_NS * body.line_rate_hz), 1)
            body.lines = min(body.lines or lines, lines)
            envelope = raw.envelope._replace(stamp_ns=at_ns, sequence=raw.envelope.sequence + 1)
            messages.append(raw._replace(envelope=envelope, data=codec.encode(body)))
        return messages


def _split(reader: RecordingReader, numbers: Any, from_ns: int | None, to_ns: int | None) -> tuple[Any, Any]:
    """Numbers of what was said before, to be sent at once, and of the others; both in order of reception."""
    index = reader.index
    ordered = numbers[np.argsort(index.receive_ns[numbers], kind="stable")]
    names = [reader.channels[int(c)].topic for c in index.channel[ordered]]
    latched = np.array([topics.find(name).latched for name in names], dtype=bool)
    verdict = np.array([name == VERDICT for name in names], dtype=bool)
    stamps = index.stamp_ns[ordered]
    timed = np.flatnonzero(~latched)
    begin = stamps[timed].min() if len(timed) else 0
    begin = max(begin, from_ns) if from_ns is not None else begin
    at_once = (latched & (stamps <= begin)) | (verdict & (stamps < begin))
    inside = ~at_once & (stamps >= begin)
    if to_ns is not None:
        inside &= stamps <= to_ns
    return ordered[at_once], ordered[inside]


def _holding(reader: RecordingReader, before: Any, body: Any) -> tuple[list[RawMessage], dict[int, list[RawMessage]]]:
    """What nodes have to hear to begin with what was said before a flight's part; and verdicts of the part, by number,
    with what waited for them when it began.

    Nodes that have not flown yet take any project and camera, so those that were refused in flight are left out, and
    come with the verdict that lets them in; and they do not know what a verdict on a topic was about, so it names the
    source that it let in.
    """
    decisive = [id for id, channel in reader.channels.items() if channel.topic in (*FIXED, VERDICT)]
    later = body[np.isin(reader.index.channel[body], decisive)]
    raws = [reader.raw(int(number)) for number in before]
    early = {_key(raw.topic, raw.envelope) for raw in raws}
    voices = RecordedVoices()
    used: set[_Key] = set()  # of what was said before, and counted then
    named: dict[_Key, bytes] = {}  # verdicts with the source that they let in
    let_in: dict[_Key, _Key] = {}  # projects and cameras by the verdict that did
    heard = np.unique(np.concatenate([before, later, reader.first_flown()]))
    for message in reader.decode(reader.sort(heard)):
        key = _key(message.topic, message)
        passed = [_key(one.topic, one) for one in voices.used(message) if one.topic in FIXED]
        if key in early:
            used.update(passed)
        elif message.topic == VERDICT:
            let_in.update((key, one) for one in passed)
        if message.topic == VERDICT and message.body.accepted and not message.body.HasField("clock_s"):
            message.body.publisher = message.body.publisher or voices.chosen(message.body.topic)
            named[key] = codec.encode(message.body)
    head: list[RawMessage] = []
    waits: dict[_Key, RawMessage] = {}
    for raw in raws:
        key = _key(raw.topic, raw.envelope)
        if raw.topic in FIXED and key not in used:
            waits[key] = raw
        else:
            head.append(raw._replace(data=named.get(key, raw.data)))
    told: dict[int, list[RawMessage]] = {}
    for number in later if waits else ():
        verdict = reader.raw(int(number))
        key = _key(verdict.topic, verdict.envelope)
        if key in let_in:
            told[int(number)] = [verdict._replace(data=named[key])]
            held = waits.get(let_in[key])
            if held is not None:
                envelope = held.envelope._replace(stamp_ns=verdict.envelope.stamp_ns)  # of two with a stamp it is first
                told[int(number)].insert(0, held._replace(envelope=envelope))
    return head, told


def _key(topic: str, said: Message | Envelope) -> _Key:
    return topic, said.source, said.start, said.sequence


class _Starts:
    """Start ids of a replay: one for each recorded run of a publisher, so that nothing looks like a duplicate."""

    def __init__(self, start: int) -> None:
        self._start = start
        self._known: dict[tuple[str, str, int], int] = {}
        self._runs: Counter[tuple[str, str]] = Counter()

    def of(self, raw: RawMessage, round_: int) -> int:
        key = (raw.topic, raw.envelope.source, raw.envelope.start)
        if key not in self._known:
            self._known[key] = self._runs[key[:2]]
            self._runs[key[:2]] += 1
        return self._start + round_ * 1000 + self._known[key]


def _publish(
    raw: RawMessage, publish: Callable[[RawMessage], None], starts: _Starts, shift_ns: int, result: PlayResult
) -> None:
    envelope = raw.envelope._replace(start=starts.of(raw, result.rounds))
    data = raw.data
    if shift_ns:
        envelope = envelope._replace(stamp_ns=envelope.stamp_ns + shift_ns)
        data = shifted(raw.topic, data, shift_ns, f"~{result.rounds + 1}")
    publish(RawMessage(raw.topic, envelope, data))
    result.counts[raw.topic] += 1


def shifted(topic: str, data: bytes | memoryview, shift_ns: int, suffix: str) -> bytes | memoryview:
    """A payload with all times shifted and a suffix on the names of strips and points.

    What cannot be decoded stays as it is.
    """
    try:
        body = codec.decode(topic, data)
    except ValueError:
        return data
    if isinstance(body, LineBlock):
        times = None if body.line_times_ns is None else body.line_times_ns + shift_ns
        body = replace(body, time_ns=body.time_ns + shift_ns, line_times_ns=times, strip=body.strip + suffix)
    else:
        _shift(body, shift_ns, suffix)
        if topic == "configuration/strip":
            body.id += suffix
    return codec.encode(body)


def _shift(body: Any, shift_ns: int, suffix: str) -> None:
    for descriptor, value in body.ListFields():
        name = descriptor.name
        if descriptor.message_type is not None:
            if descriptor.message_type.full_name == "google.protobuf.Timestamp":
                total = value.seconds * SECOND_NS + value.nanos + shift_ns
                value.seconds, value.nanos = divmod(total, SECOND_NS)
            else:
                for part in (value,) if hasattr(value, "ListFields") else value:
                    _shift(part, shift_ns, suffix)
        elif name in ("strip", "point"):  # a strip, and what is seen from it, is not the same thing a round later
            setattr(body, name, value + suffix)
        elif name.endswith(("time_ns", "start_ns", "end_ns")):
            setattr(body, name, value + shift_ns)


def time_argument(text: str, first_ns: int) -> int:
    """Platform time in ns of ``12.5`` (seconds after ``first_ns``) or of an ISO time (UTC where it names no zone)."""
    from datetime import UTC, datetime

    try:
        return first_ns + round(float(text) * SECOND_NS)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise UserError(f"time {text!r}, wanted seconds from the start or an ISO time") from None
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    whole = moment.replace(microsecond=0)
    return int(whole.timestamp()) * SECOND_NS + moment.microsecond * 1000


def first_stamp_ns(reader: RecordingReader) -> int:
    """Stamp of the first measurement of a recording (or of whatever there is)."""
    index = reader.index
    timed = [
        c.id
        for c in reader.channels.values()
        if c.known and not topics.find(c.topic).latched and topics.find(c.topic).family is not Family.STATUS
    ]
    stamps = index.stamp_ns[np.isin(index.channel, timed)]
    stamps = stamps if len(stamps) else index.stamp_ns
    return int(stamps.min()) if len(stamps) else 0


def run(options: ProgramOptions) -> int:
    """Play the recording that the configuration names: [player] input, rate, from, to, loop, all."""
    table = dict(options.table)
    path = table.pop("input", None)
    if not path or not isinstance(path, str):
        raise UserError("the player needs a recording: --set input=FILE, or [player] input in the configuration")
    for key, value in table.items():
        if key not in SETTINGS:
            raise UserError(f"configuration [player]: {key} is not known, wanted one of input, {', '.join(SETTINGS)}")
        if SETTINGS[key] is False and not isinstance(value, bool):
            raise UserError(f"configuration [player]: {key} is {value!r}, wanted true or false")
    rate = table.get("rate", 1.0)
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 <= rate < 1e6:
        raise UserError(f"configuration [player]: rate is {rate!r}, wanted a number of at least 0")
    reader = RecordingReader(Path(path))
    first = first_stamp_ns(reader)
    with options.open_bus() as bus:
        bus.announce("player")
        bus.prepare({channel.topic for channel in reader.channels.values() if channel.known})
        result = play(
            reader,
            bus.publish_raw,
            options.stop,
            rate=float(rate),
            from_ns=time_argument(str(table["from"]), first) if "from" in table else None,
            to_ns=time_argument(str(table["to"]), first) if "to" in table else None,
            loop=bool(table.get("loop", False)),
            everything=bool(table.get("all", False)),
            start=bus.start,
        )
        options.stop.wait(0.5)  # what is still on its way
    options.report(f"played {sum(result.counts.values())} messages")
    return 0
