"""Leap seconds, texts and stamps."""

from __future__ import annotations

import numpy as np
import pytest

from triline.solver.orbit.time_scales import (
    iso_utc,
    julian_dates,
    parse_time,
    tai_from_day,
    tai_from_unix,
    unix_from_tai,
)

SECOND = 1_000_000_000


def test_scales_of_one_instant():
    utc = parse_time("2018-12-26T10:48:55.4490001Z")
    assert utc == parse_time("2018-12-26T10:49:32.4490001", "TAI")
    assert utc == parse_time("2018-12-26 10:49:13.449000100", "GPS")
    assert utc == parse_time("2018-12-26T10:50:04.6330001", "TT")


def test_a_leap_second_is_a_second():
    before, inside, after = (
        parse_time(text) for text in ("2016-12-31T23:59:59Z", "2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z")
    )
    assert (inside - before, after - inside) == (SECOND, SECOND)


def test_stamps_there_and_back():
    stamps = np.array(["2005-12-31T23:59:59.5", "2006-01-01T00:00:00", "2016-12-31T23:59:59", "2026-01-01"], "M8[ns]")
    ns = stamps.astype(np.int64)
    np.testing.assert_array_equal(unix_from_tai(tai_from_unix(ns)), ns)
    assert int(tai_from_unix(ns[1]) - tai_from_unix(ns[0])) == SECOND + SECOND // 2
    assert iso_utc(int(tai_from_unix(ns[2]))) == "2016-12-31T23:59:59.000Z"


def test_julian_dates_have_the_midnight_apart():
    day, rest = julian_dates(parse_time("2018-12-26T12:00:00", "TT"), [0.0, 43_200.0], "TT")
    assert day % 1 == 0.5
    np.testing.assert_allclose(day + rest, [2458479.0, 2458479.5], atol=1e-9)


@pytest.mark.parametrize("text", ["", "2018-02-30T00:00:00", "2018-12-26", "2018-12-26T25:00:00Z", "yesterday"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match=r"time|calendar"):
        parse_time(text)


def test_an_unknown_scale_is_refused():
    with pytest.raises(ValueError, match=r"TDB.*wanted one of UTC"):
        tai_from_day(58000, 0, "TDB")
