"""Tie points between images by location models that are wrong, on ground with relief, against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_pictures import HIGH_M, LOW_M, ArrayPixels, View, errors_of, moved, textured

from triline.solver.location.rpc_fit import fit_to_model
from triline.solver.matching.options import MatchingOptions
from triline.solver.matching.scene_patches import ScenePatches, SceneView, mapping, parallaxes, transferred
from triline.solver.matching.scene_search import agreeing, crowd, grids, pair_of, plane_fit, shifts_between
from triline.solver.matching.scene_ties import ELSEWHERE, NO_HEIGHT, SceneMatcher, SceneMatching
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass, overpass_beside

#: Turned against each other, of other views and other pixel sizes.
VIEWS = [View(10, (0.02, 0.0)), View(-20, (0.35, 0.1)), View(55, (-0.3, 0.05), 1.35, 220, 220)]
#: What the metadata say: 8 to 17 m off.
STATED = [moved(VIEWS[0], 6, -9), moved(VIEWS[1], -14, 5, 0.1), moved(VIEWS[2], 12, 12)]


class Extent(ArrayPixels):
    """An image without pixels."""

    def __init__(self, lines: int, samples: int):
        self.first, self.end = (0, 0), (lines, samples)


def seen(views: list[View], stated: list[View], seed: int, noise: float) -> list[SceneView]:
    texture, rng = textured(seed), np.random.default_rng(seed + 100)
    return [
        SceneView(f"{k}", fit_to_model(wrong, LOW_M, HIGH_M).rpc, ArrayPixels(view.picture(texture, rng, noise)))
        for k, (view, wrong) in enumerate(zip(views, stated, strict=True))
    ]


def matching(points: int, search_m: float = 40.0, heights=None) -> SceneMatching:
    options = MatchingOptions(image_sigma_px=0.0, largest_sigma_px=0.25)
    low, high = (LOW_M, HIGH_M) if heights is None else (-10.0, 10.0)
    return SceneMatching(points, low, high, heights, search_m, options)


@pytest.fixture(scope="module")
def three():
    """What is found in three images, noise a twentieth of the contrast."""
    return SceneMatcher(seen(VIEWS, STATED, 1, 50.0), matching(60)).match()


def test_ties_are_where_the_ground_is_seen_and_sigmas_say_how_well(three):
    points, _ = three
    off, nees, _ = errors_of(VIEWS, points)
    assert len(off) > 100
    assert np.sqrt(np.mean(off**2)) < 0.1 and np.abs(np.mean(off, axis=0)).max() < 0.02
    assert 0.5 < nees.mean() < 1.5


@pytest.mark.study
@pytest.mark.parametrize("noise", [50.0, 120.0])
def test_errors_are_as_large_as_their_sigmas_over_seeds(noise):
    found = [
        errors_of(VIEWS, SceneMatcher(seen(VIEWS, STATED, seed, noise), matching(60)).match()[0]) for seed in range(10)
    ]
    assert 0.5 < np.concatenate([nees for _, nees, _ in found]).mean() < 1.5
    assert np.abs(np.concatenate([off for off, _, _ in found]).mean(axis=0)).max() < 0.02


def test_a_place_in_three_images_is_one_point_and_every_pair_has_points_all_over(three):
    points, reports = three
    assert sum(len(p.rays) == 3 for p in points) > 20
    assert [{*r.names} for r in reports] == [{"0", "1"}, {"0", "2"}, {"1", "2"}]
    assert reports[1].names[0] == "2"  # the coarser image is the master
    for r in reports:
        assert r.kept >= 40 and 0.3 < r.overlap < 0.9 and r.left_px < 0.15 < r.misfit_px
        a, b = (int(name) for name in r.names)
        places = np.array([p.rays[a][:2] for p in points if a in p.rays and b in p.rays])
        off = places - np.median(places, axis=0)
        quarters = [np.mean((off[:, 0] > 0) == u) * np.mean((off[:, 1] > 0) == v) for u in (0, 1) for v in (0, 1)]
        assert min(quarters) > 0.15


def test_no_place_is_measured_twice_where_a_further_image_does_not_show_it():
    scenes = seen(VIEWS, STATED, 1, 50.0)
    clouds = scenes[2].pixels.image[:, :110]
    clouds[:] = 700 + 100 * np.random.default_rng(5).standard_normal(clouds.shape)
    points, _ = SceneMatcher(scenes, matching(60)).match()
    assert len(points) > 60
    for k in range(3):
        places = np.array([p.rays[k][:2] for p in points if k in p.rays])
        apart = np.linalg.norm(places[:, None] - places, axis=2) + 99.0 * np.eye(len(places))
        assert apart.min() > 2.5


def test_points_of_a_pair_in_which_nothing_was_found_by_itself(monkeypatch):
    first = SceneMatcher._first_look
    monkeypatch.setattr(
        SceneMatcher, "_first_look", lambda self, *of: "lost" if of[:2] in ((0, 1), (1, 0)) else first(self, *of)
    )
    points, reports = SceneMatcher(seen(VIEWS, STATED, 1, 50.0), matching(60)).match()
    assert (reports[0].why, reports[0].tried) == ("lost", 0) and np.isnan(reports[0].misfit_px)
    assert reports[0].kept == sum({0, 1} <= set(p.rays) for p in points) > 10


def test_misfits_are_those_of_the_models(three):
    # across the parallax, what one model is moved against the other
    _, reports = three
    tilt = np.subtract(VIEWS[1].tilt, VIEWS[0].tilt)
    move = np.array([-14 - 6, 5 + 9])
    across = abs(tilt[0] * move[1] - tilt[1] * move[0]) / np.hypot(*tilt)
    assert reports[0].misfit_px == pytest.approx(across, abs=0.3)


def test_what_residuals_do_not_show_is_as_large_on_the_ground_in_both_images():
    views = [replace(VIEWS[0], lines=400, samples=400), replace(VIEWS[1], gsd_m=3.0, lines=130, samples=130)]
    stated = [moved(views[0], 6, -9), moved(views[1], -14, 5, 0.1)]
    how = replace(matching(40), matching=MatchingOptions(image_sigma_px=0.2, largest_sigma_px=0.25))
    points, _ = SceneMatcher(seen(views, stated, 1, 8.0), how).match()
    fine, coarse = (np.array([p.rays[k][2] for p in points]) for k in (0, 1))
    assert len(points) > 10 and coarse.min() > 0.14
    assert fine == pytest.approx(3.0 * coarse, rel=0.05)


def test_known_heights_need_no_search_along_the_parallax():
    views, stated = VIEWS[:2], [moved(VIEWS[0], 3, 0), moved(VIEWS[1], -3, 2)]
    scenes = seen(views, stated, 2, 8.0)
    heights = lambda view, pixel: stated[int(view.name)].on_ground(pixel)[:, 2]  # noqa: E731
    shares: list[float] = []
    points, (report,) = SceneMatcher(scenes, matching(40, 15.0, heights), shares.append).match()
    off, _, _ = errors_of(views, points)
    assert len(points) > 25 and np.sqrt(np.mean(off**2)) < 0.05
    assert report.kept == len(points)
    # of large scenes one pair takes minutes
    assert len(shares) > 50 and shares == sorted(shares) and np.diff(shares).max() < 0.4 and shares[-1] == 1.0


def test_ground_without_heights_is_no_lack_of_overlap():
    """Of a raster with a hole, or one that ends."""
    views = [VIEWS[0], replace(VIEWS[0], at_m=(150.0, 0.0))]
    scenes = seen(views, views, 3, 8.0)

    def heights(view, pixel):
        other = scenes[1 - int(view.name)]
        lat, lon, h = view.location.direct(*pixel.T, np.full(len(pixel), 240.0)).T
        return np.where(other.inside(other.location.inverse(lat, lon, h, 1e4), 40.0), np.nan, h)

    points, (report,) = SceneMatcher(scenes, matching(40, 15.0, heights)).match()
    assert not points and report.why == NO_HEIGHT


def test_images_that_see_other_ground_have_no_points():
    views = [VIEWS[0], View(0, (0.0, 0.0), at_m=(2000.0, 0.0))]
    points, (report,) = SceneMatcher(seen(views, views, 3, 8.0), matching(40)).match()
    assert not points and report.why == ELSEWHERE


def test_images_of_other_places_under_the_same_coordinates_have_no_points():
    scenes = [*seen(VIEWS[:1], STATED[:1], 4, 8.0), *seen(VIEWS[1:2], STATED[1:2], 5, 8.0)]
    points, (report,) = SceneMatcher(scenes, matching(40)).match()
    assert len(points) < 5 and (points or report.why)


def test_pixels_that_were_not_measured_are_no_texture():
    scenes = seen(VIEWS[:2], STATED[:2], 6, 8.0)
    scenes[1].pixels.image[:, :150] = 0
    points, _ = SceneMatcher(scenes, matching(40)).match()
    off, _, _ = errors_of(VIEWS[:2], points)
    assert len(points) > 10 and np.sqrt(np.mean(off**2)) < 0.1
    assert min(p.rays[1][1] for p in points) > 145


def test_single_pixels_that_are_saturated_or_black_do_no_harm():
    scenes, rng = seen(VIEWS[:2], STATED[:2], 6, 8.0), np.random.default_rng(1)
    for scene in scenes:
        chance = rng.uniform(size=scene.pixels.image.shape)
        scene.pixels.image[chance < 0.01] = 4095
        scene.pixels.image[chance > 0.995] = 0
        scene.pixels.saturated = 4095.0
    points, _ = SceneMatcher(scenes, matching(40)).match()
    off, _, _ = errors_of(VIEWS[:2], points)
    assert len(points) > 25 and np.sqrt(np.mean(off**2)) < 0.1


# -- the parts


def test_patches_of_both_images_are_the_same_picture_where_heights_are_right():
    scenes = seen(VIEWS, VIEWS, 7, 4.0)
    place = np.array([[150.0, 150.0], [120.0, 170.0]])
    height = VIEWS[0].on_ground(place)[:, 2]

    def alike(k: int, h: np.ndarray) -> float:
        ground = grids(place, h, 1.35)
        one, other = (ScenePatches(scenes[0], scenes[n]).patches(ground, place[:, 0], 10, 1) for n in (0, k))
        assert (other.known == 1.0).all()
        return min(np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(one.values, other.values, strict=True))

    for k in (1, 2):
        assert alike(k, height) > 0.9 > 0.6 > alike(k, height + 20.0)


def test_derivatives_and_parallax_are_those_of_differences():
    a, b = seen(VIEWS[:2], STATED[:2], 8, 8.0)
    place, h = np.array([[40.0, 200.0], [150.0, 90.0]]), np.array([210.0, 260.0])
    at, slope = mapping(a, b, place, h)
    step = np.array([0.7, -0.4])
    assert transferred(a, b, place + step, h) - at == pytest.approx(slope @ step, abs=1e-4)
    way = parallaxes(a, b, place, h)
    higher = transferred(a, b, place, h + 5.0)
    pair = pair_of(a, b, place, h)
    assert shifts_between(pair, place, h, higher) == pytest.approx(5.0 * way, abs=1e-3)
    assert np.abs(way @ pair.across).max() < 1e-4


def test_wrong_shifts_do_not_agree():
    rng = np.random.default_rng(9)
    a, b = seen(VIEWS[:2], STATED[:2], 8, 8.0)
    place = rng.uniform(0, 300, (80, 2))
    pair = pair_of(a, b, place, np.full(80, 240.0))
    across = 12.0 + 0.01 * place[:, 0] + rng.normal(0, 0.1, 80)
    along = 30.0 + 5.0 * np.sin(place[:, 1] / 60.0) + rng.normal(0, 0.1, 80)
    shift = across[:, None] * pair.across + along[:, None] * pair.along
    shift[:6] += 3.0 * pair.across
    shift[6:9] += 60.0 * pair.along
    shift[9] = np.nan
    good = agreeing(place, shift, pair.along, 0.1)
    assert not good[:10].any() and good[10:].mean() > 0.95
    plane, scale = plane_fit(place[10:], across[10:], 0.01)
    assert plane == pytest.approx(12.0 + 0.01 * place[10:, 0], abs=0.15) and 0.05 < scale < 0.2
    values, weight = np.array([5.0, 5.2, 90.0, np.nan, 4.9]), np.array([0.3, 0.3, 0.5, 0.0, 0.3])
    assert crowd(values, weight, 0.5).tolist() == [True, True, False, False, True]


def test_ground_of_all_heights_agrees_where_parallax_turns_within_the_scene():
    # another satellite that turns back while it images
    nadir = overpass(ORBITAL_SENSORS["alos-prism"], 36.0, 139.6).sensors["N"]
    aside = overpass_beside(ORBITAL_SENSORS["eros-a1"], 36.0, 139.6, 15.0).sensors["P"]
    a, b = (SceneView(n, s, Extent(s.lines, s.samples)) for n, s in (("a", nadir), ("b", aside)))
    rng = np.random.default_rng(3)
    place, middle = rng.uniform([4000, 7500], [10500, 12500], (300, 2)), np.full(300, 700.0)
    height = middle * (1.0 + np.sin(place[:, 0] / 900.0) * np.cos(place[:, 1] / 1300.0))
    pair = pair_of(a, b, place, middle)
    pixel = transferred(a, b, place, height) + np.array([3.0, -2.0]) + rng.normal(0.0, 0.05, (300, 2))
    shift = shifts_between(pair, place, middle, pixel)
    way = pair.ways(place, middle)
    shift[:10] += 1.5 * np.stack([-way[:10, 1], way[:10, 0]], axis=1)
    good = agreeing(place, shift, way, 0.05)
    assert not good[:10].any() and good[10:].mean() > 0.95
