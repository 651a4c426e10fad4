"""``triline study ties``: what an adjustment makes of matched tie points, beside simulated ones of the same noise.

The same flight twice and more often: once with the tie points that were matched in its image lines, then with the true
looks at the same points and normal noise, as large as the errors of the matched ones are: the sigmas that the matcher
gave times the square root of the flight's mean normalised error squared. Everything else is the same: trajectory
errors, points, looks, their times, their sigmas, and control as it was measured.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.ray_intersection import intersect_rays
from ...solver.geometry.rotation import matrix_from_angles
from ...solver.simulation.flight import Flight
from ...solver.simulation.observations import find_looks
from ..adjuster.adjuster import Adjuster
from ..errors import UserError
from ..formats.json_text import json_text
from ..matcher.matcher import Matcher
from ..navigator.navigator import Navigator
from ..node import Message
from ..recording.reader import RecordingReader
from ..report.evaluation import orientation_errors
from ..report.flight import collect
from ..report.source import messages_of
from ..simulator.flight_settings import simulated_flight
from ..simulator.simulator import Simulator
from .matched_ties import ROUGH, is_matched, is_target, simulated_ties, tie_errors
from .study_flights import EPOCH_NS, each, processed

EXAMPLE = "triline study ties --seeds 6"
#: Matched ties may be worse than simulated ones by this factor.
WANTED = 1.1
KINDS: dict[str, dict[str, Any]] = {"plain": {}, "rough": ROUGH, "no mount": {"unstabilised": True}}
#: Errors farther off than this are no noise, px.
WRONG_PX = 2.0
#: Check points: true looks at the ground that see the errors of the orientation alone, so many a flight.
CHECKS = 400
COMPONENTS = ("X", "Y", "Z", "omega", "phi", "kappa", "gr. X", "gr. Y", "gr. Z")
BOOTSTRAPS = 2000
Array = NDArray[np.floating]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=6, metavar="N", help="flights of each kind (6)")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="first seed (1)")
    parser.add_argument("--again", type=int, default=3, metavar="N", help="drawings of simulated noise a flight (3)")
    parser.add_argument("--seconds", type=float, default=45.0, metavar="X", help="length of the strip (45)")
    parser.add_argument("--pixels", type=int, default=800, metavar="N", help="of a CCD line (800)")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="of flights (all)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")


def run(args: argparse.Namespace) -> int:
    if args.seeds < 2 or args.again < 1 or args.jobs < 1:
        raise UserError("wanted --seeds 2 at least, --again and --jobs 1 at least")
    base = {"sensor": "ads40-small", "pixels": args.pixels, "seconds": args.seconds, "lead_in": 2.0}
    cases = [
        {**base, **KINDS[kind], "seed": args.first + i, "kind": kind} for kind in args.kinds for i in range(args.seeds)
    ]
    rows = list(each(partial(fly, again=args.again), cases, args.quiet or args.json, args.jobs))
    if args.json:
        print(json_text(rows, indent=None))
    else:
        print("\n".join(lines(rows)))
    return 0


def fly(case: dict[str, Any], again: int) -> dict[str, Any]:
    """Mean squared errors (9 components) of a flight with matched ties, and with simulated ones several times."""
    settings = {k: v for k, v in case.items() if k != "kind"}
    flown = simulated_flight({**settings, "images": True})
    flight = flown.simulation.flight
    messages = list(Simulator(flown.simulation, flown.imager).messages(EPOCH_NS))
    checks = check_looks(flight, np.random.default_rng(case["seed"]))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        matched, ties, sigma0 = evaluated(messages, [Navigator(), Matcher(), Adjuster()], folder, checks)
        found = [message for message in ties if is_matched(message)]
        # control is the same in both: targets as they were measured
        others = [message for message in messages if not message.topic.startswith("sensor/lines/")]
        others += [message for message in ties if is_target(message)]
        error, sigma, _ = tie_errors(flight, [message.body for message in found])
        normalised = float(((error / sigma)[np.hypot(*error.T) < WRONG_PX] ** 2).mean())
        simulated = []
        for k in range(again):
            ties = simulated_ties(flight, found, np.random.default_rng([case["seed"], k]), normalised**0.5)
            simulated.append(evaluated([*others, *ties], [Navigator(), Adjuster()], folder, checks))
    return {
        "kind": case["kind"], "seed": case["seed"], "ties": len(found), "normalised": normalised,
        "matched": matched.tolist(), "sigma0": sigma0, "simulated": [part[0].tolist() for part in simulated],
        "simulated_sigma0": [part[2] for part in simulated],
    }  # fmt: skip


def evaluated(
    messages: Iterable[Message], nodes: list[Any], folder: Path, checks: CheckLooks
) -> tuple[Array, list[Message], float]:
    """Mean squared errors (9,) of the final orientation and of the ground that it gives; ties; sigma0."""
    out = processed(messages, nodes, folder)
    ties = list(RecordingReader(out).messages(["observation/tie"]))
    if not any(map(is_matched, ties)):
        raise UserError("a flight in which no tie point is matched, wanted more --pixels or --seconds")
    flight = collect(messages_of(out))
    time_ns, error, *_ = orientation_errors(flight)["final"]
    ground = checks.errors((time_ns - EPOCH_NS) * 1e-9, error)
    squares = np.concatenate([(error**2).mean(axis=0), (ground**2).mean(axis=0)])
    return squares, ties, float(flight.reports[-1][1].sigma0_total)


class CheckLooks:
    """True looks at ground points; with a wrong orientation, rays do not meet there.

    Parameters
    ----------
    flight : the truth
    point_l : (n, 3) places on the ground
    """

    def __init__(self, flight: Flight, point_l: Array) -> None:
        looks = find_looks(point_l, flight.strips, flight.camera)
        self._flight, self._point_l, self._looks = flight, point_l, looks
        camera = flight.camera
        xy = camera.image_coordinates(looks.ccd, looks.sample)[0]
        self._ray_c = np.column_stack([xy, -camera.focal_length_mm[looks.ccd]])

    def errors(self, time_s: Array, error: Array) -> Array:
        """(m, 3) errors of those points that are seen by all CCD lines while the orientation's errors are known."""
        looks, views = self._looks, len(self._flight.camera.lines)
        known = (looks.time_s >= time_s[0]) & (looks.time_s <= time_s[-1])
        poses = self._flight.truth.at(looks.time_s[known])
        wrong = np.stack([np.interp(looks.time_s[known], time_s, column) for column in error.T], axis=1)
        direction = np.einsum("nij,nj->ni", matrix_from_angles(*(poses.angles + wrong[:, 3:]).T), self._ray_c[known])
        point = looks.point[known]
        xyz, _ = intersect_rays(poses.position_l + wrong[:, :3], direction, point, len(self._point_l))
        seen = np.bincount(point, minlength=len(self._point_l)) == views
        return (xyz - self._point_l)[seen]


def check_looks(flight: Flight, rng: np.random.Generator) -> CheckLooks:
    """Looks at `CHECKS` places that the first strip sees at nadir."""
    strip = flight.strips[0]
    master = int(np.argmin([abs(line.xy_mm[:, 0].mean()) for line in flight.camera.lines]))
    time_s = strip.time_of(rng.uniform(0, strip.lines - 1, CHECKS))
    sample = rng.uniform(0, flight.camera.lines[master].pixels - 1, CHECKS)
    poses = flight.truth.at(time_s)
    xy = flight.camera.image_coordinates(np.full(CHECKS, master), sample)[0]
    ray = np.column_stack([xy, np.full(CHECKS, -flight.camera.focal_length_mm[master])])
    return CheckLooks(flight, flight.terrain.intersect(poses.position_l, np.einsum("nij,nj->ni", poses.R_lc, ray)))


def ratios(rows: list[dict[str, Any]], rng: np.random.Generator) -> tuple[Array, Array]:
    """RMSE with matched over RMSE with simulated ties, and its standard error: (10,), 9 components and their mean.

    Squared errors are averaged over flights, as an RMSE over all of them is. For the standard error, flights are drawn
    again with repetition (bootstrap). The mean is the geometric one.
    """
    matched = np.array([row["matched"] for row in rows])
    simulated = np.array([np.mean(row["simulated"], axis=0) for row in rows])

    def logarithm(drawn: NDArray[np.int64]) -> Array:
        each = 0.5 * np.log(matched[drawn].mean(axis=-2) / simulated[drawn].mean(axis=-2))
        return np.concatenate([each, each.mean(axis=-1, keepdims=True)], axis=-1)

    ratio = np.exp(logarithm(np.arange(len(rows))))
    return ratio, ratio * logarithm(rng.integers(0, len(rows), (BOOTSTRAPS, len(rows)))).std(axis=0)


def luck(rows: list[dict[str, Any]], rng: np.random.Generator) -> Array:
    """Standard deviation (10,) of the same ratios by other noise alone, if matched ties are just as good.

    One drawing of simulated noise a flight takes the place of the matched ties, the others are what it is held against;
    all NaN with one drawing.
    """
    squares = np.array([row["simulated"] for row in rows])  # (flights, drawings, 9)
    flights, again, _ = squares.shape
    if again < 2:
        return np.full(len(COMPONENTS) + 1, np.nan)
    chosen = squares[np.arange(flights), rng.integers(0, again, (BOOTSTRAPS, flights))]
    others = (squares.sum(axis=1) - chosen) / (again - 1)
    each = 0.5 * np.log(chosen.mean(axis=1) / others.mean(axis=1))
    each = np.concatenate([each, each.mean(axis=1, keepdims=True)], axis=1)
    # it is held against one drawing less than the matched ties are
    return np.sqrt((each**2).mean(axis=0) * (1 + 1 / again) / (1 + 1 / (again - 1)))


def by_flights(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Geometric mean of the ratios of single flights, and its standard error from their scatter.

    Every flight counts alike; an RMSE over flights is that of the one or two with the largest errors, which both kinds
    of ties leave in it.
    """
    matched = np.array([row["matched"] for row in rows])
    simulated = np.array([np.mean(row["simulated"], axis=0) for row in rows])
    each = 0.5 * np.log(matched / simulated).mean(axis=1)
    mean = float(np.exp(each.mean()))
    return mean, mean * float(each.std(ddof=1)) / len(rows) ** 0.5


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """Tables: flights, and ratios by kind."""
    rng, out = np.random.default_rng(1), []
    unit = np.array([1, 1, 1, *[1e3 * np.degrees(1)] * 3, 1, 1, 1])
    head = " ".join(f"{name:>7}" for name in COMPONENTS)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        out.append(f"{kind + f', {len(mine)} flights':<47}{head}")
        for row in mine:
            each = np.sqrt(np.array(row["matched"]) / np.mean(row["simulated"], axis=0))
            sigma0 = f"{row['sigma0']:.2f} / {np.mean(row['simulated_sigma0']):.2f}"
            title = f"  seed {row['seed']:2d} {row['ties']:4d} ties, sigma0 {sigma0}, errors {row['normalised']:.2f}"
            out.append(f"{title:<47}" + " ".join(f"{v:7.2f}" for v in each))
        for name in ("matched", "simulated"):
            squares = np.mean([np.mean(np.atleast_2d(row[name]), axis=0) for row in mine], axis=0)
            out.append(f"  {'RMSE, ' + name + ' (m, mdeg)':<45}" + " ".join(f"{v:7.3f}" for v in unit * squares**0.5))
        (ratio, error), chance = ratios(mine, rng), luck(mine, rng)
        for name, values in (("ratio", ratio), ("its standard error", error), ("by other noise alone, +-", chance)):
            out.append(f"  {name:<45}" + " ".join(f"{v:7.3f}" for v in values[:-1]))
        # one that is above by chance alone is no finding: two standard errors
        clear = [name for name, r, e in zip(COMPONENTS, ratio[:-1], error, strict=False) if r - 2 * e > WANTED]
        met = ratio[-1] < WANTED and not clear
        verdict = f"matched over simulated {ratio[-1]:.3f} +- {error[-1]:.3f} (mean of all), wanted below {WANTED:g};"
        verdict += f" simulated over simulated 1 +- {chance[-1]:.3f}"
        verdict += ", each flight alike {:.3f} +- {:.3f}".format(*by_flights(mine))
        above = f"; clearly above: {', '.join(clear)}" if clear else ""
        out.append(f"  {'met' if met else 'NOT MET'}: {verdict}{above}")
    out.append("all {} flights, each alike: {:.3f} +- {:.3f}".format(len(rows), *by_flights(rows)))
    out.append(
        "one flight a row: ties, sigma0 with matched / simulated ties, normalised errors squared of the matched, ratios"
    )
    out.append("standard error: drawing flights again; by other noise: one drawing of simulated noise against the rest")
    return out
