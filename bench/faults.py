"""Fault campaign: what is lost, how long until all is right again, what the operator is told, and whether the error
stays within the protection level.

    python bench/faults.py [--kind data|processes] [--only WORD] [--rate 1]

Each fault hits a flight of one strip with control, tie points and truth. Faults of *processes* (recorder, navigator,
adjuster, in processes of their own, fed by `triline replay`) come in mid-strip. Faults of *data* are put into the
messages of the flight, which `process` works off: the exact sequence, whatever the machine.

- *lost*: time of the strip without final orientation, s, less what the flight lacks without a fault
- *right*: from the fault (the end of a freeze) until live orientation came again, s by the recorder's clock (of data: s
  of flight); "-" where it never stopped for more than a second
- *beyond*: live orientations under a green light whose error is beyond the protection level in X, Y or Z, of how many
- *told*: alarms, and lines of the event log that the flight without a fault does not have, the first of them
"""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import frame
import numpy as np

from triline.nodes import convert
from triline.nodes.bus.processes import NodeGroup
from triline.nodes.bus.session import Bus
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.report.integrity import levels
from triline.nodes.report.source import read
from triline.schemas import codec

SECONDS, LEAD_S, FAULT_S = 36, 10.0, 26.0  # of the strip, before it, and of the fault from the start of the flight
NODES = ("recorder", "navigator", "adjuster")
Messages = list[Message]


@dataclass
class Row:
    """A line of the table."""

    fault: str
    lost_s: float
    right_s: float
    beyond: int
    green: int
    told: str

    def __str__(self) -> str:
        right = f"{self.right_s:.1f}" if self.right_s > 0 else "-"
        return f"{self.fault:<44}{self.lost_s:>7.1f}{right:>7}{f'{self.beyond} of {self.green}':>12}  {self.told}"


# ---- what came of it


@dataclass
class Outcome:
    """What the recordings of a flight hold."""

    final_s: np.ndarray
    live_s: np.ndarray
    heard_ns: np.ndarray
    beyond: int
    green: int
    lines: list[str]

    @classmethod
    def of(cls, paths: Iterable[Path], alarms: Iterable[str] = ()) -> Outcome:
        final, live, heard, lines, beyond, green = [], [], [], list(alarms), 0, 0
        for path in paths:
            reader = RecordingReader(path)
            start = reader.index.stamp_ns.min() if len(reader.index.stamp_ns) else 0
            for topic, times in (("orientation/final", final), ("orientation/live", live)):
                times += [convert.time_ns(m.body.timestamp) for m in reader.sorted_messages([topic]) if m.body.valid]
            heard += reader.index.receive_ns[reader.select(["orientation/live"])].tolist()
            for m in reader.sorted_messages(["event/log"]):
                lines.append(f"{m.body.name}: {m.body.message}")
            if start:
                a, b = _under_green(path)
                beyond, green = beyond + a, green + b
        return cls(np.unique(final), np.unique(live), np.unique(heard), beyond, green, lines)


def _under_green(path: Path) -> tuple[int, int]:
    """Errors beyond the protection level in X, Y or Z under a green light, of how many that were compared."""
    flight = read(path)[0]
    found = levels(flight)
    if found is None:
        return 0, 0
    time_s, protection, _, error = found
    green = {float(flight.seconds(stamp)) for stamp, r in flight.reports if r.light == "good"}
    mine = np.array([float(t) in green for t in time_s]) & np.isfinite(error[:, :3]).all(axis=1)
    beyond = (np.abs(error[mine, :3]) > protection[mine, :3]).any(axis=1)
    return int(beyond.sum()), int(mine.sum())


def missing_s(times_ns: np.ndarray, strip: tuple[int, int]) -> float:
    """Time of a strip in which orientations are more than 0.3 s apart, s."""
    inside = times_ns[(times_ns >= strip[0]) & (times_ns <= strip[1])]
    gaps = np.diff(np.concatenate([[strip[0]], inside, [strip[1]]])) * 1e-9
    return float(gaps[gaps > 0.3].sum())


def _pause_s(times_ns: np.ndarray, from_ns: int, longest_s: float) -> float:
    """From a time to the end of the longest pause in the half minute after it, s; 0 where none is longer than usual."""
    after = times_ns[(times_ns > from_ns) & (times_ns < from_ns + 30e9)]
    gaps = np.diff(np.concatenate([[from_ns], after])) * 1e-9
    if not len(gaps) or gaps.max() <= longest_s:
        return 0.0
    return float((after[int(np.argmax(gaps))] - from_ns) * 1e-9)


def row(fault: str, got: Outcome, usual: Outcome, strip: tuple[int, int], at_ns: int, heard_from_ns: int = 0) -> Row:
    known = {_kind(line) for line in usual.lines}
    new = [line for line in got.lines if _kind(line) not in known and not line.endswith(": good")]
    if heard_from_ns:
        right = _pause_s(got.heard_ns, heard_from_ns, 1.0)
    else:
        right = _pause_s(got.live_s, at_ns, 0.5)
    lost = missing_s(got.final_s, strip) - missing_s(usual.final_s, strip)
    told = "; ".join(dict.fromkeys(line[:110] for line in new[:2])) or "nothing"
    return Row(fault, max(0.0, lost), right, got.beyond, got.green, told)


def _kind(line: str) -> str:
    return " ".join(word for word in line.split() if not any(map(str.isdigit, word)))[:50]


# ---- data


def process(messages: Iterable[Message], folder: Path) -> list[Path]:
    source, out = folder / "in.mcap", folder / "out.mcap"
    writer = RecordingWriter(source)
    for message in sorted(messages, key=lambda m: m.stamp_ns):
        writer.write(message)
    writer.close()
    frame.triline("process", str(source), "-o", str(out), "-q")
    return [out]


def changed(message: Message, **values: Any) -> Message:
    body = type(message.body)()
    body.CopyFrom(message.body)
    for name, value in values.items():
        setattr(body, name, value)
    return Message(message.topic, message.stamp_ns, body, message.source, message.sequence, message.start)


def of_data(start_ns: int) -> dict[str, Callable[[Messages], Messages]]:
    """Faults of data, by name."""
    rng = np.random.default_rng(1)

    def s(m: Message) -> float:
        return (m.stamp_ns - start_ns) * 1e-9

    def during(m: Message, length: float) -> bool:
        return FAULT_S <= s(m) < FAULT_S + length

    def clock(by_s: float) -> Callable[[Messages], Messages]:
        def change(m: Message) -> Message:
            if m.topic != "sensor/gnss" or s(m) < FAULT_S:
                return m
            other = changed(m)
            convert.set_time(other.body.timestamp, convert.time_ns(m.body.timestamp) + round(by_s * 1e9))
            return other

        return lambda messages: [change(m) for m in messages]

    def frozen(messages: Messages) -> Messages:
        out, last = [], {}
        for m in messages:
            if m.topic == "sensor/attitude" and during(m, 5.0):
                last.setdefault(m.topic, m)
                held = last[m.topic].body
                m = changed(m, roll=held.roll, pitch=held.pitch, heading=held.heading)
            out.append(m)
        return out

    def swapped(messages: Messages) -> Messages:
        """Every other attitude has the stamp and number of the one before it, and that one its own."""
        mine = [i for i, m in enumerate(messages) if m.topic == "sensor/attitude" and during(m, 10.0)]
        out = list(messages)
        for i, j in zip(mine[::2], mine[1::2], strict=False):
            a, b = messages[i], messages[j]
            out[i] = Message(a.topic, a.stamp_ns, b.body, a.source, a.sequence, a.start)
            out[j] = Message(b.topic, b.stamp_ns, a.body, b.source, b.sequence, b.start)
        return out

    return {
        "GNSS clock 18 s back": clock(-18.0),
        "GNSS clock an hour ahead": clock(3600.0),
        "GNSS without finite numbers, 5 s": lambda ms: [
            changed(m, latitude=float("nan")) if m.topic == "sensor/gnss" and during(m, 5.0) else m for m in ms
        ],
        "attitude without finite numbers, 5 s": lambda ms: [
            changed(m, roll=float("nan")) if m.topic == "sensor/attitude" and during(m, 5.0) else m for m in ms
        ],
        "attitude frozen, 5 s": frozen,
        "GNSS silent, 5 s": lambda ms: [m for m in ms if not (m.topic == "sensor/gnss" and during(m, 5.0))],
        "attitude lost, one of ten": lambda ms: [
            m for m in ms if m.topic != "sensor/attitude" or not during(m, 20.0) or rng.random() > 0.1
        ],
        "every message twice, 10 s": lambda ms: [x for m in ms for x in ([m, m] if during(m, 10.0) else [m])],
        "attitude in the wrong order, 10 s": swapped,
        "GNSS drifts by 0.5 m/s, 8 s": lambda ms: [
            changed(m, latitude=m.body.latitude + 0.5 * (s(m) - FAULT_S) / 111_200.0)
            if m.topic == "sensor/gnss" and during(m, 8.0)
            else m
            for m in ms
        ],
    }


# ---- processes


class Rig:
    """A flight over the bus, as it is flown."""

    def __init__(self, flight: Path, folder: Path, rate: float, recorder_output: Path | None = None) -> None:
        self.folder, self.rate = folder, rate
        self.output = recorder_output or folder / "live.mcap"
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.group = NodeGroup(folder / "log", "demo", self.port)
        self.flight = flight
        self.alarms: list[str] = []
        self.fault_ns = 0  # when it came, by the clock of this machine

    def start(self, name: str, **named: str) -> None:
        more = ["-o", str(self.output)] if name == "recorder" else []
        self.group.start(name, *more, **named)

    def fly(self, fault: Callable[[Rig], None] | None, at_s: float = FAULT_S) -> list[Path]:
        with self.group, Bus(source="campaign", port=self.port) as bus:
            newest = [0]
            bus.subscribe("sensor/attitude", lambda raw: newest.__setitem__(0, max(newest[0], raw.envelope.stamp_ns)))
            bus.subscribe("status/*", self._hear)
            for name in NODES:
                self.start(name)
            until = time.monotonic() + 60
            while not bus.alive() >= set(NODES) and time.monotonic() < until:
                time.sleep(0.1)
            command = [*frame.TRILINE, "replay", str(self.flight), "--rate", str(self.rate), "-q"]
            command += ["--wait-for", "navigator,adjuster", "--port", str(self.port)]
            replay = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            first = 0
            try:
                while fault is not None and replay.poll() is None:
                    first = first or newest[0]
                    if first and (newest[0] - first) * 1e-9 > at_s:
                        self.fault_ns = time.time_ns()
                        fault(self)
                        break
                    time.sleep(0.02)
                replay.wait(300)
            finally:
                if replay.poll() is None:
                    replay.kill()
            time.sleep(3.0)
            for name in ("navigator", "adjuster", "recorder"):
                process = self.group.processes.get(name)
                if process is not None:
                    process.stop(20.0)
        return sorted(self.output.parent.glob(f"{self.output.stem}*.mcap"))

    def _hear(self, raw: Any) -> None:
        alarm = codec.decode(raw.topic, raw.data).alarm
        if alarm and alarm not in self.alarms:
            self.alarms.append(alarm)

    def killed(self, name: str) -> None:
        self.group.processes[name].process.kill()
        self.group.processes[name].process.wait()
        self.start(name)

    def stopped(self, seconds: float, *names: str) -> None:
        processes = [self.group.processes[name].process for name in names]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        for process in processes:
            process.send_signal(signal.SIGCONT)
        self.fault_ns = time.time_ns()


def of_processes() -> dict[str, Callable[[Rig], None]]:
    """Faults of processes, by name."""
    out: dict[str, Callable[[Rig], None]] = {}
    for name in NODES:
        out[f"SIGKILL and restart: {name}"] = lambda rig, name=name: rig.killed(name)
    for name in NODES:
        for seconds in (1.0, 5.0):
            out[f"SIGSTOP {seconds:g} s: {name}"] = lambda rig, name=name, seconds=seconds: rig.stopped(seconds, name)
    out["SIGSTOP 15 s: navigator, adjuster, recorder"] = lambda rig: rig.stopped(15.0, *NODES)
    out["a second program in the sensors' name, 5 s"] = second_replay
    out["two navigators"] = lambda rig: rig.start("navigator", id="second")
    return out


def second_replay(rig: Rig) -> None:
    """The same flight once more from the start, in the name of the first, for 5 s."""
    command = [*frame.TRILINE, "replay", str(rig.flight), "--rate", str(rig.rate), "-q", "--port", str(rig.port)]
    second = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(5.0)
    second.kill()
    second.wait()


def disk_full(flight: Path, folder: Path, rate: float) -> tuple[list[Path], list[str]] | None:
    """The recorder on a disk that is too small; None where none can be mounted."""
    disk = folder / "disk"
    disk.mkdir()
    size = f"size={max(1, flight.stat().st_size // 3)}"
    if subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], capture_output=True).returncode:
        return None
    try:
        rig = Rig(flight, folder, rate, disk / "live.mcap")
        paths = rig.fly(None)
        kept = [Path(shutil.copy(path, folder / f"kept_{path.name}")) for path in paths]
        return kept, rig.alarms
    finally:
        subprocess.run(["umount", "-l", str(disk)], capture_output=True)


def readable(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Recordings as they are, or what `recover` saves of them."""
    out = []
    for path in paths:
        whole = folder / f"whole_{path.name}"
        done = subprocess.run([*frame.TRILINE, "recover", str(path), "-o", str(whole), "-q"], capture_output=True)
        out.append(whole if done.returncode == 0 and whole.exists() else path)
    return out


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--only", default="", help="faults whose name has this word")
    parser.add_argument("--kind", choices=("all", "data", "processes"), default="all", help="of faults")
    parser.add_argument("--rate", type=float, default=1.0, help="of the replays, times real time")
    args = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="triline-faults-") as name:
        folder = Path(name)
        flight = folder / "flight.mcap"
        frame.triline("simulate", "-o", str(flight), "--seconds", str(SECONDS), "--control", "9", "--seed", "3", "-q")
        messages = list(RecordingReader(flight).sorted_messages())
        start_ns = next(m.stamp_ns for m in messages if m.topic == "sensor/attitude")
        at_ns = start_ns + round(FAULT_S * 1e9)
        strip = start_ns + round(LEAD_S * 1e9), start_ns + round((LEAD_S + SECONDS) * 1e9)
        print(f"{'fault':<44}{'lost s':>7}{'right':>7}{'beyond':>12}  told", flush=True)

        def done(fault: str, got: Outcome, usual: Outcome, heard_from_ns: int = 0) -> None:
            rows.append(row(fault, got, usual, strip, at_ns, heard_from_ns))
            print(rows[-1], flush=True)

        if args.kind != "processes":
            usual = Outcome.of(process(messages, _folder(folder, "usual")))
            done("none (process)", usual, usual)
            for fault, change in of_data(start_ns).items():
                if args.only in fault:
                    done(fault, Outcome.of(process(change(messages), _folder(folder, fault))), usual)
        if args.kind != "data":
            live = Outcome.of(Rig(flight, _folder(folder, "live"), args.rate).fly(None))
            done("none (live)", live, live)
            for fault, do in of_processes().items():
                if args.only in fault:
                    place = _folder(folder, fault)
                    rig = Rig(flight, place, args.rate)
                    paths = readable(rig.fly(do), place)
                    done(fault, Outcome.of(paths, rig.alarms), live, rig.fault_ns)
            if args.only in "disk full":
                place = _folder(folder, "disk full")
                found = disk_full(flight, place, args.rate)
                if found is None:
                    print("disk full: no tmpfs can be mounted here")
                else:
                    done("disk full", Outcome.of(readable(found[0], place), found[1]), live)
    beyond = sum(r.beyond for r in rows)
    silent = [r.fault for r in rows[1:] if r.told == "nothing" and r.lost_s > 0.5]
    print(f"{len(rows)} flights; {beyond} errors beyond the protection level under a green light; "
          f"lost more than 0.5 s and not told: {', '.join(silent) or 'none'}")  # fmt: skip
    return frame.verdict(not beyond and not silent)


def _folder(folder: Path, fault: str) -> Path:
    place = folder / "".join(c if c.isalnum() else "_" for c in fault)
    place.mkdir()
    return place


if __name__ == "__main__":
    sys.exit(main())
