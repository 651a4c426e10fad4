"""Maps of sensitivity: ellipses and shares against what is known, and against the single pixel."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.location.uncertainty import Sigmas
from triline.solver.sensitivity.inputs import Normal
from triline.solver.sensitivity.located_pixel import AIRCRAFT, AircraftPixel, camera_inputs
from triline.solver.sensitivity.scene_map import scene_map


def turned(column, row):
    """East and north by two parameters: an ellipse of 3 by 1 with its longer axis at an azimuth of 30 degrees, once as
    large with every column; pixels of row 2 see no ground."""
    if row == 2:
        raise ValueError("no ground")
    angle, size = np.radians(30.0), 1.0 + column

    def function(errors):
        along, across = 3.0 * errors[:, :1], errors[:, 1:2]
        towards, beside = np.array([[np.sin(angle), np.cos(angle)]]), np.array([[np.cos(angle), -np.sin(angle)]])
        return size * (along * towards + across * beside)

    return function


def test_ellipses_and_shares():
    found = scene_map(turned, Normal([0.0, 0.0], [1.0, 1.0], ("a", "b")), [0, 1, 2], [0, 1, 2])
    larger, smaller, azimuth = found.ellipses
    np.testing.assert_allclose(larger[:2], [[3, 6, 9]] * 2, rtol=1e-9)
    np.testing.assert_allclose(smaller[:2], [[1, 2, 3]] * 2, rtol=1e-9)
    np.testing.assert_allclose(np.degrees(azimuth[:2]), 30.0, atol=1e-9)
    np.testing.assert_allclose(found.sigma[:2], np.sqrt(10.0) * np.array([[1, 2, 3]] * 2))
    np.testing.assert_allclose(found.share[:2], np.broadcast_to([0.9, 0.1], (2, 3, 2)))
    assert (found.dominating[:2] == 0).all() and (found.dominating[2] == -1).all()
    assert np.isnan(larger[2]).all() and np.isnan(azimuth[2]).all()


def test_towards_the_edge_of_a_swath_roll_gives_way_to_heights():
    def pixel(column, row):
        return AircraftPixel((0.0, 0.0, 2000.0), (0.0, 0.0, 0.0), (0.0, column), 60.0, 0.01, 0.0)

    inputs = camera_inputs(AIRCRAFT, Sigmas((0.0,) * 3, (5e-4, 0.0, 0.0), 0.0, (0.0, 0.0), 2.5), 0.0)
    found = scene_map(pixel, inputs, [0.0, 20.0, 60.0], [0.0])
    tangent = np.array([0.0, 20.0, 60.0]) / 60.0
    by_roll, by_height = 2000.0 * 5e-4 * (1.0 + tangent**2), 2.5 * tangent
    np.testing.assert_allclose(found.sigma[0], np.hypot(by_roll, by_height), rtol=1e-4)
    assert [found.names[k] for k in found.dominating[0]] == ["omega", "omega", "height"]
    np.testing.assert_allclose(found.share[0, :, 9], by_height**2 / (by_roll**2 + by_height**2), rtol=1e-3, atol=1e-9)


def test_nothing_that_scatters():
    with pytest.raises(ValueError, match="no parameter has a sigma above 0"):
        scene_map(turned, Normal([0.0, 0.0], [0.0, 0.0], ("a", "b")), [0], [0])
