"""Chain of filter nodes that can be mended: a fix that comes late makes a node where it belongs.

Inertial samples are kept, integrated in short spans ("chunks"). Between two nodes stand the chunks that lead from one
to the other; the last node has those that lead to the present. After an insertion the filter runs again from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..geometry.rotation import quaternion_from_matrix
from .carried import NavigationTrajectory
from .error_state import ErrorStateFilter, Estimate, Innovation, NavigationSettings, Observation, Start
from .filter_pass import Carried, Estimates
from .inertial_data import GnssData, InertialData, cut
from .observations import AntennaPosition, AntennaVelocity
from .smoother import corrected, gains, recurse
from .strapdown import IncrementBlock, State, integrate_one, integrate_to, propagate

Array = NDArray[np.floating]


@dataclass(slots=True)
class Chunk:
    """Inertial pieces between two poses, and their integrals where they have been needed."""

    pieces: InertialData
    block: IncrementBlock | None
    end_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.end_s = float(self.pieces.time_s[-1])


@dataclass(slots=True)
class Span:
    """What leads from a node to the next: chunks, integrals from the node to the end of each, what was taken off."""

    gyro: Array
    accel: Array
    chunks: list[Chunk] = field(default_factory=list)
    running: list[IncrementBlock] = field(default_factory=list)

    @property
    def total(self) -> IncrementBlock:
        return self.running[-1]

    def append(self, chunk: Chunk) -> None:
        if chunk.block is None:
            chunk.block = integrate_one(chunk.pieces, self.gyro, self.accel)
        self.running.append(self.running[-1].then(chunk.block) if self.running else chunk.block)
        self.chunks.append(chunk)

    def extend(self, pieces: InertialData, borders: Sequence[int]) -> None:
        """Several chunks, of the pieces between borders; only the integrals from the node are made."""
        runs = integrate_to(pieces, borders[1:], self.gyro, self.accel)
        before = self.running[-1] if self.running else None
        self.running += runs if before is None else [before.then(run) for run in runs]
        self.chunks += [Chunk(pieces[a:b], None) for a, b in pairwise(borders)]

    def start(self, n: int) -> Span:
        """The first n chunks."""
        return Span(self.gyro, self.accel, self.chunks[:n], self.running[:n])


@dataclass(slots=True)
class FilterNode:
    """A time at which the filter stops: the estimate before and after what was observed there, and the way onward."""

    time_s: float
    prior: Estimate
    P_prior: Array
    F: Array
    span: Span
    posterior: Estimate
    P_posterior: Array
    x: Array
    memory_before: tuple[int, int, float]
    memory: tuple[int, int, float]
    observations: list[Observation]
    innovations: list[Innovation] = field(default_factory=list)


class NavigationChain:
    """Nodes from the start of a navigation, or from what is still of interest, to the present.

    Parameters
    ----------
    settings : sensors and treatment
    start : estimate with covariance
    step_s : longest distance of nodes
    """

    def __init__(self, settings: NavigationSettings, start: Start, step_s: float):
        self.settings, self.step_s = settings, step_s
        self._filter = f = ErrorStateFilter(settings, start)
        e, n = start.estimate, settings.layout.n
        first = FilterNode(
            e.time_s, e, f.P, np.eye(n), Span(e.gyro, e.accel), e, f.P, np.zeros(n), f.memory, f.memory, []
        )  # fmt: skip
        self.nodes = [first]

    @property
    def end_s(self) -> float:
        """End of the inertial data."""
        last = self.nodes[-1]
        return last.span.chunks[-1].end_s if last.span.chunks else last.time_s

    def append(self, pieces: InertialData) -> None:
        """Inertial pieces (corrected) that follow."""
        if self.nodes[-1].span.chunks and self.nodes[-1].span.total.duration_s >= self.step_s - 1e-9:
            self.close()
        span = self.nodes[-1].span
        span.append(Chunk(pieces, integrate_one(pieces, span.gyro, span.accel)))

    def extend(self, pieces: InertialData, ends: list[int]) -> None:
        """Many chunks that follow: inertial pieces (corrected), and where each chunk ends. As `append` of each."""
        borders = [0, *ends]
        length = np.concatenate([[0.0], np.cumsum(pieces.dt_s)])[borders]
        i = 0
        while i < len(ends):
            if self.nodes[-1].span.chunks and self.nodes[-1].span.total.duration_s >= self.step_s - 1e-9:
                self.close()
            span = self.nodes[-1].span
            before = span.total.duration_s if span.chunks else 0.0
            n = 1 + int((before + length[i + 1 : -1] - length[i] < self.step_s - 1e-9).sum())
            span.extend(pieces[borders[i] : borders[i + n]], [b - borders[i] for b in borders[i : i + n + 1]])
            i += n

    def close(self) -> None:
        """Make a node at the present."""
        if not self.nodes[-1].span.chunks:
            return
        node = self._blank(self.end_s)
        self.nodes.append(node)
        self._run_from(len(self.nodes) - 1)
        node.span = Span(node.posterior.gyro, node.posterior.accel)

    def insert(self, time_s: float, fix: GnssData) -> str:
        """Put a fix where it belongs in time, and run the filter again from there; returns what is wrong with it."""
        nodes = self.nodes
        k = len(nodes) - 1
        while k >= 0 and nodes[k].time_s > time_s + 1e-7:
            k -= 1
        if k < 0:
            return "too late"
        if time_s - nodes[k].time_s > 1e-7:
            self._split(k, time_s)
            k += 1
        if any(o.kind == "position" for o in nodes[k].observations):
            return "duplicate"
        nodes[k].observations += self._observations(k, fix)
        self._run_from(k)
        return ""

    def tip(self) -> tuple[float, State, Array]:
        """Time, state and covariance (n, n) at the present."""
        node, f = self.nodes[-1], self._filter
        state, P = node.posterior.state, node.P_posterior
        if not node.span.chunks:
            return node.time_s, state, P
        block, e = node.span.total, node.posterior
        R, v, p = block.for_errors(e.gyro - node.span.gyro, e.accel - node.span.accel)
        F, Q, _ = f.transition(state, block)
        return self.end_s, propagate(state, block.duration_s, R, v, p), F @ P @ F.T + Q

    def smoothed(self) -> NavigationTrajectory:
        """Smoothed trajectory from the first to the last node, a row of it for each chunk."""
        nodes = self.nodes
        F, P_prior, P_post, x = (
            np.array([getattr(n, name) for n in nodes]) for name in ("F", "P_prior", "P_posterior", "x")
        )
        d, P = recurse(gains(F, P_post, P_prior), P_post, P_prior, x)
        estimates = corrected(Estimates.stack([n.posterior for n in nodes]), d, self.settings.layout)
        return NavigationTrajectory(estimates, estimates, P, P, _carried(nodes))

    def forget(self, before_s: float) -> None:
        """Drop nodes that are not needed for times after ``before_s``."""
        old = sum(n.time_s < before_s for n in self.nodes)
        if old > 1:
            del self.nodes[: old - 1]

    def _blank(self, time_s: float) -> FilterNode:
        last, n = self.nodes[-1], self.settings.layout.n
        e, P = last.posterior, last.P_posterior
        return FilterNode(
            time_s, e, P, np.eye(n), Span(e.gyro, e.accel), e, P, np.zeros(n), last.memory, last.memory, []
        )  # fmt: skip

    def _observations(self, k: int, fix: GnssData) -> list[Observation]:
        axes = fix.R_en[0].T
        out: list[Observation] = [AntennaPosition(fix.position_e[0], fix.covariance_e()[0], axes)]
        v, s = fix.velocity_e, fix.sigma_velocity_n
        if v is not None and s is not None:
            before = self.nodes[k - 1].span if k > 0 else self.nodes[k].span
            near = before.chunks[-1].pieces if before.chunks else None
            if near is not None:
                rate = near.dtheta.sum(axis=0) / near.dt_s.sum()
                A = fix.R_en[0] * s[0]
                out.append(AntennaVelocity(v[0], A @ A.T, rate, axes))
        return out

    def _split(self, k: int, time_s: float) -> None:
        """Make a node inside the span of node ``k``."""
        nodes, span = self.nodes, self.nodes[k].span
        n = next((i for i, chunk in enumerate(span.chunks) if chunk.end_s > time_s + 1e-7), len(span.chunks))
        first, second = span.start(n), Span(span.gyro, span.accel)
        for chunk in span.chunks[n:]:
            begin = float(chunk.pieces.time_s[0] - chunk.pieces.dt_s[0])
            if begin >= time_s - 1e-7:
                second.append(chunk)
                continue
            pieces = cut(chunk.pieces, [time_s])[0]
            inside = pieces.time_s <= time_s + 1e-7
            for part, to in ((pieces[inside], first), (pieces[~inside], second)):
                to.append(Chunk(part, integrate_one(part, span.gyro, span.accel)))
        node = self._blank(time_s)
        node.span = second
        nodes[k].span = first
        nodes.insert(k + 1, node)

    def _run_from(self, k: int) -> None:
        """Run the filter from node ``k`` to the last one."""
        f = self._filter
        for i in range(k, len(self.nodes)):
            node = self.nodes[i]
            if i > 0:
                before = self.nodes[i - 1]
                f.set(before.posterior, before.P_posterior, before.memory)
                node.F = f.predict(before.span.total, before.span.gyro, before.span.accel)
                f.estimate.time_s = node.time_s
                node.prior, node.P_prior, node.memory_before = f.estimate, f.P, f.memory
            f.set(node.prior, node.P_prior, node.memory_before)
            node.x, node.innovations = np.zeros(self.settings.layout.n), []
            for observation in node.observations:
                innovation, dx = f.update(observation)
                node.innovations.append(innovation)
                node.x += dx
            node.posterior, node.P_posterior, node.memory = f.estimate, f.P, f.memory


def _carried(nodes: list[FilterNode]) -> Carried:
    """Running integrals of the closed spans, a row for each chunk with the last of its pieces."""
    ends, block, runs, last = [], [], [], []
    for k, node in enumerate(nodes[:-1]):
        for chunk, running in zip(node.span.chunks, node.span.running, strict=True):
            ends.append(chunk.end_s)
            block.append(k)
            runs.append(running)
            p = chunk.pieces
            last.append((p.dt_s[-1], p.dtheta[-1], p.dv[-1]))
    return Carried(
        np.array(ends),
        np.array(block),
        np.array([r.duration_s for r in runs]),
        quaternion_from_matrix(np.array([r.R for r in runs])),
        np.array([r.v for r in runs]),
        np.array([r.p for r in runs]),
        *(np.array(column) for column in zip(*last, strict=True)),
    )
