"""Rational polynomials in files: tags of a GeoTIFF, .RPB and XML of Maxar, _RPC.TXT, DIMAP and OSSIM .geom.

Pixels. RPC00B files (GeoTIFF, RPB, XML of Maxar, _RPC.TXT, geom) count lines and samples from 0 at the centre of the
first pixel, as triline does (rasterio's ``rowcol`` counts from the corner and is half a pixel more). DIMAP 2 counts
rows and columns from 1, DIMAP 3 (Pleiades Neo) from 0. Where the polynomials hold may be wider than the image, whose
size the file of the scene beside them tells; without that file it is the size of the image where it begins with the
first pixel.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....solver.location.rpc import RationalFunctions, Rpc
from ...errors import UserError
from ..new_file import new_file
from ..raster_open import open_raster
from .xml_file import Element, float_of, read_xml

#: RPC00B names of offsets and scales, in the order longitude, latitude, height, sample, line.
_NAMES = ("LONG", "LAT", "HEIGHT", "SAMP", "LINE")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?"
#: Names in an .RPB file.
_RPB = {"LINE": "line", "SAMP": "samp", "LAT": "lat", "LONG": "long", "HEIGHT": "height"}


def checked(path: Path, rpc: Rpc) -> Rpc:
    """The polynomials, if their denominators stay on one side of zero.

    Raises
    ------
    UserError : they do not
    """
    smallest = rpc.to_image.smallest_denominator()
    if not smallest > 0:
        names = ("sample", "line")
        which = [name for k, name in enumerate(names) if not _single(rpc.to_image, k).smallest_denominator() > 0]
        raise UserError(
            f"{path}: RPC: the denominator of the {' and of the '.join(which)} passes zero inside the box of "
            "longitude, latitude and height, wanted one above zero"
        )
    return rpc


def _single(functions: RationalFunctions, k: int) -> RationalFunctions:
    c = np.repeat(functions.coefficients[2 * k : 2 * k + 2][None], 2, axis=0).reshape(4, 20)
    return RationalFunctions(c, functions.in_offset, functions.in_scale, functions.out_offset, functions.out_scale)


def _rpc(path: Path, values: dict[str, float], lists: dict[str, NDArray[np.float64]], lines: int, samples: int) -> Rpc:
    """An RPC from values and lists by their RPC00B names."""
    offset, scale = (np.array([values[f"{name}_{what}"] for name in _NAMES]) for what in ("OFF", "SCALE"))
    coefficients = np.stack(
        [lists[name] for name in ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")]
    )
    try:
        functions = RationalFunctions(coefficients, offset[:3], scale[:3], offset[3:], scale[3:])
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    bias, random = values.get("ERR_BIAS", 0.0), values.get("ERR_RAND", 0.0)
    return checked(path, Rpc(functions, None, lines, samples, max(bias, 0.0), max(random, 0.0)))


def read_rpc_tags(path: Path) -> Rpc:
    """RPC of an image: tags of the GeoTIFF, or a file beside it that GDAL knows.

    Raises
    ------
    UserError : no image, or one without RPC
    """
    from rasterio.errors import RasterioError

    try:
        with open_raster(path) as image:
            tags, lines, samples = image.rpcs, image.height, image.width
    except (RasterioError, ValueError) as error:  # the words of a tag may be no numbers
        raise UserError(f"{path}: cannot be read as an image: {' '.join(str(error).split())}") from None
    if tags is None:
        raise UserError(f"{path}: an image without RPC, wanted RPC tags or a file .RPB or _RPC.TXT beside it")
    values = {
        "LONG_OFF": tags.long_off, "LAT_OFF": tags.lat_off, "HEIGHT_OFF": tags.height_off, "SAMP_OFF": tags.samp_off,
        "LINE_OFF": tags.line_off, "LONG_SCALE": tags.long_scale, "LAT_SCALE": tags.lat_scale,
        "HEIGHT_SCALE": tags.height_scale, "SAMP_SCALE": tags.samp_scale, "LINE_SCALE": tags.line_scale,
        "ERR_BIAS": tags.err_bias or 0.0, "ERR_RAND": tags.err_rand or 0.0,
    }  # fmt: skip
    lists = {
        "SAMP_NUM_COEFF": np.array(tags.samp_num_coeff), "SAMP_DEN_COEFF": np.array(tags.samp_den_coeff),
        "LINE_NUM_COEFF": np.array(tags.line_num_coeff), "LINE_DEN_COEFF": np.array(tags.line_den_coeff),
    }  # fmt: skip
    return _rpc(path, values, lists, lines, samples)


def read_rpb(path: Path) -> Rpc:
    """An ``.RPB`` file (``lineOffset = 123;``, lists in brackets).

    Raises
    ------
    UserError : a key that is missing or has no sense
    """
    text = _text(path)
    found: dict[str, str] = {}
    for name, value in re.findall(r"(\w+)[ \t]*=[ \t]*(\([^)]*\)|[^;\r\n]*)", text):
        found.setdefault(name.lower(), value)
    if "RPC00A" in found.get("specid", "").upper():
        raise UserError(f"{path}: SpecId: {found['specid']}, wanted RPC00B (the order of terms)")
    values: dict[str, float] = {}
    for name in _NAMES:
        for what, word in (("OFF", "Offset"), ("SCALE", "Scale")):
            values[f"{name}_{what}"] = _value(path, found, f"{_RPB[name]}{word}")
    for name, key in (("ERR_BIAS", "errbias"), ("ERR_RAND", "errrand")):
        if key in found:
            values[name] = _value(path, found, key)
    lists = {}
    for name in ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF"):
        axis, part, _ = name.split("_")
        key = f"{_RPB[axis]}{part.title()}Coef"
        if key.lower() not in found:
            raise UserError(f"{path}: {key}: missing, wanted 20 numbers")
        numbers = [float_of(word) for word in re.findall(_NUMBER, found[key.lower()])]
        if len(numbers) != 20:
            raise UserError(f"{path}: {key}: {len(numbers)}, wanted 20 numbers")
        lists[name] = np.array(numbers)
    return _rpc(path, values, lists, 0, 0)


def read_maxar_rpc(root: Element) -> Rpc:
    """The XML of a WorldView scene (root ``isd``), which has what an ``.RPB`` has under other names.

    Raises
    ------
    UserError : an element that is missing or has no sense
    """
    rpb = root.need("RPB", "rational polynomials")
    if rpb.find("SPECID") is not None and rpb.text("SPECID").upper() != "RPC00B":
        raise rpb.refuse("SPECID", "RPC00B (the order of terms)", rpb.text("SPECID"))
    image = rpb.need("IMAGE", "offsets, scales and coefficients")
    values = {
        f"{name}_{short}": image.number(f"{name}{word}")
        for name in _NAMES
        for short, word in (("OFF", "OFFSET"), ("SCALE", "SCALE"))
    }
    values |= {key: image.number(key.replace("_", ""), default=0.0) for key in ("ERR_BIAS", "ERR_RAND")}
    lists = {}
    for name in ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF"):
        tag = name.removesuffix("F").replace("_", "")
        lists[name] = image.numbers(f"{tag}List/{tag}", 20)
    size = root.find("IMD")
    lines, samples = (0, 0) if size is None else (size.integer("NUMROWS", low=1), size.integer("NUMCOLUMNS", low=1))
    return _rpc(root.path, values, lists, lines, samples)


def _value(path: Path, found: dict[str, str], key: str) -> float:
    if key.lower() not in found:
        raise UserError(f"{path}: {key}: missing, wanted a number")
    try:
        value = float_of(found[key.lower()].strip())
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise UserError(f"{path}: {key}: {found[key.lower()]!r}, wanted a number")
    return value


def read_rpc_text(path: Path) -> Rpc:
    """``_RPC.TXT`` (``LINE_OFF: 123 pixels``, ``LINE_NUM_COEFF_1: ..``) or OSSIM ``.geom`` (``line_num_coeff_00: ..``).

    Raises
    ------
    UserError : a key that is missing or has no sense
    """
    found: dict[str, str] = {}
    for line in _text(path).splitlines():
        key, *value = re.split("[:=]", line, maxsplit=1)
        if value:
            found.setdefault(key.strip().lower(), value[0].strip())
    first = found.get("polynomial_format", "B").upper()
    if first != "B":
        raise UserError(f"{path}: polynomial_format: {first!r}, wanted B (the order of terms of RPC00B)")

    def number(*keys: str) -> float:
        for key in keys:
            if key in found:
                word = found[key].split()
                try:
                    value = float_of(word[0])
                except (ValueError, IndexError):
                    value = float("nan")
                if not np.isfinite(value):
                    raise UserError(f"{path}: {key}: {found[key]!r}, wanted a number")
                return value
        raise UserError(f"{path}: {keys[0]}: missing, wanted a number")

    values = {f"{n}_{w}": number(f"{n}_{w}".lower()) for n in _NAMES for w in ("OFF", "SCALE")}
    for name, key in (("ERR_BIAS", "bias_error"), ("ERR_RAND", "rand_error")):
        if name.lower() in found or key in found:
            values[name] = number(name.lower(), key)
    base = 0 if "line_num_coeff_00" in found else 1
    lists = {}
    for name in ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF"):
        keys = [(f"{name.lower()}_{k + base:02d}", f"{name.lower()}_{k + base}") for k in range(20)]
        lists[name] = np.array([number(*key) for key in keys])
    lines = int(number("number_lines")) if "number_lines" in found else 0
    samples = int(number("number_samples")) if "number_samples" in found else 0
    return _rpc(path, values, lists, lines, samples)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file, wanted RPC as text") from None


#: Where a DIMAP document has its polynomials: in a file of their own, and in that of the scene.
_DIMAP_PLACES = ("Rational_Function_Model/Global_RFM", "Geoposition/Rational_Sensor_Model/Global_RFM")
#: Names of the polynomials in DIMAP 2 and 3.
_DIMAP_TO_IMAGE, _DIMAP_TO_GROUND = ("Inverse_Model", "GroundtoImage_Values"), ("Direct_Model", "ImagetoGround_Values")


def has_dimap_rpc(root: Element) -> bool:
    """Whether a DIMAP document has rational polynomials."""
    return root.find(*_DIMAP_PLACES) is not None


def read_dimap_rpc(root: Element, lines: int = 0, samples: int = 0) -> Rpc:
    """RPC of a DIMAP document: a file of its own (``Rational_Function_Model``) or a part of the scene's.

    Raises
    ------
    UserError : an element that is missing or has no sense
    """
    model = root.need(_DIMAP_PLACES[0], "rational polynomials", *_DIMAP_PLACES[1:])
    validity = model.find("RFM_Validity")
    first = 0.0 if model.find(_DIMAP_TO_IMAGE[1]) is not None else 1.0  # of DIMAP 3, of DIMAP 2
    to_image = _dimap_functions(model, validity, first, inverse=True)
    to_ground = None
    if model.find(*_DIMAP_TO_GROUND) is not None:
        to_ground = _dimap_functions(model, validity, first, inverse=False)
    if not lines:
        lines, samples = _size_beside(root.path)
    if not lines and validity is not None:
        domain = validity.find("ImagetoGround_Validity_Domain", "Direct_Model_Validity_Domain")
        if domain is not None and all(domain.number(f"FIRST_{axis}") == first for axis in ("COL", "ROW")):
            samples, lines = (int(domain.number(f"LAST_{axis}") - first) + 1 for axis in ("COL", "ROW"))
    return checked(root.path, Rpc(to_image, to_ground, lines, samples))


def _size_beside(path: Path) -> tuple[int, int]:
    """Rows and columns by the file of the scene, ``DIM_a.XML`` beside ``RPC_a.XML``; 0 and 0 where there is none."""
    scene = path.with_name(f"DIM_{path.name[4:]}")
    if not path.name.upper().startswith("RPC_") or not scene.is_file():
        return 0, 0
    size = read_xml(scene).find("Raster_Data/Raster_Dimensions")
    return (0, 0) if size is None else (size.integer("NROWS", low=1), size.integer("NCOLS", low=1))


def _dimap_functions(model: Element, validity: Element | None, first: float, *, inverse: bool) -> RationalFunctions:
    """The polynomials of one direction; ``first``: the number of the first column and row."""
    known, *others = _DIMAP_TO_IMAGE if inverse else _DIMAP_TO_GROUND
    place = model.need(known, "rational polynomials", *others)
    # in products of DIMAP 2 the direct model has SAMP for longitude and LINE for latitude
    names = (("SAMP", "LINE"), ("F_COL", "F_ROW") if inverse else ("F_LON", "F_LAT"))
    if not inverse and place.find("LON_NUM_COEFF_1") is not None:
        names = (("LON", "LAT"), names[1])
    if place.find(f"{names[0][0]}_NUM_COEFF_1") is not None:
        rows = [
            np.array([place.number(f"{axis}_{part}_COEFF_{k}") for k in range(1, 21)])
            for axis in names[0]
            for part in ("NUM", "DEN")
        ]
        coefficients = np.stack(rows)
    else:
        coefficients = np.concatenate([place.numbers(name, 40).reshape(2, 20) for name in names[1]])
    if validity is None:
        raise model.refuse("RFM_Validity", "offsets and scales")
    of = {}
    for axis, short in (("LONG", "Lon"), ("LAT", "Lat"), ("HEIGHT", "Alt"), ("SAMP", "Col"), ("LINE", "Row")):
        if validity.find(f"{axis}_OFF") is not None:
            of[short] = validity.number(f"{axis}_OFF"), validity.number(f"{axis}_SCALE")
        else:
            part = validity.need(short, "offset and scale")
            of[short] = part.number("B"), part.number("A")
    of["Col"], of["Row"] = ((of[axis][0] - first, of[axis][1]) for axis in ("Col", "Row"))
    ground, image = ("Lon", "Lat"), ("Col", "Row")
    ins, outs = (ground, image) if inverse else (image, ground)
    try:
        return RationalFunctions(
            coefficients,
            np.array([of[name][0] for name in (*ins, "Alt")]),
            np.array([of[name][1] for name in (*ins, "Alt")]),
            np.array([of[name][0] for name in outs]),
            np.array([of[name][1] for name in outs]),
            periodic=inverse,
        )
    except ValueError as error:
        raise UserError(f"{place.path}: {place.where}: {error}") from None


def _stated(error_m: float) -> float:
    """An error as files state it, in which -1 stands for one that is not known; 0 would be none."""
    return error_m if error_m > 0 else -1.0


def write_rpb(path: Path, rpc: Rpc) -> None:
    """Write an ``.RPB`` file; the result is read by GDAL beside an image of the same name."""
    f = rpc.to_image
    out = ['satId = "triline";', 'bandId = "P";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    out.append(f"\terrBias = {_stated(rpc.error_bias_m):.17g};")
    out.append(f"\terrRand = {_stated(rpc.error_random_m):.17g};")
    ends = {"samp": (3, 0), "line": (3, 1)}
    for what, ins, outs in (("Offset", f.in_offset, f.out_offset), ("Scale", f.in_scale, f.out_scale)):
        for name in ("line", "samp", "lat", "long", "height"):
            value = outs[ends[name][1]] if name in ends else ins[("long", "lat", "height").index(name)]
            out.append(f"\t{name}{what} = {value:.17g};")
    for row, name in ((2, "lineNumCoef"), (3, "lineDenCoef"), (0, "sampNumCoef"), (1, "sampDenCoef")):
        out.append(f"\t{name} = (")
        out.extend(f"\t\t\t{c:.17g}{',' if k < 19 else ');'}" for k, c in enumerate(f.coefficients[row]))
    out += ["END_GROUP = IMAGE", "END;", ""]
    with new_file(path) as part:
        part.write_text("\n".join(out), encoding="ascii")


def write_rpc_text(path: Path, rpc: Rpc) -> None:
    """Write an ``_RPC.TXT`` file."""
    f = rpc.to_image
    values = dict(
        zip(_NAMES, zip((*f.in_offset, *f.out_offset), (*f.in_scale, *f.out_scale), strict=True), strict=True)
    )
    units = {"LONG": "degrees", "LAT": "degrees", "HEIGHT": "meters", "SAMP": "pixels", "LINE": "pixels"}
    order = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
    errors = (("ERR_BIAS", rpc.error_bias_m), ("ERR_RAND", rpc.error_random_m))
    out = [f"{name}: {_stated(error):.17g} meters" for name, error in errors]
    out += [f"{n}_{w}: {values[n][k]:.17g} {units[n]}" for k, w in enumerate(("OFF", "SCALE")) for n in order]
    for row, name in ((2, "LINE_NUM"), (3, "LINE_DEN"), (0, "SAMP_NUM"), (1, "SAMP_DEN")):
        out.extend(f"{name}_COEFF_{k + 1}: {c:.17g}" for k, c in enumerate(f.coefficients[row]))
    with new_file(path) as part:
        part.write_text("\n".join([*out, ""]), encoding="ascii")


def rasterio_rpc(rpc: Rpc) -> Any:
    """The polynomials as rasterio takes them for the tags of a GeoTIFF (``dataset.rpcs = ..``)."""
    from rasterio.rpc import RPC

    f = rpc.to_image
    names: dict[str, Any] = dict(
        height_off=float(f.in_offset[2]), height_scale=float(f.in_scale[2]),
        lat_off=float(f.in_offset[1]), lat_scale=float(f.in_scale[1]),
        long_off=float(f.in_offset[0]), long_scale=float(f.in_scale[0]),
        samp_off=float(f.out_offset[0]), samp_scale=float(f.out_scale[0]),
        line_off=float(f.out_offset[1]), line_scale=float(f.out_scale[1]),
        samp_num_coeff=f.coefficients[0].tolist(), samp_den_coeff=f.coefficients[1].tolist(),
        line_num_coeff=f.coefficients[2].tolist(), line_den_coeff=f.coefficients[3].tolist(),
        err_bias=rpc.error_bias_m or None, err_rand=rpc.error_random_m or None,
    )  # fmt: skip
    return RPC(**names)
