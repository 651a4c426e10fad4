"""Results that other programs take: calibrated camera, orientation of every line, points, heights of a raster."""

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from recording_file import write_recording
from test_adjust_command import AXES, write_block

from triline.nodes.batch.strip_orientation import OfTable
from triline.nodes.cli import main
from triline.nodes.formats.camera_json import read_camera, write_camera
from triline.nodes.formats.geotiff import Heights, write_heights
from triline.nodes.formats.sbet import read_sbet
from triline.nodes.node import Message
from triline.nodes.recording.access import Recording
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import messages as m
from triline.solver.geometry.rotation import matrix_from_angles
from triline.solver.geometry.trajectory import Trajectory

ERRORS = {"dc": 0.05, "k1": 3e-6, "xp_F": 0.012, "yp_B": -0.01, "sy_F": 2e-4, "th_B": 2e-4}


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("block") / "b"
    simulated = write_block(folder, points=70, control=12, check=20, parameters=ERRORS)
    return folder, simulated


def adjusted(folder, out, *options):
    assert main(["adjust", str(folder), "-o", str(out), "-q", *map(str, options)]) == 0
    return json.loads((out / "result.json").read_text()), pd.read_csv(out / "points.csv")


def test_calibrated_camera_gives_the_same_points_without_parameters(block, tmp_path):
    folder, _ = block
    with_parameters, points = adjusted(folder, tmp_path / "one", "--selfcal", "tls18", "--keep", "all")
    again = tmp_path / "again"
    shutil.copytree(folder, again)
    for file in (tmp_path / "one").glob("camera*"):
        shutil.copy(file, again / file.name)
    without, same = adjusted(again, tmp_path / "two")
    assert without["additional_parameters"] == {}
    assert not (tmp_path / "two" / "camera.json").exists()  # nothing was calibrated
    assert same[AXES].to_numpy() == pytest.approx(points[AXES].to_numpy(), abs=1e-3)
    # the same residuals, though a camera that is taken as known has the redundancy of its 18 parameters
    squares = [result["sigma0"] ** 2 * result["redundancy"] for result in (without, with_parameters)]
    assert squares[0] == pytest.approx(squares[1], rel=2e-3)
    assert 16 <= without["redundancy"] - with_parameters["redundancy"] <= 18
    # and without either, the block does not fit at all
    bent, _ = adjusted(folder, tmp_path / "three")
    assert bent["sigma0"] > 1.5 * without["sigma0"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A block whose camera is off by some pixels, as a recording and as a folder; and what was adjusted in it."""
    folder = tmp_path_factory.mktemp("recording")
    write_block(folder / "b", points=70, control=12, check=20, parameters={**ERRORS, "k1": 3e-7})
    path = folder / "b.mcap"
    assert main(["import", str(folder / "b"), "-o", str(path), "-q"]) == 0
    result, points = adjusted(path, folder / "calibrated", "--selfcal", "tls18", "--keep", "all")
    return path, folder / "calibrated", result, points


def apart(points, others):
    """Distances of coordinates from those of the same points, in sigmas of the first."""
    both = points.merge(others, on="point", suffixes=("", "_other"))
    assert len(both) == len(points) == len(others)
    other = both[[f"{axis}_other" for axis in AXES]].to_numpy()
    return np.abs(both[AXES].to_numpy() - other) / both[[f"sigma_{axis}" for axis in AXES]].to_numpy()


@pytest.mark.parametrize("kind", ["recording", "block folder"])
def test_a_calibrated_camera_given_back_gives_the_same_points_without_parameters(recording, tmp_path, kind):
    path, calibrated, with_parameters, points = recording
    path = path if kind == "recording" else path.with_suffix("")
    camera = calibrated / "camera.json"
    without, same = adjusted(path, tmp_path / "again", "--camera", camera)
    assert without["additional_parameters"] == {} and without["n_unknowns"] < with_parameters["n_unknowns"]
    assert f"camera of {camera}" in without["notes"]
    # points.csv is rounded to 0.01 mm, and weights go with the pitch of the pixels, which k1 stretches by 0.1 %
    assert apart(points, same).max() < 2e-3
    bent, others = adjusted(path, tmp_path / "bent")
    assert bent["sigma0"] > 1.5 * without["sigma0"] and apart(points, others).max() > 1.0
    # the camera that goes with these tables lies beside them, for whoever takes them
    for file in calibrated.glob("camera*"):
        assert (tmp_path / "again" / file.name).read_text() == file.read_text()
    # adjusted once more with parameters there is nothing left for them
    left, _ = adjusted(path, tmp_path / "left", "--camera", camera, "--selfcal", "tls18", "--keep", "all")
    assert max(abs(p["t"]) for p in left["additional_parameters"].values()) < 0.1


def test_process_takes_a_calibrated_camera_and_hands_it_on(tmp_path):
    flight = tmp_path / "flight.mcap"
    flown = ["--seconds", "12", "--ties", "12", "--attitude-rate", "100", "--lead-in", "2", "--sensor", "ads40-small"]
    assert main(["simulate", "-o", str(flight), "-q", *flown]) == 0
    camera = Recording(flight).camera()
    bent = replace(camera, lines=tuple(
        replace(l, xy_mm=l.xy_mm + np.array([0.03 * (l.id == "F"), 0.0])) for l in camera.lines))  # fmt: skip
    for name, given in (("right", camera), ("bent", bent)):
        (tmp_path / name).mkdir()
        write_camera(tmp_path / name / "camera.json", given)

    def processed(recording, name):
        out = tmp_path / f"{recording.stem} {name}.mcap"
        camera = str(tmp_path / name / "camera.json")
        assert main(["process", str(recording), "-o", str(out), "--camera", camera]) == 0
        for line, wanted in zip(Recording(out).camera().lines, read_camera(Path(camera)).lines, strict=True):
            np.testing.assert_array_equal(line.xy_mm, wanted.xy_mm)
        return out

    right, wrong = processed(flight, "right"), processed(flight, "bent")
    again = processed(wrong, "right")  # what was processed with another camera is made anew
    told = [[(m.topic, m.stamp_ns, m.body) for m in Recording(path).messages()] for path in (right, again, wrong)]
    assert told[0] == told[1] != told[2]
    _, points = adjusted(right, tmp_path / "a")
    _, same = adjusted(wrong, tmp_path / "b", "--camera", tmp_path / "right" / "camera.json")
    assert apart(points, same).max() == 0.0


@pytest.mark.parametrize("command", ["adjust", "process"])
def test_cameras_that_do_not_go_with_the_recording_are_refused_in_one_line(recording, tmp_path, capsys, command):
    path, calibrated, _, _ = recording
    other = tmp_path / "other.json"
    other.write_text((calibrated / "camera.json").read_text().replace('"id": "N"', '"id": "M"'))
    for table in calibrated.glob("camera_*.csv"):
        shutil.copy(table, tmp_path)
    for file, said in ((other, "has other lines, wanted F with"), (tmp_path / "no.json", "no such file")):
        assert main([command, str(path), "--camera", str(file), "-o", str(tmp_path / "out")]) == 1
        err = capsys.readouterr().err
        assert f"{file}: {said}" in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_orientation_of_every_line_is_that_of_the_refined_trajectory(block, tmp_path):
    folder, _ = block
    adjusted(folder, tmp_path / "r", "--per-line")
    lines = pd.read_csv(tmp_path / "r" / "orientation_lines.csv")
    refined = pd.read_csv(tmp_path / "r" / "trajectory_refined.csv")
    strips = pd.read_csv(folder / "strips.csv").set_index("strip")
    for strip, own in lines.groupby("strip"):
        assert (own.line.diff().dropna() == 1).all()
        first, rate = strips.loc[strip, ["first_line_time_s", "line_rate_hz"]]
        assert own.time_s.to_numpy() == pytest.approx(first + own.line / rate, abs=1e-8)
        track = refined[refined.strip == strip]
        inside = own[(own.time_s > track.time_s.min()) & (own.time_s < track.time_s.max())]
        for name in ("X_m", "sigma_Z_m", "phi_deg"):
            between = np.interp(inside.time_s, track.time_s, track[name])
            assert inside[name].to_numpy() == pytest.approx(between, abs=2e-4), name


@pytest.fixture(scope="module")
def oriented(tmp_path_factory):
    """A flight in UTM, processed, with a boresight, and the CSV of its lines."""
    folder = tmp_path_factory.mktemp("oriented")
    words = ["--seconds", "6", "--ties", "12", "--attitude-rate", "100", "--lead-in", "2", "--sensor", "ads40-small"]
    assert main(["simulate", "-o", str(folder / "flight.mcap"), "-q", "--strips", "2", "--no-turns", *words]) == 0
    assert main(["process", str(folder / "flight.mcap"), "-o", str(folder / "oriented.mcap"), "-q"]) == 0
    assert main(["export", str(folder / "oriented.mcap"), "--per-line", str(folder / "lines.csv"), "-q"]) == 0
    return folder / "oriented.mcap", pd.read_csv(folder / "lines.csv")


def test_sigmas_of_refined_orientation_hold_the_noise_of_the_poses(tmp_path):
    """They were those of the corrections alone: of a heading that is measured to 0.01 deg they were 0.006 deg."""
    path, noise = tmp_path / "flight.mcap", ["--noise-attitude", ".01", ".01", ".01", "--noise", ".3", ".3", ".3"]
    flight = ["--seconds", "20", "--gnss-rate", "1", "--attitude-rate", "50", "--check", "0", "--seed", "2"]
    assert main(["simulate", "-q", "-o", str(path), *flight, *noise]) == 0
    adjusted(path, tmp_path / "whole", "--per-line")
    adjusted(path, tmp_path / "parts", "--per-line", "--workers", "1", "--partition-rays", "200")
    true = Recording(path).poses("truth/trajectory")
    begin_s = true.time_ns[0] * 1e-9
    path = Trajectory(true.time_ns * 1e-9 - begin_s, true.position_l, true.quaternion)
    for name in ("trajectory_refined.csv", "orientation_lines.csv"):
        table, same = (pd.read_csv(tmp_path / which / name) for which in ("whole", "parts"))
        sigma = table.filter(regex="^sigma").to_numpy()
        np.testing.assert_allclose(same.filter(regex="^sigma").to_numpy(), sigma, rtol=1e-3)
        at = path.at(table.time_s.to_numpy() - begin_s)
        off = table[["X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"]].to_numpy()
        off -= np.hstack([at.position_l, np.degrees(at.angles)])
        squares = np.mean(np.square(off / sigma), axis=0)
        assert 0.5 < squares[5] < 2.4  # was 4.8


def test_orientation_of_recordings_adjusted_together_goes_back_to_each(tmp_path):
    """It stands in the local frame of the first one, under names of strips that no recording has."""
    few = ["--seconds", "8", "--ties", "3", "--control", "0", "--check", "0", "--attitude-rate", "50", "-q"]
    for name, heading, seed in (("day1", "90", "1"), ("drawn", "0", "2")):  # of one seed a look may be the same
        drawn = ["simulate", "-o", str(tmp_path / f"{name}.mcap"), "--heading", heading, "--seed", seed]
        assert main([*drawn, *few]) == 0
    with RecordingWriter(tmp_path / "day2.mcap") as writer:  # with an origin of its own
        for message in Recording(tmp_path / "drawn.mcap").messages():
            if message.topic == "configuration/project":
                body = m.Project()
                body.CopyFrom(message.body)
                body.origin_latitude += 0.1
                message = replace(message, body=body)
            writer.write(message)
    days = [str(tmp_path / f"day{k}.mcap") for k in (1, 2)]
    assert main(["adjust", *days, "-o", str(tmp_path / "out"), "--per-line", "-q"]) == 0
    for table in ("trajectory_refined.csv", "orientation_lines.csv"):
        assert set(pd.read_csv(tmp_path / "out" / table).strip) == {"S1@day1", "S1@day2"}
        for day, drawn in zip(days, ("day1.mcap", "drawn.mcap"), strict=True):
            of, frame = OfTable(Recording(day), tmp_path / "out" / table), Recording(day).frame()
            true, in_frame = Recording(day).poses("truth/trajectory"), Recording(tmp_path / drawn).frame()
            time_s = (true.time_ns - of.reference_ns) * 1e-9
            inside = of.orientation.covers(time_s)
            position, _ = of.orientation.at(time_s[inside])
            wanted = frame.from_geodetic(*in_frame.to_geodetic(true.position_l[inside]).T)
            assert inside.sum() > 10 and not of.missing
            assert np.abs(position - wanted).max() < 9.0  # it was 11 km


def test_lines_have_the_last_whole_orientation(oriented, tmp_path):
    """The first strip is refined again with the second one."""
    path, lines = oriented
    recording = Recording(path)
    topic = "orientation/whole"
    poses = recording.poses(topic)
    count = len(poses.time_ns)
    last = poses.one_a_time()
    assert len(last.time_ns) * 2 == count and (np.diff(last.time_ns) > 0).all()
    assert np.abs(last.position_l - poses.one_a_time(keep_first=True).position_l).max() > 0.01
    for strip in ("S1", "S2"):
        own = lines[lines.strip == strip]
        known = last.strip == strip
        found = np.interp(last.time_ns[known] * 1e-9 - 1.7e9, own.time_s - 1.7e9, own.Z_m)
        assert found == pytest.approx(last.position_l[known, 2], abs=2e-3)


def test_lines_of_a_strip_without_whole_orientation_have_the_sigmas_of_the_final_one(oriented, tmp_path):
    path, _ = oriented
    cut, out = tmp_path / "cut.mcap", tmp_path / "lines.csv"
    messages = Recording(path).messages()
    write_recording(cut, (x for x in messages if x.topic != "orientation/whole" or x.body.strip != "S2"))
    assert main(["export", str(cut), "--per-line", str(out), "-q"]) == 0
    lines, final = pd.read_csv(out), Recording(path).poses("orientation/final")
    own, known = lines[lines.strip == "S2"], final.strip == "S2"
    found = np.interp(final.time_ns[known] * 1e-9 - 1.7e9, own.time_s - 1.7e9, own.sigma_Z_m)
    assert found == pytest.approx(np.sqrt(final.covariance[known, 2, 2]), rel=0.01)


def test_lines_as_patb_are_those_of_the_csv(oriented, tmp_path, capsys):
    recording, lines = oriented
    out = tmp_path / "lines.ori"
    assert main(["export", str(recording), "--per-line", str(out), "--format", "patb"]) == 0
    assert f"{len(lines)} lines" in capsys.readouterr().out
    rows = [row.split(" ") for row in out.read_text().splitlines()]
    assert [row[0] for row in rows] == [f"{strip}_{line}" for strip, line in zip(lines.strip, lines.line, strict=True)]
    values = np.array([row[1:] for row in rows], dtype=float)
    np.testing.assert_array_equal(values[:, :3], lines[AXES].to_numpy())
    R = values[:, 3:].reshape(-1, 3, 3)
    wanted = matrix_from_angles(*np.radians(lines[["omega_deg", "phi_deg", "kappa_deg"]].to_numpy()).T)
    np.testing.assert_allclose(R, wanted, atol=2e-9)
    for strip in set(lines.strip):  # x of the image points along the flight
        own = (lines.strip == strip).to_numpy()
        along = np.diff(values[own, :3], axis=0)
        assert (np.einsum("ni,ni->n", along, R[own][:-1, :, 0]) > 0.95 * np.linalg.norm(along, axis=1)).all()


def test_lines_as_sbet_are_those_of_the_csv(oriented, tmp_path, capsys):
    recording, lines = oriented
    out = tmp_path / "lines.sbet"
    assert main(["export", str(recording), "--per-line", str(out), "--format", "sbet"]) == 0
    assert f"{len(lines)} lines" in capsys.readouterr().out
    utc_ns = np.array([round(float(t) * 1e6) for t in lines.time_s]) * 1000  # as far as the table's floats tell it
    day = datetime.fromtimestamp(utc_ns[0] // 10**9, UTC).date()
    track = read_sbet(out, day)
    assert len(track.time_ns) == len(lines)
    np.testing.assert_allclose((track.time_ns - utc_ns) * 1e-9, 0.0, atol=2e-6)
    np.testing.assert_allclose(track.geodetic, lines[["lat_deg", "lon_deg", "height_m"]], atol=1e-4, rtol=0)
    np.testing.assert_allclose(track.geodetic[:, :2], lines[["lat_deg", "lon_deg"]], atol=1e-10, rtol=0)
    rpy = np.degrees(track.rpy) - lines[["roll_deg", "pitch_deg", "heading_deg"]].to_numpy()
    np.testing.assert_allclose((rpy + 180.0) % 360.0 - 180.0, 0.0, atol=2e-7)
    # velocities are those of the places, line by line within a strip
    values = np.fromfile(out, "<f8").reshape(-1, 17)
    one = lines.strip.to_numpy() == lines.strip.iloc[0]
    north_m = np.radians(np.gradient(track.geodetic[one, 0], track.time_ns[one] * 1e-9)) * 6.37e6
    np.testing.assert_allclose(values[one, 4], north_m, atol=0.5)
    assert np.linalg.norm(values[:, 4:7], axis=1).min() > 10.0
    accuracies = tmp_path / "lines.smrmsg"  # beside the SBET under its name
    assert main(["export", str(recording), "--per-line", str(accuracies), "--format", "smrmsg"]) == 0
    again = read_sbet(out, day)
    np.testing.assert_allclose(again.sigma_ned_m[:, 2], lines.sigma_Z_m, atol=1e-4)
    # along and across are turned against those of the CRS by the convergence, which is small
    np.testing.assert_allclose(again.sigma_ned_m[:, :2], lines[["sigma_Y_m", "sigma_X_m"]], rtol=0.02)
    np.testing.assert_allclose(np.degrees(again.sigma_rpy[:, 2]), lines.sigma_kappa_deg, rtol=0.05)


def test_lines_by_measured_poses_have_the_sigmas_of_these(oriented, tmp_path):
    """They had none, and `--format smrmsg` said that no pose has a covariance."""
    recording, _ = oriented
    out, accuracies = tmp_path / "lines.csv", tmp_path / "lines.smrmsg"
    for name, words in ((out, []), (accuracies, ["--format", "smrmsg"])):
        assert main(["export", str(recording), "--per-line", str(name), "--orientation", "measured", *words, "-q"]) == 0
    lines, poses = pd.read_csv(out), Recording(recording).poses("trajectory/smoothed")
    up = np.interp(lines.time_s, poses.time_ns * 1e-9, np.sqrt(poses.covariance[:, 2, 2]))
    np.testing.assert_allclose(lines.sigma_Z_m, up, atol=1e-3)
    np.testing.assert_allclose(np.fromfile(accuracies, "<f8").reshape(-1, 10)[:, 3], lines.sigma_Z_m, atol=1e-4)


def test_formats_of_lines_are_refused_in_one_line(oriented, block, tmp_path, capsys):
    recording, _ = oriented
    folder, _ = block
    assert main(["import", str(folder), "-o", str(tmp_path / "b.mcap"), "-q"]) == 0  # local: nowhere on the Earth
    for source, words, said in (
        (tmp_path / "b.mcap", ["--per-line", "x", "--format", "sbet"], "wanted the origin of the local frame"),
        (recording, ["--points", "x", "--format", "patb"], "--format: wanted with --per-line only"),
        (recording, ["--topic", "orientation/final", "--csv", "x", "--format", "csv"], "--format: wanted with --per"),
    ):
        assert main(["export", str(source), *(str(tmp_path / "x") if w == "x" else w for w in words)]) == 1
        err = capsys.readouterr().err
        assert said in err and err.count("\n") == 1
        assert not (tmp_path / "x").exists()


def surface_with_houses(folder, path, rng):
    """The ground that `write_block` takes, on which each tenth cell of 40 m carries 15 m more."""
    x, y = np.meshgrid(np.arange(-2000, 2000, 10.0), np.arange(2000, -2000, -10.0))
    z = 60 * np.sin(x / 400 + y / 700)
    built = np.kron(rng.uniform(size=(100, 100)) < 0.1, np.ones((4, 4)))[: z.shape[0], : z.shape[1]]
    crs = "EPSG:32632"
    return Heights(crs, z + 15.0 * built, 5e5 + x[0, 0], 5.4e6 + y[0, 0], 10.0, -10.0, above_ellipsoid=True)


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """A block without control, in UTM, and the raster of its ground with houses on it."""
    folder = tmp_path_factory.mktemp("placed") / "b"
    simulated = write_block(folder, points=120, control=0, check=40, seed=5)
    for name, columns in (("trajectory.csv", AXES[:2]), ("ground_points.csv", AXES[:2])):
        table = pd.read_csv(folder / name)
        table[columns] += [5e5, 5.4e6]
        table.to_csv(folder / name, index=False, float_format="%.9f")
    text = (folder / "project.toml").read_text().replace('name = "simulated"', 'name = "s"\ncrs = "EPSG:32632"')
    text = text.replace("offset_sigma_m = [0.1, 0.1, 0.2]", "offset_sigma_m = [0.3, 0.3, 1.0]")  # as they are drawn
    (folder / "project.toml").write_text(text)
    rng = np.random.default_rng(2)
    write_heights(folder.parent / "dem.tif", surface_with_houses(folder, folder.parent / "dem.tif", rng))
    return folder, simulated


def test_heights_of_a_raster_hold_the_block_in_spite_of_houses(placed, tmp_path, capsys):
    folder, _ = placed
    free, _ = adjusted(folder, tmp_path / "free")
    options = ["--dem", folder.parent / "dem.tif", "--dem-sigma", 0.3, "--dem-shift-sigma", 0.05]
    held, points = adjusted(folder, tmp_path / "held", *options)
    assert held["check"]["sigma_m"][2] < 0.5 * free["check"]["sigma_m"][2]
    assert held["check"]["rmse_m"][2] < 2.0 * held["check"]["sigma_m"][2]
    assert abs(held["check"]["mean_m"][2]) < 0.1  # houses of 15 m on a tenth of the cells would lift it by 1.5 m
    assert held["dem"]["holds_height"] and abs(held["dem"]["shift_m"]) < 3 * held["dem"]["shift_sigma_m"]
    assert held["dem"]["n"] > 60 and 3 <= held["dem"]["half_weight_or_less"] < 30
    assert held["control"]["n"] == 0 and set(points.role) == {"tie", "check"}
    assert main(["adjust", str(folder), "--dem", str(folder.parent / "dem.tif"), "--dem-sigma", "0.3"]) == 0
    out = capsys.readouterr().out
    assert "heights of the raster" in out and "raster minus all else" in out


def test_a_raster_in_another_datum_is_told_and_gives_no_height(placed, tmp_path, capsys):
    folder, _ = placed
    free, _ = adjusted(folder, tmp_path / "free")
    with rasterio.open(folder.parent / "dem.tif") as source:
        z, corner = source.read(1), source.xy(0, 0)
    write_heights(tmp_path / "geoid.tif", Heights("EPSG:32632", z + 47.0, *corner, 10.0, -10.0, above_ellipsoid=True))
    held, _ = adjusted(folder, tmp_path / "held", "--dem", tmp_path / "geoid.tif", "--dem-sigma", 0.3)
    assert not held["dem"]["holds_height"] and held["dem"]["shift_m"] == pytest.approx(47.0, abs=3.0)
    assert "vertical datum of --dem-crs?" in " ".join(held["notes"])
    assert held["check"]["mean_m"][2] == pytest.approx(free["check"]["mean_m"][2], abs=0.2)
    assert "NO height datum of the raster" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--dem", "flat.tif", "--dem-sigma", "1"], "does not say what its heights count from, wanted --dem-crs"),
        (["--dem", "flat.tif"], "wanted both"),
        (["--dem-crs", "ellipsoid"], "wanted --dem FILE with it"),
        (["--dem", "flat.tif", "--dem-sigma", "0"], "--dem-sigma 0, wanted more than 0"),
        (["--dem", "flat.tif", "--dem-sigma", "1", "--dem-crs", "EPSG:32632"], "says nothing of heights"),
        (["--dem", "flat.tif", "--dem-sigma", "1", "--dem-crs", "metres"], "--dem-crs metres:"),
        (["--dem", "flat.tif", "--dem-sigma", "1", "--dem-crs", "EPSG:5773"], "PROJ lacks the grid"),
        (["--dem", "flat.tif", "--dem-sigma", "1", "--dem-crs", "ellipsoid"], "no height below any tie point"),
        (["--per-line"], "--per-line needs a folder"),
    ],
)
def test_heights_without_datum_or_sigma_are_refused_in_one_line(placed, tmp_path, capsys, monkeypatch, options, said):
    folder, _ = placed
    monkeypatch.chdir(tmp_path)
    place = Heights("EPSG:32632", np.full((4, 4), 3.0), 5.2e5, 5.5e6, 10.0, -10.0)
    write_heights(tmp_path / "flat.tif", place)
    if "PROJ lacks" in said and not _lacks_egm96():
        pytest.skip("PROJ has the geoid here")
    assert main(["adjust", str(folder), "-q", *options]) == 1
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def _lacks_egm96():
    from triline.nodes.formats.projection import missing_grids

    return bool(missing_grids("EPSG:32632+EPSG:5773"))


def test_a_raster_of_ours_says_its_datum(placed):
    with rasterio.open(placed[0].parent / "dem.tif") as source:
        assert source.tags()["VERTICAL_DATUM"] == "ellipsoid"


def test_points_say_what_checks_them(tmp_path):
    path, table = tmp_path / "a.mcap", tmp_path / "points.csv"
    with RecordingWriter(path) as writer:
        for i, checked in enumerate(("all", "doubtful")):
            point = m.ObjectPoint(point=f"T{i}", x=1.0, y=2.0, z=3.0, rays=3, role="tie", status=2, checked=checked)
            writer.write(Message("point/object", 10**9, point, "adjuster"))
    assert main(["export", str(path), "--points", str(table), "-q"]) == 0
    assert pd.read_csv(table).set_index("point")["checked"].to_dict() == {"T0": "all", "T1": "doubtful"}
