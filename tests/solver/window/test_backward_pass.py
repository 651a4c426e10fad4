"""The backward pass over a long strip: cofactors beside those of all unknowns at once."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from triline.solver.window.block.backward import before
from triline.solver.window.block.solution import DenseSolution
from triline.solver.window.state.unknowns import Marginal

#: Unknowns of a strip that follow each other, those in the window, and those that leave together.
COUNT, WINDOW, TOGETHER = 700, 20, 5


def strip_of_three_views():
    """Normal equations of a wander whose times are seen three at once, and of a constant and a drift beside it."""
    rng = np.random.default_rng(5)
    N, rhs = np.zeros((COUNT + 2, COUNT + 2)), np.zeros(COUNT + 2)

    def observe(unknowns, coefficients, weight):
        a = np.zeros(COUNT + 2)
        a[unknowns] = coefficients
        N[:] += weight * np.outer(a, a)
        rhs[:] += np.sqrt(weight) * rng.normal() * a

    for i in range(COUNT):
        observe([i, i - 1] if i else [i], [1.0, -0.9] if i else [1.0], 5.0 if i else 1.0)
        if i >= 14:
            observe([i, i - 7, i - 14], [1.0, -2.0 + 0.05 * rng.normal(), 1.0], 1e4)
            observe([i, i - 7], [1.0, -1.0], 1e2)
        if i % 50 == 0:
            observe([i, COUNT, COUNT + 1], [1.0, 1.0, 2.0 * i / COUNT - 1.0], 1.0)
    for constant in (COUNT, COUNT + 1):
        observe([constant], [1.0], 1.0)
    return N, rhs


def test_cofactors_of_a_long_strip_are_those_of_all_unknowns_at_once():
    N, rhs = strip_of_three_views()
    A, b, steps = N.copy(), rhs.copy(), []
    constants = np.array([COUNT, COUNT + 1])
    for i in range(0, COUNT - WINDOW, TOGETHER):
        gone = np.arange(i, i + TOGETHER)
        stayed = np.concatenate([np.arange(i + TOGETHER, min(i + TOGETHER + WINDOW, COUNT)), constants])
        R11 = np.linalg.cholesky(A[np.ix_(gone, gone)]).T
        R12 = solve_triangular(R11, A[np.ix_(gone, stayed)], trans=1)
        d1 = solve_triangular(R11, b[gone], trans=1)
        A[np.ix_(stayed, stayed)] -= R12.T @ R12
        b[stayed] -= R12.T @ d1
        steps.append(Marginal(gone, stayed, R11, R12, d1))
    left = np.concatenate([np.arange(COUNT - WINDOW, COUNT), constants])
    cofactors = np.linalg.inv(A[np.ix_(left, left)])
    solution = DenseSolution(left, cofactors @ b[left], cofactors)
    Q = np.linalg.inv(N)
    for step in reversed(steps):
        solution = before(step, solution)
        own = solution.numbers
        np.testing.assert_allclose(np.diag(solution.cofactors), np.diag(Q)[own], rtol=1e-9)
    first = solution.numbers < TOGETHER
    np.testing.assert_allclose(solution.values[first], (Q @ rhs)[:TOGETHER], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(solution.cofactors, Q[np.ix_(own, own)], rtol=1e-7, atol=1e-10)
