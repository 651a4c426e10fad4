"""Image lines from files: ENVI, TIFF and raw images with the times of their lines, as the messages of a strip."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ...schemas.topics import rank
from ...solver.camera.line_camera import LineCamera
from ..convert import SECOND_NS, STRIP_SILENT_S
from ..errors import UserError
from ..node import Message
from .envi import header_of
from .envi_image import TYPES, open_envi, open_raw
from .grey_image import GreyImage, ImageFile
from .image_cubes import cubes_of, joined
from .line_time_files import line_times, times_beside
from .tiff_image import is_tiff, open_tiff
from .time_columns import instant_ns

#: Length of a block, s, and the most bytes that it has.
BLOCK_S = 0.1
MOST_BYTES = 8_000_000
#: A strip ends so long after its last line, when its last matches are there, ns.
CLOSING_NS = 250_000_000


@dataclass(frozen=True)
class LinesGiven:
    """What the user says about the images of one strip.

    Attributes
    ----------
    files : (id of the CCD line or "", image or pattern of cubes, band or None), one a view
    strip : id of the strip; the name of the first file where it is empty
    times : file with the time of each line, or None for one beside the image, or the times of poses
    first : time of line 0 in ISO 8601, and lines a second; None with ``times``
    band : of files that name none
    span : values that become black and white
    day : of the flight, for GPS seconds
    raw : type (of `TYPES`) and samples of a line, 0 for those of the CCD line, of files without a header; None for none
    rate_hz : lines a second of image topics of a bag, None for what their stamps say
    """

    files: tuple[tuple[str, Path, str | None], ...]
    strip: str = ""
    times: Path | None = None
    first: tuple[str, float] | None = None
    band: str | None = None
    span: tuple[float, float] | None = None
    day: date | None = None
    raw: tuple[str, int] | None = None
    rate_hz: float | None = None

    @property
    def topics(self) -> dict[str, str] | None:
        """CCD line -> topic, where what is given are topics of a bag and no files; None without any."""
        if not self.files or not all(str(name).startswith("/") and not name.exists() for _, name, _ in self.files):
            return None
        return {ccd: str(name) for ccd, name, _ in self.files}


@dataclass(frozen=True)
class ImageStrip:
    """Views of one strip, line by line.

    Attributes
    ----------
    id : of the strip
    views : CCD line -> its image
    time_ns : (n,) UTC of each line
    rate_hz : mean line rate
    equal : the lines are equally spaced by construction
    notes : remarks
    """

    id: str
    views: dict[str, GreyImage]
    time_ns: NDArray[np.int64]
    rate_hz: float
    equal: bool
    notes: tuple[str, ...]

    def messages(self, notes: list[str], source: str = "import") -> Iterator[Message]:
        """``configuration/strip`` and ``sensor/lines/*``, by stamp and rank; a block is read when it is asked for.

        A block is stamped when its last line has been imaged.
        """
        begin, end = int(self.time_ns[0]), int(self.time_ns[-1]) + CLOSING_NS
        yield Message("configuration/strip", begin, self._strip(ended=False), source)
        yield from self.blocks(source)
        yield Message("configuration/strip", end, self._strip(ended=True), source)
        for image in self.views.values():
            notes.extend(image.notes())

    def blocks(self, source: str = "import") -> Iterator[Message]:
        """``sensor/lines/*`` alone, by stamp and rank."""
        yield from merge(*(self._blocks(ccd, source) for ccd in self.views), key=_order)

    def _strip(self, *, ended: bool) -> Any:
        return m.Strip(
            id=self.id,
            first_line_time_ns=int(self.time_ns[0]),
            line_rate_hz=self.rate_hz,
            lines=len(self.time_ns),
            ended=ended,
        )

    def _blocks(self, ccd: str, source: str) -> Iterator[Message]:
        image = self.views[ccd]
        most = max(MOST_BYTES // (2 * image.image.samples), 1)
        size = min(max(round(BLOCK_S * self.rate_hz), 1), most)
        period = round(SECOND_NS / self.rate_hz)
        for first in range(0, len(self.time_ns), size):
            times = self.time_ns[first : first + size]
            pixels = image.read(first, len(times))
            how = (period, None) if self.equal else (0, times)
            block = LineBlock(pixels, ccd, self.id, first, int(times[0]), *how)
            yield Message(f"sensor/lines/{ccd}", int(times[-1]), block, source)


def files_of(texts: Sequence[str]) -> tuple[tuple[str, Path, str | None], ...]:
    """CCD line, image and band of ``F=forward.img,N=nadir.img`` and ``F=all.img@1,N=all.img@2``; each may be alone.

    Raises
    ------
    UserError : a part without a file, a view that comes twice
    """
    found = []
    for part in (part.strip() for text in texts for part in text.split(",")):
        view, sign, name = part.partition("=")
        if not sign:
            view, name = "", part
        band = None
        if "@" in name and not Path(name).exists():
            name, _, band = name.rpartition("@")
        if not name or (sign and not view.strip()):
            raise UserError(f"--lines {part}: wanted VIEW=FILE, as in F=forward.img,N=nadir.img")
        found.append((view.strip(), Path(name), band))
    views = [view for view, _, _ in found]
    if len(set(views)) < len(views) or (len(views) > 1 and "" in views):
        raise UserError(
            f"--lines {','.join(texts)}: wanted another view for each file, as in F=forward.img,N=nadir.img"
        )
    return tuple(found)


def open_strips(
    given: LinesGiven, camera: LineCamera | None = None, pose_times_ns: NDArray[np.int64] | None = None
) -> list[ImageStrip]:
    """The images of a strip, with the time of each line.

    A pattern, as in ``raw_*``, names cubes. They follow one another in the order of the numbers in their names, and
    a new strip begins where a cube begins more than `STRIP_SILENT_S` after the end of that before it.

    Parameters
    ----------
    given : files and times
    camera : its CCD lines must be those of the views, with as many pixels
    pose_times_ns : (n,) times of poses that belong to the image lines, where nothing else says the times

    Raises
    ------
    UserError : images or times that cannot be read, or do not fit together or to the camera
    """
    views: dict[str, list[ImageFile]] = {}
    bands: dict[str, str | None] = {}
    notes: list[str] = []
    _refuse_type_without_effect(given)
    for name, path, band in given.files:
        view = _view(name, path, camera)
        pixels = 0 if camera is None else camera.lines[camera.line_index[view]].pixels
        cubes = [open_image(file, given.raw, pixels) for file in cubes_of(path, headless=given.raw is not None)]
        image = joined(cubes)
        notes.extend(image.notes)
        if pixels and pixels != image.samples:
            wanted = f"{pixels} as CCD line {view} of the camera has pixels"
            raise UserError(f"{image.path}: {image.samples} samples, wanted {wanted}")
        if views:
            _refuse_other_lines(cubes, next(iter(views.values())))
        views[view], bands[view] = cubes, band or given.band
    if not views:
        raise UserError("--lines: no image, wanted VIEW=FILE, as in F=forward.img,N=nadir.img")
    if camera is None:
        notes.append("no camera given (--camera): recorded without configuration/camera, image lines cannot be matched")
    elif set(views) < {line.id for line in camera.lines}:
        lost = [line.id for line in camera.lines if line.id not in views]
        notes.append(f"no image of the CCD lines {', '.join(lost)} of the camera")
    cubes = next(iter(views.values()))
    time_ns, rate_hz = _times(given, cubes, pose_times_ns, notes), given.first[1] if given.first else None
    ends = np.cumsum([cube.lines for cube in cubes])
    late = time_ns[ends[:-1]] - time_ns[ends[:-1] - 1] > STRIP_SILENT_S * SECOND_NS
    parts = np.split(np.arange(len(cubes)), np.flatnonzero(late) + 1)
    strips = []
    for part in parts:
        images = {view: joined(files[part[0] : part[-1] + 1]) for view, files in views.items()}
        grey = {view: GreyImage(image, image.weights(bands[view]), given.span) for view, image in images.items()}
        times = time_ns[ends[part[0]] - cubes[part[0]].lines : ends[part[-1]]]
        name = given.strip or cubes[0].path.stem if len(parts) == 1 else given.strip + strip_name(int(times[0]))
        strips.append(_strip_of(name, grey, times, rate_hz, notes))
        notes = []
    return strips


def strip_name(utc_ns: int) -> str:
    """Of a strip in a row of them: the time at which it begins."""
    return datetime.fromtimestamp(utc_ns // SECOND_NS, UTC).strftime("%H%M%S")


def _strip_of(
    id: str, views: dict[str, GreyImage], time_ns: NDArray[np.int64], rate_hz: float | None, notes: list[str]
) -> ImageStrip:
    """A strip of images; ``rate_hz`` of lines that are equally spaced by construction."""
    lines = len(time_ns)
    if lines < 2:
        raise UserError(f"{next(iter(views.values())).image.path}: {lines} line, wanted at least 2")
    rate = rate_hz or (lines - 1) * 1e9 / float(time_ns[-1] - time_ns[0])
    off = float(np.abs((time_ns - time_ns[0]) * (rate * 1e-9) - np.arange(lines)).max())
    told = off_the_rate(off, rate, "the strip has that rate, tie points have the times of their lines")
    return ImageStrip(id, views, time_ns, rate, rate_hz is not None, (*notes, *told))


def _refuse_other_lines(cubes: list[ImageFile], first: list[ImageFile]) -> None:
    """Raise UserError where the images of a view are not as long as those of the first view."""
    if len(cubes) != len(first):
        what = f"{len(cubes)} images from {cubes[0].path} on, wanted {len(first)}"
        raise UserError(f"{what} as of {first[0].path.name}")
    for cube, other in zip(cubes, first, strict=True):
        if cube.lines != other.lines:
            raise UserError(f"{cube.path}: {cube.lines} lines, wanted {other.lines} as in {other.path.name}")


def off_the_rate(lines: float, rate_hz: float, so: str) -> list[str]:
    """A note where lines of a strip are off its constant rate, and what follows."""
    if lines <= 0.1:
        return []
    what = f"line times are off a constant rate of {rate_hz:.4f} lines/s by {lines:.1f} lines at most"
    return [f"{what}; {so}"]


def with_lines(messages: Iterable[Message], strips: Sequence[ImageStrip], notes: list[str]) -> Iterator[Message]:
    """The messages of a flight with those of image strips among them, by stamp and rank."""
    yield from merge(messages, *(strip.messages(notes) for strip in strips), key=_order)


def _order(message: Message) -> tuple[int, int]:
    return message.stamp_ns, rank(message.topic)


def open_image(path: Path, raw: tuple[str, int] | None = None, samples: int = 0) -> ImageFile:
    """An image of lines: TIFF, ENVI, or with ``raw`` what has no header.

    Parameters
    ----------
    raw : see `LinesGiven`
    samples : of the CCD line, 0 where the camera is not known

    Raises
    ------
    UserError : from the reader of its format, or of no format
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if is_tiff(path):
        return open_tiff(path)
    if raw is None or _says_its_values(path):
        return open_envi(path)
    kind, width = raw
    if kind not in TYPES:
        raise UserError(f"{path}: values of type {kind!r}, wanted one of {', '.join(TYPES)}")
    if not (width or samples):
        raise UserError(f"{path}: pixels of a line are not known, wanted --samples, or --camera")
    return open_raw(path, kind, width or samples)


def _refuse_type_without_effect(given: LinesGiven) -> None:
    """Raise UserError for a type of raw values where every file says itself what its values are."""
    if given.raw is None or not given.files or not all(_says_its_values(path) for _, path, _ in given.files):
        return
    path = given.files[0][1]
    header = header_of(path)
    says = "a TIFF" if header is None else f"{header.name} beside it says what its values are"
    raise UserError(f"{path}: {says}, wanted no type {given.raw[0]}: that is of files without a header")


def _says_its_values(path: Path) -> bool:
    """Whether an image is a TIFF, or has an ENVI header."""
    return path.is_file() and (is_tiff(path) or path.suffix.lower() == ".hdr" or header_of(path) is not None)


def _view(name: str, path: Path, camera: LineCamera | None) -> str:
    if camera is None:
        return name or "N"
    lines = {line.id: line.pixels for line in camera.lines}
    if not name and len(lines) == 1:
        (name,) = lines
    if not name:
        raise UserError(f"{path}: its CCD line is not said, wanted --lines {next(iter(lines))}={path.name}")
    if name not in lines:
        raise UserError(f"{path}: CCD line {name!r} is not in the camera, wanted one of {', '.join(lines)}")
    return name


def _times(
    given: LinesGiven, cubes: list[ImageFile], pose_times_ns: NDArray[np.int64] | None, notes: list[str]
) -> NDArray[np.int64]:
    """Times of the lines (n,)."""
    lines, path = sum(cube.lines for cube in cubes), cubes[0].path
    if given.times is not None and given.first is not None:
        raise UserError(f"{given.times}: line times and a first time with a rate, wanted one of them")
    if given.first is not None:
        text, rate = given.first
        if not 0 < rate < np.inf:
            raise UserError(f"--line-rate {rate:g}, wanted more than 0 Hz")
        start = instant_ns(text, "--first-time")
        return start + np.rint(np.arange(lines) * (1e9 / rate)).astype(np.int64)
    if given.times is not None:
        return _of_file(given.times, path, lines, given.day, notes)
    if times_beside(path) is not None:
        return _beside(cubes, given.day, notes)
    if pose_times_ns is None:
        raise UserError(
            f"{path}: times of its lines are missing, wanted --line-times CSV, or --first-time and --line-rate"
        )
    if len(pose_times_ns) != lines:
        has = f"the file of poses, one a line, has the times of {len(pose_times_ns)}"
        raise UserError(f"{path}: {lines} lines, but {has}")
    return pose_times_ns


def _of_file(times: Path, image: Path, lines: int, day: date | None, notes: list[str]) -> NDArray[np.int64]:
    time_ns = line_times(times, day, notes)
    if len(time_ns) != lines:
        raise UserError(f"{image}: {lines} lines, but {times} has the times of {len(time_ns)}")
    return time_ns


def _beside(cubes: list[ImageFile], day: date | None, notes: list[str]) -> NDArray[np.int64]:
    """Times of lines that a camera's program has written beside each of its cubes."""
    found: list[NDArray[np.int64]] = []
    for cube in cubes:
        times = times_beside(cube.path)
        if times is None:
            raise UserError(f"{cube.path}: no times of its lines beside it, as {cubes[0].path.name} has them")
        time_ns = _of_file(times, cube.path, cube.lines, day, notes if not found else [])
        if found and time_ns[0] <= found[-1][-1]:
            raise UserError(f"{times}: begins before the cube before it ends, wanted cubes in the order of time")
        found.append(time_ns)
    return np.concatenate(found)
