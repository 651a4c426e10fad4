"""A STAC item (1.0.0) beside a mosaic: where it lies and which files belong to it."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.rectification.grid import transformer_to
from ..errors import UserError
from .new_file import new_file

#: Places along each edge of the extent, whose longitudes and latitudes give the footprint.
_EDGE = 9
_TYPES = {
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized", ".vrt": "application/xml",
    ".geojson": "application/geo+json",
}  # fmt: skip
_ROLES = {"mosaic": ["data"], "source": ["metadata"], "seams": ["metadata"], "sigma": ["metadata"]}


def write_stac_item(
    path: Path, mosaic: Path, crs: str, gsd: float, done: dict[str, Any], result: dict[str, Any],
    assets: dict[str, Path | None],
) -> None:  # fmt: skip
    """Write the item; paths of assets are as seen from its folder.

    Parameters
    ----------
    crs, gsd : of the cells
    done : first row and column (numbered over the projection), rows, columns
    result : of the command; layers and seams go into the properties
    assets : name -> file

    Raises
    ------
    UserError : a local frame, which has no place on the Earth, or a file that cannot be written
    """
    if crs == "local":
        raise UserError("--stac: wanted a map projection (--crs), not the local frame")
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
    lon, lat = transformer_to(crs).transform(x, y, direction="INVERSE")
    ring = [[round(float(a), 8), round(float(b), 8)] for a, b in zip([*lon, lon[0]], [*lat, lat[0]], strict=True)]
    epsg = pyproj.CRS.from_user_input(crs).to_epsg()
    item = {
        "type": "Feature", "stac_version": "1.0.0", "id": mosaic.stem,
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": [min(p[0] for p in ring), min(p[1] for p in ring), max(p[0] for p in ring), max(p[1] for p in ring)],
        "properties": {
            "datetime": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"), "gsd": gsd,
            "proj:epsg": epsg, "proj:shape": [done["rows"], done["columns"]],
            "proj:transform": [gsd, 0.0, left, 0.0, -gsd, top],
            "triline:layers": [layer["name"] for layer in result["layers"]],
            "triline:step_across_seams": result["step_across_seams"],
        },
        "links": [],
        "assets": {
            name: {"href": os.path.relpath(file, path.parent), "type": _TYPES[file.suffix], "roles": _ROLES[name]}
            for name, file in assets.items() if file is not None
        },
    }  # fmt: skip
    with new_file(path) as part:
        part.write_text(json.dumps(item, indent=2) + "\n", encoding="utf-8")
