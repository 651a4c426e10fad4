"""Flat over hours: memory and latency of a long flight through the nodes, faster than real time.

    python bench/long_flight.py [--hours 4] [--pace throughput] [--recording FILE] [-o out/bench]

Prints a row for each ten minutes as soon as they are flown, and at the end whether memory after warm-up stays within
5 % and the latency has no trend; draws both. Latency is processor time of the window's updates while a strip is flown;
divided by that of a fixed piece of work (a Cholesky decomposition of 500 x 500) at the same time it does not depend on
what else the machine does. The flight is warm when all strips of its first block have been closed (110 minutes; the
first one is at 50), and what it keeps is no more for hours: memory is told in medians of ten minutes, in single
samples a minute apart, and as a second thread sees it every 20 ms, however short the peak.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from pathlib import Path

import frame
import numpy as np

from triline.nodes import registry
from triline.nodes.cli.process import at_pace
from triline.nodes.config import build
from triline.nodes.garbage_collection import RareCollections
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas.envelope import RawMessage
from triline.solver.window.window import Window

#: The flight is warm after so long, s, or after half of it. Measured: medians of memory rise until then.
WARM_S = 6600.0
#: Of a row of the table, s.
ROW_S = 600.0
#: Of a parallel strip, and with its turn, s.
STRIP_S, TURN_S = 238.0, 93.0


def simulate(folder: Path, hours: float) -> Path:
    """A block of strips, 8 tie points a second, attitude at 50 Hz."""
    path = folder / "flight.mcap"
    strips = max(2, round(hours * 3600.0 / (STRIP_S + TURN_S)))
    plan = ("--strips", str(strips), "--seconds", str(STRIP_S), "--ties", "8", "--attitude-rate", "50")
    frame.triline("simulate", "-o", str(path), *plan, "-q")
    return path


class Watcher:
    """Memory as a second thread sees it all the time, (s, MB); ``now_s`` is set by the first one."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.seen: list[tuple[float, float]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(0.02):
            self.seen.append((self.now_s, frame.resident_mb()))

    def close(self) -> np.ndarray:
        """All that was seen (n, 2)."""
        self._over.set()
        self._thread.join()
        return np.array(self.seen)


class Reference:
    """Processor time of a fixed piece of work, ms: the least of the last few times."""

    def __init__(self) -> None:
        a = np.random.default_rng(0).standard_normal((500, 500))
        self._matrix = a @ a.T + 500.0 * np.eye(500)
        self._last: list[float] = []

    def __call__(self) -> float:
        begun = time.process_time()
        np.linalg.cholesky(self._matrix)
        self._last = [*self._last[-4:], 1e3 * (time.process_time() - begun)]
        return float(np.median(self._last))


def fly(recording: Path, output: Path, pace: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Memory (n, 2: s, MB) each minute and all the time, updates (m, 3: s, ms, of the reference); told meanwhile."""
    memory: list[tuple[float, float]] = []
    updates: list[tuple[float, float, float]] = []
    plain, reference = Window.update, Reference()

    def timed(self: Window, now_s: float):
        begun = time.process_time()
        result = plain(self, now_s)
        if result.report is not None and result.report.points:
            took = 1e3 * (time.process_time() - begun)
            updates.append((now_s, took, took / reference()))
        return result

    Window.update = timed  # the program measures from outside
    collections = RareCollections()
    reader = RecordingReader(recording)
    nodes = [build(registry.node_class(name), at_pace({}, pace)) for name in registry.ESTIMATING]
    first_ns = int(reader.index.stamp_ns.min())
    watcher = Watcher()
    with RecordingWriter(output) as writer:
        due, row_due = 0.0, ROW_S

        def write(raw: RawMessage) -> None:
            nonlocal due, row_due
            writer.write_raw(raw)
            now_s = watcher.now_s = (raw.envelope.stamp_ns - first_ns) / 1e9
            if now_s >= due:
                due = now_s + 60.0
                collections.if_due()
                memory.append((now_s, frame.resident_mb()))
                if now_s >= row_due:
                    tell(np.array(memory), np.array(updates), row_due)
                    row_due += ROW_S

        process(reader, nodes, write)
    return np.array(memory), watcher.close(), np.array(updates)


def tell(memory: np.ndarray, updates: np.ndarray, to_s: float) -> None:
    """The row that ends at a time."""
    m, u = (a[(a[:, 0] >= to_s - ROW_S) & (a[:, 0] < to_s), 1:] for a in (memory, updates))
    if len(u):
        p50, p99 = np.percentile(u[:, 0], [50, 99])
        hours = f"{(to_s - ROW_S) / 60:4.0f} - {to_s / 60:3.0f}"
        mb = f"{np.median(m):6.1f}  {m.min():6.1f}  {m.max():6.1f}"
        print(f"{hours}  {mb}  {len(u):7d}  {p50:6.2f}  {p99:6.2f}  {np.median(u[:, 1]):7.2f}", flush=True)


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--hours", type=float, default=4.0)
    parser.add_argument("--pace", choices=("load", "throughput"), default="load", help="as of triline process")
    parser.add_argument("--recording", type=Path, help="a recording instead of a simulated flight")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/bench"), help="folder of the drawing")
    args = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = args.recording or simulate(folder, args.hours)
        print("  minutes  memory MB, least, most  updates  p50 ms  p99 ms  p50/ref", flush=True)
        memory, seen, updates = fly(recording, folder / "out.mcap", args.pace)
    tell(memory, updates, np.ceil(memory[-1, 0] / ROW_S) * ROW_S)
    from_s = min(WARM_S, 0.5 * memory[-1, 0])
    warm = memory[memory[:, 0] >= from_s]
    seen_mb = seen[seen[:, 0] >= from_s, 1]
    late = updates[updates[:, 0] >= from_s]
    half = len(late) // 2
    rows = [warm[(warm[:, 0] >= t) & (warm[:, 0] < t + ROW_S), 1] for t in np.arange(from_s, warm[-1, 0], ROW_S)]
    medians = [float(np.median(row)) for row in rows if len(row) > 2]
    slope = np.polyfit(late[:, 0] / 3600.0, late[:, 2], 1)
    result = {
        "hours": round(memory[-1, 0] / 3600.0, 2),
        "wall time, s": round(time.monotonic() - begun),
        "memory after warm-up, MB": [round(float(warm[:, 1].min()), 1), round(float(warm[:, 1].max()), 1)],
        "memory every 20 ms, least, 1 %, 99 %, most, MB": np.percentile(seen_mb, [0, 1, 99, 100]).round(1).tolist(),
        "memory, trend an hour, MB": round(float(np.polyfit(warm[:, 0] / 3600.0, warm[:, 1], 1)[0]), 2),
        "memory, medians of ten minutes, MB": [round(min(medians), 1), round(max(medians), 1)],
        "memory, last half over first": round(
            float(np.median(warm[len(warm) // 2 :, 1]) / np.median(warm[: len(warm) // 2, 1])), 4
        ),
        "latency p50, last half over first": round(float(np.median(late[half:, 1]) / np.median(late[:half, 1])), 3),
        "latency p50 by the reference, last half over first": round(
            float(np.median(late[half:, 2]) / np.median(late[:half, 2])), 3
        ),
        "latency by the reference, trend an hour": round(float(slope[0] / np.polyval(slope, 0.0)), 4),
    }
    frame.show(result)
    draw(memory, updates, args.output)
    return 0


def draw(memory: np.ndarray, updates: np.ndarray, folder: Path) -> None:
    """``long_flight.png`` with memory and latency over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    above.plot(memory[:, 0] / 3600.0, memory[:, 1])
    above.set(ylabel="resident memory, MB", ylim=(0, None))
    below.plot(updates[:, 0] / 3600.0, updates[:, 1], ",", alpha=0.4)
    below.set(ylabel="update, ms of processor time", xlabel="hours", yscale="log")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "long_flight.png", dpi=110)
    print(f"drawn: {folder / 'long_flight.png'}")


if __name__ == "__main__":
    sys.exit(main())
