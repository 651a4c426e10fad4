"""A camera that is not as calibrated: it is found, told, and estimated where it may be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from triline.solver.camera.displacement import most_certain
from triline.solver.camera.self_calibration import (
    FOCAL_SIGMA,
    LEFT,
    LEFT_OPEN,
    focal_length,
    left_by_calibration,
    lens,
    tls,
)
from triline.solver.camera.sensors import preset
from triline.solver.models.platform import PlatformErrors
from triline.solver.simulation.camera_errors import drawn_parameters, simulate_with_camera_errors
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import OBSERVED, ROWS, SETTINGS
from triline.solver.simulation.scenario import simulate
from triline.solver.simulation.window_study import adjust_online, navigate, orientation_errors, point_errors
from triline.solver.window.quality.light import BADLY_CALIBRATED, FAILED, GOOD, WEAK
from triline.solver.window.results import WindowOptions

PLAN, OPTIONS = FlightPlan(strip_s=40.0, lead_in_s=3.0, lead_out_s=2.0), WindowOptions(grid_hz=4.0)
ADS40 = preset("ads40")


def rmse(simulation, online) -> float:
    return float(np.sqrt((point_errors(simulation, online.whole_points).error ** 2).sum(axis=1).mean()))


@cache
def measured(share: float, row: str, seed: int):
    """A flight with carrier-phase GNSS whose camera is off by a share of 0.1 mm at the edge, about, and its poses."""
    if share:
        stated = tls(PLAN.camera, 12).scaled(share)
        simulation = simulate_with_camera_errors(PLAN, seed, stated, SETTINGS["rtk"], OBSERVED)
    else:
        simulation = simulate(PLAN, seed, SETTINGS["rtk"], OBSERVED, world=ROWS[row].world)
    return simulation, navigate(simulation)


@cache
def flown(share: float, known: str = "calibrated", row: str = "stated", seed: int = 1):
    """Such a flight through the window."""
    simulation, poses = measured(share, row, seed)
    parameters = left_by_calibration(PLAN.camera) if known == "calibrated" else focal_length(PLAN.camera)
    online = adjust_online(
        simulation, poses, OPTIONS, parameters, live=False, update_s=1.0, platform=PlatformErrors(1e-3)
    )
    return simulation, online


def test_what_a_calibration_leaves_open():
    one = left_by_calibration(ADS40)
    assert one.name == LEFT and one.as_calibrated and not tls(ADS40).as_calibrated
    expected = dict(zip(tls(ADS40).names, LEFT_OPEN * tls(ADS40).sigma, strict=True)) | {"dc": FOCAL_SIGMA}
    assert dict(zip(one.unknown_names, one.apriori_sigma, strict=True)) == pytest.approx(
        {name: expected[name] for name in one.unknown_names}
    )
    assert not any(name.endswith(f"_{ADS40.nadir_line.id}") or name == "k3" for name in one.unknown_names)
    many = preset("alos-prism")
    assert len(many.lenses) > 1 and left_by_calibration(many).names == lens(many).names


def test_the_displacement_that_is_most_certain():
    parameters = tls(ADS40)
    value, Q = np.zeros(parameters.n_unknowns), np.diag(parameters.apriori_sigma**2) * 1e-8
    place = parameters.unknown_names.index("yp_F")
    value[place] = 0.13
    worst = most_certain(ADS40, parameters, value, Q)
    pitch_mm = np.linalg.norm(ADS40.lines[0].image_coordinates(0.0)[1])
    assert worst.ccd == "F" and worst.off_px == pytest.approx(0.13 / pitch_mm, rel=0.01)


@pytest.mark.parametrize("share", [pytest.param(0.01, marks=pytest.mark.study), 0.1])
def test_a_camera_that_is_worse_than_calibrated_is_estimated(share):
    """With the focal length alone some pixels of distortion made points metres wrong, worse than direct
    georeferencing."""
    simulation, online = flown(share)
    good = rmse(*flown(0.0))
    calibration = online.window.network.calibration
    assert calibration.factor > 1.8
    assert any(event.startswith("sigmas: calibration of the camera") for event in online.events)
    assert any(event.startswith("camera: looks are off its calibration by") for event in online.events)
    assert rmse(simulation, online) < 1.6 * good
    assert orientation_errors(simulation, online.whole).nees.mean() < 2.5
    assert point_errors(simulation, online.whole_points).nees.mean() < 2.5
    if calibration.factor > BADLY_CALIBRATED:
        assert online.reports[-1].quality.light == WEAK and "camera is calibrated" in online.reports[-1].quality.reason


def test_the_errors_of_the_camera_are_found():
    _, online = flown(0.1)
    true = drawn_parameters(1, tls(PLAN.camera, 12).scaled(0.1))
    names = left_by_calibration(PLAN.camera).unknown_names
    value, Q = online.window.network.calibration.values()
    of = [names.index(name) for name in tls(PLAN.camera, 12).unknown_names]
    error = value[of] - true
    assert error @ np.linalg.solve(Q[np.ix_(of, of)], error) / len(of) < 4.0


def test_a_camera_as_calibrated_is_not_questioned():
    _, online = flown(0.0)
    assert online.window.network.calibration.factor == 1.0
    assert online.reports[-1].quality.light == GOOD
    with_focal = rmse(*flown(0.0, "focal"))
    assert rmse(*flown(0.0)) < 1.05 * with_focal


@pytest.mark.parametrize(
    ("row", "seed"),
    [
        ("sine-fast", 12),
        ("sine-slow", 5),
        *(pytest.param(*of, marks=pytest.mark.study) for of in (("sine-fast", 5), ("sine-fast", 7))),
        *(pytest.param(row, 5, marks=pytest.mark.study) for row in ("step", "clock")),
    ],
)
def test_other_errors_are_not_taken_for_the_camera(row, seed):
    """A vibration was, and the calibration stated thousands of times as bad; and while its noise was being found, eight
    and sixteen times in flights 7 and 12."""
    _, online = flown(0.0, "calibrated", row, seed)
    assert online.window.network.calibration.factor == 1.0
    assert not any("camera" in event for event in online.events)


def test_a_camera_that_must_not_be_estimated_is_told():
    _, online = flown(0.1, "focal")
    told = [event for event in online.events if event.startswith("camera: the camera is not as calibrated")]
    assert len(told) == 1 and 'self_calibration = "tls12"' in told[0]
    assert any(r.quality.camera is not None and r.quality.light == FAILED for r in online.reports)


@pytest.mark.parametrize(("row", "seed"), [("stated", 1), ("sine-fast", 3), ("boresight", 3)])
def test_no_other_error_is_told_as_the_camera(row, seed):
    _, online = flown(0.0, "focal", row, seed)
    assert all(r.quality.camera is None for r in online.reports)
