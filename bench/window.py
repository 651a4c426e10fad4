"""How long an update of the sliding window takes while it is full, and where its time goes, phase by phase.

    python bench/window.py latency [--selfcal] [--interval 0.024]

Times are processor times.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import wraps
from time import process_time
from typing import Any

import frame
import numpy as np

from triline.nodes.garbage_collection import RareCollections
from triline.solver.camera.self_calibration import tls
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.leaving import Leaving
from triline.solver.window.results import WindowOptions
from triline.solver.window.state.relinearisation import Relinearisation
from triline.solver.window.window import Window

#: White noise of GNSS positions, X, Y, Z, m.
GNSS_NOISE_M = (0.002, 0.002, 0.002)
#: Phases of an update, see docs/architecture.md, and what does them.
PHASES = (
    ("extend the strips", Window, "_extend_strips"),
    ("arrive", Window, "_arrive"),
    ("follow the trajectory", Relinearisation, "replace_filtered"),
    ("linearise what has moved", Relinearisation, "look_after"),
    ("solve", Window, "_solve"),
    ("screen", Window, "_screen"),
    ("weigh control", Window, "_weigh_control"),
    ("judge what is new", Window, "_judge"),
    ("learn the noise of poses", Window, "_learn_noise"),
    ("publish points", Window, "_publish"),
    ("let go", Leaving, "let_go"),
    ("report", Window, "_report"),
)


class Stopwatch:
    """Processor time of each phase in each update, s."""

    def __init__(self) -> None:
        self.updates: list[dict[str, float]] = []
        self._of_update: dict[str, float] = {}
        for title, owner, method in PHASES:
            setattr(owner, method, self._timed(title, getattr(owner, method)))
        update = Window.update

        @wraps(update)
        def counted(window: Window, now_s: float) -> Any:
            self._of_update = dict.fromkeys((title for title, *_ in PHASES), 0.0)
            self.updates.append(self._of_update)
            return update(window, now_s)

        Window.update = counted  # pyrefly: ignore[bad-assignment]  # nobody names its first argument

    def _timed(self, title: str, work: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(work)
        def timed(*given: Any, **named: Any) -> Any:
            begun = process_time()
            found = work(*given, **named)
            if title in self._of_update:
                self._of_update[title] += process_time() - begun
            return found

        return timed


def latency(args: argparse.Namespace) -> dict[str, object]:
    """20 000 rays in a window of 40 s, while it is full; the end of the strip apart.

    Every 0.024 s is the adjuster's pace at 500 rays a second: 12 new rays an update. GNSS has the noise of
    `GNSS_NOISE_M`: with more, so many rays see what smoothing leaves of it, and healthy control is doubted.
    """
    plan, errors = ObservationPlan(tie_points_per_s=300.0), ErrorModel(gnss_noise_m=GNSS_NOISE_M)
    simulation = simulate(FlightPlan(strip_s=110.0), 1, errors, plan)
    RareCollections()
    parameters = tls(simulation.flight.camera) if args.selfcal else None
    options, interval_s, watch = WindowOptions(window_s=40.0), args.interval, Stopwatch()
    result = adjust_online(simulation, navigate(simulation), options, parameters, live=False, update_s=interval_s)
    rays = np.array([r.rays for r in result.reports[: len(result.update_s)]])
    now_s = interval_s * (1 + np.arange(len(rays)))
    first_s, end_s = simulation.flight.strip_times_s[0]
    full = (now_s > first_s + 45.0) & (now_s < end_s - 2.0)
    rays, all_ms = rays[full], 1e3 * np.array(result.update_s)
    ms = all_ms[full]
    p50, p90, p99 = np.percentile(ms, [50, 90, 99])
    spent = [u for u, counts in zip(watch.updates, full, strict=False) if counts]
    phases = {f"  {title}, ms": 1e3 * float(np.mean([u[title] for u in spent])) for title, *_ in PHASES}
    slowest = [u for u, took in zip(spent, ms, strict=True) if took > p99]
    slow = {f"  {title}, slowest 1 %, ms": 1e3 * float(np.mean([u[title] for u in slowest])) for title, *_ in PHASES}
    unknowns = max(r.unknowns - 3 * r.points for r in result.reports)
    return {
        "interval_s": interval_s,
        "rays in window": [int(rays.min()), int(rays.max())], "unknowns without points": unknowns,
        "updates": int(full.sum()),
        "p50_ms": p50, "p90_ms": p90, "p99_ms": p99, "max_ms": ms.max(),
        "share of a core": ms.mean() / 1e3 / interval_s, "mean_ms": ms.mean(), **phases, **slow,
        "max_ms at the end of the strip": all_ms[now_s > end_s].max(),
    }  # fmt: skip


def main() -> None:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("what", choices=("latency",))
    parser.add_argument("--selfcal", action="store_true", help="with TLS-18")
    parser.add_argument("--interval", type=float, default=0.2, help="platform time between updates, s")
    args = parser.parse_args()
    frame.show(latency(args), args.json)


if __name__ == "__main__":
    main()
