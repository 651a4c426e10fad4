"""Commands that want a recording say how to make one of what they are given."""

import pytest
from places import ROOT

from triline.nodes.cli import main

POSES = "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + "".join(
    f"{1.7e9 + i},{48 + 0.001 * i},11.0,1000,0,0,0\n" for i in range(5)
)


@pytest.mark.parametrize(
    ("command", "made"),
    [
        ("info", "poses.csv"),
        ("check", "poses.csv"),
        ("process", "poses.csv"),
        ("adjust", "poses.csv"),
        ("adjust", "."),
        ("info", "."),
    ],
)
def test_importable_input_is_named_with_the_command(tmp_path, capsys, monkeypatch, command, made):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.csv").write_text(POSES)
    (tmp_path / "flight.toml").write_text('[flight]\nname = "x"\n')
    options = ["-o", "out.mcap"] if command == "process" else []
    assert main([command, made, *options]) == 1
    err = capsys.readouterr().err
    kind = "trajectory as CSV" if made == "poses.csv" else "flight folder"
    assert kind in err and f"triline import {made} -o" in err and err.count("\n") == 1


def test_a_flight_folder_with_its_camera_is_no_block(tmp_path, capsys):
    """`adjust` of one asked for strips.csv, where a camera lay beside flight.toml as the docs have it."""
    (tmp_path / "flight.toml").write_text('[flight]\nname = "x"\n')
    (tmp_path / "camera.json").write_text(CAMERA)
    assert main(["adjust", str(tmp_path)]) == 1
    err = capsys.readouterr().err
    assert "flight folder" in err and f"triline import {tmp_path} -o" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["info", "."], ".: is a folder, wanted a recording"),
        (["export", ".", "--points", "out.csv"], ".: is a folder, wanted a recording"),
        (["process", "strip.mcap", "--camera", ".", "-o", "out.mcap"], ".: is a folder, wanted a camera.json"),
    ],
)
def test_a_folder_is_told_as_one_with_what_was_wanted(tmp_path, capsys, monkeypatch, words, wanted):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "strip.mcap").symlink_to(ROOT / "recordings" / "strip.mcap")
    assert main(words) == 1
    assert capsys.readouterr().err == f"triline {words[0]}: {wanted}\n"


CAMERA = '{"name": "c", "lenses": [{"focal_length_mm": 62.7}], "lines": [{"id": "F", "pixels": 2, "pixel_size_mm": 1}]}'
FRAME = '{"interior": {"focal_length_mm": 50}, "exterior": {"lat_deg": 48}}'
FILES = {
    "camera.json": (CAMERA, "a line camera (camera.json), which lies in the folder of a block or flight"),
    "image.json": (FRAME, "orientation of a frame camera's image, which `triline rectify --sensor`"),
    "scene.json": ('{"name_model": "USGS"}', "community sensor model), which `triline locate` and"),
    "map.geojson": ('{"type": "FeatureCollection"}', "GeoJSON, which"),
    "a_RPC.TXT": ("LINE_OFF: +001.0 pixels\n", "rational polynomials of a satellite scene, which `triline locate`"),
    "dim.xml": ('<?xml version="1.0"?><Dimap_Document/>', "metadata of a satellite scene, which `triline locate`"),
    "flight.mcap.gz": ("\x1f\x8b", "packed (gzip), which has to be unpacked first"),
    "flight.zip": ("PK\x03\x04", "packed (ZIP), which has to be unpacked first"),
    "flight.toml": ("[flight]\n", "settings of a flight folder, which is given as a whole"),
    "imu.csv": ("time_s,interval_s,force_x_m_s2\n", "inertial samples of a sensor folder, which is given as a whole"),
}


@pytest.mark.parametrize(
    "command",
    ["adjust", "import", "process", "check", "info", "analyze", "replay", "view", "export", "rectify", "navigate"],
)
def test_what_is_for_another_command_is_named_with_that_command(tmp_path, capsys, monkeypatch, command):
    """Of each was said that it is not an MCAP recording, by `import` that it is of no known kind."""
    monkeypatch.chdir(tmp_path)
    options = {
        "process": ["-o", "out.mcap"],
        "rectify": ["-o", "out.tif"],
        "navigate": ["-o", "out"],
        "import": ["-o", "out.mcap"],
        "export": ["--points", "out.csv"],
    }
    for name, (text, said) in FILES.items():
        (tmp_path / name).write_text(text, encoding="latin-1")
        assert main([command, name, *options.get(command, [])]) == 1
        err = capsys.readouterr().err
        assert f"triline {command}: {name}: " in err and said in err and err.count("\n") == 1, err
        assert ("wanted a recording" in err) == (command != "import")


@pytest.mark.parametrize("command", ["check", "fly"])
def test_a_folder_without_a_flight_is_named_by_what_lies_in_it(tmp_path, capsys, monkeypatch, command):
    """A folder of recordings was to get a flight.toml."""
    monkeypatch.chdir(tmp_path)
    assert main([command, "."]) == 1
    assert "no flight.toml; `triline new flight .` writes one" in capsys.readouterr().err
    (tmp_path / "result.json").write_text("{}")
    assert main([command, "."]) == 1
    assert "no flight.toml, but result.json: it holds results" in capsys.readouterr().err
    for name, said in (
        ("b", "no flight.toml, but b.mcap: a recording is given itself"),
        ("a", "a.mcap, 2 recordings:"),
    ):
        (tmp_path / f"{name}.mcap").write_bytes(b"")
        assert main([command, "."]) == 1
        assert said in capsys.readouterr().err


def test_locate_names_a_camera_as_what_it_is(tmp_path, capsys, monkeypatch):
    """It said that its name_model was missing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.json").write_text(CAMERA)
    (tmp_path / "p.csv").write_text("column,row,height_m\n1,1,0\n")
    assert main(["locate", "camera.json", "--pixels", "p.csv", "-o", "out.csv"]) == 1
    err = capsys.readouterr().err
    assert "camera.json: a line camera (camera.json), which lies in" in err and "wanted a scene" in err


def test_a_header_in_capital_letters_is_told(tmp_path, capsys, monkeypatch):
    """TIME_S stood there, and time_s was missing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.csv").write_text(POSES.replace(POSES[: POSES.index("\n")], POSES[: POSES.index("\n")].upper()))
    assert main(["import", "poses.csv", "-o", "out.mcap"]) == 1
    err = capsys.readouterr().err
    assert "poses.csv:1: time_s: column missing" in err and "; capital letters count: TIME_S stands there" in err
