"""A flight folder becomes the messages of a recording, or the configuration of a live flight."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.topics import rank
from ...solver.adjustment.block_data import Apriori
from ...solver.geometry.frames import LocalFrame
from ...solver.models import WANDER_TIMES
from ..convert import camera_message, ground_point_message
from ..errors import UserError
from ..node import Message
from .detect import Imported, Options, read_any
from .flight_folder import FILE, Flight, Instead, read_flight, refuse_problems
from .ground_height import GroundGiven
from .ground_points import read_ground_points
from .track import Accuracy


def live_configuration(flight: Flight, origin_deg: tuple[float, float], stamp_ns: int, source: str) -> list[Message]:
    """Project, camera, control and announced strips of a live flight, all of them with one stamp.

    Parameters
    ----------
    flight : read with ``live``, without problems
    origin_deg : latitude and longitude of the local frame's origin; its height is that of the ground
    stamp_ns : platform time from which they hold
    source : name of the publisher
    """
    lat, lon = origin_deg
    project = m.Project(
        origin_latitude=lat, origin_longitude=lon, origin_height=flight.ground_height_m,
        image_sigma_px=Apriori.image_sigma_px,
    )  # fmt: skip
    strips = [
        m.Strip(id=id, first_line_time_ns=first_ns, line_rate_hz=rate_hz) for id, first_ns, rate_hz in flight.announced
    ]
    return [
        *_configuration(flight, project, stamp_ns, source),
        *(Message("configuration/strip", stamp_ns, strip, source) for strip in strips),
    ]


def flight_messages(folder: Path, instead: Instead | None = None) -> tuple[Imported, str]:
    """The messages of a flight folder sorted by stamp and rank, and the name of its platform.

    Parameters
    ----------
    folder : with a flight.toml
    instead : data that are not those in the folder

    Raises
    ------
    UserError : the first problem of the folder and the number of the others, or what a reader finds
    """
    flight = read_flight(folder, live=False, instead=instead)
    refuse_problems(flight)
    if flight.navigation is None or flight.camera is None:
        raise UserError(f"{folder / FILE}: navigation or camera missing")
    # what was asked of positions once is not asked again; those of tables of sensors are known to their reader only
    asked = flight.track is None and flight.ground.stated
    options = Options(
        flight.day,
        flight.crs,
        flight.mounting,
        camera=flight.camera if flight.kind == "ros2" else None,
        accuracies=flight.accuracies,
        lines=flight.lines,
        accuracy=_accuracy(flight.sigmas),
        ground=flight.ground if asked else GroundGiven(flight.ground_height_m),
        poses_only=bool(flight.strips),
        without_images=instead is not None and instead.files is not None,
        grade=flight.grade,
        folder=flight.tables,
    )
    imported = read_any(flight.navigation, flight.kind, options)
    notes = imported.notes
    notes[:] = [flight.in_keys(note) for note in notes if "--position-sigma" not in note]  # flight.toml has said them
    notes[:0] = [*flight.notes, *(note for strip in flight.strips for note in strip.notes)]
    return Imported("flight", _messages(flight, imported, notes), notes), flight.platform


def _accuracy(sigmas: dict[str, Any]) -> Accuracy:
    """Of poses that come without: all slow errors together."""

    def total(*names: str) -> tuple[float, float, float]:
        a, b, c = np.sqrt(np.sum([np.square(sigmas[name]) for name in names], axis=0)).tolist()
        return a, b, c

    position = total("offset_sigma_m", "wander_sigma_m")
    return Accuracy(position, total("shift_sigma_deg", "drift_sigma_deg", "wander_sigma_deg"))


def _messages(flight: Flight, imported: Imported, notes: list[str]) -> Iterator[Message]:
    """Project, camera and control, then sensors or poses with the image lines among them."""
    messages = (message for message in imported.messages if message.topic != "configuration/camera")
    first = next(messages)
    start = min([first.stamp_ns, *(int(strip.time_ns[0]) for strip in flight.strips)])
    yield from _configuration(flight, first.body, start, first.source)
    yield from merge(
        messages,
        *(strip.messages(notes) for strip in flight.strips),
        key=lambda message: (message.stamp_ns, rank(message.topic)),
    )


def _configuration(flight: Flight, project: Any, start: int, source: str) -> Iterator[Message]:
    """Project, camera and control; the project has its origin already."""
    project.name, project.crs = flight.name, flight.crs
    frame = LocalFrame(project.origin_latitude, project.origin_longitude, project.origin_height, flight.crs)
    arm = np.asarray(flight.lever_arm_m) - np.asarray(flight.mounting.lever_arm_m)
    for key, values in (("lever_arm_m", arm), ("boresight_deg", flight.mounting.boresight_deg), *flight.sigmas.items()):
        if key in WANDER_TIMES:
            setattr(project, key, values)
            continue
        del getattr(project, key)[:]
        getattr(project, key).extend(float(v) for v in values)
    yield Message("configuration/project", start, project, source)
    if flight.camera is not None:
        yield Message("configuration/camera", start, camera_message(flight.camera), source)
    if flight.control is not None:
        points, _ = read_ground_points(flight.control, flight.crs, frame, [])
        columns = points.id, points.xyz_l, points.covariance, points.role, points.target_radius_m
        for id, xyz, covariance, role, radius in zip(*columns, strict=True):
            body = ground_point_message(id, xyz, covariance, role, radius)
            yield Message("observation/control", start, body, source)
