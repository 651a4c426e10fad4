"""What `bench/batch_fleet.py` measures, as tests: killed workers, programs and schedulers, and an S3 store."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from places import ROOT

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


def measured(recordings, *words: str) -> dict:
    """The figures of the program; its exit code says that they are as wanted."""
    command = [
        sys.executable,
        str(ROOT / "bench" / "batch_fleet.py"),
        *words,
        "--recordings",
        str(recordings),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def test_killed_workers_leave_every_result_once_and_as_by_process(recordings):
    figures = measured(recordings, "killed", "--flights", "6")
    assert figures["here: equal to process"] == figures["cluster: equal to process"] == 6


def test_the_same_command_does_what_a_killed_program_or_scheduler_left(recordings):
    figures = measured(recordings, "restarted", "--flights", "5")
    assert figures["program: done again"] == figures["scheduler: done again"] == 0


def test_of_a_recording_in_a_store_is_fetched_what_is_used(recordings):
    pytest.importorskip("moto", reason="pip install '.[bench]'")
    figures = measured(recordings, "store")
    assert figures["info: fetched, MB"] < 0.1 * figures["recording, MB"]
    assert figures["adjust: fetched, MB"] < 0.5 * figures["recording, MB"]
    assert figures["process: equal to that of the file"] is True
