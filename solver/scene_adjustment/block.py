"""A block of satellite scenes: images, image points, known ground points; the layout of its unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipsoid import WGS84, Ellipsoid
from .images import ImageModel, UnknownGroup

Array = NDArray[np.floating]
Indices = NDArray[np.int64]

#: Which coordinates (east, north, up) a known point gives, by its role.
GIVEN = {
    "control": (True, True, True),
    "planimetric": (True, True, False),
    "height": (False, False, True),
    "check": (False, False, False),
}


@dataclass(frozen=True)
class KnownGround:
    """Ground points with given coordinates.

    Attributes
    ----------
    point : (k,) index of the object point
    position_e : (k, 3) metres
    covariance_enu : (k, 3, 3) m2 of the given coordinates, east, north, up
    role : (k,) words of `GIVEN`
    """

    point: Indices
    position_e: Array
    covariance_enu: Array
    role: tuple[str, ...]

    @cached_property
    def given(self) -> NDArray[np.bool_]:
        """(k, 3) which coordinates are observations."""
        return np.array([GIVEN[role] for role in self.role], dtype=bool).reshape(-1, 3)

    @classmethod
    def none(cls) -> KnownGround:
        """No known points."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), ())


@dataclass(frozen=True)
class ImagePoints:
    """Measured pixels.

    Attributes
    ----------
    image, point : (n,) indices
    line, sample : (n,)
    sigma_px : (n,) of both
    """

    image: Indices
    point: Indices
    line: Array
    sample: Array
    sigma_px: Array

    def __len__(self) -> int:
        return len(self.image)


@dataclass(frozen=True)
class SceneBlock:
    """All of a block.

    Raises
    ------
    ValueError : no images, two images of the same name, groups of unknowns of the same key that differ, indices out of
        range, a sigma that is not positive
    """

    images: tuple[ImageModel, ...]
    point_ids: tuple[str, ...]
    rays: ImagePoints
    known: KnownGround
    ellipsoid: Ellipsoid = WGS84
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        names = [image.name for image in self.images]
        if not names:
            raise ValueError("a block without images")
        if len(set(names)) != len(names):
            raise ValueError("two images of a block have the same name")
        for values, most, what in (
            (self.rays.image, len(names), "images"),
            (self.rays.point, len(self.point_ids), "points"),
            (self.known.point, len(self.point_ids), "points"),
        ):
            if len(values) and (int(values.min()) < 0 or int(values.max()) >= most):
                raise ValueError(f"index out of range: there are {most} {what}")
        if not (self.rays.sigma_px > 0).all():
            raise ValueError("sigma of an image point that is not positive")

    @cached_property
    def layout(self) -> Layout:
        return Layout.of(self.images)

    @cached_property
    def rays_of(self) -> tuple[Indices, ...]:
        """For each image its rays."""
        return tuple(np.flatnonzero(self.rays.image == i) for i in range(len(self.images)))


@dataclass(frozen=True)
class Layout:
    """Where the unknowns of images stand in the vector of all.

    Attributes
    ----------
    groups : in order, each once
    first : (groups + 1,) first column of each
    columns : for each image, its columns in the order of its equations
    """

    groups: tuple[UnknownGroup, ...]
    first: Indices
    columns: tuple[Indices, ...]

    @classmethod
    def of(cls, images: Sequence[ImageModel]) -> Layout:
        groups: dict[tuple[str, str], UnknownGroup] = {}
        for image in images:
            for group in image.groups:
                same = groups.setdefault((group.kind, group.key), group)
                if len(same) != len(group):
                    raise ValueError(
                        f"{group.kind} {group.key}: {len(group)} unknowns in {image.name}, {len(same)} in another image"
                    )
        first = np.cumsum([0, *map(len, groups.values())])
        start = dict(zip(groups, first[:-1], strict=True))
        columns = tuple(
            np.concatenate([start[g.kind, g.key] + np.arange(len(g)) for g in image.groups]).astype(np.int64)
            for image in images
        )
        return cls(tuple(groups.values()), first, columns)

    @property
    def n_unknowns(self) -> int:
        return int(self.first[-1])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for group in self.groups for name in group.names)

    def place(self, kind: str, key: str) -> slice:
        """Columns of a group.

        Raises
        ------
        KeyError : no such group
        """
        for k, group in enumerate(self.groups):
            if (group.kind, group.key) == (kind, key):
                return slice(int(self.first[k]), int(self.first[k + 1]))
        raise KeyError(f"no unknowns {kind} {key}")

    def prior(self) -> tuple[Array, Array]:
        """A-priori equations of all unknowns, whitened: coefficients (m, n_unknowns) and values (m,)."""
        rows, values = [], []
        for k, group in enumerate(self.groups):
            if group.prior is None:
                continue
            weighs = np.flatnonzero(np.isfinite(group.prior.sigma))
            A = np.zeros((len(weighs), self.n_unknowns + 1))
            columns = group.prior.columns[weighs]
            columns = np.where(columns >= 0, columns + self.first[k], self.n_unknowns)
            np.add.at(A, (np.arange(len(weighs))[:, None], columns), group.prior.coefficients[weighs])
            rows.append(A[:, :-1] / group.prior.sigma[weighs, None])
            values.append(group.prior.value[weighs] / group.prior.sigma[weighs])
        if not rows:
            return np.empty((0, self.n_unknowns)), np.empty(0)
        return np.concatenate(rows), np.concatenate(values)

    def assumed(self) -> NDArray[np.bool_]:
        """(m,) of the equations of `prior`, which nobody stated, see `UnknownGroup`."""
        rows = [np.zeros(0, dtype=bool)]
        for group in self.groups:
            if group.prior is not None:
                of_group = np.array(group.assumed or (False,) * len(group.prior), dtype=bool)
                rows.append(of_group[np.isfinite(group.prior.sigma)])
        return np.concatenate(rows)
