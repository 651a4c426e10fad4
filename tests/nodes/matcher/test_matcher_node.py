"""The matcher among real nodes: bad imagery, several strips, a window that asks for more or less."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from recording_file import write_recording

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.convert import R_bc_of, local_frame, mounting_of, pose_sample
from triline.nodes.matcher.matcher import Matcher
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.solver.camera.line_camera import quarter_turn
from triline.solver.geometry.rotation import R_BC_NOMINAL
from triline.solver.matching.options import MatchingOptions
from triline.solver.matching.places import Density

EPOCH_NS = 1_780_000_000_000_000_000
SETTINGS = {
    "sensor": "ads40-small",
    "pixels": 500,
    "images": True,
    "height": 600.0,
    "speed": 120.0,
    "seconds": 12.0,
    "lead_in": 2.0,
    "check": 10,
    "attitude_rate": 50.0,
    "seed": 6,
}


@pytest.fixture(scope="module")
def messages():
    flight = simulated_flight(SETTINGS)
    return list(Simulator(flight.simulation, flight.imager).messages(EPOCH_NS))


@pytest.fixture(scope="module")
def short():
    flight = simulated_flight({**SETTINGS, "seconds": 8.0, "lead_out": 2.0, "check": 2})
    return list(Simulator(flight.simulation, flight.imager).messages(EPOCH_NS))


def run(tmp_path, messages, points_per_s=4.0, **settings):
    """Process messages with navigator, matcher and adjuster; returns summary, ties and what was told."""
    flight, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    write_recording(flight, messages)
    with RecordingWriter(out) as writer:
        nodes = [Navigator(), Matcher(points_per_s=points_per_s, **settings), Adjuster(update_s=1.0, update_rays=100)]
        summary = process(RecordingReader(flight), nodes, writer.write_raw)
    reader = RecordingReader(out)
    ties = [m.body for m in reader.messages(["observation/tie"]) if "-M" in m.body.point]
    told = [m.body.message for m in reader.messages(["event/log"]) if m.body.name == "matcher"]
    return summary, ties, told


def spoilt(messages, change):
    """Messages whose line blocks went through ``change(ccd, first line, pixels)``; None is a lost block."""
    for message in messages:
        if not message.topic.startswith("sensor/lines/"):
            yield message
            continue
        b = message.body
        pixels = change(b.ccd, int(b.first_line), b.pixels.copy())
        if pixels is not None:
            block = LineBlock(pixels, b.ccd, b.strip, b.first_line, b.time_ns, b.line_period_ns)
            yield replace(message, body=block)


def lines_between(first, end, value):
    """A change that sets lines of all CCD lines; ``value`` is a grey value or a function of the pixels."""

    def change(ccd, line, pixels):
        number = line + np.arange(len(pixels))
        bad = (number >= first) & (number < end)
        pixels[bad] = value(pixels[bad]) if callable(value) else value
        return pixels

    return change


def water(pixels):
    return np.random.default_rng(1).normal(300, 4, pixels.shape).astype(pixels.dtype)


FROZEN = {}


def frozen_backward(ccd, line, pixels):
    """From line 200 to 300 the backward line repeats what it saw last."""
    if ccd != "B" or not 200 <= line < 300:
        FROZEN[ccd] = pixels[-1]
        return pixels
    pixels[:] = FROZEN[ccd]
    return pixels


def chain(*changes):
    def change(ccd, line, pixels):
        for one in changes:
            pixels = one(ccd, line, pixels)
            if pixels is None:
                return None
        return pixels

    return change


def lost_block(ccd, line, pixels):
    return None if ccd == "N" and 100 <= line < 120 else pixels


def short_lines(ccd, line, pixels):
    return pixels[:, :100] if 60 <= line < 70 and ccd == "F" else pixels


def backward_dies(ccd, line, pixels):
    return None if ccd == "B" and line >= 150 else pixels


def nadir_dies(ccd, line, pixels):
    return None if ccd == "N" and line >= 150 else pixels


FAULTS = {
    "faults of the camera": (
        chain(lost_block, short_lines, lines_between(150, 155, 0), frozen_backward, lines_between(330, 350, 4095)),
        {"lines missing": 4, "malformed": 1, "lines dark": 15, "lines frozen": 90, "lines saturated": 60},
        ("N: 20 lines are missing", "N: lines are black", "B: lines are frozen", "N: lines are saturated"),
    ),
    "a CCD line falls silent": (
        backward_dies,
        {"ties": 30},  # of a flight of 8 s
        ("B: nothing has come after line 151",),
    ),
    "the nadir line dies": (
        nadir_dies,
        {"ties": 60},
        ("N: nothing has come after line 151", "N sees nothing: tie points begin in B"),
    ),
    "lens cap, then water": (
        chain(lines_between(40, 100, 0), lines_between(235, 400, water)),
        {"lines dark": 180, "cells without texture": 30},
        ("N: lines are black (lens cap", "N: lines are good again", "poor in texture", "has texture again"),
    ),
}


@pytest.mark.parametrize(
    ("fault", "flight"),
    [
        ("a CCD line falls silent", "short"),
        *(pytest.param(f, "messages", marks=pytest.mark.study) for f in list(FAULTS) if "silent" not in f),
    ],
)
def test_bad_imagery_is_told_in_a_line_and_counted_and_the_adjustment_goes_on(tmp_path, request, fault, flight):
    change, counters, words = FAULTS[fault]
    summary, ties, told = run(tmp_path, spoilt(request.getfixturevalue(flight), change))
    counted = summary.counters["matcher"]
    for name, least in counters.items():
        assert counted.get(name, 0) >= least, name
    assert not counted.get("failed") and not summary.counters["adjuster"].get("failed")
    for text in words:
        assert sum(text in line for line in told) in range(1, 4), (text, told)
    assert all("\n" not in text for text in told)
    assert sum(": target " not in text for text in told) < 20 and not any("no lines" in text for text in told)
    assert len(ties) > 10 and counted["ties"] == len(ties)
    assert summary.outputs["orientation/final"] > (120 if flight == "short" else 180)


@pytest.mark.study
def test_points_keep_their_names_from_strip_to_strip(tmp_path):
    settings = {**SETTINGS, "seconds": 15.0, "height": 450.0, "strips": 1, "cross": 1, "no_turns": True}
    flight = simulated_flight(settings)
    messages = list(Simulator(flight.simulation, flight.imager).messages(EPOCH_NS))
    summary, ties, _ = run(tmp_path, messages)
    strips = {}
    for tie in ties:
        strips.setdefault(tie.point, set()).update(image.strip for image in tie.images)
    again = [point for point, seen in strips.items() if len(seen) == 2]
    assert len(again) >= 10
    assert all(point.startswith("S1-M") for point in again)
    counted = summary.counters["matcher"]
    assert counted["ties with earlier strips"] == len(again)
    assert counted["earlier points not found"] < 0.3 * counted["earlier points tried"]
    # the window takes them for what they are
    rejected = summary.counters["adjuster"].get("rejected", 0)
    assert rejected < 0.03 * sum(len(tie.images) for tie in ties)


def test_where_many_points_are_wanted_an_empty_window_asks_for_no_more():
    density = Density(MatchingOptions(points_per_s=45.0, window_points=60))
    density.window_holds(points=0, rays=0)
    assert density.cells(10.0)[0] == pytest.approx(900, abs=2)


def test_density_follows_the_window_and_the_success_of_its_places():
    density = Density(MatchingOptions(points_per_s=8.0, window_points=60, window_rays=600))
    first, borders = density.cells(10.0)
    assert first == pytest.approx(160, abs=2) and np.ptp(np.diff(borders)) < 1e-9
    density.window_holds(points=10, rays=30)
    assert density.cells(10.0)[0] == pytest.approx(320, abs=4)
    density.window_holds(points=20, rays=60)  # 16 more come within two seconds
    assert density.cells(10.0)[0] == pytest.approx(160 * 60 / 36, abs=4)
    density.window_holds(points=400, rays=1200)
    assert density.cells(10.0)[0] == pytest.approx(80, abs=2)
    density.window_holds(points=100, rays=300)
    across = np.linspace(-0.99, 0.99, 800)
    for _ in range(5):  # the left half fails more often
        density.judged(across, (np.arange(800) % 2 == 0) | (across > 0))
    n, borders = density.cells(0.1)
    left = int(np.searchsorted(borders, 0.5))
    assert left == pytest.approx(2 / 3 * n, abs=2)


def test_what_the_adjuster_answers_is_no_progress():
    """The adjuster is driven by the matcher's progress: if its reports were progress again, neither would ever end."""
    matcher = Matcher()
    lines = LineBlock(np.zeros((2, 10), np.uint16), "N", "S1", 0, EPOCH_NS)
    bodies = {
        "trajectory/filtered": m.PoseInFrame(), "sensor/lines/N": lines,
        "adjustment/report": m.AdjustmentReport(points=50, rays=150), "orientation/live": m.PoseInFrame(),
    }  # fmt: skip
    told = [
        topic
        for i, (topic, body) in enumerate(bodies.items())
        for x in matcher.step(Message(topic, EPOCH_NS + i * 10**9, body))
        if x.topic == "observation/progress"
    ]
    assert told == ["trajectory/filtered", "sensor/lines/N"]


def whole_orientation(out):
    """Perspective centres of the last answers."""
    poses = [pose_sample(x.body) for x in RecordingReader(out).messages(["orientation/whole"])]
    return np.array([pose.position_l for pose in poses])


@pytest.fixture(scope="module")
def alone(tmp_path_factory, short):
    """Ties of the flight as it is, and its whole orientation."""
    folder = tmp_path_factory.mktemp("alone")
    summary, ties, _ = run(folder, short)
    assert not summary.counters["matcher"].get("malformed") and not summary.counters["adjuster"].get("malformed")
    return ties, whole_orientation(folder / "out.mcap")


# ---- two strips at once


def test_lines_of_a_second_camera_leave_the_strip_that_began_first_as_it_is(tmp_path, short, alone):
    """With each block of another strip matching began anew: no tie point, no target, and nothing said so."""

    def second():
        """Another camera's strip, by every second block of the nadir line."""
        for strip in (x for x in short if x.topic == "configuration/strip"):
            body = m.Strip()
            body.CopyFrom(strip.body)
            body.id = "T1"
            yield replace(strip, body=body)
        blocks = [x for x in short if x.topic == "sensor/lines/N"]
        for x in blocks[1::2]:
            yield replace(x, body=replace(x.body, strip="T1"))

    numbers = Counter()
    both = sorted([*short, *second()], key=lambda x: x.stamp_ns)
    for k, x in enumerate(both):
        both[k] = replace(x, sequence=numbers[x.topic])
        numbers[x.topic] += 1
    summary, ties, told = run(tmp_path, both)
    assert len(ties) > 0.8 * len(alone[0]) > 20
    assert {image.strip for tie in ties for image in tie.images} == {"S1"}
    (said,) = [text for text in told if "beside" in text]
    assert said.startswith("T1: its lines come beside those of S1: they are left out")
    assert summary.counters["matcher"]["lines beside another strip"] > 200
    assert summary.counters["matcher"]["target measured"] > 5


# ---- ground far from the origin's height


def raised(messages, by_m, control=True):
    """The same flight, with the origin of the local frame so much lower: all that is local is so much higher."""
    for message in messages:
        if message.topic == "observation/control" and not control:
            continue
        if message.topic in ("configuration/project", "observation/control"):
            body = type(message.body)()
            body.CopyFrom(message.body)
            if message.topic == "observation/control":
                body.z += by_m
            else:
                body.origin_height -= by_m
            message = replace(message, body=body)
        yield message


@pytest.mark.parametrize(
    ("by_m", "control"),
    [
        (300.0, False),
        *(pytest.param(z, False, marks=pytest.mark.study) for z in (1000.0, 2500.0)),
        *(pytest.param(z, True, marks=pytest.mark.study) for z in (300.0, 1000.0, 2500.0)),
    ],
)
def test_ties_do_not_hang_on_the_height_of_the_origin(tmp_path, short, by_m, control):
    (tmp_path / "as it is").mkdir()
    _, ties, _ = run(tmp_path / "as it is", list(raised(short, 0.0, control)))
    _, as_many, told = run(tmp_path, list(raised(short, by_m, control)))
    assert len(ties) > 20 and abs(len(as_many) - len(ties)) <= 0.05 * len(ties)
    assert not [text for text in told if "ground_m" in text]
    assert control != any("the ground was found at about" in text for text in told)


@pytest.mark.parametrize("ground_m", [None, pytest.param(-0.3, marks=pytest.mark.study)])
def test_where_nothing_matches_a_line_says_what_to_give(tmp_path, short, ground_m):
    def other(ccd, line, pixels):
        return pixels if ccd == "N" else pixels[:, ::-1].copy()

    _, ties, told = run(tmp_path, spoilt(raised(short, 300.0, control=False), other), ground_m=ground_m)
    (line,) = [text for text in told if "ground_m" in text]
    assert not ties and "no tie point at" in line
    assert ("the ground is taken to be at 0 m" if ground_m is not None else "looked for at all heights") in line


def test_a_ground_that_is_no_height_is_refused():
    with pytest.raises(ValueError, match="ground_m: wanted a height"):
        Matcher(ground_m=float("nan"))


def test_control_that_does_not_count_tells_no_height_of_the_ground(short):
    """What an operator refused, and what is in a local frame that was given up."""

    def ground_m(*more):
        matcher = Matcher()
        begin = [x for x in short if x.topic.startswith("configuration/") and "strip" not in x.topic]
        for x in [*begin, *(Message("observation/control", EPOCH_NS, body) for body in points), *more]:
            list(matcher.step(x))
        assert matcher._matcher is not None
        return matcher._matcher.ground_m

    high = [m.GroundPoint(point=f"H{k}", z=900.0, covariance=[1.0] * 9) for k in range(3)]
    points = [*high, m.GroundPoint(point="G", z=100.0, covariance=[1.0] * 9)]
    assert ground_m() == 900.0
    refused = [Message("observation/verdict", EPOCH_NS, m.Verdict(point=p.point, by="Ann")) for p in high]
    assert ground_m(*refused) == 100.0
    again = [Message("observation/verdict", EPOCH_NS, m.Verdict(point=p.point, accepted=True)) for p in high]
    assert ground_m(*refused, *again) == 900.0
    project = next(x for x in short if x.topic == "configuration/project")
    body = type(project.body).FromString(project.body.SerializeToString())
    body.origin_latitude += 0.1
    stated = Message("observation/control", EPOCH_NS, points[-1])
    assert ground_m(replace(project, body=body), stated) == 100.0


# ---- what changes in mid-flight


@pytest.fixture(scope="module")
def low():
    """Flown so low and fast that all looks at a point are there after 3.5 s."""
    flight = simulated_flight({**SETTINGS, "height": 300.0, "seconds": 11.0})
    return list(Simulator(flight.simulation, flight.imager).messages(EPOCH_NS))


def _let_in(messages, topic, seconds, change):
    """Another project or camera, so long after the first line, and an operator's word on it."""
    was = next(x for x in messages if x.topic == topic)
    first = next(x for x in messages if x.topic == "configuration/strip").body.first_line_time_ns
    body = type(was.body).FromString(was.body.SerializeToString())
    change(body)
    stamp = first + round(seconds * 1e9)
    said = m.Verdict(topic=topic, accepted=True, by="Ann")
    other = replace(was, body=body, stamp_ns=stamp, sequence=100)
    return [other, Message("observation/verdict", stamp + 1, said, "confirm")]


def test_a_matcher_that_begins_in_mid_strip_gives_no_name_a_second_time(tmp_path, low):
    """With another camera it begins again; its points are others than those of before."""

    def renamed(camera):
        camera.name += " calibrated"

    more = _let_in(low, "configuration/camera", 5.5, renamed)
    summary, ties, told = run(tmp_path, sorted([*low, *more], key=lambda x: x.stamp_ns))
    assert "configuration changed: matching starts again" in told
    # lines that come before poses are counted as such, and no CCD line is silent for not having been heard before
    counters = summary.counters["matcher"]
    assert counters["lines before poses"] > 0 and not counters.get("malformed") and "nothing has come" not in str(told)
    names = [tie.point for tie in ties]
    assert len(set(names)) == len(names)
    late = [name for name in names if not name.startswith("S1-M")]
    assert 10 < len(late) < len(names) - 10 and all(name.startswith("S1-L8") for name in late), late


def test_in_another_local_frame_matching_begins_again(tmp_path, low):
    """Poses and targets of before are 200 m from where they are in it; control that is stated in it counts, other
    targets are looked for no more. The navigator begins again, too, and its first poses do not know how it flies: lines
    were wanted for a platform that stands still ("a budget of .. is too small: 390791756355 are wanted")."""

    def moved(project):
        project.origin_longitude += 0.0027

    more = _let_in(low, "configuration/project", 5.5, moved)
    before, after = (local_frame(x.body) for x in (low[0], more[0]))
    assert low[0].topic == "configuration/project"
    points = [x for x in low if x.topic == "observation/control"]
    for k, x in enumerate(points[::2]):
        body = type(x.body).FromString(x.body.SerializeToString())
        body.x, body.y, body.z = after.from_geodetic(*before.to_geodetic([body.x, body.y, body.z]))
        more.append(replace(x, body=body, stamp_ns=more[0].stamp_ns + 2, sequence=1000 + k))
    summary, ties, told = run(tmp_path, sorted([*low, *more], key=lambda x: x.stamp_ns))
    counted = summary.counters["matcher"]
    begun = told.index("configuration changed: matching starts again")
    assert sum("S1: 10 poses are left out: the navigator did not know" in text for text in told[begun:]) == 1
    assert not [text for text in told[begun:] if "S1: target" in text], told
    assert counted["poses without motion"] == 10 and not counted.get("malformed")
    assert sum(not tie.point.startswith("S1-M") for tie in ties) > 10 and counted["target measured"] > 20
    looks = [x for x in RecordingReader(tmp_path / "out.mcap").messages(["observation/target"])]
    seen = {x.body.point for x in looks if x.stamp_ns > more[0].stamp_ns + 10**9}
    assert len(seen) > 2 and seen <= {x.body.point for x in points[::2]}, seen


def _mounted(messages, boresight_deg):
    """The same flight with a camera whose image axes are mounted with a boresight: it sees what it saw."""
    for x in messages:
        if x.topic not in ("configuration/project", "configuration/camera"):
            yield x
            continue
        body = type(x.body).FromString(x.body.SerializeToString())
        if x.topic == "configuration/project":
            body.boresight_deg[:] = boresight_deg
        else:
            R_bc = R_bc_of(m.Project(boresight_deg=boresight_deg))
            c = body.lenses[0].focal_length_mm
            for line in body.lines:
                v = np.stack([line.x_mm, line.y_mm, np.full(len(line.x_mm), -c)], axis=1) @ R_BC_NOMINAL.T @ R_bc
                line.x_mm[:], line.y_mm[:] = (-c * v[:, :2] / v[:, 2:]).T.tolist()
        yield replace(x, body=body)


@pytest.mark.parametrize(
    ("heading_deg", "turns"), [(0.0, 0), (44.0, 0), (-46.0, 1), (-90.0, 1), (180.0, 2), (90.0, 3), (134.0, 3)]
)
def test_a_mounting_is_quarters_of_a_turn_and_what_is_left(heading_deg, turns):
    project = m.Project(boresight_deg=(4.0, -3.0, heading_deg))
    found, R_fi = mounting_of(project)
    R_fc = R_BC_NOMINAL.T @ R_bc_of(project)
    ray = np.array([3.0, 1.0, -60.0])  # in image axes
    x, y = quarter_turn(found)[:2, :2] @ ray[:2]
    assert found == turns
    assert R_fi @ (x, y, ray[2]) == pytest.approx(R_fc @ ray)
    assert R_fi[0, 0] > 0.65  # x goes along the flight


def test_a_camera_may_be_mounted_turned_and_oblique(tmp_path, short, alone):
    """The whole orientation is that of the same flight with a camera that is mounted straight."""
    summary, ties, _ = run(tmp_path, _mounted(short, (5.0, 25.0, 90.0)))
    assert not summary.counters["matcher"].get("malformed") and not summary.counters["adjuster"].get("malformed")
    straight, expected = alone
    found = whole_orientation(tmp_path / "out.mcap")
    assert len(ties) > 0.85 * len(straight) > 25
    assert len(found) == len(expected) and np.abs(found - expected).max() < 0.3
