"""Work of the window that can wait: what of it is done in which update, by platform time and not by their number."""

from __future__ import annotations

#: Updates that follow each other faster than this, s, share the work that can wait: each does one part of it.
HURRIED_S = 0.1
#: Time between two turns of each part, s; done in the next update after it.
LOOK_AFTER, RETEST, WATCH = "look after", "retest", "watch"
EVERY_S = {LOOK_AFTER: 0.1, RETEST: 0.1, WATCH: 0.3}
#: An update with other work puts off what is late by less than this share of its time.
PUT_OFF = 1.0
_SMALL_S = 1e-6


class Duties:
    """Tells each update which parts are its own."""

    def __init__(self) -> None:
        self._now_s = float("-inf")
        self._done_s = dict.fromkeys(EVERY_S, float("-inf"))

    def take(self, now_s: float, busy: bool = False) -> set[str]:
        """The parts that an update does.

        Parameters
        ----------
        now_s : platform time of the update
        busy : it has other work that does not come with every update
        """
        hurried = now_s - self._now_s < HURRIED_S
        self._now_s = max(self._now_s, now_s)
        late = {part: (now_s - done_s) / EVERY_S[part] - 1.0 for part, done_s in self._done_s.items()}
        due = {part for part, share in late.items() if share >= -_SMALL_S}
        if hurried and due:
            most = max(EVERY_S, key=lambda part: late[part])
            due = set() if busy and late[most] < PUT_OFF else {most}
        for part in due:
            self._done_s[part] = now_s
        return due
