"""What of a recording is used: nothing is left out without being counted, and clocks that are wrong do no harm."""

from __future__ import annotations

import numpy as np
import pytest
import sample_messages as sample

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import time_span_ns
from triline.nodes.recording.usable import usable
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage

BEGIN_NS = 10**18
ATTITUDE, GNSS = "sensor/attitude", "sensor/gnss"


def stream(topic, hz, seconds, stamped=lambda t: t, numbered=lambda i: i):
    """Messages of a sensor in the order in which they came: (s of reception, topic, stamp in s, number)."""
    return [(i / hz, topic, stamped(i / hz), numbered(i)) for i in range(round(seconds * hz))]


def recording(path, *streams):
    data = {topic: codec.encode(sample.body(topic)) for topic in (ATTITUDE, GNSS)}
    with RecordingWriter(path) as writer:
        for received, topic, stamp, number in sorted(row for rows in streams for row in rows):
            envelope = Envelope(BEGIN_NS + round(stamp * 1e9), topic.split("/")[1], number)
            writer.write_raw(RawMessage(topic, envelope, data[topic], BEGIN_NS + round(received * 1e9)))
    return RecordingReader(path)


def used(reader):
    """What is used, by topic: stamps, s."""
    found = usable(reader, lambda channel: False, lambda topic: True)
    left_out = len(reader.index) - len(found.numbers)
    assert found.left_out.total() == left_out
    rows = [(reader.channels[int(reader.index.channel[n])].topic, int(reader.index.stamp_ns[n])) for n in found.numbers]
    assert [stamp for _, stamp in rows] == sorted(stamp for _, stamp in rows)
    return found, {of: [(stamp - BEGIN_NS) / 1e9 for topic, stamp in rows if topic == of] for of in (ATTITUDE, GNSS)}


@pytest.mark.parametrize("last", [(3600.0, 24), (4.8, 50_000)], ids=["stamp", "number"])
def test_what_jumps_ahead_at_the_very_end_is_counted(tmp_path, last):
    """Nothing follows that could confirm it."""
    gnss = stream(GNSS, 5.0, 5.0)
    gnss[-1] = (gnss[-1][0], GNSS, *last)
    reader = recording(tmp_path / "flight.mcap", stream(ATTITUDE, 100.0, 5.0), gnss)
    found, stamps = used(reader)
    assert found.left_out == {"malformed": 1} and "jump" in found.last_problems["malformed"]
    assert time_span_ns(reader, found.numbers) == (BEGIN_NS, BEGIN_NS + 4_990_000_000)
    assert len(stamps[GNSS]) == 24 and len(stamps[ATTITUDE]) == 500


@pytest.mark.parametrize("since", [0.0, 2.5])
def test_a_stream_that_is_an_hour_ahead_of_all_others_is_left_out(tmp_path, since):
    gnss = stream(GNSS, 5.0, 5.0, lambda t: t + (3600.0 if t + 0.1 > since else 0.0))
    reader = recording(tmp_path / "flight.mcap", stream(ATTITUDE, 100.0, 5.0), [(t + 0.1, *row) for t, *row in gnss])
    found, stamps = used(reader)
    assert found.left_out == {"clock": sum(stamp > 60 for _, _, stamp, _ in gnss)}
    assert "sensor/gnss of 'gnss' is stamped 3599.9 s ahead of everything else" in found.last_problems["clock"]
    assert max(stamps[GNSS], default=0.0) < 5 and len(stamps[ATTITUDE]) == 500
    assert np.subtract(*time_span_ns(reader, found.numbers)[::-1]) < 5e9
    assert np.subtract(*time_span_ns(reader)[::-1]) > 3600e9


@pytest.mark.parametrize("topic, last", [(GNSS, (3600.0, 24)), (ATTITUDE, (3600.0, 499))])
def test_check_finds_a_stamp_that_no_node_would_use(tmp_path, capsys, topic, last):
    """By its numbers such a recording is whole."""
    streams = {ATTITUDE: stream(ATTITUDE, 100.0, 5.0), GNSS: stream(GNSS, 5.0, 5.0)}
    recording(tmp_path / "good.mcap", *streams.values())
    streams[topic][-1] = (streams[topic][-1][0], topic, *last)
    recording(tmp_path / "flight.mcap", *streams.values())
    assert main(["check", str(tmp_path / "good.mcap")]) == 0
    assert main(["check", str(tmp_path / "flight.mcap")]) == 1
    said = capsys.readouterr().err
    assert "1 messages that nodes leave out for their stamps or numbers" in said and topic in said


def test_a_pause_of_an_hour_loses_nothing(tmp_path):
    late = lambda t: t + (3600.0 if t > 2.5 else 0.0)  # noqa: E731
    reader = recording(
        tmp_path / "flight.mcap", stream(ATTITUDE, 100.0, 5.0, late), stream(GNSS, 5.0, 5.0, late)
    )  # fmt: skip
    found, stamps = used(reader)
    assert not found.left_out and [len(times) for times in stamps.values()] == [500, 25]


def test_a_clock_that_was_set_back_tells_no_time_twice(tmp_path):
    """Sorted by stamps, what came after would be mixed with what was measured then."""
    attitude = stream(ATTITUDE, 100.0, 12.0, lambda t: t - (3.005 if t > 6 else 0.0))
    found, stamps = used(recording(tmp_path / "flight.mcap", attitude, stream(GNSS, 5.0, 12.0)))
    times = np.array(stamps[ATTITUDE])
    np.testing.assert_allclose(times[times < 6.002], np.arange(601) / 100)
    np.testing.assert_allclose(times[times > 6.002], 6.005 + np.arange(299) / 100)
    assert set(found.left_out) == {"late", "malformed"} and found.left_out["malformed"] == 4
    assert found.notes == ["sensor/attitude of 'attitude': the clock was set back by 2.955 s"]


def test_one_stamp_that_is_ahead_costs_no_others_their_place(tmp_path):
    """Those after it go on where all other sensors are."""
    attitude = stream(ATTITUDE, 100.0, 12.0, lambda t: t + (20.0 if t == 6.0 else 0.0))
    found, stamps = used(recording(tmp_path / "flight.mcap", attitude, stream(GNSS, 5.0, 12.0)))
    assert found.left_out == {"malformed": 4} and len(stamps[ATTITUDE]) == 1196


def test_messages_out_of_order_are_no_clock_that_was_set_back(tmp_path):
    attitude = stream(ATTITUDE, 100.0, 5.0)
    attitude = [row for i in range(0, 500, 10) for row in (*attitude[i + 5 : i + 10], *attitude[i : i + 5])]
    attitude = [(i / 100, *row) for i, (_, *row) in enumerate(attitude)]
    found, stamps = used(recording(tmp_path / "flight.mcap", attitude, stream(GNSS, 5.0, 5.0)))
    assert not found.left_out and len(stamps[ATTITUDE]) == 500


@pytest.mark.parametrize("ahead_s", [18.0, -18.0, 0.3])
def test_fixes_with_stamps_of_another_clock_than_attitudes_received_with_them_are_told(tmp_path, ahead_s):
    gnss = stream(GNSS, 5.0, 30.0, lambda t: t + 100.0 + ahead_s)
    attitude = stream(ATTITUDE, 100.0, 30.0, lambda t: t + 100.0)
    silent = [row for row in attitude if not 5.0 < row[0] < 22.0]  # attitudes that stop tell nothing
    found, stamps = used(recording(tmp_path / "flight.mcap", silent, gnss))
    assert len(stamps[GNSS]) == 150 and not found.left_out
    where = {18.0: "ahead of", -18.0: "behind"}.get(ahead_s)
    told = f"GNSS clock 18.00 s {where} the attitude clock (the leap seconds between GPS time and UTC), by what"
    assert [note[: len(told)] for note in found.notes] == ([told] if where else [])


def test_process_tells_what_it_used_all_the_same_and_counts_only_what_it_left_out(tmp_path, capsys):
    flight, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    messages = sample.flight(4.0)
    with RecordingWriter(flight) as writer:
        numbers: dict[str, int] = {}
        for message in messages:
            number = numbers[message.topic] = numbers.get(message.topic, -1) + 1
            ahead = 20 * 10**9 if (message.topic, number) == (ATTITUDE, 300) else 0
            envelope = Envelope(message.stamp_ns + ahead, message.source, number)
            writer.write_raw(RawMessage(message.topic, envelope, codec.encode(message.body), message.stamp_ns))
    assert main(["process", str(flight), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "left out: 4 malformed" in said
    assert "used all the same: sensor/attitude of 'test': the clock was set back by" in said
