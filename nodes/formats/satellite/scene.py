"""What the readers of satellite metadata have in common: the scene they return, and checks of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....solver.geometry.earth import ROTATION_RATE
from ....solver.geometry.ellipsoid import WGS84, Ellipsoid
from ....solver.location.pushbroom import PushbroomSensor
from ....solver.location.rpc import Rpc
from ....solver.location.uncertainty import Sigmas
from ....solver.orbit.ephemeris import InterpolatedOrbit
from ....solver.orbit.time_scales import iso_utc
from ....solver.scene_adjustment.rigorous import LensView
from ...errors import UserError
from .xml_file import Element

Array = NDArray[np.floating]

#: A step between nodes that is this much longer than the usual one is a gap. Tuned: single nodes may be missing.
GAP_STEPS = 3.5
#: Largest difference between stated velocities and the slope of the positions at which they count as the same, m/s.
#: Tuned: velocities against the stars differ by hundreds.
SAME_VELOCITY_M_S = 1.0
#: Corners that lie further beside the rays of their pixels are told, metres. Tuned: orbits and attitudes are better.
CORNER_OFF_M = 1000.0
#: Heights of ground, metres.
_GROUND_M = (-500.0, 9000.0)
#: Half axes that differ by less are the same, metres; GRS 80 has those of WGS 84 to a tenth of a millimetre.
_SAME_AXIS_M = 1e-3
#: Nodes that are left out in turn to judge velocities, and how many on each side they are met by.
_LEFT_OUT, _NEIGHBOURS = 20, 4


@dataclass(frozen=True)
class SatelliteScene:
    """A scene as its metadata describe it.

    Attributes
    ----------
    kind : of the file, a name in `read.KINDS`
    sensor : rigorous model, None where the file has none
    rpc : rational polynomials, None where the file has none
    notes : remarks for the user
    sensors : one for each line of detectors, by its name, where the file has several
    sigmas : accuracies that the file states
    views : image frame of each line of detectors in the body, where the file has its camera
    camera : its name, "" where the file has none
    """

    kind: str
    sensor: PushbroomSensor | None
    rpc: Rpc | None = None
    notes: list[str] = field(default_factory=list)
    sensors: dict[str, PushbroomSensor] = field(default_factory=dict)
    sigmas: Sigmas = field(default_factory=Sigmas)
    views: dict[str, LensView] = field(default_factory=dict)
    camera: str = ""

    def model(self, which: str | None = None, ccd: str | None = None) -> PushbroomSensor | Rpc:
        """The model to locate with: "rigorous", "rpc", or None for the better one that is there.

        Raises
        ------
        UserError : there is none of that kind, or no line of detectors of that name
        """
        if ccd is not None and ccd not in self.sensors:
            have = ", ".join(self.sensors) or "one without a name"
            raise UserError(f"line of detectors {ccd!r}: not in the scene, which has {have}")
        sensor = self.sensor if ccd is None else self.sensors[ccd]
        chosen = self.rpc if which == "rpc" or sensor is None else sensor
        if chosen is None or (which == "rigorous" and sensor is None):
            raise UserError(f"no {which or 'rigorous'} model in a file of the kind {self.kind}")
        return chosen

    def line_taken(self, model: PushbroomSensor | Rpc, ccd: str | None) -> list[str]:
        """A note where the file has several lines of detectors and nobody said which: the first is taken."""
        if ccd is not None or len(self.sensors) < 2 or not isinstance(model, PushbroomSensor):
            return []
        taken = next(id for id, sensor in self.sensors.items() if sensor is self.sensor)
        return [f"line of detectors {taken} of {', '.join(self.sensors)}: --ccd takes another"]


def ellipsoid_of(semi_major_m: float, semi_minor_m: float) -> Ellipsoid:
    """The ellipsoid of two half axes; WGS 84 where they are its, as far as files write them out."""
    near = max(abs(semi_major_m - WGS84.semi_major_m), abs(semi_minor_m - WGS84.semi_minor_m)) < _SAME_AXIS_M
    return WGS84 if near else Ellipsoid(semi_major_m, semi_minor_m)


def orbit_of(path: Path, where: str, tai_ns: list[int], position: Array, velocity: Array | None,
             reference_ns: int, notes: list[str]) -> InterpolatedOrbit:  # fmt: skip
    """Earth-fixed orbit through the nodes of an ephemeris; repeated nodes are dropped.

    Eight positions or more are interpolated without velocities (Lagrange, as makers of satellites define it). With
    fewer, velocities are used if they are the slope of the positions, or become it without the rotation of the Earth.

    Raises
    ------
    UserError : fewer than two nodes
    """
    order = np.argsort(tai_ns, kind="stable")
    stamps = np.array(tai_ns, dtype=np.int64)[order]
    keep = np.concatenate([[True], np.diff(stamps) > 0]) if len(stamps) else np.empty(0, dtype=bool)
    if not keep.all():
        notes.append(f"{path.name}: {where}: {int((~keep).sum())} nodes at a time that an earlier one has were dropped")
    order, stamps = order[keep], stamps[keep]
    if len(order) < 2:
        raise UserError(f"{path}: {where}: {len(order)} positions at different times, wanted at least 2")
    t = (stamps - reference_ns) * 1e-9
    P = position[order]
    if len(order) >= 8 or velocity is None:
        return InterpolatedOrbit(t, P)
    V = velocity[order]
    turning = np.cross([0.0, 0.0, ROTATION_RATE], P)
    misfit = [velocity_misfit(t, P, v) for v in (V, V - turning)]
    if misfit[1] < misfit[0]:
        V = V - turning
        notes.append(f"{path.name}: {where}: velocities are against the stars, the rotation of the Earth was taken off")
    if min(misfit) > SAME_VELOCITY_M_S:
        notes.append(f"{path.name}: {where}: velocities are not the slope of the positions and were not used")
        return InterpolatedOrbit(t, P)
    return InterpolatedOrbit(t, P, V)


def velocity_misfit(time_s: Array, position: Array, velocity: Array) -> float:
    """Largest difference, m/s, between velocities (n, 3) and the slope of positions (n, 3), but for the outer nodes.

    With four nodes or fewer the slope is too uncertain to tell; then it is 0.
    """
    n = len(time_s)
    if n <= 4:
        return 0.0
    slope = InterpolatedOrbit(time_s, position).at(time_s)[1]
    return float(np.abs((velocity - slope)[n // 4 : n - n // 4]).max())


def stated_velocity(
    file: str, time_s: Array, position: Array, velocity: Array, rotation_rate: float, notes: list[str]
) -> Array | None:
    """The velocities (n, 3) of an ephemeris if they are the slope of its positions, or what makes them so; else None.

    They are the slope if nodes that are left out are met by their neighbours with velocities as well as without them.

    Parameters
    ----------
    rotation_rate : of the frame of the positions against the stars, rad/s; velocities may be against these; 0 for none
    notes : gets a remark where the velocities are changed or not used
    """
    if len(time_s) < 2:  # too few for an orbit, which is told
        return velocity
    turning = np.cross([0.0, 0.0, rotation_rate], position)
    wanted = max(_left_out_m(time_s, position, None), SAME_VELOCITY_M_S * float(np.median(np.diff(time_s))))
    off = [_left_out_m(time_s, position, v) for v in (velocity, velocity - turning)]
    if off[0] <= wanted and (off[0] <= 10.0 * off[1] or off[0] <= SAME_VELOCITY_M_S):
        return velocity
    if off[1] < off[0] and off[1] <= wanted:
        notes.append(f"{file}: velocities are against the stars, the rotation of the Earth was taken off")
        return velocity - turning
    notes.append(f"{file}: velocities are not the slope of the positions and were not used")
    return None


def _left_out_m(time_s: Array, position: Array, velocity: Array | None) -> float:
    """How far at most some nodes lie from the orbit through their neighbours, metres; of two nodes, how far the second
    lies from where the mean velocity leads, and infinite without velocities."""
    n = len(time_s)
    if n == 2:
        if velocity is None:
            return np.inf
        return float(np.linalg.norm(position[1] - position[0] - velocity.mean(axis=0) * (time_s[1] - time_s[0])))
    largest = 0.0
    for k in np.unique(np.linspace(1, n - 2, min(n - 2, _LEFT_OUT)).astype(int)):
        others = np.array([i for i in range(max(k - _NEIGHBOURS, 0), min(k + _NEIGHBOURS + 1, n)) if i != k])
        orbit = InterpolatedOrbit(time_s[others], position[others], None if velocity is None else velocity[others])
        largest = max(largest, float(np.linalg.norm(orbit.at(time_s[k : k + 1])[0][0] - position[k])))
    return largest


def refuse_gap(path: Path, where: str, tai_ns: list[int], first_ns: int, last_ns: int) -> None:
    """Refuse nodes that leave out a part of the time in which lines were taken.

    Raises
    ------
    UserError : telling the gap
    """
    t = np.sort(np.array(tai_ns, dtype=np.int64))
    steps = np.diff(t)
    if len(steps) < 3:
        return
    gap = (steps > GAP_STEPS * np.median(steps)) & (t[:-1] < last_ns) & (t[1:] > first_ns)
    if gap.any():
        k = int(np.argmax(gap))
        raise UserError(
            f"{path}: {where}: gap from {iso_utc(int(t[k]))} to {iso_utc(int(t[k + 1]))} while lines were taken, "
            f"wanted a value every {np.median(steps) * 1e-9:g} s"
        )


def corner_notes(sensor: PushbroomSensor, frame: Element | None, prefix: str = "") -> list[str]:
    """A note where pixels are not located where the file itself says that corners of the image lie.

    Parameters
    ----------
    frame : element with a ``Vertex`` a corner, None for none: row and column from 1, latitude and longitude in degrees
    prefix : of the names in a vertex
    """
    names = [f"{prefix}{name}" for name in ("ROW", "COL", "LAT", "LON")]
    corners = [] if frame is None else [Element(frame.path, v, frame.where) for v in frame.node.findall("Vertex")]
    corners = [vertex for vertex in corners if all(vertex.find(name) is not None for name in names)]
    if not corners:
        return []
    row, column, lat, lon = np.array([[vertex.number(name) for name in names] for vertex in corners]).T
    # from the file's corner to the ray at the lowest and the highest ground, and to where it is nearest between them
    try:
        low, high = (
            sensor.ground(row - 1.0, column - 1.0, h)
            - sensor.ellipsoid.cartesian(np.radians(lat), np.radians(lon), np.full(len(lat), h))
            for h in _GROUND_M
        )
    except ValueError:  # a row that is not in the image
        return []
    way = high - low
    square = np.maximum(np.einsum("ni,ni->n", way, way), 1e-9)
    share = np.clip(-np.einsum("ni,ni->n", low, way) / square, 0.0, 1.0)
    off = np.linalg.norm(low + share[:, None] * way, axis=1)
    if not (off > CORNER_OFF_M).any():
        return []
    k = int(np.nanargmax(off))
    return [
        f"{corners[k].path.name}: row {row[k]:g}, column {column[k]:g} lies {off[k] / 1000.0:.3g} km from where the "
        "file says that this corner is: what is located by its orbit and attitude may be wrong"
    ]
