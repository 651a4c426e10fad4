"""``triline navigate``: GNSS/inertial filter and smoother over a sensor folder or a recording."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.navigation.clock_check import offset_in_words
from ...solver.navigation.clock_offset import inertial_offsets
from ...solver.navigation.error_state import Observation
from ...solver.navigation.inertial_cleaning import Finding
from ...solver.navigation.inertial_data import GnssData, InertialData
from ...solver.navigation.post_processing import (
    Navigated,
    NavigationError,
    headings,
    held_out_misses,
    innovation_statistics,
    navigate,
    zero_velocities,
)
from ..convert import LINE_RATES_HZ
from ..errors import UserError
from ..formats.importable import refuse_importable
from ..formats.json_text import json_text
from ..formats.new_file import new_file, new_files, refuse_unless_folder
from ..formats.recorded_sensors import read_recorded_sensors
from ..formats.sensor_folder import SensorFolder, read_sensor_folder
from ..recording.remote import RemotePath, path_of
from .outputs import refuse_folder_of_inputs

HELP = "GNSS/inertial filter and smoother over a recording or a sensor folder"
EXAMPLE = "triline navigate flight_sensors/ -o navigation"

#: What a run writes; those of an earlier run, which do not belong to it, stay until all is written.
TRAJECTORY, PAGE, RESULT = FILES = ("trajectory.csv", "navigation.html", "result.json")

_VALUES = ("lat_deg", "lon_deg", "height_m", "vn_m_s", "ve_m_s", "vd_m_s", "roll_deg", "pitch_deg", "heading_deg")
_SIGMAS = ("n_m", "e_m", "d_m", "vn_m_s", "ve_m_s", "vd_m_s", "roll_deg", "pitch_deg", "heading_deg")
COLUMNS = ("time_s", *_VALUES, *(f"sigma_{name}" for name in _SIGMAS))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input",
        metavar="INPUT",
        help="recording, or sensor folder (imu.csv; gnss.csv, gnss.pos or gnss.txt; platform.toml)",
    )
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for the results (default: INPUT/navigation)")
    parser.add_argument("--platform", metavar="FILE", help="platform.toml to use instead of the one in the folder")
    parser.add_argument("--no-smooth", action="store_true", help="write what the filter knew at each time")
    parser.add_argument("--rate", type=float, metavar="HZ", help="rows a second (default: every inertial sample)")
    parser.add_argument("--zero-velocity", action="store_true", help="use that the platform stands where it does")
    parser.add_argument("--heading-aid", action="store_true", help="use the headings of attitude.csv")
    parser.add_argument("--hold-out", type=int, metavar="N", help="compare every Nth fix instead of using it")
    parser.add_argument("--no-checks", action="store_true", help="do not look for wrong units, axes and time scales")
    parser.add_argument("--no-page", action="store_true", help="no page with plots")


def run(args: argparse.Namespace) -> int:
    began = time.perf_counter()
    most = LINE_RATES_HZ[1]
    if args.rate is not None and not 0 < args.rate <= most:
        raise UserError(f"--rate {args.rate:g}: wanted a number above 0, at most {most:g}")
    if args.hold_out is not None and args.hold_out < 2:
        raise UserError(f"--hold-out {args.hold_out}: wanted at least 2")
    source = path_of(args.input)
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    platform = None if args.platform is None else Path(args.platform)
    if platform is not None and not platform.is_file():
        raise UserError(f"{platform}: no such file")
    default = source / "navigation" if source.is_dir() else source.with_name(source.name + ".navigation")
    if isinstance(source, RemotePath) and not args.output:
        raise UserError(f"{source}: results of a recording elsewhere need a folder here: -o DIR")
    out = Path(args.output) if args.output else default
    refuse_unless_folder(out)
    refuse_folder_of_inputs(out)
    if source.is_dir():
        folder = read_sensor_folder(source, platform)
    else:
        refuse_importable(source)
        folder = read_recorded_sensors(source, platform)
    inertial, gnss, findings = folder.cleaned()
    quiet = args.quiet or args.json
    _say(quiet, f"{source}: {len(inertial)} inertial samples, {len(gnss)} fixes")
    held_out = np.zeros(len(gnss), dtype=bool)
    if args.hold_out:
        if args.hold_out > len(gnss):
            raise UserError(f"--hold-out {args.hold_out}: there are {len(gnss)} fixes, wanted at most as many")
        held_out[args.hold_out - 1 :: args.hold_out] = True
    try:
        stretches = navigate(
            inertial,
            gnss,
            folder.platform.settings,
            prior=folder.platform.initial,
            smoothing=not args.no_smooth,
            increments=folder.increments,
            held_out=held_out,
            aids=_aids(args, folder, inertial, gnss),
            checks=not args.no_checks,
            offset_s=folder.offset_s,
        )
    except NavigationError as error:
        raise UserError(f"{source}: {folder.named(error.finding)}") from None
    findings = [*findings, *(f for s in stretches for f in s.findings)]
    if not args.no_checks:
        findings += _clock_findings(folder, inertial, gnss)
    notes = [*folder.notes, *(folder.named(f) for f in findings)]
    for note in notes:
        _say(quiet, f"note: {note}")
    with new_files(out, RESULT, FILES) as new:
        with new_file(new / TRAJECTORY) as part:
            rows = write_trajectory(part, stretches, inertial, folder, args.rate)
            if not rows:
                span_s = max(s.best.end_s - s.best.start_s for s in stretches)
                raise UserError(f"--rate {args.rate:g}: no row falls into {span_s:.3g} s, wanted more a second")
        result = _result(folder, stretches, inertial, gnss, notes, held_out)
        result["rows"] = rows
        if not args.no_page:
            from ..report.navigation_page import write_page

            with new_file(new / PAGE) as part:
                write_page(part, stretches, gnss, result)
        result["seconds"] = round(time.perf_counter() - began, 3)
        text = json_text(result)
        with new_file(new / RESULT) as part:
            part.write_text(text + "\n", encoding="utf-8")
    if args.json:
        print(text)
    else:
        _summary(result, out)
    return 0


def _aids(
    args: argparse.Namespace, folder: SensorFolder, inertial: InertialData, gnss: GnssData
) -> list[tuple[float, Observation]]:
    aids: list[tuple[float, Observation]] = []
    if args.zero_velocity:
        aids += zero_velocities(inertial, gnss)
    if args.heading_aid:
        if folder.attitude is None:
            raise UserError(f"{folder.path / 'attitude.csv'}: missing, wanted headings for --heading-aid")
        a = folder.attitude
        aids += headings(a.time_s, a.angles[:, 2], a.sigma[:, 2])
    return aids


def _clock_findings(folder: SensorFolder, inertial: InertialData, gnss: GnssData) -> list[Finding]:
    """Tenths of a second between the clocks, which turns show, and which nothing else does."""
    found = []
    for time_s, offset in inertial_offsets(inertial, gnss, folder.platform.settings):
        words = f"{offset_in_words(offset.offset_s, 'inertial')}, +- {offset.sigma_s:.2f} s"
        seen = f"seen at {time_s + folder.offset_s:.1f} s"
        text = f"{words}, {seen}: positions are off by what is flown in this time"
        found.append(Finding("clock offset", "gnss.time", text, fatal=False))
    return found


def write_trajectory(
    path: Path,
    stretches: list[Navigated],
    inertial: InertialData,
    folder: SensorFolder,
    rate_hz: float | None = None,
) -> int:
    """Write trajectory.csv: a row for each inertial sample (gaps filled), or at a rate; returns the number of rows."""
    settings = folder.platform.settings
    digits = 9 if inertial.time_s[-1] + folder.offset_s < 1e7 else 6
    line = f"%.{digits}f,%.10f,%.10f,%.5f,%.6f,%.6f,%.6f,%.7f,%.7f,%.7f" + ",%.6g" * 9
    rows = 0
    with open(path, "w", encoding="utf-8", newline="") as file:
        file.write(",".join(COLUMNS) + "\n")
        for stretch in stretches:
            trajectory = stretch.best
            flown = inertial[(inertial.time_s >= trajectory.start_s) & (inertial.time_s <= trajectory.end_s)]
            time_s = flown.bridged(settings.gap_rate_sigma, settings.gap_force_sigma).time_s
            if rate_hz is not None:
                first, last = np.ceil(trajectory.start_s * rate_hz), np.floor(trajectory.end_s * rate_hz)
                time_s = np.arange(first, last + 1) / rate_hz
            for part in np.array_split(time_s, max(1, len(time_s) // 20000)):
                table = trajectory_table(stretch, part)
                table[:, 0] += folder.offset_s
                file.write("\n".join([line % tuple(row) for row in table.tolist()]) + "\n")
            rows += len(time_s)
    return rows


def trajectory_table(stretch: Navigated, time_s: NDArray[Any]) -> NDArray[Any]:
    """Rows (n, 19) of trajectory.csv."""
    states = stretch.best.at(time_s)
    g = states.geodetic
    sigma = stretch.best.sigmas(time_s)
    sigma[:, 6:] = np.degrees(sigma[:, 6:])
    return np.column_stack([time_s, np.degrees(g[:, :2]), g[:, 2], states.velocity_n, np.degrees(states.angles), sigma])


def _result(
    folder: SensorFolder,
    stretches: list[Navigated],
    inertial: InertialData,
    gnss: GnssData,
    notes: list[str],
    held_out: NDArray[np.bool_],
) -> dict[str, Any]:
    out: dict[str, Any] = {
        "input": str(folder.path),
        "n_inertial": len(inertial),
        "n_gnss": len(gnss),
        "inertial_rate_hz": round(1.0 / inertial.interval_s, 3),
        "smoothed": stretches[0].smoothed is not None,
        "notes": notes,
        "stretches": [_stretch(s, gnss, held_out, folder.offset_s) for s in stretches],
    }
    return out


def _stretch(stretch: Navigated, gnss: GnssData, held_out: NDArray[np.bool_], offset_s: float) -> dict[str, Any]:
    e, settings = stretch.best.nodes, stretch.forward.settings
    lay = settings.layout
    sigma = np.sqrt(np.einsum("kii->ki", stretch.best.P))
    middle = len(e) // 2
    of_nodes = stretch.best.sigmas(e.time_s)
    rms, median = np.sqrt(np.mean(of_nodes**2, axis=0)), np.median(of_nodes, axis=0)
    per_h, mgal = np.degrees(1.0) * 3600.0, 1e5
    kinds = sorted({i.kind for i in stretch.forward.innovations})
    out: dict[str, Any] = {
        "start_s": float(e.time_s[0]) + offset_s,
        "end_s": float(e.time_s[-1]) + offset_s,
        "time_offset_s": offset_s,
        "alignment": stretch.start.how,
        "sigma_rms": _by_kind(rms),
        "sigma_median": _by_kind(median),
        "gyro_bias_deg_h": _rounded(e.gyro[middle, :3] * per_h),
        "gyro_bias_deg_h_sigma": _rounded(sigma[middle, lay.gyro][:3] * per_h),
        "accel_bias_mgal": _rounded(e.accel[middle, :3] * mgal),
        "accel_bias_mgal_sigma": _rounded(sigma[middle, lay.accel][:3] * mgal),
        "innovations": {kind: innovation_statistics(stretch.forward.innovations, kind) for kind in kinds},
        "gaps": [[a + offset_s, b + offset_s] for a, b in stretch.forward.gaps],
        "observations_outside": stretch.forward.unused,
    }
    if lay.with_lever_arm:
        out["lever_arm_m"] = _rounded(e.lever_arm_b[middle])
        out["lever_arm_m_sigma"] = _rounded(sigma[middle, lay.lever_arm])
    miss, s = held_out_misses(stretch.best, gnss, settings, held_out)
    if len(miss):
        out["held_out"] = {
            "n": len(miss),
            "rms_m": _rounded(np.sqrt(np.mean(miss**2, axis=0))),
            "rms_over_sigma": _rounded(np.sqrt(np.mean((miss / s) ** 2, axis=0))),
            "beyond_3_sigma": round(float(np.mean(np.abs(miss / s) > 3.0)), 4),
        }
    return out


def _by_kind(sigma: NDArray[Any]) -> dict[str, list[float]]:
    """Standard deviations (9,) by quantity."""
    return {
        "position_m": _rounded(sigma[:3]),
        "velocity_m_s": _rounded(sigma[3:6]),
        "attitude_deg": _rounded(np.degrees(sigma[6:])),
    }


def _rounded(values: NDArray[Any]) -> list[float]:
    return [float(f"{v:.6g}") for v in values]


def _summary(result: dict[str, Any], out: Path) -> None:
    for s in result["stretches"]:
        median = s["sigma_median"]
        print(f"{s['start_s']:.1f} to {s['end_s']:.1f} s, aligned {s['alignment']}")
        print(f"  median sigma north, east, down  {_joined(median['position_m'], 1e3, '.1f')} mm")
        print(f"  median sigma roll, pitch, heading  {_joined(median['attitude_deg'], 1.0, '.4f')} deg")
        for kind, i in s["innovations"].items():
            if i["n"]:
                fate = ", ".join(f"{i[k]} {k}" for k in ("used", "weighted", "rejected", "restored") if i[k])
                square = i["nis_per_degree_of_freedom"]
                print(f"  {kind}: {fate}; squares of innovations over sigma {square:.2f} (expected 1)")
        if "held_out" in s:
            h = s["held_out"]
            print(f"  held out: {h['n']} fixes, rms {_joined(h['rms_m'], 1.0, '.3f')} m")
    print(f"{result['rows']} rows in {out / TRAJECTORY} ({result['seconds']:.1f} s)")


def _joined(values: list[float], factor: float, form: str) -> str:
    return ", ".join(format(v * factor, form) for v in values)


def _say(quiet: bool, text: str) -> None:
    if not quiet:
        print(text, file=sys.stderr)
