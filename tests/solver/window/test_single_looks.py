"""Looks that find no partner in their strip: refused, kept for the block, and used when it sees their points."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from noisy_surface import surface_below
from three_strips import OPTIONS, PLAN, SENSORS, SIDE_BY_SIDE, TIES, flown, usual, usual_at_once, usual_online

from triline.solver.camera.line_camera import LineCamera
from triline.solver.camera.self_calibration import left_by_calibration
from triline.solver.simulation import window_study
from triline.solver.simulation.scenario import ObservationPlan, simulate
from triline.solver.simulation.window_study import adjust_at_once, adjust_online, navigate, orientation_errors
from triline.solver.window import leaving
from triline.solver.window.block import archive, points
from triline.solver.window.block.points import SingleLook
from triline.solver.window.results import TAKEN_BACK
from triline.solver.window.screening import first_ground
from triline.solver.window.state.maker import BatchMaker

ALONE = "too few looks"


def nadir_alone():
    """The camera of the flight with the CCD line that looks down, and no other."""
    nadir = PLAN.camera.nadir_line
    return LineCamera("one", tuple(lens for lens in PLAN.camera.lenses if lens.id == nadir.lens), (nadir,))


@pytest.fixture(scope="module")
def flight():
    return usual()


@pytest.fixture(scope="module")
def online():
    return usual_online()


@pytest.fixture(scope="module")
def side_by_side():
    """Two shorter strips, and what the window makes of them."""
    flight = flown(SIDE_BY_SIDE)
    return flight, adjust_online(*flight, OPTIONS, live=False, update_s=1.0)


def looks_of(result, reason):
    return [(r.point, r.look) for r in result.refused if r.reason == reason]


def test_a_single_look_counts_when_another_strip_sees_its_point(online):
    alone, back = looks_of(online, ALONE), looks_of(online, TAKEN_BACK)
    assert len(back) == len(set(back)) >= 8
    assert set(back) <= set(alone)
    batch = usual_at_once()
    for name, look in back:
        whole, wanted = online.whole_points[name], batch.final_points[name]
        assert look in [r.look for r in whole.residuals]
        assert {r.look for r in whole.residuals} == {r.look for r in wanted.residuals}
        sigma = np.sqrt(np.diag(wanted.covariance))
        assert np.abs((whole.xyz_l - wanted.xyz_l) / sigma).max() < 0.1
        assert np.sqrt(np.diag(whole.covariance)) == pytest.approx(sigma, rel=0.02)


def test_points_of_single_looks_lie_where_the_looks_meet(monkeypatch):
    """Nadir looks alone, which are first thought to meet the ground 100 m too high; the camera has parameters, so rays
    are fitted to their points, and the attitude changes fast between the two places."""
    simulation, poses = unsteady = flown(replace(PLAN, strips=1, strip_s=16.0, stabilised=False))
    nadir = simulation.images.looks.ccd == simulation.flight.camera.line_index["N"]
    unsteady = replace(simulation, images=simulation.images.select(nadir)), poses
    make, open_ = BatchMaker.make_single, left_by_calibration(simulation.flight.camera)
    monkeypatch.setattr(BatchMaker, "make_single", lambda *a: make(*a[:-1], a[-1] + [0.0, 0.0, 100.0]))
    online = adjust_online(*unsteady, replace(OPTIONS, snoop=True), open_, live=False, update_s=1.0)
    batch = adjust_at_once(*unsteady, OPTIONS, open_)
    assert not any("do not agree" in text for text in online.events)
    met = [name for name, point in online.whole_points.items() if point.rays == 2]
    assert len(met) > 15
    for name in met:
        whole, wanted = online.whole_points[name], batch.final_points[name]
        sigma = np.sqrt(np.diag(wanted.covariance))
        assert np.abs((whole.xyz_l - wanted.xyz_l) / sigma).max() < 0.1


def test_a_camera_with_one_ccd_line_has_a_window_of_its_own_and_loses_no_ties():
    """The window was as long as the strip, so that updates took longer and longer. Here the only control lies at the
    beginning of the first strip: when looks that wait for the next strip leave the window, no point in it tells the
    height of the ground any more."""
    plan = replace(PLAN, camera=nadir_alone(), cross_strips=0, strip_s=50.0, sidelap=0.6)
    simulation, poses = flown(plan, replace(TIES, control=30))
    looks, roles = simulation.images.looks, np.array(simulation.points.role)
    since_s = looks.time_s - simulation.flight.strip_times_s[looks.strip, 0]
    early = np.unique(looks.point[(looks.strip == 0) & (since_s < 20.0)])
    begin = simulation.images.select((roles[looks.point] != "control") | np.isin(looks.point, early))
    result = adjust_online(
        replace(simulation, images=begin), poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0
    )
    left_s = [float(o.time_s[-1]) for o in result.final if o.strip == "S1"]
    assert left_s[0] < 25.0 and len(left_s) > 5 and left_s[-2] < 45.0
    ties = [p for name, p in result.whole_points.items() if p.rays == 2]
    assert len(ties) > 0.95 * (roles == "tie").sum()
    place = dict(zip(simulation.points.id, simulation.points.xyz_l, strict=True))
    off = np.array([p.xyz_l - place[p.name] for p in ties])
    C = np.array([p.covariance for p in ties])
    assert 0.4 < np.einsum("ni,ni->n", off, np.linalg.solve(C, off[:, :, None])[:, :, 0]).mean() / 3.0 < 1.6


def test_one_ccd_line_without_control_ties_its_strips(monkeypatch):
    """Nobody says where the ground is, 700 m nearer than looks are linearised at first: none of them tied anything."""
    monkeypatch.setattr(leaving, "NOBODY_KNOWS_M", 2200.0)
    simulation, poses = flown(replace(PLAN, camera=nadir_alone(), strip_s=16.0), replace(TIES, control=0))
    online = adjust_online(simulation, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    batch = adjust_at_once(simulation, poses, OPTIONS)
    ties = {name: p for name, p in batch.final_points.items() if p.rays > 1}
    met = [name for name in ties if name in online.whole_points]
    assert len(met) > 0.95 * len(ties) > 50
    for name in met:
        sigma = np.sqrt(np.diag(ties[name].covariance))
        assert np.abs((online.whole_points[name].xyz_l - ties[name].xyz_l) / sigma).max() < 0.3
        assert np.sqrt(np.diag(online.whole_points[name].covariance)) == pytest.approx(sigma, rel=0.1)
    # the strips are final as they are flown, not when they are over
    assert max(known - o.time_s[-1] for known, o in zip(online.final_known_s, online.final, strict=True)) < 25.0


def test_the_window_waits_for_looks_where_few_lines_a_second_come(monkeypatch):
    """4 lines/s: a matcher has 100 lines around the first places of the second strip after 25 s. The window waited for
    20 s at most, in every strip, so that these looks were too late."""
    nadir = PLAN.camera.nadir_line
    slow = LineCamera("slow", nadir_alone().lenses, (replace(nadir, xy_mm=nadir.xy_mm[50::100], chips=()),))
    plan = replace(SIDE_BY_SIDE, camera=slow, strip_s=32.0)
    ties = replace(TIES, tie_points_per_s=2.0, matching_delay_s=25.0, image_sigma_px=0.02)
    simulation = simulate(plan, 11, replace(SENSORS, attitude_rate_hz=20.0), ties)
    assert 3.0 < simulation.flight.strips[0].line_rate_hz < 6.0
    begun_s, events = simulation.flight.strips[1].first_line_time_s, window_study._events

    def told(*args):  # places of the first strip are told at once, as they are chosen
        early = ((t, o, what) if o != 2 or t - 25.0 >= begun_s else (t - 25.0, o, what) for t, o, what in events(*args))
        return sorted(early, key=lambda event: event[:2])

    monkeypatch.setattr(window_study, "_events", told)
    result = adjust_online(simulation, navigate(simulation), replace(OPTIONS, snoop=True), live=False, update_s=2.0)
    seen = simulation.images.looks
    of_both = set(seen.point[seen.strip == 0]) & set(seen.point[seen.strip == 1])
    met = [p for p in result.whole_points.values() if p.rays > 1]
    assert not looks_of(result, "too late") and len(met) > 0.95 * len(of_both) > 25


def test_an_elevation_model_says_where_the_ground_is(monkeypatch):
    """Before any rays meet: looks at a camera's first strip are linearised on it, and tie the next one."""
    monkeypatch.setattr(first_ground, "LEAST_MEETING", 10**6)
    simulation, poses = flown(replace(SIDE_BY_SIDE, camera=nadir_alone()), replace(TIES, control=0))
    surface = surface_below(simulation, 3)
    online = adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0, surface=surface)
    batch = adjust_at_once(simulation, poses, OPTIONS, surface=surface)
    ties = [name for name, p in batch.final_points.items() if p.rays > 1]
    met = [name for name in ties if name in online.whole_points and online.whole_points[name].rays > 1]
    assert len(met) > 0.95 * len(ties) > 15
    for name in met:
        wanted, whole = batch.final_points[name], online.whole_points[name]
        assert np.abs((whole.xyz_l - wanted.xyz_l) / np.sqrt(np.diag(wanted.covariance))).max() < 0.3


@pytest.mark.study
@pytest.mark.parametrize("world", ["as stated", "relief of 250 m", "blunders", "no stabilised mount", "500 m above"])
def test_how_well_strips_of_one_ccd_line_are_tied_without_control(world):
    """Three strips and one across them, four seeds: NEES of whole points, and their errors beside the batch."""
    plan = replace(PLAN, camera=nadir_alone(), strips=3, strip_s=40.0, gap_s=60.0)
    ties = ObservationPlan(
        tie_points_per_s=6.0, control=0, check=12, outlier_share=0.03 if world == "blunders" else 0.0
    )
    plan = {
        "relief of 250 m": replace(plan, relief_m=250.0),
        "no stabilised mount": replace(plan, stabilised=False),
        "500 m above": replace(plan, height_m=500.0, relief_m=50.0, speed_m_s=50.0),
    }.get(world, plan)
    nees, squares = [], []
    for seed in range(1, 5):
        simulation = simulate(plan, seed, SENSORS, ties)
        poses = navigate(simulation)
        online = adjust_online(simulation, poses, replace(OPTIONS, snoop=True), live=False, update_s=0.5).whole_points
        batch = adjust_at_once(simulation, poses, replace(OPTIONS, snoop=True)).final_points
        place = dict(zip(simulation.points.id, simulation.points.xyz_l, strict=True))
        both = [name for name in batch if batch[name].rays > 1 and name in online]
        assert len(both) > 0.9 * sum(p.rays > 1 for p in batch.values())
        off = [np.array([points[name].xyz_l - place[name] for name in both]) for points in (online, batch)]
        C = np.array([online[name].covariance for name in both])
        nees.append(np.einsum("ni,nij,nj->n", off[0], np.linalg.inv(C), off[0]).mean() / 3.0)
        squares.append([np.sum(v**2, axis=1).mean() for v in off])
    ratio = np.sqrt(np.divide(*np.mean(squares, axis=0)))
    print(f"{world}: NEES {np.mean(nees):.2f}, RMSE {ratio:.3f} times that of the batch")
    assert 0.6 < np.mean(nees) < 1.6 and ratio < 1.1


def test_strips_of_one_ccd_line_without_any_look_are_final(monkeypatch):
    """Their looks are waited for, not longer than 30 s after the strip, with no more of it than is bearable, and at the
    end of the flight no longer."""
    monkeypatch.setattr(leaving, "AWAITED_S", 4.0)
    monkeypatch.setattr(leaving, "MOST_AWAITED_S", 10.0)
    simulation, poses = flown(replace(SIDE_BY_SIDE, camera=nadir_alone()), replace(TIES, control=0))
    none = replace(simulation, images=simulation.images.select(np.zeros(len(simulation.images.looks), dtype=bool)))
    online = adjust_online(none, poses, OPTIONS, live=False, update_s=0.5)
    for k, (begin, end) in enumerate(simulation.flight.strip_times_s):
        mine = [i for i, o in enumerate(online.final) if o.strip == simulation.flight.strips[k].id]
        time_s = np.concatenate([online.final[i].time_s for i in mine])
        assert time_s.min() < begin + 0.5 and time_s.max() > end - 0.5
        late_s = [online.final_known_s[i] - online.final[i].time_s[0] for i in mine]
        assert max(late_s) < 22.0
        assert k > 0 or min(late_s) > 3.0


def test_rays_say_how_high_they_meet():
    to = np.array([[100.0, 50.0, 20.0], [0.0, 0.0, -30.0], [0.0, 0.0, 0.0], [10.0, 0.0, 500.0]])
    a, b = np.array([[0.0, 0.0, 1000.0]] * 4), np.array([[400.0, 100.0, 1100.0]] * 4)
    b[2] = [0.0, 10.0, 1000.0]  # nearly parallel
    rays = np.stack([to - a, 3.0 * (to - b)])
    rays[0, 3] *= -1.0  # behind the camera
    height = first_ground.meeting_heights(np.stack([a, b]), rays)
    assert height[:2] == pytest.approx([20.0, -30.0]) and np.isnan(height[2:]).all()


@pytest.mark.parametrize("later", [False, True])
def test_a_look_along_the_ground_is_left_out_and_nothing_else(side_by_side, monkeypatch, later):
    """Its line and sample tell the same: there is no place for its point, at once or when another strip sees it."""
    flight, online = side_by_side
    spoilt = {name for name, _ in looks_of(online, TAKEN_BACK)[:3]}
    rows_of, seen = points.rows_of, set()

    def level(batch, i, cell):
        rows, origin = rows_of(batch, i, cell)
        name = batch.names[i]
        if name in spoilt and len(rows[2]) == 2 and (name in seen or not later):
            rows = (*rows[:2], np.stack([rows[2][0], 2.0 * rows[2][0]]), *rows[3:])
        seen.add(name)
        return rows, origin

    monkeypatch.setattr(points, "rows_of", level)
    flown_on = adjust_online(*flight, OPTIONS, live=False, update_s=1.0)
    back = {name for name, _ in looks_of(flown_on, TAKEN_BACK)}
    assert back == {name for name, _ in looks_of(online, TAKEN_BACK)} - spoilt and len(spoilt) == 3
    for one, other in zip(flown_on.whole, online.whole, strict=True):
        sigma = np.sqrt(np.einsum("nii->ni", other.covariance))
        assert np.abs((one.correction - other.correction) / sigma).max() < 1.0
        assert np.isfinite(one.covariance).all()


@pytest.mark.study
def test_how_far_away_its_point_is_need_not_be_known_beforehand(flight, online, monkeypatch):
    """Linearised 300 m from it, and not anew where it is found, looks would tell positions from attitudes."""
    make = BatchMaker.make_single
    monkeypatch.setattr(BatchMaker, "make_single", lambda *a: make(*a[:-1], a[-1] + [0.0, 0.0, 300.0]))
    far = adjust_online(*flight, OPTIONS, live=False, update_s=0.5)
    assert looks_of(far, TAKEN_BACK) == looks_of(online, TAKEN_BACK)
    for one, other in zip(far.whole, online.whole, strict=True):
        sigma = np.sqrt(np.einsum("nii->ni", other.covariance))
        assert np.abs((one.correction - other.correction) / sigma).max() < 0.02
        assert np.sqrt(np.einsum("nii->ni", one.covariance)) == pytest.approx(sigma, rel=0.01)


def with_a_wrong_look(flight, wrong):
    """The flight, a look at which is measured 60 samples aside, with data snooping."""
    simulation, poses = flight
    images = simulation.images
    at = (images.line == wrong.line) & (images.sample == wrong.sample)
    assert at.sum() == 1
    spoilt = replace(simulation, images=replace(images, sample=np.where(at, images.sample + 60.0, images.sample)))
    return adjust_online(spoilt, poses, replace(OPTIONS, snoop=True), live=False, update_s=0.5)


@pytest.mark.study
def test_a_wrong_single_look_is_left_out(flight, online):
    simulation, _ = flight
    name, wrong = next((n, k) for n, k in looks_of(online, TAKEN_BACK) if online.whole_points[n].rays == 4)
    result = with_a_wrong_look(flight, wrong)
    assert name not in [n for n, _ in looks_of(result, TAKEN_BACK)]
    assert any("do not agree with earlier strips" in text and name in text for text in result.events)
    truth = dict(zip(map(str, simulation.points.id), simulation.points.xyz_l, strict=True))
    off = result.whole_points[name].xyz_l - truth[name]
    assert off @ np.linalg.solve(result.whole_points[name].covariance, off) < 20.0


@pytest.mark.study
def test_two_single_looks_that_contradict_each_other_place_no_point(flight, online):
    """Neither can be told to be the wrong one; what was left out is not taken back again and again."""
    name, wrong = next((n, k) for n, k in looks_of(online, TAKEN_BACK) if online.whole_points[n].rays == 5)
    result = with_a_wrong_look(flight, wrong)
    told = [r for r in result.refused if r.point == name]
    assert {(r.look.strip, r.reason) for r in told} == {("S1", ALONE), ("S2", "snooping")}
    assert result.whole_points[name].rays == 3  # those of the last strip


@pytest.mark.study
def test_a_slightly_wrong_single_look_does_not_take_good_ones_with_it(flight, online):
    """It passes at the door; the looks of the next strip are refused for it, come back together, and it goes."""
    simulation, poses = flight
    name, wrong = next((n, k) for n, k in looks_of(online, TAKEN_BACK) if n == "T00264")
    images = simulation.images
    at = (images.line == wrong.line) & (images.sample == wrong.sample)
    spoilt = replace(simulation, images=replace(images, sample=np.where(at, images.sample + 2.2, images.sample)))
    result = adjust_online(spoilt, poses, replace(OPTIONS, snoop=True), live=False, update_s=0.5)
    refused = [r.look for r in result.refused if r.point == name and r.reason == "snooping"]
    assert len(refused) == 3 and {r.look for r in result.refused if r.reason == TAKEN_BACK} >= set(refused)
    assert result.whole_points[name].rays == 3
    assert any("do not agree with earlier strips" in text and name in text for text in result.events)


@pytest.mark.study
def test_single_looks_of_a_strip_flown_again_leave_it_consistent():
    """Every fourth point has one look of the same CCD line in each, 45 m apart."""
    plan = replace(PLAN, strips=3, cross_strips=0, sidelap=0.97)
    simulation, poses = flown(plan, replace(TIES, tie_points_per_s=8.0, control=0, check=0))
    looks, rng = simulation.images.looks, np.random.default_rng(3)
    keep = np.ones(len(looks.point), dtype=bool)
    for point in np.unique(looks.point):
        first, last = (np.flatnonzero((looks.point == point) & (looks.strip == k)) for k in (0, 2))
        both = set(looks.ccd[first]) & set(looks.ccd[last])
        if both and rng.random() < 0.25:
            ccd = min(both)
            keep[looks.point == point] = False
            keep[[first[looks.ccd[first] == ccd][0], last[looks.ccd[last] == ccd][0]]] = True
    simulation = replace(simulation, images=simulation.images.select(keep))
    result = adjust_online(simulation, poses, OPTIONS, live=False, update_s=0.5)
    assert len(looks_of(result, TAKEN_BACK)) > 100
    again = orientation_errors(simulation, [o for o in result.final if o.strip == "S3"])
    assert 0.4 < again.nees.mean() < 1.2  # 1.4 where errors they share count as independent
    assert 0.4 < orientation_errors(simulation, result.whole).nees.mean() < 1.2


def test_a_look_without_ground_near_it_is_given_up(flight):
    """One point, whose looks contradict each other, and a single look at another: it is told, nothing fails."""
    simulation, poses = flight
    images = simulation.images
    of_first = images.looks.strip == 0
    seen = np.bincount(images.looks.point[of_first], minlength=len(simulation.points.id))
    pair, other = np.flatnonzero(seen == 2)[0], np.flatnonzero(seen > 2)[0]
    keep = of_first & (images.looks.point == pair)
    keep[np.flatnonzero(of_first & (images.looks.point == other))[0]] = True
    few = images.select(keep)
    few = replace(few, sample=few.sample + 300.0 * (np.arange(len(few.sample)) == np.argmax(few.looks.point == pair)))
    spoilt = replace(simulation, images=few)
    result = adjust_online(spoilt, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    assert [n for n, _ in looks_of(result, ALONE)] == [str(simulation.points.id[other])]


@pytest.mark.study
def test_control_that_comes_late_places_a_single_look(flight, online):
    """Nobody sees its point again; as in the batch adjustment that knows the control."""
    simulation, poses = flight
    name, look = looks_of(online, TAKEN_BACK)[0]
    i = list(map(str, simulation.points.id)).index(name)
    images = simulation.images
    simulation = replace(simulation, images=images.select((images.looks.point != i) | (images.line == look.line)))
    xyz = simulation.points.xyz_l[i] + 0.01
    begin_s = simulation.flight.strips[1].first_line_time_s

    def watch(now, window):
        if now > begin_s + 10.0 and name not in window.network.intake.control:
            window.add_control(name, xyz, np.full(3, 0.02), "control")

    late = adjust_online(simulation, poses, OPTIONS, live=False, update_s=0.5, watch=watch)
    assert name in late.whole_points and late.whole_points[name].role == "control"
    role = np.where(np.arange(len(simulation.points.id)) == i, "control", simulation.points.role)
    surveyed = simulation.surveyed_l.copy()
    surveyed[i] = xyz
    known = replace(simulation, surveyed_l=surveyed, points=replace(simulation.points, role=role))
    batch = adjust_at_once(known, poses, OPTIONS)
    sigma = np.sqrt(np.diag(batch.final_points[name].covariance))
    assert np.abs((late.whole_points[name].xyz_l - batch.final_points[name].xyz_l) / sigma).max() < 0.1


@pytest.mark.study
def test_what_a_drift_does_to_a_single_look_is_known(flight, monkeypatch):
    """By the difference that a look makes that is measured a pixel aside."""
    made = []
    init = SingleLook.left

    def left(self, place_l=None):
        made.append(self)
        return init(self, place_l)

    monkeypatch.setattr(SingleLook, "left", left)
    adjust_online(*flight, OPTIONS, live=False, update_s=0.5)
    with_cell = [s for s in made if s.cell is not None]
    assert len(with_cell) > 0.8 * len(made)
    for single in with_cell[:5]:
        batch, i = single.batch, single.place
        effect = single.cell.on_rays(range(i, i + 1))
        assert effect.shape == (2, len(single.cell.of_block)) and (single.cell.of_block < 0).all()
        group = int(np.flatnonzero(effect.any(axis=0))[0]) // 4 * 4  # of the unknowns of its group, the first
        before = batch.lin.residual[:, i].copy()
        rays = batch.rays
        batch.rays = replace(rays, xy_mm=rays.xy_mm + rays.pitch_mm)
        batch.linearise(batch.theta, reweigh=False)
        moved = batch.lin.residual[:, i] - before
        batch.rays = rays
        batch.linearise(batch.theta, reweigh=False)
        assert effect[:, group + 1] == pytest.approx(moved, rel=1e-3, abs=1e-3)


def test_looks_are_placed_in_the_same_order_in_each_run():
    """They are linearised together, batch by batch; in the order of a set two runs gave other bytes."""
    block = archive.Archive(np.empty(0, dtype=np.int64), np.empty(0))
    order, names = [], [f"M{i:02d}" for i in range(40)]
    for name in names:
        single = SimpleNamespace(place_above=lambda _, name=name: order.append(name))
        block.points[name] = SimpleNamespace(single=single, unplaced=True)
        block.unplaced.add(name)
    block.place_single(0.0)
    assert order == names and not block.points and not block.unplaced


def test_what_is_kept_of_a_long_flight_is_even(monkeypatch):
    """Each solution forgot some of all looks that were left, so that of the first of 12 parts 1 in 50 was left, and of
    the last one all."""
    monkeypatch.setattr(archive, "MOST_SINGLE", 600)
    block = archive.Archive(np.empty(0, dtype=np.int64), np.empty(0))
    for second in range(0, 1200, 4):
        names = tuple(f"S{second // 60}-M{10 * second + i}" for i in range(10))
        single = SimpleNamespace(batch=SimpleNamespace(names=names))
        block.points |= {name: SimpleNamespace(single=single, time_s=second) for name in names}
        assert block.thin_out() == 0, "none of these has been published"
    time_s = [kept.time_s for kept in block.points.values()]
    assert len(time_s) == 600 and len({id(kept.single.batch) for kept in block.points.values()}) == 60
    assert (np.histogram(time_s, np.arange(0, 1201, 200))[0] > 40).all()


@pytest.mark.study
def test_no_more_than_so_many_are_kept(flight, monkeypatch):
    monkeypatch.setattr(archive, "MOST_SINGLE", 3)
    told = []

    def watch(now, window):
        patches = window._block.earlier._patches
        told.append(sum(kept.single is not None for patch in patches for kept in patch.members.values()))

    adjust_online(*flight, OPTIONS, live=False, update_s=0.5, watch=watch)
    assert max(told) == 3
