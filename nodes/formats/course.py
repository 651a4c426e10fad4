"""Whether attitudes go with the flight that positions say: heading with the course, roll with the turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.earth import SEMI_MAJOR_M

Array = NDArray[np.floating]

#: Steps over which the course is taken, s; those behind a gap do not count.
_STEP_S, _GAP_S = 1.0, 5.0
#: Aircraft that are slower may fly sideways, m/s.
SLOW_M_S = 10.0
#: No crab angle is larger, degrees.
MOST_CRAB_DEG = 35.0
#: Turns are flown with a bank of at least and at most so much, degrees.
_BANKS_DEG = (8.0, 60.0)
#: The median of roll or pitch of a flight is not larger, degrees.
_MOST_TILT_DEG = 45.0
#: So many steps have to say something.
_FEWEST = 10
#: Other conventions -> the heading by them, of the one that stands in the file.
_CONVENTIONS = {
    "counted counter-clockwise": lambda heading: -heading,
    "of the opposite direction": lambda heading: heading + np.pi,
    "counted from east, counter-clockwise": lambda heading: np.pi / 2 - heading,
    "counted from east, clockwise": lambda heading: np.pi / 2 + heading,
    "counted from west, clockwise": lambda heading: heading - np.pi / 2,
}


def attitude_remarks(time_s: Array, geodetic: Array, rpy: Array) -> list[str]:
    """Remarks about attitudes of another convention than that of `solver`; none where nothing tells.

    Parameters
    ----------
    time_s : (n,), rising
    geodetic : (n, 2) latitude and longitude in degrees, or more columns
    rpy : (n, 3) roll, pitch, heading, radians
    """
    if len(time_s) < 3:
        return []
    step = max(round(_STEP_S / max(float(np.median(np.diff(time_s))), 1e-6)), 1)
    apart_s = np.diff(time_s[::step])
    lat, lon = np.radians(geodetic[::step, :2].T)
    north = np.diff(lat) * SEMI_MAJOR_M
    east = _wrapped(np.diff(lon)) * SEMI_MAJOR_M * np.cos(lat[:-1])
    speed = np.hypot(north, east) / apart_s
    counts = (speed > SLOW_M_S) & (apart_s < _GAP_S)
    course, heading, roll = np.arctan2(east, north), rpy[::step, 2][:-1], rpy[::step, 0]
    tilt_deg = np.degrees(np.median(np.abs(rpy[:, :2]), axis=0))
    remarks = []
    if tilt_deg.max() > _MOST_TILT_DEG:
        what = " and ".join(f"{angle:.0f}" for angle in tilt_deg)
        remarks.append(f"roll and pitch are {what} deg off level (median): are the axes forward, right and down?")
    if counts.sum() >= _FEWEST:
        remarks += _of_heading(heading[counts], course[counts])
    both = counts[:-1] & counts[1:]
    if both.any():
        rate = _wrapped(np.diff(course))[both] / (0.5 * (apart_s[:-1] + apart_s[1:]))[both]
        remarks += _of_roll(roll[1:-1][both], np.arctan(speed[1:][both] * rate / 9.81))
    return remarks


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _of_heading(heading: Array, course: Array) -> list[str]:
    def share(said: Array) -> float:
        return float(np.mean(np.abs(_wrapped(said - course)) < np.radians(MOST_CRAB_DEG)))

    if share(heading) > 0.2:
        return []
    off_deg = np.degrees(np.median(np.abs(_wrapped(heading - course))))
    fit = [name for name, by in _CONVENTIONS.items() if share(by(heading)) > 0.8]
    maybe = f" (are they {' or '.join(fit)}?)" if fit else ""
    return [f"headings are {off_deg:.0f} deg off the course (median), wanted from north, clockwise{maybe}"]


def _of_roll(roll: Array, bank: Array) -> list[str]:
    """``bank`` (n,) is the roll that holds an aircraft in the turns which it flies."""
    least, most = np.radians(_BANKS_DEG)
    turns = (np.abs(bank) > least) & (np.abs(bank) < most)
    if turns.sum() < _FEWEST or roll[turns] @ bank[turns] > -0.5 * (bank[turns] @ bank[turns]):
        return []
    return ["the flight turns left where the roll is to the right: wanted positive with the right wing down"]
