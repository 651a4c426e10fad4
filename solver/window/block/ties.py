"""What the strips flown so far say of points that a later strip sees again.

To solve the block anew with every tie point is no on-line computation, so a later strip meets the earlier ones in short
form. The points of some seconds of an earlier strip, a *patch*, share the errors of its orientation. The main
directions of these joint errors, with the variance they have after the solution of the block, become a few unknowns of
the window (their *modes*), ``p_i = p^_i + B_i s + e_i``; they enter when a point of the patch is seen again, with their
correlation with the modes and additional parameters that are present, and are marginalised when the window has passed.
What is left, ``e_i``, counts as independent from point to point. That costs about 1 % in RMSE of what becomes final
against an adjustment with all the equations, and nothing after the backward pass (``bench/efficiency.py block``).

Nothing is counted twice: what the later strip learns about a patch goes back to it not here, but when the block is
solved again with all the equations (`archive`); a patch that has left is closed for the rest of the strip.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...adjustment.eliminated_points import EliminatedPoints, eliminated, spread
from ...adjustment.frontal import Root
from ...adjustment.in_parts import Parts
from ...arrays import Array, IntArray
from ..state.batch import PointTies
from ..state.points import ControlPoint
from ..state.unknowns import Information, WindowState
from .archive import PLACED, Archive
from .points import KeptPoint
from .solution import BlockSolution

#: Length of a patch along the strip, s. Tuned: the errors of the orientation hardly change within it.
PATCH_S = 10.0
#: Points of a patch, at most, from which its modes are computed. Tuned.
SAMPLED = 60
#: Least variance of a mode, in units of what one point of the patch tells about it divided by their number: one that
#: all points together would hardly notice is left out. Tuned.
NEGLIGIBLE = 0.05
#: Modes of a patch, and modes in the window, at most; with so many, points of further patches do not tie. They bound
#: the time of an update. Tuned.
MOST_MODES, MOST_PRESENT = 32, 240
#: Strips, the newest ones, that the next one is likely to be beside: what it will want of them is computed in the turn.
#: Of others it is computed when a point of theirs is seen. Tuned.
PREPARED = 2
#: Cost of finding the modes of a patch, for each of its points, in floating point operations, about: of its own, and of
#: each unknown of the block.
PATCH_COST, COST_OF_UNKNOWN = 4e6, 600.0
#: Least variance of a mode given those present, as a share of its own: some modes all but follow from others.
FLOOR = 1e-6


@dataclass
class Patch:
    """Points of some seconds of a strip.

    Attributes
    ----------
    strip : where its points were seen last
    members : these, by name, as they were when the block was solved
    modes : functions (r, u) of unknowns with numbers (u,); None until somebody wants them
    root : of the modes, while they are present
    numbers : of its modes in the window, empty while they are not present
    used_s : time of the newest ray that touched it
    closed : whether its modes have left the window
    """

    strip: str
    members: dict[str, KeptPoint] = field(default_factory=dict)
    modes: tuple[IntArray, Array] | None = None
    root: Root | None = None
    numbers: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    used_s: float = -np.inf
    closed: bool = False


@dataclass(frozen=True)
class EarlierPoint:
    """``p = xyz_l + modes @ s + e``, and ``root`` (3, 3) with ``root^T root`` the weight of e.

    ``single``: of one look, which says where the point is but along its ray; the last row of its root is zero.
    """

    patch: Patch
    xyz_l: Array
    modes: Array
    root: Array
    with_control: bool
    single: bool


class EarlierStrips:
    """Points of the block as it was solved last, and which of their modes are in the window.

    Attributes
    ----------
    full : how often a point could not tie because there were too many modes in the window
    """

    def __init__(self, state: WindowState, shared_columns: IntArray) -> None:
        self.full = 0
        self._state, self._shared = state, shared_columns
        self._solution: BlockSolution | None = None
        self._patches: list[Patch] = []  # those of the oldest strips first
        self._newest: list[str] = []
        self._patch_of: dict[str, Patch] = {}
        self._points: dict[str, EarlierPoint] = {}  # of patches whose modes are known
        self._shared_root: Root | None = None
        self._shared_values: Array = np.zeros(len(shared_columns))

    def __len__(self) -> int:
        """Points that a later strip may see again."""
        return len(self._patch_of)

    def has_control(self, name: str) -> bool:
        """Whether known coordinates count in a point already."""
        patch, point = self._patch_of.get(name), self._points.get(name)
        if patch is None:
            return False
        return bool(patch.members[name].control.any()) if point is None else point.with_control

    @property
    def present(self) -> bool:
        """Whether modes are in the window."""
        return any(True for _ in self._here())

    def _here(self) -> Iterator[Patch]:
        """Patches whose modes are in the window."""
        return (patch for patch in self._patches if len(patch.numbers))

    def forget(self) -> None:
        """Nothing is known of earlier strips."""
        self._solution, self._shared_root = None, None
        self._patches, self._patch_of, self._points = [], {}, {}

    def learn(self, archive: Archive, solution: BlockSolution, without: Collection[str] = ()) -> None:
        """Take the points of a solution of the block in place of those known so far.

        Parameters
        ----------
        without : strips whose points are left out
        """
        self.forget()
        patches: dict[tuple[str, int], Patch] = {}
        order = {id: i for i, id in enumerate(archive.strips)}
        for name, kept in archive.points.items():
            if kept.strips.isdisjoint(without) and not kept.unplaced:
                strip = max(kept.strips, key=order.__getitem__)
                part = int(kept.time_s // PATCH_S) if len(archive.strips[strip].entered) > 4 * MOST_MODES else 0
                patch = patches.setdefault((strip, part), Patch(strip))
                patch.members[name] = replace(kept)  # as it is now: the block goes on
                self._patch_of[name] = patch
        self._patches = list(patches.values())
        self._newest = sorted({patch.strip for patch in self._patches}, key=order.__getitem__)[-PREPARED:]
        self._solution = solution
        self._shared_root = solution.rooted(self._shared, np.eye(len(self._shared)))
        self._shared_values = solution.values_of(self._shared)

    def preparing(self) -> Parts:
        """Find the modes of patches of the newest strips before somebody wants them; in parts."""
        for patch in self._patches[::-1]:  # where the next strip begins if it has the other direction
            if patch.strip in self._newest and patch.modes is None:
                self._find_modes(patch)
                unknowns = 0 if self._solution is None else len(self._solution.numbers)
                yield (PATCH_COST + COST_OF_UNKNOWN * unknowns) * len(patch.members)

    def _find_modes(self, patch: Patch) -> tuple[IntArray, Array]:
        if patch.modes is None:
            assert self._solution is not None
            found, patch.modes = _modes(patch, self._solution)
            self._points |= zip(patch.members, found, strict=True)
        return patch.modes

    # -- in the window -------------------------------------------------------------------------------------------------

    def enter(self, name: str, time_s: float) -> bool:
        """Make the modes of a point's patch present; False where it cannot tie.

        Parameters
        ----------
        time_s : newest ray that will touch it
        """
        patch = self._patch_of.get(name)
        if patch is None or patch.closed:
            return False
        if not len(patch.numbers):
            columns, functions = self._find_modes(patch)
            here = list(self._here())
            if sum(len(p.numbers) for p in here) + len(functions) > MOST_PRESENT:
                self.full += 1
                return False
            assert self._solution is not None
            patch.root = self._solution.rooted(columns, functions)
            patch.numbers = self._state.new_numbers(len(functions))
            self._state.enter(patch.numbers)
            self._observe(patch, here)
        patch.used_s = max(patch.used_s, time_s)
        return True

    def _observe(self, patch: Patch, here: Sequence[Patch]) -> None:
        """What is known of modes that enter, given those present and the additional parameters."""
        roots = [root for root in (*(p.root for p in here), self._shared_root, patch.root) if root is not None]
        S = np.block([[a.joint(b) for b in roots] for a in roots])
        m = len(patch.numbers)
        given, own = np.arange(len(S) - m), np.arange(len(S) - m, len(S))
        scale = np.sqrt(np.maximum(S[given, given], 1e-300))
        known = S[np.ix_(given, given)] / scale[:, None] / scale + FLOOR * np.eye(len(given))
        K = np.linalg.solve(known, S[np.ix_(given, own)] / scale[:, None]).T / scale
        V = S[np.ix_(own, own)] - K @ S[np.ix_(given, own)]
        root = np.linalg.inv(np.linalg.cholesky(V + FLOOR * np.eye(m)))
        rows = np.concatenate([root, -root @ K], axis=1)
        value = -root @ K[:, len(given) - len(self._shared) :] @ self._shared_values
        columns = np.concatenate([patch.numbers, *(p.numbers for p in here), self._shared])
        self._state.observe(np.tile(columns, (m, 1)).astype(np.int32), rows, value, np.ones(m))

    def ties(self, names: Sequence[str], control: Array) -> PointTies:
        """Of points whose patches are present; ``control`` (p, 3) are the weights of their known coordinates."""
        points = [self._points[name] for name in names]
        own = {int(p.patch.numbers[0]): p.patch.numbers for p in points}
        numbers = np.concatenate([own[first] for first in sorted(own)])
        modes = np.zeros((len(points), 3, len(numbers)))
        for i, p in enumerate(points):
            modes[i][:, np.isin(numbers, p.patch.numbers)] = p.modes
        return PointTies(
            numbers, np.array([p.xyz_l for p in points]), modes, np.array([p.root for p in points]), control,
            np.ones(len(points), dtype=bool), np.array([p.single for p in points]),
            np.array([p.with_control for p in points]),
        )  # fmt: skip

    def add_control(self, name: str, control: ControlPoint) -> bool:
        """Known coordinates of a point of an earlier strip that came late; whether they count in the window now."""
        patch, weight = self._patch_of.get(name), np.diag(control.weight)
        if patch is None or not weight.any():
            return False
        self._find_modes(patch)
        point = self._points[name]
        if point.with_control:
            return False
        # a single look, straight down, does not say where the point is
        if np.linalg.cond(point.root.T @ point.root + weight) > PLACED or not self.enter(name, -np.inf):
            return False
        numbers, root = patch.numbers, point.root[: 2 if point.single else 3]
        rows = numbers, -root @ point.modes, root, np.zeros(len(root))
        placed, matrix, rhs, square = eliminated([rows], weight, np.nan_to_num(control.xyz_l), point.xyz_l)
        told = Information(matrix, rhs, square, len(root) + int(np.count_nonzero(weight)) - 3)
        self._state.add(numbers, told)
        self._state.fix(numbers, told)
        (factor,), (y,), (D,) = placed.factor, placed.y, placed.coupling
        xyz_l, root = point.xyz_l + factor.T @ y, np.linalg.inv(factor).T
        self._points[name] = EarlierPoint(patch, xyz_l, -factor.T @ D, root, with_control=True, single=False)
        return True

    def leaving(self, limit_s: float, used: Iterable[IntArray]) -> IntArray:
        """Modes that no batch in the window (columns of each) touches and none will; their patches are closed."""
        none = np.empty(0, dtype=np.int64)
        old = [patch for patch in self._here() if patch.used_s <= limit_s]
        if not old:
            return none
        busy = np.isin([patch.numbers[0] for patch in old], np.concatenate([none, *used]))
        gone = [none]
        for patch in (patch for patch, needed in zip(old, busy, strict=True) if not needed):
            gone.append(patch.numbers)
            patch.numbers, patch.root, patch.closed = none, None, True
        return np.concatenate(gone)


def _modes(patch: Patch, solution: BlockSolution) -> tuple[list[EarlierPoint], tuple[IntArray, Array]]:
    """Points of a patch, and its modes as functions (r, u) of unknowns with numbers (u,)."""
    kept = list(patch.members.values())
    columns = np.unique(np.concatenate([k.functions.columns for k in kept]))
    theta, Q = solution.of_any(columns)
    own = [(k.functions, k.place) for k in kept]
    D = np.array([spread(f.coupling[i], f.columns, columns) for f, i in own])
    origin, factor, y = (np.array(v) for v in zip(*((f.origin_l[i], f.factor[i], f.y[i]) for f, i in own), strict=True))
    through = (D.reshape(-1, len(columns)) @ Q).reshape(D.shape)
    xyz_l, covariance = EliminatedPoints(columns, origin, factor, y, D).given(theta, through)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), SAMPLED)).astype(int))
    sample, sample_through = (-half[chosen].reshape(-1, len(columns)) for half in (D, through))
    values, vectors = np.linalg.eigh(sample_through @ sample.T)
    r = max(min(int((values * len(kept) / len(chosen) > NEGLIGIBLE).sum()), MOST_MODES), 1)
    main = (vectors[:, -r:] / np.sqrt(np.maximum(values[-r:], 1e-300))).T
    M = main @ sample
    B = -np.swapaxes(factor, 1, 2) @ D @ (main @ sample_through).T
    root = np.linalg.inv(np.linalg.cholesky(covariance - B @ np.swapaxes(B, 1, 2)))
    for i in np.flatnonzero([k.single is not None for k in kept]):  # nothing is known along the ray
        weight, axes = np.linalg.eigh(root[i].T @ root[i])
        root[i] = np.sqrt(np.append(weight[1:], 0.0))[:, None] * np.column_stack([axes[:, 1:], axes[:, 0]]).T
    found = [
        EarlierPoint(patch, xyz_l[i], B[i], root[i], bool(k.control.any()), k.single is not None)
        for i, k in enumerate(kept)
    ]
    shared = columns >= 0  # drifts are of one strip alone
    return found, (columns[shared], M[:, shared])
