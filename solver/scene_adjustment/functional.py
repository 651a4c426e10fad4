"""Images whose line and sample are functions of longitude, latitude and height: RPC with a correction, affine, DLT.

- RPC: ``line = rpc_line + a0 + a1 x + a2 y``, likewise the sample, with ``x, y`` the model's line and sample from the
  middle of the image in units of its half size (Fraser and Hanley 2003); of these a shift, or all.
- affine (8 coefficients) and DLT (11): ``(a . (1, x, y, z)) / (1 + c . (x, y, z))``, with ``c = 0`` for the affine one,
  in longitude, latitude and height scaled to the points (Fraser and Yamakawa 2004; El-Manadili and Novak 1996). The
  geographic frame takes the curvature of the Earth out of the along-track direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.ellipsoid import WGS84, Ellipsoid
from ..location.affine_bias import AffineBias, CorrectedModel
from ..location.in_image import in_image
from ..location.rpc import Rpc
from ..models.base import direct_observations
from .images import IMAGE, Equations, UnknownGroup

Array = NDArray[np.floating]

#: Usual a-priori sigmas of the correction of an RPC, pixels: shift, and change from the middle to the edge of the
#: image. Tuned: larger than those of any maker, so that control or ties decide.
SHIFT_SIGMA_PX, SLOPE_SIGMA_PX = 50.0, 5.0
_NAMES = ("line shift", "line along lines", "line along samples", "sample shift", "sample along lines",
          "sample along samples")  # fmt: skip
#: Newton's method of the direct location of affine and DLT models ends below this, pixels.
_CONVERGED_PX = 1e-9
_MOST_STEPS = 20
#: Singular values of the equations of a model below this share of the largest do not determine it; nor do points whose
#: scaled coordinates have a singular value below this share (a tenth of a millimetre in height).
_DETERMINED, _FLAT = 1e-9, 1e-4


class RpcImage:
    """An image with rational polynomials and their correction in the image.

    Parameters
    ----------
    name : of the image
    rpc : its polynomials
    affine : False for a shift alone
    shift_sigma_px, slope_sigma_px : what is known of the correction
    assumed : of these two, whether nobody stated it
    size_px : lines and samples, where the polynomials do not know them
    ellipsoid : of the heights
    """

    kind = "rpc"
    locates = True

    def __init__(
        self,
        name: str,
        rpc: Rpc,
        affine: bool = True,
        shift_sigma_px: float = SHIFT_SIGMA_PX,
        slope_sigma_px: float = SLOPE_SIGMA_PX,
        size_px: tuple[int, int] | None = None,
        ellipsoid: Ellipsoid = WGS84,
        assumed: tuple[bool, bool] = (False, False),
    ):
        self.name, self.rpc, self.ellipsoid = name, rpc, ellipsoid
        lines, samples = size_px if size_px is not None else (rpc.lines, rpc.samples)
        if lines and samples:
            self._middle = 0.5 * (np.array([lines, samples]) - 1.0)
            self._half = np.maximum(self._middle, 1.0)
        else:  # the box of the polynomials, sample and line
            self._middle, self._half = rpc.to_image.out_offset[::-1].copy(), np.abs(rpc.to_image.out_scale[::-1])
        self._terms = 3 if affine else 1
        names = [f"{what} of {name}" for what in (*_NAMES[: self._terms], *_NAMES[3 : 3 + self._terms])]
        sigma = np.array([shift_sigma_px, slope_sigma_px, slope_sigma_px])[: self._terms]
        prior = direct_observations(np.tile(sigma, 2), tuple(names))
        of_line = (assumed[0], assumed[1], assumed[1])[: self._terms]
        self.groups = (UnknownGroup(name, IMAGE, tuple(names), prior, 2 * of_line),)

    def measured(self, line: Array, sample: Array) -> FunctionalRays:
        return FunctionalRays(self._computed, np.stack([line, sample], axis=1).astype(float), self.ellipsoid)

    def start(self, line: Array, sample: Array, position_e: Array) -> Array:
        return np.zeros(2 * self._terms)

    def _computed(self, lat: Array, lon: Array, height: Array, values: Array) -> tuple[Array, Array, Array]:
        pixel, slope = self.rpc.to_image.with_derivatives(np.degrees(lon), np.degrees(lat), height)
        pixel, slope = pixel[:, ::-1], slope[:, ::-1] * np.array([np.degrees(1.0), np.degrees(1.0), 1.0])
        n, k = len(pixel), self._terms
        T = np.concatenate([np.ones((n, 1)), (pixel - self._middle) / self._half], axis=1)
        A = np.zeros((n, 2, 2 * k))
        A[:, 0, :k] = A[:, 1, k:] = T[:, :k]
        bias = self._bias(values)
        grown = np.eye(2) + bias[:, 1:] / self._half
        return pixel + T @ bias.T, grown @ slope, A

    def _bias(self, values: Array) -> Array:
        bias = np.zeros((2, 3))
        bias[:, : self._terms] = values.reshape(2, self._terms)
        return bias

    def located(self, values: Array) -> CorrectedModel:
        """The polynomials with their correction."""
        return CorrectedModel(self.rpc, AffineBias(self._bias(values), np.zeros((6, 6)), self._middle, self._half))


@dataclass(frozen=True)
class ProjectiveFunctions:
    """Line and sample as quotients of linear functions of scaled longitude, latitude and height.

    Attributes
    ----------
    numerators : (2, 4) of line and sample: constant, then by x (longitude), y (latitude), z (height)
    denominator : (3,) by x, y, z, beside the constant 1; zeros for the affine model
    offset, scale : (3,) of longitude, latitude (radians) and height
    lines, samples : size of the image, 0 where unknown
    """

    numerators: Array
    denominator: Array
    offset: Array
    scale: Array
    lines: int = 0
    samples: int = 0

    def normalised(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike) -> Array:
        """Scaled coordinates (n, 3)."""
        lat, lon, h = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, dtype=float)) for a in (lat, lon, height_m)))
        d = np.stack([lon, lat, h], axis=1) - self.offset
        d[:, 0] = (d[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
        return d / self.scale

    def at(self, x: Array) -> tuple[Array, Array, Array]:
        """Line and sample (n, 2), their derivatives (n, 2, 3) by scaled coordinates (n, 3), and denominators (n,)."""
        below = 1.0 + x @ self.denominator
        pixel = (self.numerators[:, 0] + x @ self.numerators[:, 1:].T) / below[:, None]
        slope = (self.numerators[:, 1:] - pixel[:, :, None] * self.denominator) / below[:, None, None]
        return pixel, slope, below

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike, margin_px: float | None = None) -> Array:
        """Line and sample, (n, 2), of latitudes and longitudes (radians) at heights; NaN where a denominator is not
        positive, or outside the image by more than a margin."""
        pixel, _, below = self.at(self.normalised(lat, lon, height_m))
        pixel[~(below > 0)] = np.nan
        if margin_px is not None and self.lines and self.samples:
            pixel[~in_image(pixel, self.lines, self.samples, margin_px)] = np.nan
        return pixel

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3), of pixels (n,); NaN where there is none."""
        u, v, h = (np.array(a, dtype=float) for a in np.broadcast_arrays(*map(np.atleast_1d, (line, sample, height_m))))
        x = np.zeros((len(u), 3))
        x[:, 2] = (h - self.offset[2]) / self.scale[2]
        pixel = np.stack([u, v], axis=1)
        miss = np.full((len(u), 2), np.inf)
        for _ in range(_MOST_STEPS):
            computed, slope, _ = self.at(x)
            miss = pixel - computed
            if not (np.abs(miss) > _CONVERGED_PX).any():
                break
            determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
            with np.errstate(divide="ignore", invalid="ignore"):
                x[:, 0] += (slope[:, 1, 1] * miss[:, 0] - slope[:, 0, 1] * miss[:, 1]) / determinant
                x[:, 1] += (slope[:, 0, 0] * miss[:, 1] - slope[:, 1, 0] * miss[:, 0]) / determinant
        lon, lat = (self.offset[:2] + x[:, :2] * self.scale[:2]).T
        out = np.stack([lat, (lon + np.pi) % (2.0 * np.pi) - np.pi, h], axis=1)
        out[~(np.abs(miss).max(axis=1) < 1e3 * _CONVERGED_PX)] = np.nan
        return out


class ProjectiveImage:
    """An image with an affine or a DLT model, which known points determine.

    Parameters
    ----------
    name : of the image
    kind : "affine" (8 unknowns, 4 points at least) or "dlt" (11 unknowns, 6 points)
    size_px : lines and samples, where they are known
    ellipsoid : of the heights
    """

    locates = False

    def __init__(self, name: str, kind: str, size_px: tuple[int, int] | None = None, ellipsoid: Ellipsoid = WGS84):
        if kind not in ("affine", "dlt"):
            raise ValueError(f"model {kind!r}, wanted affine or dlt")
        self.name, self.kind, self.ellipsoid = name, kind, ellipsoid
        self._lines, self._samples = size_px or (0, 0)
        what = [
            f"{c} {t}" for c in ("line", "sample") for t in ("constant", "by longitude", "by latitude", "by height")
        ]
        if kind == "dlt":
            what += [f"denominator {t}" for t in ("by longitude", "by latitude", "by height")]
        self.groups = (UnknownGroup(name, IMAGE, tuple(f"{w} of {name}" for w in what), None),)
        self._offset, self._scale = np.zeros(3), np.ones(3)

    def measured(self, line: Array, sample: Array) -> FunctionalRays:
        return FunctionalRays(self._computed, np.stack([line, sample], axis=1).astype(float), self.ellipsoid)

    def start(self, line: Array, sample: Array, position_e: Array) -> Array:
        """Coefficients by linear least squares."""
        least = 4 if self.kind == "affine" else 6
        if len(position_e) < least:
            raise ValueError(
                f"image {self.name}: {len(position_e)} points with known coordinates, the {self.kind} model wants at "
                f"least {least}"
            )
        g = self.ellipsoid.geodetic(position_e)[:, [1, 0, 2]]
        g[:, 0] = g[0, 0] + (g[:, 0] - g[0, 0] + np.pi) % (2.0 * np.pi) - np.pi
        low, high = g.min(axis=0), g.max(axis=0)
        self._offset = 0.5 * (low + high)
        self._scale = np.maximum(0.5 * (high - low), [1e-9, 1e-9, 1.0])
        x = (g - self._offset) / self._scale
        one, pixel = np.concatenate([np.ones((len(x), 1)), x], axis=1), np.stack([line, sample], axis=1)
        n = len(x)
        A = np.zeros((2 * n, sum(map(len, self.groups))))
        A[:n, :4], A[n:, 4:8] = one, one
        if self.kind == "dlt":
            A[:n, 8:], A[n:, 8:] = -pixel[:, :1] * x, -pixel[:, 1:] * x
        size = np.maximum(np.linalg.norm(A, axis=0), 1e-30)
        shape, values = (np.linalg.svd(M, compute_uv=False) for M in (one, A / size))
        if shape[-1] < _FLAT * shape[0] or values[-1] < _DETERMINED * values[0]:
            raise ValueError(
                f"image {self.name}: its points with known coordinates lie in a plane or on a line, which does not "
                f"determine the {self.kind} model"
            )
        return np.linalg.lstsq(A / size, pixel.T.ravel(), rcond=None)[0] / size

    def located(self, values: Array) -> ProjectiveFunctions:
        """The model with coefficients."""
        below = values[8:] if self.kind == "dlt" else np.zeros(3)
        numerators = np.asarray(values[:8], dtype=float).reshape(2, 4)
        return ProjectiveFunctions(
            numerators, np.asarray(below, dtype=float), self._offset, self._scale, self._lines, self._samples
        )

    def _computed(self, lat: Array, lon: Array, height: Array, values: Array) -> tuple[Array, Array, Array]:
        f = self.located(values)
        x = f.normalised(lat, lon, height)
        pixel, slope, below = f.at(x)
        pixel = np.where((below > 0)[:, None], pixel, np.nan)
        n = len(x)
        one = np.concatenate([np.ones((n, 1)), x], axis=1) / below[:, None]
        A = np.zeros((n, 2, sum(map(len, self.groups))))
        A[:, 0, :4] = A[:, 1, 4:8] = one
        if self.kind == "dlt":
            A[:, :, 8:] = -pixel[:, :, None] * x[:, None, :] / below[:, None, None]
        return pixel, slope / f.scale, A


class FunctionalRays:
    """Measured pixels of an image that is a function of longitude, latitude and height.

    Parameters
    ----------
    computed : lat, lon (radians), height and unknowns to line and sample (n, 2), their derivatives (n, 2, 3) by
        longitude, latitude, height, and (n, 2, k) by the unknowns
    pixel : (n, 2) measured
    """

    def __init__(
        self, computed: Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]], pixel: Array,
        ellipsoid: Ellipsoid,
    ):  # fmt: skip
        self._computed, self._pixel, self._ellipsoid = computed, pixel, ellipsoid

    def equations(self, position_e: Array, values: Array) -> Equations:
        lat, lon, height = self._ellipsoid.geodetic(position_e).T
        pixel, by_geodetic, by_unknown = self._computed(lat, lon, height, values)
        by_point = by_geodetic @ geodetic_derivatives(self._ellipsoid, lat, lon, height)
        return Equations(self._pixel - pixel, by_point, by_unknown)


def geodetic_derivatives(ellipsoid: Ellipsoid, lat: Array, lon: Array, height: Array) -> Array:
    """Derivatives (n, 3, 3) of longitude, latitude (radians) and height by Earth-fixed coordinates."""
    e2, s2 = ellipsoid.eccentricity2, np.sin(lat) ** 2
    N = ellipsoid.semi_major_m / np.sqrt(1.0 - e2 * s2)
    M = N * (1.0 - e2) / (1.0 - e2 * s2)
    J = np.swapaxes(R_e_enu(lat, lon), -1, -2).copy()
    J[:, 0] /= ((N + height) * np.maximum(np.cos(lat), 1e-12))[:, None]
    J[:, 1] /= (M + height)[:, None]
    return J


def R_e_enu(lat: ArrayLike, lon: ArrayLike) -> Array:
    """Rotations (n, 3, 3) from east, north, up at latitudes and longitudes (n,) in radians to Earth-fixed."""
    sp, cp, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(sp)
    east = np.stack([-sl, cl, zero], axis=-1)
    north = np.stack([-sp * cl, -sp * sl, cp], axis=-1)
    return np.stack([east, north, np.stack([cp * cl, cp * sl, sp], axis=-1)], axis=-1)
