"""Attitudes of a file against the flight that its positions say."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest

from triline.nodes.formats.course import attitude_remarks
from triline.nodes.formats.sbet import read_sbet, write_sbet
from triline.nodes.formats.sensor_folder import read_sensor_folder

RIGHT = "the flight turns left where the roll is to the right: wanted positive with the right wing down"


def lines_with_turns(crab=0.0):
    """Two lines to the north-east over the date line, a turn to the right between them, and one back; 60 m/s, 10 Hz.

    Times (n,), s; latitude, longitude, height (n, 3); roll, pitch, heading (n, 3), radians.
    """
    time_s = np.arange(0.0, 120.0, 0.1)
    rate = np.where((time_s > 40.0) & (time_s < 40.0 + np.pi / 0.1), 0.1, 0.0)
    course = 0.8 + np.cumsum(rate) * 0.1
    north, east = (np.cumsum(60.0 * f(course)) * 0.1 / 6_378_137.0 for f in (np.cos, np.sin))
    lon = (np.degrees(east / np.cos(np.radians(-33.0))) + 179.99 + 180.0) % 360.0 - 180.0
    geodetic = np.column_stack([-33.0 + np.degrees(north), lon, np.full(len(time_s), 2000.0)])
    rpy = np.column_stack([np.arctan(60.0 * rate / 9.81), np.zeros(len(time_s)), course + crab])
    return time_s, geodetic, (rpy + np.pi) % (2 * np.pi) - np.pi


def remarks_of(change, crab=0.0):
    time_s, geodetic, rpy = lines_with_turns(crab)
    return attitude_remarks(time_s, geodetic, change(rpy))


@pytest.mark.parametrize("crab", [-0.4, 0.0, 0.4])
def test_attitudes_that_go_with_the_flight_are_not_remarked(crab):
    assert remarks_of(lambda rpy: rpy, crab) == []
    assert remarks_of(lambda rpy: rpy * [0.0, 1.0, 1.0], crab) == []  # a stabilised mount


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (lambda rpy: rpy * [-1.0, 1.0, 1.0], RIGHT),
        (lambda rpy: rpy * [1.0, 1.0, -1.0], "are they counted counter-clockwise?"),
        (
            lambda rpy: rpy + np.array([0.0, 0.0, np.pi]),
            "headings are 180 deg off the course (median), wanted from north",
        ),
        (lambda rpy: rpy + np.array([0.0, 0.0, -np.pi / 2]), "are they counted from east, clockwise?"),
        (lambda rpy: np.radians(rpy), "off the course (median), wanted from north, clockwise"),
    ],
)
def test_headings_and_rolls_of_another_convention_are_told(change, wanted):
    (remark,) = remarks_of(change)
    assert wanted in remark


def test_times_that_are_next_to_each_other_do_no_harm():
    time_s = np.cumsum(np.full(9, 5e-324))
    assert attitude_remarks(time_s, np.zeros((9, 3)), np.zeros((9, 3))) == []


@pytest.mark.parametrize(("tilt", "wanted"), [((np.pi, 0.0), "180 and 0"), ((0.0, 1.5), "0 and 86")])
def test_axes_that_point_up_are_told(tilt, wanted):
    remarks = remarks_of(lambda rpy: np.column_stack([np.full((len(rpy), 2), tilt), rpy[:, 2]]))
    assert remarks == [f"roll and pitch are {wanted} deg off level (median): are the axes forward, right and down?"]


def test_an_aircraft_that_hovers_may_look_anywhere():
    time_s, geodetic, rpy = lines_with_turns()
    assert attitude_remarks(10.0 * time_s, geodetic, rpy + np.array([0.0, 0.0, np.pi])) == []


def test_attitudes_of_a_sensor_folder_are_held_against_its_fixes(tmp_path):
    time_s, geodetic, rpy = lines_with_turns()
    fixes = [f"{t:.1f},{a:.8f},{b:.8f},{h},1,1,2" for t, (a, b, h) in zip(time_s[::10], geodetic[::10], strict=True)]
    (tmp_path / "gnss.csv").write_text(
        "\n".join(["time_s,lat_deg,lon_deg,height_m,sigma_n_m,sigma_e_m,sigma_d_m", *fixes])
    )
    for sign in (1, -1):
        rows = [f"{t:.1f},{r:.4f},{p:.4f},{sign * h:.4f}" for t, (r, p, h) in zip(time_s, np.degrees(rpy), strict=True)]
        (tmp_path / "attitude.csv").write_text("\n".join(["time_s,roll_deg,pitch_deg,heading_deg", *rows]))
        notes = read_sensor_folder(tmp_path).notes
        told = [note for note in notes if note.startswith("attitude.csv: headings are") and "counter-clockwise" in note]
        assert len(told) == (sign == -1)


def test_a_reader_passes_on_what_is_remarked(tmp_path):
    time_s, geodetic, rpy = lines_with_turns()
    write_sbet(tmp_path / "sbet_7.out", time_s + 1000.0, geodetic, rpy * [-1.0, 1.0, 1.0], np.zeros_like(rpy))
    assert f"sbet_7.out: {RIGHT}" in read_sbet(tmp_path / "sbet_7.out", date(2020, 6, 7)).notes
