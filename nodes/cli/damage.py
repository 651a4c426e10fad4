"""The line with which a command reports a damaged recording that it can still work on."""

from __future__ import annotations

import sys

from ..recording.reader import RecordingReader
from ..recording.summary import damage_lines


def tell_damage(command: str, reader: RecordingReader) -> None:
    """Print one line on standard error if damage makes the result incomplete, also with --quiet."""
    lines = damage_lines(reader)
    if lines:
        print(f"triline {command}: {reader.path}: {'; '.join(lines)}", file=sys.stderr)
