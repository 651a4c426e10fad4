"""What a recording holds, and whether it is whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...schemas import topics
from ...schemas.topics import Family
from ..errors import UserError
from ..last_problems import in_words
from .reader import RecordingReader
from .usable import usable

#: What a note on the file begins with, among notes on other things.
OF_RECORDING = "recording: "
#: Families whose stamps tell when a flight was.
_TIMED = (Family.SENSOR, Family.OBSERVATION, Family.RESULT, Family.TRUTH)


#: Results of many moments, with the stamp at which they could be known: their stamps have no rate.
IN_BURSTS = frozenset({"trajectory/smoothed", "orientation/final", "orientation/whole", "point/object"})


@dataclass
class TopicSummary:
    """One topic of a recording.

    Attributes
    ----------
    topic, type : names
    messages : how many
    first_ns, last_ns : stamps
    rate_hz : mean rate between first and last stamp; None for fewer than two, and for what nodes put out in bursts
    sources : who published it
    gaps : messages missing by their numbers
    duplicates : messages whose number came before
    backwards : messages stamped before the one that was published before them
    """

    topic: str
    type: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    rate_hz: float | None = None
    sources: list[str] = field(default_factory=list)
    gaps: int = 0
    duplicates: int = 0
    backwards: int = 0


def topic_summaries(reader: RecordingReader) -> list[TopicSummary]:
    """All topics of a recording, those of the topic table first and in its order.

    Of a recording that is read by ranges the first and the last message of each channel are looked at: times and gaps
    are right where messages stand in their order, duplicates are not seen.
    """
    by_topic: dict[str, TopicSummary] = {}
    for channel in reader.channels.values():
        row = by_topic.setdefault(channel.topic, TopicSummary(channel.topic, channel.type_name))
        chosen = np.flatnonzero(reader.channel_of == channel.id)
        if channel.source not in row.sources:
            row.sources.append(channel.source)
        if not len(chosen):
            continue
        stamps, sequences = reader.stamps(chosen[[0, -1]] if reader.by_ranges and len(chosen) > 1 else chosen)
        row.first_ns = int(min(stamps.min(), row.first_ns)) if row.messages else int(stamps.min())
        row.last_ns = max(int(stamps.max()), row.last_ns)
        row.messages += len(chosen)
        if channel.known:
            distinct = np.unique(sequences)
            meant = distinct[distinct % channel.every == 0] // channel.every
            there = len(chosen) if reader.by_ranges else len(meant)
            row.gaps += max(int(meant[-1] - meant[0]) + 1 - there, 0) if len(meant) else 0
            row.duplicates += 0 if reader.by_ranges else len(chosen) - len(distinct)
            if not topics.find(channel.topic).latched and topics.find(channel.topic).family is not Family.STATUS:
                row.backwards += int((np.diff(stamps[np.argsort(sequences, kind="stable")]) < 0).sum())
    timed = {c.topic for c in reader.channels.values() if c.known and _is_timed(c.topic)}
    for row in by_topic.values():
        known = row.first_ns != 0 or row.topic in timed  # 0 of others: said before any time was known
        span_s = (row.last_ns - row.first_ns) / 1e9 if known else 0.0
        row.rate_hz = (row.messages - 1) / span_s if span_s > 0 and row.topic not in IN_BURSTS else None
        row.sources.sort()
    return sorted(by_topic.values(), key=lambda row: (_place(row.topic), row.topic))


def _is_timed(topic: str) -> bool:
    """Whether the stamps of a topic tell when a flight was."""
    row = topics.find(topic)
    return row.family in _TIMED and not row.latched


def time_span_ns(reader: RecordingReader, among: NDArray[np.int64] | None = None) -> tuple[int, int] | None:
    """First and last stamp of what was measured and computed, on request among some messages alone; None without any.

    What is handed to whoever joins later, such as given ground points, is known before a flight and does not count.
    """
    timed = [c.id for c in reader.channels.values() if c.known and _is_timed(c.topic)]
    numbers = np.arange(len(reader.channel_of)) if among is None else among
    chosen = numbers[np.isin(reader.channel_of[numbers], timed)]
    if reader.by_ranges and len(chosen):  # the ends of each channel tell, see topic_summaries
        _, first = np.unique(reader.channel_of[chosen], return_index=True)
        _, last = np.unique(reader.channel_of[chosen][::-1], return_index=True)
        chosen = chosen[np.concatenate([first, len(chosen) - 1 - last])]
    stamps, _ = reader.stamps(chosen)
    return (int(stamps.min()), int(stamps.max())) if len(stamps) else None


@dataclass(frozen=True)
class Holdings:
    """What a recording holds, the same for every command that says it.

    Attributes
    ----------
    file, size_bytes : of the recording
    messages : how many it holds, of all topics
    span_ns : first and last stamp of what was measured and computed, see `time_span_ns`
    topics : summaries by topic
    damage : what cannot be read, one line each
    unfit : what can be read and makes no sense, one line each
    """

    file: str
    size_bytes: int
    messages: int
    span_ns: tuple[int, int] | None
    topics: list[TopicSummary]
    damage: list[str]
    unfit: list[str]

    @property
    def duration_s(self) -> float:
        """Between first and last stamp, 0 without any."""
        return (self.span_ns[1] - self.span_ns[0]) / 1e9 if self.span_ns else 0.0


def holdings(reader: RecordingReader) -> Holdings:
    """What a recording holds; messages are judged as far as they were decoded."""
    return Holdings(
        str(reader.path), reader.size, len(reader.channel_of), time_span_ns(reader), topic_summaries(reader),
        damage_lines(reader), unfit_lines(reader),
    )  # fmt: skip


def platforms(reader: RecordingReader) -> list[str]:
    """Names of the platforms whose messages are in a recording."""
    return sorted({channel.platform for channel in reader.channels.values() if channel.platform})


def _several_platforms(reader: RecordingReader) -> list[str]:
    """A line where a file holds more than one flight, as one that a tool for MCAP files has merged; nodes do not tell
    their messages apart."""
    names = platforms(reader)
    return [f"messages of platforms {', '.join(names)} in one file, wanted one for each"] if len(names) > 1 else []


def damage_lines(reader: RecordingReader) -> list[str]:
    """What of a recording cannot be read, in words; the messages are judged as far as they were decoded."""
    lines = _several_platforms(reader)
    places = [d for d in reader.damage if not d.is_cut]
    if places:
        n, lost, first = len(places), sum(d.length for d in places), places[0]
        several = f"{n} damaged places ({lost} bytes); the first: {first}"
        lines.append("skipped " + (several if n > 1 else f"1 damaged place: {first}"))
    lines += _open_end(reader)
    if reader.problems["without a channel"]:
        lines.append(f"skipped {reader.problems['without a channel']} messages without a channel")
    if reader.problems["malformed"]:
        n, last = reader.problems["malformed"], reader.last_problems["malformed"]
        lines.append(f"skipped {n} unusable messages; the last: {last}")
    return lines


def _open_end(reader: RecordingReader) -> list[str]:
    """A line where a file does not end as it should: of a flight that goes on, or of one that was cut off."""
    cut = [d for d in reader.damage if d.is_cut]
    if reader.complete or (reader.damage and not cut):
        return []
    what = str(cut[0]) if cut else "the file has no end"
    why = "it is being written, was cut off, or its writer was killed"
    return [f"{what}, and grows: it is being written" if reader.grows else f"{what}: {why}"]


def unfit_lines(reader: RecordingReader) -> list[str]:
    """What of a recording was sent with values that no publisher may send, in words, as far as it was decoded."""
    n = reader.problems["impossible"]
    last = reader.last_problems.get("impossible")
    return [f"{n} message{'s' * (n > 1)} sent with impossible values; the last: {last}"] if n else []


def left_out_lines(reader: RecordingReader) -> list[str]:
    """What of a recording is not used, because it cannot be read or makes no sense."""
    return [*damage_lines(reader), *unfit_lines(reader)]


def not_whole(reader: RecordingReader) -> list[str]:
    """What is wrong with the bytes of a recording, place by place."""
    return [*(str(damage) for damage in reader.damage if not damage.is_cut), *_open_end(reader)]


def held_topics(reader: RecordingReader) -> str:
    """The topics of which a recording has messages, in words."""
    held = sorted(reader.topics_with_messages())
    return f"it holds {', '.join(held)}" if held else "it holds no message"


def lacking(reader: RecordingReader, what: str) -> UserError:
    """The error of a recording in which something is missing, with the damage that may be why."""
    return UserError(f"{reader.path}: {what}{in_brackets(left_out_lines(reader))}")


def in_brackets(lines: Sequence[str]) -> str:
    """What follows an error to say what may be why."""
    return f" ({'; '.join(lines)})" if lines else ""


def findings(reader: RecordingReader, *, decode: bool = True, outside: bool = True) -> list[str]:
    """What is wrong with a recording, one line each, the worst first; empty if it is whole.

    ``decode`` looks into every message and into what nodes would use, ``outside`` at the bytes between chunks, too.
    """
    found = not_whole(reader)
    wrong = reader.check_outside() if outside else None
    if wrong is not None:
        found.append(wrong)
    if not any(channel.known for channel in reader.channels.values()):
        held = ", ".join(sorted({channel.topic for channel in reader.channels.values()})[:3])
        found.append(f"foreign: no topic of triline in it{', only ' + held if held else ''}")
    found += _several_platforms(reader)
    if reader.problems["without a channel"]:
        found.append(f"{reader.problems['without a channel']} messages without a channel")
    for row in topic_summaries(reader):
        if row.gaps and not topics.may_be_dropped(row.topic):
            found.append(f"{row.topic}: {row.gaps} messages missing by their numbers")
        if row.duplicates:
            found.append(f"{row.topic}: {row.duplicates} messages twice")
        if row.backwards:
            found.append(f"{row.topic}: time goes back {row.backwards} times")
    if decode:
        for _ in reader.messages():
            pass
        used = usable(reader, lambda channel: False, lambda topic: True)
        left_out = {kind: used.left_out[kind] for kind in ("malformed", "late", "clock")}
        if any(left_out.values()):
            last = in_words(left_out, used.last_problems)
            found.append(f"{sum(left_out.values())} messages that nodes leave out for their stamps or numbers; {last}")
        found += used.notes
        if reader.problems["malformed"]:
            number, last = reader.problems["malformed"], reader.last_problems["malformed"]
            found.append(f"{number} messages that cannot be used; the last: {last}")
        found += unfit_lines(reader)
    return found


def _place(topic: str) -> int:
    try:
        return topics.rank(topic)
    except KeyError:
        return len(topics.TOPICS)
