"""Constant errors of the platform: what is mounted or clocked otherwise than stated, the same in all strips.

Image lines and poses are stamped by clocks that differ by a constant ``clock``: what is stamped t was so at
``t - clock``. The camera was then at time t where the stamps say it is at ``t + clock``, so that the correction of the
measured orientation is its rate times ``clock``: velocity for the position, attitude rate for the attitude. Along a
straight strip at a constant speed it is an offset along the flight; it shows by what the attitude does in turbulence,
and between strips of opposite headings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry.trajectory import Poses
from .base import Design, PseudoObservations, direct_observations

Array = NDArray[np.floating]

#: A clock that is off by more is no error of a clock, s: the first order of its effect does not go so far.
MOST_CLOCK_S = 0.5
#: The attitude rate is a mean over so long before and after, s: with samples of 100 Hz and 2 mdeg the noise of the mean
#: is a tenth of the rates of calm air, and what it smooths away is slower than 2 Hz by a hundredth. Tuned.
RATE_OVER_S = 0.05


class Measured(Protocol):
    """A measured trajectory."""

    def covers(self, time_s: Array) -> NDArray[np.bool_]:
        """Which times (m,) have an orientation."""
        ...

    def angles_at(self, time_s: Array) -> Array:
        """Omega, phi, kappa (m, 3) at times (m,) that have one."""
        ...


@dataclass(frozen=True)
class PlatformErrors:
    """Which constant errors of the platform are unknowns, and what is known of them beforehand.

    Attributes
    ----------
    clock_sigma_s : of the clock; 0 = it is right

    Raises
    ------
    ValueError : a sigma that is negative or not finite
    """

    clock_sigma_s: float = 0.0

    UNITS: ClassVar[dict[str, str]] = {"clock": "s"}

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ValueError(f"{name}: wanted a sigma not below 0, got {value}")

    @property
    def unknown_names(self) -> tuple[str, ...]:
        """(m,) of the unknowns."""
        return ("clock",) if self.clock_sigma_s else ()

    @staticmethod
    def words(name: str, value: float, sigma: float) -> str:
        """What an error comes to, for the operator."""
        late = "later" if value > 0 else "earlier"
        return f"{name}: poses are stamped {1e3 * abs(value):.2f} +- {1e3 * sigma:.2f} ms {late} than image lines"

    @property
    def sigma(self) -> Array:
        """(m,) a priori."""
        return np.array([self.clock_sigma_s] if self.clock_sigma_s else [])

    @property
    def n_unknowns(self) -> int:
        return len(self.sigma)

    def pseudo_observations(self) -> PseudoObservations:
        """Each unknown observed as zero with its sigma."""
        return direct_observations(self.sigma, self.unknown_names)

    def design(self, poses: Poses, measured: Measured, heading: bool) -> Design:
        """Corrections of orientations (n,) by the unknowns, columns counted from 0.

        The attitude rate is a mean over `RATE_OVER_S` before and after: that at one time is mostly noise of the samples
        beside it, which would make the clock too small.

        Parameters
        ----------
        poses : n measured poses
        measured : the trajectory they are of
        heading : kappa's correction is one of heading, see `adjustment.layout.Layout`
        """
        n, t = len(poses.time_s), poses.time_s
        ends = np.concatenate([t - RATE_OVER_S, t + RATE_OVER_S])
        ends = np.where(measured.covers(ends), ends, np.tile(t, 2))
        (before, after), ends = measured.angles_at(ends).reshape(2, n, 3), ends.reshape(2, n)
        turned_by = (after - before + np.pi) % (2 * np.pi) - np.pi
        rate = turned_by / np.maximum(ends[1] - ends[0], RATE_OVER_S)[:, None]
        columns = np.full((n, 6 * self.n_unknowns, 6), -1, dtype=np.int32)
        columns[:, np.arange(6), np.arange(6)] = 0
        if heading:  # kappa's correction turns the tilt; omega and phi take that back
            omega, phi, _ = poses.angles.T
            turned = np.column_stack([phi, -omega, np.zeros(n)])
            rate = rate + turned * rate[:, 2:]
        return Design(columns, np.hstack([poses.velocity_l, rate]))


#: A platform that is as stated.
NO_PLATFORM_ERRORS = PlatformErrors()
#: What is usually known of a platform: clocks agree to some tenths of a millisecond if nothing is wrong with them.
#: Where they do not, the sigma is stated anew by the window (`window.screening.sigma_check`). Tuned.
USUAL_PLATFORM = PlatformErrors(clock_sigma_s=1e-3)
