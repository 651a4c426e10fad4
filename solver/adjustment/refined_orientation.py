"""Refined orientation at any time: corrections of all models that were run, and their cofactors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adjustment import Solution
from .layout import CorrectionSet

Array = NDArray[np.floating]


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
        total += found.model.evaluate(stage.state.theta[found.columns], time_s)
    return total


def correction_cofactors(solution: Solution, strip: int, time_s: ArrayLike, lens: int | None = None) -> Array:
    """Cofactors (n, 6, 6) of the corrections at times (n,), of the last model; m and rad, for sigma0 = 1."""
    found = find_set(solution, strip, lens)
    design = found.model.design(time_s)
    n, nodes = design.coefficients.shape
    result = np.zeros((n, 6, 6))
    _, group = np.unique(design.columns.reshape(n, -1), axis=0, return_inverse=True)
    for g in range(int(group.max(initial=-1)) + 1):
        mine = np.flatnonzero(group == g)
        columns = design.columns[mine[0]].astype(np.int64)
        present = np.flatnonzero(columns.ravel() >= 0)
        own = columns.ravel()[present]
        Q = np.zeros((nodes * 6, nodes * 6))
        Q[np.ix_(present, present)] = solution.factor.cofactors(own + found.first_column)
        by_node = Q.reshape(nodes, 6, nodes, 6)
        a = design.coefficients[mine]
        result[mine] = np.einsum("nk,kcld,nl->ncd", a, by_node, a, optimize=True)
    return result


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
