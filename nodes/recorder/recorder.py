"""The recorder: everything the topic table marks as recorded, into a recording, without decoding it."""

from __future__ import annotations

import math
import os
import shutil
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...schemas import codec, topics
from ...schemas import messages as m
from ...schemas.envelope import Envelope, RawMessage
from ..bus.downlink import INVENTORY, asked
from ..bus.program import ProgramOptions
from ..bus.recall import Recall
from ..bus.session import Bus
from ..bus.status import StatusPublisher
from ..errors import UserError
from ..node import STOPPING, Node
from ..ordering import StreamCheck, order_key
from ..recording.reread import Reread, Stream
from ..recording.writer import COMPRESSIONS, RecordingWriter

if TYPE_CHECKING:
    from ..bus.bundle import Bundle
    from ..recording.seal import Seal

#: The open chunk is closed at least so often: what SIGKILL can cost.
FLUSH_S = 0.3
#: Bytes that wait for the disk before publishers are slowed down.
WAITING_BYTES = 256 << 20
#: So many messages are written before the recorder looks at its disk, its status and its orders again.
PORTION = 500
#: The disk, or the machine, is too slow when something has waited for so long, s.
SLOW_S = 3.0
#: What comes in this time after the start is sorted: configuration and control to the head of the file.
HEAD_S = 0.4
#: A recorder that begins while a flight is under way takes what was said in so long before, s: one that was killed is
#: back by then.
BEFORE_S = 10.0
#: When it is told to stop, a recorder takes what is still on its way until nothing has come for so long, s ...
QUIET_S = 0.3
#: ... but no longer than this: sensors may go on.
LAST_WORDS_S = 2.0
#: A full disk is tried again after so long.
RETRY_S = 2.0
#: The disk is looked at so often, s; it is nearly full with so many minutes at the present rate, or bytes, left.
DISK_PERIOD_S, FULL_SOON_MIN, FULL_SOON_BYTES = 5.0, 10.0, 200_000_000


class RecordingFile:
    """An unbuffered file that never ends inside a record: a write that fails is taken back."""

    def __init__(self, path: Path, bundle: Bundle | None = None) -> None:
        self.path = path
        self._seal = None if bundle is None else _seal(path, bundle)
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        self._size = 0

    def write(self, data: bytes | memoryview) -> int:
        view = memoryview(data).cast("B") if len(data) else memoryview(b"")
        done = 0
        try:
            while done < len(view):
                done += os.write(self._descriptor, view[done:])
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            os.lseek(self._descriptor, self._size, os.SEEK_SET)
            raise
        self._size += done
        if self._seal is not None:
            self._seal.took(view)
        return done

    def tell(self) -> int:
        return self._size

    def fate(self) -> str:
        """What somebody has done with the file: ``""`` where it is under its name, ``deleted`` or ``moved away``.

        Raises
        ------
        OSError : the disk does not say
        """
        written = os.fstat(self._descriptor)
        try:
            named = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            pass
        else:  # some network disks number their files anew: one that is as long is taken for this one
            if os.path.samestat(named, written) or named.st_size >= self._size:
                return ""
        return "moved away" if written.st_nlink else "deleted"

    def flush(self) -> None:
        """Every write goes to the operating system at once."""

    def sign(self) -> None:
        """Sign what has been written, where the recording is signed."""
        if self._seal is not None:
            self._seal.sign()

    def close(self, whole: bool = False) -> None:
        os.close(self._descriptor)
        if self._seal is not None and whole:
            self._seal.close()


def _seal(path: Path, bundle: Bundle) -> Seal:
    from ..bus.authority import AUTHORITY, CERTIFICATE, KEY
    from ..recording.seal import Seal

    return Seal(path, bundle.folder / CERTIFICATE, bundle.folder / AUTHORITY, bundle.folder / KEY)


class Recorder(Node):
    """Keeps messages in files.

    Parameters
    ----------
    output : path of the recording; where there is one already, a number is added to the name
    compression : ``none``, ``lz4`` or ``zstd``
    rotate_mb : start a new file after so many megabytes; 0 = one file
    sign : bundle of `triline keys` in whose name recordings are signed; "" = not at all
    """

    name = "recorder"
    inputs = tuple(row.name for row in topics.TOPICS if row.recorded)
    outputs = ()

    def __init__(
        self, output: str = "recording.mcap", compression: str = "none", rotate_mb: float = 0, sign: str = ""
    ) -> None:
        super().__init__()
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression is {compression!r}, wanted one of {', '.join(COMPRESSIONS)}")
        if rotate_mb < 0:
            raise ValueError(f"rotate_mb is {rotate_mb}, wanted 0 or more")
        self._bundle: Bundle | None = None
        if sign:
            from ..bus.bundle import load_bundle  # certificates take a tenth of a second to import

            self._bundle = load_bundle(Path(sign))
        self._path = Path(output)
        self._compression = compression
        self._rotate_bytes = int(rotate_mb * 1e6)
        self.files: list[Path] = []
        self.platform = "demo"
        self.newest_ns = 0
        self._check: StreamCheck[None] = StreamCheck()
        self._latched: list[RawMessage] = []
        self._heard_ns: dict[str, int] = {}
        self._file: RecordingFile | None = None
        self._writer: RecordingWriter | None = None
        self._flushed_s = 0.0
        self._retry_s = 0.0
        self._unflushed = self._in_file = 0
        self._lost = 0
        self._measured_s = 0.0  # when the disk was looked at, and what had been written by then
        self._written = self._bytes_before = 0
        self._reread = Reread()
        self._closed_to = 0  # all that stands before this byte of the open file can be found again

    @property
    def statistics(self) -> Any:
        """Counts by topic, see `ordering.TopicCounts`."""
        return self._check.counts

    @property
    def missing(self) -> int:
        """How many messages never came, by their numbers; what nodes say of their health does not count."""
        return sum(c.gaps for topic, c in self._check.counts.items() if not topics.may_be_dropped(topic))

    def recall(self, bus: Bus) -> Recall:
        """Asks for what this recorder has missed."""
        return Recall(bus, self.inputs, self._check)

    def every(self, topic: str) -> int:
        """Of a topic only messages whose number this divides come."""
        return 1

    def state(self) -> str:
        return "recording" if self._writer is not None else f"not recording: {self.last_problems.get('disk', '')}"

    def start(self) -> None:
        """Open the first file.

        Raises
        ------
        UserError : it cannot be written
        """
        if self._path.is_dir():
            raise UserError(f"{self._path}: is a folder, wanted a file")
        try:
            self._open()
        except OSError as error:
            raise UserError(f"{self._path}: cannot be written: {(error.strerror or str(error)).lower()}") from None

    def take(self, messages: list[RawMessage]) -> None:
        """Write messages; on a disk that is full they are counted and lost, and the recorder goes on."""
        for raw in messages:
            self._check.accept(raw.topic, raw.envelope, None)
            if not raw.topic.startswith("status/"):
                self.newest_ns = max(self.newest_ns, raw.envelope.stamp_ns)
                said_ns, source = raw.envelope.stamp_ns, raw.envelope.source
                self._heard_ns[source] = max(self._heard_ns.get(source, 0), said_ns)
            if topics.find(raw.topic).latched:
                self._latched.append(raw)
            self._write(raw)

    def heard(self, parameters: dict[str, str]) -> Any:
        """``query/heard?source=..``: how far a source was heard, for who takes its place; None where it was not."""
        said_ns = self._heard_ns.get(parameters.get("source", ""))
        return None if said_ns is None else m.Progress(time_ns=said_ns)

    def inventory(self, parameters: dict[str, str]) -> list[RawMessage]:
        """``query/inventory``: which messages are on the disk, by stream (an `m.Inventory`)."""
        body = m.Inventory()
        for stream, (lowest, highest) in sorted(self._reread.streams().items()):
            body.streams.add(topic=stream.topic, source=stream.source, start=stream.start, first=lowest, last=highest)
        return [RawMessage(INVENTORY, Envelope(self.newest_ns, self.name, 0), codec.encode(body))]

    def recorded(self, parameters: dict[str, str]) -> list[RawMessage]:
        """``query/recorded?topic=..;source=..;start=..;runs=..;every=..``: messages by their numbers.

        An empty inventory behind them says that these are all.

        Raises
        ------
        ValueError : parameters that are missing or no numbers
        """
        topic, source, start, runs, every = asked(parameters)
        end = RawMessage(INVENTORY, Envelope(self.newest_ns, self.name, 0), b"")
        return [*self._reread.read(Stream(topic, source, start), runs, every), end]

    def tend(self, waited_s: float = 0.0, waiting: int = 0) -> None:
        """Close the open chunk when it is time, change files when one is large enough, try a full disk again.

        A file that was deleted or moved away meanwhile is told, and another one begun, in a new folder if need be.

        Something has waited to be written for ``waited_s``, and as many bytes wait now.
        """
        now = time.monotonic()
        self._tell_disk()
        self.alarms["slow disk"] = (
            f"the disk or the machine is too slow: {waiting / 1e6:.1f} MB wait to be recorded, since {waited_s:.0f} s; "
            "they are kept, and publishers are held back when too much waits"
            if waited_s > SLOW_S else ""
        )  # fmt: skip
        if self._lost and self._writer is not None:
            self.alarms["lost"] = f"{self._lost} messages were not recorded"
        self.alarms["gaps"] = f"{self.missing} messages never came to the recorder" if self.missing else ""
        if self._writer is None:
            if now >= self._retry_s:
                self._try_again(now)
        elif now - self._flushed_s >= FLUSH_S:
            self._flushed_s = now
            try:
                if why := self._gone():
                    self._try_again(now, why)
                    return
                self._writer.flush()
                if self._file is not None:
                    self._file.sign()
                self._unflushed = 0
                self._note_closed()
                if self._rotate_bytes and self._writer.size > self._rotate_bytes:
                    self._close()
                    self._open()
            except OSError as error:
                self._fail(error)

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._gone()
            self._close()
        except OSError as error:
            self._fail(error)

    def account(self) -> str:
        """What is in which files, and what is not."""
        lost = self.counters["lost"]
        total = sum(counts.received for counts in self.statistics.values()) - lost
        names = ", ".join(str(path) for path in self.files if path.exists()) or "no file"
        said = f"{total} messages in {names}; {self.missing} missing by number"
        return said + (f"; {lost} others were lost" if lost else "")

    # ---- files

    def _open(self) -> None:
        number = len(self.files)
        path = self._next_path()
        self._file = RecordingFile(path, self._bundle)
        try:
            self._writer = RecordingWriter(
                self._file,  # pyrefly: ignore[bad-argument-type]  # has what the writer asks of a file
                self._compression,
                platform=self.platform,
                every=self.every,
            )
            for raw in self._latched if number else ():
                self._writer.write_raw(raw)
            if number:
                self._writer.flush()
        except OSError:
            self._writer = None
            self._file.close()
            os.unlink(path)
            raise
        self.files.append(path)
        self._flushed_s = time.monotonic()
        self._unflushed = self._in_file = 0
        self._closed_to = self._file.tell()

    def _gone(self) -> str:
        """Let go of a file that is not under its name any more, and say what has become of it; "" if it is there."""
        if self._file is None or self._writer is None or not (fate := self._file.fate()):
            return ""
        path, in_file = self._file.path, self._in_file
        self._bytes_before += self._writer.size
        self._writer.flush()
        self._note_closed()
        self._writer.close()
        self._file.close()
        self._writer = self._file = None
        if fate == "deleted":
            self._lose(in_file)
        self.problem("disk", f"{path}: was {fate} while it was written")
        return f"{self.last_problem}; "

    def _note_closed(self) -> None:
        """What was written since the last time can be found again."""
        if self._file is not None and self._writer is not None and self._file.tell() > self._closed_to:
            self._reread.closed(self._file.path, self._closed_to, self._file.tell(), self._writer)
            self._closed_to = self._file.tell()

    def _next_path(self) -> Path:
        """The path asked for, or the next number after it: a recording is never written over."""
        number, path = len(self.files), self._path
        while path in self.files or (path.exists() and path.stat().st_size):
            number = max(number, 1)
            path = self._path.with_stem(f"{self._path.stem}_{number:04d}")
            number += 1
        return path

    def _close(self) -> None:
        if self._writer is not None and self._file is not None:
            self._bytes_before += self._writer.size
            self._writer.flush()
            self._note_closed()
            self._writer.close()
            self._file.close(whole=True)
            self._writer = self._file = None

    def _write(self, raw: RawMessage) -> None:
        if self._writer is None:
            self._lose(1)
            return
        self._unflushed += 1
        self._in_file += 1
        try:
            self._writer.write_raw(raw)
            self._reread.note(raw)
        except OSError as error:
            self._fail(error)

    def _lose(self, number: int) -> None:
        self._lost += number
        self.counters["lost"] += number

    def _tell_disk(self) -> None:
        """An alarm for who looks at the monitor: nothing is recorded, or not for long any more."""
        if self._writer is None:
            self.alarms["disk"] = f"NOT RECORDING: {self.last_problems['disk']}; {self._lost} messages lost so far"
            return
        if self.alarms.get("disk", "").startswith("NOT"):
            self.alarms["disk"] = ""
        now = time.monotonic()
        if now < self._measured_s + DISK_PERIOD_S:
            return
        written = self._bytes_before + self._writer.size
        rate = (written - self._written) / (now - self._measured_s) if self._measured_s else 0.0
        self._measured_s, self._written = now, written
        try:
            left = shutil.disk_usage(self.files[-1].parent).free
        except OSError:
            return
        minutes = left / rate / 60.0 if rate > 0 else math.inf
        full = minutes < FULL_SOON_MIN or left < FULL_SOON_BYTES
        left_min = f", for {minutes:.0f} min" if math.isfinite(minutes) else ""
        self.alarms["disk"] = f"the disk is nearly full: {left / 1e6:.0f} MB left{left_min}" if full else ""

    def _fail(self, error: OSError) -> None:
        assert self._file is not None
        self._file.close()
        path = self._file.path
        self._writer = self._file = None
        self._reread.forget_open()
        self._lose(self._unflushed)  # at most: some of them may be in chunks that were written
        self._unflushed = 0
        self._retry_s = time.monotonic() + RETRY_S
        self.problem("disk", f"{path}: {(error.strerror or str(error)).lower()}")

    def _try_again(self, now: float, why: str = "") -> None:
        self._retry_s = now + RETRY_S
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._open()
        except OSError as error:
            self.keep_problem("disk", f"{why}{self._path}: {(error.strerror or str(error)).lower()}")
        else:
            self.problem("resumed", f"{why}recording again, into {self.files[-1]}; {self._lost} messages lost")


class _Backlog:
    """Messages on their way to the disk, bounded by bytes; who puts one waits, but the thread that made the backlog.

    That thread takes them, and what it publishes itself comes back to it: it would wait for itself.

    Attributes
    ----------
    bytes : how many wait
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._messages: deque[RawMessage] = deque()
        self.bytes = 0
        self._open = True
        self._taker = threading.get_ident()
        self._emptied_s = time.monotonic()

    def put(self, raw: RawMessage) -> None:
        with self._condition:
            while self.bytes >= WAITING_BYTES and self._open and threading.get_ident() != self._taker:
                self._condition.wait(0.5)
            self._messages.append(raw)
            self.bytes += len(raw.data)
            if len(self._messages) == 1:
                self._condition.notify_all()

    def take(self, timeout_s: float, most: int = PORTION) -> list[RawMessage]:
        """The oldest messages, ``most`` of them; waits for one."""
        with self._condition:
            if not self._messages:
                self._condition.wait(timeout_s)
            taken = [self._messages.popleft() for _ in range(min(most, len(self._messages)))]
            self.bytes -= sum(len(raw.data) for raw in taken)
            if not self._messages:
                self._emptied_s = time.monotonic()
            self._condition.notify_all()
            return taken

    def waited_s(self) -> float:
        """For how long something has waited all the time, s."""
        return time.monotonic() - self._emptied_s if self._messages else 0.0

    def close(self) -> None:
        with self._condition:
            self._open = False
            self._condition.notify_all()

    def __len__(self) -> int:
        return len(self._messages)


def run(options: ProgramOptions) -> int:
    """Record until told to stop."""
    from ..config import build

    recorder = build(Recorder, options.tables, "recorder")
    recorder.platform = options.platform
    recorder.start()
    options.report(f"recording to {recorder.files[0]}")
    with options.open_bus() as bus:
        record(recorder, bus, options)
    recorder.close()
    options.report(recorder.account())
    return 1 if recorder.counters["disk"] else 0


def _take_last_words(recorder: Recorder, backlog: _Backlog) -> None:
    """What is still on its way when the recorder is told to stop: until nothing comes for a while."""
    begun = heard = time.monotonic()
    while (now := time.monotonic()) - heard < QUIET_S and now - begun < LAST_WORDS_S:
        raws = backlog.take(0.05)
        if raws:
            recorder.take(raws)
            heard = time.monotonic()
        recorder.tend()


def record(recorder: Recorder, bus: Bus, options: ProgramOptions) -> None:
    """Feed a recorder from the bus until ``options.stop`` is set."""
    backlog = _Backlog()

    def malformed(topic: str, why: str) -> None:
        recorder.problem("malformed", f"{topic}: {why}")

    def receive(raw: RawMessage) -> None:
        try:
            topics.find(raw.topic)
        except KeyError:
            malformed(raw.topic, "unknown topic")
            return
        backlog.put(raw)

    for name in recorder.inputs:
        bus.subscribe(name, receive, malformed)
    bus.announce(recorder.name)
    status = StatusPublisher(bus, recorder.name)
    status.publish("starting", {}, recorder, 0.0, 0, 0)
    problem = ""
    head: list[RawMessage] = []
    until = time.monotonic() + HEAD_S
    while time.monotonic() < until and not options.stop.is_set():
        head += backlog.take(0.05)
    recall = recorder.recall(bus)
    head = recall.joined(head, BEFORE_S)
    latched = [raw for raw in head if topics.find(raw.topic).latched]
    recorder.take(sorted(latched, key=lambda raw: order_key(raw.topic, raw.envelope)))
    recorder.take([raw for raw in head if not topics.find(raw.topic).latched])
    bus.answer("heard", recorder.heard)
    bus.answer_messages("inventory", recorder.inventory)
    bus.answer_messages("recorded", recorder.recorded)
    recall.come_round()
    round_s = 0.0
    while not options.stop.is_set():
        begun = time.monotonic()
        recorder.take(recall.complete(backlog.take(0.05)))
        recorder.tend(max(backlog.waited_s(), round_s), backlog.bytes)
        round_s = time.monotonic() - begun
        if recorder.last_problem != problem:
            problem = recorder.last_problem
            options.report(f"recorder: {problem}")
        if status.due():
            status.publish(recorder.state(), dict(recorder.statistics), recorder, 0.0, len(backlog), recorder.newest_ns)
        recall.come_round()
    _take_last_words(recorder, backlog)
    backlog.close()
    while raws := backlog.take(0.0):  # a disk that is slow has left some
        recorder.take(raws)
    status.publish(STOPPING, dict(recorder.statistics), recorder, 0.0, len(backlog), recorder.newest_ns)
