"""A small flight with image lines, rendered once a process, for tests of what matching makes of it."""

from __future__ import annotations

import functools

from triline.nodes.simulator.flight_settings import simulated_flight
from triline.solver.simulation.matching_study import match_strip

PIXELS = 800


@functools.cache
def flown():
    settings = {"sensor": "ads40-small", "pixels": PIXELS, "images": True, "seconds": 25.0, "height": 800.0}
    return simulated_flight({**settings, "lead_in": 2.0, "seed": 3})


@functools.cache
def images():
    lines = flown().simulation.flight.strips[0].lines
    return [flown().imager.render(0, ccd, 0, lines) for ccd in range(3)]


@functools.cache
def clean():
    """Ties of lines that are as they should be."""
    return match_strip(flown().simulation.flight, images()).ties
