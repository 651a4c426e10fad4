"""Several strips in the sliding window: points seen again, the block as a whole, late control, bounds."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from three_strips import OPTIONS, PLAN, SENSORS, SIDE_BY_SIDE, TIES, flown, usual, usual_at_once, usual_online

from triline.solver.adjustment.in_parts import in_one_go
from triline.solver.camera.self_calibration import focal_length
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import (
    adjust_at_once,
    adjust_online,
    navigate,
    orientation_errors,
    point_errors,
    slow_errors_of,
)
from triline.solver.window.block import archive as window_archive
from triline.solver.window.block import block as window_block
from triline.solver.window.results import WindowOptions
from triline.solver.window.state.strip import WindowStrip
from triline.solver.window.state.unknowns import WindowState


@pytest.fixture(scope="module")
def flight():
    return usual()


@pytest.fixture(scope="module")
def online():
    return usual_online()


@pytest.fixture(scope="module")
def batch():
    return usual_at_once()


@pytest.fixture(scope="module")
def side_by_side():
    return flown(SIDE_BY_SIDE)


@pytest.fixture(scope="module")
def bounded(flight):
    """The flight with a block that may hold few unknowns, what was published of each time, and solutions of it."""
    published, solved = Counter(), []
    plain, solving = window_block.Block.refined, window_archive.Archive.solving

    def watched(self, now_s, steps, at_the_end):
        result = plain(self, now_s, steps, at_the_end)
        if result is not None:
            published.update((o.strip, float(o.time_s[0])) for o in result.orientation)
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(window_archive, "BLOCK_UNKNOWNS", 200)
        patch.setattr(window_block.Block, "refined", watched)
        patch.setattr(window_archive.Archive, "solving", lambda *a: solved.append(1) or solving(*a))
        result = adjust_online(*flight, OPTIONS, live=False, update_s=1.0)
    return result, published, solved


def joined(orientations):
    """Time, correction and covariance, in order of time."""
    rows = [np.concatenate([getattr(o, name) for o in orientations]) for name in ("time_s", "correction", "covariance")]
    order = np.argsort(rows[0])
    return [r[order] for r in rows]


def far_apart(found, wanted):
    """Largest difference of two orientations, in sigmas of the second; largest share by which sigmas differ."""
    (t1, c1, S1), (t2, c2, S2) = joined(found), joined(wanted)
    assert t1 == pytest.approx(t2)
    sigma = np.sqrt(np.einsum("nii->ni", S2))
    return np.abs((c1 - c2) / sigma).max(), np.abs(np.sqrt(np.einsum("nii->ni", S1)) / sigma - 1).max()


def test_after_the_last_strip_every_line_and_point_has_the_information_of_the_block(online, batch):
    difference, sigma = far_apart(online.whole, batch.final)
    assert difference < 0.1 and sigma < 0.02  # linearised before the other strips were known
    assert far_apart(online.final, batch.final)[0] > 1.0  # which what became final on the way could not know
    assert online.whole_points.keys() == batch.final_points.keys()
    shared = 0
    for name, point in online.whole_points.items():
        wanted = batch.final_points[name]
        sigma = np.sqrt(np.diag(wanted.covariance))
        assert point.rays == wanted.rays
        assert np.abs((point.xyz_l - wanted.xyz_l) / sigma).max() < 0.1, name
        assert np.sqrt(np.diag(point.covariance)) == pytest.approx(sigma, rel=0.02)
        shared += point.rays > 3
    assert shared > 50  # seen in two strips at least


def test_the_backward_pass_of_the_block_is_that_of_the_window_where_there_is_one_strip(flight):
    one = simulate(replace(PLAN, strips=1, cross_strips=0), 11, SENSORS, TIES)
    poses = navigate(one)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(window_archive, "PRIOR_TOGETHER", 7)
        block = adjust_online(one, poses, OPTIONS, live=False, update_s=1.0)
        patch.setattr(window_block, "MOST_OF_STRIP", 10)
        chain = adjust_online(one, poses, OPTIONS, live=False, update_s=1.0)
    assert any("refined alone" in text for text in chain.events)
    difference, sigma = far_apart(block.whole, chain.whole)
    assert difference < 1e-4 and sigma < 1e-6
    assert block.whole_points.keys() == chain.whole_points.keys()


def test_a_strip_of_25_minutes_has_room_in_a_block():
    strip = WindowStrip("S1", 0.0, 200.0, 1500 * 200, slow_errors_of(SENSORS), WindowOptions(), WindowState())
    assert len(strip.numbers) <= window_archive.MOST_OF_STRIP


def test_sigmas_that_a_later_strip_shows_to_be_larger_count_for_the_earlier_ones_too(side_by_side):
    """As if they had been known from the start: all strips were measured with the same instruments."""
    simulation, poses = side_by_side

    def whole(since_s):
        def larger(now_s, window):
            network = window.network
            if now_s > since_s and network.sigmas.apriori.max() == 1.0:
                network.sigmas.apriori = np.array([3.0, 4.0, 1.0, 1.0])
                for strip in network.flown:
                    strip.restate_sigmas(network.sigmas.apriori, network.state)

        return adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0, watch=larger).whole

    (begin, _), (second, _) = simulation.flight.strip_times_s
    from_the_start = whole(begin + 2.0)
    difference, sigma = far_apart(whole(second + 5.0), from_the_start)
    assert difference < 0.05 and sigma < 0.005
    as_stated = adjust_at_once(simulation, poses, OPTIONS).final
    assert far_apart(as_stated, from_the_start)[1] > 0.2, "these are other sigmas"


def test_a_later_strip_knows_what_the_earlier_ones_say_of_its_points(flight, online):
    """As the batch adjustment of what had arrived when a time became final; far better than alone."""
    simulation, poses = flight
    for strip in ("S2", "C1"):
        i = next(i for i, o in enumerate(online.final) if o.strip == strip)
        final, known_s = online.final[i], online.final_known_s[i]
        at_once = adjust_at_once(simulation, poses, OPTIONS, until_s=known_s)
        wanted = at_once.window.orientation_at(strip, final.time_s)
        difference, sigma = far_apart([final], [wanted])
        assert difference < 0.5 and sigma < 0.1
    alone = replace(
        simulation,
        images=simulation.images.select(simulation.images.looks.strip == simulation.images.looks.strip.max()),
    )
    alone = adjust_online(alone, poses, OPTIONS, live=False, update_s=1.0)
    rmse = [orientation_errors(simulation, [o for o in r.final if o.strip == "C1"]) for r in (online, alone)]
    sigma = [np.sqrt(np.einsum("nii->ni", e.covariance)).mean(axis=0) for e in rmse]
    assert (sigma[0][:3] < 0.8 * sigma[1][:3]).all()


@pytest.mark.study
def test_several_strips_are_consistent():
    nees = []
    for seed in range(3):
        simulation = simulate(PLAN, seed, SENSORS, TIES)
        result = adjust_online(simulation, navigate(simulation), OPTIONS, live=False, update_s=1.0)
        kinds = [orientation_errors(simulation, result.final), orientation_errors(simulation, result.whole)]
        kinds += [point_errors(simulation, p) for p in (result.final_points, result.whole_points)]
        nees.append([k.nees.mean() for k in kinds])
    assert (np.mean(nees, axis=0) > 0.6).all() and (np.mean(nees, axis=0) < 1.5).all(), np.mean(nees, axis=0)


def test_control_counts_once_although_it_is_seen_from_two_strips(flight, online):
    simulation, _ = flight
    given = {str(i) for i in simulation.points.id[simulation.points.role == "control"]}
    sigma = [np.sqrt(np.diag(p.covariance)).min() for n, p in online.whole_points.items() if n in given]
    seen = [p.rays for n, p in online.whole_points.items() if n in given]
    assert max(seen) > 3 and min(sigma) > 0.02 / np.sqrt(2)


@pytest.mark.study
def test_control_that_comes_after_its_strip_is_over_counts_as_in_the_batch(flight, batch):
    simulation, poses = flight
    role = simulation.points.role
    control = np.flatnonzero(role == "control")
    blind = replace(simulation, points=replace(simulation.points, role=np.where(role == "control", "tie", role)))
    sigma = {}

    def watch(now, window):
        strip = simulation.flight.strips[1]
        if abs(now - strip.first_line_time_s - 20.0) < 0.26 and "after" not in sigma:
            sigma["before"] = window.live(now - 0.3).covariance[0, 0, 0]
            for i in control:
                window.add_control(str(simulation.points.id[i]), simulation.surveyed_l[i], np.full(3, 0.02), "control")
            sigma["after"] = None
        elif sigma.get("after", 0.0) is None:
            sigma["after"] = window.live(now - 0.8).covariance[0, 0, 0]

    late = adjust_online(blind, poses, OPTIONS, live=False, update_s=1.0, watch=watch)
    assert any("came after its point was final: it counts" in text for text in late.events)
    assert sigma["after"] < 0.7 * sigma["before"]  # on line, through the points both strips see
    difference, share = far_apart(late.whole, batch.final)
    assert difference < 0.3 and share < 0.02


def test_control_that_is_corrected_after_its_point_was_final_leaves_no_trace(side_by_side):
    """All control 0.6 m too high with other sigmas, and a tie point as control; put right in the second strip."""
    simulation, poses = side_by_side
    online = adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0)
    control = np.flatnonzero(simulation.points.role == "control")
    named = {str(simulation.points.id[i]): simulation.surveyed_l[i] for i in control}
    passed = next(n for n, p in online.final_points.items() if p.role == "tie")
    place_l = online.whole_points[passed].xyz_l
    changed = []

    def watch(now, window):
        if not changed:
            for name, xyz_l in named.items():
                window.add_control(name, xyz_l + np.array([0.0, 0.0, 0.6]), np.full(3, 0.05), "control")
            window.add_control(passed, place_l + np.array([0.6, 0.0, 0.0]), np.full(3, 0.05), "control")
            changed.append(now)
        strip = simulation.flight.strips[1]
        if len(changed) == 1 and now > strip.first_line_time_s + 12.0:
            for name, xyz_l in named.items():
                window.add_control(name, xyz_l, np.full(3, 0.02), "control")
            window.add_control(passed, place_l, np.full(3, np.inf), "check")
            changed.append(now)

    result = adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0, watch=watch)
    assert any("was changed after its point was final: it counts" in text for text in result.events)
    difference, share = far_apart(result.whole, online.whole)
    assert difference < 0.3 and share < 0.02


def test_a_strip_that_is_closed_leaves_what_it_says_of_the_others(online):
    archive = deepcopy(online.window._block._archive)
    stay = np.concatenate([archive.strips[id].entered for id in ("S2", "C1")])
    values, Q = in_one_go(archive.solving()).of(stay)
    in_one_go(archive.closing(["S1"]))
    rest = in_one_go(archive.solving())
    assert len(rest.numbers) == len(stay)
    again, Q_again = rest.of(stay)
    sigma = np.sqrt(np.diag(Q))
    assert np.abs((again - values) / sigma).max() < 1e-6
    assert Q_again / sigma / sigma[:, None] == pytest.approx(Q / sigma / sigma[:, None], abs=1e-7)


def test_a_strip_may_begin_while_others_are_refined(online):
    archive = deepcopy(online.window._block._archive)
    solution, over = in_one_go(archive.solving()), archive.over
    at_once = in_one_go(archive.refining(solution, over))
    work = archive.refining(solution, over)
    next(work)
    archive.strips["next"] = window_archive.KeptStrip(len(over), np.arange(4) + 1_000_000)
    portions = in_one_go(work)
    assert [(o.strip, float(o.time_s[0])) for o in portions.orientation] == [
        (o.strip, float(o.time_s[0])) for o in at_once.orientation
    ]
    assert {o.strip for o in portions.orientation} == set(over)
    assert [p.name for p in portions.points] == [p.name for p in at_once.points]


def test_a_block_keeps_its_bounds_and_says_so(flight, bounded):
    result, _, _ = bounded
    assert sum("refined no more" in text for text in result.events) == 2
    assert {o.strip for o in result.whole} == {"S1", "S2", "C1"}
    assert list(result.window._block._archive.strips) == ["C1"]
    assert 0.3 < orientation_errors(flight[0], result.whole).nees.mean() < 2.0


def test_where_one_strip_cannot_leave_what_it_says_all_are_closed_and_the_camera_is_kept(side_by_side):
    simulation, poses = side_by_side
    camera = focal_length(simulation.flight.camera)
    archive = adjust_online(simulation, poses, OPTIONS, camera, live=False, update_s=1.0).window._block._archive
    values, Q = in_one_go(archive.solving()).of(archive._shared)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(window_archive, "MOST_MET", 10)
        assert not archive.is_closable(["S1"])
        patch.setattr(window_archive, "BLOCK_UNKNOWNS", 50)
        patch.setattr(window_archive, "MOST_POINTS", 20)
        patch.setattr(window_block, "MOST_POINTS", 20)
        result = adjust_online(simulation, poses, OPTIONS, camera, live=False, update_s=1.0)
    told = " | ".join(result.events)
    assert "the block has over 20 points" in told and "strips S1, S2 are refined no more" in told
    again, Q_again = in_one_go(result.window._block._archive.solving()).of(archive._shared)
    assert again == pytest.approx(values, abs=0.1 * np.sqrt(Q[0, 0])) and Q_again == pytest.approx(Q, rel=0.02)
    for strip in ("S1", "S2"):  # with the points that are forgotten
        errors = orientation_errors(simulation, [o for o in result.whole if o.strip == strip])
        assert 0.3 < errors.nees.mean() < 2.0
    assert len(result.whole_points) > 100


def test_a_strip_too_long_for_a_block_leaves_those_before_it_as_they_are(side_by_side):
    """Not as if all that is unknown of it were nothing, which what ties them would say otherwise."""
    simulation, poses = side_by_side
    (_, end), _ = simulation.flight.strip_times_s
    with pytest.MonkeyPatch.context() as patch:

        def watch(now_s, _):
            if now_s > end + 5.0:
                patch.setattr(window_block, "MOST_OF_STRIP", 60)

        result = adjust_online(simulation, poses, OPTIONS, live=False, update_s=1.0, watch=watch)
    assert any("S2 has more than 60 unknowns" in text for text in result.events)
    assert not result.window._block._archive.strips
    assert {o.strip for o in result.whole} == {"S1", "S2"}
    for strip in ("S1", "S2"):
        errors = orientation_errors(simulation, [o for o in result.whole if o.strip == strip])
        assert 0.2 < errors.nees.mean() < 2.0


def test_strips_are_published_when_they_are_over_and_when_they_are_closed_no_more_often(bounded):
    _, published, solved = bounded
    # the first is published twice: at its end, and when the end of the second closes it
    assert {strip for strip, _ in published} == {"S1", "S2", "C1"}
    assert {n for (strip, _), n in published.items() if strip == "S1"} == {2}
    assert max(published.values()) == 2 and len(solved) <= 4


@pytest.mark.study
def test_a_point_taken_for_another_ties_nothing(flight, online):
    simulation, poses = flight
    looks = simulation.images.looks
    seen = [set(looks.point[looks.strip == s].tolist()) for s in range(2)]
    shared = sorted(seen[0] & seen[1])
    shared = [p for p in shared if simulation.points.role[p] == "tie" and all(
        (looks.point[looks.strip == s] == p).sum() == 3 for s in range(2))]  # fmt: skip
    one, other = shared[0], shared[len(shared) // 2]
    point = looks.point.copy()
    second = looks.strip == 1
    point[second & (looks.point == one)], point[second & (looks.point == other)] = other, one
    order = np.lexsort((looks.time_s, point))
    mixed = replace(
        simulation,
        images=replace(simulation.images.select(order), looks=replace(looks, point=point).select(order)),
    )
    result = adjust_online(mixed, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    named = " ".join(text for text in result.events if "do not agree with earlier strips" in text)
    for name in (str(simulation.points.id[one]), str(simulation.points.id[other])):
        assert name in named and result.whole_points[name].checked == "doubtful"
    kept = [o for o in result.whole if o.strip == "S1"], [o for o in online.whole if o.strip == "S1"]
    assert far_apart(*kept)[0] < 1.5


def test_a_point_that_strips_contradict_each_other_at_is_where_more_looks_say(flight):
    """Two of the three looks of a later strip are there, and wrong alike; they took the place of three good ones."""
    simulation, poses = flight
    images, roles = simulation.images, simulation.points.role
    seen = [np.bincount(images.looks.point[images.looks.strip == s], minlength=len(roles)) for s in range(2)]
    point = np.flatnonzero((seen[0] == 3) & (seen[1] == 3) & (roles == "tie"))[0]
    again = np.flatnonzero((images.looks.strip == 1) & (images.looks.point == point))
    keep = images.looks.strip < 2
    keep[again[0]] = False
    sample = images.sample + 60.0 * np.isin(np.arange(len(images)), again)
    wrong = replace(simulation, images=replace(images, sample=sample).select(keep))
    result = adjust_online(wrong, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    name = str(simulation.points.id[point])
    assert any("do not agree with earlier strips" in text and name in text for text in result.events)
    whole, off = result.whole_points[name], result.whole_points[name].xyz_l - simulation.points.xyz_l[point]
    assert whole.checked == "doubtful" and {r.look.strip for r in whole.residuals} == {"S1"} and whole.rays == 3
    assert off @ np.linalg.solve(whole.covariance, off) < 16.0


def seen_again_once(simulation, role):
    """The flight with points of a role seen only once in the strips after the first, their places, and those looks."""
    looks = simulation.images.looks
    chosen = np.isin(looks.point, np.flatnonzero(simulation.points.role == role))
    later = looks.strip > 0
    once = np.zeros(len(looks), dtype=bool)
    once[np.unique(looks.point * 10 + looks.strip, return_index=True)[1]] = True
    kept = ~(chosen & later) | once
    thinned = replace(simulation, images=simulation.images.select(kept))
    names = set(looks.point[chosen & ~later].tolist()) & set(looks.point[chosen & later].tolist())
    return thinned, names, np.flatnonzero((chosen & later & once)[kept])


@pytest.mark.study
def test_a_control_point_seen_again_in_one_look_ties_and_is_not_weighted_again(flight):
    simulation, poses = flight
    thinned, seen, _ = seen_again_once(simulation, "control")
    result = adjust_online(thinned, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    assert seen
    for p in seen:
        name = str(simulation.points.id[p])
        assert not [r for r in result.refused if r.point == name]
        point = result.whole_points[name]
        assert point.rays > 1 and np.sqrt(np.diag(point.covariance)).min() > 0.02 / np.sqrt(2)


def test_control_whose_looks_in_a_later_strip_are_all_refused_leaves_the_block_as_it_was():
    """It is seen there once, far from where it is: neither the earlier strip nor its coordinates agree."""
    simulation, poses = flown(replace(SIDE_BY_SIDE, sidelap=0.6))
    images, roles = simulation.images, simulation.points.role
    in_second = images.looks.strip == 1
    seen = {int(i) for i in images.looks.point[in_second] if roles[i] == "control"}
    point = min(seen & set(images.looks.point[~in_second].tolist()))
    again = np.flatnonzero(in_second & (images.looks.point == point))
    keep = np.ones(len(images), dtype=bool)
    keep[again[1:]] = False
    sample = images.sample + 1000.0 * (np.arange(len(images)) == again[0])
    wrong = replace(simulation, images=replace(images, sample=sample).select(keep))
    result = adjust_online(wrong, poses, replace(OPTIONS, snoop=True), live=False, update_s=1.0)
    name = str(simulation.points.id[point])
    assert "snooping" in [r.reason for r in result.refused if r.point == name]
    assert {r.look.strip for r in result.whole_points[name].residuals} == {"S1"}
    assert {o.strip for o in result.whole} == {"S1", "S2"}


@pytest.mark.study
def test_a_single_look_ties_a_later_strip_unless_it_contradicts(flight):
    """With single looks alone a later strip is better than without; one that is wrong is not used."""
    simulation, poses = flight
    thinned, seen, looks = seen_again_once(simulation, "tie")
    options = replace(OPTIONS, snoop=True)
    result = adjust_online(thinned, poses, options, live=False, update_s=1.0)
    single = np.isin(np.arange(len(thinned.images)), looks)
    none = replace(thinned, images=thinned.images.select(~single))
    without = adjust_online(none, poses, options, live=False, update_s=1.0)
    sigma = [
        np.sqrt(np.einsum("nii->ni", np.concatenate([o.covariance for o in r.final if o.strip == "S2"]))).mean(axis=0)
        for r in (result, without)
    ]
    assert (sigma[0][:3] < 0.9 * sigma[1][:3]).all()
    assert orientation_errors(simulation, result.final).nees.mean() < 2.0
    sample = thinned.images.sample.copy()
    wrong = next(i for i in looks if thinned.images.looks.point[i] in seen and thinned.images.looks.strip[i] == 1)
    sample[wrong] += 40.0
    spoilt = replace(thinned, images=replace(thinned.images, sample=sample))
    spoilt = adjust_online(spoilt, poses, options, live=False, update_s=1.0)
    name = str(simulation.points.id[thinned.images.looks.point[wrong]])
    assert any("do not agree with earlier strips" in e and name in e for e in spoilt.events)
    assert far_apart(spoilt.final, result.final)[0] < 1.0


def test_a_point_of_several_strips_is_checked_by_all_its_rays(online):
    points = [p for p in online.whole_points.values() if p.rays > 2 and len(p.residuals) < 2 * p.rays]
    assert max(p.rays for p in points) > 3
    assert {p.checked for p in points} == {"all"}
