"""Pixel to terrain to cell to pixel, for frame and pushbroom, oblique and bent by the air, over high relief."""

from __future__ import annotations

import numpy as np
import pytest
from relief import Waves
from satellite_scenes import Truth, cartesian, write_dimap2

from triline.nodes.formats.satellite.read import read_scene
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.location.frame_camera import FrameCamera
from triline.solver.location.refraction import Refraction
from triline.solver.rectification.cell_to_pixel import HeightsOfTile, Tile, pixels_of_tile
from triline.solver.rectification.grid import MapGrid, default_crs
from triline.solver.rectification.nodes import lagrange, places
from triline.solver.rectification.occlusion import ground_slopes
from triline.solver.rectification.pixel_to_cell import meet_terrain, mesh_cells
from triline.solver.rectification.sampled import metres_a_radian


def frame_camera(tilt_deg=50.0, **kwargs) -> FrameCamera:
    """A camera on a satellite that looks aside, with a lens that distorts by some pixels."""
    frame = LocalFrame(39.0, 32.0, 0.0)
    C = WGS84.cartesian(np.radians(39.0), np.radians(32.0), 686e3)
    R = frame.R_el @ matrix_from_angles(np.radians(tilt_deg), np.radians(3.0), np.radians(20.0))
    distortion = (3e-6, -1e-9, 0.0, 2e-6, -1e-6)
    return FrameCamera(C, R, 150.0, 0.006, 900, 1100, principal_point_mm=(0.1, -0.2), distortion=distortion, **kwargs)


@pytest.fixture(scope="module")
def pushbroom(tmp_path_factory):
    truth = Truth(lines=1200, samples=900, gsd=1.6e-5, period_s=2.5e-3, tilt_deg=(51.0, -5.0, 2.0))
    return read_scene(write_dimap2(tmp_path_factory.mktemp("scene") / "scene.xml", truth)).model()


def models(pushbroom):
    return {
        "frame": frame_camera(refraction=Refraction()),
        "pushbroom": pushbroom.with_refraction(Refraction()),
    }


def zenith_deg(model) -> float:
    """Zenith angle of the ray in the middle of the image, on the ground, from two heights of it."""
    u, v = np.array([0.5 * model.lines]), np.array([0.5 * model.samples])
    low, high = (cartesian(model.direct(u, v, np.array([h])))[0] for h in (0.0, 1000.0))
    lat, lon, _ = model.direct(u, v, np.array([0.0]))[0]
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    d = high - low
    return float(np.degrees(np.arccos(d @ up / np.linalg.norm(d))))


@pytest.mark.parametrize("kind", ["frame", "pushbroom"])
def test_pixel_to_terrain_to_pixel(pushbroom, kind):
    model = models(pushbroom)[kind]
    assert 58.0 < zenith_deg(model) < 70.0
    relief = Waves.under(model)
    rng = np.random.default_rng(1)
    line, sample = rng.uniform(0, model.lines - 1, 2000), rng.uniform(0, model.samples - 1, 2000)
    ground = meet_terrain(model, line, sample, relief, 0.0, 1000.0)
    assert np.isfinite(ground.lat).mean() > 0.99
    met = np.isfinite(ground.lat)
    height = relief.at(ground.lat[met], ground.lon[met])
    assert np.ptp(height) > 950.0
    # the point lies on the terrain, and the model sees it in the pixel it came from
    assert np.abs(ground.height_m[met] - height).max() < 0.02
    back = model.inverse(ground.lat[met], ground.lon[met], ground.height_m[met], 1.0)
    assert np.abs(back - np.stack([line, sample], axis=1)[met]).max() < 0.01


class OverSlopingGeoid(Waves):
    """Waves above a geoid that slopes as in high mountains, and is not known beyond the raster."""

    def undulation(self, lat, lon):
        row, column = self.place(np.asarray(lat), np.asarray(lon))
        inside = (row >= 0) & (row <= self.rows - 1) & (column >= 0) & (column <= self.columns - 1)
        return np.where(inside, 40.0 + 2e-4 * 6.37e6 * (np.asarray(lat) - np.radians(self.lat_deg)), np.nan)


def test_rays_meet_terrain_above_the_geoid_of_the_place_where_they_do():
    """Above that of their place at the mean height points were decimetres off, and lost near the edge of the geoid."""
    model = frame_camera()
    relief = OverSlopingGeoid.under(model)
    line, sample = (a.ravel() for a in np.mgrid[0 : model.lines : 12, 0 : model.samples : 12].astype(float))
    met = meet_terrain(model, line, sample, relief, -300.0, 1050.0)
    assert np.isfinite(met.lat).mean() > 0.99
    height = relief.at(met.lat, met.lon) + relief.undulation(met.lat, met.lon)
    assert np.nanmax(np.abs(met.height_m - height)) < 0.01
    # a raster whose edges, one of them high, lie in the image
    row, _ = relief.place(met.lat, met.lon)
    first, last = 82, 138
    part = OverSlopingGeoid(
        relief.lat_deg - first * relief.step_deg, relief.lon_deg, relief.step_deg, last - first, relief.columns
    )
    part.z = relief.z[first:last]
    again = meet_terrain(model, line, sample, part, -300.0, 1050.0)
    inside = (row > first + 1) & (row < last - 2)
    assert inside.any() and np.isfinite(again.lat[inside]).all()


class Fine:
    """Heights of 500 m in cells of 4 m over all of an image of 30 km, of which no large window is read."""

    cell_m = 4.0
    largest = 0

    def place(self, lat, lon):
        return (np.radians(40.0) - np.asarray(lat)) * 6.37e6 / 4.0, (np.asarray(lon) - np.radians(31.0)) * 5e6 / 4.0

    def undulation(self, lat, lon):
        return np.zeros(np.shape(lat))

    def heights(self, row: int, column: int, rows: int, columns: int) -> np.ndarray:
        assert rows * columns < 6e6, f"a window of {rows} x {columns} values"
        self.largest = max(self.largest, rows * columns)
        return np.full((rows, columns), 500.0, dtype=np.float32)


def test_pixels_far_from_each_other_take_small_windows_of_a_fine_raster():
    """The edge of an image took a window as large as the image: 2.3 GB of 11 000 x 11 000 values."""
    model, fine = frame_camera(), Fine()
    line, sample = (a.ravel() for a in np.mgrid[0 : model.lines - 1 : 5j, 0 : model.samples - 1 : 5j])
    met = meet_terrain(model, line, sample, fine, 490.0, 510.0)
    row, column = fine.place(met.lat, met.lon)
    assert np.ptp(row) * np.ptp(column) > 1e8 and fine.largest > 0
    assert np.abs(met.height_m - 500.0).max() < 1e-3
    level = meet_terrain(model, line, sample, 500.0)
    assert np.allclose(met.lat, level.lat, rtol=0, atol=1e-9) and np.allclose(met.lon, level.lon, rtol=0, atol=1e-9)
    slope = ground_slopes(fine, met.lat, met.lon, met.height_m, WGS84)
    assert slope.shape == (25, 2) and np.abs(slope).max() == 0.0


@pytest.mark.parametrize("kind", ["frame", "pushbroom"])
def test_cells_see_the_pixels_that_the_model_says_and_both_ways_agree(pushbroom, kind):
    model = models(pushbroom)[kind]
    relief = Waves.under(model)
    middle = model.direct(np.array([0.5 * model.lines]), np.array([0.5 * model.samples]), np.array([500.0]))[0]
    grid = MapGrid(default_crs(middle[0], middle[1]), 0.0, 0.0, 30.0, 0, 0)
    x, y = grid.map(middle[:1], middle[1:2])
    grid = grid.over(np.array([x[0] - 3000, x[0] + 3000]), np.array([y[0] - 3000, y[0] + 3000]))
    whole = np.full((2, grid.rows, grid.columns), np.nan)
    for tile, pixels in pixels_of_tile(model, Tile(0, 0, grid.rows, grid.columns), grid.where, relief):
        here = slice(tile.row, tile.row + tile.rows), slice(tile.column, tile.column + tile.columns)
        whole[0][here] = pixels.line + np.float64(pixels.origin[0])
        whole[1][here] = pixels.sample + np.float64(pixels.origin[1])
    assert np.isfinite(whole).all()
    rng = np.random.default_rng(2)
    i, j = rng.integers(0, grid.rows, 500), rng.integers(0, grid.columns, 500)
    lat, lon = grid.where(j, i)
    true = model.inverse(lat, lon, relief.at(lat, lon), 1.0)
    assert np.abs(whole[:, i, j].T - true).max() < 0.01

    # the direct way over the same cells: a mesh of every pixel
    u0, v0 = np.floor(whole.min(axis=(1, 2))) - 1
    u1, v1 = np.ceil(whole.max(axis=(1, 2))) + 1
    mesh = mesh_cells(model, grid, np.arange(u0, u1 + 1), np.arange(v0, v1 + 1), relief, 0.0, 1000.0)
    assert mesh is not None and mesh.line.shape == (grid.rows, grid.columns)
    # no ground is hidden here: slopes are gentler than the rays
    apart = np.maximum(np.abs(mesh.line - whole[0]), np.abs(mesh.sample - whole[1]))
    assert apart.max() < 0.05
    assert np.percentile(apart, 90) < 0.002


class Counted:
    """A model that counts how often it is asked."""

    def __init__(self, model):
        self.model, self.lines, self.samples, self.asked = model, model.lines, model.samples, 0

    def inverse(self, lat, lon, height_m, margin_px):
        self.asked += len(np.ravel(lat))
        return self.model.inverse(lat, lon, height_m, margin_px)


@pytest.mark.parametrize("relief_m", [50.0, 400.0])
def test_relief_of_a_third_of_the_flying_height_asks_the_model_at_few_places(relief_m):
    """Pixels are no parabola of the height there; every cell was asked for its own."""
    frame = LocalFrame(39.0, 32.0, 0.0, "EPSG:32636")
    east, north, _ = frame.to_crs(np.zeros((1, 3)))[0]
    R = frame.R_el @ matrix_from_angles(np.radians(4.0), np.radians(3.0), np.radians(20.0))
    camera = FrameCamera(WGS84.cartesian(np.radians(39.0), np.radians(32.0), 1200.0), R, 60.0, 0.01, 2000, 2000)
    grid = MapGrid("EPSG:32636", east - 51.2, north + 51.2, 0.2, 512, 512)
    y, x = np.mgrid[0:512, 0:512]
    z = (0.5 * relief_m * (1.0 + np.sin(x / 40.0) * np.cos(y / 50.0))).astype(np.float32)
    heights = HeightsOfTile(z, z, z, z, np.zeros(1, dtype=np.float32))
    counted = Counted(camera)
    ((_, pixels),) = pixels_of_tile(counted, Tile(0, 0, 512, 512), grid.where, None, heights)
    assert counted.asked < 2000
    lat, lon = grid.where(x.ravel().astype(float), y.ravel().astype(float))
    true = camera.inverse(lat, lon, z.ravel().astype(float), 1000.0)
    for got, origin, want in zip((pixels.line, pixels.sample), pixels.origin, true.T, strict=True):
        assert np.abs(got.ravel() + origin - want).max() < 0.01


@pytest.mark.parametrize("k1", [-8e-4, 1e-3])
def test_derivatives_of_a_wide_lens_hold_its_distortion(k1):
    """A shift of the camera of a metre moves the ground by a metre, at the corners of a wide image too."""
    C, R = WGS84.cartesian(np.radians(47.0), np.radians(8.0), 600.0), LocalFrame(47.0, 8.0, 0.0).R_el
    camera = FrameCamera(C, R, 10.0, 0.02, 600, 800, distortion=(k1, 1e-6, 0.0, 2e-4, -1e-4))
    line, sample, height = np.array([5.0, 300.0, 590.0]), np.array([10.0, 420.0, 50.0]), np.full(3, 500.0)
    located = camera.direct(line, sample, height)
    J = camera.image_derivatives(line, sample, height)
    for k in range(3):
        moved = camera.with_orientation(C + 0.01 * R[:, k], R)
        change = (moved.inverse(*located.T, 50.0) - np.stack([line, sample], axis=1)) / 0.01
        np.testing.assert_allclose(J[:, :, k], change, atol=2e-3 * np.abs(change).max())
    beside = (camera.direct(line + 0.01, sample, height), camera.direct(line, sample + 0.01, height))
    by_pixel = np.stack([(p - located)[:, [1, 0]] / 0.01 for p in beside], axis=-1)
    east, north = metres_a_radian(located[:, 0], height, WGS84)
    by_shift = by_pixel * np.stack([east, north], axis=1)[:, :, None] @ J[:, :, :2]
    np.testing.assert_allclose(by_shift, np.broadcast_to(-np.eye(2), (3, 2, 2)), atol=3e-3)


@pytest.mark.parametrize(
    ("k1", "seen"),
    [
        (0.005, 1.0),  # by so much that a fixed point runs away from it
        (-1.5e-3, 0.99),  # turns back at the corners, 10 mm from the middle
        (-0.05, 0.05),  # of a lens whose distortion is in units of the focal length
    ],
)
def test_distortion_is_taken_off_as_far_as_it_goes(k1, seen):
    C, R = WGS84.cartesian(np.radians(47.0), np.radians(8.0), 600.0), LocalFrame(47.0, 8.0, 0.0).R_el
    camera = FrameCamera(C, R, 10.0, 0.02, 600, 800, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    line, sample = (a.ravel() for a in np.meshgrid(np.linspace(0.0, 599.0, 61), np.linspace(0.0, 799.0, 81)))
    ideal = camera.image_mm(line, sample)
    known = np.isfinite(ideal).all(axis=1)
    assert known.mean() == pytest.approx(seen, abs=0.01)
    assert np.abs(camera.pixel_of(ideal) - np.stack([line, sample], axis=1))[known].max() < 1e-7
    # the ideal place of a pixel lies between the middle and where the distortion turns back
    r = np.linalg.norm(ideal[known], axis=1)
    assert (1.0 + 3.0 * k1 * r**2 > 0.0).all()
    located = camera.direct(line, sample, np.full(len(line), 500.0))
    assert (np.isfinite(located[:, 0]) == known).all()
    assert np.abs(camera.inverse(*located[known].T) - np.stack([line, sample], axis=1)[known]).max() < 1e-5
    if k1 < 0:  # ground beyond comes back into the image
        lat, lon, _ = WGS84.geodetic(C + R @ np.array([[0.0, 1.2 * 10.0 / np.sqrt(-3.0 * k1), -100.0]]).T[:, 0])
        assert np.isnan(camera.inverse(lat, lon, 500.0)).all()


def test_frame_camera_derivatives_by_its_orientation():
    camera = frame_camera(30.0)
    line, sample, height = (
        np.array([10.0, 500.0, 880.0]),
        np.array([1000.0, 20.0, 555.0]),
        np.array([0.0, 300.0, 900.0]),
    )
    located = camera.direct(line, sample, height)
    J = camera.image_derivatives(line, sample, height)
    lat, lon, _ = WGS84.geodetic(camera.position_e)
    axes = LocalFrame(float(np.degrees(lat)), float(np.degrees(lon)), 0.0).R_el
    for k in range(6):
        step = 1.0 if k < 3 else 1e-6
        C, R = camera.position_e, camera.R_ec
        if k < 3:
            C = C + step * axes[:, k]
        else:
            from scipy.spatial.transform import Rotation

            R = Rotation.from_rotvec(step * axes[:, k - 3]).as_matrix() @ R
        moved = FrameCamera(
            C, R, 150.0, 0.006, 900, 1100, principal_point_mm=camera.principal_point_mm, distortion=camera.distortion
        )
        change = (moved.inverse(*located.T, 50.0) - np.stack([line, sample], axis=1)) / step
        assert np.allclose(J[:, :, k], change, rtol=1e-3, atol=1e-4 * np.abs(change).max())


def test_an_image_smaller_than_a_tile_without_anything_around_it(tmp_path):
    truth = Truth(lines=40, samples=30, gsd=1.6e-5, period_s=2.5e-3)
    model = read_scene(write_dimap2(tmp_path / "s.xml", truth)).model()
    located = model.direct(np.array([20.0]), np.array([15.0]), np.array([0.0]))[0]
    grid = MapGrid(default_crs(located[0], located[1]), 0.0, 0.0, 25.0, 0, 0)
    x, y = grid.map(located[:1], located[1:2])
    # not in the middle of the tile, where a node is
    grid = grid.over(np.array([x[0] - 2000, x[0] + 3500]), np.array([y[0] - 3300, y[0] + 2100]))
    u, v = (a.ravel() for a in np.meshgrid(np.arange(40.0), np.arange(30.0)))
    ground = model.direct(u, v, np.zeros(len(u)))
    footprint = np.stack(grid.cells(ground[:, 0], ground[:, 1]), axis=1)
    seen = 0
    for _, pixels in pixels_of_tile(model, Tile(0, 0, grid.rows, grid.columns), grid.where, 0.0, footprint=footprint):
        line, sample = pixels.line + pixels.origin[0], pixels.sample + pixels.origin[1]
        with np.errstate(invalid="ignore"):
            seen += int(((line >= -0.5) & (line <= 39.5) & (sample >= -0.5) & (sample <= 29.5)).sum())
    row, column = np.mgrid[0 : grid.rows, 0 : grid.columns]
    true = model.inverse(*grid.where(column.ravel(), row.ravel()), 0.0, 0.0)
    assert seen == np.isfinite(true[:, 0]).sum() > 200


@pytest.mark.parametrize("length", [2, 3, 16, 64])
@pytest.mark.parametrize("count", [2, 3, 9])
def test_polynomials_through_nodes_of_a_tile(length, count):
    """Exact for polynomials of that order, at nodes and between; without a warning of NumPy in a tile of two cells."""
    nodes, cells = places(length, count), np.arange(length, dtype=float)
    with np.errstate(all="raise"):
        weights = lagrange(nodes, cells)
    np.testing.assert_allclose(weights @ (nodes / length) ** (count - 1), (cells / length) ** (count - 1), atol=1e-12)
