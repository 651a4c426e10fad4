"""What the window does when hangs on platform time, not on how many updates there are."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import OnlineResult, adjust_online, navigate
from triline.solver.window.leaving import LEAVING_S
from triline.solver.window.results import WindowOptions
from triline.solver.window.window import LOOK_AFTER, QUESTION, RETEST, SOURCES, TURN_S, WATCH, Duties, Window


def turns(interval_s: float, seconds: float = 30.0, busy: float = 0.0) -> dict[str, list[float]]:
    """When each part was done; a share of the updates is busy with other work."""
    duties, rng = Duties(), np.random.default_rng(1)
    done: dict[str, list[float]] = {part: [] for part in TURN_S}
    for k in range(int(seconds / interval_s)):
        parts = duties.take(k * interval_s, busy=bool(rng.uniform() < busy))
        assert interval_s >= 0.1 or k == 0 or len(parts) <= 1
        for part in parts:
            done[part].append(k * interval_s)
    return done


@pytest.mark.parametrize("interval_s", [0.012, 0.024, 0.05])
def test_work_that_can_wait_is_done_as_often_whatever_the_batches(interval_s: float) -> None:
    done = turns(interval_s)
    # 20 updates a second have no place for 25 turns: all parts are late by the same share
    crowded = max(1.0, interval_s * sum(1.0 / every_s for every_s in TURN_S.values()))
    assert crowded < 1.3
    for part, every_s in TURN_S.items():
        gaps = np.diff(done[part])
        assert every_s - 1e-6 < gaps.min()
        assert gaps.max() < crowded * every_s + max(3.0 * interval_s, 0.2 * every_s) + 1e-6


def test_updates_that_do_not_hurry_do_all_that_is_due() -> None:
    done = turns(0.2)
    often = {LOOK_AFTER: 150, RETEST: 150, QUESTION: 30, WATCH: 75, SOURCES: 30}
    assert {part: len(done[part]) for part in TURN_S} == often
    assert np.diff(done[WATCH]) == pytest.approx(0.4)
    assert np.diff(done[QUESTION]) == pytest.approx(1.0)


def test_other_work_puts_it_off_but_not_for_long() -> None:
    free, busy, always = turns(0.024), turns(0.024, busy=0.2), turns(0.024, busy=1.0)
    for part, every_s in TURN_S.items():
        assert len(busy[part]) > 0.85 * len(free[part])
        assert np.diff(always[part]).max() < 2.0 * every_s + 0.1


@pytest.mark.study
def test_what_is_old_leaves_a_little_at_a_time() -> None:
    """Points that are completed together were seen first at different times: at the border of a segment many batches
    are old at once."""
    plan, points = FlightPlan(strip_s=42.0, lead_in_s=4.0), ObservationPlan(tie_points_per_s=60.0)
    simulation = simulate(plan, 1, observation_plan=points)
    length_s, end_s = 26.0, simulation.flight.strip_times_s[0][1]
    final: list[int] = []
    late_s: list[float] = []

    def watch(now: float, window: Window) -> None:
        if now < end_s:
            late_s.append(now - length_s - min((b.oldest_s for b in window.network.batches), default=np.inf))

    def so_far(now: float, result: OnlineResult) -> None:
        if now < end_s:
            final.append(len(result.final_points))

    options = WindowOptions(window_s=length_s, snoop=False)
    adjust_online(simulation, navigate(simulation), options, live=False, watch=watch, so_far=so_far)
    leaving = np.diff(final)
    assert leaving.sum() > 1000  # 12 in each update, on average
    assert leaving.max() < 65  # 80 at the border of a segment, if all that is old leaves at once
    assert max(late_s) < LEAVING_S


@pytest.mark.study
def test_results_do_not_hang_on_the_size_of_batches() -> None:
    """Two points an update, or forty: the same final orientation, where both know the same when it becomes final."""
    simulation = simulate(FlightPlan(strip_s=26.0, lead_in_s=4.0), 3, observation_plan=ObservationPlan(40.0))
    poses, options = navigate(simulation), WindowOptions(window_s=60.0, grid_hz=2.0)
    found = []
    for update_s in (0.05, 1.0):
        final = adjust_online(simulation, poses, options, live=False, update_s=update_s).final
        values = np.concatenate([np.hstack([o.position_l, o.angles]) for o in final])
        found.append((values, np.concatenate([np.sqrt(np.einsum("nii->ni", o.covariance)) for o in final])))
    (few, sigma), (many, sigma_of_many) = found
    assert len(few) > 50
    assert np.abs((few - many) / sigma).max() < 0.05
    assert np.abs(np.log(sigma_of_many / sigma)).max() < 0.01
