"""Metadata as other makers and programs write them: encodings, namespaces, numbers, times, parts that may be absent."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from satellite_scenes import OMEGA, Truth, write_dimap1, write_dimap2, write_isd
from test_rpc_files import WRITERS as RPC_WRITERS

from triline.nodes.formats.satellite.read import read_scene
from triline.solver.location.rpc_fit import fit_to_model

XML = {
    "dimap2-list": lambda path, truth: write_dimap2(path, truth),
    "dimap2-polynomial": lambda path, truth: write_dimap2(path, truth, polynomial=True),
    "dimap1": write_dimap1,
}
NUMBER = re.compile(r"(?<=>)\s*([-+]?\d+\.\d+(?:[eE][-+]?\d+)?)\s*(?=<)")
TIME = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d:\d\d)(\.\d+)?Z?")


def fortran(text):
    return f"{float(text):+.17E}".replace("E", "D")


def prefixed(text):
    """All elements in a namespace with a prefix."""
    text = re.sub(r"<(/?)(?=[A-Za-z])", r"<\1d:", re.sub(r"<\?xml.*?\?>", "", text))
    return re.sub(r"<d:(\w+)", r'<d:\1 xmlns:d="http://example.org/dimap"', text, count=1)


def default_namespace(text):
    return re.sub(r"<(?!\?|!)(\w+)", r'<\1 xmlns="http://example.org/dimap"', text, count=1)


#: Text of a document -> bytes of the same in another form.
FORMS = {
    "byte order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "UTF-16": lambda text: re.sub(r"^<\?xml.*?\?>", "", text).encode("utf-16"),
    "latin-1": lambda text: ('<?xml version="1.0" encoding="ISO-8859-1"?><!-- Mosaïque -->'
                             + re.sub(r"^<\?xml.*?\?>", "", text)).encode("latin-1"),
    "line ends": lambda text: text.replace("\n", "\r\n").encode(),
    "blank lines first": lambda text: b"\n  \n" + text.encode(),
    "byte order mark and declaration": lambda text: b"\xef\xbb\xbf"
    + ('<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n' + re.sub(r"^<\?xml.*?\?>", "", text)).encode(),
    "namespace": lambda text: default_namespace(text).encode(),
    "prefix": lambda text: prefixed(text).encode(),
    "comments": lambda text: re.sub(r"(</\w+>)", r"\1<!-- here -->", text).encode(),
    "blanks about values": lambda text: NUMBER.sub(r"\n   \1\t", text).encode(),
    "exponents": lambda text: NUMBER.sub(lambda m: f"{float(m[1]):.17E}", text).encode(),
    "signs": lambda text: NUMBER.sub(lambda m: f"{float(m[1]):+.17g}", text).encode(),
    "Fortran": lambda text: NUMBER.sub(lambda m: fortran(m[1]), text).encode(),
    "times with zone": lambda text: TIME.sub(r"\1T\2\3+00:00", text).encode(),
    "times of another zone": lambda text: TIME.sub(lambda m: earlier(m), text).encode(),
    "times with blanks": lambda text: TIME.sub(r"\1 \2\3", text).encode(),
    "times by day of the year": lambda text: TIME.sub(day_of_year, text).encode(),
}  # fmt: skip


def earlier(found):
    moment = np.datetime64(f"{found[1]}T{found[2]}") - np.timedelta64(90, "m")
    return f"{moment}{found[3] or ''}-01:30"


def day_of_year(found):
    day = (np.datetime64(found[1]) - np.datetime64(found[1][:4])).astype("timedelta64[D]").astype(int) + 1
    return f"{found[1][:4]}-{day:03d}T{found[2]}{found[3] or ''}"


def located(path):
    sensor = read_scene(path).model("rigorous")
    return sensor.ground(np.array([0.0, 500.0, 990.0]), np.array([0.0, 300.0, 590.0]), 300.0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", XML)
def test_forms_of_xml(kind, form, tmp_path):
    path = XML[kind](tmp_path / "scene.xml", Truth())
    wanted = located(path)
    text = path.read_text()
    path.write_bytes(FORMS[form](text))
    np.testing.assert_allclose(located(path), wanted, atol=2e-5)


#: Parts of RPC files in other forms.
RPC_FORMS = {
    "a_RPC.TXT": {
        "byte order mark": lambda t: "\ufeff" + t,
        "line ends": lambda t: t.replace("\n", "\r\n"),
        "equals signs": lambda t: t.replace(":", " ="),
        "no units": lambda t: re.sub(r" (degrees|meters|pixels)", "", t),
        "padded": lambda t: re.sub(r": (\S+)", lambda m: f":\t{float(m[1]):+030.17E}", t),
        "Fortran": lambda t: re.sub(r": (\S+)", lambda m: f": {fortran(m[1])}", t),
        "two digits": lambda t: re.sub(r"COEFF_(\d):", r"COEFF_0\1:", t),
        "lower case": str.lower,
        "errors": lambda t: "ERR_BIAS: 1.5 meters\nERR_RAND: -1\n" + t,
        "comment first": lambda t: "# made by another program\n\n" + t,
    },
    "a.RPB": {
        "no errors": lambda t: re.sub(r"\terr\w+ = .*;\n", "", t),
        "byte order mark": lambda t: "\ufeff" + t,
        "no semicolons": lambda t: t.replace(";", ""),
        "one line each": lambda t: re.sub(r",\n\s*", ", ", t),
        "close": lambda t: t.replace(" = ", "="),
        "line ends": lambda t: t.replace("\n", "\r\n"),
        "Fortran": lambda t: re.sub(r"(?<=\t)(-?\d\S*?)(?=[,)])", lambda m: fortran(m[1]), t),
        "lower case": str.lower,
        "bias alone": lambda t: re.sub(r"\terrRand = .*;\n", "", t),
    },
    "a.geom": {
        "line ends": lambda t: t.replace("\n", "\r\n"),
        "no size": lambda t: re.sub(r"number_\w+:.*\n", "", t),
    },
    "RPC_a.XML": {
        "namespace": default_namespace,
        "prefix": prefixed,
        "byte order mark": lambda t: "\ufeff" + t,
        "Fortran": lambda t: NUMBER.sub(lambda m: fortran(m[1]), t),
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def rpc(tmp_path_factory):
    path = write_dimap2(tmp_path_factory.mktemp("scene") / "scene.xml", Truth())
    return fit_to_model(read_scene(path).model("rigorous"), 0.0, 2000.0).rpc


@pytest.mark.parametrize(("name", "form"), [(name, form) for name, forms in RPC_FORMS.items() for form in forms])
def test_forms_of_rpc(name, form, rpc, tmp_path):
    path = RPC_WRITERS[name](tmp_path / name, rpc)
    path.write_bytes(RPC_FORMS[name][form](path.read_bytes().decode()).encode())
    back = read_scene(path).model("rpc")
    ground = rpc.direct(np.array([10.0, 5000.0]), np.array([10.0, 3000.0]), np.array([0.0, 1000.0]))
    np.testing.assert_allclose(back.inverse(*ground.T), rpc.inverse(*ground.T), atol=1e-6)


def without(*names):
    def change(isd):
        for name in names:
            place, _, key = name.rpartition(".")
            (isd[place] if place else isd).pop(key, None)

    return change


def integers(isd):
    for table in isd.values():
        if isinstance(table, dict):
            for key in [k for k, v in table.items() if isinstance(v, float) and v == int(v)]:
                table[key] = int(table[key])


def unknown_parts(isd):
    isd["isis_camera_version"], isd["interpolation_method"] = 2, "lagrange"
    isd["naif_keywords"] = {"INS-1": [1, "x"], "BODY_CODE": 399}
    isd["reference_height"] = {"maxheight": 1000, "minheight": -1000, "unit": "m"}


def radial(isd):
    isd["optical_distortion"] = {"radial": {"coefficients": [0, 0, 0]}}


ISD_FORMS = {
    "no distortion": without("optical_distortion"),
    "distortion of zeros": radial,
    "no summing": without("detector_sample_summing", "detector_line_summing"),
    "no start": without("starting_detector_line", "starting_detector_sample"),
    "integers": integers,
    "parts of other versions": unknown_parts,
    "no units": without("radii.unit"),
}


@pytest.mark.parametrize("inertial", [False, True])
@pytest.mark.parametrize("form", ISD_FORMS)
def test_forms_of_isd(form, inertial, tmp_path):
    path = write_isd(tmp_path / "scene.json", Truth(), inertial=inertial)
    wanted = located(path)
    isd = json.loads(path.read_text())
    ISD_FORMS[form](isd)
    path.write_text(json.dumps(isd))
    np.testing.assert_allclose(located(path), wanted, atol=1e-6)


@pytest.mark.parametrize("name", ["scene.isd", "scene.json", "scene.txt", "scene"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_names_of_isd(name, mark, tmp_path):
    path = write_isd(tmp_path / name, Truth())
    wanted = path.read_text()
    path.write_text("\n " * (not mark) + mark + wanted, encoding="utf-8")
    assert read_scene(path).model("rigorous").lines == Truth().lines


@pytest.mark.parametrize("inertial", [False, True])
def test_isd_without_velocities(inertial, tmp_path):
    path = write_isd(tmp_path / "scene.json", Truth(), inertial=inertial)
    wanted = located(path)
    isd = json.loads(path.read_text())
    isd["instrument_position" if inertial else "sensor_position"].pop("velocities")
    path.write_text(json.dumps(isd))
    np.testing.assert_allclose(located(path), wanted, atol=0.1)


@pytest.mark.parametrize("against_the_stars", [False, True])
def test_isd_with_few_positions_and_velocities(against_the_stars, tmp_path):
    """Five positions are interpolated with their velocities, if these are their slope over the planet."""
    path = write_isd(tmp_path / "scene.json", Truth())
    wanted = located(path)
    isd = json.loads(path.read_text())
    table = isd["sensor_position"]
    first = int(-isd["t0_ephemeris"] // isd["dt_ephemeris"]) - 1
    isd["t0_ephemeris"] += first * isd["dt_ephemeris"]
    P, V = (np.array(table[name][first : first + 5]) for name in ("positions", "velocities"))
    if against_the_stars:
        V = V + np.cross([0.0, 0.0, OMEGA], P)
    table["positions"], table["velocities"] = P.tolist(), V.tolist()
    path.write_text(json.dumps(isd))
    said = ["scene.json: velocities are not the slope of the positions and were not used"] * against_the_stars
    assert read_scene(path).notes == said
    np.testing.assert_allclose(located(path), wanted, atol=0.01)
