"""Determinability on line: which additional parameters the network can see by now.

All parameters are in the state from the start with what is known of them beforehand, and gather information all along.
What the network cannot see yet stays near zero by its a-priori sigma, and what that sigma leaves open is in the
covariance of all results. A parameter held at zero until a test lets it in would leave that out, and good rays would be
refused for the camera's fault; with what it leaves open in the covariance (considered) sigmas would be right, and the
results 31 to 86 % worse: parameters that fail a test alone are known in combinations
(`bench/consistency.py held`).

The stepwise test of the batch adjustment (`determinability.examine`) runs on the normal equations of the window, one
parameter an update, from the full set downwards, again and again. Before its four criteria stands one that a window
needs: what the observations say must be more than what was said beforehand. Two sweeps have to agree before a
parameter counts as determined or no longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..adjustment.determinability import Evidence, Limits, examine
from ..selfcalibration import SelfCalibration
from .batch import Batch, inverse_factors
from .state import WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

ESTIMATED, NOT_YET = "estimated", "not yet determined"
#: Share of the a-priori variance that may be left of a parameter the network sees.
LEFT_OF_PRIOR = 0.25
#: Sweeps that have to agree; one is enough for a parameter as significant as this.
AGREEING, CLEAR = 2, 4.5
#: Redundancy below which nothing is examined.
ENOUGH = 60
#: Batches whose points stand for all.
SAMPLED = 4


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
    rank : (m,) as in `Evidence`
    limits : critical values

    Attributes
    ----------
    inside : (m,) which are determined
    reasons : (m) why (not)
    swept : whether a first sweep is over
    """

    def __init__(
        self,
        parameters: SelfCalibration,
        numbers: IntArray,
        rank: IntArray,
        limits: Limits = Limits(),  # noqa: B008
    ) -> None:
        self.names = parameters.unknown_names
        self.numbers = numbers
        self._rank, self._limits = rank, limits
        self._sigma = parameters.apriori_sigma
        m = len(numbers)
        self.inside = np.zeros(m, dtype=bool)
        self.reasons = ["too few observations yet"] * m
        self._open = np.ones(m, dtype=bool)  # of the sweep under way
        self._found = [""] * m
        self._votes = np.zeros(m, dtype=np.int64)
        self.swept = False

    def standing(self) -> list[Standing]:
        return [
            Standing(ESTIMATED if inside else NOT_YET, reason)
            for inside, reason in zip(self.inside, self.reasons, strict=True)
        ]

    def step(
        self, state: WindowState, batches: Sequence[Batch], sigma0: float, redundancy: int, gsd_m: float
    ) -> list[str]:
        """One step of the sweep; returns what happened, for the operator."""
        if redundancy < ENOUGH or not batches:
            return []
        if self._open.any():
            evidence, seen = self._gather(state, batches, sigma0, redundancy, gsd_m)
            open_ = np.flatnonzero(self._open)
            worst = int(np.argmax(seen))
            if seen[worst] > LEFT_OF_PRIOR:
                self._open[open_[worst]] = False
                self._found[open_[worst]] = f"of its a-priori variance {100 * seen[worst]:.0f} % are left"
                return []
            verdict = examine(evidence, self._limits)
            if verdict.removal is not None:
                place = self.names.index(verdict.removal.name)
                self._open[place] = False
                self._found[place] = verdict.removal.reason
                return []
            for name, why in verdict.kept.items():
                self._found[self.names.index(name)] = why
            self._votes[open_[np.abs(evidence.t) > CLEAR]] += 1
        return self._conclude()

    def _conclude(self) -> list[str]:
        """A sweep is over: parameters that two of them agree about come or go."""
        differs = self._open != self.inside
        self._votes = np.where(differs, self._votes + 1, 0)
        change = differs & (self._votes >= AGREEING)
        events = []
        for i in np.flatnonzero(change):
            self.inside[i] = self._open[i]
            what = "is determined" if self.inside[i] else f"is not determined any more: {self._found[i]}"
            events.append(f"parameter {self.names[i]} {what}")
        for i in range(len(self.names)):
            self.reasons[i] = self._found[i]
            if self.inside[i] != self._open[i]:
                self.reasons[i] = self._found[i] or "just determined"
        self._votes[change] = 0
        self.swept = True
        self._open[:] = True
        self._found = [""] * len(self.names)
        return events

    def _gather(
        self, state: WindowState, batches: Sequence[Batch], sigma0: float, redundancy: int, gsd_m: float
    ) -> tuple[Evidence, Array]:
        """Evidence of the parameters that are still open in this sweep, the others being zero, and the share (m,) of
        their a-priori variance that is left."""
        open_ = np.flatnonzero(self._open)
        numbers = self.numbers[open_]
        factor, values = state.conditioned(self.numbers[~self._open])
        places = state.places(numbers)
        unit = np.zeros((len(state), len(places)))
        unit[places, np.arange(len(places))] = 1.0
        Q = factor.solve(unit)
        own = Q[places]
        q = np.maximum(np.diagonal(own), 1e-300)
        others = np.ones(len(state), dtype=bool)
        others[state.places(self.numbers)] = False
        everything = factor.inverse()
        variances = np.maximum(np.diagonal(everything), 1e-300)
        r = Q[others] / np.sqrt(variances[others, None] * q)
        strongest = np.argmax(np.abs(r), axis=0)
        correlation = r[strongest, np.arange(len(places))]
        effects, partner = [], ["the orientation"] * len(places)
        for batch in sorted(batches, key=lambda b: -b.n_points)[:SAMPLED]:
            known = batch.normals.rank == 3
            L = inverse_factors(batch.normals)
            columns = state.places(batch.columns)
            through = batch.coupling @ Q[columns]  # (p, 3, m)
            to_points = -np.swapaxes(L, 1, 2) @ through
            inner = batch.coupling @ everything[np.ix_(columns, columns)] @ np.swapaxes(batch.coupling, 1, 2) + np.eye(
                3
            )
            own_variance = np.einsum("pki,pki->pi", L, inner @ L)
            rp = to_points[known] / np.sqrt(np.maximum(own_variance[known], 1e-12)[:, :, None] * q)
            if rp.size:
                flat = np.clip(rp.reshape(-1, len(places)), -1.0, 1.0)
                top = np.argmax(np.abs(flat), axis=0)
                value = flat[top, np.arange(len(places))]
                for i in np.flatnonzero(np.abs(value) > np.abs(correlation)):
                    correlation[i] = value[i]
                    p, axis = divmod(int(top[i]), 3)
                    partner[i] = f"{'XYZ'[axis]} of point {batch.names[int(np.flatnonzero(known)[p])]}"
                effects.append(to_points[known] ** 2 / q)
        share = np.sqrt(np.concatenate(effects).mean(axis=0)).T if effects else np.zeros((len(places), 3))
        evidence = Evidence(
            tuple(self.names[i] for i in open_),
            values[places],
            own,
            np.ones(len(places)),
            tuple(partner),
            correlation,
            share,
            sigma0 if np.isfinite(sigma0) else 1.0,
            redundancy,
            gsd_m,
            self._rank[open_],
        )
        return evidence, q / self._sigma[open_] ** 2


def ranks(parameters: SelfCalibration, nadir: str) -> IntArray:
    """Which of a group to do without first (see `Evidence`); ``nadir`` is the CCD line that looks down."""
    power = {"k2": 1, "k3": 2, "p2": 1}
    names = parameters.unknown_names
    return np.array([power.get(n.split("_")[0], int(n.partition("_")[2] == nadir)) for n in names], dtype=np.int64)
