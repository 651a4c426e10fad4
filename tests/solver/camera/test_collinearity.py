"""Collinearity: derivatives against central differences, image motion, look-up tables."""

import numpy as np
import pytest

from triline.solver.camera.collinearity import image_motion, project, sine_and_cosine
from triline.solver.camera.line_camera import CcdLine, Lens, LineCamera, straight_line, three_line_camera
from triline.solver.geometry.rotation import matrix_from_angles

RNG = np.random.default_rng(3)
N = 40
POSITION = RNG.normal([0, 0, 1500], 100, (N, 3))
ANGLES = RNG.normal(0, 0.05, (N, 3)) + np.column_stack([np.zeros(N), np.zeros(N), RNG.uniform(-3, 3, N)])
POINT = RNG.normal(0, 400, (N, 3)) * [1, 1, 0.1]
C = np.full(N, 62.7)


def test_sine_and_cosine_on_the_whole_circle_and_beyond():
    quarters = np.pi / 2 * np.arange(-8, 9)
    angles = np.concatenate([np.linspace(-9, 9, 2000), quarters, quarters + 1e-9, [0.0]])
    sine, cosine = sine_and_cosine(angles)
    np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=5e-16)
    np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=5e-16)
    small = 1e-3 * np.linspace(-1, 1, 100)
    np.testing.assert_allclose(sine_and_cosine(small)[0], np.sin(small), rtol=1e-15)


def test_projection_meets_the_ray():
    xy = project(POSITION, ANGLES, POINT, C).xy_mm
    ray_c = np.column_stack([xy, -C])
    ray_l = np.einsum("nij,nj->ni", matrix_from_angles(*ANGLES.T), ray_c)
    assert np.abs(np.cross(ray_l, POINT - POSITION)).max() < 1e-8
    assert project(POSITION, ANGLES, POINT, C).in_front.all()


@pytest.mark.parametrize("unknown", range(9))
def test_derivatives_against_central_differences(unknown):
    step = 1e-3 if unknown < 3 or unknown > 5 else 1e-6
    shift = np.zeros(9)
    shift[unknown] = step

    def xy(sign):
        d = sign * shift
        return project(POSITION + d[:3], ANGLES + d[3:6], POINT + d[6:], C).xy_mm

    p = project(POSITION, ANGLES, POINT, C)
    ours = p.d_orientation[:, :, unknown] if unknown < 6 else p.d_point[:, :, unknown - 6]
    np.testing.assert_allclose(ours, (xy(1) - xy(-1)) / (2 * step), rtol=1e-6, atol=1e-6 * np.abs(ours).max())


def test_image_motion_is_the_time_derivative():
    velocity, rate = RNG.normal(0, 70, (N, 3)), RNG.normal(0, 0.02, (N, 3))
    p = project(POSITION, ANGLES, POINT, C)
    h = 1e-5
    plus = project(POSITION + h * velocity, ANGLES + h * rate, POINT, C).xy_mm
    minus = project(POSITION - h * velocity, ANGLES - h * rate, POINT, C).xy_mm
    motion = image_motion(p.d_orientation, velocity, rate)
    np.testing.assert_allclose(motion, (plus - minus) / (2 * h), rtol=1e-6, atol=1e-6)


def test_three_line_camera_has_the_viewing_angles():
    camera = three_line_camera("ads40", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})
    centres = np.array([line.centre_mm for line in camera.lines])
    np.testing.assert_allclose(np.degrees(np.arctan2(centres[:, 0], 62.7)), [26, 0, -16], atol=1e-12)
    np.testing.assert_allclose(centres[:, 1], 0, atol=1e-12)


def test_table_is_linear_between_pixel_centres():
    line = straight_line("N", "L1", 100, 0.01, (1.0, 0.0), inclination_rad=0.01)
    xy, pitch = line.image_coordinates(np.array([10.0, 10.25, 99.4]))
    np.testing.assert_allclose(xy[0], line.xy_mm[10])
    np.testing.assert_allclose(xy[1], line.xy_mm[10] + 0.25 * (line.xy_mm[11] - line.xy_mm[10]))
    np.testing.assert_allclose(np.hypot(*pitch.T), 0.01)
    np.testing.assert_array_equal(line.contains([-0.6, -0.5, 99.5, 99.6]), [False, True, True, False])


def test_principal_point_is_taken_off():
    camera = LineCamera("c", (Lens("A", 50.0, (0.1, -0.2)),), (straight_line("N", "A", 11, 0.01, (0.0, 0.0)),))
    xy, _ = camera.image_coordinates(np.array([0]), np.array([5.0]))
    np.testing.assert_allclose(xy, [[-0.1, 0.2]], atol=1e-15)


def test_cameras_that_contradict_themselves_are_refused():
    line = CcdLine("N", "Z", np.zeros((2, 2)))
    with pytest.raises(ValueError, match="lens 'Z'"):
        LineCamera("c", (Lens("A", 50.0),), (line,))
    twice = CcdLine("N", "A", np.zeros((2, 2)))
    with pytest.raises(ValueError, match="same id"):
        LineCamera("c", (Lens("A", 50.0),), (twice, twice))
