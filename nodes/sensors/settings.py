"""The ``[[sensor]]`` tables of a flight folder: which programs they start, with what settings."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

from .. import registry
from ..errors import UserError
from ..formats.flight_folder import FILE, Flight
from ..formats.keys import Keys
from .line_camera import LineCameraSettings
from .nmea import NmeaSettings
from .ros2 import Ros2Settings
from .stream import StreamSettings

#: `kind` of a sensor -> the node that reads it, and its settings.
KINDS: dict[str, Any] = {
    "nmea": NmeaSettings,
    "lines": LineCameraSettings,
    "ros2": Ros2Settings,
    "stream": StreamSettings,
}


#: Addresses that two programs cannot read at once: each would have a part of what comes, or none.
ALONE = ("serial:", "udp:", "listen:")


@dataclass(frozen=True)
class SensorProgram:
    """A program that a flight starts.

    Attributes
    ----------
    id : of the sensor: its name on the bus and of its log
    node : name in the registry
    settings : its table
    """

    id: str
    node: str
    settings: dict[str, Any]

    def arguments(self) -> list[str]:
        """Of ``triline node``."""
        return [word for key, value in self.settings.items() for word in ("--set", f"{key}={_toml(value)}")]


def read_sensors(flight: Flight) -> list[SensorProgram]:
    """The programs that a flight folder names; what is wrong with a table goes to the problems of the flight.

    ROS topics of images in several tables, which make strips of their own, are noted, and cameras that make strips at
    the same time.
    """
    programs: list[SensorProgram] = []
    for keys in flight.sensors:
        program = flight.attempt(lambda keys=keys: _program(flight, keys))
        if program is None:
            continue
        if program.id in [other.id for other in programs]:
            flight.problems.append(str(keys.refuse("id", "another name for each sensor")))
        address = str(program.settings.get("address", ""))
        if address.startswith(ALONE) and address in [other.settings.get("address") for other in programs]:
            flight.problems.append(str(keys.refuse("address", "another one for each sensor: one program reads a port")))
        programs.append(program)
    cameras = [program.id for program in programs if program.node == "ros2" and program.settings.get("images")]
    if len(cameras) > 1:
        flight.notes.append(
            f"{FILE}: [[sensor]] {', '.join(cameras)}: image topics in {len(cameras)} tables make separate strips; "
            "those of one camera belong in one table"
        )
    lines = [program for program in programs if program.node == "lines"]
    if len({(program.settings.get("strip"), program.settings.get("line_rate_hz")) for program in lines}) > 1:
        flight.notes.append(
            f"{FILE}: [[sensor]] {', '.join(program.id for program in lines)}: strips or line rates of their own: of "
            "strips that are imaged at the same time the matcher ties the one that began first"
        )
    return programs


def _program(flight: Flight, keys: Keys) -> SensorProgram:
    kind = keys.text("kind")
    if kind not in KINDS:
        raise keys.refuse("kind", f"one of {', '.join(KINDS)}")
    id = keys.text("id", kind)
    if not id.replace("-", "").replace("_", "").isalnum():
        raise keys.refuse("id", "a word of letters, digits, _ and -")
    if id in registry.names() and id not in registry.SENSORS:
        raise keys.refuse("id", "another name, for a node of triline has this one")
    settings = KINDS[kind].read(keys, flight.folder)
    check = getattr(settings, "check_camera", None)
    if check is not None and flight.camera is not None:
        check(keys, flight.camera)
    values = {key: value for key, value in keys.values.items() if key not in ("id", "kind")}
    if kind in ("stream", "ros2"):
        values["imu_noise"] = [flight.grade.gyro_noise, flight.grade.accel_noise]
    return SensorProgram(id, kind, {"id": id, **values, **settings.in_full()})


def _toml(value: Any) -> str:
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, str | bool | int | float):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(entry) for entry in value) + "]"
    raise UserError(f"{value!r}: wanted a text, a number or a list")
