"""The simulator as a node, and the command that writes its recordings."""

import json
import time
from collections import Counter, defaultdict

import numpy as np
import pytest
from bus_rig import free_port, wait_for
from places import MOTION

from triline.nodes import convert
from triline.nodes.bus.program import ProgramOptions
from triline.nodes.bus.session import Bus
from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator, run
from triline.schemas import topics
from triline.solver.accuracy import angle_difference
from triline.solver.camera.collinearity import project
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory
from triline.solver.navigation.inertial_data import TACTICAL
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.inertial_sensors import InertialPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

EPOCH_NS = 1_780_000_000 * convert.SECOND_NS
SMALL = FlightPlan(strips=2, strip_s=25.0, lead_in_s=2.0, lead_out_s=1.0)


@pytest.fixture(scope="module")
def simulation():
    return simulate(SMALL, 1, observation_plan=ObservationPlan(tie_points_per_s=4.0, image_sigma_px=0.0))


@pytest.fixture(scope="module")
def messages(simulation):
    return list(Simulator(simulation).messages(EPOCH_NS))


def of(messages, topic):
    return [message for message in messages if message.topic == topic]


# -- the messages ------------------------------------------------------------------------------------------------------


def test_messages_come_in_the_order_in_which_they_are_processed(messages):
    keys = [(message.stamp_ns, topics.rank(message.topic)) for message in messages]
    assert keys == sorted(keys)
    assert messages[0].topic == "configuration/project" and messages[0].stamp_ns == EPOCH_NS - convert.SECOND_NS
    assert messages[1].topic == "configuration/camera"
    assert {message.topic for message in messages} <= set(Simulator.outputs)


def test_counts(simulation, messages):
    counts = Counter(message.topic for message in messages)
    n = len(simulation.flight.truth)
    assert counts["sensor/attitude"] == n
    assert counts["sensor/gnss"] == (n - 1) // 40 + 1
    assert counts["truth/trajectory"] == (n - 1) // 10 + 1
    assert counts["truth/point"] == len(simulation.points)
    assert counts["observation/control"] == 36
    assert counts["configuration/strip"] == 4
    assert sum(len(tie.body.images) for tie in of(messages, "observation/tie")) == len(simulation.images)
    assert len(Simulator(simulation)) == len(messages)


def test_each_stamp_is_when_the_measurement_could_be_known(simulation, messages):
    """Sensors at once; a tie point after its last look in the strip and the matching delay, never earlier."""
    delay = round(simulation.observation_plan.matching_delay_s * 1e9)
    for message in messages:
        body = message.body
        if message.topic == "observation/tie":
            newest = max(image.time_ns for image in body.images)
            assert abs(message.stamp_ns - newest - delay) <= 2
            assert len({image.strip for image in body.images}) == 1
        elif message.topic == "sensor/attitude":
            assert body.time_ns == message.stamp_ns
        elif message.topic in ("sensor/gnss", "truth/trajectory"):
            assert convert.time_ns(body.timestamp) == message.stamp_ns
        elif message.topic in ("observation/control", "truth/point"):
            assert message.stamp_ns == EPOCH_NS - convert.SECOND_NS


def test_rays_of_a_later_strip_come_as_a_further_message(messages):
    seen = defaultdict(list)
    for tie in of(messages, "observation/tie"):
        seen[tie.body.point].append(tie.body.images[0].strip)
    again = [strips for strips in seen.values() if len(strips) > 1]
    assert len(again) > 20
    assert all(strips == ["S1", "S2"] for strips in again)


def test_strips_begin_before_their_rays_and_end_after_them(simulation, messages):
    strips = of(messages, "configuration/strip")
    assert [(s.body.id, s.body.ended) for s in strips] == [("S1", False), ("S1", True), ("S2", False), ("S2", True)]
    for begin, end in ((0, 1), (2, 3)):
        rays = [t.stamp_ns for t in of(messages, "observation/tie") if t.body.images[0].strip == strips[begin].body.id]
        assert strips[begin].stamp_ns == strips[begin].body.first_line_time_ns
        assert strips[begin].stamp_ns < min(rays) and max(rays) < strips[end].stamp_ns
        assert strips[end].stamp_ns - max(rays) < 3e9
        assert strips[end].body.lines == simulation.flight.strips[begin // 2].lines


def test_line_numbers_and_time_stamps_of_images_agree(messages):
    strips = {s.body.id: s.body for s in of(messages, "configuration/strip")}
    for tie in of(messages, "observation/tie"):
        for image in tie.body.images:
            strip = strips[image.strip]
            line = (image.time_ns - strip.first_line_time_ns) * 1e-9 * strip.line_rate_hz
            assert line == pytest.approx(image.line, abs=1e-6)
            assert 0 <= image.line < strip.lines


def test_rays_reproject_through_the_messages_alone(simulation, messages):
    """Camera, true points and noise-free rays as a stranger reads them; orientation from the truth."""
    camera = convert.camera_from(of(messages, "configuration/camera")[0].body)
    points = {t.body.point: (t.body.x, t.body.y, t.body.z) for t in of(messages, "truth/point")}
    images = [(tie.body.point, image) for tie in of(messages, "observation/tie") for image in tie.body.images]
    ccd = np.array([camera.line_index[image.ccd] for _, image in images])
    xyz = np.array([points[point] for point, _ in images])
    poses = simulation.flight.truth.at([(image.time_ns - EPOCH_NS) * 1e-9 for _, image in images])
    computed = project(poses.position_l, poses.angles, xyz, camera.focal_length_mm[ccd]).xy_mm
    measured, _ = camera.image_coordinates(ccd, np.array([image.sample for _, image in images]))
    assert np.abs(computed - measured).max() / 0.0065 < 2e-6  # stamps are whole nanoseconds


def test_project_tells_what_was_simulated():
    errors = ErrorModel(
        offset_sigma_m=(1.0, 2.0, 3.0), wander_time_s=44.0, attitude_wander_time_s=8.0, drift_sigma_deg=(0.0, 0.1, 0.2)
    )
    s = simulate(SMALL, 1, errors, ObservationPlan(tie_points_per_s=1.0, image_sigma_px=0.4))
    project_body = next(iter(Simulator(s).messages(EPOCH_NS))).body
    assert list(project_body.offset_sigma_m) == [1.0, 2.0, 3.0]
    assert (project_body.wander_time_s, project_body.attitude_wander_time_s) == (44.0, 8.0)
    assert convert.slow_errors_of(project_body).wander_times_s.tolist() == [44.0] * 3 + [8.0] * 3
    assert project_body.image_sigma_px == 0.4
    assert list(project_body.wander_sigma_m) == [1.0, 1.0, 1.5]
    assert list(project_body.drift_sigma_deg)[1:] == [0.1, 0.2] and 0 < project_body.drift_sigma_deg[0] < 1e-5
    assert convert.lever_arm_of(project_body) == pytest.approx(s.mounting.lever_arm_m)
    assert convert.R_bc_of(project_body) == pytest.approx(s.mounting.R_bc)
    assert convert.local_frame(project_body) == s.flight.frame


def test_control_and_check_points_have_their_roles_and_sigmas(simulation, messages):
    truth = {t.body.point: (t.body.x, t.body.y, t.body.z) for t in of(messages, "truth/point")}
    roles = Counter()
    for message in of(messages, "observation/control"):
        body, role = message.body, convert.role_of(message.body)
        roles[role] += 1
        off = np.subtract((body.x, body.y, body.z), truth[body.point])
        if role == "check":
            assert (off == 0).all() and not any(body.covariance)
        else:
            assert np.reshape(body.covariance, (3, 3)) == pytest.approx(np.eye(3) * 0.02**2)
            assert 0 < np.abs(off).max() < 0.1
    assert roles == {"control": 6, "check": 30}


def test_true_trajectory_names_its_strip(simulation, messages):
    for message in of(messages, "truth/trajectory"):
        t = (message.stamp_ns - EPOCH_NS) * 1e-9
        times = simulation.flight.strip_times_s
        inside = [s.id for s, (a, b) in zip(simulation.flight.strips, times, strict=True) if a <= t <= b]
        assert message.body.strip == "".join(inside)
        pose = convert.pose_sample(message.body)
        truth = simulation.flight.truth.at(t)
        assert pose.position_l == pytest.approx(truth.position_l[0], abs=1e-4)
        assert matrix_from_angles(*message.body.angles) == pytest.approx(truth.R_lc[0], abs=1e-8)


def test_inertial_data_take_the_place_of_attitude():
    s = simulate(FlightPlan(strip_s=5.0, lead_in_s=2.0), 1, inertial=InertialPlan(TACTICAL, 100.0))
    found = list(Simulator(s).messages(EPOCH_NS))
    counts = Counter(message.topic for message in found)
    assert counts["sensor/imu"] == 1200 and "sensor/attitude" not in counts
    imu = of(found, "sensor/imu")[0].body
    assert imu.interval_ns == 10_000_000 and imu.time_ns == EPOCH_NS + 10_000_000
    assert imu.force_z == pytest.approx(-9.81, abs=1.5) and imu.rate_sigma > 0 and imu.force_sigma > 0
    assert of(found, "sensor/gnss")[3].body.velocity_enu.x == pytest.approx(70.0, abs=1.5)


def test_epoch_shifts_all_times_alike(simulation, messages):
    shift = 123_456_789_000
    for one, other in zip(messages[::97], list(Simulator(simulation).messages(EPOCH_NS + shift))[::97], strict=True):
        assert other.stamp_ns - one.stamp_ns == shift
        if one.topic == "sensor/attitude":
            assert other.body.time_ns - one.body.time_ns == shift and other.body.roll == one.body.roll


# -- the command -------------------------------------------------------------------------------------------------------

QUICK = ["simulate", "--seconds", "20", "--ties", "2", "--lead-in", "1"]


def test_same_seed_same_bytes(tmp_path, capsys):
    files = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for file, seed in zip(files, ("3", "3", "4"), strict=True):
        assert main([*QUICK, "-o", str(file), "--seed", seed]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    assert files[0].read_bytes() != files[2].read_bytes()
    assert "tie points" in capsys.readouterr().out


def test_recording_holds_the_flight(tmp_path, capsys):
    file = tmp_path / "flight.mcap"
    options = ["--strips", "2", "--cross", "1", "--no-turns", "--unstabilised", "--outliers", "0.1", "--control", "4"]
    assert (
        main([*QUICK, "-o", str(file), "--json", "--sensor", "si-100", "--epoch", "2026-06-01T00:00:00Z", *options])
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    read = list(RecordingReader(file).messages())
    counts = Counter(message.topic for message in read)
    assert counts == result["messages"]
    assert list(result["strips"]) == ["S1", "S2", "C1"]
    assert result["points"]["control"] == 4 and result["camera"] == "si-100"
    assert result["outliers"] == pytest.approx(0.1 * result["rays"], rel=0.5)
    assert read[0].stamp_ns == 1_780_271_999 * convert.SECOND_NS
    by_topic = defaultdict(list)
    for message in read:
        by_topic[message.topic].append(message.sequence)
    assert all(numbers == list(range(len(numbers))) for numbers in by_topic.values())
    assert main(["info", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["duration_s"] == pytest.approx(result["seconds"])


def test_control_of_a_camera_with_one_ccd_line_is_measured_where_one_strip_sees_it(tmp_path, capsys):
    camera = {
        "name": "one line",
        "lenses": [{"id": "L", "focal_length_mm": 62.7, "principal_point_mm": [0.0, 0.0]}],
        "lines": [{"id": "N", "lens": "L", "pixels": 1500, "pixel_size_mm": 0.052, "center_mm": [0.0, 0.0]}],
    }
    (tmp_path / "one.json").write_text(json.dumps(camera))
    options = ["--sensor", str(tmp_path / "one.json"), "--control", "4", "--check", "4", "--attitude-rate", "20"]
    assert main([*QUICK, "-o", str(tmp_path / "f.mcap"), "--json", *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["points"] == {"tie": 0, "control": 4, "check": 0} and result["rays"] == 4


def test_a_camera_whose_lines_lie_along_the_flight_is_refused(tmp_path, capsys):
    """It would see the ground along its own track."""
    line = {"id": "N", "lens": "L", "pixels": 100, "pixel_size_mm": 0.1, "center_mm": [0, 0], "inclination_deg": 90}
    camera = {"lenses": [{"id": "L", "focal_length_mm": 50}], "lines": [line]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    assert main(["simulate", "-o", str(tmp_path / "x.mcap"), "--sensor", str(tmp_path / "camera.json")]) == 1
    error = capsys.readouterr().err
    assert "lie along x, wanted along y: across the flight" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "options, words",
    [
        (["--strips", "0"], "at least one strip"),
        (["--sensor", "leica"], "presets: ads40"),
        (["--sensor", "alos-prism"], "one lens"),
        (["--seed", "-1"], "seed must not be negative"),
        (["--epoch", "yesterday"], "wanted a time such as"),
        (["--epoch", "2026-01-01T00:00:00"], "time zone"),
        (["--epoch", "1960-01-01T00:00:00Z"], "before 1970, wanted UTC since then"),
        (["--epoch", "9999-01-01T00:00:00Z"], "wanted a time before 2261"),
        (["--offset", "1", "1", "-1"], "offset_sigma_m"),
        (["--outliers", "1.5"], "outlier_share"),
        (["--height", "inf"], "height is inf, wanted a number"),
        (["--imu", "mems", "--strips", "2", "--no-turns"], "without interruptions"),
        (["--motion", "absent_file"], "no such file"),
        (["--motion", "absent_file", "--strips", "2"], "belongs to a planned flight"),
        (["--motion", "absent_file", "--no-turns"], "belongs to a planned flight"),
        (["--motion", "absent_file", "--ground", "nan"], "ground is nan, wanted a number"),
        (["--heading", "nan"], "heading is nan, wanted a number"),
        (["--relief", "nan"], "relief is nan, wanted a number"),
        (["--offset", "1", "nan", "1"], "wanted 3 numbers"),
        (["--satellite", "spot5-hrs", "--control-sigma", "inf"], "control_sigma is inf, wanted 3 numbers"),
        (["--satellite", "spot5-hrs", "--place", "nan", "0"], "--place nan 0: wanted latitude and longitude, degrees"),
    ],
)
def test_bad_options_get_one_line(tmp_path, capsys, options, words):
    assert main([*QUICK[:1], "-o", str(tmp_path / "x.mcap"), *options]) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and error.startswith("triline simulate: ")
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    "options, words",
    [
        (["--image-noise", "3"], "--image-noise goes with --images"),
        (["--cars", "0"], "--cars goes with --images"),
        (["--clouds", "0.1"], "--clouds goes with --images"),
        (["--imu-rate", "100"], "--imu-rate goes with --imu"),
        (["--outlier-px", "5", "9"], "--outlier-px goes with --outliers"),
        (["--outliers", "0", "--outlier-px", "5", "9"], "--outlier-px goes with --outliers"),
        (["--images", "--outliers", "0.1"], "--outliers goes with --ties above 0"),
        (["--ties", "0", "--outliers", "0.1"], "--outliers goes with --ties above 0"),
        (["--satellite", "aster-vnir", "--images", "--outliers", "0.1"], "--outliers does not go with --satellite and"),
        (["--sidelap", "0.2"], "--sidelap goes with --strips, of at least 2"),
        (["--sidelap", "0.2", "--cross", "1"], "--sidelap goes with --strips, of at least 2"),
        (["--no-turns"], "--no-turns goes with --strips or --cross"),
        (["--imu", "mems", "--attitude-rate", "100"], "--attitude-rate does not go with --imu"),
        (["--imu", "mems", "--noise-attitude", "1", "1", "1"], "--noise-attitude does not go with --imu"),
        (["--motion", "absent_file", "--gnss-rate", "2"], "--gnss-rate does not go with --motion"),
        (["--motion", "absent_file", "--as-sensors", "--attitude-rate", "2"], "--attitude-rate does not go with"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, capsys, options, words):
    assert main([*QUICK[:1], "-o", str(tmp_path / "x.mcap"), *options]) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_options_that_go_together_are_taken():
    plan = {"seconds": 4, "ties": 2, "lead_in": 1, "control": 0, "check": 0}
    assert len(simulated_flight({**plan, "no_turns": True, "cross": 1}).simulation.flight.strips) == 2
    assert simulated_flight({**plan, "no_turns": False, "outliers": 0.1, "outlier_px": [5, 9]}).motion is None
    assert simulated_flight({**plan, "images": True, "outliers": 0.1}).imager is not None


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"altitude": 3}, "altitude is not known"),
        ({"strips": "many"}, "wanted a whole number"),
        ({"offset": [1, 2]}, "has 2 values, wanted 3"),
        ({"strips": [1, 2]}, "wanted one value"),
        ({"no_turns": 1}, "wanted true or false"),
        ({"imu": "best"}, "wanted one of tactical, mems"),
        ({"offset": None}, "wanted 3 numbers"),
    ],
)
def test_bad_settings_of_a_configuration_file_are_named(settings, words):
    with pytest.raises(UserError, match=words):
        simulated_flight(settings)


def test_settings_reach_the_simulation():
    settings = {
        "seconds": "12",
        "strips": 2,
        "offset": 0.7,
        "control_sigma": [0.1, 0.1, 0.2],
        "unstabilised": True,
        "ties": 1,
    }
    flight = simulated_flight(settings)
    s = flight.simulation
    assert s.errors.offset_sigma_m == (0.7, 0.7, 0.7) and s.observation_plan.control_sigma_m == (0.1, 0.1, 0.2)
    assert [strip.id for strip in s.flight.strips] == ["S1", "S2"]
    assert np.diff(s.flight.strip_times_s, axis=1) == pytest.approx(12.0, abs=0.11)
    assert np.degrees(s.flight.truth.at(s.flight.truth.time_s).angles[:, 1]).std() > 0.2
    assert flight.epoch_ns is None and flight.motion is None


def test_flight_on_the_bus():
    """The program publishes what the simulator makes, stamped with the time of the wall, and its status."""
    port = free_port()
    options = ProgramOptions(
        "simulator",
        platform="sim",
        port=port,
        tables={"simulator": {"seconds": 1, "lead_in": 1, "ties": 1, "rate": 0}},
    )
    received = []
    with Bus("sim", source="listener", port=port) as bus:
        for topic in (*Simulator.outputs, "status/*"):
            bus.subscribe(topic, received.append)
        before = time.time_ns()
        assert run(options) == 0
        expected = simulate(FlightPlan(strip_s=1, lead_in_s=1), 1, observation_plan=ObservationPlan(tie_points_per_s=1))
        wanted = Counter(message.topic for message in Simulator(expected).messages(0))
        wait_for(lambda: Counter(raw.topic for raw in tuple(received)) >= wanted, 10, "all messages")
    counts = Counter(raw.topic for raw in received)
    assert counts.pop("status/simulator") >= 1
    assert counts == wanted
    stamps = [raw.envelope.stamp_ns for raw in received if raw.topic == "sensor/attitude"]
    assert 0 < min(stamps) - before < 5e9 and stamps == sorted(stamps)


def test_program_names_settings_it_does_not_know():
    port = free_port()
    with pytest.raises(UserError, match="altitude is not known"):
        run(ProgramOptions("simulator", port=port, tables={"simulator": {"altitude": 3}}))
    with pytest.raises(UserError, match="rate is 'fast'"):
        run(ProgramOptions("simulator", port=port, tables={"simulator": {"rate": "fast"}}))


def test_missing_output_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["simulate"])
    assert stop.value.code == 2


@pytest.mark.parametrize("as_sensors", [False, True])
def test_real_motion(tmp_path, capsys, as_sensors):
    if not MOTION.exists():
        pytest.skip(f"{MOTION} is absent")
    file = tmp_path / "real.mcap"
    options = [
        "--motion",
        str(MOTION),
        "--from",
        "900",
        "--seconds",
        "90",
        "--ties",
        "2",
        *["--as-sensors"] * as_sensors,
    ]
    assert main(["simulate", "-o", str(file), "--json", *options]) == 0
    result = json.loads(capsys.readouterr().out)
    given = {"sensor/attitude", "sensor/gnss"} if as_sensors else {"trajectory/smoothed"}
    assert {t for t in result["messages"] if t.startswith(("sensor", "trajectory"))} == given
    read = list(RecordingReader(file).messages())
    start = np.datetime64(of(read, "truth/trajectory")[0].stamp_ns, "ns")
    # line 9690 of the file: GPS second 419877 of the week from 2017-03-19, 18 leap seconds
    assert abs(start - np.datetime64("2017-03-23T20:37:39", "ns")) < np.timedelta64(1, "s")
    if not as_sensors:
        pose = convert.pose_sample(of(read, "trajectory/smoothed")[200].body)
        assert pose.covariance is not None
        assert np.sqrt(np.diag(pose.covariance))[:3] == pytest.approx(np.hypot([8, 8, 12], [3, 3, 4]), rel=1e-3)
        assert pose.strip == "S1"


def test_motion_that_is_no_pose_file(tmp_path, capsys):
    file = tmp_path / "ang20170323t202244_eph_att"
    file.write_bytes(b"not poses")
    assert main(["simulate", "-o", str(tmp_path / "x.mcap"), "--motion", str(file)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def lively_track(path, seconds=24.0, rate_hz=10.0):
    """Turbulent flight at 500 m above ground as `triline navigate` writes it, ten poses a second."""
    t = np.arange(0, seconds, 1 / rate_hz)
    phase = np.random.default_rng(3).uniform(0, 2 * np.pi, 3)
    roll, pitch, heading = (2.0 * np.sin(9.0 * t + p) for p in phase)
    lines = ["time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    lines += [
        f"{1.7e9 + a:.3f},{48.0 + a * 70 / 111_200:.10f},11.0,700.0,{r:.6f},{p:.6f},{h:.6f}"
        for a, r, p, h in zip(t, roll, pitch, heading, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_truth_of_a_lively_motion_is_recorded_as_it_moves(tmp_path):
    flight = simulated_flight({"motion": str(lively_track(tmp_path / "poses.csv")), "ties": 1.0, "control": 2})
    truth = flight.simulation.flight.truth
    written = [m for m in Simulator(flight.simulation).messages(EPOCH_NS) if m.topic == "truth/trajectory"]
    poses = [convert.pose_sample(m.body) for m in written]
    again = Trajectory(
        [(p.time_ns - EPOCH_NS) * 1e-9 for p in poses], [p.position_l for p in poses], [p.quaternion for p in poses]
    )
    between = np.arange(4.0, 18.0, 0.013)
    assert angle_difference(again.at(between).angles, truth.at(between).angles) == pytest.approx(0.0, abs=1e-9)
    # what 20 Hz would make of it is larger than orientation is measured to
    at_20 = truth.at(np.arange(3.0, 20.0, 0.05))
    coarse = Trajectory(at_20.time_s, at_20.position_l, quaternion_from_matrix(at_20.R_lc))
    assert np.degrees(angle_difference(coarse.at(between).angles, truth.at(between).angles)).std() > 0.005


def test_motion_of_a_csv_and_of_a_recording_that_was_made_with_it(tmp_path, capsys):
    poses = lively_track(tmp_path / "poses.csv")
    flight = tmp_path / "flight.mcap"
    options = ["--ground", "200", "--ties", "1", "--control", "2", "--check", "2", "-q"]
    assert main(["simulate", "-o", str(flight), "--motion", str(poses), *options]) == 0
    again = simulated_flight({"motion": str(flight), "ties": 1.0, "control": 2}).simulation.flight
    truth = simulated_flight({"motion": str(poses), "ties": 1.0, "control": 2}).simulation.flight
    assert again.camera.name == "ads40"  # 500 m above the ground: not the camera of high altitude
    assert again.truth.position_l == pytest.approx(truth.truth.position_l, abs=1e-4)
    assert again.truth.at([9.87]).angles == pytest.approx(truth.truth.at([9.87]).angles, abs=1e-8)


def test_a_gap_in_a_motion_is_told(tmp_path, capsys):
    """What `export --per-line` writes has no poses between strips: a strip was flown across, and nothing said so."""
    whole = lively_track(tmp_path / "poses.csv").read_text().splitlines()
    (tmp_path / "two.csv").write_text("\n".join([*whole[: len(whole) // 2], *whole[len(whole) // 2 + 60 :]]))
    for name, gaps in (("poses.csv", 0), ("two.csv", 1)):
        words = ["--motion", str(tmp_path / name), "--ground", "200", "--ties", "1", "--json"]
        assert main(["simulate", "-o", str(tmp_path / "a.mcap"), *words]) == 0
        notes = [note for note in json.loads(capsys.readouterr().out)["notes"] if "interpolated" in note]
        assert len(notes) == gaps and all("motion has 1 gap, of " in note for note in notes), notes


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], None),
        (["--seconds", "20"], None),
        (["--seconds", "38"], "23.9 of the 38 s that were asked for, from 0.0 to 23.9 s"),
        (["--seconds", "29.55", "--from", "30"], "19.5 of the 29.55 s that were asked for, from 40.0 to 59.5 s"),
        (["--seconds", "70", "--from", "10"], "53.9 of the 70 s that were asked for, from 10.0 to 63.9 s"),
    ],
)
def test_a_motion_that_is_shorter_than_asked_for_is_told(tmp_path, capsys, words, told):
    """It ended with the gap, or with the recorded flight, and nothing said so."""
    rows = lively_track(tmp_path / "poses.csv", 64.0).read_text().splitlines()
    (tmp_path / "two.csv").write_text("\n".join([*rows[:241], *rows[401:]]))
    words = [*words, "--motion", str(tmp_path / "two.csv"), "--ground", "200", "--ties", "1", "--json"]
    assert main(["simulate", "-o", str(tmp_path / "a.mcap"), *words]) == 0
    notes = [note for note in json.loads(capsys.readouterr().out)["notes"] if "asked for" in note]
    begin = "the recorded motion has poses for "
    assert notes == ([] if told is None else [f"{begin}{told}: it ends there, or has a gap"])


def test_motion_of_what_has_no_poses_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "imu.csv").write_text("time_s\n")
    assert main(["simulate", "-o", str(tmp_path / "x.mcap"), "--motion", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "wanted a trajectory" in said and "triline navigate" in said
    poses = lively_track(tmp_path / "poses.csv")
    assert main(["simulate", "-o", str(tmp_path / "x.mcap"), "--motion", str(poses), "--ground", "900"]) == 1
    assert "below the ground at 900 m" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--seconds", "4"], "left out 6 of 6 check points and all tie points, "),
        (["--seconds", "8"], "left out 5 of 6 check points, "),
        (["--seconds", "25"], ""),
    ],
)
def test_why_points_that_were_asked_for_are_not_there_is_said(words, told, tmp_path, capsys):
    """A strip too short for all views to see the same ground had 0 check points, without a word."""
    command = ["simulate", "-o", str(tmp_path / "a.mcap"), "--sensor", "ads40-small", "--control", "4", "--check", "6"]
    assert main([*command, *words, "--seed", "1"]) == 0
    said = capsys.readouterr().out
    assert ("note: " in said) is bool(told)
    if told:
        assert f"  note: {told}which are not seen often enough (twice; control once): all CCD lines " in said
        assert f" see the same ground where a strip lasts 20 s or longer, and S1 lasts {words[1]} s\n" in said
    assert main([*command, *words, "--seed", "1", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["notes"]) == bool(told)


def test_a_camera_with_one_ccd_line_is_named_as_the_reason(tmp_path, capsys):
    line = {"id": "N", "lens": "L", "pixels": 500, "pixel_size_mm": 0.01, "center_mm": [0, 0], "inclination_deg": 0}
    camera = {"name": "one", "lenses": [{"id": "L", "focal_length_mm": 60.0}], "lines": [line]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    words = ["simulate", "-o", str(tmp_path / "a.mcap"), "--sensor", str(tmp_path / "camera.json"), "--seconds", "10"]
    assert main([*words, "--control", "2", "--check", "3"]) == 0
    assert "the camera has one CCD line, and sees a point once in a strip: wanted strips" in capsys.readouterr().out
