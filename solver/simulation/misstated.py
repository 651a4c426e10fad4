"""A world that is not as it is stated: errors that a flight has and no estimator is told of.

What is *stated* are mounting, camera, a-priori error model, sigmas of image measurements and of control: they go into
messages and covariances. The `World` says by how much the truth differs. It changes measurements only, each error where
it arises, and draws what it needs from streams of its own; all other errors keep their draws, so that a flight with and
without it can be compared error by error.

Measured = true + error throughout, as in `error_models`; what is mounted or built differs by ``true = stated + error``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from ..geometry.rotation import quaternion_from_angles, quaternion_from_matrix
from ..geometry.trajectory import Trajectory
from ..quantiles import norm, student
from .error_models import ErrorModel, ErrorRealisation, Three
from .observations import Looks
from .streams import stream

Array = NDArray[np.floating]

ZERO: Three = (0.0, 0.0, 0.0)
#: Step at which the random walk of a position is drawn, s; between, straight lines.
WALK_STEP_S = 0.1
#: Degrees of freedom of heavy-tailed image noise.
HEAVY_TAILED = 3
#: Largest values that still make a flight: of a clock, s; of a focal length, as a share; of the other errors, m or deg.
MOST_CLOCK_S, MOST_FOCAL_SHARE, MOST = 1.0, 0.1, 1000.0


@dataclass(frozen=True)
class Step:
    """The position of the GNSS is off by ``size_m`` (X, Y, Z) from ``time_s`` on; None is the middle of the flight's
    middle strip."""

    size_m: Three
    time_s: float | None = None


@dataclass(frozen=True)
class Sine:
    """Omega, phi and kappa as measured swing by ``amplitude_deg`` at ``frequency_hz``, each with a phase of its own,
    from ``from_s`` to ``to_s``, as in air that is rough there."""

    amplitude_deg: Three
    frequency_hz: float
    from_s: float = -np.inf
    to_s: float = np.inf


@dataclass(frozen=True)
class World:
    """By how much the world differs from what is stated; the default does not.

    Attributes
    ----------
    wander_factor : on the sigmas of the wander of position and attitude
    wander_time_factor : on their correlation time
    random_walk_m : X, Y, Z, m / sqrt(s): position error on top, zero where the flight begins
    steps, sines : errors of positions and of attitude on top
    boresight_deg : roll, pitch, heading of the true boresight minus the stated one
    lever_arm_m : body frame, true minus stated
    focal_length_um : true minus stated
    distortion_px : of the lenses, radial, with the cube of the radius, pixels at the corner of the image; outwards if
        positive
    clock_s : stamps of GNSS and INS minus time of the image lines: what is stamped t was so at ``t - clock_s``
    heavy_tails : noise of image measurements has Student's distribution of 3 degrees of freedom, in units of the
        stated sigma; its variance is three times the stated one
    noise_factor : on the noise of image measurements
    gnss_datum_m, control_datum_m : X, Y, Z, constant error of all positions, and of all control points

    Raises
    ------
    ValueError : a value that is not finite or cannot be
    """

    wander_factor: float = 1.0
    wander_time_factor: float = 1.0
    random_walk_m: Three = ZERO
    steps: tuple[Step, ...] = ()
    sines: tuple[Sine, ...] = ()
    boresight_deg: Three = ZERO
    lever_arm_m: Three = ZERO
    focal_length_um: float = 0.0
    distortion_px: float = 0.0
    clock_s: float = 0.0
    heavy_tails: bool = False
    noise_factor: float = 1.0
    gnss_datum_m: Three = ZERO
    control_datum_m: Three = ZERO

    def __post_init__(self) -> None:
        if not 0 < self.wander_time_factor <= MOST:
            raise ValueError(f"true world: wander_time_factor must be positive, got {self.wander_time_factor}")
        for name in ("wander_factor", "noise_factor"):
            if not 0 <= getattr(self, name) <= MOST:
                raise ValueError(f"true world: {name} must not be negative, got {getattr(self, name)}")
        names = ("boresight_deg", "lever_arm_m", "gnss_datum_m", "control_datum_m", "random_walk_m")
        threes = [(name, getattr(self, name)) for name in names]
        threes += [("step", step.size_m) for step in self.steps] + [("sine", s.amplitude_deg) for s in self.sines]
        for name, value in threes:
            if not all(abs(v) <= MOST for v in value):
                raise ValueError(f"true world: {name} wants numbers up to {MOST:g}, got {value}")
        if min(self.random_walk_m) < 0:
            raise ValueError(f"true world: random_walk_m must not be negative, got {self.random_walk_m}")
        if not abs(self.clock_s) <= MOST_CLOCK_S:
            raise ValueError(f"true world: clock wants at most {MOST_CLOCK_S:g} s, got {self.clock_s}")
        for sine in self.sines:
            if not 0 < sine.frequency_hz < np.inf:
                raise ValueError(f"true world: frequency of a sine must be positive, got {sine.frequency_hz}")
            if not sine.from_s < sine.to_s:
                raise ValueError(f"true world: a sine from {sine.from_s:g} to {sine.to_s:g} s, wanted a later end")
        if not abs(self.focal_length_um) < np.inf:
            raise ValueError(f"true world: focal_length_um must be finite, got {self.focal_length_um}")
        if not abs(self.distortion_px) <= MOST:
            raise ValueError(f"true world: distortion wants at most {MOST:g} px, got {self.distortion_px}")

    @property
    def as_stated(self) -> bool:
        return self == AS_STATED

    def errors(self, stated: ErrorModel) -> ErrorModel:
        """What the wander is drawn from."""
        f = self.wander_factor
        if f == 1.0 and self.wander_time_factor == 1.0:
            return stated
        m, deg = stated.wander_sigma_m, stated.wander_sigma_deg
        return replace(
            stated,
            wander_sigma_m=(f * m[0], f * m[1], f * m[2]),
            wander_sigma_deg=(f * deg[0], f * deg[1], f * deg[2]),
            wander_time_s=stated.wander_time_s * self.wander_time_factor,
            attitude_wander_time_s=stated.attitude_wander_time_s * self.wander_time_factor,
        )

    def camera(self, stated: LineCamera) -> LineCamera:
        """The true camera: longer by the error of its focal length, with the distortion; everything else as stated.

        Raises
        ------
        ValueError : a change that is no error of a calibration any more
        """
        if self.distortion_px:
            stated = _distorted(stated, self.distortion_px)
        if not self.focal_length_um:
            return stated
        for lens in stated.lenses:
            if abs(self.focal_length_um) * 1e-3 > MOST_FOCAL_SHARE * lens.focal_length_mm:
                raise ValueError(
                    f"true world: focal length {self.focal_length_um:g} um off, wanted at most "
                    f"{100 * MOST_FOCAL_SHARE:g} % of {lens.focal_length_mm:g} mm"
                )
        longer = 1e-3 * self.focal_length_um
        return replace(
            stated, lenses=tuple(replace(s, focal_length_mm=s.focal_length_mm + longer) for s in stated.lenses)
        )

    def stamped(self, truth: Trajectory) -> Trajectory:
        """The true trajectory under the stamps of GNSS and INS, over the same times; straight on at its ends."""
        if not self.clock_s:
            return truth
        wanted = truth.time_s - self.clock_s
        poses = truth.at(np.clip(wanted, truth.start_s, truth.end_s))
        beyond = (wanted - poses.time_s)[:, None]
        angles = poses.angles + beyond * poses.angle_rate
        quaternion = quaternion_from_angles(angles)
        return Trajectory(truth.time_s, poses.position_l + beyond * poses.velocity_l, quaternion)

    def image_noise(self, drawn: Array) -> Array:
        """Noise of image measurements in units of the stated sigma, from standard normal draws of the same shape.

        Heavy tails take the quantile of Student's distribution that belongs to each draw, so that they need no other.
        """
        if self.heavy_tails:
            drawn = np.sign(drawn) * student.isf(norm.sf(np.abs(drawn)), HEAVY_TAILED)
        return self.noise_factor * drawn

    def unstated(self, strip_s: Array, start_s: float, end_s: float, seed: int) -> Callable[[Array], Array] | None:
        """Errors of positions and attitude on top: a function of times (n,) that gives (n, 6), m and rad; None if none.

        Parameters
        ----------
        strip_s : (strips, 2) first and last line of each strip
        start_s, end_s : of the flight

        Raises
        ------
        ValueError : a step, or all of a sine, outside the flight
        """
        parts: list[Callable[[Array], Array]] = []
        if any(self.random_walk_m):
            parts.append(_walk(self.random_walk_m, start_s, end_s, stream(seed, "random walk")))
        middle = float(np.mean(strip_s[(len(strip_s) - 1) // 2]))
        for step in self.steps:
            time_s = middle if step.time_s is None else step.time_s
            if not start_s <= time_s <= end_s:
                raise ValueError(f"true world: step at {time_s:g} s, wanted a time in {start_s:g} to {end_s:g} s")
            parts.append(_step(step.size_m, time_s))
        for sine in self.sines:
            if not (sine.from_s < end_s and sine.to_s > start_s):
                part = f"sine from {sine.from_s:g} to {sine.to_s:g} s"
                raise ValueError(f"true world: {part}, wanted times in {start_s:g} to {end_s:g} s")
        phases = stream(seed, "sine")
        parts += [_sine(sine, phases.uniform(0, 2 * np.pi, 3)) for sine in self.sines]
        if any(self.gnss_datum_m):
            parts.append(_step(self.gnss_datum_m, -np.inf))
        if not parts:
            return None
        return lambda time_s: np.sum([part(time_s) for part in parts], axis=0)


#: The world as it is stated.
AS_STATED = World()


@dataclass(frozen=True)
class MisstatedErrors(ErrorRealisation):
    """Slow errors with others on top, ``unstated`` of times (n,): (n, 6), m and rad.

    They are in `at`, and neither in `systematic` and `wander` nor in `rate`: velocities of a receiver come from Doppler
    shifts, which neither a step nor a random walk of its positions changes.
    """

    unstated: Callable[[Array], Array]

    def at(self, time_s: Array) -> Array:
        """The whole error at times (n,): (n, 6), m and rad."""
        return super().at(time_s) + self.unstated(np.asarray(time_s, dtype=float))

    @classmethod
    def over(cls, drawn: ErrorRealisation, unstated: Callable[[Array], Array]) -> MisstatedErrors:
        """Slow errors as drawn, and others on top."""
        return cls(**{name: getattr(drawn, name) for name in ErrorRealisation.__dataclass_fields__}, unstated=unstated)


def as_believed(
    truth: Trajectory, R_bc: Array, lever_b: Array, stated_R_bc: Array, stated_lever_b: Array
) -> Trajectory:
    """The trajectory (of the camera) that follows from antenna and body with a mounting that is stated wrongly.

    Parameters
    ----------
    R_bc, stated_R_bc : (3, 3) true and stated boresight
    lever_b, stated_lever_b : (3,) true and stated lever arm, body frame
    """
    if (R_bc == stated_R_bc).all() and (lever_b == stated_lever_b).all():
        return truth
    poses = truth.at(truth.time_s)
    R_lb = poses.R_lc @ R_bc.T
    position = poses.position_l + R_lb @ (np.asarray(lever_b) - stated_lever_b)
    return Trajectory(truth.time_s, position, quaternion_from_matrix(R_lb @ stated_R_bc))


def looks_through(stated: Looks, true: Looks) -> tuple[Looks, NDArray[np.bool_]]:
    """The looks of a stated camera, each where the true one sees it, and which of them it sees; order as stated."""

    def keys(looks: Looks) -> list[tuple[int, int, int]]:
        return list(zip(looks.point.tolist(), looks.strip.tolist(), looks.ccd.tolist(), strict=True))

    place = {key: i for i, key in enumerate(keys(true))}
    found = np.array([place.get(key, -1) for key in keys(stated)], dtype=int)
    seen = found >= 0
    values = [np.where(seen, getattr(true, a)[found], getattr(stated, a)) if len(true.line) else getattr(stated, a)
              for a in ("time_s", "line", "sample")]  # fmt: skip
    return Looks(stated.point, stated.strip, stated.ccd, *values), seen


def _walk(sigma: Three, start_s: float, end_s: float, rng: np.random.Generator) -> Callable[[Array], Array]:
    n = int(np.ceil((end_s - start_s) / WALK_STEP_S)) + 1
    moves = rng.standard_normal((n, 3)) * np.sqrt(WALK_STEP_S) * np.asarray(sigma)
    place = np.vstack([np.zeros(3), np.cumsum(moves, axis=0)])
    nodes = start_s + WALK_STEP_S * np.arange(n + 1)

    def at(time_s: Array) -> Array:
        error = np.zeros((len(time_s), 6))
        for i in range(3):
            error[:, i] = np.interp(time_s, nodes, place[:, i])
        return error

    return at


def _step(size_m: Three, from_s: float) -> Callable[[Array], Array]:
    return lambda time_s: np.where((time_s >= from_s)[:, None], [*size_m, 0.0, 0.0, 0.0], 0.0)


def _sine(sine: Sine, phase: Array) -> Callable[[Array], Array]:
    amplitude = np.radians(sine.amplitude_deg)

    def at(time_s: Array) -> Array:
        angle = 2 * np.pi * sine.frequency_hz * time_s[:, None] + phase
        there = (time_s >= sine.from_s) & (time_s <= sine.to_s)
        return np.hstack([np.zeros((len(time_s), 3)), amplitude * np.sin(angle) * there[:, None]])

    return at


def _distorted(camera: LineCamera, corner_px: float) -> LineCamera:
    """The camera whose pixels look where its lenses have a radial distortion of so many pixels at the corner."""
    reduced = [line.xy_mm - camera.principal_point_mm[k] for k, line in enumerate(camera.lines)]
    corner_mm = max(float(np.linalg.norm(xy, axis=1).max()) for xy in reduced)
    pitch_mm = float(np.median(np.concatenate([np.linalg.norm(np.diff(xy, axis=0), axis=1) for xy in reduced])))
    k1 = corner_px * pitch_mm / corner_mm**3
    lines = [
        # a look at a pixel comes from further in where the lens moves its image outwards
        replace(line, xy_mm=line.xy_mm - k1 * (xy**2).sum(axis=1, keepdims=True) * xy)
        for line, xy in zip(camera.lines, reduced, strict=True)
    ]
    return replace(camera, lines=tuple(lines))
