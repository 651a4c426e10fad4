"""Real pixels: two Pleiades looks at Mont Ventoux, tied by `triline match`, oriented by RPC and affine correction."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from places import DATA, needs_data

from triline.nodes.cli import main

PIXELS = DATA / "satellites" / "phr_ventoux"


def block(folder: Path) -> Path:
    """The two looks, each corrected by shift and slopes."""
    text = "[rpc]\nshift_sigma_px = 50\nslope_sigma_px = 50\n"
    for side in ("left", "right"):
        text += f'[scenes.{side}]\nmetadata = "{PIXELS / side}_image.geom"\nimage = "{PIXELS / side}_image.tif"\n'
    (folder / "project.toml").write_text(text)
    return folder


def summary(folder: Path, capsys: pytest.CaptureFixture, *more: str) -> dict[str, float]:
    """What `match` and `adjust` of the folder tell: misfits and residuals in pixels of both images together."""
    assert main(["match", str(folder), "--json", *more]) == 0
    matched = json.loads(capsys.readouterr().out)
    assert main(["adjust", str(folder), "--snoop", "-o", str(folder / "result"), "--json"]) == 0
    adjusted = json.loads(capsys.readouterr().out)
    tables = {}
    for name in ("residuals", "points"):
        with open(folder / "result" / f"{name}.csv", newline="") as file:
            tables[name] = list(csv.DictReader(file))
    kept = [row for row in tables["residuals"] if row["rejected"] == "0"]
    v = np.array([[float(row["v_line_px"]), float(row["v_sample_px"])] for row in kept])
    height = [float(row["Z_m"]) for row in tables["points"] if row["Z_m"]]
    return {
        "points": matched["points"],
        "left_out": len(tables["residuals"]) - len(kept),
        "sigma0": adjusted["sigma0"],
        "rpc_rms": matched["pairs"][0]["misfit_px"] / np.sqrt(2.0),
        "rms": float(np.sqrt(2.0 * np.mean(np.sum(v**2, axis=1)))),
        "lowest": float(np.percentile(height, 5)),
        "highest": float(np.percentile(height, 95)),
    }


@needs_data
@pytest.mark.parametrize("heights", ["of the RPC", "of a raster"])
def test_tie_points_of_real_texture_orient_two_looks(tmp_path, capsys, heights):
    more = ("--dem", str(PIXELS / "N44E005.hgt"), "--dem-datum", "50.5") if heights == "of a raster" else ()
    found = summary(block(tmp_path), capsys, *more)
    assert found["points"] > 150
    assert found["rms"] < 0.2 and found["rpc_rms"] > 2.0
    assert found["left_out"] < 0.1 * found["points"]
    assert 0.8 < found["sigma0"] < 1.25
    assert 450.0 < found["lowest"] < found["highest"] < 620.0  # as the SRTM has it
