"""``triline recover``: a valid recording from a broken one."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ..errors import UserError
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_file
from ..recording.reader import RecordingReader
from ..recording.summary import topic_summaries
from ..recording.writer import RecordingWriter

EXAMPLE = "triline recover broken.mcap -o whole.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="the broken recording; it is not changed")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="recording to write")


def run(args: argparse.Namespace) -> int:
    reader = RecordingReader(args.recording, salvage=True)
    refuse_unless_file(args.output)
    numbers = reader.select()
    if not len(numbers):
        raise UserError(f"{args.recording}: nothing in it that could be recovered")
    part = args.output.with_name(args.output.name + ".part")
    try:
        with RecordingWriter(part, reader.compression) as writer:
            for number, raw in zip(reader.index.channel[numbers].tolist(), reader.raws(numbers), strict=True):
                channel = reader.channels[number]
                writer.write_raw(raw, channel.platform or None, channel.every)
        os.replace(part, args.output)
    except OSError as error:
        raise UserError(f"{args.output}: cannot be written: {(error.strerror or str(error)).lower()}") from None
    finally:
        part.unlink(missing_ok=True)
    missing = {row.topic: row.gaps for row in topic_summaries(reader) if row.gaps}
    result = {
        "output": str(args.output),
        "messages": len(numbers),
        "chunks": reader.n_chunks,
        "foreign_messages": int(len(reader.index) - len(numbers)),
        "attachments": reader.attachments,
        "lost_bytes": sum(damage.length for damage in reader.damage),
        "damage": [str(damage) for damage in reader.damage],
        "complete": reader.complete,
        "missing": missing,
    }
    print(json_text(result) if args.json else "\n".join(_lines(result)))
    return 0


def _lines(r: dict) -> list[str]:
    lines = [f"{r['output']}: kept {r['messages']} messages of {r['chunks']} whole chunks"]
    if r["damage"]:
        lines.append(f"lost {r['lost_bytes']} bytes in {len(r['damage'])} places; the first: {r['damage'][0]}")
    elif not r["complete"]:
        lines.append("the file had no end; no whole chunk was lost")
    else:
        lines.append("nothing was lost")
    if r["missing"]:
        lines.append("missing by their numbers: " + ", ".join(f"{n} of {topic}" for topic, n in r["missing"].items()))
    if r["foreign_messages"]:
        lines.append(f"left out {r['foreign_messages']} messages of other programs")
    if r["attachments"]:
        lines.append(f"left out {r['attachments']} attachments (files of other programs)")
    return lines
