"""Times of image lines from files: CSV, Resonon's ``.times`` and Headwall's ``frameIndex_*.txt``."""

from __future__ import annotations

from datetime import date
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .byte_order_mark import without_mark
from .number_rows import numbered_lines, numbers_of
from .table import Column, column_names_of, read_table, separator_hint
from .time_columns import WANTED, time_columns, times_of
from .vendor_poses import headwall_clock, resonon_first_ns

#: Readings of a log's clock before and behind the lines whose times it tells.
_AROUND = 200
#: So far a reading may be off a clock that runs evenly, s.
_UNEVEN_S = 0.1
#: Lines of one image are taken within a day, s.
_LONGEST_S = 86400.0
#: A scatter of readings that is worth a remark, s.
_SCATTER_S = 1e-3


def line_times(path: Path, day: date | None, notes: list[str]) -> NDArray[np.int64]:
    """UTC (n,) in ns since the Unix epoch of the lines 0, 1, 2 ... of an image.

    Parameters
    ----------
    path : CSV ``line,time`` (ISO 8601, seconds, GPS), or what the program of a camera writes beside its images, see
        `resonon_line_times` and `headwall_line_times`
    day : of the flight, where a file does not know it
    notes : remarks are added here

    Raises
    ------
    UserError : a column or a line that is missing, a time that does not come after the one before
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file, wanted a CSV with line and time")
    if path.suffix.lower() == ".times":
        return resonon_line_times(path, day, notes)
    if is_frame_index(path):
        return headwall_line_times(path, notes)
    header = column_names_of(path)
    columns = time_columns(header)
    if not columns:
        raise UserError(f"{path}:1: time: column missing, wanted line and {WANTED}{separator_hint(header, 'time_s')}")
    table = read_table(path, [Column("line", "integer", low=0), *columns], notes)
    line = table["line"]
    table.refuse(line != np.arange(len(line)), "line", lambda i: f"{line[i]:.0f}, wanted {i} (0, 1, 2, ...)")
    time_ns = times_of(table, columns, day, notes)
    late = np.concatenate([[False], np.diff(time_ns) <= 0])
    table.refuse(late, columns[0].name, lambda i: "does not come after the line before it")
    return time_ns


def times_beside(image: Path) -> Path | None:
    """The times of its lines that the program of a camera has written beside an image, if there are any."""
    names = [f"{image.name}.times", f"{image.stem}.times"]
    if image.stem.startswith("raw_"):
        names.append(f"frameIndex_{image.stem.removeprefix('raw_')}.txt")
    return next((path for name in names if (path := image.with_name(name)).is_file()), None)


def is_frame_index(path: Path) -> bool:
    """Whether a file begins like a Headwall ``frameIndex_0.txt``."""
    with open(path, "rb") as file:
        return without_mark(file.readline(256)).lstrip().startswith(b"Frame#")


def resonon_line_times(path: Path, day: date | None, notes: list[str]) -> NDArray[np.int64]:
    """UTC (n,) in ns of the lines of a Resonon image: ``.times`` has a row for each, s since the system was started.

    The first line is taken with the first pose of the ``.lcf`` beside it, as Resonon specifies it.

    Raises
    ------
    UserError : no ``.lcf``, a row that is no number, a time that does not come after the one before
    """
    image = path.with_suffix("")
    poses = [p for p in (image.with_suffix(".lcf"), image.with_name(image.name + ".lcf")) if p.is_file()]
    if not poses:
        wanted = f"wanted {image.with_suffix('.lcf').name} beside it, whose first pose is that of the first line"
        raise UserError(f"{path}: seconds since the system was started; {wanted}")
    lines = [(number, text.split()) for number, text in numbered_lines(path)]
    seconds = numbers_of(path, lines, {"time": 0})[:, 0]
    _refuse_late(path, [number for number, _ in lines], np.diff(seconds) <= 0)
    if seconds[-1] - seconds[0] > _LONGEST_S:
        raise UserError(
            f"{path}: {seconds[-1] - seconds[0]:.3g} s from the first to the last line, wanted less than a day"
        )
    notes.append(f"{path.name}: the first line is taken with the first pose of {poses[0].name}")
    return resonon_first_ns(poses[0], day) + np.rint((seconds - seconds[0]) * 1e9).astype(np.int64)


def headwall_line_times(path: Path, notes: list[str]) -> NDArray[np.int64]:
    """UTC (n,) in ns of the lines of a Headwall image: a ``frameIndex_*.txt`` has ``Frame#`` and ``Timestamp`` of each.

    ``Timestamp`` counts a clock that ``imu_gps.txt`` beside it has in the column of that name, beside the UTC of the
    GPS. A straight line through its readings around the image's lines tells the rate and the origin of that clock.

    Raises
    ------
    UserError : no ``imu_gps.txt``, or none with a Timestamp; a row that is no number, a time that does not come after
        the one before; lines outside of the log; a clock that does not run evenly
    """
    rows = [(number, text.split()) for number, text in numbered_lines(path)]
    names = rows[0][1]
    if names[1:2] != ["Timestamp"]:
        raise UserError(f"{path}:1: {' '.join(names)[:60]!r}, wanted the columns Frame# and Timestamp")
    log = path.with_name("imu_gps.txt")
    if not log.is_file():
        raise UserError(f"{path}: counts of a clock, wanted imu_gps.txt beside it, which has their UTC")
    counts = numbers_of(path, rows[1:], {"Timestamp": 1})[:, 0]
    _refuse_late(path, [number for number, _ in rows[1:]], np.diff(counts) <= 0)
    stat = log.stat()
    clock, utc_ns = _clock(log, stat.st_mtime_ns, stat.st_size)
    if counts[0] < clock[0] or counts[-1] > clock[-1]:
        span = f"wanted the range of {log.name}, {clock[0]:.0f} to {clock[-1]:.0f}"
        raise UserError(f"{path}: Timestamp: {counts[0]:.0f} to {counts[-1]:.0f}, {span}")
    low, high = np.searchsorted(clock, [counts[0], counts[-1]])
    near = slice(max(int(low) - _AROUND, 0), int(high) + _AROUND)
    line = np.polynomial.Polynomial.fit(clock[near], (utc_ns[near] - utc_ns[0]) * 1e-9, 1)
    off_s = np.abs((utc_ns[near] - utc_ns[0]) * 1e-9 - line(clock[near]))
    if off_s.max() > _UNEVEN_S:
        where = f"{log}: Timestamp: {off_s.max():.3g} s off a clock that runs evenly"
        raise UserError(f"{where}, wanted at most {_UNEVEN_S:g} s while the lines of {path.name} were taken")
    scatter_s = float(np.sqrt(np.mean(off_s**2)))
    known = f"{path.name}: Timestamp has its UTC from {log.name}"
    notes.append(f"{known}, readings scatter by {scatter_s * 1e3:.1f} ms" if scatter_s > _SCATTER_S else known)
    return utc_ns[0] + np.rint(line(counts) * 1e9).astype(np.int64)


@lru_cache(maxsize=1)
def _clock(log: Path, _time_ns: int, _bytes: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The clock of a log as it is, read once for all cubes of a flight."""
    return headwall_clock(log)


def _refuse_late(path: Path, numbers: list[int], late: NDArray[np.bool_]) -> None:
    """Raise UserError at the first row whose time is not after that of the row before; ``late`` begins with the 2nd."""
    if late.any():
        at = int(np.argmax(late)) + 1
        raise UserError(f"{path}:{numbers[at]}: does not come after the line before it")
