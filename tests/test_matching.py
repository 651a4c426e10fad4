"""Image lines of a simulated flight, and the tie points that matching makes of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from triline.nodes.cli import main
from triline.nodes.flight_settings import simulated_flight
from triline.nodes.recording import RecordingReader
from triline.solver.matching.interest_points import interest_point
from triline.solver.matching.least_squares import match_patches
from triline.solver.matching.line_intake import LineIntake
from triline.solver.matching.line_quality import IS_DARK, IS_FROZEN, IS_PARTLY_SATURATED, IS_SATURATED, judge_lines
from triline.solver.matching.line_scan import LineScan, view_of
from triline.solver.matching.line_store import LineRing, LineStore
from triline.solver.matching.looks import LookMatcher
from triline.solver.matching.tie_matcher import MatchingOptions, TieMatcher
from triline.solver.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.simulation.imagery import ImagingPlan, LineImager
from triline.solver.simulation.observations import find_looks

PIXELS, SECONDS, HEIGHT, BLOCK = 800, 25.0, 800.0, 8


@pytest.fixture(scope="module")
def flown():
    settings = {
        "sensor": "ads40-small",
        "pixels": PIXELS,
        "images": True,
        "seconds": SECONDS,
        "height": HEIGHT,
        "lead_in": 2.0,
        "seed": 3,
    }
    return simulated_flight(settings)


@pytest.fixture(scope="module")
def images(flown):
    lines = flown.simulation.flight.strips[0].lines
    return [flown.imager.render(0, ccd, 0, lines) for ccd in range(3)]


@pytest.fixture(scope="module")
def clean(flown, images):
    """Ties of lines that are as they should be."""
    return matched(flown.simulation.flight, images)[0]


def matched(flight, images, seed=1, wrong_px=0.0, options=None, delay=None, lost=None):
    """Ties and matcher for images of the first strip, with slow attitude errors (0.02 deg) and perhaps large ones.

    ``lost`` says of each image which lines never come.
    The list ``delay`` is given the lines from the last look of each tie to the newest one.
    """
    strip, camera = flight.strips[0], flight.camera
    matcher = TieMatcher(camera, options or MatchingOptions())
    matcher.begin_strip(strip.id, strip.first_line_time_s, strip.line_rate_hz)
    time_s = np.arange(0.0, flight.truth.end_s, 0.005)
    truth = flight.truth.at(time_s)
    rng = np.random.default_rng(seed)
    angles = truth.angles + np.radians(0.02) * rng.standard_normal(3)
    angles += np.radians(0.01) * np.sin(time_s[:, None] / 5.0 + rng.uniform(0, 6, 3))
    pixel = 0.0065 * 12000 / PIXELS / 62.7
    angles[:, 0] += wrong_px * pixel * np.sin(2 * np.pi * time_s / 40.0)
    quaternion = quaternion_from_matrix(matrix_from_angles(*angles.T))
    covariance = np.diag([1.0] * 3 + [np.radians(0.03) + wrong_px * pixel] * 3) ** 2
    ties, told, poses = [], [], 0
    for first in range(0, strip.lines, BLOCK):
        end_s = float(strip.time_of(first + BLOCK - 1))
        while poses < len(time_s) and time_s[poses] <= end_s:
            matcher.orientation.add_pose(time_s[poses], truth.position_l[poses], quaternion[poses], covariance)
            poses += 1
        for i, (image, line) in enumerate(zip(images, camera.lines, strict=True)):
            there = np.arange(first, min(first + BLOCK, len(image)))
            if lost is not None:
                there = there[~lost[i][there]]
            for part in np.split(there, np.flatnonzero(np.diff(there) > 1) + 1):
                if len(part):
                    matcher.add_lines(line.id, int(part[0]), image[part])
        new = matcher.match()
        ties += new
        if delay is not None:
            delay += [first + BLOCK - max(ray.line for ray in tie.rays) for tie in new]
        told += matcher.take_events()
    return ties, matcher, told


def errors(flight, ties):
    """(rays, 2) line and sample against the truth of the place in the master view, and their sigma (rays, 2)."""
    camera, strip = flight.camera, flight.strips[0]
    index = camera.line_index
    ccd = np.array([index[tie.rays[0].ccd] for tie in ties])
    line, sample = np.array([[tie.rays[0].line, tie.rays[0].sample] for tie in ties]).T
    poses = flight.truth.at(strip.time_of(line))
    xy = camera.image_coordinates(ccd, sample)[0]
    ray = np.einsum("nij,nj->ni", poses.R_lc, np.column_stack([xy, -camera.focal_length_mm[ccd]]))
    looks = find_looks(flight.terrain.intersect(poses.position_l, ray), flight.strips, camera)
    true = {(p, c): uv for p, c, *uv in zip(looks.point, looks.ccd, looks.line, looks.sample, strict=True)}
    rows = [
        (r.line - true[i, index[r.ccd]][0], r.sample - true[i, index[r.ccd]][1],
         np.hypot(r.sigma_line, tie.rays[0].sigma_line), np.hypot(r.sigma_sample, tie.rays[0].sigma_sample))
        for i, tie in enumerate(ties) for r in tie.rays[1:]
    ]  # fmt: skip
    rows = np.array(rows)
    return rows[:, :2], rows[:, 2:]


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


def test_least_squares_matching_finds_shifts():
    rng = np.random.default_rng(2)
    n, k = 27, 150
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((k, 64, 64))) * np.exp(-0.5 * (f / 0.2) ** 2)
    shift = rng.uniform(-0.8, 0.8, (k, 2))
    phase = np.exp(-2j * np.pi * (np.fft.fftfreq(64)[:, None] * shift[:, 0, None, None]
                                  + np.fft.fftfreq(64)[None, :] * shift[:, 1, None, None]))  # fmt: skip
    first, second = (np.fft.ifft2(s).real[:, :n, :n] * 800 for s in (spectrum, spectrum * phase))
    first, second = (a + 15 * rng.standard_normal(a.shape) for a in (first, 0.8 * second + 100))
    found = match_patches(first[:, 4:-4, 4:-4].astype(np.float32), second.astype(np.float32), np.zeros((k, 2)))
    error = found.shift - shift
    assert found.converged.all() and np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.08
    assert (found.score > 0.9).mean() > 0.9


def test_what_was_not_measured_does_not_matter_whatever_its_grey_values():
    rng = np.random.default_rng(5)
    k, t, s = 300, 19, 27
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((k, 64, 64))) * np.exp(-0.5 * (f / 0.12) ** 2)
    shift = rng.uniform(-0.4, 0.4, (k, 2))
    phase = np.exp(-2j * np.pi * (np.fft.fftfreq(64)[:, None] * shift[:, 0, None, None]
                                  + np.fft.fftfreq(64)[None, :] * shift[:, 1, None, None]))  # fmt: skip
    first, second = (np.fft.ifft2(a).real[:, :s, :s] * 1500 for a in (spectrum, spectrum * phase))
    template, search = (a + 1000 + 40 * rng.standard_normal(a.shape) for a in (first, second))
    template = template[:, 4:-4, 4:-4].astype(np.float32)
    holes = np.zeros((k, t, t), bool), np.zeros((k, s, s), bool)
    holes[0][:, 4:7], holes[1][:, :, 15:17] = True, True
    between = search.copy()
    for i, share in ((15, 1 / 3), (16, 2 / 3)):  # as a mended patch has them
        between[:, :, i] = (1 - share) * search[:, :, 14] + share * search[:, :, 17]
    a = match_patches(template, between.astype(np.float32), np.zeros((k, 2)), holes=holes)
    spoilt = np.where(holes[0], 4095, template).astype(np.float32)
    b = match_patches(spoilt, between.astype(np.float32), np.zeros((k, 2)), holes=holes)
    np.testing.assert_allclose(a.shift, b.shift, atol=1e-9)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)
    assert ((a.measured > 0.6) & (a.measured < 0.8)).all() and a.converged.all()
    # and the covariance tells what is left, as that of whole patches does
    whole = match_patches(template, search.astype(np.float32), np.zeros((k, 2)))
    error = a.shift - shift
    normalised = [
        np.einsum("ki,kij,kj->k", x.shift - shift, np.linalg.inv(x.covariance), x.shift - shift).mean()
        for x in (a, whole)
    ]
    # 2, and what shifts lean by until a patch is taken anew from where it was found
    assert 0.8 < normalised[0] / normalised[1] < 1.25 and 1.0 < normalised[1] < 4.5
    assert 1.05 < np.median(a.covariance[:, 0, 0] / whole.covariance[:, 0, 0]) < 2.5
    # without the holes the same patches are spoilt
    blind = match_patches(spoilt, between.astype(np.float32), np.zeros((k, 2)))
    assert np.abs(blind.shift - shift).mean() > 2 * np.abs(error).mean()


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
    error, sigma = errors(flown.simulation.flight, clean)
    length = np.hypot(*error.T)
    assert len(clean) > 80
    assert (length < 0.3).mean() > 0.95 and (length > 2.0).mean() < 0.01
    assert 1.4826 * np.median(np.abs(error)) < 0.06
    assert 0.5 < np.median((error / sigma) ** 2) / 0.455 < 1.4
    assert 0.6 < ((error / sigma)[length < 2] ** 2).mean() < 1.4


def test_views_are_looked_for_as_they_come_and_ties_follow_soon(flown, images, monkeypatch):
    looked, delay = [], []
    look = LookMatcher.look

    def noted(self, tracks, view):
        begun = [int(track.found.sum()) for track in tracks]
        look(self, tracks, view)
        looked.append((view, begun, float(self.prediction._widest[self.prediction.others[view]])))

    monkeypatch.setattr(LookMatcher, "look", noted)
    ties, matcher, _ = matched(flown.simulation.flight, images, delay=delay)
    tried = {view: sum(len(begun) for v, begun, _ in looked if v == view) for view in (0, 1)}
    # who is not found by the view that looks ahead is not looked for by the other
    assert all(min(begun) == 1 for view, begun, _ in looked if view == 1)
    assert tried[1] < 0.95 * tried[0] and tried[1] < 1.2 * len(ties)
    # with the height from the first view, the second is searched within a few pixels
    later = len(looked) // 2
    assert np.median([reach for view, _, reach in looked[later:] if view == 1]) < 6.0
    # a patch, the search around it, a block, and what waits for company (the first ones wait to be judged together)
    assert np.quantile(delay[len(delay) // 2 :], 0.9) < 70
    assert min(track.place.line for track in matcher._master.waiting.tracks) > len(images[0]) - 280


def test_points_of_two_views_do_without_the_third(flown, images):
    dark = [np.zeros_like(images[0]), images[1], images[2]]
    ties, matcher, _ = matched(flown.simulation.flight, dark, options=MatchingOptions(least_rays=2))
    error, _ = errors(flown.simulation.flight, ties)
    assert len(ties) > 60 and {ray.ccd for tie in ties for ray in tie.rays} == {"N", "B"}
    assert (np.hypot(*error.T) < 0.3).mean() > 0.95
    assert matcher.counters["looks never came"] == 0


@pytest.mark.parametrize("dead_s", [(0.0, 99.0), (8.0, 99.0), (8.0, 14.0)], ids=["from the start", "dies", "a while"])
def test_without_the_nadir_line_ties_begin_in_the_next_steepest(flown, images, clean, dead_s):
    strip = flown.simulation.flight.strips[0]
    nadir, (first, end) = images[1].copy(), np.multiply(dead_s, strip.line_rate_hz).astype(int)
    nadir[first:end] = 0
    delay = []
    ties, matcher, told = matched(flown.simulation.flight, [images[0], nadir, images[2]], delay=delay)
    error, sigma = errors(flown.simulation.flight, ties)
    length = np.hypot(*error.T)
    assert len(ties) > 0.75 * len(clean)
    assert (length < 0.3).mean() > 0.98 and (length > 2.0).mean() < 0.01
    assert 0.5 < ((error / sigma)[length < 2] ** 2).mean() < 1.3
    assert len({tie.name for tie in ties}) == len(ties)
    begun = np.array([(tie.rays[0].ccd == "N", tie.rays[0].line) for tie in ties])
    assert not ((begun[:, 0] == 1) & (begun[:, 1] >= first) & (begun[:, 1] < end)).any()
    assert {tie.rays[0].ccd for tie in ties} == ({"B"} if first == 0 else {"N", "B"})
    # ties that are through come without a long pause: some patience, what is told the other way, ten to be judged by
    known_s = (
        np.sort([max(r.line for r in tie.rays) + d for tie, d in zip(ties, delay, strict=True)]) / strip.line_rate_hz
    )
    assert np.diff(known_s).max() < 4.0
    assert known_s[-1] > 24.0
    assert sum("N sees nothing: tie points begin in B" in text for text in told) == 1
    assert sum("N sees again: tie points begin in N" in text for text in told) == (end < len(nadir))
    if end < len(nadir):
        assert (begun[begun[:, 0] == 1, 1] > end).sum() > 10 and len(matcher._at_work) == 1


def test_lanes_of_a_small_budget_give_ties_too():
    settings = {"sensor": "ads40-small", "pixels": 3200, "images": True, "seconds": 8.0, "height": 400.0, "seed": 4}
    flight = (wide := simulated_flight(settings)).simulation.flight
    images = [wide.imager.render(0, ccd, 0, flight.strips[0].lines) for ccd in range(3)]
    ties, matcher, told = matched(flight, images, options=MatchingOptions(budget_mb=46.0, points_per_s=24.0))
    assert matcher.store is not None and matcher.store.nbytes <= 46e6 and 0.6 < matcher.store.cover < 0.9
    assert any("lanes" in text for text in told)
    error, _ = errors(flight, ties)
    assert len(ties) > 8 and (np.hypot(*error.T) < 0.3).mean() > 0.95


def test_a_wrong_orientation_does_not_hinder(flown, images):
    ties, _, _ = matched(flown.simulation.flight, images, wrong_px=30.0)
    error, _ = errors(flown.simulation.flight, ties)
    length = np.hypot(*error.T)
    assert len(ties) > 60
    assert (length < 0.3).mean() > 0.93 and (length > 2.0).mean() < 0.01


def test_bad_imagery_is_told_and_survived(flown, images):
    bad = [image.copy() for image in images]
    bad[0][300:340] = 0
    bad[2][1100:1160] = bad[2][1100]
    bad[1][900:906] = 4095
    lost = [np.zeros(len(image), dtype=bool) for image in images]
    lost[1][640 : 640 + BLOCK] = True
    ties, matcher, told = matched(flown.simulation.flight, bad, lost=lost)
    error, _ = errors(flown.simulation.flight, ties)
    length = np.hypot(*error.T)
    assert len(ties) > 40 and (length < 0.3).mean() > 0.95 and (length > 2.0).mean() < 0.01
    assert matcher.counters["lines dark"] == 40 and matcher.counters["lines frozen"] == 59
    assert matcher.counters["lines saturated"] == 6 and matcher.counters["lines missing"] == BLOCK
    missing = f"N: {BLOCK} lines are missing"
    for words in ("F: lines are black", "F: lines are good again", "B: lines are frozen", missing):
        assert any(words in text for text in told), words


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


@pytest.mark.parametrize("fault", ["lost", "black", "frozen", "dead columns", "saturated"])
def test_a_few_pixels_that_were_not_measured_cost_few_ties_and_no_honesty(flown, images, clean, fault):
    lost = lost_in_threes(images, 0.05)
    assert all(0.035 < mask.mean() < 0.065 for mask in lost)
    if fault == "lost":
        ties, matcher, _ = matched(flown.simulation.flight, images, lost=lost)
        # of the newest ones it is not known yet
        assert matcher.counters["lines missing"] == pytest.approx(sum(mask.sum() for mask in lost), abs=9)
    elif fault in ("dead columns", "saturated"):
        ties, _, _ = matched(flown.simulation.flight, spoilt_pixels(images, fault))
    else:
        bad = [image.copy() for image in images]
        for image, mask in zip(bad, lost, strict=True):
            for line in np.flatnonzero(mask):
                image[line] = 0 if fault == "black" else image[line - 1]
        ties, _, _ = matched(flown.simulation.flight, bad)
    error, sigma = errors(flown.simulation.flight, ties)
    length = np.hypot(*error.T)
    assert len(ties) > 0.7 * len(clean)
    assert (length < 0.3).mean() > 0.98 and (length > 2.0).mean() < 0.01
    assert 1.4826 * np.median(np.abs(error)) < 0.06
    assert 0.5 < ((error / sigma)[length < 2] ** 2).mean() < 1.3


def test_featureless_ground_gives_no_ties_and_is_told(flown, images):
    rng = np.random.default_rng(1)
    water = [rng.normal(300, 5, image[:900].shape).astype(np.uint16) for image in images]
    short = [np.concatenate([w, image[900:1000]]) for w, image in zip(water, images, strict=True)]
    ties, matcher, told = matched(flown.simulation.flight, [image[:900] for image in short])
    assert not ties and matcher.counters["ties"] == 0
    assert any("poor in texture" in text for text in told)


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
