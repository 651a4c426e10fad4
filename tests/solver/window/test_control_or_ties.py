"""Control and tie points that contradict each other: drifts and biases of control as one border, and what is blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.drift_hypotheses import EACH, Hypothesis
from triline.solver.adjustment.reliability import CRITICAL_W
from triline.solver.camera.sensors import preset
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_at_once, adjust_online, navigate, orientation_errors
from triline.solver.window.datum.biases import Biases, Coordinate, Discrepancies, LeftControl, discrepancies
from triline.solver.window.datum.drift_monitor import DriftMonitor
from triline.solver.window.datum.hypotheses import weigh
from triline.solver.window.results import CONTRADICTS, TAKEN_BACK, WindowOptions
from triline.solver.window.state.network import LiveNetwork
from triline.solver.window.state.unknowns import Border, Information, WindowState

# ---- one border, carried through marginalisation

UNKNOWNS, GROUPS, BIASES = 7, 2, 3
DRIFTS = GROUPS * EACH


def left_with(N, rhs, square):
    """A state in which drifts and biases are held at zero, and what has left of them."""
    state = WindowState()
    numbers = state.new_numbers(UNKNOWNS)
    state.enter(numbers)
    x, d, b = slice(0, UNKNOWNS), slice(UNKNOWNS, UNKNOWNS + DRIFTS), slice(UNKNOWNS + DRIFTS, None)
    information = Information(N[x, x], rhs[x], square, 40)
    state.add(numbers, information)
    state.fix(numbers, information)
    border, left = DriftMonitor(LiveNetwork(preset("ads40-small"))), LeftControl(20)
    border._groups = {("", str(i)): i for i in range(GROUPS)}
    border._left.add(np.arange(DRIFTS), numbers, N[x, d], N[d, d], rhs[d])
    coordinates = [Coordinate(f"P{i}", 2, 0, 1.0, 0.0) for i in range(BIASES)]
    drifts = -1 - np.arange(DRIFTS)
    coupling = np.concatenate([N[x, b], N[d, b]])
    columns = np.concatenate([numbers, drifts])
    left.add(Biases(coordinates, np.zeros(BIASES, dtype=bool), Border(columns, coupling, N[b, b], rhs[b])))
    return state, border, left, numbers


def reduced(N, rhs, free):
    """Normal equations of the unknowns of drifts with others free, all else at zero."""
    d = np.arange(UNKNOWNS, UNKNOWNS + DRIFTS)
    inner = np.linalg.inv(N[np.ix_(free, free)])
    return N[np.ix_(d, d)] - N[np.ix_(d, free)] @ inner @ N[np.ix_(free, d)], rhs[d] - N[np.ix_(d, free)] @ inner @ rhs[
        free
    ]


def test_drifts_stay_exact_while_control_that_has_left_is_refused_and_taken_back():
    rng = np.random.default_rng(3)
    A, values = rng.normal(size=(60, UNKNOWNS + DRIFTS + BIASES)), rng.normal(size=60)
    N, rhs = A.T @ A, A.T @ values
    state, border, left, numbers = left_with(N, rhs, float(values @ values))
    for leaving, out in (([0, 3], []), ([1], [1]), ([5], [1, 2]), ([], [0, 2]), ([2], [0]), ([], [])):
        border.recount(*left.set_out(np.isin(np.arange(BIASES), out), state))
        if leaving:
            left.marginalised(border.marginalised(state.marginalise(numbers[leaving])))
        state.solve()
        coupling = np.zeros((DRIFTS, len(state)))
        beside = border._left
        coupling[:, state.places(beside.numbers)] = beside.G[:, :DRIFTS].T
        normal, score = beside.H[:DRIFTS, :DRIFTS], beside.r[:DRIFTS]
        free = [*range(UNKNOWNS), *(UNKNOWNS + DRIFTS + np.array(out, dtype=int))]
        V, s = reduced(N, rhs, free)
        assert normal - coupling @ state.propagated(coupling.T) == pytest.approx(V, rel=1e-8, abs=1e-8)
        assert score - coupling @ state.theta == pytest.approx(s, rel=1e-8, abs=1e-8)

        joint = discrepancies([left], state, Border(state.numbers, coupling.T, normal, score))
        information = np.block([[joint.C, joint.X], [joint.X.T, joint.V]])
        order = [*range(UNKNOWNS + DRIFTS, len(N)), *range(UNKNOWNS, UNKNOWNS + DRIFTS)]
        whole = np.linalg.inv(N)
        assert np.linalg.inv(information) == pytest.approx(whole[np.ix_(order, order)], rel=1e-7)
        both = np.linalg.solve(information, np.concatenate([joint.v, joint.score]))
        assert both == pytest.approx((whole @ rhs)[order], rel=1e-7)


# ---- of batches

PLAN = FlightPlan(strip_s=60.0, lead_in_s=3.0, lead_out_s=2.0)


@pytest.fixture(scope="module")
def flight():
    ties = ObservationPlan(tie_points_per_s=8.0, control=6, check=10)
    simulation = simulate(PLAN, 5, ErrorModel(attitude_rate_hz=100.0), ties)
    return simulation, navigate(simulation)


def test_what_drifts_have_to_do_with_control_is_what_refusing_it_changes(flight):
    """The border against a second way: control left out of its batch, and everything computed anew."""
    window = adjust_at_once(*flight, WindowOptions(snoop=False), until_s=50.0).window
    assert window is not None
    desk, sources, state = window._control, window._sources, window.state
    sources.begin()

    def joint():
        drifts = sources.unknowns(50.0)
        assert drifts is not None
        cells = sources.cells(window.network.batches)
        parts = [(b, p) for b in window.network.batches for p in desk._of_batch(b, cells.get(id(b)))]
        return [b for b, _ in parts], [p for _, p in parts], discrepancies([p for _, p in parts], state, drifts[0])

    batches, parts, before = joint()
    assert len(before.v) >= 6 and np.abs(before.X).max() > 0.1 * np.sqrt(before.C.max() * before.V.max())
    alone = discrepancies(parts, state)
    assert pytest.approx(alone.C) == before.C and before.v == pytest.approx(alone.v)

    refused = np.zeros(len(before.v), dtype=bool)
    refused[[0, 2, 4]] = True
    at = 0
    for batch, part in zip(batches, parts, strict=True):
        old = batch.information
        for c, lost in zip(part.coordinates, refused[at : at + len(part.coordinates)], strict=True):
            if lost:
                batch.weigh_control(batch.names.index(c.point), c.axis, 0.0)
                window.network.intake.points[c.point].out.add(c.axis)
        at += len(part.coordinates)
        batch.eliminate()
        state.exchange(batch.columns, old, batch.information)
    state.solve()
    through = before.X[refused].T @ np.linalg.inv(before.C[np.ix_(refused, refused)])
    drifts = sources.unknowns(50.0)
    assert drifts is not None
    beside, _ = drifts
    V = beside.H - beside.G.T @ state.propagated(beside.G)
    scale = np.sqrt(np.outer(np.diagonal(V), np.diagonal(V)))
    assert V / scale == pytest.approx((before.V - through @ before.X[refused]) / scale, abs=1e-7)
    score = beside.r - beside.G.T @ state.theta
    size = np.abs(before.score).max()
    assert score / size == pytest.approx((before.score - through @ before.v[refused]) / size, abs=1e-7)

    _, _, after = joint()  # and put back
    assert (after.out == refused).all()
    scale = np.sqrt(np.diagonal(before.C))[:, None] * np.sqrt(np.diagonal(before.V))
    assert after.X / scale == pytest.approx(before.X / scale, abs=1e-7)
    assert pytest.approx(before.C, rel=1e-6, abs=1e-6 * before.C.max()) == after.C


# ---- what is blamed


def weighed(drift_px, wrong_m, blamed=False):
    """Four heights of 0.1 m that a drift of 1 px, which residuals hardly show, moves by 0.5 m, some of them wrong."""
    rng = np.random.default_rng(1)
    effect, seen = np.full(4, 0.5) * [1.0, 1.2, 1.4, 1.6], 0.2
    # rows: heights, and what residuals of tie points show of the first of four unknowns of the drift
    A = np.zeros((8, 8))
    A[:4, :4], A[:4, 4] = np.eye(4) / 0.1, effect / 0.1
    A[4:, 4:] = np.eye(4) / seen
    truth = np.concatenate([wrong_m, [drift_px, 0.0, 0.0, 0.0]])
    rhs = A.T @ (A @ truth + rng.normal(size=8))
    N = A.T @ A
    coordinates = [Coordinate(f"P{i}", 2, 0, 1.0, 0.0) for i in range(4)]
    none = np.zeros(4, dtype=bool)
    d = Discrepancies(coordinates, none, N[:4, :4], rhs[:4], N[4:, 4:], rhs[4:], N[:4, 4:])

    drifts = [(Hypothesis(("", "F"), (0,)).choice(EACH, age=1.0), 28.5)]
    return weigh(d, drifts, CRITICAL_W**2, d.judge(CRITICAL_W**2), blamed)


def test_a_drift_is_blamed_for_what_it_explains_and_control_for_the_rest():
    clean = weighed(0.0, [0.0, 0.0, 0.0, 0.0])
    assert not clean.drift and not clean.verdict.out.any()
    drift = weighed(2.5, [0.0, 0.0, 0.0, 0.0])
    assert drift.drift and drift.told and not drift.verdict.out.any()
    wrong = weighed(0.0, [0.0, 3.0, 0.0, 0.0])
    assert not wrong.drift and wrong.told and wrong.verdict.out.tolist() == [False, True, False, False]
    both = weighed(2.5, [0.0, 3.0, 0.0, 0.0])
    assert both.drift and both.verdict.out.tolist() == [False, True, False, False]


def test_a_drift_that_control_meets_first_is_named_and_control_counts(flight):
    simulation, poses = flight
    images, looks = simulation.images, simulation.images.looks
    ids = np.array([line.id for line in simulation.flight.camera.lines])
    sample = np.where(ids[looks.ccd] == "F", 0.03 * looks.time_s, 0.0)
    spoilt = replace(simulation, images=replace(images, sample=images.sample + sample))
    online = adjust_online(spoilt, poses, WindowOptions(grid_hz=4.0), live=False, update_s=1.0)
    alarms = [r.quality.sources for r in online.reports if r.quality.sources]
    assert alarms and all(("", "F") in sources[0].suspects for sources in alarms)
    refused = {(r.point, r.coordinate) for r in online.refused if r.reason == CONTRADICTS}
    back = {(r.point, r.coordinate) for r in online.refused if r.reason == TAKEN_BACK and r.coordinate}
    assert len(refused - back) <= 1
    assert orientation_errors(simulation, online.whole).nees.mean() < 2.0
    assert orientation_errors(simulation, online.final).nees.mean() < 6.0


def test_control_that_is_wrong_is_not_blamed_on_the_tie_points(flight):
    simulation, poses = flight
    control = np.flatnonzero(simulation.points.role == "control")
    along = simulation.points.xyz_l[control] @ np.diff(simulation.flight.truth.at([5.0, 55.0]).position_l, axis=0)[0]
    wrong = control[np.argsort(along)[3]]
    surveyed = simulation.surveyed_l.copy()
    surveyed[wrong, 2] -= 8.0
    spoilt = replace(simulation, surveyed_l=surveyed)
    online = adjust_online(spoilt, poses, WindowOptions(grid_hz=4.0), live=False, update_s=1.0)
    assert not any(r.quality.sources or "tie points" in r.quality.reason for r in online.reports if r.control)
    refused = {(r.point, r.coordinate) for r in online.refused if r.reason == CONTRADICTS}
    assert refused == {(str(simulation.points.id[wrong]), "Z")}
