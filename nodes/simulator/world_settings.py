"""What the world of a simulation has that is not stated, as ``key=value``: read, and written back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ...solver.simulation.error_models import Three
from ...solver.simulation.misstated import AS_STATED, Sine, Step, World
from ..errors import UserError


@dataclass(frozen=True)
class Key:
    """One kind of error.

    Attributes
    ----------
    field : of the `World`
    wanted : what its value is, for help and errors
    read : value of the field from the text after ``=``; raises ValueError
    write : the text of a value
    many : whether it may be given more than once: the field is a tuple of values
    """

    field: str
    wanted: str
    read: Callable[[str], Any]
    write: Callable[[Any], str]
    many: bool = False


def _numbers(text: str) -> list[float]:
    numbers = [float(part) for part in text.replace(",", " ").split()]
    if not np.isfinite(numbers).all():
        raise ValueError(text)
    return numbers


def _one(text: str) -> float:
    (number,) = _numbers(text)
    return number


def _three(text: str) -> Three:
    """Three numbers, or one for all axes."""
    numbers = _numbers(text)
    x, y, z = numbers * 3 if len(numbers) == 1 else numbers
    return x, y, z


def _shown(value: Three) -> str:
    return ",".join(f"{v:g}" for v in (value[:1] if len(set(value)) == 1 else value))


def _unit(*units: tuple[str, float]) -> Callable[[str], float]:
    """Reads a number that may carry one of some units, each with its size in that of the field."""

    def read(text: str) -> float:
        for unit, size in units:
            if text.endswith(unit):
                return _one(text.removesuffix(unit)) * size
        return _one(text)

    return read


def _step(text: str) -> Step:
    size, at, time_s = text.partition("@")
    return Step(_three(size), _unit(("s", 1.0))(time_s) if at else None)


def _sine(text: str) -> Sine:
    size, _, rest = text.partition("@")
    frequency, at, part = rest.partition("@")
    sine = Sine(_three(size), _unit(("Hz", 1.0))(frequency))
    if not at:
        return sine
    begin, _, end = part.partition("-")
    return replace(sine, from_s=_one(begin), to_s=_unit(("s", 1.0))(end))


def _shown_sine(sine: Sine) -> str:
    text = f"{_shown(sine.amplitude_deg)}@{sine.frequency_hz:g}"
    return text if np.isinf([sine.from_s, sine.to_s]).all() else f"{text}@{sine.from_s:g}-{sine.to_s:g}"


def _heavy(text: str) -> bool:
    if text not in ("t3", "normal"):
        raise ValueError(text)
    return text == "t3"


def _number(value: float) -> str:
    return f"{value:g}"


KEYS: dict[str, Key] = {
    "wander-factor": Key("wander_factor", "a factor on the sigma of the wander", _one, _number),
    "wander-time-factor": Key("wander_time_factor", "a factor on its correlation time", _one, _number),
    "random-walk": Key("random_walk_m", "m/sqrt(s) of the position, one or X,Y,Z", _three, _shown),
    "step": Key(
        "steps", "m of the GNSS, one or X,Y,Z, @ seconds of the flight (else in mid-strip)", _step,
        lambda v: _shown(v.size_m) + ("" if v.time_s is None else f"@{v.time_s:g}"), many=True,
    ),
    "sine": Key(
        "sines", "deg@Hz of the attitude, deg one or omega,phi,kappa, @ from-to seconds of the flight (else all along)",
        _sine, _shown_sine, many=True,
    ),
    "boresight": Key("boresight_deg", "deg, one or roll,pitch,heading", _three, _shown),
    "lever-arm": Key("lever_arm_m", "m, one or three in the body frame", _three, _shown),
    "focal-length": Key("focal_length_um", "um", _unit(("um", 1.0), ("mm", 1e3)), _number),
    "distortion": Key("distortion_px", "px at the corner of the image, radial", _one, _number),
    "clock": Key(
        "clock_s", "s, or ms with its unit: stamps of GNSS and INS minus image time",
        _unit(("ms", 1e-3), ("s", 1.0)), _number,
    ),
    "tie-noise": Key(
        "heavy_tails", "t3 or normal: distribution of image measurements", _heavy, lambda v: "t3" if v else "normal"
    ),
    "tie-noise-factor": Key("noise_factor", "a factor on their noise", _one, _number),
    "gnss-datum": Key("gnss_datum_m", "m of all positions, one or X,Y,Z", _three, _shown),
    "control-datum": Key("control_datum_m", "m of all control, one or X,Y,Z", _three, _shown),
}  # fmt: skip

HELP = "\n".join(f"{name}: {key.wanted};" for name, key in KEYS.items()).rstrip(";") + "."


def world_from(terms: Iterable[Any]) -> World:
    """The world of some ``key=value``.

    Raises
    ------
    UserError : a key that is not known or comes twice, a value that cannot be
    """
    values: dict[str, Any] = {}
    for term in terms:
        name, equals, text = str(term).partition("=")
        name = name.strip()
        key = KEYS.get(name)
        if key is None or not equals:
            raise UserError(f"true {str(term)!r}: wanted KEY=VALUE with KEY one of {', '.join(KEYS)}")
        if key.field in values and not key.many:
            raise UserError(f"true {name}: given twice, wanted once")
        try:
            value = key.read(text.strip())
            changed: dict[str, Any] = {key.field: (value,) if key.many else value}
            replace(AS_STATED, **changed)
        except ValueError as error:
            said = str(error).removeprefix("true world: ")
            why = f" ({said})" if str(error).startswith("true world") else ""
            raise UserError(f"true {term!r}: wanted {name}=VALUE with VALUE {key.wanted}{why}") from None
        values[key.field] = (*values.get(key.field, ()), value) if key.many else value
    return replace(AS_STATED, **values)


def world_terms(world: World) -> list[str]:
    """A world as the ``key=value`` that give it; none for one that is as stated."""
    by_field = {key.field: (name, key) for name, key in KEYS.items()}
    terms = []
    for field in fields(world):
        value, (name, key) = getattr(world, field.name), by_field[field.name]
        if value != getattr(AS_STATED, field.name):
            terms += [f"{name}={key.write(v)}" for v in (value if key.many else (value,))]
    return terms


def world_text(world: World) -> str:
    """The same in one line."""
    return " ".join(world_terms(world))
