"""DIMAP 1: scenes of SPOT-1 to SPOT-5 (HRV, HRVIR, HRG, HRS) of level 1A.

Conventions (SPOT Satellite Geometry Handbook). Rows and columns count from 1 at the centre of the first pixel; a
row is taken at the time of the centre of the scene plus its distance in line periods. Positions and velocities are
Earth-fixed, interpolated by Lagrange's formula through eight nodes. The orbital frame has Z away from the Earth's
centre, X along ``v x Z``, Y = Z x X. The velocity is that over the rotating Earth for SPOT-5, which is steered in
yaw, and that against the stars for SPOT-1 to 4, which are not (the corners in their files, which leave the
attitudes out, are met to 4 m; by the other velocity they are missed by 1 to 24 km). Roll turns about Y, pitch
about X, yaw about Z; roll and pitch count negative; pitch is applied last. Angles are linear between their nodes.
SPOT-1 to 4 have angles at both ends, and angular speeds between, which are summed up to nodes. A detector looks
along ``(-tan psi_y, tan psi_x, -1)``. Light time and aberration are not applied.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....solver.location.look_directions import TableLook
from ....solver.location.pushbroom import PushbroomSensor
from ....solver.orbit.attitude import AnglesAttitude
from ....solver.orbit.line_times import UniformLineTimes
from ....solver.orbit.motion import Motion
from ...errors import UserError
from .scene import SatelliteScene, corner_notes, orbit_of, refuse_gap
from .xml_file import Element, times_of

Array = NDArray[np.floating]

#: From the handbook's orbital frame (X2, Y2, Z2) to the solver's: X2 = y, Y2 = x, Z2 = -z.
_ORBITAL_FROM_SPOT = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: Orbital frame of the attitudes, by `MISSION_INDEX` of SPOT.
_FRAMES = {1: "o", 2: "o", 3: "o", 4: "o", 5: "orbital-e"}
#: Level of images whose columns are those of the detectors and whose rows are those of the line times.
_RAW_LEVEL = "1A"
#: The attitudes of a scene may begin and end this many of their steps inside it; tuned: real scenes lack one or two.
_STEPS_BEYOND = 4.0


def read_dimap1(root: Element) -> SatelliteScene:
    """The scene of a DIMAP 1 document.

    Raises
    ------
    UserError : an element that is missing or has no sense, by its place in the document
    """
    notes: list[str] = []
    mission = _mission(root)
    level = root.find("Data_Processing/PROCESSING_LEVEL")
    if level is not None and level.text().upper() != _RAW_LEVEL:
        raise level.refuse("", f"{_RAW_LEVEL}: images of other levels are resampled", level.text())
    size = root.need("Raster_Dimensions", "the size of the image")
    lines, samples = size.integer("NROWS", low=1), size.integer("NCOLS", low=2)
    strip = root.need("Data_Strip", "orbit, attitude and look angles of a scene of level 1A")
    stamp = strip.need("Sensor_Configuration/Time_Stamp", "times of the lines")
    period_s = stamp.number("LINE_PERIOD")
    if not period_s > 0:
        raise stamp.refuse("LINE_PERIOD", "a number above 0", f"{period_s:g}")
    centre, centre_line = stamp.time("SCENE_CENTER_TIME"), stamp.number("SCENE_CENTER_LINE")
    first_s = (1.0 - centre_line) * period_s
    first_ns = centre + round(first_s * 1e9)
    last_ns = first_ns + round((lines - 1) * period_s * 1e9)
    try:
        sensor = PushbroomSensor(
            Motion(
                _orbit(strip, centre, first_ns, last_ns, notes),
                _attitude(strip, centre, first_ns, last_ns, notes),
                attitude_frame=_FRAMES[mission],
            ),
            UniformLineTimes(first_s, period_s, lines),
            _look(strip, samples, notes),
            reference_ns=centre,
            name=root.path.stem,
        )
    except ValueError as error:
        raise UserError(f"{root.path}: {strip.where}: {error}") from None
    notes += corner_notes(sensor, root.find("Dataset_Frame"), "FRAME_")
    return SatelliteScene("dimap1", sensor, None, notes)


def _mission(root: Element) -> int:
    """Number of the satellite among those of SPOT; 5 where the file does not tell."""
    source = root.find("Dataset_Sources/Source_Information/Scene_Source")
    if source is None or source.find("MISSION") is None:
        return 5
    if source.text("MISSION").upper() != "SPOT":
        raise source.refuse("MISSION", "SPOT", source.text("MISSION"))
    index = source.integer("MISSION_INDEX", low=1)
    if index not in _FRAMES:
        raise source.refuse("MISSION_INDEX", "1 to 5", str(index))
    return index


def _orbit(strip: Element, reference: int, first_ns: int, last_ns: int, notes: list[str]):
    place = strip.need("Ephemeris/Points", "positions of the satellite")
    points = place.all("Point", "at least 2 positions of the satellite", least=2)
    times = times_of(points, "TIME")
    refuse_gap(place.path, place.where, times, first_ns, last_ns)
    position = _vectors(points, "Location")
    velocity = _vectors(points, "Velocity") if all(p.find("Velocity") is not None for p in points) else None
    return orbit_of(place.path, place.where, times, position, velocity, reference, notes)


def _vectors(points: list[Element], name: str) -> Array:
    return np.array([[p.number(f"{name}/{axis}") for axis in "XYZ"] for p in points])


def _attitude(strip: Element, reference: int, first_ns: int, last_ns: int, notes: list[str]) -> AnglesAttitude:
    place = strip.need("Satellite_Attitudes", "attitudes of the satellite")
    corrected = place.find("Corrected_Attitudes/Corrected_Attitude")
    raw = corrected is None
    if corrected is None:
        corrected = place.need("Raw_Attitudes/Aocs_Attitude/Angles_List", "corrected or raw attitudes")
        notes.append(f"{place.path.name}: no corrected attitudes, the raw ones of the attitude control are used")
    good = _in_range(corrected, "Angles", "attitudes", notes)
    times = times_of(good, "TIME")
    refuse_gap(place.path, corrected.where, times, first_ns, last_ns)
    t, angles = _in_order(good, times, reference)
    speeds = place.find("Raw_Attitudes/Aocs_Attitude/Angular_Speeds_List") if raw and len(good) == 2 else None
    if speeds is not None:
        t, angles = _summed(speeds, t, angles, reference, first_ns, last_ns, notes)
    margin_s = _STEPS_BEYOND * float(np.median(np.diff(t)))
    return AnglesAttitude(t, angles * [-1.0, -1.0, 1.0], "XYZ", fixed=_ORBITAL_FROM_SPOT, margin_s=margin_s)


def _in_range(place: Element, name: str, what: str, notes: list[str]) -> list[Element]:
    every = place.all(name, f"at least 2 {what}", least=2)
    good = [a for a in every if a.find("OUT_OF_RANGE") is None or a.text("OUT_OF_RANGE").upper() != "Y"]
    if len(good) < len(every):
        notes.append(f"{place.path.name}: {len(every) - len(good)} {what} that are out of range were left out")
    if len(good) < 2:
        raise place.refuse(name, f"at least 2 {what} that are in range", f"{len(good)} of them")
    return good


def _in_order(elements: list[Element], times: list[int], reference: int) -> tuple[Array, Array]:
    """Times in seconds, and pitch, roll, yaw (n, 3), or their speeds."""
    order = np.argsort(times, kind="stable")
    t = (np.array(times, dtype=np.int64)[order] - reference) * 1e-9
    return t, np.array([[a.number(name) for name in ("PITCH", "ROLL", "YAW")] for a in elements])[order]


def _summed(
    place: Element, ends_s: Array, angles: Array, reference: int, first_ns: int, last_ns: int, notes: list[str]
) -> tuple[Array, Array]:
    """Nodes between two angles (2, 3) by the speeds between them; what the sum is off at the end is shared out."""
    from scipy.integrate import cumulative_trapezoid

    good = _in_range(place, "Angular_Speeds", "angular speeds", notes)
    times = times_of(good, "TIME")
    refuse_gap(place.path, place.where, times, first_ns, last_ns)
    t, speed = _in_order(good, times, reference)
    between = (t > ends_s[0]) & (t < ends_s[1])
    if not between.any():
        raise place.refuse("Angular_Speeds", "speeds between the times of the angles", "none of them")
    nodes = np.concatenate([ends_s[:1], t[between], ends_s[1:]])
    speed = np.pad(speed[between], ((1, 1), (0, 0)), mode="edge")
    found = angles[0] + cumulative_trapezoid(speed, nodes, axis=0, initial=0)
    share = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
    return nodes, found + share[:, None] * (angles[1] - found[-1])


def _look(strip: Element, samples: int, notes: list[str]) -> TableLook:
    bands = strip.all(
        "Sensor_Configuration/Instrument_Look_Angles_List/Instrument_Look_Angles", "look angles of the detectors"
    )
    if len(bands) > 1:
        notes.append(f"{strip.path.name}: {len(bands)} bands, the look angles of the first are used")
    angles = bands[0].all("Look_Angles_List/Look_Angles", "look angles of at least 2 detectors", least=2)
    detector = np.array([a.number("DETECTOR_ID") for a in angles])
    psi = np.array([[a.number("PSI_X"), a.number("PSI_Y")] for a in angles])
    if not (np.diff(detector) > 0).all():
        k = int(np.argmin(np.diff(detector) > 0)) + 1
        raise angles[k].refuse("DETECTOR_ID", "a number above that of the detector before", f"{detector[k]:g}")
    if samples > detector[-1]:
        notes.append(
            f"{strip.path.name}: look angles of {len(angles)} detectors for {samples} columns, continued beyond the "
            "last"
        )
    if len(detector) < detector[-1] - detector[0] + 1:  # some detectors alone: angles are linear between them
        every = np.arange(detector[0], detector[-1] + 1.0)
        psi = np.stack([np.interp(every, detector, column) for column in psi.T], axis=1)
        detector = every
    look = np.stack([-np.tan(psi[:, 1]), np.tan(psi[:, 0]), -np.ones(len(psi))], axis=1)
    return TableLook(detector - 1.0, look, samples)
