"""Simulated blocks of any size: strips are flown once, points and rays come tile by tile and are never all held."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..adjustment.network import Control, Measurements, Network, Strip, build_network
from ..camera.line_camera import LineCamera
from ..models.base import Extent, ModelOptions
from .network import (
    FlightLine,
    Noise,
    control_of,
    draw_unknowns,
    fly,
    known_points,
    looks_of,
    measured_trajectory,
    parallel_and_cross,
    swath_m,
)

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Strips are flown so high, m; half the strips overlap their neighbours by this share of the swath.
HEIGHT_M, SIDELAP = 1800.0, 0.4
#: Every so many-th point of a tile is a check point.
CHECK = 7


@dataclass(frozen=True)
class Tile:
    """Points of a tile and their looks.

    Attributes
    ----------
    point_ids : (p,)
    points_l : (p, 3) true
    measurements : point indices count from the tile's first
    control, check : with such indices
    """

    point_ids: tuple[str, ...]
    points_l: Array
    measurements: Measurements
    control: Control
    check: Control


@dataclass(frozen=True)
class LargeBlock:
    """A block of parallel and cross strips over rolling ground, in tiles of about equal numbers of points.

    Attributes
    ----------
    camera, lines : what is flown
    truth, measured : strips with their true and with their measured trajectories
    tiles : (k, 4) limits x_min, x_max, y_min, y_max, metres
    points : of a tile
    noise, seed : of the measurements
    """

    camera: LineCamera
    lines: tuple[FlightLine, ...]
    truth: tuple[Strip, ...] = field(repr=False)
    measured: tuple[Strip, ...] = field(repr=False)
    tiles: Array
    points: int
    noise: Noise
    seed: int

    def tile(self, key: int) -> Tile:
        """Points and rays of one tile, the same whenever they are asked for.

        One point in the middle of each third tile is control.
        """
        rng = np.random.default_rng([self.seed, 1, key])
        x0, x1, y0, y1 = self.tiles[key]
        x, y = rng.uniform(x0, x1, self.points), rng.uniform(y0, y1, self.points)
        xyz = np.column_stack([x, y, 60 * np.sin(x / 700) + 40 * np.cos(y / 500)])
        looks = [
            looks_of(self.camera, strip, line, xyz, i)
            for i, (strip, line) in enumerate(zip(self.truth, self.lines, strict=True))
            if _may_see(line, self.tiles[key], swath_m(self.camera, line.height_m))
        ]
        point, strip, ccd, u, v = (np.concatenate(a) for a in zip(*looks, strict=True))
        u = u + rng.normal(0.0, self.noise.image_px, len(u))
        v = v + rng.normal(0.0, self.noise.image_px, len(v))
        sigma = np.full(len(u), self.noise.image_px)
        middle = int(np.argmin(np.hypot(x - (x0 + x1) / 2, y - (y0 + y1) / 2)))
        roles = {middle: "control"} if key % 3 == 0 else {}
        check = np.array([i for i in range(0, self.points, CHECK) if i not in roles], dtype=np.int64)
        return Tile(
            tuple(f"T{key}-{i}" for i in range(self.points)),
            xyz,
            Measurements(point, strip, ccd, u, v, sigma, sigma),
            control_of(xyz, roles, self.noise, rng),
            known_points(xyz, check),
        )

    def network(self, key: int) -> Network:
        """The network of one tile."""
        tile = self.tile(key)
        return build_network(
            self.camera, self.measured, tile.point_ids, tile.measurements, tile.control, tile.check
        )  # fmt: skip

    def whole(self) -> Network:
        """The network of all tiles, in memory."""
        tiles = [self.tile(key) for key in range(len(self.tiles))]
        first = np.arange(len(tiles)) * self.points

        def joined(name: str) -> Any:
            return np.concatenate([getattr(t.measurements, name) for t in tiles])

        def together(parts: Iterator[Control]) -> Control:
            own = [replace(c, point=c.point + f) for c, f in zip(parts, first, strict=True)]
            return Control(
                np.concatenate([c.point for c in own]),
                np.concatenate([c.xyz_l for c in own]),
                np.concatenate([c.sigma_m for c in own]),
            )

        point = np.concatenate([t.measurements.point + f for t, f in zip(tiles, first, strict=True)])
        names = ("strip", "ccd", "line", "sample", "sigma_line_px", "sigma_sample_px")
        return build_network(
            self.camera,
            self.measured,
            [name for t in tiles for name in t.point_ids],
            Measurements(point, *(joined(name) for name in names)),
            together(t.control for t in tiles),
            together(t.check for t in tiles),
        )


def large_block(
    camera: LineCamera,
    errors: ModelOptions,
    strips: int,
    length_m: float,
    cross: int,
    tiles: tuple[int, int],
    points: int,
    noise: Noise = Noise(),  # noqa: B008  (frozen)
    seed: int = 1,
    pose_rate_hz: float = 20.0,
) -> LargeBlock:
    """Fly a block.

    Parameters
    ----------
    errors : model whose unknowns are drawn from its a-priori knowledge, strip by strip
    strips, cross, length_m : as in `simulation.network.parallel_and_cross`
    tiles : how many along the strips, and across
    points : of each tile
    """
    lines = parallel_and_cross(camera, HEIGHT_M, strips, cross, length_m, sidelap=SIDELAP)
    truth, measured = [], []
    for i, line in enumerate(lines):
        rng = np.random.default_rng([seed, 0, i])
        true = fly(line, noise, pose_rate_hz, rng)
        strip = Strip(line.id, true, true.start_s + 0.5, line.line_rate_hz, int(line.duration_s * line.line_rate_hz))
        model = errors.build(Extent(f"strip {line.id}", true.start_s, true.end_s))
        truth.append(strip)
        measured.append(
            replace(strip, trajectory=measured_trajectory(true, model, draw_unknowns(model, rng), noise, rng))
        )
    half_x = length_m / 2
    half_y = (1 + (1 - SIDELAP) * (strips - 1)) * swath_m(camera, HEIGHT_M) / 2
    x, y = np.linspace(-half_x, half_x, tiles[0] + 1), np.linspace(-half_y, half_y, tiles[1] + 1)
    limits = [(x[i], x[i + 1], y[k], y[k + 1]) for i in range(tiles[0]) for k in range(tiles[1])]
    return LargeBlock(camera, lines, tuple(truth), tuple(measured), np.array(limits), points, noise, seed)


def _may_see(line: FlightLine, limits: Array, swath: float) -> bool:
    """Whether a strip can see any of a rectangle: its distance to the line of flight is less than the swath."""
    corners = np.array([(x, y) for x in limits[:2] for y in limits[2:]]) - line.start
    a = np.radians(line.azimuth_deg)
    across = -corners[:, 0] * np.sin(a) + corners[:, 1] * np.cos(a)
    return bool(across.min() < swath and across.max() > -swath)
