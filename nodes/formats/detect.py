"""What a file or folder is, and its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from ...solver.camera import LineCamera
from ..convert import camera_message
from ..errors import UserError
from ..node import Message
from ..recording import RecordingReader
from .avirisc import LINE_RATE_HZ, is_avirisc, read_avirisc
from .avirisng import is_avirisng, read_avirisng
from .block_folder import is_block_folder, read_block
from .block_messages import block_messages, not_carried
from .geocal_xml import kind_of, read_tie_points
from .pos_export import is_pos_export, read_pos_export
from .ros2 import is_ros2, ros2_messages
from .sbet import is_sbet, read_sbet
from .sensor_recording import sensor_messages
from .tie_points import statistics, tie_point_messages
from .track import Accuracy, Mounting, NavigationTrack, track_messages
from .trajectory_csv import is_trajectory_csv, read_trajectory_csv

#: What `triline import` understands: name -> words.
KINDS = {
    "block": "block folder (camera.json, strips.csv, trajectory.csv, ground_points.csv, image_points.csv)",
    "sensors": "sensor folder (imu.csv, gnss.csv, attitude.csv)",
    "avirisng": "AVIRIS-NG line-by-line poses (angYYYYMMDDtHHMMSS_eph_att)",
    "avirisc": "AVIRIS-C ephemeris (fYYMMDDtNNpNNrNN..._eph)",
    "pos": "Applanix POS Export text",
    "sbet": "SBET",
    "csv": "trajectory as CSV",
    "ros2": "ROS 2 recording (MCAP) with NavSatFix and Imu",
    "ties": "AVIRIS-NG tie points (GeoCal XML)",
    "camera": "AVIRIS-NG camera (GLAS GFM XML)",
}


@dataclass(frozen=True)
class Options:
    """What a file may need to be told.

    Attributes
    ----------
    day : of the flight, where the file only has GPS seconds
    crs : of easting and northing, where the file does not say
    mounting : of the camera on the body whose poses the file has
    line_rate_hz : of files with a pose a line and no times
    camera : put into the recording as ``configuration/camera``
    seconds_of_day : SBET times count from midnight
    accuracy : of poses
    """

    day: date | None = None
    crs: str | None = None
    mounting: Mounting = field(default_factory=Mounting)
    line_rate_hz: float = LINE_RATE_HZ
    camera: LineCamera | None = None
    seconds_of_day: bool | None = None
    accuracy: Accuracy = field(default_factory=Accuracy)


@dataclass(frozen=True)
class Imported:
    """What came of a file: kind, messages sorted by stamp and rank, remarks (complete once all messages are read)."""

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
        if is_block_folder(path):
            return "block"
        if any((path / name).is_file() for name in ("imu.csv", "gnss.csv", "attitude.csv")):
            return "sensors"
        raise UserError(f"{path}: neither {KINDS['block']} nor {KINDS['sensors']}")
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: empty, wanted one of: {', '.join(KINDS)}")
    with open(path, "rb") as file:
        head = file.read(512)
    if head.startswith(b"\x89MCAP0\r\n"):
        return "ros2"
    if is_avirisng(path):
        return "avirisng"
    if is_avirisc(path):
        return "avirisc"
    if head.lstrip().startswith(b"<?xml") or b"boost_serialization" in head:
        kind = kind_of(path)
        if kind is None:
            raise UserError(f"{path}: XML of another kind, wanted {KINDS['ties']} or {KINDS['camera']}")
        return kind
    if is_pos_export(path):
        return "pos"
    if b"\0" not in head and is_trajectory_csv(path):
        return "csv"
    if is_sbet(path):
        return "sbet"
    if path.suffix.lower() == ".csv":  # let the reader say which columns it misses
        return "csv"
    raise UserError(f"{path}: of no known kind, wanted one of: {', '.join(KINDS)}")


def read_track(path: Path, kind: str, options: Options) -> NavigationTrack:
    """The poses in a file of one of the kinds avirisng, avirisc, pos, sbet, csv.

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
    if kind == "sbet":
        return read_sbet(path, options.day, seconds_of_day=options.seconds_of_day)
    return read_trajectory_csv(path, options.crs)


def read_any(path: Path, kind: str | None = None, options: Options | None = None) -> Imported:
    """The messages of a file or folder of any kind but ``camera``.

    Raises
    ------
    UserError : one line about what is wrong, where, and what was wanted
    """
    kind = kind_of_path(path) if kind is None else kind
    options = Options() if options is None else options
    if kind == "block":
        block = read_block(path)
        return Imported(kind, block_messages(block), [*block.notes, *not_carried(block)])
    if kind == "sensors":
        notes: list[str] = []
        return Imported(kind, _with_camera(sensor_messages(path, notes), options.camera), notes)
    if kind == "ros2":
        reader = RecordingReader(path)
        if not is_ros2(reader):
            if any(channel.known for channel in reader.channels.values()):
                raise UserError(f"{path}: is a triline recording already")
            raise UserError(f"{path}: an MCAP file without sensor_msgs/msg/NavSatFix or sensor_msgs/msg/Imu")
        notes = [f"{path.name}: damaged, {damage}" for damage in reader.damage[:3]]
        return Imported(kind, _with_camera(ros2_messages(reader, notes), options.camera), notes)
    if kind == "ties":
        ties = read_tie_points(path)
        return Imported(kind, tie_point_messages(ties, path.stem), statistics=statistics(ties))
    track = read_track(path, kind, options)
    messages = track_messages(track, "import", options.mounting, accuracy=options.accuracy)
    notes = list(track.notes)
    if track.sigma_ned_m is None and not options.accuracy.stated:
        east, _, up = options.accuracy.position_m
        omega, _, kappa = options.accuracy.attitude_deg
        taken = f"{east:g} and {up:g} m, {omega:g} and {kappa:g} deg taken (--position-sigma, --attitude-sigma)"
        notes.append(f"{path.name}: no accuracies of the poses: {taken}")
    return Imported(kind, _with_camera(messages, options.camera), notes)


def _with_camera(messages: Iterable[Message], camera: LineCamera | None) -> Iterator[Message]:
    """The messages with the camera behind the project."""
    for message in messages:
        yield message
        if camera is not None and message.topic == "configuration/project":
            yield Message("configuration/camera", message.stamp_ns, camera_message(camera), message.source)
