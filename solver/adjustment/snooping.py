"""Data snooping after Baarda: test, leave out the worst, adjust again, until nothing fails [K A.17].

Several observations go in one round only where they cannot have caused each other's failure: at most one of an object
point, and none that is much smaller than the largest of all. What was left out is tested against the adjustment without
it and returns if it agrees: an outlier that was masked, or that made good neighbours look bad, is undone that way.
Where a point has lost half of its rays, the largest set of its rays that agree takes the place of those that were kept.
Given coordinates of the point that contradict this set go in place of its rays: one that is grossly wrong bends the
block so much that the rays of its own point fail first.

The test takes model and a-priori sigmas for right. Where most image points fail they are not, and nothing is left out.
Control is what the block stands on: a coordinate goes only if it fails clearly while the image points fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ..arrays import Array, IntArray
from ..quantiles import chi2, norm
from .adjustment import AdjustmentOptions, Solution, State, solve
from .covariance import Cofactors, cofactors
from .normal_equations import weigh_control
from .point_consensus import consensus_of_points
from .ray_statistics import RayStatistics, ray_statistics
from .reliability import CRITICAL_W
from .variance_components import scaled

#: A failing observation goes in the same round as the largest only if it has at least this share of it.
TOGETHER = 0.5

#: Share of the image points left out beyond which it is the model or the sigmas that are wrong.
MOST_LEFT_OUT = 0.35

#: A control coordinate goes beyond so many times the critical value, and only if the sigma of the image points, from
#: the median of their w, is less than so many times the a-priori one.
CONTROL_CLEAR, CONTROL_FIT = 2.0, 1.5

#: The image motion is taken anew for the weights where the cost has fallen below this share of what it was when that
#: was done last: gross errors bend a block, and the weights with it.
WEIGHTS_ANEW = 0.9

#: Rounds after which the search ends in any case; blocks with a few per cent of outliers take ten.
MOST_ROUNDS = 100


@dataclass(frozen=True)
class Round:
    """One round, for progress lines."""

    number: int
    largest_w: float
    left_out: int
    returned: int


@dataclass(frozen=True)
class Rejected:
    """An observation left out: ray (place in the network's rays), or coordinate of a control point.

    Attributes
    ----------
    ray, point, axis : place of the ray, or of the control point with its coordinate 0..2; -1 where it is the other kind
    w : normalised residual against the final adjustment without it; when it was left out where nothing controls it now
    reason : "snooping", or "lone" for the last ray of a point whose others contradicted each other
    """

    ray: int
    point: int
    axis: int
    w: float
    reason: str


@dataclass(frozen=True)
class Snooping:
    """Outcome.

    Attributes
    ----------
    solution, cofactors, statistics : the adjustment without the rejected observations, its cofactors and residuals
    rejected : what was left out
    rounds : of tests
    given_up : share of the image points that would have gone where that is too many; then the search left out nothing
    """

    solution: Solution
    cofactors: Cofactors
    statistics: RayStatistics
    rejected: tuple[Rejected, ...]
    rounds: int
    given_up: float = 0.0


@cache
def joint_limit(critical: float, values: int = 2) -> float:
    """Limit of the joint test value of line and sample, or of other numbers of values, with the same error probability
    as one |w| (13.8 for 3.29)."""
    return float(chi2.isf(2.0 * norm.sf(critical), values))


def failing_w(largest_w: Array, joint: Array, critical: float) -> Array:
    """Larger |w| (n,) of the rays that fail the joint test (n,), 0 of the others.

    A ray contradicts the others if this exceeds the critical value: one of its w and the joint test have to fail, which
    keeps the share of good rays lost at that of a single test.
    """
    return np.where(joint > joint_limit(critical), largest_w, 0.0)


def largest_of_group(group: IntArray, value: Array) -> IntArray:
    """Places of the largest value in each group."""
    order = np.lexsort((-value, group))
    return order[np.diff(group[order], prepend=-1) != 0]


def control_tests(solution: Solution, cofactors: Cofactors) -> Array:
    """Normalised residuals (p, 3) of the control coordinates, adjusted minus given; 0 where nothing is given."""
    return solution.problem.control.normalised(solution.state.points_l, cofactors.points)


def snoop(
    solution: Solution,
    critical: float = CRITICAL_W,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008  (frozen)
    progress: Callable[[Round], None] | None = None,
    before: Snooping | None = None,
    image_factor: float = 1.0,
) -> Snooping:
    """Leave out image points and control coordinates whose normalised residual exceeds the critical value.

    An image point goes with both its coordinates, and so is judged by both (`failing_w`). Of several rays at one object
    point the one with the largest joint value goes.

    Parameters
    ----------
    solution : start; rays it gives no weight stay out and are not reported
    critical : of ``|w|``; 3.29 for alpha = 0.001
    options : for the adjustments in between
    progress : called after every round
    before : search in an earlier adjustment of the same network, from which `solution` has its weights: what it left
        out is reported again, and may return
    image_factor : what the sigmas of the image points were multiplied by, which weights that are taken anew need
    """
    if not critical > 0:
        raise ValueError(f"critical value {critical}, wanted more than 0")
    search = _Search(solution, critical, before, image_factor)
    beginning = search.result(0)
    for number in range(1, MOST_ROUNDS + 1):
        largest, out = search.leave_out()
        back = 0 if out else search.bring_back() or search.exchange()
        if progress:
            progress(Round(number, largest, out, back))
        if search.share > MOST_LEFT_OUT:
            return replace(beginning, rounds=number, given_up=search.share)
        if not (out or back):
            return search.result(number)
        search.solve(options)
    return search.result(MOST_ROUNDS)


def image_scale(statistics: RayStatistics, ray_weight: Array) -> float:
    """Sigma of the image points in units of the a-priori one, from the median of |w|, which outliers hardly move.

    Parameters
    ----------
    statistics, ray_weight : of n rays; rays of weight (n,) 0 do not count
    """
    w = np.abs(statistics.w[ray_weight > 0])
    w = w[w != 0.0]
    return float(np.median(w)) / 0.6745 if len(w) else 1.0


def _weight_of_all_control(solution: Solution) -> Array:
    """Weights (p, 3) of control with those that were left out, whose sigmas are as many times what was stated as those
    of the others."""
    given = weigh_control(solution.network.control, solution.network.n_points).weight
    weight = solution.problem.control.weight
    on = (weight > 0) & (given > 0)
    return given * (float(np.median(weight[on] / given[on])) if on.any() else 1.0)


class _Search:
    """The state of a search: weights of rays and control, and what was left out when."""

    def __init__(self, solution: Solution, critical: float, before: Snooping | None, image_factor: float):
        self.critical, self.image_factor = critical, image_factor
        self.point = solution.network.rays.point
        self.weight = solution.ray_weight.copy()
        self.control_weight = solution.problem.control.weight.copy()
        self.given_weight = _weight_of_all_control(solution)
        self.out: dict[int, float] = {}
        self.control_out: dict[tuple[int, int], float] = {}
        self.returned: set[int | tuple[int, int]] = set()
        self.exchanged: set[int] = set()
        for r in before.rejected if before else ():
            if r.reason == "snooping" and r.ray >= 0:
                self.out[r.ray] = r.w
            elif r.reason == "snooping":
                self.control_out[r.point, r.axis] = r.w
        self.out_before = len(self.out)
        self.weighed_at = solution.cost
        self.start: State | None = None
        self._take(solution)

    def _take(self, solution: Solution) -> None:
        self.solution = solution
        self.cofactors = cofactors(solution)
        self.statistics = ray_statistics(solution, self.cofactors)
        self.control_w = control_tests(solution, self.cofactors)

    def solve(self, options: AdjustmentOptions) -> None:
        control = self.solution.problem.control
        if (self.control_weight != control.weight).any():
            control = replace(control, weight=self.control_weight.copy())
            problem = replace(self.solution.problem, control=control)
            self.solution = replace(self.solution, problem=problem)
        found = self.solution
        if self.start is None:
            found = solve(found.problem, found, self.weight, options)
            if found.cost < WEIGHTS_ANEW * self.weighed_at:
                self.start = found.state
        if self.start is not None:
            found = solve(found.problem, self.start, self.weight, options)
            if self.image_factor != 1.0:
                found = scaled(found, {"image": self.image_factor}, options)
            self.weighed_at, self.start = found.cost, None
        self._take(found)

    def leave_out(self) -> tuple[float, int]:
        """Largest |w| of what takes part, and how many observations go."""
        in_use = self.weight > 0
        joint = self.statistics.joint
        w = np.where(in_use, failing_w(self.statistics.largest_w, joint, self.critical), 0.0)
        control_w = np.abs(self.control_w)
        if image_scale(self.statistics, self.weight) > CONTROL_FIT:
            control_w = np.zeros_like(control_w)
        of_control = float(control_w.max(initial=0.0))
        limit = max(self.critical, TOGETHER * max(float(w.max(initial=0.0)), of_control))
        largest = max(float(self.statistics.largest_w[in_use].max(initial=0.0)), of_control)
        failing = np.flatnonzero(w > limit)
        worst_control = control_w.max(axis=1)
        first = failing[largest_of_group(self.point[failing], joint[failing])]
        # a control coordinate goes instead of a ray of its point if it fails more clearly
        clearly = max(limit, CONTROL_CLEAR * self.critical)
        p, axis = np.nonzero((control_w > clearly) & (control_w == worst_control[:, None]))
        ray_w = np.zeros(len(control_w))
        ray_w[self.point[first]] = np.sqrt(joint[first])
        clear = worst_control[p] >= ray_w[p]
        p, axis = p[clear], axis[clear]
        first = first[~np.isin(self.point[first], p)]
        for i in first:
            self.out[int(i)] = float(w[i])
        self.weight[first] = 0.0
        for i, a in zip(p, axis, strict=True):
            self.control_out[int(i), int(a)] = float(self.control_w[i, a])
        self.control_weight[p, axis] = 0.0
        return largest, len(first) + len(p)

    def bring_back(self) -> int:
        """Of what was left out, what agrees with the rest returns, each only once and one ray of a point at a time."""
        return self._bring_back_rays() or self._bring_back_control()

    def _bring_back_control(self) -> int:
        back = []
        for key in self.control_out:
            w = self._w_of_control_out(key)
            if w is not None and abs(w) <= self.critical and key not in self.returned:
                back.append(key)
        for key in back:
            del self.control_out[key]
            self.returned.add(key)
            self.control_weight[key] = self.given_weight[key]
        return len(back)

    def _w_of_control_out(self, key: tuple[int, int]) -> float | None:
        """Normalised difference, adjusted minus given, of a coordinate that was left out; None where its point is not
        determined without it."""
        i, a = key
        if self.solution.points.rank[i] < 3:
            return None
        miss = self.solution.state.points_l[key] - self.solution.problem.control.xyz_l[key]
        return float(miss / np.sqrt(1.0 / self.given_weight[key] + self.cofactors.points[i, a, a]))

    def _bring_back_rays(self) -> int:
        candidates = np.array([i for i in self.out if i not in self.returned], dtype=np.int64)
        if not len(candidates):
            return 0
        known = self.solution.points.rank[self.point[candidates]] == 3
        w, joint = self.statistics.largest_w[candidates], self.statistics.joint[candidates]
        good = known & (failing_w(w, joint, self.critical) <= self.critical)
        candidates = candidates[good]
        first = candidates[largest_of_group(self.point[candidates], -joint[good])]
        for i in first:
            del self.out[int(i)]
            self.returned.add(int(i))
        self.weight[first] = 1.0
        return len(first)

    def exchange(self) -> int:
        """Where half of a point's rays are out and more of them agree than were kept, these take their place.

        Coordinates that are given of the point go then; those that agree with its rays return.
        """
        n = self.solution.network.n_points
        lost = np.bincount(self.point[list(self.out)], minlength=n) if self.out else np.zeros(n, dtype=np.int64)
        mostly = (lost > 0) & (2 * lost >= np.bincount(self.point, minlength=n))
        points = np.array([p for p in np.flatnonzero(mostly) if int(p) not in self.exchanged], dtype=np.int64)
        self.exchanged.update(points.tolist())
        back = 0
        for p, (chosen, rival, place) in consensus_of_points(self.solution, points, joint_limit(self.critical)).items():
            own = np.flatnonzero(self.point == p)
            kept = own[self.weight[own] > 0]
            if rival or len(chosen) < 3 or len(chosen) <= len(kept):
                continue
            for i in own:
                inside = bool(np.isin(i, chosen))
                back += inside and int(i) in self.out
                if inside:
                    self.out.pop(int(i), None)
                else:
                    self.out.setdefault(int(i), 0.0)
                self.weight[i] = float(inside)
            given = np.flatnonzero(self.control_weight[p] > 0)
            for axis in given:
                self.control_out[p, int(axis)] = float(self.control_w[p, axis])
                self.control_weight[p, axis] = 0.0
            if len(given):  # it begins where its rays meet
                start = self.start or self.solution.state
                points = start.points_l.copy()
                points[p] = place
                self.start = State(start.theta, points)
        return back

    @property
    def share(self) -> float:
        """Of the image points that this search has left out."""
        return (len(self.out) - self.out_before) / max(len(self.point), 1)

    def result(self, rounds: int) -> Snooping:
        rank = self.solution.points.rank
        rejected = []
        for i, w in self.out.items():
            now = float(self.statistics.largest_w[i]) if rank[self.point[i]] == 3 else w
            rejected.append(Rejected(i, -1, -1, now, "snooping"))
        p = self.point
        lone = np.flatnonzero((self.weight > 0) & (rank[p] < 3) & np.isin(p, [p[i] for i in self.out]))
        rejected += [Rejected(int(i), -1, -1, 0.0, "lone") for i in lone]
        for (i, a), w in self.control_out.items():
            now = self._w_of_control_out((i, a))
            rejected.append(Rejected(-1, i, a, w if now is None else now, "snooping"))
        rejected.sort(key=lambda r: -abs(r.w))
        return Snooping(self.solution, self.cofactors, self.statistics, tuple(rejected), rounds)
