"""Real metadata with known answers: Pleiades, its RPC, SPOT-5."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
import rasterio
from places import DATA, needs_data
from scipy.spatial.transform import Rotation

from triline.nodes.formats.satellite.earth_orientation_file import installed_table
from triline.nodes.formats.satellite.read import read_scene
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.location.pushbroom import SPEED_OF_LIGHT
from triline.solver.orbit.earth_orientation import EarthOrientation
from triline.solver.orbit.time_scales import parse_time

FOLDER = DATA / "satellites"
PLEIADES = FOLDER / "PHRDIMAP_P1BP--2018122638935449CP.XML"
GRID = FOLDER / "GRID_P1BP--2018122638935449CP.tif"
RPC_FILE = FOLDER / "RPC_PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.XML"
SPOT5 = FOLDER / "spot_example1.xml"

pytestmark = needs_data


@pytest.fixture(scope="module")
def pleiades():
    return read_scene(PLEIADES)


@pytest.mark.parametrize("layer", range(9))
def test_pleiades_agrees_with_the_grid_of_the_operator(pleiades, layer):
    with rasterio.open(GRID) as grid:
        lon, lat = np.radians(grid.read([2 * layer + 1, 2 * layer + 2]))
        height = float(grid.tags()[f"ALTITUDE_B{2 * layer}"])
        columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
        step_x, step_y = grid.transform.a, grid.transform.e
        column, row = grid.transform.c + step_x * columns, grid.transform.f + step_y * rows
    # node coordinate + 0.5 = DIMAP pixel, which counts from 1
    located = pleiades.sensor.ground((row + 0.5 - 1).ravel(), (column + 0.5 - 1).ravel(), height)
    wanted = WGS84.cartesian(lat.ravel(), lon.ravel(), height)
    assert np.linalg.norm(located - wanted, axis=1).max() < 0.005


def test_pleiades_agrees_with_its_own_rpc(pleiades):
    """Inside the heights of the polynomials, both ways."""
    rng = np.random.default_rng(1)
    sensor, rpc = pleiades.sensor, pleiades.rpc
    u, v = rng.uniform(0, sensor.lines - 1, 2000), rng.uniform(0, sensor.samples - 1, 2000)
    h = rng.uniform(490.0, 660.0, 2000)
    located = sensor.direct(u, v, h)
    assert np.abs(rpc.inverse(*located.T) - np.stack([u, v], axis=1)).max() < 0.005
    lon, lat = np.radians(rpc.to_ground.at(v, u, h)).T
    assert np.linalg.norm(WGS84.cartesian(lat, lon, h) - sensor.ground(u, v, h), axis=1).max() < 0.005
    back = sensor.inverse(*rpc.direct(u, v, h).T, 1.0)
    assert np.abs(back - np.stack([u, v], axis=1)).max() < 0.005


@pytest.mark.parametrize("height", [-400.0, 9000.0])
@pytest.mark.parametrize("path", [PLEIADES, SPOT5], ids=["pleiades", "spot5"])
def test_round_trip_at_the_ends_of_real_scenes(path, height):
    sensor = read_scene(path).model("rigorous")
    u, v = np.meshgrid(np.linspace(-0.5, sensor.lines - 0.5, 15), np.linspace(-0.5, sensor.samples - 0.5, 9))
    located = sensor.direct(u.ravel(), v.ravel(), height)
    np.testing.assert_allclose(sensor.inverse(*located.T), np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-6)


def test_a_file_with_rpc_alone():
    rpc = read_scene(RPC_FILE).model()
    line, sample = rpc.inverse(np.radians(43.727748394435459), np.radians(7.048662660737770), 0.0)[0]
    # row 200.5 and column 100.5 from the corner of the first pixel
    np.testing.assert_allclose([line + 0.5, sample + 0.5], [200.5, 100.5], atol=1e-3)


@pytest.mark.parametrize(
    ("row", "lat", "lon"), [(1, -76.636309, -75.519946), (96168, -79.298919, -91.818476)], ids=["first", "last"]
)
def test_spot5_corners(row, lat, lon):
    located = read_scene(SPOT5).sensor.ground([row - 1.0], [0.0], 0.0)
    assert np.linalg.norm(located - WGS84.cartesian(np.radians(lat), np.radians(lon), 0.0)) < 0.2


def test_inertial_attitudes_of_pleiades_are_the_earth_fixed_ones_but_for_a_constant_turn(pleiades):
    """Aberration is in the Earth-fixed ones: they point to where light comes from, the others to where it seems to."""
    root = ET.parse(PLEIADES).getroot()

    def quaternions(name, time, scale):
        elements = root.findall(f".//{name}")
        q = np.array([[float(x) for x in e.findtext("Q_VALUES").split()] for e in elements])
        return {parse_time(e.findtext(time), scale): k for e, k in zip(elements, q[:, [1, 2, 3, 0]], strict=True)}

    inertial = quaternions("Accurate_Attitudes/Quaternion_List/Quaternion", "TAI_TIME", "TAI")
    fixed = quaternions("WGS84_Attitudes_List/WGS84_Attitudes", "UTC_TIME", "UTC")
    times = sorted(set(inertial) & set(fixed))
    assert len(times) > 20
    R_ie = EarthOrientation(installed_table(), times[0]).R_ie_at(times)
    of_stars = Rotation.from_quat([inertial[t] for t in times])
    of_earth = Rotation.from_matrix(R_ie) * Rotation.from_quat([fixed[t] for t in times])

    motion = pleiades.sensor.motion
    position, velocity = motion.orbit.at((np.array(times) - pleiades.sensor.reference_ns) * 1e-9)
    v = np.einsum("nij,nj->ni", R_ie, motion.inertial_velocity(position, velocity))
    bend = Rotation.from_rotvec(np.cross(of_earth.apply([0.0, 0.0, 1.0]), v) / SPEED_OF_LIGHT)

    def scatter(turn):
        return np.degrees(np.linalg.norm((turn * turn.mean().inv()).as_rotvec(), axis=1).max()) * 3600.0

    assert scatter(of_stars.inv() * bend * of_earth) < 0.001
    assert scatter(of_stars.inv() * of_earth) > 0.01
