"""Direct georeferencing of a network: space intersection with the measured orientation, the baseline of reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..arrays import Array, Bools
from ..models.base import ModelOptions
from .adjustment import State, pose_problem
from .layout import Layout
from .linearisation import linearise_and_weigh
from .network import Network
from .normal_equations import Prior


@dataclass(frozen=True)
class Georeferenced:
    """Object points without adjustment; p points.

    Attributes
    ----------
    xyz_l : (p, 3) metres; NaN where the rays do not decide a point
    image_sigma_m : (p, 3) theoretical, from the image measurements alone [K 5.1]
    sigma_m : (p, 3) theoretical, from image measurements and the a-priori sigmas of the trajectory
    """

    xyz_l: Array
    image_sigma_m: Array
    sigma_m: Array


def georeference(network: Network, model: ModelOptions, ray_weight: Array | None = None) -> Georeferenced:
    """Weighted multi-ray forward intersection of all points.

    Errors of the trajectory act as the correction functions of the model with their a-priori sigmas: in common on all
    looks of a strip at a point.

    Parameters
    ----------
    network, model : as for the adjustment
    ray_weight : (n,) factors on the weights; 0 leaves a ray out
    """
    problem = pose_problem(network, model)
    return georeference_posed(network, problem.layout, problem.prior, ray_weight)


def georeference_posed(network: Network, layout: Layout, prior: Prior, ray_weight: Array | None) -> Georeferenced:
    """`georeference` with the unknowns of a model and what is known of them beforehand; weights (n,) of the rays."""
    state = State(np.zeros(layout.n_unknowns), network.approximate_l)
    weight = np.ones(len(network.rays)) if ray_weight is None else ray_weight
    p = network.rays.point
    count = network.n_points
    lin, inverse, known = None, np.empty((count, 3, 3)), np.zeros(count, dtype=bool)
    for _ in range(4):
        _, lin, _ = linearise_and_weigh(network.rays, layout, state.theta, state.points_l)
        lin = lin.reweighted(weight)
        (x, y), v = lin.point, lin.residual
        normal = np.empty((count, 3, 3))
        for i in range(3):
            for k in range(i + 1):
                normal[:, i, k] = normal[:, k, i] = np.bincount(p, x[i] * x[k] + y[i] * y[k], count)
        right = np.stack([np.bincount(p, x[i] * v[0] + y[i] * v[1], count) for i in range(3)], axis=1)
        inverse, known = _inverse(normal)
        state = State(state.theta, state.points_l + np.einsum("pij,pj->pi", inverse, right))
    assert lin is not None
    image = np.einsum("pii->pi", inverse)
    total = image + _through_trajectory(network, layout, prior, lin.orientation, np.moveaxis(lin.point, 2, 0), inverse)
    xyz = np.where(known[:, None], state.points_l, np.nan)
    return Georeferenced(xyz, _root(image, known), _root(total, known))


def _root(variance: Array, known: Bools) -> Array:
    return np.where(known[:, None], np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _inverse(normal: Array) -> tuple[Array, Bools]:
    """Inverses (p, 3, 3), zero where singular, and which are not."""
    scale = np.einsum("pii->p", normal)
    known = np.linalg.eigvalsh(normal)[:, 0] > 1e-10 * scale
    result = np.zeros_like(normal)
    result[known] = np.linalg.inv(normal[known])
    return result, known


def _through_trajectory(
    network: Network, layout: Layout, prior: Prior, d_orientation: Array, J: Array, inverse: Array
) -> Array:
    """Variances (p, 3) that a-priori errors of the correction functions bring into the points."""
    point = network.rays.point
    # what an orientation error of a ray does to its point, (n, 3, 6)
    effect = inverse[point] @ np.einsum("nij,ikn->njk", J, d_orientation)
    rows, columns, values = [], [], []
    for t, (node, component) in enumerate(zip(layout.node, layout.component, strict=True)):
        present = np.flatnonzero(layout.columns[t] >= 0)
        for axis in range(3):
            rows.append(3 * point[present] + axis)
            columns.append(layout.columns[t, present])
            values.append(effect[present, axis, component] * layout.coefficients[node, present])
    shape = (3 * network.n_points, layout.n_unknowns)
    M = csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
    B = prior.matrix
    if np.diff(B.indptr).max(initial=0) <= 1:
        information = np.asarray(B.multiply(B).sum(axis=0)).ravel()
        variance = np.divide(1.0, information, out=np.zeros_like(information), where=information > 0)
        spread = np.asarray(M.multiply(M) @ variance).ravel()
    else:  # continuity binds unknowns of one component of a set, never those of two
        spread = np.zeros(shape[0])
        by_column, normal = M.tocsc(), prior.normal.tocsr()
        count, group = connected_components(normal, directed=False)
        order = np.argsort(group, kind="stable")
        for columns in np.split(order, np.cumsum(np.bincount(group, minlength=count))[:-1]):
            own = csr_array(by_column[:, columns])
            rows = np.flatnonzero(np.diff(own.indptr))
            if not len(rows):  # no error of the trajectory
                continue
            own = own[rows]
            covariance = _pseudo_inverse(normal[columns][:, columns].toarray())
            spread[rows] += np.asarray(own.multiply(own @ covariance).sum(axis=1)).ravel()
    return spread.reshape(-1, 3)


def _pseudo_inverse(normal: Array) -> Array:
    """Of a symmetric matrix, judged singular with its unknowns in units of their own sigmas.

    Metres and slopes of angles differ by 16 orders of magnitude in their weights: unscaled, the least determined
    offsets would count as undetermined, with variance 0.
    """
    diagonal = normal.diagonal()
    scale = np.divide(1.0, np.sqrt(diagonal), out=np.zeros_like(diagonal), where=diagonal > 0)
    return scale[:, None] * np.linalg.pinv(scale[:, None] * normal * scale, hermitian=True) * scale
