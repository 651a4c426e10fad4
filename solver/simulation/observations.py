"""What the CCD lines see of the ground: when, in which image line and at which sample a point is imaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..adjustment.network import Strip
from ..camera.collinearity import project
from ..camera.line_camera import LineCamera
from ..geometry.rotation import matrix_from_angles
from ..geometry.trajectory import Trajectory

Array = NDArray[np.floating]
IntArray = NDArray[np.int_]

#: Steps of the search for the time a CCD line passes over a point: over the strip, then around each passage.
COARSE_S, FINE_S, WINDOW_S = 0.5, 0.05, 2.5
#: How close the line condition is solved, mm in the focal plane.
TOLERANCE_MM = 1e-11


@dataclass(frozen=True)
class Looks:
    """Images of points; n looks, sorted by point, then by time.

    Attributes
    ----------
    point, strip, ccd : (n,) indices
    time_s : (n,)
    line, sample : (n,) pixels
    """

    point: IntArray
    strip: IntArray
    ccd: IntArray
    time_s: Array
    line: Array
    sample: Array

    def __len__(self) -> int:
        return len(self.point)

    def select(self, chosen: NDArray[np.bool_] | IntArray) -> Looks:
        """The looks of a mask or in an order."""
        point, strip, ccd = (a[chosen] for a in (self.point, self.strip, self.ccd))
        return Looks(point, strip, ccd, self.time_s[chosen], self.line[chosen], self.sample[chosen])


class _LineCurve:
    """A CCD line as ``x(y)`` and ``sample(y)``, straight on beyond its ends."""

    def __init__(self, xy_mm: Array):
        turned = xy_mm[-1, 1] < xy_mm[0, 1]
        samples = np.arange(len(xy_mm), dtype=float)
        self._sample = samples[::-1] if turned else samples
        self._x, self._y = (xy_mm[::-1] if turned else xy_mm).T
        if not (np.diff(self._y) > 0).all():
            raise ValueError("a CCD line must run across the flight: its y coordinates do not increase all along")

    def at(self, y: Array) -> tuple[Array, Array]:
        i = np.clip(np.searchsorted(self._y, y) - 1, 0, len(self._y) - 2)
        share = (y - self._y[i]) / (self._y[i + 1] - self._y[i])
        x = self._x[i] + share * (self._x[i + 1] - self._x[i])
        return x, self._sample[i] + share * (self._sample[i + 1] - self._sample[i])


def find_looks(point_l: Array, strips: tuple[Strip, ...], camera: LineCamera) -> Looks:
    """When, in which line and at which sample each CCD line of each strip images each point.

    The line condition - the projection of the point lies on the CCD line - is solved along the strip's trajectory.
    Where attitude jitter makes a line pass over a point more than once, the first passage counts. Relief hides nothing.

    Parameters
    ----------
    point_l : (m, 3) local frame
    """
    parts = [_looks_of_strip(point_l, s, strip, camera) for s, strip in enumerate(strips)]
    point, strip, ccd = (np.concatenate([getattr(p, a) for p in parts]) for a in ("point", "strip", "ccd"))
    time_s, line, sample = (np.concatenate([getattr(p, a) for p in parts]) for a in ("time_s", "line", "sample"))
    joined = Looks(point, strip, ccd, time_s, line, sample)
    return joined.select(np.lexsort((joined.time_s, joined.point)))


def _looks_of_strip(point_l: Array, index: int, strip: Strip, camera: LineCamera) -> Looks:
    """Looks of one strip, by CCD line."""
    curves = [_LineCurve(line.xy_mm - camera.principal_point_mm[k]) for k, line in enumerate(camera.lines)]
    truth = strip.trajectory
    start, end = float(strip.time_of(0)), float(strip.time_of(strip.lines - 1))
    if not len(point_l):
        nothing = np.empty(0, dtype=int)
        return Looks(nothing, nothing, nothing, np.empty(0), np.empty(0), np.empty(0))
    # the grid goes a little beyond the strip, so that a passage at its very ends is found too
    t = np.arange(max(start - 2.0, truth.start_s), min(end + 2.0, truth.end_s), FINE_S)
    poses = truth.at(t)
    position, R = poses.position_l, matrix_from_angles(*poses.angles.T)
    near = _within_reach(point_l, position, R, camera)
    point_l = point_l[near]
    stride = max(1, round(COARSE_S / FINE_S))
    around = np.arange(-round(WINDOW_S / FINE_S), round(WINDOW_S / FINE_S) + 1)
    nothing, no_number = np.empty(0, dtype=int), np.empty(0)
    found: list[tuple[IntArray, IntArray, Array, Array, Array]] = [(nothing, nothing, no_number, no_number, no_number)]
    for first in range(0, len(point_l), 400):
        chunk = point_l[first : first + 400]
        coarse = np.arange(0, len(t), stride)
        f = np.einsum("tji,ptj->pti", R[coarse], chunk[:, None] - position[coarse])
        below = f[..., 2] < 0
        for k, curve in enumerate(curves):
            c = camera.focal_length_mm[k]
            with np.errstate(divide="ignore", invalid="ignore"):
                ahead = -c * f[..., 0] / f[..., 2] - curve.at(-c * f[..., 1] / f[..., 2])[0]
            p, j = _first_passage(ahead, below)
            fine = np.clip(coarse[j][:, None] + around, 0, len(t) - 1)
            g = np.einsum("ptji,ptj->pti", R[fine], chunk[p][:, None] - position[fine])
            ahead = -c * g[..., 0] / g[..., 2] - curve.at(-c * g[..., 1] / g[..., 2])[0]
            q, i = _first_passage(ahead, g[..., 2] < 0)
            p = p[q]
            t0, t1 = t[fine[q, i]], t[fine[q, i + 1]]
            time_s, y = _refine(chunk[p], truth, curve, c, t0, t1, ahead[q, i], ahead[q, i + 1])
            sample = curve.at(y)[1]
            line = (time_s - start) * strip.line_rate_hz
            seen = camera.lines[k].contains(sample) & (line >= 0) & (line <= strip.lines - 1)
            found.append((first + p[seen], np.full(int(seen.sum()), k), time_s[seen], line[seen], sample[seen]))
    point, ccd, time_s, line, sample = (np.concatenate(a) for a in zip(*found, strict=True))
    return Looks(near[point], np.full(len(point), index), ccd, time_s, line, sample)


def _within_reach(point_l: Array, position_l: Array, R_lc: Array, camera: LineCamera) -> IntArray:
    """Indices of the points that are no farther from the path, across the ground, than a CCD line can see.

    In a block of many strips the others are most of the points, and need no search. The farthest ray of all poses to
    the deepest point, a fifth more, is the reach; where a ray looks up, no point is left out.
    """
    depth = position_l[:, 2].max() - point_l[:, 2].min()
    rays = np.concatenate([
        np.column_stack([xy, np.full(len(xy), -c)])
        for line, xy0, c in zip(camera.lines, camera.principal_point_mm, camera.focal_length_mm, strict=True)
        for xy in (line.xy_mm[:: max(1, len(line.xy_mm) // 16)] - xy0, line.xy_mm[-1:] - xy0)
    ])  # fmt: skip
    ray_l = np.einsum("tij,kj->tki", R_lc[::10], rays)
    if depth <= 0 or (ray_l[..., 2] >= 0).any():
        return np.arange(len(point_l))
    reach = 1.2 * depth * float((np.hypot(ray_l[..., 0], ray_l[..., 1]) / -ray_l[..., 2]).max())
    away, _ = KDTree(position_l[:, :2]).query(point_l[:, :2], distance_upper_bound=reach)
    return np.flatnonzero(np.isfinite(away))


def _first_passage(ahead: Array, below: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Rows of (p, t) that change from ahead (positive) to behind, and the last column before they do so first."""
    passed = (ahead[:, :-1] > 0) & (ahead[:, 1:] <= 0) & below[:, :-1] & below[:, 1:]
    rows = np.flatnonzero(passed.any(axis=1))
    return rows, passed[rows].argmax(axis=1)


def _refine(
    point_l: Array, truth: Trajectory, curve: _LineCurve, c: float, t0: Array, t1: Array, g0: Array, g1: Array
) -> tuple[Array, Array]:
    """Times at which the line condition holds, between bracketing times (Illinois method); and y there, mm."""
    a, b, ga, gb = t0, t1, g0, g1
    t, y = t1.copy(), np.zeros_like(t1)
    open_ = np.arange(len(t1))
    for _ in range(60):
        s = (a * gb - b * ga) / (gb - ga)
        poses = truth.at(s)
        xy = project(poses.position_l, poses.angles, point_l[open_], np.full(len(s), c)).xy_mm
        g = xy[:, 0] - curve.at(xy[:, 1])[0]
        t[open_], y[open_] = s, xy[:, 1]
        crossed = g * gb < 0
        a, ga = np.where(crossed, b, a), np.where(crossed, gb, 0.5 * ga)
        b, gb = s, g
        keep = np.abs(g) >= TOLERANCE_MM
        a, b, ga, gb, open_ = a[keep], b[keep], ga[keep], gb[keep], open_[keep]
        if not len(open_):
            break
    return t, y
