"""A batch adjustment as its ``result.json``: plain numbers, degrees and metres, names as in the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.adjustment.adjustment import Solution
from ...solver.adjustment.block_data import BlockData
from ...solver.adjustment.job import BatchResult, Job
from ...solver.adjustment.layout import CorrectionSet
from ...solver.adjustment.network import Control, Network
from ...solver.adjustment.reliability import HEAVY_TAILS, MISMATCHES, NARROWLY, Reliability, reliability
from ...solver.adjustment.single_looks import single_looks
from ...solver.adjustment.snooping import control_tests
from ...solver.adjustment.statistics import (
    PointAccuracy,
    global_test,
    mean_sigma,
    point_accuracy,
    strongest_correlations,
)
from ...solver.adjustment.surface_control import SurfaceFit
from ...solver.adjustment.variance_components import CONSTANTS, LEAST_REDUNDANCY
from ...solver.camera.line_camera import LineCamera
from ...solver.camera.self_calibration import SelfCalibration, calibrated, unit_of
from ...solver.geometry.frames import CrsError, LocalFrame
from ...solver.models.base import ERROR_GROUPS
from ..first_of import first_of
from ..formats.json_text import plain

Array = NDArray[np.floating]

#: Pairs of correlated unknowns and undetermined combinations that are listed at most.
MOST_LISTED = 20

#: Undetermined combinations that the notes name.
MOST_NAMED = 4

#: Axes of a CRS that are turned by more against east and north are told, degrees: a tenth of X is in Y then.
TURNED_DEG = 5.0

#: Times in what a model says of a strip.
TIMES = ("time_s", "start_s", "end_s")

#: More undetermined combinations than a block with a defect has.
MANY_WEAK = 30

#: The file that has all of the result, and those beside it.
RESULT = "result.json"
TABLES = ("points.csv", "residuals.csv", "trajectory_refined.csv")
CAMERA, PER_LINE = "camera.json", "orientation_lines.csv"
#: Sigmas so many times as large as stated are a fault of something else.
UNLIKELY = 20.0
LIKELIER = "a wrong unit, datum, time or camera is likelier"
#: An adjustment that has not converged is refused if its sigma0 is larger than this.
HOPELESS = 100.0
#: Control so many metres from where its rays meet is not where it is stated, whatever the trajectory.
ELSEWHERE_M = 500.0
PLOTS = ("residuals.png", "points.png", "corrections.png")


@dataclass(frozen=True)
class Adjustment:
    """A finished job with what it was made from.

    Attributes
    ----------
    block : input
    job, result : what was done, what came out
    seconds : wall time of the job
    """

    block: BlockData
    job: Job
    result: BatchResult
    seconds: float

    def camera(self) -> LineCamera | None:
        """The camera with the estimated additional parameters in its tables; None where none was estimated."""
        full = self.job.self_calibration
        if full is None:
            return None
        solution = self.result.solution
        names = _parameter_names(solution)
        values = dict(zip(names, solution.camera_parameters.tolist(), strict=True))
        return calibrated(self.result.network.camera, full, values) if values else None

    @property
    def image_sigma_px(self) -> float:
        """Image sigma that sigma0 = 1 stands for; the median where measurements give their own."""
        rays = self.result.network.rays
        return float(np.median([rays.sigma_line_px, rays.sigma_sample_px])) * self.result.image_factor


def set_name(adjustment: Adjustment, item: CorrectionSet) -> str:
    """Strip of a correction set as the input names it, with the lens where lenses look separately."""
    network = adjustment.result.network
    strip = network.strips[item.strip].id
    lens = None if item.lens is None else network.camera.lenses[item.lens].id
    return strip if lens is None or strip.endswith(f"/{lens}") else f"{strip}/{lens}"


def result_of(adjustment: Adjustment) -> dict[str, Any]:
    """The content of ``result.json``; what cannot be computed is None."""
    result, solution = adjustment.result, adjustment.result.solution
    redundancy = solution.redundancy
    content = {
        "project": adjustment.block.name,
        "crs": adjustment.block.frame.crs,
        "model": adjustment.job.model.name,
        "then": adjustment.job.then.name if adjustment.job.then else None,
        "selfcal": adjustment.job.self_calibration.name if adjustment.job.self_calibration else "none",
        "sigma0": result.test.sigma0,
        "sigma0_px": result.test.sigma0 * adjustment.image_sigma_px,
        "image_sigma_px": adjustment.image_sigma_px,
        "chi_square_test": {"low": result.test.low, "high": result.test.high, "passed": result.test.passed},
        "sigma0_groups": {
            group: {"observations": n, "redundancy": r, "sigma0": float(np.sqrt(v / r)) if r > 1e-3 else None}
            for group, (n, v, r) in result.groups.items()
        },
        "n_observations": solution.n_observations - solution.assumed.number,
        "n_unknowns": solution.n_unknowns,
        "redundancy": redundancy,
        "n_image_points": len(solution.network.rays),
        "n_points": solution.network.n_points,
        "iterations": result.iterations,
        "converged": bool(solution.converged),
        "seconds": adjustment.seconds,
        "strips": strips_of(adjustment, solution),
        "additional_parameters": parameters_of(result, adjustment.job.self_calibration),
        **platform_of(result),
        **accuracies(result),
        **({} if result.surface is None else {"dem": _surface(result.surface)}),
        "rejected": rejected(adjustment),
        "rejected_control": [
            {"point": result.network.point_ids[r.point], "coordinate": "XYZ"[r.axis], "w": r.w}
            for r in result.rejected
            if r.ray < 0
        ],
        "doubtful_points": [
            {"point": result.network.point_ids[d.point], "rays_left_out": d.lost, "rays": d.rays, "reason": d.reason}
            for d in result.doubtful
        ],
        "variance_components": {
            c.group: {
                "observations": c.n,
                "redundancy": c.redundancy,
                "sigma_factor": c.factor,
                "sigma_factor_sigma": c.factor * c.uncertainty,
                "estimated": c.estimated,
            }
            for c in result.components
        },
        "reliability": _reliability(result),
        "correlations": _correlations(solution),
        "undetermined": [
            {"words": c.words, "share": c.share, "unknowns": list(c.unknowns)}
            for c in (result.weak or ())[:MOST_LISTED]
        ],
        "notes": notes_of(adjustment),
    }
    if len(result.stages) > 1:
        content["before"] = [
            {"model": s.problem.model.name, "sigma0": s.sigma0, "strips": strips_of(adjustment, s)}
            for s in result.stages[:-1]
        ]
    return plain(content)


def strips_of(adjustment: Adjustment, solution: Solution) -> dict[str, Any]:
    """Correction functions of every strip, as their model describes them, with the times of tables, and sigmas that are
    a posteriori of the model's own adjustment."""
    result = adjustment.result
    scaled = result.measured_redundancy >= LEAST_REDUNDANCY and solution.redundancy > 0
    sigma0 = solution.sigma0 if scaled else 1.0
    sigma = sigma0 * np.sqrt(np.maximum(solution.factor.variances(), 0.0))
    found = {}
    for item in solution.layout.sets:
        part = item.columns
        described = item.model.describe(solution.state.theta[part], sigma[part])
        found[set_name(adjustment, item)] = _timed(described, adjustment.block.time_reference_ns)
    return found


def _timed(described: Any, reference_ns: int) -> Any:
    """What a model describes, with its times as tables have them: of a recording UTC since 1970, s."""
    if isinstance(described, list):
        return [_timed(one, reference_ns) for one in described]
    if not isinstance(described, dict):
        return described
    return {
        key: value + reference_ns * 1e-9 if key in TIMES else _timed(value, reference_ns)
        for key, value in described.items()
    }


def platform_of(result: BatchResult) -> dict[str, Any]:
    """Constant errors of the platform, with their sigmas; nothing where none is an unknown.

    The orientation that a model refined has what it found of them; a model after it finds what is left.
    """
    solution, layout = result.solution, result.solution.layout
    sigma = result.sigma0 * np.sqrt(np.maximum(solution.factor.variances(), 0.0))
    found_by = np.array([stage.state.theta[stage.layout.platform_columns] for stage in result.stages])
    value = found_by.sum(axis=0)
    found = {
        name: {
            "value": float(value[k - layout.n_of_sets]),
            "sigma": float(sigma[k]),
            "unit": layout.platform.UNITS[name],
        }
        for name, k in zip(layout.platform.unknown_names, layout.platform_columns.tolist(), strict=True)
    }
    return {"platform": found} if found else {}


def parameters_of(result: BatchResult, full: SelfCalibration | None) -> dict[str, Any]:
    """All additional parameters of the set; for those that are gone value 0, and sigma and t when they went."""
    if full is None:
        return {}
    solution = result.solution
    names, first = _parameter_names(solution), solution.layout.n_model
    variances = solution.factor.variances()[first : first + len(names)]
    sigma = result.sigma0 * np.sqrt(np.maximum(variances, 0.0))
    value = dict(zip(names, solution.camera_parameters, strict=True))
    spread = dict(zip(names, sigma, strict=True))
    gone = {r.name: r for r in result.removed}
    found: dict[str, Any] = {}
    for name in full.unknown_names:
        if name in value:
            s = spread[name]
            t = value[name] / s if s > 0 else 0.0
            entry = {"value": value[name], "sigma": s, "t": t, "status": "estimated"}
            entry["reason"] = result.kept.get(name, "")
        else:
            r = gone[name]
            t = r.value / r.sigma if r.sigma > 0 else 0.0
            entry = {"value": 0.0, "sigma": r.sigma, "t": t, "status": "eliminated", "reason": r.reason}
            entry |= {"criterion": str(r.criterion), "figure": r.figure, "limit": r.limit}
        found[name] = entry | {"unit": unit_of(name)}
    return found


def _parameter_names(solution: Solution) -> tuple[str, ...]:
    """Names of the additional parameters that were estimated."""
    first = solution.layout.n_model
    return solution.layout.names[first : first + solution.layout.n_camera]


def _surface(fit: SurfaceFit) -> dict[str, Any]:
    """Heights of a raster: differences are raster minus points, of those that count in full, less the shift."""
    known = np.isfinite(fit.off_m)
    good = known & (fit.weight > 0.5)
    d = fit.off_m[good]
    return {
        "n": int(known.sum()),
        "sigma_m": fit.sigma_m,
        "rmse_m": float(np.sqrt(np.mean(d**2))) if len(d) else None,
        "half_weight_or_less": int((known & ~good).sum()),
        "shift_sigma_apriori_m": fit.shift_sigma_m,
        "shift_m": fit.shift.shift_m,
        "shift_sigma_m": fit.shift.sigma_m,
        "shift_w": fit.shift.w,
        "holds_height": not fit.shift.free,
    }


def accuracies(result: BatchResult) -> dict[str, Any]:
    """Empirical and theoretical accuracy of check, control and tie points, and of direct georeferencing.

    Direct georeferencing is compared with the check points, or with the control where there are none. Coordinates of
    control that were left out are compared with nothing, nor are points that no image point measures.
    """
    network, points, sigma = result.network, result.adjusted_points(), result.point_sigma_m
    surveyed = result.kept_control
    tie = result.solution.points.rank == 3
    tie[network.check.point] = tie[surveyed.point] = False
    reference = network.check if len(network.check) else surveyed
    direct = result.georeferenced
    alone = single_looks(result.solution, result.cofactors, result.sigma0)
    return {
        "check": _accuracy(result.compare(network.check, points, sigma))
        | _expected(result, network.check, sigma, independent=True),
        "check_single": single_accuracy(alone.difference_m, alone.sigma_m, alone.expected_m),
        "control": _accuracy(result.compare(surveyed, points, sigma))
        | _expected(result, surveyed, sigma, independent=False),
        "tie": {"n": int(tie.sum()), "sigma_m": mean_sigma(sigma[tie]).tolist()},
        "direct_georeferencing": _accuracy(result.compare(reference, direct.xyz_l, direct.sigma_m))
        | _expected(result, reference, direct.sigma_m, independent=True)
        | {"against": "check" if len(network.check) else "control"},
    }


def _expected(result: BatchResult, given: Control, sigma_m: Any, *, independent: bool) -> dict[str, Any]:
    """RMSE to be expected of the differences to given coordinates, which have errors of their own.

    Points that were adjusted without them differ by both errors; control took part, so that the variance of its
    differences is that of the given coordinate less that of the adjusted one.
    """
    sure = ~np.isin(given.point, [d.point for d in result.doubtful])
    used = np.isfinite(given.sigma_m) & sure[:, None] & np.isfinite(sigma_m[given.point])
    found = next((c.factor for c in result.components if c.group == "control"), 1.0)
    # sigmas of control scale with the others, and with the factor that was found for them
    sign, scale = (1.0, 1.0) if independent else (-1.0, result.sigma0 * found)
    variance = (scale * given.sigma_m) ** 2 + sign * sigma_m[given.point] ** 2
    return expected_rmse(np.where(used, variance, np.nan))


def expected_rmse(variance: Array) -> dict[str, Any]:
    """What is said of differences with variances (k, 3), NaN where nothing is compared; nothing where none is."""
    used = np.isfinite(variance)
    n = used.sum(axis=0)
    if not n.any():
        return {}
    mean = np.where(used, np.maximum(variance, 0.0), 0.0).sum(axis=0) / np.maximum(n, 1)
    return {"expected_m": np.where(n > 0, np.sqrt(mean), np.nan).tolist()}


def single_accuracy(difference_m: Array, sigma_m: Array, expected_m: Array) -> dict[str, Any]:
    """Accuracy of check points that their rays do not determine, at the given heights.

    Parameters
    ----------
    difference_m, sigma_m, expected_m : (k, 2) as of `single_looks`, of flights or of scenes
    """
    if not len(difference_m):
        return {"n": 0}
    expected = np.sqrt(np.mean(np.square(expected_m), axis=0))
    found = _accuracy(point_accuracy(with_height(difference_m), with_height(sigma_m)))
    return found | {"expected_m": [*expected.tolist(), np.nan]}


def with_height(plane: Array) -> Array:
    """X and Y (k, 2) with a height that is not compared (k, 3)."""
    return np.column_stack([plane, np.full(len(plane), np.nan)])


def _accuracy(a: PointAccuracy) -> dict[str, Any]:
    return {
        "n": a.n,
        "rmse_m": a.rmse_m.tolist(),
        "mean_m": a.mean_m.tolist(),
        "max_m": a.max_m.tolist(),
        "sigma_m": a.sigma_m.tolist(),
        "empirical_sigma_m": a.empirical_sigma_m.tolist(),
        "rmse_xy_m": a.rmse_xy_m,
        "sigma_xy_m": a.sigma_xy_m,
    }


def rejected(adjustment: Adjustment) -> list[dict[str, Any]]:
    """Image points left out: by a test, with its w, and those that could not be used at all, with w = 0."""
    block, result = adjustment.block, adjustment.result
    rows = [(int(result.network.rays.source[r.ray]), r.w, r.reason) for r in result.rejected if r.ray >= 0]
    rows += [(row, 0.0, reason) for row, reason in result.network.refused]
    found = []
    for row, w, reason in rows:
        point, strip, ccd = block.image_name(row)
        pixel = {"line": float(block.image.line[row]), "sample": float(block.image.sample[row])}
        found.append({"point": point, "strip": strip, "ccd": ccd, **pixel, "w": w, "reason": reason})
    return found


def notes_of(adjustment: Adjustment) -> list[str]:
    """What a reader of the result should know, one sentence each."""
    result, solution = adjustment.result, adjustment.result.solution
    network = result.network
    notes = [*adjustment.block.notes, *_axes_notes(adjustment.block.frame)]
    notes += dict.fromkeys(note for item in solution.layout.sets for note in item.model.notes)
    notes += _strip_notes(result)
    if not solution.converged:
        notes.append("not converged: the figures are those of the last step")
    if result.sigma0 != result.test.sigma0 or solution.redundancy <= 0:
        notes.append(
            f"redundancy of image points and control is {result.measured_redundancy:.1f}: too little for sigma0; "
            "sigmas are those of the a-priori weights"
        )
    elif not result.test.passed:
        notes.append(_sigma0_note(result))
    if adjustment.job.self_calibration is not None and adjustment.camera() is None:
        notes.append(f"no additional parameter is determined: the camera stays as it is, and no {CAMERA} is written")
    for c in result.components or ():
        if c.estimated and c.factor > UNLIKELY and c.group not in CONSTANTS:
            notes.append(f"sigma of {c.group} {c.factor:.0f} times as large as stated: {LIKELIER}")
    if adjustment.job.then is not None and any(c.estimated and c.group in ERROR_GROUPS for c in result.components):
        notes.append("factors of sigmas of the trajectory are of what the first model left of its errors, not of all")
    notes += _test_notes(adjustment)
    notes += _control_notes(result)
    notes += _check_notes(adjustment)
    notes += _weakness_notes(result)
    if result.doubtful:
        notes.append(_doubt_note(result))
    lost = (solution.points.rank < 3) & (network.rays_per_point > 0)
    if lost.any():
        what = f"{int(lost.sum())} object points are not determined by their rays and have no coordinates in points.csv"
        check = int(lost[network.check.point].sum())
        notes.append(f"{what}; {check} of them are check points" if check else what)
    return notes


def _axes_notes(frame: LocalFrame) -> list[str]:
    """Which way X goes, where that is not nearly the X of the tables."""
    if frame.crs == "local":
        return []
    try:
        x_l = frame.R_l_crs(frame.to_crs(np.zeros((1, 3))))[0, :, 0]
    except CrsError:  # whoever writes tables in it says so
        return []
    turned = float(np.degrees(np.arctan2(x_l[1], x_l[0])))
    if abs(turned) < TURNED_DEG:
        return []
    return [
        "X, Y, Z of accuracies, corrections of strips and names of coordinates are those of the local frame (east, "
        f"north, up); X of the tables, which are in {frame.crs}, is turned from the east by {turned:+.0f} deg"
    ]


def _doubt_note(result: BatchResult) -> str:
    """Which points are doubtful, and which of them are missing in the statistics of the check points."""
    network, doubtful = result.network, result.doubtful
    shown = first_of([f"{network.point_ids[d.point]} ({d.lost} of {d.rays} rays out)" for d in doubtful], MOST_LISTED)
    check = set(network.check.point.tolist())
    out = sum(d.point in check for d in doubtful)
    left = f"; {out} of them check points, left out of the statistics" if out else ""
    return f"{len(doubtful)} object points are doubtful, their remaining rays do not confirm them: {shown}{left}"


def _sigma0_note(result: BatchResult) -> str:
    """Why the chi-square test may have failed."""
    test, image = result.test, result.image_test
    said = f"sigma0 {test.sigma0:.3f} outside [{test.low:.3f}, {test.high:.3f}] (95 %)"
    if test.sigma0 > UNLIKELY:
        return f"{said}: {LIKELIER} than such errors"
    if test.sigma0 > test.high:
        asked = "" if result.components else "; --variance-components asks which, clock and camera with them"
        return f"{said}: errors are left in the data or the model, or the a-priori sigmas do not fit{asked}"
    _, squares, redundancy = result.groups.get("surface", (0, 0.0, 0.0))
    surface = global_test(squares, round(redundancy))
    if redundancy > 1.0 and surface.sigma0 < surface.low:
        return f"{said}: the heights of the raster fit better than their sigma says; --dem-sigma may be smaller"
    if image.sigma0 >= image.low:
        return f"{said}: the a-priori weights of the trajectory are loose; of the image points it is {image.sigma0:.3f}"
    return f"{said}: the errors are smaller than the a-priori sigmas"


def _weakness_notes(result: BatchResult) -> list[str]:
    if result.weak is None:
        where = "in partitions" if result.solution.problem.parts is not None else "of so many unknowns"
        return [f"undetermined combinations {where} are not searched for"]
    if not result.weak:
        return []
    free = len(result.solution.factor.undetermined) > 0
    words = [c.words for c in result.weak]
    if len(result.weak) > MANY_WEAK:  # flexible models are meant to lean on their weights where rays are few
        count = f"{len(result.weak)} combinations of the {result.solution.layout.n_unknowns} unknowns"
        shown = "; ".join(words[:MOST_NAMED])
        return [f"{count} rest on a-priori weights, as flexible models do between rays; least determined: {shown}"]
    return [("not determined: " if free else "resting on a-priori weights alone: ") + first_of(words, MOST_NAMED, "; ")]


def _test_notes(adjustment: Adjustment) -> list[str]:
    """What the tests of single observations say beside what was left out."""
    result, critical = adjustment.result, adjustment.job.critical
    network, notes = result.network, []
    if result.given_up:
        robust = "" if adjustment.job.robust else "a robust start (--robust danish), "
        notes.append(
            f"data snooping would leave out {100 * result.given_up:.0f} % of the image points: model or a-priori sigma "
            f"does not fit, so nothing was left out; {robust}a richer model (ppm, lim) or --reweight may help"
        )
    elif not adjustment.job.snoop:
        failing = int((result.rays.largest_w[result.solution.ray_weight > 0] > critical).sum())
        if failing > 0.01 * len(network.rays):
            notes.append(f"{failing} image points have |w| > {critical:g}; --snoop leaves out outliers")
    failing = [abs(r.w) for r in result.rejected if r.reason == "snooping" and r.ray >= 0]
    narrowly = sum(w < NARROWLY * critical for w in failing)
    if narrowly > HEAVY_TAILS * len(network.rays):
        notes.append(
            f"{100.0 * narrowly / len(network.rays):.0f} % of the image points fail narrowly: their errors have "
            "heavier tails than stated, sigmas of points are too small"
        )
    elif len(failing) > MISMATCHES * len(network.rays):
        share = f"{100.0 * len(failing) / len(network.rays):.0f} % of the image points contradict the others"
        notes.append(f"{share} and are left out: more stay unseen at points of two rays, whose sigmas do not say it")
    w = control_tests(result.solution, result.cofactors)
    return notes + failing_note(network.point_ids, w, critical) + _deserted_control(result)


def failing_note(
    points: Sequence[str], w: Array, critical: float, what: str = "control coordinates", axes: Sequence[str] = "XYZ"
) -> list[str]:
    """What is said of normalised residuals (p, axes), adjusted minus given, that fail; nothing where none do."""
    worst = [(p, a) for p, a in np.argwhere(np.abs(w) > critical)]
    worst.sort(key=lambda key: -abs(w[key]))
    if not worst:
        return []
    names = ", ".join(f"{points[p]} {axes[a]} ({w[p, a]:+.1f})" for p, a in worst[:5])
    more = " ..." if len(worst) > 5 else ""
    return [f"{len(worst)} {what} have |w| > {critical:g}: {names}{more}"]


def _deserted_control(result: BatchResult) -> list[str]:
    """Control that lost all its image points: nothing contradicts its coordinates any more."""
    network = result.network
    known = np.zeros(network.n_points, dtype=bool)
    known[network.control.point] = np.isfinite(network.control.sigma_m).any(axis=1)
    used = np.bincount(network.rays.point, result.solution.ray_weight > 0, network.n_points) > 0
    lost = np.flatnonzero(known & ~used & (network.rays_per_point > 0))
    return deserted_note([str(network.point_ids[p]) for p in lost])


def deserted_note(points: Sequence[str]) -> list[str]:
    """What is said of control by these names that lost all its image points; nothing where there is none."""
    if not points:
        return []
    names = ", ".join(points[:5]) + (" ..." if len(points) > 5 else "")
    return [f"control that lost all its image points and stands as given: {names}; wrong coordinates, or a wrong name?"]


def where_to_look(adjustment: Adjustment) -> str:
    """What to check when nothing fits, in words: control that lies elsewhere, the strip with the largest residuals."""
    result = adjustment.result
    network = result.network
    size = np.linalg.norm(result.rays.v_px, axis=1)
    median = {s.id: float(np.median(size[network.rays.strip == i])) for i, s in enumerate(network.strips)
              if (network.rays.strip == i).any()}  # fmt: skip
    worst = max(median, key=lambda id: median[id])
    said = f"residuals are largest in strip {worst}, {median[worst]:.0f} px: check its trajectory and line times"
    if adjustment.job.robust is None:
        said += ", or, where many image points are wrong, adjust with --robust danish"
    far = _far_control(network)
    return f"{far}; {said}" if far else said


def _far_control(network: Network) -> str:
    """Control that lies elsewhere than the rays to it meet before anything is adjusted, in words; "" for none."""
    rays = network.rays_per_point[network.control.point]
    known = np.isfinite(network.control.sigma_m) & (rays > 1)[:, None]
    measured = np.flatnonzero(known.any(axis=1))
    if not len(measured):
        return ""
    points = network.control.point[measured]
    off = np.where(known[measured], network.control.xyz_l[measured] - network.where_rays_meet(points), 0.0)
    return elsewhere([str(network.point_ids[p]) for p in points], np.linalg.norm(off, axis=1), ELSEWHERE_M)


def elsewhere(names: Sequence[str], away: Array, limit_m: float) -> str:
    """Control by these names that lies so far, metres (n,), from where its rays meet, in words; "" within the limit."""
    usual, worst = float(np.median(away)), int(np.argmax(away))
    if usual > limit_m:
        return f"control lies {usual:.0f} m from where its rays meet (median): check its coordinate reference system"
    if away[worst] > limit_m:
        return f"control point {names[worst]} lies {away[worst]:.0f} m from where its rays meet"
    return ""


def _control_notes(result: BatchResult) -> list[str]:
    network, control, notes = result.network, result.network.control, []
    full, fit = np.isfinite(control.sigma_m), result.surface
    if fit is not None and fit.shift.free:
        other = "control" if full[:, 2].any() else "the trajectories"
        s = fit.shift
        notes.append(
            f"the raster's heights differ from those of {other} by {s.shift_m:+.2f} +- {s.sigma_m:.2f} m, w {s.w:.1f}: "
            f"vertical datum of --dem-crs? Its relief counts, its height does not: Z is that of {other}"
        )
    if fit is not None and not full.any() and not fit.shift.free:
        return ["no control: position and rotation of the block come from its trajectories, its height from the raster"]
    return [*notes, *_spread_notes(network, control)]


def _spread_notes(network: Network, control: Control) -> list[str]:
    full = np.isfinite(control.sigma_m)
    if not full.any():
        return ["no control: position, rotation and scale of the block come from its trajectories"]
    known = full.any(axis=1)
    measured = (network.rays_per_point[control.point] > 0) & known
    n, never = np.count_nonzero(known), np.count_nonzero(known & ~measured)
    if never == n:
        return [f"no control point of {n} is measured in an image: position, rotation and scale of the block come from "
                "its trajectories"]  # fmt: skip
    notes = [f"{never} of {n} control points are measured in no image"] if never else []
    return notes + _notes_on_spread(network, control.xyz_l[measured])


def _strip_notes(result: BatchResult) -> list[str]:
    """Strips without corrections, which are missing in the tables of orientation."""
    corrected = {item.strip for item in result.solution.layout.sets}
    lone = [strip.id for i, strip in enumerate(result.network.strips) if i not in corrected]
    if not lone:
        return []
    names = first_of(lone, MOST_NAMED)
    return [f"strips without image points take no part, and their orientation is in no table: {names}"]


def _check_notes(adjustment: Adjustment) -> list[str]:
    """Check points that no image point measures: they are missing in the accuracies."""
    network, ground = adjustment.result.network, adjustment.block.ground
    check = [id for id, role in zip(ground.id, ground.role, strict=True) if role == "check"]
    measured = {network.point_ids[p] for p in np.flatnonzero(network.rays_per_point > 0)}
    never = sum(id not in measured for id in check)
    return [f"{never} of {len(check)} check points are measured in no image"] if never else []


def _notes_on_spread(network: Network, xyz: Array) -> list[str]:
    if len(xyz) < 3:
        return [f"{len(xyz)} control point{'s' if len(xyz) > 1 else ''}: too few to check the datum of the block"]
    spread = np.linalg.svd(xyz[:, :2] - xyz[:, :2].mean(axis=0), compute_uv=False)
    seen = network.approximate_l[:, :2]
    if spread[1] < 0.02 * spread[0]:
        return ["control points lie on a line: the rotation about it comes from the trajectories"]
    if np.ptp(xyz[:, :2], axis=0).max() < 0.25 * np.ptp(seen, axis=0).max():
        return ["control lies in one part of the block only: away from it the trajectories decide"]
    return []


def _reliability(result: BatchResult) -> dict[str, Any]:
    """Summary over the image points that take part, line and sample."""
    used = result.solution.ray_weight > 0
    rays = result.rays
    return reliability_summary(reliability(rays.redundancy[used], rays.sigma_px[used]))


def reliability_summary(r: Reliability) -> dict[str, Any]:
    """Of image points: redundancy numbers and detectable errors, line and sample."""
    found: dict[str, Any] = {}
    for k, name in enumerate(("line", "sample")):
        number, detectable = r.redundancy[:, k], r.detectable[:, k]
        finite = detectable[np.isfinite(detectable)]
        found[name] = {
            "redundancy_mean": float(number.mean()) if len(number) else None,
            "redundancy_min": float(number.min()) if len(number) else None,
            "detectable_px_median": float(np.median(finite)) if len(finite) else None,
            "detectable_px_max": float(finite.max()) if len(finite) else None,
            "uncontrolled": int((~np.isfinite(detectable)).sum()),
        }
    return found


def _correlations(solution: Solution) -> list[dict[str, Any]]:
    """The strongest correlations above 0.9 between orientation and additional parameters."""
    names = solution.layout.names
    if len(names) > 1500:
        return []
    pairs = strongest_correlations(solution.factor.cofactors(np.arange(len(names))), names)
    return [{"between": [p.first, p.second], "r": p.correlation} for p in pairs[:MOST_LISTED]]
