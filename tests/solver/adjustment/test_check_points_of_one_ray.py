"""Check points of one ray, as of a camera with one CCD line: how far off they are at their given heights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from adjustment_networks import simulate

from triline.solver.adjustment.job import Job, run
from triline.solver.adjustment.single_looks import single_looks
from triline.solver.camera.line_camera import three_line_camera
from triline.solver.models.dgr import DgrOptions

NADIR = three_line_camera("nadir", 62.7, 12000, 0.0065, {"N": 0.0})
ERRORS = DgrOptions((0.2,) * 3, (0.01,) * 3, (0.005,) * 3)


def adjusted(seed: int, off_m=(0.0, 0.0, 0.0), sigma_m=(1e-6,) * 3):
    """A strip of one CCD line, with given coordinates of check points that are off."""
    network = simulate(seed, ERRORS, NADIR, points=70, strips=1, cross=0).network
    check = network.check
    check = replace(check, xyz_l=check.xyz_l + off_m, sigma_m=np.broadcast_to(sigma_m, check.xyz_l.shape))
    result = run(replace(network, check=check), Job(ERRORS))
    return result, single_looks(result.solution, result.cofactors, result.sigma0)


def test_they_are_off_by_as_much_as_their_sigmas_say():
    """Two-sided, over flights, with given coordinates that have errors of their own."""
    off = []
    for seed in range(12):
        survey = np.random.default_rng(100 + seed).normal(size=3) * (0.1, 0.1, 0.3)
        result, found = adjusted(seed, survey, (0.1, 0.1, 0.3))
        assert len(found.point) == len(result.network.check)
        assert (result.solution.points.rank[found.point] == 2).all()
        assert (found.expected_m > found.sigma_m).all()
        off.append(found.difference_m / found.expected_m)
    assert 0.8 < np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1.2


def test_given_coordinates_that_are_off_move_them_along_the_ray():
    """In X and Y as they are; a height moves the place by the slope of the ray, to the sides of the flight."""
    result, exact = adjusted(3)
    _, east = adjusted(3, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(east.difference_m, exact.difference_m - [1.0, 0.0], atol=1e-9)
    _, higher = adjusted(3, (0.0, 0.0, 1.0))
    moved = higher.difference_m - exact.difference_m
    place = {p: xyz for p, xyz in zip(result.network.check.point, result.network.check.xyz_l, strict=True)}
    across = np.array([place[p][1] / (1800.0 - place[p][2]) for p in exact.point])
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=4e-3)  # looks straight down, but for the attitude
    np.testing.assert_allclose(moved[:, 1], -across, atol=4e-3)
    assert np.abs(across).max() > 0.2


def test_points_of_several_rays_are_none():
    network = simulate(1, ERRORS, points=40).network
    result = run(network, Job(ERRORS))
    assert not len(single_looks(result.solution, result.cofactors, result.sigma0).point)
