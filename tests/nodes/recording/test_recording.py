"""Recordings: what is written comes back, and damage costs no more than what it hit."""

from __future__ import annotations

import io
import random
import struct

import numpy as np
import pytest
import sample_messages as sample
from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from recording_file import chunk_spans, write_recording

from triline.nodes.errors import UserError
from triline.nodes.node import Message
from triline.nodes.ordering import order_key
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import damage_lines, findings, holdings, left_out_lines, topic_summaries
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage, pack, unpack
from triline.schemas.image_lines import LineBlock, decode


def keys(reader, numbers=None):
    raws = [reader.raw(int(n)) for n in (reader.select() if numbers is None else numbers)]
    return [(raw.topic, raw.envelope, bytes(raw.data)) for raw in raws]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_what_is_written_comes_back(tmp_path, compression):
    messages = sample.flight(lines=True)
    path = write_recording(tmp_path / "a.mcap", messages, compression=compression)
    reader = RecordingReader(path)
    assert findings(reader) == []
    back = list(reader.messages())
    assert [(b.topic, b.stamp_ns, b.source) for b in back] == [(a.topic, a.stamp_ns, a.source) for a in messages]
    assert [codec.encode(b.body) for b in back] == [codec.encode(a.body) for a in messages]
    for topic in ("sensor/attitude", "sensor/gnss"):
        numbers = [b.sequence for b in back if b.topic == topic]
        assert numbers == list(range(len(numbers)))


def test_the_same_messages_give_the_same_bytes(tmp_path):
    one, two = (
        write_recording(tmp_path / name, sample.flight(lines=True)).read_bytes() for name in ("1.mcap", "2.mcap")
    )
    assert one == two


def test_other_programs_read_a_recording_as_it_is(tmp_path):
    """The MCAP library with the general protobuf decoder, which knows only what is in the file."""
    path = write_recording(tmp_path / "a.mcap", sample.flight(0.1))
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        decoded = [(c.topic, s.name, d, c.metadata) for s, c, _, d in reader.iter_decoded_messages()]
    by_topic = {topic: (name, body, metadata) for topic, name, body, metadata in decoded}
    assert by_topic["sensor/gnss"][0] == "foxglove.LocationFix"
    assert by_topic["sensor/gnss"][1].latitude == 48.9
    assert by_topic["sensor/gnss"][2]["source"] == "test"


def test_sorted_messages_are_sorted_and_all_there(tmp_path):
    messages = [Message(a.topic, a.stamp_ns, a.body, a.source, i) for i, a in enumerate(sample.flight(1.0, lines=True))]
    random.Random(3).shuffle(messages)
    reader = RecordingReader(write_recording(tmp_path / "a.mcap", messages))
    back = [(b.topic, Envelope(b.stamp_ns, b.source, b.sequence)) for b in reader.sorted_messages()]
    assert back == sorted(back, key=lambda k: order_key(*k))
    assert {e.sequence for _, e in back} == set(range(len(messages)))


def test_select_understands_wildcards(tmp_path):
    messages = [sample.message("sensor/lines/F"), sample.message("sensor/gnss")]
    messages.append(Message("sensor/lines/B", sample.EPOCH_NS, sample.line_block(), "test"))
    reader = RecordingReader(write_recording(tmp_path / "a.mcap", messages))
    assert [b.topic for b in reader.messages(["sensor/lines/*"])] == ["sensor/lines/F", "sensor/lines/B"]


def test_a_source_that_goes_back_in_time_is_refused_by_the_writer(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write(sample.message("sensor/gnss", 10))
        with pytest.raises(ValueError, match=r"sensor/gnss of 'test': stamp \d+ after \d+"):
            writer.write(sample.message("sensor/gnss", 9))


def test_both_times_are_kept_apart(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write(sample.message("sensor/gnss"), receive_ns=5)
    reader = RecordingReader(tmp_path / "a.mcap")
    raw = reader.raw(0)
    assert (raw.envelope.stamp_ns, raw.receive_ns) == (sample.EPOCH_NS, 5)


def test_bad_payloads_are_skipped_and_counted(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write(sample.message("sensor/gnss", 0))
        envelope = Envelope(sample.EPOCH_NS, "test", 1)
        writer.write_raw(RawMessage("sensor/gnss", envelope, b"\xff\xff\xff", 1))
        nan = sample.body("sensor/imu")
        nan.rate_x = float("nan")
        writer.write_raw(RawMessage("sensor/imu", envelope, codec.encode(nan), 1))
    reader = RecordingReader(tmp_path / "a.mcap")
    assert len(list(reader.messages())) == 1
    assert reader.problems == {"malformed": 1, "impossible": 1, "without a channel": 0}
    assert "sensor/gnss 1 of 'test': not a foxglove.LocationFix" in reader.last_problems["malformed"]
    assert "rate_x is not finite" in reader.last_problems["impossible"]


def test_impossible_values_are_no_damage_of_the_file(tmp_path):
    """A report named a recording damaged in which a receiver had said NaN."""
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for k in range(3):
            fix = sample.body("sensor/gnss", k)
            fix.latitude = fix.latitude if k else float("nan")
            writer.write(Message("sensor/gnss", sample.EPOCH_NS + k, fix, "test", k))
    reader = RecordingReader(tmp_path / "a.mcap")
    assert len(list(reader.messages())) == 2
    said = "1 message sent with impossible values; the last: sensor/gnss 0 of 'test': latitude is not finite"
    held = holdings(reader)
    assert held.damage == [] and held.unfit == [said] and left_out_lines(reader) == [said]
    assert said in findings(RecordingReader(tmp_path / "a.mcap"))


def test_a_file_without_an_end_that_grows_is_being_written(tmp_path):
    whole = tmp_path / "whole.mcap"
    write_recording(whole, sample.flight(1.0), chunk_size=2048)
    data = whole.read_bytes()
    growing = tmp_path / "growing.mcap"
    for cut, said in ((8, "the file has no end"), (len(data) // 2, "the file ends inside a record at byte ")):
        growing.write_bytes(data[:-cut])
        reader = RecordingReader(growing)
        (line,) = damage_lines(reader)
        assert line.startswith(said) and line.endswith(": it is being written, was cut off, or its writer was killed")
        with open(growing, "ab") as file:
            file.write(data[-cut:][:7])
        (line,) = damage_lines(reader)
        assert line.startswith(said) and line.endswith(", and grows: it is being written")
        assert findings(reader, decode=False) == [line]
    reader = RecordingReader(whole)
    whole.write_bytes(data + b"more")
    assert not damage_lines(reader)  # it has its end; what comes behind is another's


# ---- damage


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory):
    """About 40 chunks: bytes of the file, the chunk of each message, where each chunk begins and ends."""
    path = tmp_path_factory.mktemp("damage") / "long.mcap"
    write_recording(path, sample.flight(6.0, lines=True), chunk_size=8192)
    reader = RecordingReader(path)
    assert reader.n_chunks > 20
    return path.read_bytes(), keys(reader), reader.index.chunk.tolist(), chunk_spans(path)


def test_a_file_cut_anywhere_keeps_all_chunks_before_the_cut(long_recording, tmp_path):
    data, messages, chunks, spans = long_recording
    rng = random.Random(7)
    for cut in sorted(rng.randrange(9, len(data) - 1) for _ in range(60)):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        reader = RecordingReader(path)
        assert findings(reader, decode=False)
        whole = {i for i, (_, end) in enumerate(spans) if end <= cut}
        assert keys(reader) == [k for k, c in zip(messages, chunks, strict=True) if c in whole], cut


def test_a_flipped_bit_is_found_wherever_it_is(long_recording, tmp_path):
    data, messages, chunks, spans = long_recording
    rng = random.Random(11)
    outside = [i for i in range(8, len(data)) if not any(a <= i < b for a, b in spans)]
    for place in [rng.randrange(8, len(data)) for _ in range(40)] + rng.sample(outside, 40):
        broken = bytearray(data)
        broken[place] ^= 1 << rng.randrange(8)
        path = tmp_path / "flipped.mcap"
        path.write_bytes(broken)
        reader = RecordingReader(path)
        assert findings(reader, decode=False), place
        hit = {i for i, (a, b) in enumerate(spans) if a <= place < b}
        spared = [k[0].startswith("configuration/") or c not in hit for k, c in zip(messages, chunks, strict=True)]
        # a bit in the head of a chunk, such as its times, costs no message
        assert keys(reader) in ([k for k, kept in zip(messages, spared, strict=True) if kept], messages), place


def test_a_channel_that_damage_turns_into_a_message_is_none(long_recording, tmp_path):
    data, messages, _, _ = long_recording
    footer = make_reader(io.BytesIO(data)).get_summary()
    assert footer is not None
    path = tmp_path / "flipped.mcap"
    turned = 0
    for channel in footer.channels.values():
        name = channel.topic.encode()
        # id of the channel, id of its schema, its topic: the last time in the file this is the copy behind the data
        head = struct.pack("<HHI", channel.id, channel.schema_id, len(name)) + name
        place = data.rindex(head) - 9
        assert data[place] == Opcode.CHANNEL
        broken = bytearray(data)
        broken[place] = Opcode.MESSAGE
        path.write_bytes(broken)
        reader = RecordingReader(path)
        assert keys(reader) == messages
        assert any("a message behind the end of the data" in line for line in findings(reader, decode=False))
        turned += 1
    assert turned > 3


def test_an_index_that_damage_turns_into_a_message_is_none(long_recording, tmp_path):
    data, messages, _, spans = long_recording
    path = tmp_path / "flipped.mcap"
    for _, end in spans[5:30:6]:
        assert data[end] == Opcode.MESSAGE_INDEX
        broken = bytearray(data)
        broken[end] = Opcode.MESSAGE
        path.write_bytes(broken)
        reader = RecordingReader(path)
        assert keys(reader) == messages
        assert any("a message with the shape of an index" in line for line in findings(reader, decode=False))


def test_configuration_stands_twice_and_is_read_once(tmp_path):
    path = write_recording(tmp_path / "a.mcap", sample.flight(lines=True))
    reader = RecordingReader(path)
    topics = [b.topic for b in reader.messages()]
    head = [t for t in topics if t.startswith("configuration/")]
    assert head and topics[: len(head)] == head and findings(reader) == []
    assert set(reader.index.chunk[: len(head)]) == {0} and 0 not in reader.index.chunk[len(head) :]
    first, end = chunk_spans(path)[0]
    broken = bytearray(path.read_bytes())
    broken[(first + end) // 2] ^= 4
    (tmp_path / "b.mcap").write_bytes(broken)
    again = RecordingReader(tmp_path / "b.mcap")
    assert keys(again) == keys(reader)
    assert len(findings(again)) == 1 and again.damage
    assert sorted(c.id for c in again.channels.values()) == sorted(c.id for c in reader.channels.values())


def test_overwritten_stretches_cost_only_the_chunks_they_touch(long_recording, tmp_path):
    data, messages, chunks, spans = long_recording
    rng = random.Random(13)
    for fill in (b"\0", b"\xff", b"\x06", None):
        for _ in range(10):
            begin, length = rng.randrange(100, spans[-1][0]), rng.choice((10, 1000, 30_000))
            stretch = rng.randbytes(length) if fill is None else fill * length
            path = tmp_path / "overwritten.mcap"
            broken = data[:begin] + stretch + data[begin + length :]
            if broken == data:
                continue
            path.write_bytes(broken)
            reader = RecordingReader(path)
            assert findings(reader, decode=False)
            hit = {i for i, (a, b) in enumerate(spans) if a < begin + length and begin < b}
            kept = [k for k, c in zip(messages, chunks, strict=True) if c not in hit]
            assert set(keys(reader)) >= set(kept), (begin, length)
            assert all(d.length > 0 or d.reason for d in reader.damage)


@pytest.mark.parametrize("content", [b"", b"not a recording at all", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_foreign_files_are_named(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"x.mcap: (empty|not an MCAP recording)"):
        RecordingReader(path)


def test_a_recording_of_another_program_is_called_foreign(tmp_path):
    from mcap.writer import Writer

    with open(tmp_path / "ros.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0\1\0\0\0a", 1)
        writer.finish()
    assert findings(RecordingReader(tmp_path / "ros.mcap")) == ["foreign: no topic of triline in it, only /chatter"]


def test_missing_and_repeated_numbers_are_counted(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i, number in enumerate((0, 1, 4, 5, 5)):
            message = sample.message("sensor/gnss", i)
            writer.write(Message(message.topic, message.stamp_ns, message.body, "test", number))
    reader = RecordingReader(tmp_path / "a.mcap")
    (row,) = topic_summaries(reader)
    assert (row.messages, row.gaps, row.duplicates) == (5, 2, 1)
    assert findings(reader)[0] == "sensor/gnss: 2 messages missing by their numbers"


def test_a_status_that_was_dropped_is_no_damage(tmp_path):
    """It may be, so that it slows nobody down, and a newer one follows: recordings of a busy flight were `damaged`."""
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i, number in enumerate((0, 1, 3)):
            message = sample.message("status/navigator", i)
            writer.write(Message(message.topic, message.stamp_ns, message.body, "test", number))
    reader = RecordingReader(tmp_path / "a.mcap")
    assert [row.gaps for row in topic_summaries(reader)] == [1]
    assert not any("missing" in text for text in findings(reader))


# ---- envelopes and image lines


def test_envelopes_come_back_and_bad_ones_are_refused():
    envelope = Envelope(sample.EPOCH_NS, "navigator", 17, 3)
    data = pack(envelope)
    assert unpack(data) == envelope
    for bad in (b"", data[:20], b"\x02" + data[1:], data + b"x" * 60, data[:25] + b"\xff\xfe"):
        with pytest.raises(ValueError, match="envelope"):
            unpack(bad)
    with pytest.raises(ValueError, match="wanted neither below 0"):
        unpack(pack(Envelope(-1, "a", 0)))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_line_blocks_are_valid_protobuf_and_are_not_copied(dtype):
    block = LineBlock(np.arange(48, dtype=dtype).reshape(3, 16), "N", "S2", 7, sample.EPOCH_NS, 1000)
    data = block.encode()
    message = m.RawImage.FromString(data)  # protobuf's own reading of what was written by hand
    assert (message.height, message.width, message.frame_id, message.first_line) == (3, 16, "N", 7)
    assert message.data == block.pixels.tobytes()
    back = decode(data)
    np.testing.assert_array_equal(back.pixels, block.pixels)
    assert np.shares_memory(back.pixels, np.frombuffer(data, np.uint8))
    assert (back.ccd, back.strip, back.first_line, back.time_ns) == ("N", "S2", 7, sample.EPOCH_NS)
    # and of what protobuf writes, where the pixels stand in the middle
    np.testing.assert_array_equal(decode(message.SerializeToString()).pixels, block.pixels)


def test_line_times_come_back():
    times = sample.EPOCH_NS + np.array([0, 10, 25])
    block = LineBlock(np.zeros((3, 4), np.uint8), "N", "S", 0, int(times[0]), 0, times)
    np.testing.assert_array_equal(decode(block.encode()).times_ns(), times)
    even = LineBlock(np.zeros((3, 4), np.uint8), "N", "S", 0, 100, 7)
    np.testing.assert_array_equal(even.times_ns(), [100, 107, 114])


def test_broken_line_blocks_are_refused_never_misread():
    data = sample.line_block().encode()
    rng = random.Random(5)
    for _ in range(300):
        broken = bytearray(data)
        if rng.random() < 0.5:
            del broken[rng.randrange(len(broken)) :]
        else:
            for _ in range(3):
                broken[rng.randrange(60)] = rng.randrange(256)
        try:
            block = decode(bytes(broken))
        except ValueError:
            continue
        assert block.pixels.shape[0] * block.pixels.shape[1] * block.pixels.itemsize <= len(data)
    message = sample.line_block().message()
    message.height += 1
    with pytest.raises(ValueError, match="bytes of pixels"):
        decode(message.SerializeToString())
    with pytest.raises(DecodeError):
        m.RawImage.FromString(b"\x0a\xff")


def test_a_writer_takes_an_open_file():
    stream = io.BytesIO()
    with RecordingWriter(stream) as writer:
        writer.write(sample.message("sensor/gnss"))
    assert stream.getvalue().endswith(b"\x89MCAP0\r\n")
