"""The block folder: a project as human-readable files, read into arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.block_data import Apriori, BlockData, ImagePoints, KnownPoints
from ...solver.adjustment.network import Strip
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import CrsError, LocalFrame
from ...solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from ...solver.geometry.trajectory import Trajectory
from ...solver.models import WANDER_SIGMAS, WANDER_TIMES, setting_names
from ..convert import LONGEST_STRIP_S
from ..errors import UserError
from .camera_json import read_camera
from .ground_points import FAR_M, known_points, notes_of_names, read_ground_table
from .keys import Keys, is_there, read_toml
from .place_columns import PLACE, check_place_units, place_column, to_local
from .projection import notes_of_heights
from .table import Column, Table, column_names_of, one_line, read_table

#: Files that make a folder a block folder (project.toml may be absent).
FILES = ("camera.json", "strips.csv", "trajectory.csv", "ground_points.csv", "image_points.csv")

#: Known points are looked for at about so many poses of the trajectories.
_PLACES = 1000

_STRIPS = (
    Column("strip", "text"),
    Column("first_line_time_s", blank=True),
    Column("line_rate_hz", blank=True, above=0.0),
    Column("lines", "integer", blank=True, low=0),
    Column("lens", "text", optional=True, blank=True),
    Column("line_times", "text", optional=True, blank=True),
)
#: What a file of line times says in their place.
_OF_LINE_TIMES = ("first_line_time_s", "line_rate_hz", "lines")
_LINE_TIMES = (Column("line", "integer", low=0), Column("time_s"))
_POSE = (*PLACE, "omega_deg", "phi_deg", "kappa_deg")
_TRAJECTORY = (
    Column("strip", "text"),
    Column("time_s"),
    *(place_column(name) for name in PLACE),
    *(Column(name) for name in _POSE[3:]),
    Column("lens", "text", optional=True, blank=True),
)
_IMAGE = (
    Column("point", "text"),
    Column("strip", "text"),
    Column("ccd", "text"),
    Column("line"),
    Column("sample"),
    Column("sigma_px", optional=True, blank=True, above=0.0),
)

#: Settings of trajectory models that are whole numbers.
_WHOLE = ("segments", "fixes", "order", "continuity")

Key = tuple[str, str | None]  # strip and lens


def is_block_folder(path: Path) -> bool:
    """Whether a folder looks like a block folder; not one of results or of a flight, which may have a camera."""
    other = any((path / name).is_file() for name in ("result.json", "flight.toml"))
    names = ["image_points.csv", "strips.csv", *([] if other else ["camera.json"])]
    return path.is_dir() and any((path / name).is_file() for name in names)


def read_block(folder: Path | str, with_lines: bool = False) -> BlockData:
    """Read a block folder into arrays in the local frame.

    Parameters
    ----------
    with_lines : whether image lines come with it, in which tie points are matched: none need be measured then

    Raises
    ------
    UserError : a file that is missing, a value that is missing or malformed (``file:line: column: what is wrong``),
        names that do not fit together, a CRS that PROJ does not know
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder, wanted a block folder with {', '.join(FILES)}")
    for name in FILES:
        if not (folder / name).is_file():
            raise UserError(f"{folder}: no {name}; a block folder has {', '.join(FILES)}")
    notes: list[str] = []
    name, crs, apriori = _project(folder, notes)
    camera = read_camera(folder / "camera.json", notes)
    strip_table = _strip_table(folder / "strips.csv", notes)
    poses = read_table(folder / "trajectory.csv", _TRAJECTORY, notes)
    ground_table = read_ground_table(folder / "ground_points.csv", crs, notes, may_be_empty=True)
    _refuse_far(ground_table, poses, crs)
    frame = _frame(folder, crs, poses, ground_table)
    notes.extend(f"project.toml: {note}" for note in notes_of_heights(crs))

    trajectories = _trajectories(poses, frame, notes)
    strips = _strips(strip_table, camera, trajectories, notes)
    used = {id(strip.trajectory) for strip in strips}
    extra = [_name(*key) for key, trajectory in trajectories.items() if id(trajectory) not in used]
    notes.extend(f"trajectory.csv: strip {name!r} is not in strips.csv and was ignored" for name in extra)
    ground = known_points(ground_table, frame, notes)
    image_table = read_table(folder / "image_points.csv", _IMAGE, notes, may_be_empty=with_lines)
    point_ids, image = _image_points(image_table, camera, strips, ground, apriori, notes)
    return BlockData(name, frame, camera, strips, point_ids, ground, image, apriori, tuple(notes))


def _name(strip: str, lens: str | None) -> str:
    return strip if lens is None else f"{strip}/{lens}"


def _project(folder: Path, notes: list[str]) -> tuple[str, str, Apriori]:
    path = folder / "project.toml"
    default = folder.resolve().name
    if not path.is_file():
        return default, "local", Apriori()
    file = read_toml(path)
    project, apriori, trajectory = file.table("project"), file.table("apriori"), file.table("trajectory")
    name, crs = project.text("name", default), project.text("crs", "local")
    sigma = apriori.number("image_sigma_px", Apriori.image_sigma_px, positive=True)
    settings, then = trajectory_settings(trajectory)
    for table in (file, project, apriori):
        notes.extend(f"project.toml: key {key} is not known and was ignored" for key in table.unread())
    notes.extend(unknown_settings(settings, then))
    return name, crs, Apriori(sigma, settings, then)


def trajectory_settings(table: Keys) -> tuple[dict[str, object], dict[str, object]]:
    """Settings of the trajectory models in a table ``[trajectory]``, and those in ``[trajectory.then]``.

    Raises
    ------
    UserError : ``file: key: what it holds, what was wanted``
    """
    then = table.table("then")
    if "then" in then.values:
        raise then.refuse("then", "no third step")
    return _settings(table), _settings(then)


def unknown_settings(settings: Mapping[str, object], then: Mapping[str, object]) -> list[str]:
    """A note for each key of ``[trajectory]`` and ``[trajectory.then]`` that no model knows."""
    known, tables = setting_names(), (("trajectory", settings), ("trajectory.then", then))
    return [
        f"project.toml: {table}: key {key} is not known and was ignored"
        for table, stated in tables
        for key in stated
        if key not in known
    ]


def _settings(table: Keys) -> dict[str, object]:
    settings: dict[str, object] = {}
    for key, value in table.values.items():
        if key == "then":
            continue
        if "_sigma" in key:  # one number stands for all three components
            how: dict[str, Any] = {"low": 0.0} if key in WANDER_SIGMAS else {"positive": True}  # a wander may be none
            many = isinstance(value, list)
            settings[key] = table.numbers(key, 3, **how) if many else (table.number(key, **how),) * 3
        elif key in _WHOLE:
            settings[key] = table.integer(key)
        elif key in WANDER_TIMES:
            settings[key] = table.number(key, positive=True)
        else:
            settings[key] = table.raw(key)
    return settings


def _refuse_far(ground: Table, poses: Table, crs: str) -> None:
    """Raise UserError where no known point is near the trajectories, and say whether one is with X and Y exchanged."""
    ground = ground.part(np.isfinite(ground["X_m"]) & np.isfinite(ground["Y_m"]))
    if not len(ground):
        return
    xyz, places = np.nan_to_num(ground.stack(*PLACE)), poses.stack(*PLACE)[:: 1 + len(poses) // _PLACES]
    # looks may go as far aside as the flight is high
    near = FAR_M + max(0.0, float(np.median(places[:, 2]) - np.median(xyz[:, 2])))
    try:
        frame = LocalFrame.around(places, crs)
        seen = frame.from_crs(places)
    except CrsError:  # told where the frame of all is made
        return
    far = _level_distance(to_local(ground, xyz, frame), seen)
    if far <= near:
        return
    try:
        exchanged = _level_distance(frame.from_crs(xyz[:, [1, 0, 2]]), seen) <= near
    except CrsError:
        exchanged = False
    what = f"no point lies within {1e-3 * far:.0f} km of the trajectories, wanted coordinates in {crs!r}"
    raise UserError(f"{ground.path}: {what}{'; X and Y are exchanged' * exchanged}")


def _level_distance(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Least distance in level between points (n, 3) and (m, 3)."""
    from scipy.spatial import KDTree

    return float(np.min(KDTree(other[:, :2]).query(one[:, :2])[0]))


def _frame(folder: Path, crs: str, poses: Table, ground: Table) -> LocalFrame:
    """Local frame at the middle of the box about ground points and trajectories."""
    xyz = poses.stack("X_m", "Y_m", "Z_m")
    known = ground.stack("X_m", "Y_m", "Z_m") if len(ground) else np.empty((0, 3))
    both = np.concatenate([xyz, known[np.isfinite(known).all(axis=1)]])
    try:
        return LocalFrame.around(np.stack([both.min(axis=0), both.max(axis=0)]), crs)
    except CrsError as error:
        raise UserError(f"{folder / 'project.toml'}: project.crs: {error}") from None


def _trajectories(table: Table, frame: LocalFrame, notes: list[str]) -> dict[Key, Trajectory]:
    check_place_units(table, frame)
    xyz, angles = table.stack(*_POSE[:3]), np.radians(table.stack(*_POSE[3:]))
    time = table["time_s"]
    position = to_local(table, xyz, frame)
    R = matrix_from_angles(*angles.T)
    if frame.crs != "local":
        R = frame.R_l_crs(xyz) @ R
    quaternion = quaternion_from_matrix(R)
    found: dict[Key, Trajectory] = {}
    lens = table["lens"] if "lens" in table else np.full(len(table), "", dtype=object)
    for key, rows in _groups(table["strip"], lens):
        step = np.diff(time[rows])
        if (step <= 0).any():
            late = int(rows[1:][step <= 0][0])
            before = time[rows[int(np.flatnonzero(step <= 0)[0])]]
            what = f"{time[late]:.6f} of strip {_name(*key)} does not come after {before:.6f}"
            where = f"{table.path}:{table.line_of(late)}: time_s"
            raise UserError(one_line([f"{where}: {what}"], int((step <= 0).sum()) - 1))
        if len(rows) < 2:
            where = f"{table.path}:{table.line_of(int(rows[0]))}"
            raise UserError(f"{where}: strip: {_name(*key)} has one sample, wanted at least 2")
        found[key] = Trajectory(time[rows], position[rows], quaternion[rows])
        longest = float(step.max())
        if longest > 1.0 and longest > 5 * float(np.median(step)):
            notes.append(f"trajectory.csv: strip {_name(*key)} has a gap of {longest:.2f} s, interpolated")
    return found


def _groups(strip: NDArray[np.object_], lens: NDArray[np.object_]):
    """Rows of each strip (and lens), in the order of their first appearance."""
    names: dict[Key, int] = {}
    pairs = list(zip(strip, lens, strict=True)) if len(set(lens)) > 1 or (len(lens) and lens[0]) else None
    if pairs is None:
        words, code = np.unique(strip.astype(str), return_inverse=True)
        order = np.argsort([int(np.argmax(code == i)) for i in range(len(words))])
        for i in order:
            yield (str(words[i]), None), np.flatnonzero(code == i)
        return
    code = np.array([names.setdefault((s, l or None), len(names)) for s, l in pairs])
    for key, i in names.items():
        yield key, np.flatnonzero(code == i)


def _strip_table(path: Path, notes: list[str]) -> Table:
    """strips.csv; where it names files of line times, the columns that these replace may be absent."""
    if "line_times" not in column_names_of(path):
        return read_table(path, _STRIPS, notes)
    return read_table(path, [replace(c, optional=c.optional or c.name in _OF_LINE_TIMES) for c in _STRIPS], notes)


def _strips(
    table: Table, camera: LineCamera, trajectories: Mapping[Key, Trajectory], notes: list[str]
) -> tuple[Strip, ...]:
    strips: dict[str, Strip] = {}
    lenses = {lens.id for lens in camera.lenses}
    for row in range(len(table)):

        def refuse(column: str, what: str, row: int = row) -> UserError:
            return UserError(f"{table.path}:{table.line_of(row)}: {column}: {what}")

        id, lens = table["strip"][row], (table["lens"][row] or None) if "lens" in table else None
        if lens is not None and lens not in lenses:
            raise refuse("lens", f"{lens!r}, wanted one of {', '.join(sorted(lenses))}")
        name = _name(id, lens)
        if name in strips:
            raise refuse("strip", f"{name} comes twice")
        trajectory = trajectories.get((id, lens)) or trajectories.get((id, None))
        if trajectory is None:
            raise refuse("strip", f"no trajectory of {name} in trajectory.csv")
        first, rate, lines = (float(table[c][row]) if c in table else np.nan for c in _OF_LINE_TIMES)
        lines = 0 if np.isnan(lines) else int(lines)
        times = table["line_times"][row] if "line_times" in table else ""
        line_time = None
        if times:
            line_time = _line_times(table.path.parent / times, refuse, notes)
            if lines not in (0, len(line_time)):
                raise refuse("lines", f"{lines}, but {times} has {len(line_time)}")
            first, rate = float(line_time[0]), (len(line_time) - 1) / float(line_time[-1] - line_time[0])
            lines = len(line_time)
        elif np.isnan(first) or np.isnan(rate):
            column = "first_line_time_s" if np.isnan(first) else "line_rate_hz"
            raise refuse(column, "missing, wanted a number (or a file of line times in line_times)")
        if lines > LONGEST_STRIP_S * rate:
            raise refuse("lines", f"{lines:.6g}, {rate:g} a second: more than a day")
        strip = Strip(name, trajectory, first, rate, lines, line_time, lens)
        last = float(max(lines - 1, 0))
        ends = strip.time_of(np.array([0.0, last]))
        if not trajectory.covers(ends).any() and (ends[1] < trajectory.start_s or ends[0] > trajectory.end_s):
            raise refuse(
                "first_line_time_s",
                f"lines from {ends[0]:.3f} to {ends[1]:.3f} s, trajectory from {trajectory.start_s:.3f} to "
                f"{trajectory.end_s:.3f} s",
            )
        if lines:
            lost = [u for u, inside in zip((0.0, last), trajectory.covers(ends), strict=True) if not inside]
            notes.extend(f"strips.csv: line {u:.0f} of strip {name} lies outside its trajectory" for u in lost)
        strips[name] = strip
    return tuple(strips.values())


def _line_times(path: Path, refuse, notes: list[str]) -> NDArray[np.float64]:
    if not (is_there(path) and path.is_file()):
        raise refuse("line_times", f"no file {path.name[:60]!r} beside it")
    table = read_table(path, _LINE_TIMES, notes)
    line, time = table["line"], table["time_s"]
    if len(line) < 2:
        raise UserError(f"{path}: one line, wanted at least 2")
    table.refuse(line != np.arange(len(line)), "line", lambda i: f"{line[i]:.0f}, wanted {i} (0, 1, 2, ...)")
    back = np.concatenate([[False], np.diff(time) <= 0])
    table.refuse(back, "time_s", lambda i: f"{time[i]:.6f} does not come after {time[i - 1]:.6f}")
    return time


def _image_points(
    table: Table, camera: LineCamera, strips: tuple[Strip, ...], ground: KnownPoints, apriori: Apriori,
    notes: list[str],
) -> tuple[tuple[str, ...], ImagePoints]:  # fmt: skip
    ids: dict[str, int] = {id: i for i, id in enumerate(ground.id)}
    point = _codes(table["point"], lambda id: ids.setdefault(id, len(ids)))
    ccd = _codes(table["ccd"], lambda id: camera.line_index.get(id, -1))
    base = {_base(strip): i for i, strip in enumerate(strips)}
    strip = _codes(table["strip"], lambda id: base.get((id, None), -1))
    if any(s.lens is not None for s in strips):  # strip and lens of the CCD line decide
        lens = np.array([line.lens for line in camera.lines] + [""])[ccd]
        for key, i in base.items():
            if key[1] is not None:
                strip[(table["strip"] == key[0]) & (lens == key[1])] = i
    unknown = np.flatnonzero((strip < 0) | (ccd < 0))
    for row in unknown[:5]:
        what = f"ccd: {table['ccd'][row]!r} is not in camera.json"
        if strip[row] < 0:
            what = f"strip: {table['strip'][row]!r} is not in strips.csv"
        notes.append(f"image_points.csv:{table.line_of(int(row))}: {what}; the ray cannot be used")
    if len(unknown) > 5:
        notes.append(f"image_points.csv: {len(unknown) - 5} more rays name an unknown strip or CCD line")
    notes.extend(notes_of_names(tuple(ids), len(ground), point))
    line, sample = table["line"], table["sample"]
    sigma = np.full(len(table), apriori.image_sigma_px)
    if "sigma_px" in table:
        sigma = np.where(np.isnan(table["sigma_px"]), sigma, table["sigma_px"])
    time = np.full(len(table), np.nan)
    for i, one in enumerate(strips):
        mine = strip == i
        time[mine] = one.time_of(line[mine])
    keep = _without_repeats(point, strip, ccd, line, sample, notes)
    names = {i: (str(table["strip"][row]), str(table["ccd"][row])) for i, row in _places(keep, unknown)}
    measured = (c[keep].astype(float) for c in (line, sample, sigma, time))
    return tuple(ids), ImagePoints(point[keep], strip[keep], ccd[keep], *measured, unknown=names)


def _base(strip: Strip) -> Key:
    return (strip.id if strip.lens is None else strip.id.removesuffix(f"/{strip.lens}"), strip.lens)


def _codes(words: NDArray[np.object_], code: Callable[[str], int]) -> NDArray[np.int64]:
    """A number for every word; ``code`` is called once for each different word, in the order of appearance."""
    known: dict[str, int] = {}
    return np.fromiter((known[w] if w in known else known.setdefault(w, code(w)) for w in words), np.int64, len(words))


def _without_repeats(point, strip, ccd, line, sample, notes: list[str]) -> NDArray[np.int64]:
    """Rows without exact repeats of the same measurement, which would count twice."""
    columns = np.stack([point, strip, ccd, line, sample], axis=1)
    order = np.lexsort(columns.T[::-1])
    same = np.zeros(len(point), dtype=bool)
    same[order[1:]] = (columns[order[1:]] == columns[order[:-1]]).all(axis=1)
    if same.any():
        notes.append(f"image_points.csv: {same.sum()} rows repeat a measurement and were left out")
    return np.flatnonzero(~same)


def _places(keep: NDArray[np.int64], rows: NDArray[np.int64]):
    """(place among the kept rows, row) of those rows that were kept."""
    place = np.searchsorted(keep, rows)
    for p, row in zip(place, rows, strict=True):
        if p < len(keep) and keep[p] == row:
            yield int(p), int(row)
