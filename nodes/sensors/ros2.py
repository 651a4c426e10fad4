"""ROS 2 topics over Zenoh, without ROS installed: rmw_zenoh's keys and CDR become ``sensor/*``.

rmw_zenoh publishes a topic under ``<domain>/<name without its first slash>/<package>::msg::dds_::<Type>_/<hash>``. The
bytes are CDR, decoded by rosbags. Bodies are turned into ours as for bags (`formats.ros2`).
"""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ..bus.session import listen_elsewhere
from ..convert import SECOND_NS, STRIP_SILENT_S, set_time
from ..errors import UserError
from ..formats.image_lines import strip_name
from ..formats.keys import Keys
from ..formats.ros2 import IMU, fix_messages, inertial_messages
from ..formats.ros2_decoding import FIX
from ..formats.ros2_images import IMAGE, image_rows, lines_missing
from ..node import Message
from .blocks import block_message
from .program import LOOK_S, Clock, Sensor, noise_of, publish, refuse_unknown

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions

KEYS = ("endpoint", "domain", "imu", "fix", "images", "line_rate_hz", "strip", "imu_noise")
#: Samples that wait to be decoded; then ROS publishers are slowed down.
_DEPTH = 2000
#: A strip begins when all topics of images have, or one of them is so far ahead, s: publishers that start together.
BEGIN_S = 1.0
#: Images whose stamps the rate is looked for in, the newest ones; how many there have to be, and by how many lines half
#: of them have to be off the rate that is known, to say that the camera has another one. Tuned: stamps of a program are
#: off by a millisecond or so, of one image or another.
FITTED, LEAST_FITTED, OFF_LINES = 200, 9, 0.5


@dataclass(frozen=True)
class _Image:
    """An image of a CCD line: stamp of its first row, rows (n, samples)."""

    ccd: str
    time_ns: int
    pixels: NDArray[Any]


@dataclass(frozen=True)
class Ros2Settings:
    """What a table says; see docs/flight-folder.md."""

    id: str
    endpoint: str
    domain: int
    imu: str
    fix: str
    images: dict[str, str]
    rate_hz: float
    strip: str
    clock: Clock

    @classmethod
    def read(cls, keys: Keys, folder: Path) -> Ros2Settings:
        """From a table of a flight.toml or of a configuration.

        Raises
        ------
        UserError : a key that is not known, or a value that cannot be; no topic at all, images without a line rate
        """
        refuse_unknown(keys, KEYS)
        table = keys.table("images")
        images = {ccd: table.text(ccd) for ccd in table.values}
        imu, fix = keys.text("imu", ""), keys.text("fix", "")
        if not (imu or fix or images):
            raise UserError(f'{keys.path}: {keys.where}: no topic, wanted imu = "/imu/data", fix or images')
        for name in (imu, fix, *images.values()):
            if name and (not name.strip("/") or any(c in name for c in "*$?#% ")):
                raise UserError(f"{keys.path}: {keys.where}: {name!r}, wanted a ROS topic as /imu/data")
        twice = [name for name, n in Counter(name.strip("/") for name in images.values()).items() if n > 1]
        if twice:
            both = ", ".join(ccd for ccd, name in images.items() if name.strip("/") in twice)
            raise UserError(f"{keys.path}: {keys.where}: one topic for {both}, wanted a topic for each CCD line")
        rate_hz = keys.number("line_rate_hz", positive=True) if images else 0.0
        return cls(
            keys.text("id", "ros2"), keys.text("endpoint", "tcp/127.0.0.1:7447"), keys.integer("domain", 0),
            imu, fix, images, rate_hz, keys.text("strip", ""), Clock.of(keys),
        )  # fmt: skip

    def in_full(self) -> dict[str, Any]:
        """What a table has to say in another folder."""
        return {}

    def check_camera(self, keys: Keys, camera: LineCamera) -> None:
        """Raise UserError where the CCD lines are not those of the camera."""
        for ccd in self.images:
            if ccd not in camera.line_index:
                there_are = ", ".join(line.id for line in camera.lines)
                raise UserError(f"{keys.path}: {keys.name('images')}: CCD line {ccd!r}, wanted {there_are}")


def key_expression(domain: int, topic: str, kind: str) -> str:
    """Zenoh key under which rmw_zenoh publishes a topic, whatever the hash of its type."""
    package, _, name = kind.split("/")
    return f"{domain}/{topic.strip('/')}/{package}::msg::dds_::{name}_/*"


class LiveStrips:
    """Numbers the rows of images of one camera, whose topics are its CCD lines: one count a strip, by their stamps.

    The stamp of an image is the time of its first row. Line 0 is the earliest row of a strip, whichever CCD line it is
    of: what comes first is held back until all topics have begun, or one is `BEGIN_S` ahead. Rows of a topic count on
    from image to image, over images that are lost as well. A topic that begins later, or begins anew, takes its number
    from the others. When no topic has brought an image for `STRIP_SILENT_S`, or the clock was set back, the next one
    begins another strip, named by the time of its first line.

    Where the camera keeps another rate than the nominal one, its lines get times of their own, by a straight line
    through the newest stamps; the next strip begins with the rate found.

    Parameters
    ----------
    settings : with the topics, the line rate, and what the name of a strip begins with
    left_out : by topic, where is counted what could not be used

    Attributes
    ----------
    told : what an operator should know
    """

    def __init__(self, settings: Ros2Settings, left_out: Mapping[str, Counter[str]]) -> None:
        self._settings = settings
        self._left_out = {ccd: left_out[topic] for ccd, topic in settings.images.items()}
        self._period_ns = round(SECOND_NS / settings.rate_hz)
        self._come: deque[tuple[int, int]] = deque(maxlen=FITTED)  # line and time since the first line, of images
        self._first_image = (0, 0)
        self._fit: tuple[float, float] | None = None  # time of line 0 since the first line, and period, ns
        self._end = (0, -1)  # the line after the newest one, and the time of that
        self.told: list[str] = []
        self._held: list[_Image] = []
        self._strip, self._first_ns = "", 0
        self._next: dict[str, tuple[int, int]] = {}  # time and number of the row that each CCD line gives next

    def add(self, ccd: str, time_ns: int, pixels: NDArray[Any]) -> list[Message]:
        """``sensor/lines`` of an image, or of those that were held back.

        Parameters
        ----------
        time_ns : stamp on the clock of ROS, later than that of the CCD line's image before, unless that was set back
        pixels : rows (n, samples)
        """
        begin_ns = round(BEGIN_S * SECOND_NS)
        silent = not self._next or time_ns - max(self._next.values())[0] > STRIP_SILENT_S * SECOND_NS
        set_back = ccd in self._next and self._next[ccd][0] - time_ns > begin_ns
        if not (silent or set_back or (self._held and time_ns > self._held[0].time_ns - begin_ns)):
            return self._numbered(_Image(ccd, time_ns, pixels))
        self._held.append(_Image(ccd, time_ns, pixels))
        all_here = {image.ccd for image in self._held} >= self._settings.images.keys()
        stamps = [image.time_ns for image in self._held]
        return self.begin() if all_here or max(stamps) - min(stamps) > begin_ns else []

    def begin(self) -> list[Message]:
        """Begin a strip with what was held back."""
        held, self._held = self._held, []
        if not held:
            return []
        self._first_ns = min(image.time_ns for image in held)
        self._strip = self._settings.strip + strip_name(self._settings.clock.utc(self._first_ns))
        self._next = {}
        if self._fit is not None:
            (line, since_ns), (last, last_ns) = self._first_image, self._come[-1]
            self._period_ns = round((last_ns - since_ns) / max(last - line, 1))
        self._come.clear()
        self._fit, self._end = None, (0, -1)
        return [message for image in held for message in self._numbered(image, (self._first_ns, 0))]

    def _numbered(self, image: _Image, known: tuple[int, int] | None = None) -> list[Message]:
        """``known`` is the time and number of a row that a CCD line new to the strip goes by; else the newest one."""
        left_out = self._left_out[image.ccd]
        if image.ccd in self._next:
            next_ns, line = self._next[image.ccd]
            missing = lines_missing(image.time_ns, next_ns, self._period_ns, len(image.pixels))
            if missing:
                left_out["image lines missing"] += missing
                line += missing
        else:
            known_ns, line = known or max(self._next.values())
            line += round((image.time_ns - known_ns) / self._period_ns)
        if line < 0:
            left_out["images before their strip"] += 1
            return []
        self._next[image.ccd] = image.time_ns + len(image.pixels) * self._period_ns, line + len(image.pixels)
        clock = self._settings.clock
        self._look_at_rate(line, image.time_ns - self._first_ns)
        utc_ns, how = clock.utc(image.time_ns), (self._period_ns, None)
        if self._fit is not None:
            times = self._own_times(line, len(image.pixels), *self._fit) + clock.utc(self._first_ns)
            utc_ns, how = int(times[0]), (0, times)
        return [block_message(clock, LineBlock(image.pixels, image.ccd, self._strip, line, utc_ns, *how))]

    def _look_at_rate(self, line: int, since_ns: int) -> None:
        """Whether the camera keeps the rate that is known, and which one it does keep."""
        if not self._come:
            self._first_image = line, since_ns
        self._come.append((line, since_ns))
        lines, times = np.array(self._come, dtype=float).T
        off = np.median(np.abs(times / self._period_ns - lines)[-LEAST_FITTED:])
        if len(lines) < LEAST_FITTED or np.ptp(lines) < 1 or (self._fit is None and off < OFF_LINES):
            return
        middle = lines.mean()
        period, at_middle = np.polyfit(lines - middle, times, 1)
        if self._fit is None:
            found, known = SECOND_NS / period, SECOND_NS / self._period_ns
            self.told.append(
                f"{self._strip}: {found:.2f} lines/s come, not {known:.2f} as line_rate_hz or the strip before says; "
                "lines get their times by the stamps"
            )
        self._fit = float(at_middle - period * middle), float(period)

    def _own_times(self, line: int, rows: int, first_ns: float, period_ns: float) -> NDArray[np.int64]:
        """Times (rows,) of lines since the first line of the strip, ns; they go on where the fit goes back a little."""
        times = np.rint(first_ns + period_ns * (line + np.arange(rows))).astype(np.int64)
        end_line, end_ns = self._end
        if line >= end_line:
            if end_line:
                times += max(end_ns - int(times[0]), 0)
            self._end = line + rows, int(times[-1]) + round(0.5 * period_ns)
        return times


_Convert = Callable[[Iterable[bytes], Counter[str]], Iterator["Message | _Image"]]


class Ros2(Sensor):
    """ROS nodes as one sensor; each topic is decoded in a thread of its own."""

    outputs = ("sensor/gnss", "sensor/imu", "sensor/attitude", "sensor/lines/*")

    def __init__(self, settings: Ros2Settings) -> None:
        super().__init__(settings.id)
        self._settings = settings
        self._left_out: dict[str, Counter[str]] = {}
        self._told: Counter[str] = Counter()
        self._strips: LiveStrips | None = None

    def messages(self, stop: Event) -> Iterator[Message | None]:
        s = self._settings
        made: queue.Queue[Message | _Image] = queue.Queue(_DEPTH)
        waiting: dict[str, queue.Queue[bytes | None]] = {}
        threads = []
        self._left_out = {topic: Counter() for topic in (s.fix, s.imu, *s.images.values()) if topic}
        strips = self._strips = LiveStrips(s, self._left_out) if s.images else None
        for topic, kind, convert in self._topics():
            key = key_expression(s.domain, topic, kind)
            waiting[key.removesuffix("*")] = come = queue.Queue(_DEPTH)
            left_out = self._left_out[topic]

            def work(come: Any = come, convert: Any = convert, left_out: Any = left_out) -> None:
                for message in convert(iter(come.get, None), left_out):
                    while not stop.is_set():
                        try:
                            made.put(message, timeout=LOOK_S)
                            break
                        except queue.Full:
                            continue

            threads.append(threading.Thread(target=work, name=topic))
            threads[-1].start()

        def receive(key: str, payload: bytes) -> None:
            come = waiting.get(key.rpartition("/")[0] + "/")
            while come is not None and not stop.is_set():
                try:
                    come.put(payload, timeout=LOOK_S)
                    return
                except queue.Full:
                    continue

        try:
            with listen_elsewhere(s.endpoint, [key + "*" for key in waiting], receive):
                while not stop.is_set():
                    try:
                        come_in: Message | _Image | None = made.get(timeout=LOOK_S)
                    except queue.Empty:
                        come_in = None
                    out: list[Message | None]
                    if isinstance(come_in, _Image):
                        assert strips is not None
                        out = [*strips.add(come_in.ccd, come_in.time_ns, come_in.pixels)]
                    else:
                        out = [None if come_in is None else self._on_our_clock(come_in)]
                    self._tell()
                    yield from out or [None]
        finally:
            stop.set()
            for come in waiting.values():
                with suppress(queue.Full):
                    come.get_nowait() if come.full() else None
                    come.put_nowait(None)
            for thread in threads:
                thread.join()
        if strips is not None:
            yield from strips.begin()
        self._tell()

    def _topics(self) -> Iterator[tuple[str, str, _Convert]]:
        s = self._settings
        if s.fix:
            yield s.fix, FIX, lambda come, left_out: fix_messages(come, s.fix, [], "", left_out)
        if s.imu:
            yield s.imu, IMU, lambda come, left_out: inertial_messages(come, s.imu, [], "", left_out, at_once=1)
        for ccd, topic in s.images.items():
            yield (
                topic,
                IMAGE,
                lambda come, left_out, ccd=ccd: (
                    _Image(ccd, *found) for found in image_rows(come, left_out, live=True)
                ),
            )

    def _on_our_clock(self, message: Message) -> Message | None:
        """The message with its times in UTC; None for the first inertial sample, whose interval is not known."""
        clock, body = self._settings.clock, message.body
        utc_ns = clock.utc(message.stamp_ns)
        if message.topic == "sensor/gnss":
            set_time(body.timestamp, utc_ns)
        else:
            body.time_ns = utc_ns
            if message.topic == "sensor/imu" and not body.interval_ns:
                return None
        return replace(message, stamp_ns=clock.stamp(utc_ns))

    def _tell(self) -> None:
        """Count what could not be used, and say what an operator should know."""
        while self._strips is not None and self._strips.told:
            self.problem("another line rate", self._strips.told.pop(0))
        for topic, left_out in self._left_out.items():
            for why, n in list(left_out.items()):
                new = n - self._told[f"{topic} {why}"]
                if new:
                    self._told[f"{topic} {why}"] = n
                    self.problem(why, f"{topic}: {n} {why}")
                    self.counters[why] += new - 1


def run(options: ProgramOptions) -> int:
    """Publish what ROS nodes measure until told to stop."""
    keys = Keys(Path("configuration"), options.table, options.name)
    sensor = Ros2(Ros2Settings.read(keys, Path.cwd()))
    sensor.noise = noise_of(keys)
    return publish(options, sensor)
