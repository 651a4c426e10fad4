"""The test at the door: what a point's looks alone, with the orientation's covariance, tell of gross errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from triline.solver.adjustment.reliability import CRITICAL_W
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.screening import arriving as module
from triline.solver.window.screening.entry import SUSPECTED, entry_weight


@pytest.fixture(scope="module")
def entering():
    """Batches of a clean flight with the equations of their points, as they came to the door."""
    simulation = simulate(
        FlightPlan(strip_s=24.0, lead_in_s=3.0, lead_out_s=2.0),
        6,
        ErrorModel(attitude_rate_hz=100.0),
        ObservationPlan(tie_points_per_s=8.0),
    )
    seen, refused = [], []
    admit = module.admit

    def watch(batch, equations, network):
        seen.append((batch, equations))
        refused.extend(found := admit(batch, equations, network))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "admit", watch)
        adjust_online(simulation, navigate(simulation), live=False)
    assert not refused
    return seen


def test_square_sums_of_good_points_are_chi_square(entering):
    below = []
    for batch, equations in entering:
        square, *_ = equations.test(equations.present, batch.control.weight)
        redundancy = 2 * equations.present.sum(axis=1) + (batch.control.weight > 0).sum(axis=1) - 3
        below += list(chi2.cdf(square, redundancy))
    assert len(below) > 150
    assert 0.42 < np.mean(below) < 0.58
    assert 0.2 < np.std(below) < 0.36  # 0.29 of a uniform distribution


class Spoilt:
    """A batch at the door, one look of one point moved by whitened (2,)."""

    def __init__(self, batch, equations, point, ray, by):
        residual = equations.residual.copy()
        residual[point, 2 * ray : 2 * ray + 2] += by
        moved = replace(equations, residual=residual)
        self.weight, self.w = entry_weight(batch, moved)
        self.of_point = self.weight[batch.rays.point == point]
        self.others = self.weight[batch.rays.point != point]


def test_a_bad_look_is_named_and_nothing_else_or_its_point_goes(entering):
    named = lost = 0
    rng = np.random.default_rng(1)
    for batch, equations in entering:
        for point in np.flatnonzero(equations.present.sum(axis=1) == 3):
            ray, direction = int(rng.integers(3)), rng.uniform(0, 2 * np.pi)
            by = 60.0 * np.array([np.cos(direction), np.sin(direction)])
            spoilt = Spoilt(batch, equations, point, ray, by)
            assert (spoilt.others == 1.0).all()
            expected = np.ones(3)
            expected[ray] = 0.0
            named += (spoilt.of_point == expected).all()
            lost += not spoilt.of_point.any()
            assert spoilt.w[batch.rays.point == point][ray] > CRITICAL_W
            assert (spoilt.of_point == expected).all() or not spoilt.of_point.any()
    assert named > 10 * max(lost, 1) and named > 30


def test_of_two_looks_that_contradict_each_other_none_enters(entering):
    batch, equations = next((b, e) for b, e in entering if (e.present.sum(axis=1) == 2).any())
    point = int(np.flatnonzero(equations.present.sum(axis=1) == 2)[0])
    results = [Spoilt(batch, equations, point, 0, by) for by in ([200.0, 0.0], [0.0, 200.0])]
    assert any(not r.of_point.any() for r in results)
    assert all(r.of_point.all() or not r.of_point.any() for r in results)


def test_three_looks_that_agree_stay_where_known_coordinates_are_wrong(entering):
    known = [(b, e, p) for b, e in entering for p in np.flatnonzero((b.control.weight > 0).all(axis=1))
             if e.present[p].sum() == 3]  # fmt: skip
    assert known
    for batch, equations, point in known:
        off = equations.off.copy()
        off[point, 2] += 47.0
        moved = replace(equations, off=off)
        square, *_ = moved.test(equations.present, batch.control.weight)
        assert square[point] > chi2.isf(SUSPECTED, 6)
        weight, _ = entry_weight(batch, moved)
        assert (weight[batch.rays.point == point] == 1.0).all()


def test_the_level_is_what_it_says():
    assert 0 < SUSPECTED < 1e-3
