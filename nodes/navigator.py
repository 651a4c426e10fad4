"""The navigator: sensors in, measured trajectory of the camera out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..schemas import messages as m
from ..solver.frames import LocalFrame
from ..solver.kinematic import KinematicFilter, KinematicOptions
from ..solver.navigation_pose import NavigationEngine, NavigationPose
from ..solver.rotation import R_ENU_NED
from ..solver.slow_errors import SlowErrors
from . import convert
from .node import Message, Node


def slow_errors_of(project: Any) -> SlowErrors:
    """A-priori slow errors of a Project message; what is absent is zero.

    Raises
    ------
    ValueError : naming the value that cannot be
    """

    def three(values: Any, factor: float = 1.0) -> tuple[float, float, float]:
        if not values:
            return (0.0, 0.0, 0.0)
        a, b, c = (float(v) * factor for v in values)
        return (a, b, c)

    to_rad = float(np.radians(1.0))
    return SlowErrors(
        three(project.offset_sigma_m),
        three(project.shift_sigma_deg, to_rad),
        three(project.drift_sigma_deg, to_rad),
        three(project.wander_sigma_m),
        three(project.wander_sigma_deg, to_rad),
        project.wander_time_s or SlowErrors.wander_time_s,
    )


def kinematic_engine(project: Any) -> NavigationEngine:
    """The engine for attitude and GNSS input."""
    slow = slow_errors_of(project)
    options = KinematicOptions(
        lever_arm_b=convert.lever_arm_of(project),
        R_bc=convert.R_bc_of(project),
        offset_sigma_m=np.array(slow.offset_m),
        wander_sigma_m=np.array(slow.wander_m),
        wander_time_s=slow.wander_time_s,
        attitude_sigma=slow.attitude_sigma,
    )
    return KinematicFilter(convert.local_frame(project), options)


class Navigator(Node):
    """Runs a navigation engine.

    The engine is made when the project is known; another engine (inertial) takes its place by its own factory here.
    Poses carry the stamp of the message that made them possible; the time they are valid for stands in the body.
    """

    name = "navigator"
    inputs = ("configuration/project", "sensor/attitude", "sensor/gnss")
    outputs = ("trajectory/filtered", "trajectory/smoothed", "event/log")

    def __init__(self) -> None:
        super().__init__()
        self._engine: NavigationEngine | None = None
        self._reference_ns = 0
        self._seen: Counter[str] = Counter()
        self._stamp_ns = 0
        self._project = b""
        self._frame = LocalFrame(0.0, 0.0, 0.0)
        self._covariance_key: tuple[float, ...] = ()
        self._covariance = np.zeros((3, 3))

    def step(self, message: Message) -> Iterable[Message]:
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        try:
            if message.topic == "sensor/attitude":
                poses = self._attitude(message.body)
            elif message.topic == "sensor/gnss":
                poses = self._gnss(message.body)
            else:
                return self._configure(message)
        except ValueError as error:
            self.problem("malformed", f"{message.topic}: {error}")
            return ()
        return self._messages(poses)

    def finish(self) -> Iterable[Message]:
        if self._engine is None:
            return ()
        return self._messages(self._engine.finish())

    def state(self) -> str:
        return "running" if self._engine is not None else "waiting for configuration/project"

    def _configure(self, message: Message) -> Iterable[Message]:
        content = message.body.SerializeToString(deterministic=True)
        if content == self._project:
            return ()
        try:
            self._engine = kinematic_engine(message.body)
        except ValueError as error:
            self.problem("bad configuration", f"{message.topic}: {error}")
            return (self._log(message.stamp_ns, f"configuration/project cannot be used: {error}", warning=True),)
        self._frame = convert.local_frame(message.body)
        self._seen = Counter()
        self._project = content
        self._reference_ns = message.stamp_ns
        return ()

    def _attitude(self, body: Any) -> list[NavigationPose]:
        if self._engine is None:
            self.problem("before configuration", "sensor/attitude came before configuration/project")
            return []
        rpy = (body.roll, body.pitch, body.heading)
        if not np.isfinite(rpy).all():
            raise ValueError("roll, pitch or heading is not finite")
        if max(abs(rpy[0]), abs(rpy[1])) > 2.0 or abs(rpy[2]) > 7.0:
            raise ValueError(f"roll, pitch, heading {rpy} are not radians of an aircraft")
        return self._engine.add_attitude(self._seconds(body.time_ns), rpy, self._attitude_covariance(body.covariance))

    def _attitude_covariance(self, values: Any) -> Any:
        """(3, 3); the array of the last message again if it had the same values, so that nothing is computed twice."""
        key = tuple(values)
        if key != self._covariance_key:
            if len(key) != 9 or not np.isfinite(key).all() or min(key[0], key[4], key[8]) <= 0:
                raise ValueError(f"attitude covariance {list(key)}, wanted 9 values with a positive diagonal")
            self._covariance_key, self._covariance = key, np.array(key).reshape(3, 3)
        return self._covariance

    def _gnss(self, body: Any) -> list[NavigationPose]:
        if self._engine is None:
            self.problem("before configuration", "sensor/gnss came before configuration/project")
            return []
        geodetic = np.array([body.latitude, body.longitude, body.altitude])
        if not np.isfinite(geodetic).all() or abs(geodetic[0]) > 90 or abs(geodetic[1]) > 360:
            raise ValueError(f"position {geodetic.tolist()} is no latitude, longitude, height")
        covariance = np.array(body.position_covariance)
        if covariance.shape != (9,) or not np.isfinite(covariance).all() or covariance[::4].min() <= 0:
            raise ValueError("position covariance: wanted 9 values with a positive diagonal")
        frame = self._frame
        antenna_l = frame.from_geodetic(*geodetic)
        R_l_enu = frame.R_ln(antenna_l) @ R_ENU_NED
        return self._engine.add_gnss(
            self._seconds(convert.time_ns(body.timestamp)), antenna_l, R_l_enu @ covariance.reshape(3, 3) @ R_l_enu.T
        )

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._reference_ns) * 1e-9

    def _messages(self, poses: list[NavigationPose]) -> list[Message]:
        out = [
            Message(
                "trajectory/smoothed" if p.smoothed else "trajectory/filtered",
                self._stamp_ns,
                convert.pose_message(
                    self._reference_ns + round(p.time_s * 1e9), p.position_l, p.angles, p.covariance,
                    quaternion=p.quaternion, valid=p.valid, reason=p.reason, velocity_l=p.velocity_l,
                ),
            )
            for p in poses
        ]  # fmt: skip
        assert self._engine is not None
        for kind, n in self._engine.counters.items():
            self.counters[kind] += n - self._seen[kind]
            self._seen[kind] = n
        for event in self._engine.take_events():
            out.append(self._log(self._reference_ns + round(event.time_s * 1e9), event.text))
        return out

    def _log(self, time_ns: int, text: str, warning: bool = False) -> Message:
        body = m.Log(name=self.name, message=text, level=3 if warning else 2)
        convert.set_time(body.timestamp, time_ns)
        return Message("event/log", self._stamp_ns, body)
