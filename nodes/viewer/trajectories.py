"""Trajectories in 3D, their ellipsoids, and where the camera looks now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from ..convert import SECOND_NS, PoseSample
from .canvas import Canvas
from .scene_part import FILTERED, FINAL, LIVE, TRUTH, Part, Pieces, ccd_color
from .scene_state import SceneState

Array = NDArray[np.floating]

_STYLE = {  # topic -> entity, colour, radius, label
    "trajectory": ("flight/trajectory", FILTERED, 1.6, "trajectory"),
    "orientation/live": ("flight/live", LIVE, 1.6, "live"),
    "orientation/final": ("flight/final", FINAL, 2.4, "final"),
    "truth/trajectory": ("flight/truth", TRUTH, 0.9, "truth"),
}
_STEP_NS = int(0.2 * SECOND_NS)
LARGEST_GAP_NS = 2 * SECOND_NS  # deviations are not joined over turns
_ELLIPSOID_STEP_NS = 2 * SECOND_NS
_SIGMAS = 3.0


class FlightPart(Part):
    """Flown trajectories: the filtered one as it is, the others by their exaggerated deviation from it."""

    def __init__(self, state: SceneState) -> None:
        super().__init__(state)
        self._forget()

    def _forget(self) -> None:
        self._lines = {topic: Pieces(style[0], 150, joined=True) for topic, style in _STYLE.items()}
        self._last: dict[str, tuple[int, str]] = {}
        self._head: dict[str, Array] = {}
        self._ellipsoids = Pieces("flight/sigma", 50)
        self._last_ellipsoid = 0

    def pose(self, topic: str, sample: PoseSample) -> None:
        if topic not in _STYLE:
            return
        last, strip = self._last.get(topic, (0, sample.strip))
        if sample.time_ns - last < _STEP_NS:
            return
        if topic == "truth/trajectory" and not self.state.on_strip(sample.time_ns):
            return
        gone = topic != "trajectory" and sample.time_ns - last > LARGEST_GAP_NS
        if gone or sample.strip != strip:
            self._lines[topic].cut()
        if self._add(topic, sample) and topic == "orientation/final":
            self._add_ellipsoid(sample)
        self._last[topic] = sample.time_ns, sample.strip

    def _place(self, topic: str, sample: PoseSample) -> Array | None:
        """Display position: the filtered place plus the exaggerated deviation from it."""
        if topic == "trajectory":
            return self.state.display(sample.position_l)
        if sample.correction is not None:
            base = sample.position_l - sample.correction[:3]
        else:
            found = self.state.trajectory.at(sample.time_ns)
            if found is None:
                return None
            base = found[0]
        return self.state.display(base + self.state.exaggeration * (sample.position_l - base))

    def _add(self, topic: str, sample: PoseSample) -> bool:
        place = self._place(topic, sample)
        if place is None:
            return False
        self._lines[topic].add(place)
        self._head[topic] = place
        return True

    def _add_ellipsoid(self, sample: PoseSample) -> None:
        if sample.covariance is None or sample.time_ns - self._last_ellipsoid < _ELLIPSOID_STEP_NS:
            return
        self._last_ellipsoid = sample.time_ns
        half_axes, quaternion = ellipsoid(sample.covariance[:3, :3], _SIGMAS * self.state.exaggeration)
        self._ellipsoids.add((self._head["orientation/final"], half_axes, quaternion))

    def begin_again(self, canvas: Canvas) -> None:
        canvas.clear("flight")
        self._forget()

    def draw(self, canvas: Canvas) -> None:
        for topic, (_, color, radius, _) in _STYLE.items():

            def line(entity: str, rows: list[Array], color=color, radius=radius) -> None:
                if len(rows) > 1:
                    canvas.lines(entity, [np.array(rows)], [color], radius)

            self._lines[topic].draw(line)

        def bodies(entity: str, rows: list[tuple[Array, Array, Array]]) -> None:
            centres, half_axes, quaternions = (np.array(column) for column in zip(*rows, strict=True))
            canvas.ellipsoids(entity, centres, half_axes, quaternions, FINAL)

        self._ellipsoids.draw(bodies)
        for topic, place in self._head.items():
            _, color, _, label = _STYLE[topic]
            canvas.points(f"flight/heads/{label}", place[None], [color], 4.0)
        self._draw_looks(canvas)

    def _draw_looks(self, canvas: Canvas) -> None:
        """The ground that each CCD line images now, with the rays to its ends."""
        pose, camera = self.state.newest, self.state.camera
        if pose is None or camera is None or self._head.get("trajectory") is None:
            return
        R = matrix_from_quaternion(pose.quaternion)
        fans, colors, names = [], [], []
        for k, line in enumerate(camera.lines):
            ends = line.xy_mm[[0, -1]] - camera.principal_point_mm[k]
            rays = np.column_stack([ends, np.full(2, -camera.focal_length_mm[k])]) @ R.T
            if (rays[:, 2] >= 0).any():
                continue
            reach = (self.state.ground_m - pose.position_l[2]) / rays[:, 2]
            ground = pose.position_l + reach[:, None] * rays
            fan = np.array([pose.position_l, ground[0], ground[1], pose.position_l])
            fans.append(self.state.display(fan))
            colors.append(ccd_color(k))
            names.append(line.id)
        canvas.lines("flight/looks", fans, colors, 0.8, names)


def ellipsoid(covariance: Array, scale: float) -> tuple[Array, Array]:
    """Half axes (3,) and orientation (quaternion xyzw) of the error ellipsoid of a (3, 3) covariance, times a scale."""
    values, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return scale * np.sqrt(np.clip(values, 0.0, None)), quaternion_from_matrix(axes)
