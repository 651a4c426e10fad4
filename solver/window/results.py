"""What the window takes and gives: settings, looks, refined orientation, points, reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..adjustment.reliability import CRITICAL_W
from ..arrays import Array
from ..models import MODELS

#: Whose datum can be published.
DATUMS = ("control", "gnss")


class DivergedError(ArithmeticError):
    """The solution of the window has left what is plausible, and does not come back to it: a window begins anew."""


@dataclass(frozen=True)
class WindowOptions:
    """Settings of the sliding window.

    Attributes
    ----------
    model : trajectory model: "wander" (see `models.wander`), "dgr", "ppm", "lim"
    segment_s : longest segment (distance of fixes for "lim"); 0 = a fifteenth of the correlation time
    window_s : length; 0 = `window_looks` times the time between the first and the last look at a point, or that of
        cameras whose views are not apart (see `screening.arriving`)
    window_looks : see there
    grid_hz : rate of the published orientation
    settle_s : so long after the end of a strip late tie points are waited for; then the strip is final, if smoothed
        poses have come to its end
    critical : of Baarda's |w|
    snoop : whether observations are tested at all
    determine : whether it is tested which additional parameters the network can see by now; else all are estimated
    retest : batches tested again per update, besides new ones
    datum : whose datum is published where control that agrees with itself and GNSS differ: "control" or "gnss"
    alert_limit_m : what an error on the ground must stay below for the operator's light to be good; 0 = so many ground
        sample distances (see `ground`)
    """

    model: str = "wander"
    segment_s: float = 0.0
    window_s: float = 0.0
    window_looks: float = 1.5
    grid_hz: float = 20.0
    settle_s: float = 3.0
    critical: float = CRITICAL_W
    snoop: bool = True
    determine: bool = True
    retest: int = 4
    datum: str = "control"
    alert_limit_m: float = 0.0

    @property
    def follows_wander(self) -> bool:
        """Whether the model has a place for what wanders."""
        return self.model != "dgr"

    def grid(self, from_s: float, to_s: float) -> Array:
        """Times of the published orientation in [from, to)."""
        first, end = np.ceil(np.array([from_s, to_s]) * self.grid_hz - 1e-6)
        return np.arange(first, end) / self.grid_hz

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"unknown trajectory model {self.model!r}; known: {', '.join(MODELS)}")
        if self.datum not in DATUMS:
            raise ValueError(f"datum: {self.datum!r} is not known, wanted one of {', '.join(DATUMS)}")
        for name in ("segment_s", "window_s", "settle_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: wanted seconds not below 0, got {getattr(self, name)}")
        if not 0 <= self.alert_limit_m < float("inf"):
            raise ValueError(f"alert_limit_m: wanted metres, or 0 for the default, got {self.alert_limit_m}")
        for name in ("window_looks", "grid_hz", "critical"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: wanted more than 0, got {getattr(self, name)}")


@dataclass(slots=True, unsafe_hash=True)  # frozen ones take four times as long to make
class Look:
    """One image measurement of a point: strip and CCD line by name, line and sample in pixels with their sigmas.
    Nobody changes one.

    ``source`` is who measured it; the same measurement from two is one. ``time_s`` is when its line was imaged, NaN
    where that is as the rate of its strip says.
    """

    strip: str
    ccd: str
    line: float
    sample: float
    sigma_line_px: float
    sigma_sample_px: float
    source: str = field(default="", compare=False)
    time_s: float = field(default=float("nan"), compare=False)


#: Reason of a "refusal" that is the opposite: what was refused before is used again.
TAKEN_BACK = "taken back"
#: Reason why a known coordinate does not count.
CONTRADICTS = "contradicts"
#: In place of a look where it is a known coordinate that is refused.
NO_LOOK = Look("", "", 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Refusal:
    """A measurement that was not used, and why (or that is `TAKEN_BACK`); ``w`` is 0 where no test decided.

    Where it is a known coordinate there is no look: ``coordinate`` is X, Y or Z, and ``off_m`` by how much it is off.
    """

    point: str
    look: Look
    reason: str
    w: float = 0.0
    coordinate: str = ""
    off_m: float = 0.0


@dataclass(frozen=True)
class RefinedOrientation:
    """Refined exterior orientation at n times.

    Attributes
    ----------
    strip : whose model it comes from
    time_s : (n,)
    position_l, angles : (n, 3) m; omega, phi, kappa in rad
    covariance : (n, 6, 6) of correction and measurement noise together
    correction : (n, 6) added to the measured orientation
    protection : (n, 6) protection levels, see `quality.exposure`; None where they are not known
    """

    strip: str
    time_s: Array
    position_l: Array
    angles: Array
    covariance: Array
    correction: Array
    protection: Array | None = None


class RayResidual(NamedTuple):
    """Residual of one look, measured minus computed, px; ``w`` is the larger normalised one."""

    look: Look
    v_line: float
    v_sample: float
    w: float
    rejected: bool


class AdjustedPoint(NamedTuple):
    """An object point as it came out.

    Attributes
    ----------
    name, role : role is tie, control, planimetric, height or check
    xyz_l, covariance : (3,) m, (3, 3) m^2
    rays : looks that take part
    final : whether it has left the window
    whole : whether it has the information of whole strips, from the backward pass
    residuals : of all its looks
    checked : what a gross error in one of its rays would meet: "all" of them are checked by others; "across": two
        rays, so that an error along the base goes into the height unseen; "doubtful": half of the rays are left out, or
        strips contradict each other
    """

    name: str
    role: str
    xyz_l: Array
    covariance: Array
    rays: int
    final: bool
    residuals: tuple[RayResidual, ...]
    checked: str = "all"
    whole: bool = False


class Parameter(NamedTuple):
    """A parameter of the present strip or of the camera; status "estimated" or "not yet determined", and why.

    ``correlation`` is the strongest one with another of these parameters, ``partner`` that one's name.
    """

    name: str
    unit: str
    value: float
    sigma: float
    status: str = "estimated"
    reason: str = ""
    correlation: float = 0.0
    partner: str = ""

    @property
    def t(self) -> float:
        return self.value / self.sigma if self.sigma > 0 else 0.0


@dataclass(frozen=True)
class WholeStrips:
    """Orientation and points with the information of whole strips, from the backward pass after their end."""

    orientation: list[RefinedOrientation]
    points: list[AdjustedPoint]


@dataclass
class Update:
    """An update: when it is, and what its phases have to tell.

    Attributes
    ----------
    now_s, number : platform time, and how many there were
    final, points : orientation and points that have left the window, and points that have come
    whole : when strips have ended
    refused : looks and known coordinates left out, and those that count again
    events, warnings : for the operator
    alone : points that do not agree with what earlier strips say of them, not told yet
    """

    now_s: float
    number: int
    final: list[RefinedOrientation] = field(default_factory=list)
    points: list[AdjustedPoint] = field(default_factory=list)
    whole: WholeStrips | None = None
    refused: list[Refusal] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    alone: list[str] = field(default_factory=list)

    def tell_alone(self) -> None:
        """Put into words which points do not agree with earlier strips."""
        if self.alone:
            self.events.append(f"do not agree with earlier strips: {', '.join(self.alone)}")
            self.alone = []


def checks(rays: int, looks: int, known: bool) -> str:
    """What `AdjustedPoint.checked` is for a point of so many looks of which so many take part."""
    if 2 * rays <= looks and looks > 2:
        return "doubtful"
    return "all" if rays > 2 or known else "across"
