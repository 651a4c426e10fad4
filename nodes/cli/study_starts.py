"""``triline study starts``: flights whose orientation is wrong by 30 px, in one direction after another.

The first window of ties has to find out. Two figures tell what is predicted before and after it: how far tie points
were found from where the orientation of now puts them (the views against each other), and how far from its true place
the live orientation images the ground (what a target is looked for with).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.rotation import matrix_from_angles
from ...solver.matching.options import MatchedTie
from ...solver.simulation.flight import Flight, pixel_angle
from ...solver.simulation.scenario import Simulation
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
from .matched_ties import ROUGH
from .study_flights import EPOCH_NS, each, processed

EXAMPLE = "triline study starts --seeds 3"
WRONG_PX = 30.0
#: Predictions are to be so good after the first window, px.
WANTED_PX = 2.0
#: What is wrong; roll, pitch, heading or a place along, across, up.
DIRECTIONS = ("roll", "pitch", "heading", "east", "north", "height")
#: Flown so low that more than the first window fits into the strip.
FLIGHT = {"sensor": "ads40-small", "seconds": 45.0, "height": 600.0, "lead_in": 2.0, "images": True, "check": 0}
Array = NDArray[np.floating]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="flights a direction, plain and rough (3)")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="first seed (1)")
    parser.add_argument("--pixels", type=int, default=800, metavar="N", help="of a CCD line (800)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")


def run(args: argparse.Namespace) -> int:
    if args.seeds < 1 or args.jobs < 1:
        raise UserError("wanted --seeds and --jobs 1 at least")
    cases = [
        (direction, rough, {**FLIGHT, **(ROUGH if rough else {}), "pixels": args.pixels, "seed": args.first + i})
        for direction in DIRECTIONS
        for rough in (False, True)
        for i in range(args.seeds)
    ]
    rows = list(each(fly, cases, args.quiet or args.json, args.jobs))
    print(json_text(rows) if args.json else "\n".join(lines(rows)))
    return 0


def fly(case: tuple[str, bool, dict[str, Any]]) -> dict[str, Any]:
    """A flight that starts wrong; what is predicted in its first window and after it."""
    direction, rough, settings = case
    flown = simulated_flight(settings)
    simulation = wrong_start(flown.simulation, direction)
    assert flown.imager is not None
    matcher = _Predicting()
    with tempfile.TemporaryDirectory() as folder:
        messages = Simulator(simulation, flown.imager).messages(EPOCH_NS)
        out = processed(messages, [Navigator(), matcher, Adjuster()], Path(folder))
        reader = RecordingReader(out)
        stamps = [tie.stamp_ns for tie in reader.messages(["observation/tie"])]
        # reports tell how long the window is; the first one is over when its ties have been worked in
        lengths = [m.body.window_end_ns - m.body.window_start_ns for m in reader.messages(["adjustment/report"])]
        window_ns = min(stamps, default=0) + max(lengths, default=0)
        found = collect(messages_of(out))
    time_ns, error, *_ = orientation_errors(found)["live"]
    absolute = displacement_px(simulation.flight, (time_ns - EPOCH_NS) * 1e-9, error)
    stamp_ns, between = np.array(matcher.noted, dtype=float).reshape(-1, 2).T
    return {
        "direction": direction, "rough": rough, "seed": settings["seed"], "ties": len(matcher.noted),
        "between_views_px": _parts(stamp_ns, between, window_ns),
        "on_the_ground_px": _parts(np.repeat(time_ns.astype(float), absolute.shape[1]), absolute.ravel(), window_ns),
    }  # fmt: skip


def _parts(stamp_ns: Array, px: Array, window_ns: int) -> dict[str, list[float]]:
    """Median and 95 % of what was there until the first window was full, and after it; empty where there is nothing."""
    parts = {"before": px[stamp_ns <= window_ns], "after": px[stamp_ns > window_ns]}
    return {name: np.quantile(part, [0.5, 0.95]).tolist() if len(part) else [] for name, part in parts.items()}


def wrong_start(simulation: Simulation, direction: str) -> Simulation:
    """The same flight with sensors that are wrong by `WRONG_PX` at the most in the image, all the time.

    The project states such an error as possible: one sigma of it.

    Raises
    ------
    ValueError : a direction that is not one of `DIRECTIONS`
    """
    if direction not in DIRECTIONS:
        raise ValueError(f"direction {direction!r}, wanted one of {', '.join(DIRECTIONS)}")
    flight, errors = simulation.flight, simulation.errors
    angle = WRONG_PX * pixel_angle(flight.camera)
    # what heading and height shift is largest in the corners of the image
    corner = max(float(np.hypot(*line.xy_mm[end])) for line in flight.camera.lines for end in (0, -1))
    far = corner / float(flight.camera.focal_length_mm[0])
    k = DIRECTIONS.index(direction)
    if k < 3:
        size = angle / (far if direction == "heading" else 1.0)
        wrong = np.zeros(3)
        wrong[k] = size
        shift = np.array(errors.shift_sigma_deg)
        shift[[2] if direction == "heading" else [0, 1]] = np.degrees(size)
        a, b, c = shift.tolist()
        return replace(
            simulation, attitude_rpy=simulation.attitude_rpy + wrong, errors=replace(errors, shift_sigma_deg=(a, b, c))
        )
    height = float(flight.truth.position_l[:, 2].mean())
    wrong = np.zeros(3)
    wrong[k - 3] = size = height * angle / (far if direction == "height" else 1.0)
    offset = np.array(errors.offset_sigma_m)
    offset[[2] if direction == "height" else [0, 1]] = size
    position_l = flight.frame.from_geodetic(*simulation.gnss_geodetic.T) + wrong
    a, b, c = offset.tolist()
    return replace(
        simulation, gnss_geodetic=flight.frame.to_geodetic(position_l), errors=replace(errors, offset_sigma_m=(a, b, c))
    )


def displacement_px(flight: Flight, time_s: Array, error: Array) -> Array:
    """(n, looks) px by which an orientation with errors (n, 6) images the ground beside its place.

    Looks are the middle and the ends of each CCD line, at the mean height of the ground.
    """
    camera = flight.camera
    ccd = np.repeat(np.arange(len(camera.lines)), 3)
    sample = np.array([s * (line.pixels - 1) for line in camera.lines for s in (0.05, 0.5, 0.95)])
    xy, pitch = camera.image_coordinates(ccd, sample)
    c = camera.focal_length_mm[ccd]
    ray = np.column_stack([xy, -c])
    true = flight.truth.at(time_s)
    direction = np.einsum("nij,kj->nki", true.R_lc, ray)
    reach = (flight.terrain.height_m - true.position_l[:, None, 2]) / direction[..., 2]
    away = reach[..., None] * direction - error[:, None, :3]
    f = np.einsum("nji,nkj->nki", matrix_from_angles(*(true.angles + error[:, 3:]).T), away)
    seen = -c[:, None] * f[..., :2] / f[..., 2:]
    return np.hypot(*np.moveaxis(seen - xy, 2, 0)) / np.linalg.norm(pitch, axis=1)


class _Predicting(Matcher):
    """A matcher that notes how far from their prediction its tie points were found, with the stamp, ns."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[tuple[int, float]] = []

    def _tie(self, strip_id: str, tie: MatchedTie) -> Message:
        self.noted.append((self._stamp_ns, tie.prediction_px))
        return super()._tie(strip_id, tie)


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """The rows as a table: each direction over its flights."""
    out = [
        f"orientation wrong by {WRONG_PX:g} px, of predictions the median and 95 %, px; wanted within {WANTED_PX:g} px"
        " after the first window",
        "                     views against each other                the ground in the image",
        "                     first window      after it          first window      after it       ties (least)",
    ]
    missed = 0
    for direction in DIRECTIONS:
        for rough in (False, True):
            mine = [r for r in rows if r["direction"] == direction and r["rough"] == rough]
            if not mine:
                continue
            texts = []
            for key in ("between_views_px", "on_the_ground_px"):
                for part in ("before", "after"):
                    values = [r[key][part] for r in mine if r[key][part]]
                    # over flights: the middle one of medians, the worst one of 95 %
                    both = [np.median([v[0] for v in values]), max(v[1] for v in values)] if values else []
                    texts.append(" ".join(f"{v:7.2f}" for v in both) or "none")
            bad = [r["seed"] for r in mine if any(not r[k]["after"] or r[k]["after"][1] > WANTED_PX for k in
                                                  ("between_views_px", "on_the_ground_px"))]  # fmt: skip
            missed += len(bad)
            name = f"{direction}, {'rough' if rough else 'plain'}"
            out.append(
                f"  {name:<16}" + " ".join(f"{t:>17}" for t in texts) + f" {min(r['ties'] for r in mine):8d}"
                + (f"   not within: seed {', '.join(map(str, bad))}" if bad else "")
            )  # fmt: skip
    out.append(f"{len(rows)} flights, {missed} not within {WANTED_PX:g} px (95 %) after the first window")
    return out
