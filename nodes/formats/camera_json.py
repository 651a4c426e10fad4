"""The camera of a block folder: ``camera.json`` and the tables it names."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...solver.camera.line_camera import CcdLine, Lens, LineCamera
from ...solver.camera.sensors import line_from_parameters
from ..errors import UserError
from .keys import Keys, is_there, read_json
from .new_file import new_file
from .table import Column, read_table, write_table

#: The most pixels of a CCD line, ten times those of the longest lines that are built.
MOST_PIXELS = 1_000_000
#: No pixel of a line camera looks farther off the axis of its lens, degrees: fish-eyes end here as well.
FARTHEST_DEG = 80.0
_TABLE = (Column("sample", "integer", low=0), Column("x_mm"), Column("y_mm"))


def read_camera(path: Path, notes: list[str] | None = None) -> LineCamera:
    """A camera from ``camera.json``.

    A line is given by its parameters (``pixels``, ``pixel_size_mm``, ``center_mm``, ``inclination_deg``), to which the
    lens's ``distortion`` (Brown's k1, k2, k3, p1, p2; mm-based) is added, or by a ``table`` of calibrated pixel centres
    (CSV ``sample,x_mm,y_mm`` beside the file), which stands as it is. ``chips`` lists the first sample of each chip.

    Raises
    ------
    UserError : naming file, key and what was wanted
    """
    path = Path(path)
    notes = [] if notes is None else notes
    file = read_json(path)
    name = file.text("name", path.parent.name or "camera")
    lenses = {}
    for keys in file.tables("lenses"):
        lens = _lens(keys)
        if lens.id in lenses:
            raise keys.refuse("id", "an id that no other lens has")
        lenses[lens.id] = lens
        notes.extend(f"{path.name}: key {key} is not known and was ignored" for key in keys.unread())
    lines: dict[str, CcdLine] = {}
    for keys in file.tables("lines"):
        line = _line(keys, lenses, notes)
        _refuse_wide(keys, line, lenses[line.lens])
        if line.id in lines:
            raise keys.refuse("id", "an id that no other line has")
        lines[line.id] = line
        notes.extend(f"{path.name}: key {key} is not known and was ignored" for key in keys.unread())
    notes.extend(f"{path.name}: key {key} is not known and was ignored" for key in file.unread())
    return LineCamera(name, tuple(lenses.values()), tuple(lines.values()))


def read_camera_instead(path: Path, camera: LineCamera, told: str = "", notes: list[str] | None = None) -> LineCamera:
    """The camera of a ``camera.json`` that stands for another one: a calibrated one in place of that of a recording.

    Its CCD lines come in the order of the other's.

    Parameters
    ----------
    camera : for which it stands
    told : of the file in the error, where it was not named by the user
    notes : gets remarks

    Raises
    ------
    UserError : a camera that cannot be read, or with other CCD lines
    """
    if not path.is_file():
        raise UserError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}, wanted a camera.json")
    found = read_camera(path, notes)
    lenses = max(len(camera.lenses), len(found.lenses)) > 1

    def lines_of(c: LineCamera) -> dict[str, tuple[int, str]]:
        return {line.id: (line.pixels, line.lens if lenses else "") for line in c.lines}

    if lines_of(found) != lines_of(camera):
        words = ", ".join(
            f"{id} with {pixels} pixels" + (f" behind {lens}" if lens else "")
            for id, (pixels, lens) in lines_of(camera).items()
        )
        raise UserError(f"{path}: {told}has other lines, wanted {words}")
    return replace(found, lines=tuple(found.lines[found.line_index[line.id]] for line in camera.lines))


def _lens(keys: Keys) -> Lens:
    focal_length = keys.number("focal_length_mm", positive=True)
    x, y = keys.numbers("principal_point_mm", 2, (0.0, 0.0))
    distortion = keys.raw("distortion", [])
    if isinstance(distortion, dict):  # by name
        named = keys.table("distortion")
        distortion = [named.number(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2")]
        if named.unread():
            raise UserError(f"{keys.path}: {named.unread()[0]}: unknown, wanted some of k1, k2, k3, p1, p2")
    elif not isinstance(distortion, list) or len(distortion) not in (0, 5):
        raise keys.refuse("distortion", "5 numbers: k1, k2, k3, p1, p2")
    elif distortion:
        distortion = keys.numbers("distortion", 5)
    return Lens(keys.text("id"), focal_length, (x, y), tuple(distortion) if any(distortion) else ())


def _line(keys: Keys, lenses: dict[str, Lens], notes: list[str]) -> CcdLine:
    id = keys.text("id")
    lens = keys.text("lens", next(iter(lenses)) if len(lenses) == 1 else None)
    if lens not in lenses:
        raise keys.refuse("lens", f"one of the lenses {', '.join(lenses)}")
    if keys.has("table"):
        xy = _read_table(keys.path.parent / keys.text("table"), keys, notes)
        for unused in ("pixel_size_mm", "center_mm", "inclination_deg"):
            keys.raw(unused)
        if keys.has("pixels") and keys.integer("pixels", low=2) != len(xy):
            raise keys.refuse("pixels", f"{len(xy)}, the number of samples in {keys.text('table')}")
        return CcdLine(id, lens, xy, _chips(keys, len(xy)))
    pixels = keys.integer("pixels", low=2, high=MOST_PIXELS)
    centre = keys.numbers("center_mm", 2)
    return line_from_parameters(
        id,
        lenses[lens],
        pixels,
        keys.number("pixel_size_mm", positive=True),
        (centre[0], centre[1]),
        float(np.radians(keys.number("inclination_deg", 0.0))),
        _chips(keys, pixels),
    )


def _refuse_wide(keys: Keys, line: CcdLine, lens: Lens) -> None:
    """Raise UserError where lengths of a lens and a line cannot be in one unit: micrometres, metres, pixels."""
    farthest = float(np.linalg.norm(line.xy_mm - lens.principal_point_mm, axis=1).max())
    angle = float(np.degrees(np.arctan2(farthest, lens.focal_length_mm)))
    if not angle <= FARTHEST_DEG:
        raise UserError(
            f"{keys.path}: {keys.where}: pixels up to {farthest:.4g} mm off the axis of a lens with a focal length of "
            f"{lens.focal_length_mm:g} mm, {angle:.1f} degrees, wanted {FARTHEST_DEG:g} at most; is all of it in mm?"
        )


def _chips(keys: Keys, pixels: int) -> tuple[int, ...]:
    chips = keys.raw("chips", [])
    good = isinstance(chips, list) and all(isinstance(c, int) and not isinstance(c, bool) for c in chips)
    if not good or (chips and (chips[0] != 0 or chips != sorted(set(chips)) or chips[-1] >= pixels)):
        raise keys.refuse("chips", f"the first sample of each chip: 0, ... , rising, below {pixels}")
    return tuple(chips)


def _read_table(path: Path, keys: Keys, notes: list[str]) -> np.ndarray:
    if not (is_there(path) and path.is_file()):
        raise UserError(f"{keys.path}: {keys.name('table')}: no file {path.name[:60]!r} beside it")
    table = read_table(path, _TABLE, notes)
    sample = table["sample"]
    if len(sample) < 2:
        raise UserError(f"{path}: one sample, wanted at least 2")
    table.refuse(sample != np.arange(len(sample)), "sample", lambda i: f"{sample[i]:.0f}, wanted {i} (0, 1, 2, ...)")
    return table.stack("x_mm", "y_mm")


def write_camera(path: Path, camera: LineCamera) -> None:
    """Write ``NAME.json``, and beside it ``NAME_LINE.csv`` with the pixel centres of each line; `read_camera` gives the
    same camera."""
    path = Path(path)
    lenses = []
    for lens in camera.lenses:
        entry: dict[str, object] = {
            "id": lens.id,
            "focal_length_mm": lens.focal_length_mm,
            "principal_point_mm": list(lens.principal_point_mm),
        }
        if lens.distortion:
            entry["distortion"] = list(lens.distortion)
        lenses.append(entry)
    lines = []
    tables: set[str] = set()  # in small letters: some systems take capitals for the same
    for line in camera.lines:
        name = f"{path.stem}_{''.join(c if c.isalnum() or c in '-_' else '_' for c in line.id)}"
        table, number = f"{name}.csv", 2
        while table.lower() in tables:
            table, number = f"{name}_{number}.csv", number + 1
        tables.add(table.lower())
        write_table(
            path.parent / table,
            {"sample": range(line.pixels), "x_mm": line.xy_mm[:, 0], "y_mm": line.xy_mm[:, 1]},
            {"x_mm": ".9f", "y_mm": ".9f"},
        )
        entry = {"id": line.id, "lens": line.lens, "pixels": line.pixels, "table": table}
        if line.chips:
            entry["chips"] = list(line.chips)
        lines.append(entry)
    text = json.dumps({"name": camera.name, "lenses": lenses, "lines": lines}, indent=1)
    with new_file(path) as part:
        part.write_text(text + "\n", encoding="utf-8")
