"""Radiometric balance of overlapping orthoimages: gain, offset and fall-off of each, by least squares.

Where orthoimage ``i`` shows a place of radiance ``L``, its grey value is

    x = a_i (1 + c1 s^2 + c2 s^4) L + b_i + e

with a gain ``a``, an offset ``b`` and the fall-off towards the ends of the CCD line, ``s`` from 0 in its middle to 1 at
either end, which all strips of a camera share. The radiances are unknowns as object points are in a bundle adjustment:
they are eliminated place by place, so that errors of both orthoimages of a pair count alike and a gain is not drawn
towards nothing, as a regression of one on the other would draw it. No overlap can tell the scale of all radiances,
and hardly their zero: the mean gain is 1 (`MEAN_GAIN_SIGMA`) and the mean offset near 0. Places where something moved
count less, the worse they fit, and the worst not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: Sigma with which the mean gain is 1, and the mean offset 0 where no fall-off is estimated: a datum, so small.
MEAN_GAIN_SIGMA = 1e-6
#: Sigma of the mean offset, as a share of the mean grey value, where a fall-off is estimated, which sees it a little.
MEAN_OFFSET_SIGMA = 0.05
#: Sigmas a priori: of a gain, of an offset as a share of the mean grey value, of a coefficient of the fall-off. They
#: keep finite what overlaps do not reach; an overlap of a few places outweighs them.
GAIN_SIGMA, OFFSET_SIGMA, FALL_OFF_SIGMA = 0.5, 0.5, 0.5
#: Places worse than so many sigmas count less, and than so many not at all. Statistical levels (1 %, 0.001 %).
DOUBTED, REFUSED = 2.58, 4.4
#: Grey values are not taken for better than this share of the mean one, else places that agree to the last bit (parts
#: of one image, water of one grey) would leave nothing of the sigmas a priori. Derived: a part of the step of 8 bits.
FINEST = 1e-4
#: With fewer groups of places an orthoimage than this the covariance is that of independent, equal errors.
FEWEST_GROUPS = 6
#: Rounds of the iteration, at most, and the change of a gain that ends it.
ROUNDS, ENOUGH = 40, 1e-7


@dataclass(frozen=True)
class ToneSamples:
    """Mean grey values of places that several orthoimages show; n values of K places.

    Attributes
    ----------
    place : (n,) number of the place, 0 to K - 1
    layer : (n,) which orthoimage
    value : (n,) its grey value there
    off_middle : (n,) s, 0 in the middle of the CCD line to 1 at its ends
    group : (K,) what places are joined to where their errors may be alike (a tile of the mosaic)
    """

    place: IntArray
    layer: IntArray
    value: Array
    off_middle: Array
    group: IntArray


@dataclass(frozen=True)
class ToneBalance:
    """Gain, offset and fall-off of m orthoimages of k cameras.

    Attributes
    ----------
    gain, offset : (m,) grey values = gain * fall-off * radiance + offset
    fall_off : (k, 2) coefficients of s^2 and s^4
    camera : (m,) which camera each orthoimage is of
    covariance : (2 m + 2 k,) squared, of gains, offsets, fall-offs camera by camera
    sigma0 : of the mean grey value of a place
    places, refused : how many there were, and how many did not fit
    tied : (m,) whether an overlap reaches the orthoimage
    """

    gain: Array
    offset: Array
    fall_off: Array
    camera: IntArray
    covariance: Array
    sigma0: float
    places: int
    refused: int
    tied: Mask

    @property
    def gain_sigma(self) -> Array:
        return np.sqrt(np.diag(self.covariance)[: len(self.gain)])

    @property
    def offset_sigma(self) -> Array:
        m = len(self.gain)
        return np.sqrt(np.diag(self.covariance)[m : 2 * m])

    @property
    def relative_offset_sigma(self) -> Array:
        """Sigma of each offset against the mean of all of them, which overlaps hardly see."""
        m = len(self.gain)
        less_mean = np.eye(m) - 1.0 / m
        return np.sqrt(np.diag(less_mean @ self.covariance[m : 2 * m, m : 2 * m] @ less_mean))

    @property
    def mean_offset(self) -> tuple[float, float]:
        """Mean of all offsets, and its sigma."""
        m = len(self.gain)
        return float(self.offset.mean()), float(np.sqrt(self.covariance[m : 2 * m, m : 2 * m].mean()))

    @property
    def fall_off_sigma(self) -> Array:
        return np.sqrt(np.diag(self.covariance)[2 * len(self.gain) :]).reshape(-1, 2)

    def radiance(self, layer: int, value: Array, off_middle: Array) -> Array:
        """Balanced grey values of values of an orthoimage; any shape, float32."""
        s2 = np.square(off_middle, dtype=np.float32)
        c1, c2 = (np.float32(c) for c in self.fall_off[self.camera[layer]])
        scale = np.float32(self.gain[layer]) * (np.float32(1.0) + s2 * (c1 + s2 * c2))
        return (np.asarray(value, dtype=np.float32) - np.float32(self.offset[layer])) / scale

    @classmethod
    def none(cls, camera: IntArray) -> ToneBalance:
        """Grey values as they are."""
        m, k = len(camera), int(camera.max(initial=0)) + 1
        size = 2 * (m + k)
        return cls(
            np.ones(m), np.zeros(m), np.zeros((k, 2)), camera, np.zeros((size, size)), 0.0, 0, 0, np.zeros(m, bool)
        )


def balance(samples: ToneSamples, camera: IntArray, fall_off: Mask) -> ToneBalance:
    """Gains, offsets and fall-offs from places that several orthoimages show.

    The covariance is that of the estimate with the residuals themselves (of groups of places, whose errors may be
    alike) in place of an assumed noise, so that it holds where places differ in how well they fit.

    Parameters
    ----------
    samples : places with at least two orthoimages each
    camera : (m,) camera of each orthoimage, 0 to k - 1
    fall_off : (k,) which cameras have a fall-off to estimate

    Raises
    ------
    ValueError : no place at all
    """
    m, k = len(camera), len(fall_off)
    K = len(samples.group)
    if not K:
        raise ValueError("no place is shown by two orthoimages")
    x, i, place = samples.value, samples.layer, samples.place
    level = float(np.median(x))
    s2 = samples.off_middle**2
    powers = np.stack([s2, s2 * s2], axis=1)
    cam = camera[i]
    estimated = fall_off[cam]
    columns = np.column_stack([i, m + i, 2 * m + 2 * cam, 2 * m + 2 * cam + 1])
    size = 2 * (m + k)
    theta = np.concatenate([np.ones(m), np.zeros(m + 2 * k)])
    prior, prior_rhs_at = _prior(m, fall_off, level)
    of_place = csr_array((np.ones(len(x)), (place, np.arange(len(x)))), shape=(K, len(x)))
    seen = np.maximum(np.bincount(place, minlength=K), 1)
    radiance = (of_place @ x) / seen
    weight = np.ones(K)
    scale, N, moved = 1.0, prior, np.inf
    rows = np.arange(len(x))
    A = csr_array((len(x), size))
    residual, slope = np.zeros(len(x)), np.ones(len(x))
    for _ in range(ROUNDS):
        a, b, c = theta[:m], theta[m : 2 * m], theta[2 * m :].reshape(k, 2)
        shape = 1.0 + (powers * c[cam]).sum(axis=1)
        slope = a[i] * shape
        # the best radiance of each place with these parameters
        radiance = (of_place @ (slope * (x - b[i]))) / (of_place @ slope**2)
        L = radiance[place]
        residual = x - b[i] - slope * L
        free = np.maximum(seen - 1, 1)
        misfit = np.sqrt((of_place @ residual**2) / free)
        scale = max(1.4826 * float(np.median(misfit)), FINEST * max(level, 1.0))
        worth = misfit / scale
        weight = np.where(worth > REFUSED, 0.0, np.where(worth > DOUBTED, DOUBTED / np.maximum(worth, 1e-12), 1.0))
        if moved < ENOUGH:
            break
        w = weight[place] / scale**2
        values = np.column_stack([shape * L, np.ones(len(x)), *((a[i] * L * estimated)[:, None] * powers).T])
        A = csr_array((values.ravel(), (np.repeat(rows, 4), columns.ravel())), shape=(len(x), size))
        N, n = _reduced(A, slope, residual, w, of_place)
        N = N + prior
        n = n + prior @ (prior_rhs_at - theta)
        step = np.linalg.solve(N, n)
        theta = theta + step
        moved = float(np.abs(np.concatenate([step[:m], step[m : 2 * m] / max(level, 1.0), step[2 * m :]])).max())
    covariance = _sandwich(A, slope, residual, weight[place] / scale**2, of_place, samples.group, N, prior)
    if len(np.unique(samples.group)) < FEWEST_GROUPS * m:
        covariance = np.linalg.inv(N)  # too few groups for their scatter to tell anything
    used = weight[place] > 0
    redundancy = max(int(used.sum()) - int((weight > 0).sum()) - 2 * m, 1)
    sigma0 = float(np.sqrt((weight[place] * residual**2).sum() / redundancy))
    tied = np.bincount(i[used], minlength=m) > 0
    return ToneBalance(
        theta[:m], theta[m : 2 * m], theta[2 * m :].reshape(k, 2), camera, covariance, sigma0, K,
        int((weight == 0).sum()), tied,
    )  # fmt: skip


def held_out(samples: ToneSamples, camera: IntArray, fall_off: Mask) -> float:
    """How much better places agree with a balance that they are no part of, times as well as without any.

    Places of every second group are balanced by those of the others, and the other way round. Where orthoimages show
    what they have in common the value is large; it is below 1 where a balance would do harm: of too few places, or of
    pictures that do not show the same ground.

    Parameters
    ----------
    samples, camera, fall_off : as for `balance`
    """
    group = np.unique(samples.group, return_inverse=True)[1]
    if group.max(initial=0) == 0:  # neighbours stay together
        group = np.arange(len(group)) * 4 // max(len(group), 1)
    K = len(group)
    raw, balanced = np.zeros(K), np.zeros(K)
    for half in (0, 1):
        out = group % 2 == half
        if out.all() or not out.any():
            continue
        found = balance(_of_places(samples, ~out), camera, fall_off)
        layers = samples.layer
        toned = np.empty(len(layers))
        for layer in np.unique(layers).tolist():
            of = layers == layer
            toned[of] = found.radiance(layer, samples.value[of], samples.off_middle[of])
        raw[out], balanced[out] = (_misfit(samples.place, v, K)[out] for v in (samples.value, toned))
    finest = FINEST * max(float(np.median(samples.value)), 1.0)
    return max(float(np.median(raw)), finest) / max(float(np.median(balanced)), finest)


def _of_places(samples: ToneSamples, chosen: Mask) -> ToneSamples:
    """The samples of some of the places."""
    of = chosen[samples.place]
    number = np.cumsum(chosen) - 1
    return ToneSamples(
        number[samples.place[of]], samples.layer[of], samples.value[of], samples.off_middle[of], samples.group[chosen]
    )


def _misfit(place: IntArray, value: Array, places: int) -> Array:
    """By how much the values of each place (K,) differ from their mean."""
    seen = np.maximum(np.bincount(place, minlength=places), 1)
    mean = np.bincount(place, value, places) / seen
    return np.sqrt(np.bincount(place, (value - mean[place]) ** 2, places) / np.maximum(seen - 1, 1))


def _prior(m: int, fall_off: Mask, level: float) -> tuple[Array, Array]:
    """Information a priori and the values that it holds: datum, and what keeps unknowns without overlap finite."""
    k = len(fall_off)
    level = max(abs(level), 1e-6)
    of_fall_off = np.repeat(np.where(fall_off, FALL_OFF_SIGMA, MEAN_GAIN_SIGMA), 2)
    sigma = np.concatenate([np.full(m, GAIN_SIGMA), np.full(m, OFFSET_SIGMA * level), of_fall_off])
    N = np.diag(sigma**-2)
    mean_offset = level * (MEAN_OFFSET_SIGMA if fall_off.any() else MEAN_GAIN_SIGMA)
    N[:m, :m] += 1.0 / (m * MEAN_GAIN_SIGMA) ** 2
    N[m : 2 * m, m : 2 * m] += 1.0 / (m * mean_offset) ** 2
    return N, np.concatenate([np.ones(m), np.zeros(m + 2 * k)])


def _reduced(A: csr_array, slope: Array, residual: Array, w: Array, of_place: csr_array) -> tuple[Array, Array]:
    """Normal equations of the parameters after the radiances are eliminated."""
    weighted = A * w[:, None]
    B, inverse, cross = _of_radiances(A, slope, w, of_place)
    N = (A.T @ weighted).toarray() - (cross.T @ (cross * inverse[:, None])).toarray()
    n = np.asarray(weighted.T @ residual) - np.asarray(cross.T @ (inverse * (B @ residual)))
    return N, n


def _of_radiances(A: csr_array, slope: Array, w: Array, of_place: csr_array) -> tuple[Any, Array, csr_array]:
    """Normal equations of the radiances, one unknown a place: design by weights (places by values), the inverse of
    their own part (places,), and the part that they share with the parameters (places by parameters)."""
    B = of_place * (slope * w)[None, :]
    own = of_place @ (slope**2 * w)
    return B, np.where(own > 0, 1.0 / np.where(own > 0, own, 1.0), 0.0), csr_array(B @ A)


def _sandwich(
    A: csr_array, slope: Array, residual: Array, w: Array, of_place: csr_array, group: IntArray, N: Array, prior: Array
) -> Array:
    """Covariance: inverse normal equations around the scatter of the scores of groups, and the information a priori."""
    B, inverse, cross = _of_radiances(A, slope, w, of_place)
    score = csr_array(of_place @ (A * (w * residual)[:, None])) - cross * (inverse * (B @ residual))[:, None]
    groups, at = np.unique(group, return_inverse=True)
    join = csr_array((np.ones(len(group)), (at, np.arange(len(group)))), shape=(len(groups), len(group)))
    scores = csr_array(join @ score).toarray()
    few = len(groups) / max(len(groups) - 1, 1)
    Q = np.linalg.inv(N)
    return Q @ (few * (scores.T @ scores) + prior) @ Q
