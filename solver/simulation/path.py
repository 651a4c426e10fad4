"""The ground track of a flight: straight strips joined by shortest turns, rounded as an aircraft rolls in and out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

#: Time over which the acceleration of a turn builds up and dies away, seconds (length of the rounding kernel).
ROUNDING_S = 12.0


@dataclass(frozen=True)
class Leg:
    """A straight line to be flown: from ``start`` (2,) for ``length_m`` towards ``azimuth`` (radians, from X to Y)."""

    start: tuple[float, float]
    azimuth: float
    length_m: float

    @property
    def end(self) -> tuple[float, float]:
        return self.point(self.length_m)

    def point(self, distance_m: float) -> tuple[float, float]:
        return (
            self.start[0] + distance_m * float(np.cos(self.azimuth)),
            self.start[1] + distance_m * float(np.sin(self.azimuth)),
        )


@dataclass(frozen=True)
class _Piece:
    """A line or an arc: ``curvature`` 1/m, positive to the left."""

    start: tuple[float, float]
    azimuth: float
    length_m: float
    curvature: float

    def at(self, distance_m: Array) -> Array:
        """Points (n, 2) at distances (n,) from its start."""
        k, a = self.curvature, self.azimuth
        if k == 0.0:
            along, aside = distance_m, np.zeros_like(distance_m)
        else:
            along, aside = np.sin(k * distance_m) / k, (1.0 - np.cos(k * distance_m)) / k
        c, s = np.cos(a), np.sin(a)
        return np.stack([self.start[0] + c * along - s * aside, self.start[1] + s * along + c * aside], axis=-1)

    def end_state(self) -> tuple[tuple[float, float], float]:
        x, y = self.at(np.array([self.length_m]))[0]
        return (float(x), float(y)), self.azimuth + self.curvature * self.length_m


def shortest_turn(
    start: tuple[float, float], azimuth: float, end: tuple[float, float], end_azimuth: float, radius_m: float
) -> list[tuple[float, float]]:
    """Shortest way between two directed points with bounded curvature, as (length_m, curvature) of three pieces.

    Arc-line-arc and arc-arc-arc ways are compared. Source: L. E. Dubins, Amer. J. Math. 79 (1957) 497-516.
    """
    best: list[tuple[float, float]] = []
    for left1, left2 in product((1.0, -1.0), repeat=2):
        c1 = _centre(start, azimuth, left1 * radius_m)
        c2 = _centre(end, end_azimuth, left2 * radius_m)
        candidates = [_line_way(c1, c2, azimuth, end_azimuth, left1, left2, radius_m)]
        if left1 == left2:
            candidates += [_arc_way(c1, c2, azimuth, end_azimuth, left1, radius_m, side) for side in (1.0, -1.0)]
        for way in candidates:
            if way and (not best or sum(p[0] for p in way) < sum(p[0] for p in best)):
                best = way
    return best


def _centre(point: tuple[float, float], azimuth: float, radius: float) -> Array:
    return np.array([point[0] - radius * np.sin(azimuth), point[1] + radius * np.cos(azimuth)])


def _turn(change: float) -> float:
    """Angle to turn in [0, 2 pi); rounding must not make a full circle of no turn at all."""
    angle = float(change % (2 * np.pi))
    return 0.0 if angle > 2 * np.pi - 1e-10 else angle


def _line_way(
    c1: Array, c2: Array, azimuth: float, end_azimuth: float, left1: float, left2: float, radius: float
) -> list[tuple[float, float]]:
    d = c2 - c1
    distance = float(np.hypot(*d))
    bearing = float(np.arctan2(d[1], d[0]))
    if left1 == left2:
        line, along = bearing, distance
    else:
        if distance < 2 * radius:
            return []
        along = float(np.sqrt(distance**2 - 4 * radius**2))
        line = bearing + left1 * float(np.arctan2(2 * radius, along))
    a1, a2 = _turn(left1 * (line - azimuth)), _turn(left2 * (end_azimuth - line))
    return [(a1 * radius, left1 / radius), (along, 0.0), (a2 * radius, left2 / radius)]


def _arc_way(
    c1: Array, c2: Array, azimuth: float, end_azimuth: float, left: float, radius: float, side: float
) -> list[tuple[float, float]]:
    d = c2 - c1
    distance = float(np.hypot(*d))
    if distance > 4 * radius or distance == 0.0:
        return []
    tip = float(np.arctan2(d[1], d[0]) + side * np.arccos(distance / (4 * radius)))
    middle = c1 + 2 * radius * np.array([np.cos(tip), np.sin(tip)])
    # where two circles touch, the heading is the direction from the centre turned by a quarter
    h1 = tip + left * np.pi / 2
    h2 = float(np.arctan2(*(middle - c2)[::-1])) + left * np.pi / 2
    a1, a2, a3 = _turn(left * (h1 - azimuth)), _turn(-left * (h2 - h1)), _turn(left * (end_azimuth - h2))
    return [(a1 * radius, left / radius), (a2 * radius, -left / radius), (a3 * radius, left / radius)]


@dataclass(frozen=True)
class Track:
    """A ground track at constant speed.

    Attributes
    ----------
    time_s : (n,) regular, from 0
    position : (n, 2) m
    azimuth : (n,) direction of flight, radians from X to Y, continuous
    azimuth_rate : (n,) rad/s
    leg_start_s, leg_end_s : (legs,) when the legs begin and end
    """

    time_s: Array
    position: Array
    azimuth: Array
    azimuth_rate: Array
    leg_start_s: Array
    leg_end_s: Array


def fly_legs(
    legs: Sequence[Leg], speed_m_s: float, step_s: float, radius_m: float, lead_in_s: float, lead_out_s: float
) -> Track:
    """Fly the legs one after the other, with turns between them.

    The legs themselves are flown straight: turns begin and end far enough from them for the rounding. ``lead_in_s`` of
    straight flight comes before the first leg and ``lead_out_s`` after the last one.
    """
    settle = 0.5 * ROUNDING_S * speed_m_s + speed_m_s
    lead_in, lead_out = lead_in_s * speed_m_s, lead_out_s * speed_m_s
    first = legs[0]
    pieces = [_Piece(first.point(-lead_in), first.azimuth, lead_in, 0.0)]
    begin, end = [], []
    for i, leg in enumerate(legs):
        if i > 0:
            state = legs[i - 1].point(legs[i - 1].length_m + settle), legs[i - 1].azimuth
            pieces.append(_Piece(legs[i - 1].end, legs[i - 1].azimuth, settle, 0.0))
            for length, curvature in shortest_turn(*state, leg.point(-settle), leg.azimuth, radius_m):
                pieces.append(_Piece(*state, length, curvature))
                state = pieces[-1].end_state()
            pieces.append(_Piece(leg.point(-settle), leg.azimuth, settle, 0.0))
        begin.append(sum(p.length_m for p in pieces))
        pieces.append(_Piece(leg.start, leg.azimuth, leg.length_m, 0.0))
        end.append(begin[-1] + leg.length_m)
    pieces.append(_Piece(legs[-1].end, legs[-1].azimuth, lead_out, 0.0))
    n = int(np.floor(sum(p.length_m for p in pieces) / speed_m_s / step_s + 1e-9)) + 1
    position, azimuth, rate = _rounded(pieces, n, speed_m_s, step_s)
    to_s = 1.0 / speed_m_s
    return Track(np.arange(n) * step_s, position, azimuth, rate, np.array(begin) * to_s, np.array(end) * to_s)


def _rounded(pieces: list[_Piece], n: int, speed: float, step_s: float) -> tuple[Array, Array, Array]:
    """Positions (n, 2) smoothed with a cubic B-spline kernel, which leaves straight lines as they are."""
    from scipy.signal import oaconvolve

    box = np.full(round(ROUNDING_S / 4.0 / step_s), 1.0)
    kernel = np.convolve(np.convolve(box, box), np.convolve(box, box))
    kernel /= kernel.sum()
    half = len(kernel) // 2
    distance = (np.arange(n + len(kernel) - 1) - half) * step_s * speed
    starts = np.concatenate([[0.0], np.cumsum([p.length_m for p in pieces])])
    index = np.clip(np.searchsorted(starts, distance, side="right") - 1, 0, len(pieces) - 1)
    rough = np.empty((len(distance), 2))
    for i, piece in enumerate(pieces):
        mine = index == i
        rough[mine] = piece.at(distance[mine] - starts[i])
    position = oaconvolve(rough, kernel[:, None], mode="valid", axes=0)
    velocity = np.gradient(position, step_s, axis=0)
    azimuth = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    return position, azimuth, np.gradient(azimuth, step_s)
