"""An orthoimage that grows while lines and orientations come in: lines wait for the orientation they shall have."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.measured_trajectory import MeasuredTrajectory
from ..geometry.rotation import angles_from_matrix, matrix_from_angles, matrix_from_quaternion
from .ground_grid import GroundGrid
from .mosaic import Mosaic
from .strip import Rays, StripRectifier
from .surface import Surface

Array = NDArray[np.floating]

#: Refined orientation farther apart than this has a gap between, and reaches so far beyond its ends, s.
REACH_S = 1.0
#: Orientation older than this is forgotten once no line needs it, s.
KEPT_S = 60.0
#: Lines that are rectified at once.
BAND = 16
#: Cells a side of a tile.
TILE = 256


@dataclass(frozen=True)
class WaitingLines:
    """Lines without orientation yet; n lines."""

    strip: str
    first_line: int
    pixels: NDArray[np.unsignedinteger]
    time_s: Array


class GrowingOrthoimage:
    """Lines are rectified as soon as refined orientation covers them, or when they have waited long enough.

    Parameters
    ----------
    patience_s : lines older than this against the newest pose are rectified with what is known; infinity = they wait
    budget_bytes : waiting lines take no more; the oldest are rectified with what is known

    Attributes
    ----------
    mosaic : the orthoimage, None before the ground is known
    grid : its cells, None before the ground is known
    strip : the newest one
    newest_s : time of the newest line in it
    impatient : lines that were rectified without refined orientation of their time
    lost : lines without any orientation
    """

    def __init__(self, patience_s: float, budget_bytes: int) -> None:
        self._patience_s, self._budget = patience_s, budget_bytes
        self.mosaic: Mosaic | None = None
        self.newest_s = -np.inf
        self.impatient = self.lost = 0
        self._rays: Rays | None = None
        self.grid: GroundGrid | None = None
        self._surface: Surface | None = None
        self._measured = MeasuredTrajectory()
        self._skipped_s = -np.inf
        self._knots: list[tuple[float, Array]] = []
        self._unplaced: deque[tuple[float, Array, Array]] = deque()
        self._waiting: deque[WaitingLines] = deque()
        self._waiting_bytes = 0
        self.strip = ""
        self._rectifier: StripRectifier | None = None

    @property
    def measured(self) -> MeasuredTrajectory:
        return self._measured

    def set_ground(self, rays: Rays, grid: GroundGrid, surface: Surface) -> None:
        """What lines are rectified with from now on; rays (but for `set_rays`) and grid stay as they were first."""
        if self._rays is None:
            self._rays, self.grid = rays, grid
        self._surface = surface
        if self._rectifier is not None:
            self._rectifier.surface = surface

    def set_rays(self, rays: Rays) -> None:
        """Rays of the same pixels with another calibration, for lines that come from now on."""
        self._rays = rays
        if self._rectifier is not None:
            self._rectifier.rays = rays

    def look_with(self, rays: Rays) -> None:
        """Lines of another CCD line come from now on: what the one before has shown goes, poses and cells stay."""
        if self._rays is not None:
            self._rays = rays
        self.mosaic, self._rectifier, self.strip = None, None, ""
        self._waiting.clear()
        self._waiting_bytes = 0

    def add_pose(self, time_s: float, position_l: Array, quaternion: Array, covariance: Array, smoothed: bool) -> bool:
        """A measured pose; False for one that comes too late."""
        late = self._measured.add([time_s], position_l[None], quaternion[None], covariance[None], smoothed)
        return late == 0

    def skip_pose(self, time_s: float) -> None:
        """A measured pose that is not to be relied on: lines about it get no orientation, and wait for none."""
        self._skipped_s = max(self._skipped_s, time_s)

    def add_refined(self, time_s: float, position_l: Array, quaternion: Array) -> None:
        """A refined pose; one of the same or an earlier time takes the place of what was known from there on."""
        self._unplaced.append((time_s, position_l, quaternion))
        while self._unplaced and (self._unplaced[0][0] <= self._measured.end_s):
            t, position, q = self._unplaced.popleft()
            if not self._measured.covers(np.array([t]))[0]:
                continue
            measured = self._measured.at([t]).poses
            turn = angles_from_matrix(matrix_from_quaternion(q)) - measured.angles[0]
            added = np.concatenate([position - measured.position_l[0], (turn + np.pi) % (2 * np.pi) - np.pi])
            while self._knots and self._knots[-1][0] >= t:
                self._knots.pop()
            self._knots.append((t, added))

    def add_lines(self, lines: WaitingLines) -> None:
        """Lines of a strip, in order."""
        self._waiting.append(lines)
        self._waiting_bytes += lines.pixels.nbytes

    def work(self, everything: bool = False) -> None:
        """Rectify what can be; everything that waits, if nothing more will come."""
        if self._surface is None or self._rays is None or self.grid is None:
            return
        newest = max(self._measured.end_s, self._skipped_s)
        while self._waiting:
            lines = self._waiting[0]
            end = float(lines.time_s[-1])
            refined = bool(self._knots) and self._knots[-1][0] >= end
            waited = newest - end > self._patience_s or self._waiting_bytes > self._budget
            if not (refined or waited or everything):
                break
            if not everything and newest < end:
                break
            self._waiting.popleft()
            self._waiting_bytes -= lines.pixels.nbytes
            self._rectify(lines, self._rays, self.grid, self._surface)
        if everything and self._rectifier is not None:
            self._put(self._rectifier.finish())
            self._rectifier = None
        self._forget()

    def _rectify(self, lines: WaitingLines, rays: Rays, grid: GroundGrid, surface: Surface) -> None:
        if self.mosaic is None:
            self.mosaic = Mosaic(lines.pixels.dtype, TILE)
        if lines.strip != self.strip or self._rectifier is None:
            if self._rectifier is not None:
                self._put(self._rectifier.finish())
            self._rectifier = StripRectifier(rays, surface, grid, band=BAND)
            self.strip = lines.strip
        known = self._measured.covers(lines.time_s)
        self.lost += int((~known).sum())
        edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            t = lines.time_s[begin:end]
            poses = self._measured.at(t).poses
            position, angles = poses.position_l, poses.angles
            added, refined = self._added(t)
            self.impatient += int((~refined).sum())
            R = matrix_from_angles(*(angles + added[:, 3:]).T)
            first = lines.first_line + begin
            self._put(self._rectifier.add(first, lines.pixels[begin:end], None, position + added[:, :3], R))
            self.newest_s = max(self.newest_s, float(t[-1]))

    def _added(self, t: Array) -> tuple[Array, NDArray[np.bool_]]:
        """What refinement adds at times (n, 6), and whether it was told for them."""
        if not self._knots:
            return np.zeros((len(t), 6)), np.zeros(len(t), dtype=bool)
        times = np.array([time for time, _ in self._knots])
        values = np.array([value for _, value in self._knots])
        added = np.stack([np.interp(t, times, column) for column in values.T], axis=1)
        i = np.searchsorted(times, t)
        before, after = t - times[np.maximum(i - 1, 0)], times[np.minimum(i, len(times) - 1)] - t
        return added, np.minimum(np.abs(before), np.abs(after)) <= REACH_S

    def _put(self, patches: list) -> None:
        assert self.mosaic is not None
        for patch in patches:
            self.mosaic.add(patch)

    def _forget(self) -> None:
        needed = float(self._waiting[0].time_s[0]) if self._waiting else self._measured.end_s
        old = needed - KEPT_S
        if np.isfinite(old) and self._measured.start_s < old - KEPT_S:
            self._measured.forget(old)
            self._knots = [knot for knot in self._knots if knot[0] >= old]
