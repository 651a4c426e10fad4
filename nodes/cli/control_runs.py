"""Runs of ``triline study control``: one block with many configurations and numbers of control points."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.block_data import BlockData, KnownPoints
from ...solver.adjustment.control_choice import spread_choice
from ...solver.adjustment.job import Job
from ...solver.adjustment.single_looks import single_looks as flight_looks
from ...solver.camera.self_calibration import SELF_CALIBRATIONS
from ...solver.models.ppm import PpmOptions
from ...solver.scene_adjustment.functional import R_e_enu
from ..batch.scene_adjustment import (
    SCENE_CALIBRATIONS,
    SCENE_MODELS,
    SceneJob,
    differences,
    point_sigmas,
    run_scene_job,
)
from ..batch.two_steps import sigmas_stated
from ..errors import UserError
from ..formats.scene_block import SceneBlockData
from ..worker_pool import WorkerPool
from .adjust import adjust_block, models_of, wanders

Array = NDArray[np.floating]
D = TypeVar("D", BlockData, SceneBlockData)
Indices = NDArray[np.int64]
Tell = Callable[[float], None] | None


@dataclass(frozen=True)
class Configuration:
    """What is adjusted with; None where a setting is the project's, or means nothing.

    Attributes
    ----------
    model, then : trajectory models; "" where no image of the block has a trajectory
    segments, fixes, order, selfcal, sets : as the options of ``triline adjust``
    correction : of images with rational polynomials: shift or affine
    """

    model: str
    then: str | None = None
    segments: int | None = None
    fixes: int | None = None
    order: int | None = None
    selfcal: str = "none"
    sets: str | None = None
    correction: str | None = None

    @property
    def label(self) -> str:
        """In words."""
        steps = []
        for name in (self.model, self.then):
            if not name:
                continue
            of = {"ppm": (("segments", ""), ("order", "order ")), "lim": (("fixes", ""),)}.get(name, ())
            values = [(key, before, getattr(self, key)) for key, before in of]
            said = [f"{before}{value}" if before else _count(value, key) for key, before, value in values if value]
            steps.append(" ".join([name.upper(), *said]))
        words = [", then ".join(steps)] if steps else []
        words += [f"one set a {self.sets}"] if self.sets else []
        words += [f"RPC {self.correction}"] if self.correction else []
        words += [self.selfcal] if self.selfcal != "none" else []
        return ", ".join(words) or "as given"

    @property
    def options(self) -> str:
        """The options of ``triline adjust`` that mean the same."""
        pairs = (
            ("model", self.model), ("then", self.then), ("segments", self.segments), ("fixes", self.fixes),
            ("order", self.order), ("sets", self.sets), ("selfcal", self.selfcal if self.selfcal != "none" else None),
        )  # fmt: skip
        return " ".join(f"--{key} {value}" for key, value in pairs if value)


@dataclass(frozen=True)
class Axes:
    """What is gone over; () where the block decides."""

    model: tuple[str, ...] = ()
    then: tuple[str, ...] = ()
    segments: tuple[int, ...] = ()
    fixes: tuple[int, ...] = ()
    order: tuple[int, ...] = ()
    selfcal: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()
    correction: tuple[str, ...] = ()


@dataclass(frozen=True)
class Found:
    """What an adjustment gave.

    Attributes
    ----------
    check : (k,) names of the check points that it determined
    difference_m, sigma_m : (k, 3) adjusted minus given, and theoretical sigmas, a posteriori; at the given heights, and
        these NaN, of points of one image point (`Pool.single`)
    given_m2 : (k,) what the given coordinates add to the variance of a difference, all its coordinates together
    n_unknowns : of images: orientation, camera, corrections; without coordinates of points
    sigma0, passed : and whether its chi-square test passed; None where nothing was redundant
    """

    check: tuple[str, ...]
    difference_m: Array
    sigma_m: Array
    given_m2: Array
    n_unknowns: int
    redundancy: int
    sigma0: float
    passed: bool | None
    converged: bool
    undetermined: int


@dataclass(frozen=True)
class Run:
    """One adjustment; ``failed`` says why there is nothing found."""

    control: int
    configuration: Configuration
    seconds: float
    found: Found | None
    failed: str = ""


@dataclass(frozen=True)
class Settings:
    """Of all runs: data snooping, iterations at most (None: as many as are usual), and whether check points have one
    image point each (`Pool.single`)."""

    snoop: bool = False
    iterations: int | None = None
    single: bool = False


class Block(Protocol):
    """A block of either kind."""

    @property
    def axes(self) -> tuple[str, str, str]:
        """Names of the three coordinates of differences."""
        ...

    @property
    def name(self) -> str: ...

    @property
    def notes(self) -> tuple[str, ...]: ...

    @property
    def ground(self) -> KnownPoints: ...

    def with_ground(self, ground: KnownPoints) -> Block: ...

    def measured(self) -> dict[str, int]:
        """Image points of each point, by its name."""
        ...

    def plan_m(self) -> Array:
        """Known points (m, 2) in a horizontal plane, metres."""
        ...

    def configurations(self, axes: Axes) -> list[Configuration]: ...

    def run(self, configuration: Configuration, settings: Settings) -> Found: ...


@dataclass(frozen=True)
class _OfData(Generic[D]):
    """What both kinds say of themselves."""

    data: D

    @property
    def name(self) -> str:
        return self.data.name

    @property
    def notes(self) -> tuple[str, ...]:
        return self.data.notes

    @property
    def ground(self) -> KnownPoints:
        return self.data.ground

    def with_ground(self, ground: KnownPoints) -> Self:
        return replace(self, data=replace(self.data, ground=ground))

    def given_variance(self, ids: Sequence[str]) -> Array:
        """Variances of the given coordinates of known points, all three together (k,), m2."""
        place = {id: k for k, id in enumerate(self.ground.id)}
        return np.einsum("nii->n", self.ground.covariance[[place[id] for id in ids]].reshape(-1, 3, 3))


@dataclass(frozen=True)
class AirborneBlock(_OfData[BlockData]):
    """A block folder or recording."""

    axes: tuple[str, str, str] = ("X", "Y", "Z")

    def measured(self) -> dict[str, int]:
        image = self.data.image
        usable = (image.strip >= 0) & (image.ccd >= 0)
        counts = np.bincount(image.point[usable], minlength=len(self.data.point_ids))
        return dict(zip(self.data.point_ids, counts.tolist(), strict=True))

    def plan_m(self) -> Array:
        return self.data.ground.xyz_l[:, :2]

    def configurations(self, axes: Axes) -> list[Configuration]:
        """Raises UserError for what does not go with such a block."""
        if axes.sets:
            raise UserError("--sets goes with a block of satellite scenes (project.toml with [scenes])")
        if axes.correction:
            raise UserError("--correction goes with a block of satellite scenes that has rational polynomials")
        stated = self.data.apriori.trajectory
        models = axes.model or ("dgr", "ppm", "lim", *(["wander"] if wanders(stated) else []))
        # where the slow errors are known as a process, it says how many segments and fixes there are
        try:
            process = PpmOptions.from_settings(stated).slow is not None
        except ValueError as error:
            raise UserError(f"{self.name}: model ppm: {error}") from None
        if process and axes.order:
            raise UserError("--order: means nothing where the project states a wander, which gives weights to PPM")
        camera = self.data.camera
        sets = axes.selfcal or ("none", "tls18" if len(camera.lenses) == 1 else "lens")
        return _product(axes, models, *(((), (), ()) if process else ((2, 4), (4, 8), (1, 2))), sets, (None,), (None,))

    def run(self, configuration: Configuration, settings: Settings) -> Found:
        c, block = configuration, self.data
        first, second = models_of(block, c.model, c.then, _given(c))
        parameters = None if c.selfcal == "none" else SELF_CALIBRATIONS[c.selfcal](block.camera)
        job = Job(
            first, second, parameters, snoop=settings.snoop, max_iterations=settings.iterations,
            then_stated=sigmas_stated(block.apriori.then), wide=block.apriori.wide,
        )  # fmt: skip
        result = adjust_block(block, job).result
        network, solution = result.network, result.solution
        if settings.single:
            alone = flight_looks(solution, result.cofactors, result.sigma0)
            points, d, sigma = alone.point, _in_plan(alone.difference_m), _in_plan(alone.sigma_m)
            given = _added(alone.sigma_m, alone.expected_m)
            wanted = np.isfinite(d[:, :2]).all(axis=1)
        else:
            points, d = network.check.point, result.adjusted_points()[network.check.point] - network.check.xyz_l
            given = self.given_variance([network.point_ids[p] for p in points])
            sigma, wanted = result.point_sigma_m[points], np.isfinite(d).all(axis=1)
        sure = wanted & ~np.isin(points, [doubt.point for doubt in result.doubtful])
        return Found(
            tuple(network.point_ids[p] for p in points[sure]), d[sure], sigma[sure], given[sure],
            solution.layout.n_unknowns, solution.redundancy, result.test.sigma0, result.test.passed,
            bool(solution.converged), 0,
        )  # fmt: skip


@dataclass(frozen=True)
class SceneBlock(_OfData[SceneBlockData]):
    """A block of satellite scenes."""

    axes: tuple[str, str, str] = ("east", "north", "up")

    def measured(self) -> dict[str, int]:
        counts = np.bincount(self.data.rays.point, minlength=len(self.data.point_ids))
        return dict(zip(self.data.point_ids, counts.tolist(), strict=True))

    def plan_m(self) -> Array:
        position_e = self.data.known().position_e
        middle = position_e.mean(axis=0)
        lat, lon, _ = self.data.ellipsoid.geodetic(middle[None])[0]
        return ((position_e - middle) @ R_e_enu(lat, lon))[:, :2]

    def configurations(self, axes: Axes) -> list[Configuration]:
        """Raises UserError for what does not go with such a block."""
        models = {image.scene.model for image in self.data.images}
        corrections: tuple[str | None, ...] = axes.correction or ("shift", "affine")
        if "rpc" not in models:
            if axes.correction:
                raise UserError(f"--correction: no image of {self.name} is adjusted with rational polynomials")
            corrections = (None,)
        if "rigorous" not in models:
            for option in ("model", "then", "segments", "fixes", "order", "selfcal", "sets"):
                if getattr(axes, option):
                    raise UserError(f"--{option}: no image of {self.name} has a rigorous model")
            return [Configuration("", correction=correction) for correction in corrections]
        for option, wanted, given in (
            ("model", SCENE_MODELS, axes.model),
            ("then", ("none", *SCENE_MODELS), axes.then),
            ("selfcal", SCENE_CALIBRATIONS, axes.selfcal),
        ):
            for word in given:
                if word not in wanted:
                    raise UserError(f"--{option} {word}: does not go with satellite scenes, wanted {', '.join(wanted)}")
        sets = axes.sets if len(axes.sets) != 1 or axes.sets[0] != "lens" else ()
        return _product(
            axes, axes.model or SCENE_MODELS, (1, 2), (4,), (1, 2), axes.selfcal or ("none", "lens"), sets or (None,),
            corrections,
        )  # fmt: skip

    def run(self, configuration: Configuration, settings: Settings) -> Found:
        c, data = configuration, self.data
        if c.correction is not None:
            data = replace(data, rpc={**data.rpc, "correction": c.correction})
        job = SceneJob(
            c.model or "dgr", c.then, _given(c), c.selfcal, sets=c.sets or "lens", snoop=settings.snoop,
            iterations=settings.iterations or SceneJob.iterations,
        )  # fmt: skip
        a = run_scene_job(data, job)
        if settings.single:
            alone = a.single_looks
            points, d = data.rays.point[alone.rays], _in_plan(alone.difference_m)
            given = _added(alone.sigma_m, alone.expected_m)
            sigma, finite = _in_plan(alone.sigma_m), np.isfinite(d[:, :2]).all(axis=1)
        else:
            points, d = differences(a, "check")
            given = self.given_variance([data.point_ids[p] for p in points])
            sigma, finite = point_sigmas(a)[points], np.isfinite(d).all(axis=1)
        return Found(
            tuple(data.point_ids[p] for p in points[finite]), d[finite], sigma[finite], given[finite],
            a.problem.block.layout.n_unknowns, a.solution.redundancy, a.test.sigma0, a.test.passed,
            bool(a.solution.converged), len(a.solution.undetermined),
        )  # fmt: skip


def _in_plan(values: Array) -> Array:
    """Values of two coordinates (k, 2) with the third, which is not known (k, 3)."""
    return np.column_stack([values, np.full(len(values), np.nan)])


def _added(sigma_m: Array, expected_m: Array) -> Array:
    """What the given coordinates add to the variance of both coordinates together (k,)."""
    return np.sum(np.square(expected_m) - np.square(sigma_m), axis=1)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number != 1 else f"1 {what.removesuffix('s')}"


def _given(c: Configuration) -> dict[str, int | None]:
    return {"segments": c.segments, "fixes": c.fixes, "order": c.order}


def _product(
    axes: Axes,
    models: Sequence[str],
    segments: Sequence[int],
    fixes: Sequence[int],
    orders: Sequence[int],
    calibrations: Sequence[str],
    sets: Sequence[str | None],
    corrections: Sequence[str | None],
) -> list[Configuration]:
    """All combinations, each once, simple ones first; what a model does not take is left aside.

    Segments, fixes and orders are those of the axes, or else the given ones.
    """
    found: dict[Configuration, None] = {}
    steps = [(model, None if then == "none" else then) for model in models for then in axes.then or ("none",)]
    for option, owner in (("segments", "ppm"), ("order", "ppm"), ("fixes", "lim")):
        if getattr(axes, option) and not any(owner in step for step in steps):
            raise UserError(f"--{option} is for the model {owner}; asked for is {', '.join(models)}")
    for calibration, set_, correction, (model, then) in product(calibrations, sets, corrections, steps):
        mine = {model, then}
        for s, o, f in product(
            (axes.segments or segments or (None,)) if "ppm" in mine else (None,),
            (axes.order or orders or (None,)) if "ppm" in mine else (None,),
            (axes.fixes or fixes or (None,)) if "lim" in mine else (None,),
        ):
            found[Configuration(model, then, s, f, o, calibration, set_, correction)] = None
    return list(found)


@dataclass(frozen=True)
class Pool:
    """Which known points can be control, and which are check points in any case.

    Attributes
    ----------
    possible : (p,) places in the known points of those that become control or check points
    always : (c,) places of those that can only be check points, since they state no sigma
    fixed : (f,) planimetric and height points: control in every run
    lost : (l,) places of those with less image points than are wanted, which take no part
    single : no point has two image points, as in one scene alone or one strip of one CCD line: one is wanted, and
        check points are compared at their given heights; else two are wanted
    """

    possible: Indices
    always: Indices
    fixed: Indices
    lost: Indices
    single: bool = False

    @property
    def most(self) -> int:
        """Largest number of control points that leaves a check point."""
        return len(self.possible) - (len(self.always) == 0)


def pool_of(block: Block) -> Pool:
    """Raises UserError where there is nothing that could be a check point."""
    ground, rays = block.ground, block.measured()
    role = np.array(ground.role, dtype=object)
    full = (role == "control") | (role == "check")
    count = np.array([rays.get(id, 0) for id in ground.id], dtype=np.int64)
    single = not (full & (count > 1)).any()
    seen = count >= (1 if single else 2)
    variance = np.einsum("nii->ni", ground.covariance).reshape(-1, 3)
    stated = (variance > 0).all(axis=1)
    parts = (full & seen & stated, full & seen & ~stated, ~full, full & ~seen)
    pool = Pool(*(np.flatnonzero(m) for m in parts), single=single)
    if len(pool.possible) + len(pool.always) == 0:
        what = "known points" if not len(ground) else "control or check points with image points"
        raise UserError(f"{block.name}: no {what}, so that nothing can be checked; wanted some in ground_points.csv")
    return pool


def default_numbers(pool: Pool) -> tuple[int, ...]:
    """0, 4, 9, 16, 25 control points, as far as there are, and as half of the points at least stay check points; not 0
    where single image points determine nothing without."""
    n = len(pool.possible) + len(pool.always)
    some = tuple(k for k in (4, 9, 16, 25) if k <= min(pool.most, n // 2))
    return some if pool.single and some else (0, *some)


def with_control(block: Block, pool: Pool, number: int) -> tuple[Block, tuple[str, ...]]:
    """The block with so many control points, spread out, all others check points; and their names."""
    ground = block.ground
    chosen = pool.possible[spread_choice(block.plan_m()[pool.possible], number)]
    role = np.array(ground.role, dtype=object)
    role[np.r_[pool.possible, pool.always]] = "check"
    role[chosen] = "control"
    # points in the order of the rest: who takes no part is neither control nor check
    keep = np.setdiff1d(np.arange(len(ground)), pool.lost)
    left = KnownPoints(
        tuple(ground.id[k] for k in keep), ground.xyz_l[keep], ground.covariance[keep], tuple(role[keep]),
        tuple(ground.target_radius_m[k] for k in keep) if ground.target_radius_m else (),
    )  # fmt: skip
    return block.with_ground(left), tuple(ground.id[k] for k in chosen)


@dataclass(frozen=True)
class Work:
    """All runs of a study: blocks by number of control points, and what is run on them."""

    blocks: Mapping[int, Block] = field(repr=False)
    runs: tuple[tuple[int, Configuration], ...]
    settings: Settings


def run_all(work: Work, jobs: int, tell: Tell = None) -> list[Run]:
    """Run everything, on several processes where ``jobs`` says so; in the order of the work."""
    total, jobs = len(work.runs), min(jobs, len(work.runs))
    done: dict[int, Run] = {}

    def keep(k: int, run: Run) -> None:
        done[k] = run
        if tell is not None:
            tell(len(done) / total)

    if jobs > 1:
        try:
            with WorkerPool(jobs, _begin, (work,)) as pool:
                futures = {pool.submit(_one, k): k for k in range(total)}
                for future in as_completed(futures):
                    keep(futures[future], future.result())
        except BrokenProcessPool:  # killed, most often for its memory: one at a time needs less
            pass
        except (OSError, ImportError, NotImplementedError):  # no processes or semaphores to be had here
            pass
    for k in range(total):
        if k not in done:
            keep(k, run_one(work, k))
    return [done[k] for k in range(total)]


def run_one(work: Work, k: int) -> Run:
    """One of the runs; one that fails says why."""
    number, configuration = work.runs[k]
    start = time.perf_counter()
    found, failed = None, ""
    try:
        with np.errstate(all="ignore"):  # what is not finite is told
            found = work.blocks[number].run(configuration, work.settings)
    except UserError as error:
        failed = str(error).removeprefix(f"{work.blocks[number].name}: ")
    except (ValueError, ArithmeticError, MemoryError) as error:
        failed = f"cannot be adjusted: {error or type(error).__name__}"
    return Run(number, configuration, time.perf_counter() - start, found, " ".join(failed.split()))


_work: Work | None = None


def _begin(work: Work) -> None:
    global _work
    _work = work


def _one(k: int) -> Run:
    assert _work is not None
    return run_one(_work, k)
