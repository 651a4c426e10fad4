"""Names, states and files made to upset a terminal or a parser: nothing of it reaches the operator as such."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
import sample_messages as sample
from command_line import run
from rich.console import Console

from triline.nodes.cli import main
from triline.nodes.monitor.monitor import MOST_NODES, Monitor, screen
from triline.nodes.node import Message
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.terminal import CleanStream, clean_streams, drawing, plain
from triline.schemas import messages as m

#: Clears the screen, sets the title of the window, hides text, turns the direction of writing, rings, begins a line.
HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b31m[/b][red]\u202egood\r\nlight: good\x00"


def _harmless(text: str) -> bool:
    return all(c == "\n" or (c.isprintable() and c not in "\u202e\x9b") for c in text)


def test_plain_text_keeps_what_is_readable_and_escapes_what_commands_a_terminal():
    assert plain("GCP 3, Größe 5 µm, 中") == "GCP 3, Größe 5 µm, 中"
    assert plain("a\x1b[2Jb\x07\x9b") == "a\\x1b[2Jb\\x07\\x9b"
    assert plain("one\ntwo\tthree") == "one two three"
    assert plain("\u202egpj.exe\ud800\u2028") == "\\u202egpj.exe\\ud800\\u2028"
    assert plain("x" * 50, 10) == "xxxxxxx..."


def test_streams_are_clean_inside_a_command_and_given_back_after_it():
    before, caught = sys.stdout, io.StringIO()
    sys.stdout = caught
    try:
        with clean_streams(), clean_streams():
            sys.stdout.writelines(["a\tb\n", "\x1b[31mc\n"])
            assert drawing(sys.stdout) is caught and isinstance(sys.stdout, CleanStream)
        assert sys.stdout is caught
    finally:
        sys.stdout = before
    assert caught.getvalue() == "a\tb\n\\x1b[31mc\n"


def test_a_name_that_the_terminal_has_no_letters_for_is_shown_as_escapes(tmp_path, monkeypatch):
    """The file was written, and then the line that says so was a fault in triline, with exit code 1."""
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii", write_through=True))
    assert main(["new", "flight", str(tmp_path / "Süd")]) == 0
    assert b"S\\xfcd/flight.toml: fill it in" in written.getvalue()


def test_the_monitor_shows_hostile_states_names_and_events_as_plain_text():
    monitor = Monitor()
    status = m.NodeStatus(node="navigator[/b]", state=f"running[/b]{HOSTILE}", lag_s=0.1)
    status.topics.add(topic=HOSTILE, received=10, gaps=1, rate_hz=5.0)
    monitor.step(Message("status/navigator", 1, status))
    monitor.step(Message(f"status/x{HOSTILE}", 1, status))
    monitor.step(Message("event/log", 1, m.Log(level=m.Log.Level.Value("ERROR"), name=HOSTILE, message=HOSTILE)))
    report = m.AdjustmentReport(sigma0=1.0, redundancy=5)
    report.parameters.add(name=HOSTILE, partner=HOSTILE, status="open")
    monitor.step(Message("adjustment/report", 1, report))
    shown = io.StringIO()
    console = Console(file=shown, width=200, force_terminal=False)
    console.print(screen(monitor.overview, f"platform [/b]{HOSTILE}"))
    assert "running[/b]\\x1b[2J" in shown.getvalue() and "platform [/b]" in shown.getvalue()
    assert _harmless(shown.getvalue())
    assert _harmless(monitor.overview.line())


def test_a_flood_of_node_names_does_not_fill_the_screen():
    monitor = Monitor()
    for i in range(3 * MOST_NODES):
        monitor.step(Message(f"status/n{i}", 1, m.NodeStatus(node=f"n{i}", state="running")))
    assert len(monitor.overview.nodes) == MOST_NODES
    assert monitor.counters["too many nodes"] == 2 * MOST_NODES


def _hostile_recording(path: Path) -> None:
    camera = sample.body("configuration/camera")
    camera.name = HOSTILE
    strip = sample.body("configuration/strip")
    strip.id = f"S1{HOSTILE}"
    project = sample.body("configuration/project")
    project.name = project.crs = HOSTILE
    with path.open("wb") as file:
        writer = RecordingWriter(file, "none", platform=f"p{HOSTILE}")
        for i, (topic, body) in enumerate(
            (("configuration/project", project), ("configuration/camera", camera), ("configuration/strip", strip),
             ("sensor/gnss", sample.body("sensor/gnss")))
        ):  # fmt: skip
            writer.write(Message(topic, sample.EPOCH_NS + i, body, f"s{HOSTILE}"[:40], i))
        writer.close()


@pytest.mark.parametrize(
    "command", [("info",), ("check",), ("info", "-v"), ("export", "--topic", "sensor/x\x1b[2J", "--csv", "x.csv")]
)
def test_no_control_character_of_a_recording_reaches_the_terminal(tmp_path, capsys, command):
    path = tmp_path / "flight\x1b[2J.mcap"
    _hostile_recording(path)
    _, out, err = run(capsys, command[0], path, *command[1:])
    assert _harmless(out) and _harmless(err)
    assert "\\x1b[2J" in out + err
    if command[0] == "info":
        assert not any(line.startswith("light: good") for line in out.splitlines())


def _one_line(code: int, err: str, *wanted: str) -> None:
    assert code == 1
    assert len(err.strip().splitlines()) == 1, err
    for text in wanted:
        assert text in err, err


DEEP_JSON = "[" * 200_000 + "]" * 200_000
DEEP_TOML = "a = " + "[" * 5_000 + "]" * 5_000 + "\n"


@pytest.fixture
def block(tmp_path) -> Path:
    """A small block folder that can be spoilt."""
    from block_writer import write_block
    from small_block import simulated_block

    write_block(tmp_path / "block", simulated_block())
    return tmp_path / "block"


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("camera.json", DEEP_JSON, "nested too deep"),
        ("camera.json", '{"name": ' * 100_000, "nested too deep"),
        ("camera.json", '{"name": 1' + "0" * 5000 + "}", "not valid JSON"),
        ("project.toml", DEEP_TOML, "nested too deep"),
        ("project.toml", "a = " + "9" * 5000, "not valid TOML"),
        ("project.toml", "a." * 5000 + "b = 1\n", ""),
        ("strips.csv", None, "field larger than field limit"),
        ("image_points.csv", None, "field larger than field limit"),
        ("strips.csv", "strip," + "x" * 200_000 + "\n", "field larger than field limit"),
    ],
)
def test_parsers_that_give_up_are_told_in_one_line(block, capsys, name, text, wanted):
    path = block / name
    if text is None:  # a whole table with one field too long in the last row
        head, first, *rest = path.read_text().splitlines()
        long = first.split(",")
        long[0] = '"' + "x" * 200_000 + '"'
        long[-1] = "no number"
        text = "\n".join([head, first, *rest, ",".join(long)]) + "\n"
    path.write_text(text)
    code, _, err = run(capsys, "adjust", block, "-o", block / "out")
    if wanted:
        _one_line(code, err, name, wanted)
    else:
        assert len(err) < 2000


def test_numbers_too_large_for_a_double_are_refused_with_their_key(block, capsys):
    text = (block / "camera.json").read_text()
    (block / "camera.json").write_text(
        text.replace('"focal_length_mm": ', '"focal_length_mm": ' + "9" * 400 + ', "x": ', 1)
    )
    code, _, err = run(capsys, "adjust", block, "-o", block / "out")
    _one_line(code, err, "focal_length_mm", "wanted a number")


def test_configuration_of_nodes_nested_too_deep_is_told_in_one_line(tmp_path, capsys):
    config = tmp_path / "nodes.toml"
    config.write_text(f"[adjuster]\n{DEEP_TOML}")
    code, _, err = run(capsys, "node", "adjuster", "--config", config)
    _one_line(code, err, "nodes.toml", "nested too deep")
    code, _, err = run(capsys, "node", "adjuster", "--set", "model=" + "[" * 5000)
    _one_line(code, err, "configuration [adjuster]")
    assert len(err) < 1200
