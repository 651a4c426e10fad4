"""Sensor folder: raw inertial and GNSS data, and platform.toml with lever arms and noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.rotation import R_BC_NOMINAL, matrix_from_navigation
from ...solver.navigation.alignment import AttitudePrior
from ...solver.navigation.carried import CameraMount
from ...solver.navigation.error_state import NavigationSettings
from ...solver.navigation.inertial_cleaning import Finding, clean_gnss, clean_inertial, in_order
from ...solver.navigation.inertial_data import MEMS, GnssData, InertialData, InertialGrade
from ..convert import LATEST_S
from ..errors import UserError
from .course import attitude_remarks
from .keys import Keys, read_toml
from .rtklib import read_rtklib
from .table import Column, Table, read_table, separator_of
from .track import MOST_BORESIGHT_DEG, MOST_LEVER_ARM_M
from .waypoint import read_grafnav

Array = NDArray[np.floating]

#: Files with fixes: our own, of RTKLIB, of GrafNav; and files that make a folder one of sensors.
GNSS_FILES = ("gnss.csv", "gnss.pos", "gnss.txt")
SENSOR_FILES = ("imu.csv", *GNSS_FILES, "attitude.csv")
#: Kinds of files of positions alone.
POSITIONS = ("rtklib", "grafnav")

FORCE = ("fx_m_s2", "fy_m_s2", "fz_m_s2")
RATE = ("wx_rad_s", "wy_rad_s", "wz_rad_s")
DV = ("dvx_m_s", "dvy_m_s", "dvz_m_s")
DTHETA = ("dthx_rad", "dthy_rad", "dthz_rad")
POSITION = ("lat_deg", "lon_deg", "height_m")
SIGMA = ("sigma_n_m", "sigma_e_m", "sigma_d_m")
VELOCITY = ("vn_m_s", "ve_m_s", "vd_m_s")
SIGMA_VELOCITY = ("sigma_vn_m_s", "sigma_ve_m_s", "sigma_vd_m_s")
ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
SIGMA_ANGLES = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")

_INITIAL_SIGMA_DEG = (2.0, 2.0, 5.0)  # where [initial] gives an angle without a sigma
_UNKNOWN_DEG = (20.0, 20.0, 60.0)  # where it does not give one
_VELOCITY_SIGMA_M_S = 0.05  # where gnss.csv has velocities without sigmas


@dataclass(frozen=True)
class AttitudeTable:
    """attitude.csv: (n,) times, which increase, (n, 3) roll, pitch, heading and sigmas, radians."""

    time_s: Array
    angles: Array
    sigma: Array


@dataclass(frozen=True)
class Platform:
    """platform.toml.

    Attributes
    ----------
    lever_arm_m : antenna from the inertial sensor, body axes
    camera_lever_arm_m : perspective centre from the inertial sensor, body axes
    boresight_deg : roll, pitch, heading of the camera against the body
    lever_arm_sigma_m : 0 takes the lever arm as known
    grade : of the inertial sensor
    initial : attitude at the first inertial sample, where given
    wander_sigma_ned_m, wander_time_s : slow errors of the GNSS positions, and their correlation time
    """

    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm_sigma_m: float = 0.0
    grade: InertialGrade = MEMS
    initial: AttitudePrior | None = None
    wander_sigma_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wander_time_s: float = 60.0

    @property
    def settings(self) -> NavigationSettings:
        scale = self.grade.gyro_scale > 0.0 or self.grade.accel_scale > 0.0
        return NavigationSettings(
            self.grade,
            lever_arm_b=self.lever_arm_m,
            lever_arm_sigma_m=self.lever_arm_sigma_m,
            wander_sigma_ned_m=self.wander_sigma_ned_m,
            wander_time_s=self.wander_time_s,
            scale_factors=scale,
        )

    @property
    def mount(self) -> CameraMount:
        turned = matrix_from_navigation(*np.radians(self.boresight_deg)) @ R_BC_NOMINAL
        return CameraMount(self.camera_lever_arm_m, turned)


@dataclass(frozen=True)
class SensorFolder:
    """The contents of a sensor folder, not yet checked or cleaned.

    Attributes
    ----------
    path : the folder
    time_s : (n,) stamps of the inertial samples, or None without imu.csv
    rotation, force : (n, 3) angular rates (rad/s) and specific forces (m/s^2), or increments (rad, m/s)
    increments : whether they are increments
    gnss : fixes, or None without one of `GNSS_FILES`
    attitude : or None without attitude.csv
    platform : of platform.toml, or defaults
    notes : remarks on reading
    offset_s : added to the times in output files
    gnss_file : name of the file that the fixes are from
    """

    path: Path
    time_s: Array | None
    rotation: Array | None
    force: Array | None
    increments: bool
    gnss: GnssData | None
    attitude: AttitudeTable | None
    platform: Platform
    notes: list[str] = field(default_factory=list)
    offset_s: float = 0.0
    gnss_file: str = "gnss.csv"

    @property
    def name(self) -> str:
        """That of the folder; of positions alone that of their file."""
        alone = self.gnss_file not in ("gnss.csv", "gnss.pos")
        return Path(self.gnss_file).stem if alone else self.path.resolve().name

    def cleaned(self) -> tuple[InertialData, GnssData, list[Finding]]:
        """Data for the navigator, and findings about what was taken out of them.

        Raises
        ------
        UserError : imu.csv or gnss.csv is missing, or too little is left of them
        """
        if self.time_s is None or self.rotation is None or self.force is None:
            raise UserError(f"{self.path}: imu.csv is missing, wanted inertial data ({','.join((*FORCE, *RATE))})")
        if self.gnss is None:
            raise UserError(f"{self.path}: gnss.csv (or gnss.pos) is missing, wanted GNSS positions")
        time, rotation, force, findings = clean_inertial(
            self.time_s, self.rotation, self.force, increments=self.increments
        )
        if len(time) < 10:
            why = "".join(f"; {finding.text}" for finding in findings)
            raise UserError(f"{self.path / 'imu.csv'}: only {len(time)} usable samples, wanted at least 10{why}")
        make = InertialData.from_increments if self.increments else InertialData.from_rates
        gnss, more = clean_gnss(self.gnss)
        findings += more
        for finding in (f for f in more if f.fatal):
            raise UserError(f"{self.path}: {self.named(finding)}")
        if len(gnss) < 2:
            why = "".join(f"; {finding.text}" for finding in more)
            raise UserError(f"{self.path / self.gnss_file}: only {len(gnss)} usable fixes, wanted at least 4{why}")
        return make(time, rotation, force), gnss, findings

    def named(self, finding: Finding) -> str:
        """A finding in one line, with file and columns, or line and column where it is one value."""
        force, rate = (DV, DTHETA) if self.increments else (FORCE, RATE)
        where = {
            "imu.time": ("imu.csv", ("time_s",)),
            "imu.force": ("imu.csv", force),
            "imu.rate": ("imu.csv", rate),
            "imu.axes": ("imu.csv", (*force, *rate)),
            "imu.noise": ("platform.toml", ("[imu]",)),
            "gnss.time": (self.gnss_file, ("time_s",)),
            "gnss.sigma": (self.gnss_file, SIGMA),
            "gnss.position": (self.gnss_file, POSITION),
            "gnss.velocity": (self.gnss_file, VELOCITY),
        }.get(finding.subject)
        if where is None:
            return finding.text
        file, columns = where
        if file == self.gnss_file and not file.endswith(".csv"):  # its columns have other names
            row = "" if finding.place is None else f" position {finding.place[0] + 1}:"
            return f"{file}:{row} {finding.text}"
        if finding.place is not None and (self.path / file).is_file():
            row, column = finding.place
            return f"{file}:{Table(self.path / file, {}).line_of(row)}: {columns[column]}: {finding.text}"
        return f"{file}: {','.join(columns)}: {finding.text}"


def read_sensor_folder(path: str | Path, platform_file: Path | None = None) -> SensorFolder:
    """Read a sensor folder; another platform.toml may take the place of its own.

    Raises
    ------
    UserError : ``file:line: column: what is wrong``
    """
    folder = Path(path)
    if not folder.is_dir():
        raise UserError(f"{folder}: not a folder, wanted one with imu.csv and gnss.csv (or gnss.pos, gnss.txt)")
    notes: list[str] = []
    time, rotation, force, increments = _read_imu(folder / "imu.csv", notes)
    of_fixes = [name for name in GNSS_FILES if (folder / name).is_file()]
    if len(of_fixes) > 1:
        raise UserError(f"{folder}: {' and '.join(of_fixes)}, wanted one of them")
    file = (of_fixes or [SensorFolder.gnss_file])[0]
    if file == "gnss.pos":
        gnss: GnssData | None = read_rtklib(folder / file, notes)
    elif file == "gnss.txt":
        gnss = read_grafnav(folder / file, notes)
    else:
        gnss = _read_gnss(folder / file, notes)
    attitude = _read_attitude(folder / "attitude.csv", notes)
    if gnss is not None and attitude is not None:
        notes.extend(f"attitude.csv: {remark}" for remark in _remarks(gnss, attitude))
    platform = read_platform(platform_file or folder / "platform.toml", notes)
    if platform.initial is None and attitude is not None and time is not None:
        platform = replace(platform, initial=_initial_of(attitude, float(time.min())))
    return SensorFolder(folder, time, rotation, force, increments, gnss, attitude, platform, notes, gnss_file=file)


def positions_alone(path: Path, kind: str, day: date | None) -> SensorFolder:
    """Positions (`POSITIONS`) as a sensor folder that has nothing else; the day where the file has none.

    Raises
    ------
    UserError : as `read_rtklib` and `read_grafnav`
    """
    notes = [f"{path.name}: positions without attitudes: they become sensor/gnss, not poses"]
    gnss = read_rtklib(path, notes) if kind == "rtklib" else read_grafnav(path, notes, day)
    return SensorFolder(path.parent, None, None, None, False, gnss, None, Platform(), notes, gnss_file=path.name)


def _read_imu(path: Path, notes: list[str]) -> tuple[Array | None, Array | None, Array | None, bool]:
    if not path.is_file():
        return None, None, None, False
    optional = [Column(name, optional=True) for name in (*FORCE, *RATE, *DV, *DTHETA)]
    table = read_table(path, [Column("time_s"), *optional], notes)
    rates = [name for name in (*FORCE, *RATE) if name in table]
    increments = [name for name in (*DV, *DTHETA) if name in table]
    if rates and increments:
        raise UserError(f"{path}:1: {increments[0]}: increments beside rates ({rates[0]}), wanted one of both")
    wanted = (*DV, *DTHETA) if increments else (*FORCE, *RATE)
    missing = [name for name in wanted if name not in table]
    if missing:
        other = "" if increments else f" (or increments: {','.join((*DV, *DTHETA))})"
        raise UserError(f"{path}:1: {missing[0]}: column missing, wanted time_s,{','.join(wanted)}{other}")
    force, rotation = table.stack(*wanted[:3]), table.stack(*wanted[3:])
    return _times(table), rotation, force, bool(increments)


def _times(table: Table) -> Array:
    """Times of the rows, s; those of which ns do not fit into 64 bits are refused."""
    seconds = table["time_s"]
    table.refuse(~(np.abs(seconds) < LATEST_S), "time_s", lambda i: f"{seconds[i]:.6g}, wanted seconds")
    return seconds


def _read_gnss(path: Path, notes: list[str]) -> GnssData | None:
    if not path.is_file():
        return None
    columns = [Column(name) for name in ("time_s", *POSITION)]
    # as text, because the checks, and not the reader, deal with empty values and nan
    columns += [Column(name, kind="text", blank=True) for name in SIGMA]
    columns += [Column(name, kind="text", optional=True, blank=True) for name in (*VELOCITY, *SIGMA_VELOCITY)]
    table = read_table(path, columns, notes)
    position = table.stack(*POSITION)
    velocity = _parsed(table, VELOCITY) if _all_there(path, table, VELOCITY) else None
    sigma_v = _parsed(table, SIGMA_VELOCITY) if _all_there(path, table, SIGMA_VELOCITY) else None
    if velocity is not None and sigma_v is None:
        notes.append(
            f"{path.name}: velocities without sigmas ({','.join(SIGMA_VELOCITY)}): {_VELOCITY_SIGMA_M_S} m/s taken"
        )
        sigma_v = np.full_like(velocity, _VELOCITY_SIGMA_M_S)
    lat, lon = np.radians(position[:, 0]), np.radians(position[:, 1])
    return GnssData(_times(table), lat, lon, position[:, 2], _parsed(table, SIGMA), velocity, sigma_v)


def _all_there(path: Path, table: Table, names: tuple[str, ...]) -> bool:
    """Whether optional columns that belong together are there; an error where only some of them are."""
    there = [name for name in names if name in table]
    missing = [name for name in names if name not in table]
    if there and missing:
        raise UserError(f"{path}:1: {missing[0]}: column missing beside {there[0]}, wanted {','.join(names)}")
    return bool(there)


def _parsed(table: Table, names: tuple[str, ...]) -> Array:
    """Columns of text as numbers, with the decimal sign of the file; empty is NaN."""
    out = np.full((len(table), len(names)), np.nan)
    signs = str.maketrans(",.", ".,") if separator_of(table.path)[1] == "," else {}
    for k, name in enumerate(names):
        words = table[name]
        bad = np.zeros(len(words), dtype=bool)
        for i, word in enumerate(words):
            try:
                out[i, k] = float(word.translate(signs)) if word else np.nan
            except ValueError:
                bad[i] = True
        table.refuse(bad, name, lambda row, words=words: f"{words[row]!r} is not a number, wanted a number")
    return out


def _read_attitude(path: Path, notes: list[str]) -> AttitudeTable | None:
    if not path.is_file():
        return None
    columns = [Column(name) for name in ("time_s", *ANGLES)]
    columns += [Column(name, optional=True, above=0.0) for name in SIGMA_ANGLES]
    table = read_table(path, columns, notes)
    angles = np.radians(table.stack(*ANGLES))
    sigma = np.tile([0.5, 0.5, 1.0], (len(angles), 1))
    if _all_there(path, table, SIGMA_ANGLES):
        sigma = table.stack(*SIGMA_ANGLES)
    else:
        notes.append(f"{path.name}: no sigmas ({','.join(SIGMA_ANGLES)}): 0.5, 0.5, 1 deg are assumed")
    time = _times(table)
    rows, findings = in_order(time, "attitude.time", "attitudes")
    notes.extend(f"{path.name}: time_s: {finding.text}" for finding in findings)
    return AttitudeTable(time[rows], angles[rows], np.radians(sigma[rows]))


def _remarks(gnss: GnssData, attitude: AttitudeTable) -> list[str]:
    """Whether the attitudes go with the flight of the fixes."""
    known = (np.abs(gnss.lat) <= np.pi / 2) & (np.abs(gnss.lon) <= 2 * np.pi)
    known &= (gnss.time_s >= attitude.time_s[0]) & (gnss.time_s <= attitude.time_s[-1])
    time_s, first = np.unique(gnss.time_s[known], return_index=True)
    angles = np.unwrap(attitude.angles, axis=0)
    rpy = np.column_stack([np.interp(time_s, attitude.time_s, angle) for angle in angles.T])
    geodetic = np.degrees(np.column_stack([gnss.lat[known][first], gnss.lon[known][first]]))
    return attitude_remarks(time_s, geodetic, rpy)


def _initial_of(attitude: AttitudeTable, time_s: float) -> AttitudePrior | None:
    i = int(np.argmin(np.abs(attitude.time_s - time_s)))
    off = abs(float(attitude.time_s[i]) - time_s)
    if off > 1.0:
        return None
    return AttitudePrior(attitude.angles[i], np.hypot(attitude.sigma[i], np.radians(5.0) * off))


def read_platform(path: Path, notes: list[str]) -> Platform:
    """Read platform.toml; keys that it lacks have defaults, with a note where the default matters.

    Raises
    ------
    UserError : not TOML, a value that no platform has
    """
    if not path.is_file():
        notes.append(f"{path.name} is absent: a lever arm of zero and a MEMS unit are assumed")
        return Platform()
    keys = read_toml(path)
    zero = (0.0, 0.0, 0.0)
    refuse_mounting(keys)
    arms = [keys.numbers(name, 3, zero) for name in ("lever_arm_m", "camera_lever_arm_m", "boresight_deg")]
    sigma = keys.number("lever_arm_sigma_m", 0.0, low=0.0)
    if sigma > MOST_LEVER_ARM_M:
        raise keys.refuse("lever_arm_sigma_m", f"metres up to {MOST_LEVER_ARM_M:g}; are they mm?")
    imu, initial, gnss = keys.table("imu"), keys.table("initial"), keys.table("gnss")
    wander = gnss.numbers("wander_sigma_m", 3, zero)
    wander_time_s = gnss.number("wander_time_s", 60.0, positive=True)
    if min(wander) < 0.0:
        raise gnss.refuse("wander_sigma_m", "3 numbers of at least 0: north, east, down")
    grade = read_grade(imu, notes, path.name)
    prior = _prior(initial) if initial.values else None
    for table in (keys, imu, initial, gnss):
        notes.extend(f"{path.name}: key {name!r} is not known and was ignored" for name in table.unread())
    a, b, c, w = ((float(x), float(y), float(z)) for x, y, z in (*arms, wander))
    return Platform(a, b, c, sigma, grade, prior, w, wander_time_s)


def refuse_mounting(keys: Keys) -> None:
    """Raise UserError for a lever arm or a boresight in a table that no platform has."""
    metres = f"metres within {MOST_LEVER_ARM_M:g}; are they mm?"
    for key, most, wanted in (
        ("lever_arm_m", MOST_LEVER_ARM_M, metres),
        ("camera_lever_arm_m", MOST_LEVER_ARM_M, metres),
        ("boresight_deg", MOST_BORESIGHT_DEG, f"degrees within {MOST_BORESIGHT_DEG:g}"),
    ):
        if keys.has(key) and np.abs(keys.numbers(key, 3)).max() > most:
            raise keys.refuse(key, wanted)


def read_grade(imu: Keys, notes: list[str], file: str, default_grade: InertialGrade | None = None) -> InertialGrade:
    """Noise of an inertial unit by its data sheet (table [imu]); what is absent is that of a default unit.

    Parameters
    ----------
    imu : table of the file
    notes : gets what was assumed
    file : name for notes
    default_grade : without one, that of a MEMS unit, with a note

    Raises
    ------
    UserError : a value that no unit has
    """
    unit = MEMS if default_grade is None else default_grade
    deg, names = (
        np.pi / 180.0,
        ("gyro_noise_deg_sqrt_h", "gyro_bias_deg_h", "accel_noise_m_s_sqrt_h", "accel_bias_mgal"),
    )
    default = (
        unit.gyro_noise / deg * 60.0,
        unit.gyro_bias / deg * 3600.0,
        unit.accel_noise * 60.0,
        unit.accel_bias * 1e5,
    )
    missing = [name for name in names if not imu.has(name)]
    if missing and default_grade is None:
        notes.append(f"{file}: [imu] {', '.join(missing)} absent: those of a MEMS unit are assumed")
    values = [imu.number(name, round(d, 9), positive=True) for name, d in zip(names, default, strict=True)]
    time_s = imu.number("bias_time_s", usual_bias_time_s(values[1]), positive=True)
    grade = InertialGrade.from_datasheet(values[0], values[1], values[2], values[3], time_s)
    ppm = [imu.number(name, 0.0) * 1e-6 for name in ("gyro_scale_ppm", "accel_scale_ppm")]
    if min(ppm) < 0.0:
        raise imu.refuse("gyro_scale_ppm" if ppm[0] < 0.0 else "accel_scale_ppm", "a number of at least 0")
    return InertialGrade(grade.gyro_noise, grade.gyro_bias, grade.accel_noise, grade.accel_bias, time_s, ppm[0], ppm[1])


def usual_bias_time_s(gyro_bias_deg_h: float) -> float:
    """Correlation time of biases: those of MEMS units wander within minutes, those of better ones within hours."""
    return 600.0 if gyro_bias_deg_h > 2.0 else 7200.0


def _prior(initial: Keys) -> AttitudePrior | None:
    """[initial]: roll_deg, pitch_deg, heading_deg, each with NAME_sigma_deg (or sigma_NAME_deg)."""
    angles, sigmas = [], []
    for name, default, unknown in zip(("roll", "pitch", "heading"), _INITIAL_SIGMA_DEG, _UNKNOWN_DEG, strict=True):
        given = initial.has(f"{name}_deg")
        angles.append(initial.number(f"{name}_deg", 0.0))
        spelling = f"sigma_{name}_deg" if initial.has(f"sigma_{name}_deg") else f"{name}_sigma_deg"
        sigmas.append(initial.number(spelling, default if given else unknown, positive=True))
    if not any(initial.has(f"{name}_deg") for name in ("roll", "pitch", "heading")):
        return None
    return AttitudePrior(np.radians(angles), np.radians(sigmas))
