"""Several recordings as one block: what is joined, what is kept apart, and the same answers as of one recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from adjustment_networks import CAMERA

from triline.nodes.cli.adjust import join_inputs, joining_notes
from triline.nodes.errors import UserError
from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.block_data import BlockData, ImagePoints, KnownPoints, network_from_block
from triline.solver.adjustment.covariance import cofactors
from triline.solver.adjustment.joined_block import join_blocks, other_points
from triline.solver.adjustment.options_by_strip import OptionsByStrip
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import quaternion_multiply
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.network import regular_block

FRAME = LocalFrame(48.0, 11.0, 500.0)


@pytest.fixture(scope="module")
def block():
    """Three strips and a cross strip, one block."""
    network = regular_block(CAMERA, np.random.default_rng(4), DgrOptions(), 120, 3, 1, length_m=4000.0).network
    known = network.control
    covariance = np.stack([np.diag(s**2) for s in known.sigma_m])
    rays, ids = network.rays, [network.point_ids[i] for i in known.point]
    names = (*ids, *(id for id in network.point_ids if id not in ids))
    place = {id: i for i, id in enumerate(names)}
    point = np.array([place[id] for id in network.point_ids])[rays.point]
    sigma = rays.sigma_line_px
    image = ImagePoints(point, rays.strip, rays.ccd, rays.line, rays.sample, sigma, rays.time_s, {}, sigma)
    ground = KnownPoints(tuple(ids), known.xyz_l, covariance, ("control",) * len(ids))
    return BlockData("block", FRAME, network.camera, network.strips, names, ground, image)


def some_strips(block, which):
    """The recording of some strips: their image points, and the known points."""
    rows = np.flatnonzero(np.isin(block.image.strip, which))
    place = np.full(len(block.strips), -1)
    place[which] = np.arange(len(which))
    image = block.image
    part = [getattr(image, n)[rows] for n in ("ccd", "line", "sample", "sigma_px", "time_s")]
    own = ImagePoints(image.point[rows], place[image.strip[rows]], *part, {}, image.sigma_sample_px[rows])
    return replace(block, strips=tuple(block.strips[i] for i in which), image=own)


def later(block, seconds):
    """A recording of another day: its times count from another moment, and stand at other values."""
    strips = [
        replace(
            s,
            trajectory=Trajectory(s.trajectory.time_s - seconds, s.trajectory.position_l, s.trajectory.quaternion),
            first_line_time_s=s.first_line_time_s - seconds,
        )
        for s in block.strips
    ]
    image = replace(block.image, time_s=block.image.time_s - seconds)
    return replace(
        block, strips=tuple(strips), image=image, time_reference_ns=block.time_reference_ns + seconds * 10**9
    )


def answers(block):
    solution = adjust(network_from_block(block), DgrOptions())
    Q = cofactors(solution)
    place = {id: i for i, id in enumerate(solution.network.point_ids)}
    return solution, Q, place


def test_two_recordings_are_one_with_the_same_content(block):
    joined = join_blocks([some_strips(block, [0, 1]), later(some_strips(block, [2, 3]), 64)], ["day1", "day2"])
    assert (joined.strips, sum(joined.image_points)) == ((2, 2), len(block.image))
    assert joined.ties > 30 and joined.ground >= 1 and not joined.elsewhere and not joined.renamed
    assert joined.recording == {"S1": 0, "S2": 0, "S3": 1, "C1": 1}
    (one, Q1, place1), (two, Q2, place2) = answers(block), answers(joined.block)
    assert two.redundancy == one.redundancy
    assert two.sigma0 == pytest.approx(one.sigma0, rel=1e-9)
    ours = np.array([place2[id] for id in place1])
    sigma = np.sqrt(np.einsum("pii->pi", Q1.points))
    known = one.points.rank == 3
    assert known.sum() > 100
    assert (np.abs(two.state.points_l[ours] - one.state.points_l) < 1e-6 * sigma)[known].all()
    again = np.sqrt(np.einsum("pii->pi", Q2.points))[ours]
    np.testing.assert_allclose(again[known], sigma[known], rtol=1e-8)


def test_names_that_come_again(block):
    """The same strips twice, under the same names; a tie point whose name means another point in the second."""
    first, second = some_strips(block, [0, 1]), some_strips(block, [0, 2])
    seen = [np.unique(b.image.point) for b in (first, second)]
    n = len(block.ground)
    a, b = (int(i) for i in np.intersect1d(*seen)[np.intersect1d(*seen) >= n][[0, -1]])
    names = list(second.point_ids)
    names[a], names[b] = names[b], names[a]
    joined = join_blocks([first, replace(second, point_ids=tuple(names))], ["day1", "day2"])
    assert [s.id for s in joined.block.strips] == ["S1@day1", "S2", "S1@day2", "S3"]
    assert joined.renamed == (("day1", "S1", "S1@day1"), ("day2", "S1", "S1@day2"))
    assert joined.elsewhere == 2
    assert {f"{block.point_ids[a]}@day2", f"{block.point_ids[b]}@day2"} <= set(joined.block.point_ids)
    solution, _, _ = answers(joined.block)
    assert solution.sigma0 < 1.2


def of_another_seed(block, seed):
    """Names of the tie points among those whose points lie near each other, as a matcher would give them anew."""
    network = network_from_block(block)
    place = {id: i for i, id in enumerate(network.point_ids)}
    n, rng = len(block.ground), np.random.default_rng(seed)
    names = list(block.point_ids)
    ties = [id for id in names[n:] if id in place]
    xyz = network.approximate_l[[place[id] for id in ties]]
    left = set(range(len(ties)))
    new = {}
    for k in rng.permutation(len(ties)):
        near = sorted(left, key=lambda j: float(np.linalg.norm(xyz[j] - xyz[k])))
        new[ties[k]] = ties[near[int(rng.integers(min(3, len(near))))]]
        left.discard(ties.index(new[ties[k]]))
    return replace(block, point_ids=tuple(new.get(id, id) for id in names))


def test_names_that_a_matcher_gave_again_on_the_same_flight_line(block):
    """Other points of the same names, some of them less than 5 % of the height away: these were taken for the same."""
    first, second = some_strips(block, [0, 1]), later(some_strips(block, [0, 1]), 64)
    apart = join_blocks([first, of_another_seed(second, 3)], ["day1", "day2"])
    ties = np.unique(second.image.point[second.image.point >= len(block.ground)])
    assert apart.elsewhere == len(ties) and not apart.ties
    solution, _, _ = answers(apart.block)
    assert 0.85 < solution.sigma0 < 1.15


def test_ties_of_a_trajectory_that_is_turned_are_ties(block):
    """Half a degree of boresight moves the points of the second recording 17 m on the ground, all the same way."""
    first, second = some_strips(block, [0, 1]), some_strips(block, [1, 2])
    turn = np.array([np.sin(np.radians(0.25)), 0.0, 0.0, np.cos(np.radians(0.25))])
    strips = tuple(
        replace(
            s,
            trajectory=Trajectory(
                s.trajectory.time_s, s.trajectory.position_l, quaternion_multiply(s.trajectory.quaternion, turn)
            ),
        )
        for s in second.strips
    )
    straight = join_blocks([first, second], ["day1", "day2"])
    joined = join_blocks([first, replace(second, strips=strips)], ["day1", "day2"])
    assert straight.ties > 20 and joined.ties > 0.9 * straight.ties


@pytest.mark.parametrize("seed", range(5))
def test_points_all_near_each_other_that_are_not_off_by_the_same_are_others(seed):
    rng, reach = np.random.default_rng(seed), 100.0
    at = rng.uniform(0.0, 3000.0, (40, 3)) * (1.0, 0.3, 0.02)
    chance = at + rng.uniform(0.0, 90.0, (40, 1)) ** 0.5 * rng.normal(0.0, 6.0, (40, 3)) * (1.0, 1.0, 0.3)
    tied = at + np.array((60.0, -40.0, 10.0)) + rng.normal(0.0, 4.0, (40, 3))
    tied[7] += (0.0, 900.0, 0.0)
    near = np.linalg.norm(chance - at, axis=1) < reach
    assert near.mean() > 0.6 and other_points(chance, at, reach).all()
    assert np.flatnonzero(other_points(tied, at, reach)).tolist() == [7]
    assert other_points(at[:1], at[:1], reach).tolist() == [False]


def test_another_frame_is_turned_into_the_first(block):
    """The second recording has its origin 20 km away."""
    first, second = some_strips(block, [0, 1]), some_strips(block, [2, 3])
    away = LocalFrame(48.2, 11.1, 300.0)
    turn = away.R_el.T @ FRAME.R_el
    offset = (FRAME.origin_e - away.origin_e) @ away.R_el
    from triline.solver.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix

    strips = [
        replace(
            s,
            trajectory=Trajectory(
                s.trajectory.time_s,
                s.trajectory.position_l @ turn.T + offset,
                quaternion_from_matrix(turn @ matrix_from_quaternion(s.trajectory.quaternion)),
            ),
        )
        for s in second.strips
    ]
    ground = replace(second.ground, xyz_l=second.ground.xyz_l @ turn.T + offset)
    moved = replace(second, frame=away, strips=tuple(strips), ground=ground)
    joined = join_blocks([first, moved], ["here", "there"]).block
    for ours, theirs in zip(joined.strips[2:], second.strips, strict=True):
        np.testing.assert_allclose(ours.trajectory.position_l, theirs.trajectory.position_l, atol=1e-6)
        turned = matrix_from_quaternion(ours.trajectory.quaternion)
        np.testing.assert_allclose(turned, matrix_from_quaternion(theirs.trajectory.quaternion), atol=1e-12)


def test_control_with_other_sigmas_is_told(block):
    """The first recording that has the point counts, and nothing said so."""
    first, second = some_strips(block, [0, 1]), some_strips(block, [2, 3])
    covariance = second.ground.covariance.copy()
    covariance[1] *= 25.0
    other = replace(second, ground=replace(second.ground, covariance=covariance))
    assert join_blocks([first, second], ["day1", "day2"]).restated == ()
    joined = join_blocks([first, other], ["day1", "day2"])
    point = second.ground.id[1]
    assert joined.restated == ((point, "day1"),)
    kept = joined.block.ground.covariance[joined.block.ground.id.index(point)]
    np.testing.assert_array_equal(kept, first.ground.covariance[first.ground.id.index(point)])
    (note,) = [note for note in joining_notes(joined, ["day1", "day2"]) if "sigmas that are not the same" in note]
    assert note.endswith(f"in all recordings: {point} (those of day1 count)")


def test_what_contradicts_is_refused(block):
    first, second = some_strips(block, [0, 1]), some_strips(block, [2, 3])
    wrong = replace(second.ground, xyz_l=second.ground.xyz_l + np.array([0.0, 0.3, 0.0]))
    with pytest.raises(ValueError, match=r"known point .*: day2 and day1 do not say the same .*0.300 m apart"):
        join_blocks([first, replace(second, ground=wrong)], ["day1", "day2"])
    other = replace(block.camera, lines=tuple(replace(li, xy_mm=li.xy_mm + 0.01) for li in block.camera.lines))
    with pytest.raises(ValueError, match="day2 has another camera than day1"):
        join_blocks([first, replace(second, camera=other)], ["day1", "day2"])
    with pytest.raises(ValueError, match="attitude of day2"):
        join_blocks([first, replace(second, heading=True)], ["day1", "day2"])


def test_each_recording_keeps_its_apriori_sigmas(block):
    """A second day with a trajectory a hundred times as good: its strips stay where they were measured."""
    joined = join_blocks([some_strips(block, [0, 1]), some_strips(block, [2, 3])], ["day1", "day2"]).block
    usual, good = DgrOptions(), DgrOptions(*(tuple(0.01 * np.array(s)) for s in vars(DgrOptions()).values()))
    network = network_from_block(joined)
    alike = adjust(network, OptionsByStrip(dict.fromkeys(("S1", "S2", "S3", "C1"), usual)))
    assert alike.sigma0 == adjust(network, usual).sigma0
    mixed = adjust(network, OptionsByStrip({"S1": usual, "S2": usual, "S3": good, "C1": good}))
    prior = mixed.layout.prior
    for set_, strip in zip(mixed.layout.sets, joined.strips, strict=True):
        rows = np.flatnonzero([f"strip {strip.id}" in label for label in prior.labels])
        stated = (good if strip.id in ("S3", "C1") else usual).build(set_.model.extent).pseudo_observations()
        np.testing.assert_array_equal(prior.sigma[rows], stated.sigma)
    moved = {strip.id: np.abs(mixed.state.theta[set_.columns][:3]).max() for set_, strip in
             zip(mixed.layout.sets, joined.strips, strict=True)}  # fmt: skip
    assert max(moved["S3"], moved["C1"]) < 0.1 * max(moved["S1"], moved["S2"])


def test_measurements_that_two_recordings_hold_are_told(block):
    """A flight as recorded and as processed: all counted twice, and sigma0 was 0.63 where it should be 1."""
    one, other = some_strips(block, [0, 1]), some_strips(block, [2])
    ids = {id: i for i, id in enumerate(reversed(block.point_ids))}
    place = np.array([ids[id] for id in block.point_ids])
    again = some_strips(block, [0, 3])  # S1 once more, its points in another order and its times from another moment
    again = replace(again, point_ids=tuple(ids), image=replace(again.image, point=place[again.image.point]))
    names = ["a", "b", "c"]
    number = int((block.image.strip == 0).sum())
    assert join_blocks([one, other, later(again, 64)], names).repeated == (("a", "c", number),)
    assert join_blocks([one, other, some_strips(block, [3])], names).repeated == ()
    for name in ("line", "sample", "time_s"):  # of another flight
        changed = replace(again, image=replace(again.image, **{name: getattr(again.image, name) + 1e-3}))
        assert join_blocks([one, changed], ["a", "b"]).repeated == ()
    with pytest.raises(UserError, match=rf"b holds {number} of the image points of a, which would count twice"):
        join_inputs([one, again], [Path("a.mcap"), Path("b.mcap")])


def test_a_recording_is_given_twice_whatever_way_leads_to_it(block, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.mcap").write_bytes(b"x")
    (tmp_path / "b.mcap").symlink_to(tmp_path / "a.mcap")
    for other in ("sub/../a.mcap", "b.mcap"):
        with pytest.raises(UserError, match="a recording is given twice"):
            join_inputs([block, block], [tmp_path / "a.mcap", tmp_path / other])
