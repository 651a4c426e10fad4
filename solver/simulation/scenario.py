"""A whole simulated flight: the truth, what every sensor measured of it, and the image measurements, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from ..geometry.rotation import R_BC_NOMINAL, matrix_from_navigation
from ..geometry.trajectory import Trajectory
from .error_models import ErrorModel, ErrorRealisation, Three, draw_slow_errors, measure_attitude, measure_gnss
from .flight import Flight, FlightPlan, fly
from .ground_points import GroundPoints, place_points
from .inertial_sensors import InertialMeasurements, InertialPlan, measure_inertial
from .misstated import AS_STATED, MisstatedErrors, World, as_believed, looks_through
from .observations import Looks, find_looks
from .real_motion import HIGH_ALTITUDE_ERRORS, RealMotion, control_for, degrade, fly_real_motion
from .streams import stream

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Mounting:
    """How the camera sits on the platform.

    Attributes
    ----------
    lever_arm_m : perspective centre to antenna, body frame
    boresight_deg : roll, pitch, heading of the camera against the body
    """

    lever_arm_m: Three = (0.1, 0.0, -1.2)
    boresight_deg: Three = (0.05, -0.03, 0.1)

    @property
    def R_bc(self) -> Array:
        return matrix_from_navigation(*np.radians(self.boresight_deg)) @ R_BC_NOMINAL

    def true(self, world: World) -> Mounting:
        """How it truly sits in a world where this is what is stated."""
        lever, boresight = (
            (a[0] + b[0], a[1] + b[1], a[2] + b[2])
            for a, b in ((self.lever_arm_m, world.lever_arm_m), (self.boresight_deg, world.boresight_deg))
        )
        return Mounting(lever, boresight)


@dataclass(frozen=True)
class ObservationPlan:
    """What is measured in the images and on the ground.

    Attributes
    ----------
    tie_points_per_s : new tie points per second of a strip (about three rays each)
    image_sigma_px : of a line and of a sample
    outlier_share : share of the rays of tie points that are blunders
    outlier_px : least and largest size of a blunder
    control, check : numbers of control and check points
    control_sigma_m : X, Y, Z of control points
    matching_delay_s : from the last look at a point in a strip to its tie point message

    Raises
    ------
    ValueError : a value that makes no sense
    """

    tie_points_per_s: float = 8.0
    image_sigma_px: float = 0.3
    outlier_share: float = 0.0
    outlier_px: tuple[float, float] = (5.0, 40.0)
    control: int = 6
    control_sigma_m: Three = (0.02, 0.02, 0.02)
    check: int = 30
    matching_delay_s: float = 0.2

    def __post_init__(self) -> None:
        for name in ("tie_points_per_s", "image_sigma_px", "control", "check", "matching_delay_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"observation plan: {name} must not be negative, got {getattr(self, name)}")
        if not 0 <= self.outlier_share < 1:
            raise ValueError(f"observation plan: outlier_share must be in [0, 1), got {self.outlier_share}")
        if not 0 <= self.outlier_px[0] <= self.outlier_px[1]:
            raise ValueError(f"observation plan: outlier_px wants least and largest size, got {self.outlier_px}")
        if not min(self.control_sigma_m) > 0:
            raise ValueError(f"observation plan: control_sigma_m must be positive, got {self.control_sigma_m}")


@dataclass(frozen=True)
class ImageMeasurements:
    """Image measurements with their truth; n rays.

    Attributes
    ----------
    looks : true images, indices into the points, strips and CCD lines
    line, sample : (n,) as measured, px
    outlier : (n,) which are blunders
    """

    looks: Looks
    line: Array
    sample: Array
    outlier: Mask

    def __len__(self) -> int:
        return len(self.line)

    def select(self, chosen: Mask) -> ImageMeasurements:
        """The rays of a mask."""
        return ImageMeasurements(
            self.looks.select(chosen), self.line[chosen], self.sample[chosen], self.outlier[chosen]
        )


@dataclass(frozen=True)
class Simulation:
    """Everything a flight gives.

    Attributes
    ----------
    flight : the truth, with the camera as stated
    mounting, errors, observation_plan : what was assumed
    slow : the slow errors of the trajectory sensors
    attitude_time_s, attitude_rpy : (n,), (n, 3) radians; empty if a trajectory is given instead
    gnss_time_s, gnss_geodetic : (g,), (g, 3) degrees, degrees, metres
    inertial : inertial measurements and GNSS velocities, given instead of attitude
    trajectory : degraded trajectory of the camera, given instead of attitude and GNSS
    world : by how much the world differs from what was assumed
    points : ground points
    surveyed_l : (m, 3) their coordinates as surveyed (control: with error; others: true)
    images : image measurements, sorted by point and time
    """

    flight: Flight
    mounting: Mounting
    errors: ErrorModel
    observation_plan: ObservationPlan
    slow: ErrorRealisation
    attitude_time_s: Array
    attitude_rpy: Array
    gnss_time_s: Array
    gnss_geodetic: Array
    points: GroundPoints
    surveyed_l: Array
    images: ImageMeasurements
    inertial: InertialMeasurements | None = None
    trajectory: Trajectory | None = None
    world: World = AS_STATED

    @property
    def seen_flight(self) -> Flight:
        """The flight with the true camera: what image lines are rendered from."""
        return replace(self.flight, camera=self.world.camera(self.flight.camera))


def simulate(
    plan: FlightPlan,
    seed: int,
    errors: ErrorModel | None = None,
    observation_plan: ObservationPlan | None = None,
    mounting: Mounting | None = None,
    inertial: InertialPlan | None = None,
    world: World | None = None,
) -> Simulation:
    """Fly a plan and measure: attitude at its rate, GNSS at its rate, tie, control and check points.

    With an inertial plan, inertial measurements and GNSS velocities take the place of attitude.

    Raises
    ------
    ValueError : a world that cannot be; a sine in it where no attitude is measured
    """
    flight = fly(plan, stream(seed, "motion"), stream(seed, "terrain"))
    errors, mounting, world = errors or ErrorModel(), mounting or Mounting(), world or AS_STATED
    observation_plan = observation_plan or ObservationPlan()
    if inertial is None:
        return measure(flight, seed, errors, observation_plan, mounting, world=world)
    if world.sines:
        raise ValueError("true world: a sine is an error of measured attitude; an inertial unit measures none")
    measured = measure(flight, seed, errors, observation_plan, mounting, np.empty(0), world=world)
    true, gnss_s = mounting.true(world), measured.gnss_time_s
    rate = measured.slow.rate(gnss_s)[:, :3]
    stamped, lever = replace(flight, truth=world.stamped(flight.truth)), np.array(true.lever_arm_m)
    imu = measure_inertial(stamped, true.R_bc, lever, gnss_s, rate, inertial, stream(seed, "imu"))
    return replace(measured, inertial=imu)


def measure(
    flight: Flight,
    seed: int,
    errors: ErrorModel,
    observation_plan: ObservationPlan,
    mounting: Mounting,
    attitude_time_s: Array | None = None,
    gnss_time_s: Array | None = None,
    world: World | None = None,
) -> Simulation:
    """Measurements of a flight by attitude and GNSS sensors (at given times, or at their rates) and in the images."""
    world = world or AS_STATED
    slow = slow_errors(flight, seed, errors, world)
    attitude_s = flight.sample_times(errors.attitude_rate_hz) if attitude_time_s is None else attitude_time_s
    gnss_s = flight.sample_times(errors.gnss_rate_hz) if gnss_time_s is None else gnss_time_s
    true = mounting.true(world)
    args = world.stamped(flight.truth), flight.frame, true.R_bc
    rpy = measure_attitude(*args, attitude_s, slow, errors.attitude_noise_deg, stream(seed, "attitude noise"))
    lever = np.array(true.lever_arm_m)
    geodetic = measure_gnss(*args, lever, gnss_s, slow, errors.gnss_noise_m, stream(seed, "gnss noise"))
    points, surveyed, images = measure_points(flight, seed, observation_plan, world)
    return Simulation(
        flight, mounting, errors, observation_plan, slow, attitude_s, rpy, gnss_s, geodetic, points, surveyed, images,
        world=world,
    )  # fmt: skip


def simulate_real_motion(
    motion: RealMotion,
    seed: int,
    errors: ErrorModel = HIGH_ALTITUDE_ERRORS,
    observation_plan: ObservationPlan | None = None,
    mounting: Mounting | None = None,
    camera: LineCamera | None = None,
    relief_m: float = 150.0,
    as_sensors: bool = False,
    world: World | None = None,
) -> Simulation:
    """A simulation over a recorded motion, which is its truth.

    What the system gets is the degraded trajectory of the camera; or, ``as_sensors``, attitude at all sample times and
    GNSS at every other one.
    """
    plan = observation_plan or ObservationPlan(control=control_for(motion.trajectory.end_s))
    mounting, world = mounting or Mounting(), world or AS_STATED
    flight = fly_real_motion(motion, stream(seed, "terrain"), camera, relief_m)
    if as_sensors:
        return measure(flight, seed, errors, plan, mounting, flight.truth.time_s, flight.truth.time_s[::2], world)
    nothing = np.empty(0)
    simulation = measure(flight, seed, errors, plan, mounting, nothing, nothing, world)
    noise = stream(seed, "gnss noise"), stream(seed, "attitude noise")
    true = mounting.true(world)
    mounted = true.R_bc, np.array(true.lever_arm_m), mounting.R_bc, np.array(mounting.lever_arm_m)
    believed = as_believed(world.stamped(flight.truth), *mounted)
    return replace(simulation, trajectory=degrade(believed, simulation.slow, errors, *noise))


def slow_errors(flight: Flight, seed: int, errors: ErrorModel, world: World | None = None) -> ErrorRealisation:
    """The slow errors of a flight's trajectory sensors, with all that is not stated of them."""
    world = world or AS_STATED
    drawn = draw_slow_errors(
        world.errors(errors),
        flight.strip_times_s,
        flight.truth.start_s,
        flight.truth.end_s,
        stream(seed, "gnss slow"),
        stream(seed, "attitude slow"),
    )
    unstated = world.unstated(flight.strip_times_s, flight.truth.start_s, flight.truth.end_s, seed)
    return drawn if unstated is None else MisstatedErrors.over(drawn, unstated)


def measure_points(
    flight: Flight, seed: int, plan: ObservationPlan, world: World | None = None
) -> tuple[GroundPoints, Array, ImageMeasurements]:
    """Ground points, their surveyed coordinates (m, 3), and their images; points with fewer than two rays drop out, but
    for control, of which one says something."""
    world = world or AS_STATED
    control_rng = stream(seed, "control")
    points = place_points(flight, plan.tie_points_per_s, plan.control, plan.check, stream(seed, "points"), control_rng)
    looks = find_looks(points.xyz_l, flight.strips, flight.camera)
    images = measure_images(flight, points, looks, plan, stream(seed, "image noise"), stream(seed, "outliers"), world)

    rays = np.bincount(images.looks.point, minlength=len(points))
    kept = rays >= np.where(points.role == "control", 1, 2)
    survey_error = control_rng.standard_normal((len(points), 3)) * plan.control_sigma_m + world.control_datum_m
    surveyed = points.xyz_l + np.where((points.role == "control")[:, None], survey_error, 0.0)
    images = images.select(kept[images.looks.point])
    number = np.cumsum(kept) - 1
    seen = images.looks
    looks = Looks(number[seen.point], seen.strip, seen.ccd, seen.time_s, seen.line, seen.sample)
    return points.select(kept), surveyed[kept], ImageMeasurements(looks, images.line, images.sample, images.outlier)


def measure_images(
    flight: Flight,
    points: GroundPoints,
    looks: Looks,
    plan: ObservationPlan,
    noise_rng: np.random.Generator,
    outlier_rng: np.random.Generator,
    world: World | None = None,
) -> ImageMeasurements:
    """Lines and samples with noise, and with blunders in a share of the tie rays; off the image nothing is measured.

    Parameters
    ----------
    looks : of the camera as stated; in a world with another one each is taken where that one sees it
    """
    world = world or AS_STATED
    n, seen, camera = len(looks), np.ones(len(looks), dtype=bool), world.camera(flight.camera)
    if camera is not flight.camera:
        looks, seen = looks_through(looks, find_looks(points.xyz_l, flight.strips, camera))
    noise = plan.image_sigma_px * world.image_noise(noise_rng.standard_normal((n, 2)))
    line, sample = looks.line + noise[:, 0], looks.sample + noise[:, 1]
    chance, size, direction = outlier_rng.uniform(size=(n, 3)).T
    outlier = (chance < plan.outlier_share) & (points.role[looks.point] == "tie")
    length = np.where(outlier, plan.outlier_px[0] + size * (plan.outlier_px[1] - plan.outlier_px[0]), 0.0)
    line, sample = line + length * np.cos(2 * np.pi * direction), sample + length * np.sin(2 * np.pi * direction)
    lines = np.array([strip.lines for strip in flight.strips])[looks.strip]
    pixels = np.array([ccd.pixels for ccd in flight.camera.lines])[looks.ccd]
    inside = (line >= 0) & (line <= lines - 1) & (sample >= 0) & (sample <= pixels - 1)
    return ImageMeasurements(looks, line, sample, outlier).select(inside & seen)
