"""What all parts of a scene share: configuration, the display frame, scales, the newest poses."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.frames import LocalFrame
from ...solver.geometry.rotation import matrix_from_quaternion
from .. import convert
from ..convert import PoseSample
from ..node import Message
from .canvas import SIGMA0_SPAN

Array = NDArray[np.floating]
_HISTORY_S = 120.0
_HISTORY_STEP_S = 0.05
_LARGEST_GAP_NS = convert.SECOND_NS
_IMAGE_HEIGHT = 0.16  # of an image-space view, as a share of its width
_LINES_WIDTH, _LINES_HIGH = 400, 2.4  # of a view of image lines, about, px; and its height at least, in widths
_NO_LENGTH_S = 60.0  # of a strip whose end is not known
_WINDOW_CHANGE = 0.2  # of its length, at least: views are arranged again
_SIGMA0_ROOM, _SIGMA0_MOST = 1.3, 4.0
_SWING = 3.3  # standard deviations that a slow error reaches in a flight, about
_ROOM = 0.2  # of the flying height: what deviations of that size are drawn as


class PoseHistory:
    """Poses of the last two minutes, in order of time."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Array, Array]] = deque(maxlen=round(_HISTORY_S / _HISTORY_STEP_S))

    def add(self, sample: PoseSample) -> None:
        """Keep a pose that is newer than all kept ones."""
        if not self._samples or sample.time_ns > self._samples[-1][0]:
            self._samples.append((sample.time_ns, sample.position_l, sample.quaternion))

    @property
    def newest_ns(self) -> int:
        """Time of the newest pose; -1 without any."""
        return self._samples[-1][0] if self._samples else -1

    def at(self, time_ns: int) -> tuple[Array, Array] | None:
        """Position and quaternion at a time, linear between neighbours; None outside what is kept and in long gaps."""
        samples = self._samples
        if not samples or not samples[0][0] <= time_ns <= samples[-1][0]:
            return None
        k = bisect_left(samples, time_ns, key=lambda sample: sample[0])
        t1, p1, q1 = samples[k]
        if t1 == time_ns or k == 0:
            return p1, q1
        t0, p0, q0 = samples[k - 1]
        if t1 - t0 > _LARGEST_GAP_NS:
            return None
        share = (time_ns - t0) / (t1 - t0)
        q = q0 + share * (np.where(q0 @ q1 < 0, -q1, q1) - q0)
        return p0 + share * (p1 - p0), q / np.linalg.norm(q)


class SceneState:
    """Configuration and display frame of a scene.

    Attributes
    ----------
    start_ns : stamp of the first message that is not latched; None before it
    now_s : newest stamp, seconds since then
    closing : whether this is the last drawing
    recorded : whether all is drawn before anybody looks, so that curves may come in few pieces
    project, camera, frame, strips : configuration, as far as it has come; strip : id of the newest strip
    origin : (3,) subtracted from local coordinates for display; decided by the first pose
    extent : strip id -> (2, 3) first and last place of the perspective centre, as planned
    imaged_by : strip id -> CCD lines that its tie points are in, so far
    framed : (2, 3) least and largest coordinates of what the views frame as long as no strip is flown: the flown
        trajectory (before the first pose, the fixes), with room to go on; None before the first of them
    bar_px : residual that is drawn as long as the scale bar
    measured : the trajectory others are compared with, "filtered" or "smoothed"
    trajectory, truth : the newest poses of both
    units : units of the parameters that have come
    sigma0_span : between which sigma0 is drawn: about 1, and wider where it was beyond
    window_s : length of the adjustment's window, from where orientation is final until now; None until it is full
    """

    def __init__(self) -> None:
        self.start_ns: int | None = None
        self.now_s = 0.0
        self.closing = self.recorded = False
        self.project: Any = None
        self.camera: LineCamera | None = None
        self.frame: LocalFrame | None = None
        self.strips: dict[str, Any] = {}
        self.strip = ""
        self.origin: Array = np.zeros(3)
        self.ground_m = 0.0
        self.height_m = 1000.0
        self.extent: dict[str, Array] = {}
        self.framed: Array | None = None
        self._flown: Array | None = None
        self.units: list[str] = []
        self.sigma0_span = SIGMA0_SPAN
        self.window_s: float | None = None
        self.has_truth = False
        self.imaged_by: dict[str, set[str]] = {}
        self.has_mosaic = False
        self.has_results = False
        self.has_lines = False
        self.bar_px = 1.0
        self.newest: PoseSample | None = None
        self.speed_m_s = 70.0
        self._control: list[Array] = []
        self.trajectory = PoseHistory()
        self.measured = ""
        self.truth = PoseHistory()

    # ---- taking

    def begin_again(self) -> None:
        """Local coordinates are in another frame from now on: forget those so far, and the display frame."""
        self.origin, self.extent, self.newest = np.zeros(3), {}, None
        self.framed = self._flown = None
        self._control.clear()
        self.trajectory, self.truth = PoseHistory(), PoseHistory()

    def note(self, message: Message) -> None:
        """Keep configuration, control and time."""
        topic, body = message.topic, message.body
        if topic == "configuration/project":
            self.project, self.frame = body, convert.local_frame(body)
        elif topic == "configuration/camera":
            self.camera = convert.camera_from(body)
        elif topic == "configuration/strip":
            self.strips[body.id] = body
            self.strip = body.id
        elif topic == "observation/control":
            self._control.append(np.array([body.x, body.y, body.z]))
        else:
            if self.start_ns is None:
                self.start_ns = message.stamp_ns
            self.now_s = max(self.now_s, self.seconds(message.stamp_ns))
            if topic == "sensor/gnss" and self.newest is None and self.placed is not None:
                self._frame(self.placed.from_geodetic(body.latitude, body.longitude, body.altitude))
            if topic == "observation/tie":
                for image in body.images:
                    self.imaged_by.setdefault(image.strip, set()).add(image.ccd)
            self.has_results = self.has_results or topic.startswith(("adjustment/", "orientation/"))
            if topic == "adjustment/report":
                self._note_window(message.stamp_ns, body)

    def _note_window(self, stamp_ns: int, report: Any) -> None:
        """Keep the length of the window once something has left it; a slightly different one changes nothing."""
        strip = self.strips.get(report.strip)
        if strip is None or report.window_start_ns <= strip.first_line_time_ns + convert.SECOND_NS:
            return
        length = (stamp_ns - report.window_start_ns) / convert.SECOND_NS
        if self.window_s is None or abs(length - self.window_s) > _WINDOW_CHANGE * self.window_s:
            self.window_s = length

    def note_sigma0(self, value: float) -> None:
        """Let the plot of sigma0 show a value (of 4 at most), with room: it is arranged anew a few times only."""
        low, high = self.sigma0_span
        value = min(value, _SIGMA0_MOST)
        if not low <= value <= high:
            self.sigma0_span = min(low, value / _SIGMA0_ROOM), max(high, value * _SIGMA0_ROOM)

    def note_pose(self, topic: str, sample: PoseSample) -> None:
        """keep the newest poses; the first one decides the display frame."""
        if topic == "truth/trajectory":
            self.has_truth = True
            self.truth.add(sample)
        if topic != "trajectory":
            return
        if self.newest is None:
            self._decide_frame(sample)
            self.framed = self._flown = None
        elif sample.time_ns > self.newest.time_ns + 0.9 * _HISTORY_STEP_S * convert.SECOND_NS:
            step = (sample.time_ns - self.newest.time_ns) / convert.SECOND_NS
            speed = float(np.linalg.norm(sample.position_l - self.newest.position_l)) / step
            self.speed_m_s += 0.1 * (speed - self.speed_m_s)
        else:
            return
        self.newest = sample
        if sample.valid:
            self.trajectory.add(sample)
        self._plan(sample)
        if not self.extent:
            self._frame(sample.position_l)

    def _frame(self, place: Array) -> None:
        """Let views frame what has been flown; with room, so that they are arranged anew a few times only."""
        box = np.array([place, place]) if self._flown is None else self._flown
        self._flown = np.array([np.minimum(box[0], place), np.maximum(box[1], place)])
        if self.framed is None or (place < self.framed[0]).any() or (place > self.framed[1]).any():
            room = max(0.5 * float(np.linalg.norm(self._flown[1] - self._flown[0])), self.height_m / 2)
            self.framed = self._flown + np.array([[-room], [room]])

    def frame_flown(self) -> None:
        """Nothing more is flown: let views frame what was, and no more."""
        if self._flown is not None:
            self.framed = self._flown

    def _decide_frame(self, sample: PoseSample) -> None:
        anchor = np.mean(self._control, axis=0) if self._control else sample.position_l
        self.ground_m = float(np.median(self._control, axis=0)[2]) if self._control else 0.0
        self.origin = np.array([100 * round(anchor[0] / 100), 100 * round(anchor[1] / 100), 0.0])
        self.origin[2] = 10 * round(self.ground_m / 10)
        self.height_m = max(float(sample.position_l[2]) - self.ground_m, 50.0)

    def _plan(self, sample: PoseSample) -> None:
        """Where the strip that is being flown will end, once it has begun."""
        for id, strip in self.strips.items():
            if id in self.extent or not self._flying(strip, sample.time_ns):
                continue
            gone_s = (sample.time_ns - strip.first_line_time_ns) / convert.SECOND_NS  # more than 0 for who joins late
            step = forward(sample.quaternion) * self.speed_m_s
            start = sample.position_l - gone_s * step
            self.extent[id] = np.array([start, start + _length_s(strip) * step])
            self.strip = id

    def _flying(self, strip: Any, time_ns: int) -> bool:
        gone_s = (time_ns - strip.first_line_time_ns) / convert.SECOND_NS
        return strip.line_rate_hz > 0 and 0 <= gone_s <= _length_s(strip)

    # ---- asking

    @property
    def placed(self) -> LocalFrame | None:
        """The local frame where it is known where on the Earth it lies, for maps."""
        return self.frame if self.frame is not None and self.frame.is_placed else None

    def seconds(self, stamp_ns: int) -> float:
        """Seconds since the start."""
        return (stamp_ns - (stamp_ns if self.start_ns is None else self.start_ns)) / convert.SECOND_NS

    def on_strip(self, time_ns: int) -> bool:
        """Whether a strip is flown at a time; always where no strip is known."""
        return not self.strips or any(self._flying(strip, time_ns) for strip in self.strips.values())

    def ground_of(self, strip: str, position_l: Array, quaternion: Array) -> Array | None:
        """Left and right end on the ground (2, 3) of what a strip images: of the CCD line that looks down, or of those
        that its tie points are in where these are fewer, as of a scene. None where that does not meet the ground."""
        if self.camera is None:
            return None
        told = self.imaged_by.get(strip)
        R = matrix_from_quaternion(quaternion)
        found = []
        for k, line in enumerate(self.camera.lines):
            if told and line.id not in told:
                continue
            ends = line.xy_mm[[0, -1]] - self.camera.principal_point_mm[k]
            rays = np.column_stack([ends, np.full(2, -self.camera.focal_length_mm[k])]) @ R.T
            if (rays[:, 2] < 0).all():
                on_ground = position_l + ((self.ground_m - position_l[2]) / rays[:, 2])[:, None] * rays
                aside = float(np.linalg.norm((on_ground.mean(axis=0) - position_l)[:2]))
                found.append((aside, k, on_ground))
        if not found:
            return None
        ends_l = min(found, key=lambda row: row[:2])[2]
        along = forward(quaternion)
        left = np.array([-along[1], along[0], 0.0])
        return ends_l if (ends_l[0] - ends_l[1]) @ left >= 0 else ends_l[::-1]

    def display(self, position_l: Array) -> Array:
        """Display coordinates of local coordinates (..., 3)."""
        return np.asarray(position_l) - self.origin

    @property
    def ccds(self) -> list[str]:
        return [line.id for line in self.camera.lines] if self.camera is not None else []

    @property
    def gsd_m(self) -> float:
        """Pixel on the ground across the flight, m."""
        if self.camera is None:
            return 0.1
        line = self.camera.lines[0]
        pitch = float(np.linalg.norm(line.xy_mm[1] - line.xy_mm[0]))
        return self.height_m * pitch / float(self.camera.focal_length_mm[0])

    @property
    def swath_m(self) -> float:
        """Width on the ground of the widest CCD line, m."""
        if self.camera is None:
            return self.height_m
        widths = [float(np.linalg.norm(line.xy_mm[-1] - line.xy_mm[0])) for line in self.camera.lines]
        return self.height_m * max(widths) / float(self.camera.focal_length_mm.min())

    @property
    def _expected_m(self) -> float:
        """Slow position errors that the project expects in the trajectory, one sigma; a metre where it says nothing."""
        p = self.project
        squares = [] if p is None else [v * v for v in (*p.offset_sigma_m, *p.wander_sigma_m)]
        return float(np.sqrt(sum(squares) / 3)) or 1.0

    @property
    def grid_m(self) -> float:
        """Spacing of the grid on the ground, m."""
        return round_number(self.height_m / 3)

    @property
    def exaggeration(self) -> float:
        """Of deviations between trajectories, and of sigmas: what they reach in a flight fits in the room above it."""
        return round_number(_ROOM * self.height_m / (_SWING * self._expected_m))

    @property
    def room_m(self) -> float:
        """Above and below a trajectory, for deviations from it: at least as much as a slow error needs."""
        return max(_ROOM * self.height_m, self.exaggeration * _SWING * self._expected_m)

    @property
    def residual_scale(self) -> float:
        """Of residuals in object space: the scale bar of image space becomes a 25th of the flying height."""
        return round_number(self.height_m / 25 / (self.bar_px * self.gsd_m))

    @property
    def strip_s(self) -> float:
        """Length of the longest strip, s, in full tens: one that ends a little off its plan changes no view."""
        longest = max(map(_length_s, (s for s in self.strips.values() if s.line_rate_hz > 0)), default=_NO_LENGTH_S)
        return 10.0 * float(np.ceil(longest / 10.0))

    @property
    def lines_reduced(self) -> int:
        """Pixels of a line, and lines, that are put together to one in a view of image lines."""
        return max(round(self.image_size[0] / _LINES_WIDTH), 1)

    @property
    def lines_size(self) -> tuple[float, float]:
        """Width and height of a view of image lines, in reduced pixels.

        It is so high that all looks at a place are in view at once.
        """
        width = self.image_size[0] / self.lines_reduced
        if self.camera is None:
            return width, width
        ahead = [line.xy_mm[len(line.xy_mm) // 2, 0] for line in self.camera.lines]
        between = np.ptp(ahead) / float(self.camera.focal_length_mm.min()) * self.height_m / self.gsd_m
        return width, float(np.clip(1.12 * between / self.lines_reduced, _LINES_HIGH * width, 2 * _LINES_HIGH * width))

    @property
    def image_size(self) -> tuple[float, float]:
        """Width (samples) and height of an image-space view."""
        width = max((line.pixels for line in self.camera.lines), default=1) if self.camera is not None else 1
        return float(width), _IMAGE_HEIGHT * width


def _length_s(strip: Any) -> float:
    return strip.lines / strip.line_rate_hz if strip.lines else _NO_LENGTH_S


def forward(quaternion: Array) -> Array:
    """Horizontal direction of flight (3,) of an orientation."""
    axis = matrix_from_quaternion(quaternion)[:, 0].copy()
    axis[2] = 0.0
    return axis / max(float(np.linalg.norm(axis)), 1e-9)


def round_number(value: float) -> float:
    """The nearest of 1, 2, 5, 10, 20, ..., as ratios go."""
    power = float(10.0 ** np.floor(np.log10(max(value, 1e-9))))
    return min((f * power for f in (1, 2, 5, 10)), key=lambda f: abs(np.log(f / max(value, 1e-9))))
