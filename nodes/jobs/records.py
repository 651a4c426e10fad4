"""The record of a finished job: it stands beside the result, is written last, and says what the result was made of."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

#: Ending of a record, after the name of its step.
ENDING = ".done.json"


def record_of(folder: Path, step: str) -> Path:
    """Where the record of a step stands."""
    return folder / (step + ENDING)


def write_record(folder: Path, step: str, made_of: dict[str, Any], outputs: list[str], seconds: float) -> None:
    """Say that a job is finished; its outputs are in place.

    Parameters
    ----------
    made_of : what the result depends on, as JSON has it: see `plan.Job.made_of`
    outputs : names in the folder
    seconds : that the job took
    """
    sizes = {name: _size(folder / name) for name in outputs}
    content = {"step": step, "made_of": made_of, "outputs": sizes, "seconds": round(seconds, 3)}
    write_whole(record_of(folder, step), json.dumps(content, indent=2) + "\n")


def read_record(folder: Path, step: str) -> dict[str, Any] | None:
    """The record of a step whose outputs are as they were written; None where there is none."""
    try:
        record = json.loads(record_of(folder, step).read_text(encoding="utf-8"))
        outputs = record["outputs"]
        record["made_of"]  # a record without it is none
        if all(_size(folder / name) == size for name, size in outputs.items()):
            return record
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return None


def is_finished(folder: Path, step: str, made_of: dict[str, Any]) -> bool:
    """Whether the result is there, and made of the same."""
    record = read_record(folder, step)
    return record is not None and record["made_of"] == made_of


def write_whole(path: Path, text: str) -> None:
    """Write a file that has its name only when it is complete; one that is there is replaced."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(part, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _size(path: Path) -> int:
    """Bytes of a file, of a folder those of its files."""
    if path.is_dir():
        return sum(p.stat().st_size for p in sorted(path.rglob("*")) if p.is_file())
    return path.stat().st_size
