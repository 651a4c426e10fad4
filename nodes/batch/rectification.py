"""From image lines with an orientation, and the ground, to the orthoimage of each strip."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import LocalFrame, known_crs
from ...solver.orthoimage.error_band import GroundErrors
from ...solver.orthoimage.ground_grid import CellWindow, GroundGrid
from ...solver.orthoimage.mosaic import Mosaic
from ...solver.orthoimage.orientation import LineOrientation
from ...solver.orthoimage.strip import Shadows, StripRectifier, rays_of, step_over
from ...solver.orthoimage.surface import Surface
from ..errors import UserError
from ..recording.access import Recording

Array = NDArray[np.floating]

#: Each so many-th line, and of it each so many-th ray, tell whether a block of lines sees a part of the ground. It does
#: if what they see, so many cells wider and a share of its length, meets the part: relief between them bulges.
LOOK_LINES, LOOK_RAYS, ROUND_CELLS, ROUND_SHARE = 16, 4, 16.0, 0.05
#: Lines that are missing are left black, so that the others stay in their places, if there are not more than this.
LARGEST_GAP = 5000


@dataclass
class Rectified:
    """What came of it.

    Attributes
    ----------
    mosaic : the orthoimage
    strips : lines of each strip that went into it
    left_out : lines that did not, by reason
    missed_rays : rays that did not meet the ground
    hidden_cells : cells that were left out because the relief hides them, of each strip
    """

    mosaic: Mosaic
    strips: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    missed_rays: int = 0
    hidden_cells: int = 0


def pixel_on_ground(camera: LineCamera, ccd: int, above_m: float) -> float:
    """Size of a pixel in the middle of a CCD line, m."""
    line = camera.lines[ccd]
    xy = line.xy_mm - camera.principal_point_mm[ccd]
    pitch = float(np.linalg.norm(line.xy_mm[-1] - line.xy_mm[0])) / (line.pixels - 1)
    c = float(camera.focal_length_mm[ccd])
    slant = float(np.hypot(c, xy[line.pixels // 2, 0])) / c
    return above_m * pitch / c * slant


class Rectification:
    """Rectifies the lines of one CCD line, strip by strip, as they come.

    Parameters
    ----------
    camera, ccd : camera, and the index of its CCD line
    surface, grid, resampling : as in `StripRectifier`
    orientation, reference_ns : of the lines of a strip, by its name, None where it has none, and what its times count
        from
    factor : pixels that are put together to one, along and across, where cells are that much larger
    errors : besides those of the orientation; then the orthoimage has sigmas
    mosaic : makes what the cells go into, from the data type of the lines
    shadows : what the relief hides is left out; None = it shows what is seen beside it
    part : the only cells that are wanted; None for all

    Attributes
    ----------
    seen : corners (column, row) of what blocks of lines have been found to see, where a part is wanted
    """

    def __init__(
        self, camera: LineCamera, ccd: int, surface: Surface, grid: GroundGrid, resampling: str,
        orientation: Callable[[str], LineOrientation | None], reference_ns: int, factor: int = 1,
        errors: GroundErrors | None = None, mosaic: Callable[[np.dtype], Mosaic] = Mosaic,
        shadows: Shadows | None = None, part: CellWindow | None = None,
    ) -> None:  # fmt: skip
        self._mosaic, self.shadows, self.part = mosaic, shadows, part
        self.seen: tuple[Array, Array] | None = None
        line = camera.lines[ccd]
        if line.pixels // factor < 2 <= line.pixels:
            most = grid.gsd / factor * (line.pixels // 2)
            raise UserError(
                f"--gsd {grid.gsd:g}: leaves less than two cells for the {line.pixels} pixels of CCD line {line.id!r}, "
                f"wanted {most:.3g} at most"
            )
        self.rays = rays_of(camera, ccd, step_over(surface, grid), factor)
        self.surface, self.grid, self.resampling = surface, grid, resampling
        self.orientation, self.reference_ns, self.factor, self.errors = orientation, reference_ns, factor, errors
        self.result: Rectified | None = None
        self._strip = ""
        self._rectifier: StripRectifier | None = None
        self._of_strip: LineOrientation | None = None
        self._next_line = 0
        self._rest: tuple[NDArray[Any], NDArray[np.bool_], Array] | None = None

    def add(self, block: LineBlock) -> None:
        """Lines of the CCD line.

        Raises
        ------
        ValueError : lines of another length
        """
        if self.result is None:
            self.result = Rectified(self._mosaic(block.pixels.dtype))
        if block.strip != self._strip:
            self._close()
            self._strip, self._of_strip = block.strip, self.orientation(block.strip)
            self._rectifier = StripRectifier(
                self.rays, self.surface, self.grid, self.resampling, errors=self.errors, shadows=self.shadows
            )
            self._next_line = int(block.first_line)
        pixels, first = block.pixels, int(block.first_line)
        time_s = (block.times_ns() - self.reference_ns) * 1e-9
        late = min(max(self._next_line - first, 0), len(pixels))
        self._leave_out("twice or late", late)
        pixels, time_s, first = pixels[late:], time_s[late:], first + late
        if not len(pixels):
            return
        usable = np.ones(len(pixels), dtype=bool)
        gap = first - self._next_line
        if 0 < gap <= LARGEST_GAP:
            self._leave_out("missing", gap)
            step = block.line_period_ns * 1e-9 or float(time_s[-1] - time_s[0]) / max(len(time_s) - 1, 1)
            time_s = np.concatenate([time_s[0] - step * np.arange(gap, 0, -1), time_s])
            pixels = np.concatenate([np.zeros((gap, pixels.shape[1]), dtype=pixels.dtype), pixels])
            usable = np.concatenate([np.zeros(gap, dtype=bool), usable])
            first -= gap
        elif gap > 0:
            self._rest = None
        self._next_line = first + len(pixels)
        self._reduced(pixels, usable, time_s, first)

    def _reduced(self, pixels: NDArray[Any], usable: NDArray[np.bool_], time_s: Array, first: int) -> None:
        """Put pixels together; what does not fill a group of lines waits for the next block."""
        f = self.factor
        if f == 1:
            self._place(pixels, usable, time_s, first)
            return
        if self._rest is not None:
            rest, rest_usable, rest_s = self._rest
            pixels, time_s = np.concatenate([rest, pixels]), np.concatenate([rest_s, time_s])
            usable, first = np.concatenate([rest_usable, usable]), first - len(rest)
        skip = min(-first % f, len(pixels))
        pixels, usable, time_s, first = pixels[skip:], usable[skip:], time_s[skip:], first + skip
        n, width = len(pixels) // f, pixels.shape[1] // f
        used = n * f
        self._rest = pixels[used:], usable[used:], time_s[used:]
        if n:
            grey = pixels[:used, : width * f].reshape(n, f, width, f).mean(axis=(1, 3), dtype=np.float32)
            small = np.rint(grey).astype(pixels.dtype)
            together = np.logical_and.reduce(usable[:used].reshape(n, f), axis=1)
            self._place(small, together, time_s[:used].reshape(n, f).mean(axis=1), first // f)

    def _place(self, pixels: NDArray[Any], usable: NDArray[np.bool_], time_s: Array, first: int) -> None:
        assert self.result is not None and self._rectifier is not None
        if self._of_strip is None:
            self._leave_out("without orientation", self.factor * int(usable.sum()))
            return
        known = self._of_strip.covers(time_s)
        self._leave_out("without orientation", self.factor * int((usable & ~known).sum()))
        edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            position, R = self._of_strip.at(time_s[begin:end])
            lines = self.factor * int(usable[begin:end].sum())
            if self.part is not None and not self._sees(self.part, position, R):
                self._leave_out("beside the bounds", lines)
                continue
            Q = None if self.errors is None else self._of_strip.covariance_at(time_s[begin:end])
            for patch in self._rectifier.add(first + begin, pixels[begin:end], usable[begin:end], position, R, Q):
                self.result.mosaic.add(patch)
            self.result.strips[self._strip] = self.result.strips.get(self._strip, 0) + lines

    def _sees(self, part: CellWindow, position_l: Array, R_lc: Array) -> bool:
        """Whether lines see some of a part, or nearly."""
        n, k = len(position_l), len(self.rays.sample)
        lines, rays = _every(LOOK_LINES, n), _every(LOOK_RAYS, k)
        direction = self.rays.ray_c[rays] @ np.swapaxes(R_lc[lines], 1, 2)
        point, met = self.surface.meet(position_l[lines, None, :], direction)
        if not met.any():
            return False
        cells = self.grid.cells_of_many(point[met])
        low, high = cells.min(axis=0), cells.max(axis=0)
        before = self.seen or (low, high)
        self.seen = np.minimum(before[0], low), np.maximum(before[1], high)
        around = ROUND_CELLS + ROUND_SHARE * float((high - low).max())
        return part.meets(low - around, high + around)

    def _leave_out(self, reason: str, lines: int) -> None:
        assert self.result is not None
        if lines:
            self.result.left_out[reason] = self.result.left_out.get(reason, 0) + lines

    def _close(self) -> None:
        if self._rectifier is not None and self.result is not None:
            for patch in self._rectifier.finish():
                self.result.mosaic.add(patch)
            self.result.missed_rays += self._rectifier.missed
            self.result.hidden_cells += self._rectifier.hidden
        self._rectifier = self._rest = None

    def finish(self) -> Rectified | None:
        """The orthoimage; None if no lines came."""
        self._close()
        if self.result is not None and self.part is not None:
            self.result.mosaic.clip(self.part)
        return self.result


def _every(step: int, n: int) -> NDArray[np.int64]:
    """Each step-th of n, with the first and the last one."""
    return np.unique(np.append(np.arange(0, n, step), n - 1))


def line_blocks(
    recording: Recording, ccd: str, strips: list[str] | None, told: Callable[[float], None] | None = None
) -> Iterator[LineBlock]:
    """Blocks of lines of a CCD line and some strips (None: of all), in order."""
    topic = f"sensor/lines/{ccd}"
    total = max(len(recording.reader.select([topic])), 1)
    for i, message in enumerate(recording.messages(topic)):
        if told is not None and i % 20 == 0:
            told(i / total)
        block = message.body
        if strips is None or block.strip in strips:
            yield block


def frame_for(frame: LocalFrame, crs: str) -> LocalFrame:
    """The local frame with another CRS.

    Raises
    ------
    UserError : PROJ does not know the CRS, it is not projected, or the frame lies outside its area
    """
    other = LocalFrame(frame.lat_deg, frame.lon_deg, frame.height_m, crs)
    if crs == "local":
        return other
    try:
        known_crs(crs, geocentric=False)
        geographic = other.is_geographic
    except ValueError as error:
        raise UserError(f"--crs: {error}") from None
    if geographic:
        raise UserError(f"--crs {crs}: is geographic, wanted a projected CRS such as EPSG:32632")
    try:
        other.to_crs(np.zeros((1, 3)))
    except ValueError:
        raise UserError(f"--crs {crs}: the project lies outside its area") from None
    return other
