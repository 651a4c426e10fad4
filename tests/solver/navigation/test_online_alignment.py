"""What the on-line navigator says of GNSS and of the data it aligns with."""

import inertial_flights as sim
import numpy as np
import pytest

from triline.solver.geometry.frames import LocalFrame
from triline.solver.navigation.inertial_navigator import InertialNavigator
from triline.solver.navigation.online_alignment import GnssWatch

FRAME = LocalFrame(47.5, 9.2, 0.0)


def fed(inertial, gnss, settings):
    """A navigator and its events after data in the order of their times."""
    navigator = InertialNavigator(FRAME, settings)
    position = FRAME.from_geodetic(np.degrees(gnss.lat), np.degrees(gnss.lon), gnss.height_m)
    samples = [(float(t), 0, i) for i, t in enumerate(inertial.time_s)]
    samples += [(float(t) + 0.05, 1, i) for i, t in enumerate(gnss.time_s)]
    for time_s, is_fix, i in sorted(samples):
        if is_fix:
            navigator.add_gnss(float(gnss.time_s[i]), position[i], np.diag(gnss.sigma_ned_m[i][[1, 0, 2]] ** 2))
        else:
            navigator.add_increments(time_s, float(inertial.dt_s[i]), inertial.dv[i], inertial.dtheta[i])
    return navigator, [e.text for e in navigator.take_events()]


def test_an_outage_while_aligning_is_counted_and_told():
    f = sim.flight("mems", duration_s=60.0, seed=25, rate_hz=100)
    gnss = f.gnss[(f.gnss.time_s < 3.5) | (f.gnss.time_s > 13.5)]
    navigator, events = fed(f.inertial, gnss, f.settings)
    assert navigator.counters["gnss outage"] == 1
    assert [e for e in events if e.startswith("no GNSS for")] == ["no GNSS for 5.0 s: the alignment waits for it"]
    assert "GNSS is back after 11.0 s" in events and navigator.aligned


@pytest.mark.study
def test_forward_left_up_data_are_told_when_aligning_and_good_data_are_not():
    f = sim.flight("mems", duration_s=60.0, seed=25, rate_hz=100)
    navigator, events = fed(f.inertial, f.gnss, f.settings)
    assert navigator.aligned and navigator.counters["data suspicious"] == 0 and len(events) == 1
    flu = np.array([1.0, -1.0, -1.0])
    d = f.inertial
    turned = type(d)(d.time_s, d.dt_s, d.dtheta * flu, d.dv * flu, d.gyro_psd, d.accel_psd)
    navigator, events = fed(turned, f.gnss, f.settings)
    assert navigator.counters["data suspicious"] == 1
    assert any(e.startswith("imu.axes:") and "up" in e for e in events)


def test_the_watch_knows_the_usual_interval():
    watch = GnssWatch()
    assert [watch.fix(5.0 * i) for i in range(4)] == [""] * 4 and watch.inertial(22.0) == ""
    assert watch.inertial(45.0) == "no GNSS for 30.0 s" and watch.inertial(46.0) == ""
    assert watch.fix(47.0) == "GNSS is back after 32.0 s" and watch.fix(46.5) == ""
