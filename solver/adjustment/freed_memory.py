"""What the C library does with the memory of arrays that are no longer needed."""

from __future__ import annotations

import numpy as np

#: Bytes of an array up to which its memory is kept: room for those of a step, which are formed for some ten thousand
#: rays at a time. Of larger ones it goes back at once; of all together about twice this is kept.
KEPT = 1 << 24


def keep_freed_memory() -> None:
    """Let arrays take over the memory of those before them, from one step and one adjustment to the next.

    A process that has only had small arrays gets memory for every larger one from the system, which clears it page by
    page as it is written to: of an adjustment of 5 000 rays this was a sixth of the time at best, and two fifths in the
    median. The C library (glibc) stops that for arrays as large as one that was given back before, so one that is never
    written to is enough. Other libraries do as they always do.
    """
    np.empty(KEPT, dtype=np.uint8)
