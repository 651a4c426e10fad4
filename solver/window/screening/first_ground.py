"""Where the ground is, for a camera with one view: found where looks of two strips at the same points meet.

A camera with one CCD line, or with lines side by side, places no point within a strip, and without control, or a
surface that points lie on, nobody knows how far away the ground is. Its looks are kept all the same
(`KeptPoint.unplaced`). When a later strip sees some of their points from the side, the rays of both meet about where
the ground is. It need not be known well: a look that is linearised a tenth of the flying height off ties two strips as
well as one at its place.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...arrays import Array
from ...camera.line_camera import LineCamera
from ...geometry.ray_intersection import intersect_rays
from ...geometry.rotation import matrix_from_angles
from ..block.block import Block
from ..state.lens_sets import lens_of
from ..state.maker import BatchMaker
from ..state.network import LiveNetwork

#: Views whose base over height is less place no point within a strip: those of a camera with one CCD line, or with
#: lines side by side for colours; and rays that are as nearly parallel do not say where they meet. Tuned; cameras with
#: views to several sides have ten times as much.
LEAST_BASE = 0.05
#: Pairs of rays whose median height is taken for that of the ground. Tuned: it bears three wrong ones.
LEAST_MEETING = 8


def has_one_view(camera: LineCamera, strips: Iterable[str]) -> bool:
    """Whether a camera sees the ground from one side only, so that a strip alone places no point; not one whose strips
    were taken lens by lens, each of which looks its own way."""
    if float(np.ptp(camera.ahead_mm / camera.focal_length_mm)) >= LEAST_BASE:
        return False
    return not any(lens_of(camera, strip) for strip in strips)


class FirstGround:
    """Tells the block how high the ground is; see the module."""

    def __init__(self, network: LiveNetwork, block: Block, maker: BatchMaker) -> None:
        self._network, self._block, self._maker = network, block, maker

    def look(self) -> list[str]:
        """Names of the points that wait in the window and tie strips from now on; none before the ground is found."""
        network, block = self._network, self._block
        names, kept = [], []
        for name, point in network.intake.points.items():
            if point.batch is None and len(point.looks) == 1 and not point.alone:
                ray = block.unplaced_ray(name, point.looks[0].strip)
                if ray is not None and network.trajectory.covers(np.array(point.time_s))[0]:
                    names.append(name)
                    kept.append(ray)
        if len(names) < LEAST_MEETING:
            return []
        rays, *_ = self._maker.rays([network.intake.points[name] for name in names])
        image = np.column_stack([rays.xy_mm, -rays.focal_length_mm])
        here = np.einsum("nij,nj->ni", matrix_from_angles(*rays.angles.T), image)
        position, ray = (np.array(part) for part in zip(*kept, strict=True))
        height = meeting_heights(np.stack([rays.position_l, position]), np.stack([here, ray]))
        height = height[np.isfinite(height)]
        if len(height) < LEAST_MEETING:
            return []
        block.ground_found(float(np.median(height)))
        return names


def meeting_heights(position_l: Array, ray_l: Array) -> Array:
    """Heights (n,) where pairs of rays meet; NaN for those that are nearly parallel, or meet behind a camera.

    Parameters
    ----------
    position_l, ray_l : (2, n, 3) where the rays begin, and where they go, of any length
    """
    n = position_l.shape[1]
    place_l, known = intersect_rays(position_l.reshape(-1, 3), ray_l.reshape(-1, 3), np.tile(np.arange(n), 2), n)
    a, b = ray_l / np.linalg.norm(ray_l, axis=2)[:, :, None]
    known &= np.linalg.norm(np.cross(a, b), axis=1) > LEAST_BASE
    known &= (np.einsum("kni,kni->kn", place_l - position_l, ray_l) > 0.0).all(axis=0)
    return np.where(known, place_l[:, 2], np.nan)
