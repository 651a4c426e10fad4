"""Batch adjustment against Ceres (sparse Schur complement, automatic derivatives): same residuals, start and cost.

    python bench/batch_peers.py [--repeat 5] [CASE ...]

Builds bench/ceres/adjust.cpp with Debian's libceres-dev. Times are the smallest of the repetitions: ours from the
network to the solution (layout, elimination plan, iterations, factor at the solution), Ceres' from its summary (without
building the problem), with the faster of SuiteSparse and Eigen. Both use one thread. Fails where costs or unknowns say
that the two have not solved the same problem.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame

HERE = Path(__file__).parent / "ceres"
#: name: model, segments or fixes, with TLS-18, points, parallel strips, cross strips, length of the block in m
CASES = {
    "DGR, 5 000 rays": ("dgr", 0, False, 880, 4, 1, 5000.0),
    "DGR + TLS-18, 8 000 rays": ("dgr", 0, True, 1400, 4, 1, 5000.0),
    "LIM-18, 8 000 rays": ("lim", 18, False, 1400, 4, 1, 5000.0),
    "LIM-18 + TLS-18, 8 000 rays": ("lim", 18, True, 1400, 4, 1, 5000.0),
    "PPM-8, 8 000 rays": ("ppm", 8, False, 1400, 4, 1, 5000.0),
    "PPM-8 + TLS-18, 8 000 rays": ("ppm", 8, True, 1400, 4, 1, 5000.0),
    "DGR, 125 000 rays": ("dgr", 0, False, 19700, 8, 3, 12000.0),
    "DGR + TLS-18, 125 000 rays": ("dgr", 0, True, 19700, 8, 3, 12000.0),
}
#: Costs of the same problem differ by no more than this share, unknowns by no more than this share of their sigma.
SAME_COST, SAME_SIGMA = 1e-10, 1e-4


def build(folder: Path) -> Path | None:
    """Compile the peer; None and a one-line reason where that cannot be."""
    wanted = "apt-get install cmake g++ libceres-dev gives the comparison; without it only our times"
    if shutil.which("cmake") is None:
        print(f"no cmake: {wanted}", file=sys.stderr)
        return None
    for command in (["cmake", "-S", str(HERE), "-B", str(folder)], ["cmake", "--build", str(folder)]):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            reason = next((line for line in done.stderr.splitlines() if "Error" in line or "error" in line), "")
            print(f"the Ceres peer cannot be built ({reason.strip()}): {wanted}", file=sys.stderr)
            return None
    return folder / "adjust"


def write_problem(path: Path, problem, whitening) -> None:
    """The problem with fixed weights, as adjust.cpp reads it."""
    import numpy as np

    network, layout = problem.network, problem.layout
    rays, n = network.rays, len(network.rays)
    model = {"dgr": 0, "ppm": 1, "lim": 2}[problem.model.name]
    size = {0: 9, 1: 18, 2: 6}[model]
    block_of = layout.columns.min(axis=0).astype(np.int64) // size
    n_lines = len(network.camera.lines) if layout.camera is not None else 0
    camera = np.zeros((n, 20))
    place = {}
    if layout.camera is not None:
        camera = layout.camera.coefficients().transpose(2, 0, 1).reshape(n, 20)
        table = problem.self_calibration.columns
        place = {int(c): ("common", k) for k, c in enumerate(table[0, :6])}
        place |= {int(table[i, 6 + k]): (i, k) for i in range(n_lines) for k in range(4)}
    coefficient = np.zeros((n, 4))
    coefficient[:, : len(layout.coefficients)] = layout.coefficients.T
    xy_mm, pose = rays.xy_mm, np.hstack([rays.position_l, rays.angles])
    if layout.shift is not None:  # rays are linearised where they are fitted
        xy_mm, pose = xy_mm + layout.shift.image_mm.T, pose + layout.shift.orientation
    table = np.column_stack([xy_mm, pose, rays.focal_length_mm, whitening.g.T, coefficient, camera])
    linear = []
    prior = problem.prior.matrix.tocsr()
    groups: dict[tuple[int, ...], list[int]] = {}
    for row in range(prior.shape[0]):
        columns = prior.indices[prior.indptr[row] : prior.indptr[row + 1]]
        if columns[0] < layout.n_model:
            groups.setdefault(tuple(sorted({int(c) // size for c in columns})), []).append(row)
    for blocks, rows in groups.items():
        columns = np.concatenate([np.arange(b * size, (b + 1) * size) for b in blocks])
        linear.append((0, blocks, prior[rows][:, columns].toarray(), problem.prior.value[rows]))
    if layout.camera is not None:
        sigma = problem.self_calibration.apriori_sigma
        weights = {"common": np.zeros(6)} | {i: np.zeros(4) for i in range(n_lines)}
        for c, (block, k) in place.items():
            weights[block][k] = 1.0 / sigma[c]
        for block, w in weights.items():
            kind, index = (3, block) if isinstance(block, int) else (2, 0)
            linear.append((kind, (index,), np.diag(w), np.zeros(len(w))))
    control = problem.control
    for i in np.flatnonzero(control.weight.any(axis=1)):
        w = np.sqrt(control.weight[i])
        linear.append((1, (int(i),), np.diag(w), w * control.xyz_l[i]))
    with open(path, "wb") as file:
        head = [model, layout.n_model // size, size, n_lines, network.n_points, n, len(linear)]
        np.array(head, dtype=np.int64).tofile(file)
        network.approximate_l.tofile(file)
        for index in (block_of, rays.ccd, rays.point):
            index.astype(np.int64).tofile(file)
        np.ascontiguousarray(table).tofile(file)
        for kind, index, a, b in linear:
            np.array([kind, len(b), len(index), *index], dtype=np.int64).tofile(file)
            np.ascontiguousarray(a).tofile(file)
            np.ascontiguousarray(b).tofile(file)


def compare(name: str, peer: Path | None, folder: Path, repeat: int) -> dict:
    import numpy as np

    from triline.solver.adjustment.adjustment import pose_problem, solve
    from triline.solver.camera.line_camera import three_line_camera
    from triline.solver.camera.self_calibration import tls
    from triline.solver.models.dgr import DgrOptions
    from triline.solver.models.lim import LimOptions
    from triline.solver.models.ppm import PpmOptions
    from triline.solver.simulation.network import regular_block

    model, parts, with_aps, points, strips, cross, length = CASES[name]
    options = DgrOptions()
    if model == "ppm":
        options = PpmOptions(segments=parts)
    elif model == "lim":
        options = LimOptions(fixes=parts, merge=False)
    camera = three_line_camera("ads40", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})
    aps = tls(camera) if with_aps else None
    errors = {"k1": 3e-6, "xp_F": 0.004, "sy_B": 1e-4} if with_aps else None
    network = regular_block(
        camera,
        np.random.default_rng(1),
        options,
        points=points,
        strips=strips,
        cross=cross,
        length_m=length,
        self_calibration=aps,
        camera_parameters=errors,
    ).network
    ours: list[float] = []
    problem = solution = None
    for _ in range(repeat):
        start = time.perf_counter()
        problem = pose_problem(network, options, aps)
        solution = solve(problem)
        ours.append(time.perf_counter() - start)
    if problem is None or solution is None:
        raise ValueError("wanted at least one run")
    row = {
        "case": name,
        "rays": len(network.rays),
        "points": network.n_points,
        "unknowns": solution.n_unknowns,
        "ours_s": min(ours),
        "ours_iterations": len(solution.history),
    }
    if peer is None:
        return row
    path = folder / "problem.bin"
    write_problem(path, solution.problem, solution.whitening)  # additional parameters where the solution has them
    theirs = []
    for library in ("suite", "eigen"):  # whichever sparse factorisation is faster on this machine
        for _ in range(repeat):
            command = [str(peer), str(path), "1", library]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            theirs.append(json.loads(done.stdout))
    path.unlink()
    sigma = np.sqrt(solution.factor.variances())[: problem.layout.n_model]
    apart = (np.array(theirs[0]["theta"]) - solution.state.theta[: problem.layout.n_model]) / sigma
    return row | {
        "ceres_s": min(t["seconds"] for t in theirs),
        "ceres_iterations": theirs[0]["iterations"],
        "cost_difference": solution.cost / theirs[0]["cost"] - 1.0,
        "largest_difference_sigma": float(np.abs(apart).max()),
    }


def _same(r: dict) -> bool:
    """Whether both have solved the same problem."""
    return abs(r["cost_difference"]) <= SAME_COST and r["largest_difference_sigma"] <= SAME_SIGMA


def _line(r: dict) -> str:
    line = (
        f"{r['case']:30s} {r['rays']:7d} rays {r['unknowns']:6d} unknowns"
        f"  ours {1e3 * r['ours_s']:8.1f} ms ({r['ours_iterations']} steps)"
    )
    if "ceres_s" not in r:
        return line
    return (
        f"{line}  Ceres {1e3 * r['ceres_s']:8.1f} ms ({r['ceres_iterations']} steps)"
        f"  ratio {r['ours_s'] / r['ceres_s']:.2f}"
        f"  cost {r['cost_difference']:+.0e}  unknowns {r['largest_difference_sigma']:.0e} sigma"
    )


def main() -> None:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("cases", nargs="*", metavar="CASE", help="; ".join(CASES))
    parser.add_argument("--repeat", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        peer = build(Path(folder))
        rows = []
        for name in given.cases or CASES:
            if name not in CASES:
                sys.exit(f"no case {name!r}; there are: {'; '.join(CASES)}")
            rows.append(compare(name, peer, Path(folder), given.repeat))
            if not given.json:
                print(_line(rows[-1]), flush=True)
        if given.json:
            print(json.dumps(rows, indent=1))
    other = [r["case"] for r in rows if "ceres_s" in r and not _same(r)]
    if other:
        sys.exit(f"not the same problem, so that times say nothing: {'; '.join(other)}")


if __name__ == "__main__":
    main()
