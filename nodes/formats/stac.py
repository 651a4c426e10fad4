"""A STAC item (1.0.0) beside a mosaic: where it lies and which files belong to it."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.rectification.grid import transformer_to
from .geotiff import is_virtual
from .new_file import new_file

Array = NDArray[np.floating]

#: Places along each edge of the extent, whose longitudes and latitudes give the footprint.
_EDGE = 9
_COG, _VRT, _LINES = (
    "image/tiff; application=geotiff; profile=cloud-optimized", "application/xml", "application/geo+json",
)  # fmt: skip
_ROLES = {"mosaic": ["data"], "source": ["metadata"], "seams": ["metadata"], "sigma": ["metadata"]}


def write_stac_item(
    path: Path, mosaic: Path, crs: str, gsd: float, done: dict[str, Any], result: dict[str, Any],
    assets: dict[str, Path | None],
) -> None:  # fmt: skip
    """Write the item; paths of assets are as seen from its folder.

    Its time is from the first image line to the last, where all layers tell theirs, else that of its making.

    Parameters
    ----------
    crs, gsd : of the cells, in a map projection
    done : first row and column (numbered over the projection), rows, columns
    result : of the command; layers and seams go into the properties
    assets : name -> file

    Raises
    ------
    UserError : a file that cannot be written
    """
    import pyproj

    left, top = done["column"] * gsd, -done["row"] * gsd
    right, bottom = left + done["columns"] * gsd, top - done["rows"] * gsd
    s = np.linspace(0.0, 1.0, _EDGE)[:-1]
    x = np.concatenate(
        [left + s * (right - left), np.full(len(s), right), right - s * (right - left), np.full(len(s), left)]
    )
    y = np.concatenate(
        [np.full(len(s), bottom), bottom + s * (top - bottom), np.full(len(s), top), top - s * (top - bottom)]
    )
    to_map = transformer_to(crs)
    lon, lat = to_map.transform(x, y, direction="INVERSE")
    poles = [(pole, *to_map.transform(0.0, pole)) for pole in (-90.0, 90.0)]
    inside = [pole for pole, x, y in poles if left < x < right and bottom < y < top]
    outline = np.column_stack([lon, lat])
    geometry, bbox = _round_pole(outline, inside[0]) if inside else _footprint(*outline.T)
    made = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    of_cells = pyproj.CRS.from_user_input(crs)
    epsg = of_cells.to_epsg()
    item = {
        "type": "Feature", "stac_version": "1.0.0", "id": mosaic.stem,
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "geometry": geometry, "bbox": bbox,
        "properties": {
            **_times(result["layers"], made), "created": made, "gsd": _metres(crs, left, right, bottom, top, gsd),
            "proj:epsg": epsg, **({} if epsg is not None else {"proj:wkt2": of_cells.to_wkt("WKT2_2019")}),
            "proj:shape": [done["rows"], done["columns"]],
            "proj:transform": [gsd, 0.0, left, 0.0, -gsd, top],
            "triline:layers": [layer["name"] for layer in result["layers"]],
            "triline:step_across_seams": result["step_across_seams"],
        },
        "links": [],
        "assets": {
            name: {
                "href": os.path.relpath(file, path.parent), "roles": _ROLES[name],
                "type": _LINES if name == "seams" else _VRT if is_virtual(file) else _COG,
            }
            for name, file in assets.items() if file is not None
        },
    }  # fmt: skip
    with new_file(path) as part:
        part.write_text(json.dumps(item, indent=2) + "\n", encoding="utf-8")


def _footprint(lon: Array, lat: Array) -> tuple[dict[str, Any], list[float]]:
    """Geometry and bounds of an outline (n,), degrees; across the date line two polygons, and west above east."""
    across = np.ptp(lon) > 180.0
    if across:
        lon = np.where(lon < 0, lon + 360.0, lon)
    outline = np.column_stack([lon, lat])
    parts = [_cut(outline, -1.0), _cut(outline, 1.0) - [360.0, 0.0]] if across else [outline]
    rings = [[[round(a, 8), round(b, 8)] for a, b in [*part.tolist(), part[0].tolist()]] for part in parts]
    west, east = lon.min(), lon.max() - (360.0 if across else 0.0)
    bounds = [round(float(v), 8) for v in (west, lat.min(), east, lat.max())]
    if across:
        return {"type": "MultiPolygon", "coordinates": [[ring] for ring in rings]}, bounds
    return {"type": "Polygon", "coordinates": rings}, bounds


def _round_pole(outline: Array, pole: float) -> tuple[dict[str, Any], list[float]]:
    """Geometry and bounds of what an outline (n, 2) round a pole, at latitude -90 or 90, has inside: all longitudes."""
    lon, lat = outline[np.argsort(outline[:, 0])].T
    at_date_line = float(np.interp(180.0, [lon[-1], lon[0] + 360.0], [lat[-1], lat[0]]))
    edge = np.column_stack([[-180.0, *lon, 180.0], [at_date_line, *lat, at_date_line]]).tolist()
    ring = [*edge, [180.0, pole], [-180.0, pole], edge[0]]
    ring = ring if pole > 0.0 else ring[::-1]  # counterclockwise
    south, north = (float(lat.min()), pole) if pole > 0.0 else (pole, float(lat.max()))
    bounds = [-180.0, round(south, 8), 180.0, round(north, 8)]
    return {"type": "Polygon", "coordinates": [[[round(a, 8), round(b, 8)] for a, b in ring]]}, bounds


def _cut(outline: Array, side: float) -> Array:
    """The part (m, 2) of a convex outline (n, 2) west (side -1) or east (1) of 180 degrees."""
    out = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        before, after = side * (a[0] - 180.0), side * (b[0] - 180.0)
        if before >= 0:
            out.append(a)
        if before * after < 0:
            out.append(a + before / (before - after) * (b - a))
    return np.array(out)


def _times(layers: list[dict[str, Any]], made: str) -> dict[str, str | None]:
    """When the images were taken."""
    spans = [(layer.get("first_line_utc"), layer.get("last_line_utc")) for layer in layers]
    first, last = ([t for t in times if t] for times in zip(*spans, strict=True))
    if len(first) < len(spans):
        return {"datetime": made}
    return {"datetime": None, "start_datetime": min(first), "end_datetime": max(last)}


def _metres(crs: str, left: float, right: float, bottom: float, top: float, gsd: float) -> float:
    """Side of a cell in the middle of the mosaic, metres on the ground."""
    import pyproj

    x, y = 0.5 * (left + right), 0.5 * (bottom + top)
    lon, lat = transformer_to(crs).transform([x, x + gsd, x], [y, y, y + gsd], direction="INVERSE")
    sides = pyproj.Geod(ellps="WGS84").inv([lon[0]] * 2, [lat[0]] * 2, lon[1:], lat[1:])[2]
    return float(f"{float(np.sqrt(sides[0] * sides[1])):.3g}")
