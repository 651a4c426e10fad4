"""One good message for every row of the topic table."""

from __future__ import annotations

from typing import Any

import numpy as np

from triline.nodes import convert
from triline.nodes.node import Message
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.schemas.topics import TOPICS

EPOCH_NS = 1_790_000_000_000_000_000
IDENTITY3, IDENTITY6 = np.eye(3).ravel().tolist(), np.eye(6).ravel().tolist()


def line_block(i: int = 0, *, width: int = 64, height: int = 4, ccd: str = "F") -> LineBlock:
    pixels = np.random.default_rng(i).integers(0, 4096, (height, width), dtype=np.uint16)
    return LineBlock(pixels, ccd, "S1", i * height, EPOCH_NS + i * 40_000_000, 1_250_000)


def _report(i: int, time_ns: int) -> Any:
    report = m.AdjustmentReport(update=i, sigma0=1.01, redundancy=30, strip="S1", window_end_ns=time_ns)
    report.rejected.add(point="T1", strip="S1", ccd="F", line=10.5, sample=3.25, w=7.5, reason="snooping")
    report.parameters.add(name="dX", unit="m", value=1.5, sigma=0.1, t=15.0, status="estimated")
    return report


def _point() -> Any:
    point = m.ObjectPoint(point="T1", x=1.0, y=2.0, z=3.0, covariance=IDENTITY3, rays=3, role="tie")
    point.residuals.add(strip="S1", ccd="F", line=10.5, sample=3.25, v_line=0.25, v_sample=-0.5)
    return point


def _camera() -> Any:
    camera = m.Camera(name="test")
    camera.lenses.add(id="L", focal_length_mm=62.7)
    camera.lines.add(id="F", lens="L", x_mm=[14.0, 14.0], y_mm=[-30.0, 30.0])
    return camera


def _log(time_ns: int) -> Any:
    log = m.Log(level=m.Log.Level.Value("INFO"), message="strip S1 begins", name="adjuster")
    convert.set_time(log.timestamp, time_ns)
    return log


def body(topic: str, i: int = 0) -> Any:
    """A body of a topic of the table (wildcards filled in), number ``i``."""
    time_ns = EPOCH_NS + i * 5_000_000
    if topic.startswith("sensor/lines/"):
        return line_block(i)
    if topic.startswith("status/"):
        status = m.NodeStatus(node="navigator", state="running", uptime_s=1.5 + i, lag_s=0.1, queued=3)
        status.topics.add(topic="sensor/gnss", received=10, gaps=1, rate_hz=5.0)
        return status
    tie = {"strip": "S1", "ccd": "F", "line": 10.5 + i, "sample": 3.25, "time_ns": time_ns}
    tile: dict[str, Any] = {
        "size": 2,
        "gsd_m": 0.5,
        "encoding": "mono8",
        "data": b"\0\1\2\3",
        "newest_time_ns": time_ns,
    }

    def pose() -> Any:
        more = dict(covariance=IDENTITY6, correction=np.full(6, 0.25), velocity_l=(60.0, 1.0, 0.0), strip="S1")
        return convert.pose_message(time_ns, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), **more)

    def ground() -> Any:
        return convert.ground_point_message(f"G{i}", (1.0, 2.0, 3.0), IDENTITY3, "control")

    # only the one that is asked for is made
    return {
        "configuration/project": lambda: m.Project(
            name="test", crs="local", origin_latitude=48.9, lever_arm_m=[0.1, 0.2, 0.3]
        ),
        "configuration/camera": _camera,
        "configuration/strip": lambda: m.Strip(id="S1", first_line_time_ns=time_ns, line_rate_hz=800.0, lines=1000),
        "sensor/imu": lambda: m.Imu(time_ns=time_ns, interval_ns=5_000_000, force_z=-9.81, rate_x=0.01),
        "sensor/attitude": lambda: convert.attitude_message(time_ns, (0.1, 0.2, 0.3), (1e-4, 1e-4, 2e-4)),
        "sensor/gnss": lambda: convert.gnss_message(time_ns, (48.9, 8.9, 2000.0), (0.1, 0.1, 0.2), (60.0, 0.0, 0.0)),
        "trajectory/filtered": pose,
        "trajectory/smoothed": pose,
        "observation/control": ground,
        "observation/verdict": lambda: m.Verdict(point=f"G{i}", accepted=True, by="test"),
        "observation/target": lambda: m.TargetLook(
            point=f"G{i}",
            image=m.ImagePoint(**tie),
            state=m.TargetLook.State.Value("HELD"),
            reason="imprecise",
            score=0.99,
            expected_line=11.0,
            expected_sample=3.5,
            reach=6.0,
            off=[0.1, -0.2],
            chi2=3.0,
        ),
        "observation/progress": lambda: m.Progress(time_ns=time_ns),
        "observation/tie": lambda: convert.tie_message(f"T{i}", [tie]),
        "orientation/live": pose,
        "orientation/whole": pose,
        "orientation/final": pose,
        "point/object": _point,
        "adjustment/report": lambda: _report(i, time_ns),
        "orthoimage/live": lambda: m.GroundTile(**tile),
        "orthoimage/final": lambda: m.GroundTile(row=-3, **tile),
        "adjustment/pace": lambda: m.Pace(start_ns=time_ns, level=3, interval_factor=5, kept_share=0.5, lag_s=2.5),
        "matching/pace": lambda: m.Pace(start_ns=time_ns, level=2, interval_factor=1, kept_share=0.5, lag_s=0.5),
        "truth/trajectory": lambda: convert.pose_message(time_ns, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)),
        "truth/point": ground,
        "truth/world": lambda: _log(time_ns),
        "event/log": lambda: _log(time_ns),
    }[topic]()


def names() -> list[str]:
    """A topic for each row of the table."""
    filled = {"sensor/lines/*": "sensor/lines/F", "status/*": "status/navigator"}
    return [filled.get(row.name, row.name) for row in TOPICS]


def message(topic: str, i: int = 0, source: str = "test") -> Message:
    return Message(topic, EPOCH_NS + i * 5_000_000, body(topic, i), source)


def flight(seconds: float = 2.0, lines: bool = False) -> list[Message]:
    """Configuration, 200 Hz attitude, 5 Hz GNSS, ties and (on request) image lines, in the order of their stamps."""
    out = [message("configuration/project"), message("configuration/camera"), message("configuration/strip")]
    out += [message("observation/control") for _ in range(3)]
    for i in range(round(seconds * 200)):
        out.append(message("sensor/attitude", i))
        if i % 40 == 0:
            out.append(message("sensor/gnss", i))
        if lines and i % 8 == 0:
            out.append(message("sensor/lines/F", i))
        if i % 4 == 0:
            out.append(message("observation/tie", i))
    return out
