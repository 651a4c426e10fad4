"""Control points spread out, and which adjustments check points can tell from the best."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from triline.solver.adjustment.confidence_set import LEAST_POINTS, confidence_set
from triline.solver.adjustment.control_choice import spread_choice, spread_order


def test_control_of_a_grid():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    order = spread_order(np.column_stack([x, y]))
    assert sorted(order) == list(range(25))
    assert set(order[:4]) == {0, 4, 20, 24} and order[4] == 12
    assert set(order[:9]) == {0, 2, 4, 10, 12, 14, 20, 22, 24}
    assert spread_choice(np.column_stack([x, y]), 1).tolist() == [12]
    assert spread_choice(np.column_stack([x, y]), 0).tolist() == []


def test_control_is_farther_apart_than_any_at_random():
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 1000.0, (60, 2))
    for number in (4, 9, 16):
        chosen = spread_choice(xy, number)
        assert set(chosen) < set(spread_choice(xy, number + 1))
        apart = pdist(xy[chosen]).min()
        others = [pdist(xy[rng.choice(60, number, replace=False)]).min() for _ in range(300)]
        assert apart > np.quantile(others, 0.99)


def test_few_and_equal_points():
    assert spread_order(np.empty((0, 2))).tolist() == [] and spread_order([[1.0, 2.0]]).tolist() == [0]
    assert sorted(spread_order(np.ones((4, 2)))) == [0, 1, 2, 3]
    assert spread_order([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0]]).tolist() == [0, 2, 1]
    with pytest.raises(ValueError, match="wanted 0 to 1, got 2"):
        spread_choice([[1.0, 2.0]], 2)
    with pytest.raises(ValueError, match="wanted finite coordinates"):
        spread_order([[1.0, np.nan]])


@pytest.mark.parametrize(("points", "number"), [(LEAST_POINTS, 8), (10, 30), (25, 8)])
def test_equal_adjustments_are_kept_and_a_worse_one_is_not(points, number):
    """All of equally good ones are in the set as often as the level says; errors are alike from one to the other."""
    rng = np.random.default_rng(points)
    draws, kept, out = 80, 0, 0
    for _ in range(draws):
        error = rng.normal(size=(points, 3)) + 0.4 * rng.normal(size=(number, points, 3))
        kept += bool(confidence_set(np.linalg.norm(error, axis=-1)).all())
        error[0] *= 2.5
        found = confidence_set(np.linalg.norm(error, axis=-1))
        out += not found[0]
        assert found.any()
    assert 0.86 < kept / draws < 1.0
    assert out / draws > (0.85 if points == LEAST_POINTS else 0.95)


def test_the_same_adjustment_twice_and_too_few_points():
    loss = np.abs(np.random.default_rng(2).normal(size=(1, 20)))
    assert confidence_set(np.repeat(loss, 3, axis=0)).all()
    assert confidence_set(loss).all()
    assert confidence_set([[1.0] * (LEAST_POINTS - 1), [9.0] * (LEAST_POINTS - 1)]).all()
    # constant differences have no scatter: what is always worse is out
    assert confidence_set(np.vstack([loss, loss + 1.0, loss])).tolist() == [True, False, True]
    with pytest.raises(ValueError, match="finite"):
        confidence_set([[1.0, np.nan]])
