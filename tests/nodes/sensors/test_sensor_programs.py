"""Sensor tables of a flight folder, the programs they start, and what is said of sensors that do not come."""

from __future__ import annotations

import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from bus_rig import free_port, wait_for
from envi_files import write_camera

from triline.nodes.bus.program import ProgramOptions
from triline.nodes.bus.session import Bus
from triline.nodes.cli import fly, main, parse
from triline.nodes.cli.fly import FirstData
from triline.nodes.cli.node import _value
from triline.nodes.convert import gnss_message
from triline.nodes.formats.flight_folder import read_flight
from triline.nodes.formats.flight_messages import live_configuration
from triline.nodes.monitor.sensor_watch import SensorWatch
from triline.nodes.sensors import line_camera
from triline.nodes.sensors.settings import read_sensors
from triline.nodes.sensors.stream import run
from triline.schemas import messages as m
from triline.schemas.codec import decode, encode
from triline.schemas.envelope import Envelope, RawMessage

TOML = """
[flight]
name = "live"
platform = "live1"
crs = "EPSG:32632"
vertical_datum = "ellipsoid"
ground_height_m = 300.0
[camera]
file = "camera.json"
[navigation]
gnss = "RTK"
imu = "tactical"
[[strips]]
id = "S1"
first_time = 2026-11-22T09:30:00Z
line_rate_hz = 100
[[sensor]]
kind = "nmea"
address = "file:gnss.nmea"
date = 2026-11-22
[[sensor]]
kind = "stream"
id = "camera"
address = "listen://127.0.0.1:5555"
clock_offset_s = -0.5
[[sensor]]
kind = "lines"
images = {N = "n.bil@2"}
line_rate_hz = 100
first_time = 2026-11-22T09:30:00Z
[nodes.matcher]
ground_m = 5.0
"""
T = 1_795_339_800_000_000_000


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "flight.toml").write_text(TOML)
    write_camera(tmp_path / "camera.json")
    return tmp_path


def test_a_folder_of_a_live_flight(folder, capsys):
    assert main(["check", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "`triline fly` starts the sensors nmea (nmea), camera (stream), lines (lines)" in said
    flight = read_flight(folder)
    nmea, camera, lines = read_sensors(flight)
    assert nmea.settings["address"] == f"file:{(folder / 'gnss.nmea').resolve()}"
    assert camera.settings["imu_noise"] == [flight.grade.gyro_noise, flight.grade.accel_noise]
    # what goes to a program comes back from its command line
    for program in (nmea, camera, lines):
        words = program.arguments()[1::2]
        assert {w.partition("=")[0]: _value(w.partition("=")[2]) for w in words} == program.settings
    assert lines.settings["images"] == {"N": f"{(folder / 'n.bil').resolve()}@2"}


def test_image_topics_in_several_tables_are_told(folder, capsys):
    ros = '[[sensor]]\nkind = "ros2"\nid = "ros-{0}"\nline_rate_hz = 100\nimages = {{{0} = "/camera/{0}"}}\n'
    (folder / "flight.toml").write_text(TOML.partition("[nodes")[0] + ros.format("F"))
    assert main(["check", str(folder)]) == 0
    assert "separate strips" not in capsys.readouterr().out
    (folder / "flight.toml").write_text(TOML.partition("[nodes")[0] + ros.format("F") + ros.format("N"))
    assert main(["check", str(folder)]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "separate strips" in line]
    assert said == [
        "  note: flight.toml: [[sensor]] ros-F, ros-N: image topics in 2 tables make separate strips; "
        "those of one camera belong in one table"
    ]


def test_cameras_with_strips_of_their_own_are_told(folder, capsys):
    table = '[[sensor]]\nkind = "lines"\nid = "cam-{0}"\nimages = {{{0} = "{0}.bil"}}\nsamples = 7\n{1}\n'
    rest = "first_time = 2026-11-22T10:10:00Z\nline_rate_hz = 100"
    for other, told in ((rest, 0), (f'{rest}\nstrip = "T1"', 1), (rest.replace("100", "50"), 1)):
        text = TOML.partition("[[sensor]]")[0] + table.format("F", rest) + table.format("N", other)
        (folder / "flight.toml").write_text(text)
        assert main(["check", str(folder)]) == 0
        assert capsys.readouterr().out.count("[[sensor]] cam-F, cam-N: strips or line rates of their own") == told


def test_what_is_published_before_a_live_flight(folder):
    flight = read_flight(folder)
    messages = live_configuration(flight, (48.0, 9.0), T, "flight")
    assert [(m.topic, m.stamp_ns, m.source) for m in messages] == [
        (f"configuration/{name}", T, "flight") for name in ("project", "camera", "strip")
    ]
    project, strip = messages[0].body, messages[2].body
    assert (project.origin_latitude, project.origin_longitude, project.origin_height) == (48.0, 9.0, 300.0)
    np.testing.assert_allclose(project.offset_sigma_m, [0.03, 0.03, 0.05])  # RTK
    assert (strip.id, strip.first_line_time_ns, strip.line_rate_hz, strip.ended) == ("S1", T, 100.0, False)


WRONG = {
    "kind": ('kind = "nmea"', 'kind = "nema"', "sensor[0].kind: 'nema', wanted one of nmea, lines, ros2, stream"),
    "no kind": ('kind = "nmea"\n', "", "sensor[0].kind: missing, wanted a text"),
    "key": ("clock_offset_s", "clock_ofset_s", "sensor[1].clock_ofset_s: not known, wanted id, kind"),
    "id": ('id = "camera"', 'id = "my camera"', "sensor[1].id: 'my camera', wanted a word of letters"),
    "id of a node": ('id = "camera"', 'id = "navigator"', "sensor[1].id: 'navigator', wanted another name, for a node"),
    "twice": ('id = "camera"', 'id = "nmea"', "sensor[1].id: 'nmea', wanted another name for each sensor"),
    "port": (
        "[nodes.matcher]",
        '[[sensor]]\nkind = "stream"\nid = "imu"\naddress = "listen://127.0.0.1:5555"\n[nodes.matcher]',
        "sensor[3].address: 'listen://127.0.0.1:5555', wanted another one for each sensor: one program reads a port",
    ),
    "CCD line": ("{N =", "{Q =", "sensor[2].images: CCD line 'Q', wanted F, N, B"),
    "band": ('"file:gnss.nmea"', '"gnss.nmea"', "sensor[0].address: 'gnss.nmea', wanted serial:PORT"),
    "time": ("09:30:00Z\nline_rate_hz = 100\n[[sensor]]", "\n[[sensor]]", "not valid TOML"),
    "rate": (
        "line_rate_hz = 100\n[[sensor]]",
        "[[sensor]]",
        "strips[0].line_rate_hz: missing, wanted a number above 0",
    ),
    "origin": ("ground_height_m", "origin_deg = [148, 9]\nground_height_m", "flight.origin_deg: [148, 9], wanted lat"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_said_in_one_line(folder, what, capsys):
    old, new, wanted = WRONG[what]
    assert TOML.count(old) >= 1
    (folder / "flight.toml").write_text(TOML.replace(old, new, 1))
    assert main(["fly", str(folder)]) == 1
    said = capsys.readouterr().err
    assert wanted in said and said.count("\n") == 1


def test_a_flight_is_not_written_over(folder, capsys):
    out = folder / "out"
    out.mkdir()
    (out / "flight.mcap").write_bytes(b"")
    assert main(["fly", str(folder), "-o", str(out)]) == 1
    assert "holds a flight already, wanted another folder" in capsys.readouterr().err
    assert main(["fly", str(folder / "nowhere")]) == 1
    assert "no flight.toml" in capsys.readouterr().err


def test_a_platform_that_flies_already_is_not_flown_again(folder, capsys, monkeypatch):
    monkeypatch.setattr(fly, "ENDED_S", 0.0)
    port = free_port()
    words = ["fly", str(folder), "-o", str(folder / "out"), "--no-viewer", "--port", str(port), "--seconds", "1"]
    with Bus("live1", source="adjuster", port=port) as bus:
        bus.announce("adjuster")
        assert main(words) == 1
    told = (
        f"platform 'live1' flies already: adjuster runs on port {port}, wanted them stopped, "
        "another flight.platform in flight.toml, or another --port"
    )
    assert capsys.readouterr().err == f"triline fly: {told}\n"


def test_nodes_of_others_on_the_port_and_those_that_end_hinder_no_flight(folder, monkeypatch):
    monkeypatch.setattr(fly, "MEET_S", 0.3)
    words = ["fly", str(folder), "-o", str(folder / "out"), "--no-viewer", "--port", str(port := free_port())]
    args = parse([*words, "--nodes", "navigator"])
    flight = fly.Fly(args, read_flight(folder, live=True), [])
    with Bus("live1", source="adjuster", port=port) as bus, Bus("live2", source="navigator", port=port) as other:
        bus.announce("adjuster")
        other.announce("navigator")
        assert flight.port() == port
        ending = Bus("live1", source="navigator", port=port)
        ending.announce("navigator")
        threading.Timer(0.5, ending.close).start()
        assert flight.port() == port


class Told:
    """What would stand on the screen of a flight."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.phase = ""

    def tell(self, text: str) -> None:
        self.lines.append(text)


def flown(folder, nodes=(), place=None):
    """A flight that has said what it consists of; what nodes have told of themselves, and where its first fix is."""
    args = parse(["fly", str(folder), "-o", str(folder / "out"), "--no-viewer"])
    flight = fly.Fly(args, read_flight(folder, live=True), [])
    flight.watch, flight._configured = Told(), True
    flight._overview = SimpleNamespace(nodes={status.node: status for status in nodes})
    flight.first.place = place
    flight.tend(None)
    flight.tend(None)
    return flight


def test_image_lines_that_no_node_can_use_are_told_in_flight_and_at_its_end(folder):
    """A camera.json of 200 px for lines of 180: all of them were refused, and a flight ended without a word of it."""
    why = "sensor/lines/N: lines of N of 180 samples, wanted 200"
    status = m.NodeStatus(node="matcher", last_problem="lines of N came 0.9 s behind")
    status.counters.add(name="cells without texture", value=3)
    status.counters.add(name="late", value=2, last_problem="lines of N came 0.9 s behind")
    status.counters.add(name="malformed", value=130, last_problem=why)
    flight = flown(folder, [status])
    assert flight.watch.lines == [f"matcher: malformed: {why}"]
    lost = flight._lost_so_far(("gaps", "malformed", "dropped"))
    assert lost == {"matcher: malformed": 130}
    assert flight._lost_so_far(("late",)) == {}


@pytest.mark.parametrize(("place", "told"), [((38.2, 53.6), True), ((47.91, 11.2), False), (None, False)])
def test_an_origin_far_from_the_flight_is_told_with_the_first_fix(folder, place, told):
    """Control in another CRS put the local frame in another country, and the flight began there without a word."""
    (folder / "flight.toml").write_text(TOML.replace("[flight]", "[flight]\norigin_deg = [47.9, 11.1]"))
    said = flown(folder, place=place).watch.lines
    assert len(said) == told
    if told:
        assert said[0] == (
            "the origin lies 3529 km from the first GNSS fix (38.2000, 53.6000 deg), wanted at most 50 km: "
            "see flight.origin_deg, and flight.crs (EPSG:32632)"
        )


@pytest.mark.parametrize(
    ("stated", "place", "noted", "refused"),
    [
        ("", (4_432_100.0, 5_306_200.0), "control.csv: lies at about ", None),  # Gauss-Krueger, zone 4
        ("", (890_000.0, 5_306_200.0), None, None),  # the next zone as well
        ("origin_deg = [47.9, 11.1]", (357_900.0, 5_307_200.0), None, "of flight.origin_deg, wanted coordinates in"),
        ("origin_deg = [47.9, 11.1]", (656_900.0, 5_307_200.0), None, None),
    ],
)
def test_control_that_is_not_where_its_crs_is_used_is_told(folder, stated, place, noted, refused):
    """A live flight was called complete, and began in another country."""
    control = "point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role\nP1,{},{},600,0.05,0.05,0.1,control\n"
    (folder / "control.csv").write_text(control.format(*place))
    toml = TOML.replace("[flight]", f"[flight]\n{stated}")
    (folder / "flight.toml").write_text(f'{toml}[control]\nfile = "control.csv"\n')
    flight = read_flight(folder, live=True)
    told = [note for note in flight.notes if "outside of the area of flight.crs (EPSG:32632: " in note]
    assert [note.startswith(noted) for note in told] == [True] * (noted is not None)
    assert [refused in problem for problem in flight.problems] == [True] * (refused is not None)


@pytest.mark.parametrize(("crs", "noted"), [("EPSG:32632", 0), ("EPSG:32732", 1), ("EPSG:32756", 1)])
def test_an_origin_that_is_not_where_the_crs_is_used_is_told(folder, crs, noted):
    """Without control a flight in another hemisphere than its CRS was complete without a word."""
    toml = TOML.replace("[flight]", "[flight]\norigin_deg = [47.9, 11.1]").replace("EPSG:32632", crs)
    (folder / "flight.toml").write_text(toml)
    told = [note for note in read_flight(folder, live=True).notes if "outside of the area of flight.crs" in note]
    assert len(told) == noted and all("flight.toml: the flight lies at about 47.9, 11.1 deg" in note for note in told)


@pytest.mark.parametrize(
    ("time", "noted"),
    [
        ("2026-11-22T09:30:00", True),
        ('"2026-11-22 09:30:00.5"', True),
        ("2026-11-22", True),
        ("2026-11-22T10:30:00+01:00", False),
        ('"2026-11-22T09:30:00Z"', False),
    ],
)
def test_a_time_without_a_zone_is_utc_with_a_note(folder, time, noted):
    """A crew that writes its local time was an hour off without a word."""
    (folder / "flight.toml").write_text(TOML.replace("2026-11-22T09:30:00Z", time, 1))
    flight = read_flight(folder, live=True)
    told = [note for note in flight.notes if "has no time zone, taken as UTC" in note]
    assert len(told) == noted and len(flight.announced) == 1 and not flight.problems


def test_folders_where_files_are_wanted_are_told_by_their_key(folder):
    (folder / "c").mkdir()
    toml = TOML.replace("camera.json", "c").replace("file:gnss.nmea", "file:c") + '[control]\nfile = "c"\n'
    (folder / "flight.toml").write_text(toml)
    flight = read_flight(folder, live=True)
    read_sensors(flight)
    assert [problem.partition(": ")[2] for problem in flight.problems] == [
        "camera.file: 'c' is a folder, wanted a file",
        "control.file: 'c' is a folder, wanted a file",
        "sensor[0].address: 'file:c', wanted a file, not a folder",
    ]


def connected(port: int) -> socket.socket:
    """A link to a program that is on the bus already and may not listen yet."""
    found: list[socket.socket] = []

    def tried() -> bool:
        try:
            found.append(socket.create_connection(("127.0.0.1", port)))
        except ConnectionRefusedError:
            return False
        return True

    wait_for(tried, 60, "the program to listen")
    return found[0]


def test_a_program_publishes_under_its_id_and_tells_what_it_refuses(tmp_path):
    port, device = free_port(), free_port()
    said, received, statuses = [], [], []
    table = {"id": "imu1", "address": f"listen://127.0.0.1:{device}", "imu_noise": [1e-5, 1e-3]}
    options = ProgramOptions("stream", "here", port, tables={"stream": table}, report=said.append)
    with Bus("here", source="test", port=port) as bus:
        bus.subscribe("sensor/imu", received.append)
        bus.subscribe("status/*", lambda raw: statuses.append(decode(raw.topic, raw.data)))
        thread = threading.Thread(target=run, args=(options,))
        thread.start()
        try:
            wait_for(lambda: "imu1" in bus.alive(), 60, "the program")
            wait_for(lambda: bus.peers(), 60, "the link")
            with connected(device) as driver:
                text = "".join(f"IMU {T + i} 10000000 0 0 -9.8 0 0 0\n" for i in range(5))
                driver.sendall(text.encode() + b"rubbish\nrubbish\n")
            wait_for(lambda: len(received) >= 5, 60, "the samples")
            wait_for(lambda: statuses and "2 refused" in statuses[-1].state, 60, "the status")
        finally:
            options.stop.set()
            thread.join(60)
    assert [(r.envelope.source, r.envelope.sequence, r.envelope.stamp_ns) for r in received] == [
        ("imu1", i, T + i) for i in range(5)
    ]
    body = decode("sensor/imu", received[0].data)
    np.testing.assert_allclose([body.rate_sigma, body.force_sigma], [1e-4, 1e-2])  # over 10 ms
    assert statuses[-1].state == "5 messages, 2 refused"
    assert [(c.name, c.value) for c in statuses[-1].counters] == [("not a record", 2)]
    assert len([line for line in said if "not a record: rubbish, wanted GNSS, IMU" in line]) == 1


def test_a_program_that_was_started_again_does_not_say_its_file_once_more(tmp_path):
    """All lines of the flight were recorded twice, and `process` lost half of the tie points."""
    port, said, received = free_port(), [], []
    (tmp_path / "n.raw").write_bytes(bytes(4000))
    table = {"id": "cam", "images": {"N": str(tmp_path / "n.raw")}, "samples": 10, "line_rate_hz": 100.0}
    table["first_time"] = "2026-11-22T09:27:50Z"
    options = ProgramOptions("lines", "here", port, tables={"lines": table}, report=said.append)
    begun_ns = 1_795_339_670 * 10**9
    with Bus("here", source="recorder", port=port) as bus:
        bus.answer("heard", lambda asked: m.Progress(time_ns=begun_ns + 10**9) if asked["source"] == "cam" else None)
        bus.announce("recorder")
        bus.subscribe("sensor/lines/*", received.append)
        bus.subscribe("configuration/strip", received.append)
        thread = threading.Thread(target=line_camera.run, args=(options,))
        thread.start()
        try:
            wait_for(lambda: len(received) >= 30, 60, "the lines")
        finally:
            options.stop.set()
            thread.join(60)
    stamps = [raw.envelope.stamp_ns for raw in received if raw.topic == "sensor/lines/N"]
    assert stamps == [begun_ns + i * 100_000_000 + 90_000_000 for i in range(10, 40)]
    assert [decode(raw.topic, raw.data).ended for raw in received if raw.topic == "configuration/strip"] == [True]
    assert "cam: said before: what was published up to 09:27:51 UTC is not said again" in said


def test_first_data():
    first = FirstData()
    first.take(RawMessage("sensor/imu", Envelope(T + 7, "imu", 0), encode(m.Imu(time_ns=T + 7, force_z=-9.8))))
    assert (first.newest_ns, first.place) == (T + 7, None)
    first.take(RawMessage("sensor/imu", Envelope(T + 9, "imu", 0), b"\xff"))  # not decodable
    for place in ((4807.4, 9.0, 500.0), (48.1, 9.0, float("nan"))):  # of somebody's own publisher
        fix = encode(gnss_message(T + 8, place, (1.0, 1.0, 2.0)))
        first.take(RawMessage("sensor/gnss", Envelope(T + 8, "gnss", 0), fix))
        assert (first.newest_ns, first.place) == (T + 7, None)
    fix = encode(gnss_message(T, (48.1234567, 9.0, 500.0), (1.0, 1.0, 2.0)))
    first.take(RawMessage("sensor/gnss", Envelope(T, "gnss", 0), fix))
    assert (first.newest_ns, first.place) == (T + 7, (48.123457, 9.0))


def test_one_stamp_far_ahead_does_not_put_the_configuration_off():
    """Configuration was stamped by it: no node had any until then, and the flight no result."""
    first, year = FirstData(), 365 * 86400 * 10**9
    attitude, inertial = encode(m.Attitude(time_ns=T)), encode(m.Imu(time_ns=T + year, force_z=-9.8))
    first.take(RawMessage("sensor/attitude", Envelope(T + year, "a", 0), attitude))
    first.take(RawMessage("sensor/attitude", Envelope(T + 7, "a", 1), attitude))
    assert first.newest_ns == T + 7
    fix = encode(gnss_message(T, (48.1, 9.0, 500.0), (1.0, 1.0, 2.0)))
    first.take(RawMessage("sensor/gnss", Envelope(T + 5, "b", 0), fix))
    first.take(RawMessage("sensor/imu", Envelope(T + year, "c", 0), inertial))  # a clock of its own
    assert first.newest_ns == T + 7


def test_clocks_that_are_apart_are_told():
    first = FirstData()
    fix = encode(gnss_message(T, (48.1, 9.0, 500.0), (1.0, 1.0, 2.0)))
    first.take(RawMessage("sensor/lines/N", Envelope(T - 18_000_000_000, "camera", 0), b"", T + 5))
    assert first.apart() == {} and not first.newest_ns
    first.take(RawMessage("sensor/gnss", Envelope(T, "gnss", 0), fix, T + 200_000_000))
    first.take(RawMessage("sensor/imu", Envelope(T, "imu", 0), b"", T + 900_000_000))
    (text,) = first.apart().values()
    assert text.startswith("sensor/lines/N is stamped -17.8 s against sensor/gnss that came at the same time")


def test_what_comes_in_and_what_is_missing():
    now = [0.0]
    watch = SensorWatch([("sensor/gnss",), ("sensor/imu", "sensor/attitude"), ("sensor/lines/N",)], lambda: now[0])

    def look(seconds: float, ending: bool = False, **received: int) -> list[str]:
        lines = []
        for _ in range(round(seconds * 2)):
            now[0] += 0.5
            for name in received:
                counted[name] = counted.get(name, 0) + received[name] // 2
            topics = [
                SimpleNamespace(
                    topic=f"sensor/{name.replace('_', '/')}", received=n, gaps=0, malformed=0,
                    rate_hz=received.get(name, 0),
                )
                for name, n in counted.items()
            ]  # fmt: skip
            status = SimpleNamespace(topics=topics, uptime_s=now[0] - begun[0])
            lines += watch.look({"recorder": status}, ending=ending)
            now[0] += 0.2  # it looks more often than a status comes
            lines += watch.look({"recorder": status}, ending=ending)
            now[0] -= 0.2
        return lines

    counted: dict[str, int] = {}
    begun = [0.0]
    assert look(1) == [] and watch.never == ["sensor/gnss", "sensor/imu or sensor/attitude", "sensor/lines/N"]
    assert look(6, gnss=4, attitude=100) == ["sensor/gnss comes in", "sensor/attitude comes in"]
    assert watch.line().startswith("sensor/gnss 4.0/s, sensor/attitude 100.0/s; sensor/lines/N never seen")
    (stopped,) = look(8, attitude=100)
    assert stopped.startswith("sensor/gnss stopped") and watch.never == ["sensor/lines/N"]
    assert look(2, gnss=4, attitude=100) == ["sensor/gnss comes in"]
    # a recorder that is started again counts from 0, and what nobody counted meanwhile has not stopped
    before = {row.name: row.received for row in watch.rows()}
    counted.clear()
    now[0] += 4.0
    assert watch.look({"recorder": watch._status}) == []
    begun[0] = now[0]
    assert look(1) == [] and look(2, gnss=4, attitude=100) == []
    after = {row.name: row.received for row in watch.rows()}
    assert after["sensor/gnss"] == before["sensor/gnss"] + 8 and watch.never == ["sensor/lines/N"]
    watch.tell("gnss has ended: no such port")
    assert look(0.5, gnss=4) == ["gnss has ended: no such port"]
    # what came just before the end is told, and not that all fall silent
    assert look(8, ending=True, lines_N=10)[:1] == ["sensor/lines/N comes in"]
    assert not any("stopped" in line for line in look(8, ending=True))


def test_rates_are_those_that_the_recorder_measures():
    """Counts that change every 0.53 s, looked at every 0.25 s, made between 89 and 106 Hz of 100."""
    now = [0.0]
    watch = SensorWatch([("sensor/attitude",)], lambda: now[0])
    told, status = [], SimpleNamespace(topics=[], uptime_s=0.0)
    for look in range(120):
        now[0] = 0.25 * look
        received = int(100 * 0.53 * (now[0] // 0.53))
        if not status.topics or status.topics[0].received != received:
            topic = SimpleNamespace(topic="sensor/attitude", received=received, gaps=0, malformed=0, rate_hz=100.0)
            status = SimpleNamespace(topics=[topic], uptime_s=now[0])
        watch.look({"recorder": status})
        told += [row.rate_hz for row in watch.rows() if now[0] > 6.0]
    assert min(told) == max(told) == 100.0
