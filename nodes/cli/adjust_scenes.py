"""``triline adjust`` of a block of satellite scenes."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.refraction import Refraction
from ..batch.adjustment_result import RESULT
from ..batch.adjustment_summary import Content
from ..batch.scene_adjustment import (
    SCENE_CALIBRATIONS,
    SCENE_MODELS,
    TABLES,
    SceneAdjustment,
    SceneJob,
    run_scene_job,
    scene_result,
    write_scene_tables,
)
from ..batch.two_steps import OWNERS, UNUSED
from ..errors import UserError
from ..formats.json_text import json_text
from ..formats.new_file import new_file, new_files
from ..formats.scene_block import SceneBlockData, read_scene_block
from .location_options import refraction_of

#: More unknowns of correction functions a lens than this want more memory than they are worth.
MOST_PIECES = 60


def run_scenes(args: argparse.Namespace) -> Content:
    """Adjust a folder and write the result; its content."""
    data = read_scene_block(Path(args.input))
    if args.refraction is not None:
        data = _in_air(data, refraction_of(args.refraction, data.ellipsoid, str(args.input)))
    if data.then and args.then is None:
        data = replace(data, notes=(*data.notes, UNUSED))
    adjustment = run_scene_job(data, scene_job(args))
    content = scene_result(adjustment)
    if args.output:
        content["notes"] += write_scene_result(adjustment, content, Path(args.output))
    return content


def _in_air(data: SceneBlockData, refraction: Refraction) -> SceneBlockData:
    """The block with rigorous models that bend their rays.

    Raises
    ------
    UserError : no image has a rigorous model
    """
    rigorous = [image for image in data.images if isinstance(image.location, PushbroomSensor)]
    if not rigorous:
        raise UserError(f"{data.name}: --refraction goes with rigorous models, and no image of the block has one")
    images = tuple(
        replace(image, location=image.location.with_refraction(refraction))
        if isinstance(image.location, PushbroomSensor)
        else image
        for image in data.images
    )
    return replace(data, images=images, notes=(*data.notes, f"refraction in the models of {len(rigorous)} images"))


def scene_job(args: argparse.Namespace) -> SceneJob:
    """The job that the options ask for.

    Raises
    ------
    UserError : an option that does not go with satellite scenes
    """
    for option, given in (
        ("--robust", args.robust), ("--reweight", args.reweight), ("--variance-components", args.variance_components),
        ("--plots", args.plots), ("--dem", args.dem),
    ):  # fmt: skip
        if given:
            raise UserError(f"{option} does not go with a block of satellite scenes")
    for model in (args.model, args.then):
        if model is not None and model not in SCENE_MODELS:
            raise UserError(f"model {model}: does not go with satellite scenes, wanted {', '.join(SCENE_MODELS)}")
    if args.selfcal not in SCENE_CALIBRATIONS:
        wanted = ", ".join(SCENE_CALIBRATIONS)
        raise UserError(f"--selfcal {args.selfcal}: does not go with satellite scenes, wanted {wanted}")
    model = args.model or "dgr"
    given = {option: getattr(args, option) for option in OWNERS}
    for option in ("segments", "fixes"):
        value = given[option]
        if value is not None and not 1 <= value <= MOST_PIECES:
            raise UserError(f"--{option} {value}, wanted 1 to {MOST_PIECES}")
    return SceneJob(
        model, args.then, given, args.selfcal, args.free, args.sets or "lens", args.snoop, args.critical,
        args.iterations or SceneJob.iterations,
    )  # fmt: skip


def write_scene_result(adjustment: SceneAdjustment, content: dict[str, object], folder: Path) -> list[str]:
    """Write the tables, ``rpc/`` and, last, ``result.json``; returns notes.

    An earlier result stays until all is written.
    """
    with new_files(folder, RESULT, (*TABLES, "rpc/*.RPB")) as new:
        notes = write_scene_tables(adjustment, new)
        with_notes = content | {"notes": [*_texts(content["notes"]), *notes]}
        with new_file(new / RESULT) as part:
            part.write_text(json_text(with_notes) + "\n")
    return notes


def _texts(notes: object) -> list[str]:
    return [str(note) for note in notes] if isinstance(notes, list) else []
