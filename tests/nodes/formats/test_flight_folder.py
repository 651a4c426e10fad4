"""A flight folder: what is missing in it is said, and it becomes a recording."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest
import rasterio
from envi_files import write_camera, write_image
from tracks import ns

from triline.nodes.cli import main
from triline.nodes.config import load
from triline.nodes.convert import local_frame, pose_sample
from triline.nodes.formats.detect import within
from triline.nodes.formats.flight_folder import read_flight
from triline.nodes.formats.geotiff import Heights, write_heights
from triline.nodes.formats.ground_points import read_ground_points
from triline.nodes.formats.table import read_table
from triline.nodes.recording.reader import RecordingReader

START = "2020-06-01T12:00:00"
LAT, LON, GROUND = 48.0, 11.0, 612.3
TOML = """
[flight]
name = "valley"
platform = "do228"
crs = "EPSG:32632"
vertical_datum = "ellipsoid"
[camera]
file = "camera.json"
[mounting]
lever_arm_m = [0.2, 0.0, -1.5]
camera_lever_arm_m = [0.1, 0.0, 0.3]
boresight_deg = [0.0, 0.1, 0.0]
[navigation]
file = "poses.csv"
date = 2020-06-01
gnss = "RTK"
imu = "tactical"
[trajectory]
shift_sigma_deg = [0.004, 0.004, 0.008]
attitude_wander_time_s = 20
[control]
file = "control.csv"
[[strips]]
id = "S1"
images = {F = "all.img@1", N = "all.img@2", B = "all.img@3"}
line_times = "times.csv"
[[strips]]
id = "S2"
images = {N = "nadir.img"}
first_time = 2020-06-01T12:00:03Z
line_rate_hz = 50
[nodes.matcher]
ground_m = 5.0
"""


@pytest.fixture
def folder(tmp_path):
    """Poses 2 000 m up over ground at 612 m, two strips of images, three control points."""
    at = tmp_path / "flight"
    at.mkdir()
    rows = [f"{129618 + i},{LAT + 0.0009 * i:.6f},{LON},2000,0,0,0" for i in range(6)]
    (at / "poses.csv").write_text(
        "gps_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + "\n".join(rows) + "\n"
    )
    write_camera(at / "camera.json")
    rng = np.random.default_rng(1)
    write_image(at / "all.img", rng.integers(0, 255, (50, 7, 3)).astype("u1"), "bip")
    write_image(at / "nadir.img", rng.integers(0, 4000, (20, 7, 1)).astype("u2"))
    (at / "times.csv").write_text("line,time\n" + "".join(f"{i},2020-06-01T12:00:{i / 50:09.6f}Z\n" for i in range(50)))
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    points = []
    for i, height in enumerate((GROUND - 10, GROUND, GROUND + 30)):
        x, y = to_utm.transform(LON + 0.001 * i, LAT + 0.001 * i)
        points.append(f"P{i},{x:.3f},{y:.3f},{height},0.05,0.05,0.1,control")
    (at / "control.csv").write_text("point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role\n" + "\n".join(points) + "\n")
    (at / "flight.toml").write_text(TOML)
    return at


def test_a_folder_becomes_a_recording(folder, tmp_path, capsys):
    assert main(["check", str(folder)]) == 0
    assert "complete; 2 strips with images, ground at 612.3 m" in capsys.readouterr().out
    assert main(["check", str(folder), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert (checked["strips"], checked["ground_height_m"], checked["sensors"]) == (2, GROUND, {})
    out = tmp_path / "o.mcap"
    assert main(["import", str(folder), "-o", str(out)]) == 0
    told = capsys.readouterr().out
    assert "control.csv: median height 612.3 m above the ellipsoid is the origin's" in told and "--position" not in told
    reader = RecordingReader(out)
    project = next(iter(reader.messages(["configuration/project"]))).body
    assert (project.name, project.crs, project.origin_height) == ("valley", "EPSG:32632", GROUND)
    np.testing.assert_allclose(project.lever_arm_m, [0.1, 0.0, -1.8])
    np.testing.assert_allclose(project.offset_sigma_m, [0.03, 0.03, 0.05])  # RTK
    np.testing.assert_allclose(project.shift_sigma_deg, [0.004, 0.004, 0.008])  # stated
    np.testing.assert_allclose(project.drift_sigma_deg, [0.002, 0.002, 0.005])  # tactical
    assert project.wander_time_s == 60.0 and project.attitude_wander_time_s == 20.0  # of the GNSS; stated
    camera = next(iter(reader.messages(["configuration/camera"]))).body
    assert [line.id for line in camera.lines] == ["F", "N", "B"]
    control = [message.body for message in reader.messages(["observation/control"])]
    frame = local_frame(project)
    for i, point in enumerate(control):
        lat, lon, height = frame.to_geodetic([point.x, point.y, point.z])
        np.testing.assert_allclose([lat, lon], [LAT + 0.001 * i, LON + 0.001 * i], atol=1e-7)
        assert height == pytest.approx(GROUND + (-10, 0, 30)[i], abs=1e-3)
    assert control[1].z == pytest.approx(0.0, abs=0.1)  # the ground is at the origin's height
    first = next(iter(reader.messages(["trajectory/smoothed"]))).body
    pose = pose_sample(first)
    assert pose.time_ns == ns(START) and pose.position_l[2] == pytest.approx(2000 - GROUND - 0.3, abs=0.05)
    np.testing.assert_allclose(np.sqrt(np.diag(pose.covariance)[0]), np.hypot(0.03, 0.02), rtol=1e-6)
    strips = [message.body for message in reader.messages(["configuration/strip"])]
    assert [(s.id, s.lines, s.ended) for s in strips] == [
        ("S1", 50, False), ("S1", 50, True), ("S2", 20, False), ("S2", 20, True)
    ]  # fmt: skip
    blocks = [message.body for message in reader.messages(["sensor/lines/N"])]
    assert blocks[-1].strip == "S2" and blocks[-1].pixels.dtype == np.uint16
    assert load(folder / "flight.toml", ["matcher"]) == {"matcher": {"image_sigma_px": 0.04, "ground_m": 5.0}}


def test_strips_that_are_imaged_at_the_same_time_are_told(folder, capsys):
    """A time taken over from another strip, or a second camera: nothing said why the matcher found no tie point."""
    (folder / "flight.toml").write_text(TOML.replace("12:00:03Z", "12:00:00.5Z"))
    assert main(["check", str(folder)]) == 0
    (told,) = [line for line in capsys.readouterr().out.splitlines() if "at the same time" in line]
    assert "strips S1 and S2 are imaged at the same time" in told


def test_the_origin_lies_on_the_ground_by_raster_or_height_above_it(folder, tmp_path, capsys):
    place = rasterio.Affine(0.002, 0, LON - 0.1, 0, -0.002, LAT + 0.1)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=100, height=100, count=1, dtype="float32", crs="EPSG:4326",
        transform=place,
    ) as file:  # fmt: skip
        file.write(np.full((1, 100, 100), 431.5, np.float32))
    poses, out = str(folder / "poses.csv"), tmp_path / "o.mcap"
    dem = ["--dem", str(folder / "dem.tif"), "--dem-crs", "ellipsoid"]
    for arguments, height in (
        (dem, 431.5),
        (["--above-ground", "1400"], 600.0),
        (["--ground-height", "55"], 55.0),
        ([], 0),
    ):
        assert main(["import", poses, "-o", str(out), *arguments]) == 0
        (project,) = [m.body for m in RecordingReader(out).messages(["configuration/project"])]
        assert project.origin_height == pytest.approx(height, abs=0.06), arguments
    assert "note: median height of dem.tif under the flight" in capsys.readouterr().out
    dem[1] = str(tmp_path / "far.tif")
    with rasterio.open(folder / "dem.tif") as file:
        profile = file.profile | {"transform": rasterio.Affine(0.002, 0, LON + 1, 0, -0.002, LAT)}
        with rasterio.open(dem[1], "w", **profile) as far:
            far.write(file.read())
    for arguments, wanted in (
        (dem, "far.tif: has no height under the flight, wanted a raster of the same area"),
        (dem[:2], "does not say what its heights count from"),
        (dem[2:], "--dem-crs ellipsoid: is of a raster of heights, wanted --dem FILE with it"),
        (["--ground-height", "5", *dem], "--ground-height and --dem: wanted one of them"),
        (["--above-ground", "-5"], "--above-ground -5, wanted more than 0 m"),
        (["--ground-height", "1e5"], "--ground-height 100000, wanted metres from -500 to 9000"),
    ):
        assert main(["import", poses, "-o", str(out), *arguments]) == 1
        assert wanted in capsys.readouterr().err, arguments
    text = (folder / "flight.toml").read_text()
    (folder / "flight.toml").write_text(text + '\n[dem]\nfile = "dem.tif"\ncrs = "ellipsoid"\n')
    assert main(["check", str(folder)]) == 0
    assert "ground at 431.5 m" in capsys.readouterr().out
    (folder / "flight.toml").write_text(text + '\n[dem]\nfile = "dem.tif"\n')
    assert main(["check", str(folder)]) == 1
    assert "does not say what its heights count from, wanted dem.crs ellipsoid" in capsys.readouterr().out


def test_sensors_get_height_and_noise_from_the_folder(folder, tmp_path):
    at = folder / "sensors"
    at.mkdir()
    t = 1591012800 + np.arange(500) * 0.01
    rows = [f"{x:.2f},0,0,-9.81,0,0,0" for x in t]
    (at / "imu.csv").write_text("time_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s\n" + "\n".join(rows) + "\n")
    fixes = [f"{1591012800 + i},{LAT},{LON},2000,0.1,0.1,0.2" for i in range(6)]
    (at / "gnss.csv").write_text(
        "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m\n" + "\n".join(fixes) + "\n"
    )
    text = TOML.replace('"poses.csv"', '"sensors"') + "[imu]\ngyro_noise_deg_sqrt_h = 0.06\n"
    (folder / "flight.toml").write_text(text)
    out = tmp_path / "o.mcap"
    assert main(["import", str(folder), "-o", str(out), "-q"]) == 0
    reader = RecordingReader(out)
    assert next(iter(reader.messages(["configuration/project"]))).body.origin_height == GROUND
    imu = next(iter(reader.messages(["sensor/imu"]))).body
    assert imu.rate_sigma == pytest.approx(np.radians(0.06) / 60 / np.sqrt(imu.interval_ns * 1e-9), rel=1e-6)
    (folder / "flight.toml").write_text(text + "gyro_bias_deg_h = 5\n")
    lost = "mounting.camera_lever_arm_m, imu.gyro_bias_deg_h: a recording has no place for that; the navigator"
    assert any(lost in note for note in read_flight(folder).notes)


@pytest.mark.parametrize("beside", [True, False])
def test_a_mounting_that_the_sensor_folder_alone_states_is_asked_for(beside, folder, tmp_path, capsys):
    """Its lever arm was lost without a word; the notes spoke of zero, or of nothing."""
    at, out = (tmp_path if beside else folder) / "sensors", tmp_path / "o.mcap"
    at.mkdir()
    fixes = [f"{1591012800 + i},{LAT},{LON},2000,0.1,0.1,0.2" for i in range(6)]
    head = "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m\n"
    (at / "gnss.csv").write_text(head + "\n".join(fixes) + "\n")
    (at / "platform.toml").write_text(
        "lever_arm_m = [0.2, 0, -1.5]\nboresight_deg = [0, 0.3, 0]\n[imu]\ngyro_noise_deg_sqrt_h = 7\n"
        "[gnss]\nwander_sigma_m = [1, 1, 2]\n"
    )
    text = TOML.replace('"poses.csv"', '"sensors"')
    command = ["import", *([str(at), "--flight"] if beside else []), str(folder), "-o", str(out)]
    (folder / "flight.toml").write_text(text)
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "note: platform.toml: boresight_deg [0, 0.3, 0] is not used: mounting.boresight_deg of flight.toml" in told
    assert "platform.toml: [imu] is not used: " in told and "platform.toml: [gnss] is not used: " in told
    assert "platform.toml: lever_arm_m" not in told  # the same in both
    project = next(iter(RecordingReader(out).messages(["configuration/project"]))).body
    np.testing.assert_allclose(project.boresight_deg, [0.0, 0.1, 0.0])
    (folder / "flight.toml").write_text(text.replace("lever_arm_m = [0.2, 0.0, -1.5]\n", "", 1))
    assert main(command) == 1
    wanted = f"mounting.lever_arm_m: missing, but {at / 'platform.toml'} says [0.2, 0, -1.5]: wanted one"
    assert wanted in capsys.readouterr().err


@pytest.mark.parametrize("whole", [True, False])
def test_tables_of_sensors_are_read_once(whole, folder, tmp_path, monkeypatch):
    """With images and a height above the ground they were read three times, four times of a flight folder."""
    at, out = folder / "sensors", tmp_path / "o.mcap"
    at.mkdir()
    rows = [f"{1591012800 + 0.01 * i:.2f},0,0,-9.81,0,0,0" for i in range(500)]
    (at / "imu.csv").write_text("time_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s\n" + "\n".join(rows) + "\n")
    fixes = [f"{1591012800 + i},{LAT},{LON},{2000 + i},0.1,0.1,0.2" for i in range(6)]
    head = "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m\n"
    (at / "gnss.csv").write_text(head + "\n".join(fixes) + "\n")
    text = TOML.replace('"poses.csv"', '"sensors"').replace("[camera]", "above_ground_m = 1400.0\n[camera]", 1)
    (folder / "flight.toml").write_text(text)
    read = []

    def counted(path, *more, **others):
        read.append(path.name)
        return read_table(path, *more, **others)

    monkeypatch.setattr("triline.nodes.formats.sensor_folder.read_table", counted)
    more = ["--lines", f"N={folder / 'nadir.img'}", "--first-time", f"{START}Z", "--line-rate", "50"]
    words = [str(folder)] if whole else [str(at), *more, "--above-ground", "1400"]
    assert main(["import", *words, "-o", str(out), "-q"]) == 0
    assert sorted(read) == ["gnss.csv", "imu.csv"]
    reader = RecordingReader(out)
    assert next(iter(reader.messages(["configuration/project"]))).body.origin_height == 602.5  # 2002.5 less 1400
    assert len(list(reader.messages(["sensor/gnss"]))) == 6


def test_lines_and_sensors_of_different_times_are_told(folder, tmp_path, capsys):
    at = folder / "sensors"
    at.mkdir()
    text = TOML.replace('"poses.csv"', '"sensors"')

    def sensors(begin_s, seconds):
        t = begin_s + np.arange(int(100 * seconds)) * 0.01
        rows = [f"{x:.2f},0,0,-9.81,0,0,0" for x in t]
        head = "time_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s"
        (at / "imu.csv").write_text("\n".join([head, *rows]) + "\n")
        fixes = [f"{begin_s + i},{LAT},{LON},2000,0.1,0.1,0.2" for i in range(int(seconds) + 1)]
        (at / "gnss.csv").write_text(
            "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m\n" + "\n".join(fixes) + "\n"
        )

    (folder / "flight.toml").write_text(text)
    sensors(1591012800 - 7200, 5.0)  # two hours off
    problems = read_flight(folder).problems
    assert any("strip S1: lines from 2020-06-01T12:00:00Z" in p and "but sensors from" in p for p in problems)
    sensors(1591012800 + 0.5, 5.0)
    flight = read_flight(folder)
    assert not flight.problems
    notes = [note for strip in flight.strips for note in strip.notes]
    assert any("strip S1: 25 of 50 lines outside the time of the sensors: without orientation" in n for n in notes)
    (at / "gnss.csv").unlink()
    (problem,) = (p for p in read_flight(folder).problems if "gnss.csv" in p)
    assert problem.endswith("gnss.csv: no such file, wanted GNSS positions")


def test_no_line_is_outside_of_poses_for_the_rounding_of_their_times(folder):
    """Of poses of each line, which another program wrote, the last one was a nanosecond too early."""
    strip = read_flight(folder).strips[0]
    first, last = int(strip.time_ns[0]), int(strip.time_ns[-1])
    assert within([strip], first + 900, last - 900, "poses")[0].notes == strip.notes
    (note,) = within([strip], first, last - 2000, "poses")[0].notes[len(strip.notes) :]
    assert "1 of 50 lines outside the time of the poses" in note


def test_a_vertical_datum_without_a_geoid_is_refused(folder):
    """No grid of it can be missing, and its heights would count as ellipsoidal ones."""
    (folder / "flight.toml").write_text(TOML.replace('vertical_datum = "ellipsoid"', 'vertical_datum = "EPSG:5705"'))
    (problem,) = read_flight(folder).problems
    assert "flight.vertical_datum: PROJ knows no geoid of 'Baltic 1977 height': heights would be off by it" in problem


@pytest.mark.parametrize(
    "crs",
    [
        "WGS 84 / UTM zone 32N",
        "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs",
        "+proj=utm +zone=32 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0 +units=m +no_defs",
        pyproj.CRS("EPSG:32632").to_wkt(),
        pyproj.CRS("EPSG:32632").to_wkt("WKT1_GDAL"),
    ],
)
def test_heights_of_a_crs_that_is_no_code(folder, crs):
    """PROJ passes over what stands behind WKT or a PROJ string: control counted as ellipsoidal, off by the geoid."""
    toml = TOML.replace('"EPSG:32632"', f"'{crs}'").replace(
        'vertical_datum = "ellipsoid"', 'vertical_datum = "EPSG:5705"'
    )
    (folder / "flight.toml").write_text(toml)
    flight = read_flight(folder)
    assert ["Baltic 1977 height" in problem for problem in flight.problems] == [True]
    flat, heights = pyproj.CRS(flight.crs).sub_crs_list
    assert flat.utm_zone == "32N" and heights.to_epsg() == 5705
    (folder / "flight.toml").write_text(toml.replace("EPSG:5705", "ellipsoid"))
    assert read_flight(folder).problems == []


def test_control_far_from_the_flight_is_refused(folder):
    """Such as that of another UTM zone: the flight went on without a word, and found no tie points."""
    zone = next(text for text in ("EPSG:32632", "EPSG:32633") if text in TOML)
    (folder / "flight.toml").write_text(TOML.replace(zone, "EPSG:32635"))
    (problem,) = read_flight(folder).problems
    assert problem.startswith("control.csv: no point lies within ") and "flight.crs (EPSG:32635)" in problem


@pytest.mark.parametrize("heights", [1, 0])
def test_control_without_a_height(heights, folder):
    """As planimetric points have it: the flight was refused, with coordinates "outside the area" of its CRS."""
    rows = (folder / "control.csv").read_text().splitlines()
    for i in range(1, len(rows) - heights):
        point, x, y, *_ = rows[i].split(",")
        rows[i] = f"{point},{x},{y},,0.05,0.05,,planimetric"
    (folder / "control.csv").write_text("\n".join([*rows, ""]))
    flight = read_flight(folder)
    assert not flight.problems
    assert f"{3 - heights} points without height were put at {heights * (GROUND + 30):.1f} m" in "".join(flight.notes)
    points, frame = read_ground_points(folder / "control.csv", "EPSG:32632", None, [])
    place = frame.to_geodetic(points.xyz_l)
    np.testing.assert_allclose(place[:, 0], LAT + 0.001 * np.arange(3), atol=1e-7)
    np.testing.assert_allclose(place[:, 2], heights * (GROUND + 30), atol=1e-3)


def test_lines_with_a_pose_each_need_no_times(folder, tmp_path):
    """AVIRIS-NG: gpstime, lat, lon, alt, pitch, roll, heading of each line; the poses make no strip of their own."""
    records = [(129618 + i / 100, LAT + 9e-6 * i, LON, 2000.0, 0.0, 0.0, 0.0) for i in range(50)]
    np.array(records, dtype="<f8").tofile(folder / "ang20200601t120000_eph_att")
    text = TOML[: TOML.index('[[strips]]\nid = "S2"')].replace('line_times = "times.csv"', "")
    (folder / "flight.toml").write_text(text.replace('"poses.csv"', '"ang20200601t120000_eph_att"'))
    out = tmp_path / "o.mcap"
    assert main(["import", str(folder), "-o", str(out), "-q"]) == 0
    reader = RecordingReader(out)
    assert [message.body.id for message in reader.messages(["configuration/strip"])] == ["S1", "S1"]
    blocks = [message.body for message in reader.messages(["sensor/lines/F"])]
    assert np.concatenate([block.times_ns() for block in blocks])[49] == ns(START) + 490_000_000


def test_new_check_import_of_an_empty_folder(tmp_path, capsys):
    at = tmp_path / "new"
    assert main(["new", "flight", str(at)]) == 0
    assert "fill it in" in capsys.readouterr().out
    assert main(["new", "flight", str(at)]) == 1
    assert "flight.toml: is there already, and is not overwritten" in capsys.readouterr().err
    assert main(["check", str(at)]) == 1
    out, err = capsys.readouterr()
    for wanted in (
        "flight.toml: camera.file: no camera.json in the folder",
        "flight.toml: navigation.file: no navigation.csv in the folder",
        "flight.toml: neither [control] nor flight.ground_height_m, wanted one",
        "note: flight.toml: no [[strips]]",
    ):
        assert wanted in out
    assert "3 to be mended" in err
    assert main(["check", str(at), "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)["problems"]) == 3
    assert main(["import", str(at), "-o", str(tmp_path / "o.mcap")]) == 1
    err = capsys.readouterr().err
    assert "no camera.json in the folder (and 2 more" in err and err.count("\n") == 1
    assert main(["check", str(tmp_path)]) == 1
    assert "no flight.toml; `triline new flight" in capsys.readouterr().err


WRONG = {
    "time of the first line": (
        "first_time = 2020-06-01T12:00:03Z",
        'first_time = "1.6.2020 12:00:03"',
        "flight.toml: strips[1].first_time: '1.6.2020 12:00:03', wanted an ISO 8601 time",
    ),
    "vertical datum absent": (
        'vertical_datum = "ellipsoid"\n',
        "",
        "flight.vertical_datum: missing, wanted a vertical CRS",
    ),
    "vertical datum not vertical": (
        '"ellipsoid"',
        '"EPSG:32632"',
        "flight.vertical_datum: 'EPSG:32632', wanted a vertical",
    ),
    "CRS unknown": ('"EPSG:32632"', '"EPSG:9"', "flight.crs: PROJ does not know the CRS 'EPSG:9"),
    "CRS vertical": (
        '"EPSG:32632"',
        '"EPSG:5773"',
        "flight.crs: crs 'EPSG:5773': a vertical system, wanted a projected",
    ),
    "CRS local": ('"EPSG:32632"', '"local"', "flight.crs: 'local', wanted one that PROJ understands"),
    "camera and preset": ('"camera.json"', '"camera.json"\npreset = "ads40"', "camera: wanted either file"),
    "no such preset": ('file = "camera.json"', 'preset = "x"', "camera.preset: 'x', wanted one of"),
    "lever arm in mm": (
        "[0.2, 0.0, -1.5]",
        "[200, 0, -1500]",
        "mounting.lever_arm_m: [200, 0, -1500], wanted metres within",
    ),
    "boresight of many turns": (
        "[0.0, 0.1, 0.0]",
        "[0, 0, 1e9]",
        "mounting.boresight_deg: [0, 0, 1000000000.0], wanted",
    ),
    "ground in space": (
        '"ellipsoid"\n',
        '"ellipsoid"\nground_height_m = 1e9\n',
        "flight.ground_height_m: 1000000000.0, wanted metres from -500 to 9000",
    ),
    "two grounds": (
        '"ellipsoid"\n',
        '"ellipsoid"\nground_height_m = 600\nabove_ground_m = 1400\n',
        "flight.above_ground_m and flight.ground_height_m: wanted one of them",
    ),
    "rate of a bag": ('"RTK"', '"RTK"\nline_rate_hz = 50', "navigation.line_rate_hz: goes with a ROS 2 bag, not with"),
    "topics of a bag": ('"RTK"', '"RTK"\nimages = {N = "/n"}', "navigation.images: goes with a ROS 2 bag, not with"),
    "wander below zero": (
        "attitude_wander_time_s = 20",
        "wander_sigma_m = [0, 0, -1]",
        "trajectory.wander_sigma_m: [0, 0, -1], wanted 3 numbers of at least 0",
    ),
    "two numbers": ("[0.0, 0.1, 0.0]", "[0.0, 0.1]", "mounting.boresight_deg: [0.0, 0.1], wanted 3 numbers"),
    "another day": (
        "2020-06-01\ngnss",
        "2020-06-04\ngnss",
        "poses.csv: GPS seconds of the week say Monday, but 2020-06-04",
    ),
    "day in quotes": ("date = 2020-06-01", 'date = "2020-06-01"', "navigation.date: '2020-06-01', wanted a day"),
    "grade": ('"RTK"', '"good"', "navigation.gnss: 'good', wanted one of RTK, PPP, code"),
    "sigma of zero": ("0.004, 0.004", "0, 0.004", "trajectory.shift_sigma_deg: [0, 0.004, 0.008], wanted 3 positive"),
    "misspelled": ("boresight_deg", "boresigth_deg", "mounting.boresigth_deg: not known, wanted lever_arm_m"),
    "no control file": ('"control.csv"', '"gcp.csv"', "control.file: no gcp.csv in the folder"),
    "a name that no file can have": ('"control.csv"', f'"{"9" * 400}"', f"control.file: no {'9' * 200} in the folder"),
    "no image": ('"nadir.img"', '"n.img"', "images.N: no n.img in the folder"),
    "CCD line": ('images = {N = "nadir.img"}', 'images = {X = "nadir.img"}', "CCD line 'X' is not in the camera"),
    "no times": ('line_times = "times.csv"', "", "strips[0]: times of the lines missing, wanted line_times"),
    "rate of zero": ("line_rate_hz = 50", "line_rate_hz = 0", "line_rate_hz: 0, wanted a number above 0"),
    "another hour": ("T12:00:03Z", "T14:00:03Z", "strip S2: lines from 2020-06-01T14:00:03Z to"),
    "strip twice": ('"S2"', '"S1"', "strips: 'S1' comes twice"),
    "node unknown": ("[nodes.matcher]", "[nodes.macher]", "nodes.macher: {'ground_m': 5.0}, wanted a node"),
    "setting unknown": ("ground_m = 5.0", "ground = 5.0", "[matcher]: ground is not known, wanted one of"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_said_once_and_nothing_else(folder, what):
    old, new, wanted = WRONG[what]
    assert TOML.count(old) == 1
    (folder / "flight.toml").write_text(TOML.replace(old, new))
    problems = read_flight(folder).problems
    n = 2 if what == "another day" else 1  # of the poses and of the lines
    assert len(problems) == n and wanted in problems[0] and "\n" not in problems[0], problems


def test_images_of_a_strip_that_are_missing_are_counted(folder):
    for images, wanted in (
        ("F = 'f.img', N = 'nadir.img', B = 'b.img'", "2 files are not in the folder: f.img, b.img"),
        ("F = 'x.img@1', N = 'x.img@2', B = 'b.img'", "2 files are not in the folder: x.img, b.img"),
        (
            "F = '1.img', N = '2.img', B = '3.img', C = '4.img'",
            "4 files are not in the folder: 1.img, 2.img, 3.img and 1 more",
        ),
    ):
        (folder / "flight.toml").write_text(TOML.replace('N = "nadir.img"', images))
        assert read_flight(folder).problems == [f"{folder / 'flight.toml'}: strips[1].images: {wanted}"]


def test_zeros_say_that_nothing_wanders(folder):
    (folder / "flight.toml").write_text(TOML.replace("[trajectory]", "[trajectory]\nwander_sigma_m = [0, 0, 0]"))
    flight = read_flight(folder)
    assert not flight.problems and flight.sigmas["wander_sigma_m"] == (0.0, 0.0, 0.0)


def test_the_height_of_the_ground_is_told_once(folder, tmp_path, capsys):
    (folder / "flight.toml").write_text(TOML.replace('"ellipsoid"\n', '"ellipsoid"\nabove_ground_m = 1400\n', 1))
    assert main(["import", str(folder), "-o", str(tmp_path / "out.mcap")]) == 0
    assert capsys.readouterr().out.count("median height of the flight less 1400 m: the ground is taken to be") == 1


def test_an_elevation_model_without_datum_is_asked_for_it(folder):
    write_heights(folder / "dem.tif", Heights("EPSG:4326", np.zeros((4, 4)), LON - 0.15, LAT + 0.15, 0.1, -0.1))
    table = '[dem]\nfile = "dem.tif"\nsigma_m = 0.5\n'
    for more, wanted in (
        ("", "does not say what its heights count from, wanted dem.crs ellipsoid"),
        ('crs = "EPSG:32632"\n', "dem.crs EPSG:32632: says nothing of heights"),
        ("sigma = 1\n", "dem.sigma: not known, wanted file, crs"),
    ):
        (folder / "flight.toml").write_text(TOML + table + more)
        problems = read_flight(folder).problems
        assert any(wanted in line for line in problems) and "\n" not in "".join(problems), problems
    (folder / "flight.toml").write_text(TOML + table + 'crs = "ellipsoid"\n')
    assert not read_flight(folder).problems
    assert load(folder / "flight.toml")["adjuster"] == {
        "dem": str(folder / "dem.tif"), "dem_sigma_m": 0.5, "dem_crs": "ellipsoid",
    }  # fmt: skip
    (folder / "flight.toml").write_text(TOML + '[dem]\nfile = "dem.tif"\ncrs = "ellipsoid"\n')  # for other things
    assert not read_flight(folder).problems and "adjuster" not in load(folder / "flight.toml")
    above = TOML.replace('"ellipsoid"\n', '"ellipsoid"\nabove_ground_m = 1400\n') + table + 'crs = "ellipsoid"\n'
    (folder / "flight.toml").write_text(above)
    assert "flight.above_ground_m and [dem]: wanted one of them" in read_flight(folder).problems[0]
    (folder / "dem.tif").unlink()
    assert "dem.file: no dem.tif in the folder" in read_flight(folder).problems[0]


def test_options_that_the_folder_says(folder, tmp_path, capsys):
    assert main(["import", str(folder), "-o", str(tmp_path / "o.mcap"), "--crs", "EPSG:32633"]) == 1
    assert "--crs does not go with a flight folder: it stands in flight.toml" in capsys.readouterr().err
    (folder / "flight.toml").write_text("[flight\n")
    assert main(["check", str(folder)]) == 1
    assert "flight.toml: not valid TOML" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("date = 2020-06-01\n", ""), "(GPS seconds without a day count from 1980-01-06, wanted navigation.date)"),
        (("date = 2020-06-01\n", "date = 2020-06-04\n"), "times.csv: navigation.date 2020-06-04, but its times begin"),
        (('N = "nadir.img"', 'N = "dim.img"'), "wanted their range: grey_range = [LOW, HIGH]"),
        (('N = "nadir.img"', 'N = "all.img"'), 'wanted one of them (band = "2") or a sum (band = "2:0.5,3:0.5")'),
        (('N = "nadir.img"', 'N = "flight.toml"'), "a TIFF, or type (u1, u2 or >u2)"),
    ],
)
def test_what_is_wrong_is_told_with_keys_and_no_options(folder, capsys, change, told):
    """Options of `triline import` are refused beside a flight folder."""
    write_image(folder / "dim.img", np.random.default_rng(2).random((20, 7, 1)).astype("f4"))
    (folder / "flight.toml").write_text(TOML.replace(*change))
    assert main(["check", str(folder)]) == 1
    said = capsys.readouterr()
    assert told in said.out and "--" not in said.out, said.out


# -- data that are not in the folder -------------------------------------------------------------------------------


def test_poses_beside_a_folder_take_the_place_of_its_navigation(folder, tmp_path, capsys):
    within, beside = tmp_path / "within.mcap", tmp_path / "beside.mcap"
    assert main(["import", str(folder), "-o", str(within), "-q"]) == 0
    (tmp_path / "office").mkdir()
    poses = (folder / "poses.csv").rename(tmp_path / "office" / "poses.csv")
    assert main(["import", str(poses), "--flight", str(folder), "-o", str(beside)]) == 0
    assert f"{poses} (trajectory as CSV) with {folder} -> {beside}" in capsys.readouterr().out
    assert beside.read_bytes() == within.read_bytes()


def test_poses_of_a_flight_that_was_live(folder, tmp_path, capsys):
    """Its folder has sensors and announced strips; the poses come from the office, GPS seconds with their day."""
    poses = (folder / "poses.csv").rename(tmp_path / "poses.csv")
    live = TOML.replace('file = "poses.csv"\ndate = 2020-06-01\n', "").partition("[[strips]]")[0]
    live += '[[strips]]\nid = "S1"\n[[sensor]]\nkind = "stream"\naddress = "listen://127.0.0.1:5555"\n'
    (folder / "flight.toml").write_text(live)
    out = tmp_path / "o.mcap"
    day = ["--date", "2020-06-01"]
    assert main(["import", str(poses), "--flight", str(folder), "-o", str(out), "--json", *day]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["flight"] == str(folder) and told["messages"]["observation/control"] == 3
    assert "flight.toml: strips[0].id: 'S1' has no images: the recording has no lines of it" in told["notes"]
    reader = RecordingReader(out)
    assert next(iter(reader.messages(["trajectory/smoothed"]))).stamp_ns == ns(START)
    lines = ["--lines", f"N={folder / 'nadir.img'}", "--first-time", "2020-06-01T12:00:03Z", "--line-rate", "50"]
    assert main(["import", str(poses), "--flight", str(folder), "-o", str(out), "-q", *day, *lines]) == 0
    strips = [message.body for message in RecordingReader(out).messages(["configuration/strip"])]
    assert [(s.id, s.lines) for s in strips] == [("nadir", 20)] * 2


def test_image_lines_beside_a_folder_take_the_place_of_its_strips(folder, tmp_path, capsys):
    image = folder / "nadir.img"
    out = tmp_path / "o.mcap"
    times = ["--first-time", "2020-06-01T12:00:02Z", "--line-rate", "40", "--strip", "S9"]
    command = ["import", str(image), "--flight", str(folder), "-o", str(out)]
    assert main([*command, "--lines", f"N={image}", *times]) == 0
    assert "no image of the CCD lines F, B of the camera" in capsys.readouterr().out
    reader = RecordingReader(out)
    strips = [message.body for message in reader.messages(["configuration/strip"])]
    assert [(s.id, s.lines, s.line_rate_hz) for s in strips] == [("S9", 20, 40.0)] * 2
    assert len(list(reader.messages(["trajectory/smoothed"]))) == 6
    late = [*times[:1], "2020-06-01T14:00:02Z", *times[2:]]
    assert main([*command, "--lines", f"N={image}", *late]) == 1
    assert "strip S9: lines from 2020-06-01T14:00:02Z" in capsys.readouterr().err
    assert main(command) == 1
    assert "its CCD line is not said, wanted --lines F=nadir.img" in capsys.readouterr().err


def test_what_does_not_go_beside_a_folder(folder, tmp_path, capsys):
    poses, out = str(folder / "poses.csv"), str(tmp_path / "o.mcap")
    block = tmp_path / "block"
    block.mkdir()
    for name in ("camera.json", "strips.csv", "trajectory.csv", "ground_points.csv", "image_points.csv"):
        (block / name).write_text("")
    for arguments, told in (
        ([poses, "--flight", str(folder), "--camera", "ads40"], "--camera does not go with --flight: it stands in "),
        ([poses, "--flight", str(tmp_path)], "no flight.toml; `triline new flight"),
        ([str(block), "--flight", str(folder)], "--flight: goes with poses, sensors, a ROS 2 bag or image lines, not "),
        ([str(folder), "--flight", str(folder)], "not with flight folder (flight.toml)"),
    ):
        assert main(["import", *arguments, "-o", out]) == 1
        error = capsys.readouterr().err
        assert told in error and error.count("\n") == 1, error
    lines = ["--lines", f"N={folder / 'nadir.img'}"]
    for more, told in (  # by the names of options that were given, and not of keys
        (lines, "times of its lines are missing, wanted --line-times CSV, or --first-time and --line-rate"),
        (["--date", "2019-01-01"], "--date"),
    ):
        (folder / "dated.csv").write_text((folder / "poses.csv").read_text().replace("gps_s", "time_s"))
        source = poses if more is lines else str(folder / "dated.csv")
        assert main(["import", source, "--flight", str(folder), "-o", out, *more]) == 1
        assert told in (error := capsys.readouterr().err) and "navigation.date" not in error, error
    (folder / "camera.json").unlink()
    assert main(["import", poses, "--flight", str(folder), "-o", out]) == 1
    assert "camera.file: no camera.json in the folder" in capsys.readouterr().err
