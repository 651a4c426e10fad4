"""The workers of a Dask cluster that runs already (`dask_cluster`), as a pool for jobs.

What runs on a worker is `_run`: it starts the command as a process of its own and returns a few words. Results lie in
the folder of results and not on workers, so that a worker that is lost costs no more than what it was doing: a job that
is given out again finds what is finished.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

from ..dask_cluster import connect, current_worker
from ..errors import UserError
from .plan import Job
from .work import Outcome, run

#: So long may a cluster be away before it is taken for lost, s.
_LOST_S = 20.0
#: Time between two questions after the number of workers, s.
_COUNT_S = 2.0


class DaskPool:
    """Has jobs done by a Dask cluster.

    Parameters
    ----------
    address : of the scheduler, ``tcp://HOST:PORT``

    Raises
    ------
    UserError : Dask is not installed, nobody answers there, or the workers have another triline
    """

    def __init__(self, address: str) -> None:
        self._dask, self._client = connect(address, "triline-batch")
        self._address = address
        self._ended = self._dask.as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        self._given: dict[str, tuple[Job, Any]] = {}  # job and future by key
        self._away_s: float | None = None
        self._workers, self._counted_s = 0, -_COUNT_S

    def submit(self, job: Job, attempt: int, place: int) -> None:
        key = f"triline-{job.flight}-{job.step}-{attempt}-{time.time_ns()}"
        future = self._client.submit(_run, job, key=key, pure=False, retries=0, priority=-place)
        self._given[key] = job, future
        self._ended.add(future)

    def ended(self, timeout_s: float) -> list[Outcome]:
        until = time.monotonic() + timeout_s
        while True:
            found = [self._outcome(future, result) for future, result in self._ended.next_batch(block=False)]
            self._watch()
            if found or time.monotonic() > until:
                return found
            time.sleep(0.05)

    def workers(self) -> int:
        if time.monotonic() - self._counted_s > _COUNT_S and self._client.status == "running":
            with suppress(Exception):  # a scheduler that is lost is told of elsewhere
                self._workers = len(self._client.nthreads())
            self._counted_s = time.monotonic()
        return self._workers

    def close(self) -> None:
        """Cancel what waits and what runs; workers end the processes of cancelled jobs."""
        with suppress(Exception):
            if self._given and self._client.status == "running":
                self._client.cancel([future for _, future in self._given.values()], force=True)
        with suppress(Exception):
            self._client.close(timeout=3)

    def _watch(self) -> None:
        """Raise UserError where the scheduler has been away for long."""
        if self._client.status == "running":
            self._away_s = None
            return
        now = time.monotonic()
        self._away_s = self._away_s or now
        if self._client.status == "closed" or now - self._away_s > _LOST_S:
            raise self._lost()

    def _lost(self) -> UserError:
        return UserError(f"--scheduler {self._address}: the scheduler is gone")

    def _outcome(self, future: Any, result: Any) -> Outcome:
        job, _ = self._given.pop(future.key)
        future.release()
        if isinstance(result, Outcome):
            return result
        if isinstance(result, tuple):  # of an error: its type, itself, where
            result = result[1]
        if isinstance(result, self._dask.CancelledError):
            raise self._lost()
        if isinstance(result, self._dask.KilledWorker):
            reason = "the workers that had it were lost, one after the other (out of memory?)"
            return Outcome(job.flight, job.step, False, reason=reason, again=True)
        what = " ".join(f"{type(result).__name__}: {result}".split())
        return Outcome(job.flight, job.step, False, reason=what, again=True)


def _run(job: Job) -> Outcome:
    """On a worker: do a job for as long as the cluster wants it."""
    worker = current_worker()
    key = worker.get_current_task()

    def unwanted() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    return run(job, unwanted)
