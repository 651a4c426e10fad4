"""Rectification of images: a strip beside GDAL's RPC warp, and two looks at Mont Ventoux on each other.

    python bench/rectification.py [--lines 40000] [--samples 12000] [--workers N] [--keep FOLDER]

Speed: a strip of 16-bit pixels of a simulated satellite over waves of 1 000 m (heights every 30 m), by its RPC,
bilinear, to cells as large as a pixel. triline and GDAL's warp (rasterio, as many threads) start from the same file,
polynomials and heights, and write the same cells to a tiled GeoTIFF without compression. triline asks the polynomials
exactly, GDAL interpolates places to an eighth of a pixel. The command ``triline rectify`` beside them also makes
overviews and compresses. Mpx/s are cells of the orthoimage, by the clock, and a second of processor time of all
threads; memory is the most that the process held. Each runs in a process of its own.

Ventoux: median offset between the two orthoimages in pixels of 0.5 m, by RPC alone and after an affine correction from
half of the matches; *of vectors* (a shift of the whole), *across* the direction in which errors of the heights move the
looks apart, and of the *lengths*, which are mostly errors of SRTM's heights: a metre moves them apart by ``base``.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import frame
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))

VENTOUX = ROOT.parent / "shared" / "data" / "satellites" / "phr_ventoux"
WANTED_MPX_S, WANTED_MB, WANTED_PX = 30.0, 1000.0, 0.5


def make_scene(folder: Path, lines: int, samples: int) -> dict[str, str]:
    """Image with texture, RPC and heights of a strip."""
    import rasterio
    from relief import Waves
    from satellite_scenes import Truth, write_dimap2

    from triline.nodes.formats.satellite.read import read_scene
    from triline.nodes.formats.satellite.rpc_files import write_rpb
    from triline.solver.location.rpc_fit import fit_to_model

    truth = Truth(lines=lines, samples=samples, period_s=1.5e-4, gsd=1.45e-6, tilt_deg=(15.0, -9.0, 1.0))
    model = read_scene(write_dimap2(folder / "scene.xml", truth)).model()
    rpc = fit_to_model(model, -200.0, 1200.0).rpc
    cells = max(int(1.6 * max(lines, samples) / 30), 200)
    Waves.under(model, cells, waves=cells / 60.0).write(folder / "heights.tif")
    rng = np.random.default_rng(1)
    with rasterio.open(
        folder / "image.tif", "w", driver="GTiff", width=samples, height=lines, count=1, dtype="uint16", tiled=True,
        blockxsize=512, blockysize=512,
    ) as target:  # fmt: skip
        from rasterio.windows import Window

        for row in range(0, lines, 512):
            n = min(512, lines - row)
            grain = rng.integers(0, 300, (n, samples), dtype=np.uint16)
            wave = 800 + 300 * np.sin(np.arange(samples) / 17.0)[None] * np.cos((row + np.arange(n)) / 23.0)[:, None]
            target.write((grain + wave).astype(np.uint16), 1, window=Window(0, row, samples, n))
    write_rpb(folder / "image.RPB", rpc)  # last: a new image takes what stands beside the old one away
    return {"image": str(folder / "image.tif"), "rpc": str(folder / "image.RPB"), "dem": str(folder / "heights.tif")}


def run_triline(job: dict) -> None:
    """The tiles of the strip to a plain GeoTIFF, the grid of ``triline rectify``."""
    from triline.nodes.cli import main

    args = ["rectify", job["image"], "--sensor", job["rpc"], "--dem", job["dem"], "--dem-datum", "ellipsoid", "-q"]
    code = main([*args, "-o", job["out"], "--workers", str(job["workers"]), *job["more"]])
    if code:
        raise SystemExit(code)


def run_gdal(job: dict) -> None:
    """GDAL's warp with the same polynomials, heights and cells."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    with rasterio.open(job["like"]) as like:
        profile = {"crs": like.crs, "transform": like.transform, "width": like.width, "height": like.height}
    with (
        rasterio.Env(GDAL_CACHEMAX=192),
        rasterio.open(job["image"]) as source,
        rasterio.open(
            job["out"], "w", driver="GTiff", tiled=True, blockxsize=512, blockysize=512, count=1, dtype="uint16",
            nodata=0, bigtiff="if_safer", **profile,
        ) as target,
    ):  # fmt: skip
        reproject(
            rasterio.band(source, 1), rasterio.band(target, 1), src_crs="EPSG:4326", src_nodata=0, dst_nodata=0,
            resampling=Resampling.bilinear, num_threads=job["workers"], warp_mem_limit=256, RPC_DEM=job["dem"],
            RPC_DEMINTERPOLATION="bilinear",
        )  # fmt: skip


def alone(what: str, job: dict) -> dict[str, float]:
    """Seconds and megabytes of one job in a process of its own; what it imports is not counted."""
    words = [sys.executable, __file__, "--job", json.dumps({"what": what, **job})]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr.strip() or f"{what}: failed")
    return json.loads(done.stdout.splitlines()[-1])


def work_alone(job: dict) -> int:
    warnings.simplefilter("ignore")
    import pyproj
    import rasterio.shutil
    import rasterio.warp  # noqa: F401

    from triline.nodes.cli import rectify_image  # noqa: F401

    pyproj.CRS.from_epsg(4326)
    begun, used = time.perf_counter(), time.process_time()
    {"triline": run_triline, "gdal": run_gdal}[job["what"]](job)
    seconds = time.perf_counter() - begun
    cpu = time.process_time() - used
    print(
        json.dumps({"seconds": seconds, "cpu": cpu, "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0})
    )
    return 0


def speed(folder: Path, lines: int, samples: int, workers: int) -> tuple[dict, bool]:
    import rasterio
    from rasterio.windows import Window

    scene = make_scene(folder, lines, samples)
    job = {**scene, "workers": workers, "like": str(folder / "plain.tif")}
    plain = alone("triline", {**job, "out": job["like"], "more": ["--plain"]})
    gdal = alone("gdal", {**job, "out": str(folder / "gdal.tif")})
    whole = alone("triline", {**job, "out": str(folder / "cog.tif"), "more": []})
    with rasterio.open(folder / "plain.tif") as one, rasterio.open(folder / "gdal.tif") as two:
        cells = one.width * one.height
        corner = one.width // 2 - 500, one.height // 2 - 500
        middle = Window(*corner, 1000, 1000)
        a, b = one.read(1, window=middle).astype(float), two.read(1, window=middle).astype(float)
    known = (a > 0) & (b > 0)
    rows = {}
    for name, got in (("triline, plain GeoTIFF", plain), ("GDAL, plain GeoTIFF", gdal), ("triline rectify", whole)):
        rate = {"Mpx/s": cells / got["seconds"] / 1e6, "Mpx a processor second": cells / got["cpu"] / 1e6}
        rows[name] = {**rate, "seconds": got["seconds"], "MB": got["mb"]}
    ratio = gdal["seconds"] / plain["seconds"]
    figures = {
        "strip": f"{samples} x {lines} px to {cells / 1e6:.0f} million cells, {workers} threads",
        **{f"{name}: {unit}": value for name, row in rows.items() for unit, value in row.items()},
        "as fast as GDAL, times": ratio,
        "median difference of grey values": float(np.median(np.abs(a - b)[known])),
    }
    good = cells / plain["seconds"] / 1e6 >= WANTED_MPX_S and max(plain["mb"], whole["mb"]) < WANTED_MB and ratio >= 1.0
    return figures, good


def main() -> int:
    if len(sys.argv) > 2 and sys.argv[1] == "--job":
        return work_alone(json.loads(sys.argv[2]))
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--lines", type=int, default=40_000)
    parser.add_argument("--samples", type=int, default=12_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where the files stay (default: nowhere)")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        figures, good = speed(folder, args.lines, args.samples, args.workers)
        frame.show(figures, args.json)
        if VENTOUX.is_dir():
            import contextlib
            import io

            from ventoux import summary

            with contextlib.redirect_stdout(io.StringIO()):
                found = summary(VENTOUX, folder)
            frame.show({f"Ventoux {name.replace('_', ', ')}": value for name, value in found.items()}, args.json)
            good &= found["corrected_median"] < WANTED_PX and found["corrected_across"] < WANTED_PX
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
