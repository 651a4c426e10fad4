"""The recorder on the ground: one recording for each aircraft of a fleet, of all that came down.

What did not come while a link was gone, or was too slow, is asked for: the recorder on board says which numbers it has
of each stream (`query/inventory`), and gives those that are missing here (`query/recorded`), in portions, as fast as
the aircraft's router allows.
"""

from __future__ import annotations

import bisect
import functools
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError

from ...schemas import messages as m
from ...schemas import topics
from ...schemas.envelope import RawMessage
from ..bus.authority import DESK_STATUSES
from ..bus.downlink import INVENTORY, MOST_ASKED, MOST_RUNS, SHARES, Share, share_of
from ..bus.program import ProgramOptions
from ..bus.session import Bus
from ..bus.status import StatusPublisher
from ..config import build
from ..errors import UserError
from ..node import Node
from ..recording.reread import Stream
from .recorder import Recorder

#: The platform under which the ground speaks of itself.
FLEET = "fleet"
#: An aircraft is asked for its inventory so often unless told otherwise, s; what it had then and is not here the next
#: time is missing.
INVENTORY_S = 5.0
#: An answer takes so long at most, s: what is there, and some messages.
INVENTORY_ANSWER_S, ANSWER_S = 10.0, 30.0
#: Who answers for an aircraft.
ANSWERS = frozenset({"router", "recorder"})
#: Aircraft that are recorded, at most: names come over the link.
MOST_AIRCRAFT = 200
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True)
class Gap:
    """Messages of a stream that are missing: runs of multiples of ``share.every``, first and last, in order."""

    stream: Stream
    share: Share
    runs: list[tuple[int, int]]


class Numbers:
    """A set of whole numbers, kept as runs."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._last: list[int] = []

    def add(self, number: int) -> bool:
        """Take a number; False where it is there already."""
        return self.add_run(number, number) > 0

    def add_run(self, first: int, last: int) -> int:
        """Take all numbers from first to last; returns how many are new."""
        missing = self.missing(first, last)
        i = bisect.bisect_left(self._last, first - 1)
        j = bisect.bisect_right(self._first, last + 1)
        if i < j:
            first, last = min(first, self._first[i]), max(last, self._last[j - 1])
        self._first[i:j], self._last[i:j] = [first], [last]
        return sum(b - a + 1 for a, b in missing)

    def missing(self, first: int, last: int) -> list[tuple[int, int]]:
        """Runs between first and last, both included, that are not in the set."""
        runs = []
        for k in range(bisect.bisect_left(self._last, first), len(self._first)):
            if self._first[k] > last:
                break
            if self._first[k] > first:
                runs.append((first, self._first[k] - 1))
            first = max(first, self._last[k] + 1)
        if first <= last:
            runs.append((first, last))
        return runs


class AircraftRecorder(Recorder):
    """Records what comes from one aircraft, live or asked for, each message once.

    Parameters
    ----------
    platform : the aircraft
    output : path of the recording
    whole : topics of which all messages are asked for, beside those of `bus.downlink.SHARES`
    compression, rotate_mb, sign : see `Recorder`
    """

    def __init__(
        self, platform: str, output: str, whole: tuple[str, ...] = (), compression: str = "none",
        rotate_mb: float = 0, sign: str = "",
    ) -> None:  # fmt: skip
        super().__init__(output, compression, rotate_mb, sign)
        self.platform = platform
        self._whole = whole
        self._here = threading.Lock()
        self._held: dict[Stream, Numbers] = {}  # of thinned topics the multiples of their divisor
        self._absent: dict[Stream, Numbers] = {}  # asked for, and not on board either
        self._before: dict[Stream, int] = {}  # highest number of each stream in the inventory before
        self._lacking = 0
        self.filled = 0
        #: Messages that were here neither now nor at the inventory before, and are asked for.
        self.settled = 0
        self.heard_s = time.monotonic()

    @property
    def missing(self) -> int:
        return self._lacking

    def receive(self, raw: RawMessage) -> bool:
        """Record a message if it is new."""
        with self._here:
            share, number = self._share(raw.topic), raw.envelope.sequence
            stream = Stream(raw.topic, raw.envelope.source, raw.envelope.start)
            every = 1 if share is None else share.every
            if number % every == 0 and not self._held.setdefault(stream, Numbers()).add(number // every):
                return False
            self.take([raw])
            return True

    def every(self, topic: str) -> int:
        share = self._share(topic)
        return 1 if share is None else share.every

    def tend(self, waited_s: float = 0.0, waiting: int = 0) -> None:
        with self._here:
            super().tend(waited_s, waiting)

    def lacks(self, inventory: Any) -> list[Gap]:
        """What the aircraft has for some time and is not here, what is wanted first before the rest.

        Parameters
        ----------
        inventory : an `m.Inventory` of its recorder
        """
        found, lacking = [], 0
        with self._here:
            for entry in inventory.streams:
                stream, share = Stream(entry.topic, entry.source, entry.start), self._share(entry.topic)
                before = self._before.get(stream, -1)
                self._before[stream] = entry.last
                if share is None or not share.filled:
                    continue
                held = self._held.setdefault(stream, Numbers())
                absent = self._absent.setdefault(stream, Numbers())
                first, last = -(-entry.first // share.every), entry.last // share.every
                runs = [run for gap in held.missing(first, last) for run in absent.missing(*gap)]
                lacking += _count(runs)
                old = before // share.every  # what is newer may be on its way
                runs = [(a, min(b, old)) for a, b in runs if a <= old]
                if runs:
                    found.append(Gap(stream, share, runs))
            self._lacking = lacking
            self.settled = sum(_count(gap.runs) for gap in found)
        found.sort(key=lambda gap: (gap.share.turn, topics.rank(gap.stream.topic)))
        return found

    def fill(self, raws: list[RawMessage], gap: Gap, whole: bool) -> list[tuple[int, int]]:
        """Take the answer to a question for a gap; returns the runs that are still to be asked for.

        Parameters
        ----------
        raws : messages, by number
        gap : what was asked for
        whole : whether all came that its recorder has; the link or the aircraft's router may have cut the answer
        """
        stream, every = gap.stream, gap.share.every
        came = [raw for raw in raws if raw.topic == stream.topic and raw.envelope.sequence % every == 0]
        new = sum(self.receive(raw) for raw in came)
        self.filled += new
        upto = gap.runs[-1][1] if whole else came[-1].envelope.sequence // every if came else -1
        with self._here:
            # what lies before and did not come is not on board either
            gone = [run for a, b in gap.runs if a <= upto for run in self._held[stream].missing(a, min(b, upto))]
            for a, b in gone:
                self._absent[stream].add_run(a, b)
            done = new + _count(gone)
            self._lacking, self.settled = max(self._lacking - done, 0), max(self.settled - done, 0)
        return [(max(a, upto + 1), b) for a, b in gap.runs if b > upto]

    def _share(self, topic: str) -> Share | None:
        if topic in self._whole:
            return Share(topic, SHARES[-1].turn)
        return share_of(topic)


class Ground(Node):
    """Settings and state of the recorder on the ground.

    Parameters
    ----------
    output : folder of the recordings, ``<aircraft>.mcap``
    whole : topics that are asked for besides, every message, with commas between them; they come when nothing else does
    ask_s : aircraft are asked for what they have so often, s
    compression, rotate_mb, sign : see `Recorder`
    """

    name = "ground"
    inputs = tuple(share.topic for share in SHARES)
    outputs = ()

    def __init__(
        self, output: str = "fleet", whole: str = "", ask_s: float = INVENTORY_S, compression: str = "none",
        rotate_mb: float = 0, sign: str = "",
    ) -> None:  # fmt: skip
        super().__init__()
        if not ask_s > 0:
            raise ValueError(f"ask_s is {ask_s}, wanted more than 0")
        self.ask_s = ask_s
        self.folder = Path(output)
        self._whole = tuple(name.strip() for name in whole.split(",") if name.strip())
        for topic in self._whole:
            try:
                row = topics.find(topic)
            except KeyError:
                raise ValueError(f"whole: unknown topic {topic!r}") from None
            if not row.recorded:
                raise ValueError(f"whole: {topic} is not recorded on board")
        self._options = compression, rotate_mb, sign
        self.aircraft: dict[str, AircraftRecorder] = {}
        self._lock = threading.Lock()

    def recorder_of(self, platform: str) -> AircraftRecorder | None:
        """The recorder of an aircraft, made when it is heard first; None for what cannot be one."""
        with self._lock:
            found = self.aircraft.get(platform)
            if found is not None or platform == FLEET:
                return found
            if not _NAME.fullmatch(platform) or len(self.aircraft) >= MOST_AIRCRAFT:
                self.problem("refused", f"no recording of platform {platform[:64]!r}")
                return None
            made = AircraftRecorder(platform, str(self.folder / f"{platform}.mcap"), self._whole, *self._options)
            made.start()
            self.aircraft[platform] = made
            return made

    def state(self) -> str:
        missing = sum(aircraft.missing for aircraft in self.aircraft.values())
        return f"{len(self.aircraft)} aircraft, " + (f"{missing} messages to come" if missing else "nothing missing")

    def note(self) -> None:
        """Bring counters and alarms up to date."""
        for platform, aircraft in list(self.aircraft.items()):
            self.counters[f"{platform} missing"] = aircraft.missing
            self.counters[f"{platform} filled"] = aircraft.filled
            self.alarms[platform] = f"{platform}: {aircraft.alarms['disk']}" if aircraft.alarms.get("disk") else ""


def run(options: ProgramOptions) -> int:
    """Record a fleet until told to stop."""
    ground = build(Ground, options.tables, "ground")
    folder = ground.folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made: {(error.strerror or str(error)).lower()}") from None
    with Bus(FLEET, source="ground", port=options.port, file=options.bus_file, secure=options.secure) as bus:
        if alone := bus.why_alone():
            options.report(alone)
        _record(ground, bus, options)
    for platform, aircraft in sorted(ground.aircraft.items()):
        aircraft.close()
        total = sum(c.received for c in aircraft.statistics.values())
        files = ", ".join(map(str, aircraft.files))
        options.report(f"{platform}: {total} messages in {files}, {aircraft.filled} of them asked for; "
                       f"{aircraft.missing} missing")  # fmt: skip
    return 0


def _record(ground: Ground, bus: Bus, options: ProgramOptions) -> None:
    alive: set[tuple[str, str]] = set()
    filling: dict[str, threading.Thread] = {}

    def changed(platform: str, node: str, there: bool) -> None:
        if node in ANSWERS:
            (alive.add if there else alive.discard)((platform, node))

    def receive(platform: str, raw: RawMessage) -> None:
        aircraft = None
        if is_known(raw.topic):  # a desk that looks for an aircraft under any name does not make one
            aircraft = (ground.aircraft.get if raw.topic in DESK_STATUSES else ground.recorder_of)(platform)
        if aircraft is not None:
            aircraft.heard_s = time.monotonic()
            aircraft.receive(raw)

    def malformed(topic: str, why: str) -> None:
        ground.problem("malformed", f"{topic}: {why}")

    for name in ground.inputs:
        bus.hear(name, receive, malformed)
    bus.watch_fleet(changed)
    bus.announce("ground")
    status = StatusPublisher(bus, "ground")
    while not options.stop.wait(0.1):
        for platform, aircraft in list(ground.aircraft.items()):
            aircraft.tend()
            if platform not in filling:
                options.report(f"{platform}: recording to {aircraft.files[-1]}")
                linked = functools.partial(_answers, alive, platform)
                arguments = (aircraft, bus, options, linked, ground.ask_s)
                filling[platform] = threading.Thread(target=_fill, args=arguments, name=f"fill {platform}")
                filling[platform].start()
        ground.note()
        if status.due():
            status.publish(ground.state(), {}, ground, 0.0, 0, 0)
    for thread in filling.values():
        thread.join()


def _answers(alive: set[tuple[str, str]], platform: str) -> bool:
    """Whether somebody lives who answers for an aircraft."""
    return any((platform, node) in alive for node in ANSWERS)


def is_known(topic: str) -> bool:
    """Whether a topic is in the table of topics."""
    try:
        topics.find(topic)
    except KeyError:
        return False
    return True


def _fill(
    aircraft: AircraftRecorder, bus: Bus, options: ProgramOptions, linked: Callable[[], bool], ask_s: float
) -> None:
    """Ask an aircraft for what is missing, as long as there is a link."""
    told = 0
    while not options.stop.wait(ask_s):
        if not linked():
            continue
        try:
            answers = list(bus.ask("inventory", INVENTORY_ANSWER_S, aircraft.platform))
            inventory = next((m.Inventory.FromString(raw.data) for raw in answers if raw.topic == INVENTORY), None)
        except (ValueError, DecodeError):
            continue
        if inventory is None:
            continue
        gaps = aircraft.lacks(inventory)
        if gaps and not told:
            options.report(f"{aircraft.platform}: {aircraft.settled} messages are missing, and asked for")
        told += len(gaps)
        for gap in gaps:
            if not _fill_gap(aircraft, bus, gap, options):
                break
        if told and not aircraft.settled:
            options.report(f"{aircraft.platform}: nothing is missing any more, {aircraft.filled} came when asked for")
            told = 0


def _fill_gap(aircraft: AircraftRecorder, bus: Bus, gap: Gap, options: ProgramOptions) -> bool:
    """Ask for one gap; False where the link is gone again."""
    left = gap.runs
    while left and not options.stop.is_set():
        part, left = portion(left)
        text = ",".join(f"{a * gap.share.every}-{b * gap.share.every}" for a, b in part)
        raws: list[RawMessage] = []
        try:
            question = {**gap.stream._asdict(), "every": gap.share.every, "runs": text}
            for raw in bus.ask("recorded", ANSWER_S, aircraft.platform, **question):
                raws.append(raw)
                aircraft.heard_s = time.monotonic()
        except ValueError:  # what came counts
            pass
        whole = bool(raws) and raws[-1].topic == INVENTORY
        rest = aircraft.fill(raws, Gap(gap.stream, gap.share, part), whole)
        if rest == part:
            return False
        left = rest + left
    return True


def portion(runs: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Runs that fit into one question, and those that are left."""
    part: list[tuple[int, int]] = []
    room = MOST_ASKED
    for k, (a, b) in enumerate(runs):
        if not room or len(part) == MOST_RUNS:
            return part, runs[k:]
        end = min(b, a + room - 1)
        part.append((a, end))
        room -= end - a + 1
        if end < b:
            return part, [(end + 1, b), *runs[k + 1 :]]
    return part, []


def _count(runs: list[tuple[int, int]]) -> int:
    return sum(b - a + 1 for a, b in runs)
