"""Units of the number fields of all messages, as they end the names of columns: ``x_m``, ``covariance_X_Y_m2``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

#: Coordinates and angles of a pose, with their units.
POSE = (("X", "m"), ("Y", "m"), ("Z", "m"), ("omega", "rad"), ("phi", "rad"), ("kappa", "rad"))
_XYZ, _RPY = ("X", "Y", "Z"), ("roll", "pitch", "heading")

#: Units that coordinates of a place may have in a CRS.
PLACE_UNITS = ("m", "deg", "grad", "ft", "ft_us", "crs_unit")


def place_columns(units: Iterable[str] = ("m", "m", "m")) -> tuple[str, ...]:
    """Columns of the coordinates of a place, by their units: ``X_m, Y_m, Z_m``, or ``X_deg, Y_deg, Z_m``."""
    return tuple(f"{axis}_{unit}" for axis, unit in zip(_XYZ, units, strict=True))


def _square(axes: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Ends of the columns of a covariance, row by row: both axes, and the product of their units."""
    ends = []
    for a, unit in axes:
        for b, other in axes:
            product = f"{unit}2" if unit == other else "_".join(sorted((unit, other)))
            ends.append(f"{a}_{b}_{product}")
    return tuple(ends)


def _with(unit: str, axes: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{axis}_{unit}" for axis in axes)


_EACH = tuple(f"{axis}_{unit}" for axis, unit in POSE)
_ENU = ("east", "north", "up")
_POINT = {"x": "m", "y": "m", "z": "m", "covariance": _square([(axis, "m") for axis in _XYZ])}

#: Message type -> field -> unit ("" = none) of a number, or the ends of the columns of a vector. Parts of several types
#: stand under the message that has them, with dots.
UNITS: dict[str, dict[str, str | tuple[str, ...]]] = {
    "foxglove.LocationFix": {
        "latitude": "deg", "longitude": "deg", "altitude": "m",
        "position_covariance": _square([(axis, "m") for axis in _ENU]),
        "velocity_enu.x": "m_s", "velocity_enu.y": "m_s", "velocity_enu.z": "m_s",
        "velocity_covariance": tuple(f"{a}_{b}_m2_s2" for a in _ENU for b in _ENU),
    },
    "foxglove.PoseInFrame": {
        "pose.position.x": "m", "pose.position.y": "m", "pose.position.z": "m",
        **{f"pose.orientation.{axis}": "" for axis in "xyzw"},
        "covariance": _square(POSE), "correction": _EACH, "angles": _EACH[3:], "protection": _EACH,
        "velocity.x": "m_s", "velocity.y": "m_s", "velocity.z": "m_s", "noise_time_s": "s",
    },
    "foxglove.RawImage": {
        "width": "px", "height": "lines", "step": "bytes", "first_line": "", "line_period_ns": "ns",
        "line_times_ns": "ns",
    },
    "foxglove.Log": {"line": ""},
    "triline.Imu": {
        "time_ns": "ns", "interval_ns": "ns", "force_sigma": "m_s2", "rate_sigma": "rad_s",
        **{f"force_{axis}": "m_s2" for axis in "xyz"}, **{f"rate_{axis}": "rad_s" for axis in "xyz"},
    },
    "triline.Attitude": {
        "time_ns": "ns", **dict.fromkeys(_RPY, "rad"), "covariance": _square([(axis, "rad") for axis in _RPY]),
    },
    "triline.Strip": {"first_line_time_ns": "ns", "line_rate_hz": "hz", "lines": ""},
    "triline.Lens": {"focal_length_mm": "mm", "principal_point_x_mm": "mm", "principal_point_y_mm": "mm"},
    "triline.CcdLine": {"x_mm": "mm", "y_mm": "mm", "chip_first_sample": ""},
    "triline.Camera": {},
    "triline.Project": {
        "origin_latitude": "deg", "origin_longitude": "deg", "origin_height": "m",
        "lever_arm_m": _with("m", ("forward", "right", "down")), "boresight_deg": _with("deg", _RPY),
        "image_sigma_px": "px", "offset_sigma_m": _with("m", _XYZ), "wander_sigma_m": _with("m", _XYZ),
        **{f"{name}_sigma_deg": _with("deg", ("omega", "phi", "kappa")) for name in ("shift", "drift", "wander")},
        "wander_time_s": "s", "attitude_wander_time_s": "s",
    },
    "triline.ImagePoint": {
        "line": "px", "sample": "px", "sigma_line": "px", "sigma_sample": "px", "time_ns": "ns",
    },
    "triline.TiePoint": {},
    "triline.GroundPoint": {**_POINT, "target_radius": "m"},
    "triline.TargetLook": {
        "score": "", "expected_line": "px", "expected_sample": "px", "reach": "px", "off": _with("m", _XYZ[:2]),
        "chi2": "",
    },
    "triline.Verdict": {"clock_s": "s"},
    "triline.Progress": {"time_ns": "ns"},
    "triline.RejectedObservation": {"line": "px", "sample": "px", "w": "", "off": "m"},
    "triline.ParameterEstimate": {"value": "", "sigma": "", "t": "", "correlation": ""},  # the field unit says it
    "triline.BiasedSource": {
        "line": "px", "sample": "px", "line_rate": "px_s", "sample_rate": "px_s", "test": "", "limit": "",
        "since_ns": "ns",
    },
    "triline.AdjustmentReport": {
        **dict.fromkeys(
            ("update", "sigma0", "redundancy", "observations", "unknowns", "iterations", "rays", "points", "control",
             "sigma0_total", "redundancy_total", "rejected_total", "returned_total", "kept_share", "left_out_total"),
            "",
        ),
        "window_start_ns": "ns", "window_end_ns": "ns", "data_latency_s": "s", "compute_s": "s",
        "protection": _EACH, "sigma": _EACH, "alert_limit_m": "m", "update_interval_s": "s",
        "ground_protection": ("X_m", "Y_m", "Z_m", "swath_ends_m"),
    },
    "triline.Pace": {"start_ns": "ns", "level": "", "interval_factor": "", "kept_share": "", "lag_s": "s"},
    "triline.RayResidual": {"line": "px", "sample": "px", "v_line": "px", "v_sample": "px", "w": ""},
    "triline.ObjectPoint": {**_POINT, "rays": ""},
    "triline.Counter": {"value": ""},
    "triline.TopicStatistics": {
        **dict.fromkeys(("received", "refused", "gaps", "duplicates", "late", "malformed", "dropped"), ""),
        "rate_hz": "hz",
    },
    "triline.NodeStatus": {"uptime_s": "s", "lag_s": "s", "queued": ""},
    "triline.GroundTile": {
        "column": "", "row": "", "size": "", "gsd_m": "m", "x": "m", "y": "m", "z": "m", "newest_time_ns": "ns",
    },
}  # fmt: skip


def columns_of(type_name: str, field: str, name: str) -> str | tuple[str, ...]:
    """The name of the column of a number field, or of the columns of a vector.

    Parameters
    ----------
    type_name, field : key of `UNITS`
    name : what the column is called without its unit

    Raises
    ------
    KeyError : a field whose unit is not stated
    """
    unit = UNITS[type_name][field]
    if isinstance(unit, str):
        return name if not unit or name.endswith(f"_{unit}") else f"{name}_{unit}"
    end = "_" + unit[0].rpartition("_")[2]  # lever_arm_m has its unit behind the axis
    return tuple(f"{name.removesuffix(end)}_{each}" for each in unit)
