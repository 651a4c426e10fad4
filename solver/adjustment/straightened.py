"""Rays that the air bends, as straight ones: their image coordinates are corrected before the adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..camera.collinearity import project
from ..geometry.frames import BodyFrame, LocalFrame
from ..location.refraction import Refraction
from .network import Network


def straightened(network: Network, frame: LocalFrame | BodyFrame, refraction: Refraction) -> Network:
    """The network with image coordinates as they were without air.

    A bent ray looks at a place beyond the point that it comes from. What the two are apart in the image, from the
    measured orientation and the approximate point, is taken off the measurement; both need to be right to some metres.

    Parameters
    ----------
    network : as measured
    frame : of its coordinates
    refraction : what the air does; heights are above its ellipsoid
    """
    rays = network.rays
    point = network.approximate_l[rays.point]
    true_e, centre_e = (frame.origin_e + a @ frame.R_el.T for a in (point, rays.position_l))
    with np.errstate(invalid="ignore"):  # points without an approximate place
        seen = (refraction.straight_ground(true_e, centre_e) - frame.origin_e) @ frame.R_el
        xy = [project(rays.position_l, rays.angles, at, rays.focal_length_mm).xy_mm for at in (point, seen)]
    off = np.where(np.isfinite(xy[1] - xy[0]), xy[1] - xy[0], 0.0)
    return replace(network, rays=replace(rays, xy_mm=rays.xy_mm - off))
