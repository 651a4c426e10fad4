"""What an on-line navigator keeps until it is aligned, and its watch over GNSS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .alignment import AlignmentError, AttitudePrior, align
from .error_state import NavigationSettings, Start
from .gnss_fix import stacked
from .inertial_checks import check
from .inertial_data import GnssData, InertialData, concatenate
from .online_poses import OnlineOptions

Fixes = list[tuple[float, GnssData]]

#: Data that cannot be aligned are looked through for a cause when they are so long, s, and again at twice that.
_CHECK_S = 60.0
#: Without a fix for so long, s, or so many times the usual interval, GNSS is out.
_OUTAGE_S, _OUTAGE_INTERVALS = 3.0, 5.0
#: The usual interval, s, as long as there is one fix only.
_UNKNOWN_INTERVAL_S = 2.0


@dataclass(frozen=True)
class Aligned:
    """An alignment, the data to navigate from its start to the present, and what was seen in them.

    Attributes
    ----------
    start : of the filter
    raw : inertial data from there
    fixes, ahead : fixes up to the newest inertial sample, and later ones
    seen_s : length of the data that were needed
    remarks : what is wrong with the data (see `inertial_checks`)
    """

    start: Start
    raw: InertialData
    fixes: Fixes
    ahead: Fixes
    seen_s: float
    remarks: list[str]


class AlignmentBuffer:
    """Inertial data and fixes of a navigator that is not aligned.

    Parameters
    ----------
    settings : sensors and treatment
    options : how long to wait for what
    prior : attitude at the first sample, where known

    Attributes
    ----------
    fixes : with their times, in order
    status : why there is no alignment yet
    """

    def __init__(self, settings: NavigationSettings, options: OnlineOptions, prior: AttitudePrior | None):
        self.settings, self.options = settings, options
        self.fixes: Fixes = []
        self.status = "aligning"
        self._prior = prior
        self._raw: list[InertialData] = []
        self._next_try = -np.inf
        self._next_check_s = _CHECK_S
        self._said: set[str] = set()

    def append(self, raw: InertialData) -> None:
        """Inertial data that follow."""
        self._raw.append(raw)

    def add_fix(self, time_s: float, fix: GnssData) -> bool:
        """A fix, in any order; whether it is new."""
        if any(abs(time_s - t) < 1e-6 for t, _ in self.fixes):
            return False
        self.fixes.append((time_s, fix))
        self.fixes.sort(key=lambda f: f[0])
        return True

    def attempt(self, now_s: float) -> tuple[Aligned | None, list[str]]:
        """Align, if it is time for it, with inertial data up to now; an alignment or None, and new remarks."""
        o = self.options
        if not self._raw:
            return None, []
        while len(self._raw) > 1 and now_s - self._raw[0].time_s[0] > o.longest_alignment_s:
            self._raw.pop(0)
            self._prior = None  # it was for the first sample
        start = float(self._raw[0].time_s[0] - self._raw[0].dt_s[0])
        self.fixes = [f for f in self.fixes if f[0] >= start]
        if len(self.fixes) < 4 or now_s - self.fixes[0][0] < 4.0 or now_s < self._next_try:
            return None, []
        self._next_try = now_s + max(1.0, 0.25 * (now_s - self.fixes[0][0]))
        raw = concatenate(self._raw)
        covered = [f for f in self.fixes if f[0] <= now_s]
        gnss = stacked([f for _, f in covered])
        seen = float(gnss.time_s[-1] - start)
        try:
            patience = o.patience_s if seen >= o.patience_s else np.inf
            found = align(raw, gnss, self.settings, start_s=start, prior=self._prior, patience_s=patience)
        except AlignmentError as error:
            self.status = f"aligning: {error}"
            if seen < self._next_check_s:
                return None, []
            self._next_check_s = 2.0 * seen
            return None, self._remarks(raw, gnss)
        ahead = [f for f in self.fixes if f[0] > now_s]
        return Aligned(found, raw, covered, ahead, seen, self._remarks(raw, gnss)), []

    def _remarks(self, raw: InertialData, gnss: GnssData) -> list[str]:
        """What is wrong with the data, said once."""
        found = [f"{f.subject}: {f.text}" for f in check(raw, gnss, self.settings, increments=False)]
        new = [text for text in found if text not in self._said]
        self._said.update(new)
        return new


class GnssWatch:
    """Tells when fixes fail to come, and when they are back."""

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._usual_s = _UNKNOWN_INTERVAL_S
        self._out = False

    def fix(self, time_s: float) -> str:
        """A fix has come; what is to be said of it."""
        before, self._last_s = self._last_s, max(time_s, self._last_s or -np.inf)
        if before is None or time_s <= before:
            return ""
        was_out, self._out = self._out, False
        self._usual_s = min(max(time_s - before, 0.5 * self._usual_s), 2.0 * self._usual_s)
        return f"GNSS is back after {time_s - before:.1f} s" if was_out else ""

    def inertial(self, time_s: float) -> str:
        """An inertial sample has come; what is to be said of GNSS."""
        if self._last_s is None or self._out:
            return ""
        if time_s - self._last_s <= max(_OUTAGE_S, _OUTAGE_INTERVALS * self._usual_s):
            return ""
        self._out = True
        return f"no GNSS for {time_s - self._last_s:.1f} s"
