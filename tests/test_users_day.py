"""A user's day: the tutorial's commands on files that share no code with the package, judged against their truth."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import users_day
from places import ROOT

import triline
from triline.schemas import topics
from triline.solver.geometry.frames import navigation_from_R_lc
from triline.solver.geometry.rotation import matrix_from_quaternion

PAGE = ROOT / "docs" / "your-own-flight.md"
COMMANDS = re.findall(r"^    (triline .+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)


def fly(folder: Path, seconds: float) -> users_day.Truth:
    """Run all commands of the page in a folder."""
    truth = users_day.write_files(folder / "files", seconds)
    assert COMMANDS[0] == "triline new flight valley"
    run(folder, COMMANDS[:1])
    toml = re.search(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert toml is not None
    (folder / "valley" / "flight.toml").write_text(toml.group(1))
    for file in (folder / "files").iterdir():
        if file.is_file():
            file.rename(folder / "valley" / file.name)
    run(folder, COMMANDS[1:])
    return truth


#: Runs commands one after the other until one fails: an interpreter for each would load the same modules ten times.
ALL = """
import shlex, sys
from triline.nodes.cli import main
for command in sys.argv[1:]:
    print(command, flush=True)
    if main(shlex.split(command)[1:]):
        sys.exit(1)
"""


def run(folder: Path, commands: list[str]) -> None:
    # PROJ looks for the geoid here too
    environment = os.environ | {"PROJ_USER_WRITABLE_DIRECTORY": str(folder / "files" / "proj"), "COLUMNS": "120"}
    words = [sys.executable, "-c", ALL, *commands]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"


def orientation_error(recording, truth: users_day.Truth, topic: str):
    """RMS of X, Y, Z in m and of roll, pitch, heading in deg."""
    frame, poses = recording.frame(), recording.poses(topic)
    t = poses.time_ns * 1e-9 - users_day.START_S
    inside = (t > 0.2) & (t < truth.seconds - 0.2)
    position = poses.position_l[inside]
    lat, lon, height = frame.to_geodetic(position).T
    place = np.stack(users_day._TOPO.transform(lon, lat, height), axis=-1)
    rpy = navigation_from_R_lc(frame, position, matrix_from_quaternion(poses.quaternion[inside]))
    true_place, true_rpy = truth.pose(t[inside])
    turn = np.degrees((rpy - true_rpy + np.pi) % (2 * np.pi) - np.pi)
    return np.sqrt(np.mean(np.square(np.hstack([place - true_place, turn])), axis=0))


def shift_of(path: Path, truth: users_day.Truth):
    """By how many cells an orthoimage is off the ground, and the correlation with it."""
    with rasterio.open(path) as source:
        grey, t = source.read(1).astype(float), source.transform
    row, column = np.indices(grey.shape)
    lon, lat = users_day._UTM.transform(t.c + (column + 0.5) * t.a, t.f + (row + 0.5) * t.e, direction="INVERSE")
    h = np.full(grey.shape, users_day.GROUND_M)
    for _ in range(4):
        x, y, z = users_day._TOPO.transform(lon, lat, h)
        h = h + truth.height(x, y) - z
    ground = 235 * truth.brightness(x, y)
    seen = grey > 0
    seen[:4] = seen[-4:] = seen[:, :4] = seen[:, -4:] = False
    whole = [(i, j) for i in range(-4, 5) for j in range(-4, 5)]
    i, j = min(whole, key=lambda s: np.mean(np.square(grey - np.roll(ground, s, (0, 1)))[seen]))
    moved = np.roll(ground, (i, j), (0, 1))
    gy, gx = np.gradient(moved)
    A = np.stack([-gx[seen], -gy[seen], np.ones(seen.sum())], axis=1)
    part = np.linalg.lstsq(A, (grey - moved)[seen], rcond=None)[0]
    return np.hypot(j + part[0], i + part[1]), np.corrcoef(grey[seen], moved[seen])[0, 1]


def judge(folder: Path, truth: users_day.Truth) -> None:
    recording = triline.open(folder / "oriented.mcap")
    measured = orientation_error(recording, truth, "trajectory/smoothed")
    # what the files were given: a reader that turned or moved anything would show here
    given = np.abs([*users_day.OFFSET_M, *users_day.SHIFT_DEG])
    assert measured == pytest.approx(given, rel=0.02, abs=2e-3)
    for topic in ("orientation/final", "orientation/whole"):
        found = orientation_error(recording, truth, topic)
        assert (found < measured).all(), (topic, found, measured)
        assert found[2] < 0.3 * measured[2] and found[5] < 0.3 * measured[5]  # what nothing else can stand in for
    off, alike = shift_of(folder / "ortho.tif", truth)
    assert off < 1.0 and alike > 0.9
    # what the recorder of a flight keeps, and nothing that is there for the order on the bus alone
    assert all(topics.find(name).recorded for name in recording.topics().index)
    assert (folder / "report.html").stat().st_size > 100_000
    assert (folder / "adjusted" / "points.csv").exists()


def test_the_tutorial_on_files_of_another_program(tmp_path):
    judge(tmp_path, fly(tmp_path, 11.0))


@pytest.mark.study
def test_a_longer_day(tmp_path):
    judge(tmp_path, fly(tmp_path, 40.0))


def test_the_program_that_writes_the_files_knows_nothing_of_ours():
    text = Path(users_day.__file__).read_text()
    assert not re.search(r"^\s*(import|from)\s+triline", text, flags=re.MULTILINE)


def test_without_the_geoid_nothing_is_computed(tmp_path):
    """The heights of the control would be off by 47 m."""
    folder = tmp_path / "valley"
    users_day.write_files(folder, 9.0)
    toml = re.search(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert toml is not None
    (folder / "flight.toml").write_text(toml.group(1))
    environment = os.environ | {"PROJ_USER_WRITABLE_DIRECTORY": str(tmp_path), "PROJ_NETWORK": "OFF"}
    words = [sys.executable, "-m", "triline.nodes.cli", "import", str(folder), "-o", str(tmp_path / "x.mcap")]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120)
    if done.returncode == 0:
        pytest.skip("PROJ has the geoid itself here")
    assert "PROJ lacks the grid us_nga_egm96_15.tif" in done.stderr and done.stderr.count("\n") == 1
