"""Drifts of tie points as quantities beside the unknowns: in one batch, and their effect on a solution once named.

Each group of rays, those of one source on one CCD line, has four drift unknowns, which are held at zero (`Border`).
With the effect ``B`` of a drift ``b`` on whitened residuals ``v``, and S that projects out the object points, the
scores are ``s = sum B^T S (v + A theta)``, the coupling to the unknowns is ``M = sum B^T S A``, and the normal matrix
``sum B^T S B``.

In a window, the drifts of the strip that is flown have the numbers -1, -2, ... wherever they stand beside unknowns of
the state. In a block of strips they are unknowns as others are, but for their numbers (`of_block`) and that they are
held at zero until they are named.

A drift that has been named is estimated with the unknowns, with what is known of it beforehand, P: it is
``b = (V + P)^-1 s`` with ``V = sum B^T S B - M Q M^T``, and the unknowns and their cofactors become

    theta - Q M^T b,        Q + Q M^T (V + P)^-1 M Q.

So the orientation is what it would be with a bias and a drift of every group that may be the one as unknowns, and its
covariance says how badly that is known where several cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...adjustment.drift_hypotheses import EACH
from ...arrays import Array, IntArray
from ..state.batch import Information
from ..state.unknowns import Border

#: Groups of a strip at most; rays of further groups are not watched. Bounds the border to 64 quantities.
MOST_GROUPS = 16


@dataclass(frozen=True)
class Cell:
    """Drifts of the rays of one batch of p points and n rays, with k unknowns.

    Attributes
    ----------
    information, weight : what the batch was when this was computed
    strip : place of the strip
    places : (k,) of the unknowns among those of the strip
    border : the unknowns beside those of the batch, at theta = 0
    rays : (MOST_GROUPS,) how many rays each group has
    shares : (2,) of the variance of a ray that are noise of its position and a vibration of its attitude, summed over
        the rays
    effect : (n, 2, k) of the unknowns on the whitened residuals
    coupling : (p, 3, k) how the points hang on the unknowns, see `Batch.coupling`
    """

    information: Information
    weight: Array
    strip: int
    places: IntArray
    border: Border
    rays: IntArray
    shares: Array
    effect: Array
    coupling: Array

    @property
    def of_block(self) -> IntArray:
        """Numbers of the unknowns (k,), see `of_block`."""
        return of_block(self.strip, self.places)

    def on_rays(self, rays: range) -> Array:
        """Effect of the unknowns on the whitened residuals of m rays (2 m, k)."""
        return self.effect[rays].reshape(2 * len(rays), -1)


def of_block(strip: int, places: IntArray) -> IntArray:
    """Numbers (k,) of a strip's drift unknowns at places (k,) beside those of a block of strips: negative ones."""
    return -1 - (strip * MOST_GROUPS * EACH + places)


def estimated(score: Array, V: Array, sigma: Array) -> tuple[Array, Array]:
    """Unknowns (k,) of a drift, and their covariance (k, k).

    Parameters
    ----------
    score, V : scores at the solution without them, and their cofactors, of the same data
    sigma : (k,) beforehand
    """
    # the rounding of a difference of large numbers does not make it negative
    values, vectors = np.linalg.eigh(0.5 * (V + V.T) * sigma[:, None] * sigma)
    root = sigma[:, None] * vectors / np.sqrt(np.maximum(values, 0.0) + 1.0)
    covariance = root @ root.T
    return covariance @ score, covariance


@dataclass(frozen=True)
class Named:
    """What drifts in a strip.

    Attributes
    ----------
    strip : place of the strip
    rows, sigma : unknowns (k,) of its border, and what they may be beforehand
    """

    strip: int
    rows: IntArray
    sigma: Array


@dataclass(frozen=True)
class Compensation:
    """Change of a solution with n unknowns by a drift with k.

    Attributes
    ----------
    through : (n, k) ``Q M^T``
    drift, covariance : (k,), (k, k)
    """

    through: Array
    drift: Array
    covariance: Array

    def change(self, functions: Array, places: IntArray) -> tuple[Array, Array]:
        """Change (..., m) of linear functions (..., m, u) of the unknowns at places (u,), and of their covariance."""
        G = functions @ self.through[places]
        return -G @ self.drift, G @ self.covariance @ np.swapaxes(G, -1, -2)
