"""A block in partitions has the answers of the block as a whole: steps, corrections, sigmas, tests of rays."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from triline.solver.adjustment.job import Job, NotAdjustableError, refuse_in_parts, run
from triline.solver.adjustment.robust import Huber
from triline.solver.camera.line_camera import three_line_camera
from triline.solver.camera.self_calibration import tls
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions
from triline.solver.models.wander import WanderOptions
from triline.solver.partitioned.engine import Engine
from triline.solver.partitioned.part import cut
from triline.solver.partitioned.runner import Here, Tree
from triline.solver.simulation.large_block import large_block
from triline.solver.simulation.network import regular_block

CAMERA = three_line_camera("test", 62.7, 12000, 0.0065, {"F": 26.0, "N": 0.0, "B": -16.0})
JOBS = {
    "dgr, snooping, components": Job(DgrOptions(), snoop=True, reweight=True, components=True),
    "lim, robust start": Job(LimOptions(fixes=10), snoop=True, robust=Huber()),
    "dgr, self-calibration": Job(DgrOptions(), self_calibration=tls(CAMERA), eliminate=False),
}


class Memory:
    """A store that keeps what a file would."""

    def __init__(self):
        self.objects = {}

    def save(self, name, value):
        self.objects[name] = pickle.dumps(value, 5)

    def load(self, name):
        return pickle.loads(self.objects[name])

    def remove(self, name):
        self.objects.pop(name, None)


@pytest.fixture(scope="module")
def network():
    """A block with some blunders."""
    clean = regular_block(CAMERA, np.random.default_rng(1), DgrOptions(), 500, 3, 1, length_m=5000.0).network
    rng = np.random.default_rng(2)
    xy = clean.rays.xy_mm.copy()
    xy[rng.choice(len(xy), 12, replace=False)] += rng.normal(0, 0.05, (12, 2))
    return replace(clean, rays=replace(clean.rays, xy_mm=xy))


def same(whole, parts):
    """Both answers to 1e-9 of a sigma."""
    of_unknowns, of_points = (np.sqrt(np.maximum(x, 1e-300)) for x in
                              (whole.cofactors.unknowns, np.einsum("pii->pi", whole.cofactors.points)))  # fmt: skip
    assert parts.iterations == whole.iterations
    assert parts.solution.redundancy == whole.solution.redundancy
    assert parts.sigma0 == pytest.approx(whole.sigma0, rel=1e-10)
    assert (np.abs(parts.solution.state.theta - whole.solution.state.theta) < 1e-9 * of_unknowns).all()
    np.testing.assert_allclose(np.sqrt(parts.cofactors.unknowns), of_unknowns, rtol=1e-9)
    known = whole.solution.points.rank == 3
    np.testing.assert_array_equal(parts.solution.points.rank, whole.solution.points.rank)
    off = np.abs(parts.solution.state.points_l - whole.solution.state.points_l)
    assert (off[known] < 1e-9 * of_points[known]).all()
    np.testing.assert_allclose(parts.point_sigma_m[known], whole.point_sigma_m[known], rtol=1e-9)
    assert [(r.ray, r.point, r.axis) for r in parts.rejected] == [(r.ray, r.point, r.axis) for r in whole.rejected]
    assert [(d.point, d.reason) for d in parts.doubtful] == [(d.point, d.reason) for d in whole.doubtful]
    np.testing.assert_allclose(parts.rays.w, whole.rays.w, atol=1e-7)
    for group, figures in whole.groups.items():
        np.testing.assert_allclose(parts.groups[group], figures, rtol=1e-7, atol=1e-9)
    for ours, theirs in zip(parts.components, whole.components, strict=True):
        assert ours.factor == pytest.approx(theirs.factor, rel=1e-9)
    np.testing.assert_allclose(parts.georeferenced.xyz_l, whole.georeferenced.xyz_l, rtol=1e-12)
    np.testing.assert_allclose(parts.georeferenced.sigma_m, whole.georeferenced.sigma_m, rtol=1e-9)


@pytest.mark.parametrize("job", JOBS.values(), ids=JOBS.keys())
def test_partitions_answer_as_the_whole(network, job):
    store = Memory()
    whole, parts = run(network, job), run(network, job, pose=Engine(Here(store), 700).pose)
    assert len([name for name in store.objects if name.startswith("part-")]) == 4
    if job.snoop:
        assert len(whole.rejected) > 8
    same(whole, parts)


def test_noise_of_poses_is_counted_over_partitions(network):
    """What corrections absorb of it, piece by piece of a strip, whichever partitions its rays are in."""
    noise = np.diag([0.02, 0.02, 0.03, 1e-5, 1e-5, 2e-5]) ** 2
    noisy = replace(
        network,
        rays=replace(network.rays, orientation_noise=np.broadcast_to(noise, (len(network.rays), 6, 6)).copy()),
        strips=tuple(replace(strip, noise_time_s=1.0) for strip in network.strips),
    )
    job = Job(WanderOptions.from_settings({"wander_time_s": 300.0}))
    whole, parts = run(noisy, job), run(noisy, job, pose=Engine(Here(Memory()), 700).pose)
    assert whole.iterations > run(network, job).iterations
    same(whole, parts)


def test_states_that_nobody_needs_go(network):
    store = Memory()
    result = run(network, JOBS["dgr, snooping, components"], pose=Engine(Here(store), 700).pose)
    assert len([name for name in store.objects if name.startswith("state-")]) == 4
    del result
    assert not [name for name in store.objects if name.startswith("state-")]


def test_partitions_have_each_ray_and_point_once(network):
    parts = list(cut(network, 600))
    assert [id for part in parts for id in part.point_ids] == list(network.point_ids)
    np.testing.assert_array_equal(np.concatenate([part.rays.source for part in parts]), network.rays.source)
    assert sum(len(part.control) for part in parts) == len(network.control)
    assert sum(len(part.check) for part in parts) == len(network.check)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 12])
def test_a_tree_adds_up_in_one_shape(count):
    """Whatever the order in which results come."""
    rng, found = np.random.default_rng(count), set()
    for _ in range(5):
        tree = Tree(count, lambda a, b: f"({a}{b})")
        for place in rng.permutation(count).tolist():
            tree.add(place, chr(ord("a") + place))
        found.add(tree.total())
    assert len(found) == 1
    (shape,) = found
    assert shape.replace("(", "").replace(")", "") == "abcdefghijklm"[:count]


def test_what_partitions_cannot_do_is_refused(network):
    for job, word in (
        (Job(DgrOptions(), then=LimOptions()), "--then"),
        (Job(DgrOptions(), self_calibration=tls(CAMERA)), "--keep"),
    ):
        with pytest.raises(NotAdjustableError, match=word):
            refuse_in_parts(network, job)


def test_a_large_block_tile_by_tile_is_the_block_as_a_whole():
    block = large_block(CAMERA, DgrOptions(), 3, 5000.0, 1, (2, 2), 60)
    whole = block.whole()
    tiles = [block.network(key) for key in range(4)]
    assert sum(len(tile.rays) for tile in tiles) == len(whole.rays)
    for tile in tiles:
        own = np.array([whole.point_index[id] for id in tile.point_ids])
        np.testing.assert_allclose(tile.approximate_l, whole.approximate_l[own], atol=1e-6)
        np.testing.assert_array_equal(tile.rays_per_point, whole.rays_per_point[own])
    assert len(whole.control) == 2
