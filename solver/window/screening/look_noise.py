"""Noise of the looks: of lines and samples, or of the attitude under them.

The image has a factor, from the median of squared normalised residuals, which gross errors do not move much. Where
looks at different points, taken at nearly the same time, have much of it in common it is no noise of the image: the
attitude vibrates. It is stated as noise of the attitude then, so that the orientation says it, too. As long as the
looks are too few to tell, and far noisier than stated, it may vibrate, and the orientation says that as well. What
lasts longer is a wander of the trajectory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjustment.network import Rays
from ...arrays import Array, IntArray
from ...quantiles import median_square
from ..state.network import LiveNetwork
from ..state.sigma_factors import CHANGED, MOST_DOWN, MOST_UP
from .likelihood import LookNoise

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
#: An image seldom has so many times the noise that its matcher states: beyond that the attitude may vibrate, unless the
#: share in common is below VIBRATES by so many standard deviations. Tuned.
MAY_VIBRATE, SURELY = 3.0, 2.0
#: Batches that are looked at then, the newest ones.
MOST_JUDGED = 120
#: Looks so far apart, s, that have this share of their variance in common show a wander. Tuned.
APART_S, LASTING = (0.4, 0.8), 0.15


class NoiseOfLooks:
    """See the module."""

    def __init__(self, network: LiveNetwork) -> None:
        self._network = network
        self._shared, self._of_the_image = 0.0, False

    def known(self) -> LookNoise | None:
        """What the looks say with the noise that is stated now; None while some have the weights of another one."""
        network = self._network
        batches = list(network.batches)
        if any(b.noise_version != network.noise_version for b in batches):
            return None
        pixel, sigma = _pixel_and_sigma([b.rays for b in batches[-MOST_JUDGED:]])
        information = [b.information for b in batches]
        return LookNoise(
            sigma**2 + (network.pose_noise.vibration / pixel) ** 2, pixel, sigma / network.sigmas.image,
            sum(i.rows for i in information), sum(i.square for i in information), *network.state.live(),
        )  # fmt: skip

    def controlled(self) -> Array:
        """Normalised residuals of the looks in the window that the others control, as they were judged last."""
        known = [b.judged[2] for b in self._network.batches if b.judged is not None]
        return np.concatenate([s.w[s.redundancy > LEAST_CONTROLLED] for s in known]) if known else np.empty(0)

    def median_ratio(self) -> float:
        """Median of the squares of these over that of right sigmas; 1 where there are too few."""
        return _median_ratio(self.controlled())

    def is_as_stated(self) -> bool:
        """Whether no other noise is in force than what was stated at first."""
        return self._network.sigmas.image == 1.0 and self._network.pose_noise.vibration == 0.0

    def unstated(self, ratio: float) -> float:
        """Share of the variance of looks that nobody stated at first, where it is so many times what is stated now."""
        image, vibration = self._variances()
        return 1.0 - 1.0 / ((image + vibration) * ratio)

    @property
    def vibrating(self) -> float:
        """Share of the variance of looks that is a vibration of the attitude."""
        image, vibration = self._variances()
        return vibration / (image + vibration)

    def _variances(self) -> tuple[float, float]:
        """Of a sample by noise of the image and by vibration, in units of the variance that was stated at first."""
        sigmas, noise = self._network.sigmas, self._network.pose_noise
        if not noise.vibration:
            return sigmas.image**2, 0.0
        pixel, sigma = _pixel_and_sigma([b.rays for b in list(self._network.batches)[-MOST_JUDGED:]])
        return sigmas.image**2, (noise.vibration / pixel / (sigma / sigmas.image)) ** 2

    def ratio_now(self) -> float:
        """As `median_ratio`, of the newest looks, judged by the solution as it is now."""
        judged = [b.judge(self._network.state)[1] for b in list(self._network.batches)[-MOST_JUDGED:]]
        w = np.concatenate([s.w[s.redundancy > LEAST_CONTROLLED] for s in judged]) if judged else np.empty(0)
        return _median_ratio(w)

    def residuals(self) -> Residuals | None:
        """Residuals of the looks in the window, where they ask for another noise than is stated; None where not."""
        sigmas, state = self._network.sigmas, self._network.state
        w = self.controlled()
        if len(w) < LEAST_LOOKS:
            return None
        if self.is_as_stated() and np.median(w**2) / median_square(1) < 1.0 + IMAGE_QUESTIONED * np.sqrt(2.0 / len(w)):
            return None
        judged = [(b, b.judge(state)[1]) for b in list(self._network.batches)[-MOST_JUDGED:]]
        rays = [b.rays for b, _ in judged]
        firsts = np.cumsum([0, *(b.n_points for b, _ in judged[:-1])]).tolist()
        time_s = np.concatenate([r.time_s for r in rays])
        order = np.argsort(time_s, kind="stable")
        point = np.concatenate([r.point + first for first, r in zip(firsts, rays, strict=True)])
        w = np.clip(np.concatenate([s.w for _, s in judged]), -OUTLYING, OUTLYING)
        redundancy = np.concatenate([s.redundancy for _, s in judged])
        pixel, sigma = _pixel_and_sigma(rays)
        return Residuals(time_s[order], point[order], w[order], redundancy[order], pixel, sigma / sigmas.image)

    def restate(self, found: Residuals) -> bool:
        """State the noise of looks as residuals ask for; whether it changed."""
        sigmas, noise, pixel, sigma = self._network.sigmas, self._network.pose_noise, found.pixel, found.sigma_px
        share, deviation = found.in_common(0.0, TOGETHER_S)
        significant = share > (STILL_SIGNIFICANT if noise.vibration else SIGNIFICANT) * deviation
        self._shared = max(share if significant else 0.0, SHARE_KEPT * self._shared)
        self._of_the_image |= share + SURELY * deviation < VIBRATES
        total = (sigma * sigmas.image) ** 2 + (noise.vibration / pixel) ** 2
        wanted = total * min(max(found.ratio, MOST_DOWN**2), MOST_UP**2)
        return self.state(wanted, pixel, sigma)

    def state(self, variance: float, pixel: float, sigma_px: float) -> bool:
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
        as_before = bool((now == before).all() or (little and now.max() > 1.0))
        if not as_before:
            sigmas.image, noise.vibration = image, vibration
            sigmas.version += 1
        self._of_the_image &= sigmas.image > 1.0  # else there is nothing unstated, or it is known to be a vibration
        doubtful = sigmas.image > MAY_VIBRATE and not self._of_the_image
        unstated = pixel * sigma_px * float(np.sqrt(sigmas.image**2 - 1.0))
        noise.possible_vibration = unstated if doubtful else noise.vibration
        return not as_before

    def note_vibration(self, now_s: float) -> None:
        """Note what is known now of a vibration of the attitude."""
        noise = self._network.pose_noise
        resolved = self._of_the_image or noise.vibration > 0.0
        possible = None if resolved else noise.possible_vibration
        self._network.vibrations.note(now_s, noise.vibration, possible)


@dataclass(frozen=True)
class Residuals:
    """Residuals of n looks in the order of their times.

    Attributes
    ----------
    time_s, point : (n,)
    w, redundancy : (n, 2) normalised residuals of line and sample, and their redundancy numbers
    pixel, sigma_px : angle that a pixel subtends, rad, and the stated sigma of a sample
    """

    time_s: Array
    point: IntArray
    w: Array
    redundancy: Array
    pixel: float
    sigma_px: float

    @property
    def ratio(self) -> float:
        """Median of the squares over that of right sigmas."""
        return float(np.median(self.w[self.redundancy > LEAST_CONTROLLED] ** 2) / median_square(1))

    def last(self) -> bool:
        """Whether what looks have in common lasts longer than a vibration: then it is a wander of the trajectory."""
        share, deviation = self.in_common(*APART_S)
        return share > max(LASTING, SIGNIFICANT * deviation)

    def in_common(self, least_s: float, most_s: float) -> tuple[float, float]:
        """Share of the variance that looks at different points have in common which are so far apart in time, and its
        standard deviation where they have nothing in common; 0 and infinity from too few looks.

        Of two residuals with redundancy numbers r1, r2 and a noise of variance A in common, the product has the
        expectation ``r1 r2 A``: the rest of the noise is taken by the points.
        """
        a = np.arange(len(self.time_s))
        b = np.maximum(np.searchsorted(self.time_s, self.time_s + least_s), a + 1)
        a, b = a[b < len(a)], b[b < len(a)]
        near = (self.time_s[b] - self.time_s[a] < most_s) & (self.point[a] != self.point[b])
        a, b = a[near], b[near]
        if len(a) < LEAST_PAIRS:
            return 0.0, np.inf
        w, r = self.w, self.redundancy[a] * self.redundancy[b]
        square = float(np.sum(r**2))
        found, noise = float(np.sum(w[a] * w[b] * r**1.5)), float(np.sqrt(np.sum(r**3)))
        total = float(np.sum(w**2 * self.redundancy) / np.sum(self.redundancy))
        return min(found / square / total, 1.0), noise / square


def _median_ratio(w: Array) -> float:
    """Median of the squares of normalised residuals over that of right sigmas; 1 where there are too few."""
    return float(np.median(w**2) / median_square(1)) if len(w) >= LEAST_LOOKS else 1.0


def _pixel_and_sigma(rays: Sequence[Rays]) -> tuple[float, float]:
    """Angle that a pixel subtends, rad, and the sigma of a sample as it is stated now, pixels: medians of rays."""
    pixel = np.concatenate([np.linalg.norm(r.pitch_mm, axis=1) / r.focal_length_mm for r in rays])
    return float(np.median(pixel)), float(np.median(np.concatenate([r.sigma_sample_px for r in rays])))
