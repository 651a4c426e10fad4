"""Tie points in image lines of two lenses from orbit, whose looks at a place lie 93 s and 700 km apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from triline.nodes import convert
from triline.nodes.matcher.matcher import Matcher
from triline.nodes.node import Message
from triline.schemas import messages as m
from triline.schemas.image_lines import LineBlock
from triline.solver.camera.line_camera import CcdLine, Lens, LineCamera
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import R_BC_NOMINAL, angles_from_matrix, matrix_from_quaternion
from triline.solver.location.local_poses import local_poses
from triline.solver.location.pushbroom import PushbroomSensor
from triline.solver.matching.round_earth import above_sphere, way_of_platform
from triline.solver.orbit.line_times import UniformLineTimes
from triline.solver.orbit.motion import Motion
from triline.solver.scene_adjustment.rigorous import LensView
from triline.solver.simulation.orbital_imagery import render, texture_of
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

#: Half the flight, s; the lenses see the same ground 93 s apart.
HALF_S = 58.0
SECOND = 1_000_000_000
EPOCH = 1_150_000_000 * SECOND
FOCAL_MM = 580.0


def ns(time_s):
    return EPOCH + round((time_s + HALF_S) * SECOND)


def flight():
    """Messages of one strip with both lenses in one image frame, and the sensors."""
    made = ORBITAL_SENSORS["spot5-hrs-small"]
    scene = overpass(made, 36.0, 139.6, light_time=False, aberration=False)
    span = {"start_s": -2 * HALF_S, "end_s": 2 * HALF_S}
    motion = Motion(replace(scene.motion.orbit, **span), replace(scene.motion.attitude, **span), attitude_frame="o")
    lines = int(2 * HALF_S / made.period_s)
    frame, view = LocalFrame(36.0, 139.6, 0.0, "EPSG:4979"), LensView(R_BC_NOMINAL, FOCAL_MM)
    times = np.arange(-HALF_S - 0.5, HALF_S + 0.5, 0.1)
    sensors, poses = {}, {}
    for id, sensor in scene.sensors.items():
        sensors[id] = PushbroomSensor(motion, UniformLineTimes(-HALF_S, made.period_s, lines), sensor.look, name=id)
        poses[id] = local_poses(sensors[id], frame, view.image_coordinates, view.R_bc, FOCAL_MM, times, 0.0)
    ccds = tuple(CcdLine(id, "L", found.xy_mm) for id, found in poses.items())
    camera = LineCamera("both", (Lens("L", FOCAL_MM),), ccds)
    project = m.Project(name="orbit", crs="EPSG:4979", origin_latitude=36.0, origin_longitude=139.6)
    strip = m.Strip(id="S", first_line_time_ns=ns(-HALF_S), line_rate_hz=1 / made.period_s, lines=lines)
    first = [
        Message("configuration/project", EPOCH - SECOND, project, "test"),
        Message("configuration/camera", EPOCH - SECOND, convert.camera_message(camera), "test"),
        Message("configuration/strip", EPOCH - SECOND, strip, "test"),
    ]
    covariance = np.diag([5.0] * 3 + [np.radians(0.002)] * 3) ** 2
    trajectory = poses["F"].trajectory
    angles = angles_from_matrix(matrix_from_quaternion(trajectory.quaternion))
    rest = []
    for t, position, angle, q in zip(times, trajectory.position_l, angles, trajectory.quaternion, strict=True):
        body = convert.pose_message(ns(t), position, angle, covariance, quaternion=q)
        rest.append(Message("trajectory/smoothed", ns(t), body, "test"))
    texture = texture_of(scene.sensors["F"], 3)
    for id, sensor in sensors.items():
        pixels = render(sensor, frame, texture, 0.0, np.random.default_rng(3))
        for begin in range(0, lines, 25):
            part, time_s = pixels[begin : begin + 25], -HALF_S + begin * made.period_s
            block = LineBlock(part, id, "S", begin, ns(time_s), round(made.period_s * SECOND))
            rest.append(Message(f"sensor/lines/{id}", ns(time_s + (len(part) - 1) * made.period_s), block, "test"))
    return first + sorted(rest, key=lambda message: (message.stamp_ns, message.topic)), sensors


def test_ties_between_lenses_far_apart():
    """About 60 on two kinds of processor, 12 to 90 over five textures: it depends on when the ground is found."""
    messages, sensors = flight()
    node = Matcher()
    out = [found for message in messages for found in node.step(message)]
    ties = [{i.ccd: i for i in o.body.images} for o in [*out, *node.finish()] if o.topic == "observation/tie"]
    ties = [tie for tie in ties if len(tie) == 2]
    assert len(ties) > 40
    forward = np.array([(tie["F"].line, tie["F"].sample) for tie in ties])
    backward = np.array([(tie["B"].line, tie["B"].sample) for tie in ties])
    error = sensors["B"].ground_to_pixel(sensors["F"].ground(*forward.T, 0.0)) - backward
    assert (np.median(np.abs(error), axis=0) < 0.05).all()
    assert np.mean(np.abs(error).max(axis=1) < 0.3) > 0.95


def test_way_to_what_is_seen():
    """Against the sphere itself: from above the point, back along the orbit, it is seen in that direction."""
    height, forward = 832_000.0, np.tan(np.radians(20.0))
    way = way_of_platform(forward, height)
    radius = 6_371_000.0 + height
    x, z = -radius * np.sin(way / radius), radius * np.cos(way / radius)
    nadir, towards = np.array([-x, -z]), np.array([-x, 6_371_000.0 - z])
    angle = np.arccos(nadir @ towards / np.linalg.norm(nadir) / np.linalg.norm(towards))
    np.testing.assert_allclose(angle, np.radians(20.0), rtol=1e-9)
    assert way_of_platform(-forward, height) == -way
    np.testing.assert_allclose(above_sphere([x, 0.0, z - 6_371_000.0]), height, rtol=1e-12)
    # as flat as it looks from an aircraft
    np.testing.assert_allclose(way_of_platform(forward, 2000.0), 2000.0 * forward, rtol=5e-4)
