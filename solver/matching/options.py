"""How tie points are made, and what they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..ranges import check_ranges

Array = NDArray[np.floating]

#: What is added to the sigma of a match for what its residuals do not show, px, of simulated pixels: they average the
#: ground over their area, and nothing finer shows in them. Tuned: ties of simulated flights then have a NEES of 0.9.
SIMULATED_FLOOR_PX = 0.017
#: The same of real pixels, in which detail finer than themselves aliases, and which two looks see differently. Tuned:
#: two real pushbroom looks have a NEES of 1 (95 %: 0.02 to 0.06 px); `bench/real_pixels.py`.
REAL_FLOOR_PX = 0.04


@dataclass(frozen=True)
class MatchingOptions:
    """How tie points are made.

    Attributes
    ----------
    points_per_s : tie points that are wanted a second; more places are tried where matches fail
    window_rays : more rays than this an adjustment is not given to hold at once
    window_points : with fewer points than this in its window, it is given up to twice as many
    largest_sigma_px : places and matches that are measured worse are left out
    least_score : correlation coefficient of a match
    largest_closing_px : by which matching back may miss
    least_reach_px, largest_reach_px : of the search, before anything is known and at all
    relief_sigma_m : of the ground about its mean height, before anything is known
    image_sigma_px : what is added to the sigma of a match for what its residuals do not show: `SIMULATED_FLOOR_PX`, or
        for a flight folder `REAL_FLOOR_PX`
    least_rays : of a tie point
    budget_mb : megabytes (10^6 bytes) for image lines
    chips_mb : megabytes for patches of earlier strips, 0 for none: no ties from strip to strip
    full_scale : largest grey value; 0 for 255 of 8-bit images, else 4095, or 16383 or 65535 once there are larger ones

    Raises
    ------
    ValueError : a value that makes no sense
    """

    points_per_s: float = 8.0
    window_rays: float = 6000.0
    window_points: float = 60.0
    largest_sigma_px: float = 0.1
    least_score: float = 0.75
    largest_closing_px: float = 0.3
    least_reach_px: float = 40.0
    largest_reach_px: float = 80.0
    relief_sigma_m: float = 60.0
    image_sigma_px: float = SIMULATED_FLOOR_PX
    least_rays: int = 3
    budget_mb: float = 1024.0
    chips_mb: float = 64.0
    full_scale: int = 0

    def __post_init__(self) -> None:
        positive = "points_per_s", "window_rays", "largest_sigma_px", "least_reach_px", "budget_mb", "relief_sigma_m"
        check_ranges(self, positive, ("window_points", "chips_mb", "image_sigma_px"))
        if not self.least_reach_px <= self.largest_reach_px <= 80:
            raise ValueError(f"largest_reach_px: wanted {self.least_reach_px:g} to 80, got {self.largest_reach_px}")
        if not 0 <= self.least_score < 1:
            raise ValueError(f"least_score: wanted 0 to 1, got {self.least_score}")
        if self.least_rays < 2:
            raise ValueError(f"least_rays: wanted at least 2, got {self.least_rays}")


@dataclass(frozen=True)
class Place:
    """A place in the master view whose other looks are awaited.

    Attributes
    ----------
    line, sample : px
    name : of the point, if an earlier strip has it already
    variance : of line and sample, px^2, against the earlier strip; None for a place that was chosen freely
    """

    line: float
    sample: float
    name: str = ""
    variance: tuple[float, float] | None = None


@dataclass(frozen=True)
class MatchedRay:
    """One look at a tie point; px. ``strip`` where it is not the one whose lines are matched now."""

    ccd: str
    line: float
    sample: float
    sigma_line: float
    sigma_sample: float
    strip: str = ""


@dataclass(frozen=True)
class MatchedTie:
    """A tie point.

    Attributes
    ----------
    name : the strip it was first seen in and a number there
    rays : its looks in this strip, the master's first
    score : least correlation coefficient
    xyz_l : (3,) where it lies with the orientation of now
    prediction_px : largest distance of a look from where the orientation of now puts it
    again : whether it was known from an earlier strip
    """

    name: str
    rays: tuple[MatchedRay, ...]
    score: float
    xyz_l: Array
    prediction_px: float
    again: bool = False


def first_part_of_names(strip: str, first_line: int) -> str:
    """What names of the tie points of a strip begin with.

    A matcher that begins in mid-strip, because it or its camera is another one, does not give names again that the one
    before has given.
    """
    return strip if first_line <= 0 else f"{strip}-L{first_line}"
