"""Real nodes in real processes on a bus of their own, for tests."""

from __future__ import annotations

import functools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from triline.nodes.bus.session import Bus
from triline.nodes.cli import main
from triline.schemas import codec
from triline.schemas.envelope import RawMessage

TRILINE = [sys.executable, "-m", "triline.nodes.cli"]
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def triline(*arguments: object, timeout: float = 600) -> subprocess.CompletedProcess[str]:
    """A command, run to its end."""
    command = [*TRILINE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, env=ENVIRONMENT)


def here(*arguments: object) -> int:
    """The exit code of a command that is run in this process: its interpreter need not be started for it."""
    return main([*map(str, arguments)])


@functools.cache
def _folder() -> tempfile.TemporaryDirectory:
    """Goes when the process ends."""
    return tempfile.TemporaryDirectory(prefix="triline-tests-")


@functools.cache
def simulated_flight(seconds: int = 8, attitude_hz: int = 200) -> Path:
    """A small flight: attitude, GNSS, tie points, control, truth."""
    path = Path(_folder().name) / f"flight-{seconds}-{attitude_hz}.mcap"
    plan = ("--sensor", "ads40", "--strips", 1, "--seconds", seconds, "--seed", 3, "--attitude-rate", attitude_hz)
    assert here("simulate", "-o", path, *plan, "-q") == 0
    return path


#: A machine that is busy with other things may take so many times as long as an idle one needs at most.
PATIENCE = 6.0


def wait_for(condition: Callable[[], Any], timeout_s: float = 10.0, what: str = "the condition") -> Any:
    """What a question gives as soon as it gives anything."""
    until = time.monotonic() + PATIENCE * timeout_s
    while not (found := condition()):
        assert time.monotonic() < until, f"{what} did not come within {PATIENCE * timeout_s:g} s"
        time.sleep(0.02)
    return found


def wait_for_nodes(bus: Bus, *names: str) -> None:
    """Until nodes are on the bus and have worked off what was said before they came."""
    states: dict[str, str] = {}

    def hear(raw: RawMessage) -> None:
        states[raw.topic.removeprefix("status/")] = codec.decode(raw.topic, raw.data).state

    stop = bus.subscribe("status/*", hear)
    wait_for(lambda: all(states.get(name, "starting") != "starting" for name in names), 40, f"{', '.join(names)}")
    wait_for(lambda: bus.alive() >= set(names), 40, f"{', '.join(names)}")
    stop()


def wait_for_listener(session: zenoh.Session, key: str) -> None:
    """Until a session knows of somebody who listens to a key: what it says there from now on is heard."""
    publisher = session.declare_publisher(key)
    wait_for(lambda: publisher.matching_status.matching, 20, f"one who listens to {key}")
    publisher.undeclare()


class Rig:
    """Processes on one port; whatever happens, none is left when the context ends."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self, *arguments: object, name: str = "") -> subprocess.Popen[bytes]:
        """A command in the background, its output in ``<name>.log``."""
        name = name or str(arguments[1] if arguments[0] == "node" else arguments[0])
        return self.start_program([*TRILINE, *map(str, arguments)], name)

    def start_program(self, command: list[str], name: str) -> subprocess.Popen[bytes]:
        """Any program that takes ``--port``."""
        with open(self.folder / f"{name}.log", "ab") as log:
            process = subprocess.Popen(
                [*command, "--port", str(self.port)],
                stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, env=ENVIRONMENT, start_new_session=True,
            )  # fmt: skip
        self.processes.append(process)
        return process

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def stop(self, process: subprocess.Popen[bytes], number: int = signal.SIGINT) -> int:
        process.send_signal(number)
        return process.wait(20 * PATIENCE)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.wait()
