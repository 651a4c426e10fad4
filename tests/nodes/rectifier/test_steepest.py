"""Which CCD line the live orthoimage shows: of several lenses the one that looks down, as their poses tell."""

from __future__ import annotations

import numpy as np
import pytest
from stepped_node import stepped

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.rectifier.rectifier import Rectifier
from triline.nodes.rectifier.steepest import SteepestLine
from triline.solver.camera.line_camera import Lens, LineCamera, straight_line, three_line_camera
from triline.solver.geometry.rotation import matrix_from_angles

HIGH = np.array([0.0, 0.0, 2000.0])


def camera(*ids):
    """A lens and a CCD line in its middle for each."""
    lines = tuple(straight_line(id, id, 100, 0.01, (0.0, 0.0)) for id in ids)
    return LineCamera("lenses", tuple(Lens(id, 100.0) for id in ids), lines)


def looks(degrees, roll=0.0):
    """Orientation of a lens that looks forward by so much."""
    return matrix_from_angles(np.radians(roll), np.radians(degrees), 0.0)


def test_of_one_lens_the_camera_says_it():
    one = three_line_camera("three", 60.0, 100, 0.01, {"F": 27.0, "N": 2.0, "B": -14.0})
    steepest = SteepestLine(one)
    assert one.lines[steepest.line] is one.nadir_line
    assert not any(steepest.wants(k) for k in range(len(one.lines)))


def test_the_first_is_shown_until_one_comes_that_looks_down_more_steeply():
    steepest = SteepestLine(camera("F", "N", "B"))
    assert steepest.line == 0 and all(map(steepest.wants, (0, 1, 2)))
    assert steepest.see(0, "s/F", HIGH, looks(24.0)) is None and not steepest.wants(0)
    assert np.degrees(steepest.see(1, "s/N", HIGH, looks(0.5))) == pytest.approx([24.0, 0.5])
    assert steepest.line == 1
    assert steepest.see(2, "s/B", HIGH, looks(-24.0)) is None and steepest.line == 1


def test_lenses_that_look_alike_and_a_turn_of_the_aircraft_change_nothing():
    steepest = SteepestLine(camera("A", "B", "C"))
    assert steepest.see(0, "S1", HIGH, looks(0.0, roll=15.0)) is None
    assert steepest.see(1, "S1", HIGH, looks(0.0, roll=1.0)) is None  # the same strip: lenses that look the same way
    assert steepest.see(2, "S1/C", HIGH, looks(14.0)) is None  # not steeper by two degrees
    assert steepest.line == 0


def test_a_lens_that_is_not_imaged_is_not_waited_for():
    steepest = SteepestLine(camera("F", "N"))
    assert steepest.see(1, "s/N", HIGH, looks(3.0)) is not None and steepest.line == 1


def test_the_live_orthoimage_of_a_triplet_is_that_of_the_lens_that_looks_down(tmp_path):
    flight, out = tmp_path / "triplet.mcap", tmp_path / "out.mcap"
    simulated = ["simulate", "-o", str(flight), "--satellite", "alos-prism-small", "--images", "--points", "34", "-q"]
    assert main(simulated) == 0
    assert main(["process", str(flight), "-o", str(out), "--nodes", "rectifier", "-q"]) == 0
    reader = RecordingReader(out)
    assert {tile.body.ccd for tile in reader.messages(["orthoimage/final"])} == {"N"}
    live = [tile.body for tile in reader.messages(["orthoimage/live"])]
    assert [tile.ccd for tile in live] == sorted(tile.ccd for tile in live) and live[-1].ccd == "N"  # F, then N
    assert len({tile.gsd_m for tile in live}) == 1
    (said,) = (log.body.message for log in reader.messages(["event/log"]) if log.source == "rectifier")
    assert said == (
        "CCD line N looks down more steeply than F (0.2 and 23.6 deg off): the orthoimage shows it from now on"
    )
    tiles = [tiles_of(reader.messages(), version) for version in ("live", "final")]
    # the whole strip of N, as if F had not been
    (tmp_path / "nodes.toml").write_text('[rectifier]\nccd = "N"\n')
    words = ["process", str(flight), "-o", str(out), "--nodes", "rectifier", "--config", str(tmp_path / "nodes.toml")]
    assert main([*words, "-q"]) == 0
    assert tiles == [tiles_of(RecordingReader(out).messages(), version) for version in ("live", "final")]


def test_a_lens_is_looked_at_where_poses_come_long_after_its_lines(tmp_path):
    """A block was never looked at whose orientation came later: the orthoimage stayed that of F."""
    flight = tmp_path / "triplet.mcap"
    simulated = ["simulate", "-o", str(flight), "--satellite", "alos-prism-small", "--images", "--points", "34", "-q"]
    assert main(simulated) == 0
    messages = list(RecordingReader(flight).sorted_messages())
    begin_ns = min(message.stamp_ns for message in messages if message.topic.startswith("sensor/lines/"))
    poses = sorted(message.stamp_ns for message in messages if message.topic.startswith("trajectory/"))
    assert sum(stamp > begin_ns for stamp in poses) > 10

    def put_out(late_s, **settings):
        """What the rectifier says where poses come so much later than what they belong to."""
        rectifier = Rectifier(**settings)
        wanted = tuple(name.rstrip("*") for name in rectifier.inputs)

        def comes_ns(message):
            return message.stamp_ns + round(late_s * 1e9) * message.topic.startswith("trajectory/")

        used = (message for message in sorted(messages, key=comes_ns) if message.topic.startswith(wanted))
        return stepped(rectifier, used), rectifier

    said, _ = put_out(1.0)
    assert {out.body.ccd for out in said if out.topic == "orthoimage/final"} == {"N"}
    assert any("CCD line N looks down more steeply than F" in out.body.message for out in said if out.topic[0] == "e")
    # its lines of before the first pose are in it, also where all poses come after all lines
    for late_s in (1.0, 1e4):
        said, rectifier = put_out(late_s)
        alone, _ = put_out(late_s, ccd="N")
        for version in ("live", "final"):
            assert tiles_of(said, version) == tiles_of(alone, version) != {}
        assert "lines given up" not in rectifier.counters
    # lines of before are given up where they are too many
    said, rectifier = put_out(1e4, budget_mb=1e-3)
    assert "were more than budget_mb" in rectifier.last_problems["lines given up"]


def tiles_of(messages, version):
    """The tiles of N at the end."""
    tiles = (tile.body for tile in messages if tile.topic == f"orthoimage/{version}")
    return {(tile.row, tile.column): tile.data for tile in tiles if tile.ccd == "N"}
