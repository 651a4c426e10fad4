"""Recordings of other writers: of the MCAP library with whatever it leaves out, and of earlier versions of triline."""

from __future__ import annotations

import itertools
from io import BytesIO
from pathlib import Path

import pytest
import sample_messages as sample
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import build_file_descriptor_set, register_schema
from places import ROOT
from recording_file import chunk_spans, write_recording

from triline.nodes.recording.mcap_writer import McapWriter
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import findings
from triline.nodes.recording.writer import COMPRESSIONS
from triline.schemas import codec, topics

GOLDEN = ROOT / "recordings" / "strip.mcap"
NO_SUMMARY = {
    "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
    "use_summary_offsets": False,
}  # fmt: skip


def library_writes(path: Path, messages, source: str = "test", **options) -> Path:
    """A recording by the library's writer alone; log time is a second behind publish time."""
    with open(path, "wb") as file:
        writer = Writer(file, **options)
        writer.start()
        channels: dict[str, int] = {}
        for i, message in enumerate(messages):
            if message.topic not in channels:
                schema = register_schema(writer, topics.find(message.topic).type)
                channels[message.topic] = writer.register_channel(message.topic, "protobuf", schema, {"source": source})
            data = codec.encode(message.body)
            writer.add_message(channels[message.topic], message.stamp_ns + 10**9, data, message.stamp_ns, i)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize(
    "options",
    [
        {}, {"chunk_size": 4096}, {"use_chunking": False}, {"enable_crcs": False}, {"enable_data_crcs": True},
        NO_SUMMARY, {**NO_SUMMARY, "use_chunking": False},
    ],
    ids=["as it is", "small chunks", "no chunks", "no checksums", "checksum of all", "no summary", "neither"],
)  # fmt: skip
def test_what_the_library_writes_is_read(tmp_path, compression, options):
    messages = sample.flight(lines=True)
    path = library_writes(tmp_path / "a.mcap", messages, compression=compression, **options)
    reader = RecordingReader(path)
    raws = list(reader.raws(reader.select()))
    assert [(raw.topic, raw.envelope.stamp_ns, raw.envelope.source, raw.envelope.sequence) for raw in raws] == [
        (message.topic, message.stamp_ns, "test", i) for i, message in enumerate(messages)
    ]
    assert all(raw.receive_ns == raw.envelope.stamp_ns + 10**9 for raw in raws)
    assert [bytes(raw.data) for raw in raws] == [codec.encode(message.body) for message in messages]
    assert reader.complete and reader.damage == [] and reader.check_outside() is None


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunk_size", [1 << 20, 4096, 1])
def test_files_are_those_of_the_librarys_writer_to_the_byte(tmp_path, compression, chunk_size):
    with open(tmp_path / "theirs.mcap", "wb") as theirs, open(tmp_path / "ours.mcap", "wb") as ours:
        library = Writer(theirs, chunk_size, CompressionType[compression.upper()], enable_data_crcs=True)
        library.start(library="triline")
        own = McapWriter(ours, chunk_size, COMPRESSIONS[compression], "triline")
        channels: dict[str, int] = {}
        for i, message in enumerate(sample.flight(lines=True)):
            topic, stamp, data = message.topic, message.stamp_ns, codec.encode(message.body)
            if topic not in channels:
                row = topics.find(topic)
                schema = register_schema(library, row.type)
                content = build_file_descriptor_set(row.type).SerializeToString()
                assert own.register_schema(row.type_name, "protobuf", content) == schema
                channel = library.register_channel(topic, "protobuf", schema, {"source": "test"})
                assert own.register_channel(topic, "protobuf", schema, {"source": "test"}) == channel
                channels[topic] = channel
                for writer in (library, own):
                    writer.add_metadata("channel", {"topic": topic})
            if i % 40 == 30:
                library.flush()
                own.flush()
            received = stamp + (7 * i % 5 - 2) * 10**6  # not in the order of the stamps
            library.add_message(channels[topic], received, data, stamp, i)
            own.add_message(channels[topic], received, memoryview(data), stamp, i)
        library.finish()
        own.finish()
    assert (tmp_path / "ours.mcap").read_bytes() == (tmp_path / "theirs.mcap").read_bytes()


def test_a_recording_without_messages_is_that_of_the_librarys_writer(tmp_path):
    ours, theirs = BytesIO(), BytesIO()
    library = Writer(theirs, compression=CompressionType.NONE, enable_data_crcs=True)
    library.start(library="triline")
    library.finish()
    McapWriter(ours, 1 << 20, "", "triline").finish()
    assert ours.getvalue() == theirs.getvalue()


def test_a_recording_of_an_earlier_version_is_read_like_the_library_reads_it():
    reader = RecordingReader(GOLDEN)
    assert findings(reader) == [] and len(reader.index) > 4000
    ours = {
        (raw.topic, raw.envelope.source, raw.envelope.stamp_ns, raw.receive_ns, bytes(raw.data))
        for raw in reader.raws(reader.select())
    }
    with open(GOLDEN, "rb") as file:
        theirs = {
            (channel.topic, channel.metadata["source"], message.publish_time, message.log_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        }
    assert ours == theirs and len(ours) == len(reader.index)


@pytest.mark.parametrize("chunked", [True, False])
def test_a_program_that_numbers_channels_anew_and_keeps_metadata_mixes_up_no_topics(tmp_path, chunked):
    """Metadata repeat the channels of a recording; their numbers counted more than the channels themselves."""
    ours, theirs = write_recording(tmp_path / "ours.mcap", sample.flight()), tmp_path / "theirs.mcap"
    with open(ours, "rb") as source, open(theirs, "wb") as target:
        reader, writer = make_reader(source), Writer(target, use_chunking=chunked)
        writer.start()
        for kept in reader.iter_metadata():
            writer.add_metadata(kept.name, kept.metadata)
        for i in range(6):  # of another program
            writer.register_channel(f"/other/{i}", "json", 0)
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            to = channels[channel.id]
            writer.add_message(to, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
    told = [[(raw.topic, raw.envelope, bytes(raw.data)) for raw in r.raws(r.sort(r.select()))]
            for r in (RecordingReader(ours), RecordingReader(theirs))]  # fmt: skip
    assert told[0] == told[1]
    assert findings(RecordingReader(theirs)) == []


def test_views_of_a_file_are_not_copies(tmp_path):
    path = write_recording(tmp_path / "a.mcap", [sample.message("sensor/gnss")])
    reader = RecordingReader(path)
    data = reader.raw(0).data
    assert isinstance(data, memoryview) and data.obj is reader._buffer.obj


def test_a_chunk_that_damage_turns_into_a_footer_does_not_end_the_recording(tmp_path):
    path = write_recording(tmp_path / "a.mcap", sample.flight(2.0), chunk_size=8192)
    data, spans = bytearray(path.read_bytes()), chunk_spans(path)
    data[spans[2][0]] = Opcode.FOOTER  # one bit of the opcode of a chunk
    path.write_bytes(data)
    reader = RecordingReader(path)
    assert reader.n_chunks == len(spans) - 1 and reader.complete and reader.damage


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_chunk_of_the_wrong_length_costs_that_chunk_alone(tmp_path, compression):
    """Every bit of the length that its record, its content and its data are said to have."""
    path = write_recording(tmp_path / "a.mcap", sample.flight(2.0), chunk_size=8192, compression=compression)
    data, reader, spans = path.read_bytes(), RecordingReader(path), chunk_spans(path)
    hit = len(spans) // 2
    assert hit > 3
    kept = int((reader.index.chunk != hit).sum())
    begin = spans[hit][0]
    of_data = begin + 9 + 28 + 4 + (0 if compression == "none" else len(compression))
    for place in (begin + 1, begin + 9 + 16, of_data):
        for bit in range(64):
            broken = bytearray(data)
            broken[place + bit // 8] ^= 1 << bit % 8
            (tmp_path / "b.mcap").write_bytes(broken)
            again = RecordingReader(tmp_path / "b.mcap")
            assert len(again.index) == kept and again.damage, (place - begin, bit)
            # some lengths lead into the middle of a record: that is a second piece of the same damage
            for one, other in itertools.pairwise(again.damage):
                assert one.offset + one.length == other.offset, (place - begin, bit)
