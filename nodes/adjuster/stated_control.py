"""Ground points of the adjuster: coordinates with sigmas, and what a surveyor said of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.window.window import Window
from .. import convert

Array = NDArray[np.floating]

#: Points named in one line at most.
NAMED = 8


class StatedControl:
    """Known ground points by name, and those whose coordinates do not count."""

    def __init__(self) -> None:
        self.bodies: dict[str, Any] = {}
        self._refused: set[str] = set()
        self._came: list[str] = []
        self._changed: list[str] = []
        self._ended: list[str] = []

    def __contains__(self, name: str) -> bool:
        return name in self.bodies

    def forget(self) -> int:
        """Forget all points, whose coordinates are in a local frame that was given up; returns how many there were.

        What a surveyor said of them stays.
        """
        n = len(self.bodies)
        self.bodies.clear()
        return n

    def take(self, body: Any, window: Window | None) -> None:
        """Keep a ground point, and hand it to the window if there is one.

        Raises
        ------
        ValueError : no name, or coordinates or variances that cannot be
        """
        if not body.point:
            raise ValueError("ground point without a name")
        xyz, sigma, role = _coordinates(body)
        if window is not None and window.strips:
            self._note(body, role)
        self.bodies[body.point] = body
        if body.point in self._refused:
            sigma, role = np.full(3, np.inf), "check"
        if window is not None:
            window.add_control(body.point, xyz, sigma, role)

    def _note(self, body: Any, role: str) -> None:
        """Control that comes in flight, or becomes another."""
        old = self.bodies.get(body.point)
        before = "check" if old is None else convert.role_of(old)
        if role == "check":
            if before != "check":
                self._ended.append(body.point)
        elif old is None:
            self._came.append(body.point)
        elif before != role:
            self._changed.append(f"{body.point} from {before} to {role}")
        elif old != body:
            dx, dy, dz = body.x - old.x, body.y - old.y, body.z - old.z
            if dx or dy or dz:
                self._changed.append(f"{body.point} by {dx:.2f}, {dy:.2f}, {dz:.2f} m")
            elif body.covariance != old.covariance:
                (before, _), (after, _) = (_coordinates(b)[1:] for b in (old, body))
                self._changed.append(f"{body.point} in its sigmas, from {_metres(before)} to {_metres(after)} m")

    def take_news(self) -> list[str]:
        """Lines for the operator about control that came or changed in flight since the last call."""
        lines = [
            f"control {what} in flight: {_several(names)}"
            for what, names in (("came", self._came), ("changed", self._changed))
            if names
        ]
        if self._ended:
            left = sum(convert.role_of(body) != "check" for body in self.bodies.values())
            lines.append(
                f"control became check points in flight and counts no more: {_several(self._ended)}; "
                f"{left or 'no'} control point{'' if left == 1 else 's'} left"
            )
        self._came, self._changed, self._ended = [], [], []
        return lines

    def judge(self, verdict: Any, window: Window | None) -> None:
        """A surveyor says whether the coordinates of a point count, now or when they are stated."""
        (self._refused.discard if verdict.accepted else self._refused.add)(verdict.point)
        if verdict.point in self.bodies:
            self.take(self.bodies[verdict.point], window)


def _metres(sigma: Array) -> str:
    """Sigmas of the coordinates that are given."""
    return ", ".join(f"{s:.2f}" for s in sigma[np.isfinite(sigma)])


def _several(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _coordinates(body: Any) -> tuple[Array, Array, str]:
    """Coordinates (3,), sigmas (3,), infinite where a coordinate is not given, and the role."""
    xyz = np.array([body.x, body.y, body.z])
    role = convert.role_of(body)
    covariance = np.array(body.covariance) if body.covariance else np.zeros(9)
    if not np.isfinite(xyz).all() or covariance.shape != (9,) or not np.isfinite(covariance).all():
        raise ValueError(f"ground point {body.point!r} is not finite or its covariance has not 9 values")
    variance = covariance[::4]
    given = {"control": (0, 1, 2), "planimetric": (0, 1), "height": (2,)}.get(role, ())
    sigma = np.full(3, np.inf)
    for axis in given:
        if not variance[axis] > 0:
            raise ValueError(f"ground point {body.point!r}: variance {variance[axis]}, wanted more than 0")
        sigma[axis] = np.sqrt(variance[axis])
    return xyz, sigma, role
