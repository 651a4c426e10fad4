"""What the adjuster takes from the covariance of the trajectory instead of the project."""

from __future__ import annotations

import numpy as np
import pytest

from triline.nodes import convert
from triline.nodes.adjuster import Adjuster
from triline.nodes.navigator import Navigator
from triline.nodes.simulator import Simulator
from triline.solver.accuracy import angle_difference
from triline.solver.inertial_data import MEMS
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import simulate
from triline.solver.slow_errors import SlowErrors

EPOCH = 1_700_000_000_000_000_000
TOLD = SlowErrors((0.5, 0.5, 0.8), (1e-4, 1e-4, 2e-4), (1e-5,) * 3, (1.0, 1.0, 1.5), (1e-5,) * 3, 30.0)


def covariance(position: float = 1.0, attitude: float = 1.0) -> np.ndarray:
    return np.diag(np.concatenate([TOLD.position_sigma * position, TOLD.attitude_sigma * attitude]) ** 2)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 1.2])
def test_a_pose_as_uncertain_as_the_project_says_changes_nothing(factor):
    assert TOLD.widened(covariance(factor, factor)) is TOLD


def test_a_less_certain_pose_makes_its_components_less_certain_and_none_more():
    P = covariance()
    P[5, 5] = 0.02**2
    slow = TOLD.widened(P)
    assert slow.shift[2] == pytest.approx(np.sqrt(0.02**2 + TOLD.shift[2] ** 2 - TOLD.attitude_sigma[2] ** 2))
    assert slow.attitude_sigma[2] > 0.02 and slow.drift[2] > 0.019
    assert slow.shift[:2] == TOLD.shift[:2] and slow.offset_m == TOLD.offset_m and slow.wander_m == TOLD.wander_m
    assert slow.wander_time_s < TOLD.wander_time_s
    for name in ("offset_m", "shift", "drift", "wander_m", "wander"):
        assert (np.array(getattr(TOLD.widened(covariance(3.0, 5.0)), name)) >= getattr(TOLD, name)).all()
    # all of the pose's covariance is slow then: no white noise is left of it
    assert np.diagonal(slow.without(P))[5] == pytest.approx(1e-12)


def test_a_filter_that_still_learns_has_faster_errors():
    slow = TOLD.widened(covariance(), learning=True)
    assert slow.wander_time_s < TOLD.wander_time_s and slow.shift == TOLD.shift and slow.offset_m == TOLD.offset_m


def run(adjuster: Adjuster, simulation) -> list:
    navigator = Navigator()
    out = []
    for message in Simulator(simulation).messages(EPOCH):
        made = list(navigator.step(message)) if message.topic in navigator.inputs else []
        for each in (message, *made):
            if each.topic in adjuster.inputs:
                out += adjuster.step(each)
    for each in navigator.finish():
        if each.topic in adjuster.inputs:
            out += adjuster.step(each)
    return [*out, *adjuster.finish()]


def nees(out: list, simulation) -> float:
    """Mean over the final orientation of e^T C^-1 e / 6."""
    bodies = [o.body for o in out if o.topic == "orientation/final"][::4]
    t = np.array([(convert.time_ns(b.timestamp) - EPOCH) * 1e-9 for b in bodies])
    truth = simulation.flight.truth.at(t)
    samples = [convert.pose_sample(b) for b in bodies]
    angles = np.array([list(b.angles) for b in bodies])
    e = np.hstack(
        [np.array([s.position_l for s in samples]) - truth.position_l, angle_difference(angles, truth.angles)]
    )
    C = np.array([s.covariance for s in samples])
    return float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(C, e[:, :, None])[:, :, 0])) / 6.0)


def test_a_heading_found_in_motion_is_weighted_by_its_covariance():
    """The heading is wrong by more than a degree and the project tells of 0.04: seeds in a two-sided band."""
    by_poses, by_project = [], []
    for seed in (2, 3):
        plan = FlightPlan(strip_s=25.0, lead_in_s=18.0)
        simulation = simulate(plan, seed, ErrorModel(gnss_rate_hz=2.0), inertial=InertialPlan(MEMS, 50.0))
        out = run(Adjuster(apriori="trajectory"), simulation)
        by_poses.append(nees(out, simulation))
        if seed == 2:
            by_project.append(nees(run(Adjuster(apriori="project"), simulation), simulation))
    assert 0.5 < np.mean(by_poses) < 1.8
    assert np.mean(by_project) > 3.0


def test_with_measured_attitude_both_give_the_same_bytes():
    flight = simulate(FlightPlan(strip_s=12.0, lead_in_s=3.0), 1, ErrorModel(attitude_rate_hz=100.0))
    first, second = (
        [(o.topic, o.stamp_ns, o.body.SerializeToString(deterministic=True)) for o in run(Adjuster(apriori=a), flight)]
        for a in ("trajectory", "project")
    )
    assert first == second and len(first) > 200


def test_an_unknown_choice_is_refused():
    with pytest.raises(ValueError, match="apriori: 'pose' is not known, wanted one of trajectory, project"):
        Adjuster(apriori="pose")
