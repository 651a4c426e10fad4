"""Building a block: what is refused and why, order of points, approximate points, line times, roles."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import simulate

from triline.solver.adjustment.network import Control, Measurements, build_network, neighbourhood_order
from triline.solver.adjustment.robust import Danish, Huber, Igg3
from triline.solver.camera.line_camera import Lens, LineCamera, straight_line
from triline.solver.geometry.ray_intersection import intersect_rays
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.network import Noise, draw_unknowns


@pytest.fixture(scope="module")
def simulated():
    return simulate(1, DgrOptions(), points=40)


def measurements(network) -> Measurements:
    r = network.rays
    return Measurements(r.point, r.strip, r.ccd, r.line, r.sample, r.sigma_line_px, r.sigma_sample_px)


def rebuilt(network, **changed):
    return build_network(
        network.camera, network.strips, network.point_ids, replace(measurements(network), **changed), network.control
    )


def test_what_cannot_be_used_is_named(simulated):
    network = simulated.network
    m = measurements(network)
    strip, ccd, line, sample = m.strip.copy(), m.ccd.copy(), m.line.copy(), m.sample.copy()
    sigma = m.sigma_line_px.copy()
    strip[0], ccd[1], line[2], sample[3], line[4], sigma[5], strip[6] = 99, -1, 1e7, 20000.0, np.nan, 0.0, -1
    got = rebuilt(network, strip=strip, ccd=ccd, line=line, sample=sample, sigma_line_px=sigma)
    reasons = dict(got.refused)
    assert reasons == {
        0: "unknown strip",
        1: "unknown CCD line",
        2: "outside strip or trajectory",
        3: "beyond the CCD line",
        4: "value is not finite",
        5: "sigma is not positive",
        6: "unknown strip",
    }
    assert len(got.rays) == len(network.rays) - 7
    assert not set(got.rays.source) & set(reasons)


def test_no_usable_ray_is_one_line(simulated):
    with pytest.raises(ValueError, match=r"none of .* rays can be used: unknown strip"):
        rebuilt(simulated.network, strip=np.full(len(simulated.network.rays), 7))


def test_index_of_a_point_that_does_not_exist(simulated):
    with pytest.raises(ValueError, match="point 1000"):
        rebuilt(simulated.network, point=np.full(len(simulated.network.rays), 1000))


def test_rays_keep_their_values_whatever_their_order(simulated):
    network = simulated.network
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(network.rays))
    m = measurements(network)
    mixed = Measurements(*(getattr(m, name)[shuffled] for name in m.__dataclass_fields__ if name != "time_s"))
    got = build_network(network.camera, network.strips, network.point_ids, mixed, network.control, network.check)
    assert got.point_ids == network.point_ids
    np.testing.assert_array_equal(got.rays.line, network.rays.line)
    np.testing.assert_array_equal(got.rays.sample, network.rays.sample)
    np.testing.assert_array_equal(mixed.line[got.rays.source], got.rays.line)
    np.testing.assert_array_equal(np.repeat(np.arange(got.n_points), got.rays_per_point), got.rays.point)
    np.testing.assert_allclose(got.approximate_l, network.approximate_l, atol=1e-6)


def test_approximate_points_are_near(simulated):
    """Orientation errors of decimetres and hundredths of degrees move them by metres at most."""
    error = simulated.network.approximate_l - simulated.points_l
    several = simulated.network.rays_per_point > 2
    assert np.abs(error[several]).max() < 5.0
    assert np.abs(error).max() > 0.01


def test_line_times_from_a_table(simulated):
    strip = simulated.network.strips[0]
    u = np.arange(strip.lines, dtype=float)
    table = replace(strip, line_time_s=strip.time_of(u) + 1e-3 * np.sin(u / 50))
    lines = np.array([0.0, 10.25, 500.5, strip.lines - 1.0])
    below = np.minimum(np.floor(lines), strip.lines - 2).astype(int)
    expected = table.line_time_s[below] + (lines - below) * np.diff(table.line_time_s)[below]
    np.testing.assert_allclose(table.time_of(lines), expected, rtol=1e-14)
    h = 1e-3
    np.testing.assert_allclose(
        (table.time_of(lines[1:3] + h) - table.time_of(lines[1:3] - h)) / (2 * h),
        table.line_period(lines[1:3]),
        rtol=1e-9,
    )
    assert table.contains(lines).all() and not table.contains([-1.0, strip.lines + 1.0]).any()


def test_check_points_and_control_keep_their_roles(simulated):
    network = simulated.network
    role = network.role()
    assert set(role) == {"tie", "control", "check"}
    assert (role == "control").sum() == len(network.control) == 5
    np.testing.assert_allclose(network.check.xyz_l, simulated.points_l[network.check.point])


def test_a_control_point_without_rays_stays_a_tie_point_without_rays_goes(simulated):
    network = simulated.network
    ids = (*network.point_ids, "G", "T")
    c = network.control
    control = Control(
        np.append(c.point, network.n_points), np.vstack([c.xyz_l, [1, 2, 3]]), np.vstack([c.sigma_m, [1, 1, 1]])
    )
    got = build_network(network.camera, network.strips, ids, measurements(network), control)
    assert "G" in got.point_ids and "T" not in got.point_ids
    assert got.rays_per_point[got.point_index["G"]] == 0


def test_neighbours_in_the_order_are_neighbours_on_the_ground():
    xy = np.random.default_rng(0).uniform(0, 1000, (4000, 2))
    order = neighbourhood_order(xy)
    assert sorted(order) == list(range(4000))
    step = np.linalg.norm(np.diff(xy[order], axis=0), axis=1)
    assert np.median(step) < 1.5 * 1000 / np.sqrt(4000)
    assert neighbourhood_order(np.zeros((3, 2))).tolist() == [0, 1, 2]


def test_intersection_of_rays():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3)) * 100
    index = np.repeat(np.arange(20), 3)
    position = rng.normal(size=(60, 3)) * 50 + [0, 0, 2000]
    xyz, known = intersect_rays(position, points[index] - position, index, 22)
    np.testing.assert_allclose(xyz[:20], points, atol=1e-6)
    assert known.tolist() == [True] * 20 + [False] * 2 and np.isnan(xyz[20:]).all()
    parallel, known = intersect_rays(np.zeros((2, 3)), np.array([[0.0, 0, -1], [0, 0, -2]]), np.zeros(2, dtype=int), 1)
    assert not known[0] and np.isnan(parallel).all()


def test_network_without_errors_fits_exactly():
    """Simulation and adjustment agree on every convention: no noise, no residuals."""
    from triline.solver.adjustment.adjustment import adjust

    exact = DgrOptions((1e-9,) * 3, (1e-9,) * 3, (1e-9,) * 3)
    simulated = simulate(4, exact, points=30, noise=Noise(image_px=1e-6, control_m=(1e-7,) * 3, jitter_deg=0.3))
    solution = adjust(simulated.network, DgrOptions())
    # what is left comes from sampling the true trajectory at 100 Hz
    assert np.abs(solution.state.points_l - simulated.points_l).max() < 1e-3


def test_several_lenses_and_principal_points():
    lines = (
        straight_line("F", "A", 8000, 0.0065, (25.0, 0.3)),
        straight_line("B", "B", 8000, 0.0065, (-20.0, -0.2), inclination_rad=1e-3),
    )
    camera = LineCamera("two", (Lens("A", 62.0, (0.05, -0.02)), Lens("B", 63.0, (-0.1, 0.04))), lines)
    simulated = simulate(3, DgrOptions(), points=40, camera=camera)
    rays = simulated.network.rays
    assert set(rays.focal_length_mm) == {62.0, 63.0}
    several = simulated.network.rays_per_point > 2
    assert np.abs(simulated.network.approximate_l - simulated.points_l)[several].max() < 5.0


def test_drawn_unknowns_have_their_apriori_sigmas():
    from triline.solver.models import Extent

    model = DgrOptions((0.1, 0.2, 0.3)).build(Extent("strip S1", 0.0, 10.0))
    rng = np.random.default_rng(1)
    draws = np.array([draw_unknowns(model, rng) for _ in range(2000)])
    np.testing.assert_allclose(draws.std(axis=0), model.pseudo_observations().sigma, rtol=0.08)


@pytest.mark.parametrize("function", [Huber(2.0), Danish(2.0), Igg3(1.5, 4.0)], ids=["huber", "danish", "igg3"])
def test_weight_functions_fall_from_one(function):
    w = np.linspace(0, 100, 1001)
    weight = function(w)
    assert (weight[w <= 1.5] == 1.0).all()
    assert (np.diff(weight) <= 1e-12).all() and (weight >= 0).all()
    assert weight[-1] < 0.05
    with pytest.raises(ValueError, match="IGG III"):
        Igg3(4.0, 1.5)
