"""GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .features import Features, parts_of_line
from .new_file import new_file


def write_geojson(path: Path, features: Features) -> int:
    """Write points and lines as one FeatureCollection, lines cut at the date line; returns the number of features."""
    place = [_place(row) for row in features.lon_lat_height.tolist()]
    names = list(features.properties)
    columns = [features.properties[name] for name in names]
    count = 0
    with open(path, "w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for name, pieces in features.lines.items():
            places = [features.lon_lat_height[rows] for rows in pieces]
            _write(file, _line(*places), {"line": name, "points": sum(map(len, pieces))}, count)
            count += 1
        for i, values in enumerate(zip(*columns, strict=True)):
            _write(file, {"type": "Point", "coordinates": place[i]}, dict(zip(names, values, strict=True)), count)
            count += 1
        file.write("\n]}\n")
    return count


def _place(row: list[float]) -> list[float]:
    """Longitude and latitude, degrees, and a height in metres if there is one, without digits that say nothing."""
    return [round(value, 4 if k == 2 else 9) for k, value in enumerate(row)]


def _line(*pieces: NDArray[np.float64]) -> dict[str, Any]:
    """Geometry of a line, in pieces (n, 2 or 3) of longitude, latitude, height."""
    parts = [[_place(row) for row in part.tolist()] for piece in pieces for part in parts_of_line(piece)]
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0]}
    return {"type": "MultiLineString", "coordinates": parts}


def _write(file: Any, geometry: dict[str, Any], properties: dict[str, Any], number: int) -> None:
    feature = {"type": "Feature", "geometry": geometry, "properties": properties}
    file.write((",\n" if number else "\n") + json.dumps(feature))


def write_line_features(
    path: Path, lines: Iterable[tuple[NDArray[np.float64], dict[str, Any]]], *, geographic: bool
) -> int:
    """Write lines, each with its places (n, 2) and its properties; returns their number.

    The file gets its name when it is whole.

    Parameters
    ----------
    geographic : places are longitudes and latitudes, degrees; else plain coordinates

    Raises
    ------
    UserError : the file cannot be written
    """
    count = 0
    with new_file(path) as part, open(part, "w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for places, properties in lines:
            plain = {"type": "LineString", "coordinates": [_place(row) for row in places.tolist()]}
            _write(file, _line(places) if geographic else plain, properties, count)
            count += 1
        file.write("\n]}\n")
    return count
