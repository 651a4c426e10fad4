"""Values of TOML and JSON files, checked one by one: errors name file, key and what was wanted."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError

#: Largest integer of a file: larger ones are no double.
LARGEST = 1 << 53


class Keys:
    """One table (object) of a file, read key by key.

    Parameters
    ----------
    path : file, for messages
    values : the table
    where : place of the table in the file, e.g. ``lines[2]``
    """

    def __init__(self, path: Path, values: Any, where: str = ""):
        if not isinstance(values, Mapping):
            raise UserError(f"{path}: {where or 'top level'}: {_shown(values)}, wanted a table of keys")
        self.path, self.values, self.where = path, values, where
        self._read: set[str] = set()

    def name(self, key: str) -> str:
        return f"{self.where}.{key}" if self.where else key

    def refuse(self, key: str, wanted: str) -> UserError:
        """The error for a key that is missing or holds something else than what was wanted."""
        if key not in self.values:
            return UserError(f"{self.path}: {self.name(key)}: missing, wanted {wanted}")
        return UserError(f"{self.path}: {self.name(key)}: {_shown(self.values[key])}, wanted {wanted}")

    def has(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str, default: str | None = None) -> str:
        value = self._get(key, default)
        if not isinstance(value, str) or (not value.strip() and default is None):
            raise self.refuse(key, "a text")
        return value

    def number(
        self, key: str, default: float | None = None, *, positive: bool = False, low: float | None = None
    ) -> float:
        value = self._get(key, default)
        if not _is_number(value) or (positive and not value > 0):
            raise self.refuse(key, "a number above 0" if positive else "a number")
        if low is not None and value < low:
            raise self.refuse(key, f"a number of at least {low:g}")
        return float(value)

    def integer(self, key: str, default: int | None = None, *, low: int = 0, high: int = LARGEST) -> int:
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            most = f" and at most {high}" if isinstance(value, int) and value > high else ""
            raise self.refuse(key, f"an integer of at least {low}{most}")
        return value

    def numbers(
        self,
        key: str,
        count: int,
        default: tuple[float, ...] | None = None,
        *,
        positive: bool = False,
        low: float | None = None,
    ) -> tuple[float, ...]:
        value = self._get(key, default)
        good = isinstance(value, list | tuple) and len(value) == count and all(_is_number(v) for v in value)
        if not good or (positive and not all(v > 0 for v in value)):
            raise self.refuse(key, f"{count} {'positive ' if positive else ''}numbers")
        if low is not None and min(value) < low:
            raise self.refuse(key, f"{count} numbers of at least {low:g}")
        return tuple(float(v) for v in value)

    def tables(self, key: str) -> list[Keys]:
        """A list of tables."""
        value = self._get(key, None)
        if not isinstance(value, list) or not value:
            raise self.refuse(key, "a list with at least one entry")
        return [Keys(self.path, entry, f"{self.name(key)}[{i}]") for i, entry in enumerate(value)]

    def table(self, key: str) -> Keys:
        """A table, empty if absent."""
        return Keys(self.path, self._get(key, {}), self.name(key))

    def raw(self, key: str, default: Any = None) -> Any:
        return self._get(key, default)

    def unread(self) -> list[str]:
        """Keys that were not read."""
        return [self.name(key) for key in self.values if key not in self._read]

    def _get(self, key: str, default: Any) -> Any:
        self._read.add(key)
        return self.values.get(key, default)


def is_there(path: Path) -> bool:
    """Whether there is a file or folder; names that the system does not take are not there."""
    try:
        return path.exists()
    except OSError:
        return False


def read_toml(path: Path) -> Keys:
    """A TOML file.

    Raises
    ------
    UserError : not TOML, with line and column
    """
    try:
        return Keys(path, tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file, wanted TOML") from None
    except RecursionError:
        raise UserError(f"{path}: not valid TOML: nested too deep") from None
    except ValueError as error:  # numbers of thousands of digits
        raise UserError(f"{path}: not valid TOML: {error}") from None


def read_json(path: Path) -> Keys:
    """A JSON file.

    Raises
    ------
    UserError : not JSON, with line and column
    """
    try:
        return Keys(path, json.loads(path.read_text(encoding="utf-8-sig")))
    except json.JSONDecodeError as error:
        raise UserError(f"{path}:{error.lineno}: not valid JSON: {error.msg} (column {error.colno})") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file, wanted JSON") from None
    except RecursionError:
        raise UserError(f"{path}: not valid JSON: nested too deep") from None
    except ValueError as error:  # numbers of thousands of digits
        raise UserError(f"{path}: not valid JSON: {error}") from None


def _is_number(value: Any) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    try:
        return bool(np.isfinite(float(value)))
    except OverflowError:  # an integer of hundreds of digits
        return False


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested deep, or an integer of thousands of digits
        return f"a {type(value).__name__} that is too large to show"
    return text if len(text) <= 60 else text[:57] + "..."
