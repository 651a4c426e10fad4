"""What a sensor in orbit sees: image lines through its true rigorous model, of ground on the curved ellipsoid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.frames import LocalFrame
from ..location.pushbroom import PushbroomSensor
from .ground_texture import GroundTexture, ground_texture
from .imagery import FULL_SCALE, ImagingPlan
from .streams import stream

Array = NDArray[np.floating]

#: Lines rendered at once.
_LINES = 50


def texture_of(sensor: PushbroomSensor, seed: int) -> GroundTexture:
    """A ground with detail for the pixels in the middle of a sensor's image."""
    u, v = 0.5 * (sensor.lines - 1), 0.5 * (sensor.samples - 1)
    ground = sensor.ground([u, u + 1.0, u], [v, v, v + 1.0], 0.0)
    return ground_texture(stream(seed, "texture"), float(np.linalg.norm(ground[1:] - ground[0], axis=1).mean()))


def render(
    sensor: PushbroomSensor, frame: LocalFrame, texture: GroundTexture, height_m: float, rng: np.random.Generator,
    plan: ImagingPlan | None = None,
) -> NDArray[np.uint16]:  # fmt: skip
    """All lines of a scene, (lines, samples), 12 bit; ground at an ellipsoidal height, told by X and Y of the frame.

    The point spread is that of a pixel of the texture's detail, whatever the view.

    Raises
    ------
    ValueError : lines that orbit and attitude do not cover
    """
    plan = plan or ImagingPlan()
    seen = texture.seen_by(texture.detail_m)
    out = np.empty((sensor.lines, sensor.samples), dtype=np.uint16)
    sample = np.arange(float(sensor.samples))
    for first in range(0, sensor.lines, _LINES):
        line = np.arange(float(first), min(first + _LINES, sensor.lines))
        ground = sensor.ground(np.repeat(line, len(sample)), np.tile(sample, len(line)), height_m)
        x, y, _ = ((ground - frame.origin_e) @ frame.R_el).T
        signal = seen.reflectance(x, y).reshape(len(line), -1) * (plan.bright - plan.dark) + plan.dark
        noise = np.sqrt(plan.noise**2 + plan.photon_noise**2 / FULL_SCALE * np.maximum(signal, 0.0))
        out[first : first + len(line)] = np.clip(
            np.rint(signal + noise * rng.standard_normal(signal.shape)), 0, FULL_SCALE
        )
    return out
