"""The simulated testfields and the studies about them, on few seeds."""

import json

import numpy as np
import pytest

from triline.nodes.cli import main
from triline.solver.simulation.consistency import MODELS, consistency
from triline.solver.simulation.testfield_study import choose_control, study
from triline.solver.simulation.testfields import TESTFIELDS


@pytest.mark.study
def test_every_configuration_runs_and_finds_the_image_noise_that_was_put_in():
    for key, make in TESTFIELDS.items():
        field = make()
        assert field.key == key and field.configurations
        for row in study((field,), 1):
            assert np.isfinite([row.rmse_xy, row.rmse_z, row.sigma_xy, row.sigma_z]).all(), row.configuration.label
            low, high = row.configuration.published.sigma0_px
            if np.isfinite(low):
                assert 0.8 * low < row.sigma0_px < 1.1 * high, (key, row.configuration.label)


@pytest.mark.study
def test_additional_parameters_take_out_the_camera_errors_that_were_put_in():
    """They spoil DGR, and direct georeferencing more so."""
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
    assert tuple(grid[choose_control(grid, 1)[0]]) == (5.0, 5.0)


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
    assert main(["study", "testfields", "--seeds", "1", "--only", "pavia4000", "-q"]) == 0
    out = capsys.readouterr().out
    assert out.count("ADS40 Pavia, 4000 m") == 2 and "1.790" in out and "RMSE / sigma" in out and "Unsaid:" in out
    assert main(["study", "testfields", "--seeds", "1", "--only", "pavia4000", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    direct, calibrated = plain["rows"]
    assert direct["published"]["rmse_z_m"] == 1.79 and calibrated["reason"]
    assert plain["networks"][0]["published"] == direct["published"]


def test_command_prints_sigmas_alone_of_scenes(capsys):
    assert main(["study", "testfields", "--seeds", "1", "--only", "zurich", "hrs", "--sigmas", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["rows"] == [] and [row["testfield"] for row in plain["networks"]] == ["hrs", *["zurich"] * 5]
    two = plain["networks"][2]
    assert (two["control"], two["check"], two["published"]["rmse_xy_m"]) == (2, 97, 1.6)
    assert two["published_rmse_over_sigma"][0] == pytest.approx(1.6 / two["sigma_xy_m"])


def test_command_refuses_unknown_testfields(capsys):
    assert main(["study", "testfields", "--only", "atlantis"]) == 1
    assert "no such testfield" in capsys.readouterr().err
    assert main(["study", "consistency", "--seeds", "0"]) == 1
    assert "wanted 1 at least" in capsys.readouterr().err


def test_study_without_a_name_is_a_usage_error():
    with pytest.raises(SystemExit) as stop:
        main(["study"])
    assert stop.value.code == 2
