"""``triline simulate``: a flight recording with truth."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.geometry.measured_trajectory import POSE_GAP_S
from ...solver.simulation.ground_points import shortest_coverage_s
from ...solver.simulation.orbital_scene import ORBITAL_SENSORS
from ...solver.simulation.real_motion import RealMotion
from ...solver.simulation.scenario import Simulation
from .. import convert
from ..batch.relief import true_relief
from ..batch.simulated_scenes import SceneSimulation, simulated_recording, write_simulated_scenes
from ..errors import UserError, flag
from ..formats.geotiff import write_heights
from ..formats.json_text import json_text
from ..formats.new_file import new_file, refuse_unless_free
from ..recording.writer import COMPRESSIONS, RecordingWriter
from ..simulator.flight_settings import (
    DEFAULT_EPOCH,
    DEFAULT_EPOCH_NS,
    GRADES,
    OPTIONS,
    Option,
    SimulatedFlight,
    checked,
    shown_default,
    simulated_flight,
)
from ..simulator.simulator import BEFORE_NS, Simulator
from ..simulator.world_settings import HELP, world_terms
from .outputs import refuse_other_format
from .progress import progress

EXAMPLE = """triline simulate -o flight.mcap --sensor ads40 --strips 6 --cross 2 --seconds 60 --seed 1
  triline simulate -o flight.mcap --motion ang20170323t202244_eph_att --from 800 --seconds 300
  triline simulate -o flight.mcap --motion trajectory.csv --ground 310
  triline simulate -o flight.mcap --sensor ads40-small --images --seconds 60
  triline simulate -o flight.mcap --true sine=0.02@0.1 --true clock=5ms
  triline simulate -o pair --satellite spot5-hrs --seed 1
  triline simulate -o triplet.mcap --satellite alos-prism --seed 1"""

_GROUPS = {
    "general": "flight",
    "plan": "planned flight",
    "motion": "real motion",
    "imagery": "image lines",
    "observations": "observations",
    "errors": "errors of the trajectory, 1 sigma",
    "world": "errors that are not stated",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="recording to write, or folder")
    parser.add_argument("--epoch", metavar="UTC", help=f"when it begins (default {DEFAULT_EPOCH}, or as --motion says)")
    parser.add_argument("--compression", choices=sorted(COMPRESSIONS), help="of the recording (default none)")
    parser.add_argument("--dem", metavar="FILE", help="also write the true relief, a GeoTIFF in UTM, for `rectify`")
    satellite = parser.add_argument_group(
        "satellite scenes",
        "a block of scenes for `adjust` in place of a flight; of the other options --seed, --control, --check, "
        "--image-sigma, --control-sigma, --outliers and --images (of a recording) go with it",
    )
    satellite.add_argument(
        "--satellite", metavar="NAME", help=f"one of {', '.join(ORBITAL_SENSORS)}; -o is a new folder, or NAME.mcap"
    )
    satellite.add_argument(
        "--place",
        type=float,
        nargs=2,
        metavar=("LAT", "LON"),
        help="passed over (36 139.6, or where the orbit reaches)",
    )
    satellite.add_argument(
        "--overpasses", type=int, metavar="N", help="of the place, three days apart; several look aside at it (1)"
    )
    satellite.add_argument("--points", type=int, metavar="N", help="ground points in all (120)")
    about = {"world": f"messages and sigmas stay as the other options say; the flight has these as well: {HELP}"}
    groups = {name: parser.add_argument_group(title, about.get(name)) for name, title in _GROUPS.items()}
    for option in OPTIONS:
        _add(groups[option.group], option)


def _add(group: Any, option: Option) -> None:
    name = flag(option.name)
    if option.kind is bool:
        group.add_argument(name, action="store_true", default=None, help=option.text)
        return
    if option.count == 0:
        group.add_argument(name, action="append", metavar="KEY=VALUE", help=option.text)
        return
    shown = shown_default(option)
    text = f"{option.text} (default {shown})" if shown else option.text
    if option.name == "imu":
        group.add_argument(name, choices=sorted(GRADES), help=text)
    elif option.name == "control_sigma":
        group.add_argument(name, type=float, nargs="+", metavar="M", help=text)
    else:
        metavar = {int: "N", float: "X", str: "NAME"}[option.kind]
        group.add_argument(
            name, type=option.kind, nargs=None if option.count == 1 else option.count, metavar=metavar, help=text
        )


def run(args: argparse.Namespace) -> int:
    given = {option.name: getattr(args, option.name) for option in OPTIONS}
    if args.satellite is not None:
        return _simulate_scenes(args, given)
    if any(value is not None for value in (args.place, args.points, args.overpasses)):
        raise UserError("--place, --points and --overpasses go with --satellite")
    flight = simulated_flight({name: _single(value) for name, value in given.items() if value is not None})
    epoch_ns = _utc_ns(args.epoch) if args.epoch else flight.epoch_ns or DEFAULT_EPOCH_NS
    if args.dem is not None and Path(args.dem).resolve() == Path(args.output).resolve():
        raise UserError("-o, --dem: wanted different files")
    refuse_other_format(args.dem, "a GeoTIFF", ".tif", ".tiff")
    simulator = Simulator(flight.simulation, flight.imager)
    with (
        new_file(Path(args.output)) as part,
        RecordingWriter(part, args.compression or "none") as writer,
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
    if flight.motion is not None and given["seconds"] is not None:
        result["notes"] += _shorter(flight.motion, given["from"] or 0.0, given["seconds"])
    if args.json:
        print(json_text(result))
    elif not args.quiet:
        _print_summary(result)
    return 0


def _simulate_scenes(args: argparse.Namespace, given: dict[str, Any]) -> int:
    """A block of satellite scenes, as a folder or as a recording."""
    goes = {"seed", "control", "check", "image_sigma", "control_sigma", "outliers", "images"}
    other = [name for name, value in given.items() if value is not None and name not in goes]
    other += [name for name in ("epoch", "dem") if getattr(args, name) is not None]
    if other:
        raise UserError(f"{flag(other[0])} does not go with --satellite")
    checked({name: _single(value) for name, value in given.items() if value is not None})
    if args.place is not None and not (abs(args.place[0]) <= 90 and abs(args.place[1]) <= 360):
        raise UserError(f"--place {args.place[0]:g} {args.place[1]:g}: wanted latitude and longitude, degrees")
    if given["images"] and given["outliers"] is not None:
        raise UserError("--outliers does not go with --satellite and --images: no tie points are simulated then")
    output = Path(args.output)
    recording = output.suffix.lower() == ".mcap"
    if not recording:
        for name in ("images", "compression"):
            if getattr(args, name) is not None:
                raise UserError(f"{output}: --{name} goes with a recording, wanted a name that ends with .mcap")
        refuse_unless_free(output)
    keys = {"seed": "seed", "control": "control", "check": "check", "image_sigma": "image_sigma_px",
            "control_sigma": "control_sigma_m", "outliers": "outliers", "images": "images"}  # fmt: skip
    stated = {keys[name]: _single(given[name]) for name in goes if given[name] is not None}
    if isinstance(stated.get("control_sigma_m"), list):
        raise UserError("--control-sigma: wanted one number with --satellite")
    stated |= {} if args.place is None else {"lat_deg": args.place[0], "lon_deg": args.place[1]}
    stated |= {} if args.points is None else {"points": args.points}
    stated |= {} if args.overpasses is None else {"overpasses": args.overpasses}
    what = SceneSimulation(args.satellite, **stated)
    if recording:
        messages, result = simulated_recording(what)
        result |= {"folder": args.output}
        with new_file(output) as part, RecordingWriter(part, args.compression or "none") as writer:
            for message in messages:
                writer.write(message)
    else:
        result = write_simulated_scenes(output, what)
    if args.json:
        print(json_text(result))
    elif not args.quiet:
        print(f"{result['folder']}: {result['satellite']}, images {', '.join(result['images'])}, seed {result['seed']}")
        print(f"  {result['points']} points, {result['control']} control and {result['check']} check among them; "
              f"{result['image_points']} image points, {result['outliers']} of them gross errors")  # fmt: skip
    return 0


def _single(value: Any) -> Any:
    """Accept one number for X, Y and Z."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _utc_ns(text: str) -> int:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise UserError(f"--epoch {text!r}: wanted a time such as {DEFAULT_EPOCH}") from None
    if moment.tzinfo is None:
        raise UserError(f"--epoch {text!r} has no time zone: wanted a time such as {DEFAULT_EPOCH}")
    whole = moment.replace(microsecond=0)
    epoch_ns = int(whole.timestamp()) * convert.SECOND_NS + moment.microsecond * 1000
    if epoch_ns + BEFORE_NS < 0:  # what is known before the flight is stamped with that time
        raise UserError(f"--epoch {text!r}: begins before 1970, wanted UTC since then")
    if epoch_ns > convert.LATEST_S * convert.SECOND_NS:
        raise UserError(f"--epoch {text!r}: wanted a time before 2261")
    return epoch_ns


def _summary(flight: SimulatedFlight, seconds: float, output: str, seed: int, counts: dict[str, int]) -> dict[str, Any]:
    simulation, motion = flight.simulation, flight.motion
    images, strips = simulation.images, simulation.flight.strips
    times = simulation.flight.strip_times_s
    roles = Counter(simulation.points.role.tolist())
    result: dict[str, Any] = {
        "recording": output,
        "seed": seed,
        "seconds": seconds,
        "camera": simulation.flight.camera.name,
        "strips": {
            strip.id: {"seconds": round(float(t1 - t0), 3), "line_rate_hz": strip.line_rate_hz, "lines": strip.lines}
            for strip, (t0, t1) in zip(strips, times, strict=True)
        },
        "points": {role: roles[role] for role in ("tie", "control", "check")},
        "notes": _left_out(simulation, roles),
        "rays": len(images),
        "rays_per_s": len(images) / float(np.sum(times[:, 1] - times[:, 0])),
        "outliers": int(images.outlier.sum()),
        "messages": counts,
    }
    if not simulation.world.as_stated:
        result["true"] = world_terms(simulation.world)
    if motion is not None:
        result["motion"] = {"poses": len(motion.trajectory), "steps_taken_out": motion.jumps}
        result["notes"] += _gaps(motion.trajectory.time_s)
    return result


def _gap_s(time_s: np.ndarray) -> float:
    """Longer without poses is a gap of a recorded motion: longer than nodes take for one, and than ten of its steps."""
    return max(POSE_GAP_S, 10.0 * float(np.median(np.diff(time_s))))


def _gaps(time_s: np.ndarray) -> list[str]:
    """A line where the recorded motion has no poses for a while."""
    step = np.diff(time_s)
    gaps = step[step > _gap_s(time_s)]
    if not len(gaps):
        return []
    what = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    return [f"the recorded motion has {what}, of {gaps.max():.1f} s at most: its path is interpolated there"]


def _shorter(motion: RealMotion, from_s: float, wanted_s: float) -> list[str]:
    """A line where the part of a recorded motion that was asked for begins or ends with a gap, or reaches beyond it."""
    time_s = motion.trajectory.time_s
    first, last = motion.first_time_s, motion.first_time_s + float(time_s[-1])
    if max(first - from_s, from_s + wanted_s - last) <= _gap_s(time_s):
        return []
    return [
        f"the recorded motion has poses for {last - first:.1f} of the {wanted_s:g} s that were asked for, from "
        f"{first:.1f} to {last:.1f} s: it ends there, or has a gap"
    ]


def _left_out(simulation: Simulation, roles: Mapping[str, int]) -> list[str]:
    """A line where points that were asked for are not in the flight, since they are not seen often enough."""
    flight, plan = simulation.flight, simulation.observation_plan
    missing = [
        f"{wanted - roles[role]} of {wanted} {name}"
        for role, name, wanted in (("control", "control points", plan.control), ("check", "check points", plan.check))
        if roles[role] < wanted
    ]
    if plan.tie_points_per_s > 0 and not roles["tie"]:
        missing.append("all tie points")
    if not missing:
        return []
    if len(flight.camera.lines) == 1:
        why = "the camera has one CCD line, and sees a point once in a strip: wanted strips that overlap"
    else:
        needed = [shortest_coverage_s(flight, strip) for strip in flight.strips]
        lasting = [float(t1 - t0) for t0, t1 in flight.strip_times_s]
        short = [k for k in range(len(needed)) if lasting[k] < needed[k]]
        if not short:
            why = ""
        else:
            k = max(short, key=needed.__getitem__)
            why = (
                f"all CCD lines see the same ground where a strip lasts {needed[k]:.0f} s or longer, "
                f"and {flight.strips[k].id} lasts {lasting[k]:.0f} s"
            )
    told = f"left out {' and '.join(missing)}, which are not seen often enough (twice; control once)"
    return [f"{told}: {why}" if why else told]


def _print_summary(result: dict[str, Any]) -> None:
    points = result["points"]
    print(f"{result['recording']}: {result['seconds']:.0f} s, camera {result['camera']}, seed {result['seed']}")
    if "true" in result:
        print(f"  true world, not stated: {' '.join(result['true'])}")
    if "motion" in result:
        motion = result["motion"]
        print(f"  {motion['poses']} poses; {motion['steps_taken_out']} steps of the recorded position taken out")
    for id, strip in result["strips"].items():
        print(f"  strip {id}: {strip['seconds']:.0f} s, {strip['lines']} lines at {strip['line_rate_hz']:g} Hz")
    print(
        f"  {points['tie']} tie points, {points['control']} control, {points['check']} check; {result['rays']} rays "
        f"({result['rays_per_s']:.0f} a second of strip), {result['outliers']} of them blunders"
    )
    for note in result["notes"]:
        print(f"  note: {note}")
    print("  messages: " + ", ".join(f"{topic} {count}" for topic, count in result["messages"].items()))
