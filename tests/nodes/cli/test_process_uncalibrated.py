"""A block of another program whose camera has never been calibrated, 29 px off at the edge, on line and in batch.

Before, points were 4 m off in height with sigmas of centimetres, and nothing said why.
"""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from places import BLOCKS, needs_blocks

from triline.nodes.cli import main
from triline.nodes.recording.access import Recording


@needs_blocks
def test_the_batch_says_what_is_wrong_and_finds_it(tmp_path, capsys):
    plain, asked = (["adjust", str(BLOCKS / "selfcal"), "-q", "-o", str(tmp_path / n)] for n in ("plain", "asked"))
    assert main(plain) == 0 and "--variance-components asks which" in capsys.readouterr().out
    assert main([*asked, "--variance-components"]) == 0
    out = capsys.readouterr().out
    assert "sigma of clock: a-priori kept, nothing contradicts it" in out
    result = json.loads((tmp_path / "asked" / "result.json").read_text())
    calibration = result["variance_components"]["calibration"]
    assert calibration["estimated"] and calibration["sigma_factor"] > 50.0
    assert result["sigma0"] == pytest.approx(1.0, abs=0.03)
    truth = json.loads((BLOCKS / "selfcal" / "truth.json").read_text())["points"]
    points = pd.read_csv(tmp_path / "asked" / "points.csv")
    error = points[["X_m", "Y_m", "Z_m"]].to_numpy() - [truth[name] for name in points["point"]]
    assert (np.sqrt((error**2).mean(axis=0)) < (0.04, 0.04, 0.08)).all()
    assert 0.6 < np.mean((error / points[["sigma_X_m", "sigma_Y_m", "sigma_Z_m"]].to_numpy()) ** 2) < 1.6


@needs_blocks
def test_parameters_without_weight_keep_the_other_unknowns(capsys):
    """``--free`` took away camera and clock without a word, and points were a metre off with sigma0 1.00."""
    assert main(["adjust", str(BLOCKS / "selfcal"), "-q", "--variance-components", "--free"]) == 0
    out = capsys.readouterr().out
    assert "self-calibration calibrated" in out and "clock:" in out and "sigma of calibration" not in out
    assert main(["adjust", str(BLOCKS / "dgr"), "-q", "--free"]) == 1
    assert "--free goes with additional parameters, wanted --selfcal" in capsys.readouterr().err


@needs_blocks
def test_a_camera_that_was_never_calibrated(tmp_path):
    """The two strips side by side, of four."""
    folder, flight, done = tmp_path / "two", tmp_path / "flight.mcap", tmp_path / "done.mcap"
    shutil.copytree(BLOCKS / "selfcal", folder, copy_function=shutil.copyfile)
    for name in ("strips.csv", "trajectory.csv", "image_points.csv"):
        table = pd.read_csv(folder / name, dtype=str)
        table[table["strip"].isin(["S1", "S2"])].to_csv(folder / name, index=False)
    assert main(["import", str(folder), "-o", str(flight), "-q"]) == 0
    assert main(["process", str(flight), "-o", str(done), "-q"]) == 0
    truth = json.loads((BLOCKS / "selfcal" / "truth.json").read_text())["points"]
    recording = Recording(done)
    whole = {m.body.point: m.body for m in recording.messages("point/object") if m.body.status == m.body.WHOLE}
    assert len(whole) > 0.95 * len(truth)
    error = np.array([[p.x, p.y, p.z] for p in whole.values()]) - [truth[name] for name in whole]
    assert (np.sqrt((error**2).mean(axis=0)) < (0.04, 0.05, 0.1)).all()
    C = np.array([p.covariance for p in whole.values()]).reshape(-1, 3, 3)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(C, error[:, :, None])[:, :, 0]) / 3.0
    assert 0.6 < nees.mean() < 1.6
    texts = [m.body.message for m in recording.messages("event/log")]
    assert any(text.startswith("camera: looks are off its calibration by") for text in texts)
    light = list(recording.messages("adjustment/report"))[-1].body
    assert light.light == "weak" and "the camera is calibrated" in light.light_reason
