"""What a drift of tie points that has been named does to the solution, taken back.

The drift is a border of the normal equations (`sources`): scores ``s`` of its unknowns ``b``, their normal matrix, and
``M``, their coupling to the other unknowns. Estimated with these, with what is known of ``b`` beforehand, it is
``b = (V + P)^-1 s`` with ``V = sum B^T S B - M Q M^T``, and the unknowns and their cofactors become

    theta - Q M^T b,        Q + Q M^T (V + P)^-1 M Q.

So the orientation is what it would be with a bias and a drift of every group that may be the one as unknowns, and its
covariance says how badly that is known where several cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


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
    strip : index
    rows, sigma : unknowns (k,) of its border, and what they may be beforehand
    """

    strip: int
    rows: IntArray
    sigma: Array


@dataclass(frozen=True)
class Border:
    """Unknowns (k,) of a drift beside those of the normal equations.

    Attributes
    ----------
    score, normal : (k,), (k, k), for values 0 of all unknowns
    coupling : (k, u) to unknowns
    sigma : (k,) of the drift's unknowns beforehand
    """

    score: Array
    normal: Array
    coupling: Array
    sigma: Array

    def compensation(self, values: Array, cofactors: Array, places: IntArray) -> Compensation:
        """What it does to a solution of the same data.

        Parameters
        ----------
        values, cofactors : (n,), (n, n) of the solution
        places : (u,) in it, of the unknowns it is coupled to
        """
        through = cofactors[:, places] @ self.coupling.T
        score = self.score - self.coupling @ values[places]
        V = self.normal - self.coupling @ through[places]
        return Compensation(through, *estimated(score, V, self.sigma))


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

    def apply(self, values: Array, cofactors: Array) -> None:
        """Change a solution (n,) with cofactors (n, n) in place."""
        values -= self.through @ self.drift
        cofactors += self.through @ self.covariance @ self.through.T
