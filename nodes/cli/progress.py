"""Progress of long work: a bar on a terminal, plain lines elsewhere, nothing with --quiet."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..terminal import drawing, plain, redraws

#: Time between two plain lines, s.
_LINE_PERIOD_S = 5.0


@contextmanager
def progress(text: str, quiet: bool = False) -> Iterator[Callable[[float], None] | None]:
    """Yield a function that takes the fraction done, 0 to 1."""
    if quiet:
        yield None
    elif redraws(sys.stderr):
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress

        with Progress(console=Console(file=drawing(sys.stderr)), transient=True) as bar:
            task = bar.add_task(escape(plain(text)), total=1.0)
            yield lambda fraction: bar.update(task, completed=fraction)
    else:
        last = time.monotonic()

        def line(fraction: float) -> None:
            nonlocal last
            if time.monotonic() - last >= _LINE_PERIOD_S:
                last = time.monotonic()
                print(f"{text}: {100 * fraction:.0f} %", file=sys.stderr, flush=True)

        yield line
