"""Spoilt image lines: told, survived, and honest about what is left."""

import matched_flight
import numpy as np
import pytest

from triline.solver.matching.options import MatchingOptions
from triline.solver.simulation.matching_study import BLOCK, match_strip, tie_errors


@pytest.fixture(scope="module")
def flown():
    return matched_flight.flown()


@pytest.fixture(scope="module")
def images():
    return matched_flight.images()


@pytest.fixture(scope="module")
def clean():
    """Ties of lines that are as they should be."""
    return matched_flight.clean()


@pytest.mark.study
def test_points_of_two_views_do_without_the_third(flown, images):
    dark = [np.zeros_like(images[0]), images[1], images[2]]
    found = match_strip(flown.simulation.flight, dark, options=MatchingOptions(least_rays=2))
    error, _ = tie_errors(flown.simulation.flight, found.ties)
    assert len(found.ties) > 60 and {ray.ccd for tie in found.ties for ray in tie.rays} == {"N", "B"}
    assert (np.hypot(*error.T) < 0.3).mean() > 0.95
    assert found.matcher.counters["looks never came"] == 0


@pytest.mark.study
@pytest.mark.parametrize(
    "dead_s",
    [
        pytest.param((0.0, 99.0), id="from the start"),
        pytest.param((8.0, 99.0), id="dies"),
        pytest.param((8.0, 14.0), id="a while"),
    ],
)
def test_without_the_nadir_line_ties_begin_in_the_next_steepest(flown, images, clean, dead_s):
    strip = flown.simulation.flight.strips[0]
    nadir, (first, end) = images[1].copy(), np.multiply(dead_s, strip.line_rate_hz).astype(int)
    nadir[first:end] = 0
    found = match_strip(flown.simulation.flight, [images[0], nadir, images[2]])
    error, sigma = tie_errors(flown.simulation.flight, found.ties)
    length = np.hypot(*error.T)
    assert len(found.ties) > 0.75 * len(clean)
    assert (length < 0.3).mean() > 0.98 and (length > 2.0).mean() < 0.01
    assert 0.5 < ((error / sigma)[length < 2] ** 2).mean() < 1.3
    assert len({tie.name for tie in found.ties}) == len(found.ties)
    begun = np.array([(tie.rays[0].ccd == "N", tie.rays[0].line) for tie in found.ties])
    assert not ((begun[:, 0] == 1) & (begun[:, 1] >= first) & (begun[:, 1] < end)).any()
    assert {tie.rays[0].ccd for tie in found.ties} == ({"B"} if first == 0 else {"N", "B"})
    # ties that are through come without a long pause: some patience, what is told the other way, ten to be judged by
    known_s = np.sort(found.came_line) / strip.line_rate_hz
    assert np.diff(known_s).max() < 4.0
    assert known_s[-1] > 24.0
    assert sum("N sees nothing: tie points begin in B" in text for text in found.told) == 1
    assert sum("N sees again: tie points begin in N" in text for text in found.told) == (end < len(nadir))
    if end < len(nadir):
        assert (begun[begun[:, 0] == 1, 1] > end).sum() > 10 and len(found.matcher._at_work) == 1


def test_bad_imagery_is_told_and_survived(flown, images):
    bad = [image[:850].copy() for image in images]
    bad[0][300:340] = 0
    bad[2][480:540] = bad[2][480]
    bad[1][700:706] = 4095
    lost = [np.zeros(len(image), dtype=bool) for image in bad]
    lost[1][640 : 640 + BLOCK] = True
    found = match_strip(flown.simulation.flight, bad, lost=lost)
    error, _ = tie_errors(flown.simulation.flight, found.ties)
    length = np.hypot(*error.T)
    assert len(found.ties) > 40 and (length < 0.3).mean() > 0.95 and (length > 2.0).mean() < 0.01
    assert found.matcher.counters["lines dark"] == 40 and found.matcher.counters["lines frozen"] == 59
    assert found.matcher.counters["lines saturated"] == 6 and found.matcher.counters["lines missing"] == BLOCK
    missing = f"N: {BLOCK} lines are missing"
    for words in ("F: lines are black", "F: lines are good again", "B: lines are frozen", missing):
        assert any(words in text for text in found.told), words


def lost_in_threes(images, share):
    """Which lines of each image are lost, three at a time, so large a share of all."""
    rng = np.random.default_rng(7)
    return [np.convolve(rng.random(len(image)) < share / 3, np.ones(3))[: len(image)] > 0 for image in images]


def spoilt_pixels(images, kind):
    """Images with 2 % of dead columns, or with so much light that 2 to 6 % of the pixels are saturated."""
    rng = np.random.default_rng(8)
    out = []
    for image, more in zip(images, (1.0, 1.15, 0.9), strict=True):
        image = image.copy()
        if kind == "dead columns":
            bad = rng.random(image.shape[1]) < 0.02
            image[:, bad] = rng.choice([0, 4095], bad.sum())
        else:
            image = np.clip(image * (more * 4095 / np.quantile(image, 0.98)), 0, 4095).astype(image.dtype)
        out.append(image)
    return out


@pytest.mark.parametrize(
    "fault",
    [
        "lost",
        *(pytest.param(fault, marks=pytest.mark.study) for fault in ("black", "frozen", "dead columns", "saturated")),
    ],
)
def test_a_few_pixels_that_were_not_measured_cost_few_ties_and_no_honesty(flown, images, clean, fault):
    if fault == "lost":  # what every run of the tests looks at: more than half of the flight
        images = [image[:850] for image in images]
        clean = [tie for tie in clean if max(ray.line for ray in tie.rays) < 850]
    lost = lost_in_threes(images, 0.05)
    assert all(0.035 < mask.mean() < 0.065 for mask in lost)
    if fault == "lost":
        found = match_strip(flown.simulation.flight, images, lost=lost)
        # of the newest ones it is not known yet
        assert found.matcher.counters["lines missing"] == pytest.approx(sum(mask.sum() for mask in lost), abs=9)
    elif fault in ("dead columns", "saturated"):
        found = match_strip(flown.simulation.flight, spoilt_pixels(images, fault))
    else:
        bad = [image.copy() for image in images]
        for image, mask in zip(bad, lost, strict=True):
            for line in np.flatnonzero(mask):
                image[line] = 0 if fault == "black" else image[line - 1]
        found = match_strip(flown.simulation.flight, bad)
    error, sigma = tie_errors(flown.simulation.flight, found.ties)
    length = np.hypot(*error.T)
    assert len(found.ties) > 0.7 * len(clean)
    assert (length < 0.3).mean() > 0.98 and (length > 2.0).mean() < 0.01
    assert 1.4826 * np.median(np.abs(error)) < 0.06
    assert 0.5 < ((error / sigma)[length < 2] ** 2).mean() < 1.3


def test_featureless_ground_gives_no_ties_and_is_told(flown, images):
    rng = np.random.default_rng(1)
    water = [rng.normal(300, 5, image[:900].shape).astype(np.uint16) for image in images]
    short = [np.concatenate([w, image[900:1000]]) for w, image in zip(water, images, strict=True)]
    found = match_strip(flown.simulation.flight, [image[:900] for image in short])
    assert not found.ties and found.matcher.counters["ties"] == 0
    assert any("poor in texture" in text for text in found.told)
