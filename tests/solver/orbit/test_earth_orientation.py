"""Rotation between ITRF and GCRS, against astropy, off line."""

from __future__ import annotations

import numpy as np
import pytest

from triline.nodes.formats.satellite.earth_orientation_file import installed_table
from triline.solver.orbit.earth_orientation import EarthOrientation, EarthOrientationTable, R_bias
from triline.solver.orbit.time_scales import parse_time

DAY = 86_400 * 1_000_000_000
START = parse_time("2004-03-01T00:00:00Z")


def astropy_gcrs(tai_ns, position_e):
    """GCRS coordinates (n, 3) of ITRF positions (n, 3) by astropy with the data that are installed."""
    from astropy import units
    from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        day, ns = np.divmod(tai_ns, DAY)
        when = Time(2440587.5 + day, ns / DAY, format="jd", scale="tai")
        itrs = ITRS(CartesianRepresentation(position_e.T * units.m), obstime=when)
        return itrs.transform_to(GCRS(obstime=when)).cartesian.xyz.to_value(units.m).T


def test_twenty_years_agree_with_astropy():
    rng = np.random.default_rng(20)
    tai_ns = START + rng.integers(0, int(20.0 * 365.25 * DAY), 200)
    position = rng.normal(size=(200, 3))
    position *= 7.1e6 / np.linalg.norm(position, axis=1, keepdims=True)
    R = EarthOrientation(installed_table(), START).R_ie_at(tai_ns)
    ours = np.einsum("nij,nj->ni", R, position)
    assert np.abs(ours - astropy_gcrs(tai_ns, position)).max() < 1e-6


@pytest.mark.parametrize("span_s", [10.0, 6000.0, 40 * 86400.0])
def test_many_epochs_are_interpolated_to_the_same(span_s):
    earth = EarthOrientation(installed_table(), START)
    time_s = np.linspace(0.0, span_s, 3000)
    many = earth.R_ie(time_s)
    some = np.concatenate([earth.R_ie(time_s[k : k + 1]) for k in range(0, 3000, 300)])
    assert np.abs(many[::300] - some).max() * 7.1e6 < 1e-6


def test_seconds_run_on_through_a_leap_second():
    earth = EarthOrientation(installed_table(), parse_time("2016-12-31T23:59:50Z"))
    R = earth.R_ie(np.arange(0.0, 20.0))
    turns = np.linalg.norm(np.diff(R, axis=0), axis=(1, 2))
    np.testing.assert_allclose(turns, turns[0], rtol=1e-6)


def test_frame_bias_is_some_milliarcseconds():
    turn = np.linalg.norm(R_bias() - np.eye(3)) / np.sqrt(2.0)
    assert 20e-3 < np.degrees(turn) * 3600.0 < 30e-3


def test_dates_before_the_table_are_refused_and_after_it_told():
    table = EarthOrientationTable(np.array([58000.0, 58001.0]), np.array([0.3, 0.29]), np.zeros(2), np.zeros(2))
    early = EarthOrientation(table, parse_time("2017-08-30T00:00:00Z"))
    with pytest.raises(
        ValueError, match="2017-08-30T00:00:00Z lies before the Earth orientation table, which begins 2017"
    ):
        early.R_ie([0.0])
    inside = EarthOrientation(table, parse_time("2017-09-04T12:00:00Z"))
    assert inside.warning(0.0, 60.0) == ""
    late = EarthOrientation(table, parse_time("2017-09-15T00:00:00Z"))
    assert np.isfinite(late.R_ie([0.0])).all()
    assert "after the Earth orientation table, which ends 2017-09-05: up to 4.7 m" in late.warning(0.0, 60.0)


def test_days_must_increase():
    with pytest.raises(ValueError, match="days must increase"):
        EarthOrientationTable(np.array([58001.0, 58000.0]), np.zeros(2), np.zeros(2), np.zeros(2))
