"""Matched tie points among the rows of image_points.csv: those of a run before go, all other rows stay."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from .new_file import new_file
from .scene_block import IMAGE
from .table import separator_of

#: Names of matched points, by which a later run knows its own.
_OWN = re.compile(r"match_\d{6,}")


@dataclass(frozen=True)
class MatchedLook:
    """One look at a matched point: its number, scene, line of detectors ("" where the scene has one) and pixel."""

    point: int
    scene: str
    ccd: str
    line: float
    sample: float
    sigma_px: float


def write_matched_points(
    source: Path, target: Path, looks: Iterable[MatchedLook], known: Collection[str]
) -> tuple[int, int]:
    """Write the rows of a table that are not of a run before, and matched points after them.

    Parameters
    ----------
    source : image_points.csv, which need not be there
    target : may be the same
    looks : points are numbered from 0 on
    known : names of ground points: these are nobody's own, whatever they are like

    Returns
    -------
    rows that stayed, rows that went
    """
    header, rows, (separator, decimal) = [column.name for column in IMAGE], [], (",", ".")
    if source.is_file():
        separator, decimal = separator_of(source)
        with open(source, newline="", encoding="utf-8-sig") as file:
            lines = [row for row in csv.reader(file, skipinitialspace=True, delimiter=separator) if any(row)]
        header, rows = [name.strip() for name in lines[0]], lines[1:]
    at = header.index("point")
    stay = [row for row in rows if not _OWN.fullmatch(row[at].strip()) or row[at].strip() in known]
    went = len(rows) - len(stay)
    looks = list(looks)
    more = [name for name in ("ccd", "sigma_px") if name not in header]
    if not any(look.ccd for look in looks):
        more = [name for name in more if name != "ccd"]
    stay = [row + [""] * (len(header) - len(row)) for row in stay]
    header += more
    # numbers of names that ground points or rows that stay have are left out
    taken = {*known, *(row[at].strip() for row in stay)}
    names: dict[int, str] = {}
    number = 0
    with new_file(target) as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n", delimiter=separator)
        writer.writerow(header)
        writer.writerows([*row, *[""] * len(more)] for row in stay)
        for look in looks:
            while look.point not in names:
                number += 1
                if (name := f"match_{number:06d}") not in taken:
                    names[look.point] = name
            fields = {
                "point": names[look.point], "strip": look.scene, "ccd": look.ccd, "line": f"{look.line:.5f}",
                "sample": f"{look.sample:.5f}", "sigma_px": f"{look.sigma_px:.4f}",
            }  # fmt: skip
            for name in ("line", "sample", "sigma_px"):
                fields[name] = fields[name].replace(".", decimal)
            writer.writerow([fields.get(name, "") for name in header])
    return len(stay), went
