"""Load on the bus and the recorder: three CCD lines of 12 000 px x 16 bit at 800 lines/s, 500 Hz inertial, 5 Hz GNSS.

    python bench/bus_load.py            # 30 s
    python bench/bus_load.py --seconds 5
    python bench/bus_load.py --secure    # the same over TLS with certificates and access lists

Every publisher is a process of its own; the recorder is ``triline node recorder`` as it is. Prints what was lost, how
much of a core the recorder took, and the latency from publishing to reception.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import frame
import numpy as np
import psutil

from triline.nodes.bus.authority import Authority
from triline.nodes.bus.bundle import load_bundle
from triline.nodes.bus.processes import ALLOCATOR
from triline.nodes.bus.session import Bus
from triline.nodes.convert import gnss_message
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock

N_SAMPLES, LINES, LINE_RATE_HZ = 12_000, 32, 800.0
RATES_HZ = {"F": LINE_RATE_HZ / LINES, "N": LINE_RATE_HZ / LINES, "B": LINE_RATE_HZ / LINES, "imu": 500.0, "gnss": 5.0}
START_DELAY_S = 8.0
PLATFORM = "aircraft1"
#: What the recorder may take of a core.
WANTED_CORES = 0.5


def publish(what: str, port: int, seconds: float, begin: float, bundle: str = "") -> None:
    """One publisher; prints how many messages it sent and how much of a core it took."""
    rate = RATES_HZ[what]
    n = round(seconds * rate)
    # 12-bit grey values with noise, as a camera gives them
    pixels = np.random.default_rng(1).normal(1500, 3, (LINES, N_SAMPLES)).astype("<u2") if len(what) == 1 else None
    where: dict[str, Any] = {"platform": PLATFORM, "secure": load_bundle(Path(bundle))} if bundle else {}
    with Bus(port=port, source=what, **where) as bus:
        time.sleep(max(0.0, begin - time.time()))
        cpu = time.process_time()
        for i in range(n):
            time.sleep(max(0.0, begin + i / rate - time.time()))
            bus.publish(_message(what, i, pixels))
        cpu = time.process_time() - cpu
        time.sleep(2.0)
    print(json.dumps({"what": what, "sent": n, "cpu": cpu / seconds}))


def _message(what: str, i: int, pixels: np.ndarray | None) -> Message:
    now = time.time_ns()
    if pixels is not None:
        block = LineBlock(pixels, what, "S1", i * LINES, now, round(1e9 / LINE_RATE_HZ))
        return Message(f"sensor/lines/{what}", now, block)
    if what == "imu":
        body = m.Imu(
            time_ns=now, interval_ns=2_000_000, force_x=0.1, force_y=0.2, force_z=-9.8, rate_x=1e-3, rate_y=2e-3
        )
        return Message("sensor/imu", now, body)
    return Message("sensor/gnss", now, gnss_message(now, (48.9, 8.9, 2000.0), (0.02, 0.02, 0.04)))


def measure(seconds: float, port: int, compression: str, secure: bool = False) -> dict:
    """Run recorder and publishers, read the recording."""
    environment = {**os.environ, **ALLOCATOR}
    with tempfile.TemporaryDirectory(prefix="triline-bench-") as folder:
        output = Path(folder) / "load.mcap"
        bundle = (
            str(Authority.create(Path(folder) / "survey").certify(PLATFORM, "aircraft", [], port)) if secure else ""
        )
        command = [*frame.TRILINE, "node", "recorder", "-q", "--port", str(port)]
        command += ["-o", str(output), "--set", f"compression={compression}"]
        command += ["--platform", PLATFORM, "--secure", bundle] if secure else []
        recorder = subprocess.Popen(command, env=environment)
        begin = time.time() + START_DELAY_S
        arguments = [str(port), str(seconds), str(begin), bundle]
        publishers = [
            subprocess.Popen(
                [sys.executable, __file__, "--publish", what, *arguments], env=environment, stdout=subprocess.PIPE
            )
            for what in RATES_HZ
        ]
        process = psutil.Process(recorder.pid)
        time.sleep(max(0.0, begin - time.time()))
        before = process.cpu_times()
        time.sleep(seconds)
        after = process.cpu_times()
        sent = [json.loads(publisher.communicate()[0]) for publisher in publishers]
        recorder.send_signal(signal.SIGINT)
        recorder.wait(30)
        result = {
            "seconds": seconds,
            "recorder_cores": (after.user - before.user + after.system - before.system) / seconds,
            "file_mb": output.stat().st_size / 1e6,
            "topics": [_topic(RecordingReader(output), entry) for entry in sent],
        }
    result["lost"] = sum(topic["lost"] for topic in result["topics"])
    return result


def _topic(reader: RecordingReader, entry: dict) -> dict:
    what = entry["what"]
    topic = f"sensor/{what}" if what in ("imu", "gnss") else f"sensor/lines/{what}"
    numbers = reader.select([topic])
    latency_ms = (reader.index.receive_ns[numbers] - reader.index.stamp_ns[numbers]) / 1e6
    p50, p99, worst = np.percentile(latency_ms, (50, 99, 100)) if len(numbers) else (np.nan,) * 3
    return {
        "topic": topic, "sent": entry["sent"], "lost": entry["sent"] - len(np.unique(reader.index.sequence[numbers])),
        "p50_ms": p50, "p99_ms": p99, "max_ms": worst, "publisher_cores": entry["cpu"],
    }  # fmt: skip


def main() -> int:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--port", type=int, default=17547)
    parser.add_argument("--compression", default="none", choices=("none", "lz4", "zstd"))
    parser.add_argument("--secure", action="store_true", help="TLS with certificates, and access lists")
    parser.add_argument("--publish", nargs=5, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.publish:
        what, port, seconds, begin, bundle = args.publish
        publish(what, int(port), float(seconds), float(begin), bundle)
        return 0
    result = measure(args.seconds, args.port, args.compression, args.secure)
    if args.json:
        print(json.dumps(result, indent=2))
    else:
        print(
            f"{result['file_mb']:.0f} MB in {result['seconds']:g} s, recorder {result['recorder_cores']:.2f} of a core"
        )
        print(f"{'topic':<16} {'sent':>7} {'lost':>5} {'p50':>8} {'p99':>8} {'max':>8}   publisher")
        for t in result["topics"]:
            times = " ".join(f"{t[key]:5.2f} ms" for key in ("p50_ms", "p99_ms", "max_ms"))
            print(
                f"{t['topic']:<16} {t['sent']:>7} {t['lost']:>5} {times}   {100 * t['publisher_cores']:.0f} % of a core"
            )
    return frame.verdict(result["lost"] == 0 and result["recorder_cores"] < WANTED_CORES)


if __name__ == "__main__":
    sys.exit(main())
