"""Tie points between strips of different lenses, or of overpasses: against the truth, the batch, and bad input."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from functools import cache
from heapq import merge
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from recording_file import write_recording
from scipy.spatial.transform import Rotation

from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.batch.simulated_scenes import SceneSimulation, simulated_recording, write_with_sensors
from triline.nodes.cli import main
from triline.nodes.convert import pose_message, pose_sample
from triline.nodes.formats.block_recording import block_from_messages
from triline.nodes.formats.scene_block import read_scene_block
from triline.nodes.formats.scene_recording import local_block
from triline.nodes.matcher.matcher import Matcher
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.report.accuracy_table import accuracy_lines
from triline.nodes.report.evaluation import evaluate
from triline.schemas.topics import rank
from triline.solver.adjustment.adjustment import adjust
from triline.solver.adjustment.block_data import network_from_block
from triline.solver.camera.line_camera import LineCamera
from triline.solver.camera.sensors import preset
from triline.solver.geometry.rotation import angles_from_matrix
from triline.solver.matching.line_times import LineTimes
from triline.solver.matching.options import MatchingOptions, Place
from triline.solver.matching.pair_prediction import PairPrediction
from triline.solver.matching.round_earth import RoundHeights
from triline.solver.matching.strip_matcher import StripMatcher
from triline.solver.matching.strip_pair import Master, StripPair
from triline.solver.models.dgr import DgrOptions

#: EROS-A1 has one lens, which turns while it images: two overpasses.
SATELLITES = ("spot5-hrs-small", "alos-prism-small", "aster-vnir-small", "eros-a1-small")


def order(message):
    return message.stamp_ns, rank(message.topic)


def through(node, messages):
    """What a node says to the messages that it takes."""
    topics = tuple(topic.removesuffix("*") for topic in node.inputs)
    found = [out for message in messages if message.topic.startswith(topics) for out in node.step(message)]
    return [*found, *node.finish()]


@cache
def recorded(satellite, seed):
    """Messages of a simulated recording with image lines, the true sensor of each strip, and the local frame."""
    what = SceneSimulation(satellite, images=True, seed=seed, overpasses=2 if satellite == "eros-a1-small" else 1)
    messages, _ = simulated_recording(what)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch) / "scene"
        _, sensors = write_with_sensors(folder, what)
        block = local_block(read_scene_block(folder))
    return messages, dict(zip((strip.id for strip in block.strips), sensors, strict=True)), block.frame


@cache
def matched(satellite, seed=2, **options):
    """Messages of the recording, those of the matcher's ties, the matcher, true places of its points, and by how much
    looks miss them."""
    messages, sensor, frame = recorded(satellite, seed)
    node = Matcher(**options)
    ties = [out for out in through(node, messages) if out.topic == "observation/tie"]
    firsts = {tie.body.point: tie.body.images[0] for tie in reversed(ties)}
    truth, missed = {}, []
    for strip in sensor:
        own = {point: (image.line, image.sample) for point, image in firsts.items() if image.strip == strip}
        ground = sensor[strip].ground(*np.reshape([*own.values()], (-1, 2)).T, frame.height_m)
        truth |= dict(zip(own, ground, strict=True))
    for strip in sensor:
        looks = [(tie.body.point, image) for tie in ties for image in tie.body.images if image.strip == strip]
        pixels = np.array([(image.line, image.sample) for _, image in looks])
        missed.append(pixels - sensor[strip].ground_to_pixel(np.array([truth[point] for point, _ in looks])))
    local = {id: frame.R_el.T @ (ground - frame.origin_e) for id, ground in truth.items()}
    return messages, ties, node, local, np.concatenate(missed)


def on_line(messages, ties):
    """Points of the adjuster, name -> (xyz, covariance), and all that it was given."""
    given = list(merge(messages, sorted(ties, key=order), key=order))
    points = {}
    for out in through(Adjuster(model="dgr", self_calibration="none"), given):
        if out.topic == "point/object":
            body = out.body
            points[body.point] = np.array([body.x, body.y, body.z]), np.reshape(body.covariance, (3, 3))
    return points, given


def nees_of(points, truth):
    """Mean squared error by the covariance, a coordinate."""
    return np.mean([(e := points[id][0] - xyz) @ np.linalg.solve(points[id][1], e) / 3 for id, xyz in truth.items()])


@pytest.mark.parametrize(
    "satellite",
    # two lenses of one overpass as those of SPOT
    [pytest.param(name, marks=pytest.mark.study) if name == "aster-vnir-small" else name for name in SATELLITES],
)
def test_ties_between_strips_of_lenses(satellite):
    """Each lens is a strip of its own, minutes apart: ties of all lenses, as exact as the images, adjusted on line."""
    messages, ties, node, truth, missed = matched(satellite)
    assert len(truth) > 60 and not node.counters["contradiction"] > 0.1 * len(truth)
    assert (np.median(np.abs(missed), axis=0) < 0.03).all()
    assert (np.abs(missed).max(axis=1) < 0.2).mean() > 0.97
    strips = {image.strip for tie in ties for image in tie.body.images}
    assert strips == {m.body.id for m in messages if m.topic == "configuration/strip"}
    points, given = on_line(messages, ties)
    both = {id: xyz for id, xyz in truth.items() if id in points}
    looks = Counter(tie.body.point for tie in ties for _ in tie.body.images)
    assert len(both) > 0.95 * sum(n > 1 for n in looks.values()) > 60  # a point that one overpass has seen is none
    assert 0.1 < nees_of(points, both) < 3.0  # a few values of the datum in all of them: exact over seeds, below
    block = block_from_messages(given, "recording")
    network = network_from_block(block)
    solution = adjust(network, DgrOptions.from_settings(block.apriori.trajectory))
    batch = dict(zip(network.point_ids, solution.state.points_l, strict=True))
    off = np.array([np.abs(xyz - batch[id]) / np.sqrt(np.diag(C)) for id, (xyz, C) in points.items()])
    assert off.mean() < 0.03 and off.max() < 0.15


@pytest.mark.study
def test_errors_are_as_large_as_their_sigmas():
    found = []
    for satellite in SATELLITES:
        for seed in range(10):
            messages, ties, _, truth, _ = matched(satellite, seed)
            points, _ = on_line(messages, ties)
            found.append(nees_of(points, {id: xyz for id, xyz in truth.items() if id in points}))
    assert 0.6 < np.mean(found) < 1.6


def test_later_looks_have_the_name_of_their_point():
    """PRISM: the second strip's lens looks down, so that places are chosen in it; the third one's looks come alone."""
    _, ties, node, _, _ = matched("alos-prism-small")
    first = [tie for tie in ties if len(tie.body.images) == 2]
    later = [tie for tie in ties if len(tie.body.images) == 1]
    assert {tie.body.images[0].ccd for tie in first} == {"N"}
    assert np.mean([tie.body.images[1].ccd == "F" for tie in first]) > 0.9  # others only the third strip sees
    assert {image.ccd for tie in later for image in tie.body.images} == {"B"}
    names = {tie.body.point for tie in first}
    assert len(names) == len(first) and {tie.body.point for tie in later} <= names
    assert len(later) > 0.8 * len(first) and node.counters["later looks"] == len(later)
    # ties are known when the strip that completes them is over
    assert len({tie.stamp_ns for tie in later}) == 1 and min(tie.stamp_ns for tie in first) < later[0].stamp_ns


def test_ground_that_is_not_where_it_is_said_to_be():
    """It is looked for at other heights: 12 km are 46 pixels of parallax, and the first search reaches 40."""
    _, _, _, truth, missed = matched("alos-prism-small", ground_m=12_000.0)
    assert len(truth) > 60
    assert (np.median(np.abs(missed), axis=0) < 0.03).all()


def test_attitudes_that_are_further_off_than_a_search_reaches():
    """The second lens is turned by 1.3 deg about the track: 15 km, 130 pixels across; the covariance says so."""
    messages, _, _ = recorded("alos-prism-small", 2)
    turn, C = Rotation.from_rotvec([np.radians(1.3), 0.0, 0.0]), np.diag([5.0] * 3 + [np.radians(0.6)] * 3) ** 2
    node, out, begun = Matcher(), [], ""
    for message in messages:
        if message.topic == "trajectory/smoothed":
            sample = pose_sample(message.body)
            R = Rotation.from_quat(sample.quaternion) * (turn if begun == "scene/B" else Rotation.identity())
            position, angles, q = sample.position_l, angles_from_matrix(R.as_matrix()), R.as_quat()
            message = replace(message, body=pose_message(message.stamp_ns, position, angles, C, quaternion=q))
        elif message.topic == "configuration/strip":
            begun = message.body.id
        if message.topic.startswith(tuple(topic.removesuffix("*") for topic in node.inputs)):
            out += node.step(message)
    later = [tie.body for tie in out if tie.topic == "observation/tie" and tie.body.images[-1].strip == "scene/B"]
    assert len(later) > 20


def test_overpasses_of_one_lens():
    """Places of the first one are told at once, with one look, and later under the same names."""
    _, ties, _, _, _ = matched("eros-a1-small")
    first = [tie for tie in ties if tie.body.images[0].strip == "scene1/P"]
    later = [tie for tie in ties if tie.body.images[0].strip == "scene2/P"]
    assert {len(tie.body.images) for tie in ties} == {1}
    assert len({tie.body.point for tie in first}) == len(first)
    found = {tie.body.point for tie in later} & {tie.body.point for tie in first}
    # those about which both strips have lines and samples enough for a template
    inner = {
        tie.body.point
        for tie in first
        if 30 < (image := tie.body.images[0]).line < 260 and 30 < image.sample < 260
    }  # fmt: skip
    assert len(inner) > 80 and len(inner & found) > 0.9 * len(inner)
    assert len({tie.body.point for tie in later}) < 1.05 * len(found)  # hardly any place of its own beside those
    assert later[0].stamp_ns - first[-1].stamp_ns > 2.9 * 86_400e9


CAMERA = """{"name": "hyper", "lenses": [{"id": "L1", "focal_length_mm": 25.0}],
 "lines": [{"id": "N", "lens": "L1", "pixels": 500, "pixel_size_mm": 0.0384, "center_mm": [0.05, 0.0]}]}"""
#: As many poses as such flights need, and such a camera.
SENSORS = ("--attitude-rate", "50", "--sensor")


def test_strips_of_one_ccd_line_in_any_direction_are_tied_by_their_images_alone(tmp_path, capsys):
    """Two strips in opposite directions and one across them, no control, the height of the ground wrongly stated.

    Lines in another direction were taken for shaken ones: strips of one direction alone were tied.
    """
    sensor, flight, out = tmp_path / "camera.json", tmp_path / "flight.mcap", tmp_path / "out.mcap"
    sensor.write_text(CAMERA)
    plan = ["--strips", "2", "--cross", "1", "--sidelap", "0.6", "--seconds", "12", "--height", "1000", "--speed", "60"]
    simulate = ["simulate", "-q", "-o", str(flight), *SENSORS, str(sensor), "--images", *plan, "--no-turns"]
    assert main([*simulate, "--control", "0", "--check", "0", "--lead-in", "3", "--seed", "3"]) == 0
    capsys.readouterr()
    settings = tmp_path / "nodes.toml"
    pace = "[navigator]\nfiltered_s = 0.02\n[adjuster]\nupdate_s = 0.5\nupdate_rays = 100\n"
    settings.write_text(f"[matcher]\nground_m = 400.0\n{pace}")  # it is at 0 m, the camera at 1000 m
    nodes = ["--nodes", "navigator,matcher,adjuster", "--processes", "1", "--config", str(settings)]
    assert main(["process", str(flight), "-o", str(out), "-q", *nodes]) == 0
    assert "note:" not in capsys.readouterr().out
    seen, said, late_s = {}, [], []
    for message in RecordingReader(out).messages(["observation/tie", "event/log"]):
        if message.topic == "observation/tie":
            for image in message.body.images:
                seen.setdefault(message.body.point, set()).add(image.strip)
                late_s.append((message.stamp_ns - image.time_ns) * 1e-9)
        elif message.topic == "event/log":
            said.append(message.body.message)
    pairs = [frozenset(strips) for strips in seen.values()]
    for pair in (("S1", "S2"), ("S1", "C1")):
        assert sum(set(pair) <= strips for strips in pairs) > 0.3 * len(pairs) > 20, pair
    assert any("the ground was found at about" in text for text in said)
    assert not any("no tie point at" in text for text in said)
    # while a strip is flown, and not when it is over: its time is in the window of 10 s as yet
    assert np.median(late_s) < 4.0 and max(late_s) < 10.0
    result = evaluate(out)
    why = "none: there is no check point in it, and no truth of the tie points"
    assert any(why in line for line in accuracy_lines(result))
    whole, alone = (result["orientation"][name] for name in ("whole", "filtered"))
    assert 0.3 < whole["nees"] < 1.8
    assert (np.array(whole["sigma_m"]) < 0.75 * np.array(alone["sigma_m"])).all(), whole["sigma_m"]
    # and they fit: the batch says how well
    assert main(["adjust", str(out), "--json", "-o", str(tmp_path / "adjusted")]) == 0
    batch = json.loads(capsys.readouterr().out)
    assert batch["redundancy"] > 50 and batch["sigma0"] < 1.2


def test_a_strip_of_one_ccd_line_whose_end_nobody_tells_is_tied(tmp_path):
    """The program of the camera crashed and went on with another strip: nothing was tied, and nothing said why."""
    sensor, flight, rest, out = (tmp_path / name for name in ("camera.json", "flight.mcap", "rest.mcap", "out.mcap"))
    sensor.write_text(CAMERA)
    plan = ["--strips", "2", "--sidelap", "0.6", "--seconds", "10", "--height", "1000", "--speed", "60", "--no-turns"]
    simulate = ["simulate", "-q", "-o", str(flight), *SENSORS, str(sensor), "--images", *plan, "--control", "0"]
    assert main([*simulate, "--check", "0", "--lead-in", "6", "--lead-out", "6", "--seed", "3"]) == 0
    messages = [
        x for x in RecordingReader(flight).messages()
        if not (x.topic == "configuration/strip" and x.body.ended and x.body.id == "S1")
    ]  # fmt: skip
    write_recording(rest, messages)
    settings = tmp_path / "nodes.toml"
    settings.write_text("[matcher]\nground_m = 0.0\n[adjuster]\nupdate_s = 1.0\nupdate_rays = 100\n")
    nodes = ["--nodes", "navigator,matcher,adjuster", "--processes", "1", "--config", str(settings)]
    assert main(["process", str(rest), "-o", str(out), "-q", *nodes]) == 0
    reader, seen = RecordingReader(out), {}
    for tie in reader.messages(["observation/tie"]):
        seen.setdefault(tie.body.point, set()).update(image.strip for image in tie.body.images)
    assert sum(strips == {"S1", "S2"} for strips in seen.values()) > 60
    told = [x.body.message for x in reader.messages(["event/log"])]
    assert "S1: lines of S2 come, none of its own do, and nobody has told its end: matched as if it were over" in told
    assert sum("strip S1: another one has begun, and nobody has told its end" in text for text in told) == 1
    whole = {x.body.strip: x.stamp_ns for x in reversed(list(reader.messages(["orientation/whole"])))}
    assert whole["S1"] < messages[-1].stamp_ns - 5_000_000_000 and "S2" in whole


@pytest.mark.study
def test_a_strip_of_few_lines_a_second_is_tied_while_it_is_flown(tmp_path, capsys):
    """4 lines/s: 25 s go by before the first places have the lines around them that a search wants. The window waited
    for 20 s at most, and refused them as too late."""
    sensor, flight, out = (tmp_path / name for name in ("camera.json", "flight.mcap", "out.mcap"))
    sensor.write_text(CAMERA.replace("500", "200").replace("0.0384", "0.064"))
    plan = ["--strips", "2", "--sidelap", "0.8", "--seconds", "45", "--height", "5860", "--speed", "60", "--no-turns"]
    simulate = ["simulate", "-q", "-o", str(flight), "--sensor", str(sensor), "--images", *plan, "--control", "0"]
    rest = ["--check", "0", "--attitude-rate", "10", "--lead-in", "4", "--lead-out", "4", "--seed", "3"]
    assert main([*simulate, *rest]) == 0
    settings = tmp_path / "nodes.toml"
    pace = "[navigator]\nfiltered_s = 0.1\n[adjuster]\nupdate_s = 2.0\nupdate_rays = 1000\n"
    settings.write_text(f"[matcher]\nground_m = 0.0\n{pace}")
    nodes = ["--nodes", "navigator,matcher,adjuster", "--processes", "1", "--config", str(settings)]
    capsys.readouterr()
    assert main(["process", str(flight), "-o", str(out), "--json", *nodes]) == 0
    done = json.loads(capsys.readouterr().out)["counters"]
    assert done["matcher"]["later looks"] > 60 and not done["matcher"].get("ground not found")
    assert not done["adjuster"].get("too late")
    tied = {x.body.point for x in RecordingReader(out).messages(["point/object"]) if x.body.rays > 1}
    assert len(tied) > 0.9 * done["matcher"]["later looks"]


@pytest.mark.study
@pytest.mark.parametrize("world", ["as usual", "relief of 150 m", "three times the turbulence"])
def test_matched_strips_of_one_ccd_line_are_as_good_as_they_say(world, tmp_path):
    """Three strips and one across, no control, four seeds: orientation and check points after the strips."""
    sensor, flight, out = tmp_path / "camera.json", tmp_path / "flight.mcap", tmp_path / "out.mcap"
    sensor.write_text(CAMERA)
    other = {"relief of 150 m": ["--relief", "150"], "three times the turbulence": ["--turbulence", "3"]}
    plan = ["--strips", "3", "--cross", "1", "--sidelap", "0.5", "--seconds", "20", "--height", "1000", "--speed", "60"]
    simulate = ["simulate", "-q", "-o", str(flight), *SENSORS, str(sensor), "--images", *plan, "--no-turns"]
    nees, squares = [], []
    for seed in range(11, 15):
        assert main([*simulate, "--control", "0", "--check", "30", "--seed", str(seed), *other.get(world, [])]) == 0
        nodes = ["--nodes", "navigator,matcher,adjuster", "--processes", "1"]
        assert main(["process", str(flight), "-o", str(out), "-q", *nodes]) == 0
        result = evaluate(out)
        o, p = result["orientation"], result["points"]
        nees.append((o["whole"]["nees"], p["adjusted_whole"]["nees"]))
        squares.append([np.square(each["rmse_m"]) for each in (o["filtered"], o["whole"])])
    before, after = np.sqrt(np.mean(squares, axis=0))
    words = " ".join(f"{a:.2f} from {b:.2f} m," for a, b in zip(after, before, strict=True))
    of_orientation, of_points = np.mean(nees, axis=0)
    print(f"{world}: X, Y, Z {words} NEES of orientation {of_orientation:.2f}, of points {of_points:.2f}")
    # without control a flight has some four errors in common to all: sixteen of them, 95 %
    assert 0.4 < of_orientation < 1.8 and 0.4 < of_points < 1.8
    assert (after < 0.75 * before).all()


@pytest.fixture(scope="module")
def flown_twice(tmp_path_factory):
    """Messages of a line that was flown forth and back, and of a strip across it."""
    folder = tmp_path_factory.mktemp("twice")
    sensor, flight, out = folder / "camera.json", folder / "flight.mcap", folder / "out.mcap"
    sensor.write_text(CAMERA.replace("500", "300").replace("0.0384", "0.064"))
    plan = [
        "--strips",
        "2",
        "--cross",
        "1",
        "--sidelap",
        "0.999",
        "--seconds",
        "12",
        "--height",
        "1000",
        "--speed",
        "60",
    ]
    simulate = ["simulate", "-q", "-o", str(flight), *SENSORS, str(sensor), "--images", *plan, "--no-turns"]
    assert main([*simulate, "--control", "0", "--check", "0", "--seed", "7"]) == 0
    assert main(["process", str(flight), "-o", str(out), "-q", "--nodes", "navigator", "--processes", "1"]) == 0
    return list(RecordingReader(out).messages())


def test_a_line_that_is_flown_twice_tells_no_heights(flown_twice):
    """Its rays are nearly parallel: a pixel is 330 m of height. The strip across was looked for on ground that was as
    wrong as that, and 14 of its places were found."""
    seen = {}
    for out in through(Matcher(), flown_twice):
        if out.topic == "observation/tie":
            seen.setdefault(out.body.point, set()).update(image.strip for image in out.body.images)
    assert sum({"S1", "S2"} <= strips for strips in seen.values()) > 120
    assert sum({"S1", "C1"} <= strips for strips in seen.values()) > 120


def test_a_strip_without_ties_is_told_though_each_of_its_places_is_a_point_at_once(flown_twice):
    told = [out.body.message for out in through(Matcher(ground_m=400.0), flown_twice) if out.topic == "event/log"]
    assert [text.partition(":")[0] for text in told if "no tie point at" in text] == ["C1"]


def test_process_without_the_matcher_says_that_images_have_no_tie_points(tmp_path, capsys):
    sensor, flight = tmp_path / "camera.json", tmp_path / "flight.mcap"
    sensor.write_text(CAMERA)
    simulate = ["simulate", "-q", "-o", str(flight), "--sensor", str(sensor), "--images", "--seconds", "3"]
    assert main([*simulate, "--height", "1000", "--lead-in", "1", "--lead-out", "1", "--control", "0"]) == 0
    capsys.readouterr()
    assert main(["process", str(flight), "-o", str(tmp_path / "out.mcap"), "-q", "--processes", "1"]) == 0
    assert "note: image lines and no tie point in it; '--nodes navigator,matcher,adjuster'" in capsys.readouterr().out


def test_lines_that_a_budget_does_not_hold():
    """The newest lines of a strip are kept, and it is told; the oldest strips go where all of them do not fit."""
    messages, _, _ = recorded("alos-prism-small", 2)
    node = Matcher(budget_mb=0.3)  # 500 kB are 834 lines in all, of three strips of 300
    out = through(node, messages)
    told = [o.body.message for o in out if o.topic == "event/log"]
    assert [text for text in told if "hold the last" in text and "of 300 lines" in text]


def of_one_line(pose, first_line=0, sigma_m=1e-3, lines=300):
    """A matcher of a camera with one CCD line, 1 km up, and its only strip, of 12 s and 300 lines at most."""
    camera = preset("spot5-hrs")
    line = camera.lines[0]
    lens = tuple(lens for lens in camera.lenses if lens.id == line.lens)
    matcher = StripMatcher(LineCamera("one", lens, (line,)))
    matcher.begin_strip("S1", LineTimes(-first_line / 25.0, 25.0), first_line)
    for t in np.arange(0.0, 12.0, 0.05):
        covariance = np.diag([sigma_m**2] * 3 + [1e-12] * 3)
        matcher.add_pose(t, pose(t), np.array([0.0, 0, 0, 1]), covariance)
    matcher.add_lines(line.id, first_line, np.full((lines, 12000), 700, np.uint16))
    return matcher, matcher._strips["S1"].views[line.id]


def test_lines_that_do_not_begin_at_0_are_all_held():
    """It was told that the budget holds the last 300 of 5300 lines."""
    matcher, _ = of_one_line(lambda t: np.array([60.0 * t, 0.0, 1000.0]), first_line=5000)
    matcher.end_strip("S1")
    assert not [text for text in matcher.take_events() if "hold" in text]


def test_lines_of_a_strip_that_is_taken_are_put_together_once():
    """Each of the earlier strips asks for them every two seconds."""
    matcher, view = of_one_line(lambda t: np.array([60.0 * t, 0.0, 1000.0]))
    scan = view.whole(100.0)
    assert scan is not None and scan.first_line == 100 and view.whole(100.0) is scan
    matcher.add_pose(12.0, np.array([720.0, 0.0, 1000.0]), np.array([0.0, 0, 0, 1]), np.diag(np.full(6, 1e-6)))
    assert view.whole(100.0) is not scan


def test_a_platform_that_hovers_has_no_way():
    """Not a number: a fault with each block of lines once another strip saw the same ground."""
    _, view = of_one_line(lambda t: np.array([0.0, 0.0, 1000.0]))
    assert view.ground_share == 1.0 and view.whole().way.tolist() == [1.0, 0.0]


def test_the_first_lines_of_a_long_strip_keep_their_orientation():
    """Poses older than two minutes went: of a strip of five minutes nothing was matched but the end."""
    matcher = StripMatcher(preset("spot5-hrs"))
    matcher.begin_strip("S1", LineTimes(0.0, 10.0))
    for t in np.arange(0.0, 300.0, 0.05):
        matcher.add_pose(t, np.array([60.0 * t, 0.0, 1000.0]), np.array([0.0, 0, 0, 1]), np.diag(np.full(6, 1e-6)))
        if t % 1.0 < 0.05:
            matcher.orientation.add_correction(t, np.full(6, 1e-9) * t, np.diag(np.full(6, 1e-6)))
    orientation = matcher.orientation_of("S1")
    assert orientation.start_s == 0.0 and orientation.end_s > 299.0
    position, _ = orientation.at([0.5, 10.0, 299.0])
    assert position[:, 0] == pytest.approx([30.0, 600.0, 17940.0], abs=1e-3)


def test_places_are_looked_for_no_farther_beside_a_strip_than_the_orientation_may_be_wrong():
    """A pixel of 11 mm, and positions to 0.3 m: all of the swath was looked for in 12 % of it, and never was a third of
    that found, so that no such strips were tied."""
    _, left = of_one_line(lambda t: np.array([60.0 * t, 0.0, 1000.0]), sigma_m=0.3)
    _, right = of_one_line(lambda t: np.array([60.0 * t, -118.0, 1000.0]), sigma_m=0.3)
    for way in (1.0, -1.0):  # both strips forth, and the first one from the other side
        here, there = (left, right) if way > 0 else (right, left)
        prediction = PairPrediction((here, there), 1, MatchingOptions(), RoundHeights(0.0, 60.0))
        prediction.renew()
        sample = np.arange(50.0, 12000.0, 100.0)
        seen = np.isfinite(prediction.seen([Place(150.0, s) for s in sample.tolist()])[:, 0])
        three_sigma = 3 * np.sqrt(2.0) * 0.3 / 0.0112
        assert 80 < three_sigma < 120
        assert 1430 < np.ptp(sample[seen]) < 1430 + 2.5 * three_sigma  # 118 of 134 m are beside


def pair_of_strips(lines, step=10):
    """Places of a strip without texture, and a strip beside it that has fewer lines; both are over."""
    _, first = of_one_line(lambda t: np.array([60.0 * t, 0.0, 1000.0]))
    _, second = of_one_line(lambda t: np.array([60.0 * t, 20.0, 1000.0]), lines=lines)
    places = [Place(float(line), 6000.0) for line in range(10, 200, step)]
    first.strip.over = second.strip.over = True
    return StripPair(Master(first, "S1", places), second, 1, MatchingOptions(), RoundHeights(0.0, 60.0))


def test_places_without_lines_are_not_counted_as_not_found():
    """The second strip has 120 lines; places of the first one that it would see in lines up to 80 further are none that
    were looked for in vain: "no tie point at 17 places" spoke of them, too."""
    pair = pair_of_strips(120)
    assert pair.match() == []
    assert pair.counters["ground not found"] == 9  # lines 20 to 100: a match wants 13 lines on either side
    assert pair.counters["no lines"] > 6


def test_the_ground_is_found_where_a_third_of_the_places_is_that_have_lines(monkeypatch):
    """Six of eight were too few, because twelve more had none."""
    pair = pair_of_strips(300, step=4)
    monkeypatch.setattr(pair._looks, "try_height", lambda tracks, *_: (np.zeros((6, 3)), len(tracks) - 12))
    pair.match()
    assert pair.counters["ground not found"] == 0


def test_bad_input():
    matcher = StripMatcher(preset("spot5-hrs"))
    with pytest.raises(ValueError, match="lines of F before their strip"):
        matcher.add_lines("F", 0, np.zeros((2, 12000), np.uint16))
    with pytest.raises(ValueError, match="wanted 0 to 1"):
        matcher.keep(1.5)
    matcher.begin_strip("S/F", LineTimes(0.0, 100.0))
    with pytest.raises(ValueError, match="unknown CCD line 'N'"):
        matcher.add_lines("N", 0, np.zeros((2, 12000), np.uint16))
    with pytest.raises(ValueError, match="samples, wanted 12000"):
        matcher.add_lines("F", 0, np.zeros((2, 100), np.uint16))
    matcher.add_lines("F", 0, np.zeros((2, 12000), np.uint16))  # lines without any pose
    assert matcher.end_strip("S/F") == [] and matcher.end_strip("never begun") == []
    matcher.begin_strip("S/B", LineTimes(20.0, 100.0))
    assert matcher.finish() == []
