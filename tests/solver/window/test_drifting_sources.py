"""Sources of tie points that drift: which hypotheses can be told apart, who is named, what the orientation is then."""

from __future__ import annotations

import zlib
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from triline.solver.adjustment.drift_hypotheses import ALL, EACH, Hypothesis, Scores, Suspicion, hypotheses
from triline.solver.adjustment.eliminated_points import eliminated
from triline.solver.adjustment.in_parts import in_one_go
from triline.solver.camera.line_camera import finest_pixel
from triline.solver.camera.self_calibration import tls
from triline.solver.simulation.camera_errors import simulate_with_camera_errors
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, Simulation, simulate
from triline.solver.simulation.window_study import (
    adjust_at_once,
    adjust_online,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.block import archive
from triline.solver.window.block.backward import LeftPoints
from triline.solver.window.datum.control import ControlTests
from triline.solver.window.datum.drift_monitor import DRIFT_S, DriftMonitor
from triline.solver.window.datum.drifts import Compensation, Named, estimated, of_block
from triline.solver.window.results import AdjustedPoint, Look, WindowOptions
from triline.solver.window.screening.sigma_check import SigmaCheck
from triline.solver.window.state.maker import BatchMaker
from triline.solver.window.state.unknowns import Border
from triline.solver.window.window import Window

PLAN = FlightPlan(strip_s=50.0, lead_in_s=3.0, lead_out_s=2.0)
SENSORS = ErrorModel(attitude_rate_hz=100.0)
TIES = ObservationPlan(tie_points_per_s=8.0, check=10)


@pytest.fixture(scope="module")
def flight():
    simulation = simulate(PLAN, 0, SENSORS, TIES)
    return simulation, navigate(simulation)


def _shifted(simulation: Simulation, shift, ccd: str = ALL, points=None) -> Simulation:
    """Lines and samples shifted by a function of time (..., 2), px, on a CCD line, at some points."""
    images, looks = simulation.images, simulation.images.looks
    ids = np.array([line.id for line in simulation.flight.camera.lines])
    mine = np.ones(len(looks), dtype=bool) if ccd == ALL else ids[looks.ccd] == ccd
    if points is not None:
        mine &= points[looks.point]
    line, sample = np.where(mine, shift(looks.time_s).T, 0.0)
    return replace(simulation, images=replace(images, line=images.line + line, sample=images.sample + sample))


def _drifting(line: float, sample: float, from_s: float = 5.0):
    return lambda t: np.multiply.outer(np.maximum(t - from_s, 0.0), [line, sample])


def _fly(simulation: Simulation, poses):
    """Result, and alarms as (time, sources)."""
    result = adjust_online(simulation, poses, live=False, update_s=1.0)
    reports = [r.quality for r in result.reports]
    return result, [(w.time_s, w.sources) for w in reports if w.sources]


@pytest.fixture(scope="module")
def drifted(flight):
    """The flight with a drift of a CCD line, as `_fly` has it; each is flown once."""
    simulation, poses = flight
    return cache(lambda ccd, line, sample: _fly(_shifted(simulation, _drifting(line, sample), ccd), poses))


# ---- one source


def test_the_test_value_is_what_the_adjustment_gains_by_the_drift(flight):
    """The border against a second way: the adjustment of images from which the estimated drift has been taken."""
    simulation, poses = flight
    spoilt = _shifted(simulation, _drifting(0.0, 0.02), "N")
    options = WindowOptions(snoop=False)

    def cost(images: Simulation) -> float:
        window = adjust_at_once(images, poses, options, until_s=45.0).window
        assert window is not None
        return window.state.cost()

    window = adjust_at_once(spoilt, poses, options, until_s=45.0).window
    assert window is not None
    monitor, batches = DriftMonitor(window.network), list(window.network.batches)
    monitor._strip = 0
    for batch in batches:
        monitor._take([batch])
    cells = monitor._in_border(batches)
    border, found, _ = monitor._assembled(45.0, cells)
    scores = monitor._scores(45.0, batches, cells, border)
    before, values = window.state.cost(), {}
    for h in found:
        own = EACH * h.members[0] + np.arange(EACH)
        if h.name[1] == ALL:
            continue
        b = np.linalg.solve(scores.V[np.ix_(own, own)], scores.score[own])
        corrected = _shifted(spoilt, lambda t, b=b: -b[:2] - np.multiply.outer(t / DRIFT_S, b[2:]), h.name[1])
        values[h.name[1]] = scores.test(h)
        assert before - cost(corrected) == pytest.approx(values[h.name[1]], rel=0.04)
    # the three are almost parallel, so that noise decides which is the largest
    assert min(values.values()) > 30.0 and max(values.values()) < 1.2 * min(values.values())


def test_a_vibration_makes_a_drift_less_sure(flight):
    """What looks have in step may be a drift: the limit grows with the share of the noise that is a vibration."""
    simulation, poses = flight
    window = adjust_at_once(simulation, poses, WindowOptions(snoop=False), until_s=20.0).window
    assert window is not None
    network = window.network

    def factor(vibration: float) -> float:
        network.pose_noise.vibration = vibration
        batches, monitor = list(network.batches), DriftMonitor(network)
        BatchMaker(network).refresh(batches)
        for batch in batches:
            network.batches.linearise(batch, network.state.values(batch.columns), reweigh=True)
        monitor._strip = 0
        monitor._take(batches)
        return monitor._assembled(20.0, monitor._in_border(batches))[2]

    pixel = finest_pixel(network.camera)
    without = factor(0.0)
    for pixels in (0.5, 1.5):
        share = pixels**2 / (pixels**2 + 0.3**2)
        assert factor(pixels * pixel) - without == pytest.approx((16.0 / 6.0 - 1.0) * share, rel=0.12)


def test_points_are_what_they_are_without_the_drift(flight):
    """Against a second way: the adjustment of images from which the drift has been taken."""
    simulation, poses = flight
    spoilt = _shifted(simulation, _drifting(0.0, 0.03), "N")
    options = WindowOptions(snoop=False)
    window = adjust_at_once(spoilt, poses, options, until_s=45.0).window
    assert window is not None
    batches = list(window.network.batches)
    monitor = window._sources
    monitor.begin()
    assert monitor.unknowns(45.0) is not None
    (group,) = [i for (_, ccd), i in monitor._groups.items() if ccd == "N"]
    rows, drift = EACH * group + np.arange(EACH), np.array([0.3, -0.2, 0.1, 0.25])
    monitor._drift = rows, drift, 0.04 * np.eye(EACH)
    compensation = monitor.compensation()
    assert compensation is not None
    start_s = monitor._start_s
    corrected = _shifted(spoilt, lambda t: -drift[:2] - np.multiply.outer((t - start_s) / DRIFT_S, drift[2:]), "N")
    again = adjust_at_once(corrected, poses, options, until_s=45.0).window
    assert again is not None
    known = {name: xyz for b in again.network.batches for name, xyz in zip(b.names, b.points_l, strict=True)}
    changes, wrong = [], []
    for batch in batches:
        change, covariance = monitor.on_points(batch, compensation)
        A = np.array([np.linalg.eigvalsh(c)[-1] for c in covariance])
        assert (A > 0).all()
        for i, name in enumerate(batch.names):
            if batch.normals.rank[i] == 3:
                changes.append(np.linalg.norm(known[name] - batch.points_l[i]))
                wrong.append(np.linalg.norm(batch.points_l[i] + change[i] - known[name]))
    assert np.median(changes) > 0.1
    assert np.median(wrong) < 0.02 * np.median(changes) and max(wrong) < 0.15 * max(changes)


@pytest.mark.parametrize(
    ("ccd", "line", "sample", "seen"),
    [
        ("N", 0, 0.05, True),
        ("B", 0.12, 0, True),
        *(
            pytest.param(*case, marks=pytest.mark.study)
            for case in (("F", 0, 0.05, True), ("B", 0, 0.05, True), ("F", 0.06, 0, False), ("N", 0.08, 0, True))
        ),
    ],
)
def test_of_one_source_the_line_that_drifts_is_always_among_those_named(drifted, ccd, line, sample, seen):
    _, alarms = drifted(ccd, line, sample)
    assert bool(alarms) or not seen
    for _, sources in alarms:
        assert ("", ccd) in sources[0].suspects and len(sources) == 1
    leaders = [sources[0].suspects[0] for _, sources in alarms]
    assert sum(a != b for a, b in pairwise(leaders)) <= 1
    if sample:  # geometry: they cannot be told apart
        assert all(len(sources[0].suspects) > 1 for _, sources in alarms)
        assert "cannot be told apart" in str(alarms[-1][1][0])


def test_the_orientation_and_its_covariance_are_without_a_drift_that_is_named(flight, drifted):
    simulation, _ = flight
    result, alarms = drifted("N", 0, 0.05)
    later = [o for o, known in zip(result.final, result.final_known_s, strict=True) if known > alarms[0][0] + 1.0]
    for orientations in (later, result.whole):
        errors = orientation_errors(simulation, orientations)
        assert errors.nees.mean() < 3.0  # some hundreds if it stays
        assert errors.rmse[1] < 1.0
    for points in (result.final_points, result.whole_points):
        assert point_errors(simulation, points).nees.mean() < 5.0  # likewise


@pytest.mark.study
@pytest.mark.parametrize(("strip", "ccd", "bounded"), [(0, "F", False), (1, "N", False), (0, "N", True)])
def test_in_a_block_neither_strip_is_bent_by_a_drift_that_is_named(strip, ccd, bounded, monkeypatch):
    """Points that tie strips carry the drift of their looks in one of them, also of one that is refined no more."""
    if bounded:
        monkeypatch.setattr(archive, "BLOCK_UNKNOWNS", 200)
    plan = FlightPlan(strips=2, strip_s=50.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0)
    simulation = simulate(plan, 1, SENSORS, ObservationPlan(tie_points_per_s=6.0, control=6, check=10))
    begin_s, end_s = simulation.flight.covered_s[strip]
    spoilt = _shifted(
        simulation,
        lambda t: np.multiply.outer(((t > begin_s) & (t < end_s)) * (0.5 + 0.03 * (t - begin_s)), [0, 1]),
        ccd,
    )
    result, alarms = _fly(spoilt, navigate(simulation))
    assert alarms and all(("", ccd) in sources[0].suspects for _, sources in alarms)
    for id in ("S1", "S2"):
        whole = {float(o.time_s[0]): o for o in result.whole if o.strip == id}
        assert orientation_errors(simulation, list(whole.values())).nees.mean() < 2.5  # some tens if it stays
    assert any("refined no more" in text for text in result.events) == bounded
    tied = {name: p for name, p in result.whole_points.items() if p.rays > 3}
    assert len(tied) > 50 and point_errors(simulation, tied).nees.mean() < 2.0


@pytest.mark.study
def test_the_camera_is_without_what_drifted_in_the_strip_before():
    plan = FlightPlan(strips=3, strip_s=50.0, sidelap=0.4, turns=False, gap_s=6.0, lead_in_s=3.0, lead_out_s=2.0)
    camera = tls(plan.camera, 12).scaled(0.03)
    ties = ObservationPlan(tie_points_per_s=8.0, control=9, check=20)
    simulation = simulate_with_camera_errors(plan, 1, camera, SENSORS, ties)
    begin_s, end_s = simulation.flight.covered_s[1]

    def shift(t):
        return np.multiply.outer(((t > begin_s) & (t < end_s)) * 0.03 * (t - begin_s), [0.0, 1.0])

    spoilt = _shifted(simulation, shift, "N")
    result = adjust_online(spoilt, navigate(simulation), self_calibration=camera, live=False, update_s=1.0)
    # over a few redundant observations sigma0 says nothing
    found = np.array([r.sigma0 for r in result.reports if r.strip == "S3" and r.redundancy > 5])
    assert len(found) > 25 and found.min() > 0.6 and found.max() < 1.5
    later = [o for o in result.final if o.strip == "S3"]
    assert orientation_errors(simulation, later).nees.mean() < 2.5  # eight if the camera keeps it


# ---- several sources


def _with_sources(monkeypatch, simulation: Simulation):
    """Looks come from two publishers, by the name of the point; which points (p,) the second has."""
    add_look = Window.add_look

    def add(self, name, look: Look):
        return add_look(self, name, replace(look, source=f"matcher-{1 + zlib.crc32(name.encode()) % 2}"))

    monkeypatch.setattr(Window, "add_look", add)
    return np.array([zlib.crc32(str(id).encode()) % 2 == 1 for id in simulation.points.id])


def test_a_source_that_drifts_as_a_whole_is_named_and_the_good_one_never_alone(flight, monkeypatch):
    simulation, poses = flight
    second = _with_sources(monkeypatch, simulation)
    result, alarms = _fly(_shifted(simulation, _drifting(0.0, 0.05), ALL, second), poses)
    assert alarms
    for _, sources in alarms:
        assert ("matcher-2", ALL) in sources[0].suspects
    assert orientation_errors(simulation, result.whole).nees.mean() < 3.0


def test_no_drift_is_named_where_a_larger_wander_is_the_better_explanation(flight, drifted, monkeypatch):
    """In one of twenty flights whose attitude wandered twice as far as stated a healthy line was named for ten seconds.

    What speaks for a wander is asked for where a test has failed, and is less than what speaks for a real drift.
    """
    simulation, poses = flight
    assert drifted("N", 0, 0.05)[1]
    monkeypatch.setattr(SigmaCheck, "gain_of_wanders", lambda *_: 1e4)
    assert not _fly(_shifted(simulation, _drifting(0.0, 0.05), "N"), poses)[1]


def test_no_drift_of_all_lines_is_named_where_control_and_gnss_differ(flight, monkeypatch):
    """All tie points contradict one of them then. With control 1.5 m off they were named as drifting for a while."""
    monkeypatch.setattr(ControlTests, "differs_from_gnss", property(lambda _: True))
    simulation, poses = flight
    second = _with_sources(monkeypatch, simulation)
    _, alarms = _fly(_shifted(simulation, _drifting(0.0, 0.05), ALL, second), poses)
    assert not any(source.ccd == ALL for _, sources in alarms for source in sources)


@pytest.mark.study
def test_one_line_of_one_of_two_sources_is_named_alone_and_the_other_source_holds_the_orientation(flight, monkeypatch):
    simulation, poses = flight
    second = _with_sources(monkeypatch, simulation)
    result, alarms = _fly(_shifted(simulation, _drifting(0.0, 0.05), "F", second), poses)
    assert alarms[-1][1][0].suspects == (("matcher-2", "F"),)
    clean = adjust_online(simulation, poses, live=False, update_s=1.0)
    with_, without = (orientation_errors(simulation, r.whole).rmse for r in (result, clean))
    assert np.linalg.norm(with_[:3]) < 1.3 * np.linalg.norm(without[:3])


# ---- clean flights


@pytest.mark.parametrize(("seed", "rate"), [pytest.param(6, 300.0, marks=pytest.mark.study), (1, 8.0)])
def test_a_clean_flight_gives_no_alarm(seed, rate):
    plan, ties = replace(PLAN, strip_s=30.0), ObservationPlan(tie_points_per_s=rate, check=10)
    simulation = simulate(plan, seed, SENSORS, ties)
    assert not _fly(simulation, navigate(simulation))[1]


# ---- hypotheses


def _scores(effect: dict[int, float], mixing: np.ndarray) -> Scores:
    """Of groups whose unknowns have effects on residuals (r, m); those of some groups are biased in their samples."""
    m = mixing.shape[1]
    V = np.kron(mixing.T @ mixing, np.eye(EACH))
    b = np.zeros(EACH * m)
    for group, size in effect.items():
        b[EACH * group + 1] = size
    return Scores(V @ b, V, 1.0, DRIFT_S)


GROUPS = [("a", "F"), ("a", "N"), ("b", "F"), ("b", "N")]
OF = hypotheses(GROUPS, [50] * 4)
APART = 30.0 * np.eye(4)


def test_hypotheses_are_groups_wholes_and_lines():
    names = {h.name: h.members for h in OF}
    assert set(names) == {*GROUPS, ("a", ALL), ("b", ALL), (ALL, "F"), (ALL, "N"), (ALL, ALL)}
    assert names["b", ALL] == (2, 3) and names[ALL, "N"] == (1, 3)
    assert [h.name for h in hypotheses([("", "F"), ("", "N")], [50, 3])] == [("", "F")]


def test_what_can_be_told_apart_is_named_alone_and_two_both():
    def named(scores: Scores):
        suspicion, found = Suspicion(), ()
        for k in range(8):
            found = suspicion.judge(float(k), scores, OF)
        return [s.suspects for s in found]

    assert named(_scores({2: 0.5}, APART)) == [(("b", "F"),)]
    assert named(_scores({1: 0.5, 3: 0.5}, APART)) == [((ALL, "N"),)]
    assert named(_scores({1: 0.8, 2: -0.5}, APART)) == [(("a", "N"),), (("b", "F"),)]
    assert named(_scores({}, APART)) == []
    alike = 30.0 * np.array([[1.0, -0.99, 0, 0], [0, 0.14, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    assert named(_scores({1: 0.5}, alike)) == [(("a", "N"), ("a", "F"))]


def test_who_is_named_stays_so_until_another_is_decisively_better():
    suspicion, single = Suspicion(), [Hypothesis(g, (i,)) for i, g in enumerate(GROUPS)]

    def told(now_s, **sizes):
        effect = {"FNfn".index(k): v for k, v in sizes.items()}
        found = suspicion.judge(now_s, _scores(effect, APART), single)
        return [s.suspects[0] for s in found]

    assert not told(0.0, F=0.4) and not told(1.0, F=0.4)  # one bad test is not enough
    assert told(2.0, F=0.4) == [GROUPS[0]]
    assert told(3.0, F=0.4, N=0.41)[0] == GROUPS[0]  # about as good
    assert told(4.0, F=0.2, N=0.6)[0] == GROUPS[1]
    assert told(5.0, N=0.14)[0] == GROUPS[1]  # below the limit, not cleared
    assert not told(6.0, N=0.01) and not told(7.0, N=0.6)


def test_a_drift_is_named_anew_only_where_it_is_better_than_what_else_may_be_wrong():
    suspicion, scores = Suspicion(), _scores({0: 0.4}, APART)
    test, limit = scores.test(OF[0]), Suspicion().limit()

    def named(now_s, instead):
        return bool(suspicion.judge(now_s, scores, OF[:1], 1.0, instead))

    assert test > limit + 5.0
    assert not any(named(k, test - limit + 0.1) for k in range(8))
    assert [named(8 + k, test - limit - 0.1) for k in range(3)] == [False, False, True]
    assert named(12, 100.0)  # it stays named


# ---- what it does


def test_compensation_is_the_solution_with_the_drift_as_unknowns():
    rng = np.random.default_rng(2)
    A, B, e = rng.standard_normal((30, 6)), rng.standard_normal((30, 3)), rng.standard_normal(30)
    sigma = np.array([1.0, 0.5, 2.0])
    N, prior = A.T @ A, np.diag(sigma**-2.0)
    joint = np.linalg.inv(np.block([[N, A.T @ B], [B.T @ A, B.T @ B + prior]]))
    expected = joint @ np.concatenate([A.T @ e, B.T @ e])
    Q = np.linalg.inv(N)
    border = Border(np.arange(6), A.T @ B, B.T @ B, B.T @ e)
    through, theta = Q @ border.G, Q @ A.T @ e
    V = border.H - border.G.T @ through
    found = Compensation(through, *estimated(border.r - border.G.T @ theta, V, sigma))
    change, covariance = found.change(np.eye(6), np.arange(6))
    assert found.drift == pytest.approx(expected[6:]) and found.covariance == pytest.approx(joint[6:, 6:])
    assert Q @ A.T @ e + change == pytest.approx(expected[:6])
    assert Q + covariance == pytest.approx(joint[:6, :6])
    # without any information, rounding included, it is what was known beforehand
    assert estimated(np.zeros(3), -1e-12 * np.eye(3), sigma)[1] == pytest.approx(np.diag(sigma**2))


def test_a_point_without_the_drift_is_that_of_a_solution_with_the_drift_as_unknowns():
    rng = np.random.default_rng(4)
    A, J, B, values = rng.normal(size=(14, 4)), rng.normal(size=(14, 3)), rng.normal(size=(14, 3)), rng.normal(size=14)
    design = np.hstack([A, J, B])
    N = design.T @ design + np.diag([1.0] * 4 + [0.0] * 3 + [4.0] * 3)
    moment = design.T @ values
    together, covariance = np.linalg.solve(N, moment), np.linalg.inv(N)

    columns = np.concatenate([np.arange(4), of_block(0, np.arange(3))])
    published = AdjustedPoint("P", "tie", np.zeros(3), np.eye(3), 2, True, ())
    rows = columns, np.hstack([A, B]), J, values
    functions, *told, _ = eliminated([rows], np.zeros((3, 3)), np.zeros(3), np.zeros(3))
    block = archive.Archive(np.arange(4), np.ones(4))
    block.strips["S1"] = archive.KeptStrip(0, np.empty(0, dtype=np.int64))
    block.add(functions.columns, *told)
    named = [Named(0, np.arange(3), np.full(3, 0.5))]
    solution = in_one_go(block.solving(named))
    order = [0, 1, 2, 3, 7, 8, 9]
    got = solution.of(columns)
    assert got[0] == pytest.approx(together[order]) and got[1] == pytest.approx(covariance[np.ix_(order, order)])
    (point,) = LeftPoints(functions, (published,)).refined(solution)
    assert point.xyz_l == pytest.approx(together[4:7])
    assert point.covariance == pytest.approx(covariance[4:7, 4:7])
    values, Q = in_one_go(block.solving()).of(columns)  # where it is not named, it is zero and certain
    assert values[:4] == pytest.approx(np.linalg.solve(N[:7, :7], moment[:7])[:4])
    assert not values[4:].any() and not Q[4:].any() and not Q[:, 4:].any()
    in_one_go(block.closing(["S1"], named))
    rest = in_one_go(block.solving()).of(columns)
    assert rest[0][:4] == pytest.approx(together[:4]) and rest[1][:4, :4] == pytest.approx(covariance[:4, :4])
