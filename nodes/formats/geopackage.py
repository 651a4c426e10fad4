"""GeoPackage (OGC 12-128r18) by SQLite: one table of points, and one of lines where there are any."""

from __future__ import annotations

import errno
import re
import sqlite3
import struct
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .features import Features, parts_of_line

APPLICATION_ID = 0x47504B47  # "GPKG"
VERSION = 10300
WGS84 = 4326
_POINT_Z, _LINE_Z = 1001, 1002

_SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL, m TINYINT NOT NULL, CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""


def write_geopackage(path: Path, name: str, features: Features) -> int:
    """Write features as a new GeoPackage; returns the number of features, of which a line across the date line is one,
    in two rows.

    Parameters
    ----------
    name : of the table of points; lines go to ``<name>_lines``

    Raises
    ------
    OSError : the file cannot be written
    """
    table = re.sub(r"\W", "_", name)
    try:
        path.unlink(missing_ok=True)
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("PRAGMA journal_mode = MEMORY")  # a file of its own would stay where a disk is full
            database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            database.execute(f"PRAGMA user_version = {VERSION}")
            database.executescript(_SCHEMA)
            database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", _reference_systems())
            points = [_point(place) for place in features.lon_lat_height]
            _add_table(database, table, "POINT", points, features.properties, features.lon_lat_height)
            lines = {
                name: [part for rows in pieces for part in parts_of_line(features.lon_lat_height[rows])]
                for name, pieces in features.lines.items()
            }
            if lines:
                parts = [(name, part) for name, cut in lines.items() for part in cut]
                names = {"line": [name for name, _ in parts], "points": [len(part) for _, part in parts]}
                blobs = [_line(part) for _, part in parts]
                places = np.concatenate([part for _, part in parts])
                _add_table(database, f"{table}_lines", "LINESTRING", blobs, names, places)
            return len(points) + len(lines)
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error), str(path)) from None


def _reference_systems() -> list[tuple[Any, ...]]:
    from pyproj import CRS

    definition = CRS.from_epsg(WGS84).to_wkt("WKT1_GDAL")
    return [
        ("Undefined Cartesian", -1, "NONE", -1, "undefined", None),
        ("Undefined geographic", 0, "NONE", 0, "undefined", None),
        ("WGS 84", WGS84, "EPSG", WGS84, definition, "longitude, latitude; heights above the ellipsoid"),
    ]


def _add_table(
    database: sqlite3.Connection,
    table: str,
    geometry: str,
    blobs: list[bytes],
    properties: dict[str, list[Any]],
    place: NDArray[np.float64],
) -> None:
    columns = ", ".join(f'"{name}" {_sql_type(values)}' for name, values in properties.items())
    database.execute(f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {geometry}, {columns})')
    low, high = place[:, :2].min(axis=0), place[:, :2].max(axis=0)
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    database.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (table, table, now, float(low[0]), float(low[1]), float(high[0]), float(high[1]), WGS84),
    )
    database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)", (table, geometry, WGS84))
    marks = ", ".join("?" * (1 + len(properties)))
    names = ", ".join(["geom", *(f'"{name}"' for name in properties)])
    database.executemany(
        f'INSERT INTO "{table}" ({names}) VALUES ({marks})', zip(blobs, *properties.values(), strict=True)
    )


def _sql_type(values: list[Any]) -> str:
    known = next((value for value in values if value is not None), 0.0)
    if isinstance(known, bool):
        return "BOOLEAN"
    return "INTEGER" if isinstance(known, int) else "REAL" if isinstance(known, float) else "TEXT"


def _header() -> bytes:
    """Header of a geometry: version 1, little-endian, no envelope."""
    return struct.pack("<2sBBi", b"GP", 0, 1, WGS84)


def _point(place: NDArray[np.float64]) -> bytes:
    return _header() + struct.pack("<BI3d", 1, _POINT_Z, *place.tolist())


def _line(places: NDArray[np.float64]) -> bytes:
    return _header() + struct.pack("<BII", 1, _LINE_Z, len(places)) + np.ascontiguousarray(places, "<f8").tobytes()
