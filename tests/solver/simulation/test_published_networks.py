"""Sigmas of published networks: against the published ones, against errors that are drawn, against what must follow."""

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.statistics import planimetric
from triline.solver.camera.sensors import preset
from triline.solver.models.base import same
from triline.solver.models.dgr import DgrOptions
from triline.solver.scene_adjustment.solution import adjust, intersect, points_enu, prepare
from triline.solver.simulation.published_network import (
    AerialNetwork,
    SceneNetwork,
    control_differences,
    network_sigmas,
)
from triline.solver.simulation.published_tables import NETWORKS, six_of_prism


def few_rows(key, rows):
    network = NETWORKS[key]()
    return replace(network, rows=tuple(network.rows[i] for i in rows))


def test_sigmas_of_prism_are_near_the_published_ones():
    """Nine and more control points, where their place matters little: theory against theory, nothing is drawn.

    In height the published ones are larger throughout: 2.7 times those in planimetry instead of 2.4.
    """
    networks = [few_rows("saitama", [2, 5]), few_rows("bern", [4]), few_rows("zurich", [3])]
    for found in network_sigmas(networks, 1):
        p, where = found.row.published, (found.network.key, found.row.label, found.row.control)
        assert 0.8 < found.sigma_xy / p.sigma_xy < 1.1, where
        assert 0.7 < found.sigma_z / p.sigma_z < 1.2, where


def test_sigmas_of_aerial_blocks_follow_the_published_ones():
    """Table 5.4: sigmas here are smaller by a quarter to a third throughout, for whatever model and control."""
    network = few_rows("si290", [0, 7, 8, 15])
    ratio = np.array([
        (r.sigma_xy / r.row.published.sigma_xy, r.sigma_z / r.row.published.sigma_z)
        for r in network_sigmas([network], 1)
    ])  # fmt: skip
    assert ((ratio > 0.6) & (ratio < 0.95)).all()


def test_sigmas_fall_with_control_and_grow_with_unknowns():
    network = few_rows("piemont", [0, 2, 3])
    five, nine, in_pieces = (r.sigma_z / r.row.sigma0_px for r in network_sigmas([network], 1))
    assert nine < five and nine < in_pieces


def test_image_points_and_control_of_a_network_are_free_of_errors():
    """The adjustment stays at the truth, with attitudes as unknown as 2 degrees."""
    network = NETWORKS["saitama"]()
    block = network.block(network.rows[0], np.random.default_rng(1))
    solution = adjust(prepare(block))
    known = block.known
    d = points_enu(solution.problem, solution.state.position_e, known.position_e, known.point)
    assert solution.converged and np.abs(d).max() < 1e-3
    assert [known.role.count(role) for role in ("control", "check")] == [5, 198]
    assert not solution.undetermined


def test_every_network_is_as_large_as_published():
    points = {"hrs": 41, "aster": 6, "saitama": 203, "bern": 108, "piemont": 29, "okazaki": 51, "zurich": 99}
    points |= {"si290": 39, "si100": 61, "vaihingen": 201, "pavia2000": 46, "pavia4000": 50}
    assert set(points) == set(NETWORKS)
    for key, make in NETWORKS.items():
        network = make()
        assert network.key == key and network.unsaid.startswith("Unsaid: ")
        assert isinstance(network, SceneNetwork | AerialNetwork)
        of_points = network.known if isinstance(network, SceneNetwork) else network.field.signalised
        assert of_points == points[key]
        assert {row.control + row.check for row in network.rows} == {points[key]}


def test_scale_and_bending_of_a_prism_line_are_free():
    six = six_of_prism(preset("alos-prism"))
    assert six.unknown_names == ("b_F", "s_F", "b_N", "s_N", "b_B", "s_B")
    bending, scale = six.apriori_sigma[:2]
    half_mm = 35.0  # of a line: five pixels and more at its ends carry no weight
    assert bending * half_mm**3 > 5 * 0.007 and scale * half_mm > 5 * 0.007


def test_differences_at_control_are_as_large_as_told():
    """Drawn errors of ASTER's six control points: intersection of the adjusted rays minus given coordinates."""
    network = NETWORKS["aster"]()
    row = replace(network.rows[0], model=DgrOptions(same(2.0), same(0.02), same(0.005)))
    block = network.block(row, np.random.default_rng(3))
    solution = adjust(prepare(block))
    points = np.arange(6)
    told = control_differences(solution, points)
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rays = replace(
            block.rays,
            line=block.rays.line + rng.normal(0.0, row.image_px, len(block.rays)),
            sample=block.rays.sample + rng.normal(0.0, row.image_px, len(block.rays)),
        )
        axes = solution.problem.R_e_enu[block.known.point]
        error = np.einsum("pij,pj->pi", axes, rng.normal(0.0, network.control_m, (6, 3)))
        given = replace(block.known, position_e=block.known.position_e + error)
        drawn = adjust(prepare(replace(block, rays=rays, known=given)))
        by_rays, _ = intersect(drawn.problem, drawn.state, drawn.ray_weight)
        squares.append(points_enu(drawn.problem, by_rays, given.position_e, given.point) ** 2)
    ratio = np.sqrt(np.mean(squares, axis=(0, 1)) / np.einsum("pii->pi", told).mean(axis=0))
    assert ((ratio > 0.85) & (ratio < 1.15)).all()


def test_aerial_networks_carry_the_weights_of_their_rows():
    """Sigmas of direct georeferencing are those of the trajectory: ten centimetres and more at Pavia."""
    network = few_rows("pavia2000", [0])
    (found,) = network_sigmas([network], 1)
    height_m, attitude = 0.20 / 0.0065 * 62.77, np.radians(0.0054)
    assert found.sigma_xy == pytest.approx(np.hypot(0.1, height_m * attitude), rel=0.25)
    assert found.sigma_xy == pytest.approx(planimetric(found.sigma_m[0]))
