"""``triline study matching``: tie points from image lines alone, held against truth."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.simulation.flight import Flight
from ..adjuster.adjuster import Adjuster
from ..formats.json_text import json_text
from ..matcher.matcher import Matcher
from ..navigator.navigator import Navigator
from ..recording.reader import RecordingReader
from ..simulator.flight_settings import simulated_flight
from ..simulator.simulator import Simulator
from .common_options import refuse_less
from .matched_ties import ROUGH, is_matched, tie_errors
from .study_flights import EPOCH_NS, each, processed

EXAMPLE = "triline study matching --seeds 3"
#: Errors below the first value are good matches, above the second wrong ones, px; then the limits to be met.
GOOD_PX, WRONG_PX = 0.3, 2.0
WANTED_GOOD, WANTED_WRONG, WANTED_SIGMA_PX, WANTED_NORMALISED = 0.95, 0.01, 0.15, (0.8, 1.25)
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "rough": ROUGH,
    "no stabilised mount": {"unstabilised": True},
    "strong image noise": {"image_noise": 60.0},
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="flights of each kind (3)")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="first seed (1)")
    parser.add_argument("--seconds", type=float, default=45.0, metavar="X", help="length of the strip (45)")
    parser.add_argument("--pixels", type=int, default=800, metavar="N", help="of a CCD line (800)")
    parser.add_argument("--plain", action="store_true", help="leave the rough flights out")


def run(args: argparse.Namespace) -> int:
    refuse_less(args, 1, "seeds")
    base = {"sensor": "ads40-small", "pixels": args.pixels, "seconds": args.seconds, "lead_in": 2.0, "images": True}
    kinds = ["plain"] if args.plain else list(KINDS)
    cases = [(kind, args.first + i) for kind in kinds for i in range(args.seeds)]
    flights = [{**base, **KINDS[kind], "seed": seed} for kind, seed in cases]
    found = each(fly, flights, args.quiet or args.json)
    rows = [{"kind": kind, "seed": seed, **quality} for (kind, seed), quality in zip(cases, found, strict=True)]
    print(json_text(rows) if args.json else "\n".join(lines(rows)))
    return 0


def fly(settings: dict[str, Any]) -> dict[str, Any]:
    """Process a flight with image lines through the on-line nodes, and compare its ties with truth."""
    flown = simulated_flight(settings)
    simulator = Simulator(flown.simulation, flown.imager)
    with tempfile.TemporaryDirectory() as folder:
        out = processed(simulator.messages(EPOCH_NS), [Navigator(), Matcher(), Adjuster()], Path(folder))
        ties = [message.body for message in RecordingReader(out).messages(["observation/tie"]) if is_matched(message)]
    return tie_quality(flown.simulation.flight, ties)


def tie_quality(flight: Flight, ties: list[Any]) -> dict[str, Any]:
    """Errors of matched ties (messages): each ray against the truth of the place of the point's first ray.

    Sigma is the robust one of single coordinates of good rays; normalised errors squared should be 1. ``common`` is
    what good rays of a CCD line have in common: mean of line and sample, and its standard error.
    """
    error, sigma, ccds = tie_errors(flight, ties)
    if not len(error):
        nothing: dict[str, Any] = {"ties": 0, "rays": 0, "good": 0.0, "wrong": 0.0, "sigma_px": 0.0}
        return {**nothing, "normalised": [0.0, 0.0], "common": {}}
    length = np.hypot(*error.T)
    good = length < GOOD_PX
    common = {}
    for ccd in dict.fromkeys(ccds):
        mine = error[good & (np.array(ccds) == ccd)]
        if len(mine) > 1:
            common[ccd] = [mine.mean(axis=0).tolist(), (mine.std(axis=0) / np.sqrt(len(mine))).tolist()]
    return {
        "ties": len(ties), "rays": len(length) + len(ties), "good": float(good.mean()),
        "wrong": float((length > WRONG_PX).mean()), "sigma_px": float(1.4826 * np.median(np.abs(error[good]))),
        "normalised": ((error / sigma)[length <= WRONG_PX] ** 2).mean(axis=0).tolist(), "common": common,
    }  # fmt: skip


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """The rows as a table, and whether they show what is wanted."""
    out = [
        "tie points from image lines    ties  in 0.3 px  over 2 px     sigma   normalised errors squared: line, sample"
    ]
    for r in rows:
        name = f"{r['kind']}, seed {r['seed']}"
        out.append(
            f"  {name:<27}{r['ties']:6d} {100 * r['good']:8.1f} % {100 * r['wrong']:8.2f} %"
            f" {r['sigma_px']:6.3f} px   " + " ".join(f"{v:6.2f}" for v in r["normalised"])
        )
    low, high = WANTED_NORMALISED
    pooled = {
        kind: np.mean([r["normalised"] for r in rows if r["kind"] == kind])
        for kind in dict.fromkeys(r["kind"] for r in rows)
    }
    checks = (
        (f"{100 * WANTED_GOOD:g} % within {GOOD_PX} px", all(r["good"] >= WANTED_GOOD for r in rows)),
        (f"sigma of the good ones below {WANTED_SIGMA_PX} px", all(0 < r["sigma_px"] < WANTED_SIGMA_PX for r in rows)),
        (f"wrong ones below {100 * WANTED_WRONG:g} %", all(r["wrong"] < WANTED_WRONG for r in rows)),
        (f"normalised errors squared of each kind in {low} to {high}", all(low <= v <= high for v in pooled.values())),
    )
    out += [f"  {'met' if met else 'NOT MET'}: {text}" for text, met in checks]
    return out + [f"  {kind}, errors common to a CCD line, px: {common_errors(rows, kind)}" for kind in pooled]


def common_errors(rows: list[dict[str, Any]], kind: str) -> str:
    """What rays of a CCD line have in common in flights of a kind, weighted by how well each tells it."""
    texts, found = [], [r["common"] for r in rows if r["kind"] == kind]
    for ccd in dict.fromkeys(ccd for common in found for ccd in common):
        mean, error = np.array([common[ccd] for common in found if ccd in common]).swapaxes(0, 1)
        weight = 1.0 / np.maximum(error, 1e-6) ** 2
        value, sigma = (weight * mean).sum(axis=0) / weight.sum(axis=0), weight.sum(axis=0) ** -0.5
        each = zip(("line", "sample"), value, sigma, strict=True)
        texts.append(f"{ccd} " + ", ".join(f"{name} {v:+.4f} +- {s:.4f}" for name, v, s in each))
    return "; ".join(texts)
