"""RTKLIB positions: their times, axes and sigmas, in a sensor folder and alone."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyproj
import pytest
from test_sensor_folder import write

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import kind_of_path, read_any
from triline.nodes.formats.rtklib import read_rtklib
from triline.nodes.formats.sensor_folder import read_sensor_folder
from triline.solver.arrays import Array

START = datetime(2024, 5, 17, 9, 30, tzinfo=UTC)
LEAP = timedelta(seconds=18)
ABOVE = "% program   : RTKPOST ver.2.4.3\n% obs start : 2024/05/17 09:30:18.0 GPST (week2314 466218.0s)\n%\n"
HEIGHTS = "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)\n"
PLACE, SIGMAS = "latitude(deg) longitude(deg)  height(m)   Q  ns", "sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)"
NAMES = f"{PLACE}   {SIGMAS} age(s)  ratio"
SPEEDS = "    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun"
ROW = (
    "48.{i:02d}0000000   11.500000000   612.3456   {q}  12   "
    "0.0100   0.0200   0.0500  -0.0030   0.0040  -0.0010   0.00   9.9"
)
SPEED = "   20.00000   -3.00000    1.00000   0.10000  0.20000  0.30000  0.00000  0.00000  0.00000"


def text_of(scale: str = "GPST", names: str = NAMES, row: str = ROW, times: list[str] | None = None, n: int = 8) -> str:
    """A file of n positions a quarter of a second apart; the last two are not fixed."""
    ahead = LEAP if scale == "GPST" else timedelta()
    when = [START + ahead + timedelta(seconds=0.25 * i) for i in range(n)]
    words = times or [f"{t:%Y/%m/%d %H:%M:%S}.{t.microsecond // 1000:03d}" for t in when]
    rows = [f"{word}   {row.format(i=i, q=1 if i < n - 2 else 2)}" for i, word in enumerate(words)]
    return f"{ABOVE}{HEIGHTS}%  {scale}                  {names}\n" + "\n".join(rows) + "\n"


def read(path: Path, text: str):
    path.write_text(text)
    notes: list[str] = []
    return read_rtklib(path, notes), notes


def gps_weeks(scale: str = "GPST") -> str:
    whole = [START + LEAP + timedelta(seconds=0.25 * i) - datetime(1980, 1, 6, tzinfo=UTC) for i in range(8)]
    weeks = [divmod(t.total_seconds(), 604_800) for t in whole]
    return text_of(scale, times=[f"{int(week)} {seconds:.3f}" for week, seconds in weeks])


@pytest.mark.parametrize(
    "text", [text_of("GPST"), text_of("UTC"), gps_weeks(), text_of().replace("   ", ",").replace("  ", ",")]
)
def test_times_positions_and_sigmas(tmp_path, text):
    gnss, notes = read(tmp_path / "a.pos", text)
    np.testing.assert_allclose(gnss.time_s - START.timestamp(), 0.25 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(np.degrees(gnss.lat), 48 + 0.01 * np.arange(8), rtol=1e-14)
    np.testing.assert_allclose(np.degrees(gnss.lon), 11.5, rtol=1e-14)
    assert (gnss.height_m == 612.3456).all() and gnss.velocity_n is None
    np.testing.assert_array_equal(gnss.sigma_ned_m, np.tile([0.01, 0.02, 0.05], (8, 1)))
    assert notes == ["a.pos: 8 positions: 75.0% fixed, 25.0% float"]


def test_velocities_are_north_east_down(tmp_path):
    gnss, _ = read(tmp_path / "a.pos", text_of(names=NAMES + SPEEDS, row=ROW + SPEED))
    assert gnss.velocity_n is not None and gnss.sigma_velocity_n is not None
    np.testing.assert_array_equal(gnss.velocity_n[3], [20.0, -3.0, -1.0])
    np.testing.assert_array_equal(gnss.sigma_velocity_n[3], [0.1, 0.2, 0.3])


def test_positions_in_x_y_z_have_the_sigmas_of_north_east_and_down(tmp_path):
    to_xyz = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

    def xyz(lat: float, lon: float, height: float) -> Array:
        return np.array(to_xyz.transform(lon, lat, height))

    place = (-35.2, 149.1, 700.0)
    ways = [xyz(place[0] + 1e-5, *place[1:]), xyz(place[0], place[1] + 1e-5, place[2]), xyz(*place[:2], 701.0)]
    axes = np.column_stack([(way - xyz(*place)) / np.linalg.norm(way - xyz(*place)) for way in ways])
    C = axes @ np.diag(np.square([0.01, 0.02, 0.05])) @ axes.T
    mixed = [np.sign(C[i, j]) * np.sqrt(abs(C[i, j])) for i, j in ((0, 1), (1, 2), (2, 0))]
    values = [*xyz(*place), 1, 12, *np.sqrt(np.diag(C)), *mixed, 0.0, 9.9]
    names = "x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio"
    row = "  ".join(f"{value:.9f}" for value in values)
    moved = axes @ [20.0, -3.0, 1.0]
    speeds = " vx(m/s) vy(m/s) vz(m/s) sdvx sdvy sdvz sdvxy sdvyz sdvzx"
    speed = "  ".join(f"{value:.9f}" for value in (*moved, *np.sqrt(np.diag(C)), *mixed))
    gnss, _ = read(tmp_path / "a.pos", text_of(names=names + speeds, row=f"{row}  {speed}"))
    assert gnss.velocity_n is not None and gnss.sigma_velocity_n is not None
    np.testing.assert_allclose(gnss.velocity_n[3], [20.0, -3.0, -1.0], atol=1e-4)
    np.testing.assert_allclose(gnss.sigma_velocity_n[3], [0.01, 0.02, 0.05], rtol=1e-4)
    np.testing.assert_allclose(np.degrees([gnss.lat[0], gnss.lon[0]]), place[:2], atol=1e-9)
    np.testing.assert_allclose(gnss.height_m, place[2], atol=1e-6)
    np.testing.assert_allclose(gnss.sigma_ned_m, np.tile([0.01, 0.02, 0.05], (8, 1)), rtol=1e-4)


@pytest.mark.parametrize(
    "change, wanted",
    [
        (lambda t: t.replace("  GPST  ", "  JST  "), "a.pos:5: times in JST, wanted GPST or UTC"),
        (lambda t: t.replace("WGS84/ellipsoidal", "WGS84/geodetic"), "heights above the geoid .*, wanted those above"),
        (
            lambda t: t.replace("height=WGS84", "height=Tokyo"),
            "a.pos:4: positions in the datum Tokyo, wanted",
        ),
        (lambda t: t + text_of("UTC"), "a.pos:18: other columns than in line 5, wanted one kind in a file"),
        (lambda t: t + t.replace("WGS84/ellipsoidal", "WGS84/geodetic"), "a.pos:17: heights above the geoid"),
        (lambda t: t.replace("612.3456", "612,3456"), "a.pos:6: .*, wanted day and time"),
        (lambda t: t.replace("09:30:18.750", "99:30:18.750"), "a.pos:9: .*, wanted day and time"),
        (lambda t: t.replace("latitude(deg)", "latitude(d'\")"), r"latitude\(deg\): column missing, wanted"),
        (lambda t: t.replace("sdn(m)", "sd(m)"), r"sdn\(m\): column missing"),
        (lambda t: t.replace("% GPST", "").replace("latitude", "breadth"), "no line of column names, wanted '% GPST"),
        (lambda t: t.replace("48.03", "north"), "a.pos:9: '2024/05/17 09:30:18.750 .*, wanted day and time"),
        (lambda t: t.replace("48.03", "north").replace("48.05", "x"), r"and 1 more like it"),
        (lambda t: t[:-40], "a.pos:13: .*, wanted day and time .* and 13 values as the names say"),
        (lambda t: t.replace("09:30:18.750", "9h30"), "a.pos:9: "),
        (lambda t: t.replace("2024/05/17", "2024/13/17"), "a.pos:6: "),
        (lambda t: "\n".join(t.splitlines()[:5]), "no position below the column names"),
        (lambda t: gps_weeks("UTC"), "a.pos:6: .*, wanted day and time and 13 values"),
    ],
)
def test_files_that_cannot_be(tmp_path, change, wanted):
    with pytest.raises(UserError, match=wanted):
        read(tmp_path / "a.pos", change(text_of()))


def test_fixes_at_latitude_and_longitude_zero_are_dropped(tmp_path):
    path = tmp_path / "a.pos"
    path.write_text(re.sub(r" 48.0[01]0+ +11.50+ ", " 0.000000000 0.000000000 ", text_of()))
    imported = read_any(path)
    assert sum(m.topic == "sensor/gnss" for m in imported.messages) == 6
    assert "a.pos: 2 fixes without a position: dropped" in imported.notes


def test_what_a_file_does_not_say_about_heights_and_another_datum_are_told(tmp_path):
    _, notes = read(tmp_path / "a.pos", text_of().replace(HEIGHTS, ""))
    assert "a.pos: heights are taken as those above the ellipsoid of WGS 84; the file does not say" in notes
    _, notes = read(tmp_path / "a.pos", text_of().replace("height=WGS84", "height=CGCS2000"))
    assert "a.pos: datum CGCS2000, taken as WGS 84" in notes


def test_positions_alone_become_fixes(tmp_path, capsys):
    path = tmp_path / "day_1.pos"
    path.write_text(text_of())
    assert kind_of_path(path) == "rtklib"
    imported = read_any(path)
    project, *fixes = (message.body for message in imported.messages)
    assert project.name == "day_1" and len(fixes) == 8
    assert [fixes[2].position_covariance[i] for i in (0, 4, 8)] == pytest.approx([4e-4, 1e-4, 25e-4])
    assert any("become sensor/gnss, not poses" in note for note in imported.notes)
    path.write_text(text_of().replace("0.0500", "0.0000"))
    assert main(["import", str(path), "-o", str(tmp_path / "o.mcap")]) == 1
    err = capsys.readouterr().err
    assert "day_1.pos: sigma down is zero or not a number in all 8 fixes" in err and err.count("\n") == 1


def test_a_sensor_folder_takes_them_in_place_of_gnss_csv(tmp_path, capsys):
    """The same navigation, to the digits that either file has."""
    folder = write(tmp_path / "flight")
    shift_s = START.timestamp()
    table = np.loadtxt(folder / "imu.csv", delimiter=",", skiprows=1)
    header = (folder / "imu.csv").read_text().splitlines()[0]
    table[:, 0] += shift_s
    np.savetxt(folder / "imu.csv", table, "%.14g", ",", header=header, comments="")
    fixes = np.loadtxt(folder / "gnss.csv", delimiter=",", skiprows=1)
    rows = []
    for time_s, *values in fixes.tolist():
        t = START + LEAP + timedelta(seconds=time_s)
        lat, lon, height, n, e, d = values
        place = f"{lat:.12f} {lon:.12f} {height:.6f} 1 9 {n:.6f} {e:.6f} {d:.6f} 0 0 0 0 9.9"
        rows.append(f"{t:%Y/%m/%d %H:%M:%S.%f} {place}")
    (folder / "gnss.pos").write_text(f"{ABOVE}{HEIGHTS}%  GPST   {NAMES}\n" + "\n".join(rows) + "\n")
    with pytest.raises(UserError, match=r"gnss.csv and gnss.pos, wanted one of them"):
        read_sensor_folder(folder)
    fixes[:, 0] += shift_s
    old = (folder / "gnss.csv").read_text().splitlines()[0]
    found = []
    for name in ("gnss.csv", "gnss.pos"):
        if name == "gnss.csv":
            other = (folder / "gnss.pos").rename(tmp_path / "kept.pos")
            np.savetxt(folder / name, fixes, "%.14g", ",", header=old, comments="")
        else:
            (folder / "gnss.csv").unlink()
            other.rename(folder / "gnss.pos")
        assert main(["navigate", str(folder), "-o", str(tmp_path / name), "--no-page"]) == 0
        found.append(np.loadtxt(tmp_path / name / "trajectory.csv", delimiter=",", skiprows=1))
    np.testing.assert_allclose(found[0][:, 1:3], found[1][:, 1:3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(found[0][:, 3], found[1][:, 3], rtol=0, atol=1e-3)
    assert f"gnss.pos: {len(rows)} positions: 100.0% fixed" in capsys.readouterr().err
