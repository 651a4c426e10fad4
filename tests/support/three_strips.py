"""A small flight of several strips: two side by side and one across them, 24 s each."""

from __future__ import annotations

import functools
from dataclasses import replace

from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    OnlineResult,
    TimedPose,
    adjust_at_once,
    adjust_online,
    navigate,
)
from triline.solver.window.results import WindowOptions

PLAN = FlightPlan(
    strips=2, cross_strips=1, strip_s=24.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0
)
SENSORS = ErrorModel(attitude_rate_hz=100.0)
TIES = ObservationPlan(tie_points_per_s=4.0, control=4, check=6)
OPTIONS = WindowOptions(snoop=False, settle_s=1.0, grid_hz=4.0)
#: Two strips side by side of it, shorter.
SIDE_BY_SIDE = replace(PLAN, cross_strips=0, strip_s=16.0)


def flown(plan: FlightPlan = PLAN, ties: ObservationPlan = TIES) -> tuple[Simulation, list[TimedPose]]:
    """A simulation and its poses as navigated."""
    simulation = simulate(plan, 11, SENSORS, ties)
    return simulation, navigate(simulation)


@functools.cache
def usual() -> tuple[Simulation, list[TimedPose]]:
    """The flight as planned, made once a process."""
    return flown()


@functools.cache
def usual_online() -> OnlineResult:
    """That flight through the window."""
    return adjust_online(*usual(), OPTIONS, live=False, update_s=1.0)


@functools.cache
def usual_at_once() -> OnlineResult:
    """The batch adjustment of that flight."""
    return adjust_at_once(*usual(), OPTIONS)
