"""The operator's light: good, weak or failed, and why, in words.

It is good where an error of the orientation on the ground stays below the alert limit though one observation may be
wrong unseen: where the protection levels do (`exposure`, `ground`). More tie points and more control make these
smaller, so that they never make the light worse.

What is shown has a memory (`LightDisplay`). It goes to a worse colour at once, and to a better one when that has held
for a while; words of the same colour stay for a while, so that it does not chatter. When a strip is over it says what
became of the strip as a whole, until the next one begins.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field, replace

import numpy as np

from ...adjustment.drift_hypotheses import BiasedSource, Group
from ...adjustment.reliability import CRITICAL_W, HEAVY_TAILS, MISMATCHES
from ...arrays import Array
from ...models.base import ERROR_GROUPS
from ...quantiles import chi2
from .camera_check import CameraDoubt
from .determinability import Standing
from .exposure import Exposure
from .ground import WHERE

GOOD, WEAK, FAILED = "good", "weak", "failed"

#: sigma0 over the window above which observations and a-priori sigmas contradict each other, if it is beyond its
#: chi-square limit of this probability, which alone makes the light weak (tuned); and the redundancy needed to say so.
CONTRADICTION, BY_CHANCE, CONTRADICTION_REDUNDANCY = 1.5, 1e-6, 30
#: Looks that disagree by so much more than all sigmas allow, and errors of the trajectory that are so many times as
#: large as stated, make the light weak (tuned).
DISAGREE, DOUBTED = 1.3, 2.0
#: So do errors of the camera that are so many times as large as a calibration leaves them: a pixel, about (tuned).
BADLY_CALIBRATED = 10.0
#: Share of the points in the window without a ray left that says the same, and the points needed to say so (tuned).
MOSTLY_REFUSED, ENOUGH_POINTS = 0.5, 20
#: Sigma of the position, in units of the a-priori one, below which earlier control holds the datum (tuned).
DATUM_HELD = 0.5
#: Object points with two rays that the window must have: as many as a relative orientation of two frames.
LEAST_POINTS = 6
#: Share of looks that come too late above which that is why there are few: of three views one is (tuned).
MANY_LATE = 0.3


@dataclass(frozen=True)
class Fit:
    """How well observations and a-priori sigmas agree: over about the length of the window, and since the start.

    Attributes
    ----------
    sigma0, redundancy, sigma0_total, redundancy_total : sigma0 is 1 a priori, NaN without redundancy
    """

    sigma0: float
    redundancy: int
    sigma0_total: float
    redundancy_total: int


@dataclass(frozen=True, kw_only=True)
class QualityFindings:
    """What an update found of the quality of the orientation, and the light that follows from it.

    Attributes
    ----------
    strip : that is flown, "" for none
    length_s, since_s : length of the window, and how long the strip has been flown
    fit : of the observations to their sigmas
    points, refused, tied : object points in the window, those without a ray left, and those with two or more
    free : of the latter those that are no ground points with given coordinates; None: not known
    late : share of the strip's looks that came when the window had passed them
    control, control_refused : (3,) X, Y and Z coordinates of control in use; control points without a ray left
    control_doubt, control_failed : what control contradicts, itself or the GNSS, and what the surface that points lie
        on does, in words, "" where they do not; and whether control does by so much that no sigma can be relied on
    apriori_m : (3,) sigma of X, Y and Z before any observation
    sources : of tie points, those that drift
    time_s, exposure : newest time, and what could be wrong unseen there; None without tie points
    sigma, protection : (6,) of the newest orientation, m and rad; zero without tie points
    ground_sigma_m, ground_protection_m : (4,) of the same on the ground, see `ground`; none where it is not known
    alert_limit_m : what protection levels on the ground stay below if the light is good; inf before the ground is seen
    standing : of the additional parameters
    failing, narrowly : share of looks that fail, and of those that fail narrowly, see `Tails`
    disagreement, trajectory : see `SigmaFactors`; the latter of offset, of shift and drift, and of the wander of
        position: that of the attitude shows in the images, and its sigma is what these say
    attitude_at_most_s : see `SigmaFactors`. A shorter time than stated makes the light weak: it is found where looks
        contradict what is stated, and then the position may be what is worse, too
    camera : in what it is not as calibrated, see `CameraCheck`; None where nothing says so
    calibration : how many times as large its errors are as stated, see `LiveCalibration`
    light, reason : that are shown, see `LightDisplay`
    events : for the operator
    held_by : what holds the datum where no control is in the window
    """

    strip: str
    length_s: float
    since_s: float
    fit: Fit
    points: int
    refused: int
    tied: int
    control: Array
    control_refused: int
    control_doubt: str
    control_failed: bool
    apriori_m: Array
    sources: tuple[BiasedSource, ...]
    time_s: float
    exposure: Exposure | None
    sigma: Array
    protection: Array
    ground_sigma_m: Array
    ground_protection_m: Array
    alert_limit_m: float
    standing: tuple[Standing, ...] = ()
    failing: float = 0.0
    narrowly: float = 0.0
    disagreement: float = 1.0
    trajectory: tuple[float, float, float] = (1.0, 1.0, 1.0)
    attitude_at_most_s: float = np.inf
    camera: CameraDoubt | None = None
    calibration: float = 1.0
    light: str = GOOD
    reason: str = ""
    events: tuple[str, ...] = ()
    free: int | None = None
    late: float = 0.0
    held_by: str = "earlier control"

    @property
    def names(self) -> frozenset[Group]:
        """The sources that drift, or may be the one that does."""
        return frozenset(name for s in self.sources for name in s.suspects)


def light(s: QualityFindings) -> tuple[str, str]:
    """Colour and reason; the reason may say something where the light is good too."""
    return contradiction(s) or _tie_points(s) or _datum(s)


def contradiction(s: QualityFindings) -> tuple[str, str] | None:
    """What contradicts what, None if nothing does: it casts doubt on all of the strip, not on the present alone."""
    if s.camera is not None:  # everything else contradicts everything then
        return FAILED if s.camera.spoils else WEAK, str(s.camera)
    chance = sigma0_by_chance(s.fit.redundancy)
    if s.fit.sigma0 > max(CONTRADICTION, chance):
        return FAILED, f"observations contradict each other: sigma0 {s.fit.sigma0:.1f}"
    if s.points >= ENOUGH_POINTS and s.refused > MOSTLY_REFUSED * s.points:
        return FAILED, f"{s.refused} of {s.points} tie points contradict the others"
    # that drifting tie points contradict control has been said
    if not s.sources and s.control_refused >= max(2, int(s.control.max())):
        return FAILED, f"{s.control_refused} control points contradict the orientation"
    camera = ""
    if s.calibration > BADLY_CALIBRATED:
        camera = f"the camera is calibrated {s.calibration:.1f} times worse than stated; its errors are estimated"
    doubts = [doubt for doubt in (camera, s.control_doubt) if doubt]
    if doubts or s.sources:
        return FAILED if s.control_failed else WEAK, "; ".join([*doubts, *map(str, s.sources)])
    if s.fit.sigma0 > chance:
        return WEAK, f"observations disagree more than sigmas say: sigma0 {s.fit.sigma0:.2f}, by chance {chance:.2f}"
    if s.disagreement > DISAGREE:
        return WEAK, f"new looks disagree {s.disagreement:.1f} times as much as sigmas say, which are being questioned"
    if s.narrowly > HEAVY_TAILS:
        share = f"{100.0 * s.narrowly:.0f} % of the looks fail narrowly"
        return WEAK, f"{share}: their errors have heavier tails than stated, sigmas of points are too small"
    if s.failing > MISMATCHES:
        share = f"{100.0 * s.failing:.0f} % of the looks contradict the others"
        return WEAK, f"{share} and are left out: more stay unseen at points of two looks, whose sigmas do not say it"
    doubts = [f"{n} {f:.1f} times" for n, f in zip(ERROR_GROUPS, s.trajectory, strict=False) if f > DOUBTED]
    if s.attitude_at_most_s < np.inf:
        doubts.append(f"the attitude wanders within {s.attitude_at_most_s:g} s")
    if doubts:
        return WEAK, f"the trajectory is worse than stated: {', '.join(doubts)}"
    return None


def sigma0_by_chance(redundancy: int) -> float:
    """sigma0 that right sigmas exceed with the probability `BY_CHANCE`; infinite where nothing can be said."""
    if redundancy < CONTRADICTION_REDUNDANCY:
        return np.inf
    return float(np.sqrt(chi2.isf(BY_CHANCE, redundancy) / redundancy))


def _tie_points(s: QualityFindings) -> tuple[str, str] | None:
    within = f"within {s.length_s:.0f} s" if s.length_s else "yet"
    if s.points == s.refused:
        when = "yet" if s.since_s < s.length_s else within
        return WEAK, f"no tie points {when}: the orientation is the measured one"
    if s.tied < LEAST_POINTS:
        passed = ""
        if s.late > MANY_LATE:
            share = f"{100.0 * s.late:.0f} % of the looks came when the window had passed them"
            passed = f"; {share}: is it shorter than from one view to the next?"
        return WEAK, f"too few tie points {within}: {s.tied} are seen twice, wanted {LEAST_POINTS}{passed}"
    if s.free == 0:  # ground points alone look good, and say nothing of what lies between them
        return WEAK, f"nothing but ground points is matched {within}, no tie point: is the height of the ground right?"
    return None


def datum_on_gnss(s: QualityFindings) -> str:
    """What of the datum no control says, now or earlier; "" if all is said."""
    known = s.control > 0
    held = known if s.exposure is None else known | (s.exposure.sigma[:3] < DATUM_HELD * s.apriori_m)
    if held.all():
        return ""
    missing = "no control"
    if known.any():
        missing = "no height control" if known[:2].all() else "no planimetric control"
    rests = "height datum rests"
    if not held[:2].all():
        rests = "position datum rests" if held[2] else "position and height datum rest"
    return f"{missing} {_within(s)}; {rests} on GNSS"


def _within(s: QualityFindings) -> str:
    return f"within {min(s.length_s, max(s.since_s, 1.0)):.0f} s"


def _datum(s: QualityFindings) -> tuple[str, str]:
    on_gnss = datum_on_gnss(s)
    if on_gnss:
        return WEAK, on_gnss
    if not (len(s.ground_protection_m) and (s.ground_protection_m <= s.alert_limit_m).all()):
        return WEAK, _exposed(s)
    return GOOD, "" if (s.control > 0).any() else f"no control {_within(s)}; {s.held_by} holds the datum"


def _exposed(s: QualityFindings) -> str:
    """Why the protection levels are beyond the alert limit."""
    e, levels = s.exposure, s.ground_protection_m
    if e is None or not len(levels) or np.isnan(levels).any():
        return "how far the orientation may be off is not known yet"
    worst = int(np.argmax(levels))
    level, limit = metres(float(levels[worst])), metres(s.alert_limit_m)
    against = f"limit {limit}" if level != limit else "just beyond the limit"
    off = f"{WHERE[worst]} up to {level} off unseen, {against}"
    if e.names:
        rests, one = f"{e.names[0]} alone", f"its {e.observation[0]}"
        if len(e.names) > 1:
            rests, one = ", ".join(e.names[:-1]) + " and " + e.names[-1], "one of them"
        return f"the datum rests on {rests}: an error of {metres(e.detectable_m)} in {one} would not be seen ({off})"
    if CRITICAL_W * s.ground_sigma_m[worst] > s.alert_limit_m:
        return f"{WHERE[worst]} known to {metres(float(s.ground_sigma_m[worst]))}, 1 sigma ({off})"
    if e.observation:
        return f"an error in the {e.observation} would not be seen ({off})"
    return f"too few tie points check each other ({off})"


def metres(value: float) -> str:
    """Two figures: of a protection level more would not be true."""
    return f"{value:.0f} m" if value >= 9.95 else f"{value:.1f} m" if value >= 0.095 else f"{value:.2f} m"


#: A better colour is shown when it has held for so long, s (tuned).
HOLD_S = 3.0
#: Other figures in the words of the same colour are shown after so long, s, and words of another kind (tuned).
WORDS_S, KIND_S = 5.0, 1.0
#: A strip is good if this share of its final orientation is within the alert limit (tuned).
GOOD_SHARE = 0.9
#: A strip has failed that contradicted itself for this share of its time, or at its end; its trajectory is in doubt if
#: it was for so long (tuned).
LONG = 0.1
COLOURS = (GOOD, WEAK, FAILED)


def kind(reason: str) -> str:
    """A reason without what changes from second to second: its first words."""
    return " ".join([word for word in reason.split() if not any(map(str.isdigit, word))][:3])


@dataclass
class StripRecord:
    """What is remembered of a strip for the verdict.

    Attributes
    ----------
    final, beyond : times of its final orientation, and those beyond the alert limit
    worst_m, where : largest protection level on the ground, and of what
    looks : how often the light was decided, by colour
    failure : why, the last time
    last : what was found last
    doubted, trajectory : how often its trajectory was worse than stated, and by how much at most, see
        `QualityFindings`; what was so for a while is in the strip as a whole
    on_gnss : what of the datum rested on GNSS at the last look, "" if ever nothing did
    weak_for : looks, by reason without its figures
    words : of these reasons
    free : most tie points that the window had, None: not known
    seen : most points with a ray that it had
    """

    final: int = 0
    beyond: int = 0
    worst_m: float = 0.0
    where: str = ""
    looks: Counter[str] = field(default_factory=Counter[str])
    failure: str = ""
    last: QualityFindings | None = None
    doubted: int = 0
    trajectory: tuple[float, float, float] = (1.0, 1.0, 1.0)
    on_gnss: str | None = None
    weak_for: Counter[str] = field(default_factory=Counter[str])
    words: dict[str, str] = field(default_factory=dict)
    free: int | None = None
    seen: int = 0

    def look(self, s: QualityFindings, colour: str, reason: str) -> None:
        """Remember what the light said in flight."""
        self.looks[colour] += 1
        self.last = s
        self.seen = max(self.seen, s.points - s.refused)
        self.doubted += max(s.trajectory) > DOUBTED
        a, b, c = np.maximum(self.trajectory, s.trajectory).tolist()
        self.trajectory = a, b, c
        if s.free is not None:
            self.free = max(self.free or 0, s.free)
        if self.on_gnss != "":
            self.on_gnss = datum_on_gnss(s)
        if colour == FAILED:
            self.failure = reason
        elif colour == WEAK:
            self.weak_for[kind(reason)] += 1
            self.words[kind(reason)] = reason.partition(" (")[0]

    def became_final(self, times: int, protection_m: Array, limit_m: float) -> None:
        """So many times of its orientation are final, with protection levels (times, 4) on the ground if known."""
        self.final += times
        if not protection_m.size:
            self.beyond += times
            return
        self.beyond += int((protection_m.max(axis=1) > limit_m).sum())
        if protection_m.max() > self.worst_m:
            self.worst_m = float(protection_m.max())
            self.where = WHERE[int(np.argmax(protection_m.max(axis=0)))]

    def verdict(self, strip: str) -> tuple[str, str]:
        """Colour and reason for the strip of this name as a whole."""
        over = f"strip {strip} over"
        last = self.last
        if last is not None and self.doubted > LONG * self.looks.total():
            last = replace(last, trajectory=self.trajectory)
        doubt = contradiction(last) if last is not None else None
        failed = self.looks[FAILED] / max(self.looks.total(), 1)
        if failed > LONG and (doubt is None or doubt[0] != FAILED):
            return FAILED, f"{over}: {self.failure} (for {100 * failed:.0f} % of its time)"
        if doubt is not None:
            return doubt[0], f"{over}: {doubt[1]}"
        if last is not None and not self.seen:
            return WEAK, f"{over}: no tie points: the orientation is the measured one"
        if self.on_gnss:
            return WEAK, f"{over}: {self.on_gnss}"
        if self.free == 0:
            return WEAK, f"{over}: nothing but ground points was matched, no tie point"
        limit_m = self.last.alert_limit_m if self.last is not None else np.inf
        limit = "" if np.isinf(limit_m) else f" {metres(limit_m)}"
        if self.final and self.beyond <= (1.0 - GOOD_SHARE) * self.final:
            return GOOD, f"{over}: within the limit of{limit}" if limit else over
        text = f"{over}: no orientation"
        if self.final:
            text = f"{over}: {100 * self.beyond / self.final:.0f} % of its final orientation beyond the limit of{limit}"
        if self.where:
            text += f", {self.where} up to {metres(self.worst_m)} off unseen"
        if self.weak_for:
            text += f"; {self.words[self.weak_for.most_common(1)[0][0]]}"
        return WEAK, text


class LightDisplay:
    """The light as it is shown; see the module.

    Attributes
    ----------
    records : of the strips of a flight, by name
    """

    def __init__(self) -> None:
        self.records: defaultdict[str, StripRecord] = defaultdict(StripRecord)
        self._said: deque[tuple[float, str, str]] = deque()
        self._strip = ""
        self._shown = GOOD, "no strip is flown"
        self._worded_s = -np.inf

    def look(self, now_s: float, s: QualityFindings) -> tuple[str, str]:
        """Colour and reason that are shown at a time."""
        if not s.strip:
            if self._strip:
                self._shown = self.records[self._strip].verdict(self._strip)
                self.records.clear()
                self._strip = ""
            return self._shown
        colour, reason = light(s)
        self.records[s.strip].look(s, colour, reason)
        if s.strip != self._strip:
            self._strip = s.strip
            self._said.clear()
            self._worded_s = -np.inf
        self._said.append((now_s, colour, reason))
        while self._said[0][0] < now_s - HOLD_S:
            self._said.popleft()
        worst = max((c for _, c, _ in self._said), key=COLOURS.index)
        words = next(r for _, c, r in reversed(self._said) if c == worst)
        stay_s = WORDS_S if kind(words) == kind(self._shown[1]) else KIND_S
        if worst != self._shown[0] or now_s - self._worded_s >= stay_s:
            self._shown, self._worded_s = (worst, words), now_s
        return self._shown
