"""The tutorial docs/satellite-pair.md: every command of it, one after the other, and the results that it prints."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd

from triline.nodes.cli import main

PAGE = Path(__file__).parents[3] / "docs" / "satellite-pair.md"


def test_the_tutorial(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    steps = re.findall(
        r"^    ((?:triline|printf|mkdir|cp|sed) .*)$|^((?:sigma0|best:|\d+ others) .*)$", text, flags=re.MULTILINE
    )
    assert sum(command.startswith("triline") for command, _ in steps) == 10
    printed = ""
    for command, shown in steps:
        if shown:  # what the page shows is what the command before it printed
            assert shown in printed
        elif command.startswith("triline "):
            assert main(shlex.split(command)[1:]) == 0, command
            printed = capsys.readouterr().out
        else:
            subprocess.run(command, shell=True, check=True)
    for path in re.findall(r"^    ((?:pair|result)/\S+)", text, flags=re.MULTILINE):
        assert (tmp_path / path).exists(), path
    before, after = pd.read_csv("ground.csv"), pd.read_csv("refined.csv")
    moved = 111_000.0 * np.hypot(before["lon_deg"] - after["lon_deg"], before["lat_deg"] - after["lat_deg"])
    assert 20.0 < moved.max() < 2000.0
    for folder in ("result", "ppm", "lens", "mixed/result"):
        result = json.loads(Path(folder, "result.json").read_text())
        check = result["check"]
        assert result["converged"] and result["sigma0"] < 1.3 and check["n"] >= 24, folder
        assert (np.array(check["rmse_m"]) < 2.0 * np.array(check["sigma_m"])).all(), folder
    assert json.loads(Path("mixed/result/result.json").read_text())["images"] == {
        "forward": "rpc",
        "backward/B": "rigorous",
    }
