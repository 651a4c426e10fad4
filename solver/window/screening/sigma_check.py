"""Whether the a-priori sigmas are right: asked before any look is thrown out.

A trajectory that is worse than stated makes good looks contradict each other. Data snooping would then throw out one
after the other and keep a model that is wrong. Two quantities prevent that:

*Disagreement.* Each point that comes is compared with the orientation as it is known without it, and without the look
that disagrees most. Its weighted squares over their median under the chi-square distribution have a median of about 0.3
over many points if all sigmas are right, also where every fifth look is a gross error. Where that of the newest points
is clearly larger, tests of single looks are made wider by that much. A strip begins with points of two looks, of which
none can be spared; they count until there are others.

*Variance components.* Pairs of factors on the sigmas of positions and attitudes are weighed by their restricted
likelihood (`_likely`); the sigmas of the unknowns present are stated anew, and those of all that come later. Those of
the wanders are weighed where larger ones are clearly more likely than those in force: a wander that is stated too small
bends smoothly, and its residuals in single a-priori equations say little of it where few looks contradict each other.
Those of offset and of shift and drift are weighed where the squared residuals of their few a-priori equations are
significantly more than their redundancy. A factor falls again where the data no longer ask for it, and never below 1: a
trajectory that is stated too good costs much, one that is stated too bad next to nothing. Where that of a wander falls,
the wander that is present keeps what it had: it may be all in one step of the GNSS, which a mean over the window no
longer shows. Not where noise of the looks, or the other wander, has been found larger since, which had been taken for
it. The image has a factor, too: from the median of squared normalised residuals, which gross errors do not move much.
Few looks with much noise look as if the trajectory wandered, and a wander that is stated so large would follow their
noise from then on. So before one is stated larger, noise of looks is a third factor of the bank. Where looks at
different points, taken at nearly the same time, have much of it in common it is no noise of the image: the attitude
vibrates. It is stated as noise of the attitude then, so that the orientation says it, too.

Source: W. Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86, 1979; restricted
likelihood: K.-R. Koch, Maximum likelihood estimate of variance components, Bulletin geodesique 60, 1986.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ...adjustment.network import Rays
from ...models.base import ATTITUDE_WANDER, CONSTANT, ERROR_GROUPS, OFFSET, POSITION_WANDER, WANDERS
from ...models.slow_errors import LEARNING_TIME_S
from ...quantiles import chi2
from ..state.network import LiveNetwork
from ..state.strip import WindowStrip
from ..state.unknowns import WindowState, block_of

Array = NDArray[np.floating]

#: Residuals of a-priori equations are compared with their redundancy over so long, s.
MEMORY_S = 30.0
#: Probability that a right sigma of the offset, and of shift and drift, is questioned by one look. Tuned: of 20 flights
#: each with a lever arm 0.2 m off and with a random walk one is shown as good though its orientation is worse than its
#: sigmas say; at 3e-3 for the offset four. Flights as stated are the same at both.
QUESTIONED = (1.5e-2, 3e-3)
#: Wanders are weighed where twice as large a one is more likely by so much, as minus twice the logarithm of a
#: likelihood ratio: chi-square of two degrees of freedom, 0.5 %. Tuned: between 6 and 18 flights as stated are the
#: same, and points of flights whose wander is twice as large and seen by few looks are within 3 %.
CLEARLY_LIKELIER = 10.6
#: Factors on position and attitude that are tried for that.
TWICE = ((1.0, 2.0), (2.0, 1.0), (2.0, 2.0))
#: Where the wander of position is not as stated, but guessed from the covariance of a pose, the likelihood of a bank
#: says what it is as soon as there is so much redundancy; no test has to ask for it first. Tuned.
PLENTY = 10.0
#: Factors on errors of position and attitude that are tried beside a worse camera, or others of these. Tuned.
LARGER = (1.0, 3.0, 10.0)
#: Redundancy of a group below which nothing is said about it.
LEAST_REDUNDANCY = 0.2
#: A factor is applied if it differs by so much from the one in force, and changes by so much at most in one look.
CHANGED, MOST_UP, MOST_DOWN = 1.15, 3.0, 0.7
#: Redundancy number from which the residual of a look says something, and normalised residuals wanted; how far the
#: median of their squares may be off, in units of ``sqrt(2 / n)``: its standard deviation is 1.7 of these, and looks at
#: one time have noise in common. Tuned.
LEAST_CONTROLLED, LEAST_LOOKS, IMAGE_QUESTIONED = 0.1, 40, 8.0
#: Looks are at one time if they are so far apart at most, s; pairs wanted, and share of the variance in common, in
#: units of its standard deviation, to say that the attitude vibrates, and that it still does; normalised residuals
#: count up to so much; less vibration than this share of the image sigma is none. Tuned.
TOGETHER_S, LEAST_PAIRS, SIGNIFICANT, STILL_SIGNIFICANT, OUTLYING, LEAST_VIBRATION = 0.05, 40, 4.0, 1.5, 4.0, 0.3
#: All noise beyond that of the image is vibration where looks have more than this share of their variance in common;
#: so much of what they had is kept at least from one look to the next. Tuned.
VIBRATES, SHARE_KEPT = 0.3, 0.9
#: Batches that are looked at then, the newest ones.
MOST_JUDGED = 120
#: Looks are questioned when so many looks at the slow errors have changed nothing. Tuned.
STEADY = 3
#: Looks so far apart, s, that have this share of their variance in common show a wander; each time both wanders are
#: stated so many times as large. Tuned.
APART_S, LASTING, RAISED = (0.4, 0.8), 0.15, 1.5
#: The other wander was meant where its factor has become so many times as large since. Tuned.
MOVED = 2.0
#: Disagreements of two looks beyond so many standard deviations may be gross errors, and this share of them is taken
#: for good: usual, and tuned, for points of which a third are spoilt. Rounds that find out.
WITHIN, SURELY_GOOD, MOST_ROUNDS = 2.5, 0.3, 30
#: What is left of the variance of a normal distribution within these. Derived.
KEPT_INSIDE = float((1.0 - chi2.sf(WITHIN**2, 3)) / (1.0 - chi2.sf(WITHIN**2, 1)))
#: What the operator is told of the additional parameters.
CALIBRATION = "calibration of the camera"
#: A factor is told again when it differs by so much from what was told last.
TOLD_AGAIN = 1.5
#: Factors that are weighed against each other, and how far from 1 they usually are, as a logarithm. Tuned.
BANK, USUAL_LOG = (1.0, 1.5, 2.3, 3.5, 5.5, 9.0, 15.0, 30.0, 60.0), 1.5
#: Before a wander is stated larger it is weighed against noise of looks that is so many times as large. Tuned.
NOISES = (1.0, 1.2, 1.45, 1.75, 2.1, 2.6, 3.2, 4.0, 5.0)
#: The steps from a choice of factors to its neighbours.
STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
#: Neighbours are weighed of factors whose cost is so far above the least: their weight is below 1e-4. Derived.
COUNTS = 20.0
#: How often the camera is questioned in one look. Tuned.
MOST_ROUNDS_OF_CAMERA = 3
#: An error of the platform contradicts what was known of it beforehand if its normalised residual is larger (a
#: probability of 1 %); it is told when it is so many times its sigma, and so many times the a-priori one. Tuned.
PLATFORM_QUESTIONED, CERTAIN, SURPRISING = 2.6, 5.0, 2.0
#: No factor becomes larger.
LARGEST = 1000.0
#: Points whose disagreement is remembered, those wanted to say anything, the variance ratio where all is right (the
#: median of chi-square values of one degree of freedom that are the least of three), and that from which it counts.
#: Tuned.
REMEMBERED, ENOUGH, RIGHT, CLEARLY = 60, 15, 0.3, 1.5


class SigmaCheck:
    """See the module.

    Parameters
    ----------
    constants : whether offset, shift and drift are questioned; not where GNSS is the datum, which control gives way to
    """

    def __init__(self, network: LiveNetwork, constants: bool = True) -> None:
        self._network = network
        self._pairs = (WANDERS, CONSTANT)[: 1 + constants]
        self._ratios: deque[float] = deque(maxlen=REMEMBERED)
        self._of_two: deque[float] = deque(maxlen=REMEMBERED)
        self._told = np.ones(len(ERROR_GROUPS) + 2)
        self._vibration = self._shared = 0.0
        self._steady = 0
        self._enough = False
        self._told_platform: set[str] = set()
        self._costs: dict[tuple[int, int], _Cost] = {}
        # largest factor of the wanders of position and attitude, and that of the other one then
        self._largest, self._beside = np.ones(2), np.ones(2)
        self.events: list[str] = []

    @property
    def in_doubt(self) -> bool:
        """Whether new looks disagree more than the sigmas say, or are too few to tell."""
        return not self._enough or self._network.sigmas.disagreement > 1.0

    def entered(self, squares: Iterable[tuple[float, int, bool]]) -> None:
        """Points have come, each as `entry.disagreement` judges it. Those of two looks count until enough have more."""
        for square, redundancy, spared in squares:
            if spared:
                self._ratios.append(square / _median_square(redundancy))
            else:
                self._of_two.append(square)
        self._enough, ratio = True, RIGHT
        if len(self._ratios) >= ENOUGH:
            ratio = float(np.median(self._ratios))
        elif len(self._of_two) >= ENOUGH:
            ratio = RIGHT * _variance_of_most(np.array(self._of_two))
        else:
            self._enough = False
        self._network.sigmas.disagreement = np.sqrt(ratio / RIGHT) if ratio > CLEARLY else 1.0

    def look(self, now_s: float, due: bool, turns: int = 1) -> tuple[bool, bool]:
        """Compare residuals with sigmas where that is due; whether those of slow errors and of looks were changed.

        Where looks disagree more than expected it is due in every update.

        Parameters
        ----------
        turns : how often it is due before anything new comes: what changes nothing would not the next time either
        """
        network = self._network
        sigmas = network.sigmas
        if not due and sigmas.disagreement == 1.0:
            return False, False
        strip = next((s for s in reversed(network.flown) if s.first_line_time_s <= now_s), None)
        if strip is None or not len(network.batches):
            return False, False
        network.state.solve()
        network.state.expect([network.state.numbers])
        if network.platform.question(PLATFORM_QUESTIONED):
            network.state.solve()
        self._question_camera(strip)
        factor, of_image = self._slow_errors(strip, now_s, due)
        of_slow = bool((factor != sigmas.apriori).any())
        # what the trajectory explains is no noise of looks
        self._steady = 0 if of_slow or of_image else self._steady + turns
        if self._steady >= STEADY:
            judged = self._judged()
            if judged is not None and judged.last():
                factor[[POSITION_WANDER, ATTITUDE_WANDER]] *= RAISED
                of_slow, self._steady = True, 0
            elif judged is not None:
                of_image = self._restate_looks(judged)
        if of_slow or of_image:
            self._restate(strip, np.clip(factor, 1.0, LARGEST))
            network.state.solve()
        self._tell()
        self._tell_platform()
        return of_slow, of_image

    def _question_camera(self, strip: WindowStrip) -> None:
        """State larger errors of the camera where its calibration is contradicted by more than looks disagree, and no
        constant error of the trajectory makes the data as likely."""
        calibration = self._network.calibration
        if not calibration.is_questioned or len(self._controlled()) < LEAST_LOOKS:
            return  # few looks do not tell noise from anything else
        variance = max(self._network.sigmas.disagreement**2, self._median_ratio(), 1.0)
        for _ in range(MOST_ROUNDS_OF_CAMERA):
            if not calibration.is_contradicted(variance) or self._constants_instead(strip):
                break
            calibration.state_larger(variance)
            self._network.state.solve()

    def _constants_instead(self, strip: WindowStrip) -> bool:
        """Whether larger offsets, shifts and drifts make the data more likely than a worse camera does."""
        return self._gain(strip, CONSTANT) > self._network.calibration.gain()

    def _gain(self, strip: WindowStrip, pair: tuple[int, int]) -> float:
        """By how much minus twice the logarithm of the likelihood of the data falls where the factors of a pair are as
        much larger as is likely best; 0 where they are not questioned."""
        if pair not in self._pairs:
            return 0.0
        cost, apriori = self._cost(strip, pair), self._network.sigmas.apriori
        f, g = (float(apriori[group]) for group in pair)
        return cost.of(f, g, 1.0) - min(cost.of(i * f, j * g, 1.0) for i in LARGER for j in LARGER)

    def _restate(self, strip: WindowStrip, factor: Array) -> None:
        """State the sigmas of slow errors anew, with factors (4,) that the residuals of a strip ask for."""
        sigmas, state = self._network.sigmas, self._network.state
        sigmas.apriori, before = factor, state.changes
        kept = self._kept(factor[list(WANDERS)])
        changed = {each: each.restate_sigmas(factor, state, kept) for each in self._network.flown}
        for pair, cost in self._costs.items():
            if cost.changes == before and all(g <= ({*pair} if s is strip else set()) for s, g in changed.items()):
                cost.changes = state.changes

    def _kept(self, factor: Array) -> tuple[bool, bool]:
        """Whether the wanders (2,) of position and attitude that are present keep the largest factors they have had.

        Not where noise of looks has been found that had been taken for them, nor where the other one has become much
        larger since: then it was that one all along.
        """
        if self._network.sigmas.image > 1.0 or self._network.pose_noise.vibration:
            return False, False
        other = factor[::-1]
        moved = (factor < self._largest) & (other > MOVED * self._beside)
        new = moved | (factor >= self._largest)
        self._largest[new], self._beside[new] = factor[new], other[new]
        position, attitude = (~moved).tolist()
        return position, attitude

    def _slow_errors(self, strip: WindowStrip, now_s: float, due: bool) -> tuple[Array, bool]:
        """Factors (4,) that the residuals of a-priori equations ask for; whether the noise of looks was stated anew,
        which may be what bends the trajectory."""
        before, state = self._network.sigmas.apriori, self._network.state
        group, square, redundancy = strip.apriori_fit(state, now_s - MEMORY_S)
        n = len(ERROR_GROUPS)
        squares, redundancies = np.bincount(group, square, n), np.bincount(group, redundancy, n)
        factor, of_looks = before.copy(), False
        known = redundancies >= LEAST_REDUNDANCY
        too_large = [
            known[g] and squares[g] > chi2.isf(p, redundancies[g]) for g, p in zip(CONSTANT, QUESTIONED, strict=True)
        ]
        contradicted = any(too_large) or self._offset_or_mounting(strip, now_s)
        weighed = known & (factor > 1.0)
        guessed = strip.slow.wander_time_s < 2.0 * LEARNING_TIME_S  # nearer to what is learnt than to what is stated
        weighed[POSITION_WANDER] |= guessed and squares[POSITION_WANDER] > redundancies[POSITION_WANDER] > PLENTY
        for pair in self._pairs:
            asked = weighed[list(pair)] | (pair == CONSTANT and contradicted)
            # a gross error among the first few points bends the trajectory as a wander does
            by_likelihood = pair == WANDERS and due and self._enough
            if not asked.any() and not by_likelihood:
                continue
            cost, present = self._cost(strip, pair), (float(before[pair[0]]), float(before[pair[1]]))
            if by_likelihood and cost.prefers_larger(*present):
                if self._gain(strip, CONSTANT) > self._gain(strip, WANDERS):
                    contradicted = True  # a mounting that is off bends the trajectory, too, until it is known
                else:
                    asked |= True
            if not asked.any():
                continue
            *wanted, ratio = _likely(cost, present)
            noise = self._noise() if pair == WANDERS and max(np.divide(wanted, present)) > CHANGED else None
            if noise is not None:
                cost.noise = noise
                *wanted, ratio = _likely(cost, present)
                cost.noise = None
            for g, w, it in zip(pair, wanted, asked, strict=True):
                if it:
                    factor[g] = _changed(float(factor[g]), w / float(factor[g]))
            # gross errors count in the likelihood, and not in a median
            ratio = min(ratio, MOST_UP, np.sqrt(self._median_ratio()))
            if noise is not None and ratio > CHANGED:
                self._state_noise(noise.variance * ratio**2, noise.pixel, noise.sigma_px)
                of_looks = True
            if (factor != before).any() or of_looks:
                break  # what wanders is looked at first; the rest when that is settled
        return factor, of_looks

    def _cost(self, strip: WindowStrip, pair: tuple[int, int]) -> _Cost:
        """The cost of factors of a pair: as it was where nothing has changed since but these factors."""
        cost = self._costs.get(pair)
        if cost is None or cost.strip is not strip or cost.changes != self._network.state.changes:
            cost = self._costs[pair] = _Cost(strip, self._network.state, pair)
        return cost

    def _offset_or_mounting(self, strip: WindowStrip, now_s: float) -> bool:
        """Whether an offset would be contradicted if focal length and lever arm were as stated. These explain a height
        or a place as well as an offset does, so that both may be wrong where one of them is."""
        network = self._network
        if not len(network.like_an_offset):
            return False
        _, square, redundancy = strip.apriori_fit(
            network.state, now_s - MEMORY_S, network.like_an_offset, np.array([OFFSET])
        )
        mine = redundancy >= LEAST_REDUNDANCY
        return bool((square[mine] > redundancy[mine] * chi2.isf(QUESTIONED[OFFSET], 1)).any())

    def _noise(self) -> _Noise | None:
        """What the looks say with the noise that is stated now; None while some have the weights of another one."""
        network = self._network
        batches = list(network.batches)
        if any(b.noise_version != network.noise_version for b in batches):
            return None
        pixel, sigma = _pixel_and_sigma([b.rays for b in batches[-MOST_JUDGED:]])
        information = [b.information for b in batches]
        return _Noise(
            sigma**2 + (network.pose_noise.vibration / pixel) ** 2, pixel, sigma / network.sigmas.image,
            sum(i.rows for i in information), sum(i.square for i in information), *network.state.live(),
        )  # fmt: skip

    def _controlled(self) -> Array:
        """Normalised residuals of the looks in the window that the others control, as they were judged last."""
        known = [b.judged[2] for b in self._network.batches if b.judged is not None]
        return np.concatenate([s.w[s.redundancy > LEAST_CONTROLLED] for s in known]) if known else np.empty(0)

    def _median_ratio(self) -> float:
        """Median of the squares of these over that of right sigmas; 1 where there are too few."""
        w = self._controlled()
        return float(np.median(w**2) / _median_square(1)) if len(w) >= LEAST_LOOKS else 1.0

    def _judged(self) -> _Residuals | None:
        """Residuals of the looks in the window, where they ask for another noise than is stated; None where not."""
        sigmas, noise, state = self._network.sigmas, self._network.pose_noise, self._network.state
        w = self._controlled()
        if len(w) < LEAST_LOOKS:
            return None
        stated = sigmas.image == 1.0 and noise.vibration == 0.0
        if stated and np.median(w**2) / _median_square(1) < 1.0 + IMAGE_QUESTIONED * np.sqrt(2.0 / len(w)):
            return None
        judged = [(b, b.judge(state)[1]) for b in list(self._network.batches)[-MOST_JUDGED:]]
        rays = [b.rays for b, _ in judged]
        time_s = np.concatenate([r.time_s for r in rays])
        order = np.argsort(time_s, kind="stable")
        point = np.concatenate([r.point + 1000 * REMEMBERED * i for i, r in enumerate(rays)])
        w = np.clip(np.concatenate([s.w for _, s in judged]), -OUTLYING, OUTLYING)
        redundancy = np.concatenate([s.redundancy for _, s in judged])
        pixel, sigma = _pixel_and_sigma(rays)
        return _Residuals(time_s[order], point[order], w[order], redundancy[order], pixel, sigma / sigmas.image)

    def _restate_looks(self, found: _Residuals) -> bool:
        """State the noise of looks as residuals ask for; whether it changed."""
        sigmas, noise, pixel, sigma = self._network.sigmas, self._network.pose_noise, found.pixel, found.sigma_px
        shared = found.shared(0.0, TOGETHER_S, STILL_SIGNIFICANT if noise.vibration else SIGNIFICANT)
        self._shared = max(shared, SHARE_KEPT * self._shared)
        total = (sigma * sigmas.image) ** 2 + (noise.vibration / pixel) ** 2
        wanted = total * min(max(found.ratio, MOST_DOWN**2), MOST_UP**2)
        return self._state_noise(wanted, pixel, sigma)

    def _state_noise(self, variance: float, pixel: float, sigma_px: float) -> bool:
        """State the noise of lines and samples, or of the attitude under them; whether it changed.

        Parameters
        ----------
        variance : of a sample with both, pixels squared
        pixel, sigma_px : angle that a pixel subtends, rad, and the sigma of a sample as stated at first
        """
        sigmas, noise = self._network.sigmas, self._network.pose_noise
        image, vibration = max(float(np.sqrt(variance)) / sigma_px, 1.0), 0.0
        if self._shared > VIBRATES and image > np.hypot(1.0, LEAST_VIBRATION):
            image, vibration = 1.0, pixel * sigma_px * float(np.sqrt(image**2 - 1.0))
        before = np.array([sigmas.image, noise.vibration / pixel / sigma_px])
        now = np.array([image, vibration / pixel / sigma_px])
        little = np.abs(now - before).max() < (CHANGED - 1.0) * np.hypot(*before)
        if (now == before).all() or (little and now.max() > 1.0):
            return False
        sigmas.image, noise.vibration = image, vibration
        sigmas.version += 1
        return True

    def _tell(self) -> None:
        """Say what has become clearly larger or smaller since it was told last."""
        vibration = self._network.pose_noise.vibration
        if abs(vibration - self._vibration) > (TOLD_AGAIN - 1.0) * max(vibration, self._vibration):
            self._vibration = vibration
            self.events.append(
                f"sigmas: the attitude vibrates by {1e3 * np.degrees(vibration):.1f} mdeg, which nobody stated"
                if vibration
                else "sigmas: the attitude does not vibrate any more"
            )
        calibration = self._network.calibration
        now = np.array([*self._network.sigmas.apriori, self._network.sigmas.image, calibration.factor])
        for i, name in enumerate((*ERROR_GROUPS, "image", CALIBRATION)):
            if max(now[i] / self._told[i], self._told[i] / now[i]) < TOLD_AGAIN:
                continue
            self._told[i] = now[i]
            self.events.append(
                f"sigmas: {name} is {now[i]:.1f} times as large as stated"
                if now[i] > 1.0
                else f"sigmas: {name} is as stated"
            )
            if name == CALIBRATION:
                self.events.append(
                    f"camera: looks are off its calibration by {calibration.worst(self._network.camera)}"
                )

    def _tell_platform(self) -> None:
        """Say once which errors of the platform are certain, and more than was expected."""
        platform, state = self._network.platform, self._network.state
        value, sigma = state.values(platform.numbers), np.sqrt(np.diagonal(state.covariance(platform.numbers)))
        for i, name in enumerate(platform.errors.unknown_names):
            certain = abs(value[i]) > max(CERTAIN * sigma[i], SURPRISING * platform.errors.sigma[i])
            if certain and name not in self._told_platform:
                self._told_platform.add(name)
                self.events.append(platform.errors.words(name, float(value[i]), float(sigma[i])))

    def take_events(self) -> list[str]:
        """Lines for the operator since the last call."""
        lines, self.events = self.events, []
        return lines


@dataclass(frozen=True)
class _Noise:
    """What the looks in the window say, and the noise that is stated of them.

    Attributes
    ----------
    variance : of a sample, pixels squared, with the vibration of the attitude
    pixel, sigma_px : angle that a pixel subtends, rad, and the sigma of a sample as stated at first
    rows, square : their observations less object coordinates, and the squares of these where all unknowns are zero
    matrix, rhs : (n, n), (n,) normal equations
    """

    variance: float
    pixel: float
    sigma_px: float
    rows: int
    square: float
    matrix: Array
    rhs: Array


class _Cost:
    """Minus twice the logarithm of the restricted likelihood of a choice of factors.

    It is ``log det N + sum 2 m log f + q - n' N^-1 n``, with m equations of a group and the squares q of the looks at
    unknowns of zero. The factors of a pair act on unknowns of its own each; all others are eliminated once, those of
    the position once for each of its factors: a choice costs a factorisation of the size of the attitude's alone, and
    one that was asked for before nothing.

    Parameters
    ----------
    pair : groups of position and attitude

    Attributes
    ----------
    noise : of looks; None while it stays as it is
    changes : of the state for which it holds
    """

    def __init__(self, strip: WindowStrip, state: WindowState, pair: tuple[int, int]) -> None:
        self.noise: _Noise | None = None
        self.strip, self.changes = strip, state.changes
        matrix, rhs = state.normal()
        own, self._apriori, self._rows = [], [], []
        for group in pair:
            numbers, as_stated, in_force, rows = strip.apriori_information(group, state)
            own.append(state.places(numbers))
            self._apriori.append(as_stated)
            self._rows.append(rows)
            matrix[np.ix_(own[-1], own[-1])] -= in_force
        others = np.setdiff1d(np.arange(len(state)), np.concatenate(own))
        self._order = np.concatenate([others, *own])
        assert len(self._order) == len(state)
        self._first = len(others)
        self._matrix, self._rhs = block_of(matrix, self._order), rhs[self._order]
        self._of_noise: dict[float, _Eliminated | None] = {}
        self._of_position: dict[tuple[float, float], _Eliminated | None] = {}
        self._known: dict[tuple[float, float, float], float] = {}

    def prefers_larger(self, f: float, g: float) -> bool:
        """Whether larger factors than these, of position or attitude or both, are clearly more likely."""
        larger = min(self.of(i * f, j * g, 1.0) for i, j in TWICE)
        return self.of(f, g, 1.0) - larger > CLEARLY_LIKELIER

    def of(self, f: float, g: float, h: float) -> float:
        """Of factors of position, attitude and noise; infinite where the equations have no solution."""
        if (f, g, h) not in self._known:
            self._known[f, g, h] = self._weighed(f, g, h)
        return self._known[f, g, h]

    def _weighed(self, f: float, g: float, h: float) -> float:
        if h not in self._of_noise:
            self._of_noise[h] = self._without_others(h)
        both, (A, B), (a, b) = self._of_noise[h], self._apriori, self._rows
        if both is None:
            return np.inf
        if (f, h) not in self._of_position:
            m = len(A)
            matrix = both.matrix.copy()
            matrix[:m, :m] += A / f**2
            self._of_position[f, h] = _eliminated(matrix, both.rhs, m)
        one = self._of_position[f, h]
        last = None if one is None else _eliminated(one.matrix + B / g**2, one.rhs, len(B))
        if one is None or last is None:
            return np.inf
        gained = sum(part.log_det - part.square for part in (both, one, last))
        of_looks = 0.0
        if self.noise is not None and h > 1.0:
            of_looks = 2.0 * self.noise.rows * np.log(h) - (1.0 - h**-2) * self.noise.square
        far = (np.log(f) ** 2 + np.log(g) ** 2 + np.log(h) ** 2) / USUAL_LOG**2
        return float(gained + 2.0 * (a * np.log(f) + b * np.log(g)) + of_looks + far)

    def _without_others(self, h: float) -> _Eliminated | None:
        """The equations of the pair, without what is stated of it."""
        matrix, rhs = self._matrix, self._rhs
        if self.noise is not None and h > 1.0:
            less = 1.0 - h**-2
            matrix = matrix - less * block_of(self.noise.matrix, self._order)
            rhs = rhs - less * self.noise.rhs[self._order]
        return _eliminated(matrix, rhs, self._first)


@dataclass(frozen=True)
class _Eliminated:
    """Normal equations (m, m), (m,) without their first unknowns; what these add to ``log det N``, ``n' N^-1 n``."""

    matrix: Array
    rhs: Array
    log_det: float
    square: float


def _eliminated(matrix: Array, rhs: Array, first: int) -> _Eliminated | None:
    """Without the first unknowns; None where these are not determined."""
    try:
        root = np.linalg.cholesky(matrix[:first, :first])
    except np.linalg.LinAlgError:
        return None
    y = solve_triangular(root, np.column_stack([matrix[:first, first:], rhs[:first]]), lower=True, check_finite=False)
    X, y = y[:, :-1], y[:, -1]
    log_det = 2.0 * float(np.log(np.diagonal(root)).sum())
    return _Eliminated(matrix[first:, first:] - X.T @ X, rhs[first:] - X.T @ y, log_det, float(y @ y))


def _likely(cost: _Cost, present: tuple[float, float]) -> tuple[float, float, float]:
    """Factors of errors of position and attitude of one kind, and what the noise of looks is to be multiplied by, from
    the likelihood of the data under a bank of them.

    Whether a position is off, or an attitude, or the looks are less good shows in the images by little. So each choice
    of factors is weighed by its restricted likelihood, and variances are averaged: where the data cannot tell, all are
    larger, and no sigma is too small. Most of the bank is far from likely: the search goes from the factors in force to
    neighbours as long as they count.

    Parameters
    ----------
    cost : of a choice of factors
    present : factors in force
    """
    banks = BANK, BANK, NOISES if cost.noise is not None else (1.0,)
    most = tuple(len(bank) for bank in banks)
    costs = np.full(most, np.inf)
    first = tuple(int(np.argmin(np.abs(np.log(np.divide(BANK, f))))) for f in present)
    seen, waiting, least = {(*first, 0)}, [(*first, 0)], np.inf
    while waiting:
        place = waiting.pop()
        costs[place] = cost.of(*(bank[i] for bank, i in zip(banks, place, strict=True)))
        least = min(least, costs[place])
        if costs[place] > least + COUNTS and np.isfinite(least):
            continue
        beside = {(place[0] + i, place[1] + j, place[2] + k) for i, j, k in STEPS} - seen
        near = sorted(c for c in beside if min(c) >= 0 and all(i < n for i, n in zip(c, most, strict=True)))
        seen.update(near)
        waiting.extend(near)
    weight = np.exp(-0.5 * (costs - least))
    weight /= weight.sum()
    square = [
        float(weight.sum(axis=tuple(j for j in range(3) if j != i)) @ np.square(bank)) for i, bank in enumerate(banks)
    ]
    return float(np.sqrt(square[0])), float(np.sqrt(square[1])), float(np.sqrt(square[2]))


def _pixel_and_sigma(rays: Sequence[Rays]) -> tuple[float, float]:
    """Angle that a pixel subtends, rad, and the sigma of a sample as it is stated now, pixels: medians of rays."""
    pixel = np.concatenate([np.linalg.norm(r.pitch_mm, axis=1) / r.focal_length_mm for r in rays])
    return float(np.median(pixel)), float(np.median(np.concatenate([r.sigma_sample_px for r in rays])))


def _variance_of_most(squares: Array) -> float:
    """Variance of which squares (n,) with one degree of freedom each are, but for gross errors among them.

    With one gross error among three values their median is three times that of good ones. So the search begins with a
    smaller quantile, and goes on with the mean of those within `WITHIN` standard deviations, until nothing changes. It
    is not more than their median says: a vibration has fewer small squares than a normal distribution.

    Source: P. J. Rousseeuw, A. M. Leroy, Robust regression and outlier detection, 1987, section 5.1 (reweighted).
    """
    variance = float(np.quantile(squares, SURELY_GOOD)) / float(chi2.ppf(SURELY_GOOD, 1))
    for _ in range(MOST_ROUNDS):
        inside = squares < WITHIN**2 * variance
        before, variance = variance, float(squares[inside].mean()) / KEPT_INSIDE if inside.any() else variance
        if np.isclose(variance, before):
            break
    return min(variance, float(np.median(squares)) / _median_square(1))


@lru_cache
def _median_square(redundancy: int) -> float:
    """Median of the chi-square distribution."""
    return float(chi2.median(redundancy))


@dataclass(frozen=True)
class _Residuals:
    """Residuals of n looks in the order of their times.

    Attributes
    ----------
    time_s, point : (n,)
    w, redundancy : (n, 2) normalised residuals of line and sample, and their redundancy numbers
    pixel, sigma_px : angle that a pixel subtends, rad, and the stated sigma of a sample
    """

    time_s: Array
    point: NDArray[np.int64]
    w: Array
    redundancy: Array
    pixel: float
    sigma_px: float

    @property
    def ratio(self) -> float:
        """Median of the squares over that of right sigmas."""
        return float(np.median(self.w[self.redundancy > LEAST_CONTROLLED] ** 2) / _median_square(1))

    def last(self) -> bool:
        """Whether what looks have in common lasts longer than a vibration: then it is a wander of the trajectory."""
        return self.shared(*APART_S, SIGNIFICANT) > LASTING

    def shared(self, least_s: float, most_s: float, significant: float) -> float:
        """Share of the variance that looks at different points have in common which are so far apart in time.

        Of two residuals with redundancy numbers r1, r2 and a noise of variance A in common, the product has the
        expectation ``r1 r2 A``: the rest of the noise is taken by the points.

        Parameters
        ----------
        significant : in units of its standard deviation, where nothing is in common; 0 is returned below
        """
        a = np.arange(len(self.time_s))
        b = np.maximum(np.searchsorted(self.time_s, self.time_s + least_s), a + 1)
        a, b = a[b < len(a)], b[b < len(a)]
        near = (self.time_s[b] - self.time_s[a] < most_s) & (self.point[a] != self.point[b])
        a, b = a[near], b[near]
        if len(a) < LEAST_PAIRS:
            return 0.0
        w, r = self.w, self.redundancy[a] * self.redundancy[b]
        found, noise = float(np.sum(w[a] * w[b] * r**1.5)), float(np.sqrt(np.sum(r**3)))
        total = float(np.sum(w**2 * self.redundancy) / np.sum(self.redundancy))
        return min(found / float(np.sum(r**2)) / total, 1.0) if found > significant * noise * total else 0.0


def _changed(factor: float, ratio: float) -> float:
    """A factor that residuals ask to be multiplied by a ratio: itself where that makes little difference."""
    new = min(max(factor * min(max(ratio, MOST_DOWN), MOST_UP), 1.0), LARGEST)
    return factor if max(new / factor, factor / new) < CHANGED and new > 1.0 else new
