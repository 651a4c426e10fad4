"""Filter and smoother on simulated flights: accuracy, and whether errors are as large as the covariance says."""

from dataclasses import replace

import inertial_flights as sim
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from triline.solver.geometry import earth
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import R_BC_NOMINAL, angles_from_matrix
from triline.solver.navigation.alignment import align
from triline.solver.navigation.carried import (
    CameraMount,
    NavigationStates,
    NavigationTrajectory,
    camera_jacobian,
    camera_poses,
    navigation_jacobian,
)
from triline.solver.navigation.error_state import ErrorStateFilter, Estimate, NavigationSettings, Start, bias_variances
from triline.solver.navigation.filter_pass import node_times, rates_at, run_filter
from triline.solver.navigation.inertial_data import TACTICAL, GnssData, InertialGrade
from triline.solver.navigation.observations import AntennaPosition, AntennaVelocity, Heading, ZeroVelocity
from triline.solver.navigation.post_processing import (
    NavigationError,
    headings,
    held_out_misses,
    navigate,
    zero_velocities,
)
from triline.solver.navigation.smoother import smooth
from triline.solver.navigation.strapdown import State, rotation_matrix
from triline.solver.simulation.inertial import gnss_fixes, survey_flight, with_errors

SEEDS = (1, 2, 3)


@pytest.fixture(scope="module")
def tactical():
    flights = [sim.flight(seed=s) for s in SEEDS]
    return [(f, navigate(f.inertial, f.gnss, f.settings)[0]) for f in flights]


@pytest.fixture(scope="module")
def mems():
    flights = [sim.flight("mems", duration_s=400.0, seed=s) for s in (4, 5)]
    return [(f, navigate(f.inertial, f.gnss, f.settings)[0]) for f in flights]


def statistics(results, smoothed: bool):
    """RMS errors (9,) after 120 s and RMS of errors over sigma (9,), over flights."""
    square, ratio = [], []
    for f, r in results:
        trajectory = r.smoothed if smoothed else r.filtered
        t = np.arange(120.0, trajectory.end_s - 1.0, 0.5) + 0.123
        e = sim.errors(trajectory, f.motion, t)
        square.append(np.mean(e**2, axis=0))
        ratio.append(np.mean((e / trajectory.sigmas(t)) ** 2, axis=0))
    return np.sqrt(np.mean(square, axis=0)), np.sqrt(np.mean(ratio, axis=0))


@pytest.mark.study
def test_tactical_grade_accuracy(tactical):
    forward, _ = statistics(tactical, False)
    smoothed, _ = statistics(tactical, True)
    assert (forward[:3] <= [0.010, 0.010, 0.017]).all(), forward[:3]
    assert (np.degrees(forward[6:]) <= [0.0006, 0.0005, 0.0010]).all(), np.degrees(forward[6:])
    assert (forward[:3] / smoothed[:3] >= 1.5).all()
    assert forward[8] / smoothed[8] >= 1.5


@pytest.mark.parametrize("smoothed", [False, True])
def test_errors_are_as_large_as_the_covariance_says(tactical, mems, smoothed):
    for results in (tactical, mems):
        _, ratio = statistics(results, smoothed)
        assert (ratio > 0.65).all() and (ratio < 1.4).all(), ratio
        assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.15, ratio


def test_mems_grade_accuracy(mems):
    forward, _ = statistics(mems, False)
    smoothed, _ = statistics(mems, True)
    assert (forward[:3] <= [0.025, 0.025, 0.04]).all()
    assert (np.degrees(forward[6:]) <= [0.04, 0.04, 0.1]).all(), np.degrees(forward[6:])
    assert (forward[:3] / smoothed[:3] >= 1.5).all()


def test_innovations_are_white_and_of_unit_variance(tactical):
    z = np.concatenate([[i.value / i.sigma for i in r.forward.innovations[10:]] for _, r in tactical])
    assert (np.abs(np.std(z, axis=0) - 1.0) < 0.08).all()
    assert (np.abs(np.mean(z, axis=0)) < 0.1).all()
    for k in range(3):
        assert abs(np.corrcoef(z[1:, k], z[:-1, k])[0, 1]) < 0.1
    nis = np.concatenate([[i.nis for i in r.forward.innovations] for _, r in tactical])
    assert 2.7 < nis.mean() < 3.3


def test_biases_are_found_within_their_sigmas(tactical):
    z = []
    for f, r in tactical:
        e, P = r.smoothed.nodes, r.smoothed.P
        k = len(e) // 2
        i = int(np.searchsorted(f.inertial.time_s, e.time_s[k]))
        sigma = np.sqrt(np.diag(P[k])[9:15])
        true = np.concatenate([f.gyro_bias[i], f.accel_bias[i]])
        z.append((np.concatenate([e.gyro[k], e.accel[k]]) - true) / sigma)
        assert sigma[2] < 0.9 * TACTICAL.gyro_bias
    assert 0.5 < sim.rms(np.concatenate(z)) < 1.6


def test_smoothing_never_knows_less(tactical):
    _, r = tactical[0]
    forward, smoothed = r.forward.P_posterior, r.smoothed.P
    for k in range(0, len(forward), 50):
        d = np.sqrt(np.diag(forward[k]))
        difference = (forward[k] - smoothed[k]) / np.outer(d, d)
        assert np.linalg.eigvalsh(difference).min() > -1e-6
    assert np.linalg.eigvalsh(smoothed[100] / np.outer(d, d)).min() > -1e-9


def test_a_minute_without_gnss():
    f = sim.flight(seed=6)
    lost = (f.gnss.time_s > 300.0) & (f.gnss.time_s < 360.0)
    r = navigate(f.inertial, f.gnss[~lost], f.settings)[0]
    assert any(x.code == "outage" and "(299.0-360.0 s)" in x.text for x in r.findings)
    t = np.arange(301.0, 360.0, 1.0)
    for trajectory in (r.filtered, r.smoothed):
        z = sim.errors(trajectory, f.motion, t) / trajectory.sigmas(t)
        assert (np.abs(z[:, :3]) < 3.5).all()
    drift = r.filtered.sigmas([359.9])[0, :3]
    assert 0.05 < drift[0] < 1.0
    assert np.abs(sim.errors(r.filtered, f.motion, np.array([359.9])))[0, :2].max() < 1.5
    # no jump in the smoothed trajectory at the end of the outage: the error changes by less than 3 sigma in an instant
    around = np.arange(355.0, 366.0, 0.05)
    e, s = sim.errors(r.smoothed, f.motion, around), r.smoothed.sigmas(around)
    assert (np.abs(np.diff(e, axis=0)) < 0.3 * s[1:]).all()


def test_velocities_of_gnss_are_used():
    f = sim.flight("mems", duration_s=200.0, seed=7, velocity=True, sigma=(1.0, 1.0, 2.0))
    r = navigate(f.inertial, f.gnss, f.settings)[0]
    without = navigate(f.inertial, replace(f.gnss, velocity_n=None, sigma_velocity_n=None), f.settings)[0]
    t = np.arange(60.0, 190.0)
    better = sim.rms(sim.errors(r.filtered, f.motion, t))
    worse = sim.rms(sim.errors(without.filtered, f.motion, t))
    assert better[3] < 0.6 * worse[3] and better[8] < worse[8]
    nis = np.array([i.nis for i in r.forward.innovations if i.kind == "velocity"])
    assert 2.5 < nis.mean() < 3.5


def test_slow_errors_of_gnss_are_estimated():
    from triline.solver.models.gauss_markov import second_order_gauss_markov

    f = sim.flight(duration_s=400.0, seed=15)
    rng = np.random.default_rng(15)
    sigma, time_s = np.array([0.5, 0.5, 0.8]), 40.0
    F, Q, P0 = second_order_gauss_markov(1.0, time_s, 1.0)
    x = np.linalg.cholesky(P0) @ rng.standard_normal((2, 3))
    slow = []
    for _ in f.gnss.time_s:
        slow.append(sigma * x[0])
        x = F @ x + np.linalg.cholesky(Q) @ rng.standard_normal((2, 3))
    north, east, down = np.array(slow).T
    R_N, R_E = earth.curvature_radii(f.gnss.lat)
    lon = f.gnss.lon + east / ((R_E + f.gnss.height_m) * np.cos(f.gnss.lat))
    wandering = replace(
        f.gnss, lat=f.gnss.lat + north / (R_N + f.gnss.height_m), lon=lon, height_m=f.gnss.height_m - down
    )
    settings = replace(f.settings, wander_sigma_ned_m=(0.5, 0.5, 0.8), wander_time_s=time_s)
    r = navigate(f.inertial, wandering, settings)[0]
    assert not any(x.code in ("tuned", "restored") for x in r.findings)
    assert 2.6 < np.mean([i.nis for i in r.forward.innovations]) < 3.4
    t = np.arange(120.0, 398.0, 0.5)
    e, s = sim.errors(r.smoothed, f.motion, t), r.smoothed.sigmas(t)
    assert 0.5 < sim.rms((e / s)[:, :3].ravel()) < 1.6 and (np.degrees(sim.rms(e)[6:]) < [0.002, 0.002, 0.012]).all()
    assert (s[:, :3].mean(axis=0) > [0.05, 0.05, 0.1]).all()
    known = np.sqrt(np.diag(r.smoothed.P[200])[-6:-3])
    assert (known < 0.45).all()


@pytest.mark.study
def test_outliers_are_rejected_and_do_no_harm():
    f = sim.flight(duration_s=200.0, seed=8)
    rng = np.random.default_rng(8)
    bad = rng.random(len(f.gnss)) < 0.1
    bad[:10] = False
    height = f.gnss.height_m + np.where(bad, rng.uniform(3.0, 50.0, len(bad)), 0.0)
    r = navigate(f.inertial, replace(f.gnss, height_m=height), f.settings)[0]
    rejected = [i.time_s for i in r.forward.innovations if i.status == "rejected"]
    assert np.allclose(rejected, f.gnss.time_s[bad], atol=1e-6)
    t = np.arange(60.0, 198.0)
    assert sim.rms(sim.errors(r.smoothed, f.motion, t))[2] < 0.015
    assert any("rejected" in x.text for x in r.findings)


def test_a_lasting_jump_of_gnss_is_followed_after_a_while():
    f = sim.flight("mems", duration_s=200.0, seed=9)
    height = f.gnss.height_m + np.where(f.gnss.time_s > 100.0, 5.0, 0.0)
    r = navigate(f.inertial, replace(f.gnss, height_m=height), f.settings, tune=False)[0]
    assert [i.status for i in r.forward.innovations].count("restored") == 1
    after = sim.errors(r.filtered, f.motion, np.arange(115.0, 190.0))
    assert (np.abs(after[:, 2] + 5.0) < 0.3).all()  # down
    assert (np.abs(np.degrees(after[:, 6:8])) < 0.3).all()


def test_lever_arm_and_scale_factors_are_estimated_on_request():
    f = sim.flight(duration_s=400.0, seed=10)
    wrong = replace(f.settings, lever_arm_b=(0.7, -0.1, -1.1), lever_arm_sigma_m=0.3)
    r = navigate(f.inertial, f.gnss, wrong)[0]
    sigma = np.sqrt(np.diag(r.smoothed.P[-1])[-3:])
    z = (r.smoothed.nodes.lever_arm_b[-1] - sim.ARM) / sigma
    assert (np.abs(z) < 4.0).all() and sigma[2] < 0.05
    scale = np.array([300e-6, -200e-6, 400e-6])
    grade = replace(TACTICAL, gyro_scale=300e-6, accel_scale=1e-6)
    measured = replace(f.inertial, dtheta=f.inertial.dtheta * (1.0 + scale))
    r = navigate(measured, f.gnss, replace(f.settings, grade=grade, scale_factors=True))[0]
    found, P = r.smoothed.nodes.gyro[-1, 3:], r.smoothed.P[-1]
    sigma = np.sqrt(np.diag(P)[12:15])
    assert (np.abs((found - scale) / sigma) < 3.5).all()
    assert sigma[2] < 1e-4 and abs(found[2] - scale[2]) < 1e-4  # turns show that of the vertical gyro


def test_filter_and_smoother_agree_with_a_batch_adjustment():
    """Least squares over the whole window is an independent way to the smoothed state at its start."""
    f = sim.flight(duration_s=60.0, seed=11, line_s=20.0)
    steady = replace(f.settings, grade=replace(f.settings.grade, bias_time_s=1e9))
    start = align(f.inertial, f.gnss, steady, patience_s=1e9)
    wide = Start(start.estimate, np.diag([100.0] * 3 + [4.0] * 3 + [0.05**2] * 3 + bias_variances(steady).tolist()))
    s = smooth(run_filter(f.inertial, f.gnss, wide, steady))
    from triline.solver.navigation.alignment_window import curve, fit_window, noise_root

    inside = f.gnss[f.gnss.time_s < f.inertial.time_s[-1]]
    c = curve(f.inertial.corrected(), inside, start.estimate.time_s)
    fit = fit_window(c, steady, start.estimate.state.R_eb, noise_root(c, steady))
    sigma = np.sqrt(np.diag(fit.P))
    assert (np.abs(s.estimates.r_e[0] - fit.r0) < 0.35 * sigma[:3]).all()
    turn = s.estimates.R_eb[0] @ fit.R0.T
    angle = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
    assert (np.abs(angle) < 0.5 * sigma[6:9]).all()
    assert (np.abs(s.estimates.accel[0] - fit.accel) < 0.5 * sigma[12:15]).all()
    ratio = np.sqrt(np.diag(s.P[0])[:15]) / sigma
    assert ((ratio > 0.85) & (ratio < 1.15)).all(), ratio


@pytest.mark.parametrize("until_s", [15.0, 25.0])
def test_fixes_before_the_inertial_data_have_no_integrals(until_s):
    from triline.solver.navigation.alignment_window import curve

    f = sim.flight(duration_s=30.0, seed=2, line_s=10.0)
    begin_s, t0 = f.gnss.time_s[0] + 16.0, f.gnss.time_s[0]
    c = curve(f.inertial[f.inertial.time_s > begin_s].corrected(), f.gnss[f.gnss.time_s < t0 + until_s], t0)
    before = c.tau < 15.9
    assert before.any() and not c.v[before].any() and (c.R[before] == np.eye(3)).all()
    assert c.v[c.tau > 16.1].any(axis=1).all()


def test_trajectory_between_nodes_follows_the_inertial_data(tactical):
    f, r = tactical[0]
    t = np.arange(200.0, 203.0, 0.0013)
    e = sim.errors(r.smoothed, f.motion, t)
    assert np.ptp(e[:, :3], axis=0).max() < 2e-3  # the motion itself changes by 200 m meanwhile
    assert np.degrees(np.ptp(e[:, 6:], axis=0).max()) < 1e-3
    nodes = r.smoothed.nodes
    at_nodes = r.smoothed.at(nodes.time_s[5:50])
    assert np.abs(at_nodes.r_e - nodes.r_e[5:50]).max() < 1e-7
    assert np.abs(at_nodes.R_eb - nodes.R_eb[5:50]).max() < 1e-11
    step = 1e-3
    near = r.smoothed.at(np.array([200.2 - step, 200.2, 200.2 + step]))
    assert np.allclose((near.r_e[2] - near.r_e[0]) / (2 * step), near.v_e[1], atol=2e-3)
    with pytest.raises(ValueError, match="outside the trajectory"):
        r.smoothed.at([1e6])


def test_camera_poses_and_their_covariance(tactical):
    f, r = tactical[0]
    frame = LocalFrame(47.5, 9.2, 0.0)
    mount = CameraMount((0.3, -0.2, 0.8), rotation_matrix(np.array([0.01, -0.02, 0.03])) @ R_BC_NOMINAL)
    t = np.array([250.0, 250.004])
    poses = r.smoothed.camera(t, frame, mount)
    truth = f.motion.at(t)
    X = frame.from_geodetic(np.degrees(truth.lat), np.degrees(truth.lon), truth.height_m)
    R_lb = frame.R_ln(X) @ truth.R_nb
    assert np.abs(poses.position_l - X - R_lb @ np.array(mount.lever_arm_b)).max() < 0.03
    assert np.degrees(np.abs(poses.angles - angles_from_matrix(R_lb @ mount.rotation)).max()) < 0.003
    states = r.smoothed.at(t)
    J = camera_jacobian(states, frame, mount)
    for k in range(9):
        x = np.zeros(9)
        x[k] = 1e-5
        ends = []
        for s in (1.0, -1.0):
            turned = NavigationStates(
                t, states.r_e + s * x[:3], states.v_e + s * x[3:6], rotation_matrix(s * x[6:]) @ states.R_eb
            )
            p = camera_poses(turned, np.zeros((2, 9, 9)), frame, mount)
            ends.append(np.hstack([p.position_l, p.angles]))
        assert np.allclose((ends[0] - ends[1]) / 2e-5, J[:, :, k], atol=1e-4), k


def test_roll_pitch_heading_derivatives(tactical):
    _, r = tactical[0]
    states = r.smoothed.at([333.0])
    J = navigation_jacobian(states)[0]
    R_ne = states.R_ne
    for k in range(3):
        x = np.zeros(3)
        x[k] = 1e-6
        ends = [
            NavigationStates(states.time_s, states.r_e, states.v_e, rotation_matrix(s * x) @ states.R_eb).angles[0]
            for s in (1.0, -1.0)
        ]
        assert np.allclose((ends[0] - ends[1]) / 2e-6, J[6:, 6 + k], atol=1e-6)
    assert np.allclose(J[:3, :3], R_ne[0])


def test_held_out_fixes_are_predicted():
    f = sim.flight(duration_s=200.0, seed=12)
    out = np.arange(len(f.gnss)) % 5 == 4
    r = navigate(f.inertial, f.gnss, f.settings, held_out=out)[0]
    assert sum(i.status == "held out" for i in r.forward.innovations) == out.sum()
    miss, sigma = held_out_misses(r.smoothed, f.gnss, f.settings, out)
    assert len(miss) == out.sum()
    assert 0.75 < sim.rms(miss / sigma).mean() < 1.25


def test_held_out_fixes_are_predicted_with_the_estimated_lever_arm_and_slow_errors():
    f = sim.flight(duration_s=200.0, seed=12)
    out = np.arange(len(f.gnss)) % 5 == 4
    wrong = tuple(np.add(sim.ARM, (0.3, -0.3, 0.0)))
    # slow errors as a spline through knots 30 s apart
    knots = np.random.default_rng(3).normal(size=(8, 3)) * [0.5, 0.5, 0.8]
    off = CubicSpline(30.0 * np.arange(8), knots)(f.gnss.time_s)
    R_N, R_E = earth.curvature_radii(f.gnss.lat)
    lon = f.gnss.lon + off[:, 1] / (R_E * np.cos(f.gnss.lat))
    slow = replace(f.gnss, lat=f.gnss.lat + off[:, 0] / R_N, lon=lon, height_m=f.gnss.height_m - off[:, 2])
    for gnss, settings in (
        (f.gnss, replace(f.settings, lever_arm_b=wrong, lever_arm_sigma_m=0.3)),
        (slow, replace(f.settings, wander_sigma_ned_m=(0.5, 0.5, 0.8), wander_time_s=30.0)),
    ):
        r = navigate(f.inertial, gnss, settings, held_out=out)[0]
        miss, sigma = held_out_misses(r.smoothed, gnss, settings, out)
        assert (sim.rms(miss) < [0.06, 0.06, 0.12]).all()
        assert 0.75 < sim.rms(miss / sigma).mean() < 1.35


@pytest.mark.parametrize(
    ("speed", "interval_s", "sigma"),
    [
        (10.0, 4.0, (5.0, 5.0, 10.0)),
        (5.0, 5.0, (2.5, 2.5, 5.0)),
        (1.0, 0.1, (2.5, 2.5, 5.0)),
        (3.0, 1.0, (5.0, 5.0, 10.0)),
    ],
)
def test_an_aircraft_in_calm_air_does_not_stand(speed, interval_s, sigma):
    """Though it moves less from fix to fix than these are uncertain."""
    rng = np.random.default_rng(1)
    motion = survey_flight(200.0, rng, line_s=80.0, turbulence=0.2, speed_m_s=speed, bank_deg=10.0)
    inertial, _ = with_errors(motion.increments(0.5 + np.arange(199 * 50) / 50.0), TACTICAL, rng)
    fixes = gnss_fixes(motion, np.arange(1.0, 198.0, interval_s), sigma, rng)
    assert zero_velocities(inertial, fixes) == []


def test_zero_velocity_and_heading_aids():
    f = sim.flight("mems", duration_s=260.0, seed=13, static_s=120.0, turbulence=0.3, sigma=(1.0, 1.0, 2.0))
    aids = zero_velocities(f.inertial, f.gnss)
    times = np.array([t for t, _ in aids])
    assert len(times) > 100 and times.max() < 123.0
    t = np.arange(1.0, 259.0)
    true = f.motion.at(t)
    rng = np.random.default_rng(13)
    measured = true.angles[:, 2] + np.radians(0.3) * rng.standard_normal(len(t))
    aids += headings(t, measured, np.full(len(t), np.radians(0.3)))
    aided = navigate(f.inertial, f.gnss, f.settings, aids=aids)[0]
    alone = navigate(f.inertial, f.gnss, f.settings)[0]
    at_rest = np.arange(40.0, 110.0)
    a, b = (sim.rms(sim.errors(x.filtered, f.motion, at_rest)) for x in (aided, alone))
    assert a[3] < 0.3 * b[3] and np.degrees(a[8]) < 0.3
    z = sim.errors(aided.filtered, f.motion, at_rest) / aided.filtered.sigmas(at_rest)
    assert sim.rms(z[:, 8]) < 2.0
    shown = [i for i in aided.forward.innovations if i.kind == "zero velocity"]
    prior = aided.forward.prior
    velocity_n = NavigationStates(prior.time_s, prior.r_e, prior.v_e, prior.R_eb).velocity_n
    at = [int(np.abs(prior.time_s - i.time_s).argmin()) for i in shown]
    np.testing.assert_allclose([i.value for i in shown], -velocity_n[at], atol=1e-5)  # north, east, down, as plots say


def test_long_gap_divides_and_short_gap_is_bridged():
    f = sim.flight("mems", duration_s=300.0, seed=14, line_s=40.0)
    t = f.inertial.time_s
    short = f.inertial[~((t > 100.0) & (t < 102.0))]
    (r,) = navigate(short, f.gnss, f.settings)
    assert any(x.code == "gap" and "100.0" in x.text for x in r.findings)
    during = np.arange(100.1, 101.9, 0.1)
    z = sim.errors(r.smoothed, f.motion, during) / r.smoothed.sigmas(during)
    assert (np.abs(z) < 4.0).all()
    later = np.arange(120.0, 290.0)
    assert (np.degrees(sim.rms(sim.errors(r.smoothed, f.motion, later))[6:]) < [0.1, 0.1, 0.2]).all()
    parts = navigate(f.inertial[~((t > 100.0) & (t < 130.0))], f.gnss, f.settings)
    assert [round(p.best.end_s) for p in parts] == [100, 300] and round(parts[1].best.start_s) == 130


@pytest.mark.parametrize("fixes_from_s", [0.0, 330.0])
def test_a_flight_that_stands_for_long_or_gets_its_fixes_late_begins_where_the_attitude_shows(fixes_from_s):
    f = sim.flight("mems", duration_s=480.0, seed=34, rate_hz=50, static_s=350.0, line_s=30.0)
    (r,) = navigate(f.inertial, f.gnss[f.gnss.time_s > fixes_from_s], f.settings, offset_s=1000.0)
    begin = r.best.start_s
    assert 325.0 < begin < 365.0
    assert any(f"navigation begins at {1000.0 + begin:.1f} s" in x.text for x in r.findings)
    later = np.arange(begin + 30.0, 475.0)
    z = sim.errors(r.smoothed, f.motion, later) / r.smoothed.sigmas(later)
    assert sim.rms(z).max() < 2.0


@pytest.mark.parametrize("scales", [(2e-4, 0.0), (0.0, 2e-4)])
def test_scale_factors_of_one_kind_of_sensor(scales):
    gyro, accel = scales
    f = sim.flight(duration_s=100.0, seed=61, rate_hz=100, line_s=20.0)
    grade = replace(f.settings.grade, gyro_scale=gyro, accel_scale=accel)
    r = navigate(f.inertial, f.gnss, replace(f.settings, grade=grade, scale_factors=True))[0]
    t = np.arange(60.0, 95.0)
    assert np.sqrt(np.mean(np.square(sim.errors(r.smoothed, f.motion, t) / r.smoothed.sigmas(t)))) < 1.6
    of_scales = r.best.nodes.accel if gyro else r.best.nodes.gyro
    assert np.abs(of_scales[:, 3:]).max() == 0.0


@pytest.mark.parametrize("kind", ["position", "velocity", "zero velocity", "heading"])
def test_observation_derivatives(kind):
    settings = NavigationSettings(
        lever_arm_b=(0.5, 0.2, -1.0), lever_arm_sigma_m=0.1, scale_factors=True, wander_sigma_ned_m=(1.0, 1.0, 2.0)
    )
    lay = settings.layout
    true = sim.motion(120.0, 3)
    r, v, R = sim.true_start(true, 70.0)
    estimate = Estimate(70.0, State(r, v, R), np.zeros(6), np.zeros(6), np.array(settings.lever_arm_b))
    rate = true.felt(np.array([70.0]))[0][0]
    observation = {
        "position": AntennaPosition(r + 0.3, np.eye(3)),
        "velocity": AntennaVelocity(v + 0.1, np.eye(3), rate),
        "zero velocity": ZeroVelocity(0.1),
        "heading": Heading(float(true.at(70.0).angles[0, 2]) + 0.1, 0.01),
    }[kind]
    _, H, _ = observation.linearise(estimate, lay)
    for k in range(lay.n):
        x = np.zeros(lay.n)
        x[k] = 1e-5
        plus, minus = (observation.linearise(estimate.corrected(s * x, lay), lay)[0] for s in (1.0, -1.0))
        numeric = (minus - plus) / 2e-5
        tolerance = 2e-4 if kind == "position" or (kind == "velocity" and 6 <= k < 9) else 1e-6  # rounding; Earth rate
        assert np.allclose(numeric, H[:, k], atol=tolerance), k


def test_nodes_stand_at_observations_and_not_too_far_apart():
    t = node_times(0.0, 10.0, [2.0, 2.3, 7.0, 11.0, -1.0], 0.5)
    assert t[0] == 0.0 and t[-1] == 10.0
    assert {2.0, 2.3, 7.0} <= set(t.tolist())
    assert (np.diff(t) > 0).all() and np.diff(t).max() <= 0.5 + 1e-9


def test_rates_are_means_over_a_short_time():
    f = sim.flight(duration_s=60.0, seed=11, grade="mems", line_s=20.0)
    rate = rates_at(f.inertial, [10.0, 30.0])
    true = f.motion.felt(np.array([10.0, 30.0]))[0]
    assert np.abs(rate - true).max() < 0.02


def test_bad_settings_are_refused_in_words():
    with pytest.raises(ValueError, match="gyro_noise"):
        InertialGrade(0.0, 1.0, 1.0, 1.0)
    f = sim.flight(duration_s=60.0, seed=11, grade="mems", line_s=20.0)
    start = align(f.inertial, f.gnss, f.settings, patience_s=1e9)
    with pytest.raises(ValueError, match="wanted"):
        ErrorStateFilter(f.settings, Start(start.estimate, np.eye(4)))
    start.estimate.time_s = 1e6
    with pytest.raises(ValueError, match="outside the inertial data"):
        run_filter(f.inertial, f.gnss, start, f.settings)
    far = GnssData(*(getattr(f.gnss, n) for n in ("time_s", "lat", "lon", "height_m", "sigma_ned_m")))
    with pytest.raises(NavigationError, match="do not overlap"):
        navigate(f.inertial, replace(far, time_s=far.time_s + 1e6), f.settings)


def test_trajectory_of_the_filter_uses_no_later_fix():
    f = sim.flight(duration_s=60.0, seed=11, grade="mems", line_s=20.0)
    start = align(f.inertial, f.gnss, f.settings, patience_s=1e9)
    whole = NavigationTrajectory.filtered(run_filter(f.inertial, f.gnss, start, f.settings))
    part = f.inertial.time_s < 40.0
    until = f.gnss[f.gnss.time_s < 40.0]
    cut = NavigationTrajectory.filtered(run_filter(f.inertial[part], until, start, f.settings))
    t = np.arange(10.0, 39.0, 0.7)
    assert np.abs(whole.at(t).r_e - cut.at(t).r_e).max() < 1e-6
    assert np.abs(earth.geodetic_from_ecef(whole.at(t).r_e)[:, 2]).max() < 1e4
