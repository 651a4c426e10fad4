"""The page over many flights."""

from __future__ import annotations

from typing import Any

from triline.nodes.report.batch_page import _map, _tiles
from triline.nodes.report.style import styled


def row(good: float, on_strips_s: float, flown_s: float) -> dict[str, Any]:
    light = {"good": good, "weak": 1.0 - good, "failed": 0.0}
    return {"state": "finished", "seconds": flown_s, "sigma0": 1.0, "nees": None, "light": light, "lit_s": on_strips_s}


def test_the_share_of_the_light_is_that_of_the_time_on_strips():
    """A flight of long turns does not count for more than its strips."""
    tiles = _tiles({"flights": [row(1.0, 600.0, 3600.0), row(0.0, 1800.0, 1900.0)], "jobs": {"failed": 0}})
    assert ("25 %", "of the time on strips under a good light", "") in tiles


def test_flights_at_one_place_are_named_once_and_seen_beside_one_far_away():
    def flown(flight, lon, lat):
        return row(1.0, 60.0, 60.0) | {
            "flight": flight,
            "tracks": [{"lon_deg": [lon, lon + 0.01], "lat_deg": [lat, lat]}],
        }

    rows = [flown("valley_of_the_river_in_the_north_2026-05-01_aircraft_two", 8.9, 48.9), flown("b", 8.9, 48.91)]
    rows += [flown("c", 8.91, 48.9), flown("south", 18.4, -33.9)]
    with styled():
        figure = _map(rows)
    assert figure is not None
    (axes,) = figure.axes
    names = [text.get_text() for text in axes.texts]
    assert sorted(names) == ["b + 2", "south"]
    assert all(line.get_marker() == "." for line in axes.get_lines())
