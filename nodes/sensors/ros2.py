"""ROS 2 topics over Zenoh, without ROS installed: rmw_zenoh's keys and CDR become ``sensor/*``.

rmw_zenoh publishes a topic under ``<domain>/<name without its first slash>/<package>::msg::dds_::<Type>_/<hash>``. The
bytes are CDR, decoded by rosbags. Bodies are turned into ours as for bags (`formats.ros2`).
"""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ..bus.session import listen_elsewhere
from ..convert import SECOND_NS, set_time
from ..errors import UserError
from ..formats.keys import Keys
from ..formats.ros2 import IMU, fix_messages, inertial_messages
from ..formats.ros2_decoding import FIX
from ..formats.ros2_images import IMAGE, image_rows, lines_missing, strip_name
from ..node import Message
from .blocks import block_message
from .program import LOOK_S, SILENT_S, Clock, Sensor, noise_of, publish, refuse_unknown

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions

KEYS = ("endpoint", "domain", "imu", "fix", "images", "line_rate_hz", "strip")
#: Samples that wait to be decoded; then ROS publishers are slowed down.
_DEPTH = 2000


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


def image_messages(
    payloads: Iterable[bytes], ccd: str, settings: Ros2Settings, left_out: Counter[str]
) -> Iterator[Message]:
    """``sensor/lines`` of each Image in CDR: its rows are image lines, its stamp is the time of the first one.

    Rows count on from image to image, over images that are lost as well. A silence begins another strip, which is named
    by the time of its first line.
    """
    period_ns = round(SECOND_NS / settings.rate_hz)
    strip, line, next_ns = "", 0, 0
    for time_ns, pixels in image_rows(payloads, left_out):
        utc_ns = settings.clock.utc(time_ns)
        if not strip or time_ns - next_ns > SILENT_S * SECOND_NS:
            strip, line = settings.strip + strip_name(utc_ns), 0
        else:
            missing = lines_missing(time_ns, next_ns, period_ns, len(pixels))
            if missing:
                left_out["image lines missing"] += missing
                line += missing
        yield block_message(settings.clock, LineBlock(pixels, ccd, strip, line, utc_ns, period_ns))
        line += len(pixels)
        next_ns = time_ns + len(pixels) * period_ns


class Ros2(Sensor):
    """ROS nodes as one sensor; each topic is decoded in a thread of its own."""

    outputs = ("sensor/gnss", "sensor/imu", "sensor/attitude", "sensor/lines/*")

    def __init__(self, settings: Ros2Settings) -> None:
        super().__init__(settings.id)
        self._settings = settings
        self._left_out: dict[str, Counter[str]] = {}
        self._told: Counter[str] = Counter()

    def messages(self, stop: Event) -> Iterator[Message | None]:
        s = self._settings
        made: queue.Queue[Message] = queue.Queue(_DEPTH)
        waiting: dict[str, queue.Queue[bytes | None]] = {}
        threads = []
        for topic, kind, convert in self._topics():
            key = key_expression(s.domain, topic, kind)
            waiting[key.removesuffix("*")] = come = queue.Queue(_DEPTH)
            left_out = self._left_out.setdefault(topic, Counter())

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
                        message: Message | None = self._on_our_clock(made.get(timeout=LOOK_S))
                    except queue.Empty:
                        message = None
                    self._tell()
                    yield message
        finally:
            stop.set()
            for come in waiting.values():
                with suppress(queue.Full):
                    come.get_nowait() if come.full() else None
                    come.put_nowait(None)
            for thread in threads:
                thread.join()
        self._tell()

    def _topics(self) -> Iterator[tuple[str, str, Callable[[Iterable[bytes], Counter[str]], Iterator[Message]]]]:
        s = self._settings
        if s.fix:
            yield s.fix, FIX, lambda come, left_out: fix_messages(come, s.fix, [], "", left_out)
        if s.imu:
            yield s.imu, IMU, lambda come, left_out: inertial_messages(come, s.imu, [], "", left_out, at_once=1)
        for ccd, topic in s.images.items():
            yield topic, IMAGE, lambda come, left_out, ccd=ccd: image_messages(come, ccd, s, left_out)

    def _on_our_clock(self, message: Message) -> Message | None:
        """The message with its times in UTC; None for the first inertial sample, whose interval is not known."""
        clock, body = self._settings.clock, message.body
        if message.topic.startswith("sensor/lines/"):  # is so already
            return message
        utc_ns = clock.utc(message.stamp_ns)
        if message.topic == "sensor/gnss":
            set_time(body.timestamp, utc_ns)
        else:
            body.time_ns = utc_ns
            if message.topic == "sensor/imu" and not body.interval_ns:
                return None
        return replace(message, stamp_ns=clock.stamp(utc_ns))

    def _tell(self) -> None:
        """Count what could not be used."""
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
