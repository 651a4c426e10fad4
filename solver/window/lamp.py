"""The lamp that the operator looks at: the light with a memory.

It goes to a worse colour at once, and to a better one when that has held for a while; words of the same colour stay for
a while, so that it does not chatter. When a strip is over it says what became of the strip as a whole, until the next
one begins.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .ground import WHERE
from .light import FAILED, GOOD, WEAK, Situation, contradiction, datum_on_gnss, light, metres

Array = NDArray[np.floating]

#: A better colour is shown when it has held for so long, s.
HOLD_S = 3.0
#: Other figures in the words of the same colour are shown after so long, s, and words of another kind.
WORDS_S, KIND_S = 5.0, 1.0
#: A strip is good if this share of its final orientation is within the alert limit.
MOSTLY = 0.9
#: A strip has failed that contradicted itself for this share of its time, or at its end.
LONG = 0.1
RANK = {GOOD: 0, WEAK: 1, FAILED: 2}


def kind(reason: str) -> str:
    """A reason without what changes from second to second: its first words."""
    return " ".join([word for word in reason.split() if not any(map(str.isdigit, word))][:3])


@dataclass
class StripRecord:
    """What is remembered of a strip for the verdict.

    Attributes
    ----------
    strip : name
    final, beyond : times of its final orientation, and those beyond the alert limit
    worst_m, where, limit_m : largest protection level on the ground, of what, and the limit
    looks, failed : how often it was looked at, and how often it failed
    failure : why, the last time
    doubt : what contradicted what at the last look
    on_gnss : what of the datum rested on GNSS at the last look, "" if ever nothing did
    weak_for : looks, by reason without its figures
    words : of these reasons
    """

    strip: str
    final: int = 0
    beyond: int = 0
    worst_m: float = 0.0
    where: str = ""
    limit_m: float = np.inf
    looks: int = 0
    failed: int = 0
    failure: str = ""
    doubt: tuple[str, str] | None = None
    on_gnss: str | None = None
    weak_for: dict[str, int] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)

    def look(self, s: Situation, colour: str, reason: str) -> None:
        """Remember what the light said in flight."""
        self.looks += 1
        self.doubt = contradiction(s)
        self.limit_m = s.limit_m
        if self.on_gnss != "":
            self.on_gnss = datum_on_gnss(s)
        if colour == FAILED:
            self.failed += 1
            self.failure = reason
        elif colour == WEAK:
            self.weak_for[kind(reason)] = self.weak_for.get(kind(reason), 0) + 1
            self.words[kind(reason)] = reason.partition(" (")[0]

    def became_final(self, times: int, protection_m: Array | None, limit_m: float) -> None:
        """So many times of its orientation are final, with protection levels (times, 4) on the ground if known."""
        self.final += times
        if protection_m is None or not protection_m.shape[1]:
            self.beyond += times
            return
        self.beyond += int((protection_m.max(axis=1) > limit_m).sum())
        if protection_m.max() > self.worst_m:
            self.worst_m = float(protection_m.max())
            self.where = WHERE[int(np.argmax(protection_m.max(axis=0)))]

    def verdict(self) -> tuple[str, str]:
        """Colour and reason for the strip as a whole."""
        over = f"strip {self.strip} over"
        if self.doubt is not None and self.doubt[0] == FAILED:
            return FAILED, f"{over}: {self.doubt[1]}"
        if self.failed > LONG * self.looks:
            share = 100 * self.failed / self.looks
            return FAILED, f"{over}: {self.failure} (for {share:.0f} % of its time)"
        if self.doubt is not None:
            return WEAK, f"{over}: {self.doubt[1]}"
        if self.on_gnss:
            return WEAK, f"{over}: {self.on_gnss}"
        limit = "" if np.isinf(self.limit_m) else f" {metres(self.limit_m)}"
        if self.final and self.beyond <= (1.0 - MOSTLY) * self.final:
            return GOOD, f"{over}: within the limit of{limit}" if limit else over
        if not self.final:
            text = f"{over}: no orientation"
        else:
            text = f"{over}: {100 * self.beyond / self.final:.0f} % of its final orientation beyond the limit of{limit}"
        if self.where:
            text += f", {self.where} up to {metres(self.worst_m)} off unseen"
        if self.weak_for:
            text += f"; {self.words[max(self.weak_for, key=self.weak_for.__getitem__)]}"
        return WEAK, text


class Lamp:
    """See the module."""

    def __init__(self) -> None:
        self._records: dict[str, StripRecord] = {}
        self._said: deque[tuple[float, str, str]] = deque()
        self._strip = ""
        self._shown = GOOD, "no strip is flown"
        self._worded_s = -np.inf

    def became_final(self, strip: str, times: int, protection_m: Array | None, limit_m: float) -> None:
        """So many times of a strip are final; see `StripRecord.became_final`."""
        self._record(strip).became_final(times, protection_m, limit_m)

    def look(self, now_s: float, s: Situation) -> tuple[str, str]:
        """Colour and reason that are shown at a time."""
        if not s.flying:
            if self._strip:
                self._shown = self._record(self._strip).verdict()
                self._records.clear()
                self._strip = ""
            return self._shown
        colour, reason = light(s)
        self._record(s.strip).look(s, colour, reason)
        if s.strip != self._strip:
            self._strip = s.strip
            self._said.clear()
            self._worded_s = -np.inf
        self._said.append((now_s, colour, reason))
        while self._said[0][0] < now_s - HOLD_S:
            self._said.popleft()
        worst = max((c for _, c, _ in self._said), key=RANK.__getitem__)
        words = next(r for _, c, r in reversed(self._said) if c == worst)
        stay_s = WORDS_S if kind(words) == kind(self._shown[1]) else KIND_S
        if worst != self._shown[0] or now_s - self._worded_s >= stay_s:
            self._shown, self._worded_s = (worst, words), now_s
        return self._shown

    def _record(self, strip: str) -> StripRecord:
        return self._records.setdefault(strip, StripRecord(strip))
