"""Navigation solutions of other programs: values, times, frames, damaged files."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from places import DATA, needs_data
from tracks import ns, straight_track

from triline.nodes.cli import main
from triline.nodes.convert import pose_sample
from triline.nodes.errors import UserError
from triline.nodes.formats.avirisc import read_avirisc, utm_zone
from triline.nodes.formats.avirisng import read_avirisng
from triline.nodes.formats.detect import kind_of_path, read_any
from triline.nodes.formats.gps_time import GPS_EPOCH_S, WEEK_S, gps_from_utc_ns, gps_week, unwrap_weeks, utc_ns_from_gps
from triline.nodes.formats.line_orientation import OrientedLines, write_oriented_lines
from triline.nodes.formats.pos_export import mapping_frame, read_pos_export
from triline.nodes.formats.sbet import read_sbet, write_sbet
from triline.nodes.formats.track import Accuracy, Mounting, NavigationTrack, camera_poses, frame_of, track_messages
from triline.nodes.formats.trajectory_csv import read_poses_of_strips, read_trajectory_csv
from triline.nodes.recording.reader import RecordingReader
from triline.solver.geometry.frames import LocalFrame, R_lc_from_navigation, navigation_from_R_lc
from triline.solver.geometry.rotation import (
    R_BC_NOMINAL,
    angles_from_matrix,
    matrix_from_angles,
    matrix_from_navigation,
    matrix_from_quaternion,
)

AVIRIS_NG = DATA / "avirisng" / "ang20170323t202244_eph_att"
AVIRIS_C = DATA / "avirisng" / "f180522t01p00r07_eph"
AVIRIS_C_LONLAT = DATA / "avirisng" / "f180522t01p00r07rdn_e_lonlat_eph"
POS = DATA / "pospac" / "s251_sbet_subset.txt"


# ---- GPS time


def test_gps_time_of_known_instants():
    assert gps_week(date(1980, 1, 6)) == (0, 0)
    assert gps_week(date(2017, 3, 23)) == (1941, 4)  # a Thursday
    assert gps_week(date(2019, 4, 7)) == (2048, 0)  # the second roll-over of ten bits
    assert utc_ns_from_gps(2048, [18.0])[0] == ns("2019-04-07T00:00:00")
    for day, seconds in (("1980-01-06", 0), ("2000-01-01", 13), ("2016-12-31", 17), ("2017-01-01", 18)):
        utc_ns = ns(f"{day}T00:00:00")
        week, of_week = gps_from_utc_ns(utc_ns)
        assert GPS_EPOCH_S + week * WEEK_S + of_week[0] - utc_ns // 10**9 == seconds


def test_gps_time_over_a_leap_second():
    """The leap second itself has no nanoseconds since the epoch of its own; the seconds about it have."""
    utc = ns("2016-12-31T23:59:58") + np.array([0, 1, 2, 3]) * 10**9
    week, seconds = gps_from_utc_ns(utc)
    np.testing.assert_allclose(np.diff(seconds), [1, 2, 1])
    np.testing.assert_array_equal(utc_ns_from_gps(week, seconds), utc)


def test_weeks_go_on():
    np.testing.assert_allclose(unwrap_weeks([604799.5, 604799.9, 0.3]), [604799.5, 604799.9, 604800.3])


# ---- the camera on the body


def test_lever_arm_and_boresight():
    track = straight_track()
    track = NavigationTrack("t", track.time_ns, track.geodetic, np.radians(np.tile([0.0, 0.0, 90.0], (50, 1))))
    frame = frame_of(track)
    plain, R, _ = camera_poses(track, frame)
    moved, _, _ = camera_poses(track, frame, Mounting(lever_arm_m=(1.0, 2.0, 3.0)))
    # flight to the east: forward is east, right is south, down is down (within convergence and curvature)
    np.testing.assert_allclose(moved - plain, np.tile([1.0, -2.0, -3.0], (50, 1)), atol=2e-3)
    np.testing.assert_allclose(R[25] @ [1, 0, 0], [1, 0, 0], atol=1e-3)  # x of the image along flight
    np.testing.assert_allclose(R[25] @ [0, 0, 1], [0, 0, 1], atol=1e-3)  # z up
    turned = camera_poses(track, frame, Mounting(boresight_deg=(0.0, 0.0, 90.0)))[1]
    np.testing.assert_allclose(turned[25] @ [1, 0, 0], [0, -1, 0], atol=1e-3)  # heading on: south


def test_sigmas_become_a_covariance():
    n = 50
    sigma_m, sigma_rpy = np.tile([0.1, 0.2, 0.3], (n, 1)), np.radians(np.tile([0.01, 0.02, 0.05], (n, 1)))
    track = straight_track(sigma_ned_m=sigma_m, sigma_rpy=sigma_rpy)
    covariance = camera_poses(track, frame_of(track))[2]
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    np.testing.assert_allclose(sigma[:, :3], np.tile([0.2, 0.1, 0.3], (n, 1)), rtol=1e-3)  # east, north, up
    np.testing.assert_allclose(np.degrees(sigma[:, 5]), 0.05, rtol=0.01)  # kappa is heading, nearly level
    np.testing.assert_allclose(np.linalg.eigvalsh(covariance[0])[:2], np.radians([0.01, 0.02]) ** 2, rtol=0.01)


def test_angles_come_back_from_the_messages():
    track = straight_track(line_rate_hz=10.0)
    frame = frame_of(track)
    messages = list(track_messages(track, "x", Mounting(boresight_deg=(0.3, -0.2, 1.0))))
    poses = [pose_sample(message.body) for message in messages if message.topic == "trajectory/smoothed"]
    position = np.array([pose.position_l for pose in poses])
    R = matrix_from_quaternion(np.array([pose.quaternion for pose in poses]))
    rpy = navigation_from_R_lc(frame, position, R, Mounting(boresight_deg=(0.3, -0.2, 1.0)).R_bc)
    np.testing.assert_allclose(rpy, track.rpy, atol=1e-12)
    np.testing.assert_allclose(frame.to_geodetic(position), track.geodetic, rtol=1e-12)
    assert [pose.time_ns for pose in poses] == track.time_ns.tolist()
    assert [message.stamp_ns for message in messages] == sorted(message.stamp_ns for message in messages)
    speed = np.linalg.norm([[v.x, v.y, v.z] for v in (messages[i].body.velocity for i in range(5, 40))], axis=1)
    np.testing.assert_allclose(speed, 100, rtol=0.05)


def test_accuracy_where_the_file_gives_none():
    """Poses get it as covariance, the project as a-priori sigmas of slow errors; what the file says goes before."""
    accuracy = Accuracy((0.5, 0.6, 0.7), (0.01, 0.02, 0.03))
    n = 50
    known = straight_track(sigma_ned_m=np.tile([0.1, 0.2, 0.3], (n, 1)), sigma_rpy=np.radians(np.full((n, 3), 0.1)))
    for track, wanted_m in ((straight_track(), [0.5, 0.6, 0.7]), (known, [0.2, 0.1, 0.3])):
        messages = list(track_messages(track, "x", accuracy=accuracy))
        project, pose = messages[0].body, pose_sample(messages[5].body)
        np.testing.assert_allclose(project.offset_sigma_m, wanted_m, rtol=1e-3)
        np.testing.assert_allclose(np.sqrt(np.diagonal(pose.covariance))[:3], wanted_m, rtol=1e-3)
        np.testing.assert_allclose(np.degrees(np.sqrt(pose.covariance[5, 5])), project.shift_sigma_deg[2], rtol=1e-3)
    stated = replace(accuracy, position_stated=True, attitude_stated=True)
    project = next(iter(track_messages(known, "x", accuracy=stated))).body
    np.testing.assert_allclose([*project.offset_sigma_m, *project.drift_sigma_deg], [0.5, 0.6, 0.7, 0.01, 0.02, 0.03])


@pytest.mark.parametrize(
    ("option", "wanted"),
    [("--position-sigma", [0.5, 0.6, 0.7, 0.1, 0.2, 0.3]), ("--attitude-sigma", [0.2, 0.1, 0.3, 0.5, 0.6, 0.7])],
)
def test_an_accuracy_that_is_stated_leaves_the_other_one_of_the_file(option, wanted, tmp_path):
    """Only what the user states takes the place of what the file says; heading north, omega is pitch and phi roll."""
    path, out = tmp_path / "a.csv", tmp_path / "a.mcap"
    rows = [f"2024-05-17T09:30:{s:02d}Z,{48 + 0.0005 * s},11,900,0,0,0,0.1,0.2,0.3,0.2,0.1,0.3" for s in range(4)]
    head = "time,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_n_m,sigma_e_m,sigma_d_m,"
    path.write_text("\n".join([head + "sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg", *rows, ""]))
    assert main(["import", str(path), "-q", "-o", str(out), option, "0.5", "0.6", "0.7"]) == 0
    reader = RecordingReader(out)
    project = reader.last("configuration/project")
    np.testing.assert_allclose([*project.offset_sigma_m, *project.shift_sigma_deg], wanted, rtol=1e-3)
    pose = pose_sample(reader.last("trajectory/smoothed"))
    sigma = np.sqrt(np.diagonal(pose.covariance)) * [1.0, 1.0, 1.0, *[180.0 / np.pi] * 3]
    np.testing.assert_allclose(sigma, wanted, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "0.2 and 0.2 m, 0.01 and 0.02 deg taken (--position-sigma, --attitude-sigma)"),
        (["--position-sigma", "1", "1", "1"], "0.01 and 0.02 deg taken (--attitude-sigma)"),
        (["--attitude-sigma", "1", "1", "1"], "0.2 and 0.2 m taken (--position-sigma)"),
    ],
)
def test_what_is_assumed_of_poses_without_accuracies_is_told(options, told, tmp_path, capsys):
    path = tmp_path / "a.csv"
    rows = [f"2024-05-17T09:30:{s:02d}Z,{48 + 0.0005 * s},11,900,0,0,0" for s in range(4)]
    path.write_text("\n".join(["time,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg", *rows, ""]))
    assert main(["import", str(path), "-o", str(tmp_path / "a.mcap"), *options]) == 0
    assert f"a.csv: no accuracies of the poses: {told}\n" in capsys.readouterr().out


# ---- AVIRIS-NG


def two_strips(gap_s: float, jump_m: float = 0.0) -> str:
    """60 m/s eastwards and back at 10 Hz, with a step to the north within the second strip."""
    rows = ["time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    for k in range(200):
        metres = 6.0 * k if k < 100 else 6.0 * (200 - k)
        north_m = (1000.0 if k >= 100 else 0.0) + (jump_m if k >= 150 else 0.0)
        time_s = 1.79e9 + 0.1 * k + (gap_s if k >= 100 else 0.0)
        lat, lon = 48.0 + north_m / 111_200, 9.0 + metres / 74_600
        rows.append(f"{time_s:.1f},{lat:.9f},{lon:.9f},1500,0,0,{90 if k < 100 else 270}")
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("gap_s", "jump_m", "told"),
    [
        (120.0, 0.0, []),
        (120.0, 5.0, ["two.csv: position jumps at 1 places, by 5.0 m at most, first at record 151"]),
        (0.0, 0.0, ["two.csv: position jumps at 1 places, by 1000.2 m at most, first at record 101"]),
    ],
)
def test_a_gap_between_strips_is_no_jump(tmp_path, gap_s, jump_m, told):
    """The velocity across the gap is none that was flown: the first pose behind it was said to be 6 m off."""
    path = tmp_path / "two.csv"
    path.write_text(two_strips(gap_s, jump_m))
    assert [note for note in read_trajectory_csv(path).notes if "jumps" in note] == told


def test_poses_of_a_receiver_without_a_fix_are_left_out(tmp_path):
    """At latitude 0, longitude 0 they put the origin of the local frame half way to the Gulf of Guinea."""
    path, rows = tmp_path / "two.csv", two_strips(120.0, 5.0).splitlines()
    zero = [re.sub(r",48[.]\d+,9[.]\d+,", ",0,0,", row) for row in rows[1:4]]
    path.write_text("\n".join([rows[0], *zero, *rows[4:]]) + "\n")
    track = read_trajectory_csv(path)
    assert len(track) == 197 and track.geodetic[0, 0] == 48.0
    assert "two.csv: 3 poses at latitude 0, longitude 0 (no fix) were left out" in track.notes
    assert "two.csv: position jumps at 1 places, by 5.0 m at most, first at record 151" in track.notes
    path.write_text(path.read_text().replace(rows[9], rows[9].replace(",48.", ",148.")))
    with pytest.raises(UserError, match=r"record 9: latitude: 148, wanted"):
        read_trajectory_csv(path)


@needs_data
def test_aviris_ng_poses():
    track = read_avirisng(AVIRIS_NG)
    assert len(track) == 17540 and track.name == "ang20170323t202244"
    # 418977.00417 s of GPS week 1941, less 18 leap seconds; the file name says when recording was started, 5 s later
    assert track.time_ns[0] == ns("2017-03-23T20:22:39") + 4_166_667
    assert (np.diff(track.time_ns) > 0).all()
    np.testing.assert_allclose(track.geodetic[0], [31.4980295, -114.505856, 19871.2583], rtol=1e-8)
    assert track.line_rate_hz == pytest.approx(10.767, abs=0.001)
    position, R, _ = camera_poses(track, frame_of(track))
    velocity = np.gradient(position, (track.time_ns - track.time_ns[0]) * 1e-9, axis=0)
    assert np.linalg.norm(velocity, axis=1).mean() == pytest.approx(207, abs=3)
    # the image's x axis points along flight, but for crab and pitch
    along = np.einsum("ni,ni->n", R[:, :, 0], velocity) / np.linalg.norm(velocity, axis=1)
    assert np.percentile(np.degrees(np.arccos(along)), 99) < 5.0
    # real data: the position solution jumps here and there, by tens of metres, which is told
    assert any("position jumps at" in note for note in track.notes)


@needs_data
def test_aviris_ng_to_a_recording(tmp_path, capsys):
    out = tmp_path / "ng.mcap"
    assert main(["import", str(AVIRIS_NG), "-o", str(out), "--camera", "ads40"]) == 0
    assert "17540" in capsys.readouterr().out
    reader = RecordingReader(out)
    assert reader.complete and not reader.damage
    assert reader.first("configuration/camera").name == "ads40"
    strips = [message.body for message in reader.messages(["configuration/strip"])]
    assert [(s.id, s.ended, s.lines) for s in strips] == [
        ("ang20170323t202244", False, 17540),
        ("ang20170323t202244", True, 17540),
    ]
    poses = [pose_sample(message.body) for message in reader.messages(["trajectory/smoothed"])]
    assert len(poses) == 17540 and all(pose.strip == "ang20170323t202244" for pose in poses)
    # the strip's constant rate gives the line times to a tenth of a line
    start = strips[0].first_line_time_ns
    lines = (np.array([pose.time_ns for pose in poses]) - start) * 1e-9 * strips[0].line_rate_hz
    assert np.abs(lines - np.arange(17540)).max() < 0.1


@needs_data
def test_aviris_ng_damaged(tmp_path):
    path = tmp_path / AVIRIS_NG.name
    data = AVIRIS_NG.read_bytes()
    path.write_bytes(data[:-13])
    with pytest.raises(UserError, match="982227 bytes, wanted a whole number of records of 56 bytes; truncated"):
        read_avirisng(path)
    header = AVIRIS_NG.with_name(AVIRIS_NG.name + ".hdr").read_text()
    (tmp_path / (path.name + ".hdr")).write_text(header)
    path.write_bytes(data[: 56 * 100])
    with pytest.raises(UserError, match=r"100 records, but .*hdr says 17540"):
        read_avirisng(path)
    values = np.frombuffer(data, "<f8").reshape(-1, 7)[:100].copy()
    values[16, 1] = np.nan
    (tmp_path / (path.name + ".hdr")).write_text(header.replace("17540", "100"))
    values.tofile(path)
    with pytest.raises(UserError, match="record 17: latitude: nan, wanted -90 to 90 deg"):
        read_avirisng(path)
    values[16, 1] = 31.0
    values[50, 0] = values[49, 0]
    values.tofile(path)
    track = read_avirisng(path)
    assert len(track) == 99 and any("1 poses do not come after" in note for note in track.notes)
    for old, new, wanted in (
        ("data type = 5", "data type = 4", "data type: 4, wanted 5"),
        ("bands = 7", "bands = x", "bands: 'x', wanted an integer"),
        ("interleave = bip", "interleave = bsq", "interleave: wanted bip"),
        ("ENVI\n", "ENVO\n", "not an ENVI header"),
        ("heading", "course", "band heading: missing"),
    ):
        (tmp_path / (path.name + ".hdr")).write_text(header.replace("17540", "100").replace(old, new))
        with pytest.raises(UserError, match=wanted):
            read_avirisng(path)


# ---- AVIRIS-C


@needs_data
def test_aviris_c_pair_agrees_and_headings_differ_by_the_convergence(tmp_path):
    utm, lonlat = read_avirisc(AVIRIS_C), read_avirisc(AVIRIS_C_LONLAT)
    raw = [np.fromfile(path, "<f8").reshape(-1, 6)[:, 5] for path in (AVIRIS_C, AVIRIS_C_LONLAT)]
    assert raw[0] - raw[1] == pytest.approx(0.86, abs=0.01)
    np.testing.assert_allclose(utm.geodetic, lonlat.geodetic, atol=2e-7)
    np.testing.assert_allclose(np.degrees(utm.rpy), np.degrees(lonlat.rpy), atol=1e-7)
    assert len(utm) == 1130 and utm.time_ns[0] == ns("2018-05-22T00:00:00")
    # 12 lines a second give the speed of the ER-2
    position = camera_poses(lonlat, frame_of(lonlat))[0]
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).mean() * 12 == pytest.approx(210, abs=5)
    path = tmp_path / AVIRIS_C.name
    path.write_bytes(AVIRIS_C.read_bytes())
    with pytest.raises(UserError, match=r"unknown zone, wanted --crs"):
        read_avirisc(path)
    np.testing.assert_allclose(read_avirisc(path, "EPSG:32611").rpy, utm.rpy)
    with pytest.raises(UserError, match="not a projected CRS"):
        read_avirisc(path, "EPSG:4326")
    with pytest.raises(UserError, match="PROJ does not know"):
        read_avirisc(path, "zone 11")


def test_utm_zones():
    assert utm_zone(-118.5, 35.7) == "EPSG:32611" and utm_zone(9.0, -1.0) == "EPSG:32732"
    assert utm_zone(179.9, 0.0) == "EPSG:32660" and utm_zone(-180.0, 0.0) == "EPSG:32601"


# ---- POS Export


@needs_data
def test_pos_export_values():
    track = read_pos_export(POS, date(2009, 3, 5))  # 380430 s: a Thursday
    assert len(track) == 335
    np.testing.assert_allclose(track.geodetic[0], [35.97443318, -115.13749165, 711.549])
    np.testing.assert_allclose(np.degrees(track.rpy[0]), [0.079, 0.192, 271.106])
    np.testing.assert_allclose(track.sigma_ned_m[0], [0.017, 0.017, 0.034])
    np.testing.assert_allclose(np.degrees(track.sigma_rpy[0]), [0.002, 0.002, 0.009])
    assert track.time_ns[0] == ns("2009-03-05T09:40:15") + 326_560_000  # 15 leap seconds
    assert not track.notes  # latitude and longitude agree with the mapping frame
    assert read_pos_export(POS).time_ns[0] == ns("1980-01-10T09:40:30") + 326_560_000
    with pytest.raises(UserError, match="seconds of the week say Thursday, but 2009-03-07 is a Saturday"):
        read_pos_export(POS, date(2009, 3, 7))


@needs_data
def test_pos_export_gives_east_before_north(tmp_path):
    path = tmp_path / "pos.txt"
    path.write_text(POS.read_text().replace("0.017    0.017", "0.011    0.022", 1))
    np.testing.assert_allclose(read_pos_export(path).sigma_ned_m[0], [0.022, 0.011, 0.034])


@needs_data
def test_pos_export_with_accuracies_of_the_positions_alone(tmp_path):
    path = tmp_path / "pos.txt"
    path.write_text(POS.read_text().replace("HEADING SD", "OTHER SD"))
    track = read_pos_export(path)
    np.testing.assert_allclose(track.sigma_ned_m[0], [0.017, 0.017, 0.034])
    assert track.sigma_rpy is None and not track.has_attitude_sigmas


@needs_data
def test_pos_export_with_longitudes_to_360_degrees_agrees_with_its_grid(tmp_path):
    path = tmp_path / "pos.txt"
    path.write_text(re.sub(r" -115\.(\d+)", lambda said: f" {360 - float(f'115.{said[1]}'):.8f}", POS.read_text()))
    track = read_pos_export(path, date(2009, 3, 5))
    np.testing.assert_allclose(track.geodetic[0], [35.97443318, 244.86250835, 711.549])
    assert not track.notes  # it was 32 338 796 m off


@needs_data
def test_pos_export_without_latitude(tmp_path):
    """The mapping frame of the header stands in."""
    rows = POS.read_text().splitlines()
    place = next(i for i, row in enumerate(rows) if row.startswith(" TIME"))
    names = [name.strip() for name in rows[place].split(",")]
    keep = [i for i, name in enumerate(names) if name not in ("LATITUDE", "LONGITUDE")]
    rows[place] = ", ".join(names[i] for i in keep)
    data = [" ".join(row.split()[i] for i in keep) if row[:4] == " 380" else row for row in rows[place + 1 :]]
    path = tmp_path / "pos.txt"
    path.write_text("\n".join([*rows[: place + 1], *data]))
    np.testing.assert_allclose(read_pos_export(path).geodetic, read_pos_export(POS).geodetic, atol=1e-7)
    assert mapping_frame("\n".join(rows[:place])).startswith("+proj=tmerc +lon_0=-117.000000")


@needs_data
def test_pos_export_says_its_day(tmp_path):
    path = tmp_path / "pos.txt"
    start = " Mission Start Time:\n   Date of Mission: 2009-03-05\n   Start Time: 09:12:26\n Mapping frame datum"
    path.write_text(POS.read_text().replace(" Mapping frame datum", start))
    track = read_pos_export(path)
    assert track.time_ns[0] == ns("2009-03-05T09:40:15") + 326_560_000 and not track.notes
    np.testing.assert_array_equal(read_pos_export(path, date(2009, 3, 6)).time_ns, track.time_ns)
    with pytest.raises(UserError, match="--date 2009-03-12, but its mission began on 2009-03-05"):
        read_pos_export(path, date(2009, 3, 12))


@needs_data
@pytest.mark.parametrize(
    ("units", "other", "wanted"),
    [
        ("position in Meters", "position in US Survey Feet", "position in US Survey Feet"),
        ("lat, long in Degrees", "lat, long in Radians", "long in Radians"),
        ("angles and SD in Degrees", "angles and SD in Radians", "orientation angles and SD in Radians"),
        ("position SD in Meters", "position SD in Feet", "position SD in Feet"),
        ("time in Sec", "time in UTC Sec", "time in UTC Sec"),
    ],
)
def test_pos_export_in_other_units_is_refused(tmp_path, units, other, wanted):
    path = tmp_path / "pos.txt"
    path.write_text(POS.read_text().replace(units, other))
    with pytest.raises(UserError, match=rf"pos.txt:23: {wanted}, wanted an export in seconds, metres and degrees"):
        read_pos_export(path)
    path.write_text(POS.read_text().replace("velocity in Meter/Sec", "velocity in Knots"))  # is not used
    assert len(read_pos_export(path)) == 335


@needs_data
def test_pos_export_damaged(tmp_path):
    text = POS.read_text()
    rows = text.splitlines()
    path = tmp_path / "pos.txt"
    for change, wanted in (
        (lambda: text[:-100], "values, wanted 20"),
        (lambda: text.replace("35.97443318", "35.97x", 1), r"pos.txt:25: LATITUDE: '35.97x' is not a number"),
        (lambda: text.replace("35.97443318", "nan", 1), r"pos.txt:25: LATITUDE: 'nan' is not a number"),
        (lambda: text.replace("HEADING,", "COURSE,"), "HEADING: column missing"),
        (lambda: "\n".join(rows[:18]), "no line of column names"),
        (lambda: "\n".join(rows[:24]), "0 poses below the header"),
    ):
        path.write_text(change())
        with pytest.raises(UserError, match=wanted):
            read_pos_export(path)


# ---- SBET


def test_sbet_round_trip(tmp_path):
    track = straight_track()
    path = tmp_path / "sbet.out"
    write_sbet(path, gps_from_utc_ns(track.time_ns)[1], track.geodetic, track.rpy, np.zeros((50, 3)))
    assert path.stat().st_size == 50 * 136 and kind_of_path(path) == "sbet"
    again = read_sbet(path, date(2020, 6, 1))
    np.testing.assert_allclose(again.time_ns, track.time_ns, atol=200)  # float64 seconds of the week
    np.testing.assert_allclose(again.geodetic, track.geodetic, rtol=1e-14)
    np.testing.assert_allclose(again.rpy, track.rpy, atol=1e-14)


def test_sbet_wander_angle_and_seconds_of_day(tmp_path):
    path = tmp_path / "flight.out"
    values = np.zeros((3, 17))
    values[:, 0] = [100.0, 101.0, 102.0]
    values[:, 1:4] = [0.8, 0.2, 1000.0]
    values[:, 9], values[:, 10] = 1.5, 0.25
    values.tofile(path)
    np.testing.assert_allclose(read_sbet(path).rpy[:, 2], 1.25)
    assert read_sbet(path, date(2020, 6, 3)).time_ns[0] == ns("2020-06-03T00:01:22")  # 18 leap seconds
    assert read_sbet(path, date(2020, 6, 7)).time_ns[0] == ns("2020-06-07T00:01:22")  # Sunday: seconds of the week
    with pytest.raises(UserError, match="seconds of the week say Sunday"):
        read_sbet(path, date(2020, 6, 3), seconds_of_day=False)
    monday = read_sbet(path, date(2020, 6, 8))  # its Sunday, or seconds of the day: nothing tells
    assert monday.time_ns[0] == ns("2020-06-07T00:01:22")
    assert "times below one day; if they count from midnight, wanted --seconds-of-day" in monday.notes[0]
    assert "times are taken as seconds of the week, of 2020-06-07, the day before --date" in monday.notes[1]


@pytest.mark.parametrize("said", [True, None])
def test_sbet_with_seconds_of_the_day_over_midnight(tmp_path, said):
    path = tmp_path / "flight.out"
    values = np.zeros((4, 17))
    values[:, 0] = [86399.0, 86399.5, 0.0, 0.5]
    values[:, 1:4] = [0.8, 0.2, 1000.0]
    values.tofile(path)
    track = read_sbet(path, date(2020, 6, 3), seconds_of_day=said)
    assert track.time_ns.tolist() == [ns("2020-06-03T23:59:41") + k * 500_000_000 for k in range(4)]


def test_sbet_over_the_end_of_a_week(tmp_path):
    path = tmp_path / "flight.out"
    values = np.zeros((3, 17))
    values[:, 0] = [604799.0, 604799.5, 0.0]
    values.tofile(path)
    track = read_sbet(path, date(2020, 6, 6))  # Saturday
    np.testing.assert_array_equal(np.diff(track.time_ns), [500_000_000] * 2)
    assert track.time_ns[0] == ns("2020-06-06T23:59:41")
    # the same flight, named after its second day
    np.testing.assert_array_equal(read_sbet(path, date(2020, 6, 7)).time_ns, track.time_ns)
    # its part behind the end of the week, whose seconds go on
    values[:, 0] = [604800.0, 604800.5, 604801.0]
    values.tofile(path)
    for day in (6, 7):
        assert read_sbet(path, date(2020, 6, day)).time_ns[0] == track.time_ns[2]


@pytest.mark.parametrize(
    ("name", "behind_s"),
    [
        ("sbet--UTCtime-Lillehammer_211021.out", 0),
        ("Lillehammer-WGS84-UTC-10Hz.out", 0),
        ("sbet_20211021_1200UTC.out", 18),
        ("sbet_1200_UTC.out", 18),
        ("sbet_utc.out", 0),
        ("sbet_butcher.out", 18),
    ],
)
def test_sbet_in_seconds_of_utc_by_its_name(tmp_path, name, behind_s):
    """Names of real files."""
    path = tmp_path / name
    values = np.zeros((3, 17))
    values[:, 0] = [604799.0, 604799.5, 0.0]
    values[:, 1:4] = [0.8, 0.2, 1000.0]
    values.tofile(path)
    track = read_sbet(path, date(2020, 6, 6))
    assert track.time_ns.tolist() == [ns("2020-06-06T23:59:59") - behind_s * 10**9 + k * 500_000_000 for k in range(3)]
    assert any("as its name says" in note for note in track.notes) == (behind_s == 0)


@pytest.mark.parametrize(("name", "datum"), [("S222_NAD83_SBET.out", "NAD83"), ("sbet_gda2020.out", "gda2020")])
def test_sbet_of_another_datum_by_its_name_is_told(tmp_path, name, datum):
    track = straight_track()
    path = tmp_path / name
    write_sbet(path, gps_from_utc_ns(track.time_ns)[1], track.geodetic, track.rpy, np.zeros((50, 3)))
    assert f"{name}: positions are taken as WGS 84, though its name says {datum}" in read_sbet(path).notes


def test_sbet_damaged(tmp_path):
    path = tmp_path / "sbet.out"
    track = straight_track()
    write_sbet(path, gps_from_utc_ns(track.time_ns)[1], track.geodetic, track.rpy, np.zeros((50, 3)))
    data = path.read_bytes()
    path.write_bytes(data[:-5])
    with pytest.raises(UserError, match="6795 bytes, wanted a whole number of SBET records of 136 bytes"):
        read_sbet(path)
    path.write_bytes(data[8:] + data[:8])  # fields shifted by one
    with pytest.raises(UserError, match="record 1: "):
        read_sbet(path)


# ---- CSV


def test_trajectory_csv_of_both_kinds(tmp_path):
    path = tmp_path / "trajectory.csv"
    names = ["time_s", "lat_deg", "lon_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg"]
    sigmas = [f"{name}_sigma" for name in names[1:]]
    row = "{0},48.{0},11.{0},2000,0.1,0.2,45," + "0.1,0.2,0.3,0.01,0.02,0.03"
    path.write_text(",".join(names + sigmas) + "\n" + "\n".join(row.format(i) for i in range(5)) + "\n")
    track = read_trajectory_csv(path)
    assert kind_of_path(path) == "csv" and track.time_ns.tolist() == [i * 10**9 for i in range(5)]
    np.testing.assert_allclose(track.geodetic[3], [48.3, 11.3, 2000])
    np.testing.assert_allclose(np.degrees(track.sigma_rpy[0]), [0.01, 0.02, 0.03])

    frame = LocalFrame(48.2, 11.2, 0.0, "EPSG:32632")
    position = frame.from_geodetic(*track.geodetic.T)
    xyz = frame.to_crs(position)
    R = camera_poses(track, frame)[1]
    angles = np.degrees(angles_from_matrix(np.swapaxes(frame.R_l_crs(xyz), -1, -2) @ R))
    rows = [",".join(f"{v:.9f}" for v in (i, *xyz[i], *angles[i])) for i in range(5)]
    path.write_text("time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg\n" + "\n".join(rows) + "\n")
    again = read_trajectory_csv(path, "EPSG:32632")
    np.testing.assert_allclose(again.geodetic, track.geodetic, atol=1e-6)
    np.testing.assert_allclose(np.degrees(again.rpy), np.degrees(track.rpy), atol=1e-6)
    with pytest.raises(UserError, match="unknown CRS, wanted --crs"):
        read_trajectory_csv(path)


@pytest.mark.parametrize(("lat", "lon"), [(48.2, 11.2), (-71.0, 179.99)], ids=["north", "date line"])
def test_lines_in_a_local_frame_come_back_as_they_were(lat, lon, tmp_path):
    """X .. kappa are of the camera, latitude .. heading of a body to which it is turned: both were refused."""
    frame, rng, path = LocalFrame(lat, lon, 300.0), np.random.default_rng(1), tmp_path / "lines.csv"
    position = np.column_stack([np.linspace(-3e4, 6e4, 40), rng.normal(0.0, 500.0, 40), rng.normal(2e3, 9.0, 40)])
    R = matrix_from_angles(*rng.normal([0.02, -0.05, 1.5], [0.01, 0.01, 2.0], (40, 3)).T)
    sigma = np.array([0.1, 0.2, 0.4, 1e-4, 2e-4, 4e-4])
    known = np.tile(np.diag(sigma**2), (40, 1, 1))
    stamps = ns("2026-05-01T10:00:00") + np.arange(40) * 5_000_000
    R_bc = matrix_from_navigation(*np.radians([3.0, -2.0, 90.0])) @ R_BC_NOMINAL
    write_oriented_lines(path, [OrientedLines("S1", np.arange(40), stamps, position, R, known)], frame, R_bc)
    track = read_trajectory_csv(path)
    assert np.abs(track.time_ns - stamps).max() < 200  # seconds since 1970 as a number of 16 digits
    at = frame.from_geodetic(*track.geodetic.T)
    np.testing.assert_allclose(at, position, atol=2e-4)
    np.testing.assert_allclose(R_lc_from_navigation(frame, at, track.rpy), R, atol=3e-9)  # 1e-7 degrees
    north = np.swapaxes(frame.R_ln(at), 1, 2)
    np.testing.assert_allclose(
        track.covariance_n[:, :3, :3], north @ known[:, :3, :3] @ np.swapaxes(north, 1, 2), atol=1e-5
    )
    assert main(["import", str(path), "-o", str(tmp_path / "lines.mcap"), "-q"]) == 0
    text = path.read_text()
    path.write_text(text.replace("X_m,Y_m", "Y_m,X_m"))
    with pytest.raises(
        UserError, match="are in no local frame by lat_deg, lon_deg, height_m beside them, wanted --crs"
    ):
        read_trajectory_csv(path)
    path.write_text(text.replace("lat_deg", "lat"))
    with pytest.raises(
        UserError, match="or of a local frame lat_deg, lon_deg, height_m beside them, as `triline export"
    ):
        read_trajectory_csv(path)
    path.write_text(text.replace("X_m,Y_m", "X_deg,Y_deg"))  # of scenes in a geographic CRS
    with pytest.raises(UserError, match="1: X_deg: coordinates of no local frame, wanted the --crs that they are in"):
        read_trajectory_csv(path)


def written_lines(path, frame, lat=48.2, lon=11.2):
    """Forty lines of a strip as `triline export --per-line` writes them, and their places and attitudes."""
    rng = np.random.default_rng(2)
    position = frame.from_geodetic(lat + np.linspace(0.0, 0.02, 40), np.full(40, lon), rng.normal(2e3, 9.0, 40))
    R = matrix_from_angles(*rng.normal([0.02, -0.05, 1.5], [0.01, 0.01, 2.0], (40, 3)).T)
    stamps = ns("2026-05-01T10:00:00") + np.arange(40) * 5_000_000
    part = OrientedLines("S1", np.arange(40), stamps, position, R, np.full((40, 6, 6), np.nan))
    write_oriented_lines(path, [part], frame)
    return position, R


def test_lines_of_another_local_frame_are_taken_to_that_of_the_project(tmp_path):
    """The same files imported twice may have another origin: lines of the one stood as far off in the other."""
    path, here, there = tmp_path / "lines.csv", LocalFrame(48.2, 11.2, -60.0), LocalFrame(48.25, 11.1, 0.0)
    position, R = written_lines(path, here)
    at, R_lc, _ = read_poses_of_strips(path, there).of("S1")
    np.testing.assert_allclose(at, there.from_geodetic(*here.to_geodetic(position).T), atol=2e-4)
    np.testing.assert_allclose(
        navigation_from_R_lc(there, at, R_lc), navigation_from_R_lc(here, position, R), atol=3e-9
    )
    same, R_same, _ = read_poses_of_strips(path, here).of(None)
    np.testing.assert_allclose(same, position, atol=1e-4)
    np.testing.assert_allclose(R_same, R, atol=3e-9)


def test_crs_of_lines_is_held_against_latitudes_beside_them(tmp_path):
    path = tmp_path / "lines.csv"
    written_lines(path, LocalFrame(48.2, 11.2, 0.0, "EPSG:32632"))
    assert not any("height_m" in note for note in read_trajectory_csv(path, "EPSG:32632").notes)
    with pytest.raises(
        UserError, match=r"'EPSG:32633' are 4\d+\.\d km from lat_deg, lon_deg beside them, wanted the CRS"
    ):
        read_trajectory_csv(path, "EPSG:32633")
    lines = [line.split(",") for line in path.read_text().splitlines()]
    height = lines[0].index("height_m")
    raised = [lines[0], *([*row[:height], str(float(row[height]) + 47.0), *row[height + 1 :]] for row in lines[1:])]
    path.write_text("\n".join(map(",".join, raised)))
    notes = read_trajectory_csv(path, "EPSG:32632").notes
    assert any("Z_m in 'EPSG:32632' are 47.0 m below height_m beside them" in note for note in notes)


def test_trajectory_csv_damaged(tmp_path):
    path = tmp_path / "trajectory.csv"
    head = "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
    good = "1,48,11,500,0,0,45\n2,48,11.001,500,0,0,45\n"
    for text, wanted in (
        (head + good + "2,48,11,500,0,0,45\n", r"trajectory.csv:4: time_s: 2.000000 does not come after 2.000000"),
        (head + good.replace("11.001", "east"), r"trajectory.csv:3: lon_deg: 'east' is not a number"),
        (head + good.replace("48", "148"), "record 1: latitude: 148, wanted -90 to 90 deg"),
        (head + "1,48,11,500,0,0,45\n", "1 poses with rising time, wanted at least 2"),
        ("when,lat,lon\n1,2,3\n", "time_s: column missing"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=wanted):
            list(read_any(path, "csv").messages)
