"""What the window computes in a shorter way is what the long way gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.ray_statistics import whitened_pixels
from triline.solver.adjustment.reduced_system import DenseFactor
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_online, navigate
from triline.solver.window.datum.drift_monitor import DriftMonitor
from triline.solver.window.results import WindowOptions
from triline.solver.window.state.maker import BatchMaker, Draft
from triline.solver.window.state.unknowns import WindowState
from triline.solver.window.window import Window

PLAN = FlightPlan(lead_in_s=3.0, lead_out_s=2.0)
SENSORS = ErrorModel(attitude_rate_hz=100.0)


def test_cofactors_of_the_last_unknowns() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(60, 40)) * 10.0 ** rng.uniform(-3, 3, 40)
    wanted = np.linalg.inv(A.T @ A)[25:, 25:]
    factor = DenseFactor(A.T @ A)
    last = factor.last_cofactors(25)
    scale = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(last / scale / scale[:, None], wanted / scale / scale[:, None], atol=1e-9)
    factor.inverse()
    np.testing.assert_allclose(factor.last_cofactors(25), last, rtol=1e-9, atol=1e-12 * np.abs(last).max())


def test_cofactors_of_the_last_unknowns_of_a_singular_matrix() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(30, 5)) @ rng.normal(size=(5, 8))
    factor = DenseFactor(A.T @ A)
    np.testing.assert_allclose(factor.last_cofactors(5), factor.inverse()[5:, 5:])
    assert len(factor.undetermined.eigenvalues) == 3


def test_lasting_unknowns_stand_last_and_cofactors_are_those_of_the_whole_inverse() -> None:
    rng, state = np.random.default_rng(5), WindowState()
    lasting, other = state.new_numbers(2), [state.new_numbers(4) for _ in range(3)]
    state.last(lasting)
    state.enter(lasting)
    for numbers in other:
        state.enter(numbers)
        columns = np.concatenate([numbers, lasting])
        rows = rng.normal(size=(9, 6))
        state.observe(np.tile(columns, (9, 1)).astype(np.int32), rows, rng.normal(size=9), np.ones(9))
    assert state.numbers.tolist() == [*np.concatenate(other), *lasting]
    state.solve()
    matrix, rhs = state.normal()
    Q = np.linalg.inv(matrix)
    np.testing.assert_allclose(state.theta, Q @ rhs)
    for numbers in (np.append(other[2], lasting[1]), other[1], np.append(lasting, other[0]), lasting[:0]):
        places = state.places(numbers)
        np.testing.assert_allclose(state.covariance(numbers), Q[np.ix_(places, places)], atol=1e-12)
    more = state.new_numbers(2)
    columns = np.stack([more, other[2][:2], lasting], axis=1).astype(np.int32)
    state.covariance(other[2])
    state.extend(more, columns, rng.normal(size=(2, 3)), np.ones(2), np.array([0.5, 2.0]))
    assert state.numbers.tolist() == [*np.concatenate(other), *more, *lasting]
    Q, solution = np.linalg.inv(state.normal()[0]), state.solution
    state.solve()
    assert state.solution == solution  # nothing to solve
    np.testing.assert_allclose(state.theta, Q @ state.normal()[1])
    np.testing.assert_allclose(state.covariance(more), Q[12:14, 12:14], atol=1e-12)
    np.testing.assert_allclose(state.covariance(state.numbers[8:]), Q[8:, 8:], atol=1e-12)
    left = state.marginalise(other[0])
    assert left.stayed.tolist() == state.numbers.tolist() == [*other[1], *other[2], *more, *lasting]
    places = np.r_[4:16]
    np.testing.assert_allclose(state.covariance(more), Q[12:14, 12:14], atol=1e-12)
    np.testing.assert_allclose(state.covariance(state.numbers), Q[np.ix_(places, places)], atol=1e-12)


def test_values_and_cofactors_if_others_were_held() -> None:
    rng, state = np.random.default_rng(3), WindowState()
    state.enter(state.new_numbers(9))
    state.observe(np.tile(state.numbers, (20, 1)).astype(np.int32), rng.normal(size=(20, 9)), np.ones(20), np.ones(20))
    state.solve()
    held, numbers = np.array([7, 1]), np.array([4, 0, 8])
    wanted_cofactors, wanted = state.conditioned(held)
    values, cofactors = state.if_held(held, numbers)
    np.testing.assert_allclose(values, wanted[numbers])
    np.testing.assert_allclose(cofactors, wanted_cofactors[np.ix_(numbers, numbers)])
    everything, values = state.conditioned(held[:0])
    np.testing.assert_allclose(values, state.theta)
    np.testing.assert_allclose(everything, np.linalg.inv(state.normal()[0]))


def test_scores_of_drifts_are_those_of_the_residuals() -> None:
    """Of every batch of a window, whatever solution its residuals are for."""
    simulation = simulate(replace(PLAN, strip_s=12.0), 1, SENSORS, ObservationPlan(tie_points_per_s=6.0))
    compared = 0

    def watch(_: float, window: Window) -> None:
        nonlocal compared
        state, batches = window.state, list(window.network.batches)
        monitor = DriftMonitor(window.network)
        monitor.begin()
        cells = monitor.cells(batches)
        for batch in batches:
            v_px = batch.judge(state)[1].v_px
            v = np.einsum("nij,nj->ni", whitened_pixels(batch.rays, batch.lin, batch.whitening), v_px)
            cell = cells[id(batch)]
            B, G = cell.effect.reshape(2 * len(v), -1), batch.without_points[1].reshape(2 * len(v), -1).T
            np.testing.assert_allclose(cell.border.G, G @ B, atol=1e-9 * np.abs(cell.border.G).max())
            score = B.T @ v.ravel() + state.values(batch.columns) @ cell.border.G
            np.testing.assert_allclose(cell.border.r, score, atol=1e-8 * np.abs(score).max())
            compared += 1

    adjust_online(simulation, navigate(simulation), live=False, watch=watch)
    assert compared > 20


@pytest.mark.study
def test_a_joined_batch_says_what_its_parts_said() -> None:
    """Rays that come a few at a time: batches of a time are joined, and together know what they knew."""
    simulation = simulate(replace(PLAN, strip_s=24.0), 1, SENSORS, ObservationPlan(tie_points_per_s=20.0))
    sizes, compared = [], 0

    def watch(now: float, window: Window) -> None:
        nonlocal compared
        sizes.append(max((len(b.rays) for b in window.network.batches if b.newest_s < now - 3.0), default=0))
        parts = [b for b in window.network.batches if b.provisional][:3]
        if len(parts) < 2 or compared == 20:
            return
        compared += 1
        points, state = window.network.intake.points, window.state
        known = {name: xyz for b in parts for name, xyz in zip(b.names, b.points_l, strict=True)}
        maker = BatchMaker(window.network)
        made = [maker.make(Draft(b.names, [points[n] for n in b.names]), known) for b in parts]
        joined = maker.make(Draft(list(known), [points[n] for n in known]), known)
        total, rhs = np.zeros((len(state), len(state))), np.zeros(len(state))
        for batch in made:
            assert batch is not None
            place = state.places(batch.columns)
            total[np.ix_(place, place)] += batch.information.matrix
            rhs[place] += batch.information.rhs
        assert joined is not None
        place = state.places(joined.columns)
        scale = np.sqrt(np.diagonal(state.covariance(joined.columns)))
        got = joined.information
        wanted = total[np.ix_(place, place)] * scale * scale[:, None]
        np.testing.assert_allclose(got.matrix * scale * scale[:, None], wanted, atol=1e-9 * np.abs(wanted).max())
        np.testing.assert_allclose(got.rhs * scale, rhs[place] * scale, rtol=1e-7, atol=1e-6)
        assert got.rows == sum(b.information.rows for b in made if b is not None)

    adjust_online(simulation, navigate(simulation), live=False, watch=watch, update_s=0.05)
    assert compared == 20
    assert 12 < max(sizes) <= 160  # 3 rays an update; smoothed poses come five times a second


def test_what_batches_keep_of_all_is_what_a_walk_over_them_gives() -> None:
    """While points come, looks are rejected, batches are joined and leave, over two strips."""
    plan = ObservationPlan(tie_points_per_s=6.0, outlier_share=0.05)
    strips = replace(PLAN, strips=2, strip_s=14.0, turns=False, gap_s=4.0)
    simulation = simulate(strips, 3, SENSORS, plan)
    compared = 0

    def watch(_: float, window: Window) -> None:
        nonlocal compared
        batches = window.network.batches
        every = list(batches)
        for name in ("redundancy", "determined", "rays", "control", "points"):
            assert getattr(batches.counts, name) == sum(getattr(batch.counts, name) for batch in every), name
        for strip in range(2):
            assert batches.points_in(strip) == sum(b.n_points for b in every if strip in b.strips)
        assert {id(b) for b in batches.with_control()} == {id(b) for b in every if b.counts.control}
        assert batches.provisional() == [b for b in every if b.provisional]
        compared += bool(every)

    adjust_online(simulation, navigate(simulation), WindowOptions(window_s=8.0), live=False, watch=watch)
    assert compared > 100
