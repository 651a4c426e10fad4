"""Configuration of nodes from TOML, the names of nodes, and the meeting port."""

from __future__ import annotations

import json
import re
import tomllib

import numpy as np
import pytest
from bus_rig import free_port
from places import ROOT

from triline.nodes import registry
from triline.nodes.bus.ports import DEFAULT_PORT, default_port
from triline.nodes.bus.session import configuration
from triline.nodes.cli import main
from triline.nodes.config import build, load, settings_of
from triline.nodes.errors import UserError
from triline.nodes.navigator.engines import InertialUnit
from triline.nodes.node import Node
from triline.nodes.player.player import SETTINGS as PLAYER
from triline.nodes.recorder.recorder import Recorder
from triline.nodes.router.router import OnBoardRouter
from triline.solver.navigation.inertial_data import InertialGrade


class Gauge(Node):
    name, inputs, outputs = "gauge", (), ()

    def __init__(self, depth: int = 3, unit: str = "m") -> None:
        super().__init__()
        if depth < 0:
            raise ValueError(f"depth is {depth}, wanted 0 or more")
        self.depth, self.unit = depth, unit


def write(path, text):
    path.write_text(text)
    return path


def test_a_table_a_node(tmp_path):
    tables = load(write(tmp_path / "a.toml", "[gauge]\ndepth = 7\n\n[other]\nx = 1\n"))
    gauge = build(Gauge, tables)
    assert (gauge.depth, gauge.unit) == (7, "m")
    assert build(Gauge, load(None)).depth == 3


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[gauge]\nheight = 2\n", r"configuration \[gauge\]: height is not known, wanted one of depth, unit"),
        ("[gauge]\ndepth = -1\n", r"configuration \[gauge\]: depth is -1, wanted 0 or more"),
        ("[gauge]\ndepth = 'x'\n", r"configuration \[gauge\]: "),
        ("depth = 1\n", "depth stands outside a table"),
        ("[gauge\n", "a.toml: not a TOML file"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(tmp_path, text, what):
    with pytest.raises(UserError, match=what) as caught:
        build(Gauge, load(write(tmp_path / "a.toml", text)))
    assert "\n" not in str(caught.value)


def test_a_flight_folder_tells_the_navigator_where_the_camera_is(tmp_path):
    flight = '[flight]\nname = "x"\n[mounting]\ncamera_lever_arm_m = [0.1, 0.0, 0.3]\n'
    tables = load(write(tmp_path / "flight.toml", flight))
    assert tables["navigator"] == {"camera_lever_arm_m": [0.1, 0.0, 0.3]}
    build(registry.node_class("navigator"), tables)
    own = load(write(tmp_path / "flight.toml", flight + "[nodes.navigator]\ncamera_lever_arm_m = [0, 0, 1]\n"))
    assert own["navigator"] == {"camera_lever_arm_m": [0, 0, 1]}
    none = flight.replace("[0.1, 0.0, 0.3]", "[0, 0, 0]")
    assert "navigator" not in load(write(tmp_path / "flight.toml", none))
    for wrong in ("[0.1, 0.3]", "[0, 0, 300]", "[0, 0, nan]"):
        tables = load(write(tmp_path / "flight.toml", flight.replace("[0.1, 0.0, 0.3]", wrong)))
        with pytest.raises(
            UserError, match=r"configuration \[navigator\]: camera_lever_arm_m is .* 3 numbers within 50 m"
        ):
            build(registry.node_class("navigator"), tables)
    with pytest.raises(UserError, match=r"mounting.camera_lever_arm_m is '0.3', wanted 3 numbers"):
        load(write(tmp_path / "flight.toml", flight.replace("[0.1, 0.0, 0.3]", "'0.3'")))


def test_a_flight_folder_tells_the_navigator_what_its_inertial_unit_is(tmp_path):
    imu = "[imu]\ngyro_noise_deg_sqrt_h = 0.1\ngyro_bias_deg_h = 100\naccel_bias_mgal = 5000\ngyro_scale_ppm = 300\n"
    tables = load(write(tmp_path / "flight.toml", f'[flight]\nname = "x"\n{imu}'))
    assert tables["navigator"] == {"gyro_bias_deg_h": 100, "accel_bias_mgal": 5000, "gyro_scale_ppm": 300}
    build(registry.node_class("navigator"), tables)
    with pytest.raises(UserError, match=r"configuration \[navigator\]: gyro_bias_deg_h is -1, wanted 0 or more"):
        build(registry.node_class("navigator"), {"navigator": {"gyro_bias_deg_h": -1}})
    noise = np.radians(0.1) / 60.0, 0.05 / 60.0
    grade = InertialUnit(gyro_bias_deg_h=100, accel_bias_mgal=5000, gyro_scale_ppm=300).grade(*noise)
    assert (grade.gyro_noise, grade.accel_noise) == noise
    assert grade.gyro_bias == pytest.approx(np.radians(100) / 3600) and grade.accel_bias == pytest.approx(0.05)
    assert (grade.bias_time_s, grade.gyro_scale, grade.accel_scale) == (600.0, pytest.approx(3e-4), 0.0)
    assert InertialUnit().grade(*noise) == InertialGrade.of_noise(*noise)


def test_tables_and_keys_that_nobody_reads_are_refused(tmp_path, capsys):
    file = write(tmp_path / "a.toml", "[adjustor]\nmodel = 'ppm'\n")
    assert main(["node", "monitor", "--config", str(file)]) == 1
    assert "a.toml: table [adjustor] is not known, wanted one of simulator, " in capsys.readouterr().err
    assert main(["node", "monitor", "--set", "foo=1"]) == 1
    assert "configuration [monitor]: foo is not known" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("not json {", "line 1, column 1: expected array"),
        ('{\nmode:"foo"}', "line 2: unknown value 'foo', wanted router, peer or client"),
        ('{\nmode:"peer",\nscoutin: 1}', "line 3: unknown key 'scoutin', wanted scouting"),
        ("{\nscouting:{\nmulticast: {enabld: true}}}", "line 3: unknown key 'enabld', wanted enabled"),
        ("{\nconnect: {qqq: 1}}", "line 2: unknown key 'qqq', wanted timeout_ms, endpoints, exit_on_failure or retry"),
        ("{qqq: 1}", "line 1: unknown key 'qqq', wanted one of "),
        ("", "Empty config file"),
    ],
)
def test_a_bad_bus_file_is_told_without_what_zenoh_is_made_of(tmp_path, text, what):
    with pytest.raises(UserError) as caught:
        configuration(file=write(tmp_path / "bus.json5", text))
    said = str(caught.value)
    assert f"bus.json5: not a Zenoh configuration: {what}" in said
    assert "\n" not in said and ".rs" not in said and "cargo" not in said and "`" not in said
    assert len(said) < len(str(tmp_path)) + 170  # it was a list of all keys


def test_a_key_of_a_bus_file_in_yaml_is_told_alike(tmp_path):
    wanted = r"bus\.yaml: not a Zenoh configuration: line 2: unknown key 'lisen', wanted listen$"
    with pytest.raises(UserError, match=wanted):
        configuration(file=write(tmp_path / "bus.yaml", "mode: peer\nlisen: {}\n"))


def test_every_step_node_can_be_loaded_and_keeps_to_the_topic_table():
    from triline.schemas import topics

    for name in (*registry.ESTIMATING, *registry.ONLOOKERS):
        cls = registry.node_class(name)
        assert cls.name == name and issubclass(cls, Node)
        for topic in (*cls.inputs, *cls.outputs):
            topics.find(topic)
        truth = [t for t in cls.inputs if topics.find(t).family is topics.Family.TRUTH]
        assert not truth or name in registry.ONLOOKERS  # no estimating node reads the truth
    for name in registry.PROGRAMS:
        assert callable(registry.program(name))
    for name in ("pilot", "recorder"):
        with pytest.raises(UserError, match=f"no node '{name}'"):
            registry.node_class(name)


def test_the_meeting_port(monkeypatch):
    monkeypatch.delenv("TRILINE_PORT", raising=False)
    assert default_port() == DEFAULT_PORT
    monkeypatch.setenv("TRILINE_PORT", "18000")
    assert default_port() == 18000
    for bad in ("0", "x", "70000"):
        monkeypatch.setenv("TRILINE_PORT", bad)
        with pytest.raises(UserError, match="wanted a port number"):
            default_port()


def stated_on_the_page() -> tuple[dict[str, dict], dict[str, set[str]]]:
    """Tables of the page's settings: values of keys, and all keys with those that are commented out."""
    page = (ROOT / "docs" / "bus.md").read_text(encoding="utf-8")
    text = page.split("## Settings of the nodes")[1].split("\n## ")[0]
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    keys: dict[str, set[str]] = {}
    for line in lines:
        if name := re.match(r"\[(\w+)\]", line):
            table = keys.setdefault(name[1], set())
        elif key := re.match(r"(?:# (?:\.\.\. )?)?(\w+) = ", line):
            table.add(key[1])
    return tomllib.loads("\n".join(lines)), keys


def test_the_page_names_all_settings_with_their_defaults():
    values, keys = stated_on_the_page()
    settings = {name: settings_of(registry.node_class(name)) for name in (*registry.STEP_NODES, *registry.ONLOOKERS)}
    settings |= {"recorder": settings_of(Recorder), "router": settings_of(OnBoardRouter)}
    settings |= {"player": {"input": None} | PLAYER}
    for name, known in settings.items():
        assert keys[name] == set(known), name
        defaults = {key: known[key] for key in values[name]}
        assert {key: list(v) if isinstance(v, tuple) else v for key, v in defaults.items()} == values[name], name
    assert set(settings) | {"simulator", "nmea"} == set(keys)


def test_what_a_program_hands_to_a_node_is_no_setting(capsys):
    assert main(["node", "viewer", "--set", "canvas=5"]) == 1
    told = capsys.readouterr().err
    assert told.endswith("[viewer]: canvas is not known, wanted one of mode, queue_size, truth\n")


def test_settings_of_the_player(tmp_path, capsys):
    for word, told in (
        ("pace=4", "pace is not known, wanted one of input, rate, from, to, loop, all"),
        ("loop=no", "loop is 'no', wanted true or false"),
    ):
        assert main(["node", "player", "--set", "input=flight.mcap", "--set", word]) == 1
        assert told in capsys.readouterr().err


def test_a_node_says_at_its_end_as_json_what_it_said(capsys):
    """The option had no effect."""
    words = ["node", "player", "--set", f"input={ROOT / 'recordings' / 'strip.mcap'}", "--set", "rate=0"]
    assert main([*words, "--port", str(free_port()), "--platform", "do228", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"node": "player", "platform": "do228", "said": ["played 4368 messages"]}
    assert main(["node", "monitor", "--json"]) == 1
    assert "wanted `triline monitor --json" in capsys.readouterr().err
