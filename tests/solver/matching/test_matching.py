"""Image lines of a simulated flight, and the tie points that matching makes of them."""

import json
from dataclasses import replace

import matched_flight
import numpy as np
import pytest
from matched_flight import PIXELS
from scipy.ndimage import gaussian_filter

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.matching.interest_points import interest_point
from triline.solver.matching.line_scan import LineScan, view_of
from triline.solver.matching.looks import LookMatcher
from triline.solver.matching.tie_matcher import MatchingOptions
from triline.solver.simulation.imagery import ImagingPlan, LineImager
from triline.solver.simulation.matching_study import match_strip, tie_errors
from triline.solver.simulation.observations import find_looks


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


# ---- imagery


def test_a_target_is_rendered_where_collinearity_puts_it():
    # a calm flight: vibration pulls the grey values of a target about, their centre would not be its centre
    settings = {"sensor": "ads40-small", "pixels": PIXELS, "images": True, "seconds": 30.0, "turbulence": 0.0}
    flown = simulated_flight(settings)
    flight = flown.simulation.flight
    points = flown.simulation.points
    targets = points.xyz_l[points.role != "tie"]
    # even light and a ground without detail: the centre of the grey values is the centre of the target
    flat = replace(
        flown.imager.texture, reflectance=np.full(1024, 0.4, np.float32), contrast=np.zeros(1024, np.float32),
        unsteady=np.zeros(1024, np.float32), roads=(), parcel_m=(1e7, 1e7),
        target_radius_m=3.0 * flown.imager.texture.detail_m,
    )  # fmt: skip
    imager = LineImager(flight, flat, 1, ImagingPlan(falloff=0.0, flicker=0.0))
    background = LineImager(flight, replace(flat, targets_l=np.empty((0, 2))), 1, imager.plan)
    looks = find_looks(targets, flight.strips, flight.camera)
    half, off = 11, []
    for ccd, line, sample in zip(looks.ccd, looks.line, looks.sample, strict=True):
        u, v = round(line), round(sample)
        near = (looks.ccd == ccd) & (np.abs(looks.line - line) < 25) & (np.abs(looks.sample - sample) < 25)
        if near.sum() > 1 or not (half <= v < PIXELS - half and half <= u < flight.strips[0].lines - half):
            continue
        patch, empty = (
            image.signal(0, int(ccd), u - half, 2 * half + 1)[:, v - half : v + half + 1].astype(float)
            for image in (imager, background)
        )
        bright = (patch - empty) ** 2  # disc and ring
        r = np.arange(-half, half + 1)
        off.append((bright.sum(1) @ r / bright.sum() - (line - u), bright.sum(0) @ r / bright.sum() - (sample - v)))
    off = np.array(off)
    assert len(off) > 40
    assert np.abs(np.median(off, axis=0)).max() < 0.01
    assert 1.4826 * np.median(np.abs(off)) < 0.02


def test_pixels_see_the_ground_that_collinearity_gives_them(flown):
    flight, points = flown.simulation.flight, flown.simulation.points
    looks = find_looks(points.xyz_l, flight.strips, flight.camera)
    assert len(looks) > 50
    for point, ccd, line, sample in zip(looks.point, looks.ccd, looks.line, looks.sample, strict=True):
        v = min(int(sample), PIXELS - 2)
        ground = flown.imager.ground(int(ccd), np.atleast_1d(flight.strips[0].time_of(line)))[:, 0]
        there = ground[:, v] + (sample - v) * (ground[:, v + 1] - ground[:, v])
        off = np.hypot(*(there - points.xyz_l[point])[:2])
        assert off < 0.02 * flown.imager.texture.detail_m


def test_lines_are_the_same_in_whatever_blocks_they_are_rendered(flown, images):
    parts = [flown.imager.render(0, 1, first, n) for first, n in ((100, 3), (103, 7))]
    np.testing.assert_array_equal(np.concatenate(parts), images[1][100:110])
    assert images[1].max() <= 4095 and images[1].dtype == np.uint16
    with pytest.raises(ValueError, match="strip of"):
        flown.imager.render(0, 1, flown.simulation.flight.strips[0].lines - 1, 2)


# ---- parts


def test_ground_points_are_found_back_on_their_lines(flown):
    flight = flown.simulation.flight
    view, strip = view_of(flight.camera, 0), flight.strips[0]
    poses = flight.truth.at(strip.time_of(np.arange(100, 400)))
    scan = LineScan(view, 100, poses.position_l, poses.R_lc)
    rng = np.random.default_rng(3)
    line, sample = rng.integers(120, 380, 200).astype(float), rng.uniform(5, PIXELS - 6, 200)
    point, _ = scan.to_plane(line, sample, rng.uniform(-40, 40, 200))
    u, v, inside = scan.locate(point, line + rng.uniform(-30, 30, 200), rounds=5)
    assert inside.all()
    assert np.abs(u - line).max() < 1e-3 and np.abs(v - sample).max() < 1e-3


def test_a_place_with_texture_all_over_its_window_is_better_than_one_strong_corner():
    rng = np.random.default_rng(4)
    image = np.full((60, 120), 800.0, dtype=np.float32)
    image[20:40, 20:40] += 1500.0  # one corner in a window, whichever
    wavy = gaussian_filter(rng.standard_normal((40, 40)), 1.5)
    image[10:50, 70:110] += (120.0 / wavy.std() * wavy).astype(np.float32)
    image += 10.0 * rng.standard_normal(image.shape).astype(np.float32)
    best = interest_point(image, np.ones(60, dtype=bool), 19, 0.1)
    assert best is not None and 74 <= best[1] <= 106 and best[2] < 0.1
    # the corner alone is good enough where there is nothing else
    alone = interest_point(image[:, :60], np.ones(60, dtype=bool), 19, 0.1)
    assert alone is not None and min(abs(alone[0] - 20), abs(alone[0] - 39)) < 10
    assert interest_point(np.full((60, 60), 800, np.float32), np.ones(60, dtype=bool), 19, 0.1) is None


# ---- all of it


def test_ties_lie_where_the_truth_says_with_the_covariance_they_claim(flown, clean):
    error, sigma = tie_errors(flown.simulation.flight, clean)
    length = np.hypot(*error.T)
    assert len(clean) > 80
    assert (length < 0.3).mean() > 0.95 and (length > 2.0).mean() < 0.01
    assert 1.4826 * np.median(np.abs(error)) < 0.06
    assert 0.5 < np.median((error / sigma) ** 2) / 0.455 < 1.4
    assert 0.6 < ((error / sigma)[length < 2] ** 2).mean() < 1.4


@pytest.mark.study
def test_views_are_looked_for_as_they_come_and_ties_follow_soon(flown, images, monkeypatch):
    looked = []
    look = LookMatcher.look

    def noted(self, tracks, view):
        begun = [int(track.found.sum()) for track in tracks]
        look(self, tracks, view)
        looked.append((view, begun, float(self.prediction._widest[self.prediction.others[view]])))

    monkeypatch.setattr(LookMatcher, "look", noted)
    found = match_strip(flown.simulation.flight, images)
    tried = {view: sum(len(begun) for v, begun, _ in looked if v == view) for view in (0, 1)}
    # who is not found by the view that looks ahead is not looked for by the other
    assert all(min(begun) == 1 for view, begun, _ in looked if view == 1)
    assert tried[1] < 0.95 * tried[0] and tried[1] < 1.2 * len(found.ties)
    # with the height from the first view, the second is searched within a few pixels
    later = len(looked) // 2
    assert np.median([reach for view, _, reach in looked[later:] if view == 1]) < 6.0
    # a patch, the search around it, a block, and what waits for company (the first ones wait to be judged together)
    delay = found.came_line - [max(ray.line for ray in tie.rays) for tie in found.ties]
    assert np.quantile(delay[len(delay) // 2 :], 0.9) < 70
    assert min(track.place.line for track in found.matcher._master.waiting.tracks) > len(images[0]) - 280


@pytest.mark.study
def test_lanes_of_a_small_budget_give_ties_too():
    settings = {"sensor": "ads40-small", "pixels": 3200, "images": True, "seconds": 8.0, "height": 400.0, "seed": 4}
    flight = (wide := simulated_flight(settings)).simulation.flight
    images = [wide.imager.render(0, ccd, 0, flight.strips[0].lines) for ccd in range(3)]
    found = match_strip(flight, images, options=MatchingOptions(budget_mb=46.0, points_per_s=24.0))
    store = found.matcher.store
    assert store is not None and store.nbytes <= 46e6 and 0.6 < store.cover < 0.9
    assert any("lanes" in text for text in found.told)
    error, _ = tie_errors(flight, found.ties)
    assert len(found.ties) > 8 and (np.hypot(*error.T) < 0.3).mean() > 0.95


@pytest.mark.study
def test_a_wrong_orientation_does_not_hinder(flown, images):
    found = match_strip(flown.simulation.flight, images, wrong_rad=30 * 0.0065 * 12000 / PIXELS / 62.7)  # 30 px
    error, _ = tie_errors(flown.simulation.flight, found.ties)
    length = np.hypot(*error.T)
    assert len(found.ties) > 60
    assert (length < 0.3).mean() > 0.93 and (length > 2.0).mean() < 0.01


@pytest.mark.study
def test_from_image_lines_to_refined_orientation(tmp_path, capsys):
    flight, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    arguments = ["--sensor", "ads40-small", "--pixels", "600", "--images", "--seconds", "18", "--height", "600"]
    arguments += ["--lead-in", "2", "--attitude-rate", "100"]
    assert main(["simulate", "-q", "-o", str(flight), *arguments, "--seed", "5"]) == 0
    assert main(["process", "-q", "--json", str(flight), "-o", str(out), "--nodes", "navigator,matcher,adjuster"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["nodes"] == ["navigator", "matcher", "adjuster"] and not result["counters"]["matcher"].get("failed")
    bodies = [message.body for message in RecordingReader(out).messages(["observation/tie"])]
    tie = [body for body in bodies if "-M" in body.point]
    assert len(tie) > 40 and all(0 < image.sigma_line < 0.2 for body in tie for image in body.images)
    assert any(not body.point.startswith("S1-M") for body in bodies)  # targets measured by others stay
    assert result["outputs"]["orientation/final"] > 100
