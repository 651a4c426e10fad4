"""Data snooping: what it finds, what it loses, what it gives back."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triline.solver.adjustment.adjustment import adjust, solve
from triline.solver.adjustment.covariance import cofactors
from triline.solver.adjustment.job import Job, run
from triline.solver.adjustment.network import Control, Measurements, build_network
from triline.solver.adjustment.point_consensus import consensus
from triline.solver.adjustment.ray_statistics import ray_statistics
from triline.solver.adjustment.reliability import CRITICAL_W
from triline.solver.adjustment.robust import Danish, Huber, Igg3
from triline.solver.adjustment.snooping import Rejected, control_tests, joint_limit, snoop
from triline.solver.adjustment.variance_components import scaled
from triline.solver.camera.self_calibration import tls
from triline.solver.camera.sensors import preset
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.network import Noise, parallel_and_cross, scatter_points, simulate_network

CAMERA = preset("ads40")
MODEL = DgrOptions((0.1, 0.1, 0.2), (0.005, 0.005, 0.008), (0.005, 0.005, 0.008))


def block(seed, points=70, strips=2, cross=2, noise=0.3):
    rng = np.random.default_rng(seed)
    ground = scatter_points(points, (-1500, 1500, -1200, 1200), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)
    lines = parallel_and_cross(CAMERA, 2000.0, strips, cross, 3000.0)
    roles = dict.fromkeys(range(6), "control")
    return simulate_network(CAMERA, lines, ground, roles, range(6, 24), MODEL, rng, Noise(image_px=noise))


def measurements(network, line, sample):
    r = network.rays
    return Measurements(r.point, r.strip, r.ccd, line, sample, r.sigma_line_px, r.sigma_sample_px)


def rebuilt(network, line, sample):
    m = measurements(network, line, sample)
    return build_network(network.camera, network.strips, network.point_ids, m, network.control, network.check)


def with_outliers(network, share, seed, low=6.0, high=40.0):
    """The network with a share of its rays moved by low..high pixels in a random direction; and which they are."""
    rng = np.random.default_rng(seed)
    r = network.rays
    bad = rng.choice(len(r), round(share * len(r)), replace=False)
    angle, size = rng.uniform(0, 2 * np.pi, len(bad)), rng.uniform(low, high, len(bad))
    line, sample = r.line.copy(), r.sample.copy()
    line[bad] += size * np.cos(angle)
    sample[bad] += size * np.sin(angle)
    spoiled = rebuilt(network, line, sample)
    return spoiled, np.isin(spoiled.rays.source, bad)


def rejected_rays(network, rejected):
    out = np.zeros(len(network.rays), dtype=bool)
    out[[r.ray for r in rejected if r.ray >= 0]] = True
    return out


def check_rmse(network, points_l):
    d = points_l[network.check.point] - network.check.xyz_l
    return np.sqrt(np.nanmean(d**2, axis=0))


def test_five_per_cent_of_outliers_are_found_and_good_rays_kept():
    found = bad_rays = lost = good_rays = 0
    spoiled_squares, clean_squares = np.zeros(3), np.zeros(3)
    for seed in range(6):
        clean = block(seed).network
        network, bad = with_outliers(clean, 0.05, seed + 100)
        outcome = snoop(adjust(network, MODEL))
        out = rejected_rays(network, outcome.rejected)
        found, bad_rays = found + (out & bad).sum(), bad_rays + bad.sum()
        lost, good_rays = lost + (out & ~bad).sum(), good_rays + (~bad).sum()
        reference = solve(outcome.solution.problem, adjust(network, MODEL), (~bad).astype(float))
        spoiled_squares += check_rmse(network, outcome.solution.state.points_l) ** 2
        clean_squares += check_rmse(network, reference.state.points_l) ** 2
    assert found / bad_rays >= 0.98
    assert lost / good_rays < 0.003
    np.testing.assert_allclose(np.sqrt(spoiled_squares / clean_squares), 1.0, atol=0.05)


def test_check_points_stay_as_good_as_in_the_clean_block():
    ratio = []
    for seed in range(4):
        clean = block(seed).network
        network, _ = with_outliers(clean, 0.05, seed + 300)
        found = snoop(adjust(network, MODEL)).solution.state.points_l
        without = adjust(clean, MODEL).state.points_l
        ratio.append(np.linalg.norm(check_rmse(network, found)) / np.linalg.norm(check_rmse(clean, without)))
    assert 0.93 < np.mean(ratio) < 1.05


def test_a_fifth_of_outliers_is_found_too():
    clean = block(3).network
    network, bad = with_outliers(clean, 0.2, 5)
    outcome = snoop(adjust(network, MODEL))
    out = rejected_rays(network, outcome.rejected)
    assert (out & bad).sum() / bad.sum() >= 0.98
    assert (out & ~bad).sum() / (~bad).sum() < 0.01
    assert 0.9 < outcome.solution.sigma0 < 1.1


def mostly_spoiled(seed, points):
    """A block where more than half of the rays of some check points are moved by 6..40 pixels; which rays they are."""
    network, rng = block(seed).network, np.random.default_rng(seed + 50)
    line, sample = network.rays.line.copy(), network.rays.sample.copy()
    many = [p for p in network.check.point if network.rays_per_point[p] >= 7]
    bad = []
    for p in many[:points]:
        own = np.flatnonzero(network.rays.point == p)
        chosen = rng.choice(own, len(own) - 4, replace=False)
        angle, size = rng.uniform(0, 2 * np.pi, len(chosen)), rng.uniform(6, 40, len(chosen))
        line[chosen] += size * np.cos(angle)
        sample[chosen] += size * np.sin(angle)
        bad.extend(chosen)
    spoiled = rebuilt(network, line, sample)
    return spoiled, np.isin(spoiled.rays.source, bad)


def test_points_with_most_rays_wrong_keep_the_right_ones_and_are_named():
    missed = wronged = 0
    for seed in range(5):
        network, bad = mostly_spoiled(seed, 4)
        result = run(network, Job(MODEL, snoop=True))
        out = rejected_rays(network, result.rejected)
        missed, wronged = missed + (bad & ~out).sum(), wronged + (out & ~bad).sum()
        spoiled = {int(p) for p in network.rays.point[bad]}
        assert spoiled <= {d.point for d in result.doubtful}
        assert len(result.doubtful) <= len(spoiled) + 2
        compared = result.compare(network.check, result.adjusted_points(), result.point_sigma_m)
        assert compared.n == len(network.check) - sum(d.point in network.check.point for d in result.doubtful)
    assert missed <= 1 and wronged <= 6


def test_largest_set_that_agrees_takes_the_place_of_rays_that_were_kept_wrongly():
    """Here testing one ray after the other keeps six wrong rays and loses twelve good ones."""
    missed = wronged = 0
    for seed in (1, 4, 7):
        network, bad = with_outliers(block(seed).network, 0.25, seed + 5)
        out = rejected_rays(network, snoop(adjust(network, MODEL)).rejected)
        missed, wronged = missed + (bad & ~out).sum(), wronged + (out & ~bad).sum()
    assert missed <= 2 and wronged <= 3


def test_points_of_a_clean_block_are_not_doubtful():
    assert sum(len(run(block(seed).network, Job(MODEL, snoop=True)).doubtful) for seed in range(4)) <= 1


def test_three_rays_of_one_strip_of_which_one_slid_along_it_do_not_tell_which():
    """Each two of three rays in a plane meet: leaving out any of them cures the misfit."""
    design = np.zeros((3, 2, 3))
    tilt = np.array([-0.5, 0.0, 0.5])
    design[:, 0, 0], design[:, 0, 2], design[:, 1, 1] = 1.0, tilt, 1.0
    slid = np.array([[20.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    both = consensus(np.array([slid, slid[:, ::-1]]), np.array([design, design]), joint_limit(CRITICAL_W))
    assert both.found.all() and both.chosen[0].sum() == 2
    assert both.chosen[1].tolist() == [False, True, True] and both.rival.tolist() == [True, False]


def test_clean_block_loses_no_more_than_the_error_probability():
    lost = total = 0
    for seed in range(8):
        solution = adjust(block(seed).network, MODEL)
        lost, total = lost + len(snoop(solution).rejected), total + len(solution.network.rays)
    assert lost / total < 0.002


def test_w_of_a_clean_block_is_standard_normal():
    w = []
    for seed in range(4):
        solution = adjust(block(seed).network, MODEL)
        w.append(ray_statistics(solution, cofactors(solution)).w)
    every = np.concatenate(w)
    assert 0.97 < every[:, 0].std() < 1.03 and 0.97 < every[:, 1].std() < 1.03
    assert stats.kstest(every.ravel(), "norm").pvalue > 1e-3


def test_redundancy_numbers_sum_up_with_those_of_the_other_observations():
    solution = adjust(block(1).network, MODEL)
    Q = cofactors(solution)
    s = ray_statistics(solution, Q)
    assert (s.redundancy > 0).all() and (s.redundancy <= 1).all()
    prior = len(solution.problem.prior.value) - np.sum(solution.problem.prior.matrix.data**2 * Q.unknowns)
    control = solution.problem.control.weight
    of_control = (control > 0).sum() - np.sum(control * np.einsum("pii->pi", Q.points))
    assert s.redundancy.sum() + prior + of_control == pytest.approx(solution.redundancy, rel=1e-6)


@pytest.mark.parametrize("coordinate", [0, 1], ids=["line", "sample"])
def test_residuals_in_pixels_are_what_a_shifted_pixel_changes(coordinate):
    network = block(2).network
    i, shift = 17, 5e-3
    pixel = [network.rays.line.copy(), network.rays.sample.copy()]
    pixel[coordinate][i] += shift
    moved = rebuilt(network, *pixel)
    assert (moved.rays.source == np.arange(len(pixel[0]))).all()
    first, second = adjust(network, MODEL), adjust(moved, MODEL)
    before, after = (ray_statistics(s, cofactors(s)) for s in (first, second))
    change = (after.v_px - before.v_px)[i, coordinate] / shift
    np.testing.assert_allclose(change, before.redundancy[i, coordinate], rtol=2e-3)


def test_blunder_in_a_control_point_is_found_there_and_not_in_its_rays():
    network = block(4).network
    xyz = network.control.xyz_l.copy()
    xyz[2, 1] += 1.5
    network = replace(network, control=Control(network.control.point, xyz, network.control.sigma_m))
    outcome = snoop(adjust(network, MODEL))
    blamed = {(r.point, r.axis) for r in outcome.rejected if r.ray < 0}
    assert blamed == {(int(network.control.point[2]), 1)}
    assert sum(r.ray >= 0 for r in outcome.rejected) <= 2
    assert outcome.solution.sigma0 == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize(("axis", "off_m"), [(0, 20.0), (1, 500.0), (2, 100.0), (2, 5000.0)])
def test_control_that_is_grossly_wrong_goes_in_place_of_the_rays_of_its_point(axis, off_m):
    """It bends the block so much that its rays fail first: with all of them out nothing contradicted it any more."""
    clean = block(4).network
    xyz = clean.control.xyz_l.copy()
    xyz[2, axis] += off_m
    network = replace(clean, control=Control(clean.control.point, xyz, clean.control.sigma_m))
    outcome = snoop(adjust(network, MODEL))
    point = int(network.control.point[2])
    [(blamed, w)] = [((r.point, r.axis), r.w) for r in outcome.rejected if r.ray < 0]
    assert blamed == (point, axis)
    sigma = np.hypot(clean.control.sigma_m[2, axis], np.sqrt(outcome.cofactors.points[point, axis, axis]))
    assert w == pytest.approx(-off_m / sigma, rel=0.02)
    assert not any(network.rays.point[r.ray] == point for r in outcome.rejected if r.ray >= 0)
    without = np.array(clean.control.sigma_m)
    without[2, axis] = np.inf
    by_hand = snoop(adjust(replace(clean, control=Control(clean.control.point, clean.control.xyz_l, without)), MODEL))
    assert outcome.solution.sigma0 == pytest.approx(by_hand.solution.sigma0, rel=1e-4)
    np.testing.assert_allclose(outcome.solution.state.points_l, by_hand.solution.state.points_l, atol=2e-4)


def test_looks_at_other_points_leave_no_trace_in_the_weights():
    """Wrong names move looks by thousands of pixels; weights of the block that they bend are not those without them."""
    clean = block(6).network
    line, sample = clean.rays.line.copy(), clean.rays.sample.copy()
    bad = np.arange(5, len(line), len(line) // 8)
    line[bad], sample[bad] = np.roll(line[bad], 1), np.roll(sample[bad], 1)
    network = rebuilt(clean, line, sample)
    moved = np.isin(network.rays.source, bad)
    outcome = snoop(adjust(network, MODEL))
    out = rejected_rays(network, outcome.rejected)
    assert out[moved].all() and (out & ~moved).sum() <= 1
    by_hand = solve(outcome.solution.problem, None, (~out).astype(float))
    assert outcome.solution.sigma0 == pytest.approx(by_hand.sigma0, rel=1e-4)
    np.testing.assert_allclose(outcome.solution.whitening.g, by_hand.whitening.g, rtol=1e-3, atol=1e-9)


def wandering(seed):
    """A block whose trajectories have slow errors that DGR cannot follow."""
    rng = np.random.default_rng(seed)
    ground = scatter_points(150, (-1500, 1500, -1200, 1200), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)
    lines = parallel_and_cross(CAMERA, 2000.0, 2, 2, 3000.0)
    noise = Noise(wander_m=0.5, wander_deg=0.02)
    return simulate_network(CAMERA, lines, ground, dict.fromkeys(range(6), "control"), [], MODEL, rng, noise).network


def test_model_that_does_not_fit_is_not_taken_for_blunders():
    result = run(wandering(1), Job(MODEL, snoop=True))
    assert result.given_up > 0.35 and result.rejected == ()
    assert (result.solution.ray_weight == 1.0).all()
    assert not result.test.passed


def test_control_is_left_out_only_where_the_image_points_fit():
    """Control at odds with a poor model stays: the block stands on it."""
    network = wandering(2)
    outcome = snoop(adjust(network, MODEL))
    assert all(r.ray >= 0 for r in outcome.rejected)
    assert np.abs(control_tests(outcome.solution, outcome.cofactors)).max() > 2 * CRITICAL_W


def test_masked_ray_that_was_wronged_returns():
    """Two outliers at one point make a good ray of it fail; it must be back in the end."""
    network = block(5).network
    p = int(np.argmax(network.rays_per_point))
    rays = np.flatnonzero(network.rays.point == p)
    line, sample = network.rays.line.copy(), network.rays.sample.copy()
    line[rays[:3]] += 12.0
    sample[rays[0]] -= 20.0
    spoiled = rebuilt(network, line, sample)
    bad = np.isin(spoiled.rays.source, rays[:3])
    returned = []
    outcome = snoop(adjust(spoiled, MODEL), progress=lambda r: returned.append(r.returned))
    out = rejected_rays(spoiled, outcome.rejected)
    assert out[bad].all()
    assert (out & ~bad).sum() <= 1
    assert outcome.rounds == len(returned) and returned[-1] == 0


def test_two_rays_that_contradict_each_other_are_both_named():
    network = block(6, strips=1, cross=0).network
    p = next(int(i) for i in np.flatnonzero(network.rays_per_point == 3) if i not in network.control.point)
    rays = np.flatnonzero(network.rays.point == p)
    sample = network.rays.sample.copy()
    sample[rays[0]] += 30.0
    keep = np.delete(np.arange(len(sample)), rays[2])
    m = measurements(network, network.rays.line, sample)
    m = Measurements(*(getattr(m, name)[keep] for name in m.__dataclass_fields__ if name != "time_s"))
    two = build_network(network.camera, network.strips, network.point_ids, m, network.control, network.check)
    rejected = snoop(adjust(two, MODEL)).rejected
    at_point = {r.reason for r in rejected if two.rays.point[r.ray] == two.point_index[network.point_ids[p]]}
    assert at_point == {"snooping", "lone"}


def test_joint_limit_has_the_error_probability_of_one_coordinate():
    assert joint_limit(CRITICAL_W) == pytest.approx(13.8, abs=0.05)
    assert stats.chi2.sf(joint_limit(CRITICAL_W), 2) == pytest.approx(0.001, abs=5e-6)


def test_control_that_returns_has_the_weight_of_the_other_control():
    """Whose sigmas were found to be three times as large as stated, before the search."""
    solution = scaled(adjust(block(2).network, MODEL), {"control": 3.0})
    control = solution.problem.control
    key = next(zip(*np.nonzero(control.weight > 0), strict=True))
    stated = control.weight[key]
    without = replace(control, weight=control.weight.copy())
    without.weight[key] = 0.0
    start = solve(replace(solution.problem, control=without), solution)
    out = Rejected(-1, int(key[0]), int(key[1]), 4.0, "snooping")
    before = replace(snoop(start), rejected=(out,))
    found = snoop(start, before=before)
    assert not [r for r in found.rejected if r.ray < 0]
    assert found.solution.problem.control.weight[key] == pytest.approx(stated)


def test_critical_value_must_be_positive():
    with pytest.raises(ValueError, match="critical value"):
        snoop(adjust(block(1, points=30).network, MODEL), critical=0.0)


@pytest.mark.parametrize("weights", [Huber(), Danish(), Igg3()])
def test_robust_estimation_withstands_outliers(weights):
    clean = block(7).network
    network, _ = with_outliers(clean, 0.05, 1)
    robust = run(network, Job(MODEL, robust=weights))
    plain = run(network, Job(MODEL))
    reference = check_rmse(clean, adjust(clean, MODEL).state.points_l)
    of_robust, of_plain = (np.linalg.norm(check_rmse(network, r.adjusted_points())) for r in (robust, plain))
    assert of_robust < 1.6 * np.linalg.norm(reference)
    assert of_plain > 2.0 * of_robust


@pytest.mark.parametrize("weights", [Huber(), Danish(), Igg3()])
def test_robust_estimation_leaves_good_rays_alone(weights):
    """Points have few rays, and residuals are half as large as errors: a scale that followed these threw out many."""
    network = block(7).network
    plain, robust = run(network, Job(MODEL)), run(network, Job(MODEL, robust=weights))
    assert len(robust.rejected) < 0.002 * len(network.rays)
    assert robust.solution.sigma0 == pytest.approx(plain.solution.sigma0, rel=0.03)
    sigmas = [np.sqrt(np.einsum("pii->p", cofactors(r.solution).points)) for r in (plain, robust)]
    assert np.median(sigmas[1] / sigmas[0]) == pytest.approx(1.0, abs=0.02)
    assert pickle.loads(pickle.dumps(weights)) == weights  # partitions are adjusted by other processes


def test_steps_to_a_robust_start_count():
    """The result said `0 iterations, converged`."""
    network = block(7).network
    plain, robust = run(network, Job(MODEL)), run(network, Job(MODEL, robust=Huber()))
    assert robust.iterations >= plain.iterations > 0


def test_igg3_names_what_it_left_without_weight():
    network, bad = with_outliers(block(7).network, 0.05, 1)
    result = run(network, Job(MODEL, robust=Igg3()))
    out = rejected_rays(network, result.rejected)
    assert {r.reason for r in result.rejected} == {"robust"}
    assert (out & bad).sum() / bad.sum() >= 0.98


@pytest.mark.parametrize("then", [None, MODEL])
def test_robust_weights_are_those_of_their_function_in_a_second_model_too(then):
    network, _ = with_outliers(block(7).network, 0.05, 1, high=12.0)
    found = run(network, Job(MODEL, then, robust=Huber())).solution
    wanted = Huber()(np.abs(found.linearisation.residual).max(axis=0))
    assert (wanted < 0.8).sum() > 10
    np.testing.assert_allclose(found.ray_weight, wanted, rtol=1e-2)


def test_what_robust_estimation_leaves_out_is_no_observation():
    """Danish weights of outliers are tiny and not zero: counted in full such rays made sigma0 too small."""
    network, _ = with_outliers(block(7).network, 0.08, 1)
    danish, igg3 = (run(network, Job(MODEL, robust=weights)) for weights in (Danish(), Igg3()))
    assert len(danish.rejected) > 0.07 * len(network.rays)
    for result in (danish, igg3):
        assert {r.ray for r in result.rejected} == set(np.flatnonzero(result.solution.ray_weight == 0.0))
    assert danish.test.sigma0 == pytest.approx(igg3.test.sigma0, rel=0.01)


def with_half_the_sigma():
    """A network with gross errors whose image sigma is stated half as large as it is; which rays are spoilt."""
    network = block(8, noise=0.6).network
    half = np.full(len(network.rays), 0.3)
    rays = replace(network.rays, sigma_line_px=half, sigma_sample_px=half)
    return with_outliers(replace(network, rays=rays), 0.05, 2)


def test_wrong_image_sigma_is_mended_before_outliers_are_sought():
    """With a sigma half as large as it should be, every eighth good ray would fail the test."""
    network, bad = with_half_the_sigma()
    result = run(network, Job(MODEL, snoop=True, reweight=True))
    out = rejected_rays(network, result.rejected)
    assert result.image_factor == pytest.approx(2.0, rel=0.05)
    assert (out & bad).sum() / bad.sum() >= 0.98 and (out & ~bad).sum() / (~bad).sum() < 0.005
    without = run(network, Job(MODEL, snoop=True))
    assert (rejected_rays(network, without.rejected) & ~bad).sum() > 5 * (out & ~bad).sum()


def test_variance_components_and_snooping_agree_in_the_end():
    """What is left out depends on the sigma of the image, and that on what is left out."""
    network, bad = with_half_the_sigma()
    result = run(network, Job(MODEL, snoop=True, components=True))
    (image,) = (c for c in result.components if c.group == "image")
    assert image.factor == pytest.approx(2.0, rel=0.05)
    assert result.solution.sigma0 == pytest.approx(1.0, abs=0.02)
    out = rejected_rays(network, result.rejected)
    assert (out & bad).sum() / bad.sum() >= 0.98 and (out & ~bad).sum() / (~bad).sum() < 0.005


def test_snooping_goes_through_self_calibration():
    network, bad = with_outliers(block(9).network, 0.05, 3)
    result = run(network, Job(MODEL, self_calibration=tls(CAMERA), snoop=True))
    out = rejected_rays(network, result.rejected)
    assert (out & bad).sum() / bad.sum() >= 0.98 and (out & ~bad).sum() / (~bad).sum() < 0.004
