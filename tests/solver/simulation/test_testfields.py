"""The simulated testfields and the studies about them, on few seeds."""

import json

import numpy as np
import pytest

from triline.nodes.cli import main
from triline.solver.simulation.consistency import MODELS, consistency
from triline.solver.simulation.testfield_study import choose_control, study
from triline.solver.simulation.testfields import TESTFIELDS


@pytest.fixture(scope="module")
def prism_rows():
    return study(tuple(TESTFIELDS[key]() for key in ("saitama", "bern", "zurich")), 5)


def test_theoretical_sigmas_of_prism_are_near_the_published_ones(prism_rows):
    """The publication's own sigmas, which do not depend on its data: same network, same weights."""
    for row in prism_rows:
        p = row.configuration.published
        assert 0.75 < row.sigma_xy / p.sigma_xy < 1.1, row.field.key
        assert 0.75 < row.sigma_z / p.sigma_z < 1.1, row.field.key


def test_errors_of_prism_are_as_large_as_their_sigmas(prism_rows):
    ratio = np.array([(row.ratio_xy, row.ratio_z) for row in prism_rows])
    assert (ratio > 0.8).all() and (ratio < 1.25).all()
    for row in prism_rows:
        assert row.sigma0_px == pytest.approx(row.configuration.published.sigma0_px[0], rel=0.06)


@pytest.mark.study
def test_every_configuration_runs_and_finds_the_published_sigma0():
    for key, make in TESTFIELDS.items():
        field = make()
        assert field.key == key and field.configurations
        for row in study((field,), 1):
            assert np.isfinite([row.rmse_xy, row.rmse_z, row.sigma_xy, row.sigma_z]).all(), row.configuration.label
            low, high = row.configuration.published.sigma0_px
            if np.isfinite(low):
                assert 0.8 * low < row.sigma0_px < 1.1 * high, (key, row.configuration.label)


@pytest.mark.study
def test_self_calibration_gains_what_the_dissertation_says():
    """Camera errors spoil DGR, more so direct georeferencing; additional parameters take them out."""
    field = TESTFIELDS["vaihingen"]()
    of = {row.configuration.label: row for row in study((field,), 2)}
    assert of["DGR SC"].rmse_xy < 0.85 * of["DGR"].rmse_xy
    assert of["DGR SC"].rmse_z < 0.85 * of["DGR"].rmse_z
    assert of["DGR SC"].ratio_xy < 1.3 < of["DGR"].ratio_xy
    assert of["direct georeferencing"].rmse_z > 3 * of["DGR"].rmse_z


def test_control_is_spread_over_the_block():
    grid = np.stack(np.meshgrid(np.arange(11.0), np.arange(11.0)), axis=-1).reshape(-1, 2)
    corners = {(0.0, 0.0), (10.0, 0.0), (0.0, 10.0), (10.0, 10.0)}
    assert {tuple(xy) for xy in grid[choose_control(grid, 4)]} == corners
    assert tuple(grid[choose_control(grid, 5)[4]]) == (5.0, 5.0)
    assert len(set(choose_control(grid, 121))) == 121
    assert len(choose_control(grid, 0)) == 0


def test_study_refuses_no_seeds():
    with pytest.raises(ValueError, match="seeds"):
        study((), 0)


@pytest.mark.parametrize(
    ("name", "calibrated"),
    [
        pytest.param(name, calibrated, marks=() if (name, calibrated) == ("DGR", True) else pytest.mark.study)
        for name in MODELS
        for calibrated in (False, True)
    ],
)
def test_blocks_with_errors_as_assumed_are_consistent(name, calibrated):
    c = consistency(MODELS[name], calibrated, 50)
    assert ((c.points > 0.95) & (c.points < 1.05)).all()
    assert (c.points_sigma > 0.005).all() and (c.points_sigma < 0.05).all()
    low, high = c.band
    assert low - 0.01 < c.orientation < high + 0.01
    assert np.isnan(c.parameters) if not calibrated else 0.9 < c.parameters < 1.1
    assert c.sigma0 == pytest.approx(1.0, abs=0.01)
    assert c.passed_band[0] <= c.passed <= c.passed_band[1]


def test_command_prints_the_table(capsys):
    assert main(["study", "testfields", "--seeds", "1", "--only", "zurich", "-q"]) == 0
    out = capsys.readouterr().out
    assert "PRISM Zurich/Winterthur" in out and "1.600" in out and "RMSE / sigma" in out
    assert main(["study", "testfields", "--seeds", "1", "--only", "zurich", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["published"]["rmse_xy_m"] == 1.6 and row["reason"]


def test_command_refuses_unknown_testfields(capsys):
    assert main(["study", "testfields", "--only", "atlantis"]) == 1
    assert "no such testfield" in capsys.readouterr().err
    assert main(["study", "consistency", "--seeds", "0"]) == 1
    assert "wanted 1 at least" in capsys.readouterr().err


def test_study_without_a_name_is_a_usage_error():
    with pytest.raises(SystemExit) as stop:
        main(["study"])
    assert stop.value.code == 2
