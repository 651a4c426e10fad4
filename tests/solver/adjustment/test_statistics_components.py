"""Variance components, direct georeferencing, and how errors compare with the sigmas stated for them, over seeds."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.covariance import cofactors, point_cofactors
from triline.solver.adjustment.direct_georeferencing import georeference
from triline.solver.adjustment.job import Job, run
from triline.solver.adjustment.statistics import global_test
from triline.solver.adjustment.variance_components import (
    CALIBRATION,
    CONSTANTS,
    GROUPS,
    estimate_components,
    group_sums,
)
from triline.solver.camera.self_calibration import left_by_calibration, tls
from triline.solver.camera.sensors import preset
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.simulation.network import Noise, parallel_and_cross, scatter_points, simulate_network

CAMERA = preset("ads40")
MODEL = DgrOptions((0.1, 0.1, 0.2), (0.005, 0.005, 0.008), (0.005, 0.005, 0.008))


def block(seed, points=60, control=6, errors=MODEL, **more):
    rng = np.random.default_rng(seed)
    ground = scatter_points(points, (-1500, 1500, -1200, 1200), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)
    lines = parallel_and_cross(CAMERA, 2000.0, 2, 2, 3000.0)
    check = range(control, min(25, points))
    return simulate_network(
        CAMERA, lines, ground, dict.fromkeys(range(control), "control"), check, errors, rng, Noise(), **more
    )


def wrong_by(network, image=1.0, control=1.0):
    """The same network with image and control sigmas stated wrongly: this many times too large."""
    rays = network.rays
    sigma = {name: getattr(rays, name) * image for name in ("sigma_line_px", "sigma_sample_px")}
    given = replace(network.control, sigma_m=network.control.sigma_m * control)
    return replace(network, rays=replace(rays, **sigma), control=given)


def scaled_model(position, attitude):
    return DgrOptions(*(tuple(f * s for s in v) for f, v in (
        (position, MODEL.offset_sigma_m), (attitude, MODEL.shift_sigma_deg), (attitude, MODEL.drift_sigma_deg),
    )))  # fmt: skip


def test_group_redundancies_sum_up():
    solution = adjust(block(1).network, MODEL)
    sums = group_sums(solution, cofactors(solution))
    assert sum(r for _, _, r in sums.values()) == pytest.approx(solution.redundancy, rel=1e-6)
    assert sum(s for _, s, _ in sums.values()) == pytest.approx(solution.cost, rel=1e-9)
    assert sum(n for n, _, _ in sums.values()) == solution.n_observations


@cache
def without_camera(seed):
    """A small network, and the global test of its adjustment without parameters of the camera; to be read only."""
    network = block(seed, points=12).network
    return network, run(network, Job(MODEL)).test


@pytest.mark.parametrize("how", ["usual", "free", "stated"])
def test_usual_sigmas_of_a_camera_are_no_observations(how):
    """A camera without errors leaves them no residuals: as observations they make sigma0 too small."""
    parameters = {"usual": tls(CAMERA), "free": tls(CAMERA).free(), "stated": tls(CAMERA).scaled(1.0)}[how]
    plain, with_camera = [], []
    for seed in range(20):
        network, test = without_camera(seed)
        plain.append(test)
        result = run(network, Job(MODEL, self_calibration=parameters, eliminate=False))
        with_camera.append(result.test)
        of_groups = sum(r for _, _, r in result.groups.values())
        assert abs(with_camera[-1].redundancy - of_groups) < 1.0 or how == "stated"
    least = plain[0].redundancy - 18
    assert (
        plain[0].redundancy == with_camera[0].redundancy if how == "stated" else with_camera[0].redundancy <= least + 1
    )
    ratio = np.mean([t.sigma0**2 for t in with_camera]) / np.mean([t.sigma0**2 for t in plain])
    assert ratio < 0.93 if how == "stated" else ratio == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("stated", [False, True])
def test_what_is_known_of_the_trajectory_counts_once_in_two_models(stated):
    """A second model finds next to nothing beside what it would let be: as observations that makes sigma0 too small."""
    second = LimOptions(4, True, MODEL.offset_sigma_m, MODEL.shift_sigma_deg)
    one, two = [], []
    for seed in range(12):
        network, test = without_camera(seed)
        one.append(test)
        result = run(network, Job(MODEL, second, then_stated=stated))
        two.append(result.test)
        measured = result.measured_redundancy
        assert stated or abs(result.test.redundancy - measured) < 1.0
    ratio = np.sqrt(np.mean([t.sigma0**2 for t in two]) / np.mean([t.sigma0**2 for t in one]))
    assert ratio < 0.9 if stated else 0.93 < ratio < 1.02


def test_components_recover_sigmas_that_were_stated_wrongly():
    """Image twice too small, control 3 times too large, position 4 times too large, attitude half."""
    factors = []
    for seed in range(10):
        network = wrong_by(block(seed, control=20).network, image=0.5, control=3.0)
        found = estimate_components(adjust(network, scaled_model(4.0, 0.5)))
        assert found.converged and found.solution.sigma0 == pytest.approx(1.0, abs=0.02)
        factors.append([c.factor for c in found.components])
    assert [c.group for c in found.components] == [g for g in GROUPS if g not in CONSTANTS]
    rms = np.sqrt(np.mean(np.square(factors), axis=0))
    np.testing.assert_allclose(rms, [2.0, 1 / 3, 0.25, 2.0, 1.0, 1.0], rtol=0.2)


def test_component_of_a_group_without_redundancy_is_not_guessed():
    found = estimate_components(adjust(block(1, control=1).network, MODEL))
    control = next(c for c in found.components if c.group == "control")
    assert not control.estimated and control.factor == 1.0


def test_components_work_with_continuity_constraints():
    options = PpmOptions(segments=2, offset_sigma_m=(0.1,) * 3, shift_sigma_deg=(0.005,) * 3)
    network = wrong_by(block(2, errors=options).network, image=0.5)
    found = estimate_components(adjust(network, options))
    assert next(c for c in found.components if c.group == "image").factor == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("share", [0.0, 1.0, 40.0])
def test_a_camera_is_questioned_where_it_contradicts_its_calibration(share):
    """As perfect, as calibrated, and some pixels off; then the sigma is stated anew, and that of points is right."""
    left, factors, ratio = left_by_calibration(CAMERA), [], []
    for seed in range(6):
        drawn = np.random.default_rng(seed).normal(0.0, left.apriori_sigma)
        drawn[np.isin(left.unknown_names, left.questioned_names)] *= share
        values = dict(zip(left.unknown_names, drawn.tolist(), strict=True))
        simulated = block(seed, control=12, self_calibration=left, camera_parameters=values)
        found = estimate_components(adjust(simulated.network, MODEL, left))
        calibration = next(c for c in found.components if c.group == CALIBRATION)
        assert calibration.estimated == (share > 1.0)
        factors.append(calibration.factor)
        error = found.solution.state.points_l - simulated.points_l
        Q = point_cofactors(found.solution)
        ratio.append(np.einsum("pi,pi->p", error, np.linalg.solve(Q, error[:, :, None])[:, :, 0]).mean() / 3.0)
    assert 0.7 < np.sqrt(np.mean(np.square(factors))) / max(share, 1.0) < 1.4
    assert 0.6 < np.mean(ratio) < 1.6


def test_components_refuse_unknown_groups():
    with pytest.raises(ValueError, match="no observation group"):
        estimate_components(adjust(block(1).network, MODEL), ("gravity",))


def test_direct_georeferencing_errors_fit_their_sigmas():
    squares = np.zeros(3)
    stated = np.zeros(3)
    for seed in range(16):
        simulated = block(seed, points=30, control=0)
        direct = georeference(simulated.network, MODEL)
        squares += np.mean((direct.xyz_l - simulated.points_l) ** 2, axis=0)
        stated += np.mean(direct.sigma_m**2, axis=0)
    np.testing.assert_allclose(np.sqrt(squares / stated), 1.0, atol=0.25)
    assert (direct.image_sigma_m < direct.sigma_m).all()


def test_direct_georeferencing_with_continuity_constraints():
    options = PpmOptions(segments=2, offset_sigma_m=(0.1,) * 3, shift_sigma_deg=(0.005,) * 3)
    simulated = block(3, points=30, control=0, errors=options)
    direct = georeference(simulated.network, options)
    assert np.isfinite(direct.sigma_m).all()
    ratio = (direct.xyz_l - simulated.points_l) / direct.sigma_m
    assert 0.3 < np.sqrt(np.mean(ratio**2)) < 3.0


@pytest.mark.parametrize("self_calibration", [False, True])
def test_errors_of_points_and_sigma0_fit_what_is_stated(self_calibration):
    """RMSE over theoretical sigma near 1, sigma0 in its chi-square band; the long version is `study consistency`."""
    squares, stated, outside = np.zeros(3), np.zeros(3), 0
    true = {"k1": 2e-6, "xp_F": 0.004, "yp_B": -0.003, "sy_F": 1e-4} if self_calibration else {}
    parameters = tls(CAMERA) if self_calibration else None
    seeds = 16
    for seed in range(seeds):
        simulated = block(seed, self_calibration=parameters, camera_parameters=true)
        solution = adjust(simulated.network, MODEL, parameters)
        Q = point_cofactors(solution)
        squares += np.mean((solution.state.points_l - simulated.points_l) ** 2, axis=0)
        stated += np.mean(np.einsum("pii->pi", Q), axis=0)
        outside += not global_test(solution.cost, solution.redundancy).passed
    np.testing.assert_allclose(np.sqrt(squares / stated), 1.0, atol=0.1)
    assert outside <= 4


def test_elimination_leaves_true_parameters_and_sound_points():
    true = {"k1": 3e-6, "xp_F": 0.004, "yp_B": -0.003, "sy_F": 1.5e-4}
    simulated = block(5, points=120, control=12, self_calibration=tls(CAMERA), camera_parameters=true)
    result = run(simulated.network, Job(MODEL, self_calibration=tls(CAMERA)))
    layout = result.solution.layout
    left = dict(zip(layout.names[layout.n_model :], result.solution.camera_parameters, strict=True))
    sigma = np.sqrt(result.solution.factor.variances()[layout.n_model :])
    assert set(true) <= set(left) and len(left) <= 8
    for (name, value), s in zip(left.items(), sigma, strict=True):
        assert abs(value - true.get(name, 0.0)) < 4 * s, name
    assert result.test.passed
    assert len(result.removed) == 18 - len(left)
    assert all(r.reason for r in result.removed)
    ratio = (result.adjusted_points() - simulated.points_l) / result.point_sigma_m
    assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.15
