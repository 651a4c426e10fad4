"""The rigorous model of a pushbroom scene: direct and inverse location, with light time and aberration as options."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.ellipsoid import WGS84, Ellipsoid
from ..geometry.rotation import cross
from ..orbit.line_times import LineTimes
from ..orbit.motion import FixedPoses, Motion, turned_on
from .in_image import in_image
from .look_directions import LookDirections
from .refraction import Refraction

Array = NDArray[np.floating]

SPEED_OF_LIGHT = 299792458.0  # m/s
#: Newton's method for the inverse ends when line and sample change by less than this, pixels.
_CONVERGED_PX = 1e-7
_MOST_STEPS = 40
#: The rate of the direction is computed anew in every third step; tuned for time.
_STEPS_PER_RATE = 3
#: Pixels are worked on in portions that stay in the processor's cache.
_PORTION = 8192
#: Lines from which the inverse takes its first guess. Tuned: with 17 a strip of half an orbit needs one step more.
_GUESS_LINES = 65
#: How far Newton's method may look beyond the ends of the line of detectors, pixels.
_OVERSHOOT_PX = 1000.0
#: What is further off than this, lines, when it has come to rest is held at the end of orbit and attitude.
_HELD_LINES = 1e-3
#: Refraction is not computed anew once line and sample change by less, pixels. Derived: it changes by 1e-4 of that.
_STEADY_PX = 1e-3


@dataclass(frozen=True)
class Rays:
    """Earth-fixed rays of n pixels.

    Attributes
    ----------
    origin_e : (n, 3) perspective centre, metres
    direction_e : (n, 3) unit vectors from the satellite to the ground, after aberration
    """

    origin_e: Array
    direction_e: Array


class Miss(NamedTuple):
    """How far directions in the body pass beside what n detectors look along, and how that changes by the line.

    Attributes
    ----------
    across, along : (n, 3) axes across the line of detectors and along it, at right angles to the look directions
    square : (n,) squared length of these
    depth : (n,) components along the look directions, times their length; above 0 in front of the sensor
    f, g : (n,) components along ``across`` and ``along``, over the depth
    f_rate, g_rate : (n,) their change, a line
    """

    across: Array
    along: Array
    square: Array
    depth: Array
    f: Array
    g: Array
    f_rate: Array
    g_rate: Array


def miss_of(d: Array, rate: Array, look: Array, slope: Array) -> Miss:
    """`Miss` of directions (n, 3) in the body.

    Parameters
    ----------
    d, rate : (n, 3) directions and their change, a line
    look, slope : (n, 3) look directions of the detectors and their change, a sample
    """
    across = cross(look, slope)
    square = _dot(look, look)
    along = slope - look * (_dot(look, slope) / square)[:, None]
    depth, depth_rate = _dot(d, look), _dot(rate, look)
    f, g = _dot(d, across) / depth, _dot(d, along) / depth
    f_rate = (_dot(rate, across) - f * depth_rate) / depth
    g_rate = (_dot(rate, along) - g * depth_rate) / depth
    return Miss(across, along, square, depth, f, g, f_rate, g_rate)


class PushbroomSensor:
    """One line of detectors over a moving satellite.

    Parameters
    ----------
    motion : Earth-fixed pose at any time
    line_times : when a line was taken, in the seconds of the motion
    look : where a detector looks in the body
    light_time : whether the ground has turned on while the light travelled (the ray meets the ground where it was when
        the light left it); some products have this in their attitudes already
    aberration : whether directions are seen from the moving satellite; some products have this in their attitudes
    lever_arm_b : (3,) metres, from the point whose orbit is given to the perspective centre, in the body
    ellipsoid : heights are above it
    reference_ns : instant of time zero, nanoseconds of TAI (`orbit.time_scales`); 0 where the scene has no date
    name : for messages
    refraction : what the air does to the rays; None where it is left out, or in the attitudes

    Raises
    ------
    ValueError : lines at times that orbit or attitude do not cover
    """

    def __init__(
        self,
        motion: Motion,
        line_times: LineTimes,
        look: LookDirections,
        *,
        light_time: bool = False,
        aberration: bool = False,
        lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
        ellipsoid: Ellipsoid = WGS84,
        reference_ns: int = 0,
        name: str = "",
        refraction: Refraction | None = None,
    ):
        ends = np.sort(line_times.time_of(np.array([0.0, line_times.lines - 1.0])))
        if ends[0] < motion.start_s or ends[1] > motion.end_s:
            what = "orbit" if ends[0] < motion.orbit.start_s or ends[1] > motion.orbit.end_s else "attitude"
            part = motion.orbit if what == "orbit" else motion.attitude
            raise ValueError(
                f"lines are taken from {ends[0]:.6f} to {ends[1]:.6f} s, but the {what} is given "
                f"from {part.start_s:.6f} to {part.end_s:.6f} s only"
            )
        self.motion, self.line_times, self.look = motion, line_times, look
        self.light_time, self.aberration = bool(light_time), bool(aberration)
        self._lever_arm = np.asarray(lever_arm_b, dtype=float)
        self.ellipsoid, self.reference_ns, self.name = ellipsoid, int(reference_ns), name
        self.refraction = refraction
        self._guess: tuple[Array, Array, Array, Array] | None = None  # of the inverse, made when it is first wanted

    def with_refraction(self, refraction: Refraction | None) -> PushbroomSensor:
        """The same sensor with other air, or without."""
        other = copy(self)
        other.refraction = refraction
        return other

    def changed(self, motion: Motion, look: LookDirections) -> PushbroomSensor:
        """The same sensor with another motion, given for the same time at least, and other look directions."""
        other = copy(self)
        other.motion, other.look, other._guess = motion, look, None
        return other

    @property
    def lines(self) -> int:
        return self.line_times.lines

    @property
    def samples(self) -> int:
        return self.look.samples

    def rays(self, line: ArrayLike, sample: ArrayLike) -> Rays:
        """Rays of pixels (n,), before light time.

        Raises
        ------
        ValueError : a line whose time orbit or attitude do not cover
        """
        u, v = np.atleast_1d(np.asarray(line, dtype=float)), np.atleast_1d(np.asarray(sample, dtype=float))
        pose = self._pose(self.line_times.time_of(u))
        direction = np.einsum("nij,nj->ni", pose.R_eb, self.look.at(v)[0])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        if self.aberration:
            direction = without_aberration(direction, self.motion.inertial_velocity(pose.position_e, pose.velocity_e))
        return Rays(pose.position_e, direction)

    def pose(self, line: ArrayLike, *, held: bool = False) -> FixedPoses:
        """Earth-fixed pose of the perspective centre at lines (n,).

        Parameters
        ----------
        held : beyond orbit and attitude as at their ends

        Raises
        ------
        ValueError : a line whose time orbit or attitude do not cover, unless it is held
        """
        u = np.atleast_1d(np.asarray(line, dtype=float))
        return self._pose(self._time_inside(u) if held else self.line_times.time_of(u))

    @property
    def covered_lines(self) -> tuple[float, float]:
        """First and last line, with fractions, for which there are orbit and attitude; all of the image at least."""
        ends = np.sort(self.line_times.line_of(np.array([self.motion.start_s, self.motion.end_s])))
        return min(float(ends[0]), -0.5), max(float(ends[1]), self.lines - 0.5)

    @property
    def _covered_s(self) -> tuple[float, float]:
        """The same in the seconds of the motion."""
        ends = np.sort(self.line_times.time_of(np.array([-0.5, self.lines - 0.5])))
        return min(self.motion.start_s, float(ends[0])), max(self.motion.end_s, float(ends[1]))

    def _pose(self, time_s: Array) -> FixedPoses:
        """Earth-fixed pose of the perspective centre."""
        low, high = self._covered_s
        inside = np.clip(time_s, self.motion.start_s, self.motion.end_s)
        beyond = time_s - inside
        if beyond.any() and low <= time_s.min() and time_s.max() <= high:
            pose = self._continued(inside, beyond)
        else:  # which tells what is not covered
            pose = self.motion.at(time_s)
        if not self._lever_arm.any():
            return pose
        return replace(pose, position_e=pose.position_e + pose.R_eb @ self._lever_arm)

    def _continued(self, time_s: Array, beyond_s: Array) -> FixedPoses:
        """Poses so much before the first or after the last one of the motion, at its rates there.

        Orbit and attitude may end with the centre of the first or last line, whose pixels are a line wide.
        """
        pose = self.motion.at(time_s)
        out = np.flatnonzero(beyond_s)
        period = abs(float(self.line_times.time_of(1.0) - self.line_times.time_of(0.0)))
        step = min(period, self.motion.end_s - self.motion.start_s)
        inner = self.motion.at(time_s[out] - step * np.sign(beyond_s[out]))
        position, R = pose.position_e.copy(), pose.R_eb.copy()
        position[out] += pose.velocity_e[out] * beyond_s[out, None]
        R[out] = turned_on(R[out], inner.R_eb, np.abs(beyond_s[out]) / step)
        return replace(pose, position_e=position, R_eb=R)

    def ground(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Earth-fixed positions (n, 3) in metres where the rays of pixels (n,) reach heights; NaN where they miss.

        Raises
        ------
        ValueError : a line whose time orbit or attitude do not cover
        """
        u, v, h = (
            np.ascontiguousarray(a, dtype=float)
            for a in np.broadcast_arrays(*map(np.atleast_1d, (line, sample, height_m)))
        )
        if u.ndim != 1:
            raise ValueError(f"line, sample and height {u.shape}, wanted one dimension")
        out = np.full((len(u), 3), np.nan)
        for part in _portions(len(u)):
            good = np.isfinite(u[part]) & np.isfinite(v[part]) & np.isfinite(h[part])
            if good.all():
                out[part] = self._ground(u[part], v[part], h[part])
            elif good.any():
                out[part][good] = self._ground(u[part][good], v[part][good], h[part][good])
        return out

    def _ground(self, u: Array, v: Array, h: Array) -> Array:
        return self.reach(self.rays(u, v), h)

    def reach(self, rays: Rays, height_m: ArrayLike) -> Array:
        """Earth-fixed positions (n, 3) in metres where rays (n,) reach heights (n,), with light time and refraction."""
        h = np.asarray(height_m, dtype=float)
        C, d = rays.origin_e, rays.direction_e
        s = self.ellipsoid.intersect(C, d, h)
        if self.light_time:
            for _ in range(2):
                angle = self.motion.omega_e[2] * s / SPEED_OF_LIGHT
                C, d = _turned_back(rays.origin_e, angle), _turned_back(rays.direction_e, angle)
                s = self.ellipsoid.intersect(C, d, h)
        P = C + s[:, None] * d
        return P if self.refraction is None else self.refraction.true_ground(P, C)

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height (metres), (n, 3), of pixels (n,) at heights above the ellipsoid.

        Rays that miss the Earth give NaN.

        Raises
        ------
        ValueError : a line whose time orbit or attitude do not cover
        """
        located = self.ground(line, sample, height_m)
        for part in _portions(len(located)):
            located[part] = self.ellipsoid.geodetic(located[part])
        located[:, 2] = np.where(np.isnan(located[:, 0]), np.nan, np.broadcast_to(height_m, len(located)))
        return located

    def ground_to_pixel(self, position_e: ArrayLike, margin_px: float = 0.0) -> Array:
        """Line and sample, (n, 2), of Earth-fixed positions (n, 3) in metres.

        Newton's method on the direction in the body: across the line of detectors it gives the time, along it the
        detector. The first guess is where the plane of the detectors sweeps over the point.

        Parameters
        ----------
        position_e : (n, 3) metres
        margin_px : how far outside the image an answer is still given; the edge of the image lies half a pixel outside
            the centres of the outermost pixels

        Returns
        -------
        (n, 2) ; NaN where the point is not in the image, or hidden behind the planet
        """
        P = np.asarray(position_e, dtype=float)
        if P.ndim != 2 or P.shape[1] != 3:
            raise ValueError(f"positions {P.shape}, wanted (n, 3)")
        out = np.full((len(P), 2), np.nan)
        for part in _portions(len(P)):
            good = np.isfinite(P[part]).all(axis=1)
            if good.any():
                out[part][good] = self._inverse(P[part][good], margin_px)
        return out

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float = 0.0) -> Array:
        """Line and sample, (n, 2), of latitudes and longitudes (n,) in radians at heights above the ellipsoid.

        Parameters and result as of `ground_to_pixel`.
        """
        lat, lon, h = np.broadcast_arrays(*map(np.atleast_1d, (lat, lon, height_m)))
        return self.ground_to_pixel(self.ellipsoid.cartesian(lat, lon, h), margin_px)

    def _inverse(self, P: Array, margin_px: float) -> Array:
        u_low, u_high = self.covered_lines
        u, v = self._first_guess(P)
        low, high = -0.5 - margin_px - _OVERSHOOT_PX, self.samples - 0.5 + margin_px + _OVERSHOOT_PX
        seen, moved = np.zeros(len(P), dtype=bool), np.full(len(P), np.inf)
        active = np.arange(len(P))
        rates, origin, straight = np.empty_like(P), np.empty_like(P), P.copy()
        for k in range(_MOST_STEPS):
            if self.refraction is not None and (k < 2 or moved[active].max() > _STEADY_PX):
                straight[active] = self._straight(self.refraction, P[active], u[active])
            d, origin[active] = self._towards(straight[active], u[active])
            if k % _STEPS_PER_RATE == 0:  # a rate of a step before is good enough close to the answer
                step = np.where(u[active] + 1.0 <= u_high, 1.0, -1.0)
                rates[active] = (self._towards(straight[active], u[active] + step)[0] - d) / step[:, None]
            rate = rates[active]
            look, slope = self.look.at(v[active])
            at = miss_of(d, rate, look, slope)
            with np.errstate(divide="ignore", invalid="ignore"):
                du = -at.f / at.f_rate
            new_u = np.clip(np.where(np.isfinite(du), u[active] + du, u[active]), u_low, u_high)
            du = new_u - u[active]
            dv = (at.g + at.g_rate * du) * at.square / _dot(at.along, at.along)
            new_v = np.clip(v[active] + dv, low, high)
            moved[active] = np.maximum(np.abs(du), np.abs(new_v - v[active]))
            seen[active] = (at.depth > 0) & (np.abs(at.f) <= _HELD_LINES * np.abs(at.f_rate))  # not held at an end
            u[active], v[active] = new_u, new_v
            active = active[moved[active] > _CONVERGED_PX]
            if not len(active):
                break
        out = np.stack([u, v], axis=1)
        visible = _dot(self.ellipsoid.normal_and_height(P)[0], origin - P) > 0  # the side the satellite is above
        inside = in_image(out, self.lines, self.samples, margin_px + _CONVERGED_PX)
        out[~(inside & seen & (moved <= _CONVERGED_PX) & visible)] = np.nan
        return out

    def appearance(self, position_e: Array, pose: FixedPoses) -> Array:
        """Directions (n, 3) in the body, unit vectors, in which points (n, 3) appear from poses (n,).

        Refraction, light time and aberration are those of the sensor.
        """
        P = position_e
        if self.refraction is not None:
            P = self._straightened(self.refraction, P, pose.position_e)
        return self._appearance(P, pose)

    def _straight(self, refraction: Refraction, P: Array, u: Array) -> Array:
        """Points (n, 3) towards which straight rays of lines (n,) look that, bent, reach points (n, 3)."""
        return self._straightened(refraction, P, self._pose(self._time_inside(u)).position_e)

    def _straightened(self, refraction: Refraction, P: Array, C: Array) -> Array:
        """The same for perspective centres (n, 3)."""
        if self.light_time:
            C = _turned_back(C, self.motion.omega_e[2] * np.linalg.norm(P - C, axis=1) / SPEED_OF_LIGHT)
        return refraction.straight_ground(P, C)

    def _towards(self, P: Array, u: Array) -> tuple[Array, Array]:
        """Directions (n, 3) in the body in which points (n, 3) appear on lines (n,), and perspective centres (n, 3)."""
        pose = self._pose(self._time_inside(u))
        return self._appearance(P, pose), pose.position_e

    def _appearance(self, P: Array, pose: FixedPoses) -> Array:
        """Directions (n, 3) in the body in which points (n, 3) appear without refraction."""
        if self.light_time:
            d = P - pose.position_e
            P = _turned_back(P, -self.motion.omega_e[2] * np.linalg.norm(d, axis=1) / SPEED_OF_LIGHT)
        d = P - pose.position_e
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        if self.aberration:
            d = without_aberration(d, -self.motion.inertial_velocity(pose.position_e, pose.velocity_e))
        return np.einsum("nij,ni->nj", pose.R_eb, d)

    def _time_inside(self, u: Array) -> Array:
        return np.clip(self.line_times.time_of(u), *self._covered_s)

    def _first_guess(self, P: Array) -> tuple[Array, Array]:
        """Line and sample (n,), (n,) near where points (n, 3) appear.

        On some lines the plane of the detectors is known; the point lies between the two lines where it changes side.
        Of several such places the one where the point is nearest to the middle of the line of detectors is taken.
        """
        if self._guess is None:
            u = np.linspace(0.0, max(self.lines - 1.0, 1.0), _GUESS_LINES)
            pose = self._pose(self._time_inside(u))
            ends = self.look.at(np.array([0.0, 0.5 * (self.samples - 1), max(self.samples - 1.0, 1.0)]))[0]
            ends /= np.linalg.norm(ends, axis=1, keepdims=True)
            frame = np.stack([np.cross(ends[0], ends[2]), ends[1], ends[2] - ends[0]])
            frame /= np.linalg.norm(frame, axis=1, keepdims=True)
            self._guess = (u, pose.position_e, np.einsum("kij,aj->aki", pose.R_eb, frame), ends @ frame[2])
        u, C, axes, edge = self._guess
        side, depth, along = (P @ a.T - _dot(a, C) for a in axes)  # (n, k) each
        change = (np.sign(side[:, 1:]) != np.sign(side[:, :-1])) & (depth[:, 1:] > 0) & (depth[:, :-1] > 0)
        middle = np.abs(along[:, 1:] + along[:, :-1]) / np.maximum(depth[:, 1:] + depth[:, :-1], 1.0)
        k = np.argmin(np.where(change, middle, np.inf), axis=1)
        row = np.arange(len(P))
        nowhere = ~change.any(axis=1)
        angle = np.where(depth > 0, np.abs(side) / np.maximum(depth, 1.0), np.inf)
        k[nowhere] = np.clip(np.argmin(angle[nowhere], axis=1), 0, len(u) - 2)
        a, b = side[row, k] / np.abs(depth[row, k]), side[row, k + 1] / np.abs(depth[row, k + 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip(np.nan_to_num(a / (a - b), nan=0.5, posinf=1.0, neginf=0.0), 0.0, 1.0)
        line = u[k] + share * (u[k + 1] - u[k])
        tangent = (along[row, k] * (1 - share) + along[row, k + 1] * share) / np.linalg.norm(P - C[k], axis=1)
        sample = (tangent - edge[0]) / (edge[2] - edge[0]) * (self.samples - 1)
        return line, np.clip(sample, 0.0, self.samples - 1.0)


def without_aberration(direction: Array, velocity: Array) -> Array:
    """Unit directions (n, 3) at rest of directions seen from a platform that moves with velocities (n, 3), m/s.

    The platform sees light come from a direction that is bent towards its velocity; this takes the bend away
    (special relativity, exact): along the velocity ``cos = (cos' - b) / (1 - b cos')``.
    """
    b = velocity / SPEED_OF_LIGHT
    gamma = 1.0 / np.sqrt(1.0 - np.einsum("ni,ni->n", b, b))
    along = np.einsum("ni,ni->n", b, direction)
    factor = gamma * gamma / (1.0 + gamma) * along - gamma
    rest = direction + factor[:, None] * b
    return rest / (gamma * (1.0 - along))[:, None]


def _turned_back(x: Array, angle: Array) -> Array:
    """Vectors (n, 3) in the Earth-fixed axes of an instant earlier, in which the Earth turns by ``angle`` (n,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1], x[:, 2]], axis=1)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)


def _portions(n: int) -> list[slice]:
    return [slice(k, min(k + _PORTION, n)) for k in range(0, n, _PORTION)]
