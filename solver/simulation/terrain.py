"""Smooth relief that follows the curvature of the Earth, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

EARTH_RADIUS_M = 6.371e6
#: Newton's steps of `Terrain.met`, and how small the last must be (it leaves an error of about its square), m.
NEWTON_STEPS, MET_M = 3, 0.05
#: Steps of the search from above along rays that the relief may be as steep as, and rays that are searched at once.
#: Tuned: the shortest waves of a relief take several steps.
SEARCH_STEPS, SEARCHED_TOGETHER = 256, 256


@dataclass(frozen=True)
class Terrain:
    """Ground height as a sum of plane waves, longer ones higher, in the local frame.

    Attributes
    ----------
    height_m : mean height above the local origin
    wave_vector : (w, 2) rad/m
    phase : (w,) rad
    amplitude_m : (w,)
    """

    height_m: float
    wave_vector: Array = field(repr=False)
    phase: Array = field(repr=False)
    amplitude_m: Array = field(repr=False)

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Local Z of the ground below X, Y (...), metres."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        z = self.height_m - (x * x + y * y) / (2.0 * EARTH_RADIUS_M)
        for k, phase, amplitude in zip(self.wave_vector, self.phase, self.amplitude_m, strict=True):
            z = z + amplitude * np.sin(k[0] * x + k[1] * y + phase)
        return z

    def intersect(self, position_l: ArrayLike, direction_l: ArrayLike, tolerance_m: float = 1e-9) -> Array:
        """Ground points (n, 3) of rays from positions (n, 3) downward along directions (n, 3).

        Heights are found to ``tolerance_m``, from height to height along the ray; where the relief is as steep as the
        ray, by a search from above.

        Raises
        ------
        ValueError : a ray that does not come down to the ground
        """
        origin, d = np.asarray(position_l, dtype=float), np.asarray(direction_l, dtype=float)
        slope = d[:, :2] / d[:, 2:]
        z = np.full(len(origin), self.height_m)
        step = np.full(len(origin), np.inf)
        for _ in range(60):
            xy = origin[:, :2] + slope * (z - origin[:, 2])[:, None]
            step = self.height(xy[:, 0], xy[:, 1]) - z
            z = z + step
            if np.abs(step).max(initial=0.0) < tolerance_m:
                break
        down = d[:, 2] < 0
        steep = np.flatnonzero(down & ~(np.abs(step) < tolerance_m))
        z[steep] = self._first(origin[steep], slope[steep])
        lost = ~np.isfinite(z)
        if lost.any() or not down.all():
            raise ValueError(f"{int((lost | ~down).sum())} rays do not come down to the ground")
        xy = origin[:, :2] + slope * (z - origin[:, 2])[:, None]
        return np.column_stack([xy, z])

    def _first(self, origin: Array, slope: Array) -> Array:
        """Heights (n,) at which rays first meet the ground, NaN where they do not: steps from above, then halving."""
        relief = float(np.abs(self.amplitude_m).sum())
        xy = origin[:, :2] + slope * (self.height_m - origin[:, 2])[:, None]
        bend = (xy**2).sum(axis=1) / EARTH_RADIUS_M  # twice as far down as the Earth is bent there
        begin = np.minimum(self.height_m + relief, origin[:, 2])
        end = self.height_m - relief - bend
        out = np.full(len(origin), np.nan)
        for k in range(0, len(out), SEARCHED_TOGETHER):
            some = slice(k, k + SEARCHED_TOGETHER)
            z = np.linspace(begin[some], end[some], SEARCH_STEPS + 1, axis=1)
            met = self._under(origin[some], slope[some], z)
            first = np.argmax(met, axis=1)
            rays = np.flatnonzero(met.any(axis=1) & (first > 0))  # the others begin below the ground
            low, high = z[rays, first[rays]], z[rays, first[rays] - 1]
            for _ in range(60):
                middle = 0.5 * (low + high)
                met = self._under(origin[some][rays], slope[some][rays], middle[:, None])[:, 0]
                low, high = np.where(met, middle, low), np.where(met, high, middle)
            out[k + rays] = low
        return out

    def _under(self, origin: Array, slope: Array, z: Array) -> NDArray[np.bool_]:
        """Whether rays (n) are under the ground at heights (n, k)."""
        x, y = (origin[:, i, None] + slope[:, i, None] * (z - origin[:, 2:]) for i in range(2))
        return np.asarray(self.height(x, y) >= z)

    def met(self, position_l: Array, direction_l: Array) -> Array:
        """Heights (n,) at which rays from positions (n, 3) along directions (n, 3) meet the ground, to 0.1 mm.

        Newton's steps from mean height with the waves in single precision: for images, five times as fast as
        `intersect`, which takes over where the relief is too steep for that.

        Raises
        ------
        ValueError : a ray that does not come down to the ground
        """
        slope = (direction_l[:, :2] / direction_l[:, 2:]).T
        x, y, top = position_l.T
        z = np.full(len(top), self.height_m)
        step = np.full(len(top), np.inf)
        along = self.wave_vector @ slope
        base = self.wave_vector @ (position_l[:, :2].T - slope * top) + self.phase[:, None]
        amplitude = self.amplitude_m.astype(np.float32)
        turn = 2 * np.pi
        for _ in range(NEWTON_STEPS):
            phase = base + along * z
            phase -= turn * np.rint(phase / turn)
            phase = phase.astype(np.float32)
            px, py = x + slope[0] * (z - top), y + slope[1] * (z - top)
            height = self.height_m - (px * px + py * py) / (2.0 * EARTH_RADIUS_M) + amplitude @ np.sin(phase)
            rise = np.einsum("w,wn,wn->n", self.amplitude_m, along, np.cos(phase))
            step = (height - z) / (1.0 - rise)
            z = z + step
        left = np.flatnonzero(~(np.abs(step) < MET_M) | ~(direction_l[:, 2] < 0))
        if len(left):
            z[left] = self.intersect(position_l[left], direction_l[left], 1e-5)[:, 2]
        return z


def fractal_terrain(
    rng: np.random.Generator,
    height_m: float = 0.0,
    amplitude_m: float = 75.0,
    longest_m: float = 6000.0,
    waves: int = 20,
) -> Terrain:
    """A relief whose heights stay mostly within ``+-amplitude_m`` of ``height_m``.

    Wavelengths run from ``longest_m`` down to a fortieth of it; the amplitude of a wave is proportional to its
    length, so that slopes are alike at all scales.

    Raises
    ------
    ValueError : a negative amplitude
    """
    if amplitude_m < 0:
        raise ValueError(f"terrain amplitude must not be negative, got {amplitude_m} m")
    length = longest_m * np.geomspace(1.0, 1.0 / 40.0, waves)
    azimuth = rng.uniform(0.0, 2 * np.pi, waves)
    k = (2 * np.pi / length)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    # half the amplitude as standard deviation
    amplitude = length * (amplitude_m / 2.0) / np.sqrt(0.5 * np.sum(length**2))
    return Terrain(height_m, k, rng.uniform(0.0, 2 * np.pi, waves), amplitude)
