"""Processes of this machine that share work. Ctrl-C ends them without a word; the first process says it."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from types import TracebackType
from typing import Any


def cores() -> int:
    """Processors that this process may use; of a system that does not tell (macOS) those that there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerPool(ProcessPoolExecutor):
    """A pool whose processes die of Ctrl-C, which a terminal sends to them as well; what is left of its work when an
    error ends its context is not begun.

    Parameters
    ----------
    number : of processes; they are started when work is submitted
    begin : called with ``arguments`` in each process before its first work
    fresh : processes know nothing of this one. GDAL and BLAS have threads, which a forked process would lack
    """

    def __init__(
        self,
        number: int,
        begin: Callable[..., None] | None = None,
        arguments: tuple[Any, ...] = (),
        fresh: bool = False,
    ) -> None:
        context = multiprocessing.get_context("spawn") if fresh else None
        super().__init__(number, mp_context=context, initializer=_begin, initargs=(begin, arguments))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _interrupts_held():  # until a new process has begun
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, exc_type: type[BaseException] | None, exc_val: BaseException | None, exc_tb: TracebackType | None
    ) -> None:
        self.shutdown(wait=True, cancel_futures=exc_type is not None)


def _begin(begin: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    if begin is not None:
        begin(*arguments)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    held = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)
