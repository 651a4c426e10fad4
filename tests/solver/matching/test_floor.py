"""The floor of the sigma of a match: of pixels that average the ground, of pixels that alias it, and of real ones."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from triline.nodes.config import load
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.matching.options import REAL_FLOOR_PX, SIMULATED_FLOOR_PX, MatchingOptions
from triline.solver.simulation.ground_texture import GroundTexture
from triline.solver.simulation.matching_study import match_strip, tie_errors

BENCH = Path(__file__).parents[3] / "bench"


def nees(floors, monkeypatch, footprint, seed=1):
    """Mean normalised error squared of ties by floor; a pixel sees so large a share of its side."""
    whole = GroundTexture.seen_by
    monkeypatch.setattr(GroundTexture, "seen_by", lambda texture, size: whole(texture, footprint * size))
    settings = {"sensor": "ads40-small", "pixels": 800, "images": True, "seconds": 26.0}
    made = simulated_flight({**settings, "lead_in": 2.0, "seed": seed})
    flight = made.simulation.flight
    images = [made.imager.render(0, ccd, 0, flight.strips[0].lines) for ccd in range(3)]
    error, sigma = tie_errors(flight, match_strip(flight, images).ties)
    good = np.abs(error).max(axis=1) < 0.5
    assert good.sum() > 60 and good.mean() > 0.95
    alone = sigma[good] ** 2 - SIMULATED_FLOOR_PX**2
    return [float((error[good] ** 2 / (alone + floor**2)).mean()) for floor in floors]


@pytest.mark.study
def test_pixels_that_alias_want_a_larger_floor(monkeypatch):
    floors = SIMULATED_FLOOR_PX, REAL_FLOOR_PX

    def mean(footprint):
        with monkeypatch.context() as patch:
            return np.mean([nees(floors, patch, footprint, seed) for seed in (1, 2)], axis=0)

    simulated, too_large = mean(1.0)
    aliased, _ = mean(0.35)
    assert 0.75 < simulated < 1.15 and too_large < 0.6
    assert 1.05 < aliased < 1.45


def test_real_pixels_have_errors_as_large_as_the_floor_of_a_flight_folder_says(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCH))
    real = importlib.import_module("real_pixels")
    if not real.VENTOUX.is_dir():
        pytest.skip("the images are not here")
    found = real.figures(10, 0.1)
    value, low, high = found[f"NEES with a floor of {REAL_FLOOR_PX:g} px"]
    assert 0.75 < value < 1.3 and low < 1.0 < high
    assert found[f"NEES with a floor of {SIMULATED_FLOOR_PX:g} px"][1] > 1.0
    sys.modules.pop("real_pixels")
    # and a flight folder has this floor, unless it says another
    file = tmp_path / "flight.toml"
    file.write_text("[flight]\n")
    assert load(file) == {"matcher": {"image_sigma_px": REAL_FLOOR_PX}}
    file.write_text("[flight]\n[nodes.matcher]\nimage_sigma_px = 0.02\nground_m = 3\n")
    assert load(file) == {"matcher": {"image_sigma_px": 0.02, "ground_m": 3}}
    assert MatchingOptions().image_sigma_px == SIMULATED_FLOOR_PX
