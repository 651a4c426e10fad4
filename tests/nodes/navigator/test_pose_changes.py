"""Smoothed positions of an inertial navigator change as fast as the adjuster takes them to, within a factor."""

import numpy as np
import pytest

from triline.nodes import convert
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.simulator.simulator import Simulator
from triline.solver.models.gauss_markov import autocorrelation
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import simulate

EPOCH = 1_700_000_000_000_000_000
LAGS_S = (1.0, 2.0, 4.0)


def changes(seed: int) -> np.ndarray:
    """Mean squares (lags, 3) of what the position's error changes by, over what is stated, on a strip."""
    plan = FlightPlan(strips=1, strip_s=40.0, lead_in_s=18.0)
    simulation = simulate(plan, seed, ErrorModel(), inertial=InertialPlan(TACTICAL, 50.0))
    navigator, smoothed, slow = Navigator(), [], None
    for message in Simulator(simulation).messages(EPOCH):
        if message.topic == "configuration/project":
            slow = convert.slow_errors_of(message.body).with_taken_back()
        if message.topic in navigator.inputs:
            made = navigator.step(message)
            smoothed += [convert.pose_sample(m.body) for m in made if m.topic == "trajectory/smoothed"]
    assert slow is not None
    t = (np.array([s.time_ns for s in smoothed]) - EPOCH) * 1e-9
    e = np.array([s.position_l for s in smoothed]) - simulation.flight.truth.at(t).position_l
    first_s = simulation.flight.strips[0].first_line_time_s
    grid = np.arange(first_s, first_s + 38.0, 0.1)
    at = np.column_stack([np.interp(grid, t, component) for component in e.T])
    found = np.array([np.mean((at[n:] - at[:-n]) ** 2, axis=0) for n in (round(10 * lag_s) for lag_s in LAGS_S)])
    correlation = autocorrelation(slow.wander_time_s, LAGS_S)[:, None]
    return found / (2.0 * np.square(slow.wander_m) * (1.0 - correlation))


@pytest.mark.study
def test_positions_change_as_stated():
    """Two-sided; with all that a wander becomes another by in the time a filter learns in it was a quarter to 0.4."""
    ratio = np.sqrt(np.mean([changes(seed) for seed in range(10, 13)], axis=0))
    assert (ratio > 0.42).all() and (ratio < 1.1).all(), ratio
