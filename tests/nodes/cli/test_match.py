"""`triline match`: from images with RPC or rigorous metadata to image_points.csv, and what it says of bad input."""

from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from command_line import refusal
from scene_pictures import LAT, LON, METRES, View, moved, relief, write_block, write_image

from triline.nodes.batch.image_rectification import SourceImage
from triline.nodes.batch.scene_pixels import ScenePixels, Tiles
from triline.nodes.cli import main
from triline.nodes.formats.satellite.folder_writer import write_overpass
from triline.nodes.formats.satellite.read import read_scene
from triline.solver.camera.sensors import multi_lens_camera
from triline.solver.geometry.frames import LocalFrame
from triline.solver.simulation.orbital_imagery import render, texture_of
from triline.solver.simulation.orbital_scene import OrbitalSensor, overpass

VIEWS = {"fore": View(10, (0.02, 0.0)), "aft": View(-20, (0.35, 0.1), samples=280)}
STATED = {"fore": moved(VIEWS["fore"], 6, -9), "aft": moved(VIEWS["aft"], -14, 5, 0.1)}
MEASURED = "point,strip,line,sample,note\nP1,fore,100.5,120.25,a church\nmatch_000002,fore,50,60,control\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("match") / "block"
    write_block(folder, VIEWS, STATED, 1)
    (folder / "image_points.csv").write_text(MEASURED)
    ground = "point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role\nmatch_000002,11,47,240,1,1,1,control\n"
    (folder / "ground_points.csv").write_text(ground)
    return folder


@pytest.fixture(scope="module")
def matched(made, tmp_path_factory) -> Path:
    """The block with its tie points."""
    folder = Path(shutil.copytree(made, tmp_path_factory.mktemp("matched") / "block"))
    assert main(["match", str(folder), "--points", "60", "-q"]) == 0
    return folder


@pytest.fixture
def block(made, tmp_path) -> Path:
    """A copy that may be spoiled."""
    return Path(shutil.copytree(made, tmp_path / "block"))


def rows(folder: Path, name: str = "image_points.csv") -> list[dict[str, str]]:
    with open(folder / name, newline="") as file:
        return list(csv.DictReader(file))


def refused(capsys, *words) -> str:
    return refusal(capsys, "match", "-q", *words)  # progress is told where the machine is slow


def set_image(folder: Path, name: str, value: str) -> None:
    text = (folder / "project.toml").read_text()
    (folder / "project.toml").write_text(text.replace(f'image = "{name}.tif"', value))


def test_matched_points_come_behind_those_that_were_measured(matched):
    table = rows(matched)
    assert list(table[0]) == ["point", "strip", "line", "sample", "note", "sigma_px"]
    assert [list(row.values()) for row in table[:2]] == [
        ["P1", "fore", "100.5", "120.25", "a church", ""], ["match_000002", "fore", "50", "60", "control", ""],
    ]  # fmt: skip
    points = [row["point"] for row in table[2:]]
    assert len(points) > 80 and points.count("match_000002") == 0 and set(map(points.count, points)) == {2}
    for fore, aft in zip(table[2::2], table[3::2], strict=True):
        assert (fore["point"], fore["strip"], aft["strip"]) == (aft["point"], "fore", "aft")
        pixel = np.array([[float(fore["line"]), float(fore["sample"])]])
        seen = VIEWS["aft"].inverse(*VIEWS["fore"].on_ground(pixel).T)[0]
        assert np.hypot(float(aft["line"]) - seen[0], float(aft["sample"]) - seen[1]) < 0.3
        assert 0.02 < float(aft["sigma_px"]) < 0.25


def test_a_second_run_replaces_its_own(matched, tmp_path, capsys):
    before = (matched / "image_points.csv").read_bytes()
    out = tmp_path / "points.csv"
    assert main(["match", str(matched), "--points", "30", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (matched / "image_points.csv").read_bytes() == before
    assert told["rows_kept"] == 2 and told["rows_replaced"] == before.count(b"match_") - 1
    assert len(rows(tmp_path, "points.csv")) == 2 + told["rays"] and told["rays"] == 2 * told["points"]
    (pair,) = told["pairs"]
    assert (pair["master"], pair["other"]) == ("fore", "aft") and pair["kept"] == told["points"]
    assert main(["match", str(matched), "--points", "60", "-q", "-o", str(matched / "image_points.csv")]) == 0
    assert (matched / "image_points.csv").read_bytes() == before  # the same again


def test_the_block_is_adjusted_by_what_was_matched(matched, tmp_path, capsys):
    assert main(["adjust", str(matched), "--snoop", "-o", str(tmp_path / "result"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["converged"] and 0.1 < told["sigma0"] < 1.2
    off = [abs(float(row["v_line_px"])) for row in rows(tmp_path / "result", "residuals.csv") if row["v_line_px"]]
    assert np.median(off) < 0.05


def test_what_is_said_ends_with_what_to_do_next(block, capsys):
    assert main(["match", str(block), "--points", "20"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1].startswith("  fore, aft: overlap ") and "rays miss by" in out[1]
    assert out[-1] == f"next: triline adjust {block} --snoop -o result"
    assert main(["match", str(block), "--points", "20", "-o", str(block / "others.csv")]) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == f"next: `triline adjust` takes these points when they are {block / 'image_points.csv'}"


def test_tables_with_semicolons_and_decimal_commas_stay_such(block):
    (block / "image_points.csv").write_text("point;strip;line;sample;sigma_px\nP1;fore;100,5;120,25;0,3\n")
    assert main(["match", str(block), "--points", "20", "-q"]) == 0
    lines = (block / "image_points.csv").read_text().splitlines()
    assert lines[1] == "P1;fore;100,5;120,25;0,3" and len(lines) > 20
    assert all(line.count(";") == 4 and line.count(",") == 3 for line in lines[2:])


def test_a_block_without_image_points_gets_them(block):
    (block / "image_points.csv").unlink()
    (block / "ground_points.csv").unlink()
    assert main(["match", str(block), "--points", "20", "-q"]) == 0
    assert rows(block)[0]["point"] == "match_000001"


def test_bands_are_put_together_and_values_of_any_kind_are_matched(block, capsys):
    with rasterio.open(block / "aft.tif") as file:
        values = file.read(1)
    dark = (values.astype(np.float32) - 700.0) * 1e-4
    write_image(block / "bands.tif", dark, dark * 0.8, np.full_like(dark, 0.01))
    set_image(block, "aft", 'image = "bands.tif"')
    assert main(["match", str(block), "--points", "30", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["points"] > 20 and any("the mean of 3 bands" in note for note in told["notes"])
    set_image(block, "fore", 'image = "fore.tif"\nband = "2"')
    assert "fore.tif: band '2': not in it, wanted 1 to 1" in refused(capsys, block)


def test_scenes_may_be_bands_of_one_file(block):
    write_image(block / "bands.tif", *(rasterio.open(block / f"{name}.tif").read(1)[:, :280] for name in VIEWS))
    set_image(block, "fore", 'image = "bands.tif"\nband = 1')
    set_image(block, "aft", 'image = "bands.tif"\nband = 2')
    assert main(["match", str(block), "--points", "30", "-q"]) == 0
    off = [float(a["sample"]) - float(b["sample"]) for a, b in zip(rows(block)[2::2], rows(block)[3::2], strict=True)]
    assert len(off) > 20 and np.ptp(off) > 10.0


def test_what_lies_outside_an_image_is_empty(block):
    pixels = ScenePixels(SourceImage(block / "fore.tif"), {0: 1.0}, (0, 0), Tiles())
    for line, sample in ((310, 20), (20, 310), (-30, 20), (20, -700)):
        assert not pixels.window(line, sample, 25, 30).any()
    assert pixels.window(290, 20, 25, 30)[:10].all()


def test_a_part_of_a_scene_says_where_it_begins(block, capsys):
    with rasterio.open(block / "aft.tif") as file:
        part = file.read(1)[20:, 35:]
    write_image(block / "part.tif", part)
    set_image(block, "aft", 'image = "part.tif"\nfirst_pixel = [35, 20]')
    assert main(["match", str(block), "--points", "30", "-q"]) == 0
    ties = [row for row in rows(block)[2:] if row["strip"] == "aft"]
    assert min(float(row["sample"]) for row in ties) >= 35 and min(float(row["line"]) for row in ties) >= 20
    assert len(ties) > 20
    write_image(block / "placed.tif", part, transform=rasterio.Affine(1.0, 0.0, 35.0, 0.0, 1.0, 20.0))
    (block / "project.toml").write_text(
        (block / "project.toml").read_text().replace('"part.tif"\nfirst_pixel = [35, 20]', '"placed.tif"')
    )
    before = rows(block)
    assert main(["match", str(block), "--points", "30", "-q"]) == 0
    assert rows(block) == before


def test_heights_of_a_raster_are_taken(block, capsys):
    x, y = np.meshgrid(np.arange(-300.0, 301.0, 10.0), np.arange(300.0, -301.0, -10.0))
    step = 10.0 / METRES * 180.0 / np.pi
    corner = np.degrees([LON, LAT]) + step * [-30.5, 30.5]
    affine = rasterio.Affine(step[0], 0.0, corner[0], 0.0, -step[1], corner[1])
    write_image(block / "dem.tif", relief(x, y).astype(np.float32), transform=affine, crs="EPSG:4326")
    words = ["match", str(block), "--points", "30", "--dem", str(block / "dem.tif"), "--dem-datum", "ellipsoid"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["points"] > 25 and told["heights_m"] == [-30.0, 30.0]
    assert "--height and --dem" in refused(capsys, *words[1:], "--height", 100, 300)


def test_bad_input_is_told_in_one_line(block, tmp_path, capsys):
    assert "no block of satellite scenes" in refused(capsys, tmp_path)
    assert "--points 0: wanted 1" in refused(capsys, block, "--points", 0)
    assert "2 matched, fewer than 5 of them agree" in refused(capsys, block, "--points", 2)
    assert "--search-m -1: wanted more than 0" in refused(capsys, block, "--search-m", -1)
    assert "--dem-crs: goes with --dem" in refused(capsys, block, "--dem-crs", "EPSG:4326")
    assert "no folder" in refused(capsys, block, "-o", tmp_path / "none" / "points.csv")
    assert "--height 9 1: wanted the lowest" in refused(capsys, block, "--height", 9, 1)
    assert "would overwrite" in refused(capsys, block, "-o", block / "fore.tif")
    assert "would overwrite" in refused(capsys, block, "-o", block / "project.toml")
    (block / "cut.tif").write_bytes((block / "aft.tif").read_bytes()[:9000])
    set_image(block, "aft", 'image = "cut.tif"')
    assert "cut.tif: lines " in refused(capsys, block)
    before = (block / "image_points.csv").read_text()
    assert before == MEASURED
    (block / "cut.tif").write_text("no image")
    assert "cut.tif: not a raster that can be read" in refused(capsys, block)
    (block / "project.toml").write_text((block / "project.toml").read_text().replace('image = "cut.tif"', ""))
    assert 'scenes.aft.image: missing, wanted its image: image = "IMG.TIF"' in refused(capsys, block)
    text = (block / "project.toml").read_text()
    (block / "project.toml").write_text(text[: text.index("[scenes.aft]")])
    assert "one image, wanted two or more" in refused(capsys, block)


def test_a_folder_that_cannot_be_written_to_is_told_before_the_work(block, capsys, monkeypatch):
    """It was told when all was matched; as the superuser may write anywhere, access is made up."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != block or not mode & os.W_OK)
    monkeypatch.setattr("triline.nodes.cli.match.open_views", None)
    told = f"{block / 'image_points.csv'}: cannot be written: no permission in {block}\n"
    assert refused(capsys, block) == f"triline match: {told}"


def test_images_of_two_scenes_that_were_swapped_are_told(block, capsys):
    text = (block / "project.toml").read_text()
    (block / "project.toml").write_text(
        text.replace('"fore.tif"', '"x"').replace('"aft.tif"', '"fore.tif"').replace('"x"', '"aft.tif"')
    )
    assert main(["match", str(block), "--points", "20"]) == 1
    notes, told = capsys.readouterr().err.rsplit("triline match: ", 1)
    beside = "the polynomials in it or beside it are those of scene"
    assert f"note: aft.tif: {beside} aft, not of fore: are these the right images?\n" in notes
    assert f"note: fore.tif: {beside} fore, not of aft: are these the right images?\n" in notes
    assert told.endswith("are the images of fore and aft the right ones?\n")


def test_an_image_may_be_one_pixel(block, capsys):
    write_image(block / "dot.tif", np.ones((1, 1), dtype=np.uint8))
    set_image(block, "fore", 'image = "dot.tif"\nfirst_pixel = [150, 150]')
    assert "no texture where both may see the ground" in refused(capsys, block)


def test_images_that_do_not_overlap_are_told(tmp_path, capsys):
    views = {"east": View(0, (0.0, 0.0), at_m=(5000.0, 0.0), lines=60, samples=60), "west": View(0, (0.1, 0.0))}
    views["west"] = replace(views["west"], lines=60, samples=60)
    write_block(tmp_path, views, views, 3)
    assert "no two images overlap at heights from 100 to 400 m: east, west" in refused(capsys, tmp_path)


def test_two_lenses_with_rigorous_models(tmp_path, capsys):
    # parts of pictures that begin 7 lines and 5 samples off where project.toml says, which is the error of the model
    camera = multi_lens_camera("pair", 580.0, {"F": 300, "B": 300}, 0.0065)
    sensor = OrbitalSensor(camera, {"F": 20.0, "B": -20.0}, 832_000.0, 98.7, 1.4e-3, 300, yaw_steered=True)
    write_overpass(tmp_path / "scene", overpass(sensor, 45.0, 7.0), attitude_step_s=0.05)
    off, frame = {"F": (0, 0), "B": (7, -5)}, LocalFrame(45.0, 7.0, 300.0)
    sensors = read_scene(tmp_path / "scene").sensors
    texture = texture_of(sensors["F"], 5)
    for lens, model in sensors.items():
        image = render(model, frame, texture, 300.0, np.random.default_rng(6))
        line, sample = 10 + off[lens][0], 10 + off[lens][1]
        write_image(tmp_path / f"{lens}.tif", image[line : line + 280, sample : sample + 280])
    (tmp_path / "project.toml").write_text(
        '[scenes.pair]\nmetadata = "scene"\nimage = { F = "F.tif", B = "B.tif" }\nfirst_pixel = [10, 10]\n'
    )
    project = (tmp_path / "project.toml").read_text()
    (tmp_path / "project.toml").write_text(project.replace('{ F = "F.tif", B = "B.tif" }', '"F.tif"'))
    assert "scenes.pair.image: 'F.tif', wanted an image for each of the lines F, B" in refused(capsys, tmp_path)
    (tmp_path / "project.toml").write_text(project.replace("B = ", "N = "))
    assert "scenes.pair.image.N: wanted one of the lines F, B" in refused(capsys, tmp_path)
    (tmp_path / "project.toml").write_text(project.replace("first_pixel = [10, 10]\n", ""))
    assert "F.tif: 280 lines of 280 samples, wanted 300 of 300 as scene pair/F has" in refused(capsys, tmp_path)
    (tmp_path / "project.toml").write_text(project)
    assert main(["match", str(tmp_path), "--points", "40", "--height", "0", "600", "--search-m", "120", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["points"] > 20
    for a, b in zip(rows(tmp_path)[::2], rows(tmp_path)[1::2], strict=True):
        rays = {row["ccd"]: np.array([float(row["line"]), float(row["sample"])]) for row in (a, b)}
        true = {lens: pixel + off[lens] for lens, pixel in rays.items()}
        ground = sensors["F"].direct(*true["F"], 300.0)[0]
        assert np.abs(sensors["B"].inverse(*ground)[0] - true["B"]).max() < 0.15
