"""The window's update beside its peers, in one run: GTSAM's incremental fixed-lag smoother, Ceres solving it anew.

    python bench/window_peers.py [--rays 20000] [--seconds 90]

One strip, DGR-type globals, a segment each 2 s, window 40 s, TLS-18. GTSAM (wheel ``gtsam``) gets the window's own
linearised rows, one custom factor a point, evaluated once; so hardly any time goes into residuals. Ceres
(libceres-dev) solves a network of the same size (LIM with 20 fixes, TLS-18), residuals in C++ with automatic
derivatives; a warm window needs about two steps of it. All on one thread; our updates also test, publish and
marginalise. What is not installed is left out, and said.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from copy import copy
from pathlib import Path
from typing import Any

import batch_peers
import frame
import numpy as np

from triline.nodes.garbage_collection import RareCollections
from triline.solver.camera.self_calibration import tls
from triline.solver.models.wander import Wander
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.results import WindowOptions
from triline.solver.window.state.strip import WindowStrip
from triline.solver.window.window import Window

WINDOW_S = 40.0
#: Rays a second that fill the window with so many, as a share: a point stays from its last look to the end of the
#: window that its first look leaves.
FILLING = 23.5


class Recorded:
    """What each update brought: time, rays in the window, points as rows, strip and camera."""

    def __init__(self) -> None:
        self.updates: list[tuple[float, int, list[tuple[Any, ...]]]] = []
        self._known: set[int] = set()
        self._points: set[str] = set()
        self.strip: WindowStrip | None = None
        self._kept: list[Any] = []

    def watch(self, now_s: float, window: Window) -> None:
        points = []
        rays = 0
        if self.strip is None:
            (strip,) = window.strips.values() or (None,)
            self.strip = copy(strip)  # when it is over it lets go of what is needed here
        for batch in window.network.batches:
            rays += len(batch.rays)
            if id(batch) in self._known:
                continue
            self._known.add(id(batch))
            self._kept.append(batch)  # so that no other gets its id
            rows = batch.full_rows
            for p, name in enumerate(batch.names):
                if name in self._points:  # of a batch that joins others
                    continue
                self._points.add(name)
                mine = slice(int(batch.first_ray[p]), int(batch.first_ray[p + 1]))
                A = rows[mine].reshape(-1, rows.shape[2])
                J = batch.lin.point[:, :, mine].transpose(2, 0, 1).reshape(-1, 3)
                b = batch.lin.residual[:, mine].T.ravel() + A @ batch.theta
                points.append((batch.columns.copy(), A, J, b, float(batch.rays.time_s[mine].min())))
        self.updates.append((now_s, rays, points))


def gtsam_ms(recorded: Recorded, window: Window, cameras: int, first: float) -> np.ndarray | None:
    """Processor time of the peer's updates while the window is full, ms."""
    try:
        import gtsam
    except ImportError:
        return None
    strip = recorded.strip
    assert strip is not None
    base = int(strip.numbers[0])
    assert isinstance(strip.model, Wander)
    borders = strip.model.borders

    def key_of(number: int) -> tuple[int, int]:
        """Key and place in it of an unknown of the window."""
        if number < cameras:
            return gtsam.symbol("c", 0), number
        local = number - base
        return (gtsam.symbol("g", 0), local) if local < 9 else (gtsam.symbol("b", (local - 9) // 12), (local - 9) % 12)

    size = {"c": cameras, "g": 9, "b": 12, "p": 3}

    def name(key: int) -> str:
        return chr(gtsam.Symbol(key).chr())

    zero = {kind: np.zeros(n) for kind, n in size.items()}
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e9)  # the rows are linear already
    parameters.relinearizeSkip = 1000000
    smoother = gtsam.IncrementalFixedLagSmoother(WINDOW_S, parameters)
    present: set[int] = set()
    prior = strip._prior
    rows_of: dict[int, list[int]] = {}  # a-priori rows by their last border
    for row, columns in enumerate(prior.columns):
        last = max((int(c) - 9) // 12 for c in columns if c >= 0)
        rows_of.setdefault(max(last, -1), []).append(row)

    def factor(blocks: dict[int, np.ndarray], b: np.ndarray) -> Any:
        keys = list(blocks)
        matrices = [np.asfortranarray(blocks[k]) for k in keys]

        def error(_: Any, values: Any, jacobians: Any) -> np.ndarray:
            if jacobians is not None:
                for i, matrix in enumerate(matrices):
                    jacobians[i] = matrix
            return sum((a @ values.atVector(k) for k, a in zip(keys, matrices, strict=True)), -b)

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(b)), keys, error)

    def spread(numbers: Any, A: np.ndarray) -> dict[int, np.ndarray]:
        blocks: dict[int, np.ndarray] = {}
        for column, number in enumerate(numbers):
            key, place = key_of(int(number))
            blocks.setdefault(key, np.zeros((len(A), size[name(key)])))[:, place] = A[:, column]
        return blocks

    times, point, border, started = [], 0, -2, False
    for now_s, _, points in recorded.updates:
        graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}

        def enter(key: int, stamp: float, values=values, stamps=stamps) -> None:
            if key not in present:
                present.add(key)
                values.insert(key, zero[name(key)])
            stamps[key] = stamp

        if not started:
            started = True
            if cameras:
                enter(gtsam.symbol("c", 0), now_s)
                assert window.network.self_calibration is not None
                sigma = window.network.self_calibration.apriori_sigma
                graph.add(factor({gtsam.symbol("c", 0): np.diag(1.0 / sigma)}, np.zeros(cameras)))
        until = int(np.searchsorted(borders, now_s + 3.0, side="right"))
        while border < min(until, len(borders) - 1):
            border += 1
            rows = rows_of.get(border, [])
            if border >= 0:
                enter(gtsam.symbol("b", border), float(borders[border]))
            if not rows:
                continue
            keep = [r for r in rows if np.isfinite(prior.sigma[r])]
            blocks: dict[int, np.ndarray] = {}
            for i, r in enumerate(keep):
                for c, v in zip(prior.columns[r], prior.coefficients[r], strict=True):
                    if c >= 0:
                        key, place = key_of(base + int(c))
                        blocks.setdefault(key, np.zeros((len(keep), size[name(key)])))[i, place] += v / prior.sigma[r]
            for key in blocks:
                enter(key, now_s if name(key) == "g" else float(borders[gtsam.Symbol(key).index()]))
            graph.add(factor(blocks, np.zeros(len(keep))))
        for columns, A, J, b, oldest in points:
            if oldest < now_s - WINDOW_S + 1.0:
                continue
            key = gtsam.symbol("p", point)
            point += 1
            enter(key, oldest)
            blocks = spread(columns, A)
            blocks[key] = J
            graph.add(factor(blocks, b))
        for key in (gtsam.symbol("g", 0), gtsam.symbol("c", 0)):
            if key in present:
                stamps[key] = now_s
        begun = time.process_time()
        smoother.update(graph, values, stamps)
        smoother.calculateEstimate()
        if now_s > first and points:
            times.append(1e3 * (time.process_time() - begun))
    return np.array(times)


def ceres_ms(rays: int) -> tuple[float, float] | None:
    """Time of a whole solution and of one step, ms."""
    if shutil.which("cmake") is None or not Path("/usr/include/ceres").exists():
        return None
    case = "window"
    batch_peers.CASES[case] = ("lim", 20, True, round(rays / 2.9), 1, 0, 2800.0)
    with tempfile.TemporaryDirectory() as folder:
        row = batch_peers.compare(case, batch_peers.build(Path(folder)), Path(folder), 3)
    print(f"  ({row['rays']} rays in the network that Ceres solves)")
    return 1e3 * row["ceres_s"], 1e3 * row["ceres_s"] / row["ceres_iterations"]


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--rays", type=int, default=20000, help="in the window")
    parser.add_argument("--seconds", type=float, default=80.0, help="of the strip")
    args = parser.parse_args()
    rate = args.rays / FILLING / 2.9
    simulation = simulate(FlightPlan(strip_s=args.seconds), 1, observation_plan=ObservationPlan(tie_points_per_s=rate))
    parameters, poses = tls(simulation.flight.camera), navigate(simulation)
    first = simulation.flight.strips[0].first_line_time_s + WINDOW_S + 5.0
    last = first + args.seconds - WINDOW_S - 7.0
    RareCollections()
    recorded = Recorded()
    result = adjust_online(simulation, poses, WindowOptions(window_s=WINDOW_S), parameters, live=False,
                           watch=recorded.watch)  # fmt: skip
    assert result.window is not None
    steady = [i for i, (now, _, _) in enumerate(recorded.updates) if first < now < last]
    ours = 1e3 * np.array(result.update_s)[steady]
    rays = int(np.mean([recorded.updates[i][1] for i in steady]))
    recorded.updates = [u for u in recorded.updates if u[0] < last]
    figures: dict[str, Any] = {
        "rays in the window": rays, "unknowns without points": result.reports[steady[0]].unknowns
        - 3 * result.reports[steady[0]].points, "updates": len(ours),
        "ours, p50 and p99, ms": np.percentile(ours, [50, 99]).round(1).tolist(),
    }  # fmt: skip
    frame.show(figures)
    theirs = gtsam_ms(recorded, result.window, len(parameters.apriori_sigma), first)
    if theirs is None:
        print("GTSAM: not installed (pip install gtsam), left out")
    else:
        p50, p99 = np.percentile(theirs, [50, 99])
        ratios = f"{np.percentile(ours, 50) / p50:.3f} {np.percentile(ours, 99) / p99:.3f}"
        print(f"GTSAM IncrementalFixedLagSmoother, p50 and p99, ms: {p50:.1f} {p99:.1f}   ours / GTSAM: {ratios}")
    solved = ceres_ms(rays)
    if solved is None:
        print("Ceres: not installed (apt-get install cmake g++ libceres-dev), left out")
    else:
        whole, step = solved
        ratios = f"{np.percentile(ours, 50) / whole:.3f} {np.percentile(ours, 50) / (2 * step):.3f}"
        print(f"Ceres, from the start and two warm steps, ms: {whole:.1f} {2 * step:.1f}   ours / Ceres: {ratios}")


if __name__ == "__main__":
    main()
