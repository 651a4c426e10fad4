"""Rational polynomials: derivatives, inverse, fit to a rigorous model and to points with noise, affine bias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from satellite_scenes import Truth, write_dimap2

from triline.nodes.formats.satellite.read import read_scene
from triline.solver.location.affine_bias import AffineBias, CorrectedModel, fit_bias
from triline.solver.location.rpc import RationalFunctions, Rpc, term_slopes, terms
from triline.solver.location.rpc_fit import fit_to_model, fit_to_points


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene as wide and as long as one of Pleiades."""
    truth = Truth(lines=40_000, samples=40_000, period_s=7e-5, gsd=7.1e-7, tilt_deg=(12.0, -9.0, 1.0))
    folder = tmp_path_factory.mktemp("scene")
    return read_scene(write_dimap2(folder / "scene.xml", truth)).model("rigorous")


@pytest.fixture(scope="module")
def fitted(scene):
    return fit_to_model(scene, -400.0, 9000.0)


def draw(scene, n, seed, low=-400.0, high=9000.0):
    """Latitude, longitude, height, line, sample of pixels anywhere in the box."""
    rng = np.random.default_rng(seed)
    u, v, h = rng.uniform(0, scene.lines - 1, n), rng.uniform(0, scene.samples - 1, n), rng.uniform(low, high, n)
    located = scene.direct(u, v, h)
    return located[:, 0], located[:, 1], h, u, v


def test_derivatives_of_the_terms():
    x = np.random.default_rng(1).uniform(-1, 1, (3, 50))
    for axis in range(3):
        step = np.zeros((3, 1))
        step[axis] = 1e-6
        numeric = (terms(x + step) - terms(x - step)) / 2e-6
        np.testing.assert_allclose(term_slopes(x, axis), numeric, atol=1e-8)


def test_derivatives_of_the_quotients(fitted):
    f = fitted.rpc.to_image
    at = f.in_offset + 0.4 * f.in_scale * np.array([1.0, -0.7, 0.9])
    _, slope = f.with_derivatives(*at)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-5 * f.in_scale[axis]
        numeric = (f.at(*(at + step)) - f.at(*(at - step))) / (2 * step[axis])
        np.testing.assert_allclose(slope[:, :, axis], numeric, rtol=1e-6, atol=1e-6 * np.abs(slope).max() * 1e-3)


def test_fit_is_good_everywhere_in_its_box(scene, fitted):
    lat, lon, h, u, v = draw(scene, 3000, 2)
    assert np.abs(fitted.rpc.inverse(lat, lon, h) - np.stack([u, v], axis=1)).max() < 0.01
    assert fitted.max_px < 0.01 and fitted.smallest_denominator > 0.5


def test_direct_and_inverse_are_a_pair(fitted):
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-0.5, 39_999.5, (2, 500))
    for height in (-400.0, 2000.0, 9000.0):
        located = fitted.rpc.direct(u, v, height)
        np.testing.assert_allclose(fitted.rpc.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_a_hundred_points_with_noise(scene, seed):
    lat, lon, h, u, v = draw(scene, 100, seed, 0.0, 1500.0)
    rng = np.random.default_rng([seed, 1])
    fit = fit_to_points(lat, lon, h, u + rng.normal(0, 0.5, 100), v + rng.normal(0, 0.5, 100))
    assert fit.smallest_denominator > 0
    lat, lon, h, u, v = draw(scene, 2000, [seed, 2], 0.0, 1500.0)
    miss = np.linalg.norm(fit.rpc.inverse(lat, lon, h) - np.stack([u, v], axis=1), axis=1)
    assert np.sqrt(np.mean(miss**2)) < 1.0


def test_fit_over_the_date_line(tmp_path):
    truth = Truth(inclination_deg=98.0, node_deg=180.73, phase_deg=5.0, tilt_deg=(0.0, 0.0, 0.0))
    scene = read_scene(write_dimap2(tmp_path / "scene.xml", truth)).model("rigorous")
    fit = fit_to_model(scene, 0.0, 1000.0)
    lat, lon, h, u, v = draw(scene, 500, 5, 0.0, 1000.0)
    assert lon.min() < -3.0 < 3.0 < lon.max()
    assert np.abs(fit.rpc.inverse(lat, lon, h) - np.stack([u, v], axis=1)).max() < 0.01
    back = fit.rpc.direct(u, v, h)
    turn = (back[:, 1] - lon + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() * 6.4e6 < 0.1


def test_a_denominator_of_zero_gives_no_number_and_is_told(fitted):
    c = fitted.rpc.to_image.coefficients.copy()
    c[1] = 0.0
    c[1, 0], c[1, 1] = 1.0, -2.0  # zero where L is a half
    bad = replace(fitted.rpc.to_image, coefficients=c)
    assert bad.smallest_denominator() <= 0
    at = bad.in_offset + np.array([0.5, 0.0, 0.0]) * bad.in_scale
    sample, line = bad.at(*at)[0]
    assert np.isnan(sample) or abs(sample) > 1e9
    assert np.isfinite(line)
    c[1] = 0.0
    assert np.isnan(replace(fitted.rpc.to_image, coefficients=c).at(*at)[0, 0])


def test_what_is_no_rpc_is_refused():
    good = (np.ones((4, 20)), np.zeros(3), np.ones(3), np.zeros(2), np.ones(2))
    for k, (value, match) in {
        0: (np.ones((4, 19)), "coefficients"), 2: (np.array([1.0, 0.0, 1.0]), "scale is zero"),
        3: (np.array([np.nan, 0.0]), "out_offset"),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match=match):
            RationalFunctions(*[value if i == k else g for i, g in enumerate(good)])


def test_too_few_points_and_heights_in_the_wrong_order(scene):
    with pytest.raises(ValueError, match="9 points, wanted at least 10"):
        fit_to_points(*np.zeros((5, 9)))
    with pytest.raises(ValueError, match="wanted the lower one first"):
        fit_to_model(scene, 100.0, 0.0)


TRUE_BIAS = AffineBias(
    np.array([[3.0, 0.4, -0.2], [-5.0, 0.1, 0.6]]), np.zeros((6, 6)), np.full(2, 2e4), np.full(2, 2e4)
)


def test_what_lies_far_beyond_the_ground_of_polynomials_is_not_in_the_image():
    """Cubics come back: ground 370 km from a Pleiades scene of its own RPC appeared in the image."""
    c = np.zeros((4, 20))
    c[0, 1], c[0, 11], c[2, 2] = 1.0, -1.0 / 25.0, -1.0  # sample by L - L3 / 25, line by -P
    c[1, 0] = c[3, 0] = 1.0
    functions = RationalFunctions(c, [7.0, 43.0, 500.0], [0.1, 0.1, 500.0], [999.5, 999.5], [1000.0, 1000.0])
    rpc = Rpc(functions, None, 2000, 2000)
    lat, lon = np.radians([43.0, 43.0, 43.0]), np.radians([7.05, 7.5, 7.2])
    pixel = rpc.inverse(lat, lon, 500.0, 0.0)
    np.testing.assert_allclose(pixel[0], [999.5, 999.5 + 1000.0 * (0.5 - 0.125 / 25.0)])
    assert np.isnan(pixel[1:]).all()
    assert np.isfinite(rpc.inverse(lat[2:], lon[2:], 500.0, 1000.0)).all()  # a margin is for what lies beside
    assert np.isfinite(rpc.inverse(lat, lon, 500.0)).all()
    unsized = replace(rpc, lines=0, samples=0)
    assert np.isnan(unsized.inverse(lat, lon, 500.0, 0.0)[:, 0]).tolist() == [False, True, False]


def test_a_corrected_model_is_a_pair(fitted):
    model = CorrectedModel(fitted.rpc, TRUE_BIAS)
    u, v = np.random.default_rng(4).uniform(0, 39_999, (2, 100))
    located = model.direct(u, v, 500.0)
    np.testing.assert_allclose(model.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-6)


def test_bias_errors_are_as_large_as_their_sigmas(scene, fitted):
    """Control with errors on the ground and in the image, over seeds: a band on both sides."""
    squares, sigma0 = [], []
    true = CorrectedModel(fitted.rpc, TRUE_BIAS)
    for seed in range(60):
        rng = np.random.default_rng([seed, 6])
        lat, lon, h, _, _ = draw(scene, 25, [seed, 7], 0.0, 1500.0)
        pixel = true.inverse(lat, lon, h) + rng.normal(0, 0.3, (25, 2))
        e = rng.normal(0, 1, (3, 25)) * np.array([[0.2], [0.2], [0.4]])
        radius = 6.371e6
        found = fit_bias(
            fitted.rpc, lat + e[1] / radius, lon + e[0] / radius / np.cos(lat), h + e[2], *pixel.T, 0.3, (0.2, 0.2, 0.4)
        )
        own = AffineBias(TRUE_BIAS.coefficients, TRUE_BIAS.covariance, TRUE_BIAS.middle, TRUE_BIAS.half)
        at = np.array([[0.0, 0.0], [39_999.0, 39_999.0], [0.0, 39_999.0]])
        T = np.concatenate([np.ones((3, 1)), (at - found.bias.middle) / found.bias.half], axis=1)
        error = (found.bias.at(at) - own.at(at)).T.ravel()
        J = np.kron(np.eye(2), T)
        squares.append(error @ np.linalg.solve(J @ found.bias.covariance @ J.T, error) / 6.0)
        sigma0.append(found.sigma0)
    assert 0.8 < np.mean(squares) < 1.25
    assert 0.93 < np.sqrt(np.mean(np.square(sigma0))) < 1.07


def test_control_that_is_worse_than_assumed_is_no_gross_error(scene, fitted):
    """Nobody has stated how well it is measured: 25 points of 3 pixels, where half a pixel is assumed."""
    off, rejected = [], 0
    for seed in range(20):
        lat, lon, h, _, _ = draw(scene, 25, 30 + seed, 0.0, 1500.0)
        true = CorrectedModel(fitted.rpc, TRUE_BIAS).inverse(lat, lon, h)
        pixel = true + np.random.default_rng(seed).normal(0, 3.0, (25, 2))
        fit = fit_bias(fitted.rpc, lat, lon, h, *pixel.T, stated=False)
        rejected += int(fit.rejected.sum())
        off.append(fit.bias.at(true) - TRUE_BIAS.at(true))
        pixel[7, 0] += 60.0
        assert fit_bias(fitted.rpc, lat, lon, h, *pixel.T, stated=False).rejected[7]
    assert rejected < 10  # 1 % of 500; 65 % were
    # 3 pixels of 25 points, 3 coefficients a coordinate
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(3.0 * np.sqrt(3.0 / 25.0), rel=0.2)


def test_control_on_a_line_determines_no_affine_correction(scene, fitted):
    """Noise of a tenth of a pixel, which would be any number of pixels beside the line."""
    t = np.linspace(0.0, 1.0, 20)
    row = np.stack([np.full(20, 20_000.0), 39_000.0 * t], axis=1)
    slanted = np.stack([500.0 + 39_000.0 * t, 1000.0 + 38_000.0 * t], axis=1)
    beside = np.array([2000.0, 35_000.0])
    h = np.linspace(0.0, 1500.0, 21)
    for line in (row, slanted):
        lat, lon = scene.direct(*np.vstack([line, beside]).T, h)[:, :2].T
        true = CorrectedModel(fitted.rpc, TRUE_BIAS).inverse(lat, lon, h)
        pixel = true[:20] + np.random.default_rng(9).normal(0, 0.1, (20, 2))
        with pytest.raises(ValueError, match="lie on a line"):
            fit_bias(fitted.rpc, lat[:20], lon[:20], h[:20], *pixel.T, 0.1)
        shift = fit_bias(fitted.rpc, lat[:20], lon[:20], h[:20], *pixel.T, 0.1, affine=False)
        np.testing.assert_allclose(shift.residual_px[~shift.rejected].mean(axis=0), 0.0, atol=1e-9)
        fit = fit_bias(fitted.rpc, lat, lon, h, *true.T, 0.1)
        np.testing.assert_allclose(fit.bias.at(line), TRUE_BIAS.at(line), atol=1e-3)


def test_a_gross_error_is_found_and_named(scene, fitted):
    lat, lon, h, _, _ = draw(scene, 20, 8, 0.0, 1500.0)
    pixel = CorrectedModel(fitted.rpc, TRUE_BIAS).inverse(lat, lon, h)
    pixel += np.random.default_rng(9).normal(0, 0.3, (20, 2))
    pixel[11, 1] += 6.0
    fit = fit_bias(fitted.rpc, lat, lon, h, *pixel.T, 0.3)
    assert fit.rejected[11] and fit.rejected.sum() <= 2
    assert fit.residual_px[11, 1] > 5.0
    with pytest.raises(ValueError, match="2 control points, wanted at least 3"):
        fit_bias(fitted.rpc, lat[:2], lon[:2], h[:2], *pixel[:2].T)
    shift = fit_bias(fitted.rpc, lat[:1], lon[:1], h[:1], *pixel[:1].T, affine=False)
    np.testing.assert_allclose(shift.bias.coefficients[:, 1:], 0.0)
