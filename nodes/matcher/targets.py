"""Signalised targets on the wire: ground points and verdicts in, looks and observations out. Part of the matcher."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...solver.camera.line_camera import LineCamera
from ...solver.matching.current_orientation import CurrentOrientation
from ...solver.matching.target_finder import NO_LINES, Target, TargetFinder, TargetLook, TargetOptions
from ...solver.models.slow_errors import SlowErrors
from .. import convert
from ..node import Message
from .strip_clock import StripClock


class DoubtfulTargets:
    """Keeps what surveyors and control say of the targets, and turns measured looks into messages.

    A good look goes out at once as an observation under the point's name. A doubtful one is told and held: a verdict
    that accepts the point lets it out, with those that follow; one that refuses it stops all of its looks.

    Parameters
    ----------
    options : see `TargetOptions`
    """

    def __init__(self, options: TargetOptions | None = None) -> None:
        self.options = options or TargetOptions()
        self._finder: TargetFinder | None = None
        self._slow = SlowErrors()
        self._strip: StripClock | None = None
        self._points: dict[str, Target] = {}
        self._verdict: dict[str, bool] = {}
        self._held: dict[str, list[tuple[StripClock, TargetLook]]] = {}

    @property
    def some(self) -> bool:
        """Whether any point is signalised."""
        return bool(self._points)

    @property
    def strip(self) -> str:
        """The strip that lines belong to, empty before the first one."""
        return "" if self._strip is None else self._strip.strip.id

    def configure(self, camera: LineCamera, orientation: CurrentOrientation) -> None:
        """Begin (again) with a camera; ``orientation`` is kept up to date by the caller."""
        self._finder = TargetFinder(camera, orientation, self.options)
        self._finder.slow = self._slow
        self._strip = None
        self._held.clear()
        for target in self._points.values():
            self._finder.set_target(target)

    def project(self, body: Any) -> None:
        """What a project says of slow errors; without effect where that cannot be, which the adjuster tells."""
        with suppress(ValueError):
            self._slow = convert.slow_errors_of(body)
        if self._finder is not None:
            self._finder.slow = self._slow

    def forget(self) -> None:
        """Forget all targets, whose coordinates are in a local frame that was given up; verdicts on them stay."""
        self._points.clear()

    def ground_point(self, body: Any) -> None:
        """Take a ground point; those that are not signalised, or whose place is not known, do not matter here.

        Raises
        ------
        ValueError : coordinates, covariance or radius that cannot be
        """
        if body.target_radius == 0 or convert.role_of(body) == "height":
            return
        covariance = np.array(body.covariance).reshape(3, 3) if body.covariance else np.zeros((3, 3))
        place = np.array([body.x, body.y, body.z])
        if not (np.isfinite(place).all() and np.isfinite(covariance).all() and 0 < body.target_radius < np.inf):
            raise ValueError(f"target {body.point!r} is not finite or has a radius of {body.target_radius} m")
        target = Target(body.point, place, covariance, body.target_radius)
        self._points[body.point] = target
        if self._finder is not None:
            self._finder.set_target(target)

    def verdict(self, body: Any, stamp_ns: int) -> list[Message]:
        """Take a surveyor's verdict; what was held goes out, or is dropped. Of a point that is not stated yet it counts
        when it is."""
        self._verdict[body.point] = body.accepted
        held = self._held.pop(body.point, [])
        state = "CONFIRMED" if body.accepted else "REJECTED"
        out = [self._told(strip, look, state, f"by {body.by or 'a surveyor'}", stamp_ns) for strip, look in held]
        if body.accepted:
            out += [self._observation(strip, look, stamp_ns) for strip, look in held]
        return out

    def begin_strip(self, strip: StripClock, orientation: CurrentOrientation) -> None:
        """Lines that follow belong to a strip; its times and its orientation are kept up to date by the caller."""
        self._strip = strip
        if self._finder is not None:
            self._finder.orientation = orientation
            self._finder.begin_strip(strip.times)

    def lines(
        self, ccd: str, first_line: int, pixels: Any, stamp_ns: int, usable: Any = None
    ) -> tuple[list[Message], list[str]]:
        """Messages that follow from lines, and what an operator should know; ``usable`` says which lines are."""
        if self._finder is None or self._strip is None:
            return [], []
        self._finder.add_lines(ccd, first_line, pixels, usable)
        out: list[Message] = []
        words = []
        for look in self._finder.measure(ccd):
            verdict = self._verdict.get(look.target)
            if not look.found:
                out.append(self._told(self._strip, look, "NOT_FOUND", look.reason, stamp_ns))
                if look.reason != NO_LINES:  # that lines are missing or black has been told of the lines
                    words.append(f"target {look.target} in {ccd}: {look.reason}")
            elif verdict is False:
                out.append(self._told(self._strip, look, "REJECTED", "by a surveyor", stamp_ns))
            elif look.reason and verdict is None:
                self._held.setdefault(look.target, []).append((self._strip, look))
                out.append(self._told(self._strip, look, "HELD", look.reason, stamp_ns))
                words.append(
                    f"target {look.target} in {ccd} is held: {look.reason} ({np.hypot(*look.off):.2f} m, likeness "
                    f"{look.score:.3f}); triline confirm {look.target}, or --reject"
                )
            else:
                state = "CONFIRMED" if look.reason else "MEASURED"
                out += [
                    self._told(self._strip, look, state, look.reason, stamp_ns),
                    self._observation(self._strip, look, stamp_ns),
                ]
        return out, words

    def take_counters(self) -> dict[str, int]:
        """Looks by what became of them, since the last call."""
        if self._finder is None:
            return {}
        counted = dict(self._finder.counters)
        self._finder.counters.clear()
        return counted

    # -- messages ------------------------------------------------------------------------------------------------------

    def _told(self, strip: StripClock, look: TargetLook, state: str, reason: str, stamp_ns: int) -> Message:
        body = m.TargetLook(
            point=look.target, image=m.ImagePoint(**_image(strip, look)), state=m.TargetLook.State.Value(state),
            reason=reason, score=look.score, expected_line=look.expected_line, expected_sample=look.expected_sample,
            reach=look.reach_px, off=look.off, chi2=look.chi2,
        )  # fmt: skip
        return Message("observation/target", stamp_ns, body)

    @staticmethod
    def _observation(strip: StripClock, look: TargetLook, stamp_ns: int) -> Message:
        return Message("observation/tie", stamp_ns, convert.tie_message(look.target, [_image(strip, look)]))


def _image(strip: StripClock, look: TargetLook) -> dict[str, Any]:
    return {
        "strip": strip.strip.id,
        "ccd": look.ccd,
        "line": look.line,
        "sample": look.sample,
        "sigma_line": look.sigma_line,
        "sigma_sample": look.sigma_sample,
        "time_ns": strip.time_ns(look.line),
    }
