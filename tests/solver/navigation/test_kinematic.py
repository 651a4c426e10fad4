"""Kinematic filter: consistency, lag, outages, jumps, late and double fixes."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.geometry.frames import LocalFrame, R_lc_from_navigation, opk_covariance_from_navigation
from triline.solver.geometry.rotation import (
    angles_from_matrix,
    matrix_from_angles,
    matrix_from_navigation,
    quaternion_from_matrix,
)
from triline.solver.navigation.kinematic import KinematicFilter
from triline.solver.navigation.kinematic_model import N_STATES, KinematicOptions, quintic, transition
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import measured_errors, navigate, slow_errors_of

FRAME = LocalFrame(47.0, 8.0, 400.0)
LEVER = np.array([0.5, -0.2, -1.2])
NOISE = 0.03


class Flight:
    """A smooth motion with noisy fixes of the antenna."""

    def __init__(self, seconds=30.0, seed=0):
        self.t = np.arange(0.0, seconds, 0.005)
        t = self.t
        self.position = np.stack([70 * t, 2 * np.sin(0.4 * t), 1500 + np.sin(0.3 * t)], axis=1)
        self.rpy = np.stack([0.02 * np.sin(t), 0.03 * np.cos(0.7 * t), np.pi / 2 + 0.02 * np.sin(0.2 * t)], axis=1)
        self.R_lc = R_lc_from_navigation(FRAME, self.position, self.rpy)
        self.antenna = self.position + FRAME.R_ln(self.position) @ matrix_from_navigation(*self.rpy.T) @ LEVER
        noise = np.random.default_rng(seed).standard_normal(self.antenna.shape)
        self.measured = self.antenna + NOISE * noise

    def run(self, engine, fix=lambda i, t: i % 40 == 0, change=lambda t, z: z, extra=()):
        cov, R = np.eye(3) * 1e-10, np.eye(3) * NOISE**2
        late = {}
        for at, of in extra:  # sample at whose turn the fix of another sample comes
            late.setdefault(at, []).append(of)
        poses = []
        for i, t in enumerate(self.t):
            poses += engine.add_attitude(t, self.rpy[i], cov)
            if fix(i, t):
                poses += engine.add_gnss(t, change(t, self.measured[i]), R)
            for j in late.get(i, ()):
                poses += engine.add_gnss(self.t[j], self.measured[j], R)
        return poses + engine.finish()

    def error(self, poses, smoothed):
        chosen = [p for p in poses if p.smoothed == smoothed]
        i = np.rint(np.array([p.time_s for p in chosen]) / 0.005).astype(int)
        return chosen, np.array([p.position_l for p in chosen]) - self.position[i], i


def engine(**changes):
    return KinematicFilter(FRAME, KinematicOptions(lever_arm_b=LEVER, **changes))


def test_every_attitude_sample_gives_a_filtered_pose_at_once_and_a_smoothed_one_after_the_lag():
    flight, e = Flight(10.0), engine(lag_s=1.0)
    cov, R = np.eye(3) * 1e-10, np.eye(3) * NOISE**2
    for i, t in enumerate(flight.t):
        filtered = e.add_attitude(t, flight.rpy[i], cov)
        assert [p.time_s for p in filtered if not p.smoothed] == ([t] if i > 0 else [])
        if i % 40 == 0:
            smoothed = e.add_gnss(t, flight.measured[i], R)
            assert all(p.smoothed and t - 1.2 - 1e-6 <= p.time_s <= t - 1.0 + 1e-6 for p in smoothed)
    poses = flight.run(engine())
    times = [p.time_s for p in poses if p.smoothed]
    assert times == sorted(times) and len(times) == len(flight.t)


def test_attitude_passes_unchanged_and_position_is_that_of_the_camera():
    flight = Flight(20.0)
    poses = flight.run(engine())
    for smoothed, position_m in ((False, 0.07), (True, 0.03)):
        chosen, error, i = flight.error(poses, smoothed)
        late = i > 1000
        assert np.sqrt(np.mean(error[late] ** 2)) < position_m  # with the lever arm left out it would be a metre
        angles = angles_from_matrix(flight.R_lc[i[late]])
        assert np.abs(np.array([p.angles for p in chosen])[late] - angles).max() < 2e-7
        q = quaternion_from_matrix(matrix_from_angles(*np.array([p.angles for p in chosen]).T))
        assert np.abs(np.abs(np.sum(q * np.array([p.quaternion for p in chosen]), axis=1)) - 1).max() < 1e-12


def test_attitude_covariance_is_turned_into_that_of_omega_phi_kappa():
    flight, e = Flight(3.0), engine(attitude_sigma=np.array([1e-4, 2e-4, 3e-4]))
    cov = np.diag(np.square([2e-5, 3e-5, 4e-5]))
    for i, t in enumerate(flight.t):
        poses = e.add_attitude(t, flight.rpy[i], cov)
        if i % 40 == 0:
            e.add_gnss(t, flight.measured[i], np.eye(3) * NOISE**2)
    R_ln = FRAME.R_ln(flight.position[-1:])
    want = opk_covariance_from_navigation(flight.rpy[-1:], flight.R_lc[-1:], R_ln, cov)[0]
    want = want + np.diag(np.square([1e-4, 2e-4, 3e-4]))
    assert poses[-1].covariance[3:, 3:] == pytest.approx(want, rel=0.02, abs=1e-11)


def test_the_filter_is_consistent_and_smoothing_helps():
    values = {False: [], True: []}
    rmse = {False: [], True: []}
    for seed in range(4):
        simulation = simulate(FlightPlan(strip_s=20.0), seed, ErrorModel(attitude_rate_hz=50.0))
        poses = navigate(simulation)
        slow = slow_errors_of(simulation.errors)
        for smoothed, list_ in values.items():
            errors = measured_errors(simulation, poses, smoothed)
            white = (errors.error - simulation.slow.at(errors.time_s))[:, :3]
            cov = slow.without(errors.covariance)[:, :3, :3]
            list_.append(np.mean(np.einsum("ni,nij,nj->n", white, np.linalg.inv(cov), white)) / 3)
            rmse[smoothed].append(np.sqrt(np.mean(white**2)))
    assert 0.5 < np.mean(values[False]) < 1.2
    assert 0.5 < np.mean(values[True]) < 1.3
    assert np.mean(rmse[True]) < 0.5 * np.mean(rmse[False])


def test_the_covariance_owns_up_to_the_slow_gnss_error():
    nees = []
    for seed in range(12):
        plan = FlightPlan(strip_s=12.0, lead_in_s=4.0, lead_out_s=1.0)
        simulation = simulate(plan, 100 + seed, ErrorModel(attitude_rate_hz=50.0))
        errors = measured_errors(simulation, navigate(simulation), True)
        nees.append(errors.nees.mean())
    assert 0.6 < np.mean(nees) < 1.5


def test_an_outage_is_coasted_and_flagged():
    flight, e = Flight(30.0), engine()
    poses = flight.run(e, fix=lambda i, t: i % 40 == 0 and not 10.0 < t < 20.0)
    filtered = {round(p.time_s, 3): p for p in poses if not p.smoothed}
    assert filtered[11.0].valid and not filtered[15.0].valid and "GNSS" in filtered[15.0].reason
    assert filtered[21.0].valid
    assert e.counters["gnss outage"] == 1
    assert any("coasting" in event.text for event in e.take_events())
    chosen, error, i = flight.error(poses, False)
    sigma = np.sqrt([np.diag(p.covariance)[:3] for p in chosen])
    inside = (i > 2100) & (i < 4000)
    assert (np.abs(error) < 4 * sigma)[inside].all()
    assert sigma[3990].min() > 20 * sigma[1990].max()  # says that it does not know
    smoothed = {round(p.time_s, 3): p for p in poses if p.smoothed}
    assert not smoothed[15.0].valid and smoothed[25.0].valid
    _, bridged, j = flight.error(poses, True)
    inside = (j > 2100) & (j < 3900)
    sigma = np.sqrt([np.diag(p.covariance)[:3] for p in poses if p.smoothed])
    assert np.abs(bridged[inside]).max() < 0.2 * np.abs(error[(i > 2100) & (i < 3900)]).max()
    assert (np.abs(bridged) < 4 * sigma)[inside].all()
    assert len(smoothed) == len(flight.t)


def test_a_single_jump_is_refused_and_a_lasting_one_is_followed():
    flight, e = Flight(20.0), engine()
    poses = flight.run(e, change=lambda t, z: z + (abs(t - 10.0) < 1e-6) * np.array([30.0, 0, 0]))
    assert e.counters["gnss refused"] == 1 and e.counters["position jump"] == 0
    _, error, i = flight.error(poses, False)
    assert np.abs(error[i > 1500]).max() < 0.3
    lasting = engine()
    poses = flight.run(lasting, change=lambda t, z: z + (t >= 10.0) * np.array([30.0, 0, 0]))
    assert lasting.counters["position jump"] == 1
    _, error, i = flight.error(poses, False)
    assert np.abs(error[i > 3000] - [30.0, 0, 0]).max() < 0.5


def test_a_doubtful_fix_is_weighted_down():
    flight, e = Flight(20.0), engine()
    poses = flight.run(e, change=lambda t, z: z + (abs(t - 10.0) < 1e-6) * np.array([0.3, 0, 0]))
    assert e.counters["gnss weighted down"] >= 1
    _, error, i = flight.error(poses, True)
    assert np.abs(error[i > 1000]).max() < 0.15


def test_late_fixes_are_filtered_in_again_and_too_late_ones_counted():
    flight = Flight(20.0)
    on_time = flight.run(engine())
    skipped = {2000, 2040, 2080}
    late, without = engine(), engine()
    poses = flight.run(late, fix=lambda i, t: i % 40 == 0 and i not in skipped, extra=[(i + 100, i) for i in skipped])
    flight.run(without, fix=lambda i, t: i % 40 == 0 and i not in skipped)
    assert late.counters["gnss late"] == 3
    a = {p.time_s: p.position_l for p in on_time if not p.smoothed and p.time_s > 12.0}
    b = {p.time_s: p.position_l for p in poses if not p.smoothed and p.time_s > 12.0}
    assert max(np.abs(a[t] - b[t]).max() for t in a) < 1e-6
    too_late = engine()
    flight.run(too_late, fix=lambda i, t: i % 40 == 0 and i != 2000, extra=[(2600, 2000)])
    assert too_late.counters["gnss too late"] == 1


def test_duplicates_and_disorder_change_nothing():
    flight = Flight(10.0)
    plain = flight.run(engine())
    e = engine()
    again = flight.run(e, extra=[(i, i) for i in range(0, 2000, 40)])
    assert e.counters["gnss duplicate"] == 50
    assert all((p.position_l == q.position_l).all() for p, q in zip(plain, again, strict=True))
    assert e.add_attitude(flight.t[-1], flight.rpy[-1], np.eye(3)) == []
    assert e.add_attitude(flight.t[-5], flight.rpy[-5], np.eye(3)) == []
    assert e.counters["attitude duplicate"] == 1 and e.counters["attitude out of order"] == 1


def test_an_attitude_gap_is_counted():
    flight, e = Flight(10.0), engine()
    keep = (flight.t < 5.0) | (flight.t > 5.5)
    flight.t, flight.rpy = flight.t[keep], flight.rpy[keep]
    flight.measured = flight.measured[keep]
    flight.run(e)
    assert e.counters["attitude gap"] == 1


@pytest.mark.parametrize("every", [19, 20, 40])  # 200 Hz: about ten samples a second and five
def test_slow_attitude_has_no_gaps_but_those(every):
    """Each second sample of a sensor with 10 Hz was told as "attitude gap of 0.10 s"."""
    flight, e = Flight(20.0), engine()
    keep = (np.arange(len(flight.t)) % every == 0) & ~((flight.t > 9.0) & (flight.t < 10.0))
    flight.t, flight.rpy, flight.measured = flight.t[keep], flight.rpy[keep], flight.measured[keep]
    flight.run(e)
    assert e.counters["attitude gap"] == 1


def test_after_a_long_silence_it_begins_again():
    flight, e = Flight(20.0), engine()
    keep = (flight.t < 5.0) | (flight.t > 12.0)
    flight.t, flight.rpy, flight.measured = flight.t[keep], flight.rpy[keep], flight.measured[keep].copy()
    flight.measured[flight.t > 12.0] += [5000.0, -300.0, 0.0]
    poses = flight.run(e)
    assert e.counters["gnss refused"] == 0
    times = np.array([p.time_s for p in poses if p.smoothed])
    assert (times < 5.0).sum() == 1000 and (times > 12.0).sum() > 1500
    late = [p for p in poses if p.smoothed and p.time_s > 14.0]
    want = np.interp([p.time_s for p in late], flight.t, flight.measured[:, 0])
    assert np.abs(np.array([p.position_l[0] for p in late]) - want).max() < 2.0


def test_transition_is_a_semigroup_and_quintic_goes_through_its_ends():
    o = KinematicOptions(wander_sigma_m=np.array([1.0, 2.0, 3.0]), wander_time_s=20.0)
    Fa, Qa = transition(0.3, o)
    Fb, Qb = transition(0.5, o)
    F, Q = transition(0.8, o)
    assert Fb @ Fa == pytest.approx(F, abs=1e-12)
    assert Fb @ Qa @ Fb.T + Qb == pytest.approx(Q, rel=1e-9, abs=1e-12)
    x = np.random.default_rng(0).standard_normal((2, N_STATES))
    for t, want in ((0.0, x[0]), (0.4, x[1])):
        position, velocity = quintic(np.array([t]), np.array([0.4]), x[:1], x[1:])
        assert position[0] == pytest.approx(want[:3]) and velocity[0] == pytest.approx(want[3:6])
    h = 1e-6
    ahead, back = (quintic(np.array([0.2 + d]), np.array([0.4]), x[:1], x[1:])[0][0] for d in (h, -h))
    assert quintic(np.array([0.2]), np.array([0.4]), x[:1], x[1:])[1][0] == pytest.approx(
        (ahead - back) / (2 * h), rel=1e-6
    )
