"""Sigmas of direct georeferencing, against drawing the errors that the project states."""

import numpy as np

from triline.solver.adjustment.direct_georeferencing import georeference
from triline.solver.camera.sensors import preset
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.models.wander import WanderOptions
from triline.solver.simulation.network import parallel_and_cross, scatter_points, simulate_network


def test_offsets_of_metres_count_beside_wanders_of_a_thousandth_of_a_degree():
    rng = np.random.default_rng(1)
    camera = preset("ads40")
    ground = scatter_points(20, (-1500, 1500, -600, 600), lambda x, y: 0 * x, rng)
    lines = parallel_and_cross(camera, 2000.0, 1, 0, 3000.0)
    tiny = (1e-9, 1e-9, 1e-9)
    network = simulate_network(
        camera, lines, ground, {}, (), DgrOptions(tiny, tiny, tiny), rng, pose_rate_hz=20.0
    ).network
    wander = tuple(np.radians([0.001, 0.001, 0.002]))
    slow = SlowErrors((8.0, 8.0, 12.0), wander, wander, (3.0, 3.0, 4.0), wander, 30.0)
    found = georeference(network, WanderOptions(slow))
    # two looks at a point a minute apart share the offset, and the wander at least in part
    assert (found.sigma_m[:, 0] > 8.0).all() and (found.sigma_m[:, 0] < 10.5).all()
    assert (found.sigma_m[:, 2] > 12.0).all()
    assert (found.sigma_m > found.image_sigma_m).all()
    without = georeference(
        network, WanderOptions(SlowErrors((8.0, 8.0, 12.0), wander, wander, (0.0, 0.0, 0.0), wander, 30.0))
    )
    assert np.abs(without.sigma_m[:, 0] - 8.0).max() < 0.1
