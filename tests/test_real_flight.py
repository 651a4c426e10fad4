"""The main job on real motion: a camera on a recorded AVIRIS-NG flight, over the bus and through `process`."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from bus_rig import free_port
from places import MOTION, needs_motion

from triline.nodes.bus.processes import NodeGroup
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.evaluation import evaluate

pytestmark = needs_motion
RATE = 6.0


def triline(*arguments: object) -> str:
    command = [sys.executable, "-m", "triline.nodes.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("real") / "flight.mcap"
    triline("simulate", "--motion", MOTION, "--from", 300, "--seconds", 150, "--seed", 11, "-o", path, "-q")
    return path


@pytest.fixture(scope="module")
def processed(flight: Path) -> Path:
    triline("process", flight, "-o", flight.with_name("processed.mcap"), "-q")
    return flight.with_name("processed.mcap")


def test_on_line_orientation_removes_the_injected_errors(processed: Path):
    result = evaluate(processed)
    measured, final = result["orientation"]["smoothed"], result["orientation"]["final"]
    # metre-level errors of the trajectory go down to the size of what 12 control points leave; in Z the focal length,
    # as well as it is known, is worth metres from 20 km
    assert final["rmse_m"][2] < measured["rmse_m"][2] / 3
    assert np.linalg.norm(final["rmse_m"]) < np.linalg.norm(measured["rmse_m"]) / 2.5
    assert np.linalg.norm(final["rmse_deg"]) < np.linalg.norm(measured["rmse_deg"])
    assert 0.93 < result["sigma0"] < 1.07
    assert 0.4 < final["nees"] < 1.8
    before = np.array(result["points"]["direct_georeferencing"]["rmse_m"])
    after = np.array(result["points"]["adjusted"]["rmse_m"])
    # in X and Y what is left is the image noise: 0.3 px are half a metre from 20 km
    assert (after < before).all() and np.linalg.norm(after) < np.linalg.norm(before) / 2.5


@pytest.mark.study
def test_replay_over_the_bus_gives_the_same_orientation(flight: Path, processed: Path, tmp_path: Path):
    live = tmp_path / "live.mcap"
    port = free_port()
    with NodeGroup(tmp_path / "log", "avirisng", port) as group:
        group.start("recorder", "-o", str(live))
        group.start("adjuster", "--set", 'pace="normal"')
        time.sleep(3)
        where = ("--platform", "avirisng", "--port", port)
        triline("replay", flight, "--rate", RATE, "--wait-for", "adjuster", *where, "-q")
        time.sleep(8)
        assert group.processes["adjuster"].stop() == 0
        time.sleep(6)
        assert group.processes["recorder"].stop() == 0
    for topic in ("orientation/live", "orientation/final", "point/object"):
        ours = [m.body.SerializeToString() for m in RecordingReader(live).sorted_messages([topic])]
        again = [m.body.SerializeToString() for m in RecordingReader(processed).sorted_messages([topic])]
        assert len(ours) > 500
        assert ours == again, f"{topic} differs between the bus and `process`"


def test_import_of_the_pose_file_is_the_measured_trajectory(tmp_path: Path):
    path = tmp_path / "imported.mcap"
    triline("import", MOTION, "-o", path, "-q")
    info = json.loads(triline("info", path, "--json"))
    assert any("trajectory/smoothed" in str(topic) for topic in info["topics"])
