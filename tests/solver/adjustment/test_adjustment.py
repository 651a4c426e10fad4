"""Batch adjustment: known answers, agreement with an independent minimiser, derivatives, cofactors, errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, dense_design, simulate
from places import BLOCKS, needs_blocks
from scipy import stats
from scipy.optimize import least_squares

from triline.solver.adjustment.adjustment import AdjustmentOptions, State, adjust, pose_problem, solve
from triline.solver.adjustment.covariance import cofactors, point_cofactors, point_unknown_cofactors
from triline.solver.adjustment.linearisation import linearise
from triline.solver.adjustment.network import Control
from triline.solver.adjustment.refined_orientation import correction_cofactors, corrections_at, find_set
from triline.solver.adjustment.robust import Danish, Huber, Igg3
from triline.solver.camera.collinearity import project
from triline.solver.camera.self_calibration import tls
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.simulation.network import Noise

MODELS = {
    "dgr": DgrOptions(),
    "ppm": PpmOptions(segments=3),
    "lim": LimOptions(fixes=5, merge=False),
}
CAMERA_ERRORS = {"k1": 3e-6, "xp_F": 0.004, "sy_B": 1e-4, "p1": 1e-6}


def block(model, with_aps, seed=1, **more):
    aps = tls(CAMERA) if with_aps else None
    simulated = simulate(
        seed, model, self_calibration=aps, camera_parameters=CAMERA_ERRORS if with_aps else None, **more
    )
    return simulated, aps


def independent_residuals(solution):
    """All whitened residuals as a function of (theta, points), written down once more from the formulas.

    With additional parameters they are those of the line and the sample with which the ray meets its CCD line exactly,
    found for every value of the unknowns.
    """
    network, layout = solution.network, solution.layout
    rays, p = network.rays, network.n_points
    C = solution.whitening.g
    names = solution.problem.self_calibration.unknown_names if solution.problem.self_calibration else ()
    line_names = np.array([line.id for line in network.camera.lines])[rays.ccd]

    def oriented(theta, later_s=0.0):
        eo = np.empty((len(rays), 6))
        for s, item in enumerate(layout.sets):
            mine = layout.set_of_ray == s
            eo[mine] = item.model.evaluate(theta[item.columns], rays.time_s[mine])
        later = np.broadcast_to(later_s, len(rays))[:, None]
        return rays.position_l + eo[:, :3] + later * rays.velocity_l, rays.angles + eo[:, 3:] + later * rays.angle_rate

    def image_at(theta, points, later_s=0.0):
        return project(*oriented(theta, later_s), points[rays.point], rays.focal_length_mm).xy_mm

    here, step = (solution.state.theta, solution.state.points_l), 1e-4
    motion = (image_at(*here, step) - image_at(*here, -step)) / (2 * step)
    basis = np.stack([motion, rays.pitch_mm], axis=2)

    def displacement(ap, xy):
        x, y = xy.T
        r2 = x * x + y * y
        a = dict(zip(names, ap, strict=True))
        own = {k: np.array([a[f"{k}_{line}"] for line in line_names]) for k in ("xp", "yp", "sy", "th")}
        radial = a["k1"] * r2 + a["k2"] * r2**2 + a["k3"] * r2**3 - a["dc"] / rays.focal_length_mm
        dx = own["xp"] + x * radial + (r2 + 2 * x**2) * a["p1"] + 2 * x * y * a["p2"] + y * own["th"]
        dy = own["yp"] + y * radial + (r2 + 2 * y**2) * a["p2"] + 2 * x * y * a["p1"] - y * own["sy"]
        return np.stack([dx, dy], axis=1)

    def residuals(theta, points):
        r = rays.xy_mm - image_at(theta, points)
        for _ in range(4 if names else 0):
            later, samples = np.linalg.solve(basis, r[:, :, None])[:, :, 0].T
            there = rays.xy_mm - samples[:, None] * rays.pitch_mm
            r = rays.xy_mm - displacement(theta[layout.n_model :], there) - image_at(theta, points, later)
            r += later[:, None] * motion
        white = np.stack([C[0] * r[:, 0], C[1] * r[:, 0] + C[2] * r[:, 1]])
        parts = [white.ravel()]
        for item in layout.sets:
            prior = item.model.pseudo_observations()
            own = np.append(theta[item.columns], 0.0)
            parts.append((prior.value - (prior.coefficients * own[prior.columns]).sum(axis=1)) / prior.sigma)
        if names:
            parts.append(theta[layout.n_model :] / solution.problem.self_calibration.apriori_sigma)
        given = np.isfinite(network.control.sigma_m)
        parts.append(((network.control.xyz_l - points[network.control.point]) / network.control.sigma_m)[given])
        return np.concatenate(parts)

    return residuals, p


@pytest.mark.parametrize("with_aps", [False, pytest.param(True, marks=pytest.mark.study)], ids=["", "tls18"])
@pytest.mark.parametrize("name", MODELS)
def test_agrees_with_an_independent_minimiser(name, with_aps):
    simulated, aps = block(MODELS[name], with_aps, points=18, strips=1)
    solution = adjust(simulated.network, MODELS[name], aps)
    assert solution.converged
    residuals, p = independent_residuals(solution)
    u = solution.layout.n_unknowns
    both = cofactors(solution)
    sigma = np.sqrt(np.concatenate([both.unknowns, np.einsum("nii->ni", both.points).ravel()]))
    sigma = np.maximum(sigma, 1e-3 * np.median(sigma[u:]) * (np.arange(len(sigma)) >= u) + 1e-300)
    start = np.concatenate([np.zeros(u), simulated.network.approximate_l.ravel()])

    def whole(z):
        v = start + z * sigma
        return residuals(v[:u], v[u:].reshape(p, 3))

    found = least_squares(whole, np.zeros(len(start)), jac="3-point", method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    ours = np.concatenate([solution.state.theta, solution.state.points_l.ravel()])
    # that the displacement changes with the fitted sample is not in the derivatives, but in the iterations
    assert 2 * found.cost == pytest.approx(solution.cost, rel=2e-5 if with_aps else 1e-9)
    assert np.abs((start + found.x * sigma - ours) / sigma).max() < (2e-2 if with_aps else 1e-3)


@pytest.mark.parametrize("with_aps", [False, True], ids=["", "tls18"])
@pytest.mark.parametrize("name", MODELS)
def test_counts_are_those_of_the_dissertation(name, with_aps):
    model = MODELS[name]
    simulated, aps = block(model, with_aps, points=40)
    solution = adjust(simulated.network, model, aps)
    network = simulated.network
    strips, rays, p = len(network.strips), len(network.rays), network.n_points
    gcps = len(network.control)
    extra = 18 if with_aps else 0
    constraints = {"dgr": 9 * strips, "ppm": strips * (18 * 3 + 12 * 2), "lim": strips * 6 * 5}[name]
    unknowns = {"dgr": 9 * strips, "ppm": 18 * 3 * strips, "lim": 6 * 5 * strips}[name]
    assert solution.n_unknowns == unknowns + extra + 3 * p - (network.rays_per_point == 1).sum()
    assert solution.n_observations == 2 * rays + constraints + extra + 3 * gcps


def test_planimetric_and_height_control_count_two_and_one():
    simulated, _ = block(MODELS["dgr"], False)
    c = simulated.network.control
    sigma = c.sigma_m.copy()
    sigma[0, 2] = np.inf
    sigma[1, :2] = np.inf
    network = replace(simulated.network, control=Control(c.point, c.xyz_l, sigma))
    assert network.control.n_observations == c.n_observations - 3
    full, part = adjust(simulated.network, DgrOptions()), adjust(network, DgrOptions())
    assert full.n_observations - part.n_observations == 3
    role = network.role()
    assert role[c.point[0]] == "planimetric" and role[c.point[1]] == "height" and role[c.point[2]] == "control"


@pytest.mark.parametrize("name", MODELS)
def test_linearisation_is_the_derivative(name):
    simulated, aps = block(MODELS[name], True, points=20)
    problem = pose_problem(simulated.network, MODELS[name], aps)
    rng = np.random.default_rng(4)
    u, p = problem.layout.n_unknowns, simulated.network.n_points
    theta = rng.normal(size=u) * np.where(np.arange(u) < problem.layout.n_model, 1e-3, 1e-7)
    points = simulated.network.approximate_l + rng.normal(size=(p, 3))
    solution = solve(problem, State(theta, points), options=AdjustmentOptions(max_iterations=0))
    A, _ = dense_design(solution)
    direction = rng.normal(size=u + 3 * p)
    direction[:u] *= np.where(np.arange(u) < problem.layout.n_model, 1e-4, 1e-8)

    def white(h):
        moved = State(theta + h * direction[:u], points + h * direction[u:].reshape(p, 3))
        return linearise(
            simulated.network.rays, solution.layout, solution.whitening, moved.theta, moved.points_l
        ).residual

    numeric = -(white(1e-2) - white(-1e-2)) / 2e-2
    np.testing.assert_allclose(
        np.einsum("nau,u->an", A, direction), numeric, rtol=1e-6, atol=1e-6 * np.abs(numeric).max()
    )


@pytest.mark.parametrize("with_aps", [False, True], ids=["", "tls18"])
@pytest.mark.parametrize("name", MODELS)
def test_cofactors_are_blocks_of_the_inverse(name, with_aps):
    simulated, aps = block(MODELS[name], with_aps)
    solution = adjust(simulated.network, MODELS[name], aps)
    weight = np.ones(len(simulated.network.rays))
    weight[::17] = 0.0
    weight[5:9] = 0.3
    solution = solve(solution.problem, solution, weight)
    A, N = dense_design(solution)
    scale = 1.0 / np.sqrt(np.diagonal(N))
    Q = np.linalg.inv(N * scale[:, None] * scale) * scale[:, None] * scale
    u, p = solution.layout.n_unknowns, simulated.network.n_points
    both = cofactors(solution)
    np.testing.assert_allclose(both.unknowns, np.diagonal(Q)[:u], rtol=1e-7)
    of_points = np.stack([Q[i : i + 3, i : i + 3] for i in range(u, u + 3 * p, 3)])
    np.testing.assert_allclose(both.points, of_points, atol=1e-9 * np.abs(of_points).max())
    np.testing.assert_allclose(point_cofactors(solution), both.points, rtol=1e-12)
    np.testing.assert_allclose(both.observed, np.einsum("nau,uv,nbv->nab", A, Q, A, optimize=True), atol=1e-8)
    some = np.array([0, 3, u - 1])
    np.testing.assert_allclose(
        point_unknown_cofactors(solution, some), Q[u:, some].reshape(p, 3, 3), atol=1e-7 * np.abs(Q[u:, some]).max()
    )
    # redundancy numbers add up to the redundancy
    prior = solution.problem.prior.matrix.toarray()
    control = solution.problem.control.weight.ravel()
    taken = np.einsum("ij,jk,ik->", prior, Q[:u, :u], prior) + (control * np.diagonal(Q)[u:]).sum()
    rays = (solution.ray_weight[:, None] * np.einsum("naa->na", both.observed)).sum()
    assert rays + taken == pytest.approx(solution.n_unknowns, rel=1e-6)


def test_leaving_rays_out_is_adjusting_without_them():
    simulated, _ = block(MODELS["dgr"], False)
    network = simulated.network
    solution = adjust(network, DgrOptions())
    out = np.zeros(len(network.rays), dtype=bool)
    out[[3, 50, 51, 200]] = True
    warm = solve(solution.problem, solution, np.where(out, 0.0, 1.0))
    cold = solve(solution.problem, None, np.where(out, 0.0, 1.0))
    assert warm.n_observations == solution.n_observations - 8
    assert warm.iterations <= 2
    sigma = np.sqrt(np.einsum("nii->ni", point_cofactors(warm)))
    assert np.abs(warm.state.points_l - cold.state.points_l).max() < 1e-3 * sigma.min()


def errors_of(seed, model, with_aps, **more):
    simulated, aps = block(model, with_aps, seed=seed, **more)
    solution = adjust(simulated.network, model, aps)
    both = cofactors(solution)
    seen = simulated.network.rays_per_point > 1
    e = (solution.state.points_l - simulated.points_l)[seen]
    C = both.points[seen]
    n = solution.layout.n_model
    truth = np.concatenate([simulated.corrections[simulated.network.strips[s.strip].id] for s in solution.layout.sets])
    d = solution.state.theta[:n] - truth
    nees = d @ np.linalg.solve(solution.factor.cofactors(np.arange(n)), d) / n
    return (
        np.sqrt((e**2).sum() / np.einsum("nii->", C)),
        np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e).mean() / 3,
        nees,
        solution,
    )


@pytest.mark.parametrize("name", MODELS)
def test_errors_are_as_large_as_they_say(name):
    """RMSE over theoretical sigma and normalised errors over 8 seeds; sigma0 of DGR and LIM in its chi-square band."""
    got = [errors_of(100 + seed, MODELS[name], seed % 2 == 1, points=50) for seed in range(8)]
    ratio, nees, theta = (np.array([g[k] for g in got]) for k in range(3))
    assert 0.85 < np.sqrt((ratio**2).mean()) < 1.15
    assert 0.75 < nees.mean() < 1.25
    assert 0.75 < theta.mean() < 1.25
    if (
        name != "ppm"
    ):  # drawn unknowns obey all pseudo-observations of PPM at once, which leaves its residuals too small
        cost, redundancy = sum(g[3].cost for g in got), sum(g[3].redundancy for g in got)
        assert abs(np.sqrt(cost / redundancy) - 1.0) < 4.0 / np.sqrt(2 * redundancy)


def test_weights_through_the_image_motion_pay_on_an_unstabilised_mount():
    """0.4 deg of turbulence: sigma0 1 against 1.5 with the pixel pitch alone, object points at least 20 % better."""
    model = DgrOptions((0.05, 0.05, 0.05), (0.002, 0.002, 0.004), (0.002, 0.002, 0.004))
    noise = Noise(jitter_deg=0.4, jitter_hz=(0.6, 2.5))
    figures = {"motion": [], "pitch": []}
    for seed in range(8):
        simulated, _ = block(model, False, seed=seed, noise=noise, points=80, height_m=2400.0, length_m=4080.0)
        seen = simulated.network.rays_per_point > 1
        for weights, collected in figures.items():
            solution = adjust(simulated.network, model, options=AdjustmentOptions(weights=weights))
            error = (solution.state.points_l - simulated.points_l)[seen]
            collected.append((solution.sigma0, (error**2).mean()))
    (motion, motion_error), (pitch, pitch_error) = (np.mean(figures[k], axis=0) for k in ("motion", "pitch"))
    assert 0.97 < motion < 1.03
    assert 1.2 < pitch < 1.6
    assert np.sqrt(pitch_error / motion_error) > 1.2


def test_white_noise_of_the_orientation_belongs_to_the_weights():
    """Where it is known, sigma0 is 1; where it is kept back, the image points get the blame."""
    sigma = np.array([0.03, 0.03, 0.03, 3e-5, 3e-5, 6e-5])
    model, squares = MODELS["dgr"], {"known": 0.0, "kept back": 0.0}
    redundancy = 0
    for seed in range(4):
        simulated, _ = block(model, False, seed=seed)
        rays, rng = simulated.network.rays, np.random.default_rng(seed)
        error = sigma * rng.standard_normal((len(rays), 6))
        network = simulated.network.with_orientation(rays.position_l + error[:, :3], rays.angles + error[:, 3:])
        noise = np.broadcast_to(np.diag(sigma**2), (len(rays), 6, 6))
        told = replace(network, rays=replace(network.rays, orientation_noise=noise))
        for name, each in (("known", told), ("kept back", network)):
            squares[name] += adjust(each, model).cost
        redundancy += adjust(network, model).redundancy
    low, high = np.sqrt(stats.chi2.ppf([0.005, 0.995], redundancy) / redundancy)
    assert low < np.sqrt(squares["known"] / redundancy) < high
    assert np.sqrt(squares["kept back"] / redundancy) > 1.2


def test_bad_starting_points_are_reached_by_damping():
    simulated, _ = block(MODELS["dgr"], False)
    problem = pose_problem(simulated.network, DgrOptions())
    good = solve(problem)
    far = simulated.network.approximate_l + np.random.default_rng(0).normal(size=(simulated.network.n_points, 3)) * 300
    bad = solve(problem, State(np.zeros(problem.layout.n_unknowns), far))
    assert bad.converged
    assert bad.cost == pytest.approx(good.cost, rel=1e-6)


@pytest.mark.parametrize("function", [Huber(), Danish(), Igg3()], ids=["huber", "danish", "igg3"])
def test_robust_estimation_bounds_the_damage(function):
    simulated, _ = block(MODELS["dgr"], False)
    rays = simulated.network.rays
    rng = np.random.default_rng(8)
    hit = rng.choice(len(rays), len(rays) // 20, replace=False)
    xy = rays.xy_mm.copy()
    xy[hit] += rng.choice([-1, 1], size=(len(hit), 2)) * 0.0065 * rng.uniform(6, 40, size=(len(hit), 2))
    spoiled = replace(simulated.network, rays=replace(rays, xy_mm=xy))
    seen = simulated.network.rays_per_point > 3

    def rmse(network, options):
        error = adjust(network, DgrOptions(), options=options).state.points_l - simulated.points_l
        return float(np.sqrt((error[seen] ** 2).mean()))

    clean, plain = rmse(simulated.network, AdjustmentOptions()), rmse(spoiled, AdjustmentOptions())
    robust = rmse(spoiled, AdjustmentOptions(robust=function))
    assert plain > 2.0 * clean
    assert robust < 0.5 * plain


def test_residuals_are_measured_minus_computed():
    simulated, _ = block(MODELS["dgr"], False)
    solution = adjust(simulated.network, DgrOptions())
    rays = simulated.network.rays
    eo = solution.layout.corrections(solution.state.theta)
    image = project(
        rays.position_l + eo[:3].T, rays.angles + eo[3:].T, solution.state.points_l[rays.point], rays.focal_length_mm
    )
    whitened = solution.whitening.apply((rays.xy_mm - image.xy_mm).T)
    np.testing.assert_allclose(solution.linearisation.residual, whitened, atol=1e-9)
    assert image.in_front.all()


def test_no_information_is_an_answer_not_an_error():
    """No control and no a-priori knowledge of the orientation: a free datum."""
    wide = DgrOptions((np.inf,) * 3, (np.inf,) * 3, (np.inf,) * 3)
    simulated, _ = block(MODELS["dgr"], False, control=0)
    solution = adjust(simulated.network, wide)
    assert np.isfinite(solution.cost) and np.isfinite(solution.state.points_l).all()
    null = solution.factor.undetermined
    assert len(null) == 3, "shifts of the whole block; its rotations would need drifting positions"
    shift = np.array(["X offset" in name for name in solution.layout.names], dtype=float) / null.scale
    inside = null.vectors @ np.linalg.lstsq(null.vectors, shift, rcond=None)[0]
    np.testing.assert_allclose(inside, shift, atol=1e-3 * np.abs(shift).max())


@needs_blocks
def test_block_of_an_independent_program():
    from triline.nodes.formats.block_folder import read_block
    from triline.solver.adjustment.block_data import network_from_block

    block = read_block(BLOCKS / "dgr")
    expected = json.loads((BLOCKS / "dgr" / "expected.json").read_text())
    solution = adjust(network_from_block(block), DgrOptions.from_settings(block.apriori.trajectory))
    assert (solution.n_observations, solution.n_unknowns) == (expected["n_obs"], expected["n_unknowns"])
    assert solution.sigma0 == pytest.approx(expected["sigma0"], rel=1e-4)
    place = solution.network.point_index
    ours = np.array([solution.state.points_l[place[name]] for name in expected["points_m"]])
    np.testing.assert_allclose(ours, list(expected["points_m"].values()), atol=1e-4)
    for item in solution.layout.sets:
        theta = solution.state.theta[item.columns]
        theirs = expected["strips"][solution.network.strips[item.strip].id]
        np.testing.assert_allclose(theta[:3], theirs["offset_m"], atol=2e-5)
        np.testing.assert_allclose(np.degrees(theta[3:6]), theirs["shift_deg"], atol=1e-6)
        np.testing.assert_allclose(np.degrees(theta[6:]), theirs["drift_deg_per_strip"], atol=1e-6)


def test_one_model_after_another():
    """Offsets far beyond the a-priori sigma of the second model go into the first one."""
    coarse = DgrOptions((20.0, 20.0, 5.0), (0.2, 0.2, 1.0), (0.01, 0.01, 0.02))
    fine = LimOptions(fixes=5, merge=False, offset_sigma_m=(0.3,) * 3, shift_sigma_deg=(0.01,) * 3)
    simulated, _ = block(coarse, False, seed=3)
    solution = adjust(simulated.network, coarse, then=[fine])
    assert len(solution.problem.earlier) == 1 and solution.problem.model is fine
    assert 0.9 < solution.sigma0 < 1.1
    alone = adjust(simulated.network, fine)
    assert alone.sigma0 > 3.0
    rays = simulated.network.rays
    for s in range(len(simulated.network.strips)):
        mine = rays.strip == s
        total = corrections_at(solution, s, rays.time_s[mine])
        first = solution.problem.earlier[0]
        moved = solution.network.rays.position_l[mine] - rays.position_l[mine]
        second = solution.layout.corrections(solution.state.theta)[:, mine].T
        np.testing.assert_allclose(total[:, :3], moved + second[:, :3], atol=1e-9)
        assert np.abs(total - corrections_at(first, s, rays.time_s[mine])).max() > 0


@pytest.mark.parametrize("name", MODELS)
def test_corrections_over_time_agree_with_their_covariance(name):
    """Normalised errors of the corrections along every strip, over 12 seeds."""
    squares = []
    for seed in range(12):
        simulated, _ = block(MODELS[name], False, seed=200 + seed)
        solution = adjust(simulated.network, MODELS[name])
        for s, strip in enumerate(simulated.network.strips):
            t = np.linspace(strip.trajectory.start_s, strip.trajectory.end_s, 7)[1:-1]
            model = find_set(solution, s).model
            error = corrections_at(solution, s, t) - model.evaluate(simulated.corrections[strip.id], t)
            Q = correction_cofactors(solution, s, t)
            squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(Q), error) / 6)
    assert 0.8 < np.mean(squares) < 1.25


def test_bad_calls_say_what_was_wanted():
    simulated, _ = block(MODELS["dgr"], False, points=20)
    problem = pose_problem(simulated.network, DgrOptions())
    with pytest.raises(ValueError, match=r"wanted \d+ weights not below zero"):
        solve(problem, ray_weight=np.ones(3))
    with pytest.raises(ValueError, match="not below zero"):
        solve(problem, ray_weight=-np.ones(len(simulated.network.rays)))
    with pytest.raises(ValueError, match="'motion' or 'pitch'"):
        AdjustmentOptions(weights="none")
    solution = solve(problem)
    with pytest.raises(ValueError, match="has no rays"):
        find_set(solution, 0, None) and corrections_at(replace_sets(solution), 0, [1.0])


def replace_sets(solution):
    """The solution as if no strip had rays."""
    return replace(solution, problem=replace(solution.problem, layout=replace(solution.layout, sets=())))


def test_progress_tells_every_step_and_stops_at_the_limit():
    simulated, _ = block(MODELS["dgr"], False, points=20)
    told = []
    solution = adjust(simulated.network, DgrOptions(), progress=told.append)
    assert tuple(told) == solution.history
    assert [i.number for i in told] == list(range(1, len(told) + 1))
    assert all(i.cost <= i.cost_before for i in told if i.accepted)
    short = adjust(simulated.network, DgrOptions(), options=AdjustmentOptions(max_iterations=1))
    assert len(short.history) == 1 and not short.converged
