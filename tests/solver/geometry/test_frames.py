"""The ellipsoid, the local frame and coordinate reference systems, against PROJ and round trips."""

import subprocess
import sys
import warnings

import numpy as np
import pyproj
import pytest
from pyproj.transformer import TransformerGroup

from triline.solver.geometry import earth
from triline.solver.geometry.frames import (
    CrsError,
    LocalFrame,
    R_lc_from_navigation,
    navigation_from_R_lc,
    opk_covariance_from_navigation,
    outside_area,
)
from triline.solver.geometry.rotation import angles_from_matrix, matrix_from_angles, matrix_from_navigation

RNG = np.random.default_rng(11)
LAT, LON, H = RNG.uniform(-89, 89, 60), RNG.uniform(-180, 180, 60), RNG.uniform(-100, 12000, 60)
ZURICH = LocalFrame(47.4, 8.5, 500.0)


def test_earth_fixed_coordinates_agree_with_proj():
    proj = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    expected = np.column_stack(proj.transform(LON, LAT, H))
    ours = earth.ecef_from_geodetic(np.radians(LAT), np.radians(LON), H)
    np.testing.assert_allclose(ours, expected, atol=1e-7)
    back = earth.geodetic_from_ecef(expected)
    np.testing.assert_allclose(np.degrees(back[:, 0]), LAT, atol=1e-12)
    np.testing.assert_allclose(np.degrees(back[:, 1]), LON, atol=1e-12)
    np.testing.assert_allclose(back[:, 2], H, atol=1e-7)


def test_normal_gravity_at_known_places():
    assert earth.normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert earth.normal_gravity(np.pi / 2, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    # GRS 80/WGS 84 value at 45 degrees and the free-air gradient
    assert earth.normal_gravity(np.pi / 4, 0.0) == pytest.approx(9.806197769, abs=1e-8)
    gradient = (earth.normal_gravity(np.pi / 4, 1000.0) - earth.normal_gravity(np.pi / 4, 0.0)) / 1000.0
    assert gradient == pytest.approx(-3.085e-6, rel=1e-3)


def closed_normal_gravity(lat, h):
    """North and down, m/s^2, by the closed formula in ellipsoidal coordinates (NIMA TR8350.2, 4-5 to 4-15)."""
    a, b = earth.SEMI_MAJOR_M, earth.SEMI_MAJOR_M * (1.0 - earth.FLATTENING)
    E, w2 = np.sqrt(a * a - b * b), earth.ROTATION_RATE**2
    p, z = np.hypot(*earth.ecef_from_geodetic(lat, 0.0, h)[:2]), earth.ecef_from_geodetic(lat, 0.0, h)[2]
    r2 = p * p + z * z - E * E
    u = np.sqrt(0.5 * r2 * (1.0 + np.sqrt(1.0 + (2.0 * E * z / r2) ** 2)))
    v = np.hypot(u, E)
    s, c = np.sin(np.arctan2(z * v, u * p)), np.cos(np.arctan2(z * v, u * p))
    W = np.sqrt(u * u + (E * s) ** 2) / v
    q, q0 = (0.5 * ((1.0 + 3.0 * (x / E) ** 2) * np.arctan2(E, x) - 3.0 * x / E) for x in (u, b))
    dq = 3.0 * (1.0 + (u / E) ** 2) * (1.0 - u / E * np.arctan2(E, u)) - 1.0
    along = -(earth.GM / v**2 + w2 * a * a * E / v**2 * dq / q0 * (0.5 * s * s - 1.0 / 6.0)) / W + w2 * u * c * c / W
    across = (w2 * a * a / v * q / q0 - w2 * v) * s * c / W
    gp, gz = (u / v * c * along - s * across) / W, (s * along + u / v * c * across) / W
    return np.cos(lat) * gz - np.sin(lat) * gp, -np.cos(lat) * gp - np.sin(lat) * gz


@pytest.mark.parametrize("lat_deg", [-45.0, 0.0, 20.0, 70.0])
@pytest.mark.parametrize("h", [0.0, 1000.0, 20_000.0])
def test_gravity_is_that_of_the_closed_formula(lat_deg, h):
    """Without its lean to the equator at height, levels at 20 km were 0.001 deg off."""
    lat = np.radians(lat_deg)
    north, down = closed_normal_gravity(lat, h)
    g = earth.gravity_n(lat, h)
    assert g[1] == 0.0
    assert g[0] == pytest.approx(north, abs=5e-7)
    assert g[2] == pytest.approx(down, abs=2e-6)


def test_curvature_radii_are_arc_lengths_of_proj():
    geod = pyproj.Geod(ellps="WGS84")
    lat = np.radians(47.0)
    R_N, R_E = earth.curvature_radii(lat)
    step = 1e-4
    _, _, north = geod.inv(8.0, 47.0 - step, 8.0, 47.0 + step)
    _, _, east = geod.inv(8.0 - step, 47.0, 8.0 + step, 47.0)
    assert north / np.radians(2 * step) == pytest.approx(float(R_N), rel=1e-7)
    assert east / np.radians(2 * step) == pytest.approx(float(R_E) * np.cos(lat), rel=1e-7)


def test_local_frame_agrees_with_proj_topocentric_and_round_trips():
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=8.5 +lat_0=47.4 +h_0=500"
    )
    lat, lon, h = 47.4 + RNG.normal(0, 0.1, 30), 8.5 + RNG.normal(0, 0.1, 30), RNG.uniform(300, 3000, 30)
    expected = np.column_stack(pipeline.transform(lon, lat, h))
    local = ZURICH.from_geodetic(lat, lon, h)
    np.testing.assert_allclose(local, expected, atol=1e-6)
    np.testing.assert_allclose(ZURICH.to_geodetic(local), np.column_stack([lat, lon, h]), atol=1e-8)


def test_projected_crs_round_trip_and_convergence():
    frame = LocalFrame(47.4, 8.5, 0.0, "EPSG:32632")
    xyz = np.array([[465000.0, 5250000.0, 450.0], [460000.0, 5245000.0, 900.0]])
    local = frame.from_crs(xyz)
    np.testing.assert_allclose(frame.to_crs(local), xyz, atol=1e-5)
    # grid north lies off true north by the meridian convergence
    convergence = pyproj.Proj("EPSG:32632").get_factors(8.5, 47.4).meridian_convergence
    R = frame.R_l_crs(frame.to_crs(np.zeros((1, 3))))[0]
    grid_north = R[:, 1]
    assert np.degrees(np.arctan2(grid_north[0], grid_north[1])) == pytest.approx(convergence, abs=1e-4)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_a_frame_across_the_date_line():
    xyz = np.array([[179.99, 10.0, 0.0], [-179.97, 10.02, 3.0]])
    frame = LocalFrame.around(xyz, "EPSG:4979")
    assert (frame.lat_deg, frame.lon_deg) == (10.01, -179.99)
    local = frame.from_crs(xyz)
    assert np.abs(local).max() < 3000.0
    np.testing.assert_allclose(frame.to_crs(local), xyz, atol=1e-9)
    grad = LocalFrame.around([[199.9, 50.0, 0.0], [-199.9, 50.0, 0.0]], "EPSG:4807")  # Paris, in grad
    assert abs(grad.lon_deg) == pytest.approx(177.66, abs=0.02)


@pytest.mark.parametrize("crs", ["EPSG:5513", "EPSG:2065", "EPSG:5513+EPSG:5773"])
def test_left_handed_axes_have_no_angles(crs):
    """Krovak's south and west: the angles of an image there, read again, were those of another attitude."""
    with pytest.raises(CrsError, match="its axes go south and west, and angles in a left-handed system are none"):
        LocalFrame.around(np.array([[1_058_147.0, 703_011.0, 300.0]]), crs)


def test_heights_that_count_downwards_have_no_angles():
    """A block with depths ended as a fault of triline, a rotation with a determinant of -1."""
    with pytest.raises(CrsError, match="its heights count downwards, and angles in a left-handed system are none"):
        LocalFrame.around([[500_000.0, 5_300_000.0, -500.0]], "EPSG:32632+EPSG:5715")


@pytest.mark.parametrize(
    "crs, place", [("EPSG:5514", (50.0, 15.0)), ("EPSG:2053", (-26.0, 29.2)), ("EPSG:2193", (-40, 175))]
)
def test_angles_in_axes_to_the_south_or_with_the_northing_first(crs, place):
    frame = LocalFrame(*place, 0.0, crs)
    R_l_crs = frame.R_l_crs(frame.to_crs(np.zeros((1, 3))))
    R_lc = R_lc_from_navigation(frame, np.zeros((1, 3)), np.radians([[2.0, 1.0, 30.0]]))
    angles = angles_from_matrix(np.swapaxes(R_l_crs, 1, 2) @ R_lc)
    rpy = navigation_from_R_lc(frame, np.zeros((1, 3)), R_l_crs @ matrix_from_angles(*angles.T))
    np.testing.assert_allclose(np.degrees(rpy), [[2.0, 1.0, 30.0]], atol=1e-9)


@pytest.mark.parametrize(
    "crs", [pyproj.CRS("EPSG:32632").to_wkt(), "+proj=utm +zone=32 +ellps=GRS80 +no_defs", "+proj=longlat"]
)
def test_the_code_of_a_vertical_crs_behind_anything_but_a_code(crs):
    """PROJ does not read it, and heights above the geoid would be ellipsoidal ones."""
    for more in ("+EPSG:5773", " + EPSG:5773"):
        with pytest.raises(
            CrsError, match="a vertical CRS behind '\\+' goes with codes, wanted them as one compound WKT"
        ):
            LocalFrame.around(np.array([[600000.0, 5300000.0, 500.0]]), crs + more)
    assert LocalFrame(48.0, 11.0, 0.0, crs).units[2] == "m"


def test_unknown_crs_is_named():
    with pytest.raises(CrsError, match="EPSG:999999"):
        LocalFrame(0, 0, 0, "EPSG:999999").from_crs(np.zeros((1, 3)))


def test_navigation_angles_to_local_and_back_include_convergence():
    position = np.array([[30000.0, 20000.0, 2000.0], [0.0, 0.0, 1500.0]])
    rpy = np.radians([[1.0, -2.0, 135.0], [0.5, 0.3, 10.0]])
    R_lc = R_lc_from_navigation(ZURICH, position, rpy)
    np.testing.assert_allclose(navigation_from_R_lc(ZURICH, position, R_lc), rpy, atol=1e-12)
    # level flight to the north at the origin: x forward = north, y left = west, z up
    R = R_lc_from_navigation(ZURICH, np.zeros((1, 3)), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    # heading east at 30 km east: kappa = 0 at the origin, off by the convergence out there
    kappa = angles_from_matrix(R_lc_from_navigation(ZURICH, position[:1], np.radians([[0, 0, 90.0]])))[0, 2]
    convergence = (ZURICH.to_geodetic(position[:1])[0, 1] - 8.5) * np.sin(np.radians(47.4))
    assert np.degrees(kappa) == pytest.approx(convergence, abs=2e-3)


def test_attitude_covariance_by_sampling():
    position, rpy = np.zeros(3), np.radians([2.0, -3.0, 130.0])
    cov = np.diag(np.radians([0.01, 0.02, 0.05]) ** 2)
    R_ln = ZURICH.R_ln(position)
    R_lc = R_lc_from_navigation(ZURICH, position, rpy)
    J_cov = opk_covariance_from_navigation(rpy, R_lc, R_ln, cov)
    samples = rpy + RNG.multivariate_normal(np.zeros(3), cov, 20000)
    R = R_ln @ matrix_from_navigation(*samples.T) @ np.diag([1.0, -1, -1])
    empirical = np.cov(angles_from_matrix(R).T)
    np.testing.assert_allclose(empirical, J_cov, rtol=0.05, atol=0.05 * J_cov.max())


BORDER = """
import sys
import numpy as np
from pyproj import datadir
datadir.append_data_dir(sys.argv[1])
from triline.solver.geometry.frames import CrsError, LocalFrame
for place in ((600000, 5300000, 500), (600000, 5000000, 500)):
    frame = LocalFrame(47.0, 10.0, 0.0, "EPSG:25832+7837")
    try:
        local = frame.from_crs(np.array([place]))
        print(round(float(frame.to_geodetic(local)[0, 2]), 3), round(float(frame.to_crs(local)[0, 2]), 3))
    except CrsError as error:
        print(error)
try:
    LocalFrame(45.0, 10.0, 0.0, "EPSG:25832+7837").to_crs(np.zeros((1, 3)))
except CrsError as error:
    print(error)
"""


def test_heights_end_where_their_geoid_ends(tmp_path):
    """Beyond the grid of a geoid PROJ takes heights as they stand: a block had a step of 47 m at the border."""
    rasterio = pytest.importorskip("rasterio")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup("EPSG:25832+7837", "EPSG:4979", always_xy=True)
    grids = {grid.short_name for way in group.unavailable_operations for grid in way.grids if not grid.available}
    if len(grids) != 1:
        pytest.skip("PROJ has the geoid here, or wants more than one grid")
    shape = {"driver": "GTiff", "width": 100, "height": 90, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(
        tmp_path / grids.pop(), "w", transform=rasterio.Affine(0.1, 0, 5.5, 0, -0.1, 56.0), **shape
    ) as grid:  # from 47 to 56 degrees north
        grid.write(np.full((1, 90, 100), 47.0, dtype=np.float32))
        grid.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        grid.set_band_description(1, "geoid_undulation")
    done = subprocess.run([sys.executable, "-c", BORDER, str(tmp_path)], capture_output=True, text=True, check=True)
    outside = "coordinates outside the area of 'EPSG:25832+7837'"
    assert done.stdout.splitlines() == ["547.0 500.0", outside, outside]


@pytest.mark.parametrize(
    ("crs", "place", "outside_deg"),
    [
        ("EPSG:32632", (48.0, 9.0), 0.0),
        ("EPSG:32632", (48.0, 13.5), 1.5),
        ("EPSG:32632", (-10.0, 9.0), 10.0),
        ("EPSG:32601", (10.0, 179.0), 1.0),  # 180 W to 174 W
        ("EPSG:3832", (0.0, -179.0), 0.0),  # the Pacific, on both sides of the date line
        ("EPSG:4326", (0.0, 190.0), 0.0),
        ("+proj=utm +zone=32", (48.0, 90.0), 0.0),  # nobody states an area
    ],
)
def test_how_far_a_place_is_outside_the_area_of_a_crs(crs, place, outside_deg):
    assert outside_area(crs, *place)[0] == pytest.approx(outside_deg, abs=0.01)


@pytest.mark.parametrize(
    ("crs", "lat", "lons", "back_m"),
    [
        ("EPSG:2056", 47.0, (7.0, 8.0), 1e-5),
        ("EPSG:5514", 49.0, (18.5, 19.5), 0.01),  # PROJ itself takes it back to 5 mm
        ("EPSG:4807", 47.0, (1.0, 2.0), 1e-5),
    ],
    ids=["Swiss", "Krovak, where PROJ changes operation", "Paris, grads"],
)
def test_heights_in_a_crs_without_heights_are_those_of_gnss(crs, lat, lons, back_m):
    """PROJ takes them from the ellipsoid of the CRS, 45 m away, and in a part of EPSG:5514 not: a step in a block."""
    at = np.array([[lat, lon, h] for lon in lons for h in (0.0, 600.0, 3000.0)])
    frame = LocalFrame(lat, lons[0], 0.0, crs)
    position = frame.from_geodetic(*at.T)
    in_crs = frame.to_crs(position)
    np.testing.assert_allclose(in_crs[:, 2], at[:, 2], atol=1e-6)
    np.testing.assert_allclose(frame.from_crs(in_crs), position, atol=back_m)
    whole = pyproj.Transformer.from_crs(pyproj.CRS(crs).to_3d(), "EPSG:4979", always_xy=True)
    x, y, _ = whole.transform(at[:, 1], at[:, 0], at[:, 2], direction="INVERSE")
    np.testing.assert_allclose(in_crs[:, 0], x, atol=1e-6)
    np.testing.assert_allclose(in_crs[:, 1], y, atol=1e-6)
    one = LocalFrame.around(in_crs[1], crs)
    np.testing.assert_allclose([one.lat_deg, one.lon_deg], at[1, :2], atol=1e-6)
