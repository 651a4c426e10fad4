"""Does what the window says of itself stay true over hours? Mean normalised error squared (1 expected) as time goes on.

    python bench/drift.py [--minutes 120] [--seed 1]

Strips one after the other, each tied to the one before by its side lap, with ground control now and then. A row each
ten minutes, as soon as they are flown, of the strips that became final in them: the ratio of final and whole
orientation and of points, time of updates and memory (the results are kept). At the end the ratio of the whole flight,
and that of its second half over the first, with their 95 % bands: 1 has to lie in both. The bands are from the scatter
of the rows, not of the strips: neighbouring strips share points and errors.
"""

from __future__ import annotations

import time

import frame
import numpy as np
from scipy.stats import t as student

from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    OnlineResult,
    adjust_online,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.results import WindowOptions

#: Between two rows, s, and strips of so many seconds with gaps between them.
ROW_S = 600.0
STRIP_S, GAP_S = 54.0, 6.0
KINDS = ("final", "whole", "points")


class Ratios:
    """Of the strips that are over, told in rows."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._ends = {s.id: s.first_line_time_s + s.lines / s.line_rate_hz for s in simulation.flight.strips}
        self.of_strip: dict[str, list[float]] = {}
        self.rows: list[np.ndarray] = []  # means of each row
        self._due_s, self._updates = ROW_S, 0
        self._begun = time.monotonic()

    def look(self, now_s: float, result: OnlineResult) -> None:
        """A row, if its time has come; strips count half a minute after their end."""
        if now_s < self._due_s:
            return
        self._due_s += ROW_S
        over = [id for id, end_s in self._ends.items() if end_s + 30.0 < now_s and id not in self.of_strip]
        rows = self._count(over, result)
        ms = 1e3 * np.array(result.update_s[self._updates :])
        self._updates = len(result.update_s)
        self.rows.append(np.mean(rows, axis=0))
        each = "  ".join(f"{kind} {ratio:.3f}" for kind, ratio in zip(KINDS, self.rows[-1], strict=True))
        print(
            f"to {now_s / 60:4.0f} min, {len(over):2d} strips: {each}   update p50 {np.median(ms):5.1f} ms, p99 "
            f"{np.percentile(ms, 99):5.1f} ms   "
            f"{frame.resident_mb():5.0f} MB   {time.monotonic() - self._begun:5.0f} s",
            flush=True,
        )

    def _count(self, strips: list[str], result: OnlineResult) -> np.ndarray:
        points: dict[str, dict] = {id: {} for id in strips}
        for name, point in result.final_points.items():
            if point.residuals and point.residuals[0].look.strip in points:
                points[point.residuals[0].look.strip][name] = point
        for id in strips:
            ratios = [
                orientation_errors(self._simulation, [o for o in run if o.strip == id]).nees.mean()
                for run in (result.final, result.whole)
            ]
            self.of_strip[id] = [*map(float, ratios), float(point_errors(self._simulation, points[id]).nees.mean())]
        return np.array([self.of_strip[id] for id in strips])


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    if args.minutes < 45.0:
        parser.error("--minutes: wanted at least 45, two rows of ten minutes in each half")
    strips = max(4, round(60.0 * args.minutes / (STRIP_S + GAP_S)))
    plan = FlightPlan(
        strips=strips, strip_s=STRIP_S, turns=False, gap_s=GAP_S, lead_in_s=3.0, lead_out_s=2.0, sidelap=0.2
    )
    errors = ErrorModel(attitude_rate_hz=100.0)
    seen = ObservationPlan(tie_points_per_s=3.0, control=2 * strips, check=strips)
    simulation = simulate(plan, args.seed, errors, seen)
    print(f"{simulation.flight.covered_s[-1, 1] / 60:.0f} minutes, {strips} strips", flush=True)
    ratios = Ratios(simulation)
    adjust_online(
        simulation, navigate(simulation), WindowOptions(grid_hz=2.0), live=False, update_s=0.5, so_far=ratios.look
    )
    rows = np.array(ratios.rows)
    first, last = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    print(f"{args.minutes:.0f} minutes, {len(ratios.of_strip)} strips judged in {len(rows)} rows")
    for i, kind in enumerate(KINDS):
        error = student.isf(0.025, len(rows) - 1) * rows[:, i].std(ddof=1) / np.sqrt(len(rows))
        drift = last[:, i].mean() / first[:, i].mean()
        each = [h[:, i].std(ddof=1) / h[:, i].mean() / np.sqrt(len(h)) for h in (first, last)]
        scatter = student.isf(0.025, len(rows) - 2) * drift * np.hypot(*each)
        print(f"{kind:7} {frame.banded(rows[:, i].mean(), error)}")
        print(f"{'':7} second half over first {frame.banded(drift, scatter)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
