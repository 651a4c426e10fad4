"""``triline adjust`` of a recording that nobody has processed."""

from __future__ import annotations

import json

import pytest
from command_line import refusal
from recording_file import without_topics

from triline.nodes.cli import main


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    assert main(["simulate", "-o", str(path), "--seconds", "12", "--seed", "4", "-q"]) == 0
    return path


def test_the_answer_is_that_of_the_processed_recording(flight, tmp_path, capsys):
    processed = tmp_path / "processed.mcap"
    assert main(["process", str(flight), "-o", str(processed), "-q"]) == 0
    found = {}
    for name, path in (("raw", flight), ("processed", processed)):
        capsys.readouterr()
        assert main(["adjust", str(path), "--snoop", "-o", str(tmp_path / name), "--json"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    for name in ("points.csv", "residuals.csv", "trajectory_refined.csv"):
        assert (tmp_path / "raw" / name).read_bytes() == (tmp_path / "processed" / name).read_bytes()
    assert found["raw"]["sigma0"] == found["processed"]["sigma0"]
    said = "flight.mcap: no trajectory in it: the navigator has made one of its sensors, as `triline process` does"
    assert said in found["raw"]["notes"] and not any("the navigator" in note for note in found["processed"]["notes"])


@pytest.mark.parametrize(
    ("lost", "told"),
    [
        ("observation/tie", "no message on observation/tie; it cannot be adjusted as a block"),
        ("sensor/gnss", "no message on trajectory/smoothed or trajectory/filtered"),
        ("sensor/attitude", "no message on trajectory/smoothed or trajectory/filtered"),
    ],
)
def test_what_is_missing_is_told(flight, tmp_path, capsys, lost, told):
    assert told in refusal(capsys, "adjust", without_topics(flight, tmp_path / "lost.mcap", lost))
