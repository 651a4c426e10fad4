"""Options that every command takes."""

from __future__ import annotations

import argparse

_OPTIONS = (
    (("--json",), "print a machine-readable result"),
    (("-q", "--quiet"), "print only the result and errors"),
    (("-v", "--verbose"), "print details"),
)


def add_common(parser: argparse.ArgumentParser, *, again: bool = False) -> None:
    """Add them to the parser of a command; ``again`` to that of an action of it, where one that stands before the
    action stays."""
    default = argparse.SUPPRESS if again else False
    for words, text in _OPTIONS:
        parser.add_argument(*words, action="store_true", default=default, help=text)
