"""The Earth orientation that is installed with triline: IERS C04, then Bulletin A with its predictions."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from ....solver.orbit.earth_orientation import EarthOrientationTable
from ...errors import UserError

_ARCSEC = np.pi / 180.0 / 3600.0


@functools.cache
def installed_table() -> EarthOrientationTable:
    """The table of the package ``astropy-iers-data``: off line, and as new as that package.

    Raises
    ------
    UserError : the package is not installed, or its files are not as expected
    """
    try:
        from astropy_iers_data import IERS_A_FILE, IERS_B_FILE
    except ImportError:
        raise UserError("Earth orientation: the package astropy-iers-data is missing, wanted: pip install it") from None
    return join(read_c04(Path(IERS_B_FILE)), read_finals(Path(IERS_A_FILE)))


def read_c04(path: Path) -> EarthOrientationTable:
    """The series C04 of the IERS: year, month, day, hour, MJD, x, y (arcsec), UT1-UTC (s), ..

    Raises
    ------
    UserError : not such a file
    """
    rows = []
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if line.startswith("#") or not line.strip():
                continue
            try:
                mjd, x, y, ut1_utc = (float(word) for word in line.split()[4:8])
            except ValueError:  # no numbers, or fewer
                raise UserError(f"{path}:{number}: no row of the series C04, wanted MJD x y UT1-UTC") from None
            rows.append([mjd, x, y, ut1_utc])
    return _table(path, rows)


def read_finals(path: Path) -> EarthOrientationTable:
    """``finals2000A`` of the IERS: fixed columns, values of Bulletin A, with a year of predictions.

    Raises
    ------
    UserError : not such a file
    """
    rows, predicted = [], np.inf
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line[58:68].strip():  # days without a prediction end the file
                continue
            try:
                row = [float(line[a:b]) for a, b in ((7, 15), (18, 27), (37, 46), (58, 68))]
            except ValueError:
                raise UserError(
                    f"{path}:{number}: no row of finals2000A, wanted MJD x y UT1-UTC in fixed columns"
                ) from None
            if "P" in (line[16], line[57]):
                predicted = min(predicted, row[0])
            rows.append(row)
    return _table(path, rows, predicted)


def join(first: EarthOrientationTable, then: EarthOrientationTable) -> EarthOrientationTable:
    """The first table, and what the other one has after its end."""
    later = then.mjd > first.mjd[-1]
    columns = [
        np.concatenate([getattr(first, name), getattr(then, name)[later]])
        for name in ("mjd", "ut1_utc_s", "pole_x", "pole_y")
    ]
    return EarthOrientationTable(*columns, predicted_from_mjd=then.predicted_from_mjd)


def _table(path: Path, rows: list[list[float]], predicted: float = np.inf) -> EarthOrientationTable:
    if len(rows) < 2:
        raise UserError(f"{path}: {len(rows)} days of Earth orientation, wanted at least 2")
    mjd, x, y, ut1 = np.array(rows).T
    try:
        return EarthOrientationTable(mjd, ut1, x * _ARCSEC, y * _ARCSEC, predicted)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
