"""``triline study sensitivity``: which parameter a location owes its error to, by four methods.

A pixel of a satellite scene, of a simulated one, of a frame image like BILSAT's or of an ADS40 strip is located with
errors in orbit, attitude, time, image and height. The table has, for each parameter and for east and north, what its
sigma moves the point by (from the derivative), its share of the variance by covariance propagation, and its
first-order and total index by FAST and Sobol. Below stands the sigma by covariance propagation and by Monte Carlo,
with its standard error and percentiles; a note says where the two differ, because the function is not linear within
the sigmas. A last line tells how the sigma varies over the scene, and which parameter dominates where; ``--page``
draws the maps.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.camera.sensors import preset
from ...solver.location.frame_camera import FrameCamera
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.refraction import Refraction
from ...solver.location.uncertainty import Sigmas
from ...solver.rectification.comparison import bilsat_camera
from ...solver.sensitivity.inputs import Function, Normal
from ...solver.sensitivity.located_pixel import (
    AIRCRAFT,
    FRAME,
    RESULTS,
    SATELLITE,
    AircraftPixel,
    FramePixel,
    SatellitePixel,
    camera_inputs,
    satellite_inputs,
)
from ...solver.sensitivity.monte_carlo import PERCENTILES
from ...solver.sensitivity.scene_map import SceneMap, scene_map
from ...solver.sensitivity.study import Study, study
from ...solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass
from ..errors import UserError
from ..formats.frame_json import is_frame_json, read_frame
from ..formats.json_text import json_text, plain
from ..formats.new_file import new_file, refuse_unless_writable
from ..formats.satellite.read import read_scene
from ..formats.table import write_table
from .location_options import refraction_of, stated_sigmas

EXAMPLE = "triline study sensitivity aster-vnir ads40 --attitude-sigma 0.001 0.001 0.001 --csv shares.csv"
#: Scenes of the study without arguments.
_SCENES = ("bilsat", "aster-vnir", "ads40")
#: The strip of the worked example: flown north, so high, m, over ground so high; CCD line.
_FLOWN_M, _GROUND_M, _AIR_CCD = 3000.0, 300.0, "N"
#: Place below the satellite of simulated scenes, degrees.
_PLACE_DEG = (36.0, 139.6)
_MDEG = math.radians(1e-3)
#: Sigmas where neither file nor command line states any. Tuned: a satellite with receiver and star tracker; an aircraft
#: with GNSS and inertial measurement after processing.
_SATELLITE = Sigmas((2.0, 2.0, 2.0), (0.5 * _MDEG, 0.5 * _MDEG, 1.0 * _MDEG), 1e-4, (0.3, 0.3), 10.0)
_AIR = Sigmas((0.05, 0.05, 0.1), (3.0 * _MDEG, 3.0 * _MDEG, 6.0 * _MDEG), 0.0, (0.3, 0.3), 0.5)
#: A small satellite with GPS and star trackers whose frame camera is not calibrated in flight.
_FRAME = Sigmas((50.0, 50.0, 50.0), (10.0 * _MDEG, 10.0 * _MDEG, 20.0 * _MDEG), 0.0, (0.3, 0.3), 15.0)
#: Of the focal length, mm: usual of a laboratory calibration of an aerial camera; of a small satellite after launch.
_FOCAL_MM, _FRAME_FOCAL_MM = 0.002, 0.02
#: Height of the ground of the frame image above the ellipsoid, m.
_FRAME_GROUND_M = 1000.0


@dataclass(frozen=True)
class _Scene:
    """A scene and the pixel in it to be looked at, as functions of parameters that scatter.

    Attributes
    ----------
    name, where : of the scene; of the pixel
    function : of the pixel
    inputs, units : the parameters
    pixel : column and row to the function of any pixel; ValueError where it sees no ground
    rows : (lowest, highest) row of the image, or the names of its lines of detectors where a row is such a line
    samples : columns
    notes : remarks of who read the metadata
    """

    name: str
    where: dict[str, float | str]
    function: Function
    inputs: Normal
    units: dict[str, str]
    pixel: Callable[[float, float], Function]
    rows: tuple[float, float] | Sequence[str]
    samples: int
    notes: tuple[str, ...] = ()

    def map(self, n: int) -> SceneMap:
        """Errors on a grid of n columns and n rows, or as many rows as there are lines of detectors."""
        first, last = self.rows[0], self.rows[-1]
        named = isinstance(first, str)
        rows = np.arange(len(self.rows)) if named else np.linspace(first, float(last), n)
        return scene_map(self.pixel, self.inputs, np.linspace(0.0, self.samples - 1.0, n), rows)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    simulated = ", ".join(ORBITAL_SENSORS)
    parser.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"metadata of a satellite scene, JSON of a frame camera, a simulated sensor ({simulated}), bilsat (a "
        f"frame image) or ads40 ({' '.join(_SCENES)})",
    )
    parser.add_argument("--pixel", type=float, nargs=2, metavar=("COLUMN", "ROW"), help="0-based (middle of the image)")
    parser.add_argument("--height", type=float, metavar="M", help="of the ground above the ellipsoid (300)")
    parser.add_argument("--ccd", metavar="ID", help="line of detectors, where the sensor has several")
    parser.add_argument("--refraction", action="store_true", help="bend the rays of satellites in the air")
    parser.add_argument("--position-sigma", type=float, nargs=3, metavar="M", help="along, across, up; X, Y, Z")
    parser.add_argument(
        "--attitude-sigma", type=float, nargs=3, metavar="DEG", help="roll, pitch, yaw; omega, phi, kappa"
    )
    parser.add_argument("--time-sigma", type=float, metavar="S", help="of line times of a satellite")
    parser.add_argument("--pixel-sigma", type=float, metavar="PX", help="of line and sample")
    parser.add_argument("--height-sigma", type=float, metavar="M", help="of the ground")
    parser.add_argument("--runs", type=int, default=20_000, metavar="N", help="of Monte Carlo (20000)")
    parser.add_argument("--samples", type=int, default=2048, metavar="N", help="for indices, a power of 2 (2048)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draws (1)")
    parser.add_argument("--grid", type=int, default=9, metavar="N", help="columns and rows of the map (9)")
    parser.add_argument("--csv", metavar="FILE", help="write one row a scene, result and parameter")
    parser.add_argument("--map-csv", metavar="FILE", help="write one row a scene and place of the map")
    parser.add_argument("--page", metavar="FILE", help="write tables, maps and convergence as a page (HTML)")


def run(args: argparse.Namespace) -> int:
    if not 2 <= args.grid <= 200:
        raise UserError(f"--grid {args.grid}: wanted 2 to 200 columns and rows")
    if args.seed < 0:
        raise UserError(f"--seed {args.seed}: wanted at least 0")
    for name in (args.csv, args.map_csv, args.page):
        if name:
            refuse_unless_writable(Path(name))
    results, maps = [], []
    for name in args.scenes or _SCENES:
        scene = _scene(args, name)
        try:
            found = study(scene.function, scene.inputs, args.runs, args.samples, args.seed)
        except ValueError as error:
            raise UserError(f"{name}: {error}") from None
        maps.append(scene.map(args.grid))
        results.append({**_as_table(scene, found), "map": _as_map(scene, maps[-1])})
    if args.csv:
        _write_csv(Path(args.csv), results)
    if args.map_csv:
        _write_map_csv(Path(args.map_csv), results)
    if args.page:
        from ..report.sensitivity_page import write_page  # draws with matplotlib

        with new_file(Path(args.page)) as part:
            write_page(part, results, maps)
    if args.json:
        print(json_text({"scenes": results}))
    else:
        print("\n\n".join(_as_text(result) for result in results))
    return 0


def _scene(args: argparse.Namespace, name: str) -> _Scene:
    if name == "ads40":
        return _aircraft(args)
    path = Path(name)
    if name == "bilsat":
        return _frame(args, name, bilsat_camera(), _FRAME_GROUND_M)
    if path.is_file() and is_frame_json(path):
        notes: list[str] = []
        camera, found = read_frame(path, notes)
        stated = Sigmas(found["position_m"], found["attitude_rad"])
        if stated.any:  # a frame image has no keys for the others
            stated = replace(stated, pixel=_FRAME.pixel, height_m=_FRAME.height_m)
        return _frame(args, name, camera, _GROUND_M, stated, notes)
    return _satellite(args, name)


def _sigmas(args: argparse.Namespace, usual: Sigmas, stated: Sigmas | None = None) -> Sigmas:
    """Those of the command line; else what the file states; else, where the file states none at all, the usual."""
    return stated_sigmas(args, stated if stated is not None and stated.any else usual)


def _satellite(args: argparse.Namespace, name: str) -> _Scene:
    stated, notes = None, []
    if name in ORBITAL_SENSORS:
        sensors = overpass(ORBITAL_SENSORS[name], *_PLACE_DEG).sensors
        ccd = args.ccd or next(iter(sensors))
        if ccd not in sensors:
            raise UserError(f"{name}: line of detectors {ccd!r}, wanted one of {', '.join(sensors)}")
        sensor = sensors[ccd]
    else:
        if not Path(name).exists():
            known = ", ".join([*ORBITAL_SENSORS, "bilsat", "ads40"])
            raise UserError(f"{name}: neither a file nor a simulated sensor, wanted metadata or one of {known}")
        scene = read_scene(Path(name))
        model = scene.model("rigorous", args.ccd)
        stated, notes = scene.sigmas, [*scene.notes, *scene.line_taken(model, args.ccd)]
        assert isinstance(model, PushbroomSensor)
        sensor = model
    if args.refraction:
        sensor = sensor.with_refraction(refraction_of((), sensor.ellipsoid, name))
    column, row = _pixel(args, name, sensor.samples, sensor.lines)
    height = _GROUND_M if args.height is None else args.height
    try:
        function = SatellitePixel(sensor, row, column, height)
    except ValueError as error:
        raise UserError(f"{name}: {error}") from None
    where = {"column": column, "row": row, "height_m": height}
    return _Scene(
        name, where, function, satellite_inputs(_sigmas(args, _SATELLITE, stated)), SATELLITE,
        lambda column, row: SatellitePixel(sensor, row, column, height), (0.0, sensor.lines - 1.0), sensor.samples,
        tuple(notes),
    )  # fmt: skip


def _frame(
    args: argparse.Namespace, name: str, camera: FrameCamera, ground_m: float, stated: Sigmas | None = None,
    notes: Sequence[str] = (),
) -> _Scene:  # fmt: skip
    if args.ccd is not None:
        raise UserError(f"{name}: --ccd {args.ccd}, but a frame image has no lines of detectors")
    if args.refraction:
        camera = camera.with_refraction(Refraction())
    column, row = _pixel(args, name, camera.samples, camera.lines)
    height = ground_m if args.height is None else args.height
    try:
        function = FramePixel(camera, row, column, height)
    except ValueError as error:
        raise UserError(f"{name}: {error}") from None
    return _Scene(
        name, {"column": column, "row": row, "height_m": height}, function,
        camera_inputs(FRAME, _sigmas(args, _FRAME, stated), _FRAME_FOCAL_MM), FRAME,
        lambda column, row: FramePixel(camera, row, column, height), (0.0, camera.lines - 1.0), camera.samples,
        tuple(notes),
    )  # fmt: skip


def _aircraft(args: argparse.Namespace) -> _Scene:
    camera = preset("ads40")
    ccd = args.ccd or _AIR_CCD
    if ccd not in camera.line_index:
        raise UserError(f"ads40: line of detectors {ccd!r}, wanted one of {', '.join(camera.line_index)}")
    column, _ = _pixel(args, "ads40", camera.lines[camera.line_index[ccd]].pixels, 1)
    height = _GROUND_M if args.height is None else args.height
    if not height < _FLOWN_M:
        raise UserError(f"ads40: --height {height:g}, wanted ground below the aircraft at {_FLOWN_M:g} m")

    def pixel(column: float, line: float) -> AircraftPixel:
        k = round(line)
        xy, pitch = camera.image_coordinates(np.array([k]), [column])
        return AircraftPixel(
            (0.0, 0.0, _FLOWN_M), (0.0, 0.0, np.pi / 2), (float(xy[0, 0]), float(xy[0, 1])),
            float(camera.focal_length_mm[k]), float(np.hypot(*pitch[0])), height,
        )  # fmt: skip

    where = {"ccd": ccd, "column": column, "height_m": height, "flying_height_m": _FLOWN_M}
    return _Scene(
        "ads40", where, pixel(column, camera.line_index[ccd]),
        camera_inputs(AIRCRAFT, _sigmas(args, _AIR), _FOCAL_MM), AIRCRAFT, pixel, tuple(camera.line_index),
        min(line.pixels for line in camera.lines),
    )  # fmt: skip


def _pixel(args: argparse.Namespace, name: str, samples: int, lines: int) -> tuple[float, float]:
    """Column and row; without ``--pixel`` a quarter of the width from the edge, in the middle line."""
    column, row = args.pixel or (0.25 * (samples - 1), 0.5 * (lines - 1))
    if not (-0.5 <= column <= samples - 0.5 and (lines == 1 or -0.5 <= row <= lines - 0.5)):
        raise UserError(
            f"{name}: --pixel {column:g} {row:g}, wanted one of the image of {samples} columns and {lines} rows"
        )
    return float(column), float(row)


def _as_table(scene: _Scene, found: Study) -> dict[str, Any]:
    """The study as it goes to JSON; results that do not scatter are left out."""
    per_result = {}
    for k, result in enumerate(RESULTS[:2]):
        drawn, sigma = found.drawn, float(found.covariance.sigma[k])
        per_result[result] = {
            "sigma_m": sigma,
            "sigma_monte_carlo_m": float(drawn.sigma[k]),
            "sigma_standard_error_m": float(drawn.sigma_error[k]),
            "mean_m": float(drawn.mean[k]),
            "percentiles_m": dict(zip(map(str, PERCENTILES), (float(v) for v in drawn.percentiles[:, k]), strict=True)),
            "convergence": [
                {"runs": int(n), "sigma_m": float(s[k])} for n, s in zip(drawn.stops, drawn.sigma_at_stops, strict=True)
            ],
            "nearly_linear": bool(found.linear[k]),
            "parameters": {
                name: {
                    "unit": scene.units[name],
                    "sigma": float(scene.inputs.sigma[j]),
                    "derivative": float(found.covariance.jacobian[k, j]),
                    "moves_m": float(abs(found.covariance.jacobian[k, j]) * scene.inputs.sigma[j]),
                    "share": plain(found.covariance.share[k, j]),
                    "fast_first": plain(found.fast.first[k, j]),
                    "fast_total": plain(found.fast.total[k, j]),
                    "sobol_first": plain(found.sobol.first[k, j]),
                    "sobol_total": plain(found.sobol.total[k, j]),
                }
                for j, name in enumerate(scene.inputs.names)
            },
        }
    return {
        "scene": scene.name,
        **scene.where,
        "runs": found.drawn.runs,
        "missed": found.drawn.missed,
        "converged": found.drawn.converged,
        "results": per_result,
        "notes": list(scene.notes),
    }


def _as_map(scene: _Scene, found: SceneMap) -> list[dict[str, Any]]:
    """One entry a pixel of the grid that sees the ground."""
    larger, smaller, azimuth = found.ellipses
    out = []
    for i, j in np.argwhere(found.dominating >= 0):
        k = int(found.dominating[i, j])
        row = scene.rows[i] if isinstance(scene.rows[0], str) else float(found.rows[i])
        out.append({
            "column": float(found.columns[j]), "row": row,
            "sigma_east_m": float(np.sqrt(found.covariance[i, j, 0, 0])),
            "sigma_north_m": float(np.sqrt(found.covariance[i, j, 1, 1])),
            "semi_major_m": float(larger[i, j]), "semi_minor_m": float(smaller[i, j]),
            "azimuth_deg": float(np.degrees(azimuth[i, j])),
            "dominating": found.names[k], "share": float(found.share[i, j, k]),
        })  # fmt: skip
    return out


def _as_text(table: dict[str, Any]) -> str:
    where = ", ".join(
        f"{key.removesuffix('_m').replace('_', ' ')} {value if isinstance(value, str) else f'{value:g}'}"
        + (" m" if key.endswith("_m") else "")
        for key, value in table.items()
        if key in ("ccd", "column", "row", "height_m", "flying_height_m")
    )
    lines = [f"{table['scene']}: {where}"]
    for result, of in table["results"].items():
        lines.append(f"  {result:9s}     sigma          moves it  share   FAST first total  Sobol first total")
        for name, p in of["parameters"].items():
            if p["sigma"] == 0:
                continue
            factor, unit = (np.degrees(1.0), "deg") if p["unit"] == "rad" else (1.0, p["unit"])
            shares = [p[key] for key in ("share", "fast_first", "fast_total", "sobol_first", "sobol_total")]
            text = ["  -  " if s is None else f"{s if abs(s) >= 5e-4 else 0.0:5.3f}" for s in shares]
            lines.append(
                f"  {name:9s} {p['sigma'] * factor:9.4g} {unit:4s} {p['moves_m']:9.4f} m  {text[0]}"
                f"        {text[1]} {text[2]}        {text[3]} {text[4]}"
            )
        low, high = of["percentiles_m"]["2.5"], of["percentiles_m"]["97.5"]
        lines.append(
            f"  sigma {of['sigma_m']:.4f} m by covariance, {of['sigma_monte_carlo_m']:.4f} +- "
            f"{of['sigma_standard_error_m']:.4f} m by Monte Carlo; 95 % within {low:.3f} .. {high:.3f} m"
        )
        if not of["nearly_linear"]:
            lines.append("  note: not linear within the sigmas; Monte Carlo is right, covariance propagation is not")
    sigmas = [float(np.hypot(place["sigma_east_m"], place["sigma_north_m"])) for place in table["map"]]
    if sigmas:
        led = Counter(place["dominating"] for place in table["map"])
        by = ", ".join(f"{name} at {n}" for name, n in led.most_common())
        lines.append(
            f"  over the scene: planimetric sigma {min(sigmas):.4f} to {max(sigmas):.4f} m; "
            f"of {len(sigmas)} places dominates {by}"
        )
    if not table["converged"]:
        lines.append("  note: Monte Carlo has not converged to 2 %; take more --runs")
    if table["missed"]:
        lines.append(f"  note: {table['missed']} of {table['runs']} runs missed the ground")
    lines += [f"  note: {note}" for note in table["notes"]]
    return "\n".join(lines)


def _write_csv(path: Path, results: list[dict[str, Any]]) -> None:
    keys = (
        "unit", "sigma", "derivative", "moves_m", "share", "fast_first", "fast_total", "sobol_first", "sobol_total",
    )  # fmt: skip
    columns: dict[str, list[Any]] = {name: [] for name in ("scene", "result", "parameter", *keys)}
    for table in results:
        for result, of in table["results"].items():
            for name, p in of["parameters"].items():
                for key, value in zip(("scene", "result", "parameter"), (table["scene"], result, name), strict=True):
                    columns[key].append(value)
                for key in keys:
                    columns[key].append(float("nan") if p[key] is None else p[key])
    with new_file(path) as part:
        write_table(part, columns, dict.fromkeys(keys[1:], ".8g"))


def _write_map_csv(path: Path, results: list[dict[str, Any]]) -> None:
    rows = [{"scene": table["scene"], **place} for table in results for place in table["map"]]
    names = list(rows[0]) if rows else ["scene"]
    lengths = dict.fromkeys(
        (name for name in names if name.endswith(("_m", "_deg")) or name in ("column", "share")), ".8g"
    )
    with new_file(path) as part:
        write_table(part, {name: [row[name] for row in rows] for name in names}, lengths)
