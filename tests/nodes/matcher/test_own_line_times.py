"""A camera that is triggered, or free-running: its lines have times of their own, and so have the tie points."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from driven_flight import SETTINGS
from recording_file import write_recording

from triline.nodes import convert
from triline.nodes.cli import main
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.evaluation import evaluate
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator

EPOCH_NS = 1_700_000_000_000_000_000
#: Clock of the platform against the rate of the camera: so many seconds, in such a period.
AMPLITUDE_S, PERIOD_S = 0.03, 12.0


def warped(time_ns) -> np.ndarray:
    """The same flight on another clock, by which platform and camera go faster and slower together."""
    s = (np.asarray(time_ns) - EPOCH_NS) * 1e-9
    return EPOCH_NS + np.rint((s + AMPLITUDE_S * np.sin(2 * np.pi * s / PERIOD_S)) * 1e9).astype(np.int64)


def other_clock(message: Message) -> Message:
    body, stamp = message.body, int(warped(message.stamp_ns))
    if message.topic.startswith("sensor/lines/"):
        times = warped(body.times_ns())
        body = replace(body, time_ns=int(times[0]), line_period_ns=0, line_times_ns=times)
        stamp = int(times[-1])
    elif message.topic == "configuration/strip":
        body.first_line_time_ns = int(warped(body.first_line_time_ns))
    elif hasattr(body, "timestamp"):
        convert.set_time(body.timestamp, int(warped(convert.time_ns(body.timestamp))))
    return Message(message.topic, stamp, body, message.source)


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Recordings that ``process`` made of a flight at a constant rate, and of the same on another clock."""
    folder = tmp_path_factory.mktemp("flights")
    flight = simulated_flight({**SETTINGS, "seconds": 10.0, "control": 8, "check": 12})
    found = {}
    for name, change in (("constant", lambda message: message), ("own", other_clock)):
        raw, out = folder / f"{name}.mcap", folder / f"{name}_out.mcap"
        messages = [change(m) for m in Simulator(flight.simulation, flight.imager).messages(EPOCH_NS)]
        write_recording(raw, sorted(messages, key=lambda m: m.stamp_ns), platform="test")
        assert main(["process", str(raw), "-o", str(out), "-q", "--nodes", "navigator,matcher,adjuster"]) == 0
        found[name] = raw, out
    return found


def ties(path):
    return [m.body for m in RecordingReader(path).messages(["observation/tie"]) if m.source == "matcher"]


def test_tie_points_have_the_times_of_their_lines(flights):
    raw, out = flights["own"]
    blocks = [m.body for m in RecordingReader(raw).messages(["sensor/lines/N"])]
    line = np.concatenate([b.first_line + np.arange(len(b.pixels)) for b in blocks])
    time_s = (np.concatenate([b.times_ns() for b in blocks]) - EPOCH_NS) * 1e-9
    off_rate = (time_s - time_s[0]) * (len(line) - 1) / (time_s[-1] - time_s[0]) - line
    assert np.abs(off_rate).max() > 1.5
    looks = [image for tie in ties(out) for image in tie.images]
    stated_s = (np.array([image.time_ns for image in looks]) - EPOCH_NS) * 1e-9
    np.testing.assert_allclose(stated_s, np.interp([i.line for i in looks], line, time_s), atol=1e-6)
    assert len(ties(out)) > 0.9 * len(ties(flights["constant"][1])) > 30
    logs = [m.body.message for m in RecordingReader(out).messages(["event/log"])]
    assert not any("lines/s" in text for text in logs)


def test_points_are_as_good_as_at_a_constant_rate_on_line_and_in_the_batch(flights, capsys):
    """Taken at the rate, lines would be off by two, and points by decimetres."""
    for name, (_, out) in flights.items():
        points = evaluate(out)["points"]
        assert main(["adjust", str(out), "--json"]) == 0
        batch = json.loads(capsys.readouterr().out)
        for what in (points["adjusted"], points["adjusted_whole"], batch["check"]):
            assert what["n"] >= 10 and max(what["rmse_m"]) < 0.1, (name, what)
        assert points["adjusted_whole"]["nees"] < 2.0 and batch["sigma0"] < 1.0
        # before the adjustment, too: rays of the report go through the orientation of their times
        assert points["direct_georeferencing"]["nees"] < 2.0
