"""``triline batch``: many recordings through the single commands, on workers of this machine or of a Dask cluster."""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..bus.folder_lock import locked
from ..errors import UserError
from ..formats.json_text import json_text
from ..formats.new_file import refuse_unless_folder
from ..jobs.driver import Progress, add_recorded, drive, progress_of
from ..jobs.inputs import flown_twice, sources
from ..jobs.plan import Plan, plans
from ..jobs.pools import LocalPool, Pool
from ..jobs.steps import STEPS, USUAL
from ..jobs.work import Outcome, remove_working_folders
from ..terminal import drawing, plain, redraws
from ..worker_pool import cores

EXAMPLE = """triline batch season/ -o results --workers 4
  triline batch 'season/*/flight.mcap' -o results --do process,adjust,analyze --with 'adjust --snoop --plots'
  triline batch s3://flights/2026 -o results --scheduler tcp://10.0.0.5:8786"""

#: Time between two plain lines of progress, s.
_LINE_PERIOD_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "inputs", nargs="+", metavar="INPUT",
        help="recordings: files, folders with all below them, patterns, @FILE with one a line; also URLs (s3://, sftp://)",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="one folder a recording in it")
    parser.add_argument(
        "--do", default=",".join(USUAL), metavar="STEPS",
        help=f"comma-separated, of {', '.join(STEPS)} (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--with", dest="options", action="append", default=[], metavar="'STEP OPTIONS'",
        help="options of a step, as its command takes them: --with 'process --pace throughput' (may be given again)",
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="jobs at a time on this machine (default: one a core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="tcp://HOST:PORT of a Dask cluster that runs already")
    parser.add_argument(
        "--retries", type=int, default=3, metavar="N",
        help="times that a job is done again that was killed, or whose store failed (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--list", action="store_true", help="say what there is to do, and do nothing")


def run(args: argparse.Namespace) -> int:
    begun = time.monotonic()
    workers = cores() if args.workers is None else args.workers
    if workers < 1:
        raise UserError(f"--workers {args.workers}: wanted 1 at least")
    if args.retries < 0:
        raise UserError(f"--retries {args.retries}: wanted 0 at least")
    wanted = _steps(args.do)
    options = _options(args.options, wanted)
    refuse_unless_folder(args.output)
    found = sources(args.inputs, args.output)
    notes = flown_twice(found)
    if not args.quiet:
        for note in notes:  # before the work, which may take hours
            print(f"triline batch: note: {plain(note)}", file=sys.stderr, flush=True)
    if args.list:
        return _list(plans(found, args.output, wanted, options), args)
    with locked(args.output):
        planned = plans(found, args.output, wanted, options)
        progress = progress_of(planned)
        lost = _work(planned, progress, workers, args) if progress.total else None
        result = _results(planned, progress, args.output, time.monotonic() - begun, notes)
    _tell(result, args)
    if lost:
        print(f"triline batch: {lost}", file=sys.stderr)
    return 1 if lost or progress.failed or progress.blocked else 0


def _work(planned: Sequence[Plan], progress: Progress, workers: int, args: argparse.Namespace) -> str | None:
    """Do what there is to do; returns why it has ended before the end, if it has."""
    remove_working_folders(Path(job.folder) for plan in planned for job in plan.jobs.values())
    pool: Pool
    if args.scheduler:
        from ..jobs.cluster import DaskPool

        pool = DaskPool(args.scheduler)
    else:
        pool = LocalPool(min(workers, progress.total))
    lost = None
    try:
        with _interruptible(), _told(progress, pool, args) as told:
            drive(planned, pool, args.retries, progress, told)
    except KeyboardInterrupt:
        lost = "interrupted"
    except UserError as error:
        lost = str(error)
    finally:
        pool.close()
        remove_working_folders(Path(job.folder) for plan in planned for job in plan.jobs.values())
    if lost is None:
        return None
    add_recorded(planned, progress)
    return f"{lost}; {_finished(progress)}, the same command goes on from there"


def _steps(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in STEPS:
            raise UserError(f"--do {name}: no such step, wanted some of {', '.join(STEPS)}")
    if not names:
        raise UserError(f"--do: wanted some of {', '.join(STEPS)}")
    return names


def _options(given: Sequence[str], wanted: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The words for each step, files among them by absolute paths; what a command would refuse is refused now."""
    from . import parse

    found: dict[str, tuple[str, ...]] = {}
    for text in given:
        try:
            name, *words = shlex.split(text)
        except ValueError as error:
            raise UserError(f"--with {text!r}: {str(error).lower()}") from None
        if name not in wanted:
            raise UserError(f"--with {text!r}: wanted one of the steps first: {', '.join(wanted)}")
        for word in words:
            if word.split("=")[0] in ("-o", "--output", "--json", "--processes", "-h", "--help"):
                raise UserError(f"--with {text!r}: {word} is set by `triline batch`")
        found[name] = (*found.get(name, ()), *map(_absolute, words))
    for name, words in found.items():
        args = parse(STEPS[name].words("recording.mcap", words))
        named = getattr(args, "recording", getattr(args, "input", None))
        if [str(path) for path in (named if isinstance(named, list) else [named])] != ["recording.mcap"]:
            raise UserError(f"--with '{name} {' '.join(words)}': names another input")
        config = getattr(args, "config", None)
        if config is not None and not config.is_file():  # each job would fail of it, one after the other
            raise UserError(f"--with '{name} {' '.join(words)}': {config}: no such file")
    return found


def _absolute(word: str) -> str:
    """A word that names a file or folder, by its absolute path: jobs work in folders of their own."""
    option, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
    if any(c in value for c in "./" + os.sep) and os.path.exists(value):
        return option + equals + os.path.abspath(value)
    return word


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGINT and SIGTERM end the work in order, also where the shell had them ignored."""

    def end(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _told(progress: Progress, pool: Pool, args: argparse.Namespace) -> Iterator[Callable[[Outcome | None], None]]:
    """What is called with each job that has ended: a bar on a terminal, lines elsewhere; failures at once."""
    if redraws(sys.stderr) and not (args.quiet or args.json):
        with _bar(progress, pool) as told:
            yield told
        return
    begun = last = time.monotonic()

    def line(outcome: Outcome | None) -> None:
        nonlocal last
        if outcome is not None and not outcome.good and not args.json:
            print(_failure(outcome), file=sys.stderr, flush=True)
        now = time.monotonic()
        if outcome is None and now - last >= _LINE_PERIOD_S and not (args.quiet or args.json):
            last = now
            working = f"{progress.running} given out, {_workers(pool.workers())}"
            told = f"{progress.ended} of {progress.total} jobs, {working}, {_rate(progress, now - begun)}"
            print(told.removesuffix(", "), file=sys.stderr, flush=True)

    yield line


@contextmanager
def _bar(progress: Progress, pool: Pool) -> Iterator[Callable[[Outcome | None], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    # the bar's own estimate looks back half a minute, in which no long job may end
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("jobs"), TimeElapsedColumn(),
        TextColumn("{task.fields[rate]}"),
    )  # fmt: skip
    with Bar(*columns, console=Console(file=drawing(sys.stderr)), transient=True) as bar:
        begun = time.monotonic()
        task = bar.add_task(_workers(pool.workers()), total=progress.total, rate="")

        def told(outcome: Outcome | None) -> None:
            if outcome is not None and not outcome.good:
                bar.console.print(plain(_failure(outcome)), markup=False, highlight=False)
            rate = _rate(progress, time.monotonic() - begun)
            bar.update(task, completed=progress.ended, description=_workers(pool.workers()), rate=rate)

        yield told


def _rate(progress: Progress, seconds: float) -> str:
    """Jobs a minute, and the time that the rest takes at this rate; "" before any job has ended."""
    if not progress.ended:
        return ""
    left = seconds / progress.ended * (progress.total - progress.ended)
    return f"{60.0 * progress.ended / seconds:.1f} a minute, {_clock(left)} left"


def _workers(n: int) -> str:
    return "1 worker" if n == 1 else f"{n} workers" if n else "no worker yet"


def _failure(outcome: Outcome) -> str:
    tries = f" ({outcome.attempts} attempts)" if outcome.attempts > 1 else ""
    return f"{outcome.flight}: {outcome.step} failed{tries}: {outcome.reason}"


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02}:{int(seconds) % 60:02}"


def _finished(progress: Progress) -> str:
    good = progress.earlier + sum(outcome.good for outcome in progress.outcomes.values())
    return f"{good} of {progress.total + progress.earlier} jobs are finished and kept"


def _list(planned: Sequence[Plan], args: argparse.Namespace) -> int:
    rows = [
        {"flight": plan.source.name, "recording": plan.source.path, "bytes": plan.source.size,
         "to_do": [name for name in plan.jobs if name not in plan.finished], "finished": sorted(plan.finished)}
        for plan in planned
    ]  # fmt: skip
    if args.json:
        print(json_text(rows))
        return 0
    for row in rows:
        print(f"{row['flight']}: {', '.join(row['to_do']) or 'nothing'} to do; {row['recording']}")
    return 0


def _results(
    planned: Sequence[Plan], progress: Progress, out: Path, seconds: float, notes: list[str]
) -> dict[str, Any]:
    """The tables and the page over all flights; returns what stands in them."""
    from ..report.batch_page import write_page
    from ..report.batch_rows import flight_rows, write_tables

    rows = flight_rows(planned, progress)
    good = sum(outcome.good for outcome in progress.outcomes.values())
    result = {
        "flights": rows,
        "jobs": {
            "finished": progress.earlier + good, "earlier": progress.earlier, "now": good,
            "failed": len(progress.failed), "not_begun": progress.total - len(progress.outcomes),
        },
        "seconds": round(seconds, 3),
        "notes": notes,
    }  # fmt: skip
    write_tables(out, result)
    write_page(out / "index.html", result)
    return result


def _tell(result: dict[str, Any], args: argparse.Namespace) -> None:
    if args.json:
        print(json_text(result))
        return
    from ..report.batch_rows import table_lines

    for line in table_lines(result["flights"], every=args.verbose):
        print(line)
    jobs = result["jobs"]
    told = [f"{jobs['now']} jobs done in {result['seconds']:.1f} s", f"{jobs['earlier']} were finished"]
    told += [f"{jobs['failed']} failed"] if jobs["failed"] else []
    told += [f"{jobs['not_begun']} not begun"] if jobs["not_begun"] else []
    print(f"{args.output}: {', '.join(told)}; the page over all flights: {args.output / 'index.html'}")
