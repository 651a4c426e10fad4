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

from ..solver.matching.options import REAL_FLOOR_PX
from .errors import UserError

Tables = dict[str, dict[str, Any]]
#: Keys of ``[mounting]`` and ``[imu]`` in a flight.toml that are settings of the navigator.
_ARM = "camera_lever_arm_m"
UNIT = ("gyro_bias_deg_h", "accel_bias_mgal", "bias_time_s", "gyro_scale_ppm", "accel_scale_ppm")
#: Keys of ``[dem]`` in a flight.toml: the adjuster's setting, its type, and what is wanted.
_ELEVATION: dict[str, tuple[str, Any, str]] = {
    "file": ("dem", str, "a raster of heights in the folder"),
    "sigma_m": ("dem_sigma_m", int | float, "the sigma of a height at a place, m"),
    "shift_sigma_m": ("dem_shift_sigma_m", int | float, "the sigma of the error that all heights share, m"),
    "crs": ("dem_crs", str, 'what its heights count from: "ellipsoid", or a vertical CRS as "EPSG:5773"'),
}


def load(path: str | Path | None, known: Iterable[str] | None = None) -> Tables:
    """The tables of a configuration file, none without a file.

    Of a ``flight.toml`` those in ``[nodes]``, the elevation model of its ``[dem]`` as settings of the adjuster, and
    ``camera_lever_arm_m`` of its ``[mounting]`` and the biases of its ``[imu]`` as settings of the navigator. A flight
    folder is of a real camera: where nothing else is said the matcher has the floor of real pixels.

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
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not a TOML file: {error}") from None
    except RecursionError:
        raise UserError(f"{path}: not a TOML file: nested too deep") from None
    except ValueError as error:  # numbers of thousands of digits
        raise UserError(f"{path}: not a TOML file: {error}") from None
    if isinstance(tables.get("flight"), dict):  # the settings of nodes in a flight.toml
        dem = elevation(Path(path)) if "dem" in tables else {}
        navigates = known is None or "navigator" in known
        unit = _inertial_unit(Path(path), tables) if navigates else {}
        tables = tables.get("nodes", {})
        if dem and isinstance(tables.get("adjuster", {}), dict):
            tables = tables | {"adjuster": dem | tables.get("adjuster", {})}
        if unit and isinstance(tables.get("navigator", {}), dict):
            tables = tables | {"navigator": unit | tables.get("navigator", {})}
        if isinstance(tables.get("matcher", {}), dict):
            tables = tables | {"matcher": {"image_sigma_px": REAL_FLOOR_PX} | tables.get("matcher", {})}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise UserError(f"{path}: {name} stands outside a table, wanted [node] tables")
        if known is not None and name not in known:
            raise UserError(f"{path}: table [{name}] is not known, wanted one of {', '.join(known)}")
    return tables


def _inertial_unit(path: Path, tables: Tables) -> dict[str, Any]:
    """Settings of the navigator by ``[mounting]`` and ``[imu]`` of a ``flight.toml``: what messages do not say of a
    unit, where it is from the perspective centre, and its biases and scale factors."""
    mounting, imu = tables.get("mounting", {}), tables.get("imu", {})
    arm = mounting.get(_ARM, [0.0]) if isinstance(mounting, dict) else None
    if not (isinstance(arm, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in arm)):
        raise UserError(f"{path}: mounting.{_ARM} is {arm!r}, wanted 3 numbers: forward, right, down, m")
    found: dict[str, Any] = {_ARM: arm} if any(arm) else {}
    return found | {key: imu[key] for key in UNIT if isinstance(imu, dict) and key in imu}


def elevation(path: Path, wanted: bool = False) -> dict[str, Any]:
    """Settings of the adjuster that say what ``[dem]`` of a ``flight.toml`` does.

    None without such a table, and where it states no sigma: then the raster is no control of heights.

    Raises
    ------
    UserError : not TOML, no such table or no sigma where they are wanted, a value that is not of its kind
    """
    found = _dem(path, ("file", "sigma_m") if wanted else ())
    return found if "dem_sigma_m" in found else {}


def raster_of_heights(path: Path) -> tuple[Path, str | None]:
    """File and, where it is stated, CRS of ``[dem]`` of a ``flight.toml``.

    Raises
    ------
    UserError : not TOML, no such table, a value that is not of its kind
    """
    found = _dem(path, ("file",))
    return Path(found["dem"]), found.get("dem_crs")


def _dem(path: Path, wanted: tuple[str, ...]) -> dict[str, Any]:
    """What ``[dem]`` states, as settings of the adjuster; some keys are wanted, or none and not even the table."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig")).get("dem")
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a TOML file: {error}") from None
    if table is None and not wanted:
        return {}
    if not isinstance(table, dict):
        raise UserError(f"{path}: wanted a table [dem] with {' and '.join(wanted or ('file',))}")
    found: dict[str, Any] = {}
    for key, (setting, kind, what) in _ELEVATION.items():
        value = table.get(key)
        if value is None and key not in (wanted or ("file",)):
            continue
        good = isinstance(value, kind) and not isinstance(value, bool)
        if not good or (isinstance(value, int | float) and not 0 < value < float("inf")):
            raise UserError(f"{path}: dem.{key} is {'missing' if value is None else repr(value)}, wanted {what}")
        found[setting] = str(path.parent / str(value)) if key == "file" else value
    unknown = [key for key in table if key not in _ELEVATION]
    if unknown:
        raise UserError(f"{path}: dem.{unknown[0]}: not known, wanted {', '.join(_ELEVATION)}")
    return found


def build(cls: Any, tables: Tables, name: str | None = None) -> Any:
    """An instance of a node class with what its table says.

    Raises
    ------
    UserError : a key the node does not know, or a value it refuses
    """
    table_name: str = cls.name if name is None else name
    table = tables.get(table_name, {})
    known = settings_of(cls)
    for key in table:
        if key not in known:
            wanted = f"wanted one of {', '.join(known)}" if known else "the node has nothing to configure"
            raise UserError(f"configuration [{table_name}]: {key} is not known, {wanted}")
    for key, value in table.items():
        wanted = _wanted(known[key], value)
        if wanted:
            raise UserError(f"configuration [{table_name}]: {key} is {value!r}, wanted {wanted}")
    try:
        return cls(**table)
    except (ValueError, TypeError) as error:
        raise UserError(f"configuration [{table_name}]: {error}") from None


def settings_of(cls: Any) -> dict[str, Any]:
    """Settings of a node class and their defaults: its named arguments that a file can state.

    None as the default stands for a number that is found where nobody states it. Arguments for programs that make a
    node themselves (what a viewer draws on) are no settings.
    """
    parameters = inspect.signature(cls).parameters.items()
    named = {key: p for key, p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)}
    return {
        key: p.default
        for key, p in named.items()
        if isinstance(p.default, bool | int | float | str) or "float" in str(p.annotation)
    }


def _wanted(default: Any, value: Any) -> str:
    """What a value should be to take the place of a default; empty if it can."""
    if isinstance(default, bool):
        return "" if isinstance(value, bool) else "true or false"
    if default is None or isinstance(default, int | float):
        return "" if isinstance(value, int | float) and not isinstance(value, bool) else "a number"
    if isinstance(default, str):
        return "" if isinstance(value, str) else "a text"
    return ""
