"""Jobs of a mosaic: each writes one small result by rename, so that a second run does only what is missing."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..formats.new_file import new_file
from ..worker_pool import WorkerPool

#: A job whose process was lost is begun again so many times.
RETRIES = 3
#: Megabytes of blocks that GDAL may hold in a process; its own default is a share of the memory of the machine.
CACHE_MB = 32


@dataclass(frozen=True)
class Job:
    """A call ``work(*arguments)`` that leaves a file.

    Attributes
    ----------
    done : the file; where it is there, the job is done
    arguments : of the function; they are sent to another process
    """

    done: Path
    arguments: tuple[Any, ...]


def _begin_worker() -> None:
    os.environ["GDAL_CACHEMAX"] = str(CACHE_MB)


class Workers:
    """Processes that do jobs; they are started when they are first wanted, and end with the context.

    Parameters
    ----------
    number : of processes; with one, jobs are done in this process
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._pool: WorkerPool | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def run(self, work: Callable[..., None], jobs: list[Job], told: Callable[[float], None] | None = None) -> int:
        """Do what is not done; returns how many jobs were done already.

        A process that is lost (killed, out of memory) costs the jobs that were running, which are begun again.

        Raises
        ------
        UserError : of a job, or processes were lost again and again
        """
        missing = [job for job in jobs if not job.done.exists()]
        before = len(jobs) - len(missing)
        if self.number <= 1 or len(missing) <= 1:
            for k, job in enumerate(missing):
                work(*job.arguments)
                if told is not None:
                    told((before + k + 1) / len(jobs))
            return before
        for attempt in range(RETRIES + 1):
            if not missing:
                break
            try:
                self._in_processes(work, missing, len(jobs), told)
            except BrokenProcessPool:
                self._end()
                if attempt == RETRIES:
                    raise UserError(
                        f"a worker was lost {RETRIES + 1} times (killed, or out of memory): the same command goes on "
                        "with what is missing; with fewer --workers it takes less memory"
                    ) from None
            missing = [job for job in missing if not job.done.exists()]
        return before

    def _in_processes(
        self, work: Callable[..., None], jobs: list[Job], total: int, told: Callable[[float], None] | None
    ) -> None:
        if self._pool is None:
            self._pool = WorkerPool(self.number, _begin_worker, fresh=True)
        running = [self._pool.submit(work, *job.arguments) for job in jobs]
        try:
            for k, future in enumerate(as_completed(running)):
                future.result()
                if told is not None:
                    told((total - len(jobs) + k + 1) / total)
        except BaseException:
            for future in running:
                future.cancel()
            raise


def write_json(path: Path, values: Any) -> None:
    """A small table, by rename.

    Raises
    ------
    UserError : the file cannot be written
    """
    with new_file(path) as part:
        part.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def open_parts(folder: Path, plan: dict[str, Any]) -> bool:
    """Make the folder of the jobs' results; whether it goes on with what an earlier run of the same plan left.

    What a run with another plan left is removed.

    Raises
    ------
    UserError : the folder cannot be made, or has its name from something else
    """
    text = json.dumps(plan, indent=1, sort_keys=True) + "\n"
    told = folder / "plan.json"
    if folder.exists():
        if not folder.is_dir() or (any(folder.iterdir()) and not told.is_file()):
            raise UserError(f"{folder}: is there already and is not of a mosaic; wanted a name that is free")
        if told.is_file() and told.read_text(encoding="utf-8") == text:
            return True
        remove_parts(folder)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: {(error.strerror or str(error)).lower()}") from None
    with new_file(told) as part:
        part.write_text(text, encoding="utf-8")
    return False


def remove_parts(folder: Path) -> None:
    """Remove the results of jobs; the plan goes last, so that what a killed removal leaves is still known as ours."""
    for name in ("layers", "tones", "labels", "tiles"):
        inside = folder / name
        if inside.is_dir():
            for root, folders, files in os.walk(inside, topdown=False):
                for file in files:
                    (Path(root) / file).unlink(missing_ok=True)
                for sub in folders:
                    (Path(root) / sub).rmdir()
            inside.rmdir()
    for path in folder.iterdir():
        if path.is_file() and path.name != "plan.json":
            path.unlink()
    (folder / "plan.json").unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()
