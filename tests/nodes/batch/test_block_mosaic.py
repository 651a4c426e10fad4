"""`triline rectify --mosaic` of orthoimages over a known ground: tones, seams, sigmas, bytes, runs that go on."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import rasterio
from block_of_orthoimages import GSD, LEFT, TOP, make_block
from rio_cogeo.cogeo import cog_validate

from triline.nodes.batch.mosaic_layers import Layer
from triline.nodes.cli import main
from triline.nodes.formats.geotiff import Raster, TilePlace, write_tile, write_virtual

ENDS = ("tif", "source.tif", "seams.geojson", "sigma.tif")


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return make_block(tmp_path_factory.mktemp("block"))


def _mosaic(block, target, *more):
    sigmas = [word for path in block.sigmas for word in ("--input-sigma", str(path))]
    words = [*map(str, block.files), "--mosaic", "--tile", "256", "--sigma", f"{target.with_suffix('')}.sigma.tif"]
    return ["rectify", *words, *sigmas, "-o", str(target), *more]


def _bytes(target):
    return {end: target.with_suffix(f".{end}").read_bytes() for end in ENDS}


@pytest.fixture(scope="module")
def made(block, tmp_path_factory):
    target = tmp_path_factory.mktemp("one") / "block.tif"
    assert main(_mosaic(block, target, "--workers", "1", "--keep", "--json", "--stac", str(target) + ".json")) == 0
    return target


def test_mosaic_shows_the_ground_in_one_tone(block, made, capsys):
    assert main(_mosaic(block, made, "--workers", "1", "--keep", "--json")) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["continued"] > 10  # nothing had to be done again
    layers = told["bands"][0]["layers"]
    for k, layer in enumerate(layers):
        assert abs(layer["gain"] - block.gain[k]) < 4 * layer["gain_sigma"] < 0.05
        assert abs(layer["offset"] - block.offset[k]) < 4 * layer["offset_sigma"]
    step = told["step_across_seams"]
    assert step["raw_tone_rms"] > 50 and step["balanced_tone_rms"] < 6
    assert told["bands"][0]["refused"] > 0  # places where the truck stands
    valid, errors, warnings = cog_validate(str(made), strict=True)
    assert valid and not errors and not warnings
    with rasterio.open(made) as mosaic:
        assert (mosaic.transform.c, mosaic.transform.f, mosaic.transform.a) == (LEFT, TOP, GSD)
        grey = mosaic.read(1).astype(float)
    assert grey.shape == block.ground.shape
    known = grey > 0
    assert known[3:].all()
    # the mean gain is 1 and the mean offset 0: the mosaic has the tone of the ground itself
    assert np.median(np.abs(grey - block.ground)[known]) < 10
    with (
        rasterio.open(made.with_suffix(".source.tif")) as source,
        rasterio.open(made.with_suffix(".sigma.tif")) as sigmas,
    ):
        layer, sigma = source.read(1), sigmas.read(1)
    assert set(np.unique(layer[known])) == {1, 2, 3}
    inside = np.zeros_like(known)
    inside[:100] = True  # far from the first seam
    np.testing.assert_allclose(sigma[inside & known], block.sigma_m[0], rtol=1e-5)
    assert block.sigma_m[0] - 1e-6 <= np.nanmin(sigma) and np.nanmax(sigma) <= block.sigma_m[-1] + 1e-6


def test_inputs_of_one_name_are_told_apart(block, tmp_path, capsys):
    """Every layer has its own cells and its own name, although the files of both days are called alike."""
    for day, path in zip(("day1", "day2"), block.files, strict=False):
        (tmp_path / day).mkdir()
        shutil.copy(path, tmp_path / day / "ortho.tif")
    inputs = [str(tmp_path / day / "ortho.tif") for day in ("day1", "day2")]
    target = tmp_path / "both.tif"
    assert main(["rectify", *inputs, "--mosaic", "--tile", "256", "--workers", "1", "-o", str(target), "--json"]) == 0
    layers = json.loads(capsys.readouterr().out)["layers"]
    assert [layer["name"] for layer in layers] == ["day1/ortho", "day2/ortho"]
    with rasterio.open(target.with_suffix(".source.tif")) as source:
        numbers = source.read(1)
        assert source.tags()["layers"] == "1 day1/ortho, 2 day2/ortho"
    assert [layer["cells"] for layer in layers] == [(numbers == 1).sum(), (numbers == 2).sum()]
    seams = json.loads(target.with_suffix(".seams.geojson").read_text())["features"]
    assert {tuple(seam["properties"]["layers"]) for seam in seams} == {("day1/ortho", "day2/ortho")}


def test_a_mosaic_has_one_no_data_value(tmp_path):
    """Also where it is of a layer with another one alone."""
    inputs = []
    for k, nodata in enumerate((0, 65535)):
        values = np.full((1, 200, 300), 1000, dtype=np.uint16)
        values[0, 50:150, 100:200] = nodata
        inputs.append(tmp_path / f"ortho{k}.tif")
        place = rasterio.Affine(GSD, 0, LEFT + 800 * k * GSD, 0, -GSD, TOP)
        shape = {"driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "uint16", "crs": "EPSG:32632"}
        with rasterio.open(inputs[-1], "w", transform=place, nodata=nodata, **shape) as target:
            target.write(values)
    target = tmp_path / "block.tif"
    words = [*map(str, inputs), "--mosaic", "--tile", "128", "--workers", "1", "-o", str(target), "-q"]
    assert main(["rectify", *words]) == 0
    with rasterio.open(target) as image:
        values = image.read(1)
        assert image.nodata == 0 and set(np.unique(values)) == {0, 1000}
        assert (values == 1000).sum() == 2 * (200 * 300 - 100 * 100)


def test_what_12_bits_saturate_says_nothing_of_tones(tmp_path, capsys):
    """Clouds and snow at 4095 in both of two strips, whose values stand in 16 bits, made their gains alike."""
    rng = np.random.default_rng(8)
    ground = np.repeat(np.repeat(rng.uniform(300.0, 6000.0, (32, 36)), 16, axis=0), 16, axis=1)
    inputs = []
    for k, (left, gain) in enumerate(((0, 1.0), (64, 0.8))):
        values = gain * ground[:, left : left + 512] + rng.normal(0.0, 5.0, (512, 512))
        values = np.clip(np.rint(values), 1, 4095).astype(np.uint16)
        inputs.append(tmp_path / f"ortho{k}.tif")
        place = rasterio.Affine(GSD, 0, LEFT + left * GSD, 0, -GSD, TOP)
        shape = {"driver": "GTiff", "height": 512, "width": 512, "count": 1, "dtype": "uint16", "crs": "EPSG:32632"}
        with rasterio.open(inputs[-1], "w", transform=place, nodata=0, **shape) as target:
            target.write(values[None])
    words = [*map(str, inputs), "--mosaic", "--tile", "256", "--balance", "gain", "--workers", "1"]
    assert main(["rectify", *words, "-o", str(tmp_path / "block.tif"), "--json"]) == 0
    one, other = json.loads(capsys.readouterr().out)["bands"][0]["layers"]
    sigma = float(np.hypot(one["gain_sigma"], other["gain_sigma"]))
    assert abs(other["gain"] / one["gain"] - 0.8) < 4.0 * sigma < 0.01


def test_pictures_of_other_ground_are_left_as_they_are(tmp_path, capsys):
    """Their balance made the step from one to the other larger, without a word."""
    rng = np.random.default_rng(8)
    inputs = []
    for k, left in enumerate((0, 64)):
        values = np.repeat(np.repeat(rng.uniform(300.0, 6000.0, (32, 32)), 16, axis=0), 16, axis=1)
        inputs.append(tmp_path / f"ortho{k}.tif")
        place = rasterio.Affine(GSD, 0, LEFT + left * GSD, 0, -GSD, TOP)
        shape = {"driver": "GTiff", "height": 512, "width": 512, "count": 1, "dtype": "uint16", "crs": "EPSG:32632"}
        with rasterio.open(inputs[-1], "w", transform=place, nodata=0, **shape) as target:
            target.write(np.rint(values).astype(np.uint16)[None])
    words = ["rectify", *map(str, inputs), "--mosaic", "--tile", "256", "--workers", "1", "-o"]
    assert main([*words, str(tmp_path / "block.tif"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "times worse: too few places, or layers that do not show the same ground" in told["balance_left_out"]
    assert [layer["gain"] for layer in told["bands"][0]["layers"]] == [1.0, 1.0]
    assert told["step_across_seams"]["balanced_rms"] == told["step_across_seams"]["raw_rms"] > 0
    assert main([*words, str(tmp_path / "again.tif")]) == 0
    said = capsys.readouterr().out
    assert f"  no balance: {told['balance_left_out']}\n" in said
    assert "gain, offset" not in said and "balance by" not in said and "after the balance" not in said


@pytest.mark.parametrize("told", ["alpha", "mask"])
def test_what_an_orthoimage_says_not_to_count_is_no_part_of_the_mosaic(told, tmp_path, capsys):
    """Alpha of 255 was taken for saturated, so that nothing was balanced; masks did not count."""
    y, x = np.mgrid[0:200, 0:320]
    ground = 100.0 + 40.0 * np.sin(x / 9.0) * np.cos(y / 7.0)
    ground[100:110, 20:30] = 0.0  # black is a value
    files = []
    for k, (first, gain) in enumerate([(0, 1.0), (120, 1.2)]):
        grey = np.rint(ground[:, first : first + 200] * gain).astype(np.uint8)
        there = np.full(grey.shape, 255, dtype=np.uint8)
        there[50:80, 85:115] = 0  # white under it
        bands = np.stack([grey, grey, grey, there])
        bands[:3, there == 0] = 255
        files.append(tmp_path / f"{k}.tif")
        kind = {"photometric": "RGB", "alpha": "YES"} if told == "alpha" else {}
        with rasterio.open(
            files[-1], "w", driver="GTiff", width=200, height=200, count=4 if told == "alpha" else 3, dtype="uint8",
            crs="EPSG:32633", transform=rasterio.Affine(0.5, 0, 5e5 + 0.5 * first, 0, -0.5, 5e6), **kind,
        ) as target:  # fmt: skip
            target.write(bands[: target.count])
            if told == "mask":
                target.write_mask(there)
    out = tmp_path / "both.tif"
    assert main(["rectify", *map(str, files), "--mosaic", "-o", str(out), "--workers", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    for band in result["bands"]:
        one, two = band["layers"]
        assert one["tied"] and two["gain"] / one["gain"] == pytest.approx(1.2, abs=0.01)
    assert len(result["bands"]) == 3
    assert len([note for note in result["notes"] if "its alpha band says" in note]) == (2 if told == "alpha" else 0)
    with rasterio.open(out) as mosaic:
        values = mosaic.read()
        assert mosaic.count == 3 and mosaic.nodata == 0
    seen = np.ones((200, 320), dtype=bool)
    seen[50:80, 85:115] = seen[50:80, 205:235] = False
    assert ((values > 0) == seen).all() and values[:, 102:108, 22:28].max() == 1 and values[:, seen].max() < 200


def test_seam_lines_are_where_the_source_changes(made):
    seams = json.loads(made.with_suffix(".seams.geojson").read_text())["features"]
    pairs = {tuple(f["properties"]["layers"]) for f in seams}
    assert pairs == {("strip0", "strip1"), ("strip1", "strip2")}
    lon, lat = np.concatenate([f["geometry"]["coordinates"] for f in seams]).T
    assert lon.min() > 8.9 and lon.max() < 9.1 and 48.6 < lat.min() < lat.max() < 48.8
    ends = [tuple(f["geometry"]["coordinates"][k]) for f in seams for k in (0, -1)]
    lonely = [end for end in ends if ends.count(end) == 1]
    assert len(lonely) == 4  # two seams from edge to edge of the block, whole across the tiles


def test_stac_item_says_where_the_mosaic_is(made):
    item = json.loads((made.parent / (made.name + ".json")).read_text())
    assert item["type"] == "Feature" and item["stac_version"] == "1.0.0"
    assert {"mosaic", "source", "seams", "sigma"} == set(item["assets"])
    assert all((made.parent / asset["href"]).exists() for asset in item["assets"].values())
    assert item["properties"]["gsd"] == GSD and item["properties"]["datetime"] == item["properties"]["created"]
    west, south, east, north = item["bbox"]
    assert 8.99 < west < east < 9.05 and 48.7 < south < north < 48.8


def test_stac_item_across_the_date_line_does_not_go_round_the_world(tmp_path):
    """In UTM zone 1: two polygons, and the bounds from west to east (RFC 7946)."""
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32601", always_xy=True).transform(180.0, 48.0)
    place = rasterio.Affine(2, 0, round(x / 2) * 2 - 400, 0, -2, round(y / 2) * 2)
    ortho, item = tmp_path / "ortho.tif", tmp_path / "item.json"
    shape = {"driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "uint16", "crs": "EPSG:32601"}
    with rasterio.open(ortho, "w", transform=place, nodata=0, **shape) as target:
        target.write(np.full((1, 200, 300), 1000, dtype=np.uint16))
    words = [
        "rectify",
        ortho,
        "--mosaic",
        "--tile",
        128,
        "-o",
        tmp_path / "m.tif",
        "--stac",
        item,
        "--workers",
        1,
        "-q",
    ]
    assert main([*map(str, words)]) == 0
    told = json.loads(item.read_text())
    west, _, east, _ = told["bbox"]
    assert 179.9 < west < 180.0 and -180.0 < east < -179.9
    a_degree = 111320.0 * np.cos(np.radians(48.0))
    widths = []
    for (ring,) in told["geometry"]["coordinates"]:
        ring = np.array(ring)
        assert (ring[0] == ring[-1]).all() and np.abs(np.abs(ring[:, 0]) - 180.0).min() == 0.0
        widths.append(np.ptp(ring[:, 0]) * a_degree)
    assert widths == pytest.approx([400.0, 200.0], abs=40.0)  # meridians are not parallel to the grid


@pytest.mark.parametrize(("crs", "pole"), [("EPSG:3031", -90.0), ("EPSG:3413", 90.0)])
def test_stac_item_round_a_pole(crs, pole, tmp_path):
    """All longitudes, up to the pole: it had two polygons without the pole, and bounds from 0 to -20 degrees."""
    from pyproj import Transformer

    ortho, item = tmp_path / "ortho.tif", tmp_path / "item.json"
    shape = {"driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "uint16", "crs": crs}
    with rasterio.open(ortho, "w", transform=rasterio.Affine(2, 0, -300, 0, -2, 200), nodata=0, **shape) as target:
        target.write(np.full((1, 200, 300), 1000, dtype=np.uint16))
    words = ["rectify", ortho, "--mosaic", "-o", tmp_path / "m.tif", "--stac", item, "--workers", 1, "-q"]
    assert main([*map(str, words)]) == 0
    told = json.loads(item.read_text())
    west, south, east, north = told["bbox"]
    assert (west, east) == (-180.0, 180.0) and pole in (south, north) and abs(south) > 89.995 and abs(north) > 89.995
    (ring,) = told["geometry"]["coordinates"]
    lon, lat = np.array(ring).T
    assert told["geometry"]["type"] == "Polygon" and ring[0] == ring[-1]
    area = 0.5 * np.sum(lon[:-1] * lat[1:] - lon[1:] * lat[:-1])  # counterclockwise; sum of the strips to the pole
    inner = np.abs(lat) < 90.0
    order = np.argsort(lon[inner])
    assert area == pytest.approx(np.trapezoid(90.0 - np.abs(lat[inner][order]), lon[inner][order]), rel=1e-6)
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon[inner], lat[inner])
    on_edge = np.minimum(np.minimum(abs(x + 300), abs(x - 300)), np.minimum(abs(y - 200), abs(y + 200)))
    assert np.sort(on_edge)[-4:-3] < 0.01 and on_edge.max() < 20.0  # between places the edge is a straight line


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832+7837", "ESRI:102013"])
def test_stac_item_says_which_crs_its_cells_are_in(crs, tmp_path):
    """Without an EPSG number by its words; shape and transform were left without any system."""
    import pyproj

    ortho, item = tmp_path / "ortho.tif", tmp_path / "item.json"
    shape = {"driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "uint16", "crs": crs}
    with rasterio.open(ortho, "w", transform=rasterio.Affine(2, 0, 5e5, 0, -2, 1e6), nodata=0, **shape) as target:
        target.write(np.full((1, 200, 300), 1000, dtype=np.uint16))
    out = tmp_path / "m.tif"
    words = ["rectify", ortho, "--mosaic", "-o", out, "--stac", item, "--workers", 1, "-q"]
    assert main([*map(str, words)]) == 0
    told = json.loads(item.read_text())["properties"]
    assert told["proj:epsg"] == (32632 if crs == "EPSG:32632" else None) and ("proj:wkt2" in told) == (
        crs[-5:] != "32632"
    )
    said = pyproj.CRS.from_user_input(told.get("proj:wkt2") or told["proj:epsg"])
    with rasterio.open(out) as mosaic:
        assert said.equals(pyproj.CRS.from_user_input(crs), ignore_axis_order=True)
        assert told["proj:transform"] == list(mosaic.transform)[:6] and told["proj:shape"] == list(mosaic.shape)


def test_seam_lines_across_the_date_line_are_cut_there(tmp_path):
    """As RFC 7946 asks for; they went round the world from 179.999 to -179.999 degrees."""
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32601", always_xy=True).transform(180.0, 48.0)
    shape = {"driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "uint16", "crs": "EPSG:32601"}
    paths, rng = [], np.random.default_rng(1)
    for k in range(2):  # one to the north of the other, with half of it in common
        place = rasterio.Affine(2, 0, round(x / 2) * 2 - 400, 0, -2, round(y / 2) * 2 - 200 * k)
        paths.append(tmp_path / f"ortho{k}.tif")
        with rasterio.open(paths[-1], "w", transform=place, nodata=0, **shape) as target:
            target.write(rng.integers(900, 1100, (1, 200, 300), dtype=np.uint16))
    words = ["rectify", *paths, "--mosaic", "--tile", 512, "-o", tmp_path / "m.tif", "--workers", 1, "-q"]
    assert main([*map(str, words)]) == 0
    features = json.loads((tmp_path / "m.seams.geojson").read_text())["features"]
    cut = [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "MultiLineString"]
    assert len(cut) == 1
    for parts in (*cut, *([f["geometry"]["coordinates"]] for f in features if f["geometry"]["type"] == "LineString")):
        assert all(np.ptp(np.array(part)[:, 0]) < 0.01 for part in parts)
    (west, east) = sorted(cut[0], key=lambda part: -part[0][0])
    ends = {part[k][0]: part[k][1] for part in (west, east) for k in (0, -1) if abs(part[k][0]) == 180.0}
    assert set(ends) == {-180.0, 180.0} and ends[180.0] == ends[-180.0] == pytest.approx(47.9975, abs=0.001)
    assert sum(np.ptp(np.array(part)[:, 0]) for part in (west, east)) * 74500.0 == pytest.approx(600.0, abs=20.0)


def test_workers_and_a_run_that_goes_on_give_the_same_bytes(block, made, tmp_path):
    other = tmp_path / "block.tif"
    assert main(_mosaic(block, other, "--workers", "2", "-q")) == 0
    assert _bytes(other) == _bytes(made)
    assert not (tmp_path / "block.tif.parts").exists()
    # what a killed run leaves: some results, none of the later ones, files that never got their names
    parts = made.with_name("block.tif.parts")
    there = sorted(parts.glob("labels/*.npy")) + sorted(parts.glob("tiles/*.json"))
    for path in there[1::2]:
        path.unlink()
    (parts / "tiles" / ".9_9.tif.part").write_bytes(b"half")
    before = _bytes(made)
    made.unlink()
    assert main(_mosaic(block, made, "--workers", "1", "--keep", "-q")) == 0
    assert _bytes(made) == before


#: One of two jobs is a Ctrl-C, which goes to all processes of the terminal.
CTRL_C = """import os, signal, sys
from pathlib import Path
from triline.nodes.batch.mosaic_jobs import Job, Workers
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
try:
    with Workers(2) as pool:
        pool.run(os.killpg, [Job(Path("none"), (os.getpgrp(), which)) for which in (0, signal.SIGINT)])
except KeyboardInterrupt:
    sys.exit(3)"""


def test_workers_that_are_interrupted_end_without_a_word(tmp_path):
    """Each of them printed a traceback, above the one line of the first process."""
    words = [sys.executable, "-c", CTRL_C]
    run = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, start_new_session=True, timeout=600)
    assert (run.returncode, run.stdout, run.stderr) == (3, "", "")


def test_virtual_mosaic_of_tiles(block, made, tmp_path):
    target = tmp_path / "block.vrt"
    assert (
        main(
            ["rectify", *map(str, block.files), "--mosaic", "--tile", "256", "--workers", "1", "-o", str(target), "-q"]
        )
        == 0
    )
    with rasterio.open(target) as virtual, rasterio.open(made) as whole:
        assert virtual.shape == whole.shape and virtual.crs == whole.crs and virtual.transform == whole.transform
        assert (virtual.read(1) > 0).sum() == (whole.read(1) > 0).sum()


@pytest.mark.parametrize("ending", ["tif", "vrt"])
def test_each_raster_is_what_its_ending_says(block, made, tmp_path, capsys, ending):
    """Also the one whose name nobody gave; tiles stay where one of them shows them."""
    target = tmp_path / f"block.{ending}"
    words = ["--workers", "1", "--json", "--stac", str(tmp_path / "item.json")]
    named = ["--source", str(tmp_path / "source.vrt")] if ending == "tif" else []
    assert main(_mosaic(block, target, *words, *named)) == 0
    told = json.loads(capsys.readouterr().out)
    assets = json.loads((tmp_path / "item.json").read_text())["assets"]
    for name, of_whole in (("mosaic", "tif"), ("source", "source.tif"), ("sigma", "sigma.tif")):
        virtual = told[name].endswith(".vrt")
        assert assets[name]["type"] == ("application/xml" if virtual else assets["sigma"]["type"])
        with rasterio.open(told[name]) as raster, rasterio.open(made.with_suffix(f".{of_whole}")) as whole:
            assert raster.driver == ("VRT" if virtual else "GTiff")
            np.testing.assert_array_equal(raster.read(1), whole.read(1))
    assert told["source"] == str(tmp_path / ("source.vrt" if ending == "tif" else "block.source.vrt"))


@pytest.mark.parametrize("dtype", ["int8", "int64", "uint64", "complex64", "colour table"])
def test_orthoimages_of_every_whole_number(dtype, tmp_path, capsys):
    """Those of 8 bits with a sign and of 64 bits ended in a fault, as complex numbers did, which are refused."""
    refused = {"complex64": "complex numbers", "colour table": "numbers of a colour table"}.get(dtype)
    colours, dtype = dtype == "colour table", dtype.replace("colour table", "uint8")
    values = np.random.default_rng(1).integers(60, 120, (1, 200, 300)).astype(dtype)
    paths = []
    for k in range(2):  # two parts of one image
        place = rasterio.Affine(2, 0, 500_000 + 200 * k, 0, -2, 5_000_000)
        shape = {"driver": "GTiff", "height": 200, "width": 200, "count": 1, "dtype": dtype, "crs": "EPSG:32632"}
        paths.append(tmp_path / f"ortho{k}.tif")
        with rasterio.open(paths[-1], "w", transform=place, nodata=0, **shape) as target:
            target.write(values[:, :, 100 * k : 100 * k + 200])
            if colours:
                target.write_colormap(1, {number: (number, 0, 0, 255) for number in range(256)})
    for out in (tmp_path / "m.tif", tmp_path / "m.vrt"):
        code = main(["rectify", *map(str, paths), "--mosaic", "-o", str(out), "--workers", "1", "-q"])
        if refused:
            assert code == 1 and f"ortho0.tif: {refused}, wanted grey values" in capsys.readouterr().err
            continue
        with rasterio.open(out) as mosaic:
            assert code == 0 and mosaic.dtypes == (dtype,) and (mosaic.read() == values).all()
            # of 64-bit whole numbers many programs read no differences
            differences = out.suffix == ".tif" and dtype == "int8"
            assert (mosaic.tags(ns="IMAGE_STRUCTURE").get("PREDICTOR") == "2") == differences


def test_a_mosaic_says_what_the_values_of_its_orthoimages_mean(tmp_path, capsys):
    values = np.random.default_rng(1).integers(600, 1200, (2, 200, 300)).astype(np.uint16)
    shape = {"driver": "GTiff", "height": 200, "width": 200, "count": 2, "dtype": "uint16", "crs": "EPSG:32632"}
    paths = [tmp_path / f"ortho{k}.tif" for k in range(2)]

    def write(k, scale):
        place = rasterio.Affine(2, 0, 500_000 + 200 * k, 0, -2, 5_000_000)
        with rasterio.open(paths[k], "w", transform=place, nodata=0, **shape) as target:
            target.write(values[:, :, 100 * k : 100 * k + 200])
            target.scales, target.offsets, target.units = (scale, 1.0), (-0.1, 0.0), ("1", "K")
            target.descriptions = "reflectance", "temperature"

    write(0, 1e-4)
    write(1, 1e-4)
    for out in (tmp_path / "m.tif", tmp_path / "m.vrt"):
        words = ["rectify", *map(str, paths), "--mosaic", "-o", str(out), "--workers", "1", "-q"]
        assert main(words) == 0
        with rasterio.open(out) as mosaic:
            assert (mosaic.scales, mosaic.offsets, mosaic.units) == ((1e-4, 1.0), (-0.1, 0.0), ("1", "K"))
            assert mosaic.descriptions == ("reflectance", "temperature")
        with rasterio.open(tmp_path / f"m.source{out.suffix}") as source:
            assert source.scales == (1.0,) and source.units == (None,)
    write(1, 1e-3)
    assert main(words) == 1
    wanted = "scales of its bands: 0.001, 1.0, but ortho0 has 0.0001, 1.0: wanted values that mean the same"
    assert wanted in capsys.readouterr().err


@pytest.mark.parametrize(("dtype", "bands"), [("uint8", 3), ("uint16", 4)])
def test_a_mosaic_has_the_colours_of_its_orthoimages(tmp_path, capsys, dtype, bands):
    """All bands of a mosaic were undefined, shown in grey; of orthoimages some may state none."""
    from rasterio.enums import ColorInterp

    values = np.random.default_rng(2).integers(60, 120, (bands, 200, 300)).astype(dtype)
    rgb = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.undefined][:bands]
    grey = [ColorInterp.gray, *[ColorInterp.undefined] * (bands - 1)]
    paths = [tmp_path / f"ortho{k}.tif" for k in range(2)]

    def write(k, colors):
        place = rasterio.Affine(2, 0, 500_000 + 200 * k, 0, -2, 5_000_000)
        shape = {"driver": "GTiff", "height": 200, "width": 200, "count": bands, "dtype": dtype, "crs": "EPSG:32632"}
        with rasterio.open(paths[k], "w", transform=place, nodata=0, photometric="MINISBLACK", **shape) as target:
            target.colorinterp = colors
            target.write(values[:, :, 100 * k : 100 * k + 200])

    write(0, grey)
    write(1, rgb)
    for out in (tmp_path / "m.tif", tmp_path / "m.vrt"):
        words = ["rectify", *map(str, paths), "--mosaic", "-o", str(out), "--workers", "1", "-q"]
        assert main(words) == 0
        with rasterio.open(out) as mosaic:
            assert list(mosaic.colorinterp) == rgb and (mosaic.read() == values).all()
        with rasterio.open(tmp_path / f"m.source{out.suffix}") as source:
            assert source.colorinterp[0] in (ColorInterp.gray, ColorInterp.undefined)
    write(0, [*rgb[2::-1], *rgb[3:]])
    assert main(words) == 1
    assert "wanted bands that mean the same" in capsys.readouterr().err


def test_a_layer_that_an_earlier_version_kept_is_read(tmp_path):
    """It says nothing of what its values mean."""
    path = tmp_path / "0.json"
    layer = Layer("A", "", "a.tif", "a.steepness.tif", None, 0, 0, 4, 4, 1, "uint8", 0.0, [(0, 0)], {})
    layer.write(path)
    kept = json.loads(path.read_text())
    for name in ("descriptions", "scales", "offsets", "units", "colors"):
        del kept[name]
    path.write_text(json.dumps(kept))
    assert Layer.read(path) == layer


@pytest.mark.parametrize("crs", ["EPSG:3035", "EPSG:2193", "EPSG:32632", "EPSG:25832+7837"])
def test_virtual_mosaics_have_their_axes_as_gdal_writes_them(crs, tmp_path):
    """Where the first axis of a CRS goes north, other programs took the columns for it: of Europe in the Atlantic."""
    import rasterio.shutil

    raster = Raster(crs, 4_000_000.0, 3_000_000.0, 10.0, 20, 30, 1, "uint8", 0)
    write_tile(tmp_path / "tile.tif", raster, np.ones((1, 20, 30), dtype=np.uint8))
    write_virtual(tmp_path / "own.vrt", raster, [TilePlace(tmp_path / "tile.tif", 0, 0, 20, 30)])
    axes = []
    for name in ("tile.tif", "own.vrt"):  # as GDAL itself has them in its own words
        rasterio.shutil.copy(tmp_path / name, tmp_path / "gdal.vrt", driver="VRT")
        axes.append(re.findall('dataAxisToSRSAxisMapping="([^"]*)"', (tmp_path / "gdal.vrt").read_text()))
    own = re.findall('dataAxisToSRSAxisMapping="([^"]*)"', (tmp_path / "own.vrt").read_text())
    assert axes[0] == axes[1] and own in ([], axes[0])
    assert axes[0][0].startswith("2,1" if crs in ("EPSG:3035", "EPSG:2193") else "1,2")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--tile", "300"], "--tile 300: wanted a power of two"),
        (["--feather", "900"], "--feather 900: wanted 0 to 256 cells"),
        (["--gsd", "3"], "cells of 2 x 2, wanted 3"),
        (["--crs", "EPSG:32633"], "is not in EPSG:32633"),
        (["--control", "c.csv"], "--control: is of one image"),
        (["--correction", "shift"], "--correction: is of one image"),
        (["--mask", "m.tif"], "--mask: is of one image; wanted orthoimages made with it, then --mosaic of these"),
        (["--trajectory", "lines.csv"], "--trajectory: is of one recording; wanted orthoimages made with it"),
        (["--tile", "0"], "--tile 0: wanted a power of two of at least 128"),
        (["--sensor", "one.geom"], "--sensor: 1 for 3 images"),
        (["--nodata", "255"], "--nodata: goes with an image and its --sensor, and there is none"),
        (["--occlusions"], "--occlusions: goes with a recording, or an image and its --sensor, and there is none"),
        (["--orientation", "final"], "--orientation: goes with a recording, and there is none"),
        (["--dem", "heights.tif"], "--dem: goes with a recording, or an image and its --sensor, and there is none"),
        (["--sigma", "s.tif"], "wanted the sigmas of each orthoimage"),
    ],
)
def test_what_does_not_go_together_is_named(block, tmp_path, capsys, words, told):
    command = ["rectify", *map(str, block.files), "--mosaic", "--workers", "1", "-o", str(tmp_path / "x.tif"), *words]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert told in error and "Traceback" not in error and not (tmp_path / "x.tif").exists()


def test_no_output_is_written_over_what_is_read(block, tmp_path, capsys):
    """Neither by a name that nobody gave, nor over a recording of a folder."""
    shutil.copy(block.files[0], tmp_path / "a.source.tif")
    folder = tmp_path / "flights"
    folder.mkdir()
    (folder / "day1.mcap").write_bytes(b"a recording")
    (tmp_path / "same.tif").symlink_to(folder / "day1.mcap")
    for words in (
        [tmp_path / "a.source.tif", "--mosaic", "-o", tmp_path / "a.tif"],
        [folder, "--mosaic", "-o", tmp_path / "b.tif", "--source", tmp_path / "same.tif"],
    ):
        assert main(["rectify", *map(str, words)]) == 1
        assert "the output would overwrite" in capsys.readouterr().err
    assert (tmp_path / "a.source.tif").read_bytes() == block.files[0].read_bytes()
    assert (folder / "day1.mcap").read_bytes() == b"a recording"


def test_options_of_a_mosaic_want_it(block, tmp_path, capsys):
    assert main(["rectify", str(block.files[0]), "--sensor", "x", "--tile", "256", "-o", str(tmp_path / "x.tif")]) == 1
    assert "--tile: goes with --mosaic" in capsys.readouterr().err
    assert main(["rectify", *map(str, block.files), "-o", str(tmp_path / "x.tif")]) == 1
    assert "more than one, which goes with --mosaic only" in capsys.readouterr().err


def test_parts_of_another_plan_are_not_taken(block, made, tmp_path):
    target = tmp_path / "block.tif"
    shutil.copytree(made.with_name("block.tif.parts"), tmp_path / "block.tif.parts")
    words = [
        "rectify",
        *map(str, block.files),
        "--mosaic",
        "--tile",
        "256",
        "--workers",
        "1",
        "-o",
        str(target),
        "-q",
        "--keep",
    ]
    assert main([*words, "--balance", "none", "--seams", "middle"]) == 0
    with rasterio.open(target) as plain, rasterio.open(made) as balanced:
        assert np.abs(plain.read(1).astype(float) - balanced.read(1)).max() > 50


def test_a_tile_in_which_two_strips_share_no_whole_place(tmp_path):
    block = make_block(tmp_path, strips=2, columns=500, seed=7)
    target = tmp_path / "block.tif"
    assert main(["rectify", *map(str, block.files), "--mosaic", "--tile", "128", "-o", str(target), "-q"]) == 0
    with rasterio.open(target) as image:
        assert (image.read(1) > 0).mean() > 0.9


@pytest.mark.parametrize("name", ["mosaic#1.tif", "what?.tif"])
def test_stac_items_want_names_that_are_addresses(name, block, tmp_path, capsys):
    """pystac 1.15 looks for `mosaic` where an href is `mosaic#1.tif`, and takes %23 in a path as it stands."""
    words = ["rectify", *map(str, block.files), "--mosaic", "-o", str(tmp_path / name), "--stac"]
    assert main([*words, str(tmp_path / "item.json")]) == 1
    assert f"--stac: {name} has # or ? in it" in capsys.readouterr().err
