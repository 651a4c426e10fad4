"""The nodes by name; a node's module is loaded when the node is asked for."""

from __future__ import annotations

import importlib
from typing import Any

from .errors import UserError

#: name -> (module, class): nodes that turn messages into messages.
STEP_NODES: dict[str, tuple[str, str]] = {
    "navigator": ("navigator.navigator", "Navigator"),
    "matcher": ("matcher.matcher", "Matcher"),
    "adjuster": ("adjuster.adjuster", "Adjuster"),
    "rectifier": ("rectifier.rectifier", "Rectifier"),
}
#: name -> (module, function): programs on the bus with a life of their own, run as ``function(options)``.
PROGRAMS: dict[str, tuple[str, str]] = {
    "simulator": ("simulator.simulator", "run"),
    "recorder": ("recorder.recorder", "run"),
    "ground": ("recorder.ground", "run"),
    "router": ("router.router", "run"),
    "player": ("player.player", "run"),
    "monitor": ("monitor.monitor", "run"),
    "nmea": ("sensors.nmea", "run"),
    "lines": ("sensors.line_camera", "run"),
    "ros2": ("sensors.ros2", "run"),
    "stream": ("sensors.stream", "run"),
}
#: Programs among them that bring data of real sensors onto the bus.
SENSORS = ("nmea", "lines", "ros2", "stream")
#: name -> (module, class): nodes that only look on.
ONLOOKERS: dict[str, tuple[str, str]] = {
    "viewer": ("viewer.viewer", "Viewer"),
}
#: What `process` runs where nothing else is asked for.
ESTIMATING = ("navigator", "adjuster")


def names() -> list[str]:
    """All names, in the order of the flow."""
    return ["simulator", *SENSORS, *STEP_NODES, "recorder", "player", *ONLOOKERS, "monitor", "router", "ground"]


def node_class(name: str) -> Any:
    """The class of a node that is driven by messages; raises UserError for a name that is none."""
    found = STEP_NODES.get(name) or ONLOOKERS.get(name)
    if found is None:
        there_are = ", ".join((*STEP_NODES, *ONLOOKERS))
        raise UserError(f"no node {name!r} that is driven by messages, there are: {there_are}")
    return _load(*found, name)


def program(name: str) -> Any:
    """The function of a program; raises UserError for a name that is none."""
    if name not in PROGRAMS:
        raise UserError(f"no node {name!r}, there are: {', '.join(names())}")
    return _load(*PROGRAMS[name], name)


def _load(module: str, attribute: str, name: str) -> Any:
    try:
        return getattr(importlib.import_module(f".{module}", __package__), attribute)
    except ModuleNotFoundError as error:
        if not f"{__package__}.{module}.".startswith(f"{error.name}."):  # neither the module nor its folder
            raise
        raise UserError(f"node {name!r} is not part of this installation") from None
