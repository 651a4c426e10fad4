"""Whether the a-priori sigmas are right: asked before any look is thrown out.

A trajectory that is worse than stated makes good looks contradict each other. Data snooping would then throw out one
after the other and keep a model that is wrong. Two quantities prevent that:

*Disagreement* of new looks (`disagreement`): where it is clearly larger than right sigmas allow, tests of single looks
are made as much wider.

*Variance components.* Pairs of factors on the sigmas of positions and attitudes are weighed by their restricted
likelihood (`likelihood`); the sigmas of the unknowns present are stated anew, and those of all that come later. Those
of the wanders are weighed where larger ones are clearly more likely than those in force: a wander that is stated too
small bends smoothly, and its residuals in single a-priori equations say little of it where few looks contradict each
other. Those of offset and of shift and drift are weighed where the squared residuals of their few a-priori equations
are significantly more than their redundancy. A factor falls again where the data no longer ask for it, and never below
1: a trajectory that is stated too good costs much, one that is stated too bad next to nothing. Where that of a wander
falls, the wander that is present may keep what it had (`kept_wanders`); not where noise of the looks has been found
larger since, which had been taken for it. A strip that begins keeps the factors that earlier ones have shown until it
has looks of its own, and those of its constant errors longer, since each strip is one sample more of the same sigma.

An attitude that swings within ten seconds where half a minute is stated would have to wander a hundred times as far to
follow that, and be as uncertain in all that is slow. So a shorter correlation time of its wander is one more model of
the bank, and holds for all of the strip, and for those that come, where it is the likelier one.

Noise of the looks (`look_noise`) comes after the trajectory. But few looks with much noise look as if the trajectory
wandered, and a wander that is stated so large would follow their noise from then on. So before one is stated larger,
noise of looks is a third factor of the likelihood.

Source: W. Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86, 1979.
"""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...models.base import ATTITUDE_WANDER, CONSTANT, ERROR_GROUPS, OFFSET, POSITION_WANDER, WANDERS
from ...quantiles import chi2
from ..state.network import LiveNetwork
from ..state.sigma_factors import CHANGED, LARGEST, MOST_UP, changed
from ..state.strip import WindowStrip
from .disagreement import CLEARLY, Disagreement
from .kept_wanders import KeptWanders
from .likelihood import NOTHING, Beforehand, Likelihood, likely
from .look_noise import LEAST_LOOKS, NoiseOfLooks

#: Residuals of a-priori equations are compared with their redundancy over so long, s.
MEMORY_S = 30.0
#: Probability that a right sigma of the offset, and of shift and drift, is questioned by one look. Tuned: of 20 flights
#: each with a lever arm 0.2 m off and with a random walk one is shown as good though its orientation is worse than its
#: sigmas say; at 3e-3 for the offset four. Flights as stated are the same at both.
QUESTIONED = (1.5e-2, 3e-3)
#: Where the wander of position is not as stated, but guessed from the covariance of a pose, the likelihood of a bank
#: says what it is as soon as there is so much redundancy; no test has to ask for it first. Tuned.
PLENTY = 10.0
#: Redundancy of a group below which nothing is said about it.
LEAST_REDUNDANCY = 0.2
#: Looks are questioned when so many looks at the slow errors have changed nothing. Tuned.
STEADY = 3
#: Sigmas are settled when none has changed for so long, s. Tuned.
SETTLED_S = 3.0
#: Each time looks show a wander, both wanders are stated so many times as large. Tuned.
RAISED = 1.5
#: What the operator is told of the additional parameters.
CALIBRATION = "calibration of the camera"
#: A factor is told again when it differs by so much from what was told last.
TOLD_AGAIN = 1.5
#: How often the camera is questioned in one look. Tuned.
MOST_ROUNDS_OF_CAMERA = 3
#: An error of the platform contradicts what was known of it beforehand if its normalised residual is larger (a
#: probability of 1 %); it is told when it is so many times its sigma, and so many times the a-priori one. Tuned.
PLATFORM_QUESTIONED, CERTAIN, SURPRISING = 2.6, 5.0, 2.0


class SigmaCheck:
    """See the module.

    Parameters
    ----------
    newest : how much the points that came last disagree
    constants : whether offset, shift and drift are questioned; not where GNSS is the datum, which control gives way to

    Attributes
    ----------
    events : lines for the operator since they were taken last
    """

    def __init__(self, network: LiveNetwork, newest: Disagreement, constants: bool = True) -> None:
        self._network, self._newest, self._looks = network, newest, NoiseOfLooks(network)
        self._pairs = (WANDERS, CONSTANT)[: 1 + constants]
        self._told = np.ones(len(ERROR_GROUPS) + 2)
        self._vibration, self._told_at_most_s = 0.0, np.inf
        self._steady, self._changed_s, self._tells = 0, -np.inf, False
        self._told_platform: set[str] = set()
        self._likelihoods: dict[tuple[int, int], Likelihood] = {}
        self._strip: WindowStrip | None = None
        self._from_earlier: dict[tuple[int, int], Beforehand] = {}
        self._kept = KeptWanders()
        self.events: list[str] = []

    def settled(self, now_s: float) -> bool:
        """Whether no sigma has been stated anew lately, and there are looks enough to tell their noise."""
        return self._tells and now_s > self._changed_s + SETTLED_S

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
        self._remember(strip, now_s)
        self._tells = self._tells or len(self._looks.controlled()) >= LEAST_LOOKS
        network.state.solve()
        network.state.expect([network.state.numbers])
        if network.platform.question(PLATFORM_QUESTIONED):
            network.state.solve()
        self._question_camera(strip)
        factor, at_most_s, of_image = self._slow_errors(strip, now_s, due)
        of_slow = bool((factor != sigmas.apriori).any()) or at_most_s != sigmas.attitude_at_most_s
        # what the trajectory explains is no noise of looks
        self._steady = 0 if of_slow or of_image else self._steady + turns
        if self._steady >= STEADY:
            judged = self._looks.residuals()
            if judged is not None and judged.last():
                factor[[POSITION_WANDER, ATTITUDE_WANDER]] *= RAISED
                of_slow, self._steady = True, 0
            elif judged is not None:
                of_image = self._looks.restate(judged)
        if of_slow or of_image:
            self._changed_s = now_s
            self._restate(strip, np.clip(factor, 1.0, LARGEST), at_most_s)
            network.state.solve()
        self._looks.note_vibration(now_s)
        self._tell()
        if self.settled(now_s) and sigmas.disagreement == 1.0:  # sigmas that are too small make anything certain
            self._tell_platform()
        return of_slow, of_image

    def _remember(self, strip: WindowStrip, now_s: float) -> None:
        """Keep what earlier strips have shown where one begins: its first looks say little of its sigmas.

        The constant errors of a strip are one sample more of the same sigma; its wanders are judged by its own looks as
        soon as there are enough of them.
        """
        if strip is not self._strip:
            self._strip, learnt = strip, self._network.sigmas.apriori.tolist()
            self._from_earlier = {(f, g): Beforehand.of_earlier_strips((learnt[f], learnt[g])) for f, g in self._pairs}
        if now_s > strip.first_line_time_s + MEMORY_S:
            self._from_earlier.pop(WANDERS, None)

    def _question_camera(self, strip: WindowStrip) -> None:
        """State larger errors of the camera where its calibration is contradicted by more than looks disagree, and no
        constant error of the trajectory makes the data as likely.

        It takes a while until all noise of looks has been found: so it is asked anew before the camera is blamed, and
        more has to speak against the camera. In the first seconds a wander that is larger than stated bends the
        trajectory as another camera would, until it shows its own sigma: so errors of the camera are stated smaller
        again, too.
        """
        calibration = self._network.calibration
        if not calibration.is_questioned or len(self._looks.controlled()) < LEAST_LOOKS:
            return  # few looks do not tell noise from anything else
        variance = max(self._network.sigmas.disagreement**2, self._looks.median_ratio(), 1.0)
        for _ in range(MOST_ROUNDS_OF_CAMERA):
            if not calibration.is_contradicted(variance):
                break
            now = max(variance, self._looks.ratio_now())
            unstated = 0.0 if self._looks.is_as_stated() and now < CLEARLY else self._looks.unstated(now)
            if not calibration.is_contradicted(now, unstated) or self._constants_instead(strip):
                break
            calibration.state_larger(now)
            self._network.state.solve()
        if calibration.state_smaller():
            self._network.state.solve()

    def _constants_instead(self, strip: WindowStrip) -> bool:
        """Whether larger offsets, shifts and drifts make the data more likely than a worse camera does."""
        return self._gain(strip, CONSTANT) > self._network.calibration.gain()

    def gain_of_wanders(self, strip: WindowStrip) -> float:
        """By how much minus twice the logarithm of the likelihood of the data falls where the wanders are stated as
        much larger as is likely best: what the sigmas do not say yet looks like many another error."""
        return self._gain(strip, WANDERS)

    def _gain(self, strip: WindowStrip, pair: tuple[int, int]) -> float:
        """By how much minus twice the logarithm of the likelihood of the data falls where the factors of a pair are as
        much larger as is likely best; 0 where they are not questioned."""
        if pair not in self._pairs:
            return 0.0
        f, g = self._network.sigmas.apriori[list(pair)].tolist()
        return self._likelihood(strip, pair).gain(f, g)

    def _restate(self, strip: WindowStrip, factor: Array, at_most_s: float) -> None:
        """State the sigmas of slow errors anew, with factors (4,) that the residuals of a strip ask for, and a bound on
        the correlation time of the attitude's."""
        sigmas, state = self._network.sigmas, self._network.state
        sigmas.apriori, before = factor, state.changes
        if at_most_s != sigmas.attitude_at_most_s:
            sigmas.attitude_at_most_s = at_most_s
            self._kept.another_attitude()
            self._likelihoods.clear()
            for each in self._network.flown:
                each.bound_attitude_time(at_most_s, factor, state)
        kept = (False, False)
        # where noise of looks had been taken for a wander, nothing has happened that a wander would have to keep
        if sigmas.image == 1.0 and not self._network.pose_noise.vibration:
            equations = strip.equations_present(state)[list(WANDERS)]
            kept = self._kept.keeps(factor[list(WANDERS)], equations, strip.final_to_s)
        groups = {each: each.restate_sigmas(factor, state, kept) for each in self._network.flown}
        for pair, cost in self._likelihoods.items():
            if cost.changes == before and all(g <= ({*pair} if s is strip else set()) for s, g in groups.items()):
                cost.changes = state.changes

    def _slow_errors(self, strip: WindowStrip, now_s: float, due: bool) -> tuple[Array, float, bool]:
        """Factors (4,) that the residuals of a-priori equations ask for; what the attitude's correlation time is to be
        bounded by; whether the noise of looks was stated anew, which may be what bends the trajectory."""
        before, state = self._network.sigmas.apriori, self._network.state
        group, square, redundancy = strip.apriori_fit(state, now_s - MEMORY_S)
        n = len(ERROR_GROUPS)
        squares, redundancies = np.bincount(group, square, n), np.bincount(group, redundancy, n)
        factor, at_most_s, of_looks = before.copy(), self._network.sigmas.attitude_at_most_s, False
        known = redundancies >= LEAST_REDUNDANCY
        too_large = [
            known[g] and squares[g] > chi2.isf(p, redundancies[g]) for g, p in zip(CONSTANT, QUESTIONED, strict=True)
        ]
        contradicted = any(too_large) or self._offset_or_mounting(strip, now_s)
        weighed = known & (factor > 1.0)
        guessed = strip.slow.is_learnt
        weighed[POSITION_WANDER] |= guessed and squares[POSITION_WANDER] > redundancies[POSITION_WANDER] > PLENTY
        for pair in self._pairs:
            asked = weighed[list(pair)] | (pair == CONSTANT and contradicted)
            # a gross error among the first few points bends the trajectory as a wander does
            by_likelihood = pair == WANDERS and due and self._newest.enough
            if not asked.any() and not by_likelihood:
                continue
            cost, present = self._likelihood(strip, pair), (float(before[pair[0]]), float(before[pair[1]]))
            if by_likelihood and cost.prefers_larger(*present):
                if self._gain(strip, CONSTANT) > self._gain(strip, WANDERS):
                    contradicted = True  # a mounting that is off bends the trajectory, too, until it is known
                else:
                    asked |= True
            if not asked.any():
                continue
            found = likely(cost, present)
            larger = max(np.divide(found[:2], present)) > CHANGED or found.at_most_s != cost.times_s[0]
            noise = self._looks.known() if pair == WANDERS and larger else None
            if noise is not None:
                cost.noise = noise
                found = likely(cost, present)
                cost.noise = None
            ratio = found.noise
            if pair == WANDERS and found.at_most_s != cost.times_s[0]:
                at_most_s, asked[1] = found.at_most_s, False
                factor[ATTITUDE_WANDER] = min(max(found.attitude, 1.0), MOST_UP * present[1])
            for g, w, it in zip(pair, found[:2], asked, strict=True):
                if it:
                    factor[g] = changed(float(factor[g]), w / float(factor[g]))
            # gross errors count in the likelihood, and not in a median
            ratio = min(ratio, MOST_UP, np.sqrt(self._looks.median_ratio()))
            if noise is not None and ratio > CHANGED:
                self._looks.state(noise.variance * ratio**2, noise.pixel, noise.sigma_px)
                of_looks = True
            if (factor != before).any() or at_most_s != self._network.sigmas.attitude_at_most_s or of_looks:
                break  # what wanders is looked at first; the rest when that is settled
        return factor, at_most_s, of_looks

    def _likelihood(self, strip: WindowStrip, pair: tuple[int, int]) -> Likelihood:
        """The cost of factors of a pair: as it was where nothing has changed since but these factors."""
        cost = self._likelihoods.get(pair)
        if cost is None or cost.strip is not strip or cost.changes != self._network.state.changes:
            beforehand = self._from_earlier.get(pair, NOTHING)
            cost = self._likelihoods[pair] = Likelihood(
                strip, self._network.state, pair, beforehand, self._network.sigmas.attitude_at_most_s
            )
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
        at_most_s = self._network.sigmas.attitude_at_most_s
        if at_most_s != self._told_at_most_s:
            self._told_at_most_s = at_most_s
            self.events.append(
                f"sigmas: the attitude wanders within {at_most_s:g} s, faster than stated"
                if at_most_s < np.inf
                else "sigmas: the attitude wanders as slowly as stated"
            )
        calibration = self._network.calibration
        now = np.array([*self._network.sigmas.apriori, self._network.sigmas.image, calibration.factor])
        for i, name in enumerate((*ERROR_GROUPS, "image", CALIBRATION)):
            if max(now[i] / self._told[i], self._told[i] / now[i]) < TOLD_AGAIN:
                continue
            self._told[i] = now[i]
            words = f"sigmas: {name} is " + (f"{now[i]:.1f} times as large as stated" if now[i] > 1.0 else "as stated")
            if name == "image" and self._network.pose_noise.possible_vibration > vibration:
                may_be = np.degrees(self._network.pose_noise.possible_vibration)
                words += f", or the attitude vibrates by {1e3 * may_be:.1f} mdeg"
            self.events.append(words)
            if name == CALIBRATION and now[i] > 1.0:
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
