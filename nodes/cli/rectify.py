"""``triline rectify``: image lines of a recording, or any image of a sensor, to an orthoimage, a GeoTIFF."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.ellipsoid import WGS84
from ...solver.geometry.frames import LocalFrame
from ...solver.orthoimage.error_band import GroundErrors
from ...solver.orthoimage.ground_grid import GroundGrid, utm_of
from ...solver.orthoimage.orientation import LineOrientation
from ...solver.orthoimage.resampling import TAPS
from ...solver.orthoimage.surface import Ellipsoid, Surface, UnderAir
from ...solver.rectification.kernels import TAPS as IMAGE_TAPS
from ..batch.rectification import (
    ORIENTATIONS,
    REFINED,
    Rectification,
    Rectified,
    camera_beside,
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
from ..config import raster_of_heights
from ..errors import UserError
from ..formats.camera_json import read_camera_instead
from ..formats.dem import dem_in_frame
from ..formats.geotiff import write_orthoimage
from ..formats.new_file import refuse_unless_file
from ..recording.access import Recording
from . import rectify_image
from .locate import refraction_of
from .progress import progress

EXAMPLE = """triline rectify flight.mcap -o ortho.tif
  triline rectify flight.mcap -o before.tif --orientation measured --dem heights.tif --gsd 0.25
  triline rectify scene.tif --sensor DIM_PHR1A.XML --dem N44E005.hgt --dem-datum EPSG:5773 -o ortho.tif"""

#: Options of an image that a recording takes, too.
_OF_BOTH = ("dem_crs", "refraction", "sigma", "pixel_sigma", "height_sigma")
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


def run(args: argparse.Namespace) -> int:
    if args.sensor is not None:
        return rectify_image.run(args)
    begun = time.perf_counter()
    _check(args)
    recording = Recording(args.input)
    camera = recording.camera()
    ccd = _ccd(recording, camera, args.ccd)
    _check_strips(recording, args.strip)
    of_camera = None
    if args.trajectory is not None:
        name = args.trajectory.name
        orientation, reference_ns = trajectory_orientation(recording, args.trajectory)
        if args.camera is None:
            camera, of_camera = camera_beside(args.trajectory, camera)
    else:
        name, orientation, reference_ns = orientation_of(recording, args.orientation)
    estimated = 0
    if args.camera is not None:
        camera, of_camera = read_camera_instead(args.camera, camera), args.camera
    elif name in REFINED:
        camera, estimated = estimated_camera(recording, camera)
    frame = project_frame(recording)
    target = frame_for(frame, args.crs or _crs(frame))
    surface, ground_m, ground = _ground(args, recording, frame)
    if args.refraction is not None:
        surface = UnderAir(surface, frame, refraction_of(args.refraction, WGS84, str(args.input)))
        ground += ", refraction taken off"
    errors = _errors(args, camera, ccd, name, orientation)
    above = float(np.median(orientation.measured.position_l[:, 2])) - ground_m
    if above <= 0:
        raise UserError(
            f"{args.input}: the camera is {-above:.0f} m below the ground; wanted another --height or --dem"
        )
    pixel = pixel_on_ground(camera, ccd, above)
    grid = GroundGrid(target, args.gsd or float(f"{pixel:.2g}"))
    factor = max(int(grid.gsd / pixel + 0.1), 1)
    _check_size(recording, camera, ccd, pixel, grid)
    work = Rectification(camera, ccd, surface, grid, args.resampling, orientation, reference_ns, factor, errors)
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
    shape = write_orthoimage(
        args.output, done.mosaic, grid, tags, sigma=None if args.sigma is None else Path(args.sigma)
    )
    result = {
        "output": str(args.output), "orientation": name, "ccd": camera.lines[ccd].id, "crs": target.crs,
        "gsd": grid.gsd, "ground": ground, "resampling": args.resampling, "rows": shape[0], "columns": shape[1],
        "pixels_together": factor, "camera_parameters": estimated, "camera": of_camera and str(of_camera),
        "sigma": args.sigma, "strips": done.strips, "left_out": done.left_out, "missed_rays": done.missed_rays,
        "seconds": round(time.perf_counter() - begun, 3),
    }  # fmt: skip
    _tell(result, done, args)
    return 0


def _check(args: argparse.Namespace) -> None:
    if not args.input.exists():
        raise UserError(f"{args.input}: no such file")
    if args.input.is_dir():
        raise UserError(f"{args.input}: is a folder, wanted a recording with image lines")
    for path in (args.output, *(() if args.sigma is None else (Path(args.sigma),))):
        refuse_unless_file(path)
        if path.resolve() == args.input.resolve():
            raise UserError(f"{path}: the orthoimage would overwrite the recording")
    if args.sigma is not None and Path(args.sigma).resolve() == args.output.resolve():
        raise UserError("-o, --sigma: wanted different files")
    for name in ("gsd", "height"):
        value = getattr(args, name)
        if value is not None and not np.isfinite(value):
            raise UserError(f"--{name} {value}: wanted a number")
    for name in ("pixel_sigma", "height_sigma"):
        value = getattr(args, name)
        option = f"--{name.replace('_', '-')}"
        if value is not None and not 0 <= value < np.inf:
            raise UserError(f"{option} {value}: wanted a number of at least 0")
        if value is not None and args.sigma is None:
            raise UserError(f"{option}: goes with --sigma FILE, for which it counts")
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
        if name not in _OF_BOTH and getattr(args, name) not in (None, False):
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
    there = list(recording.last_strips())
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
        path, crs = Path(args.dem[0]), args.dem_crs
        if (path / "flight.toml").is_file():
            if crs is not None:
                raise UserError(f"--dem-crs: [dem] of {path / 'flight.toml'} says it")
            path, crs = raster_of_heights(path / "flight.toml")
        field = dem_in_frame(path, frame, crs)
        if not np.isfinite(field.z_m).any():
            raise UserError(f"{path}: lies far from the project")
        return field, float(np.nanmedian(field.z_m)), f"heights of {path.name}"
    if args.height is not None:
        h = args.height
    else:
        points = known_points(recording)
        h = float(np.median(frame.to_geodetic(points)[:, 2])) if len(points) else frame.height_m
    return Ellipsoid(frame, h), h - frame.height_m, f"height {h:.1f} m above the ellipsoid"


def _errors(
    args: argparse.Namespace, camera: LineCamera, ccd: int, name: str, orientation: LineOrientation
) -> GroundErrors | None:
    """What counts for the sigmas besides the orientation; None where nobody asked for them."""
    if args.sigma is None:
        return None
    if args.trajectory is not None:
        raise UserError(f"--sigma: {name} has sigmas without their correlations, wanted --orientation of the recording")
    if not orientation.has_covariance:
        raise UserError(f"{args.input}: --sigma: the {name} orientation has no covariance")
    xy = camera.lines[ccd].xy_mm
    pitch_mm = float(np.linalg.norm(xy[-1] - xy[0])) / (len(xy) - 1)
    return GroundErrors((args.pixel_sigma or 0.0) * pitch_mm, args.height_sigma or 0.0)


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
    if result["sigma"]:
        print(f"  sigmas in the plane and of the height, metres: {result['sigma']}")
    if result["camera"]:
        print(f"  camera of {result['camera']}")
    if done.left_out:
        print("  left out: " + ", ".join(f"{n} lines {why}" for why, n in done.left_out.items()))
    if done.missed_rays:
        print(f"  {done.missed_rays} rays did not meet the ground")
