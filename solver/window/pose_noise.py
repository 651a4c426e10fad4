"""What the window's corrections leave of the noise of smoothed poses, see `adjustment.pose_noise`, as rays come in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..adjustment.pose_noise import PIECE_S, followed, information_by_pieces, left_of_noise, ray_information
from ..measured_trajectory import MeasuredPoses, MeasuredTrajectory
from .batch import Batch

Array = NDArray[np.floating]

#: Information is kept so long, s.
KEPT_S = 200.0
#: The noise that is left has to differ by so much of its standard deviation for rays to be weighted again.
CLEARLY = 0.15


class PoseNoise:
    """Counts what rays know of the corrections as time goes on, and says what these leave of the noise of poses.

    Attributes
    ----------
    usual : (6, 6) as `followed` gives it, where all rays have come; for the weights of rays that have just come
    version : how often that has changed clearly
    """

    def __init__(self, trajectory: MeasuredTrajectory) -> None:
        self._trajectory = trajectory
        self._pieces: dict[int, Array] = {}
        self.usual = np.eye(6)
        self.version = 0

    def count(self, batch: Batch) -> None:
        """A batch has come."""
        information = ray_information(batch.lin, batch.normals, batch.rays.point, batch.weight)
        for k, of_piece in information_by_pieces(batch.rays.time_s, information).items():
            self._pieces[k] = self._pieces.get(k, 0.0) + of_piece

    def learn(self, density: Array, now_s: float) -> bool:
        """Look at all that has been counted; whether rays are to be weighted again.

        Parameters
        ----------
        density : (6,) of the wander, see `followed`
        """
        self._pieces = {k: i for k, i in self._pieces.items() if k * PIECE_S > now_s - KEPT_S}
        left = [followed(i, density, self._trajectory.noise_time_s) for i in self._pieces.values()]
        if not left:
            return False
        least = min(left, key=_size)
        if abs(_size(least) - _size(self.usual)) <= CLEARLY * _size(self.usual):
            return False
        self.usual = least
        self.version += 1
        return True

    def of_rays(self, measured: MeasuredPoses) -> Array:
        """Covariance (n, 6, 6) of the noise of orientation under rays."""
        return _apply(measured, np.broadcast_to(self.usual, measured.covariance.shape))

    def at(self, measured: MeasuredPoses, density: Array) -> Array:
        """Covariance (n, 6, 6) of the noise of corrected orientation."""
        piece = np.floor(measured.poses.time_s / PIECE_S).astype(np.int64)
        left = np.empty_like(measured.covariance)
        for k in np.unique(piece).tolist():
            information = self._pieces.get(k)
            of_piece = np.eye(6)
            if information is not None:
                of_piece = followed(information, density, self._trajectory.noise_time_s)
            left[piece == k] = of_piece
        return _apply(measured, left)


def _size(left: Array) -> float:
    return float(np.linalg.norm(left[:, :3]))


def _apply(measured: MeasuredPoses, left: Array) -> Array:
    """What is left of the noise of smoothed poses; filtered ones keep theirs."""
    rest = left_of_noise(measured.covariance, left)
    return np.where(measured.smoothed[:, None, None], rest, measured.covariance)
