"""What the runs of ``triline study control`` say: compared by their check points, the best named with the reason."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.confidence_set import CONFIDENCE, LEAST_POINTS, confidence_set
from ...solver.adjustment.statistics import point_accuracy
from .control_runs import Block, Pool, Run

Array = NDArray[np.floating]

#: A run that loses more than this share of the check points is not compared.
MOST_LOST = 0.1
#: A run is not as good as the best if its predicted sigmas are so many times what the best one has, by sigmas or RMSE.
#: Tuned: more than sigma0 of two runs differs by chance.
LARGER_SIGMA = 1.2
#: A check point whose errors are so many times what is expected of them, in the median of the runs that are as good as
#: the best, is told. Tuned: not one in ten thousand is, if errors are as stated.
SUSPICIOUS = 4.0


@dataclass(frozen=True)
class Row:
    """A run beside the others.

    Attributes
    ----------
    rmse_m, sigma_m : (3,) of its check points, and their predicted sigmas, root of the mean variance
    n_check : check points it determined
    rmse_3d_m, expected_3d_m : in space (in plan where the third coordinate is not known), of the check points that all
        compared runs have in common, and what the sigmas of adjusted and of given coordinates let expect; NaN for a
        run that is not compared
    told_apart : whether the check points tell it from the best
    as_good : they do not, and its predicted sigmas are not larger than those of the best (`LARGER_SIGMA`)
    note : why it is not compared, and other remarks
    """

    run: Run
    rmse_m: Array
    sigma_m: Array
    n_check: int
    rmse_3d_m: float = float("nan")
    expected_3d_m: float = float("nan")
    told_apart: bool = False
    as_good: bool = False
    note: str = ""


@dataclass(frozen=True)
class Study:
    """All runs, compared.

    Attributes
    ----------
    control : names of the control points for each number
    common : names of the check points that all compared runs have
    best, simplest : the smallest RMSE; of those that are as good the one with the fewest control points, then unknowns
    suspicious : check points that are off in all runs that are as good, and how many times their sigma
    """

    block: Block
    pool: Pool
    control: dict[int, tuple[str, ...]]
    rows: tuple[Row, ...]
    common: tuple[str, ...]
    best: Row | None
    simplest: Row | None
    suspicious: dict[str, float]

    @property
    def where(self) -> str:
        """What errors of points are lengths in."""
        return "in plan" if self.pool.single else "in space"

    @property
    def enough(self) -> bool:
        """Whether there are check points enough to tell configurations apart."""
        return len(self.common) >= LEAST_POINTS


def judge(block: Block, pool: Pool, control: dict[int, tuple[str, ...]], runs: Sequence[Run]) -> Study:
    """Compare runs by the check points that they have in common."""
    rows = [_row(r) for r in runs]
    chosen = {id for ids in control.values() for id in ids}
    places = {block.ground.id[k]: k for k in (*pool.possible, *pool.always) if block.ground.id[k] not in chosen}
    usable = [k for k, row in enumerate(rows) if row.run.found is not None and not row.note]
    sets = {k: set(f.check) & places.keys() for k in usable if (f := rows[k].run.found) is not None}
    # check points that some runs cannot determine count where most runs have them
    often = {id for id in places if 2 * sum(id in s for s in sets.values()) > len(sets)}
    for k in list(sets):
        lost = len(often - sets[k])
        if lost > MOST_LOST * len(often) or not often:
            rows[k] = replace(rows[k], note=f"not compared: {lost} of {len(often)} common check points not determined")
            del sets[k]
    common = tuple(id for id in places if sets and all(id in s for s in sets.values()))
    if not sets or not common:
        return Study(block, pool, control, tuple(rows), (), None, None, {})
    squares, variance = np.empty((len(sets), len(common))), np.empty((len(sets), len(common)))
    for i, k in enumerate(sets):
        found = rows[k].run.found
        assert found is not None
        place = {id: n for n, id in enumerate(found.check)}
        mine = [place[id] for id in common]
        squares[i] = np.nansum(found.difference_m[mine] ** 2, axis=1)
        variance[i] = np.nansum(found.sigma_m[mine] ** 2, axis=1) + found.given_m2[mine]
    inside = confidence_set(np.sqrt(squares))
    for i, k in enumerate(sets):
        rmse, expected = (float(np.sqrt(values[i].mean())) for values in (squares, variance))
        rows[k] = replace(rows[k], rmse_3d_m=rmse, expected_3d_m=expected, told_apart=not inside[i])
    first = min((k for k in sets if not rows[k].told_apart), key=lambda k: rows[k].rmse_3d_m)
    limit = LARGER_SIGMA * max(rows[first].rmse_3d_m, rows[first].expected_3d_m)
    for k in sets:
        good = k == first or (not rows[k].told_apart and rows[k].expected_3d_m <= limit)
        rows[k] = replace(rows[k], as_good=good)
    best, simplest = rows[first], min((rows[k] for k in sets if rows[k].as_good), key=_simplicity)
    good_ones = [i for i, k in enumerate(sets) if rows[k].as_good]
    ratio = np.median(np.sqrt(squares / variance)[good_ones], axis=0)
    suspicious = {id: float(r) for id, r in zip(common, ratio, strict=True) if r > SUSPICIOUS}
    return Study(block, pool, control, tuple(rows), common, best, simplest, suspicious)


def _simplicity(row: Row) -> tuple[int, int, float]:
    assert row.run.found is not None
    return row.run.control, row.run.found.n_unknowns, row.rmse_3d_m


def _row(run: Run) -> Row:
    nothing = np.full(3, np.nan)
    found = run.found
    if found is None:
        return Row(run, nothing, nothing, 0, note=f"failed: {run.failed}")
    accuracy = point_accuracy(found.difference_m, found.sigma_m)
    note = ""
    if not found.converged:
        note = "not compared: not converged"
    elif not found.check:
        note = "not compared: no check point determined"
    elif found.undetermined:
        note = f"not compared: {found.undetermined} unknowns are not determined"
    return Row(run, accuracy.rmse_m, accuracy.sigma_m, accuracy.n, note=note)


def verdict(study: Study) -> Iterator[str]:
    """Which configuration is best and why, and what the check points cannot tell."""
    best, simplest = study.best, study.simplest
    compared = [row for row in study.rows if np.isfinite(row.rmse_3d_m)]
    if best is None or simplest is None:
        yield "nothing can be compared: no run is without fault; the table says why"
        return
    yield (
        f"best: {_named(best)}: RMSE {study.where} {metres(best.rmse_3d_m).strip()} m, the smallest of {len(compared)} "
        f"({best.rmse_3d_m / best.expected_3d_m:.2f} times what the sigmas let expect)"
    )
    if best.rmse_3d_m > min(row.rmse_3d_m for row in compared):
        yield "of those whose errors are not longer at most check points; another RMSE is smaller by a few points"
    if len(study.rows) > len(compared):
        out = len(study.rows) - len(compared)
        yield f"{out} of {len(study.rows)} runs failed or could not be compared; the table says why"
    if len(compared) == 1:
        return
    yield from _as_good(study, best, simplest) if study.enough else [_too_few(len(study.common))]
    least = min(compared, key=lambda row: row.expected_3d_m)
    if least is not best:
        yield (
            f"by predicted sigmas alone: {_named(least)}: {metres(least.expected_3d_m).strip()} m {study.where}; "
            f"its RMSE is {least.rmse_3d_m / least.expected_3d_m:.2f} times that"
        )


def _too_few(points: int) -> str:
    return (
        f"common check points: {points}, too few to tell configurations apart, wanted {LEAST_POINTS} at least: the "
        f"RMSE of a coordinate is itself uncertain by {100 / np.sqrt(2 * points):.0f} %; go by the predicted sigmas"
    )


def _as_good(study: Study, best: Row, simplest: Row) -> Iterator[str]:
    """What the check points cannot tell from the best."""
    n, level = len(study.common), f"({100 * CONFIDENCE:.0f} %)"
    same = [row for row in study.rows if np.isfinite(row.rmse_3d_m) and not row.told_apart and row is not best]
    others = [row for row in same if row.as_good]
    if not same:
        yield f"the {n} common check points tell it from all others {level}"
    if len(same) > len(others):
        more = len(same) - len(others)
        yield (
            f"{more} of the others cannot be told from it by {n} common check points, but "
            f"{'has' if more == 1 else 'have'} larger predicted sigmas ({100 * (LARGER_SIGMA - 1):.0f} % or more)"
        )
    if others:
        worst = max(row.rmse_3d_m for row in others) / best.rmse_3d_m - 1.0
        many = "1 other is" if len(others) == 1 else f"{len(others)} others are"
        yield (
            f"{many} as good: the RMSE is up to {100 * worst:.0f} % larger, which {n} common check points cannot "
            f"distinguish {level}"
        )
    if simplest is best and others:
        yield "it is the simplest of them, with the fewest control points and then unknowns"
    elif simplest is not best:
        yield (
            f"simplest of them, fewest control points and then unknowns: {_named(simplest)}: RMSE "
            f"{metres(simplest.rmse_3d_m).strip()} m"
        )


def _named(row: Row) -> str:
    found = row.run.found
    assert found is not None
    return f"{row.run.control} control points, {row.run.configuration.label} ({found.n_unknowns} unknowns)"


def metres(value: float) -> str:
    """Three digits at least, eight characters."""
    if not np.isfinite(value):
        return f"{'-':>8s}"
    decimals = 4 if abs(value) < 1 else 3 if abs(value) < 10 else 2 if abs(value) < 1000 else 0
    return f"{value:8.{decimals}f}"
