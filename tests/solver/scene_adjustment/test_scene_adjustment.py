"""Blocks of scenes: against a second estimator, errors as large as their sigmas, mixed models, gross errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from triline.solver.adjustment.reliability import CRITICAL_W
from triline.solver.camera.self_calibration import lens, prism
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.location.rpc_fit import fit_to_model
from triline.solver.models.dgr import DgrOptions
from triline.solver.scene_adjustment.block import GIVEN, KnownGround, SceneBlock
from triline.solver.scene_adjustment.functional import ProjectiveImage, RpcImage
from triline.solver.scene_adjustment.single_looks import single_looks
from triline.solver.scene_adjustment.snooping import bending_control, snoop
from triline.solver.scene_adjustment.solution import NotAdjustableError, adjust, points_enu, prepare
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass
from triline.solver.simulation.satellite_block import rigorous_images, scattered_points, simulate_block
from triline.solver.simulation.scene_study import CONFIGURATIONS, SENSORS, error_over_sigma

DGR = DgrOptions((2.0,) * 3, (0.01,) * 3, (0.002,) * 3)


def simulated(sensor="alos-prism", points=40, model=DGR, calibration=None, seed=1, **settings):
    rng = np.random.default_rng(seed)
    images = rigorous_images([overpass(ORBITAL_SENSORS[sensor], 36.0, 139.6)], model, calibration)
    P = scattered_points(images, points, rng)
    return simulate_block(images, P, range(min(6, points)), range(min(6, points), min(12, points)), rng, **settings)


def misses(solution, simulation):
    points = np.arange(len(simulation.position_e))
    return points_enu(solution.problem, solution.state.position_e, simulation.position_e, points)


@pytest.mark.parametrize(
    ("sensor", "calibration"),
    [
        ("spot5-hrs", None),
        *(pytest.param(s, c, marks=pytest.mark.study) for s, c in (("alos-prism", prism), ("spot5-hrs", lens))),
    ],
)
def test_scipy_finds_the_same_with_numerical_derivatives_of_the_inverse_location(sensor, calibration):
    """Another estimator on other functions: full inverse locations of adjusted sensors, no derivative of ours."""
    simulation = simulated(sensor, points=4, calibration=calibration, seed=4)
    problem = prepare(simulation.block)
    solution = adjust(problem)
    assert solution.converged
    block, layout = problem.block, problem.block.layout
    scale = np.sqrt(np.diag(solution.values_covariance))
    spread = np.sqrt(np.einsum("pii->pi", solution.points_covariance))
    A, b = layout.prior()

    def residuals(x):
        # beginning a sigma or more away, in units of the sigmas, so that the step of the derivative suits all
        values = solution.state.values + scale * x[: layout.n_unknowns]
        local = spread * x[layout.n_unknowns :].reshape(-1, 3)
        P = solution.state.position_e + np.einsum("pij,pj->pi", problem.R_e_enu, local)
        parts = [A @ values - b]
        for image, mine, columns in zip(block.images, block.rays_of, layout.columns, strict=True):
            pixel = image.located(values[columns]).ground_to_pixel(P[block.rays.point[mine]], margin_px=100.0)
            measured = np.stack([block.rays.line[mine], block.rays.sample[mine]], axis=1)
            parts.append(((measured - pixel) / block.rays.sigma_px[mine, None]).ravel())
        d = points_enu(problem, P, block.known.position_e, block.known.point)
        sigma = np.sqrt(np.einsum("kii->ki", block.known.covariance_enu))
        parts.append((d / np.where(sigma > 0, sigma, 1.0))[block.known.given])
        return np.concatenate(parts)

    def derivatives(x):
        steps = 0.05 * np.eye(len(x))
        return np.stack([(residuals(x + d) - residuals(x - d)) / 0.1 for d in steps], axis=1)

    x0 = np.random.default_rng(0).normal(0.0, 0.1, layout.n_unknowns + 3 * len(block.point_ids))
    found = least_squares(residuals, x0, jac=derivatives, xtol=1e-12, ftol=1e-12, gtol=1e-9, max_nfev=3)
    np.testing.assert_allclose(found.x, 0.0, atol=1e-4)
    assumed = np.square((A @ solution.state.values - b)[layout.assumed()]).sum()  # have no part in sigma0
    np.testing.assert_allclose(2.0 * found.cost, solution.weighted_squares + assumed, rtol=1e-6)
    # its sigmas, too, which are 1 in units of ours
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 1.0, rtol=2e-3)


@pytest.mark.parametrize("sensor", SENSORS)
def test_errors_are_as_large_as_their_sigmas(sensor):
    """A few seeds: points, orientation; the band is that of so few. The studies below have fifty."""
    ratio = error_over_sigma(sensor, "dgr", "selfcal", seeds=range(2), points=40)
    assert 0.7 < ratio.points < 1.3
    assert 0.7 < ratio.unknowns < 1.3


@pytest.mark.study
@pytest.mark.parametrize("configuration", CONFIGURATIONS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_errors_are_as_large_as_their_sigmas_over_fifty_seeds(sensor, configuration):
    model, calibration = configuration
    ratio = error_over_sigma(sensor, model, calibration, seeds=range(50))
    assert 0.95 < ratio.points < 1.05
    assert 0.95 < ratio.unknowns < 1.05
    # continuity of the pieces is drawn with them and not a second time: PPM has fewer random observations than counted
    assert (0.95 if model == "dgr" else 0.88) < ratio.sigma0 < 1.05


def test_corrections_of_a_whole_overpass_share_one_set():
    rng = np.random.default_rng(2)
    scenes = [overpass(ORBITAL_SENSORS["spot5-hrs"], 36.0, 139.6)]
    images = rigorous_images(scenes, DGR, lens, per_lens=False)
    simulation = simulate_block(images, scattered_points(images, 40, rng), range(6), (), rng)
    solution = adjust(prepare(simulation.block))
    groups = simulation.block.layout.groups
    assert [(g.kind, g.key) for g in groups] == [
        ("orientation", "1"), ("camera", "spot5-hrs/F"), ("camera", "spot5-hrs/B"),
    ]  # fmt: skip
    z = (solution.state.values - simulation.values) / np.sqrt(np.diag(solution.values_covariance))
    assert np.abs(z).max() < 4.0


def test_a_strip_of_thousands_of_kilometres():
    """Flat-Earth frames would be off by hundreds of kilometres; points have axes of their own."""
    sensor = replace(ORBITAL_SENSORS["misr"], lines=8000)  # 2 200 km
    images = rigorous_images([overpass(sensor, 30.0, 179.0)], DGR)[2:6]
    rng = np.random.default_rng(3)
    P = scattered_points(images, 60, rng, (0.0, 6000.0))
    assert np.linalg.norm(P[:, None] - P[None], axis=2).max() > 1.5e6
    simulation = simulate_block(images, P, range(12), (), rng)
    solution = adjust(prepare(simulation.block))
    assert solution.converged
    ratio = misses(solution, simulation) / np.sqrt(np.einsum("pii->pi", solution.points_covariance))
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3


def mixed(simulation, kinds):
    """The images of a simulation, some of them with another model that was made from the sensor as given."""
    images = []
    for image, kind in zip(simulation.block.images, kinds, strict=True):
        if kind == "rpc":
            rpc = fit_to_model(image.sensor, -500.0, 2500.0).rpc
            images.append(RpcImage(image.name, rpc, shift_sigma_px=100.0, slope_sigma_px=10.0))
        elif kind in ("affine", "dlt"):
            images.append(ProjectiveImage(image.name, kind, (image.sensor.lines, image.sensor.samples)))
        else:
            images.append(image)
    return replace(simulation.block, images=tuple(images))


def test_rigorous_rpc_and_dlt_images_in_one_block():
    """PRISM: forward rigorous, nadir by RPC with an affine correction, backward by DLT from control."""
    small = DgrOptions((2.0,) * 3, (0.003,) * 3, (1e-5,) * 3)
    simulation = simulated(points=80, model=small, seed=5)
    block = simulation.block
    known = KnownGround(
        np.arange(30), simulation.position_e[:30], np.tile(0.25 * np.eye(3), (30, 1, 1)), ("control",) * 30
    )
    block = replace(block, known=known)
    solution = adjust(prepare(replace(mixed(simulation, ("rigorous", "rpc", "rigorous")), known=known)))
    assert solution.converged and 0.8 < solution.sigma0 < 1.25
    d = misses(solution, simulation)[30:]
    sigma = np.sqrt(np.einsum("pii->pi", solution.points_covariance))[30:]
    assert 0.7 < np.sqrt(np.mean((d / sigma) ** 2)) < 1.3
    # a DLT leaves some pixels in an image this large: it must not be weighted as if it did not
    all_kinds = replace(mixed(simulation, ("rigorous", "rpc", "dlt")), known=known)
    weights = np.where(all_kinds.rays.image == 2, 5.0, all_kinds.rays.sigma_px)
    all_kinds = replace(all_kinds, rays=replace(all_kinds.rays, sigma_px=weights))
    solution = adjust(prepare(all_kinds))
    assert solution.converged and not solution.undetermined
    assert solution.sigma0 < 1.25
    assert np.sqrt(np.mean(misses(solution, simulation)[30:] ** 2)) < 2.0
    assert all(np.isfinite(solution.residual_px).ravel())


@pytest.mark.parametrize("assumed", [True, False])
def test_corrections_of_an_rpc_that_nobody_stated_are_no_observations(assumed):
    """Usual sigmas are wide, so that data decide; as observations that fit far too well they make sigma0 too small."""
    tiny = DgrOptions((1e-3,) * 3, (1e-7,) * 3, (1e-9,) * 3)
    squares = []
    for seed in range(12):
        simulation = simulated(points=14, model=tiny, seed=seed)
        images = tuple(
            RpcImage(image.name, fit_to_model(image.sensor, -500.0, 2500.0).rpc, assumed=(assumed, assumed))
            for image in simulation.block.images
        )
        solution = adjust(prepare(replace(simulation.block, images=images)))
        seen, given = int(solution.ray_weight.sum()), int(solution.given.sum())
        own = 2 * seen + given - 3 * 14 - 18  # three images with six coefficients each
        # nearly all of them the data determine by themselves
        assert own <= solution.redundancy <= own + 2 if assumed else solution.redundancy == own + 18
        squares.append(solution.sigma0**2)
    found, expected = np.sqrt(np.mean(squares)), 1.0 if assumed else np.sqrt(own / (own + 18))
    assert abs(found / expected - 1.0) < 0.08, found


def test_a_camera_without_errors_does_not_lower_sigma0():
    """Its parameters come out near nothing beside their a-priori sigmas, which say nothing of the image points."""
    plain, with_lenses = [], []
    for seed in range(10):
        block = simulated("spot5-hrs", 40, seed=seed).block
        images = rigorous_images([overpass(ORBITAL_SENSORS["spot5-hrs"], 36.0, 139.6)], DGR, lens)
        plain.append(adjust(prepare(block)).sigma0 ** 2)
        with_lenses.append(adjust(prepare(replace(block, images=images))).sigma0 ** 2)
    assert np.mean(with_lenses) == pytest.approx(np.mean(plain), rel=0.1)


def test_affine_images_alone_take_their_start_from_control():
    simulation = simulated(points=60, seed=6)
    known = KnownGround(
        np.arange(20), simulation.position_e[:20], np.tile(0.25 * np.eye(3), (20, 1, 1)), ("control",) * 20
    )
    block = replace(mixed(simulation, ("affine",) * 3), known=known)
    block = replace(block, rays=replace(block.rays, sigma_px=np.full(len(block.rays), 5.0)))
    solution = adjust(prepare(block))
    assert solution.converged
    assert np.sqrt(np.mean(misses(solution, simulation)[20:] ** 2)) < 20.0
    with pytest.raises(NotAdjustableError, match="no image that can locate, and no control points"):
        prepare(replace(block, known=KnownGround.none()))


def test_relative_orientation_of_rpcs_without_control():
    """Shift and affine of two RPCs from tie points alone: residuals vanish, the datum is a-priori knowledge."""
    simulation = simulated("spot5-hrs", points=60, seed=7)
    block = replace(mixed(simulation, ("rpc", "rpc")), known=KnownGround.none())
    solution = adjust(prepare(block))
    assert solution.converged and not solution.undetermined
    assert np.sqrt(np.mean(solution.residual_px**2)) < 0.3
    assert np.linalg.norm(misses(solution, simulation), axis=1).min() > 5.0, "nothing tells where the block lies"


def test_gross_errors_are_found_and_named():
    simulation = simulated(points=60, seed=8)
    block = simulation.block
    rng = np.random.default_rng(0)
    wrong = np.sort(rng.choice(np.flatnonzero(block.rays.point >= 12), 8, replace=False))
    wrong = wrong[np.diff(block.rays.point[wrong], prepend=-1) != 0]
    sample = block.rays.sample.copy()
    sample[wrong] += rng.choice([-1.0, 1.0], len(wrong)) * rng.uniform(5.0, 40.0, len(wrong))
    position = block.known.position_e.copy()
    position[2] += 40.0 * position[2] / np.linalg.norm(position[2])  # control of 0.5 m, 40 m too high
    block = replace(block, rays=replace(block.rays, sample=sample), known=replace(block.known, position_e=position))
    before = adjust(prepare(block))
    after = snoop(before)
    assert before.sigma0 > 2.0 and 0.8 < after.solution.sigma0 < 1.2
    assert after.coordinates == ((2, 2),)
    lost = set(after.rays) - set(wrong)
    # across the track; along it three rays that disagree do not tell which of them is wrong
    assert set(wrong) <= set(after.rays) and len(lost) <= 2
    clean = adjust(prepare(simulation.block))
    np.testing.assert_allclose(
        misses(after.solution, simulation)[12:].std(), misses(clean, simulation)[12:].std(), rtol=0.25
    )


def with_control_off(block, place, off_deg):
    """A block whose control point at a place of `KnownGround` is given so far north of where it is."""
    lat, lon, height = WGS84.geodetic(block.known.position_e[place : place + 1])[0]
    position = block.known.position_e.copy()
    position[place] = WGS84.cartesian(lat + np.radians(off_deg), lon, height)
    return replace(block, known=replace(block.known, position_e=position))


@pytest.mark.parametrize(("sensor", "points", "named"), [("alos-prism", 30, True), ("spot5-hrs", 15, False)])
def test_control_that_is_degrees_off_leaves_the_block_as_it_is_without_it(sensor, points, named):
    """A block that it bent did not find back: rays beyond the orbit, normal equations of points without a root, points
    that were lost for good, image points of which more than a third failed; and all image points of the control went,
    not its coordinates, where three of them agree.
    """
    simulation = simulated(sensor, points=points, seed=8)
    block = simulation.block
    for place, off_deg in ((0, -1.0), (1, 1.0)):
        found = snoop(adjust(prepare(with_control_off(block, place, off_deg))))
        point = block.known.point[place]
        own = np.flatnonzero(block.rays.point == point)
        kept = found.solution
        if named:
            assert {p for p, _ in found.coordinates} == {point} and not set(own) & set(found.rays)
            assert np.linalg.norm(misses(kept, simulation)[point]) < 20.0
        else:
            assert set(own) <= set(found.rays)  # nothing tells whether two rays are wrong or it
        assert kept.determined.all() and kept.converged and 0.8 < kept.sigma0 < 1.2
        assert len(set(found.rays) - set(own)) < 0.07 * len(block.rays)
        other = np.flatnonzero(np.arange(len(block.point_ids)) != point)
        sigma = kept.sigma0 * np.sqrt(np.einsum("pii->pi", kept.points_covariance[other]))
        assert np.sqrt(np.mean(np.square(misses(kept, simulation)[other] / sigma))) < 1.6


def test_control_that_is_off_among_image_points_that_are_off_is_named_and_its_image_points_stay():
    """Without control the block does not fit either; what went of the image points of control is exchanged for it."""
    simulation = simulated(points=20, seed=100)
    block, rng = simulation.block, np.random.default_rng(0)
    wrong = np.sort(rng.choice(np.flatnonzero(block.rays.point >= 12), 4, replace=False))
    sample = block.rays.sample.copy()
    sample[wrong] += rng.choice([-1.0, 1.0], 4) * rng.uniform(5.0, 40.0, 4)
    block = with_control_off(replace(block, rays=replace(block.rays, sample=sample)), 0, 0.3)
    found = snoop(adjust(prepare(block)))
    point = block.known.point[0]
    assert {p for p, _ in found.coordinates} == {point} and len(found.rays) == 4
    assert set(block.rays.point[found.rays]) == set(block.rays.point[wrong])  # along the track any of three may be it
    assert found.solution.converged and 0.8 < found.solution.sigma0 < 1.2


def test_where_all_control_contradicts_the_orbit_none_of_it_is_left_out_for_that():
    """Control agrees with itself, 100 m from where a-priori knowledge has it: nothing tells which is wrong."""
    tight = DgrOptions((0.1,) * 3, (1e-6,) * 3, (1e-7,) * 3)
    block = simulated(points=12, model=tight, seed=100).block

    def found(block):
        problem = prepare(block)
        return bending_control(adjust(problem, given=np.zeros((12, 3), dtype=bool)), problem.given, CRITICAL_W)

    assert {p for p, _ in np.argwhere(found(with_control_off(block, 0, 0.001)))} == {block.known.point[0]}
    for place in range(6):
        block = with_control_off(block, place, 0.001)
    assert not found(block).any()


def test_snooping_gives_up_where_sigmas_are_wrong():
    simulation = simulated(points=30, seed=9)
    block = simulation.block
    tight = replace(block, rays=replace(block.rays, sigma_px=np.full(len(block.rays), 0.01)))
    found = snoop(adjust(prepare(tight)))
    assert found.given_up > 0.35 and not len(found.rays)
    assert found.solution.ray_weight.all()


def test_normalised_residuals_are_standard_normal():
    tests = [adjust(prepare(simulated(points=40, seed=seed).block)).test for seed in range(20, 22)]
    w = np.concatenate(tests).ravel()
    assert 0.9 < w[w != 0].std() < 1.1


def test_redundancy_numbers_sum_up():
    """Redundancy numbers of rays, control and a-priori knowledge: together the redundancy."""
    simulation = simulated(points=30, seed=10)
    solution = adjust(prepare(simulation.block))
    A = solution.problem.prior
    of_prior = len(A) - np.einsum("mu,uv,mv->", A, solution.values_covariance, A)
    known = solution.problem.block.known
    control = known.point[known.given.all(axis=1)]
    C, given = solution.points_covariance[control], known.covariance_enu[known.given.all(axis=1)]
    of_control = 3 * len(control) - np.einsum("pij,pji->", C, np.linalg.inv(given))
    total = solution.redundancy_numbers.sum() + of_prior + of_control
    np.testing.assert_allclose(total, solution.redundancy, rtol=1e-6)


def test_points_with_one_ray_are_left_out_and_planimetric_and_height_control_count():
    simulation = simulated(points=30, seed=11)
    block = simulation.block
    alone = block.rays.point == 20
    keep = ~alone | (block.rays.image == 0)
    rays = replace(
        block.rays, **{k: getattr(block.rays, k)[keep] for k in ("image", "point", "line", "sample", "sigma_px")}
    )
    roles = ("planimetric", "height", "control", "planimetric", "height", "control")
    assert set(roles) < set(GIVEN)
    known = replace(block.known, role=(*roles, *block.known.role[6:]))
    solution = adjust(prepare(replace(block, rays=rays, known=known)))
    assert solution.converged and not solution.determined[20]
    assert np.isnan(solution.points_covariance[20]).all()
    assert solution.n_observations == 2 * (len(rays) - 1) + 27 + 2 * 2 + 2 * 1 + 2 * 3
    assert solution.n_unknowns == 27 + 3 * 29


def test_check_points_of_a_scene_alone_lie_off_by_as_much_as_their_sigmas_say():
    """Of one image no check point is determined; those that are given are as far off as stated."""
    w, ground = [], []
    for seed in range(25):
        simulation = simulated("spot5-hrs", points=12, seed=seed)
        block = simulation.block
        of_one = block.rays.image == 0
        rays = replace(
            block.rays, **{k: getattr(block.rays, k)[of_one] for k in ("image", "point", "line", "sample", "sigma_px")}
        )
        rng, known = np.random.default_rng(seed), block.known
        check = np.array([role == "check" for role in known.role])
        stated = np.where(check[:, None, None], np.diag([6.0, 9.0, 12.0]) ** 2, known.covariance_enu)
        survey = rng.normal(size=(len(check), 3)) * [6.0, 9.0, 12.0] * check[:, None]
        axes = prepare(block).R_e_enu[known.point]
        given = known.position_e + np.einsum("kij,kj->ki", axes, survey)
        known = replace(known, covariance_enu=stated, position_e=given)
        solution = adjust(prepare(replace(block, images=block.images[:1], rays=rays, known=known)))
        found = single_looks(solution, 1.0)
        assert len(found.rays) == 6 and not solution.determined[rays.point[found.rays]].any()
        w.append(found.test)
        ground.append(found.difference_m / found.expected_m)
        assert (found.expected_m > found.sigma_m).all()
    for values in (np.concatenate(w), np.concatenate(ground)):
        assert 0.85 < np.sqrt(np.mean(values**2)) < 1.15


def test_blocks_that_cannot_be_adjusted_are_refused_in_one_line():
    simulation = simulated(points=12, seed=12)
    block = simulation.block
    none = replace(
        block.rays, **{k: getattr(block.rays, k)[:0] for k in ("image", "point", "line", "sample", "sigma_px")}
    )
    with pytest.raises(NotAdjustableError, match=r"^no image points$"):
        prepare(replace(block, rays=none))
    line = block.rays.line.copy()
    line[3] = 1e9
    with pytest.raises(NotAdjustableError, match=r"^image 1/F: .*lies outside"):
        prepare(replace(block, rays=replace(block.rays, line=line)))
    with pytest.raises(ValueError, match="two images of a block have the same name"):
        SceneBlock((block.images[0],) * 2, block.point_ids, block.rays, block.known)
    single = replace(block.rays, **{
        k: getattr(block.rays, k)[block.rays.image == 0] for k in ("image", "point", "line", "sample", "sigma_px")
    })  # fmt: skip
    with pytest.raises(NotAdjustableError, match="no point is determined"):
        adjust(prepare(replace(block, rays=single, known=KnownGround.none())))
