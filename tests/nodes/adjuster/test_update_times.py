"""When the adjuster answers: by the stamps of what comes, soon where much comes, and no more often than it helps."""

from __future__ import annotations

import numpy as np
import pytest

from triline.nodes.adjuster.adjuster import WAIT_S, Adjuster
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.simulator.simulator import Simulator
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

EPOCH = 1_700_000_000_000_000_000
#: Of attitudes, and so of poses.
RATE_HZ = 200.0
#: Tie points are handed over from then on, s: a short time of a full flow of them is enough.
TIES_FROM_S = 11.3


def flown(ties_per_s):
    """What an adjuster gets of a low strip of 12 s, with tie points in its last seconds, looks at a point together."""
    plan = FlightPlan(height_m=700.0, strip_s=12.0, lead_in_s=1.0, lead_out_s=1.0)
    errors = ErrorModel(attitude_rate_hz=RATE_HZ)
    simulation = simulate(plan, 3, errors, ObservationPlan(tie_points_per_s=ties_per_s, check=0))
    navigator, messages = Navigator(), []
    for message in Simulator(simulation).messages(EPOCH):
        if message.topic in Navigator.inputs:
            messages += [o for o in navigator.step(message) if o.topic == "trajectory/filtered"]
        early = message.topic == "observation/tie" and message.stamp_ns < EPOCH + TIES_FROM_S * 1e9
        if message.topic in Adjuster.inputs and not early:
            messages.append(message)
    return messages


def times(messages, node):
    """Stamps of the updates, and of each tie point how long it waits for the first update after it, s."""
    updates, ties, rays = [], [], 0
    for message in messages:
        if message.topic == "observation/tie":
            ties.append(message.stamp_ns * 1e-9 - EPOCH * 1e-9)
            rays += len(message.body.images)
        for output in node.step(message):
            if output.topic == "adjustment/report":
                updates.append(message.stamp_ns * 1e-9 - EPOCH * 1e-9)
    updates, ties = np.array(updates), np.array(ties)
    after = np.searchsorted(updates, ties)
    known = after < len(updates)
    return updates, ties[known], updates[after[known]] - ties[known], rays / (ties[-1] - TIES_FROM_S)


def test_where_much_comes_no_image_point_waits_for_others():
    updates, ties, waits, rays_per_s = times(flown(110.0), Adjuster(pace="normal"))
    assert rays_per_s > 400.0
    # an update is due with the first message after the wait; poses come with RATE_HZ
    fast = ties > TIES_FROM_S + 0.5
    assert fast.sum() > 200 and np.percentile(waits[fast], 99) < WAIT_S + 1.5 / RATE_HZ
    within = updates[(updates > TIES_FROM_S + 0.5) & (updates < ties[-1])]
    assert len(within) / np.ptp(within) < 1.0 / WAIT_S + 5.0  # and with those at multiples of `update_s`


def test_where_little_comes_it_waits_for_its_time():
    updates, _, waits, rays_per_s = times(flown(2.0), Adjuster(pace="normal"))
    assert rays_per_s < 20.0
    assert np.median(np.diff(updates)) == pytest.approx(0.2, abs=0.02) and waits.max() < 0.25
