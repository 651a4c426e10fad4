"""Additional parameters: formulas, subsets, and that they bring a wrongly calibrated camera back to truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from places import BLOCKS, needs_blocks

from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.covariance import point_cofactors
from triline.solver.camera.line_camera import Lens, LineCamera, straight_line
from triline.solver.camera.self_calibration import (
    FOCAL_SIGMA,
    SELF_CALIBRATIONS,
    boresight,
    focal_length,
    lens,
    prism,
    tls,
    unit_of,
)
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.network import disturb_camera


def two_lenses():
    """Forward and backward lens, two lines of four chips each."""
    lines = []
    for name, x in (("L1", 8.0), ("L2", -8.0)):
        chips = (0, 3000, 6000, 9000)
        lines.append(straight_line(f"{name}a", name, 12000, 0.0065, (x, 0.0), chips=chips))
        lines.append(straight_line(f"{name}b", name, 12000, 0.0065, (-x, 0.5), chips=chips))
    return LineCamera("two", (Lens("L1", 60.0), Lens("L2", 61.0, (0.1, -0.2))), tuple(lines))


def test_names_and_counts():
    assert tls(CAMERA).names == (
        *("dc", "k1", "k2", "k3", "p1", "p2"),
        *(f"{kind}_{line}" for kind in ("xp", "yp", "sy", "th") for line in "BFN"),
    )
    assert [tls(CAMERA, n).n_unknowns for n in (18, 16, 12)] == [18, 16, 12]
    assert set(tls(CAMERA, 16).unknown_names) == set(tls(CAMERA).names) - {"xp_N", "yp_N"}
    gone = {"xp_N", "yp_N", "sy_N", "th_N", "dc", "k3"}
    assert set(tls(CAMERA, 12).unknown_names) == set(tls(CAMERA).names) - gone
    triplet = [straight_line(i, i, 20000, 0.007, (0.0, 0.0), chips=(0, 5000, 10000, 15000)) for i in "FNB"]
    three = LineCamera("prism", tuple(Lens(i, 2000.0) for i in "FNB"), tuple(triplet))
    assert prism(three).n_unknowns == 30 and prism(three).name == "prism30"
    assert lens(two_lenses()).n_unknowns == 18
    assert set(SELF_CALIBRATIONS) == {"tls18", "tls16", "tls12", "prism30", "lens", "boresight", "focal", "calibrated"}
    assert focal_length(CAMERA).names == ("dc",) and focal_length(CAMERA).apriori_sigma == [FOCAL_SIGMA]


def test_tls_formulas():
    """D of [K 4.43], written down once more for one ray on line F."""
    aps = tls(CAMERA)
    rng = np.random.default_rng(0)
    value = dict(zip(aps.names, rng.normal(size=18) * aps.sigma, strict=True))
    x, y, c = 30.58, -21.5, 62.7
    design = aps.design(np.array([0]), np.array([100.0]), np.array([[x, y]]), np.array([c]))
    got = design.evaluate(np.array(list(value.values())))[:, 0]
    r2 = x * x + y * y
    radial = value["k1"] * r2 + value["k2"] * r2**2 + value["k3"] * r2**3 - value["dc"] / c
    dx = value["xp_F"] + x * radial + (r2 + 2 * x * x) * value["p1"] + 2 * x * y * value["p2"] + y * value["th_F"]
    dy = value["yp_F"] + y * radial + (r2 + 2 * y * y) * value["p2"] + 2 * x * y * value["p1"] - y * value["sy_F"]
    np.testing.assert_allclose(got, [dx, dy], rtol=1e-12)


def test_boresight_turns_the_camera_as_a_whole():
    """Against rays turned by the rotation itself."""
    aps, angles, c = boresight(CAMERA), np.array([3e-4, -5e-4, 8e-4]), 62.7
    xy = np.array([[-30.0, 20.0], [0.0, 0.0], [12.0, -33.0]])
    rays = np.column_stack([xy / c, -np.ones(3)]) @ matrix_from_angles(*angles)  # R^T f
    turned = -c * rays[:, :2] / rays[:, 2:]
    design = aps.design(np.array([0, 1, 2]), np.zeros(3), xy, np.full(3, c))
    np.testing.assert_allclose(design.evaluate(angles).T, turned - xy, atol=5e-5)
    assert np.abs(turned - xy).min() > 5e-3 and unit_of("boresight_phi") == "rad"


def test_prism_parameters_go_by_chip_and_lens_parameters_by_lens():
    camera = two_lenses()
    aps = prism(camera)
    sample = np.array([0.0, 2999.4, 3000.0, 11999.0])
    xy = np.array([[1.0, 2.0]] * 4)
    design = aps.design(np.full(4, 1), sample, xy, np.full(4, 60.0))
    names = [[aps.names[c] for c in row] for row in design.columns[design.pattern]]
    assert [n[0] for n in names] == ["dx_L1b1", "dx_L1b1", "dx_L1b2", "dx_L1b4"]
    assert all(n[2:] == ["b_L1b", "s_L1b"] for n in names)
    values = np.zeros(len(aps.names))
    values[aps.names.index("b_L1b")] = 2.0
    values[aps.names.index("s_L1b")] = 3.0
    np.testing.assert_allclose(design.evaluate(values), [[2.0 * 2.0 * 5.0] * 4, [3.0 * 2.0] * 4])
    by_lens = lens(camera)
    columns = by_lens.design(np.arange(4), np.zeros(4), xy, np.full(4, 60.0)).columns
    assert columns[0].tolist() == columns[1].tolist() == list(range(9))
    assert columns[3].tolist() == list(range(9, 18))


def test_parameters_that_are_not_estimated_have_no_column():
    aps = tls(CAMERA).without(["k3", "xp_F"])
    assert aps.n_unknowns == 16 and "k3" not in aps.unknown_names
    columns = aps.design(np.array([0]), np.zeros(1), np.ones((1, 2)), np.full(1, 62.7)).columns
    assert columns[0, 3] == -1 and columns[0, 6] == -1
    with pytest.raises(ValueError, match="k9"):
        aps.without(["k9"])


def test_apriori_sigmas_by_name_and_by_kind():
    aps = tls(CAMERA).with_sigma({"k1": 1e-9, "th": 1e-5, "xp_F": 0.5})
    of = dict(zip(aps.names, aps.sigma, strict=True))
    assert of["k1"] == 1e-9 and of["th_B"] == of["th_N"] == 1e-5 and of["xp_F"] == 0.5 and of["xp_B"] == 0.1
    assert (tls(CAMERA).free().sigma > 1e3 * tls(CAMERA).sigma).all()
    with pytest.raises(ValueError, match="positive"):
        aps.with_sigma({"k1": 0.0})


@pytest.mark.parametrize("make", [tls, lens], ids=["tls", "lens"])
def test_parameters_recover_the_true_camera(make):
    """Every parameter of a wrong camera is estimated within its sigma, over 6 seeds; without them sigma0 shows it."""
    aps = make(CAMERA)
    scale = {"dc": 0.003, "k1": 2e-6, "k2": 1e-9, "k3": 1e-13, "p1": 1e-6, "p2": 1e-6, "xp": 0.005, "yp": 0.005}
    scale |= {"dx": 0.005, "dy": 0.005, "sy": 1e-4, "th": 1e-4}
    sigma = np.array([scale[name.split("_")[0]] for name in aps.names])
    weighted = replace(aps, sigma=sigma)
    squares, sigma0 = [], []
    for seed in range(6):
        truth = dict(zip(aps.names, np.random.default_rng(seed).normal(size=len(sigma)) * sigma, strict=True))
        simulated = simulate(seed, DgrOptions(), points=50, self_calibration=aps, camera_parameters=truth)
        solution = adjust(simulated.network, DgrOptions(), weighted)
        error = solution.camera_parameters - np.array(list(truth.values()))
        own = np.arange(solution.layout.n_model, solution.layout.n_unknowns)
        squares.append(error @ np.linalg.solve(solution.factor.cofactors(own), error) / len(own))
        sigma0.append((solution.cost, solution.redundancy))
        assert adjust(simulated.network, DgrOptions()).sigma0 > 1.5
    cost, redundancy = np.sum(sigma0, axis=0)
    assert abs(np.sqrt(cost / redundancy) - 1) < 4 / np.sqrt(2 * redundancy)
    n = 6 * len(sigma)
    assert abs(np.mean(squares) - 1) < 4 * np.sqrt(2 / n)


def test_disturbed_camera_is_measured_minus_displacement():
    aps = tls(CAMERA)
    truth = disturb_camera(CAMERA, aps, {"dc": 0.1, "k1": 1e-6})
    line, moved = CAMERA.lines[0], truth.lines[0]
    x, y = line.xy_mm[1000]
    radial = 1e-6 * (x * x + y * y) - 0.1 / 62.7
    np.testing.assert_allclose(moved.xy_mm[1000], [x - x * radial, y - y * radial], rtol=1e-12)


def test_lenses_that_look_separately_have_correction_sets_of_their_own():
    camera = two_lenses()
    simulated = simulate(2, DgrOptions(), camera=camera, points=50)
    solution = adjust(simulated.network, DgrOptions(), lens(camera))
    assert len(solution.layout.sets) == 2 * len(simulated.network.strips)
    assert "kappa drift of strip S1, lens L2" in solution.layout.names
    assert 0.85 < solution.sigma0 < 1.15


@needs_blocks
def test_block_with_camera_errors():
    from triline.nodes.formats.block_folder import read_block
    from triline.solver.adjustment.block_data import network_from_block

    block = read_block(BLOCKS / "selfcal")
    truth = json.loads((BLOCKS / "selfcal" / "truth.json").read_text())
    network = network_from_block(block)
    options = DgrOptions.from_settings(block.apriori.trajectory)
    assert adjust(network, options).sigma0 > 5.0
    solution = adjust(network, options, tls(network.camera))
    assert 0.95 < solution.sigma0 < 1.05
    error = solution.state.points_l - np.array([truth["points"][name] for name in network.point_ids])
    sigma = np.sqrt(np.einsum("nii->ni", point_cofactors(solution)))
    ratio = np.sqrt((error**2).mean(axis=0)) / np.sqrt((sigma**2).mean(axis=0))
    assert (ratio > 0.7).all() and (ratio < 1.3).all()
    spread = np.sqrt(solution.factor.variances())[solution.layout.n_model :]
    true = np.array([truth["ap"].get(name, 0.0) for name in tls(network.camera).names])
    assert (np.abs(solution.camera_parameters - true) < 3.5 * spread).all()
