"""What comes down from an aircraft: which topics, how much of each, what first, and how many bytes a second.

What comes is counted by numbers: of a topic that is thinned out every n-th message comes, those whose number n divides.
So the ground knows which messages it lacks, however they came or did not come, and asks for them (`recorder.ground`).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...schemas import codec, topics
from ...schemas import messages as m
from ...schemas.envelope import RawMessage

#: The name under which a recorder's inventory travels.
INVENTORY = "query/inventory"
#: What is asked of an aircraft beside messages of topics.
QUESTIONS = ("orientation", "inventory", "recorded")
#: Turns: what is sent first. What fills gaps comes behind what steers the flight and before what only looks good.
FIRST, SECOND, GAPS, LAST = range(4)
#: Bytes that a message costs on the link beside payload and envelope: key, frames of Zenoh, TLS, TCP, IP and Ethernet;
#: and an answer, which names its key in full and what it answers. As `bench/fleet.py` measures them.
OVERHEAD, ANSWER_OVERHEAD = 200, 380
#: A link that was quiet may send so much at once, s of its bytes a second.
BURST_S = 0.25
#: Messages that wait for their turn, s: later ones are more worth, and what can be asked for again is.
PATIENCE_S = 3.0
#: A tile of an orthoimage comes with so many cells a side.
THUMBNAIL = 32
#: A status of more bytes comes with so many characters of each of its problems at most.
STATUS_BYTES, STATUS_TEXT = 1000, 200
#: Bytes of messages in one answer of a gap, about: an answer that the link cuts is asked for again as a whole.
PORTION_BYTES = 60_000
#: Runs of numbers and messages in one question, at most.
MOST_RUNS, MOST_ASKED = 60, 500


@dataclass(frozen=True)
class Share:
    """How much of a topic comes down.

    Attributes
    ----------
    topic : name of the table of topics
    turn : `FIRST`, `SECOND` or `LAST`
    every : every n-th message comes
    filled : whether the ground asks for those that did not come
    """

    topic: str
    turn: int
    every: int = 1
    filled: bool = True


#: What comes down. What is not named stays on board: image lines, inertial data, attitude, truth.
SHARES: tuple[Share, ...] = (
    Share("configuration/project", FIRST),
    Share("configuration/camera", FIRST),
    Share("configuration/strip", FIRST),
    Share("observation/control", FIRST),
    Share("observation/verdict", FIRST),
    Share("event/log", FIRST),
    Share("status/*", FIRST, every=4, filled=False),
    Share("orientation/live", FIRST, every=20, filled=False),
    Share("adjustment/report", FIRST, every=5),
    Share("sensor/gnss", FIRST, every=5),
    Share("trajectory/filtered", FIRST, every=200, filled=False),
    Share("orientation/final", SECOND),
    Share("observation/tie", SECOND),
    Share("observation/target", SECOND),
    Share("trajectory/smoothed", SECOND, every=10),
    Share("point/object", LAST),
    Share("orientation/whole", LAST),
    Share("orthoimage/live", LAST, filled=False),
    Share("orthoimage/final", LAST),
)


def share_of(topic: str) -> Share | None:
    """What comes down of a topic; None where it stays on board."""
    for share in SHARES:
        row = topics.find(share.topic)
        if row.matches(topic):
            return share
    return None


#: Verdicts are stamped so far ahead of platform time, ns: nobody has passed their place by then.
VERDICT_AHEAD_NS = 500_000_000


class Asked(NamedTuple):
    """A question for messages: those of a run of a publisher on a topic whose numbers lie in ``runs`` (first and last,
    both included) and are divided by ``every``."""

    topic: str
    source: str
    start: int
    runs: list[tuple[int, int]]
    every: int


def asked(parameters: dict[str, str]) -> Asked:
    """The question in the parameters of a query: topic, source, start, every, runs (``5-9,12-12``).

    Raises
    ------
    ValueError : one is missing or makes no sense
    """
    try:
        runs = [(int(a), int(b)) for a, _, b in (run.partition("-") for run in parameters["runs"].split(","))]
        start, every = int(parameters["start"]), int(parameters["every"])
        topic, source = parameters["topic"], parameters["source"]
    except (KeyError, ValueError):
        raise ValueError("wanted topic, source, start, every and runs") from None
    if every < 1 or len(runs) > MOST_RUNS or sum(b - a for a, b in runs) > MOST_ASKED * every:
        raise ValueError(f"wanted at most {MOST_RUNS} runs and {MOST_ASKED} messages")
    return Asked(topic, source, start, runs, every)


def for_the_link(raw: RawMessage) -> RawMessage:
    """A message as it comes down: tiles of orthoimages smaller, problems of a status in short, all others as they are.

    Raises
    ------
    ValueError : a tile or a status that is none
    """
    if raw.topic.startswith("status/") and len(raw.data) > STATUS_BYTES:
        status: Any = codec.decode(raw.topic, raw.data)
        for told in (status, *status.counters):
            told.last_problem = told.last_problem[:STATUS_TEXT]
        return raw._replace(data=codec.encode(status))
    if not raw.topic.startswith("orthoimage/"):
        return raw
    tile = m.GroundTile.FromString(bytes(raw.data))
    if tile.encoding != "mono8" or tile.size < 1 or len(tile.data) != tile.size**2:
        raise ValueError(f"{len(tile.data)} bytes of {tile.encoding!r} in a tile of {tile.size} cells a side")
    if tile.size <= THUMBNAIL or tile.size % THUMBNAIL:
        return raw
    step = tile.size // THUMBNAIL
    grey = np.frombuffer(tile.data, dtype=np.uint8).reshape(THUMBNAIL, step, THUMBNAIL, step).astype(np.float64)
    known = grey > 0  # 0: not known
    count = known.sum(axis=(1, 3))
    mean = np.divide((grey * known).sum(axis=(1, 3)), count, out=np.zeros_like(count, dtype=float), where=count > 0)
    tile.data, tile.size, tile.gsd_m = np.rint(mean).astype(np.uint8).tobytes(), THUMBNAIL, tile.gsd_m * step
    return raw._replace(data=tile.SerializeToString(deterministic=True))


def cost(raw: RawMessage, overhead: int = OVERHEAD) -> int:
    """Bytes of a message on the link, about."""
    return len(raw.data) + 25 + len(raw.envelope.source) + overhead


class Meter:
    """Lets so many bytes a second pass; who has an earlier turn goes first.

    Parameters
    ----------
    bytes_s : bytes a second; 0 = no limit
    clock : steady time, s

    Attributes
    ----------
    passed : bytes so far
    """

    def __init__(self, bytes_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.bytes_s = bytes_s
        self.passed = 0
        self._clock = clock
        self._condition = threading.Condition()
        self._waiting = [0] * (LAST + 1)
        self._credit = bytes_s * BURST_S
        self._seen_s = clock()

    def wait_s(self, turn: int) -> float:
        """How long the next message of a turn has to wait at least, s; infinite while an earlier turn waits."""
        if not self.bytes_s:
            return 0.0
        now_s = self._clock()
        self._credit = min(self._credit + (now_s - self._seen_s) * self.bytes_s, self.bytes_s * BURST_S)
        self._seen_s = now_s
        if any(self._waiting[:turn]):
            return float("inf")
        return max(-self._credit / self.bytes_s, 0.0)

    def spend(self, n: int) -> None:
        """So many bytes pass now; the next ones wait for it."""
        self.passed += n
        self._credit -= n

    def let_pass(self, n: int, turn: int, stop: Callable[[], bool]) -> bool:
        """Wait until n bytes may pass; False where ``stop`` says so before."""
        with self._condition:
            self._waiting[turn] += 1
            try:
                while (wait_s := self.wait_s(turn)) > 0.0:
                    if stop():
                        return False
                    self._condition.wait(min(wait_s, 0.05))
                self.spend(n)
            finally:
                self._waiting[turn] -= 1
                self._condition.notify_all()
        return True


class Waiting:
    """Messages that wait for the link, by turn; those that wait too long, and are not latched, are left out."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._condition = threading.Condition()
        self._turns: tuple[deque[tuple[float, RawMessage]], ...] = tuple(deque() for _ in range(LAST + 1))
        #: Messages that were left out because the link had no room for them.
        self.left_out = 0

    def put(self, raw: RawMessage, turn: int) -> None:
        """Take a message; never waits."""
        with self._condition:
            self._turns[turn].append((self._clock(), raw))
            self._condition.notify()

    def take(self, timeout_s: float) -> tuple[RawMessage, int] | None:
        """The next message and its turn; None where none comes in time."""
        with self._condition:
            found = self._next()
            if found is None:
                self._condition.wait(timeout_s)
                found = self._next()
            return found

    def _next(self) -> tuple[RawMessage, int] | None:
        now_s = self._clock()
        for turn, waiting in enumerate(self._turns):
            while waiting:
                since_s, raw = waiting.popleft()
                if now_s - since_s <= PATIENCE_S or topics.find(raw.topic).latched:
                    return raw, turn
                self.left_out += 1
        return None

    def __len__(self) -> int:
        return sum(map(len, self._turns))
