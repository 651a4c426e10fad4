"""Parameters of a frame camera from control: the mixed model with pixels, heights and ground that are all in error."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.location.refraction import Refraction
from triline.solver.rectification.comparison import bilsat_camera
from triline.solver.rectification.frame_parameters import FrameControl, changed, fit_frame, names_of, prior_sigmas
from triline.solver.rectification.sampled import metres_a_radian

PIXEL, HEIGHT_M, GROUND_M = 0.3, 30.0, 15.0
SIGMAS = {"pixel_sigma": PIXEL, "height_sigma_m": HEIGHT_M, "ground_sigma_m": GROUND_M}


def control(rng, camera, points=28):
    """Points over the image, with relief, and what is observed of them."""
    line, sample = rng.uniform(0, 2047, points), rng.uniform(0, 2047, points)
    height = rng.uniform(0.0, 2500.0, points)
    lat, lon, _ = camera.direct(line, sample, height).T
    east, north = metres_a_radian(lat, height, camera.ellipsoid)
    return FrameControl(
        line + PIXEL * rng.standard_normal(points), sample + PIXEL * rng.standard_normal(points),
        lat + GROUND_M / north * rng.standard_normal(points), lon + GROUND_M / east * rng.standard_normal(points),
        height + HEIGHT_M * rng.standard_normal(points),
    )  # fmt: skip


def drawn(rng, parameters):
    """A camera whose parameters are off by their prior sigmas, and by how much."""
    off = prior_sigmas(parameters) * rng.standard_normal(parameters)
    return changed(bilsat_camera(), dict(zip(names_of(parameters), off.tolist(), strict=True))), off


@pytest.mark.parametrize("parameters", [12, 14])
def test_parameters_that_change_together_are_those_that_change_one_by_one(parameters):
    together, off = drawn(np.random.default_rng(3), parameters)
    camera = bilsat_camera()
    for name, value in zip(names_of(parameters), off.tolist(), strict=True):
        camera = changed(camera, {name: value})
    camera, together = (changed(c, {"k3": 1e-12}) for c in (camera, together))
    for name in ("position_e", "R_ec", "focal_length_mm", "pixel_mm", "principal_point_mm", "distortion"):
        one, other, start = (getattr(c, name) for c in (camera, together, bilsat_camera()))
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-14 if name == "distortion" else 1e-12)
        assert np.any(other != start) or (name == "pixel_mm" and parameters == 12), name
    with pytest.raises(KeyError, match="focus is no parameter"):
        changed(camera, {"f": 0.1, "focus": 1.0})


@pytest.mark.parametrize(
    ("parameters", "seeds"),
    [(12, 4), pytest.param(12, 20, marks=pytest.mark.study), pytest.param(14, 20, marks=pytest.mark.study)],
)
def test_errors_are_as_large_as_their_sigmas(parameters, seeds):
    share = 2.8 / np.sqrt(2 * parameters * seeds)  # of normalised errors, two-sided, one in 200
    prior, normalised, sigma0, corrections = prior_sigmas(parameters), [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        camera, off = drawn(rng, parameters)
        fit = fit_frame(
            bilsat_camera(), control(rng, camera), names_of(parameters), prior_sigma=prior, snoop=False, **SIGMAS
        )
        normalised.append(np.linalg.solve(np.linalg.cholesky(fit.found.covariance), fit.found.parameters - off))
        sigma0.append(fit.found.sigma0)
        corrections.append(fit.found.w[:, :5])
    assert abs(np.sqrt(np.mean(np.square(normalised))) - 1.0) < share
    assert abs(np.sqrt(np.mean(np.square(sigma0))) - 1.0) < 2.8 / np.sqrt(2 * 56 * seeds)
    assert 0.9 < np.sqrt(np.mean(np.square(corrections))) < 1.1  # corrections over their sigmas


def test_the_camera_locates_and_a_blunder_is_left_out():
    rng = np.random.default_rng(7)
    camera, _ = drawn(rng, 14)
    points = control(rng, camera)
    points.sample[5] += 12.0
    fit = fit_frame(bilsat_camera(), points, names_of(14), prior_sigma=prior_sigmas(14), **SIGMAS)
    assert np.flatnonzero(fit.found.rejected).tolist() == [5]
    grid = np.linspace(0, 2047, 5)
    line, sample = (a.ravel() for a in np.meshgrid(grid, grid))
    truth, found, start = (c.ground(line, sample, np.full(25, 1000.0)) for c in (camera, fit.camera, bilsat_camera()))
    error, before = (np.sqrt(np.mean(np.sum((a - truth) ** 2, axis=1))) for a in (found, start))
    assert error < 15.0 < 150.0 < before


def test_the_air_stays_where_it_is():
    """Control of a camera that sees through the air and looks 40 degrees aside changes nothing of that camera."""
    camera = changed(bilsat_camera(), {"phi": np.radians(40.0)}).with_refraction(Refraction())
    line, sample = (a.ravel() for a in np.meshgrid(*[np.linspace(0, 2047, 5)] * 2))
    lat, lon, height = camera.direct(line, sample, np.full(25, 500.0)).T
    points, names = FrameControl(line, sample, lat, lon, height), ("omega", "phi", "kappa")
    fit = fit_frame(camera, points, names, prior_sigma=np.full(3, 1e-3), snoop=False, **SIGMAS)
    assert np.abs(fit.found.parameters).max() < 1e-12
    found, truth = (c.ground(line, sample, np.full(25, 2000.0)) for c in (fit.camera, camera))
    assert np.linalg.norm(found - truth, axis=1).max() < 1e-6


def test_a_parameter_that_is_held():
    rng = np.random.default_rng(8)
    camera, off = drawn(rng, 12)
    held = {"f": float(off[0])}
    fit = fit_frame(
        bilsat_camera(), control(rng, camera), names_of(12), prior_sigma=prior_sigmas(12), constraints=held,
        snoop=False, **SIGMAS,
    )  # fmt: skip
    assert fit.found.parameters[0] == pytest.approx(off[0], abs=1e-9) and fit.found.sigma[0] < 1e-6
    assert fit.camera.focal_length_mm == pytest.approx(bilsat_camera().focal_length_mm + off[0])


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_bad_input():
    rng = np.random.default_rng(9)
    points = control(rng, bilsat_camera(), 2)
    with pytest.raises(ValueError, match=r"points, 2 conditions each|not determined"):
        fit_frame(bilsat_camera(), points, names_of(12), prior_sigma=np.full(12, np.inf), **SIGMAS)
    nowhere = (1e6, 1e6, 0.7, 0.6, 0.0)
    lost = FrameControl(*(np.append(a, b) for a, b in zip(vars(points).values(), nowhere, strict=True)))
    with pytest.raises(ValueError, match=r"control point 2 .counted from 0.: its pixel sees no ground"):
        fit_frame(bilsat_camera(), lost, names_of(12), prior_sigma=prior_sigmas(12), **SIGMAS)
