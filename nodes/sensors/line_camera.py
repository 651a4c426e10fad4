"""A line camera whose lines come as files: raw or ENVI BIL that grow, or a folder of blocks."""

from __future__ import annotations

import re
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...schemas.image_lines import LineBlock
from ...solver.camera.line_camera import LineCamera
from ..convert import LATEST_S, SECOND_NS, STRIP_SILENT_S
from ..errors import UserError
from ..formats.envi import header_integer, header_of, read_header
from ..formats.envi_image import TYPES
from ..formats.keys import Keys
from ..formats.time_columns import instant_ns, instants_ns
from ..node import Message
from .blocks import BLOCK_S, block_message, pixels_of, strip_message
from .program import LOOK_S, Clock, Sensor, publish, refuse_unknown

if TYPE_CHECKING:
    from ..bus.program import ProgramOptions

KEYS = ("images", "folder", "samples", "type", "strip", "first_time", "line_times", "line_rate_hz")
#: Types of ENVI images whose values are grey values as they are.
_ENVI = {1: "u1", 12: "u2"}
#: CCD line, number of its first line in the strip, UTC of that line in ns.
_BLOCK_NAME = re.compile(r"(?:(?P<strip>[^_]+)_)?(?P<ccd>[^_]+)_(?P<first>\d+)_(?P<time>\d{15,19})\.raw")
#: Most lines of a block where a file has grown by many at once.
_MOST_LINES = 4096
#: In place of the time of a line that nobody knows.
NO_TIME = -1
#: A first time, or one that is later than that of the line before by more, ns, is believed with so many lines in a row.
JUMP_NS, JUMP_LINES = SECOND_NS, 5
#: The end of a strip, known when nothing more has come, is stamped so long after the newest platform time, ns, that no
#: node is past it when it comes.
END_AHEAD_NS = SECOND_NS // 2
#: Lines that come so long after those before them are of another strip, ns, also where both are read at once.
PAUSE_NS = round(STRIP_SILENT_S * SECOND_NS)


@dataclass(frozen=True)
class LineCameraSettings:
    """What a table says; see docs/flight-folder.md.

    Attributes
    ----------
    images : CCD line -> file and band (from 0; of a raw file 0)
    folder : of blocks, in place of images
    samples : pixels of a line of raw files
    kind : of their values
    strip : id
    first_ns : UTC of line 0, or None where the lines have times of their own
    line_times : file that grows with them, or None
    rate_hz : nominal line rate
    """

    id: str
    images: dict[str, tuple[Path, int]]
    folder: Path | None
    samples: int
    kind: str
    strip: str
    first_ns: int | None
    line_times: Path | None
    rate_hz: float
    clock: Clock

    @classmethod
    def read(cls, keys: Keys, folder: Path) -> LineCameraSettings:
        """From a table of a flight.toml or of a configuration.

        Raises
        ------
        UserError : a key that is not known, or a value that cannot be; no files, or no times
        """
        refuse_unknown(keys, KEYS)
        if keys.has("images") == keys.has("folder"):
            raise UserError(
                f'{keys.path}: {keys.where}: wanted either images = {{N = "nadir.bil"}} or folder = "blocks"'
            )
        table = keys.table("images")
        images = {ccd: _file(folder, table.text(ccd)) for ccd in table.values}
        given = keys.has("first_time") + keys.has("line_times")
        if images and given != 1:
            raise UserError(f"{keys.path}: {keys.where}: times of the lines: wanted either first_time or line_times")
        if keys.has("folder") and given:
            raise UserError(f"{keys.path}: {keys.where}: the names of the blocks say their times, not the table")
        first = None
        if keys.has("first_time"):
            value = keys.raw("first_time")
            text = value.isoformat() if hasattr(value, "isoformat") else keys.text("first_time")
            first = instant_ns(text, f"{keys.path}: {keys.name('first_time')}")
        kind = keys.text("type", "u1")
        if kind not in TYPES:
            raise keys.refuse("type", f"one of {', '.join(TYPES)}")
        return cls(
            keys.text("id", "lines"),
            images,
            folder / keys.text("folder") if keys.has("folder") else None,
            keys.integer("samples", 0),
            kind,
            keys.text("strip", "S1"),
            first,
            folder / keys.text("line_times") if keys.has("line_times") else None,
            keys.number("line_rate_hz", positive=True),
            Clock.of(keys),
        )

    def in_full(self) -> dict[str, Any]:
        """What a table has to say in another folder."""
        out: dict[str, Any] = {}
        if self.images:
            out["images"] = {ccd: f"{path.resolve()}@{band + 1}" for ccd, (path, band) in self.images.items()}
            out["samples"] = self.samples
        if self.folder is not None:
            out["folder"] = str(self.folder.resolve())
        if self.line_times is not None:
            out["line_times"] = str(self.line_times.resolve())
        return out

    def check_camera(self, keys: Keys, camera: LineCamera) -> None:
        """Raise UserError where the CCD lines are not those of the camera, or have another number of pixels, or where
        nothing says how many."""
        lines = {line.id: line.pixels for line in camera.lines}
        bare = [path.name for path, _ in self.images.values() if path.is_file() and header_of(path) is None]
        if not self.samples and (bare or not self.images):
            what = f"no ENVI header beside {bare[0]} says" if bare else "no name of a block says"
            raise UserError(f"{keys.path}: {keys.name('samples')}: missing; {what} how many pixels a line has")
        for ccd in self.images:
            if ccd not in lines:
                raise UserError(f"{keys.path}: {keys.name('images')}: CCD line {ccd!r}, wanted {', '.join(lines)}")
            if self.samples and self.samples != lines[ccd]:
                raise keys.refuse("samples", f"{lines[ccd]} as CCD line {ccd} of the camera has pixels")


def _file(folder: Path, text: str) -> tuple[Path, int]:
    name, sign, band = text.rpartition("@")
    if sign and band.isdigit() and int(band) >= 1:
        return folder / name, int(band) - 1
    return folder / text, 0


class GrowingImage:
    """Whole lines of a raw file, or of one band of an ENVI BIL, that is still being written.

    Parameters
    ----------
    path : of the data; it may not be there yet
    band : from 0
    samples, kind : of a raw file; an ENVI header beside it says them itself
    problem : counts what cannot be used: kind, text

    Raises
    ------
    UserError : while it is read: a header of another kind of image
    """

    def __init__(self, path: Path, band: int, samples: int, kind: str, problem: Callable[[str, str], None]) -> None:
        self.path, self._band, self._problem = path, band, problem
        self._samples, self._kind, self._bands, self._offset = samples, TYPES[kind], 1, 0
        self._file: BinaryIO | None = None
        self._over = False
        self.lines = 0  # given out

    def read(self, most: int) -> NDArray[Any] | None:
        """The next lines that are whole, (n, samples); None where there is none yet.

        Nothing more comes of a file that was begun anew: nobody knows when its lines were imaged.
        """
        if self._over:
            return None
        if self._file is None:
            if not self.path.is_file():
                return None
            self._open()
        assert self._file is not None
        line_bytes = self._bands * self._samples * self._kind.itemsize
        whole = (self.path.stat().st_size - self._offset) // line_bytes - self.lines
        if whole < 0:
            self._over = True
            self._problem(
                "image begun anew",
                f"{self.path} is shorter than the {self.lines} lines that were read of it: no more of it is used",
            )
        count = min(whole, most)
        if count < 1:
            return None
        self._file.seek(self._offset + self.lines * line_bytes)
        data = self._file.read(count * line_bytes)
        count = len(data) // line_bytes
        if not count:
            return None
        self.lines += count
        values = pixels_of(data[: count * line_bytes], self._samples, self._kind)
        return np.ascontiguousarray(values.reshape(count, self._bands, self._samples)[:, self._band])

    def _open(self) -> None:
        path = header_of(self.path)
        if path is not None:
            header = read_header(path)
            code = header_integer(path, header, "data type", low=1)
            if code not in _ENVI:
                raise UserError(f"{path}: data type: {code}, wanted 1 or 12 (grey values of 8 or 16 bits)")
            self._samples = header_integer(path, header, "samples", low=1)
            self._bands = header_integer(path, header, "bands", 1, low=1)
            interleave = header.get("interleave", "bil" if self._bands == 1 else "").lower()
            if self._bands > 1 and interleave != "bil":
                raise UserError(f"{path}: interleave: {interleave or 'missing'}, wanted bil for an image that grows")
            if self._band >= self._bands:
                raise UserError(f"{path}: band {self._band + 1}, wanted 1 to {self._bands}")
            order = header_integer(path, header, "byte order", 0)
            self._kind = np.dtype(_ENVI[code]).newbyteorder(">" if order else "<")
            self._offset = header_integer(path, header, "header offset", 0)
        elif not self._samples:
            raise UserError(f"{self.path}: neither an ENVI header beside it nor samples, wanted one of them")
        elif self._band:
            raise UserError(f"{self.path}: band {self._band + 1}: no ENVI header beside it, so that it has one band")
        self._file = open(self.path, "rb")  # noqa: SIM115  # for as long as it grows

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class GrowingTimes:
    """UTC of lines from a CSV ``line,time`` or ``line,time_s`` that grows with the image.

    A row that cannot be used, or whose time does not go on, leaves its line without a time. The first times, and times
    that jump ahead, are believed when `JUMP_LINES` lines in a row have gone on from there.

    Parameters
    ----------
    problem : counts rows that are not used: kind, text

    Attributes
    ----------
    time_ns : of each line so far, ns; `NO_TIME` of a line without one
    """

    def __init__(self, path: Path, problem: Callable[[str, str], None]) -> None:
        self.path = path
        self._problem = problem
        self._position = self._row = 0
        self._column = ""
        self._next = 0  # line that the next row is to be of
        self._ahead: list[_Row] = []  # with times that have jumped, not yet believed
        self.time_ns = array("q")

    def read(self) -> None:
        """Take in what has been added.

        Raises
        ------
        UserError : ``file:line: what is wrong`` with the header
        """
        if not self.path.is_file():
            return
        with open(self.path, "rb") as file:
            file.seek(self._position)
            data = file.read()
        whole = data.rfind(b"\n") + 1
        self._position += whole
        new: list[tuple[int, str, str]] = []  # line, where it stands, and the time as it is written
        for text in data[:whole].decode("utf-8-sig", "replace").splitlines():
            self._row += 1
            if text.strip():
                new += self._cells(text)
        for row in self._times(new):
            self._take(row)

    def of(self, first: int, most: int) -> list[int]:
        """Times of the lines from one on that have times, ns, or `NO_TIME` of those that have none; up to a pause."""
        times = np.array(self.time_ns[first : first + most], dtype=np.int64)
        known = times != NO_TIME
        other = (known[1:] != known[:-1]) | (np.diff(times) > PAUSE_NS)
        return times[: np.argmax(other) + 1 if other.any() else None].tolist()

    def _cells(self, text: str) -> list[tuple[int, str, str]]:
        """Line, where it stands and how its time is written; none in the header, and of a row that is not used."""
        where = f"{self.path}:{self._row}"
        cells = [cell.strip() for cell in text.split(",")]
        if not self._column:
            if len(cells) != 2 or cells[0] != "line" or cells[1] not in ("time", "time_s"):
                raise UserError(f"{where}: {text.strip()[:40]!r}, wanted the columns line,time or line,time_s")
            self._column = cells[1]
            return []
        line = int(cells[0]) if len(cells) == 2 and cells[0].isdecimal() else -1
        if line != self._next:
            self._refuse(f"{where}: {text.strip()[:40]!r}, wanted line {self._next} and its time")
            if not self._next < line < self._next + _MOST_LINES:
                return []
        self._next = line + 1
        return [(line, where, cells[1])]

    def _times(self, new: list[tuple[int, str, str]]) -> list[_Row]:
        """The rows whose times can be read."""
        try:
            return self._read_times(new)
        except UserError:
            rows = []
            for entry in new:
                try:
                    rows += self._read_times([entry])
                except UserError as error:
                    self._refuse(str(error))
            return rows

    def _read_times(self, new: list[tuple[int, str, str]]) -> list[_Row]:
        if not new:
            return []
        if self._column == "time_s":
            times = [_seconds_ns(where, text) for _, where, text in new]
        else:  # all at once: pandas takes a millisecond for a single one
            times = instants_ns([text for *_, text in new], lambda i: new[i][1]).tolist()
        return [_Row(line, t, f"{where}: {text!r}") for (line, where, text), t in zip(new, times, strict=True)]

    def _take(self, row: _Row) -> None:
        """The time of a line, if it goes on from that of the line before."""
        newest_ns = self.time_ns[-1] if self.time_ns else None
        if newest_ns is not None and row.time_ns <= newest_ns:
            self._refuse(f"{row.shown} does not come after the line before it")
            return
        if self._ahead and not 0 < row.time_ns - self._ahead[-1].time_ns <= JUMP_NS:
            for ahead in self._ahead:
                self._refuse(f"{ahead.shown} is not near the lines after it")
            self._ahead.clear()
        self._ahead.append(row)
        jumped = newest_ns is None or self._ahead[0].time_ns - newest_ns > JUMP_NS
        if jumped and len(self._ahead) < JUMP_LINES:
            return
        for known in self._ahead:
            self.time_ns.extend([NO_TIME] * (known.line - len(self.time_ns)))
            self.time_ns.append(known.time_ns)
        self._ahead.clear()

    def _refuse(self, text: str) -> None:
        self._problem("lines without a time", text)


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of line times: line, its time, where and how it is written."""

    line: int
    time_ns: int
    shown: str


def _seconds_ns(where: str, text: str) -> int:
    whole, _, fraction = text.partition(".")
    if not whole.isdecimal() or (fraction and not fraction.isdecimal()) or int(whole) > LATEST_S:
        raise UserError(f"{where}: {text!r}, wanted seconds since the Unix epoch")
    return int(whole) * SECOND_NS + int((fraction + "0" * 9)[:9])


class LineFiles(Sensor):
    """Lines from files that grow, or from a folder of blocks."""

    outputs = ("configuration/strip", "sensor/lines/*")

    def __init__(self, settings: LineCameraSettings) -> None:
        super().__init__(settings.id)
        self.from_begin = True
        self._settings = settings
        self._period_ns = round(SECOND_NS / settings.rate_hz)
        self._strips: dict[str, _Part] = {}  # of those not ended, by the name that the files give them
        self._times_begun: Counter[str] = Counter()
        self._heard_s = 0.0  # when the last block came

    def messages(self, stop: Event) -> Iterator[Message | None]:
        yield from self._blocks(stop) if self._settings.folder is not None else self._growing(stop)
        yield from self._end_strips()

    # ---- files that grow

    def _growing(self, stop: Event) -> Iterator[Message | None]:
        s = self._settings
        images = {
            ccd: GrowingImage(path, band, s.samples, s.kind, self.problem) for ccd, (path, band) in s.images.items()
        }
        times = GrowingTimes(s.line_times, self.problem) if s.line_times is not None else None
        most = min(max(round(BLOCK_S * s.rate_hz), 1), _MOST_LINES)
        silent = Silence(stop)
        try:
            while not stop.is_set():
                came = False
                if times is not None:
                    with self._readable(times.path):
                        times.read()
                for ccd, image in images.items():
                    first, pixels = image.lines, None
                    known = None if times is None else times.of(first, most)
                    room = most if known is None else len(known)
                    if room > 0:
                        with self._readable(image.path):
                            pixels = image.read(room)
                    if pixels is None:
                        continue
                    came = True
                    if known is not None:
                        known = known[: len(pixels)]
                        if known[0] == NO_TIME:
                            continue
                    yield from self._lines(s.strip, ccd, first, pixels, self._first_ns(first, known), known)
                if not came:
                    yield None
                    if silent.long():
                        yield from self._end_strips()
                    stop.wait(LOOK_S / 2)
                else:
                    silent.broken()
        finally:
            for image in images.values():
                image.close()

    def _first_ns(self, first: int, known: list[int] | None) -> int:
        if known is not None:
            return known[0]
        assert self._settings.first_ns is not None
        return self._settings.first_ns + round(first * SECOND_NS / self._settings.rate_hz)

    # ---- folder of blocks

    def _blocks(self, stop: Event) -> Iterator[Message | None]:
        s = self._settings
        assert s.folder is not None
        done: set[str] = set()
        silent = Silence(stop)
        if not s.samples:
            raise UserError(f"{s.folder}: samples of the lines missing, wanted samples = the pixels of a CCD line")
        while not stop.is_set():
            found, came = [], False
            names: list[Path] = []
            with self._readable(s.folder):
                names = list(s.folder.iterdir()) if s.folder.is_dir() else []
            for path in names:
                if path.name in done or path.suffix != ".raw":
                    continue
                match = _BLOCK_NAME.fullmatch(path.name)
                if match is None:
                    done.add(path.name)
                    self.problem("name of a block", f"{path.name}, wanted CCD_FIRSTLINE_TIMENS.raw as N_000200_17..ns")
                    continue
                found.append((int(match["time"]), path, match))
            for time_ns, path, match in sorted(found, key=lambda entry: entry[:2]):
                data, line_bytes = None, s.samples * TYPES[s.kind].itemsize
                with self._readable(path):
                    data = path.read_bytes()
                if data is None:
                    continue
                came = True
                done.add(path.name)
                if not data or len(data) % line_bytes:
                    self.problem("size of a block", f"{path.name}: {len(data)} bytes, wanted lines of {line_bytes}")
                    continue
                pixels = pixels_of(data, s.samples, TYPES[s.kind])
                strip = match["strip"] or s.strip
                yield from self._lines(strip, match["ccd"], int(match["first"]), pixels, time_ns, None)
            if not came:
                yield None
                if silent.long():
                    yield from self._end_strips()
                stop.wait(LOOK_S)
            else:
                silent.broken()

    # ---- both

    @contextmanager
    def _readable(self, path: Path) -> Iterator[None]:
        """Count a file that cannot be read now, as on a disk of another machine; it is tried again."""
        try:
            yield
        except OSError as error:
            self.problem("not readable", f"{path}: {error.strerror.lower() if error.strerror else error}")

    def _lines(
        self, strip: str, ccd: str, first: int, pixels: NDArray[Any], time_ns: int, known: list[int] | None
    ) -> Iterator[Message]:
        """The block, after the announcement of a strip that begins with it."""
        clock, rate_hz = self._settings.clock, self._settings.rate_hz
        self._heard_s = time.monotonic()
        newest_ns = self._strips[strip].newest_ns if strip in self._strips else None
        goes_on = newest_ns is not None and clock.stamp(clock.utc(time_ns)) - newest_ns <= PAUSE_NS
        before = [] if goes_on else self._take_strips()
        part = self._strips.get(strip) or self._begun(strip, first)
        missing = part.base - first  # of a CCD line that was behind the others when the strip ended
        if missing > 0:
            self.problem("lines before their strip", f"{min(missing, len(pixels))} of {ccd} from line {first} on")
            pixels, known = pixels[missing:], None if known is None else known[missing:]
            time_ns = time_ns + missing * self._period_ns if not known else known[0]
        if not len(pixels):
            return
        line, time_ns = max(-missing, 0), clock.utc(time_ns)
        times = None if known is None else np.array(known, dtype=np.int64) - clock.offset_ns
        message = block_message(
            clock, LineBlock(pixels, ccd, part.name, line, time_ns, 0 if known is not None else self._period_ns, times)
        )
        for ended in before:
            yield self._end(ended, message.stamp_ns)
        if part.newest_ns is None:
            part.first_ns, part.newest_ns = time_ns - round(line * SECOND_NS / rate_hz), message.stamp_ns
            yield strip_message(part.name, part.first_ns, rate_hz, message.stamp_ns)
        part.lines, part.newest_ns = max(part.lines, line + len(pixels)), max(part.newest_ns, message.stamp_ns)
        yield message

    def _begun(self, strip: str, first: int) -> _Part:
        """A strip begins; one that goes on after its end gets a name of its own, and counts from the line given."""
        self._times_begun[strip] += 1
        again = self._times_begun[strip]
        part = self._strips[strip] = _Part(strip) if again == 1 else _Part(f"{strip}-{again}", first)
        if again > 1:
            self.problem("strip goes on", f"{strip} had ended; from its line {first} on it is strip {part.name}")
        return part

    def _end_strips(self) -> Iterator[Message]:
        """The ends of all strips, of which nothing more comes."""
        since_ns = round((time.monotonic() - self._heard_s) * SECOND_NS)
        for part in self._take_strips():
            assert part.newest_ns is not None
            yield self._end(part, part.newest_ns + since_ns + END_AHEAD_NS)

    def _take_strips(self) -> list[_Part]:
        """Strips that have lines and have ended now."""
        ended = [part for part in self._strips.values() if part.newest_ns is not None]
        self._strips.clear()
        return ended

    def _end(self, part: _Part, stamp_ns: int) -> Message:
        return strip_message(part.name, part.first_ns, self._settings.rate_hz, stamp_ns, part.lines)


@dataclass
class _Part:
    """A strip that has not ended.

    Attributes
    ----------
    name : its id on the bus
    base : what the files count for its line 0
    lines : so many have come
    first_ns : UTC of line 0
    newest_ns : last stamp; None before the first block
    """

    name: str
    base: int = 0
    lines: int = 0
    first_ns: int = 0
    newest_ns: int | None = None


class Silence:
    """How long nothing has come, in turns of waiting."""

    def __init__(self, stop: Event) -> None:
        self._stop = stop
        self._begun: float | None = None

    def long(self) -> bool:
        """Whether nothing has come for `STRIP_SILENT_S`; true once."""
        now = time.monotonic()
        if self._begun is None:
            self._begun = now
        if now - self._begun > STRIP_SILENT_S:
            self._begun = float("inf")
            return True
        return False

    def broken(self) -> None:
        """Something has come."""
        self._begun = None


def run(options: ProgramOptions) -> int:
    """Publish lines from files until told to stop."""
    settings = LineCameraSettings.read(Keys(Path("configuration"), options.table, options.name), Path.cwd())
    return publish(options, LineFiles(settings))
