"""The wander model stated anew in the middle of a strip has the covariance it is stated with."""

import numpy as np
import pytest

from triline.solver.models.base import Extent, PseudoObservations, join_observations
from triline.solver.models.gauss_markov import autocorrelation
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.models.wander import WanderOptions

START, END = 100.0, 160.0
SLOW = SlowErrors(wander_m=(1.0, 1.0, 1.5), wander=(1e-4, 1e-4, 2e-4), wander_time_s=30.0)
SIGMA = np.array([1.0, 1.0, 1.5, 1e-4, 1e-4, 2e-4])

Z = 2


def model():
    return WanderOptions(SLOW).build(Extent("strip S1", START, END))


def covariance(wander, times, component):
    """Of the corrections of one component at times, from the a-priori observations alone."""
    p = wander.pseudo_observations()
    A = np.zeros((len(p), wander.n_unknowns + 1))
    np.put_along_axis(A, np.where(p.columns >= 0, p.columns, wander.n_unknowns), p.coefficients, axis=1)
    A = A[:, :-1] / p.sigma[:, None]
    scale = 1.0 / np.linalg.norm(A, axis=0)
    N = (A * scale).T @ (A * scale)
    design = wander.design(times)
    D = np.zeros((len(times), wander.n_unknowns + 1))  # the last one takes what the component does not have
    for i in range(len(times)):
        np.add.at(D[i], design.columns[i, :, component][2:], design.coefficients[i][2:])
    D = D[:, :-1] * scale
    return D @ np.linalg.solve(N, D.T)


def test_without_it_the_process_is_stationary():
    times = np.array([100.0, 113.0, 140.0, 159.0])
    C = covariance(model(), times, 2)
    assert np.diagonal(C) == pytest.approx(1.5**2, rel=0.02)


def test_what_grows_is_the_same_error_made_larger_and_what_shrinks_is_another():
    wander = model()
    grown = SIGMA * [5.0, 1.0, 1.0, 1.0, 1.0, 30.0]
    up = wander.restate(112.3, grown, 6.0)
    down = wander.restate(129.0, SIGMA, 30.0)
    assert 112.3 < up <= 112.3 + 2.1 * wander.step_s and 129.0 < down <= 129.0 + 2.1 * wander.step_s
    times = np.array([up - wander.step_s, up, 0.5 * (up + down), down, down + 4.0])
    for component, factor in ((0, 5.0), (1, 1.0), (5, 30.0)):
        C = covariance(wander, times, component)
        before, large = SIGMA[component] ** 2, (factor * SIGMA[component]) ** 2
        assert np.diagonal(C) == pytest.approx([before, large, large, before, before], rel=0.02)
        correlation = C / np.sqrt(np.outer(np.diagonal(C), np.diagonal(C)))
        assert correlation[0, 1] == pytest.approx(autocorrelation(6.0, wander.step_s), abs=0.01)  # the old error
        assert correlation[3, 4] > 0.9
        if factor > 1.0:
            assert abs(correlation[1, 3]) < 1e-6  # another one


def test_a_new_error_of_the_same_size_has_nothing_to_do_with_the_old_one():
    wander = model()
    border = wander.restate(120.0, SIGMA, 30.0, another=True)
    C = covariance(wander, np.array([border - wander.step_s, border]), 4)
    assert np.diagonal(C) == pytest.approx(SIGMA[4] ** 2, rel=0.02) and abs(C[0, 1]) < 1e-3 * SIGMA[4] ** 2
    between = wander.left_out_variance([border - 0.5 * wander.step_s])[0, 4]
    assert between > 0.4 * SIGMA[4] ** 2  # where between two borders it begins is not known


def test_what_has_been_used_does_not_change():
    wander = model()
    p = wander.pseudo_observations()
    coefficients, sigma = p.coefficients.copy(), p.sigma.copy()
    used_s = 120.7
    border = wander.restate(used_s, 4.0 * SIGMA, 6.0)
    changed = np.flatnonzero((p.coefficients != coefficients).any(axis=1) | (p.sigma != sigma))
    columns = wander.design([used_s]).columns
    assert changed.size and p.columns[changed].max(axis=1).min() > columns.max()
    assert wander.restate(END, SIGMA, 30.0) == np.inf and border > used_s


def sparing():
    """With segments as long as a small part left out allows."""
    options = WanderOptions(SLOW, left_out_m=0.1, left_out=1e-5)
    return options.build(Extent("strip S1", START, END))


def test_longer_segments_say_the_same_of_the_process():
    """Interpolation and what it leaves out together have the covariance of the process, between borders, too."""
    wander, fine = sparing(), model()
    for used, all_of_them in zip(wander.used, fine.used, strict=True):
        assert len(used) <= len(all_of_them) // 2 + 1
    assert wander.step_s == fine.step_s
    times = np.linspace(START, END, 41)
    for component in (2, 5):
        C = covariance(Used(wander), times, component)
        whole = np.diagonal(C) + wander.left_out_variance(times)[:, component]
        assert whole == pytest.approx(SIGMA[component] ** 2, rel=1e-6)
        expected = SIGMA[component] ** 2 * autocorrelation(30.0, times[:, None] - times)
        assert pytest.approx(expected, abs=0.01 * SIGMA[component] ** 2) == C
    left = np.sqrt(wander.left_out_variance(times).max(axis=0))
    assert (left[:3] <= 0.1).all() and (left[3:] <= 1e-5).all() and left[2] > 0.03


def test_segments_become_short_where_the_wander_grows_and_long_where_it_is_small_again():
    wander = sparing()
    p = wander.pseudo_observations()
    before, used_s = wander.used[Z], 112.3
    columns = wander.design([used_s]).columns
    up = wander.restate(used_s, 40.0 * SIGMA, 30.0)
    down = wander.restate(135.0, SIGMA, 30.0)
    assert wander.design([used_s]).columns.tolist() == columns.tolist()
    lengths = np.diff(wander.borders[wander.used[Z]])
    starts = wander.borders[wander.used[Z][:-1]]
    longest = np.diff(wander.borders[before]).max()
    assert lengths[(starts >= up) & (starts < 135.0)] == pytest.approx(wander.step_s)
    assert lengths[starts >= down][:-1] == pytest.approx(longest)
    assert lengths[starts < used_s - longest] == pytest.approx(longest)
    # what leads to borders that are not in use has no weight, all others do
    touched = set(p.columns[np.isfinite(p.sigma)].ravel().tolist())
    assert {9 + 12 * k + Z for k in wander.used[Z].tolist()} <= touched
    assert not {9 + 12 * k + Z for k in set(range(len(wander.borders))) - set(wander.used[Z].tolist())} & touched
    C = covariance(Used(wander), np.array([100.0, 0.5 * (up + down), 150.0]), 0)
    assert np.sqrt(np.diagonal(C)) == pytest.approx(SIGMA[0] * np.array([1.0, 40.0, 1.0]), rel=0.01)


def test_each_component_has_segments_as_long_as_its_own_wander_allows():
    """A heading that is hardly known wants short ones; for all others the longest may do, and it is the same process.

    Where another wander begins in the middle of the strip, it does for all components at one border.
    """
    sigma = SIGMA * [1.0, 1.0, 1.0, 1.0, 1.0, 100.0]
    slow = SlowErrors(wander_m=(1.0, 1.0, 1.5), wander=(1e-4, 1e-4, 2e-2), wander_time_s=30.0)
    wander = WanderOptions(slow, left_out_m=0.1, left_out=1e-5).build(Extent("strip S1", START, END))
    length = [np.diff(used)[0] for used in wander.used]
    assert length[5] == 1 and min(length[:5]) >= 2 and length[0] > length[2]
    times = np.linspace(START, END, 41)
    for component in range(6):
        expected = sigma[component] ** 2 * autocorrelation(30.0, times[:, None] - times)
        assert pytest.approx(expected, abs=0.01 * sigma[component] ** 2) == covariance(Used(wander), times, component)
    columns, used_s = wander.design([112.3]).columns, 112.3
    border = wander.restate(used_s, SIGMA, 30.0)
    assert used_s < border <= used_s + 2.0 * max(length) * wander.step_s
    first = int(np.searchsorted(wander.borders, border - 1e-9))
    assert all(first in used for used in wander.used)
    assert np.diff(wander.used[5])[-2] == np.diff(sparing().used[5])[0] > 1
    unchanged = wander.design([used_s])
    for component in range(6):
        both = [set(c[0, :, component].tolist()) for c in (columns, unchanged.columns)]
        assert both[0] == both[1]
        C = covariance(Used(wander), np.array([100.0, border, 150.0]), component)
        expected = [sigma[component], SIGMA[component], SIGMA[component]]
        assert np.sqrt(np.diagonal(C)) == pytest.approx(expected, rel=0.01)


class Used:
    """A wander model with the unknowns that appear nowhere held, so that its normal equations are regular."""

    def __init__(self, wander):
        self.n_unknowns, self.design = wander.n_unknowns, wander.design
        p = wander.pseudo_observations()
        every = np.arange(len(wander.borders))
        idle = [9 + 12 * np.setdiff1d(every, used) + c for c, used in enumerate(wander.used)]
        self._observations = join_observations([p, *(direct_at(i + slope) for i in idle for slope in (0, 6))])

    def pseudo_observations(self):
        return self._observations


def direct_at(columns):
    n = len(columns)
    return PseudoObservations(columns[:, None].astype(np.int32), np.ones((n, 1)), np.zeros(n), np.ones(n), ("",) * n)
