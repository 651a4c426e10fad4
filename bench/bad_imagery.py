"""Tie points out of spoilt image lines, held against truth: how many are left, and whether their errors are as claimed.

    python bench/bad_imagery.py [--seeds 2] [--seconds 40] [--pixels 800] [--only WORDS]

Image lines of a simulated flight are spoilt in one way after another and go through the matcher, with poses that have
slow attitude errors. Errors are those of rays against the true place of the point's first ray.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable
from typing import Any

import frame
import numpy as np
from numpy.typing import NDArray

from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.simulation.matching_study import match_strip, tie_errors

Images = list[NDArray[np.unsignedinteger]]
#: Lost lines: number of the CCD line, number of the line.
Lost = list[NDArray[np.bool_]]
Spoil = Callable[[Images, Lost, np.random.Generator, float], None]

FULL = 4095


def runs(n: int, long: int, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of n lines lie in runs of a length that begin at random and take a share of all."""
    begins = rng.random(n) < share / long
    return np.convolve(begins, np.ones(long))[:n] > 0


def losing(long: int, share: float, ccds: tuple[int, ...] = (0, 1, 2)) -> Spoil:
    def spoil(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
        for i in ccds:
            lost[i] |= runs(len(lost[i]), long, share, rng)

    return spoil


def black(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
    for image in images:
        image[runs(len(image), 3, 0.05, rng)] = 0


def frozen(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
    for image in images:
        for i in np.flatnonzero(runs(len(image), 3, 0.05, rng)):
            image[i] = image[max(i - 1, 0)]


def exposed(quantile: float) -> Spoil:
    """So much light that pixels above a quantile of the grey values are saturated; one view looks less bright."""

    def spoil(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
        for image, more in zip(images, (1.0, 1.15, 0.9), strict=True):
            gain = more * FULL / np.quantile(image[::7], quantile)
            image[:] = np.clip(image * gain, 0, FULL).astype(image.dtype)

    return spoil


def columns(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
    for image in images:
        bad = rng.random(image.shape[1]) < 0.02
        image[:, bad] = rng.choice([0, FULL], bad.sum()).astype(image.dtype)


def dead(ccd: int, from_s: float, to_s: float = np.inf, value: int = 0) -> Spoil:
    def spoil(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
        images[ccd][int(from_s * rate) : int(min(to_s * rate, len(images[ccd])))] = value

    return spoil


def silent(ccd: int, from_s: float) -> Spoil:
    def spoil(images: Images, lost: Lost, rng: np.random.Generator, rate: float) -> None:
        lost[ccd][int(from_s * rate) :] = True

    return spoil


FAULTS: dict[str, Spoil] = {
    "none": lambda images, lost, rng, rate: None,
    "1 % of lines lost, by 1": losing(1, 0.01),
    "5 % of lines lost, by 3": losing(3, 0.05),
    "5 % of lines lost, by 8": losing(8, 0.05),
    "10 % of lines lost, by 3": losing(3, 0.10),
    "5 % of lines black, by 3": black,
    "5 % of lines frozen, by 3": frozen,
    "2 % of pixels saturated": exposed(0.98),
    "10 % of pixels saturated": exposed(0.90),
    "2 % of columns dead": columns,
    "nadir line black": dead(1, 0.0),
    "nadir line silent": silent(1, 0.0),
    "nadir line black from 15 s": dead(1, 15.0),
    "nadir line black 12 to 24 s": dead(1, 12.0, 24.0),
    "forward line black from 15 s": dead(0, 15.0),
    "forward line black 12 to 20 s": dead(0, 12.0, 20.0),
    "backward line black from 15 s": dead(2, 15.0),
}


def main() -> int:
    parser = frame.parser(__doc__, seeds=2)
    parser.add_argument("--first", type=int, default=3, help="seed (3)")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--pixels", type=int, default=800)
    parser.add_argument("--only", default="", help="faults whose names hold these words")
    parser.add_argument("--told", action="store_true", help="print what the matcher says")
    args = parser.parse_args()
    faults = {name: spoil for name, spoil in FAULTS.items() if args.only in name}
    rows: dict[str, list[Any]] = {name: [] for name in faults}
    for seed in range(args.first, args.first + args.seeds):
        flown = simulated_flight({
            "sensor": "ads40-small", "pixels": args.pixels, "images": True, "seconds": args.seconds, "height": 800.0,
            "lead_in": 2.0, "seed": seed,
        })  # fmt: skip
        flight = flown.simulation.flight
        assert flown.imager is not None
        strip = flight.strips[0]
        good = [flown.imager.render(0, ccd, 0, strip.lines) for ccd in range(len(flight.camera.lines))]
        for name, spoil in faults.items():
            images, lost = [image.copy() for image in good], [np.zeros(strip.lines, dtype=bool) for _ in good]
            spoil(images, lost, np.random.default_rng([seed, 5]), strip.line_rate_hz)
            begun = time.process_time()
            found = match_strip(flight, images, seed, lost=lost)
            spent = time.process_time() - begun
            ties, matcher = found.ties, found.matcher
            pause_s = np.diff([*np.unique(found.came_line), strip.lines]).max() / strip.line_rate_hz
            error, sigma = tie_errors(flight, ties)
            digest = hashlib.sha256(repr([(t.name, t.rays) for t in ties]).encode()).hexdigest()[:8]
            rows[name].append((len(ties), error, sigma, spent, pause_s, digest))
            if args.told:
                print(f"{name}, seed {seed}:", *found.told, dict(matcher.counters), sep="\n    ")
    print(f"{'lines':<32}  ties  in 0.3 px  over 2 px     sigma   normalised squared   ms a tie   longest pause")
    for name, results in rows.items():
        ties = sum(row[0] for row in results)
        error, sigma = (np.concatenate([row[i] for row in results]) for i in (1, 2))
        if not len(error):
            print(f"  {name:<30}{ties:6d}")
            continue
        length = np.hypot(*error.T)
        normalised = ((error / sigma)[length <= 2.0] ** 2).mean(axis=0)
        good, wrong = 100 * (length < 0.3).mean(), 100 * (length > 2.0).mean()
        sigma_px = 1.4826 * np.median(np.abs(error[length < 0.3]))
        ms, pause_s = 1000 * sum(row[3] for row in results) / max(ties, 1), max(row[4] for row in results)
        print(
            f"  {name:<30}{ties:6d} {good:8.1f} % {wrong:8.2f} % {sigma_px:6.3f} px   {normalised[0]:6.2f}"
            f" {normalised[1]:6.2f}      {ms:7.1f}   {pause_s:6.1f} s   {' '.join(row[5] for row in results)}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
