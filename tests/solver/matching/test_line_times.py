"""When lines were imaged: at a rate, or at times of their own."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.matching.line_times import LineTimes


def triggered(n: int = 400) -> np.ndarray:
    """Times of lines at about 100 a second, from 5 s on, of a camera that follows the speed over the ground."""
    u = np.arange(n)
    return 5.0 + u / 100.0 + 0.3 * (1.0 - np.cos(u / 150.0))


def test_a_constant_rate_stays_one():
    times = LineTimes(5.0, 100.0)
    u = np.linspace(-3.0, 900.0, 50)
    for first in range(0, 400, 25):
        times.add(first, np.round(5.0 + (first + np.arange(25)) / 100.0, 6))  # rounded to microseconds
    assert times.is_constant
    np.testing.assert_array_equal(times.time_of(u), 5.0 + u / 100.0)
    np.testing.assert_array_equal(times.line_of(5.0 + u / 100.0), (5.0 + u / 100.0 - 5.0) * 100.0)


def test_lines_of_their_own_times_there_and_back():
    true, times = triggered(), LineTimes(5.0, 100.0)
    for first in (0, 25, 50, 75, 50, 75, 100, 125, 200, 300, 375):  # of two views, one behind the other, and with gaps
        times.add(first, true[first : first + 25])
    u = np.concatenate([np.arange(0.0, 150.0, 0.7), np.arange(200.0, 224.0, 0.7), np.arange(375.0, 399.0, 0.7)])
    # the first lines were at the rate to two hundredths of a line
    np.testing.assert_allclose(times.time_of(u), np.interp(u, np.arange(400), true), atol=2.1e-4)
    v = np.arange(-20.0, 450.0, 0.3)
    np.testing.assert_allclose(times.line_of(times.time_of(v)), v, atol=1e-6)
    assert (np.diff(times.time_of(v)) > 0).all()
    np.testing.assert_allclose(times.time_of(449.0) - times.time_of(399.0), 0.5)  # after the last one the rate holds
    between = times.time_of(np.arange(224.0, 301.0))
    np.testing.assert_allclose(np.diff(between), (true[300] - true[224]) / 76)  # lines that nobody has seen


def test_what_cannot_be():
    for first_s, rate in ((0.0, float("nan")), (0.0, 0.0), (float("inf"), 10.0)):
        with pytest.raises(ValueError, match="wanted a positive rate"):
            LineTimes(first_s, rate)
    for begun in (5.0 + np.arange(100) / 100.0, triggered(100)):
        times = LineTimes(5.0, 100.0)
        times.add(0, begun)
        before = times.time_of(np.arange(120.0))
        for first, t in (
            (0, [9.0, 9.01]),  # begun anew under its name
            (100, [5.0, 5.01]),  # a second too early
            (100, [13.0, 13.01]),  # after a pause of seven seconds
            (10**12, [6.1, 6.11]),  # a number that a bit was lost of
        ):
            told = rf"line {first} came [+-]\d+ lines off its time; a strip that begins anew wants another name"
            with pytest.raises(ValueError, match=told):
                times.add(first, np.array(t))
        with pytest.raises(ValueError, match="times of the lines from 100 on are not finite"):
            times.add(100, np.array([6.5, np.nan]))
        np.testing.assert_array_equal(times.time_of(np.arange(120.0)), before)
        times.add(100, np.array([9.0, 9.01]))  # after a pause
        assert times.time_of(100.0) == 9.0


def test_stamps_of_two_views_that_go_back_a_little():
    """They come from programs, are off by a line and more, and belong to the same lines."""
    rng, times = np.random.default_rng(2), LineTimes(5.0, 1000.0)
    for first in range(0, 4000, 50):
        for _ in "FN":
            times.add(first, 5.0 + np.arange(first, first + 50) / 998.0 + 5e-4 * rng.standard_normal(50))
    u = np.arange(3990.0)
    assert (np.diff(times.time_of(u)) > 0).all()
    assert np.abs(times.time_of(u) - 5.0 - u / 998.0).max() < 3e-3
