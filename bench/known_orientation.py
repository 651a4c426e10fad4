"""By how much object points are off where the orientation is known exactly, which no adjustment knows.

    python bench/known_orientation.py [--seeds 20] [--rows stated noise-t3] [--motion FILE --from S]

The flights are those of `triline study misspecified`, one strip of a minute each, or with a motion that was recorded.
Points are intersected with the true orientation by least squares, and by the *best* estimator: the mean of the
distribution that the true noise of the looks leaves for a point, of which nothing is known beforehand. No estimator
that moves with its observations has a smaller RMSE (E. Pitman, The estimation of the location and scale parameters,
Biometrika 30, 1939). That distribution may have a peak beside each measurement that is grossly wrong, so it is sampled
about the points of least squares without each one and each two of the coordinates of looks, too. Errors are 3D.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import frame
import numpy as np

from triline.nodes.simulator.motion_track import motion_of
from triline.solver.arrays import Array
from triline.solver.camera.collinearity import image_motion, project
from triline.solver.geometry.space_intersection import ImageRays, Intersection, intersect
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import OBSERVED, ROWS, SETTINGS
from triline.solver.simulation.misstated import HEAVY_TAILED
from triline.solver.simulation.scenario import Simulation, simulate, simulate_real_motion
from triline.solver.simulation.window_study import rays_of

PLAN = FlightPlan(strip_s=60.0, turns=False, gap_s=8.0, lead_in_s=5.0, lead_out_s=3.0)
#: Worlds that differ in the noise of looks alone.
WORLDS = ("stated", "noise-t3", "noise")
#: Places at which the distribution of a point is asked, drawn from t-distributions of so many degrees of freedom.
DRAWN, FREEDOM = 3000, 3.0
#: Coordinates of looks that are left out together at most.
MOST_LEFT_OUT = 2


def in_pixels(rays: ImageRays, xyz: Array) -> tuple[Array, Array]:
    """Residuals (n, 2) in units of the sigmas of line and sample, and their design (n, 2, 3) per metre of the point."""
    p = project(rays.position_l, rays.angles, xyz[rays.point], rays.focal_length_mm)
    per_line = image_motion(p.d_orientation, rays.velocity_l, rays.angle_rate) * rays.line_period_s[:, None]
    sigma = np.stack([per_line * rays.sigma_line_px[:, None], rays.pitch_mm * rays.sigma_sample_px[:, None]], axis=2)
    return np.linalg.solve(sigma, (rays.xy_mm - p.xy_mm)[:, :, None])[:, :, 0], np.linalg.solve(sigma, p.d_point)


def log_normal(v: Array) -> Array:
    return -0.5 * v**2


def log_student(v: Array) -> Array:
    return -0.5 * (HEAVY_TAILED + 1.0) * np.log1p(v**2 / HEAVY_TAILED)


def peaks(v: Array, A: Array) -> Iterator[tuple[Array, Array]]:
    """Points (3,) of least squares, and the roots (3, 3) of their normal equations, with all observations (n,) of
    design (n, 3) and without each one and each two."""
    for number in range(MOST_LEFT_OUT + 1):
        for out in combinations(range(len(v)), number):
            kept, seen = np.delete(A, out, axis=0), np.delete(v, out)
            if np.linalg.matrix_rank(kept) == 3:
                yield np.linalg.lstsq(kept, seen, rcond=None)[0], np.linalg.cholesky(kept.T @ kept)


def mean_of_distribution(v: Array, A: Array, density: Callable[[Array], Array], rng: np.random.Generator) -> Array:
    """Mean (3,) of the distribution of a point that observations (n,) of design (n, 3) leave, by importance sampling;
    density gives the logarithm of that of their errors."""
    at, root = (np.array(each) for each in zip(*peaks(v, A), strict=True))
    size = len(at), DRAWN // len(at)
    z = rng.normal(size=(*size, 3)) / np.sqrt(rng.chisquare(FREEDOM, (*size, 1)) / FREEDOM)
    x = (at[:, None] + np.linalg.solve(np.swapaxes(root, 1, 2)[:, None], z[..., None])[..., 0]).reshape(-1, 3)
    squared = (((x[:, None] - at)[:, :, None] @ root)[:, :, 0] ** 2).sum(axis=2)
    drawn_from = np.log(
        ((1.0 + squared / FREEDOM) ** (-0.5 * (FREEDOM + 3.0)) * np.prod(np.diagonal(root, axis1=1, axis2=2), axis=1))
        .sum(axis=1)
    )  # fmt: skip
    log_weight = density(v - x @ A.T).sum(axis=1) - drawn_from
    weight = np.exp(log_weight - log_weight.max())
    return weight @ x / weight.sum()


def best(rays: ImageRays, found: Intersection, density: Callable[[Array], Array], rng: np.random.Generator) -> Array:
    """The points (n, 3) of least RMSE."""
    v, A = in_pixels(rays, found.xyz_l)
    xyz = found.xyz_l.copy()
    for p in np.flatnonzero(found.known):
        mine = rays.point == p
        xyz[p] += mean_of_distribution(v[mine].ravel(), A[mine].reshape(-1, 3), density, rng)
    return xyz


def squares(simulation: Simulation, row: str, rng: np.random.Generator) -> tuple[float, float]:
    """Mean squared 3D errors of a flight, by least squares and of the best estimator."""
    rays = rays_of(simulation, simulation.flight.truth)
    found = intersect(rays, len(simulation.points))
    use = found.known & (simulation.points.role != "control")
    density = log_student if ROWS[row].world.heavy_tails else log_normal
    errors = (xyz[use] - simulation.points.xyz_l[use] for xyz in (found.xyz_l, best(rays, found, density, rng)))
    of_least_squares, of_best = (float((e**2).sum(axis=1).mean()) for e in errors)
    return of_least_squares, of_best


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rows", nargs="+", choices=WORLDS, default=WORLDS[:2])
    parser.add_argument("--motion", type=Path, metavar="FILE", help="fly the motion recorded there")
    parser.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S")
    args = parser.parse_args()
    errors = SETTINGS["rtk"]  # of the trajectory: they do not matter here
    motion = motion_of(args.motion, 200.0, args.from_s, PLAN.strip_s)[0] if args.motion else None
    print(f"{'3D RMSE of points, m':28s}{'least squares':>15s}{'best':>9s}")
    for row in args.rows:
        rng = np.random.default_rng(1)
        found, world = [], ROWS[row].world
        for seed in range(1, args.seeds + 1):
            flown = (
                simulate(PLAN, seed, errors, OBSERVED, world=world)
                if motion is None
                else simulate_real_motion(motion, seed, errors, OBSERVED, as_sensors=True, world=world)
            )
            found.append(squares(flown, row, rng))
        least, least_of_all = np.sqrt(np.mean(found, axis=0))
        print(f"  {ROWS[row].title:26s}{least:15.3f}{least_of_all:9.3f}", flush=True)


if __name__ == "__main__":
    main()
