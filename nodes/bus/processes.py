"""Nodes as processes: start, watch, stop in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from .program import PARENT_VARIABLE

#: Large image blocks are allocated and freed all the time; glibc would return each to the system and fetch it again.
ALLOCATOR = {
    "MALLOC_MMAP_THRESHOLD_": "1073741824",
    "MALLOC_TRIM_THRESHOLD_": "1073741824",
    "MALLOC_TOP_PAD_": "67108864",
    # the nodes are processes of their own: one BLAS thread each
    "OPENBLAS_NUM_THREADS": "1",
}


@dataclass
class NodeProcess:
    """One node in a process of its own, its output in a log file."""

    name: str
    process: subprocess.Popen[bytes]
    log_path: Path

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, timeout_s: float = 10.0, writes_to: Path | None = None) -> int:
        """Ask it to finish (SIGINT) and wait; kill it after the time-out. Returns the exit code.

        While files in the folder ``writes_to`` grow it still writes what has waited for a slow disk, and is waited for.
        """
        if self.running:
            self.process.send_signal(signal.SIGINT)
        written = _bytes_in(writes_to)
        while True:
            try:
                return self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                before, written = written, _bytes_in(writes_to)
                if written > before:
                    continue
                self.process.kill()
                return self.process.wait()

    def last_line(self) -> str:
        """Why it ended: the last line it wrote, or what killed it."""
        code = self.process.poll()
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        lines = self.log_path.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "no output"


class NodeGroup:
    """Several nodes on one bus. As a context manager it leaves no process behind, whatever happens."""

    def __init__(
        self, log_folder: Path, platform: str, port: int, bus_file: Path | None = None, secure: Path | None = None
    ):
        self.log_folder = log_folder
        where = ["--port", str(port)] if bus_file is None else ["--bus", str(bus_file)]
        where += [] if secure is None else ["--secure", str(secure)]
        self.arguments = ["--platform", platform, *where]
        self.processes: dict[str, NodeProcess] = {}
        self._logs: list[IO[bytes]] = []
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, *arguments: str, own_session: bool = True, id: str = "") -> NodeProcess:
        """Start node ``name`` (again); ``id`` tells several of one name apart.

        A session of its own keeps a Ctrl-C at the terminal from reaching all nodes at once: they are stopped in order.
        """
        id = id or name
        path = self.log_folder / f"{id}.log"
        log = path.open("ab")
        self._logs.append(log)
        command = [sys.executable, "-m", "triline.nodes.cli", "node", name, *self.arguments, *arguments]
        process = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            env={**os.environ, **ALLOCATOR, PARENT_VARIABLE: str(os.getpid())}, start_new_session=own_session,
        )  # fmt: skip
        self.processes[id] = NodeProcess(id, process, path)
        return self.processes[id]

    def dead(self) -> list[NodeProcess]:
        """Nodes that have ended by themselves."""
        return [p for p in self.processes.values() if not p.running]

    def __enter__(self) -> NodeGroup:
        return self

    def __exit__(self, *_: object) -> None:
        running = [p for p in self.processes.values() if p.running]
        for p in running:
            p.process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + 5.0
        for p in running:
            try:
                p.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                p.process.kill()
                p.process.wait()
        for log in self._logs:
            log.close()


def _bytes_in(folder: Path | None) -> int:
    """Size of the recordings of a folder."""
    return 0 if folder is None else sum(path.stat().st_size for path in folder.glob("*.mcap"))
