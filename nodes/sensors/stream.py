"""Somebody's own driver without a Zenoh library: records over TCP, UDP or from a file that grows.

A record is a line of text; that of image lines is followed by their pixels. `RECORDS` has the words of each line.
"""

from __future__ import annotations

import selectors
import socket
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from ...schemas import messages as m
from ...schemas.groups import grouped
from ...schemas.image_lines import LineBlock
from ..convert import (
    LATEST_S,
    SECOND_NS,
    attitude_message,
    check_angles,
    check_inertial,
    check_place,
    gnss_message,
)
from ..errors import UserError
from ..formats.keys import Keys
from ..node import Message
from .blocks import block_message, pixels_of
from .bytes_in import WANTED, check_address, read_bytes
from .program import LOOK_S, Clock, Sensor, noise_of, publish, refuse_unknown

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions

KEYS = ("address", "baud", "imu_noise")
#: First word of a record -> the words that follow it. Times are UTC in ns since the Unix epoch.
RECORDS = {
    b"GNSS": "time_ns lat_deg lon_deg height_m sigma_east_m sigma_north_m sigma_up_m",
    b"IMU": "time_ns interval_ns force_x force_y force_z rate_x rate_y rate_z",
    b"ATTITUDE": "time_ns roll_rad pitch_rad heading_rad sigma_roll_rad sigma_pitch_rad sigma_heading_rad",
    b"LINES": "ccd strip first_line time_ns period_ns lines samples bits",
}
#: No line of text is longer, no block of pixels larger, bytes.
LONGEST, LARGEST = 1024, 64 << 20
#: Later times (of the year 2261, ns since the Unix epoch) and higher numbers of lines are refused before they leave
#: their 64 and 32 bits.
LATEST_NS, MOST_LINES = round(LATEST_S) * SECOND_NS, 2**31
_PIXELS = {8: np.dtype("u1"), 16: np.dtype("<u2")}


@dataclass(frozen=True)
class StreamSettings:
    """What a table says; see docs/flight-folder.md."""

    id: str
    address: str
    baud: int
    clock: Clock

    @classmethod
    def read(cls, keys: Keys, folder: Path) -> StreamSettings:
        """From a table of a flight.toml or of a configuration.

        Raises
        ------
        UserError : a key that is not known, or a value that cannot be
        """
        refuse_unknown(keys, KEYS)
        text = keys.text("address")
        try:
            if text.startswith("listen://"):
                check_address("tcp" + text.removeprefix("listen"), folder)
            else:
                text = check_address(text, folder)
        except ValueError:
            raise keys.refuse("address", f"listen://HOST:PORT, {WANTED}") from None
        return cls(keys.text("id", "stream"), text, keys.integer("baud", 115200, low=300), Clock.of(keys))

    def in_full(self) -> dict[str, Any]:
        """What a table has to say in another folder."""
        return {"address": self.address}


class StreamParser:
    """Bytes of one connection in, messages out.

    Parameters
    ----------
    clock : of the driver
    problem : counts what cannot be used: kind, text
    """

    def __init__(self, clock: Clock, problem: Any) -> None:
        self._clock, self._problem = clock, problem
        self._data = bytearray()
        self._block: tuple[LineBlock, int, int] | None = None  # one without pixels yet; samples, bytes
        self._kind = _PIXELS[8]

    def feed(self, data: bytes) -> list[Message]:
        """The messages that follow from more bytes."""
        self._data += data
        out: list[Message] = []
        while True:
            if self._block is not None:
                block, samples, size = self._block
                if len(self._data) < size:
                    return out
                pixels = pixels_of(bytes(self._data[:size]), samples, self._kind)
                del self._data[:size]
                self._block = None
                out.append(block_message(self._clock, replace(block, pixels=pixels)))
                continue
            end = self._data.find(b"\n")
            if end < 0:
                if len(self._data) > LONGEST:
                    self._problem("not a record", f"{len(self._data)} bytes without an end of line")
                    self._data.clear()
                return out
            line = bytes(self._data[:end]).strip()
            del self._data[: end + 1]
            if line:
                out += self._record(line)

    def _record(self, line: bytes) -> list[Message]:
        kind, *words = line.split()
        wanted = RECORDS.get(kind)
        if wanted is None:
            self._problem("not a record", f"{_shown(line)}, wanted {', '.join(name.decode() for name in RECORDS)}")
            return []
        if len(words) != len(wanted.split()):
            self._problem("not readable", f"{_shown(line)}: {len(words)} values, wanted {wanted}")
            return []
        try:
            return self._read(kind, words)
        except ValueError as error:
            self._problem("not readable", f"{_shown(line)}: {error}")
            return []

    def _read(self, kind: bytes, words: list[bytes]) -> list[Message]:
        if kind == b"LINES":
            self._begin_lines(words)
            return []
        time_ns = self._clock.utc(int(words[0]))
        values = [float(word) for word in words[1:]]
        if not np.isfinite(values).all() or not 0 <= time_ns <= LATEST_NS:
            raise ValueError("wanted finite values, and a time from 1970 to 2261")
        stamp = self._clock.stamp(time_ns)
        if kind != b"IMU" and not min(values[3:6]) > 0:
            raise ValueError("wanted sigmas above 0")
        if kind == b"GNSS":
            check_place(*values[:3])
            return [Message("sensor/gnss", stamp, gnss_message(time_ns, values[:3], values[3:6]))]
        if kind == b"ATTITUDE":
            check_angles(*values[:3])
            return [Message("sensor/attitude", stamp, attitude_message(time_ns, values[:3], values[3:6]))]
        interval_ns, f, w = int(words[1]), tuple(values[1:4]), tuple(values[4:7])
        check_inertial(interval_ns, f, w)
        body = grouped(m.Imu)(
            time_ns=time_ns, interval_ns=interval_ns, force_x=f[0], force_y=f[1], force_z=f[2],
            rate_x=w[0], rate_y=w[1], rate_z=w[2],
        )  # fmt: skip
        return [Message("sensor/imu", stamp, body)]

    def _begin_lines(self, words: list[bytes]) -> None:
        first, time_ns, lines, samples, bits = (int(words[k]) for k in (2, 3, 5, 6, 7))
        period_ns = float(words[4])
        if bits not in _PIXELS:
            raise ValueError(f"{bits} bits, wanted 8 or 16")
        size = lines * samples * bits // 8
        if min(first, time_ns) < 0 or not period_ns >= 1 or min(lines, samples) < 1 or size > LARGEST:
            raise ValueError("wanted at least one line and sample, a period above 0, and 64 MB at most")
        utc_ns = self._clock.utc(time_ns)
        if utc_ns < 0 or utc_ns + lines * period_ns > LATEST_NS or first + lines > MOST_LINES:
            raise ValueError("wanted times from 1970 to 2261, and line numbers of 32 bits")
        self._kind = _PIXELS[bits]
        empty = np.empty((0, samples), self._kind)
        ccd, strip = words[0].decode("ascii", "replace"), words[1].decode("ascii", "replace")
        block = LineBlock(empty, ccd, strip, first, utc_ns, round(period_ns))
        if lines > 1 and period_ns % 1:  # a message has whole ns between lines, and these would drift
            times = utc_ns + np.rint(period_ns * np.arange(lines)).astype(np.int64)
            block = replace(block, line_period_ns=0, line_times_ns=times)
        self._block = block, samples, size


def _shown(line: bytes) -> str:
    return "".join(c if c.isprintable() else "." for c in line[:60].decode("ascii", "replace"))


def _listen(address: str, stop: Event) -> Iterator[tuple[int, bytes]]:
    """What comes over the connections of whoever connects: which one, and its bytes; b"" now and then.

    Raises
    ------
    UserError : the port is held by another program
    """
    host, _, port = address.removeprefix("listen://").rpartition(":")
    with socket.socket() as server, selectors.DefaultSelector() as selector:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((host.strip("[]"), int(port)))
        except OSError as error:
            raise UserError(f"{address}: {(error.strerror or str(error)).lower()}") from None
        server.listen()
        selector.register(server, selectors.EVENT_READ)
        while not stop.is_set():
            events = selector.select(LOOK_S)
            if not events:
                yield -1, b""
            for event, _ in events:
                if event.fileobj is server:
                    connection, _ = server.accept()
                    selector.register(connection, selectors.EVENT_READ)
                    continue
                connection = event.fileobj
                assert isinstance(connection, socket.socket)
                try:
                    data = connection.recv(1 << 18)
                except OSError:
                    data = b""
                yield event.fd, data
                if not data:
                    selector.unregister(connection)
                    connection.close()
        for event in list(selector.get_map().values()):
            if isinstance(event.fileobj, socket.socket) and event.fileobj is not server:
                event.fileobj.close()


class Stream(Sensor):
    """A driver that writes records."""

    outputs = ("sensor/gnss", "sensor/imu", "sensor/attitude", "sensor/lines/*")

    def __init__(self, settings: StreamSettings) -> None:
        super().__init__(settings.id)
        self.from_begin = settings.address.startswith("file:")
        self._settings = settings

    def messages(self, stop: Event) -> Iterator[Message | None]:
        parsers: dict[int, StreamParser] = {}
        for number, data in self._bytes(stop):
            yield None
            if number < 0:
                continue
            if not data:
                parsers.pop(number, None)
                continue
            if number not in parsers:
                parsers[number] = StreamParser(self._settings.clock, self.problem)
            yield from parsers[number].feed(data)

    def _bytes(self, stop: Event) -> Iterator[tuple[int, bytes]]:
        address = self._settings.address
        if address.startswith("listen://"):
            yield from _listen(address, stop)
        else:
            for data in read_bytes(address, stop, self.problem, self._settings.baud):
                yield (0, data) if data else (-1, b"")


def run(options: ProgramOptions) -> int:
    """Publish what a driver writes until told to stop."""
    keys = Keys(Path("configuration"), options.table, options.name)
    sensor = Stream(StreamSettings.read(keys, Path.cwd()))
    sensor.noise = noise_of(keys)
    return publish(options, sensor)
