"""Refined orientation at any time: corrections of all models that were run, and their cofactors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..models.base import Design
from .adjustment import Solution
from .layout import CorrectionSet, platform_design

#: Times whose cofactors are computed at once; their linear functions take several times the room of what comes out.
#: Tuned, for memory.
AT_ONCE = 10_000


def corrections_at(solution: Solution, strip: int, time_s: ArrayLike, lens: int | None = None) -> Array:
    """Corrections (n, 6) to the measured orientation of a strip at times (n,), metres and radians.

    Parameters
    ----------
    solution : of the last model; those of models run before it are added
    strip : index of the strip
    time_s : (n,)
    lens : index of the lens where lenses look separately

    Raises
    ------
    ValueError : a strip (or lens) without rays
    """
    total = np.zeros((len(np.asarray(time_s)), 6))
    for stage in (*solution.problem.earlier, solution):
        found = find_set(stage, strip, lens)
        total += design_at(stage, found, time_s).evaluate(stage.state.theta)
    return total


def correction_cofactors(solution: Solution, strip: int, time_s: ArrayLike, lens: int | None = None) -> Array:
    """Cofactors (n, 6, 6) of the corrections at times (n,), of the last model; m and rad, for sigma0 = 1."""
    found = find_set(solution, strip, lens)
    design = design_at(solution, found, time_s)
    columns, coefficients = design.columns, design.coefficients
    result = np.zeros((len(columns), 6, 6))
    flat = columns.reshape(len(columns), -1)
    begins = np.ones(len(flat), dtype=bool)  # times that follow each other have the same columns: few rows are sorted
    begins[1:] = (flat[1:] != flat[:-1]).any(axis=1)
    _, group = np.unique(flat[begins], axis=0, return_inverse=True)
    group = group.reshape(-1)[np.cumsum(begins) - 1]
    for g in range(int(group.max(initial=-1)) + 1):
        mine = np.flatnonzero(group == g)
        for some in np.array_split(mine, 1 + len(mine) // AT_ONCE):
            numbers, A = Design(columns[some], coefficients[some]).functions()
            result[some] = (A @ solution.factor.cofactors(numbers)) @ np.swapaxes(A, 1, 2)
    return result


def design_at(solution: Solution, of: CorrectionSet, time_s: ArrayLike) -> Design:
    """Corrections of a set at times (n,) with those of the platform, by the columns of all unknowns."""
    design, layout = of.model.design(time_s), solution.layout
    design = Design(np.where(design.columns >= 0, design.columns + of.first_column, -1), design.coefficients)
    if layout.platform.n_unknowns:
        strip = solution.network.strips[of.strip]
        own = platform_design(strip, np.asarray(time_s, dtype=float), layout.platform, layout.heading)
        design = design.joined(own, layout.platform_columns)
    return design


def find_set(solution: Solution, strip: int, lens: int | None = None) -> CorrectionSet:
    """The correction set of a strip (and lens).

    Raises
    ------
    ValueError : there is none, because no ray was measured in it
    """
    for item in solution.layout.sets:
        if item.strip == strip and (item.lens is None or lens is None or item.lens == lens):
            return item
    raise ValueError(f"strip {solution.network.strips[strip].id} has no rays and so no corrections")
