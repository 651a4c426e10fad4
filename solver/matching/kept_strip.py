"""A strip whose lines and orientation are kept, to be matched with other strips."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .current_orientation import CurrentOrientation
from .line_intake import LineIntake
from .line_scan import LineScan, View
from .line_store import LineRing
from .line_times import LineTimes
from .places import PlaceChooser
from .round_earth import above_sphere, tilt
from .search import Image, TurnedImage

Array = NDArray[np.floating]

#: A satellite that turns holds the view on the ground back to this share of its own way at most; and the largest angle
#: from the way down for which the share is computed, rad. Bounds for what makes no sense.
LEAST_SHARE, LARGEST_TILT = 0.05, np.radians(75.0)


@dataclass(eq=False)
class KeptStrip:
    """A strip.

    Attributes
    ----------
    id : its name
    times : of its lines
    orientation : of all of its lines
    views : its CCD lines, by name
    over : whether its last line has come
    points : so many places of it have become points
    """

    id: str
    times: LineTimes
    orientation: CurrentOrientation = field(default_factory=lambda: CurrentOrientation(np.inf))
    views: dict[str, StripView] = field(default_factory=dict)
    over: bool = False
    points: int = 0

    @property
    def nbytes(self) -> int:
        """Of the lines that have come."""
        rings = [view.ring for view in self.views.values()]
        return sum((r.end - r.start) * r.nbytes // r.capacity for r in rings if r is not None)


@dataclass(eq=False)
class StripView:
    """What one CCD line has seen in a strip.

    Attributes
    ----------
    strip, view : the strip and the CCD line
    lines : those that have come
    chooser : chooses places in them
    first_line : number of the first that came
    chosen_to : places have been chosen before this line, or need not be
    """

    strip: KeptStrip
    view: View
    lines: LineIntake
    chooser: PlaceChooser
    first_line: int = 0
    chosen_to: float = -np.inf
    _whole: tuple[tuple[float, ...], LineScan | None] = ((), None)
    _share: tuple[tuple[float, ...], float] = ((), 1.0)

    @property
    def ring(self) -> LineRing | None:
        """Its lines; None before any has come."""
        return None if self.lines.store is None else self.lines.store.rings[self.view.ccd]

    @property
    def known(self) -> bool:
        """Whether there are lines and orientations."""
        return self.ring is not None and bool(np.isfinite(self.strip.orientation.end_s))

    @property
    def known_to(self) -> float:
        """Lines before this one have come and have their orientation."""
        ring, o = self.ring, self.strip.orientation
        return -np.inf if ring is None else min(ring.end, float(self.strip.times.line_of(o.end_s)))

    def scan(self, first: float, last: float) -> LineScan | None:
        """Some of its lines with their orientation, as far as there is one."""
        strip, o = self.strip, self.strip.orientation
        if not np.isfinite(o.end_s):
            return None
        low = max(int(np.floor(first)), int(np.ceil(strip.times.line_of(o.start_s))))
        high = min(int(np.ceil(last)), int(np.floor(strip.times.line_of(o.end_s))))
        if high - low < 4:
            return None
        position, R = o.at(strip.times.time_of(np.arange(low, high + 1)))
        return LineScan(self.view, low, position, R, self.ground_share)

    def whole(self, first: float = -np.inf) -> LineScan | None:
        """All of its lines; while the strip is taken, those from ``first`` on."""
        if self.ring is None:
            return None
        first = self.ring.start if self.strip.over else max(first, self.ring.start)
        of, scan = self._whole
        now = (*self._known, first, self.ring.end)
        if of != now:  # else another strip has asked for it
            scan = self.scan(first, self.ring.end)
            self._whole = now, scan
        return scan

    @property
    def ground_share(self) -> float:
        """Way of the middle pixel on the ground as a share of the platform's way, over the whole strip."""
        of, share = self._share
        if of != self._known:
            share = self._ground_share()
            self._share = self._known, share
        return share

    @property
    def _known(self) -> tuple[float, float]:
        """Tells orientations from those that were known earlier."""
        return self.strip.orientation.changes, self.strip.orientation.end_s

    def _ground_share(self) -> float:
        o = self.strip.orientation
        position, R = o.at([o.start_s, o.end_s])
        rays = R @ self.view.rays_c(np.array([0.5 * (self.view.pixels - 1)]))[0]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        tilt, above = self.tilt(), above_sphere(self.middle()[0])
        way = position + rays * above / np.cos(min(tilt, LARGEST_TILT))
        flown = float(np.linalg.norm(position[1] - position[0]))
        return max(float(np.linalg.norm(way[1] - way[0])) / flown, LEAST_SHARE) if flown else 1.0

    def middle(self) -> tuple[Array, Array]:
        """Perspective centre and direction (3,) of the middle pixel in the middle of the strip."""
        o = self.strip.orientation
        position, R = o.at([0.5 * (o.start_s + o.end_s)])
        ray = R[0] @ self.view.rays_c(np.array([0.5 * (self.view.pixels - 1)]))[0]
        return position[0], ray / np.linalg.norm(ray)

    def tilt(self) -> float:
        """Angle between its middle and the way down, rad."""
        return tilt(*self.middle())

    def image(self, scan: LineScan, travel: float) -> TurnedImage:
        """Its lines, for patches along any other strip; the platform's way from line to line is given."""
        assert self.ring is not None
        return TurnedImage(Image(scan, self.ring, travel * self.ground_share, self.lines.saturated), scan.way)
