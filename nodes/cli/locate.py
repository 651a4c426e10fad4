"""``triline locate``: pixels to the ground and back, by the rigorous model or RPC of a scene, or a frame camera."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.ellipsoid import WGS84
from ...solver.location.in_image import in_image
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import Sigmas, ground_derivatives, pixel_covariance
from ...solver.rectification.error_map import derivatives_on_terrain
from ...solver.rectification.occlusion import ground_slopes
from ...solver.rectification.pixel_to_cell import meet_terrain
from ..errors import UserError
from ..formats.height_raster import DATUMS, HeightRaster
from ..formats.json_text import json_text
from ..formats.new_file import new_file
from ..formats.table import Column, Table, read_table, write_table
from .heights_under import NothingUnder, below_camera, height_range, rasters_of_heights
from .location_model import SENSORS, Model, read_location_model
from .location_options import add_orientation_sigmas, refuse_datum_without_raster, stated_sigmas, with_refraction
from .outputs import refuse_over_files

EXAMPLE = """triline locate DIM_PHR1A.XML --pixels pixels.csv -o ground.csv
  triline locate DIM_PHR1A.XML --pixels pixels.csv --dem N44E005.hgt --dem-datum EPSG:5773 -o ground.csv"""

Array = NDArray[np.floating]

_PIXELS = (Column("column"), Column("row"))
_GROUND = (Column("lon_deg", low=-360.0), Column("lat_deg", low=-90.0))
_HEIGHT = Column("height_m")
#: With a raster of heights the column may be missing, and is not used.
_NO_HEIGHT = Column("height_m", optional=True, blank=True)
#: Note of a row without a place.
NOTHING_GIVEN = "nothing given"
#: Heights so many times as far from the middle of those of an RPC as the highest of them are told. Tuned, and no place
#: hangs on it: rays of the RPC of a Pleiades image are straight to 3 cm at ten times, and bent by 20 m at fifty.
EXTRAPOLATED = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sensor", metavar="META", help="metadata of a scene or image: " + "; ".join(SENSORS.values()))
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--pixels", metavar="CSV", help="column,row,height_m: 0-based, integers at pixel centres, above the ellipsoid"
    )
    what.add_argument("--ground", metavar="CSV", help="lon_deg,lat_deg,height_m")
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="CSV",
        help="lon_deg,lat_deg,height_m, or column,row; note where a row misses",
    )
    parser.add_argument(
        "--dem", metavar="FILE", action="append",
        help="raster of heights, in place of height_m: pixels are where their rays meet it, ground points lie on it; "
        "may be given again, or a folder of tiles",
    )  # fmt: skip
    parser.add_argument("--dem-crs", metavar="CRS", help="of the raster; or ellipsoid, EPSG:5773 .. alone")
    parser.add_argument("--dem-datum", metavar="DATUM", help=f"of its heights: {DATUMS}")
    parser.add_argument("--model", choices=("rigorous", "rpc"), help="where the file has both (default: rigorous)")
    parser.add_argument(
        "--ccd", metavar="ID", help="line of detectors, where the scene has several (default: the first)"
    )
    parser.add_argument(
        "--refraction",
        nargs="*",
        type=float,
        metavar="VALUE",
        help="bend the rays in the air: alone for the standard atmosphere, or temperature (K), pressure (hPa) and "
        "vapour pressure (hPa) at sea level (default: straight rays)",
    )
    add_orientation_sigmas(parser)
    parser.add_argument("--pixel-sigma", type=float, metavar="PX", help="of line and sample")
    parser.add_argument("--height-sigma", type=float, metavar="M", help="of the heights given, or of the raster")


def run(args: argparse.Namespace) -> int:
    scene = read_location_model(Path(args.sensor), args.model, args.ccd)
    model, notes = with_refraction(args, scene.model), scene.notes
    sigmas = stated_sigmas(args, scene.sigmas)
    if sigmas.any and isinstance(model, Rpc):
        raise UserError(f"{args.sensor}: sigmas go with a rigorous model, this is an RPC")
    terrain = _terrain(args, model)
    notes += [] if terrain is None else terrain.notes
    if args.pixels:
        columns, missed = _to_ground(Path(args.pixels), model, terrain, sigmas, notes, args.sensor)
    else:
        columns, missed = _to_pixels(Path(args.ground), model, terrain, sigmas, notes)
    if isinstance(model, Rpc):
        notes += _beyond_heights(model, np.asarray(columns["height_m"], dtype=float))
    with new_file(Path(args.output)) as part:
        write_table(part, columns, _FORMATS)
    result = {
        "sensor": str(args.sensor),
        "kind": scene.kind,
        "model": "rpc" if isinstance(model, Rpc) else "rigorous",
        "heights": "of the file" if terrain is None else f"{terrain.name}, {terrain.datum}",
        "output": str(args.output),
        "rows": len(next(iter(columns.values()))),
        "missed": missed,
        "notes": notes,
    }
    if args.json:
        print(json_text(result))
    elif not args.quiet:
        print(f"{args.sensor} ({SENSORS[scene.kind]}, {result['model']} model) -> {args.output}")
        print(f"  {result['rows']} rows, {missed} of them miss; heights {result['heights']}")
        for note in notes:
            print(f"  note: {note}")
    return 0


_FORMATS = {
    "lon_deg": ".10f", "lat_deg": ".10f", "height_m": ".4f", "column": ".6f", "row": ".6f",
    "sigma_e_m": ".4f", "sigma_n_m": ".4f", "sigma_u_m": ".4f", "sigma_column": ".4f", "sigma_row": ".4f",
}  # fmt: skip


def _terrain(args: argparse.Namespace, model: Model) -> HeightRaster | None:
    """The raster of heights that the command line names."""
    refuse_datum_without_raster(args)
    if not args.dem:
        return None
    ellipsoid = WGS84 if isinstance(model, Rpc) else model.ellipsoid
    rasters = rasters_of_heights(args.dem)
    refuse_over_files((args.output,), rasters)
    return HeightRaster(rasters, args.dem_crs, args.dem_datum, ellipsoid)


def _table(path: Path, columns: tuple[Column, ...], terrain: HeightRaster | None, notes: list[str]) -> Table:
    """The rows of a file; those without a place, as they are written for what misses, stay so."""
    needed = columns if terrain is not None else (*columns, _HEIGHT)
    more = () if terrain is None else (_NO_HEIGHT,)
    table = read_table(path, [*(replace(column, blank=True) for column in needed), *more], notes)
    empty = np.logical_and.reduce([np.isnan(table[column.name]) for column in columns])
    for column in needed:
        missing = np.isnan(table[column.name]) & ~empty
        table.refuse(missing, column.name, lambda row: "missing, wanted a number")
    if terrain is not None and "height_m" in table and np.isfinite(table["height_m"]).any():
        notes.append(f"{path}: height_m is not used: heights are those of {terrain.name}")
    return table


def _to_ground(
    path: Path, model: Model, terrain: HeightRaster | None, sigmas: Sigmas, notes: list[str], scene: str
) -> tuple[dict[str, Any], int]:
    table = _table(path, _PIXELS, terrain, notes)
    u, v = table["row"], table["column"]
    note = _outside(model, u, v)
    note[np.isnan(u)] = NOTHING_GIVEN
    inside = np.flatnonzero(note == "")
    located, slope = np.full((len(u), 3), np.nan), None
    if terrain is None:
        located[inside] = model.direct(u[inside], v[inside], table["height_m"][inside])
        note[inside[np.isnan(located[inside, 0])]] = "the ray misses the ground"
    elif len(inside):
        located[inside], slope = _met(model, u[inside], v[inside], terrain, scene, notes)
        unmet = inside[np.isnan(located[inside, 0])]
        note[unmet] = f"no height of {terrain.name} where the ray comes down"
        passing = np.isnan(model.direct(u[unmet], v[unmet], np.zeros(len(unmet)))[:, 0])
        note[unmet[passing]] = "the ray misses the ground"
    seen = np.flatnonzero(np.isfinite(located[:, 0]))
    columns: dict[str, Any] = {
        "column": v, "row": u, "lon_deg": np.degrees(located[:, 1]), "lat_deg": np.degrees(located[:, 0]),
        "height_m": located[:, 2],
    }  # fmt: skip
    if sigmas.any and not isinstance(model, Rpc):
        J = ground_derivatives(model, u[seen], v[seen], located[seen, 2])
        if slope is not None:
            J = derivatives_on_terrain(J, slope[np.isfinite(located[inside, 0])])
        sigma = np.full((len(u), 3), np.nan)
        sigma[seen] = np.sqrt(np.square(J * sigmas.values).sum(axis=2))
        columns |= {name: sigma[:, k] for k, name in enumerate(("sigma_e_m", "sigma_n_m", "sigma_u_m"))}
    columns["note"] = note
    return columns, len(u) - len(seen)


def _met(model: Model, u: Array, v: Array, terrain: HeightRaster, scene: str, notes: list[str]) -> tuple[Array, Array]:
    """Latitude, longitude and height (n, 3) at which rays of pixels meet the terrain, and its slope there (n, 2)."""
    guess = float(model.to_image.in_offset[2]) if isinstance(model, Rpc) else 0.0
    located, slope = np.full((len(u), 3), np.nan), np.full((len(u), 2), np.nan)
    rest = np.arange(len(u))
    while len(rest):

        def places(height_m: float, rest: NDArray[np.intp] = rest) -> tuple[Array, Array]:
            at = model.direct(u[rest], v[rest], np.full(len(rest), height_m))
            return at[:, 0], at[:, 1]

        try:
            low, high = height_range(places, terrain, guess, scene, "the pixels")
        except NothingUnder as reason:
            if len(rest) == len(u):
                notes.append(str(reason))
            break
        low, high = below_camera(model, low, high)
        met = meet_terrain(model, u[rest], v[rest], terrain, low, high)
        here = np.isfinite(met.lat)
        if here.any():
            some, lat, lon, height_m = rest[here], met.lat[here], met.lon[here], met.height_m[here]
            located[some] = np.column_stack([lat, lon, height_m])
            slope[some] = ground_slopes(terrain, lat, lon, height_m, terrain.ellipsoid)
        # what is left may lie on heights that are not among those under the others
        before, rest = len(rest), rest[np.isnan(located[rest, 0])]
        if len(rest) == before:
            break
    return located, slope


def _beyond_heights(rpc: Rpc, height_m: Array) -> list[str]:
    """A note where heights lie far beyond those that an RPC was made for."""
    middle, half = float(rpc.to_image.in_offset[2]), float(rpc.to_image.in_scale[2])
    beyond = np.abs(height_m - middle) > EXTRAPOLATED * half
    if not beyond.any():
        return []
    farthest = height_m[beyond][np.argmax(np.abs(height_m[beyond] - middle))]
    return [
        f"heights of {beyond.sum()} rows, up to {farthest:.0f} m, lie beyond those that the RPC was made for "
        f"({round(middle - half)} to {round(middle + half)} m): its places there may be wrong"
    ]


def _outside(model: Model, u: Array, v: Array) -> NDArray[np.object_]:
    """A note for pixels outside the image."""
    note = np.full(len(u), "", dtype=object)
    size = f" of {model.samples} columns and {model.lines} rows" if model.lines and model.samples else ""
    note[~in_image(np.column_stack([u, v]), model.lines, model.samples)] = f"outside the image{size}"
    return note


def _to_pixels(
    path: Path, model: Model, terrain: HeightRaster | None, sigmas: Sigmas, notes: list[str]
) -> tuple[dict[str, Any], int]:
    table = _table(path, _GROUND, terrain, notes)
    if not (model.lines and model.samples):
        notes.append(
            "the polynomials do not say how large the image is: points beyond its last row or column have a pixel"
        )
    table.refuse(np.abs(table["lat_deg"]) > 90.0, "lat_deg", lambda row: "a latitude beyond 90 degrees")
    lat, lon = np.radians(table["lat_deg"]), np.radians(table["lon_deg"])
    given = np.isfinite(lat)
    h = np.full(len(lat), np.nan)
    h[given] = table["height_m"][given] if terrain is None else terrain.at(lat[given], lon[given])
    known = np.isfinite(h)
    pixel = np.full((len(h), 2), np.nan)
    pixel[known] = model.inverse(lat[known], lon[known], h[known], 0.0)
    seen = np.flatnonzero(np.isfinite(pixel[:, 0]))
    note = np.full(len(pixel), "not in the image", dtype=object)
    if terrain is not None:
        note[~known] = f"no height of {terrain.name} there"
    note[~given] = NOTHING_GIVEN
    note[seen] = ""
    columns: dict[str, Any] = {
        "lon_deg": table["lon_deg"], "lat_deg": table["lat_deg"], "height_m": h,
        "column": pixel[:, 1], "row": pixel[:, 0],
    }  # fmt: skip
    if sigmas.any and not isinstance(model, Rpc):
        covariance = np.full((len(pixel), 2, 2), np.nan)
        covariance[seen] = pixel_covariance(model, pixel[seen, 0], pixel[seen, 1], h[seen], sigmas)
        for k, name in enumerate(("sigma_row", "sigma_column")):
            columns[name] = np.sqrt(covariance[:, k, k])
    columns["note"] = note
    return columns, len(pixel) - len(seen)
