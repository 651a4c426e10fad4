"""What a part of a scene is, and entities that grow without being drawn again and again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..convert import PoseSample
from ..node import Message
from .canvas import Canvas, Color
from .scene_state import SceneState

# One colour a meaning, in every view.
FILTERED = (150, 165, 190, 255)
LIVE = (255, 170, 40, 255)
FINAL = (70, 220, 120, 255)
WHOLE = (40, 150, 110, 255)
TRUTH = (255, 255, 255, 255)
CONTROL = (255, 80, 80, 255)
CHECK = (80, 190, 255, 255)
REJECTED = (255, 60, 230, 255)
AXES = ((255, 110, 110, 255), (120, 220, 120, 255), (120, 160, 255, 255))
LEGEND = (
    ("live", LIVE),
    ("final", FINAL),
    ("truth", TRUTH),
    ("tie, live", LIVE),
    ("tie, final", FINAL),
    ("control", CONTROL),
    ("check", CHECK),
    ("rejected ray", REJECTED),
)
# Nine, as MISR has. From the fifth on the colour-blind tell each from all others, too (CIELAB distance of 25 and more
# for normal, protan and deutan eyes), and from LIVE, REJECTED and the ground of the views (20).
CCD_COLORS = (
    (255, 140, 120, 255), (235, 225, 140, 255), (130, 170, 255, 255), (190, 140, 255, 255), (190, 250, 250, 255),
    (250, 250, 40, 255), (190, 70, 130, 255), (175, 40, 250, 255), (55, 130, 40, 255),
)  # fmt: skip


_GROUND = (18, 20, 26)


def ccd_color(number: int) -> Color:
    """The colour of a CCD line, by its number in the camera."""
    return CCD_COLORS[number % len(CCD_COLORS)]


def faded(color: Color, share: float) -> Color:
    """A colour of which only a share is left on the dark ground of the views."""
    r, g, b = (round(share * c + (1 - share) * ground) for c, ground in zip(color, _GROUND, strict=False))
    return r, g, b, 255


class Part:
    """A part of a scene: keeps what concerns it of each message, draws what has changed."""

    def __init__(self, state: SceneState) -> None:
        self.state = state

    def pose(self, topic: str, sample: PoseSample) -> None:
        """Take a pose."""

    def take(self, message: Message) -> None:
        """Take any other message."""

    def begin_again(self, canvas: Canvas) -> None:
        """Local coordinates are in another frame from now on: take away what is in the one before."""

    def draw(self, canvas: Canvas) -> None:
        """Draw what has changed."""


class Pieces:
    """Rows of an entity that grows, drawn in pieces of bounded size, so that only the newest piece is drawn again.

    Parameters
    ----------
    entity : pieces are ``entity/0``, ``entity/1``, ...
    size : rows of a piece
    joined : whether a piece begins with the last row of the one before (a line goes on)
    """

    def __init__(self, entity: str, size: int, joined: bool = False) -> None:
        self.entity, self.size, self.joined = entity, size, joined
        self._rows: list[list[Any]] = [[]]
        self._number = 0
        self._changed = False

    def add(self, row: Any) -> None:
        """Add a row."""
        if len(self._rows[-1]) >= self.size:
            self._rows.append(self._rows[-1][-1:] if self.joined else [])
        self._rows[-1].append(row)
        self._changed = True

    def cut(self) -> None:
        """Let the next row begin a piece that is not joined to this one."""
        if self._rows[-1]:
            self._rows.append([])

    def draw(self, draw: Callable[[str, list[Any]], None]) -> None:
        """Call ``draw(entity, rows)`` for pieces that have changed; full ones are then forgotten."""
        if not self._changed:
            return
        self._changed = False
        for i, rows in enumerate(self._rows):
            if rows:
                draw(f"{self.entity}/{self._number + i}", rows)
        self._number += len(self._rows) - 1
        self._rows = self._rows[-1:]
