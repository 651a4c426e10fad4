"""The commands that read and write recordings: what they say, and with which exit code."""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
import time
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sample_messages as sample
from bus_rig import Rig, simulated_flight, wait_for
from bus_rig import triline as command
from command_line import run
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from recording_file import write_recording

import triline
from triline.nodes.bus.session import Bus
from triline.nodes.cli import damage
from triline.nodes.cli.replay import _nobody
from triline.nodes.convert import iso
from triline.nodes.errors import UserError
from triline.nodes.node import Message, Node
from triline.nodes.player.player import play, time_argument
from triline.nodes.recorder.recorder import FLUSH_S
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import active_nodes, process
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.step_driver import StepDriver
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp("cli") / "flight.mcap", sample.flight(3.0, lines=True))


# ---- info, check, recover


def test_info(capsys, flight):
    code, out, _ = run(capsys, "info", flight)
    assert code == 0
    for text in ("project test, crs local", "camera test, 62.7 mm; lines F (2 px)", "strip S1: from 2026-09-21T"):
        assert text in out
    code, out, _ = run(capsys, "info", flight, "--json")
    summary = json.loads(out)
    rows = {row["topic"]: row for row in summary["topics"]}
    assert rows["sensor/attitude"]["messages"] == 600 and rows["sensor/attitude"]["rate_hz"] == pytest.approx(200)
    assert rows["sensor/gnss"]["rate_hz"] == pytest.approx(5)
    assert rows["sensor/attitude"]["sources"] == ["test"]
    assert summary["damage"] == [] and summary["duration_s"] == pytest.approx(2.995)


def test_a_recording_without_an_end_may_be_one_that_is_being_written(capsys, flight, tmp_path):
    """Of a flight that went on its writer was said to be killed."""
    growing = tmp_path / "growing.mcap"
    growing.write_bytes(flight.read_bytes()[: -len(b"\x89MCAP0\r\n")])
    out = run(capsys, "info", growing)[1]
    assert "the file has no end: it is being written, was cut off, or its writer was killed" in out


@pytest.mark.parametrize("word", ["check", "info", "recover"])
def test_a_file_without_an_end_is_looked_at_again(capsys, flight, tmp_path, monkeypatch, word):
    """Recorders write several times a second: `recover` of a flight that goes on said that nothing was lost."""
    data = flight.read_bytes()
    growing = tmp_path / "growing.mcap"
    growing.write_bytes(data[:-30])
    waited = []

    def go_on(seconds):
        waited.append(seconds)
        growing.write_bytes(data[:-20])

    monkeypatch.setattr(damage.time, "sleep", go_on)
    options = ["-o", tmp_path / "out.mcap"] if word == "recover" else []
    _, out, err = run(capsys, word, growing, *options)
    assert "grows: it is being written" in out + err and len(waited) == 1 and waited[0] > FLUSH_S
    _, out, err = run(capsys, word, flight, *options)
    assert "grows" not in out + err and len(waited) == 1


def test_a_view_of_a_recording_without_a_whole_message_tells_the_damage(capsys, flight, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[:200])
    code, _, said = run(capsys, "view", cut, "--rrd", tmp_path / "scene.rrd")
    assert code == 1 and len(said.splitlines()) == 1
    assert "nothing in it that can be shown (the file ends inside a record" in said


def test_stamps_from_zero_have_a_rate(capsys, tmp_path):
    """Sensor folders count seconds from where they will: what began at 0 s had no rate."""
    fixes = [Message("sensor/gnss", k * 200_000_000, sample.body("sensor/gnss", k), "test", k) for k in range(11)]
    code, out, _ = run(capsys, "info", write_recording(tmp_path / "zero.mcap", fixes), "--json")
    assert code == 0 and json.loads(out)["topics"][0]["rate_hz"] == pytest.approx(5)


def test_no_rate_is_known_of_one_message(capsys, tmp_path):
    """The text had "-", the JSON 0.0."""
    one = Message("sensor/gnss", 1_000_000_000, sample.body("sensor/gnss", 0), "test", 0)
    path = write_recording(tmp_path / "one.mcap", [one])
    row = json.loads(run(capsys, "info", path, "--json")[1])["topics"][0]
    assert (row["messages"], row["rate_hz"]) == (1, None)
    assert run(capsys, "info", path)[1].splitlines()[3].split() == ["sensor/gnss", "1", "-", "0", "test"]


def test_a_strip_that_has_not_ended_has_no_number_of_lines(capsys, tmp_path):
    """Drivers say it at the end; it had "0 lines"."""
    strip = m.Strip(id="S1", first_line_time_ns=sample.EPOCH_NS, line_rate_hz=200.0)
    path = write_recording(tmp_path / "cut.mcap", [Message("configuration/strip", sample.EPOCH_NS, strip, "test", 0)])
    code, out, _ = run(capsys, "info", path)
    assert code == 0 and ", lines at 200.0 Hz, not ended" in out


def test_check(capsys, flight, tmp_path):
    assert run(capsys, "check", flight)[0] == 0
    data = flight.read_bytes()
    broken = bytearray(data)
    broken[len(data) // 2] ^= 4
    cases = {
        "cut.mcap": (data[: len(data) * 2 // 3], "the file ends inside a record"),
        "flipped.mcap": (bytes(broken), "a chunk with a wrong checksum"),
        "twice.mcap": (
            data * 2,
            f"a second recording behind the end of the first at byte {len(data)} ({len(data)} bytes)",
        ),
        "longer.mcap": (data + bytes(700), f"bytes behind the end of the recording at byte {len(data)} (700 bytes)"),
        "foreign.mcap": (b"GIF89a" + bytes(50), "not an MCAP recording"),
        "empty.mcap": (b"", "empty"),
    }
    for name, (content, text) in cases.items():
        (tmp_path / name).write_bytes(content)
        code, out, err = run(capsys, "check", tmp_path / name)
        assert (code, out) == (1, "")
        assert len(err.splitlines()) == 1 and text in err and name in err, err
    code, _, err = run(capsys, "check", tmp_path / "none.mcap")
    assert code == 1 and err == f"triline check: {tmp_path / 'none.mcap'}: no such file or folder\n"
    code, out, _ = run(capsys, "check", tmp_path / "cut.mcap", "--json")
    assert code == 1 and json.loads(out)["whole"] is False


def test_check_names_gaps(capsys, tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i in (0, 1, 5):
            body = sample.body("sensor/gnss", i)
            writer.write(Message("sensor/gnss", sample.EPOCH_NS + i, body, "test", i))
    code, _, err = run(capsys, "check", tmp_path / "a.mcap")
    assert code == 1 and "sensor/gnss: 3 messages missing by their numbers" in err


def test_a_file_with_the_flights_of_two_aircraft_is_told(capsys, tmp_path):
    """Tools for MCAP files merge any; nodes took both for one flight, and only duplicates were told."""
    both = tmp_path / "both.mcap"
    with RecordingWriter(both, platform="a1") as writer:
        for platform, source in (("a1", "receiver"), ("b1", "other")):
            for k in range(3):
                data, envelope = codec.encode(sample.body("sensor/gnss", k)), Envelope(sample.EPOCH_NS + k, source, k)
                writer.write_raw(RawMessage("sensor/gnss", envelope, data, 1), platform)
    wanted = "messages of platforms a1, b1 in one file, wanted one for each"
    code, _, err = run(capsys, "check", both)
    assert code == 1 and wanted in err
    assert run(capsys, "info", both)[1].count(wanted) == 1


def test_recover(capsys, flight, tmp_path):
    path, out_path = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    write_recording(tmp_path / "small.mcap", sample.flight(3.0, lines=True), chunk_size=8192)
    data = (tmp_path / "small.mcap").read_bytes()
    path.write_bytes(data[: len(data) // 2])
    code, out, _ = run(capsys, "recover", path, "-o", out_path)
    assert code == 0 and "whole chunks" in out and "the file ends inside a record" in out
    assert run(capsys, "check", out_path)[0] == 0
    kept, before = RecordingReader(out_path), RecordingReader(path)
    assert len(kept.index) == len(before.index) > 100
    np.testing.assert_array_equal(kept.index.stamp_ns, before.index.stamp_ns)
    np.testing.assert_array_equal(kept.index.sequence, before.index.sequence)
    path.write_bytes(data + data)
    code, out, _ = run(capsys, "recover", path, "-o", out_path)
    assert code == 0 and f"lost {len(data)} bytes in 1 places; the first: a second recording behind the end" in out
    assert len(RecordingReader(out_path).index) == len(RecordingReader(tmp_path / "small.mcap").index)
    code, _, err = run(capsys, "recover", path, "-o", path)
    assert code == 1 and "would overwrite" in err
    (tmp_path / "junk").write_bytes(b"junk" * 100)
    code, _, err = run(capsys, "recover", tmp_path / "junk", "-o", tmp_path / "x.mcap")
    assert code == 1 and "nothing in it that could be recovered" in err
    assert not (tmp_path / "x.mcap").exists()


def test_the_parts_of_one_flight_become_one_recording(capsys, tmp_path):
    """A recorder that begins a new file, or was started again: nothing took the parts as one flight."""
    whole, one, two, joined = (tmp_path / f"{name}.mcap" for name in ("whole", "one", "two", "joined"))
    numbers: Counter[str] = Counter()
    messages = []
    for message in sample.flight(6.0):
        messages.append(replace(message, sequence=numbers[message.topic]))
        numbers[message.topic] += 1
    write_recording(whole, messages)
    head = [message for message in messages if message.topic.startswith("configuration/")][:2]
    middle = len(messages) // 2
    write_recording(one, messages[: middle + 20])  # what both have heard is in both
    write_recording(two, [*head, *messages[middle:]])
    code, out, _ = run(capsys, "recover", two, one, "-o", joined, "--json")
    result = json.loads(out)
    assert code == 0 and result["messages"] == len(messages) and result["repeated"] == 20 + len(head)
    assert result["recordings"] == [str(one), str(two)] and result["missing"] == {}
    got, wanted = RecordingReader(joined), RecordingReader(whole)
    for name in ("stamp_ns", "sequence"):
        np.testing.assert_array_equal(getattr(got.index, name), getattr(wanted.index, name))
    assert [m.topic for m in got.messages()] == [m.topic for m in wanted.messages()]
    code, out, _ = run(capsys, "recover", one, two, "-o", joined)
    assert (
        f"kept {len(messages)} messages" in out and " of 2 recordings\n" in out and "that several of them hold" in out
    )
    assert "nothing was lost" in out
    code, _, err = run(capsys, "recover", one, one, "-o", joined)
    assert code == 1 and f"{one}: named twice" in err
    other = tmp_path / "other.mcap"
    with RecordingWriter(other, platform="another") as writer:
        writer.write(messages[0])
    with RecordingWriter(one, platform="aircraft") as writer:
        writer.write(messages[0])
    code, _, err = run(capsys, "recover", one, other, "-o", tmp_path / "x.mcap")
    assert code == 1 and "wanted parts of one flight" in err and not (tmp_path / "x.mcap").exists()
    code, _, err = run(capsys, "recover", one, joined, "-o", joined)
    assert code == 1 and "would overwrite" in err


def test_records_of_other_programs_are_no_damage_and_attachments_are_told(capsys, tmp_path):
    """Opcodes from 0x80 are free for any program; a recording that was written anew may hold both."""
    small, mixed, whole = (tmp_path / f"{name}.mcap" for name in ("small", "mixed", "whole"))
    write_recording(small, sample.flight(3.0), chunk_size=8192)
    with open(small, "rb") as source, open(mixed, "wb") as file:
        writer = McapWriter(file, chunk_size=8192, compression=CompressionType.LZ4, enable_data_crcs=False)
        writer.start("", "another program")
        numbers: dict[int, int] = {}
        reader = make_reader(source)
        for i, (schema, channel, message) in enumerate(reader.iter_messages(log_time_order=False)):
            if channel.id not in numbers:
                id = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, id, channel.metadata
                )
            if i % 100 == 50:
                file.write(struct.pack("<BQ", 0x80 + i % 128, 40) + bytes(40))
                writer.add_attachment(0, 0, "notes.txt", "text/plain", b"windy")
            number = numbers[channel.id]
            writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
    assert i > 200
    assert run(capsys, "check", mixed)[0] == 0
    code, out, _ = run(capsys, "recover", mixed, "-o", whole)
    assert code == 0 and "nothing was lost\n" in out and f"left out {(i + 50) // 100} attachments" in out
    assert len(RecordingReader(whole).index) == len(RecordingReader(small).index)
    assert RecordingReader(whole).compression == "lz4"


def test_what_a_thinned_topic_leaves_out_is_not_missing_in_copies(capsys, tmp_path):
    thinned, recovered, copied = (tmp_path / f"{name}.mcap" for name in ("thinned", "recovered", "copied"))
    with RecordingWriter(thinned, every=lambda topic: 5 if topic == "sensor/gnss" else 1) as writer:
        for i in (0, 5, 10):
            writer.write(Message("sensor/gnss", sample.EPOCH_NS + i, sample.body("sensor/gnss", i), "test", i))
    assert run(capsys, "recover", thinned, "-o", recovered)[0] == 0
    reader = RecordingReader(thinned)
    with RecordingWriter(copied) as writer:  # as `process` copies what it has read
        writer.write_recorded(reader.recorded(reader.select()))
    for path in (thinned, recovered, copied):
        assert run(capsys, "check", path) == (0, f"{path}: whole, 3 messages in 1 chunks\n", "")


# ---- process


@pytest.mark.study
def test_process_twice_gives_the_same_bytes(tmp_path):
    one, two = tmp_path / "1.mcap", tmp_path / "2.mcap"
    for path in (one, two):
        done = command("process", simulated_flight(), "-o", path, "--json")
        assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["nodes"] == ["navigator", "adjuster"] and result["outputs"]["orientation/final"] > 20
    assert result["dropped"] == {} and result["counters"] == {"navigator": {}, "adjuster": {}}
    assert one.read_bytes() == two.read_bytes()
    # what was made is made anew, not taken over
    three = tmp_path / "3.mcap"
    done = command("process", one, "-o", three, "--json")
    assert json.loads(done.stdout)["replaced"]["orientation/final"] == result["outputs"]["orientation/final"]
    assert three.read_bytes() == one.read_bytes()


def test_the_usual_pace_of_process_keeps_that_of_the_results_in_a_recording(capsys, tmp_path):
    def processed(source, name, *more):
        code, out, _ = run(capsys, "process", source, "-o", tmp_path / name, "--json", *more)
        assert code == 0
        return json.loads(out)["pace"], (tmp_path / name).read_bytes()

    flight = tmp_path / "flight.mcap"
    short = ["--seconds", 6, "--lead-in", 1, "--lead-out", 0.5, "--attitude-rate", 50, "--seed", 2]
    assert run(capsys, "simulate", "-o", flight, *short, "-q")[0] == 0
    pace, fast = processed(flight, "fast.mcap")
    assert (pace, fast) == ("throughput", processed(flight, "asked.mcap", "--pace", "throughput")[1])
    assert processed(tmp_path / "fast.mcap", "again.mcap") == ("throughput", fast)
    assert processed(flight, "navigated.mcap", "--nodes", "navigator")[0] == "load"
    _, flown = processed(flight, "flown.mcap", "--pace", "load")
    assert flown != fast and processed(tmp_path / "flown.mcap", "same.mcap") == ("load", flown)


def test_process_refuses_in_one_line(capsys, flight, tmp_path):
    out = tmp_path / "out.mcap"
    ros = tmp_path / "ros.mcap"
    from mcap.writer import Writer

    with open(ros, "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[:-100])
    begun = tmp_path / "begun.mcap"
    begun.write_bytes(flight.read_bytes()[:9])
    longer = tmp_path / "longer.mcap"
    longer.write_bytes(flight.read_bytes() + bytes(700))
    configured = write_recording(tmp_path / "configured.mcap", [sample.message("configuration/camera")])
    bad = tmp_path / "bad.toml"
    bad.write_text("[navigator]\nwings = 2\n")
    for arguments, text in (
        ((flight, "-o", flight), "would overwrite the recording"),
        ((ros, "-o", out), "no topic of triline in it"),
        ((begun, "-o", out), "no topic of triline in it (the file ends inside a record at byte 8"),
        ((cut, "-o", out, "--strict"), "not whole: "),
        ((longer, "-o", out, "--strict"), "not whole: bytes behind the end of the recording"),
        ((configured, "-o", out), "nothing to process for navigator,adjuster: it holds configuration/camera"),
        ((flight, "-o", out, "--nodes", "pilot"), "no node 'pilot'"),
        ((flight, "-o", out, "--nodes", "navigator,viewer"), "no node 'viewer' that works on a recording, wanted navi"),
        ((flight, "-o", out, "--nodes", "adjuster"), "wanted navigator among --nodes, too"),
        ((flight, "-o", out, "--config", bad), "configuration [navigator]: wings is not known"),
        ((flight, "-o", tmp_path / "no" / "out.mcap"), f"out.mcap: no folder {tmp_path / 'no'}"),
    ):
        code, _, err = run(capsys, "process", *arguments)
        assert code == 1 and len(err.splitlines()) == 1 and text in err, err
    assert not out.exists() and not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("command", "reading"),
    [("process", "cli.process.process"), ("recover", "cli.recover._messages"), ("analyze", "report.source.read")],
)
def test_what_cannot_be_read_is_told_as_that(flight, tmp_path, monkeypatch, capsys, command, reading):
    def fails(*arguments, **options):
        raise OSError(5, "Input/output error", str(flight))

    out = tmp_path / "out"
    monkeypatch.setattr(f"triline.nodes.{reading}", fails)
    assert run(capsys, command, flight, "-o", out) == (1, "", f"triline {command}: {flight}: input/output error\n")
    assert not list(tmp_path.iterdir())


class Echo(Node):
    name, inputs, outputs = "echo", ("sensor/gnss",), ("event/log",)

    def step(self, message: Message):
        return [Message("event/log", message.stamp_ns - 10**9, m.Log(message=str(message.sequence)))]


def test_process_skips_damage_and_bad_messages_with_a_count(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for i in range(5):
            writer.write(sample.message("sensor/gnss", i))
        for sequence, data in ((5, b"\xff\xff"), (2, codec.encode(sample.body("sensor/gnss")))):
            envelope = Envelope(sample.EPOCH_NS + 10**9, "test", sequence)
            writer.write_raw(RawMessage("sensor/gnss", envelope, data, 1))
    out: list[RawMessage] = []
    summary = process(RecordingReader(tmp_path / "a.mcap"), [Echo()], out.append)
    assert summary.dropped == {"malformed": 1, "duplicate": 1}
    logs = [raw for raw in out if raw.topic == "event/log"]
    assert [codec.decode(raw.topic, raw.data).message for raw in logs] == list("01234")
    # an output is not known before its cause
    gnss = [raw for raw in out if raw.topic == "sensor/gnss"]
    assert [raw.envelope.stamp_ns for raw in logs] == [raw.envelope.stamp_ns for raw in gnss]
    assert [raw.envelope.stamp_ns for raw in out] == sorted(raw.envelope.stamp_ns for raw in out)


def test_process_tells_impossible_values_from_bytes_that_are_no_message(capsys, tmp_path):
    """Thirty fixes at a latitude of 200 deg were "30 malformed"; their bytes are as they should be."""
    flight = tmp_path / "flight.mcap"
    assert run(capsys, "simulate", "-o", flight, "--seconds", 4, "--lead-in", 1, "--lead-out", 0.5, "-q")[0] == 0
    reader = RecordingReader(flight)
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for raw in reader.raws(reader.select()):
            if raw.topic == "sensor/gnss" and raw.envelope.sequence in (10, 11):
                body = codec.parse(raw.topic, raw.data)
                body.latitude = 200.0
                raw = raw._replace(data=body.SerializeToString())
            elif raw.topic == "sensor/gnss" and raw.envelope.sequence == 15:
                raw = raw._replace(data=b"\xff\xff")
            writer.write_raw(raw)
    words = ("process", tmp_path / "a.mcap", "-o", tmp_path / "b.mcap", "--nodes", "navigator")
    code, out, _ = run(capsys, *words)
    assert code == 0 and "left out: 2 with impossible values, 1 malformed" in out
    assert "latitude 200.0, wanted -90 to 90 degrees" in " ".join(out.split())  # lines are wrapped
    assert json.loads(run(capsys, *words, "--json")[1])["dropped"] == {"impossible": 2, "malformed": 1}


def test_nodes_may_take_and_give_image_lines(tmp_path):
    class Negative(Node):
        name, inputs, outputs = "negative", ("sensor/lines/*",), ("sensor/lines/*",)

        def step(self, message: Message):
            block = message.body
            return [Message("sensor/lines/X", message.stamp_ns, replace(block, pixels=4095 - block.pixels, ccd="X"))]

    path = write_recording(tmp_path / "a.mcap", [sample.message("sensor/lines/F", i) for i in range(3)])
    out: list[Message] = []
    driver = StepDriver(Negative(), time.perf_counter)
    for message in RecordingReader(path).messages():
        out += driver.step(message)
    assert [m.sequence for m in out] == [0, 1, 2]
    np.testing.assert_array_equal(out[2].body.pixels, 4095 - sample.line_block(2).pixels)


def test_only_nodes_with_something_to_work_on_run():
    class Relay(Echo):
        name, inputs, outputs = "relay", ("event/log", "configuration/camera"), ("orientation/live",)

    echo, relay = Echo(), Relay()
    assert active_nodes([relay, echo], ["sensor/gnss"]) == [echo, relay]  # in the order of the flow
    assert active_nodes([relay, echo], ["event/log"]) == [relay]
    assert active_nodes([relay, echo], ["configuration/camera"]) == []


# ---- replay


def test_replay_keeps_its_time(tmp_path):
    """Rate 1: nothing early, no falling behind; how exact on an idle machine, `bench/replay_timing.py` measures."""
    path = write_recording(tmp_path / "a.mcap", sample.flight(2.0))
    reader = RecordingReader(path)
    got: list[tuple[int, float]] = []

    def publish(raw):
        if raw.topic == "sensor/attitude":
            got.append((raw.envelope.stamp_ns, time.perf_counter()))

    play(reader, publish, threading.Event(), settle_s=0.0)
    stamps, times = np.array([s for s, _ in got]), np.array([t for _, t in got])
    late_s = (times - times[0]) - (stamps - stamps[0]) / 1e9
    # after the first message, which may itself have been late
    assert late_s.min() > -0.1 and np.median(np.abs(late_s)) < 0.1
    assert times[-1] - times[0] > 0.9 * (stamps[-1] - stamps[0]) / 1e9


def test_replay_from_to_and_loop(tmp_path):
    path = write_recording(tmp_path / "a.mcap", sample.flight(2.0))
    reader = RecordingReader(path)
    stop, out = threading.Event(), []

    def publish(raw):
        out.append(raw)
        if len(out) > 130:
            stop.set()

    first = sample.EPOCH_NS
    times = {"from_ns": time_argument("0.5", first), "to_ns": time_argument(iso(first + 700_000_000), first)}
    play(reader, publish, stop, rate=0, loop=True, settle_s=0.0, start=10**6, **times)
    assert {raw.topic for raw in out[:6]} == {
        "configuration/project", "configuration/camera", "configuration/strip", "observation/control",
    }  # fmt: skip
    attitude = [raw for raw in out if raw.topic == "sensor/attitude"]
    offsets = [raw.envelope.stamp_ns - first for raw in attitude]
    assert (offsets[0], offsets[40]) == (500_000_000, 700_000_000)
    again = attitude[41]
    assert offsets[41] > offsets[40] and again.envelope.start != attitude[0].envelope.start
    body = codec.decode(again.topic, again.data)
    assert body.time_ns == again.envelope.stamp_ns
    strips = [codec.decode(raw.topic, raw.data).id for raw in out if raw.topic == "configuration/strip"]
    assert strips[:3] == ["S1", "S1", "S1~2"]  # a round ends the strips it has begun
    assert all(b > a for a, b in itertools.pairwise(offsets))


@pytest.mark.parametrize("text", ["soon", "2026-13-45"])
def test_a_time_that_is_none_is_refused(text):
    with pytest.raises(UserError, match="wanted seconds from the start or an ISO time"):
        time_argument(text, 0)


def test_times():
    assert time_argument("1.5", 10) == 1_500_000_010
    assert time_argument("2026-05-01T10:00:00.25", 0) == time_argument("2026-05-01T12:00:00.250+02:00", 0)
    assert iso(time_argument("2026-05-01T10:00:00.25Z", 0)) == "2026-05-01T10:00:00.250000Z"


def test_replay_leaves_out_what_nodes_make_anew(tmp_path):
    messages = [*sample.flight(1.0), *(sample.message("trajectory/filtered", i) for i in range(5))]
    messages.append(sample.message("status/navigator"))
    reader = RecordingReader(write_recording(tmp_path / "a.mcap", messages))
    result = play(reader, lambda raw: None, threading.Event(), rate=0, settle_s=0.0)
    assert result.left_out == {"trajectory/filtered": 5, "status/navigator": 1}
    stamps = sorted(x.stamp_ns for x in messages if x.topic == "trajectory/filtered")
    part = {"from_ns": stamps[1], "to_ns": stamps[3]}  # and no others than of that part are counted
    result = play(reader, lambda raw: None, threading.Event(), rate=0, settle_s=0.0, **part)
    assert result.left_out["trajectory/filtered"] == 3
    # a trajectory that nobody can make anew is an input
    reader = RecordingReader(write_recording(tmp_path / "b.mcap", messages[-6:-1]))
    assert play(reader, lambda raw: None, threading.Event(), rate=0, settle_s=0.0).counts == {"trajectory/filtered": 5}


def test_replay_command(tmp_path, flight):
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="test") as bus:
        got: dict[str, int] = {}
        for name in ("sensor/attitude", "sensor/lines/*", "configuration/camera"):
            bus.subscribe(name, lambda raw: got.update({raw.topic: got.get(raw.topic, 0) + 1}))
        done = command("replay", flight, "--rate", 3, "--json", "--port", rig.port)
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
    assert result["messages"]["sensor/attitude"] == got["sensor/attitude"] == 600
    assert got["sensor/lines/F"] == result["messages"]["sensor/lines/F"] and got["configuration/camera"] == 1


def test_replay_names_who_is_to_be_waited_for_and_is_not_there():
    bus = SimpleNamespace(platform="demo", alive=lambda: {"navigator", "recorder"})
    said = _nobody(bus, "navigtor, recorder", 0.0)
    assert said == "--wait-for navigtor: not on platform demo yet, so not waited for; there: navigator, recorder"
    assert _nobody(bus, "navigator", 0.0) == _nobody(bus, patience_s=0.0) == ""
    bus.alive = set
    assert "no node lives on platform demo yet" in _nobody(bus, "navigator", 0.0)


@pytest.mark.study
def test_replay_says_that_nobody_hears_it(tmp_path, flight):
    with Rig(tmp_path) as rig:
        done = command("replay", flight, "--rate", 0, "--port", rig.port)
        assert done.returncode == 0 and "no node lives on platform demo" in done.stderr
        rig.start("node", "recorder", "-o", tmp_path / "x.mcap")
        with Bus(port=rig.port) as bus:
            wait_for(lambda: bus.alive(), 20, "the recorder")
        done = command("replay", flight, "--rate", 0, "--port", rig.port)
        assert done.returncode == 0 and "no node" not in done.stderr
    with socket.create_server(("127.0.0.1", 0)) as foreign:
        port = foreign.getsockname()[1]
        done = command("replay", flight, "--rate", 0, "--port", port)
        assert f"port {port} is held by a program that does not answer" in done.stderr


# ---- node


def test_node_command_refuses_in_one_line(capsys, tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[navigator\n")
    for arguments, code, text in (
        (("pilot",), 2, "invalid choice: 'pilot'"),
        (("navigator", "--config", bad), 1, "not a TOML file"),
        (("navigator", "--set", "wings=2"), 1, "wings is not known"),
        (("navigator", "--set", "wings"), 1, "wanted KEY=VALUE"),
        (("recorder", "-o", tmp_path / "no" / "x.mcap"), 1, "cannot be written: no such file or directory"),
        (("recorder", "--set", "compression=zip"), 1, "compression is 'zip', wanted one of none, lz4, zstd"),
        (("player",), 1, "the player needs a recording"),
        (("navigator", "--port", "0"), 2, "wanted a port number"),
        (("navigator", "--platform", "a b"), 1, "wanted a name without blanks"),
    ):
        got, _, err = run(capsys, "node", *arguments)
        assert got == code and text in err, err
        assert code == 2 or len(err.splitlines()) == 1


def test_an_unknown_option_is_told_with_the_usage_of_its_command(capsys):
    code, _, err = run(capsys, "adjust", "block", "--selfcall", "tls18")
    assert code == 2 and "usage: triline adjust" in err and "unrecognized arguments: --selfcall" in err


def test_a_place_that_cannot_be_written_to_is_named_as_it_was_given(capsys):
    code, _, err = run(capsys, "simulate", "-o", "/proc/x.mcap", "--seconds", 2, "-q")
    assert code == 1 and err.startswith("triline simulate: /proc/x.mcap: cannot be written"), err


# ---- access from Python


def test_a_recording_as_tables_and_arrays(flight):
    recording = triline.open(flight)
    assert recording.topics().loc["sensor/gnss", "messages"] == 15
    table = recording.table("sensor/gnss")
    assert len(table) == 15 and table["latitude"].eq(48.9).all()
    assert list(table["sequence"]) == list(range(15)) and table["velocity_enu.x"].eq(60).all()
    assert table["timestamp_ns"].iloc[1] == sample.EPOCH_NS + 40 * 5_000_000
    assert np.allclose(table["position_covariance_8"], 0.04)
    assert list(recording.strips().index) == ["S1"]
    assert recording.camera().name == "test" and recording.project().crs == "local"
    lines = recording.table("sensor/lines/F")
    assert lines["pixels"].iloc[0].shape == (4, 64)
    ties = recording.table("observation/tie")
    assert ties["images"].iloc[3][0].ccd == "F"
    assert sum(1 for _ in recording.messages("sensor/gnss", "observation/tie")) == 15 + len(ties)


def test_poses_as_arrays(tmp_path):
    path = write_recording(tmp_path / "a.mcap", [sample.message("orientation/final", i) for i in range(4)])
    poses = triline.open(path).poses()
    assert poses.position_l.shape == (4, 3) and poses.covariance.shape == (4, 6, 6)
    np.testing.assert_allclose(poses.angles, np.tile((0.1, 0.2, 0.3), (4, 1)), atol=1e-12)
    np.testing.assert_array_equal(np.diff(poses.time_ns), 5_000_000)
    assert poses.valid.all() and set(poses.strip) == {"S1"}


def test_access_says_what_is_wrong(flight, tmp_path):
    recording = triline.open(flight)
    for call, text in (
        (lambda: recording.table("sensor/gps"), "no topic 'sensor/gps'; it holds configuration/camera"),
        (lambda: recording.poses("sensor/gnss"), "carries foxglove.LocationFix, not poses"),
        (lambda: triline.open(tmp_path / "none.mcap"), "no such file or directory"),
    ):
        with pytest.raises(UserError, match=text):
            call()
    assert len(recording.poses("orientation/final").time_ns) == 0
    assert recording.table("orientation/final").empty
    empty = triline.open(write_recording(tmp_path / "a.mcap", [sample.message("sensor/gnss")]))
    with pytest.raises(UserError, match="no configuration/camera in it"):
        empty.camera()
