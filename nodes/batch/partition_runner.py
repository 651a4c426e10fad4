"""Partitions of a block in files, and the processes or the Dask cluster that work on them."""

from __future__ import annotations

import os
import pickle
import resource
import secrets
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

from ...solver.partitioned.runner import Runner, Store
from ..dask_cluster import connect
from ..errors import UserError
from ..worker_pool import WorkerPool

T = TypeVar("T")

#: Results of partitions that may wait for each worker, beside the one it works on.
AHEAD = 1
#: Times that a partition is tried again after its worker has died.
RETRIES = 3


class FolderStore:
    """Objects as files of a folder that all workers see; see `solver.partitioned.runner.Store`.

    Parameters
    ----------
    folder : an empty folder that is made if it is not there, readable by its owner alone
    """

    def __init__(self, folder: Path):
        self.folder = folder
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.pickle"

    def save(self, name: str, value: Any) -> None:
        """Write by renaming, so that no reader ever meets half of it."""
        path = self._path(name)
        part = path.with_suffix(f".{os.getpid()}-{secrets.token_hex(4)}")
        with part.open("wb") as file:
            pickle.dump(value, file, protocol=5)
        os.replace(part, path)

    def load(self, name: str) -> Any:
        with self._path(name).open("rb") as file:
            return pickle.load(file)

    def remove(self, name: str) -> None:
        self._path(name).unlink(missing_ok=True)


def _work(task: Callable[..., T], store: Store, key: int, arguments: tuple[Any, ...]) -> tuple[T, int, int]:
    """Do a task; its result, the process and its largest resident set so far in kB."""
    result = task(store, key, *arguments)
    return result, os.getpid(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class _Counted(Runner):
    """What runners in other processes have in common.

    Attributes
    ----------
    peak_mb : largest resident set of each worker by its process
    """

    def __init__(self, store: FolderStore):
        super().__init__(store)
        self.peak_mb: dict[str, float] = {}

    def _note(self, worker: str, peak_kb: int) -> None:
        self.peak_mb[worker] = max(self.peak_mb.get(worker, 0.0), peak_kb / 1024)


class ProcessRunner(_Counted):
    """Processes on this machine. One that dies is replaced, and its partition done again.

    Parameters
    ----------
    store : where partitions lie
    workers : number of processes
    """

    def __init__(self, store: FolderStore, workers: int):
        super().__init__(store)
        self.workers = workers
        self._pool = WorkerPool(workers, fresh=True)

    def results(
        self, task: Callable[..., Any], keys: Sequence[int], arguments: Callable[[int], tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        todo, tries = list(range(len(keys)))[::-1], dict.fromkeys(range(len(keys)), 0)
        running: dict[Future[Any], int] = {}
        while todo or running:
            try:
                while todo and len(running) < self.workers * (1 + AHEAD):
                    place = todo[-1]
                    job = self._pool.submit(_work, task, self.store, keys[place], arguments(keys[place]))
                    running[job] = todo.pop()
                done = [job for job in wait(running, return_when=FIRST_COMPLETED).done if not job.exception()]
                broken = [job for job in running if job.done() and job.exception()]
                for job in broken:
                    error = job.exception()
                    if error is not None and not isinstance(error, BrokenProcessPool):
                        raise error
            except BrokenProcessPool:
                done, broken = [job for job in running if job.done() and not job.exception()], list(running)
            for job in done:
                result, process, peak = job.result()
                self._note(str(process), peak)
                yield running.pop(job), result
            if broken:
                again = [running.pop(job) for job in list(running)]
                for place in again:
                    tries[place] += 1
                    if tries[place] > RETRIES:
                        raise UserError(f"partition {keys[place]}: the process that works on it ended {RETRIES} times")
                todo += sorted(again, reverse=True)
                self._pool.shutdown(wait=False, cancel_futures=True)
                self._pool = WorkerPool(self.workers, fresh=True)

    def close(self) -> None:
        """End the processes."""
        self._pool.shutdown(cancel_futures=True)

    def processes(self) -> list[int]:
        """Of the workers."""
        return list(self._pool._processes)


class DaskRunner(_Counted):
    """Workers of a Dask cluster, which see the folder of the store under the same path.

    Parameters
    ----------
    store : where partitions lie
    scheduler : address, ``tcp://HOST:PORT``

    Raises
    ------
    UserError : Dask is not installed, nobody answers at the address, there are no workers, or they have another
        triline or do not see the folder
    """

    def __init__(self, store: FolderStore, scheduler: str, timeout_s: float = 20.0):
        super().__init__(store)
        self._dask, self._client = connect(scheduler, "triline-adjust", timeout_s)
        word = secrets.token_hex(8)
        store.save("word", word)
        found = self._client.run(_read_word, store.folder)
        if not found:
            raise UserError(f"--scheduler {scheduler}: the cluster has no workers")
        for worker, read in found.items():
            if read != word:
                raise UserError(
                    f"--scheduler: worker {worker} does not see {store.folder}; "
                    "--scratch names a folder that all workers share"
                )

    def results(
        self, task: Callable[..., Any], keys: Sequence[int], arguments: Callable[[int], tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        of_workers: Any = self._client.nthreads()
        threads = sum(of_workers.values())
        most, following = max(2, threads * (1 + AHEAD)), 0
        running: dict[Any, int] = {}
        arrived = self._dask.as_completed([], loop=self._client.loop, with_results=False, raise_errors=False)
        tries = [0] * len(keys)

        def submit(place: int) -> None:
            key = keys[place]
            name = f"{task.__name__}-{key}-{secrets.token_hex(6)}"
            job = self._client.submit(_work, task, self.store, key, arguments(key), key=name, pure=False)
            running[job] = place
            arrived.add(job)

        while following < min(most, len(keys)):
            submit(following)
            following += 1
        for job in arrived:
            place = running.pop(job)
            try:  # a result that was lost with the worker that held it is worked out anew, and waited for
                result, process, peak = job.result()
            except Exception as error:
                if type(error).__name__ != "KilledWorker":
                    raise
                tries[place] += 1
                if tries[place] > RETRIES:
                    raise UserError(f"partition {keys[place]}: every worker that was given it died") from None
                submit(place)
                continue
            job.release()
            self._note(str(process), peak)
            if following < len(keys):
                submit(following)
                following += 1
            yield place, result

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()


def _read_word(folder: Path) -> object:
    try:
        return FolderStore(folder).load("word")
    except OSError:
        return None
