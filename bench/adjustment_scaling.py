"""Time and memory of the batch adjustment against the number of rays, of strips and of segments.

    python bench/adjustment_scaling.py [-o FOLDER]

Every case runs in a process of its own; its memory is the largest resident set, simulation of the network included.
With -o the plot adjustment_scaling.png is written to FOLDER.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import frame

#: what grows: model, additional parameters, points, strips, cross strips, length in m, segments or fixes
CASES = {
    "rays, DGR + TLS-18": [("dgr", True, points, 8, 3, 12000.0, 0) for points in (1600, 5000, 16000, 50000, 160000)],
    "strips, DGR + TLS-18": [("dgr", True, 1200 * n, n, 3, 12000.0, 0) for n in (2, 4, 8, 16, 32)],
    "segments of one strip, PPM + TLS-18": [
        ("ppm", True, 10 * n, 1, 0, 1500.0 * n, n) for n in (25, 50, 100, 200, 400)
    ],
    "fixes of one strip, LIM + TLS-18": [("lim", True, 10 * n, 1, 0, 1500.0 * n, n) for n in (25, 50, 100, 200, 400)],
}


def run(case: tuple) -> dict:
    """Simulate and adjust one network; in a process of its own."""
    import numpy as np

    from triline.solver.adjustment.adjustment import pose_problem, solve
    from triline.solver.adjustment.covariance import cofactors
    from triline.solver.camera.line_camera import three_line_camera
    from triline.solver.camera.self_calibration import tls
    from triline.solver.models.dgr import DgrOptions
    from triline.solver.models.lim import LimOptions
    from triline.solver.models.ppm import PpmOptions
    from triline.solver.simulation.network import regular_block

    model, with_aps, points, strips, cross, length, parts = case
    options = DgrOptions()
    if model == "ppm":
        options = PpmOptions(segments=parts)
    elif model == "lim":
        options = LimOptions(fixes=parts, merge=False)
    camera = three_line_camera("ads40", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})
    network = regular_block(
        camera,
        np.random.default_rng(1),
        DgrOptions(),
        points=points,
        strips=strips,
        cross=cross,
        length_m=length,
    ).network
    simulated_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start = time.perf_counter()
    problem = pose_problem(network, options, tls(camera) if with_aps else None)
    solution = solve(problem)
    solved = time.perf_counter()
    cofactors(solution)
    done = time.perf_counter()
    return {
        "rays": len(network.rays),
        "points": network.n_points,
        "reduced_unknowns": problem.layout.n_unknowns,
        "steps": len(solution.history),
        "converged": solution.converged,
        "sigma0": solution.sigma0,
        "solve_s": solved - start,
        "cofactors_s": done - solved,
        "simulation_mb": simulated_mb,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def plot(results: dict[str, list[tuple[float, dict]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    figure, axes = plt.subplots(2, len(results), figsize=(4 * len(results), 6), constrained_layout=True)
    for column, (name, rows) in enumerate(results.items()):
        x = [r[0] for r in rows]
        for k, (keys, unit) in enumerate(((("solve_s", "cofactors_s"), "s"), (("peak_mb",), "MB"))):
            a = axes[k][column]
            for key in keys:
                a.loglog(x, [r[1][key] for r in rows], "o-", label=key.split("_")[0])
            first = rows[0][1][keys[0]]
            a.loglog(x, [first * v / x[0] for v in x], ":", color="grey", label="linear")
            a.set_xlabel(name.split(",")[0])
            a.set_ylabel(unit)
            a.xaxis.set_minor_formatter(NullFormatter())
            a.yaxis.set_minor_formatter(NullFormatter())
            a.grid(True, which="both", alpha=0.3)
            a.legend(fontsize=8)
        axes[0][column].set_title(name, fontsize=9)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("-o", type=Path, metavar="FOLDER", help="where the plot goes")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(run(tuple(json.loads(given.one)))))
        return
    results: dict[str, list[tuple[float, dict]]] = {}
    for name, cases in CASES.items():
        for case in cases:
            command = [sys.executable, __file__, "--one", json.dumps(case)]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                sys.exit(done.stderr.strip().splitlines()[-1])
            r = json.loads(done.stdout)
            grows = r["rays"] if name.startswith("rays") else case[3] if name.startswith("strips") else case[6]
            results.setdefault(name, []).append((grows, r))
            print(
                f"{name:38s} {grows:8d}: {r['rays']:8d} rays, {r['reduced_unknowns']:5d} unknowns beside the points,"
                f" {r['steps']} steps, solve {r['solve_s']:7.3f} s, cofactors {r['cofactors_s']:7.3f} s,"
                f" {r['peak_mb']:6.0f} MB",
                flush=True,
            )
    if given.o:
        given.o.mkdir(parents=True, exist_ok=True)
        plot(results, given.o / "adjustment_scaling.png")
        print(given.o / "adjustment_scaling.png")


if __name__ == "__main__":
    main()
