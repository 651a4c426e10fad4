"""The window at work: which part of the strip is live, marginal or whole, how far off it can be, and the light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..convert import SECOND_NS, PoseSample
from ..node import Message
from .canvas import Canvas, Color
from .scene_part import FINAL, LIVE, WHOLE, Part
from .scene_state import SceneState

Array = NDArray[np.floating]

_STEP_NS = int(0.4 * SECOND_NS)
_PERIOD_S = 0.4
_LIGHTS: dict[str, Color] = {"good": (70, 220, 120, 255), "weak": (255, 190, 40, 255), "failed": (255, 60, 60, 255)}
_WRAP = 84  # characters of a reason
_ASIDE = 0.18  # of the swath's width: names stand so far beside it, on the viewer's side

_Row = tuple[int, Array, Array, Array]  # time, place, left and right end of the swath


class _Swath:
    """What a strip images on the ground, as far as it has been flown."""

    def __init__(self, state: SceneState, strip: str) -> None:
        self.strip = strip
        self._state = state
        self._poses: list[PoseSample] = []
        self._rows: list[_Row] = []
        self._of: set[str] = set()  # CCD lines that rows are of, see `SceneState.ground_of`
        self._drawn: set[str] | None = None

    def add(self, sample: PoseSample) -> bool:
        """Keep a pose that is far enough from the one before; whether it was."""
        if self._poses and sample.time_ns - self._poses[-1].time_ns < _STEP_NS:
            return False
        self._poses.append(sample)
        self._rows += self._on_ground([sample])
        return True

    @property
    def rows(self) -> list[_Row]:
        """Along the strip; all of them anew where it turns out that other CCD lines image it."""
        told = self._state.imaged_by.get(self.strip, set())
        if told != self._of:
            self._of, self._rows = set(told), self._on_ground(self._poses)
        return self._rows

    def is_new(self) -> bool:
        """Whether rows are others than those that were drawn."""
        drawn, self._drawn = self._drawn, set(self._state.imaged_by.get(self.strip, set()))
        return drawn != self._drawn

    def _on_ground(self, samples: list[PoseSample]) -> list[_Row]:
        rows = []
        for sample in samples:
            ends = self._state.ground_of(self.strip, sample.position_l, sample.quaternion)
            if ends is not None:
                rows.append((sample.time_ns, sample.position_l, ends[0], ends[1]))
        return rows


class WindowPart(Part):
    """The swath on the ground: *marginal* up to where the window begins (final, kept as a prior on what follows),
    *live* from there on, and *whole* once the strip is over and the backward pass has been made. And the light."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._swath = _Swath(state, "")
        self._whole: list[_Swath] = []  # of strips that are over
        self._report: Any = None
        self._light: tuple[str, str] | None = None
        self._changed = False
        self._drawn_s = -np.inf

    def pose(self, topic: str, sample: PoseSample) -> None:
        if topic != "trajectory" or self.state.camera is None or self.state.strip not in self.state.extent:
            return
        if not self.state.on_strip(sample.time_ns):
            return
        if self.state.strip != self._swath.strip:
            if len(self._swath.rows) > 1:
                self._whole.append(self._swath)
            self._swath = _Swath(self.state, self.state.strip)
        self._changed = self._swath.add(sample) or self._changed

    def take(self, message: Message) -> None:
        if message.topic == "adjustment/report":
            self._report = message.body
        if message.topic in ("adjustment/report", "observation/tie"):
            self._changed = True

    def begin_again(self, canvas: Canvas) -> None:
        canvas.clear("flight/window")
        self._swath, self._whole = _Swath(self.state, ""), []

    def draw(self, canvas: Canvas) -> None:
        report = self._report
        if report is not None and report.light and (report.light, report.light_reason) != self._light:
            self._light = report.light, report.light_reason
            text = _wrapped(": ".join(filter(None, (report.light.upper(), report.light_reason))))
            color = _LIGHTS.get(report.light, (150, 150, 150, 255))
            canvas.points("light/lamp", np.array([[0.0, -9.0]]), [color], 10.0)
            canvas.points("light/reason", np.array([[0.0, 4.0]]), [color], 0.5, [text])
        for k, swath in enumerate(self._whole, 1):
            if swath.is_new() and len(swath.rows) > 1:
                canvas.lines(f"flight/window/whole/{k}", [self._outline(swath.rows)], [WHOLE], 1.0)
        due = self.state.closing or self.state.now_s - self._drawn_s >= _PERIOD_S
        if not self._changed or not due or len(self._swath.rows) < 2:
            return
        track = self._swath.rows
        self._changed = False
        self._drawn_s = self.state.now_s
        start_ns, over = 0, False
        if report is not None:
            start_ns = report.window_start_ns if report.strip else 0
            empty = not report.strip and report.points == 0 and report.update > 0
            over = empty and track[-1][0] < max(report.window_end_ns + SECOND_NS, report.window_start_ns)
        gone = [row for row in track if row[0] <= start_ns] if not over else track
        live = [row for row in track if row[0] > start_ns] if not over else []
        if gone and live:
            live = [gone[-1], *live]
        for name, rows, color, label in (
            ("marginal", gone, WHOLE if over else FINAL, "whole strip" if over else "marginal"),
            ("live", live, LIVE, f"live window, {_seconds(live):.0f} s"),
        ):
            entity = f"flight/window/{name}"
            if len(rows) > 1:
                canvas.lines(entity, [self._outline(rows)], [color], 1.6)
                canvas.points(f"{entity}/name", self._beside(rows)[None], [color], 0.5, [label])
            else:
                canvas.lines(entity, [], [], 1.6)
                canvas.points(f"{entity}/name", np.empty((0, 3)), [], 0.5, [])
        fence = [np.array([row[2], row[1], row[3]]) for row in (live[:1] if len(live) > 1 and gone else [])]
        canvas.lines("flight/window/border", [self.state.display(f) for f in fence], [LIVE] * len(fence), 0.8)

    def _beside(self, rows: list[_Row]) -> Array:
        """Where a name stands: beside the middle of a swath, on the side that the eye is on: the right of the first."""
        _, _, left, right = rows[len(rows) // 2]
        start, end = next(iter(self.state.extent.values()))
        aside = right - left
        if aside @ np.array([end[1] - start[1], start[0] - end[0], 0.0]) < 0:  # flown back
            aside, right = -aside, left
        return self.state.display(right + _ASIDE * aside)

    def _outline(self, rows: list[_Row]) -> Array:
        left, right = np.array([r[2] for r in rows]), np.array([r[3] for r in rows])
        return self.state.display(np.vstack([left, right[::-1], left[:1]]))


def _seconds(rows: list[_Row]) -> float:
    return (rows[-1][0] - rows[0][0]) / SECOND_NS if rows else 0.0


def _wrapped(text: str) -> str:
    """Text in lines that fit the panel."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) >= _WRAP:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
