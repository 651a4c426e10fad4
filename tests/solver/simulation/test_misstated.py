"""The world apart from what is said of it: each error is there, as large as it was asked for; nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from triline.solver.camera.collinearity import project
from triline.solver.geometry.frames import R_lc_from_navigation
from triline.solver.geometry.rotation import matrix_from_quaternion
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.misstated import Sine, Step, World
from triline.solver.simulation.real_motion import RealMotion
from triline.solver.simulation.scenario import Mounting, ObservationPlan, simulate, simulate_real_motion, slow_errors

PLAN = FlightPlan(strip_s=12.0, lead_in_s=2.0, lead_out_s=1.0, pose_rate_hz=100.0)
BLOCK = replace(PLAN, strips=3, strip_s=6.0, turns=False, gap_s=4.0)
ERRORS = ErrorModel(attitude_rate_hz=50.0)
OBSERVED = ObservationPlan(tie_points_per_s=4.0, check=6)
SEED = 3
MOUNTING = Mounting()


def flown(world=None, plan=PLAN, **more):
    return simulate(plan, SEED, ERRORS, OBSERVED, world=world, **more)


@pytest.fixture(scope="module")
def stated():
    return flown()


def gnss_change(simulation, stated):
    """(n, 3) m, local frame."""
    frame = stated.flight.frame
    return frame.from_geodetic(*simulation.gnss_geodetic.T) - frame.from_geodetic(*stated.gnss_geodetic.T)


def attitude_change(simulation, stated):
    change = simulation.attitude_rpy - stated.attitude_rpy
    return (change + np.pi) % (2 * np.pi) - np.pi


def changed(simulation, stated):
    """Names of what was measured differently."""
    found = set()
    if not np.array_equal(simulation.gnss_geodetic, stated.gnss_geodetic):
        found.add("gnss")
    if not np.array_equal(simulation.attitude_rpy, stated.attitude_rpy):
        found.add("attitude")
    if not np.array_equal(simulation.surveyed_l, stated.surveyed_l):
        found.add("control")
    mine, other = simulation.images, stated.images
    if not (np.array_equal(mine.line, other.line) and np.array_equal(mine.sample, other.sample)):
        found.add("images")
    return found


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (World(), set()),
        (World(wander_factor=2.0), {"gnss", "attitude"}),
        (World(wander_time_factor=1 / 3), {"gnss", "attitude"}),
        (World(random_walk_m=(0.03, 0.03, 0.03)), {"gnss"}),
        (World(steps=(Step((0.3, 0.3, 0.3)),)), {"gnss"}),
        (World(sines=(Sine((0.02, 0.02, 0.02), 0.1),)), {"attitude"}),
        (World(boresight_deg=(0.05, 0.0, 0.0)), {"gnss", "attitude"}),  # the antenna is turned with the body
        (World(lever_arm_m=(0.2, 0.0, 0.0)), {"gnss"}),
        (World(focal_length_um=20.0), {"images"}),
        (World(distortion_px=3.0), {"images"}),
        (World(clock_s=0.005), {"gnss", "attitude"}),
        (World(heavy_tails=True), {"images"}),
        (World(noise_factor=2.0), {"images"}),
        (World(gnss_datum_m=(0.5, 0.0, 0.0)), {"gnss"}),
        (World(control_datum_m=(0.5, 0.0, 0.0)), {"control"}),
    ],
)
def test_only_what_the_error_touches_changes(stated, world, expected):
    simulation = flown(world)
    assert changed(simulation, stated) == expected
    assert world.as_stated == (not expected)
    # truth and what is stated
    assert np.array_equal(simulation.flight.truth.position_l, stated.flight.truth.position_l)
    assert np.array_equal(simulation.flight.truth.quaternion, stated.flight.truth.quaternion)
    assert np.array_equal(simulation.points.xyz_l, stated.points.xyz_l)
    assert simulation.flight.camera.focal_length_mm.tolist() == stated.flight.camera.focal_length_mm.tolist()
    assert (simulation.errors, simulation.mounting) == (ERRORS, MOUNTING)
    assert simulation.observation_plan == OBSERVED
    assert np.array_equal(simulation.gnss_time_s, stated.gnss_time_s)
    assert np.array_equal(simulation.attitude_time_s, stated.attitude_time_s)


def test_errors_add_up(stated):
    both = flown(World(gnss_datum_m=(0.5, 0.0, 0.0), steps=(Step((0.0, 0.3, 0.0), 5.0), Step((0.0, 0.0, 0.1), 9.0))))
    t = stated.gnss_time_s
    expected = np.column_stack([np.full(len(t), 0.5), 0.3 * (t >= 5.0), 0.1 * (t >= 9.0)])
    assert gnss_change(both, stated) == pytest.approx(expected, abs=1e-6)


# -- trajectory --------------------------------------------------------------------------------------------------------


def test_the_wander_is_the_same_one_but_larger(stated):
    simulation = flown(World(wander_factor=2.5))
    expected = 1.5 * stated.slow.wander(stated.gnss_time_s)[:, :3]
    assert gnss_change(simulation, stated) == pytest.approx(expected, abs=1e-6)
    t = stated.attitude_time_s
    assert simulation.slow.wander(t) == pytest.approx(2.5 * stated.slow.wander(t), abs=1e-9)
    assert simulation.slow.systematic(t) == pytest.approx(stated.slow.systematic(t), abs=1e-12)


def test_a_shorter_correlation_time_makes_the_wander_faster_and_no_larger(stated):
    """The rate of a process of second order is its sigma over its time constant."""
    t, speed, size = stated.gnss_time_s, [], []
    for world in (World(), World(wander_time_factor=1 / 3)):
        drawn = [slow_errors(stated.flight, seed, ERRORS, world) for seed in range(40)]
        step = np.array([d.wander(t[1:]) - d.wander(t[:-1]) for d in drawn]) / np.diff(t)[:, None]
        speed.append(np.sqrt(np.mean(step**2, axis=(0, 1))))
        size.append(np.sqrt(np.mean(np.array([d.wander(t) for d in drawn]) ** 2, axis=(0, 1))))
    assert np.mean(speed[1] / speed[0]) == pytest.approx(3.0, rel=0.15)
    assert np.mean(size[1] / size[0]) == pytest.approx(1.0, rel=0.15)


def test_a_random_walk_begins_at_zero_and_grows_with_the_root_of_time(stated):
    world, sigma = World(random_walk_m=(0.03, 0.06, 0.0)), np.array([0.03, 0.06])
    strips, end_s = stated.flight.strip_times_s, stated.flight.truth.end_s
    at = np.array([0.0, 4.0, 9.0])
    walks = np.array([world.unstated(strips, 0.0, end_s, seed)(at) for seed in range(300)])
    assert not walks[:, 0].any() and not walks[:, :, 2:].any()
    assert np.sqrt(np.mean(walks[:, 1:, :2] ** 2, axis=0)) == pytest.approx(np.outer([2.0, 3.0], sigma), rel=0.15)


@pytest.mark.parametrize("plan", [PLAN, BLOCK], ids=["strip", "block"])
def test_a_step_comes_in_the_middle_of_the_middle_strip(plan):
    stated, simulation = flown(plan=plan), flown(World(steps=(Step((0.3, 0.0, -0.1)),)), plan)
    middle = np.mean(stated.flight.strip_times_s[(plan.strips - 1) // 2])
    after = stated.gnss_time_s >= middle
    assert after.any() and not after.all()
    expected = np.where(after[:, None], [0.3, 0.0, -0.1], 0.0)
    assert gnss_change(simulation, stated) == pytest.approx(expected, abs=1e-6)
    assert simulation.slow.rate(stated.gnss_time_s) == pytest.approx(stated.slow.rate(stated.gnss_time_s))


def test_a_sine_has_its_amplitude_and_frequency(stated):
    simulation = flown(World(sines=(Sine((0.02, 0.02, 0.01), 0.5),)))
    change, t = np.degrees(attitude_change(simulation, stated)), stated.attitude_time_s
    design = np.column_stack([np.sin(np.pi * t), np.cos(np.pi * t)])
    found, *_ = np.linalg.lstsq(design, change, rcond=None)
    assert np.linalg.norm(found, axis=0) == pytest.approx([0.02, 0.02, 0.01], rel=0.01)
    assert np.abs(change - design @ found).max() < 1e-4


def test_a_sine_may_last_for_a_part_of_the_flight(stated):
    all_along, part = (flown(World(sines=(Sine((0.02,) * 3, 0.5, *part),))) for part in ((), (2.0, 5.0)))
    there = (stated.attitude_time_s >= 2.0) & (stated.attitude_time_s <= 5.0)
    expected = np.where(there[:, None], attitude_change(all_along, stated), 0.0)
    assert there.any() and not there.all()
    assert attitude_change(part, stated) == pytest.approx(expected, abs=1e-9)
    with pytest.raises(ValueError, match="sine from 2000 to 2001 s, wanted times in 0 to"):
        flown(World(sines=(Sine((0.02,) * 3, 0.5, 2000.0, 2001.0),)))


def test_a_clock_moves_position_and_attitude_by_their_rates(stated):
    dt = 0.005
    simulation = flown(World(clock_s=dt))
    inside = (stated.gnss_time_s > 0.1) & (stated.gnss_time_s < stated.flight.truth.end_s - 0.1)
    velocity = stated.flight.truth.at(stated.gnss_time_s).velocity_l
    # what is stamped t was so before t; the antenna swings about the camera by far less
    assert gnss_change(simulation, stated)[inside] == pytest.approx(-dt * velocity[inside], abs=2e-3)
    assert np.linalg.norm(velocity, axis=1).mean() * dt == pytest.approx(0.35, rel=0.05)
    truth = flown_without_noise().attitude_rpy
    rate = np.gradient(truth, stated.attitude_time_s, axis=0)
    middle = slice(10, -10)
    change = attitude_change(simulation, stated)[middle]
    assert change == pytest.approx(-dt * rate[middle], abs=1e-6)
    assert np.abs(change).max() > 1e-5


def flown_without_noise(world=None):
    none = (0.0, 0.0, 0.0)
    errors = ErrorModel(none, none, none, none, none, 30.0, none, 5.0, none, 50.0)
    return simulate(PLAN, SEED, errors, replace(OBSERVED, image_sigma_px=0.0), world=world)


# -- mounting and camera -----------------------------------------------------------------------------------------------


def test_a_boresight_turns_the_camera_that_follows_from_the_stated_one():
    world = World(boresight_deg=(0.05, -0.02, 0.1))
    simulation = flown_without_noise(world)
    t = simulation.attitude_time_s
    truth = simulation.flight.truth.at(t)
    believed = R_lc_from_navigation(
        simulation.flight.frame, truth.position_l, simulation.attitude_rpy, simulation.mounting.R_bc
    )
    turned = np.swapaxes(truth.R_lc, 1, 2) @ believed
    expected = MOUNTING.true(world).R_bc.T @ MOUNTING.R_bc
    assert turned == pytest.approx(np.broadcast_to(expected, turned.shape), abs=1e-9)
    angle = np.degrees(np.arccos((np.trace(expected) - 1) / 2))
    assert angle == pytest.approx(np.linalg.norm(world.boresight_deg), rel=0.01)


def test_a_lever_arm_turns_with_the_body():
    world = World(lever_arm_m=(0.2, 0.1, -0.3))
    simulation, stated = flown_without_noise(world), flown_without_noise()
    R_lb = stated.flight.truth.at(stated.gnss_time_s).R_lc @ MOUNTING.R_bc.T
    assert gnss_change(simulation, stated) == pytest.approx(R_lb @ world.lever_arm_m, abs=1e-6)


def test_a_focal_length_is_in_the_images_and_not_in_the_camera_that_is_stated():
    simulation, stated = flown_without_noise(World(focal_length_um=20.0)), flown_without_noise()
    looks, camera = simulation.images.looks, simulation.flight.camera
    at = simulation.flight.truth.at(looks.time_s)
    xy = camera.image_coordinates(looks.ccd, simulation.images.sample)[0]
    off = {}
    for longer in (0.0, 0.02):
        f = camera.focal_length_mm[looks.ccd] + longer
        off[longer] = project(at.position_l, at.angles, simulation.points.xyz_l[looks.point], f).xy_mm - xy
    assert np.abs(off[0.02]).max() < 1e-6
    # the stated one images everything nearer to the middle by df / f, 2 px at the edge
    assert off[0.0] == pytest.approx(xy * (-0.02 / 62.7), abs=2e-4)
    assert len(simulation.images) == pytest.approx(len(stated.images), abs=10)
    assert simulation.seen_flight.camera.focal_length_mm == pytest.approx(camera.focal_length_mm + 0.02)


def test_a_distortion_grows_with_the_cube_of_the_radius():
    simulation, stated = flown_without_noise(World(distortion_px=3.0)), flown_without_noise()
    looks, camera = simulation.images.looks, simulation.flight.camera
    at = simulation.flight.truth.at(looks.time_s)
    xy, pitch = camera.image_coordinates(looks.ccd, simulation.images.sample)
    f = camera.focal_length_mm[looks.ccd]
    off = xy - project(at.position_l, at.angles, simulation.points.xyz_l[looks.point], f).xy_mm
    radius, corner = np.linalg.norm(xy, axis=1), max(np.linalg.norm(line.xy_mm, axis=1).max() for line in camera.lines)
    size = 3.0 * np.linalg.norm(pitch, axis=1) * (radius / corner) ** 3
    assert off == pytest.approx(xy / radius[:, None] * size[:, None], abs=2e-5)
    assert len(simulation.images) == pytest.approx(len(stated.images), abs=10)
    with pytest.raises(ValueError, match="distortion wants at most 1000 px"):
        World(distortion_px=np.inf)


def test_noise_of_other_looks_stays_with_a_focal_length(stated):
    """Noise is drawn for the looks of the stated camera, so that a look more or less at the edge moves no other."""
    noisy, clean = flown(World(focal_length_um=20.0)), flown_without_noise(World(focal_length_um=20.0))

    def noise(simulation):
        looks, images = simulation.images.looks, simulation.images
        keys = zip(simulation.points.id[looks.point], looks.strip.tolist(), looks.ccd.tolist(), strict=True)
        return {key: images.sample[i] - looks.sample[i] for i, key in enumerate(keys)}

    mine, other = noise(noisy), noise(stated)
    shared = mine.keys() & other.keys()
    assert len(shared) > 0.95 * len(other)
    assert [mine[k] for k in shared] == pytest.approx([other[k] for k in shared], abs=1e-9)
    assert np.abs(list(noise(clean).values())).max() < 1e-9


# -- image measurements and datum --------------------------------------------------------------------------------------


def test_noise_is_that_of_the_stated_flight_times_a_factor(stated):
    images = flown(World(noise_factor=2.0)).images
    noise = stated.images.sample - stated.images.looks.sample
    assert len(images) == len(stated.images)
    assert images.sample - images.looks.sample == pytest.approx(2.0 * noise, abs=1e-9)


def test_heavy_tails_are_those_of_student():
    z = np.random.default_rng(1).standard_normal(40_000)
    noise = World(heavy_tails=True).image_noise(z)
    assert (np.sign(noise) == np.sign(z)).all() and (np.diff(noise[np.argsort(z)]) >= 0).all()
    for p in (0.05, 0.25, 0.75, 0.99):
        assert np.quantile(noise, p) == pytest.approx(student.ppf(p, 3), rel=0.06)


def test_datum_of_control_and_of_gnss(stated):
    control = stated.points.role == "control"
    moved = flown(World(control_datum_m=(0.5, 0.0, -0.2))).surveyed_l - stated.surveyed_l
    assert moved[control] == pytest.approx(np.tile([0.5, 0.0, -0.2], (control.sum(), 1)))
    assert not moved[~control].any()
    gnss = gnss_change(flown(World(gnss_datum_m=(0.0, 0.4, 0.0))), stated)
    assert gnss == pytest.approx(np.tile([0.0, 0.4, 0.0], (len(gnss), 1)), abs=1e-6)


# -- other kinds of flights --------------------------------------------------------------------------------------------


def test_a_real_motion_has_the_same_errors(stated):
    motion = RealMotion(stated.flight.frame, stated.flight.truth, 0.0, 0)
    given = {"errors": ERRORS, "observation_plan": OBSERVED, "camera": stated.flight.camera, "relief_m": 75.0}

    def trajectory(world=None):
        return simulate_real_motion(motion, SEED, **given, world=world).trajectory

    plain, truth = trajectory(), stated.flight.truth
    middle = slice(10, -10)

    clock = trajectory(World(clock_s=0.01)).position_l - plain.position_l
    assert clock[middle] == pytest.approx(-0.01 * truth.at(truth.time_s).velocity_l[middle], abs=2e-3)
    step = trajectory(World(steps=(Step((0.3, 0.0, 0.0), 7.0),))).position_l - plain.position_l
    assert step == pytest.approx(np.where(truth.time_s[:, None] >= 7.0, [0.3, 0.0, 0.0], 0.0), abs=1e-9)

    R_lb = truth.at(truth.time_s).R_lc @ MOUNTING.R_bc.T
    lever = trajectory(World(lever_arm_m=(0.2, 0.0, 0.1))).position_l - plain.position_l
    assert lever == pytest.approx(R_lb @ [0.2, 0.0, 0.1], abs=1e-9)
    turned = trajectory(World(boresight_deg=(0.05, 0.0, 0.0)))
    R = np.swapaxes(matrix_from_quaternion(plain.quaternion), 1, 2) @ matrix_from_quaternion(turned.quaternion)
    angle = np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle == pytest.approx(np.full(len(angle), 0.05), rel=0.02)

    sensors = simulate_real_motion(motion, SEED, **given, as_sensors=True, world=World(clock_s=0.01))
    assert len(sensors.gnss_time_s) and sensors.trajectory is None


def test_an_inertial_unit_has_the_clock_too():
    plan = InertialPlan(TACTICAL, 100.0)
    stated, simulation = flown(inertial=plan), flown(World(clock_s=0.05), inertial=plan)
    assert np.array_equal(simulation.inertial.time_s, stated.inertial.time_s)
    rate, late, n = stated.inertial.rate, simulation.inertial.rate, 5  # 0.05 s are 5 samples
    shared = slice(20, -20)
    wrong, right = late[n:][shared] - rate[n:][shared], late[n:][shared] - rate[:-n][shared]
    assert np.sqrt(np.mean(right**2)) < 0.5 * np.sqrt(np.mean(wrong**2))
    with pytest.raises(ValueError, match="an inertial unit measures none"):
        flown(World(sines=(Sine((0.1, 0.1, 0.1), 1.0),)), inertial=plan)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"wander_factor": -1.0}, "wander_factor must not be negative"),
        ({"wander_time_factor": 0.0}, "wander_time_factor must be positive"),
        ({"noise_factor": np.nan}, "noise_factor"),
        ({"random_walk_m": (-0.1, 0.0, 0.0)}, "random_walk_m must not be negative"),
        ({"boresight_deg": (np.nan, 0.0, 0.0)}, "boresight_deg wants numbers"),
        ({"clock_s": 5.0}, "clock wants at most 1 s"),
        ({"sines": (Sine((0.1, 0.1, 0.1), 0.0),)}, "frequency of a sine must be positive"),
        ({"focal_length_um": np.inf}, "focal_length_um must be finite"),
    ],
)
def test_worlds_that_cannot_be(wrong, said):
    with pytest.raises(ValueError, match=said):
        World(**wrong)


def test_errors_that_do_not_fit_the_flight():
    with pytest.raises(ValueError, match="step at 900 s, wanted a time in 0 to"):
        flown(World(steps=(Step((0.3, 0.3, 0.3), 900.0),)))
    with pytest.raises(ValueError, match="focal length 20000 um off"):
        flown(World(focal_length_um=20_000.0))
