"""Which tie points drift: hypotheses, their tests, and which of them cannot be told apart.

A drift is looked for in the looks of one source on one CCD line, in all looks of a source, in those of all sources on
one CCD line, and in all looks. Each hypothesis has the same four unknowns, a bias and a drift of lines and samples, and
is tested over the same data: its test value is what the squares of the adjustment would lose if they were estimated,
twice the logarithm of its likelihood ratio. So the hypothesis with the largest value is the most likely one; but by how
much the value has to be larger is a matter of geometry. The orientation absorbs a drift that the three CCD lines have
in common, and one that is proportional to their viewing angles. Residuals show only one direction in three, and it is
the same for a drift of the forward, the nadir and the backward line, but for its size. Test values of hypotheses that
are so alike (correlation of their effects on the residuals near one) hardly differ. Where the difference is no more
than noise, or a small share of the whole (a model error in proportion to the drift), all of them are named.

Source: W. Foerstner, Reliability and discernability of extended Gauss-Markov models, DGK A 98, 1983.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Array
from ..quantiles import chi2

#: Source of image measurements (its publisher, may be empty) and CCD line.
Group = tuple[str, str]

#: Stands for all sources, and for all CCD lines.
ALL = "*"
#: Unknowns of a hypothesis: line and sample, constant and drifting.
EACH = 4
#: Probability that a good group fails in one test. Tests follow each other with most of their data in common, so
#: there is at most one false alarm in some ten hours.
FALSE_ALARM = 1e-5
#: Tests in a row that have to fail for an alarm: a gross error fails a few of them until it is rejected. Tuned.
CONFIRMED = 3
#: An alarm is over when the test value is below this share of its limit, so that it does not flicker. Tuned.
OVER = 0.5
#: A hypothesis is excluded if its test value is lower than the largest one by `DECISIVE` (a likelihood ratio of 3000),
#: or by this share of the largest, whichever is more; by `AGAIN` times that once it has been named. Tuned.
DECISIVE, SHARE, AGAIN = 16.0, 0.1, 1.5
#: A bias below this, px, does too little harm to raise an alarm. Tuned.
MATTERS_PX = 0.08
#: A-priori sigma of a bias, and of what a drift has grown to by now, px: where nothing says how large it is, it is
#: estimated small. Tuned.
USUAL_PX = 1.0
#: Time since the beginning, in its unit, from which on a drift is told from a bias.
LEAST_AGE = 0.1
#: Rays of a group needed for a test; groups that drift at the same time, at most.
LEAST_RAYS, MOST = 12, 2


@dataclass(frozen=True)
class BiasedSource:
    """A group whose measurements are biased.

    Attributes
    ----------
    source, ccd : publisher (may be empty) and CCD line; `ALL` where all of them are meant
    line_px, sample_px : bias now
    line_px_s, sample_px_s : its drift
    test, limit : chi-square, and what it should stay below
    since_s : time of the first alarm
    rivals : others whose bias would explain the same about as well: on one of them it is
    """

    source: str
    ccd: str
    line_px: float
    sample_px: float
    line_px_s: float
    sample_px_s: float
    test: float
    limit: float
    since_s: float
    rivals: tuple[Group, ...] = ()

    @property
    def suspects(self) -> tuple[Group, ...]:
        """The group and its rivals."""
        return ((self.source, self.ccd), *self.rivals)

    def __str__(self) -> str:
        bias = f"line {self.line_px:+.2f} px, sample {self.sample_px:+.2f} px"
        rivals = [_on(ccd) if source == self.source else _on(ccd) + _of(source) for source, ccd in self.rivals]
        told = f" (or {', or '.join(rivals)}: cannot be told apart)" if rivals else ""
        return f"tie points{_of(self.source)} on {_on(self.ccd)} drift: {bias}{told}; the orientation is without it"


def _of(source: str) -> str:
    return " of all sources" if source == ALL else f" of source {source}" if source else ""


def _on(ccd: str) -> str:
    return "all CCDs" if ccd == ALL else f"CCD {ccd}"


@dataclass(frozen=True)
class Hypothesis:
    """A drift common to some groups.

    Attributes
    ----------
    name : source and CCD line
    members : places of the groups
    """

    name: Group
    members: tuple[int, ...]

    def choice(self, unknowns: int, age: float) -> Array:
        """Its four unknowns (n, 4) among those of all groups: of one size, a drift being what it has grown to by now.

        ``age``: see `Scores`.
        """
        C = np.zeros((unknowns, EACH))
        for i in self.members:
            C[EACH * i + np.arange(EACH), np.arange(EACH)] = 1.0 / np.repeat([1.0, max(age, LEAST_AGE)], EACH // 2)
        return C


def covers(name: Group, group: Group) -> bool:
    """Whether a group is one of those that a name stands for."""
    return all(n in (ALL, g) for n, g in zip(name, group, strict=True))


def hypotheses(groups: Sequence[Group], rays: Sequence[int]) -> list[Hypothesis]:
    """What may drift, of groups with so many rays each."""
    use = [i for i, count in enumerate(rays) if count >= LEAST_RAYS]
    singles = [groups[i] for i in use]
    sources = dict.fromkeys(source for source, _ in singles)
    wholes = [(source, ALL) for source in sources]
    if len(sources) > 1:
        wholes += [*dict.fromkeys((ALL, ccd) for _, ccd in singles), (ALL, ALL)]
    found = [Hypothesis(name, tuple(i for i in use if covers(name, groups[i]))) for name in singles + wholes]
    return [h for h in found if h.name in singles or len(h.members) > 1]


@dataclass(frozen=True)
class Scores:
    """Scores (n,) of the unknowns of all groups, four each, and their cofactors V (n, n), given all else.

    Attributes
    ----------
    age : time since the strip began, in units of the drift's
    unit_s : these
    """

    score: Array
    V: Array
    age: float
    unit_s: float

    def of(self, h: Hypothesis) -> tuple[Array, Array, Array]:
        """Choice C (n, 4) of unknowns, their scores and cofactors."""
        C = h.choice(len(self.score), self.age)
        return C, C.T @ self.score, C.T @ self.V @ C

    def test(self, h: Hypothesis) -> float:
        """Test value: chi-square with four degrees of freedom if there is no bias at all."""
        _, s, V = self.of(h)
        return float(s @ np.linalg.pinv(V, rcond=1e-9, hermitian=True) @ s)

    def bias(self, h: Hypothesis) -> Array:
        """Line and sample, px, now; the same a second, px/s."""
        _, s, V = self.of(h)
        b = np.linalg.solve(V + np.eye(EACH) / USUAL_PX**2, s)
        grown = max(self.age, LEAST_AGE)
        return np.concatenate([b[:2] + b[2:] * self.age / grown, b[2:] / (grown * self.unit_s)])

    def without(self, h: Hypothesis) -> Scores:
        """The scores of the others with this one estimated."""
        C, _, V = self.of(h)
        gain = self.V @ C @ np.linalg.pinv(V, rcond=1e-9, hermitian=True) @ C.T
        return Scores(self.score - gain @ self.score, self.V - gain @ self.V, self.age, self.unit_s)


@dataclass
class _Alarm:
    """Whether one drift is reported, and which hypotheses may be it, from test to test."""

    failed: int = 0
    since_s: float = np.inf
    leader: Group | None = None
    named: frozenset[Group] = frozenset()

    def update(
        self, now_s: float, tests: dict[Group, float], limit: float, instead: float, decisive: float, matters: bool
    ) -> bool:
        """Take in new tests; whether there is an alarm."""
        best = max(tests, key=tests.__getitem__)
        if self.leader not in tests:
            self.leader, self.named = None, frozenset()
        if self.leader is None:
            self.failed = self.failed + 1 if tests[best] > limit + instead and matters else 0
            if self.failed < CONFIRMED:
                return False
            self.leader, self.since_s = best, now_s
        elif tests[best] < OVER * limit:
            self.forget()
            return False
        margin = max(decisive, SHARE * tests[best])
        self.named = frozenset(
            name for name, t in tests.items() if t >= tests[best] - margin * (AGAIN if name in self.named else 1.0)
        )
        if self.leader not in self.named:
            self.leader = best
        return True

    def forget(self) -> None:
        """There is no alarm any more."""
        self.failed, self.leader, self.named = 0, None, frozenset()


@dataclass
class Suspicion:
    """Names what drifts; what has been named stays named until it is cleared, or until another is decisively better.

    Attributes
    ----------
    alpha : probability that a good group fails in one test
    strongest : largest test value of the last tests
    """

    alpha: float = FALSE_ALARM
    strongest: float = np.inf
    _alarms: list[_Alarm] = field(default_factory=lambda: [_Alarm() for _ in range(MOST)])

    def limit(self, factor: float = 1.0) -> float:
        """Of test values; ``factor`` as in `judge`."""
        return float(chi2.isf(self.alpha, EACH)) * factor

    def judge(
        self,
        now_s: float,
        scores: Scores,
        of: Sequence[Hypothesis],
        factor: float = 1.0,
        instead: float = 0.0,
    ) -> tuple[BiasedSource, ...]:
        """Test all hypotheses.

        Parameters
        ----------
        factor : by which the cofactors of scores are larger than stated
        instead : twice the logarithm of the likelihood ratio of what may be wrong instead: a drift is named anew where
            it is the better explanation by as much as a drift has to be better than none
        """
        limit = self.limit(factor)
        given, open_, result, least = [scores], list(of), [], limit
        for i, alarm in enumerate(self._alarms):
            if not open_:
                break
            # whichever of those named before it is
            tests = {h.name: min(g.test(h) for g in given) for h in open_}
            by_name = {h.name: h for h in open_}
            best = by_name[max(tests, key=tests.__getitem__)]
            if i == 0:
                self.strongest = tests[best.name]
            matters = float(np.abs(given[0].bias(best)[:2]).max()) >= MATTERS_PX
            if not alarm.update(now_s, tests, max(limit, least), instead, DECISIVE * factor, matters):
                for later in self._alarms[i + 1 :]:
                    later.forget()
                break
            leader = by_name[alarm.leader] if alarm.leader is not None else best
            line, sample, line_s, sample_s = given[0].bias(leader).tolist()
            result.append(
                BiasedSource(
                    *leader.name, line, sample, line_s, sample_s, tests[leader.name], limit, alarm.since_s,
                    tuple(sorted(alarm.named - {leader.name})),
                )
            )  # fmt: skip
            least = SHARE * tests[best.name]
            given = [g.without(by_name[name]) for g in given for name in sorted(alarm.named)]
            open_ = [h for h in open_ if h.name not in alarm.named]
        return tuple(result)
