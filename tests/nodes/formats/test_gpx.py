"""GPX tracks, written here: with attitudes they are poses, without them fixes."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
from tracks import ns

from triline.nodes.cli import main
from triline.nodes.convert import time_ns
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import Options, kind_of_path, read_any, read_track
from triline.nodes.formats.ground_height import GroundGiven
from triline.nodes.formats.track import Accuracy
from triline.nodes.simulator.motion_track import motion_track

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1" xmlns:d="http://example.org/drone">
<trk><name>line 1</name><trkseg>
"""


def point(i, more="", ele="612.5", time=None, lat=None):
    """The i-th of points a second and some 60 m apart, towards the north."""
    time = f"2024-05-17T09:30:{i:02d}.25Z" if time is None else time
    lat = f"{48 + i * 0.00055:.5f}" if lat is None else lat
    return f'<trkpt lat="{lat}" lon="11.5"><ele>{ele}</ele><time>{time}</time>{more}</trkpt>\n'


def attitude(i, heading="heading"):
    return f"<extensions><d:roll>{0.1 * i}</d:roll><d:pitch>-1</d:pitch><d:{heading}>2.5</d:{heading}></extensions>"


def write(path, points, head=HEAD):
    path.write_text(head + "".join(points) + "</trkseg></trk></gpx>\n")
    return path


@pytest.mark.parametrize("heading", ["heading", "yaw", "course"])
def test_points_with_attitudes_are_poses(tmp_path, heading):
    more = [f"<geoidheight>46.5</geoidheight>{attitude(i, heading)}" for i in range(5)]
    path = write(tmp_path / "a.gpx", [point(i, more[i]) for i in range(5)])
    assert kind_of_path(path) == "gpx"
    track = read_track(path, "gpx", Options())
    np.testing.assert_allclose(track.geodetic[3], [48.00165, 11.5, 659.0])
    np.testing.assert_allclose(np.degrees(track.rpy[3]), [0.3, -1.0, 2.5])
    assert track.time_ns[3] == ns("2024-05-17T09:30:03") + 250_000_000
    assert any("heading taken from course" in note for note in track.notes) == (heading == "course")
    messages = list(read_any(path).messages)
    assert [m.topic for m in messages] == ["configuration/project", *["trajectory/smoothed"] * 5]
    assert len(motion_track(path)) == 5


def test_points_without_attitudes_are_fixes(tmp_path, capsys):
    path, out = write(tmp_path / "a.gpx", [point(i) for i in range(4)]), tmp_path / "o.mcap"
    accuracy = Accuracy((1.0, 2.0, 3.0), position_stated=True)
    imported = read_any(path, options=Options(accuracy=accuracy, ground=GroundGiven(400.0)))
    project, *fixes = list(imported.messages)
    assert project.body.origin_height == 400.0 and {m.topic for m in fixes} == {"sensor/gnss"}
    assert (fixes[1].body.latitude, fixes[1].body.altitude) == (48.00055, 612.5)
    assert time_ns(fixes[1].body.timestamp) == ns("2024-05-17T09:30:01") + 250_000_000
    assert [fixes[0].body.position_covariance[i] for i in (0, 4, 8)] == [1.0, 4.0, 9.0]
    assert main(["import", str(path), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    for word in ("5 m and 10 m in height taken", "they become sensor/gnss, not poses", "ele is taken as height above"):
        assert word in said
    for read in (lambda: motion_track(path), lambda: read_track(path, "gpx", Options())):
        with pytest.raises(UserError, match=r"a.gpx: positions without attitudes, wanted roll, pitch and heading"):
            read()


def test_angles_of_a_gimbal_are_not_those_of_the_aircraft(tmp_path):
    """They stand deeper; the first of a name in the file counted, heading of the gimbal beside roll of the aircraft."""
    gimbal = "<d:gimbal><d:roll>0</d:roll><d:pitch>-90</d:pitch><d:yaw>10</d:yaw></d:gimbal>"
    more = [attitude(i, "yaw").replace("<extensions>", f"<extensions>{gimbal}") for i in range(4)]
    track = read_track(write(tmp_path / "a.gpx", [point(i, more[i]) for i in range(4)]), "gpx", Options())
    np.testing.assert_allclose(np.degrees(track.rpy[3]), [0.3, -1.0, 2.5])


def test_points_without_a_fix_are_left_out(tmp_path):
    more = ["<fix>none</fix>", "<fix>3d</fix>", "<fix>dgps</fix>", ""]
    path = write(tmp_path / "a.gpx", [point(i, more[i], lat="0" if i == 0 else None) for i in range(4)])
    imported = read_any(path)
    assert [m.body.latitude for m in imported.messages if m.topic == "sensor/gnss"] == [48.00055, 48.0011, 48.00165]
    assert "a.gpx: 1 points without a fix were left out" in imported.notes
    with pytest.raises(UserError, match=r"a.gpx: 1 points with a fix, wanted at least 2"):
        list(read_any(write(path, [point(i, "<fix>none</fix>" * (i > 0)) for i in range(4)])).messages)


def test_an_attitude_that_some_points_lack_is_told_and_a_course_is_none(tmp_path):
    lacking = [point(i, attitude(i) if i else "") for i in range(4)]
    with pytest.raises(UserError, match=r"trkpt\[1\]/roll: missing, wanted degrees \(and 2 more like it\)"):
        read_any(write(tmp_path / "a.gpx", lacking))
    courses = [point(i, "<course>90</course>" if i in (0, 3) else "") for i in range(4)]
    assert len(list(read_any(write(tmp_path / "b.gpx", courses)).messages)) == 5


def test_a_track_that_cannot_be_read_gets_one_line(tmp_path, capsys):
    good = [point(i, attitude(i)) for i in range(4)]
    where = "gpx/trk/trkseg/trkpt[3]"
    for points, wanted in (
        ([], "gpx/trk/trkseg/trkpt: missing, wanted a track with points"),
        (good[:1], "wanted a track with points that have time and ele"),
        ([*good[:2], point(2, attitude(2), time="noon")], f"{where}/time: 'noon', wanted an ISO 8601 time"),
        ([*good[:2], point(2, attitude(2), time="")], f"{where}/time: missing, wanted an ISO 8601 time"),
        ([*good[:2], point(2, attitude(2), ele="high")], f"{where}/ele: 'high', wanted metres"),
        ([*good[:2], point(2, attitude(2), lat="48,5")], f"{where}/lat: '48,5', wanted degrees"),
        ([*good[:2], point(2, attitude(2), lat="95")], "record 3: latitude: 95, wanted -90 to 90 deg"),
        ([*good[:2], point(2)], f"{where}/roll: missing, wanted degrees"),
        ([good[1], good[1]], "1 poses with rising time, wanted at least 2"),
    ):
        path, out = write(tmp_path / "a.gpx", points), tmp_path / "o.mcap"
        assert main(["import", str(path), "-o", str(out)]) == 1, wanted
        err = capsys.readouterr().err
        assert wanted in err and err.count("\n") == 1 and "a.gpx" in err and not out.exists(), err
    path.write_text(HEAD + good[0])
    assert main(["import", str(path), "-o", str(out)]) == 1
    assert "a.gpx:5: not whole XML" in capsys.readouterr().err
    write(path, good)
    with pytest.raises(UserError, match="--date 2024-05-20, but its times begin on 2024-05-17"):
        read_track(path, "gpx", Options(day=date(2024, 5, 20)))
    with pytest.raises(UserError, match="radians in a column of degrees"):
        write(path, [point(i, attitude(i).replace("2.5", "1.5708")).replace('lat="48.', 'lat="48.') for i in range(9)])
        text = path.read_text()
        for i in range(9):  # towards the east
            text = text.replace(f'lat="{48 + i * 0.00055:.5f}" lon="11.5"', f'lat="48" lon="{11.5 + i * 0.0008:.5f}"')
        path.write_text(text)
        read_track(path, "gpx", Options())
