"""The window's bookkeeping of information, against dense least squares."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.window.state.unknowns import Information, WindowState


def random_information(rng, n, rows):
    A, y = rng.standard_normal((rows, n)), rng.standard_normal(rows)
    return Information(A.T @ A, A.T @ y, float(y @ y), rows), A, y


def problem(seed=0, n=12):
    rng = np.random.default_rng(seed)
    state = WindowState()
    numbers = state.new_numbers(n)
    state.enter(numbers)
    columns = np.arange(n, dtype=np.int32)[:, None]
    sigma = rng.uniform(0.5, 2.0, n)
    state.observe(columns, np.ones((n, 1)), np.zeros(n), sigma)
    return rng, state, numbers, np.diag(1 / sigma)


def anew(state):
    """Solve although nothing has changed."""
    nothing = Information(np.zeros((1, 1)), np.zeros(1), 0.0, 0)
    state.add(state.numbers[:1], nothing)
    solution = state.solution
    state.solve()
    assert state.solution == solution + 1


@pytest.mark.parametrize("known", [False, True], ids=["values", "values and cofactors"])
def test_unknowns_that_leave_and_come_change_nothing_that_would_have_to_be_solved(known):
    """A chain goes on at its end, and its begin leaves; the others keep values and cofactors without a solution."""
    rng, state, numbers, _ = problem()
    information = random_information(rng, 8, 12)[0]
    state.add(numbers[:8], information)
    state.solve()
    if known:
        state.covariance(numbers)
    state.fix(numbers[:8], information)
    state.marginalise(numbers[:3])
    fresh = state.new_numbers(4)
    # each new one hangs on one before it, the first two on old ones
    columns = np.array([[numbers[5], fresh[2]], [numbers[11], fresh[0]], [fresh[0], fresh[1]], [fresh[2], fresh[3]]])
    solution = state.solution
    state.extend(fresh, columns.astype(np.int32), rng.uniform(0.5, 1.5, (4, 2)), rng.normal(size=4), np.full(4, 0.3))
    state.solve()
    assert state.solution == solution
    values, cost = state.values(state.numbers), state.cost()
    covariance = state.covariance(state.numbers)
    propagated = state.propagated(np.eye(len(state)))
    anew(state)
    assert len(state) == 13 and state.values(state.numbers) == pytest.approx(values, abs=1e-10)
    assert state.cost() == pytest.approx(cost)
    assert state.covariance(state.numbers) == pytest.approx(covariance, abs=1e-10)
    assert propagated == pytest.approx(covariance, abs=1e-10)


def test_unknowns_of_which_more_is_known_are_solved_for():
    rng, state, numbers, A = problem()
    information, B, z = random_information(rng, 12, 15)
    state.add(numbers, information)
    state.solve()
    fresh = state.new_numbers(2)
    columns = np.array([[numbers[5], fresh[0]], [numbers[11], fresh[1]], [fresh[0], fresh[1]]])
    coefficients, value = rng.normal(size=(3, 2)), rng.normal(size=3)
    state.extend(fresh, columns.astype(np.int32), coefficients, value, np.ones(3))
    state.solve()
    rows = np.zeros((3, 14))
    np.put_along_axis(rows, columns, coefficients, axis=1)
    full = np.vstack([np.pad(A, ((0, 0), (0, 2))), np.pad(B, ((0, 0), (0, 2))), rows])
    x = np.linalg.lstsq(full, np.concatenate([np.zeros(len(A)), z, value]))[0]
    assert state.theta == pytest.approx(x)


def test_solution_cost_and_redundancy_are_those_of_least_squares():
    rng, state, numbers, A = problem()
    y = np.zeros(len(A))
    for part in (numbers[:6], numbers[4:]):
        information, B, z = random_information(rng, len(part), 9)
        state.add(part, information)
        full = np.zeros((9, len(numbers)))
        full[:, part] = B
        A, y = np.vstack([A, full]), np.concatenate([y, z])
    state.solve()
    x, cost, *_ = np.linalg.lstsq(A, y)
    assert state.theta == pytest.approx(x)
    assert state.cost() == pytest.approx(cost[0])
    assert state.redundancy == len(A) - len(numbers)
    assert state.covariance(numbers[2:5]) == pytest.approx(np.linalg.inv(A.T @ A)[2:5, 2:5])
    assert state.covariance(numbers) == pytest.approx(np.linalg.inv(A.T @ A))


def test_what_is_taken_back_leaves_nothing():
    rng, state, numbers, _ = problem()
    state.solve()
    before, cost = state.covariance(numbers), state.cost()
    information, _, _ = random_information(rng, 5, 8)
    state.add(numbers[3:8], information)
    state.solve()
    assert not np.allclose(state.covariance(numbers), before)
    state.add(numbers[3:8], information, -1)
    state.solve()
    assert state.covariance(numbers) == pytest.approx(before, abs=1e-12)
    assert state.cost() == pytest.approx(cost, abs=1e-9)


def test_marginalisation_changes_neither_estimates_nor_cost_of_what_stays():
    rng, state, numbers, _ = problem()
    old, new = random_information(rng, 7, 10)[0], random_information(rng, 6, 9)[0]
    state.add(numbers[:7], old)
    state.add(numbers[6:], new)
    state.solve()
    theta, cov, cost = state.theta.copy(), state.covariance(numbers), state.cost()
    state.fix(numbers[:7], old)
    marginal = state.marginalise(numbers[:6])
    anew(state)
    assert (state.numbers == numbers[6:]).all()
    assert state.theta == pytest.approx(theta[6:])
    assert state.covariance(numbers[6:]) == pytest.approx(cov[6:, 6:])
    assert state.cost() == pytest.approx(cost)
    # and the way back from the stored marginal
    gone = np.linalg.solve(marginal.R11, marginal.d1 - marginal.R12 @ state.values(marginal.stayed))
    assert gone == pytest.approx(theta[:6])
    # later information still reaches what stayed, as if nothing had left
    late = random_information(rng, 4, 6)[0]
    state.add(numbers[8:], late)
    state.solve()
    N = np.linalg.inv(cov)
    b = N @ theta
    N[8:, 8:] += late.matrix
    b[8:] += late.rhs
    assert state.theta == pytest.approx(np.linalg.solve(N, b)[6:])


def test_information_stays_positive_definite_over_a_long_time():
    rng, state, numbers, _ = problem(n=6)
    shared = numbers[:2]
    chain = numbers[2:4]
    state.enter(state.new_numbers(0))
    for _ in range(2000):
        new = state.new_numbers(2)
        state.enter(new)
        columns = np.column_stack([chain, new]).astype(np.int32)
        state.observe(columns, np.tile([-1.0, 1.0], (2, 1)), np.zeros(2), np.full(2, 1e-3))
        state.observe(new[:, None].astype(np.int32), np.ones((2, 1)), np.zeros(2), np.ones(2))
        touched = np.concatenate([shared, chain, new])
        information = random_information(rng, 6, 8)[0]
        information = Information(1e6 * information.matrix, 1e3 * information.rhs, information.square, 8)
        state.add(touched, information)
        state.solve()
        state.fix(touched, information)
        state.marginalise(chain)
        chain = new
    eigenvalues = np.linalg.eigvalsh(np.linalg.inv(state.covariance(state.numbers)))
    assert eigenvalues.min() > 0
    assert len(state) == 6
    assert state.cost() / state.redundancy < 1e6


def test_unknowns_without_information_cannot_leave():
    state = WindowState()
    numbers = state.new_numbers(2)
    state.enter(numbers)
    state.observe(numbers[:1, None].astype(np.int32), np.ones((1, 1)), np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match="undetermined"):
        state.marginalise(numbers[1:])
