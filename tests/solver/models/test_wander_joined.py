"""A slow and a fast wander stated as one, and components that wander with correlation times of their own."""

import numpy as np
import pytest
from test_wander_restated import Used, covariance

from triline.solver.models.base import Extent
from triline.solver.models.gauss_markov import autocorrelation, damping_rate
from triline.solver.models.slow_errors import LEARNING_TIME_S, TAKEN_BACK_TIME_S, SlowErrors, joined
from triline.solver.models.wander import WanderOptions

SLOW = SlowErrors(
    (0.5, 0.5, 0.8), wander_m=(1.0, 1.0, 1.5), wander=(1e-4, 1e-4, 2e-4), wander_time_s=30.0, attitude_time_s=6.0
)


def density(sigma, time_s, w):
    """Spectral density at angular frequencies of the process of `gauss_markov`."""
    b = damping_rate(time_s)
    return 4.0 * b**3 * np.square(sigma) / (w**2 + b**2) ** 2


@pytest.mark.parametrize("share", [0.01, 0.13, 1.0, 25.0])
def test_no_frequency_has_less_than_the_slow_wander_and_both_ends_have_what_both_have(share):
    w = np.logspace(-4, 2, 200)
    fast = share * np.square(SLOW.wander_m)
    sigma, time_s = joined(SLOW.wander_m, SLOW.wander_time_s, fast, TAKEN_BACK_TIME_S)
    assert TAKEN_BACK_TIME_S <= time_s < SLOW.wander_time_s
    for i in range(3):
        slow = density(SLOW.wander_m[i], SLOW.wander_time_s, w)
        both = slow + density(np.sqrt(fast[i]), TAKEN_BACK_TIME_S, w)
        one = density(sigma[i], time_s, w)
        assert one[[0, -1]] == pytest.approx(both[[0, -1]], rel=1e-3)
        assert (one > 0.999 * both).all()


def test_the_mean_over_a_long_strip_stays_as_uncertain_as_the_stated_wander_makes_it():
    P = np.diag(np.concatenate([SLOW.position_sigma, 5.0 * SLOW.attitude_sigma]) ** 2)
    stated = SlowErrors(SLOW.offset_m, wander_m=SLOW.wander_m, wander=SLOW.wander, wander_time_s=30.0)
    t = np.linspace(0.0, 240.0, 481)
    lag = t[:, None] - t

    def of_mean(slow: SlowErrors) -> np.ndarray:
        return np.sqrt(np.square(slow.wander_m) * autocorrelation(slow.wander_time_s, lag).mean())

    for slow in (stated.widened(P), stated.widened(np.zeros((6, 6)), learnt=(True,) * 6)):
        assert of_mean(slow) == pytest.approx(of_mean(stated), rel=0.05)
        assert (slow.wander_density[:3] > 2.0 * stated.wander_density[:3]).all()  # beside faster changes
        assert slow.attitude_time_s == LEARNING_TIME_S and slow.offset_m == stated.offset_m


def test_nothing_fast_changes_nothing():
    assert joined((1.0, 2.0, 0.0), 30.0, np.zeros(3), 4.0) == ((1.0, 2.0, 0.0), 30.0)
    sigma, time_s = joined((0.0, 0.0, 0.0), 30.0, np.array([4.0, 0.0, 1.0]), 4.0)
    assert sigma == pytest.approx((2.0, 0.0, 1.0)) and time_s == pytest.approx(4.0)
    assert joined((1.0, 1.0, 1.0), 3.0, np.full(3, 3.0), 4.0) == (pytest.approx((2.0, 2.0, 2.0)), 3.0)


def test_each_component_is_the_process_of_its_own_correlation_time():
    """Between borders, too; and after another wander has been stated."""
    wander = WanderOptions(SLOW, left_out_m=0.05, left_out=1e-5).build(Extent("strip S1", 100.0, 130.0))
    sigma, times_s = np.array([*SLOW.wander_m, *SLOW.wander]), SLOW.wander_times_s
    assert wander.step_s == pytest.approx(6.0 / 15.0)
    assert len(wander.used[0]) < len(wander.used[5])  # the slow ones have longer segments
    t = np.linspace(100.0, 130.0, 37)

    def held(until_s: float) -> None:
        at = t[t <= until_s]
        for c in (0, 2, 5):
            expected = sigma[c] ** 2 * autocorrelation(times_s[c], at[:, None] - at)
            C = covariance(Used(wander), at, c) + np.diag(wander.left_out_variance(at)[:, c])
            assert pytest.approx(expected, abs=0.015 * sigma[c] ** 2) == C

    held(130.0)
    border = wander.restate(115.0, 3.0 * sigma, [20.0, 20.0, 20.0, 6.0, 6.0, 6.0])
    held(min(border, 115.0))
    C = covariance(Used(wander), np.array([border, border + 5.0]), 0) / (3.0 * sigma[0]) ** 2
    assert pytest.approx(autocorrelation(20.0, np.array([[0.0, 5.0], [5.0, 0.0]])), abs=0.02) == C
