"""Positions without the steps of their fixes, unless the platform shakes."""

import numpy as np
import pytest

from triline.solver.matching.steady_positions import REACH_S, SteadyPositions

RATE_HZ, SECONDS = 200.0, 30.0
TIME_S = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)


def motion():
    """A platform that swings by metres within seconds."""
    return np.column_stack([70.0 * TIME_S, 3.0 * np.sin(0.9 * TIME_S), 1500.0 + 2.0 * np.cos(0.6 * TIME_S)])


def steps(fixes_hz, sigma_m=0.03, seed=1):
    """Errors that stay from fix to fix, a part of them from the last one (n, 3)."""
    rng = np.random.default_rng(seed)
    errors = np.zeros((int(SECONDS * fixes_hz) + 2, 3))
    for i in range(1, len(errors)):
        errors[i] = 0.4 * errors[i - 1] + 0.9 * sigma_m * rng.standard_normal(3)
    return errors[np.floor(TIME_S * fixes_hz + 1e-9).astype(int)]


def bend(error, half=33):
    """What errors (n, 3) do to patches of a third of a second: the middle against the mean, (m, 3)."""
    weight = np.exp(-0.5 * (np.arange(-half, half + 1) / (0.6 * half)) ** 2)
    mean = np.stack([np.convolve(column, weight / weight.sum(), "valid") for column in error.T], axis=1)
    return error[half:-half] - mean


def followed(position, late_s=0.0):
    """What the curve was (n, 3) when so much more was known than was asked for, at every tenth of a second."""
    steady, out = SteadyPositions(), np.full_like(position, np.nan)
    for i, (t, p) in enumerate(zip(TIME_S, position, strict=True)):
        steady.add(t, p)
        if late_s and i % 20 == 0 and i > 1000:
            asked = slice(i - int(late_s * RATE_HZ) - 40, i - int(late_s * RATE_HZ) + 1)
            out[asked] = steady.at(TIME_S[asked], position[asked])
    if not late_s:
        out = steady.at(TIME_S, position)
    return out, steady


@pytest.mark.parametrize("fixes_hz", [1.0, 5.0, 10.0])
def test_steps_of_fixes_do_not_bend_patches(fixes_hz):
    errors = steps(fixes_hz)
    curve, steady = followed(motion() + errors)
    assert steady.smooth
    inside = slice(200, -200)
    before, after = bend(errors[inside]).std(), bend((curve - motion())[inside]).std()
    assert after < before / 3
    # the curve stays with the positions
    assert np.abs(curve - motion() - errors)[inside].std() < 0.04


def test_a_curve_that_ends_soon_is_nearly_as_good():
    errors = steps(5.0)
    curve, _ = followed(motion() + errors, late_s=0.05)
    known = np.isfinite(curve[:, 0])
    before, after = bend(errors[known]).std(), bend((curve - motion())[known]).std()
    assert known.mean() > 0.7 and after < before / 2


def test_the_platform_itself_shakes():
    shaking = motion() + 0.05 * np.sin(2 * np.pi * 4.0 * TIME_S)[:, None] * [0.3, 1.0, 0.5]
    for position in (shaking, shaking + steps(5.0, 0.002)):
        curve, steady = followed(position)
        assert not steady.smooth
        assert (curve == position).all()


def test_white_noise_is_no_step():
    """It is left to what takes it away without touching motion as fast as this."""
    noise = 0.02 * np.random.default_rng(2).standard_normal((len(TIME_S), 3))
    position = motion() + 0.05 * np.sin(2 * np.pi * 3.0 * TIME_S)[:, None] + noise
    assert not followed(position)[1].smooth


def test_a_start_far_off_is_forgotten():
    errors = steps(5.0)
    errors[: int(0.2 * RATE_HZ)] += 8.0
    shaking = errors + 0.05 * np.sin(2 * np.pi * 4.0 * TIME_S)[:, None]
    assert followed(motion() + errors)[1].smooth
    assert not followed(motion() + 0.1 * shaking)[1].smooth


def test_motion_is_kept_to_millimetres_and_gaps_are_left_alone():
    position = motion() + 1e-4 * steps(5.0)
    steady = SteadyPositions()
    there = (TIME_S < 15.0) | (TIME_S > 15.0 + 2 * REACH_S)
    for t, p in zip(TIME_S[there], position[there], strict=True):
        steady.add(t, p)
    steady._blocks.clear()
    steady._blocks.extend([(0.0, 1.0)] * 3)  # as if there were steps
    asked = np.arange(2.0, SECONDS - 2.0, 0.013)
    measured = np.full((len(asked), 3), -1.0)
    curve = steady.at(asked, measured)
    alone = (curve == -1.0).all(axis=1)
    assert alone[np.abs(asked - 15.0 - REACH_S) < 0.3].all()
    away = np.abs(asked - 15.0 - REACH_S) > 2 * REACH_S
    true = np.column_stack([70 * asked, 3 * np.sin(0.9 * asked), 1500 + 2 * np.cos(0.6 * asked)])
    assert not alone[away].any()
    assert np.abs(bend((curve - true)[away], half=13)).max() < 1.5e-3


def test_it_costs_no_more_as_the_flight_goes_on():
    steady = SteadyPositions(120.0)
    for i in range(40_000):
        steady.add(i / RATE_HZ, np.zeros(3))
    assert len(steady._knots) <= 1201 and len(steady._time) <= 4096


@pytest.mark.parametrize("early", [1, 2, 3])
def test_first_positions_of_long_ago_are_passed_over(early):
    """A knot for each tenth of a second since would be one for each of fifty years, too, which take hours."""
    position = motion()[:2000]
    late, steady = SteadyPositions(), SteadyPositions()
    for i in range(early):
        late.add(-1e4 + 0.005 * i, position[i])
    for t, p in zip(TIME_S, position, strict=False):
        late.add(t, p)
        steady.add(t, p)
    inside = slice(400, 1600)
    curve, wanted = (s.at(TIME_S[inside], position[inside]) for s in (late, steady))
    np.testing.assert_allclose(curve, wanted, atol=1e-3)
    assert len(late._knots) < 300
