"""Attitudes that no aircraft can have turned to are left out; turns, noise, gaps and a new alignment are not."""

import numpy as np
import pytest

from triline.solver.geometry.rotation import matrix_from_navigation
from triline.solver.navigation.attitude_jumps import LARGEST_SCATTER, AttitudeJumps, turn_between


def left_out(time_s, rpy_deg):
    jumps = AttitudeJumps()
    return np.array([jumps.is_left_out(t, tuple(np.radians(a))) for t, a in zip(time_s, rpy_deg, strict=True)])


def flown(rate_hz, seconds=6.0):
    """A turn with 30 deg/s over north, rolling by 60 deg/s, under a scatter of half a degree."""
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    rpy = np.stack([40.0 * np.sin(1.5 * t), 5.0 * np.cos(t), (350.0 + 30.0 * t) % 360.0], axis=1)
    return t, rpy + np.random.default_rng(3).normal(0.0, 0.5, rpy.shape)


@pytest.mark.parametrize("rate_hz", [5.0, 50.0, 400.0])
def test_turns_are_no_jumps_and_a_blunder_alone_is_left_out(rate_hz):
    t, rpy = flown(rate_hz)
    assert not left_out(t, rpy).any()
    wrong = (t > 3.0) & (t < 3.0 + max(0.1, 1.5 / rate_hz))
    rpy[wrong, 2] += 120.0
    assert wrong.any() and (left_out(t, rpy) == wrong).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_small_jumps_of_any_axis_are_left_out_where_samples_are_dense(axis):
    t, rpy = flown(200.0)
    rpy = rpy * [0.1, 0.1, 0.0]
    rpy[605:612, axis] += 12.0
    assert np.flatnonzero(left_out(t, rpy)).tolist() == list(range(605, 612))


def test_a_jump_that_stays_is_used_after_half_a_second():
    t, rpy = flown(100.0)
    rpy[t > 2.995, 2] += 90.0
    out = t[left_out(t, rpy)]
    assert out[0] == pytest.approx(3.0) and out[-1] == pytest.approx(3.49) and len(out) == 50


def test_after_a_silence_an_aircraft_may_have_turned_to_anywhere():
    t, rpy = flown(100.0)
    kept = (t < 2.0) | (t > 3.0)
    rpy[t > 3.0, 2] += 150.0
    assert not left_out(t[kept], rpy[kept]).any()


@pytest.mark.parametrize("kept", ["in bursts", "with gaps"])
def test_a_fast_turn_in_samples_at_irregular_times_is_no_jump(kept):
    """A multicopter that yaws by 250 deg/s."""
    t = np.arange(0.0, 6.0, 0.005)
    if kept == "in bursts":
        t = 0.04 * np.floor(t / 0.04) + 1e-4 * (np.arange(len(t)) % 8)
    else:
        t = t[np.random.default_rng(5).random(len(t) // 40).repeat(40) > 0.3]  # now and then nothing for 0.2 s
    rpy = np.stack([5.0 * np.sin(t), np.zeros_like(t), (250.0 * t) % 360.0], axis=1)
    assert not left_out(t, rpy).any()


def test_attitudes_out_of_order_are_told_by_others():
    t, rpy = flown(100.0)
    jumps = AttitudeJumps()
    assert not any(jumps.is_left_out(a, tuple(np.radians(b))) for a, b in zip(t[:50], rpy[:50], strict=True))
    assert not jumps.is_left_out(t[10], (3.0, 0.0, 0.0))
    assert not jumps.is_left_out(t[50], tuple(np.radians(rpy[50])))


def test_the_angle_between_attitudes_is_that_of_their_rotation():
    rng = np.random.default_rng(1)
    for _ in range(50):
        a, b = rng.uniform(-1.0, 1.0, (2, 3)) * [np.pi, 1.5, np.pi]
        R = matrix_from_navigation(*a).T @ matrix_from_navigation(*b)
        angle = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
        assert np.sin(turn_between(tuple(a), tuple(b))) == pytest.approx(angle, abs=1e-9)
    assert turn_between((0.0, 0.0, 0.001), (0.0, 0.0, 2.0 * np.pi - 0.001)) == pytest.approx(0.002)
    assert turn_between((0.02, 0.0, 0.0), (0.0, 0.02, 0.0)) <= LARGEST_SCATTER
