"""A sparse symmetric matrix in fronts, its Cholesky factor, and the cofactors of unknowns that meet.

Multifrontal: each front of a `nested_dissection.Dissection` is a dense matrix over its own unknowns and the later ones
they meet; what is left when its own are eliminated is added to the front it hangs on. Cofactors go the other way, from
the last front to the first (Takahashi), and are computed where the factor has entries, which is where observations and
points need them; libraries of sparse Cholesky factors leave them to the user.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array

from ..arrays import Array, IntArray
from .in_parts import Cost, Parts, in_one_go
from .nested_dissection import Dissection
from .reduced_system import RAISED, ROUNDING, Undetermined, cholesky, inverse_of, null_vectors, scale_of

#: What a front costs besides its arithmetic, in floating point operations, about.
FRONT = 2e5
#: Rows of what is left of a front that are worked on together, and from what cost on they are a part of their own.
ROWS, LARGE = 512, 2e8


class FrontalMatrix:
    """Columns of the fronts' own unknowns: (own + rows, own) each; see `normal_matrix.NormalMatrix`."""

    def __init__(self, dissection: Dissection):
        self.dissection = dissection
        own = np.diff(dissection.bounds)
        self.panels: list[Array] = [
            np.zeros((int(m) + len(r), int(m))) for m, r in zip(own, dissection.rows, strict=True)
        ]
        self.reference: Array | None = None

    def subtract(self, columns: IntArray, block: Array) -> None:
        place = self.dissection.position[columns]
        if not (np.diff(place) > 0).all():
            order = np.argsort(place)
            place, block = place[order], block[np.ix_(order, order)]
        for t, low, high in pieces(self.dissection, place):
            rows = self.dissection.local(t, place[low:])
            self.panels[t][np.ix_(rows, rows[: high - low])] -= block[low:, low:high]

    def add_each(self, columns: IntArray, blocks: Array) -> None:
        for own, block in that_count(columns, blocks):
            self.subtract(own, -block)

    def add_sparse(self, matrix: csr_array) -> None:
        entries = matrix.tocoo()
        row, column = (self.dissection.position[i] for i in entries.coords)
        lower = np.flatnonzero(row >= column)
        front = np.searchsorted(self.dissection.bounds, column[lower], side="right") - 1
        order = np.argsort(front, kind="stable")
        lower, front = lower[order], front[order]
        limits = np.searchsorted(front, np.arange(len(self.panels) + 1))
        for t in np.unique(front).tolist():
            own = lower[limits[t] : limits[t + 1]]
            at = column[own] - self.dissection.bounds[t]
            np.add.at(self.panels[t], (self.dissection.local(t, row[own]), at), entries.data[own])

    def damp(self, damping: float) -> None:
        for panel in self.panels:
            i = np.arange(panel.shape[1])
            panel[i, i] *= 1.0 + damping

    def keep_scale(self) -> None:
        self.reference = np.concatenate([np.diagonal(panel) for panel in self.panels])

    def take_scale(self, diagonal: Array) -> None:
        self.reference = np.empty(len(diagonal))
        self.reference[self.dissection.position] = diagonal

    def factorise(self) -> FrontalFactor:
        """Factor, which takes the place of the matrix."""
        if self.reference is None:
            self.keep_scale()
        assert self.reference is not None
        return FrontalFactor(self.dissection, self.panels, self.reference)


class Fronts:
    """Elimination front by front: what is left of one is added to the one it hangs on.

    Parameters
    ----------
    dissection : order and fronts
    panels : columns of the matrix, not changed
    """

    def __init__(self, dissection: Dissection, panels: list[Array]):
        self._dissection, self._panels = dissection, panels
        self._waiting: list[list[tuple[IntArray, Array]]] = [[] for _ in panels]

    def assembled(self, t: int) -> tuple[Array, Array]:
        """A front with what those that hang on it have left: columns of its own unknowns (own + rows, own), and what is
        known of the others (rows, rows); only the lower triangle counts."""
        columns = self._panels[t].copy()
        own = columns.shape[1]
        rest = np.zeros((len(columns) - own, len(columns) - own))
        waiting, self._waiting[t] = self._waiting[t], []
        while waiting:
            rows, left = waiting.pop()
            at = self._dissection.local(t, rows)
            low = int(np.searchsorted(at, own))
            columns[np.ix_(at, at[:low])] += left[:, :low]
            rest[np.ix_(at[low:] - own, at[low:] - own)] += left[low:, low:]
        return columns, rest

    def eliminating(self, t: int, columns: Array, rest: Array, L: Array) -> Generator[Cost, None, Array]:
        """Columns (own + rows, own) of the factor, given that of the own unknowns; in parts.

        Parameters
        ----------
        columns, rest : the front as assembled, whose memory is used again
        """
        d, size, own = self._dissection, len(columns), len(L)
        columns[:own] = L
        cost = FRONT + own**3 / 3.0
        if size > own:
            below = columns[own:]
            below[:] = solve_triangular(L, below.T, lower=True, check_finite=False).T
            cost += float(own) ** 2 * (size - own)
            if d.parent[t] >= 0:
                for begin in range(0, len(rest), ROWS):
                    end = min(begin + ROWS, len(rest))
                    rest[begin:end, :end] -= below[begin:end] @ below[:end].T
                    cost += 2.0 * (end - begin) * end * own
                    if cost > LARGE:
                        yield cost
                        cost = 0.0
                self._waiting[int(d.parent[t])].append((d.rows[t], rest))
        yield cost
        return columns


@dataclass(frozen=True)
class Root:
    """Functions of unknowns as `FrontalFactor.rooted` makes them.

    Attributes
    ----------
    parts : by front, (own, k)
    null : (k, q) of directions without information, which cofactors have no part in
    """

    parts: dict[int, Array]
    null: Array

    def joint(self, other: Root) -> Array:
        """Cofactors (k, l) between these functions and others of the same factor."""
        found = -self.null @ other.null.T
        for t in self.parts.keys() & other.parts.keys():
            found += self.parts[t].T @ other.parts[t]
        return found


class FrontalFactor:
    """Cholesky factor in fronts; see `reduced_system.Factor`.

    A singular matrix gets its diagonal raised by `reduced_system.RAISED`; the null vectors are then found by iteration,
    and solution and cofactors have no part in them, as in `reduced_system.BandedFactor`.

    Parameters
    ----------
    dissection : order and fronts
    panels : columns of the matrix, which become those of the factor
    reference : (n,) diagonal before the points were eliminated, in the order of the fronts
    """

    def __init__(self, dissection: Dissection, panels: list[Array], reference: Array):
        in_one_go(self._making(dissection, panels, reference))

    @classmethod
    def in_parts(
        cls, dissection: Dissection, panels: list[Array], reference: Array
    ) -> Generator[Cost, None, FrontalFactor]:
        """The same, in parts, each with what it costs."""
        factor = cls.__new__(cls)
        yield from factor._making(dissection, panels, reference)
        return factor

    def _making(self, dissection: Dissection, panels: list[Array], reference: Array) -> Parts:
        self.dissection = dissection
        n, bounds = len(dissection.position), dissection.bounds
        scale = scale_of(reference)
        self._scale = scale  # in the order of the fronts
        self.scale = scale[dissection.position]
        for t, panel in enumerate(panels):
            own = slice(int(bounds[t]), int(bounds[t + 1]))
            panel *= np.concatenate([scale[own], scale[dissection.rows[t]]])[:, None]
            panel *= scale[own]
        self._z: list[Array] | None = None
        self._null, values = np.empty((n, 0)), np.empty(0)
        self._panels = panels
        if not (yield from self._factorising(0.0, 10 * ROUNDING)):
            yield from self._factorising(RAISED, 0.0)
            values, self._null = null_vectors(self._solve, n)
            if not len(values):
                yield from self._factorising(0.0, 0.0)
        del self._panels
        vectors = self._null[dissection.position]
        vectors = vectors / np.abs(vectors).max(axis=0, initial=1e-300)
        self.undetermined = Undetermined(vectors, values, self.scale)

    def _factorising(self, raised: float, limit: float) -> Generator[Cost, None, bool]:
        """Factor with the diagonal raised; whether all squared pivots are above the limit."""
        self._L: list[Array] = []
        fronts = Fronts(self.dissection, self._panels)
        for t in range(len(self._panels)):
            columns, rest = fronts.assembled(t)
            L, sound = cholesky(columns[: columns.shape[1]], raised, limit)
            if not sound:
                return False
            self._L.append((yield from fronts.eliminating(t, columns, rest, L)))
        return True

    def _solve(self, b: Array) -> Array:
        """Solve with the (raised) scaled factor, in the order of the fronts; (n,) or (n, m)."""
        d, x = self.dissection, np.array(b, dtype=float)
        for t, factor in enumerate(self._L):
            own, m = slice(int(d.bounds[t]), int(d.bounds[t + 1])), factor.shape[1]
            x[own] = solve_triangular(factor[:m], x[own], lower=True, check_finite=False)
            x[d.rows[t]] -= factor[m:] @ x[own]
        for t in range(len(self._L) - 1, -1, -1):
            factor = self._L[t]
            own, m = slice(int(d.bounds[t]), int(d.bounds[t + 1])), factor.shape[1]
            right = x[own] - factor[m:].T @ x[d.rows[t]]
            x[own] = solve_triangular(factor[:m], right, lower=True, trans=1, check_finite=False)
        return x

    def solve(self, rhs: Array) -> Array:
        """``matrix^-1 rhs`` for (n,) or (n, m)."""
        scale = self._scale if rhs.ndim == 1 else self._scale[:, None]
        b = np.empty_like(rhs)
        b[self.dissection.position] = rhs
        b *= scale
        b -= self._null @ (self._null.T @ b)
        x = self._solve(b)
        x -= self._null @ (self._null.T @ x)
        return (scale * x)[self.dissection.position]

    def selecting(self) -> Parts:
        """Compute the cofactors of unknowns that meet, if that has not been done, in parts."""
        if self._z is None:
            z = yield from self._inverse()
            self._z = z

    def forget_selected(self) -> None:
        """Let the memory of the cofactors go; they are computed anew when they are asked for."""
        self._z = None

    def _selected(self) -> list[Array]:
        in_one_go(self.selecting())
        assert self._z is not None
        return self._z

    def _inverse(self) -> Generator[Cost, None, list[Array]]:
        """Columns (own + rows, own) of the scaled inverse, from the last front to the first."""
        count = len(self._L)
        z: list[Array] = [np.empty(0)] * count
        for t in range(count - 1, -1, -1):
            factor = self._L[t]
            size, m = factor.shape
            own = inverse_of(factor[:m])
            columns = np.empty((size, m))
            if size > m:
                below = self._among(z, self.dissection.rows[t])
                assert below is not None  # what a front has entries with has entries with each other
                X = solve_triangular(factor[:m], factor[m:].T, lower=True, trans=1, check_finite=False).T
                columns[m:] = -below @ X
                own = own - X.T @ columns[m:]
            columns[:m] = 0.5 * (own + own.T)
            z[t] = columns
            yield FRONT + 2.0 * size * size * m
        return z

    def _among(self, z: list[Array], place: IntArray) -> Array | None:
        """Scaled inverse (m, m) among ascending places (m,) from its columns; None where two of them do not meet."""
        d, Q = self.dissection, np.empty((len(place), len(place)))
        for t, low, high in pieces(d, place):
            later = place[high:]
            at = np.searchsorted(d.rows[t], later)
            if len(later) and not (at.max() < len(d.rows[t]) and (d.rows[t][at] == later).all()):
                return None
            m = z[t].shape[1]
            own = place[low:high] - d.bounds[t]
            Q[low:high, low:high] = z[t][np.ix_(own, own)]
            Q[high:, low:high] = z[t][np.ix_(at + m, own)]
            Q[low:high, high:] = Q[high:, low:high].T
        return Q

    def rooted(self, columns: IntArray, functions: Array) -> Root:
        """Functions (k, m) of some unknowns (m,), so that `Root.joint` gives the cofactors between any two of them.

        It is ``L^-1 F^T``, which is zero but on the way from the unknowns' fronts to the last one.
        """
        d, k = self.dissection, len(functions)
        place = d.position[columns]
        scaled = functions * self._scale[place]
        waiting: dict[int, Array] = {}
        order = np.argsort(place)
        for t, low, high in pieces(d, place[order]):
            waiting[t] = np.zeros((len(self._L[t]), k))
            waiting[t][place[order[low:high]] - d.bounds[t]] = scaled[:, order[low:high]].T
        parts: dict[int, Array] = {}
        while waiting:
            t = min(waiting)
            b, factor = waiting.pop(t), self._L[t]
            m = factor.shape[1]
            parts[t] = solve_triangular(factor[:m], b[:m], lower=True, check_finite=False)
            if len(factor) > m:
                up = int(d.parent[t])
                above = waiting.setdefault(up, np.zeros((len(self._L[up]), k)))
                above[d.local(up, d.rows[t])] += b[m:] - factor[m:] @ parts[t]
        return Root(parts, scaled @ self._null[place] / np.sqrt(RAISED))

    def cofactors(self, columns: IntArray) -> Array:
        """Block (m, m) of the cofactor matrix; cheap where all of the unknowns meet."""
        place = self.dissection.position[columns]
        order = np.argsort(place)
        sorted_place = place[order]
        Q = self._among(self._selected(), sorted_place)
        if Q is None:
            root = self.rooted(columns, np.eye(len(columns)))
            return root.joint(root)
        null = self._null[sorted_place]
        Q -= null @ null.T / RAISED
        scale = self._scale[sorted_place]
        Q *= scale[:, None]
        Q *= scale
        result = np.empty_like(Q)
        result[np.ix_(order, order)] = Q
        return result

    def variances(self) -> Array:
        """(n,) diagonal of the cofactor matrix."""
        diagonal = np.concatenate([np.diagonal(columns) for columns in self._selected()])
        diagonal = diagonal - (self._null**2).sum(axis=1) / RAISED
        return (diagonal * self._scale**2)[self.dissection.position]


def that_count(columns: IntArray, blocks: Array) -> Iterator[tuple[IntArray, Array]]:
    """Unknowns (m,) and block (m, m) of some (k, m) and (k, m, m), without those that are -1."""
    for own, block in zip(columns, blocks, strict=True):
        used = np.flatnonzero(own >= 0)
        yield (own, block) if len(used) == len(own) else (own[used], block[np.ix_(used, used)])


def pieces(dissection: Dissection, place: IntArray) -> list[tuple[int, int, int]]:
    """Fronts that ascending places (k,) belong to, each with the range of these places."""
    front = np.searchsorted(dissection.bounds, place, side="right") - 1
    starts = np.flatnonzero(np.diff(front, prepend=-1))
    ends = np.append(starts, len(place))[1:]
    return [(int(front[low]), int(low), int(high)) for low, high in zip(starts, ends, strict=True)]
