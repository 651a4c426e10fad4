"""Which CCD line of a camera looks down most steeply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...solver.camera.line_camera import LineCamera
from ...solver.matching.round_earth import tilt
from ...solver.matching.strip_matcher import STEEPER

Array = NDArray[np.floating]


class SteepestLine:
    """Of one lens the camera says it. Several look each by itself: their poses say it, once their lines come.

    Parameters
    ----------
    camera : the camera

    Attributes
    ----------
    line : index of the CCD line, as far as is known
    """

    def __init__(self, camera: LineCamera) -> None:
        self._camera = camera
        self.line = camera.line_index[camera.nadir_line.id]
        off = np.abs(camera.ahead_mm)
        of_lens = (np.flatnonzero(camera.lens_of_line == lens) for lens in range(len(camera.lenses)))
        # the steepest of each lens, as long as its poses have not been looked at
        self._open = {int(own[np.argmin(off[own])]) for own in of_lens if len(own)} if len(camera.lenses) > 1 else set()
        self._tilt, self._strip = np.inf, ""

    def wants(self, line: int) -> bool:
        """Whether the orientation of a CCD line is still to be looked at."""
        return line in self._open

    def see(self, line: int, strip: str, position_l: Array, R_lc: Array) -> tuple[float, float] | None:
        """A CCD line that `wants` asks for was imaged with an orientation.

        If it is taken from now on: how far from the way down (rad) the one before looks (infinite where that was not
        imaged), and this one.
        """
        self._open.discard(line)
        found = self._tilt_of(line, position_l, R_lc)
        if line == self.line:
            self._tilt, self._strip = found, strip
            return None
        # lenses of one strip have its poses; that it is held askew for a moment is nothing of a lens
        before = self._tilt_of(self.line, position_l, R_lc) if strip == self._strip else self._tilt
        if found > before - STEEPER:
            return None
        self.line, self._tilt, self._strip = line, found, strip
        return before, found

    def _tilt_of(self, line: int, position_l: Array, R_lc: Array) -> float:
        middle = self._camera.lines[line].centre_mm - self._camera.principal_point_mm[line]
        return tilt(position_l, R_lc @ [*middle, -self._camera.focal_length_mm[line]])
