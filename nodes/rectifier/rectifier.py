"""The rectifier: image lines and orientations in, two growing orthoimages out: live, and with final orientation."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ...schemas.topics import CONFIGURATION, POSES
from ...solver.camera.line_camera import CcdLine, LineCamera
from ...solver.geometry.frames import LocalFrame
from ...solver.geometry.rotation import matrix_from_angles
from ...solver.matching.line_quality import full_scale_of
from ...solver.orthoimage.ground_grid import GroundGrid
from ...solver.orthoimage.growing import GrowingOrthoimage, WaitingLines
from ...solver.orthoimage.heights_of_points import heights_of_points
from ...solver.orthoimage.strip import rays_of
from ...solver.orthoimage.surface import Ellipsoid, Surface
from .. import convert
from ..node import Message, Node
from .steepest import SteepestLine

#: Lines of the live orthoimage wait so long for live orientation, s.
LIVE_PATIENCE_S = 1.0
#: So many object points make a relief; it is made anew so often, s, from the newest so many.
LEAST_POINTS, RELIEF_S, MOST_POINTS = 12, 4.0, 3000
#: Lines of a strip that nobody has announced wait so long for it, ns: the matcher announces what it finds 0.8 s later.
UNKNOWN_NS = 2_000_000_000


class Rectifier(Node):
    """Rectifies one CCD line, put together to quick-look size, with the best orientation of now and again when it is
    final. Tiles that have changed are published every ``publish_s`` of platform time.

    The ground is the relief between the adjusted object points; before there are enough of them, a height. The camera
    is that of the orientations: with the parameters that the adjuster has estimated, as its reports say.

    Of several lenses, of which the camera does not say where each looks, one is shown until lines of another come that
    its poses show to look down more steeply.

    Parameters
    ----------
    ccd : id of the CCD line, empty for the one that looks down most steeply
    samples : at most, across; the orthoimage's cells are as much larger than pixels
    publish_s : platform time between two looks for changed tiles
    budget_mb : megabytes of lines that may wait for their final orientation
    full_scale : largest grey value; 0 for 255 of 8-bit images, else 4095, or 16383 or 65535 once there are larger ones
    """

    name = "rectifier"
    inputs = (
        *CONFIGURATION,
        "sensor/lines/*",
        *POSES,
        "observation/control",
        "observation/verdict",
        "orientation/live",
        "orientation/final",
        "point/object",
        "adjustment/report",
    )
    outputs = ("orthoimage/live", "orthoimage/final", "event/log")

    def __init__(
        self,
        *,
        ccd: str = "",
        samples: int = 600,
        publish_s: float = 2.0,
        budget_mb: float = 256.0,
        full_scale: int = 0,
    ) -> None:
        super().__init__()
        if not samples >= 16:
            raise ValueError(f"samples: wanted at least 16, got {samples}")
        for name, value in (("publish_s", publish_s), ("budget_mb", budget_mb)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name}: wanted more than 0, got {value}")
        self._ccd, self._samples, self._full_scale = ccd, samples, full_scale
        self._publish_ns = round(publish_s * convert.SECOND_NS)
        self._budget = int(budget_mb * 1e6)
        self._project: Any = None
        self._camera_body: Any = None
        self._camera: LineCamera | None = None
        self._frame: LocalFrame | None = None
        self._strips: dict[str, Any] = {}
        self._control: dict[str, float] = {}
        self._refused: set[str] = set()  # control that an operator refused
        self._unknown: deque[tuple[int, LineBlock]] = deque()
        self._stamp_ns = self._reference_ns = 0
        self._next_publish_ns = 0
        self._begin_again()

    def _begin_again(self) -> None:
        self._line = -1
        self._steepest: SteepestLine | None = None
        # by CCD line, strip and time of a line whose orientation is to be looked at
        self._awaited: dict[str, tuple[str, float]] = {}
        self._kept: dict[str, deque[LineBlock]] = {}  # its lines, in case that they are to be shown
        self._kept_bytes = 0
        self._notes: list[Message] = []
        self._factor = 1
        self._next_line: dict[str, int] = {}
        self._rest: WaitingLines | None = None
        self._seen_scale = 0
        self._heights: dict[str, tuple[float, float, float]] = {}
        self._next_relief_s = -np.inf
        self._surface: Surface | None = None
        self._mean_m = 0.0
        self._parameters: Any = None  # of the newest report, as long as they have not been followed
        self._followed: Any = None
        self._filtered_seen = False
        self.images = {
            "live": GrowingOrthoimage(LIVE_PATIENCE_S, self._budget),
            "final": GrowingOrthoimage(np.inf, self._budget),
        }

    # -- node ----------------------------------------------------------------------------------------------------------

    def step(self, message: Message) -> Iterable[Message]:
        self._stamp_ns = max(self._stamp_ns, message.stamp_ns)
        try:
            self._take(message)
        except ValueError as error:
            self.refuse("malformed", f"{message.topic}: {error}")
        if self._stamp_ns < self._next_publish_ns:
            return self._said()
        self._next_publish_ns = self._stamp_ns + self._publish_ns
        self._work()
        return self._said() + self._changed_tiles()

    def finish(self) -> Iterable[Message]:
        self._work(everything=True)
        return self._said() + self._changed_tiles()

    def _said(self) -> list[Message]:
        notes, self._notes = self._notes, []
        return notes

    def state(self) -> str:
        if self._camera is None or self._frame is None:
            return "waiting for configuration"
        return "running" if self._line >= 0 else "waiting for image lines"

    # -- input ---------------------------------------------------------------------------------------------------------

    def _take(self, message: Message) -> None:
        topic, body = message.topic, message.body
        if topic == "configuration/project":
            before, self._project, self._frame = self._project, body, convert.local_frame(body)
            if before is not None and not convert.same_frame(before, body):
                self._begin_again()  # poses, points and control so far are in the local frame before
                self._control.clear()
        elif topic == "configuration/camera":
            self._configure(body, message.stamp_ns)
        elif topic == "configuration/strip":
            convert.check_strip(body, message.stamp_ns)
            self._strips[body.id] = body
            for block in [block for _, block in self._unknown if block.strip == body.id]:
                self._lines(block.ccd, block)
            self._unknown = deque(entry for entry in self._unknown if entry[1].strip != body.id)
        elif topic.startswith("sensor/lines/"):
            self._lines(topic.rpartition("/")[2], body)
        elif topic.startswith("trajectory/"):
            self._pose(body, topic == "trajectory/smoothed")
        elif topic.startswith("orientation/"):
            sample = convert.pose_sample(body)
            image = self.images[topic.removeprefix("orientation/")]
            if sample.valid:
                image.add_refined(self._seconds(sample.time_ns), sample.position_l, sample.quaternion)
        elif topic == "adjustment/report":
            self._parameters = body.parameters or self._parameters
        elif topic == "observation/verdict":
            if not body.topic:
                (self._refused.discard if body.accepted else self._refused.add)(body.point)
        elif np.isfinite([body.x, body.y, body.z]).all():
            if topic == "point/object":
                self._heights.pop(body.point, None)
                self._heights[body.point] = body.x, body.y, body.z
            elif convert.role_of(body) in ("control", "height"):
                self._control[body.point] = body.z

    def _configure(self, body: Any, stamp_ns: int) -> None:
        if body == self._camera_body:
            return
        self._camera = convert.camera_from(body)
        self._camera_body = body
        self._reference_ns = stamp_ns // convert.SECOND_NS * convert.SECOND_NS
        self._begin_again()

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._reference_ns) * 1e-9

    def _pose(self, body: Any, smoothed: bool) -> None:
        sample = convert.pose_sample(body)
        if sample.covariance is None:
            raise ValueError("pose without covariance")
        self._filtered_seen |= not smoothed
        time_s = self._seconds(sample.time_ns)
        if not sample.valid:
            self.counters["poses not valid"] += 1
            for image in self.images.values():
                image.skip_pose(time_s)
            return
        ordered = True
        for version, image in self.images.items():
            # the live image shows what was known at once; without a filter (an imported trajectory) smoothed poses lead
            if version == "final" or not smoothed or not self._filtered_seen:
                ordered &= image.add_pose(time_s, sample.position_l, sample.quaternion, sample.covariance, smoothed)
        if not ordered:
            self.problem("pose out of order", f"pose of {time_s:.3f} s came twice or too late")

    def _lines(self, ccd: str, block: LineBlock) -> None:
        if self._camera is None or self._frame is None:
            self.refuse("before configuration", f"sensor/lines/{ccd} came before configuration")
            return
        if self._line < 0:
            self._choose_line(self._camera)
        if ccd not in self._camera.line_index:
            raise ValueError(f"unknown CCD line {ccd!r}")
        line = self._camera.lines[self._camera.line_index[ccd]]
        if self._steepest is not None and self._steepest.wants(self._camera.line_index[ccd]):
            if ccd != self._camera.lines[self._line].id:
                _refuse_size(line, block)
                self._keep(ccd, block)
                self._look_down(self._camera, self._steepest, ccd, block)
                return
            self._look_down(self._camera, self._steepest, ccd, block)
        if ccd == self._camera.lines[self._line].id:
            self._show(line, block)

    def _keep(self, ccd: str, block: LineBlock) -> None:
        """Keep lines of a lens that nobody has looked at, as far as the budget goes."""
        self._kept.setdefault(ccd, deque()).append(block)
        self._kept_bytes += block.pixels.nbytes
        while self._kept_bytes > self._budget:
            most = max(self._kept, key=lambda name: len(self._kept[name]))
            self._kept_bytes -= self._kept[most].popleft().pixels.nbytes
            self.problem("lines given up", f"lines of {most} were more than budget_mb before an orientation came")

    def _show(self, line: CcdLine, block: LineBlock) -> None:
        """Hand lines of the CCD line that is shown on, those of an unknown strip once it is announced."""
        ccd = line.id
        if block.strip not in self._strips:
            self._unknown.append((self._stamp_ns, replace(block, ccd=ccd)))
            while self._unknown and self._stamp_ns - self._unknown[0][0] > UNKNOWN_NS:
                strip = self._unknown.popleft()[1].strip
                self.problem("unknown strip", f"lines of {ccd} name strip {strip!r}")
            return
        _refuse_size(line, block)
        first = int(block.first_line)
        late = min(max(self._next_line.get(block.strip, first) - first, 0), len(block.pixels))
        if late:
            self.counters["lines twice or late"] += late
        if late < len(block.pixels):
            time_s = (block.times_ns()[late:] - self._reference_ns) * 1e-9
            self._next_line[block.strip] = first + len(block.pixels)
            self._reduced(WaitingLines(block.strip, first + late, block.pixels[late:], time_s))

    def _choose_line(self, camera: LineCamera) -> None:
        if self._ccd:
            if self._ccd not in camera.line_index:
                raise ValueError(f"ccd: the camera has no line {self._ccd!r}")
            self._line = camera.line_index[self._ccd]
        else:
            self._steepest = SteepestLine(camera)
            self._line = self._steepest.line
        self._factor = -(-camera.lines[self._line].pixels // self._samples)

    def _look_down(self, camera: LineCamera, steepest: SteepestLine, ccd: str, block: LineBlock) -> None:
        """Look at the first orientation of a lens, and show its lines from now on where they look down more steeply.

        ``block`` is the newest one of it.
        """
        measured = self.images["live"].measured
        here = block.strip, self._seconds(int(block.times_ns()[0]))
        strip, time_s = self._awaited.setdefault(ccd, here)
        if not measured.covers([time_s])[0]:  # poses may come long after the lines that they belong to
            if time_s < measured.end_s:  # none will: it lies in a gap of them
                self._awaited[ccd] = here
            return
        pose = measured.at([time_s]).poses
        tilts = steepest.see(camera.line_index[ccd], strip, pose.position_l[0], matrix_from_angles(*pose.angles[0]))
        kept = self._kept.pop(ccd, ())
        self._kept_bytes -= sum(one.pixels.nbytes for one in kept)
        if tilts is None:
            return
        before = camera.lines[self._line].id
        self._line, self._rest = steepest.line, None
        self._next_line.clear()
        self._factor = -(-camera.lines[self._line].pixels // self._samples)
        self._parameters = self._parameters or self._followed
        for image in self.images.values():
            image.look_with(rays_of(camera, self._line, factor=self._factor))
        if np.isfinite(tilts[0]):
            was, now = np.degrees(tilts)
            text = (
                f"CCD line {ccd} looks down more steeply than {before} ({now:.1f} and {was:.1f} deg off): "
                "the orthoimage shows it from now on"
            )
            body = convert.log_line(self.name, text, self._stamp_ns)
            self._notes.append(Message("event/log", self._stamp_ns, body))
        for one in kept:
            self._show(camera.lines[self._line], one)

    def _reduced(self, lines: WaitingLines) -> None:
        """Put pixels together and hand lines on; what does not fill a group waits for the next block."""
        f, rest = self._factor, self._rest
        first, pixels, time_s = lines.first_line, lines.pixels, lines.time_s
        if rest is not None and rest.strip == lines.strip and rest.first_line + len(rest.pixels) == first:
            first, pixels = rest.first_line, np.concatenate([rest.pixels, pixels])
            time_s = np.concatenate([rest.time_s, time_s])
        skip = min(-first % f, len(pixels))
        first, pixels, time_s = first + skip, pixels[skip:], time_s[skip:]
        n, width = len(pixels) // f, pixels.shape[1] // f
        used = n * f
        self._rest = WaitingLines(lines.strip, first + used, pixels[used:], time_s[used:])
        if not n:
            return
        self._seen_scale = full_scale_of(pixels, self._seen_scale)
        scale = 255.0 / (self._full_scale or self._seen_scale)
        grey = pixels[:used, : width * f].reshape(n, f, width, f).mean(axis=(1, 3), dtype=np.float32) * scale
        small = np.clip(np.rint(grey), 1, 255).astype(np.uint8)
        time_s = time_s[:used].reshape(n, f).mean(axis=1)
        for image in self.images.values():
            image.add_lines(WaitingLines(lines.strip, first // f, small, time_s))

    # -- ground and output ---------------------------------------------------------------------------------------------

    def _work(self, everything: bool = False) -> None:
        if self._line < 0 or self._camera is None or self._frame is None:
            return
        if self._steepest is not None:
            for ccd, blocks in list(self._kept.items()):  # the last ones of a flight, too
                if blocks:
                    self._look_down(self._camera, self._steepest, ccd, blocks[-1])
        self._look_at_ground(self._camera, self._frame)
        self._follow_camera(self._camera)
        for version, image in self.images.items():
            image.work(everything)
            for name, count in (("without refined orientation", image.impatient), ("without orientation", image.lost)):
                if count:
                    self.counters[f"{version} lines {name}"] = count * self._factor

    def _look_at_ground(self, camera: LineCamera, frame: LocalFrame) -> None:
        now_s = self._seconds(self._stamp_ns)
        measured = self.images["live"].measured
        if now_s < self._next_relief_s or not np.isfinite(measured.end_s):
            return
        self._next_relief_s = now_s + RELIEF_S
        for old in list(self._heights)[: max(len(self._heights) - MOST_POINTS, 0)]:
            del self._heights[old]
        heights = np.array(list(self._heights.values())).reshape(-1, 3)
        control = [z for point, z in self._control.items() if point not in self._refused]
        known = heights[:, 2] if len(heights) else np.array(control)
        self._mean_m = float(np.median(known)) if len(known) else 0.0
        self._surface = Ellipsoid(frame, frame.height_m + self._mean_m)
        if len(heights) >= LEAST_POINTS:
            try:
                self._surface = heights_of_points(heights)
            except ValueError as error:
                self.problem("no relief", str(error))
        above = float(measured.at([measured.end_s]).poses.position_l[0, 2]) - self._mean_m
        if above <= 0:
            self.problem("below ground", f"the camera is {-above:.0f} m below the ground")
            return
        line = camera.lines[self._line]
        pitch = float(np.linalg.norm(line.xy_mm[-1] - line.xy_mm[0])) / (line.pixels - 1)
        gsd = float(f"{self._factor * above * pitch / camera.focal_length_mm[self._line]:.2g}")
        local = LocalFrame(frame.lat_deg, frame.lon_deg, frame.height_m, "local")
        for image in self.images.values():
            image.set_ground(rays_of(camera, self._line, factor=self._factor), GroundGrid(local, gsd), self._surface)

    def _follow_camera(self, camera: LineCamera) -> None:
        """Rectify with the camera that the adjuster has estimated from now on."""
        if self._parameters is None or any(image.grid is None for image in self.images.values()):
            return
        told = self._followed = self._parameters
        self._parameters = None
        try:
            rays = rays_of(convert.estimated_camera(camera, told)[0], self._line, factor=self._factor)
        except ValueError as error:
            self.problem("malformed", f"adjustment/report: {error}")
            return
        for image in self.images.values():
            image.set_rays(rays)

    def _changed_tiles(self) -> list[Message]:
        out = []
        for version, image in self.images.items():
            if image.mosaic is None:
                continue
            for key in sorted(image.mosaic.changed):
                out.append(Message(f"orthoimage/{version}", self._stamp_ns, self._tile(image, key)))
            image.mosaic.changed.clear()
        return out

    def _tile(self, image: GrowingOrthoimage, key: tuple[int, int]) -> Any:
        assert image.mosaic is not None and image.grid is not None and self._camera is not None
        row, column = key
        size, gsd = image.mosaic.tile, image.grid.gsd
        return m.GroundTile(
            column=column, row=row, size=size, gsd_m=gsd, x=column * size * gsd, y=-row * size * gsd, z=self._mean_m,
            encoding="mono8", data=image.mosaic.tiles[key].tobytes(), ccd=self._camera.lines[self._line].id,
            strip=image.strip, newest_time_ns=self._reference_ns + round(image.newest_s * convert.SECOND_NS),
        )  # fmt: skip


def _refuse_size(line: CcdLine, block: LineBlock) -> None:
    if block.pixels.shape[1] != line.pixels:
        raise ValueError(f"lines of {line.id} of {block.pixels.shape[1]} samples, wanted {line.pixels}")
