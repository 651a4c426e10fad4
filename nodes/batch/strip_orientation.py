"""Which orientation the lines of each strip have, of a recording or of a table, and the camera that goes with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.rotation import quaternion_from_matrix
from ...solver.orthoimage.orientation import SAME_S, LineOrientation
from .. import convert
from ..errors import UserError
from ..formats.camera_json import read_camera_instead
from ..formats.line_orientation import OrientedLines
from ..formats.table import column_names_of
from ..formats.time_columns import time_columns
from ..formats.trajectory_csv import Poses, read_poses_of_strips
from ..recording.access import PoseTable, Recording
from ..recording.summary import lacking

Array = NDArray[np.floating]
#: The poses of a topic.
_Read = Callable[[str], PoseTable]

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
        poses = read_poses_of_strips(path, recording.frame())
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
