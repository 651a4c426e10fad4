"""The map: GNSS positions as measured, the final trajectory and the ground points, in latitude and longitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import convert
from ..convert import PoseSample
from ..node import Message
from .canvas import Canvas, Color
from .scene_part import CHECK, CONTROL, FILTERED, FINAL, Part, Pieces
from .scene_state import SceneState
from .trajectories import LARGEST_GAP_NS

Array = NDArray[np.floating]
_STEP_NS = convert.SECOND_NS
_GROUND = "map/ground"


class MapPart(Part):
    """Draws on the map what has a place on Earth."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._gnss = Pieces("map/gnss", 60)
        self._final = Pieces("map/final", 60, joined=True)
        self._ground = Pieces(_GROUND, 600)
        self._last: dict[str, int] = {}

    def _due(self, topic: str, time_ns: int) -> bool:
        if time_ns - self._last.get(topic, 0) < _STEP_NS:
            return False
        self._last[topic] = time_ns
        return True

    def pose(self, topic: str, sample: PoseSample) -> None:
        before_ns = self._last.get(topic, sample.time_ns)
        frame = self.state.placed
        if topic == "orientation/final" and frame is not None and self._due(topic, sample.time_ns):
            if sample.time_ns - before_ns > LARGEST_GAP_NS:  # what was flown from strip to strip is not known
                self._final.cut()
            self._final.add(frame.to_geodetic(sample.position_l)[:2])

    def take(self, message: Message) -> None:
        body = message.body
        if message.topic == "sensor/gnss" and self._due(message.topic, message.stamp_ns):
            self._gnss.add(np.array([body.latitude, body.longitude]))
        elif message.topic == "observation/control" and self.state.placed is not None:
            place = self.state.placed.to_geodetic(np.array([body.x, body.y, body.z]))[:2]
            self._ground.add((place, CHECK if convert.role_of(body) == "check" else CONTROL))

    def begin_again(self, canvas: Canvas) -> None:
        canvas.clear(_GROUND)  # it counts no more; what was flown stays where it is on the Earth
        self._ground = Pieces(_GROUND, 600)
        self._final.cut()

    def draw(self, canvas: Canvas) -> None:
        def fixes(entity: str, rows: list[Array]) -> None:
            canvas.geographic_points(entity, np.array(rows), [FILTERED] * len(rows), 2.0)

        def line(entity: str, rows: list[Array]) -> None:
            if len(rows) > 1:
                canvas.geographic_line(entity, np.array(rows), FINAL)

        def ground(entity: str, rows: list[tuple[Array, Color]]) -> None:
            canvas.geographic_points(entity, np.array([place for place, _ in rows]), [color for _, color in rows], 4.0)

        self._gnss.draw(fixes)
        self._final.draw(line)
        self._ground.draw(ground)
