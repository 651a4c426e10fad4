"""The growing orthoimages: tiles laid on the ground, live, and final on top of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..node import Message
from .canvas import Canvas
from .scene_part import Part
from .scene_state import SceneState

Array = NDArray[np.floating]

#: The tiles lie so far below the ground, shares of the flying height, that points and residuals stand above them.
BELOW = {"live": 0.062, "final": 0.060}
LARGEST_TILE = 4096
_WHITE, _HEADROOM, _GAMMA = 99.5, 1.2, 0.8  # percentile of a tile, and how much brighter is shown as white


class MosaicPart(Part):
    """Tiles of both orthoimages; drawn again when they have changed."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._forget()

    def _forget(self) -> None:
        self._changed: dict[tuple[str, int, int], Any] = {}
        self._ccd: dict[str, str] = {}  # CCD line of each orthoimage
        self._gone: set[str] = set()  # those whose tiles so far were of another one
        self._white = 0.0

    def take(self, message: Message) -> None:
        """Take a tile.

        Raises
        ------
        ValueError : a tile whose pixels are not what it says
        """
        version = message.topic.removeprefix("orthoimage/")
        if version not in BELOW:
            return
        tile = message.body
        if tile.encoding != "mono8" or not 0 < tile.size <= LARGEST_TILE or len(tile.data) != tile.size**2:
            raise ValueError(f"{len(tile.data)} bytes of {tile.encoding!r} in a tile of {tile.size} cells a side")
        if not tile.gsd_m > 0:
            raise ValueError(f"cells of {tile.gsd_m} m")
        self.state.has_mosaic = True
        if self._ccd.setdefault(version, tile.ccd) != tile.ccd:
            self._ccd[version] = tile.ccd
            self._gone.add(version)
            self._changed = {key: old for key, old in self._changed.items() if key[0] != version}
        self._changed[version, tile.row, tile.column] = tile

    def _shown(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Brighter: ground is dark to a sensor that clouds must not blind. Tiles share one scale: none stands out.

        It is decided by the first tile, and again where a tile is brighter than that.
        """
        bright = float(np.percentile(grey[grey > 0], _WHITE))
        if bright > self._white:
            self._white = _HEADROOM * bright
        table = np.rint(255.0 * np.clip(np.arange(256) / self._white, 0.0, 1.0) ** _GAMMA).astype(np.uint8)
        return table[grey]

    def begin_again(self, canvas: Canvas) -> None:
        canvas.clear("mosaic")
        self._forget()

    def draw(self, canvas: Canvas) -> None:
        if self.state.newest is None:  # the display frame is not known yet
            return
        for version in self._gone:
            canvas.clear(f"mosaic/{version}")
        self._gone.clear()
        for (version, row, column), tile in self._changed.items():
            grey = np.frombuffer(tile.data, dtype=np.uint8).reshape(tile.size, tile.size)
            rows, columns = np.flatnonzero(grey.any(axis=1)), np.flatnonzero(grey.any(axis=0))
            if not len(rows):
                continue
            r0, r1, c0, c1 = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
            z = self.state.ground_m - BELOW[version] * self.state.height_m
            x0, x1 = tile.x + c0 * tile.gsd_m, tile.x + c1 * tile.gsd_m
            y0, y1 = tile.y - r0 * tile.gsd_m, tile.y - r1 * tile.gsd_m
            corners = np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
            canvas.picture(
                f"mosaic/{version}/{row}_{column}", self.state.display(corners), self._shown(grey[r0:r1, c0:c1])
            )
        self._changed.clear()
