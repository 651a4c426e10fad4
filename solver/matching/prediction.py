"""Where the looks at a place are to be expected, and how far around: orientation, heights, and what matches showed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .consistency import SlowDisagreement
from .current_orientation import CurrentOrientation
from .line_scan import LineScan, View
from .line_times import LineTimes
from .options import MatchingOptions
from .round_earth import ORBIT_M, RoundHeights, above_sphere, way_of_platform
from .search import CORRELATION_HALF, REACH_PX, Ground, coarsest_factor

Array = NDArray[np.floating]

#: Lines around what is needed, for vibration and reduced levels.
PAD = 24
#: Lines of which the orientation is computed around a batch: the widest patch at the coarsest level.
WIDE = 7 * PAD
#: Least reach once neighbours tell where to look, px; it doubles while more than a share is found to lie beyond.
LEAST_REACH, MOST_BEYOND = 4.0, 0.25
#: The way from one line to the next is the mean over so many lines before now. Tuned.
TRAVEL_LINES = 20


class Prediction:
    """What is known of a strip's geometry so far.

    Parameters
    ----------
    views, master : the CCD lines, and which of them places are chosen in
    options : see `MatchingOptions`

    Attributes
    ----------
    nadir_m : height of the ground below the platform, as `height_and_travel` last took it
    """

    def __init__(self, views: Sequence[View], master: int, options: MatchingOptions):
        self.views, self.master = views, master
        self.others = [i for i in range(len(views)) if i != master]
        self.options = options
        self.orientation = CurrentOrientation()
        self.heights = RoundHeights(0.0, options.relief_sigma_m)
        self.slow = SlowDisagreement(len(self.others))
        self.times = LineTimes(0.0, 1.0)
        self._axes: tuple[Array, Array] | None = None
        self._told = (-np.inf, (1.0, 1.0))
        self.nadir_m = 0.0
        # of each view: least reach, and the widest search of late
        self._least, self._widest = np.full(len(views), LEAST_REACH), np.zeros(len(views))

    @property
    def rate(self) -> float:
        """Lines a second, about."""
        return self.times.rate

    def begin_strip(self, times: LineTimes) -> None:
        """Lines begin anew, with their times."""
        self.times = times
        self.slow.forget()
        self.orientation.forget_corrections()
        self._axes = None
        self._least[:] = LEAST_REACH
        self._told = (-np.inf, (1.0, 1.0))

    @property
    def known_lines(self) -> float:
        """Lines before this one have their orientation."""
        return float(self.times.line_of(self.orientation.end_s))

    @property
    def knows_travel(self) -> bool:
        """Whether poses reach back as far as `height_and_travel` looks."""
        return self.orientation.start_s <= self.orientation.end_s - TRAVEL_LINES / self.rate

    def height_and_travel(self) -> tuple[float, float]:
        """Height above ground, and way from one line to the next, now; m."""
        t = self.orientation.end_s
        if t == self._told[0]:
            return self._told[1]
        position, _ = self.orientation.at([t - 1.0 / self.rate * TRAVEL_LINES, t])
        above = above_sphere(position[1])
        self.heights.in_orbit = above > ORBIT_M
        if self.heights.in_orbit:  # the relief is small against it
            self.nadir_m = float(position[1, 2]) - above
        else:
            self.nadir_m = float(self.heights.at(position[1:, :2])[0][0])
        height = float(position[1, 2]) - self.nadir_m
        self._told = t, (max(height, 1.0), max(float(np.linalg.norm(position[1] - position[0])) / TRAVEL_LINES, 1e-6))
        return self._told[1]

    @property
    def platform_m(self) -> float:
        """Height of the platform now, local frame."""
        above, _ = self.height_and_travel()
        return above + self.nadir_m

    def heights_changed(self) -> None:
        """What was taken for the height of the ground holds no more."""
        self._told = (-np.inf, self._told[1])

    def lines_later(self, index: int, height_m: Array) -> Array:
        """How many lines, at the rate, after the master a view sees ground at heights (k,), about; local frame, m."""
        above, travel = self.height_and_travel()
        if self.heights.in_orbit:
            ways = [way_of_platform(self.views[i].forward, above) for i in (self.master, index)]
            return np.full(len(height_m), (ways[0] - ways[1]) / travel)
        forward = self.views[self.master].forward - self.views[index].forward
        return forward * (above + self.nadir_m - height_m) / travel

    def look_lines(self, index: int, line: Array, point_l: Array) -> Array:
        """Lines (k,) of a view that see ground (k, 3), seen in lines (k,) of the master, about."""
        later = self.lines_later(index, point_l[:, 2])
        if self.times.is_constant:
            return np.asarray(line + later)
        return self.times.line_of(self.times.time_of(line) + later / self.rate)

    def when(self, line: Array, point_l: Array) -> Array:
        """Times (k,) of looks, s: of ground (k, 3), seen in lines (k,) of the master. Slow errors change with it."""
        return self.times.time_of(line)

    def scan(self, index: int, first: float, last: float) -> LineScan | None:
        """Lines of a view with their orientation, as far as there is one."""
        o = self.orientation
        low = max(int(np.floor(first)), int(np.ceil(self.times.line_of(o.start_s))) + 1)
        high = min(int(np.ceil(last)), int(np.floor(self.known_lines)) - 1)
        if high - low < 4:
            return None
        position, R = o.at(self.times.time_of(np.arange(low, high + 1)))
        return LineScan(self.views[index], low, position, R)

    def ground(self, scan: LineScan, centre_l: Array) -> Ground:
        """Grids about places (k, 3); all of a strip have the same directions."""
        if self._axes is None:
            along = scan.way
            left = np.array([-along[1], along[0]])
            sample = self.views[self.master].sample
            self._axes = along, left if sample[0] < sample[-1] else -left
        spacing = sample_m(scan, centre_l, np.full(len(centre_l), scan.first_line + len(scan.position_l) // 2))
        return Ground(centre_l, *self._axes, spacing)

    def turn(self, index: int) -> Array:
        """(2, 2) from the axes of the grids on the ground, along and across, to those of a view's lines."""
        return np.eye(2)

    def reach(self, index: int, ground: Ground, sigma_height: Array, parallax: Array) -> float:
        """Three sigma of the prediction in px: orientation of both looks, height, and what the past has shown."""
        o = self.options
        by_height = float((sigma_height * np.abs(parallax).max(axis=1)).max())
        by_orientation = self.sigma_px(index, ground.spacing_m)
        least = float(self._least[index]) if self.slow.known else o.least_reach_px
        reach = float(np.clip(3 * np.hypot(by_height, by_orientation), least, o.largest_reach_px))
        self._widest[index] = max(reach, 0.9 * self._widest[index])
        return reach

    def sigma_px(self, index: int, pixel_m: float) -> float:
        """How far a view lies from where it is expected with the right height, px."""
        if not self.slow.known:
            return self._orientation_reach(self.views[index], pixel_m) / 3
        scale = self.slow.scale_px[self.others.index(index)]
        return float(np.max(np.where(np.isfinite(scale), scale, self.options.least_reach_px / 3)))

    def searched(self, index: int, beyond: float) -> None:
        """A share of the last matches in a view was found to lie beyond the search."""
        wider = 2 * self._least[index] if beyond > MOST_BEYOND else self._least[index] / 1.4
        self._least[index] = np.clip(wider, LEAST_REACH, self.options.least_reach_px)

    def lines_around(self, index: int) -> float:
        """Lines that a search in a view may need around the predicted ones."""
        if self.slow.known:
            factor = coarsest_factor(float(max(self._widest[index], self._least[index])))
            return float((CORRELATION_HALF + REACH_PX + 2) * factor)
        _, travel = self.height_and_travel()
        reach = self._orientation_reach(self.views[index], travel)
        base = abs(self.views[index].forward) * 3 * self.options.relief_sigma_m / travel
        most = self.options.largest_reach_px
        factor = coarsest_factor(float(np.clip(np.hypot(reach, base), self.options.least_reach_px, most)))
        return float((CORRELATION_HALF + REACH_PX + 2) * factor)

    def _orientation_reach(self, view: View, pixel_m: float) -> float:
        """Three sigma, px, by which the orientation of two looks may be wrong."""
        sigma = np.sqrt(np.diagonal(self.orientation.covariance(self.orientation.end_s)))
        look = np.hypot(sigma[:3].max(), self.height_and_travel()[0] * sigma[3:].max() * (1 + view.forward**2))
        return float(3 * np.sqrt(2.0) * look / pixel_m)


def sample_m(scan: LineScan, point_l: Array, line: Array) -> float:
    """Size of a pixel across, m, on the ground at points (n, 3) that are seen in lines (n,)."""
    i = np.clip(np.nan_to_num(line) - scan.first_line, 0, len(scan.position_l) - 1).astype(int)
    depth = np.median(scan.position_l[i, 2] - point_l[:, 2])
    return float(depth * scan.view.pitch_mm / scan.view.focal_length_mm)
