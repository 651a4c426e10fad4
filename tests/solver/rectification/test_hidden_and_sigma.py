"""Hidden ground against a shadow that can be drawn on paper; sigmas against errors that were drawn."""

from __future__ import annotations

import numpy as np
import pytest
from relief import Waves

from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.location.frame_camera import FrameCamera
from triline.solver.rectification.cell_to_pixel import Tile, heights_of_tile, pixels_of_tile
from triline.solver.rectification.error_map import sigmas_of_tile
from triline.solver.rectification.grid import MapGrid
from triline.solver.rectification.occlusion import hidden, reach_cells
from triline.solver.rectification.pixel_to_cell import meet_terrain
from triline.solver.rectification.sampled import metres_a_radian, over_cells, some_cells

FRAME = LocalFrame(45.0, 9.0, 0.0)


def camera(east_m=0.0, north_m=0.0, up_m=500e3, turn=(0.0, 0.0, 0.0), tilt_deg=45.0) -> FrameCamera:
    """500 km up, looking west of it (the camera is east of the ground) by 45 degrees of tilt."""
    C = FRAME.origin_e + FRAME.R_el @ np.array([east_m, north_m, up_m])
    R = FRAME.R_el @ matrix_from_angles(0.0, np.radians(tilt_deg), 0.0)
    from scipy.spatial.transform import Rotation

    axes = FRAME.R_el
    R = Rotation.from_rotvec(axes @ np.asarray(turn)).as_matrix() @ R
    return FrameCamera(C, R, 500.0, 0.01, 1000, 1000)


def cells(model, grid, terrain):
    tile = Tile(0, 0, grid.rows, grid.columns)
    heights = heights_of_tile(tile, grid.where, terrain, 60.0)
    ((part, pixels),) = pixels_of_tile(model, tile, grid.where, terrain, heights)
    assert part == tile
    line, sample = pixels.line + np.float64(pixels.origin[0]), pixels.sample + np.float64(pixels.origin[1])
    return heights, line, sample, pixels.height_m


def ground_grid(model, gsd=20.0, size=100) -> MapGrid:
    middle = model.direct(np.array([499.5]), np.array([499.5]), np.array([0.0]))[0]
    grid = MapGrid("EPSG:32632", 0.0, 0.0, gsd, 0, 0)
    x, y = grid.map(middle[:1], middle[1:2])
    half = 0.5 * gsd * size
    return grid.over(np.array([x[0] - half, x[0] + half]), np.array([y[0] - half, y[0] + half]), 0.0)


class Wall(Waves):
    """Level ground with a wall from north to south, five values wide."""

    def raised(self, lon: float, height_m: float) -> Wall:
        self.z[:] = 0.0
        _, column = self.place(0.0, lon)
        self.wall = int(np.rint(column))
        self.z[:, self.wall - 2 : self.wall + 3] = height_m
        return self


def test_shadow_of_a_wall_is_as_long_as_the_ray_is_flat():
    model = camera()
    grid = ground_grid(model)
    lon = grid.where(np.array([50.0]), np.array([50.0]))[1]
    wall = Wall.under(model, 1500).raised(float(lon[0]), 300.0)
    heights, line, sample, height = cells(model, grid, wall)
    some = some_cells(line, sample, height, np.ones(line.shape, dtype=bool))
    blocked = hidden(model, some, heights, wall, np.ones(line.shape, dtype=bool), WGS84)
    # way of a ray from the top of the wall to the ground, west of it
    low, high = (model.direct(np.array([499.5]), np.array([499.5]), np.array([h]))[0] for h in (0.0, 300.0))
    east = metres_a_radian(low[:1], 0.0, WGS84)[0][0]
    shadow_m = (high[1] - low[1]) * east
    assert 250.0 < shadow_m < 500.0
    row, column = np.mgrid[0 : grid.rows, 0 : grid.columns]
    at = grid.where(column.ravel(), row.ravel())[1].reshape(row.shape)
    west = (np.radians(wall.lon_deg + wall.step_deg * wall.wall) - at) * east
    cell = wall.cell_m
    west -= 2 * cell  # from the edge of its top
    assert blocked[(west > cell) & (west < shadow_m - 2 * cell)].all()
    assert not blocked[(west > shadow_m + cell) | (west < -2 * cell)].any()
    assert reach_cells(model, wall, 0.0, 300.0) * cell == pytest.approx(shadow_m, rel=0.2)


def test_direct_way_meets_the_wall_first_and_leaves_its_shadow_out():
    model = camera()
    grid = ground_grid(model)
    lat, lon = grid.where(np.array([50.0]), np.array([50.0]))
    wall = Wall.under(model, 1500).raised(float(lon[0]), 300.0)
    # pixels whose ground would lie in the shadow see the wall instead
    at = model.inverse(np.repeat(lat, 3), lon - np.radians(wall.step_deg) * np.array([6.0, 9.0, 12.0]), 0.0, 0.0)
    met = meet_terrain(model, at[:, 0], at[:, 1], wall, 0.0, 300.0)
    assert (met.height_m > 20.0).all() and (np.abs(wall.at(met.lat, met.lon) - met.height_m) < 0.1).all()
    assert (np.abs(wall.place(met.lat, met.lon)[1] - wall.wall) < 3.0).all()


def test_sigmas_are_those_of_errors_that_were_drawn():
    position, attitude, pixel, dem = 3.0, 1.5e-5, 0.4, 6.0
    model = camera()
    relief = Waves.under(model, 300, waves=6.0)
    grid = ground_grid(model, 60.0, 60)
    heights, line, sample, height = cells(model, grid, relief)
    inside = np.ones(line.shape, dtype=bool)

    def errors(u, v, h):
        J = model.image_derivatives(u, v, h)
        Q = J @ np.diag([position**2] * 3 + [attitude**2] * 3) @ np.swapaxes(J, 1, 2)
        return Q + pixel**2 * np.eye(2), np.zeros(len(u))

    some = some_cells(line, sample, height, inside)
    planimetric, up = sigmas_of_tile(model, some, errors, dem, inside.shape, WGS84, heights, relief)

    # the same by moving one source after another: where a feature that truly is in a cell is then found
    rng = np.random.default_rng(5)
    i, j = rng.integers(2, 58, 200), rng.integers(2, 58, 200)
    lat, lon = grid.where(j, i)
    truth = relief.at(lat, lon)
    east, north = metres_a_radian(lat, truth, WGS84)
    seen = model.inverse(lat, lon, truth, 1.0)
    z, small = relief.z, 0.02
    square = np.zeros((3, 200))
    for k in range(9):
        pixels, sigma = seen, 1.0
        if k < 6:  # the camera is not where it is thought to be
            moved = np.eye(6)[k] * small * (position if k < 3 else attitude)
            pixels = camera(moved[0], moved[1], 500e3 + moved[2], moved[3:]).inverse(lat, lon, truth, 1.0)
        elif k < 8:
            pixels = seen + small * pixel * np.eye(2)[k - 6]
        else:
            relief.z, sigma = z + np.float32(1.0), small * dem
        met = meet_terrain(model, pixels[:, 0], pixels[:, 1], relief, -50.0, 1050.0)
        error = np.stack([(met.lon - lon) * east, (met.lat - lat) * north, met.height_m - truth])
        square += (error * sigma / small) ** 2
    relief.z = z
    want_planimetric, want_up = np.sqrt(square[0] + square[1]), np.sqrt(square[2])
    assert np.ptp(want_up) > 2.0  # slopes differ
    for got, want in ((planimetric, want_planimetric), (up, want_up)):
        ratio = got[i, j] / want
        # a feature that crosses the edge of a cell of the raster meets another slope
        assert np.median(ratio) == pytest.approx(1.0, abs=0.005)
        assert np.mean(np.abs(ratio - 1.0) < 0.05) > 0.9


def test_slow_quantities_are_carried_over_a_tile():
    row, column = np.mgrid[0:50, 0:80] / 50.0
    line, sample = 100 * row, 100 * column
    inside = column > 0.4
    some = some_cells(line, sample, 0.0, inside)
    values = np.column_stack([some.line**2 - some.sample, np.ones(len(some.line))])
    got = over_cells(some, values, inside.shape)
    assert np.allclose(got[..., 0], line**2 - sample, atol=1.0) and np.allclose(got[..., 1], 1.0)


@pytest.mark.parametrize("rows", [48, 96, 97, 480])
def test_some_cells_of_a_whole_tile_lie_all_over_it(rows: int):
    """One cell of so many in the order of memory is in the first or the last column where rows are a multiple of 48."""
    row, column = np.mgrid[-1.0 : 1.0 : rows * 1j, -1.0:1.0:200j]
    some = some_cells(100 * row, 100 * column, 0.0, np.ones(row.shape, dtype=bool))
    got = over_cells(some, 2.0 + 0.1 * some.at[:, 1:] + 0.05 * some.at[:, :1] ** 2, row.shape)
    assert np.allclose(got[..., 0], 2.0 + 0.1 * column + 0.05 * row**2, atol=1e-4)
