"""Tie points that drift: who is named, when, and what the orientation is worth.

    python bench/drifting_sources.py [--seeds 5] [--dense 3]

One strip of 70 s a seed, 8 tie points/s; from 5 s on the looks of one CCD line, of one source or of one of two, drift
by 0.03 px/s in their samples or 0.05 px/s in their lines. Then blocks of three strips of 50 s, tied across; in one of
them samples drift by 0.03 px/s. Then clean flights with 500 tie points/s.
"""

from __future__ import annotations

import zlib
from dataclasses import replace
from itertools import pairwise

import frame
import numpy as np

from triline.solver.adjustment.drift_hypotheses import ALL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors, point_errors
from triline.solver.window.results import Look
from triline.solver.window.window import Window

PLAN = FlightPlan(strip_s=70.0, lead_in_s=3.0, lead_out_s=2.0)
BLOCK = FlightPlan(strips=3, strip_s=50.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0)
SENSORS = ErrorModel(attitude_rate_hz=100.0)
SAMPLE, LINE, FROM_S = (0.0, 0.03), (0.05, 0.0), 5.0
Drift = tuple[float, float]
#: Number of sources, CCD line that drifts, how, px/s in line and sample.
CASES: list[tuple[int, str, Drift]] = [
    *((1, ccd, rate) for rate in (SAMPLE, LINE) for ccd in "FNB"),
    (2, "F", SAMPLE), (2, "N", LINE), (2, ALL, SAMPLE), (2, ALL, LINE),
]  # fmt: skip


class OfSources(Window):
    """A window whose looks come from one publisher or two, by the name of the point."""

    sources = 1

    def add_look(self, name: str, look: Look) -> str:
        return super().add_look(name, replace(look, source=source_of(name)))


def source_of(name: str) -> str:
    return f"m{zlib.crc32(name.encode()) % OfSources.sources}"


def spoilt(simulation: Simulation, ccd: str, rate: Drift) -> Simulation:
    """The looks of the last source drift."""
    images, looks = simulation.images, simulation.images.looks
    ids = np.array([line.id for line in simulation.flight.camera.lines])
    last = np.array([source_of(str(name)) == f"m{OfSources.sources - 1}" for name in simulation.points.id])
    mine = last[looks.point] & ((ccd == ALL) | (ids[looks.ccd] == ccd))
    since_s = np.where(mine, np.maximum(looks.time_s - FROM_S, 0.0), 0.0)
    return replace(
        simulation,
        images=replace(images, line=images.line + rate[0] * since_s, sample=images.sample + rate[1] * since_s),
    )


def drifting_in(simulation: Simulation, strip: int, ccd: str) -> Simulation:
    """The looks of a CCD line drift in one strip of a block."""
    images, looks = simulation.images, simulation.images.looks
    ids = np.array([line.id for line in simulation.flight.camera.lines])
    begin_s, end_s = simulation.flight.covered_s[strip]
    mine = (ids[looks.ccd] == ccd) & (looks.time_s >= begin_s) & (looks.time_s <= end_s)
    sample = images.sample + np.where(mine, SAMPLE[1] * (looks.time_s - begin_s), 0.0)
    return replace(simulation, images=replace(images, sample=sample))


def main() -> int:
    parser = frame.parser(__doc__, seeds=5)
    parser.add_argument("--dense", type=int, default=3, help="clean flights with 500 tie points/s")
    options = parser.parse_args()
    from triline.solver.simulation import window_study

    window_study.Window = OfSources
    ties = ObservationPlan(tie_points_per_s=8.0, check=10)
    flights = [simulate(PLAN, seed, SENSORS, ties) for seed in range(options.seeds)]
    poses = [navigate(flight) for flight in flights]
    print(
        "sources  CCD  drifts   named in    after, s  it is among them  alone  others named first"
        "  NEES final, whole  of points"
    )  # fmt: skip
    for number, ccd, rate in CASES:
        OfSources.sources = number
        true, after, among, alone, changes, nees = (f"m{number - 1}", ccd), [], [], [], 0, []
        for flight, known in zip(flights, poses, strict=True):
            result = adjust_online(spoilt(flight, ccd, rate), known, live=False, update_s=0.5)
            alarms = [(r.quality.time_s, r.quality.sources[0]) for r in result.reports if r.quality.sources]
            orientation = [orientation_errors(flight, o).nees.mean() for o in (result.final, result.whole)]
            points = [point_errors(flight, p).nees.mean() for p in (result.final_points, result.whole_points)]
            nees.append([*orientation, *points])
            if alarms:
                after.append(alarms[0][0] - FROM_S)
                among += [true in s.suspects for _, s in alarms]
                alone += [s.suspects == (true,) for _, s in alarms]
                changes += sum(a.suspects[0] != b.suspects[0] for (_, a), (_, b) in pairwise(alarms))
        what = "samples" if rate == SAMPLE else "lines"
        seconds = f"{np.median(after):.0f}" if after else "-"
        share = f"{100 * np.mean(among):.0f} %" if among else "-"
        sole = f"{100 * np.mean(alone):.0f} %" if alone else "-"
        final, whole, final_points, whole_points = np.mean(nees, axis=0)
        print(
            f"{number:4}     {ccd:3}  {what:8}  {len(after)} of {options.seeds}  {seconds:>10}  {share:>16}  {sole:>5}"
            f"  {changes:>18}  {final:10.1f}, {whole:5.1f}  {final_points:5.1f}, {whole_points:3.1f}",
            flush=True,
        )
    OfSources.sources = 1
    print("block: drifts    named in  NEES of final orientation, whole, whole points")
    for strip, ccd in ((0, "N"), (1, "F"), (1, "N")):
        named, found = 0, []
        for seed in range(options.seeds):
            flight = simulate(BLOCK, seed, SENSORS, ObservationPlan(tie_points_per_s=8.0, control=9, check=20))
            result = adjust_online(drifting_in(flight, strip, ccd), navigate(flight), live=False, update_s=0.5)
            named += any(r.quality.sources for r in result.reports)
            last = {(o.strip, float(o.time_s[0])): o for o in result.whole}  # told again when the block has grown
            runs = result.final, list(last.values())
            orientation = [orientation_errors(flight, o).nees.mean() for o in runs]
            found.append([*orientation, point_errors(flight, result.whole_points).nees.mean()])
        figures = "  ".join(f"{value:5.1f}" for value in np.mean(found, axis=0))
        print(f"       strip {strip + 1}, {ccd}  {named} of {options.seeds}  {figures}", flush=True)
    many, false = ObservationPlan(tie_points_per_s=500.0, check=10), 0
    for seed in range(options.dense):
        flight = simulate(replace(PLAN, strip_s=60.0), seed, SENSORS, many)
        result = adjust_online(flight, navigate(flight), live=False, update_s=0.2)
        false += any(r.quality.sources for r in result.reports)
    print(f"clean, 500 tie points/s: {false} of {options.dense} flights with an alarm")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
