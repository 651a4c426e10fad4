"""``triline fly``: the live system on real sensors. What the flight consists of stands in its folder."""

from __future__ import annotations

import argparse
import shlex
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...schemas import codec
from ...schemas.envelope import RawMessage
from ..bus.ports import default_port, port_is_held
from ..bus.processes import NodeGroup
from ..convert import check_place
from ..errors import UserError
from ..formats.json_text import json_text
from ..last_problems import last_of
from ..monitor.sensor_watch import SensorWatch
from ..ordering import MAX_JUMP_NS
from ..terminal import plain
from .live_flight import DRAIN_S, ESTIMATORS, LiveFlight, add_view_arguments, seconds_between
from .refused import refused_inputs

if TYPE_CHECKING:
    from ..bus.session import Bus
    from ..formats.flight_folder import Flight
    from ..sensors.settings import SensorProgram

EXAMPLE = "triline fly my_flight --headless"

#: Configuration holds from so long after the newest sensor data on: all nodes take it at the same place, s.
AHEAD_NS = 1_000_000_000
#: Topics whose stamps tell how far platform time is; one of them must come in before the flight begins.
TIMED = ("sensor/gnss", "sensor/imu", "sensor/attitude")
#: Sensors whose clocks are so far apart are told, ns; for so long after the configuration it is looked at, s.
APART_NS, LOOKED_AT_S = 1_000_000_000, 10.0
#: Where sensors go on at the end: for so long the nodes may catch up, s.
CATCH_UP_S = 2.5
#: Who is on a port that is taken answers within so long; nodes of a flight that was killed have ended after so long, s.
MEET_S, ENDED_S = 2.0, 5.0
#: Counters of estimating nodes whose first case is told: of what sensors send.
_TOLD_OF_NODES = ("malformed", "attitude jump", "inertial noise")
SOURCE = "flight"
FILE = "flight.toml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", type=Path, metavar="DIR", help=f"flight folder (with {FILE})")
    add_view_arguments(parser)
    parser.add_argument("--no-viewer", action="store_true", help="neither window nor scene, as where nobody looks on")
    parser.add_argument("--no-report", action="store_true", help="do not evaluate the recording at the end")
    parser.add_argument(
        "--nodes", type=_nodes, default=ESTIMATORS, metavar="NAMES",
        help=f"comma-separated, of {', '.join(ESTIMATORS)} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=seconds_between(1.0, 1e6), metavar="N", help="end after so long (default: Ctrl-C)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder of results (default: DIR/live/ and the time)"
    )
    parser.add_argument("--port", type=int, metavar="N", help="meeting port of the bus (TRILINE_PORT or 17447)")
    parser.add_argument("--bus", type=Path, metavar="FILE", help="a Zenoh configuration file instead")


def run(args: argparse.Namespace) -> int:
    from ..formats.flight_folder import read_flight, refuse_problems
    from ..sensors.settings import read_sensors

    flight = read_flight(args.flight, live=True)
    programs = read_sensors(flight)
    refuse_problems(flight)
    if args.output is None:
        args.output = args.flight / "live" / datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    live = Fly(args, flight, programs)
    result = live.fly()
    if args.json:
        print(json_text(result))
    else:
        print(live.summary(result))
    for text in result["refused"]:
        print(f"triline fly: {args.flight}: {plain(text)}", file=sys.stderr)
    return 1 if "no_report" in result or result["refused"] else 0


class FirstData:
    """What is known of the sensors as the flight begins: how far time is, where the aircraft is, and their clocks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ahead_ns: dict[str, int] = {}  # last stamp of a topic minus the time at which it came
        self._last_ns: dict[str, int] = {}  # last stamps of `TIMED`
        self.place: tuple[float, float] | None = None

    def take(self, raw: RawMessage) -> None:
        """A message of a sensor; those of `TIMED` tell how far time is."""
        with self._lock:
            self._ahead_ns[raw.topic] = raw.envelope.stamp_ns - raw.receive_ns
        if raw.topic not in TIMED:
            return
        try:
            body: Any = codec.decode(raw.topic, raw.data)
            if raw.topic == "sensor/gnss":  # the origin of the local frame is to be where a flight can be
                check_place(body.latitude, body.longitude, body.altitude)
        except ValueError:
            return
        with self._lock:
            self._last_ns[raw.topic] = raw.envelope.stamp_ns
            if raw.topic == "sensor/gnss" and self.place is None:
                self.place = round(body.latitude, 6), round(body.longitude, 6)

    @property
    def newest_ns(self) -> int:
        """How far time is, by what came last on each topic; 0 before anything has.

        A clock far from that of GNSS does not count: nodes would wait for their configuration until its time has come.
        """
        with self._lock:
            gnss_ns = self._last_ns.get("sensor/gnss")
            near = [ns for ns in self._last_ns.values() if gnss_ns is None or abs(ns - gnss_ns) <= MAX_JUMP_NS]
        return max(near, default=0)

    def apart(self) -> dict[str, str]:
        """A line for each sensor that is stamped by another clock than GNSS is."""
        with self._lock:
            ahead = dict(self._ahead_ns)
        if "sensor/gnss" not in ahead:
            return {}
        off = {topic: ns - ahead["sensor/gnss"] for topic, ns in ahead.items()}
        return {
            topic: f"{topic} is stamped {ns * 1e-9:+.1f} s against sensor/gnss that came at the same time: "
            "are both in UTC? clock_offset_s sets one right"
            for topic, ns in sorted(off.items())
            if abs(ns) > APART_NS
        }


class Fly(LiveFlight):
    """A flight whose sensors are programs of the folder, or somebody else's.

    Parameters
    ----------
    args : of the command
    flight : the folder, without problems
    programs : that the folder names
    """

    sensors_go_on = True

    def __init__(self, args: argparse.Namespace, flight: Flight, programs: list[SensorProgram]) -> None:
        super().__init__(args, flight.platform, f"triline fly {flight.name}", args.nodes)
        if self.secure is not None and self.secure.name != flight.platform:
            named = f"is of aircraft {self.secure.name!r}, the flight of platform {flight.platform!r}"
            raise UserError(f"--secure {args.secure}: {named}")
        self.flight, self.programs = flight, {program.id: program for program in programs}
        self.first = FirstData()
        self._endings: list[Any] = []
        self._configured = False
        self._told: set[tuple[str, str]] = set()
        self._look_until_s = 0.0
        self._until_s = float("inf")
        lines = [] if flight.camera is None else [(f"sensor/lines/{line.id}",) for line in flight.camera.lines]
        self.watch = SensorWatch([("sensor/gnss",), ("sensor/imu", "sensor/attitude"), *lines])
        self._tell_phase()

    def port(self) -> int:
        port = self.args.port or (default_port() if self.secure is None else self.secure.port)
        if self.args.bus is None and port_is_held(port):
            self._refuse_flown(port)
        return port

    def _refuse_flown(self, port: int) -> None:
        """Raise UserError where nodes that this flight would start run on its platform, and go on running."""
        from ..bus.session import Bus

        own, begun = {"recorder", *self.estimators, *self.programs}, time.monotonic()
        with Bus(self.platform, source=SOURCE, port=port, secure=self.secure) as bus:
            while not (there := own & bus.alive()) and time.monotonic() < begun + MEET_S:
                time.sleep(0.1)
            while there and time.monotonic() < begun + ENDED_S:
                time.sleep(0.1)
                there = own & bus.alive()
        if there:
            one = "runs" if len(there) == 1 else "run"
            raise UserError(
                f"platform {self.platform!r} flies already: {', '.join(sorted(there))} {one} on port {port}, "
                f"wanted them stopped, another flight.platform in {FILE}, or another --port"
            )

    def clear(self) -> None:
        if any(self.folder.glob("flight*.mcap")):
            raise UserError(f"{self.folder}: holds a flight already, wanted another folder")
        super().clear()
        for note in self.flight.notes:
            self.say(f"note: {note}")

    def node_arguments(self, name: str) -> tuple[str, ...]:
        return ("--config", str(self.flight.folder / FILE))

    def ready_line(self) -> str:
        programs = ", ".join(self.programs) or "none of the folder"
        return f"waiting for sensors on triline/{self.platform}/sensor; programs: {programs}"

    def sensor_ids(self) -> tuple[str, ...]:
        return tuple(self.programs)

    def start_sensors(self, group: NodeGroup) -> None:
        for id in self.programs:
            self.start_sensor(group, id)
        if self.args.seconds:
            self._until_s = time.monotonic() + self.args.seconds

    def start_sensor(self, group: NodeGroup, id: str) -> None:
        program = self.programs[id]
        group.start(program.node, *program.arguments(), id=id)

    def over(self, group: NodeGroup) -> bool:
        return time.monotonic() >= self._until_s

    # ---- configuration

    def joined(self, bus: Bus) -> None:
        bus.prepare(("configuration/project", "configuration/camera", "configuration/strip", "observation/control"))
        self._endings = [bus.subscribe(topic, self.first.take) for topic in (*TIMED, "sensor/lines/*")]

    def tend(self, bus: Bus) -> None:
        self._tell_problems()
        if self._configured:
            self._tell_clocks()
            self._tell_far()
            return
        origin = self.flight.origin_deg or self.first.place
        if not self.first.newest_ns or origin is None:
            return
        from ..formats.flight_messages import live_configuration

        self._configured = True
        for message in live_configuration(self.flight, origin, self.first.newest_ns + AHEAD_NS, SOURCE):
            bus.publish(message)
        self._look_until_s = time.monotonic() + LOOKED_AT_S
        self._tell_phase()
        assert self.watch is not None
        self.watch.tell(f"configuration published, origin at {origin[0]:.4f}, {origin[1]:.4f} deg")

    def _tell_clocks(self) -> None:
        """For a while, show sensors whose clocks are apart; then this program hears no sensor any more."""
        assert self.watch is not None
        for topic, text in self.first.apart().items() if self._endings else ():
            if (topic, "clock") not in self._told:
                self._told.add((topic, "clock"))
                self.watch.tell(text)
        if time.monotonic() > self._look_until_s:
            for end in self._endings:
                end()
            self._endings = []

    def _tell_far(self) -> None:
        """Show an origin of the local frame at which this flight cannot be, once the first fix has come."""
        assert self.watch is not None
        origin, place = self.flight.origin_deg, self.first.place
        if origin is None or place is None or ("origin", "far") in self._told:
            return
        from ..formats.flight_folder import distance_m
        from ..formats.ground_points import FAR_M

        self._told.add(("origin", "far"))
        away = distance_m(np.array([origin]), np.array([place]))
        if away > FAR_M:
            what = "control" if self.flight.control is not None else "flight.origin_deg"
            self.watch.tell(
                f"the origin lies {1e-3 * away:.0f} km from the first GNSS fix ({place[0]:.4f}, {place[1]:.4f} deg), "
                f"wanted at most {1e-3 * FAR_M:.0f} km: see {what}, and flight.crs ({self.flight.crs})"
            )

    def _tell_problems(self) -> None:
        """Show what sensor programs refuse or lack, and what nodes hold against sensors, when it comes first."""
        assert self.watch is not None
        for id in (*self.programs, *self.estimators):
            status = self._overview.nodes.get(id)
            if status is None:
                continue
            for counter in status.counters:
                if (id in self.programs or counter.name in _TOLD_OF_NODES) and (id, counter.name) not in self._told:
                    self._told.add((id, counter.name))
                    self.watch.tell(f"{id}: {counter.name}: {last_of(status, counter)}")

    def _tell_phase(self) -> None:
        assert self.watch is not None
        for_origin = "GNSS, for the origin of the local frame" if self.flight.origin_deg is None else "sensor data"
        self.watch.phase = "" if self._configured else f"waiting for {for_origin}"

    # ---- the end

    def drain_s(self) -> float:
        assert self.watch is not None
        coming = any(row.state == "comes in" for row in self.watch.rows())
        return CATCH_UP_S if coming else DRAIN_S

    def _evaluate(self) -> dict[str, Any]:
        assert self.watch is not None
        rows = self.watch.rows()
        missing = self.watch.never
        if not any(row.received for row in rows):
            raise UserError(f"no sensor data came in on triline/{self.platform}; never seen: {', '.join(missing)}")
        result = super()._evaluate()
        refused = refused_inputs(self._overview.nodes, self.estimators, self._overview.earlier)
        sensors = {row.name: row.received for row in rows}
        return {**result, "sensors": sensors, "never_seen": missing, "refused": refused}

    def remarks(self, result: dict[str, Any]) -> list[str]:
        came = ", ".join(f"{name} {n}" for name, n in result["sensors"].items() if n)
        lines = [f"sensors: {came}"] if came else []
        return lines + [f"never seen: {name}" for name in result["never_seen"]]

    def settings_again(self) -> str:
        return f" --config {shlex.quote(str(self.flight.folder / FILE))}"


def _nodes(text: str) -> tuple[str, ...]:
    names = [name.strip() for name in text.split(",")]
    if not all(name in ESTIMATORS for name in names):
        raise argparse.ArgumentTypeError(f"{text!r}, wanted some of {','.join(ESTIMATORS)}")
    return tuple(name for name in ESTIMATORS if name in names)
