"""Which additional parameters a network can determine: the stepwise test of the dissertation [K 4.2.2.4].

One step looks at one solution and names at most one parameter to remove; the caller solves again without it and asks
again. The four criteria stand in this order, and within each the worst parameter goes first:

(i) pivot of the scaled Cholesky factor: what is left of a parameter's information when all other unknowns are free;
(ii) correlation with an orientation parameter, an object coordinate or another additional parameter;
(iii) trace check: what the parameter adds to the mean variance of the object coordinates, against a share of the GSD;
(iv) significance: Student's t of the parameter, Fisher's F of its group.

A parameter that fails (ii) or (iii) though it is clearly significant is kept, and said so: the observations contradict
its absence, and removing it would move its effect into the orientation and the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from ..arrays import Array, Bools, IntArray
from ..camera.line_camera import LineCamera
from .statistics import correlations, fisher_limit, fisher_value, student_limit


class Criterion(StrEnum):
    """What a parameter failed."""

    PIVOT = "pivot"
    CORRELATION = "correlation"
    TRACE = "trace check"
    STUDENT = "Student t"
    FISHER = "Fisher F"


@dataclass(frozen=True)
class Limits:
    """Critical values.

    Attributes
    ----------
    pivot : smallest share of a parameter's information that may be left
    correlation : largest |r|; beyond `hopeless` a parameter goes even if it is significant
    trace_gsd : largest addition to the mean standard deviation of object coordinates, as a share of the GSD
    alpha : level of Student's t and Fisher's F
    keep_significant : whether a significant parameter survives (ii) and (iii)
    """

    pivot: float = 1e-9
    correlation: float = 0.9
    hopeless: float = 0.9999
    trace_gsd: float = 0.25
    alpha: float = 0.05
    keep_significant: bool = True


@dataclass(frozen=True)
class Evidence:
    """What one solution says about its m additional parameters; cofactors are for sigma0 = 1.

    Attributes
    ----------
    names : (m,)
    values : (m,)
    cofactors : (m, m)
    pivot : (m,) ``1 / (n_ii q_ii)``
    partner, correlation : (m,) the unknown outside the set with the largest |r|, and r
    point_sigma_m : (m, 3) root of the mean of ``r_ij^2 q_jj`` over the object points [K 4.51], per X, Y, Z
    sigma0, redundancy : of the solution
    gsd_m : ground sample distance
    rank : (m,) of two parameters of a group that go with each other, which is the one to do without: the higher rank
        (the line that serves as reference, the higher power)
    """

    names: tuple[str, ...]
    values: Array
    cofactors: Array
    pivot: Array
    partner: tuple[str, ...]
    correlation: Array
    point_sigma_m: Array
    sigma0: float
    redundancy: int
    gsd_m: float
    rank: IntArray

    @property
    def sigma(self) -> Array:
        """(m,) standard deviations, with the a-posteriori sigma0."""
        return self.sigma0 * np.sqrt(np.diag(self.cofactors))

    @property
    def t(self) -> Array:
        """(m,) Student's t."""
        s = self.sigma
        return np.divide(self.values, s, out=np.zeros_like(s), where=s > 0)


def strongest_correlations(cross: Array, variance: Array, q: Array) -> tuple[IntArray, Array]:
    """With which of k other unknowns each of m parameters is most correlated: its place (m,), and r (m,).

    Parameters
    ----------
    cross, variance, q : (k, m) cofactors between both, (k,) of the other unknowns, (m,) of the parameters
    """
    scale = np.sqrt(np.maximum(variance, 0.0))[:, None] * np.sqrt(q)
    r = np.divide(cross, scale, out=np.zeros_like(cross), where=scale > 0)
    strongest = np.argmax(np.abs(r), axis=0)
    return strongest, r[strongest, np.arange(len(q))]


def point_sigmas(cross: Array, q: Array) -> Array:
    """What parameters with cofactors q (m,) add to the sigma of X, Y and Z, (m, 3); see `Evidence.point_sigma_m`.

    ``cross`` (p, 3, m) are the cofactors between object points and parameters.
    """
    effect = np.divide(cross**2, q, out=np.zeros_like(cross), where=q > 0)
    return np.sqrt(effect.mean(axis=0)).T


def ranks(names: Sequence[str], camera: LineCamera) -> IntArray:
    """See `Evidence.rank`: the parameter of the nadir line of a lens, to which those of its other lines then refer, and
    of powers the highest."""
    nadir = camera.nadir_line.id if len(camera.lenses) == 1 else None
    power = {"k2": 1, "k3": 2, "p2": 1}
    return np.array([power.get(n.split("_")[0], int(n.partition("_")[2] == nadir)) for n in names], np.int64)


@dataclass(frozen=True)
class Removal:
    """A parameter that is not determinable: by which criterion, with which figure against which limit.

    Attributes
    ----------
    value, sigma : estimate at the moment of removal
    reason : one line
    """

    name: str
    criterion: Criterion
    figure: float
    limit: float
    value: float
    sigma: float
    reason: str


@dataclass(frozen=True)
class Verdict:
    """Outcome of one step: the parameter to remove, if any, and why others stay in spite of a failed criterion."""

    removal: Removal | None
    kept: dict[str, str] = field(default_factory=dict)


def examine(evidence: Evidence, limits: Limits = Limits()) -> Verdict:
    """One step of the stepwise test."""
    e = evidence
    if not e.names:
        return Verdict(None)
    t_limit = student_limit(e.redundancy, limits.alpha)
    significant = np.abs(e.t) > t_limit
    r, partner = _strongest(e, significant)

    worst = int(np.argmin(e.pivot))
    if e.pivot[worst] < limits.pivot:
        text = f"{e.pivot[worst]:.1e} below {limits.pivot:.0e}, not to be told from {e.partner[worst]}"
        return Verdict(_removal(e, worst, Criterion.PIVOT, e.pivot[worst], limits.pivot, text))

    kept: dict[str, str] = {}
    for i in np.argsort(-np.abs(r), kind="stable"):
        if abs(r[i]) <= limits.correlation:
            break
        text = f"{r[i]:+.3f} with {partner[i]}"
        if limits.keep_significant and significant[i] and abs(r[i]) < limits.hopeless:
            kept[e.names[i]] = f"correlation {text}, kept: significant with t = {e.t[i]:.1f}"
            continue
        text += f", beyond {limits.correlation:g}"
        return Verdict(_removal(e, int(i), Criterion.CORRELATION, float(r[i]), limits.correlation, text), kept)

    share = e.sigma0 * e.point_sigma_m.max(axis=1) / e.gsd_m
    for i in np.argsort(-share, kind="stable"):
        if share[i] <= limits.trace_gsd:
            break
        text = f"adds {share[i]:.2f} GSD to the mean sigma of {'XYZ'[int(np.argmax(e.point_sigma_m[i]))]}"
        if limits.keep_significant and significant[i]:
            kept.setdefault(e.names[i], f"{text}, kept: significant with t = {e.t[i]:.1f}")
            continue
        text += f", beyond {limits.trace_gsd:g}"
        return Verdict(_removal(e, int(i), Criterion.TRACE, float(share[i]), limits.trace_gsd, text), kept)

    if significant.all():
        return Verdict(None, kept)
    worst = int(np.argmin(np.abs(e.t)))
    return Verdict(_insignificant(e, worst, t_limit, limits.alpha), kept)


def group_of(name: str) -> str:
    """Group of an additional parameter for Fisher's test: xp, yp, sy, th, k, p and the like."""
    kind = name.split("_")[0]
    return kind[0] if kind in ("k1", "k2", "k3", "p1", "p2") else kind


def _insignificant(e: Evidence, i: int, t_limit: float, alpha: float) -> Removal:
    """Student's t of the parameter with Fisher's F of its group beside it; F is the reason where the group fails it."""
    t = abs(float(e.t[i]))
    text = f"t = {t:.2f} below {t_limit:.2f}"
    group = [k for k, name in enumerate(e.names) if group_of(name) == group_of(e.names[i])]
    if len(group) > 1:
        F = fisher_value(e.values[group], e.cofactors[np.ix_(group, group)], e.sigma0)
        limit = fisher_limit(len(group), e.redundancy, alpha)
        members = ", ".join(e.names[k] for k in group)
        if limit > F:
            text = f"F = {F:.2f} of the group ({members}) below {limit:.2f}; its t = {t:.2f} is the smallest"
            return _removal(e, i, Criterion.FISHER, F, limit, text)
        text += f" (group {members}: F = {F:.1f}, significant)"
    return _removal(e, i, Criterion.STUDENT, t, t_limit, text)


def _strongest(e: Evidence, significant: Bools) -> tuple[Array, list[str]]:
    """Largest correlation of each parameter with anything.

    Of two additional parameters that go with each other only one is held to it, as the other can stay without it: the
    one that is not significant, or the one of higher rank in their group, or the one with the smaller t.
    """
    r, partner = e.correlation.copy(), list(e.partner)
    inner = correlations(e.cofactors)
    np.fill_diagonal(inner, 0.0)
    group = np.array([group_of(name) for name in e.names])
    rank = np.where(group[:, None] == group, e.rank[:, None] - e.rank, 0)
    t = np.abs(e.t)
    unlike = significant[:, None] != significant
    weaker = np.where(unlike, ~significant[:, None], np.where(rank != 0, rank > 0, t[:, None] < t))
    inner = np.where(weaker, inner, 0.0)
    other = np.argmax(np.abs(inner), axis=1)
    for i, k in enumerate(other):
        if abs(inner[i, k]) > abs(r[i]):
            r[i], partner[i] = inner[i, k], e.names[k]
    return r, partner


def _removal(e: Evidence, i: int, criterion: Criterion, figure: float, limit: float, reason: str) -> Removal:
    value, sigma = float(e.values[i]), float(e.sigma[i])
    return Removal(e.names[i], criterion, float(figure), float(limit), value, sigma, f"{criterion}: {reason}")
