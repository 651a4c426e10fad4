"""``triline study matching``: tie points from image lines alone against truth, and what an adjustment makes of them."""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.matching.options import MatchedTie
from ...solver.simulation.flight import Flight
from ...solver.simulation.observations import find_looks
from ..adjuster import Adjuster
from ..errors import UserError
from ..flight_settings import simulated_flight
from ..matcher import Matcher
from ..navigator import Navigator
from ..node import Message
from ..recording import RecordingReader, RecordingWriter
from ..report.evaluation import evaluate_flight
from ..report.flight import collect
from ..report.source import messages_of
from ..runner import process
from ..simulator import Simulator
from .progress import progress

EXAMPLE = "triline study matching --seeds 3"
EPOCH_NS = 1_780_000_000_000_000_000
#: Good matches are nearer to the truth than this, wrong ones farther, px.
GOOD_PX, WRONG_PX = 0.3, 2.0
#: Flights besides the plain ones: name -> settings. The angle of 30 px depends on the pixels and is set for them.
ROUGH: dict[str, dict[str, Any]] = {
    "three times the turbulence": {"turbulence": 3.0},
    "no stabilised mount": {"unstabilised": True},
    "strong image noise": {"image_noise": 60.0},
}
WRONG_START = "orientation 30 px wrong"
Array = NDArray[np.floating]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="plain flights (3)")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="first seed (1)")
    parser.add_argument("--seconds", type=float, default=45.0, metavar="X", help="length of the strip (45)")
    parser.add_argument("--pixels", type=int, default=800, metavar="N", help="of a CCD line (800)")
    parser.add_argument("--plain", action="store_true", help="leave the rough flights out")


def run(args: argparse.Namespace) -> int:
    if args.seeds < 1:
        raise UserError(f"--seeds {args.seeds}, wanted 1 at least")
    base = {"sensor": "ads40-small", "pixels": args.pixels, "seconds": args.seconds, "lead_in": 2.0}
    cases = [(f"seed {args.first + i}", {"seed": args.first + i}) for i in range(args.seeds)]
    if not args.plain:
        cases += [(name, {**settings, "seed": args.first}) for name, settings in ROUGH.items()]
        angle = float(np.degrees(30 * 0.065 * 1200 / args.pixels / 62.7))
        # so low that more than the first window fits into the strip
        cases.append((WRONG_START, {"shift": [angle, angle, angle / 2], "seed": args.first, "height": 600.0}))
    rows = []
    with tempfile.TemporaryDirectory() as folder, progress("flights", args.quiet or args.json) as tell:
        for i, (name, settings) in enumerate(cases):
            rows.append({"flight": name, **fly({**base, **settings}, Path(folder))})
            if tell is not None:
                tell((i + 1) / len(cases))
    print(json.dumps(rows, indent=2) if args.json else "\n".join(lines(rows)))
    return 0


def fly(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A flight with image lines; and the same with simulated rays in place of the matched ones: truth and noise."""
    flown = simulated_flight({**settings, "images": True})
    simulator, flight = Simulator(flown.simulation, flown.imager), flown.simulation.flight
    messages = list(simulator.messages(EPOCH_NS))
    matcher = _Predicting()
    ties, evaluated, window_ns = _processed(messages, [Navigator(), matcher, Adjuster()], folder)
    matched = [message for message in ties if "-M" in message.body.point]
    others = [message for message in messages if not message.topic.startswith("sensor/lines/")]
    rng = np.random.default_rng(settings["seed"])
    # control is the same in both: targets as they were measured
    others += [message for message in ties if "-M" not in message.body.point and message.source == Matcher.name]
    _, reference, _ = _processed([*others, *simulated_ties(flight, matched, rng)], [Navigator(), Adjuster()], folder)
    accuracy = {
        name: {
            "rms_m": part["orientation"]["final"]["rmse_m"], "rms_deg": part["orientation"]["final"]["rmse_deg"],
            "points_m": part["points"].get("adjusted", {"rmse_m": [np.nan] * 3})["rmse_m"], "sigma0": part["sigma0"],
        }
        for name, part in (("matched", evaluated), ("simulated", reference))
    }  # fmt: skip
    quality = tie_quality(flight, [message.body for message in matched])
    return {**quality, "prediction": matcher.prediction_px(window_ns), "accuracy": accuracy}


class _Predicting(Matcher):
    """A matcher that notes how far from their prediction its tie points were found."""

    def __init__(self) -> None:
        super().__init__()
        self._noted: list[tuple[int, float]] = []

    def _tie(self, strip: Any, tie: MatchedTie) -> Message:
        self._noted.append((self._stamp_ns, tie.prediction_px))
        return super()._tie(strip, tie)

    def prediction_px(self, window_ns: int) -> dict[str, list[float]]:
        """Median and 95 % of the distances, px, of ties made until a time and after it; empty where there are none."""
        stamp_ns, px = np.array(self._noted, dtype=float).reshape(-1, 2).T
        parts = {"before": px[stamp_ns <= window_ns], "after": px[stamp_ns > window_ns]}
        return {name: np.quantile(part, [0.5, 0.95]).tolist() if len(part) else [] for name, part in parts.items()}


def _processed(messages: list[Message], nodes: list[Any], folder: Path) -> tuple[list[Message], dict[str, Any], int]:
    """Ties, evaluation, and the time at which the first window of ties was full, ns."""
    recording, out = folder / "flight.mcap", folder / "out.mcap"
    with RecordingWriter(recording) as writer:
        for message in messages:
            writer.write(message)
    with RecordingWriter(out) as writer:
        process(RecordingReader(recording), nodes, writer.write_raw)
    reader = RecordingReader(out)
    ties = list(reader.messages(["observation/tie"]))
    begun = min((tie.stamp_ns for tie in ties), default=0)
    # reports tell how long the window is; the first one is over when its ties have been worked in
    lengths = [m.body.window_end_ns - m.body.window_start_ns for m in reader.messages(["adjustment/report"])]
    return ties, evaluate_flight(collect(messages_of(out))), begun + max(lengths, default=0)


def simulated_ties(flight: Flight, ties: list[Message], rng: np.random.Generator) -> list[Message]:
    """The ties with their true rays, and noise of the sigmas that the matcher gave."""
    true, index = _true_rays(flight, [message.body for message in ties])
    number = {strip.id: i for i, strip in enumerate(flight.strips)}
    out = []
    for message in ties:
        body = type(message.body)()
        body.CopyFrom(message.body)
        for ray in body.images:
            strip = number[ray.strip]
            at = true.get((index[body.point], strip, flight.camera.line_index[ray.ccd]))
            if at is None:
                continue
            line = at[0] + ray.sigma_line * rng.standard_normal()
            ray.time_ns += round((line - ray.line) * 1e9 / flight.strips[strip].line_rate_hz)
            ray.line, ray.sample = line, at[1] + ray.sigma_sample * rng.standard_normal()
        out.append(Message(message.topic, message.stamp_ns, body, "simulator of ties"))
    return out


def tie_quality(flight: Flight, ties: list[Any]) -> dict[str, Any]:
    """Errors of matched ties (messages): each ray against the truth of the place of the point's first ray.

    Sigma is the robust one of single coordinates of good rays; normalised errors squared should be 1.
    """
    error, sigma = tie_errors(flight, ties)
    if not len(error):
        return {"ties": 0, "rays": 0, "good": 0.0, "wrong": 0.0, "sigma_px": 0.0, "normalised": 0.0}
    length = np.hypot(*error.T)
    good = length < GOOD_PX
    return {
        "ties": len(ties), "rays": len(length) + len(ties), "good": float(good.mean()),
        "wrong": float((length > WRONG_PX).mean()), "sigma_px": float(1.4826 * np.median(np.abs(error[good]))),
        "normalised": float(((error / sigma)[length <= WRONG_PX] ** 2).mean()),
    }  # fmt: skip


def tie_errors(flight: Flight, ties: list[Any]) -> tuple[Array, Array]:
    """(rays, 2) errors of line and sample against the point's first ray, and their sigma (rays, 2), px."""
    true, index = _true_rays(flight, ties)
    number = {strip.id: i for i, strip in enumerate(flight.strips)}
    first: dict[str, Any] = {}
    rows = []
    for tie in ties:
        base = first.setdefault(tie.point, tie.images[0])
        for ray in tie.images:
            at = true.get((index[tie.point], number[ray.strip], flight.camera.line_index[ray.ccd]))
            if at is None or (ray.strip == base.strip and ray.ccd == base.ccd):
                continue
            sigma = np.hypot([ray.sigma_line, ray.sigma_sample], [base.sigma_line, base.sigma_sample])
            rows.append((ray.line - at[0], ray.sample - at[1], *sigma))
    table = np.array(rows).reshape(-1, 4)
    return table[:, :2], table[:, 2:]


def _true_rays(
    flight: Flight, ties: list[Any]
) -> tuple[dict[tuple[int, int, int], tuple[float, float]], dict[str, int]]:
    """True line and sample by (point, strip, CCD line) of the ground under each point's first ray; points by name."""
    camera, strips = flight.camera, flight.strips
    number = {strip.id: i for i, strip in enumerate(strips)}
    first: dict[str, Any] = {}
    for tie in ties:
        first.setdefault(tie.point, tie.images[0])
    point_l = np.empty((len(first), 3))
    for i, ray in enumerate(first.values()):
        ccd = camera.line_index[ray.ccd]
        pose = flight.truth.at(np.atleast_1d(strips[number[ray.strip]].time_of(ray.line)))
        xy = camera.image_coordinates(np.array([ccd]), np.array([ray.sample]))[0][0]
        direction = pose.R_lc[0] @ np.array([*xy, -camera.focal_length_mm[ccd]])
        point_l[i] = flight.terrain.intersect(pose.position_l, direction[None])[0]
    looks = find_looks(point_l, strips, camera)
    columns = looks.point, looks.strip, looks.ccd, looks.line, looks.sample
    true = {(p, s, c): (u, v) for p, s, c, u, v in zip(*(a.tolist() for a in columns), strict=True)}
    return true, {name: i for i, name in enumerate(first)}


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """The rows as two tables."""
    out = ["tie points from image lines   ties  in 0.3 px  over 2 px    sigma  normalised errors squared"]
    for r in rows:
        out.append(
            f"  {r['flight']:<27} {r['ties']:5d} {100 * r['good']:8.1f} % {100 * r['wrong']:8.2f} %"
            f" {r['sigma_px']:6.3f} px {r['normalised']:6.2f}"
        )
    out.append("distance of tie points from where the orientation of now puts them, px: median and 95 %")
    out.append("                                in the first window      after it")
    for r in rows:
        texts = [" ".join(f"{v:8.2f}" for v in r["prediction"][part]) or "none" for part in ("before", "after")]
        out.append(f"  {r['flight']:<27} {texts[0]:>20} {texts[1]:>20}")
    out.append("on-line, final: RMS against truth, matched ties / the same points with simulated rays")
    out.append(
        "                                X, Y, Z (m)           omega, phi, kappa (mdeg)        points X, Y, Z (m)"
    )
    for r in rows:
        for name, part in r["accuracy"].items():
            title = r["flight"] if name == "matched" else "   simulated"
            values = [part["rms_m"], [1e3 * v for v in part["rms_deg"]], part["points_m"]]
            out.append(f"  {title:<27} " + "   ".join(" ".join(f"{v:7.3f}" for v in value) for value in values))
    for key, name in (("rms_m", "position"), ("rms_deg", "attitude"), ("points_m", "points")):
        both = [np.array([r["accuracy"][kind][key] for r in rows]) for kind in ("matched", "simulated")]
        known = np.isfinite(both).all(axis=(0, 2))  # a flight without good targets has no points to compare
        if not known.any():
            continue
        ratio = np.sqrt((both[0][known] ** 2).sum(axis=0) / (both[1][known] ** 2).sum(axis=0))
        out.append(f"  matched over simulated, {name:<9}" + " ".join(f"{v:6.2f}" for v in ratio))
    return out
