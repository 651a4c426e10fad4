"""A recording that nobody has processed, with the poses that the navigator makes of its sensors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from .. import registry
from ..config import build, load
from ..recording.reader import RecordingReader
from ..recording.runner import process
from ..recording.writer import RecordingWriter
from .process import NAVIGATOR, POSES, at_pace

#: What can be adjusted once there are poses; image lines want the matcher first.
_ADJUSTABLE = ("configuration/camera", "configuration/strip", "observation/tie")
_SENSORS = ("sensor/gnss",)


@contextmanager
def navigated(reader: RecordingReader, name: str, notes: list[str]) -> Iterator[RecordingReader]:
    """The recording itself, or one with poses as ``triline process`` makes them where it has none.

    Parameters
    ----------
    name : of the recording, for notes
    notes : gets a remark where the navigator had to work
    """
    wanted = not len(reader.select(POSES)) and all(len(reader.select([topic])) for topic in (*_ADJUSTABLE, *_SENSORS))
    if not wanted:
        yield reader
        return
    with TemporaryDirectory(prefix="triline-") as folder:
        made = Path(folder) / "navigated.mcap"
        node = build(registry.node_class(NAVIGATOR), at_pace(load(None, registry.names()), "throughput"))
        with RecordingWriter(made) as writer:
            process(
                reader, [node],
                lambda message: None if message.topic.startswith("sensor/lines/") else writer.write_raw(message),
            )  # fmt: skip
        notes.append(
            f"{name}: no trajectory in it: the navigator has made one of its sensors, as `triline process` does"
        )
        yield RecordingReader(made)
