"""The operator's light: good, weak or failed, and why, in words.

It is good where an error of the orientation on the ground stays below the alert limit though one observation may be
wrong unseen: where the protection levels do (`integrity`, `ground`). More tie points and more control make
them smaller, so that they never make the light worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ground import WHERE
from .integrity import Exposure
from .suspects import BiasedSource

Array = NDArray[np.floating]

GOOD, WEAK, FAILED = "good", "weak", "failed"

#: sigma0 over the window above which observations and a-priori sigmas contradict each other, and the redundancy needed.
CONTRADICTION, ENOUGH = 1.5, 30
#: Share of the points in the window of which nothing is left that says the same, and the points needed.
MOSTLY_REFUSED, ENOUGH_POINTS = 0.5, 20
#: Sigma of the position, in units of what was known beforehand, below which earlier control holds the datum.
HELD = 0.5
#: Object points seen twice that the window must have: as many as a relative orientation of two frames.
LEAST_POINTS = 6
#: So many sigmas beyond the alert limit: then it is not an unseen error that makes the light weak.
EVERYDAY = 3.29


@dataclass(frozen=True)
class Situation:
    """What the light looks at.

    Attributes
    ----------
    flying : whether a strip is in the window
    length_s : of the window
    since_s : how long the strip is being flown
    sigma0, redundancy : over the window
    points, refused : object points in the window, and those of which nothing is left
    control_refused : control points of which nothing is left
    control : (3,) known X, Y and Z coordinates in the window
    apriori_m : (3,) sigma of X, Y and Z before any observation
    exposure : of the newest orientation, None without
    sources : those that drift
    control_doubt : what control contradicts, itself or the GNSS, in words; "" where it does not
    control_failed : whether by so much that no sigma can be relied on
    strip : that is flown
    tied : object points of which two rays are left, at least
    ground_m, ground_sigma_m : (4,) protection levels and sigmas on the ground, see `ground`; None as they are not known
    limit_m : alert limit of the protection levels
    """

    flying: bool
    length_s: float
    since_s: float
    sigma0: float
    redundancy: int
    points: int
    refused: int
    control_refused: int
    control: Array
    apriori_m: Array
    exposure: Exposure | None
    sources: tuple[BiasedSource, ...]
    control_doubt: str = ""
    control_failed: bool = False
    strip: str = ""
    tied: int = LEAST_POINTS
    ground_m: Array | None = None
    ground_sigma_m: Array | None = None
    limit_m: float = np.inf


def light(s: Situation) -> tuple[str, str]:
    """Colour and reason; the reason may say something where the light is good too."""
    if not s.flying:
        return GOOD, "no strip is flown"
    return contradiction(s) or _tie_points(s) or _datum(s)


def contradiction(s: Situation) -> tuple[str, str] | None:
    """What contradicts what, None if nothing does: it casts doubt on all of the strip, not on the present alone."""
    if s.redundancy >= ENOUGH and s.sigma0 > CONTRADICTION:
        return FAILED, f"observations contradict each other: sigma0 {s.sigma0:.1f}"
    if s.points >= ENOUGH_POINTS and s.refused > MOSTLY_REFUSED * s.points:
        return FAILED, f"{s.refused} of {s.points} tie points contradict the others"
    # looks that drift contradict control: that is no more than has been said
    if not s.sources and s.control_refused >= max(2, int(s.control.max())):
        return FAILED, f"{s.control_refused} control points contradict the orientation"
    doubts = [s.control_doubt] if s.control_doubt else []
    if doubts or s.sources:
        return FAILED if s.control_failed else WEAK, "; ".join([*doubts, *map(str, s.sources)])
    return None


def _tie_points(s: Situation) -> tuple[str, str] | None:
    within = f"within {s.length_s:.0f} s"
    if s.points - s.refused == 0:
        if s.since_s < s.length_s or not s.length_s:
            return WEAK, "no tie points yet: the orientation is the measured one"
        return WEAK, f"no tie points {within}: the orientation is the measured one"
    if s.tied < LEAST_POINTS:
        return WEAK, f"too few tie points {within}: {s.tied} are seen twice, wanted {LEAST_POINTS}"
    return None


def datum_on_gnss(s: Situation) -> str:
    """What of the datum no control says, now or earlier; "" if all is said."""
    held = _held(s)
    if held.all():
        return ""
    known = s.control > 0
    missing = "no control"
    if known.any():
        missing = "no height control" if known[:2].all() else "no planimetric control"
    rests = {(False, False): "position and height datum rest", (False, True): "position datum rests"}.get(
        (bool(held[:2].all()), bool(held[2])), "height datum rests"
    )
    return f"{missing} {_within(s)}; {rests} on GNSS"


def _held(s: Situation) -> NDArray[np.bool_]:
    sigma = np.full(3, np.inf) if s.exposure is None else s.exposure.sigma[:3]
    return (s.control > 0) | (sigma < HELD * s.apriori_m)


def _within(s: Situation) -> str:
    return f"within {min(s.length_s, max(s.since_s, 1.0)):.0f} s"


def _datum(s: Situation) -> tuple[str, str]:
    on_gnss = datum_on_gnss(s)
    if on_gnss:
        return WEAK, on_gnss
    if s.ground_m is None or not (s.ground_m <= s.limit_m).all():
        return WEAK, _exposed(s)
    return GOOD, "" if (s.control > 0).any() else f"no control {_within(s)}; earlier control holds the datum"


def _exposed(s: Situation) -> str:
    """Why the protection levels are beyond the alert limit."""
    if s.ground_m is None or np.isnan(s.ground_m).any():
        return "how far the orientation may be off is not known yet"
    worst = int(np.argmax(s.ground_m))
    level, limit = metres(float(s.ground_m[worst])), metres(s.limit_m)
    against = f"limit {limit}" if level != limit else "just beyond the limit"
    off = f"{WHERE[worst]} up to {level} off unseen, {against}"
    e = s.exposure
    if e is not None and e.control:
        if len(e.names) > 1:
            rests, one = ", ".join(e.names[:-1]) + " and " + e.names[-1], "one of them"
        else:
            axis, _, name = e.observation.partition(" of control point ")
            rests, one = f"{name} alone", f"its {axis}"
        error = metres(e.detectable_m)
        return f"the datum rests on {rests}: an error of {error} in {one} would not be seen ({off})"
    if s.ground_sigma_m is not None and EVERYDAY * s.ground_sigma_m[worst] > s.limit_m:
        return f"{WHERE[worst]} known to {metres(float(s.ground_sigma_m[worst]))}, 1 sigma ({off})"
    if e is not None and e.observation:
        return f"an error in the {e.observation} would not be seen ({off})"
    return f"too few tie points check each other ({off})"


def metres(value: float) -> str:
    """Two figures: of a protection level more would not be true."""
    return f"{value:.0f} m" if value >= 9.95 else f"{value:.1f} m" if value >= 0.095 else f"{value:.2f} m"
