"""Bad input as a user meets it at the commands; the table of who tests what stands in `test_bad_input`."""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from block_writer import write_block
from bus_rig import free_port, simulated_flight
from command_line import run
from recording_file import chunk_spans
from small_block import simulated_block

from triline.nodes.cli import COMMANDS, main
from triline.nodes.cli.outputs import refuse_input_as_output
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.solver.geometry.frames import CrsError

# ---- weak networks and what the files say of them, as a user meets them


def _keep_rows(path: Path, keep: Callable[[list[str]], bool]) -> None:
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *(row for row in rows if keep(row.split(",")))]) + "\n")


@pytest.mark.parametrize(
    ("name", "points", "control", "options"),
    [
        ("one point", 1, True, ()),
        ("two points", 2, False, ("--snoop",)),
        ("three points, all unknowns of the camera", 3, True, ("--selfcal", "prism30", "--free", "--snoop")),
        ("no control", 12, False, ("--selfcal", "tls18", "--free", "--then", "lim", "--variance-components")),
        ("no control, many fixes", 12, False, ("--model", "lim", "--fixes", "9")),
        ("no control, many segments", 12, False, ("--model", "ppm", "--segments", "9", "--robust", "huber")),
        ("no rays", 0, True, ()),
    ],
)
def test_weak_blocks_get_a_result_that_names_what_is_open_or_one_line(tmp_path, capsys, name, points, control, options):
    write_block(tmp_path, simulated_block())
    chosen = {f"P{i}" for i in range(points)}
    _keep_rows(tmp_path / "image_points.csv", lambda row: row[0] in chosen)
    if not control:
        _keep_rows(tmp_path / "ground_points.csv", lambda row: row[-1] == "check")
    code, out, err = run(capsys, "adjust", tmp_path, "--json", *options)
    if code == 1:
        assert out == "" and len(err.splitlines()) == 1 and err.startswith("triline adjust: "), (name, err)
        assert points == 0
        return
    result = json.loads(out)  # and nothing else on standard output
    assert err == "" and result["redundancy"] == result["n_observations"] - result["n_unknowns"]
    assert np.isfinite(result["sigma0"]) or result["redundancy"] <= 0
    assert result["undetermined"] or any("a-priori" in note for note in result["notes"]), name
    for parameter in result["additional_parameters"].values():
        assert parameter["status"] in ("estimated", "eliminated")
        assert parameter["reason"] or parameter["status"] == "estimated"


@pytest.mark.parametrize("options", [("--control", 0, "--check", 0), ("--ties", 0), ("--ties", 0, "--control", 0)])
def test_a_flight_without_control_or_ties_is_flown_to_the_end(tmp_path, capsys, options):
    flight, out_path = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    code, _, err = run(capsys, "simulate", "-o", flight, "--seconds", 4, "--lead-in", 3, "-q", *options)
    assert (code, err) == (0, "")
    code, out, err = run(capsys, "process", flight, "-o", out_path, "--json")
    assert (code, err) == (0, "")
    result = json.loads(out)
    assert result["outputs"]["orientation/final"] > 70 and "failed" not in result["counters"]["adjuster"]
    final = [message.body for message in RecordingReader(out_path).messages(["orientation/final"])]
    sigma = np.sqrt([body.covariance[::7] for body in final])
    assert np.isfinite(sigma).all() and sigma.min() > 0
    assert sigma[:, :3].max() > 0.3  # what nothing has measured keeps its a-priori sigma


# ---- recordings


def test_a_recording_whose_head_is_lost_is_refused_with_the_reason(tmp_path, capsys):
    """Configuration stands in the first chunk and in the last: without both there is nothing to compute."""
    data = bytearray(simulated_flight(12).read_bytes())
    first, *_, last = chunk_spans(simulated_flight(12))
    data[sum(first) // 2] ^= 1
    data[sum(last) // 2] ^= 1
    flipped, cut, out = tmp_path / "flipped.mcap", tmp_path / "cut.mcap", tmp_path / "out.mcap"
    flipped.write_bytes(data)
    cut.write_bytes(data[: first[1] - 10])
    code, text, err = run(capsys, "process", flipped, "-o", out)
    assert code == 1 and text == "" and "nothing came out: navigator waiting for configuration/project" in err
    damage = "(the file ends inside a record at byte"
    for *command, lacks in (
        ("process", cut, "-o", out, "it holds no message"),
        ("adjust", cut, "no message on configuration/camera; it cannot be adjusted as a block"),
        ("rectify", cut, "-o", tmp_path / "out.tif", "no configuration/camera in it"),
        ("replay", cut, "nothing to play: no message in it"),
        ("export", "--per-line", out, cut, "no orientation in it; 'triline process' makes one from sensor data"),
        ("export", "--points", out, cut, "no message on point/object: `triline process` makes them"),
        ("export", "--topic", "sensor/gnss", "--csv", out, cut, "no message on sensor/gnss; it holds no message"),
    ):
        code, text, err = run(capsys, *command)
        assert code == 1 and text == "" and f"{lacks} {damage}" in err, err
        assert len(err.splitlines()) == 1 and not out.exists() and not list(tmp_path.glob("*.part"))
    code, text, err = run(capsys, "info", cut)
    assert code == 0 and "0 messages" in text and "not as it should be: the file ends inside a record" in text
    code, text, err = run(capsys, "recover", cut, "-o", out)
    assert code == 1 and "nothing in it that could be recovered" in err and not out.exists()


def test_process_tells_what_it_skipped(tmp_path, capsys):
    data = bytearray(simulated_flight(12).read_bytes())
    last = chunk_spans(simulated_flight(12))[-1]
    data[sum(last) // 2] ^= 1
    path, out = tmp_path / "flipped.mcap", tmp_path / "out.mcap"
    path.write_bytes(data)
    code, text, err = run(capsys, "process", path, "-o", out, "--json")
    result = json.loads(text)
    assert code == 0 and err == "" and result["lost_bytes"] == last[1] - last[0]
    assert len(result["damage"]) == 1 and "a chunk with a wrong checksum" in result["damage"][0]
    code, _, err = run(capsys, "process", path, "-o", out, "-q")
    assert code == 0 and "skipped 1 damaged place: a chunk" in err and len(err.splitlines()) == 1


def test_commands_that_work_on_what_is_left_say_that_something_is_missing(tmp_path, capsys):
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    flight = ("--seconds", 8, "--lead-in", 30, "--images", "--pixels", 100, "--imu", "tactical", "-q")
    assert run(capsys, "simulate", "-o", whole, *flight)[0] == 0
    data = whole.read_bytes()
    cut.write_bytes(data[: int(0.8 * len(data))])
    for command in (
        ("navigate", cut, "-o", tmp_path / "navigation"),
        ("rectify", cut, "-o", tmp_path / "o.tif", "--orientation", "truth", "-q"),
        ("view", cut, "--rrd", tmp_path / "v.rrd"),
    ):
        code, out, err = run(capsys, *command)
        assert code == 0 and "the file ends" in out + err, command


# ---- commands


def test_no_command_takes_its_input_for_its_output_or_a_device_for_a_file(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    path.write_bytes(simulated_flight(12).read_bytes())
    before = path.read_bytes()
    for arguments in (
        ("process", path, "-o", path),
        ("recover", path, "-o", path),
        ("analyze", path, "-o", path),
        ("view", path, "--rrd", path),
        ("export", path, "--topic", "sensor/gnss", "--csv", path),
        ("import", path, "-o", path),
        ("process", path, "-o", os.devnull),
        ("recover", path, "-o", os.devnull),
        ("export", path, "--topic", "sensor/gnss", "--csv", os.devnull),
        ("simulate", "-o", os.devnull, "--seconds", 2),
        ("simulate", "-o", tmp_path, "--seconds", 2),
        ("node", "recorder", "-o", tmp_path),
    ):
        code, out, err = run(capsys, *arguments)
        assert code == 1 and out == "" and len(err.splitlines()) == 1, (arguments, err)
        assert path.read_bytes() == before and not Path(os.devnull).is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_no_command_writes_over_another_of_its_inputs(tmp_path, capsys):
    path, other = tmp_path / "a.mcap", tmp_path / "other"
    path.write_bytes(simulated_flight(12).read_bytes())
    other.write_text("mine")
    for arguments in (
        ("process", path, "--camera", other, "-o", other),
        ("process", path, "--config", other, "-o", other),
        ("process", path, "--dem", other, "--dem-sigma", 1, "-o", other),
        ("import", path, "--camera", other, "-o", other),
        ("import", path, "--lines", f"F={path},N={other}@2", "-o", other),
        ("rectify", path, "--trajectory", other, "-o", other),
        ("locate", path, "--pixels", other, "-o", other),
        ("simulate", "--motion", other, "-o", other),
        ("analyze", other, "-o", other),
        ("export", other, "--topic", "sensor/gnss", "--csv", other),
        ("export", other, "--points", other),
        ("view", other, "--rrd", other),
        ("view", path, other, "--fleet", "--rrd", other),
    ):
        code, _, err = run(capsys, *arguments)
        assert code == 1 and "the output would overwrite the" in err, (arguments, err)
        assert other.read_text() == "mine"
    block = tmp_path / "block"
    write_block(block, simulated_block())
    (block / "project.toml").write_text("# line times of S1: times.csv\n")
    times, trajectory = block / "times.csv", block / "trajectory.csv"
    times.write_text("mine")
    flown = trajectory.read_bytes()
    for arguments, said in (
        (
            ("study", "control", block, "--csv", trajectory),
            f"{trajectory}: the output would overwrite a file of {block}",
        ),
        (("study", "control", block, "--page", times), f"{times}: the output would overwrite a file of {block}"),
        (
            ("study", "misspecified", "--motion", trajectory, "--csv", trajectory),
            "the output would overwrite the motion",
        ),
        (("export", path, "--points", path), "the output would overwrite the recording"),
        (("rectify", other, "--sensor", path, "-o", "x.tif", "--mask", path), "the output would overwrite the sensor"),
        (("import", block, "-o", trajectory), f"the output would overwrite a file of {block}"),
    ):
        code, _, err = run(capsys, *arguments)
        assert code == 1 and said in err and len(err.splitlines()) == 1, (arguments, err)
    assert times.read_text() == "mine" and trajectory.read_bytes() == flown
    (block / "mes.csv").write_text("a result")  # the end of a name that stands there
    refuse_input_as_output(argparse.Namespace(block=block, csv=block / "mes.csv"))
    shutil.rmtree(block)
    code, _, err = run(capsys, "simulate", "--seconds", 2, "-o", tmp_path / "new", "--dem", tmp_path / "new")
    assert code == 1 and "wanted different files" in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "other"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "a.mcap", "--topic", "orientation/final", "--csv", ""),
        ("export", "a.mcap", "--topic", "orientation/final", "--geojson="),
        ("adjust", "block", "-o", ""),
        ("simulate", "--satellite", "spot5-hrs", "-o", ""),
        ("new", "flight", ""),
    ],
    ids=lambda words: words[0],
)
def test_an_output_without_a_name_is_refused(arguments, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    option = "" if arguments[0] == "new" else next(w for w in reversed(arguments) if w).rstrip("=") + " "
    assert run(capsys, *arguments) == (1, "", f"triline {arguments[0]}: {option}'': wanted a name\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("export", "a.mcap", "--topic", "orientation/final", "--csv", "-"), "--csv -"),
        (("export", "a.mcap", "--topic", "orientation/final", "--geojson=-"), "--geojson -"),
        (("simulate", "--seconds", 2, "-o-"), "-o -"),
        (("import", "-", "-o", "a.mcap"), "-"),
    ],
    ids=lambda words: words[0],
)
def test_standard_output_is_no_file(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = f"triline {arguments[0]}: {said}: wanted the name of a file, not standard input or output\n"
    assert run(capsys, *arguments) == (1, "", told)
    assert not list(tmp_path.iterdir())


def test_a_result_is_not_written_among_the_files_of_a_block(tmp_path, capsys):
    write_block(tmp_path / "block", simulated_block())
    before = sorted(p.name for p in (tmp_path / "block").iterdir())
    code, _, err = run(capsys, "adjust", tmp_path / "block", "-o", tmp_path / "block")
    assert code == 1 and "has the files of a block or a flight, wanted another folder for the result" in err
    assert sorted(p.name for p in (tmp_path / "block").iterdir()) == before
    # what lies in a folder that no adjustment made stays there
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "orientation_lines.csv").write_text("mine")
    assert run(capsys, "adjust", tmp_path / "block", "-o", tmp_path / "mine")[0] == 0
    assert (tmp_path / "mine" / "orientation_lines.csv").read_text() == "mine"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_an_example_and_the_common_options(command, capsys):
    code, out, err = run(capsys, command, "--help")
    assert (code, err) == (0, "") and f"example:\n  triline {command}" in out
    assert all(option in out for option in ("--json", "--quiet", "--verbose"))
    code, out, err = run(capsys, command, "--wings")
    assert code == 2 and out == "" and err.splitlines()[-1].startswith("triline")


def test_what_a_command_cannot_help_is_one_line(tmp_path, capsys, monkeypatch):
    """A full disk, no memory, a fault of our own: one line, exit code 1, and what was begun is taken away."""
    import triline.nodes.cli.simulate as module

    path = tmp_path / "a.mcap"
    monkeypatch.setenv("PROJ_DATA", "/grids:/proj")
    for error, text in (
        (
            ValueError("PROJ: internal_proj_create_from_database: Cannot find proj.db"),
            "triline simulate: no proj.db in PROJ_DATA (/grids:/proj): wanted one folder that has it, or none",
        ),
        (
            OSError(28, "No space left on device"),
            f"triline simulate: {path}: cannot be written: no space left on device",
        ),
        (MemoryError("Unable to allocate 2 TiB"), "triline simulate: not enough memory: Unable to allocate 2 TiB"),
        (ZeroDivisionError("two\nlines"), "triline simulate: fault in triline"),
    ):

        class Failing(RecordingWriter):
            def write(self, *arguments, error=error, **options):
                raise error

        monkeypatch.setattr(module, "RecordingWriter", Failing)
        code = main(["simulate", "-o", str(path), "--seconds", "2"])
        out, err = capsys.readouterr()
        assert code == 1 and out == "" and len(err.splitlines()) == 1 and err.startswith(text)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("node", "setting", "text"),
    [
        ("player", "rate=abc", "rate is 'abc', wanted a number of at least 0"),
        ("player", "rate=-1", "rate is -1, wanted a number of at least 0"),
        ("player", "input=3", "the player needs a recording"),
        ("adjuster", "snoop='no'", "snoop is 'no', wanted true or false"),
        ("adjuster", "update_s=true", "update_s is True, wanted a number"),
        ("adjuster", "model=3", "model is 3, wanted a text"),
        ("recorder", "rotate_mb=abc", "rotate_mb is 'abc', wanted a number"),
    ],
)
def test_settings_of_the_wrong_kind_are_refused(tmp_path, capsys, node, setting, text):
    settings = ["--set", setting] if "input" in setting else ["--set", "input=none.mcap", "--set", setting]
    settings = settings if node == "player" else ["--set", setting]
    code, _, err = run(capsys, "node", node, *settings, "--port", free_port())
    assert code == 1 and text in err and len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (("--from", 20, "--to", 10), "the time asked for begins 2"),
        (("--from", 1000), "nothing but configuration in the time asked for; it is of 2"),
        (("--to", "2001-01-01", "--loop"), "nothing but configuration in the time asked for; it is of 2"),
    ],
)
def test_a_replay_of_nothing_is_refused(capsys, times, told):
    code, out, err = run(capsys, "replay", simulated_flight(12), "-q", "--port", free_port(), *times)
    assert code == 1 and out == "" and len(err.splitlines()) == 1
    assert told in err and err.count("T") > 1


def test_coordinates_outside_the_crs_are_named_with_their_place(tmp_path, capsys):
    write_block(tmp_path, simulated_block())
    (tmp_path / "project.toml").write_text('[project]\ncrs = "EPSG:4326"\n')  # metres taken for degrees
    code, out, err = run(capsys, "adjust", tmp_path)
    assert code == 1 and out == "" and len(err.splitlines()) == 1
    assert "trajectory.csv:2: " in err and "outside the area of 'EPSG:4326'" in err


def test_a_place_that_a_crs_has_not_is_no_fault(tmp_path, monkeypatch, capsys):
    """Such as a point of a flight beyond the geoid of the project's heights."""

    def run(args):
        raise CrsError("coordinates outside the area of 'EPSG:25832+7837'")

    monkeypatch.setattr("triline.nodes.cli.info.run", run)
    (tmp_path / "a.mcap").touch()
    assert main(["info", str(tmp_path / "a.mcap")]) == 1
    assert capsys.readouterr().err == "triline info: coordinates outside the area of 'EPSG:25832+7837'\n"
