"""What the sensor programs have in common: id, clock, and the loop that publishes what they read."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from threading import Event
from typing import TYPE_CHECKING

from ..bus.status import StatusPublisher
from ..convert import CENTURY_S, SECOND_NS, state_noise
from ..errors import UserError
from ..formats.keys import Keys
from ..node import Message, Node

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions
    from ..bus.session import Bus

#: Keys that each sensor table may have.
COMMON = ("id", "kind", "clock_offset_s", "delay_s")
#: So long a program that may have been started again waits for the recorder, which knows, s.
RECORDER_S = 2.0
#: Where a program waits for data it looks this often whether it shall end, s.
LOOK_S = 0.1


@dataclass(frozen=True)
class Clock:
    """Times of a sensor.

    Attributes
    ----------
    offset_ns : its stamps minus UTC, ns; a clock that is ahead has a positive one
    delay_ns : its messages are stamped so long after the measurement, ns: as long as they are on their way, so that
        they come in their turn
    """

    offset_ns: int = 0
    delay_ns: int = 0

    @classmethod
    def of(cls, keys: Keys) -> Clock:
        """By ``clock_offset_s`` and ``delay_s``.

        Raises
        ------
        UserError : not numbers, an offset of more than 100 years, a delay that is negative or above 5 s
        """
        offset_s, delay_s = keys.number("clock_offset_s", 0.0), keys.number("delay_s", 0.0)
        if not abs(offset_s) <= CENTURY_S:
            raise keys.refuse("clock_offset_s", "100 years at most")
        if not 0.0 <= delay_s <= 5.0:
            raise keys.refuse("delay_s", "0 to 5 seconds")
        return cls(round(offset_s * SECOND_NS), round(delay_s * SECOND_NS))

    def utc(self, time_ns: int) -> int:
        """UTC of what the sensor's clock says."""
        return time_ns - self.offset_ns

    def stamp(self, utc_ns: int) -> int:
        """Stamp of a message measured at a time."""
        return utc_ns + self.delay_ns


class Sensor(Node):
    """A source of messages.

    Parameters
    ----------
    id : name on the bus

    Attributes
    ----------
    from_begin : whether it reads its files from their begin, so that it says all once more when it is started again
    """

    inputs = ()

    def __init__(self, id: str) -> None:
        super().__init__()
        self.name = id  # pyrefly: ignore[read-only]  # several of one class
        self.published = 0
        self.from_begin = False
        #: White noise of the inertial unit, rad/sqrt(s) and m/s/sqrt(s), for samples that do not state theirs.
        self.noise: tuple[float, float] | None = None

    def messages(self, stop: Event) -> Iterator[Message | None]:
        """What it measures, as it comes; None, at least every `LOOK_S`, where there is nothing."""
        raise TypeError(f"{type(self).__name__} does not define messages")

    def state(self) -> str:
        """How much has come and was refused; the counters tell why."""
        refused = sum(self.counters.values()) - self.counters["said before"]
        return f"{self.published} messages" + (f", {refused} refused" if refused else "")


def noise_of(keys: Keys) -> tuple[float, float] | None:
    """White noise of the inertial unit of the flight, rad/sqrt(s) and m/s/sqrt(s), which `triline fly` hands on."""
    if not keys.has("imu_noise"):
        return None
    gyro, accel = keys.numbers("imu_noise", 2, positive=True)
    return gyro, accel


def refuse_unknown(keys: Keys, known: tuple[str, ...]) -> None:
    """Raise UserError for a key of a sensor table that is not known."""
    for key in keys.values:
        if key not in (*COMMON, *known):
            raise UserError(f"{keys.path}: {keys.name(key)}: not known, wanted {', '.join((*COMMON, *known))}")


def publish(options: ProgramOptions, sensor: Sensor) -> int:
    """Publish what a sensor measures until told to stop; each kind of problem is told when it comes first.

    What the recorder has heard of the run before this one is not said again.
    """
    told: set[str] = set()
    options = replace(options, name=sensor.name)
    stamp_ns = 0
    with options.open_bus() as bus:
        bus.prepare(sensor.outputs)
        bus.announce(sensor.name)
        status = StatusPublisher(bus, sensor.name)
        status.publish("starting", {}, sensor, 0.0, 0, 0)
        said_ns = _said_ns(bus, options.stop, sensor.name) if sensor.from_begin else 0
        for message in sensor.messages(options.stop):
            if message is not None and message.stamp_ns <= said_ns:
                until = datetime.fromtimestamp(said_ns // SECOND_NS, UTC)
                sensor.problem("said before", f"what was published up to {until:%H:%M:%S} UTC is not said again")
            elif message is not None:
                if message.topic == "sensor/imu":
                    state_noise(message.body, sensor.noise)
                bus.publish(message)
                sensor.published += 1
                stamp_ns = message.stamp_ns
            for kind in sensor.counters.keys() - told:
                told.add(kind)
                options.report(": ".join(filter(None, (sensor.name, kind, sensor.last_problems.get(kind)))))
            if status.due():
                status.publish(sensor.state(), {}, sensor, 0.0, 0, stamp_ns)
        status.publish(sensor.state(), {}, sensor, 0.0, 0, stamp_ns)
        options.stop.wait(0.3)  # what is still on its way
    kinds = "".join(f", {n} {kind}" for kind, n in sorted(sensor.counters.items()))
    options.report(f"{sensor.name} stopped: {sensor.published} messages{kinds}")
    return 0


def _said_ns(bus: Bus, stop: Event, name: str) -> int:
    """How far the recorder has heard a program of this name; 0 where it has not, or there is none."""
    until_s = time.monotonic() + RECORDER_S
    while "recorder" not in bus.alive() and time.monotonic() < until_s and not stop.wait(LOOK_S):
        pass
    return max((body.time_ns for body in bus.query("heard", "observation/progress", source=name)), default=0)
