"""The elevation model that tie points lie on: from options of `process`, from a flight folder, and what is wrong."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from recording_file import write_recording

from triline.nodes import registry
from triline.nodes.cli import main
from triline.nodes.config import build, elevation, load
from triline.nodes.errors import UserError
from triline.nodes.formats.geotiff import Heights, write_heights
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.runner import process
from triline.nodes.recording.writer import RecordingWriter
from triline.nodes.simulator.simulator import Simulator
from triline.solver.simulation.error_models import ErrorModel
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

EPOCH = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A folder with a strip without control over ground with a raster, and the sums of their heights."""
    folder = tmp_path_factory.mktemp("flight")
    plan = FlightPlan(strip_s=12.0, lead_in_s=3.0, lead_out_s=2.0)
    errors = ErrorModel(attitude_rate_hz=50.0, offset_sigma_m=(0.3, 0.3, 2.0))
    simulation = simulate(plan, 4, errors, ObservationPlan(tie_points_per_s=5.0, control=0, check=0))
    write_recording(folder / "flight.mcap", Simulator(simulation).messages(EPOCH))
    write_heights(folder / "dem.tif", raster(simulation))
    (folder / "flight.toml").write_text(
        '[flight]\nname = "f"\n[dem]\nfile = "dem.tif"\nsigma_m = 0.3\nshift_sigma_m = 0.2\n'
        "[nodes.adjuster]\ngrid_hz = 4\n"
    )
    return folder, simulation


def raster(simulation, **more):
    """The true ground in latitude and longitude, heights above the ellipsoid."""
    frame, xyz = simulation.flight.frame, simulation.points.xyz_l
    lat, lon = frame.to_geodetic(xyz)[:, :2].T
    step = 2e-4
    lats, lons = (
        np.arange(lat.max() + 0.004, lat.min() - 0.004, -step),
        np.arange(lon.min() - 0.004, lon.max() + 0.004, step),
    )
    at = np.stack([a.ravel() for a in np.meshgrid(lats, lons, indexing="ij")], axis=1)
    local = frame.from_geodetic(at[:, 0], at[:, 1], np.full(len(at), frame.height_m))
    z = simulation.flight.terrain.height(local[:, 0], local[:, 1])
    height = frame.to_geodetic(np.column_stack([local[:, :2], z]))[:, 2].reshape(len(lats), len(lons))
    return replace(Heights("EPSG:4326", height, lons[0], lats[0], step, -step, above_ellipsoid=True), **more)


def heights(simulation, data):
    """Mean error of the last heights of the object points in a recording, and their mean sigma."""
    found = {m.body.point: m.body for m in RecordingReader(data).messages(["point/object"])}
    truth = dict(zip(map(str, simulation.points.id), simulation.points.xyz_l[:, 2], strict=True))
    errors = [b.z - truth[name] for name, b in found.items()]
    return np.mean(errors), np.mean([np.sqrt(b.covariance[8]) for b in found.values()])


def processed(folder, out, tables):
    with RecordingWriter(out) as writer:
        nodes = [build(registry.node_class(name), tables) for name in registry.ESTIMATING]
        process(RecordingReader(folder / "flight.mcap"), nodes, writer.write_raw)
    return out


def said(path):
    return [m.body.message for m in RecordingReader(path).messages(["event/log"])]


@pytest.fixture(scope="module")
def oriented(flight, tmp_path_factory):
    """The flight processed with the heights of the raster, as options of the command."""
    folder = tmp_path_factory.mktemp("oriented")
    (folder / "nodes.toml").write_text("[adjuster]\ngrid_hz = 4\n")
    options = ["--dem", flight[0] / "dem.tif", "--dem-sigma", 0.3, "--dem-shift-sigma", 0.2]
    options += ["--pace", "load", "--config", folder / "nodes.toml"]
    command = ["process", flight[0] / "flight.mcap", "-o", folder / "o.mcap", "-q"]
    assert main([str(part) for part in command + options]) == 0
    return folder / "o.mcap"


def test_the_folder_and_the_options_give_the_same_and_the_height_of_the_ground(flight, oriented, tmp_path):
    folder, simulation = flight
    tables = load(folder / "flight.toml", registry.names())
    assert tables["adjuster"] | {"dem": "dem.tif"} == {
        "dem": "dem.tif", "dem_sigma_m": 0.3, "dem_shift_sigma_m": 0.2, "grid_hz": 4,
    }  # fmt: skip
    again = processed(folder, tmp_path / "again.mcap", tables)
    bodies = [
        [(m.topic, m.stamp_ns, m.body.SerializeToString()) for m in RecordingReader(path).messages()]
        for path in (oriented, again)
    ]
    assert bodies[0] == bodies[1]
    assert "tie points lie on dem.tif +- 0.3 m, all of it +- 0.2 m" in said(oriented)
    before = heights(simulation, processed(folder, tmp_path / "without.mcap", {"adjuster": {"grid_hz": 4}}))
    after = heights(simulation, oriented)
    assert before[1] > 1.2 and after[1] < 0.35 and abs(after[0]) < 0.6


def test_adjust_takes_the_raster_of_the_folder(flight, oriented, capsys):
    folder, _ = flight
    assert main(["adjust", str(oriented), "--dem", str(folder), "--json", "-q"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["dem"]["sigma_m"] == 0.3 and result["dem"]["shift_sigma_apriori_m"] == 0.2
    assert result["dem"]["holds_height"] and result["tie"]["sigma_m"][2] < 0.4
    assert "from its trajectories, its height from the raster" in " ".join(result["notes"])
    assert main(["adjust", str(oriented), "--dem", str(folder), "--dem-sigma", "1"]) == 1
    assert "--dem-sigma: [dem] of" in capsys.readouterr().err


def test_a_raster_elsewhere_is_told_and_the_flight_goes_on(flight, tmp_path):
    folder, simulation = flight
    far = raster(simulation)
    write_heights(tmp_path / "far.tif", replace(far, x0=far.x0 + 20.0))
    settings = {"dem": str(tmp_path / "far.tif"), "dem_sigma_m": 0.3, "grid_hz": 4}
    out = processed(folder, tmp_path / "out.mcap", {"adjuster": settings})
    assert sum("far.tif" in line for line in said(out)) == 1, said(out)
    assert heights(simulation, out)[1] > 1.2


WRONG = {
    "no sigma": ({"dem": "dem.tif"}, "dem_sigma_m is 0, wanted the sigma of the heights of"),
    "no raster": ({"dem_sigma_m": 1.0}, "are of a raster of heights, wanted dem"),
    "negative": ({"dem": "dem.tif", "dem_sigma_m": 1.0, "dem_shift_sigma_m": -1.0}, "dem_shift_sigma_m is -1"),
    "not there": ({"dem": "gone.tif", "dem_sigma_m": 1.0}, "gone.tif: no such file"),
    "no datum": ({"dem": "flat.tif", "dem_sigma_m": 1.0}, "does not say what its heights count from, wanted"),
    "datum": ({"dem": "flat.tif", "dem_sigma_m": 1.0, "dem_crs": "EPSG:32632"}, "says nothing of heights"),
}


@pytest.mark.parametrize("what", WRONG)
def test_settings_that_cannot_be_are_refused_in_one_line(flight, tmp_path, what):
    settings, wanted = WRONG[what]
    write_heights(tmp_path / "flat.tif", Heights("EPSG:32632", np.zeros((4, 4)), 5e5, 5.4e6, 10.0, -10.0))
    write_heights(tmp_path / "dem.tif", raster(flight[1]))
    if "dem" in settings:
        settings = settings | {"dem": str(tmp_path / settings["dem"])}
    with pytest.raises(UserError, match=wanted) as caught:
        build(registry.node_class("adjuster"), {"adjuster": settings})
    assert "\n" not in str(caught.value)


TABLES = {
    "sigma_m = 1.0\n": "dem.file is missing, wanted a raster",
    'file = "dem.tif"\nsigma_m = "1"\n': "dem.sigma_m is '1', wanted",
    'file = "dem.tif"\nsigma_m = 1\nshift_sigma_m = 0\n': "dem.shift_sigma_m is 0, wanted",
    'file = "dem.tif"\nsigma_m = 1\nsigma = 1\n': "dem.sigma: not known, wanted file",
}


@pytest.mark.parametrize("table", TABLES)
def test_a_table_of_the_folder_that_cannot_be(tmp_path, table):
    (tmp_path / "flight.toml").write_text('[flight]\nname = "f"\n[dem]\n' + table)
    with pytest.raises(UserError, match=TABLES[table]):
        load(tmp_path / "flight.toml")
    (tmp_path / "flight.toml").write_text('[flight]\nname = "f"\n[dem]\nfile = "dem.tif"\n')
    assert "adjuster" not in load(tmp_path / "flight.toml")
    with pytest.raises(UserError, match="sigma_m is missing, wanted the sigma"):
        elevation(tmp_path / "flight.toml", wanted=True)


def test_messages_before_the_configuration_need_no_raster(flight):
    node = build(registry.node_class("adjuster"), {"adjuster": {"dem": str(flight[0] / "dem.tif"), "dem_sigma_m": 1.0}})
    assert isinstance(node.state(), str) and "waiting" in node.state()
    assert not [m for m in node.finish() if isinstance(m, Message)]
