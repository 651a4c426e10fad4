"""Users' traps: found in the data, named, and never in good data."""

import re
from dataclasses import replace

import inertial_flights as sim
import numpy as np
import pytest

from triline.solver.navigation.inertial_checks import check
from triline.solver.navigation.inertial_cleaning import clean_gnss, clean_inertial, gap_findings, outage_findings
from triline.solver.navigation.inertial_data import InertialData

FLU = np.diag([1.0, -1.0, -1.0])
RFU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def data(**kwargs):
    f = sim.flight(duration_s=300.0, seed=21, **kwargs)
    return f.inertial, f.gnss, f.settings


def turned(d: InertialData, gyro: np.ndarray, accel: np.ndarray) -> InertialData:
    return replace(d, dtheta=d.dtheta @ gyro.T, dv=d.dv @ accel.T)


@pytest.mark.parametrize("grade", ["tactical", "mems"])
@pytest.mark.parametrize("sigma", [(0.02, 0.02, 0.04), (2.0, 2.0, 4.0)])
def test_good_data_raise_no_alarm(grade, sigma):
    for seed in (21, 22):
        f = sim.flight(grade, duration_s=300.0, seed=seed, sigma=sigma)
        assert check(f.inertial, f.gnss, f.settings, increments=False) == []


def test_good_data_at_rest_or_on_a_straight_line_raise_no_alarm():
    for kwargs in ({"static_s": 100.0, "line_s": 300.0}, {"line_s": 300.0, "turbulence": 0.0}):
        f = sim.flight("mems", duration_s=90.0, seed=23, **kwargs)
        assert check(f.inertial, f.gnss, f.settings, increments=False) == []


CASES = {
    "degrees": (lambda d, dt: replace(d, dtheta=np.degrees(d.dtheta)), False, "imu.rate", "degrees, not radians"),
    "increments in columns of rates": (
        lambda d, dt: replace(d, dtheta=d.dtheta * dt, dv=d.dv * dt),
        False,
        "imu.force",
        "hold velocity increments",
    ),
    "angle increments in columns of rates": (
        lambda d, dt: replace(d, dtheta=d.dtheta * dt),
        False,
        "imu.rate",
        "hold angle increments",
    ),
    "rates in columns of increments": (
        lambda d, dt: replace(d, dtheta=d.dtheta / dt, dv=d.dv / dt),
        True,
        "imu.force",
        "hold specific force",
    ),
    "angular rates in columns of increments": (
        lambda d, dt: replace(d, dtheta=d.dtheta / dt),
        True,
        "imu.rate",
        "hold angular rates",
    ),
    "g": (lambda d, dt: replace(d, dv=d.dv / 9.80665), False, "imu.force", "give g, not m/s"),
    "thousandths of g": (lambda d, dt: replace(d, dv=d.dv / 9.80665e-3), False, "imu.force", "thousandths of g"),
    "no gravity": (lambda d, dt: replace(d, dv=d.dv * 0.002), False, "imu.force", "gravity"),
    "forward-left-up": (lambda d, dt: turned(d, FLU, FLU), False, "imu.axes", "forward-left-up"),
    "right-forward-up": (lambda d, dt: turned(d, RFU, RFU), False, "imu.axes", "right-forward-up"),
    "x and y swapped": (lambda d, dt: turned(d, SWAPPED, SWAPPED), False, "imu.axes", "right-forward-down"),
    "gyro axes swapped": (lambda d, dt: turned(d, SWAPPED, np.eye(3)), False, "imu.axes", r"\(wy, wx, wz\)"),
    "accelerometers forward-left-up": (lambda d, dt: turned(d, np.eye(3), FLU), False, "imu.axes", "do not belong"),
}


#: The others go the same ways through the checks; `make study` flies them too.
FIRST = ("degrees", "gyro axes swapped", "angle increments in columns of rates", "forward-left-up")


@pytest.mark.parametrize(
    "case", [case if case in FIRST else pytest.param(case, marks=pytest.mark.study) for case in CASES]
)
def test_wrong_units_and_axes_are_named(case):
    change, increments, subject, words = CASES[case]
    d, g, s = data()
    (finding,) = check(change(d, d.dt_s[:, None]), g, s, increments=increments)
    assert finding.fatal and finding.subject == subject
    assert re.search(words, finding.text), finding.text
    assert "\n" not in finding.text


@pytest.mark.parametrize(
    ("rate_hz", "increments", "mixed_up", "unit"),
    [
        (100, True, "the columns say velocity increments, but they hold specific force", "cm/s^2 (Gal)"),
        (10, False, "the columns say specific force, but they hold velocity increments", "accelerometers give g"),
        (200, True, "the columns say velocity increments, but they hold specific force", None),
        (50, False, "the columns say specific force, but they hold velocity increments", None),
    ],
)
def test_a_mix_up_is_named_where_another_unit_looks_like_it(rate_hz, increments, mixed_up, unit):
    """At 100 Hz gravity of a mix-up is that of cm/s^2, at 10 Hz that of g."""
    time = 50.0 + np.arange(40 * rate_hz) / rate_hz
    force = np.tile([0.3, -0.2, -9.81], (len(time), 1)) * (rate_hz if increments else 1.0 / rate_hz)
    inertial = InertialData.from_rates(time, np.zeros_like(force), force)
    _, gnss, settings = data()
    (finding,) = check(inertial, gnss, settings, increments=increments)
    assert finding.subject == "imu.force" and finding.text.startswith(mixed_up), finding.text
    assert ("; or " in finding.text) == (unit is not None)
    assert unit is None or unit in finding.text


@pytest.mark.parametrize("shift", [1.0, -18.0, *(pytest.param(s, marks=pytest.mark.study) for s in (-1.0, 18.0, 37.0))])
def test_time_scales_that_differ_by_whole_seconds_are_named(shift):
    d, g, s = data()
    (finding,) = check(d, replace(g, time_s=g.time_s + shift), s, increments=False)
    assert finding.subject == "gnss.time"
    assert f"{abs(shift):.0f} s {'late' if shift > 0 else 'early'}" in finding.text


METRES = [
    "degrees", "angle increments in columns of rates", "forward-left-up", "x and y swapped", "gyro axes swapped",
    "accelerometers forward-left-up",
]  # fmt: skip


@pytest.mark.parametrize("case", [METRES[0], *(pytest.param(case, marks=pytest.mark.study) for case in METRES[1:])])
def test_metre_level_gnss_shows_units_and_axes(case):
    change, increments, subject, words = CASES[case]
    d, g, s = data(sigma=(2.0, 2.0, 4.0))
    (finding,) = check(change(d, d.dt_s[:, None]), g, s, increments=increments)
    assert finding.fatal and finding.subject == subject and re.search(words, finding.text), finding.text


@pytest.mark.parametrize("shift", [-18.0, *(pytest.param(s, marks=pytest.mark.study) for s in (1.0, -1.0, 2.0, 18.0))])
def test_metre_level_gnss_shows_whole_seconds(shift):
    d, g, s = data(sigma=(2.0, 2.0, 4.0), grade="mems")
    (finding,) = check(d, replace(g, time_s=g.time_s + shift), s, increments=False)
    assert finding.subject == "gnss.time"
    assert f"{abs(shift):.0f} s {'late' if shift > 0 else 'early'}" in finding.text


def test_a_few_seconds_at_rest_raise_no_alarm():
    """There a fit from a wrong heading is as bad as any other trap's."""
    f = sim.flight("tactical", duration_s=60.0, seed=24, static_s=50.0)
    for start, length in ((5.0, 9.0), (12.0, 16.0), (30.0, 9.0)):
        d = f.inertial[(f.inertial.time_s > start) & (f.inertial.time_s < start + length)]
        g = f.gnss[(f.gnss.time_s > start) & (f.gnss.time_s < start + length)]
        assert check(d, g, f.settings, increments=False) == []


def test_times_that_do_not_overlap():
    d, g, s = data()
    (finding,) = check(d, replace(g, time_s=g.time_s + 1.7e9), s, increments=False)
    assert finding.fatal and "do not overlap" in finding.text


def test_outliers_are_not_taken_for_a_wrong_clock():
    d, g, s = data()
    rng = np.random.default_rng(5)
    bad = rng.random(len(g)) < 0.08
    g = replace(g, height_m=g.height_m + np.where(bad, rng.uniform(3.0, 80.0, len(g)), 0.0))
    assert check(d, g, s, increments=False) == []


def test_upside_down_is_seen_without_any_turn():
    f = sim.flight("mems", duration_s=90.0, seed=23, line_s=300.0, turbulence=0.0)
    (finding,) = check(turned(f.inertial, FLU, FLU), f.gnss, f.settings, increments=False)
    assert "up" in finding.text and finding.subject == "imu.axes"


def test_garbage_first_interval_and_disorder_are_taken_out():
    t = 100.0 + 0.01 * np.arange(200)
    t[0] = 3.0
    x = np.ones((200, 3))
    time, _, _, findings = clean_inertial(t, x, x)
    assert len(time) == 199 and findings[0].code == "first interval" and "97" in findings[0].text
    t = 100.0 + 0.01 * np.arange(200)
    t[50], t[60] = t[49], t[10]
    x = x.copy()
    x[80, 1] = np.nan
    time, a, _, findings = clean_inertial(t, x, x)
    assert len(time) == 197 and (np.diff(time) > 0).all() and np.isfinite(a).all()
    assert {f.code for f in findings} == {"time order", "not finite"}


def test_parts_in_another_order_and_single_stamps_far_off_cost_no_others():
    t, x = 100.0 + 0.01 * np.arange(2000), np.zeros((2000, 3))
    x[:, 0] = np.arange(2000)
    rows = np.r_[1200:2000, 0:1200]
    time, a, _, findings = clean_inertial(t[rows], x[rows], x[rows])
    assert (time == t).all() and (a == x).all()
    assert [f.text for f in findings] == ["samples go back in time at 1 place(s): put in order"]
    for stamp, left in ((1e9, 2000), (104.0, 1999), (112.0, 1999), (50.0, 1999)):
        off = t.copy()
        off[700] = stamp
        time, a, _, findings = clean_inertial(off, x, x)
        assert len(time) == left and (np.diff(time) > 0).all() and findings
        assert (np.delete(a[:, 0], np.flatnonzero(a[:, 0] == 700)) == np.delete(x[:, 0], 700)).all()
    back = np.where(np.arange(2000) < 1000, t, t - 2.0)  # a clock that is set back: overlapping samples are not mixed
    time, a, _, _ = clean_inertial(back, x, x)
    assert len(time) == 1800 and (np.diff(a[:, 0]) > 0).all()
    _, g, _ = data()
    shuffled, findings = clean_gnss(g[np.random.default_rng(0).permutation(len(g))])
    assert (shuffled.time_s == g.time_s).all() and (shuffled.lat == g.lat).all()
    assert "put in order" in findings[0].text


@pytest.mark.parametrize("increments", [False, True])
def test_impossible_samples_are_taken_out_and_hard_turns_are_not(increments):
    t, factor = 100.0 + 0.01 * np.arange(2000), 0.01 if increments else 1.0
    rate, force = np.full((2000, 3), 1e-5), np.full((2000, 3), 0.1)
    rate[500:510, 0], force[500:510, 2] = 4.0, 90.0  # a short manoeuvre after standing still
    force[700, 1], rate[800, 2] = -3000.0, 1e4
    time, a, b, findings = clean_inertial(t, factor * rate, factor * force, increments=increments)
    assert len(time) == 1998 and a.max() == 4.0 * factor and b.max() == 90.0 * factor
    assert {(f.subject, f.place) for f in findings} == {("imu.rate", (800, 2)), ("imu.force", (700, 1))}


def test_gnss_sigmas_of_zero_or_nan():
    _, g, _ = data()
    sigma = g.sigma_ned_m.copy()
    sigma[3, 0], sigma[5, 2], sigma[6, 2] = 0.0, np.nan, -1.0
    cleaned, findings = clean_gnss(replace(g, sigma_ned_m=sigma))
    assert (cleaned.sigma_ned_m > 0).all() and cleaned.sigma_ned_m[5, 2] == pytest.approx(0.04)
    assert [f.fatal for f in findings] == [False, False] and "2 of" in findings[1].text
    _, findings = clean_gnss(replace(g, sigma_ned_m=np.zeros_like(sigma)))
    assert all(f.fatal and f.subject == "gnss.sigma" for f in findings)


def test_gnss_positions_and_times_are_cleaned():
    _, g, _ = data()
    lat, time = g.lat.copy(), g.time_s.copy()
    lat[4], time[9] = np.nan, time[8]
    cleaned, findings = clean_gnss(replace(g, lat=lat, time_s=time))
    assert len(cleaned) == len(g) - 2 and {f.code for f in findings} == {"no position", "time order"}
    _, findings = clean_gnss(replace(g, lat=g.lat * 0 + 1.8))
    assert findings[-1].fatal and "swapped" in findings[-1].text
    velocity = np.ones((len(g), 3))
    velocity[2] = np.nan
    cleaned, findings = clean_gnss(replace(g, velocity_n=velocity, sigma_velocity_n=0.1 * np.ones((len(g), 3))))
    assert findings[0].code == "velocity" and "1 velocities" in findings[0].text


def test_gaps_and_outages_are_listed():
    d, g, _ = data()
    holed = d[~((d.time_s > 50.0) & (d.time_s < 53.0))]
    holed = InertialData.from_increments(holed.time_s, holed.dtheta, holed.dv)
    (finding,) = gap_findings(holed)
    assert "50.0" in finding.text and "599 sample" in finding.text
    (finding,) = outage_findings(g[~((g.time_s > 100.0) & (g.time_s < 130.0))], 0.5, 299.0)
    assert "99.0-130.0" in finding.text
    assert outage_findings(g, 0.5, 299.0) == [] and gap_findings(d) == []
