"""What the adjuster takes from the covariance of the trajectory instead of the project."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.nodes import convert
from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.config import build
from triline.nodes.errors import UserError
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.simulator.simulator import Simulator
from triline.solver.accuracy import angle_difference
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

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
    assert slow.shift[:2] == TOLD.shift[:2] and slow.offset_m == TOLD.offset_m and slow.wander[:2] == TOLD.wander[:2]
    assert slow.attitude_time_s < slow.wander_time_s < TOLD.wander_time_s
    for name in ("offset_m", "shift", "drift", "wander_m", "wander"):
        assert (np.array(getattr(TOLD.widened(covariance(3.0, 5.0)), name)) >= getattr(TOLD, name)).all()
    # all of the pose's covariance is slow then: no white noise is left of it
    assert np.diagonal(slow.without(P))[5] == pytest.approx(1e-12)


def test_a_filter_that_still_learns_has_faster_errors():
    slow = TOLD.widened(covariance(), learnt=(True,) * 6)
    assert slow.wander_time_s < TOLD.wander_time_s and slow.shift == TOLD.shift and slow.offset_m == TOLD.offset_m
    assert slow.attitude_time_s == 6.0


def test_an_attitude_that_is_measured_wanders_as_stated_where_positions_are_learnt():
    learnt = (True,) * 3 + (False,) * 3
    for slow in (TOLD.widened(covariance(), learnt), TOLD.widened(covariance(position=3.0))):
        assert slow.attitude_time_s == TOLD.wander_time_s > slow.wander_time_s
        assert slow.wander == TOLD.wander and slow.shift == TOLD.shift
        assert slow.grown(covariance(position=9.0)).attitude_time_s == TOLD.wander_time_s
        assert slow.grown(covariance(attitude=9.0)).attitude_time_s == 6.0


def test_what_is_left_of_a_covariance_is_one():
    """A heading that is being learnt is correlated with the other angles; what is left must stay positive definite."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        A = rng.standard_normal((6, 6)) * np.concatenate([TOLD.position_sigma, 3.0 * TOLD.attitude_sigma])
        P = A.T @ A
        rest = TOLD.without(P[None])[0]
        assert np.linalg.eigvalsh(rest / np.sqrt(np.outer(np.diag(rest), np.diag(rest)))).min() > 0.0
        kept = np.diagonal(rest) > 2e-6
        assert np.diagonal(rest)[kept] == pytest.approx(
            (np.diagonal(P) - np.square([*TOLD.position_sigma, *TOLD.attitude_sigma]))[kept]
        )


def test_in_the_middle_of_a_strip_only_the_wander_grows_and_shrinks_again():
    slow = TOLD.grown(covariance(4.0, 1.0))
    assert slow.offset_m == TOLD.offset_m and slow.wander == TOLD.wander and slow.wander_time_s < TOLD.wander_time_s
    assert slow.position_sigma == pytest.approx(4.0 * TOLD.position_sigma, rel=0.08)  # more: see `joined`
    assert (slow.position_sigma > 4.0 * TOLD.position_sigma).all()
    assert TOLD.differs(slow) and slow.differs(TOLD) and not TOLD.differs(TOLD)
    assert TOLD.grown(covariance(1.1, 1.1)) is TOLD


def fly(seed: int, strip_s: float, grade=MEMS, ties_per_s: float = 5.0):
    """One strip with raw inertial data; heading is found in motion on the way to it."""
    plan = FlightPlan(strips=1, strip_s=strip_s, lead_in_s=18.0)
    ties = ObservationPlan(tie_points_per_s=ties_per_s)
    return simulate(plan, seed, ErrorModel(gnss_rate_hz=2.0), ties, inertial=InertialPlan(grade, 50.0))


def adjuster_of(apriori: str = "trajectory") -> Adjuster:
    return Adjuster(apriori=apriori, update_s=1.0, update_rays=1000)


def run(adjuster: Adjuster, simulation, hole_s=(0.0, 0.0), killed_s: float = np.inf) -> list:
    """Final and live orientation; GNSS is out in a hole, the navigator is killed and started again at a time."""
    navigator = Navigator()
    out, project = [], None
    for message in Simulator(simulation).messages(EPOCH):
        time_s = (message.stamp_ns - EPOCH) * 1e-9
        if message.topic == "configuration/project":
            project = message
        if message.topic == "sensor/gnss" and hole_s[0] < time_s < hole_s[1]:
            continue
        if time_s > killed_s and project is not None:
            navigator, killed_s = Navigator(), np.inf
            navigator.step(project)
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


@pytest.mark.study
def test_a_heading_found_in_motion_is_weighted_by_its_covariance():
    """The heading is wrong by more than a degree and the project tells of 0.04 (two-sided; many seeds in bench)."""
    simulation = fly(2, 25.0, ties_per_s=8.0)
    by_poses, by_project = (nees(run(Adjuster(apriori=a), simulation), simulation) for a in ("trajectory", "project"))
    assert 0.4 < by_poses < 2.2
    assert by_project > max(3.0, 2.0 * by_poses)


@pytest.mark.study
def test_an_outage_in_the_middle_of_a_strip_is_weighted_by_what_it_leaves():
    """The refined orientation knows the larger error (two-sided, many seeds in bench)."""
    simulation, adjuster = fly(1, 38.0), adjuster_of()
    out = run(adjuster, simulation, hole_s=(26.0, 45.0))
    assert adjuster.counters["wander restated"] >= 2  # larger, and small again
    assert 0.15 < nees(out, simulation) < 2.5


def test_a_new_filter_in_the_middle_of_a_strip_has_another_error():
    """What it says of the time that the model takes for the old filter's is not used: no orientation there."""
    simulation, adjuster = fly(1, 34.0), adjuster_of()
    out = run(adjuster, simulation, killed_s=20.0)
    assert adjuster.counters["wander restated"] >= 1
    final = np.array([(convert.time_ns(o.body.timestamp) - EPOCH) * 1e-9 for o in out if "final" in o.topic])
    assert (final < 20.0).any() and not ((final > 21.0) & (final < 35.0)).any() and (final > 48.0).any()


@pytest.mark.study
def test_a_new_filter_that_aligns_after_the_strip_says_nothing_of_it():
    """Its poses of the strip are not taken for those of the old filter; old looks that waited for it are of no use."""
    simulation, adjuster = fly(1, 30.0, TACTICAL), adjuster_of()
    out = run(adjuster, simulation, killed_s=26.0)
    assert adjuster.counters["wander restated"] >= 1
    final = np.array([(convert.time_ns(o.body.timestamp) - EPOCH) * 1e-9 for o in out if "final" in o.topic])
    assert 25.5 < final.max() < 26.1
    assert nees(out, simulation) < 2.0


@pytest.mark.study
def test_with_measured_attitude_both_give_the_same_bytes():
    flight = simulate(FlightPlan(strip_s=12.0, lead_in_s=3.0), 1, ErrorModel(attitude_rate_hz=100.0))
    first, second = (
        [(o.topic, o.stamp_ns, o.body.SerializeToString(deterministic=True)) for o in run(Adjuster(apriori=a), flight)]
        for a in ("trajectory", "project")
    )
    assert first == second and len(first) > 200


def test_a_segment_without_length_is_refused():
    for value in (0, 0.0, -1.0):
        with pytest.raises(UserError, match=r"\[adjuster\]: segment_s is -?[01], wanted more than 0 s"):
            build(Adjuster, {"adjuster": {"segment_s": value}})
    with pytest.raises(UserError, match="segment_s is 'long', wanted a number"):
        build(Adjuster, {"adjuster": {"segment_s": "long"}})
    assert build(Adjuster, {"adjuster": {"segment_s": 2}}).options.segment_s == 2
    assert build(Adjuster, {}).options.segment_s == 0.0


def test_an_unknown_choice_is_refused():
    with pytest.raises(ValueError, match="apriori: 'pose' is not known, wanted one of trajectory, project"):
        Adjuster(apriori="pose")


def test_a_navigator_that_has_no_fix_yet_does_not_say_how_good_the_trajectory_is():
    """Another project in mid-strip: both begin again, and the first poses, without a fix, are known to 10 m."""
    plan = FlightPlan(strips=1, strip_s=18.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, 5, ErrorModel(attitude_rate_hz=100.0))
    navigator, adjuster, live, project = Navigator(), adjuster_of(), [], None
    for message in Simulator(simulation).messages(EPOCH):
        given = [message]
        if message.topic == "configuration/project":
            project = message
        elif project is not None and message.stamp_ns > EPOCH + 12 * 10**9:
            other = type(project.body).FromString(project.body.SerializeToString())
            other.image_sigma_px = 0.31
            given, project = [replace(project, body=other, stamp_ns=message.stamp_ns), message], None
        for one in given:
            made = list(navigator.step(one)) if one.topic in navigator.inputs else []
            for each in (one, *made):
                if each.topic in adjuster.inputs:
                    live += [x for x in adjuster.step(each) if x.topic == "orientation/live"]
    sigma = {round(x.body.timestamp.nanos * 1e-9 + x.body.timestamp.seconds - EPOCH * 1e-9, 2): x for x in live}
    before, after = (
        np.array([np.sqrt(x.body.covariance[::7][:3]) for t, x in sigma.items() if a < t < b])
        for a, b in ((3.5, 5.0), (14.5, 18.0))
    )
    assert len(before) > 10 and len(after) > 30
    assert (after < 1.2 * before.max(axis=0)).all()
