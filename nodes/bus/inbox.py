"""What has arrived from the bus and waits for the node."""

from __future__ import annotations

import threading
from collections import Counter, deque

from ...schemas.envelope import RawMessage
from ...schemas.topics import Queue

#: Waiting messages of lossless topics after which publishers are slowed down.
LOSSLESS_DEPTH = 20_000
#: Waiting messages of each newest-first topic; fewer, but 16 at least, where they take more bytes than this.
NEWEST_DEPTH, NEWEST_LEAST, NEWEST_BYTES = 2_000, 16, 32 << 20


class Inbox:
    """The bounded queue between the bus and a worker: lossless topics block, newest-first topics lose their oldest."""

    def __init__(
        self, lossless_depth: int = LOSSLESS_DEPTH, newest_depth: int = NEWEST_DEPTH, newest_bytes: int = NEWEST_BYTES
    ) -> None:
        self._condition = threading.Condition()
        self._entries: deque[list[RawMessage | None]] = deque()
        self._newest: dict[str, deque[list[RawMessage | None]]] = {}
        self._lossless = 0
        self._lossless_depth = lossless_depth
        self._newest_depth = newest_depth
        self._newest_bytes = newest_bytes
        self._closed = False
        self.dropped: Counter[str] = Counter()

    def put(self, raw: RawMessage, policy: Queue) -> None:
        """Add a message; waits while the queue is full of lossless messages."""
        with self._condition:
            entry: list[RawMessage | None] = [raw]
            if policy is Queue.LOSSLESS:
                while self._lossless >= self._lossless_depth and not self._closed:
                    self._condition.wait(0.5)
                self._lossless += 1
            else:
                waiting = self._newest.setdefault(raw.topic, deque())
                n = len(waiting)
                if n >= self._newest_depth or (n >= NEWEST_LEAST and n * len(raw.data) > self._newest_bytes):
                    waiting.popleft()[0] = None
                    self.dropped[raw.topic] += 1
                waiting.append(entry)
            self._entries.append(entry)
            self._condition.notify_all()

    def take(self, timeout_s: float) -> list[RawMessage]:
        """All waiting messages, in the order of arrival; waits for one at most ``timeout_s``."""
        with self._condition:
            if not self._entries:
                self._condition.wait(timeout_s)
            taken = [entry[0] for entry in self._entries if entry[0] is not None]
            self._entries.clear()
            self._newest.clear()
            self._lossless = 0
            self._condition.notify_all()
            return taken

    def __len__(self) -> int:
        return len(self._entries)

    def close(self) -> None:
        """Let go of whoever waits to put."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
