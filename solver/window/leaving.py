"""What is older than the window becomes final: batches are fixed, unknowns marginalised, results published."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..arrays import Array, IntArray
from ..geometry.measured_trajectory import SMOOTHED_LATE_S
from .block.backward import LeftOrientation, LeftPoints, Step
from .block.block import Block
from .datum.control import ControlTests
from .datum.drift_monitor import DriftMonitor
from .output import OrientationOutput
from .quality.quality_control import QualityControl
from .results import RefinedOrientation, Refusal, Update, WindowOptions
from .screening.first_ground import has_one_view
from .screening.snooping import snoop
from .screening.ties import snoop_ties
from .state.batch import Batch
from .state.lens_sets import stays_to
from .state.maker import BatchMaker
from .state.network import LiveNetwork
from .state.strip import WindowStrip

#: Rays of a strip that is over which leave in one update, about; the others follow in the next ones.
MOST_LEAVING = 1000
#: What is older than the window leaves within about so long, s, but so many rays in each update at least: points that
#: are completed together were seen first at different times, so that at the border of a segment many batches are old
#: at once.
LEAVING_S, LEAST_LEAVING = 1.0, 100
#: So long after the end of a strip of a camera with one view, s, its first looks are waited for, and so much of the
#: strip, s, stays for them. Tuned: the first is time for a program that matches whole strips, the second bounds the
#: work of an update.
AWAITED_S, MOST_AWAITED_S = 30.0, 180.0
#: Steps kept for the backward pass of a strip too long for a block; of one that never ends the earliest part is not
#: refined again.
MOST_STEPS = 600


class Leaving:
    """Makes final what is older than the window, and hands it to the block."""

    def __init__(
        self,
        options: WindowOptions,
        network: LiveNetwork,
        block: Block,
        control: ControlTests,
        quality: QualityControl,
        orientation: OrientationOutput,
    ) -> None:
        self.options, self._network, self._block = options, network, block
        self._control, self._quality, self._orientation = control, quality, orientation
        self._single = SingleLooks(network, block, control.sources)
        self._steps: list[Step] = []
        self._left: list[LeftPoints] = []
        self._let_go_s = -np.inf

    def let_go(self, update: Update, limit_s: float, length_s: float, at_the_end: bool = False) -> None:
        """Batches and unknowns older than the limit, and those of strips that are over, become final."""
        network, now_s = self._network, update.now_s
        limits = self._limits(now_s, limit_s)
        leaving = self._older_than(list(limits.values()))
        if self.options.snoop and leaving:
            self._last_test(leaving, update)
        gone = [(strip, *strip.leaving(limits[strip.id], network.state)) for strip in network.strips.values()]
        update.refused += self._single.leave(now_s, limits, at_once=any(len(numbers) for _, numbers, _ in gone))
        self._release_points(leaving, limit_s - length_s, update)
        for strip, numbers, to_s in gone:
            if len(numbers):
                self._release_orientation(strip, numbers, to_s, update)
        over = min(limits.values(), default=limit_s)
        modes = self._block.earlier.leaving(max(over, limit_s), (b.columns for b in network.batches))
        if len(modes):
            self._marginalise(modes)
        update.whole = self._block.refined(now_s, self._steps, at_the_end)
        if self._block.quiet:
            update.events += self._block.take_events()
        update.refused += network.intake.take_refused()
        del self._steps[: max(len(self._steps) - MOST_STEPS, 0)]
        self._forget(limit_s, length_s)

    def _limits(self, now_s: float, limit_s: float) -> dict[str, float]:
        """By strip, the time before which all leaves."""
        bearable_s = self._bearable_s(limit_s, now_s - self._let_go_s)
        self._let_go_s = now_s
        limits = {}
        for strip in self._network.strips.values():
            if limit_s < np.inf and self._is_awaited(strip, now_s):  # else it is the end of the flight
                limits[strip.id] = min(limit_s, now_s - MOST_AWAITED_S)
                continue
            settled_s = -np.inf
            if self._is_settled(strip, now_s):
                settled_s = _until(self._network.of_strip(strip), MOST_LEAVING + 1, np.inf)
            limits[strip.id] = max(settled_s, bearable_s)
        return limits

    def _older_than(self, limits: list[float]) -> list[Batch]:
        """Batches with rays older than the limit of one of their strips."""
        latest = max(limits, default=-np.inf)
        old = self._network.batches.older_than(latest)
        return [b for b in old if b.oldest_s <= max(limits[i] for i in b.strips)]

    def _last_test(self, leaving: list[Batch], update: Update) -> None:
        rounds = snoop(leaving, self._network, self._control, self._block, update)
        failed = snoop_ties(leaving, self._network, update)
        update.tell_alone()
        if failed:
            self._network.state.solve()
        if rounds or failed:
            self._orientation.forget()

    def _release_points(self, leaving: list[Batch], forget_s: float, update: Update) -> None:
        """Publish the points of batches, and fix what these know."""
        network, sources = self._network, self._control.sources
        cells = sources.cells(leaving)
        for batch in leaving:
            points = self._orientation.points_of(batch, final=True)
            update.points += points
            update.refused += network.intake.without_place(batch, {p.name for p in points})
            left = LeftPoints.of(batch, points)
            self._left.append(left)
            self._single.passes(batch)
            self._block.leave(batch, left, cells.get(id(batch)), update)
        self._quality.integrity.leave(leaving, forget_s)
        self._control.leaving(leaving, sources.leave(leaving))
        network.tails.leaving(leaving)
        for batch in leaving:
            network.batches.leave(batch)
            network.intake.finish(batch)

    def _release_orientation(self, strip: WindowStrip, numbers: IntArray, to_s: float, update: Update) -> None:
        """Publish the orientation of a strip up to a time, and marginalise unknowns that no later time needs."""
        network, final = self._network, self._final(strip, to_s)
        left = None
        if final is not None:
            update.final.append(final)
            noise = self._orientation.noise(strip, final.time_s)
            vibration, design = network.vibrations.since(final.time_s), strip.design(final.time_s)
            left = LeftOrientation(final, design, noise, vibration, doubtful=network.sigmas.image > 1.0)
            self._block.orientation(strip, left)
        strip.final_to_s = to_s
        self._marginalise(numbers, left)
        if strip.ended and strip.is_gone(network.state):
            for step in self._steps:  # those of a strip that is no part of a block
                if step.orientation is not None and step.orientation.published.strip == strip.id:
                    step.orientation.over(network.vibrations)
            self._block.gone(strip)
            strip.release()

    def _is_settled(self, strip: WindowStrip, now_s: float) -> bool:
        """Whether a strip is over and nothing is waited for: late tie points, and smoothed poses under its rays."""
        late_s = now_s - strip.end_s - self.options.settle_s
        if not strip.ended or late_s < 0.0:
            return False
        network = self._network
        if now_s < stays_to(strip, network.strips.values(), network.camera, now_s) + self.options.settle_s:
            return False
        smoothed_s = self._network.trajectory.smoothed_to_s
        if np.isinf(smoothed_s) or late_s >= SMOOTHED_LATE_S:
            return True
        return smoothed_s >= strip.end_s and not any(b.provisional for b in self._network.of_strip(strip))

    def _is_awaited(self, strip: WindowStrip, now_s: float) -> bool:
        """Whether a strip of a camera with one view has no look yet, but may have some when it is over: a matcher finds
        its points in other strips, so they come together."""
        network = self._network
        if strip.id in network.intake.looked or not has_one_view(network.camera, network.strips):
            return False
        return not strip.ended or now_s < strip.end_s + AWAITED_S

    def _bearable_s(self, limit_s: float, passed_s: float) -> float:
        """The limit, or an earlier one where more is older than may leave in an update so long after the one before."""
        if not np.isfinite(limit_s) or passed_s >= LEAVING_S:
            return limit_s
        old = self._network.batches.older_than(limit_s)
        return _until(old, max(LEAST_LEAVING, sum([len(b.rays) for b in old]) * passed_s / LEAVING_S), limit_s)

    def _marginalise(self, numbers: IntArray, final: LeftOrientation | None = None) -> None:
        """Marginalise unknowns, with all that stands beside them, and keep what leads back to them."""
        marginal = self._network.state.marginalise(numbers)
        self._quality.integrity.marginalised(marginal)
        self._control.marginalised(self._control.sources.marginalised(marginal))
        self._steps.append(Step(marginal, final, self._left))
        self._left = []
        self._orientation.forget()

    def _final(self, strip: WindowStrip, to_s: float) -> RefinedOrientation | None:
        """Orientation at the grid times that become final now."""
        end = self._network.trajectory.end_s
        if not np.isfinite(end):
            return None
        times = self.options.grid(strip.final_to_s, min(to_s, strip.end_s, end + 1e-3))
        times = times[self._network.trajectory.covers(times)] if len(times) else times
        if not len(times):
            return None
        return self._quality.protected(strip, self._orientation.at(strip, times), final=True)

    def _forget(self, limit_s: float, length_s: float) -> None:
        """Drop what nothing can need any more: names of points long final, old poses."""
        if not np.isfinite(limit_s) and limit_s < 0:
            return
        self._network.intake.forget(limit_s - length_s)
        used = self._network.batches.oldest_s
        waiting = self._network.intake.oldest_waiting_s
        finals = min(
            (s.final_to_s for s in self._network.strips.values() if not s.is_gone(self._network.state)), default=np.inf
        )
        self._network.trajectory.forget(min(limit_s - length_s, used, waiting, finals) - 1.0)


#: Time between two looks for looks that wait in vain, s, unless unknowns leave.
GIVE_UP_EVERY_S = 1.0
#: Looks that are kept together.
KEPT_TOGETHER = 12
#: Batches whose points say about how far away the ground is.
GROUND_BATCHES = 32
#: How far below the camera, m, looks are linearised as long as nobody knows how far away the ground is: anything in
#: front of the camera, as they are linearised anew when it is known.
NOBODY_KNOWS_M = 1000.0


class SingleLooks:
    """Gives up waiting for partners of looks, and keeps what can be kept for the block.

    Such looks say nothing of their strip, but a later strip may see their point again. Before the unknowns of their
    time leave the window they are linearised. A camera with one view places no point in its first strip: its looks are
    kept, and placed when a later strip has shown where the ground is (`first_ground`).
    """

    def __init__(self, network: LiveNetwork, block: Block, sources: DriftMonitor) -> None:
        self._network, self._block, self._sources = network, block, sources
        self._maker = BatchMaker(network)
        self._looked_s = -np.inf
        self._ground_l = np.empty((0, 3))  # the newest points that have left the window

    def passes(self, batch: Batch) -> None:
        """A batch leaves: its points say where the ground is until nearer ones are known."""
        placed = batch.points_l[batch.normals.rank == 3]
        if len(placed):
            self._ground_l = placed

    def leave(self, now_s: float, limits_s: Mapping[str, float], at_once: bool) -> list[Refusal]:
        """Looks older than the limits of their strips leave, now and then; told as refused: their strip has no use for
        them.

        Parameters
        ----------
        limits_s : by strip
        at_once : unknowns are about to leave
        """
        if not at_once and now_s < self._looked_s + GIVE_UP_EVERY_S:
            return []
        self._looked_s = now_s
        names = self._network.intake.without_partner(limits_s)
        by_strip: dict[str, list[str]] = {}
        for name in names:
            point = self._network.intake.points[name]
            if len(point.looks) == 1 and not point.alone and self._network.trajectory.covers(point.time_s)[0]:
                by_strip.setdefault(point.looks[0].strip, []).append(name)
        for id, single in by_strip.items():
            for begin in range(0, len(single), KEPT_TOGETHER):
                self._keep(self._network.strips[id], single[begin : begin + KEPT_TOGETHER])
        return self._network.intake.give_up(names)

    def _keep(self, strip: WindowStrip, names: list[str]) -> None:
        """Keep looks of a strip, if its unknowns are there and it is known about where the ground is: by points of the
        strip in the window, else by those that left it last."""
        ground = self._network.of_strip(strip)
        points = [self._network.intake.points[name] for name in names]
        times = [p.time_s[0] for p in points]
        gone = strip.is_gone(self._network.state)
        if gone or (self._network.state.places(strip.design(times).unknowns()) < 0).any():
            return
        ground.sort(key=lambda b: abs(b.oldest_s - times[0]))
        placed = [b.points_l[b.normals.rank == 3] for b in ground[:GROUND_BATCHES]]
        near = np.concatenate(placed) if any(map(len, placed)) else self._ground_l
        near = near if len(near) else self._on_surface(times)
        unplaced = not len(near)
        if unplaced:
            if not has_one_view(self._network.camera, self._network.strips):
                return  # the strip itself will place points
            near = self._network.trajectory.at(np.array(times)).poses.position_l - [0.0, 0.0, NOBODY_KNOWS_M]
        elif self._block.groundless:
            self._block.ground_found(float(np.median(near[:, 2])))
        batch = self._maker.make_single(names, points, near)
        if batch is not None:
            looks = [p.looks[0] for p in points]
            self._block.keep_single(batch, looks, self._sources.cell_of_single(batch), unplaced)

    def _on_surface(self, times: list[float]) -> Array:
        """Places (m, 3) of the surface that points lie on below the camera at some times; none where it has none."""
        surface = self._network.surface.control
        if surface is None:
            return np.empty((0, 3))
        xy = self._network.trajectory.at(np.array(times)).poses.position_l[:, :2]
        places = np.column_stack([xy, surface.height(*xy.T)])
        return places[np.isfinite(places[:, 2])]


def _until(batches: Iterable[Batch], most_rays: float, otherwise_s: float) -> float:
    """Up to when of some batches may leave now: up to the one with which they have so many rays, the oldest first."""
    rays = 0
    for batch in sorted(batches, key=lambda b: b.oldest_s):
        rays += len(batch.rays)
        if rays >= most_rays:
            return batch.oldest_s
    return otherwise_s
