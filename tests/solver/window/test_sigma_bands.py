"""Errors are as large as the sigmas say, so exactly that a sigma that is a fifth wrong would fail (`make study`)."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import cache

import numpy as np
import pytest

from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors, point_errors
from triline.solver.window.results import WindowOptions

pytestmark = pytest.mark.study
SEEDS = 60
#: Mean normalised errors squared that are accepted; a sigma that is a fifth too large or too small gives 0.69 or 1.56.
LOW, HIGH = 0.83, 1.2
#: Errors of one flight are correlated: so many standard deviations of the mean over flights may come on top.
SPREAD = 1.0
KINDS = ("final orientation", "whole orientation", "final points", "whole points")


def one(seed: int) -> list[float]:
    """Mean normalised errors squared of a flight, by `KINDS`."""
    plan = FlightPlan(strip_s=30.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(
        plan, seed, ErrorModel(attitude_rate_hz=50.0), ObservationPlan(tie_points_per_s=6.0, check=20)
    )
    online = adjust_online(simulation, navigate(simulation), WindowOptions(grid_hz=4.0), live=False, update_s=0.5)
    errors = [orientation_errors(simulation, o) for o in (online.final, online.whole)]
    errors += [point_errors(simulation, p) for p in (online.final_points, online.whole_points)]
    return [float(e.nees.mean()) for e in errors]


@cache
def flights() -> np.ndarray:
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one, range(1, SEEDS + 1))))


def in_band(nees: np.ndarray) -> bool:
    """Whether the mean over flights (n,) is accepted."""
    allowed = SPREAD * nees.std(ddof=1) / np.sqrt(len(nees))
    return bool(LOW - allowed < nees.mean() < HIGH + allowed)


@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_as_large_as_their_sigmas(kind):
    nees = flights()[:, KINDS.index(kind)]
    assert in_band(nees), f"{nees.mean():.3f} +- {nees.std(ddof=1) / np.sqrt(len(nees)):.3f}"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_sigma_that_is_a_fifth_wrong_fails(kind, factor):
    nees = flights()[:, KINDS.index(kind)]
    assert not in_band(nees / factor**2)
