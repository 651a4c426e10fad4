"""All aircraft on one screen and in one view."""

from __future__ import annotations

import io

import numpy as np
import sample_messages as sample
from rich.console import Console

from triline.nodes import convert
from triline.nodes.monitor.fleet import SILENT_S, FleetOverview, screen
from triline.nodes.monitor.monitor import SILENT, Monitor
from triline.nodes.node import Message
from triline.nodes.viewer.canvas import FleetLayout, NullCanvas
from triline.nodes.viewer.fleet_scene import FleetScene
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage

STOPPED = codec.encode(m.NodeStatus(node="matcher", state="stopping"))


def status(node: str, **fields) -> RawMessage:
    body = m.NodeStatus(node=node, state="running", **fields)
    return RawMessage(f"status/{node}", Envelope(1, node, 0, 1), codec.encode(body))


def shown(overview: FleetOverview) -> str:
    console = Console(file=io.StringIO(), width=110, record=True)
    console.print(screen(overview, "fleet"))
    return console.export_text()


def test_each_aircraft_has_a_row_and_one_that_is_silent_has_no_light():
    now = [100.0]
    overview = FleetOverview(lambda: now[0])
    overview.link("a1", "router", True)
    overview.link("a2", "router", True)
    overview.link("a2", "matcher", False)  # nodes come and go without the link
    overview.take("a1", status("adjuster", light="good", lag_s=0.4))
    overview.take("a2", status("adjuster", light="weak", light_reason="no control", alarm="no trajectory for 5 s"))
    report = m.AdjustmentReport(
        sigma0=1.02, redundancy=90, sigma=[0.02, 0.05, 0.04, 0, 0, 0], protection=[0.1, 0.2, 0.3]
    )
    overview.take("a1", RawMessage("adjustment/report", Envelope(1, "adjuster", 0, 1), codec.encode(report)))
    ground = m.NodeStatus(node="ground", state="2 aircraft, 7 messages to come")
    ground.counters.add(name="a2 missing", value=7)
    overview.take("fleet", RawMessage("status/ground", Envelope(1, "ground", 0, 1), codec.encode(ground)))
    overview.take("a3", RawMessage("status/x", Envelope(1, "x", 0, 1), b"\xff\xff"))  # rubbish is nobody
    one, two = overview.rows()
    assert (one["light"], one["sigma_m"], one["protection_m"], one["lag_s"], one["link"]) == (
        "good",
        0.05,
        0.3,
        0.4,
        "linked",
    )
    assert (two["light"], two["reason"], two["missing"], two["heard_s"]) == ("weak", "no control", 7, 0.0)
    text = shown(overview)
    assert "0.050 m" in text and "a2: no control" in text and "a2: no trajectory for 5 s" in text and "\n" in text
    now[0] += SILENT_S + 1.0
    overview.link("a1", "router", False)
    overview.take("a2", status("navigator"))
    one, two = overview.rows()
    assert (two["light"], two["reason"]) == ("unknown", "silent; last known: weak")  # whatever its navigator says
    overview.take("a2", status("adjuster", light="weak"))
    one, two = overview.rows()
    assert (one["light"], one["link"], one["heard_s"]) == ("unknown", "gone", SILENT_S + 1.0)
    assert "last known: good" in one["reason"] and two["light"] == "weak"
    assert "a1 unknown gone, heard 16 s ago" in overview.line() and "7 to come" in overview.line()


def test_of_a_fleet_too_a_node_that_has_died_is_told_and_one_that_was_stopped_is_not():
    overview = FleetOverview()
    overview.take("a1", status("recorder", lag_s=7.0, alarm="the disk is full"))
    overview.take("a1", RawMessage("status/matcher", Envelope(1, "matcher", 2, 1), STOPPED))
    for _ in range(SILENT // 4 - 1):  # every fourth status comes down
        overview.take("a1", status("navigator"))
    assert overview.rows()[0]["alarms"] == ["the disk is full"]
    overview.take("a1", status("navigator", lag_s=0.5))
    row = overview.rows()[0]
    assert row["alarms"] == ["recorder is silent: it stands still, has died, or is cut off"] and row["lag_s"] == 0.5
    assert "ALARM: recorder is silent" in overview.line() and "recorder is silent" in shown(overview)
    overview.take("a1", status("recorder"))
    assert overview.rows()[0]["alarms"] == []


def test_a_desk_that_looks_at_an_aircraft_is_not_the_aircraft():
    now = [100.0]
    overview = FleetOverview(lambda: now[0])
    overview.take("a1", status("adjuster", light="good"))
    now[0] += SILENT_S + 1.0
    for platform in ("a1", "demo"):
        overview.take(platform, status("monitor"))
    assert [(row["name"], row["heard_s"]) for row in overview.rows()] == [("a1", SILENT_S + 1.0)]
    scene = FleetScene(NullCanvas())
    for platform, node in (("a1", "adjuster"), ("demo", "monitor")):
        scene.take(platform, Message(f"status/{node}", 0, m.NodeStatus(node=node)), 0.0)
    assert list(scene._aircraft) == ["a1"]


def test_where_nothing_is_redundant_there_is_no_sigma0():
    overview = FleetOverview()
    for platform, redundancy in (("a1", 90), ("a2", 0)):
        report = m.AdjustmentReport(sigma0=1.02 if redundancy else 0.0, redundancy=redundancy)
        overview.take(platform, RawMessage("adjustment/report", Envelope(1, "adjuster", 0, 1), codec.encode(report)))
    assert [row["sigma0"] for row in overview.rows()] == [1.02, None]
    assert "1.02" in shown(overview) and "0.00" not in shown(overview)


def test_the_monitor_counts_rejected_observations_as_the_report_of_a_flight_does():
    monitor = Monitor()
    report = m.AdjustmentReport(rejected_total=46, returned_total=4)
    monitor.step(Message("adjustment/report", sample.EPOCH_NS, report))
    assert monitor.overview.rejected == 42 and "42 rejected" in monitor.overview.line()


def test_a_node_that_has_died_is_told_and_its_light_holds_no_longer():
    monitor = Monitor()

    def say(node: str, times: int = 1, **fields) -> None:
        for _ in range(times):
            body = m.NodeStatus(**{"node": node, "state": "running", **fields})
            monitor.step(Message(f"status/{node}", sample.EPOCH_NS, body))

    view = monitor.overview
    say("adjuster", light="good")
    say("viewer")
    say("matcher", state="stopping")
    say("navigator", 10)
    assert view.alarms() == [] and view.as_json()["nodes"]["adjuster"]["light"] == "good"
    say("navigator", SILENT - 10)
    assert view.alarms() == ["adjuster is silent: it stands still, has died, or is cut off"]
    told = view.as_json()["nodes"]["adjuster"]
    assert (told["state"], told["light"]) == ("silent, last known: running", "unknown")
    assert "ALARM: adjuster is silent" in view.line()
    say("adjuster", light="weak")  # it was started again
    assert view.alarms() == [] and view.as_json()["nodes"]["adjuster"]["light"] == "weak"
    say("navigator", SILENT)
    view.ending = True
    assert view.alarms() == []


class Canvas(NullCanvas):
    def __init__(self) -> None:
        self.drawn: dict[str, list] = {}
        self.layouts: list[FleetLayout] = []
        self.text = ""
        self.pictures: set[str] = set()

    def lines(self, entity, strips, colors, radius, labels=None) -> None:
        self.drawn[entity] = list(strips)

    def points(self, entity, xyz, colors, radius, labels=None) -> None:
        self.drawn[entity] = [np.asarray(xyz), labels]

    def layout(self, layout) -> None:
        self.layouts.append(layout)

    def picture(self, entity, corners, grey) -> None:
        self.pictures.add(entity)

    def clear(self, entity) -> None:
        self.pictures = {name for name in self.pictures if not name.startswith(f"{entity}/")}

    def document(self, entity, markdown) -> None:
        self.text = markdown


def pose(topic: str, second: int, place: tuple[float, float, float]) -> Message:
    body = sample.body(topic)
    time_ns = sample.EPOCH_NS + second * convert.SECOND_NS
    convert.set_time(body.timestamp, time_ns)
    body.pose.position.x, body.pose.position.y, body.pose.position.z = place
    return Message(topic, time_ns, body, "adjuster")


def test_aircraft_of_two_projects_are_drawn_in_one_frame_and_a_gap_is_filled_later():
    canvas = Canvas()
    scene = FleetScene(canvas)
    first = m.Project(name="one", crs="local", origin_latitude=48.0, origin_longitude=9.0, origin_height=300.0)
    frame = convert.local_frame(first)
    north, east, up = map(float, frame.to_geodetic(np.array([0.0, 5000.0, 0.0])))
    other = m.Project(name="two", crs="local", origin_latitude=north, origin_longitude=east, origin_height=up)
    scene.take("a1", Message("configuration/project", 0, first), 0.0)
    for second in (0, 1, 2, 20, 21):
        scene.take("a1", pose("orientation/final", second, (100.0 * second, 0.0, 1000.0)), 1.0)
    scene.take("a2", pose("orientation/final", 0, (0.0, 0.0, 1000.0)), 1.0)  # before its project
    scene.take("a2", Message("configuration/project", 0, other), 1.0)
    scene.take("a2", pose("orientation/final", 1, (0.0, 0.0, 1000.0)), 1.0)
    scene.take(
        "a1", Message("status/adjuster", 0, m.NodeStatus(node="adjuster", light="weak", light_reason="a|b")), 1.0
    )
    scene.link("a2", "router", False)
    scene.draw(2.0)
    assert [len(piece) for piece in canvas.drawn["flight/a1/final"]] == [3, 2]  # nothing across the gap
    a1, a2 = canvas.drawn["flight/a1/head"][0][0], canvas.drawn["flight/a2/head"][0][0]
    assert abs(a2[1] - a1[1] - 5000.0) < 5.0 and canvas.drawn["flight/a2/head"][1] == ["a2: no link"]
    assert canvas.layouts[-1].aircraft == ("a1", "a2") and "| a1 | weak | a/b |" in canvas.text
    for second in range(3, 20):
        scene.take("a1", pose("orientation/final", second, (100.0 * second, 0.0, 1000.0)), 3.0)
    scene.draw(3.0)
    assert [len(piece) for piece in canvas.drawn["flight/a1/final"]] == [22]


def test_tiles_of_another_ccd_line_take_the_place_of_all_before_of_the_same_aircraft():
    """Tiles of the lens that looks forward stayed under those of the one that looks down."""
    canvas = Canvas()
    scene = FleetScene(canvas)
    project = m.Project(name="one", crs="local", origin_latitude=48.0, origin_longitude=9.0, origin_height=300.0)
    for name in ("a1", "a2"):
        scene.take(name, Message("configuration/project", 0, project), 0.0)

    def tile(name, version, ccd, column, stamp_ns):
        grey = bytes([100]) * 16
        body = m.GroundTile(column=column, size=4, gsd_m=1.0, x=4.0 * column, encoding="mono8", data=grey, ccd=ccd)
        scene.take(name, Message(f"orthoimage/{version}", stamp_ns, body), 0.0)

    for name, column in (("a1", 0), ("a1", 1), ("a2", 0)):
        tile(name, "live", "F", column, 5)
    scene.draw(1.0)
    tile("a1", "live", "F", 2, 9)  # not drawn before the next one comes
    tile("a1", "live", "N", 3, 10)
    tile("a1", "final", "F", 4, 9)  # late over the link
    scene.draw(2.0)
    tile("a1", "final", "N", 5, 12)
    scene.draw(3.0)
    assert canvas.pictures == {"mosaic/a2/0_0", "mosaic/a1/0_3", "mosaic/a1/0_5"}
