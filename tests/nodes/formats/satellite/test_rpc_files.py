"""RPC in every kind of file: the same numbers come back, and agree with GDAL's."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from places import DATA, needs_data
from rasterio.transform import RPCTransformer
from satellite_scenes import Truth, write_dimap2

from triline.nodes.errors import UserError
from triline.nodes.formats.satellite.read import read_scene
from triline.nodes.formats.satellite.rpc_files import rasterio_rpc, write_rpb, write_rpc_text
from triline.solver.location.rpc_fit import fit_to_model

VENTOUX = DATA / "satellites" / "phr_ventoux"


@pytest.fixture(scope="module")
def rpc(tmp_path_factory):
    path = write_dimap2(tmp_path_factory.mktemp("scene") / "scene.xml", Truth())
    return fit_to_model(read_scene(path).model("rigorous"), 0.0, 2000.0).rpc


def write_geotiff(path, rpc):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(path, "w", driver="GTiff", width=60, height=50, count=1, dtype="uint8") as image:
            image.rpcs = rasterio_rpc(rpc)
    return path


def write_geom(path, rpc):
    f = rpc.to_image
    names = ("long", "lat", "height", "samp", "line")
    rows = [f"{n}_off:  {x:.17g}" for n, x in zip(names, (*f.in_offset, *f.out_offset), strict=True)]
    rows += [f"{n}_scale:  {x:.17g}" for n, x in zip(names, (*f.in_scale, *f.out_scale), strict=True)]
    for k, name in enumerate(("samp_num", "samp_den", "line_num", "line_den")):
        rows += [f"{name}_coeff_{i:02d}:  {c:.17g}" for i, c in enumerate(f.coefficients[k])]
    path.write_text("\n".join([*rows, "polynomial_format:  B", "number_lines:  20000", "number_samples:  6000", ""]))
    return path


def write_dimap(path, rpc):
    f = rpc.to_image
    rows = []
    for k, name in enumerate(("SAMP_NUM", "SAMP_DEN", "LINE_NUM", "LINE_DEN")):
        rows += [f"<{name}_COEFF_{i + 1}>{c:.17g}</{name}_COEFF_{i + 1}>" for i, c in enumerate(f.coefficients[k])]
    ends = []
    offsets = (*f.in_offset, f.out_offset[0] + 1, f.out_offset[1] + 1)  # DIMAP counts from 1
    scales = (*f.in_scale, *f.out_scale)
    for name, off, scale in zip(("LONG", "LAT", "HEIGHT", "SAMP", "LINE"), offsets, scales, strict=True):
        ends.append(f"<{name}_SCALE>{scale:.17g}</{name}_SCALE><{name}_OFF>{off:.17g}</{name}_OFF>")
    path.write_text(
        "<Dimap_Document><Metadata_Identification><METADATA_FORMAT version='2.15'>DIMAP</METADATA_FORMAT>"
        "</Metadata_Identification><Rational_Function_Model><Global_RFM><Inverse_Model>"
        + "".join(rows)
        + f"</Inverse_Model><RFM_Validity>{''.join(ends)}</RFM_Validity></Global_RFM></Rational_Function_Model>"
        "</Dimap_Document>"
    )
    return path


def write_dimap3(path, rpc, margins=(0, 0)):
    """As Pleiades Neo has them: other names, pixels from 0; polynomials hold with margins of columns and rows."""
    text = write_dimap(path, rpc).read_text().replace("Inverse_Model>", "GroundtoImage_Values>")
    samples, lines = rpc.to_image.out_offset
    text = text.replace(f"<SAMP_OFF>{samples + 1:.17g}", f"<SAMP_OFF>{samples:.17g}")
    text = text.replace(f"<LINE_OFF>{lines + 1:.17g}", f"<LINE_OFF>{lines:.17g}")
    direct = "".join(
        f"<{axis}_{part}_COEFF_{k}>{float(k == (1 if part == 'DEN' else one)):g}</{axis}_{part}_COEFF_{k}>"
        for axis, one in (("LON", 2), ("LAT", 3)) for part in ("NUM", "DEN") for k in range(1, 21)
    )  # fmt: skip
    a, b = margins
    domain = f"<FIRST_COL>{-a}</FIRST_COL><FIRST_ROW>{-b}</FIRST_ROW>"
    domain += f"<LAST_COL>{5999 + a}</LAST_COL><LAST_ROW>{19999 + b}</LAST_ROW>"
    direct = f"<ImagetoGround_Values>{direct}</ImagetoGround_Values>"
    domain = f"<ImagetoGround_Validity_Domain>{domain}</ImagetoGround_Validity_Domain>"
    path.write_text(text.replace("<RFM_Validity>", f"{direct}<RFM_Validity>{domain}"))
    return path


def write_copy(path, rpc):
    """An image of another kind, which GDAL makes of a GeoTIFF."""
    from rasterio.shutil import copy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        copy(write_geotiff(path.with_suffix(".tif"), rpc), path, driver={".vrt": "VRT", ".pix": "PCIDSK"}[path.suffix])
    return path


def _rpb(path, rpc):
    write_rpb(path, rpc)
    return path


def _text(path, rpc):
    write_rpc_text(path, rpc)
    return path


def write_maxar(path, rpc):
    f = rpc.to_image
    names = ("LONG", "LAT", "HEIGHT", "SAMP", "LINE")
    rows = [f"<{n}OFFSET>{x:.17g}</{n}OFFSET>" for n, x in zip(names, (*f.in_offset, *f.out_offset), strict=True)]
    rows += [f"<{n}SCALE>{x:.17g}</{n}SCALE>" for n, x in zip(names, (*f.in_scale, *f.out_scale), strict=True)]
    for k, name in enumerate(("SAMPNUM", "SAMPDEN", "LINENUM", "LINEDEN")):
        numbers = " ".join(f"{c:.17E}" for c in f.coefficients[k])
        rows.append(f"<{name}COEFList><{name}COEF>{numbers} </{name}COEF></{name}COEFList>")
    size = "<IMD><NUMROWS>20000</NUMROWS><NUMCOLUMNS>6000</NUMCOLUMNS></IMD>"
    errors = "<ERRBIAS>3.29</ERRBIAS><ERRRAND>2.6e-1</ERRRAND>"
    path.write_text(
        f"<isd>{size}<RPB><SATID>WV01</SATID><SPECID>RPC00B</SPECID><IMAGE>{errors}{''.join(rows)}</IMAGE></RPB></isd>"
    )
    return path


def _dimap3_with_margins(path, rpc):
    return write_dimap3(path, rpc, (4900, 4510))


WRITERS = {
    "a.tif": write_geotiff, "a.RPB": _rpb, "a_RPC.TXT": _text, "a.geom": write_geom, "RPC_a.XML": write_dimap,
    "RPC_PNEO.XML": write_dimap3, "RPC_PNEO4.XML": _dimap3_with_margins,
    "a.XML": write_maxar, "a.vrt": write_copy, "a.pix": write_copy,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_the_same_polynomials_come_back(name, rpc, tmp_path):
    back = read_scene(WRITERS[name](tmp_path / name, rpc)).model("rpc")
    rng = np.random.default_rng(1)
    u, v, h = rng.uniform(0, 20_000, 50), rng.uniform(0, 6000, 50), rng.uniform(0, 2000, 50)
    located = rpc.direct(u, v, h)
    np.testing.assert_allclose(back.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-6)


def test_size_of_an_image_of_dimap_3(rpc, tmp_path):
    back = read_scene(write_dimap3(tmp_path / "RPC_PNEO.XML", rpc)).model()
    assert (back.lines, back.samples) == (20_000, 6_000) and back.to_ground is not None


def test_size_and_errors_of_the_xml_of_maxar(rpc, tmp_path):
    back = read_scene(write_maxar(tmp_path / "a.XML", rpc)).model()
    assert (back.lines, back.samples, back.error_bias_m, back.error_random_m) == (20_000, 6_000, 3.29, 0.26)


def test_polynomials_of_dimap_that_hold_beyond_the_image_do_not_tell_its_size(rpc, tmp_path):
    """As those of Pleiades Neo, and of some scenes of Pleiades: the margin is not part of the image."""
    path = _dimap3_with_margins(tmp_path / "RPC_PNEO.XML", rpc)
    back = read_scene(path).model()
    assert (back.lines, back.samples) == (0, 0)
    write_dimap2(tmp_path / "DIM_PNEO.XML", Truth(lines=900, samples=800))  # of the scene, which tells it
    back = read_scene(path).model()
    assert (back.lines, back.samples) == (900, 800)
    path = write_dimap(tmp_path / "RPC_PHR.XML", rpc)
    for first, size in ((1, (42248, 39208)), (-27, (0, 0))):
        ends = f"<FIRST_ROW>{first}</FIRST_ROW><FIRST_COL>{first}</FIRST_COL><LAST_ROW>42248</LAST_ROW>"
        domain = f"<Direct_Model_Validity_Domain>{ends}<LAST_COL>39208</LAST_COL></Direct_Model_Validity_Domain>"
        (tmp_path / "RPC_a.XML").write_text(path.read_text().replace("<RFM_Validity>", f"<RFM_Validity>{domain}"))
        back = read_scene(tmp_path / "RPC_a.XML").model()
        assert (back.lines, back.samples) == size


def test_polynomials_that_a_scene_of_dimap_2_names(rpc, tmp_path):
    """Products have them in a file of their own beside that of the scene, which knows the size of the image."""
    scene = write_dimap2(tmp_path / "DIM_a.XML", Truth())
    place = "<Component><COMPONENT_PATH href='RPC_a.XML'/></Component>"
    model = f"<Geoposition_Models><Rational_Function_Model>{place}</Rational_Function_Model></Geoposition_Models>"
    text = scene.read_text().replace("<Geometric_Data>", f"<Geoposition>{model}</Geoposition><Geometric_Data>")
    scene.write_text(text)
    assert read_scene(scene).rpc is None  # the file is not there
    scene.write_text(text.replace("Geometric_Data", "Other_Data"))
    with pytest.raises(UserError, match=r"COMPONENT_PATH: 'RPC_a\.XML', wanted this file beside it"):
        read_scene(scene)
    write_dimap(tmp_path / "RPC_a.XML", rpc)
    for name, kind in (("Geometric_Data", "dimap2"), ("Other_Data", "rpc")):  # with a rigorous model, and without
        scene.write_text(text.replace("Geometric_Data", name))
        found = read_scene(scene)
        back = found.model("rpc")
        assert (found.kind, back.lines, back.samples) == (kind, 20_000, 6_000)
        np.testing.assert_array_equal(back.to_image.coefficients, rpc.to_image.coefficients)


@pytest.mark.parametrize("errors", [(3.0, 0.25), (0.0, 0.0)])
@pytest.mark.parametrize("name", ["a.tif", "a.RPB", "a_RPC.TXT"])
def test_stated_errors_come_back(name, errors, rpc, tmp_path):
    """Those that are not known are told as -1, as GDAL does it: 0 would say that there are none."""
    stated = replace(rpc, error_bias_m=errors[0], error_random_m=errors[1])
    path = WRITERS[name](tmp_path / name, stated)
    back = read_scene(path).model("rpc")
    assert (back.error_bias_m, back.error_random_m) == errors
    if name != "a.tif":
        found = re.findall(r"(?i)err_?(bias|rand) *[:=] *([-\d.]+)", path.read_text())
        assert [float(value) for _, value in found] == ([-1.0, -1.0] if errors == (0.0, 0.0) else list(errors))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with rasterio.open(
                tmp_path / "a.tif", "w", driver="GTiff", width=60, height=50, count=1, dtype="uint8"
            ) as image:
                image.write(np.zeros((1, 50, 60), dtype=np.uint8))
            with rasterio.open(tmp_path / "a.tif") as image:
                assert [image.rpcs.err_bias, image.rpcs.err_rand] == [float(value) for _, value in found]


def test_gdal_gives_the_same_pixels(rpc):
    """GDAL counts from the corner of a pixel, half a pixel more."""
    rng = np.random.default_rng(2)
    u, v, h = rng.uniform(0, 20_000, 50), rng.uniform(0, 6000, 50), rng.uniform(0, 2000, 50)
    located = rpc.direct(u, v, h)
    with RPCTransformer(rasterio_rpc(rpc)) as transformer:
        row, column = transformer.rowcol(np.degrees(located[:, 1]), np.degrees(located[:, 0]), h, op=lambda x: x)
    np.testing.assert_allclose(np.stack([row, column], axis=1) - 0.5, np.stack([u, v], axis=1), atol=1e-4)


@needs_data
@pytest.mark.parametrize("name", ["left_image", "right_image"])
def test_geom_of_ossim(name):
    rpc = read_scene(VENTOUX / f"{name}.geom").model()
    assert rpc.lines > 40_000 and rpc.samples > 38_000
    u, v = np.array([0.0, 5000.0, 40_000.0]), np.array([0.0, 5000.0, 39_000.0])
    located = rpc.direct(u, v, 1000.0)
    np.testing.assert_allclose(np.degrees(located[1, :2]), [44.2, 5.19], atol=0.03)
    np.testing.assert_allclose(rpc.inverse(*located.T), np.stack([u, v], axis=1), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("a.RPB", lambda s: s.replace("lineOffset", "lineOfset"), "lineOffset: missing, wanted a number"),
        ("a.RPB", lambda s: s[: s.index("sampDenCoef") + 60], "sampDenCoef: .*wanted 20 numbers"),
        ("a_RPC.TXT", lambda s: s.replace("SAMP_SCALE: ", "SAMP_SCALE: x"), "samp_scale: 'x.*wanted a number"),
        ("a_RPC.TXT", lambda s: s.replace("LINE_DEN_COEFF_7:", "LINE_DEN_COEFF_77:"), "line_den_coeff_07: missing"),
        ("a.RPB", lambda s: s.replace("RPC00B", "RPC00A"), 'SpecId: "RPC00A", wanted RPC00B'),
        ("a.XML", lambda s: s.replace("RPC00B", "RPC00A"), "isd/RPB/SPECID: 'RPC00A', wanted RPC00B"),
        ("a.XML", lambda s: s.replace("RPB>", "RPX>"), "isd/RPB: missing, wanted rational polynomials"),
        ("a.geom", lambda s: s.replace("polynomial_format:  B", "polynomial_format:  A"), "'A', wanted B"),
        ("RPC_a.XML", lambda s: s.replace("LINE_NUM_COEFF_3>", "X>"), "LINE_NUM_COEFF_3: missing, wanted a number"),
        ("RPC_a.XML", lambda s: s.replace("<LAT_SCALE>", "<LAT_SCALE>0 "), "LAT_SCALE.*wanted a number"),
    ],
)
def test_what_is_missing_is_named(name, change, match, rpc, tmp_path):
    path = WRITERS[name](tmp_path / name, rpc)
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError, match=match) as caught:
        read_scene(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_denominator_of_zero_is_refused(rpc, tmp_path):
    path = _text(tmp_path / "a_RPC.TXT", rpc)
    lines = path.read_text().splitlines()
    lines = ["SAMP_DEN_COEFF_2: -1.5" if line.startswith("SAMP_DEN_COEFF_2:") else line for line in lines]
    path.write_text("\n".join(lines))
    with pytest.raises(UserError, match="denominator of the sample passes zero inside the box"):
        read_scene(path)


def test_an_image_without_rpc(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=6, height=5, count=1, dtype="uint8"):
            pass
    with pytest.raises(UserError, match="an image without RPC"):
        read_scene(tmp_path / "a.tif")
