"""The simulated flight: its motion, its ground, what its sensors measure and what its images show."""

import numpy as np
import pytest
from simulated_rays import EXACT, flown, reprojection_px

from triline.solver.camera.collinearity import project
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import R_lc_from_navigation
from triline.solver.geometry.rotation import angles_from_matrix, corrected_angles, matrix_from_angles
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel, antenna_position, draw_slow_errors
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.observations import find_looks
from triline.solver.simulation.scenario import (
    Mounting,
    ObservationPlan,
    simulate,
)
from triline.solver.simulation.streams import STREAMS, stream

BLOCK = FlightPlan(strips=2, cross_strips=1, strip_s=45.0, stabilised=False)


@pytest.fixture(scope="module")
def demo():
    return simulate(FlightPlan(), 1)


@pytest.fixture(scope="module")
def block():
    return simulate(BLOCK, 3, observation_plan=EXACT)


# -- geometry of the images --------------------------------------------------------------------------------------------


def test_every_ray_goes_through_its_pixel(block):
    assert len(block.images) > 3000
    assert reprojection_px(block).max() < 1e-6


def test_line_numbers_and_times_agree(block):
    looks, strips = block.images.looks, block.flight.strips
    for s, strip in enumerate(strips):
        mine = looks.strip == s
        assert strip.time_of(looks.line[mine]) == pytest.approx(looks.time_s[mine], abs=1e-10)
        assert (looks.line[mine] >= 0).all() and (looks.line[mine] <= strip.lines - 1).all()
    assert (block.images.line == looks.line).all() and (block.images.sample == looks.sample).all()


def test_forward_location_meets_the_point(block):
    """The ray of a pixel, cut with the relief, is the ground point: tie points are made so, other looks must agree."""
    looks, flight = block.images.looks, block.flight
    chosen = np.arange(0, len(looks), 7)
    poses = flight.truth.at(looks.time_s[chosen])
    ccd = looks.ccd[chosen]
    xy, _ = flight.camera.image_coordinates(ccd, looks.sample[chosen])
    ray_c = np.column_stack([xy, -flight.camera.focal_length_mm[ccd]])
    ray_l = np.einsum("nij,nj->ni", matrix_from_angles(*poses.angles.T), ray_c)
    found = flight.terrain.intersect(poses.position_l, ray_l)
    assert found == pytest.approx(block.points.xyz_l[looks.point[chosen]], abs=1e-5)


def test_no_earlier_passage_is_missed():
    """Line conditions evaluated 200 times a second over a strip, in turbulence that makes lines pass repeatedly."""
    flight = flown(FlightPlan(strip_s=40.0, stabilised=False, turbulence=2.0), 5)
    strip, camera = flight.strips[0], flight.camera
    xy = np.random.default_rng(0).uniform((-1000, -800), (1000, 800), (60, 2))
    points = np.column_stack([xy, flight.terrain.height(*xy.T)])
    looks = find_looks(points, flight.strips, camera)
    t = np.arange(strip.first_line_time_s, strip.time_of(strip.lines - 1), 0.005)
    poses = flight.truth.at(t)
    repeated = 0
    for p, point in enumerate(points):
        for k, line in enumerate(camera.lines):
            c = np.full(len(t), camera.focal_length_mm[k])
            x, y = project(poses.position_l, poses.angles, np.broadcast_to(point, (len(t), 3)), c).xy_mm.T
            ahead = x - line.centre_mm[0]  # the lines of this camera are straight
            passed = np.flatnonzero((ahead[:-1] > 0) & (ahead[1:] <= 0))
            seen = [i for i in passed if line.xy_mm[0, 1] < y[i] < line.xy_mm[-1, 1]]
            mine = looks.time_s[(looks.point == p) & (looks.ccd == k)]
            assert len(mine) == (len(seen) > 0)
            if seen:
                assert t[seen[0]] - 1e-9 <= mine[0] <= t[seen[0] + 1] + 1e-9
                repeated += len(seen) > 1
    assert repeated > 0  # otherwise the flight is too calm for this test


def test_curved_lines_and_lines_that_run_the_other_way():
    """Look-up tables of distorted, inclined and reversed CCD lines are solved as exactly as straight ones."""
    from triline.solver.camera.line_camera import CcdLine, Lens, LineCamera, straight_line

    base = preset("ads40")
    lines = [
        straight_line("F", "L1", 12000, 0.0065, (30.0, 0.3), np.radians(0.4), (0.0, 2e-6, 0.0)),
        base.lines[1],
        CcdLine("B", "L1", base.lines[2].xy_mm[::-1].copy()),
    ]
    camera = LineCamera("bent", (Lens("L1", 62.7, (0.1, -0.2)),), tuple(lines))
    simulation = simulate(FlightPlan(camera=camera, strip_s=40.0, stabilised=False), 2, observation_plan=EXACT)
    assert np.bincount(simulation.images.looks.ccd, minlength=3).min() > 150
    assert reprojection_px(simulation).max() < 1e-6


# -- points and measurements -------------------------------------------------------------------------------------------


def test_demo_has_the_planned_points(demo):
    roles = demo.points.role
    assert (roles == "control").sum() == 6 and (roles == "check").sum() == 30
    assert (roles == "tie").sum() == pytest.approx(8 * 60, abs=5)
    rays = np.bincount(demo.images.looks.point)
    assert len(rays) == len(demo.points) and rays.min() >= 2 and rays.max() == 3
    assert (rays[roles != "tie"] == 3).all()
    assert 20 < len(demo.images) / 60.0 < 30
    assert len(set(demo.points.id)) == len(demo.points)


def test_tie_points_fill_the_swath_evenly(demo):
    looks = demo.images.looks
    nadir = looks.select(looks.ccd == 1)
    along = np.histogram(nadir.time_s, 6, range=(10.0, 70.0))[0]
    across = np.histogram(nadir.sample, 6, range=(0, 12000))[0]
    for counts in (along, across):
        assert counts.min() > 0.7 * counts.mean() and counts.max() < 1.3 * counts.mean()


def test_control_lies_on_both_sides_along_the_strip(demo):
    xyz = demo.points.xyz_l[demo.points.role == "control"]
    assert (np.sign(xyz[:, 1]) == [1, -1, 1, -1, 1, -1]).all()
    assert np.ptp(xyz[:, 0]) > 2500
    off = demo.surveyed_l - demo.points.xyz_l
    assert (off[demo.points.role != "control"] == 0).all()
    assert 0 < np.abs(off[demo.points.role == "control"]).max() < 5 * 0.02


def test_an_odd_control_point_lies_in_the_middle_of_the_swath():
    s = simulate(FlightPlan(strip_s=40.0), 1, observation_plan=ObservationPlan(1.0, control=3, check=0))
    xyz = s.points.xyz_l[s.points.role == "control"]
    assert np.abs(xyz[:2, 1]).min() > 500 and abs(xyz[2, 1]) < 100
    assert xyz[2, 0] > xyz[:2, 0].max() + 300


def test_survey_error_of_control_points():
    plan = ObservationPlan(tie_points_per_s=0.0, control=300, check=0, control_sigma_m=(0.02, 0.03, 0.06))
    s = simulate(FlightPlan(strip_s=40.0), 4, observation_plan=plan)
    ratio = (s.surveyed_l - s.points.xyz_l).std(axis=0) / plan.control_sigma_m
    assert ratio == pytest.approx(1.0, abs=4 / np.sqrt(2 * 300))


def test_points_are_shared_between_overlapping_strips(block):
    looks = block.images.looks
    strips = np.zeros((len(block.points), 3), dtype=bool)
    strips[looks.point, looks.strip] = True
    in_all, in_two = (strips.sum(axis=1) == n for n in (3, 2))
    assert in_all.sum() > 20 and in_two.sum() > 100
    # 30 % sidelap of swaths 1866 m wide, the axis of the block in the middle
    both = block.points.xyz_l[strips[:, 0] & strips[:, 1]]
    assert np.abs(both[:, 1]).max() < 0.5 * 0.3 * 1866 + 120


def test_image_noise_is_as_stated(demo):
    looks, n = demo.images.looks, len(demo.images)
    for error in (demo.images.line - looks.line, demo.images.sample - looks.sample):
        assert np.mean(error) == pytest.approx(0.0, abs=4 * 0.3 / np.sqrt(n))
        assert np.std(error) == pytest.approx(0.3, rel=4 / np.sqrt(2 * n))


def test_outliers_are_a_share_of_the_tie_rays_and_as_large_as_stated():
    plan = ObservationPlan(outlier_share=0.2, image_sigma_px=0.0, outlier_px=(5.0, 40.0))
    s = simulate(FlightPlan(), 1, observation_plan=plan)
    tie = s.points.role[s.images.looks.point] == "tie"
    assert s.images.outlier[~tie].sum() == 0
    n = tie.sum()
    assert s.images.outlier[tie].mean() == pytest.approx(0.2, abs=4 * np.sqrt(0.2 * 0.8 / n))
    size = np.hypot(s.images.line - s.images.looks.line, s.images.sample - s.images.looks.sample)
    assert (size[~s.images.outlier] == 0).all()
    bad = size[s.images.outlier]
    assert bad.min() >= 5 - 1e-9 and bad.max() <= 40 + 1e-9
    assert bad.mean() == pytest.approx(22.5, abs=4 * 35 / np.sqrt(12 * len(bad)))


def test_a_source_of_chance_leaves_the_others_alone(demo):
    other = simulate(FlightPlan(), 1, ErrorModel(offset_sigma_m=(5.0, 5.0, 5.0)), ObservationPlan(outlier_share=0.3))
    assert (other.attitude_rpy == demo.attitude_rpy).all()
    assert (other.gnss_geodetic != demo.gnss_geodetic).all()
    assert (other.flight.truth.position_l == demo.flight.truth.position_l).all()
    clean = ~other.images.outlier
    index = {(p, s, k): i for i, (p, s, k) in enumerate(zip(*_keys(demo), strict=True))}
    same = [
        index[key] for key, good in zip(zip(*_keys(other), strict=True), clean, strict=True) if good and key in index
    ]
    mine = [i for i, key in enumerate(zip(*_keys(other), strict=True)) if clean[i] and key in index]
    assert len(same) > 800
    assert (other.images.line[mine] == demo.images.line[same]).all()


def _keys(simulation):
    looks = simulation.images.looks
    return simulation.points.id[looks.point], looks.strip, looks.ccd


def test_streams_are_independent_and_repeatable():
    draws = [stream(7, name).standard_normal(1000) for name in STREAMS]
    correlation = np.corrcoef(draws) - np.eye(len(STREAMS))
    assert np.abs(correlation).max() < 4.5 / np.sqrt(1000)
    assert (stream(7, "motion").standard_normal(1000) == draws[0]).all()
    assert (stream(8, "motion").standard_normal(1000) != draws[0]).all()
    with pytest.raises(ValueError, match="seed must not be negative"):
        stream(-1, "motion")


# -- errors of the trajectory ------------------------------------------------------------------------------------------


def test_slow_errors_have_the_stated_covariance_over_seeds():
    """Offset, shift, drift and wander of 400 drawings of two strips, two-sided."""
    model = ErrorModel(
        wander_sigma_m=(1.0, 1.2, 1.5), offset_sigma_m=(0.5, 0.6, 0.8), drift_sigma_deg=(0.01, 0.02, 0.03)
    )
    strips = np.array([[2.0, 12.0], [20.0, 34.0]])
    t = np.array([2.0, 12.0, 20.0, 27.0, 34.0])
    systematic, wander = [], []
    for seed in range(400):
        drawn = draw_slow_errors(model, strips, 0.0, 36.0, stream(seed, "gnss slow"), stream(seed, "attitude slow"))
        systematic.append(drawn.systematic(t))
        wander.append(drawn.wander(t))
        assert drawn.at(t) == pytest.approx(systematic[-1] + wander[-1])
    errors, wandered = np.array(systematic), np.array(wander)
    band = 4.5 * np.sqrt(2.0 / 400)
    offset, shift = np.array(model.offset_sigma_m), np.radians(model.shift_sigma_deg)
    drift = np.radians(model.drift_sigma_deg)
    for start, end in ((0, 1), (2, 4)):
        assert errors[:, start, :3] == pytest.approx(errors[:, end, :3], abs=1e-12)
        assert (errors[:, start, :3] ** 2).mean(axis=0) / offset**2 == pytest.approx(1.0, abs=band)
        assert (errors[:, start, 3:] ** 2).mean(axis=0) / shift**2 == pytest.approx(1.0, abs=band)
        gone = errors[:, end, 3:] - errors[:, start, 3:]
        assert (gone**2).mean(axis=0) / drift**2 == pytest.approx(1.0, abs=band)
        assert (gone * errors[:, start, 3:]).mean(axis=0) / (drift * shift) == pytest.approx(0.0, abs=0.25)
    assert errors[:, 3] == pytest.approx(0.5 * (errors[:, 2] + errors[:, 4]), abs=1e-12)  # linear within a strip
    between = (errors[:, 0, :3] * errors[:, 2, :3]).mean(axis=0) / offset**2
    assert between == pytest.approx(0.0, abs=0.25)  # strips have offsets of their own
    sigma = np.concatenate([model.wander_sigma_m, np.radians(model.wander_sigma_deg)])
    assert (wandered**2).mean(axis=0) / sigma**2 == pytest.approx(1.0, abs=band)


def test_slow_errors_are_smooth_from_one_strip_to_the_next():
    drawn = draw_slow_errors(
        ErrorModel(),
        np.array([[10.0, 70.0], [170.0, 230.0]]),
        0.0,
        240.0,
        stream(1, "gnss slow"),
        stream(1, "attitude slow"),
    )
    t = np.arange(0.0, 240.0, 0.005)
    step = np.abs(np.diff(drawn.at(t), axis=0))
    assert (step.max(axis=0) < np.array([2e-3] * 3 + [np.radians(2e-5)] * 3)).all()
    difference = drawn.rate(t[1:-1]) - (drawn.at(t[2:]) - drawn.at(t[:-2])) / 0.01
    assert (np.abs(difference).max(axis=0) < np.array([5e-3] * 3 + [np.radians(5e-5)] * 3)).all()


def test_sensors_measure_truth_plus_slow_error_plus_noise(demo):
    flight, model, lever = demo.flight, demo.errors, np.array(demo.mounting.lever_arm_m)
    measured = flight.frame.from_geodetic(*demo.gnss_geodetic.T)
    antenna = antenna_position(flight.truth, demo.mounting.R_bc, lever, demo.gnss_time_s)
    rest = measured - antenna - demo.slow.at(demo.gnss_time_s)[:, :3]
    n = len(rest)
    assert rest.std(axis=0) / model.gnss_noise_m == pytest.approx(1.0, abs=4 / np.sqrt(2 * n))
    assert rest.mean(axis=0) / model.gnss_noise_m == pytest.approx(0.0, abs=4 / np.sqrt(n))

    poses = flight.truth.at(demo.attitude_time_s)
    R = R_lc_from_navigation(flight.frame, poses.position_l, demo.attitude_rpy, demo.mounting.R_bc)
    rest = corrected_angles(angles_from_matrix(R), -demo.slow.at(demo.attitude_time_s)[:, 3:]) - poses.angles
    # flying east and level, roll turns about X, pitch about -Y and heading about -Z
    n = len(rest)
    assert rest.std(axis=0) / np.radians(model.attitude_noise_deg) == pytest.approx(1.0, abs=4 / np.sqrt(2 * n) + 0.01)
    assert rest.mean(axis=0) / np.radians(model.attitude_noise_deg) == pytest.approx(0.0, abs=4 / np.sqrt(n))
    assert len(demo.attitude_time_s) == 75 * 200 + 1 and len(demo.gnss_time_s) == 75 * 5 + 1


def test_antenna_is_where_the_lever_arm_puts_it():
    flight = flown(BLOCK)
    t = np.linspace(0.0, flight.truth.end_s, 300)
    lever = np.array([2.0, 0.5, -1.5])
    poses = flight.truth.at(t)
    arm_l = antenna_position(flight.truth, Mounting(boresight_deg=(0, 0, 0)).R_bc, lever, t) - poses.position_l
    assert np.linalg.norm(arm_l, axis=1) == pytest.approx(np.linalg.norm(lever))
    level = np.abs(poses.R_lc[:, 2, 2] - 1.0) < 1e-4
    assert arm_l[level, 2] == pytest.approx(1.5, abs=0.05)  # up
    forward = poses.velocity_l[level] / np.linalg.norm(poses.velocity_l[level], axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", arm_l[level], forward) == pytest.approx(2.0, abs=0.12)
    assert np.cross(forward, arm_l[level])[:, 2] == pytest.approx(-0.5, abs=0.12)  # to the right


def test_mounting_turns_the_camera_against_the_body():
    """The body's attitude that an error-free sensor reports leads back to the camera's through the boresight only."""
    none = dict.fromkeys(
        ("offset_sigma_m", "wander_sigma_m", "shift_sigma_deg", "drift_sigma_deg", "wander_sigma_deg"), (0.0, 0.0, 0.0)
    )
    errors = ErrorModel(**none, gnss_noise_m=(0, 0, 0), attitude_noise_deg=(0, 0, 0))
    mounting = Mounting((3.0, 2.0, -1.0), (0.5, -0.4, 1.0))
    s = simulate(FlightPlan(strip_s=20.0, lead_in_s=2.0), 1, errors, ObservationPlan(tie_points_per_s=1.0), mounting)
    poses = s.flight.truth.at(s.attitude_time_s)
    R = R_lc_from_navigation(s.flight.frame, poses.position_l, s.attitude_rpy, mounting.R_bc)
    assert pytest.approx(poses.R_lc, abs=1e-12) == R
    # the antenna hangs on the body, whose attitude the sensor reports
    at_fixes = np.searchsorted(s.attitude_time_s, s.gnss_time_s - 1e-6)
    R_lb = R_lc_from_navigation(s.flight.frame, poses.position_l, s.attitude_rpy, np.eye(3))[at_fixes]
    antenna = poses.position_l[at_fixes] + R_lb @ np.array(mounting.lever_arm_m)
    assert s.flight.frame.from_geodetic(*s.gnss_geodetic.T) == pytest.approx(antenna, abs=1e-6)
    plain = R_lc_from_navigation(s.flight.frame, poses.position_l, s.attitude_rpy)
    turned = np.degrees(np.arccos((np.trace(np.swapaxes(plain, 1, 2) @ poses.R_lc, axis1=1, axis2=2) - 1) / 2))
    assert turned == pytest.approx(np.linalg.norm([0.5, -0.4, 1.0]), abs=0.01)


def test_inertial_measurements_agree_with_gnss_and_gravity():
    errors = ErrorModel(wander_sigma_m=(4.0, 4.0, 4.0))  # velocities carry the rate of the slow errors, too
    s = simulate(FlightPlan(strip_s=30.0), 1, errors, inertial=InertialPlan(TACTICAL, 100.0))
    assert s.inertial is not None and len(s.attitude_time_s) == 0
    assert s.inertial.force.mean(axis=0) == pytest.approx([0.0, 0.0, -9.81], abs=0.03)
    assert s.inertial.rate.mean(axis=0) == pytest.approx(0.0, abs=2e-3)
    assert len(s.inertial.time_s) == 45 * 100
    place = s.flight.frame.from_geodetic(*s.gnss_geodetic.T)
    slope = (place[2:] - place[:-2]) / (s.gnss_time_s[2:] - s.gnss_time_s[:-2])[:, None]
    difference = slope - s.inertial.velocity_enu[1:-1]
    # position noise of 3 cm over 0.4 s, velocity noise
    sigma = np.hypot(0.03 * np.sqrt(2) / 0.4, s.inertial.plan.velocity_noise_m_s)
    assert difference.std(axis=0) / sigma == pytest.approx(1.0, abs=0.25)
    assert difference.mean(axis=0) == pytest.approx(0.0, abs=0.05)
