"""The unknowns of the window and what is known of them: information that is added, taken back and marginalised."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import get_lapack_funcs, solve_triangular

from ...adjustment.reduced_system import DenseFactor
from ...arrays import Array, Bools, IntArray
from ..results import DivergedError

#: Weight of what is held, which makes its cofactors nothing.
HELD_WEIGHT = 1e30
(_potrf,) = get_lapack_funcs(("potrf",), dtype=float)  # pyrefly: ignore[not-iterable]


@dataclass(frozen=True)
class Information:
    """What some observations know of the unknowns ``theta`` of their columns.

    Their cost is ``square - 2 rhs theta + theta matrix theta``.

    Attributes
    ----------
    matrix, rhs : (u, u), (u,) reduced normal equations
    square : sum of squares at theta = 0
    rows : observations less object coordinates
    """

    matrix: Array
    rhs: Array
    square: float
    rows: int

    def __sub__(self, other: Information) -> Information:
        """What this says beyond another one about the same unknowns."""
        return Information(
            self.matrix - other.matrix, self.rhs - other.rhs, self.square - other.square, self.rows - other.rows
        )


@dataclass(frozen=True)
class Marginal:
    """What was known of unknowns when they left: ``R11 x1 + R12 x2 = d1 + noise(1)`` with those that stayed, x2.

    Attributes
    ----------
    gone, stayed : numbers of the unknowns
    R11, R12, d1 : upper triangular (m, m), (m, k), (m,)
    """

    gone: IntArray
    stayed: IntArray
    R11: Array
    R12: Array
    d1: Array


@dataclass
class Border:
    """Quantities beside the unknowns that are held at zero, as columns of the normal equations.

    With c quantities ``b`` beside the unknowns ``x`` the normal equations are

        [N  G] [x]   [n]
        [G' H] [b] = [r]

    and keep that form when unknowns leave. So a drift of tie points, a bias of control or a gross error can be tested,
    estimated or named exactly, long after the observations it stands in have left the window.

    Attributes
    ----------
    numbers : (n,) unknowns
    G, H, r : (n, c), (c, c), (c,)
    """

    numbers: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    G: Array = field(default_factory=lambda: np.zeros((0, 0)))
    H: Array = field(default_factory=lambda: np.zeros((0, 0)))
    r: Array = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.r)

    @classmethod
    def of(cls, columns: int, numbers: ArrayLike = ()) -> Border:
        """So many quantities, of which nothing is known yet, beside unknowns (n,)."""
        numbers = np.array(numbers, dtype=np.int64)
        return cls(numbers, np.zeros((len(numbers), columns)), np.zeros((columns, columns)), np.zeros(columns))

    def add(
        self, places: IntArray, numbers: IntArray, G: Array, H: Array | float = 0.0, r: Array | float = 0.0
    ) -> None:
        """Add weighted equations of k quantities, beside u unknowns.

        Parameters
        ----------
        places : (k,) of the quantities among those of the border; beyond the last one they are new
        numbers : (u,) of the unknowns
        G, H, r : (u, k), (k, k), (k,): ``A'PB``, ``B'PB`` and ``B'Pl``
        """
        more = max(int(places.max(initial=-1)) + 1 - len(self), 0)
        at = places_of(self.numbers, numbers)
        new = np.flatnonzero(at < 0)
        at[new] = len(self.numbers) + np.arange(len(new))
        if more or len(new):
            self.numbers = np.concatenate([self.numbers, numbers[new]])
            self.G = _padded(self.G, len(new), more)
            if more:
                self.H, self.r = _padded(self.H, more, more), np.concatenate([self.r, np.zeros(more)])
        self.G[at[:, None], places] += G
        self.H[places[:, None], places] += H
        self.r[places] += r

    def join(self, places: IntArray, other: Border) -> None:
        """Add equations of quantities that stand in another border, here at places (k,)."""
        self.add(places, other.numbers, other.G, other.H, other.r)

    def join_all(self, parts: Iterable[tuple[IntArray, Border]]) -> None:
        """The same for many borders; those of the same quantities and unknowns are added to each other first."""
        sums: dict[tuple[bytes, bytes], tuple[IntArray, Border]] = {}
        for places, other in parts:
            _, total = sums.setdefault(
                (places.tobytes(), other.numbers.tobytes()), (places, Border.of(len(places), other.numbers))
            )
            total.G += other.G
            total.H += other.H
            total.r += other.r
        for places, total in sums.values():
            self.join(places, total)

    def scores(self, N: Array, rhs: Array) -> tuple[Array, Array]:
        """Scores (c,) of the quantities at the solution of normal equations (n, n), (n,) of the same unknowns; their
        cofactors (c, c)."""
        solved = DenseFactor(N).solve(np.column_stack([rhs, self.G]))
        V = self.H - self.G.T @ solved[:, 1:]
        return self.r - self.G.T @ solved[:, 0], 0.5 * (V + V.T)

    def rows(self, numbers: IntArray) -> Array:
        """Rows (m, c) of G, zero for unknowns it does not have."""
        at = places_of(self.numbers, numbers)
        found = np.zeros((len(numbers), self.G.shape[1]))
        found[at >= 0] = self.G[at[at >= 0]]
        return found

    def marginalise(self, m: Marginal) -> Array:
        """Unknowns have left; returns what is left of their rows, ``R11^-T G1`` (m, c)."""
        if (places_of(self.numbers, m.gone) < 0).all():
            return np.zeros((len(m.gone), len(self)))
        q = solve_triangular(m.R11, self.rows(m.gone), trans=1, check_finite=False)
        self.G = self.rows(m.stayed) - m.R12.T @ q
        self.H, self.r, self.numbers = self.H - q.T @ q, self.r - q.T @ m.d1, m.stayed.copy()
        return q

    def freed(self, which: IntArray | Bools, weight: Array | float = 0.0) -> Information:
        """Information that the unknowns lose when k of the quantities are estimated instead of held at zero.

        Parameters
        ----------
        which : places (k,) of the quantities, or a mask
        weight : (k,) what is known of them beforehand, which counts as one observation each; 0 for nothing
        """
        G, r = self.G[:, which], self.r[which]
        K = np.linalg.inv(self.H[np.ix_(which, which)] + np.eye(len(r)) * weight)
        return Information(G @ K @ G.T, G @ (K @ r), float(r @ K @ r), 0 if np.any(weight) else len(r))

    def keep(self, which: IntArray | Bools) -> None:
        """Forget all other quantities: they stay at zero."""
        self.G, self.H, self.r = self.G[:, which], self.H[which][:, which], self.r[which]


class WindowState:
    """Unknowns, each with a number for life, and their normal equations in two parts.

    The *live* part is the sum of the batches that can still be linearised again or lose a ray. The *fixed* part holds
    a-priori knowledge and what was marginalised; it never changes its linearisation. When unknowns leave, the fixed
    part is brought to square-root form (Cholesky, those that leave first): the lower right block of the factor is what
    stays. It is positive definite by construction.

    Attributes
    ----------
    numbers : (n,) unknowns present, in the order of the matrices: as they came, the lasting ones after all others
    theta : (n,) values
    square : cost of everything so far at theta = 0 of the present unknowns
    redundancy : observations so far less unknowns so far
    solution : number of solutions computed so far
    changes : number of times so far that something else was known of them, or of others
    """

    def __init__(self) -> None:
        self.numbers: IntArray = np.empty(0, dtype=np.int64)
        self.theta: Array = np.empty(0)
        self._next = 0
        self._place = np.full(256, -1, dtype=np.int64)
        self._fixed: Array = np.zeros((0, 0))
        self._live: Array = np.zeros((0, 0))
        self._fixed_rhs, self._live_rhs = np.empty(0), np.empty(0)
        self.square = 0.0
        self.redundancy = 0
        self._lasting = np.zeros(256, dtype=bool)
        self._factor: DenseFactor | None = None
        self._cofactors: Array | None = None
        self._expected: list[IntArray] = []
        self._solved = True
        self.solution = self.changes = 0

    def __len__(self) -> int:
        return len(self.numbers)

    def new_numbers(self, n: int) -> IntArray:
        """Numbers for n unknowns that may become present later."""
        numbers = np.arange(self._next, self._next + n)
        self._next += n
        if self._next > len(self._place):
            self._place = np.concatenate([self._place, np.full(self._next, -1, dtype=np.int64)])
            self._lasting = np.concatenate([self._lasting, np.zeros(self._next, dtype=bool)])
        return numbers

    def last(self, numbers: IntArray) -> None:
        """Looks of all times touch these unknowns, not those of a time only, as long as they are present."""
        self._lasting[numbers] = True

    def _present(self, numbers: IntArray) -> IntArray:
        """Places of unknowns that must be present.

        Raises
        ------
        ValueError : one that is not, because it has left or has not been entered yet
        """
        place = self._place[numbers]
        if len(place) and place.min() < 0:
            raise ValueError(f"unknown {int(numbers[int(np.argmin(place))])} is not in the window")
        return place

    def places(self, numbers: ArrayLike) -> IntArray:
        """Places in the matrices; -1 for unknowns that are not present."""
        return self._place[np.asarray(numbers, dtype=np.int64)]

    def values(self, numbers: ArrayLike) -> Array:
        """Values of unknowns; 0 for those that are not present."""
        place = self.places(numbers)
        absent = place < 0
        if not absent.any():
            return self.theta.take(place)
        return np.where(absent, 0.0, np.append(self.theta, 0.0)[place])

    def enter(self, numbers: IntArray) -> None:
        """Make unknowns present, before the lasting ones; until observed they have no information."""
        m = len(numbers)
        both = np.concatenate([self.numbers, numbers])
        order = np.argsort(self._lasting[both], kind="stable")
        self.numbers = both[order]
        self._place[self.numbers] = np.arange(len(order))
        self.theta = np.pad(self.theta, (0, m))[order]
        self._fixed, self._live = (block_of(np.pad(a, ((0, m), (0, m))), order) for a in (self._fixed, self._live))
        self._fixed_rhs, self._live_rhs = (np.pad(a, (0, m))[order] for a in (self._fixed_rhs, self._live_rhs))
        self.redundancy -= m
        self._changed()

    def observe(self, columns: NDArray[np.int32], coefficients: Array, value: Array, sigma: Array) -> None:
        """Add m independent observations ``sum_t coefficients[i, t] theta[columns[i, t]] = value[i]``.

        They go to the fixed part, which is never linearised again: nothing takes them back.

        Parameters
        ----------
        columns : (m, t) numbers of present unknowns, -1 for none
        coefficients : (m, t)
        value, sigma : (m,) in one unit; infinite sigma: no weight

        Raises
        ------
        ValueError : an unknown that is not present
        """
        self._observe(*self._rows(columns, coefficients, value, sigma))

    def reweigh(self, columns: NDArray[np.int32], coefficients: Array, value: Array, before: Array, now: Array) -> None:
        """Give a-priori observations (m, t) of present unknowns other sigmas (m,) than those they were added with."""
        places, rows, rhs = self._rows(columns, coefficients, value, np.ones(len(value)))
        change = now**-2.0 - before**-2.0
        weighted = rows * change[:, None]
        self._fixed[np.ix_(places, places)] += rows.T @ weighted
        self._fixed_rhs[places] += weighted.T @ rhs
        self.square += float(rhs @ (change * rhs))
        self._changed()

    def extend(
        self, numbers: IntArray, columns: NDArray[np.int32], coefficients: Array, value: Array, sigma: Array
    ) -> None:
        """Make unknowns present about which these a-priori observations say all that is known.

        Where there are as many as unknowns, these follow from what is known of the others: values and cofactors of
        those stay what they are, and there is nothing to solve.
        """
        solved, before, cofactors = self._solved, self.numbers, self._cofactors
        self.enter(numbers)
        places, rows, rhs = self._rows(columns, coefficients, value, sigma)
        self._observe(places, rows, rhs)
        new = np.isin(self.numbers[places], numbers)
        own, others = rows[:, new], rows[:, ~new]
        if not solved or not len(own) == own.shape[1] == len(numbers):
            return
        old, new = places[~new], places[new]
        try:
            given = np.linalg.solve(own, np.column_stack([rhs, -others, np.eye(len(own))]))
        except np.linalg.LinAlgError:
            return
        through, noise = given[:, 1 : 1 + len(old)], given[:, 1 + len(old) :]
        self.theta[new] = given[:, 0] + through @ self.theta[old]
        self._solved = True
        if cofactors is None or (m := len(before) - len(cofactors)) > old.min(initial=m):
            return
        there, old, new = self.places(before[m:]) - m, old - m, new - m
        known = self._cofactors = np.empty((len(self) - m, len(self) - m))
        known[there[:, None], there] = cofactors
        known[new[:, None], there] = through @ known[old[:, None], there]
        known[there[:, None], new] = known[new[:, None], there].T
        known[new[:, None], new] = known[new[:, None], old] @ through.T + noise @ noise.T

    def _rows(
        self, columns: NDArray[np.int32], coefficients: Array, value: Array, sigma: Array
    ) -> tuple[IntArray, Array, Array]:
        """Places (u,) of the unknowns that a-priori observations speak of, whitened rows (m, u), right-hand side."""
        keep = np.isfinite(sigma)
        columns, weight = columns[keep], 1.0 / sigma[keep]
        touched = np.unique(columns)
        touched = touched[touched >= 0].astype(np.int64)
        rows = np.zeros((len(columns), len(touched) + 1))
        local = np.where(columns >= 0, np.searchsorted(touched, columns), len(touched))
        np.add.at(rows, (np.arange(len(rows))[:, None], local), coefficients[keep] * weight[:, None])
        return self._present(touched), rows[:, :-1], value[keep] * weight

    def _observe(self, places: IntArray, rows: Array, rhs: Array) -> None:
        self._fixed[np.ix_(places, places)] += rows.T @ rows
        self._fixed_rhs[places] += rows.T @ rhs
        self.square += float(rhs @ rhs)
        self.redundancy += len(rows)
        self._changed()

    def _changed(self) -> None:
        """Something else is known."""
        self._factor = self._cofactors = None
        self._solved, self._expected = False, []
        self.changes += 1

    def add(self, columns: IntArray, information: Information, sign: int = 1) -> None:
        """Add a batch's information to the live part, or take it back (``sign = -1``)."""
        place = self._present(columns)
        _add(self._live, place, information.matrix, sign)
        self._live_rhs[place] += sign * information.rhs
        self.square += sign * information.square
        self.redundancy += sign * information.rows
        self._changed()

    def exchange(self, columns: IntArray, old: Information, new: Information) -> None:
        """Put a batch's new information in the live part in place of what it said before."""
        self.add(columns, new - old)

    def fix(self, columns: IntArray, information: Information) -> None:
        """Move a batch's information from the live to the fixed part."""
        place = self._present(columns)
        _add(self._live, place, information.matrix, -1)
        _add(self._fixed, place, information.matrix)
        self._live_rhs[place] -= information.rhs
        self._fixed_rhs[place] += information.rhs
        self.changes += 1

    def normal(
        self, less: Iterable[tuple[IntArray, Information]] = (), more: Iterable[tuple[IntArray, Information]] = ()
    ) -> tuple[Array, Array]:
        """Normal equations (n, n), (n,) of all information, less some and with more about unknowns of these numbers."""
        matrix, rhs = self._fixed + self._live, self._fixed_rhs + self._live_rhs
        sums: dict[bytes, tuple[IntArray, Array, Array]] = {}  # batches of one segment have the same unknowns
        for combine, parts in ((np.subtract, less), (np.add, more)):
            for columns, information in parts:
                key = columns.tobytes()
                if key not in sums:
                    n = len(columns)
                    sums[key] = columns, np.zeros((n, n)), np.zeros(n)
                _, own, own_rhs = sums[key]
                combine(own, information.matrix, out=own)
                combine(own_rhs, information.rhs, out=own_rhs)
        for columns, own, own_rhs in sums.values():
            place = self.places(columns)
            matrix[np.ix_(place, place)] += own
            rhs[place] += own_rhs
        return matrix, rhs

    def live(self) -> tuple[Array, Array]:
        """Normal equations (n, n), (n,) of the batches alone that can still lose a ray."""
        return self._live, self._live_rhs

    def conditioned(self, held: IntArray) -> tuple[Array, Array]:
        """Cofactors (n, n) and values (n,) with other unknowns held at zero."""
        if not len(held):
            self.solve()
            return self.covariance(self.numbers), self.theta
        matrix, rhs = self.normal()
        places = self.places(held)
        matrix[places, :] = 0.0
        matrix[:, places] = 0.0
        matrix[places, places] = HELD_WEIGHT  # cut off from the others: zero and certain
        rhs[places] = 0.0
        factor = DenseFactor(matrix)
        return factor.inverse(), factor.solve(rhs)

    def if_held(self, held: IntArray, numbers: IntArray) -> tuple[Array, Array]:
        """Values (m,) and cofactors (m, m) of unknowns if few others were held at zero: from those of the solution."""
        m = len(numbers)
        Q = self.covariance(np.concatenate([numbers, held]))
        K = np.linalg.solve(Q[m:, m:], Q[m:, :m]).T
        return self.values(numbers) - K @ self.values(held), Q[:m, :m] - K @ Q[m:, :m]

    @property
    def factor(self) -> DenseFactor:
        """Of all information.

        Raises
        ------
        DivergedError : it holds what is no number
        """
        if self._factor is None:
            try:
                self._factor = DenseFactor(self._fixed + self._live)
            except np.linalg.LinAlgError as error:
                raise DivergedError("the normal equations are no numbers any more") from error
        return self._factor

    def solve(self) -> None:
        """Values from all information, if they are not.

        Raises
        ------
        DivergedError : they are no numbers
        """
        if self._solved:
            return
        theta = self.factor.solve(self._fixed_rhs + self._live_rhs)
        if not np.isfinite(theta).all():
            raise DivergedError("the solution is no number any more")
        self.theta = theta
        self._solved = True
        self.solution += 1

    def cost(self) -> float:
        """Weighted squares of everything so far, at the present solution."""
        return max(self.square - float((self._fixed_rhs + self._live_rhs) @ self.theta), 0.0)

    def expect(self, numbers: Iterable[IntArray]) -> None:
        """Cofactors of these unknowns, all of them present, will be asked for."""
        self._expected += numbers

    def covariance(self, numbers: IntArray) -> Array:
        """Cofactors (m, m) of present unknowns.

        Mostly those of the newest times and lasting ones are asked for. They stand last, so that theirs follow from a
        small part of the factor.
        """
        n, place = len(self), self.places(numbers)
        first = int(place.min(initial=n))
        if self._cofactors is None or n - len(self._cofactors) > first:
            for expected in self._expected:
                first = min(first, int(self.places(expected).min(initial=n)))
            self._expected = []
            self._cofactors = self.factor.last_cofactors(max(first, 0))
        return block_of(self._cofactors, place - (n - len(self._cofactors)))

    def propagated(self, functions: Array) -> Array:
        """Cofactors (n, k) between all unknowns and functions (n, k) of them."""
        known = self._cofactors
        return known @ functions if known is not None and len(known) == len(self) else self.factor.solve(functions)

    def marginalise(self, numbers: IntArray) -> Marginal:
        """Take unknowns out; batches that touch them must have been fixed before.

        Raises
        ------
        ValueError : an unknown about which nothing is known, not even beforehand
        """
        gone = self.places(numbers)
        stay = np.setdiff1d(np.arange(len(self)), gone)
        own = self._fixed[np.ix_(gone, gone)]
        diagonal = np.diagonal(own)
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        R11, failed = _potrf(own * scale[:, None] * scale, lower=0, clean=1)
        if failed:
            raise ValueError(f"unknown {int(self.numbers[gone[failed - 1]])} is undetermined and cannot leave")
        R11 /= scale
        R12 = solve_triangular(R11, self._fixed[np.ix_(gone, stay)], trans=1, check_finite=False)
        d = solve_triangular(R11, self._fixed_rhs[gone], trans=1, check_finite=False)
        marginal = Marginal(self.numbers[gone].copy(), self.numbers[stay].copy(), R11, R12, d)
        self._fixed = block_of(self._fixed, stay) - R12.T @ R12
        self._fixed_rhs = self._fixed_rhs[stay] - R12.T @ d
        self._live, self._live_rhs = block_of(self._live, stay), self._live_rhs[stay]
        self.square -= float(d @ d)
        self._place[self.numbers[gone]] = -1
        self.numbers, self.theta = self.numbers[stay], self.theta[stay]
        self._place[self.numbers] = np.arange(len(stay))
        self._factor, self._expected = None, []
        self.changes += 1
        if self._cofactors is not None:  # of what stays, they are what they were
            m = len(self) + len(gone) - len(self._cofactors)
            self._cofactors = block_of(self._cofactors, stay[stay >= m] - m)
        return marginal


def places_of(numbers: IntArray, wanted: IntArray) -> IntArray:
    """Places of numbers among others, all different; -1 for those that are not there."""
    if not len(numbers):
        return np.full(len(wanted), -1)
    order = np.argsort(numbers)
    at = order.take(np.searchsorted(numbers, wanted, sorter=order), mode="clip")
    return np.where(numbers[at] == wanted, at, -1)


def block_of(matrix: Array, places: IntArray) -> Array:
    """Rows and columns of a large symmetric matrix; one after the other is several times faster than both at once."""
    return matrix.take(places, axis=0).take(places, axis=1)


def _padded(matrix: Array, rows: int, columns: int) -> Array:
    """With rows and columns of zeros behind it; NumPy's own function takes five times as long for a small one."""
    n, m = matrix.shape
    found = np.zeros((n + rows, m + columns), order="F" if matrix.flags.fnc else "C")
    found[:n, :m] = matrix
    return found


def _add(matrix: Array, places: IntArray, more: Array, sign: int = 1) -> None:
    """Add to rows and columns of a large matrix whose rows stand one after the other; by one index that takes half the
    time of two."""
    matrix.reshape(-1)[places[:, None] * len(matrix) + places] += sign * more
