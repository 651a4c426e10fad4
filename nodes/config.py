"""Configuration of nodes: a TOML file with one table a node.

    [adjuster]
    model = "ppm"

The keys are the named arguments of the node; what is not there keeps its default.
"""

from __future__ import annotations

import inspect
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .errors import UserError

Tables = dict[str, dict[str, Any]]


def load(path: str | Path | None, known: Iterable[str] | None = None) -> Tables:
    """The tables of a configuration file, none without a file; of a ``flight.toml`` those in ``[nodes]``.

    Parameters
    ----------
    path : of the file
    known : names that tables may have; None = any

    Raises
    ------
    UserError : not TOML, something outside a table, or a table of another name
    """
    if path is None:
        return {}
    try:
        with open(path, "rb") as file:
            tables = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not a TOML file: {error}") from None
    except RecursionError:
        raise UserError(f"{path}: not a TOML file: nested too deep") from None
    except ValueError as error:  # numbers of thousands of digits
        raise UserError(f"{path}: not a TOML file: {error}") from None
    if isinstance(tables.get("flight"), dict):  # the settings of nodes in a flight.toml
        tables = tables.get("nodes", {})
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise UserError(f"{path}: {name} stands outside a table, wanted [node] tables")
        if known is not None and name not in known:
            raise UserError(f"{path}: table [{name}] is not known, wanted one of {', '.join(known)}")
    return tables


def build(cls: Any, tables: Tables, name: str | None = None) -> Any:
    """An instance of a node class with what its table says.

    Raises
    ------
    UserError : a key the node does not know, or a value it refuses
    """
    table_name: str = cls.name if name is None else name
    table = tables.get(table_name, {})
    parameters = inspect.signature(cls).parameters
    known = [key for key, p in parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    for key in table:
        if key not in known:
            wanted = f"wanted one of {', '.join(known)}" if known else "the node has nothing to configure"
            raise UserError(f"configuration [{table_name}]: {key} is not known, {wanted}")
    for key, value in table.items():
        wanted = _wanted(parameters[key].default, value)
        if wanted:
            raise UserError(f"configuration [{table_name}]: {key} is {value!r}, wanted {wanted}")
    try:
        return cls(**table)
    except (ValueError, TypeError) as error:
        raise UserError(f"configuration [{table_name}]: {error}") from None


def _wanted(default: Any, value: Any) -> str:
    """What a value should be to take the place of a default; empty if it can."""
    if isinstance(default, bool):
        return "" if isinstance(value, bool) else "true or false"
    if default is None or isinstance(default, int | float):
        return "" if isinstance(value, int | float) and not isinstance(value, bool) else "a number"
    if isinstance(default, str):
        return "" if isinstance(value, str) else "a text"
    return ""
