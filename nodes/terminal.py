"""What is shown on a terminal: names, states and reasons come from files and other programs, and may hold anything.

A terminal obeys control characters: they move the cursor, change its title, hide what was written. None that came with
data reaches it. `clean_streams` stands around every command; who draws on a terminal asks `drawing` for the stream
beneath, and cleans with `plain` what it draws.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

#: Categories of Unicode that are written as escapes: control, surrogate, private use, not assigned, and separators that
#: break lines; of the format characters those that turn the direction of writing.
_ESCAPED = frozenset(("Cc", "Cs", "Co", "Cn", "Zl", "Zp"))
_TURNING = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\ufeff")


def plain(text: object, most: int = 0) -> str:
    r"""A text as one line that a terminal only shows: control characters become escapes such as ``\x1b``.

    Parameters
    ----------
    text : anything
    most : longest text, in characters; what is longer ends in ``...``; 0 = any length
    """
    shown = str(text)
    if most and len(shown) > most:
        shown = shown[: max(most - 3, 0)] + "..."
    return _clean(shown, "")


def _clean(text: str, kept: str) -> str:
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if c in kept or not _is_hostile(c) else _escape(c) for c in text)


def _is_hostile(c: str) -> bool:
    return c in _TURNING or unicodedata.category(c) in _ESCAPED


def _escape(c: str) -> str:
    if c in "\n\r\t":
        return " "
    return c.encode("unicode_escape").decode("ascii")


class CleanStream:
    """A text stream that writes lines and tabs as they are, as escapes all other control characters and what its
    encoding has not (a name with an umlaut on a terminal of ASCII).
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        shown, encoding = _clean(text, "\n\t"), getattr(self.stream, "encoding", None)
        if encoding and not shown.isascii():
            shown = shown.encode(encoding, "backslashreplace").decode(encoding)
        self.stream.write(shown)
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def redraws(stream: Any) -> bool:
    """Whether a stream is a terminal on which lines are drawn over: neither a file nor a dumb one, as in editors."""
    return bool(stream.isatty()) and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def width() -> int:
    """Characters that fit on a line of the terminal."""
    return max(shutil.get_terminal_size().columns - 1, 20)


def drawing(stream: Any) -> TextIO:
    """The stream beneath a `CleanStream`, for who moves the cursor himself."""
    return stream.stream if isinstance(stream, CleanStream) else stream


class _Closed(io.TextIOBase):
    """In the place of a stream that was closed before the program began (``>&-``).

    Parameters
    ----------
    wanted : whether what is written is a result, which then goes nowhere as with a closed pipe
    """

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted

    def write(self, text: str, /) -> int:
        if self._wanted:
            raise BrokenPipeError
        return len(text)


class _Lasting:
    """A text stream of which what cannot be written any more goes nowhere."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError):
            self.stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self.stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def whoever_reads() -> Iterator[None]:
    """In this block work goes on when what it says on standard output cannot be written any more.

    The terminal was closed, the program behind a pipe (``| tee``) was ended by the same Ctrl-C, or a disk is full.
    """
    out = sys.stdout
    sys.stdout = cast(TextIO, CleanStream(cast(TextIO, _Lasting(drawing(out)))))
    try:
        yield
    finally:
        sys.stdout = out


@contextmanager
def clean_streams() -> Iterator[None]:
    """Standard output and standard error take no control characters in this block."""
    out, err = sys.stdout, sys.stderr
    sys.stdout = cast(TextIO, CleanStream(drawing(out) or cast(TextIO, _Closed(wanted=True))))
    sys.stderr = cast(TextIO, CleanStream(drawing(err) or cast(TextIO, _Closed(wanted=False))))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = out, err
