"""Recordings that hold one flight: as it was recorded, and what nodes made of it, or a copy."""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ...schemas.envelope import Envelope
from .ranges import counts_at_end
from .reader import RecordingReader


def beginning_alike(paths: Iterable[Path], wanted: Sequence[str]) -> Iterator[tuple[Path, Path, str]]:
    """Recordings that begin with the same messages as an earlier one: the two, and each topic on which they do.

    Messages are the same by source, number and bytes, since simulated flights begin at one time.

    Parameters
    ----------
    wanted : topics, as in the topic table, of which the first message of each channel is looked at

    Raises
    ------
    UserError : a recording that cannot be read
    """
    begins: dict[tuple[str, Envelope, bytes], Path] = {}
    for path in paths:
        reader = RecordingReader(path)
        chosen = reader.select(wanted)
        _, first = np.unique(reader.channel_of[chosen], return_index=True)
        for raw in reader.raws(chosen[first]):
            other = begins.setdefault((raw.topic, raw.envelope, bytes(raw.data)), path)
            if other != path:
                yield path, other, raw.topic


def measured(path: Path) -> dict[str, int]:
    """How many messages a recording has on each topic of sensors, or where it has none, of tie points.

    It is asked of the end of the file, and takes no time; a file that does not say it has none.
    """
    try:
        with open(path, "rb") as file:
            counts = counts_at_end(memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))
    except (OSError, ValueError):  # an empty file cannot be mapped
        return {}
    for kind in ("sensor/", "observation/tie"):
        if found := {topic: n for topic, n in sorted(counts.items()) if topic.startswith(kind) and n}:
            return found
    return {}
