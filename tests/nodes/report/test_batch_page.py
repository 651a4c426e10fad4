"""The page over many flights."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

from triline.nodes.report.batch_page import _map, _tiles, write_page
from triline.nodes.report.batch_rows import write_tables
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


def flown_with(camera: str, adjusted: bool) -> dict[str, Any]:
    nothing = dict.fromkeys(("damage", "incomplete", "reason", "recording", "tracks"))
    batch = {"sigma0": 1.02, "rejected": 3, "check_rmse_m": [0.1234, 0.2345, None]} if adjusted else None
    return {
        **row(1.0, 60.0, 60.0), **nothing, "damage": [], "incomplete": [], "flight": camera, "camera": camera,
        "strips": 2, "rays": 100, "rejected": 1, "rmse_m": [0.5, 0.6, 0.7], "against": "truth", "steps": {},
        "adjust": batch,
    }  # fmt: skip


def test_page_and_table_say_what_camera_flew_and_the_same_of_the_adjustment(tmp_path: Path):
    """Check points of the adjustment stood on the page alone, and its columns also where nothing had been adjusted."""
    for adjusted in (False, True):
        rows = [flown_with("ads40", adjusted), flown_with("si-100", False)]
        result = {"flights": rows, "jobs": {"failed": 0, "now": 2, "earlier": 0}, "seconds": 1.0, "notes": []}
        write_page(tmp_path / "index.html", result)
        write_tables(tmp_path, result)
        page = (tmp_path / "index.html").read_text()
        heads, *flights = re.findall(r"<tr>(.*?)</tr>", page[page.index("<th>camera</th>") - 99 :], re.DOTALL)[:3]
        assert [len(re.findall("<td", line)) for line in flights] == [heads.count("<th")] * 2
        assert ("adjusted: sigma0" in heads) == adjusted == ("0.123</td>" in page)
        one, other = csv.DictReader((tmp_path / "summary.csv").read_text().splitlines())
        assert (one["camera"], other["camera"]) == ("ads40", "si-100")
        assert one["adjust_rmse_X_m"] == ("0.1234" if adjusted else "") and one["adjust_rmse_Z_m"] == ""
