"""When Python looks for unreachable objects.

Messages and results come and go by the thousand, and hardly any form cycles; a collection over all objects that live in
a window takes as long as several updates. So what is there at the start is set aside, the young are looked through
seldom, and all of them at times that the program chooses.
"""

from __future__ import annotations

import gc
import time

#: Between two collections over all objects, s.
PERIOD_S = 300.0
#: Newly made objects after which the young are looked through.
YOUNG = 20_000


class RareCollections:
    """From now on a collection over all objects happens only in `if_due`."""

    def __init__(self) -> None:
        gc.collect()
        gc.freeze()
        gc.set_threshold(YOUNG, 50, 1_000_000)
        self._last_s = time.monotonic()

    def if_due(self) -> bool:
        """Collect if the last time is long ago; whether it did."""
        now = time.monotonic()
        if now - self._last_s < PERIOD_S:
            return False
        self._last_s = now
        gc.collect()
        return True
