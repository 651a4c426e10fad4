"""The mixed model: beside orthogonal distance regression, over seeds, outliers, constraints, variance components."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.estimation.mixed_model import MixedModel, estimate, variance_components
from triline.solver.geometry.rotation import matrix_from_angles

TRUE = np.array([0.02, -0.01, 0.3, 100.0, -50.0, 3000.0])  # omega, phi, kappa, X, Y, Z
SCALE = np.array([1.0, 1.0, 1.0, 3000.0, 3000.0, 3000.0])
SIGMA = np.array([0.004, 0.004, 2.0])  # image in mm, height in m


def ground_of(beta, xyh, focal_mm=100.0):
    """Where a frame camera locates image points (mm) at heights: X, Y."""
    d = np.column_stack([xyh[:, :2], np.full(len(xyh), -focal_mm)]) @ matrix_from_angles(*beta[:3]).T
    return beta[3:5] + d[:, :2] * ((xyh[:, 2] - beta[5]) / d[:, 2])[:, None]


def control(rng, points=16, sigma=SIGMA):
    """True ground coordinates, and observed image points and heights."""
    xyh = np.column_stack([rng.uniform(-80, 80, (points, 2)), rng.uniform(0, 800, points)])
    return ground_of(TRUE, xyh), xyh + sigma * rng.standard_normal(xyh.shape)


def camera(ground, observed, sigma=SIGMA, **more):
    def conditions(beta, xyh):
        return ground_of(beta, xyh[:, :3]) - xyh[:, 3:]

    known = np.column_stack([observed, ground])  # ground coordinates without error
    start = TRUE + np.array([0.01, 0.01, 0.01, 20.0, 20.0, 20.0])
    return MixedModel(conditions, known, [*sigma, 0.0, 0.0], start, SCALE, **more)


def test_beside_odrpack():
    odrpack = pytest.importorskip("odrpack")
    rng = np.random.default_rng(1)
    ground, observed = control(rng)
    # the regression wants a result with an error too: one of the ground, 0.5 m
    known = np.column_stack([observed, ground + 0.5 * rng.standard_normal(ground.shape)])
    sigma = np.array([*SIGMA, 0.5, 0.5])
    base = camera(ground, observed)
    ours = estimate(MixedModel(base.conditions, known, sigma, TRUE, SCALE))
    theirs = odrpack.odr_fit(
        lambda x, b: ground_of(b, x.T).T, known[:, :3].T, known[:, 3:].T, TRUE + 0.0,
        weight_x=1.0 / SIGMA**2, weight_y=np.full(2, 4.0), sstol=1e-15, partol=1e-15, maxit=500,
        diff_scheme="central", step_beta=np.full(6, 1e-6),
    )  # fmt: skip
    assert theirs.success
    assert (np.abs(theirs.beta - ours.parameters) / ours.sigma).max() < 1e-6
    assert (np.abs(theirs.delta.T - ours.corrections[:, :3]) / SIGMA).max() < 1e-6


def test_linear_regression_with_errors_in_both_in_closed_form():
    # Deming: slope of a line with equal sigmas is that of the first axis of the scatter
    rng = np.random.default_rng(2)
    t = np.linspace(0.0, 10.0, 30)
    xy = np.column_stack([t, 0.5 * t + 1.0]) + 0.3 * rng.standard_normal((30, 2))
    found = estimate(MixedModel(lambda b, v: (v[:, 1] - b[0] - b[1] * v[:, 0])[:, None], xy, 0.3, [0.0, 1.0]))
    axis = np.linalg.svd(xy - xy.mean(axis=0))[2][0]
    assert found.parameters[1] == pytest.approx(axis[1] / axis[0], abs=1e-9)
    assert found.parameters[0] == pytest.approx(xy[:, 1].mean() - found.parameters[1] * xy[:, 0].mean(), abs=1e-8)
    across = (xy - xy.mean(axis=0)) @ [-axis[1], axis[0]]
    assert found.sigma0 == pytest.approx(np.sqrt(np.sum(across**2) / 0.09 / 28), rel=1e-6)
    fitted = xy + found.corrections
    np.testing.assert_allclose(fitted[:, 1], found.parameters[0] + found.parameters[1] * fitted[:, 0], atol=1e-8)


def test_errors_are_as_large_as_their_sigmas_over_100_seeds():
    errors, sigma0, tests = [], [], []
    for seed in range(100):
        found = estimate(camera(*control(np.random.default_rng(seed))))
        errors.append((found.parameters - TRUE) / found.sigma)
        sigma0.append(found.sigma0)
        tests.append(found.w[:, :3])
    assert 0.95 < np.sqrt(np.mean(np.square(errors))) < 1.05
    assert np.mean(np.square(sigma0)) == pytest.approx(1.0, abs=0.06)
    assert np.std(tests) == pytest.approx(1.0, abs=0.05)


def test_steps_of_the_size_of_rounding_end():
    """A limit below what numerical derivatives can give is not waited for."""
    ground, observed = control(np.random.default_rng(4))
    usual, finest = (estimate(camera(ground, observed, last_step=step)) for step in (1e-6, 1e-17))
    assert finest.iterations < 20
    assert (np.abs(finest.parameters - usual.parameters) < 1e-4 * usual.sigma).all()


def test_an_outlier_is_found():
    ground, observed = control(np.random.default_rng(3), 20)
    observed[7, 0] += 0.08  # 20 sigma in the image
    found = estimate(camera(ground, observed), snoop=True)
    assert np.flatnonzero(found.rejected).tolist() == [7]
    assert np.abs(found.w[7]).max() > 3.3 and np.isnan(found.corrections[7]).all()
    assert (np.abs(found.parameters - TRUE) < 4 * found.sigma).all()


def test_constraints_and_prior_values():
    ground, observed = control(np.random.default_rng(4))
    free = estimate(camera(ground, observed))
    fixed = estimate(camera(ground, observed, constraint=np.eye(6)[5:], value=[3000.0]))
    assert fixed.parameters[5] == pytest.approx(3000.0, abs=1e-6) and fixed.sigma[5] == pytest.approx(0.0, abs=1e-6)
    assert fixed.redundancy == free.redundancy + 1 and fixed.sigma[0] <= free.sigma[0]
    tight = np.full(6, np.inf)
    tight[5] = 1e-6
    held = estimate(camera(ground, observed, prior=TRUE, prior_sigma=tight))
    np.testing.assert_allclose(held.parameters, fixed.parameters, rtol=1e-7)


def test_variance_components():
    sigma = np.array([0.004, 0.004, 6.0])  # heights three times as wrong as stated
    ground, observed = control(np.random.default_rng(5), 400, sigma)
    found = variance_components(camera(ground, observed), ("image", "image", "height", "ground", "ground"))
    assert found.factors["image"] == pytest.approx(1.0, abs=0.15)
    assert found.factors["height"] == pytest.approx(3.0, rel=0.1)
    assert found.sigma0 == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": -1.0}, "sigmas of the observations, wanted numbers of at least 0"),
        ({"sigma": 0.0}, "a condition holds observations without error only"),
        ({"observations": np.ones((2, 2)) + np.eye(2)}, "2 points, 1 conditions each, wanted at least 3 conditions"),
        ({"prior": [0.0, 0.0, 0.0]}, "prior values, wanted with their sigmas"),
        ({"constraint": [[1.0, 0.0, 0.0]]}, "wanted one value a row of 3"),
        ({"conditions": lambda b, v: (v[:, 1] - b[0] - b[1] * v[:, 0] - b[2])[:, None]}, "is not determined"),
        ({"conditions": lambda b, v: v[:, :1] * np.nan}, "point 0: its condition is not a number"),
    ],
)
def test_bad_input(change, message):
    t = np.linspace(-1.0, 1.0, 9)
    good = {
        "conditions": lambda b, v: (v[:, 1] - b[0] - b[1] * v[:, 0] - b[2] * v[:, 0] ** 2)[:, None],
        "observations": np.column_stack([t, t**2]), "sigma": 0.1, "start": [0.0, 1.0, 0.0],
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        estimate(MixedModel(**(good | change)))
