"""What the window keeps does not grow from strip to strip, and the work of a turn is done in portions."""

from __future__ import annotations

import gc
import sys
import types

import numpy as np
import pytest

from triline.solver.geometry.measured_trajectory import MeasuredTrajectory
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.block import archive as window_archive
from triline.solver.window.block import block as window_block
from triline.solver.window.results import WindowOptions

SENSORS = ErrorModel(attitude_rate_hz=50.0)
OPTIONS = WindowOptions(settle_s=1.0, grid_hz=4.0, window_s=8.0)
#: Not looked at: what Python knows anyway, and poses, whose buffers are made twice as large now and then.
SHARED = (types.ModuleType, type, types.FunctionType, types.BuiltinFunctionType, MeasuredTrajectory)


def size_of(root, without=()) -> int:
    """Bytes of all that can be reached from an object but not through others, each array with all of its memory."""
    seen = {id(o) for o in without}
    waiting, total = [root], 0
    while waiting:
        o = waiting.pop()
        if id(o) in seen or isinstance(o, SHARED):
            continue
        seen.add(id(o))
        total += sys.getsizeof(o)
        if isinstance(o, np.ndarray) and isinstance(o.base, np.ndarray):
            waiting.append(o.base)
        waiting += gc.get_referents(o)
    return total


def flown(strips):
    """Short strips side by side."""
    plan = FlightPlan(
        strips=strips, strip_s=9.0, height_m=400.0, relief_m=10.0, sidelap=0.4, turns=False, gap_s=9.0, lead_in_s=3.0,
        lead_out_s=2.0,
    )  # fmt: skip
    simulation = simulate(plan, 5, SENSORS, ObservationPlan(tie_points_per_s=4.0, control=2, check=2))
    return simulation, list(navigate(simulation))


@pytest.fixture(scope="module")
def flight():
    """Many strips."""
    return flown(9)


@pytest.mark.study
def test_what_the_window_keeps_does_not_grow_with_the_flight(flight, monkeypatch):
    """Measured in the turns, when the window is empty and the block holds as much as it may."""
    monkeypatch.setattr(window_archive, "BLOCK_UNKNOWNS", 200)
    simulation, _ = flight
    before_s = [strip.first_line_time_s - 0.6 for strip in simulation.flight.strips[1:]]
    sizes: list[dict[str, int]] = []

    def watch(now_s, window):
        if before_s and now_s >= before_s[0]:
            del before_s[0]
            assert not len(window.network.batches) and window._block._work is None
            # every part reaches the network, which is looked at by itself
            others = {name: () if name == "network" else (window.network,) for name in vars(window)}
            sizes.append({name: size_of(part, others[name]) for name, part in vars(window).items()})

    adjust_online(*flight, OPTIONS, live=False, watch=watch, update_s=0.5)
    assert len(sizes) == 8
    early, late = sizes[3], sizes[7]
    growth = {name: (late[name] - early[name]) / 4.0 for name in late}  # a strip
    # for life: the strip's place among the strips, and a place in the table for the number of each unknown
    assert {name: round(g) for name, g in growth.items() if g > 10_000.0} == {}


def test_exposed_observations_are_those_of_batches_in_the_window():
    """Also where updates are rare, so that batches change and leave in the same one."""
    gone: list[int] = []

    def watch(_, window):
        present = {id(b) for b in window.network.batches}
        gone.append(sum(key not in present for key in window._quality.integrity._of_batch))

    result = adjust_online(*flown(3), OPTIONS, live=False, watch=watch, update_s=3.0)
    assert len(result.final) and not any(gone)


@pytest.mark.study
def test_the_work_of_a_turn_is_done_in_portions_or_before_points_are_looked_up(flight, monkeypatch):
    """With next to no time for it, a strip's work waits for the next one's points, and gives the same."""
    at_leisure = adjust_online(*flight, OPTIONS, live=False, update_s=0.5)
    monkeypatch.setattr(window_block, "RATE", 1.0)
    monkeypatch.setattr(window_block, "MOST_TOLD", 1)
    under_way = []
    hurried = adjust_online(
        *flight, OPTIONS, live=False, update_s=0.5, watch=lambda _, w: under_way.append(w._block._work is not None)
    )
    assert sum(under_way) > 40  # most of the turns
    assert len(hurried.final) == len(at_leisure.final)
    for a, b in zip(hurried.final, at_leisure.final, strict=True):
        assert np.array_equal(a.position_l, b.position_l) and np.array_equal(a.covariance, b.covariance)
    whole = [{(o.strip, float(o.time_s[0])): o for o in r.whole} for r in (hurried, at_leisure)]
    assert whole[0].keys() == whole[1].keys()
    assert all(np.array_equal(o.position_l, whole[1][key].position_l) for key, o in whole[0].items())
