"""``triline info``: what a recording holds."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..convert import iso
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..recording.access import Recording
from ..recording.remote import path_of
from ..recording.seal_place import seal_of
from ..recording.summary import findings, holdings, platforms
from ..terminal import plain
from .damage import look_again

EXAMPLE = "triline info flight.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=path_of, metavar="RECORDING", help="flight.mcap, or its URL")


def run(args: argparse.Namespace) -> int:
    refuse_importable(args.recording)
    summary = _summary(Recording(args.recording))
    print(json_text(summary) if args.json else "\n".join(map(plain, _lines(summary))))
    return 0


def _signed(recording: Path) -> dict[str, Any] | None:
    """What the seal beside a recording says; libraries of certificates are imported only where there is one."""
    if not seal_of(recording).is_file():
        return None
    from ..recording.seal import verify

    seal = verify(recording)
    return None if seal is None else {**asdict(seal), "words": str(seal)}


def _summary(recording: Recording) -> dict[str, Any]:
    reader = recording.reader
    look_again(reader)
    held = holdings(reader)
    span, rows = held.span_ns, held.topics
    present = {row.topic for row in rows if row.messages}  # a damaged file can name a channel whose messages are lost
    summary: dict[str, Any] = {
        "file": str(reader.path),
        "bytes": reader.size,
        "library": reader.library,
        "messages": held.messages,
        "chunks": reader.n_chunks,
        "platforms": platforms(reader),
        "start": iso(span[0]) if span else None,
        "end": iso(span[1]) if span else None,
        "duration_s": held.duration_s,
        "topics": [vars(row) for row in rows],
        "damage": findings(reader, decode=False, outside=False),
    }
    signed = None if reader.remote is not None else _signed(reader.path)
    if signed is not None:
        summary["signed"] = signed
    if "configuration/project" in present:
        p = recording.project()
        summary["project"] = {
            "name": p.name, "crs": p.crs or "local", "origin_latitude": p.origin_latitude,
            "origin_longitude": p.origin_longitude, "origin_height": p.origin_height,
        }  # fmt: skip
    if "configuration/camera" in present:
        camera = recording.camera()
        summary["camera"] = {
            "name": camera.name,
            "focal_length_mm": [lens.focal_length_mm for lens in camera.lenses],
            "lines": {line.id: len(line.xy_mm) for line in camera.lines},
        }
    if "configuration/strip" in present:
        summary["strips"] = [
            {"id": name, "start": iso(int(s.first_line_time_ns)), "line_rate_hz": float(s.line_rate_hz),
             "lines": int(s.lines), "ended": bool(s.ended)}
            for name, s in recording.last_strips().items()
        ]  # fmt: skip
    if "truth/world" in present:
        summary["world"] = recording.true_world()
    if reader.remote is not None:
        summary["bytes_read"] = reader.remote.fetched
    return summary


def _lines(s: dict[str, Any]) -> list[str]:
    lines = [f"{s['file']}: {_size(s['bytes'])}, {s['messages']} messages in {s['chunks']} chunks"]
    if s["start"]:
        platform = ", ".join(s["platforms"]) or "-"
        lines.append(f"{s['start']} to {s['end']}, {s['duration_s']:.1f} s, platform {platform}")
    if "project" in s:
        p = s["project"]
        origin = f"{p['origin_latitude']:.6f}, {p['origin_longitude']:.6f}, {p['origin_height']:.1f} m"
        lines.append(f"project {p['name'] or '-'}, crs {p['crs']}, origin {origin}")
    if "camera" in s:
        c = s["camera"]
        focal = ", ".join(f"{f:g} mm" for f in c["focal_length_mm"])
        lines.append(f"camera {c['name']}, {focal}; lines " + ", ".join(f"{k} ({n} px)" for k, n in c["lines"].items()))
    for strip in s.get("strips", ()):
        ended = "" if strip["ended"] else ", not ended"
        rate = f"{strip['line_rate_hz']:.1f} Hz"
        number = f"{strip['lines']} lines" if strip["lines"] else "lines"  # drivers say how many when a strip ends
        lines.append(f"strip {strip['id']}: from {strip['start']}, {number} at {rate}{ended}")
    if "world" in s:
        lines.append(f"true world, not stated: {s['world']}")
    lines.append(f"{'topic':<24} {'messages':>9} {'rate':>9}  {'gaps':>5}  source")
    for row in s["topics"]:
        rate = f"{row['rate_hz']:.1f}/s" if row["rate_hz"] is not None else "-"
        sources = ", ".join(row["sources"])
        lines.append(f"{row['topic']:<24} {row['messages']:>9} {rate:>9}  {row['gaps']:>5}  {sources}")
    if "bytes_read" in s:
        read = f"{s['bytes_read'] / 1e6:.3f} MB of {s['bytes'] / 1e6:.3f} MB read"
        lines.append(f"{read}; by ranges: gaps from first and last messages, checksums not compared")
    lines.append("start, end: of what was measured and computed; rate: between the first and last message of the topic")
    if "signed" in s:
        lines.append(f"{s['signed']['words']}{'' if s['signed']['altered'] else ', nothing was altered'}")
        lines += [f"altered: {text}" for text in s["signed"]["altered"]]
    lines += [f"not as it should be: {text}" for text in s["damage"]]
    return lines


def _size(n: float) -> str:
    for unit in ("bytes", "kB", "MB"):
        if n < 1000:
            return f"{n:.0f} {unit}" if unit == "bytes" else f"{n:.1f} {unit}"
        n /= 1000
    return f"{n:.2f} GB"
