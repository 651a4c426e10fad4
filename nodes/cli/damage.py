"""What commands say of a damaged recording that they work on all the same."""

from __future__ import annotations

import sys

from ..recording import RecordingReader
from ..recording_summary import damage_lines


def tell_damage(command: str, reader: RecordingReader) -> None:
    """One line on standard error if something is missing in the result, quiet or not."""
    lines = damage_lines(reader)
    if lines:
        print(f"triline {command}: {reader.path}: {'; '.join(lines)}", file=sys.stderr)
