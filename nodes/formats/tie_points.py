"""Tie points between strips as a table or as messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...solver.geometry.earth import geodetic_from_ecef
from ..node import Message
from .geocal_xml import TiePoints
from .table import write_table

#: Line of AVIRIS-NG's only CCD, as `geocal_xml.read_glas_camera` calls it.
CCD = "N"


def strip_names(ties: TiePoints) -> tuple[str, ...]:
    """Names of the images, which the file does not give: image1, image2, ..."""
    return tuple(f"image{i + 1}" for i in range(ties.line.shape[1]))


def write_tie_points(path: Path, ties: TiePoints) -> int:
    """Write the image points as ``image_points.csv`` of a block folder, each with its approximate ground point."""
    point, image = np.nonzero(np.isfinite(ties.line) & np.isfinite(ties.sample))
    names = np.array(strip_names(ties))
    lat, lon, height = _geodetic(ties).T
    columns = {
        "point": [f"T{i + 1:04d}" for i in point],
        "strip": names[image],
        "ccd": [CCD] * len(point),
        "line": ties.line[point, image],
        "sample": ties.sample[point, image],
        "sigma_px": np.maximum(ties.sigma_line, ties.sigma_sample)[point, image],
        "lat_deg": lat[point],
        "lon_deg": lon[point],
        "height_m": height[point],
    }
    formats = dict.fromkeys(("line", "sample", "sigma_px"), ".4f") | {
        "lat_deg": ".8f",
        "lon_deg": ".8f",
        "height_m": ".3f",
    }
    write_table(path, columns, formats)
    return len(point)


def tie_point_messages(ties: TiePoints, name: str, source: str = "import") -> Iterator[Message]:
    """``configuration/project`` and one ``observation/tie`` a point; they have no times, so the stamp is 0."""
    lat, lon, _ = np.median(_geodetic(ties), axis=0)
    project = m.Project(name=name, crs="local", origin_latitude=round(lat, 6), origin_longitude=round(lon, 6))
    yield Message("configuration/project", 0, project, source)
    names = strip_names(ties)
    for i in range(len(ties)):
        tie = grouped(m.TiePoint)(point=f"T{i + 1:04d}")
        for k in range(len(names)):
            if np.isfinite(ties.line[i, k]) and np.isfinite(ties.sample[i, k]):
                tie.images.add(
                    strip=names[k],
                    ccd=CCD,
                    line=ties.line[i, k],
                    sample=ties.sample[i, k],
                    sigma_line=ties.sigma_line[i, k],
                    sigma_sample=ties.sigma_sample[i, k],
                )
        yield Message("observation/tie", 0, tie, source)


def statistics(ties: TiePoints) -> dict[str, Any]:
    """Counts, and the median, 95 % and largest sigma of a line and of a sample in each image."""
    result: dict[str, Any] = {
        "points": len(ties),
        "rays": int((np.isfinite(ties.line) & np.isfinite(ties.sample)).sum()),
        "control": int(ties.is_control.sum()),
    }
    for k, name in enumerate(strip_names(ties)):
        result[name] = {
            what: [round(float(v), 4) for v in np.percentile(sigma[:, k], [50, 95, 100])]
            for what, sigma in (("sigma_line_px", ties.sigma_line), ("sigma_sample_px", ties.sigma_sample))
        }
    return result


def _geodetic(ties: TiePoints) -> np.ndarray:
    g = geodetic_from_ecef(ties.position_e)
    g[:, :2] = np.degrees(g[:, :2])
    return g
