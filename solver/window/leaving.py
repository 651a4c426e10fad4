"""What is older than the window becomes final: batches are fixed, unknowns marginalised, results published."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..measured_trajectory import MeasuredTrajectory
from ..models.base import Design
from .backward import LeftPoints, Step
from .batches import Batches
from .block import Block
from .control import ControlDesk
from .intake import Intake
from .integrity import Exposure
from .output import Orienter, adjusted_points
from .results import RefinedOrientation, WindowOptions, WindowUpdate
from .single_looks import SingleLooks
from .snooping import snoop
from .state import WindowState
from .strip import WindowStrip
from .tie_snooping import snoop_ties
from .watch import Watch, middle

Array = NDArray[np.floating]
IntArray = NDArray[np.int64]

#: Rays of a strip that is over which leave in one update, about; the others follow in the next ones.
MOST_LEAVING = 1000
#: What is older than the window leaves within about so long, s, but so many rays in each update at least: points that
#: are completed together were seen first at different times, so that at the border of a segment many batches are old
#: at once.
LEAVING_S, LEAST_LEAVING = 1.0, 100
#: Steps kept for the backward pass of a strip too long for a block; of one that never ends the earliest part is not
#: refined again.
MOST_STEPS = 600
#: A strip waits so long beyond its time, s, for smoothed poses of its end where there are smoothed ones: longer than a
#: smoother lags behind. Filtered ones differ by more than any wander explains while a filter learns, and where they
#: follow smoothed ones is a step that no correction can take.
SMOOTHED_LATE_S = 12.0


class Leaver:
    """Lets go.

    Parameters
    ----------
    single : takes care of looks without a partner
    control : weighs control
    apart : told the points that do not agree with earlier strips, and the result
    """

    def __init__(
        self,
        options: WindowOptions,
        state: WindowState,
        strips: dict[str, WindowStrip],
        batches: Batches,
        intake: Intake,
        trajectory: MeasuredTrajectory,
        block: Block,
        watch: Watch,
        orienter: Orienter,
        control: ControlDesk,
        apart: Callable[[list[str], WindowUpdate], None],
        single: SingleLooks,
    ) -> None:
        self.options, self._state, self._strips, self._batches = options, state, strips, batches
        self._intake, self._trajectory, self._block = intake, trajectory, block
        self._watch, self._orienter, self._control, self._apart, self._single = (
            watch, orienter, control, apart, single,
        )  # fmt: skip
        self._steps: list[Step] = []
        self._left: list[LeftPoints] = []
        self._let_go_s = -np.inf

    def let_go(
        self, now_s: float, limit_s: float, length_s: float, serial: int, result: WindowUpdate, at_the_end: bool = False
    ) -> None:
        """Batches and unknowns older than the limit, and those of strips that are over, become final."""
        limits = {}
        bearable_s = self._bearable_s(limit_s, now_s - self._let_go_s)
        self._let_go_s = now_s
        for strip in self._strips.values():
            settled_s = self._settled_to(strip) if self._is_settled(strip, now_s) else -np.inf
            limits[strip.id] = max(settled_s, bearable_s)
        by_index = [limits[id] for id in self._strips]
        latest = max(by_index, default=-np.inf)
        old = [b for b in self._batches if b.oldest_s <= latest]
        leaving = [b for b in old if b.oldest_s <= max(by_index[i] for i in b.strips)]
        if self.options.snoop and leaving:
            refused, rounds = snoop(
                leaving, self._state, self._intake.points, self.options.critical, serial,
                partial(self._control.look, now_s), lambda names: self._apart(names, result),
            )  # fmt: skip
            result.refused += refused
            failed = snoop_ties([b for b in leaving if b.ties is not None], self._state)
            self._apart(failed, result)
            if failed:
                self._state.solve()
            if rounds or failed:
                self._orienter.forget()
        gone = [(strip, *strip.leaving(limits[strip.id], self._state)) for strip in self._strips.values()]
        result.refused += self._single.leave(now_s, limits, at_once=any(len(numbers) for _, numbers, _ in gone))
        cells = self._watch.cells(leaving)
        for batch in leaving:
            drift = self._watch.on_points(batch, self._orienter.drift)
            points = adjusted_points(batch, self._state, self._intake.points, self._intake.control, True, drift)
            result.points += points
            result.refused += self._intake.without_place(batch, {p.name for p in points})
            self._left.append(LeftPoints.of(batch, points))
            result.refused += self._block.leave(batch, points, cells.get(id(batch)))
        self._watch.leaving(leaving, limit_s - length_s)
        for batch in leaving:
            self._batches.leave(batch)
            self._intake.finish(batch)
        for strip, numbers, to_s in gone:
            if not len(numbers):
                continue
            final = self._final(strip, to_s)
            design = noise = None
            if final is not None:
                result.final.append(final)
                design, noise = strip.design(final.time_s), self._orienter.noise(strip, final.time_s)
                self._block.orientation(strip, final, design, noise)
            strip.final_to_s = to_s
            self._step(numbers, final, design, noise)
            if strip.ended and strip.is_gone(self._state):
                self._block.gone(strip)
                strip.release()
        over = min(limits.values(), default=limit_s)
        modes = self._block.earlier.leaving(max(over, limit_s), (b.columns for b in self._batches))
        if len(modes):
            self._step(modes)
        result.whole = self._block.refined(now_s, self._steps, at_the_end)
        if self._block.quiet:
            result.events += self._block.take_events()
        del self._steps[: max(len(self._steps) - MOST_STEPS, 0)]
        self._forget(limit_s, length_s)

    def _is_settled(self, strip: WindowStrip, now_s: float) -> bool:
        """Whether a strip is over and nothing is waited for: late tie points, and smoothed poses under its rays."""
        late_s = now_s - strip.end_s - self.options.settle_s
        if not strip.ended or late_s < 0.0:
            return False
        smoothed_s = self._trajectory.smoothed_to_s
        if np.isinf(smoothed_s) or late_s >= SMOOTHED_LATE_S:
            return True
        index = list(self._strips).index(strip.id)
        return smoothed_s >= strip.end_s and not any(b.provisional and index in b.strips for b in self._batches)

    def _bearable_s(self, limit_s: float, passed_s: float) -> float:
        """The limit, or an earlier one where more is older than may leave in an update so long after the one before."""
        if not np.isfinite(limit_s) or passed_s >= LEAVING_S:
            return limit_s
        old = sorted((b for b in self._batches if b.oldest_s <= limit_s), key=lambda b: b.oldest_s)
        most = max(LEAST_LEAVING, sum(len(b.rays) for b in old) * passed_s / LEAVING_S)
        rays = 0
        for batch in old:
            rays += len(batch.rays)
            if rays >= most:
                return batch.oldest_s
        return limit_s

    def _settled_to(self, strip: WindowStrip) -> float:
        """Up to when a strip that is over may leave now: all of it, or as much as one update can bear."""
        index = list(self._strips).index(strip.id)
        rays = 0
        for batch in sorted((b for b in self._batches if index in b.strips), key=lambda b: b.oldest_s):
            rays += len(batch.rays)
            if rays > MOST_LEAVING:
                return batch.oldest_s
        return np.inf

    def _step(
        self,
        numbers: IntArray,
        final: RefinedOrientation | None = None,
        design: Design | None = None,
        noise: Array | None = None,
    ) -> None:
        """Marginalise unknowns, and keep what leads back to them."""
        marginal = self._state.marginalise(numbers)
        self._watch.marginalised(marginal)
        self._steps.append(Step(marginal, final, design, noise, self._left))
        self._left = []
        self._orienter.forget()

    def _final(self, strip: WindowStrip, to_s: float) -> RefinedOrientation | None:
        """Orientation at the grid times that become final now."""
        end = self._trajectory.end_s
        if not np.isfinite(end):
            return None
        times = grid(self.options.grid_hz, strip.final_to_s, min(to_s, strip.end_s, end + 1e-3))
        times = times[self._trajectory.covers(times)] if len(times) else times
        if not len(times):
            return None
        final = self._orienter.at(strip, times)
        return _protected(final, self._watch.became_final(strip, final))

    def protected(self, strip: WindowStrip, orientation: RefinedOrientation) -> RefinedOrientation:
        """With protection levels as the middle of the times is exposed."""
        return _protected(orientation, self._watch.exposure_at(strip, middle(orientation)))

    def _forget(self, limit_s: float, length_s: float) -> None:
        """Drop what nothing can need any more: names of points long final, old poses."""
        if not np.isfinite(limit_s) and limit_s < 0:
            return
        self._intake.forget(limit_s - length_s)
        used = min((b.oldest_s for b in self._batches), default=np.inf)
        waiting = self._intake.oldest_waiting_s
        finals = min((s.final_to_s for s in self._strips.values() if not s.is_gone(self._state)), default=np.inf)
        self._trajectory.forget(min(limit_s - length_s, used, waiting, finals) - 1.0)


def _protected(orientation: RefinedOrientation, exposure: Exposure | None) -> RefinedOrientation:
    if exposure is None:
        return orientation
    sigma = np.sqrt(np.einsum("nii->ni", orientation.covariance))
    return replace(orientation, protection=exposure.protection(sigma))


def grid(hz: float, from_s: float, to_s: float) -> Array:
    """Times of the published orientation in [from, to)."""
    return np.arange(np.ceil(from_s * hz - 1e-6), np.ceil(to_s * hz - 1e-6)) / hz
