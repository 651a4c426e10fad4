"""Constant errors of the platform: what is mounted or clocked otherwise than stated, the same in all strips.

Image lines and poses are stamped by clocks that differ by a constant ``clock``: what is stamped t was so at
``t - clock``. The camera was then at time t where the stamps say it is at ``t + clock``, so that the correction of the
measured orientation is its rate times ``clock``: velocity for the position, attitude rate for the attitude. Along a
straight strip at a constant speed it is an offset along the flight; it shows by what the attitude does in turbulence,
and between strips of opposite headings.

The ``lever`` arm from the perspective centre to what the GNSS measures is known as well as it was surveyed. Its error
is constant along the camera's axes x, y, z, so the correction of the position is ``R_lc lever``: an offset in one
strip, which turns with the heading between strips.
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
#: A lever arm that is less well known is not known at all, m.
MOST_LEVER_ARM_M = 100.0
#: The attitude rate is a mean over so long before and after, s: with samples of 100 Hz and 2 mdeg the noise of the mean
#: is a tenth of the rates of calm air, and what it smooths away is slower than 2 Hz by a hundredth. Tuned.
RATE_OVER_S = 0.05


#: Unknowns of the lever arm, along the axes of the camera.
LEVER = ("lever x", "lever y", "lever z")


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
    lever_arm_sigma_m : of each component of the lever arm; 0 = it is right

    Raises
    ------
    ValueError : a sigma that is negative or not finite
    """

    clock_sigma_s: float = 0.0
    lever_arm_sigma_m: float = 0.0

    UNITS: ClassVar[dict[str, str]] = {"clock": "s"} | dict.fromkeys(LEVER, "m")

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ValueError(f"{name}: wanted a sigma not below 0, got {value}")

    @property
    def unknown_names(self) -> tuple[str, ...]:
        """(m,) of the unknowns."""
        return ("clock",) * bool(self.clock_sigma_s) + LEVER * bool(self.lever_arm_sigma_m)

    @staticmethod
    def words(name: str, value: float, sigma: float) -> str:
        """What an error comes to, for the operator."""
        if name in LEVER:
            axis = name.removeprefix("lever ")
            return (
                f"lever arm: the camera is {value:+.3f} +- {sigma:.3f} m along its {axis} axis from where it is stated"
            )
        late = "later" if value > 0 else "earlier"
        return f"{name}: poses are stamped {1e3 * abs(value):.2f} +- {1e3 * sigma:.2f} ms {late} than image lines"

    @property
    def sigma(self) -> Array:
        """(m,) a priori."""
        clock, lever = [self.clock_sigma_s], [self.lever_arm_sigma_m] * 3
        return np.array(clock * bool(self.clock_sigma_s) + lever * bool(self.lever_arm_sigma_m))

    @property
    def questioned(self) -> NDArray[np.bool_]:
        """(m,) whose sigma may be stated larger: not the lever arm's, since what is more in one strip is an offset."""
        return np.array([name not in LEVER for name in self.unknown_names], dtype=bool)

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
        n, place = len(poses.time_s), 0
        columns: list[NDArray[np.int32]] = [np.empty((n, 0, 6), dtype=np.int32)]
        coefficients: list[Array] = [np.empty((n, 0))]
        if self.clock_sigma_s:
            moved = np.full((n, 6, 6), -1, dtype=np.int32)
            moved[:, np.arange(6), np.arange(6)] = 0
            columns.append(moved)
            coefficients.append(np.hstack([poses.velocity_l, _rate(poses, measured, heading)]))
            place = 1
        if self.lever_arm_sigma_m:
            # the terms of one unknown follow one another: term 3 a + c is that of axis a and component c
            along = np.full((n, 9, 6), -1, dtype=np.int32)
            along[:, np.arange(9), np.tile(np.arange(3), 3)] = place + np.repeat(np.arange(3), 3)
            columns.append(along)
            coefficients.append(np.swapaxes(poses.R_lc, 1, 2).reshape(n, 9))
        return Design(np.concatenate(columns, axis=1), np.concatenate(coefficients, axis=1))


def _rate(poses: Poses, measured: Measured, heading: bool) -> Array:
    """Attitude rate (n, 3) as corrections of the angles count it."""
    n, t = len(poses.time_s), poses.time_s
    ends = np.concatenate([t - RATE_OVER_S, t + RATE_OVER_S])
    ends = np.where(measured.covers(ends), ends, np.tile(t, 2))
    (before, after), ends = measured.angles_at(ends).reshape(2, n, 3), ends.reshape(2, n)
    turned_by = (after - before + np.pi) % (2 * np.pi) - np.pi
    rate = turned_by / np.maximum(ends[1] - ends[0], RATE_OVER_S)[:, None]
    if heading:  # kappa's correction turns the tilt; omega and phi take that back
        omega, phi, _ = poses.angles.T
        turned = np.column_stack([phi, -omega, np.zeros(n)])
        rate = rate + turned * rate[:, 2:]
    return rate


#: A platform that is as stated.
NO_PLATFORM_ERRORS = PlatformErrors()
#: What is usually known of a platform: clocks agree to some tenths of a millisecond if nothing is wrong with them.
#: Where they do not, the sigma is stated anew by the window (`window.screening.sigma_check`). Tuned. A lever arm is
#: taken as it was surveyed: its unknowns would make the position of every flight that much less certain.
USUAL_PLATFORM = PlatformErrors(clock_sigma_s=1e-3)
