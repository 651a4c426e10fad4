"""Poses as CSV with all kinds of times and units, and of Headwall and Resonon; files that state the wrong unit."""

from __future__ import annotations

import json
from datetime import date
from math import radians

import numpy as np
import pyproj
import pytest
from tracks import ns

from triline.nodes.convert import pose_sample
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import Options, kind_of_path, read_any, read_track
from triline.nodes.formats.frame_json import read_frame
from triline.nodes.formats.image_lines import line_times
from triline.nodes.formats.projection import missing_grids, off_without_grids
from triline.nodes.formats.table import Column, read_table
from triline.nodes.formats.track import Accuracy
from triline.solver.geometry.rotation import angles_from_matrix, matrix_from_angles

START = "2020-06-01T12:00:00"  # a Monday; GPS week 2108, second 129618
N = 6
LAT = [48.0 + 0.0009 * i for i in range(N)]  # 100 m a second to the north-east
LON = [11.0 + 0.00135 * i for i in range(N)]
TAIL = [f"{LAT[i]:.6f},{LON[i]:.6f},2000,1.5,-2.5,45" for i in range(N)]
COLUMNS = "lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg"

TIMES = {
    "ISO": ("time", [f"2020-06-01T12:00:0{i}Z" for i in range(N)], None),
    "ISO with a zone and a blank": ("timestamp", [f"2020-06-01 14:00:0{i}.000+02:00" for i in range(N)], None),
    "day and time": ("date,time", [f"2020-06-01,12:00:0{i}.0" for i in range(N)], None),
    "Unix": ("time_s", [f"{1591012800 + i}.0" for i in range(N)], None),
    "Unix, with the day": ("time_s", [f"{1591012800 + i}.0" for i in range(N)], date(2020, 6, 1)),
    "week": ("week,gps_s", [f"2108,{129618 + i}" for i in range(N)], None),
    "day": ("gps_s", [f"{129618 + i}" for i in range(N)], date(2020, 6, 1)),
    "since 1980": ("gps_s", [f"{2108 * 604800 + 129618 + i}" for i in range(N)], None),
}


def write(path, head, times, columns=COLUMNS, tail=TAIL, sep=","):
    rows = [f"{head},{columns}", *(f"{t},{v}" for t, v in zip(times, tail, strict=True))]
    path.write_text("\n".join(rows).replace(",", sep) + "\n")
    return path


@pytest.mark.parametrize("what", TIMES)
@pytest.mark.parametrize("sep", [",", ";"])
def test_times_of_every_kind(tmp_path, what, sep):
    head, times, day = TIMES[what]
    path = write(tmp_path / "poses.csv", head, times, sep=sep)
    assert kind_of_path(path) == "csv"
    track = read_track(path, "csv", Options(day=day))
    assert track.time_ns.tolist() == [ns(START) + i * 10**9 for i in range(N)]
    told = "poses.csv: gps_s counts since 1980-01-06: the flight begins at 2020-06-01T12:00:00Z"
    assert track.notes == ((told,) if what == "since 1980" else ())
    np.testing.assert_allclose(track.geodetic, np.column_stack([LAT, LON, np.full(N, 2000.0)]), atol=1e-6)
    np.testing.assert_allclose(np.degrees(track.rpy[2]), [1.5, -2.5, 45.0])


def test_over_the_end_of_a_week(tmp_path):
    times = ["2108,604798", "2108,604799", *(f"2109,{i}" for i in range(N - 2))]
    track = read_track(write(tmp_path / "p.csv", "week,gps_s", times), "csv", Options())
    assert np.diff(track.time_ns).tolist() == [10**9] * (N - 1)


@pytest.mark.parametrize(
    ("first", "day", "told"),
    [
        (43_218, date(2020, 6, 1), "of 2020-05-31, the day before --date"),  # seconds of the day, of a Monday
        (86_400 + 43_218, date(2020, 6, 1), None),
        (86_400 + 43_218, date(2020, 5, 31), "of 2020-06-01, the day after --date"),
        (6 * 86_400, date(2020, 6, 7), "of 2020-06-06, the day before --date"),  # a Sunday
    ],
)
def test_seconds_of_the_week_of_another_day_than_the_one_given_are_told(tmp_path, first, day, told):
    path = write(tmp_path / "poses.csv", "gps_s", [f"{first + i}" for i in range(N)])
    notes = read_track(path, "csv", Options(day=day)).notes
    assert notes == (() if told is None else (f"poses.csv: times are taken as seconds of the week, {told}",))


def test_weeks_modulo_1024(tmp_path):
    """As satellites send them: week 2108 is 60, which is 39 years before without a word."""
    path = write(tmp_path / "p.csv", "week,gps_s", [f"60,{129618 + i}" for i in range(N)])
    track = read_track(path, "csv", Options(day=date(2020, 6, 1)))
    assert track.time_ns.tolist() == [ns(START) + i * 10**9 for i in range(N)]
    assert track.notes == ("p.csv: week counts modulo 1024: week 2108 by the day given",)
    track = read_track(path, "csv", Options())
    said = "p.csv: week 60 is that of 1981-03-02; if it counts modulo 1024, wanted the day of the flight (--date)"
    assert track.notes == (said,) and track.time_ns[0] < ns("1981-03-03T00:00:00")
    for day in (date(2020, 6, 10), date(1981, 4, 1)):
        with pytest.raises(UserError, match=f"--date {day}, but its times begin on"):
            read_track(path, "csv", Options(day=day))
    # the end of the count falls into the flight, on 2019-04-06; an old flight with its day, a new one with whole weeks
    times = ["1023,604798", "1023,604799", *(f"0,{i}" for i in range(N - 2))]
    track = read_track(write(path, "gps_week,tow_s", times), "csv", Options(day=date(2019, 4, 7)))
    assert track.time_ns[0] == ns("2019-04-06T23:59:40") and np.diff(track.time_ns).tolist() == [10**9] * (N - 1)
    for week, day in ((900, date(1997, 4, 7)), (2108, date(2020, 6, 1))):
        path = write(path, "week,gps_s", [f"{week},{129618 + i}" for i in range(N)])
        track = read_track(path, "csv", Options(day=day))
        assert not track.notes and track.time_ns[0] // 86_400_000_000_000 == (day - date(1970, 1, 1)).days


@pytest.mark.parametrize(
    "columns",
    [
        "lat_rad,lon_rad,height_m,roll_rad,pitch_rad,heading_rad",
        "Latitude [rad],Longitude [rad],Altitude (m),Roll (rad),Pitch (rad),Yaw (rad)",
    ],
)
def test_radians_stated_in_the_header(tmp_path, columns):
    turn = [radians(v) for v in (1.5, -2.5, 45)]
    tail = [
        f"{radians(LAT[i]):.10f},{radians(LON[i]):.10f},2000," + ",".join(f"{v:.9f}" for v in turn) for i in range(N)
    ]
    path = write(tmp_path / "p.csv", *TIMES["Unix"][:2], columns, tail)
    assert kind_of_path(path) == "csv"
    track = read_track(path, "csv", Options())
    np.testing.assert_allclose(track.geodetic[:, :2], np.column_stack([LAT, LON]), atol=1e-6)
    np.testing.assert_allclose(np.degrees(track.rpy[2]), [1.5, -2.5, 45.0], atol=1e-6)
    told = "p.csv: Altitude (m) is taken as height above the ellipsoid (WGS 84)"
    assert (told in track.notes) == ("Altitude" in columns)


def test_decimal_commas_and_sigmas_as_navigate_writes_them(tmp_path):
    sigmas = "sigma_n_m;sigma_e_m;sigma_d_m;sigma_roll_deg;sigma_pitch_deg;sigma_heading_deg"
    rows = [
        f"{1591012800 + i},5;{LAT[i]:.6f};{LON[i]:.6f};2000,25;1,5;-2,5;45;0,1;0,2;0,3;0,01;0,02;0,03" for i in range(N)
    ]
    path = tmp_path / "p.csv"
    text = "\n".join(["time_s;" + COLUMNS.replace(",", ";") + ";" + sigmas, *rows])
    path.write_text(text.replace(".", ",") + "\n")
    track = read_track(path, "csv", Options())
    assert track.time_ns[0] == ns(START) + 500_000_000 and track.geodetic[0, 2] == 2000.25
    np.testing.assert_allclose(track.sigma_ned_m[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.degrees(track.sigma_rpy[0]), [0.01, 0.02, 0.03])


@pytest.mark.parametrize("known, other", [("position", "attitude"), ("attitude", "position")])
def test_sigmas_of_positions_count_without_those_of_attitudes_and_the_other_way_round(tmp_path, known, other):
    sigmas = {
        "position": ("sigma_n_m,sigma_e_m,sigma_d_m", "0.01,0.02,0.03"),
        "attitude": ("sigma_roll_deg,sigma_pitch_deg,sigma_heading_deg", "0.001,0.002,0.003"),
    }
    path = tmp_path / "p.csv"
    names, values = sigmas[known]
    path.write_text(
        "\n".join([f"time_s,{COLUMNS},{names}", *(f"{t},{r},{values}" for t, r in zip(UNIX, TAIL, strict=True))]) + "\n"
    )
    imported = read_any(path, "csv")
    taken = {
        "attitude": "0.01 and 0.02 deg taken (--attitude-sigma)",
        "position": "0.2 and 0.2 m taken (--position-sigma)",
    }
    assert f"p.csv: no accuracies of the {other}s: {taken[other]}" in imported.notes
    project = next(message.body for message in imported.messages if message.topic == "configuration/project")
    # X is east, and kappa the heading of an aircraft that flies nearly level
    position = [0.02, 0.01, 0.03] if known == "position" else Accuracy().position_m
    kappa = 0.003 if known == "attitude" else Accuracy().attitude_deg[2]
    np.testing.assert_allclose(project.offset_sigma_m, position, rtol=1e-3)
    np.testing.assert_allclose(project.shift_sigma_deg[2], kappa, rtol=0.05)


UNIX = TIMES["Unix"][1]


def test_decimal_commas_below_a_row_of_whole_numbers(tmp_path):
    """Spreadsheets write whole numbers without a decimal sign, so that the first row tells nothing."""
    path = tmp_path / "p.csv"
    rows = [f"{1591012800 + i};{47 + i};{9 + i};{2000 + i};0;0;{45 + i}" for i in range(2)]
    rows += ["1591012802;49,5;11,25;2002,5;0,5;0;47"]
    path.write_text("\n".join(["time_s;" + COLUMNS.replace(",", ";"), *rows]) + "\n")
    track = read_track(path, "csv", Options())
    np.testing.assert_allclose(track.geodetic[2], [49.5, 11.25, 2002.5])
    points = path.read_text().replace("2002,5", "2002.5")
    path.write_text(points)
    with pytest.raises(UserError, match=r"p.csv:4: height_m: 2002.5, wanted a decimal comma as other values have$"):
        read_track(path, "csv", Options())


@pytest.mark.parametrize("sep", [",", ";"])
def test_names_and_values_between_quotes_below_a_blank_line(tmp_path, sep):
    rows = [["time_s", *COLUMNS.split(",")]]
    rows += [[f"{1591012800 + i}.5", f"{LAT[i]:.6f}", f"{LON[i]:.6f}", "2000", "1.5", "-2.5", "45"] for i in range(N)]
    path, times = tmp_path / "p.csv", tmp_path / "times.csv"
    path.write_text("\n" + "\n".join(sep.join(f'"{value}"' for value in row) for row in rows) + "\n")
    assert kind_of_path(path) == "csv"
    track = read_track(path, "csv", Options())
    assert track.time_ns[0] == ns(START) + 500_000_000
    np.testing.assert_allclose(track.geodetic[:, 1], LON, atol=1e-6)
    times.write_text(f'"line"{sep}"time_s"\n"0"{sep}"1591012800.5"\n"1"{sep}"1591012800.75"\n')
    assert line_times(times, None, []).tolist() == [ns(START) + 500_000_000, ns(START) + 750_000_000]


def test_empty_columns_and_others_that_come_twice_are_ignored(tmp_path):
    """As spreadsheets write them: two empty columns were a column without a name that "comes twice"."""
    rows = [f"{1591012800 + i},{LAT[i]:.6f},{LON[i]:.6f},2000,1.5,-2.5,45,7,8,," for i in range(N)]
    path = tmp_path / "p.csv"
    path.write_text("\n".join([f"time_s,{COLUMNS},fix,fix,,", *rows]) + "\n")
    track = read_track(path, "csv", Options())
    np.testing.assert_allclose(track.geodetic[:, 1], LON, atol=1e-6)
    assert sum("is not known and was ignored" in note for note in track.notes) == 2  # each name once
    path.write_text(path.read_text().replace("fix,fix", "time_s,fix"))
    with pytest.raises(UserError, match=r"p\.csv:1: time_s: this column comes twice"):
        read_track(path, "csv", Options())


def test_tabs_are_told(tmp_path):
    """Of poses and line times it was said that the column of the time is missing, which stood there."""
    poses = write(tmp_path / "p.csv", "time_s", [f"{1591012800 + i}.0" for i in range(N)], sep="\t")
    times = tmp_path / "times.csv"
    times.write_text("line\ttime_s\n0\t1591012800.5\n1\t1591012800.75\n")
    for read in (lambda: read_track(poses, "csv", Options()), lambda: line_times(times, None, [])):
        with pytest.raises(UserError, match=r":1: .*column missing, .*; is the separator a comma\?"):
            read()


def test_times_in_words_with_decimal_commas(tmp_path):
    """ISO 8601 has them, and tables with decimal commas."""
    rows = [
        f"2020-06-01T12:00:{i:02d},25Z;{LAT[i]:.6f};{LON[i]:.6f};2000,0;1,5;-2,5;45,0".replace(".", ",")
        for i in range(N)
    ]
    path = tmp_path / "p.csv"
    path.write_text("\n".join([f"time;{COLUMNS.replace(',', ';')}", *rows]) + "\n")
    track = read_track(path, "csv", Options())
    assert track.time_ns.tolist() == [ns("2020-06-01T12:00:00") + i * 10**9 + 250_000_000 for i in range(N)]
    np.testing.assert_allclose(track.geodetic[:, 1], LON, atol=1e-6)


@pytest.mark.parametrize("text, line", [("point,X_m,Höhe\nA,1,2\n", 1), ("point,X_m\nA,1\nMühle,2\n", 3)])
def test_a_table_that_is_not_utf8_is_told_by_its_line(tmp_path, text, line):
    """As German spreadsheets save a CSV unless they are told otherwise."""
    path = tmp_path / "control.csv"
    path.write_bytes(text.encode("cp1252"))
    letter = "ö" if line == 1 else "ü"
    with pytest.raises(
        UserError, match=rf"control.csv:{line}: a letter that is not UTF-8 \('{letter}' in Windows-1252\?\)"
    ):
        read_table(path, [Column("point", "text"), Column("X_m")], [])


def test_names_that_look_like_numbers_do_not_tell_the_decimal_sign(tmp_path):
    for name, text in (("1,2", "500.25"), ("1.2", "500,25")):
        path = tmp_path / "control.csv"
        path.write_text(f"point;X_m;Y_m;Z_m;role\n7;1;2;3;check\n{name};{text};{text};{text};check\n")
        table = read_table(path, [Column("point", "text"), Column("X_m"), Column("Z_m")], [])
        assert table["point"][1] == name and table["X_m"][1] == table["Z_m"][1] == 500.25


def test_sigmas_along_the_axes_of_a_crs_as_adjust_and_export_write_them(tmp_path):
    """Of a camera turned by 33 degrees near the edge of a zone, against the definition of the angles."""
    crs, kappa = "EPSG:32632", 33.0
    to_lonlat = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    names = ("X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")
    sigma = np.array([0.1, 0.4, 0.2, 0.01, 0.03, 0.05])
    head = ",".join(("time_s", *names, *(f"sigma_{name}" for name in names)))
    rows = [[1591012800 + i, 750000 + 70 * i, 5400000 + 70 * i, 2000, 2.0, -3.0, kappa, *sigma] for i in range(N)]
    texts = [",".join(map(str, row)) for row in rows]
    texts[2] = ",".join(map(str, rows[2][:-6])) + "," * 6  # a pose whose sigmas are not known
    path, some = tmp_path / "p.csv", tmp_path / "some.csv"
    path.write_text("\n".join([head, *texts]) + "\n")
    imported = read_any(path, "csv", Options(crs=crs))
    messages = list(imported.messages)
    assert imported.notes == [
        "p.csv: 1 poses without sigmas: they get the accuracies of poses that have none "
        "(--position-sigma, --attitude-sigma)",
        "p.csv: poses are 1 s apart: more than 0.2 s between two are a gap without orientation for 'process'",
    ]
    poses = [pose_sample(message.body) for message in messages if message.topic == "trajectory/smoothed"]

    lon, lat = to_lonlat.transform(*np.transpose([row[1:3] for row in rows]))
    grid = np.radians(pyproj.Proj(crs).get_factors(lon.mean(), lat.mean()).meridian_convergence)
    turn = np.array([[np.cos(grid), -np.sin(grid), 0], [np.sin(grid), np.cos(grid), 0], [0, 0, 1]]).T  # grid to east
    angles, s = np.radians([2.0, -3.0, kappa]), np.array([*sigma[:3], *np.radians(sigma[3:])])
    J = np.empty((3, 3))
    for k in range(3):
        d = 1e-6 * np.eye(3)[k]
        up, down = (angles_from_matrix(turn @ matrix_from_angles(*(angles + x))) for x in (d, -d))
        J[:, k] = (up - down) / 2e-6
    wanted = np.zeros((6, 6))
    wanted[:3, :3], wanted[3:, 3:] = turn @ np.diag(s[:3] ** 2) @ turn.T, J @ np.diag(s[3:] ** 2) @ J.T
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    for i in (0, 1, 3, 4, 5):
        np.testing.assert_allclose(poses[i].covariance / scale, wanted / scale, atol=2e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(poses[2].covariance)), np.diag(Accuracy().covariance) ** 0.5)
    project = messages[0].body
    np.testing.assert_allclose(project.offset_sigma_m, np.sqrt(np.diag(wanted))[:3], rtol=1e-3)

    some.write_text("\n".join(",".join(row.split(",")[:-1]) for row in (head, *texts)) + "\n")
    imported = read_any(some, "csv", Options(crs=crs))
    assert imported.notes[0] == "some.csv: no column sigma_kappa_deg: the other sigmas of the attitude do not count"
    assert "some.csv: no accuracies of the attitudes: 0.01 and 0.02 deg taken (--attitude-sigma)" in imported.notes
    poses = [pose_sample(message.body) for message in imported.messages if message.topic == "trajectory/smoothed"]
    of_place, of_angles = slice(0, 3), slice(3, 6)
    for i, place in ((0, wanted), (2, Accuracy().covariance)):
        np.testing.assert_allclose(poses[i].covariance[of_place, of_place], place[of_place, of_place], atol=2e-5)
        usual = Accuracy().covariance[of_angles, of_angles]
        np.testing.assert_allclose(poses[i].covariance[of_angles, of_angles], usual, rtol=1e-6)


BARE = COLUMNS.replace("roll_deg", "roll")
BAD = {
    "no unit": ("time_s", UNIX, BARE, TAIL, None, "p.csv:1: roll: the unit is not stated, wanted roll_deg or roll_rad"),
    "feet": (
        "time_s",
        UNIX,
        COLUMNS.replace("height_m", "height_ft") + ",height_rad",
        [f"{t},1" for t in TAIL],
        None,
        "p.csv:1: height_rad: the unit is not stated, wanted height_m",
    ),
    "no heading": (
        "time_s",
        UNIX,
        COLUMNS.replace("heading", "track"),
        TAIL,
        None,
        "p.csv:1: heading_deg: column missing",
    ),
    "twice": (
        "time_s",
        UNIX,
        f"{COLUMNS},yaw_deg",
        [f"{t},1" for t in TAIL],
        None,
        "p.csv:1: yaw_deg: heading comes twice",
    ),
    "no such year": (
        "time_s",
        [*UNIX[:-1], "1e19"],
        COLUMNS,
        TAIL,
        None,
        f"p.csv:{N + 1}: time_s: 1e+19, wanted seconds since 1970-01-01 UTC",
    ),
    "before 1970": (
        "time_s",
        ["-3.5", *UNIX[1:]],
        COLUMNS,
        TAIL,
        None,
        "p.csv:2: time_s: -3.5 is before 1970, wanted UTC seconds since then",
    ),
    "no time": ("when", UNIX, COLUMNS, TAIL, None, "p.csv:1: time_s: column missing, wanted time_s (UTC, since 1970)"),
    "a word": (
        "time",
        ["noon", *TIMES["ISO"][1][1:]],
        COLUMNS,
        TAIL,
        None,
        "p.csv:2: time: 'noon', wanted an ISO 8601",
    ),
    "seconds without scale": (
        "time",
        ["5.5", *TIMES["ISO"][1][1:]],
        COLUMNS,
        TAIL,
        None,
        "p.csv:2: time: 5.5 has no scale",
    ),
    "ms of the week": (
        "gps_s",
        ["129618000"] * N,
        COLUMNS,
        TAIL,
        None,
        "p.csv:2: gps_s: 1.29618e+08, wanted seconds of",
    ),
    "not in the week": (
        "week,gps_s",
        ["2108,700000"] * N,
        COLUMNS,
        TAIL,
        None,
        "p.csv:2: gps_s: 700000, wanted seconds of",
    ),
    "another day, Unix": (
        "time_s",
        UNIX,
        COLUMNS,
        TAIL,
        date(2020, 6, 9),
        "--date 2020-06-09, but its times begin on 2020-06-01",
    ),
    "another day, week": (
        *TIMES["week"][:2],
        COLUMNS,
        TAIL,
        date(2020, 6, 9),
        "--date 2020-06-09, but its times begin on",
    ),
    "another weekday": (*TIMES["day"][:2], COLUMNS, TAIL, date(2020, 6, 4), "say Monday, but 2020-06-04 is a Thursday"),
    "degrees for radians": (
        "time_s",
        UNIX,
        COLUMNS.replace("heading_deg", "heading_rad"),
        TAIL,
        None,
        "p.csv:2: heading_rad: 45, wanted radians; are they degrees? (and 5 more like it)",
    ),
    "positions in radians": (
        "time_s",
        UNIX,
        COLUMNS,
        [f"{radians(LAT[i]):.9f},{radians(LON[i]):.9f},2000,0,0,45" for i in range(N)],
        None,
        "p.csv: lat_deg, lon_deg: radians in columns of degrees?",
    ),
    "headings in radians": (
        "time_s",
        UNIX,
        COLUMNS,
        [f"{LAT[i]:.6f},{11 - (LON[i] - 11):.6f},2000,0,0,-0.785" for i in range(N)],
        None,
        "p.csv: heading_deg: radians in a column of degrees?",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_tables(tmp_path, what):
    head, times, columns, tail, day, wanted = BAD[what]
    path = write(tmp_path / "p.csv", head, times, columns, tail)
    with pytest.raises(UserError) as error:
        list(read_any(path, "csv", Options(day=day)).messages)
    assert wanted in str(error.value) and "\n" not in str(error.value)


def test_a_flight_of_a_metre_a_second_is_named(tmp_path):
    tail = [f"{48 + 0.000009 * i:.7f},11,2000,0,0,0" for i in range(N)]
    track = read_track(write(tmp_path / "p.csv", "time_s", UNIX, tail=tail), "csv", Options())
    assert track.notes == (
        "p.csv: a flight of 1 m/s (median), wanted 5 to 350; are times in seconds, and positions in degrees?",
    )


# ---- Headwall, Resonon

HEADWALL = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading"


def headwall_rows(day="2020/06/01"):
    return [f"1.5\t-2.5\t45\t{LAT[i]:.6f}\t{LON[i]:.6f}\t2000\t{i}\t{day} 12:00:0{i}.250000\t4\t44" for i in range(N)]


@pytest.mark.parametrize("day", ["2020/06/01", "2020/Jun/01"])
def test_headwall(tmp_path, day):
    rows = headwall_rows(day)
    path = tmp_path / "imu_gps.txt"
    path.write_text("\n".join([HEADWALL, rows[0], *rows]) + "\n")
    assert kind_of_path(path) == "headwall"
    track = read_track(path, "headwall", Options(day=date(2020, 6, 1)))
    assert track.time_ns.tolist() == [ns(START) + i * 10**9 + 250_000_000 for i in range(N)]
    np.testing.assert_allclose(track.geodetic[3], [LAT[3], LON[3], 2000], atol=1e-6)
    np.testing.assert_allclose(np.degrees(track.rpy[0]), [1.5, -2.5, 45])
    assert "1 poses repeat the time" in track.notes[-1]


def test_headwall_damaged(tmp_path):
    path, rows = tmp_path / "imu_gps.txt", headwall_rows()
    good = "\n".join([HEADWALL, *rows])
    for text, day, wanted in (
        (good.replace("\tAlt", "\tElev"), None, r"imu_gps.txt:1: Alt: column missing, wanted Roll, Pitch"),
        (good.replace("48.000900", "north"), None, r"imu_gps.txt:3: Lat: 'north' is not a number"),
        (
            good.replace("12:00:02", "25:00:02"),
            None,
            r"imu_gps.txt:4: Gps_UTC_Date&Time: '2020/06/01 25:00:02.250000', wan",
        ),
        (good, date(2020, 1, 1), r"--date 2020-01-01, but its times begin on 2020-06-01"),
        (
            good.replace("12:00:03.250000", "12:00:03.\u00b2"),
            None,
            r"imu_gps.txt:5: Gps_UTC_Date&Time: '2020/06/01 12:00:03.\u00b2",
        ),
        (HEADWALL + "\n" + rows[0], None, r"imu_gps.txt: 1 rows, wanted at least 2"),
    ):
        path.write_text(text + "\n")
        with pytest.raises(UserError, match=wanted):
            read_track(path, "headwall", Options(day=day))


def lcf_rows(before=0):
    """As Resonon specifies it: roll positive with the right wing up, GPS seconds (``before`` them others)."""
    turn = "\t".join(f"{radians(v):.9f}" for v in (-1.5, -2.5, 45))
    start = 1591012800 + 18 - 315964800 + before
    return [f"{start + i}.25\t{turn}\t{LON[i]:.6f}\t{LAT[i]:.6f}\t2000.0\t0\t0\t5\t12" for i in range(N)]


def test_resonon(tmp_path):
    path = tmp_path / "flight.lcf"
    path.write_text("\n".join(lcf_rows()) + "\n")
    assert kind_of_path(path) == "resonon"
    track = read_track(path, "resonon", Options())
    assert track.time_ns[1] == ns(START) + 1_250_000_000
    np.testing.assert_allclose(track.geodetic[3], [LAT[3], LON[3], 2000], atol=1e-6)
    np.testing.assert_allclose(np.degrees(track.rpy[0]), [1.5, -2.5, 45], atol=1e-6)
    assert track.notes[0].endswith("GPS seconds since 1980-01-06: the flight begins at 2020-06-01T12:00:00Z")
    for text, day, wanted in (
        (
            "\n".join(lcf_rows()).replace("0.785398163", "45"),
            None,
            r"flight.lcf:1: yaw: 45, wanted radians; are they deg",
        ),
        ("\n".join(lcf_rows()).replace("48.000900", "x"), None, r"flight.lcf:2: latitude: 'x' is not a number"),
        ("1 2 3\n4 5 6\n", None, r"flight.lcf:1: yaw|flight.lcf:1: longitude: missing"),
        ("\n".join(lcf_rows()), date(2019, 1, 1), r"--date 2019-01-01, but its times begin on 2020-06-01"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=wanted):
            read_track(path, "resonon", Options(day=day))


def test_a_day_tells_that_a_resonon_log_counts_from_1970(tmp_path):
    path = tmp_path / "flight.lcf"
    path.write_text("\n".join(lcf_rows(before=315964800 - 18)))
    track = read_track(path, "resonon", Options(day=date(2020, 6, 1)))
    assert track.time_ns[1] == ns(START) + 1_250_000_000
    assert "seconds since 1970-01-01 (UTC)" in track.notes[0]
    assert "begins at 2030-" in read_track(path, "resonon", Options()).notes[0]


def test_lines_of_a_resonon_log_that_are_not_to_be_used_are_left_out(tmp_path):
    """They have positions of before the first fix."""
    path, rows = tmp_path / "flight.lcf", lcf_rows()
    unused = [row.replace("\t5\t12", "\t0\t12") for row in rows]
    path.write_text("\n".join([*unused[:2], *rows[2:]]))
    track = read_track(path, "resonon", Options())
    assert len(track) == N - 2 and "2 poses that the file says not to use were left out" in track.notes[-1]
    path.write_text("\n".join(unused))
    assert len(read_track(path, "resonon", Options())) == N


def test_heights_above_a_geoid_that_is_not_here_are_refused(tmp_path):
    """They were taken for heights above the ellipsoid without a word, 47 m off in the Alps."""
    if not missing_grids("EPSG:32632+EPSG:5773"):
        pytest.skip("PROJ has the geoid here")
    path = tmp_path / "poses.csv"
    rows = [f"2020-06-01T12:00:0{i}Z,600000,{5300000 + 50 * i},1000,0,0,90" for i in range(3)]
    path.write_text("\n".join(["time,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg", *rows, ""]))
    with pytest.raises(UserError, match=r"poses.csv: PROJ lacks the grid us_nga.*heights would be off by the geoid"):
        read_any(path, options=Options(crs="EPSG:32632+EPSG:5773"))
    assert len(read_track(path, "csv", Options(crs="EPSG:32632"))) == 3
    if missing_grids("EPSG:31467"):  # a datum shift is no geoid
        with pytest.raises(
            UserError, match=r"lacks the grid de_adv_BETA2007.tif .* positions would be off by the datum"
        ):
            read_any(path, options=Options(crs="EPSG:31467"))
        assert off_without_grids("EPSG:31467+EPSG:5773").endswith("datum shift, heights would be off by the geoid")
    exterior = {"crs": "EPSG:32632+EPSG:5773", "position": [600000, 5300000, 1000], "omega_phi_kappa_deg": [0, 0, 90]}
    interior = {"focal_length_mm": 100, "pixel_size_mm": 0.01, "lines": 100, "samples": 100}
    frame = tmp_path / "frame.json"
    frame.write_text(json.dumps({"interior": interior, "exterior": exterior}))
    with pytest.raises(UserError, match=r"frame.json: PROJ lacks the grid"):
        read_frame(frame, [])
