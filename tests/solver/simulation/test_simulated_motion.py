"""The motion of a simulated flight: mounts, turns, tracks, and motion that was recorded."""

import numpy as np
import pytest
from places import MOTION
from simulated_rays import EXACT, flown, reprojection_px

from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import R_lc_from_navigation
from triline.solver.geometry.rotation import angles_from_matrix, navigation_from_matrix
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel, draw_slow_errors
from triline.solver.simulation.flight import FlightPlan, view_tangents
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.path import Leg, fly_legs, shortest_turn
from triline.solver.simulation.real_motion import real_motion, without_jumps
from triline.solver.simulation.scenario import (
    ObservationPlan,
    simulate,
    simulate_real_motion,
)
from triline.solver.simulation.spectra import band_limited_noise
from triline.solver.simulation.streams import stream
from triline.solver.simulation.terrain import fractal_terrain


@pytest.fixture(scope="module")
def aviris():
    if not MOTION.exists():
        pytest.skip(f"{MOTION} is absent")
    poses = np.fromfile(MOTION, "<f8").reshape(-1, 7)
    return poses[:, 0], poses[:, 1], poses[:, 2], poses[:, 3], np.radians(poses[:, [5, 4, 6]])


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


def test_a_relief_as_steep_as_the_rays_is_met_where_they_first_come_to_it():
    """From height to height along the ray nothing comes to rest there: `simulate --relief 450` told of a fault."""
    terrain, rng = fractal_terrain(np.random.default_rng(1), 0.0, 450.0), np.random.default_rng(2)
    start = np.column_stack([rng.uniform(-3000, 3000, (600, 2)), np.full(600, 1500.0)])
    direction = np.column_stack([rng.uniform(-0.9, 0.9, (600, 2)), np.full(600, -1.0)])
    found = terrain.intersect(start, direction)
    assert found[:, 2] == pytest.approx(terrain.height(found[:, 0], found[:, 1]), abs=1e-8)
    assert np.cross(found - start, direction) == pytest.approx(0.0, abs=1e-6)
    before = start[:, None] + np.linspace(0.001, 0.999, 1000)[:, None] * (found - start)[:, None]
    assert (terrain.height(before[..., 0], before[..., 1]) < before[..., 2] + 1e-6).all()
    assert terrain.met(start, direction) == pytest.approx(found[:, 2], abs=1e-3)


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
