"""``triline study rectification`` and ``regularisation``: what they show, and bad input."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from triline.nodes.cli import main, study_regularisation
from triline.solver.rectification.comparison import (
    Noise,
    bilsat_camera,
    compare,
    resection,
    scene_points,
)
from triline.solver.rectification.nine_pixels import conditions, design, iterations, outcomes, prior_sigmas

FAST = ("affine", "projective", "polynomial 2", "differential")


def test_relief_is_what_transforms_cannot_follow():
    level = compare(FAST, 25, 60, 0.0, Noise(), 2)
    relief = compare(FAST, 25, 60, 1000.0, Noise(), 2)
    size = {name: float(np.hypot(*got.rmse_m)) for name, got in relief.items()}
    assert all(size[name] > 2.5 * size["differential"] for name in FAST[:3])
    # half a metre a metre of slope and 0.3 px of 27.6 m
    assert size["differential"] < 17.0 and np.hypot(*level["differential"].rmse_m) < 17.0
    assert np.hypot(*level["projective"].rmse_m) < 25.0 < np.hypot(*level["affine"].rmse_m)


@pytest.mark.parametrize("off", [1.0, 3.0])
def test_a_start_that_is_far_off_and_blunders_in_the_control(off):
    camera, rng = bilsat_camera(), np.random.default_rng(3)
    noise = Noise(0.3, 0.0, 0.0, 0.12)
    points = scene_points(camera, 25, 1000.0, noise, rng)
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(np.radians(0.1 * off) * np.array([1.0, -1.0, 1.0])).as_matrix() @ camera.R_ec
    start = camera.with_orientation(camera.position_e + 1000.0 * off * np.array([1.0, -0.5, 0.3]), R)
    found = resection(start, points, 0.3)
    assert found.converged and found.rejected[:3].all() and found.rejected.sum() <= 4
    assert 0.6 < found.sigma0 < 1.4
    u, v = np.array([100.0, 1000.0, 1900.0]), np.array([1900.0, 1000.0, 50.0])
    moved = found.camera.inverse(*camera.direct(u, v, np.full(3, 800.0)).T, 50.0) - np.stack([u, v], axis=1)
    assert np.abs(moved).max() < 0.6


def test_an_orientation_that_most_points_contradict_is_none():
    camera, rng = bilsat_camera(), np.random.default_rng(3)
    points = scene_points(camera, 25, 1000.0, Noise(0.3, 0.0, 0.0, 0.8), rng)
    assert not resection(camera, points, 0.3).converged


def test_too_few_points_are_told():
    camera = bilsat_camera()
    points = scene_points(camera, 2, 0.0, Noise(), np.random.default_rng(1))
    with pytest.raises(ValueError, match="2 control points, wanted at least 3"):
        resection(camera, points, 0.3)
    failed = compare(("rpc", "projective", "differential"), 3, 5, 0.0, Noise(), 1)
    assert failed["rpc"].failed == failed["projective"].failed == 1 and failed["differential"].failed == 0


def test_study_of_methods_writes_table_and_picture(tmp_path, capsys):
    csv, plot, page = tmp_path / "c.csv", tmp_path / "c.png", tmp_path / "c.html"
    args = ["--control", "9", "--check", "20", "--seeds", "1", "--csv", str(csv), "--plot", str(plot)]
    args += ["--page", str(page)]
    assert main(["study", "rectification", *args]) == 0
    out = capsys.readouterr().out
    assert "differential" in out and "too few points" in out  # nine points are no RPC
    table = pd.read_csv(csv)
    assert len(table) == 3 * 9 and table["rmse_east_m"].notna().sum() >= 3 * 7
    assert plot.read_bytes().startswith(b"\x89PNG")
    text = page.read_text()
    assert text.count("<svg") == 1 and "too few points" in text and "9 control points, 20 check points" in text
    assert "src=" not in text and 'href="http' not in text  # one file
    level = table[(table["scene"] == "level ground") & (table["method"] == "differential")].iloc[0]
    assert f"<td>{level['rmse_east_m']:.1f} {level['rmse_north_m']:7.1f}</td>" in text
    assert main(["study", "rectification", "--control", "2"]) == 1
    assert "--control: wanted at least 3" in capsys.readouterr().err


def test_nine_pixels_determine_less_than_there_are_parameters():
    for parameters in (14, 12):
        narrow, wide = conditions(parameters, "narrow"), conditions(parameters, "wide")
        # wide geometry helps, and knowledge beforehand makes geometry matter little, as published
        if parameters == 12:  # of the 14, two are a sum of others
            assert narrow.before > 1e3 * wide.before
        assert narrow.rank <= wide.rank < 14
        assert narrow.after < 1e-6 * narrow.before and wide.after < 1e-3 * wide.before
        assert 0.1 < narrow.after / wide.after < 10.0


def test_derivatives_by_the_camera_are_those_of_the_position():
    """A camera that moves east, where it is, moves the ground by as much."""
    line, sample = np.array([1000.0, 200.0]), np.array([1000.0, 1700.0])
    A = design(12, line, sample)
    assert A.shape == (4, 12) and np.isfinite(A).all() and (prior_sigmas(12) > 0).all()
    by_lon = A[:2, 11]
    assert by_lon == pytest.approx((6.387e6 + 686e3) * np.cos(np.radians(39.9)), rel=0.01)


def test_with_knowledge_beforehand_the_error_is_smaller():
    found = outcomes(14, "narrow", 20, np.random.default_rng(1))
    fictitious, plain = found["fictitious observations"], found["least squares"]
    assert fictitious.error_m < 0.01 * plain.error_m
    total = np.hypot(fictitious.bias_m, fictitious.noise_m)
    assert 0.5 * total < fictitious.error_m < 1.5 * total  # as large as it is expected to be
    assert fictitious.effective < 5.0


def test_with_knowledge_beforehand_the_camera_is_found_in_few_steps():
    for parameters, where in ((14, "narrow"), (12, "wide")):
        before, after = iterations(parameters, where, np.random.default_rng(1))
        assert after is not None and after <= 6 and (before is None or before > after)


def test_study_of_regularisation_prints_the_published_table(tmp_path, capsys, monkeypatch):
    plot, steps = tmp_path / "l.png", {}

    def once(parameters, where, rng):  # the same in both runs, and most of their time
        if (parameters, where) not in steps:
            steps[parameters, where] = iterations(parameters, where, rng)
        return steps[parameters, where]

    monkeypatch.setattr(study_regularisation, "iterations", once)
    assert main(["study", "regularisation", "--draws", "3", "--plot", str(plot)]) == 0
    out = capsys.readouterr().out
    assert "6.3e+38" in out and "2.8e+10" in out and "Tikhonov, L-curve" in out
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert main(["study", "regularisation", "--draws", "2", "--json"]) == 0
    text = capsys.readouterr().out
    sets = json.loads(text)["sets"]
    assert "NaN" not in text and "Infinity" not in text  # what other readers of JSON refuse; least squares has no alpha
    assert sets[0]["ways"]["least squares"]["alpha"] is None
    assert len(sets) == 4 and set(sets[0]["ways"]) == {
        "least squares", "fictitious observations", "Tikhonov, cross-validation", "Tikhonov, L-curve",
        "truncated, cross-validation",
    }  # fmt: skip


@pytest.mark.parametrize("option", ["--seed", "--draws"])
def test_draws_and_seeds_that_cannot_be(option, capsys):
    assert main(["study", "regularisation", option, "-1"]) == 1
    assert capsys.readouterr().err.startswith(f"triline study: {option} -1: wanted at least ")
