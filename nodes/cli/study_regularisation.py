"""``triline study regularisation``: the source's nine control pixels, with its published condition numbers beside ours.

First table: condition number (Frobenius norm) of the normal equations without and with fictitious observations, and
how many parameters the pixels determine, with the steps of Gauss-Newton's method that the camera itself takes. Second
table: error on the ground over the whole image, of parameters estimated from the nine pixels in several ways; bias
and noise are what is expected of it. ``--plot`` draws the L-curve and the cross-validation of the narrow set.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.rectification.nine_pixels import PUBLISHED, ROUNDING, conditions, curve, iterations, outcomes
from ..errors import UserError
from ..formats.json_text import json_text, plain
from ..formats.new_file import new_file
from .outputs import refuse_unless_picture

EXAMPLE = "triline study regularisation --draws 200 --plot l-curve.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--draws", type=int, default=100, metavar="N", help="of parameters and control (100)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draws (1)")
    parser.add_argument("--plot", metavar="FILE", help="write L-curve and cross-validation (PNG, SVG, PDF)")


def run(args: argparse.Namespace) -> int:
    if args.draws < 1:
        raise UserError(f"--draws {args.draws}: wanted at least 1")
    if args.seed < 0:
        raise UserError(f"--seed {args.seed}: wanted at least 0")
    if args.plot:
        refuse_unless_picture(Path(args.plot))
    rows: list[dict[str, Any]] = []
    for (parameters, where), (before, after) in PUBLISHED.items():
        got = conditions(parameters, where)
        rng = np.random.default_rng(args.seed)
        steps = iterations(parameters, where, np.random.default_rng(args.seed))
        ways = outcomes(parameters, where, args.draws, rng)
        rows.append(
            {
                "parameters": parameters, "pixels": where, "published_before": before, "published_after": after,
                "iterations_before": steps[0], "iterations_after": steps[1],
                "before": got.before, "after": got.after, "determined": got.rank,
                "ways": {name: vars(found) for name, found in ways.items()},
            }
        )  # fmt: skip
    if args.plot:
        _plot(Path(args.plot), args.seed)
    if args.json:
        print(json_text({"sets": plain(rows)}))
        return 0
    print(
        "condition numbers, Frobenius norm, parameters in units of what is known beforehand (the source's are unknown)"
    )
    print(
        f"{'':12s}{'':8s}{'without':>21s}{'with fictitious obs.':>24s}{'determined':>12s}{'steps without, with':>21s}"
    )
    print(f"{'parameters':12s}{'pixels':8s}{'published':>11s}{'here':>10s}{'published':>14s}{'here':>10s}")
    for row in rows:
        here = f"{row['before']:.1e}" if row["before"] < ROUNDING else "rounding"
        print(
            f"{row['parameters']:<12d}{row['pixels']:8s}{row['published_before']:11.1e}{here:>10s}"
            f"{row['published_after']:14.1e}{row['after']:10.1e}{row['determined']:12d}"
            f"{_steps(row['iterations_before']):>12s}{_steps(row['iterations_after']):>9s}"
        )
    print("\nerror on the ground over the whole image, m")
    head = "".join(f"{word:>10s}" for word in ("error", "1 in 20", "bias", "noise"))
    print(f"{'':50s}{head}{'effective':>11s}{'alpha':>8s}{'condition':>11s}")
    for row in rows:
        for name, way in row["ways"].items():
            alpha = f"{way['alpha']:.2g}" if np.isfinite(way["alpha"]) else "-"
            print(
                f"{row['parameters']:<12d}{row['pixels']:8s}{name:30s}{_metres(way['error_m'])}{_metres(way['worst_m'])}"
                f"{_metres(way['bias_m'])}{_metres(way['noise_m'])}{way['effective']:11.1f}{alpha:>8s}{way['condition']:11.1e}"
            )
    return 0


def _steps(n: int | None) -> str:
    return "diverges" if n is None else str(n)


def _metres(value: float) -> str:
    return f"{value:10.1e}" if value >= 1e5 else f"{value:10.1f}"


def _plot(path: Path, seed: int) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for parameters in (14, 12):
        drawn = curve(parameters, "narrow", np.random.default_rng(seed))
        (line,) = left.loglog(drawn["residual"], drawn["prior"], label=f"{parameters} parameters")
        right.loglog(drawn["alpha"], drawn["score"], label=f"{parameters} parameters")
        for criterion, mark in (("gcv", "o"), ("l-curve", "s")):
            k = int(np.argmin(np.abs(np.log(drawn["alpha"] / drawn[criterion][0]))))
            text = f"{parameters}: by {'cross-validation' if criterion == 'gcv' else 'L-curve'}"
            style = {"color": line.get_color(), "marker": mark, "linestyle": "none", "label": text}
            left.plot(drawn["residual"][k], drawn["prior"][k], **style)
            right.plot(drawn["alpha"][k], drawn["score"][k], **style)
    left.set_xlabel("norm of the whitened residuals")
    left.set_ylabel("norm of the whitened parameters")
    right.set_xlabel("alpha")
    right.set_ylabel("score of cross-validation")
    left.set_title("nine narrow pixels: L-curve", loc="left", fontsize="medium")
    right.set_title("generalised cross-validation", loc="left", fontsize="medium")
    left.legend(frameon=False, fontsize="small")
    for axes in (left, right):
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    with new_file(path) as part:
        figure.savefig(part, format=path.suffix.lstrip(".").lower(), dpi=120)
    plt.close(figure)
