"""``triline process``: nodes over a recording, in one process."""

from __future__ import annotations

import argparse
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path

from ...schemas import codec
from .. import registry
from ..config import Tables, build, load
from ..convert import camera_from, camera_message
from ..errors import UserError
from ..formats.camera_json import read_camera_instead
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.new_file import new_file, refuse_unless_writable
from ..garbage_collection import RareCollections
from ..last_problems import in_words
from ..node import Node
from ..recording.reader import RecordingReader
from ..recording.remote import path_of
from ..recording.runner import ProcessSummary, process
from ..recording.summary import damage_lines, held_topics, lacking, not_whole
from ..recording.writer import COMPRESSIONS, RecordingWriter
from .damage import tell_damage
from .dem_options import add_dem_options, dem_settings
from .progress import progress

EXAMPLE = "triline process flight.mcap -o out.mcap"
#: Interval of filtered poses at the pace for throughput, s; there they only document the accuracy of the trajectory.
FILTERED_S = 0.2
#: Interval at which smoothed poses are handed to the adjuster at that pace, s.
SMOOTH_EVERY_S = 2.0
#: Updates of a flight follow each other faster than this, s; those at the pace for throughput do not.
RARE_S = 5.0
#: Nodes whose results are as good at the pace for throughput.
FAST = {"navigator", "matcher", "adjuster"}
CAMERA, REPORT, TIES, LINES = "configuration/camera", "adjustment/report", "observation/tie", "sensor/lines/*"
NAVIGATOR, MATCHER, ADJUSTER = "navigator", "matcher", "adjuster"
#: What an adjuster corrects, of a recording or of a navigator.
POSES = ("trajectory/smoothed", "trajectory/filtered")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=path_of, metavar="RECORDING", help="flight.mcap, or its URL")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="recording to write")
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file with one table a node")
    parser.add_argument(
        "--nodes", default=",".join(registry.ESTIMATING), metavar="NAMES",
        help=f"comma-separated, of {', '.join(registry.STEP_NODES)} (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--pace", choices=("load", "throughput"),
        help="load: that of a live flight, with its recorded changes under load; throughput: larger batches and "
        "filtered poses at 5 Hz, as accurate, but results come later (default: load where the recording holds results "
        "at that pace, which come out the same, and with other nodes than navigator, matcher and adjuster; else "
        "throughput)",
    )  # fmt: skip
    parser.add_argument(
        "--camera", type=Path, metavar="FILE",
        help="camera.json in place of the recording's, as 'triline adjust --selfcal' writes it; the output has it",
    )  # fmt: skip
    add_dem_options(parser.add_argument_group("heights"))
    parser.add_argument("--compression", choices=COMPRESSIONS, default="none", help="of the output (default: none)")
    parser.add_argument(
        "--processes", type=int, choices=(1, 2), default=2,
        help="of this machine at most; the output is the same (default: 2, where there are two processors)",
    )  # fmt: skip
    parser.add_argument("--strict", action="store_true", help="refuse a recording that is not whole")


def run(args: argparse.Namespace) -> int:
    refuse_importable(args.recording)
    reader = RecordingReader(args.recording)
    _check(reader, args)
    names = list(dict.fromkeys(name.strip() for name in args.nodes.split(",")))
    other = next((name for name in names if name not in registry.STEP_NODES), None)
    if other is not None:
        raise UserError(
            f"--nodes: no node {other!r} that works on a recording, wanted {', '.join(registry.STEP_NODES)}"
        )
    if ADJUSTER in names and NAVIGATOR not in names and not len(reader.select(POSES)):
        raise lacking(reader, f"no message on {' or '.join(POSES)}, wanted {NAVIGATOR} among --nodes, too")
    pace = args.pace or usual_pace(reader, names)
    tables = at_pace(load(args.config, registry.names()), pace)
    dem = dem_settings(args)
    if dem:
        tables = tables | {"adjuster": tables.get("adjuster", {}) | dem}
    notes: list[str] = []
    instead = {} if args.camera is None else {CAMERA: _camera(reader, args.camera, notes)}
    if ADJUSTER in names and MATCHER not in names and not len(reader.select([TIES])) and len(reader.select([LINES])):
        more = ",".join([*names[: names.index(ADJUSTER)], MATCHER, *names[names.index(ADJUSTER) :]])
        notes.append(f"image lines and no tie point in it; '--nodes {more}' finds tie points")
    nodes: list[Node] = [build(registry.node_class(name), tables) for name in names]
    begun = time.monotonic()
    with (
        new_file(args.output) as part,
        RecordingWriter(part, args.compression, platform=_platform(reader)) as writer,
        progress("processing", args.quiet or args.json) as told,
    ):
        collections = RareCollections()

        def progressed(fraction: float) -> None:
            collections.if_due()
            if told is not None:
                told(fraction)

        summary = process(
            reader, nodes, writer.write_raw, progressed, apart=args.processes > 1, instead=instead,
            copy=writer.write_recorded,
        )  # fmt: skip
        if not summary.nodes:
            raise lacking(reader, f"nothing to process for {args.nodes}: {held_topics(reader)}")
        if not summary.outputs:
            raise lacking(reader, f"nothing came out: {_waiting(summary)}")
    missing = ""
    if NAVIGATOR in summary.nodes and not summary.outputs.keys() & set(POSES):
        missing = f"no trajectory came out, so nothing is oriented: {_no_trajectory(summary)}"
    seconds = time.monotonic() - begun
    for name, text in summary.failed.items():
        print(f"triline process: {reader.path}: {name} {text}", file=sys.stderr)
    if args.json:
        more = {"pace": pace, "notes": [*summary.notes, *notes, *([missing] if missing else [])]}
        print(json_text(result(summary, reader, args.output, seconds) | more))
        return _ended(reader, missing)
    for line in (*_lines(summary, args.output, seconds), *(f"  note: {note}" for note in notes)):
        print(line)
    if pace != args.pace and pace == "throughput" and ADJUSTER in summary.nodes:
        print("  live orientation is that of updates 10 s apart; that of a flight comes with --pace load")
    tell_damage("process", reader)
    return _ended(reader, missing)


def _ended(reader: RecordingReader, missing: str) -> int:
    """Exit code; what is missing is said last, where `batch` looks for the reason of a failure."""
    if not missing:
        return 0
    print(f"triline process: {reader.path}: {missing}", file=sys.stderr)
    return 1


def usual_pace(reader: RecordingReader, nodes: Sequence[str]) -> str:
    """The pace at which results come out as they are in a recording; of one that has none, that for throughput.

    A live adjuster tells its status, and no other; in what was processed the reports say how far apart updates were.
    Nodes that work with the live orientation, as the rectifier does, need that of a flight.
    """
    if ADJUSTER not in nodes or not set(nodes) <= FAST:
        return "load"
    topics = reader.topics_with_messages()
    if f"status/{ADJUSTER}" in topics:
        return "load"
    if REPORT not in topics:
        return "throughput"
    first = reader.select([REPORT])[:1]
    try:
        report = codec.decode(REPORT, next(reader.raws(first))[2])
    except ValueError:
        return "load"
    return "throughput" if report.update_interval_s >= RARE_S else "load"


def at_pace(tables: Tables, pace: str) -> Tables:
    """The configuration of the nodes with the settings of a pace; settings in the file take precedence."""
    if pace != "throughput":
        return tables
    rare = {"filtered_s": FILTERED_S, "smooth_every_s": SMOOTH_EVERY_S}
    of_pace: Tables = {"navigator": rare, "matcher": {"pace": "normal"}, "adjuster": {"pace": "throughput"}}
    return tables | {name: table | tables.get(name, {}) for name, table in of_pace.items()}


def _check(reader: RecordingReader, args: argparse.Namespace) -> None:
    refuse_unless_writable(args.output)
    if not any(channel.known for channel in reader.channels.values()):
        raise lacking(reader, "no topic of triline in it")
    if args.strict and (reader.damage or not reader.complete):
        raise UserError(f"{args.recording}: not whole: {not_whole(reader)[0]}")


def _camera(reader: RecordingReader, path: Path, notes: list[str]) -> bytes:
    """The message of a camera in place of that of the recording; ``notes`` gets remarks."""
    body = reader.last(CAMERA)
    if body is None:
        raise lacking(reader, f"no {CAMERA} in it, so --camera has nothing to stand for")
    return codec.encode(camera_message(read_camera_instead(path, camera_from(body), notes=notes)))


def _no_trajectory(summary: ProcessSummary) -> str:
    """Why the navigator made none, as far as can be told."""
    sensors = ("sensor/gnss",), ("sensor/attitude", "sensor/imu")
    lacking = [" or ".join(names) for names in sensors if not any(summary.inputs.get(name) for name in names)]
    if lacking:
        return f"no usable message on {', and none on '.join(lacking)}"
    return summary.problems.get(NAVIGATOR) or f"{NAVIGATOR} {summary.states[NAVIGATOR]}"


def _waiting(summary: ProcessSummary) -> str:
    """What the nodes wait for, from their status."""
    said = ((name, summary.states[name], summary.problems.get(name)) for name in summary.nodes)
    return "; ".join(f"{name} {state}" + (f" ({problem})" if problem else "") for name, state, problem in said)


def _platform(reader: RecordingReader) -> str:
    return next((c.platform for c in reader.channels.values() if c.platform), "demo")


def result(summary: ProcessSummary, reader: RecordingReader, output: Path, seconds: float) -> dict[str, object]:
    """The machine-readable result."""
    return {
        "output": str(output),
        "nodes": summary.nodes,
        "inputs": dict(sorted(summary.inputs.items())),
        "outputs": dict(sorted(summary.outputs.items())),
        "replaced": dict(sorted(summary.replaced.items())),
        "dropped": dict(sorted(summary.dropped.items())),
        "notes": summary.notes,
        "damage": damage_lines(reader),
        "lost_bytes": sum(damage.length for damage in reader.damage),
        "counters": summary.counters,
        "problems": summary.problems,
        "problems_by_kind": summary.problems_by_kind,
        "failed": summary.failed,
        "flight_s": (summary.last_ns - summary.first_ns) / 1e9,
        "seconds": round(seconds, 3),
    }


def _lines(summary: ProcessSummary, output: Path, seconds: float) -> list[str]:
    flight_s = (summary.last_ns - summary.first_ns) / 1e9
    times = flight_s / max(seconds, 1e-9)
    lines = [
        f"{output}: {' and '.join(summary.nodes)} over {flight_s:.1f} s of flight in {seconds:.1f} s"
        f" ({times:.{0 if times >= 9.95 else 1}f} times real time)"
    ]
    lines += [f"  {topic:<24} {n:>9} in" for topic, n in sorted(summary.inputs.items())]
    lines += [f"  {topic:<24} {n:>9} out" for topic, n in sorted(summary.outputs.items())]
    if summary.dropped:
        words = {"impossible": "with impossible values"}
        counted = ", ".join(f"{n} {words.get(kind, kind)}" for kind, n in sorted(summary.dropped.items()))
        lines += _wrapped(f"left out: {counted}", in_words(summary.dropped, summary.last_problems))
    if summary.notes:
        more = len(summary.notes) - 1
        lines.append(f"  used all the same: {summary.notes[-1]}" + (f" (and {more} more)" if more else ""))
    for name, counters in summary.counters.items():
        if any(counters.values()):
            by_number = sorted(((n, kind) for kind, n in counters.items() if n), key=lambda c: (-c[0], c[1]))
            counted = ", ".join(f"{n} {kind}" for n, kind in by_number)
            lines += _wrapped(f"{name}: {counted}", in_words(counters, summary.problems_by_kind.get(name, {})))
    return lines


def _wrapped(counted: str, last: str) -> list[str]:
    """What was counted, and the last problems, as indented lines."""
    text = f"{counted}; {last}" if last else counted
    return textwrap.wrap(text, 116, initial_indent="  ", subsequent_indent="    ", break_long_words=False)
