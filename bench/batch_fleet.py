"""Many recordings through `triline batch`: two workers against one, workers and schedulers that are killed, a store.

    python bench/batch_fleet.py speed [--flights 40]
    python bench/batch_fleet.py killed [--flights 20] [--every 5]
    python bench/batch_fleet.py restarted [--flights 12]
    python bench/batch_fleet.py store

``speed``: simulated recordings of 24 s (a strip of 8 s) on one worker and on two, in turns; *of twice the speed* is
the time of one over twice that of two. The machine has to be idle; *load before* says whether it was. *Workers are
busy*: share of the time in which they have a job; *processor s a job*: what a job costs, with its part of the
program; of one worker and of two. ``killed``: a Dask cluster of two workers here, one of which is killed (SIGKILL)
every few seconds, and the same for the processes of ``--workers 2``; *equal to process* counts results that are byte
for byte those of `triline process`. ``restarted``: the program, and the scheduler of a cluster, killed when some jobs
are finished; the same command again: *done again* counts finished jobs that were done a second time. ``store``: an S3
server of this machine (moto) with a recording of image lines and ties; what each command fetched of it.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import frame

#: Strip of a flight, s, and seconds with which it is flown to and from.
STRIP_S = 8


def main() -> int:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("what", choices=("speed", "killed", "restarted", "store"))
    parser.add_argument("--flights", type=int, help="recordings (speed 40, killed 20, restarted 12)")
    parser.add_argument("--every", type=float, help="seconds between kills (1.5 times what a job takes)")
    parser.add_argument("--rounds", type=int, default=1, help="of speed (1)")
    parser.add_argument("--recordings", type=Path, help="folder to keep simulated recordings in")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="triline-bench-") as name:
        work = Path(name)
        recordings = args.recordings or work / "recordings"
        figures, good = {"speed": speed, "killed": killed, "restarted": restarted, "store": store_run}[args.what](
            args, recordings, work
        )
    frame.show(figures, args.json)
    return frame.verdict(good)


def flights(folder: Path, number: int) -> list[Path]:
    """Simulated recordings, those that are missing made."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"flight-{seed:03}.mcap" for seed in range(1, number + 1)]
    for seed, path in enumerate(paths, 1):
        if not path.exists():
            frame.triline("simulate", "-o", str(path), "--seconds", str(STRIP_S), "--seed", str(seed), "-q")
    return paths


def batch(paths: list[Path], out: Path, *words: str) -> dict:
    """What a batch says of itself; all of its jobs have to be finished."""
    done = subprocess.run(
        [*frame.TRILINE, "batch", *map(str, paths), "-o", str(out), "--json", *words], capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(done.stderr.strip() or done.stdout[-1000:])
    return json.loads(done.stdout)


def speed(args, recordings: Path, work: Path) -> tuple[dict, bool]:
    paths = flights(recordings, args.flights or 40)
    load = os.getloadavg()[0]
    seconds: dict[int, float] = {1: 0.0, 2: 0.0}
    busy, processor = dict(seconds), dict(seconds)
    for turn in range(args.rounds):
        for workers in (1, 2) if turn % 2 == 0 else (2, 1):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            result = batch(paths, work / f"out-{turn}-{workers}", "--workers", str(workers))
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds[workers] += result["seconds"]
            processor[workers] += after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            busy[workers] += sum(step["seconds"] for row in result["flights"] for step in row["steps"].values())
    jobs, share = 2 * len(paths), seconds[1] / seconds[2] / 2.0
    figures = {
        "recordings": len(paths), "jobs": jobs, "load before": load, "one worker, s": seconds[1] / args.rounds,
        "two workers, s": seconds[2] / args.rounds, "of twice the speed": share,
        "workers are busy, share": [busy[n] / seconds[n] / n for n in (1, 2)],
        "processor s a job": [processor[n] / jobs / args.rounds for n in (1, 2)],
    }  # fmt: skip
    return figures, share >= 0.85


# ---- processes


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def children(pid: int) -> list[int]:
    """Processes that a process has started, from the table of the system."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError, ValueError):
                if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                    found.append(int(entry.name))
    return found


@contextmanager
def running(*words: str, log: Path) -> Iterator[subprocess.Popen]:
    """A program that is killed at the end, with what it started."""
    with open(log, "ab") as file:
        process = subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def answers(port: int, seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while True:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        if time.monotonic() > until:
            sys.exit(f"nobody answers at port {port}")
        time.sleep(0.2)


def scheduler(port: int, work: Path):
    words = ("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    return running(sys.executable, *words, log=work / "scheduler.log")


def worker(port: int, work: Path, name: str):
    words = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(work / name), "--death-timeout", "60")
    command = (sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{port}", *words)
    return running(*command, log=work / f"{name}.log")


def started(work: Path, paths: list[Path], out: Path, *words: str):
    command = (*frame.TRILINE, "batch", *map(str, paths), "-o", str(out), "--retries", "50", *words)
    return running(*command, log=work / "batch.log")


def equal_to_process(paths: list[Path], out: Path, work: Path) -> int:
    """How many results are byte for byte those of `triline process`."""
    equal = 0
    for path in paths:
        alone = work / "alone.mcap"
        frame.triline("process", str(path), "-o", str(alone), "-q")
        result = out / path.stem / "processed.mcap"
        equal += result.exists() and result.read_bytes() == alone.read_bytes()
    return equal


def killed(args, recordings: Path, work: Path) -> tuple[dict, bool]:
    paths = flights(recordings, args.flights or 20)
    chance, begun = random.Random(1), time.monotonic()
    frame.triline("process", str(paths[0]), "-o", str(work / "alone.mcap"), "-q")
    # a job that is always killed before its end would never be done
    every = args.every or 1.5 * (time.monotonic() - begun)
    figures: dict[str, object] = {"recordings": len(paths), "seconds between kills": every}
    good = True
    for kind in ("cluster", "here"):
        port, out, kills = free_port(), work / f"out-{kind}", 0
        begun = time.monotonic()
        with scheduler(port, work), worker(port, work, "w1") as w1, worker(port, work, "w2") as w2:
            answers(port)
            where = ("--scheduler", f"tcp://127.0.0.1:{port}") if kind == "cluster" else ("--workers", "2")
            with started(work, paths, out, "--do", "process", *where) as program:
                while program.poll() is None:
                    time.sleep(every)
                    victims = [*children(w1.pid), *children(w2.pid)] if kind == "cluster" else children(program.pid)
                    victims = [pid for pid in victims if "resource_tracker" not in command_of(pid)]
                    if victims and program.poll() is None:
                        with suppress(ProcessLookupError):
                            os.kill(chance.choice(victims), signal.SIGKILL)
                            kills += 1
                code = program.returncode
        result = json.loads((out / "summary.json").read_text())
        records = len(list(out.glob("*/process.done.json")))
        equal = equal_to_process(paths, out, work)
        left = len(list(out.glob("*/.job-*")))
        figures |= {
            f"{kind}: kills": kills, f"{kind}: seconds": time.monotonic() - begun, f"{kind}: exit code": code,
            f"{kind}: finished": result["jobs"]["finished"], f"{kind}: records": records,
            f"{kind}: equal to process": equal, f"{kind}: folders left over": left,
        }  # fmt: skip
        good = good and code == 0 and records == equal == len(paths) and kills > 0 and left == 0
    return figures, good


def command_of(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""


def wait_for_records(out: Path, number: int, program: subprocess.Popen) -> dict[Path, int]:
    """The records and when they were written, as soon as there are so many."""
    while program.poll() is None:
        found = sorted(out.glob("*/*.done.json"))
        if len(found) >= number:
            return {path: path.stat().st_mtime_ns for path in found}
        time.sleep(0.1)
    sys.exit("the batch was over before it was to be killed")


def restarted(args, recordings: Path, work: Path) -> tuple[dict, bool]:
    paths = flights(recordings, args.flights or 12)
    figures: dict[str, object] = {"recordings": len(paths), "jobs": 2 * len(paths)}
    good = True
    for kind in ("program", "scheduler"):
        out, port = work / f"out-{kind}", free_port()
        where = ("--workers", "2") if kind == "program" else ("--scheduler", f"tcp://127.0.0.1:{port}")
        words = ("--do", "process,analyze", *where)
        if kind == "program":
            with started(work, paths, out, *words) as program:
                before = wait_for_records(out, len(paths), program)
                program.kill()
            again = batch(paths, out, *words)
        else:
            with worker(port, work, "w1"), worker(port, work, "w2"):
                with scheduler(port, work) as hub:
                    answers(port)
                    with started(work, paths, out, *words) as program:
                        before = wait_for_records(out, len(paths), program)
                        hub.kill()
                        hub.wait()
                        begun = time.monotonic()
                        program.wait(120)
                        figures["scheduler: program ends after, s"] = time.monotonic() - begun
                figures["scheduler: it says"] = (work / "batch.log").read_text().splitlines()[-1].split(": ", 2)[-1]
                with scheduler(port, work), worker(port, work, "w3"):
                    answers(port)
                    again = batch(paths, out, *words)
        figures |= {
            f"{kind}: finished before": again["jobs"]["earlier"],
            f"{kind}: done by the second run": again["jobs"]["now"],
            f"{kind}: done again": sum(path.stat().st_mtime_ns != when for path, when in before.items()),
            f"{kind}: equal to process": equal_to_process(paths, out, work),
        }  # fmt: skip
        jobs = again["jobs"]
        good = good and jobs["now"] + jobs["earlier"] == 2 * len(paths) and jobs["earlier"] >= len(before)
        good = good and figures[f"{kind}: done again"] == 0 and figures[f"{kind}: equal to process"] == len(paths)
    return figures, good


# ---- a store


@contextmanager
def store(work: Path) -> Iterator[dict[str, str]]:
    """An S3 server of this machine; what the environment has to say of it."""
    port = free_port()
    code = f"from moto.server import main; main(['-H', '127.0.0.1', '-p', '{port}'])"
    with running(sys.executable, "-c", code, log=work / "store.log"):
        answers(port)
        yield {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_DEFAULT_REGION": "us-east-1",
        }  # fmt: skip


def store_run(args, recordings: Path, work: Path) -> tuple[dict, bool]:
    recordings.mkdir(parents=True, exist_ok=True)
    flown, path = recordings / "flown.mcap", recordings / "images.mcap"
    if not path.exists():
        words = ("--seconds", "10", "--seed", "1", "--images", "--pixels", "3000", "-q")
        frame.triline("simulate", "-o", str(flown), *words)
        frame.triline("process", str(flown), "-o", str(path), "--nodes", "navigator,matcher,adjuster", "-q")
    figures: dict[str, object] = {"recording, MB": path.stat().st_size / 1e6}
    good = True
    with store(work) as environment:
        os.environ.update(environment)
        import fsspec

        fs = fsspec.filesystem("s3")
        fs.mkdir("season")
        fs.put(str(path), "season/images.mcap")
        url = "s3://season/images.mcap"
        for name, words in (
            ("info", ()), ("adjust", ("-o", str(work / "a"))), ("analyze", ("-o", str(work / "r.html"))),
            ("process", ("-o", str(work / "p.mcap"))),
        ):  # fmt: skip
            begun = time.monotonic()
            done = subprocess.run([*frame.TRILINE, name, url, *words, "-v"], capture_output=True, text=True, check=True)
            told = next(line for line in done.stderr.splitlines() if line.startswith(url) and " MB of " in line)
            fetched = float(told.split(": ")[1].split()[0])
            figures[f"{name}: fetched, MB"] = fetched
            figures[f"{name}: ranges"] = int(told.split()[-2])
            figures[f"{name}: seconds"] = time.monotonic() - begun
            good = good and (fetched < 0.5 * path.stat().st_size / 1e6) == (name != "process")
        frame.triline("process", str(path), "-o", str(work / "here.mcap"))
        same = (work / "here.mcap").read_bytes() == (work / "p.mcap").read_bytes()
        figures["process: equal to that of the file"] = same
        result = batch([], work / "out", "s3://season", "--do", "process")
        figures["batch: flights finished"] = sum(row["state"] == "finished" for row in result["flights"])
        good = good and same and figures["batch: flights finished"] == 1
        for name, change in (
            ("refused", {"AWS_ACCESS_KEY_ID": ""}), ("not there", {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{free_port()}"}),
        ):  # fmt: skip
            begun = time.monotonic()
            environment = {k: v for k, v in {**os.environ, **change}.items() if v}
            done = subprocess.run([*frame.TRILINE, "info", url], capture_output=True, text=True, env=environment)
            figures[f"{name}: it says"] = done.stderr.strip().split(": ", 2)[-1]
            figures[f"{name}: after, s"] = time.monotonic() - begun
            good = good and done.returncode == 1 and done.stderr.count("\n") == 1
    return figures, good


if __name__ == "__main__":
    sys.exit(main())
