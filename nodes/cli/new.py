"""``triline new``: a flight folder, or a block of satellite scenes, to fill in."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path

from ..errors import UserError
from ..formats.flight_template import write_template
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_folder
from ..formats.satellite.read import read_scene
from ..formats.scene_block import write_scene_block

EXAMPLE = """triline new flight my_flight
  triline new scenes my_block DIM_PHR1A_1.XML DIM_PHR1A_2.XML"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what",
        choices=("flight", "scenes"),
        help="flight: a folder with a commented flight.toml; scenes: a block of satellite scenes for `adjust`",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="made where it is not there")
    parser.add_argument("metadata", type=Path, nargs="*", metavar="META", help="of the scenes, anything `locate` reads")


def run(args: argparse.Namespace) -> int:
    if args.what == "scenes":
        path = _new_scenes(args.folder, args.metadata)
        todo = "ground_points.csv and image_points.csv want their rows; `triline match` finds tie points in images"
    elif args.metadata:
        raise UserError(f"{args.metadata[0]}: metadata go with `triline new scenes`")
    else:
        command = f"triline check {shlex.quote(str(args.folder))}"
        path, todo = write_template(args.folder), f"fill it in; `{command}` says what is missing"
    if args.json:
        print(json_text({"file": str(path)}))
    elif not args.quiet:
        print(f"{path}: {todo}")
    return 0


def _new_scenes(folder: Path, metadata: list[Path]) -> Path:
    """A folder that names the scenes, with tables that have their header alone."""
    if not metadata:
        raise UserError("no metadata: wanted those of the scenes, `triline new scenes DIR META ..`")
    refuse_unless_folder(folder)
    path = folder / "project.toml"
    if path.exists():
        raise UserError(f"{path}: is there already")
    scenes: dict[str, dict[str, str]] = {}
    for file in metadata:
        read_scene(file)  # refuses what cannot be adjusted
        name, number = file.stem or file.name, 2
        while name in scenes:
            name, number = f"{file.stem}-{number}", number + 1
        scenes[name] = {"metadata": os.path.relpath(file.resolve(), folder.resolve())}
    write_scene_block(folder, folder.resolve().name, scenes)
    return path
