"""``triline simulate``: a flight recording with truth."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from .. import convert
from ..errors import UserError
from ..flight_settings import GRADES, OPTIONS, Option, SimulatedFlight, shown_default, simulated_flight
from ..formats.geotiff import write_heights
from ..formats.new_file import new_file
from ..recording import COMPRESSIONS, RecordingWriter
from ..rectification import true_relief
from ..simulator import Simulator
from .progress import progress

EXAMPLE = """triline simulate -o flight.mcap --sensor ads40 --strips 6 --cross 2 --seconds 60 --seed 1
  triline simulate -o flight.mcap --motion ang20170323t202244_eph_att --from 800 --seconds 300
  triline simulate -o flight.mcap --sensor ads40-small --images --seconds 60"""

DEFAULT_EPOCH = "2026-05-01T10:00:00Z"
_GROUPS = {
    "general": "flight",
    "plan": "planned flight",
    "motion": "real motion",
    "imagery": "image lines",
    "observations": "observations",
    "errors": "errors of the trajectory, 1 sigma",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="recording to write")
    parser.add_argument("--epoch", metavar="UTC", help=f"when it begins (default {DEFAULT_EPOCH}, or as --motion says)")
    parser.add_argument("--compression", choices=sorted(COMPRESSIONS), default="none", help="of the recording")
    parser.add_argument("--dem", metavar="FILE", help="also write the true relief, a GeoTIFF in UTM, for `rectify`")
    groups = {name: parser.add_argument_group(title) for name, title in _GROUPS.items()}
    for option in OPTIONS:
        _add(groups[option.group], option)


def _add(group: Any, option: Option) -> None:
    flag = "--" + option.name.replace("_", "-")
    if option.kind is bool:
        group.add_argument(flag, action="store_true", default=None, help=option.text)
        return
    shown = shown_default(option)
    text = f"{option.text} (default {shown})" if shown else option.text
    if option.name == "imu":
        group.add_argument(flag, choices=sorted(GRADES), help=text)
    elif option.name == "control_sigma":
        group.add_argument(flag, type=float, nargs="+", metavar="M", help=text)
    else:
        metavar = {int: "N", float: "X", str: "NAME"}[option.kind]
        group.add_argument(
            flag, type=option.kind, nargs=None if option.count == 1 else option.count, metavar=metavar, help=text
        )


def run(args: argparse.Namespace) -> int:
    given = {option.name: getattr(args, option.name) for option in OPTIONS}
    flight = simulated_flight({name: _single(value) for name, value in given.items() if value is not None})
    epoch_ns = _utc_ns(args.epoch) if args.epoch else flight.epoch_ns or _utc_ns(DEFAULT_EPOCH)
    simulator = Simulator(flight.simulation, flight.imager)
    with (
        new_file(Path(args.output)) as part,
        RecordingWriter(part, args.compression) as writer,
        progress("writing", quiet=args.quiet or args.json) as tell,
    ):
        for i, message in enumerate(simulator.messages(epoch_ns)):
            writer.write(message)
            if tell is not None and i % 1000 == 0:
                tell(i / len(simulator))
        counts = dict(sorted(writer.counts.items()))
    if args.dem is not None:
        write_heights(Path(args.dem), true_relief(flight.simulation.flight))
    result = _summary(flight, simulator.duration_s, args.output, 1 if given["seed"] is None else given["seed"], counts)
    if args.json:
        print(json.dumps(result, indent=2))
    elif not args.quiet:
        _print_summary(result)
    return 0


def _single(value: Any) -> Any:
    """One number for X, Y and Z may stand alone."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _utc_ns(text: str) -> int:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise UserError(f"--epoch {text!r}: wanted a time such as {DEFAULT_EPOCH}") from None
    if moment.tzinfo is None:
        raise UserError(f"--epoch {text!r} has no time zone: wanted a time such as {DEFAULT_EPOCH}")
    whole = moment.replace(microsecond=0)
    return int(whole.timestamp()) * convert.SECOND_NS + moment.microsecond * 1000


def _summary(flight: SimulatedFlight, seconds: float, output: str, seed: int, counts: dict[str, int]) -> dict[str, Any]:
    simulation, motion = flight.simulation, flight.motion
    images, strips = simulation.images, simulation.flight.strips
    times = simulation.flight.strip_times_s
    roles = Counter(simulation.points.role.tolist())
    result = {
        "recording": output,
        "seed": seed,
        "seconds": seconds,
        "camera": simulation.flight.camera.name,
        "strips": {
            strip.id: {"seconds": round(float(t1 - t0), 3), "line_rate_hz": strip.line_rate_hz, "lines": strip.lines}
            for strip, (t0, t1) in zip(strips, times, strict=True)
        },
        "points": {role: roles[role] for role in ("tie", "control", "check")},
        "rays": len(images),
        "rays_per_s": len(images) / float(np.sum(times[:, 1] - times[:, 0])),
        "outliers": int(images.outlier.sum()),
        "messages": counts,
    }
    if motion is not None:
        result["motion"] = {"poses": len(motion.trajectory), "steps_taken_out": motion.jumps}
    return result


def _print_summary(result: dict[str, Any]) -> None:
    points = result["points"]
    print(f"{result['recording']}: {result['seconds']:.0f} s, camera {result['camera']}, seed {result['seed']}")
    if "motion" in result:
        motion = result["motion"]
        print(f"  {motion['poses']} poses; {motion['steps_taken_out']} steps of the recorded position taken out")
    for id, strip in result["strips"].items():
        print(f"  strip {id}: {strip['seconds']:.0f} s, {strip['lines']} lines at {strip['line_rate_hz']:g} Hz")
    print(
        f"  {points['tie']} tie points, {points['control']} control, {points['check']} check; {result['rays']} rays "
        f"({result['rays_per_s']:.0f} a second of strip), {result['outliers']} of them blunders"
    )
    print("  messages: " + ", ".join(f"{topic} {count}" for topic, count in result["messages"].items()))
