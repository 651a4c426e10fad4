"""ENVI images with line times to image lines in a recording; the files are written here, byte by byte."""

from __future__ import annotations

import warnings
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import rasterio
from envi_files import write_camera, write_image
from rasterio.errors import NotGeoreferencedWarning
from tracks import ns

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import Options, kind_of_path, read_any
from triline.nodes.formats.envi_image import open_envi
from triline.nodes.formats.grey_image import GreyImage
from triline.nodes.formats.image_lines import LinesGiven, files_of
from triline.nodes.recording.reader import RecordingReader

START = "2020-06-01T12:00:00"


def cube_of(kind: str, lines=50, samples=7, bands=3) -> np.ndarray:
    values = np.random.default_rng(3).integers(0, 200, (lines, samples, bands))
    return values.astype(kind)


def write_times(path: Path, n=50) -> Path:
    rows = [f"{i},2020-06-01T12:00:{i * 0.01:09.6f}Z" for i in range(n)]
    path.write_text("line,time\n" + "\n".join(rows) + "\n")
    return path


def write_poses(path: Path) -> Path:
    t0 = ns(START) // 10**9
    rows = [f"{t0 + i},48.{i:03d},11,2000,0,0,0" for i in range(-2, 9) if i >= 0]
    path.write_text("time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n" + "\n".join(rows) + "\n")
    return path


def pixels_of(recording: Path, ccd: str) -> np.ndarray:
    with_lines = [message.body for message in RecordingReader(recording).messages([f"sensor/lines/{ccd}"])]
    assert [block.first_line for block in with_lines] == list(
        np.cumsum([0, *(len(block.pixels) for block in with_lines[:-1])])
    )
    return np.concatenate([block.pixels for block in with_lines])


# ---- the image


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize(
    ("kind", "big", "offset"), [("u1", False, 0), ("u2", True, 128), ("i2", True, 3), ("f4", False, 0)]
)
def test_every_order_of_values_gives_the_same_grey_values(tmp_path, interleave, kind, big, offset):
    cube = cube_of(kind)
    image = open_envi(write_image(tmp_path / "a.img", cube, interleave, big, offset))
    grey = GreyImage(image, image.weights("2"))
    np.testing.assert_array_equal(grey.read(10, 5), cube[10:15, :, 1])
    assert grey.read(10, 5).dtype == (np.uint8 if kind == "u1" else np.uint16)
    both = GreyImage(image, image.weights("1:0.5,3:0.25"))
    np.testing.assert_array_equal(both.read(0, 50), np.rint(cube[..., 0] * 0.5 + cube[..., 2] * 0.25))


@pytest.mark.parametrize("header", ["A.HDR", "A.IMG.HDR"])
def test_names_in_capitals(tmp_path, header):
    """As cards of cameras have them: the image was "of no known kind"."""
    cube = cube_of("u1")
    image = write_image(tmp_path / "a.img", cube).rename(tmp_path / "A.IMG")
    (tmp_path / "a.hdr").rename(tmp_path / header)
    assert kind_of_path(image) == "lines"
    for name in ("A.IMG", header):
        opened = open_envi(tmp_path / name)
        assert opened.path == image
        np.testing.assert_array_equal(GreyImage(opened, opened.weights("2")).read(0, 50), cube[..., 1])


def test_dark_lines_at_the_end_are_told(tmp_path):
    """A header as recorders of Specim write it."""
    image = write_image(tmp_path / "a.raw", cube_of("u2"))
    assert open_envi(image).notes == ()
    more = "errors = {none}\nStart Time = UTC TIME: 22:47:35\ndefault bands = {\n2,1\n}\nautodarkstartline = 40\n"
    header = tmp_path / "a.hdr"
    header.write_text(header.read_text() + more)
    assert open_envi(image).notes == ("a.raw: lines from 40 on are dark (autodarkstartline), not of the ground",)


def test_bands_by_name_and_values_in_a_range(tmp_path):
    cube = cube_of("f4") / np.float32(400.0)
    cube[0, 0, 1], cube[0, 1, 1] = np.nan, 2.0
    path = write_image(tmp_path / "a.img", cube, **{"band names": "{Green, Red, NIR}"})
    image = open_envi(tmp_path / "a.hdr")
    assert image.path == path and image.weights("red:2") == {1: 2.0}
    grey = GreyImage(image, image.weights("Red"), (0.0, 0.5))
    wanted = np.clip(np.rint(cube[1:, :, 1].astype(float) / 0.5 * 65535), 0, 65535)
    np.testing.assert_allclose(grey.read(1, 49), wanted, atol=1)
    assert grey.read(0, 1)[0, :2].tolist() == [0, 65535]
    assert grey.notes() == [
        "a.img: 1 values above the range, taken as 65535",
        "a.img: 1 values without a number, taken as 0",
    ]
    with pytest.raises(
        UserError, match=r"a.img: values from .* fewer than 16 grey values .* wanted their range: --grey"
    ):
        GreyImage(image, image.weights("1"))


HEADERS = {
    "complex": ({"data type": 6}, r"a.hdr: data type: 6, wanted one with real numbers"),
    "no samples": ({"samples": None}, r"a.hdr: samples: missing, wanted an integer of at least 1"),
    "lines in words": ({"lines": "many"}, r"a.hdr: lines: 'many', wanted an integer"),
    "too long": ({"lines": 51}, r"a.img: 1050 bytes, wanted 1071 for 51 lines of 7 samples and 3 bands .*truncated"),
    "interleave": ({"interleave": "tiled"}, r"a.hdr: interleave: tiled, wanted bil, bip or bsq"),
    "byte order": ({"byte order": 2}, r"a.hdr: byte order: 2, wanted 0"),
    "compressed": ({"file compression": 1}, r"a.hdr: file compression: 1, wanted 0"),
    "bytes between lines": ({"major frame offsets": "{16, 0}"}, r"a.hdr: major frame offsets: 16, 0, wanted 0"),
    "names": ({"band names": "{a, b}"}, r"a.hdr: band names: 2 names, wanted 3"),
}


@pytest.mark.parametrize("what", HEADERS)
def test_bad_headers(tmp_path, what):
    header, wanted = HEADERS[what]
    path = write_image(tmp_path / "a.img", cube_of("u1"), **header)
    with pytest.raises(UserError, match=wanted):
        open_envi(path)


def test_bands_that_are_not_there(tmp_path):
    image = open_envi(write_image(tmp_path / "a.img", cube_of("u1")))
    for text, wanted in (
        (None, r"a.img: 3 bands, wanted one of them \(--band 2\)"),
        ("4", r"a.img: band '4': not in it, wanted 1 to 3"),
        ("1:half", r"a.img: band '1:half': weight 'half', wanted a number"),
    ):
        with pytest.raises(UserError, match=wanted):
            image.weights(text)
    with pytest.raises(UserError, match=r"b.img: no ENVI header beside it, wanted b.img.hdr or b.hdr"):
        (tmp_path / "b.img").write_bytes(b"x")
        open_envi(tmp_path / "b.img")


# ---- other formats


def write_tiff(path: Path, cube: np.ndarray, **profile) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        lines, samples, bands = cube.shape
        with rasterio.open(
            path, "w", driver="GTiff", width=samples, height=lines, count=bands, dtype=cube.dtype.name, **profile
        ) as file:
            file.write(np.moveaxis(cube, 2, 0))
            if bands == 3:
                file.descriptions = ("Red", "Green", "NIR")
    return path


@pytest.mark.parametrize("kind", ["u1", "u2"])
def test_a_tiff_and_a_raw_strip_give_the_lines_of_the_envi_image(tmp_path, capsys, kind):
    cube = cube_of(kind)
    out, times, poses = tmp_path / "o.mcap", str(write_times(tmp_path / "t.csv")), str(write_poses(tmp_path / "p.csv"))
    camera = ["--camera", str(write_camera(tmp_path / "camera.json")), "--line-times", times]
    tiff = write_tiff(tmp_path / "all.tif", cube, compress="deflate", tiled=True, blockxsize=16, blockysize=16)
    raw = tmp_path / "nadir.raw"
    raw.write_bytes(cube[..., 1].tobytes())
    files = f"F={tiff}@1,N={raw},B={tiff}@NIR"
    assert kind_of_path(tiff) == "lines"
    assert main(["import", poses, "-o", str(out), "--lines", files, "--raw", kind, *camera]) == 0
    for ccd, band in (("F", 0), ("N", 1), ("B", 2)):
        np.testing.assert_array_equal(pixels_of(out, ccd), cube[..., band])
    capsys.readouterr()
    # alone; big end first, pixels of a line stated
    raw.write_bytes(cube[..., 1].astype(">u2").tobytes() + b"abc")
    alone = ["--raw", ">u2", "--samples", "7", "--first-time", START, "--line-rate", "100"]
    assert main(["import", str(raw), "-o", str(out), *alone]) == 0
    assert (
        "nadir.raw: 3 bytes after the last of 50 lines of 7 samples of type >u2 (14 bytes)" in capsys.readouterr().out
    )
    np.testing.assert_array_equal(pixels_of(out, "N"), cube[..., 1])


def test_a_raw_image_that_says_its_ccd_line_is_an_input(tmp_path, monkeypatch):
    """It was of no known kind, as of a camera of several CCD lines --lines has to say which one it is."""
    cube, out = cube_of("u2", bands=1), tmp_path / "o.mcap"
    raw = tmp_path / "nadir.raw"
    raw.write_bytes(cube.tobytes())
    camera = ["--camera", str(write_camera(tmp_path / "camera.json"))]
    how = ["--raw", "u2", "--first-time", START, "--line-rate", "100", "-o", str(out), "-q"]
    monkeypatch.chdir(tmp_path)
    for name in (raw, "./nadir.raw"):
        assert main(["import", "nadir.raw", "--lines", f"N={name}", *camera, *how]) == 0
        np.testing.assert_array_equal(pixels_of(out, "N"), cube[..., 0])


def test_a_tiff_with_coordinates_is_told(tmp_path):
    place = {"crs": "EPSG:32632", "transform": rasterio.Affine(1, 0, 5e5, 0, -1, 5e6)}
    tiff = write_tiff(tmp_path / "a.tif", cube_of("u1", bands=1), **place)
    imported = read_any(tiff, options=Options(lines=LinesGiven((), first=(START, 100.0))))
    assert any("a.tif: has coordinates" in note for note in imported.notes)


def test_tiff_and_raw_strips_that_cannot_be(tmp_path, capsys):
    poses, camera = str(write_poses(tmp_path / "p.csv")), str(write_camera(tmp_path / "camera.json"))
    times, out = ["--line-times", str(write_times(tmp_path / "t.csv"))], tmp_path / "o.mcap"
    tiff = write_tiff(tmp_path / "a.tif", cube_of("u1"))
    cut = tmp_path / "cut.tif"
    cut.write_bytes(tiff.read_bytes()[:300])
    complex_tiff = write_tiff(tmp_path / "c.tif", np.ones((50, 7, 1), np.complex64))
    raw, empty = tmp_path / "a.raw", tmp_path / "empty.raw"
    raw.write_bytes(bytes(349))
    headed = write_image(tmp_path / "b.img", cube_of("u1", bands=1)).with_suffix(".raw")  # has the header of b.img
    headed.write_bytes(bytes(300))
    empty.write_bytes(bytes(3))
    for arguments, wanted in (
        (["--lines", f"F={tiff}"], "a.tif: 3 bands, wanted one of them (--band 2)"),
        (["--lines", f"F={tiff}@Blue"], "a.tif: band 'Blue': not in it, wanted 1 to 3 or one of Red, Green, NIR"),
        (["--lines", f"F={tiff}@1", "--camera", "ads40"], "a.tif: 7 samples, wanted 12000 as CCD line F"),
        (["--lines", f"F={cut}@1"], "cut.tif: "),
        (["--lines", f"F={complex_tiff}"], "c.tif: values of type complex64, wanted real numbers"),
        (["--lines", f"F={raw}"], "a.raw: no ENVI header beside it, wanted a.raw.hdr or a.hdr, a TIFF, or --raw TYPE"),
        (
            ["--lines", f"F={raw}", "--raw", "u1"],
            "a.raw: pixels of a line are not known, wanted --samples, or --camera",
        ),
        (["--lines", f"F={raw}", "--raw", "u1", "--camera", camera], "a.raw: 49 lines, but "),
        (["--lines", f"F={empty}", "--raw", "u1", "--camera", camera], "empty.raw: 3 bytes, wanted lines of 7 samples"),
        (["--lines", f"F={tiff}@1", "--samples", "7"], "--samples 7: wanted the pixels of a line, with --raw TYPE"),
        (["--raw", "u1"], "--raw is of images, wanted --lines VIEW=FILE with it"),
        (["--lines", f"F={tiff}@1", "--raw", "u2"], "a.tif: a TIFF, wanted no type u2: that is of files without"),
        (["--lines", f"F={headed}", "--raw", ">u2"], "b.raw: b.hdr beside it says what its values are, wanted no type"),
    ):
        more = ["--format", "csv"] if arguments == ["--raw", "u1"] else times
        assert main(["import", poses, "-o", str(out), *arguments, *more]) == 1, arguments
        err = capsys.readouterr().err
        assert wanted in err and err.count("\n") == 1 and not out.exists(), (arguments, err)


# ---- with times and poses


def test_three_views_and_poses_become_a_flight(tmp_path, capsys):
    cubes = {view: cube_of("u1", bands=1) + i for i, view in enumerate("FNB")}
    files = ",".join(f"{v}={write_image(tmp_path / f'{v}.img', cube)}" for v, cube in cubes.items())
    out = tmp_path / "o.mcap"
    more = ["--camera", str(write_camera(tmp_path / "camera.json")), "--strip", "S1"]
    times = str(write_times(tmp_path / "times.csv"))
    poses = str(write_poses(tmp_path / "poses.csv"))
    assert main(["import", poses, "-o", str(out), "--lines", files, "--line-times", times, *more]) == 0
    assert "sensor/lines/N" in capsys.readouterr().out
    for view, cube in cubes.items():
        np.testing.assert_array_equal(pixels_of(out, view), cube[..., 0])
    reader = RecordingReader(out)
    strips = [message.body for message in reader.messages(["configuration/strip"])]
    assert [(s.id, s.lines, s.ended) for s in strips] == [("S1", 50, False), ("S1", 50, True)]
    assert strips[0].first_line_time_ns == ns(START) and strips[0].line_rate_hz == pytest.approx(100.0, rel=1e-9)
    block = next(iter(reader.messages(["sensor/lines/F"])))
    assert block.stamp_ns == ns(START) + 90_000_000 and len(block.body.pixels) == 10
    assert block.body.times_ns()[3] == ns(START) + 30_000_000
    assert len(list(reader.messages(["trajectory/smoothed"]))) == 9


def test_an_image_alone_with_first_time_and_rate(tmp_path, capsys):
    path = write_image(tmp_path / "nadir.bil", cube_of("u2", bands=1), big=True)
    assert kind_of_path(path) == "lines" == kind_of_path(tmp_path / "nadir.hdr")
    out = tmp_path / "o.mcap"
    assert main(["import", str(path), "-o", str(out), "--first-time", START, "--line-rate", "80"]) == 0
    assert "image lines alone: no poses" in capsys.readouterr().out
    blocks = [message.body for message in RecordingReader(out).messages(["sensor/lines/N"])]
    assert blocks[1].time_ns == ns(START) + 100_000_000 and blocks[0].line_period_ns == 12_500_000
    camera = ["--camera", str(write_camera(tmp_path / "camera.json")), "--first-time", START, "--line-rate", "80"]
    assert main(["import", str(path), "-o", str(out), "--lines", f"B={path}", *camera]) == 0
    assert len(pixels_of(out, "B")) == 50
    other = write_image(tmp_path / "other.img", cube_of("u2", bands=1))
    assert main(["import", str(path), "-o", str(out), "--lines", f"B={other}", *camera]) == 1
    assert "nadir.bil: an image that --lines does not name" in capsys.readouterr().err
    day = ["--date", "2020-06-01"]
    assert main(["import", str(path), "-o", str(out), *camera, "--lines", f"B={path}", *day]) == 1
    assert "--date goes with --line-times" in capsys.readouterr().err
    assert main(["import", str(path), "-o", str(out)]) == 1
    assert "nadir.bil: times of its lines are missing, wanted --line-times CSV" in capsys.readouterr().err


def test_uneven_line_times_are_kept_and_told(tmp_path):
    path = write_image(tmp_path / "a.img", cube_of("u1", lines=4, bands=1))
    times = tmp_path / "t.csv"
    times.write_text("line;gps_s;week\n0;129618,00;2108\n1;129618,01;2108\n2;129618,02;2108\n3;129618,06;2108\n")
    imported = read_any(path, options=Options(lines=LinesGiven((), times=times)))
    blocks = [message.body for message in imported.messages if message.topic == "sensor/lines/N"]
    stamps = np.concatenate([block.times_ns() for block in blocks])
    assert (stamps - ns(START)).tolist() == [0, 10_000_000, 20_000_000, 60_000_000]
    assert any("off a constant rate of 50.0000 lines/s by 1.0 lines" in note for note in imported.notes)


def test_lines_that_do_not_fit(tmp_path, capsys):
    poses, times = str(write_poses(tmp_path / "poses.csv")), str(write_times(tmp_path / "times.csv"))
    camera = str(write_camera(tmp_path / "camera.json"))
    image = write_image(tmp_path / "a.img", cube_of("u1", bands=1))
    short = write_image(tmp_path / "b.img", cube_of("u1", lines=49, bands=1))
    (tmp_path / "gap.csv").write_text("line,time\n0,2020-06-01T12:00:00\n2,2020-06-01T12:00:01\n")
    (tmp_path / "word.csv").write_text("line,time\n0,noon\n1,2020-06-01T12:00:01\n")
    (tmp_path / "number.csv").write_text("line,time\n0,100.5\n1,101.5\n")
    (tmp_path / "back.csv").write_text("line,time_s\n0,100.5\n1,100.5\n")
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "none.csv").write_text("line,when\n0,100.5\n")
    rate = ["--line-rate", "100"]
    for arguments, wanted in (
        (["--lines", f"F={image}"], "a.img: times of its lines are missing, wanted --line-times CSV, or --first-time"),
        (["--lines", f"F={image}", *rate], "--line-rate without --first-time, wanted both"),
        (["--lines", f"F={image}", "--first-time", "noon", *rate], "--first-time: 'noon', wanted an ISO 8601 time"),
        (["--lines", f"F={image},F={image}", "--line-times", times], "wanted another view for each file"),
        (["--lines", f"F={image},N={short}", "--line-times", times], "b.img: 49 lines, wanted 50 as in a.img"),
        (["--lines", f"F={short}", "--line-times", times], "b.img: 49 lines, but"),
        (["--lines", f"X={image}", "--line-times", times, "--camera", camera], "CCD line 'X' is not in the camera"),
        (
            ["--lines", f"{image}", "--line-times", times, "--camera", camera],
            "its CCD line is not said, wanted --lines F=a.img",
        ),
        (["--lines", f"F={image}", "--line-times", times, "--camera", "ads40"], "a.img: 7 samples, wanted 12000"),
        (["--lines", f"F={image}", "--first-time", "2021-06-01", *rate], "strip a: lines from 2021-06-01T00:00:00Z"),
        (["--lines", f"F={image}", "--line-times", str(tmp_path / "gap.csv")], "gap.csv:3: line: 2, wanted 1"),
        (["--lines", f"F={image}", "--line-times", str(tmp_path / "word.csv")], "word.csv:2: time: 'noon', wanted an"),
        (
            ["--lines", f"F={image}", "--line-times", str(tmp_path / "number.csv")],
            "number.csv:2: time: 100.5 has no scale",
        ),
        (
            ["--lines", f"F={image}", "--line-times", str(tmp_path / "back.csv")],
            "back.csv:3: time_s: does not come after",
        ),
        (["--lines", f"F={image}", "--line-times", str(tmp_path / "empty.csv")], "empty.csv:1: time: column missing"),
        (["--lines", f"F={image}", "--line-times", str(tmp_path / "none.csv")], "none.csv:1: time: column missing"),
        (["--line-times", times], "--line-times is of images, wanted --lines VIEW=FILE with it"),
        (["--lines", f"F={image}", "--grey-range", "5", "5", "--line-times", times], "--grey-range 5 5, wanted two"),
    ):
        out = tmp_path / "o.mcap"
        assert main(["import", poses, "-o", str(out), *arguments]) == 1, arguments
        err = capsys.readouterr().err
        assert wanted in err and err.count("\n") == 1 and not out.exists(), (arguments, err)


def test_files_of_views():
    assert files_of(["F=f.img,N=all.img@2", "B=b.img"]) == (
        ("F", Path("f.img"), None), ("N", Path("all.img"), "2"), ("B", Path("b.img"), None)
    )  # fmt: skip


def test_a_day_is_honoured_or_refused(tmp_path):
    image = write_image(tmp_path / "a.img", cube_of("u1", lines=2, bands=1))
    times = tmp_path / "t.csv"
    times.write_text("line,gps_s\n0,129618\n1,129619\n")
    day = date(2020, 6, 1)
    lines = LinesGiven((), times=times, day=day)
    assert next(iter(read_any(image, options=Options(day=day, lines=lines)).messages)).stamp_ns == ns(START)
    with pytest.raises(UserError, match="GPS seconds of the week say Monday, but 2020-06-04 is a Thursday"):
        read_any(image, options=Options(lines=LinesGiven((), times=times, day=date(2020, 6, 4))))
    write_times(times, 2)
    with pytest.raises(
        UserError, match=r"t.csv: --date 2020-06-04, but its times begin on 2020-06-01; wanted the same"
    ):
        read_any(image, options=Options(lines=LinesGiven((), times=times, day=date(2020, 6, 4))))
