"""Images of ROS 2 bags as image lines: rows in their order, line numbers shared by the views, strips, what is told."""

from __future__ import annotations

import numpy as np
import pytest
from envi_files import write_camera, write_image
from test_ros2 import IMAGE, SQLITE, START_NS, _header, _type, fix, image, imu, write_bag

from triline.nodes.cli import main
from triline.nodes.formats.detect import Options, read_any
from triline.nodes.formats.image_lines import LinesGiven
from triline.nodes.recording.reader import RecordingReader

ROWS, SAMPLES, PERIOD_NS = 8, 7, 5_000_000
PIXELS = {
    view: np.random.default_rng(i).integers(0, 60000, (200, SAMPLES)).astype("u2") for i, view in enumerate("FNB")
}


def rows_of(view, first, *, big=0, step=2 * SAMPLES + 4, encoding="mono16", samples=SAMPLES):
    """An Image of lines of a view, stamped with the time of its first one."""
    values = PIXELS[view][first : first + ROWS, :samples].astype(">u2" if big else "<u2")
    data = np.zeros((ROWS, step), np.uint8)
    data[:, : 2 * samples] = values.view(np.uint8).reshape(ROWS, -1)[:, :step]
    stamp = START_NS + first * PERIOD_NS
    return _type(IMAGE, _header(stamp, "camera"), ROWS, samples, encoding, big, step, data.ravel())


def views(skip=(), late=0):
    """Three topics with 25 images each; the forward one without some, the backward one without its first ones."""
    for i in range(25):
        for view, name in zip("FNB", ("f", "n", "b"), strict=True):
            if (view, i) not in skip and not (view == "B" and i < late):
                yield (
                    f"/camera/{name}/image_raw",
                    START_NS + i * ROWS * PERIOD_NS,
                    rows_of(view, i * ROWS, big=view == "N"),
                )
        yield "/imu", START_NS + i * ROWS * PERIOD_NS, imu(START_NS + i * ROWS * PERIOD_NS)
    yield "/fix", START_NS, fix(START_NS, 600.0)


def pixels_of(messages, ccd):
    """Lines of a CCD line by their numbers."""
    blocks = [m.body for m in messages if m.topic == f"sensor/lines/{ccd}"]
    return {b.first_line + i: row for b in blocks for i, row in enumerate(b.pixels)}


def test_rows_become_lines_of_the_strip_with_shared_numbers(tmp_path, capsys):
    bag = write_bag(tmp_path / "bag", views(skip={("F", 3), ("F", 4)}, late=2), SQLITE)
    out, camera = tmp_path / "out.mcap", str(write_camera(tmp_path / "camera.json"))
    assert main(["import", str(bag), "-o", str(out), "--camera", camera, "--strip", "S1"]) == 0
    assert "note: bag: 16 image lines are missing between images" in capsys.readouterr().out
    messages = list(RecordingReader(out).sorted_messages())
    for view, numbers in (
        ("N", set(range(200))),
        ("F", set(range(200)) - set(range(24, 40))),
        ("B", set(range(16, 200))),
    ):
        lines = pixels_of(messages, view)
        assert set(lines) == numbers
        assert all((lines[u] == PIXELS[view][u]).all() for u in numbers)
    strips = [m.body for m in messages if m.topic == "configuration/strip"]
    assert [(s.id, s.lines, s.ended) for s in strips] == [("S1", 200, False), ("S1", 200, True)]
    assert strips[0].first_line_time_ns == START_NS and strips[0].line_rate_hz == pytest.approx(200.0, rel=1e-9)
    block = next(m for m in messages if m.topic == "sensor/lines/F")
    assert block.stamp_ns == START_NS + (ROWS - 1) * PERIOD_NS == block.body.times_ns()[-1]
    assert sum(m.topic == "sensor/imu" for m in messages) == 25


def test_a_silence_begins_another_strip(tmp_path):
    times = [*range(4), *range(300, 303)]
    bag = write_bag(tmp_path / "bag", [("/nadir", START_NS + t, image(START_NS + t * 50_000_000)) for t in times])
    messages = list(read_any(bag, options=Options(lines=LinesGiven((), "A", rate_hz=40.0))).messages)
    strips = [m.body for m in messages if m.topic == "configuration/strip"]
    assert [(s.id, s.lines) for s in strips] == [("A221320", 8)] * 2 + [("A221335", 6)] * 2
    blocks = [m.body for m in messages if m.topic == "sensor/lines/nadir"]
    assert [b.first_line for b in blocks] == [0, 2, 4, 6, 0, 2, 4] and {b.strip for b in blocks} == {
        "A221320",
        "A221335",
    }


def test_lines_go_through_a_flight_folder(tmp_path, capsys):
    write_bag(tmp_path / "bag", views(), SQLITE)
    write_camera(tmp_path / "camera.json")
    text = """[flight]
crs = "EPSG:32632"
vertical_datum = "ellipsoid"
ground_height_m = 300.0
[camera]
file = "camera.json"
[navigation]
file = "bag"
images = {N = "/camera/n/image_raw"}
line_rate_hz = 200.0
"""
    (tmp_path / "flight.toml").write_text(text)
    assert main(["check", str(tmp_path)]) == 0
    assert "complete; image lines as in the bag, ground at 300 m" in capsys.readouterr().out
    out = tmp_path / "out.mcap"
    assert main(["import", str(tmp_path), "-o", str(out)]) == 0
    assert (
        f"not imported: 25 {IMAGE} of /camera/b/image_raw, 25 {IMAGE} of /camera/f/image_raw" in capsys.readouterr().out
    )
    messages = list(RecordingReader(out).sorted_messages())
    assert len(pixels_of(messages, "N")) == 200 and not pixels_of(messages, "F")
    assert sum(m.topic == "configuration/camera" for m in messages) == 1
    (tmp_path / "flight.toml").write_text(text.replace('"/camera/n/image_raw"', '"nadir.img"'))
    assert main(["check", str(tmp_path)]) == 1
    assert "navigation.images.N: 'nadir.img', wanted a ROS topic as /camera/nadir" in capsys.readouterr().out


def test_what_cannot_be_image_lines_is_told(tmp_path, capsys):
    def odd():
        yield from views(skip={("N", 5), ("N", 6)})
        for i, how in ((5, {"encoding": "rgb8"}), (6, {"step": 5})):
            yield "/camera/n/image_raw", START_NS + i * ROWS * PERIOD_NS, rows_of("N", i * ROWS, **how)

    bag = write_bag(tmp_path / "bag", odd(), SQLITE)
    camera = ["--camera", str(write_camera(tmp_path / "camera.json", 9))]
    right = ["--camera", str(write_camera(tmp_path / "right.json"))]
    n, out = "/camera/n/image_raw", tmp_path / "out.mcap"
    for arguments, wanted in (
        (
            ["--lines", "N=/nadir"],
            f"{bag}: --lines N=/nadir: no {IMAGE} of this topic, wanted one of: /camera/b/image",
        ),
        (["--lines", f"X={n}", *right], f"{bag}: CCD line 'X' is not in the camera, wanted one of F, N, B"),
        (["--lines", f"N={n}", *camera], f"{bag}: images of N: 7 samples, wanted 9 as CCD line N of the camera has"),
        (
            ["--lines", f"N={n}", "--band", "1"],
            "--band, --grey-range, --line-times and --first-time are of image files",
        ),
        (["--lines", "N=nadir.img", "--line-rate", "50"], "--line-rate without --first-time, wanted both"),
    ):
        assert main(["import", str(bag), "-o", str(out), *arguments]) == 1, arguments
        err = capsys.readouterr().err
        assert wanted in err and err.count("\n") == 1 and not out.exists(), (arguments, err)
    assert main(["import", str(bag), "-o", str(out), *right]) == 0
    assert "note: bag: N: 1 images of a wrong size, 1 images that are not grey" in capsys.readouterr().out
    one = write_bag(tmp_path / "one", [("/nadir", START_NS, image(START_NS)), ("/imu", START_NS, imu(START_NS))])
    assert main(["import", str(one), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"images not imported: {one}: one image, which does not tell the line rate, wanted --line-rate" in said


@pytest.mark.parametrize("names", [("/a/image", "/b/image"), ("/image", "/other/image")])
def test_without_a_camera_the_topics_name_the_lines(tmp_path, names):
    bag = [(name, START_NS + i, image(START_NS + i * 50_000_000)) for i in range(3) for name in names]
    topics = {m.topic for m in read_any(write_bag(tmp_path / "bag", bag)).messages if m.topic.startswith("sensor")}
    wanted = {"/a/image": "a", "/b/image": "b", "/image": "N", "/other/image": "other"}
    assert topics == {f"sensor/lines/{wanted[name]}" for name in names}


@pytest.mark.parametrize("beside", ["", "folder", "option"])
def test_files_of_image_lines_are_held_against_the_times_of_a_bag(beside, tmp_path, capsys):
    """As against those of sensor folders and poses: lines of another day went in without a word; and without a flight
    folder no lines at all.
    """
    fixes = [("/fix", START_NS + i * 10**9, fix(START_NS + i * 10**9, 600.0)) for i in range(3)]
    write_bag(tmp_path / "bag", [*fixes, *views()])
    write_camera(tmp_path / "camera.json", SAMPLES)
    write_image(tmp_path / "n.img", np.ones((90, SAMPLES, 1), dtype=np.uint8))
    first = np.datetime64(START_NS, "ns")
    toml = (
        '[flight]\ncrs = "EPSG:32632"\nvertical_datum = "ellipsoid"\nground_height_m = 300.0\n'
        '[camera]\nfile = "camera.json"\n[navigation]\nfile = "bag"\n'
    )
    strip = '[[strips]]\nid = "S"\nimages = {N = "n.img"}\nline_rate_hz = 100\nfirst_time = '
    out = ["-o", str(tmp_path / "out.mcap")]

    def imported(time) -> int:
        lines = ["--lines", f"N={tmp_path / 'n.img'}", "--strip", "S", "--first-time", f"{time}Z", "--line-rate", "100"]
        (tmp_path / "flight.toml").write_text(toml + (f'{strip}"{time}Z"\n' if beside == "folder" else ""))
        if beside == "folder":
            return main(["import", str(tmp_path), *out])
        more = ["--flight", str(tmp_path)] if beside else ["--camera", str(tmp_path / "camera.json")]
        return main(["import", str(tmp_path / "bag"), *lines, *more, *out])

    assert imported(first) == 0
    assert "outside the time" not in capsys.readouterr().out
    blocks = [message.body for message in RecordingReader(tmp_path / "out.mcap").messages(["sensor/lines/N"])]
    assert sum(len(block.pixels) for block in blocks if block.strip == "S") == 90
    assert ({block.strip for block in blocks} == {"S"}) == (beside != "folder")  # which has the images of the bag, too
    assert imported(first - np.timedelta64(250, "ms")) == 0
    assert "strip S: 25 of 90 lines outside the time of the sensors" in capsys.readouterr().out
    assert imported(first + np.timedelta64(1, "D")) == 1
    assert "strip S: lines from 20" in (error := capsys.readouterr().err) and "but sensors from" in error
