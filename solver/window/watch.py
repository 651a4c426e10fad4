"""What watches over the window besides data snooping: integrity, sources that drift, determinability, the light."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..adjustment.determinability import Limits
from ..camera import LineCamera
from ..selfcalibration import SelfCalibration
from .batch import Batch, Information
from .compensation import Compensation
from .control import ControlDesk
from .determinability import Determinability, Standing, ranks
from .drift_border import Cell
from .ground import GroundBelow
from .integrity import Exposure, Integrity
from .lamp import Lamp
from .light import Situation
from .results import RefinedOrientation
from .settle import refused_control
from .sources import SourceMonitor
from .state import Marginal, WindowState
from .strip import WindowStrip
from .suspects import BiasedSource, Group

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Level of the tests of parameters on line; they are made again and again.
ALPHA = 0.01
#: Steps of the determinability test at one look before the first sweep is over, and time between two later on, s.
STEPS, STEP_EVERY_S = 2, 0.8


@dataclass(frozen=True)
class Watched:
    """The findings of one update.

    Attributes
    ----------
    light, reason : see `lamp`
    exposure : at the newest time, None without tie points
    time_s : of that
    sources : those that drift
    standing : of the additional parameters
    events : for the operator
    sigma, protection : (6,) of the newest orientation, m and rad
    ground_protection_m : (4,) of the same on the ground, see `ground`; none where it is not known
    alert_limit_m : what these stay below if the light is good; inf before the ground is seen
    """

    light: str
    reason: str
    exposure: Exposure | None
    time_s: float
    sources: tuple[BiasedSource, ...]
    standing: tuple[Standing, ...]
    events: tuple[str, ...]
    sigma: Array
    protection: Array
    ground_protection_m: Array
    alert_limit_m: float

    @property
    def names(self) -> frozenset[Group]:
        """The sources that drift, or may be the one that does."""
        return frozenset(name for s in self.sources for name in s.suspects)


@dataclass(frozen=True)
class _Count:
    """Of a batch, as long as its information is this: points of which nothing is left, points of two rays or more,
    control coordinates (3,) in use, control points of which nothing is left."""

    information: Information
    refused: int
    tied: int
    has_control: bool
    control: Array
    control_refused: int


def middle(orientation: RefinedOrientation) -> float:
    """The time whose exposure stands for all."""
    return float(orientation.time_s[len(orientation.time_s) // 2])


class Watch:
    """Looks at the window after its updates; what costs much is spread over updates.

    Parameters
    ----------
    determine : whether it is tested which additional parameters are determined
    alert_limit_m : of the light; 0 = see `ground`
    control : judges control, and is told what leaves
    sources : watches for tie points that drift

    Attributes
    ----------
    exposure : of the newest orientation
    last : the findings of the last look, without its events
    strip : that was flown at the last look, "" for none
    """

    def __init__(
        self,
        camera: LineCamera,
        critical: float,
        self_calibration: SelfCalibration | None,
        camera_columns: IntArray,
        state: WindowState,
        determine: bool,
        control: ControlDesk,
        sources: SourceMonitor,
        alert_limit_m: float = 0.0,
    ) -> None:
        self._integrity = Integrity(critical)
        self._control, self._sources, self._state = control, sources, state
        self._pitch = float(np.median(np.linalg.norm(np.diff(camera.lines[0].xy_mm[:2], axis=0), axis=1)))
        self._focal = float(camera.focal_length_mm[0])
        self._determinability: Determinability | None = None
        if self_calibration is not None and determine:
            nadir = min(camera.lines, key=lambda line: abs(float(line.centre_mm[0]))).id
            order = ranks(self_calibration, nadir)
            self._determinability = Determinability(self_calibration, camera_columns, order, Limits(alpha=ALPHA))
        self._next_step_s = -np.inf
        self._ground, self._limit_m, self._lamp = GroundBelow(camera), alert_limit_m, Lamp()
        self._counts: dict[int, _Count] = {}
        self.exposure: Exposure | None = None
        self.last: Watched | None = None
        self.strip = ""

    @property
    def most_exposed(self) -> Batch | None:
        """The batch to be tested before all others, if it is in the window."""
        return self._integrity.most_exposed

    def drop(self, batch: Batch) -> None:
        """A batch is taken apart."""
        self._integrity.drop(batch)

    def note(self, batches: list[Batch]) -> None:
        """Batches have been judged."""
        self._integrity.note(batches)

    def leaving(self, batches: list[Batch], before_s: float) -> None:
        """Batches leave the window; what left before a time is forgotten."""
        self._integrity.note(batches)
        self._integrity.leave(batches, self._state, before_s)
        self._control.leaving(batches, self._sources.leave(batches, self._state))

    def marginalised(self, marginal: Marginal) -> None:
        """Unknowns have left the window."""
        self._integrity.marginalised(marginal)
        self._control.marginalised(self._sources.marginalised(marginal))

    def became_final(self, strip: WindowStrip, orientation: RefinedOrientation) -> Exposure | None:
        """Orientation has become final; returns how exposed the middle of its times is."""
        protection = None
        exposure = self.exposure_at(strip, middle(orientation), ground=True)
        if exposure is not None and (ground := self._ground.ground) is not None:
            protection = exposure.ground_protection(ground.sigma_m(orientation.covariance))
        self._lamp.became_final(strip.id, len(orientation.time_s), protection, self.alert_limit_m)
        return exposure

    @property
    def alert_limit_m(self) -> float:
        """See `Watched`."""
        ground = self._ground.ground
        return self._limit_m or (np.inf if ground is None else ground.limit_m)

    def exposure_at(
        self, strip: WindowStrip, time_s: float, renew: bool = False, ground: bool = False
    ) -> Exposure | None:
        """Exposure of the orientation at a time of a strip, and on the ground; None if its unknowns are not there."""
        numbers, A = _functions(strip, time_s)
        if not len(numbers) or (self._state.places(numbers) < 0).any():
            return None
        below = self._ground.ground if ground else None
        if below is not None:
            A = np.concatenate([A, below.functions @ A])
        return self._integrity.at(numbers, A, self._state, renew)

    def look(
        self,
        now_s: float,
        length_s: float,
        strip: WindowStrip | None,
        batches: list[Batch],
        sigma0: float,
        redundancy: int,
        total: tuple[float, int],
        apriori_m: Array,
        noise: Array,
    ) -> Watched:
        """Findings of an update.

        Parameters
        ----------
        strip : the newest one, None if all are over
        batches : of the window
        sigma0, redundancy, total : over the window, since the start
        apriori_m : (3,) sigma of the position beforehand
        noise : (6, 6) covariance of the noise that is on the newest orientation
        """
        time_s = -np.inf
        self.strip = "" if strip is None else strip.id
        self.exposure = None
        ground = self._ground.look(batches)
        if strip is not None and batches:
            time_s = min(now_s, strip.end_s)
            self.exposure = self.exposure_at(strip, time_s, renew=True, ground=True)
        drift = self._drift_covariance(strip if self.exposure is not None else None, time_s, batches)
        ground_m = ground_sigma_m = None
        if self.exposure is not None and ground is not None:
            ground_sigma_m = np.hypot(self.exposure.ground_sigma, ground.sigma_m(noise + drift))
            ground_m = self.exposure.ground_protection(ground_sigma_m)
        if self._sources.begin(batches, self._state):
            self._control.strip_began()
        self._sources.update(now_s, batches, self._state)
        events: list[str] = []
        d = self._determinability
        if d is not None:
            for _ in range(int(now_s >= self._next_step_s) if d.swept else STEPS):
                self._next_step_s = now_s + STEP_EVERY_S - 1e-6
                events += d.step(self._state, batches, total[0], total[1], self._gsd(batches))
        self._counts = {id(b): self._count_of(b) for b in batches}
        points = sum(b.n_points for b in batches)
        refused = sum(c.refused for c in self._counts.values())
        tied = sum(c.tied for c in self._counts.values())
        known = [c for c in self._counts.values() if c.has_control]
        control = sum((c.control for c in known), np.zeros(3))
        control_refused = sum(c.control_refused for c in known)
        since_s = now_s - strip.model.extent.start_s if strip is not None else 0.0
        colour, reason = self._lamp.look(
            now_s,
            Situation(
                strip is not None, length_s, since_s, sigma0, redundancy, points, refused, control_refused, control,
                apriori_m, self.exposure, self._sources.biased, strip=self.strip, tied=tied,
                ground_m=ground_m, ground_sigma_m=ground_sigma_m, limit_m=self.alert_limit_m,
                control_doubt=self._control.doubt, control_failed=self._control.failed,
            ),
        )  # fmt: skip
        standing = tuple(d.standing()) if d is not None else ()
        sigma = np.zeros(6)
        if self.exposure is not None:
            sigma = np.sqrt(self.exposure.sigma**2 + np.diagonal(drift))
        protection = sigma if self.exposure is None else self.exposure.protection(sigma)
        found = Watched(
            colour, reason, self.exposure, time_s, self._sources.biased, standing, (), sigma, protection,
            np.empty(0) if ground_m is None else ground_m, self.alert_limit_m,
        )  # fmt: skip
        self.last = found
        return replace(found, events=tuple(events))

    def compensation(self, batches: Iterable[Batch]) -> Compensation | None:
        """What tie points that drift do to the solution; None without an alarm."""
        return self._sources.compensation(batches, self._state)

    def on_points(self, batch: Batch, drift: Compensation | None) -> tuple[Array, Array] | None:
        """What a compensation does to the points of a batch (p, 3) and their covariance (p, 3, 3)."""
        return None if drift is None else self._sources.on_points(batch, self._state, drift)

    def cells(self, batches: list[Batch]) -> dict[int, Cell]:
        """What drifts have to do with batches, by identity."""
        return self._sources.cells(batches, self._state)

    def cell_of_single(self, batch: Batch) -> Cell | None:
        """The same of a batch of points with one look each."""
        return self._sources.cell_of_single(batch, self._state)

    def _drift_covariance(self, strip: WindowStrip | None, time_s: float, batches: list[Batch]) -> Array:
        """(6, 6) of the orientation at a time, for tie points that drift."""
        drift = self.compensation(batches) if strip is not None else None
        if strip is None or drift is None:
            return np.zeros((6, 6))
        numbers, A = _functions(strip, time_s)
        return drift.change(A, self._state.places(numbers))[1]

    def _count_of(self, batch: Batch) -> _Count:
        """Anew only if the batch has changed."""
        count = self._counts.get(id(batch))
        if count is not None and count.information is batch.information:
            return count
        rays = np.bincount(batch.rays.point, batch.weight > 0, batch.n_points)
        kept, tied = rays > 0, int((rays >= 2).sum())
        control = ((batch.control.weight > 0) & kept[:, None]).sum(axis=0)
        refused = batch.n_points - int(kept.sum())
        return _Count(batch.information, refused, tied, bool(batch.active_control), control, refused_control(batch))

    def _gsd(self, batches: list[Batch]) -> float:
        if not batches:
            return 1.0
        rays = batches[-1].rays
        height = np.abs(rays.position_l[:, 2] - batches[-1].points_l[rays.point, 2])
        return float(np.median(height)) * self._pitch / self._focal


def _functions(strip: WindowStrip, time_s: float) -> tuple[IntArray, Array]:
    """The orientation at a time of a strip as functions (6, u) of unknowns, and their numbers (u,)."""
    design = strip.design([time_s])
    numbers = np.unique(design.columns)
    numbers = numbers[numbers >= 0].astype(np.int64)
    A = np.zeros((6, len(numbers) + 1))
    local = np.where(design.columns[0] >= 0, np.searchsorted(numbers, design.columns[0]), len(numbers))
    A[np.arange(6), local] += design.coefficients[0][:, None]
    return numbers, A[:, :-1]
