"""``triline rectify IMAGE --sensor META``: what comes out, beside GDAL, and what is said of bad input."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from command_line import refusal
from places import DATA
from relief import Waves
from satellite_scenes import Truth, write_dimap2

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.frame_json import read_frame
from triline.nodes.formats.height_raster import HeightRaster
from triline.nodes.formats.projection import missing_grids, notes_of_map
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import write_rpb
from triline.solver.location.rpc_fit import fit_to_model

TRUTH = Truth(lines=400, samples=300, gsd=2.0e-5, period_s=2.0e-3, tilt_deg=(20.0, -7.0, 1.0))
#: position of an image of which each pixel holds its own line or sample
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def write_image(path, bands, nodata=None, transform=None, **kwargs):
    bands = np.asarray(bands)
    count, height, width = bands.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype, nodata=nodata,
        transform=transform, **kwargs,
    ) as target:  # fmt: skip
        target.write(bands)
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene: metadata, its model, relief under it, an image whose bands are its lines and samples."""
    folder = tmp_path_factory.mktemp("scene")
    path = write_dimap2(folder / "scene.xml", TRUTH)
    model = read_scene(path).model()
    relief = Waves.under(model, 120, waves=2.0)
    dem = relief.write(folder / "dem.tif")
    line, sample = np.mgrid[0 : TRUTH.lines, 0 : TRUTH.samples]
    image = write_image(folder / "image.tif", np.stack([line, sample]).astype(np.float32) + 10.0, nodata=-1.0)
    return folder, path, model, relief, dem, image


def rectify(tmp_path, image, sensor, *more, name="ortho.tif"):
    out = tmp_path / name
    assert main(["rectify", str(image), "--sensor", str(sensor), "-o", str(out), "-q", *map(str, more)]) == 0
    return rasterio.open(out)


def refused(capsys, *args) -> str:
    return refusal(capsys, "rectify", *args)


# -- what comes out ------------------------------------------------------------------------------------------------


def test_cells_hold_what_the_model_sees_there(scene, tmp_path):
    _, path, model, relief, dem, image = scene
    mask = tmp_path / "mask.tif"
    out = rectify(tmp_path, image, path, "--dem", dem, "--dem-datum", "ellipsoid", "--gsd", 10, "--mask", mask)
    assert out.crs.is_projected and out.count == 2 and out.dtypes[0] == "float32" and out.nodata == -1.0
    from rio_cogeo import cog_validate

    assert cog_validate(out.name)[0] and out.overviews(1)
    values = out.read()
    rng = np.random.default_rng(1)
    known = np.argwhere(values[0] > 0)
    some = known[rng.integers(0, len(known), 300)]
    x, y = out.transform.c + (some[:, 1] + 0.5) * out.res[0], out.transform.f - (some[:, 0] + 0.5) * out.res[1]
    from pyproj import Transformer

    lon, lat = Transformer.from_crs(out.crs, "EPSG:4326", always_xy=True).transform(x, y)
    lat, lon = np.radians(lat), np.radians(lon)
    true = model.inverse(lat, lon, relief.at(lat, lon), 1.0)
    inner = ((true > 0) & (true < np.array([TRUTH.lines, TRUTH.samples]) - 1)).all(axis=1)
    assert inner.mean() > 0.95
    assert np.abs(values[:, some[:, 0], some[:, 1]].T - 10.0 - true)[inner].max() < 0.01
    classes = rasterio.open(mask).read(1)
    assert ((classes == 0) == (values[0] > 0)).all() and set(np.unique(classes)) == {0, 1}


def as_gdal(rpc):
    """Polynomials as rasterio wants them."""
    from rasterio.rpc import RPC

    f = rpc.to_image
    c = f.coefficients.tolist()
    return RPC(
        height_off=f.in_offset[2], height_scale=f.in_scale[2], lat_off=f.in_offset[1], lat_scale=f.in_scale[1],
        long_off=f.in_offset[0], long_scale=f.in_scale[0], line_off=f.out_offset[1], line_scale=f.out_scale[1],
        samp_off=f.out_offset[0], samp_scale=f.out_scale[0], samp_num_coeff=c[0], samp_den_coeff=c[1],
        line_num_coeff=c[2], line_den_coeff=c[3],
    )  # fmt: skip


@pytest.mark.skipif(shutil.which("gdalwarp") is None, reason="gdalwarp is not installed")
@pytest.mark.parametrize("with_dem", [True, False])
def test_beside_gdalwarp(scene, tmp_path, with_dem):
    """The program itself, told not to interpolate: every cell looks at the same place in the image."""
    _, _, model, _, dem, image = scene
    rpb = tmp_path / "scene.RPB"
    rpc = fit_to_model(model, -100.0, 1100.0).rpc
    write_rpb(rpb, rpc)
    ground = ["--dem", dem, "--dem-datum", "ellipsoid"] if with_dem else ["--height", 400.0]
    out = rectify(tmp_path, image, rpb, *ground)
    with rasterio.open(image) as source:
        bands = source.read().astype(np.float32)
    with rasterio.open(write_image(tmp_path / "tagged.tif", bands, nodata=-1.0), "r+") as target:
        target.rpcs = as_gdal(rpc)
    heights = [f"RPC_DEM={dem}", "RPC_DEMINTERPOLATION=bilinear"] if with_dem else ["RPC_HEIGHT=400"]
    extent = [repr(float(v)) for v in out.bounds]
    words = ["-rpc", "-et", "0", "-r", "bilinear", "-t_srs", out.crs.to_wkt(), "-te", *extent, "-dstnodata", "-1"]
    words += ["-ts", str(out.width), str(out.height), *(word for option in heights for word in ("-to", option))]
    subprocess.run(["gdalwarp", "-q", *words, tmp_path / "tagged.tif", tmp_path / "warped.tif"], check=True)
    with rasterio.open(tmp_path / "warped.tif") as warped:
        theirs = warped.read()
    ours = out.read()
    both = (ours[0] > 0) & (theirs[0] > 0)
    assert both.sum() > 0.95 * max((ours[0] > 0).sum(), (theirs[0] > 0).sum())
    inner = both & (ours.min(axis=0) > 12) & (ours[0] < TRUTH.lines + 7) & (ours[1] < TRUTH.samples + 7)
    assert np.abs(ours - theirs)[:, inner].max() < 0.1


@pytest.mark.parametrize("with_dem", [True, False])
def test_beside_the_rpc_warp_of_gdal(scene, tmp_path, with_dem):
    """The same polynomials, DEM and cells: GDAL and triline look at the same place in the image."""
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    _, _, model, _, dem, image = scene
    rpb = tmp_path / "scene.RPB"
    rpc = fit_to_model(model, -100.0, 1100.0).rpc
    write_rpb(rpb, rpc)
    ground = ["--dem", dem, "--dem-datum", "ellipsoid"] if with_dem else ["--height", 400.0]
    out = rectify(tmp_path, image, rpb, *ground)
    gdal_rpc = as_gdal(rpc)
    options = {"RPC_DEM": str(dem), "RPC_DEMINTERPOLATION": "bilinear"} if with_dem else {"RPC_HEIGHT": 400.0}
    with rasterio.open(image) as source:
        bands = source.read()
    theirs = np.full((2, out.height, out.width), -1.0, dtype=np.float32)
    reproject(
        bands, theirs, src_crs="EPSG:4326", rpcs=gdal_rpc, dst_transform=out.transform, dst_crs=out.crs,
        src_nodata=-1.0, dst_nodata=-1.0, resampling=Resampling.bilinear, tolerance=0.0, **options,
    )  # fmt: skip
    ours = out.read()
    both = (ours[0] > 0) & (theirs[0] > 0)
    assert both.sum() > 0.95 * max((ours[0] > 0).sum(), (theirs[0] > 0).sum())
    inner = both & (ours.min(axis=0) > 12) & (ours[0] < TRUTH.lines + 7) & (ours[1] < TRUTH.samples + 7)
    apart = np.abs(ours - theirs)[:, inner]
    # over level ground rasterio's warp interpolates places, to an eighth of a pixel (its tolerance has no effect)
    limit = (0.1, 0.01) if with_dem else (0.14, 0.07)
    assert np.percentile(apart, 99.9) < limit[0] and np.median(apart) < limit[1]
    if not with_dem:  # GDAL's transformer itself, which does not interpolate
        from pyproj import Transformer
        from rasterio.transform import RPCTransformer

        row, column = np.argwhere(inner)[::500].T
        x, y = out.transform.c + (column + 0.5) * out.res[0], out.transform.f - (row + 0.5) * out.res[1]
        lon, lat = Transformer.from_crs(out.crs, "EPSG:4326", always_xy=True).transform(x, y)
        with RPCTransformer(gdal_rpc, rpc_height=400.0) as transformer:
            line, sample = transformer.rowcol(lon, lat, op=lambda places: places)
        exact = np.stack([line, sample]) - 0.5 + 10.0
        assert np.abs(ours[:, row, column] - exact).max() < 0.002


def test_a_part_of_a_scene_whose_rpc_state_no_size(scene, tmp_path):
    """As .RPB and _RPC.TXT: the size of the part was taken for that of the scene, and what lies beyond was lost."""
    _, _, model, _, _, image = scene
    write_rpb(tmp_path / "scene.RPB", fit_to_model(model, -100.0, 1100.0).rpc)
    with rasterio.open(image) as source:
        part = write_image(tmp_path / "part.tif", source.read()[:, 200:300, 60:220], nodata=-1.0)
    args = (tmp_path / "scene.RPB", "--height", 400.0, "--gsd", 20)
    whole = rectify(tmp_path, image, *args)
    found = rectify(tmp_path, part, *args, "--first-pixel", 60, 200, name="part_ortho.tif")
    column = round((found.transform.c - whole.transform.c) / 20)
    row = round((whole.transform.f - found.transform.f) / 20)
    there = whole.read()[:, row : row + found.height, column : column + found.width]
    values = found.read()
    seen = values[0] > 0
    inner = (there[0] > 211) & (there[0] < 308) & (there[1] > 71) & (there[1] < 228)
    assert inner.sum() > 1000 and seen[inner].all()
    np.testing.assert_allclose(values[:, inner], there[:, inner], atol=0.02)


def test_a_part_of_a_scene_with_the_polynomials_of_the_scene(scene, tmp_path, capsys):
    """Programs that cut images out copy the tags as they are, and the part states no size of the scene."""
    _, _, model, _, _, image = scene
    rpc = fit_to_model(model, -100.0, 1100.0).rpc
    with rasterio.open(image) as source:
        bands = source.read()[:, 200:300, 60:240]
    shift = rasterio.Affine(1.0, 0.0, 60.0, 0.0, 1.0, 200.0)
    parts = write_image(tmp_path / "p.tif", bands, -1.0), write_image(tmp_path / "t.tif", bands, -1.0, shift)
    for part, of_part in zip(parts, (rpc.shifted(200.0, 60.0), rpc), strict=True):
        with rasterio.open(part, "r+") as target:
            target.rpcs = as_gdal(of_part)
    args = ("--height", 300, "--gsd", 10)
    wanted = rectify(tmp_path, parts[0], parts[0], *args, name="w.tif")
    found = rectify(tmp_path, parts[1], parts[1], *args, "--first-pixel", 60, 200, name="f.tif")
    assert found.bounds == wanted.bounds and np.abs(found.read() - wanted.read()).max() < 0.01
    error = refused(capsys, parts[1], "--sensor", parts[1], "-o", tmp_path / "o.tif", *args)
    assert "wanted --first-pixel 60 200 if these are of the whole scene, --first-pixel 0 0 if" in error


def test_direct_way_gives_the_same_orthoimage(scene, tmp_path):
    _, path, _, _, dem, image = scene
    args = ("--dem", dem, "--dem-datum", "ellipsoid", "--mask")
    one = rectify(tmp_path, image, path, *args, tmp_path / "m1.tif").read()
    two = rectify(tmp_path, image, path, *args, tmp_path / "m2.tif", "--direct", name="direct.tif").read()
    both = (one[0] > 0) & (two[0] > 0)
    assert both.sum() > 0.995 * (one[0] > 0).sum() and (both == (two[0] > 0)).mean() > 0.995
    assert np.abs(one - two)[:, both].max() < 0.05
    mask = rasterio.open(tmp_path / "m2.tif").read(1)
    assert ((mask == 0) == (two[0] > 0)).all()


def test_direct_way_of_an_image_whose_empty_cells_are_no_numbers(scene, tmp_path, capsys):
    _, path, *_ = scene
    pixels = np.full((1, TRUTH.lines, TRUTH.samples), 0.25, dtype=np.float32)
    pixels[:, 100:150, 100:150] = np.nan
    image = write_image(tmp_path / "reflectance.tif", pixels)
    args = ["rectify", image, "--sensor", path, "--height", "100", "--direct", "--json", "-o", tmp_path / "o.tif"]
    assert main([str(word) for word in args]) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    found = rasterio.open(tmp_path / "o.tif").read(1)
    assert cells["value"] == (found == 0.25).sum() > 0.5 * TRUTH.lines * TRUTH.samples


def test_bits_bands_no_data_and_resampling(scene, tmp_path):
    _, path, *_ = scene
    rng = np.random.default_rng(2)
    for dtype, method in (("uint8", "nearest"), ("int16", "cubic"), ("uint32", "lanczos"), ("float64", "bilinear")):
        bands = rng.integers(1, 200, (3, TRUTH.lines, TRUTH.samples)).astype(dtype)
        bands[:, 100:150, 100:150] = 0
        image, mask = write_image(tmp_path / f"{dtype}.tif", bands, nodata=0), tmp_path / f"m_{dtype}.tif"
        args = ("--height", 100, "--gsd", 40, "--resampling", method, "--mask", mask)
        out = rectify(tmp_path, image, path, *args, name=f"{dtype}{method}.tif")
        assert out.dtypes == (dtype,) * 3 and out.nodata == 0
        values, classes = out.read(), rasterio.open(mask).read(1)
        assert set(np.unique(classes)) == {0, 1, 4}
        assert (values[:, classes != 0] == 0).all() and (values[:, classes == 0] != 0).all()
        if method == "nearest":
            assert set(np.unique(values)) <= set(np.unique(bands))


@pytest.mark.parametrize("gsd", [10, 40])
def test_bands_of_different_types(scene, tmp_path, gsd):
    """A virtual raster may have them, and files of PCIDSK."""
    from rasterio.shutil import copy

    _, path, *_ = scene
    line, sample = np.mgrid[0 : TRUTH.lines, 0 : TRUTH.samples] + 10
    one = write_image(tmp_path / "one.tif", np.stack([line, sample]).astype(np.float32))
    copy(one, tmp_path / "image.vrt", driver="VRT")
    words = (tmp_path / "image.vrt").read_text().replace('"Float32" band="2"', '"UInt16" band="2"')
    (tmp_path / "mixed.vrt").write_text(words)
    args = ("--height", 100, "--gsd", gsd, "--nodata", -1)
    wanted = rectify(tmp_path, one, path, *args, name="w.tif").read()
    found = rectify(tmp_path, tmp_path / "mixed.vrt", path, *args, name="f.tif")
    assert found.dtypes == ("float32", "float32") and np.abs(found.read() - wanted).max() < 0.01


@pytest.mark.parametrize("more", [(), ("--plain",)])
def test_what_grey_values_mean_goes_on(scene, tmp_path, more):
    _, path, *_ = scene
    image = write_image(tmp_path / "reflectance.tif", np.full((2, TRUTH.lines, TRUTH.samples), 4000, dtype=np.uint16))
    with rasterio.open(image, "r+") as target:
        target.scales, target.offsets, target.units = (1e-4, 2e-4), (-0.1, 0.0), ("reflectance", "1")
        target.set_band_description(2, "NIR")
    out = rectify(tmp_path, image, path, "--height", 100, *more)
    assert out.scales == (1e-4, 2e-4) and out.offsets == (-0.1, 0.0) and out.units == ("reflectance", "1")
    assert out.descriptions == (None, "NIR")  # they were lost
    assert set(np.unique(out.read())) == {0, 4000}


@pytest.mark.parametrize("stated", [7, None])
def test_no_data_takes_no_part_where_pixels_are_put_together(scene, tmp_path, stated):
    """Whether the file states it or the command line does."""
    _, path, _, _, _, _ = scene
    pixels = np.full((1, TRUTH.lines, TRUTH.samples), 200, dtype=np.uint8)
    pixels[0, :, : TRUTH.samples // 2 + 3] = 7
    image = write_image(tmp_path / "half.tif", pixels, nodata=stated)
    words = ["--height", 0, "--gsd", 40] if stated else ["--height", 0, "--gsd", 40, "--nodata", 7]
    out = rectify(tmp_path, image, path, *words)
    values = out.read(1)
    assert out.nodata == 7 and set(np.unique(values)) == {7, 200} and (values == 200).sum() > 500


@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize(("gsd", "value", "nodata"), [(10, 200, 0), (40, 200, 0), (10, 0, 0), (10, 255, 255)])
def test_what_a_mask_of_the_file_leaves_out_is_no_data(scene, tmp_path, internal, gsd, value, nodata):
    """A value that the orthoimage has for no data is moved by one."""
    _, path, *_ = scene
    pixels = np.full((1, TRUTH.lines, TRUTH.samples), value, dtype=np.uint8)
    there = np.full(pixels.shape[1:], True)
    pixels[0, :, : TRUTH.samples // 2 + 3], there[:, : TRUTH.samples // 2 + 3] = 90, False
    image = write_image(tmp_path / "half.tif", pixels)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal), rasterio.open(image, "r+") as target:
        target.write_mask(there)
    assert (tmp_path / "half.tif.msk").exists() != internal
    out = rectify(tmp_path, image, path, "--height", 0, "--gsd", gsd, *(["--nodata", nodata] if nodata else []))
    values = out.read(1)
    seen = {0: 1, 255: 254}.get(value, value)
    assert out.nodata == nodata and set(np.unique(values)) == {nodata, seen} and (values == seen).sum() > 500


@pytest.mark.parametrize("nodata", ["-1", "256", "0.5", "nan"])
def test_no_data_that_the_type_of_the_image_does_not_hold_is_refused(scene, tmp_path, capsys, nodata):
    _, path, *_ = scene
    image = write_image(tmp_path / "image.tif", np.full((1, TRUTH.lines, TRUTH.samples), 200, dtype=np.uint8))
    words = ["rectify", str(image), "--sensor", str(path), "--height", "0", "-o", str(tmp_path / "out.tif")]
    assert main([*words, "--nodata", nodata]) == 1
    assert f"--nodata {nodata}: wanted a whole number from 0 to 255, as" in capsys.readouterr().err


def test_values_that_would_be_taken_for_no_data_stay(scene, tmp_path):
    _, path, *_ = scene
    image = write_image(tmp_path / "black.tif", np.zeros((1, TRUTH.lines, TRUTH.samples), dtype=np.uint8))
    out = rectify(tmp_path, image, path, "--height", 100)
    assert (out.read(1) == 1).sum() > 0.5 * TRUTH.lines * TRUTH.samples


def test_degrees_bounds_and_larger_cells(scene, tmp_path):
    _, path, model, _, _, image = scene
    middle = np.degrees(model.direct(np.array([200.0]), np.array([150.0]), np.array([0.0]))[0, :2])
    bounds = [middle[1] - 0.01, middle[0] - 0.01, middle[1] + 0.01, middle[0] + 0.01]
    out = rectify(tmp_path, image, path, "--height", 0, "--crs", "EPSG:4326", "--gsd", 0.0005, "--bounds", *bounds)
    assert out.crs.is_geographic and out.res == pytest.approx((0.0005, 0.0005))
    assert out.bounds.left <= bounds[0] and out.bounds.right >= bounds[2] and out.width <= 43
    values = out.read()
    row, column = map(int, out.index(middle[1], middle[0]))  # rasterio 1.4.0 gives floating-point numbers
    x, y = out.xy(row, column)
    true = model.inverse(np.radians([y]), np.radians([x]), 0.0, 0.0)[0]
    # two to three pixels are put together: the mean of their lines is the line of their middle
    assert values[:, row, column] - 10.0 == pytest.approx(true, abs=0.02)


def test_overviews_of_the_image_move_nothing(scene, tmp_path):
    """What GDAL would read out of them lies up to a pixel elsewhere."""
    from rasterio.enums import Resampling

    _, path, *_ = scene
    line, sample = np.mgrid[0 : TRUTH.lines, 0 : TRUTH.samples]
    image = write_image(tmp_path / "image.tif", np.stack([line, sample]).astype(np.float32) + 10.0, nodata=-1.0)
    args = ("--height", 100, "--gsd", 60)
    wanted = rectify(tmp_path, image, path, *args, name="without.tif").read()
    with rasterio.open(image, "r+") as target:
        target.build_overviews([2, 4], Resampling.nearest)
    np.testing.assert_array_equal(rectify(tmp_path, image, path, *args, name="with.tif").read(), wanted)


def test_an_image_across_the_date_line(scene, tmp_path, capsys):
    """In degrees its two sides are 360 degrees apart; other systems have it in one piece."""
    _, _, model, _, _, image = scene
    lon = np.degrees(model.direct(np.array([200.0]), np.array([150.0]), np.array([0.0]))[0, 1])
    path = write_dimap2(tmp_path / "east.xml", replace(TRUTH, node_deg=TRUTH.node_deg + 180.0 - lon))
    words = [image, "--sensor", path, "--height", 0, "-o", tmp_path / "out.tif"]
    for gsd in ([], ["--gsd", 0.01]):
        told = refused(capsys, *words, "--crs", "EPSG:4326", *gsd)
        assert "lies across the date line" in told and "--bounds" in told
    for crs in ("EPSG:32601", "EPSG:3832"):
        out = rectify(tmp_path, image, path, "--height", 0, "--crs", crs, "--gsd", 40)
        assert out.width < 2000 and (out.read(1) > 0).mean() > 0.4
    low = np.degrees(model.direct(np.array([200.0]), np.array([150.0]), np.array([0.0]))[0, 0])
    bounds = [179.9, low - 0.1, 180.0, low + 0.1]
    half = rectify(tmp_path, image, path, "--height", 0, "--crs", "EPSG:4326", "--gsd", 0.0005, "--bounds", *bounds)
    assert (half.read(1) > 0).sum() > 0


def test_a_part_of_a_scene_by_its_first_pixel_or_geotransform(scene, tmp_path):
    _, path, _, _, _, image = scene
    whole = rectify(tmp_path, image, path, "--height", 100, "--gsd", 20)
    with rasterio.open(image) as source:
        part = source.read()[:, 100:300, 50:250]
    plain = write_image(tmp_path / "part.tif", part, nodata=-1.0)
    told = write_image(tmp_path / "told.tif", part, nodata=-1.0, transform=rasterio.Affine(1, 0, 50, 0, 1, 100))
    by_hand = rectify(tmp_path, plain, path, "--height", 100, "--gsd", 20, "--first-pixel", 50, 100, name="a.tif")
    by_file = rectify(tmp_path, told, path, "--height", 100, "--gsd", 20, name="b.tif")
    assert (by_hand.read() == by_file.read()).all()
    window = rasterio.windows.from_bounds(*by_hand.bounds, whole.transform)
    other = whole.read(window=window.round_offsets().round_lengths(), boundless=True, fill_value=-1.0)
    both = (by_hand.read() > 0).all(axis=0) & (other[0] > 113) & (other[0] < 307) & (other[1] > 63) & (other[1] < 257)
    both = np.broadcast_to(both, other.shape)
    assert both.sum() > 1000 and np.abs(by_hand.read() - other)[both].max() < 0.01


FRAME = {
    "interior": {
        "focal_length_mm": 150.0, "pixel_size_mm": 0.007, "lines": 300, "samples": 400,
        "distortion": {"k1": 1e-5},
    },
    "exterior": {"lat_deg": 39.9, "lon_deg": 32.8, "height_m": 686000.0, "omega_phi_kappa_deg": [3.0, -20.0, 12.0]},
    "sigma": {"position_m": [5.0, 5.0, 5.0], "attitude_deg": [0.001, 0.001, 0.002]},
}  # fmt: skip


@pytest.mark.parametrize("how", [[], ["--plain"]])
def test_bands_show_what_they_show_in_the_image(tmp_path, how):
    """The infrared of an aerial image of red, green, blue and infrared said how opaque the others are."""
    meta = tmp_path / "frame.json"
    meta.write_text(json.dumps(FRAME))
    bands = np.full((4, 300, 400), 100, dtype=np.uint8)
    for k, (count, options) in enumerate([
        (4, {"photometric": "RGB", "alpha": "NO"}), (4, {"photometric": "MINISBLACK", "alpha": "NO"}),
        (4, {"photometric": "RGB", "alpha": "YES"}), (3, {"photometric": "RGB"}), (1, {}),
    ]):  # fmt: skip
        image = write_image(tmp_path / f"{k}.tif", bands[:count], **options)
        out = rectify(tmp_path, image, meta, "--height", 900, *how, name=f"ortho{k}.tif")
        assert out.colorinterp == rasterio.open(image).colorinterp


def test_a_frame_camera_and_its_sigmas(tmp_path):
    meta = tmp_path / "frame.json"
    meta.write_text(json.dumps(FRAME))
    camera, _ = read_frame(meta, [])
    line, sample = np.mgrid[0:300, 0:400]
    image = write_image(tmp_path / "frame.tif", np.stack([line, sample]).astype(np.float32), nodata=-1.0)
    sigma = tmp_path / "sigma.tif"
    out = rectify(tmp_path, image, meta, "--height", 900, "--sigma", sigma, "--height-sigma", 5, "--refraction")
    values = out.read()
    row, column = np.argwhere((values[0] > 100) & (values[0] < 200))[777]
    x, y = out.xy(row, column)
    from pyproj import Transformer

    lon, lat = np.radians(Transformer.from_crs(out.crs, "EPSG:4326", always_xy=True).transform(x, y))
    from triline.solver.location.refraction import Refraction

    true = camera.with_refraction(Refraction()).inverse([lat], [lon], 900.0)[0]
    assert values[:, row, column] == pytest.approx(true, abs=0.01)
    planimetric, up = rasterio.open(sigma).read()
    assert (np.isfinite(planimetric) == (values[0] >= 0)).all()
    # 5 m of position, 0.001 deg at 740 km is 13 m, and 5 m of height under 23 deg
    assert np.nanmin(planimetric) > 15.0 and np.nanmax(planimetric) < 30.0 and np.nanmax(np.abs(up - 5.0)) < 1e-3


@pytest.mark.parametrize("summit_m", [0.0, 3000.0])
def test_a_frame_camera_in_a_valley_under_summits(summit_m, tmp_path):
    low = json.loads(json.dumps(FRAME))
    low["interior"] |= {"focal_length_mm": 100.0, "pixel_size_mm": 0.1, "distortion": {}}
    low["exterior"] |= {"lat_deg": 47.0, "lon_deg": 11.0, "height_m": 2500.0, "omega_phi_kappa_deg": [4.0, -15.0, 33.0]}
    meta = tmp_path / "frame.json"
    meta.write_text(json.dumps(low))
    camera, _ = read_frame(meta, [])
    valley = Waves(47.02, 10.98, 1e-4, 400, 500, low_m=550.0, high_m=650.0)
    valley.z[189, 300] += np.float32(summit_m)
    line, sample = np.mgrid[0:300, 0:400]
    image = write_image(tmp_path / "frame.tif", np.stack([line, sample]).astype(np.float32), nodata=-1.0)
    dem = valley.write(tmp_path / "valley.tif")
    out = rectify(tmp_path, image, meta, "--dem", dem, "--dem-datum", "ellipsoid", "--crs", "EPSG:32632")
    from pyproj import Transformer

    values = out.read()
    row, column = np.argwhere((values[0] > 20) & (values[0] < 280))[::997].T
    x, y = np.array(out.xy(row, column))
    lon, lat = np.radians(Transformer.from_crs(32632, 4326, always_xy=True).transform(x, y))
    height = valley.at(lat, lon)
    flat = height < 650.0
    assert len(row) > 50 and flat.mean() > 0.9
    true = camera.inverse(lat[flat], lon[flat], height[flat])
    assert pytest.approx(true, abs=0.05) == values[:, row[flat], column[flat]].T


@pytest.mark.parametrize(("option", "value"), [("--ccd", "F"), ("--model", "rpc")])
def test_a_frame_camera_has_one_model_and_no_lines(option, value, tmp_path, capsys):
    """Both were taken, and the orthoimage was that without them."""
    (tmp_path / "frame.json").write_text(json.dumps(FRAME))
    image = write_image(tmp_path / "frame.tif", np.ones((1, 300, 400), np.float32), nodata=-1.0)
    given = (image, "--sensor", tmp_path / "frame.json", "--height", 900, option, value, "-o", tmp_path / "o.tif")
    assert f"{option} {value}" in refused(capsys, *given)
    assert not (tmp_path / "o.tif").exists()


def test_stated_errors_of_an_rpc_are_of_each_axis(scene, tmp_path):
    """As RPC00B has them: bias and random error, metres per horizontal axis."""
    _, _, model, _, _, image = scene
    rpc = replace(fit_to_model(model, -100.0, 1100.0).rpc, error_bias_m=3.0, error_random_m=4.0)
    write_rpb(tmp_path / "scene.RPB", rpc)
    sigma = tmp_path / "sigma.tif"
    rectify(tmp_path, image, tmp_path / "scene.RPB", "--height", 400, "--sigma", sigma)
    planimetric, height = rasterio.open(sigma).read()
    assert np.nanmedian(planimetric) == pytest.approx(np.sqrt(2.0) * 5.0, rel=1e-4) and np.nanmax(height) == 0.0


def test_parameters_of_a_frame_camera_by_control(tmp_path, capsys):
    """The metadata are off by 0.02 degrees, as they state, the control by what is stated, one point by 60 pixels."""
    truth, meta, rng = tmp_path / "truth.json", tmp_path / "frame.json", np.random.default_rng(2)
    turned = json.loads(json.dumps(FRAME))
    turned["exterior"]["omega_phi_kappa_deg"][0] += 0.02
    turned["sigma"]["attitude_deg"] = [0.02, 0.02, 0.02]
    truth.write_text(json.dumps(FRAME))
    meta.write_text(json.dumps(turned))
    camera, _ = read_frame(truth, [])
    image = write_image(tmp_path / "frame.tif", np.ones((1, camera.lines, camera.samples), np.float32), nodata=-1.0)
    line, sample, height = rng.uniform(0, 299, 16), rng.uniform(0, 399, 16), rng.uniform(700, 1100, 16)
    lat, lon, _ = np.degrees(camera.direct(line, sample, height)).T
    sample[4] += 60.0
    noisy = (
        lon,
        lat,
        height + 5.0 * rng.standard_normal(16),
        sample.clip(0, 399),
        line + 0.2 * rng.standard_normal(16),
    )
    control = tmp_path / "control.csv"
    control.write_text(
        "lon_deg,lat_deg,height_m,column,row\n"
        + "\n".join(",".join(map(repr, map(float, r))) for r in zip(*noisy, strict=True))
    )
    args = [
        "rectify",
        str(image),
        "--sensor",
        str(meta),
        "--height",
        "900",
        "--control",
        str(control),
        "--correction",
        "camera",
    ]
    args += ["--pixel-sigma", "0.2", "--height-sigma", "5", "-o", str(tmp_path / "o.tif")]
    assert main([*args, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["control"]
    assert found["points"] == 16 and found["rejected"] == 1 and 0.5 < found["sigma0"] < 1.6
    omega = found["parameters"]["omega"]
    assert abs(np.degrees(omega["change"]) + 0.02) < 3.5 * np.degrees(omega["sigma"])
    assert [p["point"] for p in found["corrections"]] == [k for k in range(1, 17) if k != 5]
    assert all(0 < p["row_px"]["sigma"] < 0.2 for p in found["corrections"])
    # control without errors on the ground is held: 15 m were taken
    assert main([*args, "--height-sigma", "0", "--json"]) == 0
    exact = json.loads(capsys.readouterr().out)["control"]
    places = [p[name] for p in exact["corrections"] for name in ("height_m", "east_m", "north_m")]
    assert places and all(p == {"correction": 0.0, "sigma": 0.0} for p in places)
    assert main([*args, "--sigma", str(tmp_path / "s.tif")]) == 1
    assert "--sigma: goes with --correction shift or affine" in capsys.readouterr().err
    capsys.readouterr()
    assert main([*args, "-q"]) == 0
    printed = capsys.readouterr().out
    assert "13 camera parameters" in printed
    _, value, _, sigma, unit = next(row.split() for row in printed.splitlines() if "omega" in row)
    assert unit == "deg" and float(value) == pytest.approx(np.degrees(omega["change"]), rel=1e-3)
    assert float(sigma) == pytest.approx(np.degrees(omega["sigma"]), rel=0.05) and omega["unit"] == "rad"


def aerial_photograph(folder, off_m, sigma_up_m):
    """A frame camera 2 km above relief whose metadata are that much too high; the true one, and control."""
    folder.mkdir()
    truth, rng = json.loads(json.dumps(FRAME)), np.random.default_rng(5)
    truth["exterior"].update(height_m=3000.0, omega_phi_kappa_deg=[3.0, -2.0, 12.0])
    (folder / "truth.json").write_text(json.dumps(truth))
    camera, _ = read_frame(folder / "truth.json", [])
    write_image(folder / "photo.tif", np.ones((1, camera.lines, camera.samples), np.float32), nodata=-1.0)
    line, sample, height = rng.uniform(2, 297, 24), rng.uniform(2, 397, 24), rng.uniform(700, 1400, 24)
    lat, lon, _ = np.degrees(camera.direct(line, sample, height)).T
    line, sample = (a + 0.1 * rng.standard_normal(24) for a in (line, sample))
    table = {"lon_deg": lon, "lat_deg": lat, "height_m": height, "column": sample, "row": line}
    truth["exterior"]["height_m"] += off_m
    truth["sigma"] = {"position_m": [1.0, 1.0, sigma_up_m], "attitude_deg": [0.02, 0.02, 0.02]}
    (folder / "photo.json").write_text(json.dumps(truth))
    return camera, table


def rectify_photograph(folder, table, height_sigma=0.001):
    control = folder / "control.csv"
    rows = zip(*(np.asarray(a).tolist() for a in table.values()), strict=True)
    control.write_text(",".join(table) + "\n" + "\n".join(",".join(map(repr, row)) for row in rows))
    args = ["rectify", folder / "photo.tif", "--sensor", folder / "photo.json", "--height", 900, "--control", control]
    args += ["--correction", "camera", "--pixel-sigma", 0.1, "-o", folder / "o.tif", "--json"]
    args += [] if height_sigma is None else ["--height-sigma", height_sigma]
    return main([str(a) for a in args])


def test_control_finds_the_height_of_a_photograph(tmp_path, capsys):
    """Stated to 20 m and 15 m too high: the focal length took it up, and sigma0 was 2 with all sigmas right."""
    _, table = aerial_photograph(tmp_path / "p", 15.0, 20.0)
    assert rectify_photograph(tmp_path / "p", table) == 0
    result = json.loads(capsys.readouterr().out)
    found = result["control"]
    assert found["rejected"] == 0 and 0.6 < found["sigma0"] < 1.4
    up, f = found["parameters"]["h"], found["parameters"]["f"]
    assert up["unit"] == "m" and f["unit"] == "mm" and up["sigma"] < 5.0
    assert abs(up["change"] + 15.0) < 3.5 * up["sigma"] and abs(f["change"]) < 3.5 * f["sigma"]
    assert not [note for note in result["notes"] if "let expect" in note or "taken to be good" in note]
    # nobody says how good the control is: it corrected next to nothing, and no word said why
    assert rectify_photograph(tmp_path / "p", table, None) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert "control: its points are taken to be good to 15 m in place and height; --height-sigma says better" in notes
    # known to half a metre it is not 15 m off: something else is wrong, and is named
    _, table = aerial_photograph(tmp_path / "q", 15.0, 0.5)
    assert rectify_photograph(tmp_path / "q", table) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert [n for n in notes if re.match(r"control: (up|f) [-+][\d.]+ m+: [\d.]+ times what photo.json, or usual", n)]


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("swapped", r"control.csv:2: lon_deg, lat_deg: 39.\d+, 32.\d+ is not in the image, nor within its size of it"),
        ("above", r"control.csv:2: height_m: 1\d{4}.*: the camera is at 3000 m"),
        ("from below", r"control.csv: .*no.*: wanted rows counted from above"),
    ],
)
def test_control_that_no_photograph_fits_is_refused_by_its_row(how, told, tmp_path, capsys):
    """It was "focal length -299.3" and "point 0: its condition is not a number"."""
    _, table = aerial_photograph(tmp_path / "p", 0.0, 1.0)
    if how == "swapped":
        table["lon_deg"], table["lat_deg"] = table["lat_deg"], table["lon_deg"]
    elif how == "above":
        table["height_m"] = table["height_m"] + 10_000.0
    else:
        table["row"] = 299.0 - table["row"]
    assert rectify_photograph(tmp_path / "p", table) == 1
    assert re.search(told, capsys.readouterr().err)


def test_control_corrects_a_frame_camera_by_what_it_states_to_be_uncertain(tmp_path, capsys):
    """An attitude off by half a degree, which the metadata state to a degree, or do not."""
    truth, meta, rng = tmp_path / "truth.json", tmp_path / "frame.json", np.random.default_rng(5)
    aerial = json.loads(json.dumps(FRAME))
    aerial["exterior"]["height_m"], aerial["exterior"]["omega_phi_kappa_deg"] = 3000.0, [3.0, -2.0, 12.0]
    truth.write_text(json.dumps(aerial))
    camera, _ = read_frame(truth, [])
    image = write_image(tmp_path / "frame.tif", np.ones((1, camera.lines, camera.samples), np.float32), nodata=-1.0)
    line, sample, height = rng.uniform(0, 299, 16), rng.uniform(0, 399, 16), rng.uniform(700, 1100, 16)
    lat, lon, _ = np.degrees(camera.direct(line, sample, height)).T
    line, sample = ((a + 0.2 * rng.standard_normal(16)).clip(0, n) for a, n in ((line, 299), (sample, 399)))
    control = tmp_path / "control.csv"
    rows = zip(*(a.tolist() for a in (lon, lat, height, sample, line)), strict=True)
    control.write_text("lon_deg,lat_deg,height_m,column,row\n" + "\n".join(",".join(map(repr, row)) for row in rows))
    aerial["exterior"]["omega_phi_kappa_deg"] = [3.5, -2.3, 12.8]
    args = ["rectify", image, "--sensor", meta, "--height", 900, "--control", control, "--correction", "camera"]
    args += ["--pixel-sigma", 0.2, "--height-sigma", 0.01, "-o", tmp_path / "o.tif", "--json"]
    found = {}
    for stated in (True, False):
        aerial["sigma"] = {"position_m": [3.0, 3.0, 5.0], "attitude_deg": [1.0, 1.0, 1.0]} if stated else {}
        meta.write_text(json.dumps(aerial))
        assert main([str(a) for a in args]) == 0
        found[stated] = json.loads(capsys.readouterr().out)
    assert found[True]["control"]["rejected"] == 0 and 0.5 < found[True]["control"]["sigma0"] < 1.6
    kappa = found[True]["control"]["parameters"]["kappa"]
    assert abs(kappa["change"] + np.radians(0.8)) < 3.5 * kappa["sigma"] and kappa["sigma"] < np.radians(0.1)
    assert not [note for note in found[True]["notes"] if "left out" in note]
    assert found[False]["control"]["rejected"] > 8
    assert [note for note in found[False]["notes"] if "points are left out: they contradict" in note]


@pytest.mark.parametrize("way", ["crs", "orbital", "quaternion", "navigation"])
def test_the_ways_to_state_an_orientation_agree(tmp_path, way):
    from pyproj import Transformer
    from scipy.spatial.transform import Rotation

    from triline.solver.geometry.rotation import R_BC_NOMINAL, navigation_from_matrix
    from triline.solver.orbit.motion import R_from_orbital

    def read(exterior):
        (tmp_path / "f.json").write_text(json.dumps({**FRAME, "exterior": exterior}))
        return read_frame(tmp_path / "f.json", [])[0]

    first = read(FRAME["exterior"])
    if way == "crs":  # along the meridian of the zone's middle grid and ground north agree
        middle = {**FRAME["exterior"], "lon_deg": 33.0}
        first = read(middle)
        x, y = Transformer.from_crs("EPSG:4326", "EPSG:32636", always_xy=True).transform(33.0, 39.9)
        exterior = {"crs": "EPSG:32636", "position": [x, y, 686000.0], "omega_phi_kappa_deg": [3.0, -20.0, 12.0]}
    elif way == "quaternion":
        q = Rotation.from_matrix(first.R_ec).as_quat()
        exterior = {"position_e_m": first.position_e.tolist(), "quaternion_xyzw": q.tolist()}
    elif way == "navigation":
        from triline.solver.geometry.earth import R_en

        R_nb = R_en(np.radians(39.9), np.radians(32.8)).T @ first.R_ec @ R_BC_NOMINAL.T
        angles = np.degrees(navigation_from_matrix(R_nb)).tolist()
        exterior = {"lat_deg": 39.9, "lon_deg": 32.8, "height_m": 686000.0, "roll_pitch_heading_deg": angles}
    else:
        velocity = np.array([-3000.0, -2000.0, 6500.0])
        inertial = velocity + np.cross([0, 0, 7.292115e-5], first.position_e)
        R_ob = R_from_orbital(first.position_e, inertial).T @ first.R_ec @ R_BC_NOMINAL.T
        roll, pitch, yaw = navigation_from_matrix(R_ob)
        exterior = {
            "position_e_m": first.position_e.tolist(), "velocity_e_m_s": velocity.tolist(),
            "roll_pitch_yaw_deg": np.degrees([roll, pitch, yaw]).tolist(),
        }  # fmt: skip
    second = read(exterior)
    assert np.abs(second.position_e - first.position_e).max() < 1e-3
    assert np.abs(second.R_ec - first.R_ec).max() < 1e-9


@pytest.mark.parametrize("angles", [{"roll_pitch_heading_deg": [0, 0, 30]}, {"omega_phi_kappa_deg": [0, 0, 60.0]}])
def test_angles_of_a_frame_camera_in_a_crs_are_from_its_grid_north(tmp_path, angles):
    """Three degrees from the middle of the zone grid north is 2.3 degrees off; headings were from true north."""
    from pyproj import Transformer

    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32636", always_xy=True)
    x, y = to_map.transform(36.0, 50.0)
    exterior = {"crs": "EPSG:32636", "position": [x, y, 3000.0], **angles}
    (tmp_path / "f.json").write_text(json.dumps({**FRAME, "exterior": exterior}))
    camera = read_frame(tmp_path / "f.json", [])[0]
    middle, ends = 0.5 * (camera.lines - 1), np.array([0.0, camera.samples - 1.0])
    located = camera.direct(np.full(2, middle), ends, np.zeros(2))
    east, north = np.diff(to_map.transform(np.degrees(located[:, 1]), np.degrees(located[:, 0])), axis=1)[:, 0]
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(30.0, abs=1e-3)


def test_large_cells_over_fine_heights_take_small_windows_of_them(tmp_path, monkeypatch):
    """A tile of 512 cells of 20 m took all of a raster of 1 m under it: 2.4 GB of an image of 10 km."""
    from pyproj import Transformer

    aerial = json.loads(json.dumps(FRAME))
    aerial["interior"] = {"focal_length_mm": 10.0, "pixel_size_mm": 0.02, "lines": 300, "samples": 400}
    aerial["exterior"] |= {"lon_deg": 33.0, "height_m": 10000.0, "omega_phi_kappa_deg": [0.0, 0.0, 0.0]}
    meta = tmp_path / "frame.json"
    meta.write_text(json.dumps(aerial))
    image = write_image(tmp_path / "frame.tif", np.full((1, 300, 400), 9, dtype=np.uint8))
    y = Transformer.from_crs("EPSG:4326", "EPSG:32636", always_xy=True).transform(33.0, 39.9)[1]
    with rasterio.open(
        tmp_path / "fine.tif", "w", driver="GTiff", width=9000, height=9000, count=1, dtype="int16", tiled=True,
        crs="EPSG:32636", sparse_ok=True, transform=rasterio.Affine(1.0, 0.0, 495_500.0, 0.0, -1.0, round(y) + 4500.0),
    ) as dem:  # fmt: skip
        dem.write(np.full((1, 256, 256), 120, dtype=np.int16), window=rasterio.windows.Window(0, 0, 256, 256))
    heights, sizes = HeightRaster.heights, []

    def watched(self, *window):
        sizes.append(window[2] * window[3])
        return heights(self, *window)

    monkeypatch.setattr(HeightRaster, "heights", watched)
    out = rectify(tmp_path, image, meta, "--dem", tmp_path / "fine.tif", "--dem-datum", "10")
    assert out.res == (20.0, 20.0) and (out.read(1) == 9).sum() > 0.95 * 300 * 400
    assert max(sizes) < 20e6


def test_a_frame_camera_in_local_coordinates_is_refused(tmp_path):
    """Nobody knows where they begin: its orthoimage lay at 0 N, 0 E."""
    exterior = {"crs": "local", "position": [100.0, 200.0, 3000.0], "omega_phi_kappa_deg": [0.0, 0.0, 0.0]}
    (tmp_path / "f.json").write_text(json.dumps({**FRAME, "exterior": exterior}))
    with pytest.raises(UserError, match=r"exterior.crs: 'local', wanted a projected or geographic CRS"):
        read_frame(tmp_path / "f.json", [])


def test_a_distortion_in_other_units_is_told(tmp_path):
    """Of normalised coordinates in place of mm: orthoimages were far too large, or an error was about the date line."""
    interior = {"focal_length_mm": 10.0, "pixel_size_mm": 0.02, "lines": 600, "samples": 800}

    def read(**distortion):
        notes = []
        text = json.dumps({"interior": interior | {"distortion": distortion}, "exterior": FRAME["exterior"]})
        (tmp_path / "f.json").write_text(text)
        read_frame(tmp_path / "f.json", notes)
        return notes

    assert read(k1=-8e-4, k2=1e-6) == read(k1=1e-3) == []
    assert read(k1=-1.5e-3) == ["f.json: interior.distortion: turns back within the image, 0.9 % of it have no place"]
    assert read(k1=0.27) == [
        "f.json: interior.distortion: moves places by up to 70 % of their distance: in powers of mm, of places in mm?"
    ]
    with pytest.raises(UserError, match=r"interior.distortion.k1: -0.27, wanted a distortion in powers of mm"):
        read(k1=-0.27)


def test_which_line_of_detectors_is_taken_is_told(tmp_path, capsys):
    """An image of the lens that looks backward lay 34 km off, where the first lens looks, without a word."""
    made = ["--satellite", "spot5-hrs-small", "--points", "40", "--seed", "1"]
    assert main(["simulate", "-q", "-o", str(tmp_path / "pair"), *made]) == 0
    with rasterio.open(tmp_path / "b.tif", "w", driver="GTiff", height=150, width=300, count=1, dtype="uint8") as image:
        image.write(np.full((1, 150, 300), 100, dtype=np.uint8))
    command = ["rectify", str(tmp_path / "b.tif"), "--sensor", str(tmp_path / "pair" / "spot5-hrs-small")]
    command += ["--height", "300", "-o", str(tmp_path / "o.tif"), "--json"]
    for options, told in (([], ["line of detectors F of F, B: --ccd takes another"]), (["--ccd", "B"], [])):
        assert main([*command, *options]) == 0
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert [note for note in notes if "line of detectors" in note] == told
    shutil.copy(tmp_path / "b.tif", tmp_path / "f.tif")
    both = ["rectify", str(tmp_path / "f.tif"), *command[1:4], *command[2:], "--mosaic", "--workers", "1"]
    assert main(both) == 0  # of every image of a mosaic too
    told = json.loads(capsys.readouterr().out)["notes"]
    assert told == [f"{name}: line of detectors F of F, B: --ccd takes another" for name in "fb"]


def test_control_takes_a_shift_and_a_turn_out(scene, tmp_path, capsys):
    _, path, model, relief, dem, image = scene
    rng = np.random.default_rng(4)
    u, v = rng.uniform(20, 380, 12), rng.uniform(20, 280, 12)
    g = model.direct(u, v, rng.uniform(100, 900, 12))
    measured_u, measured_v = u + 7.0 + 0.002 * v, v - 4.0 - 0.003 * u
    measured_u[3] += 40.0
    rows = [
        f"{np.degrees(lon):.10f},{np.degrees(lat):.10f},{h!r},{x!r},{y!r}"
        for (lat, lon, h), x, y in zip(g.tolist(), measured_v.tolist(), measured_u.tolist(), strict=True)
    ]
    control = tmp_path / "control.csv"
    control.write_text("lon_deg,lat_deg,height_m,column,row\n" + "\n".join(rows) + "\n")
    args = ["--dem", str(dem), "--dem-datum", "0", "--control", str(control), "--pixel-sigma", "0.1"]
    sigma = tmp_path / "s.tif"
    args += ["--sigma", str(sigma), "--json"]
    assert main(["rectify", str(image), "--sensor", str(path), "-o", str(tmp_path / "o.tif"), *args]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["control"]["points"] == 12 and result["control"]["rejected"] == 1
    assert max(result["control"]["rms_px"]) < 1e-3
    out = rasterio.open(tmp_path / "o.tif")
    values = out.read()
    row, column = np.argwhere((values[0] > 150) & (values[1] > 100))[500]
    x, y = out.xy(row, column)
    from pyproj import Transformer

    lon, lat = np.radians(Transformer.from_crs(out.crs, "EPSG:4326", always_xy=True).transform(x, y))
    a, b = model.inverse([lat], [lon], relief.at([lat], [lon]), 0.0)[0]
    assert values[:, row, column] - 10.0 == pytest.approx([a + 7.0 + 0.002 * b, b - 4.0 - 0.003 * a], abs=0.01)


def test_control_of_a_mirrored_image_is_refused_and_a_large_turn_told(scene, tmp_path, capsys):
    """Rows counted from below: the affine correction mirrored the image, with sigma0 0 and no word."""
    _, path, model, *_, image = scene
    rng = np.random.default_rng(4)
    u, v = rng.uniform(20, 280, (2, 3))
    places = model.direct(u, v, np.full(3, 300.0)) * np.degrees([1.0, 1.0, np.radians(1.0)])
    control, out = tmp_path / "control.csv", tmp_path / "o.tif"
    args = [image, "--sensor", path, "--height", 300, "--control", control, "-o", out]

    def measured(row, column):
        rows = [f"{lon!r},{lat!r},{h!r},{x!r},{y!r}" for (lat, lon, h), x, y in
                zip(places.tolist(), column.tolist(), row.tolist(), strict=True)]  # fmt: skip
        control.write_text("\n".join(["lon_deg,lat_deg,height_m,column,row", *rows, ""]))

    for row, column in ((model.lines - 1 - u, v), (v, u)):  # counted from below, and the one for the other
        measured(row, column)
        said = refused(capsys, *args)
        assert "control.csv: its points see the image as in a mirror: wanted rows counted from above" in said
        assert not out.exists()
    measured(model.lines - 1 - u, model.samples - 1 - v)
    assert main(["rectify", *map(str, args)]) == 0
    said = capsys.readouterr().out
    assert "control: 3 points, 0 rejected, no redundancy, shift of lines" in said
    assert "control.csv: turns or stretches the image by 200 % of its size" in said
    measured(u, v)
    assert main(["rectify", *map(str, args)]) == 0
    assert "turns or stretches" not in capsys.readouterr().out


def test_sigmas_of_a_correction_are_as_good_as_its_control(scene, tmp_path, capsys):
    """Nobody states how well control is measured: half a pixel was taken, were it a tenth of one or two."""
    _, path, model, _, dem, image = scene
    rng = np.random.default_rng(6)
    u, v = rng.uniform(20, 380, 60), rng.uniform(20, 280, 60)
    g = model.direct(u, v, rng.uniform(100, 900, 60))
    noise, means = rng.normal(size=(2, 60)), {}

    def sigma_with(noise_px, *options, points=60):
        control, target = tmp_path / "control.csv", tmp_path / "s.tif"
        places = list(zip(g.tolist(), v + noise_px * noise[0], u + noise_px * noise[1], strict=True))[:points]
        rows = [f"{np.degrees(lon):.10f},{np.degrees(lat):.10f},{h},{x},{y}" for (lat, lon, h), x, y in places]
        control.write_text("\n".join(["lon_deg,lat_deg,height_m,column,row", *rows, ""]))
        args = ["--dem", str(dem), "--dem-datum", "0", "--control", str(control), "--sigma", str(target), *options]
        assert main(["rectify", str(image), "--sensor", str(path), "-o", str(tmp_path / "o.tif"), *args, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["control"]["rejected"] == 0
        with rasterio.open(target) as found:
            return float(np.nanmean(found.read(1))), told["notes"]

    for noise_px in (0.1, 0.4, 3.0):  # of three pixels two thirds of the control counted as gross errors
        means[noise_px], notes = sigma_with(noise_px)
        assert any("with control as good as it fits" in note for note in notes)
    assert means[0.4] / means[0.1] == pytest.approx(4.0, rel=0.01)
    assert means[3.0] / means[0.1] == pytest.approx(30.0, rel=0.02)
    stated, notes = sigma_with(0.1, "--pixel-sigma", "0.5")
    assert not any("as good as it fits" in note for note in notes)
    without = "sigma: the heights of the ground are taken as without error; --height-sigma states theirs"
    assert without in notes and without not in sigma_with(0.1, "--height-sigma", "0.5")[1]
    assert stated > 4.0 * means[0.1]
    # four points have two observations too many, which fit by chance
    few, notes = sigma_with(0.1, points=4)
    assert any("few points do not tell (0.5 px)" in note for note in notes)
    assert few == pytest.approx(sigma_with(0.0, points=4)[0], rel=0.01)
    assert few > 10.0 * means[0.1] and sigma_with(3.0, points=4)[0] > 1.5 * few


# -- what is said of bad input -------------------------------------------------------------------------------------


def test_heights_are_refused_without_a_datum_elsewhere_and_of_another_planet(scene, tmp_path, capsys):
    _, path, _, relief, dem, image = scene
    base = [image, "--sensor", path, "-o", tmp_path / "o.tif", "--dem"]
    assert "wanted --dem-datum ellipsoid" in refused(capsys, *base, dem)
    far = replace(relief, lon_deg=relief.lon_deg + 30.0).write(tmp_path / "far.tif")
    assert "does not cover the pixels of the image" in refused(capsys, *base, far, "--dem-datum", "ellipsoid")
    moon = relief.write(tmp_path / "moon.tif", "+proj=longlat +a=1737400 +b=1737400 +no_defs")
    assert "another planet" in refused(capsys, *base, moon, "--dem-datum", "ellipsoid")
    assert "neither a file nor a CRS" in refused(capsys, *base, dem, "--dem-datum", "sea")
    assert "says nothing of heights" in refused(capsys, *base, dem, "--dem-datum", "EPSG:4326")
    assert "no such file" in refused(capsys, *base, tmp_path / "none.tif", "--dem-datum", "0")
    (tmp_path / "text.tif").write_text("heights")
    assert "not a raster" in refused(capsys, *base, tmp_path / "text.tif", "--dem-datum", "0")
    assert "goes with --dem" in refused(capsys, *base[:-1], "--dem-datum", "0")
    assert "--occlusions: goes with --dem" in refused(capsys, *base[:-1], "--height", "0", "--occlusions")
    assert not (tmp_path / "o.tif").exists()


def test_a_geoid_without_its_grid_is_named(scene, tmp_path, capsys):
    import pyproj

    if pyproj.transformer.TransformerGroup("EPSG:4326+5773", "EPSG:4979").best_available:
        pytest.skip("the grid of EGM96 is installed")
    _, path, _, _, dem, image = scene
    error = refused(capsys, image, "--sensor", path, "-o", tmp_path / "o.tif", "--dem", dem, "--dem-datum", "EPSG:5773")
    assert "geoid grid is not installed" in error


def test_geoid_heights_by_number_and_by_raster(scene, tmp_path):
    _, path, _, relief, dem, image = scene
    geoid = replace(relief, low_m=40.0, high_m=40.0).write(tmp_path / "geoid.tif")
    args = ("--dem", dem, "--dem-datum")
    number = rectify(tmp_path, image, path, *args, 40.0, name="n.tif").read()
    raster = rectify(tmp_path, image, path, *args, geoid, name="r.tif").read()
    ellipsoid = rectify(tmp_path, image, path, *args, "ellipsoid", name="e.tif").read()
    assert number.shape == raster.shape and np.abs(number - raster).max() < 1e-3
    assert number.shape != ellipsoid.shape or np.abs(number - ellipsoid).max() > 0.3


def test_a_geoid_as_large_as_heights_that_cover_a_part(scene, tmp_path, capsys):
    """Where nobody knows the ground, nobody has to know the geoid; where it is known, a hole would be silent."""
    _, path, _, relief, _, image = scene
    part, whole = replace(relief, rows=80, columns=50), replace(relief)
    part.z, whole.z = relief.z[:80, :50], relief.z
    dem = part.write(tmp_path / "part.tif")
    geoid = replace(part, low_m=40.0, high_m=40.0).write(tmp_path / "geoid.tif")
    wider = replace(whole, low_m=40.0, high_m=40.0).write(tmp_path / "wider.tif")
    smaller = replace(part, columns=30, low_m=40.0, high_m=40.0).write(tmp_path / "smaller.tif")
    args = ("--dem", dem, "--gsd", 10, "--dem-datum")
    wanted = rectify(tmp_path, image, path, *args, wider, name="w.tif").read()
    for datum in (geoid, 40.0):
        found = rectify(tmp_path, image, path, *args, datum, name="f.tif").read()
        assert found.shape == wanted.shape and np.abs(found - wanted).max() < 1e-3
    assert (wanted == -1.0).mean() > 0.2 and (wanted > 0.0).mean() > 0.2
    error = refused(capsys, image, "--sensor", path, "-o", tmp_path / "o.tif", *args, smaller)
    assert "smaller.tif: no geoid height at " in error


@pytest.mark.parametrize("first", [-180.0, 0.0])
@pytest.mark.parametrize("seam", [0.0, 180.0])
def test_rasters_round_the_earth_have_no_gap_where_they_begin(scene, tmp_path, first, seam):
    """Heights and geoid heights of the whole Earth, under images at both of the meridians where such rasters begin."""
    _, _, model, _, _, image = scene
    step = 1.0
    lon = np.arange(first + 0.5 * step, first + 360.0, step)
    z = np.broadcast_to(20.0 * np.cos(np.radians(lon)), (180, len(lon))).astype(np.float32)
    world = write_image(
        tmp_path / "world.tif", z[None], crs="EPSG:4326", transform=rasterio.Affine(step, 0, first, 0, -step, 90)
    )
    middle = np.degrees(model.direct([200.0], [150.0], [0.0])[0, 1])
    path = write_dimap2(tmp_path / "seam.xml", replace(TRUTH, node_deg=TRUTH.node_deg + seam - middle))
    args = ("--gsd", 10)
    height = 20.0 * np.cos(np.radians(seam + 0.5 * step))  # the same on both sides of the meridian
    wanted = rectify(tmp_path, image, path, *args, "--height", 2.0 * height, name="w.tif")
    found = rectify(tmp_path, image, path, *args, "--dem", world, "--dem-datum", world, name="f.tif")
    assert found.bounds == wanted.bounds and np.abs(found.read() - wanted.read()).max() < 0.01


def test_heights_that_cover_a_part_and_tiles_of_heights(scene, tmp_path, capsys):
    _, path, model, relief, dem, image = scene
    half = tmp_path / "tiles"
    half.mkdir()
    corner = np.degrees(np.ravel(model.direct(0.0, 0.0, float(relief.z.mean())))[:2])
    column, row = (corner[1] - relief.lon_deg) / relief.step_deg, (relief.lat_deg - corner[0]) / relief.step_deg
    hole = replace(relief)
    hole.z = relief.z.copy()
    hole.z[int(row) - 1 : int(row) + 3, int(column) - 1 : int(column) + 3] = np.nan
    words = [image, "--sensor", path, "-o", tmp_path / "o.tif", "--dem", hole.write(tmp_path / "hole.tif")]
    assert main(["rectify", *map(str, words), "--dem-datum", "ellipsoid", "--gsd", "100"]) == 0
    assert "hole.tif: covers more than 99 % of the image, the rest is missing" in capsys.readouterr().out
    left, right = (
        replace(relief, columns=61),
        replace(relief, lon_deg=relief.lon_deg + 60 * relief.step_deg, columns=60),
    )
    left.z, right.z = relief.z[:, :61], relief.z[:, 60:]
    left.write(half / "left.tif")
    args = ("--dem-datum", "ellipsoid", "--mask", tmp_path / "m.tif")
    rectify(tmp_path, image, path, "--dem", half / "left.tif", *args, name="part.tif")
    assert 2 in np.unique(rasterio.open(tmp_path / "m.tif").read(1))
    right.write(half / "right.tif")
    whole = rectify(tmp_path, image, path, "--dem", dem, *args, name="whole.tif").read()
    tiles = rectify(tmp_path, image, path, "--dem", half, *args, name="tiles.tif").read()
    assert whole.shape == tiles.shape and np.abs(whole - tiles).max() < 1e-3
    before = (half / "left.tif").read_bytes()
    for words in (["-o", half / "left.tif"], ["-o", tmp_path / "p.tif", "--sigma", half / "left.tif"]):
        told = refused(capsys, image, "--sensor", path, "--dem", half, "--dem-datum", "ellipsoid", *words)
        assert "left.tif: the output would overwrite" in told
    assert (half / "left.tif").read_bytes() == before and not (tmp_path / "p.tif").exists()


def test_a_mosaic_begins_anew_where_a_tile_of_heights_or_the_geoid_has_changed(scene, tmp_path, capsys):
    _, path, _, relief, dem, image = scene
    tiles, geoid = tmp_path / "tiles", tmp_path / "geoid.tif"
    tiles.mkdir()

    def write(target, heights):
        shutil.copy(dem, target)
        with rasterio.open(target, "r+") as raster:
            raster.write(heights.astype(np.float32), 1)

    words = ["--sensor", path, "--mosaic", "--workers", 1, "--keep", "--gsd", 10, "--dem", tiles, "--dem-datum", geoid]
    made = []
    for name, heights in (("both", relief.z), ("tile", relief.z + 150.0), ("geoid", 0.0 * relief.z + 50.0)):
        if name != "geoid":
            write(tiles / "tile.tif", heights)
        if name != "tile":
            write(geoid, 0.0 * relief.z if name == "both" else heights)
        out = tmp_path / "block.tif"
        assert main(["rectify", str(image), "-o", str(out), "-q", *map(str, words)]) == 0
        made.append(rasterio.open(out).read())
    assert not np.array_equal(made[0], made[1]) and not np.array_equal(made[1], made[2])


def test_sizes_control_and_options_that_do_not_fit(scene, tmp_path, capsys):
    _, path, model, _, dem, image = scene
    base = [image, "--sensor", path, "-o", tmp_path / "o.tif", "--height", 0]
    small = write_image(tmp_path / "small.tif", np.ones((1, 50, 60), dtype=np.uint8))
    error = refused(capsys, small, *base[1:])
    assert "60 x 50 pixels" in error and "300 x 400" in error
    assert "columns 280 to 339" in refused(capsys, small, *base[1:], "--first-pixel", 280, 0)
    control = tmp_path / "control.csv"
    head = "lon_deg,lat_deg,height_m,column,row\n"
    lat, lon = np.degrees(model.direct(np.array([5.0]), np.array([5.0]), np.array([0.0]))[0, :2])
    control.write_text(head + f"{lon},{lat},0,5,5\n")
    assert "1 control points, wanted at least 3" in refused(capsys, *base, "--control", control)
    control.write_text(head + f"{lon},{lat},0,5,500\n" * 3)
    assert "control.csv:2: row: 500: outside" in refused(capsys, *base, "--control", control)
    control.write_text(head + f"{lon},{lat},0,5,5\n" * 2 + f"{lon + 40},{lat},0,5,5\n")
    error = refused(capsys, *base, "--control", control)
    assert f"control.csv:4: lon_deg, lat_deg: {lon + 40:g}, {lat:g} is not in the image" in error
    assert "--correction affine: goes with --control" in refused(capsys, *base, "--correction", "affine")
    error = refused(capsys, *base, "--control", control, "--pixel-sigma", 0)
    assert "--pixel-sigma 0: wanted more than 0 with --control" in error
    for name in ("pixel", "height"):
        assert f"--{name}-sigma: goes with --sigma FILE or" in refused(capsys, *base, f"--{name}-sigma", 0.3)
    assert "--attitude-sigma: goes with --sigma FILE" in refused(capsys, *base, "--attitude-sigma", 1, 1, 1)
    assert "wanted one of them" in refused(capsys, *base, "--dem", dem)
    assert "would overwrite" in refused(capsys, image, "--sensor", path, "-o", image)
    assert "no sigma is known" in refused(capsys, *base, "--sigma", tmp_path / "s.tif")
    assert "PROJ does not know" in refused(capsys, *base, "--crs", "EPSG:1")
    assert "another planet" in refused(capsys, *base, "--crs", "+proj=longlat +a=1737400 +b=1737400")
    (tmp_path / "f.json").write_text(json.dumps({**FRAME, "exterior": {"lat_deg": 1.0, "lon_deg": 2.0}}))
    assert "height_m: missing" in refused(capsys, image, "--sensor", tmp_path / "f.json", "-o", tmp_path / "o.tif")
    swapped = {"lat_deg": 139.6, "lon_deg": 36.0, "height_m": 1e5, "omega_phi_kappa_deg": [0, 0, 0]}
    (tmp_path / "f.json").write_text(json.dumps({**FRAME, "exterior": swapped}))
    error = refused(capsys, image, "--sensor", tmp_path / "f.json", "-o", tmp_path / "o.tif")
    assert "f.json: exterior.lat_deg: 139.6, wanted degrees from -90 to 90" in error
    assert "--mask: goes with an image" in refused(
        capsys, "recordings/strip.mcap", "-o", tmp_path / "o.tif", "--mask", tmp_path / "m.tif"
    )


@pytest.mark.parametrize("crs, unit", [("EPSG:3857", "m"), ("EPSG:2225", "ft_us"), ("EPSG:4326", "deg")])
def test_cells_are_told_with_their_unit(scene, tmp_path, capsys, crs, unit):
    _, path, _, _, _, image = scene
    out = tmp_path / "o.tif"
    for more in ([], ["--mosaic", "--workers", "1", "--balance", "none"]):
        assert (
            main(["rectify", str(image), "--sensor", str(path), "-o", str(out), "--height", "0", "--crs", crs, *more])
            == 0
        )
        size = rasterio.open(out).transform.a
        assert f"cells of {size:g} {unit} in {crs}, " in capsys.readouterr().out


def test_a_map_whose_datum_shift_is_not_here(scene, tmp_path, capsys):
    _, path, _, _, _, image = scene
    if not missing_grids("EPSG:31467"):
        pytest.skip("PROJ has the grid here")
    out = tmp_path / "o.tif"
    for crs, said in (("EPSG:31467", 1), ("EPSG:31467+EPSG:5773", 1), ("EPSG:3035", 0)):
        args = ["--height", "0", "--crs", crs, "--json"]
        assert main(["rectify", str(image), "--sensor", str(path), "-o", str(out), *args]) == 0
        notes = [note for note in json.loads(capsys.readouterr().out)["notes"] if "datum shift" in note]
        assert len(notes) == said and all("no grid de_adv_BETA2007.tif here" in note for note in notes)
    # the way back to the CRS of the control has no error of its own
    assert notes_of_map("EPSG:31467", "EPSG:31467+EPSG:5773") == notes_of_map("local", "EPSG:31467") == []
    assert notes_of_map("EPSG:31467", "EPSG:25832") and not notes_of_map("+proj=longlat +a=1737400 +b=1737400")


def test_heights_whose_datum_shift_is_not_here(scene, tmp_path, capsys):
    """Heights of a CRS that PROJ brings to WGS 84 but roughly lie metres beside their places."""
    _, path, _, relief, dem, image = scene
    if not missing_grids("EPSG:31467"):
        pytest.skip("PROJ has the grid here")
    shifted = rasterio.open(relief.write(tmp_path / "dhdn.tif", "EPSG:4314")).name
    (tmp_path / "pixels.csv").write_text("column,row\n100,100\n")
    of_image = ["rectify", str(image), "--sensor", str(path), "-o", str(tmp_path / "o.tif")]
    of_pixels = ["locate", str(path), "--pixels", str(tmp_path / "pixels.csv"), "-o", str(tmp_path / "o.csv")]
    for command in (of_image, of_pixels):
        for heights, said in ((shifted, 1), (str(dem), 0)):
            assert main([*command, "--dem", heights, "--dem-datum", "ellipsoid", "--json"]) == 0
            notes = [note for note in json.loads(capsys.readouterr().out)["notes"] if "datum shift" in note]
            assert len(notes) == said and all(
                "dhdn.tif: PROJ has no grid de_adv_BETA2007.tif" in note for note in notes
            )


# -- real images ---------------------------------------------------------------------------------------------------

VENTOUX = DATA / "satellites" / "phr_ventoux"


@pytest.mark.skipif(not VENTOUX.is_dir(), reason="the two looks of Ventoux are not there")
def test_two_looks_of_ventoux_lie_on_each_other(tmp_path):
    from ventoux import summary

    found = summary(VENTOUX, tmp_path)
    assert found["matches"] >= 100
    assert found["corrected_median"] < 0.5 < found["rpc_median"]
    # across the direction in which SRTM's height errors (some metres, under trees) move the two looks apart
    assert found["corrected_across"] < 0.5
