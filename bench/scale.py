"""What a flight costs in each stage, fitted to measured runs, and a simulated cluster that works off many of them.

    python bench/scale.py [--seconds 10 20 40 80] [--kills 3] [--json]
    python bench/scale.py --cluster       only the simulated clusters of docs/scale.md, which need no measured run

Flights of four sizes are simulated with image lines (400 pixels), and go through ``process`` (navigator, adjuster),
``adjust`` and ``rectify --mosaic`` with one worker, each in a process of its own. Processor seconds (of all threads),
the most megabytes and the bytes written are fitted by ``y = a + b x^p`` with a start ``a``, a constant ``b`` and an
exponent ``p``; ``x`` is messages, rays and cells. *Fit* is the largest relative difference from a run. Flops are
bounded by the processor seconds times what a matrix product reaches on this core.

Bytes and messages an hour of flight are counted in the recordings, by family of topics; those of image lines of a large
camera follow from its pixels and line rate (presets at 1 500 m and 70 m/s).

The cluster: workers take one job after another; input is read from a store and results are written to it, all transfers
sharing its bandwidth evenly up to the link of each worker; a worker is lost after an exponential time, which costs its
running job, and is back some minutes later. *Efficiency* is the processor time of the jobs over that of the workers.
The simulation is held against a real run: two workers process copies of a recording in processes of their own, some of
which are ended by SIGKILL while they work; replayed with the same durations and losses it has to end at the same time.
"""

from __future__ import annotations

import heapq
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from pathlib import Path

import frame
import numpy as np
from scipy.optimize import nnls

#: What a fit may be off, and the simulated end of the real run.
FIT, END = 0.35, 0.10
#: Families of topics that go down the link from an aircraft: image lines and raw sensors stay on board.
DOWNLINK = ("orientation", "adjustment", "point", "status", "event", "configuration")
_WATCHED = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
u = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({"cpu": u.ru_utime + u.ru_stime, "mb": u.ru_maxrss / 1024}))
sys.exit(code)
"""


def watched(*words: str) -> dict[str, float]:
    """Processor seconds and megabytes of a `triline` command."""
    done = subprocess.run(
        [sys.executable, "-c", _WATCHED, *frame.TRILINE, *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.stderr.strip())
    return json.loads(done.stdout)


# -- measured runs ---------------------------------------------------------------------------------------------------


def measure(seconds: float, folder: Path) -> dict[str, dict[str, float]]:
    """Stage -> size, processor seconds, megabytes, bytes written; and what a recording holds."""
    from triline.nodes.recording.reader import RecordingReader

    raw, processed, dem = folder / "raw.mcap", folder / "p.mcap", folder / "dem.tif"
    words = ["--sensor", "ads40-small", "--pixels", "400", "--strips", "2", "--no-turns", "--sidelap", "0.4"]
    words += ["--images", "--ties", "8", "--dem", str(dem), "--seed", "3", "-q", "--seconds", f"{seconds:g}"]
    watched("simulate", "-o", str(raw), *words)
    out = {}
    runs = {
        "process": ["process", str(raw), "-o", str(processed), "--nodes", "navigator,adjuster", "-q"],
        "adjust": ["adjust", str(processed), "-o", str(folder / "adjusted"), "-q"],
        "mosaic": ["rectify", str(processed), "--mosaic", "--orientation", "measured", "--dem", str(dem), "--gsd", "2",
                   "--workers", "1", "-o", str(folder / "m.tif"), "-q"],
    }  # fmt: skip
    for stage, command in runs.items():
        out[stage] = watched(*command)
    count, held = Counter(), Counter()
    reader = RecordingReader(processed)
    for message in reader.raws(reader.select()):
        family = message.topic.split("/")[0]
        family = "image lines" if message.topic.startswith("sensor/lines") else family
        count[family] += 1
        held[family] += len(message.data)
    inside = sum(n for family, n in count.items() if family in ("sensor", "observation"))
    out["process"] |= {"size": inside, "bytes": processed.stat().st_size - raw.stat().st_size}
    written = sum(p.stat().st_size for p in (folder / "adjusted").rglob("*") if p.is_file())
    out["adjust"] |= {"size": count["observation"], "bytes": written}
    import rasterio

    with rasterio.open(folder / "m.tif") as image:
        cells = int((image.read(1) > 0).sum())
    out["mosaic"] |= {"size": cells, "bytes": (folder / "m.tif").stat().st_size}
    out["recording"] = {"seconds": 2 * seconds}
    out["recording"] |= {f"{k} bytes": v for k, v in held.items()} | {f"{k} messages": v for k, v in count.items()}
    return out


def fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float, float]:
    """a, b, p of ``y = a + b x^p`` by least relative squares, a and b not negative; and the largest relative error."""
    best = (0.0, 0.0, 1.0, np.inf)
    least = np.inf
    for p in np.arange(0.5, 2.51, 0.05):
        A = np.column_stack([np.ones(len(x)), (x / x[-1]) ** p]) / y[:, None]
        (a, b), rest = nnls(A, np.ones(len(x)))
        if rest < least - 1e-9:
            error = float(np.abs(A @ [a, b] - 1.0).max())
            least, best = rest, (float(a), float(b / x[-1] ** p), float(p), error)
    return best


def gflops() -> float:
    """Of a matrix product on one core, 1e9 a second of processor time."""
    a = np.random.default_rng(1).normal(size=(700, 700))
    begun = time.process_time()
    for _ in range(5):
        a @ a
    return 5 * 2 * 700**3 / (time.process_time() - begun) / 1e9


# -- the simulated cluster -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cluster:
    """Workers and their store.

    Attributes
    ----------
    workers : each does one job at a time
    store_mb_s, link_mb_s : of the store together, and of each worker
    lost_h : mean time after which a worker is lost; infinity for never
    back_s : until another one takes its place
    """

    workers: int
    store_mb_s: float
    link_mb_s: float
    lost_h: float
    back_s: float = 120.0


def simulate(
    cluster: Cluster, work_s: np.ndarray, read_mb: float, write_mb: float, rng: np.random.Generator,
    losses: dict[tuple[int, int], float] | None = None,
) -> dict[str, float]:  # fmt: skip
    """Work off jobs; returns the end (s), attempts, and the efficiency.

    Transfers share the store: each has moved the same ``moved`` megabytes since it began as all others since then, so
    that one heap of ends, counted in ``moved``, is all that is needed.

    Parameters
    ----------
    work_s : (n,) processor seconds of each job
    losses : (job, attempt) -> seconds after its begin at which it is lost; None draws losses from ``lost_h``
    """
    waiting = deque(range(len(work_s)))
    events: list[tuple[float, int, str, int]] = []
    transfers: list[tuple[float, int, int]] = []  # end in `moved`, order, worker
    job_of, run_of = {}, Counter()
    now = moved = 0.0
    order = attempts = done = active = 0
    alive = dict.fromkeys(range(cluster.workers), 0)  # worker -> number of its life
    tried: Counter[int] = Counter()
    idle: set[int] = set()
    state: dict[int, str] = {}
    current: dict[int, int] = {}

    def push(when: float, what: str, worker: int) -> None:
        nonlocal order
        order += 1
        heapq.heappush(events, (when, order, what, worker))

    def begin(worker: int) -> None:
        nonlocal attempts
        if not waiting:
            job_of.pop(worker, None)
            idle.add(worker)  # it takes what a lost one leaves
            return
        job = waiting.popleft()
        attempts += 1
        tried[job] += 1
        job_of[worker] = job
        run_of[worker] += 1
        if losses is not None and (job, tried[job]) in losses:
            push(now + losses[job, tried[job]], f"lost {alive[worker]}", worker)
        transfer(worker, read_mb, "read")

    def transfer(worker: int, megabytes: float, what: str) -> None:
        nonlocal order, active
        order += 1
        active += 1
        state[worker] = what
        heapq.heappush(transfers, (moved + megabytes, order, worker))
        current[worker] = order

    if losses is None and np.isfinite(cluster.lost_h):
        for worker in alive:
            push(rng.exponential(3600 * cluster.lost_h), "lost 0", worker)
    for worker in alive:
        begin(worker)
    while done < len(work_s):
        while transfers and current.get(transfers[0][2]) != transfers[0][1]:
            heapq.heappop(transfers)  # of a worker that was lost
        rate = min(cluster.link_mb_s, cluster.store_mb_s / max(active, 1))
        at = now + max(transfers[0][0] - moved, 0.0) / rate if transfers else np.inf
        if events and events[0][0] <= at:
            when, _, what, worker = heapq.heappop(events)
            moved += (when - now) * rate if active else 0.0
            now = when
            kind, _, number = what.partition(" ")
            if kind == "work" and run_of[worker] == int(number) and worker in job_of:
                transfer(worker, write_mb, "write")
            elif kind == "lost" and alive[worker] == int(number):
                if current.pop(worker, None) is not None:
                    active -= 1
                if worker in job_of:
                    waiting.append(job_of.pop(worker))
                idle.discard(worker)
                if idle and waiting:
                    begin(idle.pop())
                run_of[worker] += 1
                alive[worker] += 1
                push(now + cluster.back_s, "back", worker)
            elif kind == "back":
                if losses is None and np.isfinite(cluster.lost_h):
                    push(now + rng.exponential(3600 * cluster.lost_h), f"lost {alive[worker]}", worker)
                begin(worker)
            continue
        if not transfers:
            break
        moved, now = transfers[0][0], at
        _, _, worker = heapq.heappop(transfers)
        current.pop(worker)
        active -= 1
        if state[worker] == "read":
            push(now + float(work_s[job_of[worker]]), f"work {run_of[worker]}", worker)
        else:
            done += 1
            begin(worker)
    return {
        "end_s": now, "attempts": attempts, "efficiency": float(work_s.sum()) / (now * cluster.workers),
    }  # fmt: skip


def real_run(recording: Path, folder: Path, jobs: int, kills: int) -> tuple[float, float]:
    """Seconds that two workers take for copies of a job, some of them killed; and what the simulation says."""
    queue, lock = deque(range(jobs)), threading.Lock()
    took: dict[int, float] = {}
    losses: dict[tuple[int, int], float] = {}
    tried: Counter[int] = Counter()

    def worker(seed: int) -> None:
        rng = np.random.default_rng(seed)
        while True:
            with lock:
                if not queue:
                    return
                job = queue.popleft()
                tried[job] += 1
                kill = tried[job] == 1 and len(losses) < kills and job % 2 == 1
                if kill:
                    losses[job, 1] = 0.0
            part, target = folder / f"{job}.part.mcap", folder / f"{job}.mcap"
            words = ["process", str(recording), "-o", str(part), "--nodes", "navigator,adjuster", "-q"]
            begun = time.perf_counter()
            run = subprocess.Popen([*frame.TRILINE, *words], stdout=subprocess.DEVNULL, start_new_session=True)
            try:
                run.wait(rng.uniform(1.0, 3.0) if kill else None)
                part.replace(target)
                took[job] = time.perf_counter() - begun
                if kill:
                    losses.pop((job, 1))
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                run.wait()
                losses[job, 1] = time.perf_counter() - begun
                with lock:
                    queue.append(job)

    begun = time.perf_counter()
    threads = [threading.Thread(target=worker, args=(k,)) for k in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    end = time.perf_counter() - begun
    cluster = Cluster(2, 1e9, 1e9, np.inf, back_s=0.0)
    work = np.array([took[k] for k in range(jobs)])
    return end, simulate(cluster, work, 0.0, 0.0, np.random.default_rng(1), losses)["end_s"]


#: Flights, workers, MB/s of the store and hours between losses of a worker, of the clusters in docs/scale.md.
CLUSTERS = (
    (10, 2, np.inf, np.inf), (1_000, 64, np.inf, np.inf), (1_000, 64, np.inf, 5.0), (100_000, 2_000, np.inf, 5.0),
    (100_000, 2_000, 1_000.0, 5.0),
)  # fmt: skip


def clusters() -> None:
    """Jobs of 600 s (25 % scatter) that read 1 GB and write 0.1 GB."""
    print(" flights  workers  store MB/s  lost every h  efficiency  attempts")
    for flights, workers, store, lost_h in CLUSTERS:
        rng = np.random.default_rng(1)
        work = 600.0 * np.maximum(1.0 + 0.25 * rng.standard_normal(flights), 0.1)
        told = simulate(Cluster(workers, store, 500.0, lost_h), work, 1000.0, 100.0, rng)
        print(
            f"{flights:8} {workers:8} {store:11.0f} {lost_h:13.0f} {told['efficiency']:11.2f} {told['attempts']:9.0f}"
        )


# -- the table -------------------------------------------------------------------------------------------------------


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--seconds", type=float, nargs="+", default=[10, 20, 40, 80], help="of each of two strips")
    parser.add_argument("--kills", type=int, default=3, help="processes of the real run that are killed")
    parser.add_argument("--cluster", action="store_true", help="only the simulated clusters")
    args = parser.parse_args()
    if args.cluster:
        clusters()
        return 0
    good = True
    with tempfile.TemporaryDirectory() as name:
        runs = []
        for seconds in args.seconds:
            folder = Path(name) / f"{seconds:g}"
            folder.mkdir()
            runs.append(measure(seconds, folder))
            shutil.rmtree(folder / "adjusted")
        speed = gflops()
        print(
            "stage     x         processor s = a + b x^p           fit   MB at most        bytes a x   "
            f"({speed:.0f} Gflop/s a core)"
        )
        fits, slopes = {}, {}
        for stage, of in (("process", "messages"), ("adjust", "rays"), ("mosaic", "cells")):
            x, y, mb, size = (np.array([run[stage][k] for run in runs]) for k in ("size", "cpu", "mb", "bytes"))
            a, b, p, error = fits[stage] = fit(x.astype(float), y)
            slopes[stage] = float((y[-1] - y[-2]) / (x[-1] - x[-2]))
            good &= error < FIT
            print(
                f"{stage:8}  {of:8}  {a:6.2f} + {b:9.3g} x^{p:.2f}  {100 * error:14.0f} %  "
                f"{mb.min():5.0f} to {mb.max():5.0f}  {size[-1] / x[-1]:10.3g}"
            )
        last = runs[-1]
        hours = last["recording"]["seconds"] / 3600
        held = {k.removesuffix(" bytes"): v / hours for k, v in last["recording"].items() if k.endswith(" bytes")}
        sent = {k.removesuffix(" messages"): v / hours for k, v in last["recording"].items() if k.endswith("messages")}
        print(
            "an hour of flight: " + ", ".join(f"{k} {v / 1e6:.0f} MB in {sent[k]:.0f}" for k, v in sorted(held.items()))
        )
        down = sum(v for k, v in held.items() if k in DOWNLINK)
        print(f"downlink without image lines and raw sensors: {down * 8 / 3600 / 1e3:.0f} kbit/s")
        lines_mb = 450.0 * 12_000 * 3 * 2 * 3600 / 1e6  # 3 CCD lines of 12 000 px, 16 bit, 450 lines/s
        messages = sum(v for k, v in sent.items() if k in ("sensor", "observation"))
        size = {"process": messages, "adjust": sent["observation"], "mosaic": 450.0 * 12_000 * 3600}
        # far beyond what was measured an exponent of a narrow range means nothing: the last slope is carried on
        cost = {k: fits[k][0] + slopes[k] * size[k] for k in size}
        job_s, read_mb, write_mb = sum(cost.values()), lines_mb, size["mosaic"] * 2.0 / 1e6
        print(
            "a flight of an hour (12 000 px, 450 lines/s): "
            + ", ".join(f"{k} {v:.0f} s" for k, v in cost.items())
            + f" of a core; {read_mb / 1e3:.0f} GB in, {write_mb / 1e3:.1f} GB out, "
            f"at most {job_s * speed / 1e3:.0f} Tflop"
        )
        print("flights   cores  store GB/s   stored TB   end, h   lost jobs   efficiency   with a store of a tenth, h")
        rng = np.random.default_rng(1)
        for flights, cores, store in ((10, 4, 1.0), (1_000, 64, 5.0), (100_000, 2_000, 100.0)):
            work = job_s * rng.lognormal(0.0, 0.25, flights)
            whole = simulate(Cluster(cores, 1e3 * store, 500.0, 100.0), work, read_mb, write_mb, rng)
            slow = simulate(Cluster(cores, 1e2 * store, 500.0, 100.0), work, read_mb, write_mb, rng)
            print(
                f"{flights:7d}  {cores:6d}  {store:10.0f}  {flights * (read_mb + write_mb) / 1e6:10.1f}  "
                f"{whole['end_s'] / 3600:7.1f}  {whole['attempts'] - flights:10d}  {whole['efficiency']:11.2f}  "
                f"{slow['end_s'] / 3600:12.1f}"
            )
        folder = Path(name) / "real"
        folder.mkdir()
        end, said = real_run(Path(name) / f"{args.seconds[0]:g}" / "raw.mcap", folder, 8, args.kills)
        print(f"two real workers, {args.kills} processes killed: {end:.1f} s; simulated {said:.1f} s")
        good &= abs(said / end - 1.0) < END
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
