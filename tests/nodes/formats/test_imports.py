"""Blocks, sensor folders and tie points as flights; and what a user is told about foreign files."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from block_writer import write_block
from command_line import refusal
from places import DATA, needs_data
from small_block import FILES, simulated_block, write_files
from tracks import ns, straight_track

from triline.nodes.cli import main
from triline.nodes.cli.import_ import GO_WITH
from triline.nodes.convert import pose_sample
from triline.nodes.errors import UserError
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.block_messages import block_messages, filled, not_carried, strip_shifts
from triline.nodes.formats.block_recording import block_from_messages
from triline.nodes.formats.detect import KINDS, Options, read_any
from triline.nodes.formats.geocal_xml import read_tie_points
from triline.nodes.formats.gps_time import gps_from_utc_ns
from triline.nodes.formats.sbet import write_sbet
from triline.nodes.formats.tie_points import statistics
from triline.nodes.formats.track import Mounting
from triline.nodes.recording.reader import RecordingReader
from triline.schemas.topics import rank
from triline.solver.geometry.earth import R_en, geodetic_from_ecef
from triline.solver.geometry.trajectory import Trajectory

TIES = DATA / "avirisng" / "tpcol_3_1.xml"


# ---- sensor folder


def _sensor_folder(folder: Path, increments: bool) -> Path:
    folder.mkdir()
    dt = 0.01
    names = "dvx_m_s,dvy_m_s,dvz_m_s,dthx_rad,dthy_rad,dthz_rad" if increments else (
        "fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s"
    )  # fmt: skip
    values = np.array([0.5, -0.25, -9.75, 0.01, 0.02, -0.03]) * (dt if increments else 1.0)
    rows = [f"{100 + i * dt:.3f}," + ",".join(f"{v:.9f}" for v in values) for i in range(200)]
    (folder / "imu.csv").write_text(f"time_s,{names}\n" + "\n".join(rows) + "\n")
    fixes = [f"{100 + 0.2 * i:.1f},48.0,11.{i:02d},500,0.01,0.02,0.03,1,2,3,0.1,0.2,0.3" for i in range(10)]
    columns = "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m"
    velocity = "vn_m_s,ve_m_s,vd_m_s,sigma_vn_m_s,sigma_ve_m_s,sigma_vd_m_s"
    (folder / "gnss.csv").write_text(f"{columns},{velocity}\n" + "\n".join(fixes) + "\n")
    (folder / "attitude.csv").write_text("time_s,roll_deg,pitch_deg,heading_deg\n100,1,2,3\n101,1,2,3\n")
    (folder / "platform.toml").write_text(
        "lever_arm_m = [1, 2, -3]\ncamera_lever_arm_m = [0.5, 0, 0]\nboresight_deg = [0, 0, 1]\n"
    )
    return folder


@pytest.mark.parametrize("increments", [False, True])
def test_sensor_folder_becomes_a_flight(tmp_path, increments):
    imported = read_any(_sensor_folder(tmp_path / "flight", increments))
    messages = list(imported.messages)
    assert imported.kind == "sensors"
    stamps = [(message.stamp_ns, rank(message.topic)) for message in messages]
    assert stamps == sorted(stamps)
    project = messages[0].body
    assert list(project.lever_arm_m) == [0.5, 2.0, -3.0] and list(project.boresight_deg) == [0, 0, 1]
    imu = [m.body for m in messages if m.topic == "sensor/imu"]
    assert len(imu) == 200 and imu[50].time_ns == 100_500_000_000 and imu[50].interval_ns == 10_000_000
    b = imu[50]
    values = [b.force_x, b.force_y, b.force_z, b.rate_x, b.rate_y, b.rate_z]
    np.testing.assert_allclose(values, [0.5, -0.25, -9.75, 0.01, 0.02, -0.03], rtol=1e-6)
    fix = [m.body for m in messages if m.topic == "sensor/gnss"][3]
    assert (fix.latitude, fix.longitude) == pytest.approx((48.0, 11.03), abs=1e-12)
    sigma = np.sqrt([fix.position_covariance[i] for i in (0, 4, 8)])
    np.testing.assert_allclose(sigma, [0.02, 0.01, 0.03])  # east, north, up
    assert (fix.velocity_enu.x, fix.velocity_enu.y, fix.velocity_enu.z) == (2.0, 1.0, -3.0)
    attitude = [m.body for m in messages if m.topic == "sensor/attitude"]
    assert len(attitude) == 2 and np.degrees(attitude[0].heading) == pytest.approx(3.0)
    assert any("camera_lever_arm_m: a recording has no place for it" in note for note in imported.notes)
    assert not any("no place for biases" in note for note in imported.notes)
    platform = tmp_path / "flight" / "platform.toml"
    platform.write_text(platform.read_text() + "[imu]\ngyro_bias_deg_h = 200\n")
    imported = read_any(tmp_path / "flight")
    assert list(imported.messages)
    assert any("[imu]: a recording has no place for biases" in note for note in imported.notes)


def test_sensor_folder_damaged(tmp_path):
    folder = _sensor_folder(tmp_path / "flight", False)
    text = (folder / "gnss.csv").read_text()
    (folder / "gnss.csv").write_text(text.replace("11.04", "x"))
    with pytest.raises(UserError, match=r"gnss.csv:6: lon_deg: 'x' is not a number"):
        list(read_any(folder).messages)
    (folder / "gnss.csv").write_text(text.replace("48.0", "148.0"))
    with pytest.raises(UserError, match="latitude beyond 90 deg"):
        list(read_any(folder).messages)


# ---- tie points


@needs_data
def test_tie_points_of_crossing_strips():
    ties = read_tie_points(TIES)
    assert len(ties) == 800 and ties.line.shape == (800, 2) and not ties.is_control.any()
    np.testing.assert_allclose([ties.line[0], ties.sample[0]], [[2152.0, 9877.457779], [360.0, 588.0011666]])
    np.testing.assert_allclose(ties.sigma_line[0], [0.05, 0.0584036], rtol=1e-5)
    np.testing.assert_allclose(ties.position_e[0], [-2636970.5608, -4537659.7500, 3612771.4143])
    assert len(read_tie_points(TIES.with_name("tpcol_3_2.xml"))) == 1023
    table = statistics(ties)
    assert table["rays"] == 1600 and table["image2"]["sigma_sample_px"][0] == pytest.approx(0.0584, abs=1e-4)


@needs_data
def test_samples_grow_to_the_left_of_flight():
    """What `read_glas_camera` rests on: on the ground, samples go to the left of the way the lines go."""
    ties = read_tie_points(TIES)
    geodetic = geodetic_from_ecef(ties.position_e)
    ned = (ties.position_e - ties.position_e.mean(axis=0)) @ R_en(*geodetic[:, :2].mean(axis=0))
    for k in range(2):
        A = np.column_stack([ties.line[:, k], ties.sample[:, k], np.ones(len(ties))])
        along, across, _ = np.linalg.lstsq(A, ned[:, :2], rcond=None)[0]
        sine = (along[0] * across[1] - along[1] * across[0]) / (np.linalg.norm(along) * np.linalg.norm(across))
        assert sine < -0.95  # north-east axes: negative is to the left


@needs_data
def test_tie_points_as_table_and_messages(tmp_path, capsys):
    assert main(["import", str(TIES), "-o", str(tmp_path / "t.csv"), "-q"]) == 0
    rows = (tmp_path / "t.csv").read_text().splitlines()
    assert rows[0] == "point,strip,ccd,line,sample,sigma_px,lat_deg,lon_deg,height_m" and len(rows) == 1601
    assert rows[1].startswith("T0001,image1,N,2152.0000,360.0000,0.0500,34.7226")
    assert main(["import", str(TIES), "-o", str(tmp_path / "t.mcap"), "--json"]) == 0
    assert '"observation/tie": 800' in capsys.readouterr().out
    first = RecordingReader(tmp_path / "t.mcap").first("observation/tie")
    assert [(i.strip, i.ccd) for i in first.images] == [("image1", "N"), ("image2", "N")]
    assert first.images[1].sample == pytest.approx(588.0011666)


@needs_data
def test_tie_points_damaged(tmp_path):
    text = TIES.read_text()
    path = tmp_path / "ties.xml"
    for change, wanted in (
        (text[: len(text) // 2], r"ties.xml:\d+: not well-formed XML .*; truncated"),
        (text.replace("<count>800</count>", "<count>801</count>", 1), "800 tie points, but the file says 801"),
        (text.replace("<line>2.15200000000000000e+03", "<line>x", 1), "tie point 1: px/line: 'x', wanted a number"),
        (
            text.replace("TiePointCollection", "Other"),
            "GeoCal::Other, wanted a boost archive with GeoCal::TiePointCollection",
        ),
    ):
        path.write_text(change)
        with pytest.raises(UserError, match=wanted):
            read_tie_points(path)


# ---- a block as a flight


def test_block_becomes_a_flight_in_the_order_of_what_could_be_known():
    block = simulated_block()  # its strips overlap in time
    messages = list(block_messages(block))
    stamps = [(message.stamp_ns, rank(message.topic)) for message in messages]
    assert stamps == sorted(stamps)
    start = messages[0].stamp_ns
    assert [m.topic for m in messages[:3]] == ["configuration/project", "configuration/camera", "configuration/strip"]
    control = [m for m in messages if m.topic == "observation/control"]
    assert len(control) == 8 and all(m.stamp_ns == start for m in control)
    begun, ended, seen = set(), set(), set()
    looks = 0
    for message in messages:
        if message.topic == "configuration/strip":
            (ended if message.body.ended else begun).add(message.body.id)
        elif message.topic == "trajectory/smoothed":
            assert message.body.strip in begun - ended
            assert message.stamp_ns == pose_sample(message.body).time_ns
        elif message.topic == "observation/tie":
            (strip,) = {image.strip for image in message.body.images}
            assert strip in begun - ended
            assert message.stamp_ns == max(image.time_ns for image in message.body.images)
            assert (message.body.point, strip) not in seen  # one message a point and strip
            seen.add((message.body.point, strip))
            looks += len(message.body.images)
    assert begun == ended == {"S1", "S2"} and looks == len(block.image)


def test_signalised_points_stay_signalised(tmp_path):
    """The radius of their discs goes into a folder and back, and into the messages, by which a matcher measures."""
    block = simulated_block()
    radius = tuple(0.25 * (k % 3) for k in range(len(block.ground)))
    block = replace(block, ground=replace(block.ground, target_radius_m=radius))
    write_block(tmp_path / "block", block)
    block = read_block(tmp_path / "block")
    assert block.ground.target_radius_m == radius
    messages = list(block_messages(block))
    assert [m.body.target_radius for m in messages if m.topic == "observation/control"] == list(radius)
    assert block_from_messages(messages, "block").ground.target_radius_m == radius


def test_looks_outside_their_strip_come_within_it(tmp_path):
    """They are for the adjuster to reject; their lines must not put a stamp anywhere."""
    text = "point,strip,ccd,line,sample\n" + "".join(
        f"G{i},S1,N,{u},5\n" for i, u in enumerate((5, -1e5, 1e5, 1e300, -1e18))
    )
    block = read_block(write_files(tmp_path, image_points=text))
    messages = list(block_messages(block))
    stamps = [(message.stamp_ns, rank(message.topic)) for message in messages]
    assert stamps == sorted(stamps) and messages[0].topic == "configuration/project"
    ties = {m.body.point: m for m in messages if m.topic == "observation/tie"}
    assert [ties[f"G{i}"].body.images[0].line for i in range(5)] == [5, -1e5, 1e5, 1e300, -1e18]
    assert ties["G0"].stamp_ns == 100_025_000_000
    ends = [m.stamp_ns for m in messages if m.topic == "configuration/strip"]
    assert all(ends[0] <= tie.stamp_ns < ends[1] for tie in ties.values())


def test_overlapping_strips_are_set_apart_by_whole_seconds():
    block = simulated_block()
    shift = strip_shifts(block)
    assert shift[0] == 0 and shift[1] > 0 and shift[1] == np.floor(shift[1])
    end = max(block.strips[0].trajectory.end_s, float(block.strips[0].time_of(9399.0)))
    assert block.strips[1].trajectory.start_s + shift[1] >= end


def test_strips_of_lenses_that_share_a_trajectory_are_set_apart():
    """At the same times an on-line adjustment lost half of the looks, and took every pose for one that came twice."""
    block = simulated_block()
    first = block.strips[0]
    lenses = tuple(replace(first, id=f"S1/{lens}", lens=lens) for lens in ("L1", "L2"))
    block = replace(block, strips=lenses)
    shift = strip_shifts(block)
    assert shift[0] == 0 and first.trajectory.start_s + shift[1] > first.trajectory.end_s
    stamps = [m.stamp_ns for m in block_messages(block) if m.topic == "trajectory/smoothed"]
    assert len(stamps) == len(set(stamps)) == 2 * len(first.trajectory.time_s)


def test_poses_that_are_too_far_apart_for_the_adjuster_get_others_in_between():
    """With poses once a second it had no orientation, so no image point was used and no point came out."""
    block = simulated_block()
    strip = block.strips[0]
    whole = strip.trajectory
    every = np.flatnonzero(np.abs(whole.time_s - np.round(whole.time_s)) < 1e-6)
    few = Trajectory(whole.time_s[every], whole.position_l[every], whole.quaternion[every])
    thin = replace(block, strips=(replace(strip, trajectory=few), *block.strips[1:]))
    more = filled(few)
    assert np.diff(more.time_s).max() <= 0.2 and set(few.time_s) <= set(more.time_s)
    between = 0.5 * (few.time_s[1:] + few.time_s[:-1])
    np.testing.assert_allclose(more.at(between).position_l, few.at(between).position_l, atol=1e-3)
    np.testing.assert_allclose(more.at(between).angles, few.at(between).angles, atol=1e-6)
    messages = list(block_messages(thin))
    poses = [m.body.strip for m in messages if m.topic == "trajectory/smoothed"]
    assert poses.count(strip.id) == len(more)
    added = len(more) - len(few)
    note = f"strip {strip.id}: poses are 1 s apart: {added} interpolated ones are put in between"
    assert not_carried(thin)[0] == note
    assert filled(whole) is whole
    gap = np.concatenate([few.time_s[:5], few.time_s[5:] + 30.0])  # longer than five usual steps
    holed = filled(Trajectory(gap, few.position_l, few.quaternion))
    assert np.diff(holed.time_s).max() > 30.0


def test_keys_of_a_camera_that_nobody_knows_are_told(tmp_path, capsys):
    """A misspelt distortion was none, without a word."""
    poses, camera = tmp_path / "poses.csv", json.loads(FILES["camera.json"])
    rows = "".join(f"{100 + 0.1 * k},47,11,1500,0,0,90\n" for k in range(5))
    poses.write_text("time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + rows)
    camera["lenses"][0]["distorsion"] = {"k1": 1e-6}
    (tmp_path / "mine.json").write_text(json.dumps(camera))
    out = str(tmp_path / "poses.mcap")
    assert main(["import", str(poses), "-o", out, "--camera", str(tmp_path / "mine.json")]) == 0
    assert "note: mine.json: key lenses[0].distorsion is not known and was ignored" in capsys.readouterr().out


def test_keys_of_another_camera_that_nobody_knows_are_told_by_process(tmp_path, capsys):
    camera = json.loads(FILES["camera.json"])
    camera["lenses"][0]["distorsion"] = {"k1": 1e-6}
    (tmp_path / "mine.json").write_text(json.dumps(camera))
    flight, out = str(tmp_path / "flight.mcap"), str(tmp_path / "out.mcap")
    assert main(["import", str(write_files(tmp_path / "block")), "-o", flight, "-q"]) == 0
    assert main(["process", flight, "-o", out, "--camera", str(tmp_path / "mine.json")]) == 0
    assert "note: mine.json: key lenses[0].distorsion is not known and was ignored" in capsys.readouterr().out


def test_poses_of_a_file_that_are_too_far_apart_are_told(tmp_path):
    rows = "".join(f"{t},47,11,1500,0,0,90\n" for t in range(100, 105))
    path = tmp_path / "slow.csv"
    path.write_text("time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + rows)
    note = "slow.csv: poses are 1 s apart: more than 0.2 s between two are a gap without orientation for 'process'"
    assert note in read_any(path).notes


def test_block_survives_the_recording(tmp_path):
    block = simulated_block("EPSG:32632")
    sigma = 0.2 + 0.01 * np.arange(len(block.image))
    block = replace(block, image=replace(block.image, sigma_px=sigma))
    wander = {"wander_sigma_deg": (0.002, 0.002, 0.003), "wander_time_s": 60.0, "attitude_wander_time_s": 12.0}
    apriori = replace(block.apriori, trajectory={**block.apriori.trajectory, **wander})
    block = replace(block, apriori=apriori)
    write_block(tmp_path / "block", block)
    out = tmp_path / "flight.mcap"
    assert main(["import", str(tmp_path / "block"), "-o", str(out), "-q"]) == 0
    reader = RecordingReader(out)
    again = block_from_messages(reader.messages(), str(out))
    assert again.frame.crs == "EPSG:32632" and again.apriori.image_sigma_px == 0.3
    # what the project leaves out travels as the default that a batch adjustment would take
    assert again.apriori.trajectory == {**block.apriori.trajectory, "drift_sigma_deg": (0.01, 0.01, 0.02)}
    assert {s.id: s.lines for s in again.strips} == {"S1": 9400, "S2": 9400}
    order = [again.point_ids.index(id) for id in block.point_ids]
    names, wanted = (
        [
            (b.image_name(i), round(float(b.image.line[i]), 3), round(b.image.sigma_px[i], 6))
            for i in range(len(b.image))
        ]
        for b in (again, block)
    )
    assert sorted(names) == sorted(wanted) and len(order) == 12
    assert again.ground.role == block.ground.role
    t = again.strips[1].time_of(np.array([100.0]))
    old = block.strips[1].trajectory.at(block.strips[1].time_of(np.array([100.0])))
    new = again.strips[1].trajectory.at(t)
    R = again.frame.R_el.T @ block.frame.R_el
    shift = (block.frame.origin_e - again.frame.origin_e) @ again.frame.R_el
    np.testing.assert_allclose(new.position_l, old.position_l @ R.T + shift, atol=1e-5)
    np.testing.assert_allclose(new.R_lc, R @ old.R_lc, atol=1e-8)


def test_what_a_recording_cannot_carry_is_told(tmp_path):
    strips = "strip,first_line_time_s,line_rate_hz,lines,line_times\nS1,,,,lines.csv\n"
    project = "[trajectory]\nsecond_sigma_m = [1, 1, 1]\noffset_sigma_m = [1, 1, 1]\n"
    image = "point,strip,ccd,line,sample\nG1,S1,N,1.5,1\n"
    folder = write_files(tmp_path, strips=strips, project=project, image_points=image)
    (folder / "lines.csv").write_text("line,time_s\n0,100\n1,100.1\n2,100.3\n")
    notes = not_carried(read_block(folder))
    assert "project.toml: trajectory.second_sigma_m: not carried by a recording" in notes
    assert any("line times are off a constant rate by 0.33 lines at most: image points keep theirs" in n for n in notes)
    block = simulated_block()
    assert not_carried(replace(block, strips=block.strips[:1])) == []
    by = strip_shifts(block)[1]
    [note] = not_carried(block)
    assert note.endswith(f"has strips later than the files do: S2 by {by:.0f} s")


def test_an_imported_block_runs_on_line(tmp_path):
    """The adjuster takes the imported messages as they are: exact data, none rejected, points where they should be."""
    block = simulated_block()
    write_block(tmp_path / "block", block)
    flight, result = tmp_path / "flight.mcap", tmp_path / "result.mcap"
    assert main(["import", str(tmp_path / "block"), "-o", str(flight), "-q"]) == 0
    assert main(["process", str(flight), "-o", str(result), "-q"]) == 0
    reader = RecordingReader(result)
    final = [pose_sample(m.body) for m in reader.messages(["orientation/final"])]
    assert len(final) > 100
    points = {m.body.point: m.body for m in reader.sorted_messages(["point/object"])}
    assert set(points) == set(block.point_ids)
    for id, xyz in zip(block.ground.id, block.ground.xyz_l, strict=True):
        p = points[id]
        # exact but for the interpolation of the poses
        assert [p.x, p.y, p.z] == pytest.approx(xyz, abs=0.03)
    # a point may have left the window before the second strip sees it; nothing else is wrong with any look
    reasons = {r.reason for m in reader.messages(["adjustment/report"]) for r in m.body.rejected}
    assert reasons <= {"point is final"}


def test_rays_of_unknown_strips_reach_the_adjuster(tmp_path):
    folder = write_files(tmp_path / "block", image_points="point,strip,ccd,line,sample\nG1,S1,F,500,499\nG1,S7,N,1,1\n")
    messages = list(read_any(folder).messages)
    ties = [m.body for m in messages if m.topic == "observation/tie"]
    assert [(t.point, t.images[0].strip) for t in ties] == [("G1", "S1"), ("G1", "S7")]
    again = block_from_messages(messages, "x")
    assert again.image_name(1) == ("G1", "S7", "N") and again.image.strip[1] == -1


def test_recordings_that_hold_no_block():
    messages = list(block_messages(simulated_block()))
    for topic, wanted in (
        ("configuration/camera", "no message on configuration/camera"),
        ("configuration/strip", "no message on configuration/strip"),
        ("observation/tie", "no message on observation/tie"),
        ("trajectory/smoothed", "no message on trajectory/smoothed or trajectory/filtered"),
    ):
        with pytest.raises(UserError, match=wanted):
            block_from_messages([m for m in messages if m.topic != topic], "x")


# ---- what a user sees


def _refused(capsys, *args: object) -> str:
    return refusal(capsys, "import", *args)


def test_foreign_files_get_one_line(tmp_path, capsys):
    out = tmp_path / "out.mcap"
    text, empty, folder = tmp_path / "notes.txt", tmp_path / "empty.bin", tmp_path / "folder"
    text.write_text("hello\n" * 100)
    empty.touch()
    folder.mkdir()
    (tmp_path / "other.xml").write_text("<?xml version='1.0'?><a/>")
    (tmp_path / "other.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    assert "of no known kind" in _refused(capsys, str(text), "-o", str(out))
    assert "empty, wanted one of" in _refused(capsys, str(empty), "-o", str(out))
    assert "none of block folder" in _refused(capsys, str(folder), "-o", str(out))
    assert "no such file or folder" in _refused(capsys, str(tmp_path / "none"), "-o", str(out))
    assert "XML of another kind" in _refused(capsys, str(tmp_path / "other.xml"), "-o", str(out))
    assert "no usable sensor_msgs" in _refused(capsys, str(tmp_path / "other.mcap"), "-o", str(out))
    assert "time_s: column missing" in _refused(capsys, str(tmp_path / "other.csv"), "-o", str(out))
    block = write_files(tmp_path / "block")
    assert "no preset of that name" in _refused(
        capsys, str(write_sbet_file(tmp_path)), "-o", str(out), "--camera", "nikon"
    )
    assert "no folder" in _refused(capsys, str(block), "-o", str(tmp_path / "no" / "out.mcap"))
    assert not out.exists() and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("head", "wanted"),
    [
        ("$GNGGA,092750.20,5321.6802,N,00630.3372,W,4,18,0.8,61.7,M,55.2,M,,*5E\n", 'kind = "nmea" in a flight.toml'),
        (
            "Project:     x\nProgram:     Inertial Explorer Version 8.90.6611\n",
            "without a row of names (Latitude, Longitude, H-Ell,",
        ),
        ("Project:     x\n\nProgram:     GrafNav Version 9.00.2207\n", "text of Inertial Explorer or GrafNav"),
    ],
)
def test_navigation_of_receivers_and_other_programs_is_named(tmp_path, capsys, head, wanted):
    path = tmp_path / "navigation.txt"
    path.write_text(head * 20)
    assert wanted in _refused(capsys, str(path), "-o", str(tmp_path / "out.mcap"))


def write_sbet_file(folder: Path) -> Path:
    track = straight_track()
    path = folder / "sbet_x.out"
    write_sbet(path, gps_from_utc_ns(track.time_ns)[1], track.geodetic, track.rpy, np.zeros((50, 3)))
    return path


def test_bad_block_leaves_no_file(tmp_path, capsys):
    bad = write_files(tmp_path / "block", image_points="point,strip,ccd,line,sample\nG1,S1,F,1,x\n")
    err = _refused(capsys, str(bad), "-o", str(tmp_path / "out.mcap"))
    assert "image_points.csv:2: sample: 'x' is not a number" in err
    assert not (tmp_path / "out.mcap").exists()


def test_usage_errors(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["import", "x", "-o", "y", "--date", "yesterday"])
    assert stop.value.code == 2 and "wanted YYYY-MM-DD" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options, wanted",
    [
        (["--lever-arm", "nan", "0", "0"], "--lever-arm nan 0 0: wanted metres within 50; are they mm?"),
        (["--lever-arm", "0", "inf", "0"], "--lever-arm 0 inf 0: wanted metres within 50"),
        (["--lever-arm", "0", "0", "-1500"], "--lever-arm 0 0 -1500: wanted metres within 50"),
        (["--boresight", "nan", "0", "0"], "--boresight nan 0 0: wanted degrees within 360"),
        (["--boresight", "0", "0", "1e9"], "--boresight 0 0 1e+09: wanted degrees within 360"),
        (["--position-sigma", "1", "nan", "1"], "--position-sigma 1 nan 1: wanted three numbers above 0"),
        (["--line-rate", "nan"], "--line-rate nan, wanted a number above 0 (Hz)"),
        (["--line-rate", "inf"], "--line-rate inf, wanted a number above 0 (Hz)"),
        (["--above-ground", "nan"], "--above-ground nan, wanted more than 0 m"),
        (["--ground-height", "nan"], "--ground-height nan, wanted metres from -500 to 9000"),
        (["--camera", ""], "--camera '': wanted a name"),
        (["--seconds-of-day"], "--seconds-of-day goes with --date"),
    ],
)
def test_numbers_and_names_that_cannot_be(tmp_path, capsys, options, wanted):
    out = tmp_path / "out.mcap"
    assert wanted in _refused(capsys, str(write_sbet_file(tmp_path)), "-o", str(out), *options)
    assert not out.exists()


VALUES = {
    "date": ["2020-06-01"], "crs": ["EPSG:32632"], "camera": ["ads40"], "lever_arm": ["0", "0", "1"],
    "boresight": ["0", "0", "1"], "position_sigma": ["1", "1", "1"], "attitude_sigma": ["1", "1", "1"],
    "line_rate": ["50"], "seconds_of_day": [], "ground_height": ["100"], "lines": ["N=n.img"], "strip": ["S1"],
}  # fmt: skip


def test_every_kind_says_which_options_go_with_it():
    assert GO_WITH.keys() == KINDS.keys()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "flight"])
def test_options_without_effect_are_refused(tmp_path, capsys, kind):
    path = tmp_path / "input"
    path.write_text("content")
    for name in VALUES.keys() - set(GO_WITH[kind]):
        flag = f"--{name.replace('_', '-')}"
        err = _refused(capsys, str(path), "-o", str(tmp_path / "out.mcap"), "--format", kind, flag, *VALUES[name])
        assert f"{flag} does not go with {KINDS[kind]}" in err


GPX = """<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="48" lon="11"><ele>900</ele><time>2020-06-01T12:00:00Z</time></trkpt>
<trkpt lat="48.001" lon="11"><ele>900</ele><time>2020-06-01T12:00:02Z</time></trkpt></trkseg></trk></gpx>"""


@pytest.mark.parametrize(
    "name, option, wanted",
    [
        ("poses.csv", "crs", "poses.csv, whose positions are latitude and longitude"),
        ("poses.csv", "line_rate", "--line-rate is of images, wanted --lines VIEW=FILE with it"),
        ("track.gpx", "lever_arm", "--lever-arm does not go with"),
        ("track.gpx", "attitude_sigma", "track.gpx, whose positions have no attitudes"),
        ("f090625t01p00r05_lonlat_eph", "crs", "whose positions are latitude and longitude"),
    ],
)
def test_what_a_file_holds_decides_which_options_go_with_it(tmp_path, capsys, name, option, wanted):
    rows = "".join(f"{1591012800 + i},48.00{i},11,900,0,0,0\n" for i in range(3))
    (tmp_path / "poses.csv").write_text("time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + rows)
    (tmp_path / "track.gpx").write_text(GPX)
    np.array([[11.0, 48.0, 900.0, 0.0, 0.0, 0.0]] * 3).astype("<f8").tofile(tmp_path / "f090625t01p00r05_lonlat_eph")
    out = tmp_path / "out.mcap"
    more = [f"--{option.replace('_', '-')}", *VALUES[option]]
    assert wanted in _refused(capsys, str(tmp_path / name), "-o", str(out), *more)
    assert main(["import", str(tmp_path / name), "-o", str(out), "--camera", "ads40", "--position-sigma", *"123"]) == 0


def test_options_reach_the_reader(tmp_path):
    path = write_sbet_file(tmp_path)
    options = Options(day=date(2020, 6, 1), mounting=Mounting(lever_arm_m=(0.0, 0.0, 10.0)))
    messages = list(read_any(path, options=options).messages)
    plain = list(read_any(path, options=Options(day=date(2020, 6, 1))).messages)
    assert messages[0].stamp_ns == pytest.approx(ns("2020-06-01T12:00:00"), abs=200)
    lower = pose_sample(plain[5].body).position_l[2] - pose_sample(messages[5].body).position_l[2]
    assert lower == pytest.approx(10.0, abs=0.01)
