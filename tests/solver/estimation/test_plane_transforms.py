"""Transforms of the plane: exact at map coordinates, sigmas over draws, points that are not enough."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.estimation.plane_transforms import LEAST_POINTS, fit_transform

KINDS = [*((kind, 2) for kind in LEAST_POINTS), ("polynomial", 2), ("polynomial", 3)]
MIDDLE = np.array([500_000.0, 5_400_000.0])


def points(n, seed=0):
    return MIDDLE + np.random.default_rng(seed).uniform(-2000.0, 2000.0, (n, 2))


def truth(kind, xy):
    """A transform of each kind, of map coordinates to pixels."""
    x, y = (xy - MIDDLE).T / 2000.0
    z = x + 1j * y
    if kind in ("helmert", "conformal"):
        w = (3000 + 400j) * z + (70 - 30j) * z**2 * (kind == "conformal") + 1000 + 2000j
        return np.stack([w.real, w.imag], axis=1)
    X, Y = 1000.0 + 3000.0 * x + 200.0 * y, 2000.0 - 300.0 * x + 2500.0 * y
    if kind == "projective":
        return np.stack([X, Y], axis=1) / (1.0 + 0.05 * x - 0.03 * y)[:, None]
    bend = {"affine": 0.0 * x, "pseudo-affine": x * y}.get(kind, x * y + x**2 - 0.5 * y**2)
    return np.stack([X + 40.0 * bend, Y - 25.0 * bend], axis=1)


@pytest.mark.parametrize(("kind", "order"), KINDS)
def test_exact_at_map_coordinates(kind, order):
    xy = points(20)
    found = fit_transform(kind, xy, truth(kind, xy), order=order)
    assert np.abs(found.residuals).max() < 1e-8
    other = points(50, 1)
    np.testing.assert_allclose(found.at(other), truth(kind, other), atol=2e-8)
    assert found.redundancy == 40 - len(found.coefficients) and found.condition < 100.0


@pytest.mark.parametrize(("kind", "order"), KINDS)
def test_least_points_go_through(kind, order):
    least = LEAST_POINTS.get(kind, (order + 1) * (order + 2) // 2)
    xy = points(least, 2)
    found = fit_transform(kind, xy, truth(kind, xy), 1.0, order)
    np.testing.assert_allclose(found.at(xy), truth(kind, xy), atol=1e-6)
    assert found.redundancy == 0 and np.isnan(found.sigma0) and np.isfinite(found.sigma).all()
    with pytest.raises(ValueError, match=f"{kind} transform: {least - 1} points, wanted at least {least}"):
        fit_transform(kind, xy[1:], xy[1:], order=order)


@pytest.mark.parametrize(("kind", "order"), KINDS)
def test_errors_are_as_large_as_their_sigmas(kind, order):
    xy, other = points(25, 3), points(10, 4)
    rng = np.random.default_rng(5)
    normalised, sigma0 = [], []
    for _ in range(150):
        found = fit_transform(kind, xy, truth(kind, xy) + 0.5 * rng.standard_normal((25, 2)), 0.5, order)
        spread = np.sqrt(np.einsum("nkk->nk", found.covariance_at(other)))
        normalised.append((found.at(other) - truth(kind, other)) / spread)
        sigma0.append(found.sigma0)
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(1.0, abs=0.06)
    assert np.sqrt(np.mean(np.square(sigma0))) == pytest.approx(1.0, abs=0.03)


def test_sigma_from_residuals():
    xy = points(400, 6)
    noisy = truth("affine", xy) + 0.3 * np.random.default_rng(7).standard_normal(xy.shape)
    unknown, known = fit_transform("affine", xy, noisy), fit_transform("affine", xy, noisy, 0.3)
    assert unknown.sigma0 == pytest.approx(0.3, rel=0.1)
    np.testing.assert_allclose(unknown.sigma / known.sigma, unknown.sigma0 / 0.3, rtol=1e-9)


@pytest.mark.parametrize("kind", ["affine", "pseudo-affine", "projective", "polynomial"])
def test_points_on_one_line_are_refused(kind):
    t = np.linspace(-1.0, 1.0, 12)[:, None]
    xy = MIDDLE + t * [1500.0, 700.0]
    with pytest.raises(ValueError, match=r"transform: the points determine \d of \d+ parameters \(on one line\?\)"):
        fit_transform(kind, xy, truth("affine", xy))


def test_three_of_four_points_on_one_line_leave_a_projective_open():
    xy = MIDDLE + np.array([[0.0, 0.0], [1000.0, 0.0], [2000.0, 0.0], [500.0, 900.0]])
    with pytest.raises(ValueError, match="of 8 parameters"):
        fit_transform("projective", xy, truth("affine", xy))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda xy: fit_transform("rubber", xy, xy), "transform 'rubber', wanted one of helmert, affine"),
        (lambda xy: fit_transform("affine", xy, xy[:3]), r"points \(9, 2\) and \(3, 2\), wanted"),
        (lambda xy: fit_transform("affine", xy, xy * np.nan), "a coordinate that is not a number"),
        (lambda xy: fit_transform("affine", xy, xy, 0.0), "wanted numbers above 0"),
        (lambda xy: fit_transform("polynomial", xy, xy, order=0), "polynomial of order 0, wanted 1 to 9"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call(points(9))
