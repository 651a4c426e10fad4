"""The flight folder: ``flight.toml`` names what a flight consists of; here it is read and checked."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...solver.arrays import Array
from ...solver.camera.line_camera import LineCamera
from ...solver.camera.sensors import PRESETS, preset
from ...solver.geometry.earth import ecef_from_geodetic
from ...solver.geometry.frames import CrsError, LocalFrame, known_crs, outside_area
from ...solver.models import WANDER_SIGMAS, WANDER_TIMES
from ...solver.navigation.inertial_data import MEMS, TACTICAL, InertialGrade
from .. import config, registry
from ..errors import UserError
from ..first_of import first_of
from .block_messages import SIGMAS
from .camera_json import read_camera
from .dem import read_dem
from .detect import KINDS, Options, kind_of_path, read_any, read_track, sensor_span, within
from .envi_image import TYPES
from .geocal_xml import read_glas_camera
from .ground_height import HIGHEST_M, LOWEST_M, NOT_GIVEN, GroundGiven
from .ground_points import FAR_M, read_ground_points
from .image_cubes import cubes_of, is_pattern
from .image_lines import ImageStrip, LinesGiven, open_strips
from .keys import Keys, is_there, read_toml
from .line_time_files import times_beside
from .projection import LONGEST_NAME, missing_grids, off_without_grids, unknown_heights, with_heights
from .sensor_folder import SensorFolder, read_grade, read_sensor_folder, refuse_mounting
from .sensor_recording import sensor_extent, some
from .time_columns import instant_ns
from .track import Mounting, NavigationTrack

FILE = "flight.toml"
#: Control that lies farther outside of the area of its CRS, degrees, is likely to be in another one: maps are used in
#: neighbouring zones, too.
OUTSIDE_DEG = 5.0
#: Images of a strip that are named where they are missing.
MISSING_SHOWN = 3
#: What `navigation.file` may be.
NAVIGATION = ("sensors", "ros2", "avirisng", "avirisc", "pos", "waypoint", "sbet", "csv", "headwall", "resonon", "gpx")
#: Slow errors of positions by kind of GNSS solution, m: constant in a strip, and wandering (east, north, up), and the
#: correlation time, s. Usual figures of such solutions, to be replaced by what is known of the own one.
POSITION_ERRORS = {
    "RTK": ((0.03, 0.03, 0.05), (0.02, 0.02, 0.03), 60.0),
    "PPP": ((0.1, 0.1, 0.2), (0.05, 0.05, 0.1), 120.0),
    "code": ((1.0, 1.0, 2.0), (0.5, 0.5, 1.0), 60.0),
}
#: Slow errors of attitudes by grade of the inertial unit, degrees: constant in a strip, drift over it, and wandering
#: (omega, phi, kappa). Usual figures of such units, to be replaced by what is known of the own one.
ATTITUDE_ERRORS = {
    "tactical": ((0.005, 0.005, 0.01), (0.002, 0.002, 0.005), (0.002, 0.002, 0.004)),
    "MEMS": ((0.05, 0.05, 0.15), (0.02, 0.02, 0.05), (0.02, 0.02, 0.05)),
}
_GRADES = {"tactical": TACTICAL, "MEMS": MEMS}
_IMU = ("gyro_noise_deg_sqrt_h", "gyro_bias_deg_h", "accel_noise_m_s_sqrt_h", "accel_bias_mgal", "bias_time_s")
#: Table of a flight.toml -> its keys; "" has the tables themselves.
_KEYS = {
    "": (
        "flight",
        "camera",
        "mounting",
        "navigation",
        "trajectory",
        "imu",
        "control",
        "dem",
        "strips",
        "nodes",
        "sensor",
    ),
    "flight": ("name", "platform", "crs", "vertical_datum", "ground_height_m", "above_ground_m", "origin_deg"),
    "camera": ("file", "preset"),
    "mounting": ("lever_arm_m", "camera_lever_arm_m", "boresight_deg"),
    "navigation": ("file", "accuracies", "kind", "date", "gnss", "imu", "images", "line_rate_hz"),
    "trajectory": (*SIGMAS, *WANDER_TIMES),
    "imu": (*_IMU, "gyro_scale_ppm", "accel_scale_ppm"),
    "control": ("file",),
    "dem": ("file", "crs", "sigma_m", "shift_sigma_m"),
    "strips": (*("id", "images", "line_times", "first_time", "line_rate_hz", "band", "grey_range", "type", "samples"),),
}
#: Options of `triline import` in what readers say, and the keys that stand for them here.
_AS_KEYS = (
    (r"--grey-range LOW HIGH", "grey_range = [LOW, HIGH]"),
    (r"--band ([\w:.,+-]*\w)", r'band = "\1"'),
    (r"--raw TYPE", "type (u1, u2 or >u2)"),
    (r"--samples\b", "samples"),
    (r"--line-times(?: CSV)?", "line_times"),
    (r"--first-time\b", "first_time"),
    (r"--line-rate\b", "line_rate_hz"),
    (r"--date\b", "navigation.date"),
    (r"--crs\b", "flight.crs"),
    (r"--ground-height\b", "flight.ground_height_m"),
    (r"--camera\b", "camera.file"),
)
#: Of these, options of `triline import` that say of image lines what [[strips]] says of those in the folder.
_OF_LINES = ("--grey-range", "--band", "--raw", "--samples", "--line-times", "--first-time", "--line-rate")
_ZERO = (0.0, 0.0, 0.0)
T = TypeVar("T")


@dataclass(frozen=True)
class Instead:
    """Data of a flight that are named beside its folder, in place of those in it.

    Attributes
    ----------
    navigation, kind : file of poses or sensors, one of `NAVIGATION`; None for that of the folder
    day : of the flight; None for what the folder says
    lines : image files of a strip, or topics of a bag; None for the strips of the folder
    """

    navigation: Path | None = None
    kind: str = ""
    day: date | None = None
    lines: LinesGiven | None = None

    @property
    def files(self) -> LinesGiven | None:
        """The image files of a strip; None for topics of a bag."""
        return self.lines if self.lines is not None and self.lines.files and self.lines.topics is None else None

    @property
    def options(self) -> tuple[str, ...]:
        """Options that have said it: what is wrong with them is told by their names, and not by those of keys."""
        return (*(["--date"] if self.day else []), *(_OF_LINES if self.lines is not None else ()))


@dataclass
class Flight:
    """What a ``flight.toml`` says, read and checked.

    Attributes
    ----------
    folder : it stands in
    name, platform : of the flight; the platform is the first word of the topics on the bus
    crs : of control and results, with the vertical datum
    ground_height_m : above the ellipsoid, the height of the local frame's origin, where it is known by now
    ground : what is said of it, for what has positions of the flight
    camera : LineCamera
    lever_arm_m : antenna from the inertial sensor, body axes forward-right-down
    mounting : of the camera on the body
    navigation, kind, day : file of poses or sensors, one of `NAVIGATION`, and the day of the flight
    accuracies : SMRMSG file with those of the poses of an SBET, where the folder names one
    track : the poses, where the file has poses and not sensors
    tables : of a sensor folder, as they were read
    places_deg : (n, 2) latitude and longitude of some places that were flown over; None where they are not known
    span_ns : UTC of the first and the last pose, or of sensors that make poses; None where it is not known
    sigmas : slow errors, named as in `configuration/project`
    grade : of the inertial unit
    control : file, or None
    strips : images, opened
    origin_deg : latitude and longitude of the local frame of a live flight, where they are stated
    announced : strips of a live flight that are known beforehand: id, time of the first line in ns, lines a second
    sensors : tables of the sensor programs of a live flight
    lines : image topics of a ROS 2 bag, where they are stated
    options : of the command line that say something in place of keys
    notes : remarks
    problems : what is wrong or missing, a line each; an empty list for a flight that can be imported
    """

    folder: Path
    name: str = ""
    platform: str = "aircraft"
    crs: str = ""
    ground_height_m: float = 0.0
    ground: GroundGiven = NOT_GIVEN
    camera: LineCamera | None = None
    lever_arm_m: tuple[float, ...] = _ZERO
    mounting: Mounting = field(default_factory=Mounting)
    navigation: Path | None = None
    kind: str = ""
    day: date | None = None
    accuracies: Path | None = None
    track: NavigationTrack | None = None
    tables: SensorFolder | None = None
    places_deg: Array | None = None
    span_ns: tuple[int, int] | None = None
    sigmas: dict[str, Any] = field(default_factory=dict)
    grade: InertialGrade = MEMS
    control: Path | None = None
    strips: list[ImageStrip] = field(default_factory=list)
    origin_deg: tuple[float, float] | None = None
    announced: list[tuple[str, int, float]] = field(default_factory=list)
    sensors: list[Keys] = field(default_factory=list)
    lines: LinesGiven | None = None
    options: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def attempt(self, work: Callable[[], T]) -> T | None:
        """What ``work`` returns; None where it raises, with its line among the problems."""
        try:
            return work()
        except UserError as error:
            self.problems.append(self.in_keys(str(error)))
        except OSError as error:
            self.problems.append(f"{error.filename}: {(error.strerror or str(error)).lower()}")
        return None

    def in_keys(self, text: str) -> str:
        """What a reader says, with keys of the ``flight.toml`` for the options that it names and nobody gave."""
        for option, key in _AS_KEYS:
            if not option.startswith(self.options):
                text = re.sub(option, key, text)
        return text


def _instead_of_flight(folder: Path) -> str:
    """What is to be done about a folder without a flight, or what lies in it."""
    recordings = sorted(path.name for path in folder.glob("*.mcap"))
    if recordings:
        many = f", {len(recordings)} recordings" if len(recordings) > 1 else ""
        return f", but {recordings[0]}{many}: a recording is given itself"
    if (folder / "result.json").is_file():
        return ", but result.json: it holds results of a command"
    return f"; `triline new flight {shlex.quote(str(folder))}` writes one"


def read_flight(folder: Path, live: bool | None = None, instead: Instead | None = None) -> Flight:
    """A flight folder with all that is wrong in it among its ``problems``.

    Parameters
    ----------
    folder : with a flight.toml
    live : the data are still to come: files of navigation and images are not wanted. None = where the file names
        sensors and no file of navigation
    instead : data that are not those in the folder; strips without images are left out then

    Raises
    ------
    UserError : no flight.toml, or one that is not TOML
    """
    path = folder / FILE
    others = instead or Instead()
    if not path.is_file():
        if folder.is_file():
            raise UserError(f"{folder}: is a file, wanted a folder with {FILE}")
        raise UserError(f"{folder}: no {FILE}{_instead_of_flight(folder)}")
    file = read_toml(path)
    flight = Flight(folder, options=others.options)
    tables: dict[str, Keys] = {}
    for name in (name for name in _KEYS[""] if name not in ("strips", "sensor")):
        tables[name] = flight.attempt(lambda name=name: file.table(name)) or Keys(path, {}, name)
    strips = flight.attempt(lambda: file.tables("strips")) if file.has("strips") else []
    flight.sensors = (flight.attempt(lambda: file.tables("sensor")) or []) if file.has("sensor") else []
    if live is None:
        live = bool(flight.sensors) and not tables["navigation"].has("file")
    flight.attempt(lambda: _general(flight, tables["flight"]))
    flight.attempt(lambda: _camera(flight, tables["camera"]))
    flight.attempt(lambda: _mounting(flight, tables["mounting"]))
    flight.attempt(lambda: _navigation(flight, tables["navigation"], live, others))
    flight.attempt(lambda: _errors(flight, tables["navigation"], tables["trajectory"], tables["imu"]))
    if flight.tables is not None:
        _beside_platform(flight, flight.tables, tables["mounting"])
    flight.attempt(lambda: _ground(flight, tables["dem"], tables["flight"]))
    flight.attempt(lambda: _control(flight, tables["control"], tables["flight"]))
    given = others.files
    for keys in strips or [] if given is None else []:
        if instead is not None and not keys.has("images"):
            id = keys.raw("id")
            flight.notes.append(f"{FILE}: {keys.name('id')}: {id!r} has no images: the recording has no lines of it")
            continue
        flight.attempt(lambda keys=keys: (_announced if live else _strip)(flight, keys))
    places = flight.places_deg
    if places is None and flight.origin_deg is not None:
        places = np.array([flight.origin_deg])
    if flight.crs and flight.control is None and places is not None:
        _tell_outside(flight, f"{FILE}: the flight", places, "is that the CRS of the results?")
    if given is not None:
        flight.attempt(lambda: _open(flight, replace(given, day=flight.day)))
    elif not strips and not live and flight.kind != "ros2":
        flight.notes.append(f"{FILE}: no [[strips]]: the recording has no image lines")
    raw = flight.kind == "ros2" or (flight.tables is not None and flight.tables.time_s is not None)
    stated = ["mounting.camera_lever_arm_m"] if any(flight.mounting.lever_arm_m) else []
    stated += [f"imu.{key}" for key in config.UNIT if tables["imu"].has(key)]
    if raw and stated:
        how = f"the navigator gets {'it' if len(stated) == 1 else 'them'} with --config {shlex.quote(str(path))}"
        flight.notes.append(f"{FILE}: {', '.join(stated)}: a recording has no place for that; {how}")
    ids = [id for id, _, _ in flight.announced] if live else [strip.id for strip in flight.strips]
    for id in sorted({id for id in ids if ids.count(id) > 1}):
        flight.problems.append(f"{path}: strips: {id!r} comes twice, wanted another id for each strip")
    flight.notes.extend(_at_once(flight.strips))
    for name in tables["nodes"].values:
        flight.attempt(lambda name=name: _node(tables["nodes"], name))
    for keys in (file, *tables.values(), *(strips or [])):
        known = _KEYS.get(keys.where.partition("[")[0], tuple(keys.values))
        unknown = [key for key in keys.values if key not in known]
        flight.problems.extend(f"{path}: {keys.name(key)}: not known, wanted {', '.join(known)}" for key in unknown)
    return flight


def _at_once(strips: list[ImageStrip]) -> list[str]:
    """A note for each strip whose lines were imaged while those of another one were."""
    notes, before = [], None
    for strip in sorted(strips, key=lambda strip: int(strip.time_ns[0])):
        if before is not None and strip.time_ns[0] <= before.time_ns[-1]:
            notes.append(
                f"{FILE}: strips {before.id} and {strip.id} are imaged at the same time: of one camera a time is "
                "wrong; cameras that look at once want a folder each, since lines of one strip at a time are matched"
            )
        if before is None or strip.time_ns[-1] > before.time_ns[-1]:
            before = strip
    return notes


def refuse_problems(flight: Flight) -> None:
    """Raise UserError with the first problem of a folder and the number of the others, if there is any."""
    if flight.problems:
        more = len(flight.problems) - 1
        command = f"triline check {shlex.quote(str(flight.folder))}"
        others = f" (and {more} more: `{command}` names them)" if more else ""
        raise UserError(f"{flight.problems[0]}{others}")


def _general(flight: Flight, keys: Keys) -> None:
    flight.name = keys.text("name", flight.folder.resolve().name)
    flight.platform = keys.text("platform", "aircraft")
    if not flight.platform.replace("_", "").replace("-", "").isalnum():
        flight.problems.append(str(keys.refuse("platform", "a word of letters, digits, _ and -")))
    flight.ground_height_m = flight.attempt(lambda: _ground_height(keys)) or 0.0
    if keys.has("origin_deg"):
        flight.attempt(lambda: _origin(flight, keys))
    crs = flight.attempt(lambda: keys.text("crs"))
    datum = flight.attempt(lambda: _datum(keys))
    if not crs or not datum:
        return
    if crs == "local":
        raise keys.refuse("crs", "one that PROJ understands, for example EPSG:32632: a real flight is on the Earth")
    if "+" in crs and "[" not in crs and not crs.strip().startswith("+"):
        raise keys.refuse("crs", "the horizontal part alone, the vertical one in vertical_datum")
    whole = crs
    try:
        if known_crs(crs).is_compound:
            raise keys.refuse("crs", "the horizontal part alone, the vertical one in vertical_datum")
        whole = crs if datum == "ellipsoid" else with_heights(crs, datum)
        LocalFrame.around(np.zeros((1, 3)), whole)
    except CrsError as error:
        if "outside" not in str(error):  # the origin of the coordinates may lie there
            raise UserError(f"{keys.path}: flight.crs: {error}") from None
    grids = missing_grids(whole)
    flight.crs = whole
    if grids:
        off = off_without_grids(whole)
        key = "vertical_datum" if "heights" in off else "crs"
        shown = whole if len(whole) < LONGEST_NAME else known_crs(whole).name
        what = f"PROJ lacks the grid {', '.join(grids[:3])} for {shown!r}: {off}"
        flight.problems.append(f"{keys.path}: flight.{key}: {what} (`projsync --file {grids[0]}` fetches it)")
    elif unknown := unknown_heights(whole):
        what = f"PROJ knows no geoid of {unknown!r}: heights would be off by it, wanted a vertical CRS with a geoid"
        flight.problems.append(f"{keys.path}: flight.vertical_datum: {what}")


def _ground_height(keys: Keys) -> float:
    height = keys.number("ground_height_m", 0.0)
    if not LOWEST_M < height < HIGHEST_M:
        raise keys.refuse("ground_height_m", f"metres from {LOWEST_M:g} to {HIGHEST_M:g}")
    return height


def _origin(flight: Flight, keys: Keys) -> None:
    lat, lon = keys.numbers("origin_deg", 2)
    if not (abs(lat) <= 90 and abs(lon) <= 180):
        raise keys.refuse("origin_deg", "latitude and longitude in degrees, as [47.9, 11.1]")
    flight.origin_deg = lat, lon


def _datum(keys: Keys) -> str:
    wanted = 'a vertical CRS such as "EPSG:5773" (EGM96), or "ellipsoid" for heights above the ellipsoid'
    value = keys.raw("vertical_datum")
    if not isinstance(value, str) or not value.strip():
        raise keys.refuse("vertical_datum", wanted)
    if value != "ellipsoid":
        import pyproj
        import pyproj.exceptions

        try:
            if not pyproj.CRS.from_user_input(value).is_vertical:
                raise keys.refuse("vertical_datum", wanted)
        except pyproj.exceptions.CRSError:
            raise keys.refuse("vertical_datum", wanted) from None
    return value


def _beside(flight: Flight, keys: Keys, key: str, text: str, *, or_folder: bool = False) -> Path:
    """A file, or a folder where that may be one, by its name in the folder."""
    path = flight.folder / text
    if not is_there(path):
        raise UserError(f"{keys.path}: {keys.name(key)}: no {text[:200]} in the folder")
    if path.is_dir() and not or_folder:
        raise UserError(f"{keys.path}: {keys.name(key)}: {text[:200]!r} is a folder, wanted a file")
    return path


def _camera(flight: Flight, keys: Keys) -> None:
    if keys.has("file") == keys.has("preset"):
        raise UserError(
            f'{keys.path}: camera: wanted either file = "camera.json" or preset, one of {", ".join(PRESETS)}'
        )
    if keys.has("preset"):
        if keys.text("preset") not in PRESETS:
            raise keys.refuse("preset", f"one of {', '.join(PRESETS)}")
        flight.camera = preset(keys.text("preset"))
        return
    path = _beside(flight, keys, "file", keys.text("file"))
    flight.camera = read_glas_camera(path) if path.suffix.lower() == ".xml" else read_camera(path, flight.notes)


def _mounting(flight: Flight, keys: Keys) -> None:
    def three(key: str) -> tuple[float, float, float]:
        if not keys.has(key):
            flight.notes.append(f"{FILE}: {keys.name(key)} is not given, taken as zero")
        a, b, c = keys.numbers(key, 3, _ZERO)
        return a, b, c

    refuse_mounting(keys)
    flight.lever_arm_m = three("lever_arm_m")
    flight.mounting = Mounting(three("camera_lever_arm_m"), three("boresight_deg"))


def _beside_platform(flight: Flight, folder: SensorFolder, keys: Keys) -> None:
    """What a platform.toml in the folder of the sensors says: flight.toml counts, and has to say as much."""
    own = folder.platform
    for key, said, counts in (
        ("lever_arm_m", own.lever_arm_m, flight.lever_arm_m),
        ("camera_lever_arm_m", own.camera_lever_arm_m, flight.mounting.lever_arm_m),
        ("boresight_deg", own.boresight_deg, flight.mounting.boresight_deg),
    ):
        if not any(said) or tuple(said) == tuple(counts):
            continue
        shown = ", ".join(f"{value:g}" for value in said)
        if keys.has(key):
            flight.notes.append(f"platform.toml: {key} [{shown}] is not used: {keys.name(key)} of {FILE} counts")
        else:
            where = folder.path / "platform.toml"
            flight.problems.append(f"{keys.path}: {keys.name(key)}: missing, but {where} says [{shown}]: wanted one")
    if own.grade not in (MEMS, flight.grade):
        flight.notes.append(f"platform.toml: [imu] is not used: imu.* and navigation.imu of {FILE} count")
    if any(own.wander_sigma_ned_m):
        flight.notes.append(f"platform.toml: [gnss] is not used: trajectory.* and navigation.gnss of {FILE} count")


def _navigation(flight: Flight, keys: Keys, live: bool, instead: Instead) -> None:
    day = keys.raw("date")
    if day is not None and (not isinstance(day, date) or hasattr(day, "hour")):
        raise keys.refuse("date", "a day as 2024-05-17, without quotes")
    flight.day = day = instead.day or day
    kind = keys.text("kind", "")
    if kind and kind not in NAVIGATION:
        raise keys.refuse("kind", f"one of {', '.join(NAVIGATION)}")
    if live:
        return
    if instead.navigation is not None:
        path, kind = instead.navigation, instead.kind
    elif not keys.has("file"):
        raise keys.refuse("file", "poses or sensors of the flight; or, for `triline fly`, [[sensor]] tables")
    else:
        path = _beside(flight, keys, "file", keys.text("file"), or_folder=True)
        kind = kind or kind_of_path(path)
        if kind not in NAVIGATION:
            raise keys.refuse("file", f"poses or sensors, not a {KINDS[kind]}")
    if kind == "ros2":
        if instead.lines is None:
            _image_topics(flight, keys)
        elif instead.files is None:
            flight.lines = instead.lines
    elif instead.navigation is None:
        of_bag = [keys.name(key) for key in ("images", "line_rate_hz") if keys.has(key)]
        flight.problems.extend(f"{keys.path}: {key}: goes with a ROS 2 bag, not with {KINDS[kind]}" for key in of_bag)
    if instead.navigation is None and keys.has("accuracies"):
        if kind == "sbet":
            flight.accuracies = _beside(flight, keys, "accuracies", keys.text("accuracies"))
        else:
            flight.problems.append(f"{keys.path}: {keys.name('accuracies')}: goes with an SBET, not with {KINDS[kind]}")
    bag_camera = flight.camera if kind == "ros2" else None
    options = Options(day, flight.crs or None, camera=bag_camera, accuracies=flight.accuracies, lines=flight.lines)
    if kind in ("sensors", "ros2"):
        if kind == "sensors":
            flight.tables = read_sensor_folder(path)
        options = replace(options, folder=flight.tables, without_images=instead.files is not None)
        next(iter(read_any(path, kind, options).messages), None)
        if flight.tables is not None:
            flight.span_ns, flight.places_deg = sensor_extent(flight.tables)
    else:
        track = flight.track = read_track(path, kind, options)
        flight.span_ns, flight.places_deg = (int(track.time_ns[0]), int(track.time_ns[-1])), some(track.geodetic[:, :2])
    flight.navigation, flight.kind = path, kind


def _image_topics(flight: Flight, keys: Keys) -> None:
    """Topics of a bag whose images are image lines."""
    table = keys.table("images")
    files = tuple((ccd, Path(table.text(ccd)), None) for ccd in table.values)
    for ccd, topic, _ in files:
        if not str(topic).startswith("/"):
            raise table.refuse(ccd, "a ROS topic as /camera/nadir")
    rate = keys.number("line_rate_hz", positive=True) if keys.has("line_rate_hz") else None
    if files or rate is not None:
        flight.lines = LinesGiven(files, rate_hz=rate)


def _errors(flight: Flight, navigation: Keys, trajectory: Keys, imu: Keys) -> None:
    def choice(key: str, table: dict[str, Any], default: str) -> str:
        if not navigation.has(key):
            flight.notes.append(f"{FILE}: {navigation.name(key)} is not given, {default!r} taken")
        name = navigation.text(key, default)
        if name not in table:
            raise navigation.refuse(key, f"one of {', '.join(table)}")
        return name

    gnss, unit = choice("gnss", POSITION_ERRORS, "code"), choice("imu", ATTITUDE_ERRORS, "MEMS")
    offset, wander_m, time_s = POSITION_ERRORS[gnss]
    shift, drift, wander_deg = ATTITUDE_ERRORS[unit]
    defaults = {
        "offset_sigma_m": offset, "shift_sigma_deg": shift, "drift_sigma_deg": drift,
        "wander_sigma_m": wander_m, "wander_sigma_deg": wander_deg,
    }  # fmt: skip
    for key, value in defaults.items():  # a wander may be none
        how: dict[str, Any] = {"low": 0.0} if key in WANDER_SIGMAS else {"positive": True}
        flight.sigmas[key] = trajectory.numbers(key, 3, value, **how)
    flight.sigmas["wander_time_s"] = trajectory.number("wander_time_s", time_s, positive=True)
    if trajectory.has("attitude_wander_time_s"):
        flight.sigmas["attitude_wander_time_s"] = trajectory.number("attitude_wander_time_s", 0.0, positive=True)
    flight.grade = read_grade(imu, flight.notes, FILE, _GRADES[unit])


def _ground(flight: Flight, keys: Keys, general: Keys) -> None:
    """A raster of heights, or the height above ground: they tell where the ground is under the flight."""
    if keys.values:
        config.elevation(keys.path)
        path = _beside(flight, keys, "file", keys.text("file"))
        try:  # what the adjuster could not use either
            read_dem(path, keys.text("crs") if keys.has("crs") else None)
        except UserError as error:
            raise UserError(f"{keys.path}: " + str(error).replace("--dem-crs", "dem.crs")) from None
        flight.ground = GroundGiven(dem=path, dem_crs=keys.text("crs") if keys.has("crs") else None)
    if general.has("above_ground_m"):
        above = general.number("above_ground_m", positive=True)
        for said, other in (
            (general.has("ground_height_m"), "flight.ground_height_m"),
            (flight.ground.stated, "[dem]"),
        ):
            if said:
                raise UserError(f"{general.path}: flight.above_ground_m and {other}: wanted one of them")
        flight.ground = GroundGiven(above_m=above)
    if general.has("ground_height_m"):
        flight.ground = GroundGiven(flight.ground_height_m)
    elif flight.track is not None:
        flight.ground_height_m = flight.ground.height(keys.path, flight.track.geodetic, flight.notes)
    elif flight.ground.dem is not None and flight.origin_deg is not None:  # a live flight
        place = np.array([[*flight.origin_deg, 0.0]])
        flight.ground_height_m = flight.ground.height(keys.path, place, flight.notes)


def _control(flight: Flight, keys: Keys, general: Keys) -> None:
    stated = general.has("ground_height_m") or flight.ground.stated
    if not keys.values:
        if not stated:
            wanted = "wanted one (or [dem], or flight.above_ground_m): where is the ground?"
            flight.problems.append(f"{keys.path}: neither [control] nor flight.ground_height_m, {wanted}")
        return
    path = _beside(flight, keys, "file", keys.text("file"))
    if not flight.crs:
        return
    points, frame = read_ground_points(path, flight.crs, None, flight.notes)
    if not stated or (flight.ground.above_m is not None and flight.track is None):  # live, nobody has flown yet
        flight.ground_height_m = round(float(np.median(frame.to_geodetic(points.xyz_l)[:, 2])), 1)
        flight.notes.append(
            f"{path.name}: median height {flight.ground_height_m:g} m above the ellipsoid is the origin's"
        )
    if len(points.xyz_l):
        _refuse_far(flight, path.name, frame.to_geodetic(points.xyz_l)[:, :2])
    flight.control = path
    if flight.origin_deg is None:
        flight.origin_deg = frame.lat_deg, frame.lon_deg


def _refuse_far(flight: Flight, name: str, control_deg: Array) -> None:
    """Raise UserError for control (n, 2) that is far from the flight; where nobody says where that is, ask its CRS."""
    what, places = "the flight", flight.places_deg
    if places is None and flight.origin_deg is not None:
        what, places = "flight.origin_deg", np.array([flight.origin_deg])
    if places is not None:
        away = distance_m(control_deg, places)
        if away > FAR_M:
            raise UserError(
                f"{name}: no point lies within {1e-3 * away:.0f} km of {what}, "
                f"wanted coordinates in flight.crs ({flight.crs})"
            )
        return
    _tell_outside(flight, f"{name}:", control_deg, "are its coordinates in that CRS?")


def _tell_outside(flight: Flight, name: str, places_deg: Array, ask: str) -> None:
    """A note where places (n, 2) are outside of the area that the CRS is made for."""
    lat, lon = np.median(places_deg, axis=0)
    outside, area = outside_area(flight.crs, lat, lon)
    if outside > OUTSIDE_DEG:
        flight.notes.append(
            f"{name} lies at about {lat:.1f}, {lon:.1f} deg, {outside:.0f} deg outside of the area of flight.crs "
            f"({flight.crs}: {area}): {ask}"
        )


def distance_m(one_deg: Array, other_deg: Array) -> float:
    """Least distance between places (n, 2) and (m, 2) of latitude and longitude in degrees, m; a chord."""
    a, b = (ecef_from_geodetic(lat, lon, 0.0) for lat, lon in (np.radians(one_deg).T, np.radians(other_deg).T))
    return float(np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=2).min()))


def _announced(flight: Flight, keys: Keys) -> None:
    """A strip of a live flight: what is said of it beforehand; its image lines are still to come."""
    id = keys.text("id")
    if not keys.has("first_time") and not keys.has("line_rate_hz"):
        flight.notes.append(f"{FILE}: {keys.name('id')}: {id!r} has no first_time: it begins with its first line")
        return
    (_, first_ns), rate_hz = _first_time(flight, keys), keys.number("line_rate_hz", positive=True)
    flight.announced.append((id, first_ns, rate_hz))


def _first_time(flight: Flight, keys: Keys) -> tuple[str, int]:
    """In ISO 8601, and UTC in ns since the Unix epoch; what has no time zone is UTC, with a note."""
    value = keys.raw("first_time")
    text = value.isoformat() if hasattr(value, "isoformat") else keys.text("first_time")
    time_ns = instant_ns(text, f"{keys.path}: {keys.name('first_time')}")
    if not re.search(r"(Z|[-+]\d\d:?(\d\d)?)\s*$", text[10:]):
        flight.notes.append(f"{FILE}: {keys.name('first_time')}: {text} has no time zone, taken as UTC")
    return text, time_ns


def _strip(flight: Flight, keys: Keys) -> None:
    id = keys.text("id")
    images = keys.table("images")
    if not images.values:
        raise keys.refuse("images", 'one file for each CCD line: {F = "forward.img", N = "nadir.img"}')
    files = []
    for view in images.values:
        name, band = images.text(view), None
        if "@" in name and not is_there(flight.folder / name):
            name, _, band = name.rpartition("@")
        files.append((view, name, band))
    named = {name: flight.folder / name for _, name, _ in files}
    missing = [name for name, path in named.items() if not is_there(path) and not is_pattern(path)]
    if len(missing) > 1:
        shown = first_of([name[:200] for name in missing], MISSING_SHOWN)
        raise UserError(f"{keys.path}: {images.where}: {len(missing)} files are not in the folder: {shown}")
    for view, name, _ in files:
        if name in missing:
            _beside(flight, images, view, name)
    files = [(view, named[name], band) for view, name, band in files]
    times = _beside(flight, keys, "line_times", keys.text("line_times")) if keys.has("line_times") else None
    first = None
    if keys.has("first_time") or keys.has("line_rate_hz"):
        text, _ = _first_time(flight, keys)
        first = (text, keys.number("line_rate_hz", positive=True))
    span = keys.numbers("grey_range", 2) if keys.has("grey_range") else None
    if span is not None and span[0] >= span[1]:
        raise keys.refuse("grey_range", "two numbers, the lower one first")
    band = keys.text("band") if keys.has("band") else None
    pair = None if span is None else (span[0], span[1])
    raw = (keys.text("type"), keys.integer("samples", 0)) if keys.has("type") else None
    if raw is not None and raw[0] not in TYPES:
        raise keys.refuse("type", f"one of {', '.join(TYPES)}")
    given = LinesGiven(tuple(files), id, times, first, band, pair, flight.day, raw)
    track = flight.track
    beside = times_beside(cubes_of(files[0][1], headless=keys.has("type"))[0])
    if times is None and first is None and beside is None and (track is None or track.line_rate_hz <= 0):
        raise UserError(
            f"{keys.path}: {keys.where}: times of the lines missing, wanted line_times, or first_time and line_rate_hz"
        )
    if raw is not None and not raw[1] and flight.camera is None:
        return  # how long its lines are would be known from the camera, and what is wrong with that is told
    _open(flight, given)


def _open(flight: Flight, given: LinesGiven) -> None:
    """Add the images of a strip."""
    track = flight.track
    strips = open_strips(given, flight.camera, track.time_ns if track is not None and track.line_rate_hz > 0 else None)
    if flight.span_ns is None and flight.kind == "ros2" and flight.navigation is not None:
        flight.span_ns = sensor_span(flight.navigation, flight.kind, Options(flight.day))
    if flight.span_ns is not None:
        strips = within(strips, *flight.span_ns, "poses" if track is not None else "sensors")
    for strip in strips:
        notes = () if flight.camera is None else strip.notes  # a missing camera is told once
        flight.strips.append(replace(strip, notes=tuple(map(flight.in_keys, notes))))


def _node(nodes: Keys, name: str) -> None:
    """Whether a node takes its settings."""
    if name not in registry.names():
        raise nodes.refuse(name, f"a node: {', '.join(registry.names())}")
    table = nodes.table(name)
    if name in registry.STEP_NODES:
        try:
            config.build(registry.node_class(name), {name: dict(table.values)})
        except UserError as error:
            raise UserError(f"{nodes.path}: nodes: {error}") from None
