"""UTC of image lines of a strip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...solver.matching.line_times import LineTimes
from ..convert import SECOND_NS


@dataclass(frozen=True)
class StripClock:
    """A strip and the times of its lines.

    Attributes
    ----------
    strip : `configuration/strip`
    times : of its lines, from the reference on
    reference_ns : UTC, ns
    """

    strip: Any
    times: LineTimes
    reference_ns: int

    def time_ns(self, line: float) -> int:
        """UTC of a line of any fraction, ns."""
        if self.times.is_constant:
            return int(self.strip.first_line_time_ns) + round(line * SECOND_NS / self.strip.line_rate_hz)
        return self.reference_ns + round(float(self.times.time_of(line)) * SECOND_NS)
