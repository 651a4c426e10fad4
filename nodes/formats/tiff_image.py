"""TIFF images of lines, with or without coordinates: what GDAL reads of them, some lines at a time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError
from .grey_image import ImageFile
from .height_raster import RasterFile

_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True, kw_only=True)
class TiffImage(ImageFile):
    """A TIFF whose rows are image lines in the order of their times."""

    file: RasterFile

    def read(self, first: int, count: int, band: int) -> NDArray[Any]:
        from rasterio.errors import RasterioError
        from rasterio.windows import Window

        window = Window(0, first, self.samples, count)
        try:
            return self.file.source.read(band + 1, window=window)
        except RasterioError as error:
            where = f"lines {first} to {first + count - 1}"
            raise UserError(f"{self.path}: {where}: {' '.join(str(error).split())}; damaged?") from None


def is_tiff(path: Path) -> bool:
    """Whether a file begins like a TIFF or BigTIFF."""
    with open(path, "rb") as file:
        return file.read(4) in _MAGIC


def open_tiff(path: Path) -> TiffImage:
    """A TIFF by name; bands are named by their descriptions, where all have one.

    Raises
    ------
    UserError : not there, not a TIFF that can be read, or one of complex numbers
    """
    file = RasterFile(path)
    if file.dtype.kind not in "uif":
        raise UserError(f"{path}: values of type {file.dtype}, wanted real numbers")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = tuple(name or "" for name in file.source.descriptions)
    notes: tuple[str, ...] = ()
    if file.crs is not None and not file.transform.is_identity:
        notes = (f"{path.name}: has coordinates; its rows are taken as image lines: an orthoimage has none any more",)
    named = names if all(names) and len(set(names)) == len(names) else ()
    return TiffImage(
        path=path, lines=file.rows, samples=file.columns, bands=file.count, kind=np.dtype(file.dtype), names=named,
        notes=notes, file=file,
    )  # fmt: skip
