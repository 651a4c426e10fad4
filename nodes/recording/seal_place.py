"""Where the seal of a recording stands; a module of its own, since `seal` imports libraries of certificates."""

from __future__ import annotations

from pathlib import Path

#: Ending of a seal, after the name of the recording.
ENDING = ".seal"


def seal_of(recording: Path) -> Path:
    """Where the seal of a recording stands."""
    return recording.with_name(recording.name + ENDING)
