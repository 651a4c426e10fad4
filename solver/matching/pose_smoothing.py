"""Measured poses without their white noise, as far as the motion is smooth enough to tell the two apart.

Lines come several times as fast as poses. White noise of the poses bends patches, and puts a measured place where one
noisy pose sees it. A cubic through the neighbours of each pose (Savitzky-Golay) takes most of it away; how many
neighbours may help is learnt from the data.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import (
    quaternion_conjugate,
    quaternion_from_vector,
    quaternion_multiply,
    vector_from_quaternion,
)

Array = NDArray[np.floating]

#: Neighbours on each side that are tried, most first; poses come out this many late.
REACHES = (8, 4, 2)
#: What is learnt is an average over so many poses. Motion is smooth enough if it adds less than this to the noise.
MEMORY, LARGEST_EXCESS = 200, 1.5
#: Fourth differences of white noise have 70 times its variance; those of smooth motion vanish (derived).
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)


def centre_weights(reach: int) -> Array:
    """(2 reach + 1,) weights of a cubic's value in the middle."""
    j = np.arange(-reach, reach + 1.0)
    design = np.stack([np.ones_like(j), j * j], axis=1)
    return np.linalg.solve(design.T @ design, design.T)[0]


class PoseSmoother:
    """Poses in, smoothed poses out, eight poses later."""

    def __init__(self) -> None:
        self._queue: deque[tuple[float, Array, Array, Array]] = deque(maxlen=2 * REACHES[0] + 1)
        self._weights = [centre_weights(reach) for reach in REACHES]
        self._noise = np.zeros(6)
        self._left = np.zeros((len(REACHES), 6))
        self._seen = 0

    @property
    def reach(self) -> tuple[int, int]:
        """Neighbours on each side that are used now, for position and for attitude."""
        return self._reach(slice(0, 3)), self._reach(slice(3, 6))

    @property
    def noise_left(self) -> Array:
        """(6,) variance of the white noise that is left in position, m^2, and attitude about camera axes, rad^2."""
        share = [float(self._weights[REACHES.index(r)][r]) if r else 1.0 for r in self.reach]
        return np.repeat(share, 3) * self._noise

    def push(
        self, time_s: float, position_l: Array, quaternion: Array, covariance: Array
    ) -> tuple[float, Array, Array, Array] | None:
        """Add a pose; returns the one that is known now, the first eight as they came; None for lack of neighbours."""
        self._queue.append((time_s, position_l, quaternion, covariance))
        n, most = len(self._queue), REACHES[0]
        if n < 2 * most + 1:
            return self._queue[n - 1 - most] if n > most else None
        centre = self._queue[most]
        times = np.array([pose[0] for pose in self._queue])
        steps = np.diff(times)
        if np.ptp(steps) > 0.05 * steps.mean():
            return centre
        near = np.empty((n, 6))
        near[:, :3] = np.stack([pose[1] for pose in self._queue]) - centre[1]
        turns = quaternion_multiply(quaternion_conjugate(centre[2])[None], np.stack([pose[2] for pose in self._queue]))
        near[:, 3:] = vector_from_quaternion(turns)
        # a pose's own noise is in what is left of it; the mean motion drops out of both
        moved = np.stack(
            [w @ near[most - reach : most + reach + 1] for w, reach in zip(self._weights, REACHES, strict=True)]
        )
        self._learn(FOURTH @ near[most - 2 : most + 3], moved)
        position, attitude = self.reach
        shift = moved[REACHES.index(position), :3] if position else np.zeros(3)
        turn = moved[REACHES.index(attitude), 3:] if attitude else np.zeros(3)
        return centre[0], centre[1] + shift, quaternion_multiply(centre[2], quaternion_from_vector(turn)), centre[3]

    def rest(self) -> list[tuple[float, Array, Array, Array]]:
        """The poses that wait for neighbours, as they came: no more will come."""
        waiting = list(self._queue)[-REACHES[0] :]
        self._queue.clear()
        return waiting

    def _learn(self, fourth: Array, moved: Array) -> None:
        self._seen = min(self._seen + 1, MEMORY)
        share = 1.0 / self._seen
        self._noise += share * (fourth**2 - self._noise)
        self._left += share * (moved**2 - self._left)

    def _reach(self, part: slice) -> int:
        for reach, weights, left in zip(REACHES, self._weights, self._left, strict=True):
            expected = (1.0 - weights[reach]) * self._noise[part]
            if self._seen >= MEMORY // 4 and (left[part] <= LARGEST_EXCESS * expected).all():
                return reach
        return 0
