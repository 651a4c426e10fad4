"""Lines with which a command reports what of a recording it does not use."""

from __future__ import annotations

import sys
import time

from ..convert import iso
from ..recording.reader import RecordingReader
from ..recording.summary import left_out_lines

#: A recorder that lives has written something more after so long, s: twice `recorder.FLUSH_S`, what it waits at most.
_LOOK_AGAIN_S = 0.6


def look_again(reader: RecordingReader) -> None:
    """Wait until it shows whether a file without an end is being written; one with an end is not waited for."""
    if not reader.complete and reader.remote is None and not reader.grows:
        time.sleep(_LOOK_AGAIN_S)


def tell_damage(command: str, reader: RecordingReader) -> None:
    """Print one line on standard error if what is left out makes the result incomplete, also with --quiet."""
    lines = left_out_lines(reader)
    if lines:
        print(f"triline {command}: {reader.path}: {'; '.join(lines)}", file=sys.stderr)


def tell_other_frame(command: str, reader: RecordingReader) -> None:
    """The same where results are in another local frame than that of the project."""
    begin_ns = reader.frame_begins_ns()
    if begin_ns:
        what = "poses and points are in another local frame and left out: the project became another one then"
        print(f"triline {command}: {reader.path}: before {iso(begin_ns)} {what}", file=sys.stderr)


def tell_other_camera(command: str, reader: RecordingReader) -> None:
    """The same where an operator let in another camera in flight: there is one for all lines."""
    begin_ns = reader.camera_begins_ns()
    if begin_ns:
        what = "nodes used another camera; lines of then are rectified with the same one as those after"
        print(f"triline {command}: {reader.path}: before {iso(begin_ns)} {what}", file=sys.stderr)
