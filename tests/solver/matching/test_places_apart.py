"""Places of tie points keep apart: what two cells have on their border is chosen once."""

import numpy as np
import pytest

from triline.solver.matching.line_store import LineRing
from triline.solver.matching.options import MatchingOptions
from triline.solver.matching.places import APART, PlaceChooser

WINDOW, RATE_HZ, LINES, SAMPLES = 19, 60.0, 600, 400


def chosen(pixels, points_per_s):
    """Lines and samples (n, 2) of places, chosen while the lines come."""
    chooser = PlaceChooser(MatchingOptions(points_per_s=points_per_s), WINDOW, 2)
    ring, places = LineRing(SAMPLES, 200), []
    for first in range(0, LINES, 6):
        ring.add(first, pixels[first : first + 6])
        places += chooser.choose(ring, RATE_HZ)
    return np.array([(place.line, place.sample) for place in places])


def textured(rng, spots):
    """Weak texture all over, and strong marks at some places."""
    image = 800.0 + 15.0 * rng.standard_normal((LINES, SAMPLES))
    row, column = np.mgrid[-4:5, -4:5]
    mark = 600.0 * np.exp(-(row**2 + column**2) / 6.0)
    for u, v in spots:
        image[u - 4 : u + 5, v - 4 : v + 5] += mark
    return np.clip(image, 0, 4095).astype(np.uint16)


def nearest(places):
    """(n,) distance of each place from the nearest other one, the larger of lines and samples."""
    away = np.abs(places[:, None] - places[None]).max(axis=2)
    np.fill_diagonal(away, np.inf)
    return away.min(axis=1)


@pytest.mark.parametrize("points_per_s", [10.0, 40.0])
def test_no_two_places_share_most_of_their_windows(points_per_s):
    rng = np.random.default_rng(5)
    spots = np.column_stack([rng.integers(10, LINES - 10, 60), rng.integers(10, SAMPLES - 10, 60)])
    places = chosen(textured(rng, spots), points_per_s)
    assert len(places) > 60
    assert nearest(places).min() >= round(APART * WINDOW)


def test_a_mark_on_the_border_of_two_cells_is_one_place():
    """Chunks have 15 lines: marks stand where one ends and the next begins."""
    rng = np.random.default_rng(6)
    spots = [(u, v) for u in range(45, LINES - 45, 60) for v in (60, 200, 340)]
    places = chosen(textured(rng, spots), 20.0)
    for spot in spots:
        assert (np.abs(places - spot).max(axis=1) <= 6).sum() == 1


def test_a_new_strip_begins_with_nothing_chosen():
    pixels = textured(np.random.default_rng(7), [(45, 60), (45, 200)])
    chooser = PlaceChooser(MatchingOptions(points_per_s=20.0), WINDOW, 2)
    found = []
    for _ in range(2):
        chooser.begin_strip()
        ring = LineRing(SAMPLES, LINES)
        ring.add(0, pixels)
        found.append([(place.line, place.sample) for place in chooser.choose(ring, RATE_HZ)])
    assert found[0] == found[1] and len(found[0]) == 2
