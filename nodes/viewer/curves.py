"""Curves over time: sigma0, latency, correction functions, parameters, errors against truth; and the event log."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.accuracy import angle_difference
from ...solver.quantiles import chi2
from ...solver.window.quality.determinability import ESTIMATED
from .. import convert
from ..convert import PoseSample
from ..node import Message
from .canvas import Canvas, Color, Series
from .scene_part import AXES, CHECK, CONTROL, FILTERED, FINAL, LIVE, TRUTH, Part, faded
from .scene_state import SceneState

Array = NDArray[np.floating]

COMPONENTS = ("dX", "dY", "dZ", "domega", "dphi", "dkappa")
_MDEG = 1000.0 * float(np.degrees(1.0))
_SCALE = np.array([1.0, 1.0, 1.0, _MDEG, _MDEG, _MDEG])
_STEP_NS = int(0.2 * convert.SECOND_NS)
_ALPHA = 0.05
_WAITING = 1000
#: Values of a curve of a recording that are handed over together. Tuned: with fewer a piece costs more than its values.
TOGETHER = 1000
_GAP_S, _UPDATES, _RAYS_GAP_S = 1.5, 3.0, 6.0  # a curve is broken after so long without a pose, so many updates, rays
_MOST_LIMITS = 10.0  # in the overview protection levels end at so many alert limits
_TELLING = 30  # redundancy from which sigma0 says something
_RECORD = faded(LIVE, 0.45)
_GREY = (140, 140, 150, 255)
_LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
_SIGMAS = 3.0
_NAMES = {"orientation/live": "live", "orientation/final": "final"}


class PlotsPart(Part):
    """Collects samples of curves and hands them over in batches."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._curves: dict[str, tuple[list[float], list[float]]] = {}
        self._styles: dict[str, Series] = {}
        self._styled: set[str] = set()
        self._events: list[tuple[float, str, str]] = []
        self._last: dict[str, int] = {}
        self._untested: list[tuple[float, str, PoseSample]] = []  # orientations that came before their truth
        self._newest_ray_ns = 0
        self._newest: dict[str, float] = {}  # time of the newest value of a curve

    # ---- taking

    def pose(self, topic: str, sample: PoseSample) -> None:
        if sample.time_ns - self._last.get(topic, 0) < _STEP_NS:
            return
        self._last[topic] = sample.time_ns
        t = self.state.seconds(sample.time_ns)
        if topic in _NAMES:
            self._corrections(t, _NAMES[topic], sample)
            if sample.valid:
                self._untested.append((t, _NAMES[topic], sample))
        elif topic == "truth/trajectory":
            base = self.state.trajectory.at(sample.time_ns)
            if base is not None and self.state.on_strip(sample.time_ns):
                self._error(t, self.state.measured, *base, sample.position_l, sample.quaternion)
                needed = _difference(sample.position_l, sample.quaternion, *base) * _SCALE
                series = Series(f"truth - {self.state.measured}", TRUTH, 1.0)
                for name, value in zip(COMPONENTS, needed, strict=True):
                    self._add(f"corrections/{name}/truth", t, value, series)
            self._test(self.state.truth.newest_ns)

    def _test(self, known_ns: int) -> None:
        """Errors of the orientations that truth has caught up with."""
        waiting, self._untested = self._untested[-_WAITING:], []
        for row in waiting:
            time_s, kind, sample = row
            if sample.time_ns > known_ns:
                self._untested.append(row)
                continue
            true = self.state.truth.at(sample.time_ns)
            if true is not None:
                self._error(time_s, kind, sample.position_l, sample.quaternion, *true)

    def _corrections(self, t: float, kind: str, sample: PoseSample) -> None:
        """The correction functions: final with its band, and the part that the window holds with its own.

        What was said at once is drawn twice: thin, as a record, and as the window's part, of which views show no more
        than is not final yet.
        """
        if sample.correction is None or len(sample.correction) != 6:
            return
        values = sample.correction * _SCALE
        drawn = (("live", "live, earlier", _RECORD, 1.0), ("window", "live, in the window", LIVE, 2.2))
        if kind == "final":
            drawn = (("final", "final", FINAL, 2.2),)
        for entity, text, color, width in drawn:
            for name, value in zip(COMPONENTS, values, strict=True):
                self._add(f"corrections/{name}/{entity}", t, value, Series(text, color, width))
        for i, (name, value) in enumerate(zip(COMPONENTS[:3], values[:3], strict=True)):
            style = Series(name, AXES[i], 2.0) if kind == "final" else Series(name, faded(AXES[i], 0.6), 1.0)
            self._add(f"overview/position/{name}{'' if kind == 'final' else '_window'}", t, value, style)
        if sample.covariance is not None:
            self._band(t, kind, values, _SIGMAS * np.sqrt(np.diag(sample.covariance)) * _SCALE)

    def _band(self, t: float, kind: str, values: Array, width: Array) -> None:
        prefix, text, color = ("", "final", FINAL) if kind == "final" else ("window_", "live", LIVE)
        style = Series(f"{text} \u00b1 {_SIGMAS:g} sigma", faded(color, 0.6), 1.0)
        for i, name in enumerate(COMPONENTS):
            for bound, sign in (("upper", 1.0), ("lower", -1.0)):
                self._add(f"corrections/{name}/{prefix}{bound}", t, values[i] + sign * width[i], style)

    def _error(self, t: float, kind: str, position: Array, quaternion: Array, true_p: Array, true_q: Array) -> None:
        error = _difference(position, quaternion, true_p, true_q)
        color = {"live": LIVE, "final": FINAL}.get(kind, FILTERED)
        if kind == "live":
            worst = float(np.abs(error[:3]).max())
            self._add("overview/integrity/error", t, worst, Series("error of live", TRUTH, 1.0))
        self._add(f"errors/position/{kind}", t, float(np.linalg.norm(error[:3])), Series(kind, color))
        self._add(f"errors/attitude/{kind}", t, _MDEG * float(np.linalg.norm(error[3:])), Series(kind, color))

    def take(self, message: Message) -> None:
        if message.topic == "adjustment/report":
            self._report(self.state.seconds(message.stamp_ns), message.body)
        elif message.topic == "event/log":
            body = message.body
            text = f"{body.name}: {body.message}" if body.name else body.message
            self._events.append((self.state.seconds(message.stamp_ns), text, _LEVELS.get(body.level, "INFO")))

    def _report(self, t: float, report: Any) -> None:
        gap_s = max(_UPDATES * report.update_interval_s, _GAP_S)
        self._add("sigma0/one", t, 1.0, Series("1.0", TRUTH, 1.0), gap_s)
        if report.redundancy >= _TELLING:
            self._add("sigma0/value", t, report.sigma0, Series("sigma0", FINAL, 2.0), gap_s)
            self.state.note_sigma0(report.sigma0)
            low, high = _sigma0_band(int(report.redundancy))
            self._add("sigma0/low", t, low, Series("95 %, low", _GREY, 1.0), gap_s)
            self._add("sigma0/high", t, high, Series("95 %, high", _GREY, 1.0), gap_s)
        if report.rays > 0 and report.window_end_ns > self._newest_ray_ns:
            self._newest_ray_ns = report.window_end_ns
            style = Series("newest ray to answer", FILTERED)
            self._add("latency/data", t, 1000 * report.data_latency_s, style, max(gap_s, _RAYS_GAP_S))
        if report.compute_s > 0:
            self._add("latency/compute", t, 1000 * report.compute_s, Series("update", LIVE), gap_s)
        self._add("window/rays", t, report.rays, Series("rays", FILTERED), gap_s)
        self._add("window/points", t, report.points, Series("points", FINAL), gap_s)
        self._add("window/rejected", t, report.rejected_total, Series("rejected, total", (255, 60, 230, 255)), gap_s)
        if report.strip:
            self._integrity(t, report, gap_s)
        for k, parameter in enumerate(report.parameters):
            self._parameter(t, k, parameter, gap_s)
        if report.parameters:
            estimated = sum(p.status == ESTIMATED for p in report.parameters)
            self._of_unit("determined")
            self._add("parameters/determined/estimated", t, estimated, Series("estimated", FINAL, 2.0), gap_s)
            self._add("parameters/determined/all", t, len(report.parameters), Series("all", _GREY, 1.0), gap_s)

    def _integrity(self, t: float, report: Any, gap_s: float) -> None:
        """Protection levels and sigmas while a strip is flown: of each axis, and of the worst one."""
        for group, part, scale in (("position", slice(0, 3), 1.0), ("attitude", slice(3, 6), _MDEG)):
            for kind, values, width in (("protection", report.protection, 2.0), ("sigma", report.sigma, 1.0)):
                for axis, value in enumerate(values[part]):
                    name = COMPONENTS[part][axis].removeprefix("d")
                    series = Series(f"{name}, {kind}", AXES[axis] if width > 1 else faded(AXES[axis], 0.7), width)
                    self._add(f"integrity/{group}/{name}_{kind}", t, scale * value, series, gap_s)
        most = _MOST_LIMITS * report.alert_limit_m or np.inf  # of a young window they are hundreds of kilometres
        for kind, values, color in (("protection", report.protection, LIVE), ("sigma", report.sigma, CHECK)):
            if len(values) == 6:
                self._add(f"overview/integrity/{kind}", t, min(max(values[:3]), most), Series(kind, color, 2.0), gap_s)
        if report.alert_limit_m > 0 and report.ground_protection:
            ground = Series("protection on the ground", FINAL, 2.0)
            self._add("overview/integrity/ground", t, min(max(report.ground_protection), most), ground, gap_s)
            limit = Series("alert limit", CONTROL, 1.0)
            self._add("overview/integrity/limit", t, report.alert_limit_m, limit, gap_s)

    def _parameter(self, t: float, k: int, parameter: Any, gap_s: float) -> None:
        """The value; faint as long as the network cannot see it. Lens distortions, each of which has a unit of its own,
        in units of their sigmas."""
        unit, value = parameter.unit or "1", parameter.value
        if unit.startswith("rad"):
            unit, value = "mdeg" + unit[3:], _MDEG * value
        elif unit.startswith("mm^"):
            unit, value = "sigma", parameter.t
        self._of_unit(unit)
        entity = f"parameters/{entity_name(unit)}/{entity_name(parameter.name)}"
        series = Series(parameter.name, _palette(k), 1.5)
        if parameter.status != ESTIMATED:
            entity, series = f"{entity}_open", Series(f"{parameter.name}, open", faded(_palette(k), 0.4), 1.0)
        self._add(entity, t, value, series, gap_s)

    def _of_unit(self, unit: str) -> None:
        """There is a plot of this unit."""
        if unit not in self.state.units:
            self.state.units.append(unit)

    def _add(self, entity: str, t: float, value: float, style: Series, gap_s: float = _GAP_S) -> None:
        """Add to a curve; after a gap (a turn) it begins anew: a value that is not a number breaks it."""
        if not np.isfinite(value):
            return
        times, values = self._curves.setdefault(entity, ([], []))
        last = self._newest.get(entity, t)
        if t - last > gap_s:
            times.append((last + t) / 2)
            values.append(np.nan)
        self._newest[entity] = t
        times.append(t)
        values.append(float(value))
        self._styles.setdefault(entity, style)

    # ---- drawing

    def draw(self, canvas: Canvas) -> None:
        least = TOGETHER if self.state.recorded and not self.state.closing else 1
        for entity, (times, values) in self._curves.items():
            if entity not in self._styled:
                self._styled.add(entity)
                canvas.style(f"plots/{entity}", self._styles[entity])
            if len(times) >= least:
                canvas.curve(f"plots/{entity}", times, values)
                self._curves[entity] = [], []
        for t, text, level in self._events:
            canvas.at(t)
            canvas.event("log", text, level)
        self._events.clear()
        canvas.at(self.state.now_s)


def _difference(position: Array, quaternion: Array, base_p: Array, base_q: Array) -> Array:
    """Position and angles (6,) minus those of a base."""
    angles = convert.angles_of(np.array([quaternion, base_q]))
    return np.concatenate([position - base_p, angle_difference(angles[0], angles[1])])


@lru_cache(maxsize=4096)
def _sigma0_band(redundancy: int) -> tuple[float, float]:
    """Between which sigma0 lies in 95 % of all cases if the stochastic model is right."""
    low, high = np.sqrt(chi2.ppf([_ALPHA / 2, 1 - _ALPHA / 2], redundancy) / redundancy)
    return float(low), float(high)


def entity_name(text: str) -> str:
    """Text as one part of an entity path."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text) or "_"


def _palette(k: int) -> Color:
    """Colours that differ for neighbouring numbers."""
    hues = ((230, 90, 80), (90, 200, 120), (90, 150, 250), (240, 200, 70), (200, 110, 240), (90, 220, 220))
    red, green, blue = hues[k % len(hues)]
    return red, green, blue, 255
