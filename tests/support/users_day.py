"""A flight as a user has it, in files that share no code with the package: rendered and written with NumPy and PROJ.

Geometry stands here once more, from the definitions in the documentation: body axes forward, right, down; roll, pitch
and heading against north, east, down; a perspective camera whose lines lie across the flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio

LON, LAT, GROUND_M = 9.03, 48.1, 520.0
FOCAL_MM, PIXEL_MM, PIXELS = 30.0, 0.03, 280
VIEW_DEG = {"forward": 17.0, "nadir": 0.0, "backward": -17.0}
RATE_HZ, SPEED, HEIGHT_M = 110.0, 60.0, 550.0
START_S = 1_715_938_200  # 2024-05-17T09:30:00Z
TARGET_M = 1.2
#: Undulation of the geoid at 9 deg east, and its slope to the east, m and m per degree.
GEOID_M, GEOID_SLOPE = 47.4, 0.6
OFFSET_M = np.array([0.55, -0.45, 0.6])
SHIFT_DEG = np.array([0.03, -0.025, 0.05])  # roll, pitch, heading

_TOPO = pyproj.Transformer.from_pipeline(
    f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
    f"+step +proj=topocentric +ellps=WGS84 +lon_0={LON} +lat_0={LAT} +h_0={GROUND_M}"
)
_UTM = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)


@dataclass
class Truth:
    """What the files do not say: the ground, its brightness, and where the camera was."""

    seconds: float
    noise: np.ndarray
    targets: np.ndarray

    def height(self, x, y):
        """Of the ground above the plane at the origin, m."""
        return 22.0 * np.sin(x / 170.0 + 0.4) * np.cos(y / 110.0) + 6.0 * np.sin(y / 37.0 + x / 61.0)

    def brightness(self, x, y):
        """Between 0 and 1: random detail of many sizes, and the signals."""
        value = np.full(np.shape(x), 0.45)
        for size, share in ((0.7, 0.10), (1.9, 0.12), (6.1, 0.12), (23.0, 0.12)):
            value = value + share * self._smooth(x / size, y / size)
        for tx, ty in self.targets[:, :2]:
            d = np.hypot(x - tx, y - ty)
            for radius, shade in ((2.2 * TARGET_M, 0.05), (TARGET_M, 0.95)):
                cover = np.clip((radius - d) / 0.35 + 0.5, 0.0, 1.0)
                value = value + cover * (shade - value)
        return value

    def _smooth(self, u, v):
        """Random numbers at whole places, smooth between them."""
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = (s * s * (3 - 2 * s) for s in (u - i, v - j))
        n = self.noise
        k = len(n)
        low = n[i % k, j % k] * (1 - a) + n[(i + 1) % k, j % k] * a
        high = n[i % k, (j + 1) % k] * (1 - a) + n[(i + 1) % k, (j + 1) % k] * a
        return low * (1 - b) + high * b

    def pose(self, t):
        """Position (n, 3) east, north, up of the origin, and roll, pitch, heading (n, 3) against north there."""
        x = SPEED * (t - 0.5 * self.seconds)
        p = np.stack([x, 3.0 * np.sin(t / 3.0), HEIGHT_M + 2.0 * np.sin(t / 4.0)], axis=-1)
        a = [0.35 * np.sin(1.3 * t), 0.3 * np.sin(0.9 * t + 1.0), 90.0 + 0.4 * np.sin(0.5 * t)]
        return p, np.radians(np.stack(a, axis=-1))

    def rays(self, t, view):
        """Directions (n, pixels, 3) in the local axes, and perspective centres (n, 3)."""
        p, (roll, pitch, heading) = self.pose(t)[0], self.pose(t)[1].T
        across = (np.arange(PIXELS) - (PIXELS - 1) / 2) * PIXEL_MM
        along = FOCAL_MM * np.tan(np.radians(VIEW_DEG[view]))
        # image x forward, image y to the left: a point ahead of the camera has a positive x
        body = np.stack([np.full(PIXELS, along), -across, np.full(PIXELS, FOCAL_MM)], axis=-1)
        cr, sr, cp, sp, ch, sh = (f(v) for v in (roll, pitch, heading) for f in (np.cos, np.sin))
        R = np.array([
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [-sp, cp * sr, cp * cr],
        ])  # fmt: skip
        ned = np.einsum("ijn,pj->npi", R, body)
        turn = self.level(p)  # north and plumb line there against those of the origin
        return np.einsum("nij,npj->npi", turn, np.stack([ned[..., 1], ned[..., 0], -ned[..., 2]], axis=-1)), p

    @staticmethod
    def level(p):
        """(n, 3, 3) from east, north, up at places to those of the origin."""
        lon, lat, h = _TOPO.transform(*p.T, direction="INVERSE")
        step = 1e-5
        east, west, high, low = (
            np.stack(_TOPO.transform(lon + a, lat, h + b), axis=-1) for a, b in ((step, 0), (-step, 0), (0, 1), (0, -1))
        )
        east, up = east - west, high - low
        east, up = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (east, up))
        return np.stack([east, np.cross(up, east), up], axis=-1)

    def image(self, view, lines):
        """(lines, pixels) of uint8, as the line sees the ground; with a little noise."""
        out = np.empty((lines, PIXELS))
        for first in range(0, lines, 200):
            t = np.arange(first, min(first + 200, lines)) / RATE_HZ
            d, p = self.rays(t, view)
            z = np.zeros(d.shape[:2])
            for _ in range(12):
                s = (z - p[:, None, 2]) / d[..., 2]
                x, y = p[:, None, 0] + s * d[..., 0], p[:, None, 1] + s * d[..., 1]
                z = self.height(x, y)
            out[first : first + 200] = self.brightness(x, y)
        noise = np.random.default_rng(7).normal(0.0, 0.006, out.shape)
        return np.clip(np.rint(235 * (out + noise)), 1, 255).astype(np.uint8)


def geoid(lon):
    return GEOID_M + GEOID_SLOPE * (lon - 9.0)


def to_utm(xyz):
    """Easting, northing, height above the geoid of places in the local axes."""
    lon, lat, h = _TOPO.transform(*np.asarray(xyz).T, direction="INVERSE")
    e, n = _UTM.transform(lon, lat)
    return np.stack([e, n, h - geoid(lon)], axis=-1)


def write_files(folder: Path, seconds: float = 14.0) -> Truth:
    """The files of a flight, and next to them, in ``proj``, the geoid that PROJ wants for EPSG:5773."""
    rng = np.random.default_rng(11)
    half = 0.5 * SPEED * seconds - 210.0
    targets = np.array([(x, y) for x in np.linspace(-half, half, 4) for y in (-50.0, 50.0)])
    truth = Truth(seconds, rng.uniform(-1, 1, (701, 701)), targets)
    folder.mkdir(parents=True, exist_ok=True)
    lines = int(seconds * RATE_HZ)
    for view in VIEW_DEG:
        pixels = truth.image(view, lines)
        (folder / f"{view}.img").write_bytes(pixels.tobytes())
        (folder / f"{view}.hdr").write_text(
            f"ENVI\nsamples = {PIXELS}\nlines = {lines}\nbands = 1\nheader offset = 0\ndata type = 1\n"
            "interleave = bil\nbyte order = 0\n"
        )
    _write_poses(folder / "navigation.csv", truth, rng)
    _write_control(folder / "control.csv", truth, rng)
    _write_dem(folder / "ground.tif", truth)
    _write_camera(folder / "camera.json")
    _write_geoid(folder / "proj")
    return truth


def _write_poses(path: Path, truth: Truth, rng) -> None:
    t = np.arange(-0.5, truth.seconds + 0.5, 0.01)
    p, angles = truth.pose(t)
    p = p + OFFSET_M + rng.normal(0, 0.01, p.shape)
    degrees = np.degrees(angles) + SHIFT_DEG + rng.normal(0, 0.001, p.shape)
    lon, lat, h = _TOPO.transform(*p.T, direction="INVERSE")
    with open(path, "w") as file:
        file.write("time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n")
        for k in range(len(t)):
            attitude = ",".join(f"{v:.6f}" for v in degrees[k])
            file.write(f"{START_S + t[k]:.4f},{lat[k]:.11f},{lon[k]:.11f},{h[k]:.4f},{attitude}\n")


def _write_control(path: Path, truth: Truth, rng) -> None:
    x, y = truth.targets.T
    places = to_utm(np.stack([x, y, truth.height(x, y)], axis=-1)) + rng.normal(0, 0.01, (len(x), 3))
    with open(path, "w") as file:
        file.write("point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role,target_radius_m\n")
        for k, (e, n, z) in enumerate(places):
            file.write(f"G{k + 1},{e:.4f},{n:.4f},{z:.4f},0.01,0.01,0.01,control,{TARGET_M}\n")


def _write_dem(path: Path, truth: Truth) -> None:
    e0, n0 = _UTM.transform(LON, LAT)
    step, reach = 4.0, 0.5 * SPEED * truth.seconds + 320.0
    e, n = np.meshgrid(e0 + np.arange(-reach, reach, step), n0 - np.arange(-300.0, 300.0, step))
    lon, lat = _UTM.transform(e, n, direction="INVERSE")
    h = np.full(e.shape, GROUND_M)
    for _ in range(4):
        x, y, z = _TOPO.transform(lon, lat, h)
        h = h + truth.height(x, y) - z
    profile = {"driver": "GTiff", "height": e.shape[0], "width": e.shape[1], "count": 1, "dtype": "float32"}
    transform = rasterio.Affine(step, 0, e[0, 0] - step / 2, 0, -step, n[0, 0] + step / 2)
    with rasterio.open(path, "w", crs="EPSG:32632", transform=transform, **profile) as target:
        target.write((h - geoid(lon)).astype(np.float32), 1)


def _write_camera(path: Path) -> None:
    along = {view[0].upper(): FOCAL_MM * float(np.tan(np.radians(deg))) for view, deg in VIEW_DEG.items()}
    lines = ", ".join(
        f'{{"id": "{id}", "lens": "L1", "pixels": {PIXELS}, "pixel_size_mm": {PIXEL_MM}, "center_mm": [{x:.9f}, 0]}}'
        for id, x in along.items()
    )
    lens = f'{{"id": "L1", "focal_length_mm": {FOCAL_MM}, "principal_point_mm": [0, 0]}}'
    path.write_text(f'{{"name": "three views", "lenses": [{lens}], "lines": [{lines}]}}\n')


def _write_geoid(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    lon = np.arange(-180.0, 180.5, 0.5)
    z = np.tile(geoid(lon), (len(np.arange(90.0, -90.5, -0.5)), 1)).astype(np.float32)
    transform = rasterio.Affine(0.5, 0, -180.25, 0, -0.5, 90.25)
    profile = {"driver": "GTiff", "height": z.shape[0], "width": z.shape[1], "count": 1, "dtype": "float32"}
    with rasterio.open(folder / "us_nga_egm96_15.tif", "w", crs="EPSG:4979", transform=transform, **profile) as target:
        target.write(z, 1)
        target.set_band_description(1, "geoid_undulation")
        target.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
