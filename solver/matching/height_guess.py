"""How high the ground is, from the points found so far."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.floating]

#: Heights that are kept, and how many neighbours a guess takes.
KEPT, NEIGHBOURS = 1000, 6
#: The ground rises so much over a distance, 1 sigma.
SLOPE = 0.06


@dataclass
class HeightGuess:
    """A guess from neighbours, or the prior where there are none.

    Attributes
    ----------
    prior_m, prior_sigma_m : of heights of which nothing is known
    lowest_m : the lowest ground that is looked for
    unknown : nobody has said how high the ground is, and it has not been found yet
    """

    prior_m: float
    prior_sigma_m: float
    lowest_m: float = 0.0
    unknown: bool = False
    _points: Array = field(default_factory=lambda: np.empty((0, 3)))
    _tree: KDTree | None = None  # of the points, once they are asked for

    @property
    def some(self) -> bool:
        """Whether the heights of enough points are known to guess others from."""
        return len(self._points) >= 3

    def say(self, height_m: float) -> None:
        """The ground is about so high."""
        self.prior_m, self.unknown = height_m, False

    def lose(self, lowest_m: float) -> None:
        """The ground has to be looked for, from a lowest height on: it is not where it is thought to be."""
        if len(self._points):
            self.prior_m = float(np.median(self._points[-KEPT:, 2]))
        self._points, self._tree = np.empty((0, 3)), None
        self.lowest_m, self.unknown = min(lowest_m, self.prior_m), True

    def found(self, xyz_l: Array) -> None:
        """Points (n, 3) show where the ground is."""
        self.say(float(np.median(xyz_l[:, 2])))
        self.add(xyz_l)

    def add(self, xyz_l: Array) -> None:
        """Points (n, 3) that were found."""
        self._points, self._tree = np.concatenate([self._points, xyz_l])[-KEPT:], None

    def at(self, xy: Array) -> tuple[Array, Array]:
        """Heights (n,) and their sigma (n,) at places (n, 2)."""
        if not self.some:
            return np.full(len(xy), self.prior_m), np.full(len(xy), self.prior_sigma_m)
        tree = self._tree = self._tree or KDTree(self._points[:, :2])
        d, near = map(np.asarray, tree.query(xy, k=min(NEIGHBOURS, len(self._points))))
        z = self._points[near, 2]
        w = 1.0 / (d + 1e-3 * d.max() + 1e-6) ** 2
        w /= w.sum(axis=1, keepdims=True)
        height = np.sum(w * z, axis=1)
        spread = np.sum(w * (z - height[:, None]) ** 2, axis=1)
        sigma = np.sqrt(spread + (SLOPE * d.min(axis=1)) ** 2)
        return height, np.minimum(sigma, self.prior_sigma_m)
