"""What the simulated ground looks like: fields, woods, water, roads, targets, and fractal detail on all of it.

The ground is a function of position that is evaluated anywhere without being stored: three hash tables decide the
parcels, four periodic tiles of noise, each turned and scaled in its own way, give detail from two pixels to some
hundred. Everything is blurred by the footprint of a pixel where it is evaluated: noise in its spectrum, edges of
tracks, roads and targets as a straight edge under a Gaussian. So an image needs
one sample a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf, ndtri

Array = NDArray[np.floating]
Float32 = NDArray[np.floating]

#: Standard deviation of the point spread, in pixels: detector, motion during a line, and optics (MTF 0.29 at Nyquist).
PSF_SIGMA_PX = 0.5
#: Noise tiles: samples a side, how many, texel of the finest in pixels, and from one to the next.
TILE, TILES, FINEST_TEXEL, TILE_STEP = 512, 4, 0.5, 4.0
#: Wavelengths in a tile, texels.
WAVELENGTHS = (4.0, 16.0)
#: Standard deviation of reflectance from each tile, finest first.
TILE_SIGMA = (0.035, 0.035, 0.03, 0.03)
#: Kinds of ground: share of the parcels, darkest and brightest reflectance, contrast of the detail, and how much of the
#: fine detail looks different from every direction (tree crowns, waves).
KINDS: dict[str, tuple[float, float, float, float, float]] = {
    "field": (0.62, 0.25, 0.55, 1.0, 0.0),
    "built": (0.16, 0.30, 0.45, 1.8, 0.1),
    "wood": (0.15, 0.12, 0.20, 1.2, 0.6),
    "water": (0.07, 0.04, 0.06, 0.12, 1.0),
}
_KEYS = 1024
TRACK_REFLECTANCE, ROAD_REFLECTANCE, CAR_REFLECTANCE = 0.5, 0.62, 0.9
#: Clouds: reflectance, texel of the larger of their two tiles in pixels, and width of their rim (standard deviations).
CLOUD_REFLECTANCE, CLOUD_TEXEL, CLOUD_RIM = 0.95, 48.0, 0.5
#: A signalised target: white disc in a black ring, reflectances.
TARGET_WHITE, TARGET_BLACK, TARGET_RING = 0.9, 0.05, 2.2


@dataclass(frozen=True)
class Roads:
    """Straight parallel roads with cars on them.

    Attributes
    ----------
    azimuth_rad : of the direction across the roads, from X to Y
    spacing_m : mean distance
    shift : (_KEYS,) of each road from its regular place, share of the spacing (+-0.3)
    width_m : of a road
    car_spacing_m, car_speed_m_s : along a road; speed 0 for none
    """

    azimuth_rad: float
    spacing_m: float
    shift: Array = field(repr=False)
    width_m: float
    car_spacing_m: float = 400.0
    car_speed_m_s: float = 0.0

    def place(self, x: Array, y: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Signed distance to the nearest road (m), distance along it (m), and its number."""
        c, s = np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)
        across = c * x + s * y
        number = np.floor(across / self.spacing_m).astype(np.int64)
        middle = (number + 0.5 + self.shift[number % _KEYS]) * self.spacing_m
        return across - middle, c * y - s * x, number


@dataclass(frozen=True)
class GroundTexture:
    """Reflectance of the ground; made by `ground_texture`.

    Attributes
    ----------
    detail_m : what it is made for: the size of a pixel on the ground
    tiles : (TILES, TILE, TILE) spectra of the noise
    turn : (TILES,) direction of each tile, rad
    parcel_azimuth_rad, parcel_m : direction and size of the parcels
    reflectance, contrast, unsteady : (_KEYS,) of parcels
    scatter : (2, _KEYS) width of the parcels of a row and their shift
    order : (_KEYS,) shuffles the keys
    roads : families of roads
    targets_l : (t, 2) X, Y of signalised targets
    target_radius_m : of the white disc
    """

    detail_m: float
    tiles: NDArray[np.complexfloating] = field(repr=False)
    turn: Array
    parcel_azimuth_rad: float
    parcel_m: tuple[float, float]
    reflectance: Float32 = field(repr=False)
    contrast: Float32 = field(repr=False)
    unsteady: Float32 = field(repr=False)
    scatter: Array = field(repr=False)
    order: NDArray[np.int64] = field(repr=False)
    roads: tuple[Roads, ...]
    targets_l: Array
    target_radius_m: float

    def seen_by(self, footprint_m: float) -> SeenTexture:
        """The texture as pixels of a footprint (m, square) see it.

        Raises
        ------
        ValueError : a footprint that is not positive
        """
        if not footprint_m > 0:
            raise ValueError(f"footprint of {footprint_m} m, wanted more than 0")
        return SeenTexture(self, footprint_m)


class SeenTexture:
    """A texture blurred by the footprint of a pixel."""

    def __init__(self, texture: GroundTexture, footprint_m: float):
        self.texture = texture
        self.sigma_m = PSF_SIGMA_PX * footprint_m
        f = np.fft.fftfreq(TILE)[:, None] ** 2 + np.fft.rfftfreq(TILE)[None, :] ** 2
        self._tiles = []
        for level, spectrum in enumerate(texture.tiles):
            sigma = self.sigma_m / _texel(texture.detail_m, level)
            tile = np.fft.irfft2(spectrum * np.exp(-2 * np.pi**2 * sigma**2 * f), (TILE, TILE))
            self._tiles.append(tile.astype(np.float32))

    def reflectance(self, x: Array, y: Array, time_s: Array | float = 0.0, look: int = 0) -> Float32:
        """Reflectance (0 .. 1) at ground positions.

        Parameters
        ----------
        x, y : (...) m, local frame
        time_s : (...) or one, for what moves
        look : number of the direction it is seen from, for what looks different from each
        """
        t = self.texture
        shape = x.shape
        x, y = np.ravel(x), np.ravel(y)
        key, edge = self._parcels(x, y)
        coarse = self._noise(2, x, y) + self._noise(3, x, y)
        fine = self._noise(0, x, y) + self._noise(1, x, y)
        unsteady = t.unsteady[key]
        moving = np.flatnonzero(unsteady > 0)
        if len(moving):
            dx, dy = (37.0 + 61.7 * look) * t.detail_m, (91.0 - 43.3 * look) * t.detail_m
            other = self._noise(0, x[moving] + dx, y[moving] + dy) + self._noise(1, x[moving] + dx, y[moving] + dy)
            share = unsteady[moving]
            fine[moving] = (1 - share) * fine[moving] + share * other
        value = t.reflectance[key] + t.contrast[key] * (fine + coarse)
        # tracks along the parcels hide where one colour jumps to the next
        track = self._band(edge, 4.0 * t.detail_m)
        value += track * (np.float32(TRACK_REFLECTANCE) + fine - value)
        for roads in t.roads:
            self._draw_roads(value, roads, x, y, np.broadcast_to(np.asarray(time_s, dtype=float), shape).ravel())
        self._draw_targets(value, x, y)
        return np.clip(value, 0.0, 1.0).reshape(shape)

    def clouds(self, x: Array, y: Array, share: float) -> Float32:
        """How much of the light from below clouds keep (0 .. 1), at places (...) in their layer; they cover a share."""
        shape = x.shape
        x, y = np.ravel(x), np.ravel(y)
        grown = CLOUD_TEXEL / (FINEST_TEXEL * TILE_STEP**3)
        value = self._noise(3, x, y, grown) / TILE_SIGMA[3] + 0.25 * self._noise(2, x, y, grown) / TILE_SIGMA[2]
        rim = float(ndtri(1.0 - share)) * np.hypot(1.0, 0.25)
        return np.clip((value - np.float32(rim)) / np.float32(CLOUD_RIM), 0.0, 1.0).reshape(shape)

    def _noise(self, level: int, x: Array, y: Array, grown: float = 1.0) -> Float32:
        """Bilinear in a periodic tile, ``grown`` times as large as usual."""
        texel = grown * _texel(self.texture.detail_m, level)
        c, s = np.cos(self.texture.turn[level]) / texel, np.sin(self.texture.turn[level]) / texel
        u, v = c * x + s * y, c * y - s * x
        i, j = np.floor(u), np.floor(v)
        a, b = (u - i).astype(np.float32), (v - j).astype(np.float32)
        i, j = i.astype(np.int32), j.astype(np.int32)
        i0, j0 = (i & (TILE - 1)) * TILE, j & (TILE - 1)
        i1, j1 = ((i + 1) & (TILE - 1)) * TILE, (j + 1) & (TILE - 1)
        flat = self._tiles[level].ravel()
        low = flat[i0 + j0]
        low += b * (flat[i0 + j1] - low)
        high = flat[i1 + j0]
        high += b * (flat[i1 + j1] - high)
        return low + a * (high - low)

    def _parcels(self, x: Array, y: Array) -> tuple[NDArray[np.int64], Float32]:
        """Key of each place's parcel, and the distance to the nearest edge, m."""
        t = self.texture
        c, s = np.cos(t.parcel_azimuth_rad), np.sin(t.parcel_azimuth_rad)
        width, depth = t.parcel_m
        u, v = (c * x + s * y) / width, (c * y - s * x) / depth
        row = np.floor(v)
        r = row.astype(np.int64) % _KEYS
        scale = t.scatter[0][r]
        u = u / scale + t.scatter[1][r]
        column = np.floor(u)
        key = t.order[(column.astype(np.int64) + t.order[r]) % _KEYS]
        a, b = u - column, v - row
        edge = np.minimum(np.minimum(a, 1 - a) * scale * width, np.minimum(b, 1 - b) * depth)
        return key, edge.astype(np.float32)

    def _band(self, distance: Array, width_m: float) -> Float32:
        """How much of the footprint a straight band covers, from the distance to its middle."""
        scale = 1.0 / (np.sqrt(2.0) * self.sigma_m)
        near = np.flatnonzero(np.abs(distance) < 0.5 * width_m + 4 * self.sigma_m)
        cover = np.zeros(distance.shape, dtype=np.float32)
        d = distance[near]
        cover[near] = 0.5 * (erf((0.5 * width_m - d) * scale) + erf((0.5 * width_m + d) * scale))
        return cover

    def _draw_roads(self, value: Float32, roads: Roads, x: Array, y: Array, time_s: Array) -> None:
        across, along, number = roads.place(x, y)
        cover = self._band(across, roads.width_m)
        on = np.flatnonzero(cover > 0)
        value[on] += cover[on] * (np.float32(ROAD_REFLECTANCE) - value[on])
        if not roads.car_speed_m_s or not len(on):
            return
        ahead = along[on] - roads.car_speed_m_s * time_s[on] * np.where(number[on] % 2 == 0, 1.0, -1.0)
        ahead = (ahead + 997.0 * number[on]) % roads.car_spacing_m - 0.5 * roads.car_spacing_m
        car = self._band(ahead, 2.0 * roads.width_m) * self._band(across[on], 0.5 * roads.width_m)
        value[on] += car * (np.float32(CAR_REFLECTANCE) - value[on])

    def _draw_targets(self, value: Float32, x: Array, y: Array) -> None:
        t = self.texture
        if not len(t.targets_l) or not len(x):
            return
        reach = TARGET_RING * t.target_radius_m + 4 * self.sigma_m
        low, high = np.array([x.min(), y.min()]) - reach, np.array([x.max(), y.max()]) + reach
        for tx, ty in t.targets_l[((t.targets_l >= low) & (t.targets_l <= high)).all(axis=1)]:
            near = np.flatnonzero((np.abs(x - tx) < reach) & (np.abs(y - ty) < reach))
            distance = np.hypot(x[near] - tx, y[near] - ty)
            for radius, shade in ((TARGET_RING * t.target_radius_m, TARGET_BLACK), (t.target_radius_m, TARGET_WHITE)):
                cover = 0.5 * (1 + erf((radius - distance) / (np.sqrt(2.0) * self.sigma_m)))
                value[near] += (cover * (shade - value[near])).astype(np.float32)


def _texel(detail_m: float, level: int) -> float:
    return detail_m * FINEST_TEXEL * TILE_STEP**level


def ground_texture(
    rng: np.random.Generator, detail_m: float, targets_l: Array | None = None, car_speed_m_s: float = 0.0
) -> GroundTexture:
    """A ground for pixels of ``detail_m``, with signalised targets at ``targets_l`` (t, 2 or 3) and cars, or none.

    Raises
    ------
    ValueError : a detail that is not positive
    """
    if not detail_m > 0:
        raise ValueError(f"texture detail of {detail_m} m, wanted more than 0")
    f = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None, :])
    longest, shortest = 1.0 / WAVELENGTHS[1], 1.0 / WAVELENGTHS[0]
    band = (f >= longest) & (f <= shortest)
    amplitude = np.where(band, 1.0 / np.where(f > 0, f, 1.0), 0.0)  # each octave as strong as the next
    tiles = []
    for sigma in TILE_SIGMA:
        spectrum = amplitude * np.fft.rfft2(rng.standard_normal((TILE, TILE)))
        tiles.append(spectrum * (sigma / np.fft.irfft2(spectrum, (TILE, TILE)).std()))
    kinds = np.array(list(KINDS.values()))
    kind = rng.choice(len(kinds), _KEYS, p=kinds[:, 0])
    _, darkest, brightest, contrast, unsteady = kinds[kind].T
    shift = rng.uniform(-0.3, 0.3, (2, _KEYS))
    azimuth, turned = rng.uniform(0, np.pi), rng.uniform(0.3, 1.2)
    roads = tuple(
        Roads(azimuth + k * turned, spacing, shift[k], 5.0 * detail_m, car_speed_m_s=car_speed_m_s)
        for k, spacing in enumerate((350 * detail_m, 520 * detail_m))
    )
    targets = np.empty((0, 2)) if targets_l is None else np.asarray(targets_l, dtype=float)[:, :2]
    return GroundTexture(
        detail_m=detail_m,
        tiles=np.array(tiles),
        turn=rng.uniform(0, 2 * np.pi, TILES),
        parcel_azimuth_rad=float(rng.uniform(0, np.pi)),
        parcel_m=(110 * detail_m, 70 * detail_m),
        reflectance=rng.uniform(darkest, brightest).astype(np.float32),
        contrast=contrast.astype(np.float32),
        unsteady=unsteady.astype(np.float32),
        scatter=np.stack([rng.uniform(0.6, 1.6, _KEYS), rng.uniform(0, 1, _KEYS)]),
        order=rng.permutation(_KEYS),
        roads=roads,
        targets_l=targets,
        target_radius_m=2.0 * detail_m,
    )
