"""``triline navigate`` of a recording: the fixes that nodes used, with the times that an operator said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_file import write_recording

from triline.nodes import convert
from triline.nodes.cli import main
from triline.nodes.node import Message
from triline.nodes.recording.access import Recording
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import messages as m

NEEDED = ("configuration/project", "sensor/imu", "sensor/gnss", "truth/trajectory")
SECOND = convert.SECOND_NS


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> list[Message]:
    """Two strips with a turn between them."""
    path = tmp_path_factory.mktemp("flown") / "flight.mcap"
    words = ["--strips", "2", "--seconds", "25", "--seed", "3", "--imu", "tactical", "--imu-rate", "100", "-q"]
    assert main(["simulate", "-o", str(path), *words]) == 0
    return list(RecordingReader(path).sorted_messages(NEEDED))


def shifted(message: Message, seconds: float, north_deg: float = 0.0, **more) -> Message:
    body = type(message.body).FromString(message.body.SerializeToString())
    convert.set_time(body.timestamp, convert.time_ns(body.timestamp) + round(seconds * SECOND))
    body.latitude += north_deg
    return replace(message, body=body, **more)


def late(messages: list[Message], seconds: float) -> list[Message]:
    return [shifted(x, seconds) if x.topic == "sensor/gnss" else x for x in messages]


def navigated(folder: Path, messages: list[Message], capsys) -> tuple[float, list[str]]:
    """RMS of the horizontal error, m, and the notes."""
    path = write_recording(folder / "flight.mcap", messages)
    assert main(["navigate", str(path), "-o", str(folder / "out"), "--json", "--no-page", "--rate", "20"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    rows = np.loadtxt(folder / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    recording = Recording(path)
    truth, frame = recording.poses("truth/trajectory"), recording.frame()
    t = truth.time_ns * 1e-9
    inside = (t > rows[0, 0] + 20.0) & (t < rows[-1, 0])
    found = np.column_stack([np.interp(t[inside], rows[:, 0], x) for x in frame.from_geodetic(*rows[:, 1:4].T).T])
    return float(np.sqrt(np.mean(np.square(found - truth.position_l[inside])[:, :2].sum(axis=1)))), notes


def test_times_are_corrected_as_an_operator_said_in_flight(flown, tmp_path, capsys):
    body = m.Verdict(topic="sensor/gnss", accepted=True, by="Ann", clock_s=-0.5)
    stamp = next(x.stamp_ns for x in flown if x.topic == "sensor/gnss") + 60 * SECOND
    verdict = Message("observation/verdict", stamp, body, "surveyor", 0)
    off_m, notes = navigated(tmp_path, [*late(flown, 0.5), verdict], capsys)
    assert off_m < 1.0  # it was 2500 m
    assert any("corrected as was said in flight, from the start on: -0.500 s (Ann)" in note for note in notes)
    assert not any("GNSS clock" in note for note in notes)


def test_tenths_of_a_second_between_the_clocks_are_told(flown, tmp_path, capsys):
    off_m, notes = navigated(tmp_path, late(flown, 0.1), capsys)
    (told,) = [note for note in notes if "GNSS clock" in note]
    assert told.startswith("sensor/gnss: timestamp: GNSS clock 0.") and "ahead of the inertial clock" in told
    assert off_m > 5.0  # of which no sigma tells anything
    (tmp_path / "right").mkdir()
    off_m, notes = navigated(tmp_path / "right", flown, capsys)
    assert off_m < 1.0 and not any("GNSS clock" in note for note in notes)


def test_fixes_of_a_second_receiver_are_not_mixed_in(flown, tmp_path, capsys):
    fixes = [x for x in flown if x.topic == "sensor/gnss"]
    other = [shifted(x, 0.0, 1e-3, source="receiver2", stamp_ns=x.stamp_ns + 10**6) for x in fixes]
    off_m, notes = navigated(tmp_path, [*flown, *other], capsys)
    assert off_m < 1.0  # it was refused: inertial and GNSS data do not fit
    assert any(note.startswith(f"sensor/gnss: {len(other)} not used by the nodes") for note in notes)
