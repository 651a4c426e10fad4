"""From a recording with image lines to an orthoimage: orientation, ground, and the lines of each strip."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import LocalFrame, known_crs
from ...solver.geometry.rotation import quaternion_from_matrix
from ...solver.orthoimage.error_band import GroundErrors
from ...solver.orthoimage.ground_grid import CellWindow, GroundGrid, utm_of
from ...solver.orthoimage.heights_of_points import heights_of_points
from ...solver.orthoimage.mosaic import Mosaic
from ...solver.orthoimage.orientation import SAME_S, LineOrientation
from ...solver.orthoimage.strip import Shadows, StripRectifier, rays_of, step_over
from ...solver.orthoimage.surface import HeightField, Surface
from ...solver.simulation.flight import Flight
from .. import convert
from ..errors import UserError
from ..formats.camera_json import read_camera_instead
from ..formats.geotiff import Heights
from ..formats.line_orientation import OrientedLines
from ..formats.table import column_names_of
from ..formats.time_columns import time_columns
from ..formats.trajectory_csv import Poses, read_poses_of_strips
from ..recording.access import PoseTable, Recording
from ..recording.summary import lacking
from ..voices import VERDICT, RecordedVoices

Array = NDArray[np.floating]

#: Orientations that a recording may hold, best first, and the topic of each.
ORIENTATIONS: dict[str, str] = {
    "whole": "orientation/whole",
    "final": "orientation/final",
    "live": "orientation/live",
    "measured": "trajectory/",
    "truth": "truth/trajectory",
}
#: Those that an adjustment has refined, with the camera that it estimated.
REFINED = ("whole", "final", "live")
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


#: The poses of a topic.
_Read = Callable[[str], PoseTable]


class OfStrips:
    """Orientation of each strip of a recording: of one that is imaged beside another one by the poses of its own.

    Parameters
    ----------
    name : of `ORIENTATIONS`
    orientation, reference_ns : from `orientation_of`, for all strips that are imaged alone
    """

    def __init__(self, recording: Recording, name: str, orientation: LineOrientation, reference_ns: int):
        self._recording, self._name, self._reference_ns = recording, name, reference_ns
        self._orientation = orientation
        self._beside = strips_beside(recording)
        self._tables: dict[str, PoseTable] = {}

    def __call__(self, strip: str) -> LineOrientation:
        """Its orientation; times count from the common stamp.

        Raises
        ------
        UserError : too few of its poses are valid, or refined ones do not go with measured ones
        """
        if strip not in self._beside:
            return self._orientation
        return _orientation(self._recording, self._name, partial(self._poses, strip), self._reference_ns)[0]

    def _poses(self, strip: str, topic: str) -> PoseTable:
        """Those of a topic that are of a strip."""
        if topic not in self._tables:
            self._tables[topic] = self._recording.poses(topic)
        return _own(self._tables[topic], strip)


def strips_beside(recording: Recording) -> set[str]:
    """The strips that are imaged while another one is, as by two cameras with line rates of their own."""
    spans = []
    for id, strip in recording.last_strips().items():
        if strip.line_rate_hz > 0:
            lines = int(strip.lines) or _under_poses(recording, strip)
            first_ns = int(strip.first_line_time_ns)
            spans.append((first_ns, first_ns + max(lines - 1, 0) / strip.line_rate_hz * 1e9, id))
    found: set[str] = set()
    last_ns, last = -np.inf, ""
    for begin_ns, end_ns, id in sorted(spans):
        if begin_ns < last_ns:
            found |= {last, id}
        if end_ns > last_ns:
            last_ns, last = end_ns, id
    return found


def _own(table: PoseTable, strip: str) -> PoseTable:
    """Poses without those of other strips from the first to the last valid one of a strip; all where it has none."""
    own = np.asarray(table.strip == strip)
    times = table.time_ns[own & table.valid]
    if not len(times):
        return table
    return table.part(own | (table.time_ns < times.min()) | (table.time_ns > times.max()))


def orientation_of(recording: Recording, name: str | None) -> tuple[str, LineOrientation, int]:
    """The orientation of a recording: which it is, the orientation, and the stamp (ns) that its times count from.

    Where its poses have covariances, it has them, too. Poses that are not valid take no part: where there are no others
    lines have no orientation.

    Parameters
    ----------
    name : of `ORIENTATIONS`; None for the best there is

    Raises
    ------
    UserError : the recording does not hold it, or too few of its poses are valid
    """
    path = recording.reader.path
    topics = (*(t for t in ORIENTATIONS.values() if not t.endswith("/")), "trajectory/filtered", "trajectory/smoothed")
    reader, begin_ns = recording.reader, recording.reader.frame_begins_ns()
    held = {topic for topic in topics if (reader.index.stamp_ns[reader.select([topic])] >= begin_ns).sum() > 1}
    there = [key for key, topic in ORIENTATIONS.items() if any(h.startswith(topic) for h in held)]
    measured = any(h.startswith("trajectory/") for h in held)
    if not measured:  # refined orientation alone comes too seldom to carry the motion of the platform
        there = [key for key in there if key == "truth"]
    if name is None:
        name = next(iter(there), None)
        if name is None:
            raise lacking(reader, "no orientation in it; 'triline process' makes one from sensor data")
    if name not in there:
        has = f"it has {', '.join(there)}" if there else "it has none"
        missing = ORIENTATIONS[name].rstrip("/") if measured or name == "measured" else "trajectory"
        raise UserError(f"{path}: no {name} orientation ({missing}): {has}; 'triline process' makes it")
    return name, *_orientation(recording, name, recording.poses)


def _orientation(
    recording: Recording, name: str, read: _Read, reference_ns: int | None = None
) -> tuple[LineOrientation, int]:
    """`orientation_of` by poses that are read in a certain way; without a stamp times count from the first of them."""
    path = recording.reader.path
    stated = _poses(read, "truth/trajectory") if name == "truth" else _measured(read, name != "live")
    base = stated.part(stated.valid)
    not_valid = len(stated.time_ns) - len(base.time_ns)
    if len(base.time_ns) < 2:
        kind = "true" if name == "truth" else "measured"
        raise UserError(f"{path}: {len(base.time_ns)} valid poses of the {kind} trajectory, wanted at least 2")
    reference_ns = int(base.time_ns[0]) if reference_ns is None else reference_ns
    gap_s = max(0.3, 2.5 * float(np.median(np.diff(base.time_ns))) * 1e-9)
    orientation = LineOrientation((base.time_ns - reference_ns) * 1e-9, base.position_l, base.quaternion, gap_s)
    orientation.not_valid = not_valid
    if name in REFINED:
        # whole strips come again when the block is refined with later ones; live is the first answer
        refined = _poses(read, ORIENTATIONS[name], keep_first=name == "live")
        if name == "whole":
            refined = _with_final(read, refined)
        refined = refined.part(refined.valid)
        try:
            orientation.refine((refined.time_ns - reference_ns) * 1e-9, refined.position_l, refined.quaternion)
        except ValueError as error:
            raise UserError(f"{path}: {ORIENTATIONS[name]}: {error}") from None
        base = refined
    if name == "truth":
        orientation.state_covariance([0.0], np.zeros((1, 6, 6)))
    elif np.isfinite(base.covariance).all(axis=(1, 2)).any():
        orientation.state_covariance((base.time_ns - reference_ns) * 1e-9, base.covariance)
    return orientation, reference_ns


def _poses(read: _Read, topic: str, keep_first: bool = False) -> PoseTable:
    return read(topic).one_a_time(keep_first)


def _measured(read: _Read, smoothed: bool) -> PoseTable:
    """Filtered poses or smoothed ones, and the others before the first of them that is valid and behind the last."""
    topics = (
        ("trajectory/smoothed", "trajectory/filtered") if smoothed else ("trajectory/filtered", "trajectory/smoothed")
    )
    poses, more = (_poses(read, topic) for topic in topics)
    valid = poses.time_ns[poses.valid]
    if not len(valid):
        return more if more.valid.any() else poses
    return _joined(poses, more, (more.time_ns < valid[0]) | (more.time_ns > valid[-1]))


def _with_final(read: _Read, whole: PoseTable) -> PoseTable:
    """Poses of whole strips, and the final ones of strips that have none: of those whose backward pass is missing."""
    final = read("orientation/final")
    return _joined(whole, final, ~np.isin(final.strip, whole.strip))


def _joined(one: PoseTable, other: PoseTable, which: NDArray[np.bool_]) -> PoseTable:
    pairs = zip(vars(one).values(), vars(other).values(), strict=True)
    return PoseTable(*(np.concatenate([a, b[which]]) for a, b in pairs)).one_a_time()


def estimated_camera(recording: Recording, camera: LineCamera) -> tuple[LineCamera, int]:
    """The camera with the additional parameters of the last report, and how many there are (0: the camera itself)."""
    last = None
    for message in recording.messages("adjustment/report"):
        last = message.body if message.body.parameters else last
    return convert.estimated_camera(camera, last.parameters if last is not None else ())


def camera_of_table(table: Path) -> Path:
    """File of the calibrated camera that goes with a table of orientation alone."""
    return table.with_name(f"{table.stem}_camera.json")


def camera_beside(
    trajectory: Path, camera: LineCamera, notes: list[str] | None = None
) -> tuple[LineCamera, Path | None]:
    """The calibrated camera that stands beside a table of orientation and goes with it: that of the table, which
    `triline export` writes, or that of the folder, which `triline adjust` does.

    Parameters
    ----------
    notes : gets remarks on the file

    Returns
    -------
    camera : the one given where there is none
    path : its file; None where there is none

    Raises
    ------
    UserError : a camera that cannot be read, or with other CCD lines
    """
    for path in (camera_of_table(trajectory), trajectory.parent / "camera.json"):
        if path.exists():
            return read_camera_instead(path, camera, f"stands beside {trajectory.name} and ", notes), path
    return camera, None


def lines_of_recording(recording: Recording, name: str | None) -> tuple[str, Iterator[OrientedLines], int]:
    """Which orientation it is (of `ORIENTATIONS`), all lines of all strips with it, and how many poses are not valid.

    Raises
    ------
    UserError : the recording does not hold it, or no strip
    """
    name, orientation, reference_ns = orientation_of(recording, name)
    # nodes use no strip without a rate
    strips = {id: strip for id, strip in recording.last_strips().items() if strip.line_rate_hz > 0}
    if not strips:
        raise lacking(recording.reader, "no strip in it, so no lines (configuration/strip)")
    of_strip = OfStrips(recording, name, orientation, reference_ns)

    def parts() -> Iterator[OrientedLines]:
        for strip in strips.values():
            stamps = _line_stamps(recording, strip)
            time_s = (stamps - reference_ns) * 1e-9
            own = of_strip(strip.id)
            known = np.flatnonzero(own.covers(time_s))
            if not len(known):
                continue
            position, R = own.at(time_s[known])
            covariance = np.full((len(known), 6, 6), np.nan)
            if name != "truth" and own.has_covariance:
                covariance = own.covariance_at(time_s[known])
            yield OrientedLines(strip.id, known, stamps[known], position, R, covariance)

    return name, parts(), orientation.not_valid


def _line_stamps(recording: Recording, strip: Any) -> NDArray[np.int64]:
    """UTC of the lines of a strip, ns: of its image lines where it has some, which know them best; where the number of
    its lines is not known, as of a strip whose end was not recorded, of those under its poses."""
    blocks: list[tuple[int, NDArray[np.int64]]] = []
    for topic in sorted({c.topic for c in recording.reader.channels.values() if c.topic.startswith("sensor/lines/")}):
        own = (message.body for message in recording.messages(topic) if message.body.strip == strip.id)
        blocks += [(int(body.first_line), body.times_ns()) for body in own]
    if blocks:
        found = _regular(strip, max(first + len(times) for first, times in blocks))
        for first, times in reversed(blocks):  # those of the first CCD line count, where it has the line
            found[first : first + len(times)] = times
        return found
    return _regular(strip, int(strip.lines) or _under_poses(recording, strip))


def _under_poses(recording: Recording, strip: Any) -> int:
    """Number of lines of a strip up to the last pose that names it; 0 where none does."""
    tables = [recording.poses(ORIENTATIONS[name]) for name in REFINED]
    since_ns = np.concatenate([p.time_ns[p.strip == strip.id] for p in tables]) - int(strip.first_line_time_ns)
    return max(int(since_ns.max(initial=-1) * 1e-9 * strip.line_rate_hz + 1e-6) + 1, 0) if len(since_ns) else 0


def _regular(strip: Any, lines: int) -> NDArray[np.int64]:
    return int(strip.first_line_time_ns) + np.rint(np.arange(lines) * (1e9 / strip.line_rate_hz)).astype(np.int64)


class OfTable:
    """Orientation of strips by a table that `triline adjust` or `triline export --per-line` wrote.

    Where it says in a column ``strip`` which one its rows are of, each strip has those of its own, or those of its
    lens, where lenses were adjusted separately, or those that have the name of its recording as well, where several
    with strips of one name were; else all rows count by their times alone.

    Parameters
    ----------
    path : of the table
    wanted : strips that it must have; None for all of the recording, of which it must have one
    lens : of the lines

    Attributes
    ----------
    orientation : of all these strips together
    reference_ns : stamp that times count from
    missing : strips of the recording that are not taken, where it tells strips

    Raises
    ------
    UserError : no such table, or one of another flight
    """

    def __init__(self, recording: Recording, path: Path, wanted: list[str] | None = None, lens: str = "") -> None:
        if not time_columns(column_names_of(path)):
            raise UserError(
                f"{path}: no column of times, wanted a table of `triline adjust` or `triline export --per-line`; "
                "`triline import` takes trajectories of other programs"
            )
        poses = read_poses_of_strips(path, project_frame(recording))
        found: dict[str | None, Poses] = {}
        if not poses.rows:
            found[None] = poses.of(None)
        for strip in (wanted or list(recording.last_strips())) if poses.rows else ():
            joined = (strip, *(f"{strip}@{name}" for name in (recording.reader.path.stem, recording.reader.path)))
            name = next((n for base in joined for n in (base, f"{base}/{lens}") if n in poses.rows), None)
            if name is not None or wanted:
                found[strip] = poses.of(name or strip)
        if not found:
            strips = ", ".join(recording.last_strips())
            raise UserError(
                f"{path}: strip: {', '.join(poses.rows)}, wanted one of those of {recording.reader.path}: {strips}"
            )
        time_ns = np.concatenate([time_ns for _, _, time_ns in found.values()])
        starts = [int(strip.first_line_time_ns) for strip in recording.last_strips().values()]
        rounded_ns = round(SAME_S * convert.SECOND_NS)
        if not any(time_ns.min() - rounded_ns <= start <= time_ns.max() + rounded_ns for start in starts):
            raise UserError(
                f"{path}: its times do not reach the strips of {recording.reader.path}, wanted the same flight"
            )
        self.reference_ns = int(time_ns.min())
        self._of = {strip: self._orientation(*of) for strip, of in found.items()}
        self.missing = [] if None in found else [strip for strip in recording.last_strips() if strip not in found]
        if len(found) == 1:
            self.orientation = next(iter(self._of.values()))
        else:
            first = np.unique(time_ns, return_index=True)[1]
            position, R = (np.concatenate([of[k] for of in found.values()])[first] for k in range(2))
            self.orientation = self._orientation(position, R, time_ns[first])

    def __call__(self, strip: str) -> LineOrientation | None:
        """That of a strip, None where the table has not this strip."""
        return self._of.get(None, self._of.get(strip))

    def _orientation(self, position: Array, R: Array, time_ns: NDArray[np.int64]) -> LineOrientation:
        seconds = (time_ns - self.reference_ns) * 1e-9
        gap_s = max(0.3, 2.5 * float(np.median(np.diff(seconds))))
        return LineOrientation(seconds, position, quaternion_from_matrix(R), gap_s)


def _ground_with_height(recording: Recording) -> dict[str, Any]:
    """Ground control with a height that counts, by name: not what nodes or an operator refused in flight, nor points of
    which the adjuster left a coordinate out, nor what was stated in a local frame that was given up."""
    points: dict[str, Any] = {}
    refused: set[str] = set()
    left_out: set[tuple[str, str]] = set()
    begin_ns = recording.reader.frame_begins_ns()
    messages = recording.messages("observation/control", VERDICT, "adjustment/report")
    for message in RecordedVoices().all_used(messages):
        body = message.body
        if message.topic == "observation/control":
            if message.stamp_ns >= begin_ns:
                points[body.point] = body
        elif message.topic == "adjustment/report":
            if message.stamp_ns < begin_ns:  # of coordinates in the frame before
                continue
            left_out |= {(r.point, r.coordinate) for r in body.rejected if r.coordinate}
            left_out -= {(r.point, r.coordinate) for r in body.returned}
        elif not body.topic:
            (refused.discard if body.accepted else refused.add)(body.point)
    refused |= {point for point, _ in left_out}
    return {
        name: body for name, body in points.items() if name not in refused and convert.role_of(body) != "planimetric"
    }


def known_points(recording: Recording) -> Array:
    """(n, 3) local coordinates of object points as adjusted last, and of ground control with a height that counts."""
    points = _ground_with_height(recording)
    for message in recording.reader.in_frame(recording.messages("point/object")):
        points[message.body.point] = message.body
    xyz = np.array([(p.x, p.y, p.z) for p in points.values()]).reshape(-1, 3)
    return xyz[np.isfinite(xyz).all(axis=1)]


def ground_of_points(recording: Recording) -> HeightField:
    """The relief between the object points and the ground control of a recording.

    Raises
    ------
    UserError : too few of them
    """
    points = known_points(recording)
    try:
        return heights_of_points(points)
    except ValueError as error:
        raise UserError(f"{recording.reader.path}: no relief from object points: {error}") from None


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


def true_relief(flight: Flight, step_m: float = 10.0) -> Heights:
    """The ground of a simulated flight, as far as its cameras look, on a grid of its UTM zone."""
    low, high = flight.truth.position_l.min(axis=0), flight.truth.position_l.max(axis=0)
    above = high[2] - flight.terrain.height_m
    c = float(flight.camera.focal_length_mm.min())
    reach = 1.3 * above * max(float(np.abs(line.xy_mm).max()) for line in flight.camera.lines) / c
    utm = replace(flight.frame, crs=utm_of(flight.frame))
    corners = [(x, y, 0.0) for x in (low[0] - reach, high[0] + reach) for y in (low[1] - reach, high[1] + reach)]
    border = utm.to_crs(np.array(corners))
    (x0, y0), (x1, y1) = border[:, :2].min(axis=0), border[:, :2].max(axis=0)
    x, y = np.meshgrid(np.arange(x0, x1, step_m), np.arange(y1, y0, -step_m))
    place = np.stack([x.ravel(), y.ravel(), np.full(x.size, flight.frame.height_m + flight.terrain.height_m)], axis=1)
    for _ in range(3):  # the plumb lines of the local frame and of the map differ a little
        local = utm.from_crs(place)
        local[:, 2] = flight.terrain.height(local[:, 0], local[:, 1])
        place[:, 2] = utm.to_crs(local)[:, 2]
    return Heights(
        utm.crs, place[:, 2].reshape(x.shape), float(x[0, 0]), float(y[0, 0]), step_m, -step_m, above_ellipsoid=True
    )


def project_frame(recording: Recording) -> LocalFrame:
    """The local frame of a recording, with the CRS of its project."""
    return convert.local_frame(recording.project())
