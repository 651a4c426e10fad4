"""A camera as options and settings name it: by its file, or by the name of a preset."""

from __future__ import annotations

from pathlib import Path

from ...solver.camera.line_camera import LineCamera
from ...solver.camera.sensors import PRESETS, preset
from ..errors import UserError
from .camera_json import read_camera
from .geocal_xml import read_glas_camera


def camera_named(text: str, where: str, notes: list[str] | None = None) -> LineCamera:
    """A camera from a file (camera.json or AVIRIS-NG XML) or by the name of a preset.

    Parameters
    ----------
    where : the option or setting, for the error
    notes : gets remarks

    Raises
    ------
    UserError : none of these, or a file that cannot be read
    """
    path = Path(text)
    if path.is_file():
        return read_glas_camera(path) if path.suffix.lower() == ".xml" else read_camera(path, notes)
    if text in PRESETS:
        return preset(text)
    raise UserError(f"{where} {text}: no such file, and no preset of that name; presets: {', '.join(PRESETS)}")
