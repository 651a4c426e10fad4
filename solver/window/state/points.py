"""The points of the window: looks and control as they arrive, judged, and held until they can be used."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from math import isfinite

import numpy as np

from ...adjustment.drift_hypotheses import Group
from ...adjustment.network import SAME_S, most_off
from ...adjustment.normal_equations import ControlWeights
from ...arrays import Array, Bools
from ...camera.line_camera import LineCamera
from ...geometry.measured_trajectory import SMOOTHED_LATE_S, MeasuredTrajectory
from ..results import Look, Refusal
from .batch import Batch
from .strip import WindowStrip

#: Sigmas outside this are of no measurement, px: squares of their weights leave the range of numbers, and what is not a
#: number in one look is in all unknowns afterwards.
SIGMAS_PX = (1e-6, 1e9)


@dataclass
class ControlPoint:
    """Known coordinates: (3,) m with sigma (3,), infinite where not given; role as in the messages."""

    xyz_l: Array
    sigma_m: Array
    role: str

    @property
    def weight(self) -> Array:
        if self.role == "check":
            return np.zeros(3)
        return np.where(
            np.isfinite(self.sigma_m), 1.0 / np.where(np.isfinite(self.sigma_m), self.sigma_m, 1.0) ** 2, 0.0
        )

    def says(self, other: ControlPoint) -> bool:
        """Whether another says the same of the coordinates that count."""
        weight = self.weight
        return bool((weight == other.weight).all() and (self.xyz_l == other.xyz_l)[weight > 0].all())


@dataclass
class PointLooks:
    """All looks at one point that the window knows; m of them.

    Attributes
    ----------
    looks : as they came
    time_s : (m,)
    weight : (m,) 0 for rejected ones
    returned, reported : looks that were taken back once; looks whose rejection was reported
    batch : where the point is, None while it waits for a second look
    out : control coordinates that were rejected
    alone : does not agree with what earlier strips say of it
    spent : known coordinates have been used by an earlier strip, whether or not the point ties that strip
    """

    looks: list[Look] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)
    returned: set[int] = field(default_factory=set)
    reported: set[int] = field(default_factory=set)
    batch: Batch | None = None
    out: set[int] = field(default_factory=set)
    alone: bool = False
    spent: bool = False


#: Why a look is refused whose time is final.
TOO_LATE = "too late"
#: Time after which a look whose orientation has not come is given up, s.
PATIENCE_S = 2.0


class Intake:
    """The points of the window by name, and which of them have news or wait.

    Attributes
    ----------
    points : all points that are not final
    control : known coordinates by point
    looked : names of the strips of which a look was ever taken
    came : by strip, how many looks at points came that the window was there for, and that it had passed
    """

    def __init__(self, camera: LineCamera, strips: dict[str, WindowStrip], trajectory: MeasuredTrajectory):
        self.points: dict[str, PointLooks] = {}
        self.control: dict[str, ControlPoint] = {}
        self.looked: set[str] = set()
        self.came: defaultdict[str, Counter[bool]] = defaultdict(Counter)
        self._camera, self._strips, self._trajectory = camera, strips, trajectory
        self._arrived: dict[str, None] = {}
        self._waiting: dict[str, None] = {}
        self._done: dict[tuple[str, str], float] = {}  # points that are final in a strip, and the time of their batch
        self._refused: list[Refusal] = []
        self._missing_s = -np.inf  # when poses were missing last
        self._out_before: dict[str, set[int]] = {}

    def add_control(self, name: str, point: ControlPoint) -> None:
        self.control[name] = point
        self._out_before.pop(name, None)
        if name in self.points:
            self.points[name].out.clear()  # it is judged anew
            self._arrived[name] = None

    def add_look(self, name: str, look: Look) -> str:
        """Take a look, or say why not."""
        time_s = self._time_of(look)
        reason = self._judge(look)
        if not reason:
            reason = self._judge_time(name, look, time_s)
            self.came[look.strip][reason == TOO_LATE] += 1
        if reason:
            self._refused.append(Refusal(name, look, reason))
            return reason
        point = self.points.get(name)
        if point is None:  # what was refused of it in an earlier strip is in doubt
            point = self.points[name] = PointLooks(out=set(self._out_before.get(name, ())))
        self.looked.add(look.strip)
        point.looks.append(look)
        point.time_s.append(time_s)
        point.weight.append(1.0)
        self._arrived[name] = None
        if point.batch is None:
            self._waiting[name] = None
        return ""

    def late_share(self, strip: str) -> float:
        """Share of the looks of a strip that came when the window had passed them."""
        came = self.came[strip]
        return came[True] / max(came.total(), 1)

    def known_coordinates(self, names: Sequence[str], used: Bools) -> ControlWeights:
        """Known coordinates of points; those that are refused, and those ``used`` (p,) by earlier strips, take no
        weight."""
        weight, xyz = np.zeros((len(names), 3)), np.zeros((len(names), 3))
        for i, name in enumerate(names):
            if name in self.control:
                weight[i], xyz[i] = self.control[name].weight, np.nan_to_num(self.control[name].xyz_l)
                weight[i, list(self.points[name].out)] = 0.0
        weight[used] = 0.0
        return ControlWeights(weight, xyz)

    def sources_of(self, batch: Batch) -> list[Group]:
        """Source and CCD line of each ray."""
        if batch.groups is None:
            looks = [self.points[name].looks for name in batch.names]
            of_rays = (looks[p][k] for p, k in zip(batch.rays.point.tolist(), batch.rays.source.tolist(), strict=True))
            batch.groups = [(look.source, look.ccd) for look in of_rays]
        return batch.groups

    def _time_of(self, look: Look) -> float:
        """NaN for a strip that is not known."""
        strip = self._strips.get(look.strip)
        if strip is None:
            return float("nan")
        by_rate = strip.first_line_time_s + look.line / strip.line_rate_hz
        return look.time_s if abs(look.time_s - by_rate) > SAME_S else by_rate

    def _judge(self, look: Look) -> str:
        if not all(map(isfinite, (look.line, look.sample, look.sigma_line_px, look.sigma_sample_px))):
            return "value is not finite"
        if not (look.sigma_line_px > 0 and look.sigma_sample_px > 0):
            return "sigma is not positive"
        least, most = SIGMAS_PX
        if not (least <= look.sigma_line_px <= most and least <= look.sigma_sample_px <= most):
            return "sigma of no measurement"
        if look.ccd not in self._camera.line_index:
            return "unknown ccd"
        if look.strip not in self._strips:
            return "unknown strip"
        strip = self._strips[look.strip]
        since_s = look.line / strip.line_rate_hz
        if abs(look.time_s - strip.first_line_time_s - since_s) > most_off(since_s):
            return "time is not that of its line"
        if not -0.5 <= look.sample <= self._camera.lines[self._camera.line_index[look.ccd]].pixels - 0.5:
            return "beyond the ccd line"
        if not strip.contains(look.line):
            return "outside strip"
        return ""

    def _judge_time(self, name: str, look: Look, time_s: float) -> str:
        if time_s < self._strips[look.strip].final_to_s:
            return TOO_LATE
        if (name, look.strip) in self._done:
            return "point is final"
        if name in self.points and look in self.points[name].looks:
            return "duplicate"
        return ""

    def ready(self, now_s: float) -> list[str]:
        """Points with news all of whose looks have a measured orientation; they have no news any more.

        Looks for which no orientation will come are refused, and those that waited for a partner too long.
        """
        names = list(self._arrived)
        points = [self.points[name] for name in names]
        time_s = np.array([t for point in points for t in point.time_s])
        final_s = np.array([self._strips[look.strip].final_to_s for point in points for look in point.looks])
        alone = np.repeat([point.batch is None for point in points], [len(point.looks) for point in points])
        past = alone.astype(bool) & (time_s < final_s)
        covered = self._trajectory.covers(time_s) & ~past
        if self._trajectory.end_s < now_s - PATIENCE_S:
            self._missing_s = now_s
        late_s = -np.inf
        if now_s >= self._missing_s + SMOOTHED_LATE_S:
            late_s = min(now_s - PATIENCE_S, self._trajectory.end_s)
        over, good, lost = past.tolist(), covered.tolist(), (past | (~covered & (time_s < late_s))).tolist()
        ready = []
        end = 0
        for name, point in zip(names, points, strict=True):
            first, end = end, end + len(point.looks)
            gone = [i for i in range(end - first) if lost[first + i]] if not all(good[first:end]) else []
            if len(gone) + sum(good[first:end]) == end - first:
                ready.append(name)
                del self._arrived[name]
            for i in gone[::-1]:
                reason = "too few looks" if over[first + i] else "no orientation"
                self._refused.append(Refusal(name, point.looks[i], reason))
                del point.looks[i], point.time_s[i], point.weight[i]
        # a batch is taken apart whole, so its points wait for each other
        waits = {id(batch) for name in self._arrived if (batch := self.points[name].batch) is not None}
        held = [name for name in ready if id(self.points[name].batch) in waits]
        self._arrived.update(dict.fromkeys(held))
        return [name for name in ready if id(self.points[name].batch) not in waits] if held else ready

    def place(self, name: str, batch: Batch | None) -> None:
        """A point is in a batch now, or in none."""
        self.points[name].batch = batch
        if batch is None:
            self._waiting[name] = None
        else:
            self._waiting.pop(name, None)

    def finish(self, batch: Batch) -> None:
        """The points of a batch are final."""
        for name in batch.names:
            strips = {look.strip for look in self.points[name].looks}
            if name in self.control:
                self._out_before[name] = self.points[name].out
            del self.points[name]
            self._arrived.pop(name, None)
            self._done |= {(name, strip): batch.newest_s for strip in strips}

    def without_partner(self, limits_s: Mapping[str, float]) -> list[str]:
        """Points that wait for another look in vain: theirs are older than the limits of their strips."""
        points = ((name, self.points[name]) for name in self._waiting)
        return [
            name
            for name, point in points
            if all(t <= limits_s[look.strip] for look, t in zip(point.looks, point.time_s, strict=True))
        ]

    def give_up(self, names: Iterable[str]) -> list[Refusal]:
        """Wait no longer for other looks at points."""
        refused = []
        for name in names:
            refused += [Refusal(name, look, "too few looks") for look in self.points[name].looks]
            del self.points[name], self._waiting[name]
            self._arrived.pop(name, None)
        return refused

    def without_place(self, batch: Batch, placed: Collection[str]) -> list[Refusal]:
        """Looks of a batch that leaves which nothing has placed: single ones that were to tie strips and did not."""
        points = ((name, self.points[name]) for name in batch.names if name not in placed)
        return [
            Refusal(name, p.looks[0], "too few looks") for name, p in points if len(p.looks) == 1 and p.weight[0] > 0
        ]

    def forget(self, before_s: float) -> None:
        """Forget which points became final before a time."""
        for key in list(takewhile(lambda key: self._done[key] < before_s, self._done)):
            del self._done[key]

    @property
    def oldest_waiting_s(self) -> float:
        """Time of the oldest look that waits."""
        return min((min(self.points[n].time_s, default=np.inf) for n in self._waiting), default=np.inf)

    def take_refused(self) -> list[Refusal]:
        """What was refused since the last call."""
        refused, self._refused = self._refused, []
        return refused
