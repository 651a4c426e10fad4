"""What an image is to an adjustment: equations of its rays, linear in its unknowns and in the object points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.base import PseudoObservations

Array = NDArray[np.floating]

#: What a group of unknowns does.
ORIENTATION, CAMERA, IMAGE = "orientation", "camera", "image"


@dataclass(frozen=True)
class UnknownGroup:
    """Unknowns that belong together; images that name the same key share them.

    Attributes
    ----------
    key : of the correction set, lens or image
    kind : ORIENTATION (correction functions), CAMERA (additional parameters), IMAGE (coefficients of an image)
    names : (k,) in words
    prior : what is known beforehand of them; None where nothing is
    assumed : of each equation of these, whether nobody stated its sigma, and it is wide so that the data decide; such a
        value holds what nothing else determines, and is no observation that sigma0 could be judged by
    """

    key: str
    kind: str
    names: tuple[str, ...]
    prior: PseudoObservations | None
    assumed: tuple[bool, ...] = ()

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Equations:
    """Linearised equations of n rays.

    Attributes
    ----------
    misclosure_px : (n, 2) measured minus computed line and sample; NaN where the model does not see the point
    by_point : (n, 2, 3) derivative of the computed ones by the point, Earth-fixed, pixels per metre
    by_unknown : (n, 2, k) derivative by the unknowns of the image, group after group
    """

    misclosure_px: Array
    by_point: Array
    by_unknown: Array


class Located(Protocol):
    """Direct and inverse location of an image."""

    def direct(self, line: ArrayLike, sample: ArrayLike, height_m: ArrayLike) -> Array:
        """Latitude, longitude (radians) and height, (n, 3)."""
        ...

    def inverse(self, lat: ArrayLike, lon: ArrayLike, height_m: ArrayLike) -> Array:
        """Line and sample, (n, 2)."""
        ...


class MeasuredRays(Protocol):
    """The measured pixels of one image."""

    def equations(self, position_e: Array, values: Array) -> Equations:
        """Equations of the n rays to points (n, 3), Earth-fixed, for values (k,) of the image's unknowns."""
        ...


class ImageModel(Protocol):
    """An image with its unknowns."""

    @property
    def name(self) -> str:
        """Of the image; no two of a block have the same."""
        ...

    @property
    def kind(self) -> str:
        """Of the model: rigorous, rpc, affine, dlt."""
        ...

    @property
    def groups(self) -> tuple[UnknownGroup, ...]:
        """The unknowns, in the order of the columns of its equations."""
        ...

    @property
    def locates(self) -> bool:
        """Whether it can locate without known points."""
        ...

    def measured(self, line: Array, sample: Array) -> MeasuredRays:
        """What is measured at lines and samples (n,)."""
        ...

    def start(self, line: Array, sample: Array, position_e: Array) -> Array:
        """Values (k,) to start with, from points (n, 3) at lines and samples (n,) if the model needs them.

        Raises
        ------
        ValueError : too few points, or points that do not determine the model
        """
        ...

    def located(self, values: Array) -> Located:
        """Direct and inverse location with values (k,) of the unknowns."""
        ...
