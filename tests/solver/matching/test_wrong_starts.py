"""Matching with an orientation that is found anew in flight: what has been told of earlier times moves with it."""

import numpy as np
import pytest

from triline.nodes.cli import study_starts
from triline.nodes.cli.study_starts import DIRECTIONS, FLIGHT, WANTED_PX, WRONG_PX, displacement_px, wrong_start
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.matching.current_orientation import CurrentOrientation

SIGMA = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])


@pytest.fixture
def orientation():
    o = CurrentOrientation()
    for t in np.arange(0.0, 12.0, 0.05):
        o.add_pose(t, np.array([70 * t, 0, 1000.0]), np.array([0, 0, 0, 1.0]), np.diag(SIGMA**2))
    return o


def corrected(orientation, corrections):
    """(n, 3) what is added to the position of 1, 4 and 9 s, and to phi."""
    for t in np.arange(0.0, 10.0, 0.05):
        orientation.add_correction(t, corrections(t), np.diag((0.3 * SIGMA) ** 2))
    position, R = orientation.at(np.array([1.0, 4.0, 9.0]))
    return position - np.array([[70.0, 0, 1000], [280, 0, 1000], [630, 0, 1000]]), R[:, 0, 2]


def test_a_correction_that_jumps_holds_for_what_was_flown_before(orientation):
    jump = np.array([3.0, 0, 0, 0, 0.05, 0])
    position, phi = corrected(orientation, lambda t: jump * (t > 6.0))
    np.testing.assert_allclose(position[:, 0], 3.0, atol=1e-6)
    np.testing.assert_allclose(phi, np.sin(0.05), atol=1e-6)


def test_slow_errors_stay_where_they_were(orientation):
    slow = np.array([0.1, 0, 0, 0, 1e-4, 0])
    position, phi = corrected(orientation, lambda t: slow * t)
    np.testing.assert_allclose(position[:, 0], [0.1, 0.4, 0.9], atol=0.01)
    np.testing.assert_allclose(phi, [1e-4, 4e-4, 9e-4], atol=1e-5)


def test_a_new_strip_knows_nothing_of_the_last_jump(orientation):
    orientation.add_correction(1.0, np.zeros(6), np.diag(SIGMA**2))
    orientation.forget_corrections()
    orientation.add_correction(1.2, 9.0 * np.ones(6), np.diag(SIGMA**2))
    orientation.add_correction(1.4, 9.0 * np.ones(6), np.diag(SIGMA**2))
    np.testing.assert_allclose(orientation.at(np.array([1.0]))[0], [[79.0, 9.0, 1009.0]], atol=1e-6)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_wrong_start_is_as_wrong_as_it_says(direction):
    simulation = simulated_flight({**FLIGHT, "seconds": 12.0, "images": False, "seed": 1}).simulation
    wrong = wrong_start(simulation, direction)
    flight, error = simulation.flight, np.zeros((1, 6))
    # of the same sensors: what has been added to them
    k = DIRECTIONS.index(direction)
    if k < 3:
        size = np.ptp(np.unique(np.round(wrong.attitude_rpy - simulation.attitude_rpy, 12)))
        error[0, 3:] = np.where([direction == "heading"] * 3, [0, 0, size], [size, 0, 0])
    else:
        there, here = (flight.frame.from_geodetic(*s.gnss_geodetic.T) for s in (wrong, simulation))
        np.testing.assert_allclose(there - here, (there - here)[:1].repeat(len(there), axis=0), atol=1e-6)
        error[0, :3] = (there - here)[0]
        assert np.argmax(np.abs(error[0])) == k - 3
    largest = displacement_px(flight, np.array([flight.truth.end_s / 2]), error).max()
    assert 0.8 * WRONG_PX < largest < 1.5 * WRONG_PX


@pytest.mark.study
def test_after_the_first_window_predictions_are_right():
    row = study_starts.fly(("roll", False, {**FLIGHT, "pixels": 500, "seconds": 25.0, "seed": 1}))
    assert row["ties"] > 150
    assert row["on_the_ground_px"]["before"][1] > 0.9 * WRONG_PX
    for key in ("between_views_px", "on_the_ground_px"):
        median, most = row[key]["after"]
        assert 0.05 < median < 1.0 and most < WANTED_PX
    assert "1 flights, 0 not within" in study_starts.lines([row])[-1]
