"""The scene of a fleet: all aircraft in one local frame, each in a colour of its own."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import topics
from ...solver.geometry.frames import LocalFrame
from .. import convert
from ..node import Message
from .canvas import Canvas, Color, FleetLayout, Series
from .orthoimages import LARGEST_TILE
from .scene_part import CONTROL, Pieces, faded

Array = NDArray[np.floating]

#: What the scene draws.
TOPICS = (
    "configuration/project", "configuration/strip", "observation/control", "trajectory/filtered", "orientation/live",
    "orientation/final", "point/object", "adjustment/report", "orthoimage/live", "orthoimage/final", "status/*",
    "event/log",
)  # fmt: skip
COLORS: tuple[Color, ...] = (
    (90, 180, 255, 255), (255, 170, 60, 255), (110, 220, 120, 255), (235, 120, 220, 255), (240, 230, 110, 255),
    (120, 235, 230, 255), (255, 120, 110, 255), (175, 150, 255, 255),
)  # fmt: skip
LIGHTS: dict[str, Color] = {"good": (70, 220, 120, 255), "weak": (255, 200, 60, 255), "failed": (255, 80, 80, 255)}
_NO_LIGHT = (120, 125, 140, 255)
#: Positions of a trajectory that are drawn are so far apart, ns; a longer gap than this is not drawn over.
_STEP_NS, _GAP_NS = convert.SECOND_NS, 5 * convert.SECOND_NS
#: Aircraft that are drawn; names come over the link.
_MOST_AIRCRAFT = 40
#: Between lights in their view, points.
_ROW = 26.0


@dataclass
class _Track:
    """Positions by their times, whatever the order in which they come."""

    time_ns: list[int] = field(default_factory=list)
    place: dict[int, Array] = field(default_factory=dict)
    changed: bool = False

    def add(self, time_ns: int, place: Array) -> None:
        k = bisect_left(self.time_ns, time_ns)
        near = [t for t in self.time_ns[max(k - 1, 0) : k + 1] if abs(t - time_ns) < _STEP_NS]
        if not near:
            insort(self.time_ns, time_ns)
            self.place[time_ns] = place
            self.changed = True

    def pieces(self) -> list[Array]:
        """Lines without the gaps."""
        if not self.time_ns:
            return []
        cuts = np.flatnonzero(np.diff(self.time_ns) > _GAP_NS) + 1
        places = np.array([self.place[t] for t in self.time_ns])
        return [piece for piece in np.split(places, cuts) if len(piece) > 1]


class _Aircraft:
    def __init__(self, name: str, color: Color) -> None:
        self.name, self.color = name, color
        self.frame: LocalFrame | None = None
        self.tracks = {"live": _Track(), "final": _Track()}
        self.head: tuple[int, Array] | None = None
        self.points = Pieces(f"points/{name}", 600)
        self.control: dict[str, Array] = {}
        self.control_changed = False
        self.tiles: dict[tuple[int, int], Any] = {}
        self.ccd: str | None = None  # whose tiles are shown, and from which stamp on
        self.ccd_ns = 0
        self.tiles_gone = False  # those that were drawn are of another one
        self.light = self.reason = ""
        self.linked = True
        self.waiting: list[Message] = []


class FleetScene:
    """Takes messages of many aircraft one by one and draws what has changed when told to."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._aircraft: dict[str, _Aircraft] = {}
        self._frame: LocalFrame | None = None  # of the first aircraft: all are drawn in it
        self._origin: Array | None = None
        self._laid_out: Any = None
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)
        self._lights: Any = None
        self.used = 0

    def take(self, platform: str, message: Message, time_s: float) -> None:
        """Remember what a message says; what cannot be used is passed over.

        Parameters
        ----------
        platform : whose it is
        message : decoded
        time_s : when it was received, s since the begin; platform times of aircraft need not go together
        """
        if message.topic.startswith("status/") and message.topic != "status/adjuster":
            return  # nothing is drawn of it, and a desk that looks for an aircraft under any name does not make one
        aircraft = self._of(platform)
        if aircraft is None or not any(topics.find(name).matches(message.topic) for name in TOPICS):
            return
        if message.topic == "configuration/project":
            aircraft.frame = convert.local_frame(message.body)
            self._frame = self._frame or aircraft.frame
            waiting, aircraft.waiting = aircraft.waiting, []
            for one in waiting:
                self._take(aircraft, one, time_s)
            return
        if aircraft.frame is None and not message.topic.startswith(("status/", "event/", "adjustment/")):
            if len(aircraft.waiting) < 5000:
                aircraft.waiting.append(message)
            return
        self._take(aircraft, message, time_s)

    def link(self, platform: str, node: str, alive: bool) -> None:
        """An aircraft's router is linked with the ground, or no longer."""
        aircraft = self._of(platform) if node == "router" else None
        if aircraft is not None:
            aircraft.linked = alive

    def _of(self, platform: str) -> _Aircraft | None:
        if platform == "fleet" or (platform not in self._aircraft and len(self._aircraft) >= _MOST_AIRCRAFT):
            return None
        if platform not in self._aircraft:
            self._aircraft[platform] = _Aircraft(platform, COLORS[len(self._aircraft) % len(COLORS)])
        return self._aircraft[platform]

    def _take(self, aircraft: _Aircraft, message: Message, time_s: float) -> None:
        topic, body = message.topic, message.body
        self.used += 1
        if topic in ("trajectory/filtered", "orientation/live", "orientation/final"):
            time_ns = convert.time_ns(body.timestamp)
            place = self._place(aircraft, convert.pose_sample(body).position_l)
            aircraft.tracks["final" if topic.endswith("final") else "live"].add(time_ns, place)
            if aircraft.head is None or time_ns > aircraft.head[0]:
                aircraft.head = time_ns, place
            self._low, self._high = np.minimum(self._low, place), np.maximum(self._high, place)
        elif topic == "point/object":
            place = self._place(aircraft, np.array([body.x, body.y, body.z]))
            aircraft.points.add(place)
            self._low, self._high = np.minimum(self._low, place), np.maximum(self._high, place)
        elif topic == "observation/control":
            aircraft.control[body.point] = self._place(aircraft, np.array([body.x, body.y, body.z]))
            aircraft.control_changed = True
        elif topic == "adjustment/report":
            self._curves(aircraft, body, time_s)
        elif topic == "status/adjuster":
            aircraft.light, aircraft.reason = body.light, body.light_reason
        elif topic.startswith("orthoimage/"):
            if body.encoding == "mono8" and 0 < body.size <= LARGEST_TILE and len(body.data) == body.size**2:
                self._take_tile(aircraft, message)
        elif topic == "event/log":
            level = {"ERROR": "ERROR", "WARNING": "WARN"}.get(convert.enum_name(type(body).Level, body.level).upper())
            self._canvas.event("log", f"{aircraft.name}: {body.message}", level or "INFO")

    def _take_tile(self, aircraft: _Aircraft, message: Message) -> None:
        """Tiles of another CCD line, to which the rectifier has changed over, take the place of all before."""
        tile = message.body
        if aircraft.ccd is not None and tile.ccd != aircraft.ccd:
            if message.stamp_ns < aircraft.ccd_ns:
                return  # one of before, which came late over the link
            aircraft.tiles.clear()
            aircraft.tiles_gone = True
        if tile.ccd != aircraft.ccd:
            aircraft.ccd, aircraft.ccd_ns = tile.ccd, message.stamp_ns
        aircraft.tiles[tile.row, tile.column] = tile

    def _place(self, aircraft: _Aircraft, position_l: Array) -> Array:
        """Display position: in the frame of the first aircraft, less a rounded origin."""
        frame = aircraft.frame
        if frame is not None and self._frame is not None and frame != self._frame:
            position_l = self._frame.from_geodetic(*frame.to_geodetic(position_l))
        if self._origin is None:
            self._origin = np.round(position_l, -2) * (1.0, 1.0, 0.0)
        return position_l - self._origin

    def _curves(self, aircraft: _Aircraft, report: Any, time_s: float) -> None:
        if len(report.sigma) >= 3:
            self._curve(aircraft, "sigma", time_s, max(report.sigma[:3]))
        if report.redundancy > 0:
            self._curve(aircraft, "sigma0", time_s, report.sigma0)

    def _curve(self, aircraft: _Aircraft, plot: str, time_s: float, value: float) -> None:
        entity = f"plots/fleet/{plot}/{aircraft.name}"
        self._canvas.style(entity, Series(aircraft.name, aircraft.color))
        self._canvas.curve(entity, [time_s], [value])

    def draw(self, time_s: float) -> None:
        """Draw what has changed since the last call.

        Parameters
        ----------
        time_s : now, s since the begin
        """
        self._canvas.at(time_s)
        self._lay_out()
        for aircraft in list(self._aircraft.values()):
            self._draw(aircraft)
        self._draw_lights()

    def _draw(self, aircraft: _Aircraft) -> None:
        canvas, name = self._canvas, aircraft.name
        for kind, color, radius in (("live", faded(aircraft.color, 0.45), 1.2), ("final", aircraft.color, 2.4)):
            track = aircraft.tracks[kind]
            if track.changed:
                track.changed = False
                pieces = track.pieces()
                canvas.lines(f"flight/{name}/{kind}", pieces, [color] * len(pieces), radius)
                self._map(aircraft, kind, pieces, color)
        if aircraft.head is not None:
            light = LIGHTS.get(aircraft.light, _NO_LIGHT) if aircraft.linked else _NO_LIGHT
            label = name if aircraft.linked else f"{name}: no link"
            canvas.points(f"flight/{name}/head", aircraft.head[1][None, :], [light], 6.0, [label])
            place = self._geodetic(aircraft.head[1][None, :])
            if place is not None:
                canvas.geographic_points(f"map/{name}/head", place, [light], 6.0)
        aircraft.points.draw(
            lambda entity, rows: canvas.points(entity, np.array(rows), [faded(aircraft.color, 0.7)] * len(rows), 1.4)
        )
        if aircraft.control_changed:
            aircraft.control_changed = False
            places = np.array(list(aircraft.control.values()))
            canvas.points(f"points/control/{name}", places, [CONTROL] * len(places), 4.0)
        self._draw_tiles(aircraft)

    def _draw_tiles(self, aircraft: _Aircraft) -> None:
        if aircraft.tiles_gone:
            aircraft.tiles_gone = False
            self._canvas.clear(f"mosaic/{aircraft.name}")
        for (row, column), tile in aircraft.tiles.items():
            grey = np.frombuffer(tile.data, dtype=np.uint8).reshape(tile.size, tile.size)
            if not grey.any():
                continue
            side = tile.size * tile.gsd_m
            east, south = tile.x + side, tile.y - side
            z = tile.z - 5.0
            corners = [(tile.x, tile.y, z), (east, tile.y, z), (east, south, z), (tile.x, south, z)]
            placed = np.array([self._place(aircraft, np.array(corner)) for corner in corners])
            self._canvas.picture(f"mosaic/{aircraft.name}/{row}_{column}", placed, grey)
        aircraft.tiles.clear()

    def _geodetic(self, places: Array) -> Array | None:
        if self._frame is None or self._origin is None or not self._frame.is_placed:
            return None  # nobody knows where on the Earth it lies
        return np.array([self._frame.to_geodetic(place + self._origin)[:2] for place in places])

    def _map(self, aircraft: _Aircraft, kind: str, pieces: list[Array], color: Color) -> None:
        for k, piece in enumerate(pieces):
            line = self._geodetic(piece)
            if line is not None:
                self._canvas.geographic_line(f"map/{aircraft.name}/{kind}/{k}", line, color)

    def _draw_lights(self) -> None:
        rows = sorted(self._aircraft.values(), key=lambda a: a.name)
        state = [(a.name, a.light, a.reason, a.linked) for a in rows]
        if state == self._lights or not rows:
            return
        self._lights = state
        places = np.array([[0.0, _ROW * k] for k in range(len(rows))])
        colors = [LIGHTS.get(a.light, _NO_LIGHT) if a.linked else _NO_LIGHT for a in rows]
        self._canvas.points("lights", places, colors, 8.0, [a.name for a in rows])
        lines = ["| aircraft | light | reason |", "|---|---|---|"]
        for a in rows:
            light = (a.light or "unknown") if a.linked else f"no link; last known: {a.light or 'unknown'}"
            lines.append(f"| {_cell(a.name)} | {_cell(light)} | {_cell(a.reason) if a.light != 'good' else ''} |")
        self._canvas.document("about", "\n".join(lines))

    def _lay_out(self) -> None:
        """Arrange the views when an aircraft has come, or they have flown far beyond what is in view."""
        if not np.isfinite(self._low).all():
            return
        low, high = self._low, self._high
        if self._laid_out is not None:
            names, before_low, before_high = self._laid_out
            room = 0.1 * np.maximum(before_high - before_low, 200.0)
            within = (low >= before_low - room).all() and (high <= before_high + room).all()
            if names == tuple(self._aircraft) and within:
                return
        self._laid_out = tuple(self._aircraft), low.copy(), high.copy()
        corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        centre = self._geodetic(corners.mean(axis=0)[None, :])
        middle = None if centre is None else (float(centre[0, 0]), float(centre[0, 1]))
        self._canvas.layout(FleetLayout(tuple(self._aircraft), corners, _ROW, middle))


def _cell(text: str) -> str:
    """Text of another program inside a table."""
    return text.replace("|", "/").replace("\n", " ")[:200]
