"""Lines as they come: the ring that keeps them, lanes of a small budget, bad lines told apart and summed up."""

import numpy as np
import pytest

from triline.solver.matching.line_intake import LineIntake
from triline.solver.matching.line_quality import IS_DARK, IS_FROZEN, IS_PARTLY_SATURATED, IS_SATURATED, judge_lines
from triline.solver.matching.line_store import LineRing, LineStore
from triline.solver.matching.options import MatchingOptions


def test_a_ring_keeps_the_newest_lines_and_knows_the_missing_ones():
    ring = LineRing(4, 10)
    lines = np.arange(40, dtype=np.uint16).reshape(10, 4)
    assert ring.add(5, lines[:6]) == (0, 0)
    assert ring.add(14, lines[:3]) == (3, 0)
    assert ring.add(15, lines[:4]) == (0, 2)
    got = ring.read(0, 100)
    assert (got.first_line, len(got.pixels)) == (9, 10)
    np.testing.assert_array_equal(got.usable, [1, 1, 0, 0, 0, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(got.filled, ~got.usable)
    np.testing.assert_array_equal(got.pixels[2:5], np.rint(np.linspace(lines[5], lines[0], 5)[1:4]))
    np.testing.assert_array_equal(got.pixels[-1], lines[3])
    values, lines_known, samples_known, filled = ring.windows(np.array([13, 17]), np.array([-1, 2]), 3, 3)
    np.testing.assert_array_equal(lines_known, [[1, 1, 1], [1, 1, 0]])
    np.testing.assert_array_equal(filled, [[1, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(samples_known, [[0, 1, 1], [1, 1, 0]])
    assert values[0, 1, 1] == lines[0, 0] and values[1, 1, 0] == lines[3, 2]
    # a long gap stays one
    assert ring.add(28, lines[:1]) == (9, 0)
    assert not ring.read(0, 100).filled.any() and ring.read(0, 100).usable.sum() == 1
    store = LineStore({"F": 100, "N": 100}, {"F": 300, "N": 100}, 40_000)
    assert store.nbytes <= 40_000 and store.rings["F"].capacity == pytest.approx(3 * store.rings["N"].capacity, abs=3)
    with pytest.raises(ValueError, match="too small"):
        LineStore({"F": 1000}, {"F": 100}, 1000)


def test_a_small_budget_keeps_lanes_of_the_lines():
    samples, lines = {"N": 12000, "F": 12000, "B": 12000}, {"N": 900, "F": 2000, "B": 400}
    seen = {ccd: np.arange(12000) + off for ccd, off in (("N", 0.0), ("F", 300.0), ("B", -200.0))}
    store = LineStore(samples, lines, 30_000_000, counterpart=seen)
    assert store.nbytes <= 30_000_000 and store.share == 1 and 0.2 < store.cover < 0.5
    assert store.nbytes > 0.8 * 30_000_000
    off = [store.rings[ccd].lanes[2, 0] - store.lanes[2, 0] for ccd in "FB"]
    assert off == [300, -200]
    rng = np.random.default_rng(1)
    block = rng.integers(0, 4000, (700, 12000)).astype(np.uint16)
    for first in (0, 700, 1400):  # around the end of the ring
        store.rings["F"].add(first, block)
    left, right = store.rings["F"].lanes[1]
    values, known, across, _ = store.rings["F"].windows(np.array([1990]), np.array([left - 5]), 4, 20)
    assert known.all() and not across[0, :5].any() and across[0, 5:].all()
    np.testing.assert_array_equal(values[0, :, 5:], block[590:594, left : left + 15])
    np.testing.assert_array_equal(store.rings["F"].read(1990, 1994, left, right).pixels, block[590:594, left:right])
    assert LineStore(samples, lines, 100_000_000).cover == 1


def test_bad_lines_are_told_apart():
    rng = np.random.default_rng(1)
    lines = rng.integers(500, 3000, (5, 600)).astype(np.uint16)
    lines[1], lines[2], lines[4] = rng.integers(0, 50, 600), 4095, lines[3]
    np.testing.assert_array_equal(judge_lines(lines, None, 4095), [0, IS_DARK, IS_SATURATED, 0, IS_FROZEN])
    lines[3, :300] = 4095  # a cloud: told, and used beside it
    assert judge_lines(lines, None, 4095)[3] == IS_PARTLY_SATURATED
    intake = LineIntake({"N": 600}, MatchingOptions(), lambda dtype: None)
    intake.begin_strip(100.0)
    assert intake.add("N", 0, lines[:4]).tolist() == [True, False, False, True]
    assert any("partly saturated" in text for text in intake.take_events())


@pytest.mark.parametrize(("bits", "full_scale"), [(12, 4095), (14, 16_383), (16, 65_535)])
def test_bright_pixels_of_14_and_16_bits_are_not_saturated(bits, full_scale):
    rng = np.random.default_rng(3)
    intake = LineIntake({"N": 600}, MatchingOptions(), lambda dtype: None)
    intake.begin_strip(100.0)
    dim, bright = (
        rng.integers(low, high, (20, 600)).astype(np.uint16) << (bits - 12) for low, high in ((200, 900), (800, 3900))
    )
    dim[5, 300] = 65_535 if bits == 12 else 0  # one wrong bit makes no other camera
    assert intake.add("N", 0, dim).all() and intake.add("N", 20, bright).all()
    assert intake.saturated == pytest.approx(0.995 * full_scale)
    told = intake.take_events()
    assert bool(told) == (bits > 12) and all(f"full scale is taken to be {full_scale}" in text for text in told[-1:])
    spoilt = bright.copy()
    spoilt[3] = full_scale
    assert intake.add("N", 40, spoilt).tolist() == [i != 3 for i in range(20)]
    stated = LineIntake({"N": 600}, MatchingOptions(full_scale=4095), lambda dtype: None)
    stated.begin_strip(100.0)
    assert stated.add("N", 0, bright).all() == (bits == 12)


@pytest.mark.parametrize("full_scale", [255, 4095, 16383, 65535])
def test_lines_of_any_depth_are_fit_for_use_but_where_they_are_saturated(full_scale):
    """A camera of 14 bits, or values of a range spread over 16 bits, are not all saturated."""
    rng = np.random.default_rng(3)
    kind = np.uint8 if full_scale == 255 else np.uint16
    bright = (rng.uniform(0.3, 0.9, (4, 300)) * full_scale).astype(kind)
    intake = LineIntake({"N": 300, "F": 300}, MatchingOptions(), lambda dtype: None)
    intake.begin_strip(100.0)
    assert intake.add("N", 0, bright).all()
    assert intake.saturated == pytest.approx(0.995 * full_scale)
    bright[2] = full_scale
    assert intake.add("N", 4, bright + (np.arange(4, dtype=kind)[:, None] % 2 == 1)).tolist() == [1, 1, 0, 1]
    # ground that is dark beside what the camera can bear is no lens cap, and what is known stays known
    shade = rng.integers(100 if full_scale > 255 else 20, 200, (4, 300)).astype(kind)
    assert intake.add("F", 0, shade).all() and intake.saturated == pytest.approx(0.995 * full_scale)
    stated = LineIntake({"N": 300}, MatchingOptions(full_scale=full_scale), lambda dtype: None)
    stated.begin_strip(100.0)
    assert not stated.add("N", 0, (0.01 * bright).astype(kind)).any() and stated.counters["lines dark"] == 4


def test_a_fault_that_comes_again_and_again_is_summed_up():
    intake = LineIntake({"N": 64}, MatchingOptions(), lambda dtype: None)
    intake.begin_strip(100.0)
    rng = np.random.default_rng(2)
    told = []
    for first in range(0, 6000, 10):
        pixels = rng.integers(500, 900, (10, 64)).astype(np.uint16)
        pixels[3] = 0
        usable = intake.add("N", first, pixels)
        assert usable.tolist() == [i != 3 for i in range(10)]
        told += intake.take_events()
    assert told[0] == "N: 1 line is black (lens cap, no light or no data) from 3 on"
    assert len(told) == 3 + 5 and "more lines are black" in told[-1]
    # nothing is lost but what the last ten seconds would sum up
    assert 3 + sum(int(text.split()[1]) for text in told[3:]) in range(500, 601)
    assert intake.counters["lines dark"] == 600
