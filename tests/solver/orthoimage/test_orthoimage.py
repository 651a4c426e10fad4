"""Direct rectification: rays to the ground, cells back to lines, patches, mosaic; against independent computation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from scipy import ndimage
from scipy.optimize import brentq

from triline.solver.camera.collinearity import project
from triline.solver.camera.line_camera import three_line_camera
from triline.solver.geometry import earth
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.orthoimage.ground_grid import GroundGrid, heights_in_frame, utm_of
from triline.solver.orthoimage.heights_of_points import heights_of_points
from triline.solver.orthoimage.mosaic import Mosaic
from triline.solver.orthoimage.orientation import LineOrientation
from triline.solver.orthoimage.resampling import resample
from triline.solver.orthoimage.strip import Patch, StripRectifier, rays_of, step_over
from triline.solver.orthoimage.surface import Ellipsoid, HeightField, Plane

FRAME = LocalFrame(48.93, 8.96, 300.0)
PIXELS, RATE, SPEED, HEIGHT = 500, 50.0, 60.0, 1500.0
CAMERA = three_line_camera("test", 60.0, PIXELS, 0.05, {"F": 20.0, "N": 0.0, "B": -16.0})
GSD = 1.3


def _relief(x, y):
    return 30 * np.sin(x / 230.0) * np.cos(y / 310.0) + 0.04 * x


def _field(step=10.0, reach=2500.0):
    n = round(2 * reach / step) + 1
    x = -reach + step * np.arange(n)
    return HeightField(-reach, -reach, step, _relief(*np.meshgrid(x, x)))


def _rays(rng, n, slant):
    position = np.column_stack([rng.uniform(-500, 500, (n, 2)), rng.uniform(1200, 1800, n)])
    return position, np.column_stack([rng.uniform(-slant, slant, (n, 2)), -np.ones(n)]) * rng.uniform(0.5, 3, (n, 1))


class _Flight:
    """Orientation with jitter up to 5 Hz, as functions of the line."""

    def __init__(self, seed=0, jitter=2e-3, heading=0.5):
        rng = np.random.default_rng(seed)
        self.f, self.phase = rng.uniform(0.1, 5, (3, 6)), rng.uniform(0, 6, (3, 6))
        self.jitter, self.heading = jitter, heading

    def angles(self, line):
        t = np.asarray(line, dtype=float)[..., None, None] / RATE
        shake = (np.sin(2 * np.pi * self.f * t + self.phase) / (1 + self.f)).sum(axis=-1) * self.jitter
        return shake + np.array([0.01, -0.02, self.heading])

    def position(self, line):
        t = np.asarray(line, dtype=float) / RATE
        way = SPEED * t - 300.0
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack([c * way, s * way + 3 * np.sin(t), HEIGHT + 2 * np.cos(t / 2)], axis=-1)

    def R(self, line):
        return matrix_from_angles(*self.angles(line).T)

    def image_of(self, line, point_l):
        """x (mm ahead of the nadir CCD) and sample of one ground point at a (fractional) line."""
        p = project(self.position([line]), self.angles([line]), point_l[None], np.array([60.0]))
        x, y = p.xy_mm[0]
        return x, y / 0.05 + (PIXELS - 1) / 2


def test_ellipsoid_is_met_at_the_nearer_point():
    rng = np.random.default_rng(1)
    position, direction = _rays(rng, 30, 1.0)
    point, met = Ellipsoid(FRAME, 120.0).meet(position, direction)
    assert met.all()
    for p, d, found in zip(position, direction, point, strict=True):

        def above(s, p=p, d=d):
            return FRAME.to_geodetic(p + s * d)[2] - 120.0

        s = brentq(above, 0.0, 1e4, xtol=1e-9)
        assert np.linalg.norm(p + s * d - found) < 2e-3  # "half axes plus height" is no parallel surface: 1e-5 of 120 m
    point, met = Ellipsoid(FRAME).meet(position, direction)
    assert np.abs(FRAME.to_geodetic(point)[:, 2]).max() < 1e-6
    satellite = FRAME.from_geodetic(10.0, 30.0, 7e5)
    to_e = earth.ecef_from_geodetic(np.radians(12.0), np.radians(31.0), 0.0)
    target = (to_e - FRAME.origin_e) @ FRAME.R_el
    point, met = Ellipsoid(FRAME).meet(satellite, target - satellite)
    assert met and np.linalg.norm(point - target) < 1e-5


def test_rays_that_do_not_come_down_meet_nothing():
    up, down = np.array([0.1, 0, 1.0]), np.array([0.1, 0, -1.0])
    position = np.array([0.0, 0.0, 1000.0])
    for surface in (Plane(0.0), Ellipsoid(FRAME), _field()):
        point, met = surface.meet(np.stack([position, position]), np.stack([up, down]))
        assert met.tolist() == [False, True] and np.isnan(point[0]).any() and np.isfinite(point[1]).all()
    assert not Plane(2000.0).meet(position, down)[1]
    point, met = _field(reach=50.0).meet(position, np.array([1.0, 0.0, -1.0]))
    assert not met


def test_relief_is_met_where_a_root_finder_says():
    field = _field()
    rng = np.random.default_rng(2)
    position, direction = _rays(rng, 300, 0.8)
    point, met = field.meet(position, direction)
    assert met.all()
    for p, d, found in zip(position[:60], direction, point, strict=False):

        def above(s, p=p, d=d):
            q = p + s * d
            return float(q[2] - field.height(q[0], q[1]))

        top = (p[2] - 140.0) / -d[2]
        s = brentq(above, top, (p[2] + 140.0) / -d[2], xtol=1e-9)
        assert np.linalg.norm(p + s * d - found) < 3e-3


def test_relief_steeper_than_the_rays_is_met_where_it_is_first_seen():
    step = 2.0
    x = -400 + step * np.arange(401)
    cliffs = np.where(np.sin(x / 25.0) > 0, 60.0, 0.0)[None, :] + np.zeros((401, 1))
    field = HeightField(-400.0, -400.0, step, cliffs)
    rng = np.random.default_rng(3)
    position = np.column_stack([rng.uniform(-50, 50, (400, 2)), np.full(400, 200.0)])
    direction = np.column_stack([rng.uniform(-1.2, 1.2, (400, 2)), -np.ones(400)])
    simple = field._correct(position, direction[:, :2] / direction[:, 2:])
    lost = ~np.isfinite(simple)
    assert 10 < lost.sum() < 300  # the relief correction alone gives up on many of them
    point, met = field.meet(position, direction)
    assert met.all()
    assert np.abs(field.height(point[:, 0], point[:, 1]) - point[:, 2]).max() < 0.02
    for p, d, found in zip(position[lost], direction[lost], point[lost], strict=True):
        z = np.arange(61.0, -1.0, -0.005)
        q = p + d * ((p[2] - z) / -d[2])[:, None]
        under = field.height(q[:, 0], q[:, 1]) >= z
        assert abs(z[np.argmax(under)] - found[2]) < 0.1


def test_rays_stop_at_the_first_roof_or_wall():
    """The relief correction alone comes to rest on the ground behind a building as well."""
    rng = np.random.default_rng(4)
    z = np.full((300, 300), 100.0)
    for i, j, rows, columns in np.column_stack([rng.integers(5, 270, (40, 2)), rng.integers(6, 25, (40, 2))]):
        z[i : i + rows, j : j + columns] = rng.uniform(105, 140)
    field = HeightField(0.0, 0.0, 1.0, z)
    foot = np.column_stack([rng.uniform(60, 240, (3000, 2)), np.full(3000, 100.0)])
    direction = np.column_stack([rng.uniform(-0.8, 0.8, (3000, 2)), -np.ones(3000)])
    position = foot - 500.0 * direction
    high = np.linspace(141.0, 99.99, 4000)
    first = np.full(3000, np.nan)
    for k in range(3000):
        q = position[k] + direction[k] * (position[k, 2] - high)[:, None]
        first[k] = high[np.argmax(field.height(q[:, 0], q[:, 1]) >= high)]
    point, met = field.meet(position, direction)
    assert met.all()
    # a ray may pass an edge by less than a step of the search
    assert (np.abs(point[:, 2] - first) > 0.1).mean() < 0.003
    below = np.array([[150.0, 150.0, 120.0]])  # of a mountain above the sensor nothing is seen behind it
    hill = HeightField(0.0, 0.0, 1.0, np.linspace(0.0, 400.0, 300)[None, :] + np.zeros((300, 1)))
    assert not hill.meet(below, np.array([[-0.2, 0.0, -1.0]]))[1].any()


def test_heights_unknown_or_outside():
    z = np.zeros((5, 5))
    z[2, 2] = np.nan
    field = HeightField(0.0, 0.0, 1.0, z)
    assert np.isnan(field.height(np.array(2.5), np.array(2.5))) and field.height(np.array(0.5), np.array(0.5)) == 0
    assert np.isnan(field.height(np.array(4.1), np.array(0.0)))
    assert replace(field, z_m=np.eye(5), endless=True).height(np.array(9.0), np.array(9.0)) == 1
    for bad in (np.zeros((1, 5)), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="height"):
            HeightField(0.0, 0.0, 1.0, bad)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832+5783", "EPSG:3857"])
def test_polynomial_to_cells_is_the_projection(crs):
    grid = GroundGrid(replace(FRAME, crs=crs), 0.25)
    rng = np.random.default_rng(4)
    point = np.column_stack([rng.uniform(-3000, 3000, (2000, 2)), rng.uniform(-200, 900, 2000)]).reshape(20, 100, 3)
    point[3, 4] = np.nan
    fast, exact = grid.cells_of_many(point), grid.cells(point)
    assert np.nanmax(np.abs(fast - exact)) < 4e-3 and np.isnan(fast[3, 4]).all()
    g = FRAME.to_geodetic(point[0, 0])
    x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(g[1], g[0])
    assert np.abs(np.array(grid.centre(*exact[0, 0])) - [x, y]).max() < 1e-6
    far = np.delete(point, 3, axis=0) * np.array([100.0, 100.0, 1.0])
    assert np.nanmax(np.abs(grid.cells_of_many(far) - grid.cells(far))) < 1e-6  # too far for it: the projection itself


@pytest.mark.parametrize(
    ("crs", "gsd"), [("EPSG:25832+5783", 0.25), ("+proj=utm +zone=32 +units=us-ft +type=crs", 1.0), ("local", 0.25)]
)
@pytest.mark.parametrize("reach", [1500.0, 60e3])
def test_relief_under_cells_is_in_these_cells(crs, gsd, reach):
    """The second one is too far for the polynomial."""
    grid, field = GroundGrid(replace(FRAME, crs=crs), gsd), _field(step=reach / 50, reach=1.1 * reach)
    rng = np.random.default_rng(8)
    column, row = np.moveaxis(grid.cells(np.column_stack([rng.uniform(-reach, reach, (300, 2)), np.zeros(300)])), 1, 0)
    found = grid.on_relief(column.reshape(20, 15), row.reshape(20, 15), field).reshape(-1, 3)
    # a polynomial is as good as what its heights are taken at; exact, two rounds leave what plumb lines differ by
    assert np.abs(grid.cells(found) - np.column_stack([column, row])).max() * grid.cell_m < 0.03
    np.testing.assert_allclose(found[:, 2], field.height(found[:, 0], found[:, 1]), atol=1e-9)
    outside = grid.on_relief(column + 3 * reach / gsd, row, field)
    assert np.isnan(outside[..., 2]).any()


def test_heights_of_a_map_projection_in_the_local_frame():
    utm = replace(FRAME, crs=utm_of(FRAME))
    assert utm.crs == "EPSG:32632" and utm_of(LocalFrame(-33.0, 151.0, 0.0)) == "EPSG:32756"
    x0, y0, _ = utm.to_crs(np.array([-1000.0, 1000.0, 0.0]))

    def ground(x, y):
        return 350.0 + 0.05 * (x - x0) + 8 * np.sin((y - y0) / 90.0)

    x, y = x0 + 10.0 * np.arange(200), y0 - 10.0 * np.arange(180)
    field = heights_in_frame(FRAME, utm.crs, ground(*np.meshgrid(x, y)), x0, y0, 10.0, -10.0)
    rng = np.random.default_rng(5)
    place = np.column_stack([rng.uniform(x[5], x[-5], 200), rng.uniform(y[-5], y[5], 200), np.zeros(200)])
    place[:, 2] = ground(place[:, 0], place[:, 1])
    local = utm.from_crs(place)
    miss = field.height(local[:, 0], local[:, 1]) - local[:, 2]
    assert np.abs(miss).max() < 2.5 * 8 / 8 * (10 / 90) ** 2  # bilinear twice over 10 m of that wave
    with pytest.raises(ValueError, match="nodes"):
        heights_in_frame(FRAME, utm.crs, np.zeros((1, 9)), x0, y0, 1.0, -1.0)


def _rectified(flight, image, surface, grid, method="bilinear", block=60, usable=None, ccd=1):
    strip = StripRectifier(rays_of(CAMERA, ccd), surface, grid, method)
    patches, lines = [], np.arange(len(image))
    for a in range(0, len(image), block):
        part = slice(a, a + block)
        use = None if usable is None else usable[part]
        patches += strip.add(a, image[part], use, flight.position(lines[part]), flight.R(lines[part]))
    return patches + strip.finish()


def _mosaic(patches):
    mosaic = Mosaic(patches[0].values.dtype, 64)
    for patch in patches:
        mosaic.add(patch)
    return mosaic


@pytest.mark.parametrize("heading", [0.5, 2.2, -np.pi / 2, 0.0])
def test_every_cell_comes_from_the_pixel_that_sees_it(heading):
    """Line and sample of cells, found by a root finder through the collinearity equations."""
    flight, field = _Flight(heading=heading), _field()
    grid = GroundGrid(replace(FRAME, crs="EPSG:32632"), GSD)
    lines = 500
    u, v = np.meshgrid(np.arange(lines), np.arange(PIXELS), indexing="ij")
    scale = 10_000.0
    images = [np.rint(a * scale + 1).astype(np.uint32) for a in (u, v)]
    line_at, sample_at = (_mosaic(_rectified(flight, image, field, grid)) for image in images)
    extent = line_at.extent()
    line, sample = ((m.read(*extent) - 1.0) / scale for m in (line_at, sample_at))
    known = line_at.read(*extent) > 0
    rng = np.random.default_rng(6)
    row, column = (a[rng.choice(known.sum(), 250, replace=False)] for a in np.nonzero(known))
    x, y = grid.centre(column + extent[2], row + extent[0])
    point = np.column_stack([x, y, np.zeros(len(x))])
    for _ in range(4):
        local = grid.frame.from_crs(point)
        local[:, 2] = field.height(local[:, 0], local[:, 1])
        point[:, 2] = grid.frame.to_crs(local)[:, 2]
    misses = []
    for p, u0, v0 in zip(local, line[row, column], sample[row, column], strict=True):
        if not 8 < u0 < lines - 9:
            continue
        root = brentq(lambda at, p=p: flight.image_of(at, p)[0], u0 - 8, u0 + 8, xtol=1e-6)
        misses.append([u0 - root, v0 - flight.image_of(root, p)[1]])
    misses = np.abs(misses)
    assert len(misses) > 200
    # rays stand 16 pixels apart, which is 20 m: the bends of heights every 10 m are rounded a little
    assert np.percentile(misses, 95, axis=0).max() < 0.05 and np.percentile(misses, 99) < 0.15


def test_no_cell_is_left_out_and_none_is_asked_twice():
    flight = _Flight(jitter=4e-3)
    grid = GroundGrid(FRAME, 1.0)
    image = np.full((400, PIXELS), 7, dtype=np.uint8)
    patches = _rectified(flight, image, Plane(0.0), grid)
    rows = np.concatenate([np.repeat(p.row, p.length) for p in patches])
    runs = [c + np.arange(n) for p in patches for c, n in zip(p.column, p.length, strict=True)]
    cells = np.column_stack([rows, np.concatenate(runs)])
    assert len(np.unique(cells, axis=0)) == len(cells) > 100_000
    mosaic = _mosaic(patches)
    known = mosaic.read(*mosaic.extent()) > 0
    assert (ndimage.binary_fill_holes(known) == known).all()
    area = 400 * SPEED / RATE * PIXELS * 0.05 / 60 * HEIGHT
    assert 0.9 < known.sum() / area < 1.1


def test_blocks_do_not_matter():
    flight, grid = _Flight(), GroundGrid(FRAME, GSD)
    image = np.random.default_rng(7).integers(1, 4000, (300, PIXELS), dtype=np.uint16)
    image = ndimage.gaussian_filter(image.astype(float), 2).astype(np.uint16)
    one, other = (_mosaic(_rectified(flight, image, _field(), grid, block=n)) for n in (11, 300))
    a, b = (m.read(*one.extent()).astype(int) for m in (one, other))
    both = (a > 0) & (b > 0)
    assert both.sum() > 0.999 * max((a > 0).sum(), (b > 0).sum())
    contrast = float(a[both].std())
    assert np.sqrt(np.mean((a - b)[both] ** 2)) < 0.02 * contrast  # the nodes of the table lie elsewhere


def test_missing_lines_stay_empty_and_the_others_in_place():
    flight, grid = _Flight(jitter=0.0), GroundGrid(FRAME, 1.2)
    image = np.full((300, PIXELS), 100, dtype=np.uint16)
    usable = np.ones(300, dtype=bool)
    usable[120:150] = False
    whole, holed = (_mosaic(_rectified(flight, image, Plane(0.0), grid, usable=use)) for use in (None, usable))
    a, b = (m.read(*whole.extent()) > 0 for m in (whole, holed))
    assert not (b & ~a).any()
    assert 29 < (a & ~b).sum() / a.sum() * 300 < 33
    strip = StripRectifier(rays_of(CAMERA, 1), Plane(0.0), grid)
    patches = []
    for part in (np.arange(120), np.arange(150, 300)):
        patches += strip.add(part[0], image[part], None, flight.position(part), flight.R(part))
    c = _mosaic(patches + strip.finish()).read(*whole.extent()) > 0
    assert (b ^ c).sum() < 4 * PIXELS


def test_ground_whose_height_is_not_known_stays_empty():
    """Nothing is put between the rays on either side of it, across the flight or along it."""
    flight, grid, field = _Flight(), GroundGrid(FRAME, GSD), _field()
    image = np.random.default_rng(8).integers(1, 4000, (300, PIXELS), dtype=np.uint16)
    z = field.z_m.copy()
    side = np.arange(len(z)) * field.step_m + field.x_m
    y, x = np.nonzero((np.abs(side[:, None] + 60.0) < 70.0) & (np.abs(side[None] + 80.0) < 70.0))
    z[y, x] = np.nan
    whole, holed = (_mosaic(_rectified(flight, image, surface, grid)) for surface in (field, replace(field, z_m=z)))
    row0, row1, column0, column1 = whole.extent()
    a, b = (m.read(row0, row1, column0, column1).astype(int) for m in (whole, holed))
    e, n = grid.centre(np.arange(column0, column1)[None], np.arange(row0, row1)[:, None])
    unknown = np.isnan(replace(field, z_m=z).height(*np.broadcast_arrays(e, n)))
    # a corner may lie between two rays
    assert (unknown & (a > 0)).sum() > 5000 and not (b[ndimage.binary_erosion(unknown, iterations=8)] > 0).any()
    near = ndimage.binary_dilation(unknown, iterations=40)  # as far as from one ray to the next
    inner = ndimage.binary_erosion(a > 0, iterations=3)
    assert (b > 0)[inner & ~near].all()
    assert np.percentile(np.abs(a - b)[(a > 0) & (b > 0)], 99) < 0.02 * a[a > 0].std()


def test_between_lines_that_a_wrong_pose_puts_apart_nothing_is_worked_on(monkeypatch):
    """Not so far that they are left out, but many bands of 8 lines: each would take as long as one with lines."""
    flight, grid = _Flight(jitter=0.0), GroundGrid(FRAME, 1.2)
    image, lines = np.full((300, PIXELS), 100, dtype=np.uint16), np.arange(300)

    def patches_of(away_m):
        position = np.array(flight.position(lines))
        position[290:] += away_m * (flight.position([9])[0] - flight.position([8])[0])[None] / (SPEED / RATE)
        strip, bands = StripRectifier(rays_of(CAMERA, 1), Plane(0.0), grid, band=8), []
        monkeypatch.setattr(strip, "_band", lambda b, e, band=strip._band: (bands.append((b, e)), band(b, e))[1])
        found = []
        for part in np.split(lines, 10):
            found += strip.add(part[0], image[part], None, position[part], flight.R(part))
        return found + strip.finish(), bands, strip

    near, bands, _ = patches_of(0.0)
    apart, more, strip = patches_of(1000.0)
    assert strip.missed == 0 and strip._done - more[0][0] > 700  # they were not left out
    assert len(more) < len(bands) + 12
    filled = [sum(int((p.values > 0).sum()) for p in found) for found in (near, apart)]
    assert filled[1] > 0.85 * filled[0]


@pytest.mark.parametrize("cell_m", [1.2, 0.12, 0.03])
def test_cells_much_finer_than_pixels_leave_out_no_line(cell_m):
    flight, grid = _Flight(jitter=0.0), GroundGrid(FRAME, cell_m)
    lines = np.arange(40)
    strip = StripRectifier(rays_of(CAMERA, 1), Plane(0.0), grid)
    strip.add(0, np.full((40, PIXELS), 100, dtype=np.uint16), None, flight.position(lines), flight.R(lines))
    strip.finish()
    assert strip.missed == 0


@pytest.mark.parametrize("away_m", [0.0, 1e7, 1e9])
@pytest.mark.parametrize("axis", [0, 1])
def test_lines_of_a_wrong_pose_are_left_out_and_take_no_memory(away_m, axis):
    """A table up to where they were thought to be would be of terabytes."""
    flight, grid = _Flight(jitter=0.0), GroundGrid(FRAME, 1.2)
    image, lines = np.full((300, PIXELS), 100, dtype=np.uint16), np.arange(300)
    position = np.array(flight.position(lines))
    position[200:203, axis] += away_m
    strip = StripRectifier(rays_of(CAMERA, 1), Plane(0.0), grid)
    patches = []
    for part in np.split(lines, 10):
        patches += strip.add(part[0], image[part], None, position[part], flight.R(part))
        assert strip._inverse(0, 1) is None or strip._inverse(0, 1)[1].size < 1e6
    seen = _mosaic(patches + strip.finish())
    filled = sum(len(p.values) and int((p.values > 0).sum()) for p in patches)
    assert (strip.missed > 0) == (away_m > 0)
    assert filled > 0.5 * 300 * PIXELS * 0.3 and (seen.read(*seen.extent()) > 0).any()


def test_bad_calls_are_told():
    flight, grid = _Flight(), GroundGrid(FRAME, 1.0)
    strip = StripRectifier(rays_of(CAMERA, 0), Plane(0.0), grid)
    with pytest.raises(ValueError, match="lines of 3 pixels, wanted 500"):
        strip.add(0, np.zeros((2, 3), dtype=np.uint8), None, flight.position([0, 1]), flight.R(np.arange(2)))
    lines = np.arange(50)
    strip.add(0, np.zeros((50, PIXELS), dtype=np.uint8), None, flight.position(lines), flight.R(lines))
    with pytest.raises(ValueError, match="line 10 comes after line 49"):
        strip.add(10, np.zeros((2, PIXELS), dtype=np.uint8), None, flight.position([0, 1]), flight.R(np.arange(2)))
    with pytest.raises(ValueError, match="wanted one of nearest, bilinear, cubic"):
        StripRectifier(rays_of(CAMERA, 0), Plane(0.0), grid, "lanczos")
    with pytest.raises(ValueError, match="cells of 0"):
        GroundGrid(FRAME, 0.0)
    with pytest.raises(ValueError, match="empty"):
        Mosaic().extent()
    assert StripRectifier(rays_of(CAMERA, 0), Plane(0.0), grid).finish() == []


def test_lines_that_see_no_ground_are_counted():
    flight, grid = _Flight(), GroundGrid(FRAME, GSD)
    strip = StripRectifier(rays_of(CAMERA, 1), Plane(2000.0), grid)
    lines = np.arange(100)
    image = np.ones((100, PIXELS), dtype=np.uint8)
    assert strip.add(0, image, None, flight.position(lines), flight.R(lines)) == [] and strip.finish() == []
    assert strip.missed == 100 * len(rays_of(CAMERA, 1).sample)


def test_rays_stand_closer_where_the_ground_has_walls():
    grid = GroundGrid(replace(FRAME, crs="local"), 0.5)
    x, y = np.meshgrid(np.arange(0.0, 400.0, 2.0), np.arange(0.0, 600.0, 2.0))
    hills = 40.0 * np.sin(x / 90.0) * np.cos(y / 120.0)
    assert step_over(Plane(0.0), grid) == step_over(HeightField(0.0, 0.0, 2.0, hills), grid) == 16
    house = HeightField(0.0, 0.0, 2.0, hills + 8.0 * ((np.abs(x - 200.0) < 15.0) & (np.abs(y - 300.0) < 20.0)))
    assert step_over(house, grid) == 2
    town = HeightField(0.0, 0.0, 2.0, hills + 8.0 * ((x % 50.0 < 30.0) & (y % 60.0 < 40.0)))
    assert step_over(town, grid) == 2


@pytest.mark.parametrize("oblique", [0.0, 0.5])
def test_ground_that_ends_under_a_strip_is_rectified_as_far_as_it_goes(oblique):
    """Its edge runs along the strip, or across it so that no line has all of it."""
    flight, grid = _Flight(heading=0.0), GroundGrid(replace(FRAME, crs="local"), 2.0)
    x, y = np.meshgrid(np.arange(-900.0, 901.0, 5.0), np.arange(-900.0, 901.0, 5.0))
    field = HeightField(-900.0, -900.0, 5.0, np.where(y > 100.0 + oblique * x, np.nan, 0.0))
    strip = StripRectifier(rays_of(CAMERA, 1), field, grid)
    lines = np.arange(300)
    image = np.full((300, PIXELS), 7, dtype=np.uint8)
    seen = _mosaic([p for part in np.split(lines, 3) for p in strip.add(
        part[0], image[part], None, flight.position(part), flight.R(part))] + strip.finish())  # fmt: skip
    row0, row1, column0, column1 = seen.extent()
    filled = seen.read(row0, row1, column0, column1) > 0
    rows, columns = np.nonzero(filled)
    east, north = grid.centre(columns + column0, rows + row0)
    assert np.ptp(east) > 300.0 and north.min() < -250.0
    edge = 100.0 + oblique * east
    assert (north < edge + 1.0).all() and (edge - north).min() < 45.0


@pytest.mark.parametrize("unknown", ["beside", "across", "at first", "nowhere"])
def test_lines_do_not_wait_for_ground_that_is_not_known(unknown, monkeypatch):
    """A ray that had left the heights was waited for; lines that waited longest were left out of the orthoimage."""
    monkeypatch.setattr("triline.solver.orthoimage.strip.MOST_WAITING", 2000)
    x, y = np.meshgrid(np.arange(-200.0, 12_200.0, 20.0), np.arange(-600.0, 601.0, 20.0))
    z = np.zeros(x.shape)
    z[{
        "beside": y > np.maximum(500.0 - 0.15 * x, 100.0), "across": abs(x - 2000.0) < 300.0, "at first": x < 8000.0,
        "nowhere": x > np.inf,
    }[unknown]] = np.nan  # fmt: skip
    grid = GroundGrid(replace(FRAME, crs="local"), 2.0)
    strip = StripRectifier(rays_of(CAMERA, 1), HeightField(-200.0, -600.0, 20.0, z), grid)
    patches, most = [], 0
    for k in range(0, 6000, 200):
        position = np.column_stack([2.0 * np.arange(k, k + 200), np.zeros(200), np.full(200, 1500.0)])
        R = np.broadcast_to(np.eye(3), (200, 3, 3))
        patches += strip.add(k, np.full((200, PIXELS), 7, dtype=np.uint8), None, position, R)
        most = max(most, len(strip._usable))
    seen = _mosaic(patches + strip.finish())
    row0, row1, column0, column1 = seen.extent()
    east = grid.centre(np.arange(column0, column1), np.zeros(column1 - column0))[0]
    filled = east[(seen.read(row0, row1, column0, column1) > 0).any(axis=0)]
    assert most < 1000
    assert filled[0] == pytest.approx(8000.0 if unknown == "at first" else 0.0, abs=25.0)
    assert filled[-1] == pytest.approx(12_000.0, abs=25.0)
    assert 2.0 * len(filled) == pytest.approx(
        {"across": 11_400.0, "at first": 4000.0}.get(unknown, 12_000.0), abs=50.0
    )  # fmt: skip


@pytest.mark.parametrize(("method", "order"), [("nearest", 0), ("bilinear", 1)])
def test_resampling_as_scipy_does_it(method, order):
    rng = np.random.default_rng(8)
    image = rng.integers(0, 60_000, (40, 30), dtype=np.uint16)
    u, v = rng.uniform(-1, 40, 3000).astype(np.float32), rng.uniform(-1, 30, 3000).astype(np.float32)
    value, known = resample(image, None, u, v, method)
    wanted = ndimage.map_coordinates(image.astype(float), np.stack([u, v]), order=order, mode="nearest")
    assert np.abs(value - wanted)[known].max() < 0.1
    half = 0.5 if order == 0 else 0.0
    assert (known == ((u >= -half) & (u < 39 + half) & (v >= -half) & (v < 29 + half))).mean() > 0.999
    value, known = resample(
        image, None, np.array([np.nan, 5.0], np.float32), np.array([3.0, np.nan], np.float32), method
    )
    assert not known.any()


def test_cubic_resampling_keeps_parabolas():
    y, x = np.mgrid[0:40, 0:30].astype(float)
    image = np.rint(100 * (500 + x + 2 * y + 0.1 * x * x - 0.05 * y * y)).astype(np.uint32)
    rng = np.random.default_rng(9)
    u, v = rng.uniform(1, 37.9, 500).astype(np.float32), rng.uniform(1, 27.9, 500).astype(np.float32)
    value, known = resample(image, None, u, v, "cubic")
    assert known.all()
    assert np.abs(value / 100 - (500 + v + 2 * u + 0.1 * v * v - 0.05 * u * u)).max() < 0.02
    usable = np.ones(40, dtype=bool)
    usable[20] = False
    _, known = resample(image, usable, u, v, "cubic")
    assert (known == ((np.floor(u) + 2 < 20) | (np.floor(u) - 1 > 20))).all()


def test_mosaic_takes_the_steepest_look_and_knows_its_extent():
    def patch(value, steep, column):
        one = np.ones(100, dtype=np.uint8)
        return Patch(np.array([-3]), np.array([column]), np.array([100]), value * one, steep * one)

    mosaic = Mosaic(np.uint8, 64)
    mosaic.add(patch(10, 100, -50))
    mosaic.add(patch(20, 200, 0))
    mosaic.add(patch(30, 150, -20))
    assert mosaic.extent() == (-3, -2, -50, 100)
    row = mosaic.read(-4, -2, -50, 100)
    assert not row[0].any()
    assert (row[1] == np.repeat([10, 30, 20], [30, 20, 100])).all()
    assert mosaic.changed == set(mosaic.tiles) and mosaic.nbytes == 2 * 64 * 64 * len(mosaic.tiles)


def test_refined_orientation_keeps_the_motion_between_its_poses():
    flight = _Flight(jitter=3e-3)
    t = np.arange(0, 10, 0.005)
    error = np.array([1.0, -2.0, 0.5]), np.array([1e-3, 2e-3, -1e-3])
    q = quaternion_from_matrix(matrix_from_angles(*(flight.angles(t * RATE) + error[1]).T))
    orientation = LineOrientation(t, flight.position(t * RATE) + error[0], q)
    seldom = np.arange(1, 9, 0.05)
    true_q = quaternion_from_matrix(flight.R(seldom * RATE))
    orientation.refine(
        np.append(seldom, 99.0),
        np.vstack([flight.position(seldom * RATE), np.zeros(3)]),
        np.vstack([true_q, true_q[:1]]),
    )
    at = np.arange(1.0, 8.9, 0.0137)
    position, R = orientation.at(at)
    assert np.abs(position - flight.position(at * RATE)).max() < 1e-4
    assert np.abs(R - flight.R(at * RATE)).max() < 2e-6
    assert orientation.covers(np.array([-1.0, 1.5, 9.5, 9.9, 11.0])).tolist() == [False, True, True, True, False]
    assert not orientation.covers(np.array([9.99]))[0]
    with pytest.raises(ValueError, match="no refined pose"):
        orientation.refine([50.0], np.zeros((1, 3)), true_q[:1])
    gap = LineOrientation(np.array([0, 0.1, 2.0, 2.1]), np.zeros((4, 3)), np.tile([0, 0, 0, 1.0], (4, 1)))
    assert gap.covers(np.array([0.05, 1.0, 2.05])).tolist() == [True, False, True]


def test_lines_of_a_table_have_its_orientation_to_the_ends_of_strips():
    """A table of lines with a gap between strips; seconds since 1970 are known to a tenth of a microsecond."""
    t = np.array([0.0, 0.1, 0.2, 5.0, 5.1, 5.2])
    position = np.arange(18.0).reshape(6, 3)
    table = LineOrientation(t, position, np.tile([0, 0, 0, 1.0], (6, 1)))
    for rounding in (0.0, 1.2e-7, -1.2e-7):
        assert table.covers(t + rounding).all()
        np.testing.assert_array_equal(table.at(t + rounding)[0], position)
    assert not table.covers(np.array([-1e-5, 0.20001, 4.99999, 5.20001])).any()


def test_relief_from_points():
    rng = np.random.default_rng(10)
    xy = rng.uniform(-1000, 1000, (400, 2))
    point = np.column_stack([xy, _relief(*xy.T)])
    point[7, 2] += 400.0  # a wrong tie point
    field = heights_of_points(point)
    inside = rng.uniform(-800, 800, (500, 2))
    miss = field.height(*inside.T) - _relief(*inside.T)
    assert np.sqrt(np.mean(miss**2)) < 3.0 and np.abs(miss).max() < 25
    assert np.isfinite(field.height(np.array(9e3), np.array(-9e3)))
    for bad, text in (
        (point[:2], "2 points"),
        (np.zeros((5, 3)), "place"),
        (np.outer(np.arange(5), [1, 1, 1]), "line"),
    ):
        with pytest.raises(ValueError, match=text):
            heights_of_points(bad)
