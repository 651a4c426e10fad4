"""A node of `triline process` whose work fails at a message: what came out is not told as whole."""

import json
from dataclasses import replace

import pytest
from places import ROOT

from triline.nodes.cli import main
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter


@pytest.fixture
def failing(monkeypatch):
    """A navigator that fails at two fixes, and has another problem after them."""
    step, seen = Navigator.step, []

    def fail(self, message):
        if message.topic == "sensor/gnss":
            seen.append(message)
            if len(seen) in (20, 30):
                raise IndexError("by design")
            if len(seen) == 40:
                self.problem("malformed", "another problem")
        return step(self, message)

    monkeypatch.setattr(Navigator, "step", fail)


@pytest.mark.parametrize("options", [[], ["-q"], ["--json"]])
def test_it_is_told_at_what_and_how_often(failing, options, tmp_path, capsys):
    strip, out = ROOT / "recordings" / "strip.mcap", tmp_path / "out.mcap"
    assert main(["process", str(strip), "-o", str(out), "--nodes", "navigator", *options]) == 0
    told = capsys.readouterr()
    line = (
        "navigator failed twice, its results are not complete; the first time at sensor/gnss 19: IndexError: by design"
    )
    (said,) = (text for text in told.err.splitlines() if not text.startswith("processing: "))  # on a busy machine
    assert said.startswith(f"triline process: {strip}: {line} (test_process_failed.py:")
    assert out.is_file()
    if "--json" in options:
        result = json.loads(told.out)
        assert list(result["failed"]) == ["navigator"] and result["counters"]["navigator"]["failed"] == 2
        assert result["problems"]["navigator"] == "another problem"


@pytest.mark.parametrize(
    ("topic", "field", "said"),
    [
        ("sensor/gnss", "altitude", "no usable message on sensor/gnss"),
        ("sensor/attitude", "roll", "no usable message on sensor/attitude or sensor/imu"),
        ("sensor/gnss", "position_covariance", "sensor/gnss: position covariance: wanted 9 values with a positive dia"),
    ],
)
def test_a_flight_without_a_trajectory_is_told_with_the_reason(topic, field, said, tmp_path, capsys):
    """It was done like any other, and that nothing was oriented had to be found out from the counts of topics."""
    flight, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    with RecordingWriter(flight) as writer:
        for message in RecordingReader(ROOT / "recordings" / "strip.mcap").sorted_messages():
            if message.topic == topic:
                body = type(message.body)()
                body.CopyFrom(message.body)
                if field == "position_covariance":
                    body.position_covariance[:] = [0.0] * 9
                else:
                    setattr(body, field, float("nan"))
                message = replace(message, body=body)
            writer.write(message)
    for options in ([], ["--json"]):
        assert main(["process", str(flight), "-o", str(out), "-q", *options]) == 1
        told, missing = capsys.readouterr(), f"no trajectory came out, so nothing is oriented: {said}"
        assert told.err.splitlines()[-1].startswith(f"triline process: {flight}: {missing}")
        assert out.is_file()  # with all that is in the flight
    assert json.loads(told.out)["notes"][-1].startswith(missing)
