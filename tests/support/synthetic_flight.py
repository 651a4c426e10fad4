"""A plausible flight as messages, made from arrays with known errors, for tests of what reads recordings."""

from __future__ import annotations

import numpy as np

from triline.nodes import convert
from triline.nodes.node import Message
from triline.schemas import messages as m
from triline.schemas.topics import rank
from triline.solver.camera.collinearity import image_motion, project
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import LocalFrame, navigation_from_R_lc
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory

START_NS = 1_700_000_000 * convert.SECOND_NS
FRAME = LocalFrame(47.0, 8.0, 0.0)
RATE_HZ = 800.0
POSE_HZ = 40
GROUND_M, HEIGHT_M, SPEED = 420.0, 1920.0, 70.0
HEADING = np.radians(65.0)  # of the strip against east, counter-clockwise
FILTERED_SIGMA = np.array([0.9, 0.7, 1.2, 1.0e-4, 1.0e-4, 2.0e-4])
LIVE_SIGMA = np.array([0.25, 0.25, 0.3, 5e-5, 5e-5, 6e-5])
FINAL_SIGMA = np.array([0.08, 0.08, 0.1, 2e-5, 2e-5, 3e-5])


def _wave(t, seed, scale, periods=(17.0, 31.0, 47.0)):
    """Smooth errors (n, 6), 1 sigma = scale."""
    rng = np.random.default_rng(seed)
    out = np.zeros((len(t), 6))
    for period in periods:
        out += np.sqrt(2 / len(periods)) * np.sin(2 * np.pi * t[:, None] / period + rng.uniform(0, 2 * np.pi, 6))
    return out * scale


def _truth(t):
    """Position and angles (n, 3) of the true flight."""
    along = SPEED * t
    x, y = along * np.cos(HEADING), along * np.sin(HEADING)
    position = np.stack([x + 3 * np.sin(t / 6), y + 2 * np.sin(t / 9), HEIGHT_M + 4 * np.sin(t / 8)], axis=1)
    angles = np.stack([0.01 * np.sin(t / 1.7), 0.012 * np.sin(t / 2.3 + 1), HEADING + 0.02 * np.sin(t / 3.1)], axis=1)
    return position, angles


def flight_messages(seconds: float = 30.0, points: int = 120, seed: int = 5, truth: bool = True) -> list[Message]:
    """Messages of one strip in order of their stamps, numbered per topic."""
    rng = np.random.default_rng(seed)
    camera = preset("ads40")
    out: list[Message] = []

    def add(topic, t, body, source="test"):
        out.append(Message(topic, START_NS + round(t * 1e9), body, source))

    project_message = m.Project(
        name="synthetic", crs="local", origin_latitude=FRAME.lat_deg, origin_longitude=FRAME.lon_deg,
        origin_height=FRAME.height_m, lever_arm_m=[0.4, 0.1, -1.2], image_sigma_px=0.3, wander_time_s=30.0,
    )  # fmt: skip
    strip = m.Strip(
        id="S1", first_line_time_ns=START_NS + 2 * convert.SECOND_NS, line_rate_hz=RATE_HZ,
        lines=int((seconds - 4) * RATE_HZ),
    )  # fmt: skip
    add("configuration/project", 0.0, project_message)
    add("configuration/camera", 0.0, convert.camera_message(camera))
    add("configuration/strip", 0.0, strip)
    add("event/log", 0.0, _log(0.0, m.Log.INFO, "flight begins", "simulator"))

    fast = np.arange(0, round(seconds * POSE_HZ) + 1) / POSE_HZ
    position, angles = _truth(fast)
    path = Trajectory(fast, position, quaternion_from_matrix(matrix_from_angles(*angles.T)))
    wander = _wave(fast, seed + 1, FILTERED_SIGMA)
    _poses(add, "trajectory/filtered", fast, position, angles, wander, FILTERED_SIGMA)
    slow = fast[::2]
    strip_time = slow[(slow >= 2.0) & (slow <= seconds - 2.0)]
    p, a = _truth(strip_time)
    measured = _wave(strip_time, seed + 1, FILTERED_SIGMA)
    for topic, sigma, delay, place in (("live", LIVE_SIGMA, 0.5, 2), ("final", FINAL_SIGMA, 8.0, 3)):
        error = _wave(strip_time, seed + place, sigma, (5.0, 9.0, 13.0))
        _poses(add, f"orientation/{topic}", strip_time, p, a, error, sigma, delay, error - measured, "S1")
    if truth:
        _poses(add, "truth/trajectory", slow, *_truth(slow), np.zeros((len(slow), 6)), None)
    _sensors(add, rng, fast, position, angles)
    _points(add, rng, camera, path, seconds, points, truth)
    _reports(add, rng, seconds, out)
    add("event/log", seconds / 2, _log(seconds / 2, m.Log.WARNING, "GNSS outage of 1.4 s, coasting", "navigator"))
    status = m.NodeStatus(node="adjuster", state="running", uptime_s=seconds, lag_s=0.02)
    status.counters.append(m.Counter(name="rejected", value=3))
    status.topics.append(m.TopicStatistics(topic="observation/tie", received=points))
    add("status/adjuster", seconds, status)

    out.sort(key=lambda message: (message.stamp_ns, rank(message.topic)))
    numbers: dict[str, int] = {}
    numbered = []
    for message in out:
        n = numbers.get(message.topic, 0)
        numbers[message.topic] = n + 1
        numbered.append(Message(message.topic, message.stamp_ns, message.body, message.source, n))
    return numbered


def _log(t, level, text, name):
    log = m.Log(level=level, message=text, name=name)
    convert.set_time(log.timestamp, START_NS + round(t * 1e9))
    return log


def _poses(add, topic, t, position, angles, error, sigma, delay=0.0, correction=None, strip=""):
    covariance = None if sigma is None else np.diag(np.square(sigma))
    q = quaternion_from_matrix(matrix_from_angles(*(angles + error[:, 3:]).T))
    for i in range(len(t)):
        body = convert.pose_message(
            START_NS + round(t[i] * 1e9), position[i] + error[i, :3], angles[i] + error[i, 3:], covariance,
            quaternion=q[i], strip=strip, correction=None if correction is None else correction[i],
        )  # fmt: skip
        add(topic, t[i] + delay, body)


def _sensors(add, rng, t, position, angles):
    R = matrix_from_angles(*angles.T)
    rpy = navigation_from_R_lc(FRAME, position, R)
    for i in range(0, len(t), 2):
        noisy = rpy[i] + rng.normal(0, 1.5e-4, 3)
        add("sensor/attitude", t[i], convert.attitude_message(START_NS + round(t[i] * 1e9), noisy, [1.5e-4] * 3))
    lever_c = np.diag([1.0, -1.0, -1.0]) @ np.array([0.4, 0.1, -1.2])
    antenna = position + R @ lever_c
    for i in range(0, len(t), 8):
        fix = FRAME.to_geodetic(antenna[i] + rng.normal(0, 0.5, 3))
        add("sensor/gnss", t[i], convert.gnss_message(START_NS + round(t[i] * 1e9), fix, [0.5, 0.5, 0.5]))


def _points(add, rng, camera, path, seconds, points, truth):
    """Ground points seen by all three lines, their image points with 0.3 px, and adjusted coordinates."""
    middle = rng.uniform(2 + 11, max(13.5, seconds - 2 - 7), points)
    side = rng.uniform(-750, 750, points)
    direction, left = np.array([np.cos(HEADING), np.sin(HEADING)]), np.array([-np.sin(HEADING), np.cos(HEADING)])
    ground = np.empty((points, 3))
    ground[:, :2] = (SPEED * middle)[:, None] * direction + side[:, None] * left
    ground[:, 2] = GROUND_M + 30 * np.sin(ground[:, 0] / 400)
    lines, samples, seen = {}, {}, np.ones(points, dtype=bool)
    for k, line in enumerate(camera.lines):
        t, sample = _image_time(camera, k, path, ground, middle)
        lines[line.id], samples[line.id] = (t - 2.0) * RATE_HZ, sample
        seen &= (t > 2.05) & (t < seconds - 2.05) & line.contains(sample)
    for i in np.flatnonzero(seen):
        name = f"P{i:04d}"
        role = {0: "control", 20: "check", 40: "check"}.get(int(i) % 60, "tie")
        last = max(lines[c][i] for c in lines) / RATE_HZ + 2.0
        images, residuals = [], []
        for ccd in lines:
            v = rng.normal(0, 0.3, 2)
            rejected = i % 37 == 7 and ccd == "N"
            if rejected:
                v += (12.0, -9.0)
            u, s = lines[ccd][i] + v[0], samples[ccd][i] + v[1]
            images.append({"strip": "S1", "ccd": ccd, "line": u, "sample": s, "sigma_line": 0.3, "sigma_sample": 0.3})
            residual = m.RayResidual(
                strip="S1", ccd=ccd, line=u, sample=s, v_line=v[0], v_sample=v[1], w=float(np.abs(v).max() / 0.28),
                rejected=rejected,
            )  # fmt: skip
            residuals.append(residual)
        add("observation/tie", last, convert.tie_message(name, images))
        sigma = np.array([0.05, 0.05, 0.12])
        for status, scale, delay in ((0, 2.5, 0.5), (1, 1.0, 8.0)):
            x, y, z = ground[i] + rng.normal(0, sigma * scale)
            body = m.ObjectPoint(
                point=name, x=x, y=y, z=z, covariance=np.diag((scale * sigma) ** 2).ravel(), rays=3, role=role,
                status=status, residuals=residuals,
            )  # fmt: skip
            add("point/object", last + delay, body)
        if role != "tie":
            given = ground[i] + rng.normal(0, 0.03, 3)
            add("observation/control", 0.0, convert.ground_point_message(name, given, np.eye(3) * 0.03**2, role))
        if truth:
            add("truth/point", 0.0, convert.ground_point_message(name, ground[i], np.zeros((3, 3)), "check"))


def _image_time(camera, k, path, ground, t):
    """When a CCD line images points, and at which sample: Newton on the image coordinate along flight."""
    x_line = camera.lines[k].xy_mm[0, 0]
    focal = np.full(len(t), camera.focal_length_mm[k])
    t = t - np.tan(np.arctan(x_line / focal)) * (HEIGHT_M - GROUND_M) / SPEED
    for _ in range(8):
        pose = path.at(np.clip(t, path.start_s, path.end_s))
        image = project(pose.position_l, pose.angles, ground, focal)
        motion = image_motion(image.d_orientation, pose.velocity_l, pose.angle_rate)
        t = t + (x_line - image.xy_mm[:, 0]) / motion[:, 0]
    y = camera.lines[k].xy_mm[:, 1]
    return t, (image.xy_mm[:, 1] - y[0]) / (y[1] - y[0])


def _reports(add, rng, seconds, out):
    """Five reports a second; the observations that the points' final residuals mark are named in the next one."""
    waiting = [
        (message.stamp_ns, message.body.point, r)
        for message in out
        if message.topic == "point/object" and message.body.status == 0
        for r in message.body.residuals
        if r.rejected
    ]
    names = (("dX", "m", 0.8), ("dY", "m", -0.6), ("dZ", "m", 1.1), ("domega", "rad", 9e-5), ("dphi", "rad", -6e-5))
    rejected_total = 0
    for update, t in enumerate(np.arange(5.0, seconds, 0.2)):
        body = m.AdjustmentReport(
            update=update, sigma0=1 + 0.04 * rng.normal(), redundancy=900, observations=1500, unknowns=600,
            iterations=2,
            window_start_ns=START_NS + round((t - 8) * 1e9), window_end_ns=START_NS + round((t - 0.1) * 1e9), rays=300,
            points=100, control=5, data_latency_s=0.1 + 0.02 * rng.random(), compute_s=0.03 + 0.01 * rng.random(),
            sigma0_total=1.003, redundancy_total=40 * (update + 1), rejected_total=rejected_total, strip="S1",
        )  # fmt: skip
        now = START_NS + round(t * 1e9)
        for _stamp, point, r in [w for w in waiting if w[0] <= now]:
            waiting = [w for w in waiting if w[2] is not r]
            rejected_total += 1
            named = {"point": point, "strip": "S1", "ccd": r.ccd, "line": r.line, "sample": r.sample, "w": r.w}
            body.rejected.append(m.RejectedObservation(**named, reason="snooping"))
        body.rejected_total = rejected_total
        for name, unit, value in names:
            sigma = abs(value) * 0.1 * (1 + 5 / t)
            row = m.ParameterEstimate(name=name, unit=unit, value=value, sigma=sigma, t=value / sigma)
            row.status = "estimated"
            body.parameters.append(row)
        add("adjustment/report", t, body)


def spoilt_copy(body, rng):
    """A copy with some of its numbers not finite."""
    copy = type(body)()
    copy.CopyFrom(body)
    for field, value in copy.ListFields():
        if field.cpp_type == field.CPPTYPE_DOUBLE and rng.random() < 0.3:
            bad = float(rng.choice([np.nan, np.inf, -np.inf]))
            if isinstance(value, float):
                setattr(copy, field.name, bad)
            else:
                value[int(rng.integers(len(value)))] = bad
        elif field.cpp_type == field.CPPTYPE_MESSAGE and not hasattr(value, "DESCRIPTOR"):
            for i in range(len(value)):
                value[i].CopyFrom(spoilt_copy(value[i], rng))
    return copy
