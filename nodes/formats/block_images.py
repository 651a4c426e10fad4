"""Image lines of the strips of a block folder, with the times that its strips have."""

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
from .block_messages import lines_of
from .grey_image import GreyImage
from .image_lines import ImageStrip, LinesGiven, open_image
from .scene_images import with_notes


def with_block_images(
    block: BlockData, messages: Iterable[Message], given: LinesGiven, notes: list[str]
) -> Iterator[Message]:
    """The messages of a block folder with the lines of its images among them, by stamp and rank.

    Parameters
    ----------
    messages : of the block; its strips tell the times
    given : one file a strip and CCD line, ``strip/ccd``, or ``ccd`` where there is one strip
    notes : gets remarks; all of them are there once the messages have been read

    Raises
    ------
    UserError : images that cannot be read or are not as large as their strip, strips or CCD lines that are not there
        or come twice
    """
    if given.times is not None or given.first is not None or given.strip:
        raise UserError("--lines of a block folder: strips.csv has times and names, wanted no --line-times, "
                        "--first-time, --strip")  # fmt: skip
    told = list(messages)
    begin = {m.body.id: m.body.first_line_time_ns for m in told if m.topic == "configuration/strip"}
    views: dict[str, dict[str, GreyImage]] = {}
    strips: dict[str, Strip] = {}
    for name, path, band in given.files:
        strip, ccd = _view(block, name)
        if ccd in views.get(strip.id, {}):
            raise UserError(f"--lines {name}={path}: CCD line {ccd} of strip {strip.id} has an image already")
        pixels, lines = block.camera.lines[block.camera.line_index[ccd]].pixels, lines_of(strip)
        image = open_image(path, given.raw, pixels)
        if (image.lines, image.samples) != (lines, pixels):
            raise UserError(
                f"{path}: {image.lines} lines of {image.samples} samples, wanted {lines} of {pixels} as strip "
                f"{strip.id} has"
            )
        views.setdefault(strip.id, {})[ccd] = GreyImage(image, image.weights(band or given.band), given.span)
        strips[strip.id] = strip
        notes += image.notes
    found = [_images(strip, views[id], begin[id]) for id, strip in strips.items()]
    lost = [strip.id for strip in block.strips if strip.id not in strips]
    if lost:
        notes.append(f"no images of the strips {', '.join(lost)}")
    blocks = (strip.blocks() for strip in found)
    merged = merge(told, *blocks, key=lambda m: (m.stamp_ns, rank(m.topic)))
    return with_notes(merged, found, notes)


def _images(strip: Strip, views: dict[str, GreyImage], begin_ns: int) -> ImageStrip:
    """The images of a strip; line times of their own are kept."""
    seconds = strip.time_of(np.arange(lines_of(strip), dtype=float))
    time_ns = begin_ns + np.rint((seconds - seconds[0]) * SECOND_NS).astype(np.int64)
    return ImageStrip(strip.id, views, time_ns, strip.line_rate_hz, strip.line_time_s is None, ())


def _view(block: BlockData, name: str) -> tuple[Strip, str]:
    """Strip and CCD line of a name; where there is one strip the CCD line is enough."""
    id, _, ccd = name.rpartition("/")
    if ccd not in block.camera.line_index:
        wanted = ", ".join(block.camera.line_index)
        raise UserError(f"--lines: {name!r}: CCD line {ccd!r} is not in camera.json, wanted STRIP/CCD with {wanted}")
    lens = block.camera.lines[block.camera.line_index[ccd]].lens
    able = [strip for strip in block.strips if strip.lens in (None, lens)]
    known = [strip for strip in able if id in (strip.id, strip.id.rpartition("/")[0])] if id else able
    if len(known) != 1:
        ids = ", ".join(strip.id for strip in block.strips)
        raise UserError(f"--lines: {name!r}: strip {id!r} is not one of {ids}, wanted STRIP/CCD=FILE for each image")
    return known[0], ccd
