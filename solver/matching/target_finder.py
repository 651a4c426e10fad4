"""Signalised targets as the lines come in: where each should appear, whether it does, and where exactly.

Coordinates of the target and the orientation of now, with its covariance, say where on the CCD lines a target appears
and how far from there it may lie. The pattern is looked for within that, and the best place is centred by least squares
in the original pixels. What lies further off than the covariance allows, looks like two targets, or is measured poorly
is held for a person to decide.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..camera.line_camera import LineCamera
from ..geometry.rotation import angles_from_matrix, matrix_from_angles
from ..models.slow_errors import SlowErrors
from ..ranges import check_ranges
from .current_orientation import CurrentOrientation
from .line_scan import LineScan, view_of
from .line_store import LineRing, Stretch
from .line_times import LineTimes
from .search import LEAST_MEASURED
from .target_image import RING, Centre, candidates, fit

Array = NDArray[np.floating]

#: Lines kept beyond the widest search: looks wait so long for the pose at their time, s, and lines of vibration.
WAIT_S, PAD = 2.0, 16
#: Why a look is not measured whose lines are missing, black or saturated, but for a few.
NO_LINES = "no lines"
#: A look whose orientation has not come is given up after so long, s.
PATIENCE_S = 1.5
#: Targets are looked for so far along the flight about where the platform is, s: times of looks are guessed to that.
HORIZON_S = 0.5
#: Steps of poses whose noise is looked at, s; and its share in a sample: a target is an average over some lines.
POSE_STEP_S, SHARE_ACROSS = 0.005, 0.5
#: Steps of the pose by which derivatives of a prediction are made, m and rad.
STEPS = (1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4)


@dataclass(frozen=True)
class TargetOptions:
    """How targets are measured, and what is believed.

    Attributes
    ----------
    least_score : correlation coefficient of grey values and model of a target
    rival_score : another place in the search window that looks so much like a target makes the best one doubtful
    least_radius_px : smaller targets are not measured
    least_reach_px, largest_reach_px : of the search
    largest_sigma_px : of a measurement that is believed
    image_sigma_px : what is added for what residuals of grey values do not show
    critical : chi-square (2) of what is measured against what is expected, beyond which a look is doubtful (0.1 %)

    Raises
    ------
    ValueError : a value that makes no sense
    """

    least_score: float = 0.97
    rival_score: float = 0.93
    least_radius_px: float = 1.2
    least_reach_px: float = 6.0
    largest_reach_px: float = 80.0
    largest_sigma_px: float = 0.15
    image_sigma_px: float = 0.01
    critical: float = 13.8

    def __post_init__(self) -> None:
        if not (0 < self.least_score < 1 and 0 < self.rival_score < 1):
            raise ValueError(f"scores {self.least_score}, {self.rival_score}: wanted 0 to 1")
        if not 0 < self.least_reach_px <= self.largest_reach_px:
            raise ValueError(f"largest_reach_px: wanted at least {self.least_reach_px:g}, got {self.largest_reach_px}")
        check_ranges(self, ("image_sigma_px", "largest_sigma_px", "critical"))


@dataclass(frozen=True)
class Target:
    """A ground point that is signalised: local coordinates (3,), their covariance (3, 3), radius of the disc, m."""

    name: str
    xyz_l: Array
    covariance: Array
    radius_m: float


@dataclass(frozen=True)
class TargetLook:
    """A target in one view.

    Attributes
    ----------
    target, ccd : names
    line, sample, sigma_line, sigma_sample : measured, px
    expected_line, expected_sample : by the orientation of now, px
    reach_px : how far from there it was looked for
    score : correlation coefficient of grey values and model; 0 where nothing was found
    off : (2,) measured minus expected, on the ground, X and Y, m
    chi2 : of this, by the covariance of the orientation and of the coordinates
    reason : why it is doubtful; empty for a good one
    found : whether there is a measurement at all
    """

    target: str
    ccd: str
    line: float
    sample: float
    sigma_line: float
    sigma_sample: float
    expected_line: float
    expected_sample: float
    reach_px: float
    score: float
    off: tuple[float, float]
    chi2: float
    reason: str
    found: bool


class TargetFinder:
    """Measures the targets that the lines of one strip after another see.

    Parameters
    ----------
    camera : line camera
    orientation : best orientation known now; kept up to date by whoever owns it, who may change it between strips
    options : see `TargetOptions`

    Attributes
    ----------
    counters : looks by what became of them
    slow : by what the orientation wanders between corrections, kept up to date as ``orientation`` is
    """

    def __init__(self, camera: LineCamera, orientation: CurrentOrientation, options: TargetOptions | None = None):
        self.options = options or TargetOptions()
        self.orientation, self.slow = orientation, SlowErrors()
        self.views = {line.id: view_of(camera, i) for i, line in enumerate(camera.lines)}
        self.counters: Counter[str] = Counter()
        self._targets: dict[str, Target] = {}
        self._rings: dict[str, LineRing] = {}
        self._open: set[tuple[str, str]] = set()
        self._times: LineTimes | None = None
        self._wait_s = WAIT_S  # so long after their lines targets are looked for

    def set_target(self, target: Target) -> None:
        """Add a target, or change its coordinates.

        Raises
        ------
        ValueError : a radius that is not positive
        """
        if not target.radius_m > 0:
            raise ValueError(f"target {target.name!r} of radius {target.radius_m} m, wanted more than 0")
        known = target.name in self._targets
        self._targets[target.name] = target
        if not known and self._times is not None:
            self._open |= {(target.name, ccd) for ccd in self.views}

    def begin_strip(self, times: LineTimes) -> None:
        """Lines that follow belong to a new strip, with their times; all targets may appear in it."""
        self._times = times
        around = self.options.largest_reach_px + 4 * PAD  # of the widest search, on either side
        lines = int(WAIT_S * times.rate + 2 * around)
        # few lines a second take long to come
        self._wait_s = max(WAIT_S, 0.5 * WAIT_S + around / times.rate)
        self._rings = {}
        self._capacity = lines
        self._open = {(name, ccd) for name in self._targets for ccd in self.views}

    def add_lines(
        self,
        ccd: str,
        first_line: int,
        pixels: NDArray[np.unsignedinteger],
        usable: NDArray[np.bool_] | None = None,
    ) -> None:
        """Lines of one CCD line of the strip, and which (n,) are fit for use; nothing is kept without a target."""
        view = self.views.get(ccd)
        if view is None or not self._targets or self._times is None:
            return
        if pixels.ndim != 2 or pixels.shape[1] != view.pixels:
            return
        if ccd not in self._rings:
            self._rings[ccd] = LineRing(view.pixels, self._capacity, pixels.dtype)
        self._rings[ccd].add(first_line, pixels, usable)

    def measure(self, ccd: str) -> list[TargetLook]:
        """Targets whose look by a CCD line has become known, in the order of their names."""
        ring, o, times = self._rings.get(ccd), self.orientation, self._times
        if ring is None or times is None or not np.isfinite(o.end_s) or ring.end <= ring.start:
            return []
        names = sorted(name for name, view in self._open if view == ccd)
        if not names:
            return []
        low = max(ring.start, int(np.ceil(times.line_of(o.start_s))) + 1)
        high = min(ring.end - 1, int(np.floor(times.line_of(o.end_s))) - 1)
        if high - low < 4 * PAD:
            return []
        near = self._near(ccd, names, float(times.time_of(high)))
        if not near:
            return []
        time_s = times.time_of(np.arange(low, high + 1))
        position, R = o.at(time_s)
        scan = LineScan(self.views[ccd], low, position, R)
        looks = []
        for name in near:
            look = self._look(self._targets[name], scan, ring)
            if look is not None:
                self._open.discard((name, ccd))
                self.counters["target " + (look.reason if look.reason else "measured")] += 1
                looks.append(look)
        return looks

    # -- where -------------------------------------------------------------------------------------------------------

    def _near(self, ccd: str, names: list[str], t: float) -> list[str]:
        """The targets that the lines at a time have passed a moment ago, roughly."""
        o, view = self.orientation, self.views[ccd]
        position, R = o.at([t - 0.1, t])
        velocity = (position[1] - position[0]) / 0.1
        middle = R[1] @ view.rays_c(np.array([0.5 * (view.pixels - 1)]))[0]
        points = np.array([self._targets[name].xyz_l for name in names])
        ground = position[1] + middle * ((points[:, 2:] - position[1, 2]) / middle[2])
        speed = max(float(np.hypot(*velocity[:2])), 1e-6)
        behind_s = (ground[:, :2] - points[:, :2]) @ velocity[:2] / speed**2
        aside = np.abs((ground[:, :2] - points[:, :2]) @ np.array([-velocity[1], velocity[0]]) / speed)
        above = position[1, 2] - points[:, 2]
        swath = above * float(np.ptp(view.y_mm)) / view.focal_length_mm
        return [
            n
            for n, b, a, s in zip(names, behind_s, aside, swath, strict=True)
            if -HORIZON_S < b < self._wait_s and a < s
        ]

    def _look(self, target: Target, scan: LineScan, ring: LineRing) -> TargetLook | None:
        """The look at a target, or None while it is not complete or not on these lines."""
        place = target.xyz_l[None]
        middle = np.array([scan.first_line + 0.5 * len(scan.position_l)])
        line, sample, inside = scan.locate(place, middle, rounds=8)
        if not inside[0]:
            return None
        i = int(np.clip(line[0] - scan.first_line, 0, len(scan.position_l) - 2))
        above = float(scan.position_l[i, 2] - target.xyz_l[2])
        pixel = above * scan.view.pitch_mm / scan.view.focal_length_mm
        travel = float(np.linalg.norm(scan.position_l[-1] - scan.position_l[0])) / (len(scan.position_l) - 1)
        covariance = self._expected(target, scan, line[0], sample[0])
        o = self.options
        sigma_px = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) / min(pixel, travel)
        reach = float(np.clip(3.0 * sigma_px + 1.0, o.least_reach_px, o.largest_reach_px))
        half = int(np.ceil(reach + RING * target.radius_m / pixel)) + 2
        away = (half + PAD) * max(pixel / travel, 1.0)
        last = scan.first_line + len(scan.position_l) - 1
        if line[0] + away > last:
            return None  # lines, or poses, are still to come
        if line[0] - away < scan.first_line:
            return None
        nothing = TargetLook(
            target.name, scan.view.ccd, float(line[0]), float(sample[0]), 0.0, 0.0, float(line[0]), float(sample[0]),
            reach, 0.0, (0.0, 0.0), 0.0, "not found", False,
        )  # fmt: skip
        if target.radius_m < o.least_radius_px * pixel:
            return replace(nothing, reason="too small")
        found = self._search(target, scan, ring, line[0], pixel, travel, half, covariance)
        if isinstance(found, str):
            return replace(nothing, reason=found)
        return self._judge(nothing, target, scan, found, covariance, pixel, travel)

    def _time_of(self, line: float) -> float:
        assert self._times is not None
        return float(self._times.time_of(line))

    def _expected(self, target: Target, scan: LineScan, line: float, sample: float) -> Array:
        """Covariance (2, 2) of where the target appears, as X and Y on the ground, m^2: pose and coordinates."""
        i = int(np.clip(round(line) - scan.first_line, 0, len(scan.position_l) - 1))
        position, angles = scan.position_l[i], angles_from_matrix(scan.R_lc[i])
        poses = np.concatenate([position, angles]) + np.vstack([np.zeros(6), np.diag(STEPS)])
        moved = LineScan(scan.view, 0, poses[:, :3], matrix_from_angles(*poses[:, 3:].T))
        xyz, slope = moved.to_plane(np.arange(7.0), np.full(7, sample), np.full(7, target.xyz_l[2]))
        by_pose = ((xyz[1:, :2] - xyz[0, :2]) / np.array(STEPS)[:, None]).T
        by_point = np.column_stack([-np.eye(2), slope[0]])
        time_s = self._time_of(line)
        pose = self.orientation.covariance(time_s) + np.diag(self.slow.wandered(self.orientation.beyond_s(time_s)))
        return by_pose @ pose @ by_pose.T + by_point @ target.covariance @ by_point.T

    def _shaken(self, scan: LineScan, line: float, height_m: float) -> Array:
        """Noise (2,) of single poses, as X and Y on the ground, m: from third differences, which no flight has."""
        time_s = self._time_of(line) + POSE_STEP_S * np.arange(-20, 21)
        time_s = time_s[(time_s > self.orientation.start_s) & (time_s < self.orientation.end_s)]
        if len(time_s) < 12:
            return np.zeros(2)
        position, R = self.orientation.at(time_s)
        track = LineScan(scan.view, 0, position, R)
        n = len(time_s)
        ground, _ = track.to_plane(np.arange(float(n)), np.full(n, 0.5 * (scan.view.pixels - 1)), np.full(n, height_m))
        return np.sqrt(np.mean(np.diff(ground[:, :2], n=3, axis=0) ** 2, axis=0) / 20.0)

    # -- what --------------------------------------------------------------------------------------------------------

    def _search(
        self, target: Target, scan: LineScan, ring: LineRing, line: float, pixel: float, travel: float, half: int,
        expected: Array,
    ) -> tuple[Centre, str] | str:  # fmt: skip
        """The target among the pixels about where it should be, with a doubt; or why there is none."""
        away = int((half + PAD) * max(pixel / travel, 1.0))
        stretch = ring.read(int(line) - away, int(line) + away + 1)
        if len(stretch.pixels) < 2 * away or not (stretch.usable | stretch.filled).all():
            return NO_LINES
        along = scan.way
        turned = scan.view.sample[0] > scan.view.sample[-1]
        across = np.array([along[1], -along[0]]) if turned else np.array([-along[1], along[0]])
        r = pixel * np.arange(-half, half + 1)
        grid = np.empty((len(r), len(r), 3))
        grid[..., :2] = target.xyz_l[:2] + r[:, None, None] * along + r[None, :, None] * across
        grid[..., 2] = target.xyz_l[2]
        guess = np.broadcast_to((line + r / travel)[:, None], grid.shape[:2])
        u, v, inside = scan.locate(grid.reshape(-1, 3), guess.ravel(), rounds=4)
        # beyond the ends of the line there are no pixels: their nearest ones stand in, which look like no target
        values = map_coordinates(
            stretch.pixels.astype(np.float32), [u - stretch.first_line, v], order=1, mode="nearest"
        ).reshape(len(r), len(r))
        if inside.mean() < 0.3:
            return "at the end of the line"
        places, _ = candidates(values, target.radius_m / pixel, 4)
        u, v = u.reshape(values.shape), v.reshape(values.shape)
        fits = [self._centre(target, scan, stretch, float(u[a, b]), float(v[a, b]), pixel) for a, b in places]
        good = sorted((c for c in fits if c is not None and c.converged and c.white > c.black), key=lambda c: -c.score)
        if not good or good[0].score < 0.7:
            return NO_LINES if stretch.filled.any() else "not found"
        best = good[0]
        alike = [best] + [
            c for c in good[1:] if c.score > self.options.rival_score and np.hypot(*(c.xy - best.xy)) > 1.5 * pixel
        ]
        off = np.array([c.xy - target.xyz_l[:2] for c in alike])
        chi2 = np.einsum("ni,ij,nj->n", off, np.linalg.inv(expected + (0.1 * pixel) ** 2 * np.eye(2)), off)
        likely = [c for c, value in zip(alike, chi2, strict=True) if value <= self.options.critical]
        return (likely or alike)[0], "two alike" if len(likely) > 1 else ""

    def _centre(
        self, target: Target, scan: LineScan, stretch: Stretch, u: float, v: float, pixel: float
    ) -> Centre | None:
        """The centre of a target near a pixel, in ground coordinates."""
        size = int(np.ceil(RING * target.radius_m / pixel)) + 3
        first, left = round(u) - 2 * size, round(v) - size
        lines = np.arange(
            max(first, stretch.first_line), min(first + 4 * size + 1, stretch.first_line + len(stretch.pixels))
        )
        samples = np.arange(max(left, 0), min(left + 2 * size + 1, scan.view.pixels))
        if len(samples) < size + 1 or len(lines) < size + 1:
            return None
        line, sample = (a.ravel() for a in np.meshgrid(lines, samples, indexing="ij"))
        xyz, _ = scan.to_plane(line.astype(float), sample.astype(float), np.full(len(line), target.xyz_l[2]))
        grey = stretch.pixels[line - stretch.first_line, sample].astype(float)
        start = xyz[int(np.argmin(np.hypot(line - u, sample - v))), :2]
        if stretch.filled.any():  # what lies between other lines was not measured
            there = stretch.usable[line - stretch.first_line]
            around = np.hypot(*(xyz[:, :2] - start).T) < RING * target.radius_m
            if there[around].mean() < LEAST_MEASURED:
                return None
            xyz, grey = xyz[there], grey[there]
        return fit(xyz[:, :2], grey, start, target.radius_m, pixel)

    def _judge(
        self, nothing: TargetLook, target: Target, scan: LineScan, found: tuple[Centre, str], expected: Array,
        pixel: float, travel: float,
    ) -> TargetLook:  # fmt: skip
        """The look, and whether it is to be believed."""
        o, (centre, doubt) = self.options, found
        xyz = np.append(centre.xy, target.xyz_l[2])
        line, sample, inside = scan.locate(xyz[None], np.array([nothing.line]), rounds=6)
        if not inside[0]:
            return nothing
        along = scan.way
        across = np.array([-along[1], along[0]])
        shaken = self._shaken(scan, float(line[0]), target.xyz_l[2])
        line_var = along @ centre.covariance @ along + (along @ shaken) ** 2
        sample_var = across @ centre.covariance @ across + (SHARE_ACROSS * (across @ shaken)) ** 2
        sigma_line = float(np.sqrt(line_var / travel**2 + o.image_sigma_px**2))
        sigma_sample = float(np.sqrt(sample_var / pixel**2 + o.image_sigma_px**2))
        off = centre.xy - target.xyz_l[:2]
        chi2 = float(off @ np.linalg.solve(expected + (sigma_line * travel) ** 2 * np.eye(2), off))
        reason = doubt
        if chi2 > o.critical:
            reason = "far from where it should be"
        if max(sigma_line, sigma_sample) > o.largest_sigma_px:
            reason = "imprecise"
        if centre.score < o.least_score:
            reason = "poor likeness"
        return replace(
            nothing, line=float(line[0]), sample=float(sample[0]), sigma_line=sigma_line, sigma_sample=sigma_sample,
            score=centre.score, off=(float(off[0]), float(off[1])), chi2=chi2, reason=reason, found=True,
        )  # fmt: skip
