"""Residual vectors in image space, one view a CCD line."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np

from ..node import Message
from .canvas import Canvas
from .scene_part import REJECTED, Part, ccd_color, faded
from .scene_state import SceneState, round_number

_NEWEST = 1500  # rays a view shows
_PERIOD_S = 1.0  # all of them are drawn again
_LENGTH_S = 60.0  # of a strip whose end is not known
_BAR = 0.05  # of the view's width is the scale bar,
_TELLING, _BAR_RMS = 240, 3.0  # which is 1 px, or less: about so many times the residuals, once there are so many
_SETTLED = 0.5  # of the colour is left of the residuals of final points
_GREY = (110, 110, 120, 255)


class ImagePart(Part):
    """Rays of the newest strip of each CCD line: samples to the right, lines upwards, vectors enlarged as the scale bar
    says. Points may have looks in several strips, and each scene of a satellite is a strip of one CCD line."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._rays: dict[str, OrderedDict[tuple[str, int], Any]] = {}
        self._strip: dict[str, str] = {}  # of each CCD line
        self._changed: set[str] = set()
        self._drawn_s = 0.0
        self._framed: dict[str, tuple[str, int, float]] = {}
        self._drawn_bar_px = state.bar_px
        self._sized = False
        self._squares: list[float] = []

    def take(self, message: Message) -> None:
        if message.topic != "point/object":
            return
        settled = message.body.status != message.body.LIVE
        for r in message.body.residuals:
            if r.ccd not in self.state.ccds or self._is_earlier(r.strip, self._strip.get(r.ccd)):
                continue
            if r.strip != self._strip.get(r.ccd):
                self._strip[r.ccd] = r.strip
                self._rays[r.ccd] = OrderedDict()
            rays = self._rays[r.ccd]
            self._size(r)
            rays[message.body.point, round(r.line)] = r.line, r.sample, r.v_line, r.v_sample, r.rejected, settled
            if len(rays) > _NEWEST:
                rays.popitem(last=False)
            self._changed.add(r.ccd)

    def _is_earlier(self, strip: str, shown: str | None) -> bool:
        """Whether a strip began before the one that is shown."""
        if shown is None or strip == shown:
            return False
        begun = [self.state.strips[id].first_line_time_ns for id in (strip, shown) if id in self.state.strips]
        return len(begun) == 2 and begun[0] < begun[1]

    def _size(self, residual: Any) -> None:
        """Decide how long the scale bar is, by the first residuals."""
        if self._sized or residual.rejected:
            return
        self._squares.append(residual.v_line**2 + residual.v_sample**2)
        if len(self._squares) >= _TELLING:
            self._sized = True
            self.state.bar_px = min(round_number(_BAR_RMS * float(np.sqrt(np.mean(self._squares)))), 1.0)
            self._squares.clear()

    def draw(self, canvas: Canvas) -> None:
        due = self.state.closing or self.state.now_s - self._drawn_s >= _PERIOD_S
        if self._drawn_bar_px != self.state.bar_px:
            self._changed.update(self._rays)
        shown = (ccd for ccd in self._changed if ccd in self.state.ccds)
        changed = sorted(ccd for ccd in shown if self._strip[ccd] in self.state.strips)
        if not changed or not due:
            return
        self._drawn_bar_px = self.state.bar_px
        self._drawn_s = self.state.now_s
        width, height = self.state.image_size
        bar = _BAR * width
        scale = bar / self.state.bar_px
        for ccd in changed:
            lines = self._lines(self._strip[ccd])
            along = height / lines
            framed = self._strip[ccd], round(lines), self.state.bar_px
            if self._framed.get(ccd) != framed:
                self._framed[ccd] = framed
                self._frame(canvas, ccd, bar)
            rows = np.array([row for row in self._rays[ccd].values()], dtype=float).reshape(-1, 6)
            origin = np.column_stack([rows[:, 1], height - rows[:, 0] * along])
            vector = scale * np.column_stack([rows[:, 3], -rows[:, 2]])
            bad = rows[:, 4] > 0
            length = np.linalg.norm(vector, axis=1)
            longest = 2 * bar  # a rejected ray may be far off; its arrow shows where to
            vector[bad] *= np.minimum(1.0, longest / np.maximum(length[bad], 1e-9))[:, None]
            color = ccd_color(self.state.ccds.index(ccd))
            shades = [faded(color, _SETTLED) if settled else color for settled in rows[:, 5] > 0]
            for name, chosen in (("residuals", ~bad), ("rejected", bad)):
                own = [REJECTED if bad[i] else shades[i] for i in np.flatnonzero(chosen)]
                canvas.arrows(f"image/{ccd}/{name}", origin[chosen], vector[chosen], own, 0.9)
        self._changed.difference_update(changed)

    def _lines(self, strip: str) -> float:
        """Lines of a strip that a view has room for: as planned, or more once there are more; the same in all views."""
        told = self.state.strips[strip]
        lines = max(float(told.lines or _LENGTH_S * told.line_rate_hz), 1.0)
        own = (rays for ccd, rays in self._rays.items() if self._strip[ccd] == strip)
        newest = max((line for rays in own for line, *_ in rays.values()), default=0.0)
        while newest > lines:
            lines *= 2
        return lines

    def _frame(self, canvas: Canvas, ccd: str, length: float) -> None:
        """Outline of the strip and a scale bar."""
        width, height = self.state.image_size
        box = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]])
        canvas.lines(f"image/{ccd}/frame", [box], [_GREY], 0.7)
        bar = np.array([[-0.015 * width - length, 0.9 * height]])
        canvas.arrows(f"image/{ccd}/scale", bar, np.array([[length, 0.0]]), [(255, 255, 255, 255)], 1.2)
