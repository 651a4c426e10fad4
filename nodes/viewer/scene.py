"""The scene of an on-line triangulation: messages in, drawing out. What it is drawn on is a `Canvas`.

The 3D view is in local coordinates minus a rounded origin near the control points. Orientations differ by metres over
kilometres, so deviations from the filtered trajectory, ellipsoids and residuals are exaggerated; the view's title says
by how much.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import convert
from ..convert import PoseSample
from ..node import Message
from ..truth_frames import TruthFrames
from .canvas import Canvas, ViewLayout
from .curves import PlotsPart
from .image_residuals import ImagePart
from .incoming_lines import LinesPart
from .map_view import MapPart
from .object_points import PointsPart
from .orthoimages import MosaicPart
from .scene_part import FILTERED, LEGEND
from .scene_state import SceneState
from .trajectories import FlightPart
from .window_progress import WindowPart

Array = NDArray[np.floating]

#: What the scene can show.
TOPICS: tuple[str, ...] = (
    "configuration/project",
    "configuration/camera",
    "configuration/strip",
    "sensor/gnss",
    "sensor/lines/*",
    "trajectory/filtered",
    "trajectory/smoothed",
    "observation/control",
    "observation/tie",
    "observation/target",
    "orientation/live",
    "orientation/final",
    "point/object",
    "adjustment/report",
    "orthoimage/live",
    "orthoimage/final",
    "event/log",
)
TRUTH_TOPICS: tuple[str, ...] = ("truth/trajectory",)
LINES = "sensor/lines/"
_SHOWN = frozenset(TOPICS + TRUTH_TOPICS)


def is_shown(topic: str) -> bool:
    """Whether a scene draws a topic."""
    return topic in _SHOWN or topic.startswith(LINES)


_HOLD_NS = convert.SECOND_NS // 2
_NO_NAVIGATOR_NS = 30 * convert.SECOND_NS


class Scene:
    """Takes messages one by one and draws what has changed when told to.

    Parameters
    ----------
    canvas : what is drawn on
    recorded : as in `SceneState`
    """

    def __init__(self, canvas: Canvas, recorded: bool = False) -> None:
        self.canvas = canvas
        self.state = SceneState()
        self.state.recorded = recorded
        self.parts = (
            FlightPart(self.state),
            PointsPart(self.state),
            ImagePart(self.state),
            LinesPart(self.state),
            PlotsPart(self.state),
            MapPart(self.state),
            MosaicPart(self.state),
            WindowPart(self.state),
        )
        self._laid_out: Any = None
        self._held: list[tuple[str, PoseSample]] = []
        self._released = False
        self._waiting_truth: deque[PoseSample] = deque(maxlen=20_000)
        self._truth_frames = TruthFrames()

    def take(self, message: Message) -> None:
        """Remember what a message says.

        Raises
        ------
        ValueError : a message without usable values
        """
        topic, body = message.topic, message.body
        if not is_shown(topic):
            return
        self._truth_frames.note(message)
        if self._truth_frames.is_elsewhere(message, self.state.project):
            return
        before = self.state.project
        self.state.note(message)
        if before is not None and not convert.same_frame(before, self.state.project):
            self._begin_again()
        if topic.startswith("configuration/"):
            return
        if topic.startswith(("trajectory/", "orientation/", "truth/")):
            self._take_pose(topic, convert.pose_sample(body))
            return
        for part in self.parts:
            part.take(message)

    def _begin_again(self) -> None:
        """Draw what comes from now on in the local frame of another project, and take away what is not in it."""
        self.state.begin_again()
        self._laid_out, self._released = None, False
        self._held.clear()
        self._waiting_truth.clear()
        self.canvas.at(self.state.now_s)
        for part in self.parts:
            part.begin_again(self.canvas)

    def _take_pose(self, topic: str, sample: PoseSample) -> None:
        """Hand a pose to the parts; truth waits for the filtered pose it is compared with.

        The first half second is held back: control points of the same stamp come after poses, and the display frame
        depends on them.
        """
        if not self._released:
            self._held.append((topic, sample))
            if sample.time_ns - self._held[0][1].time_ns < _HOLD_NS:
                return
            self._release()
            return
        if topic == "truth/trajectory" and self.state.measured == "truth":
            self._hand_out("trajectory", sample)
        elif topic == "truth/trajectory":
            self._waiting_truth.append(sample)
            if not self.state.measured and sample.time_ns - self._waiting_truth[0].time_ns > _NO_NAVIGATOR_NS:
                self._adopt_truth()
        elif topic.startswith("trajectory/"):
            name = topic.removeprefix("trajectory/")  # the first that comes is the one others are compared with
            self.state.measured = self.state.measured or name
            if name == self.state.measured:
                self._hand_out("trajectory", sample)
        else:
            self._hand_out(topic, sample)
        while self._waiting_truth and self._waiting_truth[0].time_ns <= self.state.trajectory.newest_ns:
            self._hand_out("truth/trajectory", self._waiting_truth.popleft())

    def _adopt_truth(self) -> None:
        """Draw the true trajectory as the flown one: a simulated recording that no navigator has seen."""
        self.state.measured = "truth"
        for sample in self._waiting_truth:
            self._hand_out("trajectory", sample)
        self._waiting_truth.clear()

    def _hand_out(self, topic: str, sample: PoseSample) -> None:
        self.state.note_pose(topic, sample)
        for part in self.parts:
            part.pose(topic, sample)

    def draw(self) -> None:
        """Draw what has changed since the last call."""
        if self.state.start_ns is None:
            return
        self.canvas.at(self.state.now_s)
        self._lay_out()
        for part in self.parts:
            part.draw(self.canvas)

    def _release(self) -> None:
        self._released = True
        for topic, sample in self._held:
            self._take_pose(topic, sample)
        self._held.clear()
        if self.state.closing and not self.state.measured and self._waiting_truth:
            self._adopt_truth()

    def close(self) -> None:
        """Draw the rest and close the canvas."""
        self.state.closing = True
        self._release()
        self.state.frame_flown()
        self.draw()
        self.canvas.close()

    def _lay_out(self) -> None:
        """Arrange the views when what they frame has changed: a strip (before the first, the trajectory), the camera,
        the first truth or parameter."""
        s = self.state
        has = s.has_truth, s.has_mosaic, s.has_lines
        adjusted = s.camera is not None or s.has_results
        key = (
            tuple(s.extent) or (None if s.framed is None else tuple(s.framed.ravel())),
            tuple(s.origin),
            s.camera is not None,
            adjusted,
            has,
            tuple(s.units),
            s.placed is not None,
            s.bar_px,
            s.window_s,
            s.strip_s,
            s.sigma0_span,
        )
        if key == self._laid_out or (not s.extent and s.framed is None):
            return
        self._laid_out = key
        corners = self._corners()
        centre = corners.mean(axis=0)
        along = self._along()
        measured = s.measured or "trajectory"
        middle = None
        if s.placed is not None:
            place = s.placed.to_geodetic(centre + s.origin)
            middle = float(place[0]), float(place[1])
        layout = ViewLayout(
            title=f"Deviations from {measured} and 3 sigma x {s.exaggeration:g}, residuals x {s.residual_scale:g}"
            if adjusted
            else f"Trajectory, {s.measured}"
            if s.measured
            else "No trajectory yet; fixes are on the map",
            grid_m=s.grid_m,
            corners=corners,
            along=along,
            ccds={ccd: f"Residuals {ccd}: samples to the right, lines up, bar = {s.bar_px:g} px" for ccd in s.ccds},
            image_size=s.image_size,
            units=tuple(s.units),
            strip_s=s.strip_s,
            sigma0=s.sigma0_span,
            window_s=s.window_s,
            adjusted=adjusted,
            truth=s.has_truth,
            mosaic=s.has_mosaic,
            lines=tuple(s.ccds) if s.has_lines else (),
            lines_size=s.lines_size,
            geographic_centre=middle,
        )
        self.canvas.layout(layout)
        self._legend(s.has_truth)
        east, north, up = s.origin
        self.canvas.document(
            "about",
            f"Display origin: E {east:.0f} m, N {north:.0f} m, U {up:.0f} m in the local frame of "
            f"*{s.project.name if s.project is not None else 'no project'}*.\n\n"
            f"Live, final and true trajectory: deviation from the {measured} one x {s.exaggeration:g}; ellipsoids: "
            f"3 sigma of the final one x {s.exaggeration:g}.\n\n"
            f"Residuals x {s.residual_scale:g}: thin arrows are those of single rays laid on the ground, in the "
            "colour of their CCD line; they fade when the point is final. Thick arrows at control and check points "
            "are adjusted minus given coordinates.\n\n"
            "Image lines, newest on top: dots of one colour in the three views are the looks at one tie point; red are "
            "control points, blue check points, magenta targets that are held (with the reason) and rejected rays.\n\n"
            "Outlines on the ground: the part of the strip in the *live* window; the *marginal* part before it is "
            "final and kept as a prior on what follows; the *whole* strip has been through the backward pass.\n\n"
            "Correction functions: green and final, with three sigma, until the window begins; orange, with its own "
            "three sigma, what was said at once of the time that the window holds; thin, what was said at once of "
            "earlier times.\n\n"
            "Protection level: with a risk of 0.001 the orientation is not further off, even if one gross error that "
            "the tests do not find is among the observations. The overview draws none beyond ten alert limits.",
        )

    def _along(self) -> Array:
        """Direction of the first strip, or the longer side of what has been flown (3,)."""
        s = self.state
        if s.extent or s.framed is None:
            first = next(iter(s.extent.values()))
            return (first[1] - first[0]) / max(float(np.linalg.norm(first[1] - first[0])), 1.0)
        east, north = (s.framed[1] - s.framed[0])[:2]
        return np.array([1.0, 0.0, 0.0] if east >= north else [0.0, 1.0, 0.0])

    def _corners(self) -> Array:
        """Ends of the strips in the air, with room for exaggerated deviations, and their swaths on the ground; without
        a strip what has been flown."""
        s = self.state
        if not s.extent and s.framed is not None:
            (w, so, low), (e, n, high) = s.framed + np.array([[-1.0], [1.0]]) * (0.05 * s.height_m)
            return s.display(np.array([[x, y, z] for x in (w, e) for y in (so, n) for z in (low, high)]))
        places = []
        for start, end in s.extent.values():
            along = (end - start) / max(float(np.linalg.norm(end - start)), 1.0)
            left = np.array([-along[1], along[0], 0.0]) * s.swath_m / 2
            for place in (start, end):
                ground = np.array([place[0], place[1], s.ground_m])
                above = np.array([0.0, 0.0, s.room_m])
                places += [place + above, place - above, ground - left, ground + left]
        return s.display(np.array(places))

    def _legend(self, truth: bool) -> None:
        rows = [(self.state.measured or "trajectory", FILTERED), *(row for row in LEGEND if truth or row[0] != "truth")]
        places = np.array([[100.0 * i, 0.0] for i in range(len(rows))])
        self.canvas.points("legend", places, [color for _, color in rows], 5.0, [text for text, _ in rows])
