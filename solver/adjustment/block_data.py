"""A block as it was handed over: camera, strips with measured trajectories, points, a-priori values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..camera.line_camera import LineCamera
from ..geometry.frames import LocalFrame
from .network import Control, Measurements, Network, Strip, build_network

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class KnownPoints:
    """Points with known coordinates; m of them.

    Attributes
    ----------
    id : (m,) names
    xyz_l : (m, 3) metres, local frame
    covariance : (m, 3, 3) m^2, local frame
    role : (m,) control, planimetric, height or check
    target_radius_m : (m,) of the white disc that signalises a point, 0 for none; () for none at all
    """

    id: tuple[str, ...]
    xyz_l: Array
    covariance: Array = field(repr=False)
    role: tuple[str, ...]
    target_radius_m: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.id)

    @property
    def sigma_m(self) -> Array:
        """(m, 3) metres, local axes; infinite where the role says that a coordinate is not given."""
        sigma = np.sqrt(np.einsum("nii->ni", self.covariance))
        role = np.array(self.role, dtype=object)
        sigma[role == "planimetric", 2] = np.inf
        sigma[role == "height", :2] = np.inf
        return sigma


@dataclass(frozen=True)
class ImagePoints:
    """Image measurements; n of them, in the order of the file.

    Attributes
    ----------
    point : (n,) index into the block's ``point_ids``
    strip : (n,) index into the block's strips, -1 for one that does not exist
    ccd : (n,) index into the camera's CCD lines, -1 for one that does not exist
    line, sample : (n,) pixels, 0-based, integer at pixel and line centre
    sigma_px : (n,) of a line, and of a sample where it has no own
    time_s : (n,) time of the line; NaN where the strip does not exist
    unknown : names (strip, ccd) as written, of the rows where one of the two does not exist
    sigma_sample_px : (n,) of a sample; None where it is that of a line
    """

    point: IntArray
    strip: IntArray
    ccd: IntArray
    line: Array
    sample: Array
    sigma_px: Array
    time_s: Array
    unknown: Mapping[int, tuple[str, str]] = field(default_factory=dict)
    sigma_sample_px: Array | None = None

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True)
class Apriori:
    """A-priori values of a project.

    Attributes
    ----------
    image_sigma_px : of a line or a sample where the measurement gives none
    trajectory : the ``[trajectory]`` table as written (sigmas of the corrections), what a trajectory model's
        ``from_settings`` takes; a key that is absent gets the model's default
    then : the ``[trajectory.then]`` table: what the second of two models has of its own
    of_strip : by the name of a strip, what differs there from ``trajectory``
    wide : sigmas of the trajectory are in some strips those of its filter, far larger than what the corrections find
    """

    image_sigma_px: float = 0.3
    trajectory: Mapping[str, object] = field(default_factory=dict)
    then: Mapping[str, object] = field(default_factory=dict)
    of_strip: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    wide: bool = False


@dataclass(frozen=True)
class BlockData:
    """A block folder as arrays, everything in the local frame.

    Attributes
    ----------
    name : of the project
    frame : local frame, and the CRS that the files are written in
    camera : look-up tables
    strips : with trajectories; where strips are given lens by lens, one entry a lens, with id ``strip/lens``
    point_ids : names of all ground and image points
    ground, image : see there
    apriori : see there
    notes : what the reader wants said (ignored columns, rows that cannot be used, assumptions)
    time_reference_ns : times count from here (ns since the Unix epoch)
    heading : the attitude is that of an inertial system, whose error of kappa is one of heading (`Layout.heading`)
    refused : names of ground points whose coordinates do not count, as an operator said in flight
    """

    name: str
    frame: LocalFrame
    camera: LineCamera
    strips: tuple[Strip, ...]
    point_ids: tuple[str, ...] = field(repr=False)
    ground: KnownPoints
    image: ImagePoints
    apriori: Apriori = Apriori()
    notes: tuple[str, ...] = ()
    time_reference_ns: int = 0
    heading: bool = False
    refused: frozenset[str] = frozenset()

    def image_name(self, row: int) -> tuple[str, str, str]:
        """Point, strip and CCD of an image point, as written."""
        point = self.point_ids[self.image.point[row]]
        if row in self.image.unknown:
            return (point, *self.image.unknown[row])
        strip = self.strips[self.image.strip[row]]
        name = strip.id if strip.lens is None else strip.id.removesuffix(f"/{strip.lens}")
        return point, name, self.camera.lines[self.image.ccd[row]].id


def network_from_block(block: BlockData) -> Network:
    """The network an adjustment works on. Its ``refused`` rows count as `ImagePoints` does: name them by `image_name`.

    Raises
    ------
    ValueError : no usable ray at all
    """
    place = {id: i for i, id in enumerate(block.point_ids)}
    index = np.array([place[id] for id in block.ground.id], dtype=np.int64)
    check = np.array([role == "check" for role in block.ground.role], dtype=bool)
    sigma = block.ground.sigma_m
    image = block.image
    of_sample = image.sigma_px if image.sigma_sample_px is None else image.sigma_sample_px
    network = build_network(
        block.camera,
        block.strips,
        block.point_ids,
        Measurements(
            image.point, image.strip, image.ccd, image.line, image.sample, image.sigma_px, of_sample, image.time_s
        ),
        Control(index[~check], block.ground.xyz_l[~check], sigma[~check]),
        Control(index[check], block.ground.xyz_l[check], sigma[check]),
    )
    return replace(network, heading=block.heading, control=_where_it_lies(network, block.frame))


def _where_it_lies(network: Network, frame: LocalFrame) -> Control:
    """The control, with what is not given of a point as its rays have it.

    The vertical leans away from that of the local frame by the distance from its origin: 10 km away X of a planimetric
    point is 0.8 m off if its height is 500 m off, and so is a height by its X and Y.
    """
    control = network.control
    given = np.isfinite(control.sigma_m)
    some = np.flatnonzero(~given.all(axis=1) & given.any(axis=1) & (network.rays_per_point[control.point] >= 2))
    if not len(some) or frame.crs == "local":
        return control
    stated, met = (
        frame.to_crs(xyz_l, may_lie_outside=True)
        for xyz_l in (control.xyz_l[some], network.where_rays_meet(control.point[some]))
    )
    known = np.isfinite(stated).all(axis=1) & np.isfinite(met).all(axis=1)
    xyz_l = control.xyz_l.copy()
    xyz_l[some[known]] = frame.from_crs(np.where(given[some], stated, met)[known])
    return replace(control, xyz_l=xyz_l)
