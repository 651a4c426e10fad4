"""Seams: the least cut, tiles that keep what their neighbours decided, feathering, lines."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from triline.solver.orthoimage import seams


def _energy(labels, cost, difference) -> float:
    """What `seam_labels` makes small, for few nodes."""
    seam = np.where(np.isfinite(difference), np.minimum(difference, seams.MOST_DIFFERENCE), seams.UNKNOWN_DIFFERENCE)
    total = 0.0
    for (i, j), a in np.ndenumerate(labels):
        total += cost[a, i, j]
        for p, q in ((i + 1, j), (i, j + 1)):
            if p < labels.shape[0] and q < labels.shape[1] and labels[p, q] != a:
                total += seam[a, labels[p, q], i, j] + seam[a, labels[p, q], p, q] + 2 * seams.LENGTH_COST
    return total


@pytest.mark.parametrize("seed", range(6))
def test_two_labels_have_the_least_energy_of_all(seed):
    rng = np.random.default_rng(seed)
    shape = (3, 4)
    cost = rng.uniform(0, 4, (2, *shape))
    d = rng.uniform(0, 3, shape)
    difference = np.zeros((2, 2, *shape))
    difference[0, 1] = difference[1, 0] = d
    found = seams.seam_labels(cost, difference)
    every = (np.array(bits).reshape(shape) for bits in itertools.product((0, 1), repeat=12))
    least = min(_energy(labels, cost, difference) for labels in every)
    assert _energy(found, cost, difference) == pytest.approx(least, abs=0.2)  # costs are whole 64ths


def _overlap(rows: int = 40, columns: int = 60):
    """Two strips side by side that share columns 20 to 39."""
    known = np.zeros((2, rows, columns), dtype=bool)
    known[0, :, :40] = known[1, :, 20:] = True
    x = np.arange(columns)
    off = np.clip(np.abs(np.stack([x - 19.5, x - 39.5])) / 20.0, 0, 1)[:, None] * np.ones((1, rows, 1))
    difference = np.full((2, 2, rows, columns), np.nan)
    difference[0, 1, :, 20:40] = difference[1, 0, :, 20:40] = 1.0
    return known, off, difference


def test_a_seam_goes_round_what_differs():
    known, off, difference = _overlap()
    difference[:, :, 10:25, 26:34] = np.where(np.isfinite(difference[:, :, 10:25, 26:34]), 15.0, np.nan)
    labels = seams.seam_labels(seams.label_cost(known, off, None), difference)
    assert (labels[:, :20] == 0).all() and (labels[:, 40:] == 1).all()
    assert len(np.unique(labels[10:25, 26:34])) == 1
    (line,) = seams.seam_lines(labels)
    assert line.labels == (0, 1) and {line.corners[0, 0], line.corners[-1, 0]} == {0, 40}


def test_neighbours_keep_their_labels_and_the_seam_goes_on():
    known, off, difference = _overlap()
    fixed = np.full(known.shape[1:], -1)
    fixed[0, :23], fixed[0, 23:] = 0, 1
    labels = seams.seam_labels(seams.label_cost(known, off, None), difference, fixed)
    np.testing.assert_array_equal(labels[0], fixed[0])
    assert np.abs(np.diff((labels == 0).sum(axis=1))).max() <= 20 and len(seams.seam_lines(labels)) == 1


def test_a_better_known_strip_is_shown_farther():
    known, off, difference = _overlap()
    cost = [seams.label_cost(known, off, np.stack([np.full((40, 60), a), np.full((40, 60), 0.3)])) for a in (0.3, 0.6)]
    even, worse = (seams.seam_labels(c, difference) for c in cost)
    assert (even == 0).sum() > (worse == 0).sum() > 0


def test_feathering_is_a_ramp_and_ends_at_edges():
    known, _, _ = _overlap()
    labels = np.where(np.arange(60) < 30, 0, 1) * np.ones((40, 1), dtype=int)
    weight = seams.feather_weights(labels, known, 8)
    np.testing.assert_allclose(weight.sum(axis=0), 1.0, rtol=1e-6)
    ramp = weight[0, 20]
    assert ramp[20] == 1 and ramp[39] == 0 and (np.diff(ramp) <= 1e-6).all() and 0.3 < ramp[29] < 0.7
    assert np.abs(np.diff(ramp)).max() < 0.2
    hard = seams.feather_weights(labels, known, 1)
    np.testing.assert_array_equal(hard[0] == 1, labels == 0)


def test_a_lone_cell_of_an_orthoimage_has_no_weight_in_a_wide_transition():
    known = np.ones((2, 40, 60), dtype=bool)
    known[1, 30:] = False
    labels = np.zeros((40, 60), dtype=int)
    labels[5, 7] = 1
    weight = seams.feather_weights(labels, known, 150)  # a share of 1 / 150^2 of the cells around it
    assert (weight[0] == 1).all() and (weight[1] == 0).all()


def test_lines_end_where_three_meet_and_borders_belong_to_one_tile():
    labels = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 2, 2]])
    assert sorted(line.labels for line in seams.seam_lines(labels)) == [(0, 1), (0, 2), (1, 2)]
    assert [line.labels for line in seams.seam_lines(np.array([[0, 0], [1, 1]]), shared=True)] == [(0, 1)]
    assert not seams.seam_lines(np.array([[0, 0], [0, 1]]), shared=True)
