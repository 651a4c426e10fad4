"""Nodes as processes: none outlives the program that started it, and what it wrote is whole."""

import subprocess
import sys
import time

import pytest
from bus_rig import free_port, wait_for

from triline.nodes.bus.processes import NodeProcess
from triline.nodes.recording.reader import RecordingReader

PARENT = """
import sys, time
from pathlib import Path
from triline.nodes.bus.processes import NodeGroup
with NodeGroup(Path(sys.argv[1]), "orphan", int(sys.argv[2])) as group:
    node = group.start("recorder", "-o", sys.argv[3])
    print(node.process.pid, flush=True)
    time.sleep(60)
"""


def test_nodes_end_cleanly_when_their_parent_is_killed(tmp_path):
    recording = tmp_path / "flight.mcap"
    command = [sys.executable, "-c", PARENT, str(tmp_path / "log"), str(free_port()), str(recording)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert parent.stdout is not None and parent.stdout.readline().strip().isdigit()
        log = tmp_path / "log" / "recorder.log"
        wait_for(lambda: "recording to" in log.read_text(), 20, "the recorder")
        time.sleep(1)
    finally:
        parent.kill()
        parent.wait()
    wait_for(lambda: "messages in" in log.read_text(), 15, "the end of the recorder by itself")
    assert RecordingReader(recording).complete


@pytest.mark.parametrize("portions", [0, 3])
def test_a_recorder_that_still_writes_is_waited_for(tmp_path, portions):
    """It is killed when its file has not grown in the time that it is given."""
    path, killed = tmp_path / "flight.mcap", []

    class Writing:
        """Of a process that takes more than the time-out for each portion, and then hangs or ends."""

        def poll(self):
            return None

        def send_signal(self, number):
            path.write_bytes(b"x")
            self.left = portions

        def wait(self, timeout_s=None):
            if killed:
                return -9
            if self.left:
                self.left -= 1
                path.write_bytes(path.read_bytes() + b"x")
                raise subprocess.TimeoutExpired("recorder", timeout_s)
            if portions:
                return 0
            raise subprocess.TimeoutExpired("recorder", timeout_s)

        def kill(self):
            killed.append(True)

    path.write_bytes(b"x")
    node = NodeProcess("recorder", Writing(), tmp_path / "recorder.log")
    assert node.stop(1.0, tmp_path) == (0 if portions else -9) and bool(killed) == (not portions)


def test_a_process_that_was_killed_says_so(tmp_path):
    """Its last line, of something else long before, was told as the reason."""
    log = tmp_path / "cam.log"
    log.write_text("cam: lines without a time: times.csv:607\n")
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    node = NodeProcess("cam", process, log)
    assert node.last_line() == "cam: lines without a time: times.csv:607"
    process.kill()
    process.wait()
    assert node.last_line() == "killed by SIGKILL"
