"""``triline check``: whether a recording is whole, and what a folder lacks."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from ..bus.authority import CERTIFICATE
from ..errors import UserError
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..recording.reader import RecordingReader
from ..recording.remote import RemotePath, path_of
from ..recording.seal import verify
from ..recording.seal_place import seal_of
from ..recording.summary import findings
from .damage import look_again

EXAMPLE = """triline check flight.mcap
  triline check flight.mcap --authority survey      # signed in the name of one of its bundles, and not altered"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording",
        type=path_of,
        metavar="RECORDING_OR_FOLDER",
        help="flight.mcap, or its URL, a folder with flight.toml, or a block folder",
    )
    parser.add_argument(
        "--authority", type=Path, metavar="FOLDER", help="of `triline keys`: who signed must be certified by it"
    )


def run(args: argparse.Namespace) -> int:
    if args.recording.is_dir():
        return _check_folder(args)
    refuse_importable(args.recording)
    if isinstance(args.recording, RemotePath) and args.authority is not None:
        raise UserError(
            f"{args.recording}: seals of recordings elsewhere are not looked at, wanted a file for --authority"
        )
    reader = RecordingReader(args.recording)
    look_again(reader)
    found = findings(reader)
    authority = args.authority / CERTIFICATE if args.authority and args.authority.is_dir() else args.authority
    seal = None if reader.remote is not None else verify(args.recording, authority)
    if seal is None and authority is not None:
        raise UserError(f"{args.recording}: not signed, {seal_of(args.recording).name} is not there")
    if seal is not None:
        found = [*(f"not as {seal.signer!r} signed it: {line}" for line in seal.altered), *found]
    if args.json:
        signed = None if seal is None else asdict(seal)
        said = {
            "file": str(args.recording), "whole": not found, "messages": len(reader.index), "chunks": reader.n_chunks,
            "findings": found, "signed": signed,
        }  # fmt: skip
        print(json_text(said))
        return 1 if found else 0
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 and not args.verbose else ""
        if args.verbose:
            print("\n".join(found))
        raise UserError(f"{args.recording}: {found[0]}{more}")
    if not args.quiet:
        said = "" if seal is None else f"; {seal}, nothing was altered"
        print(f"{args.recording}: whole, {len(reader.index)} messages in {reader.n_chunks} chunks{said}")
    return 0


def _check_folder(args: argparse.Namespace) -> int:
    """Print what a folder lacks, a line each; 1 where something does."""
    if args.authority is not None:
        raise UserError("--authority goes with a recording")
    # the readers of everything that a flight can hold, which the check of a recording does not need
    from ..formats.block_folder import is_block_folder
    from ..formats.flight_folder import FILE, read_flight
    from ..formats.scene_block import is_scene_block
    from ..sensors.settings import read_sensors

    is_flight = (args.recording / FILE).is_file()
    if not is_flight and (is_scene_block(args.recording) or is_block_folder(args.recording)):
        return _check_block(args)
    flight = read_flight(args.recording)
    programs = read_sensors(flight)
    problems, notes = flight.problems, [*flight.notes, *(note for strip in flight.strips for note in strip.notes)]
    if args.json:
        held = {
            "strips": len(flight.strips), "ground_height_m": None if problems else flight.ground_height_m,
            "sensors": {program.id: program.node for program in programs},
        }  # fmt: skip
        _print_folder(args.recording, problems, notes, held)
        return 1 if problems else 0
    for problem in problems:
        print(f"  missing or wrong: {problem}")
    if not args.quiet:
        for note in notes:
            print(f"  note: {note}")
    if problems:
        raise UserError(f"{args.recording}: {len(problems)} to be mended before the flight can be imported")
    if not args.quiet and programs:
        names = ", ".join(f"{program.id} ({program.node})" for program in programs)
        print(f"{args.recording}: `triline fly` starts the sensors {names}")
    if not args.quiet:
        images = "no images"
        if flight.strips:
            images = f"{len(flight.strips)} strip{'s' * (len(flight.strips) > 1)} with images"
        elif flight.kind == "ros2":
            images = "image lines as in the bag"
        print(f"{args.recording}: complete; {images}, ground at {flight.ground_height_m:g} m above the ellipsoid")
    return 0


def _print_folder(folder: Path, problems: Sequence[str], notes: Iterable[str], held: Mapping[str, object]) -> None:
    """Print what is said of a folder as JSON."""
    said = {"folder": str(folder), "complete": not problems, **held, "problems": problems, "notes": list(notes)}
    print(json_text(said))


def _check_block(args: argparse.Namespace) -> int:
    """Print what is in a block folder, and remarks; the first value that cannot be read is told as by `adjust`."""
    from ..formats.block_folder import read_block
    from ..formats.scene_block import is_scene_block, read_scene_block

    folder = args.recording
    try:
        if is_scene_block(folder):
            scenes = read_scene_block(folder)
            n, what, rays, ground, notes = len(scenes.images), "image", scenes.rays, scenes.ground, scenes.notes
        else:
            block = read_block(folder)
            n, what, rays, ground, notes = len(block.strips), "strip", block.image, block.ground, block.notes
    except UserError as error:
        if not args.json:
            raise
        _print_folder(folder, [str(error)], [], {})
        return 1
    if args.json:
        held = {f"{what}s": n, "image_points": len(rays), "ground_points": len(ground)}
        _print_folder(folder, [], notes, held)
        return 0
    if not args.quiet:
        for note in notes:
            print(f"  note: {note}")
        print(
            f"{folder}: complete; {n} {what}{'s' * (n != 1)}, {len(rays)} image points, {len(ground)} ground points; "
            f"`triline adjust {shlex.quote(str(folder))}` adjusts them"
        )
    return 0
