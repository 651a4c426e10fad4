"""What ``triline adjust`` says of its result: sigmas, what to expect of check points, thinned pictures, damage."""

from types import SimpleNamespace as Names

import numpy as np
import pandas as pd
import pytest
from full_disk import files_of_at_most
from matplotlib.quiver import Quiver
from places import BLOCKS, needs_blocks
from test_adjust_command import adjust, result_in, write_block

from triline.nodes.cli import main
from triline.nodes.cli.adjust import adjust_block, read_input
from triline.nodes.report import adjustment_plots
from triline.solver.adjustment.job import Job
from triline.solver.models import MODELS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("adjust") / "block"
    write_block(path)
    return path


def test_every_number_of_a_strip_has_its_sigma(folder, tmp_path, capsys):
    code, out, _ = adjust(folder, "-o", tmp_path, capsys=capsys)
    strip = result_in(tmp_path)["strips"]["S1"]
    assert code == 0
    for key, name, digits in (("offset_m", "offset", 4), ("shift_deg", "shift", 5), ("drift_deg", "drift", 5)):
        line = next(line for line in out.splitlines() if line.startswith(f"  {name}"))
        wanted = [f"{v:.{digits}f} +- {s:.{digits}f}" for v, s in zip(strip[key], strip[f"{key}_sigma"], strict=True)]
        assert all(text in line for text in wanted) and len(line) <= 100


def test_expected_rmse_of_check_points_holds_the_survey(tmp_path, capsys):
    ratios = []
    for seed in range(4):
        block = tmp_path / f"block{seed}"
        write_block(block, points=60, check=40, seed=seed)
        points = pd.read_csv(block / "ground_points.csv")
        given = points["role"] == "check"
        rng = np.random.default_rng(100 + seed)
        for axis in "XYZ":  # a survey much worse than the adjustment
            points.loc[given, f"{axis}_m"] += rng.normal(0.0, 0.8, np.count_nonzero(given))
            points.loc[given, f"sigma_{axis}_m"] = 0.8
        points.to_csv(block / "ground_points.csv", index=False)
        code, out, _ = adjust(block, "-o", tmp_path / "out", capsys=capsys)
        check = result_in(tmp_path / "out")["check"]
        assert code == 0 and "RMSE to be expected" in out
        np.testing.assert_allclose(check["expected_m"], np.hypot(check["sigma_m"], 0.8), rtol=1e-6)
        ratios.append(np.divide(check["rmse_m"], check["expected_m"]))
        assert np.all(np.divide(check["rmse_m"], check["sigma_m"]) > 1.3)  # what the reader was left to believe
    # 12 RMSE of about 40 differences each
    assert 0.9 < np.sqrt(np.mean(np.square(ratios))) < 1.1


def test_control_takes_part_and_differs_by_less(folder, tmp_path):
    ratios = []
    for seed in range(4):
        block = tmp_path / f"block{seed}"
        write_block(block, points=60, control=20, seed=seed)
        assert adjust(block, "-o", tmp_path / "out") == 0
        control = result_in(tmp_path / "out")["control"]
        ratios.append(np.divide(control["rmse_m"], control["expected_m"]))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.3


@needs_blocks
def test_control_whose_sigma_was_estimated_differs_by_that(tmp_path):
    assert adjust(BLOCKS / "selfcal", "--variance-components", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    found, control = result["variance_components"]["control"], result["control"]
    assert found["estimated"] and found["sigma_factor"] > 1.1
    ratio = np.divide(control["rmse_m"], control["expected_m"])
    assert ((ratio > 0.7) & (ratio < 1.3)).all()  # 9 differences each


def test_a_result_without_pictures_leaves_none_of_an_earlier_one(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert adjust(folder, "--plots", "-o", tmp_path) == 0
    assert (tmp_path / "residuals.png").exists()
    assert adjust(folder, "-o", tmp_path) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"notes.txt", "result.json", "points.csv", "residuals.csv", "trajectory_refined.csv"}


def test_a_full_disk_leaves_the_result_of_the_earlier_run(folder, tmp_path, capsys):
    assert adjust(folder, "--per-line", "--plots", "-o", tmp_path) == 0
    old = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("trajectory_refined.csv", "orientation_lines.csv"):
        with files_of_at_most(len(old[name]) - 1):
            code, _, err = adjust(folder, "--per-line", "-o", tmp_path, capsys=capsys)
        told = f"triline adjust: {tmp_path / name}: cannot be written: file too large"
        assert code == 1 and err.splitlines()[-1] == told
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == old


def test_residuals_are_thinned_and_say_so(tmp_path, monkeypatch):
    write_block(tmp_path / "block", points=500)
    block = read_input(tmp_path / "block")
    adjustment = adjust_block(block, Job(MODELS["dgr"].from_settings({})))
    figure = adjustment_plots.draw_residuals(adjustment)
    arrows = [c for axis in figure.axes for c in axis.collections if isinstance(c, Quiver)]
    assert len(arrows) == len(block.camera.lines) * len(block.strips)
    for axis, quiver in zip(figure.axes, arrows, strict=True):
        total = int(axis.get_title().rsplit(" of ", 1)[1])
        every = int(axis.get_title().rsplit("1 in ", 1)[1].split()[0])
        assert 75 < np.size(quiver.U) == -(-total // every) <= adjustment_plots.MOST_ARROWS and every > 1
    monkeypatch.setattr(adjustment_plots, "MOST_COLUMNS", 2)  # of nine CCD lines the picture was 4 300 pixels wide
    shown = [axis.axison for axis in adjustment_plots.draw_residuals(adjustment).axes]
    assert shown == [True, True, True, False] * len(block.strips)
    rays = adjustment.result.network.rays
    rays.ccd[:] = rays.strip % 3  # as of scenes: 72 of 81 frames of MISR were empty, with "rms nan, nan px"
    scenes = adjustment_plots.draw_residuals(adjustment).axes
    assert len(scenes) == len(block.strips) and not any("nan" in axis.get_title() for axis in scenes)


@pytest.mark.parametrize("name", ["S", "strip_over_the_valley_of_the_north_"])
def test_the_legend_of_many_strips_hides_nothing(monkeypatch, name):
    sets = [Names(number=k, model=Names(extent=Names(start_s=0.0, end_s=10.0 + k))) for k in range(24)]
    monkeypatch.setattr(adjustment_plots, "set_name", lambda _, item: f"{name}{item.number}")
    curves = np.zeros((400, 6)), np.tile(np.eye(6), (400, 1, 1))
    monkeypatch.setattr(adjustment_plots, "correction_functions", lambda *_: curves)
    figure = adjustment_plots.draw_corrections(Names(result=Names(solution=Names(layout=Names(sets=sets)))))
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 24
    assert all(legend.get_window_extent().y1 <= axis.get_tightbbox().y0 for axis in figure.axes)
    assert legend.get_window_extent().x0 >= 0.0 and legend.get_window_extent().x1 <= figure.bbox.x1
    looks = {(line.get_color(), str(line._dash_pattern)) for line in legend.get_lines()}
    assert len(looks) == 24, "no two strips look alike"


def test_a_damaged_recording_is_said_to_be_damaged(folder, tmp_path, capsys):
    recording = tmp_path / "block.mcap"
    assert main(["import", str(folder), "-o", str(recording), "-q"]) == 0
    recording.write_bytes(recording.read_bytes()[:-40])
    capsys.readouterr()
    code, out, _ = adjust(recording, "-o", tmp_path / "out", capsys=capsys)
    assert code == 0 and "note: recording: the file ends inside a record" in out
    assert "recording: the file ends" in result_in(tmp_path / "out")["notes"][0]
