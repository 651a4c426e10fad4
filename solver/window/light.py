"""The operator's light: good, weak or failed, and why, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .integrity import Exposure
from .sources import BiasedSource

Array = NDArray[np.floating]

GOOD, WEAK, FAILED = "good", "weak", "failed"

#: sigma0 over the window above which observations and a-priori sigmas contradict each other, and the redundancy needed.
CONTRADICTION, ENOUGH = 1.5, 30
#: Share of the points in the window of which nothing is left that says the same, and the points needed.
MOSTLY_REFUSED, ENOUGH_POINTS = 0.5, 20
#: Sigma of the position, in units of what was known beforehand, below which earlier control holds the datum.
HELD = 0.5
#: A gross error in one control coordinate matters if it moves the position by so many sigmas unseen.
EXPOSED = 8.0


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


def light(s: Situation) -> tuple[str, str]:
    """Colour and reason; the reason may say something where the light is good too."""
    if not s.flying:
        return GOOD, "no strip is flown"
    if s.redundancy >= ENOUGH and s.sigma0 > CONTRADICTION:
        return FAILED, f"observations contradict each other: sigma0 {s.sigma0:.1f}"
    if s.points >= ENOUGH_POINTS and s.refused > MOSTLY_REFUSED * s.points:
        return FAILED, f"{s.refused} of {s.points} tie points contradict the others"
    if s.control_refused >= max(2, int(s.control.max())):
        return FAILED, f"{s.control_refused} control points contradict the orientation"
    if s.control_doubt:
        return FAILED if s.control_failed else WEAK, s.control_doubt
    if s.points - s.refused == 0:
        if s.since_s < s.length_s or not s.length_s:
            return WEAK, "no tie points yet: the orientation is the measured one"
        return WEAK, f"no tie points within {s.length_s:.0f} s: the orientation is the measured one"
    if s.sources:
        return WEAK, "; ".join(map(str, s.sources))
    return _datum(s)


def _datum(s: Situation) -> tuple[str, str]:
    known = s.control > 0
    sigma = np.full(3, np.inf) if s.exposure is None else s.exposure.sigma[:3]
    held = known | (sigma < HELD * s.apriori_m)
    within = f"no control within {min(s.length_s, max(s.since_s, 1.0)):.0f} s"
    if not held.all():
        partly = "no height control" if known[:2].all() else "no planimetric control"
        missing = partly if known.any() else "no control"
        rests = {(False, False): "position and height datum rest", (False, True): "position datum rests"}.get(
            (bool(held[:2].all()), bool(held[2])), "height datum rests"
        )
        return WEAK, f"{within.replace('no control', missing)}; {rests} on GNSS"
    e = s.exposure
    if e is not None and e.control:
        effect = float(np.max(e.bias[:3] / np.maximum(e.sigma[:3], 1e-9)))
        if effect > EXPOSED:
            return (
                WEAK,
                f"the datum rests on {e.observation}: an error of {e.detectable_m:.2g} m in it would not be seen",
            )
    return GOOD, "" if known.any() else f"{within}; earlier control holds the datum"
