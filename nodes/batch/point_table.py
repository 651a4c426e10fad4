"""Object points of a recording, one row a point, each by its best answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.units import place_columns
from .. import convert
from ..formats.table import csv_field
from ..recording.reader import RecordingReader
from ..recording.summary import lacking

_SIGMAS = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")


def write_points(reader: RecordingReader, path: Path, *, covariance: bool = False) -> tuple[int, int]:
    """Write ``point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,rays,role,status,checked`` in the project's CRS.

    A CRS in another unit has it in the names of the coordinates (``X_deg,Y_deg,Z_m``); sigmas are in metres. A point
    half of whose rays were left out is checked as ``doubtful``: its sigma is of the rest, and says nothing of these.

    The best answer for a point is that of the whole strip, else the final one, else the first; of several of a kind the
    last. Returns the number of points, and of those that were live but never final where others became final: their
    looks were refused since, or the recording ends before.

    Parameters
    ----------
    covariance : also the covariances ``cov_XY_m2,cov_XZ_m2,cov_YZ_m2``

    Raises
    ------
    UserError : no object points in the recording
    """
    best: dict[str, Any] = {}
    for message in reader.in_frame(reader.sorted_messages(["point/object"])):
        body = message.body
        if np.isfinite([body.x, body.y, body.z]).all() and (
            body.point not in best or body.status >= best[body.point].status
        ):
            best[body.point] = body
    if not best:
        raise lacking(reader, "no message on point/object: `triline process` makes them")
    project = reader.last("configuration/project")
    frame = convert.local_frame(project if project is not None else m.Project())
    xyz = np.array([(p.x, p.y, p.z) for p in best.values()])
    none = np.full(9, np.nan)
    C = np.array([p.covariance if len(p.covariance) == 9 else none for p in best.values()]).reshape(-1, 3, 3)
    place = frame.to_crs(xyz)
    R = frame.R_l_crs(place)
    C = np.swapaxes(R, 1, 2) @ C @ R
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", C), 0.0))
    flat = ".9f" if frame.is_geographic else ".4f"
    more = ("cov_XY_m2", "cov_XZ_m2", "cov_YZ_m2") if covariance else ()
    with open(path, "w", encoding="utf-8", newline="") as file:
        columns = ("point", *place_columns(frame.units), *_SIGMAS, *more, "rays", "role", "status", "checked")
        file.write(",".join(columns) + "\n")
        for i, p in enumerate(best.values()):
            values = [format(v, f) for v, f in zip(place[i], (flat, flat, ".4f"), strict=True)]
            values += ["" if np.isnan(s) else f"{s:.4f}" for s in sigma[i]]
            if covariance:
                values += ["" if np.isnan(c) else f"{c:.6e}" for c in C[i][[0, 0, 1], [1, 2, 2]]]
            status = convert.enum_name(m.ObjectPoint.Status, p.status)
            words = [csv_field(p.point), *values, str(p.rays), csv_field(p.role), status, csv_field(p.checked)]
            file.write(",".join(words) + "\n")
    live = sum(p.status == m.ObjectPoint.LIVE for p in best.values())
    return len(best), live if live < len(best) else 0
