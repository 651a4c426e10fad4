"""``triline adjust`` in partitions, and of several recordings."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from recording_file import write_recording
from test_adjust_command import write_block

from triline.nodes.cli import main
from triline.nodes.cli.adjust import read_input
from triline.nodes.formats.block_messages import block_messages
from triline.nodes.node import Message
from triline.schemas import messages as m


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "block"
    write_block(path, points=120)
    return path


def adjust(*words):
    return main(["adjust", *map(str, words)])


def tables(folder):
    return {name: pd.read_csv(folder / name) for name in ("points.csv", "residuals.csv")}


def test_workers_give_the_tables_of_one_process(folder, tmp_path, capsys):
    options = ("--snoop", "--variance-components")
    assert adjust(folder, *options, "-o", tmp_path / "one") == 0
    assert adjust(folder, *options, "-o", tmp_path / "two", "--workers", 1, "--partition-rays", 300) == 0
    for name, table in tables(tmp_path / "one").items():
        pd.testing.assert_frame_equal(tables(tmp_path / "two")[name], table, rtol=1e-9, atol=2e-9)
    one, two = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("one", "two"))
    assert two["sigma0"] == pytest.approx(one["sigma0"], rel=1e-10)
    looks = [{(r["point"], r["strip"], r["ccd"]): r["w"] for r in result["rejected"]} for result in (one, two)]
    assert looks[0] and looks[1] == pytest.approx(looks[0], rel=1e-9)
    assert two["strips"].keys() == one["strips"].keys()
    assert not list(tmp_path.glob("triline-*"))


def test_robust_estimation_goes_in_partitions(folder, tmp_path):
    assert adjust(folder, "--robust", "danish", "-o", tmp_path / "one") == 0
    assert adjust(folder, "--robust", "danish", "-o", tmp_path / "two", "--workers", 1, "--partition-rays", 300) == 0
    one, two = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("one", "two"))
    assert two["sigma0"] == pytest.approx(one["sigma0"], rel=1e-6)


def split(folder, tmp_path, strips):
    """A block folder with the image points of some strips alone."""
    part = tmp_path / f"part-{strips[0]}"
    shutil.copytree(folder, part)
    for name in ("strips.csv", "trajectory.csv", "image_points.csv"):
        table = pd.read_csv(part / name)
        table[table["strip"].isin(strips)].to_csv(part / name, index=False)
    return part


def test_two_recordings_are_adjusted_as_one(folder, tmp_path, capsys):
    """Written as recordings of two days."""
    parts = [split(folder, tmp_path, strips) for strips in (["S1"], ["S2", "C1"])]
    days = []
    for i, part in enumerate(parts):
        messages = block_messages(read_input(part))
        days.append(write_recording(tmp_path / f"day{i + 1}.mcap", messages))
    whole = write_recording(tmp_path / "whole.mcap", block_messages(read_input(folder)))
    assert adjust(whole, "-o", tmp_path / "one") == 0
    capsys.readouterr()
    assert adjust(*days, "-o", tmp_path / "two") == 0
    said = capsys.readouterr().out
    assert "2 recordings as one block: day1 (1 strips" in said
    assert "known points that more than one of them measured" in said
    one, two = (tables(tmp_path / name)["points.csv"].set_index("point") for name in ("one", "two"))
    assert set(one.index) == set(two.index)
    axes = [name for name in one.columns if name[:1] in "XYZ" and name.endswith("_m") and "sigma" not in name]
    assert len(axes) == 3
    np.testing.assert_allclose(two.loc[one.index, axes], one[axes], atol=1e-6)
    sigma = [name for name in one.columns if name.startswith("sigma")]
    np.testing.assert_allclose(two.loc[one.index, sigma], one[sigma], rtol=1e-6)


def test_coordinates_that_were_refused_in_one_recording_do_not_count_in_the_block(folder, tmp_path):
    """The other recording states the same coordinates."""
    days = []
    for i, strips in enumerate((["S1"], ["S2", "C1"])):
        messages = list(block_messages(read_input(split(folder, tmp_path, strips))))
        if not i:
            said = m.Verdict(point="P0", accepted=False)
            messages.append(Message("observation/verdict", messages[-1].stamp_ns, said))
        days.append(write_recording(tmp_path / f"day{i + 1}.mcap", messages))
    for name, paths in (("one", days), ("two", days[::-1])):
        assert adjust(*paths, "-o", tmp_path / name) == 0
        result = json.loads((tmp_path / name / "result.json").read_text())
        points = tables(tmp_path / name)["points.csv"].set_index("point")
        assert result["control"]["n"] == 4 and points.role["P0"] == "tie"
        assert any("P0: its coordinates do not count" in note for note in result["notes"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "0"], "--workers 0, wanted 1 at least"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "wanted one of them"),
        (["--scratch", "x"], "--scratch goes with --workers or --scheduler"),
        (["--partition-rays", "3000"], "--partition-rays goes with --workers or --scheduler"),
        (["--model", "ppm", "--segments", "0"], "--segments 0, wanted 1 at least"),
        (["--model", "lim", "--fixes", "0"], "--fixes 0, wanted 4 at least"),
        (["--workers", "1", "--partition-rays", "3"], "--partition-rays 3, wanted 100 at least"),
        (["--workers", "1", "--then", "lim"], "adjusted without a second model (--then)"),
        (["--workers", "1", "--selfcal", "tls18"], "(--keep all goes)"),
    ],
)
def test_what_does_not_go_is_one_line(folder, capsys, words, said):
    assert adjust(folder, *words) == 1
    assert said in capsys.readouterr().err


def test_a_recording_given_twice(folder, capsys):
    assert adjust(folder, folder) == 1
    assert "a recording is given twice" in capsys.readouterr().err
