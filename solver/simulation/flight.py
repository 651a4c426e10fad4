"""A planned flight and the motion that comes of it: strips, turns, turbulence."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..adjustment.network import Strip
from ..camera.line_camera import LineCamera
from ..camera.sensors import preset
from ..geometry.frames import LocalFrame, R_lc_from_navigation
from ..geometry.rotation import quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from .path import Leg, Track, fly_legs
from .spectra import band_limited_noise
from .terrain import EARTH_RADIUS_M, Terrain, fractal_terrain

Array = NDArray[np.floating]

#: Attitude jitter, degrees 1 sigma, of roll, pitch, heading with turbulence 1: on a stabilised mount and without one.
STABILISED_JITTER_DEG = (0.05, 0.05, 0.05)
UNSTABILISED_JITTER_DEG = (0.4, 0.4, 0.4)
ATTITUDE_CORNER_HZ, ATTITUDE_CUTOFF_HZ = 0.3, 2.0
#: Deviation from the planned line, metres 1 sigma, along X, Y and Z with turbulence 1.
POSITION_JITTER_M = (1.0, 1.0, 1.5)
POSITION_CORNER_HZ, POSITION_CUTOFF_HZ = 0.05, 0.5
GRAVITY_M_S2 = 9.81
#: Limits of a plan: extent of the block, and samples of the true trajectory.
LARGEST_M, MOST_POSES = 1e6, 2e7


@dataclass(frozen=True)
class FlightPlan:
    """What is to be flown.

    Attributes
    ----------
    camera : the line camera
    height_m : flying height above mean ground
    speed_m_s : over ground
    strips, cross_strips : parallel strips, alternating in direction, and strips across them
    strip_s : duration of a parallel strip; cross strips are as long as the block is wide
    sidelap : share of the swath that neighbouring strips have in common
    heading_deg : of the first strip
    turns : fly the turns; otherwise each strip stands alone and nothing is measured for `gap_s` between two
    bank_deg : roll in turns
    stabilised, turbulence : attitude jitter is that of a stabilised mount or not, times turbulence
    lead_in_s, lead_out_s : straight flight with sensors on before the first strip and after the last one
    pose_rate_hz : samples of the true trajectory
    latitude_deg, longitude_deg, ground_height_m : origin of the local frame, at the middle of the block on mean ground
    relief_m : heights of the ground lie mostly within +- this of the mean

    Raises
    ------
    ValueError : a plan that cannot be flown
    """

    camera: LineCamera = field(default_factory=lambda: preset("ads40"))
    height_m: float = 1500.0
    speed_m_s: float = 70.0
    strips: int = 1
    cross_strips: int = 0
    strip_s: float = 60.0
    sidelap: float = 0.3
    heading_deg: float = 90.0
    turns: bool = True
    gap_s: float = 30.0
    bank_deg: float = 25.0
    stabilised: bool = True
    turbulence: float = 1.0
    lead_in_s: float = 10.0
    lead_out_s: float = 5.0
    pose_rate_hz: float = 200.0
    latitude_deg: float = 48.93
    longitude_deg: float = 8.96
    ground_height_m: float = 300.0
    relief_m: float = 75.0

    def __post_init__(self) -> None:
        for name in ("height_m", "speed_m_s", "strip_s", "bank_deg", "pose_rate_hz", "gap_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"flight plan: {name} must be positive, got {getattr(self, name)}")
        for name in ("turbulence", "cross_strips", "lead_in_s", "lead_out_s", "relief_m"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"flight plan: {name} must not be negative, got {getattr(self, name)}")
        if self.bank_deg > 60:
            raise ValueError(f"flight plan: a bank of {self.bank_deg} deg is too steep, wanted at most 60")
        if len(self.camera.lenses) != 1:
            raise ValueError(
                f"flight plan: wanted a camera with one lens, {self.camera.name} has {len(self.camera.lenses)}"
            )
        way = np.abs([line.xy_mm[-1] - line.xy_mm[0] for line in self.camera.lines])
        if (way[:, 0] > way[:, 1]).any():
            raise ValueError(
                f"flight plan: CCD lines of {self.camera.name} lie along x, wanted along y: across the flight"
            )
        if self.strips < 1:
            raise ValueError(f"flight plan: wanted at least one strip, got {self.strips}")
        if not 0 <= self.sidelap < 1:
            raise ValueError(f"flight plan: sidelap must be in [0, 1), got {self.sidelap}")
        if self.relief_m > 0.3 * self.height_m:
            raise ValueError(
                f"flight plan: relief of {self.relief_m:g} m is too high for {self.height_m:g} m above ground, "
                f"wanted at most {0.3 * self.height_m:g}"
            )

        self._check_size()

    def _check_size(self) -> None:
        length = self.speed_m_s * self.strip_s
        if max(length, (self.strips + self.cross_strips) * self.swath_m, self.height_m) > LARGEST_M:
            raise ValueError(f"flight plan: a block of more than {LARGEST_M / 1000:g} km has no local frame")
        poses = (
            (self.strips + self.cross_strips) * (self.strip_s + self.lead_in_s + self.lead_out_s) * self.pose_rate_hz
        )
        if poses > MOST_POSES:
            raise ValueError(f"flight plan: {poses:.3g} poses are too many, wanted at most {MOST_POSES:.3g}")

    @property
    def line_rate_hz(self) -> float:
        """Lines a second, so that a pixel at nadir is square on the ground."""
        return line_rate(self.camera, self.height_m, self.speed_m_s)

    @cached_property
    def swath_m(self) -> float:
        return swath(self.camera, self.height_m)

    @cached_property
    def legs(self) -> tuple[tuple[str, Leg], ...]:
        """Names and ground lines of the strips in the order they are flown."""
        along = np.radians(90.0 - self.heading_deg)
        length = self.speed_m_s * self.strip_s
        spacing = (1.0 - self.sidelap) * self.swath_m
        base = self.height_m * float(np.ptp(view_tangents(self.camera)))
        width = (self.strips - 1) * spacing + self.swath_m
        legs = []
        for i in range(self.strips):
            aside = (i - (self.strips - 1) / 2.0) * spacing
            legs.append((f"S{i + 1}", _leg(along, aside, length, reverse=i % 2 == 1)))
        across = along + np.pi / 2
        for i in range(self.cross_strips):
            aside = length * ((i + 1) / (self.cross_strips + 1) - 0.5)
            legs.append((f"C{i + 1}", _leg(across, aside, width + base, reverse=i % 2 == 1)))
        return tuple(legs)


@dataclass(frozen=True)
class Flight:
    """A flight as it truly was.

    Attributes
    ----------
    name : of the project
    frame : local frame
    camera : line camera
    terrain : the ground
    truth : true orientation of the image frame
    strips : the strips with `truth` as their trajectory
    covered_s : (k, 2) times from which to which the sensors measure; nothing is known between them
    recorded : the truth is a recorded motion, of which nothing is known between its samples
    """

    name: str
    frame: LocalFrame
    camera: LineCamera
    terrain: Terrain
    truth: Trajectory
    strips: tuple[Strip, ...]
    covered_s: Array
    recorded: bool = False

    @property
    def strip_times_s(self) -> Array:
        """(strips, 2) times of the first and the last line of each strip."""
        return np.array([[s.first_line_time_s, float(s.time_of(s.lines - 1))] for s in self.strips])

    def covers(self, time_s: Array) -> NDArray[np.bool_]:
        """Which times (n,) the sensors measure at."""
        t = np.asarray(time_s)[:, None]
        inside = (t >= self.covered_s[:, 0] - 1e-9) & (t <= self.covered_s[:, 1] + 1e-9)
        return np.asarray(inside.any(axis=1))

    def sample_times(self, rate_hz: float) -> Array:
        """Regular sampling times from 0, only where the sensors measure and the truth is known."""
        index = np.arange(int(np.floor(self.truth.end_s * rate_hz + 1e-6)) + 1)
        t = np.minimum(index / rate_hz, self.truth.end_s)
        return t[self.covers(t) & (t >= self.truth.start_s)]


def view_tangents(camera: LineCamera) -> Array:
    """(lines,) tangent of the forward view angle at the middle of each CCD line."""
    return np.array(
        [
            (line.centre_mm - camera.principal_point_mm[i])[0] / camera.focal_length_mm[i]
            for i, line in enumerate(camera.lines)
        ]
    )


def pixel_angle(camera: LineCamera) -> float:
    """Angle of a pixel at the middle of the line that looks down most steeply, radians."""
    k = int(np.argmin(np.abs(view_tangents(camera))))
    pitch = camera.lines[k].image_coordinates((camera.lines[k].pixels - 1) / 2.0)[1]
    return float(np.linalg.norm(pitch) / camera.focal_length_mm[k])


def line_rate(camera: LineCamera, height_m: float, speed_m_s: float) -> float:
    """Lines a second (to a tenth) that make a pixel at nadir square on the ground."""
    return max(0.1, round(speed_m_s / (height_m * pixel_angle(camera)), 1))


def swath(camera: LineCamera, height_m: float) -> float:
    """Width on the ground of the line that looks down most steeply, metres."""
    k = int(np.argmin(np.abs(view_tangents(camera))))
    return height_m * float(np.ptp(camera.lines[k].xy_mm[:, 1])) / float(camera.focal_length_mm[k])


def fly(plan: FlightPlan, motion: np.random.Generator, relief: np.random.Generator) -> Flight:
    """Fly a plan: the true trajectory of the camera, sampled at the plan's pose rate from time 0, and its strips."""
    step = 1.0 / plan.pose_rate_hz
    tracks, offsets = _tracks(plan, step)
    frame = LocalFrame(plan.latitude_deg, plan.longitude_deg, plan.ground_height_m)
    index = np.concatenate([o + np.arange(len(t.time_s)) for t, o in zip(tracks, offsets, strict=True)])
    n = int(index[-1]) + 1
    time_s = index / plan.pose_rate_hz

    horizontal = np.concatenate([t.position for t in tracks])
    drop = np.sum(horizontal**2, axis=1) / (2.0 * EARTH_RADIUS_M)
    position = np.column_stack([horizontal, plan.height_m - drop])
    shake = plan.turbulence * np.array(POSITION_JITTER_M)
    position += band_limited_noise(motion, n, step, shake, POSITION_CORNER_HZ, POSITION_CUTOFF_HZ)[index]

    azimuth = np.concatenate([t.azimuth for t in tracks])
    rate = np.concatenate([t.azimuth_rate for t in tracks])
    bank = np.arctan(-plan.speed_m_s * rate / GRAVITY_M_S2)  # a turn to the right lowers the right wing
    rpy = np.column_stack([bank, np.zeros_like(bank), np.pi / 2 - azimuth])
    jitter = np.radians(STABILISED_JITTER_DEG if plan.stabilised else UNSTABILISED_JITTER_DEG) * plan.turbulence
    rpy += band_limited_noise(motion, n, step, jitter, ATTITUDE_CORNER_HZ, ATTITUDE_CUTOFF_HZ)[index]
    quaternion = quaternion_from_matrix(R_lc_from_navigation(frame, position, rpy))
    truth = Trajectory(time_s, position, quaternion)

    begin = np.concatenate([t.leg_start_s + o * step for t, o in zip(tracks, offsets, strict=True)])
    end = np.concatenate([t.leg_end_s + o * step for t, o in zip(tracks, offsets, strict=True)])
    strips = []
    for (name, _), start_s, end_s in zip(plan.legs, begin, end, strict=True):
        first = np.ceil(start_s * 10.0 - 1e-6) / 10.0
        lines = int(np.floor((end_s - first) * plan.line_rate_hz)) + 1
        strips.append(Strip(name, truth, float(first), plan.line_rate_hz, lines))
    covered = np.array([[o, o + len(t.time_s) - 1] for t, o in zip(tracks, offsets, strict=True)]) / plan.pose_rate_hz
    terrain = fractal_terrain(relief, amplitude_m=plan.relief_m)
    return Flight("simulated flight", frame, plan.camera, terrain, truth, tuple(strips), covered)


def _leg(azimuth: float, aside_m: float, length_m: float, reverse: bool) -> Leg:
    """A leg through the block, its middle ``aside_m`` to the left of the origin."""
    along = np.array([np.cos(azimuth), np.sin(azimuth)])
    middle = aside_m * np.array([-along[1], along[0]])
    start = middle + along * length_m * (0.5 if reverse else -0.5)
    return Leg((float(start[0]), float(start[1])), azimuth + (np.pi if reverse else 0.0), length_m)


def _tracks(plan: FlightPlan, step: float) -> tuple[list[Track], list[int]]:
    """The tracks, each without interruption, and the pose sample each begins at."""
    radius = plan.speed_m_s**2 / (GRAVITY_M_S2 * float(np.tan(np.radians(plan.bank_deg))))
    legs = [leg for _, leg in plan.legs]
    groups = [legs] if plan.turns else [[leg] for leg in legs]
    tracks = [fly_legs(group, plan.speed_m_s, step, radius, plan.lead_in_s, plan.lead_out_s) for group in groups]
    lengths = [len(t.time_s) + round(plan.gap_s / step) for t in tracks]
    return tracks, [0, *np.cumsum(lengths[:-1]).tolist()]
