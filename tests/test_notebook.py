"""The notebook in docs/ runs as it stands, on a recording made the way it says."""

import json
import subprocess
import sys

from places import ROOT

NOTEBOOK = ROOT / "docs/recordings.ipynb"


def test_every_cell_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flight = NOTEBOOK.parents[1] / "recordings/strip.mcap"
    command = [sys.executable, "-m", "triline.nodes.cli", "process", str(flight), "-o", "processed.mcap", "-q"]
    subprocess.run(command, check=True, capture_output=True, timeout=900)
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    names: dict = {}
    for cell in cells:
        exec("".join(cell["source"]), names)
    assert len(names["final"].time_ns) == len(names["sigma"]) > 100
    assert "RMSE, m" in capsys.readouterr().out
