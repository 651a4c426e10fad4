"""Strips taken lens by lens: those of a satellite with several telescopes see the same ground minutes apart."""

from __future__ import annotations

from collections.abc import Iterable

from ...camera.line_camera import LineCamera
from .strip import WindowStrip

#: A strip waits for those of the other lenses so long, s. Derived: the nine lenses of MISR see a place within 420 s.
LONGEST_S = 600.0


def lens_of(camera: LineCamera, strip: str) -> str:
    """The lens that a strip named ``scene/lens`` was taken through, "" where its name says of none."""
    scene, _, lens = strip.rpartition("/")
    several = len(camera.lenses) > 1
    return lens if scene and several and any(lens == other.id for other in camera.lenses) else ""


def stays_to(strip: WindowStrip, strips: Iterable[WindowStrip], camera: LineCamera, now_s: float) -> float:
    """Until when, s, a strip that is over stays for those of the other lenses of its scene.

    That is the end of the last of them, `LONGEST_S` after its own end while one is missing, and its own end where it
    was not taken lens by lens.
    """
    lens = lens_of(camera, strip.id)
    if not lens:
        return strip.end_s
    scene = strip.id.removesuffix(lens)
    ends = {other.id: other.end_s if other.ended else now_s for other in strips if other.id.startswith(scene)}
    missing = any(f"{scene}{other.id}" not in ends for other in camera.lenses)
    last_s = strip.end_s + LONGEST_S if missing else max(ends.values())
    return min(last_s, strip.end_s + LONGEST_S)
