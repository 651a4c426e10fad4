"""Who does the jobs: workers of this machine, or those of a Dask cluster. Neither knows what a job is good for."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from .plan import Job
from .work import Outcome, run


class Pool(Protocol):
    """Does jobs, as many at a time as it has workers."""

    def submit(self, job: Job, attempt: int, place: int) -> None:
        """Have a job done; of those that wait, those of a lower place go first."""
        ...

    def ended(self, timeout_s: float) -> list[Outcome]:
        """Jobs that have ended since the last call; waits for one, at most so long."""
        ...

    def workers(self) -> int:
        """How many work now."""
        ...

    def close(self) -> None:
        """End what still runs, and let go of all."""
        ...


class LocalPool:
    """Workers of this machine: a thread each, which starts a process a job and waits for it."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._stop = threading.Event()
        self._waiting: queue.PriorityQueue[tuple[int, int, Job, int]] = queue.PriorityQueue()
        self._ended: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        self._given = 0
        self._threads = ThreadPoolExecutor(workers, "worker")
        self._futures: list[Future[None]] = [self._threads.submit(self._work) for _ in range(workers)]

    def submit(self, job: Job, attempt: int, place: int) -> None:
        self._given += 1
        self._waiting.put((place, self._given, job, attempt))

    def ended(self, timeout_s: float) -> list[Outcome]:
        for future in self._futures:
            if future.done() and not self._stop.is_set():
                future.result()  # raises what went wrong in the thread
        found = []
        try:
            found.append(self._ended.get(timeout=timeout_s))
            while True:
                found.append(self._ended.get_nowait())
        except queue.Empty:
            return found

    def workers(self) -> int:
        return self._workers

    def close(self) -> None:
        self._stop.set()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _work(self) -> None:
        while not self._stop.is_set():
            try:
                _, _, job, _ = self._waiting.get(timeout=0.1)
            except queue.Empty:
                continue
            self._ended.put(run(job, self._stop.is_set))
