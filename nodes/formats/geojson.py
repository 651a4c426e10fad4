"""GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .features import Features
from .new_file import new_file


def write_geojson(path: Path, features: Features) -> int:
    """Write points and lines as one FeatureCollection; returns the number of features."""
    place = [[round(lon, 9), round(lat, 9), round(h, 4)] for lon, lat, h in features.lon_lat_height.tolist()]
    names = list(features.properties)
    columns = [features.properties[name] for name in names]
    count = 0
    with open(path, "w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for name, rows in features.lines.items():
            geometry = {"type": "LineString", "coordinates": [place[row] for row in rows]}
            _write(file, geometry, {"line": name, "points": len(rows)}, count)
            count += 1
        for i, values in enumerate(zip(*columns, strict=True)):
            _write(file, {"type": "Point", "coordinates": place[i]}, dict(zip(names, values, strict=True)), count)
            count += 1
        file.write("\n]}\n")
    return count


def _write(file: Any, geometry: dict[str, Any], properties: dict[str, Any], number: int) -> None:
    feature = {"type": "Feature", "geometry": geometry, "properties": properties}
    file.write((",\n" if number else "\n") + json.dumps(feature))


def write_line_features(path: Path, lines: Iterable[tuple[list[list[float]], dict[str, Any]]]) -> int:
    """Write lines, each with longitudes and latitudes (or plain coordinates) and its properties; returns their number.

    The file gets its name when it is whole.

    Raises
    ------
    UserError : the file cannot be written
    """
    count = 0
    with new_file(path) as part, open(part, "w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for places, properties in lines:
            _write(file, {"type": "LineString", "coordinates": places}, properties, count)
            count += 1
        file.write("\n]}\n")
    return count
