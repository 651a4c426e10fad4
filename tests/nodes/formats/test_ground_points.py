"""Lists of control and check points, as `ground_points.csv` and as other programs head them."""

import numpy as np
import pyproj
import pytest

from triline.nodes.errors import UserError
from triline.nodes.formats.ground_points import read_ground_points

UTM, LONLAT = "EPSG:32632", "EPSG:4326"
PLACE = pyproj.Transformer.from_crs(UTM, LONLAT).transform(691000.5, 5334000.2)
PROJCS = "# CoordinateSystem: " + pyproj.CRS(UTM).to_wkt("WKT1_GDAL")


def read(path, text, crs=UTM):
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    notes = []
    points, frame = read_ground_points(path, crs, None, notes)
    sigma = np.sqrt(np.einsum("nii->ni", points.covariance))
    return points, frame.to_geodetic(points.xyz_l), sigma, notes


LISTS = {
    "ours": "point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role\n"
    "P1,691000.5,5334000.2,512.3,0.01,0.02,0.03,control\n",
    "in small letters": "point,x,y,z,sigma_X_m,sigma_Y_m,sigma_Z_m\nP1,691000.5,5334000.2,512.3,0.01,0.02,0.03\n",
    "northing first": "NORTHING,EASTING,sigma_Y_m,sigma_X_m,sigma_Z_m,Elevation,Point ID\n"
    "5334000.2,691000.5,0.02,0.01,0.03,512.3,P1\n",
    "a spreadsheet": "\ufeffName;E;N;H;sigma_X_m;sigma_Y_m;sigma_Z_m\r\nP1;691000,5;5334000,2;512,3;0,01;0,02;0,03\r\n",
    "Metashape": f"{PROJCS}\n#Label,Enable,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y/Z_(m)\n"
    "P1,1,691000.500000,5334000.200000,512.300000,0.01/0.02/0.03\n",
    "units in names": "Label,Easting [m],Northing [metres],Height (m),Accuracy_X (m),Accuracy_Y (m),Accuracy_Z (m)\n"
    "P1,691000.5,5334000.2,512.3,0.01,0.02,0.03\n",
    # docs of OpenDroneMap and GCPEditorPro; survey points of Emlid Flow, which have heights above the geoid beside them
    "Emlid": "Name,Code,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height,Easting RMS,Northing RMS,"
    "Elevation RMS,Lateral RMS,Antenna height\nP1,,691000.5,5334000.2,465.1,0,0,512.3,0.01,0.02,0.03,0.022,1.8\n",
    "point, northing, easting, height": "P,N,E,Z,D,sigma_X_m,sigma_Y_m,sigma_Z_m\n"
    "P1,5334000.2,691000.5,512.3,,0.01,0.02,0.03\n",
    "GCP Label": "GCP Label,Northing,Easting,Elevation,Accuracy\nP1,5334000.2,691000.5,512.3,0.01/0.02/0.03\n",
    "a comma in an accuracy": "#Label;X/East;Y/North;Z/Altitude;Accuracy_(m)\n"
    "P1;691000,5;5334000,2;512,3;0,01/0,02/0,03\n",
    "a header as a remark": "# point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m\n"
    "P1,691000.5,5334000.2,512.3,0.01,0.02,0.03\n",
}


@pytest.mark.parametrize("what", LISTS)
def test_a_point_is_where_and_as_good_as_each_list_says(tmp_path, what):
    points, place, sigma, notes = read(tmp_path / "control.csv", LISTS[what])
    assert (points.id, points.role) == (("P1",), ("control",))
    np.testing.assert_allclose(place, [[*PLACE, 512.3]], rtol=0, atol=1e-8)
    # 2 deg of convergence mix X and Y a little
    np.testing.assert_allclose(sigma, [[0.01, 0.02, 0.03]], rtol=2e-2)
    assert ("control.csv: no column role: all points are control" in notes) == (what not in ("ours", "Metashape"))
    above = "control.csv: Elevation is taken as height above the ellipsoid, for the CRS has no other heights"
    assert (above in notes) == (what in ("northing first", "GCP Label"))


def test_one_accuracy_and_those_in_level_and_in_height(tmp_path):
    head = "#Label,Enable,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_X/Y/Z_(m),X_error\n"
    rows = ["A,1,11.5,48.1,500,0.05,0.1", "B,0,11.6,48.2,510,0.02/0.05,", "C,True,11.7,48.3,520,0.01/0.02/0.03,"]
    points, place, sigma, notes = read(tmp_path / "ms.csv", head + "\n".join(rows) + "\n", LONLAT)
    assert points.role == ("control", "check", "control")
    np.testing.assert_allclose(place, [[48.1, 11.5, 500], [48.2, 11.6, 510], [48.3, 11.7, 520]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(sigma, [[0.05, 0.05, 0.05], [0.02, 0.02, 0.05], [0.01, 0.02, 0.03]], rtol=1e-3)
    assert notes == ["ms.csv: column 'X_error' is not known and was ignored"]
    for names in (
        "Longitude,Latitude,Altitude,Horizontal accuracy (m),Vertical accuracy (m)",
        "Longitude [deg],Latitude [deg],Altitude [meter],Accuracy Horz [meter],Accuracy Vert [meter]",
    ):
        points, place, sigma, _ = read(tmp_path / "p4d.csv", f"Label,{names}\nA,11.5,48.1,500,0.02,0.04\n", LONLAT)
        np.testing.assert_allclose(place, [[48.1, 11.5, 500]], rtol=0, atol=1e-6)
        np.testing.assert_allclose(sigma, [[0.02, 0.02, 0.04]], rtol=1e-3)


def test_types_of_pix4d_are_roles_and_others_are_ignored(tmp_path):
    """A check point that counted as control would make the check worthless."""
    head, row = "Label,Type,Easting,Northing,Altitude,Accuracy Horz,Accuracy Vert\n", "{},{},691000.5,533{}000,500,{}\n"

    def roles(*types):
        rows = "".join(row.format(f"P{i}", name, i, "0.02,0.04") for i, name in enumerate(types))
        points, _, _, notes = read(tmp_path / "p4d.csv", head + rows)
        return points.role, [note for note in notes if "Altitude" not in note]

    assert roles("3D GCP", "2D GCP", "1D GCP", "Check Point", "3D check point") == (
        ("control", "planimetric", "height", "check", "check"), [],
    )  # fmt: skip
    ignored = ["p4d.csv: column 'Type' is not known and was ignored", "p4d.csv: no column role: all points are control"]
    assert roles("tree", "") == (("control", "control"), ignored)
    for other, what in (("Manual Tie Point", "'Manual Tie Point'"), ("", "missing")):
        with pytest.raises(
            UserError, match=rf"p4d\.csv:3: Type: {what}, wanted 3D GCP, 2D GCP, 1D GCP or Check Point$"
        ):
            roles("3D GCP", other)
    points, _, _, _ = read(tmp_path / "p4d.csv", head + row.format("P1", "Check Point", 1, ","))
    assert points.role == ("check",)  # needs no accuracy


EMLID = "Name,Easting,Northing,Elevation,Ellipsoidal height,Easting RMS,Northing RMS,Elevation RMS\n"
FEET = "EPSG:2263"


def test_of_two_heights_those_count_that_the_crs_is_of(tmp_path):
    text = EMLID + "P1,691000.5,5334000.2,465.1,512.3,0.01,0.02,0.03\n"
    _, place, _, notes = read(tmp_path / "control.csv", text, UTM)
    assert place[0, 2] == pytest.approx(512.3)
    assert "control.csv: column 'Elevation' is not known and was ignored" in notes
    # without the grid of the geoid here, PROJ takes heights as they are
    points, frame = read_ground_points(tmp_path / "control.csv", f"{UTM}+EPSG:5773", None, [])
    assert frame.to_crs(points.xyz_l)[0, 2] == pytest.approx(465.1)
    for crs, names in ((UTM, "H,h"), (UTM, "Height,Elevation"), ("local", "H,h")):
        with pytest.raises(UserError, match=r":1: (h|Elevation): heights stand in (H|Height), too; wanted one column"):
            read(tmp_path / "two.csv", f"Name,E,N,{names},Accuracy\nP1,691000.5,5334000.2,465.1,512.3,1\n", crs)
    with pytest.raises(UserError, match=r":1: Z_m: column missing"):
        read(tmp_path / "one.csv", EMLID.replace("Elevation,", ""), f"{UTM}+EPSG:5773")
    with pytest.raises(UserError, match=r":1: e: this column comes twice, also as E"):
        read(tmp_path / "two.csv", "Name,E,e,N,H,Accuracy\nP1,691000.5,691000.5,5334000.2,465.1,1\n")


def test_beside_feet_metres_have_to_be_stated(tmp_path):
    """New York in US survey feet: heights of a CRS without heights, and sigmas, are in metres."""
    row = "P1,984000,195000,10,0.02,0.02,0.03\n"
    head = "Name,Easting,Northing,Z_m,Accuracy_X (m),Accuracy_Y (m),sigma_Z_m\n"
    _, place, sigma, _ = read(tmp_path / "control.csv", head + row, FEET)
    lat, lon = pyproj.Transformer.from_crs(FEET, LONLAT).transform(984000, 195000)
    np.testing.assert_allclose(place, [[lat, lon, 10.0]], rtol=0, atol=1e-8)
    np.testing.assert_allclose(sigma, [[0.02, 0.02, 0.03]], rtol=1e-3)
    for ours, theirs, wanted in (
        ("Z_m", "Elevation", r"Elevation: no unit, beside coordinates in ft_us; wanted Z_m, or Elevation \(m\)"),
        ("sigma_Z_m", "Elevation RMS", r"Elevation RMS: no unit, .*; wanted sigma_Z_m, or"),
        ("Accuracy_X (m)", "Accuracy_X", r"Accuracy_X: no unit, .*; wanted sigma_X_m, or"),
        ("Easting", "Easting [m]", r"Easting \[m\]: coordinates in 'EPSG:2263' are in ft_us, wanted X_ft_us"),
    ):
        with pytest.raises(UserError, match=r"control\.csv:1: " + wanted):
            read(tmp_path / "control.csv", head.replace(ours, theirs) + row, FEET)
    with pytest.raises(UserError, match=r":1: Easting \[deg\]: coordinates in 'EPSG:32632' are in m, wanted X_m"):
        read(tmp_path / "control.csv", head.replace("Easting", "Easting [deg]") + row)


HEAD = "#Label,Enable,X/Easting,Y/Northing,Z/Altitude,Accuracy_X/Y/Z_(m)"
ROW = "P1,1,691000.5,5334000.2,512.3,0.02"
BAD = {
    "no sigma": ("Name,E,N,H\nP1,691000.5,5334000.2,512.3\n", r"control\.csv:2: sigma_X_m: missing, wanted a number"),
    "no height": ("Name,E,N\nP1,691000.5,5334000.2\n", r"control\.csv:1: Z_m: column missing"),
    "no header": (
        "P1,691000.5,5334000.2,512.3\n",
        r"control\.csv:1: point: .*; values stand there, wanted a row of names above them$",
    ),
    "point, northing, easting without a header": (
        "1,5334000.2,691000.5,512.3,GCP\n",
        r":1: point: .*; values stand there",
    ),
    "of OpenDroneMap": (
        "WGS84 UTM 32N\n691000.5 5334000.2 512.3 100.5 200.5 DJI_1.JPG P1\n",
        r":1: .*gcp_list\.txt.*wanted a header",
    ),
    "of OpenDroneMap by code": (
        "EPSG:32632\n691000.5\t5334000.2\t512.3\t100.5\t200.5\tDJI_1.JPG\n",
        r":1: .*gcp_list\.txt",
    ),
    "of OpenDroneMap by PROJ": ("+proj=utm +zone=32 +datum=WGS84\n1 2 3 4 5 A.JPG\n", r":1: .*gcp_list\.txt"),
    "of QGIS": ("#CRS: WGS 84\nmapX,mapY,sourceX,sourceY,enable\n1,2,3,4,1\n", r":1: point: column missing"),
    "degrees, minutes": (
        "Name,E,N,H,Accuracy\nP1,11 30 00.0,48 06 00.0,500,1\n",
        r":2: E: '11 30 00\.0' is not a number",
    ),
    "degrees": (
        "Name,Longitude,Latitude,Height,sigma_X_m,sigma_Y_m,sigma_Z_m\nP1,11.5,48.1,500,1,1,1\n",
        r"control\.csv:1: Longitude: coordinates in 'EPSG:32632' are in m, wanted X_m",
    ),
    "a letter below remarks": (
        f"{PROJCS}\n# at noon\n{HEAD}\n{ROW}\n{ROW.replace('512.3', '51z.3')}\n",
        r"control\.csv:5: Z/Altitude: '51z\.3' is not a number",
    ),
    "accuracy": (f"{HEAD}\n{ROW}/0.03/0.04/0.05\n", r"control\.csv:2: Accuracy_X/Y/Z_\(m\): .*wanted metres"),
    "accuracy in words": (
        f"{PROJCS}\n{HEAD}\n{ROW} m\n",
        r"control\.csv:3: Accuracy_X/Y/Z_\(m\): '0\.02 m', wanted met",
    ),
    "enabled": (f"{HEAD}\n{ROW.replace(',1,', ',7,')}\n", r"control\.csv:2: Enable: '7', wanted one of 1, 0"),
    "surplus": (f"{PROJCS}\n{HEAD}\n{ROW},5\n", r"control\.csv:3: .*7 values, wanted 6"),
}


def test_other_names_count_where_ours_are_not_there_and_the_others_are_ignored(tmp_path):
    """A description beside our columns is no name of a point, and a list may have places in degrees and on a map."""
    ours = "point,name,X_m,Y_m,Z_m,h,sigma_X_m,sigma_Y_m,sigma_Z_m,accuracy,role,enabled\n"
    row = "P1,a hill,691000.5,5334000.2,512.3,7,0.01,0.01,0.03,good,control,no\n"
    points, place, sigma, notes = read(tmp_path / "control.csv", ours + row)
    assert (points.id, points.role) == (("P1",), ("control",))
    np.testing.assert_allclose(place, [[*PLACE, 512.3]], rtol=0, atol=1e-8)
    np.testing.assert_allclose(sigma, [[0.01, 0.01, 0.03]], rtol=1e-3)
    ignored = ("name", "h", "accuracy", "enabled")
    assert notes == [f"control.csv: column {name!r} is not known and was ignored" for name in ignored]
    both = "ID,Name,Lat,Lon,E,N,H,sigma_X_m,sigma_Y_m,sigma_Z_m\n7,P1,48.1,11.5,691000.5,5334000.2,512.3,1,1,1\n"
    for crs, wanted, ignored in ((UTM, PLACE, ("ID", "Lat", "Lon")), (LONLAT, (48.1, 11.5), ("ID", "E", "N"))):
        points, place, _, notes = read(tmp_path / "both.csv", both, crs)
        assert points.id == ("P1",)
        np.testing.assert_allclose(place, [[*wanted, 512.3]], rtol=0, atol=1e-8)
        assert notes[:3] == [f"both.csv: column {name!r} is not known and was ignored" for name in ignored]


def wkt(*crs):
    """As Metashape writes a CRS, or a map and heights."""
    whole = pyproj.CRS(crs[0]) if len(crs) == 1 else pyproj.crs.CompoundCRS(" + ".join(crs), list(crs))
    return whole.to_wkt("WKT1_GDAL")


ZONE_33, EGM96, NAVD88 = "EPSG:32633", "EPSG:5773", "EPSG:5703"
STATED = {
    "the same": (f" {wkt(UTM)}", UTM, None),
    "without a blank": (wkt(UTM), UTM, None),
    "by another code": (f" {wkt(UTM)}", "EPSG:25832", None),
    "the same heights": (f" {wkt(UTM, EGM96)}", f"{UTM}+{EGM96}", None),
    "heights that the flight states": (f" {wkt(UTM)}", f"{UTM}+{EGM96}", None),
    "another zone": (
        wkt(ZONE_33),
        UTM,
        r"points in 'WGS 84 / UTM zone 33N' lie 446 km away, wanted them in 'EPSG:32632'",
    ),
    "a long name": (wkt(UTM), wkt(ZONE_33), r"zone 32N' lie 446 km away, wanted them in 'WGS 84 / UTM zone 33N'$"),
    "degrees": (wkt(LONLAT), UTM, r"'WGS 84', wanted points in 'EPSG:32632'"),
    "a map": (wkt(UTM), LONLAT, r"'WGS 84 / UTM zone 32N', wanted points in 'EPSG:4326'"),
    "heights of a geoid": (wkt(UTM, EGM96), UTM, r"heights are of 'EGM96 height', wanted those above the ellipsoid"),
    "feet": (wkt(UTM, "EPSG:8228"), f"{UTM}+{NAVD88}", r"lie 356 m away, wanted them in 'EPSG:32632\+EPSG:5703'"),
}


@pytest.mark.parametrize("what", STATED)
def test_the_crs_that_a_list_states_is_that_of_the_project(tmp_path, what):
    stated, crs, wanted = STATED[what]
    path, text = tmp_path / "control.csv", f"# CoordinateSystem:{stated}\n{HEAD}\n{ROW}\n"
    text = text.replace("# C", "#C") if what == "without a blank" else text
    if wanted is None:
        points, place, _, notes = read(path, text, crs)
        assert points.id == ("P1",) and notes == []
        np.testing.assert_allclose(place[0, :2], PLACE, rtol=0, atol=1e-8)
    else:
        with pytest.raises(UserError, match=r"control\.csv:1: CoordinateSystem: .*" + wanted):
            read(path, text, crs)


def test_a_stated_crs_that_proj_does_not_know_is_noted(tmp_path):
    text = f"#CoordinateSystem: WGS84; EPSG: 4326\n{HEAD}\n{ROW}\n"
    assert read(tmp_path / "a.csv", text)[3] == [
        "a.csv: CoordinateSystem 'WGS84; EPSG: 4326' is none that PROJ knows, and was ignored"
    ]


def test_empty_rows_as_spreadsheets_leave_them_are_none(tmp_path):
    first, empty, row = LISTS["a spreadsheet"], ";;;;;;\r\n", "P2;691001,5;5334000,2;512,3;0,01;0,02;0,03\r\n"
    points, place, _, _ = read(tmp_path / "control.csv", first + empty + row + empty + ";;\r\n")
    assert points.id == ("P1", "P2")
    np.testing.assert_allclose(place[0], [*PLACE, 512.3], rtol=0, atol=1e-8)
    with pytest.raises(UserError, match=r"control\.csv:4: E: '69a' is not a number"):  # lines count as in the file
        read(tmp_path / "control.csv", first + empty + row.replace("691001,5", "69a"))
    with pytest.raises(UserError, match=r"control\.csv:4: Name: P1 comes twice"):
        read(tmp_path / "control.csv", first + empty + row.replace("P2", "P1"))
    with pytest.raises(UserError, match=r"control\.csv:3: Name: missing, wanted a name"):  # not empty in another column
        read(tmp_path / "control.csv", first.replace("\r\n", ";Code\r\n", 1) + ";;;;;;;tree\r\n")


@pytest.mark.parametrize("what", BAD)
def test_a_list_that_cannot_be_read_is_told_by_its_line(tmp_path, what):
    text, wanted = BAD[what]
    with pytest.raises(UserError, match=wanted):
        read(tmp_path / "control.csv", text)
