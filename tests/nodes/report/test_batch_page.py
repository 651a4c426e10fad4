"""The page over many flights."""

from __future__ import annotations

from typing import Any

from triline.nodes.report.batch_page import _tiles


def row(good: float, on_strips_s: float, flown_s: float) -> dict[str, Any]:
    light = {"good": good, "weak": 1.0 - good, "failed": 0.0}
    return {"state": "finished", "seconds": flown_s, "sigma0": 1.0, "nees": None, "light": light, "lit_s": on_strips_s}


def test_the_share_of_the_light_is_that_of_the_time_on_strips():
    """A flight of long turns does not count for more than its strips."""
    tiles = _tiles({"flights": [row(1.0, 600.0, 3600.0), row(0.0, 1800.0, 1900.0)], "jobs": {"failed": 0}})
    assert ("25 %", "of the time on strips under a good light", "") in tiles
