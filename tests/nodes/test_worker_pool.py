"""Processes that share work, and Ctrl-C, which a terminal sends to all of them."""

import os
import subprocess
import sys
from dataclasses import fields

import pytest

from triline.nodes.batch.image_rectification import ImageRectification
from triline.nodes.worker_pool import cores

#: One of four pieces of work is a Ctrl-C.
CTRL_C = """import os, signal, sys
from triline.nodes.worker_pool import WorkerPool
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    try:
        with WorkerPool(2, fresh=FRESH) as pool:
            for _ in pool.map(os.killpg, [os.getpgrp()] * 4, [0, 0, signal.SIGINT, 0]):
                pass
    except KeyboardInterrupt:
        sys.exit(3)"""


@pytest.mark.parametrize("fresh", [True, False])
def test_workers_that_are_interrupted_end_without_a_word(tmp_path, fresh):
    """Each of them printed a traceback, above the one line of the first process."""
    words = [sys.executable, "-c", CTRL_C.replace("FRESH", str(fresh))]
    run = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, start_new_session=True, timeout=600)
    assert (run.returncode, run.stdout, run.stderr) == (3, "", "")


def test_cores_are_those_that_may_be_used_or_that_there_are(monkeypatch):
    """macOS does not tell which may be used: `triline rectify` failed there."""
    (workers,) = (field for field in fields(ImageRectification) if field.name == "workers")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3}, raising=False)
    assert cores() == workers.default_factory() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    assert cores() == workers.default_factory() == os.cpu_count()
