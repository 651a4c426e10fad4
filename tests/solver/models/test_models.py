"""Trajectory models: what they promise of columns and coefficients, continuity, counts and fixes."""

import numpy as np
import pytest
from adjustment_networks import simulate

import triline.solver.models as models
from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.refined_orientation import corrections_at
from triline.solver.models import MODELS, Extent
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions, fewest_rays, merge_fixes
from triline.solver.models.ppm import PpmOptions

EXTENT = Extent("strip S1", 100.0, 160.0)
OPTIONS = [
    DgrOptions(),
    PpmOptions(segments=1),
    PpmOptions(segments=5),
    PpmOptions(segments=3, order=1, continuity=2),
    LimOptions(fixes=4),
    LimOptions(fixes=9, merge=False),
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_design_and_names_agree_in_size(options):
    model = options.build(EXTENT)
    t = np.linspace(100.0, 160.0, 41)
    design = model.design(t)
    assert design.columns.shape == (*design.coefficients.shape, 6)
    assert design.columns.dtype == np.int32
    assert design.columns.min() >= -1 and design.columns.max() == model.n_unknowns - 1
    assert len(set(model.unknown_names)) == model.n_unknowns
    theta = np.random.default_rng(1).normal(size=model.n_unknowns)
    slow = np.zeros((len(t), 6))
    for i in range(len(t)):
        for k in range(design.columns.shape[1]):
            for c in range(6):
                if design.columns[i, k, c] >= 0:
                    slow[i, c] += design.coefficients[i, k] * theta[design.columns[i, k, c]]
    np.testing.assert_allclose(model.evaluate(theta, t), slow, atol=1e-12)
    prior = model.pseudo_observations()
    assert len(prior) == len(prior.labels) == len(prior.sigma) == len(prior.columns)
    assert (prior.sigma > 0).all()
    assert set(range(model.n_unknowns)) <= set(prior.columns.ravel().tolist()), "every unknown must carry a weight"


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_constant_unknowns_give_constant_corrections(options):
    """What all models share: a constant of the six corrections is among their functions."""
    model = options.build(EXTENT)
    t = np.linspace(100.0, 160.0, 57)
    constant = np.array([0.1, -0.2, 0.3, 1e-4, -2e-4, 3e-4])
    A = np.stack([model.evaluate(row, t).ravel() for row in np.eye(model.n_unknowns)], axis=1)
    theta, *_ = np.linalg.lstsq(A, np.tile(constant, len(t)), rcond=None)
    np.testing.assert_allclose(model.evaluate(theta, t), np.tile(constant, (len(t), 1)), atol=1e-12)


def test_dgr_is_offset_shift_and_drift_over_the_trajectory():
    model = DgrOptions().build(EXTENT)
    theta = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(model.evaluate(theta, [100.0])[0], [1, 2, 3, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(model.evaluate(theta, [160.0])[0], [1, 2, 3, 0.11, 0.22, 0.33])
    assert model.unknown_names[8] == "kappa drift of strip S1"
    described = model.describe(theta, theta)
    np.testing.assert_allclose(described["drift_deg"], np.degrees(theta[6:]))


@pytest.mark.parametrize("placed", ["equal", "data"])
def test_ppm_with_zero_continuity_misclosure_is_smooth(placed):
    rng = np.random.default_rng(3)
    extent = Extent("strip S1", 100.0, 160.0, np.sort(rng.uniform(100, 130, 300)), np.array([105.0, 150.0]))
    model = PpmOptions(segments=6, placed=placed, continuity=2).build(extent)
    prior = model.pseudo_observations()
    tied = np.array([label.startswith("C") for label in prior.labels])
    assert tied.sum() == 3 * 6 * 5
    A = np.zeros((tied.sum(), model.n_unknowns + 1))
    np.add.at(A, (np.arange(tied.sum())[:, None], prior.columns[tied]), prior.coefficients[tied])
    null = np.linalg.svd(A[:, :-1])[2][tied.sum() :]
    theta = null.T @ rng.normal(size=len(null))
    for border in model.borders[1:-1]:
        h = 1e-3
        before, after = (
            model.evaluate(theta, [border - h, border - 2 * h, border - 3 * h]),
            model.evaluate(theta, [border, border + h, border + 2 * h]),
        )
        np.testing.assert_allclose(after[0], 3 * before[0] - 3 * before[1] + before[2], atol=1e-9)
        slope_before, slope_after = (before[0] - before[1]) / h, (after[1] - after[0]) / h
        np.testing.assert_allclose(slope_after, slope_before, atol=1e-2 * np.abs(slope_before).max() + 1e-9)


def test_data_placed_segments_share_the_rays():
    rng = np.random.default_rng(5)
    times = np.concatenate([rng.uniform(100, 115, 900), rng.uniform(115, 160, 100)])
    model = PpmOptions(segments=4, placed="data").build(Extent("strip S1", 100.0, 160.0, times))
    counts = np.histogram(times, model.borders)[0]
    np.testing.assert_allclose(counts, 250, atol=2)
    assert model.borders[0] == 100.0 and model.borders[-1] == 160.0
    few = PpmOptions(segments=4, placed="data").build(Extent("strip S1", 100.0, 160.0, np.full(50, 101.0)))
    assert (np.diff(few.borders) > 1.0).all(), "borders stay apart where all rays fall together"


def test_lagrange_passes_through_the_fixes_and_reproduces_cubics():
    model = LimOptions(fixes=7, merge=False).build(EXTENT)
    rng = np.random.default_rng(2)
    theta = rng.normal(size=(7, 6))
    np.testing.assert_allclose(model.evaluate(theta.ravel(), model.fixes), theta, atol=1e-12)
    t = np.linspace(100.0, 160.0, 33)
    cubic = rng.normal(size=(4, 6))

    def at(times):
        return np.vander((times - 100.0) / 60.0, 4) @ cubic

    np.testing.assert_allclose(model.evaluate(at(model.fixes).ravel(), t), at(t), atol=1e-12)


def test_lagrange_uses_the_two_fixes_on_each_side():
    model = LimOptions(fixes=7, merge=False).build(EXTENT)
    inside = model.design([model.fixes[3] + 1.0]).columns[0, :, 0] // 6
    np.testing.assert_array_equal(inside, [2, 3, 4, 5])
    np.testing.assert_array_equal(model.design([100.0]).columns[0, :, 0] // 6, [0, 1, 2, 3])
    np.testing.assert_array_equal(model.design([160.0]).columns[0, :, 0] // 6, [3, 4, 5, 6])


def test_numbers_of_rays_between_fixes():
    with_aps = {4: 15, 5: 12, 6: 12, 7: 10, 8: 9, 30: 9}
    without = {4: 9, 7: 9, 8: 8, 30: 8}
    assert {n: fewest_rays(n, True) for n in with_aps} == with_aps
    assert {n: fewest_rays(n, False) for n in without} == without


def test_fixes_with_too_few_rays_are_merged_and_reported():
    rng = np.random.default_rng(0)
    times = np.concatenate([rng.uniform(100, 125, 200), rng.uniform(140, 160, 200)])
    model = LimOptions(fixes=13).build(Extent("strip S1", 100.0, 160.0, times))
    assert 4 <= len(model.fixes) < 13
    assert model.fixes[0] == 100.0 and model.fixes[-1] == 160.0
    assert (np.histogram(times, model.fixes)[0] >= fewest_rays(len(model.fixes), False)).all()
    assert any("merged" in note for note in model.notes)
    assert len(merge_fixes(np.linspace(0, 1, 20), np.empty(0), False)) == 4


@pytest.mark.parametrize(
    "build",
    [
        lambda: LimOptions(fixes=3),
        lambda: PpmOptions(segments=0),
        lambda: PpmOptions(order=3),
        lambda: PpmOptions(placed="nowhere"),
        lambda: DgrOptions.from_settings({"offset_sigma_m": "much"}),
        lambda: DgrOptions.from_settings({"shift_sigma_deg": [0.1, 0.1, 0.0]}),
        lambda: Extent("strip S1", 2.0, 2.0),
    ],
)
def test_bad_settings_are_named(build):
    with pytest.raises(ValueError, match=r"fixes|segments|order|placed|offset_sigma_m|shift_sigma_deg|strip S1"):
        build()


def test_models_are_found_by_name():
    assert sorted(MODELS)[:3] == ["dgr", "lim", "ppm"]
    for name in ("dgr", "ppm", "lim"):
        options = MODELS[name].from_settings({"segments": 3, "fixes": 5, "offset_sigma_m": 0.5, "unknown": 1})
        assert options.offset_sigma_m == (0.5, 0.5, 0.5)


NEW_MODEL = '''
"""Only a vertical offset."""
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from .base import CorrectionModel, Design, ModelOptions, direct_observations


@dataclass(frozen=True)
class VerticalOptions(ModelOptions):
    name: ClassVar[str] = "vertical"

    @classmethod
    def from_settings(cls, settings):
        return cls()

    def build(self, extent):
        return Vertical(extent)


class Vertical(CorrectionModel):
    def __init__(self, extent):
        self.extent = extent
        self.unknown_names = (f"Z offset of {extent.name}",)

    def design(self, time_s):
        n = len(np.asarray(time_s))
        columns = np.full((n, 1, 6), -1, dtype=np.int32)
        columns[:, 0, 2] = 0
        return Design(columns, np.ones((n, 1)))

    def pseudo_observations(self):
        return direct_observations([5.0], self.unknown_names)

    def describe(self, theta, sigma):
        return {"offset_m": float(theta[0])}
'''


def test_a_new_model_is_one_new_file(tmp_path, monkeypatch):
    """Dropped into the package it is found, adjusts, and everything that is asked of models works."""
    (tmp_path / "vertical.py").write_text(NEW_MODEL)
    monkeypatch.setattr(models, "__path__", [*models.__path__, str(tmp_path)])
    found = models._find()
    assert set(found) == {*MODELS, "vertical"}
    options = found["vertical"].from_settings({})
    simulated = simulate(1, options, points=30)
    solution = adjust(simulated.network, options)
    strips = simulated.network.strips
    truth = [simulated.corrections[strips[s.strip].id][0] for s in solution.layout.sets]
    sigma = np.sqrt(solution.factor.variances())
    assert 0.85 < solution.sigma0 < 1.15
    assert (np.abs(solution.state.theta - truth) < 4 * sigma).all()
    assert np.abs(truth).max() > 10 * sigma.max()
    np.testing.assert_allclose(corrections_at(solution, 0, [1.0])[0], [0, 0, solution.state.theta[0], 0, 0, 0])
