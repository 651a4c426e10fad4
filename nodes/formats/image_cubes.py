"""Images that a camera's program has cut into files one behind the other, cubes: ``raw_0``, ``raw_2000`` ..."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .envi import header_of
from .grey_image import ImageFile
from .keys import is_there
from .tiff_image import is_tiff


@dataclass(frozen=True, kw_only=True)
class JoinedImage(ImageFile):
    """Cubes one behind the other as one image; its ``path`` is that of the first.

    Attributes
    ----------
    cubes : at least two, of the same samples, bands and type
    """

    cubes: tuple[ImageFile, ...]

    def read(self, first: int, count: int, band: int) -> NDArray[Any]:
        parts, begin = [], 0
        for cube in self.cubes:
            low, high = max(first - begin, 0), min(first + count - begin, cube.lines)
            if low < high:
                parts.append(cube.read(low, high - low, band))
            begin += cube.lines
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


def joined(cubes: list[ImageFile]) -> ImageFile:
    """One image of cubes; a single one is itself.

    Raises
    ------
    UserError : a cube of another size or type than the first
    """
    one = cubes[0]
    for cube in cubes[1:]:
        if (cube.samples, cube.bands, cube.kind) != (one.samples, one.bands, one.kind):
            raise UserError(f"{cube.path}: {_size(cube)}, wanted {_size(one)} as in {one.path.name}")
    if len(cubes) == 1:
        return one
    return JoinedImage(
        path=one.path,
        lines=sum(cube.lines for cube in cubes),
        samples=one.samples,
        bands=one.bands,
        kind=one.kind,
        names=one.names,
        notes=tuple(note for cube in cubes for note in cube.notes),
        cubes=tuple(cubes),
    )


def is_pattern(path: Path) -> bool:
    """Whether a path is no file's, but a pattern for those of cubes, as in ``raw_*``."""
    return any(c in path.name for c in "*?[") and not is_there(path)


def cubes_of(path: Path, *, headless: bool) -> list[Path]:
    """The images that a pattern names, in the order of the numbers in their names; of any other path itself alone.

    Parameters
    ----------
    headless : files without a header are images, too

    Raises
    ------
    UserError : a pattern that fits no image
    """
    if not is_pattern(path):
        return [path]
    there = [found for found in path.parent.glob(path.name) if found.is_file() and found.suffix.lower() != ".hdr"]
    images = [found for found in there if headless or header_of(found) is not None or is_tiff(found)]
    if not images:
        raise UserError(f"{path}: {len(there)} files, none of them an image" if there else f"{path}: no such files")
    return sorted(images, key=lambda found: [(int(n or 0), word) for n, word in re.findall(r"(\d+)|(\D+)", found.name)])


def _size(image: ImageFile) -> str:
    return f"{image.samples} samples of {image.bands} bands of {image.kind.name}"
