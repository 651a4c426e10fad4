"""The sensor or RPC by which pixels are located, out of metadata of any kind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...solver.location.frame_camera import FrameCamera
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import Sigmas
from ..errors import UserError
from ..formats.frame_json import is_frame_json, read_frame
from ..formats.satellite.read import KINDS, read_scene

Model = PushbroomSensor | FrameCamera | Rpc

#: What is read: name -> words.
SENSORS = {"frame": "JSON of a frame camera (docs/rectification.md)", **KINDS}


@dataclass(frozen=True)
class LocationModel:
    """A model with direct and inverse location.

    Attributes
    ----------
    kind : of `SENSORS`
    sigmas : that the metadata state
    notes : remarks on reading
    """

    model: Model
    kind: str
    sigmas: Sigmas
    notes: list[str]


def read_location_model(path: Path, which: str | None = None, ccd: str | None = None) -> LocationModel:
    """The model of the metadata of a satellite scene or a frame image.

    Parameters
    ----------
    which : rigorous or rpc, where the metadata have both
    ccd : line of detectors, where the scene has several

    Raises
    ------
    UserError : one line about what is wrong, where, and what was wanted
    """
    if not is_frame_json(path):
        scene = read_scene(path)
        model = scene.model(which, ccd)
        return LocationModel(model, scene.kind, scene.sigmas, [*scene.notes, *scene.line_taken(model, ccd)])
    for name, given in (("ccd", ccd), ("model", which)):
        if given is not None:
            raise UserError(f"--{name} {given}: {path} is of a frame camera, which has one model and no lines")
    notes: list[str] = []
    camera, stated = read_frame(path, notes)
    return LocationModel(camera, "frame", Sigmas(stated["position_m"], stated["attitude_rad"]), notes)
