"""`triline batch --scheduler`: a real Dask scheduler and worker, which are killed."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import distributed
import pytest
from bus_rig import wait_for

from triline.nodes.cli import main
from triline.nodes.dask_cluster import connect
from triline.nodes.errors import UserError

TRILINE = [sys.executable, "-m", "triline.nodes.cli"]
CPU = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


class Cluster:
    """A scheduler and one worker, each a process; `end` kills both."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port = s.getsockname()[1]
        self.address, self.folder = f"tcp://127.0.0.1:{self.port}", folder
        self.processes: list[subprocess.Popen] = []
        self.scheduler = self._start(
            "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"
        )
        wait_for(self._answers, 15, "an answer of the scheduler")
        words = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(folder / "w"), "--death-timeout", "60")
        self.nanny = self._start("distributed.cli.dask_worker", self.address, *words)
        # a nanny gives up where its worker is killed while it still begins itself
        wait_for(self._begun, 15, "the worker")

    def _start(self, module: str, *words: str) -> subprocess.Popen:
        with open(self.folder / "cluster.log", "ab") as log:
            command = [sys.executable, "-m", module, *words]
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=CPU)
        self.processes.append(process)
        return process

    def _begun(self) -> bool:
        with distributed.Client(self.address) as client:
            states = client.run(lambda dask_worker: dask_worker.status.name, nanny=True)
            return set(states.values()) == {"running"}

    def _answers(self) -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
            return True
        return False

    def end(self) -> None:
        for process in self.processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def processes(words: str) -> dict[int, int]:
    """Processes whose command line has these words: number of each, and of who started it."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            if words in (folder / "cmdline").read_text().replace("\0", " "):
                found[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    return found


@pytest.fixture
def season(adjustable, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for k in range(3):
        os.link(adjustable, tmp_path / f"f{k}.mcap")
    return tmp_path


@pytest.fixture
def cluster(tmp_path):
    made = Cluster(tmp_path)
    yield made
    made.end()


def records() -> dict[str, int]:
    found = [os.path.join(folder, name) for folder, _, names in os.walk("out") for name in names]
    return {path: os.stat(path).st_mtime_ns for path in sorted(found) if path.endswith(".done.json")}


def batch(cluster: Cluster) -> subprocess.Popen:
    words = ("f0.mcap", "f1.mcap", "f2.mcap", "-o", "out", "--do", "adjust", "--scheduler", cluster.address)
    return subprocess.Popen([*TRILINE, "batch", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_lost_worker_or_scheduler_costs_only_what_it_was_doing(season, cluster):
    """The worker is killed during its first job, the scheduler when some jobs are finished."""
    job = f"adjust {season}/"
    program = batch(cluster)
    (pid, worker), *_ = wait_for(lambda: list(processes(job).items()), 15, "a job")
    os.kill(worker, signal.SIGKILL)
    wait_for(lambda: not Path(f"/proc/{pid}").exists(), 15, "the end of a job without its worker")
    before = wait_for(records, 15, "something finished")
    cluster.scheduler.kill()
    _, told = program.communicate(timeout=90)
    if program.returncode:  # it may have been through before it heard of it
        assert re.search("the scheduler is gone; [123] of 3 jobs are finished and kept", told.splitlines()[-1])
    cluster.end()
    wait_for(lambda: not processes(job), 15, "the end of a job without its cluster")

    again = Cluster(season)
    try:
        program = batch(again)
        _, told = program.communicate(timeout=120)
        assert program.returncode == 0, told
    finally:
        again.end()
    after = records()
    assert len(after) == 3
    assert {path: after[path] for path in before} == before, "finished jobs are not done again"
    assert json.loads(Path("out/summary.json").read_text())["jobs"]["finished"] == 3
    assert not list(Path("out").rglob(".job-*"))
    tables = [Path(f"out/f{k}/adjustment/points.csv").read_bytes() for k in range(3)]
    assert main(["adjust", "f0.mcap", "-o", "alone"]) == 0
    assert tables == [Path("alone/points.csv").read_bytes()] * 3


def test_an_interrupted_batch_takes_its_jobs_from_the_cluster(season, cluster):
    job = f"adjust {season}/"
    program = batch(cluster)
    wait_for(lambda: processes(job), 15, "a job")
    program.send_signal(signal.SIGINT)
    _, told = program.communicate(timeout=60)
    assert program.returncode == 1
    assert "interrupted; " in told
    wait_for(lambda: not processes(job), 15, "the end of a job that nobody wants")


def test_nobody_at_the_address_is_one_line(season, capsys, monkeypatch):
    import triline.nodes.dask_cluster as module

    monkeypatch.setattr(module, "CONNECT_S", 0.5)
    assert main(["batch", "f0.mcap", "-o", "out", "--scheduler", "tcp://127.0.0.1:1"]) == 1
    told = capsys.readouterr().err.splitlines()
    assert told == ["triline batch: --scheduler tcp://127.0.0.1:1: nobody answers there, wanted a Dask scheduler"]


def test_an_address_that_is_none_is_one_line_at_once(monkeypatch):
    """The traceback of a client that could not begin followed the line, half a minute later."""
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client was begun"))
    with pytest.raises(UserError, match=r"--scheduler http://127.0.0.1:1: unknown address scheme 'http'"):
        connect("http://127.0.0.1:1", "test")
