"""Sensor folders: read as they stand, errors with file, line and column; ``triline navigate`` over them."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import inertial_flights as sim
import numpy as np
import pytest
from full_disk import files_of_at_most
from matplotlib.figure import Figure
from recording_file import write_recording

from triline.nodes.cli import main
from triline.nodes.cli.navigate import COLUMNS
from triline.nodes.errors import UserError
from triline.nodes.formats.sensor_folder import read_platform, read_sensor_folder
from triline.nodes.formats.sensor_recording import sensor_messages
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report import navigation_page, navigation_plots
from triline.solver.geometry.frames import LocalFrame

RATES = "time_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s"
INCREMENTS = "time_s,dvx_m_s,dvy_m_s,dvz_m_s,dthx_rad,dthy_rad,dthz_rad"
GNSS = "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m"
PLATFORM = """lever_arm_m = [0.5, 0.1, -1.2]
[imu]
gyro_noise_deg_sqrt_h = 0.003
gyro_bias_deg_h = 0.03
accel_noise_m_s_sqrt_h = 0.005
accel_bias_mgal = 15
"""


@cache
def flight():
    return sim.flight(duration_s=100.0, seed=61, rate_hz=100, line_s=20.0)


def write(folder: Path, *, increments=False, scale=1.0, shift_s=0.0, platform=PLATFORM, keep=None) -> Path:
    f = flight()
    d, g = f.inertial, f.gnss
    dt = 1.0 if increments else d.dt_s[:, None]
    imu = np.column_stack([d.time_s, d.dv / dt, scale * d.dtheta / dt])
    if keep is not None:
        imu = imu[keep(d.time_s)]
    gnss = np.column_stack([g.time_s + shift_s, np.degrees(g.lat), np.degrees(g.lon), g.height_m, g.sigma_ned_m])
    folder.mkdir(exist_ok=True)
    header = INCREMENTS if increments else RATES
    np.savetxt(folder / "imu.csv", imu, "%.14g", ",", header=header, comments="")
    np.savetxt(folder / "gnss.csv", gnss, "%.14g", ",", header=GNSS, comments="")
    if platform:
        (folder / "platform.toml").write_text(platform)
    return folder


def edit(path: Path, line: int, old: str, new: str) -> None:
    lines = path.read_text().splitlines()
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new, 1)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("increments", [False, True])
def test_navigate_writes_trajectory_result_and_page(tmp_path, increments, capsys):
    folder = write(tmp_path / "<img src=x>", increments=increments)
    no_page = ["--no-page"] if increments else []  # which shows the same of either
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), *no_page]) == 0
    capsys.readouterr()
    with open(tmp_path / "out" / "trajectory.csv") as file:
        assert file.readline().strip() == ",".join(COLUMNS)
    rows = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    f = flight()
    assert len(rows) == len(f.inertial) and np.allclose(rows[:, 0], f.inertial.time_s)
    late = rows[rows[:, 0] > 50.0]
    true = f.motion.at(late[:, 0])
    north = (np.radians(late[:, 1]) - true.lat) * 6.37e6
    assert sim.rms(north) < 0.02 and 0.5 < sim.rms(north / late[:, 10]) < 1.6
    assert sim.rms(late[:, 3] - true.height_m) < 0.03
    assert sim.rms(late[:, 4:7] - true.velocity_n).max() < 0.01
    turn = (late[:, 7:10] - np.degrees(true.angles) + 180.0) % 360.0 - 180.0
    assert (sim.rms(turn) < [0.003, 0.003, 0.02]).all() and 0.3 < sim.rms(turn / late[:, 16:]).max() < 3.0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["smoothed"] and result["stretches"][0]["innovations"]["position"]["n"] == len(f.gnss)
    median, rms = (np.array(result["stretches"][0][k]["position_m"]) for k in ("sigma_median", "sigma_rms"))
    assert (median > 0.0).all() and (median < rms).all()  # the ends are less certain
    if increments:
        return
    page = (tmp_path / "out" / "navigation.html").read_text()
    for word in ("Trajectory", "Attitude", "Standard deviations", "Innovations", "Biases", "Gaps", "data:image/png"):
        assert word in page
    assert "http" not in page and "<img src=x>" not in page and page.count("&lt;img src=x&gt;") >= 2


def test_no_smooth_json_rate_and_hold_out(tmp_path, capsys):
    folder = write(tmp_path / "flight")
    arguments = ["--no-smooth", "--json", "--no-page", "--rate", "5", "--hold-out", "5"]
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    assert not result["smoothed"] and not (tmp_path / "out" / "navigation.html").exists()
    rows = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    assert len(rows) == result["rows"] and np.allclose(np.diff(rows[:, 0]), 0.2)
    held = result["stretches"][0]["held_out"]
    assert held["n"] == 19 and max(held["rms_over_sigma"]) < 2.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rate", "inf"], "--rate inf: wanted a number above 0, at most 100000"),
        (["--rate", "0.001"], "--rate 0.001: no row falls into 99 s, wanted more a second"),
        (["--hold-out", "1000"], "--hold-out 1000: there are 99 fixes, wanted at most as many"),
    ],
)
def test_a_rate_or_a_share_of_fixes_of_which_nothing_is_left_is_refused(tmp_path, capsys, options, words):
    """A trajectory without rows took the place of the one before, and no fix was compared, without a word."""
    folder, out = write(tmp_path / "flight"), tmp_path / "out"
    out.mkdir()
    (out / "trajectory.csv").write_text("earlier")
    arguments = ["--no-smooth", "--no-page", "--no-checks", *options]
    assert main(["navigate", str(folder), "-o", str(out), *arguments]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("triline navigate: ") and error.endswith(words)
    assert (out / "trajectory.csv").read_text() == "earlier"


def test_a_full_disk_leaves_no_half_file_and_the_result_of_the_earlier_run(tmp_path, capsys):
    folder, out = write(tmp_path / "flight"), tmp_path / "out"
    out.mkdir()
    names = ("notes.txt", "trajectory.csv", "navigation.html", "result.json")
    for name in names:
        (out / name).write_text("earlier")
    with files_of_at_most(1000):
        assert main(["navigate", str(folder), "-o", str(out), "--no-smooth", "--no-page", "--no-checks"]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == f"triline navigate: {out / 'trajectory.csv'}: cannot be written: file too large"
    assert {path.name: path.read_text() for path in out.iterdir()} == dict.fromkeys(names, "earlier")


def test_results_do_not_go_into_the_folder_of_a_block(tmp_path, capsys):
    folder, block = write(tmp_path / "flight"), tmp_path / "block"
    block.mkdir()
    (block / "strips.csv").write_text("strip,first_line_time_s,line_rate_hz,lines\n")
    (block / "trajectory.csv").write_text("of the block")
    assert main(["navigate", str(folder), "-o", str(block)]) == 1
    assert "has the files of a block or a flight, wanted another folder for the result" in capsys.readouterr().err
    assert (block / "trajectory.csv").read_text() == "of the block"


def test_gaps_are_filled_and_named(tmp_path, capsys):
    folder = write(tmp_path / "flight", keep=lambda t: ~((t > 60.0) & (t < 62.0)))
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page"]) == 0
    assert "imu.csv: time_s: 1 gap(s), 199 sample(s) lost" in capsys.readouterr().err
    rows = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    assert np.diff(rows[:, 0]).max() < 0.011 and np.isfinite(rows).all()


def test_a_last_time_that_is_wrong_makes_no_rows(tmp_path, capsys):
    folder = write(tmp_path / "flight")
    lines = (folder / "imu.csv").read_text().splitlines()
    lines[-1] = "1e9," + lines[-1].split(",", 1)[1]
    (folder / "imu.csv").write_text("\n".join(lines) + "\n")
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page"]) == 0
    rows = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    assert len(rows) == len(lines) - 2 and rows[-1, 0] < 100.0


def test_initial_attitude_from_platform_and_from_attitude_csv(tmp_path, capsys):
    roll, pitch, heading = np.degrees(flight().motion.at(0.5).angles[0])
    initial = (
        f"[initial]\nroll_deg = {roll}\npitch_deg = {pitch}\nheading_deg = {heading + 180}\nheading_sigma_deg = 1\n"
    )
    folder = write(tmp_path / "flight", platform=PLATFORM + initial)
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page"]) == 0
    assert "initial attitude is 1" in capsys.readouterr().err
    (folder / "platform.toml").write_text(PLATFORM)
    t = np.arange(0.5, 99.0, 0.5)
    table = np.column_stack([t, np.degrees(flight().motion.at(t).angles), np.full((len(t), 3), 0.2)])
    header = "time_s,roll_deg,pitch_deg,heading_deg,sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg"
    np.savetxt(folder / "attitude.csv", table, "%.10g", ",", header=header, comments="")
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page", "--heading-aid", "--json"]) == 0
    stretch = json.loads(capsys.readouterr().out)["stretches"][0]
    assert stretch["alignment"] == "given attitude" and stretch["innovations"]["heading"]["n"] > 90


def test_one_attitude_with_a_wrong_time_is_told_and_costs_no_others(tmp_path, capsys):
    folder = write(tmp_path / "flight")
    t = np.arange(0.5, 99.0, 0.5)
    times = t.copy()
    times[20] = 1e6
    table = np.column_stack([times, np.degrees(flight().motion.at(t).angles), np.full((len(t), 3), 0.2)])
    header = "time_s,roll_deg,pitch_deg,heading_deg,sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg"
    np.savetxt(folder / "attitude.csv", table, "%.10g", ",", header=header, comments="")
    read = read_sensor_folder(folder)
    assert (read.attitude.time_s == np.sort(times)).all()
    assert "attitude.csv: time_s: attitudes go back in time at 1 place(s): put in order" in read.notes
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page", "--heading-aid", "--json"]) == 0
    stretch = json.loads(capsys.readouterr().out)["stretches"][0]
    assert stretch["innovations"]["heading"]["n"] > 90


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: write(p, scale=57.29578), "imu.csv: wx_rad_s,wy_rad_s,wz_rad_s: gyros give degrees"),
        (lambda p: write(p, scale=0.01), "imu.csv: wx_rad_s,wy_rad_s,wz_rad_s: the columns say angular rates"),
        (
            lambda p: write(p, increments=True, scale=100.0),
            "imu.csv: dthx_rad,dthy_rad,dthz_rad: the columns say angle",
        ),
        (lambda p: write(p, shift_s=18.0), "gnss.csv: time_s: GNSS times are 18 s late"),
        (lambda p: write(p, shift_s=1e6), "gnss.csv: time_s: times do not overlap"),
    ],
)
def test_traps_end_in_one_line_that_names_cause_and_column(tmp_path, capsys, make, words):
    folder = make(tmp_path / "flight")
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1] and error[-1].startswith("triline navigate: ")
    assert not (tmp_path / "out").exists()


def test_semicolons_and_decimal_commas(tmp_path):
    """Sigmas and velocities of fixes are read as text, and were no numbers with decimal commas."""
    plain, folder = read_sensor_folder(write(tmp_path / "points")), write(tmp_path / "commas")
    for name in ("imu.csv", "gnss.csv"):
        path = folder / name
        path.write_text(path.read_text().replace(",", ";").replace(".", ","))
    read = read_sensor_folder(folder)
    np.testing.assert_array_equal(read.force, plain.force)
    for name in ("time_s", "lat", "lon", "height_m", "sigma_ned_m"):
        np.testing.assert_array_equal(getattr(read.gnss, name), getattr(plain.gnss, name))
    edit(folder / "gnss.csv", 3, ";0,", ";0.")
    with pytest.raises(UserError, match=r"gnss\.csv:3: sigma_n_m: '0\.\d+' is not a number"):
        read_sensor_folder(folder)


def test_malformed_files_name_file_line_and_column(tmp_path):
    folder = write(tmp_path / "flight")
    edit(folder / "imu.csv", 5, ",", ",x")
    with pytest.raises(UserError, match=r"imu\.csv:5: fx_m_s2: 'x"):
        read_sensor_folder(folder)
    folder = write(tmp_path / "flight")
    lines = (folder / "imu.csv").read_text().splitlines()
    lines[6] = ",".join(lines[6].split(",")[:5])
    (folder / "imu.csv").write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"imu\.csv:7: wy_rad_s: missing"):
        read_sensor_folder(folder)
    folder = write(tmp_path / "flight")
    edit(folder / "imu.csv", 1, "wz_rad_s", "wz_deg_s")
    with pytest.raises(UserError, match=r"imu\.csv:1: wz_rad_s: column missing"):
        read_sensor_folder(folder)
    edit(folder / "imu.csv", 1, "wz_deg_s", "dthz_rad")
    with pytest.raises(UserError, match="increments beside rates"):
        read_sensor_folder(folder)
    folder = write(tmp_path / "flight", platform=PLATFORM.replace("15", "'much'"))
    with pytest.raises(UserError, match=r"platform\.toml: imu\.accel_bias_mgal: 'much'"):
        read_sensor_folder(folder)
    (folder / "platform.toml").write_text("lever_arm_m = [1, 2")
    with pytest.raises(UserError, match="not valid TOML"):
        read_sensor_folder(folder)
    with pytest.raises(UserError, match="not a folder"):
        read_sensor_folder(folder / "imu.csv")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("lever_arm_m = [1e6, 0, 0]", r"lever_arm_m: \[1000000\.0, 0, 0\], wanted metres within 50; are they mm\?"),
        ("camera_lever_arm_m = [0, -51, 0]", r"camera_lever_arm_m: \[0, -51, 0\], wanted metres within 50"),
        ("boresight_deg = [0, 0, 1e4]", r"boresight_deg: \[0, 0, 10000\.0\], wanted degrees within 360"),
        ("lever_arm_m = [nan, 0, 0]", r"lever_arm_m: \[nan, 0, 0\], wanted 3 numbers"),
        ("boresight_deg = [0, inf, 0]", r"boresight_deg: \[0, inf, 0\], wanted 3 numbers"),
        ("lever_arm_sigma_m = -1", r"lever_arm_sigma_m: -1, wanted a number of at least 0"),
        ("lever_arm_sigma_m = 200", r"lever_arm_sigma_m: 200, wanted metres up to 50"),
    ],
)
def test_mountings_that_no_platform_has_are_refused(tmp_path, line, words):
    (tmp_path / "platform.toml").write_text(line + "\n")
    with pytest.raises(UserError, match=rf"platform\.toml: {words}"):
        read_platform(tmp_path / "platform.toml", [])


def test_sigmas_of_zero_or_nan_are_named(tmp_path, capsys):
    folder = write(tmp_path / "flight")
    edit(folder / "gnss.csv", 4, "0.02", "0")
    edit(folder / "gnss.csv", 6, "0.02", "nan")
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page"]) == 0
    assert (
        "gnss.csv: sigma_n_m,sigma_e_m,sigma_d_m: sigma north is zero or not a number in 2 of"
        in capsys.readouterr().err
    )
    text = (folder / "gnss.csv").read_text().replace(",0.02,", ",0,").replace(",0.04", ",0.04")
    (folder / "gnss.csv").write_text(text)
    assert main(["navigate", str(folder)]) == 1
    assert "sigma" in capsys.readouterr().err


def test_single_impossible_values_are_named_with_line_and_column_and_dropped(tmp_path, capsys):
    folder = write(tmp_path / "in")
    lines = (folder / "imu.csv").read_text().splitlines()
    cells = lines[4001].split(",")
    lines[4001] = ",".join([cells[0], "1e9", *cells[2:]])
    (folder / "imu.csv").write_text("\n".join(lines) + "\n")
    fixes = (folder / "gnss.csv").read_text().splitlines()
    cells = fixes[20].split(",")
    fixes[20] = ",".join([cells[0], "148.0", *cells[2:]])
    (folder / "gnss.csv").write_text("\n".join(fixes) + "\n")
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "--no-page"]) == 0
    said = capsys.readouterr().err
    assert "imu.csv:4002: fx_m_s2: 1e+09 m/s^2 cannot be" in said
    assert "gnss.csv:21: lat_deg: 148, wanted -90 to 90 deg: fix dropped" in said
    assert json.loads((tmp_path / "out" / "result.json").read_text())["n_inertial"] == len(lines) - 2


def test_defaults_unknown_columns_and_missing_files(tmp_path, capsys):
    folder = write(tmp_path / "flight", platform="")
    edit(folder / "gnss.csv", 1, "sigma_d_m", "sigma_d_m,satellites")
    read = read_sensor_folder(folder)
    assert any("satellites" in n for n in read.notes) and any("MEMS" in n for n in read.notes)
    assert main(["navigate", str(folder), "--no-page", "-q"]) == 0
    assert (folder / "navigation" / "trajectory.csv").is_file()
    (folder / "imu.csv").unlink()
    assert main(["navigate", str(folder)]) == 1
    assert "imu.csv is missing" in capsys.readouterr().err
    assert main(["navigate", str(tmp_path / "none")]) == 1
    assert main(["navigate", str(folder), "--hold-out", "1"]) == 1


def test_navigate_over_a_recording(tmp_path, capsys):
    recording = tmp_path / "flight.mcap"
    arguments = ["--strips", "2", "--cross", "0", "--seconds", "25", "--seed", "3", "-q"]
    assert main(["simulate", "-o", str(recording), *arguments, "--imu", "tactical", "--imu-rate", "100"]) == 0
    capsys.readouterr()
    assert main(["navigate", str(recording), "-o", str(tmp_path / "out"), "--json", "--no-page", "--rate", "10"]) == 0
    result = json.loads(capsys.readouterr().out)
    (stretch,) = result["stretches"]
    for kind in ("position", "velocity"):
        assert 0.85 < stretch["innovations"][kind]["nis_per_degree_of_freedom"] < 1.15
    rows = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    assert rows[0, 0] > 1.7e9 and np.allclose(np.diff(rows[:, 0]), 0.1, atol=1e-5)
    reader = RecordingReader(recording)
    project = reader.first("configuration/project")
    frame = LocalFrame(project.origin_latitude, project.origin_longitude, project.origin_height)
    truth = [m.body for m in reader.sorted_messages(["truth/trajectory"])]
    t = np.array([b.timestamp.seconds + b.timestamp.nanos * 1e-9 for b in truth])
    true = np.array([[b.pose.position.x, b.pose.position.y, b.pose.position.z] for b in truth])
    inside = (t > rows[0, 0] + 20.0) & (t < rows[-1, 0])
    found = frame.from_geodetic(*rows[:, 1:4].T)
    found = np.column_stack([np.interp(t[inside], rows[:, 0], x) for x in found.T])
    sigma = np.hypot(rows[:, 10:13].mean(axis=0)[[1, 0, 2]], project.offset_sigma_m)
    assert inside.sum() > 100 and (np.abs(found - true[inside]).mean(axis=0) < 3.0 * sigma).all()
    (tmp_path / "other.mcap").write_bytes(b"nothing")
    assert main(["navigate", str(tmp_path / "other.mcap")]) == 1


def test_a_noise_that_no_unit_has_is_not_counted_in_a_recording(tmp_path, capsys):
    messages = list(sensor_messages(read_sensor_folder(write(tmp_path / "sensors")), []))
    for message in messages:
        if message.topic == "sensor/imu":
            message.body.rate_sigma, message.body.force_sigma = 5.0, 1e3
    numbered = [replace(message, sequence=i) for i, message in enumerate(messages)]
    recording = write_recording(tmp_path / "flight.mcap", numbered)
    assert main(["navigate", str(recording), "--json", "--no-page", "--rate", "1"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    for field in ("rate_sigma", "force_sigma"):
        assert any(f"samples with a {field} that no unit has" in note for note in notes)
    assert any("a MEMS unit is assumed" in note for note in notes)


def test_notes_of_a_recording_tell_the_times_of_its_trajectory(tmp_path, capsys):
    folder = write(tmp_path / "sensors", keep=lambda t: (t < 50.0) | (t > 52.0))
    for name in ("imu.csv", "gnss.csv"):
        header, *rows = (folder / name).read_text().splitlines()
        later = [f"{1.7e9 + float(t):.6f},{rest}" for t, _, rest in (row.partition(",") for row in rows)]
        (folder / name).write_text("\n".join([header, *later]) + "\n")
    recording = tmp_path / "flight.mcap"
    assert main(["import", str(folder), "-o", str(recording), "-q"]) == 0
    capsys.readouterr()
    for source in (folder, recording):
        out = tmp_path / f"{source.stem}_out"
        assert main(["navigate", str(source), "-o", str(out), "--json", "--no-page", "--rate", "1"]) == 0
        result = json.loads(capsys.readouterr().out)
        ((begin, end),) = result["stretches"][0]["gaps"]
        assert begin > 1.7e9
        assert any(f"({begin:.2f}-{end:.2f} s)" in note for note in result["notes"])


def test_platform_keys_are_read(tmp_path):
    text = PLATFORM + (
        "bias_time_s = 900\ngyro_scale_ppm = 100\nunknown = 1\n[initial]\nheading_deg = 30\nsigma_heading_deg = 3\n"
    )
    head = "camera_lever_arm_m = [0, 0, 1]\nboresight_deg = [0, 0, 90]\n"
    slow = "[gnss]\nwander_sigma_m = [0.1, 0.2, 0.3]\nwander_time_s = 20\n"
    folder = write(tmp_path / "flight", platform=head + text + slow)
    read = read_sensor_folder(folder)
    p = read.platform
    assert p.grade.bias_time_s == 900 and p.grade.gyro_scale == pytest.approx(1e-4) and p.settings.scale_factors
    assert p.grade.accel_bias == pytest.approx(15e-5) and p.grade.gyro_noise == pytest.approx(np.radians(0.003) / 60)
    assert p.settings.wander_sigma_ned_m == (0.1, 0.2, 0.3) and p.settings.wander_time_s == 20
    assert p.initial is not None and np.degrees(p.initial.sigma) == pytest.approx([20.0, 20.0, 3.0])
    assert np.allclose(p.mount.rotation, [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12)
    assert any("unknown" in n for n in read.notes)


def test_what_a_recording_of_a_folder_keeps_of_the_platform_and_what_positions_are_of(tmp_path, capsys):
    slow = "[gnss]\nwander_sigma_m = [0.1, 0.2, 0.3]\nwander_time_s = 20\n"
    folder = write(tmp_path / "sensors", platform="camera_lever_arm_m = [0, 0, 1.5]\n" + PLATFORM + slow)
    recording = tmp_path / "flight.mcap"
    assert main(["import", str(folder), "-o", str(recording), "-q"]) == 0
    project = RecordingReader(recording).last("configuration/project")
    assert list(project.lever_arm_m) == pytest.approx([0.5, 0.1, -2.7])
    assert list(project.wander_sigma_m) == [0.2, 0.1, 0.3] and project.wander_time_s == 20  # X is east
    capsys.readouterr()
    heights, notes = [], []
    for source in (folder, recording):
        out = tmp_path / source.stem
        assert main(["navigate", str(source), "-o", str(out), "--json", "--no-page", "--rate", "1"]) == 0
        notes.append(json.loads(capsys.readouterr().out)["notes"])
        rows = np.loadtxt(out / "trajectory.csv", delimiter=",", skiprows=1)
        heights.append(np.median(rows[20:, 3]))
    assert heights[0] - heights[1] == pytest.approx(1.5, abs=0.1)  # of the unit, and of the camera below it
    said = "the inertial unit is taken to sit in the perspective centre, and positions are of that"
    assert not any(said in note for note in notes[0]) and any(said in note for note in notes[1])


def test_a_flight_across_the_date_line_has_its_origin_there(tmp_path):
    folder = write(tmp_path / "sensors")
    table = np.loadtxt(folder / "gnss.csv", delimiter=",", skiprows=1)
    table = table[len(table) % 2 :]  # as many on one side as on the other
    table[:, 2] += 180.0 - np.median(table[:, 2])
    table[:, 2] = (table[:, 2] + 180.0) % 360.0 - 180.0
    assert np.ptp(table[:, 2]) > 359.0
    np.savetxt(folder / "gnss.csv", table, "%.14g", ",", header=GNSS, comments="")
    project = next(sensor_messages(read_sensor_folder(folder), [])).body
    assert abs(project.origin_longitude) > 179.9


def test_the_plan_of_a_flight_across_the_date_line_is_as_large_as_the_flight(tmp_path, monkeypatch):
    folder = write(tmp_path / "sensors")
    table = np.loadtxt(folder / "gnss.csv", delimiter=",", skiprows=1)
    table[:, 2] += 180.0 - np.median(table[:, 2])
    table[:, 2] = (table[:, 2] + 180.0) % 360.0 - 180.0
    np.savetxt(folder / "gnss.csv", table, "%.14g", ",", header=GNSS, comments="")
    drawn = []
    trajectory = navigation_plots.trajectory
    monkeypatch.setattr(navigation_page, "_PLOTS", (("T", lambda *a: drawn.append(trajectory(*a)) or drawn[0], ""),))
    assert main(["navigate", str(folder), "-o", str(tmp_path / "out"), "-q"]) == 0
    assert np.ptp(drawn[0].axes[0].get_xlim()) < 20_000.0  # m; it was 40 000 km


@pytest.mark.parametrize("sigmas", [(0.85, 1.45), (0.9, 1.2), (0.3, 0.8), (0.02, 0.1), (0.01, 0.7), (1e-3, 2.0)])
def test_sigmas_can_be_read_whatever_their_range(sigmas):
    axis = Figure().add_subplot()
    axis.semilogy([0.0, 1.0], sigmas)
    axis.yaxis.set_major_locator(navigation_plots._ticks(axis))
    low, high = axis.get_ylim()
    assert 2 <= sum(low <= tick <= high for tick in axis.get_yticks()) <= 8
