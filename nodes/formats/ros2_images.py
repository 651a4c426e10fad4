"""Images of a ROS 2 bag as image lines: the rows of ``sensor_msgs/msg/Image`` follow one another, strip by strip."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ...schemas.topics import rank
from ...solver.camera.line_camera import LineCamera
from ..convert import SECOND_NS, STRIP_SILENT_S
from ..errors import UserError
from ..node import Message
from .image_lines import BLOCK_S, CLOSING_NS, off_the_rate, strip_name
from .ros2_decoding import decoded

IMAGE = "sensor_msgs/msg/Image"
#: Line rates of topics that differ by a larger share are not of one camera.
SAME_RATE = 0.01
_PIXELS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
#: Last words of topics that name no camera.
_PLAIN = ("image", "image_raw", "image_mono", "image_rect", "image_rect_raw", "raw", "mono", "data")


@dataclass(frozen=True)
class ImageTopics:
    """Which topics of a bag hold image lines, as the user says.

    Attributes
    ----------
    topics : CCD line -> topic; None where the user names none: all topics whose CCD line can be told
    camera : its CCD lines must be those of the topics, with as many pixels
    rate_hz : lines a second; None takes it from the stamps
    strip : id of the strip; of several, with the time at which each begins behind it
    """

    topics: Mapping[str, str] | None = None
    camera: LineCamera | None = None
    rate_hz: float | None = None
    strip: str = ""


ALL_IMAGES = ImageTopics()


@dataclass(frozen=True)
class _Strip:
    """A strip in a bag: which images of each CCD line belong to it, and the line that each begins with."""

    id: str
    first_ns: int
    rate_hz: float
    lines: int
    images: dict[str, dict[int, int]]

    def body(self, *, ended: bool) -> Any:
        return m.Strip(
            id=self.id, first_line_time_ns=self.first_ns, line_rate_hz=self.rate_hz, lines=self.lines, ended=ended
        )


def image_rows(
    payloads: Iterable[bytes | memoryview], left_out: Counter[str], live: bool = False
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Stamp in ns and rows (height, width), uint8 or uint16, of each Image in CDR that is grey and whole.

    ``left_out`` counts the others by what is wrong with them. Images are as wide as the first one.
    """
    wanted = 0
    for time_ns, image in decoded(payloads, IMAGE, left_out, live):
        kind = _PIXELS.get(image.encoding)
        if kind is None:
            left_out["images that are not grey"] += 1
            continue
        pixels = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
        size, wide = image.height * image.step, image.width * pixels.itemsize
        whole = size and wide and len(image.data) == size and image.step >= wide
        if not whole or image.width != (wanted or image.width):
            left_out["images of a wrong size"] += 1
            continue
        wanted = image.width
        rows = np.ascontiguousarray(image.data.reshape(image.height, image.step)[:, :wide]).view(pixels)
        yield time_ns, np.ascontiguousarray(rows, pixels.newbyteorder("="))


def lines_missing(time_ns: int, next_ns: int, period_ns: float, rows: int) -> int:
    """Lines between two images that never came; stamps may be off by half an image."""
    missing = round((time_ns - next_ns) / period_ns)
    return missing if missing > rows // 2 else 0


def ccd_lines(path: Path, counts: Mapping[str, int], given: ImageTopics, notes: list[str]) -> dict[str, str]:
    """CCD line -> topic, of the topics of a bag with images; notes what is not imported and why.

    Parameters
    ----------
    path : of the bag, for messages
    counts : topic -> number of images

    Raises
    ------
    UserError : a topic that the user names and the bag lacks, a CCD line that the camera lacks
    """
    own = None if given.camera is None else [line.id for line in given.camera.lines]
    if given.topics is not None:
        for ccd, topic in given.topics.items():
            if topic not in counts:
                there_are = ", ".join(counts) or "none"
                raise UserError(f"{path}: --lines {ccd}={topic}: no {IMAGE} of this topic, wanted one of: {there_are}")
            if own is not None and ccd not in own:
                raise UserError(f"{path}: CCD line {ccd!r} is not in the camera, wanted one of {', '.join(own)}")
        found = dict(given.topics)
    else:
        found = _told_by_names(list(counts), own)
    left = {topic: n for topic, n in counts.items() if topic not in found.values()}
    if left:
        wanted = f"--lines {own[0] if own else 'CCD'}={next(iter(left))} takes its rows as image lines"
        what = ", ".join(f"{n} {IMAGE} of {topic}" for topic, n in left.items())
        notes.append(f"{path.name}: not imported: {what}; {wanted}")
    return found


def _told_by_names(topics: list[str], own: list[str] | None) -> dict[str, str]:
    """CCD line -> topic where the names of the topics tell it; without a camera the topics name the CCD lines."""
    words = {topic: [word for word in topic.split("/") if word] for topic in topics}
    if own is None:
        short = {topic: next((w for w in reversed(words[topic]) if w not in _PLAIN), "N") for topic in topics}
        if len(set(short.values())) < len(short):
            short = {topic: "_".join(words[topic]) for topic in topics}
        return {re.sub(r"[^\w-]", "_", name): topic for topic, name in short.items()}
    if len(own) == 1 and len(topics) == 1:
        return {own[0]: topics[0]}
    lower = {topic: [word.lower() for word in words[topic]] for topic in topics}
    found = {ccd: [topic for topic in topics if ccd.lower() in lower[topic]] for ccd in own}
    return {ccd: named[0] for ccd, named in found.items() if len(named) == 1}


def image_messages(
    path: Path,
    payloads: Mapping[str, Callable[[], Iterable[bytes | memoryview]]],
    given: ImageTopics,
    notes: list[str],
    source: str,
) -> Iterator[Message]:
    """``configuration/strip`` and ``sensor/lines/*`` of a bag, by stamp and rank.

    The bag is gone through twice: rate, first line and length of a strip follow from the stamps of all its images. The
    CCD lines share the numbers of lines, which go on over lines that are missing between images.

    Parameters
    ----------
    path : of the bag, for messages
    payloads : CCD line -> function that gives its images in CDR, from the first one on

    Raises
    ------
    UserError : of topics that the user names: images of another width than the CCD line has pixels, rates that differ
        or cannot be told; otherwise such topics are noted and left out
    """
    try:
        seen = _seen(path, payloads, given, notes)
        strips = _strips(path, seen, _rate(path, seen, given.rate_hz), given, notes) if seen else []
    except UserError as error:
        if given.topics is not None:
            raise
        notes.append(f"images not imported: {error}")
        return
    yield from merge(
        *(_announcements(strips, source), *(_blocks(ccd, payloads[ccd](), strips, source) for ccd in seen)),
        key=lambda message: (message.stamp_ns, rank(message.topic)),
    )


def _seen(
    path: Path, payloads: Mapping[str, Callable[[], Iterable[bytes | memoryview]]], given: ImageTopics, notes: list[str]
) -> dict[str, list[tuple[int, int]]]:
    """CCD line -> stamp and rows of each of its images."""
    seen: dict[str, list[tuple[int, int]]] = {}
    for ccd, read in payloads.items():
        left_out: Counter[str] = Counter()
        seen[ccd] = []
        for time_ns, rows in image_rows(read(), left_out):
            if given.camera is not None and not seen[ccd]:
                pixels = given.camera.lines[given.camera.line_index[ccd]].pixels
                if rows.shape[1] != pixels:
                    wanted = f"wanted {pixels} as CCD line {ccd} of the camera has pixels"
                    raise UserError(f"{path}: images of {ccd}: {rows.shape[1]} samples, {wanted}")
            seen[ccd].append((time_ns, len(rows)))
        if left_out:
            notes.append(f"{path.name}: {ccd}: {', '.join(f'{n} {why}' for why, n in sorted(left_out.items()))}")
    return {ccd: images for ccd, images in seen.items() if images}


def _rate(path: Path, seen: dict[str, list[tuple[int, int]]], stated: float | None) -> float:
    """Lines a second, of all CCD lines."""
    if stated is not None:
        return stated
    rates = {}
    for ccd, images in seen.items():
        times, rows = np.array(images, dtype=np.int64).T
        if len(times) > 1:
            rates[ccd] = 1.0 / float(np.median(np.diff(times) / rows[:-1])) * SECOND_NS
    if not rates:
        raise UserError(f"{path}: one image, which does not tell the line rate, wanted --line-rate")
    low, high = min(rates, key=rates.__getitem__), max(rates, key=rates.__getitem__)
    if rates[high] > (1 + SAME_RATE) * rates[low]:
        what = f"{low} has {rates[low]:.4g} rows a second, {high} {rates[high]:.4g}"
        raise UserError(f"{path}: {what}; wanted one line rate of all CCD lines (--lines chooses topics)")
    return float(np.median(list(rates.values())))


def _strips(
    path: Path, seen: dict[str, list[tuple[int, int]]], rate_hz: float, given: ImageTopics, notes: list[str]
) -> list[_Strip]:
    period = SECOND_NS / rate_hz
    begins = sorted((time, time + round(rows * period)) for images in seen.values() for time, rows in images)
    starts, until = [], -np.inf
    for begin, end in begins:
        if begin - until > STRIP_SILENT_S * SECOND_NS:
            starts.append(begin)
        until = max(until, end)
    strips, missing = [], 0
    for start, end in zip(starts, [*starts[1:], np.inf], strict=True):
        name = given.strip or path.stem if len(starts) == 1 else given.strip + strip_name(start)
        images: dict[str, dict[int, int]] = {ccd: {} for ccd in seen}
        stamps, numbers, lines = [], [], 0
        for ccd in seen:
            line, next_ns = 0, -1
            for time_ns, rows in seen[ccd]:
                if not start <= time_ns < end:
                    continue
                if next_ns < 0:
                    line = round((time_ns - start) / period)
                else:
                    gap = lines_missing(time_ns, next_ns, period, rows)
                    line, missing = line + gap, missing + gap
                images[ccd][time_ns] = line
                stamps.append(time_ns - start)
                numbers.append(line)
                line, next_ns = line + rows, time_ns + round(rows * period)
            lines = max(lines, line)
        first, rate = _fitted(np.array(stamps, dtype=float), np.array(numbers, dtype=float), rate_hz, given.rate_hz)
        off = np.abs((np.array(stamps) - first) * (rate / SECOND_NS) - numbers).max()
        notes.extend(off_the_rate(float(off), rate, "strip and tie points take the constant rate"))
        strips.append(_Strip(name, start + round(first), rate, lines, images))
    if missing:
        notes.append(f"{path.name}: {missing} image lines are missing between images")
    return strips


def _fitted(stamps: NDArray[Any], numbers: NDArray[Any], nominal: float, stated: float | None) -> tuple[float, float]:
    """Time of line 0 (ns after the strip's start) and rate (Hz) that the stamps of numbered lines tell together."""
    if stated is None and np.ptp(numbers) > 0:
        period, first = np.polyfit(numbers, stamps, 1)
        return float(first), float(SECOND_NS / period)
    return float(np.median(stamps - numbers * (SECOND_NS / nominal))), nominal


def _announcements(strips: list[_Strip], source: str) -> Iterator[Message]:
    for strip in strips:
        begin = min(min(images) for images in strip.images.values() if images)
        begin = min(begin, strip.first_ns)
        yield Message("configuration/strip", begin, strip.body(ended=False), source)
        end = strip.first_ns + round((strip.lines - 1) * SECOND_NS / strip.rate_hz) + CLOSING_NS
        yield Message("configuration/strip", end, strip.body(ended=True), source)


def _blocks(ccd: str, payloads: Iterable[bytes | memoryview], strips: list[_Strip], source: str) -> Iterator[Message]:
    """Blocks of a CCD line, of `BLOCK_S` at most; stamped when their last line has been imaged."""
    todo = iter(strips)
    strip = next(todo)
    for time_ns, rows in image_rows(payloads, Counter()):
        while time_ns not in strip.images[ccd]:
            strip = next(todo)
        line, period = strip.images[ccd][time_ns], SECOND_NS / strip.rate_hz
        size = max(round(BLOCK_S * strip.rate_hz), 1)
        for first in range(0, len(rows), size):
            part = rows[first : first + size]
            begin = time_ns + round(first * period)
            block = LineBlock(part, ccd, strip.id, line + first, begin, round(period))
            yield Message(f"sensor/lines/{ccd}", int(block.times_ns()[-1]), block, source)
