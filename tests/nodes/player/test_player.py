"""What `triline replay` puts on the bus of a part of a flight."""

from __future__ import annotations

import threading

import pytest
import sample_messages as sample

from triline.nodes.node import Message
from triline.nodes.player.player import play
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.voices import Voices
from triline.schemas import codec
from triline.schemas import messages as m

SECOND_NS = 10**9
EPOCH_NS = 1_700_000_000 * SECOND_NS


@pytest.fixture
def flight(tmp_path):
    """An operator refuses a point, lets a second receiver in, says its clock, and confirms another project."""
    project, control = sample.body("configuration/project"), sample.body("observation/control")
    rows = [(0, "configuration/project", project, "fly"), (0, "observation/control", control, "survey")]
    for t in range(1, 12):
        rows += [(t, "sensor/gnss", sample.body("sensor/gnss"), name) for name in ("first", "second") if t != 9]
    rows.append((9, "sensor/gnss", sample.body("sensor/gnss"), "second"))
    other = type(project)()
    other.CopyFrom(project)
    other.image_sigma_px = 7.0
    rows += [
        (4, "observation/verdict", m.Verdict(point=control.point, accepted=False, by="Eva"), "confirm"),
        (5, "observation/verdict", m.Verdict(topic="sensor/gnss", accepted=True), "confirm"),
        (6, "observation/verdict", m.Verdict(topic="sensor/gnss", accepted=True, clock_s=0.1), "confirm"),
        (7, "configuration/project", other, "fly"),
        (10, "observation/verdict", m.Verdict(topic="configuration/project", accepted=True), "confirm"),
    ]
    path = tmp_path / "flight.mcap"
    with RecordingWriter(path) as writer:
        for t, topic, body, source in sorted(rows, key=lambda row: row[0]):
            writer.write(Message(topic, EPOCH_NS + t * SECOND_NS, body, source))
    return RecordingReader(path)


def _used(messages):
    """What nodes take of messages: stamp, topic, source, content."""
    voices = Voices()
    used = [one for message in messages for one in voices.hear(message).pass_on]
    return [(one.stamp_ns, one.topic, one.source, one.body.SerializeToString(deterministic=True)) for one in used]


def test_a_part_of_a_flight_begins_with_what_holds_then(flight):
    """Nodes take the same of it as of the whole flight."""
    for begin_s in (2, 5, 6, 8):
        begin_ns, played = EPOCH_NS + begin_s * SECOND_NS, []
        play(flight, played.append, threading.Event(), rate=0.0, from_ns=begin_ns, settle_s=0.0, everything=True)
        heard = []
        for raw in played:
            e = raw.envelope
            heard.append(Message(raw.topic, e.stamp_ns, codec.decode(raw.topic, raw.data), e.source, e.sequence, 0))
        whole, part = _used(flight.sorted_messages()), _used(heard)
        wanted, found = ([row for row in rows if row[0] >= begin_ns] for rows in (whole, part))
        last = {(topic, source) for _, topic, source, _ in wanted}
        assert [row[0] for row in found if row[1] == "configuration/project"] == [EPOCH_NS + 10 * SECOND_NS]
        assert ("sensor/gnss", "second") in last and found == wanted
        before = {row[1:] for row in part if row[0] < begin_ns}
        assert before == {row[1:] for row in whole if row[0] < begin_ns and row[1] != "sensor/gnss"}


def test_of_what_waits_for_a_verdict_the_last_counts(tmp_path):
    """A camera that is said again before the verdict, and one whose program says the first again, do not come back."""
    first, path = sample.body("configuration/camera"), tmp_path / "flight.mcap"
    cameras = [first]
    for k in (1, 2, 3):
        body = type(first)()
        body.CopyFrom(first)
        body.name = f"camera {k}"
        cameras.append(body)
    rows = [(0, "configuration/camera", first, "fly")]
    rows += [(t, "sensor/gnss", sample.body("sensor/gnss"), "receiver") for t in range(1, 30)]
    rows += [(t, "configuration/camera", cameras[k], "fly") for t, k in ((4, 1), (8, 2), (14, 3), (16, 0))]
    rows += [(5.5, "configuration/camera", cameras[3], "somebody")]
    yes = m.Verdict(topic="configuration/camera", accepted=True)
    rows += [(t, "observation/verdict", yes, "confirm") for t in (10, 20)]
    with RecordingWriter(path) as writer:
        for t, topic, body, source in sorted(rows, key=lambda row: row[0]):
            writer.write(Message(topic, EPOCH_NS + round(t * SECOND_NS), body, source))
    reader = RecordingReader(path)
    whole = [row for row in _used(reader.sorted_messages()) if row[1] == "configuration/camera"]
    for begin_s in (5, 6, 9, 11, 15, 18):
        begin_ns, played = EPOCH_NS + begin_s * SECOND_NS, []
        play(reader, played.append, threading.Event(), rate=0.0, from_ns=begin_ns, settle_s=0.0, everything=True)
        part = _used(
            Message(raw.topic, e.stamp_ns, codec.decode(raw.topic, raw.data), e.source, e.sequence, 0)
            for raw in played
            for e in (raw.envelope,)
        )
        found = [row for row in part if row[0] >= begin_ns and row[1] == "configuration/camera"]
        assert found == [row for row in whole if row[0] >= begin_ns], begin_s


def test_a_part_that_is_played_again_and_again_ends_its_strips_and_flies_no_two_at_once(tmp_path):
    """A round of 3 s in mid-strip: the next one begins when the strip of the one before is over."""
    path, stop, played = tmp_path / "flight.mcap", threading.Event(), []
    strips = [("S1", 1, False, 1), ("S1", 1, True, 3), ("S2", 4, False, 4), ("S2", 4, True, 12)]
    rows = [
        (t, "configuration/strip", m.Strip(id=id, first_line_time_ns=EPOCH_NS + first * SECOND_NS, line_rate_hz=100.0,
                                           lines=100 * (t - first) if ended else 0, ended=ended))
        for id, first, ended, t in strips
    ]  # fmt: skip
    rows += [(t, "sensor/gnss", sample.body("sensor/gnss"), "a") for t in range(15)]
    with RecordingWriter(path) as writer:
        for t, topic, body, *_ in sorted(rows, key=lambda row: row[0]):
            writer.write(Message(topic, EPOCH_NS + t * SECOND_NS, body, "a"))

    def publish(raw):
        played.append(raw)
        if sum(one.topic == "sensor/gnss" for one in played) == 8:
            stop.set()

    part = {"from_ns": EPOCH_NS + 6 * SECOND_NS, "to_ns": EPOCH_NS + 9 * SECOND_NS}
    play(RecordingReader(path), publish, stop, rate=0.0, **part, settle_s=0.0, loop=True)
    told = [codec.decode(raw.topic, raw.data) for raw in played if raw.topic == "configuration/strip"]
    first_s = [(body.id, (body.first_line_time_ns - EPOCH_NS) / SECOND_NS, body.lines, body.ended) for body in told]
    assert first_s[2:] == [("S2", 4.0, 0, False), ("S2", 4.0, 500, True), ("S2~2", 10.0, 0, False)]
    assert [(raw.envelope.stamp_ns - EPOCH_NS) / SECOND_NS for raw in played if raw.topic == "sensor/gnss"] == [
        6, 7, 8, 9, 12, 13, 14, 15,
    ]  # fmt: skip
