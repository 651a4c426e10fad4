"""What is known beforehand of the slow errors of a measured trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .gauss_markov import autocorrelation, damping_rate

Array = NDArray[np.floating]
Three = tuple[float, float, float]
_NONE: Three = (0.0, 0.0, 0.0)
#: A filter that learns none of the six components of an orientation.
NOTHING_LEARNT = (False,) * 6

#: A pose variance more than this many times what was said beforehand is clearly larger.
VARIANCE_EXCEEDS = 1.5
#: A variance that has become so many times smaller is that of another error.
MUCH_LESS = 4.0
#: Of what a pose is more uncertain by, this share of the standard deviation may wander.
WANDERING_SHARE = 1.0
#: If smoothing takes off this share of a variance, the filter learns: its errors are no constants.
LEARNT_SHARE = 0.02
#: Correlation time of the errors of a trajectory whose filter still learns, s: about the lag of its smoother, which
#: says something else with every second of data that it has more. Judged over seeds by bench/apriori.py. Its bound:
#: where a turn right after a strip shows the heading at once, the last seconds of smoothed poses change by more than
#: that, and single flights are several sigma off in kappa there.
LEARNING_TIME_S = 6.0
#: Correlation time of what a smoother takes back of a position, s: a random walk from one smoothing to the next, each
#: second, over a lag of 5 s; a process with a continuous slope that varies as much from second to second has this one.
TAKEN_BACK_TIME_S = 4.0
#: Between two smoothings, s (one on line, two where answers are not wanted early), the GNSS becomes another by so much;
#: no more is taken back. What smoothed positions change by within some seconds is compared with it over seeds by
#: bench/pose_changes.py.
TAKEN_BACK_WITHIN_S = 1.5

#: A wander that nobody stated is this share of the sigmas of the constant errors, but no more than so many metres, and
#: pixels of attitude; its correlation time, s. Tuned in flights whose wander is not stated, and is there or not: half
#: and double the share cost nothing where there is none, and find one that is there less well, as 30 s do; 8 s cost.
UNSTATED_SHARE, MOST_UNSTATED_M, MOST_UNSTATED_PX, UNSTATED_TIME_S = 0.25, 0.05, 0.3, 15.0

#: No pose has less white noise than this, m and rad.
LEAST_NOISE = (1e-3, 1e-6)


@dataclass(frozen=True)
class SlowErrors:
    """A-priori sigmas; X, Y, Z in metres, omega, phi, kappa in radians.

    Attributes
    ----------
    offset_m, shift : constant over a strip
    drift : change of omega, phi, kappa from the first line of a strip to the last
    wander_m, wander : wander of position and attitude
    wander_time_s : correlation time of the wander (see `gauss_markov`)
    attitude_time_s : of the attitude's, where it is another one; 0 = the same
    """

    offset_m: Three = _NONE
    shift: Three = _NONE
    drift: Three = _NONE
    wander_m: Three = _NONE
    wander: Three = _NONE
    wander_time_s: float = 60.0
    attitude_time_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value).all() and (np.asarray(value) >= 0).all()):
                raise ValueError(f"{name}: wanted sigmas not below 0, got {value}")
        if not self.wander_time_s > 0:
            raise ValueError(f"wander_time_s: wanted more than 0 s, got {self.wander_time_s}")

    @property
    def wander_times_s(self) -> Array:
        """(6,) correlation times of the wander."""
        return np.repeat([self.wander_time_s, self.attitude_time_s or self.wander_time_s], 3)

    @property
    def is_learnt(self) -> bool:
        """Whether its fastest wander is nearer to what a filter learns than to what is stated."""
        return float(self.wander_times_s.min()) < 2.0 * LEARNING_TIME_S

    @property
    def alike(self) -> SlowErrors:
        """With one correlation time, the shorter one: for models that have no other."""
        return replace(self, wander_time_s=float(self.wander_times_s.min()), attitude_time_s=0.0)

    def wandered(self, seconds: float) -> Array:
        """(6,) variance by which the wander moves away from where it was so long before."""
        sigma = np.concatenate([self.wander_m, self.wander])
        return 2.0 * sigma**2 * -np.expm1(-seconds / self.wander_times_s)

    @property
    def attitude_sigma(self) -> Array:
        """(3,) of omega, phi, kappa together; of the drift all, since a filter knows nothing of strips."""
        return np.sqrt(np.square(self.shift) + np.square(self.drift) + np.square(self.wander))

    @property
    def position_sigma(self) -> Array:
        """(3,) of X, Y, Z together."""
        return np.sqrt(np.square(self.offset_m) + np.square(self.wander_m))

    def with_some_wander(self, pixel: float) -> SlowErrors:
        """With a little wander in place of what nobody stated: few trajectories have none, and one of zero cannot be
        found to be larger.

        Parameters
        ----------
        pixel : angle that a pixel of the camera subtends, rad
        """
        a, b, c = (min(UNSTATED_SHARE * v, MOST_UNSTATED_M) for v in self.offset_m)
        d, e, f = (min(UNSTATED_SHARE * v, MOST_UNSTATED_PX * pixel) for v in self.shift)
        return replace(self, wander_m=(a, b, c), wander=(d, e, f), wander_time_s=UNSTATED_TIME_S, attitude_time_s=0.0)

    @property
    def wander_density(self) -> Array:
        """(6,) ``s`` of the wander's spectral density ``s / w^4`` at frequencies high against its correlation time."""
        b = np.array([damping_rate(time_s) for time_s in self.wander_times_s.tolist()])
        return 4.0 * b**3 * np.square([*self.wander_m, *self.wander])

    def widened(self, covariance: Array, learnt: Sequence[bool] = NOTHING_LEARNT) -> SlowErrors:
        """With what the covariance (6, 6) of a pose at the start of a strip says more; no sigma becomes smaller.

        A filter's error at one time is an error for long: its excess is a constant over the strip. It may all be gone
        when the strip ends, since the filter learns on the way, so the excess is the drift's too (the position's is in
        offset and wander); the way it goes is not straight, so a part of it wanders, and faster than the rest.

        The position's error is still the slow one of the GNSS, but from second to second the filter takes more or less
        of it for true (`with_taken_back`).

        Parameters
        ----------
        learnt : (6,) which components the filter still learns, whatever its covariance. Where it learns the attitude,
            too, that wanders as fast as it learns; an attitude that is measured wanders as stated
        """
        variance = np.diagonal(np.asarray(covariance, dtype=float))
        told = np.concatenate([self.position_sigma, self.attitude_sigma]) ** 2
        excess = np.where(variance > VARIANCE_EXCEEDS * told, variance - told, 0.0)
        if not (excess.any() or any(learnt)):
            return self

        def more(sigma: Three, part: Array, share: float = 1.0) -> Three:
            a, b, c = np.sqrt(np.square(sigma) + share**2 * part).tolist()
            return (a, b, c)

        m, rad = excess[:3], excess[3:]
        inertial = self.with_taken_back()
        wander_m, position_s = joined(inertial.wander_m, inertial.wander_time_s, m, LEARNING_TIME_S)
        return SlowErrors(
            more(self.offset_m, m),
            more(self.shift, rad),
            more(self.drift, rad),
            wander_m,
            more(self.wander, rad, WANDERING_SHARE),
            position_s,
            self._learnt_s if rad.any() or any(learnt[3:]) else inertial.attitude_time_s,
        )

    def with_taken_back(self) -> SlowErrors:
        """With what a filter that learns takes back of its positions from one smoothing to the next, beside their
        wander: no more than this becomes another by in that time; see `joined`."""
        another = 1.0 - float(autocorrelation(self.wander_time_s, TAKEN_BACK_WITHIN_S)) ** 2
        taken_back = another * np.square(self.wander_m)
        wander_m, position_s = joined(self.wander_m, self.wander_time_s, taken_back, TAKEN_BACK_TIME_S)
        return replace(self, wander_m=wander_m, wander_time_s=position_s, attitude_time_s=float(self.wander_times_s[3]))

    @property
    def _learnt_s(self) -> float:
        """Correlation time of an attitude that is learnt."""
        return min(float(self.wander_times_s[3]), LEARNING_TIME_S)

    def grown(self, covariance: Array) -> SlowErrors:
        """With what the covariance (6, 6) of a pose in the middle of a strip says more: of the wander alone.

        Offset, shift and drift are those of the whole strip; what comes later is none of them.
        """
        variance = np.diagonal(np.asarray(covariance, dtype=float))
        told = np.concatenate([self.position_sigma, self.attitude_sigma]) ** 2
        excess = np.where(variance > VARIANCE_EXCEEDS * told, variance - told, 0.0)
        if not excess.any():
            return self
        a, b, c = np.sqrt(np.square(self.wander) + excess[3:]).tolist()
        wander_m, position_s = joined(self.wander_m, self.wander_time_s, excess[:3], LEARNING_TIME_S)
        attitude_s = self._learnt_s if excess[3:].any() else float(self.wander_times_s[3])
        return replace(self, wander_m=wander_m, wander=(a, b, c), wander_time_s=position_s, attitude_time_s=attitude_s)

    def differs(self, other: SlowErrors) -> bool:
        """Whether another wander is clearly larger, or so much smaller that a new one has begun."""
        ratio = np.array([*other.wander_m, *other.wander]) / np.maximum([*self.wander_m, *self.wander], 1e-9)
        return bool((ratio**2 > VARIANCE_EXCEEDS).any() or (ratio**2 < 1.0 / MUCH_LESS).any())

    def without(self, covariance: Array, least: tuple[float, float] = LEAST_NOISE) -> Array:
        """The white part of pose covariances (..., 6, 6): what is left without slow errors, `least` (m, rad) at least.

        Correlation coefficients are kept between components of which something is left.
        """
        slow = np.concatenate([self.position_sigma, self.attitude_sigma]) ** 2
        floor = np.repeat(np.square(least), 3)
        rest = np.array(covariance, dtype=float)
        variance = np.einsum("...ii->...i", rest).copy()
        left = np.maximum(variance - slow, floor)
        share = np.sqrt(left / np.maximum(variance, floor))  # rows and columns alike, so that it stays a covariance
        rest *= share[..., :, None] * share[..., None, :]
        np.einsum("...ii->...i", rest)[...] = left
        too_small = left <= floor
        off = too_small[..., :, None] | too_small[..., None, :]
        rest[off & ~np.eye(6, dtype=bool)] = 0.0
        return rest


def joined(sigma: Three, time_s: float, fast: Array, fast_s: float) -> tuple[Three, float]:
    """Standard deviations and correlation time of one wander in place of two, a slow and a fast one.

    It has the spectral density of both together at low frequencies (the variance times the correlation time), so that
    no mean over a long strip and no trend is stated too certain, and at high ones (`SlowErrors.wander_density`), so
    that it can go wherever they go; its variance is larger than theirs. As fast as the component needs that has most of
    the fast one.

    Parameters
    ----------
    sigma, time_s : of the slow one
    fast, fast_s : (3,) variances of the fast one, and its correlation time
    """
    slow = np.square(sigma)
    if not (fast > 0.0).any() or time_s <= fast_s:
        a, b, c = np.sqrt(slow + fast).tolist()
        return (a, b, c), time_s
    low = slow * time_s + fast * fast_s
    high = slow / time_s**3 + fast / fast_s**3
    joined_s = float((low[fast > 0.0] / high[fast > 0.0]).min() ** 0.25)
    a, b, c = np.sqrt(low / joined_s).tolist()
    return (a, b, c), joined_s
