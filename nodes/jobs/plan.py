"""What is to be done: the jobs of every flight, those whose result is there left out."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from .inputs import Source
from .records import is_finished, read_record
from .steps import PROCESSED, STEPS


@dataclass(frozen=True)
class Job:
    """One command over one recording; a worker needs no more than this.

    Attributes
    ----------
    flight, step : names
    folder : of the flight's results, absolute
    words : behind ``triline``, run in a folder of its own whose content is then moved to ``folder``
    made_of : what the result depends on: input, options, version
    """

    flight: str
    step: str
    folder: str
    words: tuple[str, ...]
    made_of: dict[str, Any] = field(hash=False)

    @property
    def key(self) -> tuple[str, str]:
        return self.flight, self.step


@dataclass(frozen=True)
class Plan:
    """The jobs of one flight, in order.

    Attributes
    ----------
    source : the recording
    jobs : all that were asked for, by step
    after : steps that have to be finished before one can begin
    finished : steps whose result is there
    """

    source: Source
    jobs: dict[str, Job]
    after: dict[str, tuple[str, ...]]
    finished: frozenset[str]


def plans(
    found: Iterable[Source], out: Path, wanted: Sequence[str], options: Mapping[str, tuple[str, ...]]
) -> list[Plan]:
    """The jobs of all flights.

    Parameters
    ----------
    found : recordings
    out : folder of results
    wanted : names of steps
    options : words that a step gets beside its own, by name
    """
    chosen = [name for name in STEPS if name in wanted]
    return [_plan(source, Path(os.path.abspath(out)) / source.name, chosen, options) for source in found]


def _plan(source: Source, folder: Path, chosen: Sequence[str], options: Mapping[str, tuple[str, ...]]) -> Plan:
    jobs: dict[str, Job] = {}
    after: dict[str, tuple[str, ...]] = {}
    for name in chosen:
        step, words = STEPS[name], options.get(name, ())
        first = step.after if step.after in chosen else ""
        before = jobs[first].made_of if first else _made_before(folder, step.after, source)
        read = str(folder / PROCESSED) if before else source.path
        made_of: dict[str, Any] = {
            "version": version("triline"),
            "words": list(words),
            "files": {word: _state(word) for word in words if os.path.isabs(word) and os.path.exists(word)},
        }
        made_of |= {"after": before} if before else _input(source)
        jobs[name] = Job(source.name, name, str(folder), tuple(step.words(read, words)), made_of)
        after[name] = (first,) if first else ()
    finished = frozenset(name for name, job in jobs.items() if is_finished(folder, name, job.made_of))
    return Plan(source, jobs, after, finished)


def _input(source: Source) -> dict[str, Any]:
    return {"input": Path(source.path).name, "bytes": source.size, "modified": source.modified}


def _made_before(folder: Path, step: str, source: Source) -> dict[str, Any] | None:
    """What the result of a step of an earlier run was made of, if it was made of this recording."""
    record = read_record(folder, step) if step else None
    if record is None or not isinstance(record["made_of"], dict):
        return None
    return record["made_of"] if _input(source).items() <= record["made_of"].items() else None


def _state(path: str) -> list[int]:
    stat = os.stat(path)
    return [stat.st_size, stat.st_mtime_ns]
