"""``triline rectify IMAGE --sensor META``: any image of a sensor that can be located, to an orthoimage."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.reliability import CRITICAL_W
from ...solver.adjustment.variance_components import LEAST_REDUNDANCY
from ...solver.geometry.ellipsoid import WGS84, Ellipsoid
from ...solver.location.affine_bias import LARGE_TURN, BiasFit, CorrectedModel, fit_bias
from ...solver.location.cropped import CroppedModel
from ...solver.location.frame_camera import FrameCamera
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import Sigmas, pixel_covariance
from ...solver.rectification.frame_parameters import THIRTEEN, UNITS, FrameControl, FrameFit, fit_frame, stated_priors
from ...solver.rectification.grid import MapGrid, default_crs
from ...solver.rectification.pixel_to_cell import meet_terrain
from ...solver.rectification.sampled import SomeCells, ground_steps, metres_a_radian
from ..batch.image_rectification import ErrorMap, Ground, ImageRectification, SourceImage, edge_of
from ..errors import UserError, flag
from ..formats.height_raster import DATUMS, HeightRaster
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_writable
from ..formats.projection import notes_of_map, unit_of
from ..formats.table import Column, read_table
from .heights_under import NO_HEIGHT_SIGMA, below_camera, height_range, rasters_of_heights
from .location_model import SENSORS, read_location_model
from .location_options import add_orientation_sigmas, refuse_datum_without_raster, stated_sigmas, with_refraction
from .outputs import refuse_over_files
from .progress import progress

Array = NDArray[np.floating]

#: Sigma of heights and places of control, m, where ``--height-sigma`` states none: a hand-held receiver.
GROUND_SIGMA_M = 15.0
#: Sigma of line and sample of control, px, where ``--pixel-sigma`` states none.
CONTROL_SIGMA_PX = 0.5
_CONTROL = (
    Column("lon_deg", low=-360.0), Column("lat_deg", low=-90.0), Column("height_m"), Column("column"), Column("row"),
)  # fmt: skip
#: An orthoimage with more cells a side is refused: GDAL counts rows and columns in 31 bits.
MOST_SIDE = 2_000_000_000
#: No coordinate of a CRS is as large.
MOST_COORDINATE = 1e12
#: Options (as attributes) that a recording does not take.
OPTIONS = (
    "model", "first_pixel", "refraction", "control", "correction", "dem_crs", "dem_datum", "bounds", "nodata", "direct",
    "occlusions", "mask", "sigma", "compress", "plain", "position_sigma", "attitude_sigma", "pixel_sigma",
    "height_sigma", "workers",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that go with an image."""
    group = parser.add_argument_group(
        "an image of a sensor (with --sensor)",
        "of a recording, too: --bounds, --refraction, --occlusions, --sigma, --pixel-sigma, --height-sigma, --dem-crs",
    )
    group.add_argument(
        "--sensor", metavar="META", action="append",
        help="metadata of the image: " + "; ".join(SENSORS.values()),
    )  # fmt: skip
    group.add_argument("--model", choices=("rigorous", "rpc"), help="where the metadata have both (default: rigorous)")
    group.add_argument("--first-pixel", type=int, nargs=2, metavar=("COLUMN", "ROW"), help="of the image in the scene")
    group.add_argument("--refraction", nargs="*", type=float, metavar="VALUE", help="as in 'triline locate'")
    group.add_argument("--control", metavar="CSV", help="lon_deg,lat_deg,height_m,column,row: corrects the model")
    group.add_argument(
        "--correction",
        choices=("shift", "affine", "camera"),
        help="by control: of the image, or of the parameters of a frame camera (default: affine)",
    )
    group.add_argument("--dem-crs", metavar="CRS", help="of the raster; or ellipsoid, EPSG:5773 .. alone")
    group.add_argument("--dem-datum", metavar="DATUM", help=f"what heights are above: {DATUMS}")
    group.add_argument(
        "--bounds",
        type=float,
        nargs=4,
        metavar=("LEFT", "BOTTOM", "RIGHT", "TOP"),
        help="of the orthoimage, in its CRS",
    )
    group.add_argument(
        "--nodata", type=float, metavar="VALUE", help="in the image and the orthoimage (default: 0, NaN)"
    )
    group.add_argument("--direct", action="store_true", help="from pixels to the ground, not from the ground to pixels")
    group.add_argument("--occlusions", action="store_true", help="leave out what relief hides from the sensor")
    group.add_argument("--mask", metavar="FILE", help="GeoTIFF that says why cells are missing")
    group.add_argument("--sigma", metavar="FILE", help="GeoTIFF of planimetric and height sigma, metres")
    add_orientation_sigmas(group)
    group.add_argument("--pixel-sigma", type=float, metavar="PX", help="of what is measured in the image (matching)")
    group.add_argument("--height-sigma", type=float, metavar="M", help="of the heights")
    group.add_argument(
        "--compress", choices=("deflate", "zstd", "lzw", "none"), help="of the GeoTIFF (default: deflate)"
    )
    group.add_argument("--plain", action="store_true", help="no overviews and no compression: half the time")
    group.add_argument(
        "--workers", type=int, metavar="N", help="threads, of a mosaic processes (default: as many as cores)"
    )


def is_given(args: argparse.Namespace, name: str) -> bool:
    """Whether the command line has an option (as attribute), be it 0."""
    return getattr(args, name) is not None and getattr(args, name) is not False


@dataclass(frozen=True)
class _Sensor:
    """A location model of the image, and what is known of it.

    Attributes
    ----------
    model : of the image, corrected
    bare : the model as it was read
    kind : for people
    offset : line and sample of the image's first pixel in the scene
    sigmas : of the sensor
    fit : of the correction, None without control
    camera : parameters of a frame camera, where control was to correct these
    """

    model: Any
    bare: Any
    kind: str
    offset: tuple[float, float]
    sigmas: Sigmas
    fit: BiasFit | None
    ellipsoid: Ellipsoid
    notes: list[str]
    camera: FrameFit | None = None


def run(args: argparse.Namespace) -> int:
    begun = time.perf_counter()
    with progress("rectifying", args.quiet or args.json) as told:
        sensor, ground, grid, factor, cells = rectified(args, told)
    _tell(args, sensor, ground, grid, factor, cells, time.perf_counter() - begun)
    return 0


def cells_of(args: argparse.Namespace) -> MapGrid:
    """The cells that an image would be rectified to.

    Raises
    ------
    UserError : an image, metadata or heights that do not go together
    """
    sensor = _sensor(args, SourceImage(Path(args.input), args.nodata))
    ground = ground_under(args, sensor)
    return _grid(args, sensor, ground, *edge_of(sensor.model, ground))[0]


def rectified(args: argparse.Namespace, told: Any = None) -> tuple[_Sensor, Ground, MapGrid, int, dict[str, int]]:
    """Rectify an image as the command line asks: sensor, ground, cells, pixels put together, cells by what is in them.

    Raises
    ------
    UserError : options, an image, metadata or heights that do not go together
    """
    _check(args)
    image = SourceImage(Path(args.input), args.nodata)
    sensor = _sensor(args, image)
    ground = ground_under(args, sensor)
    lat, lon = edge_of(sensor.model, ground)
    grid, pixel_m = _grid(args, sensor, ground, lat, lon)
    nodata = image.nodata if image.nodata is not None else float("nan") if image.dtype.kind == "f" else 0.0
    factor = 1 if args.resampling == "nearest" else max(int(_metres(grid, lat, lon) / pixel_m + 0.1), 1)
    factor = max(min(factor, image.lines // 8, image.samples // 8), 1)
    work = ImageRectification(
        sensor.model, image, grid, ground, args.resampling, factor, float(nodata), args.occlusions, args.direct,
        ellipsoid=sensor.ellipsoid, **({} if args.workers is None else {"workers": args.workers}),
    )  # fmt: skip
    sigma = _error_map(args, sensor)
    tags = {
        "TIFFTAG_IMAGEDESCRIPTION": f"{Path(args.input).name} by {sensor.kind}, {ground.words}, {args.resampling}, "
        + ("pixel to ground" if args.direct else "ground to pixel")
    }
    counts = work.run(
        args.output, mask=None if args.mask is None else Path(args.mask), sigma=sigma, tags=tags,
        compress="plain" if args.plain else args.compress or "deflate", told=told,
    )  # fmt: skip
    return sensor, ground, grid, factor, counts.cells


def _check(args: argparse.Namespace) -> None:
    for path in (args.output, args.mask, args.sigma):
        if path is not None:
            refuse_unless_writable(Path(path))
    refuse_over_files((args.output, args.mask, args.sigma), rasters_of_heights(args.dem or ()))
    named = [str(Path(p).resolve()) for p in (args.output, args.mask, args.sigma) if p is not None]
    if len(set(named)) < len(named):
        raise UserError("-o, --mask, --sigma: wanted different files")
    for name in ("orientation", "trajectory", "camera", "ccd", "strip"):
        if name != "ccd" and getattr(args, name):
            raise UserError(f"--{name}: goes with a recording, not with --sensor")
    refuse_occlusions_of_level_ground(args)
    if args.correction is not None and args.control is None:
        raise UserError(f"--correction {args.correction}: goes with --control CSV, whose points it is found by")
    if args.direct and (args.sigma or args.occlusions):
        raise UserError("--direct: sees nothing hidden and makes no sigmas, wanted without --occlusions and --sigma")
    refuse_empty_bounds(args)
    for name in ("position_sigma", "attitude_sigma", "pixel_sigma", "height_sigma"):
        value = getattr(args, name)
        if value is not None and not (np.isfinite(value).all() and (np.asarray(value) >= 0).all()):
            raise UserError(f"{flag(name)}: wanted numbers of at least 0")
        counts = args.control is not None if name == "pixel_sigma" else args.correction == "camera"
        if value is not None and args.sigma is None and not (counts and name in ("pixel_sigma", "height_sigma")):
            more = {"pixel_sigma": " or --control", "height_sigma": " or --correction camera"}.get(name, "")
            raise UserError(f"{flag(name)}: goes with --sigma FILE{more}, for which it counts")
    if args.control is not None and args.pixel_sigma == 0:
        raise UserError("--pixel-sigma 0: wanted more than 0 with --control, whose pixels are measured")
    if args.plain and args.compress is not None:
        raise UserError("--plain and --compress: wanted one of them")
    if args.workers is not None and args.workers < 1:
        raise UserError(f"--workers {args.workers}: wanted at least 1")


def refuse_empty_bounds(args: argparse.Namespace) -> None:
    """Refuse --bounds between which there is nothing."""
    if args.bounds is not None:
        left, bottom, right, top = args.bounds
        if not (np.abs(args.bounds).max() < MOST_COORDINATE and left < right and bottom < top):
            raise UserError(
                f"{words_of_bounds(args.bounds)}: wanted coordinates, left below right and bottom below top"
            )


def words_of_bounds(bounds: Sequence[float]) -> str:
    """Bounds as they are given on the command line."""
    return "--bounds " + " ".join(f"{value:.10g}" for value in bounds)


def refuse_occlusions_of_level_ground(args: argparse.Namespace) -> None:
    """Refuse --occlusions where no ground is higher than another."""
    if args.occlusions and not args.dem:
        raise UserError("--occlusions: goes with --dem, without which no ground is higher than another")


# -- the sensor ----------------------------------------------------------------------------------------------------


def _sensor(args: argparse.Namespace, image: SourceImage) -> _Sensor:
    path = Path(args.sensor)
    read = read_location_model(path, args.model, args.ccd)
    bare, sigmas, notes = read.model, read.sigmas, read.notes
    kind = "frame camera" if read.kind == "frame" else "RPC" if isinstance(bare, Rpc) else "rigorous model"
    bare = with_refraction(args, bare)
    ellipsoid = WGS84 if isinstance(bare, Rpc) else bare.ellipsoid
    unknown = isinstance(bare, Rpc) and not (bare.lines and bare.samples)
    if isinstance(bare, Rpc) and path.resolve() == image.path.resolve():
        unknown = _is_a_part(args, image)  # tags do not state the size of the scene
    line, sample = _first_pixel(args, image, bare, unknown, notes)
    if isinstance(bare, Rpc) and unknown:  # the scene reaches to the end of the image at least
        bare = replace(bare, lines=line + image.lines, samples=sample + image.samples)
    model: Any = bare
    if (line, sample) != (0, 0) or (bare.lines, bare.samples) != (image.lines, image.samples):
        model = CroppedModel(bare, line, sample, image.lines, image.samples)
    fit = None
    if args.control is not None and args.correction == "camera":
        found = _camera_by_control(args, Path(args.control), model, image, sigmas)
        if args.height_sigma is None:
            notes.append(
                f"control: its points are taken to be good to {GROUND_SIGMA_M:g} m in place and height; --height-sigma "
                "says better"
            )
        out = found.found.rejected
        if 2 * out.sum() > len(out):
            notes.append(
                f"{args.control}: {int(out.sum())} of {len(out)} points are left out: they contradict the others, or "
                f"what {path.name} says of place and attitude (its sigma; without one as good as of a star tracker)"
            )
        notes.extend(
            f"control: {word} {value:+.4g} {unit}: {abs(w):.1f} times what {path.name}, or usual cameras, let expect"
            for (word, value, _, unit), w in zip(_for_people(found), found.w, strict=True)
            if abs(w) > CRITICAL_W
        )
        return _Sensor(found.camera, found.camera, kind, (line, sample), sigmas, None, ellipsoid, notes, found)
    if args.control is not None:
        fit = _correction(args, Path(args.control), model, image)
        model = CorrectedModel(model, fit.bias)
        if fit.rejected.any():
            notes.append(f"{args.control}: {int(fit.rejected.sum())} points rejected by data snooping")
        if fit.bias.turned > LARGE_TURN:
            notes.append(
                f"{args.control}: turns or stretches the image by {100.0 * fit.bias.turned:.0f} % of its size, which "
                "metadata hardly want: are columns and rows those of the image as it is?"
            )
    return _Sensor(model, bare, kind, (line, sample), sigmas, fit, ellipsoid, notes)


def _is_a_part(args: argparse.Namespace, image: SourceImage) -> bool:
    """Whether an image with polynomials of its own is a part of the scene that they are of.

    Raises
    ------
    UserError : a part of which nobody says whether they are of the scene or of the image
    """
    if args.first_pixel is None and (crop := image.crop()) is not None:
        line, sample = crop
        raise UserError(
            f"{args.input}: a part of a scene by its geotransform, with RPC of its own: wanted --first-pixel {sample} "
            f"{line} if these are of the whole scene, --first-pixel 0 0 if they are of the part"
        )
    return args.first_pixel is not None and any(args.first_pixel)


def _first_pixel(
    args: argparse.Namespace, image: SourceImage, model: Any, unknown: bool, notes: list[str]
) -> tuple[int, int]:
    """Line and sample of the image's first pixel in the scene."""
    if args.first_pixel is not None:
        sample, line = args.first_pixel
    else:
        crop = image.crop()
        if crop is None:
            line = sample = 0
            if not unknown and (model.lines, model.samples) != (image.lines, image.samples):
                raise UserError(
                    f"{args.input}: {image.samples} x {image.lines} pixels, but {args.sensor} is of {model.samples} x "
                    f"{model.lines}: wanted that image, or --first-pixel COLUMN ROW for a part of it"
                )
        else:
            line, sample = crop
            notes.append(
                f"{Path(args.input).name}: a part of the scene, first pixel at column {sample}, row {line} by its "
                "geotransform"
            )
    end = line + image.lines, sample + image.samples
    if not unknown and (min(line, sample) < 0 or end[0] > model.lines or end[1] > model.samples):
        raise UserError(
            f"{args.input}: columns {sample} to {end[1] - 1}, rows {line} to {end[0] - 1} of the scene, but "
            f"{args.sensor} is of {model.samples} x {model.lines} pixels"
        )
    return line, sample


def _control(path: Path, image: SourceImage) -> Any:
    table = read_table(path, _CONTROL, [])
    u, v = table["row"], table["column"]
    size = f"the image has {image.samples} columns and {image.lines} rows"
    outside = (u < -0.5) | (u > image.lines - 0.5)
    table.refuse(outside, "row", lambda k: f"{u[k]:g}: outside, {size}")
    table.refuse((v < -0.5) | (v > image.samples - 0.5), "column", lambda k: f"{v[k]:g}: outside, {size}")
    return table


def _camera_by_control(
    args: argparse.Namespace, path: Path, model: Any, image: SourceImage, sigmas: Sigmas
) -> FrameFit:
    """The frame camera with the parameters of `THIRTEEN`, by control with errors in pixel and height.

    ``sigmas`` : of place and attitude, as the metadata state them
    """
    if not isinstance(model, FrameCamera):
        raise UserError("--correction camera: goes with the whole image of a frame camera, wanted shift or affine")
    if args.sigma:
        raise UserError("--sigma: goes with --correction shift or affine, not with camera")
    table = _control(path, image)
    control = FrameControl(
        table["row"], table["column"], np.radians(table["lat_deg"]), np.radians(table["lon_deg"]), table["height_m"]
    )
    top = float(model.ellipsoid.geodetic(model.position_e)[2])
    table.refuse(control.height_m >= top, "height_m", lambda k: f"{control.height_m[k]:g}: the camera is at {top:g} m")
    _refuse_elsewhere(table, model, image)
    lost = np.isnan(model.direct(control.line, control.sample, control.height_m)).any(axis=1)
    table.refuse(lost, "column, row", lambda k: f"the ray does not come down to {control.height_m[k]:g} m")
    height_m = GROUND_SIGMA_M if args.height_sigma is None else args.height_sigma
    try:
        return fit_frame(
            model, control, THIRTEEN, pixel_sigma=args.pixel_sigma or CONTROL_SIGMA_PX, height_sigma_m=height_m,
            ground_sigma_m=height_m, prior_sigma=stated_priors(model, sigmas.position_m, sigmas.attitude_rad),
        )  # fmt: skip
    except ValueError as error:
        raise UserError(
            f"{path}: {error}: wanted rows counted from above, columns from the left, and the camera of this image"
        ) from None


def _correction(args: argparse.Namespace, path: Path, model: Any, image: SourceImage) -> BiasFit:
    table = _control(path, image)
    u, v = table["row"], table["column"]
    lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
    sigma = args.pixel_sigma or CONTROL_SIGMA_PX
    wide = _refuse_elsewhere(table, model, image)
    try:
        return fit_bias(
            wide,
            lat,
            lon,
            table["height_m"],
            u,
            v,
            sigma,
            affine=args.correction != "shift",
            stated=args.pixel_sigma is not None,
        )
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def _refuse_elsewhere(table: Any, model: Any, image: SourceImage) -> _Wide:
    """Refuse control that the model sees nowhere near the image; the model that says so."""
    # the image may be off by more than its size: the model alone says where a point would appear
    wide = _Wide(image.lines, image.samples, model)
    lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
    unseen = np.isnan(wide.inverse(lat, lon, table["height_m"])).any(axis=1)
    place = "is not in the image, nor within its size of it; wanted longitude and latitude in degrees"
    table.refuse(unseen, "lon_deg, lat_deg", lambda k: f"{table['lon_deg'][k]:g}, {table['lat_deg'][k]:g} {place}")
    return wide


@dataclass
class _Wide:
    """A model that answers as far as its own size around the image."""

    lines: int
    samples: int
    model: Any

    def direct(self, line: Any, sample: Any, height_m: Any) -> Array:
        return self.model.direct(line, sample, height_m)

    def inverse(self, lat: Any, lon: Any, height_m: Any, margin_px: float = 0.0) -> Array:
        return self.model.inverse(lat, lon, height_m, float(max(self.lines, self.samples)))


# -- the ground ----------------------------------------------------------------------------------------------------


def ground_under(args: argparse.Namespace, sensor: _Sensor) -> Ground:
    """The ground that the command line asks for, under the image."""
    model = sensor.model
    guess = float(sensor.bare.to_image.in_offset[2]) if isinstance(sensor.bare, Rpc) else 0.0
    refuse_datum_without_raster(args)
    if not args.dem:
        h = guess if args.height is None else args.height
        ground = Ground(h, h, h, 1.0, f"height {h:.1f} m above the ellipsoid")
        if not np.isfinite(edge_of(model, ground)[0]).any():
            raise UserError(f"{args.sensor}: the image does not see the ground at {h:g} m")
        return ground
    raster = HeightRaster(rasters_of_heights(args.dem), args.dem_crs, args.dem_datum, sensor.ellipsoid)
    sensor.notes.extend(raster.notes)
    low, high = height_range(
        lambda h: edge_of(model, Ground(h, h, h, 1.0, ""), 60), raster, guess, args.sensor, "the pixels of the image"
    )
    low, high = below_camera(model if isinstance(model, FrameCamera) else sensor.bare, low, high)
    u, v = np.meshgrid(np.linspace(0, model.lines - 1, 25), np.linspace(0, model.samples - 1, 25))
    met = meet_terrain(model, u.ravel(), v.ravel(), raster, low, high)
    covered = float(np.isfinite(met.lat).mean())
    if covered == 0.0:
        raise UserError(f"{raster.name}: knows no height under the image")
    if covered < 1.0:
        share = "more than 99" if covered > 0.99 else f"{100 * covered:.0f}"
        sensor.notes.append(f"{raster.name}: covers {share} % of the image, the rest is missing")
    return Ground(raster, low, high, covered, f"heights of {raster.name} {raster.datum}")


# -- the cells -----------------------------------------------------------------------------------------------------


def _grid(args: argparse.Namespace, sensor: _Sensor, ground: Ground, lat: Array, lon: Array) -> tuple[MapGrid, float]:
    """The cells, and the size of a pixel on the ground, metres."""
    seen = np.isfinite(lat)
    if not seen.any():
        raise UserError(f"{args.input}: none of its pixels sees the ground")
    mean = np.stack([np.cos(lat[seen]) * np.cos(lon[seen]), np.cos(lat[seen]) * np.sin(lon[seen]), np.sin(lat[seen])])
    x, y, z = mean.mean(axis=1)
    middle = float(np.arctan2(z, np.hypot(x, y))), float(np.arctan2(y, x))
    crs = args.crs or default_crs(*middle, sensor.ellipsoid)
    if crs == "local":
        raise UserError("--crs local: goes with a recording, an image wants a projected or geographic CRS")
    try:
        unit = MapGrid(crs, 0.0, 0.0, 1.0, 1, 1, sensor.ellipsoid)
        x, y = unit.map(lat[seen], lon[seen])
    except ValueError as error:
        raise UserError(f"--crs: {error}") from None
    if args.bounds is None and _is_over_the_date_line(unit, x, middle[0], lon[seen] - middle[1]):
        raise UserError(
            f"--crs {crs}: the image lies across the date line, the two sides of which are the two ends of that CRS; "
            f"wanted another one such as {default_crs(*middle, sensor.ellipsoid)}, or --bounds of one side"
        )
    sensor.notes.extend(notes_of_map(crs))
    model = sensor.model
    h = np.array([0.5 * (ground.low_m + ground.high_m)])
    centre = SomeCells(np.zeros((1, 2)), np.array([0.5 * (model.lines - 1)]), np.array([0.5 * (model.samples - 1)]), h)
    by_pixel = ground_steps(model, centre, sensor.ellipsoid)[0][0]
    pixel_m = float(np.sqrt(abs(np.linalg.det(by_pixel))))
    longest = float(np.linalg.norm(by_pixel, axis=0).max())
    if not np.isfinite(pixel_m):
        raise UserError(f"{args.sensor}: the middle of the image does not see the ground")
    a_metre = 1.0 / _metres(unit, lat, lon)
    gsd = args.gsd or float(f"{pixel_m * a_metre:.2g}")
    try:
        grid = replace(unit, gsd=gsd)
        if args.bounds is None:
            grid = grid.over(x, y, 1.0 + float(np.ceil(longest * a_metre / gsd)))
        else:
            left, bottom, right, top = args.bounds
            grid = grid.over(np.array([left, right]), np.array([bottom, top]), 0.0)
    except (ValueError, OverflowError) as error:
        raise UserError(f"--crs {crs}: {error}") from None
    if max(grid.rows, grid.columns) > MOST_SIDE:
        raise UserError(f"--gsd {gsd:g}: {grid.columns:.3g} x {grid.rows:.3g} cells are too many, wanted a larger one")
    return grid, pixel_m


def _is_over_the_date_line(grid: MapGrid, x: Array, lat: float, from_middle: Array) -> bool:
    """Whether places (n,) near each other, by longitudes from their middle, are at both ends of a CRS; rad."""
    near = (from_middle + np.pi) % (2.0 * np.pi) - np.pi
    if np.ptp(near) > 0.5 * np.pi:  # round a pole, or half of a planet
        return False
    sides, _ = grid.map(np.full(2, lat), np.pi * np.array([-1.0, 1.0]) * (1.0 - 1e-9))
    jump, wide = abs(float(sides[1] - sides[0])), float(np.nanmax(x) - np.nanmin(x))
    return 0.01 * wide < jump < 2.0 * wide


def _metres(grid: MapGrid, lat: Array, lon: Array) -> float:
    """Size of a cell in metres, at the middle of places (n,)."""
    seen = np.isfinite(lat)
    x, y = grid.map(lat[seen], lon[seen])
    x0, y0 = np.nanmean(x), np.nanmean(y)
    column, row = (x0 - grid.left) / grid.gsd - 0.5, (grid.top - y0) / grid.gsd - 0.5
    a, o = grid.where(np.array([column, column + 1.0, column]), np.array([row, row, row + 1.0]))
    east, north = metres_a_radian(a[:1], np.zeros(1), grid.ellipsoid)
    en = np.stack([(o[1:] - o[0]) * east, (a[1:] - a[0]) * north], axis=1)
    return float(np.sqrt(abs(np.linalg.det(en))))


# -- errors --------------------------------------------------------------------------------------------------------


def _error_map(args: argparse.Namespace, sensor: _Sensor) -> ErrorMap | None:
    if args.sigma is None:
        return None
    stated = stated_sigmas(args, sensor.sigmas)
    position, attitude, pixel, height = stated.position_m, stated.attitude_rad, stated.pixel, stated.height_m
    if not height and args.height_sigma is None and not args.mosaic:
        sensor.notes.append(NO_HEIGHT_SIGMA)
    bare, fit = sensor.bare, sensor.fit
    oriented = any((*position, *attitude))
    rpc_m2 = 0.0
    if isinstance(bare, Rpc):
        if oriented:
            raise UserError(
                f"{args.sensor}: --position-sigma and --attitude-sigma go with a rigorous model, not with RPC"
            )
        rpc_m2 = bare.error_bias_m**2 + bare.error_random_m**2
    factor = 1.0
    if fit is not None:
        words = "sigma: of the correction by control, in place of the orientation's"
        if args.pixel_sigma is None and fit.redundancy > 0:  # nobody has stated how well control is measured
            few = fit.redundancy < LEAST_REDUNDANCY  # a few points may fit well by chance
            factor = max(fit.sigma0, 1.0) if few else fit.sigma0
            good = "half a pixel, since few points do not tell" if few and factor == 1.0 else "it fits"
            words += f", with control as good as {good} ({factor * CONTROL_SIGMA_PX:.2g} px)"
        sensor.notes.append(words)
    elif not (oriented or rpc_m2 or stated.time_s):
        sensor.notes.append(
            "sigma: no sigma of the orientation is known (--position-sigma, --attitude-sigma, --control)"
        )
    if not (any(pixel) or height or oriented or rpc_m2 or fit is not None or stated.time_s):
        raise UserError("--sigma: no sigma is known, wanted --height-sigma, --pixel-sigma, --position-sigma or others")
    sensor_sigmas = replace(stated, pixel=(0.0, 0.0), height_m=0.0)
    matching = np.diag(np.square(pixel))

    def errors(line: Array, sample: Array, height_m: Array) -> tuple[Array, Array]:
        Q = np.broadcast_to(matching, (len(line), 2, 2)).copy()
        level = np.zeros(len(line))
        if fit is not None:
            T = np.column_stack(
                [np.ones(len(line)), (np.column_stack([line, sample]) - fit.bias.middle) / fit.bias.half]
            )
            J = np.zeros((len(line), 2, 6))
            J[:, 0, :3], J[:, 1, 3:] = T, T
            return Q + factor**2 * J @ fit.bias.covariance @ np.swapaxes(J, 1, 2), level
        u, v = line + sensor.offset[0], sample + sensor.offset[1]
        if isinstance(bare, PushbroomSensor) and sensor_sigmas.any:
            u = np.clip(u, 0.0, bare.lines - 1.0)
            Q += pixel_covariance(bare, u, v, height_m, sensor_sigmas)
        elif isinstance(bare, FrameCamera) and sensor_sigmas.any:
            J = bare.image_derivatives(u, v, height_m)
            Q += J @ np.diag(np.square([*position, *attitude])) @ np.swapaxes(J, 1, 2)
        return Q, level + rpc_m2

    return ErrorMap(Path(args.sigma), errors, float(height))


def _for_people(fit: FrameFit) -> list[tuple[str, float, float, str]]:
    """Parameters with their sigmas: turns in degrees, the place in metres."""
    lat, _, h = fit.camera.ellipsoid.geodetic(fit.camera.position_e)
    east, north = metres_a_radian(lat, h, fit.camera.ellipsoid)
    units = {"lat": ("north", float(north), "m"), "lon": ("east", float(east), "m"), "h": ("up", 1.0, "m")}
    units |= {name: (name, float(np.degrees(1.0)), "deg") for name in ("omega", "phi", "kappa")}
    told = []
    for name, value, sigma in zip(fit.names, fit.found.parameters, fit.found.sigma, strict=True):
        word, factor, unit = units.get(name, (name, 1.0, UNITS[name]))
        told.append((word, factor * float(value), factor * float(sigma), unit))
    return told


# -- what is told --------------------------------------------------------------------------------------------------


def _tell(
    args: argparse.Namespace, sensor: _Sensor, ground: Ground, grid: MapGrid, factor: int, cells: dict[str, int],
    seconds: float,
) -> None:  # fmt: skip
    result: dict[str, Any] = {
        "output": str(args.output), "sensor": str(args.sensor), "model": sensor.kind, "crs": grid.crs, "gsd": grid.gsd,
        "rows": grid.rows, "columns": grid.columns, "ground": ground.words, "resampling": args.resampling,
        "path": "direct" if args.direct else "indirect", "pixels_together": factor, "cells": cells,
        "mask": args.mask, "sigma": args.sigma, "notes": sensor.notes, "seconds": round(seconds, 3),
    }  # fmt: skip
    fit = sensor.fit
    if fit is not None:
        used = ~fit.rejected
        result["control"] = {
            "points": len(used), "rejected": int(fit.rejected.sum()), "sigma0": fit.sigma0,
            "redundancy": fit.redundancy, "correction": args.correction or "affine",
            "shift_px": fit.bias.coefficients[:, 0].tolist(),
            "rms_px": np.sqrt(np.mean(fit.residual_px[used] ** 2, axis=0)).tolist(),
        }  # fmt: skip
    if sensor.camera is not None:
        found = sensor.camera.found
        result["control"] = {
            "points": len(found.rejected), "rejected": int(found.rejected.sum()), "sigma0": found.sigma0,
            "redundancy": found.redundancy, "correction": args.correction,
            "parameters": {
                name: {"change": float(x), "sigma": float(s), "unit": UNITS[name]}
                for name, x, s in zip(sensor.camera.names, found.parameters, found.sigma, strict=True)
            },
            "corrections": [
                {"point": k + 1, **{
                    name: {"correction": float(v[c]), "sigma": float(s[c])}
                    for c, name in enumerate(("row_px", "column_px", "height_m", "east_m", "north_m"))
                }}
                for k, (v, s) in enumerate(zip(found.corrections, found.correction_sigma, strict=True))
                if not found.rejected[k]
            ],
        }  # fmt: skip
    if args.json:
        print(json_text(result))
        return
    print(
        f"{args.output}: {grid.rows} x {grid.columns} cells of {grid.gsd:g} {unit_of(grid.crs)} in {grid.crs}, "
        f"{sensor.kind}, {ground.words}, {seconds:.1f} s"
    )
    missing = [f"{n} cells {name}" for name, n in cells.items() if n and name != "value"]
    print(f"  {cells['value']} cells with a value" + (", " + ", ".join(missing) if missing else ""))
    if fit is not None:
        line, sample = result["control"]["shift_px"]
        sigma0 = f"sigma0 {fit.sigma0:.2f}" if fit.redundancy else "no redundancy"
        print(
            f"  control: {len(fit.rejected)} points, {int(fit.rejected.sum())} rejected, {sigma0}, "
            f"shift of lines {line:+.2f} px, of samples {sample:+.2f} px"
        )
    if sensor.camera is not None:
        found, n = sensor.camera.found, len(sensor.camera.names)
        out = int(found.rejected.sum())
        print(
            f"  control: {len(found.rejected)} points, {out} rejected, sigma0 {found.sigma0:.2f}, {n} camera parameters"
        )
        for name, value, sigma, unit in _for_people(sensor.camera):
            print(f"    {name:9s} {value:12.5g} +- {sigma:.2g} {unit}")
    if not args.quiet:
        for note in sensor.notes:
            print(f"  note: {note}")
