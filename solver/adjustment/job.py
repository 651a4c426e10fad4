"""The batch job: adjust, find outliers, weigh, remove what cannot be determined, and say how good the result is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array, Bools
from ..camera.self_calibration import SelfCalibration
from ..models.base import ModelOptions
from ..models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from .adjustment import AdjustmentOptions, Iteration, Problem, Solution, continue_problem, pose_problem, solve
from .covariance import Cofactors, cofactors
from .determinability import Limits, Removal
from .direct_georeferencing import Georeferenced, georeference
from .network import Control, Network
from .network_weakness import Combination, undetermined
from .normal_equations import Prior, reduce_normals, whiten_prior
from .normal_matrix import DenseMatrix
from .parameter_elimination import eliminate, own_information
from .point_consensus import Doubt, doubts
from .pose_noise import Pieces, noise_information, with_noise_left
from .ray_statistics import RayStatistics, ray_statistics
from .reliability import CRITICAL_W
from .robust import Huber, WeightFunction
from .snooping import Rejected, Round, Snooping, image_scale, joint_limit, snoop
from .statistics import GlobalTest, PointAccuracy, global_test, point_accuracy
from .surface_control import SurfaceFit, SurfaceRows, SurfaceShift
from .variance_components import LEAST_REDUNDANCY, Component, Scales, estimate_components, group_sums, scaled

#: Reduced unknowns up to which a network is searched for undetermined combinations (an eigenproblem of this size).
MOST_UNKNOWNS = 1000

#: Robust weight from which on a ray counts as left out.
ROBUST_OUT = 0.02

#: Share of the cost below which an adjustment that is followed by others is not worth another step.
WARM_TOLERANCE = 1e-9

#: Times that what is left of the noise of poses is looked at.
NOISE_ROUNDS = 3

#: Readings of a surface at most, and change of a weight, and of a height in sigmas of the surface, from which on it is
#: read again. Tuned: it is a matter of rounding.
SURFACE_ROUNDS, SURFACE_STILL = 12, 0.02

#: Re-estimations of the image sigma, each followed by a new search for outliers.
REWEIGHTINGS = 3
#: Change of the factor of the image from which they go on. Numerical: far below its standard deviation.
SETTLED = 0.01


class NotAdjustableError(ValueError):
    """A network from which nothing can be computed: one line that says why."""


@dataclass(frozen=True)
class Phase:
    """What begins now, for progress lines."""

    name: str


Pose = Callable[[Network, ModelOptions, SelfCalibration | None, PlatformErrors], Problem]
Event = Phase | Iteration | Round | Removal
Progress = Callable[[Event], None]


@dataclass(frozen=True)
class Job:
    """What to do.

    Attributes
    ----------
    model : trajectory model
    then : model that runs after it on the orientation it refined; None for one model alone
    wide : a-priori sigmas of the first model are far larger than the errors, see `Problem.wide`
    then_stated : its a-priori sigmas are stated for what the first model leaves, not for the measured trajectory
    self_calibration : additional parameters
    eliminate, limits : whether parameters that are not determinable go, and by which critical values
    snoop, critical : data snooping and its critical value
    robust : weight function; with `snoop` it gives the start of the search only
    reweight : re-estimate the image sigma
    components : estimate the sigmas of image, control, position and attitude, and question those of constants
    weights : see `AdjustmentOptions`
    max_iterations : of each adjustment, and one that takes them all is not gone on with; None for as many as are usual,
        which only guard against what does not converge
    platform : constant errors of the platform that are unknowns
    """

    model: ModelOptions
    then: ModelOptions | None = None
    self_calibration: SelfCalibration | None = None
    eliminate: bool = True
    limits: Limits = field(default_factory=Limits)
    snoop: bool = False
    critical: float = CRITICAL_W
    robust: WeightFunction | None = None
    reweight: bool = False
    components: bool = False
    weights: str = "motion"
    max_iterations: int | None = None
    platform: PlatformErrors = NO_PLATFORM_ERRORS
    then_stated: bool = False
    wide: bool = False

    @property
    def eliminates(self) -> bool:
        """Whether additional parameters are tested: not what a calibration leaves open, of which enough is known
        beforehand, and which is in the sigmas of all else."""
        return self.eliminate and self.self_calibration is not None and not self.self_calibration.as_calibrated

    @property
    def options(self) -> AdjustmentOptions:
        most = AdjustmentOptions.max_iterations if self.max_iterations is None else self.max_iterations
        return AdjustmentOptions(self.weights, most)

    @property
    def on_the_way(self) -> AdjustmentOptions:
        """For adjustments that are followed by others."""
        return replace(self.options, tolerance=WARM_TOLERANCE)


@dataclass(frozen=True)
class BatchResult:
    """What the job found.

    Attributes
    ----------
    stages : one solution per model; the last one is the result
    cofactors, rays : of the last solution; for sigma0 = 1
    test : sigma0 with its chi-square limits
    rejected : observations left out
    given_up : share of the image points that data snooping would have left out, where that is too many; else 0
    removed, kept : additional parameters that are gone, and those that stay in spite of a failed criterion
    components : variance components; () if they were not asked for
    image_factor : what the a-priori image sigma was multiplied by
    weak : combinations of unknowns that rest on a-priori weights alone; None where the network was too large to search
    georeferenced : object points without adjustment
    groups : number, ``v^T P v`` and redundancy of image, control, position and attitude
    iterations : steps of all adjustments
    doubtful : object points that the rays they kept do not confirm; comparisons leave them out
    surface : what came of the heights of the surface that points lie on; None without one
    information : of the rays about the corrections, see `pose_noise`; empty where poses have no correlated noise
    """

    stages: tuple[Solution, ...]
    cofactors: Cofactors
    rays: RayStatistics
    test: GlobalTest
    rejected: tuple[Rejected, ...]
    given_up: float
    removed: tuple[Removal, ...]
    kept: dict[str, str]
    components: tuple[Component, ...]
    image_factor: float
    weak: tuple[Combination, ...] | None
    georeferenced: Georeferenced
    groups: dict[str, tuple[int, float, float]]
    iterations: int
    doubtful: tuple[Doubt, ...] = ()
    surface: SurfaceFit | None = None
    information: Pieces = field(default_factory=dict, repr=False)

    @property
    def solution(self) -> Solution:
        return self.stages[-1]

    @property
    def network(self) -> Network:
        return self.solution.network

    @property
    def measured_redundancy(self) -> float:
        """Share of image points and control in the redundancy."""
        return self.groups["image"][2] + self.groups["control"][2]

    @property
    def image_test(self) -> GlobalTest:
        """sigma0 of the image points alone. A-priori equations that say what nothing contradicts, as the continuity of
        a smooth trajectory, lower the common sigma0; this one they leave alone."""
        _, squares, redundancy = self.groups["image"]
        return global_test(squares, max(round(redundancy), 0))

    @property
    def sigma0(self) -> float:
        """What sigmas are scaled with: sigma0 a posteriori, or 1 where image points and control have too little
        redundancy to estimate it."""
        return self.test.sigma0 if self.measured_redundancy >= LEAST_REDUNDANCY else 1.0

    @property
    def point_covariance(self) -> Array:
        """(p, 3, 3) m^2, a posteriori; NaN for points that the network does not determine."""
        C = self.sigma0**2 * self.cofactors.points
        C[self.solution.points.rank < 3] = np.nan
        return C

    @property
    def point_sigma_m(self) -> Array:
        """(p, 3) metres, a posteriori."""
        return np.sqrt(np.maximum(np.einsum("pii->pi", self.point_covariance), 0.0))

    @property
    def kept_control(self) -> Control:
        """The control without the coordinates that were left out, and without points that no image point in use
        measures, which stay where they are given: as if they were not given."""
        network, control = self.network, self.network.control
        used = np.bincount(network.rays.point[self.solution.ray_weight > 0], minlength=network.n_points)
        sigma = np.where(used[control.point, None] > 0, control.sigma_m, np.inf)
        for r in self.rejected:
            if r.ray < 0:
                sigma[control.point == r.point, r.axis] = np.inf
        return replace(control, sigma_m=sigma)

    def compare(self, with_: Control, points_l: Array, sigma_m: Array) -> PointAccuracy:
        """Accuracy of points (p, 3) with sigmas (p, 3) against given coordinates, without points that are doubtful."""
        sure = ~np.isin(with_.point, [d.point for d in self.doubtful])
        given = np.isfinite(with_.sigma_m) & sure[:, None]
        difference = np.where(given, points_l[with_.point] - with_.xyz_l, np.nan)
        return point_accuracy(difference, np.where(given, sigma_m[with_.point], np.nan))

    def adjusted_points(self) -> Array:
        """(p, 3) metres; NaN for points that the network does not determine."""
        return np.where((self.solution.points.rank == 3)[:, None], self.solution.state.points_l, np.nan)


def run(network: Network, job: Job, progress: Progress | None = None, pose: Pose | None = None) -> BatchResult:
    """Do the job.

    Parameters
    ----------
    network, job, progress : what is adjusted, how, and whom it is told
    pose : poses the problem of a block in partitions, which takes the network's rays to them; see `refuse_in_parts`

    Raises
    ------
    NotAdjustableError : no point is seen twice and nothing is known of any; values beyond all bounds; a surface that
        has no height below any point
    """
    tell = progress or (lambda event: None)
    _refuse_hopeless(network)
    stages: list[Solution] = []
    outcome: _Stage | None = None
    for model in (job.model, job.then):
        if model is not None:
            last = model is (job.then or job.model)
            outcome = _Stage(network, model, job, tell, outcome, pose)
            outcome.work(last)
            stages.append(outcome.solution)
    assert outcome is not None
    solution = outcome.solution
    tell(Phase("statistics"))
    found = outcome.snooping
    rejected = found.rejected if found else _robust_rejected(solution)
    lost = np.array([r.ray for r in rejected if r.ray >= 0 and r.reason != "lone"], dtype=np.int64)
    Q = cofactors(solution)
    return BatchResult(
        tuple(stages),
        Q,
        ray_statistics(solution, Q),
        global_test(solution.weighted_squares, max(solution.redundancy, 0)),
        rejected,
        found.given_up if found else 0.0,
        outcome.removed,
        outcome.kept,
        outcome.components,
        outcome.scales.factor["image"],
        weaknesses(solution),
        _georeferenced(stages[0], job.model, _taking_part(solution)),
        group_sums(solution, Q),
        outcome.steps,
        doubts(solution, lost, joint_limit(job.critical)),
        outcome.surface_fit(),
        _information(solution),
    )


def _information(solution: Solution) -> Pieces:
    """What says how much of the noise of poses the corrections follow; nothing where it is white."""
    if not any(strip.noise is not None and strip.noise_time_s for strip in solution.network.strips):
        return {}
    parts = solution.problem.parts
    return noise_information(solution) if parts is None else parts.noise_information(solution)


def refuse_in_parts(network: Network, job: Job) -> None:
    """Raise NotAdjustableError, with the reason, for what blocks in partitions cannot do."""
    wanted = {
        "a second model (--then)": job.then is not None,
        "the tests of additional parameters (--keep all goes)": job.eliminates,
        "a surface of tie points (--dem)": network.surface is not None,
    }
    for what, asked in wanted.items():
        if asked:
            raise NotAdjustableError(f"a block in partitions is adjusted without {what}")


def _georeferenced(first: Solution, model: ModelOptions, weight: Array) -> Georeferenced:
    if first.problem.parts is not None:
        return Georeferenced(*first.problem.parts.georeference(weight))
    return georeference(first.network, model, weight)


class _Stage:
    """One model's adjustment, as it goes through its steps."""

    def __init__(
        self,
        network: Network,
        model: ModelOptions,
        job: Job,
        tell: Progress,
        before: _Stage | None,
        pose: Pose | None = None,
    ):
        self.job, self.tell = job, tell
        self.scales = Scales(dict(before.scales.factor)) if before else Scales()
        self.snooping: Snooping | None = None
        self.removed: tuple[Removal, ...] = ()
        self.kept: dict[str, str] = {}
        self.components: tuple[Component, ...] = ()
        self.steps = before.steps if before else 0
        self.free_shift = before.free_shift if before else False
        tell(Phase(f"adjustment, {model.name}"))
        points = None
        self.given = np.ones(len(network.rays))  # weights of the rays before those of robust estimation
        if before:
            self.given, points = before.given, before.solution.state.points_l
            self.snooping = before.snooping
            problem = continue_problem(before.solution, model, stated=job.then_stated)
            problem = self._adapt(replace(problem, control=before.solution.problem.control), control=False)
        else:
            problem = (pose or pose_problem)(network, model, job.self_calibration, job.platform)
            problem = replace(problem, wide=job.wide)
        start = points
        if job.robust is not None:  # a weight function that falls to zero needs a start that is not drawn away
            start = solve(problem, points, self.given, replace(job.options, robust=Huber()), tell)
            self.steps += start.iterations
        self._keep(solve(problem, start, self.given, replace(job.options, robust=job.robust), tell))
        self._read_surface()
        if not before and not self._cut_short:  # far from the solution residuals tell nothing of noise
            self._state_noise(network, model)
        if job.robust is not None and not job.snoop and not self._cut_short:
            self._leave_out_robustly()
        if self.scales.factor["image"] != 1.0:
            self._keep(scaled(self.solution, {"image": self.scales.factor["image"]}, job.options))

    def _state_noise(self, network: Network, model: ModelOptions) -> None:
        """Weigh rays with what the corrections leave of the noise of poses: with less of it they follow more."""
        if (parts := self.solution.problem.parts) is not None:
            options = replace(self.job.options, robust=self.job.robust)
            for _ in range(NOISE_ROUNDS):
                if not parts.with_noise_left(self.solution):
                    return
                self._keep(solve(self.solution.problem, self.solution.state, self.given, options))
            return
        for _ in range(NOISE_ROUNDS):
            left = with_noise_left(network, self.solution)
            if left is None:
                return
            problem = pose_problem(left, model, self.job.self_calibration, self.job.platform)
            problem = self._adapt(
                replace(problem, wide=self.job.wide, control=self.solution.problem.control), control=False
            )
            options = replace(self.job.options, robust=self.job.robust)
            self._keep(solve(problem, self.solution.state, self.given, options))

    def _leave_out_robustly(self) -> None:
        """Rays that robust estimation leaves hardly any weight have none: as observations they would count in full."""
        weight = self.solution.ray_weight
        if ((weight > 0) & (weight < ROBUST_OUT)).any():
            left = np.where(weight < ROBUST_OUT, 0.0, weight)
            self._keep(solve(self.solution.problem, self.solution, left, self.job.options))

    def work(self, last: bool) -> None:
        """All steps after the first adjustment; elimination and variance components in the last stage only."""
        job, first = self.job, self.solution
        if job.snoop:
            self._snoop_with_start()
        if job.reweight:
            self._reweigh()
        if last and job.eliminates and self.solution.layout.n_camera:
            self.tell(Phase("determinability of the additional parameters"))
            image = self.scales.factor["image"]
            outcome = eliminate(self.solution, job.limits, job.on_the_way, self._adapt, self.tell, image)
            self.removed, self.kept = outcome.removed, outcome.kept
            self._keep(outcome.solution)
            if job.snoop:
                self._snoop()
        if last and job.components:
            self._estimate_components()
        if self.solution is first and self._cut_short:  # more steps would be more than were asked for
            return
        self._keep(solve(self.solution.problem, self.solution, self.solution.ray_weight, job.options))
        self._read_surface()

    @property
    def _cut_short(self) -> bool:
        """Whether a limit of steps that was asked for has ended the last adjustment before it arrived."""
        most = self.job.max_iterations
        return most is not None and not self.solution.converged and len(self.solution.history) >= most

    def _estimate_components(self) -> None:
        """Variance components; with data snooping in turn, until that of the image stays: what is left out depends on
        it, and it on what is left out."""
        for _ in range(REWEIGHTINGS):
            self.tell(Phase("variance components"))
            before = self.scales.factor["image"]
            found = estimate_components(self.solution, options=self.job.on_the_way, start=self.scales)
            self.components = found.components
            self.scales = Scales(self.scales.factor | {c.group: c.factor for c in found.components})
            self._keep(found.solution)
            if not self.job.snoop:
                return
            self._snoop()
            if abs(self.scales.factor["image"] / before - 1.0) < SETTLED:
                return

    def _read_surface(self) -> None:
        """Put points onto the surface as it is where they are now, until they stay, and see whether its shift agrees.

        Heights of points that stand above it, on trees and houses, lose their weight.
        """
        surface = self.solution.network.surface
        if surface is None:
            return
        for _ in range(SURFACE_ROUNDS):
            before = self.solution
            points, shift_m = np.where((before.points.rank == 3)[:, None], before.state.points_l, np.nan), self._shift_m
            rows, known = surface.rows(points, self._on_surface), before.problem.control.surface
            used = rows.weight > 0
            if not used.any():
                raise NotAdjustableError("the surface has no height below any tie point")
            off = rows.off(points, shift_m)[used]
            if known is None:  # as a whole it may be anywhere
                off = off - np.median(off)
            factor = surface.weights(off, surface.scale_m(off))
            weight = rows.weight.copy()
            weight[used] *= factor
            if known is not None:
                changed = np.abs(weight - known.weight).max() / surface.sigma_m**-2.0
                both = used & (known.weight > 0)
                moved = np.abs(rows.off(points, 0.0) - known.off(points, 0.0))[both].max(initial=0.0)
                if changed < SURFACE_STILL and moved < SURFACE_STILL * surface.sigma_m:
                    break
            self._with_surface(rows.weighed(weight))
            free = self._surface_shift().free
            if free != self.free_shift:
                self.free_shift = free
                self._with_surface(rows.weighed(weight))

    def _with_surface(self, rows: SurfaceRows) -> None:
        """Adjust with equations of the surface."""
        problem = self.solution.problem
        prior = problem.prior
        if self.free_shift:
            prior = prior.without(problem.layout.shift_column)
        elif problem.prior.n_observations < self._stated_prior.n_observations:
            prior = self._adapt(replace(problem, prior=self._stated_prior), control=False).prior
        problem = replace(problem, prior=prior, control=replace(problem.control, surface=rows))
        self._keep(solve(problem, self.solution, self.solution.ray_weight, self.job.options))

    @property
    def _stated_prior(self) -> Prior:
        """A-priori equations as they were stated."""
        layout = self.solution.layout
        return whiten_prior(layout.prior, layout.n_unknowns)

    @property
    def _on_surface(self) -> Bools:
        """Points (p,) that a height of the surface is wanted for: seen twice, without coordinates of their own."""
        network = self.solution.network
        wanted = network.rays_per_point >= 2
        wanted[network.control.point] = wanted[network.check.point] = False
        return wanted

    @property
    def _shift_m(self) -> float:
        return self.solution.layout.shift_of(self.solution.state.theta)

    def _surface_shift(self) -> SurfaceShift:
        solution, surface = self.solution, self.solution.network.surface
        assert surface is not None
        unit = np.zeros(solution.layout.n_unknowns)
        unit[solution.layout.shift_column] = 1.0
        variance = float(unit @ solution.factor.solve(unit))
        return SurfaceShift.of(self._shift_m, variance, surface.shift_sigma_m, self.free_shift)

    def surface_fit(self) -> SurfaceFit | None:
        """What came of the surface; None without one."""
        surface, rows = self.solution.network.surface, self.solution.problem.control.surface
        if surface is None or rows is None:
            return None
        points = self.solution.state.points_l
        known = surface.rows(points, self._on_surface & (self.solution.points.rank == 3))
        off = np.where(known.weight > 0, known.off(points, self._shift_m), np.nan)
        weight = rows.weight * surface.sigma_m**2
        return SurfaceFit(surface.sigma_m, surface.shift_sigma_m, off, weight, self._surface_shift())

    def _keep(self, solution: Solution) -> None:
        if not (np.isfinite(solution.cost) and np.isfinite(solution.state.theta).all()):
            raise NotAdjustableError("the adjustment leaves all bounds: image points and trajectory do not fit")
        self.solution = solution
        self.steps += solution.iterations

    def _adapt(self, problem: Problem, control: bool = True) -> Problem:
        """A problem posed anew with what was found of its a-priori weights, of those of control where wanted."""
        scaled = self.scales.apply(problem)
        if self.free_shift:
            scaled = replace(scaled, prior=scaled.prior.without(problem.layout.shift_column))
        return scaled if control else replace(scaled, control=problem.control)

    def _snoop_with_start(self) -> None:
        """Search from a robust start where one was asked for: what it left out may return."""
        if self.job.robust is not None:
            out = np.flatnonzero(self.solution.ray_weight < ROBUST_OUT)
            weight = np.ones(len(self.solution.ray_weight))
            weight[out] = 0.0
            self._keep(solve(self.solution.problem, self.solution, weight, self.job.options))
            Q = cofactors(self.solution)
            first = tuple(Rejected(int(i), -1, -1, 0.0, "snooping") for i in out)
            self.snooping = Snooping(self.solution, Q, ray_statistics(self.solution, Q), first, 0)
        if (
            self.job.reweight or self.job.components
        ):  # a wrong a-priori sigma would make the test reject good rays or pass bad ones
            self._scale_image(_robust_scale(self.solution))
        self._snoop()

    def _snoop(self) -> None:
        self.tell(Phase("data snooping"))
        self.snooping = snoop(
            self.solution, self.job.critical, self.job.on_the_way, self.tell, self.snooping, self.scales.factor["image"]
        )
        self._keep(self.snooping.solution)
        self.given = self.solution.ray_weight

    def _reweigh(self) -> None:
        for _ in range(REWEIGHTINGS):
            self.tell(Phase("image sigma"))
            found = estimate_components(self.solution, ("image",), self.job.on_the_way, start=self.scales)
            change = found.components[0].factor / self.scales.factor["image"]
            self.scales = self.scales.times({"image": change})
            self._keep(found.solution)
            if not self.job.snoop or abs(change - 1.0) < SETTLED:
                return
            self._snoop()

    def _scale_image(self, factor: float) -> None:
        self.scales = self.scales.times({"image": factor})
        self._keep(scaled(self.solution, {"image": factor}, self.job.options))


def weaknesses(solution: Solution) -> tuple[Combination, ...] | None:
    """Combinations of unknowns that the observations do not determine; None where there are too many to search."""
    problem, layout = solution.problem, solution.layout
    if layout.n_unknowns > MOST_UNKNOWNS or problem.parts is not None:
        return None
    lin = solution.linearisation.reweighted(solution.ray_weight)
    state = solution.state
    plan = replace(problem.elimination, structure=None)
    normal = reduce_normals(lin, layout, plan, problem.prior, problem.control, state.theta, state.points_l).matrix
    assert isinstance(normal, DenseMatrix)
    prior = problem.prior.normal.toarray()
    alone = own_information(solution)
    return tuple(undetermined(normal.whole() - prior, prior, alone, layout.names, len(layout.sets)))


def _refuse_hopeless(network: Network) -> None:
    known = network.control.n_observations
    if network.rays_per_point.max(initial=0) < 2 and not known:
        raise NotAdjustableError("no object point is seen by two rays and there is no control: nothing to adjust")


def _robust_scale(solution: Solution) -> float:
    """Image sigma in units of the a-priori one: from the median of |w|, which outliers hardly move."""
    of = ray_statistics(solution, cofactors(solution))
    if of.redundancy[solution.ray_weight > 0].sum() < LEAST_REDUNDANCY:
        return 1.0
    return float(np.clip(image_scale(of, solution.ray_weight), 1e-2, 1e2))


def _taking_part(solution: Solution) -> Array:
    return (solution.ray_weight > ROBUST_OUT).astype(float)


def _robust_rejected(solution: Solution) -> tuple[Rejected, ...]:
    """Rays that robust estimation left without weight; their w is against the adjustment without them."""
    out = np.flatnonzero(solution.ray_weight < ROBUST_OUT)
    if not len(out):
        return ()
    w = ray_statistics(solution, cofactors(solution)).largest_w
    return tuple(sorted((Rejected(int(i), -1, -1, float(w[i]), "robust") for i in out), key=lambda r: -r.w))
