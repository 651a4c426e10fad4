"""Determinability on line: which additional parameters the network can see by now.

All parameters are in the state from the start with what is known of them beforehand, and gather information all along.
What the network cannot see yet stays near zero by its a-priori sigma, and what that sigma leaves open is in the
covariance of all results. A parameter held at zero until a test lets it in would leave that out, and good rays would be
refused for the camera's fault; with what it leaves open in the covariance (considered) sigmas would be right, and the
results 31 to 86 % worse: parameters that fail a test alone are known in combinations
(`bench/consistency.py held`).

The stepwise test of the batch adjustment (`adjustment.determinability.examine`) runs on the normal equations of the
window, one parameter a step, from the full set downwards, again and again. Before its four criteria stands one that a
window needs: the observations must say more of a parameter than was known beforehand. Two sweeps have to agree before
a parameter counts as determined or no longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjustment.determinability import Evidence, Limits, examine, point_sigmas, ranks, strongest_correlations
from ...arrays import IntArray
from ...camera.line_camera import LineCamera
from ...camera.self_calibration import SelfCalibration
from ..state.batch import Batch
from ..state.unknowns import WindowState

ESTIMATED, NOT_YET = "estimated", "not yet determined"
#: Critical values; a level of 1 % (statistical level), as the tests are made again and again.
LIMITS = Limits(alpha=0.01)
#: Share of the a-priori variance that may be left of a parameter the network sees (tuned): half the sigma.
LEFT_OF_PRIOR = 0.25
#: Sweeps that have to agree (tuned); one is enough for a parameter with this value of Student's t.
AGREEING, CLEAR = 2, 4.5
#: Redundancy below which nothing is examined (tuned).
LEAST_REDUNDANCY = 60
#: Batches with most points, whose points stand for all (tuned, for speed).
SAMPLED_BATCHES = 4
#: Steps of the test in one update before the first sweep is over, and time between two later on, s (tuned, for speed).
STEPS, STEP_EVERY_S = 2, 0.8


@dataclass(frozen=True)
class Standing:
    """Whether a parameter is determined, and why (not)."""

    status: str
    reason: str


class Determinability:
    """The test of the additional parameters of one camera.

    Parameters
    ----------
    parameters : the set
    numbers : (m,) of its unknowns in the window

    Attributes
    ----------
    standing : (m) which are determined
    """

    def __init__(self, parameters: SelfCalibration, numbers: IntArray, camera: LineCamera) -> None:
        self._names, self._sigma = parameters.unknown_names, parameters.apriori_sigma
        self._numbers, self._rank = numbers, ranks(self._names, camera)
        m = len(numbers)
        self.standing = (Standing(NOT_YET, "too few observations yet"),) * m
        self._inside = np.zeros(m, dtype=bool)
        self._votes = np.zeros(m, dtype=np.int64)  # sweeps in a row that say otherwise
        self._open, self._found = np.ones(m, dtype=bool), [""] * m  # of the sweep under way
        self._swept = False
        self._next_s = -np.inf

    def step(
        self, now_s: float, state: WindowState, batches: Sequence[Batch], sigma0: float, redundancy: int, gsd_m: float
    ) -> list[str]:
        """The steps of the sweep that are due; returns what happened, for the operator."""
        steps = int(now_s >= self._next_s) if self._swept else STEPS
        events: list[str] = []
        for _ in range(steps):
            self._next_s = now_s + STEP_EVERY_S - 1e-6
            if redundancy < LEAST_REDUNDANCY or not batches:
                break
            if not self._open.any() or not self._removes_one(state, batches, sigma0, redundancy, gsd_m):
                events += self._conclude()
        return events

    def _removes_one(
        self, state: WindowState, batches: Sequence[Batch], sigma0: float, redundancy: int, gsd_m: float
    ) -> bool:
        """Whether another parameter of the sweep under way is not determined; if none is, the sweep is over."""
        places = np.flatnonzero(self._open)
        evidence = self._evidence(places, state, batches, sigma0, redundancy, gsd_m)
        left = np.diagonal(evidence.cofactors) / self._sigma[places] ** 2
        worst = int(np.argmax(left))
        if left[worst] > LEFT_OF_PRIOR:
            self._open[places[worst]] = False
            self._found[places[worst]] = f"of its a-priori variance {100 * left[worst]:.0f} % are left"
            return True
        verdict = examine(evidence, LIMITS)
        if verdict.removal is not None:
            place = self._names.index(verdict.removal.name)
            self._open[place], self._found[place] = False, verdict.removal.reason
            return True
        for name, why in verdict.kept.items():
            self._found[self._names.index(name)] = why
        self._votes[places[np.abs(evidence.t) > CLEAR]] += 1
        return False

    def _conclude(self) -> list[str]:
        """A sweep is over: parameters that two of them agree about come or go; lines for the operator."""
        differs = self._open != self._inside
        self._votes = np.where(differs, self._votes + 1, 0)
        change = differs & (self._votes >= AGREEING)
        self._inside ^= change
        self._votes[change] = 0
        standing, events = [], []
        for name, inside, agrees, changed, why in zip(
            self._names, self._inside, self._inside == self._open, change, self._found, strict=True
        ):
            standing.append(Standing(ESTIMATED if inside else NOT_YET, why or ("" if agrees else "just determined")))
            if changed:
                what = "is determined" if inside else f"is not determined any more: {why}"
                events.append(f"parameter {name} {what}")
        self.standing, self._swept = tuple(standing), True
        self._open[:], self._found = True, [""] * len(self._names)
        return events

    def _evidence(
        self, open_: IntArray, state: WindowState, batches: Sequence[Batch], sigma0: float, redundancy: int,
        gsd_m: float,
    ) -> Evidence:  # fmt: skip
        """Evidence of parameters (m,) of the set, the others being zero."""
        everything, values = state.conditioned(np.delete(self._numbers, open_))
        places = state.places(self._numbers[open_])
        Q = everything[:, places]
        q = np.maximum(np.diagonal(Q[places]), 1e-300)
        others = np.setdiff1d(np.arange(len(state)), state.places(self._numbers))
        names, cross, variance = ["the orientation"] * len(others), [Q[others]], [np.diagonal(everything)[others]]
        for batch in sorted(batches, key=lambda b: -b.n_points)[:SAMPLED_BATCHES]:
            known = np.flatnonzero(batch.normals.rank == 3)
            columns = state.places(batch.columns)
            to_points = -np.swapaxes(batch.inverse_factors, 1, 2) @ (batch.coupling @ Q[columns])
            points = batch.cofactors(everything[np.ix_(columns, columns)]).points
            cross.append(to_points[known].reshape(-1, len(places)))
            variance.append(np.einsum("pii->pi", points[known]).ravel())
            names += [f"{axis} of point {batch.names[p]}" for p in known for axis in "XYZ"]
        strongest, r = strongest_correlations(np.concatenate(cross), np.concatenate(variance), q)
        to_points = np.concatenate(cross[1:]).reshape(-1, 3, len(places))
        return Evidence(
            tuple(self._names[i] for i in open_), values[places], Q[places], np.ones(len(places)),
            tuple(names[k] for k in strongest), np.clip(r, -1.0, 1.0),
            point_sigmas(to_points, q) if len(to_points) else np.zeros((len(places), 3)),
            sigma0 if np.isfinite(sigma0) else 1.0, redundancy, gsd_m, self._rank[open_],
        )  # fmt: skip
