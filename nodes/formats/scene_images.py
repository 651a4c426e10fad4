"""Images of satellite scenes as the image lines of their strips, with the times and poses that the scenes have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from heapq import merge

import numpy as np

from ...schemas.topics import rank
from ...solver.adjustment.block_data import BlockData
from ...solver.adjustment.network import Strip
from ..convert import SECOND_NS
from ..errors import UserError
from ..node import Message
from .grey_image import GreyImage
from .image_lines import ImageStrip, LinesGiven, open_image


def with_scene_images(
    block: BlockData, messages: Iterable[Message], given: LinesGiven, notes: list[str]
) -> Iterator[Message]:
    """The messages of a block of scenes with the lines of their images among them, by stamp and rank.

    Parameters
    ----------
    block : from `local_block`
    messages : of the block
    given : one file a scene, ``scene`` or ``scene/lens``; the scenes tell the times
    notes : gets remarks; all of them are there once the messages have been read

    Raises
    ------
    UserError : images that cannot be read or are not as large as their scene, scenes that are not there or come twice
    """
    if given.times is not None or given.first is not None or given.strip:
        raise UserError("--lines of scenes: their metadata have times and names, wanted no --line-times, --first-time, "
                        "--strip")  # fmt: skip
    told = list(messages)
    begin = {m.body.id: m.body.first_line_time_ns for m in told if m.topic == "configuration/strip"}
    found: dict[str, ImageStrip] = {}
    for name, path, band in given.files:
        strip = _strip(block, name)
        if strip.id in found:
            raise UserError(f"--lines {name}={path}: scene {strip.id} has an image already")
        assert strip.lens is not None
        pixels = block.camera.lines[block.camera.line_index[strip.lens]].pixels
        image = open_image(path, given.raw, pixels)
        if (image.lines, image.samples) != (strip.lines, pixels):
            raise UserError(
                f"{path}: {image.lines} lines of {image.samples} samples, wanted {strip.lines} of {pixels} as scene "
                f"{strip.id} has"
            )
        period_ns = SECOND_NS / strip.line_rate_hz
        time_ns = begin[strip.id] + np.rint(np.arange(strip.lines) * period_ns).astype(np.int64)
        views = {strip.lens: GreyImage(image, image.weights(band or given.band), given.span)}
        found[strip.id] = ImageStrip(strip.id, views, time_ns, strip.line_rate_hz, True, tuple(image.notes))
    notes += [note for strip in found.values() for note in strip.notes]
    lost = [strip.id for strip in block.strips if strip.id not in found]
    if lost:
        notes.append(f"no image of the scenes {', '.join(lost)}")
    merged = merge(told, *(strip.blocks() for strip in found.values()), key=lambda m: (m.stamp_ns, rank(m.topic)))
    return with_notes(merged, found.values(), notes)


def with_notes(messages: Iterable[Message], strips: Iterable[ImageStrip], notes: list[str]) -> Iterator[Message]:
    """The messages; then notes get what was done to values that did not fit."""
    yield from messages
    notes += [note for strip in strips for image in strip.views.values() for note in image.notes()]


def _strip(block: BlockData, name: str) -> Strip:
    """The strip of a scene; of a scene with one line of detectors its name is enough."""
    known = [strip for strip in block.strips if name in (strip.id, strip.id.rpartition("/")[0])]
    if not name and len(block.strips) == 1:
        known = list(block.strips)
    if len(known) != 1:
        ids = ", ".join(strip.id for strip in block.strips)
        raise UserError(f"--lines: scene {name!r} is not one of {ids}, wanted SCENE=FILE for each")
    return known[0]
