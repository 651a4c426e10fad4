"""A real drive: the inertial data and fixes that come with gtsam (KITTI, 100 Hz and 1 Hz, eight minutes)."""

from pathlib import Path

import inertial_flights as sim
import numpy as np
import pytest

from triline.solver.geometry.frames import LocalFrame
from triline.solver.navigation.error_state import NavigationSettings
from triline.solver.navigation.inertial_cleaning import clean_gnss, clean_inertial
from triline.solver.navigation.inertial_data import GnssData, InertialData, InertialGrade
from triline.solver.navigation.post_processing import NavigationError, held_out_misses, navigate

gtsam = pytest.importorskip("gtsam", reason="gtsam (with the KITTI drive in its wheel) is not installed")

#: Noise figures of the drive's metadata; its biases move within a minute.
GRADE = InertialGrade(0.000175, 2e-3, 0.01, 0.2, bias_time_s=60.0)
FLU = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def drive():
    folder = Path(gtsam.__file__).parent / "Data"
    imu = np.loadtxt(folder / "KittiEquivBiasedImu.txt", skiprows=1)
    gps = np.loadtxt(folder / "KittiGps_converted.txt", skiprows=1, delimiter=",")
    place = LocalFrame(49.0, 8.4, 110.0).to_geodetic(gps[:, 1:])
    sigma = np.full((len(gps), 3), 0.07)
    return imu, GnssData(gps[:, 0], np.radians(place[:, 0]), np.radians(place[:, 1]), place[:, 2], sigma)


def inertial_of(imu, axes=FLU):
    time, rate, force, findings = clean_inertial(imu[:, 0], imu[:, 5:8] @ axes, imu[:, 2:5] @ axes)
    return InertialData.from_rates(time, rate, force), findings


def test_garbage_first_interval_gaps_and_outage_are_named(drive):
    imu, gnss = drive
    inertial, findings = inertial_of(imu)
    assert findings[0].code == "first interval" and "1.920 s" in findings[0].text
    gnss, more = clean_gnss(gnss)
    assert not more
    r = navigate(inertial, gnss, NavigationSettings(GRADE))[0]
    codes = {f.code: f.text for f in r.findings}
    assert "46587.1" in codes["gap"] and "restored" not in codes and "tuned" not in codes
    assert r.start.how == "in motion"
    t = r.smoothed.sample_times
    assert np.diff(t).max() < 0.02 and t[-1] > 47005.0
    assert np.isfinite(r.smoothed.at(t[::7]).r_e).all()


def test_innovations_are_consistent_and_held_out_fixes_predicted(drive):
    imu, gnss = drive
    inertial, _ = inertial_of(imu)
    out = np.arange(len(gnss)) % 5 == 4
    r = navigate(inertial, gnss, NavigationSettings(GRADE), held_out=out)[0]
    used = [i for i in r.forward.innovations if i.status != "held out"]
    nis = np.array([i.nis for i in used[10:]])
    assert 2.0 < nis.mean() < 4.5 and 0.4 < np.median(nis) < 3.0
    assert np.mean([i.status == "used" for i in used]) > 0.9
    miss, sigma = held_out_misses(r.smoothed, gnss, r.forward.settings, out)
    assert len(miss) >= 90
    z = miss / sigma
    assert 0.6 < sim.rms(z).mean() < 1.3 and np.mean(np.abs(z) > 3.0) < 0.05
    assert (sim.rms(miss) < 0.2).all()
    # and much better than a straight line between the fixes on both sides of each
    k = np.flatnonzero(out & (gnss.time_s >= r.smoothed.start_s) & (gnss.time_s <= r.smoothed.end_s))
    k = k[(k > 0) & (k < len(gnss) - 1)]
    p = gnss.position_e
    line = np.linalg.norm(0.5 * (p[k - 1] + p[k + 1]) - p[k], axis=1)
    assert np.median(line) > 3.0 * np.median(np.linalg.norm(miss, axis=1))


def test_biases_that_move_faster_than_said_are_noticed(drive):
    imu, gnss = drive
    inertial, _ = inertial_of(imu)
    calm = InertialGrade(0.000175, 5e-4, 0.01, 0.05, bias_time_s=3600.0)
    out = np.arange(len(gnss)) % 5 == 4
    r = navigate(inertial, gnss, NavigationSettings(calm), held_out=out)[0]
    assert any(f.code == "tuned" for f in r.findings)
    miss, sigma = held_out_misses(r.smoothed, gnss, r.forward.settings, out)
    assert (sim.rms(miss) < 0.2).all() and sim.rms(miss / sigma).mean() < 1.3


def test_its_axes_as_they_stand_are_refused(drive):
    imu, gnss = drive
    with pytest.raises(NavigationError, match="forward-left-up"):
        navigate(inertial_of(imu, np.eye(3))[0], gnss, NavigationSettings(GRADE))
