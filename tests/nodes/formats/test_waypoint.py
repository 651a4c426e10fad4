"""Text of Inertial Explorer: whatever columns the user has chosen, the poses are the same."""

from __future__ import annotations

from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from tracks import straight_track, waypoint_text

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import kind_of_path, read_any
from triline.nodes.formats.sensor_folder import read_sensor_folder
from triline.nodes.formats.waypoint import read_waypoint
from triline.nodes.recording.access import Recording

HEADER = """
Project:     valley
Program:     Inertial Explorer Version 8.90.6611
Profile:     survey
Source:      GNSS/INS Epochs(Smoothed TC Combined)

Datum:       WGS84, (processing datum)
Master 1:    Name BASE, Status ENABLED
             Position 48 00 42.83213, 11 33 24.98087, 496.009 m (WGS84, Ellipsoidal hgt)
UTC Offset:  18 s

"""
ANGLES = ("Heading (deg)", "HdngSep (deg)", "Pitch (deg)", "Roll (deg)", "AmbStatus", "Q")
DMS = ("Latitude (+/-D M S)", "Longitude (+/-D M S)", "H-Ell (m)")
DEGREES = ("Longitude (deg)", "Latitude (deg)", "H-Ell (m)")


def written(tmp_path, *columns, track=None, header=HEADER):
    path = tmp_path / "flight.txt"
    path.write_text(waypoint_text(track or straight_track(), *columns, header=header))
    return path


def check(found, track) -> None:
    assert np.abs(found.time_ns - track.time_ns).max() < 1_000_000
    np.testing.assert_allclose(found.geodetic[:, :2], track.geodetic[:, :2], rtol=0, atol=3e-8)  # 0.1 mas
    np.testing.assert_allclose(found.geodetic[:, 2], track.geodetic[:, 2], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.rpy, track.rpy, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "columns",
    [
        ("Week (weeks)", "GPSTime (sec)", *DMS, "VNorth (m/s)", *ANGLES),
        ("UTCTime (sec)", "Week (weeks)", "GPSTime (sec)", *DEGREES, *ANGLES),
        ("GPSTime (sec)", "Date (YMD)", *DMS, *ANGLES),
        ("UTCDate (MDY)", "UTCTime (HMS)", *DEGREES, *ANGLES),
        ("UTCDate (MDY)", "UTCTime (sec)", *DMS, "X-ECEF (m)", *ANGLES),
        ("Date (YMD)", "GPSTime (s of day)", *DMS, *ANGLES),
    ],
    ids=["week", "with UTC beside it", "date", "UTC as a clock", "UTC as seconds", "seconds of the day"],
)
@pytest.mark.parametrize("header", [HEADER, ""], ids=["header", "names alone"])
def test_columns_in_any_order_and_unit(tmp_path, columns, header):
    path = written(tmp_path, *columns, header=header)
    assert kind_of_path(path) == "waypoint"
    track = read_waypoint(path)
    check(track, straight_track())
    assert not (track.notes or track.has_position_sigmas or track.has_attitude_sigmas)


def test_a_flight_in_the_south_and_west_at_0_degrees(tmp_path):
    """-0 degrees 30 minutes is half a degree to the south."""
    track = straight_track()
    track = replace(track, geodetic=track.geodetic - [48.5, 11.5, 0.0])
    path = written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES, track=track)
    assert " -0 29 " in path.read_text()
    check(read_waypoint(path), track)


def test_separated_by_commas_with_remarks_behind(tmp_path):
    columns = ("Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES)
    rows = waypoint_text(straight_track(), *columns).splitlines()
    names, units = (",".join(part) for part in zip(*((*c.split(" ", 1), "")[:2] for c in columns), strict=True))
    path = tmp_path / "flight.txt"
    text = [names, units, *(",".join(row.split()) for row in rows[2:]), "", ",,,", "Footer: end of the table"]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(text).encode())
    check(read_waypoint(path), straight_track())


def test_the_day_is_asked_for_where_no_column_says_it(tmp_path):
    path = written(tmp_path, "GPSTime (sec)", *DMS, *ANGLES)
    assert "(--date)" in read_waypoint(path).notes[0]
    check(read_waypoint(path, date(2020, 6, 1)), straight_track())
    clock = written(tmp_path, "UTCTime (HMS)", *DMS, *ANGLES)
    check(read_waypoint(clock, date(2020, 6, 1)), straight_track())


def test_accuracies_have_their_units(tmp_path):
    more = ("SDEast (m)", "SDNorth (m)", "SDHeight (m)", "RollSD (arcmin)", "PitchSD (arcmin)", "HdngSD (deg)")
    path = written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES[:4], *more)
    lines = path.read_text().splitlines()
    sigmas = " 0.02 0.01 0.03 0.3 0.6 0.02"
    path.write_text("\n".join([*lines[:-50], *(line[: -6 * 21] + sigmas for line in lines[-50:])]))
    track = read_waypoint(path)
    np.testing.assert_allclose(track.sigma_ned_m[0], [0.01, 0.02, 0.03])
    np.testing.assert_allclose(np.degrees(track.sigma_rpy[0]), [0.005, 0.01, 0.02])
    path.write_text(path.read_text().replace("SDNorth", "CNorth "))
    track = read_waypoint(path)
    np.testing.assert_allclose(np.degrees(track.sigma_rpy[0]), [0.005, 0.01, 0.02])
    assert track.sigma_ned_m is None and "accuracies of the positions are not complete and not used" in track.notes[0]


def test_another_datum_and_rotations_are_told(tmp_path):
    header = HEADER.replace("WGS84, (pro", "NAD83(2011), (pro").replace(
        "UTC Offset", "Body to Sensor Rotations:\n  xRot=0.000, yRot=0.000, zRot=-90.000 degrees (Rotate)\nUTC Offset"
    )
    notes = read_waypoint(written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES, header=header)).notes
    assert notes[0] == "flight.txt: datum NAD83, taken as WGS 84"
    assert "rotations applied by Inertial Explorer: xRot=0.000, yRot=0.000, zRot=-90.000 degrees" in notes[1]


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        ("H-Ell", "H-MSL", r":12: H-Ell: column missing, .* \(H-MSL counts from a geoid\)"),
        ("Heading", "COG    ", ":12: Heading: column missing"),
        ("GPSTime", "Time   ", ":12: GPSTime: column missing, wanted it with Week, or UTCTime with UTCDate"),
        (" (m)", "(ft)", ":13: H-Ell: in ft, wanted m"),
        ("(sec)", "( ms)", ":13: GPSTime: in ms, wanted sec or HMS"),
        ("2000.000", "2000.0x0", r":14: H-Ell: '2000.0x0' is not a number"),
        ("2108.00000", "     week21", r":14: Week: 'week21', wanted a GPS week"),
        ("48 00 00.00000", "48 00", r":14: 14 values, wanted 15"),
        ("Latitude", "Lat     ", "no row of names with Latitude and Longitude"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(tmp_path, old, new, wanted):
    path = written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=wanted):
        read_waypoint(path)


def test_another_day_than_the_one_given_is_refused(tmp_path):
    path = written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES)
    check(read_waypoint(path, date(2020, 6, 2)), straight_track())
    with pytest.raises(UserError, match="--date 2020-06-08, but its times begin on 2020-06-01"):
        read_waypoint(path, date(2020, 6, 8))


def test_it_is_imported_as_any_file_of_poses(tmp_path, capsys):
    path = written(tmp_path, "Week (weeks)", "GPSTime (sec)", *DMS, *ANGLES)
    assert main(["import", str(path), "-o", str(tmp_path / "flight.mcap")]) == 0
    assert "text of Inertial Explorer" in capsys.readouterr().out
    assert len(Recording(tmp_path / "flight.mcap").poses("trajectory/smoothed").time_ns) == 50


def test_a_sunday_night_is_none_of_the_monday_that_is_given(tmp_path):
    """The day that somebody gives may be off by a night: seconds of the week do not become those of it."""
    track = straight_track()
    sunday = replace(track, time_ns=track.time_ns - 13 * 3600 * 10**9)  # 2020-05-31, 23:00
    path = written(tmp_path, "GPSTime (sec)", *DMS, *ANGLES, track=sunday)
    check(read_waypoint(path, date(2020, 6, 1)), sunday)


# ---- GrafNav

FIXES = ("Week (weeks)", "GPSTime (sec)", *DMS, "Q", "SDEast (m)", "SDNorth (m)", "SDHeight (m)", "COG (deg)")


def grafnav(path, columns=FIXES, sigmas="2 0.02 0.01 0.03"):
    """Positions of `straight_track`; quality and accuracies stand in the last columns but one."""
    lines = waypoint_text(straight_track(), *columns, header=HEADER).splitlines()
    width = len(sigmas.split()) + 1
    rows = [" ".join([*line.split()[:-width], *sigmas.split(), "0"]) for line in lines[-50:]]
    path.write_text("\n".join([*lines[:-50], *rows]) + "\n")
    return path


def test_positions_of_grafnav_become_fixes_with_their_accuracies(tmp_path):
    path = grafnav(tmp_path / "ppk.txt")
    assert kind_of_path(path) == "grafnav"
    imported = read_any(path)
    messages = [message for message in imported.messages if message.topic == "sensor/gnss"]
    bodies, track = [message.body for message in messages], straight_track()
    assert [message.stamp_ns for message in messages] == pytest.approx(track.time_ns.tolist(), abs=1_000_000, rel=0)
    place = np.array([(body.latitude, body.longitude, body.altitude) for body in bodies])
    np.testing.assert_allclose(place[:, :2], track.geodetic[:, :2], rtol=0, atol=3e-8)
    np.testing.assert_allclose(place[:, 2], track.geodetic[:, 2], rtol=0, atol=1e-3)
    variances = [bodies[7].position_covariance[i] for i in (0, 4, 8)]  # east, north, up
    assert variances == pytest.approx([4e-4, 1e-4, 9e-4])
    assert "ppk.txt: 50 positions: 100.0% of quality 2 (1 is the best)" in imported.notes


@pytest.mark.parametrize(
    ("columns", "sigmas", "wanted"),
    [
        (("SDHoriz (m)", "SDHeight (m)"), "1 0.02 0.03", [2e-4, 2e-4, 9e-4]),
        (("SDNorth (m)", "SDHoriz (m)", "SDHeight (m)"), "1 0.01 0.02 0.03", [2e-4, 1e-4, 9e-4]),
    ],
    ids=["alone", "beside one of the two"],
)
def test_one_accuracy_in_level_stands_for_both(tmp_path, columns, sigmas, wanted):
    imported = read_any(grafnav(tmp_path / "ppk.txt", (*FIXES[:6], *columns, "COG (deg)"), sigmas))
    fix = next(message.body for message in imported.messages if message.topic == "sensor/gnss")
    assert [fix.position_covariance[i] for i in (0, 4, 8)] == pytest.approx(wanted)


def test_positions_without_accuracies_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"ppk\.txt:\d+: SDNorth: column missing, wanted Latitude.*SDHeight"):
        read_any(grafnav(tmp_path / "ppk.txt", (*FIXES[:6], "COG (deg)"), "1"))


def test_a_sensor_folder_takes_fixes_of_grafnav(tmp_path):
    folder = tmp_path / "flight"
    folder.mkdir()
    grafnav(folder / "gnss.txt")
    found = read_sensor_folder(folder)
    assert found.gnss is not None and found.gnss_file == "gnss.txt" and kind_of_path(folder) == "sensors"
    np.testing.assert_allclose(found.gnss.time_s, straight_track().time_ns * 1e-9, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.gnss.sigma_ned_m, np.tile([0.01, 0.02, 0.03], (50, 1)))
    (folder / "gnss.csv").write_text("time_s\n")
    with pytest.raises(UserError, match=r"gnss\.csv and gnss\.txt, wanted one of them"):
        read_sensor_folder(folder)
