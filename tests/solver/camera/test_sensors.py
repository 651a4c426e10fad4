"""Camera presets, lines from parameters, Brown's distortion."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.camera.line_camera import Lens
from triline.solver.camera.sensors import (
    PRESETS,
    brown_distortion,
    lens_rotation,
    lens_views_deg,
    line_from_parameters,
    preset,
)
from triline.solver.geometry.rotation import matrix_from_angles


@pytest.mark.parametrize(
    "name, focal_length, pixels, views",
    [
        ("ads40", 62.7, 12000, {"F": 26.0, "N": 0.0, "B": -16.0}),
        ("ads40-pavia", 62.77, 12000, {"F": 28.4, "N": 0.0, "B": -14.2}),
        ("si-100", 60.0, 10200, {"F": 21.0, "N": 0.0, "B": -21.0}),
        ("si-290", 93.0, 14400, {"F": 15.0, "N": 0.0, "B": -23.0}),
    ],
)
def test_one_lens_presets_look_where_they_should(name, focal_length, pixels, views):
    camera = preset(name)
    assert len(camera.lenses) == 1 and camera.lenses[0].focal_length_mm == focal_length
    seen = {line.id: np.degrees(np.arctan2(line.centre_mm[0], focal_length)) for line in camera.lines}
    assert seen == pytest.approx(views)
    assert all(line.pixels == pixels for line in camera.lines)
    assert lens_views_deg(name) == {"L1": 0.0}


def test_stereo_angles_of_the_pavia_camera():
    """Forward/nadir 28.4 and forward/backward 42.6 deg."""
    x = {line.id: line.centre_mm[0] for line in preset("ads40-pavia").lines}
    angle = {id: np.degrees(np.arctan2(v, 62.77)) for id, v in x.items()}
    assert angle["F"] - angle["N"] == pytest.approx(28.4) and angle["F"] - angle["B"] == pytest.approx(42.6)


@pytest.mark.parametrize(
    "name, height_km, gsd_m, swath_km, views",
    [
        ("alos-prism", 692, 2.5, None, {"F": 23.8, "N": 0.0, "B": -23.8}),
        ("spot5-hrs", 822, 9.2, 110, {"F": 20.0, "B": -20.0}),
        ("aster-vnir", 705, 15.0, 61.5, {"3N": 0.0, "3B": -27.6}),
    ],
)
def test_satellite_presets_have_their_ground_sample(name, height_km, gsd_m, swath_km, views):
    camera = preset(name)
    assert lens_views_deg(name) == views
    assert [lens.id for lens in camera.lenses] == [line.id for line in camera.lines] == list(views)
    line = camera.lines[0]
    ground = height_km * 1e3 * np.diff(line.xy_mm[:, 1]) / camera.lenses[0].focal_length_mm
    assert np.mean(ground) == pytest.approx(gsd_m, rel=0.02)
    if swath_km is not None:
        assert ground.sum() / 1e3 == pytest.approx(swath_km, rel=0.02)
    np.testing.assert_allclose(line.xy_mm[:, 0], 0.0)


def test_prism_chips_overlap_by_32_pixels():
    camera = preset("alos-prism")
    for line in camera.lines:
        assert line.chips == (0, 4960, 9920, 14880)
        assert line.pixels == 14880 + 4992
        assert line.chips[0] + 4992 - line.chips[1] == 32


def test_aster_lines_have_their_own_length():
    assert {line.id: line.pixels for line in preset("aster-vnir").lines} == {"3N": 4100, "3B": 5000}


def test_a_lens_that_looks_forward_looks_forward():
    """The axis of the lens points ahead of nadir by its angle; the rotation is the photogrammetric one about y."""
    axis = lens_rotation(23.8) @ np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(axis, [np.sin(np.radians(23.8)), 0.0, -np.cos(np.radians(23.8))])
    np.testing.assert_allclose(lens_rotation(23.8), matrix_from_angles(0.0, -np.radians(23.8), 0.0))
    np.testing.assert_allclose(lens_rotation(10) @ lens_rotation(-10), np.eye(3), atol=1e-15)


def test_unknown_preset_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"ads40.*aster-vnir"):
        preset("ads80")
    assert len(PRESETS) == 9


def test_line_from_parameters_is_straight_and_inclined():
    """[K 4.2, 4.3]: x = xc + (v - vmid) ps sin th, y = yc + (v - vmid) ps cos th."""
    line = line_from_parameters("N", Lens("L", 60.0), 1001, 0.01, (2.0, 1.0), np.radians(3.0))
    v = np.array([0, 500, 1000])
    wanted = np.column_stack(
        [2.0 + (v - 500) * 0.01 * np.sin(np.radians(3)), 1.0 + (v - 500) * 0.01 * np.cos(np.radians(3))]
    )
    np.testing.assert_allclose(line.xy_mm[v], wanted, atol=1e-12)


def test_distortion_terms_one_by_one():
    x, y = 3.0, -4.0
    r2 = 25.0
    for i, wanted in enumerate(
        [
            (x * r2, y * r2),
            (x * r2**2, y * r2**2),
            (x * r2**3, y * r2**3),
            (r2 + 2 * x * x, 2 * x * y),
            (2 * x * y, r2 + 2 * y * y),
        ]
    ):
        k = np.zeros(5)
        k[i] = 1e-3
        np.testing.assert_allclose(brown_distortion([x, y], *k), np.array(wanted) * 1e-3)


def test_distortion_is_about_the_principal_point():
    coefficients = (1e-5, 2e-9, 0.0, 3e-6, -1e-6)
    shift = np.array([0.3, -0.2])
    about_zero = line_from_parameters("N", Lens("L", 60.0, (0.0, 0.0), coefficients), 500, 0.01, (1.0, 0.0))
    moved = line_from_parameters("N", Lens("L", 60.0, (0.3, -0.2), coefficients), 500, 0.01, (1.3, -0.2))
    np.testing.assert_allclose(moved.xy_mm - shift, about_zero.xy_mm, atol=1e-12)
    straight = line_from_parameters("N", Lens("L", 60.0), 500, 0.01, (1.0, 0.0))
    assert np.abs(about_zero.xy_mm - straight.xy_mm).max() > 1e-4
