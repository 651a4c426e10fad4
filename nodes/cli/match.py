"""``triline match``: tie points between the images of a block of satellite scenes."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.matching.scene_patches import SceneView
from ...solver.matching.scene_ties import PairReport
from ...solver.rectification.pixel_to_cell import meet_terrain
from ..batch.image_rectification import CACHE_MB
from ..batch.scene_matching import SEARCH_M, MatchedScenes, match_scenes, mistaken_images, open_views, write_points
from ..errors import UserError
from ..formats.height_raster import DATUMS, HeightRaster
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_writable
from ..formats.scene_block import SceneBlockData, is_scene_block, read_scene_block
from .heights_under import height_range, rasters_of_heights
from .location_options import refuse_datum_without_raster
from .outputs import refuse_over_files
from .progress import progress

EXAMPLE = """triline match pair
  triline match pair --dem N44E005.hgt --dem-datum EPSG:5773 --points 500"""

Array = NDArray[np.floating]

#: Tie points that are wanted in each pair, and the most that may be.
POINTS, MOST_POINTS = 300, 100_000
#: Heights of a raster may be wrong by so much (trees, houses, what has changed), m.
DEM_SLACK_M = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="block of satellite scenes that names their images")
    parser.add_argument(
        "-o", "--output", dest="table", type=Path, metavar="CSV",
        help="the image points of the folder and the matched ones (default: image_points.csv of the folder)",
    )  # fmt: skip
    parser.add_argument(
        "--points",
        type=int,
        default=POINTS,
        metavar="N",
        help=f"wanted in each pair of images, about (default: {POINTS})",
    )
    parser.add_argument(
        "--search-m", type=float, metavar="M",
        help="how far apart on the ground two models may put a place, beside its height (default: three sigma of what "
        f"metadata or project state, {SEARCH_M:g} at least)",
    )  # fmt: skip
    parser.add_argument(
        "--height", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="of the ground above the ellipsoid, m (default: of the RPC, else of control)",
    )  # fmt: skip
    parser.add_argument(
        "--dem", metavar="FILE", action="append",
        help="raster of heights, to know them beforehand; may be given again, or a folder of tiles",
    )  # fmt: skip
    parser.add_argument("--dem-crs", metavar="CRS", help="of the raster; or ellipsoid, EPSG:5773 .. alone")
    parser.add_argument("--dem-datum", metavar="DATUM", help=f"of its heights: {DATUMS}")


def run(args: argparse.Namespace) -> int:
    _check(args)
    import rasterio

    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB):
        return _matched(args)


def _matched(args: argparse.Namespace) -> int:
    folder: Path = args.folder
    data, views = open_views(folder, read_scene_block(folder, with_lines=True))
    mistaken = mistaken_images(folder, data, views)
    for note in () if args.quiet or args.json else mistaken:  # at once: what it does to the matches takes its time
        print(f"note: {note}", file=sys.stderr)
    notes = [*data.notes, *(mistaken if args.json else ())]
    target = args.table or folder / "image_points.csv"
    rasters = rasters_of_heights(args.dem or ())
    refuse_over_files((target,), [*rasters, *_read_files(folder, data)])
    terrain = None
    if rasters:
        raster = HeightRaster(rasters, args.dem_crs, args.dem_datum, data.ellipsoid)
        notes += raster.notes
        terrain = _Terrain(raster)
    heights = (-DEM_SLACK_M, DEM_SLACK_M) if terrain else None if args.height is None else tuple(args.height)
    with progress("matching", args.quiet or args.json) as told:
        matched = match_scenes(
            data, views, args.points, search_m=args.search_m, heights=heights, height_m=terrain, told=told
        )
    stayed, went = write_points(matched, folder / "image_points.csv", target)
    result = _result(matched, target, stayed, went, notes + matched.notes)
    if args.json:
        print(json_text(result))
    elif not args.quiet:
        _tell(args, matched, result)
    return 0


def _check(args: argparse.Namespace) -> None:
    if not is_scene_block(args.folder):
        raise UserError(f"{args.folder}: no block of satellite scenes, wanted a folder whose project.toml has "
                        "[scenes.NAME]; `triline new scenes` makes one")  # fmt: skip
    if not 1 <= args.points <= MOST_POINTS:
        raise UserError(f"--points {args.points}: wanted 1 to {MOST_POINTS}")
    if args.search_m is not None and not 0 < args.search_m < np.inf:
        raise UserError(f"--search-m {args.search_m:g}: wanted more than 0")
    if args.height is not None:
        low, high = args.height
        if not (np.isfinite(args.height).all() and low <= high):
            raise UserError(f"--height {low:g} {high:g}: wanted the lowest height, and then the highest")
        if args.dem:
            raise UserError("--height and --dem: wanted one of them")
    refuse_datum_without_raster(args)
    refuse_unless_writable(args.table or args.folder / "image_points.csv")


def _read_files(folder: Path, data: SceneBlockData) -> list[Path]:
    """What is read of a block, but for image_points.csv."""
    names = {name for e in data.images for name in (e.scene.metadata, e.image) if name}
    files = [folder / name for name in ("project.toml", "ground_points.csv", *sorted(names))]
    return files + [file for path in files if path.is_dir() for file in path.iterdir()]


class _Terrain:
    """Heights of a raster under the pixels of views."""

    def __init__(self, raster: HeightRaster):
        self.raster = raster
        self._range: dict[str, tuple[float, float]] = {}

    def __call__(self, view: SceneView, pixel: Array) -> Array:
        """(k,) where rays of pixels (k, 2) meet the raster; NaN for no height.

        Raises
        ------
        UserError : a raster that does not lie under the image
        """
        if view.name not in self._range:
            u, v = view.grid(20).T

            def places(height_m: float) -> tuple[Array, Array]:
                lat, lon, _ = view.location.direct(u, v, np.full(len(u), height_m)).T
                return lat, lon

            self._range[view.name] = height_range(places, self.raster, 0.0, view.name, "the pixels of the image")
        return meet_terrain(view.location, pixel[:, 0], pixel[:, 1], self.raster, *self._range[view.name]).height_m


def _result(matched: MatchedScenes, target: Path, stayed: int, went: int, notes: list[str]) -> dict[str, Any]:
    rays = [len(point.rays) for point in matched.points]
    return {
        "output": str(target),
        "points": len(rays),
        "rays": sum(rays),
        "in_three_or_more": sum(n > 2 for n in rays),
        "rows_kept": stayed,
        "rows_replaced": went,
        "search_m": matched.search_m,
        "heights_m": [matched.low_m, matched.high_m],
        "pairs": [
            {
                "master": pair.names[0], "other": pair.names[1], "overlap": pair.overlap, "gsd_m": pair.gsd_m,
                "tried": pair.tried, "found": pair.found, "kept": pair.kept, "misfit_px": pair.misfit_px,
                "left_px": pair.left_px, "why": pair.why,
            }
            for pair in matched.pairs
        ],
        "notes": notes,
    }  # fmt: skip


def _tell(args: argparse.Namespace, matched: MatchedScenes, result: dict[str, Any]) -> None:
    print(f"{matched.data.name}: {len(matched.data.images)} images -> {result['output']}")
    for pair in matched.pairs:
        print(f"  {_words(pair)}")
    three = f", {result['in_three_or_more']} of them in three or more images" if len(matched.data.images) > 2 else ""
    print(f"{result['points']} tie points, {result['rays']} image points{three}")
    before = f"; {result['rows_replaced']} of a run before were replaced" if result["rows_replaced"] else ""
    if result["rows_kept"] or before:
        print(f"{result['rows_kept']} rows of image_points.csv stay{before}")
    for note in result["notes"]:
        print(f"  note: {note}")
    table = args.folder / "image_points.csv"
    if result["output"] != str(table) and not (table.exists() and table.samefile(result["output"])):
        print(f"next: `triline adjust` takes these points when they are {table}")
        return
    print(f"next: triline adjust {shlex.quote(str(args.folder))} --snoop -o result")


def _words(pair: PairReport) -> str:
    """One line about a pair of images."""
    names = f"{pair.names[0]}, {pair.names[1]}:"
    if pair.why:
        through = f"; {pair.kept} points that another image has, too" if pair.kept else ""
        return f"{names} {pair.why}{through}"
    counts = f"{pair.tried} places tried, {pair.found} matched, {pair.kept} points kept"
    by = f"{pair.misfit_px:.2f} px ({pair.misfit_px * pair.gsd_m:.2f} m), {pair.left_px:.2f} px beside a plane"
    return f"{names} overlap {100 * pair.overlap:.0f} %, {counts}; rays miss by {by}"
