"""The reduced system along a band with a border gives what the dense one gives, singular or not."""

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate
from scipy.sparse import csr_array

from triline.solver.adjustment import normal_matrix
from triline.solver.adjustment.adjustment import adjust, pose_problem
from triline.solver.adjustment.covariance import cofactors
from triline.solver.adjustment.nested_dissection import Dissection
from triline.solver.adjustment.normal_matrix import DenseMatrix, Structure, new_matrix
from triline.solver.adjustment.reduced_system import BandedFactor, DenseFactor
from triline.solver.camera.self_calibration import tls
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions

LONG = {"points": 400, "strips": 1, "cross": 0, "length_m": 60000.0}


@pytest.mark.parametrize("with_aps", [False, True], ids=["", "tls18"])
@pytest.mark.parametrize("options", [LimOptions(fixes=60, merge=False), PpmOptions(segments=24)], ids=["lim", "ppm"])
def test_band_and_dense_agree(monkeypatch, options, with_aps):
    network = simulate(1, options, **LONG).network
    aps = tls(CAMERA) if with_aps else None
    monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10)
    banded = adjust(network, options, aps)
    assert isinstance(banded.factor, BandedFactor)
    monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10**6)
    dense = adjust(network, options, aps)
    assert isinstance(dense.factor, DenseFactor)
    sigma = np.sqrt(dense.factor.variances())
    assert (np.abs(banded.state.theta - dense.state.theta) < 1e-6 * sigma).all()
    ours, theirs = cofactors(banded), cofactors(dense)
    np.testing.assert_allclose(ours.unknowns, theirs.unknowns, rtol=1e-7)
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-7 * np.abs(theirs.points).max())
    np.testing.assert_allclose(ours.observed, theirs.observed, atol=1e-8)
    far = np.array([0, dense.layout.n_model // 2, dense.layout.n_unknowns - 1])
    np.testing.assert_allclose(
        banded.factor.cofactors(far) / np.outer(sigma[far], sigma[far]),
        dense.factor.cofactors(far) / np.outer(sigma[far], sigma[far]),
        atol=1e-7,
    )
    b = np.random.default_rng(0).normal(size=(len(sigma), 2)) / sigma[:, None]
    np.testing.assert_allclose(
        banded.factor.solve(b) / sigma[:, None], dense.factor.solve(b) / sigma[:, None], rtol=1e-6
    )


def test_band_is_narrow_on_a_long_strip(monkeypatch):
    options = LimOptions(fixes=60, merge=False)
    network = simulate(1, options, **LONG).network
    monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10)
    structure = pose_problem(network, options, tls(CAMERA)).elimination.structure
    assert structure is not None
    assert np.diff(structure.bounds).max() <= 150
    assert sorted(structure.position) == list(range(60 * 6 + 18))


def test_singular_band_and_singular_dense_agree(monkeypatch):
    """Nothing known of position: the block floats, in both forms, and what does not float is the same."""
    loose = LimOptions(fixes=60, merge=False, offset_sigma_m=(np.inf,) * 3)
    known = LimOptions(fixes=60, merge=False)
    network = simulate(1, known, control=0, **LONG).network
    monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10)
    banded = adjust(network, loose)
    monkeypatch.setattr(normal_matrix, "DENSE_UP_TO", 10**6)
    dense = adjust(network, loose)
    assert len(banded.factor.undetermined) == len(dense.factor.undetermined) >= 3
    a, b = banded.factor.undetermined, dense.factor.undetermined
    onto = b.vectors @ np.linalg.lstsq(b.vectors, a.vectors, rcond=None)[0]
    np.testing.assert_allclose(onto, a.vectors, atol=1e-3)
    assert banded.cost == pytest.approx(dense.cost, rel=1e-6)
    assert banded.n_unknowns == dense.n_unknowns


def test_dense_factor_of_a_singular_matrix_holds_the_null_space():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(30, 9)) @ np.diag(10.0 ** rng.uniform(-4, 4, 9))
    A[:, 4] = 2.0 * A[:, 1] - A[:, 7]
    N = A.T @ A
    factor = DenseFactor(N.copy())
    assert len(factor.undetermined) == 1
    null = factor.undetermined.vectors[:, 0] * factor.undetermined.scale
    np.testing.assert_allclose(A @ null, 0.0, atol=1e-6 * np.abs(A * null).max())
    x = factor.solve(N @ np.ones(9))
    np.testing.assert_allclose(A @ x, A @ np.ones(9), rtol=1e-6)
    regular = DenseFactor((N + np.diag(np.diagonal(N))).copy())
    assert len(regular.undetermined) == 0
    np.testing.assert_allclose(regular.inverse() @ (N + np.diag(np.diagonal(N))), np.eye(9), atol=1e-9)


@pytest.mark.parametrize("kind", ["dense", "band", "fronts"])
def test_blocks_are_added_and_subtracted_where_they_belong(kind):
    rng = np.random.default_rng(3)
    n, everything = 150, np.arange(150)
    bounds, position = np.array([0, 60, 120]), rng.permutation(n)
    structure = {
        "dense": None,
        "band": Structure(position, bounds),
        "fronts": Dissection(
            position, np.append(bounds, n), (everything[60:], everything[120:], everything[:0]), np.array([1, 2, -1])
        ),
    }[kind]
    matrix, wanted = new_matrix(n, structure), np.diag(np.full(n, 1000.0))
    matrix.add_sparse(csr_array(wanted))
    columns = np.array([[7, 3, 5, 140], [20, -1, 3, 21]])
    blocks = rng.standard_normal((2, 4, 4))
    blocks += blocks.transpose(0, 2, 1)
    matrix.add_each(columns, blocks)
    wanted[np.ix_(columns[0], columns[0])] += blocks[0]
    wanted[np.ix_([20, 3, 21], [20, 3, 21])] += blocks[1][np.ix_([0, 2, 3], [0, 2, 3])]
    many = np.concatenate([np.arange(2, 70), [90, 91, 149]])
    root = rng.standard_normal((5, len(many)))
    matrix.subtract(many, root.T @ root)
    wanted[np.ix_(many, many)] -= root.T @ root
    if isinstance(matrix, DenseMatrix):
        np.testing.assert_allclose(matrix.whole(), wanted, atol=1e-12)
    np.testing.assert_allclose(matrix.factorise().cofactors(everything), np.linalg.inv(wanted), rtol=1e-9, atol=1e-15)
