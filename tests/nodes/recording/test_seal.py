"""Signed recordings: what was altered is named, whoever altered it."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections import Counter
from pathlib import Path

import pytest
import sample_messages as sample
from bus_rig import here
from places import ROOT

from triline.nodes.bus.authority import Authority
from triline.nodes.errors import UserError
from triline.nodes.node import Message
from triline.nodes.recorder.recorder import Recorder
from triline.nodes.recording.seal import verify
from triline.nodes.recording.seal_place import seal_of
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage


@pytest.fixture(scope="module")
def authority(tmp_path_factory) -> Authority:
    made = Authority.create(tmp_path_factory.mktemp("keys") / "survey")
    made.certify("aircraft1", "aircraft", ["10.0.0.1"])
    made.certify("aircraft2", "aircraft", ["10.0.0.2"])
    return made


@pytest.fixture
def recording(tmp_path, authority) -> Path:
    """Written by the recorder in three parts, each signed."""
    return recorded(tmp_path / "flight.mcap", authority.folder / "aircraft1")


def _next(numbers: Counter[str], message: Message) -> int:
    numbers[message.topic] += 1
    return numbers[message.topic] - 1


def recorded(path: Path, bundle: Path, close: bool = True) -> Path:
    recorder = Recorder(str(path), sign=str(bundle))
    recorder.start()
    messages, numbers = sample.flight(0.6), Counter()
    messages = [m for m in messages if m.topic != "observation/control"]
    for part in (messages[:50], messages[50:120], messages[120:]):
        recorder.take(
            [
                RawMessage(
                    m.topic, Envelope(m.stamp_ns, m.source, _next(numbers, m), 1), codec.encode(m.body), m.stamp_ns
                )
                for m in part
            ]
        )
        recorder._flushed_s = 0.0  # it is time for it
        recorder.tend()
    if close:
        recorder.close()
    return path


def test_a_revocation_does_not_touch_seals_as_the_page_says(tmp_path, authority, capsys):
    page = " ".join((ROOT / "docs" / "security.md").read_text(encoding="utf-8").split())
    assert "revocations and the last day of a certificate do not count" in page
    bundle = authority.certify("lost", "aircraft", ["10.0.0.3"])
    before = recorded(tmp_path / "before.mcap", bundle)
    authority.revoke("lost")
    for signed in (before, recorded(tmp_path / "after.mcap", bundle)):
        assert here("check", signed, "--authority", authority.folder) == 0
        assert "signed by 'lost' of 'survey'" in capsys.readouterr().out


def test_a_signed_recording_is_whole_and_says_by_whom(recording, authority, capsys):
    seal = verify(recording, authority.folder / "certificate.pem")
    assert seal is not None and seal.altered == [] and seal.signatures >= 4
    assert (seal.signer, seal.authority) == ("aircraft1", "survey")
    assert here("check", recording, "--authority", authority.folder) == 0
    assert "signed by 'aircraft1' of 'survey'" in capsys.readouterr().out
    assert here("info", recording) == 0
    assert "nothing was altered" in capsys.readouterr().out


def test_a_message_changed_with_all_checksums_right_is_found_and_its_place_named(recording, capsys):
    data = bytearray(recording.read_bytes())
    place, changed = 8, False
    while place + 9 < len(data) and not changed:
        kind, size = data[place], struct.unpack_from("<Q", data, place + 1)[0]
        first = place + 9 + 40
        if kind == 0x06 and b"sensor/attitude" in data[first : place + 9 + size]:
            data[place + 9 + size - 1] ^= 1  # the last byte of a message
            struct.pack_into("<I", data, place + 9 + 24, zlib.crc32(data[first : place + 9 + size]))
            changed = True
            inside = place
        place += 9 + size
    assert changed
    recording.write_bytes(data)
    seal = verify(recording)
    assert seal is not None and len(seal.altered) == 1
    first, last = (int(word) for word in seal.altered[0].split()[1:4:2])
    assert first <= inside < last and "altered after they were signed" in seal.altered[0]
    assert here("check", recording) == 1
    assert "not as 'aircraft1' signed it: bytes" in capsys.readouterr().err
    assert here("info", recording) == 0
    assert "altered: bytes" in capsys.readouterr().out


def _without(lines: list[str], i: int) -> list[str]:
    return lines[:i] + lines[i + 1 :]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: _without(lines, 2), "or a signature was taken out"),
        (lambda lines: lines[:-1], "are not signed"),
        (lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]], "out of order|taken out"),
        (lambda lines: [*lines[:2], lines[2].replace('"to": ', '"to": 1'), *lines[3:]], "cut off|altered"),
        (lambda lines: [*lines[:2], lines[2].replace('"hash": "', '"hash": "00'), *lines[3:]], "is not of who signed"),
        (lambda lines: [*lines[:2], "[" * 5000, *lines[3:]], "is not of who signed"),
    ],
)
def test_a_seal_that_was_changed_is_no_seal_of_the_recording(recording, change, words):
    path = seal_of(recording)
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    seal = verify(recording)
    assert seal is not None
    assert any(re.search(words, line) for line in seal.altered), seal.altered


def test_the_end_cannot_be_cut_off_nor_anything_be_put_behind(recording):
    data = recording.read_bytes()
    recording.write_bytes(data[: len(data) // 2])
    assert "cut off" in verify(recording).altered[-1]
    recording.write_bytes(data + b"more")
    assert verify(recording).altered == [f"4 bytes from {len(data)} on are not signed"]


def test_a_recorder_that_was_killed_leaves_a_seal_of_what_was_written(tmp_path, authority):
    path = recorded(tmp_path / "killed.mcap", authority.folder / "aircraft1", close=False)
    assert verify(path).altered == ["the seal has no end: the recorder was killed, or the end was taken off"]


def test_who_signs_must_be_certified_by_the_authority_that_is_asked_for(recording, tmp_path, authority, capsys):
    other = Authority.create(tmp_path / "other")
    with pytest.raises(UserError, match="another authority than"):
        verify(recording, other.folder / "certificate.pem")
    head, *rest = seal_of(recording).read_text().splitlines()
    facts = json.loads(head)  # somebody else's certificate in place of the signer's
    facts["certificate"] = (authority.folder / "aircraft2" / "certificate.pem").read_text()
    seal_of(recording).write_text("\n".join([json.dumps(facts), *rest]) + "\n")
    assert "is not of who signed" in verify(recording).altered[0]
    for text in ("", "{}", "[" * 100_000, '{"triline_seal": 1, "certificate": 5}', '{"triline_seal": 9}'):
        seal_of(recording).write_text(text)
        assert here("check", recording) == 1 and "seal" in capsys.readouterr().err, text[:10]
    seal_of(recording).unlink()
    assert verify(recording) is None
    assert here("check", recording, "--authority", authority.folder) != 0
    assert "not signed" in capsys.readouterr().err


def test_a_bundle_that_is_none_is_refused_before_anything_is_recorded(tmp_path):
    with pytest.raises(UserError, match="no such bundle"):
        Recorder(str(tmp_path / "a.mcap"), sign=str(tmp_path / "nothing"))
