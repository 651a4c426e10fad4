"""Recordings of every version of the schemas are read, with the values that were written then."""

from __future__ import annotations

import tomllib

import pytest
import sample_messages
from places import ROOT

from triline.nodes import cli
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import findings
from triline.schemas import codec
from triline.schemas.image_lines import LineBlock

FOLDER = ROOT / "recordings" / "schemas"
#: Topics that a version did not have yet.
LATER: dict[str, set[str]] = {"0.1.0": set(), "0.2.0": set()}


def test_there_is_a_recording_of_this_version_and_of_all_before():
    this = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert {path.stem for path in FOLDER.glob("*.mcap")} == LATER.keys() and this in LATER


@pytest.mark.parametrize("version", LATER)
def test_every_topic_of_a_version_is_read(version, capsys):
    path = FOLDER / f"{version}.mcap"
    reader = RecordingReader(path)
    assert findings(reader) == []
    read = {message.topic: message.body for message in reader.sorted_messages()}
    assert set(sample_messages.names()) - read.keys() == LATER[version]
    for topic, body in read.items():
        wanted = sample_messages.body(topic, 3)
        if isinstance(body, LineBlock):
            assert (body.pixels == wanted.pixels).all() and body.first_line == wanted.first_line
        else:
            assert codec.encode(body) == codec.encode(wanted), topic
    assert cli.main(["info", str(path)]) == 0
    assert "sensor/gnss" in capsys.readouterr().out
