"""Navigation of a recording: check the data, align, filter, smooth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .alignment import AlignmentError, AttitudePrior, NothingSeenError, align
from .carried import NavigationTrajectory
from .error_state import Innovation, NavigationSettings, Observation, Start, sensor_covariance
from .filter_pass import FilterPass, run_filter
from .inertial_checks import check
from .inertial_cleaning import Finding, gap_findings, outage_findings
from .inertial_data import GnssData, InertialData, InertialGrade
from .observations import AntennaPosition, Heading, ZeroVelocity
from .smoother import smooth

Array = NDArray[np.floating]


class NavigationError(ValueError):
    """The data cannot be navigated; the finding says why."""

    def __init__(self, finding: Finding):
        super().__init__(finding.text)
        self.finding = finding


@dataclass(frozen=True)
class Navigated:
    """One stretch of a recording, navigated.

    Attributes
    ----------
    start : alignment
    forward : filter pass
    filtered : trajectory of the filter
    smoothed : trajectory of the smoother, None if not asked for
    findings : remarks on the data
    """

    start: Start
    forward: FilterPass
    filtered: NavigationTrajectory
    smoothed: NavigationTrajectory | None
    findings: list[Finding] = field(default_factory=list)

    @property
    def best(self) -> NavigationTrajectory:
        return self.filtered if self.smoothed is None else self.smoothed


def navigate(
    inertial: InertialData,
    gnss: GnssData,
    settings: NavigationSettings,
    *,
    prior: AttitudePrior | None = None,
    smoothing: bool = True,
    increments: bool = False,
    held_out: NDArray[np.bool_] | None = None,
    aids: list[tuple[float, Observation]] | None = None,
    checks: bool = True,
    tune: bool = True,
    offset_s: float = 0.0,
) -> list[Navigated]:
    """Navigate a recording.

    Parameters
    ----------
    inertial, gnss : cleaned data (see `inertial_checks`)
    settings : sensors and treatment
    prior : attitude at the first inertial sample, where known
    smoothing : whether to smooth after filtering
    increments : whether the inertial data came as increments, for the checks
    held_out : (m,) fixes that are compared with the result but not used
    aids : further observations (see `zero_velocities`, `headings`)
    checks : whether to look for wrong units, axes and time scales first
    tune : whether biases may be taken to change faster than the grade says, where innovations ask for it
    offset_s : added to the times that findings tell

    Returns
    -------
    stretches : one, or more where gaps in the inertial data are longer than the settings allow

    Raises
    ------
    NavigationError : wrong units, axes or time scales, or no alignment
    """
    common: list[Finding] = []
    if checks:
        common = check(inertial, gnss, settings, increments=increments, offset_s=offset_s)
        for finding in (f for f in common if f.fatal):
            raise NavigationError(finding)
    withheld = np.zeros(len(gnss), dtype=bool) if held_out is None else held_out
    out: list[Navigated] = []
    failed: list[Finding] = []
    for i, stretch in enumerate(_stretches(inertial, settings.longest_gap_s)):
        used = gnss[~withheld]
        try:
            start = _aligned(stretch, used, settings, prior if i == 0 else None, offset_s)
        except AlignmentError as error:
            failed.append(Finding("alignment", "alignment", str(error), True))
            continue
        forward = run_filter(stretch, gnss, start, settings, held_out=withheld, aids=aids)
        tuned: list[Finding] = []
        if tune and _disagrees(forward):

            def again(grade: InertialGrade, start: Start = start, stretch: InertialData = stretch) -> FilterPass:
                changed = replace(settings, grade=grade)
                return run_filter(stretch, gnss, restart(start, changed), changed, held_out=withheld, aids=aids)

            forward, tuned = _tuned(forward, again)
        smoothed = NavigationTrajectory.smoothed(forward, smooth(forward)) if smoothing else None
        findings = [*common, *gap_findings(stretch, offset_s), *tuned]
        findings += outage_findings(gnss, start.estimate.time_s, float(stretch.time_s[-1]), offset_s)
        findings += [Finding("alignment", "alignment", note, False) for note in start.notes]
        findings += innovation_findings(forward.innovations, offset_s)
        out.append(Navigated(start, forward, NavigationTrajectory.filtered(forward), smoothed, findings))
        common = []
    if not out:
        raise NavigationError(failed[0])
    for f in failed:
        out[0].findings.append(Finding(f.code, f.subject, f"a stretch was left out: {f.text}", False))
    return out


#: Where nothing shows the attitude, an alignment is tried again so much later, s, or, of a platform that stands, so
#: long before it leaves its place. Tuned: shorter than the windows of an alignment, and long enough to level.
_LATER_S, _BEFORE_S = 130.0, 20.0


def _aligned(
    stretch: InertialData, gnss: GnssData, settings: NavigationSettings, prior: AttitudePrior | None, offset_s: float
) -> Start:
    """Start at the beginning of a stretch, else where its data begin to show the attitude: many stand long before."""
    try:
        return align(stretch, gnss, settings, prior=prior, offset_s=offset_s)
    except NothingSeenError as error:
        first = error
    begin = float(stretch.time_s[0] - stretch.dt_s[0])
    while True:
        later = gnss[(gnss.time_s >= begin + _LATER_S) & (gnss.time_s < stretch.time_s[-1])]
        if not len(later):
            raise first
        position = later.position_e
        leaves = np.linalg.norm(position - position[0], axis=1) > 2.0 + 5.0 * later.sigma_ned_m.max(axis=1)
        if not leaves.any():
            raise first
        begin = max(float(later.time_s[0]), float(later.time_s[np.argmax(leaves)]) - _BEFORE_S)
        try:
            start = align(stretch, gnss, settings, start_s=begin, offset_s=offset_s)
        except NothingSeenError:
            continue
        start.notes.append(f"nothing shows the attitude before: navigation begins at {begin + offset_s:.1f} s")
        return start


#: Changes of the biases that are tried where innovations are too large: correlation time (s), factor on the sigmas.
#: Tuned: mildest first.
_FASTER = ((600.0, 1.0), (60.0, 1.0), (60.0, 3.0), (60.0, 10.0), (60.0, 30.0))
#: Mean normalised innovation squared (1 expected) above which they are tried. Tuned.
_TUNE_ABOVE = 1.3
#: A normalised innovation squared beyond this is an outlier that says nothing about inertial noise. Tuned.
_LARGEST_NIS = 25.0


def _disagrees(forward: FilterPass) -> bool:
    """Whether innovations are too large as a whole, outliers cut down."""
    of_gnss = [i for i in forward.innovations if i.kind in ("position", "velocity") and i.status != "held out"]
    if len(of_gnss) < 30:
        return False
    mean = sum(min(i.nis, _LARGEST_NIS) for i in of_gnss) / sum(len(i.value) for i in of_gnss)
    return mean > _TUNE_ABOVE or any(i.status == "restored" for i in of_gnss)


def _minus_log_likelihood(forward: FilterPass) -> float:
    return sum(
        0.5 * min(i.nis, _LARGEST_NIS) + float(np.log(i.sigma).sum())
        for i in forward.innovations
        if i.kind in ("position", "velocity") and i.status != "held out"
    )


def _tuned(forward: FilterPass, again: Callable[[InertialGrade], FilterPass]) -> tuple[FilterPass, list[Finding]]:
    """The filter pass with the bias model that makes the innovations most likely."""
    given = forward.settings.grade
    best, cost = forward, _minus_log_likelihood(forward)
    for time_s, factor in _FASTER:
        faster = min(time_s, given.bias_time_s)
        if faster == given.bias_time_s and factor == 1.0:
            continue
        trial = again(
            replace(given, bias_time_s=faster, gyro_bias=given.gyro_bias * factor, accel_bias=given.accel_bias * factor)
        )
        trial_cost = _minus_log_likelihood(trial)
        if trial_cost < cost - 10.0:
            best, cost = trial, trial_cost
    if best is forward:
        return forward, []
    g = best.settings.grade
    text = f"inertial errors change faster than the grade says: biases taken as {_biases(g)} (given: {_biases(given)})"
    return best, [Finding("tuned", "imu.noise", text, False)]


def _biases(g: InertialGrade) -> str:
    return f"{np.degrees(g.gyro_bias) * 3600:.3g} deg/h and {g.accel_bias * 1e5:.3g} mGal over {g.bias_time_s:.0f} s"


def restart(start: Start, settings: NavigationSettings) -> Start:
    """The same start for another grade of the inertial sensor."""
    P = start.P.copy()
    P[9:, 9:] = sensor_covariance(settings, start.estimate.state.r_e)
    return Start(start.estimate, P, start.how, start.notes)


def _stretches(inertial: InertialData, longest_gap_s: float) -> list[InertialData]:
    hole = inertial.time_s[1:] - inertial.dt_s[1:] - inertial.time_s[:-1]
    cuts = np.flatnonzero(hole > longest_gap_s) + 1
    parts = np.split(np.arange(len(inertial)), cuts)
    return [inertial[p[0] : p[-1] + 1] for p in parts if len(p) > 1]


def innovation_findings(innovations: list[Innovation], offset_s: float = 0.0) -> list[Finding]:
    """What the innovations say about the sigmas of the observations, and about outliers, with times of the user."""
    findings = []
    for kind in sorted({i.kind for i in innovations}):
        of_kind = [i for i in innovations if i.kind == kind]
        nis = np.array([i.nis / len(i.value) for i in of_kind])
        of_gnss = kind in ("position", "velocity")
        subject, source = ("gnss.sigma", f"gnss.{kind}") if of_gnss else (kind, kind)
        if len(nis) >= 30:
            middle = float(np.median(nis)) / 0.79  # median of chi-square of 3 degrees of freedom over 3
            if middle > 4.0 or middle < 0.1:
                text = f"{kind} innovations are {np.sqrt(middle):.2g} times what their sigmas say: scale these by that"
                findings.append(Finding("sigma scale", subject, text, False))
        rejected = sum(i.status == "rejected" for i in of_kind)
        if rejected:
            text = f"{rejected} of {len(of_kind)} {kind} observations rejected as outliers"
            findings.append(Finding("outliers", source, text, False))
        restored = [i.time_s for i in of_kind if i.status == "restored"]
        if restored:
            times = ", ".join(f"{t + offset_s:.1f}" for t in restored[:5])
            text = f"filter and {kind} disagreed for long, filter restored at {times} s"
            findings.append(Finding("restored", source, text, False))
    return findings


#: How far before and after a time fixes tell the speed of a platform, s, the nearest that are enough.
_AROUND_S = (1.0, 2.0, 4.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0)
#: A platform stands where its speed is known to so many m/s, and is less than that much and three times its sigma.
#: Tuned: a quiet aircraft is to be told from one that is parked.
_SPEED_SIGMA_M_S, _STANDS_M_S = 0.05, 0.1


def zero_velocities(inertial: InertialData, gnss: GnssData, sigma_m_s: float = 0.01) -> list[tuple[float, Observation]]:
    """Zero-velocity observations, one a second, where neither inertial nor GNSS data show a motion."""
    start = float(inertial.time_s[0] - inertial.dt_s[0])
    second = np.floor(inertial.time_s - start).astype(int)
    n = second[-1]
    if n < 3:
        return []

    def moments(x: Array) -> tuple[Array, Array]:
        """Of each second the mean and the spread, of the axis where they are largest."""
        rate = x / inertial.dt_s[:, None]
        count = np.maximum(np.bincount(second), 1)
        mean = np.stack([np.bincount(second, r) / count for r in rate.T], axis=1)
        square = np.stack([np.bincount(second, r * r) / count for r in rate.T], axis=1)
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        return np.abs(mean).max(axis=1)[:n], spread.max(axis=1)[:n]

    turning, shaking = moments(inertial.dtheta)
    quiet = (turning < 0.02) & (shaking < 0.02) & (moments(inertial.dv)[1] < 0.5)
    position, sigma = gnss.position_e, gnss.sigma_ned_m.max(axis=1)
    out: list[tuple[float, Observation]] = []
    for i in np.flatnonzero(quiet):
        time_s = start + float(i) + 0.5
        if 0 < i < n - 1 and quiet[i - 1] and quiet[i + 1] and _stands(gnss.time_s - time_s, position, sigma):
            nearest = int(np.argmin(np.abs(gnss.time_s - time_s)))
            out.append((time_s, ZeroVelocity(sigma_m_s, axes=gnss.R_en[nearest].T)))
    return out


def _stands(time_s: Array, position: Array, sigma_m: Array) -> bool:
    """Whether fixes (m,), (m, 3), (m,) about a time from which ``time_s`` counts show that the platform stands.

    A flight in calm air is as quiet as a platform at rest. What two fixes say of it is less than their noise; so the
    speed is that of as many as make it certain, and where none do, it is not known to stand.
    """
    for around_s in _AROUND_S:
        first, last = np.searchsorted(time_s, (-around_s, around_s))
        if last - first < 3:
            continue
        t = time_s[first:last] - time_s[first:last].mean()
        square = float(t @ t)
        sigma = float(np.sqrt(np.mean(sigma_m[first:last] ** 2) / square))
        if sigma <= _SPEED_SIGMA_M_S:
            speed = float(np.linalg.norm(t @ (position[first:last] - position[first]))) / square
            return speed < _STANDS_M_S + 3.0 * sigma
    return False


def headings(time_s: Array, heading: Array, sigma: Array, step_s: float = 1.0) -> list[tuple[float, Observation]]:
    """Heading observations, thinned to one in ``step_s``, of times (n,), headings and sigmas (n,) in radians."""
    keep, last = [], -np.inf
    for i, t in enumerate(time_s):
        if t >= last + step_s - 1e-6:
            keep.append(i)
            last = t
    return [(float(time_s[i]), Heading(float(heading[i]), float(sigma[i]))) for i in keep]


def innovation_statistics(innovations: list[Innovation], kind: str) -> dict[str, float]:
    """Number, mean normalised square per degree of freedom, and counts by fate, of one kind of observation."""
    of_kind = [i for i in innovations if i.kind == kind and i.status != "held out"]
    if not of_kind:
        return {"n": 0}
    nis = np.array([i.nis / len(i.value) for i in of_kind if i.status != "rejected"])
    out: dict[str, float] = {
        "n": len(of_kind),
        "nis_per_degree_of_freedom": round(float(nis.mean()), 4) if len(nis) else 0.0,
    }
    for status in ("used", "weighted", "rejected", "restored"):
        out[status] = sum(i.status == status for i in of_kind)
    return out


def held_out_misses(
    trajectory: NavigationTrajectory, gnss: GnssData, settings: NavigationSettings, held_out: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Fixes that were not used, less the antenna of a trajectory, north-east-down, and the standard deviations of that.

    The antenna is where the lever arm, as it was estimated, has it; slow errors of fixes, where they are estimated, are
    predicted with it.

    Returns
    -------
    miss, sigma : (k, 3) metres, for the fixes inside the trajectory
    """
    fixes = gnss[held_out & (gnss.time_s >= trajectory.start_s) & (gnss.time_s <= trajectory.end_s)]
    nodes, position, covariance = trajectory.nodes, fixes.position_e, fixes.covariance_e()
    k = np.searchsorted(0.5 * (nodes.time_s[1:] + nodes.time_s[:-1]), fixes.time_s)  # each fix has a node of its own
    miss, sigma = np.zeros((len(fixes), 3)), np.zeros((len(fixes), 3))
    for i, node in enumerate(k.tolist()):
        fix = AntennaPosition(position[i], covariance[i])
        off, H, R = fix.linearise(nodes.one(node), settings.layout)
        R_ne = fixes.R_en[i].T
        miss[i] = R_ne @ off
        sigma[i] = np.sqrt(np.diag(R_ne @ (H @ trajectory.P[node] @ H.T + R) @ R_ne.T))
    return miss, sigma
