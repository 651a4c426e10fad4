"""The poses of a real motion: any trajectory that `triline import` reads, or a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...solver.geometry.frames import navigation_from_R_lc
from ...solver.geometry.rotation import matrix_from_quaternion
from ...solver.simulation.real_motion import RealMotion, real_motion
from .. import convert
from ..errors import UserError
from ..formats.detect import KINDS, Options, kind_of_path, read_track
from ..formats.track import NavigationTrack
from ..recording.access import Recording

#: Topics of a recording that have poses, the best ones first.
POSE_TOPICS = (
    *("truth/trajectory", "orientation/whole", "orientation/final"),
    *("trajectory/smoothed", "trajectory/filtered"),
)
#: Kinds of files with poses.
TRACKS = ("avirisng", "avirisc", "pos", "waypoint", "sbet", "csv", "headwall", "resonon", "gpx")


def motion_of(
    path: Path, ground_m: float, from_s: float = 0.0, duration_s: float | None = None
) -> tuple[RealMotion, int]:
    """The motion in a file, see `real_motion`, and when it begins, ns.

    Raises
    ------
    UserError : as of `motion_track`
    ValueError : as of `real_motion`
    """
    track = motion_track(path)
    seconds = (track.time_ns - track.time_ns[0]) * 1e-9
    lat, lon, height = track.geodetic.T
    motion = real_motion(seconds, lat, lon, height, track.rpy, ground_m, from_s, duration_s)
    return motion, int(track.time_ns[0]) + round(motion.first_time_s * 1e9)


def motion_track(path: Path) -> NavigationTrack:
    """The poses in a file; of a recording those of the best topic that it has.

    Raises
    ------
    UserError : a file without poses, or from its reader
    """
    kind = kind_of_path(path)
    if kind in TRACKS:
        return read_track(path, kind, Options())
    if kind == "ros2" and path.suffix == ".mcap":
        recording = Recording(path)
        held = set(recording.topics().index)
        if "configuration/project" in held:
            return _of_recording(recording, held)
    hint = "; `triline navigate` makes trajectory.csv of sensors" if kind in ("sensors", "ros2") else ""
    raise UserError(f"{path}: is a {KINDS[kind]}, wanted a trajectory or a recording with one{hint}")


def _of_recording(recording: Recording, held: set[str]) -> NavigationTrack:
    path = Path(recording.reader.path)
    topic = next((topic for topic in POSE_TOPICS if topic in held), None)
    if topic is None:
        raise UserError(f"{path}: no poses in this recording, wanted one of {', '.join(POSE_TOPICS)}")
    project = recording.reader.last("configuration/project")
    assert project is not None
    frame = convert.local_frame(project)
    poses = recording.poses(topic).one_a_time()
    rows = np.flatnonzero(poses.valid)
    if len(rows) < 2:
        raise UserError(f"{path}: {len(rows)} valid poses on {topic}, wanted at least 2")
    position = poses.position_l[rows]
    # of the image frame as a body that looks down: the camera sits on it without boresight
    rpy = navigation_from_R_lc(frame, position, matrix_from_quaternion(poses.quaternion[rows]))
    return NavigationTrack(
        path.stem, poses.time_ns[rows], frame.to_geodetic(position), rpy, notes=(f"{path.name}: poses of {topic}",)
    )
