"""Export of topics: rows and columns, map features, SBET; round trips and what a user is told."""

from __future__ import annotations

import csv
import json
import sqlite3
import struct
from dataclasses import replace
from datetime import date

import numpy as np
import pandas as pd
import pytest
from full_disk import files_of_at_most
from recording_file import write_recording
from small_block import simulated_block

from triline.nodes.cli import main, process
from triline.nodes.convert import camera_message, gnss_message, ground_point_message, pose_message
from triline.nodes.errors import UserError
from triline.nodes.formats.block_messages import block_messages
from triline.nodes.formats.camera_json import write_camera
from triline.nodes.formats.detect import Options, read_any
from triline.nodes.formats.line_orientation import OrientedLines, write_oriented_lines, write_patb_lines
from triline.nodes.formats.rows import ElementLayout, RowLayout, repeated_messages
from triline.nodes.formats.track import Mounting, NavigationTrack, track_messages
from triline.nodes.node import Message
from triline.nodes.recording.access import Recording
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.schemas.topics import TOPICS
from triline.schemas.units import UNITS
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import LocalFrame

FRAME = LocalFrame(47.5, 10.6, 0.0)
START = 1_600_000_000 * 10**9


def _project() -> Message:
    body = m.Project(
        name="p", crs="local", origin_latitude=47.5, origin_longitude=10.6, boresight_deg=[0.5, -0.3, 90.0]
    )
    return Message("configuration/project", START, body, "test")


def _residual(strip: str, v: float):
    return m.RayResidual(strip=strip, ccd="N", line=10.0, sample=20.0, v_line=v, v_sample=-v)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """One message or more on topics of every shape."""
    path = tmp_path_factory.mktemp("export") / "flight.mcap"
    covariance = np.diag([0.01, 0.04, 0.09, 1e-8, 4e-8, 9e-8])
    messages = [_project()]
    for i in range(20):
        t = START + i * 10**8
        pose = pose_message(
            t, [10.0 * i, 5.0, 1000.0], [0.01, -0.02, 0.3], covariance if i else None,
            strip="S1" if i < 12 else "S2", correction=np.arange(6.0) if i else None,
        )  # fmt: skip
        messages.append(Message("orientation/final", t, pose, "adjuster"))
        messages.append(
            Message("sensor/gnss", t, gnss_message(t, [47.5 + i * 1e-6, 10.6, 600.0], [0.1, 0.2, 0.3]), "gps")
        )
    for status, z in ((0, 100.0), (1, 101.0)):
        point = m.ObjectPoint(point="P1", x=100.0, y=200.0, z=z, covariance=np.diag([1e-4, 4e-4, 9e-4]).ravel(), rays=3)
        point.role, point.status = "tie", status
        point.residuals.extend([_residual("S1", 0.1), _residual("S2", 0.2)])
        messages.append(Message("point/object", START + (1 + status) * 10**9, point, "adjuster"))
    messages.append(
        Message("point/object", START + 3 * 10**9, m.ObjectPoint(point="P2", x=1.0, role="check"), "adjuster")
    )
    report = m.AdjustmentReport(update=1, sigma0=1.1, strip="S1")
    report.rejected.append(m.RejectedObservation(point="P9", w=-7.5, reason="snooping"))
    report.parameters.extend([m.ParameterEstimate(name="dX", value=0.1), m.ParameterEstimate(name="dY", value=0.2)])
    messages.append(Message("adjustment/report", START + 10**9, report, "adjuster"))
    ground = ground_point_message("G1", [1.0, 2.0, 3.0], np.diag([1e-4, 1e-4, 4e-4]), "planimetric")
    messages.append(Message("observation/control", START, ground, "test"))
    lines = LineBlock(np.zeros((4, 10), dtype="<u2"), "F", "S1", 100, START, 2_000_000)
    messages.append(Message("sensor/lines/F", START + 10**7, lines, "camera"))
    messages.sort(key=lambda message: message.stamp_ns)
    return write_recording(path, messages)


def _csv(recording, tmp_path, topic: str, *more: str) -> pd.DataFrame:
    target = tmp_path / "out.csv"
    assert main(["export", str(recording), "--topic", topic, "--csv", str(target), "-q", *more]) == 0
    return pd.read_csv(target, float_precision="round_trip")  # the default only since pandas 3


def test_one_row_a_message_with_columns_named_as_the_fields(recording, tmp_path):
    table = _csv(recording, tmp_path, "orientation/final")
    assert list(table.columns[:5]) == ["stamp_ns", "sequence", "source", "timestamp_ns", "frame_id"]
    assert table["timestamp_ns"].tolist() == table["stamp_ns"].tolist()
    assert len(table) == 20 and (table.source == "adjuster").all()
    assert table["stamp_ns"].tolist() == [START + i * 10**8 for i in range(20)]
    assert table["sequence"].tolist() == list(range(20))
    np.testing.assert_allclose(table["pose.position.x_m"], 10.0 * np.arange(20))
    np.testing.assert_allclose(
        table[["angles_omega_rad", "angles_phi_rad", "angles_kappa_rad"]], np.tile([0.01, -0.02, 0.3], (20, 1))
    )
    # a vector that was not sent is empty, not zero
    assert table["covariance_kappa_kappa_rad2"].isna().tolist() == [True] + [False] * 19
    np.testing.assert_allclose(table["covariance_Y_Y_m2"][1:], 0.04)
    np.testing.assert_allclose(table.filter(like="correction_").iloc[1], np.arange(6))
    assert table["strip"].tolist() == ["S1"] * 12 + ["S2"] * 8
    assert table["velocity.x_m_s"].isna().all()  # a sub-message that was not sent


@pytest.mark.parametrize("kind", ["csv", "geojson", "gpkg", "parquet", "sbet", "smrmsg"])
def test_a_full_disk_is_told_with_the_file_and_leaves_nothing(recording, tmp_path, capsys, kind):
    target = tmp_path / f"o.{kind}"
    with files_of_at_most(1000):
        assert main(["export", str(recording), "--topic", "orientation/final", f"--{kind}", str(target)]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"triline export: {target}: cannot be written: ") and err.count("\n") == 1
    assert kind == "gpkg" or err.endswith(": file too large\n")
    assert not list(tmp_path.iterdir())


def test_a_table_beside_the_target_does_not_go_over_the_recording(recording, tmp_path, capsys):
    flight = tmp_path / "o_residuals.csv"  # any name may be that of a recording
    flight.write_bytes(recording.read_bytes())
    assert main(["export", str(flight), "--topic", "point/object", "--csv", str(tmp_path / "o.csv")]) == 1
    assert f"{flight}: the output would overwrite the recording" in capsys.readouterr().err
    assert flight.read_bytes() == recording.read_bytes()


def test_elements_of_a_repeated_message_go_to_a_file_of_their_own(recording, tmp_path, capsys):
    table = _csv(recording, tmp_path, "point/object")
    assert table["point"].tolist() == ["P1", "P1", "P2"] and table["residuals.count"].tolist() == [2, 2, 0]
    assert not any(name.startswith("residuals.v") for name in table.columns)
    assert {"x_m", "y_m", "z_m", "covariance_X_Z_m2"} <= set(table.columns)
    beside = pd.read_csv(tmp_path / "out_residuals.csv")
    assert list(beside.columns[:6]) == ["stamp_ns", "sequence", "source", "point", "strip", "ccd"]
    assert beside["point"].tolist() == ["P1"] * 4 and beside["strip"].tolist() == ["S1", "S2"] * 2
    np.testing.assert_allclose(beside["v_line_px"], [0.1, 0.2, 0.1, 0.2])
    assert set(zip(beside.stamp_ns, beside.source, strict=True)) <= set(zip(table.stamp_ns, table.source, strict=True))
    _csv(recording, tmp_path, "adjustment/report")  # of several, those that have elements
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "out.csv", "out_parameters.csv", "out_rejected.csv", "out_residuals.csv"
    ]  # fmt: skip
    assert pd.read_csv(tmp_path / "out_parameters.csv")["name"].tolist() == ["dX", "dY"]
    target = tmp_path / "told.csv"
    assert main(["export", str(recording), "--topic", "point/object", "--csv", str(target)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"point/object -> {target}: 3 rows", f"  {tmp_path / 'told_residuals.csv'}: 4 rows"
    ]  # fmt: skip


def test_one_row_an_element(recording, tmp_path):
    table = _csv(recording, tmp_path, "point/object", "--rows", "residuals")
    assert not (tmp_path / "out_residuals.csv").exists()
    assert table["point"].tolist() == ["P1", "P1", "P1", "P1", "P2"]
    assert table["residuals.strip"].tolist()[:4] == ["S1", "S2", "S1", "S2"]
    np.testing.assert_allclose(table["residuals.v_line_px"][:4], [0.1, 0.2, 0.1, 0.2])
    assert table["status"].tolist() == ["live", "live", "final", "final", "live"]
    assert (
        np.isnan(table["residuals.v_line_px"][4]) and table["x_m"][4] == 1.0
    )  # no element: one row, element columns empty
    whole = _csv(recording, tmp_path, "point/object", "--rows", "none")
    assert len(whole) == 3 and whole["residuals.count"].tolist() == [2, 2, 0]


def test_which_repeated_field_becomes_rows(recording, tmp_path):
    table = _csv(recording, tmp_path, "adjustment/report")
    assert len(table) == 1 and table["rejected.count"][0] == 1 and table["parameters.count"][0] == 2
    table = _csv(recording, tmp_path, "adjustment/report", "--rows", "parameters")
    assert table["parameters.name"].tolist() == ["dX", "dY"] and table["rejected.count"].tolist() == [1, 1]
    table = _csv(recording, tmp_path, "adjustment/report", "--rows", "rejected")
    assert table["rejected.w"].tolist() == [-7.5]


def test_wildcard_topics_name_the_topic_and_leave_the_pixels_out(recording, tmp_path):
    for topic in ("sensor/lines/F", "sensor/lines/*"):
        table = _csv(recording, tmp_path, topic)
        assert table["frame_id"].tolist() == ["F"] and table["first_line"].tolist() == [100]
        assert not any("data" in column for column in table.columns)
    assert table["topic"].tolist() == ["sensor/lines/F"]


def test_every_nth_message(recording, tmp_path):
    assert _csv(recording, tmp_path, "orientation/final", "--every", "7")["sequence"].tolist() == [0, 7, 14]


@pytest.mark.parametrize("topic", [row.name for row in TOPICS])
def test_every_topic_of_the_table_has_rows(topic):
    """Default messages, and the columns fit the rows for every way of spreading."""
    row = next(row for row in TOPICS if row.name == topic)
    name = topic.replace("*", "X")
    for spread in (None, *repeated_messages(row.type_name)):
        layout = RowLayout(topic, spread)
        body = row.type()
        if spread is not None:
            getattr(body, spread).add()
        table = layout.frame([Message(name, 5, body, "s", 3)])
        assert len(table) == 1 and len(set(table.columns)) == len(table.columns)
        assert table.loc[0, "stamp_ns"] == 5 and table.loc[0, "sequence"] == 3
        if spread is not None:
            table = ElementLayout(topic, spread).frame([Message(name, 5, body, "s", 3)])
            assert len(table) == 1 and len(set(table.columns)) == len(table.columns)


def test_every_unit_belongs_to_a_field():
    """The test above refuses a field without unit; here: no unit of what is not there, and sizes are the codec's."""
    for type_name, fields in UNITS.items():
        descriptor = m.message_class(type_name).DESCRIPTOR
        for name, unit in fields.items():
            at = descriptor
            for part in name.split("."):
                field = at.fields_by_name[part]
                at = field.message_type
            assert isinstance(unit, str) or field.is_repeated
            size = codec._SIZES.get(type_name, {}).get(name)
            assert size is None or (isinstance(unit, tuple) and len(unit) == size), (type_name, name)
            for tail in ("ns", "mm", "m", "px", "deg", "s", "hz"):
                if isinstance(unit, str) and unit and name.endswith(f"_{tail}"):
                    assert unit == tail, name


def test_parquet_has_the_same_table(recording, tmp_path):
    pytest.importorskip("pyarrow")
    target = tmp_path / "out.parquet"
    assert main(["export", str(recording), "--topic", "orientation/final", "--parquet", str(target), "-q"]) == 0
    table, text = pd.read_parquet(target), _csv(recording, tmp_path, "orientation/final")
    assert list(table.columns) == list(text.columns) and table["stamp_ns"].dtype == "Int64"
    np.testing.assert_array_equal(table["stamp_ns"], text["stamp_ns"])
    np.testing.assert_array_equal(table["covariance_Z_Z_m2"].to_numpy(), text["covariance_Z_Z_m2"].to_numpy())


def test_csv_gives_the_numbers_back_to_the_last_bit(tmp_path):
    block = simulated_block()
    path = tmp_path / "b.mcap"
    write_recording(path, block_messages(block))
    table = _csv(path, tmp_path, "observation/tie", "--rows", "images")
    assert len(table) == len(block.image)
    got = sorted(zip(table["point"], table["images.strip"], table["images.ccd"], table["images.line_px"], strict=True))
    wanted = sorted((*block.image_name(i), float(block.image.line[i])) for i in range(len(block.image)))
    assert got == wanted


# ---- maps


def test_geojson(recording, tmp_path):
    target = tmp_path / "o.geojson"
    assert main(["export", str(recording), "--topic", "orientation/final", "--geojson", str(target), "-q"]) == 0
    features = json.loads(target.read_text())["features"]
    lines = [f for f in features if f["geometry"]["type"] == "LineString"]
    assert {f["properties"]["line"]: len(f["geometry"]["coordinates"]) for f in lines} == {"S1": 12, "S2": 8}
    points = [f for f in features if f["geometry"]["type"] == "Point"]
    lon, lat, height = points[3]["geometry"]["coordinates"]
    wanted = FRAME.to_geodetic([30.0, 5.0, 1000.0])
    assert (lat, lon, height) == pytest.approx(tuple(wanted), abs=1e-4)
    assert points[0]["properties"]["sigma_X_m"] is None
    assert points[3]["properties"]["sigma_Y_m"] == pytest.approx(0.2)
    assert points[3]["properties"]["sigma_kappa_deg"] == pytest.approx(np.degrees(3e-4))


def test_lines_on_maps_are_cut_where_poses_are_not_valid(tmp_path, capsys):
    """Their places say nothing; the points have a column that says so, a line has none."""
    messages = [_project()]
    for i in range(10):
        pose = pose_message(START + i * 10**8, [10.0 * i, 5000.0 if 4 <= i < 7 else 5.0, 1000.0], [0.0, 0.0, 0.1])
        pose.valid, pose.strip = not 4 <= i < 7, "S1"
        messages.append(Message("orientation/final", START + i * 10**8, pose, "adjuster"))
    path, target = write_recording(tmp_path / "a.mcap", messages), tmp_path / "o.geojson"
    words = ["export", str(path), "--topic", "orientation/final"]
    assert main([*words, "--geojson", str(target)]) == 0
    assert "11 features, 3 poses not valid and on no line" in capsys.readouterr().out
    line, *points = json.loads(target.read_text())["features"]
    assert line["geometry"]["type"] == "MultiLineString"
    assert [len(part) for part in line["geometry"]["coordinates"]] == [4, 3] and line["properties"]["points"] == 7
    assert sum(not point["properties"]["valid"] for point in points) == 3 and len(points) == 10
    assert main([*words, "--gpkg", str(tmp_path / "o.gpkg"), "-q"]) == 0
    with sqlite3.connect(tmp_path / "o.gpkg") as database:
        assert len(database.execute('SELECT * FROM "orientation_final_lines"').fetchall()) == 2


def _lines(strip: str) -> OrientedLines:
    n = 3
    times = START + np.arange(n, dtype=np.int64) * 10**7
    C = np.broadcast_to(np.diag([0.01, 0.04, 0.09, 1e-8, 1e-8, 1e-8]), (n, 6, 6))
    return OrientedLines(strip, np.arange(n), times, np.arange(3.0 * n).reshape(n, 3), np.tile(np.eye(3), (n, 1, 1)), C)


def test_names_with_quotes_and_commas_stay_in_their_column(tmp_path):
    """As RFC 4180 has it; a strip a,b moved all columns, and a point with a quote its own."""
    names = ['S,"1"', "S2", 'S"3']
    assert write_oriented_lines(tmp_path / "lines.csv", map(_lines, names), FRAME) == 9
    with open(tmp_path / "lines.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["strip"] for row in rows] == np.repeat(names, 3).tolist()
    assert all(row["line"] == str(i % 3) and float(row["sigma_Z_m"]) == 0.3 for i, row in enumerate(rows))
    points = [m.ObjectPoint(point=name, x=1.0, y=2.0, z=3.0, role="tie") for name in names]
    messages = [_project(), *(Message("point/object", START + k, point, "adjuster") for k, point in enumerate(points))]
    path = write_recording(tmp_path / "a.mcap", messages)
    assert main(["export", str(path), "--points", str(tmp_path / "points.csv"), "-q"]) == 0
    with open(tmp_path / "points.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["point"], row["Z_m"], row["role"]) for row in rows] == [(name, "3.0000", "tie") for name in names]


def test_the_name_of_a_strip_may_have_the_letters_of_what_is_not_known(tmp_path):
    """Where sigmas are not known their columns are empty; of the strip Hainan1 was left Hai1."""
    lines = _lines("Hainan1")
    unknown = replace(lines, covariance=np.full_like(lines.covariance, np.nan))
    assert write_oriented_lines(tmp_path / "lines.csv", [unknown], FRAME) == 3
    with open(tmp_path / "lines.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["strip"] for row in rows] == ["Hainan1"] * 3
    assert all(row["sigma_X_m"] == row["sigma_kappa_deg"] == "" and float(row["X_m"]) >= 0.0 for row in rows)


def test_points_that_never_became_final_are_told(tmp_path, capsys):
    """Their looks were refused since they were live: one stood there like all others, 134 m off."""
    points = [m.ObjectPoint(point=name, z=1.0, role="tie", status=status) for name, status in (("A", 0), ("B", 0))]
    points.append(m.ObjectPoint(point="B", z=1.0, role="tie", status=m.ObjectPoint.WHOLE))
    messages = [_project(), *(Message("point/object", START + k, point, "adjuster") for k, point in enumerate(points))]
    path = write_recording(tmp_path / "a.mcap", messages)
    assert main(["export", str(path), "--points", str(tmp_path / "points.csv")]) == 0
    assert "2 points, 1 of them live and never final" in capsys.readouterr().out
    path = write_recording(tmp_path / "b.mcap", messages[:-1])
    assert main(["export", str(path), "--points", str(tmp_path / "points.csv")]) == 0
    assert capsys.readouterr().out.rstrip().endswith("2 points")


def test_photos_of_two_strips_with_one_name_in_patb_are_refused(tmp_path):
    """Blanks become _ there: lines of S 1 and of S_1 had the same ids."""
    path = tmp_path / "lines.ori"
    assert write_patb_lines(path, map(_lines, ["S 1", "S 2", "S 1"]), FRAME) == 9
    with pytest.raises(UserError, match="strips 'S 1' and 'S_1' have the same name in PATB, S_1"):
        write_patb_lines(path, map(_lines, ["S 1", "S_1"]), FRAME)


@pytest.mark.parametrize("target", ["--geojson", "--gpkg", "--sbet"])
def test_a_project_without_a_place_is_on_no_map(target, tmp_path, capsys):
    """Of a block in local coordinates; points and poses were at 0 N 0 E without a word."""
    poses = [
        Message("orientation/final", START + i, pose_message(START + i, [10.0 * i, 5.0, 900.0], [0.0, 0.0, 0.1]), "a")
        for i in range(3)
    ]
    project = Message("configuration/project", START, m.Project(name="p", crs="local"), "test")
    path = write_recording(tmp_path / "a.mcap", [project, *poses])
    assert main(["export", str(path), "--topic", "orientation/final", target, str(tmp_path / "out"), "-q"]) == 1
    assert "local coordinates and no origin" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_lines_across_the_date_line_are_cut_there(tmp_path):
    """As RFC 7946 asks for: over 179.98, 179.99, -179.99 .. they went round the world. 180.01 is -179.99."""
    lon = [179.98, 179.99, 190.0 - 10.01 + 0.02, -179.98, -180.0, 179.98]
    messages = [
        Message("sensor/gnss", START + i, gnss_message(START + i, [10.0 + i, x, 500.0 + i], [1.0, 1.0, 1.0]), "gps")
        for i, x in enumerate(lon)
    ]
    path, target = write_recording(tmp_path / "a.mcap", messages), tmp_path / "f.geojson"
    assert main(["export", str(path), "--topic", "sensor/gnss", "--geojson", str(target), "-q"]) == 0
    line, *points = json.loads(target.read_text())["features"]
    wanted = [
        [[179.98, 10.0, 500.0], [179.99, 11.0, 501.0], [180.0, 11.5, 501.5]],
        [[-180.0, 11.5, 501.5], [-179.99, 12.0, 502.0], [-179.98, 13.0, 503.0], [-180.0, 14.0, 504.0]],
        [[180.0, 14.0, 504.0], [179.98, 15.0, 505.0]],
    ]
    assert line["geometry"]["type"] == "MultiLineString" and line["properties"] == {"line": "gnss", "points": 6}
    for part, want in zip(line["geometry"]["coordinates"], wanted, strict=True):
        np.testing.assert_allclose(part, want, atol=1e-9)
    assert points[2]["geometry"]["coordinates"][0] == pytest.approx(-179.99, abs=1e-9)
    assert main(["export", str(path), "--topic", "sensor/gnss", "--gpkg", str(tmp_path / "f.gpkg"), "-q"]) == 0
    database = sqlite3.connect(tmp_path / "f.gpkg")
    rows = database.execute("SELECT geom FROM sensor_gnss_lines ORDER BY fid").fetchall()
    for (blob,), want in zip(rows, wanted, strict=True):
        np.testing.assert_allclose(_geometry(blob)[1], want, atol=1e-9)
    database.close()


def test_object_points_count_once_with_their_last_state(recording, tmp_path):
    target = tmp_path / "p.geojson"
    assert main(["export", str(recording), "--topic", "point/object", "--geojson", str(target), "-q"]) == 0
    features = json.loads(target.read_text())["features"]
    assert [f["properties"]["point"] for f in features] == ["P1", "P2"]
    assert features[0]["properties"]["status"] == "final"
    assert features[0]["properties"]["sigma_Z_m"] == pytest.approx(0.03)
    wanted = FRAME.to_geodetic([100.0, 200.0, 101.0])
    assert features[0]["geometry"]["coordinates"][2] == pytest.approx(wanted[2], abs=1e-3)


def test_known_points_have_the_sigmas_that_they_state(tmp_path):
    """A coordinate that a role does not give had a sigma of 0 or next to it, and so had check points without sigma."""
    C = np.diag([1e-4, 4e-4, 1e-10])  # a height has what the curvature of the Earth makes of X and Y
    known = {"P": ("planimetric", C), "H": ("height", np.diag([0.0, 0.0, 9e-4])), "Q": ("check", np.zeros((3, 3)))}
    bodies = [ground_point_message(id, [1.0, 2.0, 3.0], C, role) for id, (role, C) in known.items()]
    messages = [_project(), *(Message("observation/control", START, body, "test") for body in bodies)]
    path, target = write_recording(tmp_path / "a.mcap", messages), tmp_path / "c.geojson"
    assert main(["export", str(path), "--topic", "observation/control", "--geojson", str(target), "-q"]) == 0
    found = {f["properties"]["point"]: f["properties"] for f in json.loads(target.read_text())["features"]}
    sigmas = {id: [p[f"sigma_{axis}_m"] for axis in "XYZ"] for id, p in found.items()}
    assert sigmas["P"] == [pytest.approx(0.01), pytest.approx(0.02), None]
    assert sigmas["H"] == [None, None, pytest.approx(0.03)] and sigmas["Q"] == [None] * 3


@pytest.fixture(scope="module")
def refined_twice(tmp_path_factory):
    """Strip S1, and strip S1 again, a metre higher, with S2."""
    messages = [_project()]
    for k, (strip, z) in enumerate((("S1", 1000.0), ("S1", 1001.0), ("S2", 1001.0))):
        for i in range(5):
            t = START + (i + 10 * (strip == "S2")) * 10**8
            stamp = START + 10**10 * (1 + (k > 0)) + 10 * k + i
            pose = pose_message(t, [10.0 * i, 5.0, z], [0.0, 0.0, 0.0], np.eye(6), strip=strip)
            messages.append(Message("orientation/whole", stamp, pose, "adjuster"))
    return write_recording(tmp_path_factory.mktemp("twice") / "flight.mcap", messages)


def test_what_is_refined_again_takes_the_place_of_what_was_said_before(refined_twice, tmp_path, capsys):
    target = tmp_path / "o.geojson"
    words = ["export", str(refined_twice), "--topic", "orientation/whole"]
    assert main([*words, "--geojson", str(target)]) == 0
    assert "12 features" in capsys.readouterr().out
    features = json.loads(target.read_text())["features"]
    lines = [f for f in features if f["geometry"]["type"] == "LineString"]
    assert {f["properties"]["line"]: len(f["geometry"]["coordinates"]) for f in lines} == {"S1": 5, "S2": 5}
    heights = [place[2] for f in lines for place in f["geometry"]["coordinates"]]
    assert heights == pytest.approx([1001.0] * 10, abs=0.01)
    assert main([*words, "--sbet", str(tmp_path / "o.sbet"), "--every", "2"]) == 0
    records = np.fromfile(tmp_path / "o.sbet", "<f8").reshape(-1, 17)
    assert records[:, 3] == pytest.approx([1001.0] * 5, abs=0.01)
    assert np.diff(records[:, 0]) == pytest.approx([0.2, 0.2, 0.7, 0.2], abs=1e-6)


def test_lines_of_a_strip_whose_end_was_not_recorded_are_those_under_its_poses(tmp_path, capsys):
    """Drivers say how many lines a strip has when it ends; there were none, without a word."""
    messages = [_project(), Message("configuration/camera", START, camera_message(preset("ads40-small")), "test")]
    for id, first, rate in (("S1", 0, 100.0), ("S2", 20, 50.0), ("no rate", 30, 0.0)):
        strip = m.Strip(id=id, first_line_time_ns=START + first * 10**8, line_rate_hz=rate)
        messages.append(Message("configuration/strip", START, strip, "camera"))
    for i in range(40):  # the turn between strips, too
        t = START + i * 10**8
        pose = [10.0 * i, 5.0, 1000.0], [0.0, 0.0, 0.0], np.eye(6)
        messages.append(Message("trajectory/smoothed", t, pose_message(t, *pose), "navigator"))
        if i < 10 or 20 <= i < 26:
            strip = "S1" if i < 10 else "S2"
            messages.append(Message("orientation/final", t, pose_message(t, *pose, strip=strip), "adjuster"))
    path, table = write_recording(tmp_path / "flight.mcap", messages), tmp_path / "lines.csv"
    assert main(["export", str(path), "--per-line", str(table)]) == 0
    assert "final orientation, 117 lines" in capsys.readouterr().out
    rows = [line.split(",")[:3] for line in table.read_text().splitlines()[1:]]
    assert [row[0] for row in rows] == ["S1"] * 91 + ["S2"] * 26
    last_s = (START + 25 * 10**8) / 1e9
    assert rows[-1][1] == "25" and float(rows[-1][2]) == pytest.approx(last_s, abs=1e-6)


def test_lines_that_one_ccd_line_has_lost_are_there_for_the_others(tmp_path, capsys):
    """The table ended where the first CCD line did."""
    messages = [_project(), Message("configuration/camera", START, camera_message(preset("ads40-small")), "test")]
    strip = m.Strip(id="S1", first_line_time_ns=START, line_rate_hz=100.0, lines=200)
    messages.append(Message("configuration/strip", START, strip, "camera"))
    for i in range(21):
        t = START + i * 10**8
        pose = pose_message(t, [10.0 * i, 5.0, 1000.0], [0.0, 0.0, 0.0])
        messages.append(Message("truth/trajectory", t, pose, "simulator"))
        for ccd, late_ns in (("B", 0), ("F", 1000)):
            if i < (8 if ccd == "B" else 20):
                block = LineBlock(np.zeros((10, 5), dtype=np.uint8), ccd, "S1", 10 * i, t + late_ns, 10**7)
                messages.append(Message(f"sensor/lines/{ccd}", t + 9 * 10**7, block, "camera"))
    messages.sort(key=lambda message: message.stamp_ns)
    path, table = write_recording(tmp_path / "flight.mcap", messages), tmp_path / "lines.csv"
    assert main(["export", str(path), "--per-line", str(table)]) == 0
    assert "truth orientation, 200 lines" in capsys.readouterr().out
    times = [line.split(",")[2] for line in table.read_text().splitlines()[1:]]
    late = [int(time.split(".")[1]) % 10**7 for time in times]
    assert late == [0] * 80 + [1000] * 120


def test_configuration_that_is_stated_again_counts(tmp_path):
    """As for the nodes, which begin anew with it."""
    again = m.Project(name="p", crs="local", origin_latitude=48.5, origin_longitude=10.6)
    camera, other = preset("ads40-small"), preset("ads40")
    poses = [
        Message("trajectory/smoothed", START + 10 + i, pose_message(START + i * 10**8, [i, 5.0, 1000.0], [0.0] * 3))
        for i in range(4)
    ]
    path = write_recording(tmp_path / "flight.mcap", [
        _project(), Message("configuration/camera", START, camera_message(camera), "test"),
        Message("configuration/project", START + 5, again, "test"),
        Message("configuration/camera", START + 5, camera_message(other), "test"), *poses,
    ])  # fmt: skip
    recording = Recording(path)
    assert recording.project().origin_latitude == 48.5 and recording.camera().name == other.name
    write_camera(tmp_path / "calibrated.json", other)  # which can stand for that one alone
    assert process._camera(recording.reader, tmp_path / "calibrated.json", [])
    words = ["export", str(path), "--topic", "trajectory/smoothed", "--sbet", str(tmp_path / "o.sbet")]
    assert main(words) == 0
    assert np.degrees(np.fromfile(tmp_path / "o.sbet", "<f8")[1]) == pytest.approx(48.5, abs=1e-3)


def test_smrmsg_has_no_poses_without_covariance(recording, tmp_path, capsys):
    words = ["export", str(recording), "--topic", "orientation/final", "--smrmsg", str(tmp_path / "o.out")]
    assert main(words) == 0
    assert "19 records, 1 poses left out, without covariance" in capsys.readouterr().out
    values = np.fromfile(tmp_path / "o.out", "<f8").reshape(-1, 10)
    assert len(values) == 19
    np.testing.assert_allclose(values[:, 1:4], np.tile([0.2, 0.1, 0.3], (19, 1)))  # north, east, down of X, Y, Z
    np.testing.assert_array_equal(values[:, 4:7], 0.0)


def test_sbet_has_no_poses_that_are_not_valid(tmp_path, capsys):
    poses = [
        Message(
            "trajectory/filtered", START + i, pose_message(START + i * 10**8, [i, 5.0, 1000.0], [0.0] * 3, valid=i > 2)
        )
        for i in range(8)
    ]
    path = write_recording(tmp_path / "flight.mcap", [_project(), *poses])
    words = ["export", str(path), "--topic", "trajectory/filtered", "--sbet", str(tmp_path / "o.sbet")]
    assert main(words) == 0
    assert "5 records, 3 poses left out, not valid" in capsys.readouterr().out
    assert len(np.fromfile(tmp_path / "o.sbet", "<f8")) == 5 * 17


def _geometry(blob: bytes) -> tuple[int, np.ndarray]:
    """WKB type and coordinates of a GeoPackage geometry."""
    magic, version, flags, srs = struct.unpack_from("<2sBBi", blob)
    assert (magic, version, flags, srs) == (b"GP", 0, 1, 4326)
    _, kind = struct.unpack_from("<BI", blob, 8)
    return kind, np.frombuffer(blob, "<f8", offset=13 if kind == 1001 else 17).reshape(-1, 3)


@pytest.mark.parametrize(
    "topic, points, lines", [("orientation/final", 20, 2), ("observation/control", 1, 0), ("sensor/gnss", 20, 1)]
)
def test_geopackage(recording, tmp_path, topic, points, lines):
    target = tmp_path / "o.gpkg"
    target.write_text("something old")
    assert main(["export", str(recording), "--topic", topic, "--gpkg", str(target), "-q"]) == 0
    assert target.read_bytes()[:15] == b"SQLite format 3" and target.read_bytes()[68:72] == b"GPKG"
    database = sqlite3.connect(target)
    table = topic.replace("/", "_")
    contents = dict(database.execute("SELECT table_name, srs_id FROM gpkg_contents").fetchall())
    assert contents == {table: 4326} | ({f"{table}_lines": 4326} if lines else {})
    assert database.execute("SELECT z, m FROM gpkg_geometry_columns").fetchall() == [(1, 0)] * (2 if lines else 1)
    assert {-1, 0, 4326} <= {row[0] for row in database.execute("SELECT srs_id FROM gpkg_spatial_ref_sys")}
    rows = database.execute(f'SELECT geom FROM "{table}"').fetchall()
    assert len(rows) == points
    kind, place = _geometry(rows[-1][0])
    low = database.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents").fetchone()
    assert kind == 1001 and low[0] <= place[0, 0] <= low[2] and low[1] <= place[0, 1] <= low[3]
    if lines:
        kind, place = _geometry(database.execute(f'SELECT geom FROM "{table}_lines"').fetchone()[0])
        assert kind == 1002 and len(place) == (12 if topic.startswith("orient") else 20)
    names = [row[1] for row in database.execute(f'PRAGMA table_info("{table}")')]
    assert ("sigma_E_m" if topic == "sensor/gnss" else "sigma_X_m") in names
    assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    database.close()


# ---- SBET


def test_sbet_comes_back_as_the_track_it_was(tmp_path):
    """Track, recording with a turned camera, SBET, track: positions, attitude of the body, times."""
    n = 60
    t = np.arange(n) * 0.1
    geodetic = np.column_stack([48 + t * 6e-4, 11 + t * 9e-4, 2000 + t])
    rpy = np.radians(np.column_stack([np.sin(t), np.cos(t), 350 + 4 * t]))
    track = NavigationTrack("t", START + np.rint(t * 1e9).astype(np.int64), geodetic, rpy)
    path, sbet = tmp_path / "t.mcap", tmp_path / "t.sbet"
    write_recording(path, track_messages(track, "x", Mounting(boresight_deg=(0.5, -0.3, 90.0))))
    assert main(["export", str(path), "--topic", "trajectory/smoothed", "--sbet", str(sbet), "-q"]) == 0
    values = np.fromfile(sbet, "<f8").reshape(-1, 17)
    speed = np.linalg.norm(values[5:-5, 4:6], axis=1)
    assert speed == pytest.approx(np.hypot(6e-4 * 111_200, 9e-4 * 74_600), rel=0.01)
    np.testing.assert_allclose(values[5:-5, 6], -1.0, atol=0.01)  # down
    again = read_any(sbet, options=Options(day=date(2020, 9, 13))).messages
    poses = [message.body for message in again if message.topic == "trajectory/smoothed"]
    plain = [message.body for message in track_messages(track, "x") if message.topic == "trajectory/smoothed"]
    for a, b in zip(poses, plain, strict=True):
        assert abs(a.timestamp.nanos - b.timestamp.nanos) < 300 and a.timestamp.seconds == b.timestamp.seconds
        assert a.pose.position.x == pytest.approx(b.pose.position.x, abs=1e-5)
        assert np.array(a.angles) == pytest.approx(np.array(b.angles), abs=1e-9)


# ---- what a user is told


@pytest.mark.parametrize(
    "args, wanted",
    [
        (["--topic", "no/such", "--csv", "o"], "--topic no/such: not a topic; topics: configuration/project"),
        (["--topic", "sensor/imu", "--csv", "o"], "no message on sensor/imu; it holds adjustment/report"),
        (
            ["--topic", "point/object", "--csv", "o", "--rows", "x"],
            "--rows x: point/object has no such field, wanted one of residuals, none",
        ),
        (["--topic", "adjustment/report", "--gpkg", "o"], "adjustment/report has no places for a map"),
        (["--topic", "sensor/gnss", "--sbet", "o"], "--sbet: sensor/gnss has no poses"),
        (["--topic", "sensor/gnss", "--csv", "no/o"], "no folder"),
        (["--topic", "sensor/gnss", "--csv", "o", "--every", "0"], "--every 0, wanted at least 1"),
        (
            ["--points", "o", "--every", "1"],
            "--every: wanted with --csv, --parquet, --geojson, --gpkg, --sbet and --smrmsg only",
        ),
        (["--points", "o", "--orientation", "final"], "--orientation: wanted with --per-line only"),
        (["--points", "o", "--rows", "none"], "--rows: wanted with --csv and --parquet only"),
        (["--points", "o", "--format", "csv"], "--format: wanted with --per-line only"),
        (["--per-line", "o", "--every", "2"], "--every: wanted with --csv, "),
        (["--per-line", "o", "--covariance"], "--covariance: wanted with --points only"),
        (["--per-line", "o", "--rows", "x"], "--rows: wanted with --csv and --parquet only"),
        (["--topic", "sensor/gnss", "--csv", "o", "--format", "csv"], "--format: wanted with --per-line only"),
        (["--topic", "sensor/gnss", "--sbet", "o", "--rows", "none"], "--rows: wanted with --csv and --parquet only"),
        (["--topic", "sensor/gnss", "--csv", ""], "--csv '': wanted a name"),
    ],
)
def test_refusals_are_one_line_and_leave_no_file(recording, tmp_path, capsys, monkeypatch, args, wanted):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(recording), *args]) == 1
    out, err = capsys.readouterr()
    assert out == "" and wanted in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_old_file_stays_when_the_new_one_fails(recording, tmp_path, capsys):
    target = tmp_path / "o.csv"
    target.write_text("old")
    assert main(["export", str(recording), "--topic", "point/object", "--csv", str(target), "--rows", "x"]) == 1
    assert target.read_text() == "old"


def test_files_that_are_no_recording(tmp_path, capsys):
    empty, text = tmp_path / "e.mcap", tmp_path / "t.mcap"
    empty.touch()
    text.write_text("hello")
    for path, wanted in ((empty, "empty"), (text, "not an MCAP recording"), (tmp_path / "none", "no such file")):
        assert main(["export", str(path), "--topic", "sensor/gnss", "--csv", str(tmp_path / "o.csv")]) == 1
        assert wanted in capsys.readouterr().err


def test_no_project_no_map(tmp_path, capsys):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path) as writer:
        writer.write(Message("orientation/final", START, pose_message(START, [0, 0, 0], [0, 0, 0]), "x"))
    for option in ("--geojson", "--sbet"):
        assert main(["export", str(path), "--topic", "orientation/final", option, str(tmp_path / "o")]) == 1
        assert f"{path}: no message on configuration/project" in capsys.readouterr().err


def test_machine_readable_result(recording, tmp_path, capsys):
    args = ["export", str(recording), "--topic", "point/object", "--csv", str(tmp_path / "o.csv"), "--json"]
    assert main(args) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["rows"] == 3 and result["beside"] == {str(tmp_path / "o_residuals.csv"): 4}
    assert result["type"] == "triline.ObjectPoint" and result["skipped"] == 0


def test_what_a_damaged_recording_lacks_is_named(recording, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-40])
    args = ["export", str(cut), "--topic", "point/object", "--csv", str(tmp_path / "o.csv")]
    assert main(args) == 0
    said = capsys.readouterr()
    assert "the file ends inside a record" in said.err and len(said.err.splitlines()) == 1
    assert "()" not in said.out + said.err
    assert main([*args, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["damage"]) == 1
    assert main(["export", str(cut), "--points", str(tmp_path / "p.csv"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["damage"]) == 1
