"""Ground points by status, and residuals in object space."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import convert
from ..node import Message
from .canvas import Canvas, Color
from .scene_part import CHECK, CONTROL, FINAL, LIVE, REJECTED, Part, Pieces, ccd_color, faded
from .scene_state import SceneState, forward

Array = NDArray[np.floating]

_FADING_S, _SETTLED = 12.0, 0.3  # residuals of a final point fade so long to so much
_FADED_EVERY_S = 0.8
_LABELLED = 12  # control points; with more of them names would cover the view


class PointsPart(Part):
    """Object points (live ones replaced as a whole, final ones added), control and check points, residual vectors."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._forget()

    def _forget(self) -> None:
        self._live: dict[str, tuple[Array, Color]] = {}
        self._live_changed = False
        self._final = Pieces("points/final", 150)
        self._residuals = Pieces("points/residuals", 150)
        self._fresh: dict[str, tuple[float, list[tuple[Array, Array, Color]]]] = {}  # of live points
        self._settling: deque[tuple[float, list[tuple[Array, Array, Color]]]] = deque()
        self._faded_s = -np.inf
        self._given: dict[str, tuple[Array, str]] = {}
        self._counts: dict[str, Array] = {}  # the same, NaN where a coordinate is not given
        self._given_changed = False
        self._misfit: dict[str, Array] = {}
        self._misfit_changed = False

    def take(self, message: Message) -> None:
        body = message.body
        if message.topic == "observation/control":
            self._given[body.point] = np.array([body.x, body.y, body.z]), convert.role_of(body)
            self._counts[body.point] = convert.given_of(body)
            self._given_changed = True
        elif message.topic == "point/object":
            self._take_point(body)

    def _take_point(self, body: Any) -> None:
        xyz = np.array([body.x, body.y, body.z])
        if not np.isfinite(xyz).all():
            raise ValueError(f"point {body.point!r} is not finite")
        if body.status == body.WHOLE:  # millimetres from where it is drawn already
            return
        bad = any(r.rejected for r in body.residuals)
        if body.point in self._given and body.status == body.FINAL:
            self._misfit[body.point] = np.nan_to_num(xyz - self._counts[body.point])
            self._misfit_changed = True
        if body.status == body.LIVE:
            self._live[body.point] = xyz, REJECTED if bad else LIVE
            self._fresh[body.point] = self.state.now_s, self._vectors(xyz, body.residuals)
        else:
            self._live.pop(body.point, None)
            self._final.add((xyz, REJECTED if bad else FINAL))
            self._fresh.pop(body.point, None)
            self._settling.append((self.state.now_s, self._vectors(xyz, body.residuals)))
        self._live_changed = True

    def _vectors(self, xyz: Array, residuals: Any) -> list[tuple[Array, Array, Color]]:
        """Image residuals of a tie point, laid on the ground: lines along the flight, samples to the left."""
        pose, ccds = self.state.newest, self.state.ccds
        rows: list[tuple[Array, Array, Color]] = []
        if pose is None:
            return rows
        along = forward(pose.quaternion)
        left = np.array([-along[1], along[0], 0.0])
        for r in residuals:
            strip = self.state.strips.get(r.strip)
            if r.rejected or strip is None or r.ccd not in ccds or not strip.line_rate_hz > 0:
                continue
            advance = self.state.speed_m_s / strip.line_rate_hz
            vector = r.v_line * advance * along + r.v_sample * self.state.gsd_m * left
            color = ccd_color(ccds.index(r.ccd))
            rows.append((xyz, self.state.residual_scale * vector, color))
        return rows

    def _fade(self, canvas: Canvas) -> None:
        """Residuals of live points in full colour; those of final ones fade, and then stay as they are."""
        now = self.state.now_s
        while self._settling and (self.state.closing or now - self._settling[0][0] > _FADING_S):
            for xyz, vector, color in self._settling.popleft()[1]:
                self._residuals.add((xyz, vector, faded(color, _SETTLED)))
        rows = [row for _, rows in self._fresh.values() for row in rows]
        for since, old in self._settling:
            share = 1.0 - (1.0 - _SETTLED) * min((now - since) / _FADING_S, 1.0)
            rows += [(xyz, vector, faded(color, share)) for xyz, vector, color in old]
        self._faded_s = now
        origins = np.array([xyz for xyz, _, _ in rows]).reshape(-1, 3)
        arrows = np.array([vector for _, vector, _ in rows]).reshape(-1, 3)
        canvas.arrows("points/fresh", self.state.display(origins), arrows, [color for *_, color in rows], 0.9)

    def begin_again(self, canvas: Canvas) -> None:
        canvas.clear("points")
        self._forget()

    def draw(self, canvas: Canvas) -> None:
        display = self.state.display
        if self._live_changed:
            self._live_changed = False
            rows = list(self._live.values())
            xyz = np.array([xyz for xyz, _ in rows]).reshape(-1, 3)
            canvas.points("points/live", display(xyz), [color for _, color in rows], 2.2)

        def points(entity: str, rows: list[tuple[Array, Color]]) -> None:
            canvas.points(entity, display(np.array([r[0] for r in rows])), [r[1] for r in rows], 2.2)

        def vectors(entity: str, rows: list[tuple[Array, Array, Color]]) -> None:
            origins, arrows, colors = zip(*rows, strict=True)
            canvas.arrows(entity, display(np.array(origins)), np.array(arrows), colors, 0.6)

        self._final.draw(points)
        if self.state.closing or self.state.now_s - self._faded_s >= _FADED_EVERY_S:
            self._fade(canvas)
        self._residuals.draw(vectors)
        if self._given_changed:
            self._given_changed = False
            for entity, wanted, color in (("points/control", False, CONTROL), ("points/check", True, CHECK)):
                chosen = [(id, xyz) for id, (xyz, role) in self._given.items() if (role == "check") is wanted]
                if chosen:
                    xyz = np.array([xyz for _, xyz in chosen])
                    few = not wanted and len(chosen) <= _LABELLED
                    labels = [id for id, _ in chosen] if few else None
                    canvas.points(entity, display(xyz), [color] * len(chosen), 4.5, labels)
        if self._misfit_changed:
            self._misfit_changed = False
            origins = np.array([self._given[id][0] for id in self._misfit])
            colors = [CHECK if self._given[id][1] == "check" else CONTROL for id in self._misfit]
            vectors_l = self.state.residual_scale * np.array(list(self._misfit.values()))
            canvas.arrows("points/misfit", display(origins), vectors_l, colors, 2.0)
