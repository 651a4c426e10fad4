"""The second-order Gauss-Markov process: exact discrete form, and drawings that have the covariance it states."""

import numpy as np
import pytest
from scipy.linalg import expm

from triline.solver.models.gauss_markov import autocorrelation, damping_rate, second_order_gauss_markov
from triline.solver.simulation.error_models import draw_wander

SIGMA, TIME_S = 1.7, 30.0


def test_correlation_time_is_where_the_autocorrelation_is_one_over_e():
    assert autocorrelation(TIME_S, TIME_S) == pytest.approx(np.exp(-1), abs=1e-12)
    assert autocorrelation(TIME_S, 0.0) == 1.0
    assert autocorrelation(TIME_S, [-5.0])[0] == autocorrelation(TIME_S, [5.0])[0]
    assert damping_rate(TIME_S) == pytest.approx(2.1462 / TIME_S, rel=1e-5)


@pytest.mark.parametrize("step", [1e-4, 0.005, 0.2, 7.0, 400.0])
def test_discrete_form_is_that_of_the_differential_equation(step):
    """Van Loan's integral of the continuous process, computed independently."""
    b = damping_rate(TIME_S)
    A = np.array([[0.0, 1.0], [-b * b, -2.0 * b]])
    W = np.diag([0.0, 4.0 * b**3 * SIGMA**2])
    F, Q, P0 = second_order_gauss_markov(SIGMA, TIME_S, step)
    assert pytest.approx(expm(A * step), abs=1e-12) == F
    if step < 20.0:  # the block exponential overflows for long steps
        block = expm(np.block([[-A, W], [np.zeros((2, 2)), A.T]]) * step)
        assert pytest.approx(block[2:, 2:].T @ block[:2, 2:], rel=1e-6, abs=1e-15) == Q
    assert pytest.approx(P0, rel=1e-12, abs=1e-15) == F @ P0 @ F.T + Q
    assert (np.linalg.eigvalsh(Q) > 0).all()


def test_covariance_between_two_times_is_the_autocorrelation():
    lags = np.array([0.0, 1.0, 10.0, 60.0])
    F, _, P0 = second_order_gauss_markov(SIGMA, TIME_S, lags)
    assert (F @ P0)[:, 0, 0] == pytest.approx(SIGMA**2 * autocorrelation(TIME_S, lags), rel=1e-12)


def test_two_steps_make_one():
    F1, Q1, _ = second_order_gauss_markov(SIGMA, TIME_S, 3.0)
    F2, Q2, _ = second_order_gauss_markov(SIGMA, TIME_S, 11.0)
    F, Q, _ = second_order_gauss_markov(SIGMA, TIME_S, 14.0)
    assert pytest.approx(F, rel=1e-12) == F2 @ F1
    assert pytest.approx(Q, rel=1e-12) == F2 @ Q1 @ F2.T + Q2


def test_steps_of_an_array_are_those_of_its_elements():
    steps = np.array([[0.1, 2.0], [5.0, 0.0]])
    F, Q, _ = second_order_gauss_markov(SIGMA, TIME_S, steps)
    assert F.shape == Q.shape == (2, 2, 2, 2)
    assert F[1, 0] == pytest.approx(second_order_gauss_markov(SIGMA, TIME_S, 5.0)[0])
    assert F[1, 1] == pytest.approx(np.eye(2))
    assert (Q[1, 1] == 0).all()


def test_drawings_have_the_stated_covariance():
    """4000 independent drawings: variance of value and slope, and the correlation after the correlation time."""
    count, step = 4000, 0.5
    value, rate = draw_wander(np.random.default_rng(5), 101, step, np.full(count, SIGMA), TIME_S)
    band = 4.0 * np.sqrt(2.0 / count)  # four sigma of a sample variance
    for i in (0, 50, 100):
        assert np.mean(value[i] ** 2) / SIGMA**2 == pytest.approx(1.0, abs=band)
        assert np.mean(rate[i] ** 2) / (damping_rate(TIME_S) * SIGMA) ** 2 == pytest.approx(1.0, abs=band)
        assert np.mean(value[i] * rate[i]) / (damping_rate(TIME_S) * SIGMA**2) == pytest.approx(0.0, abs=band)
    for lag in (10, 60, 100):
        found = np.mean(value[0] * value[lag]) / SIGMA**2
        assert found == pytest.approx(float(autocorrelation(TIME_S, lag * step)), abs=band)
    # the second state is the derivative of the first
    assert np.diff(value, axis=0)[40] == pytest.approx(0.5 * step * (rate[40] + rate[41]), abs=0.03 * SIGMA)


@pytest.mark.parametrize("time_s, step", [(0.0, 1.0), (-3.0, 1.0), (30.0, -1.0), (float("nan"), 1.0)])
def test_bad_calls_say_what_was_wanted(time_s, step):
    with pytest.raises(ValueError, match="must"):
        second_order_gauss_markov(1.0, time_s, step)
