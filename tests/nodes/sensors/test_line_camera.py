"""Image lines from files that grow and from folders of blocks."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from envi_files import write_camera

from triline.nodes.errors import UserError
from triline.nodes.formats.camera_json import read_camera
from triline.nodes.formats.keys import Keys
from triline.nodes.sensors.line_camera import GrowingTimes, LineCameraSettings, LineFiles

T = 1_795_339_670_000_000_000
START = "2026-11-22T09:27:50Z"
RATE = 100.0
IMAGE = np.random.default_rng(1).integers(0, 60000, (40, 3, 7)).astype("<u2")  # lines, bands, samples


def settings(at: Path, **table) -> LineCameraSettings:
    values = {"strip": "S7", "line_rate_hz": RATE, "samples": 7, "type": "u2", **table}
    return LineCameraSettings.read(Keys(at / "flight.toml", values, "sensor[0]"), at)


def header(path: Path, **keys) -> None:
    known = {"samples": 7, "lines": 0, "bands": 3, "data type": 12, "interleave": "bil", "byte order": 0} | keys
    path.with_suffix(".hdr").write_text("ENVI\n" + "".join(f"{key} = {value}\n" for key, value in known.items()))


def read(sensor: LineFiles, n: int):
    """The first messages, and the end of the strip; less where no more come in a minute."""
    stop, out, until = threading.Event(), [], time.monotonic() + 60
    for message in sensor.messages(stop):
        out += [] if message is None else [message]
        if len(out) == n or time.monotonic() > until:
            stop.set()
    return out


def test_a_bil_that_grows_gives_the_lines_of_all_its_bands(tmp_path):
    path = tmp_path / "all.bil"
    header(path)
    given = settings(tmp_path, images={"F": "all.bil@1", "N": "all.bil@2", "B": "all.bil@3"}, first_time=START)
    data, written = IMAGE.tobytes(), [0]

    def grow():
        """A piece that ends inside a line."""
        size = min(written[0] + 317, len(data))
        with path.open("ab") as file:
            file.write(data[written[0] : size])
        written[0] = size

    sensor = LineFiles(given)
    messages, stop = [], threading.Event()
    for message in sensor.messages(stop):
        grow() if message is None else messages.append(message)
        if sum(len(m.body.pixels) for m in messages if m.topic.startswith("sensor")) == 120:
            stop.set()
    begin, end = messages[0].body, messages[-1].body
    assert (begin.id, begin.first_line_time_ns, begin.line_rate_hz, begin.ended) == ("S7", T, RATE, False)
    assert (end.id, end.lines, end.ended) == ("S7", 40, True)
    for band, ccd in enumerate("FNB"):
        blocks = [m.body for m in messages if m.topic == f"sensor/lines/{ccd}"]
        np.testing.assert_array_equal(np.concatenate([b.pixels for b in blocks]), IMAGE[:, band])
        times = np.concatenate([b.times_ns() for b in blocks])
        np.testing.assert_array_equal(times, T + np.arange(40) * 10_000_000)
        assert len(blocks) > 3
    assert all(m.stamp_ns == m.body.times_ns()[-1] for m in messages if m.topic.startswith("sensor"))


def test_a_raw_file_with_its_own_line_times(tmp_path):
    (tmp_path / "n.raw").write_bytes(IMAGE[:20, 0].astype(">u2").tobytes())
    times = T + np.arange(20) * 10_000_000 + np.random.default_rng(2).integers(0, 999, 20)
    text = "line,time_s\n" + "".join(f"{i},{t // 10**9}.{t % 10**9:09d}\n" for i, t in enumerate(times))
    (tmp_path / "times.csv").write_text(text)
    given = settings(tmp_path, images={"N": "n.raw"}, line_times="times.csv", type=">u2", clock_offset_s=0.5)
    strip, *blocks = read(LineFiles(given), 3)[:3]
    np.testing.assert_array_equal(np.concatenate([m.body.pixels for m in blocks]), IMAGE[:20, 0])
    np.testing.assert_array_equal(np.concatenate([m.body.times_ns() for m in blocks]), times - 500_000_000)
    assert strip.body.first_line_time_ns == times[0] - 500_000_000


def test_line_times_in_words_come_as_fast_as_lines(tmp_path):
    """A millisecond for each was a whole processor at 1000 lines a second, and a minute after a minute's strip."""
    times = T + np.arange(4000, dtype=np.int64) * 1_000_123
    words = np.datetime_as_string(times.astype("datetime64[ns]"))
    (tmp_path / "times.csv").write_text("line,time\n" + "".join(f"{i},{w}Z\n" for i, w in enumerate(words)))
    read_in = GrowingTimes(tmp_path / "times.csv", pytest.fail)
    begun = time.process_time()
    read_in.read()
    assert time.process_time() - begun < 1.0
    np.testing.assert_array_equal(read_in.time_ns, times)


def test_a_second_band_of_a_raw_file_is_refused(tmp_path):
    """Nobody says that it has one; the program ended with a Python error."""
    (tmp_path / "n.raw").write_bytes(IMAGE[:20, 0].tobytes())
    sensor = LineFiles(settings(tmp_path, images={"N": "n.raw@2"}, first_time=START))
    with pytest.raises(UserError, match=r"n\.raw: band 2: no ENVI header beside it, so that it has one band"):
        read(sensor, 1)


def test_a_strip_that_goes_on_after_its_end_gets_another_name(tmp_path, monkeypatch):
    """Under the same name it was announced twice, and nodes that had ended it refused all that came then."""
    monkeypatch.setattr("triline.nodes.sensors.line_camera.STRIP_SILENT_S", 0.3)
    for ccd, band, n in (("F", 0, 20), ("N", 1, 18)):  # the one is two lines behind
        (tmp_path / f"{ccd}.raw").write_bytes(IMAGE[:n, band].tobytes())
    sensor = LineFiles(settings(tmp_path, images={"F": "F.raw", "N": "N.raw"}, first_time=START))
    messages, stop = [], threading.Event()
    for message in sensor.messages(stop):
        messages += [] if message is None else [message]
        if len(messages) and messages[-1].topic == "configuration/strip" and messages[-1].body.ended:
            for ccd, band in (("F", 0), ("N", 1)):
                (tmp_path / f"{ccd}.raw").write_bytes(IMAGE[:, band].tobytes())
        if sum(len(m.body.pixels) for m in messages if m.topic.startswith("sensor")) == 78:
            stop.set()
    strips = [m.body for m in messages if m.topic == "configuration/strip"]
    assert [(s.id, s.ended, s.lines) for s in strips] == [
        ("S7", False, 0), ("S7", True, 20), ("S7-2", False, 0), ("S7-2", True, 20)
    ]  # fmt: skip
    assert strips[2].first_line_time_ns == T + 20 * 10_000_000
    # the end is known when nothing more has come for 0.3 s; stamped with the last line it came after its turn
    stamp = next(m.stamp_ns for m in messages if m.topic == "configuration/strip" and m.body.ended)
    assert 0.8 < (stamp - T - 19 * 10_000_000) * 1e-9 < 5.0
    later = [m.body for m in messages if m.topic.startswith("sensor") and m.body.strip == "S7-2"]
    for ccd, band in (("F", 0), ("N", 1)):
        of = [b for b in later if b.ccd == ccd]
        np.testing.assert_array_equal(np.concatenate([b.pixels for b in of]), IMAGE[20:, band])
        assert of[0].first_line == 0
        times = np.concatenate([b.times_ns() for b in of])
        np.testing.assert_array_equal(times, T + np.arange(20, 40) * 10_000_000)
    assert dict(sensor.counters) == {"strip goes on": 1, "lines before their strip": 1}


def test_a_folder_of_blocks(tmp_path):
    folder = tmp_path / "blocks"
    folder.mkdir()
    for first in (0, 10, 20):
        for ccd, band in (("F", 0), ("N", 1)):
            path = folder / f"{ccd}_{first:06d}_{T + first * 10_000_000}.raw"
            path.write_bytes(IMAGE[first : first + 10, band].tobytes())
    (folder / "N_000030_1795339670300000000.raw.part").write_bytes(b"not yet whole")
    (folder / "nonsense.raw").write_bytes(b"1")
    (folder / f"N_000099_{T + 990_000_000}.raw").write_bytes(b"12345")
    sensor = LineFiles(settings(tmp_path, folder="blocks"))
    messages = read(sensor, 7)
    blocks = [m.body for m in messages if m.topic == "sensor/lines/N"]
    np.testing.assert_array_equal(np.concatenate([b.pixels for b in blocks]), IMAGE[:30, 1])
    assert [m.topic for m in messages[:3]] == ["configuration/strip", "sensor/lines/F", "sensor/lines/N"]
    assert messages[-1].body.ended and messages[-1].body.lines == 30
    assert dict(sensor.counters) == {"name of a block": 1, "size of a block": 1}


def test_a_file_that_cannot_be_read_for_a_moment_is_read_later(tmp_path):
    """As on a disk of another machine; the program ended as a fault of triline, and began again at the first line."""
    (tmp_path / "n.raw").write_bytes(IMAGE[:20, 0].tobytes())
    sensor = LineFiles(settings(tmp_path, images={"N": "n.raw"}, first_time=START))
    lines, stop = 0, threading.Event()
    for message in sensor.messages(stop):
        if message is not None and message.topic.startswith("sensor"):
            lines += len(message.body.pixels)
        if lines == 20 and (tmp_path / "n.raw").exists():
            (tmp_path / "n.raw").rename(tmp_path / "elsewhere")
        elif sensor.counters["not readable"] and not (tmp_path / "n.raw").exists():
            with (tmp_path / "elsewhere").open("ab") as file:
                file.write(IMAGE[20:, 0].tobytes())
            (tmp_path / "elsewhere").rename(tmp_path / "n.raw")
        elif lines == 40:
            stop.set()
    assert list(sensor.counters) == ["not readable"]
    assert sensor.last_problem == f"{tmp_path / 'n.raw'}: no such file or directory"


def test_a_block_that_is_taken_away_or_cannot_be_read_does_not_end_the_program(tmp_path, monkeypatch):
    folder = tmp_path / "blocks"
    folder.mkdir()
    for first in (0, 10, 20):
        (folder / f"N_{first:06d}_{T + first * 10_000_000}.raw").write_bytes(IMAGE[first : first + 10, 1].tobytes())
    read_bytes = Path.read_bytes

    def read_but_one(path: Path) -> bytes:
        if "_000010_" in path.name:
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", read_but_one)
    sensor = LineFiles(settings(tmp_path, folder="blocks"))
    stop, begun, blocks = threading.Event(), time.monotonic(), []
    for message in sensor.messages(stop):
        if message is not None and message.topic.startswith("sensor"):
            blocks.append(message.body)
        if time.monotonic() > begun + 0.5:
            stop.set()
    assert [b.first_line for b in blocks] == [0, 20]
    assert 1 < sensor.counters["not readable"] < 10  # tried again, and not without end


def test_an_image_that_is_begun_anew_gives_no_more_lines(tmp_path):
    """Its new lines had the times of those that it had held before, from where it was as long again."""
    path = tmp_path / "n.raw"
    path.write_bytes(IMAGE[:20, 0].tobytes())
    sensor = LineFiles(settings(tmp_path, images={"N": "n.raw"}, first_time=START))
    lines, waits, stop = 0, 0, threading.Event()
    for message in sensor.messages(stop):
        if message is None:
            waits += 1
            path.write_bytes(IMAGE[: 10 * waits, 0].tobytes())
        elif message.topic.startswith("sensor"):
            lines += len(message.body.pixels)
        if waits == 4:
            stop.set()
    assert lines == 20 and dict(sensor.counters) == {"image begun anew": 1}
    assert sensor.last_problem == f"{path} is shorter than the 20 lines that were read of it: no more of it is used"


def test_a_strip_that_another_one_ends_ends_at_the_first_lines_of_that(tmp_path):
    folder = tmp_path / "blocks"
    folder.mkdir()
    (folder / f"A_N_000000_{T}.raw").write_bytes(IMAGE[:10, 1].tobytes())
    (folder / f"B_N_000000_{T + 3_000_000_000}.raw").write_bytes(IMAGE[10:20, 1].tobytes())
    *_, ended, begun, block, _ = read(LineFiles(settings(tmp_path, folder="blocks")), 5)
    assert (ended.body.id, ended.body.ended, ended.body.lines) == ("A", True, 10)
    assert ended.stamp_ns == begun.stamp_ns == block.stamp_ns == T + 3_090_000_000


@pytest.mark.parametrize(
    ("table", "wanted"),
    [
        ({}, "sensor[0]: wanted either images"),
        ({"images": {"N": "n.raw"}}, "sensor[0]: times of the lines: wanted either first_time or line_times"),
        ({"folder": "b", "first_time": START}, "sensor[0]: the names of the blocks say their times"),
        ({"folder": "b", "type": "f4"}, "sensor[0].type: 'f4', wanted one of u1, u2, >u2"),
        ({"folder": "b", "line_rate_hz": 0}, "sensor[0].line_rate_hz: 0, wanted a number above 0"),
        ({"images": {"N": "n"}, "first_time": "noon"}, "sensor[0].first_time: 'noon', wanted an ISO 8601 time"),
    ],
)
def test_settings_that_cannot_be(tmp_path, table, wanted):
    with pytest.raises(UserError) as error:
        settings(tmp_path, **table)
    assert str(error.value).startswith(f"{tmp_path / 'flight.toml'}: {wanted}")


def test_the_camera_must_have_the_lines(tmp_path):
    write_camera(tmp_path / "camera.json")
    camera = read_camera(tmp_path / "camera.json", [])
    for images, samples, wanted in (({"X": "n.raw"}, 7, "CCD line 'X', wanted F, N, B"), ({"N": "n"}, 9, "wanted 7")):
        given = settings(tmp_path, images=images, first_time=START, samples=samples)
        keys = Keys(tmp_path / "flight.toml", {"images": images, "samples": samples}, "sensor[0]")
        with pytest.raises(UserError, match=wanted):
            given.check_camera(keys, camera)


def test_a_raw_file_whose_lines_have_no_length_is_told_before_the_flight(tmp_path):
    """`check` said that the folder is complete, and the sensor ended in flight."""
    write_camera(tmp_path / "camera.json")
    camera = read_camera(tmp_path / "camera.json", [])
    images = {"N": "n.raw"}
    given = settings(tmp_path, images=images, first_time=START, samples=0)
    keys = Keys(tmp_path / "flight.toml", {"images": images}, "sensor[0]")
    given.check_camera(keys, camera)  # the file is not there yet, nor is its header
    (tmp_path / "n.raw").write_bytes(b"")
    with pytest.raises(
        UserError, match=r"sensor\[0\].samples: missing; no ENVI header beside n.raw says how many pixels"
    ):
        given.check_camera(keys, camera)
    (tmp_path / "n.hdr").write_text("ENVI")
    given.check_camera(keys, camera)
    blocks = settings(tmp_path, folder="blocks", samples=0)
    with pytest.raises(UserError, match=r"sensor\[0\].samples: missing; no name of a block says how many pixels"):
        blocks.check_camera(Keys(tmp_path / "flight.toml", {"folder": "blocks"}, "sensor[0]"), camera)


@pytest.mark.parametrize(
    ("keys", "wanted"),
    [
        ({"data type": 4}, "data type: 4, wanted 1 or 12"),
        ({"interleave": "bsq"}, "interleave: bsq, wanted bil for an image that grows"),
        ({"bands": 1}, "band 2, wanted 1 to 1"),
        ({"samples": "x"}, "samples: 'x', wanted an integer"),
    ],
)
def test_headers_that_cannot_be(tmp_path, keys, wanted):
    path = tmp_path / "n.bil"
    header(path, **keys)
    path.write_bytes(IMAGE.tobytes())
    with pytest.raises(UserError, match=wanted):
        read(LineFiles(settings(tmp_path, images={"N": "n.bil@2"}, first_time=START)), 1)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("a,b\n0,1\n", "times.csv:1: 'a,b', wanted the columns line,time or line,time_s"),
    ],
)
def test_line_times_that_cannot_be(tmp_path, text, wanted):
    (tmp_path / "n.raw").write_bytes(IMAGE[:20, 0].tobytes())
    (tmp_path / "times.csv").write_text(text)
    with pytest.raises(UserError) as error:
        read(LineFiles(settings(tmp_path, images={"N": "n.raw"}, line_times="times.csv")), 1)
    assert wanted in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("column", "rows", "without", "wanted"),
    [
        ("time_s", {8: "8,6.95", 9: "9,6.96"}, (8, 9), "times.csv:11: '6.96' does not come after the line before it"),
        ("time_s", {8: "8,3600", 9: "9,3601"}, (8, 9), "times.csv:11: '3601' is not near the lines after it"),
        ("time_s", {0: "0,3600", 1: "1,3601"}, (0, 1), "times.csv:3: '3601' is not near the lines after it"),
        ("time_s", {0: "0,0"}, (0,), "times.csv:2: '0' is not near the lines after it"),
        ("time_s", {0: "0,x"}, (0,), "times.csv:2: 'x', wanted seconds since the Unix epoch"),
        ("time_s", {3: "3,99999999999"}, (3,), "times.csv:5: '99999999999', wanted seconds since the Unix epoch"),
        ("time", {8: "8,noon"}, (8,), "times.csv:10: 'noon', wanted an ISO 8601 time"),
        ("time_s", {8: "", 12: "2,7"}, (8, 12), "times.csv:15: '13,7.130000000', wanted line 12 and its time"),
        ("time_s", {8: "-,-,-"}, (8,), "times.csv:11: '9,7.090000000', wanted line 8 and its time"),
    ],
)
def test_lines_without_a_time_are_left_out_and_the_camera_goes_on(tmp_path, column, rows, without, wanted):
    """A clock that goes back for a moment ended the program, and again when it was started anew."""
    (tmp_path / "n.raw").write_bytes(IMAGE[:, 0].tobytes())
    times = 7_000_000_000 + np.arange(40, dtype=np.int64) * 10_000_000
    words = np.datetime_as_string(times.astype("datetime64[ns]"))
    written = [f"{t // 10**9}.{t % 10**9:09d}" for t in times] if column == "time_s" else [f"{w}Z" for w in words]
    whole = [rows.get(i, f"{i},{text}") for i, text in enumerate(written)]
    path = tmp_path / "times.csv"
    path.write_text("\n".join([f"line,{column}", *whole[:9]]) + "\n")  # the rest when that has been read
    sensor = LineFiles(settings(tmp_path, images={"N": "n.raw"}, line_times="times.csv"))
    stop, blocks, waits = threading.Event(), [], 0
    for message in sensor.messages(stop):
        if message is None:
            waits += 1
            if waits == 1:
                path.write_text("\n".join([f"line,{column}", *whole]) + "\n")
        elif message.topic == "sensor/lines/N":
            blocks.append(message.body)
        if waits == 3:
            stop.set()
    left = np.delete(np.arange(40), without)
    lines = np.concatenate([b.first_line + np.arange(len(b.pixels)) for b in blocks])
    np.testing.assert_array_equal(lines, left)
    np.testing.assert_array_equal(np.concatenate([b.pixels for b in blocks]), IMAGE[left, 0])
    np.testing.assert_array_equal(np.concatenate([b.times_ns() for b in blocks]), times[left])
    assert list(sensor.counters) == ["lines without a time"]
    assert wanted in sensor.last_problem


def test_lines_after_a_pause_are_another_strip_also_where_all_is_read_at_once(tmp_path):
    """A program that was started again read on in the strip that had ended: no tie points, no orientation."""
    for ccd, band in (("F", 0), ("N", 1)):
        (tmp_path / f"{ccd}.raw").write_bytes(IMAGE[:, band].tobytes())
    times = T + np.arange(40) * 10_000_000 + (np.arange(40) > 11) * 90_000_000_000
    text = "line,time_s\n" + "".join(f"{i},{t // 10**9}.{t % 10**9:09d}\n" for i, t in enumerate(times))
    (tmp_path / "times.csv").write_text(text)
    sensor = LineFiles(settings(tmp_path, images={"F": "F.raw", "N": "N.raw"}, line_times="times.csv"))
    messages = read(sensor, 13)
    strips = [m.body for m in messages if m.topic == "configuration/strip"]
    assert [(s.id, s.ended, s.lines) for s in strips] == [
        ("S7", False, 0), ("S7", True, 12), ("S7-2", False, 0), ("S7-2", True, 28)
    ]  # fmt: skip
    for ccd, band in (("F", 0), ("N", 1)):
        for strip, lines in (("S7", np.arange(12)), ("S7-2", np.arange(12, 40))):
            of = [m.body for m in messages if m.topic == f"sensor/lines/{ccd}" and m.body.strip == strip]
            np.testing.assert_array_equal(np.concatenate([b.times_ns() for b in of]), times[lines])
            np.testing.assert_array_equal(np.concatenate([b.pixels for b in of]), IMAGE[lines, band])
            assert of[0].first_line == 0
    assert dict(sensor.counters) == {"strip goes on": 1}
