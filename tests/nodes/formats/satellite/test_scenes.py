"""Every format gives the scene that was written: rays through the true pixels, round trips everywhere on the Earth."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from satellite_scenes import Truth, utc, write_dimap1, write_dimap2, write_folder, write_isd
from scipy.spatial.transform import Rotation

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.formats.satellite.folder_writer import write_overpass
from triline.nodes.formats.satellite.read import read_scene
from triline.solver.geometry.earth import ROTATION_RATE
from triline.solver.geometry.ellipsoid import WGS84, Ellipsoid
from triline.solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass

WRITERS = {
    "dimap2-list": lambda folder, truth: write_dimap2(folder / "scene.xml", truth),
    "dimap2-polynomial": lambda folder, truth: write_dimap2(folder / "scene.xml", truth, polynomial=True),
    "dimap2-columns": lambda folder, truth: write_dimap2(folder / "scene.xml", truth, first_col=101),
    "dimap1": lambda folder, truth: write_dimap1(folder / "scene.dim", truth),
    "dimap1-spot4": lambda folder, truth: write_dimap1(folder / "scene.dim", truth, "SPOT 4"),
    "isd": lambda folder, truth: write_isd(folder / "scene.json", truth),
    "isd-inertial": lambda folder, truth: write_isd(folder / "scene.json", truth, inertial=True),
    "folder-angles": lambda folder, truth: write_folder(folder / "scene", truth),
    "folder-quaternions": lambda folder, truth: write_folder(folder / "scene", truth, angles=False, velocities=False),
}
#: Somewhere, over the pole, over the date line, over both; the last looks far sideways.
PLACES = {
    "middle latitude": Truth(),
    "north pole": Truth(inclination_deg=90.0, phase_deg=89.9, tilt_deg=(0.0, 0.0, 0.0)),
    "south pole": Truth(inclination_deg=90.0, phase_deg=-90.1, tilt_deg=(0.0, 0.5, 0.0)),
    "date line": Truth(inclination_deg=98.0, node_deg=180.73, phase_deg=5.0, tilt_deg=(0.0, 0.0, 0.0)),
    "oblique": Truth(tilt_deg=(35.0, 20.0, 5.0)),
}


def pixels(sensor, n=9):
    """Pixels of a grid with the edges of the image, half a pixel outside the outermost centres."""
    u, v = np.meshgrid(np.linspace(-0.5, sensor.lines - 0.5, n), np.linspace(-0.5, sensor.samples - 0.5, n))
    return u.ravel(), v.ravel()


@pytest.mark.parametrize("name", WRITERS)
def test_rays_of_the_file_pass_through_the_pixels_of_the_truth(name, tmp_path):
    truth = Truth()
    sensor = read_scene(WRITERS[name](tmp_path, truth)).model("rigorous")
    assert (sensor.lines, sensor.samples) == (truth.lines, truth.samples)
    u, v = pixels(sensor)
    for height in (-400.0, 0.0, 9000.0):
        located = sensor.direct(u, v, height)
        np.testing.assert_allclose(located[:, 2], height, atol=1e-6)
        assert truth.miss_m(u, v, located, inertial=name != "dimap1") < 1e-3


def test_orbit_and_attitudes_of_dimap_2_that_end_inside_the_scene(tmp_path):
    """Those of Pleiades Neo begin some of their steps of 4 ms after the first line."""
    truth = Truth(lines=4000)
    sensor = read_scene(write_dimap2(tmp_path / "scene.xml", truth, short_s=0.012)).model("rigorous")
    u, v = pixels(sensor, 21)
    assert truth.miss_m(u, v, sensor.direct(u, v, 100.0)) < 2e-3
    with pytest.raises(UserError, match=r"lines are taken from .* but the orbit is given from"):
        read_scene(write_dimap2(tmp_path / "short.xml", truth, short_s=0.06))


def test_biases_of_the_instrument_of_dimap_2_are_told(tmp_path):
    """All real files have zeros there; nobody knows what else would mean."""
    path = write_dimap2(tmp_path / "scene.xml", Truth())
    text, place = path.read_text(), "<Geometric_Calibration><Instrument_Calibration>"
    for pitch, said in (
        ("0.0", []),
        ("1e-3", ["scene.xml: Instrument_Biases: yaw, pitch, roll of 0, 0.001, 0 are not applied"]),
    ):
        biases = f"<Instrument_Biases><YAW>0.0</YAW><PITCH>{pitch}</PITCH><ROLL>0.0</ROLL></Instrument_Biases>"
        path.write_text(text.replace(place, place + biases))
        assert read_scene(path).notes == said


@pytest.mark.parametrize("unit", [None, "ms", "microsecond", "us", "s"])
def test_units_of_the_line_period_of_dimap_2(unit, tmp_path):
    """Milliseconds of Pleiades, microseconds of SPOT-6/7; some files do not tell."""
    path = write_dimap2(tmp_path / "scene.xml", Truth())
    text, said = path.read_text(), '<LINE_PERIOD unit="ms">0.2<'
    assert said in text
    for number in ("0.2", "200") if unit is None else (str({"s": 2e-4, "ms": 0.2}.get(unit, 200.0)),):
        attribute = f" unit='{unit}'" if unit else ""
        path.write_text(text.replace(said, f"<LINE_PERIOD{attribute}>{number}<"))
        times = read_scene(path).model("rigorous").line_times
        np.testing.assert_allclose(times.time_of([0.0, 1000.0]), [0.0, 0.2])


@pytest.mark.parametrize("kind", ["dimap1", "dimap2-list"])
def test_corners_that_a_file_gives_elsewhere_than_its_orbit_and_attitude_are_told(kind, tmp_path):
    """Of ground up to 9000 m nothing is told; of corners 5 km off it is, as of SPOT-4 read as SPOT-5."""
    path = WRITERS[kind](tmp_path, Truth(tilt_deg=(30.0, 5.0, 0.0)))
    text, sensor = path.read_text(), read_scene(path).model("rigorous")
    prefix, place, end = {
        "dimap1": ("FRAME_", "Dataset_Frame", "<Raster_Dimensions>"),
        "dimap2-list": ("", "Dataset_Content><Dataset_Extent", "<Raster_Data>"),
    }[kind]
    rows, columns = np.array([0.0, 0.0, 19999.0]), np.array([0.0, 5999.0, 5999.0])
    for height, shift_deg, told in ((0.0, 0.0, False), (9000.0, 0.0, False), (0.0, 0.05, True)):
        corners = "".join(
            "<Vertex>"
            + "".join(
                f"<{prefix}{name}>{value:.12g}</{prefix}{name}>"
                for name, value in (("ROW", u + 1), ("COL", v + 1), ("LAT", lat + shift_deg), ("LON", lon))
            )
            + "</Vertex>"
            for u, v, (lat, lon, _) in zip(rows, columns, np.degrees(sensor.direct(rows, columns, height)), strict=True)
        )
        close = "></".join(reversed(place.split("><")))
        path.write_text(text.replace(end, f"<{place}>{corners}</{close}>{end}"))
        notes = read_scene(path).notes
        assert len(notes) == told
        if told:
            assert re.search(r"scene\.\w+: row \d+, column \d+ lies 5\.\d+ km from where the file says", notes[0])


def test_raw_attitudes_of_dimap_1_with_angular_speeds_between(tmp_path):
    """As SPOT-1 to 4 have them: an angle at both ends, and speeds; a straight line between the ends is 10 m off."""
    truth = Truth(tilt_deg=(0.0, 0.0, 0.0))
    t = -1.0 + 0.125 * np.arange(49)

    def pitch(at):
        return 4e-5 + 2e-5 * np.sin(2.0 * np.pi * (at + 1.0) / 4.0)

    def node(tag, at, value):
        return (
            f"<{tag}><TIME>{utc(at)}</TIME><YAW>0.0</YAW><PITCH>{value!r}</PITCH><ROLL>0.0</ROLL>"
            f"<OUT_OF_RANGE>N</OUT_OF_RANGE></{tag}>"
        )

    speeds = np.gradient(pitch(t), 0.125)
    ends = "".join(node("Angles", at, float(pitch(at))) for at in (t[0], t[-1]))
    between = "".join(node("Angular_Speeds", at, float(v)) for at, v in zip(t[1:-1], speeds[1:-1], strict=True))
    raw = (
        f"<Raw_Attitudes><Aocs_Attitude><Angles_List>{ends}</Angles_List><Angular_Speeds_List>{between}"
        "</Angular_Speeds_List></Aocs_Attitude></Raw_Attitudes>"
    )
    path = write_dimap1(tmp_path / "scene.dim", truth, "SPOT 4")
    pattern = "<Corrected_Attitudes>.*</Corrected_Attitudes>"
    path.write_text(re.sub(pattern, raw, path.read_text(), flags=re.DOTALL))
    scene = read_scene(path)
    assert scene.notes == ["scene.dim: no corrected attitudes, the raw ones of the attitude control are used"]
    at = np.linspace(0.0, 4.0, 41)
    centre_s = (truth.lines // 2 - 1) * truth.period_s
    # the axes of the handbook are right, forward, up; pitch turns against the first
    handbook = truth.orbital_frame(at)[:, :, [1, 0, 2]] * [1.0, 1.0, -1.0]
    turn = Rotation.from_matrix(np.swapaxes(handbook, 1, 2) @ scene.sensor.motion.at(at - centre_s).R_eb)
    np.testing.assert_allclose(turn.as_rotvec(), np.stack([-pitch(at), 0 * at, 0 * at], axis=1), atol=1e-6)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", ["dimap2-list", "dimap1", "isd-inertial", "folder-angles"])
def test_round_trip_at_the_ends_of_the_scene(name, place, tmp_path):
    sensor = read_scene(WRITERS[name](tmp_path, PLACES[place])).model("rigorous")
    u, v = pixels(sensor)
    for height in (-400.0, 9000.0):
        located = sensor.direct(u, v, height)
        back = sensor.inverse(*located.T)
        np.testing.assert_allclose(back, np.stack([u, v], axis=1), atol=1e-6)


@pytest.mark.parametrize("place", ["north pole", "south pole", "date line"])
def test_scenes_over_poles_and_date_line_really_are(place, tmp_path):
    sensor = read_scene(write_dimap2(tmp_path / "scene.xml", PLACES[place])).model("rigorous")
    u, v = pixels(sensor)
    located = np.degrees(sensor.direct(u, v, 0.0))
    if place == "date line":
        assert located[:, 1].min() < -179.9 and located[:, 1].max() > 179.9
    else:
        assert np.ptp(located[:, 1]) > 300.0 and np.abs(located[:, 0]).max() > 89.8


def test_points_beside_the_image_are_not_in_it(tmp_path):
    sensor = read_scene(write_dimap2(tmp_path / "scene.xml", Truth())).model("rigorous")
    u, v = np.array([100.0, 10_000.0]), np.array([3000.0, 5999.0])
    ground = sensor.ground(u, v, 0.0)
    assert np.isfinite(sensor.ground_to_pixel(ground)).all()
    assert np.isnan(sensor.ground_to_pixel(-ground)).all(), "the other side of the Earth"
    sideways = np.cross(ground, sensor.pose(u).velocity_e)
    away = ground + 20e3 * sideways / np.linalg.norm(sideways, axis=1, keepdims=True)
    assert np.isnan(sensor.ground_to_pixel(away)).all()
    # with a margin they have coordinates outside
    ahead = sensor.ground(np.array([-300.0, 20_300.0]), v, 0.0)
    assert np.isnan(sensor.ground_to_pixel(ahead)).all()
    np.testing.assert_allclose(sensor.ground_to_pixel(ahead, 400.0)[:, 0], [-300.0, 20_300.0], atol=1e-6)


def test_orbit_and_attitude_may_end_with_the_image(tmp_path, capsys):
    """Its outer pixels are a line wide; what lies in their outer halves was a fault, and ground beside them in them."""
    truth = Truth(lines=2000, samples=300)
    whole = read_scene(write_folder(tmp_path / "whole", truth, angles=False)).model("rigorous")
    folder = write_folder(tmp_path / "short", truth, angles=False)
    t = np.linspace(0.0, (truth.lines - 1) * truth.period_s, 12)
    for name, columns, values in (
        ("ephemeris.csv", "X_m,Y_m,Z_m", truth.orbit(t)[0]),
        ("attitude.csv", "qx,qy,qz,qw", Rotation.from_matrix(truth.R_eb(t)).as_quat()),
    ):
        rows = [f"{utc(k)}," + ",".join(f"{x:.15g}" for x in row) for k, row in zip(t, values, strict=True)]
        (folder / name).write_text("\n".join([f"time_utc,{columns}", *rows, ""]))
    short = read_scene(folder).model("rigorous")
    line, sample = np.array([-0.4, 0.0, 1999.0, 1999.4]), np.array([10.0, 20.0, 30.0, 40.0])
    np.testing.assert_allclose(short.ground(line, sample, 100.0), whole.ground(line, sample, 100.0), atol=2e-3)
    inside = short.ground_to_pixel(whole.ground(line, sample, 100.0))
    np.testing.assert_allclose(inside, np.stack([line, sample], axis=1), atol=1e-3)
    beside = whole.ground(np.array([-0.9, -0.6, 1999.6, 1999.9]), sample, 100.0)
    assert np.isnan(short.ground_to_pixel(beside)).all() and np.isnan(whole.ground_to_pixel(beside)).all()
    with pytest.raises(ValueError, match="lies outside"):
        short.ground([-2.0], [10.0], 100.0)
    (tmp_path / "pixels.csv").write_text("column,row,height_m\n10,-0.4,100\n")
    assert main(["locate", str(folder), "--pixels", str(tmp_path / "pixels.csv"), "-o", str(tmp_path / "g.csv")]) == 0
    assert "1 rows, 0 of them miss" in capsys.readouterr().out


def test_another_planet(tmp_path):
    truth = Truth()
    flat = read_scene(write_isd(tmp_path / "a.json", truth, semi_minor_km=6300.0)).model("rigorous")
    u, v = pixels(flat)
    X = flat.ground(u, v, 0.0)
    on = (X[:, 0] ** 2 + X[:, 1] ** 2) / 6378137.0**2 + X[:, 2] ** 2 / 6300e3**2
    np.testing.assert_allclose(on, 1.0, rtol=1e-12)
    np.testing.assert_allclose(flat.inverse(*flat.direct(u, v, 500.0).T), np.stack([u, v], axis=1), atol=1e-6)


@pytest.mark.parametrize("earth_fixed", [False, True])
@pytest.mark.parametrize("name", ["alos-prism", "aster-vnir", "eros-a1"])
def test_a_simulated_overpass_comes_back_from_its_folder(name, earth_fixed, tmp_path):
    """60 s positions and 0.1 s attitudes, lenses with mountings of their own: a millimetre on the ground."""
    true = overpass(ORBITAL_SENSORS[name], 36.0, 139.6, roll_deg=1.2)
    write_overpass(tmp_path / "scene", true, earth_fixed=earth_fixed)
    scene = read_scene(tmp_path / "scene")
    assert list(scene.sensors) == list(true.sensors)
    for id, sensor in true.sensors.items():
        u, v = pixels(sensor, 5)
        located = scene.model("rigorous", id).ground(u, v, 500.0)
        assert np.linalg.norm(located - sensor.ground(u, v, 500.0), axis=1).max() < 2e-3, id


def test_a_mounting_of_a_lens_that_is_not_there(tmp_path):
    write_overpass(tmp_path / "scene", overpass(ORBITAL_SENSORS["eros-a1"], 36.0, 139.6))
    with open(tmp_path / "scene" / "scene.toml", "a") as file:
        file.write("[lens.Q]\nboresight_deg = [0.0, 1.0, 0.0]\n")
    with pytest.raises(UserError, match=r"scene.toml: lens.Q: no lens of camera.json, wanted P"):
        read_scene(tmp_path / "scene")


def test_half_axes_of_the_earth_as_files_write_them_out(tmp_path):
    """Those of the pages and of ISDs end earlier; such scenes were of "another planet" beside others."""
    planet = "[planet]\nsemi_major_m = 6378137.0\nsemi_minor_m = 6356752.314245\n"
    settings = "[frames]\nattitude = 'orbital'\n" + planet
    assert read_scene(write_folder(tmp_path / "scene", Truth(), settings=settings)).sensor.ellipsoid is WGS84
    assert read_scene(write_isd(tmp_path / "a.json", Truth(), semi_minor_km=6356.7523142)).sensor.ellipsoid is WGS84
    other = read_scene(write_isd(tmp_path / "b.json", Truth(), semi_minor_km=6356.7513142)).sensor.ellipsoid
    assert other == Ellipsoid(6378137.0, 6356751.3142) != WGS84


STARS = "ephemeris.csv: velocities are against the stars, the rotation of the Earth was taken off"
NO_SLOPE = "ephemeris.csv: velocities are not the slope of the positions and were not used"


@pytest.mark.parametrize("rows", [4, 6, 11])
@pytest.mark.parametrize(
    ("change", "notes"),
    [
        (lambda P, V: V, []),
        (lambda P, V: V + np.cross([0.0, 0.0, ROTATION_RATE], P), [STARS]),
        (lambda P, V: 1e-3 * V, [NO_SLOPE]),
        (lambda P, V: V[:, [1, 0, 2]], [NO_SLOPE]),
    ],
)
def test_velocities_of_a_folder_that_are_not_the_slope_of_its_positions(change, notes, rows, tmp_path):
    """Such as those against the stars, beside Earth-fixed positions: the scene lay 7 km off, and nothing said so."""
    folder = tmp_path / "scene"
    write_overpass(folder, overpass(ORBITAL_SENSORS["spot5-hrs"], 36.0, 139.6))
    right = read_scene(folder)
    head, *lines = (folder / "ephemeris.csv").read_text().splitlines()
    lines = {4: lines[3:7], 6: lines[2:8], 11: lines}[rows]  # about the scene
    numbers = np.array([line.split(",")[1:] for line in lines], dtype=float)
    numbers[:, 3:] = change(numbers[:, :3], numbers[:, 3:])
    times = [line.split(",")[0] for line in lines]
    text = [",".join([time, *(f"{x:.9f}" for x in row)]) for time, row in zip(times, numbers, strict=True)]
    (folder / "ephemeris.csv").write_text("\n".join([head, *text, ""]))
    scene = read_scene(folder)
    assert [note for note in scene.notes if "velocities" in note] == notes
    u, v = pixels(right.sensor)
    off = np.linalg.norm(scene.sensor.ground(u, v, 0.0) - right.sensor.ground(u, v, 0.0), axis=1).max()
    # without velocities an orbit through few nodes, a minute apart, is off by metres
    assert off < (1e-3 if notes != [NO_SLOPE] else {4: 10.0, 6: 0.1, 11: 1e-3}[rows])


def test_an_isd_is_read_as_usgscsm_reads_it(tmp_path):
    """A ball of 1000 km under a camera 50 km above it; the answer is that of a test of usgscsm (release 1.6)."""
    turn = 0.1 * np.arange(16) / 1050.0
    times = (999.2 + 0.1 * np.arange(16)).tolist()
    zero = np.zeros(16)
    position = 1050.0 * np.stack([np.cos(turn), zero, -np.sin(turn)], axis=1)
    velocity = -np.stack([np.sin(turn), zero, np.cos(turn)], axis=1)
    half = 0.5 * (0.5 * np.pi + turn)
    isd = {
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
        "image_lines": 16, "image_samples": 16, "center_ephemeris_time": 1000.0, "line_scan_rate": [[0.5, -0.85, 0.1]],
        "starting_detector_line": 1, "starting_detector_sample": 0, "detector_center": {"line": 0.5, "sample": 8.0},
        "focal2pixel_lines": [0.0, -10.0, 0.0], "focal2pixel_samples": [0.0, 0.0, 10.0],
        "focal_length_model": {"focal_length": 50}, "radii": {"semimajor": 1000, "semiminor": 1000, "unit": "km"},
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
        "instrument_position": {
            "unit": "km", "positions": position.tolist(), "velocities": velocity.tolist(), "ephemeris_times": times,
        },
        "instrument_pointing": {
            "quaternions": np.stack([np.cos(half), zero, -np.sin(half), zero], axis=1).tolist(),
            "ephemeris_times": times,
        },
        "body_rotation": {"quaternions": [[1.0, 0.0, 0.0, 0.0]] * 16, "ephemeris_times": times},
    }  # fmt: skip
    (tmp_path / "ball.json").write_text(json.dumps(isd))
    # the centre of line 8 and sample 8 counted from 0.5 at the first pixel, as there
    located = read_scene(tmp_path / "ball.json").model("rigorous").ground([8.5 - 0.5], [8.0 - 0.5], 0.0)
    np.testing.assert_allclose(located, [[999999.670405, 0.0, -811.905238]], atol=1e-3)


def test_several_bands_and_a_file_without_a_range_of_columns(tmp_path):
    path = write_dimap2(tmp_path / "scene.xml", Truth())
    text = path.read_text()
    low, high = text.index("<Swath_Range>"), text.index("</Instrument_Calibration>")
    band = text[text.index("<Polynomial_Look_Angles>") : high]
    bands = f"<Band_Calibration_List>{2 * f'<Band_Calibration>{band}</Band_Calibration>'}</Band_Calibration_List>"
    path.write_text(text[:low] + bands + text[high:])
    scene = read_scene(path)
    assert any("2 bands, the look angles of the first" in note for note in scene.notes)
    assert any("no range of columns" in note for note in scene.notes)
    u, v = pixels(scene.sensor)
    assert Truth().miss_m(u, v, scene.sensor.direct(u, v, 0.0)) < 1e-3


def test_look_angles_of_some_detectors_are_linear_between_them(tmp_path):
    """As SPOT-4 gives them; the truth here is linear in the tangent, so that some centimetres are left."""
    path = write_dimap1(tmp_path / "scene.dim", Truth())
    full = read_scene(path).sensor
    text = path.read_text()
    found = re.findall(r"<Look_Angles>.*?</Look_Angles>", text)
    for k, element in enumerate(found):
        if k % 1000 and k != len(found) - 1:
            text = text.replace(element, "")
    path.write_text(text)
    u, v = pixels(full)
    off = np.linalg.norm(read_scene(path).sensor.ground(u, v, 0.0) - full.ground(u, v, 0.0), axis=1)
    assert 0.0 < off.max() < 0.05
