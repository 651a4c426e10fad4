"""Alignment: what the data show is found, whatever was given; what they do not show is refused in words."""

from dataclasses import replace

import inertial_flights as sim
import numpy as np
import pytest

from triline.solver.geometry import earth
from triline.solver.geometry.rotation import matrix_from_navigation, navigation_from_matrix
from triline.solver.navigation.alignment import AlignmentError, AttitudePrior, align, static_attitude
from triline.solver.navigation.error_state import NavigationSettings
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.navigation.post_processing import navigate
from triline.solver.simulation.inertial import gnss_fixes, survey_flight, with_errors


def off(f: sim.SimulatedFlight, start) -> tuple[np.ndarray, np.ndarray]:
    """Attitude error roll, pitch, heading and its sigma about north, east, down; degrees."""
    t = start.estimate.time_s
    R_ne = earth.R_en(f.motion.at(t).lat[0], f.motion.at(t).lon[0]).T
    angles = navigation_from_matrix(R_ne @ start.estimate.state.R_eb)
    turn = (angles - f.motion.at(t).angles[0] + np.pi) % (2 * np.pi) - np.pi
    P = R_ne @ start.P[6:9, 6:9] @ R_ne.T
    return np.degrees(turn), np.degrees(np.sqrt(np.diag(P)))


@pytest.mark.parametrize("grade", ["tactical", "mems"])
@pytest.mark.parametrize(
    ("sigma", "velocity"), [((0.02, 0.02, 0.04), False), ((1.0, 1.0, 2.0), False), ((1.0, 1.0, 2.0), True)]
)
def test_in_motion(grade, sigma, velocity):
    for seed in (31, 32, 33):
        f = sim.flight(grade, duration_s=150.0, seed=seed, sigma=sigma, velocity=velocity)
        start = align(f.inertial, f.gnss, f.settings)
        error, s = off(f, start)
        assert start.how == "in motion"
        assert (np.abs(error) < 2.0 * s).all() and abs(error[2]) < 4.0 and np.abs(error[:2]).max() < 0.6


def test_sigmas_of_the_alignment_are_honest():
    """The start widens what the fit says three times; over seeds the errors are a third of that."""
    z = []
    for seed in range(40, 52):
        f = sim.flight("mems", duration_s=80.0, seed=seed, rate_hz=50, line_s=25.0)
        error, s = off(f, align(f.inertial, f.gnss, f.settings))
        z.append(3.0 * error / s)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_at_rest_by_the_rotation_of_the_earth():
    f = sim.flight("tactical", duration_s=330.0, seed=34, static_s=325.0, line_s=300.0)
    start = align(f.inertial, f.gnss, f.settings)
    error, s = off(f, start)
    assert start.how == "at rest"
    assert abs(error[2]) < 3.0 and s[2] < 7.0 and np.abs(error[:2]).max() < 0.01


def test_coarse_gyros_at_rest_are_refused_in_words():
    f = sim.flight("mems", duration_s=330.0, seed=34, static_s=325.0, line_s=300.0)
    with pytest.raises(AlignmentError, match=r"heading cannot be found.*too coarse.*heading_deg"):
        align(f.inertial, f.gnss, f.settings)


def test_static_levelling_and_gyro_compassing():
    lat, angles = np.radians(47.0), np.radians([2.0, -3.0, 130.0])
    R_nb = matrix_from_navigation(*angles)
    g = earth.normal_gravity(lat, 400.0)
    force = R_nb.T @ np.array([0.0, 0.0, -g])
    rate = R_nb.T @ (earth.ROTATION_RATE * np.array([np.cos(lat), 0.0, -np.sin(lat)]))
    found, sigma = static_attitude(force, rate, lat, TACTICAL, 300.0)
    assert np.allclose(found, angles, atol=1e-9)
    assert np.degrees(sigma[2]) < 0.3
    assert static_attitude(force, rate, lat, MEMS, 300.0)[1][2] > 1.0


@pytest.mark.parametrize("wrong_deg", [30.0, 90.0, 180.0, -120.0])
@pytest.mark.parametrize(("grade", "sigma"), [("tactical", (0.02, 0.02, 0.04)), ("mems", (1.0, 1.0, 2.0))])
def test_wrong_initial_heading_is_recovered_and_named(wrong_deg, grade, sigma):
    f = sim.flight(grade, duration_s=150.0, seed=32, sigma=sigma)
    true = f.motion.at(0.5).angles[0]
    prior = AttitudePrior(true + np.radians([0.0, 0.0, wrong_deg]), np.radians([0.5, 0.5, 2.0]))
    start = align(f.inertial, f.gnss, f.settings, prior=prior)
    error, s = off(f, start)
    assert abs(error[2]) < 4.0 and abs(error[2]) < 2.5 * s[2]
    assert "was not used" in start.notes[0] and "initial attitude" in start.notes[0]
    r = navigate(f.inertial, f.gnss, f.settings, prior=prior)[0]
    e = sim.errors(r.smoothed, f.motion, np.arange(1.0, 148.0))
    z = e / r.smoothed.sigmas(np.arange(1.0, 148.0))
    assert sim.rms(z[:, 8]) < 2.5 and any("was not used" in x.text for x in r.findings)


def test_right_initial_attitude_is_used():
    f = sim.flight(duration_s=150.0, seed=32)
    true = f.motion.at(0.5).angles[0]
    rng = np.random.default_rng(3)
    sigma = np.radians([0.05, 0.05, 0.1])
    prior = AttitudePrior(true + sigma * rng.standard_normal(3), sigma)
    start = align(f.inertial, f.gnss, f.settings, prior=prior)
    error, s = off(f, start)
    assert start.how == "given attitude" and not start.notes
    assert s[2] <= 0.101 and (np.abs(error) < 3.5 * s).all()


def test_course_stands_for_the_heading_where_nothing_else_shows_it():
    f = sim.flight("mems", duration_s=60.0, seed=35, line_s=300.0, turbulence=0.0, sigma=(1.0, 1.0, 2.0))
    start = align(f.inertial, f.gnss, f.settings)
    error, s = off(f, start)
    assert start.how == "course" and "course" in start.notes[0]
    assert abs(error[2]) < 12.0 and 8.0 < s[2] < 18.0
    backwards = AttitudePrior(f.motion.at(0.5).angles[0] + np.radians([0, 0, 170.0]), np.radians([1.0, 1.0, 1.0]))
    start = align(f.inertial, f.gnss, f.settings, prior=backwards)
    assert abs(off(f, start)[0][2]) < 12.0 and "was not used" in start.notes[0]


@pytest.mark.parametrize(("seed", "lon_deg"), [(2, 179.97), (4, -179.97)])
def test_course_over_the_date_line(seed, lon_deg):
    """Longitudes jump by 360 degrees in flight, to the west and to the east; the aircraft does not."""
    rng = np.random.default_rng(seed)
    start = (np.radians(-16.8), np.radians(lon_deg), 1500.0)
    motion = survey_flight(200.0, rng, line_s=190.0, turbulence=0.0, start=start)
    time_s = 0.5 + np.arange(199 * 50) / 50.0
    inertial, _ = with_errors(motion.increments(time_s), MEMS, rng)
    fixes = gnss_fixes(motion, np.arange(1.0, 198.0), (1.0, 1.0, 2.0), rng)
    assert np.ptp(np.sign(fixes.lon)) == 2.0
    found = align(inertial, fixes, NavigationSettings(MEMS))
    assert found.how == "course"
    R_ne = earth.R_en(fixes.lat[0], fixes.lon[0]).T
    heading = navigation_from_matrix(R_ne @ found.estimate.state.R_eb)[2]
    miss = (heading - motion.at([found.estimate.time_s]).angles[0, 2] + np.pi) % (2 * np.pi) - np.pi
    assert abs(np.degrees(miss)) < 12.0


def test_an_outlier_in_the_first_seconds_does_no_harm():
    f = sim.flight(duration_s=150.0, seed=32)
    height = f.gnss.height_m.copy()
    height[3] += 60.0
    start = align(f.inertial, replace(f.gnss, height_m=height), f.settings)
    error, s = off(f, start)
    assert abs(error[2]) < 2.5 * s[2] and np.abs(error[:2]).max() < 0.6


def test_data_that_do_not_fit_and_too_few_fixes_are_refused_in_words():
    f = sim.flight(duration_s=150.0, seed=32)
    with pytest.raises(AlignmentError, match="at least 4"):
        align(f.inertial, f.gnss[:3], f.settings)
    rng = np.random.default_rng(0)
    noisy = replace(f.gnss, height_m=f.gnss.height_m + rng.normal(0, 30.0, len(f.gnss)))
    with pytest.raises(AlignmentError, match="do not fit"):
        align(f.inertial, noisy, f.settings)
