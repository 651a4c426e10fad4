"""ENVI images and cameras written byte by byte, for tests of their readers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12}
ORDER = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}


def write_image(path: Path, cube: np.ndarray, interleave="bil", big=False, offset=0, **header) -> Path:
    """An ENVI image of a cube (lines, samples, bands), and its header."""
    kind = cube.dtype.str[1:]
    data = np.transpose(cube, ORDER.get(interleave, (0, 2, 1))).astype((">" if big else "<") + kind)
    path.write_bytes(b"\xee" * offset + data.tobytes())
    keys = {
        "samples": cube.shape[1], "lines": cube.shape[0], "bands": cube.shape[2], "header offset": offset,
        "file type": "ENVI Standard", "data type": CODES[kind], "interleave": interleave, "byte order": int(big),
    } | header  # fmt: skip
    text = "".join(f"{key} = {value}\n" for key, value in keys.items() if value is not None)
    path.with_suffix(".hdr").write_text("ENVI\ndescription = {\n  a test }\n" + text)
    return path


def write_camera(path: Path, pixels=7) -> Path:
    lens = {"id": "L", "focal_length_mm": 60.0, "principal_point_mm": [0, 0]}
    line = {"lens": "L", "pixels": pixels, "pixel_size_mm": 0.0065}
    lines = [{"id": id, "center_mm": [x, 0], **line} for id, x in (("F", 20.0), ("N", 0.0), ("B", -20.0))]
    path.write_text(json.dumps({"name": "c", "lenses": [lens], "lines": lines}))
    return path
