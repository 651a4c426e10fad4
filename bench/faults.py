"""Fault campaign: what is lost, how long until all is right again, what the operator is told, and whether the error
stays within the protection level.

    python bench/faults.py [--kind data|images|processes|link|packets] [--only WORD] [--rate 1]
    python bench/faults.py --long [--seconds 3600] [--rate 10] [--attitude-rate 50] [--ties 1]

Each fault hits a flight of one strip with control, tie points and truth. Faults of *processes* (recorder, navigator,
adjuster, in processes of their own, fed by `triline replay`) come in mid-strip, and so do those of the *link* between
the sensors (the replay) and the nodes: a program in between hands on what comes when its time is due; it loses or
shuffles single *packets*, the sensors being in a network namespace of their own. Faults of *data*
are put into the messages of the flight, which `process` works off: the exact sequence, whatever the machine. Those of
*images* are the same on a flight with image lines, from which the matcher measures the tie points.

- *lost*: time of the strip without final orientation, s, less what the flight lacks without a fault
- *right*: from the fault (the end of a freeze) until live orientation came again, s by the recorder's clock (of data: s
  of flight); "-" where it never stopped for more than a second
- *beyond*: live orientations under a green light whose error is beyond the protection level in X, Y or Z, of how many
- *told*: alarms, and lines of the event log that the flight without a fault does not have, the first of them

With ``--long`` a flight of an hour goes through recorder, navigator and adjuster at ten times real time, and what is
printed is the time without final orientation, and of each node memory and open files at tenths of the time, each
when it has come.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import frame
import numpy as np
from fault_flights import (
    FAULT_S,
    NODES,
    Flown,
    LongRig,
    PacketRig,
    Rig,
    TcpRig,
    disk_full,
    of_packets,
    of_processes,
    of_the_link,
    readable,
    slow_disk,
)
from packet_link import PacketLink

from triline.nodes import convert
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.report.integrity import levels
from triline.nodes.report.source import read

LONG_STRIP_S, LONG_TURN_S = 331.0, 93.0  # of the long flight: a strip with its turn, and the turn
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
        heard, lines, beyond, green = [], list(alarms), 0, 0
        paths = list(paths)
        final, live = (_times_ns(paths, topic) for topic in ("orientation/final", "orientation/live"))
        for path in paths:
            reader = RecordingReader(path)
            heard += reader.index.receive_ns[reader.select(["orientation/live"])].tolist()
            for m in reader.sorted_messages(["event/log"]):
                lines.append(f"{m.body.name}: {m.body.message}")
            a, b = _under_green(path)
            beyond, green = beyond + a, green + b
        return cls(final, live, np.unique(heard), beyond, green, lines)


def _times_ns(paths: list[Path], topic: str) -> np.ndarray:
    """Times of the valid poses of a topic in several recordings, ns."""
    poses = (m.body for path in paths for m in RecordingReader(path).sorted_messages([topic]))
    return np.unique([convert.time_ns(body.timestamp) for body in poses if body.valid])


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


def process(messages: Iterable[Message], folder: Path, *options: str) -> list[Path]:
    source, out = folder / "in.mcap", folder / "out.mcap"
    writer = RecordingWriter(source)
    for message in sorted(messages, key=lambda m: m.stamp_ns):
        writer.write(message)
    writer.close()
    frame.triline("process", str(source), "-o", str(out), "--pace", "load", "-q", *options)  # live as in a flight
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
        "heading 20 deg off, 0.3 s": lambda ms: [
            changed(m, heading=m.body.heading + 0.35) if m.topic == "sensor/attitude" and during(m, 0.3) else m
            for m in ms
        ],
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


def numbered(messages: Iterable[Message]) -> Messages:
    """The same with the numbers of a publisher that said exactly this."""
    counts: dict[tuple[str, str, int], int] = {}
    out = []
    for m in messages:
        stream = m.topic, m.source, m.start
        counts[stream] = counts.get(stream, -1) + 1
        out.append(replace(m, sequence=counts[stream]))
    return out


def of_images(start_ns: int) -> dict[str, Callable[[Messages], Messages]]:
    """Faults of the camera, by name; each hits all of its CCD lines."""

    def during(m: Message, length: float) -> bool:
        return m.topic.startswith("sensor/lines/") and FAULT_S <= (m.stamp_ns - start_ns) * 1e-9 < FAULT_S + length

    def repeated(messages: Messages) -> Messages:
        """The pixels of the last block before the fault under the numbers of those that come."""
        out, last = [], {}
        for m in messages:
            if during(m, 3.0):
                held = last[m.topic]
                m = replace(m, body=replace(m.body, pixels=np.resize(held, m.body.pixels.shape)))
            elif m.topic.startswith("sensor/lines/"):
                last[m.topic] = m.body.pixels
            out.append(m)
        return out

    def again(messages: Messages) -> Messages:
        """Each block is sent once more, as a message of its own with the same line numbers and times."""
        return numbered(x for m in messages for x in ([m, m] if during(m, 3.0) else [m]))

    def stuck(messages: Messages) -> Messages:
        """The last block before the fault again and again with its numbers and times, instead of those to come."""
        out, last = [], {}
        for m in messages:
            if during(m, 3.0):
                m = replace(m, body=last[m.topic])
            elif m.topic.startswith("sensor/lines/"):
                last[m.topic] = m.body
            out.append(m)
        return out

    def tenth(messages: Messages) -> Messages:
        """Every tenth block of each CCD line never comes."""
        return [m for m in messages if not (during(m, 20.0) and m.sequence % 10 == 0)]

    return {
        "image lines repeated, new numbers, 3 s": repeated,
        "image lines repeated, same numbers, 3 s": stuck,
        "image lines sent twice, 3 s": again,
        "image lines lost, every tenth block, 20 s": tenth,
    }


# ---- a long flight


def long_flight(folder: Path, seconds: float, rate: float, attitude_rate: float, ties: float, grid_hz: float) -> int:
    """A block of strips with few tie points: final orientation that is missing, memory and open files of the nodes."""
    path = folder / "long.mcap"
    strips = max(1, round(seconds / LONG_STRIP_S))
    plan = ("--strips", str(strips), "--seconds", str(min(seconds, LONG_STRIP_S) - LONG_TURN_S), "--ties", str(ties))
    frame.triline("simulate", "-o", str(path), *plan, "--attitude-rate", str(attitude_rate), "--seed", "3", "-q")
    rig = LongRig(path, _folder(folder, "long"), rate, seconds, grid_hz)
    print(f"{'s of flight':<12}" + "".join(f"{name:>14}" for name in NODES), flush=True)
    begun = time.monotonic()
    flown = rig.fly(LongRig.watch, 0.0)
    took_s = time.monotonic() - begun
    paths = readable(flown, folder)
    times = _times_ns(paths, "orientation/final")
    lost = [missing_s(times, strip) for strip in strips_of(path)]
    print(f"{rig.seen[-1][0]:.0f} s of flight, {len(lost)} strips, at {rate:g} times real time in {took_s:.0f} s; "
          f"without final orientation {sum(lost):.1f} s")  # fmt: skip
    for text in rig.alarms:
        print(f"told: {text}")
    return frame.verdict(sum(lost) < 0.5)


def strips_of(path: Path) -> list[tuple[int, int]]:
    """Times of the first and of the last line of the strips of a recording, ns; that a strip is over is said later."""
    over = [m.body for m in RecordingReader(path).sorted_messages(["configuration/strip"]) if m.body.ended]
    return [(b.first_line_time_ns, b.first_line_time_ns + round((b.lines - 1) / b.line_rate_hz * 1e9)) for b in over]


KINDS = ("data", "images", "processes", "link", "packets")


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("--only", default="", help="faults whose name has this word")
    parser.add_argument("--kind", choices=("all", *KINDS), default="all", help="of faults")
    parser.add_argument("--rate", type=float, help="of the replays, times real time (1; of --long 10)")
    parser.add_argument("--long", action="store_true", help="a flight of an hour instead of faults")
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the flight of --long (3600)")
    parser.add_argument("--ties", type=float, default=1.0, help="tie points a second of --long (1)")
    parser.add_argument("--attitude-rate", type=float, default=50.0, help="attitudes a second of --long (50)")
    parser.add_argument("--grid", type=float, default=10.0, help="orientations a second of --long (10)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="triline-faults-") as name:
        folder = Path(name)
        if args.long:
            return long_flight(folder, args.seconds, args.rate or 10.0, args.attitude_rate, args.ties, args.grid)
        return campaign(folder, KINDS if args.kind == "all" else (args.kind,), args.only, args.rate or 1.0)


def campaign(folder: Path, kinds: tuple[str, ...], only: str, rate: float) -> int:
    rows: list[Row] = []
    print(f"{'fault':<44}{'lost s':>7}{'right':>7}{'beyond':>12}  told", flush=True)

    def done(flight: Flown, fault: str, got: Outcome, usual: Outcome, heard_from_ns: int = 0) -> None:
        rows.append(row(fault, got, usual, flight.strip, flight.at_ns, heard_from_ns))
        print(rows[-1], flush=True)

    def processed(flight: Flown, name: str, faults: dict[str, Callable[[Messages], Messages]], *options: str) -> None:
        usual = Outcome.of(process(flight.messages, _folder(folder, name), *options))
        done(flight, f"none ({name})", usual, usual)
        for fault, change in faults.items():
            if only in fault:
                paths = process(change(flight.messages), _folder(folder, fault), *options)
                done(flight, fault, Outcome.of(paths), usual)

    if "images" in kinds:
        flight = Flown.simulated(folder / "images.mcap", "--images", "--sensor", "ads40-small", "--height", "800")
        processed(flight, "images", of_images(flight.start_ns), "--nodes", "navigator,matcher,adjuster")
    flight = Flown.simulated(folder / "flight.mcap")
    if "data" in kinds:
        processed(flight, "process", of_data(flight.start_ns))
    if not {"processes", "link", "packets"} & set(kinds):
        return _verdict(rows)

    rig = Rig(flight.path, _folder(folder, "live"), rate)
    live = Outcome.of(rig.fly(None))
    bytes_s = rig.output.stat().st_size * rate / ((flight.strip[1] - flight.strip[0]) * 1e-9)
    done(flight, "none (live)", live, live)

    def flown(fault: str, rig: Rig, happens: Callable[[Any], None] | None) -> None:
        paths = readable(rig.fly(happens), rig.folder)
        done(flight, fault, Outcome.of(paths, rig.alarms), live, rig.fault_ns)

    if "processes" in kinds:
        for name, do in of_processes().items():
            if only in name:
                flown(name, Rig(flight.path, _folder(folder, name), rate), do)
        if only in "disk full":
            place = _folder(folder, "disk full")
            found = disk_full(flight.path, place, rate)
            if found is None:
                print("disk full: no tmpfs can be mounted here")
            else:
                done(flight, "disk full", Outcome.of(readable(found[0], place), found[1]), live)
        name = "disk takes half of what is recorded"
        if only in name:
            place = _folder(folder, name)
            found = slow_disk(flight.path, place, rate, 0.5 * bytes_s)
            if found is None:
                print(f"{name}: no slow disk can be made here")
            else:
                done(flight, name, Outcome.of(readable(found[0], place), found[1]), live)
    if "link" in kinds:
        for name, (delay_s, happens) in of_the_link().items():
            if only in name:
                with ExitStack() as stack:
                    flown(name, TcpRig(flight.path, _folder(folder, name), rate, delay_s, stack), happens)
    if "packets" in kinds:
        for name, (loss, delay_s, spread_s) in of_packets().items():
            if only in name:
                try:
                    with PacketLink(loss, delay_s, spread_s) as link:
                        flown(name, PacketRig(flight.path, _folder(folder, name), rate, link), None)
                except (OSError, subprocess.CalledProcessError) as error:
                    print(f"{name}: no such link can be made here ({error})")
    return _verdict(rows)


def _verdict(rows: list[Row]) -> int:
    beyond = sum(r.beyond for r in rows)
    silent = [r.fault for r in rows if r.told == "nothing" and r.lost_s > 0.5]
    print(f"{len(rows)} flights; {beyond} errors beyond the protection level under a green light; "
          f"lost more than 0.5 s and not told: {', '.join(silent) or 'none'}")  # fmt: skip
    return frame.verdict(not beyond and not silent)


def _folder(folder: Path, fault: str) -> Path:
    place = folder / "".join(c if c.isalnum() else "_" for c in fault)
    place.mkdir()
    return place


if __name__ == "__main__":
    sys.exit(main())
