"""What a trajectory model is: correction functions, linear in their unknowns, of one correction set.

A correction set is what shares one set of correction functions: a strip, or a lens of a strip where the lenses look
separately. A model answers one question, "for these ray times, which columns with which coefficients", and states its
a-priori knowledge as weighted observations of its unknowns. A new model is one new module in this package that defines
a `ModelOptions` subclass; nothing else has to know about it.

Order of the six corrections everywhere: X, Y, Z (metres), omega, phi, kappa (radians).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]
IntArray = NDArray[np.int32]

#: Names of the six corrections, in order.
COMPONENTS = ("X", "Y", "Z", "omega", "phi", "kappa")


@dataclass(frozen=True)
class Extent:
    """What a model needs to know of the correction set it is built for.

    Attributes
    ----------
    name : words for names of unknowns, "strip S2" or "strip S2, lens L1"
    start_s, end_s : extent of the measured trajectory
    ray_time_s, control_time_s : times of the rays, and of those to control points, in any order, for models that place
        segments or merge fixes by them
    self_calibration : whether additional parameters are estimated in the same adjustment
    strip : name of the strip alone
    """

    name: str
    start_s: float
    end_s: float
    ray_time_s: Array = field(default_factory=lambda: np.empty(0), repr=False)
    control_time_s: Array = field(default_factory=lambda: np.empty(0), repr=False)
    self_calibration: bool = False
    strip: str = ""

    def __post_init__(self) -> None:
        if not self.end_s > self.start_s:
            raise ValueError(f"{self.name}: trajectory ends at {self.end_s} s, starts at {self.start_s} s")


@dataclass(frozen=True)
class Design:
    """Corrections of n rays as linear forms: component c of ray i is ``sum_k coefficients[i,k] theta[columns[i,k,c]]``.

    Attributes
    ----------
    columns : (n, k, 6) int32; -1 where a component has no such unknown
    coefficients : (n, k)
    """

    columns: IntArray
    coefficients: Array

    def evaluate(self, theta: ArrayLike) -> Array:
        """Corrections (n, 6) for unknowns (n_unknowns,)."""
        padded = np.append(np.asarray(theta, dtype=float), 0.0)  # column -1 reads the zero
        return np.einsum("nk,nkc->nc", self.coefficients, padded[self.columns])

    def part(self, which: slice) -> Design:
        """That of some of the rays."""
        return Design(self.columns[which], self.coefficients[which])

    def joined(self, other: Design, numbers: NDArray[np.int64]) -> Design:
        """With the corrections of another one of the same rays, whose columns are places in ``numbers``."""
        own = np.where(other.columns >= 0, numbers[other.columns], -1).astype(np.int32)
        columns = np.concatenate([self.columns, own], axis=1)
        return Design(columns, np.concatenate([self.coefficients, other.coefficients], axis=1))

    def unknowns(self) -> NDArray[np.int64]:
        """The unknowns (u,) that the corrections depend on, ascending."""
        numbers = np.unique(self.columns)
        return numbers[numbers >= 0].astype(np.int64)

    def functions(self) -> tuple[NDArray[np.int64], Array]:
        """The same, and the corrections as linear functions (n, 6, u) of them."""
        numbers = self.unknowns()
        n, u = len(self.columns), len(numbers)
        local = np.where(self.columns >= 0, np.searchsorted(numbers, self.columns), u)
        A = np.zeros((n, 6, u + 1))
        A[np.arange(n)[:, None, None], np.arange(6), local] += self.coefficients[:, :, None]
        return numbers, A[:, :, :-1]


@dataclass(frozen=True)
class PseudoObservations:
    """A-priori knowledge: m observations ``sum_t coefficients[m,t] theta[columns[m,t]] = value[m]`` with ``sigma[m]``.

    Attributes
    ----------
    columns : (m, t) int32; -1 absent
    coefficients : (m, t)
    value, sigma : (m,) in the unit of the linear form; an infinite sigma carries no weight and does not count
    labels : (m,) in words, "C0 of kappa at border 2 of strip S1"
    """

    columns: IntArray
    coefficients: Array
    value: Array
    sigma: Array
    labels: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.value)


#: Groups of slow errors whose a-priori sigmas are right or wrong together: what is constant over a strip, or drifts
#: over it, and what wanders.
OFFSET, SHIFT, POSITION_WANDER, ATTITUDE_WANDER = range(4)
CONSTANT, WANDERS = (OFFSET, SHIFT), (POSITION_WANDER, ATTITUDE_WANDER)
ERROR_GROUPS = ("offset", "shift and drift", "wander of position", "wander of attitude")
_ANGLES = ("omega", "phi", "kappa")


def error_groups(labels: Sequence[str]) -> NDArray[np.int64]:
    """Group (m,) of each a-priori equation, by the words of its label: a place in `ERROR_GROUPS`."""
    groups = np.empty(len(labels), dtype=np.int64)
    for i, label in enumerate(labels):
        words = label.partition(" of strip")[0]
        angle = any(name in words for name in _ANGLES)
        constant = any(word in words for word in ("offset", "shift", "drift"))
        groups[i] = angle if constant else POSITION_WANDER + angle
    return groups


def direct_observations(sigma: ArrayLike, labels: tuple[str, ...]) -> PseudoObservations:
    """Every unknown observed as zero with its sigma (n,)."""
    s = np.asarray(sigma, dtype=float)
    if not (s > 0).all():
        raise ValueError(f"a-priori sigma must be positive; {labels[int(np.argmin(s > 0))]} has {s[~(s > 0)][0]}")
    n = len(s)
    columns = np.arange(n, dtype=np.int32)[:, None]
    return PseudoObservations(columns, np.ones((n, 1)), np.zeros(n), s, labels)


def join_observations(parts: list[PseudoObservations]) -> PseudoObservations:
    """Stack pseudo-observations of the same unknowns."""
    shape = sum(len(part.columns) for part in parts), max(part.columns.shape[1] for part in parts)
    columns, coefficients = np.full(shape, -1, dtype=np.int32), np.zeros(shape)
    row = 0
    for part in parts:
        m, width = part.columns.shape
        columns[row : row + m, :width] = part.columns
        coefficients[row : row + m, :width] = part.coefficients
        row += m
    return PseudoObservations(
        columns,
        coefficients,
        np.concatenate([p.value for p in parts]),
        np.concatenate([p.sigma for p in parts]),
        tuple(label for p in parts for label in p.labels),
    )


class CorrectionModel(ABC):
    """Correction functions of one correction set. Unknowns are columns 0 .. n_unknowns - 1.

    Attributes
    ----------
    extent : what the model was built for
    unknown_names : (n_unknowns,) in words, "kappa drift of strip S2"
    notes : remarks for the report (the meaning of ``s``, merged fixes)
    """

    extent: Extent
    unknown_names: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def n_unknowns(self) -> int:
        return len(self.unknown_names)

    @abstractmethod
    def design(self, time_s: ArrayLike) -> Design:
        """Columns and coefficients for times (n,); times outside the extent are extrapolated."""

    @abstractmethod
    def pseudo_observations(self) -> PseudoObservations:
        """A-priori weights and continuity constraints."""

    @abstractmethod
    def describe(self, theta: ArrayLike, sigma: ArrayLike) -> dict[str, object]:
        """The unknowns (n_unknowns,) and their sigmas as the result file shows them (metres, degrees)."""

    def evaluate(self, theta: ArrayLike, time_s: ArrayLike) -> Array:
        """Corrections (n, 6) at times (n,), metres and radians."""
        return self.design(time_s).evaluate(theta)

    def left_out_variance(self, time_s: ArrayLike) -> Array:
        """Variance (n, 6) of what the model cannot follow at times (n,), m^2 and rad^2; 0 where it does not know."""
        return np.zeros((np.size(time_s), 6))

    def design_and_left_out(self, time_s: ArrayLike) -> tuple[Design, Array]:
        """`design` and `left_out_variance` of times (n,), which have work in common."""
        return self.design(time_s), self.left_out_variance(time_s)


class ModelOptions(ABC):
    """Settings of a model; builds one `CorrectionModel` per correction set.

    Attributes
    ----------
    name : how the command line calls the model
    """

    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def from_settings(cls, settings: Mapping[str, object]) -> Self:
        """From the ``[trajectory]`` table of a block folder plus ``segments``/``fixes``; unknown keys are not ours."""

    @abstractmethod
    def build(self, extent: Extent) -> CorrectionModel: ...


def same(value: float) -> tuple[float, float, float]:
    """One number for three axes."""
    return (value, value, value)


def three(
    settings: Mapping[str, object], key: str, default: tuple[float, float, float], *, zeros: bool = False
) -> tuple[float, float, float]:
    """Three numbers from settings, positive or with ``zeros`` not negative; one number stands for all three.

    Raises
    ------
    ValueError : naming the key
    """
    value = settings.get(key, default)
    try:
        numbers = np.broadcast_to(np.asarray(value, dtype=float), (3,))
    except (TypeError, ValueError):
        raise ValueError(f"{key}: wanted three numbers, got {value!r}") from None
    if not ((numbers >= 0) if zeros else (numbers > 0)).all():
        raise ValueError(
            f"{key}: wanted three {'numbers of at least 0' if zeros else 'positive numbers'}, got {value!r}"
        )
    return (float(numbers[0]), float(numbers[1]), float(numbers[2]))
