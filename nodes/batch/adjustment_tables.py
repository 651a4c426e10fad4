"""The tables of a batch adjustment: adjusted points, residuals, refined trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.units import place_columns
from ...solver.adjustment.layout import CorrectionSet
from ...solver.adjustment.pose_noise import orientation_noise
from ...solver.adjustment.refined_orientation import AT_ONCE, correction_cofactors, corrections_at
from ...solver.adjustment.reliability import reliability
from ...solver.geometry.rotation import corrected_angles, matrix_from_angles
from ..formats.line_orientation import OrientedLines, poses_in_crs
from ..formats.table import write_table
from .adjustment_result import TABLES, Adjustment, set_name

Array = NDArray[np.floating]
#: By name of the column: numbers, or words as objects.
Columns = dict[str, NDArray[Any]]

_AXES = ("X", "Y", "Z")
_ANGLES = ("omega", "phi", "kappa")
_GEODETIC = ("lat_deg", "lon_deg", "height_m")


def write_tables(adjustment: Adjustment, folder: Path) -> list[Path]:
    """Write ``points.csv``, ``residuals.csv`` and ``trajectory_refined.csv``; returns their paths."""
    paths = []
    for name, table in zip(TABLES, (points_table, residuals_table, trajectory_table), strict=True):
        path, columns = folder / name, table(adjustment)
        write_table(path, columns, {key: "" for key, values in columns.items() if values.dtype != object})
        paths.append(path)
    return paths


def points_table(adjustment: Adjustment) -> Columns:
    """Adjusted object points in the project's CRS, in the order of the input; empty where nothing is determined.

    Columns of coordinates state the unit of the CRS (``X_m`` or ``X_deg``); sigmas are in metres.
    """
    block, result = adjustment.block, adjustment.result
    network = result.network
    order = np.array([network.point_index[id] for id in block.point_ids if id in network.point_index], dtype=np.int64)
    xyz, C = result.adjusted_points()[order], result.point_covariance[order]
    known = np.isfinite(xyz).all(axis=1)
    places = np.full_like(xyz, np.nan)
    sigma = np.full_like(xyz, np.nan)
    frame = block.frame
    if known.any():
        places[known] = frame.to_crs(xyz[known])
        R = frame.R_l_crs(places[known])
        sigma[known] = np.sqrt(np.maximum(np.einsum("pji,pjk,pki->pi", R, C[known], R), 0.0))
    in_use = np.bincount(network.rays.point, result.solution.ray_weight > 0, network.n_points).astype(int)
    decimals = 9 if frame.is_geographic else 5
    columns: Columns = {"point": _words(network.point_ids[i] for i in order)}
    columns |= {a: np.round(places[:, k], 5 if k == 2 else decimals) for k, a in enumerate(place_columns(frame.units))}
    columns |= {f"sigma_{a}_m": np.round(sigma[:, k], 6) for k, a in enumerate(_AXES)}
    doubtful = np.isin(order, [d.point for d in result.doubtful]).astype(int)
    role = network.role()
    return columns | {"rays": in_use[order], "role": _words(role[order]), "doubtful": doubtful}


def residuals_table(adjustment: Adjustment) -> Columns:
    """Residuals of all image points that could be used, in the order of the input, pixels."""
    block, result = adjustment.block, adjustment.result
    rays, s = result.network.rays, result.rays
    order = np.argsort(rays.source)
    names = [block.image_name(int(row)) for row in rays.source[order]]
    r = reliability(s.redundancy, s.sigma_px)
    out = np.zeros(len(rays), dtype=bool)
    out[[x.ray for x in result.rejected if x.ray >= 0]] = True
    columns: Columns = {
        "point": _words(n[0] for n in names),
        "strip": _words(n[1] for n in names),
        "ccd": _words(n[2] for n in names),
        "line": rays.line[order],
        "sample": rays.sample[order],
    }
    detectable, outer = (np.where(np.isfinite(values), values, np.nan) for values in (r.detectable, r.outer))
    for prefix, values, digits in (
        ("v", s.v_px, 5),
        ("w", s.w, 4),
        ("redundancy", r.redundancy, 5),
        ("detectable", detectable, 4),
        ("outer", outer, 4),
    ):
        unit = "_px" if prefix in ("v", "detectable") else ""
        for k, coordinate in enumerate(("line", "sample")):
            columns[f"{prefix}_{coordinate}{unit}"] = np.round(values[order, k], digits)
    return columns | {"rejected": out[order].astype(int)}


def trajectory_table(adjustment: Adjustment) -> Columns:
    """Refined orientation at the samples of the measured trajectories, in the project's CRS, with sigmas.

    Where the place of the local frame is known, latitude, longitude and height above the ellipsoid say it: recordings
    that are adjusted together stand in that of the first.
    """
    frame, reference = adjustment.block.frame, adjustment.block.time_reference_ns
    parts = []
    for item in adjustment.result.solution.layout.sets:
        time = adjustment.block.strips[item.strip].trajectory.time_s
        position, R_lc, covariance = _refined(adjustment, item, time)
        places, angles, sigma = poses_in_crs(position, R_lc, covariance, frame)
        angles = np.degrees(angles)
        decimals = 9 if frame.is_geographic else 5
        strip = _words([set_name(adjustment, item)] * len(time))
        columns: Columns = {"strip": strip, "time_s": _seconds(time, reference)}
        columns |= {
            a: np.round(places[:, k], 5 if k == 2 else decimals) for k, a in enumerate(place_columns(frame.units))
        }
        columns |= {f"{a}_deg": np.round(angles[:, k], 9) for k, a in enumerate(_ANGLES)}
        columns |= {f"sigma_{a}_m": np.round(sigma[:, k], 6) for k, a in enumerate(_AXES)}
        columns |= {f"sigma_{a}_deg": np.round(np.degrees(sigma[:, 3 + k]), 9) for k, a in enumerate(_ANGLES)}
        if frame.is_placed:
            geodetic = frame.to_geodetic(position)
            columns |= {a: np.round(geodetic[:, k], 5 if k == 2 else 10) for k, a in enumerate(_GEODETIC)}
        parts.append(columns)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _words(words: Iterable[str]) -> NDArray[np.object_]:
    return np.array(list(words), dtype=object)


def _seconds(time_s: Array, reference_ns: int) -> NDArray[Any]:
    """Seconds as they stand in tables: of a recording UTC since 1970, with all digits."""
    if not reference_ns:
        return np.round(time_s, 9)
    whole = [divmod(reference_ns + round(float(t) * 1e9), 10**9) for t in time_s]
    return _words(f"{seconds}.{rest:09d}" for seconds, rest in whole)


def _refined(adjustment: Adjustment, item: CorrectionSet, time_s: Array) -> tuple[Array, Array, Array]:
    """Position (n, 3) and rotation (n, 3, 3) to the local frame, and their covariance (n, 6, 6).

    It is that of the corrections, with what these cannot follow: the slow errors between borders, and the noise of the
    measured poses.
    """
    poses = adjustment.block.strips[item.strip].trajectory.at(time_s)
    correction, covariance = correction_functions(adjustment, item, time_s)
    result = adjustment.result
    for i in range(0, len(time_s), AT_ONCE):
        some = slice(i, i + AT_ONCE)
        noise = orientation_noise(result.solution, result.information, item.strip, time_s[some])
        left_out = item.model.left_out_variance(time_s[some])[:, :, None] * np.eye(6)
        covariance[some] += result.sigma0**2 * (noise + left_out)
    turn = correction[:, 3:]
    angles = corrected_angles(poses.angles, turn) if adjustment.block.heading else poses.angles + turn
    return poses.position_l + correction[:, :3], matrix_from_angles(*angles.T), covariance


def oriented_lines(adjustment: Adjustment) -> Iterator[OrientedLines]:
    """Refined orientation of all lines of each strip, as far as its trajectory goes, without those in gaps of it."""
    reference = adjustment.block.time_reference_ns
    for item in adjustment.result.solution.layout.sets:
        strip = adjustment.block.strips[item.strip]
        path = strip.trajectory
        last = strip.lines - 1 if strip.lines else int((path.end_s - strip.first_line_time_s) * strip.line_rate_hz)
        line = np.arange(last + 1)
        time = np.asarray(strip.time_of(line), dtype=float)
        oriented = strip.oriented(time)
        line, time = line[oriented], time[oriented]
        if not len(line):
            continue
        stamps = reference + np.rint(time * 1e9).astype(np.int64)
        yield OrientedLines(set_name(adjustment, item), line, stamps, *_refined(adjustment, item, time))


def correction_functions(adjustment: Adjustment, item: CorrectionSet, time_s: Array) -> tuple[Array, Array]:
    """Corrections (n, 6) of all stages together, and their a-posteriori covariance (n, 6, 6); metres and radians.

    The covariance is that of the last stage, which estimates what the stages before it left.
    """
    solution = adjustment.result.solution
    which = solution, item.strip, time_s, item.lens
    return corrections_at(*which), adjustment.result.sigma0**2 * correction_cofactors(*which)
