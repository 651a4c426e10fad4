"""``triline export``: a topic of a recording to CSV, Parquet, GeoJSON, GeoPackage, SBET or SMRMSG."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas import topics
from ...solver.geometry.frames import LocalFrame
from ...solver.geometry.rotation import matrix_from_quaternion
from ...solver.geometry.trajectory import Trajectory
from ..batch.point_table import write_points
from ..batch.strip_orientation import ORIENTATIONS, REFINED, camera_of_table, estimated_camera, lines_of_recording
from ..convert import PoseSample, R_bc_of, local_frame, pose_sample
from ..errors import UserError, flag
from ..formats.camera_json import write_camera
from ..formats.features import NOT_PLACED, Features, answers, features_of
from ..formats.geojson import write_geojson
from ..formats.geopackage import write_geopackage
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.line_orientation import (
    OrientedLines,
    write_oriented_lines,
    write_patb_lines,
    write_sbet_lines,
    write_smrmsg_lines,
)
from ..formats.new_file import new_file
from ..formats.projection import refuse_missing_grids
from ..formats.rows import ElementLayout, RowLayout, repeated_messages
from ..formats.sbet import write_sbet_poses
from ..formats.smrmsg import write_smrmsg_poses
from ..node import Message
from ..recording.access import Recording
from ..recording.reader import RecordingReader
from ..recording.summary import damage_lines, held_topics, lacking, unfit_lines
from .damage import tell_damage, tell_other_frame
from .outputs import refuse_input_as_output

EXAMPLE = """triline export flight.mcap --topic orientation/final --csv orientation.csv
  triline export flight.mcap --points points.csv
  triline export flight.mcap --per-line orientation_lines.csv
  triline export flight.mcap --per-line orientation.sbet --format sbet"""

#: Messages turned into rows at a time.
BATCH = 20_000
_LINE_FORMATS = ("csv", "patb", "sbet", "smrmsg")
#: Option (as attribute) -> targets that it goes with, for those that do not go with all.
_GO_WITH = {
    "format": ("per_line",),
    "covariance": ("points",),
    "orientation": ("per_line",),
    "rows": ("csv", "parquet"),
    "every": ("csv", "parquet", "geojson", "gpkg", "sbet", "smrmsg"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING")
    parser.add_argument("--topic", help="one of: " + ", ".join(row.name for row in topics.TOPICS))
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument(
        "--csv", metavar="FILE",
        help="one row a message, columns named with their units; repeated sub-messages go to FILE_NAME.csv beside it",
    )  # fmt: skip
    target.add_argument("--parquet", metavar="FILE", help="the same tables as Parquet")
    target.add_argument("--geojson", metavar="FILE", help="points and lines in WGS 84, with sigmas")
    target.add_argument("--gpkg", metavar="FILE", help="the same as GeoPackage")
    target.add_argument(
        "--sbet", metavar="FILE", help="poses of trajectory/*, orientation/* or truth/trajectory as SBET"
    )
    target.add_argument("--smrmsg", metavar="FILE", help="the accuracies of these poses, which an SBET has not")
    target.add_argument(
        "--points",
        metavar="FILE",
        help="CSV of object points, one row a point by its best answer, in the project's CRS",
    )
    target.add_argument(
        "--per-line", metavar="FILE", help="the refined orientation of every image line, in the project's CRS"
    )
    parser.add_argument(
        "--format", choices=_LINE_FORMATS,
        help="with --per-line: CSV with sigmas (default), PATB-like rows of position and rotation matrix, SBET, "
        "or the accuracies of that (SMRMSG)",
    )  # fmt: skip
    parser.add_argument("--covariance", action="store_true", default=None, help="of the points, with --points")
    parser.add_argument(
        "--orientation", choices=tuple(ORIENTATIONS), help="with --per-line (default: the best there is, in this order)"
    )
    parser.add_argument(
        "--rows", metavar="FIELD",
        help="one table, with a row for each element of this repeated sub-message ('none': a row for each message)",
    )  # fmt: skip
    parser.add_argument(
        "--every",
        type=int,
        metavar="N",
        help="take every N-th message, on maps and as SBET every N-th time or point (default 1)",
    )


def run(args: argparse.Namespace) -> int:
    if args.every is not None and args.every < 1:
        raise UserError(f"--every {args.every}, wanted at least 1")
    kind = next(name for name in (*_WRITERS, "points", "per_line") if getattr(args, name) is not None)
    for name, kinds in _GO_WITH.items():
        if getattr(args, name) is not None and kind not in kinds:
            *flags, last = map(flag, kinds)
            raise UserError(f"--{name}: wanted with {', '.join(flags)}{' and ' * bool(flags)}{last} only")
    refuse_input_as_output(args, kind)
    path = Path(args.recording)
    refuse_importable(path)
    if kind in ("points", "per_line"):
        return _run_table(path, args)
    if args.topic is None:
        raise UserError("--topic: wanted with --csv, --parquet, --geojson, --gpkg, --sbet and --smrmsg")
    reader = RecordingReader(path)
    try:
        row = topics.find(args.topic)
    except KeyError:
        raise UserError(
            f"--topic {args.topic}: not a topic; topics: {', '.join(t.name for t in topics.TOPICS)}"
        ) from None
    if not len(reader.select([args.topic])):
        raise lacking(reader, f"no message on {args.topic}; {held_topics(reader)}")
    target = Path(getattr(args, kind))
    with new_file(target) as part:
        count: dict[str, Any] = {**_WRITERS[kind](reader, args, part)}
    # read anew: what this reader skipped is counted once
    beside = _element_tables(RecordingReader(path), args, kind, target) if kind in _TABLES else {}
    skipped = sum(reader.problems.values())
    result = {
        "recording": str(path), "topic": args.topic, "type": row.type_name, "file": str(target), **count,
        **({"beside": beside} if beside else {}), "skipped": skipped, "damaged_stretches": len(reader.damage),
        "damage": damage_lines(reader), "not_used": unfit_lines(reader),
    }  # fmt: skip
    if kind not in _TABLES and _is_local(args.topic):
        tell_other_frame("export", reader)
    if args.json:
        print(json_text(result))
        return 0
    if not args.quiet:
        what = ", ".join(f"{number} {name}" for name, number in count.items())
        print(f"{args.topic} -> {target}: {what}")
        for name, rows in beside.items():
            print(f"  {name}: {rows} rows")
    tell_damage("export", reader)
    return 0


def _run_table(path: Path, args: argparse.Namespace) -> int:
    """Points, or the orientation of all lines: tables that are no topic."""
    if args.topic is not None:
        raise UserError(f"--topic {args.topic}: does not go with --points and --per-line")
    target = Path(args.per_line if args.points is None else args.points)
    result: dict[str, Any] = {"recording": str(path), "file": str(target)}
    recording = Recording(path)
    reader = recording.reader
    name = ""
    with new_file(target) as part:
        if args.points is not None:
            project = reader.last("configuration/project")
            refuse_missing_grids("local" if project is None else local_frame(project).crs, path)
            result["points"], live = write_points(reader, part, covariance=bool(args.covariance))
            result |= {"of them live and never final": live} if live else {}
        else:
            name, lines, not_valid = lines_of_recording(recording, args.orientation)
            frame, project = recording.frame(), recording.project()
            refuse_missing_grids(frame.crs, path)
            result |= {"orientation": name, "lines": _write_lines(args.format, part, lines, frame, R_bc_of(project))}
            result |= {"poses left out, not valid": not_valid} if not_valid else {}
    said = ", ".join(f"{v} {k}" for k, v in list(result.items())[2:])
    if args.per_line:
        result |= _write_camera(recording, name, target)
    tell_other_frame("export", reader)
    if args.json:
        print(json_text(result | {"damage": damage_lines(reader), "not_used": unfit_lines(reader)}))
        return 0
    if not args.quiet:
        print(f"{path} -> {target}: {said}")
        if args.per_line and result["camera"]:
            print(f"  {result['camera']}: camera with {result['camera_parameters']} estimated parameters, goes with it")
    tell_damage("export", reader)
    return 0


def _write_camera(recording: Recording, orientation: str, table: Path) -> dict[str, Any]:
    """Write the camera whose parameters were estimated with an orientation beside the table of it."""
    path, n = camera_of_table(table), 0
    path.unlink(missing_ok=True)  # of an earlier table
    if orientation in REFINED:
        camera, n = estimated_camera(recording, recording.camera())
        if n:
            write_camera(path, camera)
    return {"camera_parameters": n, "camera": str(path) if n else None}


def _write_lines(
    format: str | None, path: Path, lines: Iterator[OrientedLines], frame: LocalFrame, R_bc: NDArray[Any]
) -> int:
    if format == "patb":
        return write_patb_lines(path, lines, frame)
    write = {"sbet": write_sbet_lines, "smrmsg": write_smrmsg_lines}.get(format or "csv", write_oriented_lines)
    return write(path, lines, frame, R_bc)


def _messages(reader: RecordingReader, args: argparse.Namespace) -> Iterator[Message]:
    return islice(reader.sorted_messages([args.topic]), 0, None, args.every)


def _answers(reader: RecordingReader, args: argparse.Namespace) -> list[Message]:
    """Every N-th of the messages that no other one about the same time or point replaces, in the local frame of the
    project."""
    messages = reader.sorted_messages([args.topic])
    return answers(args.topic, reader.in_frame(messages) if _is_local(args.topic) else messages)[:: args.every]


def _is_local(topic: str) -> bool:
    """Whether a topic carries poses or points in the local frame: results of nodes, ground points, or truth."""
    family = topics.find(topic).family
    return family in (topics.Family.RESULT, topics.Family.TRUTH) or topic == "observation/control"


def _layout(args: argparse.Namespace) -> RowLayout:
    try:
        return RowLayout(args.topic, None if args.rows in (None, "none") else args.rows)
    except ValueError:
        known = ", ".join((*repeated_messages(topics.find(args.topic).type_name), "none"))
        raise UserError(f"--rows {args.rows}: {args.topic} has no such field, wanted one of {known}") from None


def _batches(reader: RecordingReader, args: argparse.Namespace, layout: RowLayout | ElementLayout) -> Iterator[Any]:
    """Tables of the messages, at least one."""
    messages = _messages(reader, args)
    yield layout.frame(islice(messages, BATCH))
    while some := list(islice(messages, BATCH)):
        yield layout.frame(some)


def _element_tables(reader: RecordingReader, args: argparse.Namespace, kind: str, target: Path) -> dict[str, int]:
    """Write ``target_NAME`` for each repeated sub-message that has elements; rows by file name."""
    found = {}
    for field in () if args.rows else repeated_messages(topics.find(args.topic).type_name):
        if any(len(getattr(message.body, field)) for message in _messages(reader, args)):
            beside = target.with_name(f"{target.stem}_{field}{target.suffix}")
            refuse_input_as_output(args, kind, beside)
            with new_file(beside) as part:
                found[str(beside)] = _TABLES[kind](reader, args, part, ElementLayout(args.topic, field))["rows"]
    return found


def _write_csv(
    reader: RecordingReader, args: argparse.Namespace, target: Path, layout: RowLayout | ElementLayout | None = None
) -> dict[str, int]:
    count = 0
    with open(target, "w", newline="", encoding="utf-8") as file:
        for number, table in enumerate(_batches(reader, args, layout or _layout(args))):
            table.to_csv(file, index=False, header=number == 0, lineterminator="\n")
            count += len(table)
    return {"rows": count}


def _write_parquet(
    reader: RecordingReader, args: argparse.Namespace, target: Path, layout: RowLayout | ElementLayout | None = None
) -> dict[str, int]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UserError("--parquet needs the package pyarrow; install it, or use --csv") from None
    count, writer = 0, None
    try:
        for table in _batches(reader, args, layout or _layout(args)):
            arrow = pyarrow.Table.from_pandas(table, preserve_index=False)
            writer = writer or pyarrow.parquet.ParquetWriter(target, arrow.schema)
            writer.write_table(arrow)
            count += len(table)
    finally:
        if writer is not None:
            writer.close()
    return {"rows": count}


def _project_and_frame(reader: RecordingReader) -> tuple[Any, LocalFrame | None]:
    project = reader.last("configuration/project")
    return project, None if project is None else local_frame(project)


def _features(reader: RecordingReader, args: argparse.Namespace) -> Features:
    try:
        return features_of(args.topic, _answers(reader, args), _project_and_frame(reader)[1])
    except UserError as error:
        raise UserError(f"{reader.path}: {error}") from None


def _write_geojson(reader: RecordingReader, args: argparse.Namespace, target: Path) -> dict[str, int]:
    features = _features(reader, args)
    return {"features": write_geojson(target, features)} | _not_valid(features)


def _write_gpkg(reader: RecordingReader, args: argparse.Namespace, target: Path) -> dict[str, int]:
    features = _features(reader, args)
    return {"features": write_geopackage(target, args.topic, features)} | _not_valid(features)


def _not_valid(features: Features) -> dict[str, int]:
    return {"poses not valid and on no line": features.not_valid} if features.not_valid else {}


def _write_sbet(reader: RecordingReader, args: argparse.Namespace, target: Path) -> dict[str, int]:
    """Poses of the body: the boresight of the project is taken out; positions are those of the perspective centre."""
    project, frame, samples, lost = _valid_poses(reader, args, "--sbet")
    time_ns, position, quaternion = _columns(samples)
    seconds = (time_ns - time_ns[0]) * 1e-9
    velocity_l = Trajectory(seconds, position, quaternion).at(seconds).velocity_l
    write_sbet_poses(target, time_ns, position, matrix_from_quaternion(quaternion), velocity_l, frame, R_bc_of(project))
    return {"records": len(time_ns)} | lost


def _write_smrmsg(reader: RecordingReader, args: argparse.Namespace, target: Path) -> dict[str, int]:
    """Accuracies of what `_write_sbet` writes."""
    project, frame, samples, lost = _valid_poses(reader, args, "--smrmsg")
    time_ns, position, quaternion = _columns(samples)
    unknown = np.full((6, 6), np.nan)
    covariance = np.array([unknown if sample.covariance is None else sample.covariance for sample in samples])
    R_lc = matrix_from_quaternion(quaternion)
    count = write_smrmsg_poses(target, time_ns, position, R_lc, covariance, frame, R_bc_of(project))
    bare = len(samples) - count
    return {"records": count} | lost | ({"poses left out, without covariance": bare} if bare else {})


def _valid_poses(
    reader: RecordingReader, args: argparse.Namespace, option: str
) -> tuple[Any, LocalFrame, list[PoseSample], dict[str, int]]:
    """Project, local frame, valid poses, two at least, and what is said of those that are not.

    Raises
    ------
    UserError : a topic without poses, a recording whose place is not known, too few poses
    """
    if topics.find(args.topic).type is not m.PoseInFrame:
        poses = ", ".join(row.name for row in topics.TOPICS if row.type is m.PoseInFrame)
        raise UserError(f"{option}: {args.topic} has no poses; topics that have: {poses}")
    project, frame = _project_and_frame(reader)
    if frame is None:
        raise UserError(
            f"{reader.path}: no message on configuration/project: the place of the local frame is not known"
        )
    if not frame.is_placed:
        raise UserError(f"{reader.path}: {NOT_PLACED}")
    samples = []
    for message in _answers(reader, args):
        try:
            samples.append(pose_sample(message.body))
        except ValueError as error:
            reader.note_problem("malformed", str(error))
    lost = sum(not sample.valid for sample in samples)  # neither format has a flag
    samples = [sample for sample in samples if sample.valid]
    if len(samples) < 2:
        raise UserError(f"{reader.path}: {len(samples)} valid poses on {args.topic}, wanted at least 2")
    return project, frame, samples, {"poses left out, not valid": lost} if lost else {}


def _columns(samples: Sequence[PoseSample]) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]:
    """Times (n,), positions (n, 3) and quaternions (n, 4) of poses."""
    return (
        np.array([sample.time_ns for sample in samples], dtype=np.int64),
        np.array([sample.position_l for sample in samples]),
        np.array([sample.quaternion for sample in samples]),
    )


#: Those that write tables.
_TABLES = {"csv": _write_csv, "parquet": _write_parquet}
_WRITERS: dict[str, Callable[[RecordingReader, argparse.Namespace, Path], dict[str, int]]] = {
    "csv": _write_csv,
    "parquet": _write_parquet,
    "geojson": _write_geojson,
    "gpkg": _write_gpkg,
    "sbet": _write_sbet,
    "smrmsg": _write_smrmsg,
}
