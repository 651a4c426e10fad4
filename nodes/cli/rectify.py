"""``triline rectify``: image lines of a recording, or any image of a sensor, to an orthoimage, a GeoTIFF."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.orthoimage.ground_grid import GroundGrid
from ...solver.orthoimage.resampling import TAPS
from ...solver.rectification.kernels import TAPS as IMAGE_TAPS
from ..batch.rectification import Rectification, Rectified, line_blocks
from ..batch.strip_orientation import ORIENTATIONS
from ..errors import UserError, flag
from ..formats.geotiff import is_virtual, write_orthoimage
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_writable
from ..formats.projection import notes_of_map
from ..recording.remote import path_of
from . import rectify_image, rectify_mosaic
from .damage import tell_damage, tell_other_camera, tell_other_frame
from .outputs import refuse_other_format
from .progress import progress
from .rectify_recording import cells_of, prepared

EXAMPLE = """triline rectify flight.mcap -o ortho.tif
  triline rectify flight.mcap -o before.tif --orientation measured --dem heights.tif --gsd 0.25
  triline rectify scene.tif --sensor DIM_PHR1A.XML --dem N44E005.hgt --dem-datum EPSG:5773 -o ortho.tif
  triline rectify day1.mcap day2.mcap --mosaic --dem heights.tif --sigma sigma.tif --workers 4 -o block.tif"""

#: Options of an image that a recording takes, too.
_OF_BOTH = ("bounds", "dem_crs", "refraction", "occlusions", "sigma", "pixel_sigma", "height_sigma")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input", type=path_of, metavar="INPUT", nargs="+",
        help="recording with image lines, or with --sensor an image; with --mosaic several, and finished orthoimages",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="GeoTIFF to write (--mosaic: or .vrt)"
    )
    parser.add_argument(
        "--orientation", choices=tuple(ORIENTATIONS), help="of the lines (default: the best there is, in this order)"
    )
    parser.add_argument(
        "--trajectory", type=Path, metavar="FILE",
        help="refined orientation from a table instead: trajectory_refined.csv of `triline adjust`",
    )  # fmt: skip
    parser.add_argument(
        "--camera", type=Path, metavar="FILE",
        help="calibrated camera.json in place of that of the recording (default: the one beside --trajectory; with a "
        "refined orientation the parameters that were estimated with it)",
    )  # fmt: skip
    parser.add_argument("--ccd", metavar="ID", help="CCD line (default: the one that looks down most steeply)")
    parser.add_argument("--strip", action="append", metavar="ID", help="only this strip (may be given again)")
    parser.add_argument("--gsd", type=float, metavar="X", help="size of a cell, units of the CRS (default: of a pixel)")
    parser.add_argument(
        "--crs", help="projected CRS, e.g. EPSG:32632, or local (default: the project's, or the UTM zone)"
    )
    parser.add_argument(
        "--dem", metavar="FILE", action="append",
        help="raster of heights; of a recording also a flight folder with [dem], or 'points': object points; of an "
        "image: with --dem-datum, may be given again, or a folder of tiles",
    )  # fmt: skip
    parser.add_argument(
        "--height",
        type=float,
        metavar="M",
        help="of the ground above the ellipsoid (default: of known points; RPC's middle; 0)",
    )
    parser.add_argument("--resampling", choices=tuple(IMAGE_TAPS), default="bilinear", help="(default: %(default)s)")
    rectify_image.add_arguments(parser)
    rectify_mosaic.add_arguments(parser)


def _only(given: list[Any], what: str = "") -> Any:
    """The only one."""
    if len(given) > 1:
        raise UserError(f"{what or given[1]}: more than one, which goes with --mosaic only")
    return given[0]


def run(args: argparse.Namespace) -> int:
    _refuse_other_formats(args)
    _refuse_cells_and_ground(args)
    if args.mosaic:
        return rectify_mosaic.run(args)
    args.input = _only(args.input)
    if args.sensor is not None:
        args.sensor = _only(args.sensor, "--sensor")
        rectify_mosaic.refuse_options(args)
        return rectify_image.run(args)
    begun = time.perf_counter()
    _check(args)
    of = prepared(args, args.input)
    recording, camera, ccd, name = of.recording, of.camera, of.ccd, of.orientation_name
    ground, grid, factor, part = of.ground, *cells_of(args, of)
    work = Rectification(
        camera, ccd, of.surface, grid, args.resampling, of.of_strip, of.reference_ns, factor, of.errors,
        shadows=of.shadows, part=part,
    )  # fmt: skip
    with progress("rectifying", args.quiet or args.json) as told:
        for block in line_blocks(recording, camera.lines[ccd].id, args.strip, told):
            try:
                work.add(block)
            except ValueError as error:
                raise UserError(f"{args.input}: {block.ccd} line {block.first_line}: {error}") from None
    done = work.finish()
    if done is None or not done.mosaic.tiles:
        left = ", ".join(f"{n} lines {why}" for why, n in (done.left_out if done else {}).items())
        if part is not None and work.seen is not None:
            wanted = rectify_image.words_of_bounds(args.bounds)
            left = f"no line sees {wanted}; all lines together see {_extent(grid, *work.seen)}"
        if not left:
            left = "no lines of that strip" if done is None else f"no ray meets the ground: {ground}"
        raise UserError(f"{args.input}: nothing to rectify: {left}")
    tags = {
        "TIFFTAG_SOFTWARE": "triline",
        "TIFFTAG_IMAGEDESCRIPTION": f"{camera.name} {camera.lines[ccd].id}, {name} orientation, {ground}",
    }
    shape = write_orthoimage(
        args.output, done.mosaic, grid, tags, sigma=None if args.sigma is None else Path(args.sigma), part=part
    )
    result = {
        "output": str(args.output), "orientation": name, "ccd": camera.lines[ccd].id, "crs": grid.frame.crs,
        "gsd": grid.gsd, "bounds": args.bounds, "ground": ground, "resampling": args.resampling,
        "rows": shape[0], "columns": shape[1],
        "pixels_together": factor, "camera_parameters": of.estimated, "camera": of.of_camera and str(of.of_camera),
        "sigma": args.sigma, "strips": done.strips, "left_out": done.left_out, "missed_rays": done.missed_rays,
        "hidden_cells": done.hidden_cells if args.occlusions else None,
        "poses_not_valid": of.orientation.not_valid,
        "notes": [*of.notes, *notes_of_map(grid.frame.crs, recording.frame().crs)],
        "seconds": round(time.perf_counter() - begun, 3),
    }  # fmt: skip
    _tell(result, done, args, grid.frame.units[0])
    tell_damage("rectify", recording.reader)
    tell_other_frame("rectify", recording.reader)
    tell_other_camera("rectify", recording.reader)
    return 0


def _refuse_other_formats(args: argparse.Namespace) -> None:
    for path in (args.output, args.sigma, args.mask, args.source):
        if args.mosaic:
            refuse_other_format(path, "a GeoTIFF or a virtual raster", ".tif", ".tiff", ".vrt")
        else:
            more = "; --mosaic writes virtual rasters" if is_virtual(Path(path or "")) else ""
            refuse_other_format(path, "a GeoTIFF", ".tif", ".tiff", more=more)
    refuse_other_format(args.seam_lines, "GeoJSON", ".geojson", ".json")
    refuse_other_format(args.stac, "JSON", ".json", ".geojson")


def _refuse_cells_and_ground(args: argparse.Namespace) -> None:
    """Refuse sizes of cells and heights that no input goes with."""
    for name in ("gsd", "height"):
        value = getattr(args, name)
        if value is not None and not np.isfinite(value):
            raise UserError(f"--{name} {value}: wanted a number")
    if args.gsd is not None and not args.gsd > 0:
        raise UserError(f"--gsd {args.gsd}: wanted more than 0")
    if args.dem and args.height is not None:
        raise UserError("--height and --dem: wanted one of them")


def _check(args: argparse.Namespace) -> None:
    if not args.input.exists():
        raise UserError(f"{args.input}: no such file")
    if args.input.is_dir():
        raise UserError(f"{args.input}: is a folder, wanted a recording with image lines")
    refuse_importable(args.input)
    for path in (args.output, *(() if args.sigma is None else (Path(args.sigma),))):
        refuse_unless_writable(path)
    if args.sigma is not None and Path(args.sigma).resolve() == args.output.resolve():
        raise UserError("-o, --sigma: wanted different files")
    for name in ("pixel_sigma", "height_sigma"):
        value = getattr(args, name)
        option = flag(name)
        if value is not None and not 0 <= value < np.inf:
            raise UserError(f"{option} {value}: wanted a number of at least 0")
        if value is not None and args.sigma is None:
            raise UserError(f"{option}: goes with --sigma FILE, for which it counts")
    if args.trajectory is not None and args.orientation is not None:
        raise UserError("--orientation and --trajectory: wanted one of them")
    if args.dem_crs is not None and args.dem in (None, ["points"]):
        raise UserError(f"--dem-crs {args.dem_crs}: is of a raster of heights, wanted --dem FILE with it")
    rectify_image.refuse_occlusions_of_level_ground(args)
    rectify_image.refuse_empty_bounds(args)
    if args.dem is not None and len(args.dem) > 1:
        raise UserError("--dem: given more than once, which goes with --sensor only")
    if args.resampling not in TAPS:
        raise UserError(f"--resampling {args.resampling}: goes with --sensor, wanted one of {', '.join(TAPS)}")
    rectify_mosaic.refuse_options(args)
    for name in rectify_image.OPTIONS:
        if name not in _OF_BOTH and rectify_image.is_given(args, name):
            raise UserError(f"{flag(name)}: goes with an image and its --sensor, not with a recording")


def _extent(grid: GroundGrid, low: NDArray[np.floating], high: NDArray[np.floating]) -> str:
    """Corners (column, row) as bounds in the CRS."""
    (left, right), (top, bottom) = grid.centre(*np.transpose([low, high]))
    return rectify_image.words_of_bounds([left, bottom, right, top]) + f" in {grid.frame.crs}"


def _tell(result: dict[str, Any], done: Rectified, args: argparse.Namespace, unit: str) -> None:
    if args.json:
        print(json_text(result))
        return
    lines = sum(done.strips.values())
    print(
        f"{args.output}: {result['rows']} x {result['columns']} cells of {result['gsd']:g} {unit} in {result['crs']}, "
        f"{lines} lines of {result['ccd']}, {result['orientation']} orientation, {result['ground']}, "
        f"{result['seconds']:.1f} s"
    )
    if result["camera_parameters"]:
        print(f"  camera with {result['camera_parameters']} estimated parameters")
    if result["sigma"]:
        print(f"  sigmas in the plane and of the height, metres: {result['sigma']}")
    if result["camera"]:
        print(f"  camera of {result['camera']}")
    if done.left_out:
        print("  left out: " + ", ".join(f"{n} lines {why}" for why, n in done.left_out.items()))
    if result["poses_not_valid"]:
        print(f"  {result['poses_not_valid']} poses are not valid and give no orientation")
    if done.missed_rays:
        print(f"  {done.missed_rays} rays did not meet the ground")
    if args.occlusions:
        print(f"  {done.hidden_cells} cells hidden by relief")
    if not args.quiet:
        for note in result["notes"]:
            print(f"  note: {note}")
