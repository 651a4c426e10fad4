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
        height = meeting_heights(rays.position_l, here, *(np.array(part) for part in zip(*kept, strict=True)))
        height = height[np.isfinite(height)]
        if len(height) < LEAST_MEETING:
            return []
        block.ground_found(float(np.median(height)))
        return names


def meeting_heights(position_a: Array, ray_a: Array, position_b: Array, ray_b: Array) -> Array:
    """Heights (n,) half-way between rays where they come nearest to each other; NaN for rays that are nearly parallel.

    Parameters
    ----------
    position_a, position_b : (n, 3) where the rays begin
    ray_a, ray_b : (n, 3) where they go, of any length
    """
    a = ray_a / np.linalg.norm(ray_a, axis=1)[:, None]
    b = ray_b / np.linalg.norm(ray_b, axis=1)[:, None]
    base, cosine = position_b - position_a, np.einsum("ni,ni->n", a, b)
    sine2 = 1.0 - cosine**2
    along_a, along_b = np.einsum("ni,ni->n", base, a), np.einsum("ni,ni->n", base, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_a - cosine * along_b) / sine2
        t = (cosine * along_a - along_b) / sine2
    height = 0.5 * (position_a[:, 2] + s * a[:, 2] + position_b[:, 2] + t * b[:, 2])
    return np.where((sine2 > LEAST_BASE**2) & (s > 0) & (t > 0), height, np.nan)
