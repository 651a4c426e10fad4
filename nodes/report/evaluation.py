"""Accuracy of a recorded flight: orientation and object points against truth and check points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...solver.accuracy import Accuracy, accuracy, angle_difference
from ...solver.adjustment.network import SAME_S, most_off
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import R_lc_from_navigation, opk_covariance_from_navigation
from ...solver.geometry.rotation import matrix_from_navigation, quaternion_from_matrix
from ...solver.geometry.space_intersection import ImageRays, Intersection, intersect
from ...solver.geometry.trajectory import Trajectory
from .. import convert
from .accuracy_table import NO_CHECK, NO_TIES, NO_TRUTH, NONE_MEASURED
from .flight import Flight, Look, PoseSeries, collect, in_gap, rejected_key

Array = NDArray[np.floating]

#: Rows of the orientation table, in order of processing.
ORIENTATIONS = ("measured", "filtered", "smoothed", "live", "final", "whole")
#: Points are intersected with these orientations; "" stands for the trajectory before triangulation.
INTERSECTED = {"direct_georeferencing": "", "live": "live", "final": "final"}
#: Rows that the accuracy of a flight is taken from: points as published, else intersected with the final orientation.
TRIANGULATED = ("adjusted", "final")
_LARGEST_GAP_S = 1.0
_EARLY_S = 1.0  # a strip that is shorter than planned by less than this was flown to its end
_IMAGE_SIGMA_PX = 0.3  # where the project names none


def evaluate(recording: str | Path) -> dict[str, Any]:
    """Accuracy of a recording; see `evaluate_flight`.

    Raises
    ------
    UserError : a file that is not a recording, or is broken
    """
    from .source import messages_of

    return {"recording": str(recording), **evaluate_flight(collect(messages_of(recording)))}


def evaluate_flight(flight: Flight) -> dict[str, Any]:
    """Accuracy of a flight.

    Returns
    -------
    dict with

    - ``orientation``: by name of ORIENTATIONS ("measured": straight from GNSS and INS), against the true trajectory,
      over the times the final orientation covers: ``n, rmse_m, mean_m, max_m, sigma_m`` (X, Y, Z), ``rmse_deg`` ..
      (omega, phi, kappa), ``nees``;
    - ``points``: ``direct_georeferencing`` (space intersection with the filtered trajectory, or the smoothed
      one where a recording holds no other), ``live`` and ``final``
      (with these orientations), ``adjusted_live``, ``adjusted`` and ``adjusted_whole`` (as published), against true
      points that were not given as control: ``n, rmse_m, mean_m, max_m, sigma_m, nees``; where there are both direct
      georeferencing and adjusted points, all rows count only points that both have;
    - ``check``, ``control``: the same rows against given coordinates of check points and (full) control points, without
      those of which the adjuster or an operator left one out. ``nees`` counts the stated errors of the survey too;
      there is none of what was estimated from the control itself;
    - ``improvement``: RMSE of direct georeferencing (filtered) / triangulated: ``points`` (3), ``of`` (the row of
      TRIANGULATED that is meant), ``orientation`` (6, of "final");
    - ``ended_early``: strips whose end the recording does not reach: ``strip, flown_s, planned_s``;
    - ``sigma0`` over the flight, ``redundancy``, ``updates``, ``rejected`` (without those that were taken back);
    - ``poses_left_out``: how many poses of each orientation are not valid and so not compared;
    - ``missing``: what the recording does not hold, one line each.

    ``sigma`` is the theoretical value (root mean of the stated variances); keys without data are absent.
    """
    result: dict[str, Any] = {"orientation": {}, "points": {}, "check": {}, "control": {}, "missing": missing(flight)}
    errors = orientation_errors(flight)
    for name, of in errors.items():
        result["orientation"][name] = _orientation_row(of.error, of.covariance)
    result["poses_left_out"] = poses_left_out(flight)
    intersections = intersect_points(flight)
    rows = {**intersections, **_adjusted(flight)}
    shared = _shared(rows)
    check, control = _given(flight, "check"), _given(flight, "control")
    given = {id for id, g in flight.ground.items() if convert.role_of(g) != "check"} - flight.refused_ground
    truth = {id: xyz for id, xyz in flight.truth_points.items() if id not in given}  # given coordinates are no result
    surveyed = {id: _survey(g) for id, g in flight.ground.items()}
    for target, known in (("points", truth), ("check", check), ("control", control)):
        known = {id: xyz for id, xyz in known.items() if shared is None or id in shared}
        for name, (ids, xyz, covariance) in rows.items():
            row = _point_row(ids, xyz, covariance, known, {} if target == "points" else surveyed)
            if row is not None:
                result[target][name] = row
    for name, row in result["control"].items():
        if name != "direct_georeferencing":  # control took part in all others
            row.pop("nees", None)
    _improvement(result, flight.measured)
    result["ended_early"] = ended_early(flight)
    result.update(_totals(flight))
    return result


def _shared(rows: dict[str, tuple[list[str], Array, Array]]) -> set[str] | None:
    """Names of the points that both direct georeferencing and triangulation gave; None where one of them gave none."""
    if "direct_georeferencing" not in rows or "adjusted" not in rows:
        return None
    return set(rows["direct_georeferencing"][0]) & set(rows["adjusted"][0])


def triangulated(rows: dict[str, Any]) -> str | None:
    """The row of points that the accuracy of a flight is taken from, see TRIANGULATED; None where there is none."""
    return next((name for name in TRIANGULATED if name in rows), None)


def ended_early(flight: Flight) -> list[dict[str, Any]]:
    """Strips whose planned end lies after that of the recording; for a strip that was ended its true length counts."""
    measured = [*flight.gnss_ns[-1:].tolist(), *(a.time_ns for a in flight.attitude[-1:])]
    end_ns = max(measured, default=flight.end_ns)  # the end of the measurements, because results come after it
    found = []
    for id, strip in flight.strips.items():
        span = flight.strip_times(id)
        if span is None or strip.ended:
            continue
        planned = (span[1] - span[0]) / convert.SECOND_NS
        flown = max(0.0, (end_ns - span[0]) / convert.SECOND_NS)
        if flown < planned - _EARLY_S:
            found.append({"strip": id, "flown_s": flown, "planned_s": planned})
    return found


def _totals(flight: Flight) -> dict[str, Any]:
    """sigma0 over the flight (absent where nothing was redundant), redundancy, updates, rejected observations."""
    if not flight.reports:
        return {}
    last = flight.reports[-1][1]
    totals: dict[str, Any] = {
        "redundancy": last.redundancy_total or last.redundancy,
        "updates": len(flight.reports),
        "rejected": max(last.rejected_total - last.returned_total, len(flight.rejected)),
    }
    redundant = [r.sigma0 for _, r in flight.reports if r.redundancy > 0]
    if last.sigma0_total > 0:
        totals["sigma0"] = last.sigma0_total
    elif redundant:
        totals["sigma0"] = float(np.sqrt(np.mean(np.square(redundant))))
    return totals


def missing(flight: Flight) -> list[str]:
    """Topics that a full evaluation needs and the recording does not hold, a line each."""
    why = "the adjuster gave none" if flight.reports else "the recording has not been through the adjuster"
    check = set(_given(flight, "check"))
    wanted = [
        (flight.project is not None, "configuration/project"),
        (flight.camera is not None, "configuration/camera: no object points by direct georeferencing"),
        (bool(flight.looks), f"{NO_TIES}: no object points"),
        (bool(flight.measured), "trajectory/filtered or trajectory/smoothed: no direct georeferencing"),
        ("final" in flight.poses, f"orientation/final: {why}"),
        ("truth" in flight.poses, "truth/trajectory: no error of the orientation (truth is known in simulations only)"),
        (bool(flight.truth_points), f"{NO_TRUTH}: no error of the object points"),
        (bool(flight.reports), "adjustment/report"),
        (bool(flight.points), "point/object"),
        (bool(check), f"{NO_CHECK} (observation/control with role check)"),
        (not check or not flight.points or bool(check & set(flight.points)), f"{NO_CHECK}: {NONE_MEASURED}"),
    ]
    gaps = flight.poses["truth"].gaps() if "truth" in flight.poses else []
    spans = [span for span in map(flight.strip_times, flight.strips) if span is not None]
    gaps = [(a, b) for a, b in gaps if not spans or any(a < last and first < b for first, last in spans)]
    told = [
        f"truth/trajectory from {(a - flight.start_ns) / convert.SECOND_NS:.1f} to "
        f"{(b - flight.start_ns) / convert.SECOND_NS:.1f} s: nothing is compared there"
        for a, b in gaps
    ]
    return [text for there, text in wanted if not there] + told


def measured_poses(flight: Flight) -> PoseSeries | None:
    """Orientation from the sensors alone: INS attitude, GNSS positions interpolated and reduced by the lever arm.

    The clock of GNSS is as an operator corrected it in flight; lever arm and boresight are those that held then.
    """
    if flight.project is None or len(flight.gnss) < 2 or not flight.attitude:
        return None
    frame = convert.local_frame(flight.project)
    fixes = dict(zip(flight.gnss_ns.tolist(), flight.gnss, strict=True))
    fix_ns = np.array(sorted(fixes), dtype=np.int64)
    geodetic = np.array([[fixes[t].latitude, fixes[t].longitude, fixes[t].altitude] for t in fix_ns])
    antenna = frame.from_geodetic(*geodetic.T)
    variance = np.array([_diagonal3(fixes[t].position_covariance) for t in fix_ns])
    attitude = {a.time_ns: a for a in flight.attitude if fix_ns[0] <= a.time_ns <= fix_ns[-1]}
    time = np.array(sorted(attitude), dtype=np.int64)
    time = time[~in_gap(fix_ns, time)]
    if len(time) < 2:
        return None
    step = max(1, round(0.05 * convert.SECOND_NS / float(np.median(np.diff(time)))))
    time = time[::step]
    rpy = np.array([[attitude[t].roll, attitude[t].pitch, attitude[t].heading] for t in time])
    cov_rpy = np.array([np.diag(_diagonal3(attitude[t].covariance)) for t in time])
    position = np.stack([np.interp(time, fix_ns, antenna[:, i]) for i in range(3)], axis=1)
    spread = np.stack([np.interp(time, fix_ns, variance[:, i]) for i in range(3)], axis=1)
    R_ln = frame.R_ln(position)
    R_lc = np.empty((len(time), 3, 3))
    for then, project in flight.projects_at(time):
        if not then.any():
            continue
        R_nb, lever_arm_b = matrix_from_navigation(*rpy[then].T), convert.lever_arm_of(project)
        position[then] -= np.einsum("nij,njk,k->ni", R_ln[then], R_nb, lever_arm_b)
        R_lc[then] = R_lc_from_navigation(frame, position[then], rpy[then], convert.R_bc_of(project))
    covariance = np.zeros((len(time), 6, 6))
    covariance[:, :3, :3] = spread[:, :, None] * np.eye(3)
    covariance[:, 3:, 3:] = opk_covariance_from_navigation(rpy, R_lc, R_ln, cov_rpy)
    covariance[~np.isfinite(covariance).all(axis=(1, 2))] = np.nan
    q = quaternion_from_matrix(R_lc)
    none6 = np.full((len(time), 6), np.nan)
    everywhere = np.ones(len(time), dtype=bool)
    return PoseSeries(time, position, q, convert.angles_of(q), covariance, none6, everywhere, np.full(len(time), ""))


def _diagonal3(values: Any) -> Array:
    return np.array(values).reshape(3, 3).diagonal() if len(values) == 9 else np.full(3, np.nan)


def _compared(flight: Flight) -> dict[str, PoseSeries]:
    """Samples on strips, in the time that the final orientation and the truth cover, by name; valid or not."""
    truth = flight.poses.get("truth")
    if truth is None or len(truth) < 2:
        return {}
    all_poses = dict(flight.poses)
    measured = measured_poses(flight)
    if measured is not None:
        all_poses["measured"] = measured
    span = all_poses.get("final", truth).time_ns
    true_path = truth.trajectory(flight.start_ns)
    result = {}
    for name in (n for n in ORIENTATIONS if n in all_poses):
        t = all_poses[name].time_ns
        use = flight.during_strips(t) & (t >= span[0]) & (t <= span[-1]) & true_path.covers(flight.seconds(t))
        use &= truth.known_at(t)  # a recorder that stood still leaves gaps, and nobody knows what was in them
        if use.any():
            result[name] = all_poses[name].take(use)
    return result


def poses_left_out(flight: Flight) -> dict[str, int]:
    """Number of poses that are marked as not valid and so are not compared with truth, by name."""
    counts = {name: int((~poses.valid).sum()) for name, poses in _compared(flight).items()}
    return {name: n for name, n in counts.items() if n}


class OrientationErrors(NamedTuple):
    """Errors of one kind of orientation: estimate minus truth.

    Attributes
    ----------
    time_ns : (n,) UTC
    error : (n, 6) m and rad
    covariance : (n, 6, 6) as stated
    strip : (n,) "" where none is named
    """

    time_ns: NDArray[np.int64]
    error: Array
    covariance: Array
    strip: NDArray[np.str_]


def orientation_errors(flight: Flight) -> dict[str, OrientationErrors]:
    """Errors of the orientation, by name.

    Valid samples on strips, in the time the final orientation covers, so that all rows are of the same times.
    """
    result = {}
    compared = _compared(flight)
    if not compared:
        return result
    true_path = flight.poses["truth"].trajectory(flight.start_ns)
    for name, poses in compared.items():
        if not poses.valid.any():
            continue
        poses = poses.take(poses.valid)
        true = true_path.at(flight.seconds(poses.time_ns))
        error = np.hstack([poses.position_l - true.position_l, angle_difference(poses.angles, true.angles)])
        result[name] = OrientationErrors(poses.time_ns, error, poses.covariance, poses.strip)
    return result


def usable_rays(flight: Flight) -> tuple[list[str], ImageRays, ImageRays] | None:
    """Point ids and rays with the filtered orientation, without those the adjustment rejected; None without any.

    The rays are first those of the camera as it was stated when they were taken, then those of that camera as it was
    estimated last.
    """
    filtered = flight.poses.get(flight.measured)
    if filtered is None or flight.camera is None:
        return None
    bad = {rejected_key(r) for r in flight.rejected}
    path = filtered.trajectory(flight.start_ns)
    number = {id: i for i, id in enumerate(flight.strips)}
    looks, rows, seen = [], [], set()
    for look in flight.looks:
        strip = flight.strips.get(look.strip)
        if strip is None or not strip.line_rate_hz > 0 or look.key in bad or look.key in seen:
            continue
        seen.add(look.key)
        since_s = look.line / strip.line_rate_hz
        time = (strip.first_line_time_ns - flight.start_ns) / convert.SECOND_NS + since_s
        own = (look.time_ns - flight.start_ns) / convert.SECOND_NS if look.time_ns else time
        if SAME_S < abs(own - time) <= most_off(since_s):
            time = own
        inside = not strip.lines or -0.5 <= look.line <= strip.lines - 0.5
        inside = inside and bool(np.isfinite([look.sigma_line, look.sigma_sample]).all())
        if inside and path.start_s <= time <= path.end_s:
            looks.append(look)
            period = 1.0 / strip.line_rate_hz
            rows.append((look.sample, time, period, look.sigma_line, look.sigma_sample, number[look.strip]))
    if not rows:
        return None
    sample, time, period, *sigmas, strips = np.array(rows).T
    time_ns = flight.start_ns + np.rint(time * convert.SECOND_NS).astype(np.int64)
    default = np.empty(len(rows))
    for then, project in flight.projects_at(time_ns):
        default[then] = (project.image_sigma_px if project is not None else 0.0) or _IMAGE_SIGMA_PX
    stated = _in_camera(looks, sample, flight.cameras_at(time_ns))
    with_told = zip(flight.cameras_at(time_ns), flight.parameters_at(time_ns), strict=True)
    estimated = [
        (then, None if camera is None else convert.estimated_camera(camera, told)[0])
        for (then, camera), (_, told) in with_told
    ]
    use = np.flatnonzero(np.isfinite(stated[:, 4]))
    if not len(use):
        return None
    ids, point = np.unique([looks[i].point for i in use], return_inverse=True)
    pose = path.at(time[use])
    nearest = np.clip(np.searchsorted(path.time_s, time[use]), 0, len(path) - 1)
    sigma_line, sigma_sample = (np.where(s == 0, default, s)[use] for s in sigmas)
    rays = ImageRays(
        point.astype(np.int64), time[use], period[use], pose.position_l, pose.angles, pose.velocity_l,
        pose.angle_rate, stated[use, :2], stated[use, 2:4], stated[use, 4], sigma_line, sigma_sample,
        filtered.covariance[nearest], strips[use].astype(np.int64),
    )  # fmt: skip
    refined = _in_camera(looks, sample, estimated)[use]
    return [str(i) for i in ids], rays, replace(rays, xy_mm=refined[:, :2], pitch_mm=refined[:, 2:4])


def _in_camera(looks: list[Look], sample: Array, cameras: list[tuple[NDArray[np.bool_], LineCamera | None]]) -> Array:
    """Image coordinates and their change per pixel, mm, and the focal length of looks (n, 5), each in the camera that
    held then; NaN where that one has no such CCD line or pixel."""
    found = np.full((len(looks), 5), np.nan)
    for then, camera in cameras:
        if camera is None:
            continue
        index = [camera.line_index.get(looks[i].ccd) if then[i] else None for i in range(len(looks))]
        known = [i for i, ccd in enumerate(index) if ccd is not None and camera.lines[ccd].contains(sample[i])]
        ccd = np.array([index[i] for i in known], dtype=int)
        xy, pitch = camera.image_coordinates(ccd, sample[known])
        found[known] = np.column_stack([xy, pitch, camera.focal_length_mm[ccd]])
    return found


def intersect_points(flight: Flight) -> dict[str, tuple[list[str], Array, Array]]:
    """Point ids, coordinates (p, 3) and covariance (p, 3, 3) by space intersection, by name of INTERSECTED.

    All rows use the same rays: those that the final orientation covers, where there is one, and at valid poses, which
    those of an inertial system are not before it is aligned. The camera that was
    estimated with refined orientation goes with it. The correlation time of slow errors is that of the newest project.
    """
    usable = usable_rays(flight)
    if usable is None:
        return {}
    ids, rays, refined = usable
    corrections = {name: _corrections(flight, pose, rays) for name, pose in INTERSECTED.items()}
    common = np.ones(len(rays.time_s), dtype=bool)
    for found in corrections.values():
        if found is not None:
            common &= np.isfinite(found[0]).all(axis=1)
    tau = flight.project.wander_time_s if flight.project is not None and flight.project.wander_time_s > 0 else np.inf
    result = {}
    for name, found in corrections.items():
        if found is None or not common.any():
            continue
        correction, covariance = found
        names = list(ImageRays.__dataclass_fields__)
        of = refined if INTERSECTED[name] else rays
        chosen = {field: getattr(of, field)[common] for field in names if field != "orientation_covariance"}
        chosen["position_l"] = chosen["position_l"] + correction[common, :3]
        chosen["angles"] = chosen["angles"] + correction[common, 3:]
        stated = covariance[common] if np.isfinite(covariance[common]).all() else None
        points: Intersection = intersect(ImageRays(**chosen, orientation_covariance=stated), len(ids), tau)
        ok = points.known
        result[name] = [i for i, k in zip(ids, ok, strict=True) if k], points.xyz_l[ok], points.covariance[ok]
    return result


def _corrections(flight: Flight, name: str, rays: ImageRays) -> tuple[Array, Array] | None:
    """Correction to the filtered orientation (n, 6), NaN where not covered or beside a pose that is not valid, and
    covariance (n, 6, 6) at the times of rays, of the strip that each of them is in."""
    poses = flight.poses.get(name or flight.measured)
    if poses is None or len(poses) < 2:
        return None
    if not poses.is_of_several_strips:
        return _correction_at(flight, poses, rays.time_s)
    correction, covariance = np.full((len(rays.time_s), 6), np.nan), np.full((len(rays.time_s), 6, 6), np.nan)
    for number, strip in enumerate(flight.strips):
        inside, own = np.asarray(rays.strip) == number, poses.of(strip)
        if inside.any() and len(own) >= 2:
            correction[inside], covariance[inside] = _correction_at(flight, own, rays.time_s[inside])
    return correction, covariance


def _correction_at(flight: Flight, poses: PoseSeries, time_s: Array) -> tuple[Array, Array]:
    """The same at any times, by poses of one strip after the other."""
    filtered = flight.poses[flight.measured]
    t = flight.seconds(poses.time_ns)
    nearest = np.clip(np.searchsorted(t, time_s), 0, len(t) - 1)
    before = np.clip(nearest - 1, 0, len(t) - 1)
    beside = ~(poses.valid[nearest] & poses.valid[before])
    if poses is filtered:
        return np.where(beside[:, None], np.nan, np.zeros((len(time_s), 6))), filtered.covariance[nearest]
    base = flight.poses.get("smoothed", filtered)  # the less noisy trajectory, because it is interpolated
    values = _difference(poses, base, flight.start_ns)
    correction = np.stack([np.interp(time_s, t, values[:, i], np.nan, np.nan) for i in range(6)], axis=1)
    if base is not filtered:
        above, below = base.trajectory(flight.start_ns), filtered.trajectory(flight.start_ns)
        known = above.covers(time_s) & below.covers(time_s)
        a, b = above.at(time_s[known]), below.at(time_s[known])
        correction[~known] = np.nan
        correction[known, :3] += a.position_l - b.position_l
        correction[known, 3:] += angle_difference(a.angles, b.angles)
    correction[beside | ((t[nearest] - t[before] > _LARGEST_GAP_S) & (time_s < t[nearest]))] = np.nan
    return correction, poses.covariance[nearest]


def corrections_of(flight: Flight, poses: PoseSeries) -> Array:
    """Correction functions dX, dY, dZ, domega, dphi, dkappa (n, 6): as published, else orientation minus filtered."""
    filtered = flight.poses.get(flight.measured)
    bare = np.atleast_1d(~np.isfinite(poses.correction).all(axis=1))
    if not bare.any() or filtered is None:
        return poses.correction
    return np.where(bare.reshape(-1, 1), _difference(poses, filtered, flight.start_ns), poses.correction)


def _difference(poses: PoseSeries, base: PoseSeries, start_ns: int) -> Array:
    """Position and angles minus those of a base at the same times (n, 6); NaN where the base has none."""
    path: Trajectory = base.trajectory(start_ns)
    t = (poses.time_ns - start_ns) / convert.SECOND_NS
    known = path.covers(t)
    below = path.at(t[known])
    values = np.full((len(poses), 6), np.nan)
    values[known, :3] = poses.position_l[known] - below.position_l
    values[known, 3:] = angle_difference(poses.angles[known], below.angles)
    return values


def _adjusted(flight: Flight) -> dict[str, tuple[list[str], Array, Array]]:
    rows = {}
    kinds = {"adjusted_live": flight.live_points, "adjusted": flight.points, "adjusted_whole": flight.whole_points}
    for name, points in kinds.items():
        if points:
            values = list(points.values())
            xyz = np.array([[p.x, p.y, p.z] for p in values])
            none = np.full(9, np.nan)
            cov = np.array([p.covariance if len(p.covariance) == 9 else none for p in values]).reshape(-1, 3, 3)
            rows[name] = [p.point for p in values], xyz, cov
    return rows


def _given(flight: Flight, role: str) -> dict[str, Array]:
    """Given coordinates of check points or of full control points, of which none was left out."""
    of_role = {id: flight.given(id) for id, g in flight.ground.items() if convert.role_of(g) == role}
    return {id: xyz for id, xyz in of_role.items() if np.isfinite(xyz).all()}


def _survey(point: Any) -> Array:
    """(3, 3) covariance of the given coordinates of a ground point; zero where none is stated."""
    stated = np.array(point.covariance, dtype=float)
    return stated.reshape(3, 3) if len(stated) == 9 and np.isfinite(stated).all() else np.zeros((3, 3))


def _point_row(
    ids: list[str], xyz: Array, covariance: Array, known: dict[str, Array], surveyed: dict[str, Array]
) -> dict[str, Any] | None:
    """Points against known ones, whose covariances are ``surveyed``; those that are not there have no error."""
    both = [i for i, id in enumerate(ids) if id in known]
    if not both:
        return None
    error = xyz[both] - np.array([known[ids[i]] for i in both])
    row = _row(accuracy(error, covariance[both]), "m")
    if "nees" in row and surveyed:
        row["nees"] = accuracy(error, covariance[both] + np.array([surveyed[ids[i]] for i in both])).nees
    return row


def _row(a: Accuracy, unit: str, scale: float = 1.0, part: slice = slice(None)) -> dict[str, Any]:
    row: dict[str, Any] = {"n": a.n}
    for name, values in (("rmse", a.rmse), ("mean", a.mean), ("max", a.maximum), ("sigma", a.sigma)):
        if values is not None:
            row[f"{name}_{unit}"] = (values[part] * scale).tolist()
    if a.nees is not None:
        row["nees"] = a.nees
    return row


def _orientation_row(error: Array, covariance: Array) -> dict[str, Any]:
    a = accuracy(error, covariance)
    return _row(a, "m", part=slice(0, 3)) | _row(a, "deg", float(np.degrees(1.0)), slice(3, 6))


def _improvement(result: dict[str, Any], measured: str) -> None:
    points, orientation = result["points"], result["orientation"]
    better: dict[str, Any] = {}
    name = triangulated(points)
    if name and "direct_georeferencing" in points:
        better["points"] = _ratio(points["direct_georeferencing"]["rmse_m"], points[name]["rmse_m"])
        better["of"] = name
    if measured in orientation and "final" in orientation:
        rows = [orientation[n]["rmse_m"] + orientation[n]["rmse_deg"] for n in (measured, "final")]
        better["orientation"] = _ratio(*rows)
    if better:
        result["improvement"] = better


def _ratio(first: list[float], second: list[float]) -> list[float | None]:
    return [a / b if b > 0 else None for a, b in zip(first, second, strict=True)]
