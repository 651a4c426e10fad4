"""Flights of ``triline study misspecified`` that have been flown, so that hours of them need not be flown in one go."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.simulation.misspecified_study import FlightFigures, Quality
from ..errors import UserError
from ..formats.json_text import plain

#: What a flight goes through: with other code in these rooms it would come out otherwise.
FLOWN_THROUGH = (
    "solver/adjustment", "solver/camera", "solver/estimation", "solver/geometry", "solver/models", "solver/navigation",
    "solver/simulation", "solver/window", "nodes/adjuster", "nodes/navigator",
)  # fmt: skip

_PACKAGE = Path(__file__).resolve().parents[2]
_QUALITIES = ("online", "online_in_truth", "batch", "components")


@dataclass(frozen=True)
class Flown:
    """What makes two flights the same one.

    Attributes
    ----------
    setting, row, seed : as `fly` takes them
    plan : all else that was asked for, as words
    code : of the rooms in `FLOWN_THROUGH`, see `code_digest`
    """

    setting: str
    row: str
    seed: int
    plan: str
    code: str


class KeptFlights:
    """A file with a line of JSON for each flight that was flown; it is made where it is not there.

    Raises
    ------
    UserError : the file is something else, or cannot be written
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._figures: dict[Flown, FlightFigures] = {}
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read, wanted flights of --flights ({error})") from None
        *lines, rest = text.split("\n")
        for number, line in enumerate(lines, 1):
            try:
                flown, figures = _read(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError):
                raise UserError(f"{path}: line {number}: wanted a flight of triline study misspecified") from None
            self._figures[flown] = figures
        if rest and not lines:
            raise UserError(f"{path}: line 1: wanted a flight of triline study misspecified")
        try:
            with path.open("r+b" if path.exists() else "wb") as file:
                file.truncate(len(text.encode()) - len(rest.encode()))  # of a flight that was being written
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror})") from None

    def __len__(self) -> int:
        return len(self._figures)

    def of_other_code(self, code: str) -> int:
        """How many of them other code has flown."""
        return sum(flown.code != code for flown in self._figures)

    def get(self, flown: Flown) -> FlightFigures | None:
        return self._figures.get(flown)

    def add(self, flown: Flown, figures: FlightFigures) -> None:
        """Write a flight down at once, whatever happens to the next one."""
        self._figures[flown] = figures
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"flight": asdict(flown), "figures": plain(asdict(figures))}) + "\n")
            file.flush()
            os.fsync(file.fileno())


def code_digest() -> str:
    """Twelve digits that change with any file of the rooms in `FLOWN_THROUGH`."""
    digest = hashlib.sha256()
    for room in FLOWN_THROUGH:
        for path in sorted((_PACKAGE / room).rglob("*.py")):
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def _read(line: dict[str, Any]) -> tuple[Flown, FlightFigures]:
    values = {field.name: line["figures"][field.name] for field in fields(FlightFigures)}
    for name in _QUALITIES:
        values[name] = Quality(**{key: _number(value) for key, value in values[name].items()})
    values["component_factors"] = {key: _number(value) for key, value in values["component_factors"].items()}
    for name in ("direct_m", "sigma0", "rejected", "good_share"):
        values[name] = _number(values[name])
    return Flown(**line["flight"]), FlightFigures(**values)


def _number(value: Any) -> Any:
    """A number, or a tuple of them, as it was before JSON, which has no NaN."""
    if isinstance(value, list):
        return tuple(_number(v) for v in value)
    return np.nan if value is None else float(value)
