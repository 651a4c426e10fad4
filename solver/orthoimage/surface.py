"""Where rays meet the ground: a plane, the ellipsoid, or heights on a grid [D]; also those that the air bends."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry import earth
from ..geometry.frames import LocalFrame
from ..location.refraction import Refraction

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

#: The relief correction ends when heights move less than this, m, or after so many rounds.
TOLERANCE_M, ROUNDS = 1e-3, 12
#: Steps a cell of the search along rays that the relief may be as steep as, and the most of them.
STEPS_A_CELL, MOST_STEPS = 2.0, 4096
#: Cells a side of the squares whose highest and steepest ground tells which rays are searched. Tuned.
SQUARE_CELLS = 8
#: Share of the ground that may be further off a straight line than `Surface.bend_m` says (tuned: the walls of one house
#: in 20 hectares are seen), and heights of a large grid that are looked at for it.
BENT, BENDS = 0.0005, 1_000_000
#: Rounds of a bent ray with the ground. Derived: the shift changes by 1e-4 of a change in height, which is itself the
#: shift times the slope of the ground, so the second round leaves less than a millimetre.
_AIR_ROUNDS = 2


class Surface(Protocol):
    """The ground."""

    def meet(self, position_l: Array, direction_l: Array) -> tuple[Array, Mask]:
        """Where rays first meet it.

        Parameters
        ----------
        position_l, direction_l : (..., 3) local frame; directions of any length

        Returns
        -------
        point_l : (..., 3), NaN where there is none
        met : (...) whether there is one
        """
        ...

    def slope(self, point_l: Array) -> Array:
        """dZ/dX and dZ/dY (..., 2) at points (..., 3) on it; NaN where it is not known."""
        ...

    def bend_m(self, length_m: float) -> float:
        """How far the ground between two places so far apart is above or below the straight line between them, m; a
        share `BENT` of it is further off.
        """
        ...


@dataclass(frozen=True)
class Plane:
    """A level plane of the local frame.

    Attributes
    ----------
    height_m : its Z
    """

    height_m: float

    def meet(self, position_l: Array, direction_l: Array) -> tuple[Array, Mask]:
        """See `Surface.meet`."""
        met = (direction_l[..., 2] < 0) & (position_l[..., 2] > self.height_m)
        down = np.where(met, direction_l[..., 2], np.nan)
        point = position_l + direction_l * ((self.height_m - position_l[..., 2]) / down)[..., None]
        return point, met

    def slope(self, point_l: Array) -> Array:
        """See `Surface.slope`."""
        return np.zeros((*point_l.shape[:-1], 2))

    def bend_m(self, length_m: float) -> float:
        """See `Surface.bend_m`."""
        return 0.0


@dataclass(frozen=True)
class Ellipsoid:
    """The WGS 84 ellipsoid, its half axes made longer by a height.

    Attributes
    ----------
    frame : the local frame
    height_m : above the ellipsoid; exact at the equator and the poles, within 1e-5 of the height elsewhere
    """

    frame: LocalFrame
    height_m: float = 0.0

    def meet(self, position_l: Array, direction_l: Array) -> tuple[Array, Mask]:
        """See `Surface.meet`; the nearer root of the quadratic equation in closed form."""
        a = earth.SEMI_MAJOR_M + self.height_m
        b = earth.SEMI_MAJOR_M * (1.0 - earth.FLATTENING) + self.height_m
        scale = np.array([1.0, 1.0, a / b])  # the ellipsoid becomes a sphere of radius a
        origin = (position_l @ self.frame.R_el.T + self.frame.origin_e) * scale
        ray = (direction_l @ self.frame.R_el.T) * scale
        A = np.einsum("...i,...i->...", ray, ray)
        B = np.einsum("...i,...i->...", origin, ray)
        # |origin|^2 - a^2 as a product: the squares are 1e13 m^2 and would cancel
        length = np.linalg.norm(origin, axis=-1)
        C = (length - a) * (length + a)
        discriminant = B * B - A * C
        met = (discriminant >= 0) & (B < 0) & (C > 0)
        root = np.sqrt(np.where(met, discriminant, np.nan))
        share = C / (root - B)  # the nearer root, in the form that does not cancel
        return position_l + direction_l * share[..., None], met

    def slope(self, point_l: Array) -> Array:
        """See `Surface.slope`; of the tangent plane in the local frame."""
        a = earth.SEMI_MAJOR_M + self.height_m
        b = earth.SEMI_MAJOR_M * (1.0 - earth.FLATTENING) + self.height_m
        point_e = point_l @ self.frame.R_el.T + self.frame.origin_e
        normal = (point_e / np.array([a * a, a * a, b * b])) @ self.frame.R_el
        return -normal[..., :2] / normal[..., 2:]

    def bend_m(self, length_m: float) -> float:
        """See `Surface.bend_m`; the curvature of the Earth is left out."""
        return 0.0


@dataclass(frozen=True)
class HeightField:
    """Heights at the nodes of a grid along X and Y of the local frame, bilinear between them.

    Attributes
    ----------
    x_m, y_m : first node
    step_m : between nodes
    z_m : (rows along Y, columns along X) Z of the nodes, NaN where not known
    endless : whether the heights of its border go on beyond it

    Raises
    ------
    ValueError : fewer than 2 x 2 nodes, no height at all, a step that is not positive
    """

    x_m: float
    y_m: float
    step_m: float
    z_m: Array = field(repr=False)
    endless: bool = False

    def __post_init__(self) -> None:
        if self.z_m.ndim != 2 or min(self.z_m.shape) < 2:
            raise ValueError(f"heights of shape {self.z_m.shape}, wanted at least 2 x 2 nodes")
        if not self.step_m > 0:
            raise ValueError(f"heights every {self.step_m} m, wanted more than 0")
        if not np.isfinite(self.z_m).any():
            raise ValueError("no height is known")

    def height(self, x: Array, y: Array) -> Array:
        """Z below X, Y (...); NaN outside (unless endless) and next to nodes without height."""
        rows, columns = self.z_m.shape
        u, v = (y - self.y_m) / self.step_m, (x - self.x_m) / self.step_m
        if self.endless:
            u, v = np.clip(u, 0, rows - 1), np.clip(v, 0, columns - 1)
        inside = (u >= 0) & (u <= rows - 1) & (v >= 0) & (v <= columns - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        i, j = np.minimum(u.astype(np.int64), rows - 2), np.minimum(v.astype(np.int64), columns - 2)
        a, b = u - i, v - j
        z, at = self.z_m.ravel(), i * columns + j
        low = z[at] + b * (z[at + 1] - z[at])
        high = z[at + columns] + b * (z[at + columns + 1] - z[at + columns])
        return np.where(inside, low + a * (high - low), np.nan)

    def slope(self, point_l: Array) -> Array:
        """See `Surface.slope`; over one step of the grid, on one side where the other one has no height."""
        x, y, half = point_l[..., 0], point_l[..., 1], 0.5 * self.step_m
        here = self.height(x, y)
        out = []
        for dx, dy in ((half, 0.0), (0.0, half)):
            before, after = self.height(x - dx, y - dy), self.height(x + dx, y + dy)
            both = (after - before) / self.step_m
            one = np.where(np.isfinite(after), after - here, here - before) / half
            out.append(np.where(np.isfinite(both), both, one))
        return np.stack(out, axis=-1)

    def bend_m(self, length_m: float) -> float:
        """See `Surface.bend_m`; in the middle of lines along rows and columns, of a large grid of some of them."""
        apart = max(round(0.5 * length_m / self.step_m), 1)
        found = []
        for z in (self.z_m, self.z_m.T):
            z = z[:: max(z.size // BENDS, 1)]
            off = z[:, apart:-apart] - 0.5 * (z[:, : -2 * apart] + z[:, 2 * apart :])
            found.append(np.abs(off[np.isfinite(off)]))
        off = np.concatenate(found)
        # between nodes the ground is straight: a shorter line meets fewer of the bends, and sees less of them
        shorter = min(length_m / (2.0 * self.step_m), 1.0)
        return float(np.quantile(off, max(1.0 - BENT / shorter, 0.0))) * shorter if len(off) else 0.0

    def meet(self, position_l: Array, direction_l: Array) -> tuple[Array, Mask]:
        """See `Surface.meet`.

        The relief correction goes from height to height along the ray, by the secant through the last two. Where the
        relief around is as steep as the ray, and where it is not brought to rest, the ray is searched from above, step
        by step: it may have met the ground before.
        """
        shape = np.broadcast_shapes(position_l.shape, direction_l.shape)
        origin = np.broadcast_to(position_l, shape).reshape(-1, 3)
        d = np.broadcast_to(direction_l, shape).reshape(-1, 3)
        down = d[:, 2] < 0
        slope = d[:, :2] / np.where(down, d[:, 2], np.nan)[:, None]
        z = self._correct(origin, slope)
        z[z > origin[:, 2]] = np.nan  # behind the sensor
        lowest, _, highest = self.range_m
        begin = np.minimum(highest + 1e-6, origin[:, 2])
        met = np.isfinite(z)
        end = np.where(met, z, lowest - 1e-6)
        begin[met] = self._doubtful(origin[met], slope[met], z[met], begin[met])
        search = np.flatnonzero(down & (begin > end))
        search = search[self._may_pass(origin[search], slope[search], begin[search], end[search])]
        if len(search):
            first = self._search(origin[search], slope[search], begin[search], end[search])
            z[search] = np.where(np.isfinite(first), first, z[search])
        xy = origin[:, :2] + slope * (z - origin[:, 2])[:, None]
        point = np.column_stack([xy, z])
        return point.reshape(shape), np.isfinite(z).reshape(shape[:-1])

    @cached_property
    def range_m(self) -> tuple[float, float, float]:
        """Lowest, middle and highest height of the nodes, m."""
        return float(np.nanmin(self.z_m)), float(np.nanmedian(self.z_m)), float(np.nanmax(self.z_m))

    @cached_property
    def _squares(self) -> Array:
        """Highest ground (m) and its steepest slope (metres a metre) in and next to squares of cells, (2, k, m)."""
        from scipy.ndimage import maximum_filter  # not where all ground is level: it takes a tenth of a second

        rows, columns = self.z_m.shape
        starts = np.arange(0, columns, SQUARE_CELLS)
        out = []
        for i in range(0, rows, SQUARE_CELLS):  # a few rows at a time: rasters may be large
            z = self.z_m[i : i + SQUARE_CELLS + 1]
            n = min(SQUARE_CELLS, rows - i)
            steps = [np.abs(np.diff(z, axis=axis, append=np.nan))[:n] / self.step_m for axis in (0, 1)]
            steepest = np.hypot(*[np.where(np.isfinite(a), a, 0.0) for a in steps])
            high = np.where(np.isfinite(z[:n]), z[:n], -np.inf)
            out.append([np.maximum.reduceat(a.max(axis=0), starts) for a in (high, steepest)])
        return np.asarray(maximum_filter(np.stack(out, axis=1), size=(1, 3, 3), mode="nearest"))

    def _doubtful(self, origin: Array, slope: Array, z: Array, top: Array) -> Array:
        """Up to which height (n,) rays that meet the ground at heights z (n,) may have met it before; z for nowhere.

        ``top`` : (n,) height above which there is no ground
        """
        high, steep = self._squares
        side, length = SQUARE_CELLS * self.step_m, np.linalg.norm(slope, axis=1)
        until = z.copy()
        left = np.flatnonzero((length > 0) & (z < top))
        for k in range(MOST_STEPS):  # squares along the ray, from where it meets the ground
            if not len(left):
                break
            rise = side / length[left]
            low = z[left] + k * rise
            xy = origin[left, :2] + slope[left] * (low + 0.5 * rise - origin[left, 2])[:, None]
            j, i = ((xy - [self.x_m, self.y_m]) / side).astype(np.int64).T
            at = np.clip(i, 0, high.shape[0] - 1), np.clip(j, 0, high.shape[1] - 1)
            blocked = high[at] >= low if k else steep[at] * length[left] >= 1.0
            until[left[blocked]] = (low + rise)[blocked]
            left = left[low + rise < top[left]]
        return np.minimum(until, top)

    def _above(self, origin: Array, slope: Array, z: Array) -> Array:
        """How far the ground lies above height z on each ray, m."""
        xy = origin[:, :2] + slope * (z - origin[:, 2])[:, None]
        return self.height(xy[:, 0], xy[:, 1]) - z

    def _correct(self, origin: Array, slope: Array) -> Array:
        """Heights (n,) by relief correction, NaN where it does not converge."""
        z0 = np.full(len(origin), self.range_m[1])
        f0 = self._above(origin, slope, z0)
        z1 = z0 + f0
        for _ in range(ROUNDS):
            f1 = self._above(origin, slope, z1)
            if not (np.abs(f1) > TOLERANCE_M).any():
                break
            fall = f1 - f0
            # without relief the fall is minus the step; a secant that bends off by more is no guide
            step = z1 - z0
            guide = np.abs(fall + step) < 0.9 * np.abs(step)
            change = np.where(guide, -f1 * step / np.where(guide, fall, 1.0), f1)
            z0, f0, z1 = z1, f1, z1 + change
        return np.where(np.abs(self._above(origin, slope, z1)) <= TOLERANCE_M, z1, np.nan)

    def _may_pass(self, origin: Array, slope: Array, begin: Array, end: Array) -> Mask:
        """Whether rays between two heights (n,) may be over the grid; all of them where it is endless."""
        if self.endless:
            return np.ones(len(origin), dtype=bool)
        ends = np.stack([origin[:, :2] + slope * (z - origin[:, 2])[:, None] for z in (begin, end)])
        low = np.array([self.x_m, self.y_m])
        high = low + self.step_m * (np.array(self.z_m.shape[::-1]) - 1)
        return np.asarray(((ends.max(axis=0) >= low) & (ends.min(axis=0) <= high)).all(axis=1))

    def _search(self, origin: Array, slope: Array, begin: Array, end: Array) -> Array:
        """Heights (n,) of the first crossing of each ray between two heights (n,), NaN where there is none."""
        way = np.linalg.norm(slope, axis=1) * (begin - end)
        steps = 2 ** np.ceil(np.log2(np.clip(STEPS_A_CELL * way / self.step_m, 8, MOST_STEPS))).astype(int)
        out = np.full(len(origin), np.nan)
        for count in np.unique(steps).tolist():  # steep rays are not held up by flat ones
            some = np.flatnonzero(steps == count)
            out[some] = self._first(origin[some], slope[some], begin[some], end[some], count)
        return out

    def _first(self, origin: Array, slope: Array, begin: Array, end: Array, steps: int) -> Array:
        """The same of rays that are looked at in so many steps."""
        high, low = begin.copy(), np.full(len(origin), np.nan)
        left = np.arange(len(origin))
        for share in np.linspace(0.0, 1.0, steps + 1):
            z = begin[left] + share * (end[left] - begin[left])
            crossed = self._above(origin[left], slope[left], z) >= 0
            low[left[crossed]] = z[crossed]
            left = left[~crossed]
            high[left] = z[~crossed]
            if not len(left):
                break
        for _ in range(40):
            middle = 0.5 * (low + high)
            under = self._above(origin, slope, middle) >= 0
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        z = 0.5 * (low + high)
        return np.where(np.abs(self._above(origin, slope, z)) < 10 * TOLERANCE_M, z, np.nan)


@dataclass(frozen=True)
class UnderAir:
    """A ground that rays reach through air, which bends them towards the vertical.

    The place of a bent ray at a height is that of the straight one there, less the shift of `Refraction`. The ray meets
    the ground where the line from the perspective centre through this place does, once the place is as high.

    Attributes
    ----------
    surface : the ground
    frame : the local frame
    refraction : what the air does; heights are above its ellipsoid
    """

    surface: Surface
    frame: LocalFrame
    refraction: Refraction

    def meet(self, position_l: Array, direction_l: Array) -> tuple[Array, Mask]:
        """See `Surface.meet`."""
        shape = np.broadcast_shapes(position_l.shape, direction_l.shape)
        centre = np.broadcast_to(position_l, shape)
        straight, met = self.surface.meet(centre, np.broadcast_to(direction_l, shape))
        bent = straight
        for _ in range(_AIR_ROUNDS):
            if not met.any():
                break
            bent, met = self.surface.meet(centre, self._bent(centre, direction_l, bent) - centre)
        return bent, met

    def _bent(self, centre: Array, direction_l: Array, near: Array) -> Array:
        """Where the bent rays are at the heights of points near their ends."""
        along = (near[..., 2] - centre[..., 2]) / direction_l[..., 2]
        straight = centre + direction_l * along[..., None]
        e = [(a @ self.frame.R_el.T + self.frame.origin_e).reshape(-1, 3) for a in (straight, centre)]
        true = (self.refraction.true_ground(*e) - self.frame.origin_e) @ self.frame.R_el
        return true.reshape(near.shape)

    def slope(self, point_l: Array) -> Array:
        """See `Surface.slope`."""
        return self.surface.slope(point_l)

    def bend_m(self, length_m: float) -> float:
        """See `Surface.bend_m`."""
        return self.surface.bend_m(length_m)
