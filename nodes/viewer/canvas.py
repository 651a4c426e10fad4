"""What a scene is drawn on. A canvas draws; it knows nothing of flights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Color = tuple[int, int, int, int]

#: Between which sigma0 is drawn as long as it stays there.
SIGMA0_SPAN = 0.7, 1.3


@dataclass(frozen=True)
class Series:
    """How a curve of a plot looks."""

    name: str
    color: Color
    width: float = 1.5


@dataclass(frozen=True)
class ViewLayout:
    """What the views of a scene show.

    Attributes
    ----------
    title : of the 3D view; says what is exaggerated and by how much
    grid_m : spacing of the grid on the ground
    corners : (n, 3) what has to be in view, m, display coordinates
    along : (3,) direction of flight; the eye stands to its right
    ccds : ids of the CCD lines, one image-space view each, and the view's title
    image_size : width (samples) and height of an image-space view
    units : units of the parameters, one plot each
    strip_s : length of the longest strip, about
    sigma0 : between which sigma0 is drawn
    window_s : length of the adjustment's window: so far back what is not final yet is shown in plots; None: all of it
    adjusted : whether there is a camera, or anything of the adjuster; else there is nothing but a trajectory
    truth : whether errors against truth are shown
    mosaic : whether there is an orthoimage
    lines : ids of the CCD lines whose image lines come in; and width and height of a view of them
    geographic_centre : latitude and longitude for the map, deg; None without a map
    """

    title: str
    grid_m: float
    corners: Array
    along: Array
    ccds: dict[str, str]
    image_size: tuple[float, float]
    units: tuple[str, ...] = ()
    strip_s: float = 60.0
    sigma0: tuple[float, float] = SIGMA0_SPAN
    window_s: float | None = None
    adjusted: bool = True
    truth: bool = False
    mosaic: bool = False
    lines: tuple[str, ...] = ()
    lines_size: tuple[float, float] = (1.0, 1.0)
    geographic_centre: tuple[float, float] | None = None


@dataclass(frozen=True)
class FleetLayout:
    """What the views of a fleet show.

    Attributes
    ----------
    aircraft : their names, in the order of their lights
    corners : (n, 3) what has to be in view, m, display coordinates
    row : distance of two lights
    geographic_centre : latitude and longitude for the map, deg; None without a map
    """

    aircraft: tuple[str, ...]
    corners: Array
    row: float
    geographic_centre: tuple[float, float] | None = None


class Canvas(Protocol):
    """Draws in two or three dimensions, by the number of columns; an entity is replaced when drawn again.

    Radii are in screen points. Times are seconds since the start of the flight.
    """

    def at(self, time_s: float) -> None: ...

    def points(
        self, entity: str, xyz: Array, colors: Sequence[Color], radius: float, labels: Sequence[str] | None = None
    ) -> None: ...

    def lines(
        self, entity: str, strips: Sequence[Array], colors: Sequence[Color], radius: float,
        labels: Sequence[str] | None = None,
    ) -> None: ...  # fmt: skip

    def arrows(
        self, entity: str, origins: Array, vectors: Array, colors: Sequence[Color], radius: float,
        labels: Sequence[str] | None = None,
    ) -> None: ...  # fmt: skip

    def ellipsoids(self, entity: str, centres: Array, half_axes: Array, quaternions: Array, color: Color) -> None: ...

    def picture(self, entity: str, corners: Array, grey: NDArray[np.uint8]) -> None:
        """A grey image (rows, columns) between four corners (4, 3): of its first row, then back along its last."""
        ...

    def image(self, entity: str, grey: NDArray[np.uint8], place: tuple[float, float], order: float) -> None:
        """A grey image (rows, columns) in a plane view, its upper left corner at a place; higher orders lie on top."""
        ...

    def move(self, entity: str, place: tuple[float, float]) -> None:
        """Put all that is below an entity of a plane view to a place."""
        ...

    def geographic_line(self, entity: str, lat_lon: Array, color: Color) -> None: ...

    def geographic_points(self, entity: str, lat_lon: Array, colors: Sequence[Color], radius: float) -> None: ...

    def style(self, entity: str, series: Series) -> None: ...

    def curve(self, entity: str, time_s: Sequence[float], values: Sequence[float]) -> None: ...

    def event(self, entity: str, text: str, level: str) -> None: ...

    def document(self, entity: str, markdown: str) -> None: ...

    def clear(self, entity: str) -> None:
        """Take away an entity and all that is below it."""
        ...

    def layout(self, layout: ViewLayout | FleetLayout) -> None: ...

    def close(self) -> None: ...


class NullCanvas:
    """Draws nothing: what a machine without a display uses."""

    def at(self, time_s: float) -> None:
        pass

    def points(self, entity, xyz, colors, radius, labels=None) -> None:
        pass

    def lines(self, entity, strips, colors, radius, labels=None) -> None:
        pass

    def arrows(self, entity, origins, vectors, colors, radius, labels=None) -> None:
        pass

    def ellipsoids(self, entity, centres, half_axes, quaternions, color) -> None:
        pass

    def picture(self, entity, corners, grey) -> None:
        pass

    def image(self, entity, grey, place, order) -> None:
        pass

    def move(self, entity, place) -> None:
        pass

    def geographic_line(self, entity, lat_lon, color) -> None:
        pass

    def geographic_points(self, entity, lat_lon, colors, radius) -> None:
        pass

    def style(self, entity: str, series: Series) -> None:
        pass

    def curve(self, entity, time_s, values) -> None:
        pass

    def event(self, entity: str, text: str, level: str) -> None:
        pass

    def document(self, entity: str, markdown: str) -> None:
        pass

    def clear(self, entity: str) -> None:
        pass

    def layout(self, layout: ViewLayout | FleetLayout) -> None:
        pass

    def close(self) -> None:
        pass
