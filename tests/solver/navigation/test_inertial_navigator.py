"""The on-line navigator: as good as the recording's filter, the same whenever data come, fit after trouble."""

from dataclasses import replace
from functools import cache

import inertial_flights as sim
import numpy as np
import pytest

from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import R_BC_NOMINAL, angles_from_matrix
from triline.solver.navigation.alignment import AttitudePrior
from triline.solver.navigation.carried import CameraMount
from triline.solver.navigation.inertial_navigator import InertialNavigator
from triline.solver.navigation.online_poses import OnlineOptions
from triline.solver.navigation.post_processing import navigate
from triline.solver.navigation.strapdown import integrate_one, integrate_to

FRAME = LocalFrame(47.55, 9.17, 0.0)
MOUNT = CameraMount((0.2, 0.1, 0.4))


@cache
def flight(grade: str = "tactical", duration_s: float = 100.0):
    return sim.flight(grade, duration_s=duration_s, seed=51, rate_hz=100, line_s=20.0)


def stream(f, latency_s=0.1, latency=None, keep=None):
    """Inertial samples and fixes in the order they come: (arrival, kind, index)."""
    out = [(t, 0, k) for k, t in enumerate(f.inertial.time_s.tolist()) if keep is None or keep(t)]
    for i, t in enumerate(f.gnss.time_s.tolist()):
        out.append((t + (latency_s if latency is None else latency(i)), 1, i))
    return sorted(out)


def run(f, events, navigator=None, batch=None, nominal=None):
    """Poses and the navigator; with ``nominal``, samples are rates over intervals that are so many times too long."""
    nav = navigator or InertialNavigator(FRAME, f.settings, MOUNT)
    position = FRAME.from_geodetic(np.degrees(f.gnss.lat), np.degrees(f.gnss.lon), f.gnss.height_m)
    R_ln = FRAME.R_ln(position)
    poses = []
    for _, kind, i in events:
        if kind == 0:
            d, t = f.inertial, float(f.inertial.dt_s[i])
            if nominal is None:
                poses += nav.add_increments(float(d.time_s[i]), t, d.dv[i], d.dtheta[i])
            else:
                poses += nav.add_inertial(float(d.time_s[i]), nominal * t, d.dv[i] / t, d.dtheta[i] / t)
        else:
            A = R_ln[i] * f.gnss.sigma_ned_m[i]
            poses += nav.add_gnss(float(f.gnss.time_s[i]), position[i], A @ A.T)
    return poses + nav.finish(), nav


def split(poses):
    return [p for p in poses if not p.smoothed], [p for p in poses if p.smoothed]


def misses(f, poses):
    """Errors (n, 6) of poses and their sigmas."""
    t = np.array([p.time_s for p in poses])
    true = f.motion.at(t)
    position = FRAME.from_geodetic(np.degrees(true.lat), np.degrees(true.lon), true.height_m)
    R_lb = FRAME.R_ln(position) @ true.R_nb
    angles = np.array([p.angles for p in poses]) - angles_from_matrix(R_lb @ R_BC_NOMINAL)
    moved = np.array([p.position_l for p in poses]) - position - R_lb @ np.array(MOUNT.lever_arm_b)
    error = np.hstack([moved, (angles + np.pi) % (2 * np.pi) - np.pi])
    return error, np.sqrt(np.array([np.diag(p.covariance) for p in poses]))


@pytest.fixture(scope="module")
def usual():
    f = flight()
    return run(f, stream(f))


RARE = OnlineOptions(filtered_s=0.2, smooth_every_s=2.0)


@pytest.fixture(scope="module")
def rarely():
    """The same fixes, and rare answers."""
    f = flight()
    return run(f, stream(f), InertialNavigator(FRAME, f.settings, MOUNT, RARE))


def test_poses_come_at_once_and_smoothed_after_the_lag(usual):
    poses, nav = usual
    filtered, smoothed = split(poses)
    for part in (filtered, smoothed):
        assert (np.diff([p.time_s for p in part]) > 0).all()
    t = np.array([p.time_s for p in smoothed])
    assert np.diff(t).max() < 0.0201 and t[-1] == pytest.approx(flight().inertial.time_s[-1])
    first = next(p.time_s for p in filtered if p.valid)
    assert first < 30.0 and all(not p.valid and p.reason for p in filtered if p.time_s < first)
    assert all(p.valid for p in filtered if p.time_s > first + 5.0)
    assert any("aligned" in e.text for e in nav.take_events()) and nav.take_events() == []


@pytest.mark.parametrize("nominal", [0.99, 1.01])
def test_a_nominal_interval_is_no_scale_factor(rarely, nominal):
    """No sensor is as fast as its data sheet says: samples last from stamp to stamp."""
    f = flight()
    poses, _ = run(f, stream(f), InertialNavigator(FRAME, f.settings, MOUNT, RARE), nominal=nominal)
    (_, smoothed), (_, usually) = split(poses), split(rarely[0])
    error, sigma = misses(f, smoothed[-2000:])
    usual_error, _ = misses(f, usually[-2000:])
    assert np.abs(error - usual_error).max(axis=0) == pytest.approx(np.zeros(6), abs=0.2 * sigma.min())


def test_accuracy_and_covariance(usual):
    f = flight()
    filtered, smoothed = split(usual[0])
    limits = ((filtered, [0.02, 0.02, 0.03]), (smoothed, [0.012, 0.012, 0.02]))
    rms = []
    for part, limit in limits:
        error, sigma = misses(f, [p for p in part if 50.0 < p.time_s < 95.0])
        rms.append(sim.rms(error))
        assert (rms[-1][:3] < limit).all()
        assert 0.6 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.5
    assert (rms[1][:3] < rms[0][:3]).all()


def test_smoothed_poses_agree_with_the_recordings_smoother(usual):
    f = flight()
    r = navigate(f.inertial, f.gnss, f.settings)[0]
    _, smoothed = split(usual[0])
    late = [p for p in smoothed if p.time_s > 94.6]  # these have seen everything
    whole = r.smoothed.camera(np.array([p.time_s for p in late]), FRAME, MOUNT)
    d = np.array([p.position_l for p in late]) - whole.position_l
    sigma = np.sqrt(np.einsum("nii->ni", whole.covariance))
    assert (np.abs(d) < 0.3 * sigma[:, :3]).all()
    ratio = np.sqrt(np.array([np.diag(p.covariance) for p in late])) / sigma
    assert (np.abs(ratio - 1.0) < 0.15).all()


@pytest.mark.study
def test_replay_is_identical(usual):
    f = flight()
    again, _ = run(f, stream(f))
    assert len(again) == len(usual[0])
    for a, b in zip(usual[0], again, strict=True):
        assert a.time_s == b.time_s and a.smoothed == b.smoothed and a.valid == b.valid
        assert (a.position_l == b.position_l).all() and (a.covariance == b.covariance).all()
        assert (a.angles == b.angles).all()


@pytest.mark.study
def test_late_and_disordered_fixes_change_next_to_nothing(usual):
    f = flight()
    poses, nav = run(f, stream(f, latency=lambda i: 0.1 + (1.7 if i % 4 == 1 else 0.0)))
    assert not nav.counters
    reference = {p.time_s: p for p in usual[0] if p.smoothed and p.time_s > 40.0}
    same = [(reference[p.time_s], p) for p in poses if p.smoothed and p.time_s in reference]
    assert len(same) > 2000
    sigma = np.sqrt(np.diag(same[0][0].covariance))
    worst = np.max([np.abs(a.position_l - b.position_l) / sigma[:3] for a, b in same], axis=0)
    assert (worst < 2.0).all()  # some had seen a fix or two less when they were due
    at_the_end = same[-1]
    assert (np.abs(at_the_end[0].position_l - at_the_end[1].position_l) < 0.05 * sigma[:3]).all()


@pytest.mark.parametrize("latency", [None, lambda i: 0.013 if i % 5 else 1.2, lambda i: -0.3])
def test_rare_answers_are_those_of_all_answers(usual, rarely, latency):
    f = flight()
    if latency is None:
        poses, nav = rarely
    else:
        poses, nav = run(f, stream(f, latency=latency), InertialNavigator(FRAME, f.settings, MOUNT, RARE))
    assert not nav.counters
    (all_filtered, all_smoothed), (filtered, smoothed) = split(usual[0]), split(poses)
    assert len(smoothed) == pytest.approx(len(all_smoothed), rel=0.02)  # a fix between two samples makes a pose or not
    assert np.diff([p.time_s for p in filtered]).min() > RARE.filtered_s - 1e-6
    assert len(filtered) > 0.1 * f.inertial.time_s[-1] / RARE.filtered_s
    assert len(filtered) < len(all_filtered) / 5
    reference = {p.time_s: p for p in all_smoothed if p.time_s > 40.0}
    pairs = [(reference[p.time_s], p) for p in smoothed if p.time_s in reference]
    assert len(pairs) > 0.96 * len(reference) > 2000
    sigma = np.sqrt([np.diag(a.covariance) for a, _ in pairs])
    apart = np.array([np.concatenate([a.position_l - b.position_l, a.angles - b.angles]) for a, b in pairs]) / sigma
    assert np.sqrt((apart**2).mean(axis=0)).max() < 0.4  # some had seen seconds more
    assert np.abs(apart[-50:]).max() < 0.05  # at the end both have seen the same fixes
    error, sigma = misses(f, [p for p in smoothed if p.time_s > 40.0])
    assert 0.4 < np.sqrt(((error / sigma) ** 2).mean()) < 1.5


def test_integrals_to_several_ends_are_those_of_each():
    data = flight().inertial[:60].corrected()
    gyro, accel = np.array([1e-5, -2e-5, 3e-5]), np.array([1e-3, 2e-3, -1e-3])
    several = integrate_to(data, [1, 7, 8, 60], gyro, accel)
    for end, run_to in zip([1, 7, 8, 60], several, strict=True):
        one = integrate_one(data[:end], gyro, accel)
        for name in one.__slots__:
            assert np.allclose(getattr(run_to, name), getattr(one, name), rtol=1e-12, atol=1e-15), name


@pytest.mark.study
def test_fixes_that_are_too_late_or_come_twice_are_counted():
    f = flight()
    events = stream(f, latency=lambda i: 4.0 if i == 60 else 0.1)
    events = sorted([*events, (50.5, 1, 48)])
    _, nav = run(f, events)
    assert nav.counters["gnss too late"] == 1 and nav.counters["gnss duplicate"] == 1


@pytest.mark.study
def test_inertial_gap_is_bridged_and_a_long_one_aligns_anew():
    f = flight()
    poses, nav = run(f, stream(f, keep=lambda t: not 60.0 < t < 61.5))
    assert nav.counters["inertial gap"] == 1
    error, sigma = misses(f, [p for p in poses if not p.smoothed and 63.0 < p.time_s < 95.0])
    assert (np.abs(error / sigma) < 5.0).all()
    _, smoothed = split(poses)
    assert np.diff([p.time_s for p in smoothed]).max() < 0.05  # no hole in the smoothed trajectory
    poses, nav = run(f, stream(f, keep=lambda t: not 45.0 < t < 58.0))
    texts = [e.text for e in nav.take_events()]
    assert any("missing for 13.0 s" in t for t in texts) and sum("aligned" in t for t in texts) == 2
    filtered, _ = split(poses)
    assert not any(p.valid for p in filtered if 45.1 < p.time_s < 60.0)
    assert filtered[-1].valid


def test_restarted_in_flight_it_aligns_again():
    f = flight()
    events = [e for e in stream(f) if e[0] > 40.0]
    options = OnlineOptions(filtered_s=0.1, smooth_every_s=2.0)
    poses, _ = run(f, events, InertialNavigator(FRAME, f.settings, MOUNT, options))
    filtered, _ = split(poses)
    first = next(p.time_s for p in filtered if p.valid)
    assert not filtered[0].valid and filtered[0].reason.startswith("aligning") and 43.0 < first < 75.0
    error, sigma = misses(f, [p for p in filtered if p.time_s > first + 10.0])
    assert (np.abs(error / sigma) < 5.5).all()


@pytest.mark.study
def test_a_wrong_initial_heading_is_found_out():
    f = flight()
    true = f.motion.at(0.5).angles[0]
    for wrong_deg in (0.0, 180.0):
        prior = AttitudePrior(true + np.radians([0.0, 0.0, wrong_deg]), np.radians([0.5, 0.5, 1.0]))
        nav = InertialNavigator(FRAME, f.settings, MOUNT, prior=prior)
        poses, _ = run(f, [e for e in stream(f) if e[0] < 45.0], nav)
        text = " ".join(e.text for e in nav.take_events())
        assert ("was not used" in text) == (wrong_deg != 0.0) and "aligned" in text
        filtered, _ = split(poses)
        error, sigma = misses(f, [p for p in filtered if p.valid and p.time_s > 35.0])
        assert len(error) > 100 and (np.abs(error / sigma) < 5.5).all()


def test_gnss_outage_drift_and_validity():
    f = flight("mems")
    events = [e for e in stream(f) if not (e[1] == 1 and 60.0 < f.gnss.time_s[e[2]] < 90.0)]
    options = OnlineOptions(filtered_s=0.1, smooth_every_s=2.0, valid_position_m=0.5)
    nav = InertialNavigator(FRAME, f.settings, MOUNT, options)
    poses, _ = run(f, events, nav)
    filtered, _ = split(poses)
    during = [p for p in filtered if 61.0 < p.time_s < 90.0]
    error, sigma = misses(f, during)
    assert (np.abs(error / sigma)[:, :3] < 4.0).all()
    assert not during[-1].valid and during[-1].reason == "position uncertain" and during[0].valid
    assert filtered[-1].valid


def test_rates_and_increments_are_the_same():
    f = flight()
    a, b = (InertialNavigator(FRAME, f.settings, MOUNT) for _ in range(2))
    d = f.inertial
    for i in range(50):
        dt = float(d.dt_s[i])
        a.add_increments(float(d.time_s[i]), dt, d.dv[i], d.dtheta[i])
        b.add_inertial(float(d.time_s[i]), dt, d.dv[i] / dt, d.dtheta[i] / dt)
    assert np.allclose(a._alignment._raw[0].dv, b._alignment._raw[0].dv, rtol=1e-12)


def test_bad_calls_are_refused_in_words():
    f = flight()
    nav = InertialNavigator(FRAME, f.settings)
    with pytest.raises(ValueError, match="not finite"):
        nav.add_inertial(1.0, 0.01, [np.nan, 0, 0], [0, 0, 0])
    with pytest.raises(ValueError, match="not positive definite"):
        nav.add_gnss(1.0, [0, 0, 0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="not finite"):
        nav.add_gnss(1.0, [np.inf, 0, 0], np.eye(3))
    with pytest.raises(ValueError, match="shorter than rewind_s"):
        OnlineOptions(lag_s=1.0)
    nav.add_inertial(1.0, 0.01, [0, 0, -9.8], [0, 0, 0])
    assert nav.add_inertial(0.9, 0.01, [0, 0, -9.8], [0, 0, 0]) == [] and nav.counters["inertial out of order"] == 1
    assert nav.add_attitude(1.0, [0, 0, 0], np.eye(3)) == [] and nav.counters["attitude not used"] == 1
    assert nav.finish() == []


@pytest.mark.study
def test_a_filter_that_keeps_being_wrong_is_aligned_anew():
    f = flight("mems")
    d = f.inertial
    hit = d.time_s > 60.0  # the gyros' x and y axes change places in flight
    dtheta = np.where(hit[:, None], d.dtheta[:, [1, 0, 2]] * [1, -1, 1] + [0.0, 0.003, 0.0], d.dtheta)
    poses, nav = run(replace(f, inertial=replace(d, dtheta=dtheta)), stream(f))
    assert any("disagree" in e.text for e in nav.take_events())
    assert len(poses) > 100
