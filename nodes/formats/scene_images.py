"""Images of satellite scenes as the image lines of their strips, with the times and poses that the scenes have."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import numpy as np

from ...schemas.topics import rank
from ...solver.adjustment.block_data import BlockData
from ...solver.adjustment.network import Strip
from ..convert import SECOND_NS
from ..errors import UserError
from ..node import Message
from .grey_image import GreyImage
from .image_lines import ImageStrip, LinesGiven, open_image
from .scene_block import SceneBlockData

#: Images that a note spells out.
_MOST_NAMED = 6


@dataclass(frozen=True)
class NamedImage:
    """The image of a strip that project.toml names, for `triline match`.

    Attributes
    ----------
    path : of the file
    band : as project.toml writes it, "" for none
    first_pixel : column and row of the scene with which the image begins
    """

    path: Path
    band: str
    first_pixel: tuple[int, int]


def images_of_scenes(folder: Path, data: SceneBlockData, block: BlockData) -> dict[str, NamedImage]:
    """Strip of a block from `local_block` -> its image, where project.toml names one."""
    return {
        strip.id: NamedImage(folder / entry.image, entry.scene.band, entry.scene.first_pixel or (0, 0))
        for entry, strip in zip(data.images, block.strips, strict=True)
        if entry.image
    }


def left_out(images: Mapping[str, NamedImage]) -> list[str]:
    """What is said where nobody asks for image lines of a block whose scenes name their images."""
    whole = {id: image for id, image in images.items() if image.first_pixel == (0, 0)}
    notes = []
    if whole:
        of_scene = Counter(id.rpartition("/")[0] for id in images)
        names = {id: scene if of_scene[scene := id.rpartition("/")[0]] == 1 else id for id in whole}
        named = [f"{names[id]}={image.path}" for id, image in whole.items()]
        more = ",.." if len(named) > _MOST_NAMED else ""
        asked = shlex.quote(",".join(named[:_MOST_NAMED])) + more
        notes.append(f"images of the scenes are not in the recording: --lines {asked} makes image lines of them")
    notes += [
        f"{image.path}: a part of scene {id} (first_pixel), of which no image lines can be made"
        for id, image in images.items()
        if id not in whole
    ]
    return notes


def with_scene_images(
    block: BlockData, messages: Iterable[Message], given: LinesGiven, named: Mapping[str, NamedImage], notes: list[str]
) -> Iterator[Message]:
    """The messages of a block of scenes with the lines of their images among them, by stamp and rank.

    Parameters
    ----------
    block : from `local_block`
    messages : of the block
    given : one file a scene, ``scene`` or ``scene/lens``; the scenes tell the times
    named : images that project.toml names; where one of them is given, its band is taken if no other one is
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
        image, own = open_image(path, given.raw, pixels), named.get(strip.id)
        if own is not None and not (own.path.exists() and own.path.samefile(path)):
            own = None
        if own is not None and own.first_pixel != (0, 0):
            raise UserError(f"{path}: a part of scene {strip.id} (first_pixel), wanted an image of all its lines")
        if (image.lines, image.samples) != (strip.lines, pixels):
            raise UserError(
                f"{path}: {image.lines} lines of {image.samples} samples, wanted {strip.lines} of {pixels} as scene "
                f"{strip.id} has"
            )
        period_ns = SECOND_NS / strip.line_rate_hz
        time_ns = begin[strip.id] + np.rint(np.arange(strip.lines) * period_ns).astype(np.int64)
        band = band or given.band or (own.band if own is not None else None) or None
        views = {strip.lens: GreyImage(image, image.weights(band), given.span)}
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
