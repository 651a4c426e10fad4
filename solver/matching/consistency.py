"""Do the views of a point agree with each other, and with their neighbours?

Whatever the orientation has wrong shifts one view against another by an amount that varies slowly in time and across
the image. A wrong match does not follow it. The same slow amount improves the prediction of the next matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .robust_plane import robust_plane

Array = NDArray[np.floating]

#: A match that is off by so many robust standard deviations is wrong; and by how many pixels at least, before it is.
LIMIT_SIGMA, LEAST_LIMIT_PX = 3.5, 0.5
#: Matches are judged together with those of so many seconds before, and not before there are so many. Many points tell
#: in a shorter time what is slow: no more of the past than so many.
MEMORY_S, FEWEST, MOST = 4.0, 10, 40
#: If a larger share of new matches is off, it is not they who are wrong.
OUTVOTED = 0.5
#: Robust standard deviations are never smaller than this, px.
LEAST_SCALE_PX = 0.05


@dataclass(frozen=True)
class Disagreement:
    """What is left of the shifts of k points once each has got its height.

    Attributes
    ----------
    time_s : (k,) when the master view saw it
    across : (k,) place across the image, -1 to 1
    residual : (k, views, 2) along and across, px; NaN where a view has no match
    """

    time_s: Array
    across: Array
    residual: Array

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, chosen: Any) -> Disagreement:
        """Some of the points."""
        return Disagreement(self.time_s[chosen], self.across[chosen], self.residual[chosen])


def height_of(shift: Array, parallax: Array, weight: Array) -> tuple[Array, Array]:
    """Height above the guess (k,) and what is left of the shifts (k, views, 2).

    Parameters
    ----------
    shift : (k, views, 2) of each view against the master on the plane of the guessed height; NaN where not matched
    parallax : (k, views, 2) the shift that a metre of height makes
    weight : (k, views)
    """
    known = np.isfinite(shift).min(axis=2)
    w = np.where(known, weight, 0.0)
    d = np.where(known[:, :, None], shift, 0.0)
    top = np.einsum("kv,kvi,kvi->k", w, parallax, d)
    bottom = np.einsum("kv,kvi,kvi->k", w, parallax, parallax)
    height = top / np.maximum(bottom, 1e-12)
    return height, shift - parallax * height[:, None, None]


@dataclass
class SlowDisagreement:
    """The slow part of the disagreement of the last seconds: constant, across the image, and in time.

    Attributes
    ----------
    views : number of views besides the master
    """

    views: int
    _past: list[Disagreement] = field(default_factory=list)
    _fit: Array | None = None
    _scale: Array | None = None
    _middle_s: float = 0.0
    _reach_s: float = MEMORY_S / 2

    def forget(self) -> None:
        """A new strip begins."""
        self._past, self._fit, self._scale = [], None, None

    def suppose(self, shift: Array, scale_px: float) -> None:
        """The same shifts (views, 2), px, everywhere, and how wrong they may be, until points tell how they are."""
        self.forget()
        self._fit = np.stack([shift, np.zeros_like(shift), np.zeros_like(shift)])
        self._scale = np.full(shift.shape, scale_px)

    @property
    def known(self) -> bool:
        return self._fit is not None

    def expected(self, time_s: Array, across: Array) -> Array:
        """(k, views, 2) shifts to be expected, px; zero as long as nothing is known."""
        if self._fit is None:
            return np.zeros((len(time_s), self.views, 2))
        # a trend is not carried on beyond what it was found from
        t = np.clip(np.asarray(time_s) - self._middle_s, -self._reach_s, self._reach_s)
        return np.einsum("kp,pvi->kvi", _design(t, np.asarray(across)), self._fit)

    @property
    def scale_px(self) -> Array:
        """(views, 2) robust standard deviation about the slow part; infinite as long as nothing is known."""
        return np.full((self.views, 2), np.inf) if self._scale is None else self._scale

    def judge(self, new: Disagreement) -> NDArray[np.bool_] | None:
        """Which views (k, views) of new points agree with the rest; None as long as there are too few to tell.

        All points are kept for those to come, also those that do not agree: a few wrong ones do no harm to a robust
        fit, and where the orientation turns faster than before it is followed.
        """
        past = _newest(self._past, float(new.time_s.max())) if len(new) else self._past
        together = _joined([*past, new])
        if len(together) < FEWEST:
            return None
        self._past = [together]
        self._fit_to(together)
        last = np.arange(len(together))[-max(FEWEST, len(new)) :]
        lately = together.select(last)
        if len(lately) < len(together) and _contradicted(lately, self._agree(lately)).mean() > OUTVOTED:
            # the orientation has jumped, as when an adjustment meets its first control: the past says nothing any more
            self._fit_to(lately)
            if _contradicted(lately, self._agree(lately)).mean() < OUTVOTED:
                self._past = [lately]
            else:
                self._fit_to(together)
        return self._agree(new)

    def _fit_to(self, points: Disagreement) -> None:
        """Find the slow part."""
        middle = float(np.median(points.time_s))
        design = _design(points.time_s - middle, points.across)
        fit, scale = np.zeros((3, self.views, 2)), np.full((self.views, 2), np.inf)
        for v in range(self.views):
            for i in range(2):
                fit[:, v, i], scale[v, i] = _robust_fit(design, points.residual[:, v, i])
        self._fit, self._scale, self._middle_s = fit, scale, middle
        self._reach_s = float(np.clip(np.abs(points.time_s - middle).max(), 0.0, MEMORY_S / 2))

    def _agree(self, points: Disagreement) -> NDArray[np.bool_]:
        """Which views (k, views) of points follow the slow part."""
        assert self._fit is not None and self._scale is not None
        slow = np.einsum("kp,pvi->kvi", _design(points.time_s - self._middle_s, points.across), self._fit)
        limit = np.maximum(LIMIT_SIGMA * self._scale, LEAST_LIMIT_PX)
        return np.asarray((np.abs(points.residual - slow) <= limit).all(axis=2))


def _newest(parts: Sequence[Disagreement], now_s: float) -> list[Disagreement]:
    """Points that count at a time."""
    if not parts:
        return []
    kept = _joined(parts)
    since_s = now_s - MEMORY_S
    if len(kept) > MOST:
        since_s = max(since_s, float(np.partition(kept.time_s, -MOST - 1)[-MOST - 1]))
    kept = kept.select(np.flatnonzero(np.greater(kept.time_s, since_s)))
    return [kept] if len(kept) else []


def _contradicted(points: Disagreement, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (k,) have a view that was matched and does not agree."""
    return np.asarray((~good & np.isfinite(points.residual).all(axis=2)).any(axis=1))


def _joined(parts: Sequence[Disagreement]) -> Disagreement:
    return Disagreement(
        np.concatenate([d.time_s for d in parts]),
        np.concatenate([d.across for d in parts]),
        np.concatenate([d.residual for d in parts]),
    )


def _design(t: Array, across: Array) -> Array:
    return np.stack([np.ones_like(t), across, t], axis=1)


def _robust_fit(design: Array, values: Array) -> tuple[Array, float]:
    """Coefficients and robust standard deviation; zero and infinite with too few values."""
    known = np.isfinite(values)
    if known.sum() < FEWEST // 2:
        return np.zeros(design.shape[1]), np.inf
    return robust_plane(design[known], values[known], LEAST_SCALE_PX, 8, slope_weight=0.05)
