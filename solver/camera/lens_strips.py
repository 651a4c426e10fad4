"""Strips taken lens by lens: a platform with several telescopes gives each its own, named ``scene/lens``."""

from __future__ import annotations

from .line_camera import LineCamera


def lens_of(camera: LineCamera, strip: str) -> str:
    """The lens that a strip named ``scene/lens`` was taken through, "" where its name says of none."""
    scene, _, lens = strip.rpartition("/")
    several = len(camera.lenses) > 1
    return lens if scene and several and any(lens == other.id for other in camera.lenses) else ""
