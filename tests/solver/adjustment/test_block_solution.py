"""The block's equations and their solution in kept memory, against the same in plain matrices."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.adjustment.dense_in_parts import TILE, factorised, in_one_go, inverted, reduced, solved
from triline.solver.adjustment.growing_normals import BlockNormals

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
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(gone))
    K = np.linalg.solve(N[np.ix_(gone, gone)] + np.diag(weight), N[np.ix_(gone, stay)]).T
    in_one_go(block.close(gone, weight))
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


def test_the_solution_is_that_of_the_plain_matrix_with_the_weights():
    block, N, rhs = filled(np.random.default_rng(4))
    known = np.sort(block.numbers)
    weight = np.random.default_rng(5).uniform(0.5, 2.0, len(known))
    whole = N[np.ix_(known, known)] + np.diag(weight)
    values, cofactors = in_one_go(block.solving(known, weight))
    assert close(values, np.linalg.solve(whole, rhs[known]))
    assert close(cofactors, np.linalg.inv(whole))


def test_what_nothing_is_known_of_is_held_in_a_solution():
    """The factor fails there; the others come out as if it were not."""
    block, N, rhs = filled(np.random.default_rng(6))
    known = np.sort(block.numbers)
    numbers = np.append(known, MOST + np.arange(2))
    weight = np.append(np.ones(len(known)), np.zeros(2))
    values, cofactors = in_one_go(block.solving(numbers, weight))
    assert close(values[:-2], np.linalg.solve(N[np.ix_(known, known)] + np.eye(len(known)), rhs[known]))
    assert not values[-2:].any() and not cofactors[-2:].any()


def test_memory_is_used_again():
    block, _, _ = filled(np.random.default_rng(7))
    known = np.sort(block.numbers)
    _, first = in_one_go(block.solving(known, np.ones(len(known))))
    in_one_go(block.close(known[:100], np.ones(100)))
    _, second = in_one_go(block.solving(known[100:], np.ones(len(known) - 100)))
    assert np.shares_memory(first, second)
