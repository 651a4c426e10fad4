"""``triline adjust``: block folders and recordings in, result files and one-line refusals out."""

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from block_writer import write_block as write_block_folder
from places import BLOCKS, needs_blocks
from recording_file import write_recording

from triline.nodes.cli import main
from triline.nodes.cli.adjust import read_input
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.block_messages import block_messages, not_carried
from triline.nodes.recording.reader import RecordingReader
from triline.schemas.units import place_columns
from triline.solver.adjustment.block_data import network_from_block
from triline.solver.camera.self_calibration import tls
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import angles_from_matrix, matrix_from_angles, matrix_from_quaternion
from triline.solver.models.dgr import DgrOptions
from triline.solver.simulation.network import parallel_and_cross, scatter_points, simulate_network

CAMERA = preset("ads40")
AXES, ANGLES = ["X_m", "Y_m", "Z_m"], ["omega_deg", "phi_deg", "kappa_deg"]
MODEL = DgrOptions((0.1, 0.1, 0.2), (0.005, 0.005, 0.008), (0.005, 0.005, 0.008))


def write_block(folder, points=50, control=5, check=15, seed=1, parameters=None, image_sigma=0.3):
    """A simulated block as a folder; returns the simulation."""
    rng = np.random.default_rng(seed)
    ground = scatter_points(points, (-1500, 1500, -1200, 1200), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)
    lines = parallel_and_cross(CAMERA, 2000.0, 2, 1, 3000.0)
    simulated = simulate_network(
        CAMERA, lines, ground, dict.fromkeys(range(control), "control"), range(control, control + check), MODEL, rng,
        self_calibration=tls(CAMERA), camera_parameters=parameters, pose_rate_hz=50.0,
    )  # fmt: skip
    network = simulated.network
    folder.mkdir()
    camera = {
        "name": "ads40",
        "lenses": [{"id": "L1", "focal_length_mm": 62.7, "principal_point_mm": [0, 0]}],
        "lines": [
            {"id": line.id, "lens": "L1", "pixels": line.pixels, "pixel_size_mm": 0.0065,
             "center_mm": line.centre_mm.tolist(), "inclination_deg": 0.0}
            for line in CAMERA.lines
        ],
    }  # fmt: skip
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "project.toml").write_text(
        f'[project]\nname = "simulated"\n[apriori]\nimage_sigma_px = {image_sigma}\n[trajectory]\n'
        "offset_sigma_m = [0.1, 0.1, 0.2]\nshift_sigma_deg = [0.005, 0.005, 0.008]\n"
        "drift_sigma_deg = [0.005, 0.005, 0.008]\n"
    )
    strips = [(s.id, s.first_line_time_s + 1000 * i, s.line_rate_hz, s.lines) for i, s in enumerate(network.strips)]
    names = ["strip", "first_line_time_s", "line_rate_hz", "lines"]
    pd.DataFrame(strips, columns=names).to_csv(folder / "strips.csv", index=False)
    parts = []
    for i, s in enumerate(network.strips):
        t = s.trajectory
        pose = np.column_stack([t.position_l, np.degrees(angles_from_matrix(matrix_from_quaternion(t.quaternion)))])
        part = pd.DataFrame(pose, columns=["X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"])
        part.insert(0, "time_s", t.time_s + 1000 * i)
        part.insert(0, "strip", s.id)
        parts.append(part)
    pd.concat(parts).to_csv(folder / "trajectory.csv", index=False)
    given = [(network.control, "control"), (network.check, "check")]
    rows = [
        (network.point_ids[p], *xyz, *np.maximum(sigma, 1e-3), role)
        for known, role in given
        for p, xyz, sigma in zip(known.point, known.xyz_l, known.sigma_m, strict=True)
    ]
    names = ["point", "X_m", "Y_m", "Z_m", "sigma_X_m", "sigma_Y_m", "sigma_Z_m", "role"]
    pd.DataFrame(rows, columns=names).to_csv(folder / "ground_points.csv", index=False)
    r = network.rays
    image = pd.DataFrame(
        {
            "point": [network.point_ids[p] for p in r.point],
            "strip": [network.strips[s].id for s in r.strip],
            "ccd": [CAMERA.lines[k].id for k in r.ccd],
            "line": r.line,
            "sample": r.sample,
        }
    )
    image.to_csv(folder / "image_points.csv", index=False)
    return simulated


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("adjust") / "block"
    write_block(path)
    return path


def adjust(*words, capsys=None):
    """Exit code and, with capsys, what went to the two outputs."""
    code = main(["adjust", *map(str, words)])
    return (code, *capsys.readouterr()) if capsys else code


def result_in(path):
    return json.loads((path / "result.json").read_text())


@pytest.mark.parametrize("role", ["planimetric", "height"])
def test_what_is_not_given_of_control_does_not_move_what_is(tmp_path, role):
    """The vertical leans away from that of the local frame: half a kilometre of height was a decimetre of X here, and
    would be eight 10 km away."""
    write_block(tmp_path / "b")
    frame = LocalFrame(49.0, 9.0, 0.0, "EPSG:32632")
    block = replace(read_block(tmp_path / "b"), frame=frame)
    ground = block.ground
    far = int(np.argmax(np.linalg.norm(ground.xyz_l[:, :2], axis=1) * (np.array(ground.role) == "control")))
    stated = frame.to_crs(ground.xyz_l)
    stated[far] += (0.0, 0.0, -500.0) if role == "planimetric" else (300.0, -400.0, 0.0)
    roles = (*ground.role[:far], role, *ground.role[far + 1 :])
    moved = replace(block, ground=replace(ground, xyz_l=frame.from_crs(stated), role=roles))
    network = network_from_block(moved)
    k = int(np.flatnonzero(network.control.point == network.point_index[ground.id[far]])[0])
    off = network.control.xyz_l[k] - ground.xyz_l[far]
    given = np.isfinite(network.control.sigma_m[k])
    assert np.abs(moved.ground.xyz_l[far] - ground.xyz_l[far])[given].max() > 0.03
    assert np.abs(off[given]).max() < 0.01


@needs_blocks
def test_known_answer_of_an_independent_program(tmp_path, capsys):
    expected = json.loads((BLOCKS / "dgr" / "expected.json").read_text())
    code, out, _ = adjust(BLOCKS / "dgr", "--json", "-o", tmp_path, capsys=capsys)
    result = json.loads(out)
    assert code == 0 and result == result_in(tmp_path)
    # the two programs interpolate the trajectory differently, which costs 1e-4 px
    assert result["sigma0"] == pytest.approx(expected["sigma0"], abs=5e-5)
    assert (result["n_observations"], result["n_unknowns"]) == (expected["n_obs"], expected["n_unknowns"])
    for id, strip in expected["strips"].items():
        np.testing.assert_allclose(result["strips"][id]["offset_m"], strip["offset_m"], atol=1e-5)
        np.testing.assert_allclose(result["strips"][id]["shift_deg"], strip["shift_deg"], atol=1e-6)
        np.testing.assert_allclose(result["strips"][id]["drift_deg"], strip["drift_deg_per_strip"], atol=1e-6)
    points = pd.read_csv(tmp_path / "points.csv", index_col="point")
    want = np.array([expected["points_m"][id] for id in points.index])
    np.testing.assert_allclose(points[["X_m", "Y_m", "Z_m"]].to_numpy(), want, atol=1e-4)
    assert result["check"]["n"] == expected["n_check"]
    np.testing.assert_allclose(result["check"]["rmse_m"], expected["check_rmse_m"], atol=2e-5)
    np.testing.assert_allclose(result["check"]["sigma_m"], expected["check_sigma_m"], rtol=1e-4)


@needs_blocks
def test_self_calibration_brings_sigma0_to_one_and_points_to_truth(tmp_path):
    truth = json.loads((BLOCKS / "selfcal" / "truth.json").read_text())
    assert adjust(BLOCKS / "selfcal", "--selfcal", "tls18", "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    assert result["chi_square_test"]["passed"]
    points = pd.read_csv(tmp_path / "points.csv", index_col="point")
    true = np.array([truth["points"][id] for id in points.index])
    axes = ["X_m", "Y_m", "Z_m"]
    ratio = (points[axes].to_numpy() - true) / points[[f"sigma_{a}" for a in axes]].to_numpy()
    assert 0.9 < np.sqrt(np.mean(ratio**2)) < 1.1
    parameters = result["additional_parameters"]
    assert set(truth["ap"]) == {n for n, p in parameters.items() if p["status"] == "estimated"}
    for name, value in truth["ap"].items():
        assert abs(parameters[name]["value"] - value) < 3.5 * parameters[name]["sigma"], name
    gone = [p for p in parameters.values() if p["status"] == "eliminated"]
    assert len(parameters) == 18 and all(p["reason"] and p["value"] == 0 for p in gone)


def test_no_more_steps_than_asked_for(folder, tmp_path):
    assert adjust(folder, "--iterations", 1, "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    assert result["iterations"] == 1 and not result["converged"]
    assert "not converged: the figures are those of the last step" in result["notes"]


def test_result_files_have_what_the_interface_says(folder, tmp_path):
    assert adjust(folder, "--snoop", "--selfcal", "tls18", "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    wanted = "sigma0 sigma0_px n_observations n_unknowns redundancy iterations converged seconds model selfcal strips "
    wanted += "additional_parameters check control direct_georeferencing rejected"
    assert set(wanted.split()) <= set(result)
    for strip in result["strips"].values():
        for key in ("offset_m", "shift_deg", "drift_deg"):
            assert len(strip[key]) == len(strip[f"{key}_sigma"]) == 3 and min(strip[f"{key}_sigma"]) > 0
    assert set(result["strips"]) == {"S1", "S2", "C1"}
    for name, p in result["additional_parameters"].items():
        assert set(p) >= {"value", "sigma", "t", "status", "reason"} and p["status"] in ("estimated", "eliminated"), (
            name
        )
    for group in ("check", "control", "direct_georeferencing"):
        for key in ("rmse_m", "mean_m", "max_m", "sigma_m"):
            assert len(result[group][key]) == 3
    assert (result["check"]["n"], result["control"]["n"]) == (15, 5)
    assert result["redundancy"] == result["n_observations"] - result["n_unknowns"]
    points = pd.read_csv(tmp_path / "points.csv")
    columns = "point X_m Y_m Z_m sigma_X_m sigma_Y_m sigma_Z_m rays role doubtful"
    assert list(points.columns) == columns.split() and set(points.doubtful) <= {0, 1}
    assert result["doubtful_points"] == [] and points.doubtful.sum() == 0
    assert points.role.value_counts().to_dict() == {"check": 15, "control": 5, "tie": len(points) - 20}
    residuals = pd.read_csv(tmp_path / "residuals.csv")
    image = pd.read_csv(folder / "image_points.csv")
    assert len(residuals) == len(image) and (residuals.point == image.point).all()
    assert 0.2 < residuals.v_line_px.std() < 0.32 and 0.2 < residuals.v_sample_px.std() < 0.32
    refined = pd.read_csv(tmp_path / "trajectory_refined.csv")
    measured = pd.read_csv(folder / "trajectory.csv")
    assert list(refined.columns[:8]) == list(measured.columns) and len(refined) == len(measured)


def test_a_camera_stands_in_place_of_that_of_each_input(folder, tmp_path, capsys):
    """Two flights, one of which was processed with a calibrated camera: the camera that was given did not help."""
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    points = pd.read_csv(other / "image_points.csv")
    points["line"] += 0.01  # the same image points would count twice
    points.to_csv(other / "image_points.csv", index=False)
    camera = json.loads((other / "camera.json").read_text())
    camera["lenses"][0]["focal_length_mm"] += 0.01
    (other / "camera.json").write_text(json.dumps(camera))
    code, _, error = adjust(folder, other, "-q", capsys=capsys)
    assert code == 1 and "other has another camera than block" in error
    code, told, _ = adjust(folder, other, "--camera", folder / "camera.json", "-q", capsys=capsys)
    assert code == 0 and told.count(f"note: camera of {folder / 'camera.json'}") == 1


def test_refined_trajectory_is_measured_plus_correction(folder, tmp_path):
    assert adjust(folder, "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    refined, measured = (
        pd.read_csv(p).set_index("strip") for p in (tmp_path / "trajectory_refined.csv", folder / "trajectory.csv")
    )
    for id, strip in result["strips"].items():
        change = refined.loc[id, ["X_m", "Y_m", "Z_m"]].to_numpy() - measured.loc[id, ["X_m", "Y_m", "Z_m"]].to_numpy()
        np.testing.assert_allclose(change, np.tile(strip["offset_m"], (len(change), 1)), atol=2e-5)
        angles = ["omega_deg", "phi_deg", "kappa_deg"]
        turn = refined.loc[id, angles].to_numpy() - measured.loc[id, angles].to_numpy()
        turn = (turn + 180.0) % 360.0 - 180.0
        np.testing.assert_allclose(turn[0], strip["shift_deg"], atol=1e-7)
        np.testing.assert_allclose(turn[-1] - turn[0], strip["drift_deg"], atol=1e-7)
        np.testing.assert_allclose(refined.loc[id, "sigma_omega_deg"].iloc[0], strip["shift_deg_sigma"][0], atol=1e-8)


def test_adjusted_trajectory_is_better_than_the_measured_one(tmp_path):
    """Against the truth: measured = true - correction, so the estimated corrections must come near the drawn ones."""
    simulated = write_block(tmp_path / "block", seed=7)
    assert adjust(tmp_path / "block", "-q", "-o", tmp_path / "out") == 0
    for id, strip in result_in(tmp_path / "out")["strips"].items():
        true = simulated.corrections[id]
        estimate = np.concatenate([strip["offset_m"], np.radians(strip["shift_deg"]), np.radians(strip["drift_deg"])])
        sigma = np.concatenate([strip[f"{k}_sigma"] * np.array(u) for k, u in (("offset_m", 1.0),)] + [
            np.radians(strip["shift_deg_sigma"]), np.radians(strip["drift_deg_sigma"])])  # fmt: skip
        assert (np.abs(estimate - true) < 4.5 * sigma).all()


def test_recording_gives_what_the_folder_gives(folder, tmp_path):
    recording = tmp_path / "block.mcap"
    write_recording(recording, block_messages(read_input(folder)))
    for source, name in ((folder, "a"), (recording, "b")):
        assert adjust(source, "-q", "--selfcal", "tls12", "-o", tmp_path / name) == 0
    one, other = result_in(tmp_path / "a"), result_in(tmp_path / "b")
    assert other["sigma0"] == pytest.approx(one["sigma0"], abs=1e-6)
    for id, strip in one["strips"].items():
        np.testing.assert_allclose(other["strips"][id]["offset_m"], strip["offset_m"], atol=1e-5)
    np.testing.assert_allclose(other["check"]["rmse_m"], one["check"]["rmse_m"], atol=1e-5)


@pytest.mark.parametrize("variance", [0.0, -4e-4])
def test_control_without_a_variance_is_left_out_as_on_line(folder, tmp_path, variance):
    messages = list(block_messages(read_input(folder)))
    control = next(x.body for x in messages if x.topic == "observation/control" and not x.body.role)
    control.covariance[0] = variance
    recording = write_recording(tmp_path / "block.mcap", messages)
    assert adjust(recording, "-q", "-o", tmp_path / "out") == 0
    result = result_in(tmp_path / "out")
    assert result["control"]["n"] == 4
    assert f"ground point {control.point} has no usable covariance or coordinates and was left out" in result["notes"]


def test_poses_that_are_not_valid_are_told(folder, tmp_path):
    """The navigator says so where a trajectory drifts without GNSS; the adjustment cannot know."""
    lost, messages = 0, list(block_messages(read_input(folder)))
    for message in messages:
        if message.topic.startswith("trajectory/") and message.body.strip == "S1" and lost < 700:
            lost += 1
            message.body.valid, message.body.reason = False, f"no GNSS for {lost / 50:.1f} s"
    recording = write_recording(tmp_path / "lost.mcap", messages)
    assert adjust(recording, "-q", "-o", tmp_path / "out") == 0
    (note,) = (note for note in result_in(tmp_path / "out")["notes"] if "not valid" in note)
    assert note.startswith("strip S1: 700 of ") and "(no GNSS)" in note


def test_flight_is_adjusted_as_its_project_states_it(tmp_path):
    """Wander and the white noise of the poses are the project's: image points do not get the blame for either."""
    flight, smoothed = tmp_path / "flight.mcap", tmp_path / "smoothed.mcap"
    assert main(["simulate", "-o", str(flight), "--seconds", "30", "--attitude-rate", "50", "-q"]) == 0
    assert main(["process", str(flight), "-o", str(smoothed), "--nodes", "navigator", "-q"]) == 0
    assert adjust(smoothed, "-q", "-o", tmp_path / "out") == 0
    result = result_in(tmp_path / "out")
    assert result["model"] == "wander"
    assert result["sigma0"] == pytest.approx(1.0, abs=0.07)
    (strip,) = read_input(smoothed).strips
    assert strip.noise is not None and strip.noise.shape == (len(strip.trajectory), 6, 6)
    assert adjust(smoothed, "-q", "--model", "dgr", "-o", tmp_path / "dgr") == 0
    assert result_in(tmp_path / "dgr")["model"] == "dgr"
    for options, key, time in (
        (["--model", "wander"], "borders", "time_s"),
        (["--model", "lim", "--fixes", 4], "fixes", "time_s"),
        (["--model", "ppm", "--segments", 2], "segments", "start_s"),
    ):
        out = tmp_path / key
        assert adjust(smoothed, *options, "-q", "-o", out) == 0
        refined = pd.read_csv(out / "trajectory_refined.csv")["time_s"]  # UTC, seconds since 1970
        (strip,) = result_in(out)["strips"].values()
        assert strip[key][0][time] == pytest.approx(refined.iloc[0], abs=1e-5)


def test_image_points_in_a_gap_of_the_trajectory_have_no_orientation(tmp_path):
    """Six seconds without attitudes, in turbulence: an orientation across them would be off by tenths of a degree."""
    flight, gap = tmp_path / "flight.mcap", tmp_path / "gap.mcap"
    words = ["simulate", "-o", str(flight), "--seconds", "40", "--seed", "3", "--attitude-rate", "50"]
    assert main([*words, "--turbulence", "3", "-q"]) == 0
    reader = RecordingReader(flight)
    first_ns = reader.first("configuration/strip").first_line_time_ns
    begin, end = first_ns + 18 * 10**9, first_ns + 24 * 10**9
    sent = (m for m in reader.sorted_messages() if m.topic != "sensor/attitude" or not begin <= m.stamp_ns < end)
    write_recording(gap, (replace(m, sequence=i) for i, m in enumerate(sent)))
    smoothed = tmp_path / "smoothed.mcap"
    assert main(["process", str(gap), "-o", str(smoothed), "--nodes", "navigator", "-q"]) == 0
    assert adjust(smoothed, "-q", "--per-line", "-o", tmp_path / "out") == 0
    result = result_in(tmp_path / "out")
    left_out = [r for r in result["rejected"] if r["reason"] == "in a gap of the trajectory"]
    assert len(left_out) > 100 and result["sigma0"] == pytest.approx(1.0, abs=0.07)
    assert all(result["check"]["rmse_m"][k] < 2.0 * result["check"]["sigma_m"][k] for k in range(3))
    line_s = pd.read_csv(tmp_path / "out" / "orientation_lines.csv")["time_s"].to_numpy()
    assert np.diff(line_s).max() == pytest.approx(6.0, abs=0.1)


def test_what_an_inertial_filter_does_not_know_is_no_noise_of_single_poses(tmp_path):
    """Its attitudes are uncertain to tenths of a degree, and alike for long: points were 1.6, 3.2 and 5.3 m off."""
    flight, oriented = tmp_path / "flight.mcap", tmp_path / "oriented.mcap"
    words = ["--imu", "mems", "--imu-rate", "100", "--seconds", "25", "--seed", "3", "-q"]
    assert main(["simulate", "-o", str(flight), *words]) == 0
    assert main(["process", str(flight), "-o", str(oriented), "--nodes", "navigator", "-q"]) == 0
    assert adjust(oriented, "-q", "-o", tmp_path / "out") == 0
    result = result_in(tmp_path / "out")
    assert any("strip S1 begins poses are less certain than the project states" in note for note in result["notes"])
    rmse, sigma = np.array(result["check"]["rmse_m"]), np.array(result["check"]["sigma_m"])
    assert (rmse < [0.2, 0.3, 0.7]).all() and (rmse < 2.0 * sigma).all() and (sigma < 0.5).all()
    # sigmas that hold until a filter has found its attitude are no observations: residuals would be next to nothing
    assert np.sqrt(np.mean((rmse / sigma) ** 2)) < 1.3 and result["redundancy"] < result["n_image_points"]
    assert adjust(oriented, "-q", "--workers", "1", "-o", tmp_path / "parts") == 0
    parts = result_in(tmp_path / "parts")
    assert parts["redundancy"] == result["redundancy"] and parts["sigma0"] == pytest.approx(result["sigma0"], rel=1e-6)


@pytest.mark.parametrize("noise", ["t3", "normal"])
def test_heavy_tails_are_told(tmp_path, noise):
    flight = tmp_path / "flight.mcap"
    words = ["--attitude-rate", "50", *(["--true", "tie-noise=t3"] if noise == "t3" else [])]
    assert main(["simulate", "-o", str(flight), "--seconds", "40", "--ties", "10", *words, "-q"]) == 0
    assert main(["process", str(flight), "-o", str(tmp_path / "s.mcap"), "--nodes", "navigator", "-q"]) == 0
    assert adjust(tmp_path / "s.mcap", "--snoop", "-q", "-o", tmp_path / "out") == 0
    assert any("fail narrowly" in note for note in result_in(tmp_path / "out")["notes"]) == (noise == "t3")


def moved_to(folder, there, frame):
    """A block folder with its places and angles in the CRS of a frame; the trajectory."""
    shutil.copytree(folder, there)
    ground = pd.read_csv(there / "ground_points.csv")
    ground[AXES] = frame.to_crs(ground[AXES].to_numpy())
    ground.to_csv(there / "ground_points.csv", index=False)
    trajectory = pd.read_csv(there / "trajectory.csv")
    R = matrix_from_angles(*np.radians(trajectory[ANGLES].to_numpy()).T)
    places = frame.to_crs(trajectory[AXES].to_numpy())
    trajectory[ANGLES] = np.degrees(angles_from_matrix(np.swapaxes(frame.R_l_crs(places), 1, 2) @ R))
    trajectory[AXES] = places
    trajectory.to_csv(there / "trajectory.csv", index=False)
    text = (there / "project.toml").read_text()
    (there / "project.toml").write_text(text.replace("[project]", f'[project]\ncrs = "{frame.crs}"'))
    return trajectory


def test_control_that_no_image_measures_is_not_in_the_accuracy_of_control(folder, tmp_path):
    """It stays where it is given: differences of nothing made RMSE and mean of the others smaller."""
    more = shutil.copytree(folder, tmp_path / "more")
    with open(more / "ground_points.csv", "a") as file:
        file.writelines(f"U{i},{100 * i},50.0,10.0,0.02,0.02,0.02,control\n" for i in range(6))
    for source, name in ((folder, "one"), (more, "two")):
        assert adjust(source, "-q", "-o", tmp_path / name) == 0
    one, two = (result_in(tmp_path / name)["control"] for name in ("one", "two"))
    assert two["n"] == one["n"] == 5
    for key in ("rmse_m", "mean_m", "sigma_m", "expected_m"):
        np.testing.assert_allclose(two[key], one[key], rtol=1e-6)
    points = pd.read_csv(tmp_path / "two" / "points.csv", index_col="point")
    assert points.loc["U3", AXES].to_list() == [300.0, 50.0, 10.0]


def test_axes_of_a_crs_that_are_turned_are_told(folder, tmp_path):
    """South African X goes to the west: a mean difference of X in the result has the other sign in points.csv."""
    for crs, latitude, longitude, turned in (
        ("EPSG:2048", -30.0, 19.2, "-180 deg"), ("EPSG:3031", -75.0, 60.0, "+60 deg"), ("EPSG:32632", 48.0, 9.5, "")
    ):  # fmt: skip
        there = tmp_path / crs.replace(":", "")
        moved_to(folder, there, LocalFrame(latitude, longitude, 0.0, crs))
        assert adjust(there, "-q", "-o", tmp_path / f"{there.name}-out") == 0
        told = [note for note in result_in(tmp_path / f"{there.name}-out")["notes"] if "local frame" in note]
        assert len(told) == bool(turned) and all(turned in note and crs in note for note in told)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4979"])
def test_result_is_in_the_crs_of_the_project(folder, tmp_path, crs):
    """The block moved to 9 deg 30' east, 48 deg north: same adjustment, coordinates and angles in the other system."""
    there, frame = tmp_path / "there", LocalFrame(48.0, 9.5, 0.0, crs)
    trajectory = moved_to(folder, there, frame)
    for source, name in ((folder, "here"), (there, "out")):
        assert adjust(source, "-q", "-o", tmp_path / name) == 0
    one, other = result_in(tmp_path / "here"), result_in(tmp_path / "out")
    assert other["sigma0"] == pytest.approx(one["sigma0"], abs=2e-3)
    np.testing.assert_allclose(other["check"]["rmse_m"], one["check"]["rmse_m"], atol=3e-3)
    points = [pd.read_csv(tmp_path / name / "points.csv", index_col="point").sort_index() for name in ("here", "out")]
    back = frame.from_crs(points[1][list(place_columns(frame.units))].to_numpy())
    np.testing.assert_allclose(back, points[0][AXES].to_numpy(), atol=0.02)
    sigma = [f"sigma_{axis}" for axis in AXES]
    np.testing.assert_allclose(points[1][sigma].to_numpy(), points[0][sigma].to_numpy(), rtol=0.05)
    refined = pd.read_csv(tmp_path / "out" / "trajectory_refined.csv")
    turn = (refined[ANGLES].to_numpy() - trajectory[ANGLES].to_numpy() + 180) % 360 - 180
    assert np.abs(turn).max() < 0.1, "corrections are hundredths of a degree, convergence is a third"


def test_outliers_and_unusable_rays_are_rejected_by_name(folder, tmp_path):
    spoiled = tmp_path / "spoiled"
    shutil.copytree(folder, spoiled)
    image = pd.read_csv(spoiled / "image_points.csv")
    rng = np.random.default_rng(5)
    bad = rng.choice(len(image), round(0.05 * len(image)), replace=False)
    image.loc[bad, "sample"] += rng.choice([-1, 1], len(bad)) * rng.uniform(6, 40, len(bad))
    image.loc[len(image)] = [image.point[0], "S1", "Q", 100.0, 100.0]
    image.loc[len(image)] = [image.point[1], "S9", "N", 100.0, 100.0]
    image.loc[len(image)] = [image.point[2], "S1", "N", 1e7, 100.0]
    image.to_csv(spoiled / "image_points.csv", index=False)
    assert adjust(spoiled, "--snoop", "-q", "-o", tmp_path / "out") == 0
    rejected = result_in(tmp_path / "out")["rejected"]
    named = {(r["point"], r["strip"], r["ccd"]) for r in rejected}
    wanted = {(image.point[i], image.strip[i], image.ccd[i]) for i in bad}
    assert len(named & wanted) >= 0.98 * len(wanted)
    assert (image.point[0], "S1", "Q") in named and (image.point[1], "S9", "N") in named
    reasons = {r["reason"] for r in rejected}
    assert {"unknown CCD line", "unknown strip", "outside strip or trajectory"} <= reasons
    assert all(abs(r["w"]) > 3.29 for r in rejected if r["reason"] == "snooping")


@pytest.mark.parametrize(
    ("options", "key"),
    [
        (["--model", "ppm", "--segments", "2"], "segments"),
        (["--model", "lim", "--fixes", "5"], "fixes"),
        (["--model", "dgr", "--then", "lim", "--fixes", "4"], "fixes"),
        (["--model", "ppm", "--segments", "1", "--then", "ppm"], "segments"),
    ],
)
def test_models(folder, tmp_path, options, key):
    assert adjust(folder, *options, "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    assert result["converged"] and all(strip[key] for strip in result["strips"].values())
    if "--then" in options:
        assert result["then"] == options[options.index("--then") + 1]
        assert result["before"][0]["model"] == options[1]
    sigma = np.array(result["check"]["sigma_m"])
    assert (np.array(result["check"]["rmse_m"]) < 3 * sigma).all()


def test_a_second_step_keeps_what_the_first_found_of_the_clock(folder, tmp_path):
    late = shutil.copytree(folder, tmp_path / "late")
    strips = pd.read_csv(late / "strips.csv")
    strips["first_line_time_s"] += 0.02
    strips.to_csv(late / "strips.csv", index=False)
    found = []
    for name, options in (("one", ["--model", "dgr"]), ("two", ["--model", "dgr", "--then", "ppm", "--segments", "2"])):
        assert adjust(late, *options, "--clock-sigma", 0.05, "-q", "-o", tmp_path / name) == 0
        found.append(result_in(tmp_path / name)["platform"]["clock"])
    one, two = found
    assert abs(one["value"] + 0.02) < 4.0 * one["sigma"] < 0.01
    assert abs(two["value"] + 0.02) < 4.0 * two["sigma"] < 0.01


def test_factors_of_a_second_step_are_told_to_be_of_what_is_left(folder, tmp_path):
    """Shift and drift that were found already leave less than their sigma."""
    for name, options in (("one", []), ("two", ["--then", "dgr"])):
        assert adjust(folder, "--model", "dgr", *options, "--variance-components", "-q", "-o", tmp_path / name) == 0
    one, two = result_in(tmp_path / "one"), result_in(tmp_path / "two")
    factors = [r["variance_components"]["shift and drift"] for r in (one, two)]
    assert factors[0]["estimated"] and factors[1]["estimated"], factors
    assert factors[1]["sigma_factor"] < 0.8 * factors[0]["sigma_factor"]
    told = ["what the first model left" in " ".join(r["notes"]) for r in (one, two)]
    assert told == [False, True]


def test_sigmas_of_a_first_step_are_of_its_own_adjustment(folder, tmp_path):
    """A model that is too poor has a large sigma0; the one after it has not."""
    wandering = shutil.copytree(folder, tmp_path / "wandering")
    trajectory = pd.read_csv(wandering / "trajectory.csv")
    trajectory["Y_m"] += 0.5 * np.sin(trajectory["time_s"] / 5.0)
    trajectory.to_csv(wandering / "trajectory.csv", index=False)
    for name, options in (("one", []), ("two", ["--then", "lim", "--fixes", 8])):
        assert adjust(wandering, "--model", "dgr", *options, "-q", "-o", tmp_path / name) == 0
    one, two = result_in(tmp_path / "one"), result_in(tmp_path / "two")
    (before,) = two["before"]
    assert before["sigma0"] == pytest.approx(one["sigma0"]) and one["sigma0"] > 1.5 * two["sigma0"]
    for id, strip in one["strips"].items():
        np.testing.assert_allclose(before["strips"][id]["offset_m_sigma"], strip["offset_m_sigma"], rtol=1e-6)


def test_the_second_step_has_settings_of_its_own(folder, tmp_path):
    block = shutil.copytree(folder, tmp_path / "block")
    project = block / "project.toml"
    project.write_text(project.read_text() + "[trajectory.then]\noffset_sigma_m = 0.0001\nfixes = 6\nmerge = false\n")
    words = ("--model", "lim", "--fixes", "4", "--then", "lim")
    assert adjust(block, *words, "-q", "-o", tmp_path / "two") == 0
    result = result_in(tmp_path / "two")
    for strip, fixes in ((name, strip["fixes"]) for name, strip in result["strips"].items()):
        assert len(result["before"][0]["strips"][strip]["fixes"]) == 4 and len(fixes) == 6
        assert max(np.abs(fix["offset_m"]).max() for fix in fixes) < 2e-4
    assert max(np.abs(f["offset_m"]).max() for f in result["before"][0]["strips"][strip]["fixes"]) > 0.01
    again = tmp_path / "again"
    write_block_folder(again, read_input(block))
    assert read_input(again).apriori == read_input(block).apriori
    assert "project.toml: trajectory.then.offset_sigma_m, " in " ".join(not_carried(read_input(block)))
    # of the options the second step has those that only its model takes, whatever the project says
    assert adjust(block, "--model", "dgr", "--then", "lim", "--fixes", "5", "-q", "-o", tmp_path / "two") == 0
    assert {len(strip["fixes"]) for strip in result_in(tmp_path / "two")["strips"].values()} <= {4, 5}
    assert adjust(block, "-q", "-o", tmp_path / "one") == 0
    assert any("[trajectory.then]" in note for note in result_in(tmp_path / "one")["notes"])


def test_order_of_the_polynomials(folder, tmp_path):
    curved = {}
    for order in ("1", "2"):
        out = tmp_path / order
        assert adjust(folder, "--model", "ppm", "--segments", "2", "--order", order, "-q", "-o", out) == 0
        segments = [part for strip in result_in(out)["strips"].values() for part in strip["segments"]]
        curved[order] = max(np.abs(part["second_m"]).max() for part in segments)
    assert curved["1"] < 1e-6 < curved["2"]


def test_everything_at_once_with_pictures(folder, tmp_path):
    options = ["--selfcal", "tls18", "--snoop", "--robust", "igg3", "--reweight", "--variance-components", "--plots"]
    assert adjust(folder, *options, "-q", "-o", tmp_path) == 0
    result = result_in(tmp_path)
    of_trajectory = {"offset", "shift and drift", "wander of position", "wander of attitude"}
    assert set(result["variance_components"]) == {"image", "control", "clock"} | of_trajectory
    assert result["sigma0"] == pytest.approx(1.0, abs=0.03)
    for name in ("residuals.png", "points.png", "corrections.png"):
        assert (tmp_path / name).stat().st_size > 20_000


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--reweight"], False),
        (["--variance-components"], False),
        (["--reweight", "--variance-components"], True),
        (["--reweight", "--variance-components", "--selfcal", "tls18"], False),  # tested between the two
    ],
)
def test_an_image_sigma_that_is_asked_for_twice_is_told(folder, capsys, options, told):
    """The variance components begin with what it took of other groups' errors."""
    code, out, _ = adjust(folder, "-q", *options, capsys=capsys)
    assert code == 0 and ("note: --reweight beside --variance-components: " in out) is told


def test_control_that_nobody_measured_and_keys_that_nobody_knows_are_told(folder, tmp_path, capsys):
    block = tmp_path / "block"
    shutil.copytree(folder, block)
    path = block / "image_points.csv"
    control = set(pd.read_csv(block / "ground_points.csv").query("role == 'control'")["point"])
    image = pd.read_csv(path)
    image[~image["point"].isin(control - {min(control)})].to_csv(path, index=False)
    project = block / "project.toml"
    project.write_text(project.read_text().replace("[trajectory]\n", "[trajectory]\nofset_sigma_m = 0.1\n"))
    code, out, _ = adjust(block, "-q", capsys=capsys)
    assert code == 0
    assert f"note: {len(control) - 1} of {len(control)} control points are measured in no image" in out
    assert "note: project.toml: trajectory: key ofset_sigma_m is not known and was ignored" in out
    image[~image["point"].isin(control)].to_csv(path, index=False)
    code, out, _ = adjust(block, "-q", capsys=capsys)
    assert code == 0 and f"note: no control point of {len(control)} is measured in an image" in out


def test_keys_of_another_camera_that_nobody_knows_are_told(folder, tmp_path, capsys):
    """A misspelt distortion was none, without a word."""
    camera = json.loads((folder / "camera.json").read_text())
    camera["lenses"][0]["distorsion"] = {"k1": 1e-6}
    path = tmp_path / "other.json"
    path.write_text(json.dumps(camera))
    code, out, _ = adjust(folder, "-q", "--camera", str(path), capsys=capsys)
    assert code == 0 and "note: other.json: key lenses[0].distorsion is not known and was ignored" in out


def test_a_strip_without_image_points_is_told(folder, tmp_path, capsys):
    """Its orientation was in no table, without a word."""
    block = tmp_path / "block"
    shutil.copytree(folder, block)
    for name, time in (("strips", "first_line_time_s"), ("trajectory", "time_s")):
        path = block / f"{name}.csv"
        table = pd.read_csv(path)
        more = table[table["strip"] == table["strip"].iloc[0]].assign(strip="S9")
        pd.concat([table, more.assign(**{time: more[time] + 9000.0})]).to_csv(path, index=False)
    code, out, _ = adjust(block, "-q", "-o", str(tmp_path / "out"), capsys=capsys)
    assert code == 0 and "take no part, and their orientation is in no table: S9" in out
    assert "S9" not in set(pd.read_csv(tmp_path / "out" / "trajectory_refined.csv")["strip"])
    assert "take no part" not in adjust(folder, "-q", capsys=capsys)[1]


def test_check_points_that_nobody_measured_are_told(folder, tmp_path, capsys):
    """They are missing in the accuracies, and nothing else said so."""
    block = tmp_path / "block"
    shutil.copytree(folder, block)
    path = block / "image_points.csv"
    check = sorted(pd.read_csv(block / "ground_points.csv").query("role == 'check'")["point"])
    assert "check points are measured in no image" not in adjust(block, "-q", capsys=capsys)[1]
    image = pd.read_csv(path)
    image[~image["point"].isin(check[:2])].to_csv(path, index=False)
    code, out, _ = adjust(block, "-q", capsys=capsys)
    assert code == 0 and f"note: 2 of {len(check)} check points are measured in no image" in out


def test_control_that_lost_all_its_image_points_is_named(folder, tmp_path, capsys):
    """Nothing contradicts its coordinates any more, and without --snoop nobody tests them instead."""
    block = tmp_path / "block"
    shutil.copytree(folder, block)
    points = pd.read_csv(block / "ground_points.csv")
    wrong = points.query("role == 'control'").index[0]
    points.loc[wrong, "X_m"] += 40.0
    points.to_csv(block / "ground_points.csv", index=False)
    code, out, _ = adjust(block, "-q", "--robust", "igg3", capsys=capsys)
    named = points.loc[wrong, "point"]
    assert code == 0 and f"control that lost all its image points and stands as given: {named}; wrong coord" in out


def test_control_in_another_unit_is_no_matter_of_sigmas(folder, tmp_path, capsys):
    block = tmp_path / "block"
    shutil.copytree(folder, block)
    points = pd.read_csv(block / "ground_points.csv")
    points[["X_m", "Y_m", "Z_m"]] /= 0.3048
    points.to_csv(block / "ground_points.csv", index=False)
    _, out, _ = adjust(block, "-q", capsys=capsys)
    assert "a wrong unit, datum, time or camera is likelier than such errors" in out
    _, out, _ = adjust(block, "-q", "--variance-components", capsys=capsys)
    assert "times as large as stated: a wrong unit, datum, time or camera is likelier" in out


def test_summary_says_what_matters(folder, capsys):
    code, out, err = adjust(folder, "--selfcal", "tls18", "--snoop", "-v", capsys=capsys)
    assert code == 0
    for text in ("sigma0", "chi-square", "check points", "direct georeferencing", "eliminated", "reliability"):
        assert text in out
    assert "iteration 1" in err and "data snooping: round 1" in err and "removed" in err


def test_quiet_run_says_nothing_on_standard_error(folder, capsys):
    code, out, err = adjust(folder, "-q", capsys=capsys)
    assert code == 0 and err == "" and "sigma0" in out


def refusal(capsys, *words):
    code, out, err = adjust(*words, capsys=capsys)
    assert code == 1 and out == "" and "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("triline adjust:")]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    "options", [(), ("--selfcal", "none"), ("--selfcal", "calibrated"), ("--variance-components",)]
)
@pytest.mark.parametrize("keep", ["all", "significant"])
def test_keep_is_refused_where_no_parameter_is_tested(folder, capsys, options, keep):
    words = "--keep goes with additional parameters that are tested, wanted --selfcal, one of tls18, "
    assert words in refusal(capsys, folder, "--keep", keep, *options)


def test_refraction_is_taken_off(folder, tmp_path):
    """Seen through air, ground beside the flight line looks further away than it is; heights follow from that."""
    heights = []
    for words in ((), ("--refraction",), ("--refraction", "288.15", "1013.25", "0")):
        out = tmp_path / str(len(heights))
        assert adjust(folder, *words, "-q", "-o", out) == 0
        assert ("refraction taken off the image points" in result_in(out)["notes"]) == bool(words)
        with open(out / "points.csv", newline="") as file:
            heights.append(np.array([float(row["Z_m"]) for row in csv.DictReader(file)]))
    change = np.abs(heights[1] - heights[0])
    assert 1e-4 < change.max() < 0.3
    np.testing.assert_allclose(heights[2], heights[1], atol=1e-4)


def test_refusals_are_one_line(folder, tmp_path, capsys):
    assert "no such file" in refusal(capsys, tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "camera.json" in refusal(capsys, empty)
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"not a recording at all")
    assert "not an MCAP recording" in refusal(capsys, foreign)
    assert "needs a folder" in refusal(capsys, folder, "--plots")
    assert "--clock-sigma -1, wanted 0 or more, and less than 0.5 s" in refusal(capsys, folder, "--clock-sigma", "-1")
    wanted = "--lever-arm-sigma nan, wanted 0 or more, and less than 100 m"
    assert wanted in refusal(capsys, folder, "--lever-arm-sigma", "nan")
    assert "--fixes is for the model lim" in refusal(capsys, folder, "--fixes", "8")
    assert "fixes" in refusal(capsys, folder, "--model", "lim", "--fixes", "2")
    assert "segments" in refusal(capsys, folder, "--model", "ppm", "--segments", "0")
    assert "--critical" in refusal(capsys, folder, "--critical", "0")
    assert "--refraction: atmosphere: pressure_hpa 5" in refusal(capsys, folder, "--refraction", "288", "5", "0")
    occupied = tmp_path / "file"
    occupied.write_text("")
    assert "is a file" in refusal(capsys, folder, "-q", "-o", occupied)


@pytest.mark.parametrize("place", ["file", "file/below", "sealed/below"])
def test_a_folder_that_cannot_be_is_refused_before_the_work(folder, tmp_path, capsys, place, monkeypatch):
    (tmp_path / "file").write_text("")
    (tmp_path / "sealed").mkdir()
    monkeypatch.setattr(os, "access", lambda where, mode: Path(where).name != "sealed")  # root may write anywhere
    monkeypatch.setattr("triline.nodes.cli.adjust.run_job", None)
    monkeypatch.setattr("triline.nodes.cli.navigate.read_sensor_folder", None)
    assert str(tmp_path / place) in refusal(capsys, folder, "-q", "-o", tmp_path / place)
    assert main(["navigate", str(folder), "-o", str(tmp_path / place)]) == 1
    assert str(tmp_path / place) in capsys.readouterr().err
    assert not list((tmp_path / "sealed").iterdir())


@pytest.mark.parametrize("words", [("ppm", "--segments"), ("lim", "--fixes")])
def test_more_segments_than_the_rays_carry_are_refused_at_once(folder, capsys, words, monkeypatch):
    monkeypatch.setattr("triline.nodes.cli.adjust.run_job", None)
    said = refusal(capsys, folder, "--model", words[0], words[1], "100000")
    assert f"{words[1]} 100000: more than the image points carry, wanted at most" in said


def test_a_point_that_lost_most_rays_is_named_in_all_results(folder, tmp_path, capsys):
    spoiled = tmp_path / "spoiled"
    shutil.copytree(folder, spoiled)
    image = pd.read_csv(spoiled / "image_points.csv")
    ground = pd.read_csv(spoiled / "ground_points.csv")
    seen = image[image.point.isin(ground.point[ground.role == "check"])].groupby("point").size()
    name = seen.idxmax()
    rng = np.random.default_rng(3)
    bad = rng.choice(image.index[image.point == name], seen.max() // 2 + 1, replace=False)
    image.loc[bad, "line"] += rng.uniform(8, 40, len(bad))
    image.loc[bad, "sample"] += rng.choice([-1, 1], len(bad)) * rng.uniform(8, 40, len(bad))
    image.to_csv(spoiled / "image_points.csv", index=False)
    code, out, _ = adjust(spoiled, "--snoop", "-o", tmp_path / "out", capsys=capsys)
    assert code == 0 and "doubtful: 1 object points" in out and f"{name} ({len(bad)} of {seen.max()} rays out)" in out
    result = result_in(tmp_path / "out")
    assert [d["point"] for d in result["doubtful_points"]] == [name] and result["check"]["n"] == 14
    points = pd.read_csv(tmp_path / "out" / "points.csv", index_col="point")
    assert list(points.index[points.doubtful == 1]) == [name]


def test_block_without_any_usable_ray_is_refused(folder, tmp_path, capsys):
    lost = tmp_path / "lost"
    shutil.copytree(folder, lost)
    image = pd.read_csv(lost / "image_points.csv")
    image["line"] = 1e8
    image.to_csv(lost / "image_points.csv", index=False)
    assert "can be used" in refusal(capsys, lost)


def test_block_that_does_not_fit_at_all_is_refused_with_the_strip_to_blame(folder, tmp_path, capsys):
    turned = tmp_path / "turned"
    shutil.copytree(folder, turned)
    trajectory = pd.read_csv(turned / "trajectory.csv")
    trajectory.loc[trajectory.strip == "S2", "kappa_deg"] += 90.0
    trajectory.to_csv(turned / "trajectory.csv", index=False)
    message = refusal(capsys, turned, "-q")
    assert "does not converge" in message and "strip S2" in message and "--robust danish" in message
    # the image sigma becomes as large as it must be, and sigma0 is small beside it
    assert "does not converge" in refusal(capsys, turned, "-q", "--variance-components")
    assert "--robust danish" not in refusal(capsys, turned, "-q", "--robust", "danish")


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (1, "control point P0 lies 100000 m from where its rays meet; residuals are"),
        (99, "control lies 100000 m from where its rays meet (median): check its coordinate reference system"),
    ],
)
def test_control_in_another_country_is_named_where_nothing_fits(folder, tmp_path, capsys, points, said):
    far = tmp_path / "far"
    shutil.copytree(folder, far)
    ground = pd.read_csv(far / "ground_points.csv")
    ground.loc[ground[ground.role == "control"].index[:points], "X_m"] += 1e5
    ground.to_csv(far / "ground_points.csv", index=False)
    assert said in refusal(capsys, far, "-q")


def test_one_control_point_a_kilometre_off_is_left_out(folder, tmp_path):
    wrong = tmp_path / "wrong"
    shutil.copytree(folder, wrong)
    ground = pd.read_csv(wrong / "ground_points.csv")
    ground.loc[ground.role == "control", "X_m"] += [1000.0, 0.0, 0.0, 0.0, 0.0]
    ground.to_csv(wrong / "ground_points.csv", index=False)
    assert adjust(wrong, "--snoop", "-q", "-o", tmp_path / "out") == 0
    result = result_in(tmp_path / "out")
    left_out = {(r["point"], r["coordinate"]) for r in result["rejected_control"]}
    culprit = ground.point[ground.role == "control"].iloc[0]
    assert (culprit, "X") in left_out
    assert result["sigma0"] == pytest.approx(1.0, abs=0.08)
    assert max(result["check"]["rmse_m"]) < 0.3
    assert max(result["control"]["rmse_m"]) < 0.1  # of the coordinates that take part


def test_unknown_option_is_a_usage_error(folder):
    with pytest.raises(SystemExit) as stop:
        adjust(folder, "--model", "spline")
    assert stop.value.code == 2


def test_the_lever_arm_is_an_unknown_where_it_is_asked_for(folder, tmp_path):
    code = main(["adjust", str(folder), "--lever-arm-sigma", "0.05", "-o", str(tmp_path), "-q"])
    platform = json.loads((tmp_path / "result.json").read_text())["platform"]
    assert code == 0 and list(platform) == ["lever x", "lever y", "lever z"]
    for found in platform.values():  # that of the block is right
        assert found["unit"] == "m" and 0.0 < found["sigma"] < 0.0501
        assert abs(found["value"]) < 4.0 * found["sigma"]


def test_the_clock_is_an_unknown_where_it_is_asked_for(folder, tmp_path):
    code = main(["adjust", str(folder), "--clock-sigma", "0.01", "-o", str(tmp_path), "-q"])
    content = json.loads((tmp_path / "result.json").read_text())
    assert code == 0 and content["platform"]["clock"]["unit"] == "s"
    # the block's clocks agree
    assert 0.0 < content["platform"]["clock"]["sigma"] < 0.0101
    assert abs(content["platform"]["clock"]["value"]) < 4.0 * content["platform"]["clock"]["sigma"]
