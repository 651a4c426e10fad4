"""A small corpus of the fuzz campaign (`bench/fuzz.py`): hostile files and messages, checksums right."""

from __future__ import annotations

import time

import fuzzing
import pytest
from fuzzing import Campaign, NodeTarget, edited, file_targets, run_files, run_nmea, run_node, sentence_of

from triline.nodes.errors import UserError


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
        run_files(campaign, target, 12, 3, time.monotonic() + 600)
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


def test_sentences_with_right_checksums_are_read_or_counted():
    campaign = Campaign()
    run_nmea(campaign, 300, 3, time.monotonic() + 600)
    assert not found(campaign) and campaign.cases["NMEA"] == 300


@pytest.mark.parametrize("name", fuzzing.node_names())
def test_nodes_live_through_hostile_messages(name):
    campaign = Campaign()
    run_node(campaign, NodeTarget(name), 300, 3, time.monotonic() + 600)
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
