"""Opens rasters so that nothing but what is raised is shown of one that is damaged."""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UserError

#: Values that mean that no height is known, in rasters that do not say which does; so do those beyond `_NO_HEIGHT`.
_VOIDS, _NO_HEIGHT = (-9999.0, -32767.0, -32768.0, -99999.0), 1e30
#: Units of heights that count as metres.
_METRES = ("", "m", "metre", "meter", "metres", "meters")

_alone = threading.Lock()


def open_raster(path: Path, *, overviews: bool = True) -> Any:
    """A dataset of rasterio, with or without georeference.

    Parameters
    ----------
    path : of the raster
    overviews : whether GDAL may take reduced values from overviews. These need not be means, nor lie where the means of
        as many values do: places in them are off by a part of a reduced cell

    Raises
    ------
    rasterio.errors.RasterioError : not there, or not a raster that can be read
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    with warnings.catch_warnings(), _without_undecodable_messages():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            return rasterio.open(path) if overviews else rasterio.open(path, OVERVIEW_LEVEL="NONE")
        except UnicodeDecodeError:  # where rasterio would say what GDAL says, which names what the file names
            raise RasterioIOError(f"{path}: names a file in bytes that are no UTF-8") from None


def is_raster(path: Path) -> bool:
    """Whether GDAL opens a file as a raster."""
    from rasterio.errors import RasterioError

    try:
        open_raster(path).close()
    except RasterioError:
        return False
    return True


def check_grey_values(path: Path, source: Any) -> None:
    """Refuse a dataset between whose values nothing can be interpolated.

    Raises
    ------
    UserError : complex numbers, or numbers of a colour table
    """
    from rasterio.enums import ColorInterp

    if any(np.dtype(name).kind == "c" for name in source.dtypes):
        raise UserError(f"{path}: complex numbers, wanted grey values")
    if ColorInterp.palette in source.colorinterp:  # between number 3 and number 5 is no colour in the middle
        raise UserError(
            f"{path}: numbers of a colour table, wanted grey values (gdal_translate -expand rgb makes them)"
        )


def unit_of_heights(source: Any) -> str:
    """The unit of the first band of a dataset; "" for metres, and where it states none."""
    unit = (source.units[0] or "").strip().lower()
    return "" if unit in _METRES else unit


def as_stated(source: Any, values: NDArray[Any]) -> NDArray[Any]:
    """Values of the first band of a dataset, times the scale and plus the offset that it states."""
    scale, offset = source.scales[0], source.offsets[0]
    return values if scale == 1.0 and offset == 0.0 else values * values.dtype.type(scale) + values.dtype.type(offset)


def known_heights(source: Any, band: Any, dtype: Any) -> NDArray[Any]:
    """Heights of a masked window of the first band as the raster states them, NaN where not known.

    Voids that a raster has without a no-data value would be holes of ten kilometres.
    """
    with np.errstate(invalid="ignore"):  # damaged files hold signalling NaN
        z = np.ma.filled(band.astype(dtype), np.nan)
        if source.nodata is None:
            z[np.isin(z, _VOIDS) | (np.abs(z) > _NO_HEIGHT)] = np.nan
        return as_stated(source, z)


@contextmanager
def _without_undecodable_messages() -> Iterator[None]:
    """Drop messages of GDAL that quote bytes of the file which are no UTF-8.

    rasterio decodes messages in a function that GDAL calls; what is raised there cannot reach a caller, and is printed
    with a traceback, first by `sys.excepthook` and then by `sys.unraisablehook`.
    """
    with _alone:  # hooks belong to the process
        shown, ignored = sys.excepthook, sys.unraisablehook

        def show(kind: type[BaseException], error: BaseException, trace: Any) -> None:
            if not issubclass(kind, UnicodeDecodeError):
                shown(kind, error, trace)

        def ignore(error: Any) -> None:
            if not issubclass(error.exc_type, UnicodeDecodeError):
                ignored(error)

        sys.excepthook, sys.unraisablehook = show, ignore
        try:
            yield
        finally:
            sys.excepthook, sys.unraisablehook = shown, ignored
