"""The workers of a Dask cluster that runs already. Only this module imports Dask, and only where it is asked for.

What runs on a worker is `_run`: it starts the command as a process of its own and returns a few words. Results lie in
the folder of results and not on workers, so that a worker that is lost costs no more than what it was doing: a job that
is given out again finds what is finished.
"""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from importlib.metadata import version
from typing import Any

from ..errors import UserError
from .plan import Job
from .work import Outcome, run

#: What a machine lacks that cannot speak to a cluster.
INSTALL = "needs Dask: pip install 'triline[cluster]'"
#: So long is waited for a scheduler to answer, s.
_CONNECT_S = 15.0
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
        try:
            import distributed
        except ImportError:
            raise UserError(f"--scheduler {address}: {INSTALL}") from None
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said here
        self._dask: Any = distributed
        self._address = address
        try:
            self._client: Any = distributed.Client(
                address, timeout=_CONNECT_S, set_as_default=False, name="triline-batch"
            )
        except (OSError, TimeoutError, ValueError) as error:
            what = "nobody answers there" if isinstance(error, OSError | TimeoutError) else str(error)
            raise UserError(f"--scheduler {address}: {what}, wanted a Dask scheduler") from None
        self._ended = distributed.as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        self._given: dict[str, tuple[Job, Any]] = {}  # job and future by key
        self._away_s: float | None = None
        self._workers, self._counted_s = 0, -_COUNT_S
        try:
            self._check()
        except BaseException:
            self.close()
            raise

    def _check(self) -> None:
        """Refuse a cluster whose workers cannot do the same."""
        wanted = version("triline")
        for worker, held in self._client.run(_version).items():
            if held != wanted:
                has = f"triline {held}" if held else "no triline"
                raise UserError(f"--scheduler {self._address}: worker {worker} has {has}, wanted {wanted} as here")

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
        return UserError(
            f"--scheduler {self._address}: the scheduler is gone; what is finished is kept, the same command goes on"
        )

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


def _version() -> str:
    """The version of triline on a worker, "" without one."""
    try:
        return version("triline")
    except Exception:
        return ""


def _run(job: Job) -> Outcome:
    """On a worker: do a job for as long as the cluster wants it."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def unwanted() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    return run(job, unwanted)
