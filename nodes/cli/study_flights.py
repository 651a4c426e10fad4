"""Simulated flights of a study: one as a recording through the nodes, and many of them one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TypeVar

from ..node import Message, Node
from ..recording.reader import RecordingReader
from ..recording.runner import process
from ..recording.writer import RecordingWriter
from ..worker_pool import WorkerPool
from .progress import progress

Case = TypeVar("Case")
Found = TypeVar("Found")

#: When simulated flights begin.
EPOCH_NS = 1_780_000_000_000_000_000


def processed(messages: Iterable[Message], nodes: Sequence[Node], folder: Path) -> Path:
    """The messages of a flight as a recording, and what nodes make of it: the recording of these, in a folder."""
    recording, out = folder / "flight.mcap", folder / "processed.mcap"
    with RecordingWriter(recording) as writer:
        for message in messages:
            writer.write(message)
    with RecordingWriter(out) as writer:
        process(RecordingReader(recording), nodes, writer.write_raw)
    return out


def each(fly: Callable[[Case], Found], cases: Sequence[Case], quiet: bool, jobs: int = 1) -> Iterator[Found]:
    """What ``fly`` finds of each case, in their order, on so many processes; with a bar that shows how far it is."""
    jobs = min(jobs, len(cases))
    with progress("flights", quiet) as tell, WorkerPool(jobs) if jobs > 1 else nullcontext() as pool:
        for done, found in enumerate((pool.map if pool else map)(fly, cases), 1):
            yield found
            if tell is not None:
                tell(done / len(cases))
