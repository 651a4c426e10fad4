"""A disk that takes less than the flight brings: told, nothing lost, and the recorder still answers.

The disk is a named pipe that is read slowly: what the recorder writes waits as at a disk.
"""

from __future__ import annotations

import fcntl
import os
import threading
import time

import pytest
import sample_messages as sample
from bus_rig import Rig, wait_for

from triline.nodes.bus.session import Bus
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage


class SlowDisk:
    """Reads a pipe into a file, ``bytes_s`` a second."""

    def __init__(self, pipe, path) -> None:
        os.mkfifo(pipe)
        self.bytes_s = 20_000.0
        self._pipe, self._path = pipe, path
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with open(self._pipe, "rb", buffering=0) as pipe, open(self._path, "wb") as file:
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, 4096)  # what the pipe itself holds is no slow disk
            while data := pipe.read(4096):
                file.write(data)
                time.sleep(len(data) / self.bytes_s)

    def close(self) -> None:
        self._thread.join(30)


@pytest.fixture
def bodies():
    return [message for message in sample.flight(2.0) if message.topic == "sensor/attitude"]


class Sensors:
    """Publishes 400 attitudes a second from a thread until told to end; ``number`` have been published."""

    def __init__(self, bus, bodies) -> None:
        self.number = 0
        self._bus, self._bodies, self._over = bus, [codec.encode(message.body) for message in bodies], threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        while not self._over.wait(0.025):
            for _ in range(10):
                envelope = Envelope(sample.EPOCH_NS + self.number * 2_500_000, "sensors", self.number)
                data = self._bodies[self.number % len(self._bodies)]
                self._bus.publish_raw(RawMessage("sensor/attitude", envelope, data))
                self.number += 1

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def test_a_slow_disk_is_told_and_nothing_is_lost(tmp_path, bodies):
    statuses = []
    with Rig(tmp_path) as rig, Bus(port=rig.port, source="sensors") as bus:
        bus.subscribe("status/recorder", lambda raw: statuses.append(codec.decode(raw.topic, raw.data)))
        disk = SlowDisk(tmp_path / "pipe.mcap", tmp_path / "kept.mcap")
        recorder = rig.start("node", "recorder", "-o", tmp_path / "pipe.mcap")
        wait_for(lambda: "recorder" in bus.alive(), 30, "the recorder")
        sensors = Sensors(bus, bodies)
        slow = "the disk or the machine is too slow: "
        wait_for(
            lambda: any(slow in s.alarm and "MB wait" in s.alarm for s in statuses), 20, "the slow disk to be told"
        )
        disk.bytes_s = 1e7
        wait_for(lambda: slow not in statuses[-1].alarm, 20, "that it is fast again to be told")
        disk.bytes_s = 15_000.0
        wait_for(lambda: slow in statuses[-1].alarm, 20, "the slow disk to be told again")
        sensors.close()
        time.sleep(0.5)
        disk.bytes_s = 300_000.0
        assert rig.stop(recorder) == 0  # what waits is written first
        disk.close()
    reader = RecordingReader(tmp_path / "kept.mcap")
    numbers = [message.sequence for message in reader.sorted_messages(["sensor/attitude"])]
    assert numbers == list(range(sensors.number)) and not reader.problems.total()
