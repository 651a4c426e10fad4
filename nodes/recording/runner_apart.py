"""An iterator that runs ahead in a process of its own, so that two processors share the work of a run over a recording.

What it gives comes in batches, in its order, so nothing depends on which process is faster.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from multiprocessing.connection import Connection
from typing import Generic, TypeVar

from ..errors import UserError
from ..garbage_collection import RareCollections

T = TypeVar("T")

#: Items of a batch, and batches that wait before the process ahead waits.
BATCH, WAITING = 2000, 24
#: What tells a program to end.
_ENDING = (signal.SIGINT, signal.SIGTERM)


class Ahead(Generic[T]):
    """Iterates over the batches of what another process makes.

    Parameters
    ----------
    make : gives what is iterated over; called in the other process, which has a copy of all that is there now
    name : of who runs there, for messages
    """

    def __init__(self, make: Callable[[], Iterable[T]], name: str) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, there = context.Pipe(duplex=False)
        self._name = name
        self._process = context.Process(target=_work, args=(there, self._connection, make), daemon=True)
        held = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)  # whoever is ended in between would leave it behind
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
        there.close()

    @staticmethod
    def possible() -> bool:
        """Whether this system can do it, and has a second processor for it."""
        return "fork" in multiprocessing.get_all_start_methods() and multiprocessing.cpu_count() > 1

    def __iter__(self) -> Iterator[list[T]]:
        """
        Raises
        ------
        UserError : the process has ended before it was through
        """
        while True:
            try:
                batch: list[T] | UserError | None = self._connection.recv()
            except (EOFError, OSError):
                self._process.join(1.0)
                code = self._process.exitcode
                raise UserError(f"the process of the {self._name} has ended (exit code {code})") from None
            if batch is None:
                return
            if isinstance(batch, UserError):
                raise batch
            yield batch

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.terminate()
        self._process.join()
        self._connection.close()


def _work(connection: Connection, other: Connection, make: Callable[[], Iterable[T]]) -> None:
    """The process ahead: makes batches, which a thread of it sends, so that making does not wait for sending."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends this one
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
    other.close()
    made: queue.Queue[list[T] | UserError | None] = queue.Queue(WAITING)
    sender = threading.Thread(target=_send, args=(connection, made), daemon=True)
    sender.start()
    collections = RareCollections()
    items = iter(make())
    try:
        while batch := list(islice(items, BATCH)):
            made.put(batch)
            collections.if_due()
    except UserError as error:
        made.put(error)
    made.put(None)
    sender.join()


def _send(connection: Connection, made: queue.Queue[list[T] | UserError | None]) -> None:
    try:
        while True:
            batch = made.get()
            connection.send(batch)
            if batch is None:
                return
    except OSError:  # nobody listens any more: the first process has ended, or is about to end this one
        os._exit(1)
