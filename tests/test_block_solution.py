"""The block's equations and their solution in kept memory, against the same in plain matrices."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.window.block_normals import BlockNormals
from triline.solver.window.block_solution import TILE, Workspace, factorised, in_one_go, inverted, reduced, solved

#: Numbers of unknowns are below this.
MOST = 900


def close(a, b, tolerance=1e-9):
    """Whether arrays are equal but for rounding; in no time, unlike `pytest.approx` of large ones."""
    return np.abs(a - b).max() <= tolerance * max(np.abs(b).max(), 1.0)


@pytest.mark.parametrize("n", [1, TILE - 1, TILE, 3 * TILE + 1, 4 * TILE + 17])
def test_tiles_give_the_solution_and_the_inverse_of_the_lower_triangle(n):
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n + 5))
    N, rhs, scale = root @ root.T + n * np.eye(n), rng.standard_normal(n), rng.uniform(0.5, 2.0, n)
    work = np.where(np.tri(n, dtype=bool), N, np.nan)  # nobody reads what stands above
    costs = list(factorised(work))
    assert close(solved(work, rhs), np.linalg.solve(N, rhs), 1e-12)
    through = rng.standard_normal((n, 3))
    wanted = np.linalg.solve(np.linalg.cholesky(N), through)
    in_one_go(reduced(work, through))
    assert close(through, wanted, 1e-12)
    costs += list(inverted(work, scale))
    assert close(n * work, n * np.linalg.inv(N) * scale * scale[:, None])
    assert sum(costs) >= n**3 and max(costs) <= 2.0 * n * TILE * 3 * TILE  # none of the parts is large


def test_a_matrix_that_is_singular_is_refused():
    with pytest.raises(np.linalg.LinAlgError, match="not positive"):
        in_one_go(factorised(np.ones((300, 300))))


def filled(rng):
    """Equations of overlapping groups of unknowns in no order, and the same as a plain matrix."""
    block, N, rhs = BlockNormals(), np.zeros((MOST, MOST)), np.zeros(MOST)
    for _ in range(200):
        numbers = rng.integers(0, MOST - 200) + rng.choice(200, 40, replace=False)
        A, b = rng.standard_normal((50, 40)), rng.standard_normal(40)
        block.add(numbers, A.T @ A, b)
        N[np.ix_(numbers, numbers)] += A.T @ A
        rhs[numbers] += b
    return block, N, rhs


def lower_of(block, numbers):
    out = np.zeros((len(numbers), len(numbers)))
    block.lower(numbers, out, range(len(numbers)))
    return out


def test_unknowns_that_are_closed_leave_what_they_say_of_the_others():
    block, N, rhs = filled(np.random.default_rng(1))
    known = np.sort(block.numbers)
    assert close(lower_of(block, known), np.tril(N[np.ix_(known, known)]))
    gone = np.arange(300, 600)
    stay = np.setdiff1d(known, gone)
    own = N[np.ix_(gone, gone)] + np.eye(len(gone))
    K = np.linalg.solve(own, N[np.ix_(gone, stay)]).T
    in_one_go(block.close(gone, np.tril(own), rhs[gone].copy(), np.full(len(gone) * len(known), np.nan)))
    assert np.sort(block.numbers).tolist() == stay.tolist()
    wanted = N[np.ix_(stay, stay)] - K @ N[np.ix_(gone, stay)]
    assert close(lower_of(block, stay), np.tril(wanted))
    assert close(block.rhs(stay), rhs[stay] - K @ rhs[gone])


def test_unknowns_that_are_dropped_come_back_with_nothing():
    block, N, _ = filled(np.random.default_rng(2))
    gone = np.arange(100, 400)
    block.drop(gone)
    left = np.sort(block.numbers)
    assert close(lower_of(block, left), np.tril(N[np.ix_(left, left)]))
    block.add(gone[:3], np.eye(3), np.ones(3))
    assert close(lower_of(block, gone[:3]), np.eye(3))
    assert not lower_of(block, np.concatenate([left, gone[:3]]))[-3:, :-3].any()


def test_a_workspace_is_used_again():
    space = Workspace()
    large = space.square(100)
    assert np.shares_memory(space.square(90), large) and np.shares_memory(space.pair(30, 50)[1], large)
    assert not np.shares_memory(space.square(200), large)
