"""The simulator as a source of messages: each at the stamp at which an on-line system would have it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...schemas.image_lines import LineBlock
from ...schemas.topics import rank
from ...solver.geometry.rotation import quaternion_from_matrix
from ...solver.geometry.trajectory import Trajectory
from ...solver.simulation.imagery import LineImager
from ...solver.simulation.inertial_sensors import InertialMeasurements
from ...solver.simulation.scenario import Simulation
from .. import convert
from ..errors import UserError
from ..node import Message, Node
from .world_settings import world_text

if TYPE_CHECKING:
    from ..bus.brake import Brake
    from ..bus.program import ProgramOptions
    from ..bus.status import StatusPublisher

Array = NDArray[np.floating]

#: Of a planned flight, whose jitter is sampled finely; a recorded motion is written at its own samples, which alone
#: give the same interpolation again.
TRUTH_RATE_HZ = 20.0
#: Camera, project and ground points are known so long before time 0.
BEFORE_NS = -convert.SECOND_NS
#: A strip is closed when its last matches must be out, this much after the matching delay.
CLOSING_S = 0.05
#: A-priori sigmas are never published smaller than this: they become weights.
LEAST_SIGMA_M, LEAST_SIGMA_DEG, DEFAULT_IMAGE_SIGMA_PX = 1e-4, 1e-6, 0.3


@dataclass(frozen=True)
class _Stream:
    """Messages of one topic: stamps (n,) in ns since the start, and what builds message i for an epoch."""

    topic: str
    after_ns: NDArray[np.int64]
    body: Callable[[int, int], object]


class Simulator(Node):
    """A flight, message by message. It has no inputs: whoever runs it draws from `messages` and keeps the time.

    Parameters
    ----------
    simulation : what happened
    imager : renders the image lines; None for a flight without
    """

    name = "simulator"
    inputs = ()
    outputs = (
        "configuration/project",
        "configuration/camera",
        "configuration/strip",
        "sensor/imu",
        "sensor/attitude",
        "sensor/gnss",
        "trajectory/smoothed",
        "sensor/lines/*",
        "observation/control",
        "observation/tie",
        "truth/trajectory",
        "truth/point",
        "truth/world",
    )

    def __init__(self, simulation: Simulation, imager: LineImager | None = None) -> None:
        super().__init__()
        self.simulation = simulation
        self._streams = [
            *self._configuration(),
            *self._trajectory_sensors(),
            *self._ground(0.0 if imager is None else imager.texture.target_radius_m),
            *([self._ties()] if imager is None or simulation.observation_plan.tie_points_per_s else []),
            self._true_trajectory(),
            *([] if simulation.world.as_stated else [self._world()]),
            *([] if imager is None else self._lines(imager)),
        ]
        order = sorted(
            (int(after), rank(stream.topic), s, i)
            for s, stream in enumerate(self._streams)
            for i, after in enumerate(stream.after_ns)
        )
        self._order = [(after, s, i) for after, _, s, i in order]

    def __len__(self) -> int:
        return len(self._order)

    def step(self, message: Message) -> tuple[Message, ...]:
        """Nothing follows from other messages."""
        return ()

    @property
    def duration_s(self) -> float:
        """Of the flight, as `triline info` has it: without the second before it in which it is configured."""
        return self._order[-1][0] / convert.SECOND_NS

    def messages(self, epoch_ns: int) -> Iterator[Message]:
        """All messages in the order of their stamps; time 0 of the flight is ``epoch_ns``.

        Configuration and ground points come a second before it.
        """
        for after, s, i in self._order:
            stream = self._streams[s]
            yield Message(stream.topic, epoch_ns + after, stream.body(i, epoch_ns), source=self.name)

    def _configuration(self) -> list[_Stream]:
        sim = self.simulation
        project, camera = self._project(), convert.camera_message(sim.flight.camera)
        strips = sim.flight.strips
        times = sim.flight.strip_times_s
        closing = times[:, 1] + sim.observation_plan.matching_delay_s + CLOSING_S
        start = np.full(1, BEFORE_NS)

        def strip_body(i: int, epoch_ns: int) -> object:
            strip = strips[i // 2]
            return m.Strip(
                id=strip.id,
                first_line_time_ns=epoch_ns + _ns(strip.first_line_time_s),
                line_rate_hz=strip.line_rate_hz,
                lines=strip.lines,
                ended=i % 2 == 1,
            )

        return [
            _Stream("configuration/project", start, lambda i, epoch_ns: project),
            _Stream("configuration/camera", start, lambda i, epoch_ns: camera),
            _Stream("configuration/strip", _ns_array(np.column_stack([times[:, 0], closing]).ravel()), strip_body),
        ]

    def _project(self) -> object:
        sim = self.simulation
        frame, errors = sim.flight.frame, sim.errors
        return m.Project(
            name=sim.flight.name,
            crs=frame.crs,
            origin_latitude=frame.lat_deg,
            origin_longitude=frame.lon_deg,
            origin_height=frame.height_m,
            lever_arm_m=sim.mounting.lever_arm_m,
            boresight_deg=sim.mounting.boresight_deg,
            image_sigma_px=sim.observation_plan.image_sigma_px or DEFAULT_IMAGE_SIGMA_PX,
            offset_sigma_m=_at_least(errors.offset_sigma_m, LEAST_SIGMA_M),
            shift_sigma_deg=_at_least(errors.shift_sigma_deg, LEAST_SIGMA_DEG),
            drift_sigma_deg=_at_least(errors.drift_sigma_deg, LEAST_SIGMA_DEG),
            wander_sigma_m=errors.wander_sigma_m,
            wander_sigma_deg=errors.wander_sigma_deg,
            wander_time_s=errors.wander_time_s,
            attitude_wander_time_s=errors.attitude_wander_time_s,
        )

    def _trajectory_sensors(self) -> list[_Stream]:
        sim = self.simulation
        if sim.trajectory is not None:
            return [
                self._poses("trajectory/smoothed", sim.trajectory, sim.trajectory.time_s, self._trajectory_covariance())
            ]
        gnss_ns = _ns_array(sim.gnss_time_s)
        inertial = sim.inertial

        def gnss(i: int, epoch_ns: int) -> object:
            velocity = () if inertial is None else (inertial.velocity_enu[i], inertial.plan.velocity_noise_m_s)
            stamp_ns = epoch_ns + int(gnss_ns[i])
            return convert.gnss_message(stamp_ns, sim.gnss_geodetic[i], sim.errors.gnss_noise_m, *velocity)

        sensor = self._attitude() if inertial is None else self._inertial(inertial)
        return [sensor, _Stream("sensor/gnss", gnss_ns, gnss)]

    def _attitude(self) -> _Stream:
        sim = self.simulation
        sigma, after_ns = np.radians(sim.errors.attitude_noise_deg), _ns_array(sim.attitude_time_s)

        def attitude(i: int, epoch_ns: int) -> object:
            return convert.attitude_message(epoch_ns + int(after_ns[i]), sim.attitude_rpy[i], sigma)

        return _Stream("sensor/attitude", after_ns, attitude)

    @staticmethod
    def _inertial(measured: InertialMeasurements) -> _Stream:
        after_ns, grade = _ns_array(measured.time_s), measured.plan.grade
        interval_s = 1.0 / measured.plan.rate_hz

        def imu(i: int, epoch_ns: int) -> object:
            force, rate = measured.force[i].tolist(), measured.rate[i].tolist()
            return grouped(m.Imu)(
                time_ns=epoch_ns + int(after_ns[i]),
                interval_ns=_ns(interval_s),
                force_x=force[0],
                force_y=force[1],
                force_z=force[2],
                rate_x=rate[0],
                rate_y=rate[1],
                rate_z=rate[2],
                force_sigma=grade.accel_noise / interval_s**0.5,
                rate_sigma=grade.gyro_noise / interval_s**0.5,
            )

        return _Stream("sensor/imu", after_ns, imu)

    def _trajectory_covariance(self) -> Array:
        """Of a given trajectory: slow errors and noise."""
        errors = self.simulation.errors
        position = errors.offset_sigma_m, errors.wander_sigma_m, errors.gnss_noise_m
        attitude = errors.shift_sigma_deg, errors.drift_sigma_deg, errors.wander_sigma_deg, errors.attitude_noise_deg
        variances = [np.sum(np.square(parts), axis=0) for parts in (position, np.radians(attitude))]
        return np.diag(np.concatenate(variances))

    def _ground(self, target_radius_m: float) -> list[_Stream]:
        sim = self.simulation
        start = np.full(len(sim.points), BEFORE_NS)
        control = [
            convert.ground_point_message(
                str(sim.points.id[i]),
                sim.surveyed_l[i],
                np.diag(np.square(sim.observation_plan.control_sigma_m)) if role == "control" else np.zeros((3, 3)),
                str(role),
                target_radius_m,
            )
            for i, role in enumerate(sim.points.role)
            if role != "tie"
        ]

        def truth(i: int, epoch_ns: int) -> object:
            return convert.ground_point_message(str(sim.points.id[i]), sim.points.xyz_l[i], np.zeros((3, 3)), "check")

        return [
            _Stream("observation/control", start[: len(control)], lambda i, epoch_ns: control[i]),
            _Stream("truth/point", start, truth),
        ]

    def _ties(self) -> _Stream:
        """One message for a point and strip, when its last look there has been imaged and matched."""
        sim = self.simulation
        looks, strips = sim.images.looks, sim.flight.strips
        group = np.flatnonzero(np.diff(looks.point, prepend=-1) | np.diff(looks.strip, prepend=-1))
        bounds = np.append(group, len(looks))
        last = np.maximum.reduceat(looks.time_s, group) if len(looks) else np.empty(0)
        rate = np.array([strip.line_rate_hz for strip in strips])[looks.strip]
        first_ns = np.array([_ns(strip.first_line_time_s) for strip in strips])[looks.strip]
        time_ns = first_ns + _ns_array(sim.images.line / rate)

        def tie(i: int, epoch_ns: int) -> object:
            images = [
                {
                    "strip": strips[looks.strip[j]].id,
                    "ccd": sim.flight.camera.lines[looks.ccd[j]].id,
                    "line": float(sim.images.line[j]),
                    "sample": float(sim.images.sample[j]),
                    "time_ns": epoch_ns + int(time_ns[j]),
                }
                for j in range(bounds[i], bounds[i + 1])
            ]
            return convert.tie_message(str(sim.points.id[looks.point[bounds[i]]]), images)

        return _Stream("observation/tie", _ns_array(last + sim.observation_plan.matching_delay_s), tie)

    def _lines(self, imager: LineImager) -> list[_Stream]:
        """Blocks of image lines, each when its last line has been read; rendered when they are asked for."""
        flight = self.simulation.flight
        blocks = []
        for number, strip in enumerate(flight.strips):
            size = max(round(imager.plan.block_s * strip.line_rate_hz), 1)
            blocks += [(number, first, min(size, strip.lines - first)) for first in range(0, strip.lines, size)]
        after = [float(flight.strips[number].time_of(first + count - 1)) for number, first, count in blocks]

        def stream(ccd: int, name: str) -> _Stream:
            def block(i: int, epoch_ns: int) -> object:
                number, first, count = blocks[i]
                strip = flight.strips[number]
                return LineBlock(
                    imager.render(number, ccd, first, count),
                    name,
                    strip.id,
                    first,
                    epoch_ns + _ns(float(strip.time_of(first))),
                    round(convert.SECOND_NS / strip.line_rate_hz),
                )

            return _Stream(f"sensor/lines/{name}", _ns_array(after), block)

        return [stream(i, line.id) for i, line in enumerate(flight.camera.lines)]

    def _world(self) -> _Stream:
        """What is not stated; of the family of truths, which no estimating node reads."""
        text = world_text(self.simulation.world)

        def body(i: int, epoch_ns: int) -> object:
            return convert.log_line(self.name, text, epoch_ns + BEFORE_NS)

        return _Stream("truth/world", np.full(1, BEFORE_NS), body)

    def _true_trajectory(self) -> _Stream:
        flight = self.simulation.flight
        time_s = flight.truth.time_s if flight.recorded else flight.sample_times(TRUTH_RATE_HZ)
        return self._poses("truth/trajectory", flight.truth, time_s, None)

    def _poses(self, topic: str, trajectory: Trajectory, time_s: Array, covariance: Array | None) -> _Stream:
        poses = trajectory.at(time_s)
        quaternion = quaternion_from_matrix(poses.R_lc)
        after_ns = _ns_array(time_s)
        strip_s, strips = self.simulation.flight.strip_times_s, self.simulation.flight.strips
        inside = (time_s[:, None] >= strip_s[:, 0]) & (time_s[:, None] <= strip_s[:, 1])
        strip = [strips[int(row.argmax())].id if row.any() else "" for row in inside]

        def pose(i: int, epoch_ns: int) -> object:
            return convert.pose_message(
                epoch_ns + int(after_ns[i]),
                poses.position_l[i],
                poses.angles[i],
                covariance,
                quaternion=quaternion[i],
                strip=strip[i],
                velocity_l=poses.velocity_l[i],
            )

        return _Stream(topic, after_ns, pose)


def _ns(time_s: float) -> int:
    return round(time_s * convert.SECOND_NS)


def _ns_array(time_s: ArrayLike) -> NDArray[np.int64]:
    return np.rint(np.asarray(time_s, dtype=float) * convert.SECOND_NS).astype(np.int64)


def _at_least(values: tuple[float, ...], least: float) -> list[float]:
    return [max(v, least) for v in values]


def run(options: ProgramOptions) -> int:
    """Fly on the bus in real time: [simulator] takes the settings of ``triline simulate``, rate, and wait_for.

    The stamps are wall-clock time (at rate 1); the flight begins when it has been computed. A flight that waits for
    nodes that are too far behind, those of ``wait_for`` (names with commas), has a time of its own: it begins when
    simulated recordings do, so that its results are the same each time.
    """
    from ..bus.brake import Brake
    from ..bus.pacing import publish_paced
    from ..bus.status import StatusPublisher
    from .flight_settings import DEFAULT_EPOCH_NS, simulated_flight

    settings = dict(options.table)
    try:
        rate = float(settings.pop("rate", 1.0))
    except (TypeError, ValueError):
        raise UserError(f"simulation: rate is {options.table['rate']!r}, wanted a number") from None
    waited_for = str(settings.pop("wait_for", ""))
    flight = simulated_flight(settings)
    simulator = Simulator(flight.simulation, flight.imager)
    options.report(f"{len(simulator)} messages over {simulator.duration_s:.0f} s")
    with options.open_bus() as bus:
        bus.announce(simulator.name)
        epoch_ns = DEFAULT_EPOCH_NS if waited_for else time.time_ns() - BEFORE_NS
        status = StatusPublisher(bus, simulator.name)
        brake = Brake(bus, waited_for, options.stop, rate)
        publish_paced(bus, _telling(simulator, epoch_ns, status, brake), rate, options.stop, hold=brake.wait)
        options.stop.wait(0.5)  # what is still on its way
    return 0


def _telling(simulator: Simulator, epoch_ns: int, status: StatusPublisher, brake: Brake) -> Iterator[Message]:
    """The messages, with a status now and then."""
    stamp_ns, flown_ns, told_s = 0, 0, time.monotonic()
    for message in simulator.messages(epoch_ns):
        if status.due():
            state, now_s = "flying", time.monotonic()
            if brake.held_s:
                simulator.counters["ms waited for slow nodes"] = round(1e3 * brake.held_s)
                state += f" at {(stamp_ns - flown_ns) / convert.SECOND_NS / (now_s - told_s):.1f} x real time"
            status.publish(state, {}, simulator, 0.0, 0, stamp_ns)
            flown_ns, told_s = stamp_ns, now_s
        stamp_ns = message.stamp_ns
        yield message
    status.publish("landed", {}, simulator, 0.0, 0, stamp_ns)
