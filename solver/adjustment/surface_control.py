"""Heights of a known surface as control: tie points lie on a digital elevation model, within a stated sigma.

The surface says of a point at X, Y, Z that ``h(X, Y) = Z + s + e``: its height there is that of the point, plus a
shift s that is common to the whole surface (an unknown, with a sigma of its own: the surface as a whole lies too high,
its vertical datum is not the one that was said), plus an error e of this place. Linearised at X0, Y0, with the slopes
of the surface,

    n . (X, Y, Z) + s = h(X0, Y0) + n_x X0 + n_y Y0 - e,    n = (-dh/dX, -dh/dY, 1),

so a surface that is level says nothing of X and Y, and one that is not does. Trees and houses stand on the ground that
no elevation model has; points on them lose their weight (`SurfaceControl.weights`). The batch adjustment and the window
use the same equation and the same weights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Array, Bools
from .reliability import CRITICAL_W
from .robust import Igg3

#: Distances from the surface, in its sigmas, up to which a height counts in full, and from which it does not count at
#: all (weight function IGG III). Tuned: of heights with normal errors one in a hundred loses some weight.
FULL, NONE = 2.5, 6.0
#: Heights per sample of the plane through which the slope is taken: so many on each side of the point. Tuned: the slope
#: of noise is a seventh of the noise over the distance of samples.
SIDE = 2


@dataclass(frozen=True)
class SurfaceRows:
    """One equation a point, for p points: ``normal . xyz + shift = value`` with weight; weight 0 where there is none.

    Attributes
    ----------
    normal : (p, 3)
    value : (p,) m
    weight : (p,) 1/m^2
    """

    normal: Array
    value: Array
    weight: Array

    @property
    def n_observations(self) -> int:
        return int((self.weight > 0).sum())

    def off(self, points_l: Array, shift_m: float) -> Array:
        """Surface minus points (p,), m: what is left of the equations."""
        return self.value - np.einsum("pi,pi->p", self.normal, points_l) - shift_m

    def residual(self, points_l: Array, shift_m: float) -> Array:
        """Whitened (p,)."""
        return np.sqrt(self.weight) * np.where(self.weight > 0, self.off(points_l, shift_m), 0.0)

    def weighed(self, weight: Array) -> SurfaceRows:
        """The same equations with other weights (p,)."""
        return SurfaceRows(self.normal, self.value, weight)


@dataclass(frozen=True)
class SurfaceControl:
    """A surface and how well it is known.

    Attributes
    ----------
    height : Z of the surface at X, Y (n,), NaN where it has none; local frame, metres
    step_m : distance of its samples
    sigma_m : of its height at a place, independent from place to place, 1 sigma
    shift_sigma_m : of the shift that all its heights share, 1 sigma

    Raises
    ------
    ValueError : a sigma or a step that is not positive
    """

    height: Callable[[Array, Array], Array] = field(repr=False)
    step_m: float
    sigma_m: float
    shift_sigma_m: float

    def __post_init__(self) -> None:
        for name in ("step_m", "sigma_m", "shift_sigma_m"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} of a surface is {getattr(self, name):g}, wanted more than 0")

    def rows(self, points_l: Array, which: Bools) -> SurfaceRows:
        """Equations of points (p, 3), at full weight, linearised where they are now.

        Parameters
        ----------
        which : (p,) points that are to have one, if the surface has a height there
        """
        p = len(points_l)
        normal, value = np.tile([0.0, 0.0, 1.0], (p, 1)), np.zeros(p)
        use = np.flatnonzero(which & np.isfinite(points_l).all(axis=1))
        x, y = points_l[use, 0], points_l[use, 1]
        h = self.height(x, y)
        known = np.isfinite(h)
        use, x, y, h = use[known], x[known], y[known], h[known]
        slope = self.slope(x, y)
        normal[use, :2] = -slope
        value[use] = h - slope[:, 0] * x - slope[:, 1] * y
        weight = np.zeros(p)
        weight[use] = self.sigma_m**-2.0
        return SurfaceRows(normal, value, weight)

    def slope(self, x: Array, y: Array) -> Array:
        """(n, 2) dh/dX and dh/dY, of the plane that fits the samples around; 0 where some of them are missing.

        A slope that noise of the heights would make by itself tells nothing, and taken as true it would hold X and Y of
        points on level ground. So it is shrunk by the share that noise has in its square on average.
        """
        at = np.arange(-SIDE, SIDE + 1)
        v, u = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
        z = self.height(x[:, None] + u * self.step_m, y[:, None] + v * self.step_m)
        z = z - z[:, len(u) // 2 : len(u) // 2 + 1]
        squares = float(u @ u)
        slope = np.stack([z @ u, z @ v], axis=1) / (squares * self.step_m)
        slope[~np.isfinite(slope).all(axis=1)] = 0.0
        noise = 2.0 * (self.sigma_m / self.step_m) ** 2 / squares
        steep = np.einsum("ni,ni->n", slope, slope)
        return slope * np.maximum(1.0 - noise / np.maximum(steep, 1e-30), 0.0)[:, None]

    def scale_m(self, off_m: Array) -> float:
        """What distances (n,) from the surface are measured by: its sigma, or their own spread where that is larger.

        As long as the position is not known well the points are off together, and none of them stands on a tree.
        """
        spread = float(np.median(np.abs(off_m))) / 0.6745 if len(off_m) else 0.0
        return max(self.sigma_m, spread)

    def weights(self, off_m: Array, scale_m: float) -> Array:
        """Factors 0..1 (n,) on the weights of heights, by the distance of their points from the surface."""
        return Igg3(FULL, NONE)(np.abs(off_m) / scale_m)


@dataclass(frozen=True)
class SurfaceShift:
    """The shift of a surface, and the test whether it agrees with all else that is known of heights.

    Attributes
    ----------
    shift_m, sigma_m : surface minus all other observations, with the uncertainty of these
    w : of the test against the sigma stated beforehand
    free : the surface holds no height datum: its shift is estimated without that sigma
    """

    shift_m: float
    sigma_m: float
    w: float
    free: bool

    @classmethod
    def of(
        cls, value: float, variance: float, stated_m: float, was_free: bool, critical: float = CRITICAL_W
    ) -> SurfaceShift:
        """From the estimated shift.

        With the a-priori equation ``s = 0`` of sigma S the estimate is ``value`` with variance q; without it
        ``value / r`` with variance ``q / r``, where ``r = 1 - q / S^2`` is the redundancy number of that equation.
        """  # fmt: skip
        if was_free:
            shift, own = value, variance
        else:
            r = max(1.0 - variance / stated_m**2, 1e-9)
            shift, own = value / r, variance / r
        w = abs(shift) / np.sqrt(stated_m**2 + own)
        return cls(float(shift), float(np.sqrt(own)), float(w), bool(w > critical))


@dataclass(frozen=True)
class SurfaceFit:
    """What came of the heights of a surface; p points of the network.

    Attributes
    ----------
    sigma_m, shift_sigma_m : as stated
    off_m : (p,) surface minus adjusted point, less the shift; NaN where the surface gave no height
    weight : (p,) 0..1 that it counted with
    shift : of the whole surface
    """

    sigma_m: float
    shift_sigma_m: float
    off_m: Array
    weight: Array
    shift: SurfaceShift
