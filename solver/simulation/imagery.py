"""What the CCD lines of a simulated flight see: image lines through the true orientation.

Every pixel's ray goes through the true pose of its line to the ground. Heights are found on every few pixels and
interpolated, the rest is exact: a feature lies where the collinearity equations say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..ranges import check_ranges
from .flight import Flight, pixel_angle, view_tangents
from .ground_texture import CLOUD_REFLECTANCE, GroundTexture, ground_texture
from .streams import STREAMS, stream

Array = NDArray[np.floating]

FULL_SCALE = 4095
#: Heights are computed this far apart on the ground, at most; the shortest relief has more than ten times that length.
NODE_M = 12.0
#: Lines rendered at once are limited to so many pixels, so that the arrays stay small.
CHUNK_PIXELS = 200_000


@dataclass(frozen=True)
class ImagingPlan:
    """How the sensor turns reflectance into grey values.

    Attributes
    ----------
    dark, bright : grey values of reflectance 0 and 1
    gain_spread, offset_spread : half the range that looks differ by, as a factor and in grey values
    flicker, flicker_s : slow change of illumination, as a factor, and its period
    falloff : loss of light at the ends of a line
    noise : grey values, 1 sigma, without light; photon noise comes on top
    photon_noise : grey values, 1 sigma, at full scale
    cars_m_s : speed of cars on the roads, 0 for none
    clouds : share of the view that clouds cover, 0 for a clear sky
    cloud_height : of their layer, as a share of the flying height
    block_s : a block of lines is sent at least this often

    Raises
    ------
    ValueError : a value that makes no sense
    """

    dark: float = 150.0
    bright: float = 3400.0
    gain_spread: float = 0.15
    offset_spread: float = 80.0
    flicker: float = 0.05
    flicker_s: float = 40.0
    falloff: float = 0.12
    noise: float = 4.0
    photon_noise: float = 12.0
    cars_m_s: float = 14.0
    clouds: float = 0.0
    cloud_height: float = 0.5
    block_s: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(self, ("flicker_s", "block_s"), vars(self), "imaging plan")
        if not (self.clouds < 1 and self.cloud_height < 1):
            raise ValueError("imaging plan: wanted clouds and cloud_height below 1")
        if not self.dark < self.bright:
            raise ValueError(f"imaging plan: wanted dark below bright, got {self.dark} and {self.bright}")


class LineImager:
    """Renders image lines of a flight; the same lines look the same whenever and in whatever blocks they are asked for.

    Parameters
    ----------
    flight : the truth
    texture : what the ground looks like
    seed : of sensor noise and illumination
    plan : the sensor
    """

    def __init__(self, flight: Flight, texture: GroundTexture, seed: int, plan: ImagingPlan | None = None):
        self.flight, self.texture, self.seed = flight, texture, seed
        self.plan = plan or ImagingPlan()
        camera = flight.camera
        rng = stream(seed, "illumination")
        lines = len(camera.lines)
        self._gain = 1.0 + self.plan.gain_spread * rng.uniform(-1, 1, lines)
        self._offset = self.plan.offset_spread * rng.uniform(-1, 1, lines)
        self._phase = rng.uniform(0, 2 * np.pi, lines)
        gsd = texture.detail_m
        # a footprint grows across by 1 / cos and along by 1 / cos^2 of the view angle; its mean counts
        self._seen = [texture.seen_by(gsd * (1 + t * t) ** 0.75) for t in view_tangents(camera)]
        self._rays, self._nodes, self._between, self._light = [], [], [], []
        for k, line in enumerate(camera.lines):
            xy = camera.image_coordinates(np.full(line.pixels, k), np.arange(line.pixels))[0]
            self._rays.append(np.vstack([xy.T, np.full(line.pixels, -camera.focal_length_mm[k])]))
            nodes, between = _interpolation(line.pixels, max(int(NODE_M / gsd), 1))
            self._nodes.append(nodes)
            self._between.append(between)
            across = xy[:, 1] / np.abs(xy[:, 1]).max()
            self._light.append((1.0 - self.plan.falloff * across**2).astype(np.float32))

    def render(self, strip: int, ccd: int, first_line: int, count: int) -> NDArray[np.uint16]:
        """Lines ``first_line .. first_line + count - 1`` of a strip, (count, pixels), 12 bit.

        Raises
        ------
        ValueError : lines outside the strip
        """
        lines = self.flight.strips[strip].lines
        if not (first_line >= 0 and count >= 0 and first_line + count <= lines):
            raise ValueError(f"lines {first_line} to {first_line + count - 1} of a strip of {lines} lines")
        pixels = self.flight.camera.lines[ccd].pixels
        step = max(CHUNK_PIXELS // pixels, 1)
        out = np.empty((count, pixels), dtype=np.uint16)
        for begin in range(0, count, step):
            n = min(step, count - begin)
            signal = self.signal(strip, ccd, first_line + begin, n)
            for i in range(n):
                rng = np.random.default_rng(
                    np.random.SeedSequence(
                        self.seed, spawn_key=(STREAMS.index("sensor noise"), strip, ccd, first_line + begin + i)
                    )
                )
                noise = rng.standard_normal(pixels, dtype=np.float32)
                noise *= np.sqrt(self.plan.noise**2 + self.plan.photon_noise**2 / FULL_SCALE * np.maximum(signal[i], 0))
                out[begin + i] = np.clip(np.rint(signal[i] + noise), 0, FULL_SCALE)
        return out

    def signal(self, strip: int, ccd: int, first_line: int, count: int) -> NDArray[np.floating]:
        """The same without noise, rounding and limits."""
        time_s = self.flight.strips[strip].time_of(first_line + np.arange(count))
        plan, seen = self.plan, self._seen[ccd]
        ground = self.ground(ccd, time_s)
        value = seen.reflectance(ground[0], ground[1], time_s[:, None], strip * len(self._seen) + ccd)
        if plan.clouds:
            there = self._in_cloud_layer(ground, time_s)
            value += seen.clouds(there[0], there[1], plan.clouds) * (np.float32(CLOUD_REFLECTANCE) - value)
        light = self._gain[ccd] * (1 + plan.flicker * np.sin(2 * np.pi * time_s / plan.flicker_s + self._phase[ccd]))
        value = value * (plan.bright - plan.dark) + np.float32(plan.dark)
        return value * (light.astype(np.float32)[:, None] * self._light[ccd]) + np.float32(self._offset[ccd])

    def ground(self, ccd: int, time_s: Array) -> Array:
        """(3, n, pixels) ground points that a CCD line sees at times (n,)."""
        poses = self.flight.truth.at(time_s)
        direction = np.swapaxes(poses.R_lc, 0, 1) @ self._rays[ccd]  # (3, n, pixels)
        nodes = self._nodes[ccd]
        n, k = len(time_s), len(nodes)
        origin = np.repeat(poses.position_l, k, axis=0)
        at_nodes = direction[:, :, nodes].reshape(3, -1).T
        height = self.flight.terrain.met(origin, at_nodes).reshape(n, k)
        z = (self._between[ccd] @ height.T).T
        position = poses.position_l.T[:, :, None]
        return position + direction * ((z - position[2]) / direction[2])

    def _in_cloud_layer(self, ground: Array, time_s: Array) -> Array:
        """(2, n, pixels) places where the rays to the ground (3, n, pixels) pass through the clouds."""
        position = self.flight.truth.at(time_s).position_l.T[:, :, None]
        share = self.plan.cloud_height
        return ground[:2] + share * (position[:2] - ground[:2])


def imager_of(flight: Flight, seed: int, targets_l: Array | None = None, plan: ImagingPlan | None = None) -> LineImager:
    """An imager over a ground drawn from the seed, with detail for the flight's pixels and targets at (t, 2 or 3)."""
    plan = plan or ImagingPlan()
    texture = ground_texture(stream(seed, "texture"), ground_sample(flight), targets_l, plan.cars_m_s)
    return LineImager(flight, texture, seed, plan)


def ground_sample(flight: Flight) -> float:
    """Size of a pixel on the ground at nadir, in the middle of the first strip, m."""
    times = flight.strip_times_s[0]
    position = flight.truth.at(times.mean()).position_l[0]
    above = position[2] - float(flight.terrain.height(position[0], position[1]))
    return pixel_angle(flight.camera) * float(above)


def _interpolation(pixels: int, step: int) -> tuple[NDArray[np.int64], csr_array]:
    """Pixels at which heights are computed, and the matrix (pixels, nodes) of cubics through four of them."""
    nodes = np.unique(np.append(np.arange(0, pixels - 1, step), pixels - 1)).astype(np.int64)
    if len(nodes) < 4:
        nodes = np.unique(np.linspace(0, pixels - 1, 4).astype(np.int64))
    x = np.arange(pixels)
    taps = min(4, len(nodes))
    first = np.clip(np.searchsorted(nodes, x, side="right") - 2, 0, len(nodes) - taps)
    columns = first[:, None] + np.arange(taps)
    at = nodes[columns].astype(float)
    weight = np.ones((pixels, taps))
    for i in range(taps):
        for j in range(taps):
            if i != j:
                weight[:, i] *= (x - at[:, j]) / (at[:, i] - at[:, j])
    rows = np.repeat(x, taps)
    return nodes, csr_array((weight.ravel(), (rows, columns.ravel())), shape=(pixels, len(nodes)))
