"""The golden recording through the real nodes gives what it gave before, to 1 mm and 1 urad."""

import importlib.util

import numpy as np
import pandas as pd
from places import ROOT

_spec = importlib.util.spec_from_file_location("golden", ROOT / "recordings" / "golden.py")
golden = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(golden)


def test_process_gives_what_it_gave():
    expected = pd.read_csv(golden.EXPECTED, dtype={"name": str})
    now = golden.results(golden.FLIGHT)
    assert list(now.name) == list(expected.name), "other times or points came out"
    for columns, tolerance, unit in ((["x", "y", "z"], 1e-3, "m"), (["omega", "phi", "kappa"], 1e-6, "rad")):
        difference = np.abs(now[columns].to_numpy() - expected[columns].to_numpy())
        row, column = np.unravel_index(difference.argmax(), difference.shape)
        where = f"{now.kind[row]} {now.name[row]} {columns[column]}"
        assert difference.max() < tolerance, f"{where} differs by {difference.max():.2g} {unit}"
