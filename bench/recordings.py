"""What the code for recordings adds to the MCAP library, and what it costs and buys: time of a processor, and damage.

    python bench/recordings.py [--messages 200000] [--images 200]

Two recordings, one of small messages (inertial data) and one of image lines (blocks of 32 x 12 000 px x 16 bit), are
written and read by the library alone and as the nodes do it. The library reads in the order of the file or of log time;
nodes want the order of stamps, whatever part of a file is left. The last table says how many messages of a damaged
file either of them gives.
"""

from __future__ import annotations

import argparse
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import CompressionType, Writer

from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import codec
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage
from triline.schemas.image_lines import LineBlock

BEGIN_NS, N_LINES, N_SAMPLES = 1_777_629_600_000_000_000, 32, 12_000


def inertial(count: int) -> Iterator[RawMessage]:
    """Inertial data at 200 Hz."""
    for i in range(count):
        time_ns = BEGIN_NS + i * 5_000_000
        body = m.Imu(time_ns=time_ns, interval_ns=5_000_000, force_x=0.1, force_z=-9.8, rate_x=1e-3 * i, rate_y=2e-3)
        yield RawMessage("sensor/imu", Envelope(time_ns, "bench", i), codec.encode(body), time_ns)


def image_lines(count: int) -> Iterator[RawMessage]:
    """Image lines with the noise of a camera of 12 bit, 25 blocks a second."""
    pixels = np.random.default_rng(1).normal(1500, 3, (N_LINES, N_SAMPLES)).astype("<u2")
    for i in range(count):
        time_ns = BEGIN_NS + i * 40_000_000
        data = LineBlock(pixels, "N", "S1", i * N_LINES, time_ns, 1_250_000).encode()
        yield RawMessage("sensor/lines/N", Envelope(time_ns, "bench", i), data, time_ns)


def write_by_library(path: Path, raws: Iterable[RawMessage]) -> None:
    """All messages on one channel."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start()
        channel = writer.register_channel("bench", "", 0)
        for raw in raws:
            envelope = raw.envelope
            writer.add_message(channel, raw.receive_ns, bytes(raw.data), envelope.stamp_ns, envelope.sequence)
        writer.finish()


def write_by_nodes(path: Path, raws: Iterable[RawMessage]) -> None:
    with RecordingWriter(path) as writer:
        for raw in raws:
            writer.write_raw(raw)


def read_by_library(path: Path, *, by_log_time: bool) -> int:
    """How many messages come before what the library cannot read.

    From beginning to end of the file, or in the order of log time by the index at its end.
    """
    count = 0
    with open(path, "rb") as file:
        try:
            reader = SeekingReader(file, True) if by_log_time else NonSeekingReader(file, True)
            for _ in reader.iter_messages(log_time_order=by_log_time):
                count += 1
        except (McapError, struct.error, ValueError):
            pass
    return count


def read_by_nodes(path: Path) -> int:
    reader = RecordingReader(path, salvage=True)
    return sum(1 for _ in reader.raws(reader.sort(reader.select())))


READERS: dict[str, Callable[[Path], int]] = {
    "library by file": partial(read_by_library, by_log_time=False),
    "library by log time": partial(read_by_library, by_log_time=True),
    "nodes by stamp": read_by_nodes,
}


def cpu_s(work: Callable[[], object], rounds: int = 3) -> float:
    """Time of a processor, s, the best of some rounds."""
    best = np.inf
    for _ in range(rounds):
        begun = time.process_time()
        work()
        best = min(best, time.process_time() - begun)
    return best


def damaged(data: bytes) -> dict[str, bytes]:
    """A recording with the damage that happens to files."""
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]
    zeros = data[:middle] + bytes(4096) + data[middle + 4096 :]
    return {"whole": data, "cut off in the middle": data[:middle], "one bit wrong": flipped, "4 KiB of zeros": zeros}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--images", type=int, default=200)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="triline-bench-") as folder:
        path = Path(folder) / "recording.mcap"
        for title, raws in (
            ("inertial data", [*inertial(args.messages)]),
            ("image lines", [*image_lines(args.images)]),
        ):
            megabytes = sum(len(raw.data) for raw in raws) / 1e6
            print(f"{title}: {len(raws)} messages, {megabytes:.0f} MB")
            _row("written by the library", cpu_s(lambda raws=raws: write_by_library(path, raws)), len(raws), megabytes)
            _row("written by nodes", cpu_s(lambda raws=raws: write_by_nodes(path, raws)), len(raws), megabytes)
            for name, read in READERS.items():
                assert read(path) == len(raws)
                _row(f"read, {name}", cpu_s(lambda read=read: read(path)), len(raws), megabytes)
        write_by_nodes(path, inertial(args.messages))
        print(f"messages that are read of {args.messages}, inertial data")
        data = path.read_bytes()
        for title, content in damaged(data).items():
            path.write_bytes(content)
            print(f"  {title + ':':<34}", ", ".join(f"{name} {read(path)}" for name, read in READERS.items()))
    return 0


def _row(what: str, seconds: float, count: int, megabytes: float) -> None:
    print(f"  {what:<34} {1e6 * seconds / count:8.1f} us a message {megabytes / seconds:8.0f} MB a second of a core")


if __name__ == "__main__":
    sys.exit(main())
