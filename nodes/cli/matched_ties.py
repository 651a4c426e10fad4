"""Matched tie points of a simulated flight and the truth that only the simulator knows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.simulation.flight import Flight
from ...solver.simulation.matching_study import looks_under
from ..matcher.matcher import Matcher
from ..node import Message

Array = NDArray[np.floating]

#: A rough flight: three times the turbulence on a stabilised mount, and an attitude whose slow errors are ten times
#: those of the plain one.
ROUGH: dict[str, Any] = {"turbulence": 3.0, "wander_attitude": [0.05, 0.05, 0.1]}


def is_matched(message: Message) -> bool:
    """Whether a tie point was found by image matching; targets and simulated points have other names."""
    return message.topic == "observation/tie" and "-M" in message.body.point


def is_target(message: Message) -> bool:
    """Whether a tie message is about a target that the matcher found."""
    return message.topic == "observation/tie" and "-M" not in message.body.point and message.source == Matcher.name


def tie_errors(flight: Flight, ties: list[Any]) -> tuple[Array, Array, list[str]]:
    """(rays, 2) errors of line and sample against the point's first ray, their sigma (rays, 2), px; CCD lines."""
    true, index = true_rays(flight, ties)
    number = {strip.id: i for i, strip in enumerate(flight.strips)}
    first: dict[str, Any] = {}
    rows, ccds = [], []
    for tie in ties:
        base = first.setdefault(tie.point, tie.images[0])
        for ray in tie.images:
            at = true.get((index[tie.point], number[ray.strip], flight.camera.line_index[ray.ccd]))
            if at is None or (ray.strip == base.strip and ray.ccd == base.ccd):
                continue
            sigma = np.hypot([ray.sigma_line, ray.sigma_sample], [base.sigma_line, base.sigma_sample])
            rows.append((ray.line - at[0], ray.sample - at[1], *sigma))
            ccds.append(ray.ccd)
    table = np.array(rows).reshape(-1, 4)
    return table[:, :2], table[:, 2:], ccds


def simulated_ties(flight: Flight, ties: list[Message], rng: np.random.Generator, scale: float = 1.0) -> list[Message]:
    """The ties with their true rays, and noise of ``scale`` times the sigmas that the matcher gave."""
    true, index = true_rays(flight, [message.body for message in ties])
    number = {strip.id: i for i, strip in enumerate(flight.strips)}
    out = []
    for message in ties:
        body = type(message.body)()
        body.CopyFrom(message.body)
        for ray in body.images:
            strip = number[ray.strip]
            at = true.get((index[body.point], strip, flight.camera.line_index[ray.ccd]))
            if at is None:
                continue
            line = at[0] + scale * ray.sigma_line * rng.standard_normal()
            ray.time_ns += round((line - ray.line) * 1e9 / flight.strips[strip].line_rate_hz)
            ray.line, ray.sample = line, at[1] + scale * ray.sigma_sample * rng.standard_normal()
        out.append(Message(message.topic, message.stamp_ns, body, "simulator of ties"))
    return out


def true_rays(
    flight: Flight, ties: list[Any]
) -> tuple[dict[tuple[int, int, int], tuple[float, float]], dict[str, int]]:
    """True line and sample by (point, strip, CCD line) of the ground under each point's first ray; points by name."""
    number = {strip.id: i for i, strip in enumerate(flight.strips)}
    first: dict[str, Any] = {}
    for tie in ties:
        first.setdefault(tie.point, tie.images[0])
    rays = [(number[ray.strip], flight.camera.line_index[ray.ccd], ray.line, ray.sample) for ray in first.values()]
    strip, ccd, line, sample = np.array(rays, dtype=float).reshape(-1, 4).T
    looks = looks_under(flight, strip.astype(int), ccd.astype(int), line, sample)
    columns = looks.point, looks.strip, looks.ccd, looks.line, looks.sample
    true = {(p, s, c): (u, v) for p, s, c, u, v in zip(*(a.tolist() for a in columns), strict=True)}
    return true, {name: i for i, name in enumerate(first)}
