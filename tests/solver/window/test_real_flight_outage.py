"""Real motion with 5 % outliers and 20 s without GNSS: on line against the causal batch.

The causal batch is asked, for each time, when the on-line answer for it has become final, and has everything that had
arrived by then: a window that lets nothing go, with the outliers never measured and nothing tested.
"""

from dataclasses import replace

import numpy as np
import pytest
from places import MOTION, needs_motion

from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors
from triline.solver.window.results import WindowOptions

pytestmark = needs_motion
NEVER = 1e6
OUTAGE_S = (130.0, 150.0)
UPDATE_S = 2.0


@pytest.fixture(scope="module")
def flight():
    settings = {"motion": str(MOTION), "from": 300.0, "seconds": 260.0, "seed": 11, "as_sensors": True}
    simulation = simulated_flight({**settings, "outliers": 0.05, "ties": 2.5}).simulation
    heard = (simulation.gnss_time_s < OUTAGE_S[0]) | (simulation.gnss_time_s > OUTAGE_S[1])
    simulation = replace(
        simulation, gnss_time_s=simulation.gnss_time_s[heard], gnss_geodetic=simulation.gnss_geodetic[heard]
    )
    return simulation, navigate(simulation)


@pytest.mark.study
def test_on_line_is_as_good_as_the_causal_batch_without_the_outliers(flight):
    simulation, poses = flight
    assert 0.03 < simulation.images.outlier.mean() < 0.07
    online = adjust_online(simulation, poses, WindowOptions(grid_hz=2.0), live=False, update_s=UPDATE_S)
    errors = orientation_errors(simulation, online.final)
    length = online.window.length_s
    due = errors.time_s[errors.time_s < simulation.flight.strip_times_s[0, 1] - length]
    assert len(due) > 100 and ((due > OUTAGE_S[0]) & (due < OUTAGE_S[1])).sum() > 20
    causal = {}

    def watch(now, window):
        for time in [t for t in due if t not in causal and now - length >= t]:
            answer = window.live(float(time))
            if answer is not None:
                causal[time] = answer

    clean = replace(simulation, images=simulation.images.select(~simulation.images.outlier))
    options = WindowOptions(window_s=NEVER, settle_s=NEVER, snoop=False)
    adjust_online(clean, poses, options, live=False, update_s=UPDATE_S, watch=watch)
    batch = orientation_errors(simulation, [causal[t] for t in sorted(causal)])
    mine = np.isin(errors.time_s, batch.time_s)
    assert mine.sum() == len(batch.time_s) > 100
    ours = np.sqrt(np.mean(errors.error[mine] ** 2, axis=0))
    for part in (slice(0, 3), slice(3, 6)):
        ratio = np.linalg.norm(ours[part]) / np.linalg.norm(batch.rmse[part])
        assert 0.8 < ratio < 1.05, f"{ratio:.3f}: {ours} against {batch.rmse}"
    outliers = int(simulation.images.outlier.sum())
    rejected = sum(r.reason == "snooping" for r in online.refused)
    assert 0.8 * outliers < rejected < 2.0 * outliers  # of two rays both go
