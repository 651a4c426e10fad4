"""A small corpus of the fuzz campaign (`bench/fuzz.py`): hostile files and messages, checksums right."""

from __future__ import annotations

import json
import os
import signal
import time
import warnings
from dataclasses import replace
from functools import partial

import fuzzing
import numpy as np
import pytest
import rasterio
from fuzzing import Campaign, edited, file_targets, run_files, run_node, run_sentences, sentence_of
from satellite_scenes import Truth, write_folder
from test_image_lines import cube_of, write_tiff

from triline.nodes.errors import UserError
from triline.nodes.formats.geotiff import read_heights
from triline.nodes.formats.height_raster import RasterFile
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import read_rpc_tags


def found(campaign: Campaign) -> list[str]:
    # what a busy machine takes long for is no hang; the campaign looks at that
    return [f"{f.target}: {f.what} {f.example[:200]!r}" for f in campaign.findings.values() if "hangs" not in f.what]


def _size(data: bytearray, place: int) -> int:
    """Size of a record of an MCAP file."""
    return int.from_bytes(data[place + 1 : place + 9], "little")


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    return file_targets(tmp_path_factory.mktemp("fuzz"))


def test_good_files_are_read(targets):
    for target in targets:
        target.read()


def test_changed_files_are_read_or_refused_in_one_line(targets):
    campaign = Campaign()
    for target in targets:
        run_files(target, campaign, 12, 3, time.process_time() + 600)
    assert not found(campaign)
    assert campaign.refused.total() > 0.5 * campaign.cases.total() > 100


def test_checksums_are_right_so_that_the_inside_is_reached(targets):
    recording = next(t for t in targets if t.name == "recording")
    data, place = bytearray(recording.good), 8
    while data[place] != 0x06 or b"sensor/attitude" not in data[place : place + 9 + _size(data, place)]:
        place += 9 + _size(data, place)
    data[place + 9 + _size(data, place) - 1] ^= 1  # the last byte of the chunk's last message
    broken = bytes(data)
    recording.path.write_bytes(broken)
    reader = fuzzing.RecordingReader(recording.path)
    with_damage = len(list(reader.sorted_messages()))
    recording.path.write_bytes(recording.checked(broken))
    inside = len(list(fuzzing.RecordingReader(recording.path).sorted_messages()))
    recording.path.write_bytes(recording.good)
    assert inside > with_damage  # the chunk is read; without its checksum it is left out


@pytest.mark.parametrize("name", fuzzing.SENTENCES)
def test_sentences_with_right_checksums_are_read_or_counted(name):
    campaign = Campaign()
    run_sentences(name, campaign, 300, 3, time.process_time() + 600)
    assert not found(campaign) and campaign.cases[name] == 300


@pytest.mark.parametrize("name", fuzzing.node_names())
def test_nodes_live_through_hostile_messages(name):
    campaign = Campaign()
    run_node(name, campaign, 300, 3, time.process_time() + 600)
    assert not found(campaign) and campaign.cases[name] >= 300


def test_the_campaign_finds_what_is_wrong():
    campaign = Campaign()

    def broken() -> None:
        raise KeyError("not told")

    def refused() -> None:
        raise UserError("one line")

    def two() -> None:
        raise UserError("one line\nand another")

    for work in (broken, broken, refused, two):
        campaign.run("x", b"x", work)
    assert campaign.cases["x"] == 4 and campaign.refused["x"] == 2
    assert sorted(f.times for f in campaign.findings.values()) == [1, 2]


def test_a_case_that_hangs_is_ended_and_found(monkeypatch):
    monkeypatch.setattr(fuzzing, "LONGEST_S", 0.2)
    monkeypatch.setattr(fuzzing, "STOP_S", 0.5)
    campaign = Campaign()

    def endless() -> None:
        while True:
            sum(range(1000))

    assert not campaign.run("x", b"endless", endless)
    (hangs,) = campaign.findings.values()
    assert "hangs" in hangs.what and "stopped" in hangs.what and hangs.example == b"endless"


def test_a_case_that_takes_memory_is_found():
    campaign = Campaign()
    assert campaign.run("x", b"small", lambda: bytes(bytearray(1_000_000)))
    assert campaign.run("y", b"large", lambda: bytes(bytearray(200_000_000)))
    (memory,) = (f for f in campaign.findings.values() if f.what.startswith("memory beyond"))
    assert memory.target == "y" and 150e6 < campaign.most_bytes["y"] < 1e9


def test_what_a_terminal_would_show_beside_the_one_line_is_found():
    campaign = Campaign()

    class Ignored:
        def __del__(self) -> None:
            raise KeyError("traceback out of a library")

    campaign.run("x", b"1", lambda: warnings.warn("of numbers", RuntimeWarning, stacklevel=1))
    campaign.run("x", b"2", lambda: warnings.warn("of numbers", RuntimeWarning, stacklevel=1), quiet=True)
    campaign.run("x", b"3", lambda: Ignored() and None)
    assert [f.example for f in campaign.findings.values()] == [b"1", b"3"]


def test_a_process_that_dies_is_a_finding_and_the_next_one_goes_on():
    campaign = Campaign()

    def work(part: Campaign, cases: int, number: int, until: float) -> None:
        for k in range(cases):
            number_of_signal = signal.SIGKILL if number == 3 and k == 2 else 0
            part.run("x", f"{number} {k}".encode(), partial(os.kill, os.getpid(), number_of_signal))
        part.run("memory", b"24 GB", lambda: bytearray(24_000_000_000))

    fuzzing.in_a_process(campaign, "x", work, 5, 3, 600.0)
    died, memory = campaign.findings.values()
    assert "SIGKILL" in died.what and died.example == b"3 2" and campaign.cases["x"] == 5
    assert memory.what.startswith("MemoryError")  # by the bound of the address space


def test_changes_and_checksums():
    assert edited(b"a,1,b\n", [(6, 0.3, 0.0, b"")]) == b"a,nan,b\n"
    assert edited(b"a\nb\n", [(4, 0.0, 0.0, b"")]) == b"a\na\nb\n"
    assert sentence_of(b"GPGLL,5057.970,N,00146.110,E,142451,A").endswith(b"*27\r\n")  # of the standard's examples


# ---- what the campaign has found


def test_a_year_too_large_for_a_date_is_no_sentence():
    campaign = Campaign()
    parser = fuzzing.NmeaParser(
        fuzzing.NmeaSettings.read(
            fuzzing.Keys(fuzzing.Path("f.toml"), {"address": "udp://:4001"}, "sensor[0]"), fuzzing.Path()
        ),
        lambda kind, text: campaign.cases.update([kind]),
    )
    assert parser.feed(sentence_of(b"GNZDA,092750.00,22,11,9223372036854775808,00,00")) == []
    assert campaign.cases["field missing"] == 1


def _json(target, change):
    content = json.loads(target.good)
    change(content)
    return json.dumps(content).encode()


def _pixels(camera):
    camera["lines"][0]["pixels"] = 2**31


def _table(camera):
    camera["lines"][0]["table"] = "9" * 400


def _found_times(target):
    """The good file, with a time that does not fit into 64 bits in its second row."""
    head, first, _, *rest = target.good.split(b"\n")
    return b"\n".join([head, first, b"1e18" + first[first.index(b"," if b"," in first else b"\t") :], *rest])


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("camera.json", lambda t: _json(t, _pixels), r"lines\[0\].pixels: 2147483648, wanted .* at most 1000000"),
        ("block: camera.json", lambda t: _json(t, _pixels), r"lines\[0\].pixels: 2147483648, wanted"),
        ("scene folder: camera.json", lambda t: _json(t, _table), r"lines\[0\].table: no file '999"),
        ("Resonon poses", _found_times, r"flight.lcf:3: time: 1e\+18, wanted GPS seconds since 1980"),
        ("sensor folder: imu.csv", _found_times, r"imu.csv:3: time_s: 1e\+18, wanted seconds"),
        ("sensor folder: gnss.csv", _found_times, r"gnss.csv:3: time_s: 1e\+18, wanted seconds"),
    ],
)
def test_files_that_the_campaign_found(targets, name, change, said):
    target = next(t for t in targets if t.name == name)
    campaign = Campaign()
    data = change(target)
    target.read()  # what a reader imports is not the memory of a file
    try:
        target.path.write_bytes(data)
        campaign.run(name, data, target.read, len(target.good))
        with pytest.raises(UserError, match=said):
            target.read()
    finally:
        target.path.write_bytes(target.good)
    assert not found(campaign) and campaign.refused[name] == 1


@pytest.mark.parametrize("read", [read_scene, RasterFile, read_heights])
def test_names_that_no_file_can_have_are_not_there(read, tmp_path):
    with pytest.raises(UserError, match="no such file"):
        read(tmp_path / ("9" * 400))


def test_times_of_a_scene_long_after_its_epoch_are_refused(tmp_path):
    folder = write_folder(tmp_path / "scene", Truth(lines=4000, samples=500))
    settings, attitude = folder / "scene.toml", folder / "attitude.csv"
    settings.write_text("[time]\nepoch = 2026-11-22T09:27:50Z\n" + settings.read_text().replace("[time]\n", ""))
    head, *rows = attitude.read_text().splitlines()
    place = head.split(",").index("time_utc")
    words = [row.split(",") for row in rows]
    for k, row in enumerate(words):
        row[place] = f"{k}" if k != 1 else "1e18"
    text = [head.replace("time_utc", "time_s"), *(",".join(row) for row in words)]
    attitude.write_text("\n".join(text) + "\n")
    with pytest.raises(UserError, match=r"attitude.csv:3: time_s: 1e\+18 s after the epoch"):
        read_scene(folder)


def test_tags_of_rpc_that_are_no_numbers_are_refused(tmp_path):
    tiff = write_tiff(tmp_path / "lines.tif", cube_of("u2"))
    tags = "".join(f'<MDI key="{key}">x</MDI>' for key in ("LINE_OFF", "SAMP_OFF", "LINE_NUM_COEFF"))
    (tmp_path / "lines.tif.aux.xml").write_text(f'<PAMDataset><Metadata domain="RPC">{tags}</Metadata></PAMDataset>')
    with pytest.raises(UserError, match=r"lines.tif: cannot be read as an image: "):
        read_rpc_tags(tiff)


@pytest.mark.parametrize("read", [None, read_heights, read_rpc_tags])
def test_a_damaged_tiff_shows_no_traceback_of_a_library(targets, read):
    tiff = next(t for t in targets if t.name == "TIFF lines")
    if read is not None:
        tiff = replace(tiff, read=partial(read, tiff.path))
    campaign = Campaign()
    try:
        for place in range(8, 200):  # among its tags, GDAL quotes some of them
            data = tiff.good[:place] + b"\x8d\xff" + tiff.good[place + 2 :]
            tiff.path.write_bytes(data)
            campaign.run(tiff.name, data, tiff.read, len(tiff.good))
    finally:
        tiff.path.write_bytes(tiff.good)
    assert not found(campaign) and campaign.refused[tiff.name] > 10


@pytest.mark.parametrize(
    "record",
    [
        b"LINES N S1 40 9223372036854775808 5000000 1 1 8\n\x07",
        b"LINES N S1 40 9199999999999999999 5000000000000 1 1 8\n\x07",
        b"LINES N S1 4294967295 1795339670000000000 5000000 1 1 8\n\x07",
        b"GNSS 9223372036854775808 47.9 11.1 1500 0.02 0.03 0.05\n",
    ],
)
def test_records_whose_times_do_not_fit_into_64_bits_are_counted(record):
    counts: list[str] = []
    parser = fuzzing.StreamParser(fuzzing.Clock(), lambda kind, text: counts.append(kind))
    assert not [x for x in parser.feed(record) if x.topic != ""] and "not readable" in counts


def _strip(**changes):
    """The strip of the flight that nodes are given, changed."""
    message = next(x for x in fuzzing.flown() if x.topic == "configuration/strip")
    body = type(message.body)()
    body.CopyFrom(message.body)
    for name, value in changes.items():
        setattr(body, name, value)
    return replace(message, body=body)


@pytest.mark.parametrize("name", ["matcher", "adjuster", "rectifier"])
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"line_rate_hz": 2147483647.0}, "2.14748e+09 lines a second, wanted 0.01 to 100000"),
        ({"line_rate_hz": 1e-300}, "1e-300 lines a second"),
        ({"line_rate_hz": float("nan")}, "nan lines a second"),
        ({"first_line_time_ns": 0}, "s after its message"),
        ({"lines": 2**31 - 1}, "more than a day"),
    ],
)
def test_strips_of_no_flight_take_no_memory(name, changes, said):
    node = fuzzing._made(name)
    for message in fuzzing.flown():
        if message.topic in ("configuration/project", "configuration/camera"):
            list(node.step(message))
    list(node.step(_strip(**changes)))
    assert node.counters["malformed"] == 1 and said in node.last_problem


def test_a_message_stamped_an_hour_ahead_takes_no_unknowns_for_the_hour():
    """The strip does not say how many lines it will have."""
    node = fuzzing._made("adjuster")
    flight = fuzzing.flown()
    for message in flight:
        if message.topic in node.inputs:
            list(node.step(_strip(lines=0) if message.topic == "configuration/strip" else message))
        if message.topic == "orientation/live" and message.stamp_ns > fuzzing.sample_messages.EPOCH_NS + 2 * 10**9:
            break
    ahead = next(x for x in flight if x.topic == "observation/control")
    before = len(node._window.state.numbers)
    list(node.step(replace(ahead, stamp_ns=message.stamp_ns + 3600 * 10**9)))
    assert before <= len(node._window.state.numbers) < before + 400 and not node.counters["failed"]


@pytest.mark.parametrize("field", [b"1e999", b"nan", b"-inf"])
def test_a_field_that_is_not_finite_is_counted(field):
    counts: list[str] = []
    keys = fuzzing.Keys(fuzzing.Path("f.toml"), {"address": "udp://:4001"}, "sensor[0]")
    parser = fuzzing.NmeaParser(fuzzing.NmeaSettings.read(keys, fuzzing.Path()), lambda kind, text: counts.append(kind))
    campaign = Campaign()
    for body in (
        b"GNRMC,092750.00,A,5321.6802,N,00630.3372,W,120.00," + field + b",221126,,,A",
        b"GNGST,092750.20,0.9,0.03,0.02,10.0," + field + b",0.034,0.055",
        b"GNHDT," + field + b",T",
        b"PASHR,092750.20,123.40,T,-0.83," + field + b",-0.01,0.029,0.024,0.059,2,1",
        b"PASHR,092750.40,123.40,T,-0.83,+0.42,-0.01,0.029," + field + b",0.059,2,1",
        b"GNGGA,092750.20,5321.6802,N,00630.3372,W,4,12,0.6," + field + b",M,55.2,M,,",
        b"GNGGA,092750.40,5321.6802,N,00630.3372,W,4,12," + field + b",61.7,M,55.2,M,,",
    ):
        campaign.run("NMEA", body, lambda body=body: parser.feed(sentence_of(body)))
    assert not found(campaign) and counts == ["field missing"] * 7


@pytest.mark.parametrize("sigma", [1e150, 1e200, 1e-300])
def test_ties_with_sigmas_of_no_measurement_do_not_spoil_the_others(sigma):
    node = fuzzing._made("adjuster")
    driver, ties, final = fuzzing.StepDriver(node), 0, 0
    for message in fuzzing.flown():
        if message.topic not in node.inputs:
            continue
        if message.topic == "observation/tie":
            body = type(message.body)()
            body.CopyFrom(message.body)
            body.images[0].sigma_line = body.images[0].sigma_sample = sigma
            message, ties = replace(message, body=body), ties + 1
        driver.step(message)
    final = [x for x in driver.finish() if x.topic == "orientation/final"]
    assert ties >= 3 and node.counters["sigma of no measurement"] == ties and not node.counters["failed"]
    assert final and all(np.isfinite(x.body.covariance).all() for x in final)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0])
def test_a_strip_without_line_rate_does_not_hold_the_viewer(rate_hz, monkeypatch):
    monkeypatch.setattr(fuzzing, "STOP_S", 4.0)
    node, campaign, residuals = fuzzing._made("viewer"), Campaign(), 0
    for message in fuzzing.flown():
        if message.topic == "configuration/strip":
            message = _strip(line_rate_hz=rate_hz, lines=0)
        if message.topic.startswith(tuple(name.rstrip("*") for name in node.inputs)):
            residuals += message.topic == "point/object" and len(message.body.residuals)
            campaign.run("viewer", b"", lambda message=message: node.step(message), 1_000_000, quiet=True)
    campaign.run("viewer", b"the end", node.finish, 1_000_000, quiet=True)
    assert residuals > 0 and not campaign.findings


def test_signalling_numbers_of_a_damaged_raster_are_no_heights(targets):
    """A NaN of another kind makes numpy warn where it is made a float64."""
    model = next(t for t in targets if t.name == "elevation model")
    campaign = Campaign()
    heights = np.full((30, 30), 500.0, dtype=np.float32)
    heights.view(np.uint32)[3, 4] = 0x7F800001
    with rasterio.open(model.path) as image:
        profile = image.profile | {"tiled": False, "compress": "none"}
    profile.pop("blockxsize"), profile.pop("blockysize")
    try:
        with rasterio.open(model.path, "w", **profile) as image:
            image.write(heights, 1)
        campaign.run(model.name, b"signalling", lambda: read_heights(model.path))
        z = read_heights(model.path).z_m
    finally:
        model.path.write_bytes(model.good)
    assert not found(campaign) and np.isnan(z).sum() == 1


def test_a_raster_that_is_damaged_inside_is_told_where(targets):
    raster = next(t for t in targets if t.name == "height raster")
    campaign = Campaign()
    place = raster.good.rfind(b"\x78\x9c")  # the last compressed tile
    try:
        raster.path.write_bytes(raster.good[: place + 4] + b"\xff" * 60 + raster.good[place + 64 :])
        campaign.run(raster.name, b"", raster.read)
        with pytest.raises(UserError, match=r"heights.tif: heights of rows \d+ to \d+, columns \d+ to \d+ cannot be"):
            raster.read()
    finally:
        raster.path.write_bytes(raster.good)
    assert not found(campaign)


@pytest.mark.parametrize("coefficient", [1e308, -1e308])
def test_polynomials_beyond_numbers_are_no_model(targets, coefficient):
    """The ratio of the largest coefficient to the smallest is no number, and no smallest denominator either."""
    functions = read_rpc_tags(next(t for t in targets if t.name == "RPC tags").path).to_image
    denominators = functions.coefficients.copy()
    denominators[1, :4] = 1e-300, coefficient, coefficient, -coefficient
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert replace(functions, coefficients=denominators).smallest_denominator() == 0.0


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("2025   1  13   0  60688.00    0.113000    0.313000\n", ":14: no row of the series C04"),
        ("2025   1  13   0  60688.00    nan         0.313000   0.0413000\n", "is no number"),
    ],
)
def test_days_without_a_value_of_earth_orientation_are_refused(targets, row, said):
    c04 = next(t for t in targets if t.name == "IERS C04")
    lines = c04.good.decode().splitlines(keepends=True)
    assert lines[13].split()[4] == "60688.00"
    lines[13] = row
    try:
        c04.path.write_text("".join(lines))
        with pytest.raises(UserError, match=said):
            c04.read()
    finally:
        c04.path.write_bytes(c04.good)


def test_a_strip_that_the_window_refused_is_not_followed():
    node = fuzzing._made("adjuster")
    for message in fuzzing.flown():
        if message.topic in node.inputs:
            list(node.step(message))
    strips, window = node._strips, node._window
    body = _strip(id="S9", line_rate_hz=-1.0).body
    with pytest.raises(ValueError, match="S9: line rate -1"):
        strips.begin(body, window.strips["S1"].end_s + 1.0, window)
    assert strips.hand_over(window) >= 0 and not node.counters["failed"]
    assert "S9" not in window.strips and "S1" in window.strips


@pytest.mark.parametrize("key", ["clock_offset_s", "delay_s"])
@pytest.mark.parametrize("value", [1e300, -1e300, 4e9, float("nan")])
def test_clocks_off_by_more_than_a_century_are_refused(key, value):
    keys = fuzzing.Keys(fuzzing.Path("flight.toml"), {key: value}, "sensor[0]")
    with pytest.raises(UserError, match=rf"flight.toml: sensor\[0\].{key}"):
        fuzzing.Clock.of(keys)
