"""Inertial and GNSS measurements as arrays: increments, their corrections for coning and sculling, gaps, pieces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import earth
from ..geometry.rotation import cross

Array = NDArray[np.floating]

#: A sample that comes later than this share of the sampling interval has lost something before it. Tuned.
GAP_FACTOR = 1.6


@dataclass(frozen=True)
class InertialData:
    """Inertial increments, body frame (forward-right-down).

    Attributes
    ----------
    time_s : (n,) stamps: the end of each sample's interval, strictly increasing
    dt_s : (n,) length of the interval; where it is shorter than the distance of the stamps, nothing was measured before
    dtheta : (n, 3) integral of the angular rate over the interval, rad
    dv : (n, 3) integral of the specific force over the interval, m/s
    gyro_psd, accel_psd : (n,) additional noise of made-up samples in gaps, rad^2/s and (m/s)^2/s; zero for measured
        ones
    """

    time_s: Array
    dt_s: Array
    dtheta: Array
    dv: Array
    gyro_psd: Array
    accel_psd: Array

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, part: slice | NDArray) -> InertialData:
        return InertialData(
            self.time_s[part],
            self.dt_s[part],
            self.dtheta[part],
            self.dv[part],
            self.gyro_psd[part],
            self.accel_psd[part],
        )

    @property
    def interval_s(self) -> float:
        """Median sampling interval."""
        return float(np.median(self.dt_s))

    @classmethod
    def from_increments(cls, time_s: ArrayLike, dtheta: ArrayLike, dv: ArrayLike) -> InertialData:
        """From increments over the interval that ends at the stamp.

        Raises
        ------
        ValueError : fewer than two samples, shapes that do not match, values that are not finite, times that do not
            increase
        """
        time, dt, dtheta, dv = _checked(time_s, dtheta, dv)
        zero = np.zeros(len(time))
        return cls(time, dt, dtheta, dv, zero, zero)

    @classmethod
    def from_rates(cls, time_s: ArrayLike, rate: ArrayLike, force: ArrayLike) -> InertialData:
        """From the mean angular rate (rad/s) and specific force (m/s^2) over the interval that ends at the stamp."""
        time, dt, rate, force = _checked(time_s, rate, force)
        zero = np.zeros(len(time))
        return cls(time, dt, rate * dt[:, None], force * dt[:, None], zero, zero)

    def gaps(self) -> list[tuple[float, float]]:
        """Start and end of the times without measurement."""
        hole = self.time_s[1:] - self.dt_s[1:] - self.time_s[:-1]
        k = np.flatnonzero(hole > 1e-9 * np.maximum(1.0, np.abs(self.time_s[1:]))) + 1
        return [(float(self.time_s[i - 1]), float(self.time_s[i] - self.dt_s[i])) for i in k]

    def bridged(self, rate_sigma: float, force_sigma: float) -> InertialData:
        """Gaps filled with samples on the straight line between the rates on both sides.

        What is made up is noisy: over a gap of length ``T`` the rate is wrong by about ``s`` throughout, so that the
        angle is wrong by ``s T``; that is the white noise density ``s^2 T``. ``s`` is ``rate_sigma`` (rad/s) or
        ``force_sigma`` (m/s^2) plus half the jump over the gap.
        """
        hole = self.time_s[1:] - self.dt_s[1:] - self.time_s[:-1]
        where = np.flatnonzero(hole > 1e-9 * np.maximum(1.0, np.abs(self.time_s[1:]))) + 1
        if not len(where):
            return self
        parts: list[InertialData] = []
        nominal = self.interval_s
        last = 0
        for i in where:
            parts.append(self[last:i])
            T = float(hole[i - 1])
            n = max(1, round(T / nominal))
            share = ((np.arange(n) + 0.5) / n)[:, None]
            rates = [x / self.dt_s[[i - 1, i], None] for x in (self.dtheta[i - 1 : i + 1], self.dv[i - 1 : i + 1])]
            dtheta, dv = ((r[0] + share * (r[1] - r[0])) * (T / n) for r in rates)
            psd = [
                np.full(n, (sigma + 0.5 * float(np.linalg.norm(r[1] - r[0]))) ** 2 * T)
                for r, sigma in zip(rates, (rate_sigma, force_sigma), strict=True)
            ]
            time = self.time_s[i - 1] + T * (np.arange(n) + 1) / n
            parts.append(InertialData(time, np.full(n, T / n), dtheta, dv, psd[0], psd[1]))
            last = int(i)
        parts.append(self[last:])
        return concatenate(parts)

    def corrected(self, previous: tuple[ArrayLike, ArrayLike, float] | None = None) -> InertialData:
        """Rotation vectors and velocity increments, with the terms that a rate linear in time leaves [Savage 1998].

        ``phi = dtheta + dtheta' x dtheta / 12`` (coning) and ``dv + (dtheta' x dv + dv' x dtheta) / 12`` (sculling),
        where the prime is the sample before, scaled to the same length. The velocity increment stays in the axes of the
        body as it turns; the rotation over the sample is added where it is integrated.

        Parameters
        ----------
        previous : increments ``(dtheta, dv)`` and length of the sample before the first, where there is one
        """
        dtheta, dv, dt = self.dtheta, self.dv, self.dt_s[:, None]
        th0, v0, dt0 = np.empty_like(dtheta), np.empty_like(dv), np.empty_like(dt)
        th0[1:], v0[1:], dt0[1:] = dtheta[:-1], dv[:-1], dt[:-1]
        if previous is None:
            th0[0], v0[0], dt0[0] = dtheta[0], dv[0], dt[0]
        else:
            th0[0], v0[0], dt0[0] = np.asarray(previous[0]), np.asarray(previous[1]), previous[2]
        scale = dt / (12.0 * dt0)
        phi = dtheta + scale * cross(th0, dtheta)
        return replace(self, dtheta=phi, dv=dv + scale * (cross(th0, dv) + cross(v0, dtheta)))


def concatenate(parts: list[InertialData]) -> InertialData:
    """Samples of several stretches in one."""
    names = ("time_s", "dt_s", "dtheta", "dv", "gyro_psd", "accel_psd")
    return InertialData(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def cut(data: InertialData, time_s: ArrayLike) -> tuple[InertialData, NDArray[np.intp]]:
    """Samples cut at given times (k,), in proportion, so that none reaches over one of them.

    Returns
    -------
    pieces : inertial data with ``len(data) + (cuts inside samples)`` rows
    sample : index of the sample that each piece belongs to
    """
    t = np.asarray(time_s, dtype=float)
    i = np.searchsorted(data.time_s, t)
    inside = i < len(data)
    i, t = i[inside], t[inside]
    start = data.time_s[i] - data.dt_s[i]
    keep = (t > start + 1e-9) & (t < data.time_s[i] - 1e-9)  # a nanosecond: nothing worth cutting off
    i, t = i[keep], t[keep]
    if not len(t):
        return data, np.arange(len(data))
    end = np.concatenate([data.time_s, t])
    sample = np.concatenate([np.arange(len(data)), i])
    order = np.argsort(end, kind="stable")
    end, sample = end[order], sample[order]
    begin = data.time_s[sample] - data.dt_s[sample]
    begin[1:] = np.where(sample[1:] == sample[:-1], end[:-1], begin[1:])
    dt = end - begin
    share = (dt / data.dt_s[sample])[:, None]
    whole = data[sample]
    return replace(whole, time_s=end, dt_s=dt, dtheta=whole.dtheta * share, dv=whole.dv * share), sample


@dataclass(frozen=True)
class GnssData:
    """GNSS fixes of the antenna.

    Attributes
    ----------
    time_s : (m,) strictly increasing
    lat, lon : (m,) radians
    height_m : (m,) ellipsoidal
    sigma_ned_m : (m, 3) standard deviations north, east, down
    velocity_n : (m, 3) m/s north, east, down, or None
    sigma_velocity_n : (m, 3) m/s, or None
    """

    time_s: Array
    lat: Array
    lon: Array
    height_m: Array
    sigma_ned_m: Array
    velocity_n: Array | None = None
    sigma_velocity_n: Array | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, part: slice | NDArray) -> GnssData:
        v, s = self.velocity_n, self.sigma_velocity_n
        return GnssData(
            self.time_s[part],
            self.lat[part],
            self.lon[part],
            self.height_m[part],
            self.sigma_ned_m[part],
            None if v is None else v[part],
            None if s is None else s[part],
        )

    @property
    def position_e(self) -> Array:
        """Earth-fixed positions (m, 3)."""
        return earth.ecef_from_geodetic(self.lat, self.lon, self.height_m)

    @cached_property
    def R_en(self) -> Array:
        """North-east-down at each fix to Earth-fixed, (m, 3, 3)."""
        return earth.R_en(self.lat, self.lon)

    @cached_property
    def velocity_e(self) -> Array | None:
        return None if self.velocity_n is None else np.einsum("mij,mj->mi", self.R_en, self.velocity_n)

    def covariance_e(self) -> Array:
        """Covariance of the positions, Earth-fixed, (m, 3, 3)."""
        A = self.R_en * self.sigma_ned_m[:, None, :]
        return A @ np.swapaxes(A, -1, -2)


def _checked(time_s: ArrayLike, a: ArrayLike, b: ArrayLike) -> tuple[Array, Array, Array, Array]:
    time = np.ascontiguousarray(time_s, dtype=float)
    a, b = (np.ascontiguousarray(x, dtype=float) for x in (a, b))
    n = len(time)
    if n < 2:
        raise ValueError(f"inertial data need at least 2 samples, got {n}")
    if a.shape != (n, 3) or b.shape != (n, 3):
        raise ValueError(f"rotation {a.shape} and force {b.shape} do not match {n} times")
    if not (np.isfinite(time).all() and np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("inertial data contain values that are not finite")
    step = np.diff(time)
    if not (step > 0).all():
        raise ValueError(f"times of inertial data must increase; sample {int(np.argmin(step > 0)) + 1} does not")
    nominal = float(np.median(step))
    late = np.append(step[:-1] + step[1:], np.inf) < (1.0 + GAP_FACTOR) * nominal  # the next stamp makes up for it
    dt = np.concatenate([[nominal], np.where((step > GAP_FACTOR * nominal) & ~late, nominal, step)])
    return time, dt, a, b


@dataclass(frozen=True)
class InertialGrade:
    """Error model of an inertial measurement unit: white noise, and biases as first-order Gauss-Markov processes.

    Attributes
    ----------
    gyro_noise : angular random walk, rad/sqrt(s)
    gyro_bias : standard deviation, rad/s
    accel_noise : velocity random walk, m/s/sqrt(s)
    accel_bias : standard deviation, m/s^2
    bias_time_s : correlation time of the biases
    gyro_scale, accel_scale : standard deviation of constant scale factors, unitless
    """

    gyro_noise: float
    gyro_bias: float
    accel_noise: float
    accel_bias: float
    bias_time_s: float = 7200.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = name not in ("gyro_scale", "accel_scale")
            if not np.isfinite(value) or value < 0.0 or (positive and value == 0.0):
                raise ValueError(f"{name} = {value}: wanted a {'positive' if positive else 'non-negative'} number")

    @classmethod
    def from_datasheet(
        cls,
        gyro_noise_deg_sqrt_h: float,
        gyro_bias_deg_h: float,
        accel_noise_m_s_sqrt_h: float,
        accel_bias_mgal: float,
        bias_time_s: float = 7200.0,
    ) -> InertialGrade:
        """From the units of data sheets: deg/sqrt(h), deg/h, m/s/sqrt(h), mGal."""
        deg = np.pi / 180.0
        return cls(
            gyro_noise_deg_sqrt_h * deg / 60.0,
            gyro_bias_deg_h * deg / 3600.0,
            accel_noise_m_s_sqrt_h / 60.0,
            accel_bias_mgal * 1e-5,
            bias_time_s,
        )

    @classmethod
    def of_noise(cls, gyro_noise: float, accel_noise: float) -> InertialGrade:
        """Grade of a unit of which only the noise is known (rad/sqrt(s), m/s/sqrt(s); 0 = not even that).

        Biases are those of a tactical unit, or of a MEMS unit, whichever has a noise closer to it.
        """
        like = TACTICAL if 0.0 < gyro_noise < np.sqrt(TACTICAL.gyro_noise * MEMS.gyro_noise) else MEMS
        return replace(like, gyro_noise=gyro_noise or like.gyro_noise, accel_noise=accel_noise or like.accel_noise)


#: Fibre-optic or ring-laser unit of an airborne mapping system; derived from data sheets.
TACTICAL = InertialGrade.from_datasheet(0.003, 0.03, 0.005, 15.0)
#: Good industrial MEMS unit; derived from data sheets.
MEMS = InertialGrade.from_datasheet(0.2, 20.0, 0.05, 2000.0)
