"""DIMAP 2: Pleiades, Pleiades Neo and SPOT-6/7 scenes, as products and as of the maker's ground segment.

Products have their polynomials in a file of their own, which the scene names: they are read where they lie beside it.

Conventions. Rows and columns count from 1 at the centre of the first pixel. Line ``r`` is taken at the start of the
time range plus ``(r - 1)`` line periods. Quaternions are scalar first and turn body to Earth-fixed; as polynomials they
are functions of the UTC second of the day, shifted by OFFSET and divided by SCALE. A detector looks along
``(Y, -X, 1)`` with the tangents X, Y as polynomials of its number in the whole swath, from 0; the first column of the
image is detector ``FIRST_COL - 1``. Positions are interpolated by Lagrange's formula through eight. Light time and
aberration are in the attitudes already.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....solver.location.look_directions import PolynomialLook
from ....solver.location.pushbroom import PushbroomSensor
from ....solver.orbit.attitude import Attitude, PolynomialAttitude, SplineAttitude
from ....solver.orbit.line_times import UniformLineTimes
from ....solver.orbit.motion import Motion
from ....solver.orbit.time_scales import tai_from_day, unix_from_tai
from ...errors import UserError
from .rpc_files import has_dimap_rpc, read_dimap_rpc
from .scene import SatelliteScene, corner_notes, orbit_of, refuse_gap
from .xml_file import Element, read_xml, times_of

Array = NDArray[np.floating]

#: From (X, Y, 1) of the look polynomials to the body.
_BODY_FROM_LOOK = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_DAY = 86_400 * 1_000_000_000
#: Units of the line period, in seconds.
_UNITS = {"s": 1.0, "second": 1.0, "ms": 1e-3, "millisecond": 1e-3, "us": 1e-6, "microsecond": 1e-6}
#: Where a document names the file of its polynomials.
_RPC_FILE = "Geoposition/Geoposition_Models/Rational_Function_Model/Component/COMPONENT_PATH"
#: Files give times to the microsecond or better: how far the first and last line may lie outside, seconds.
_MARGIN_S = 1.0
#: The list of quaternions may begin and end this many of its steps inside the scene; tuned.
_STEPS_BEYOND = 2.0
#: Orbit and quaternions may begin and end so many seconds inside the scene, as those of Pleiades Neo do by some steps
#: of 4 ms. Derived: an orbit that is continued by its velocity is off by 1 cm then.
_BEYOND_S = 0.05


def read_dimap2(root: Element) -> SatelliteScene:
    """The scene of a DIMAP 2 document.

    Raises
    ------
    UserError : an element that is missing or has no sense, by its place in the document
    """
    notes: list[str] = []
    model = root.find("Geometric_Data/Refined_Model", "Geometric_Data/Sensor_Model_Characteristics")
    named = root.find(_RPC_FILE)
    if model is None and named is None:
        raise root.refuse(
            "Geometric_Data/Refined_Model",
            "the rigorous model of a SENSOR product (DIM_*.XML; an ORTHO product has none)",
        )
    size = root.need("Raster_Dimensions", "the size of the image", "Raster_Data/Raster_Dimensions")
    lines, samples = size.integer("NROWS", low=1), size.integer("NCOLS", low=1)
    rpc = read_dimap_rpc(root, lines, samples) if has_dimap_rpc(root) else None
    if rpc is None and named is not None:
        path = root.path.parent / named.node.get("href", "")
        if path.is_file():
            rpc = read_dimap_rpc(read_xml(path), lines, samples)
        elif model is None:
            raise named.refuse("", "this file beside it, as there is no rigorous model", path.name)
    if model is None:
        return SatelliteScene("rpc", None, rpc)
    start, period_s = _times(model, lines)
    last_ns = start + round((lines - 1) * period_s * 1e9)
    try:
        orbit = _orbit(model, start, last_ns, notes)
        attitude = _attitude(model, start, last_ns)
        sensor = PushbroomSensor(
            Motion(orbit, attitude),
            UniformLineTimes(0.0, period_s, lines),
            _look(model, samples, notes),
            reference_ns=start,
            name=root.path.stem,
        )
    except ValueError as error:
        raise UserError(f"{root.path}: {model.where}: {error}") from None
    notes += corner_notes(sensor, root.find("Dataset_Content/Dataset_Extent", "Product_Frame/Dataset_Frame"))
    return SatelliteScene("dimap2", sensor, rpc, notes)


def _times(model: Element, lines: int) -> tuple[int, float]:
    """Time of the first line (``tai_ns``) and line period in seconds."""
    span = model.need("Time/Time_Range", "the time range of the image", "UTC_Sensor_Model_Range")
    period = model.need(
        "Time/Time_Stamp/LINE_PERIOD", "the line period", "Time/Time_Range/LINE_PERIOD", "SENSOR_LINE_PERIOD"
    )
    value, unit, start = period.number(), period.node.get("unit"), span.time("START")
    if not value > 0:
        raise period.refuse("", "a number above 0", period.text())
    if unit is None:  # milliseconds of Pleiades, microseconds of SPOT-6/7: as the lines fill the time range
        filled_s = (span.time("END") - start) * 1e-9 if span.find("END") is not None else value * 1e-3 * (lines - 1)
        return start, min((value * s for s in _UNITS.values()), key=lambda p: abs(p * (lines - 1) - filled_s))
    if unit.lower() not in _UNITS:
        raise period.refuse("", f"one of the units {', '.join(_UNITS)}", f"unit {unit}")
    return start, value * _UNITS[unit.lower()]


def _orbit(model: Element, start: int, last_ns: int, notes: list[str]):
    place = model.need("Ephemeris/Point_List", "positions of the satellite", "Sensor_Ephemeris/Point_List")
    points = place.all("Point", "at least 2 positions of the satellite", least=2)
    times = times_of(points, "TIME", "UTC_TIME")
    refuse_gap(model.path, place.where, times, start, last_ns)
    position = np.array([p.numbers("LOCATION_XYZ", 3, "LOCATION_VALUES") for p in points])
    velocity = None
    if all(p.find("VELOCITY_XYZ", "VELOCITY_VALUES") is not None for p in points):
        velocity = np.array([p.numbers("VELOCITY_XYZ", 3, "VELOCITY_VALUES") for p in points])
        times, position, velocity = _continued(times, position, velocity, start, last_ns)
    return orbit_of(model.path, place.where, times, position, velocity, start, notes)


def _continued(
    times: list[int], position: Array, velocity: Array, start: int, last_ns: int
) -> tuple[list[int], Array, Array]:
    """Nodes of an orbit with more of them, by the velocity, where the scene begins or ends a little beyond them."""
    if len(times) < 2:
        return times, position, velocity
    order = np.argsort(times, kind="stable")
    t, P, V = np.array(times, dtype=np.int64)[order], position[order], velocity[order]
    step = max(int(np.median(np.diff(t))), 1)
    missing = [max(int(beyond), 0) if beyond <= _BEYOND_S * 1e9 else 0 for beyond in (t[0] - start, last_ns - t[-1])]
    before, after = (step * np.arange(1, -(-beyond // step) + 1) for beyond in missing)
    ahead = np.concatenate([-before[::-1], after])
    end = np.concatenate([np.zeros(len(before), dtype=int), np.full(len(after), -1)])
    more = P[end] + ahead[:, None] * 1e-9 * V[end]
    return [*times, *(t[end] + ahead).tolist()], np.vstack([position, more]), np.vstack([velocity, V[end]])


def _attitude(model: Element, start: int, last_ns: int) -> Attitude:
    place = model.need("Attitudes", "attitudes of the satellite", "Sensor_Attitudes")
    polynomials = place.find("Polynomial_Quaternions", "Polynomial_Models")
    if polynomials is not None:
        source = polynomials if polynomials.find("OFFSET") is not None else place
        scale_s = source.number("SCALE")
        q = [polynomials.numbers(f"Q{k}/COEFFICIENTS") for k in range(4)]
        middle = (start + last_ns) // 2
        offset_s = _second_of_day(source.number("OFFSET"), start, middle)
        end_s = (last_ns - start) * 1e-9
        begin = min(offset_s - abs(scale_s), -_MARGIN_S)
        return PolynomialAttitude(
            [q[1], q[2], q[3], q[0]], offset_s, scale_s, begin, max(offset_s + abs(scale_s), end_s + _MARGIN_S)
        )
    quaternions = place.need("Quaternion_List", "polynomials or a list of quaternions").all(
        "Quaternion", "at least 2 quaternions", least=2
    )
    times = times_of(quaternions, "TIME", "UTC_TIME")
    refuse_gap(place.path, f"{place.where}/Quaternion_List", times, start, last_ns)
    q = np.array([[e.number(f"Q{k}") for k in (1, 2, 3, 0)] for e in quaternions])
    order = np.argsort(times, kind="stable")
    t = (np.array(times, dtype=np.int64)[order] - start) * 1e-9
    margin_s = max(_STEPS_BEYOND * float(np.median(np.diff(t))), _BEYOND_S)
    return SplineAttitude(t, q[order], margin_s=margin_s)


def _second_of_day(offset_s: float, start: int, middle: int) -> float:
    """Seconds from ``start`` of a UTC second of the day; of the days about midnight the one nearest to ``middle``."""
    mjd = int(unix_from_tai(start)) // _DAY + 40587
    seconds = [(tai_from_day(mjd + day, 0) - start) * 1e-9 + offset_s for day in (-1, 0, 1)]
    return min(seconds, key=lambda s: abs(s - (middle - start) * 1e-9))


def _look(model: Element, samples: int, notes: list[str]) -> PolynomialLook:
    calibration = model.need(
        "Geometric_Calibration/Instrument_Calibration", "look angles of the detectors", "Sensor_Viewing_Model"
    )
    biases = calibration.find("Instrument_Biases")
    turns = [] if biases is None else [biases.number(name, default=0.0) for name in ("YAW", "PITCH", "ROLL")]
    if any(turns):
        told = ", ".join(f"{turn:g}" for turn in turns)
        notes.append(f"{model.path.name}: Instrument_Biases: yaw, pitch, roll of {told} are not applied")
    swath = calibration.find("Swath_Range", "Position_In_Retina", ".//Swath_Range")
    bands = calibration.node.findall(".//Polynomial_Look_Angles")
    if len(bands) > 1:
        notes.append(f"{model.path.name}: {len(bands)} bands, the look angles of the first are used")
    directions = calibration.find(".//Polynomial_Look_Angles")
    if directions is not None:
        x, y = ([], [])
        for name, values in (("XLOS", x), ("YLOS", y)):
            while (place := directions.find(f"{name}_{len(values)}")) is not None:
                values.append(place.number())
            if not values:
                raise directions.refuse(f"{name}_0", "a number")
    else:
        directions = calibration.need("Viewing_Directions", "look angles of the detectors")
        x = directions.numbers("PsiX_Model/COEFFICIENTS")
        y = directions.numbers("PsiY_Model/COEFFICIENTS")
    first = 1.0
    if swath is None:
        notes.append(f"{model.path.name}: no range of columns in the swath, the image is taken to begin with the first")
    else:
        first, last = swath.number("FIRST_COL"), swath.number("LAST_COL")
        if not last > first:
            raise swath.refuse("LAST_COL", f"a column after the first, {first:g}", f"{last:g}")
    return PolynomialLook(x, y, samples, _BODY_FROM_LOOK, shift=first - 1.0)
