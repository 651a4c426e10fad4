"""Where the looks of one strip at places of another one are to be expected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .ground_search import OVERLAP
from .kept_strip import StripView
from .line_scan import LineScan
from .options import MatchingOptions, Place
from .prediction import Prediction
from .round_earth import RoundHeights

Array = NDArray[np.floating]

#: No ground lies higher above the sphere, m, than the highest mountain, or nearer below the platform than this share of
#: the way down to the lowest.
HIGHEST_GROUND_M, LEAST_ABOVE = 9000.0, 0.1
#: Lines and samples of the corners and edges of a view, as shares.
_EDGE = np.array([0.0, 0.5, 1.0])


class PairPrediction(Prediction):
    """Where the looks of a view (number 1) at places of another one (number 0) are to be expected.

    Parameters
    ----------
    pair : the view in which places were chosen, and the one in which they are looked for
    late : which of the two was flown later
    options : see `MatchingOptions`
    heights : of the ground

    Attributes
    ----------
    whole : the lines of both, as `renew` last took them
    """

    def __init__(
        self, pair: tuple[StripView, StripView], late: int, options: MatchingOptions, heights: RoundHeights
    ) -> None:
        super().__init__([v.view for v in pair], 0, options)
        self._pair, self._late = pair, late
        strip = pair[0].strip
        self.orientation, self.heights = strip.orientation, heights
        self.times = strip.times
        self.whole: list[LineScan | None] = [None, None]
        self.height_and_travel()  # tells the heights whether the platform is in orbit

    def renew(self, first: float = -np.inf) -> None:
        """Take the lines that have come; of the later strip, while it is taken, those from ``first`` on."""
        self.whole = [v.whole(first if i == self._late else -np.inf) for i, v in enumerate(self._pair)]

    def height_and_travel(self) -> tuple[float, float]:
        height, travel = super().height_and_travel()
        return height, travel * self._pair[0].ground_share

    def scan(self, index: int, first: float, last: float) -> LineScan | None:
        return self._pair[index].scan(first, last)

    def look_lines(self, index: int, line: Array, point_l: Array) -> Array:
        whole = self.whole[index]
        return np.asarray(line, dtype=float) if whole is None else _located(whole, point_l)[0]

    def when(self, line: Array, point_l: Array) -> Array:
        """When the later strip saw places: looks are matched in this order."""
        if not self._late:
            return super().when(line, point_l)
        return self._pair[1].strip.times.time_of(self.look_lines(1, line, point_l))

    def beside(self, along_too: bool) -> list[Array]:
        """Shifts (2,) across the parallax, and along it too, px, at which a view is looked for: the nearest first, so
        that searches cover three sigma of the orientation."""
        here, there = self.whole
        assert here is not None and there is not None
        half = 0.5 * len(here.position_l)
        middle, _ = here.to_plane(
            np.array([here.first_line + half]), np.array([0.5 * (here.view.pixels - 1)]), np.array([self.nadir_m])
        )
        ground = self.ground(here, middle)
        a, b = (v.middle()[1] for v in self._pair)
        way = np.stack([ground.along, ground.across]) @ (a[:2] / a[2] - b[:2] / b[2])
        along = way / max(float(np.linalg.norm(way)), 1e-9)
        across = np.array([-along[1], along[0]])
        reach = self.options.largest_reach_px
        step = 2 * (1 - OVERLAP) * reach
        n = int(np.ceil(max(self._three_sigma_px() - reach, 0.0) / step))
        far = np.arange(-n, n + 1)
        steps = np.stack(np.meshgrid(far if along_too else np.zeros(1), far, indexing="ij"), axis=-1).reshape(-1, 2)
        nearest = steps[np.argsort(np.hypot(*steps.T), kind="stable")]
        return list(step * nearest @ np.stack([along, across]))

    def turn(self, index: int) -> Array:
        """See `Prediction`."""
        here, there = self.whole
        if index == 0 or here is None or there is None:
            return np.eye(2)
        a, b = here.way, there.way
        cosine, sine = a @ b, a[0] * b[1] - a[1] * b[0]
        return np.array([[cosine, sine], [-sine, cosine]])

    def angle(self, places: Sequence[Place]) -> float:
        """Angle at which the rays of both views meet on the ground, rad: the median of places; 0 where none is seen."""
        here, there = self.whole
        which = np.isfinite(self.seen(places)[:, 0])
        if here is None or there is None or not which.any():
            return 0.0
        line, sample = np.array([[p.line, p.sample] for p, sees in zip(places, which, strict=True) if sees]).T
        point, _ = here.to_plane(line, sample, np.full(len(line), self.heights.prior_m))
        other, _ = _located(there, point)
        rays = [point - s.position_l[np.clip(np.nan_to_num(at).astype(int) - s.first_line, 0, len(s.position_l) - 1)]
                for s, at in ((here, line), (there, other))]  # fmt: skip
        a, b = (ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays)
        return float(np.median(np.arcsin(np.clip(np.linalg.norm(np.cross(a, b), axis=1), 0.0, 1.0))))

    def tells_heights(self, places: Sequence[Place]) -> bool:
        """Whether rays of both views meet at such an angle that a pixel is less than what heights are known to before;
        those of a line that was flown twice do not."""
        return self._pixel_m <= self.angle(places) * self.heights.prior_sigma_m

    def seen(self, places: Sequence[Place]) -> Array:
        """Line and sample (n, 2) of the other view that see places, about; NaN where none does."""
        here, there = self.whole
        located = np.full((len(places), 2), np.nan)
        if here is None or there is None or not len(places):
            return located
        line, sample = np.array([[place.line, place.sample] for place in places]).T
        near = np.flatnonzero(self._near(here, there, line, sample))
        if not len(near):
            return located
        line, sample = line[near], sample[near]
        height = np.full(len(line), self.heights.prior_m)
        for _ in range(2):  # the ground falls away from the XY plane
            height, _ = self.heights.at(here.to_plane(line, sample, height)[0][:, :2])
        point, _ = here.to_plane(line, sample, height)
        u, v = _located(there, point)
        first, last = there.first_line, there.first_line + len(there.position_l)
        three_sigma, most = self._three_sigma_px(), self.options.largest_reach_px
        reach = max(three_sigma, most)
        sees = (u > first - reach) & (u < last + reach)
        if three_sigma <= most:
            sees &= (v > 0) & (v < there.view.pixels - 1)
        else:  # the view may lie beside where it is expected; with places that it cannot see too few are found
            sees &= self._beside_px(there, point, u, v) < three_sigma
        located[near[sees]] = np.column_stack([u, v])[sees]
        return located

    def _beside_px(self, there: LineScan, point_l: Array, line: Array, sample: Array) -> Array:
        """How far (n,) points (n, 3) lie beside the ends of the line, px; 0 between them. Samples are those of the
        nearest end there."""
        end, _ = there.to_plane(line, sample, point_l[:, 2])
        across = np.array([-there.way[1], there.way[0]])
        beside = np.abs((point_l - end)[:, :2] @ across) / self._pixel_m
        return np.where((sample > 0) & (sample < there.view.pixels - 1), 0.0, beside)

    def _near(self, here: LineScan, there: LineScan, line: Array, sample: Array) -> NDArray[np.bool_]:
        """Which places may lie in the lines of the other view; the others are far from them."""
        rows, columns = np.meshgrid(
            there.first_line + _EDGE * (len(there.position_l) - 1), _EDGE * (there.view.pixels - 1), indexing="ij"
        )
        (frame, swath), (at, _) = (
            self._flat(scan, u, v) for scan, u, v in ((there, rows.ravel(), columns.ravel()), (here, line, sample))
        )
        # the heights of places are not known here: a swath is left all around
        return np.asarray(((at > frame.min(axis=0) - swath) & (at < frame.max(axis=0) + swath)).all(axis=1))

    def _flat(self, scan: LineScan, line: Array, sample: Array) -> tuple[Array, float]:
        """XY (n, 2) of pixels on ground as high as it is thought to be, and the extent of the first line, m."""
        height = np.full(len(line), self.heights.prior_m)
        xy = scan.to_plane(line, sample, height)[0][:, :2]
        if self.heights.in_orbit:
            xy = scan.to_plane(line, sample, self.heights.level(xy, self.heights.prior_m))[0][:, :2]
        return xy, float(np.linalg.norm(np.ptp(xy[:3], axis=0)))

    def heights_tried(self, places: Sequence[Place]) -> Array:
        """Heights of the ground, the likeliest first; a search at one of them reaches to the next."""
        sine = np.sin(self.angle(places))
        step = 2 * (1 - OVERLAP) * self.options.largest_reach_px * self._pixel_m / max(float(sine), 1e-3)
        prior, low = self.heights.prior_m, min(self.heights.lowest_m, self.heights.prior_m)
        high = min(HIGHEST_GROUND_M, self.platform_m - LEAST_ABOVE * (self.platform_m - low))
        below, higher = (int(np.ceil(max(reach, 0.0) / step)) for reach in (prior - low, high - prior))
        steps = np.arange(-below, higher + 1)
        return prior + step * steps[np.argsort(np.abs(steps), kind="stable")]

    def _three_sigma_px(self) -> float:
        """How far a look may lie from where the orientations put it, px."""
        return self._orientation_reach(self.views[1], self._pixel_m)

    @property
    def _pixel_m(self) -> float:
        """Size of a pixel across on the ground, m, about."""
        return self.height_and_travel()[0] * self.views[0].pitch_mm / self.views[0].focal_length_mm


def _located(scan: LineScan, point_l: Array) -> tuple[Array, Array]:
    """Line and sample (n,) of points (n, 3), whatever line of a strip they are seen in."""
    middle = np.full(len(point_l), scan.first_line + 0.5 * len(scan.position_l))
    line, sample, _ = scan.locate(point_l, middle, rounds=10)
    return line, sample
