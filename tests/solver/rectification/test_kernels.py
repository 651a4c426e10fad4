"""Resampling against polynomials, SciPy's spline and pixels without data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from triline.solver.rectification.kernels import TAPS, Sampler, resampled

RNG = np.random.default_rng(3)
PLACES = RNG.uniform(6.0, 33.0, (2, 500)).astype(np.float32)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
@pytest.mark.parametrize("method", TAPS)
def test_a_plane_comes_back(method, dtype):
    row, column = np.mgrid[0:40, 0:40]
    image = (3 * row + 2 * column).astype(dtype)
    got = Sampler(*PLACES, image.shape, method).values(image)
    places = np.rint(PLACES) if method == "nearest" else PLACES
    assert np.abs(got - (3 * places[0] + 2 * places[1])).max() < (0.1 if method == "lanczos" else 1e-3)


def test_bilinear_as_scipy_and_cubic_through_a_parabola():
    image = RNG.normal(size=(40, 40))
    assert np.allclose(Sampler(*PLACES, image.shape, "bilinear").values(image), map_coordinates(image, PLACES, order=1))
    row, column = np.mgrid[0:40, 0:40].astype(float)
    got = Sampler(*PLACES, image.shape, "cubic").values(row**2 - row * column)
    u, v = PLACES.astype(float)
    assert np.allclose(got, u**2 - u * v, atol=1e-3)  # Keys' kernel reproduces second order


def test_lanczos_is_the_best_of_them_for_a_band_limited_image():
    row, column = np.mgrid[0:40, 0:40].astype(float)
    u, v = PLACES.astype(float)
    error = {}
    for method in TAPS:
        got = Sampler(*PLACES, (40, 40), method).values(np.sin(1.1 * row) + np.cos(0.9 * column))
        error[method] = float(np.sqrt(np.mean((got - np.sin(1.1 * u) - np.cos(0.9 * v)) ** 2)))
    assert error["lanczos"] < error["cubic"] < error["bilinear"] < error["nearest"]
    assert error["lanczos"] < 0.02


@pytest.mark.parametrize("method", TAPS)
def test_pixels_without_data_take_no_part(method):
    image = np.full((40, 40), 7.0, dtype=np.float32)
    good = RNG.random((40, 40)) > 0.2
    image[~good] = 1e6
    (values,), (known,) = resampled([image], [good], *PLACES, method)
    assert known is not None
    nearest = good[tuple(np.rint(PLACES).astype(int))]
    assert (known == nearest).all() and 0.1 < (~known).mean() < 0.3
    assert np.allclose(values[known], 7.0, atol=1e-3)


def test_unknown_method_and_small_images_are_refused():
    with pytest.raises(ValueError, match="wanted one of nearest, bilinear"):
        Sampler(*PLACES, (40, 40), "spline")
    with pytest.raises(ValueError, match="at least 6 pixels"):
        Sampler(*PLACES, (40, 5), "lanczos")
