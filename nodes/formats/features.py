"""Points and trajectories of a recording as map features, WGS 84 with sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import topics
from ...solver.geometry.frames import LocalFrame
from ..convert import SECOND_NS, given_of
from ..errors import UserError
from ..node import Message

#: Said of a project in local coordinates without an origin; on a map it would lie in the Gulf of Guinea.
NOT_PLACED = "configuration/project has local coordinates and no origin: the place of the local frame is not known"


@dataclass(frozen=True)
class Features:
    """Points with properties, and lines through them; n points.

    Attributes
    ----------
    lon_lat_height : (n, 3) degrees, degrees, metres above the ellipsoid
    properties : columns (n,) of the points
    lines : name of a line -> its pieces, each the rows of its points in order of time
    not_valid : how many points are poses that are not valid, and so on no line
    """

    lon_lat_height: NDArray[np.float64] = field(repr=False)
    properties: dict[str, list[Any]] = field(repr=False)
    lines: dict[str, list[list[int]]] = field(default_factory=dict, repr=False)
    not_valid: int = 0

    def __len__(self) -> int:
        return len(self.lon_lat_height)


def features_of(topic: str, messages: Iterable[Message], frame: LocalFrame | None) -> Features:
    """Features of a topic with places: poses, object points, ground points, GNSS fixes.

    Poses are joined to one line a strip, which is cut where they are not valid.

    Parameters
    ----------
    messages : of which none replaces another one, see `answers`
    frame : of the project; GNSS fixes do without

    Raises
    ------
    UserError : a topic without places, nothing on it, no project in the recording, or one whose place nobody knows
    """
    kind = topics.find(topic).type_name
    if kind not in ("foxglove.PoseInFrame", "foxglove.LocationFix", "triline.ObjectPoint", "triline.GroundPoint"):
        raise UserError(f"{topic} has no places for a map; topics that have: {', '.join(topics_with_places())}")
    if kind == "foxglove.LocationFix":
        return _fixes(topic, messages)
    if frame is None:
        raise UserError("no message on configuration/project: the place of the local frame is not known")
    if not frame.is_placed:
        raise UserError(NOT_PLACED)
    return _poses(topic, messages, frame) if kind == "foxglove.PoseInFrame" else _points(topic, messages, frame)


def answers(topic: str, messages: Iterable[Message]) -> list[Message]:
    """Poses in order of time, and points, each as the last message about it has it; other messages as they are.

    Of live orientation the first one about a time counts, which is the answer that was given at once.
    """
    kind = topics.find(topic).type_name
    found: dict[int | str, Message] = {}
    if kind == "foxglove.PoseInFrame":
        for message in messages:
            time = message.body.timestamp
            time_ns = time.seconds * SECOND_NS + time.nanos
            if topic != "orientation/live" or time_ns not in found:
                found[time_ns] = message
        return [found[time_ns] for time_ns in sorted(found)]
    if kind in ("triline.ObjectPoint", "triline.GroundPoint"):
        for message in messages:
            found[message.body.point] = message
        return list(found.values())
    return list(messages)


def parts_of_line(places: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """A line (n, 2 or more) of longitude, latitude, degrees, and more, cut at the date line.

    A step of more than half the Earth goes the other way round. As RFC 7946 asks for (3.1.9), no part crosses the date
    line; parts end and begin on it, at 180 or -180 degrees.
    """
    parts: list[list[NDArray[np.float64]]] = [[places[0]]]
    for a, b in pairwise(places):
        if abs(b[0] - a[0]) > 180.0:
            side = 180.0 if a[0] > b[0] else -180.0  # where the line leaves
            goal = b.copy()
            goal[0] += 2.0 * side
            share = (side - a[0]) / (goal[0] - a[0])
            end = a + share * (goal - a)
            end[0] = side
            parts[-1] += [end] if share > 0.0 else []
            begin = end.copy()
            begin[0] = -side
            parts.append([begin] if share < 1.0 else [])
        parts[-1].append(b)
    return [np.array(part) for part in parts if len(part) > 1]


def topics_with_places() -> tuple[str, ...]:
    """Topics that `features_of` takes."""
    kinds = ("foxglove.PoseInFrame", "foxglove.LocationFix", "triline.ObjectPoint", "triline.GroundPoint")
    return tuple(row.name for row in topics.TOPICS if row.type_name in kinds)


def _needed(topic: str, found: list[Any]) -> None:
    if not found:
        raise UserError(f"no message on {topic}")


def _on_globe(frame: LocalFrame, position_l: Any) -> NDArray[np.float64]:
    lat, lon, height = np.moveaxis(frame.to_geodetic(np.asarray(position_l, dtype=float)), -1, 0)
    return np.column_stack([lon, lat, height])


def _sigmas(covariances: list[Any], size: int, names: tuple[str, ...]) -> dict[str, list[float | None]]:
    """Square roots of the diagonals, None where a message has no covariance."""
    rows = []
    for covariance in covariances:
        whole = len(covariance) == size * size
        diagonal = [covariance[i * (size + 1)] for i in range(size)] if whole else []
        rows.append([float(np.sqrt(v)) if v >= 0 else None for v in diagonal] or [None] * size)
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def _poses(topic: str, messages: Iterable[Message], frame: LocalFrame) -> Features:
    bodies = [message.body for message in messages]
    _needed(topic, bodies)
    place = [body.pose.position for body in bodies]
    properties: dict[str, list[Any]] = {
        "time_ns": [body.timestamp.seconds * SECOND_NS + body.timestamp.nanos for body in bodies],
        "strip": [body.strip for body in bodies],
        "valid": [body.valid for body in bodies],
    }
    for i, name in enumerate(("omega_deg", "phi_deg", "kappa_deg")):
        properties[name] = [float(np.degrees(body.angles[i])) if len(body.angles) == 3 else None for body in bodies]
    names = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m", "sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")
    sigmas = _sigmas([body.covariance for body in bodies], 6, names)
    for name in names[3:]:
        sigmas[name] = [None if v is None else float(np.degrees(v)) for v in sigmas[name]]
    properties |= sigmas
    pieces: dict[str, list[list[int]]] = {}
    for i, body in enumerate(bodies):
        of_strip = pieces.setdefault(body.strip, [[]])
        if body.valid:
            of_strip[-1].append(i)
        elif of_strip[-1]:
            of_strip.append([])
    lines = {strip: [piece for piece in of if len(piece) > 1] for strip, of in pieces.items()}
    position = [(p.x, p.y, p.z) for p in place]
    not_valid = sum(not body.valid for body in bodies)
    return Features(_on_globe(frame, position), properties, {k: v for k, v in lines.items() if v}, not_valid)


def _points(topic: str, messages: Iterable[Message], frame: LocalFrame) -> Features:
    bodies = [message.body for message in messages]
    _needed(topic, bodies)
    properties: dict[str, list[Any]] = {"point": [body.point for body in bodies]}
    if bodies[0].DESCRIPTOR.full_name == "triline.ObjectPoint":
        names = bodies[0].DESCRIPTOR.enum_types_by_name["Status"].values_by_number
        properties["role"] = [body.role for body in bodies]
        properties["rays"] = [body.rays for body in bodies]
        properties["status"] = [names[body.status].name.lower() if body.status in names else "" for body in bodies]
    else:
        names = bodies[0].DESCRIPTOR.enum_types_by_name["Role"].values_by_number
        properties["role"] = [names[body.role].name.lower() if body.role in names else "" for body in bodies]
    names = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
    sigmas = _sigmas([body.covariance for body in bodies], 3, names)
    if bodies[0].DESCRIPTOR.full_name == "triline.GroundPoint":  # what is not given or stated has none, and not zero
        given = np.isfinite([given_of(body) for body in bodies])
        stated = [any(body.covariance) for body in bodies]
        for k, name in enumerate(names):
            sigmas[name] = [v if g and s else None for v, g, s in zip(sigmas[name], given[:, k], stated, strict=True)]
    properties |= sigmas
    return Features(_on_globe(frame, [(body.x, body.y, body.z) for body in bodies]), properties)


def _fixes(topic: str, messages: Iterable[Message]) -> Features:
    bodies = [message.body for message in messages]
    _needed(topic, bodies)
    properties: dict[str, list[Any]] = {
        "time_ns": [body.timestamp.seconds * SECOND_NS + body.timestamp.nanos for body in bodies]
    }
    names = ("sigma_E_m", "sigma_N_m", "sigma_U_m")
    properties |= _sigmas([body.position_covariance for body in bodies], 3, names)
    place = np.array([(body.longitude, body.latitude, body.altitude) for body in bodies])
    beyond = np.abs(place[:, 0]) > 180.0  # counted from 0 to 360
    place[beyond, 0] = (place[beyond, 0] + 180.0) % 360.0 - 180.0
    return Features(place, properties, {"gnss": [list(range(len(bodies)))]} if len(bodies) > 1 else {})
