"""What the strips flown so far say of points that a later strip sees again.

Solving the block anew with every tie point is no on-line computation, so a later strip meets the earlier ones in short
form. The points of some seconds of an earlier strip, a *patch*, share the errors of its orientation. The main
directions of these joint errors, with the variance they have after the solution of the block, become a few unknowns of
the window (their *modes*), ``p_i = p^_i + B_i s + e_i``; they enter when a point of the patch is seen again, with their
correlation with the modes and additional parameters that are present, and are marginalised when the window has passed.
What is left, ``e_i``, counts as independent from point to point. That costs about 1 % in RMSE of what becomes final
against an adjustment with all the equations, and nothing after the backward pass (``bench/efficiency.py block``).

Nothing is counted twice: what the later strip learnt about a patch is not handed back to it here, but when the block is
solved again with all the equations (`archive`); a patch that has left is closed for the rest of the strip.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.linearisation import Linearisation
from .archive import Archive, BlockSolution
from .batch import inverse_factors
from .block_solution import Parts
from .kept_points import KeptPoint
from .points import ControlPoint
from .state import WindowState

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Length of a patch along the strip, s.
PATCH_S = 10.0
#: Points from which the modes of a patch are made.
SAMPLED = 60
#: Modes whose variance is below this share of what the patch's points can tell about them are left out; modes at most.
NEGLIGIBLE, MOST_MODES = 0.05, 32
#: Modes in the window at most; while there are as many, points of further patches do not tie.
MOST_PRESENT = 240
#: What it costs to find the modes of a patch, for each of its points, in operations.
PATCH_COST = 4e6
#: Singular value, of the largest one, from which a point is determined in a direction.
DETERMINED = 1e-6
#: Variance of a mode given those present, at least: of what all but follows from them.
FLOOR = 1e-6


@dataclass
class Patch:
    """Points of some seconds of a strip.

    Attributes
    ----------
    strip : which
    place : among the patches
    modes : its rows in the joint covariance of all modes
    numbers : of its unknowns in the window, empty while they are not present
    used_s : newest ray that touched it
    closed : whether it has left
    """

    strip: str
    place: int
    modes: slice
    numbers: IntArray
    used_s: float = -np.inf
    closed: bool = False


@dataclass(frozen=True)
class EarlierPoint:
    """``p = xyz_l + modes @ s + e``, and ``root`` (3, 3) with ``root^T root`` the weight of e.

    ``single``: of one look, which says where the point is but along its ray; the last row of its root is zero.
    """

    patch: int
    xyz_l: Array
    modes: Array
    root: Array
    with_control: bool
    single: bool


@dataclass(frozen=True)
class TieRows:
    """Whitened equations of p points: ``design @ theta + point @ (xyz - origin) = residual``; three a point."""

    design: Array
    point: Array
    residual: Array
    active: Bools

    def joined(self, lin: Linearisation, point: IntArray) -> tuple[Linearisation, IntArray]:
        """With the observations of rays, as two more rays a point."""
        p = len(self.point)
        first, second = self.point[:, :2].transpose(1, 2, 0), np.zeros((2, 3, p))
        second[0] = self.point[:, 2].T
        rest = np.stack([self.residual[:, 2], np.zeros(p)])
        both = replace(
            lin,
            residual=np.concatenate([lin.residual, self.residual[:, :2].T, rest], axis=1),
            point=np.concatenate([lin.point, first, second], axis=2),
        )
        return both, np.concatenate([point, np.tile(np.arange(p), 2)])


@dataclass
class PointTies:
    """What earlier strips say of the p points of a batch.

    Attributes
    ----------
    columns : (m,) unknowns of the window that stand for earlier strips, the last ones of the batch
    xyz_l, modes, root : (p, 3), (p, 3, m), (p, 3, 3) see `EarlierPoint`
    control : (p, 3) weights of known coordinates, whether or not an earlier strip has used them
    active : (p,) False where the tie failed its test
    single : (p,) of one look
    """

    columns: IntArray
    xyz_l: Array
    modes: Array
    root: Array
    control: Array
    active: Bools
    single: Bools

    @property
    def placed(self) -> Bools:
        """Which points (p,) have a place from earlier strips."""
        return self.active & ~self.single

    @property
    def observations(self) -> IntArray:
        """How many each tie stands for (p,), active or not: that of a single look two."""
        return np.where(self.single, 2, 3)

    def rows(self, origin_l: Array, n_unknowns: int) -> TieRows:
        """Equations of all points, zero where they are not active."""
        root = np.where(self.active[:, None, None], self.root, 0.0)
        design = np.zeros((len(root), 3, n_unknowns))
        design[:, :, n_unknowns - len(self.columns) :] = -root @ self.modes
        return TieRows(design, root, np.einsum("pij,pj->pi", root, self.xyz_l - origin_l), self.active)


class EarlierStrips:
    """Points of the block as it was solved last, and which of their modes are in the window.

    Attributes
    ----------
    points : by name
    full : how often a point could not tie for want of room
    """

    def __init__(self, state: WindowState, camera_columns: IntArray) -> None:
        self.points: dict[str, EarlierPoint] = {}
        self.full = 0
        self._state, self._camera = state, camera_columns
        self._patches: list[Patch] = []
        self._covariance: list[Array] = []  # of the modes of each patch with those up to it, then of the parameters
        self._camera_values = np.zeros(len(camera_columns))

    @property
    def present(self) -> bool:
        """Whether modes are in the window."""
        return any(len(p.numbers) for p in self._patches)

    def learning(self, archive: Archive, solution: BlockSolution, without: Collection[str] = ()) -> Parts:
        """Take the points of a solution of the block in place of those known so far, which are forgotten at once.

        In parts, each with what it costs; before the last one nothing is known.

        Parameters
        ----------
        without : strips whose points are left out
        """
        self.points, self._patches, self._covariance = {}, [], []
        members: dict[tuple[str, int], list[tuple[str, KeptPoint]]] = {}
        order = {id: i for i, id in enumerate(archive.strips)}
        for name, kept in archive.points.items():
            if not kept.strips.isdisjoint(without):
                continue
            strip = max(kept.strips, key=order.__getitem__)
            part = int(kept.time_s // PATCH_S) if len(archive.strips[strip].entered) > 4 * MOST_MODES else 0
            members.setdefault((strip, part), []).append((name, kept))
        points: dict[str, EarlierPoint] = {}
        patches: list[Patch] = []
        functionals: list[tuple[IntArray, Array]] = []
        first = 0
        for (strip, _), kept in members.items():
            found, M = _patch(kept, solution)
            functionals.append(M)
            size = len(M[1])
            for (name, k), (xyz, B, root) in zip(kept, found, strict=True):
                points[name] = EarlierPoint(len(patches), xyz, B, root, k.with_control, k.single is not None)
            patches.append(Patch(strip, len(patches), slice(first, first + size), np.empty(0, dtype=np.int64)))
            first += size
            yield PATCH_COST * len(kept)
        functionals.append((solution.places(self._camera), np.eye(len(self._camera))))
        rows = []
        for row in _covariance_rows(functionals, solution.cofactors):
            rows.append(row)
            yield 2.0 * row.size * len(solution.numbers)
        self.points, self._patches = points, patches
        self._covariance = rows
        self._camera_values = solution.of(self._camera)[0]

    # -- in the window -------------------------------------------------------------------------------------------------

    def enter(self, name: str, time_s: float) -> bool:
        """Make the modes of a point's patch present; False where it cannot tie.

        Parameters
        ----------
        time_s : newest ray that will touch it
        """
        point = self.points.get(name)
        if point is None:
            return False
        patch = self._patches[point.patch]
        if patch.closed:
            return False
        if not len(patch.numbers):
            here = [p for p in self._patches if len(p.numbers)]
            m = patch.modes.stop - patch.modes.start
            if sum(len(p.numbers) for p in here) + m > MOST_PRESENT:
                self.full += 1
                return False
            patch.numbers = self._state.new_numbers(m)
            self._state.enter(patch.numbers)
            self._observe(patch, here)
        patch.used_s = max(patch.used_s, time_s)
        return True

    def _observe(self, patch: Patch, here: Sequence[Patch]) -> None:
        """What is known of modes that enter, given those present and the additional parameters."""
        groups = [*(p.place for p in here), len(self._patches), patch.place]
        S = self._joint(groups)
        m = patch.modes.stop - patch.modes.start
        given, own = np.arange(len(S) - m), np.arange(len(S) - m, len(S))
        numbers = np.concatenate([*(p.numbers for p in here), self._camera])
        scale = np.sqrt(np.maximum(S[given, given], 1e-300))
        known = S[np.ix_(given, given)] / scale[:, None] / scale + FLOOR * np.eye(len(given))
        K = np.linalg.solve(known, S[np.ix_(given, own)] / scale[:, None]).T / scale
        V = S[np.ix_(own, own)] - K @ S[np.ix_(given, own)]
        root = np.linalg.inv(np.linalg.cholesky(V + FLOOR * np.eye(len(own))))
        rows = np.concatenate([root, -root @ K], axis=1)
        value = -root @ K[:, len(given) - len(self._camera) :] @ self._camera_values
        columns = np.tile(np.concatenate([patch.numbers, numbers]), (len(own), 1))
        self._state.observe(columns.astype(np.int32), rows, value, np.ones(len(own)))

    def _joint(self, groups: Sequence[int]) -> Array:
        """Covariance of the modes of some patches; the additional parameters come after the last patch."""
        places = [p.modes for p in self._patches]
        last = places[-1].stop if places else 0
        places.append(slice(last, last + len(self._camera)))
        S = self._covariance
        return np.block([[S[a][:, places[b]] if b <= a else S[b][:, places[a]].T for b in groups] for a in groups])

    def ties(self, names: Sequence[str], control: Array) -> PointTies:
        """Of points whose patches are present; ``control`` (p, 3) are the weights of their known coordinates."""
        points = [self.points[name] for name in names]
        columns, starts = [], {}
        for patch in sorted({p.patch for p in points}):
            starts[patch] = sum(len(c) for c in columns)
            columns.append(self._patches[patch].numbers)
        numbers = np.concatenate(columns)
        modes = np.zeros((len(points), 3, len(numbers)))
        for i, p in enumerate(points):
            modes[i, :, starts[p.patch] : starts[p.patch] + p.modes.shape[1]] = p.modes
        return PointTies(
            numbers, np.array([p.xyz_l for p in points]), modes, np.array([p.root for p in points]), control,
            np.ones(len(points), dtype=bool), np.array([p.single for p in points]),
        )  # fmt: skip

    def with_control(self, names: Sequence[str]) -> Bools:
        """Which points have known coordinates in them already."""
        return np.array([self.points[n].with_control for n in names])

    def add_control(self, name: str, control: ControlPoint) -> bool:
        """Known coordinates of a point of an earlier strip that came late; whether they count in the window now."""
        point, weight = self.points.get(name), control.weight
        if point is None or point.with_control or not weight.any():
            return False
        own = point.root.T @ point.root
        N = own + np.diag(weight)
        if np.linalg.cond(N) > 1e12 or not self.enter(name, -np.inf):  # a single look, straight down
            return False
        axes = np.flatnonzero(weight > 0)
        root = point.root[: 2 if point.single else 3]
        given = np.sqrt(weight[axes])[:, None] * np.eye(3)[axes]
        design = np.concatenate([-root @ point.modes, np.zeros((len(axes), point.modes.shape[1]))])
        off = np.concatenate([np.zeros(len(root)), given @ (np.nan_to_num(control.xyz_l) - point.xyz_l)])
        rows, value = without_point(design, np.concatenate([root, given]), off)
        columns = np.tile(self._patches[point.patch].numbers, (len(rows), 1)).astype(np.int32)
        self._state.observe(columns, rows, value, np.ones(len(rows)))
        target = own @ point.xyz_l + weight * np.nan_to_num(control.xyz_l)
        self.points[name] = EarlierPoint(
            point.patch,
            np.linalg.solve(N, target),
            np.linalg.solve(N, own @ point.modes),
            np.linalg.cholesky(N).T,
            True,
            False,
        )
        return True

    def leaving(self, limit_s: float, used: Iterable[IntArray]) -> IntArray:
        """Modes that no batch in the window (columns of each) touches and none will; their patches are closed."""
        if not self.present:
            return np.empty(0, dtype=np.int64)
        busy = {int(c) for columns in used for c in columns}
        gone = []
        for patch in self._patches:
            if len(patch.numbers) and patch.used_s <= limit_s and int(patch.numbers[0]) not in busy:
                gone.append(patch.numbers)
                patch.numbers, patch.closed = np.empty(0, dtype=np.int64), True
        return np.concatenate(gone) if gone else np.empty(0, dtype=np.int64)


def _patch(
    kept: Sequence[tuple[str, KeptPoint]], solution: BlockSolution
) -> tuple[list[tuple[Array, Array, Array]], tuple[IntArray, Array]]:
    """Points of a patch as (place, modes, root of the weight of the rest), and the modes as functions (r, u) of the
    unknowns at places (u,) of the solution."""
    xyz, own, rows, white = [], [], [], []
    columns = np.unique(np.concatenate([k.left.columns for _, k in kept]))
    theta, Q = solution.of(columns)
    for _, k in kept:
        L = inverse_factors(k.left.normals)[k.place].T
        D = np.zeros((3, len(columns)))
        D[:, np.searchsorted(columns, k.left.columns)] = k.left.coupling[k.place]
        xyz.append(k.left.origin_l[k.place] + L @ (k.left.normals.y[:, k.place] - D @ theta))
        own.append(L @ L.T)
        rows.append(-L @ D)
        white.append(-D)
    P, noise = np.array(rows), np.array(own)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), SAMPLED)).astype(int))
    sample = np.concatenate([white[i] for i in chosen])
    values, vectors = np.linalg.eigh(sample @ Q @ sample.T)
    r = min(int((values * len(kept) / len(chosen) > NEGLIGIBLE).sum()), MOST_MODES)
    r = max(r, 1)
    M = (vectors[:, -r:] / np.sqrt(np.maximum(values[-r:], 1e-300))).T @ sample
    through = (P.reshape(-1, len(columns)) @ Q).reshape(P.shape)
    B = (through.reshape(-1, len(columns)) @ M.T).reshape(len(P), 3, r)
    rest = through @ np.swapaxes(P, 1, 2) + noise - B @ np.swapaxes(B, 1, 2)
    root = np.linalg.inv(np.linalg.cholesky(rest))
    for i in np.flatnonzero([k.single is not None for _, k in kept]):  # nothing is known along the ray
        values, vectors = np.linalg.eigh(root[i].T @ root[i])
        root[i] = np.sqrt(np.append(values[1:], 0.0))[:, None] * np.column_stack([vectors[:, 1:], vectors[:, 0]]).T
    own = columns >= 0  # drifts are of one strip alone
    return list(zip(xyz, B, root, strict=True)), (solution.places(columns[own]), M[:, own])


def without_point(design: Array, point: Array, residual: Array) -> tuple[Array, Array]:
    """What equations (m, u), (m, 3), (m,) of unit weight say when nothing is known of their point (r, u), (r,)."""
    U, s, _ = np.linalg.svd(point)
    left = U[:, int((s > DETERMINED * s[0]).sum()) :]
    return left.T @ design, left.T @ residual


def _covariance_rows(functionals: Sequence[tuple[IntArray, Array]], cofactors: Array) -> Iterator[Array]:
    """Covariance of linear functions: of each group with those up to it, (r, r1 + .. + r). Each is one of few unknowns,
    of their places (u,) in the cofactors (n, n), with coefficients (r, u)."""
    for i, (own, mine) in enumerate(functionals):
        half = mine @ cofactors[own]
        yield np.concatenate([half[:, places] @ M.T for places, M in functionals[: i + 1]], axis=1)
