"""A window whose solution diverges, since a third of the image points is wrong."""

import json

import numpy as np

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.evaluation import evaluate

#: A flight of two strips whose first one diverges.
FLIGHT = ["--strips", "2", "--seconds", "20", "--no-turns", "--attitude-rate", "50"]
WRONG = ["--outliers", "0.35", "--seed", "10"]


def test_the_window_begins_anew_and_the_rest_of_the_flight_is_as_good_as_its_sigmas_say(tmp_path, capsys):
    """It ran off for kilometres, then it was no number, and the adjuster failed at every message to the end."""
    flight, done = tmp_path / "flight.mcap", tmp_path / "done.mcap"
    assert main(["simulate", "-q", "--sensor", "ads40-small", *FLIGHT, *WRONG, "-o", str(flight)]) == 0
    capsys.readouterr()
    assert main(["process", str(flight), "-o", str(done), "--processes", "1", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["failed"] == {} and summary["counters"]["adjuster"]["diverged"] == 1
    said = [m.body.message for m in RecordingReader(done).messages(["event/log"])]
    assert sum("the window begins anew without what was in it" in text for text in said) == 1
    for message in RecordingReader(done).messages(["orientation/final", "orientation/whole"]):
        assert np.isfinite(list(message.body.covariance)).all()
    result = evaluate(done)
    whole, measured = (result["orientation"][name] for name in ("whole", "measured"))
    assert 0.4 < whole["nees"] < 1.8
    assert (np.array(whole["rmse_m"]) < 0.8 * np.array(measured["rmse_m"])).all()
    assert whole["n"] > 400  # the second strip, all of it
