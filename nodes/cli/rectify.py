"""``triline rectify``: image lines of a recording, or any image of a sensor, to an orthoimage, a GeoTIFF."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import LocalFrame
from ...solver.orthoimage.ground_grid import GroundGrid, utm_of
from ...solver.orthoimage.resampling import TAPS
from ...solver.orthoimage.surface import Ellipsoid, Surface
from ...solver.rectification.kernels import TAPS as IMAGE_TAPS
from ..batch.rectification import (
    ORIENTATIONS,
    REFINED,
    Rectification,
    Rectified,
    estimated_camera,
    frame_for,
    ground_of_points,
    known_points,
    line_blocks,
    orientation_of,
    pixel_on_ground,
    project_frame,
    trajectory_orientation,
)
from ..errors import UserError
from ..formats.dem import dem_in_frame
from ..formats.geotiff import write_orthoimage
from ..formats.new_file import refuse_unless_file
from ..recording.access import Recording
from . import rectify_image
from .progress import progress

EXAMPLE = """triline rectify flight.mcap -o ortho.tif
  triline rectify flight.mcap -o before.tif --orientation measured --dem heights.tif --gsd 0.25
  triline rectify scene.tif --sensor DIM_PHR1A.XML --dem N44E005.hgt --dem-datum EPSG:5773 -o ortho.tif"""

#: An orthoimage with more cells than this is refused: the mosaic is put together in memory.
MOST_CELLS = 4e9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="recording with image lines, or with --sensor an image"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="GeoTIFF to write")
    parser.add_argument(
        "--orientation", choices=tuple(ORIENTATIONS), help="of the lines (default: the best there is, in this order)"
    )
    parser.add_argument(
        "--trajectory", type=Path, metavar="FILE",
        help="refined orientation from a table instead: trajectory_refined.csv of `triline adjust`",
    )  # fmt: skip
    parser.add_argument("--ccd", metavar="ID", help="CCD line (default: the one that looks down most steeply)")
    parser.add_argument("--strip", action="append", metavar="ID", help="only this strip (may be given again)")
    parser.add_argument("--gsd", type=float, metavar="X", help="size of a cell, units of the CRS (default: of a pixel)")
    parser.add_argument(
        "--crs", help="projected CRS, e.g. EPSG:32632, or local (default: the project's, or the UTM zone)"
    )
    parser.add_argument(
        "--dem", metavar="FILE", action="append",
        help="raster of heights; of a recording also 'points': object points; of an image: with --dem-datum, may be "
        "given again, or a folder of tiles",
    )  # fmt: skip
    parser.add_argument(
        "--height",
        type=float,
        metavar="M",
        help="of the ground above the ellipsoid (default: of known points; RPC's middle; 0)",
    )
    parser.add_argument("--resampling", choices=tuple(IMAGE_TAPS), default="bilinear", help="(default: %(default)s)")
    rectify_image.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    if args.sensor is not None:
        return rectify_image.run(args)
    begun = time.perf_counter()
    _check(args)
    recording = Recording(args.input)
    camera = recording.camera()
    ccd = _ccd(recording, camera, args.ccd)
    _check_strips(recording, args.strip)
    if args.trajectory is not None:
        name = args.trajectory.name
        orientation, reference_ns = trajectory_orientation(recording, args.trajectory)
    else:
        name, orientation, reference_ns = orientation_of(recording, args.orientation)
    estimated = 0
    if name in REFINED:
        camera, estimated = estimated_camera(recording, camera)
    frame = project_frame(recording)
    target = frame_for(frame, args.crs or _crs(frame))
    surface, ground_m, ground = _ground(args, recording, frame)
    above = float(np.median(orientation.measured.position_l[:, 2])) - ground_m
    if above <= 0:
        raise UserError(
            f"{args.input}: the camera is {-above:.0f} m below the ground; wanted another --height or --dem"
        )
    pixel = pixel_on_ground(camera, ccd, above)
    grid = GroundGrid(target, args.gsd or float(f"{pixel:.2g}"))
    factor = max(int(grid.gsd / pixel + 0.1), 1)
    _check_size(recording, camera, ccd, pixel, grid)
    work = Rectification(camera, ccd, surface, grid, args.resampling, orientation, reference_ns, factor)
    with progress("rectifying", args.quiet or args.json) as told:
        for block in line_blocks(recording, camera.lines[ccd].id, args.strip, told):
            try:
                work.add(block)
            except ValueError as error:
                raise UserError(f"{args.input}: {block.ccd} line {block.first_line}: {error}") from None
    done = work.finish()
    if done is None or not done.mosaic.tiles:
        left = ", ".join(f"{n} lines {why}" for why, n in (done.left_out if done else {}).items())
        raise UserError(f"{args.input}: nothing to rectify: {left or 'no lines of that strip'}")
    tags = {
        "TIFFTAG_SOFTWARE": "triline",
        "TIFFTAG_IMAGEDESCRIPTION": f"{camera.name} {camera.lines[ccd].id}, {name} orientation, {ground}",
    }
    shape = write_orthoimage(args.output, done.mosaic, grid, tags)
    result = {
        "output": str(args.output), "orientation": name, "ccd": camera.lines[ccd].id, "crs": target.crs,
        "gsd": grid.gsd, "ground": ground, "resampling": args.resampling, "rows": shape[0], "columns": shape[1],
        "pixels_together": factor, "camera_parameters": estimated,
        "strips": done.strips, "left_out": done.left_out, "missed_rays": done.missed_rays,
        "seconds": round(time.perf_counter() - begun, 3),
    }  # fmt: skip
    _tell(result, done, args)
    return 0


def _check(args: argparse.Namespace) -> None:
    if not args.input.exists():
        raise UserError(f"{args.input}: no such file")
    if args.input.is_dir():
        raise UserError(f"{args.input}: is a folder, wanted a recording with image lines")
    refuse_unless_file(args.output)
    if args.output.resolve() == args.input.resolve():
        raise UserError(f"{args.output}: the orthoimage would overwrite the recording")
    for name in ("gsd", "height"):
        value = getattr(args, name)
        if value is not None and not np.isfinite(value):
            raise UserError(f"--{name} {value}: wanted a number")
    if args.gsd is not None and not args.gsd > 0:
        raise UserError(f"--gsd {args.gsd}: wanted more than 0")
    if args.trajectory is not None and args.orientation is not None:
        raise UserError("--orientation and --trajectory: wanted one of them")
    if args.dem_crs is not None and args.dem in (None, ["points"]):
        raise UserError(f"--dem-crs {args.dem_crs}: is of a raster of heights, wanted --dem FILE with it")
    if args.dem is not None and args.height is not None:
        raise UserError("--height and --dem: wanted one of them")
    if args.dem is not None and len(args.dem) > 1:
        raise UserError("--dem: given more than once, which goes with --sensor only")
    if args.resampling not in TAPS:
        raise UserError(f"--resampling {args.resampling}: goes with --sensor, wanted one of {', '.join(TAPS)}")
    for name in rectify_image.OPTIONS:
        if name != "dem_crs" and getattr(args, name) not in (None, False):
            raise UserError(f"--{name.replace('_', '-')}: goes with an image and its --sensor, not with a recording")


def _ccd(recording: Recording, camera: LineCamera, wanted: str | None) -> int:
    path = recording.reader.path
    imaged = [line.id for line in camera.lines if len(recording.reader.select([f"sensor/lines/{line.id}"]))]
    if not imaged:
        raise UserError(f"{path}: no image lines in it (sensor/lines); 'triline simulate --images' makes some")
    if wanted is not None:
        if wanted not in imaged:
            raise UserError(f"{path}: no image lines of CCD line {wanted!r}, there are: {', '.join(imaged)}")
        return camera.line_index[wanted]
    forward = [abs(line.centre_mm[0] - camera.principal_point_mm[k][0]) for k, line in enumerate(camera.lines)]
    return min((camera.line_index[id] for id in imaged), key=lambda k: forward[k])


def _check_strips(recording: Recording, wanted: list[str] | None) -> None:
    there = recording.strips().index.tolist()
    for strip in wanted or ():
        if strip not in there:
            raise UserError(f"{recording.reader.path}: no strip {strip!r}, there are: {', '.join(there)}")


def _crs(frame: LocalFrame) -> str:
    """The horizontal CRS of the project, or its UTM zone; local where the place of the project is not known."""
    if frame.crs == "local":
        return "local" if frame.lat_deg == frame.lon_deg == frame.height_m == 0 else utm_of(frame)
    import pyproj

    crs = pyproj.CRS.from_user_input(frame.crs)
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    return flat.to_string() if flat.is_projected else utm_of(frame)


def _ground(args: argparse.Namespace, recording: Recording, frame: LocalFrame) -> tuple[Surface, float, str]:
    """The ground, its mean height in the local frame, and its name."""
    if args.dem == ["points"]:
        field = ground_of_points(recording)
        return field, float(np.median(known_points(recording)[:, 2])), "heights of object points"
    if args.dem is not None:
        field = dem_in_frame(Path(args.dem[0]), frame, args.dem_crs)
        if not np.isfinite(field.z_m).any():
            raise UserError(f"{args.dem[0]}: lies far from the project")
        return field, float(np.nanmedian(field.z_m)), f"heights of {Path(args.dem[0]).name}"
    if args.height is not None:
        h = args.height
    else:
        points = known_points(recording)
        h = float(np.median(frame.to_geodetic(points)[:, 2])) if len(points) else frame.height_m
    return Ellipsoid(frame, h), h - frame.height_m, f"height {h:.1f} m above the ellipsoid"


def _check_size(recording: Recording, camera: LineCamera, ccd: int, pixel: float, grid: GroundGrid) -> None:
    lines = max((int(message.body.lines) for message in recording.messages("configuration/strip")), default=0)
    cells = lines * camera.lines[ccd].pixels * (pixel / grid.gsd) ** 2
    if cells > MOST_CELLS:
        raise UserError(
            f"--gsd {grid.gsd:g}: some {cells:.1g} cells, wanted at most {MOST_CELLS:.0e}: choose a larger one"
        )


def _tell(result: dict[str, Any], done: Rectified, args: argparse.Namespace) -> None:
    if args.json:
        print(json.dumps(result, indent=2))
        return
    lines = sum(done.strips.values())
    print(
        f"{args.output}: {result['rows']} x {result['columns']} cells of {result['gsd']:g} m in {result['crs']}, "
        f"{lines} lines of {result['ccd']}, {result['orientation']} orientation, {result['ground']}, "
        f"{result['seconds']:.1f} s"
    )
    if result["camera_parameters"]:
        print(f"  camera with {result['camera_parameters']} estimated parameters")
    if done.left_out:
        print("  left out: " + ", ".join(f"{n} lines {why}" for why, n in done.left_out.items()))
    if done.missed_rays:
        print(f"  {done.missed_rays} rays did not meet the ground")
