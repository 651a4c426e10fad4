"""One job: the command in a process of its own, its results moved into place, its record written last.

The process ends with the one that started it, whichever way that ends: its standard input is a pipe that nobody else
holds, and `end_with_parent` waits for the end of it. So nothing works on when a worker was killed, and a job that is
given to another worker has the machine for itself.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from ..recording.remote import AWAY
from .plan import Job
from .records import is_finished, record_of, write_record

#: Set for a process that ends with the one that started it.
VARIABLE = "TRILINE_JOB"
#: How the folders begin in which jobs work before their results are moved.
WORKING = ".job-"
#: Time between two looks at whether a job is still wanted, s.
_LOOK_S = 0.2


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Attributes
    ----------
    flight, step : names of the job
    good : whether its result is there
    seconds : that it took
    reason : why it is not good: the last line that the command wrote
    again : whether it may go well another time: it was killed, or the store of its input was away
    stopped : it was told to end
    """

    flight: str
    step: str
    good: bool
    seconds: float = 0.0
    reason: str = ""
    again: bool = False
    stopped: bool = False
    attempts: int = field(default=1, compare=False)


def end_with_parent() -> None:
    """In a process that `run` has started: end at once when the one that started it has ended."""

    def watch() -> None:
        with suppress(OSError):
            while os.read(0, 1):
                pass
        os.kill(os.getpid(), signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def run(job: Job, unwanted: Callable[[], bool] = lambda: False) -> Outcome:
    """Do a job, unless it is done.

    Parameters
    ----------
    job : what to do
    unwanted : told now and then whether to end before the job is done; nothing is left of it then
    """
    folder, held = Path(job.folder), version("triline")
    if held != job.made_of["version"]:  # a worker that came later
        reason = f"a worker has triline {held}, wanted {job.made_of['version']}"
        return Outcome(job.flight, job.step, False, reason=reason, again=True)
    if is_finished(folder, job.step, job.made_of):
        return Outcome(job.flight, job.step, True)
    begun = time.monotonic()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        working = Path(tempfile.mkdtemp(prefix=f"{WORKING}{job.step}-", dir=folder))
    except OSError as error:
        return Outcome(job.flight, job.step, False, reason=f"{error.filename}: {(error.strerror or '').lower()}")
    try:
        return _in_folder(job, folder, working, begun, unwanted)
    except OSError as error:
        reason = f"{error.filename or folder}: {(error.strerror or str(error)).lower()}"
        return Outcome(job.flight, job.step, False, time.monotonic() - begun, reason)
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _in_folder(job: Job, folder: Path, working: Path, begun: float, unwanted: Callable[[], bool]) -> Outcome:
    log, told = working / f"{job.step}.log", working / f"{job.step}.json"
    with open(log, "wb") as err, open(told, "wb") as out:
        err.write(("triline " + " ".join(job.words) + "\n").encode())
        err.flush()
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "triline.nodes.cli", *job.words],
            cwd=working, stdin=subprocess.PIPE, stdout=out, stderr=err, start_new_session=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", VARIABLE: "1"},
        )  # fmt: skip
        try:
            stopped = _wait(process, unwanted)
        finally:
            _kill(process)
    seconds = time.monotonic() - begun
    if stopped:
        return Outcome(job.flight, job.step, False, seconds, "stopped", stopped=True)
    if process.returncode == 0:
        _publish(job, folder, working, seconds)
        return Outcome(job.flight, job.step, True, seconds)
    record_of(folder, job.step).unlink(missing_ok=True)
    os.replace(log, folder / log.name)
    reason, killed = _reason(job, folder / log.name, process.returncode)
    return Outcome(job.flight, job.step, False, seconds, reason, again=killed or f": {AWAY} " in reason)


def _wait(process: subprocess.Popen[bytes], unwanted: Callable[[], bool]) -> bool:
    """Wait for the end of a process; returns whether it was not wanted any more before."""
    while True:
        try:
            process.wait(_LOOK_S)
            return False
        except subprocess.TimeoutExpired:
            if unwanted():
                return True


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and all that it started."""
    if process.poll() is None:
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _publish(job: Job, folder: Path, working: Path, seconds: float) -> None:
    """Move the results into place, and say that they are."""
    record_of(folder, job.step).unlink(missing_ok=True)
    names = sorted(p.name for p in working.iterdir())
    for name in names:
        new, target = working / name, folder / name
        if target.is_dir():  # a folder cannot be put in the place of one that is not empty
            os.replace(target, Path(tempfile.mkdtemp(prefix=WORKING, dir=working)) / name)
        os.replace(new, target)
    write_record(folder, job.step, job.made_of, [name for name in names if not name.endswith(".log")], seconds)


def _reason(job: Job, log: Path, code: int) -> tuple[str, bool]:
    """Why a command failed, and whether it was killed."""
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return f"ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else ""), True
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[1:] if line.strip()]
    last = lines[-1].strip() if lines else f"exit code {code}, and no word of it"
    return last.removeprefix(f"triline {job.step}: "), False


def remove_working_folders(folders: Iterable[Path]) -> None:
    """Remove what jobs left that were killed together with their workers; no job may be running."""
    for folder in set(folders):
        for left in folder.glob(WORKING + "*"):
            shutil.rmtree(left, ignore_errors=True)
