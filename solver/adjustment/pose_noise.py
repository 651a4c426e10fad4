"""What is left of the noise of smoothed positions once the corrections have followed it.

A smoother averages the noise of the fixes over some tenths of a second, so that what is left of it is no white noise:
its spectrum ends at the smoother's bandwidth ``w_s``. Where rays are dense the corrections follow the wander up to a
bandwidth ``w_c``, and they cannot tell wander from noise: the part of the noise below ``w_c`` is corrected with it. To
state all of the noise, in the weights of rays and beside the covariance of the corrections, is to state too much.

With a wander of spectral density ``s / w^4`` and rays that see it with white noise of density ``1 / i``, the
corrections are the wander through ``H = 1 / (1 + (w / w_c)^4)``, ``w_c^4 = s i`` (the Wiener smoother of a twice
integrated white noise). The noise of a smoother for white jerk has the spectrum ``1 / (1 + (w / w_s)^6)``. What is left
of its variance is its integral times ``(1 - H)^2``. Position and attitude are corrected together; the directions in
which each bandwidth holds are those in which information and wander are both diagonal. The information counted is that
of the rays with the points eliminated, for corrections that differ from look to look.

Source: Wiener smoother as in P. S. Maybeck, Stochastic Models, Estimation, and Control, vol. 1, 1979, section 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, IntArray
from ..geometry.measured_trajectory import MeasuredPoses, MeasuredTrajectory
from ..geometry.trajectory import noise_between
from ..models.base import ModelOptions
from ..navigation.kinematic_model import NOISE_TIMES_BANDWIDTH
from .linearisation import Linearisation
from .network import Network, Rays, Strip
from .normal_equations import PointNormals, inverse_factors
from .options_by_strip import slow_errors_of_strip
from .problem import Solution

#: Bandwidths of corrections over that of the noise for which the share left is computed; linear between.
_LOWEST, _HIGHEST, _STEPS = 1e-2, 1e2, 81
#: Variance of a contrast between three views, F - 2 N + B with N against the others, over that of independent looks.
#: Derived.
IN_STEP = 16.0 / 6.0
#: Information is counted in pieces of so long, s.
PIECE_S = 2.0


@cache
def _left() -> tuple[Array, Array]:
    """Share of the noise variance that is left, by the logarithm of ``w_c / w_s``."""
    ratio = np.linspace(np.log(_LOWEST), np.log(_HIGHEST), _STEPS)
    w = np.linspace(0.0, 8.0, 4001)
    spectrum = 1.0 / (1.0 + w**6)
    w4 = (w[:, None] / np.exp(ratio)) ** 4
    kept = (w4 / (1.0 + w4)) ** 2
    return ratio, (spectrum @ kept) / spectrum.sum()


def share_left(bandwidth: ArrayLike, noise_time_s: float) -> Array:
    """Share of the noise variance that corrections of a bandwidth (...), rad/s, leave.

    Parameters
    ----------
    noise_time_s : lag at which the noise is correlated by 1/e
    """
    x = np.asarray(bandwidth, dtype=float) * noise_time_s / NOISE_TIMES_BANDWIDTH
    return np.interp(np.log(np.maximum(x, _LOWEST)), *_left())


def followed(information: Array, density: Array, noise_time_s: float) -> Array:
    """What corrections leave of the noise of a position: (6, 6), to be multiplied with a noise of pose.

    Parameters
    ----------
    information : (6, 6) of the rays about the corrections, a second
    density : (6,) of the wander, ``s`` of its spectral density ``s / w^4``; 0 where nothing wanders
    noise_time_s : of the positions
    """
    left = np.eye(6)
    root = np.sqrt(density)
    if noise_time_s <= 0.0 or not (root[:3] > 0.0).all():
        return left
    value, vector = np.linalg.eigh(information * root[:, None] * root)
    share = share_left(np.maximum(value, 0.0) ** 0.25, noise_time_s)
    left[:, :3] = (root[:, None] * (vector * np.sqrt(share)) @ vector.T)[:, :3] / root[:3]
    return left


def ray_information(lin: Linearisation, normals: PointNormals, point: IntArray, weight: Array) -> Array:
    """Information (n, 6, 6) of rays of points (n,) about their own corrections, the points eliminated."""
    through = lin.point.transpose(2, 0, 1) @ np.swapaxes(inverse_factors(normals), 1, 2)[point]
    own = np.eye(2) - through @ np.swapaxes(through, 1, 2)
    rows = lin.orientation.transpose(2, 0, 1) * np.sqrt(weight)[:, None, None]
    return np.swapaxes(rows, 1, 2) @ own @ rows


def information_by_pieces(time_s: Array, information: Array) -> dict[int, Array]:
    """Information (6, 6) a second of rays (n,), summed over pieces of `PIECE_S` by their numbers."""
    piece = np.floor(time_s / PIECE_S).astype(np.int64)
    return {k: information[piece == k].sum(axis=0) / PIECE_S for k in np.unique(piece).tolist()}


def left_of_noise(noise: Array, left: Array) -> Array:
    """Covariance (n, 6, 6) of what `followed` (n, 6, 6) leaves of a noise."""
    return left @ noise @ np.swapaxes(left, -1, -2)


def with_noise_left(network: Network, solution: Solution) -> Network | None:
    """The network with what the corrections of a solution leave of the noise of poses; None where they leave all.

    Parameters
    ----------
    network : as measured, with the whole noise
    solution : of it, or of it with other noise
    """
    rays, slow = network.rays, getattr(solution.problem.model, "slow", None)
    if slow is None or rays.orientation_noise is None or not any(s.noise_time_s for s in network.strips):
        return None
    left = noise_left(rays, noise_information(solution), network.strips, solution.problem.model)
    return replace(network, rays=replace(rays, orientation_noise=left_of_noise(rays.orientation_noise, left)))


#: Information (6, 6) a second about corrections, by strip and piece of `PIECE_S`.
Pieces = dict[tuple[int, int], Array]


def noise_information(solution: Solution) -> Pieces:
    """What the rays of a solution say of the corrections."""
    rays, pieces = solution.network.rays, {}
    found = ray_information(solution.linearisation, solution.points, rays.point, solution.ray_weight)
    for i in np.unique(rays.strip).tolist():
        mine = np.flatnonzero(rays.strip == i)
        for k, of_piece in information_by_pieces(rays.time_s[mine], found[mine]).items():
            pieces[i, k] = of_piece
    return pieces


def noise_left(rays: Rays, pieces: Pieces, strips: Sequence[Strip], model: ModelOptions) -> Array:
    """What corrections leave of the noise of position of rays: (n, 6, 6), see `followed`."""
    left = np.empty((len(rays), 6, 6))
    for i in np.unique(rays.strip).tolist():
        mine = np.flatnonzero(rays.strip == i)
        left[mine] = noise_left_at(rays.time_s[mine], pieces, i, strips[i], model)
    return left


def noise_left_at(time_s: Array, pieces: Pieces, number: int, strip: Strip, model: ModelOptions) -> Array:
    """The same at times (n,) of a strip, which is ``number`` in the pieces; all of it where there are no rays."""
    left = np.broadcast_to(np.eye(6), (len(time_s), 6, 6)).copy()
    slow = slow_errors_of_strip(model, strip.id)
    if slow is None:
        return left
    piece = np.floor(time_s / PIECE_S).astype(np.int64)
    for k in np.unique(piece).tolist():
        if (number, k) in pieces:
            left[piece == k] = followed(pieces[number, k], slow.wander_density, strip.noise_time_s)
    return left


def orientation_noise(solution: Solution, pieces: Pieces, strip: int, time_s: Array) -> Array:
    """Noise (n, 6, 6) of the measured poses of a strip at times (n,) that the corrections of a solution leave."""
    own = solution.network.strips[strip]
    if own.noise is None:
        return np.zeros((len(time_s), 6, 6))
    noise = noise_between(own.trajectory.time_s, own.noise, time_s)
    return left_of_noise(noise, noise_left_at(time_s, pieces, strip, own, solution.problem.model))


#: Information is kept so long, s.
KEPT_S = 200.0
#: The noise that is left has to differ by so much of its standard deviation for rays to be weighted again.
NOISE_CHANGED = 0.15


def in_step(share: float) -> float:
    """Factor by which the variance of what all points say of the difference between views may be larger than stated.

    Looks at a point come from the views one after another, always so long apart. Where the attitude vibrates in step
    with that, all points show the same contrast between the views, and their number does not tell it from a camera
    that is off, or from a source that drifts.

    Parameters
    ----------
    share : of the variance of looks that may be a vibration
    """
    return 1.0 + (IN_STEP - 1.0) * share


class PoseNoise:
    """What corrections leave of the noise of poses as rays come in: counts their information as time goes on.

    Attributes
    ----------
    usual : (6, 6) as `followed` gives it, where all rays have come; for the weights of rays that have just come
    version : how often that has changed clearly
    vibration : noise of the attitude from look to look beyond what is stated, rad
    possible_vibration : the same, where noise of looks that may be of the image or of the attitude is taken for that
    """

    def __init__(self, trajectory: MeasuredTrajectory) -> None:
        self._trajectory = trajectory
        self._pieces: dict[int, Array] = {}
        self.usual: Array = np.eye(6)
        self.version = 0
        self.vibration = self.possible_vibration = 0.0

    def count(self, time_s: Array, information: Array) -> None:
        """Rays (n,) have come, with their information (n, 6, 6) (see `ray_information`)."""
        for k, of_piece in information_by_pieces(time_s, information).items():
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
        if abs(_size(least) - _size(self.usual)) <= NOISE_CHANGED * _size(self.usual):
            return False
        self.usual = least
        self.version += 1
        return True

    def of_rays(self, measured: MeasuredPoses) -> Array:
        """Covariance (n, 6, 6) of the noise of orientation under rays."""
        noise = _with_left(measured, np.broadcast_to(self.usual, measured.covariance.shape))
        return noise + of_vibration(self.vibration)

    def at(self, measured: MeasuredPoses, density: Array) -> Array:
        """Covariance (n, 6, 6) of the noise of corrected orientation, without a vibration."""
        piece = np.floor(measured.poses.time_s / PIECE_S).astype(np.int64)
        left = np.empty_like(measured.covariance)
        for k in np.unique(piece).tolist():
            information = self._pieces.get(k)
            of_piece = np.eye(6)
            if information is not None:
                of_piece = followed(information, density, self._trajectory.noise_time_s)
            left[piece == k] = of_piece
        return _with_left(measured, left)


def of_vibration(vibration: float | Array) -> Array:
    """Covariance (..., 6, 6) of poses by noise (...) of the attitude from look to look, rad."""
    return np.square(vibration)[..., None, None] * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


def _size(left: Array) -> float:
    return float(np.linalg.norm(left[:, :3]))


def _with_left(measured: MeasuredPoses, left: Array) -> Array:
    """What is left of the noise of smoothed poses; filtered ones keep theirs."""
    rest = left_of_noise(measured.covariance, left)
    return np.where(measured.smoothed[:, None, None], rest, measured.covariance)
