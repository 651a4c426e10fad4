"""Image lines of a block folder: times and numbers are those of its strips and image points."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from envi_files import write_image
from small_block import TRAJECTORY_ROWS, write_files

from triline.nodes.cli import main
from triline.nodes.recording.reader import RecordingReader

LINES = 2001
#: Line 900 of S1 and of S2, which has times of its own lines and flies at the same time.
POINTS = "point,strip,ccd,line,sample\nG1,S1,F,900,499.5\nG1,S2,N,900,510\n"


@pytest.fixture
def block(tmp_path):
    strips = "strip,first_line_time_s,line_rate_hz,lines,line_times\nS1,100,200,2001,\nS2,,,,s2.csv\n"
    both = "".join(row.replace("S1,", f"{id},", 1) + "\n" for id in ("S1", "S2") for row in TRAJECTORY_ROWS[1:])
    folder = write_files(
        tmp_path / "block", strips=strips, image_points=POINTS, trajectory=TRAJECTORY_ROWS[0] + "\n" + both
    )
    seconds = 100.0 + 10.0 * (np.arange(LINES) / (LINES - 1)) ** 1.05
    (folder / "s2.csv").write_text("line,time_s\n" + "".join(f"{i},{t:.9f}\n" for i, t in enumerate(seconds)))
    for name, grey in (("f1", 10), ("n1", 20), ("n2", 30)):
        cube = np.full((LINES, 1000, 1), grey, dtype=np.uint8)
        cube[900] = 200
        write_image(tmp_path / f"{name}.img", cube)
    return folder


def test_lines_have_the_times_of_image_points_on_them(block, tmp_path, capsys):
    out, image = tmp_path / "o.mcap", {name: tmp_path / f"{name}.img" for name in ("f1", "n1", "n2")}
    lines = f"S1/F={image['f1']},S1/N={image['n1']},S2/N={image['n2']}"
    assert main(["import", str(block), "--lines", lines, "-o", str(out)]) == 0
    capsys.readouterr()
    reader = RecordingReader(out)
    looks = [look for message in reader.messages(["observation/tie"]) for look in message.body.images]
    assert {(look.strip, look.ccd) for look in looks} == {("S1", "F"), ("S2", "N")}
    messages = list(reader.sorted_messages())
    for look, grey in ((look, {"S1": 10, "S2": 30}[look.strip]) for look in looks):
        blocks = [m.body for m in messages if m.topic == f"sensor/lines/{look.ccd}" and m.body.strip == look.strip]
        times, pixels = np.concatenate([b.times_ns() for b in blocks]), np.concatenate([b.pixels for b in blocks])
        assert len(times) == LINES and abs(int(times[900]) - look.time_ns) <= 2
        assert (pixels[900] == 200).all() and (pixels[901] == grey).all()
    order = [(m.topic, m.body.strip if m.topic.startswith("sensor/lines") else m.body.id) for m in messages
             if m.topic.startswith(("sensor/lines", "configuration/strip"))]  # fmt: skip
    for id in ("S1", "S2"):  # a strip begins before its lines and ends after them
        mine = [topic for topic, strip in order if strip == id]
        assert mine[0] == mine[-1] == "configuration/strip" and mine.count("configuration/strip") == 2
    ortho = tmp_path / "o.tif"
    words = ["rectify", str(out), "-o", str(ortho), "--orientation", "measured", "--crs", "local", "--height", "100"]
    assert main([*words, "--strip", "S1", "--ccd", "N", "--gsd", "1", "-q"]) == 0
    with rasterio.open(ortho) as file:
        assert (file.read(1) == 20).any()


@pytest.mark.parametrize(
    ("lines", "more", "told"),
    [
        ("S3/F={f1}", [], "strip 'S3' is not one of S1, S2, wanted STRIP/CCD=FILE"),
        ("F={f1}", [], "strip '' is not one of S1, S2, wanted STRIP/CCD=FILE"),
        ("S1/Q={f1}", [], "CCD line 'Q' is not in camera.json, wanted STRIP/CCD with F, N"),
        ("S1/F={f1},S1/F={n1}", [], "wanted another view for each file"),
        ("S1/F={short}", [], "1000 lines of 1000 samples, wanted 2001 of 1000 as strip S1 has"),
        ("S1/F={f1}", ["--strip", "Z"], "strips.csv has times and names, wanted no --line-times"),
        ("S1/F={f1}", ["--line-rate", "20"], "--line-rate does not go with block folder"),
    ],
)
def test_images_that_do_not_fit_are_told(block, tmp_path, capsys, lines, more, told):
    short = write_image(tmp_path / "short.img", np.zeros((1000, 1000, 1), dtype=np.uint8))
    files = {"f1": tmp_path / "f1.img", "n1": tmp_path / "n1.img", "short": short}
    out = tmp_path / "o.mcap"
    assert main(["import", str(block), "--lines", lines.format(**files), "-o", str(out), *more]) == 1
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1, error
    assert not out.exists()


def test_a_single_strip_needs_no_name_and_missing_ones_are_told(block, tmp_path, capsys):
    out = tmp_path / "o.mcap"
    assert main(["import", str(block), "--lines", f"S2/N={tmp_path / 'n2.img'}", "-o", str(out)]) == 0
    assert "note: no images of the strips S1" in capsys.readouterr().out
    one = write_files(tmp_path / "one")
    assert main(["import", str(one), "--lines", f"N={tmp_path / 'n1.img'}", "-o", str(out), "-q"]) == 0
    assert len(list(RecordingReader(out).messages(["sensor/lines/N"]))) > 90


def test_where_lines_come_no_image_point_need_be_measured(block, tmp_path, capsys):
    """The matcher finds tie points in them; a table with a header alone was refused."""
    out = tmp_path / "o.mcap"
    (block / "image_points.csv").write_text(POINTS.splitlines()[0] + "\n")
    assert main(["import", str(block), "--lines", f"S1/N={tmp_path / 'n1.img'}", "-o", str(out), "-q"]) == 0
    reader = RecordingReader(out)
    assert list(reader.messages(["sensor/lines/N"])) and list(reader.messages(["observation/control"]))
    assert not list(reader.messages(["observation/tie"]))
    out.unlink(), capsys.readouterr()
    assert main(["import", str(block), "-o", str(out)]) == 1
    assert "image_points.csv: no rows below the header, wanted at least one" in capsys.readouterr().err
