"""What the window says: orientation and points with covariance, sigma0 over its length, parameters."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..adjustment.layout import SURFACE_SHIFT
from ..adjustment.pose_noise import of_vibration
from ..arrays import Array, IntArray
from ..camera.self_calibration import unit_of
from ..geometry.rotation import corrected_angles, matrix_from_angles
from ..geometry.trajectory import Poses
from ..models.base import COMPONENTS
from .datum.drift_monitor import DriftMonitor
from .datum.drifts import Compensation
from .quality.determinability import ESTIMATED, NOT_YET, Standing
from .quality.light import Fit, QualityFindings
from .results import AdjustedPoint, Parameter, RayResidual, RefinedOrientation, Update, checks
from .state.batch import Batch
from .state.network import LiveNetwork
from .state.strip import TIMES_AT_ONCE, WindowStrip

#: After sigmas have changed sigma0 is told again when this share of the window's length has passed. Tuned.
LEAST_SHARE = 0.5
#: Sigma of a strip's parameter, in units of the a-priori one, from which the observations know it better.
BETTER = 0.7


@dataclass(frozen=True)
class WindowReport(Fit):
    """Figures of one update, beside how well observations and sigmas agree.

    Attributes
    ----------
    observations, unknowns : in the window, what was marginalised counting as one observation an unknown
    start_s, end_s : orientation before the start is final; newest ray
    quality : light, protection levels and sources that drift
    """

    observations: int
    unknowns: int
    iterations: int
    start_s: float
    end_s: float
    rays: int
    points: int
    control: int
    strip: str
    parameters: tuple[Parameter, ...]
    quality: QualityFindings


@dataclass
class WindowUpdate(Update):
    """What one update gave, with its report."""

    report: WindowReport | None = None


class OrientationOutput:
    """Refined orientation at any time, and points; keeps the cofactors of the unknowns asked for last.

    Parameters
    ----------
    sources : says what tie points that drift do to the solution
    """

    def __init__(self, network: LiveNetwork, sources: DriftMonitor) -> None:
        self._network, self._sources = network, sources
        self._drift: Compensation | None = None
        self._drift_is_known = False
        self._columns: IntArray = np.empty(0, dtype=np.int64)
        self._cofactors: Array | None = None

    def forget(self) -> None:
        """The state has changed."""
        self._cofactors, self._drift_is_known = None, False

    @property
    def drift(self) -> Compensation | None:
        """What tie points that drift do to the solution."""
        if not self._drift_is_known:
            self._drift, self._drift_is_known = self._sources.compensation(), True
        return self._drift

    def at(self, strip: WindowStrip, times: Array) -> RefinedOrientation:
        """Orientation at times (n,) that have a measured one."""
        measured = self._network.trajectory.at(times)
        chunks = [slice(i, i + TIMES_AT_ONCE) for i in range(0, len(times), TIMES_AT_ONCE)]
        parts = [self._chunk(strip, times[chunk], measured.poses.part(chunk)) for chunk in chunks]
        correction, covariance = (np.concatenate([p[i] for p in parts]) for i in range(2))
        angles = corrected_angles(measured.poses.angles, correction[:, 3:])
        angles[:, 2] = (angles[:, 2] + np.pi) % (2 * np.pi) - np.pi
        noise = self._network.pose_noise.at(measured, strip.followed)
        covariance = covariance + noise + of_vibration(self._network.vibrations.since(times))
        covariance += measured.open_end[:, :, None] * np.eye(6)
        return RefinedOrientation(
            strip.id, times, measured.poses.position_l + correction[:, :3], angles, covariance, correction
        )

    def turn(self, strip: WindowStrip, time_s: float) -> float:
        """Angle, rad, by which the solution turns the measured attitude at a time that has one."""
        measured = self._network.trajectory.at(np.array([time_s])).poses
        columns, A = strip.design(np.array([time_s]), measured).functions()
        correction = A @ self._network.state.values(columns)
        both = np.vstack([measured.angles, corrected_angles(measured.angles, correction[:, 3:])])
        before, after = matrix_from_angles(*both.T)
        return float(np.arccos(np.clip(0.5 * (np.sum(before * after) - 1.0), -1.0, 1.0)))

    def noise(self, strip: WindowStrip, times: Array) -> Array:
        """Covariance (n, 6, 6) that comes from no unknown and is no vibration: measurement noise and what the model
        leaves out."""
        noise = self._network.pose_noise.at(self._network.trajectory.at(times), strip.followed)
        return noise + strip.model.left_out_variance(times)[:, :, None] * np.eye(6)

    def points_of(self, batch: Batch, final: bool) -> list[AdjustedPoint]:
        """The points of a batch that are determined, with covariance and residuals."""
        points, control = self._network.intake.points, self._network.intake.control
        drift = self._sources.on_points(batch, self.drift)
        cofactors, statistics = batch.judge(self._network.state)
        xyz_l, covariance = batch.points_l, cofactors.points
        if drift is not None:
            xyz_l, covariance = xyz_l + drift[0], covariance + drift[1]
        v_line, v_sample = statistics.v_px.T.tolist()
        w, rejected = statistics.largest_w.tolist(), (batch.weight == 0.0).tolist()
        source, first, left = batch.rays.source.tolist(), batch.first_ray.tolist(), batch.points_left.tolist()
        known, earlier = np.all(batch.control.weight > 0, axis=1), np.zeros(batch.n_points, dtype=np.int64)
        if batch.ties is not None:
            known, earlier = known | batch.ties.placed, earlier + (batch.ties.active & batch.ties.single)
        is_known, of_earlier = known.tolist(), earlier.tolist()
        out = []
        for i in np.flatnonzero(batch.normals.rank == 3).tolist():
            name, mine = batch.names[i], slice(first[i], first[i + 1])
            point = points[name]
            seen = map(point.looks.__getitem__, source[mine])
            residuals = tuple(map(RayResidual, seen, v_line[mine], v_sample[mine], w[mine], rejected[mine]))
            role = control[name].role if name in control else "tie"
            rays, single = left[i], of_earlier[i]  # single looks of earlier strips
            checked = checks(rays + single, len(residuals) + single, is_known[i])
            if point.alone:
                checked = "doubtful"
            out.append(AdjustedPoint(name, role, xyz_l[i], covariance[i], rays, final, residuals, checked))
        return out

    def _chunk(self, strip: WindowStrip, times: Array, poses: Poses) -> tuple[Array, Array]:
        """Corrections (n, 6) and their covariance, with what the model leaves out."""
        design, left_out = strip.design_and_left_out(times, poses)
        columns, A = design.functions()
        if self._cofactors is None or not np.array_equal(columns, self._columns):
            self._cofactors, self._columns = self._network.state.covariance(columns), columns
        through = (A.reshape(-1, len(columns)) @ self._cofactors).reshape(A.shape)
        covariance = through @ np.swapaxes(A, 1, 2)
        covariance += left_out[:, :, None] * np.eye(6)
        correction = A @ self._network.state.values(columns)
        if self.drift is not None:
            change, of_drift = self.drift.change(A, self._network.state.places(columns))
            correction, covariance = correction + change, covariance + of_drift
        return correction, covariance


class CostHistory:
    """Weighted squares and redundancy so far, over time: what has been gained over the last while."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, float, int]] = deque()
        self._restarted = False

    def restart(self) -> None:
        """Sigmas have changed: costs before and after cannot be compared."""
        self._past.clear()
        self._restarted = True

    def over(self, now_s: float, length_s: float, cost: float, redundancy: int) -> tuple[float, int]:
        """sigma0 (NaN without redundancy) and redundancy of what came in the last ``length_s``."""
        self._past.append((now_s, cost, redundancy))
        while len(self._past) > 2 and self._past[1][0] <= now_s - length_s:
            self._past.popleft()
        then, old_cost, old_redundancy = self._past[0]
        if now_s - then < length_s and not self._restarted:
            old_cost, old_redundancy = 0.0, 0
        elif now_s - then < LEAST_SHARE * length_s:
            return float("nan"), 0
        gained = redundancy - old_redundancy
        if gained <= 0 or cost < old_cost:  # less than before where sigmas have become larger in between
            return float("nan"), 0
        return float(np.sqrt((cost - old_cost) / gained)), gained


def parameters(network: LiveNetwork, strip: WindowStrip, standing: Sequence[Standing] = ()) -> tuple[Parameter, ...]:
    """Offset, shift and drift of a strip where its model has them, errors of the platform, shift of the surface,
    additional parameters.

    Those of the strip, the platform and the surface are in the state from the start, with what is known beforehand:
    "estimated" says that the observations know them better.
    """
    state, self_calibration, camera_columns = network.state, network.self_calibration, network.camera_columns
    slow, strip_globals = strip.slow, strip.numbers[:9]
    apriori = np.concatenate([slow.offset_m, slow.shift, slow.drift])
    names: list[tuple[str, str, int]] = []
    if len(strip_globals):
        kinds = [f"d{c}" for c in COMPONENTS] + [f"{c} drift" for c in COMPONENTS[3:]]
        names = list(zip(kinds, ["m"] * 3 + ["rad"] * 6, strip_globals.tolist(), strict=True))
    platform = network.platform
    apriori = np.concatenate([apriori[: len(names)], platform.sigma, network.surface.sigma, network.calibration.sigma])
    for name, number in zip(platform.errors.unknown_names, platform.numbers.tolist(), strict=True):
        names.append((name, platform.errors.UNITS[name], number))
    names += [(SURFACE_SHIFT, "m", number) for number in network.surface.numbers.tolist()]
    if self_calibration is not None:
        for name, number in zip(self_calibration.unknown_names, camera_columns.tolist(), strict=True):
            names.append((name, unit_of(name), number))
    numbers = np.array([number for _, _, number in names], dtype=np.int64)
    if not len(numbers) or (state.places(numbers) < 0).any():
        return ()
    covariance = state.covariance(numbers)
    sigma = np.sqrt(np.diagonal(covariance))
    correlation = covariance / (sigma[:, None] * sigma)
    np.fill_diagonal(correlation, 0.0)
    strongest = np.abs(correlation).argmax(axis=1)
    strongest_r = correlation[np.arange(len(names)), strongest].clip(-1.0, 1.0).tolist()
    partners = strongest.tolist()
    values = state.values(numbers)
    of_strip = len(names) - len(camera_columns)
    weighed = len(names) if self_calibration is not None and self_calibration.as_calibrated else of_strip
    result, before = [], apriori.tolist()
    for i, ((name, unit, _), v, s) in enumerate(zip(names, values.tolist(), sigma.tolist(), strict=True)):
        status, reason = ESTIMATED, ""
        if i >= of_strip and standing:
            status, reason = standing[i - of_strip].status, standing[i - of_strip].reason
        elif i < weighed and s > BETTER * before[i]:
            status, reason = NOT_YET, f"its sigma is {s / max(before[i], 1e-300):.2f} of the a-priori one"
        partner = names[partners[i]][0] if strongest_r[i] else ""
        result.append(Parameter(name, unit, v, s, status, reason, strongest_r[i], partner))
    return tuple(result)
