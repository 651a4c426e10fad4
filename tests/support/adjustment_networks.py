"""Small simulated blocks for the adjustment's tests, and the dense normal matrix to compare with."""

from __future__ import annotations

import numpy as np

from triline.solver.adjustment.adjustment import Solution
from triline.solver.camera.line_camera import three_line_camera
from triline.solver.models import ModelOptions
from triline.solver.simulation.network import SimulatedNetwork, regular_block

CAMERA = three_line_camera("test", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})


def simulate(seed: int, errors: ModelOptions, camera=CAMERA, **more) -> SimulatedNetwork:
    """A regular block from a seed; see `regular_block`."""
    return regular_block(camera, np.random.default_rng(seed), errors, **more)


def dense_design(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Whitened design matrix of the rays (n, 2, u + 3 p) and the whole normal matrix, the slow way."""
    layout, lin, rays = solution.layout, solution.linearisation, solution.network.rays
    u, n = layout.n_unknowns, len(rays)
    A = np.zeros((n, 2, u + 3 * solution.network.n_points + 1))  # the last column takes what a ray does not have
    row = np.arange(n)
    for t, (node, component) in enumerate(zip(layout.node, layout.component, strict=True)):
        A[row, :, layout.columns[t]] += (lin.orientation[:, component] * layout.coefficients[node]).T
    if layout.camera is not None:
        own = layout.camera.columns[layout.camera.pattern]
        for s in range(own.shape[1]):
            A[row, :, np.where(own[:, s] >= 0, layout.n_model + own[:, s], -1)] += lin.camera[:, s].T
    for k in range(3):
        A[row, :, u + 3 * rays.point + k] += lin.point[:, k].T
    A = A[:, :, :-1]
    flat = A.reshape(2 * n, -1)
    N = flat.T @ (flat * np.repeat(solution.ray_weight, 2)[:, None])
    prior = solution.problem.prior.matrix.toarray()
    N[:u, :u] += prior.T @ prior
    point = np.arange(u, len(N))
    N[point, point] += solution.problem.control.weight.ravel()
    return A, N
