"""The adjustment of a block of satellite scenes: images from a folder's scenes, stages, ``result.json`` and tables."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.units import place_columns
from ...solver.adjustment.reliability import CRITICAL_W, reliability
from ...solver.adjustment.statistics import GlobalTest, global_test, mean_sigma, point_accuracy, strongest_correlations
from ...solver.adjustment.variance_components import LEAST_REDUNDANCY
from ...solver.camera.self_calibration import SELF_CALIBRATIONS, unit_of
from ...solver.location.affine_bias import LARGE_TURN
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.rpc_fit import fit_to_model
from ...solver.models import MODELS
from ...solver.models.base import Extent, ModelOptions
from ...solver.orbit.time_scales import iso_utc
from ...solver.scene_adjustment.functional import RpcImage
from ...solver.scene_adjustment.images import CAMERA, IMAGE, ORIENTATION, ImageModel
from ...solver.scene_adjustment.rigorous import CorrectionSet, RigorousImage, calibration_of, flight_axes_b
from ...solver.scene_adjustment.single_looks import SingleLooks, single_looks
from ...solver.scene_adjustment.snooping import SceneSnooping, snoop
from ...solver.scene_adjustment.solution import (
    NotAdjustableError,
    Problem,
    SceneSolution,
    adjust,
    intersect,
    points_enu,
    prepare,
    where_rays_meet,
)
from ..errors import UserError
from ..first_of import first_of
from ..formats.json_text import plain
from ..formats.satellite.rpc_files import write_rpb
from ..formats.scene_block import ImageEntry, SceneBlockData
from ..formats.table import write_table
from .adjustment_result import (
    HOPELESS,
    MOST_LISTED,
    deserted_note,
    elsewhere,
    expected_rmse,
    failing_note,
    reliability_summary,
    single_accuracy,
    with_height,
)
from .two_steps import sigmas_stated, step_settings

Array = NDArray[np.floating]

#: Trajectory models that correct a scene, and sets of additional parameters that a line of detectors can have.
SCENE_MODELS = ("dgr", "ppm", "lim")
SCENE_CALIBRATIONS = ("none", "lens", "prism30")
#: What shares a correction set.
SETS = ("lens", "scene")
#: Lines between two rows of trajectory_refined.csv.
_ROWS = 101
#: Heights of a fitted RPC reach so far beyond those of the points, metres.
_BEYOND_M = 500.0
#: Control so many metres from where its rays meet is not where it is stated. Derived: half a degree of attitude from
#: 830 km up is less.
_ELSEWHERE_M = 10_000.0
TABLES = ("points.csv", "residuals.csv", "trajectory_refined.csv")


@dataclass(frozen=True)
class SceneJob:
    """What to do.

    Attributes
    ----------
    model, then : names of trajectory models; ``then`` corrects what the first one left, None for one stage
    given : options of the models by name (`two_steps.OWNERS`)
    self_calibration : name of a set, or "none"
    free : additional parameters without a-priori weight
    sets : a correction set for each "lens", or for each "scene" with all its lenses
    snoop, critical : data snooping, and its critical value
    iterations : of an adjustment, at most
    """

    model: str = "dgr"
    then: str | None = None
    given: Mapping[str, int | None] = field(default_factory=dict)
    self_calibration: str = "none"
    free: bool = False
    sets: str = "lens"
    snoop: bool = False
    critical: float = CRITICAL_W
    iterations: int = 30


@dataclass(frozen=True)
class SceneAdjustment:
    """A finished job.

    Attributes
    ----------
    data, job : input
    problem : before the adjustment of the last stage
    solution : after it
    snooping : what was left out; None where nothing was looked for
    seconds : wall time of the adjustment
    before : problem and solution of the first of two steps
    """

    data: SceneBlockData
    job: SceneJob
    problem: Problem
    solution: SceneSolution
    snooping: SceneSnooping | None
    seconds: float
    before: tuple[Problem, SceneSolution] | None = None

    @property
    def test(self) -> GlobalTest:
        """Chi-square test of sigma0."""
        return _test(self.solution)

    @property
    def sigma0(self) -> float:
        """What sigmas are scaled with, see `_scale`."""
        return _scale(self.solution)

    @cached_property
    def single_looks(self) -> SingleLooks:
        """Rays of check points that nothing else determines."""
        return single_looks(self.solution, self.sigma0)

    def values_of(self, image: int) -> Array:
        """Unknowns of an image."""
        return self.solution.state.values[self.problem.block.layout.columns[image]]


def run_scene_job(data: SceneBlockData, job: SceneJob) -> SceneAdjustment:
    """Adjust a block of scenes.

    Raises
    ------
    UserError : a block from which nothing can be computed or that does not converge, settings that no model takes
    """
    start = time.perf_counter()
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused
            sensors: list[PushbroomSensor | None] = [
                e.location if isinstance(e.location, PushbroomSensor) else None for e in data.images
            ]
            problem, solution, found = _stage(data, job, sensors)
            before = None
            if job.then is not None:
                before, sensors = (problem, solution), _corrected(problem, solution, sensors)
                problem, solution, found = _stage(data, job, sensors, second=True)
    except NotAdjustableError as error:
        raise UserError(f"{data.name}: {error}") from None
    except ValueError as error:
        raise UserError(f"{data.name}: cannot be adjusted: {error}") from None
    seconds = time.perf_counter() - start
    adjustment = SceneAdjustment(data, job, problem, solution, found, seconds, before)
    sigma0 = adjustment.test.sigma0
    if not solution.converged and sigma0 > HOPELESS:
        raise UserError(f"{data.name}: does not converge (sigma0 {sigma0:.3g}); {_where_to_look(adjustment)}")
    return adjustment


def _where_to_look(a: SceneAdjustment) -> str:
    """What to check when nothing fits, in words: control that lies elsewhere, the image with the largest residuals."""
    problem, known = a.problem, a.problem.block.known
    size = np.linalg.norm(np.nan_to_num(a.solution.residual_px, nan=np.inf), axis=1)
    median = [float(np.median(size[mine])) for mine in problem.block.rays_of]
    worst = int(np.argmax(median))
    pixels = f", {median[worst]:.0f} px" if np.isfinite(median[worst]) else ""
    said = f"residuals are largest in image {a.data.images[worst].name}{pixels}: check its metadata and image points"
    try:
        with np.errstate(all="ignore"):  # what is not finite is not determined
            position, determined = where_rays_meet((a.before or (problem,))[0])
    except NotAdjustableError:
        return said
    k = np.flatnonzero(known.given.any(axis=1) & determined[known.point])
    if not len(k):
        return said
    off = np.where(known.given[k], points_enu(problem, position, known.position_e[k], known.point[k]), 0.0)
    far = elsewhere([a.data.point_ids[p] for p in known.point[k]], np.linalg.norm(off, axis=1), _ELSEWHERE_M)
    return f"{far}; {said}" if far else said


def _stage(
    data: SceneBlockData, job: SceneJob, sensors: Sequence[PushbroomSensor | None], second: bool = False
) -> tuple[Problem, SceneSolution, SceneSnooping | None]:
    problem = prepare(data.block(images_of(data, job, sensors, second)))
    solution = adjust(problem, max_iterations=job.iterations)
    if not job.snoop:
        return problem, solution, None
    found = snoop(solution, job.critical, job.iterations)
    return problem, found.solution, found


def _corrected(
    problem: Problem, solution: SceneSolution, sensors: Sequence[PushbroomSensor | None]
) -> list[PushbroomSensor | None]:
    """Sensors with the orbit and attitude of a stage; their lenses as they were."""
    out: list[PushbroomSensor | None] = []
    for image, columns, sensor in zip(problem.block.images, problem.block.layout.columns, sensors, strict=True):
        if isinstance(image, RigorousImage) and sensor is not None:
            located = image.located(solution.state.values[columns])
            sensor = sensor.changed(located.motion, sensor.look)
        out.append(sensor)
    return out


def images_of(
    data: SceneBlockData, job: SceneJob, sensors: Sequence[PushbroomSensor | None], second: bool = False
) -> tuple[ImageModel, ...]:
    """The images of a block with their unknowns, those of the second of two steps if ``second``."""
    refined = second and not sigmas_stated(data.then)  # see `CorrectionSet`
    _model(data, job, data.images, second)  # refuses settings also where no image takes them
    spans = [None if s is None else _span(s) for s in sensors]
    shared: dict[str, CorrectionSet] = {}
    images: list[ImageModel] = []
    for k, (entry, sensor, span) in enumerate(zip(data.images, sensors, spans, strict=True)):
        if entry.scene.model != "rigorous" or sensor is None or span is None:
            images.append(data.functional_image(entry))
            continue
        key = entry.name if job.sets == "lens" else entry.scene.name
        if key not in shared:
            mine = [i for i, e in enumerate(data.images) if (e.name if job.sets == "lens" else e.scene.name) == key]
            ends = [s for i in mine if (s := spans[i]) is not None]
            whole = min(s for s, _ in ends), max(e for _, e in ends)
            rays = [i in mine for i in data.rays.image]
            times = np.concatenate(
                [s.line_times.time_of(data.rays.line[data.rays.image == i]) for i in mine if (s := sensors[i])]
                or [np.empty(0)]
            )
            extent = Extent(f"strip {key}", *whole, times if any(rays) else np.empty(0), np.empty(0),
                            job.self_calibration != "none")  # fmt: skip
            axes_b = flight_axes_b(sensor, 0.5 * sum(whole))
            options = _model(data, job, [data.images[i] for i in mine], second)
            shared[key] = CorrectionSet(key, options.build(extent), axes_b, refined)
        images.append(RigorousImage(entry.name, sensor, shared[key], _calibration(data.images[k], sensor, job)))
    return tuple(images)


def _calibration(entry: ImageEntry, sensor: PushbroomSensor, job: SceneJob) -> Any:
    if job.self_calibration == "none" or entry.view is None:
        return None
    key = f"{entry.scene.camera}/{entry.ccd}" if entry.ccd else entry.scene.camera

    def make(camera: Any) -> Any:
        parameters = SELF_CALIBRATIONS[job.self_calibration](camera)
        return parameters.free() if job.free else parameters

    return calibration_of(key, sensor, entry.view, make)


def _model(data: SceneBlockData, job: SceneJob, images: Sequence[ImageEntry], second: bool) -> ModelOptions:
    """The trajectory model of images that share their corrections, with the sigmas that hold for them."""
    steps = step_settings(data.trajectory_settings(images), data.then, job.model, job.then, job.given)
    model = job.then if second and job.then is not None else job.model
    try:
        return MODELS[model].from_settings(steps[second])
    except ValueError as error:
        raise UserError(f"{data.name}: model {model}: {error}") from None


def _span(sensor: PushbroomSensor) -> tuple[float, float]:
    ends = np.sort(sensor.line_times.time_of(np.array([0.0, max(sensor.lines - 1.0, 1.0)])))
    return float(ends[0]), float(ends[1])


# result.json


def scene_result(a: SceneAdjustment) -> dict[str, Any]:
    """The content of ``result.json``: keys as of any adjustment, what cannot be computed is None."""
    s, data = a.solution, a.data
    sigma = _sigmas(s)
    image_sigma = float(np.median(data.rays.sigma_px))
    strips, parameters = _unknowns(a.problem, s)
    seen = a.problem.block.rays
    content = {
        "project": data.name,
        "crs": data.frame.crs,
        "model": a.job.model,
        "then": a.job.then,
        "selfcal": a.job.self_calibration,
        "sets": a.job.sets,
        "images": {i.name: i.kind for i in a.problem.block.images},
        "sigma0": a.test.sigma0,
        "sigma0_px": a.test.sigma0 * image_sigma,
        "image_sigma_px": image_sigma,
        "chi_square_test": {"low": a.test.low, "high": a.test.high, "passed": a.test.passed},
        "n_observations": s.n_observations,
        "n_unknowns": s.n_unknowns,
        "redundancy": s.redundancy,
        "n_image_points": len(seen),
        "n_points": len(data.point_ids),
        "iterations": s.iterations + (a.before[1].iterations if a.before else 0),
        "converged": s.converged,
        "seconds": a.seconds,
        "strips": strips,
        "additional_parameters": parameters,
        **_accuracies(a),
        "rejected": _rejected(a),
        "rejected_control": [
            {"point": data.point_ids[p], "coordinate": "XYZ"[axis], "w": _given_w(a, p, axis)}
            for p, axis in (a.snooping.coordinates if a.snooping else ())
        ],
        "doubtful_points": [],
        "variance_components": {},
        "reliability": _reliability(a),
        "correlations": _correlations(a, sigma),
        "undetermined": [{"words": words, "share": 0.0, "unknowns": [words]} for words in s.undetermined],
        "notes": _notes(a),
    }
    if a.before is not None:
        problem, solution = a.before
        strips, _ = _unknowns(problem, solution)
        content["before"] = [{"model": a.job.model, "sigma0": _test(solution).sigma0, "strips": strips}]
    return plain(content)


def _test(solution: SceneSolution) -> GlobalTest:
    return global_test(solution.weighted_squares, max(solution.redundancy, 0))


def _scale(solution: SceneSolution) -> float:
    """What sigmas are scaled with: sigma0 a posteriori, or 1 where image points and control have too little redundancy
    to estimate it."""
    return _test(solution).sigma0 if solution.measured_redundancy >= LEAST_REDUNDANCY else 1.0


def _sigmas(solution: SceneSolution) -> Array:
    """Sigmas (u,) of the unknowns, a posteriori."""
    return _scale(solution) * np.sqrt(np.maximum(np.diag(solution.values_covariance), 0.0))


def _unknowns(problem: Problem, solution: SceneSolution) -> tuple[dict[str, Any], dict[str, Any]]:
    """Corrections of every strip or image, and additional parameters."""
    layout, sigma = problem.block.layout, _sigmas(solution)
    strips: dict[str, Any] = {}
    parameters: dict[str, Any] = {}
    rigorous = [image for image in problem.block.images if isinstance(image, RigorousImage)]
    models = {image.corrections.key: image.corrections.model for image in rigorous}
    for k, group in enumerate(layout.groups):
        part = slice(int(layout.first[k]), int(layout.first[k + 1]))
        value, spread = solution.state.values[part], sigma[part]
        if group.kind == ORIENTATION:
            strips[group.key] = {"model": "rigorous"} | models[group.key].describe(value, spread)
        elif group.kind == IMAGE:
            kind = next(i.kind for i in problem.block.images if i.name == group.key)
            unit = {"unit": "px"} if kind == "rpc" else {}
            coefficients = {
                name.removesuffix(f" of {group.key}"): {"value": v, "sigma": e} | unit
                for name, v, e in zip(group.names, value, spread, strict=True)
            }
            strips[group.key] = {"model": kind, "coefficients": coefficients}
        elif group.kind == CAMERA:
            for name, v, e in zip(group.names, value, spread, strict=True):
                parameters[_unique(name, group.key, parameters)] = {
                    "value": v, "sigma": e, "t": v / e if e > 0 else 0.0, "status": "estimated", "reason": "",
                    "unit": unit_of(name), "lens": group.key,
                }  # fmt: skip
    return strips, parameters


def _unique(name: str, lens: str, taken: Mapping[str, Any]) -> str:
    """A name for an additional parameter: its own, with the lens where two lenses have it."""
    return name if name not in taken else f"{name} of {lens}"


def _rigorous(a: SceneAdjustment) -> list[RigorousImage]:
    return [image for image in a.problem.block.images if isinstance(image, RigorousImage)]


def _known(a: SceneAdjustment, *roles: str) -> NDArray[np.int64]:
    """Places of known points (k,) of some roles that an image point in use measures, and that are determined."""
    known, block = a.problem.block.known, a.problem.block
    measured = np.zeros(len(block.point_ids), dtype=bool)
    measured[block.rays.point[a.solution.ray_weight > 0]] = True  # others stay where they are given
    places = [k for k, role in enumerate(known.role) if role in roles]
    return np.array([k for k in places if (measured & a.solution.determined)[known.point[k]]], dtype=np.int64)


def differences(a: SceneAdjustment, *roles: str) -> tuple[NDArray[np.int64], Array]:
    """Known points (k,) of some roles that are measured and determined, and adjusted minus given (k, 3), metres.

    East, north, up; NaN where the role says that a coordinate is not given, and where it was left out.
    """
    known, k = a.problem.block.known, _known(a, *roles)
    points = known.point[k]
    d = points_enu(a.problem, a.solution.state.position_e, known.position_e[k], points)
    check = np.array([known.role[i] == "check" for i in k], dtype=bool)
    d = np.where(known.given[k] | check[:, None], d, np.nan)
    for p, axis in a.snooping.coordinates if a.snooping else ():
        d[points == p, axis] = np.nan
    return points, d


def point_sigmas(a: SceneAdjustment) -> Array:
    """Sigmas (p, 3) in metres of all points, east, north, up, a posteriori; NaN where not determined."""
    return a.sigma0 * np.sqrt(np.maximum(np.einsum("pii->pi", a.solution.points_covariance), 0.0))


def _accuracies(a: SceneAdjustment) -> dict[str, Any]:
    block, sigma = a.problem.block, point_sigmas(a)
    known = block.known
    found: dict[str, Any] = {}
    for key, roles in (("check", ("check",)), ("control", ("control", "planimetric", "height"))):
        points, d = differences(a, *roles)
        mine = np.where(np.isfinite(d), sigma[points], np.nan)
        survey = np.einsum("nii->ni", known.covariance_enu[_known(a, *roles)])
        found[key] = _accuracy(d, mine) | _expected(a, mine, survey, independent=key == "check")
    tie = a.solution.determined.copy()
    tie[known.point] = False
    found["tie"] = {"n": int(tie.sum()), "sigma_m": mean_sigma(sigma[tie]).tolist()}
    alone = a.single_looks
    found["check_single"] = _single_accuracy(alone)
    against = "check" if "check" in known.role else "control"
    k = _known(a, against)
    locating = np.array([image.locates for image in block.images])[block.rays.image]
    first, solution = a.before or (a.problem, a.solution)
    beforehand = _beforehand(first, solution)
    if not len(k) and len(alone.rays):
        direct = single_looks(replace(solution, determined=a.solution.determined), 1.0, beforehand)
        d, against = with_height(direct.difference_m[locating[direct.rays]]), "check_single"
    else:
        position, determined = intersect(first, beforehand, locating)
        k = k[determined[known.point[k]]] if len(k) else k
        d = points_enu(a.problem, position, known.position_e[k], known.point[k])
    found["direct_georeferencing"] = _accuracy(d, np.full_like(d, np.nan)) | {"against": against}
    return found


def _single_accuracy(alone: SingleLooks) -> dict[str, Any]:
    """Accuracy of the rays of check points that nothing else determines, at the given heights."""
    if not len(alone.rays):
        return {"n": 0}
    v = alone.residual_px
    return single_accuracy(alone.difference_m, alone.sigma_m, alone.expected_m) | {
        "rmse_px": np.sqrt(np.mean(np.square(v), axis=0)).tolist(),
        "mean_px": v.mean(axis=0).tolist(),
        "max_px": np.abs(v).max(axis=0).tolist(),
        "expected_px": np.sqrt(np.mean(np.square(alone.sigma_px), axis=0)).tolist(),
    }


def _expected(a: SceneAdjustment, sigma: Array, survey: Array, *, independent: bool) -> dict[str, Any]:
    """RMSE to be expected of the differences to given coordinates, which have errors of their own.

    As of any adjustment (`adjustment_result`): check points differ by both errors; control took part, and its sigmas
    scale with the others, so that the variance of its differences is that of the given coordinate less that of the
    adjusted one.

    Parameters
    ----------
    sigma : (k, 3) of the adjusted points, NaN where nothing is compared
    survey : (k, 3) variances of the given coordinates, 0 where none is stated
    """
    return expected_rmse(survey + sigma**2 if independent else a.sigma0**2 * survey - sigma**2)


def _beforehand(problem: Problem, solution: SceneSolution) -> Any:
    """Points as they are, with the unknowns of images that locate by themselves at zero."""
    values = solution.state.values.copy()
    for image, columns in zip(problem.block.images, problem.block.layout.columns, strict=True):
        if image.locates:
            values[columns] = 0.0
    return type(solution.state)(solution.state.position_e, values)


def _accuracy(difference: Array, sigma: Array) -> dict[str, Any]:
    found = point_accuracy(difference, sigma)
    return {
        "n": found.n,
        "rmse_m": found.rmse_m,
        "mean_m": found.mean_m,
        "max_m": found.max_m,
        "sigma_m": found.sigma_m,
    }


def _rejected(a: SceneAdjustment) -> list[dict[str, Any]]:
    if a.snooping is None:
        return []
    out = []
    for ray, w in zip(a.snooping.rays, a.snooping.w, strict=True):
        entry = a.data.images[a.data.rays.image[ray]]
        out.append(
            {
                "point": a.data.point_ids[a.data.rays.point[ray]],
                "strip": entry.scene.name,
                "ccd": entry.ccd,
                "w": float(w),
                "reason": "snooping",
            }
        )
    return out


def _reliability(a: SceneAdjustment) -> dict[str, Any]:
    """Summary over the image points that take part, line and sample."""
    used = a.solution.ray_weight
    return reliability_summary(reliability(a.solution.redundancy_numbers[used], a.data.rays.sigma_px[used, None]))


def _given_w(a: SceneAdjustment, p: int, axis: int) -> float:
    """Normalised residual of a coordinate, adjusted minus given, as blocks of flights have it."""
    problem, s = a.problem, a.solution
    miss = problem.R_e_enu[p][:, axis] @ (s.state.position_e[p] - problem.given_e[p])
    variance = problem.covariance_enu[p, axis, axis] + np.nan_to_num(s.points_covariance[p, axis, axis])
    return float(miss / np.sqrt(variance))


def _correlations(a: SceneAdjustment, sigma: Array) -> list[dict[str, Any]]:
    if not len(sigma) or len(sigma) > 1500:
        return []
    pairs = strongest_correlations(a.solution.values_covariance, a.problem.block.layout.names)
    return [{"between": [p.first, p.second], "r": p.correlation} for p in pairs[:MOST_LISTED]]


def _notes(a: SceneAdjustment) -> list[str]:
    notes = list(a.data.notes)
    s, data = a.solution, a.data
    alone = np.unique(data.rays.point[a.single_looks.rays])
    undetermined = np.setdiff1d(np.flatnonzero(~s.determined), alone)
    lost = [data.point_ids[p] for p in undetermined if (data.rays.point == p).any()]
    if lost:
        notes.append(f"{len(lost)} points are not determined by their rays and were left out: {first_of(lost, 5)}")
    blind = int((~np.isfinite(s.residual_px).all(axis=1)).sum())
    if blind:
        notes.append(f"{blind} rays look away from their point and take no part")
    if a.snooping is not None and a.snooping.given_up:
        share = 100 * a.snooping.given_up
        notes.append(f"data snooping given up: {share:.0f} % of the image points would go; model or sigmas are wrong")
    notes += _turned_notes(a)
    notes += _without_control_notes(a)
    notes += _control_notes(a)
    notes += _single_look_note(a)
    if a.before is not None and not a.before[1].converged:
        notes.append(f"the first of two steps has not converged after {a.before[1].iterations} iterations")
    if not s.converged:
        notes.append(f"not converged after {s.iterations} iterations")
    if s.redundancy <= 0:
        notes.append("no redundancy: nothing is checked")
    elif s.measured_redundancy < LEAST_REDUNDANCY:
        notes.append(
            f"redundancy of image points and control is {s.measured_redundancy:.1f}: too little for sigma0; "
            "sigmas are those of the a-priori weights"
        )
    notes += [f"undetermined: {words}" for words in s.undetermined]
    for image in _rigorous(a):
        notes += [n for n in image.corrections.model.notes if n not in notes]
    if _rigorous(a):
        notes.append("corrections: X along the track, Y across it to the right, Z up; omega about forward, phi about "
                     "right, kappa about down")  # fmt: skip
    return notes


def _turned_notes(a: SceneAdjustment) -> list[str]:
    """Images whose polynomials no orbit and no attitude can be as wrong for as their correction says."""
    notes = []
    for k, image in enumerate(a.problem.block.images):
        if isinstance(image, RpcImage) and (turned := image.located(a.values_of(k)).bias.turned) > LARGE_TURN:
            notes.append(
                f"image {image.name}: its correction turns or stretches it by {100.0 * turned:.0f} % of its size: are "
                "lines and samples those of the image as it is, from above and from the left?"
            )
    return notes


def _without_control_notes(a: SceneAdjustment) -> list[str]:
    """Images all of whose pixels of control, several, data snooping has left out."""
    of_control = np.isin(a.data.rays.point, np.flatnonzero(a.problem.given.any(axis=1)))
    kept, n = (np.bincount(a.data.rays.image[of_control & which], minlength=len(a.data.images))
               for which in (a.solution.ray_weight, np.ones(len(of_control), dtype=bool)))  # fmt: skip
    return [
        f"image {entry.name}: all its {n[k]} pixels of control are left out: it lies where its metadata and the other "
        "images say; are lines and samples, or places, those of this image?"
        for k, entry in enumerate(a.data.images)
        if n[k] > 2 and not kept[k]
    ]


def _control_notes(a: SceneAdjustment) -> list[str]:
    """What is to be said of control that does not fit, and of control that no image measures, or no longer does."""
    rays, ids = a.data.rays.point, a.data.point_ids
    given = a.problem.given.any(axis=1)
    measured, kept = (np.isin(np.arange(len(ids)), points) for points in (rays, rays[a.solution.ray_weight]))
    said = failing_note(ids, -a.solution.given_test, a.job.critical)  # adjusted minus given
    said += deserted_note([ids[p] for p in np.flatnonzero(a.solution.given.any(axis=1) & measured & ~kept)])
    n, never = np.count_nonzero(given), np.count_nonzero(given & ~measured)
    if never == n:
        what = f"no control point of {n} is measured in an image" if n else "no control"
        of = "orbits" if _rigorous(a) else "polynomials"
        return [f"{what}: where the block lies comes from the a-priori sigmas of its {of}"]
    return [f"{never} of {n} control points are measured in no image", *said] if never else said


def _single_look_note(a: SceneAdjustment) -> list[str]:
    """Pixels of check points of one ray that lie elsewhere than the adjusted image says; nothing where none do."""
    alone = a.single_looks
    points = [a.data.point_ids[p] for p in a.data.rays.point[alone.rays]]
    return failing_note(points, alone.test, a.job.critical, "pixels of check points", ("line", "sample"))


# tables


def write_scene_tables(a: SceneAdjustment, folder: Path) -> list[str]:
    """Write points, residuals, refined orientation, and an RPC for every image; returns notes."""
    _write_points(a, folder / "points.csv")
    _write_residuals(a, folder / "residuals.csv")
    _write_orientation(a, folder / "trajectory_refined.csv")
    return _write_rpcs(a, folder / "rpc")


def _write_points(a: SceneAdjustment, path: Path) -> None:
    data, s = a.data, a.solution
    frame = data.frame
    n = len(data.point_ids)
    places, sigma = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    known = s.determined
    if known.any():
        local = (s.state.position_e[known] - frame.origin_e) @ frame.R_el
        places[known] = frame.to_crs(local)
        R = np.swapaxes(frame.R_l_crs(places[known]), -1, -2) @ frame.R_el.T @ a.problem.R_e_enu[known]
        C = R @ s.points_covariance[known] @ np.swapaxes(R, -1, -2)
        sigma[known] = a.sigma0 * np.sqrt(np.maximum(np.einsum("pii->pi", C), 0.0))
    rays = np.bincount(data.rays.point, s.ray_weight, n).astype(int)
    role = np.full(n, "tie", dtype=object)
    role[a.problem.block.known.point] = a.problem.block.known.role
    flat = ".10f" if frame.is_geographic else ".5f"
    columns: dict[str, Any] = {"point": data.point_ids}
    axes = place_columns(frame.units)
    columns |= {axis: places[:, k] for k, axis in enumerate(axes)}
    columns |= {f"sigma_{axis}_m": sigma[:, k] for k, axis in enumerate("XYZ")}
    columns |= {"rays": rays, "role": role}
    formats = dict(zip(axes, (flat, flat, ".5f"), strict=True)) | {f"sigma_{axis}_m": ".6f" for axis in "XYZ"}
    write_table(path, columns, formats)


def _write_residuals(a: SceneAdjustment, path: Path) -> None:
    data, s = a.data, a.solution
    entries = [data.images[k] for k in data.rays.image]
    r = reliability(s.redundancy_numbers, data.rays.sigma_px[:, None])
    columns: dict[str, Any] = {
        "point": [data.point_ids[p] for p in data.rays.point],
        "strip": [e.scene.name for e in entries],
        "ccd": [e.ccd for e in entries],
        "line": data.rays.line,
        "sample": data.rays.sample,
    }
    formats = {"line": ".5f", "sample": ".5f"}
    detectable = np.where(np.isfinite(r.detectable), r.detectable, np.nan)
    w = s.test.copy()
    w[a.single_looks.rays] = a.single_looks.test
    for name, values, spec in (
        ("v_{}_px", s.residual_px, ".5f"), ("w_{}", w, ".4f"), ("redundancy_{}", r.redundancy, ".5f"),
        ("detectable_{}_px", detectable, ".4f"),
    ):  # fmt: skip
        for k, coordinate in enumerate(("line", "sample")):
            columns[name.format(coordinate)] = values[:, k]
            formats[name.format(coordinate)] = spec
    out = np.zeros(len(data.rays), dtype=int)
    if a.snooping is not None:
        out[a.snooping.rays] = 1
    write_table(path, columns | {"rejected": out}, formats)


_AXES = ("X_m", "Y_m", "Z_m", "qx", "qy", "qz", "qw")
_SIGMAS = ("sigma_along_m", "sigma_across_m", "sigma_up_m", "sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")


def _write_orientation(a: SceneAdjustment, path: Path) -> None:
    """Earth-fixed pose of the body at lines of the rigorous images, with sigmas of the corrections."""
    from scipy.spatial.transform import Rotation

    columns: dict[str, list[Any]] = {
        name: [] for name in ("strip", "ccd", "line", "time_s", "time_utc", *_AXES, *_SIGMAS)
    }
    layout = a.problem.block.layout
    for k, (entry, image) in enumerate(zip(a.data.images, a.problem.block.images, strict=True)):
        if not isinstance(image, RigorousImage):
            continue
        sensor = image.located(a.values_of(k))
        line = np.unique(np.round(np.linspace(0.0, sensor.lines - 1.0, min(_ROWS, sensor.lines))))
        pose, t = sensor.pose(line), sensor.line_times.time_of(line)
        model = image.corrections.model
        numbers, functions = model.design(t).functions()
        own = layout.columns[k][: model.n_unknowns][numbers]
        Q = a.solution.values_covariance[np.ix_(own, own)]
        sigma = a.sigma0 * np.sqrt(np.maximum(np.einsum("nci,ij,ncj->nc", functions, Q, functions), 0.0))
        sigma[:, 3:] = np.degrees(sigma[:, 3:])
        columns["strip"] += [entry.scene.name] * len(line)
        columns["ccd"] += [entry.ccd] * len(line)
        columns["line"] += line.tolist()
        columns["time_s"] += t.tolist()
        stamps = sensor.reference_ns + np.round(t * 1e9).astype(np.int64)
        columns["time_utc"] += [iso_utc(int(ns), 9) if sensor.reference_ns else "" for ns in stamps]
        values = np.hstack([pose.position_e, Rotation.from_matrix(pose.R_eb).as_quat(), sigma])
        for name, column in zip((*_AXES, *_SIGMAS), values.T, strict=True):
            columns[name] += column.tolist()
    formats = {"line": ".0f", "time_s": ".9f"} | dict.fromkeys(_AXES[:3], ".4f") | dict.fromkeys(_AXES[3:], ".12f")
    formats |= dict.fromkeys(_SIGMAS[:3], ".5f") | dict.fromkeys(_SIGMAS[3:], ".9f")
    write_table(path, columns, formats)


def _write_rpcs(a: SceneAdjustment, folder: Path) -> list[str]:
    """Rational polynomials of the adjusted images; a note says where there are none, or where they fit badly."""
    heights = a.problem.block.ellipsoid.geodetic(a.solution.state.position_e[a.solution.determined])[:, 2]
    low, high = float(heights.min()) - _BEYOND_M, float(heights.max()) + _BEYOND_M
    notes = []
    of_name: dict[str, str] = {}  # file -> image
    for k, (entry, image) in enumerate(zip(a.data.images, a.problem.block.images, strict=True)):
        if entry.size_px is None:
            notes.append(
                f"image {entry.name}: no RPC written: its metadata do not say how large it is; name the image itself "
                "as metadata, with the polynomials in it or beside it"
            )
            continue
        located: Any = image.located(a.values_of(k))
        try:
            fit = fit_to_model(located, low, high)
        except ValueError as error:
            notes.append(f"image {entry.name}: no RPC written: {error}")
            continue
        folder.mkdir(exist_ok=True)
        first = name = entry.name.replace("/", "_")
        number = 1
        while name in of_name:  # a/F and a_F
            number += 1
            name = f"{first}_{number}"
        of_name[name] = entry.name
        write_rpb(folder / f"{name}.RPB", fit.rpc)
        if name != first:
            notes.append(f"image {entry.name}: its RPC is {name}.RPB, beside that of image {of_name[first]}")
        if fit.max_px > 0.05:
            notes.append(f"image {entry.name}: its RPC differs from the adjusted model by up to {fit.max_px:.2g} px")
    return notes
