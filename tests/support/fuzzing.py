"""Hostile files and messages for every reader and node, with checksums kept right so that the inside is reached.

A *case* is one file that was read, one buffer that was parsed, or one message that a node was given. What a target does
with it is either an answer or a `UserError` of one line; anything else is a `Finding`: another exception, a node that
failed inside, more than two seconds of processor time, memory beyond ten times the file, a process that dies of it.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import struct
import sys
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import count
from mmap import mmap
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import rasterio
import sample_messages
from driven_flight import SETTINGS
from envi_files import write_image
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from rasterio.transform import from_bounds
from satellite_scenes import Truth, write_dimap1, write_dimap2, write_folder, write_isd
from small_block import FILES, write_files
from test_damaged_files import small_files
from test_image_lines import cube_of, write_tiff
from test_imports import write_sbet_file
from test_line_time_files import headwall, resonon
from test_pose_tables import HEADWALL, headwall_rows, lcf_rows
from test_ros2 import flight_of, write_bag
from test_rtklib import text_of as rtklib_positions

from triline.nodes import config, registry
from triline.nodes.errors import UserError
from triline.nodes.formats import detect
from triline.nodes.formats.camera_json import read_camera
from triline.nodes.formats.dem import read_dem
from triline.nodes.formats.envi_image import open_envi
from triline.nodes.formats.flight_folder import read_flight
from triline.nodes.formats.frame_json import read_frame
from triline.nodes.formats.geocal_xml import read_glas_camera
from triline.nodes.formats.geotiff import MOST_HEIGHTS, Heights, write_heights
from triline.nodes.formats.grey_image import ImageFile
from triline.nodes.formats.height_raster import HeightRaster
from triline.nodes.formats.keys import Keys
from triline.nodes.formats.line_time_files import line_times
from triline.nodes.formats.satellite.earth_orientation_file import read_c04, read_finals
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import rasterio_rpc, read_rpc_tags, write_rpb, write_rpc_text
from triline.nodes.formats.smrmsg import write_smrmsg
from triline.nodes.formats.tiff_image import open_tiff
from triline.nodes.node import Message, Node
from triline.nodes.ordering import StreamCheck
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.sensors.nmea import NmeaParser, NmeaSettings
from triline.nodes.sensors.program import Clock
from triline.nodes.sensors.stream import StreamParser
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator
from triline.nodes.step_driver import StepDriver
from triline.nodes.viewer import scene
from triline.nodes.viewer.canvas import NullCanvas
from triline.schemas import codec
from triline.schemas.envelope import Envelope
from triline.schemas.image_lines import LineBlock
from triline.solver.location.rpc_fit import fit_to_model

#: A case must not take longer, s of processor time, nor more memory than so many times the file plus a start, bytes.
LONGEST_S, MEMORY_TIMES, MEMORY_START = 2.0, 10, 64_000_000
#: A case that takes longer is ended, s of processor time.
STOP_S = 20.0
#: So much of the example of a finding is kept, bytes.
NOTE_BYTES = 4000
#: Address space of a process that works on a target, bytes: what wants more is a finding, and no danger to the machine.
ADDRESS_SPACE = 6_000_000_000
#: So many examples come from one run of hypothesis, which keeps a tree of all that it has drawn: 1 kB for each choice.
EXAMPLES = 250
#: Messages to an example, and how often each list of them is gone through: drawing takes longer than what a node does.
MESSAGES, TURNS = 20, 4
#: Processes that may die of one target.
TRIES = 5
#: What numbers are replaced by, and words.
NUMBERS = ("nan", "-inf", "1e999", "-0", "0", "1e-300", "-1", "2147483648", "9223372036854775808", "1e18", "0x10", "")
WORDS = (
    b"", b"nan", b"[", b"]" * 3, b'"', b"'", b",", b",,,", b"\n", b"\r", b"\0", b"\xff\xfe", "\u202e".encode(),
    b"\x1b[2J",
    b"<!ENTITY a 'b'>", b"&a;", b"[" * 200, b"{" * 200, b"= 1\n", b"9" * 400, b"-", b"e", b"../../etc", b"true", b"=",
)  # fmt: skip
_PLACE = st.floats(0, 1, exclude_max=True)
#: Changes of a file: (what, where, where else, word).
EDITS = st.lists(
    st.tuples(st.integers(0, 8), _PLACE, _PLACE, st.sampled_from(WORDS) | st.binary(max_size=8)), min_size=1, max_size=4
)
#: Changes of a message: (what, which field, value).
VALUES = st.sampled_from(
    [0.0, -1.0, 1e-300, 1e18, 1e300, -1e9, float("nan"), float("inf"), 2**31 - 1, -(2**31), 2**63 - 1, -(2**63)]
)
CHANGES = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 60), VALUES), max_size=3)
#: What happens to the order of messages: index, repeats, change of stamp in s, of the number, of the source.
ORDER = st.tuples(
    st.integers(0, 30),
    st.sampled_from([0.0, 0.0, 0.0, -1.0, 0.3, 3600.0, -1e6, 1e9]),
    st.sampled_from([1, 1, 1, 0, 7, 10**6]),
)


@dataclass
class Finding:
    """What was wrong, how often, and the first file or message that showed it."""

    target: str
    what: str
    example: bytes
    times: int = 1


@dataclass
class Campaign:
    """What a campaign has done.

    Attributes
    ----------
    cases, refused : by target
    longest_s : processor time of the longest case
    most_bytes : by how much a case raised the memory of the process at most
    findings : by target and kind
    note : shared with the process that started this one: the case that is being worked on
    """

    cases: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    longest_s: dict[str, float] = field(default_factory=dict)
    most_bytes: Counter[str] = field(default_factory=Counter)
    findings: dict[str, Finding] = field(default_factory=dict)
    note: mmap | None = None

    def run(self, target: str, example: bytes, work: Callable[[], Any], size: int = 0, *, quiet: bool = False) -> bool:
        """One case; False if it was ended from outside, so that what it worked on is of no more use.

        Numerical warnings count unless ``quiet`` is given: those of nodes go into their logs.
        """
        self.cases[target] += 1
        if self.note is not None:
            _write_note(self.note, self.cases[target], example)
        watch, shown, whole = _Watch(), _Shown(quiet), True
        before = _begin_peak()
        begun = time.process_time()
        try:
            with shown, watch:
                work()
        except UserError as error:
            self.refused[target] += 1
            if "\n" in str(error):
                self._found(target, f"more than one line: {str(error)[:80]!r}", example)
        except _Hangs:
            whole = False
        except Exception as error:
            whole = not isinstance(error, MemoryError)
            trace = error.__traceback__
            while trace is not None and trace.tb_next is not None:
                trace = trace.tb_next
            place = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}" if trace else ""
            text = str(error)
            if isinstance(error, AssertionError) and "failed inside" in text:
                place, text = text[text.rfind("(") :], text[:200]
            self._found(target, f"{type(error).__name__} at {place}: {text[:200]!r}", example)
        for what in shown.what:
            self._found(target, what, example)
        took = time.process_time() - begun
        self.longest_s[target] = max(self.longest_s.get(target, 0.0), took)
        if took > LONGEST_S:
            stopped = "" if whole else f", stopped after {STOP_S:.0f} s"
            self._found(target, f"hangs at {watch.place or 'its end'}: more than {LONGEST_S:.0f} s{stopped}", example)
        grown = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        self.most_bytes[target] = max(self.most_bytes[target], grown)
        if grown > MEMORY_TIMES * (size or len(example)) + MEMORY_START:
            self._found(target, f"memory beyond ten times the file: {grown / 1e6:.0f} MB", example)
        return whole

    def died(self, target: str, how: str) -> None:
        """The process that worked on a target is gone; what it was on is in the note."""
        assert self.note is not None
        cases, example = _read_note(self.note)
        self.cases[target] += cases
        self._found(target, f"the process ended ({how})", example)

    def add(self, other: Campaign) -> None:
        """What another process has done."""
        self.cases.update(other.cases)
        self.refused.update(other.refused)
        for name in other.cases:
            self.longest_s[name] = max(self.longest_s.get(name, 0.0), other.longest_s.get(name, 0.0))
            self.most_bytes[name] = max(self.most_bytes[name], other.most_bytes[name])
        for key, finding in other.findings.items():
            if key in self.findings:
                self.findings[key].times += finding.times
            else:
                self.findings[key] = finding

    def _found(self, target: str, what: str, example: bytes) -> None:
        key = f"{target}: {what.partition(': ')[0]}"
        if key in self.findings:
            self.findings[key].times += 1
        else:
            self.findings[key] = Finding(target, what, example[:NOTE_BYTES])


#: What is done with a target: a campaign, the number of cases, the seed and the latest `time.process_time` are given.
Work = Callable[[Campaign, int, int, float], None]


def _write_note(note: mmap, number: int, example: bytes) -> None:
    kept = example[:NOTE_BYTES]
    note[: 12 + len(kept)] = struct.pack("<QI", number, len(kept)) + kept


def _read_note(note: mmap) -> tuple[int, bytes]:
    number, length = struct.unpack_from("<QI", note)
    return number, note[12 : 12 + length]


def _begin_peak() -> int:
    """The memory of this process now, bytes; from here on the system counts its highest value anew (Linux)."""
    try:
        with open("/proc/self/clear_refs", "w") as file:
            file.write("5")
    except OSError:  # the highest value since the process began
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class _Hangs(BaseException):
    """Ends a case; nothing that catches exceptions of data catches it."""


class _Shown:
    """What a terminal would show of a case beside an answer or one line: warnings, and tracebacks out of libraries."""

    def __init__(self, quiet: bool) -> None:
        self.what: list[str] = []
        self._quiet = quiet
        self._warnings = warnings.catch_warnings(record=True)

    def __enter__(self) -> _Shown:
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        self._told = self._warnings.__enter__()
        warnings.simplefilter("ignore")
        if not self._quiet:
            warnings.simplefilter("always", RuntimeWarning)
        return self

    def __exit__(self, *given: object) -> None:
        self._warnings.__exit__(*given)
        sys.unraisablehook = self._hook
        for w in self._told or ():
            self.what.append(f"{w.category.__name__} at {Path(w.filename).name}:{w.lineno}: {w.message}")

    def _unraisable(self, error: Any) -> None:
        self.what.append(f"{error.exc_type.__name__} ignored in {error.object}: {error.exc_value}")


class _Watch:
    """Looks where a case is after `LONGEST_S` of processor time, and ends it after `STOP_S`."""

    def __init__(self) -> None:
        self.place = ""
        self._on = False

    def __enter__(self) -> None:
        signal.signal(signal.SIGPROF, self._ring)
        self._on = True
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)

    def __exit__(self, *_: object) -> None:
        self._on = False
        signal.setitimer(signal.ITIMER_PROF, 0.0)

    def _ring(self, _number: int, frame: FrameType | None) -> None:
        if not self._on:
            return
        if self.place:
            raise _Hangs
        signal.setitimer(signal.ITIMER_PROF, STOP_S - LONGEST_S)
        while frame is not None and "triline" not in frame.f_globals.get("__name__", ""):
            frame = frame.f_back
        self.place = f"{Path(frame.f_code.co_filename).name} {frame.f_code.co_qualname}" if frame else "?"


class _Over(Exception):
    """The time is over: hypothesis would go on to draw examples."""


# ---- files


def edited(data: bytes, edits: list[tuple[int, float, float, bytes]]) -> bytes:
    """A file with some changes: bytes, lines, numbers and words."""
    for what, a, b, word in edits:
        i, j = int(a * len(data)), int(b * len(data))
        if what == 0:
            data = data[:i]
        elif what == 1:
            data = data[:i] + word + data[i + len(word) :]
        elif what == 2:
            data = data[:i] + word + data[i:]
        elif what == 3:
            data = data[: min(i, j)] + data[max(i, j) :] if abs(i - j) < 200 else data[:i] + data[i + 16 :]
        elif what in (4, 5):  # a line twice, or gone
            first = data.rfind(b"\n", 0, i) + 1
            last = data.find(b"\n", i) + 1 or len(data)
            data = (
                data[:last] + data[first:last] * (what == 4) + data[last:] if what == 4 else data[:first] + data[last:]
            )
        elif what in (6, 7):  # a number becomes another
            k = i
            while k < len(data) and not 48 <= data[k] <= 57:
                k += 1
            end = k
            while end < len(data) and (48 <= data[end] <= 57 or data[end : end + 1] in b".-+eE"):
                end += 1
            data = data[:k] + NUMBERS[int(b * len(NUMBERS))].encode() + data[end:]
        else:
            data = data[:i] + data[j : j + 60] + data[i:]
    return data


def with_checksums(data: bytes) -> bytes:
    """An MCAP file whose chunks have the checksums of what is in them now."""
    out, place = bytearray(data), 8
    while place + 9 <= len(out):
        kind, size = out[place], struct.unpack_from("<Q", out, place + 1)[0]
        start, end = place + 9, place + 9 + size
        if end > len(out):
            break
        if kind == 0x06 and size > 40:
            words = struct.unpack_from("<I", out, start + 28)[0]
            first = start + 32 + words + 8
            if not words and first <= end:
                struct.pack_into("<I", out, start + 24, zlib.crc32(out[first:end]))
        elif kind == 0x0F and size == 4:
            struct.pack_into("<I", out, start, 0)  # of the data section: not given
        elif kind == 0x02 and size == 20:
            struct.pack_into("<I", out, start + 16, 0)  # of the summary: not given
        place = end
    return bytes(out)


def sentence_of(body: bytes) -> bytes:
    """An NMEA sentence with its checksum."""
    total = 0
    for byte in body:
        total ^= byte
    return b"$" + body + f"*{total:02X}\r\n".encode()


NMEA = (
    b"GNRMC,092750.00,A,5321.6802,N,00630.3372,W,120.00,090.00,221126,,,A",
    b"GNGST,092750.20,0.9,0.03,0.02,10.0,0.021,0.034,0.055",
    b"GNGGA,092750.20,5321.680200,N,00630.337200,W,4,18,0.8,61.7,M,55.2,M,1.0,0000",
    b"GNZDA,092750.00,22,11,2026,00,00",
    b"GNHDT,123.4,T",
    b"PASHR,092750.20,123.40,T,-0.83,+0.42,-0.01,0.029,0.024,0.059,2,1",
    b"GNGNS,092750.40,5321.680200,N,00630.337200,W,RRN,18,0.8,61.7,55.2,1.0,0000",
)
#: What `run_sentences` knows.
SENTENCES = ("NMEA", "driver records")
#: Files that other tests write, too, by name, and what they are.
OTHERS = {
    "track.gpx": "GPX",
    "ang20170323t202244_eph_att": "AVIRIS-NG poses",
    "f180522t01p00r07rdn_e_lonlat_eph": "AVIRIS-C poses",
    "pos.txt": "POS export",
    "explorer.txt": "Inertial Explorer poses",
    "camera.xml": "GLAS camera",
    "ties.xml": "GeoCal tie points",
    "imu_gps.txt": "Headwall poses",
    "flight.lcf": "Resonon poses",
}
#: Records of a driver.
RECORDS = (
    b"GNSS 1795339670000000000 47.9 11.1 1500 0.02 0.03 0.05\n",
    b"IMU 1795339670000000005 5000000 0.1 0.2 -9.8 0.01 0.02 0.03\n",
    b"ATTITUDE 1795339670000000006 0.01 0.02 1.5 0.001 0.001 0.002\n",
    b"LINES N S1 40 1795339670000000000 5000000 3 4 16\n" + bytes(range(24)),
)


#: The orientation of a frame image, and where a sensor was mounted.
FRAME = {
    "interior": {
        "focal_length_mm": 150.0, "pixel_size_mm": 0.007, "lines": 300, "samples": 400, "distortion": {"k1": 1e-5},
    },
    "exterior": {"lat_deg": 39.9, "lon_deg": 32.8, "height_m": 6.86e5, "omega_phi_kappa_deg": [3.0, -20.0, 12.0]},
    "sigma": {"position_m": [5.0, 5.0, 5.0], "attitude_deg": [0.001, 0.001, 0.002]},
}  # fmt: skip
#: Rows of Earth orientation in both forms of the IERS.
IERS_C04 = '# YR  MM  DD  HH       MJD        x(")        y(")  UT1-UTC(s)\n' + "".join(
    f"2025   1 {i:3d}   0  {60675 + i}.00    0.1{i:02d}000    0.3{i:02d}000   0.04{i:02d}000    0.000000\n"
    for i in range(1, 31)
)
IERS_FINALS = "".join(
    f"25 1{i:2d} {60675 + i}.00 {'I' if i < 20 else 'P'}  0.1352{i:02d} 0.000027  0.3053{i:02d} 0.000024  "
    f"{'I' if i < 20 else 'P'} 0.04253{i:02d} 0.0000088\n"
    for i in range(1, 31)
)
PLATFORM = """lever_arm_m = [0.1, 0.2, -1.0]
lever_arm_sigma_m = 0.02
boresight_deg = [0.1, 0, 0]
[imu]
grade = "tactical"
gyro_bias_deg_h = 1.0
[gnss]
wander_sigma_m = [0.01, 0.01, 0.02]
wander_time_s = 60
[initial]
roll_deg = 0
pitch_deg = 0
heading_deg = 90
"""


@dataclass(frozen=True)
class FileTarget:
    """A reader: the file that is changed, its good content, and how it is read.

    ``values_bytes`` is what the values of such a file may take, however small the file is: rasters leave out tiles.
    """

    name: str
    path: Path
    good: bytes
    read: Callable[[], Any]
    checked: Callable[[bytes], bytes] = bytes
    values_bytes: int = 0


def _read_all(path: Path, options: detect.Options | None = None) -> None:
    for _ in detect.read_any(path, detect.kind_of_path(path), options).messages:
        pass


def _recording(path: Path) -> None:
    reader = RecordingReader(path)
    for _ in reader.sorted_messages():
        pass


def _all_lines(open_image: Callable[[Path], ImageFile], path: Path) -> None:
    image = open_image(path)
    for band in range(min(image.bands, 4)):
        image.read(0, min(image.lines, 64), band)


def _terrain(path: Path) -> None:
    raster = HeightRaster([path], datum="ellipsoid")
    lat, lon = np.radians([47.95, 47.9]), np.radians([11.05, 11.1])
    raster.range_over(lat, lon)
    raster.at(lat, lon)


def file_targets(folder: Path) -> list[FileTarget]:
    """Every reader of files, with a small whole file of its kind each."""
    out: list[FileTarget] = []

    def whole(name: str, path: Path, read: Callable[[], Any], checked: Callable[[bytes], bytes] = bytes) -> None:
        out.append(FileTarget(name, path, path.read_bytes(), read, checked))

    sbet = write_sbet_file(folder)
    whole("SBET", sbet, partial(_read_all, sbet))
    accuracies = folder / "accuracies.out"  # with a name of its own, so that the SBET alone is read alone
    write_smrmsg(accuracies, np.fromfile(sbet, "<f8")[::17], np.full((50, 3), 0.05), np.full((50, 3), 1e-4))
    whole("SMRMSG", accuracies, partial(_read_all, sbet, detect.Options(accuracies=accuracies)))
    positions = folder / "day.pos"
    positions.write_text(rtklib_positions())
    whole("RTKLIB positions", positions, partial(_read_all, positions))
    small = folder / "small"
    small.mkdir()
    others = small_files(small)
    others["imu_gps.txt"] = ("\n".join([HEADWALL, *headwall_rows()]) + "\n").encode()
    others["flight.lcf"] = ("\n".join(lcf_rows()) + "\n").encode()
    for name, words in OTHERS.items():
        if name in others:
            (small / name).write_bytes(others[name])
            read = partial(read_glas_camera if words == "GLAS camera" else _read_all, small / name)
            whole(words, small / name, read)
    for name, write in (("Resonon line times", resonon), ("Headwall line times", headwall)):
        beside = folder / name
        beside.mkdir()
        times = write(beside)
        whole(name, times, partial(line_times, times, None, []))
    tiff = write_tiff(folder / "lines.tif", cube_of("u2"), compress="deflate")
    whole("TIFF lines", tiff, partial(_all_lines, open_tiff, tiff))
    image = write_image(folder / "lines.img", cube_of("u2"))
    whole("ENVI header", image.with_suffix(".hdr"), partial(_all_lines, open_envi, image))
    poses = folder / "poses.csv"
    poses.write_text(
        "time_s,lat_deg,lon_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
        + "".join(f"{i},48.{i},11,500,0,0,45\n" for i in range(20))
    )
    whole("trajectory CSV", poses, partial(_read_all, poses))
    bag = write_bag(folder / "bag", flight_of()) / "bag.mcap"
    whole("ROS 2 bag", bag, partial(_read_all, bag), with_checksums)
    recording = folder / "flight.mcap"
    with open(recording, "wb") as file:
        writer = RecordingWriter(file)
        for message in sample_messages.flight(0.5, lines=True):
            writer.write(message)
        writer.close()
    whole("recording", recording, partial(_recording, recording), with_checksums)
    block = write_files(folder / "block")
    for name in FILES:
        whole(f"block: {name}", block / name, partial(_read_all, block))
    whole("camera.json", block / "camera.json", partial(read_camera, block / "camera.json"))
    truth = Truth(lines=4000, samples=500)
    for name, path in (
        ("DIMAP 1", write_dimap1(folder / "dimap1.xml", truth)),
        ("DIMAP 2", write_dimap2(folder / "dimap2.xml", truth)),
        ("CSM ISD", write_isd(folder / "scene.json", truth)),
    ):
        whole(name, path, partial(read_scene, path))
    rpc = fit_to_model(read_scene(folder / "dimap2.xml").model("rigorous"), 0.0, 2000.0).rpc
    for name, path, write in (
        ("RPB", folder / "a.RPB", write_rpb),
        ("RPC text", folder / "a_RPC.TXT", write_rpc_text),
    ):
        write(path, rpc)
        whole(name, path, partial(read_scene, path))
    scene_folder = write_folder(folder / "scene", truth)
    for path in sorted(scene_folder.iterdir()):
        if path.is_file() and path.stat().st_size < 200_000:
            whole(f"scene folder: {path.name}", path, partial(read_scene, scene_folder))
    sensors = folder / "sensors"
    sensors.mkdir()
    (sensors / "imu.csv").write_text(
        "time_s,fx_m_s2,fy_m_s2,fz_m_s2,wx_rad_s,wy_rad_s,wz_rad_s\n"
        + "".join(f"{1 + 0.01 * i:.2f},0.1,0.2,-9.81,0.01,0.02,0.03\n" for i in range(60))
    )
    (sensors / "gnss.csv").write_text(
        "time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m\n"
        + "".join(f"{1 + 0.1 * i:.1f},48.0{i},11.0,500,0.1,0.1,0.2\n" for i in range(6))
    )
    for name in ("imu.csv", "gnss.csv"):
        whole(f"sensor folder: {name}", sensors / name, partial(_read_all, sensors))
    flight = folder / "flight"
    flight.mkdir()
    (flight / "flight.toml").write_text(
        '[flight]\nname = "f"\nplatform = "p"\ncrs = "EPSG:32632"\nvertical_datum = "ellipsoid"\n'
        '[camera]\nfile = "camera.json"\n[mounting]\nlever_arm_m = [0, 0, 0]\ncamera_lever_arm_m = [0, 0, 0]\n'
        'boresight_deg = [0, 0, 0]\n[navigation]\ngnss = "rtk"\nimu = "tactical"\n'
        '[[sensor]]\nkind = "nmea"\naddress = "udp://:4001"\nclock = "utc"\n'
    )
    (flight / "camera.json").write_text(FILES["camera.json"])
    whole("flight.toml", flight / "flight.toml", partial(read_flight, flight))
    (sensors / "platform.toml").write_text(PLATFORM)
    whole("platform.toml", sensors / "platform.toml", partial(_read_all, sensors))
    frame_file = folder / "frame.json"
    frame_file.write_text(json.dumps(FRAME))
    whole("frame.json", frame_file, partial(read_frame, frame_file, []))
    z = np.linspace(500.0, 600.0, 900).reshape(30, 30)
    heights, model = folder / "heights.tif", folder / "model.tif"
    for path in (heights, model):
        write_heights(path, Heights("EPSG:4326", z, 11.0, 48.0, 0.01, -0.01))
    whole("height raster", heights, partial(_terrain, heights))
    read = partial(read_dem, model, "ellipsoid")
    out.append(FileTarget("elevation model", model, model.read_bytes(), read, values_bytes=2 * 8 * MOST_HEIGHTS))
    tags = folder / "tags.tif"
    with rasterio.open(
        tags, "w", "GTiff", 60, 50, 1, "EPSG:4326", from_bounds(11, 48, 12, 49, 60, 50), "uint8"
    ) as image:
        image.rpcs = rasterio_rpc(rpc)
    whole("RPC tags", tags, partial(read_rpc_tags, tags))
    for name, text, read in (("IERS C04", IERS_C04, read_c04), ("IERS finals2000A", IERS_FINALS, read_finals)):
        path = folder / f"{name}.txt"
        path.write_text(text)
        whole(name, path, partial(read, path))
    settings_file = folder / "nodes.toml"
    settings_file.write_text('[adjuster]\nmodel = "wander"\nupdate_s = 0.2\n[matcher]\npace = "load"\n')
    whole("nodes.toml", settings_file, partial(config.load, settings_file))
    return out


def run_files(target: FileTarget, campaign: Campaign, cases: int, number: int, until: float) -> None:
    """Read so many changed files, or until a time (`time.process_time`)."""

    def case(edits: list[tuple[int, float, float, bytes]]) -> None:
        if time.process_time() > until:
            raise _Over
        data = target.checked(edited(target.good, edits))
        target.path.write_bytes(data)
        campaign.run(target.name, data, target.read, max(len(target.good), target.values_bytes // MEMORY_TIMES))

    target.read()  # what a reader imports is not the memory of a file
    try:
        _repeat(case, [EDITS], campaign, target.name, cases, number)
    finally:
        target.path.write_bytes(target.good)


def run_sentences(name: str, campaign: Campaign, cases: int, number: int, until: float) -> None:
    """Sentences whose fields are changed, many in a row into one parser; NMEA's with right checksums and with others.

    The other name is that of records of a driver.
    """
    good = NMEA if name == "NMEA" else RECORDS
    parser = _parser(name)

    def case(body: bytes, edits: list[tuple[int, float, float, bytes]], right: bool) -> None:
        nonlocal parser
        if time.process_time() > until:
            raise _Over
        data = edited(body, edits)
        if name == "NMEA":
            data = data.replace(b"\n", b" ")
            data = sentence_of(data) if right else b"$" + data + b"*00\r\n"
        whole = campaign.run(name, data, lambda: list(parser.feed(data)))
        if not whole or campaign.cases[name] % 50 == 0:  # records may announce pixels that never come
            parser = _parser(name)

    _repeat(case, [st.sampled_from(good), EDITS, st.booleans()], campaign, name, cases, number)


def _parser(name: str) -> Any:
    keys = Keys(Path("flight.toml"), {"address": "udp://:4001"}, "sensor[0]")
    if name == "NMEA":
        return NmeaParser(NmeaSettings.read(keys, Path()), lambda kind, text: None)
    return StreamParser(Clock(), lambda kind, text: None)


# ---- messages


def changed(body: Any, changes: list[tuple[int, int, Any]]) -> Any:
    """A copy of a message with some of its fields changed, in whatever depth."""
    copy = type(body)()
    copy.CopyFrom(body)
    for what, which, value in changes:
        _change(copy, what, which, value)
    return copy


def _change(body: Any, what: int, which: int, value: Any) -> None:
    fields = body.DESCRIPTOR.fields
    if not fields:
        return
    f = fields[which % len(fields)]
    many = not isinstance(getattr(body, f.name), (int, float, str, bytes, bool)) and not hasattr(
        getattr(body, f.name), "DESCRIPTOR"
    )
    try:
        if what == 0:
            body.ClearField(f.name)
        elif many:
            values = getattr(body, f.name)
            if what == 1 and len(values):
                del values[-1]
            elif f.message_type is not None:
                if len(values):
                    _change(values[which % len(values)], what, which // 2, value)
                elif hasattr(values, "add"):
                    values.add()
            elif what == 2:
                values.extend(list(values) or [_as(f, value)])
            elif len(values):
                values[which % len(values)] = _as(f, value)
            else:
                values.append(_as(f, value))
        elif f.message_type is not None:
            _change(getattr(body, f.name), what, which // 2, value)
        else:
            setattr(body, f.name, _as(f, value))
    except (ValueError, TypeError, OverflowError):
        pass  # protobuf does not take the value


def _as(f: Any, value: Any) -> Any:
    """The value in the type of a field."""
    kind = f.cpp_type
    if kind in (f.CPPTYPE_DOUBLE, f.CPPTYPE_FLOAT):
        return float(value)
    if kind == f.CPPTYPE_STRING:
        return {0.0: "", -1.0: "\x1b[2J[/b]", 1e18: "x" * 5000}.get(value, "S1")
    if f.type == f.TYPE_BYTES:
        return b"\xff" * 7
    if kind == f.CPPTYPE_BOOL:
        return bool(value == value and value > 0)
    return int(value) if value == value and abs(value) < 1e19 else 0


class _Picture(Node):
    """The scene of the viewer on a canvas that keeps nothing, drawn after every 20 messages."""

    name = "viewer"
    inputs = scene.TOPICS + scene.TRUTH_TOPICS
    outputs = ()

    def __init__(self) -> None:
        super().__init__()
        self._scene, self._taken = scene.Scene(NullCanvas()), 0

    def step(self, message: Message) -> Iterable[Message]:
        with suppress(Exception):  # the viewer counts them and goes on
            self._scene.take(message)
        self._taken += 1
        if self._taken % 20 == 0:
            self._scene.draw()
        return ()

    def finish(self) -> Iterable[Message]:
        self._scene.close()
        return ()


def node_names() -> list[str]:
    return [*registry.STEP_NODES, "monitor", "viewer"]


def _made(name: str) -> Any:
    if name == "monitor":
        from triline.nodes.monitor.monitor import Monitor

        return Monitor()
    if name == "viewer":
        return _Picture()
    return registry.node_class(name)()


@cache
def flown() -> tuple[Message, ...]:
    """A small flight with image lines, and what navigator, matcher and adjuster make of it, in the order of stamps."""
    small = simulated_flight({**SETTINGS, "seconds": 5.0})
    drivers = [StepDriver(_made(name)) for name in ("navigator", "matcher", "adjuster")]
    out: list[Message] = []

    def give(message: Message) -> None:
        out.append(message)
        for driver in drivers:
            if any(_matches(name, message.topic) for name in driver.inputs):
                for made in driver.step(message):
                    give(made)

    for message in Simulator(small.simulation, small.imager).messages(sample_messages.EPOCH_NS):
        give(message)
    return tuple(out)


class NodeTarget:
    """A node behind all that stands before it live: decoding, the check of its streams, voices, the driver.

    It gets a flight of which most messages are as they should be; a new node is made for each turn of it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._inputs = StepDriver(_made(name)).inputs
        self._flight = [x for x in flown() if self._takes(x.topic)]
        self._others = [t for t in sample_messages.names() if self._takes(t)]
        self._place = 0
        self._begin()

    def _takes(self, topic: str) -> bool:
        return any(_matches(name, topic) for name in self._inputs)

    def _begin(self) -> None:
        self.node = _made(self.name)
        self._driver = StepDriver(self.node)
        self._check: StreamCheck[Message] = StreamCheck()
        self._numbers: Counter[tuple[str, str]] = Counter()
        self._failed = 0

    def _give(self, message: Message, by_s: float, number: int) -> None:
        key = message.topic, message.source
        self._numbers[key] += number
        envelope = Envelope(message.stamp_ns + round(by_s * 1e9), message.source, self._numbers[key], 1)
        try:
            body = codec.decode(message.topic, codec.encode(message.body))
        except ValueError:
            return  # the bus drops it, and counts it
        sent = Message(message.topic, envelope.stamp_ns, body, message.source, envelope.sequence, 1)
        for passed in self._check.accept(message.topic, envelope, sent):
            self._driver.step(passed)
        self._judge()

    def _judge(self) -> None:
        failed = self.node.counters["failed"]
        if failed > self._failed:
            self._failed = failed
            raise AssertionError(f"the node failed inside: {self.node.last_problem}")

    def _finish(self) -> None:
        self._driver.finish()
        self._judge()

    def case(self, campaign: Campaign, which: int, changes: list, order: tuple[int, float, int]) -> None:
        """The next message of the flight, or one of another topic before it, with some changes."""
        skipped, by_s, number = order
        if which < 5:  # something that does not belong here
            message = sample_messages.message(self._others[skipped % len(self._others)], self._place)
        else:
            if self._place >= len(self._flight):
                campaign.run(self.name, b"the end", self._finish, 1_000_000, quiet=True)
                self._place = 0
                self._begin()
            message = self._flight[self._place]
            self._place += 1 if which < 45 else skipped
        body = message.body
        if abs(by_s) > 60.0 and not message.topic.startswith(("sensor/", "observation/")):
            by_s = 0.0  # live the sequencer holds what leaps
        if which >= 15 and which < 45:
            by_s, number = 0.0, 1
        elif isinstance(body, LineBlock):
            body = sample_messages.line_block(skipped, width=int(min(abs(changes[0][1]), 999)) + 1) if changes else body
        else:
            body = changed(body, changes)
        sent = Message(message.topic, message.stamp_ns, body, message.source or "test")
        example = f"{message.topic} {str(body)[:1500]}".encode()
        if not campaign.run(self.name, example, lambda: self._give(sent, by_s, number), 1_000_000, quiet=True):
            self._place = 0
            self._begin()


def _matches(name: str, topic: str) -> bool:
    return name == topic or (name.endswith("*") and topic.startswith(name[:-1]))


def run_node(name: str, campaign: Campaign, cases: int, number: int, until: float) -> None:
    """Give a node so many messages, some as they should be and most not; many to an example of hypothesis."""
    target = NodeTarget(name)
    of_one = st.tuples(st.integers(0, 50), CHANGES, ORDER)

    def case(messages: list) -> None:
        for which, changes, order in messages * TURNS:  # at other places of the flight
            if time.process_time() > until:
                raise _Over
            target.case(campaign, which, changes, order)

    messages = st.lists(of_one, min_size=MESSAGES, max_size=MESSAGES)
    _repeat(case, [messages], campaign, name, cases, number, MESSAGES * TURNS)


def _repeat(
    case: Callable[..., None],
    drawn: list[st.SearchStrategy],
    campaign: Campaign,
    name: str,
    cases: int,
    number: int,
    each: int = 1,
) -> None:
    """Draw examples, of so many cases each, until there are so many cases or the time is over."""
    end = campaign.cases[name] + cases
    try:
        for k in count():
            before = campaign.cases[name]
            if before >= end:
                return
            examples = min(EXAMPLES, -(-(end - before) // each))
            seed(1000 * number + k)(_settings(examples)(given(*drawn)(case)))()
            if campaign.cases[name] == before:
                return
    except _Over:
        pass


def in_a_process(campaign: Campaign, name: str, work: Work, cases: int, number: int, seconds: float) -> None:
    """Work on a target in a process with bounded memory; one that dies is a finding, and the next one goes on.

    Parameters
    ----------
    campaign : what was done is added to it
    cases, number : of the target, and the seed
    seconds : processor time of one process at most
    """
    fork = multiprocessing.get_context("fork")  # the flight that nodes are given is there already
    note = mmap(-1, 12 + NOTE_BYTES)
    end = campaign.cases[name] + cases
    for attempt in range(TRIES):
        _write_note(note, 0, b"")
        receiver, sender = fork.Pipe(duplex=False)
        left, other = end - campaign.cases[name], number + 7919 * attempt
        process = fork.Process(target=_work, args=(sender, note, work, left, other, seconds))
        process.start()
        sender.close()
        try:
            done = receiver.recv()
        except EOFError:
            process.join()
            done = None
        process.join()
        if done is not None:
            campaign.add(done)
            return
        dead = Campaign(note=note)
        code = process.exitcode or 0
        dead.died(name, signal.Signals(-code).name if code < 0 else f"exit {code}")
        campaign.add(dead)


def _work(sender: Connection, note: mmap, work: Work, cases: int, number: int, seconds: float) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    campaign = Campaign(note=note)
    work(campaign, cases, number, seconds)  # the processor time of a process begins at 0
    campaign.note = None
    sender.send(campaign)


def _settings(cases: int) -> settings:
    return settings(
        max_examples=max(1, cases),
        database=None,
        deadline=None,
        phases=[Phase.generate],
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
