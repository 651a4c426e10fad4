"""Ground whose height nobody states is looked for: the ties of a flight are the same wherever it lies."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.matching.height_guess import HeightGuess
from triline.solver.simulation.imagery import LineImager
from triline.solver.simulation.matching_study import match_strip, tie_errors
from triline.solver.simulation.terrain import Terrain

LOWEST_M = -700.0


@functools.cache
def flown():
    settings = {"sensor": "ads40-small", "pixels": 400, "images": True, "seconds": 11.0, "height": 400.0}
    made = simulated_flight({**settings, "lead_in": 2.0, "seed": 6, "relief": 20.0})
    lines = made.simulation.flight.strips[0].lines
    return made.simulation.flight, [made.imager.render(0, ccd, 0, lines) for ccd in range(3)]


def raised(flight, by_m):
    """The same flight over the same ground, all of it so much higher in the local frame."""
    truth = flight.truth
    truth = Trajectory(truth.time_s, truth.position_l + np.array([0, 0, by_m]), truth.quaternion)
    terrain = replace(flight.terrain, height_m=flight.terrain.height_m + by_m)
    strips = tuple(replace(strip, trajectory=truth) for strip in flight.strips)
    return replace(flight, truth=truth, terrain=terrain, strips=strips)


@functools.cache
def matched(by_m):
    """Ties, and the flight, where the ground is not known and thought to be at 0."""
    flight, images = flown()
    flight = raised(flight, by_m)
    return match_strip(flight, images, ground=LOWEST_M), flight


@pytest.mark.parametrize("by_m", [1000.0, *(pytest.param(z, marks=pytest.mark.study) for z in (300.0, 2500.0, -500.0))])
def test_the_ties_are_the_same_at_whatever_height_the_ground_is(by_m):
    (there, flight), (here, _) = matched(by_m), matched(0.0)
    assert len(here.ties) > 30 and abs(len(there.ties) - len(here.ties)) <= 0.05 * len(here.ties)
    heights = np.array([tie.xyz_l[2] for tie in there.ties])
    assert abs(np.median(heights) - by_m) < 60.0
    error, sigma = tie_errors(flight, there.ties)
    assert np.median(np.abs(error / sigma)) < 1.2 and np.abs(error).max() < 1.0
    (told,) = [text for text in there.told if "ground" in text]
    assert told.startswith("the ground was found at about") and told.endswith("m in the local frame, not at 0 m")


def test_ground_where_it_is_thought_to_be_is_found_without_a_word():
    found, flight = matched(0.0)
    stated = match_strip(flight, flown()[1])
    assert abs(len(found.ties) - len(stated.ties)) < 0.15 * len(stated.ties)
    assert found.came_line[0] <= stated.came_line[0] + 100 and not found.told


def test_images_of_something_else_find_no_ground_and_are_given_up_in_time():
    flight, images = flown()
    mirrored = [image if ccd == 1 else image[:, ::-1] for ccd, image in enumerate(images)]
    strip = match_strip(flight, mirrored, ground=LOWEST_M)
    assert not strip.ties and strip.matcher.ground_m is None
    assert strip.matcher.counters["ground not found"] > 20 and not strip.told


def test_heights_that_lead_nowhere_are_forgotten():
    guess = HeightGuess(0.0, 60.0)
    guess.found(np.array([[0, 0, 900.0], [10, 0, 910.0], [0, 10, 905.0]]))
    assert not guess.unknown and guess.prior_m == 905.0
    np.testing.assert_allclose(guess.at(np.array([[1.0, 1.0]]))[0], 901.0, atol=4.0)
    guess.lose(1000.0)
    assert guess.unknown and guess.prior_m == guess.lowest_m == 905.0
    assert guess.at(np.array([[1.0, 1.0]]))[1] == 60.0


def relief(flight, range_m, longest_m=12000.0):
    """The flight over mountains: heights of so many metres from top to bottom, in waves."""
    length = longest_m * np.array([1.0, 0.7, 0.45])
    azimuth = np.radians([10.0, 80.0, -30.0])
    wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    terrain = Terrain(0.0, wave, np.array([0.5, 1.5, 5.0]), 0.5 * range_m * np.array([0.6, 0.25, 0.15]))
    return replace(flight, terrain=terrain)


@functools.cache
def over_mountains(range_m, *, sea_until_m=None):
    """Ties of a strip of 10 km, 2 500 m above the mean height of the ground, which is not known; and the flight."""
    settings = {"sensor": "ads40-small", "pixels": 500, "images": True, "seconds": 50.0, "height": 2500.0}
    made = simulated_flight({**settings, "speed": 200.0, "lead_in": 2.0, "seed": 3, "relief": 50.0})
    flight = relief(made.simulation.flight, range_m)
    imager = LineImager(flight, made.imager.texture, made.imager.seed, made.imager.plan)
    images = [imager.render(0, ccd, 0, flight.strips[0].lines) for ccd in range(3)]
    if sea_until_m is not None:
        images = [_sea(flight, ccd, image, sea_until_m) for ccd, image in enumerate(images)]
    return match_strip(flight, images, ground=-1500.0), flight


def _sea(flight, ccd, image, until_m):
    """The image with dull water where a line looks at the first part of the strip."""
    strip, camera = flight.strips[0], flight.camera
    time_s = strip.time_of(np.arange(len(image)))
    poses = flight.truth.at(time_s)
    middle = camera.lines[ccd].pixels // 2
    xy = camera.image_coordinates(np.array([ccd]), np.array([middle]))[0][0]
    ray = poses.R_lc @ np.array([*xy, -camera.focal_length_mm[ccd]])
    seen = flight.terrain.intersect(poses.position_l, ray)
    start = poses.position_l[0, :2]
    wet = np.hypot(*(seen[:, :2] - start).T) < until_m
    out = image.copy()
    out[wet] = np.random.default_rng(ccd).normal(300, 4, (int(wet.sum()), image.shape[1])).astype(image.dtype)
    return out


@pytest.mark.study
@pytest.mark.parametrize("range_m", [1000.0, 1500.0])
def test_the_ties_are_the_same_with_mountains_under_the_strip(range_m):
    (strip, flight), (flat, _) = over_mountains(range_m), over_mountains(50.0)
    heights = np.array([tie.xyz_l[2] for tie in strip.ties])
    assert np.ptp(heights) > 0.75 * range_m
    assert abs(len(strip.ties) - len(flat.ties)) <= (0.05 if range_m == 1000.0 else 0.15) * len(flat.ties)
    error, _ = tie_errors(flight, strip.ties)
    assert (np.abs(error).max(axis=1) > 1.0).mean() < 0.01


@pytest.mark.study
def test_behind_a_coast_the_ground_is_found():
    (strip, flight), (dry, _) = over_mountains(1000.0, sea_until_m=4000.0), over_mountains(1000.0)
    first = min(tie.rays[0].line for tie in dry.ties)
    coast = first + 4000.0 / 200.0 * flight.strips[0].line_rate_hz
    behind = [tie for tie in dry.ties if tie.rays[0].line > coast]
    assert len(behind) > 50 and len(strip.ties) > 0.7 * len(behind)
