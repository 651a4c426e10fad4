"""The block's equations in cells and their solution in fronts, against the same in plain matrices."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.adjustment.growing_normals import CELL, BlockNormals
from triline.solver.adjustment.in_parts import in_one_go

#: Unknowns of a strip, and the first numbers of those that all strips share, and of drifts, which are negative.
STRIP, SHARED, DRIFTS = 700, 5, -6


def close(a, b, tolerance=1e-9):
    """Whether arrays are equal but for rounding; in no time, unlike `pytest.approx` of large ones."""
    return np.abs(a - b).max() <= tolerance * max(np.abs(b).max(), 1.0)


class Plain:
    """Equations in a plain matrix; numbers may be negative."""

    def __init__(self, n):
        self.N, self.r, self.known = np.zeros((n, n)), np.zeros(n), set()

    def add(self, numbers, matrix, rhs):
        self.N[np.ix_(numbers, numbers)] += matrix
        self.r[numbers] += rhs
        self.known |= set(numbers.tolist())

    def of(self, numbers, others=None):
        return self.N[np.ix_(numbers, numbers if others is None else others)]


@pytest.fixture
def strips():
    """Three strips that are tied where they are side by side: equations of unknowns in no order, in cells and plain.

    The numbers of a strip begin anywhere in a cell.
    """
    rng = np.random.default_rng(1)
    block, plain = BlockNormals(), Plain(10 + 3 * STRIP - DRIFTS)
    for _ in range(900):
        strip, at = int(rng.integers(3)), int(rng.integers(STRIP - 40))
        along = [
            s * STRIP + at + rng.choice(40, 12, replace=False) for s in {strip, min(strip + int(rng.integers(2)), 2)}
        ]
        constants = 10 + strip * STRIP + rng.choice(6, 3, replace=False)
        numbers = np.unique(
            np.concatenate([10 + np.concatenate(along), constants, rng.choice(SHARED, 2, replace=False)])
        )
        numbers = rng.permutation(np.append(numbers, DRIFTS + rng.integers(3)))
        A, b = rng.standard_normal((30, len(numbers))), rng.standard_normal(30)
        for kept in (block, plain):
            kept.add(numbers, A.T @ A, A.T @ b)
    return block, plain


def test_what_is_added_stands_where_it_belongs(strips):
    block, plain = strips
    known = block.numbers
    assert known.tolist() == sorted(plain.known)
    assert len(block._slot) < 0.5 * (len(known) / CELL) ** 2 / 2, "what has no entries takes no memory"
    asked = np.concatenate([np.random.default_rng(0).permutation(known), [10**6]])
    assert close(block.matrix(asked)[:-1, :-1], plain.of(asked[:-1])) and not block.matrix(asked)[-1].any()
    assert close(block.rhs(asked[:-1]), plain.r[asked[:-1]]) and block.rhs(asked)[-1] == 0.0


def test_a_solution_in_fronts_is_that_of_the_plain_matrix(strips):
    block, plain = strips
    numbers = np.setdiff1d(block.numbers, [DRIFTS])  # one of the drifts is zero
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(numbers))
    parts = block.solving(numbers, weight)
    costs = []
    while True:
        try:
            costs.append(next(parts))
        except StopIteration as end:
            values, factor = end.value
            break
    Q = np.linalg.inv(plain.of(numbers) + np.diag(weight))
    assert close(values, Q @ plain.r[numbers])
    assert factor._z is not None and close(factor.variances(), Q.diagonal())
    rng = np.random.default_rng(4)
    for some in (np.arange(3, 40), rng.permutation(len(numbers))[:50]):  # that observations have in common, and not
        assert close(factor.cofactors(some), Q[np.ix_(some, some)])
    A, B = rng.standard_normal((3, 20)), rng.standard_normal((2, len(numbers)))
    a, b = factor.rooted(np.arange(20), A), factor.rooted(np.arange(len(numbers)), B)
    assert close(a.joint(b), A @ Q[:20] @ B.T)
    assert 1e7 < sum(costs) < len(numbers) ** 3, "less than the dense solution takes"


def test_unknowns_that_are_determined_badly_are_solved_all_the_same():
    """By the directions that something is known of."""
    block, numbers = BlockNormals(), np.arange(CELL + 2)
    A = np.random.default_rng(5).standard_normal((CELL + 20, CELL + 2))
    A[:, -1] = 0.0
    block.add(numbers, A.T @ A, A.T @ np.ones(len(A)))
    values, factor = in_one_go(block.solving(numbers, np.zeros(len(numbers))))
    assert close(values[:-1], np.linalg.lstsq(A[:, :-1], np.ones(len(A)), rcond=None)[0]) and abs(values[-1]) < 1e-9
    root = factor.rooted(numbers, np.eye(len(numbers)))
    for Q in (factor.cofactors(numbers), root.joint(root)):
        assert close(Q[:-1, :-1], np.linalg.inv(A[:, :-1].T @ A[:, :-1]), 1e-3) and abs(Q[-1, -1]) < 1e-3


def test_unknowns_that_are_closed_leave_what_they_say_of_the_others(strips):
    block, plain = strips
    gone = np.sort([n for n in plain.known if 10 <= n < 10 + STRIP] + [DRIFTS + 1])
    stay = np.setdiff1d(block.numbers, gone)
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(gone))
    met = block.met(gone)
    touched = stay[np.abs(plain.of(stay, gone)).max(axis=1) > 0.0]
    assert np.isin(touched, met).all() and np.isin(met, stay).all()
    K = np.linalg.solve(plain.of(gone) + np.diag(weight), plain.of(gone, stay)).T
    in_one_go(block.close(gone, weight))
    assert block.numbers.tolist() == stay.tolist()
    assert close(block.matrix(stay), plain.of(stay) - K @ plain.of(gone, stay))
    assert close(block.rhs(stay), plain.r[stay] - K @ plain.r[gone])
    in_one_go(block.close(stay, np.ones(len(stay))))  # the last ones leave nothing
    assert not len(block.numbers) and not block._slot and not block._blocks.any()


def test_unknowns_that_nothing_is_known_of_are_not_closed():
    block = BlockNormals()
    block.add(np.arange(3), np.zeros((3, 3)), np.zeros(3))
    with pytest.raises(np.linalg.LinAlgError, match="undetermined"):
        in_one_go(block.close(np.arange(2), np.zeros(2)))


def test_unknowns_that_are_dropped_come_back_with_nothing(strips):
    block, plain = strips
    gone = np.arange(100, 400)
    room = len(block._blocks)
    block.drop(gone)
    left = block.numbers
    assert left.tolist() == sorted(plain.known - set(gone.tolist()))
    assert close(block.matrix(left), plain.of(left))
    assert not block.matrix(np.concatenate([left, gone]))[len(left) :].any() and not block.rhs(gone).any()
    block.add(gone, np.eye(300), np.ones(300))
    assert close(block.matrix(gone), np.eye(300)) and len(block._blocks) == room, "in the place of what was there"
