"""A walk along the topic table: every row encodes, decodes, is recorded, travels on the bus and is replayed."""

from __future__ import annotations

import importlib
import threading

import pytest
import sample_messages as sample
from bus_rig import free_port, wait_for

from triline.nodes.bus.session import Bus
from triline.nodes.player.player import play, shifted
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.schemas.messages import message_class
from triline.schemas.topics import TOPICS, Family, find, rank

NAMES = sample.names()


@pytest.fixture(scope="module")
def on_the_bus():
    """Every topic sent twice through a live subscription and once to a late joiner: topic -> payloads."""
    port = free_port()
    live: dict[str, list] = {name: [] for name in NAMES}
    late: dict[str, list] = {name: [] for name in NAMES}
    with Bus(port=port, source="sender") as sender, Bus(port=port, source="receiver") as receiver:
        for row in TOPICS:
            receiver.subscribe(row.name, lambda raw: live[raw.topic].append(raw))
        wait_for(lambda: sender.peers() == 1, what="the link")
        threading.Event().wait(0.3)
        for name in NAMES:
            sender.publish(sample.message(name, 0))
            sender.publish(sample.message(name, 1))
        wait_for(lambda: all(len(raws) == 2 for raws in live.values()), what="all messages")
        with Bus(port=port, source="late") as joiner:
            for row in TOPICS:
                joiner.subscribe(row.name, lambda raw: late[raw.topic].append(raw))
            latched = [name for name in NAMES if find(name).latched]
            wait_for(lambda: all(len(late[name]) == 2 for name in latched), what="latched messages")
            threading.Event().wait(0.2)
        yield live, late


@pytest.mark.parametrize("name", NAMES)
def test_encode_and_decode(name):
    body = sample.body(name)
    data = codec.encode(body)
    back = codec.decode(name, data)
    assert codec.encode(back) == data == codec.encode(sample.body(name))
    message = back.message() if isinstance(back, LineBlock) else back
    assert message.DESCRIPTOR.full_name == find(name).type_name
    assert message.SerializeToString() != b""


@pytest.mark.parametrize("name", NAMES)
def test_bus(name, on_the_bus):
    live, late = on_the_bus
    for i, raw in enumerate(live[name]):
        sent = sample.message(name, i)
        assert raw.data == codec.encode(sent.body)
        assert (raw.envelope.stamp_ns, raw.envelope.source, raw.envelope.sequence) == (sent.stamp_ns, "test", i)
    assert len(late[name]) == (2 if find(name).latched else 0)
    assert [raw.envelope.sequence for raw in late[name]] == sorted(raw.envelope.sequence for raw in late[name])


@pytest.mark.parametrize("name", NAMES)
def test_record_and_replay(name, tmp_path):
    path = tmp_path / "one.mcap"
    with RecordingWriter(path) as writer:
        for i in range(3):
            writer.write(sample.message(name, i))
    reader = RecordingReader(path)
    assert [codec.encode(b.body) for b in reader.messages()] == [codec.encode(sample.body(name, i)) for i in range(3)]
    played = []
    result = play(reader, played.append, threading.Event(), rate=0, everything=True, settle_s=0.0)
    assert result.counts == {name: 3}
    assert [bytes(raw.data) for raw in played] == [codec.encode(sample.body(name, i)) for i in range(3)]


@pytest.mark.parametrize("name", NAMES)
def test_loop_shifts_every_time_in_a_message(name, tmp_path):
    data = codec.encode(sample.body(name))
    shift_ns = 3_000_000_007
    moved = shifted(name, shifted(name, data, shift_ns, ""), -shift_ns, "")
    assert moved == data
    times = {b for b in _times(codec.decode(name, data)) if b}
    assert {t + shift_ns for t in times} == {
        b for b in _times(codec.decode(name, shifted(name, data, shift_ns, ""))) if b
    }
    assert times or find(name).family is Family.STATUS or name in (
        "configuration/project", "configuration/camera", "observation/control", "observation/verdict", "truth/point",
        "point/object",
    )  # fmt: skip


def test_loop_gives_strips_and_points_new_names():
    tie = codec.decode(
        "observation/tie", shifted("observation/tie", codec.encode(sample.body("observation/tie")), 1, "~2")
    )
    assert (tie.point, tie.images[0].strip, tie.images[0].ccd) == ("T0~2", "S1~2", "F")
    lines = codec.decode("sensor/lines/F", shifted("sensor/lines/F", sample.line_block().encode(), 1, "~2"))
    assert (lines.strip, lines.ccd) == ("S1~2", "F")


def _times(body):
    """Every value of a message that lies near the epoch of the samples."""
    message = body.message() if isinstance(body, LineBlock) else body
    for field, value in message.ListFields():
        if field.message_type is not None and field.message_type.full_name == "google.protobuf.Timestamp":
            yield value.seconds * 10**9 + value.nanos
        elif field.message_type is not None:
            for part in (value,) if hasattr(value, "ListFields") else value:
                yield from _times(part)
        elif isinstance(value, int) and abs(value - sample.EPOCH_NS) < 10**18 // 2:
            yield value


@pytest.mark.parametrize("name", NAMES)
def test_cut_payloads_are_refused_or_come_back_as_they_were_read(name):
    data = codec.encode(sample.body(name))
    refused = 0
    for cut in range(1, min(len(data), 60)):
        try:
            body = codec.decode(name, data[:-cut])
        except ValueError:
            refused += 1
            continue
        assert codec.encode(codec.decode(name, codec.encode(body))) == codec.encode(body)
    assert refused > 0


def test_ranks_put_sensors_before_results():
    assert max(rank(r.name) for r in TOPICS if r.family is Family.SENSOR) < min(
        rank(r.name) for r in TOPICS if r.family is Family.RESULT
    )


@pytest.mark.parametrize(
    "type_name", sorted({row.type_name for row in TOPICS if row.type_name.startswith("foxglove.")})
)
def test_foxglove_types_agree_with_the_published_ones(type_name):
    """Fields of the published schema have its names, numbers, types and labels; ours begin at 1001."""
    short = type_name.split(".")[1]
    published = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short).DESCRIPTOR
    ours = message_class(type_name).DESCRIPTOR
    for field in (f for f in ours.fields if f.number < 1001):
        same = published.fields_by_name[field.name]
        assert (same.number, same.type, same.is_repeated) == (field.number, field.type, field.is_repeated)
    ours_alone = [f.name for f in ours.fields if f.number >= 1001]
    assert not set(ours_alone) & set(published.fields_by_name)
    assert {f.name for f in published.fields} - {f.name for f in ours.fields} <= {
        "heading",
        "color",
        "metadata",
        "velocity",
    }


def test_a_quaternion_beyond_all_bounds_is_refused():
    pose = m.PoseInFrame()
    pose.pose.orientation.x = 1e300
    with pytest.raises(ValueError, match="quaternion of length 1e"):
        codec.validate(pose)


@pytest.mark.parametrize("part", ["lenses", "lines"])
def test_a_camera_without_a_lens_or_a_line_is_refused(part):
    camera = m.Camera(name="c")
    camera.lenses.add(id="L", focal_length_mm=60.0)
    camera.lines.add(id="N", lens="L", x_mm=[0.0, 0.0], y_mm=[0.0, 0.1])
    codec.validate(camera)
    camera.ClearField(part)
    with pytest.raises(
        ValueError, match=f"camera 'c' with {int(part == 'lines')} lenses and {int(part == 'lenses')} CCD"
    ):
        codec.validate(camera)
