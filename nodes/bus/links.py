"""Whether a session still hears those who speak: after a standstill single links can be gone for good.

Zenoh closes a link whose other end has been silent for the lease (4 s). Where a process stood still for about as long
(stopped, a machine that slept or swapped), some of its links are closed and others are not. Of those that are closed
only the one with the meeting point is made again: others go on publishing, and this node never hears them. Two signs
tell it, both judged here without a clock and without a bus:

- this process stood still, and links that it had before are gone now;
- another node says that it receives a topic which this one has heard before and hears no longer.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ...schemas import topics
from ...schemas.topics import Family

#: Time between two beats, s, and the time between two after which the process stood still.
BEAT_S, STOOD_STILL_S = 0.25, 2.5
#: Links are looked at for so long after a standstill, s: an end that expired is closed within the lease.
LOOK_S = 10.0
#: A topic that others receive is missed after so long, s, when they have said so this often since.
MISSED_S, TOLD = 3.0, 3
#: A session is not opened again sooner than after so long, s.
REST_S = 8.0


@dataclass
class LinkWatch:
    """Decides when a session has to be opened anew; all times are those of one steady clock, s."""

    _beat_s: float | None = None
    _peers: frozenset[str] = frozenset()
    _before: frozenset[str] = frozenset()
    _stood_s: float = 0.0
    _look_until_s: float = -1.0
    _rest_until_s: float = -1.0
    _heard_s: dict[str, float] = field(default_factory=dict)
    _told: dict[str, int] = field(default_factory=dict)

    def heard(self, topic: str, now_s: float) -> None:
        """A message of a topic has come."""
        self._heard_s[topic] = now_s
        self._told.pop(topic, None)

    def unwanted(self, name: str) -> None:
        """A subscription to a topic of the table has been ended on purpose: the topic is not missed, unless another
        subscription of this session still hears it."""
        row = topics.find(name)
        for topic in [topic for topic in self._heard_s if row.matches(topic)]:
            del self._heard_s[topic]
            self._told.pop(topic, None)

    def told(self, topic: str, now_s: float) -> None:
        """Another node says that it receives a topic at this time."""
        last = self._heard_s.get(topic)
        row = topics.find(topic)
        steady = row.rate_hz >= 1.0 and row.family is not Family.STATUS
        if last is not None and steady and not row.in_bursts and now_s - last > MISSED_S / 2:
            self._told[topic] = self._told.get(topic, 0) + 1

    def beat(self, now_s: float, peers: frozenset[str]) -> str:
        """Why the session has to be opened anew; "" if it need not.

        Parameters
        ----------
        now_s : time of this beat; they come every `BEAT_S` unless the process stands still
        peers : sessions that this one is linked with
        """
        stood_s = 0.0 if self._beat_s is None else now_s - self._beat_s
        self._beat_s = now_s
        if stood_s > STOOD_STILL_S:
            self._before, self._stood_s, self._look_until_s = self._peers, stood_s, now_s + LOOK_S
            # what was not heard in that time was not missed
            self._heard_s = dict.fromkeys(self._heard_s, now_s)
            self._told.clear()
        self._peers = peers
        if now_s < self._rest_until_s:
            return ""
        lost = self._before - peers if now_s < self._look_until_s else frozenset()
        if lost:
            return f"stood still for {self._stood_s:.1f} s, {len(lost)} of {len(self._before)} links are gone"
        for topic, number in self._told.items():
            silent_s = now_s - self._heard_s[topic]
            if number >= TOLD and silent_s > MISSED_S:
                return f"{topic} is received by others and not here for {silent_s:.1f} s"
        return ""

    def opened(self, now_s: float) -> None:
        """The session is a new one."""
        self._look_until_s, self._rest_until_s = -1.0, now_s + REST_S
        self._peers = frozenset()
        self._told.clear()
        self._heard_s = dict.fromkeys(self._heard_s, now_s)
