"""``triline recover``: a valid recording from a broken one, or from the parts of one flight."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ...schemas.envelope import RawMessage
from ..errors import UserError
from ..formats.json_text import json_text
from ..formats.new_file import new_file
from ..recording.index import Channel
from ..recording.reader import RecordingReader
from ..recording.summary import topic_summaries
from ..recording.writer import RecordingWriter
from .damage import look_again

EXAMPLE = """triline recover broken.mcap -o whole.mcap
  triline recover flight.mcap flight_0001.mcap -o whole.mcap    # a recorder that began a new file in flight"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings", type=Path, nargs="+", metavar="RECORDING",
        help="the broken recording, or all parts of a flight, in any order; they are not changed",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="recording to write")


def run(args: argparse.Namespace) -> int:
    readers = _in_order([RecordingReader(path, salvage=True) for path in args.recordings])
    counts = {"messages": 0, "repeated": 0}
    with new_file(args.output) as part:
        with RecordingWriter(part, readers[0].compression) as writer:
            for channel, raw in _messages(readers, counts):
                writer.write_raw(raw, channel.platform or None, channel.every)
        # gaps of parts may be filled by one another
        whole = readers[0] if len(readers) == 1 else RecordingReader(part)
        missing = {row.topic: row.gaps for row in topic_summaries(whole) if row.gaps}
    for reader in readers:
        look_again(reader)
    grow = [str(reader.path) for reader in readers if reader.grows and not reader.complete]
    damage = [(reader, damage) for reader in readers for damage in reader.damage]
    several = len(readers) > 1
    result = {
        "output": str(args.output),
        "recordings": [str(reader.path) for reader in readers],
        **counts,
        "chunks": sum(reader.n_chunks for reader in readers),
        "foreign_messages": sum(int(len(reader.index) - len(reader.select())) for reader in readers),
        "attachments": sum(reader.attachments for reader in readers),
        "lost_bytes": sum(d.length for _, d in damage),
        "damage": [f"{reader.path}: {d}" if several else str(d) for reader, d in damage],
        "complete": all(reader.complete for reader in readers),
        "being_written": grow,
        "missing": missing,
    }
    print(json_text(result) if args.json else "\n".join(_lines(result)))
    return 0


def _in_order(readers: Sequence[RecordingReader]) -> list[RecordingReader]:
    """The parts of a flight as they were recorded.

    Raises
    ------
    UserError : nothing in one of them, the same one twice, parts of different platforms
    """
    platforms: dict[str, Path] = {}
    for reader in readers:
        if not len(reader.select()):
            raise UserError(f"{reader.path}: nothing in it that could be recovered")
        if sum(os.path.realpath(str(reader.path)) == os.path.realpath(str(other.path)) for other in readers) > 1:
            raise UserError(f"{reader.path}: named twice, wanted each part of a flight once")
        for channel in reader.channels.values():
            if channel.platform:
                platforms.setdefault(channel.platform, reader.path)
    if len(readers) > 1 and len(platforms) > 1:
        (one, path), (other, second) = list(platforms.items())[:2]
        raise UserError(f"{second}: is of platform {other}, {path} of {one}: wanted parts of one flight")
    # configuration stands at the head of each part with the time when it was stated: what tells them apart is the end
    return sorted(readers, key=lambda reader: int(reader.index.stamp_ns[reader.select()].max()))


def _messages(readers: Sequence[RecordingReader], counts: dict[str, int]) -> Iterator[tuple[Channel, RawMessage]]:
    """Messages of all parts with their channels; of those that several parts hold the first."""
    held: set[tuple[str, str, int, int, int]] = set()
    for k, reader in enumerate(readers):
        numbers = reader.select()
        mine: set[tuple[str, str, int, int, int]] = set()
        for number, raw in zip(reader.index.channel[numbers].tolist(), reader.raws(numbers), strict=True):
            envelope = raw.envelope
            key = raw.topic, envelope.source, envelope.start, envelope.sequence, envelope.stamp_ns
            if key in held:
                counts["repeated"] += 1
                continue
            if k + 1 < len(readers):
                mine.add(key)
            counts["messages"] += 1
            yield reader.channels[number], raw
        held |= mine


def _lines(r: dict[str, Any]) -> list[str]:
    lines = [f"{r['output']}: kept {r['messages']} messages of {r['chunks']} whole chunks"]
    if len(r["recordings"]) > 1:
        lines[0] += f" of {len(r['recordings'])} recordings"
    if r["repeated"]:
        lines.append(f"{r['repeated']} messages that several of them hold are in it once")
    if r["damage"]:
        lines.append(f"lost {r['lost_bytes']} bytes in {len(r['damage'])} places; the first: {r['damage'][0]}")
    elif not r["complete"]:
        lines.append("the file had no end; no whole chunk was lost")
    else:
        lines.append("nothing was lost")
    for path in r["being_written"]:
        lines.append(f"{path} grows: it is being written, and what comes from now on is left out")
    if r["missing"]:
        lines.append("missing by their numbers: " + ", ".join(f"{n} of {topic}" for topic, n in r["missing"].items()))
    if r["foreign_messages"]:
        lines.append(f"left out {r['foreign_messages']} messages of other programs")
    if r["attachments"]:
        lines.append(f"left out {r['attachments']} attachments (files of other programs)")
    return lines
