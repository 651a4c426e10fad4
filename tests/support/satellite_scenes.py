"""Satellite scenes with a known truth, and their metadata in every format that triline reads.

The truth is written down here a second time and in another way than in the solver: a circular orbit in closed form, and
a camera that looks down with a constant tilt. Positions and attitudes of the files are taken from it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import Transformer
from scipy.spatial.transform import Rotation

OMEGA = 7.292115e-5
GM = 3.986004418e14
#: 0h UTC of the scene's day, and the second of the day at which the satellite crosses its start
DAY, START_S = "2021-03-04", 37_200.25
_TO_GEODETIC = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


@dataclass(frozen=True)
class Truth:
    """A circular orbit over an Earth that turns about its z axis, and a line camera.

    Attributes
    ----------
    inclination_deg, node_deg, phase_deg : of the orbit; phase and node at time 0, the first line
    height_m : of the orbit above the equator
    lines, samples, period_s : of the image
    gsd : angle of a pixel, rad
    tilt_deg : roll, pitch, yaw of the body in the orbital frame
    """

    inclination_deg: float = 98.2
    node_deg: float = 30.0
    phase_deg: float = 40.0
    height_m: float = 694_000.0
    lines: int = 20_000
    samples: int = 6_000
    period_s: float = 2.0e-4
    gsd: float = 2.2e-6
    tilt_deg: tuple[float, float, float] = (4.0, -7.0, 1.0)

    @property
    def radius_m(self) -> float:
        return 6_378_137.0 + self.height_m

    def orbit(self, t) -> tuple[np.ndarray, np.ndarray]:
        """Earth-fixed position and velocity over the turning Earth at times (n,)."""
        t = np.asarray(t, dtype=float)
        n = np.sqrt(GM / self.radius_m**3)
        u, i = np.radians(self.phase_deg) + n * t, np.radians(self.inclination_deg)
        lam = np.radians(self.node_deg) - OMEGA * t
        x, y, z = np.cos(u), np.sin(u) * np.cos(i), np.sin(u) * np.sin(i)
        dx, dy, dz = -np.sin(u) * n, np.cos(u) * np.cos(i) * n, np.cos(u) * np.sin(i) * n
        c, s = np.cos(lam), np.sin(lam)
        P = np.stack([c * x - s * y, s * x + c * y, z], axis=-1) * self.radius_m
        V = np.stack([c * dx - s * dy, s * dx + c * dy, dz], axis=-1) * self.radius_m
        return P, V - np.cross([0.0, 0.0, OMEGA], P)

    def orbital_frame(self, t, inertial: bool = True) -> np.ndarray:
        """Rotations (n, 3, 3), columns forward, right, down."""
        P, V = self.orbit(t)
        if inertial:
            V = V + np.cross([0.0, 0.0, OMEGA], P)
        down = -P / np.linalg.norm(P, axis=-1, keepdims=True)
        right = np.cross(down, V)
        right /= np.linalg.norm(right, axis=-1, keepdims=True)
        return np.stack([np.cross(right, down), right, down], axis=-1)

    def R_eb(self, t, inertial: bool = True) -> np.ndarray:
        """Body (forward, right, down) to Earth-fixed."""
        roll, pitch, yaw = self.tilt_deg
        return (
            self.orbital_frame(t, inertial) @ Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        )

    def look(self, v) -> np.ndarray:
        """Directions in the body (n, 3): detectors from left to right, a little ahead."""
        v = np.asarray(v, dtype=float)
        return np.stack([np.full_like(v, 0.004), (v - 0.5 * (self.samples - 1)) * self.gsd, np.ones_like(v)], axis=-1)

    def miss_m(self, u, v, located, inertial: bool = True) -> float:
        """Largest distance of located points (n, 3; lat, lon in radians, height) from the true rays of pixels."""
        t = np.asarray(u) * self.period_s
        C = self.orbit(t)[0]
        d = np.einsum("nij,nj->ni", self.R_eb(t, inertial), self.look(v))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        X = cartesian(located) - C
        along = np.einsum("ni,ni->n", X, d)
        assert (along > 0).all() and (along < 3.0 * self.height_m).all()
        return float(np.linalg.norm(X - along[:, None] * d, axis=1).max())


def cartesian(located) -> np.ndarray:
    """Earth-fixed positions by PROJ of latitudes, longitudes (radians) and heights (n, 3)."""
    lat, lon, h = np.asarray(located).T
    x, y, z = _TO_GEODETIC.transform(np.degrees(lon), np.degrees(lat), h, direction="INVERSE")
    return np.stack([x, y, z], axis=-1)


def utc(t: float) -> str:
    """UTC text of a time of the scene; the first line is taken at `START_S`."""
    ns = round((START_S + t) * 1e9)
    return str(np.datetime64(DAY, "ns") + np.timedelta64(ns, "ns")) + "Z"


def nodes(truth: Truth, step: float, beyond: float) -> np.ndarray:
    """Even times that reach beyond the scene on both sides."""
    end = (truth.lines - 1) * truth.period_s
    first, last = np.floor(-beyond / step), np.ceil((end + beyond) / step)
    return np.arange(first, last + 1) * step


def _numbers(values) -> str:
    return " ".join(f"{x:.17g}" for x in np.atleast_1d(values))


def write_dimap2(
    path: Path, truth: Truth, *, polynomial: bool = False, first_col: int = 1, short_s: float | None = None
) -> Path:
    """A DIMAP 2 document as products have it: quaternions in a list (SPOT-6/7), or polynomials (Pleiades).

    With ``short_s`` nodes are as dense as those of Pleiades Neo, and end so many seconds inside the scene.
    """
    t, ta = nodes(truth, 10.0, 60.0), nodes(truth, 0.125, 1.0)
    end = (truth.lines - 1) * truth.period_s
    if short_s is not None:
        t = ta = np.arange(short_s, end - short_s, 0.0044)
    points = "".join(
        f"<Point><LOCATION_XYZ>{_numbers(p)}</LOCATION_XYZ><VELOCITY_XYZ>{_numbers(v)}</VELOCITY_XYZ>"
        f"<TIME>{utc(k)}</TIME></Point>"
        for k, p, v in zip(t, *truth.orbit(t), strict=True)
    )

    def quaternions(times):  # scalar first
        q = Rotation.from_matrix(truth.R_eb(times)).as_quat()[:, [3, 0, 1, 2]]
        sign = np.cumprod(np.where(np.einsum("ij,ij->i", q[:-1], q[1:]) < 0, -1.0, 1.0))
        return q * np.concatenate([[1.0], sign])[:, None]

    if polynomial:
        offset, scale = 0.5 * end, 0.5 * end + 0.2
        s = np.linspace(-1.0, 1.0, 60)
        fit = np.polynomial.polynomial.polyfit(s, quaternions(offset + scale * s), 3)
        parts = "".join(
            f"<Q{k}><DEGREE>3</DEGREE><COEFFICIENTS>{_numbers(c)}</COEFFICIENTS></Q{k}>" for k, c in enumerate(fit.T)
        )
        attitudes = (
            f"<Polynomial_Quaternions><OFFSET>{START_S + offset!r}</OFFSET><SCALE>{scale!r}</SCALE>{parts}"
            "</Polynomial_Quaternions>"
        )
    else:
        attitudes = "".join(
            f"<Quaternion><TIME>{utc(k)}</TIME>"
            + "".join(f"<Q{i}>{x:.17g}</Q{i}>" for i, x in enumerate(q))
            + "</Quaternion>"
            for k, q in zip(ta, quaternions(ta), strict=True)
        )
        attitudes = f"<Quaternion_List>{attitudes}</Quaternion_List>"
    # look = (Y, -X, 1)
    # of detectors of the whole swath, of which the image may be a part
    y, x = 0.004, ((0.5 * (truth.samples - 1) + first_col - 1) * truth.gsd, -truth.gsd)
    path.write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document>
<Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT></Metadata_Identification>
<Raster_Data><Raster_Dimensions><NROWS>{truth.lines}</NROWS><NCOLS>{truth.samples}</NCOLS></Raster_Dimensions></Raster_Data>
<Geometric_Data><Refined_Model>
<Time><Time_Range><START>{utc(0.0)}</START><END>{utc(end)}</END></Time_Range>
<Time_Stamp><LINE_PERIOD unit="ms">{truth.period_s * 1e3!r}</LINE_PERIOD></Time_Stamp></Time>
<Ephemeris><Point_List>{points}</Point_List></Ephemeris>
<Attitudes>{attitudes}</Attitudes>
<Geometric_Calibration><Instrument_Calibration>
<Swath_Range><FIRST_COL>{first_col}</FIRST_COL><LAST_COL>{first_col + truth.samples - 1}</LAST_COL></Swath_Range>
<Polynomial_Look_Angles><XLOS_0>{x[0]:.17g}</XLOS_0><XLOS_1>{x[1]:.17g}</XLOS_1>
<YLOS_0>{y:.17g}</YLOS_0></Polynomial_Look_Angles>
</Instrument_Calibration></Geometric_Calibration>
</Refined_Model></Geometric_Data>
</Dimap_Document>
""")
    return path


def write_dimap1(path: Path, truth: Truth, mission: str = "SPOT 5") -> Path:
    """A DIMAP 1 document of level 1A: angles in the orbital frame, for SPOT-5 that over the turning Earth."""
    satellite, index = mission.split()
    t, ta = nodes(truth, 30.0, 150.0), nodes(truth, 0.125, 1.0)
    centre = truth.lines // 2
    points = "".join(
        "<Point>"
        + "".join(
            f"<{name}>" + "".join(f"<{a}>{x:.17g}</{a}>" for a, x in zip("XYZ", value, strict=True)) + f"</{name}>"
            for name, value in (("Location", p), ("Velocity", v))
        )
        + f"<TIME>{utc(k)}</TIME></Point>"
        for k, p, v in zip(t, *truth.orbit(t), strict=True)
    )
    # body = (forward, right, down); the handbook's frame: X2 = right, Y2 = forward, Z2 = up
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    roll, pitch, yaw = truth.tilt_deg
    body = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    minus_pitch, minus_roll, plus_yaw = Rotation.from_matrix(swap @ body @ swap).as_euler("XYZ")
    angles = "".join(
        f"<Angles><TIME>{utc(k)}</TIME><YAW>{plus_yaw:.17g}</YAW><PITCH>{-minus_pitch:.17g}</PITCH>"
        f"<ROLL>{-minus_roll:.17g}</ROLL><OUT_OF_RANGE>N</OUT_OF_RANGE></Angles>"
        for k in ta
    )
    # look in the handbook's frame: (-tan psi_y, tan psi_x, -1)
    v = np.arange(truth.samples)
    right, forward, _ = swap @ truth.look(v).T
    looks = "".join(
        f"<Look_Angles><DETECTOR_ID>{k + 1}</DETECTOR_ID><PSI_X>{np.arctan(f):.17g}</PSI_X>"
        f"<PSI_Y>{np.arctan(-r):.17g}</PSI_Y></Look_Angles>"
        for k, r, f in zip(v, right, forward, strict=True)
    )
    path.write_text(f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<Dimap_Document>
<Metadata_Id><METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT></Metadata_Id>
<Dataset_Sources><Source_Information><Scene_Source><MISSION>{satellite}</MISSION><MISSION_INDEX>{index}</MISSION_INDEX>
<SCENE_PROCESSING_LEVEL>0</SCENE_PROCESSING_LEVEL></Scene_Source></Source_Information></Dataset_Sources>
<Data_Processing><PROCESSING_LEVEL>1A</PROCESSING_LEVEL></Data_Processing>
<Raster_Dimensions><NCOLS>{truth.samples}</NCOLS><NROWS>{truth.lines}</NROWS><NBANDS>1</NBANDS></Raster_Dimensions>
<Data_Strip><Ephemeris><Points>{points}</Points></Ephemeris>
<Satellite_Attitudes><Corrected_Attitudes><Corrected_Attitude>{angles}</Corrected_Attitude></Corrected_Attitudes>
</Satellite_Attitudes><Sensor_Configuration><Time_Stamp><LINE_PERIOD>{truth.period_s!r}</LINE_PERIOD>
<SCENE_CENTER_TIME>{utc((centre - 1) * truth.period_s)}</SCENE_CENTER_TIME>
<SCENE_CENTER_LINE>{centre}</SCENE_CENTER_LINE></Time_Stamp>
<Instrument_Look_Angles_List><Instrument_Look_Angles><BAND_INDEX>1</BAND_INDEX>
<Look_Angles_List>{looks}</Look_Angles_List></Instrument_Look_Angles></Instrument_Look_Angles_List></Sensor_Configuration>
</Data_Strip>
</Dimap_Document>
""")
    return path


def write_isd(path: Path, truth: Truth, *, inertial: bool = False, semi_minor_km: float = 6356.752314245179) -> Path:
    """An ISD: body-fixed tables, or J2000 with the rotation of the planet."""
    centre = 5.0e8
    t, ta = nodes(truth, 10.0, 60.0), nodes(truth, 0.1, 1.0)
    focal, pitch = 1000.0, 1000.0 * truth.gsd
    P, V = truth.orbit(t)
    R = truth.R_eb(ta)
    isd: dict = {
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
        "image_lines": truth.lines,
        "image_samples": truth.samples,
        "center_ephemeris_time": centre,
        "starting_ephemeris_time": centre,
        "line_scan_rate": [[0.5, -0.5 * truth.period_s, truth.period_s]],
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
        "focal2pixel_lines": [0.0, 1.0 / pitch, 0.0],
        "focal2pixel_samples": [0.0, 0.0, 1.0 / pitch],
        "focal_length_model": {"focal_length": focal},
        "detector_center": {"line": -0.004 * focal / pitch, "sample": 0.5 * truth.samples},
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
        "radii": {"semimajor": 6378.137, "semiminor": semi_minor_km, "unit": "km"},
    }
    if not inertial:
        isd |= {
            "t0_ephemeris": t[0], "dt_ephemeris": 10.0, "t0_quaternion": ta[0], "dt_quaternion": 0.1,
            "sensor_position": {"positions": P.tolist(), "velocities": V.tolist(), "unit": "m"},
            "sensor_orientation": {"quaternions": Rotation.from_matrix(R).as_quat().tolist()},
        }  # fmt: skip
    else:
        turn = Rotation.from_rotvec(np.outer(-OMEGA * t, [0, 0, 1]))  # J2000 to body-fixed, equal at time 0
        turn_a = Rotation.from_rotvec(np.outer(-OMEGA * ta, [0, 0, 1]))
        to_camera = Rotation.from_matrix(R).inv() * turn_a
        isd |= {
            "instrument_position": {
                "unit": "km", "ephemeris_times": (centre + t).tolist(),
                "positions": (turn.inv().apply(P) / 1e3).tolist(),
                "velocities": (turn.inv().apply(V + np.cross([0, 0, OMEGA], P)) / 1e3).tolist(),
            },
            "instrument_pointing": {
                "ephemeris_times": (centre + ta).tolist(), "quaternions": to_camera.as_quat()[:, [3, 0, 1, 2]].tolist(),
            },
            "body_rotation": {
                "ephemeris_times": (centre + t).tolist(), "quaternions": turn.as_quat()[:, [3, 0, 1, 2]].tolist(),
            },
        }  # fmt: skip
    path.write_text(json.dumps(isd))
    return path


def write_folder(path: Path, truth: Truth, *, angles: bool = True, velocities: bool = True, settings: str = "") -> Path:
    """A plain folder; attitude as angles in the orbital frame, or Earth-fixed quaternions."""
    path.mkdir(exist_ok=True)
    t, ta = nodes(truth, 30.0, 120.0), nodes(truth, 0.5, 2.0)
    P, V = truth.orbit(t)
    head, rows = "time_utc,X_m,Y_m,Z_m", P
    if velocities:
        head, rows = head + ",VX_m_s,VY_m_s,VZ_m_s", np.hstack([P, V])
    lines = [f"{utc(k)}," + ",".join(f"{x:.9f}" for x in row) for k, row in zip(t, rows, strict=True)]
    (path / "ephemeris.csv").write_text("\n".join([head, *lines, ""]))
    if angles:
        head, rows = "time_utc,roll_deg,pitch_deg,yaw_deg", np.tile(truth.tilt_deg, (len(ta), 1))
    else:
        head, rows = "time_utc,qx,qy,qz,qw", Rotation.from_matrix(truth.R_eb(ta)).as_quat()
    lines = [f"{utc(k)}," + ",".join(f"{x:.15f}" for x in row) for k, row in zip(ta, rows, strict=True)]
    (path / "attitude.csv").write_text("\n".join([head, *lines, ""]))
    last = truth.lines - 1
    (path / "line_times.csv").write_text(f"line,time_utc\n0,{utc(0.0)}\n{last},{utc(last * truth.period_s)}\n")
    focal = 650.0
    camera = {
        "name": "test",
        "lenses": [{"id": "L", "focal_length_mm": focal}],
        "lines": [{"id": "P", "lens": "L", "pixels": truth.samples, "table": "pixels.csv"}],
    }
    (path / "camera.json").write_text(json.dumps(camera))
    # image x along the flight, y to the left
    look = truth.look(np.arange(truth.samples)) * focal
    rows = [f"{k},{x:.12f},{-y:.12f}" for k, (x, y, _) in enumerate(look)]
    (path / "pixels.csv").write_text("\n".join(["sample,x_mm,y_mm", *rows, ""]))
    frame = "orbital" if angles else "earth"
    text = settings or f'[frames]\nattitude = "{frame}"\n[model]\nlight_time = false\naberration = false\n'
    (path / "scene.toml").write_text(text)
    return path
