"""A window whose solution diverges, since a third of the image points is wrong."""

import json

import numpy as np
import pytest

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.evaluation import evaluate
from triline.solver.window.output import OrientationOutput

FLIGHT = ["--strips", "2", "--seconds", "20", "--no-turns", "--attitude-rate", "50"]


def begun_anew(tmp_path, capsys, *settings):
    """Counters of the adjuster and whole orientation of a flight that diverges, beside the measured one."""
    flight, done = tmp_path / "flight.mcap", tmp_path / "done.mcap"
    assert main(["simulate", "-q", "--sensor", "ads40-small", *FLIGHT, *settings, "-o", str(flight)]) == 0
    capsys.readouterr()
    assert main(["process", str(flight), "-o", str(done), "--processes", "1", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["failed"] == {}
    said = [m.body.message for m in RecordingReader(done).messages(["event/log"])]
    told = sum("the window begins anew without what was in it" in text for text in said)
    assert told == summary["counters"]["adjuster"]["diverged"] > 0
    for message in RecordingReader(done).messages(["orientation/final", "orientation/whole"]):
        assert np.isfinite(list(message.body.covariance)).all()
    result = evaluate(done)["orientation"]
    assert 0.4 < result["whole"]["nees"] < 1.8 and result["whole"]["n"] > 400  # the second strip, all of it
    assert (np.array(result["whole"]["rmse_m"]) < 0.8 * np.array(result["measured"]["rmse_m"])).all()
    return summary["counters"]["adjuster"]["diverged"]


def test_the_window_begins_anew_and_the_rest_of_the_flight_is_as_good_as_its_sigmas_say(tmp_path, capsys, monkeypatch):
    """Which flights diverge hangs on the last digits, so one that does not is said to."""
    turns, turn = [], OrientationOutput.turn

    def turned(self, strip, time_s):
        turns.append(turn(self, strip, time_s))
        return 1.0 if len(turns) == 8 else turns[-1]

    monkeypatch.setattr(OrientationOutput, "turn", turned)
    assert begun_anew(tmp_path, capsys, "--seed", "10") == 1
    assert np.median(turns) > 0.0 and max(turns) < 0.01


@pytest.mark.study
def test_a_flight_with_a_third_of_its_looks_wrong_goes_on(tmp_path, capsys):
    """It ran off for kilometres, then it was no number, and the adjuster failed at every message to the end."""
    begun_anew(tmp_path, capsys, "--outliers", "0.35", "--seed", "10")
