"""Options that every command takes, and checks that several make."""

from __future__ import annotations

import argparse

from ..errors import UserError, flag

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


def refuse_less(args: argparse.Namespace, least: int, *names: str) -> None:
    """Raise UserError where an option (as attribute), or one of its several numbers, is less than the least one."""
    for name in names:
        numbers = getattr(args, name)
        for number in numbers if isinstance(numbers, list) else [numbers]:
            if number is not None and number < least:
                raise UserError(f"{flag(name)} {number}, wanted {least} at least")
