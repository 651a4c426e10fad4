"""Image lines of a simulated strip through matching, and the errors of its ties against truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.rotation import quaternion_from_angles
from ..matching.line_times import LineTimes
from ..matching.options import MatchedTie, MatchingOptions
from ..matching.tie_matcher import TieMatcher
from .flight import Flight
from .observations import Looks, find_looks

Array = NDArray[np.floating]

#: Lines that come at a time.
BLOCK = 8
#: Poses come so often, s; they have a constant error and one that comes and goes of so many degrees.
POSE_S, CONSTANT_DEG, SLOW_DEG, STATED_DEG = 0.005, 0.02, 0.01, 0.03


@dataclass(frozen=True)
class MatchedStrip:
    """Ties of a strip.

    Attributes
    ----------
    ties : in the order in which they came
    came_line : (n,) lines that had been imaged when each tie came
    matcher : after the last line
    told : what it said
    """

    ties: list[MatchedTie]
    came_line: NDArray[np.int64]
    matcher: TieMatcher
    told: list[str]


def match_strip(
    flight: Flight,
    images: Sequence[NDArray[np.unsignedinteger]],
    seed: int = 1,
    *,
    lost: Sequence[NDArray[np.bool_]] | None = None,
    wrong_rad: float = 0.0,
    options: MatchingOptions | None = None,
    ground: float | None = None,
) -> MatchedStrip:
    """Match the first strip of a flight with slow attitude errors of some hundredths of a degree.

    Parameters
    ----------
    images : of each CCD line (lines, pixels)
    seed : of the attitude errors
    lost : of each CCD line (lines,), which never come
    wrong_rad : amplitude of an error of omega that swings in 40 s, and is in the sigmas
    options : of the matcher
    ground : lowest height from which on the ground is looked for; None: it is known to be about 0
    """
    strip, camera = flight.strips[0], flight.camera
    matcher = TieMatcher(camera, options or MatchingOptions())
    if ground is not None:
        matcher.search_ground(ground)
    matcher.begin_strip(strip.id, LineTimes(strip.first_line_time_s, strip.line_rate_hz))
    time_s = np.arange(0.0, flight.truth.end_s, POSE_S)
    truth = flight.truth.at(time_s)
    rng = np.random.default_rng(seed)
    angles = truth.angles + np.radians(CONSTANT_DEG) * rng.standard_normal(3)
    angles += np.radians(SLOW_DEG) * np.sin(time_s[:, None] / 5.0 + rng.uniform(0, 6, 3))
    angles[:, 0] += wrong_rad * np.sin(2 * np.pi * time_s / 40.0)
    quaternion = quaternion_from_angles(angles)
    covariance = np.diag([1.0] * 3 + [np.radians(STATED_DEG) + wrong_rad] * 3) ** 2
    ties: list[MatchedTie] = []
    came, told, poses = [], [], 0
    for first in range(0, strip.lines, BLOCK):
        end = min(first + BLOCK, strip.lines)
        end_s = float(strip.time_of(end - 1))
        while poses < len(time_s) and time_s[poses] <= end_s:
            matcher.orientation.add_pose(time_s[poses], truth.position_l[poses], quaternion[poses], covariance)
            poses += 1
        for i, (image, line) in enumerate(zip(images, camera.lines, strict=True)):
            there = np.arange(first, min(end, len(image)))
            if lost is not None:
                there = there[~lost[i][there]]
            for part in np.split(there, np.flatnonzero(np.diff(there) > 1) + 1):
                if len(part):
                    matcher.add_lines(line.id, int(part[0]), image[part])
        new = matcher.match()
        ties += new
        came += [end] * len(new)
        told += matcher.take_events()
    return MatchedStrip(ties, np.array(came, dtype=np.int64), matcher, told)


def looks_under(flight: Flight, strip: ArrayLike, ccd: ArrayLike, line: ArrayLike, sample: ArrayLike) -> Looks:
    """True looks at the ground that rays (n,) of strips and CCD lines (by index) see; point i is that of ray i."""
    camera, point_l = flight.camera, np.empty((np.size(line), 3))
    of_strip, ccd, line, sample = (np.asarray(a) for a in (strip, ccd, line, sample))
    xy = camera.image_coordinates(ccd, sample)[0]
    image = np.column_stack([xy, -camera.focal_length_mm[ccd]])
    for k in np.unique(of_strip).tolist():
        own = np.flatnonzero(of_strip == k)
        poses = flight.truth.at(flight.strips[k].time_of(line[own]))
        direction = np.einsum("nij,nj->ni", poses.R_lc, image[own])
        point_l[own] = flight.terrain.intersect(poses.position_l, direction)
    return find_looks(point_l, flight.strips, camera)


def tie_errors(flight: Flight, ties: Sequence[MatchedTie]) -> tuple[Array, Array]:
    """Errors (m, 2) of line and sample of the rays of the first strip but each point's first, and their sigma (m, 2).

    Against the truth of the ground under the first ray, whose sigma is counted with the others'.
    """
    index = flight.camera.line_index
    first = [tie.rays[0] for tie in ties]
    ccd = np.array([index[ray.ccd] for ray in first], dtype=int)
    line, sample = (np.array([getattr(ray, name) for ray in first], dtype=float) for name in ("line", "sample"))
    looks = looks_under(flight, np.zeros(len(ties), dtype=int), ccd, line, sample)
    own = looks.strip == 0
    columns = (a[own].tolist() for a in (looks.point, looks.ccd, looks.line, looks.sample))
    true = {(p, c): (u, v) for p, c, u, v in zip(*columns, strict=True)}
    rows = [
        (ray.line - true[i, index[ray.ccd]][0], ray.sample - true[i, index[ray.ccd]][1],
         np.hypot(ray.sigma_line, first[i].sigma_line), np.hypot(ray.sigma_sample, first[i].sigma_sample))
        for i, tie in enumerate(ties) for ray in tie.rays[1:] if (i, index[ray.ccd]) in true
    ]  # fmt: skip
    table = np.array(rows).reshape(-1, 4)
    return table[:, :2], table[:, 2:]
