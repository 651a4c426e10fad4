"""Recordings of a URL: what is fetched, and that it is the same as of a file."""

from __future__ import annotations

import random
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT
from recording_file import chunk_spans, write_recording

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.node import Message
from triline.nodes.recording import mcap_scan as scan
from triline.nodes.recording.access import Recording
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.remote import PAGE, RemoteFile, path_of
from triline.nodes.recording.summary import holdings
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock

RECORDING = ROOT / "recordings" / "strip.mcap"
#: Image lines stand in blocks of so many bytes, between which ties are few.
LINES, PIXELS = 40, 5000


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A recording whose bytes are image lines for the most part."""
    grey = np.random.default_rng(1).integers(0, 255, (LINES, PIXELS), dtype=np.uint8)
    path = tmp_path_factory.mktemp("flown") / "flown.mcap"
    return write_recording(path, images_and_ties(grey))


def images_and_ties(grey):
    yield Message("configuration/project", 0, m.Project(name="p"), "simulator")
    for k in range(40):
        yield Message("sensor/lines/N", k * 10**8, LineBlock(grey, "N", "S1", k * LINES, k * 10**8, 1000), "camera")
        yield Message("observation/tie", k * 10**8 + 1, m.TiePoint(point=f"T{k}"), "matcher")


def url_of(path) -> str:
    return f"file://{path}"


def contents(reader, *topics: str):
    return [
        (raw.topic, raw.envelope, raw.receive_ns, bytes(raw.data))
        for raw in reader.raws(reader.sort(reader.select(topics or None)))
    ]


def test_messages_are_those_of_the_file():
    here, there = RecordingReader(RECORDING), RecordingReader(url_of(RECORDING), by_ranges=True)
    assert there.by_ranges
    assert contents(there) == contents(here)
    assert (there.library, there.complete, there.n_chunks, there.channels) == (
        here.library, here.complete, here.n_chunks, here.channels,
    )  # fmt: skip
    for name in ("chunk", "place", "channel", "sequence", "receive_ns", "stamp_ns"):
        assert np.array_equal(getattr(there.index, name), getattr(here.index, name)), name


def test_what_it_holds_is_told_from_the_ends_of_channels():
    here, there = (holdings(RecordingReader(path, by_ranges=True)) for path in (RECORDING, url_of(RECORDING)))
    assert (there.topics, there.span_ns, there.messages) == (here.topics, here.span_ns, here.messages)


def test_only_what_is_asked_for_is_fetched(flown):
    here, there = RecordingReader(flown), RecordingReader(url_of(flown), by_ranges=True)
    assert contents(there, "observation/tie") == contents(here, "observation/tie")
    assert there.remote is not None
    assert there.remote.fetched < 0.1 * there.size, "ties stand between blocks of image lines"
    before = there.remote.fetched
    assert contents(there, "observation/tie") == contents(here, "observation/tie")
    assert there.remote.fetched == before, "what is there is not fetched again"
    assert contents(there) == contents(here)
    assert there.remote.fetched <= there.size


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_compressed_chunks_are_fetched_whole_and_compared(tmp_path, compression, monkeypatch):
    """A chunk was unpacked anew for each message whose number was wanted: 4400 messages took 8 s."""
    grey = np.random.default_rng(1).integers(0, 255, (LINES, PIXELS), dtype=np.uint8)
    path = write_recording(tmp_path / "packed.mcap", images_and_ties(grey), compression=compression)
    here, there = RecordingReader(path), RecordingReader(url_of(path), by_ranges=True)
    unpacked, unpack = [], scan.chunk_content
    monkeypatch.setattr(scan, "chunk_content", lambda chunk: (unpacked.append(chunk), unpack(chunk))[1])
    numbers = there.sort(there.select(["observation/tie"]))
    assert len(numbers) == 40 and len(unpacked) <= there.n_chunks < 20
    assert contents(there, "observation/tie") == contents(here, "observation/tie")
    assert there.by_ranges


def test_whoever_wants_all_gets_all_with_its_checksums(flown, tmp_path):
    reader = RecordingReader(url_of(flown))
    assert not reader.by_ranges
    assert reader.remote is not None
    assert reader.remote.fetched == reader.size
    broken = bytearray(flown.read_bytes())
    broken[chunk_spans(flown)[3][0] + 5000] ^= 1
    (tmp_path / "broken.mcap").write_bytes(broken)
    assert len(RecordingReader(url_of(tmp_path / "broken.mcap")).damage) == 1


@pytest.mark.parametrize("cut", [1, 40, 5000, 300_000])
def test_one_without_an_end_is_fetched_whole(flown, tmp_path, cut):
    path = tmp_path / "cut.mcap"
    path.write_bytes(flown.read_bytes()[:-cut])
    here, there = RecordingReader(path), RecordingReader(url_of(path), by_ranges=True)
    assert not there.by_ranges
    assert contents(there) == contents(here)
    assert there.damage == here.damage


def test_damage_at_the_end_never_gives_wrong_messages(flown, tmp_path):
    """Bits of the index flip: the same messages come, or one line says what is wrong."""
    chance, whole = random.Random(3), flown.read_bytes()
    wanted = contents(RecordingReader(flown), "observation/tie")
    (_, first), *_ = chunk_spans(flown)
    path = tmp_path / "bits.mcap"
    lines = 0
    for _ in range(60):
        broken = bytearray(whole)
        where = chance.choice([range(first, first + 400), range(len(whole) - 2500, len(whole))])
        broken[chance.choice(where)] ^= 1 << chance.randrange(8)
        path.write_bytes(broken)
        try:
            found = contents(RecordingReader(url_of(path), by_ranges=True), "observation/tie")
        except UserError as error:
            lines += 1
            assert str(path) in str(error)
            continue
        assert [row[3] for row in found] == [row[3] for row in wanted]
    assert lines < 60


def test_a_file_that_became_shorter_is_told(flown, tmp_path):
    path = tmp_path / "shrinks.mcap"
    path.write_bytes(flown.read_bytes())
    file = RemoteFile(path_of(url_of(path)))
    path.write_bytes(b"x" * 10)
    with pytest.raises(UserError, match="did it change"):
        file.fetch(0, 3 * PAGE)


@pytest.mark.parametrize("name", ["none.mcap", "empty.mcap", "text.mcap", ""])
def test_what_is_no_recording_is_one_line(tmp_path, name):
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_text("hello, this is none")
    with pytest.raises(UserError) as told:
        Recording(url_of(tmp_path / name))
    assert url_of(tmp_path) in str(told.value)
    assert "\n" not in str(told.value)


def test_check_takes_a_url(flown, tmp_path, capsys):
    assert main(["check", url_of(flown)]) == 0
    assert capsys.readouterr().out.startswith(f"{url_of(flown)}: whole, ")
    longer = tmp_path / "longer.mcap"
    longer.write_bytes(flown.read_bytes() + b"more")
    assert main(["check", url_of(longer)]) == 1
    assert f"{url_of(longer)}: bytes behind the end of the recording" in capsys.readouterr().err
    assert main(["check", url_of(flown), "--authority", str(tmp_path)]) == 1
    assert "seals of recordings elsewhere are not looked at" in capsys.readouterr().err


def test_a_store_that_nothing_is_installed_for_is_one_line():
    with pytest.raises(UserError, match="no store that fsspec knows"):
        RecordingReader("nowhere://bucket/flight.mcap")
    code = (
        "import sys\nsys.modules['fsspec'] = None\nfrom triline.nodes.cli import main\n"
        "sys.exit(main(['info', 's3://bucket/flight.mcap']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1
    assert run.stderr == "triline info: s3://bucket/flight.mcap: needs fsspec: pip install 'triline[cluster]'\n"
