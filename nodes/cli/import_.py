"""``triline import``: block and sensor folders, AVIRIS, POS Export, SBET, CSV, ROS 2, images to a recording."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterable, Iterator
from datetime import date
from pathlib import Path
from typing import Any

from ...solver.camera.sensors import PRESETS
from ..errors import UserError, flag
from ..formats.avirisc import LINE_RATE_HZ, avirisc_has_latitudes
from ..formats.camera_json import write_camera
from ..formats.detect import KINDS, Imported, Options, image_alone, kind_of_path, read_any
from ..formats.envi_image import TYPES
from ..formats.flight_folder import FILE, NAVIGATION, Instead
from ..formats.flight_messages import flight_messages
from ..formats.geocal_xml import read_glas_camera, read_tie_points
from ..formats.gpx import has_attitudes
from ..formats.ground_height import HIGHEST_M, LOWEST_M, NOT_GIVEN, GroundGiven
from ..formats.image_lines import LinesGiven, files_of
from ..formats.json_text import json_text
from ..formats.named_camera import camera_named
from ..formats.new_file import new_file
from ..formats.tie_points import statistics, write_tie_points
from ..formats.track import MOST_BORESIGHT_DEG, MOST_LEVER_ARM_M, Accuracy, Mounting
from ..formats.trajectory_csv import csv_has_latitudes
from ..node import Message
from ..recording.writer import RecordingWriter
from ..terminal import drawing, redraws

EXAMPLE = """triline import block_folder -o flight.mcap
  triline import day.sbet --flight flight_folder -o flight.mcap    # camera, mounting, control: of the folder"""

_GROUND = ("ground_height", "above_ground", "dem", "dem_crs")
_IMAGES = ("lines", "strip", "line_times", "first_time", "band", "raw", "samples", "grey_range")
_SENSORS = ("date", "camera", "line_rate", *_GROUND, *_IMAGES)
_POSES = ("lever_arm", "boresight", "position_sigma", "attitude_sigma", *_SENSORS)
#: Kind of input -> options (as attributes) that have an effect on it.
GO_WITH: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("flight", "ties", "camera"), ()),
    **dict.fromkeys(("sensors", "rtklib", "grafnav", "ros2"), _SENSORS),
    **dict.fromkeys(("avirisng", "pos", "waypoint", "headwall", "resonon", "gpx"), _POSES),
    **dict.fromkeys(("avirisc", "csv"), (*_POSES, "crs")),
    "sbet": (*_POSES, "seconds_of_day", "accuracies"),
    **dict.fromkeys(("block", "scenes"), _IMAGES),
    "lines": ("date", "camera", "line_rate", *_IMAGES),
}
_OPTIONS = ("crs", "seconds_of_day", "accuracies", *_POSES)
#: Options that go with ``--flight``: what the folder cannot say of data that are not in it.
_BESIDE_FLIGHT = ("date", "line_rate", *_IMAGES)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("input", metavar="INPUT", help="file or folder: " + "; ".join(KINDS.values()))
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="recording; camera.json for a camera, CSV for tie points"
    )
    parser.add_argument("--format", choices=KINDS, metavar="KIND", help=f"what the input is: {', '.join(KINDS)}")
    parser.add_argument(
        "--flight", type=Path, metavar="DIR",
        help="flight folder that says all else: INPUT takes the place of its navigation.file or, image lines, of its "
        "[[strips]]",
    )  # fmt: skip
    parser.add_argument("--date", type=_day, metavar="YYYY-MM-DD", help="day of the flight, for files with GPS seconds")
    parser.add_argument("--crs", metavar="CRS", help="of easting and northing, where the file does not say (PROJ)")
    parser.add_argument(
        "--camera", metavar="FILE", help=f"camera.json, AVIRIS-NG camera XML, or a preset ({', '.join(PRESETS)})"
    )
    parser.add_argument(
        "--lever-arm", type=float, nargs=3, metavar=("FWD", "RIGHT", "DOWN"),
        help="from the point whose positions the file gives to the perspective centre, m",
    )  # fmt: skip
    parser.add_argument(
        "--boresight", type=float, nargs=3, metavar=("ROLL", "PITCH", "HEADING"),
        help="of the camera against the body whose attitude the file gives, degrees",
    )  # fmt: skip
    for name, what in (("position", "X Y Z, m (default 0.2 0.2 0.2)"), ("attitude", "deg (default 0.01 0.01 0.02)")):
        axes = ("X", "Y", "Z") if name == "position" else ("OMEGA", "PHI", "KAPPA")
        parser.add_argument(
            f"--{name}-sigma", type=float, nargs=3, metavar=axes,
            help=f"accuracy of the poses, in place of what the file says: {what}",
        )  # fmt: skip
    parser.add_argument(
        "--line-rate",
        type=float,
        metavar="HZ",
        help=f"lines a second: of images, of AVIRIS-C (default {LINE_RATE_HZ:g})",
    )
    parser.add_argument("--seconds-of-day", action="store_true", default=None, help="SBET times count from midnight")
    parser.add_argument(
        "--accuracies", type=Path, metavar="FILE",
        help="accuracies of the poses of an SBET, as SMRMSG (default: smrmsg_7.out beside sbet_7.out)",
    )  # fmt: skip
    ground = parser.add_argument_group("the ground, where the origin of the local frame is put (one of them)")
    ground.add_argument("--ground-height", type=float, metavar="M", help="of the ground above the ellipsoid")
    ground.add_argument("--above-ground", type=float, metavar="M", help="so high the platform flies above the ground")
    ground.add_argument("--dem", type=Path, metavar="FILE", help="raster of heights: their median under the flight")
    ground.add_argument("--dem-crs", metavar="CRS", help="of the raster's heights: ellipsoid, EPSG:5773 ..")
    images = parser.add_argument_group("image lines")
    images.add_argument(
        "--lines", action="append", metavar="VIEW=FILE,..",
        help="images (ENVI, TIFF, raw) of one strip, one for each CCD line (F=forward.img,N=nadir.img); FILE@BAND for "
        "a band of it; of a ROS 2 bag topics (N=/camera/nadir); of a block folder one a strip and CCD line "
        "(S1/F=f.img), of satellite scenes one a scene (scene/F=f.tif)",
    )  # fmt: skip
    images.add_argument("--strip", metavar="ID", help="of the images (default: name of the first file)")
    images.add_argument(
        "--line-times", type=Path, metavar="FILE", help="CSV: line, and time, time_s or gps_s; Resonon; Headwall"
    )
    images.add_argument("--first-time", metavar="ISO", help="time of line 0 (UTC), with --line-rate")
    images.add_argument("--band", metavar="BAND", help="number from 1, name, or weighted sum: 2:0.5,3:0.5")
    images.add_argument("--raw", choices=TYPES, metavar="TYPE", help=f"of files without a header: {', '.join(TYPES)}")
    images.add_argument(
        "--samples", type=int, metavar="N", help="pixels of a raw line (default: of the camera's CCD line)"
    )
    images.add_argument(
        "--grey-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="values that become black and white"
    )


def _day(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a day, wanted YYYY-MM-DD") from None


def run(args: argparse.Namespace) -> int:
    source, output = Path(args.input), Path(args.output)
    _check_numbers(args)
    kind = args.format or ("lines" if _is_raw_image(args, source) else kind_of_path(source))
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    _refuse_options(args, kind, source)
    if args.flight is not None:
        imported, platform = flight_messages(args.flight, _instead(args, kind, source))
        result = _write(source, imported, output, platform, shown=not args.quiet and not args.json)
    elif kind == "flight":
        imported, platform = flight_messages(source)
        result = _write(source, imported, output, platform, shown=not args.quiet and not args.json)
    elif kind == "camera":
        result = _import_camera(source, output)
    elif kind == "ties" and output.suffix.lower() == ".csv":
        ties = read_tie_points(source)
        result = {"rows": write_tie_points(output, ties), "statistics": statistics(ties), "notes": []}
    else:
        of_camera: list[str] = []
        options = Options(
            args.date,
            args.crs,
            Mounting(args.lever_arm or Mounting.lever_arm_m, args.boresight or Mounting.boresight_deg),
            args.line_rate or LINE_RATE_HZ,
            None if args.camera is None else camera_named(args.camera, "--camera", of_camera),
            args.seconds_of_day,
            args.accuracies,
            _accuracy(args),
            _lines(args, kind),
            _ground(args),
        )
        imported = read_any(source, kind, options)
        imported.notes.extend(of_camera)
        result = _write(source, imported, output, "demo", shown=not args.quiet and not args.json)
    flight = {} if args.flight is None else {"flight": str(args.flight)}
    result = {"input": str(source), "kind": kind, **flight, "output": str(output), **result}
    if args.json:
        print(json_text(result))
    elif not args.quiet:
        _print_summary(result)
    return 0


def _is_raw_image(args: argparse.Namespace, source: Path) -> bool:
    """Whether the input is an image that does not say so: there is no other one, or ``--lines`` names it, too."""
    named = [path.absolute() for _, path, _ in files_of(args.lines or ())]
    return args.raw is not None and (not named or source.absolute() in named)


def _instead(args: argparse.Namespace, kind: str, source: Path) -> Instead:
    """What the input is in place of, in the flight folder.

    Raises
    ------
    UserError : an input that is no part of a flight
    """
    if kind not in (*NAVIGATION, "lines"):
        raise UserError(f"--flight: goes with poses, sensors, a ROS 2 bag or image lines, not with {KINDS[kind]}")
    lines = _lines(args, kind)
    if kind == "lines":
        return Instead(day=args.date, lines=image_alone(source, lines))
    if lines is not None and not lines.files and lines.rate_hz is None and not lines.strip:
        lines = None  # the image topics of the folder
    return Instead(source, kind, args.date, lines)


def _check_numbers(args: argparse.Namespace) -> None:
    """Raise UserError for a number that cannot be."""
    if args.line_rate is not None and not 0 < args.line_rate < math.inf:
        raise UserError(f"--line-rate {args.line_rate:g}, wanted a number above 0 (Hz)")
    for name, most, wanted in (
        ("lever_arm", MOST_LEVER_ARM_M, f"metres within {MOST_LEVER_ARM_M:g}; are they mm?"),
        ("boresight", MOST_BORESIGHT_DEG, f"degrees within {MOST_BORESIGHT_DEG:g}"),
    ):
        values = getattr(args, name) or ()
        if not all(abs(value) <= most for value in values):
            raise UserError(f"{flag(name)} {' '.join(f'{v:g}' for v in values)}: wanted {wanted}")


def _ground(args: argparse.Namespace) -> GroundGiven:
    """What the arguments say about the height of the ground.

    Raises
    ------
    UserError : arguments that do not go together
    """
    given = [name for name in ("ground_height", "above_ground", "dem") if getattr(args, name) is not None]
    if not given:
        if args.dem_crs is not None:
            raise UserError(f"--dem-crs {args.dem_crs}: is of a raster of heights, wanted --dem FILE with it")
        return NOT_GIVEN
    if len(given) > 1:
        raise UserError(f"{' and '.join(flag(name) for name in given)}: wanted one of them")
    if args.above_ground is not None and not 0 < args.above_ground < math.inf:
        raise UserError(f"--above-ground {args.above_ground:g}, wanted more than 0 m")
    if args.ground_height is not None and not LOWEST_M < args.ground_height < HIGHEST_M:
        raise UserError(f"--ground-height {args.ground_height:g}, wanted metres from {LOWEST_M:g} to {HIGHEST_M:g}")
    return GroundGiven(args.ground_height, args.dem, args.dem_crs, args.above_ground)


def _lines(args: argparse.Namespace, kind: str) -> LinesGiven | None:
    """What the arguments say about images; None without any.

    Raises
    ------
    UserError : arguments that do not go together
    """
    if args.samples is not None and (args.raw is None or args.samples < 1):
        raise UserError(f"--samples {args.samples}: wanted the pixels of a line, with --raw TYPE")
    raw, strip = None if args.raw is None else (args.raw, args.samples or 0), args.strip or ""
    if not args.lines and kind != "lines":
        alone = {"ros2": ("strip", "line_rate"), "avirisc": ("line_rate",)}.get(kind, ())
        for name in (*_IMAGES, "line_rate"):
            if getattr(args, name) is not None and name not in alone:
                raise UserError(f"{flag(name)} is of images, wanted --lines VIEW=FILE with it")
        return LinesGiven((), strip, rate_hz=args.line_rate) if kind == "ros2" else None
    if kind == "lines" and args.date is not None and args.line_times is None:
        raise UserError("--date goes with --line-times: a first time has its day")
    files, first = files_of(args.lines or ()), None
    if args.first_time is not None:
        if args.line_rate is None:
            raise UserError("--first-time without --line-rate, wanted both")
        first = (args.first_time, args.line_rate)
    elif args.line_rate is not None and kind != "avirisc" and LinesGiven(files).topics is None:
        raise UserError("--line-rate without --first-time, wanted both")
    span = None if args.grey_range is None else (args.grey_range[0], args.grey_range[1])
    if span is not None and not -math.inf < span[0] < span[1] < math.inf:
        raise UserError(f"--grey-range {span[0]:g} {span[1]:g}, wanted two numbers, the lower one first")
    return LinesGiven(files, strip, args.line_times, first, args.band, span, args.date, raw, args.line_rate)


def _accuracy(args: argparse.Namespace) -> Accuracy:
    position, attitude = args.position_sigma, args.attitude_sigma
    for name, values in (("position", position), ("attitude", attitude)):
        if values is not None and not all(0 < value < float("inf") for value in values):
            raise UserError(f"--{name}-sigma {' '.join(f'{v:g}' for v in values)}: wanted three numbers above 0")
    default = Accuracy()
    x, y, z = position or default.position_m
    omega, phi, kappa = attitude or default.attitude_deg
    return Accuracy((x, y, z), (omega, phi, kappa), position is not None, attitude is not None)


def _import_camera(source: Path, output: Path) -> dict[str, Any]:
    if output.suffix.lower() != ".json":
        raise UserError(f"{output}: a camera goes to a camera.json, wanted a name that ends with .json")
    notes: list[str] = []
    camera = read_glas_camera(source, notes)
    write_camera(output, camera)
    return {"lines": {line.id: line.pixels for line in camera.lines}, "notes": notes}


def _refuse_options(args: argparse.Namespace, kind: str, source: Path) -> None:
    """Raise UserError for an option that has no effect on what is imported."""
    given = [name for name in _OPTIONS if getattr(args, name) is not None]
    for name in given:
        if args.flight is not None and name not in _BESIDE_FLIGHT:
            raise UserError(f"{flag(name)} does not go with --flight: it stands in {args.flight / FILE}")
        if name not in GO_WITH[kind]:
            what = "a flight folder: it stands in flight.toml" if kind == "flight" else KINDS[kind]
            raise UserError(f"{flag(name)} does not go with {what}")
    if "crs" in given and (avirisc_has_latitudes if kind == "avirisc" else csv_has_latitudes)(source):
        raise UserError(f"--crs {args.crs}: does not go with {source}, whose positions are latitude and longitude")
    of_attitudes = [name for name in ("lever_arm", "boresight", "attitude_sigma") if name in given]
    if kind == "gpx" and of_attitudes and not has_attitudes(source):
        raise UserError(f"{flag(of_attitudes[0])} does not go with {source}, whose positions have no attitudes")
    if args.seconds_of_day and args.date is None:
        raise UserError("--seconds-of-day goes with --date: of which day?")


def _write(source: Path, imported: Imported, output: Path, platform: str, *, shown: bool) -> dict[str, Any]:
    messages = iter(imported.messages)
    first = next(messages, None)  # errors of the input are found before a file is made
    if first is None:
        raise UserError(f"{source}: nothing in it to import")
    start = end = first.stamp_ns
    with new_file(output) as part, RecordingWriter(part, platform=platform) as writer:
        writer.write(first)
        for message in _with_progress(messages, shown):
            writer.write(message)
            end = max(end, message.stamp_ns)
        counts = dict(sorted(writer.counts.items()))
    result: dict[str, Any] = {"seconds": (end - start) * 1e-9, "messages": counts, "notes": imported.notes}
    if imported.statistics:
        result["statistics"] = imported.statistics
    return result


def _with_progress(messages: Iterable[Message], shown: bool) -> Iterator[Message]:
    """The messages; their number is shown in one line that is updated on a terminal, every 5 s elsewhere."""
    terminal = redraws(sys.stderr)
    told = time.monotonic()
    for i, message in enumerate(messages):
        if shown and i % 1000 == 0 and time.monotonic() - told > (0.2 if terminal else 5.0):
            told = time.monotonic()
            if terminal:
                print(f"\r{i} messages", end="", file=drawing(sys.stderr))
            else:
                print(f"{i} messages", file=sys.stderr)
        yield message
    if shown and terminal:
        print("\r\x1b[K", end="", file=drawing(sys.stderr), flush=True)


def _print_summary(result: dict[str, Any]) -> None:
    flight = f" with {result['flight']}" if "flight" in result else ""
    print(f"{result['input']} ({KINDS[result['kind']]}){flight} -> {result['output']}")
    for topic, count in result.get("messages", {}).items():
        print(f"  {topic:24s} {count:8d}")
    if "seconds" in result:
        print(f"  {result['seconds']:.3f} s of flight")
    if "rows" in result:
        print(f"  {result['rows']} image points")
    for id, pixels in result.get("lines", {}).items():
        print(f"  CCD line {id}: {pixels} pixels")
    for name, value in result.get("statistics", {}).items():
        if isinstance(value, dict):
            for what, (median, most, largest) in value.items():
                print(f"  {name} {what}: median {median:g}, 95 % below {most:g}, largest {largest:g}")
        else:
            print(f"  {name}: {value}")
    for note in result["notes"]:
        print(f"  note: {note}")
