"""Measured poses without their white noise, as far as the motion is smooth enough to tell the two apart.

Lines come several times as fast as poses. White noise of the poses bends patches, and puts a measured place where one
noisy pose sees it. A cubic through the neighbours of each pose (Savitzky-Golay) takes most of it away; how many
neighbours may help is learnt from the data.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..geometry.rotation import (
    quaternion_conjugate,
    quaternion_from_vector,
    quaternion_multiply,
    vector_from_quaternion,
)

Array = NDArray[np.floating]
#: Times (n,), positions (n, 3), quaternions (n, 4) and covariances (n, 6, 6) of n poses.
PoseRows = tuple[Array, Array, Array, Array]

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
    """Poses in, smoothed poses out, eight poses later.

    What comes out does not depend on how many are pushed at once; twenty at once take hardly longer than one.
    """

    def __init__(self) -> None:
        #: The newest poses, at most two reaches of them: times, positions, quaternions, covariances.
        self._queue: PoseRows = np.empty(0), np.empty((0, 3)), np.empty((0, 4)), np.empty((0, 6, 6))
        self._weights = [centre_weights(reach) for reach in REACHES]
        self._noise = np.zeros(6)
        self._left = np.zeros((len(REACHES), 6))
        self._seen = 0

    @property
    def reach(self) -> tuple[int, int]:
        """Neighbours on each side that are used now, for position and for attitude."""
        now = self._noise[None], self._left[None], np.array([self._seen])
        return int(self._reaches(*now, slice(0, 3))[0]), int(self._reaches(*now, slice(3, 6))[0])

    @property
    def noise_left(self) -> Array:
        """(6,) variance of the white noise that is left in position, m^2, and attitude about camera axes, rad^2."""
        share = [float(self._weights[REACHES.index(r)][r]) if r else 1.0 for r in self.reach]
        return np.repeat(share, 3) * self._noise

    def push(self, time_s: Array, position_l: Array, quaternion: Array, covariance: Array) -> PoseRows:
        """Add n poses: times (n,), positions (n, 3), quaternions (n, 4), covariances (n, 6, 6).

        Returns
        -------
        PoseRows : those that are known now, in the same columns; the first eight as they came
        """
        most, before = REACHES[0], len(self._queue[0])
        new = time_s, position_l, quaternion, covariance
        t, p, q, C = (np.concatenate([old, more]) for old, more in zip(self._queue, new, strict=True))
        self._queue = t[-2 * most :], p[-2 * most :], q[-2 * most :], C[-2 * most :]
        centre = np.arange(max(before, most), len(t)) - most
        position, attitude = p[centre], q[centre]
        whole = centre >= most  # with all neighbours, which come at even steps
        steps = np.diff(t)
        if whole.any():
            near = np.ascontiguousarray(sliding_window_view(steps, 2 * most)[centre[whole] - most])
            whole[whole] = np.ptp(near, axis=1) <= 0.05 * near.mean(axis=1)
        if whole.any():
            shift, turn = self._smoothed(p, q, centre[whole])
            position[whole] += shift
            attitude[whole] = quaternion_multiply(attitude[whole], quaternion_from_vector(turn))
        return t[centre], position, attitude, C[centre]

    def rest(self) -> PoseRows:
        """The poses that wait for neighbours, as they came: no more will come."""
        t, p, q, C = self._queue
        self._queue = t[:0], p[:0], q[:0], C[:0]
        most = REACHES[0]
        return t[-most:], p[-most:], q[-most:], C[-most:]

    def _smoothed(self, position_l: Array, quaternion: Array, centre: NDArray[np.intp]) -> tuple[Array, Array]:
        """What moves the poses in the middle of their neighbours: shifts (k, 3), rotation vectors (k, 3)."""
        most = REACHES[0]
        about = centre[:, None] + np.arange(-most, most + 1)
        near = np.empty((*about.shape, 6))
        near[..., :3] = position_l[about] - position_l[centre][:, None]
        turns = quaternion_multiply(quaternion_conjugate(quaternion[centre])[:, None], quaternion[about])
        near[..., 3:] = vector_from_quaternion(turns)
        # a pose's own noise is in what is left of it; the mean motion drops out of both
        moved = np.stack(
            [w @ near[:, most - r : most + r + 1] for w, r in zip(self._weights, REACHES, strict=True)], axis=1
        )
        learnt = self._learn(FOURTH @ near[:, most - 2 : most + 3], moved)
        k = np.arange(len(centre))
        out = []
        for part in (slice(0, 3), slice(3, 6)):
            reach = self._reaches(*learnt, part)
            which = np.argmax(reach[:, None] == REACHES, axis=1)
            out.append(np.where(reach[:, None] > 0, moved[k, which, part], 0.0))
        return out[0], out[1]

    def _learn(self, fourth: Array, moved: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Noise (k, 6), what is left (k, reaches, 6) and the number of poses (k,), as known at each pose."""
        noise, left, seen = np.empty_like(fourth), np.empty_like(moved), np.empty(len(fourth), dtype=np.intp)
        fourth2, moved2 = fourth**2, moved**2
        for k in range(len(fourth)):
            self._seen = min(self._seen + 1, MEMORY)
            share = 1.0 / self._seen
            self._noise = self._noise + share * (fourth2[k] - self._noise)
            self._left = self._left + share * (moved2[k] - self._left)
            noise[k], left[k], seen[k] = self._noise, self._left, self._seen
        return noise, left, seen

    def _reaches(self, noise: Array, left: Array, seen: NDArray[np.intp], part: slice) -> NDArray[np.intp]:
        """Neighbours on each side (k,) that may help with what is known of k poses; 0 = none."""
        own = np.array([w[reach] for w, reach in zip(self._weights, REACHES, strict=True)])
        expected = (1.0 - own[:, None]) * noise[:, None, part]
        smooth = (left[:, :, part] <= LARGEST_EXCESS * expected).all(axis=2) & (seen >= MEMORY // 4)[:, None]
        return np.where(smooth.any(axis=1), np.array(REACHES)[np.argmax(smooth, axis=1)], 0)
