"""The simulated flight: its motion, its ground, what its sensors measure and what its images show."""

from pathlib import Path

import numpy as np
import pytest

from triline.solver.collinearity import project
from triline.solver.frames import R_lc_from_navigation
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.rotation import angles_from_matrix, matrix_from_angles, navigation_from_matrix
from triline.solver.sensors import preset
from triline.solver.simulation.error_models import ErrorModel, antenna_position, draw_slow_errors
from triline.solver.simulation.flight import FlightPlan, fly, view_tangents
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.observations import find_looks
from triline.solver.simulation.path import Leg, fly_legs, shortest_turn
from triline.solver.simulation.real_motion import real_motion, without_jumps
from triline.solver.simulation.scenario import (
    Mounting,
    ObservationPlan,
    simulate,
    simulate_real_motion,
)
from triline.solver.simulation.spectra import band_limited_noise
from triline.solver.simulation.streams import STREAMS, stream
from triline.solver.simulation.terrain import fractal_terrain

AVIRIS = Path(__file__).parents[1] / "../shared/data/avirisng/ang20170323t202244_eph_att"
BLOCK = FlightPlan(strips=2, cross_strips=1, strip_s=45.0, stabilised=False)
EXACT = ObservationPlan(image_sigma_px=0.0)


def flown(plan, seed=1):
    return fly(plan, stream(seed, "motion"), stream(seed, "terrain"))


@pytest.fixture(scope="module")
def demo():
    return simulate(FlightPlan(), 1)


@pytest.fixture(scope="module")
def block():
    return simulate(BLOCK, 3, observation_plan=EXACT)


@pytest.fixture(scope="module")
def aviris():
    if not AVIRIS.exists():
        pytest.skip(f"{AVIRIS} is absent")
    poses = np.fromfile(AVIRIS, "<f8").reshape(-1, 7)
    return poses[:, 0], poses[:, 1], poses[:, 2], poses[:, 3], np.radians(poses[:, [5, 4, 6]])


def reprojection_px(simulation):
    """Distance of noise-free image points from the projection of the true points through the true orientation, px."""
    looks, flight = simulation.images.looks, simulation.flight
    poses = flight.truth.at(looks.time_s)
    points = simulation.points.xyz_l[looks.point]
    projected = project(poses.position_l, poses.angles, points, flight.camera.focal_length_mm[looks.ccd])
    assert projected.in_front.all()
    xy, pitch = flight.camera.image_coordinates(looks.ccd, looks.sample)
    return np.linalg.norm(projected.xy_mm - xy, axis=1) / np.linalg.norm(pitch, axis=1)


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
    from triline.solver.camera import CcdLine, Lens, LineCamera, straight_line

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
    rest = angles_from_matrix(R) - poses.angles - demo.slow.at(demo.attitude_time_s)[:, 3:]
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


# -- motion ------------------------------------------------------------------------------------------------------------


def test_jitter_is_that_of_the_mount():
    for stabilised, sigma in ((True, 0.05), (False, 0.4)):
        found = []
        for seed in range(12):
            flight = flown(FlightPlan(stabilised=stabilised, strip_s=40.0), seed)
            found.append(np.degrees(flight.truth.at(flight.truth.time_s).angles))
        angles = np.array(found)
        assert np.sqrt(np.mean(angles**2, axis=(0, 1))) == pytest.approx(sigma, rel=0.2)


def test_noise_is_band_limited_and_of_the_stated_variance():
    series = np.hstack(
        [band_limited_noise(np.random.default_rng(s), 6000, 0.01, [1.0, 3.0], 0.3, 2.0) for s in range(20)]
    )
    power = np.mean(np.abs(np.fft.rfft(series * np.hanning(6000)[:, None], axis=0)) ** 2, axis=1)
    f = np.fft.rfftfreq(6000, 0.01)
    assert power[f > 2.1].sum() < 1e-6 * power.sum()
    assert np.sqrt(np.mean(series[:, ::2] ** 2)) == pytest.approx(1.0, abs=0.08)
    assert np.sqrt(np.mean(series[:, 1::2] ** 2)) == pytest.approx(3.0, abs=0.24)


def test_strips_are_straight_parallel_and_alternate():
    plan = FlightPlan(strips=3, cross_strips=1, strip_s=40.0, turbulence=0.0, heading_deg=60.0)
    flight = flown(plan)
    directions = []
    for strip, (start, end) in zip(flight.strips, flight.strip_times_s, strict=True):
        t = np.linspace(start, end, 200)
        poses = flight.truth.at(t)
        xy = poses.position_l[:, :2]
        direction = (xy[-1] - xy[0]) / np.linalg.norm(xy[-1] - xy[0])
        directions.append(np.degrees(np.arctan2(direction[0], direction[1])) % 360)
        aside = (xy - xy[0]) @ np.array([-direction[1], direction[0]])
        assert np.abs(aside).max() < 1e-4
        speed = np.linalg.norm(poses.velocity_l[:, :2], axis=1)
        assert speed == pytest.approx(70.0, abs=1e-4)
        assert strip.lines == pytest.approx((end - start) * plan.line_rate_hz, abs=1.5)
        # height above the ellipsoid is kept
        assert np.ptp(flight.frame.to_geodetic(poses.position_l)[:, 2]) < 0.02
    assert directions == pytest.approx([60.0, 240.0, 60.0, 330.0], abs=1e-3)
    assert [strip.id for strip in flight.strips] == ["S1", "S2", "S3", "C1"]
    apart = [
        flight.truth.at(t).position_l[0, :2] @ [-np.sin(np.radians(30)), np.cos(np.radians(30))]
        for t in flight.strip_times_s[:3, 0]
    ]
    assert np.diff(apart) == pytest.approx(0.7 * plan.swath_m, abs=1e-3)
    assert plan.swath_m == pytest.approx(1500 * 11999 * 0.0065 / 62.7)


def test_turns_are_coordinated():
    """In a turn without turbulence the lateral acceleration is gravity times the tangent of the roll."""
    flight = flown(FlightPlan(strips=2, strip_s=20.0, turbulence=0.0, pose_rate_hz=50.0))
    t = np.arange(0.5, flight.truth.end_s - 0.5, 0.1)
    poses = flight.truth.at(t)
    R_nb = np.swapaxes(flight.frame.R_ln(poses.position_l), -1, -2) @ poses.R_lc @ np.diag([1.0, -1.0, -1.0])
    roll, pitch, heading = navigation_from_matrix(R_nb).T
    track = np.arctan2(poses.velocity_l[:, 0], poses.velocity_l[:, 1])
    assert np.angle(np.exp(1j * (heading - track))) == pytest.approx(
        0.0, abs=1e-3
    )  # no side slip; convergence is small
    turning = np.gradient(np.unwrap(track), t)
    assert 70.0 * turning == pytest.approx(9.81 * np.tan(roll), abs=0.02)
    assert np.degrees(np.abs(roll).max()) == pytest.approx(25.0, abs=0.5)
    assert np.abs(pitch).max() < 1e-3
    speed = np.linalg.norm(poses.velocity_l, axis=1)
    assert speed.min() > 69.0 and speed.max() < 70.01


def test_without_turns_nothing_is_measured_between_strips():
    s = simulate(
        FlightPlan(strips=2, strip_s=20.0, turns=False, gap_s=30.0),
        1,
        observation_plan=ObservationPlan(tie_points_per_s=2.0),
    )
    assert s.flight.covered_s == pytest.approx(np.array([[0.0, 35.0], [65.0, 100.0]]), abs=0.011)
    for times in (s.attitude_time_s, s.gnss_time_s):
        assert not ((times > 35.02) & (times < 64.98)).any()
        assert (times > 65.5).any()
    assert np.bincount(s.images.looks.strip).min() > 30


@pytest.mark.parametrize("radius", [300.0, 1100.0])
def test_turns_lead_where_they_should(radius):
    rng = np.random.default_rng(1)
    for _ in range(300):
        start, end = rng.uniform(-2000, 2000, (2, 2))
        azimuth, end_azimuth = rng.uniform(-7, 7, 2)
        way = shortest_turn(tuple(start), azimuth, tuple(end), end_azimuth, radius)
        x, a = start.copy(), azimuth
        for length, curvature in way:
            assert length >= 0 and abs(curvature) <= 1 / radius + 1e-12
            if curvature == 0:
                x = x + length * np.array([np.cos(a), np.sin(a)])
            else:
                b = a + length * curvature
                x = x + np.array([np.sin(b) - np.sin(a), np.cos(a) - np.cos(b)]) / curvature
                a = b
        assert x == pytest.approx(end, abs=1e-6)
        assert np.exp(1j * a) == pytest.approx(np.exp(1j * end_azimuth), abs=1e-9)
        assert sum(p[0] for p in way) >= np.linalg.norm(end - start) - 1e-6


@pytest.mark.parametrize("azimuth", [0.0, 0.1, 1.0, 2.5, -3.0, np.pi])
def test_no_circle_is_flown_where_none_is_needed(azimuth):
    ahead = (10.0 + 5000.0 * np.cos(azimuth), -3.0 + 5000.0 * np.sin(azimuth))
    way = shortest_turn((10.0, -3.0), azimuth, ahead, azimuth, 1000.0)
    assert sum(length for length, _ in way) == pytest.approx(5000.0, abs=1e-3)


def test_track_is_rounded_but_legs_are_flown():
    track = fly_legs([Leg((0.0, 0.0), 0.3, 2000.0), Leg((0.0, 900.0), 2.0, 1500.0)], 70.0, 0.02, 1000.0, 5.0, 5.0)
    assert np.abs(np.diff(track.azimuth_rate)).max() / 0.02 < 0.02  # roll builds up over seconds, rad/s^2
    for start, end, azimuth in zip(track.leg_start_s, track.leg_end_s, (0.3, 2.0), strict=True):
        on = (track.time_s >= start) & (track.time_s <= end)
        assert np.exp(1j * track.azimuth[on]) == pytest.approx(np.exp(1j * azimuth), abs=1e-6)


def test_terrain_stays_in_range_and_is_cut_where_it_is():
    for seed in range(5):
        terrain = fractal_terrain(np.random.default_rng(seed), 100.0, 75.0)
        xy = np.random.default_rng(9).uniform(-8000, 8000, (20000, 2))
        z = terrain.height(*xy.T) + np.sum(xy**2, axis=1) / 2 / 6.371e6
        assert z.std() == pytest.approx(37.5, rel=0.15) and z.mean() == pytest.approx(100.0, abs=8.0)
        assert (np.abs(z - 100) < 75).mean() > 0.9
    start = np.array([[0.0, 0.0, 1500.0], [100.0, -300.0, 1400.0]])
    found = terrain.intersect(start, np.array([[0.5, 0.4, -1.0], [-0.6, 0.0, -1.0]]))
    assert found[:, 2] == pytest.approx(terrain.height(found[:, 0], found[:, 1]), abs=1e-8)
    assert np.cross(found - start, [[0.5, 0.4, -1.0], [-0.6, 0.0, -1.0]]) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(ValueError, match="do not come down"):
        terrain.intersect(start, np.array([[0.5, 0.4, -1.0], [0.1, 0.0, 1.0]]))


@pytest.mark.parametrize(
    "bad",
    [
        {"height_m": 0.0},
        {"speed_m_s": -70.0},
        {"strip_s": float("nan")},
        {"height_m": float("inf")},
        {"strips": 0},
        {"sidelap": 1.0},
        {"turbulence": -1.0},
        {"relief_m": 900.0},
        {"bank_deg": 80.0},
        {"strip_s": 1e9},
        {"speed_m_s": 1e6},
        {"camera": preset("alos-prism")},
    ],
)
def test_plans_that_cannot_be_flown_say_why(bad):
    with pytest.raises(ValueError, match="flight plan: "):
        FlightPlan(**bad)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ErrorModel(offset_sigma_m=(1.0, -1.0, 0.0)),
        lambda: ErrorModel(wander_time_s=0.0),
        lambda: ErrorModel(gnss_rate_hz=float("nan")),
        lambda: ObservationPlan(outlier_share=1.0),
        lambda: ObservationPlan(outlier_px=(9.0, 3.0)),
        lambda: ObservationPlan(control=-1),
        lambda: ObservationPlan(control_sigma_m=(0.0, 0.1, 0.1)),
        lambda: InertialPlan(TACTICAL, 0.0),
        lambda: simulate(FlightPlan(strips=2, strip_s=5.0, turns=False), 1, inertial=InertialPlan(TACTICAL)),
        lambda: draw_slow_errors(
            ErrorModel(), np.array([[0, 5], [4, 9]]), 0, 9, stream(1, "gnss slow"), stream(1, "imu")
        ),
    ],
)
def test_bad_settings_say_what_was_wanted(make):
    with pytest.raises(ValueError, match=r"want|must|needs"):
        make()


def test_a_short_strip_and_an_empty_one_still_fly():
    short = simulate(FlightPlan(strip_s=4.0), 1)  # shorter than the base of the camera
    assert len(short.attitude_time_s) == 19 * 200 + 1
    empty = simulate(FlightPlan(strip_s=4.0), 1, observation_plan=ObservationPlan(0.0, control=0, check=0))
    assert len(empty.points) == len(empty.images) == 0


def test_view_tangents_follow_the_preset():
    assert np.degrees(np.arctan(view_tangents(preset("ads40")))) == pytest.approx([26.0, 0.0, -16.0], abs=1e-3)


# -- real motion -------------------------------------------------------------------------------------------------------


def made_motion(n=600, jump_at=300, jump=5.0):
    """A straight flight north at 200 m/s, 10 Hz, with a step of the recorded height."""
    t = np.arange(n) / 10.0
    height = np.full(n, 20000.0) + 5.0 * np.sin(t / 10.0)
    height[jump_at:] += jump
    return t, 33.0 + t * 200.0 / 111000.0, np.full(n, -115.0), height, np.zeros((n, 3))


def test_steps_of_a_recorded_position_are_taken_out():
    t, lat, lon, height, rpy = made_motion()
    motion = real_motion(t, lat, lon, height, rpy)
    assert motion.jumps == 1
    found = motion.frame.to_geodetic(motion.trajectory.position_l)[:, 2]
    assert found == pytest.approx(height - np.where(t >= 30.0, 5.0, 0.0), abs=0.06)
    smooth = real_motion(*made_motion(jump=0.0))
    assert smooth.jumps == 0
    assert without_jumps(t, smooth.trajectory.position_l)[0] == pytest.approx(smooth.trajectory.position_l)


def test_part_of_a_motion_is_taken_by_time():
    motion = real_motion(*made_motion(), from_s=10.0, duration_s=20.0)
    assert motion.first_time_s == pytest.approx(10.0)
    assert motion.trajectory.start_s == 0.0 and motion.trajectory.end_s == pytest.approx(20.0)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda a: (a[0][::-1], *a[1:]),
        lambda a: (a[0][:-1], *a[1:]),
        lambda a: (*a[:3], np.where(a[0] == 5.0, np.nan, a[3]), a[4]),
        lambda a: tuple(v[:8] for v in a),
        lambda a: tuple(v[:0] for v in a),
    ],
)
def test_bad_pose_arrays_say_what_is_wrong(spoil):
    with pytest.raises(ValueError, match=r"increase|match|finite|too short"):
        real_motion(*spoil(made_motion()))


def test_a_motion_on_the_ground_is_refused():
    t, lat, lon, height, rpy = made_motion()
    with pytest.raises(ValueError, match="above mean ground"):
        simulate_real_motion(real_motion(t, lat, lon, height - 19800.0, rpy), 1)


def test_real_motion_is_dense_enough_to_interpolate(aviris):
    """Every other sample, interpolated from the rest: loss at half the rate bounds the loss at the full one."""
    motion = real_motion(*aviris, from_s=800.0, duration_s=300.0)
    full = motion.trajectory
    half = type(full)(full.time_s[::2], full.position_l[::2], full.quaternion[::2])
    t = full.time_s[1:-1:2]
    apart = np.linalg.norm(half.at(t).position_l - full.at(t).position_l, axis=1)
    turned = half.at(t).angles - full.at(t).angles
    assert np.percentile(apart, 95) < 0.05  # a twelfth of a pixel of 0.6 m
    assert np.degrees(np.percentile(np.abs(turned), 95)) < 0.006  # itself a real motion that 5 Hz cannot hold


def test_camera_on_a_real_motion(aviris):
    motion = real_motion(*aviris, from_s=900.0, duration_s=120.0)
    s = simulate_real_motion(motion, 1, observation_plan=EXACT)
    flight = s.flight
    assert reprojection_px(s).max() < 1e-6
    rays = np.bincount(s.images.looks.point)
    assert rays.max() == 3 and (rays == 3).mean() > 0.4  # the base of the camera is half the strip
    assert (rays[s.points.role != "tie"] == 3).all()
    # pixels are square on the ground: one line on is one pixel on
    looks = s.images.looks
    nadir = looks.ccd == 1
    speed = np.linalg.norm(flight.truth.at(looks.time_s[nadir]).velocity_l, axis=1).mean()
    height = flight.truth.position_l[:, 2].mean() - s.points.xyz_l[:, 2].mean()
    assert speed / flight.strips[0].line_rate_hz == pytest.approx(height * 0.0065 / 80.0, rel=0.02)
    # the degraded trajectory is off by the slow errors and the noise
    assert s.trajectory is not None and len(s.attitude_time_s) == 0
    rest = s.trajectory.position_l - flight.truth.position_l - s.slow.at(flight.truth.time_s)[:, :3]
    assert rest.std(axis=0) / s.errors.gnss_noise_m == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(rest)))
    assert np.abs(s.slow.at(flight.truth.time_s)[:, :3]).max() > 0.5


def test_real_motion_as_sensors_leads_back_to_the_truth(aviris):
    motion = real_motion(*aviris, from_s=900.0, duration_s=60.0)
    s = simulate_real_motion(motion, 1, as_sensors=True)
    truth = s.flight.truth
    assert s.trajectory is None
    assert len(s.attitude_time_s) == len(truth) and len(s.gnss_time_s) == (len(truth) + 1) // 2
    poses = truth.at(s.attitude_time_s)
    R = R_lc_from_navigation(s.flight.frame, poses.position_l, s.attitude_rpy, s.mounting.R_bc)
    rest = angles_from_matrix(R) - poses.angles - s.slow.at(s.attitude_time_s)[:, 3:]
    assert np.degrees(rest.std(axis=0)) == pytest.approx([0.0002, 0.0002, 0.0004], rel=0.2)
