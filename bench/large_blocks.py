"""Blocks in partitions against the solver that holds all rays: the same answers, time and memory against rays.

    python bench/large_blocks.py                    # 125 000 rays to 3 million on two workers, beside the whole solver
    python bench/large_blocks.py --rays 125 250     # thousands of rays
    python bench/large_blocks.py --kill             # a Dask cluster of two workers; three times one is killed

Parallel and cross strips, two looks a point in every strip that sees it, Lagrange corrections at fixes 1.2 km apart, a
control point in every third partition; the block grows in both directions, points are as dense in all. Every
adjustment runs in processes of its own. Printed for each: unknowns of the reduced system, steps, seconds of the
adjustment (posing, solving, sigmas of all points and residuals of all rays; not the simulation), and the largest
resident set of a process: of the one that leads, and of the largest worker. Beside them the same for the solver that
holds all rays, where it was asked for (``--whole``), and how far the answers differ: largest difference of a correction
and of a point coordinate in its sigma, and of a sigma in itself. Below stand the exponents of time and memory against
rays, fitted to all sizes. With ``--kill`` the answers of an adjustment whose workers were killed are compared with
those of one that ran in peace, byte by byte.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import frame
import numpy as np

#: Rays in thousands, and up to how many the solver that holds all of them is asked too.
RAYS, WHOLE = (125, 250, 500, 1000, 3000), 1000
#: Points of a partition at most; each has about 6.2 rays.
POINTS, RAYS_A_POINT = 16_000, 6.2
#: Largest difference that is wanted, in sigmas; memory of a process that is wanted, MB.
DIFFERENCE, MEMORY_MB = 1e-9, 3000.0


def block(thousand: float) -> tuple[Any, Any]:
    """A simulated block of so many rays, and the model of its corrections."""
    from triline.solver.camera.line_camera import three_line_camera
    from triline.solver.models.lim import LimOptions
    from triline.solver.simulation.large_block import large_block

    grown = np.sqrt(thousand / 125)
    strips, length = round(8 * grown), 12_000.0 * grown
    model = LimOptions(fixes=max(4, round(10 * grown)), merge=False)
    camera = three_line_camera("ads40", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})
    points = thousand * 1000 / RAYS_A_POINT
    count = max(2, round(points / POINTS))
    along = max(1, round(np.sqrt(count)))
    across = -(-count // along)
    made = large_block(camera, model, strips, length, round(3 * grown), (along, across), round(points / along / across))
    return made, model


def simulate(store: Any, key: int) -> int:
    """Put the network of one tile into the store; its number of rays."""
    network = store.load("simulated").network(key)
    store.save(f"network-{key}", replace(network, strips=()))
    return len(network.rays)


def peak_mb() -> float:
    """Largest resident set of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def in_partitions(thousand: float, output: Path, workers: int, scheduler: str = "") -> dict[str, Any]:
    """Adjust a block in partitions."""
    from triline.nodes.batch.partition_runner import DaskRunner, FolderStore, ProcessRunner
    from triline.solver.partitioned.block import describe_block, pose_block, solve_block

    made, model = block(thousand)
    with tempfile.TemporaryDirectory(dir=output) as folder:
        store = FolderStore(Path(folder) / "partitions")
        store.save("simulated", made)
        keys = range(len(made.tiles))
        first = ProcessRunner(store, workers)
        rays = first.run(simulate, keys, lambda key: (), int.__add__)
        first.close()
        runner = DaskRunner(store, scheduler) if scheduler else ProcessRunner(store, workers)
        start = time.perf_counter()
        posed = pose_block(runner, keys, made.camera, made.measured, model)
        print("posed", file=sys.stderr, flush=True)
        solution = solve_block(posed)
        totals = describe_block(solution)
        seconds = time.perf_counter() - start
        runner.close()
        described = [store.load(f"result-{key}") for key in keys]
        spilled = sum(file.stat().st_size for file in store.folder.iterdir()) / 1e6
    sigma = [np.sqrt(np.maximum(np.einsum("pii->pi", d.point_cofactors), 0.0)) for d in described]
    np.savez(
        output / "partitioned.npz",
        theta=solution.theta,
        theta_sigma=np.sqrt(solution.factor.variances()),
        ids=np.concatenate([d.point_ids for d in described]),
        xyz=np.concatenate([np.where(d.rank[:, None] == 3, d.points_l, np.nan) for d in described]),
        sigma=np.concatenate(sigma),
        w=np.concatenate([d.rays.largest_w for d in described]),
    )
    return {
        "rays": rays,
        "partitions": len(keys),
        "unknowns": posed.n_unknowns,
        "solver": type(solution.factor).__name__,
        "steps": len(solution.history),
        "sigma0": solution.sigma0,
        "redundancy": solution.redundancy,
        "of_rays": float(totals.image[2]),
        "seconds": seconds,
        "leader_mb": peak_mb(),
        "worker_mb": max(runner.peak_mb.values()),
        "spilled_mb": spilled,
        "deaths": max(0, len(runner.peak_mb) - workers),
    }


def as_a_whole(thousand: float, output: Path) -> dict[str, Any]:
    """Adjust a block with all rays in memory."""
    from triline.solver.adjustment.adjustment import pose_problem, solve
    from triline.solver.adjustment.covariance import cofactors
    from triline.solver.adjustment.ray_statistics import ray_statistics

    made, model = block(thousand)
    network = made.whole()
    simulated = peak_mb()
    start = time.perf_counter()
    solution = solve(pose_problem(network, model))
    Q = cofactors(solution)
    ray_statistics(solution, Q)
    seconds = time.perf_counter() - start
    np.savez(
        output / "whole.npz",
        theta=solution.state.theta,
        theta_sigma=np.sqrt(solution.factor.variances()),
        ids=np.array(network.point_ids),
        xyz=np.where(solution.points.rank[:, None] == 3, solution.state.points_l, np.nan),
        sigma=np.sqrt(np.maximum(np.einsum("pii->pi", Q.points), 0.0)),
    )
    return {
        "rays": len(network.rays),
        "steps": len(solution.history),
        "sigma0": solution.sigma0,
        "redundancy": solution.redundancy,
        "solver": type(solution.factor).__name__,
        "seconds": seconds,
        "mb": peak_mb(),
        "simulated_mb": simulated,
    }


def differences(folder: Path) -> dict[str, float]:
    """Largest differences of the two answers, in sigmas and shares of sigmas."""
    a, b = np.load(folder / "partitioned.npz"), np.load(folder / "whole.npz")
    left, right = np.argsort(a["ids"]), np.argsort(b["ids"])
    theta = np.abs(a["theta"] - b["theta"]) / b["theta_sigma"]
    xyz, sigma = a["xyz"][left], a["sigma"][left]
    known = np.isfinite(b["xyz"][right]).all(axis=1)
    if not (a["ids"][left] == b["ids"][right]).all() or (known != np.isfinite(xyz).all(axis=1)).any():
        raise ValueError("the answers are of different points")
    of = b["sigma"][right][known]
    return {
        "correction": float(theta.max()),
        "sigma_of_correction": float(np.abs(a["theta_sigma"] / b["theta_sigma"] - 1.0).max()),
        "point": float((np.abs(xyz[known] - b["xyz"][right][known]) / of).max()),
        "sigma_of_point": float(np.abs(sigma[known] / of - 1.0).max()),
    }


def own_process(*words: object) -> dict[str, Any]:
    """What this program prints when it does one adjustment."""
    done = subprocess.run([sys.executable, __file__, *map(str, words)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr.strip().splitlines()[-1])
    return json.loads(done.stdout)


def compare(given: argparse.Namespace) -> int:
    """Print the curve; whether all is as wanted."""
    rows, met = [], True
    for thousand in given.rays:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            r = own_process("--one", "partitions", thousand, folder, "--workers", given.workers)
            rows.append(r)
            print(
                f"{r['rays']:8d} rays in {r['partitions']:3d} partitions, {r['unknowns']:6d} unknowns beside the points"
                f" ({r['solver']}), {r['steps']} steps, {r['seconds']:7.1f} s, leading process {r['leader_mb']:5.0f}"
                f" MB, workers {r['worker_mb']:5.0f} MB, on disk {r['spilled_mb']:5.0f} MB, sigma0 {r['sigma0']:.5f}",
                flush=True,
            )
            met &= max(r["leader_mb"], r["worker_mb"]) < MEMORY_MB
            if thousand > given.whole:
                continue
            w = own_process("--one", "whole", thousand, folder)
            d = differences(folder)
            print(
                f"{'':8s} held as a whole: {w['steps']} steps, {w['seconds']:7.1f} s ({w['solver']}),"
                f" {w['mb']:5.0f} MB; differences: corrections {d['correction']:.1e} sigma, their sigmas"
                f" {d['sigma_of_correction']:.1e}, points {d['point']:.1e} sigma, their sigmas"
                f" {d['sigma_of_point']:.1e}",
                flush=True,
            )
            met &= max(d.values()) < DIFFERENCE and r["redundancy"] == w["redundancy"]
    if len(rows) > 1:
        x = np.log([r["rays"] for r in rows])
        words = []
        for name, key in (("time", "seconds"), ("leading process", "leader_mb"), ("workers", "worker_mb")):
            words.append(f"{name} {np.polyfit(x, np.log([r[key] for r in rows]), 1)[0]:.2f}")
        print("exponents against rays: " + ", ".join(words))
    print(
        f"wanted: all differences below {DIFFERENCE:.0e}, the same redundancy, every process below {MEMORY_MB:.0f} MB: "
        + ("met" if met else "not met")
    )
    return 0 if met else frame.NOT_MET


def kill(given: argparse.Namespace) -> int:
    """Adjust on a Dask cluster in peace, and with workers killed; whether the answers are the same bytes."""
    from distributed import LocalCluster

    answers = []
    for killing in (False, True):
        cluster = LocalCluster(
            given.workers, threads_per_worker=1, processes=True, host="127.0.0.1", silence_logs=50,
            dashboard_address=None,
        )  # fmt: skip
        over, killed = threading.Event(), []

        def strike(cluster: Any = cluster, over: threading.Event = over, killed: list[int] = killed) -> None:
            while len(killed) < given.kills and not over.wait(given.every):
                victims = [w.pid for w in cluster.workers.values() if w.pid]
                if victims:
                    with contextlib.suppress(ProcessLookupError):  # it has ended since
                        os.kill(victims[len(killed) % len(victims)], signal.SIGKILL)
                        killed.append(1)

        striker = threading.Thread(target=strike)
        with tempfile.TemporaryDirectory() as name:
            command = [sys.executable, __file__, "--one", "partitions", str(given.rays[0]), name]
            command += ["--workers", str(given.workers), "--scheduler", cluster.scheduler_address]
            run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            assert run.stderr is not None and run.stdout is not None
            if killing and "posed" in run.stderr.readline():
                striker.start()
            output, errors = run.communicate()
            over.set()
            if striker.ident:
                striker.join()
            if run.returncode:
                sys.exit(errors.strip().splitlines()[-1])
            r = json.loads(output)
            with np.load(Path(name) / "partitioned.npz") as file:
                answers.append({key: file[key] for key in file.files})
        cluster.close()
        how = f"{len(killed)} times a worker was killed" if killing else "in peace"
        print(f"{r['rays']} rays, {r['partitions']} partitions on Dask, {how}: {r['seconds']:.1f} s", flush=True)
        if killing and not killed:
            print("no worker was killed: more rays, or a shorter --every")
            return frame.NOT_MET
    same = all(answers[0][key].tobytes() == answers[1][key].tobytes() for key in answers[0])
    print("the answers are " + ("the same, byte by byte" if same else "NOT the same"))
    return 0 if same else frame.NOT_MET


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--rays", type=float, nargs="+", default=RAYS, metavar="N", help="thousands of rays")
    parser.add_argument("--whole", type=float, default=WHOLE, metavar="N", help=f"up to N thousand ({WHOLE})")
    parser.add_argument("--workers", type=int, default=2, help="processes (2)")
    parser.add_argument("--kill", action="store_true", help="kill workers of a Dask cluster")
    parser.add_argument("--every", type=float, default=3.0, metavar="S", help="with --kill: one every S seconds (3)")
    parser.add_argument("--kills", type=int, default=3, metavar="N", help="with --kill: N times (3)")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--scheduler", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        kind, thousand, output = given.one
        if kind == "whole":
            print(json.dumps(as_a_whole(float(thousand), Path(output))))
        else:
            print(json.dumps(in_partitions(float(thousand), Path(output), given.workers, given.scheduler)))
        return
    sys.exit(kill(given) if given.kill else compare(given))


if __name__ == "__main__":
    main()
