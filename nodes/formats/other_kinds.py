"""What a file is that is neither a recording nor becomes one, and which command reads it."""

from __future__ import annotations

import re
from pathlib import Path

from .byte_order_mark import without_mark
from .frame_json import is_frame_json
from .line_time_files import is_frame_index

#: Bytes of a file that are looked at.
_HEAD = 1 << 16
#: Files of folders -> what they are.
PARTS = {
    "flight.toml": "settings of a flight folder",
    "project.toml": "settings of a block folder",
    "platform.toml": "settings of a sensor folder",
    "imu.csv": "inertial samples of a sensor folder",
    "gnss.csv": "fixes of a sensor folder",
    "attitude.csv": "attitudes of a sensor folder",
    "strips.csv": "strips of a block folder",
    "ground_points.csv": "known points of a block folder",
    "image_points.csv": "image points of a block folder",
}
#: Files that a folder of a satellite scene has.
_SCENE_FOLDER = ("ephemeris.csv", "line_times.csv")
#: How compressed files begin -> their name.
_PACKED = {
    b"\x1f\x8b": "gzip",
    b"PK\x03\x04": "ZIP",
    b"\x28\xb5\x2f\xfd": "Zstandard",
    b"\xfd7zXZ\0": "xz",
    b"7z\xbc\xaf\x27\x1c": "7-Zip",
}


def other_kind(path: Path) -> str | None:
    """What a file or folder seems to be, and which command wants it, in words that follow its name; else None."""
    if all((path / name).is_file() for name in _SCENE_FOLDER):
        return _scene("folder of a satellite scene")
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        head = without_mark(file.read(_HEAD))
    suffix, name = path.suffix.lower(), path.name
    for begin, packed in _PACKED.items():
        if head.startswith(begin):
            return f"packed ({packed}), which has to be unpacked first"
    if is_frame_json(path):
        return "orientation of a frame camera's image, which `triline rectify --sensor` and `triline locate` read"
    if suffix in (".json", ".isd") or head.lstrip().startswith(b"{"):
        return _of_json(head)
    if suffix in (".rpb", ".geom") or name.upper().endswith("_RPC.TXT") or b"LINE_OFF" in head.upper():
        return _scene("rational polynomials of a satellite scene")
    if b"dimap_document" in head[:512].lower() or b"<isd>" in head[:512].lower():
        return _scene("metadata of a satellite scene")
    if suffix == ".times" or is_frame_index(path):
        return "times of image lines, which `triline import` finds beside their image, or takes by --line-times"
    if re.search(rb"\$[A-Z]{2}(GGA|RMC|ZDA),", head):
        return (
            'NMEA of a receiver, which `triline fly` reads: a [[sensor]] of kind = "nmea" in a flight.toml, '
            'with address = "file:NAME"'
        )
    if re.search(rb"Program:\s+(Inertial Explorer|GrafNav)", head):
        return (
            "text of Inertial Explorer or GrafNav without a row of names (Latitude, Longitude, H-Ell, Roll, Pitch, "
            "Heading, Week, GPSTime) and a row of their units; wanted an export with both"
        )
    if name in PARTS:
        return f"{PARTS[name]}, which is given as a whole"
    return None


def _of_json(head: bytes) -> str | None:
    if b'"lenses"' in head and b'"lines"' in head:
        return (
            "a line camera (camera.json), which lies in the folder of a block or flight, "
            "or stands behind --camera of `triline import`, `process` and `adjust`"
        )
    if b'"name_model"' in head:
        return _scene("metadata of a satellite scene (community sensor model)")
    if b'"FeatureCollection"' in head:
        return "GeoJSON, which triline writes and does not read"
    return None


def _scene(what: str) -> str:
    """What is said of metadata of a scene."""
    return (
        f"{what}, which `triline locate` and `rectify --sensor` read; "
        "`triline new scenes` makes a block of scenes for `triline adjust`"
    )
