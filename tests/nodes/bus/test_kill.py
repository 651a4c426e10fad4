"""Nodes that are killed or frozen: the others go on, the restarted one catches up, recordings are readable."""

from __future__ import annotations

import errno
import os
import signal
import socket
import threading
import time

import pytest
import sample_messages as sample
from bus_rig import PATIENCE, Rig, free_port, here, simulated_flight, triline, wait_for

from triline.nodes.bus.folder_lock import locked
from triline.nodes.bus.program import ProgramOptions
from triline.nodes.bus.session import Bus
from triline.nodes.recorder import recorder as module
from triline.nodes.recorder.recorder import FLUSH_S, Recorder
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import findings, topic_summaries
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage


class Listener:
    """Hears results and status on the bus."""

    def __init__(self, bus: Bus) -> None:
        self.heard: dict[tuple[str, int], list[float]] = {}
        self.statuses: list = []
        for name in ("sensor/attitude", "trajectory/filtered", "adjustment/report", "orientation/final"):
            bus.subscribe(name, self._hear)
        bus.subscribe("status/*", lambda raw: self.statuses.append(codec.decode(raw.topic, raw.data)))

    def _hear(self, raw: RawMessage) -> None:
        self.heard.setdefault((raw.topic, raw.envelope.start), []).append(time.monotonic())

    def since(self, topic: str, moment: float) -> int:
        return sum(t > moment for (name, _), times in self.heard.items() if name == topic for t in times)

    def last(self, topic: str) -> float:
        """When something was heard last."""
        return max(times[-1] for (name, _), times in self.heard.items() if name == topic)

    def followed(self, node: str, told: int, other: str) -> int:
        """How often both nodes have said something of themselves since the first one did, after so many statuses."""
        names = [status.node for status in self.statuses[told:]]
        since = names[names.index(node) :] if node in names else []
        return min(since.count(node), since.count(other))

    def runs(self, topic: str) -> int:
        return sum(name == topic for name, _ in self.heard)


def test_each_node_killed_in_turn(tmp_path, capsys):
    """One flight; navigator, adjuster and recorder are killed and restarted, the navigator is frozen."""
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="listener") as bus:
        listener = Listener(bus)
        nodes = {
            "recorder": rig.start("node", "recorder", "-o", tmp_path / "0.mcap"),
            "navigator": rig.start("node", "navigator"),
            "adjuster": rig.start("node", "adjuster"),
        }
        wait_for(lambda: bus.alive() >= set(nodes), 30, "the nodes")
        replay = rig.start("replay", simulated_flight(90, 100), "--rate", 1.6, "--wait-for", "navigator,adjuster")
        wait_for(lambda: listener.since("adjustment/report", 0) > 3, 30, "reports")

        # the recorder: at most half a second is lost, nobody else notices
        nodes["recorder"].kill()
        killed_ns, moment = time.time_ns(), time.monotonic()
        silent_s = moment - listener.last("sensor/attitude")  # what the recorder cannot have had either
        nodes["recorder"].wait()
        told = len(listener.statuses)
        nodes["recorder"] = rig.start("node", "recorder", "-o", tmp_path / "0.mcap")

        # the navigator: the adjuster waits for it and goes on with the restarted one. Before that the recorder has to
        # be back: what it missed while it began it asks the navigator for, which has to be there to answer. That one is
        # missing it learns from the next one: of what the navigator says of itself, from what it says a second later
        wait_for(lambda: listener.followed("recorder", told, "navigator") > 2, 30, "the recorder's return")
        wait_for(lambda: listener.since("adjustment/report", moment) > 0, 10, "reports without the recorder")
        runs = listener.runs("trajectory/filtered")
        moment = time.monotonic()
        nodes["navigator"].kill()
        nodes["navigator"].wait()
        nodes["navigator"] = rig.start("node", "navigator")
        wait_for(lambda: listener.runs("trajectory/filtered") == runs + 1, 10, "a trajectory after the restart")
        wait_for(lambda: listener.since("sensor/attitude", moment) > 50, 10, "attitudes without the navigator")
        back = time.monotonic()
        wait_for(lambda: listener.since("adjustment/report", back) > 2, 10, "reports after the restart")

        # the adjuster, with configuration and control from before its time
        nodes["adjuster"].kill()
        nodes["adjuster"].wait()
        moment = time.monotonic()
        nodes["adjuster"] = rig.start("node", "adjuster")
        wait_for(lambda: listener.since("adjustment/report", moment) > 2, 10, "reports of the restarted adjuster")
        wait_for(lambda: listener.since("trajectory/filtered", moment) > 50, 10, "the trajectory, as before")

        # frozen: sensors go on, and it catches up; before that the replay waits for nobody any more
        wait_for(lambda: listener.since("sensor/attitude", time.monotonic() - 0.5) > 50, 60, "the flight at its pace")
        nodes["navigator"].send_signal(signal.SIGSTOP)
        moment = time.monotonic()
        time.sleep(1.0)
        wait_for(lambda: listener.since("sensor/attitude", moment) > 50, 10, "attitudes beside the frozen navigator")
        nodes["navigator"].send_signal(signal.SIGCONT)
        moment = time.monotonic()
        wait_for(lambda: listener.since("trajectory/filtered", moment) > 75, 10, "the frozen navigator")
        status = next(s for s in reversed(listener.statuses) if s.node == "navigator")
        assert sum(t.late + t.gaps for t in status.topics) == 0  # nothing was lost, and nothing was put out of order

        assert rig.stop(replay) == 0, rig.log("replay")
        for name in ("navigator", "adjuster", "recorder"):
            assert rig.stop(nodes[name]) == 0, rig.log(name)

    first, second = tmp_path / "0.mcap", tmp_path / "0_0001.mcap"
    capsys.readouterr()
    assert here("check", first) == 1 and len(capsys.readouterr().err.splitlines()) == 1
    assert here("recover", first, "-o", tmp_path / "whole.mcap") == 0
    reader = RecordingReader(tmp_path / "whole.mcap")
    assert findings(reader) == []
    lost_s = (killed_ns - reader.index.receive_ns.max()) / 1e9 - silent_s
    assert lost_s <= 0.5
    assert here("check", second) == 0
    held = {row.topic for row in topic_summaries(RecordingReader(second))}
    assert {"configuration/camera", "configuration/project", "observation/control", "trajectory/filtered"} <= held
    topics_at_head = [raw.topic for raw in map(RecordingReader(second).raw, range(3))]
    assert topics_at_head == ["configuration/project", "configuration/camera", "observation/control"]


# ---- the recorder and its disk


class Disk:
    """Room for so many bytes; like a real disk it takes a part of what no longer fits."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._write = os.write

    def write(self, descriptor: int, data: memoryview) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self._write(descriptor, data[: self.room])
        self.room -= taken
        return taken


@pytest.fixture
def disk(monkeypatch):
    disk = Disk(60_000)
    monkeypatch.setattr(module.os, "write", disk.write)
    monkeypatch.setattr(module, "RETRY_S", 0.0)
    monkeypatch.setattr(module, "FLUSH_S", 0.0)
    return disk


def raws(n, first=0):
    return [
        RawMessage(
            "sensor/attitude",
            Envelope(sample.EPOCH_NS + i, "test", i),
            codec.encode(sample.body("sensor/attitude")),
            i + 1,
        )
        for i in range(first, first + n)
    ]


def test_a_full_disk_is_reported_the_recorder_lives_and_resumes(disk, tmp_path):
    recorder = Recorder(str(tmp_path / "a.mcap"))
    recorder.start()
    recorder.take(
        [RawMessage("configuration/strip", Envelope(0, "test", 0), codec.encode(sample.body("configuration/strip")))]
    )
    sent = 0
    while not recorder.counters["disk"]:
        recorder.take(raws(20, sent))
        sent += 20
        recorder.tend()
        assert sent < 2000
    assert recorder.last_problem == f"{tmp_path / 'a.mcap'}: no space left on device"
    assert recorder.state().startswith("not recording: ")
    recorder.take(raws(20, sent))
    sent += 20
    recorder.tend()
    assert recorder.alarm.startswith(f"NOT RECORDING: {tmp_path / 'a.mcap'}: no space left on device; ")
    recorder.tend()  # still full
    recorder.problem("malformed", "sensor/imu 4: empty")  # does not take the place of the reason
    assert recorder.state() == f"not recording: {tmp_path / 'a.mcap'}: no space left on device"
    disk.room = 10**9
    recorder.tend()
    assert recorder.state() == "recording"
    recorder.take(raws(30, sent))
    recorder.tend()
    assert recorder.alarm == f"{recorder.counters['lost']} messages were not recorded"
    recorder.close()
    assert recorder.files == [tmp_path / "a.mcap", tmp_path / "a_0001.mcap"]
    # What is on the disk is readable, what is not was counted.
    first, second = (RecordingReader(path) for path in recorder.files)
    assert findings(second) == []
    assert [c.topic for c in second.channels.values()] == ["configuration/strip", "sensor/attitude"]
    kept = len(first.select(["sensor/attitude"]))
    assert 100 < kept < sent
    assert sent - kept <= recorder.counters["lost"] <= sent - kept + 21
    assert [str(d) for d in first.damage] == []


def configuration_and(raws):
    body = codec.encode(sample.body("configuration/strip"))
    return [RawMessage("configuration/strip", Envelope(0, "test", 0), body), *raws]


@pytest.mark.parametrize("fate", ["deleted", "moved away"])
def test_a_recording_whose_folder_goes_away_is_told_and_goes_on_in_another(fate, tmp_path, monkeypatch):
    """Its name promised a recording that nobody could find any more."""
    monkeypatch.setattr(module, "FLUSH_S", 0.0)
    folder = tmp_path / "flight"
    folder.mkdir()
    recorder = Recorder(str(folder / "a.mcap"))
    recorder.start()
    recorder.take(configuration_and(raws(20)))
    recorder.tend()
    folder.rename(tmp_path / "elsewhere")
    if fate == "deleted":
        (tmp_path / "elsewhere" / "a.mcap").unlink()
    recorder.tend()
    lost = 21 if fate == "deleted" else 0
    again = recorder.files[-1]
    assert recorder.last_problem == (
        f"{folder / 'a.mcap'}: was {fate} while it was written; recording again, into {again}; {lost} messages lost"
    )
    assert recorder.counters["disk"] == 1 and recorder.counters["lost"] == lost
    recorder.take(raws(20, 20))
    recorder.tend()
    recorder.close()
    assert again.exists()
    reader = RecordingReader(again)
    assert findings(reader) == []
    assert reader.raw(0).topic == "configuration/strip"
    assert reader.index.sequence[reader.select(["sensor/attitude"])].tolist() == list(range(20, 40))
    if fate == "moved away":
        moved = RecordingReader(tmp_path / "elsewhere" / "a.mcap")
        assert findings(moved) == [] and len(moved.select(["sensor/attitude"])) == 20


def test_a_recording_that_is_deleted_at_last_is_told(tmp_path):
    recorder = Recorder(str(tmp_path / "a.mcap"))
    recorder.start()
    recorder.take(raws(20))
    (tmp_path / "a.mcap").unlink()
    recorder.close()
    assert recorder.counters["disk"] == 1 and recorder.counters["lost"] == 20
    assert recorder.last_problem == f"{tmp_path / 'a.mcap'}: was deleted while it was written"
    assert recorder.account() == "0 messages in no file; 0 missing by number; 20 others were lost"


def test_a_disk_that_numbers_its_files_anew_has_deleted_none(tmp_path, monkeypatch):
    """Network disks do; the recorder would begin another file each half second."""
    monkeypatch.setattr(module.os.path, "samestat", lambda *_: False)
    recorder = Recorder(str(tmp_path / "a.mcap"))
    recorder.start()
    recorder.take(raws(20))
    recorder.close()
    assert recorder.counters["disk"] == 0 and recorder.files == [tmp_path / "a.mcap"]


def test_a_recorder_that_is_slower_than_publishers_makes_them_wait_and_loses_nothing(tmp_path, monkeypatch):
    """What it says of itself comes back to it over the bus while more waits for the disk than may."""
    monkeypatch.setattr(module, "WAITING_BYTES", 2000)
    monkeypatch.setattr(module, "HEAD_S", 0.0)
    monkeypatch.setattr(module, "LAST_WORDS_S", 0.0)

    class Slow(Recorder):
        def take(self, messages):
            time.sleep(0.1)
            super().take(messages)

    recorder, stop = Slow(str(tmp_path / "a.mcap")), threading.Event()
    recorder.start()
    sent = raws(400)
    with Bus(port=free_port(), source="recorder") as bus:
        options = ProgramOptions("recorder", stop=stop)
        recording = threading.Thread(target=module.record, args=(recorder, bus, options), daemon=True)
        recording.start()
        wait_for(lambda: "recorder" in bus.alive(), what="the recorder")
        publishing = threading.Thread(target=lambda: [bus.publish_raw(raw) for raw in sent], daemon=True)
        begun = time.monotonic()
        publishing.start()
        publishing.join(30 * PATIENCE)
        assert not publishing.is_alive() and time.monotonic() - begun > 1.0
        stop.set()
        recording.join(10 * PATIENCE)
        assert not recording.is_alive()
    recorder.close()
    reader = RecordingReader(tmp_path / "a.mcap")
    assert reader.index.sequence[reader.select(["sensor/attitude"])].tolist() == list(range(400))
    assert len(reader.select(["status/recorder"])) > 1


def test_a_recording_is_never_written_over(tmp_path):
    for _ in range(3):
        recorder = Recorder(str(tmp_path / "a.mcap"))
        recorder.start()
        recorder.take(raws(3))
        recorder.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "a_0001.mcap", "a_0002.mcap"]
    assert all(findings(RecordingReader(path)) == [] for path in tmp_path.iterdir())


def test_a_recorder_changes_files_and_each_explains_itself(tmp_path):
    recorder = Recorder(str(tmp_path / "a.mcap"), rotate_mb=0.05)
    recorder.start()
    recorder.take(
        [RawMessage("configuration/strip", Envelope(0, "test", 0), codec.encode(sample.body("configuration/strip")))]
    )
    for i in range(40):
        recorder.take(raws(25, 25 * i))
        recorder._flushed_s -= FLUSH_S  # as if time had passed
        recorder.tend()
    recorder.close()
    assert len(recorder.files) > 1
    numbers = []
    for path in recorder.files:
        reader = RecordingReader(path)
        assert findings(reader) == []
        assert reader.raw(0).topic == "configuration/strip"
        numbers += reader.index.sequence[reader.select(["sensor/attitude"])].tolist()
    assert numbers == list(range(1000))


def test_a_disk_that_fills_and_messages_that_never_came_are_alarms_before_it_is_too_late(tmp_path, monkeypatch):
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 300_000_000})())
    monkeypatch.setattr(module, "DISK_PERIOD_S", 0.0)
    recorder = Recorder(str(tmp_path / "a.mcap"))
    recorder.start()
    recorder.tend()
    assert recorder.alarm == ""
    monkeypatch.setattr(module, "FULL_SOON_BYTES", 400_000_000)
    recorder.take(raws(20))
    recorder.tend()
    assert recorder.alarm.startswith("the disk is nearly full: 300 MB left")
    monkeypatch.setattr(module, "FULL_SOON_BYTES", 0)
    monkeypatch.setattr(module, "FULL_SOON_MIN", 0.0)
    recorder.take(raws(20, 100))
    recorder.tend()
    assert recorder.alarm == "80 messages never came to the recorder"
    recorder.close()


def test_a_folder_of_results_belongs_to_one_program_and_a_held_port_is_named_at_once(tmp_path, capsys):
    with locked(tmp_path / "demo"):
        told = triline("demo", "--headless", "-o", tmp_path / "demo")
        assert told.returncode == 1
        assert f"another program (process {os.getpid()}) writes its results there" in told.stderr
    with locked(tmp_path / "demo"):  # it was let go of
        pass
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        told = triline("demo", "--headless", "-o", tmp_path / "demo", "--port", held.getsockname()[1])
    assert told.returncode == 1 and "another program listens there" in told.stderr
    assert len(told.stderr.splitlines()) == 1
