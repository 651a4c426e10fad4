"""Space intersection: object points from image points and known orientation, weighted, with covariance.

With the measured orientation this is direct georeferencing, the baseline every adjustment is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera.collinearity import image_motion, project
from .ray_intersection import intersect_rays
from .rotation import matrix_from_angles

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class ImageRays:
    """Image points with the orientation they were taken at; n rays.

    Attributes
    ----------
    point : (n,) index of each ray's object point
    time_s, line_period_s : (n,) time of the image line, and from one line to the next
    position_l, angles : (n, 3) perspective centre in metres; omega, phi, kappa in radians
    velocity_l, angle_rate : (n, 3) m/s, rad/s
    xy_mm, pitch_mm : (n, 2) image coordinates reduced to the principal point, and their change per pixel along the line
    focal_length_mm : (n,)
    sigma_line_px, sigma_sample_px : (n,)
    orientation_covariance : (n, 6, 6) X, Y, Z, omega, phi, kappa in m, rad; None if it is not known
    strip : (n,) index of each ray's strip, whose orientation has errors of its own; None if all are of one
    """

    point: IntArray
    time_s: Array
    line_period_s: Array
    position_l: Array
    angles: Array
    velocity_l: Array
    angle_rate: Array
    xy_mm: Array
    pitch_mm: Array
    focal_length_mm: Array
    sigma_line_px: Array
    sigma_sample_px: Array
    orientation_covariance: Array | None = None
    strip: IntArray | None = None


@dataclass(frozen=True)
class Intersection:
    """Object points of a space intersection; p points.

    Attributes
    ----------
    xyz_l : (p, 3) metres; NaN where the rays do not decide it
    covariance : (p, 3, 3) m^2, from image and (where given) orientation covariance; NaN where xyz_l is
    rays : (p,) rays of each point
    known : (p,) whether the rays decide the point: two at least, from different directions
    """

    xyz_l: Array
    covariance: Array
    rays: IntArray
    known: NDArray[np.bool_]


def intersect(rays: ImageRays, n_points: int, correlation_time_s: float = np.inf, iterations: int = 3) -> Intersection:
    """Weighted multi-ray forward intersection (Gauss-Newton on the collinearity equations).

    Rays are weighted by their image covariance ``Ju su^2 Ju^T + Jv sv^2 Jv^T``. Orientation errors of two looks at one
    point from the same strip are taken as correlated by ``exp(-|dt| / correlation_time_s)``: what a trajectory has
    wrong it has wrong for a while, and errors common to all looks do not average out. Those of different strips are
    independent, as an adjustment takes them.

    Raises
    ------
    ValueError : a correlation time that is not positive, a point index outside ``n_points``
    """
    if not correlation_time_s > 0:
        raise ValueError(f"correlation time {correlation_time_s} s, wanted more than 0")
    point = np.asarray(rays.point)
    if len(point) and (point.min() < 0 or point.max() >= n_points):
        raise ValueError(f"a ray names point {point.max()}; there are {n_points} points")
    image = np.column_stack([rays.xy_mm, -rays.focal_length_mm])
    direction = np.einsum("nij,nj->ni", matrix_from_angles(*rays.angles.T), image)
    xyz, known = intersect_rays(np.asarray(rays.position_l, dtype=np.float64), direction, point, n_points)
    count = np.bincount(point, minlength=n_points)
    use = np.flatnonzero(known[point])
    p = point[use]
    if not len(use):
        return Intersection(xyz, np.full((n_points, 3, 3), np.nan), count, known)

    normal, gain, through_orientation = np.zeros((n_points, 3, 3)), np.zeros((0, 3, 2)), np.zeros((0, 2, 6))
    for _ in range(max(1, iterations)):
        projection = project(rays.position_l[use], rays.angles[use], xyz[p], rays.focal_length_mm[use])
        motion = image_motion(projection.d_orientation, rays.velocity_l[use], rays.angle_rate[use])
        weight = _image_weight(motion * rays.line_period_s[use, None], rays.pitch_mm[use], rays, use)
        residual = rays.xy_mm[use] - projection.xy_mm
        design = projection.d_point
        gain = np.swapaxes(design, 1, 2) @ weight
        through_orientation = projection.d_orientation
        normal = _sum_by_point(gain @ design, p, n_points)
        right = _sum_by_point(np.einsum("nij,nj->ni", gain, residual), p, n_points)
        xyz[known] += np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0]

    covariance = np.full((n_points, 3, 3), np.nan)
    inverse = np.linalg.inv(normal[known])
    covariance[known] = inverse
    if rays.orientation_covariance is not None:
        through = gain @ through_orientation  # (n, 3, 6): orientation error of a ray into the right-hand side
        strip = None if rays.strip is None else rays.strip[use]
        spread = _orientation_spread(
            through, rays.orientation_covariance[use], p, rays.time_s[use], strip, correlation_time_s
        )
        total = _sum_by_point(spread, p, n_points)
        covariance[known] += inverse @ total[known] @ inverse
    return Intersection(xyz, covariance, count, known)


def _image_weight(d_line: Array, d_sample: Array, rays: ImageRays, use: IntArray) -> Array:
    """(n, 2, 2) inverse covariance of the image residual; the columns are what one line and one sample move it by."""
    ju = d_line * rays.sigma_line_px[use, None]
    jv = d_sample * rays.sigma_sample_px[use, None]
    return np.linalg.inv(ju[:, :, None] * ju[:, None, :] + jv[:, :, None] * jv[:, None, :])


def _sum_by_point(values: Array, point: IntArray, n_points: int) -> Array:
    total = np.zeros((n_points, *values.shape[1:]))
    np.add.at(total, point, values)
    return total


def _orientation_spread(
    through: Array, covariance: Array, point: IntArray, time: Array, strip: IntArray | None, tau: float
) -> Array:
    """(n, 3, 3) share of each ray in the covariance of its point's right-hand side, with its partners at that point."""
    root = through @ _root(covariance)
    spread = root @ np.swapaxes(root, 1, 2)
    order = np.lexsort((time, point))
    for step in range(1, int(np.bincount(point).max())):
        first, second = order[:-step], order[step:]
        pair = point[first] == point[second]
        first, second = first[pair], second[pair]
        correlation = np.exp(-np.abs(time[second] - time[first]) / tau)
        if strip is not None:
            correlation[strip[first] != strip[second]] = 0.0
        cross = correlation[:, None, None] * (root[first] @ np.swapaxes(root[second], 1, 2))
        spread[first] += cross + np.swapaxes(cross, 1, 2)  # no ray is first twice in one step
    return spread


def _root(covariance: Array) -> Array:
    """Symmetric square roots (n, k, k) of covariances, scaled so that metres and radians do not mix."""
    s = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    s = np.where(s > 0, s, 1.0)
    value, vector = np.linalg.eigh(covariance / (s[:, :, None] * s[:, None, :]))
    half = vector * np.sqrt(np.clip(value, 0.0, None))[:, None, :] @ np.swapaxes(vector, 1, 2)
    return s[:, :, None] * half
