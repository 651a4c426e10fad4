"""Weights of the piecewise models stated from the slow errors: what they say beforehand is what the errors are."""

import numpy as np
import pytest
from adjustment_networks import simulate

from triline.solver.adjustment.adjustment import solve
from triline.solver.adjustment.problem import continue_problem, pose_problem
from triline.solver.models.base import Extent
from triline.solver.models.gauss_markov import autocorrelation
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.error_models import draw_wander

START, END = 100.0, 160.0
SLOW = SlowErrors(
    (0.5, 0.5, 0.8), (3e-4, 3e-4, 6e-4), (2e-4, 2e-4, 1e-4), (1.0, 1.0, 1.5), (1e-4, 1e-4, 2e-4), wander_time_s=30.0
)
OPTIONS = [
    PpmOptions(segments=30, slow=SLOW),
    PpmOptions(segments=15, slow=SLOW),
    LimOptions(31, False, slow=SLOW),
    LimOptions(16, False, slow=SLOW),
    WanderOptions(SLOW),
]
WANDER = np.array([*SLOW.wander_m, *SLOW.wander])


def prior(model, times):
    """Covariance (n, n) of each of six corrections at times, from the a-priori observations alone."""
    p = model.pseudo_observations()
    A = np.zeros((len(p), model.n_unknowns + 1))
    np.put_along_axis(A, np.where(p.columns >= 0, p.columns, model.n_unknowns), p.coefficients, axis=1)
    A = A[:, :-1] / p.sigma[:, None]
    assert len(p) == model.n_unknowns or isinstance(model.options, PpmOptions)
    scale = 1.0 / np.linalg.norm(A, axis=0)
    design = model.design(times)
    rows = np.zeros((len(times), 6, model.n_unknowns + 1))
    i, c = np.arange(len(times))[:, None, None], np.arange(6)
    np.add.at(rows, (i, c, np.where(design.columns >= 0, design.columns, -1)), design.coefficients[:, :, None])
    D = rows[:, :, :-1] * scale
    inverse = np.linalg.inv((A * scale).T @ (A * scale))
    return [D[:, c] @ inverse @ D[:, c].T for c in range(6)]


def stated(times):
    """The same from the definition of the errors."""
    share = (times - START) / (END - START)
    constant = np.square([*SLOW.offset_m, *SLOW.shift])
    drift = np.square([0.0, 0.0, 0.0, *SLOW.drift])
    together = autocorrelation(SLOW.wander_time_s, times[:, None] - times)
    return [constant[c] + drift[c] * np.outer(share, share) + WANDER[c] ** 2 * together for c in range(6)]


@pytest.mark.parametrize(
    "options", OPTIONS, ids=lambda o: f"{o.name}-{getattr(o, 'segments', getattr(o, 'fixes', ''))}"
)
def test_what_is_known_beforehand_is_the_covariance_of_the_errors(options):
    model = options.build(Extent("strip S1", START, END))
    times = np.array([100.0, 100.7, 101.0, 113.3, 140.0, 141.1, 158.9, 160.0])
    left = model.left_out_variance(times)
    for c, (found, wanted) in enumerate(zip(prior(model, times), stated(times), strict=True)):
        variance = np.diagonal(found) + left[:, c]
        assert variance == pytest.approx(np.diagonal(wanted), rel=0.02)
        sigma = np.sqrt(np.diagonal(wanted))
        assert found / np.outer(sigma, sigma) == pytest.approx(wanted / np.outer(sigma, sigma), abs=0.03)


def quadratic(model, t, value, rate):
    """The wander (n,) between the borders of a piecewise polynomial, value and slope drawn every 0.1 s."""
    k = np.clip(np.searchsorted(model.borders, t, side="right") - 1, 0, model.segments - 1)
    at = np.round((model.borders - START) / 0.1).astype(int)
    length = np.diff(model.borders)[k]
    s = (t - model.borders[k]) / length
    return (1 - s**2) * value[at[k]].T + (s - s**2) * length * rate[at[k]].T + s**2 * value[at[k + 1]].T


@pytest.mark.parametrize("fixes", [31, 11, 5])
def test_left_out_by_the_cubic_through_fixes_is_what_drawn_wanders_do(fixes):
    model = LimOptions(fixes, False, slow=SLOW).build(Extent("strip S1", START, END))
    value, _ = draw_wander(np.random.default_rng(3), 601, 0.1, np.full(2000, 1.5), SLOW.wander_time_s)
    t = START + 0.1 * np.arange(601)
    theta = np.zeros((model.n_unknowns, 2000))
    at = np.round((model.fixes - START) / 0.1).astype(int)
    theta[11::6] = value[at]
    inside = np.arange(3, 600, 37)
    for i in inside:
        d = model.design(t[i : i + 1])
        beyond = value[i] - d.coefficients[0, 2:] @ theta[d.columns[0, 2:, 2]]
        assert np.mean(beyond**2) == pytest.approx(model.left_out_variance(t[i : i + 1])[0, 2], rel=0.15, abs=1e-9)


@pytest.mark.parametrize("segments", [30, 10, 3])
def test_left_out_by_parabolas_is_what_drawn_wanders_do(segments):
    model = PpmOptions(segments=segments, slow=SLOW).build(Extent("strip S1", START, END))
    value, rate = draw_wander(np.random.default_rng(4), 601, 0.1, np.full(2000, 1.5), SLOW.wander_time_s)
    for i in range(3, 600, 37):
        t = START + 0.1 * i
        beyond = value[i] - quadratic(model, np.array([t]), value, rate)[:, 0]
        assert np.mean(beyond**2) == pytest.approx(model.left_out_variance([t])[0, 2], rel=0.15, abs=1e-9)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_unknowns_and_description_go_together(options):
    model = options.build(Extent("strip S1", START, END))
    assert len(model.unknown_names) == len(set(model.unknown_names))
    assert model.design(np.array([START, END])).columns.max() < model.n_unknowns
    told = model.describe(np.arange(model.n_unknowns, dtype=float), np.ones(model.n_unknowns))
    assert told["offset_m"] == [0.0, 1.0, 2.0] and told["drift_deg_sigma"] == pytest.approx([57.29578] * 3)


SETTINGS = {
    "offset_sigma_m": [0.5, 0.5, 0.8],
    "wander_sigma_m": [1.0, 1.0, 1.5],
    "wander_sigma_deg": [0.005, 0.005, 0.01],
    "wander_time_s": 30.0,
}


@pytest.mark.parametrize("options", [PpmOptions, LimOptions], ids=lambda o: o.name)
def test_a_project_that_states_its_wander_gets_weights_and_segments_from_it(options):
    model = options.from_settings(SETTINGS).build(Extent("strip S1", START, END))
    assert model.options.slow is not None and len(getattr(model, "borders", getattr(model, "fixes", ()))) == 31
    assert options.from_settings({"offset_sigma_m": 0.5}).slow is None
    few = options.from_settings(SETTINGS | {"segments": 6, "fixes": 7}).build(Extent("strip S1", START, END))
    assert len(getattr(few, "borders", getattr(few, "fixes", ()))) == 7


def test_own_weights_of_the_piecewise_model_come_first():
    assert PpmOptions.from_settings(SETTINGS | {"first_sigma_m": 0.1}).slow is None


def test_settings_that_a_stated_wander_replaces_are_told():
    extent = Extent("strip S1", START, END)
    plain, told = (
        PpmOptions.from_settings(settings).build(extent).notes
        for settings in (SETTINGS, SETTINGS | {"order": 1, "continuity": 2})
    )
    assert set(told) - set(plain) == {
        f"{what} was not used: a wander is stated, from which follow second-order terms and how pieces go on"
        for what in ("order 1", "continuity 2")
    }
    own = SETTINGS | {"order": 1, "first_sigma_m": 0.1}
    assert PpmOptions.from_settings(own).build(extent).notes == plain


def test_the_batch_weighs_rays_by_what_the_model_cannot_follow():
    """And a model run after another takes no part of the first one's."""
    network = simulate(1, LimOptions(5, False)).network
    few, many = (LimOptions(n, False, slow=SLOW) for n in (5, 25))
    coarse = pose_problem(network, few)
    noise = coarse.network.rays.orientation_noise
    model = coarse.layout.sets[0].model
    mine = coarse.layout.set_of_ray == 0
    wanted = model.left_out_variance(network.rays.time_s[mine])
    before = 0.0 if network.rays.orientation_noise is None else network.rays.orientation_noise[mine]
    assert np.einsum("nii->ni", noise[mine] - before) == pytest.approx(wanted)
    following = continue_problem(solve(coarse), many)
    alone = pose_problem(network, many).network.rays.orientation_noise
    assert following.network.rays.orientation_noise == pytest.approx(alone, abs=1e-12)
