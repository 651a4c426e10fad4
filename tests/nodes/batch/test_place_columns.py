"""Columns of places state the unit of the CRS: what `adjust` and `export` write, what is read back."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from block_writer import write_block
from small_block import FILES, simulated_block, write_files

from triline.nodes.batch.strip_orientation import OfTable
from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.block_folder import read_block
from triline.nodes.formats.detect import kind_of_path
from triline.nodes.formats.line_orientation import OrientedLines, write_oriented_lines
from triline.nodes.formats.trajectory_csv import read_trajectory_csv
from triline.nodes.recording.access import Recording
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.geometry.frames import GEOGRAPHIC, BodyFrame, LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles

CRS = {
    "EPSG:4979": ["X_deg", "Y_deg", "Z_m"],
    "EPSG:2277": ["X_ft_us", "Y_ft_us", "Z_m"],  # Texas
    "EPSG:32632": ["X_m", "Y_m", "Z_m"],
}
SIGMAS = ["sigma_X_m", "sigma_Y_m", "sigma_Z_m"]


@pytest.mark.parametrize(
    ("frame", "units"),
    [
        (LocalFrame(0.0, 0.0, 0.0), ("m", "m", "m")),
        (LocalFrame(47.0, 10.0, 0.0, "EPSG:4326"), ("deg", "deg", "m")),
        (LocalFrame(47.0, 10.0, 0.0, "EPSG:4807"), ("grad", "grad", "m")),
        (LocalFrame(30.0, -97.0, 0.0, "EPSG:2277+EPSG:6360"), ("ft_us", "ft_us", "ft_us")),
        (LocalFrame(7.0, 80.0, 0.0, "EPSG:24370"), ("crs_unit", "crs_unit", "m")),  # Indian yards
        (LocalFrame(33.0, -111.0, 0.0, "EPSG:2222"), ("ft", "ft", "m")),
        (LocalFrame(47.0, 10.0, 0.0, "EPSG:4978"), ("m", "m", "m")),
        (BodyFrame(WGS84), ("deg", "deg", "m")),
    ],
)
def test_units_of_a_crs(frame, units):
    assert frame.units == units
    if frame.crs in ("EPSG:4326", GEOGRAPHIC):
        at = np.array([[10.01, 47.02, 300.0]])
        np.testing.assert_allclose(frame.to_crs(frame.from_crs(at)), at, atol=1e-8)


@pytest.fixture(scope="module", params=CRS)
def flown(request, tmp_path_factory):
    """A block in a CRS, its recording, and what `adjust` wrote of both."""
    folder = tmp_path_factory.mktemp("crs")
    place = (30.3, -97.7) if "2277" in request.param else (47.5, 10.6)
    write_block(folder / "b", simulated_block(request.param, *place))
    assert main(["import", str(folder / "b"), "-o", str(folder / "b.mcap"), "-q"]) == 0
    for name in ("b", "b.mcap"):
        assert main(["adjust", str(folder / name), "-o", str(folder / f"adjusted {name}"), "--per-line", "-q"]) == 0
    return request.param, folder


def test_tables_name_the_unit_that_is_in_them(flown):
    crs, folder = flown
    known = pd.read_csv(folder / "b" / "ground_points.csv", index_col="point")
    for name in ("b", "b.mcap"):
        out = folder / f"adjusted {name}"
        points = pd.read_csv(out / "points.csv")
        assert list(points.columns[:7]) == ["point", *CRS[crs], *SIGMAS]
        control = points[points.role == "control"].set_index("point")
        off = control[CRS[crs]].to_numpy() - known.loc[control.index, ["X_m", "Y_m", "Z_m"]].to_numpy()
        metres = {"deg": 111e3, "m": 1.0, "ft_us": 0.3048}
        assert np.abs(off * [metres[c[2:]] for c in CRS[crs]]).max() < 0.1
        assert points[SIGMAS].to_numpy().max() < 1.0  # metres, whatever the unit of the coordinates
        refined, lines = (pd.read_csv(out / f) for f in ("trajectory_refined.csv", "orientation_lines.csv"))
        assert list(refined.columns[2:5]) == list(lines.columns[3:6]) == CRS[crs]
        assert set(SIGMAS) < set(refined.columns) and set(SIGMAS) < set(lines.columns)


def test_export_names_it_too(flown, tmp_path):
    crs, folder = flown
    assert main(["export", str(folder / "b.mcap"), "--per-line", str(tmp_path / "l.csv"), "-q"]) == 0
    assert pd.read_csv(tmp_path / "l.csv").columns[3:6].tolist() == CRS[crs]


def test_result_tables_are_read_as_input(flown, tmp_path):
    """The trajectory that was refined, and points, as a block folder or as a table of poses."""
    crs, folder = flown
    out = folder / "adjusted b.mcap"
    path = out / "trajectory_refined.csv"
    assert kind_of_path(path) == "csv"
    one = pd.read_csv(path)
    one[one.strip == one.strip.iloc[0]].to_csv(tmp_path / "one.csv", index=False, float_format="%.11f")
    track = read_trajectory_csv(tmp_path / "one.csv", crs)
    recording = Recording(folder / "b.mcap")
    table = OfTable(recording, tmp_path / "one.csv")
    position, _ = table.orientation.at((track.time_ns[[3]] - table.reference_ns) * 1e-9)
    wanted = recording.frame().from_geodetic(*track.geodetic[3])
    np.testing.assert_allclose(position[0], wanted, atol=1e-3)
    write_block(tmp_path / "again", simulated_block(crs))
    plain = read_block(folder / "b")
    for name in ("trajectory.csv", "ground_points.csv"):
        text = (folder / "b" / name).read_text()
        head, rest = text.split("\n", 1)
        for old, new in zip(("X_m", "Y_m", "Z_m"), CRS[crs], strict=True):
            head = head.replace(f",{old},", f",{new},", 1)
        (tmp_path / "again" / name).write_text(head + "\n" + rest)
    named = read_block(tmp_path / "again")
    np.testing.assert_array_equal(named.ground.xyz_l, plain.ground.xyz_l)
    np.testing.assert_array_equal(named.strips[0].trajectory.position_l, plain.strips[0].trajectory.position_l)
    assert named.notes == plain.notes


def test_a_unit_that_the_crs_has_not_is_refused(tmp_path):
    for name in ("trajectory", "ground_points"):
        bad = FILES[f"{name}.csv"].replace("X_m", "X_deg", 1)
        folder = write_files(tmp_path / name, **{name: bad})
        with pytest.raises(UserError, match=rf"{name}.csv:1: X_deg: coordinates in 'local' are in m, wanted X_m"):
            read_block(folder)
    twice = FILES["trajectory.csv"].replace(",X_m,Y_m,", ",X_m,X_deg,Y_m,")
    with pytest.raises(UserError, match=re.escape("X_deg: this column comes twice, also as X_m")):
        read_block(write_files(tmp_path / "twice", trajectory=twice))
    wrong = FILES["trajectory.csv"].replace("X_m", "X_deg").replace(",70.0,", ",east,")
    with pytest.raises(UserError, match=r"trajectory.csv:3: X_deg: 'east' is not a number"):
        read_block(write_files(tmp_path / "word", trajectory=wrong))


@pytest.mark.parametrize(
    "crs", ["EPSG:4978", "EPSG:3413", "EPSG:32632"]
)  # geocentric, polar, and nearly east and north
def test_sigmas_of_lines_are_along_the_axes_of_the_crs(crs, tmp_path):
    frame = LocalFrame(75.0, 10.0, 0.0, crs)
    rng = np.random.default_rng(2)
    n, place = 4000, np.array([100.0, -200.0, 1500.0])
    sigma = np.array([0.1, 0.3, 0.8, 4e-5, 1e-5, 2e-4])
    off = rng.normal(size=(n, 6)) * sigma
    angles = np.array([0.02, -0.03, 1.0])
    nothing = np.arange(n)
    known = np.broadcast_to(np.diag(sigma**2), (n, 6, 6))
    drawn = OrientedLines(
        "S1", nothing, nothing, place + off[:, :3], matrix_from_angles(*(angles + off[:, 3:]).T), known
    )
    assert write_oriented_lines(tmp_path / "l.csv", [drawn], frame) == n
    table = pd.read_csv(tmp_path / "l.csv")
    names = ["X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"]
    stated = table[[f"sigma_{name}" for name in names]].to_numpy()[0]
    assert stated == pytest.approx(table[names].std().to_numpy(), rel=0.06)
