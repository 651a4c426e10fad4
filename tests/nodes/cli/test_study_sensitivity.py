"""``triline study sensitivity``: tables, files, bad input."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
from satellite_scenes import Truth, write_dimap2, write_folder

from triline.nodes.cli import main
from triline.nodes.report.sensitivity_page import _map
from triline.nodes.report.style import styled
from triline.solver.sensitivity.scene_map import SceneMap

FEW = ["--runs", "6000", "--samples", "512"]


def test_worked_examples(tmp_path, capsys):
    file = tmp_path / "shares.csv"
    assert main(["study", "sensitivity", *FEW, "--csv", str(file), "--json"]) == 0
    scenes = json.loads(capsys.readouterr().out)["scenes"]
    assert [s["scene"] for s in scenes] == ["bilsat", "aster-vnir", "ads40"]
    for scene in scenes:
        assert scene["converged"] and scene["missed"] == 0
        for result in scene["results"].values():
            assert result["nearly_linear"]
            assert result["sigma_monte_carlo_m"] == pytest.approx(result["sigma_m"], rel=0.05)
            for parameter in result["parameters"].values():
                if parameter["sigma"]:
                    assert parameter["sobol_total"] == pytest.approx(parameter["share"], abs=0.03)
                    assert parameter["fast_first"] == pytest.approx(parameter["share"], abs=0.03)
    table = pd.read_csv(file)
    assert len(table) == 3 * 2 * 10
    sums = table.groupby(["scene", "result"])["share"].sum()
    assert sums.to_numpy() == pytest.approx(1.0, abs=1e-6)


def test_better_attitude_buys_something(capsys):
    def sigma(*options):
        assert main(["study", "sensitivity", "ads40", *FEW, "--json", *options]) == 0
        return json.loads(capsys.readouterr().out)["scenes"][0]["results"]["north"]["sigma_m"]

    assert sigma("--attitude-sigma", "0.001", "0.001", "0.002") < 0.7 * sigma()


def test_maps_of_the_scene(tmp_path, capsys):
    page, file = tmp_path / "page.html", tmp_path / "map.csv"
    options = ["--grid", "5", "--page", str(page), "--map-csv", str(file), "--json"]
    assert main(["study", "sensitivity", "aster-vnir", "ads40", *FEW, *options]) == 0
    satellite, aircraft = json.loads(capsys.readouterr().out)["scenes"]
    assert len(satellite["map"]) == 25 and len(aircraft["map"]) == 5 * 3
    for place in satellite["map"] + aircraft["map"]:
        squares = place["sigma_east_m"] ** 2 + place["sigma_north_m"] ** 2
        assert place["semi_major_m"] ** 2 + place["semi_minor_m"] ** 2 == pytest.approx(squares)
    # the heights move the points that are seen at a slant: at the edge of the nadir line, and everywhere forward
    by = {(place["row"], place["column"]): place["dominating"] for place in aircraft["map"]}
    middle, edge = sorted({column for _, column in by})[2], 0.0
    assert by["N", middle] != "height" == by["N", edge] == by["F", middle]
    assert {"F", "N", "B"} == {row for row, _ in by}
    table = pd.read_csv(file)
    assert len(table) == 25 + 15 and set(table["scene"]) == {"aster-vnir", "ads40"}
    text = page.read_text()
    assert text.count("<svg") == 2 * 3 and "src=" not in text and "<script" not in text
    assert "line of detectors N" in text
    # as on the terminal: sigmas of attitudes were 8.727e-06 rad
    assert re.search(r"<tr><td>roll</td><td>0.0005</td><td>deg</td>", text) and "<td>rad</td>" not in text


def test_shares_are_read_on_dark_and_on_bright_cells():
    """They were white on yellow, too."""
    covariance = np.array([1.0, 4.0, 9.0]).reshape(1, 3, 1, 1) * np.eye(2)
    found = SceneMap(np.arange(3.0), np.zeros(1), covariance, np.ones((1, 3, 1)), ("height",))
    with styled():
        drawn = _map(found, None)
    assert drawn is not None
    assert [text.get_color() for text in drawn.axes[1].texts] == ["white", "white", "black"]


def test_a_scene_from_a_file(tmp_path, capsys):
    scene = write_dimap2(tmp_path / "scene.xml", Truth(lines=4000, samples=500))
    options = ["--pixel", "250", "2000", "--height", "100", "--refraction", *FEW]
    assert main(["study", "sensitivity", str(scene), *options]) == 0
    text = capsys.readouterr().out
    assert "column 250, row 2000, height 100 m" in text and "by covariance" in text and "across" in text


def photo(folder, sigma):
    """A frame image from 3300 m, with sigmas of its orientation."""
    exterior = {"lat_deg": 39.9, "lon_deg": 32.8, "height_m": 3300.0, "omega_phi_kappa_deg": [0.0, 0.0, 0.0]}
    interior = {"focal_length_mm": 100.0, "pixel_size_mm": 0.005, "lines": 3000, "samples": 4000}
    file = folder / "photo.json"
    file.write_text(json.dumps({"interior": interior, "exterior": exterior, "sigma": sigma}))
    return file


def test_a_frame_camera_of_ones_own(tmp_path, capsys):
    file = photo(tmp_path, {"position_m": [0.1, 0.1, 0.2], "attitude_deg": [0.01, 0.01, 0.01]})
    assert main(["study", "sensitivity", str(file), *FEW, "--pixel", "1999.5", "1499.5", "--json"]) == 0
    scene = json.loads(capsys.readouterr().out)["scenes"][0]
    parameters = scene["results"]["east"]["parameters"]
    assert parameters["phi"]["moves_m"] == pytest.approx(3000.0 * 0.01 * 3.14159 / 180.0, rel=1e-3)
    assert parameters["east"]["moves_m"] == pytest.approx(0.1, rel=1e-3) and len(scene["map"]) == 81


def test_what_a_frame_image_cannot_state_has_its_usual_sigma(tmp_path, capsys):
    """With sigmas of position and attitude alone, ground and pixels of a frame image counted as known without error."""
    file = photo(tmp_path, {"position_m": [0.1, 0.1, 0.2], "atitude_deg": [0.01, 0.01, 0.01]})
    command = ["study", "sensitivity", str(file), *FEW, "--pixel", "0", "1499.5", "--json"]
    assert main(command) == 0
    scene = json.loads(capsys.readouterr().out)["scenes"][0]
    east = scene["results"]["east"]["parameters"]
    # seen 10 mm beside the middle of an image of 100 mm: a metre of height moves it 0.1 m
    assert east["height"]["moves_m"] == pytest.approx(15.0 * 9.9975 / 100.0, rel=0.01)
    assert east["sample"]["moves_m"] == pytest.approx(0.3 * 3000.0 * 0.005 / 100.0, rel=0.01)
    assert scene["notes"] == ["photo.json: key sigma.atitude_deg is not known and was ignored"]
    assert main([*command, "--height-sigma", "0.5", "--pixel-sigma", "0"]) == 0
    east = json.loads(capsys.readouterr().out)["scenes"][0]["results"]["east"]["parameters"]
    assert east["height"]["sigma"] == 0.5 and east["sample"]["sigma"] == 0.0


def test_what_reading_the_metadata_told_is_told(tmp_path, capsys):
    folder = write_folder(tmp_path / "scene", Truth(lines=400, samples=50), settings="[sigma]\npostion_m = [1, 1, 1]\n")
    assert main(["study", "sensitivity", str(folder), *FEW]) == 0
    assert "  note: scene.toml: key sigma.postion_m is not known and was ignored" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["nowhere.xml"], "nowhere.xml: neither a file nor a simulated sensor, wanted metadata or one of alos-prism"),
        (["ads40", "--samples", "1000"], "ads40: 1000 samples of a Sobol sequence, wanted a power of 2"),
        (["ads40", "--runs", "3"], "ads40: 3 runs, wanted at least 100"),
        (["ads40", "--pixel", "99999", "0"], "--pixel 99999 0, wanted one of the image of 12000 columns"),
        (["ads40", "--seed", "-1"], "triline study: --seed -1: wanted at least 0"),
        (["ads40", "--grid", "1"], "--grid 1: wanted 2 to 200 columns and rows"),
        (["ads40", "--page", "nowhere/page.html"], "nowhere/page.html: no folder nowhere"),
        (["bilsat", "--ccd", "N"], "bilsat: --ccd N, but a frame image has no lines of detectors"),
        (["ads40", "--height", "4000"], "wanted ground below the aircraft at 3000 m"),
        (["aster-vnir", "--ccd", "Q"], "aster-vnir: line of detectors 'Q', wanted one of"),
        (["aster-vnir", "--time-sigma", "-1"], "wanted numbers of at least 0"),
    ],
)
def test_bad_input(options, message, capsys):
    assert main(["study", "sensitivity", *options]) == 1
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) == 1
