"""The reduced system in fronts of a nested dissection gives what the dense one gives, singular or not."""

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from scipy.sparse import csr_array

from triline.solver.adjustment import normal_matrix
from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.covariance import cofactors
from triline.solver.adjustment.frontal import FrontalFactor
from triline.solver.adjustment.nested_dissection import Dissection
from triline.solver.adjustment.reduced_system import DenseFactor
from triline.solver.camera.self_calibration import tls
from triline.solver.models.lim import LimOptions

WIDE = {"points": 900, "strips": 4, "cross": 1, "length_m": 24000.0}


def factors(monkeypatch, options, aps=None, **block):
    """The same adjustment with fronts and with a dense matrix."""
    network = simulate(1, LimOptions(fixes=20, merge=False), **block).network
    solutions = []
    for fronts in (True, False):
        monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10 if fronts else 10**6)
        monkeypatch.setattr(normal_matrix, "FRONTS_FROM", 10)
        monkeypatch.setattr(normal_matrix, "WORTH", 0.0)
        solutions.append(adjust(network, options, aps))
    assert isinstance(solutions[0].factor, FrontalFactor) and isinstance(solutions[1].factor, DenseFactor)
    return solutions


@pytest.mark.parametrize("aps", [None, tls(CAMERA)], ids=["", "tls18"])
def test_fronts_and_dense_agree(monkeypatch, aps):
    fronts, dense = factors(monkeypatch, LimOptions(fixes=20, merge=False), aps, **WIDE)
    sigma = np.sqrt(dense.factor.variances())
    assert (np.abs(fronts.state.theta - dense.state.theta) < 1e-7 * sigma).all()
    ours, theirs = cofactors(fronts), cofactors(dense)
    np.testing.assert_allclose(ours.unknowns, theirs.unknowns, rtol=1e-8)
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-8 * np.abs(theirs.points).max())
    np.testing.assert_allclose(ours.observed, theirs.observed, atol=1e-8)
    far = np.array([0, dense.layout.n_model // 2, dense.layout.n_unknowns - 1])
    scale = np.outer(sigma[far], sigma[far])
    np.testing.assert_allclose(fronts.factor.cofactors(far) / scale, dense.factor.cofactors(far) / scale, atol=1e-7)
    b = np.random.default_rng(0).normal(size=(len(sigma), 2)) / sigma[:, None]
    np.testing.assert_allclose(fronts.factor.solve(b), dense.factor.solve(b), rtol=1e-6, atol=1e-9 * sigma.max())


def test_singular_fronts_and_singular_dense_agree(monkeypatch):
    """Nothing known of position and no control: the block floats in both, and what does not float is the same."""
    loose = LimOptions(fixes=20, merge=False, offset_sigma_m=(np.inf,) * 3)
    fronts, dense = factors(monkeypatch, loose, **WIDE, control=0)
    assert len(fronts.factor.undetermined) == len(dense.factor.undetermined) >= 3
    assert (fronts.n_unknowns, fronts.n_observations) == (dense.n_unknowns, dense.n_observations)
    assert fronts.cost == pytest.approx(dense.cost, rel=1e-6)


def test_a_grid_of_unknowns_is_taken_apart():
    """A square of groups that meet their neighbours: fronts, which take a small part of a band's work."""
    side, each = 70, 6
    number = np.arange(side * side).reshape(side, side)
    meet = [number[i : i + 2, k : k + 2].ravel() for i in range(side - 1) for k in range(side - 1)]
    n = side * side * each
    cliques = [(each * groups[:, None] + np.arange(each)).ravel() for groups in meet]
    found = normal_matrix.find_structure(n, n, cliques, csr_array((n, n)))
    assert isinstance(found, Dissection)
    assert sorted(found.position) == list(range(n))
    assert found.work < 0.45 * n * (side * each) ** 2 / 2
    for t, rows in enumerate(found.rows):  # what is left of a front has its place in the next one
        up = int(found.parent[t])
        own = set(range(found.bounds[up], found.bounds[up + 1])) | set(found.rows[up].tolist()) if up >= 0 else set()
        assert set(rows.tolist()) <= own
