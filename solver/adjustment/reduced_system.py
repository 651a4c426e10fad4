"""Solving the reduced system: scaled Cholesky, dense or along a band with a border; null vectors if it is singular."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.linalg import cho_solve, get_lapack_funcs, solve_triangular

from ..arrays import Array, Bools, IntArray

Blocks = list[Array]

_potrf, _potri, _potrs = get_lapack_funcs(("potrf", "potri", "potrs"), dtype=float)  # pyrefly: ignore[not-iterable]

#: Eigenvalues of the scaled matrix below this are taken as zero: where only its own diagonal is known for a scale, and
#: where that before the points were eliminated is, of which elimination leaves rounding.
SINGULAR, ROUNDING = 1e-11, 1e-13
#: What the diagonal of a singular banded matrix is raised by.
RAISED = 1e-12
#: Rows of a lower triangle that are copied to the upper one at a time, so that both stay in the cache. Tuned: between
#: 32 and 128 it is the same.
MIRRORED = 64


@dataclass(frozen=True)
class Undetermined:
    """Directions of the reduced unknowns about which the observations say nothing.

    Attributes
    ----------
    vectors : (n_unknowns, m) null vectors, largest element 1 in units of the unknowns' scale ``scale``
    eigenvalues : (m,) of the scaled matrix
    scale : (n_unknowns,) scale of each unknown; vectors * scale is in the unknowns' own units
    """

    vectors: Array
    eigenvalues: Array
    scale: Array

    def __len__(self) -> int:
        return self.vectors.shape[1]


class Factor(Protocol):
    """A factorised reduced system."""

    undetermined: Undetermined

    def solve(self, rhs: Array) -> Array: ...
    def cofactors(self, columns: IntArray) -> Array: ...
    def variances(self) -> Array: ...


class DenseFactor:
    """Cholesky factor of a dense symmetric matrix (which it overwrites), or its eigenvectors where it is singular.

    Directions without information are held: the solution has no part in them, and their cofactors are zero.

    Parameters
    ----------
    matrix : (n, n)
    reference : (n,) diagonal that the matrix had before the points were eliminated; its own if it is not given

    Attributes
    ----------
    undetermined : null space, empty for a regular matrix
    """

    def __init__(self, matrix: Array, reference: Array | None = None):
        n = len(matrix)
        diagonal = np.diagonal(matrix).copy()
        self.scale = scale_of(diagonal if reference is None else reference)
        limit, sound = (SINGULAR, SINGULAR) if reference is None else (ROUNDING, 10 * ROUNDING)
        scaled = matrix.T  # column by column as LAPACK wants it, and in place
        scaled *= self.scale[:, None]
        scaled *= self.scale
        factor, info = _potrf(scaled, lower=1, clean=0, overwrite_a=1)
        self._factor: Array | None = None
        self._inverse: Array | None = None
        # an eigenvalue can be smaller than the pivots; between the two limits eigenvalues decide
        if info == 0 and (n == 0 or (np.diagonal(factor) ** 2).min() > sound):
            self._factor = factor
            self.undetermined = Undetermined(np.empty((n, 0)), np.empty(0), self.scale)
            return
        scaled[np.diag_indices(n)] = diagonal * self.scale**2  # the upper triangle is as it was
        values, vectors = np.linalg.eigh(scaled, UPLO="U")
        good = values > limit * max(float(values[-1]), 1.0)
        kept = vectors[:, good]
        self._inverse = (kept / values[good]) @ kept.T * self.scale[:, None] * self.scale
        null = vectors[:, ~good]
        self.undetermined = Undetermined(null / np.abs(null).max(axis=0, initial=1e-300), values[~good], self.scale)

    def solve(self, rhs: Array) -> Array:
        """``matrix^-1 rhs`` for (n,) or (n, m)."""
        if self._factor is None:
            return self.inverse() @ rhs
        scale = self.scale if rhs.ndim == 1 else self.scale[:, None]
        if not rhs.size:
            return scale * rhs
        found, _ = _potrs(self._factor, scale * rhs, lower=1)
        return scale * found

    def inverse(self) -> Array:
        """(n, n) cofactor matrix."""
        if self._inverse is None:
            self._inverse = inverse_of(self._factor)
            self._inverse *= self.scale[:, None]
            self._inverse *= self.scale
        return self._inverse

    def cofactors(self, columns: IntArray) -> Array:
        """Block (m, m) of the cofactor matrix."""
        return self.inverse()[np.ix_(columns, columns)]

    def last_cofactors(self, first: int) -> Array:
        """Block (n - first, n - first) of the cofactor matrix, of the unknowns from one on: ``(L L^T)^-1`` with what
        stands there of L."""
        if self._factor is None or self._inverse is not None or not first:
            return self.inverse()[first:, first:]
        block, scale = inverse_of(self._factor[first:, first:]), self.scale[first:]
        block *= scale[:, None]
        block *= scale
        return block

    def variances(self) -> Array:
        """(n,) diagonal of the cofactor matrix."""
        return np.diagonal(self.inverse()).copy()


class BandedFactor:
    """Block Cholesky factor along a band with a border; cofactors inside the band without the dense inverse.

    A singular matrix gets its diagonal raised by `RAISED`; the null vectors are then found by iteration, and solution
    and cofactors have no part in them, as in `DenseFactor`.

    Parameters
    ----------
    position : (n,) place of each unknown in the order of the band
    bounds : (T + 1,) limits of the blocks; the border stands behind
    diagonal, below, border, corner : blocks of the matrix; not changed
    reference : (n,) diagonal before the points were eliminated, in the order of the band
    """

    def __init__(
        self,
        position: IntArray,
        bounds: IntArray,
        diagonal: Blocks,
        below: Blocks,
        border: Blocks,
        corner: Array,
        reference: Array,
    ):
        self.position, self.bounds = position, bounds
        n, last = len(position), len(diagonal)
        scale = scale_of(reference)
        self._scale = scale  # in the order of the band
        self.scale = scale[position]
        parts = [scale[bounds[i] : bounds[i + 1]] for i in range(last)] + [scale[bounds[-1] :]]
        scaled: Blocks = [parts[i][:, None] * diagonal[i] * parts[i] for i in range(last)]
        under: Blocks = [parts[i + 1][:, None] * below[i] * parts[i] for i in range(last - 1)]
        edge: Blocks = [parts[-1][:, None] * border[i] * parts[i] for i in range(last)]
        end = parts[-1][:, None] * corner * parts[-1]
        self._z: tuple[Blocks, Blocks, Blocks, Array] | None = None
        self._null = np.empty((n, 0))
        values = np.empty(0)
        if not self._factorise(scaled, under, edge, end, 0.0, 10 * ROUNDING):
            self._factorise(scaled, under, edge, end, RAISED, 0.0)
            values, self._null = null_vectors(self._solve, n)
            if not len(values):
                self._factorise(scaled, under, edge, end, 0.0, 0.0)
        vectors = self._null[position]
        vectors = vectors / np.abs(vectors).max(axis=0, initial=1e-300)
        self.undetermined = Undetermined(vectors, values, self.scale)

    def _factorise(
        self, diagonal: Blocks, below: Blocks, border: Blocks, corner: Array, raised: float, limit: float
    ) -> bool:
        """Factor the scaled blocks with their diagonal raised; whether all squared pivots are above the limit."""
        self._L, self._C, self._B = [], [], []
        here, edge, end = diagonal[0], border[0], corner
        for i in range(len(diagonal)):
            L, sound = cholesky(here, raised, limit)
            if not sound:
                return False
            B = solve_triangular(L, edge.T, lower=True, check_finite=False).T
            self._L.append(L)
            self._B.append(B)
            end = end - B @ B.T
            if i + 1 < len(diagonal):
                C = solve_triangular(L, below[i].T, lower=True, check_finite=False).T
                self._C.append(C)
                here, edge = diagonal[i + 1] - C @ C.T, border[i + 1] - B @ C.T
        self._E, sound = cholesky(end, raised, limit)
        return sound

    def _solve(self, b: Array) -> Array:
        """Solve with the (raised) scaled factor, in the order of the band; (n,) or (n, m)."""
        bounds, last = self.bounds, len(self._L)
        x = np.array(b, dtype=float)
        part = [x[bounds[i] : bounds[i + 1]] for i in range(last)] + [x[bounds[-1] :]]
        for i in range(last):
            part[i][:] = solve_triangular(self._L[i], part[i], lower=True, check_finite=False)
            if i + 1 < last:
                part[i + 1][:] -= self._C[i] @ part[i]
            part[-1][:] -= self._B[i] @ part[i]
        if len(part[-1]):
            part[-1][:] = cho_solve((self._E, True), part[-1], check_finite=False)
        for i in range(last - 1, -1, -1):
            t = part[i] - self._B[i].T @ part[-1]
            if i + 1 < last:
                t -= self._C[i].T @ part[i + 1]
            part[i][:] = solve_triangular(self._L[i], t, lower=True, trans=1, check_finite=False)
        return x

    def solve(self, rhs: Array) -> Array:
        """``matrix^-1 rhs`` for (n,) or (n, m)."""
        scale = self._scale if rhs.ndim == 1 else self._scale[:, None]
        b = np.empty_like(rhs)
        b[self.position] = rhs
        b *= scale
        b -= self._null @ (self._null.T @ b)
        x = self._solve(b)
        x -= self._null @ (self._null.T @ x)
        return (scale * x)[self.position]

    def _selected(self) -> tuple[Blocks, Blocks, Blocks, Array]:
        """Blocks of the scaled inverse where the matrix has blocks, from the last to the first (Takahashi)."""
        if self._z is None:
            last = len(self._L)
            corner = inverse_of(self._E)
            diagonal: Blocks = [np.empty(0)] * last
            below: Blocks = [np.empty(0)] * (last - 1)
            border: Blocks = [np.empty(0)] * last
            for i in range(last - 1, -1, -1):
                XB = solve_triangular(self._L[i], self._B[i].T, lower=True, trans=1, check_finite=False).T
                own = inverse_of(self._L[i])
                if i + 1 < last:
                    XC = solve_triangular(self._L[i], self._C[i].T, lower=True, trans=1, check_finite=False).T
                    below[i] = -(diagonal[i + 1] @ XC + border[i + 1].T @ XB)
                    border[i] = -(border[i + 1] @ XC + corner @ XB)
                    diagonal[i] = own - XC.T @ below[i] - XB.T @ border[i]
                else:
                    border[i] = -corner @ XB
                    diagonal[i] = own - XB.T @ border[i]
            self._z = diagonal, below, border, corner
        return self._z

    def cofactors(self, columns: IntArray) -> Array:
        """Block (m, m) of the cofactor matrix; cheap where the unknowns lie in neighbouring blocks."""
        bounds, last = self.bounds, len(self._L)
        place = self.position[columns]
        block = np.searchsorted(bounds, place, side="right") - 1
        inner = block[block < last]
        if len(inner) and inner.max() - inner.min() > 1:
            unit = np.zeros((len(self.position), len(columns)))
            unit[columns, np.arange(len(columns))] = 1.0
            Q = self.solve(unit)[columns]
            return 0.5 * (Q + Q.T)
        diagonal, below, border, corner = self._selected()
        Q = np.empty((len(columns), len(columns)))
        present = sorted(set(block.tolist()))
        rows = {i: np.flatnonzero(block == i) for i in present}
        for a in present:
            for b in present:
                if b > a:
                    continue
                stored = corner if b == last else border[b] if a == last else diagonal[a] if a == b else below[b]
                values = stored[np.ix_(place[rows[a]] - bounds[a], place[rows[b]] - bounds[b])]
                Q[np.ix_(rows[a], rows[b])] = values
                Q[np.ix_(rows[b], rows[a])] = values.T
        null = self._null[place]
        Q -= null @ null.T / RAISED
        scale = self._scale[place]
        return scale[:, None] * Q * scale

    def variances(self) -> Array:
        """(n,) diagonal of the cofactor matrix."""
        diagonal, _, _, corner = self._selected()
        d = np.concatenate([np.diagonal(block) for block in (*diagonal, corner)])
        d = d - (self._null**2).sum(axis=1) / RAISED
        return (d * self._scale**2)[self.position]


def null_vectors(solve: Callable[[Array], Array], n: int) -> tuple[Array, Array]:
    """Eigenvalues and vectors of a scaled matrix (n, n) that count as zero, from solutions with its raised factor."""
    rng = np.random.default_rng(0)
    wanted = 16
    while True:  # subspace iteration with the inverse; more vectors if all of them belong to the null space
        wanted = min(wanted, n)
        V = np.linalg.qr(rng.standard_normal((n, wanted)))[0]
        for _ in range(8):
            V = np.linalg.qr(solve(V))[0]
        T = V.T @ solve(V)
        values, turn = np.linalg.eigh(0.5 * (T + T.T))
        eigenvalues = 1.0 / values - RAISED
        zero = eigenvalues < ROUNDING
        if wanted == n or not zero.all():
            return np.maximum(eigenvalues[zero], 0.0), (V @ turn)[:, zero]
        wanted *= 2


def scale_of(diagonal: Array) -> Array:
    """What makes a diagonal 1."""
    positive = diagonal > 0
    return np.where(positive, 1.0 / np.sqrt(np.where(positive, diagonal, 1.0)), 1.0)


def cholesky(matrix: Array, raised: float, limit: float) -> tuple[Array, bool]:
    """Lower factor of a matrix with its diagonal raised, and whether its squared pivots are above a limit."""
    if not len(matrix):
        return matrix, True
    work = matrix.copy()
    work[np.diag_indices_from(work)] += raised
    factor, info = _potrf(work, lower=1, clean=1)
    return factor, bool(info == 0 and (np.diagonal(factor) ** 2).min() > limit)


def inverse_of(factor: Array | None) -> Array:
    """``(L L^T)^-1`` (n, n) from the lower triangle L (n, n)."""
    if factor is None or not len(factor):
        return np.empty((0, 0))
    lower, _ = _potri(factor, lower=1)
    mirror(lower)
    return lower.T  # the same numbers, row by row


def mirror(matrix: Array) -> None:
    """Make a matrix (n, n) symmetric by what stands below its diagonal.

    Part by part: a whole matrix and its transpose are not both near the processor, which takes as long as its inverse.
    """
    for begin in range(0, len(matrix), MIRRORED):
        here, after = slice(begin, begin + MIRRORED), slice(begin + MIRRORED, None)
        matrix[here, after] = matrix[after, here].T
        corner = matrix[here, here]
        np.copyto(corner, corner.T.copy(), where=_above_diagonal(len(corner)))


@lru_cache(maxsize=MIRRORED + 1)
def _above_diagonal(n: int) -> Bools:
    """Which elements of an (n, n) matrix stand above its diagonal."""
    return ~np.tri(n, dtype=bool)
