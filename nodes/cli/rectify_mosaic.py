"""``triline rectify INPUT.. --mosaic``: the strips of recordings, images and orthoimages to one mosaic, job by job."""

from __future__ import annotations

import argparse
import copy
import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ...solver.camera.line_camera import LineCamera
from ...solver.orthoimage.ground_grid import GroundGrid
from ..batch.block_mosaic import (
    BALANCES,
    SEAMS,
    MosaicSettings,
    Outputs,
    balance_left_out,
    empty_layers,
    layers_in,
    make_mosaic,
    put_together,
    read_balance,
)
from ..batch.mosaic_jobs import CACHE_MB, Job, Workers, open_parts, remove_parts, write_json
from ..batch.mosaic_layers import (
    Layer,
    SpillingMosaic,
    forget_files,
    layer_of_mosaic,
    layer_of_orthoimage,
)
from ..batch.rectification import Rectification, line_blocks
from ..errors import UserError, flag
from ..formats.geotiff import is_virtual
from ..formats.height_raster import RasterFile
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_writable
from ..formats.projection import notes_of_map, unit_of
from ..formats.stac import write_stac_item
from ..recording.access import Recording
from ..recording.reader import RecordingReader
from ..recording.same_flight import beginning_alike
from ..worker_pool import cores
from . import rectify_image
from .damage import tell_damage, tell_other_camera, tell_other_frame
from .heights_under import rasters_of_heights
from .named_files import named_files
from .outputs import refuse_over_files
from .progress import progress
from .rectify_recording import TRUTH_ALONE, Prepared, cells_of, check_strips, pixels_together, prepared

#: Cells a side of a tile: least, and when nobody asks for another.
LEAST_TILE, TILE = 128, 1024
#: Options (as attributes) that only a mosaic takes.
OPTIONS = ("tile", "balance", "seams", "feather", "source", "seam_lines", "input_sigma", "stac", "keep")
#: Image lines that are older count seconds of the project's own: nobody recorded any in 1972. Definition.
FIRST_UTC_S = 2 * 365 * 86400
#: Ends of the names of recordings; everything else is an image.
_RECORDINGS = (".mcap",)
#: Recordings that a process keeps ready at most.
KEPT_RECORDINGS = 2
#: Options of images and recordings that a mosaic of several does not take.
_NOT_OF_MOSAIC = {
    "trajectory": "recording",
    **dict.fromkeys(("control", "correction", "first_pixel", "mask", "bounds", "direct", "plain"), "image"),
}

#: Options without effect where the inputs have no image with its metadata, no recording, or neither of them.
_OF_IMAGES = ("model", "dem_datum", "nodata", "position_sigma", "attitude_sigma")
_OF_RECORDINGS = ("orientation", "camera", "strip")
_OF_BOTH = ("dem", "dem_crs", "height", "occlusions", "refraction", "ccd", "pixel_sigma", "height_sigma")


#: Those that are ready, by the words that say all that they depend on.
_prepared: dict[str, Prepared] = {}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of a mosaic."""
    group = parser.add_argument_group("a mosaic of strips, recordings, images (--sensor for each) and orthoimages")
    group.add_argument("--mosaic", action="store_true", help="balance, part by seams and blend what overlaps")
    group.add_argument("--tile", type=int, metavar="N", help=f"cells a side of the tiles (default: {TILE})")
    group.add_argument(
        "--balance", choices=BALANCES,
        help="gain and offset of each strip; fall-off: and the fall-off of light of each CCD line (default: fall-off)",
    )  # fmt: skip
    group.add_argument("--seams", choices=SEAMS, help="least cuts, or halfway between strips (default: cut)")
    group.add_argument("--feather", type=int, metavar="N", help="cells over which strips change (default: 8)")
    group.add_argument("--source", type=Path, metavar="FILE", help="which strip a cell is of (OUTPUT.source.tif)")
    group.add_argument("--seam-lines", type=Path, metavar="FILE", help="GeoJSON (OUTPUT.seams.geojson)")
    group.add_argument(
        "--input-sigma", type=Path, action="append", metavar="FILE", help="sigmas of an orthoimage, for each in order"
    )
    group.add_argument("--stac", type=Path, metavar="FILE", help="also write a STAC item, JSON")
    group.add_argument("--keep", action="store_true", help="keep the tiles and layers in OUTPUT.parts")


def refuse_options(args: argparse.Namespace) -> None:
    """Refuse options of a mosaic without --mosaic."""
    for name in OPTIONS:
        if rectify_image.is_given(args, name):
            raise UserError(f"{flag(name)}: goes with --mosaic")


def run(args: argparse.Namespace) -> int:
    begun = time.perf_counter()
    outputs = _outputs(args)
    _check(args, outputs)
    workers = args.workers or cores()
    kinds = _kinds(args)
    _refuse_without_effect(args, {kind for kind, _, _ in kinds})
    _refuse_inputs(args, outputs, kinds)
    _refuse_one_flight_twice([path for kind, path, _ in kinds if kind == "recording"])
    crs, gsd = _cells(args, kinds)
    if args.stac is not None and crs == "local":
        raise UserError("--stac: wanted a map projection (--crs), not the local frame")
    settings = MosaicSettings(
        None if crs == "local" else crs, gsd, args.tile or TILE, args.balance or "fall-off", args.seams or "cut",
        8 if args.feather is None else args.feather, args.sigma is not None,
    )  # fmt: skip
    folder = args.output.with_name(args.output.name + ".parts")
    forget_files()
    continued = open_parts(folder, _plan(args, kinds, settings))
    (folder / "layers").mkdir(exist_ok=True)
    jobs = _layer_jobs(args, kinds, folder, settings, crs)
    import rasterio

    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB), Workers(workers) as pool:
        with progress("rectifying", args.quiet or args.json) as told:
            before = pool.run(layer_job, jobs, told)
        layers = layers_in(folder)
        with progress("mosaic", args.quiet or args.json) as told:
            counts = make_mosaic(folder, layers, settings, pool, told)
    tags = {"TIFFTAG_IMAGEDESCRIPTION": f"mosaic of {len(layers)} layers, balance {settings.balance}"}
    done = put_together(folder, layers, settings, outputs, tags, args.compress or "deflate")
    forget_files()
    result = _result(args, outputs, settings, layers, folder, done)
    result["notes"] = _notes(kinds, crs)
    result["notes"] += [f"{layer.name}: {note}" for layer in layers for note in layer.told.get("notes", ())]
    if args.orientation is None and any(layer.told.get("orientation") == "truth" for layer in layers):
        result["notes"].append(TRUTH_ALONE)
    result["continued"] = before + counts["done before"] if continued else 0
    if args.stac is not None:
        write_stac_item(args.stac, outputs.mosaic, crs, gsd, done, result, _assets(outputs))
    if not args.keep and not outputs.need_tiles:
        remove_parts(folder)
    result["seconds"] = round(time.perf_counter() - begun, 3)
    if args.json:
        print(json_text(result))
    else:
        tell(result, args.quiet)
    for path in [path for kind, path, _ in kinds if kind == "recording"]:
        reader = RecordingReader(path)
        tell_other_frame("rectify", reader)
        tell_other_camera("rectify", reader)
        tell_damage("rectify", reader)
    return 0


def _outputs(args: argparse.Namespace) -> Outputs:
    stem, ending = args.output.with_suffix(""), ".vrt" if is_virtual(args.output) else ".tif"
    return Outputs(
        args.output, args.source or Path(f"{stem}.source{ending}"), args.seam_lines or Path(f"{stem}.seams.geojson"),
        None if args.sigma is None else Path(args.sigma),
    )  # fmt: skip


def _check(args: argparse.Namespace, outputs: Outputs) -> None:
    named = [p for p in (*_assets(outputs).values(), args.stac) if p is not None]
    for path in named:
        refuse_unless_writable(path)
    if args.stac is not None:
        for path in (p for p in _assets(outputs).values() if p is not None):
            seen = os.path.relpath(path, args.stac.parent)
            if "#" in seen or "?" in seen:
                raise UserError(
                    f"--stac: {seen} has # or ? in it, where an address ends: programs would look for another file"
                )
    if len({str(p.resolve()) for p in named}) < len(named):
        raise UserError("-o, --sigma, --source, --seam-lines, --stac: wanted different files")
    for name, of in _NOT_OF_MOSAIC.items():
        if rectify_image.is_given(args, name):
            raise UserError(f"{flag(name)}: is of one {of}; wanted orthoimages made with it, then --mosaic of these")
    tile = TILE if args.tile is None else args.tile
    if args.tile is not None and (tile < LEAST_TILE or tile & (tile - 1)):
        raise UserError(f"--tile {args.tile}: wanted a power of two of at least {LEAST_TILE}")
    if args.feather is not None and not 0 <= args.feather <= tile // 4:
        raise UserError(f"--feather {args.feather}: wanted 0 to {tile // 4} cells")
    if args.workers is not None and args.workers < 1:
        raise UserError(f"--workers {args.workers}: wanted at least 1")


def _kinds(args: argparse.Namespace) -> list[tuple[str, Path, str | None]]:
    """What each input is: recording, image (with its metadata), orthoimage (with its sigmas)."""
    for path in args.input:
        if not path.exists():
            raise UserError(f"{path}: no such file")
    inputs = named_files(args.input, _RECORDINGS, "recordings")
    images = [p for p in inputs if p.suffix.lower() not in _RECORDINGS]
    sensors = args.sensor or []
    if sensors and len(sensors) != len(images):
        raise UserError(f"--sensor: {len(sensors)} for {len(images)} images, wanted one for each, in their order")
    sigmas = [str(p) for p in args.input_sigma or []]
    if sigmas and (sensors or len(sigmas) != len(images)):
        raise UserError(f"--input-sigma: {len(sigmas)} for {len(images)} orthoimages, wanted one for each, in order")
    if images and not sensors and args.sigma is not None and not sigmas:
        raise UserError("--sigma: wanted the sigmas of each orthoimage, --input-sigma FILE")
    if sigmas and args.sigma is None:
        raise UserError("--input-sigma: goes with --sigma FILE")
    out: list[tuple[str, Path, str | None]] = []
    for path in inputs:
        if path not in images:
            out.append(("recording", path, None))
        elif sensors:
            out.append(("image", path, sensors[images.index(path)]))
        else:
            out.append(("orthoimage", path, sigmas[images.index(path)] if sigmas else None))
    if len({path.resolve() for path in inputs}) < len(inputs):
        raise UserError("the same input twice")
    return out


def _refuse_one_flight_twice(paths: list[Path]) -> None:
    """Refuse a flight beside what was made of it: seams would run between its two orientations.

    They begin with the same image lines.
    """
    for path, other, topic in beginning_alike(paths if len(paths) > 1 else (), ["sensor/lines/*"]):
        raise UserError(
            f"{path} begins with the same image lines ({topic}) as {other}: is it the same flight, "
            "as recorded and as processed? wanted one of them"
        )


def _refuse_without_effect(args: argparse.Namespace, kinds: set[str]) -> None:
    """Refuse options of kinds of input that are not there."""
    for names, wanted, words in (
        (_OF_IMAGES, {"image"}, "an image and its --sensor"), (_OF_RECORDINGS, {"recording"}, "a recording"),
        (_OF_BOTH, {"image", "recording"}, "a recording, or an image and its --sensor"),
    ):  # fmt: skip
        for name in names:
            if rectify_image.is_given(args, name) and not kinds & wanted:
                raise UserError(f"{flag(name)}: goes with {words}, and there is none")
    rectify_image.refuse_occlusions_of_level_ground(args)
    if args.sigma is None:
        for name in ("position_sigma", "attitude_sigma", "pixel_sigma", "height_sigma"):
            if rectify_image.is_given(args, name):
                raise UserError(f"{flag(name)}: goes with --sigma FILE, for which it counts")


def _refuse_inputs(args: argparse.Namespace, outputs: Outputs, kinds: list[tuple[str, Path, str | None]]) -> None:
    """Refuse to write over what is read: also the names that nobody gave, and what is read of folders."""
    heights: list[Path] = []
    if any(kind == "image" for kind, _, _ in kinds):
        heights = rasters_of_heights(args.dem or ())
    named = [
        Path(name) for name in (*(meta for _, _, meta in kinds), *(args.dem or ()), args.camera) if name is not None
    ]
    refuse_over_files((*_assets(outputs).values(), args.stac), [*(path for _, path, _ in kinds), *heights, *named])


def _cells(args: argparse.Namespace, kinds: list[tuple[str, Path, str | None]]) -> tuple[str, float]:
    """CRS and size of the cells: as the command line says, or of the first orthoimage, recording or image."""
    crs, gsd = args.crs, args.gsd
    for kind, path, meta in sorted(kinds, key=lambda k: k[0] != "orthoimage"):
        if crs is not None and gsd is not None:
            break
        if kind == "orthoimage":
            source = RasterFile(path)
            if source.crs is None:
                raise UserError(f"{path}: has no coordinate reference system; wanted an orthoimage, or --sensor")
            found = source.crs.to_string(), abs(source.transform.a)
        elif kind == "recording":
            of = prepared(args, path)
            found = of.target.crs, cells_of(args, of)[0].gsd
        else:
            grid = rectify_image.cells_of(_for_image(args, path, meta, crs, gsd, None, None))
            found = grid.crs, grid.gsd
        crs, gsd = crs or found[0], gsd or found[1]
    assert crs is not None and gsd is not None
    return crs, float(gsd)


def _notes(kinds: list[tuple[str, Path, str | None]], crs: str) -> list[str]:
    """What is to be said of the CRS; finished orthoimages were made in it before."""
    given = {"image": lambda _: "local", "recording": lambda path: Recording(path).frame().crs}
    return list(dict.fromkeys(
        note for kind, path, _ in kinds if kind in given for note in notes_of_map(crs, given[kind](path))
    ))  # fmt: skip


def _plan(args: argparse.Namespace, kinds: list[tuple[str, Path, str | None]], settings: MosaicSettings) -> dict:
    """What the results of jobs depend on: another plan begins anew."""
    named = [Path(m) for _, _, m in kinds if m is not None] + [Path(p) for p in args.dem or () if p != "points"]
    named += [Path(p) for p in (args.dem_datum, args.camera) if p is not None]
    # of a folder all that lies in it: tiles of heights, a flight with its [dem], metadata of a scene
    files = [path for _, path, _ in kinds]
    files += [file for path in named for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    of = ("orientation", "ccd", "strip", "dem", "dem_crs", "dem_datum", "height", "resampling", "refraction", "model",
          "nodata", "occlusions", "position_sigma", "attitude_sigma", "pixel_sigma", "height_sigma")  # fmt: skip
    stated = [path.stat() if path.exists() else None for path in files]
    return {
        "inputs": [[kind, str(path.resolve()), meta] for kind, path, meta in kinds],
        "files": [[str(p.resolve()), s and [s.st_size, s.st_mtime_ns]] for p, s in zip(files, stated, strict=True)],
        "settings": vars(settings), "options": {name: getattr(args, name) for name in of},
    }  # fmt: skip


# -- layers --------------------------------------------------------------------------------------------------------


def _layer_jobs(
    args: argparse.Namespace, kinds: list[tuple[str, Path, str | None]], folder: Path, settings: MosaicSettings,
    crs: str,
) -> list[Job]:  # fmt: skip
    jobs = []
    asked = set(args.strip or ())
    found: set[str] = set()
    names = _names([path for _, path, _ in kinds])
    for number, (kind, path, meta) in enumerate(kinds):
        strips: list[str | None] = [None]
        if kind == "recording":
            there = list(Recording(path).last_strips())
            found |= asked & set(there)
            if len(kinds) == 1:
                check_strips(Recording(path), args.strip)
            strips = [s for s in there if not asked or s in asked]
        for k, strip in enumerate(strips):
            stem = f"{number:04d}_{k:04d}"
            done = folder / "layers" / f"{stem}.json"
            jobs.append(Job(done, (kind, path, names[number], meta, strip, folder, stem, settings, crs, _plain(args))))
    if asked - found and any(kind == "recording" for kind, _, _ in kinds):
        raise UserError(f"--strip {sorted(asked - found)[0]}: in none of the recordings")
    return jobs


def _names(paths: list[Path]) -> list[str]:
    """What inputs are called: by their files, or by so many of their folders as it takes to tell them apart."""
    for parts in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.with_suffix("").parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]


def _plain(args: argparse.Namespace) -> argparse.Namespace:
    """Options without what another process cannot be sent."""
    return argparse.Namespace(**{k: v for k, v in vars(args).items() if not callable(v)})


def layer_job(
    kind: str, path: Path, name: str, meta: str | None, strip: str | None, folder: Path, stem: str,
    settings: MosaicSettings, crs: str, args: argparse.Namespace,
) -> None:  # fmt: skip
    """One strip, image or orthoimage to a layer."""
    inside, gsd, tile = folder / "layers", settings.gsd, settings.tile
    if kind == "orthoimage":
        layer = layer_of_orthoimage(path, None if meta is None else Path(meta), inside, stem, crs, gsd, tile, name)
    elif kind == "image":
        target = inside / f"{stem}.tif"
        sigma = inside / f"{stem}.sigma.tif" if settings.sigma else None
        of = _for_image(args, path, meta, crs, gsd, target, sigma)
        sensor, _, _, _, cells = rectify_image.rectified(of)
        layer = layer_of_orthoimage(target, sigma, inside, stem, crs, gsd, tile, name)
        notes = [note for note in sensor.notes if note not in notes_of_map(crs)]
        layer = replace(layer, told=cells | {"notes": [*notes, *layer.told.get("notes", ())]})
    else:
        assert strip is not None
        layer = _layer_of_strip(args, path, f"{name} {strip}", strip, inside, stem, settings)
    done = inside / f"{stem}.json"
    if layer is None:
        write_json(done, None if strip is None else f"{name} {strip}")
    else:
        layer.write(done)


def _for_image(
    args: argparse.Namespace, path: Path, meta: str | None, crs: str | None, gsd: float | None, output: Path | None,
    sigma: Path | None,
) -> argparse.Namespace:  # fmt: skip
    of = copy.copy(args)
    of.input, of.sensor, of.crs, of.gsd, of.output = path, meta, crs, gsd, output
    of.sigma, of.plain, of.workers, of.compress = sigma and str(sigma), True, 1, None
    # those of recordings, which may stand beside
    of.orientation = of.trajectory = of.camera = of.strip = None
    return of


def _prepared_once(args: argparse.Namespace, path: Path) -> Prepared:
    """A recording that is ready; the last ones are kept, since their strips are jobs one after another."""
    stamp = path.stat()
    words = f"{path} {vars(args)} {stamp.st_size} {stamp.st_mtime_ns}"
    if words not in _prepared:
        while len(_prepared) >= KEPT_RECORDINGS:
            del _prepared[next(iter(_prepared))]
        _prepared[words] = prepared(args, path)
    return _prepared[words]


def _layer_of_strip(
    args: argparse.Namespace, path: Path, name: str, strip: str, folder: Path, stem: str, settings: MosaicSettings
) -> Layer | None:
    of = _prepared_once(args, path)
    grid = GroundGrid(of.target, settings.gsd)
    factor = pixels_together(grid, of.pixel_m)
    held: list[SpillingMosaic] = []

    def mosaic(dtype: Any) -> SpillingMosaic:
        held.append(SpillingMosaic(dtype, min(settings.tile, 512), folder / f"{stem}.spilled", settings.sigma))
        return held[0]

    work = Rectification(
        of.camera, of.ccd, of.surface, grid, args.resampling, of.of_strip, of.reference_ns, factor, of.errors,
        mosaic, of.shadows,
    )  # fmt: skip
    ccd = of.camera.lines[of.ccd].id
    stamps: list[int] = []
    for block in line_blocks(of.recording, ccd, [strip]):
        stamps += block.times_ns()[[0, -1]].tolist() if len(block.pixels) else []
        try:
            work.add(block)
        except ValueError as error:
            raise UserError(f"{path}: {block.ccd} line {block.first_line}: {error}") from None
    done = work.finish()
    if done is None or not held:
        return None
    try:
        return layer_of_mosaic(
            held[0], folder, stem, settings.crs, settings.gsd, settings.tile, settings.sigma,
            name=name, camera=_camera_name(of.camera, of.ccd),
            told={"lines": sum(done.strips.values()), "first_line_utc": _utc(stamps, min),
                  "last_line_utc": _utc(stamps, max), "left_out": done.left_out, "missed_rays": done.missed_rays,
                  "hidden_cells": done.hidden_cells if args.occlusions else None, "orientation": of.orientation_name,
                  "poses_not_valid": of.orientation.not_valid, "ground": of.ground},
        )  # fmt: skip
    finally:
        held[0].close()


def _utc(stamps: list[int], which: Callable[[list[int]], int]) -> str | None:
    """The first or the last stamp, ns, in words; None where they are the project's own count and no UTC."""
    time_s = which(stamps) * 1e-9 if stamps else 0.0
    if time_s < FIRST_UTC_S:
        return None
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _camera_name(camera: LineCamera, ccd: int) -> str:
    return f"{camera.name} {camera.lines[ccd].id}"


# -- what is told --------------------------------------------------------------------------------------------------


def _assets(outputs: Outputs) -> dict[str, Path | None]:
    return {"mosaic": outputs.mosaic, "source": outputs.source, "seams": outputs.seams, "sigma": outputs.sigma}


def _result(
    args: argparse.Namespace, outputs: Outputs, settings: MosaicSettings, layers: list[Layer], folder: Path,
    done: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    bands, usual = read_balance(folder)
    cameras = list(dict.fromkeys(layer.camera for layer in layers if layer.camera))
    balanced = [
        {
            "sigma0": b.sigma0, "places": b.places, "refused": b.refused, "mean_offset": b.mean_offset[0],
            "mean_offset_sigma": b.mean_offset[1],
            "layers": [
                {"gain": float(g), "gain_sigma": float(sg), "offset": float(o), "offset_sigma": float(so),
                 "tied": bool(t)}
                for g, sg, o, so, t in zip(
                    b.gain, b.gain_sigma, b.offset - b.mean_offset[0], b.relative_offset_sigma, b.tied, strict=True
                )
            ],
            "fall_off": [
                {"camera": layers[int((b.camera == k).argmax())].camera, "s2": float(c[0]), "s2_sigma": float(s[0]),
                 "s4": float(c[1]), "s4_sigma": float(s[1])}
                for k, (c, s) in enumerate(zip(b.fall_off, b.fall_off_sigma, strict=True))
            ],
        }
        for b in bands
    ]  # fmt: skip
    return {
        **{name: path and str(path) for name, path in _assets(outputs).items()},
        "stac": args.stac and str(args.stac), "empty": empty_layers(folder),
        "crs": settings.crs or "local", "gsd": settings.gsd, "rows": done["rows"], "columns": done["columns"],
        "tile": settings.tile, "balance": settings.balance, "balance_left_out": balance_left_out(folder),
        "seams_by": settings.seams, "feather": settings.feather,
        "cameras": cameras, "usual_difference": usual,
        "layers": [
            {"name": layer.name, "cells": cells, **layer.told}
            for layer, cells in zip(layers, done["cells"], strict=True)
        ],
        "bands": balanced, "seam_lines": done["seams"], "step_across_seams": done["step_across_seams"],
    }  # fmt: skip


def tell(result: dict[str, Any], quiet: bool) -> None:
    """Print a result in words, without its notes where `quiet`."""
    again = f", {result['continued']} jobs were done already" if result["continued"] else ""
    cells = f"{result['rows']} x {result['columns']} cells of {result['gsd']:g} {unit_of(result['crs'])}"
    layers = f"{len(result['layers'])} layers"
    print(f"{result['mosaic']}: {cells} in {result['crs']}, {layers}, {result['seconds']:.1f} s{again}")
    band = result["bands"][0]
    width = max(len(layer["name"]) for layer in result["layers"])
    balanced = result["balance"] != "none" and not result["balance_left_out"]
    print(f"  {'layer':{width}}  {'cells shown':>12}" + ("  gain, offset" if balanced else ""))
    for layer, tone in zip(result["layers"], band["layers"], strict=True):
        text = f"  {layer['name']:{width}}  {layer['cells']:12d}"
        if balanced:
            text += (
                f"  {tone['gain']:.4f} +- {tone['gain_sigma']:.4f}, {tone['offset']:+.1f} +- {tone['offset_sigma']:.1f}"
                if tone["tied"]
                else "  overlaps with no other"
            )
        print(text)
    if result["balance_left_out"]:
        print(f"  no balance: {result['balance_left_out']}")
    if balanced and result["balance"] == "fall-off":
        for camera in band["fall_off"]:
            if camera["camera"]:
                end, ends = 1.0 + camera["s2"] + camera["s4"], "at the ends of the line"
                print(f"  {camera['camera']}: {100 * end:.1f} % of the light {ends}")
    if band["places"]:
        print(
            f"  balance by {band['places']} places, {band['refused']} refused, sigma of a place {band['sigma0']:.2f} "
            "grey values" + (" (first band)" if len(result["bands"]) > 1 else "")
        )
    step = result["step_across_seams"]
    if step["nodes"] and band["places"]:
        print(
            f"  step of tone across {result['seam_lines']} seam lines: {step['raw_tone_rms']:.2f} grey values before, "
            f"{step['balanced_tone_rms']:.2f} after the balance (RMS of the lines; of single nodes "
            f"{step['raw_rms']:.2f} and {step['balanced_rms']:.2f})"
        )
    elif step["nodes"]:
        print(
            f"  step of tone across {result['seam_lines']} seam lines: {step['raw_tone_rms']:.2f} grey values "
            f"(RMS of the lines; of single nodes {step['raw_rms']:.2f})"
        )
    by = Counter(layer["orientation"] for layer in result["layers"] if "orientation" in layer)
    if by:
        print("  orientation of the strips: " + ", ".join(f"{name} ({n})" for name, n in by.items()))
    for layer in result["layers"]:
        for why, lines in layer.get("left_out", {}).items():
            print(f"  left out of {layer['name']}: {lines} lines {why}")
        if layer.get("poses_not_valid"):
            print(f"  {layer['name']}: {layer['poses_not_valid']} poses are not valid and give no orientation")
        if layer.get("missed_rays"):
            print(f"  {layer['name']}: {layer['missed_rays']} rays did not meet the ground")
        if layer.get("hidden_cells") is not None:
            print(f"  {layer['name']}: {layer['hidden_cells']} cells hidden by relief")
    if not quiet:
        for note in result["notes"]:
            print(f"  note: {note}")
    for name in result["empty"]:
        print(f"  nothing of {name}")
    rest = [result[name] for name in ("source", "seams", "sigma", "stac") if result[name]]
    print("  beside it: " + ", ".join(rest))
