"""Finds out the kind of a file or folder, and reads its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.measured_trajectory import POSE_GAP_S
from ...solver.navigation.inertial_data import InertialGrade
from ...solver.orthoimage.orientation import SAME_S
from ..convert import SECOND_NS, camera_message, state_noise
from ..errors import UserError
from ..node import Message
from .avirisc import LINE_RATE_HZ, is_avirisc, read_avirisc
from .avirisng import is_avirisng, read_avirisng
from .block_folder import is_block_folder, read_block
from .block_images import with_block_images
from .block_messages import block_messages, not_carried
from .byte_order_mark import without_mark
from .envi_image import is_envi_image
from .geocal_xml import kind_of, read_tie_points
from .gps_time import GPS_EPOCH_S, WEEK_S
from .gpx import has_attitudes, is_gpx, position_messages, read_gpx, read_positions
from .ground_height import NOT_GIVEN, GroundGiven
from .image_lines import ImageStrip, LinesGiven, open_strips, with_lines
from .other_kinds import PARTS, other_kind
from .pos_export import is_pos_export, read_pos_export
from .ros2 import ros2_messages
from .ros2_images import ImageTopics
from .rtklib import is_rtklib
from .sbet import is_sbet, read_sbet
from .scene_block import is_scene_block, read_scene_block
from .scene_images import images_of_scenes, left_out, with_scene_images
from .scene_recording import local_block
from .sensor_folder import POSITIONS, SENSOR_FILES, SensorFolder, positions_alone, read_sensor_folder
from .sensor_recording import sensor_extent, sensor_fixes, sensor_messages
from .smrmsg import is_smrmsg
from .tie_points import statistics, tie_point_messages
from .tiff_image import is_tiff
from .time_columns import same_day
from .track import Accuracy, Mounting, NavigationTrack, frame_of, track_messages
from .trajectory_csv import is_trajectory_csv, read_trajectory_csv
from .vendor_poses import is_headwall, is_resonon, read_headwall, read_resonon
from .waypoint import is_grafnav, is_waypoint, read_waypoint

#: Times before this one, ns, are GPS seconds of the week whose day nobody has said.
_NO_DAY_NS = (GPS_EPOCH_S + 2 * WEEK_S) * SECOND_NS
#: What `triline import` understands: name -> words.
KINDS = {
    "flight": "flight folder (flight.toml)",
    "block": "block folder (camera.json, strips.csv, trajectory.csv, ground_points.csv, image_points.csv)",
    "scenes": "block of satellite scenes (project.toml with [scenes.NAME])",
    "sensors": "sensor folder (imu.csv, gnss.csv, gnss.pos or gnss.txt, attitude.csv)",
    "avirisng": "AVIRIS-NG line-by-line poses (angYYYYMMDDtHHMMSS_eph_att)",
    "avirisc": "AVIRIS-C ephemeris (fYYMMDDtNNpNNrNN..._eph)",
    "pos": "Applanix POS Export text",
    "waypoint": "text of Inertial Explorer (NovAtel Waypoint)",
    "sbet": "SBET",
    "csv": "trajectory as CSV",
    "headwall": "Headwall poses (imu_gps.txt)",
    "resonon": "Resonon poses (.lcf)",
    "gpx": "GPX track",
    "rtklib": "RTKLIB file of positions (.pos)",
    "grafnav": "text of GrafNav (NovAtel Waypoint)",
    "ros2": "ROS 2 bag (folder with metadata.yaml, MCAP file or .db3 file) with NavSatFix, Imu and Image",
    "lines": "image lines: ENVI image with .hdr, TIFF, or with --raw plain values",
    "ties": "AVIRIS-NG tie points (GeoCal XML)",
    "camera": "AVIRIS-NG camera (GLAS GFM XML)",
}


@dataclass(frozen=True)
class Options:
    """Facts that a file may lack and the user gives.

    Attributes
    ----------
    day : of the flight, where the file only has GPS seconds
    crs : of easting and northing, where the file does not say
    mounting : of the camera on the body whose poses the file has
    line_rate_hz : of files with a pose a line and no times
    camera : put into the recording as ``configuration/camera``
    seconds_of_day : SBET times count from midnight
    accuracies : SMRMSG file with those of the poses of an SBET; None for the one beside it under its name, if there is
        one
    accuracy : of poses
    lines : images of a strip, beside poses or sensors, or (with the file itself as image) alone
    ground : where the origin of the local frame is to lie
    without_images : images of a bag are left alone
    poses_only : poses that belong to image lines make no strip
    grade : of the inertial unit: of a sensor folder in place of its platform.toml, of a bag where it states no noise
    folder : the tables of a sensor folder, where they have been read
    """

    day: date | None = None
    crs: str | None = None
    mounting: Mounting = field(default_factory=Mounting)
    line_rate_hz: float = LINE_RATE_HZ
    camera: LineCamera | None = None
    seconds_of_day: bool | None = None
    accuracies: Path | None = None
    accuracy: Accuracy = field(default_factory=Accuracy)
    lines: LinesGiven | None = None
    ground: GroundGiven = NOT_GIVEN
    poses_only: bool = False
    without_images: bool = False
    grade: InertialGrade | None = None
    folder: SensorFolder | None = None


@dataclass(frozen=True)
class Imported:
    """Contents of a file: kind, messages sorted by stamp and rank, remarks (complete once all messages are read)."""

    kind: str
    messages: Iterable[Message]
    notes: list[str] = field(default_factory=list)
    statistics: dict[str, Any] = field(default_factory=dict)


def kind_of_path(path: Path) -> str:
    """One of `KINDS`.

    Raises
    ------
    UserError : nothing there, an empty file, or one of no known kind
    """
    if path.is_dir():
        if (path / "flight.toml").is_file():
            return "flight"
        if is_scene_block(path):
            return "scenes"
        if other := other_kind(path):
            raise UserError(f"{path}: {other}")
        if is_block_folder(path):
            return "block"
        if any((path / name).is_file() for name in SENSOR_FILES):
            return "sensors"
        if (path / "metadata.yaml").is_file():
            return "ros2"
        raise UserError(f"{path}: none of {KINDS['block']}, {KINDS['sensors']} and {KINDS['ros2']}")
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: empty, wanted one of: {', '.join(KINDS)}")
    with open(path, "rb") as file:
        head = without_mark(file.read(512))
    if head.startswith(b"\x89MCAP0\r\n") or (head.startswith(b"SQLite format 3\0") and path.suffix == ".db3"):
        return "ros2"
    if is_avirisng(path):
        return "avirisng"
    if is_avirisc(path):
        return "avirisc"
    if is_gpx(head):
        return "gpx"
    if head.lstrip().startswith(b"<?xml") or b"boost_serialization" in head:
        kind = kind_of(path)
        if kind is None and (other := other_kind(path)):
            raise UserError(f"{path}: {other}")
        if kind is None:
            raise UserError(f"{path}: XML of another kind, wanted {KINDS['ties']} or {KINDS['camera']}")
        return kind
    if is_pos_export(path):
        return "pos"
    if is_waypoint(path):
        return "grafnav" if is_grafnav(path) else "waypoint"
    if is_rtklib(path):
        return "rtklib"
    if is_headwall(path):
        return "headwall"
    if is_resonon(path):
        return "resonon"
    if b"\0" not in head and is_trajectory_csv(path):
        return "csv"
    if is_smrmsg(path):
        raise UserError(f"{path}: accuracies of poses (SMRMSG), wanted their SBET, beside which it is found")
    if is_sbet(path):
        return "sbet"
    if is_envi_image(path) or is_tiff(path):
        return "lines"
    if path.suffix.lower() == ".csv" and path.name not in PARTS:  # its reader names the columns that are missing
        return "csv"
    if other := other_kind(path):
        raise UserError(f"{path}: {other}")
    raise UserError(f"{path}: of no known kind, wanted one of: {', '.join(KINDS)}")


def read_track(path: Path, kind: str, options: Options) -> NavigationTrack:
    """The poses in a file of one of the kinds avirisng, avirisc, pos, waypoint, sbet, csv, headwall, resonon, gpx.

    Raises
    ------
    UserError : from the reader of the kind
    """
    if kind == "avirisng":
        return read_avirisng(path, options.day)
    if kind == "avirisc":
        return read_avirisc(path, options.crs, options.line_rate_hz, options.day)
    if kind == "pos":
        return read_pos_export(path, options.day)
    if kind == "waypoint":
        return read_waypoint(path, options.day)
    if kind == "sbet":
        return read_sbet(path, options.day, seconds_of_day=options.seconds_of_day, accuracies=options.accuracies)
    if kind == "headwall":
        return read_headwall(path, options.day)
    if kind == "resonon":
        return read_resonon(path, options.day)
    if kind == "gpx":
        return read_gpx(path, options.day)
    return read_trajectory_csv(path, options.crs, options.day)


def read_any(path: Path, kind: str | None = None, options: Options | None = None) -> Imported:
    """The messages of a file or folder of any kind but ``camera`` and ``flight``.

    Raises
    ------
    UserError : one line about what is wrong, where, and what was wanted
    """
    kind = kind_of_path(path) if kind is None else kind
    options = Options() if options is None else options
    if kind in ("block", "scenes"):
        lines = options.lines is not None
        scenes = read_scene_block(path, lines) if kind == "scenes" else None
        block = read_block(path, lines) if scenes is None else local_block(scenes)
        notes, messages = [*block.notes, *not_carried(block)], block_messages(block)
        images = {} if scenes is None else images_of_scenes(path, scenes, block)
        if options.lines is None:
            notes += left_out(images)
        elif scenes is None:
            messages = with_block_images(block, messages, options.lines, notes)
        else:
            messages = with_scene_images(block, messages, options.lines, images, notes)
        return Imported(kind, messages, notes)
    if kind == "ties":
        ties = read_tie_points(path)
        return Imported(kind, tie_point_messages(ties, path.stem), statistics=statistics(ties))
    if kind == "lines":
        return _image_alone(path, options)
    notes: list[str] = []
    if kind in ("sensors", *POSITIONS, "ros2") or (kind == "gpx" and not has_attitudes(path)):
        topics = _image_topics(options) if kind == "ros2" else None
        folder = options.folder
        if kind == "gpx":
            positions = read_positions(path, options.day)
            notes.extend(positions.notes)
            messages = position_messages(positions, options.accuracy, notes, "import")
        elif topics is None:
            folder = folder or (
                positions_alone(path, kind, options.day) if kind in POSITIONS else read_sensor_folder(path)
            )
            messages = sensor_messages(folder, notes, grade=options.grade)
        else:
            messages = _with_noise(ros2_messages(path, notes, given=topics), options.grade)
        messages = _on_day(path, messages, options.day)
        if options.ground.stated:
            messages = _at_height(path, kind, messages, options, notes, folder)
        given = options.lines
        files = given is not None and given.files and (topics is None or given.topics is None)
        strips = open_strips(given, options.camera) if files and given is not None else []
        if strips:
            span = sensor_span(path, kind, options) if folder is None else sensor_extent(folder)[0]
            strips = strips if span is None else within(strips, *span, "sensors")
    else:
        track = read_track(path, kind, options)
        notes.extend(track.notes)
        notes.extend(_assumed(path, track, options.accuracy))
        usual_s = float(np.median(np.diff(track.time_ns))) * 1e-9
        if usual_s > POSE_GAP_S:
            what = f"more than {POSE_GAP_S:g} s between two are a gap without orientation for 'process'"
            notes.append(f"{path.name}: poses are {usual_s:.3g} s apart: {what}")
        strips = []
        if options.lines is not None:  # the images are the strip, not the poses
            strips = open_strips(options.lines, options.camera, track.time_ns if track.line_rate_hz > 0 else None)
            strips = within(strips, int(track.time_ns[0]), int(track.time_ns[-1]), "poses")
        if strips or options.poses_only:
            track = replace(track, line_rate_hz=0.0)
        frame = replace(frame_of(track), height_m=options.ground.height(path, track.geodetic, notes))
        messages = track_messages(track, "import", options.mounting, frame, options.accuracy)
    messages = _with_camera(messages, options.camera)
    if strips:
        notes.extend(note for strip in strips for note in strip.notes)
        messages = with_lines(messages, strips, notes)
    return Imported(kind, messages, notes)


def _assumed(path: Path, track: NavigationTrack, accuracy: Accuracy) -> list[str]:
    """A note about accuracies of positions and attitudes that neither the file gives nor the user states."""
    positions, attitudes = track.has_position_sigmas, track.has_attitude_sigmas
    assumed = [
        (f"{values[0]:g} and {values[2]:g} {unit}", option, what)
        for values, unit, option, what, known in (
            (accuracy.position_m, "m", "--position-sigma", "positions", positions or accuracy.position_stated),
            (accuracy.attitude_deg, "deg", "--attitude-sigma", "attitudes", attitudes or accuracy.attitude_stated),
        )
        if not known
    ]
    if not assumed:
        return []
    values, options, which = (", ".join(column) for column in zip(*assumed, strict=True))
    what = which if positions or attitudes else "poses"
    return [f"{path.name}: no accuracies of the {what}: {values} taken ({options})"]


def _image_topics(options: Options) -> ImageTopics:
    """What the user says about images of a bag."""
    lines = options.lines
    if options.without_images:
        return ImageTopics({})
    if lines is None:
        return ImageTopics(camera=options.camera)
    if lines.files and lines.topics is None:  # image files beside the bag
        return ImageTopics({}, options.camera)
    if lines.band is not None or lines.span is not None or lines.times is not None or lines.first is not None:
        raise UserError(
            "--band, --grey-range, --line-times and --first-time are of image files, not of the images in a bag"
        )
    return ImageTopics(lines.topics, options.camera, lines.rate_hz, lines.strip)


def image_alone(path: Path, lines: LinesGiven | None) -> LinesGiven:
    """What is said of images, where the input is one of them.

    Raises
    ------
    UserError : nothing is said of its times, or of other images only
    """
    if lines is None:
        raise UserError(
            f"{path}: times of its lines are missing, wanted --line-times CSV, or --first-time and --line-rate"
        )
    files = lines.files or (("", path, None),)
    if not any(file.exists() and file.samefile(path) for _, file, _ in files):
        raise UserError(
            f"{path}: an image that --lines does not name; wanted poses or sensors as input, or it in --lines"
        )
    return replace(lines, files=files)


def _image_alone(path: Path, options: Options) -> Imported:
    """A recording of image lines and nothing else."""
    strips = open_strips(image_alone(path, options.lines), options.camera)
    notes = [note for strip in strips for note in strip.notes]
    notes.append(f"{path.name}: image lines alone: no poses, and no configuration/project")
    start = int(strips[0].time_ns[0])
    camera = options.camera
    first = [] if camera is None else [Message("configuration/camera", start, camera_message(camera), "import")]
    return Imported("lines", with_lines(first, strips, notes), notes)


def sensor_span(path: Path, kind: str, options: Options) -> tuple[int, int] | None:
    """UTC of the first and the last moment at which a bag or positions have GNSS and, where they have any, inertial
    data or attitudes; None where there is no such moment.
    """
    ends: dict[str, tuple[int, int]] = {}
    for message in read_any(path, kind, Options(options.day, grade=options.grade, without_images=True)).messages:
        first, last = ends.get(message.topic, (message.stamp_ns, message.stamp_ns))
        ends[message.topic] = min(first, message.stamp_ns), max(last, message.stamp_ns)
    moving = next((topic for topic in ("sensor/imu", "sensor/attitude") if topic in ends), "sensor/gnss")
    if "sensor/gnss" not in ends:
        return None
    begin, end = (f(ends[topic][k] for topic in ("sensor/gnss", moving)) for k, f in ((0, max), (1, min)))
    return (begin, end) if begin <= end else None


def within(strips: list[ImageStrip], begin_ns: int, end_ns: int, what: str) -> list[ImageStrip]:
    """The strips, with a note about lines that were imaged before or after there was any of something.

    Of several, those without any such line are left out.

    Parameters
    ----------
    begin_ns, end_ns : UTC of the first and the last one
    what : poses or sensors

    Raises
    ------
    UserError : no line was imaged between these
    """
    inside, outside = [], []
    for strip in strips:
        there = strip.time_ns[-1] >= begin_ns and strip.time_ns[0] <= end_ns
        (inside if there else outside).append(strip)
    if not inside:
        first, last = int(strips[0].time_ns[0]), int(strips[-1].time_ns[-1])
        spans = [f"{_utc(a)} to {_utc(b)}" for a, b in ((first, last), (begin_ns, end_ns))]
        day = " (GPS seconds without a day count from 1980-01-06, wanted --date)" if begin_ns < _NO_DAY_NS else ""
        raise UserError(
            f"strip {strips[0].id}: lines from {spans[0]}, but {what} from {spans[1]}; wanted the same time scale{day}"
        )
    found = [_with_note(strip, begin_ns, end_ns, what) for strip in inside]
    if outside:
        notes = [note for strip in outside for note in strip.notes]
        notes.append(f"outside the time of the {what} and left out: strips {', '.join(strip.id for strip in outside)}")
        found[0] = replace(found[0], notes=(*notes, *found[0].notes))
    return found


def _with_note(strip: ImageStrip, begin_ns: int, end_ns: int, what: str) -> ImageStrip:
    rounded_ns = round(SAME_S * SECOND_NS)
    out = int(np.count_nonzero((strip.time_ns < begin_ns - rounded_ns) | (strip.time_ns > end_ns + rounded_ns)))
    if not out:
        return strip
    note = f"strip {strip.id}: {out} of {len(strip.time_ns)} lines outside the time of the {what}: without orientation"
    return replace(strip, notes=(*strip.notes, note))


def _utc(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _on_day(path: Path, messages: Iterable[Message], day: date | None) -> Iterator[Message]:
    """The messages; raises UserError where they do not begin on the day that the user gives."""
    messages = iter(messages)
    for message in messages:
        same_day(path, message.stamp_ns, day)
        yield message
        break
    yield from messages


def _at_height(
    path: Path, kind: str, messages: Iterable[Message], options: Options, notes: list[str], folder: SensorFolder | None
) -> Iterator[Message]:
    """The messages, with the origin of the local frame on the ground (of sensors: they are not in the local frame)."""
    fixes = np.empty((0, 3))
    if options.ground.height_m is None and folder is not None:
        fixes = sensor_fixes(folder)
    elif options.ground.height_m is None:
        found = read_any(path, kind, Options(options.day, grade=options.grade, without_images=True)).messages
        places = [m.body for m in found if m.topic == "sensor/gnss"]
        fixes = np.array([(b.latitude, b.longitude, b.altitude) for b in places]).reshape(-1, 3)
    height_m = options.ground.height(path, fixes, notes)
    for message in messages:
        if message.topic == "configuration/project":
            message.body.origin_height = height_m
        yield message


def _with_noise(messages: Iterable[Message], grade: InertialGrade | None) -> Iterator[Message]:
    """The messages, with the noise of a unit in the inertial samples that do not state theirs."""
    noise = None if grade is None else (grade.gyro_noise, grade.accel_noise)
    for message in messages:
        if message.topic == "sensor/imu":
            state_noise(message.body, noise)
        yield message


def _with_camera(messages: Iterable[Message], camera: LineCamera | None) -> Iterator[Message]:
    """The messages with the camera inserted after the project."""
    for message in messages:
        yield message
        if camera is not None and message.topic == "configuration/project":
            yield Message("configuration/camera", message.stamp_ns, camera_message(camera), message.source)
