"""What commands write: what they must not write to or over, and pictures."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import UserError
from ..formats.new_file import new_file, refuse_unless_writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def refuse_empty_words(argv: list[str]) -> None:
    """Raise UserError where a name is empty or ``-``.

    As a path the empty one would stand for the folder in which the command runs, and ``-`` for a file of that name: no
    command reads standard input or writes a file to standard output.
    """
    for before, word in pairwise(["", *argv]):
        option, equals, value = word.partition("=")
        if len(word) == 3 and word[0] == word[2] == "-" and word[1].isalpha():  # -o-
            option, equals, value = word[:2], "=", "-"
        if not option.startswith("-") or not equals:
            option, value = before if before.startswith("-") else "", word
        where = f"{option} " if option else ""
        if not value:
            raise UserError(f"{where}'': wanted a name")
        if value == "-":
            raise UserError(f"{where}-: wanted the name of a file, not standard input or output")


#: Options that name a file which a command writes.
_WRITTEN = (
    *("output", "csv", "map_csv", "plot", "page", "mask", "sigma", "source", "seam_lines", "stac"),
    *("parquet", "geojson", "gpkg", "sbet", "smrmsg", "points", "per_line", "rrd"),
)
#: Files of a block, a flight, a sensor folder or scenes that no other file of the folder names.
_OF_FOLDERS = {
    *("project.toml", "flight.toml", "platform.toml", "camera.json", "expected.json"),
    *("strips.csv", "trajectory.csv", "ground_points.csv", "image_points.csv"),
    *("imu.csv", "gnss.csv", "gnss.pos", "gnss.txt", "attitude.csv"),
}
_LONGEST_TEXT = 1_000_000


def refuse_input_as_output(args: argparse.Namespace, option: str = "", file: Path | None = None) -> None:
    """Raise UserError where a file that a command is to write is one of those that it reads.

    Parameters
    ----------
    option : that names what is written, as an attribute; without it all that do
    file : that is written where it is not the one that the option names, but beside it
    """
    for written in (option,) if option else _WRITTEN:
        output = file or getattr(args, written, None)
        if not isinstance(output, (str, Path)) or not output or not os.path.isfile(output):
            continue
        for name, value in vars(args).items():
            for word in _words(value) if name not in _WRITTEN else ():
                if os.path.isfile(word) and os.path.samefile(word, output):
                    raise UserError(f"{output}: the output would overwrite the {name.replace('_', ' ')}")
                if os.path.isdir(word) and _is_read_of(Path(word), Path(output)):
                    raise UserError(f"{output}: the output would overwrite a file of {word}")


def _is_read_of(folder: Path, file: Path) -> bool:
    """Whether a file belongs to what is read of a folder: by its name, or because another file there names it."""
    if file.resolve().parent != folder.resolve():
        return False
    if file.name in _OF_FOLDERS:
        return True
    texts = [path for kind in ("*.toml", "*.json") for path in folder.glob(kind) if path.name != file.name]
    small = [path for path in texts if path.is_file() and path.stat().st_size <= _LONGEST_TEXT]
    named = re.compile(rf"(?<![\w.-]){re.escape(file.name)}(?![\w.-])")  # not as a part of another name
    return any(named.search(path.read_text(encoding="utf-8", errors="replace")) for path in small)


def refuse_over_files(written: Iterable[Path | str | None], read: Iterable[Path]) -> None:
    """Raise UserError where a file to write is one of those that are read, as those of a folder that is named whole."""
    there = [Path(path) for path in written if path is not None and os.path.isfile(path)]
    for path in read if there else ():
        for output in there:
            if os.path.isfile(path) and os.path.samefile(path, output):
                raise UserError(f"{output}: the output would overwrite {path}, which is read")


def refuse_unless_picture(path: Path) -> None:
    """Raise UserError where ``--plot`` names what is no picture, or cannot be written: asked before the work."""
    refuse_unless_writable(path)
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise UserError(f"--plot {path}: wanted a name that ends in .png, .svg or .pdf")


def write_picture(path: Path, draw: Callable[[], Figure], dpi: int) -> None:
    """Write what ``draw`` draws in the style of the pages, in the format that the name of ``--plot`` says."""
    from ..report.style import styled  # draws with matplotlib

    with styled(), new_file(path) as part:
        draw().savefig(part, format=path.suffix.lstrip(".").lower(), dpi=dpi)


#: Ends of names that say a format: of rasters, tables, vectors, pages and what this program writes itself.
_FORMATS = {
    *(".asc", ".bil", ".bip", ".bmp", ".bsq", ".dat", ".dem", ".ecw", ".gif", ".grd", ".h5", ".hdr", ".hgt", ".img"),
    *(".j2k", ".jp2", ".jpeg", ".jpg", ".mbtiles", ".nc", ".ntf", ".pgm", ".png", ".ppm", ".raw", ".sid", ".tif"),
    *(".tiff", ".vrt", ".webp", ".xyz", ".zarr"),
    *(".csv", ".dxf", ".geojson", ".gpkg", ".html", ".json", ".kml", ".kmz", ".las", ".laz", ".mcap", ".parquet"),
    *(".pdf", ".rrd", ".shp", ".svg", ".toml", ".txt", ".xml", ".zip"),
}


def refuse_other_format(path: Path | str | None, written: str, *endings: str, more: str = "") -> None:
    """Raise UserError where the end of a name says another format than what is written; asked before the work.

    Parameters
    ----------
    written : what is written, for people
    endings : that say it; a name without an ending, or with one that says no format, is good as well
    more : is said behind what was wanted
    """
    ending = "" if path is None else Path(path).suffix.lower()
    if ending in _FORMATS and ending not in endings:
        wanted = " or ".join(filter(None, (", ".join(endings[:-1]), endings[-1])))
        raise UserError(f"{path}: {written} is written, wanted a name that ends in {wanted}{more}")


def refuse_folder_of_inputs(folder: Path) -> None:
    """Raise UserError where a result would be written among the files of a block or of a flight, over some of them."""
    # readers that only commands with folders of results need
    from ..formats.block_folder import is_block_folder
    from ..formats.scene_block import is_scene_block

    if is_scene_block(folder) or is_block_folder(folder) or (folder / "flight.toml").is_file():
        raise UserError(f"{folder}: has the files of a block or a flight, wanted another folder for the result")


def _words(value: Any) -> Iterator[str]:
    """What may be the name of a file in the value of an option: itself, and the files in ``F=a.img@1,N=b.img``."""
    for one in value if isinstance(value, (list, tuple)) else (value,):
        if isinstance(one, (str, Path)):
            text = os.fspath(one)
            yield text
            yield from (word.split("@")[0] for word in re.split("[=,]", text)[1:])
