"""``triline demo``: a simulated flight, triangulated while it is flown: a live flight whose sensor is the simulator."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ..bus.ports import port_is_held
from ..bus.processes import NodeGroup
from ..errors import UserError
from ..formats.json_text import json_text
from .live_flight import ESTIMATORS, LiveFlight, add_view_arguments, seconds_between

EXAMPLE = "triline demo --headless --seconds 60 --seed 7"

PLATFORM = "demo"
ESTIMATORS_OF_TIES = ("navigator", "adjuster")
#: Those that leave work out where they cannot keep up.
WITH_PACE = ("matcher", "adjuster")
#: The flight with image lines: 3 x 1500 pixels, 200 times a second.
IMAGERY = {"images": "true", "sensor": '"ads40-inner"', "height": "1690", "speed": "140", "relief": "50"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_view_arguments(parser)
    parser.add_argument(
        "--no-images", action="store_true", help="no image lines: tie points are simulated, not matched"
    )
    parser.add_argument(
        "--real-time",
        action="store_true",
        help="the flight waits for nobody: nodes that cannot keep up leave work out, as in a real flight",
    )
    parser.add_argument(
        "--seconds",
        type=seconds_between(10.0, 7200.0),
        default=60.0,
        metavar="N",
        help="length of the strip (default 60)",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the simulated flight (default 1)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/demo"), metavar="DIR", help="folder of results (out/demo)"
    )
    parser.add_argument("--port", type=int, metavar="N", help="meeting port of the bus (default: a free one)")


def run(args: argparse.Namespace) -> int:
    demo = Demo(args)
    result = demo.fly()
    if args.json:
        print(json_text(for_programs(result)))
    else:
        print(demo.summary(result))
    return 1 if "no_report" in result else 0


def for_programs(result: dict[str, Any]) -> dict[str, Any]:
    """The result with the few figures at the top level that programs read: ``ties`` (tie points published), ``rays``,
    and ``improvement`` (X, Y, Z) of object points; what else is better stands in ``improvement_in_full``."""
    out = dict(result)
    if "recording" in result:
        out |= {"ties": result["recording"]["tie_points"], "rays": result["recording"]["rays"]}
    better = out.pop("improvement", {})
    if "points" in better:
        out["improvement"] = better["points"]
    return out | ({"improvement_in_full": better} if better else {})


class Demo(LiveFlight):
    """A flight that the simulator flies."""

    def __init__(self, args: argparse.Namespace):
        estimators = ESTIMATORS_OF_TIES if args.no_images else ESTIMATORS
        super().__init__(args, PLATFORM, f"triline demo, seed {args.seed}", estimators)
        self.platform = PLATFORM if self.secure is None else self.secure.name

    def port(self) -> int:
        port = super().port()
        if port_is_held(port):
            raise UserError(f"--port {port}: another program listens there, choose another or leave it out")
        return port

    def clear(self) -> None:
        """Move the recording of the last demo to ``before`` and delete its logs and scene; other files stay."""
        self.folder.mkdir(parents=True, exist_ok=True)
        before, earlier = self.folder / "before", sorted(self.folder.glob("flight*.mcap"))
        for old in [*(before.glob("flight*.mcap") if earlier else ()), *self.folder.glob("log/*.log"),
                    self.folder / "flight.rrd"]:  # fmt: skip
            old.unlink(missing_ok=True)
        for recording in earlier:
            before.mkdir(exist_ok=True)
            recording.replace(before / recording.name)
        if earlier:
            self.say(f"the flight before is kept in {before}")

    def node_arguments(self, name: str) -> tuple[str, ...]:
        """Settings of a node: where the flight waits for it, it leaves nothing out."""
        return ("--set", 'pace="normal"') if name in WITH_PACE and not self.args.real_time else ()

    def start_sensors(self, group: NodeGroup) -> None:
        group.start("simulator", *self._flight())

    def sensor_ids(self) -> tuple[str, ...]:
        return ("simulator",)

    def over(self, group: NodeGroup) -> bool:
        return not group.processes["simulator"].running

    def landed(self, group: NodeGroup) -> None:
        simulator = group.processes["simulator"]
        if simulator.process.returncode and not self.stop.is_set():
            raise UserError(f"the simulator failed: {simulator.last_line()} (see {simulator.log_path})")

    def _flight(self) -> list[str]:
        """Settings of the simulator."""
        settings = {"seed": self.args.seed, "seconds": self.args.seconds}
        if not self.args.no_images:
            settings |= IMAGERY
        if not self.args.real_time:
            settings["wait_for"] = json.dumps(",".join(self.estimators))
        return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]

    def _evaluate(self) -> dict[str, Any]:
        return {**super()._evaluate(), "images": not self.args.no_images, "waited_s": self._waited_s()}

    def _waited_s(self) -> float:
        """For how long the flight had to wait for nodes that were behind."""
        status = self._overview.nodes.get("simulator")
        counted = {} if status is None else {c.name: c.value for c in status.counters}
        return counted.get("ms waited for slow nodes", 0) / 1e3

    def remarks(self, result: dict[str, Any]) -> list[str]:
        if not result["waited_s"]:
            return []
        return [f"the flight waited {result['waited_s']:.1f} s for nodes that were behind (not with --real-time)"]
