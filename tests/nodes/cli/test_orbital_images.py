"""Image lines from orbit: two lenses minutes apart, adjusted on line, rectified to the same picture."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio

from triline.nodes.cli import main


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orbit")
    made, out = folder / "pair.mcap", folder / "out.mcap"
    assert main(["simulate", "-q", "-o", str(made), "--satellite", "spot5-hrs-small", "--images", "--seed", "2"]) == 0
    (folder / "dgr.toml").write_text('[adjuster]\nmodel = "dgr"\n')
    nodes = ["--nodes", "matcher,adjuster"]
    assert main(["process", "-q", str(made), "--config", str(folder / "dgr.toml"), *nodes, "-o", str(out)]) == 0
    return out


def test_ties_between_the_lenses(processed, tmp_path):
    """The matcher's are among the adjusted points."""
    table = tmp_path / "points.csv"
    assert main(["export", str(processed), "--points", str(table)]) == 0
    names = [row.split(",")[0] for row in table.read_text().splitlines()[1:]]
    assert sum("-M" in name for name in names) > 40


def overlap(first, second):
    """The cells of two orthoimages that both have."""
    cut = []
    with rasterio.open(first) as a, rasterio.open(second) as b:
        gsd = a.transform.a
        left, right = max(a.bounds.left, b.bounds.left), min(a.bounds.right, b.bounds.right)
        bottom, top = max(a.bounds.bottom, b.bounds.bottom), min(a.bounds.top, b.bounds.top)
        for image in (a, b):
            row, column = round((image.bounds.top - top) / gsd), round((left - image.bounds.left) / gsd)
            rows, columns = round((top - bottom) / gsd), round((right - left) / gsd)
            cut.append(image.read(1)[row : row + rows, column : column + columns].astype(float))
    both = (cut[0] > 0) & (cut[1] > 0)
    return cut[0][both], cut[1][both]


def test_orthoimages_of_two_lenses_coincide(processed, tmp_path):
    """120 km of curved ground, seen 20 deg forward and backward: the same picture, and clearly less so as measured."""
    alike = {}
    for orientation in ("whole", "measured"):
        paths = [tmp_path / f"{orientation}-{ccd}.tif" for ccd in "FB"]
        for path, ccd in zip(paths, "FB", strict=True):
            arguments = ["--ccd", ccd, "--strip", f"scene/{ccd}", "--orientation", orientation, "--gsd", "400", "-q"]
            assert main(["rectify", str(processed), "-o", str(path), *arguments]) == 0
        one, other = overlap(*paths)
        assert len(one) > 25_000
        alike[orientation] = np.corrcoef(one, other)[0, 1]
    assert alike["whole"] > 0.996
    assert 1 - alike["measured"] > 4 * (1 - alike["whole"])


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["-o", "folder", "--satellite", "spot5-hrs-small", "--images"], "--images goes with a recording"),
        (["-o", "folder", "--satellite", "misr", "--compression", "none"], "--compression goes with a recording"),
        (["-o", "x.mcap", "--satellite", "spot5-hrs", "--images"], "lines of 12000 pixels, wanted at most 2000"),
        (["-o", "x.mcap", "--satellite", "eros-a1", "--overpasses", "0"], "0 overpasses, wanted 1 to 9"),
        (["-o", "x.mcap", "--satellite", "sputnik"], "satellite 'sputnik', wanted one of alos-prism"),
    ],
)
def test_bad_input(arguments, match, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments]) != 0
    error = capsys.readouterr().err
    assert match in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())
