"""Orthoimage on line: lines a second on one core beside GDAL, and how straight roads come out, before and after.

    python bench/orthoimage.py [--lines 3000] [--seeds 2] [--rate-only]

Rate: 4 000 pixels a line, real line orientations with the jitter of an unstabilised mount, a strip that runs askew to
the map grid; rays to the relief, projection, inverse, resampling and the mosaic are all in it. GDAL warps the same
pixels over the same ground from geolocation arrays (the ground position of every pixel, whose computation is not
counted), one thread. Times are of one core (process time).

Straightness: a rough flight (three times the turbulence; attitude that wanders by 0.3 deg and position by 2 m, within
15 s) is simulated with image lines, triangulated from these lines alone (navigator, matcher, adjuster), and rectified
with the measured, the live, the final and the true orientation on the true relief. The centre lines of the roads are
then measured in the orthoimages and compared with the straight lines they are. What the true orientation leaves is the
noise of that measurement. Beside it the ground error of the orientation itself.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import frame
import numpy as np

from triline.nodes.batch import rectification as work
from triline.nodes.batch.strip_orientation import orientation_of
from triline.nodes.cli import main as triline
from triline.nodes.recording.access import Recording
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.orthoimage.ground_grid import GroundGrid, utm_of
from triline.solver.orthoimage.mosaic import Mosaic
from triline.solver.orthoimage.strip import StripRectifier, rays_of
from triline.solver.orthoimage.surface import HeightField
from triline.solver.simulation.imagery import ground_sample
from triline.solver.simulation.road_check import find_roads

PIXELS = 4000
WANTED_LINES_S, WANTED_BEFORE_PX, WANTED_AFTER_PX = 800.0, 3.0, 0.3
ROUGH = {
    "sensor": "ads40-small", "images": True, "seconds": 60.0, "turbulence": 3.0, "wander_attitude": (0.3,) * 3,
    "wander": (2.0,) * 3, "wander_time": 15.0, "control": 8, "check": 4,
}  # fmt: skip


def relief(flight, step: float = 10.0, reach: float = 2500.0) -> HeightField:
    """The true relief under a flight, bilinear between nodes."""
    low, high = (f(flight.truth.position_l[:, :2], axis=0) for f in (np.min, np.max))
    x = np.arange(low[0] - reach, high[0] + reach, step)
    y = np.arange(low[1] - reach, high[1] + reach, step)
    return HeightField(float(x[0]), float(y[0]), step, flight.terrain.height(*np.meshgrid(x, y)))


def rate(lines: int) -> bool:
    settings = {"sensor": "ads40", "pixels": PIXELS, "images": True, "unstabilised": True, "heading": 30.0, "seed": 1}
    simulated = simulated_flight({**settings, "seconds": lines / 150.0 + 1})
    flight = simulated.simulation.flight
    strip, camera = flight.strips[0], flight.camera
    ccd = camera.line_index["N"]
    poses = flight.truth.at(strip.time_of(np.arange(lines)))
    position, R = poses.position_l, poses.R_lc
    field = relief(flight)
    grid = GroundGrid(replace(flight.frame, crs=utm_of(flight.frame)), round(ground_sample(flight), 2))
    image = np.random.default_rng(1).integers(100, 4000, (lines, PIXELS), dtype=np.uint16)
    print(f"{lines} lines of {PIXELS} px, cells of {grid.gsd} m, heading 30 deg, relief +-75 m")
    ours = {}
    for method in ("nearest", "bilinear", "cubic"):
        best, longest = np.inf, 0.0
        for _ in range(3):
            begun = time.process_time()
            rectifier, mosaic, longest = StripRectifier(rays_of(camera, ccd), field, grid, method), Mosaic(), 0.0
            for a in range(0, lines, 64):
                block = time.process_time()
                for patch in rectifier.add(a, image[a : a + 64], None, position[a : a + 64], R[a : a + 64]):
                    mosaic.add(patch)
                longest = max(longest, time.process_time() - block)
            for patch in rectifier.finish():
                mosaic.add(patch)
            best = min(best, time.process_time() - begun)
        ours[method] = lines / best
        print(f"  triline, {method:<8} {lines / best:7.0f} lines/s; longest block of 64 lines {1e3 * longest:.0f} ms")
    for method in ("nearest", "bilinear", "cubic"):
        peer = lines / gdal(image, camera, ccd, position, R, field, grid, method)
        print(f"  GDAL warp, {method:<8} {peer:5.0f} lines/s; triline is {ours[method] / peer:.1f} times as fast")
    good = ours["bilinear"] >= WANTED_LINES_S
    print(f"  {'met' if good else 'NOT MET'}: {ours['bilinear']:.0f} lines/s, wanted {WANTED_LINES_S:.0f} (bilinear)")
    return good


def gdal(image, camera, ccd: int, position, R, field: HeightField, grid: GroundGrid, method: str) -> float:
    """Seconds that GDAL takes for the same orthoimage."""
    from rasterio.crs import CRS
    from rasterio.transform import Affine
    from rasterio.warp import Resampling, reproject

    rays = rays_of(camera, ccd, step=8)
    inner = (rays.sample >= 0) & (rays.sample <= PIXELS - 1)
    x, y = np.empty(image.shape), np.empty(image.shape)
    for a in range(0, len(image), 100):
        part = slice(a, min(a + 100, len(image)))
        point, _ = field.meet(position[part, None], rays.ray_c[inner] @ np.swapaxes(R[part], 1, 2))
        xyz = grid.frame.to_crs(point)
        for i in range(part.start, part.stop):
            x[i] = np.interp(np.arange(PIXELS), rays.sample[inner], xyz[i - a, :, 0])
            y[i] = np.interp(np.arange(PIXELS), rays.sample[inner], xyz[i - a, :, 1])
    west, north = np.floor(x.min() / grid.gsd) * grid.gsd, np.ceil(y.max() / grid.gsd) * grid.gsd
    shape = int((north - y.min()) / grid.gsd) + 1, int((x.max() - west) / grid.gsd) + 1
    target, crs = np.zeros(shape, dtype=np.uint16), CRS.from_user_input(grid.frame.crs)
    begun = time.process_time()
    reproject(
        image, target, src_geoloc_array=np.stack([x, y]), src_crs=crs, dst_crs=crs, dst_nodata=0, num_threads=1,
        dst_transform=Affine(grid.gsd, 0, west, 0, -grid.gsd, north), resampling=Resampling[method],
    )  # fmt: skip
    seconds = time.process_time() - begun
    if (target > 0).sum() < 0.5 * image.size:
        raise RuntimeError("GDAL rectified less than half of the image")
    return seconds


def straightness(seed: int, folder: Path) -> dict[str, tuple[float, float, float]]:
    """Orientation -> offset of roads from the truth, from their own straight lines, and ground error; RMS, px."""
    settings = {**ROUGH, "seed": seed}
    raw, processed = folder / f"rough-{seed}.mcap", folder / f"rough-{seed}-out.mcap"
    options = []
    for name, value in settings.items():
        values = value if isinstance(value, tuple) else (value,)
        options += [f"--{name.replace('_', '-')}", *(() if value is True else map(str, values))]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        if triline(["simulate", "-o", str(raw), *options, "-q"]):
            raise RuntimeError("the flight was not simulated")
        if triline(["process", str(raw), "-o", str(processed), "--nodes", "navigator,matcher,adjuster", "-q"]):
            raise RuntimeError("the flight was not processed")
    raw.unlink()
    simulated = simulated_flight(settings)
    flight, imager = simulated.simulation.flight, simulated.imager
    assert imager is not None
    recording = Recording(processed)
    camera = recording.camera()
    ccd = camera.line_index["N"]
    frame = recording.frame()
    grid = GroundGrid(work.frame_for(frame, utm_of(frame)), round(ground_sample(flight), 2))
    field, rays = relief(flight), rays_of(camera, ccd)
    _, true_orientation, reference_ns = orientation_of(recording, "truth")
    strip = recording.strips().iloc[0]
    line_ns = int(strip.first_line_time_ns) + np.arange(0, int(strip.lines), 5) * 1e9 / strip.line_rate_hz

    def ground(orientation, reference_ns: int):
        time_s = (line_ns - reference_ns) * 1e-9
        known = orientation.covers(time_s)
        position, R = orientation.at(np.where(known, time_s, time_s[known][0]))
        point, _ = field.meet(position[:, None], rays.ray_c @ np.swapaxes(R, 1, 2))
        return np.where(known[:, None, None], point[..., :2], np.nan)

    truth = ground(true_orientation, reference_ns)
    result = {}
    for name in ("measured", "live", "final", "truth"):
        _, orientation, reference_ns = orientation_of(recording, name)
        job = work.Rectification(camera, ccd, field, grid, "bilinear", lambda _, it=orientation: it, reference_ns)
        for block in work.line_blocks(recording, "N", None):
            job.add(block)
        done = job.finish()
        assert done is not None
        roads = find_roads(done.mosaic, grid, imager.texture, flight.terrain, reach=18.0)
        error = (ground(orientation, reference_ns) - truth) / grid.gsd
        result[name] = roads.rms(), roads.wiggle(), float(np.sqrt(np.nanmean(error**2)))
        print(
            f"  seed {seed}, {name:<8} roads off by {result[name][0]:6.3f} px RMS ({len(roads.road)} places on "
            f"{len(np.unique(roads.road))} roads), from their own straight lines {result[name][1]:6.3f} px; "
            f"ground error {result[name][2]:6.3f} px a coordinate",
            flush=True,
        )
    return result


def main() -> int:
    parser = frame.parser(__doc__, seeds=2)
    parser.add_argument("--lines", type=int, default=3000)
    parser.add_argument("--rate-only", action="store_true")
    args = parser.parse_args()
    good = rate(args.lines)
    if not args.rate_only:
        print("rough flight, image lines alone:")
        with tempfile.TemporaryDirectory() as folder:
            results = [straightness(seed, Path(folder)) for seed in range(1, args.seeds + 1)]
        for seed, result in enumerate(results, start=1):
            before, after = result["measured"][0], result["final"][0]
            met = before > WANTED_BEFORE_PX and after < WANTED_AFTER_PX
            good &= met
            print(
                f"  {'met' if met else 'NOT MET'}, seed {seed}: roads off by {before:.2f} px before and {after:.2f} px "
                f"after, wanted above {WANTED_BEFORE_PX:g} and below {WANTED_AFTER_PX:g}"
            )
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
