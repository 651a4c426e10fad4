"""GeoCal's XML archives (boost serialization): the fitted AVIRIS-NG camera and tie points between strips."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.camera.line_camera import CcdLine, Lens, LineCamera
from ..errors import UserError

_CAMERA, _TIES = "GeoCal::GlasGfmCamera", "GeoCal::TiePointCollection"


@dataclass(frozen=True)
class TiePoints:
    """Tie points measured in several images; n points, k images.

    Attributes
    ----------
    line, sample : (n, k) pixels, NaN where a point was not measured
    sigma_line, sigma_sample : (n, k) pixels
    position_e : (n, 3) approximate ground point, Earth-fixed, metres
    is_control : (n,) whether the ground point is known
    """

    line: NDArray[np.float64] = field(repr=False)
    sample: NDArray[np.float64] = field(repr=False)
    sigma_line: NDArray[np.float64] = field(repr=False)
    sigma_sample: NDArray[np.float64] = field(repr=False)
    position_e: NDArray[np.float64] = field(repr=False)
    is_control: NDArray[np.bool_] = field(repr=False)

    def __len__(self) -> int:
        return len(self.line)


def kind_of(path: Path) -> str | None:
    """ "camera", "ties", or None for an XML file of another kind."""
    with open(path, encoding="utf-8", errors="replace") as file:
        head = file.read(2048)
    if "boost_serialization" not in head:
        return None
    return "camera" if _CAMERA in head else "ties" if _TIES in head else None


def read_glas_camera(path: Path, notes: list[str] | None = None) -> LineCamera:
    """The camera of a GLAS/GFM archive as a look-up table.

    Its field alignment holds, for each pair of neighbouring samples, where the two look: x and y in mm on the focal
    plane at the focal length given, x forward, y to the right. Our y points to the left, so its sign turns.

    Raises
    ------
    UserError : a file of another kind, damaged, or with field angles of another type
    """
    body = _body(path, _CAMERA)
    focal_length = _number(path, body, "focal_length/val")
    samples = int(_number(path, body, "number_sample"))
    if int(_number(path, body, "field_angle_type")) != 0 or int(_number(path, body, "number_line")) != 1:
        raise UserError(f"{path}: field_angle_type, number_line: wanted 0 (mm on the focal plane) and 1 line")
    step = _number(path, body, "delta_sample_pair")
    first = _number(path, body, "sample_number_first")
    rows, cols = (int(_number(path, body, f"field_alignment/{name}")) for name in ("rows", "cols"))
    values = _numbers(path, body, "field_alignment/data/item")
    if cols != 4 or len(values) != rows * cols or rows < 1:
        raise UserError(f"{path}: field_alignment: {len(values)} values in {rows} x {cols}, wanted rows of 4")
    pairs = values.reshape(rows, 2, 2)
    places = np.concatenate([pairs[:, 0], pairs[-1:, 1]])  # where sample first + i step looks
    at = (np.arange(samples) - first) / step
    if samples < 2 or at[0] < 0 or at[-1] > rows:
        raise UserError(f"{path}: field_alignment: {rows} pairs do not cover {samples} samples")
    x, y = (np.interp(at, np.arange(rows + 1), places[:, i]) for i in range(2))
    if not focal_length > 0:
        raise UserError(f"{path}: focal_length: {focal_length:g}, wanted a number above 0")
    pitch = float(np.hypot(np.diff(x), np.diff(y)).mean())
    if not 0.1e-3 < pitch < 1.0:
        raise UserError(f"{path}: field_alignment: mean pixel pitch {pitch:g} mm, which no CCD has")
    if notes is not None:
        angle = np.degrees(np.arctan2(-y[[0, -1]], focal_length))
        notes.append(
            f"{path.name}: {samples} samples, mean pitch {pitch * 1000:.2f} um, "
            f"field {angle[0]:.2f} to {angle[1]:.2f} deg (left positive)"
        )
    line = CcdLine("N", "L1", np.column_stack([x, -y]))
    return LineCamera(path.stem, (Lens("L1", focal_length),), (line,))


def read_tie_points(path: Path) -> TiePoints:
    """Tie points of a GeoCal collection.

    Raises
    ------
    UserError : a file of another kind, or damaged
    """
    body = _body(path, _TIES)
    items = body.findall("TiePointVector/item")
    said = int(_number(path, body, "TiePointVector/count"))
    if len(items) != said or not items:
        raise UserError(f"{path}: {len(items)} tie points, but the file says {said}; truncated?")
    points, control, images, sigmas = [], [], [], []
    for number, item in enumerate(items, 1):
        what = f"tie point {number}"
        px = item.find("px")
        if px is None:
            raise UserError(f"{path}: {what}: empty")
        points.append(_numbers(path, px, "ground_location/px/CartesianFixed/position/elems/item", 3, what))
        control.append(_number(path, px, "is_gcp", what) != 0)
        looks = []
        for look in px.findall("ic/item"):
            if look.find("px/line") is None:
                looks.append((np.nan, np.nan))
            else:
                looks.append((_number(path, look, "px/line", what), _number(path, look, "px/sample", what)))
        images.append(looks)
        sigmas.append([_numbers(path, px, f"{n}_sigma/data/item", len(looks), what) for n in ("line", "sample")])
    if len({len(looks) for looks in images}) != 1:
        raise UserError(f"{path}: tie points in different numbers of images")
    places, sigma = np.array(images), np.array(sigmas)
    return TiePoints(
        places[:, :, 0], places[:, :, 1], sigma[:, 0], sigma[:, 1], np.array(points), np.array(control, dtype=bool)
    )


def _body(path: Path, wanted: str) -> ET.Element:
    try:
        root = ET.parse(path).getroot()
    except LookupError as error:  # an encoding that there is not
        raise UserError(f"{path}:1: {error}, wanted XML in UTF-8 or another that is known") from None
    except ET.ParseError as error:
        line = error.position[0]
        raise UserError(f"{path}:{line}: not well-formed XML ({error}); truncated?") from None
    body = root.find(".//px[@class_name]")
    if root.tag != "boost_serialization" or body is None or body.get("class_name") != wanted:
        found = body.get("class_name") if body is not None else f"<{root.tag}>"
        raise UserError(f"{path}: {found}, wanted a boost archive with {wanted}")
    return body


def _number(path: Path, element: ET.Element, name: str, where: str = "") -> float:
    found = element.find(name)
    text = "" if found is None or found.text is None else found.text
    return _value(path, text, f"{where}: {name}" if where else name)


def _value(path: Path, text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UserError(f"{path}: {name}: {text!r}, wanted a number" if text else f"{path}: {name}: missing") from None
    if not np.isfinite(value):
        raise UserError(f"{path}: {name}: {text}, wanted a number")
    return value


def _numbers(
    path: Path, element: ET.Element, name: str, count: int | None = None, where: str = ""
) -> NDArray[np.float64]:
    values = [_value(path, found.text or "", f"{where}: {name}" if where else name) for found in element.findall(name)]
    if count is not None and len(values) != count:
        raise UserError(f"{path}: {where}: {name}: {len(values)} values, wanted {count}")
    return np.array(values)
