"""Image lines as they come in, one view a CCD line, with the tie points and targets that are found in them.

The newest line is on top and everything moves down. Views are as high as the ground takes from the first look to the
last, so that all looks at a new tie point are in view, in one colour.
"""

from __future__ import annotations

import colorsys
from collections import deque
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from .. import convert
from ..node import Message
from .canvas import Canvas, Color
from .scene_part import CHECK, CONTROL, REJECTED, Part
from .scene_state import SceneState

Array = NDArray[np.floating]

_TILE_S = 0.5  # lines are drawn in tiles of so long
_SPARE = 1.15  # tiles are kept for so many heights of a view
_MARKED = 4000  # newest looks that are marked
_BRIGHT, _DARK, _GAMMA = 99.9, 0.2, 1.0  # percentiles that become white and black, and the exponent between


class LinesPart(Part):
    """Tiles of image lines that move, and marks on them."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._strip: dict[str, str] = {}  # of each CCD line: cameras that look at once make a strip each
        self._tiles: dict[str, _Tiles] = {}
        self._marks: dict[str, deque[tuple[float, float, Color]]] = {}
        self._targets: dict[str, dict[str, tuple[float, float, Color, str]]] = {}
        self._check: set[str] = set()
        self._changed = False

    def take(self, message: Message) -> None:
        topic, body = message.topic, message.body
        if topic.startswith("sensor/lines/"):
            self._take_lines(topic.rpartition("/")[2], body)
        elif topic == "observation/tie":
            color = _color(body.point)
            for image in body.images if len(body.images) > 1 else ():
                if image.strip == self._strip.get(image.ccd):
                    self._marks[image.ccd].append((image.line, image.sample, color))
                    self._changed = True
        elif topic == "observation/target":
            self._take_target(body)
        elif topic == "observation/control" and convert.role_of(body) == "check":
            self._check.add(body.point)

    def _take_lines(self, ccd: str, block: Any) -> None:
        if ccd not in self.state.ccds:
            return
        if block.strip != self._strip.get(ccd):
            self._strip[ccd] = block.strip
            self._tiles[ccd] = _Tiles(self.state.lines_reduced)
            self._marks[ccd] = deque(maxlen=_MARKED)
            self._targets[ccd] = {}
            self.state.has_lines = True
        strip = self.state.strips.get(block.strip)
        rate = strip.line_rate_hz if strip is not None and strip.line_rate_hz > 0 else 100.0
        self._tiles[ccd].add(int(block.first_line), block.pixels, max(round(_TILE_S * rate), 1))

    def _take_target(self, body: Any) -> None:
        image = body.image
        if image.strip != self._strip.get(image.ccd) or body.state == body.NOT_FOUND:
            return
        doubtful = body.state in (body.HELD, body.REJECTED)
        color = REJECTED if doubtful else CHECK if body.point in self._check else CONTROL
        control = body.point not in self._check
        label = f"{body.point}: {body.reason}" if doubtful else body.point if control else ""
        self._targets[image.ccd][body.point] = image.line, image.sample, color, label
        self._changed = True

    def draw(self, canvas: Canvas) -> None:
        _, height = self.state.lines_size
        reduced = self.state.lines_reduced
        moved = False
        for ccd, tiles in self._tiles.items():
            kept = int(_SPARE * height * reduced / max(tiles.size, 1)) + 2
            for number, first, grey in tiles.take():
                moved = True
                place = (0.0, -(first + len(grey) * reduced) / reduced)
                canvas.image(f"lines/{ccd}/strip/tile/{number % kept}", grey[::-1], place, float(number % kept) - kept)
            canvas.move(f"lines/{ccd}/strip", (0.0, tiles.newest / reduced))
        if not (moved or self._changed):
            return
        self._changed = False
        for ccd, tiles in self._tiles.items():
            oldest = tiles.newest - height * reduced
            rows = [row for row in self._marks[ccd] if row[0] > oldest]
            places = np.array([[s / reduced, -u / reduced] for u, s, _ in rows]).reshape(-1, 2)
            canvas.points(f"lines/{ccd}/strip/ties", places, [color for _, _, color in rows], 3.2)
            targets = [row for row in self._targets[ccd].values() if row[0] > oldest]
            places = np.array([[s / reduced, -u / reduced] for u, s, _, _ in targets]).reshape(-1, 2)
            named = np.array([bool(row[3]) for row in targets], dtype=bool)
            for kind, chosen in (("check", ~named), ("control", named)):
                some = [row for row, wanted in zip(targets, chosen, strict=True) if wanted]
                labels = [row[3] for row in some] if kind == "control" else None
                canvas.points(f"lines/{ccd}/strip/{kind}", places[chosen], [row[2] for row in some], 4.2, labels)


class _Tiles:
    """Reduces lines of one CCD to grey tiles of 8 bits.

    Attributes
    ----------
    newest : line after the last one that is in a tile
    size : lines of a tile
    """

    def __init__(self, reduced: int) -> None:
        self._reduced = reduced
        self._waiting: list[NDArray[Any]] = []
        self._first = 0
        self._range: tuple[float, float] | None = None
        self._done: list[tuple[int, int, NDArray[np.uint8]]] = []
        self.newest = 0
        self.size = 0

    def add(self, first_line: int, pixels: NDArray[Any], size: int) -> None:
        r = self._reduced
        self.size = self.size or -(-size // r) * r
        held = sum(len(block) for block in self._waiting)
        if not held or first_line != self._first + held:
            self._waiting, self._first, held = [], first_line, 0
        columns = pixels.shape[1] // r * r
        self._waiting.append(pixels[:, :columns].reshape(len(pixels), -1, r).mean(axis=2, dtype=np.float32))
        if held + len(pixels) < self.size:
            return
        rows = np.concatenate(self._waiting)
        n = len(rows) // r * r
        small = rows[:n].reshape(-1, r, rows.shape[1]).mean(axis=1)
        self._done.append((self._first // self.size, self._first, self._grey(small)))
        self._waiting, self._first = [rows[n:]] if len(rows) > n else [], self._first + n
        self.newest = self._first

    def take(self) -> list[tuple[int, int, NDArray[np.uint8]]]:
        """Tiles that are ready: number, first line, grey values."""
        done, self._done = self._done, []
        return done

    def _grey(self, values: Array) -> NDArray[np.uint8]:
        """Eight bits, with a range that follows the image slowly."""
        low, high = (float(v) for v in np.percentile(values[::2, ::2], (_DARK, _BRIGHT)))
        low *= 0.5
        if self._range is not None:
            low, high = (0.9 * old + 0.1 * new for old, new in zip(self._range, (low, high), strict=True))
        self._range = low, high
        share = np.clip((values - low) / max(high - low, 1.0), 0.0, 1.0)
        return np.rint(255 * share**_GAMMA).astype(np.uint8)


def _color(point: str) -> Color:
    """A vivid colour of its own for each point."""
    hue = crc32(point.encode()) % 997 / 997
    r, g, b = colorsys.hsv_to_rgb(hue, 0.75, 1.0)
    return round(255 * r), round(255 * g), round(255 * b), 255
