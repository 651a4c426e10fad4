"""A simulated flight as a recording through navigator and adjuster, for ``triline study misspecified``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.simulation.misspecified_study import GRID_HZ, OnlineAnswer, Refused, named
from ...solver.simulation.scenario import Simulation
from ...solver.simulation.window_study import TimedPose
from ...solver.window.quality.light import GOOD
from ...solver.window.results import AdjustedPoint, RefinedOrientation
from .. import convert
from ..adjuster.adjuster import Adjuster
from ..navigator.navigator import Navigator
from ..report.flight import Flight, collect
from ..report.source import messages_of
from ..simulator.simulator import Simulator
from .study_flights import EPOCH_NS, processed


def through_nodes(simulation: Simulation, poses: list[TimedPose]) -> OnlineAnswer:
    """What `triline process` makes of the recording of a flight; its navigator makes its own poses."""
    with tempfile.TemporaryDirectory() as folder:
        return answer_of(collect(messages_of(recording_of(simulation, Path(folder)))))


def recording_of(simulation: Simulation, folder: Path) -> Path:
    """The recording of a flight after navigator and adjuster, in a folder."""
    return processed(Simulator(simulation).messages(EPOCH_NS), [Navigator(), Adjuster(grid_hz=GRID_HZ)], folder)


def answer_of(flight: Flight) -> OnlineAnswer:
    """What the messages of a processed flight say in the end; times count from `EPOCH_NS`."""
    reports = [body for _, body in flight.reports]
    last, with_rays = reports[-1], [r for r in reports if r.rays]
    poses = flight.poses.get("whole") or flight.poses["final"]
    orientation = []
    for strip in dict.fromkeys(poses.strip.tolist()):
        mine = poses.take(poses.strip == strip)
        time_s = (mine.time_ns - EPOCH_NS) / convert.SECOND_NS
        orientation.append(
            RefinedOrientation(str(strip), time_s, mine.position_l, mine.angles, mine.covariance, mine.correction)
        )
    return OnlineAnswer(
        orientation,
        {p.point: _point(p) for p in (flight.whole_points or flight.points).values()},
        last.sigma0_total,
        _refused(reports),
        sorted({name for r in reports for s in r.sources for name in _suspects(s)}),
        last.light,
        last.light_reason,
        float(np.mean([r.light == GOOD for r in with_rays])) if with_rays else 0.0,
        [body.message for _, body in flight.events if body.name == Adjuster.name],
    )


def _point(body: Any) -> AdjustedPoint:
    covariance = np.array(body.covariance).reshape(3, 3)
    return AdjustedPoint(
        body.point, body.role, np.array([body.x, body.y, body.z]), covariance, body.rays, True, (), body.checked, True
    )


def _refused(reports: list[Any]) -> set[Refused]:
    """Looks and coordinates that were rejected and did not come back."""
    found: dict[Refused, bool] = {}
    for report in reports:
        for out, refusals in ((True, report.rejected), (False, report.returned)):
            for r in refusals:
                found[r.point, r.strip, r.ccd, r.coordinate] = out
    return {key for key, out in found.items() if out}


def _suspects(source: Any) -> list[str]:
    """A source that drifts, and its rivals ("source/ccd"); the one publisher of a simulation goes unnamed."""
    groups = [(source.source, source.ccd), *(tuple(rival.rsplit("/", 1)) for rival in source.rivals)]
    return [named("" if publisher == Simulator.name else publisher, ccd) for publisher, ccd in groups]
