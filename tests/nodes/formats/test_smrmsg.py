"""Accuracies beside an SBET: which records count for which poses, what is refused, and the way out and back."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np
import pytest
from test_imports import write_sbet_file
from test_navigation_tracks import straight_track

from triline.nodes.cli import main
from triline.nodes.convert import pose_sample
from triline.nodes.errors import UserError
from triline.nodes.formats.detect import Options, read_any
from triline.nodes.formats.flight_folder import read_flight
from triline.nodes.formats.flight_template import write_template
from triline.nodes.formats.gps_time import gps_from_utc_ns
from triline.nodes.formats.sbet import read_sbet
from triline.nodes.formats.smrmsg import beside, write_smrmsg

DAY = date(2020, 6, 1)
SECONDS = gps_from_utc_ns(straight_track().time_ns)[1]
ARCMIN = np.radians(1 / 60)


def write_accuracies(path: Path, seconds, sigma_m=(0.02, 0.03, 0.05), arcmin=(0.3, 0.4, 0.9)) -> Path:
    """Records that grow by a tenth from each to the next."""
    growth = 1 + 0.1 * np.arange(len(seconds))[:, None]
    write_smrmsg(path, seconds, growth * np.array(sigma_m), growth * np.array(arcmin) * ARCMIN)
    return path


def test_records_are_what_other_programs_read(tmp_path):
    path = write_accuracies(tmp_path / "smrmsg_x.out", [100.0, 101.0])
    np.testing.assert_allclose(
        np.fromfile(path, "<f8").reshape(-1, 10)[1],
        [101.0, 0.022, 0.033, 0.055, 0.0, 0.0, 0.0, 0.33, 0.44, 0.99],
        rtol=1e-14,
    )


@pytest.mark.parametrize(
    ("sbet", "smrmsg"),
    [
        ("sbet--UTCtime-x-WGS84.out", "sbet--UTCtime-x-WGS84-smrmsg.out"),
        ("x-sbet-200Hz.out", "x-sbet-200Hz-smrmsg.out"),
        ("S222_2020-077_NAD83_SBET.out", "S222_2020-077_NAD83_smrmsg.out"),
        ("SBET_ppk.OUT", "SMRMSG_ppk.OUT"),
    ],
)
def test_accuracies_beside_an_sbet_have_the_names_that_programs_give(tmp_path, sbet, smrmsg):
    """Those of real files, two of them of POSPac in hydrography and of Inertial Explorer."""
    path = write_sbet_file(tmp_path).rename(tmp_path / sbet)
    assert beside(path) is None
    write_accuracies(tmp_path / smrmsg, SECONDS[[0, -1]])
    assert beside(path) == tmp_path / smrmsg
    assert read_sbet(path, DAY).has_attitude_sigmas


def test_accuracies_beside_an_sbet_are_interpolated(tmp_path):
    sbet = write_sbet_file(tmp_path)
    assert not read_sbet(sbet, DAY).has_attitude_sigmas
    start, end = SECONDS[[0, -1]]
    write_accuracies(tmp_path / "smrmsg_x.out", [start, (start + end) / 2, end])
    track = read_sbet(sbet, DAY)
    assert "sbet_x.out: accuracies of the poses are those of smrmsg_x.out" in track.notes
    growth = 1 + 0.2 * np.linspace(0, 1, 50)[:, None]
    np.testing.assert_allclose(track.sigma_ned_m, growth * [0.02, 0.03, 0.05], rtol=1e-6)
    np.testing.assert_allclose(track.sigma_rpy, growth * [0.3, 0.4, 0.9] * ARCMIN, rtol=1e-6)


def test_poses_that_no_record_is_near_have_the_usual_accuracies(tmp_path):
    sbet = write_sbet_file(tmp_path)
    named = write_accuracies(tmp_path / "of_another_name.out", SECONDS[10:21])
    imported = read_any(sbet, options=Options(day=DAY, accuracies=named))
    samples = [pose_sample(m.body) for m in imported.messages if m.topic == "trajectory/smoothed"]
    z = [float(np.sqrt(sample.covariance[2, 2])) for sample in samples]
    assert z[:9] == pytest.approx([0.2] * 9) and z[22:] == pytest.approx([0.2] * 28)
    assert z[10:21] == pytest.approx((0.05 * (1 + 0.1 * np.arange(11))).tolist(), rel=1e-4)
    assert any("37 of 50 poses lie before or behind its accuracies" in note for note in imported.notes)


@pytest.mark.parametrize(
    "change, wanted",
    [
        (lambda v: v.tobytes()[:-3], "4797 bytes, wanted a whole number of SMRMSG records of 80 bytes"),
        (lambda v: b"", "0 bytes, wanted a whole number"),
        (lambda v: (v + np.eye(10)[0] * 5000).tobytes(), "of another flight, wanted those of this SBET"),
        (lambda v: (v * np.eye(10)[0]).tobytes(), "no record with accuracies above 0"),
        (lambda v: (v * np.where(np.arange(10) == 0, np.nan, 1)).tobytes(), "record 1: time: nan"),
    ],
)
def test_files_that_cannot_be(tmp_path, capsys, change, wanted):
    sbet = write_sbet_file(tmp_path)
    path = write_accuracies(tmp_path / "smrmsg_x.out", np.linspace(SECONDS[0], SECONDS[-1], 60))
    path.write_bytes(change(np.fromfile(path, "<f8").reshape(-1, 10)))
    with pytest.raises(UserError, match=wanted):
        read_sbet(sbet, DAY)
    assert main(["import", str(sbet), "-o", str(tmp_path / "o.mcap"), "--date", str(DAY)]) != 0
    err = capsys.readouterr().err
    assert "smrmsg_x.out: " in err and err.count("\n") == 1 and not (tmp_path / "o.mcap").exists()


def test_records_without_accuracies_and_in_other_units_are_told(tmp_path):
    sbet = write_sbet_file(tmp_path)
    path = write_accuracies(tmp_path / "smrmsg_x.out", SECONDS, arcmin=np.array([0.1, 0.1, 0.2]) / 60)
    values = np.fromfile(path, "<f8").reshape(-1, 10)
    values[5, 3], values[6, 8], values[8, 0] = 0.0, np.nan, values[2, 0]
    values.tofile(path)
    notes = read_sbet(sbet, DAY).notes
    assert any("3 records without accuracies above 0" in note for note in notes)
    assert any("other units? SMRMSG has arc minutes" in note for note in notes)


def test_an_smrmsg_alone_and_one_that_is_missing(tmp_path, capsys):
    sbet, out = write_sbet_file(tmp_path), str(tmp_path / "o.mcap")
    alone = write_accuracies(tmp_path / "day_smrmsg.out", np.linspace(SECONDS[0], SECONDS[-1], 17))
    assert main(["import", str(alone), "-o", out]) != 0
    assert "accuracies of poses (SMRMSG), wanted their SBET" in capsys.readouterr().err
    assert main(["import", str(sbet), "-o", out, "--accuracies", str(tmp_path / "none.out")]) != 0
    assert "none.out: no such file" in capsys.readouterr().err


def test_a_flight_folder_names_its_accuracies(tmp_path):
    path = write_template(tmp_path)
    write_sbet_file(tmp_path)
    write_accuracies(tmp_path / "a.out", SECONDS)
    text = path.read_text().replace('"navigation.csv"', '"sbet_x.out"').replace("#accuracies", "accuracies")
    path.write_text(text)
    assert any(
        "navigation.accuracies: no smrmsg_7.out in the folder" in line for line in read_flight(tmp_path).problems
    )
    path.write_text(text.replace("smrmsg_7.out", "a.out"))
    track = read_flight(tmp_path).track
    assert track is not None and track.sigma_ned_m is not None
    np.testing.assert_allclose(track.sigma_ned_m[0], [0.02, 0.03, 0.05])


def test_accuracies_come_back_as_they_went_out(tmp_path, capsys):
    """SBET with accuracies, recording of a camera that is turned on the body, SBET and SMRMSG: the same accuracies."""
    sbet = write_sbet_file(tmp_path)
    write_accuracies(tmp_path / "smrmsg_x.out", SECONDS)
    recording, out = str(tmp_path / "o.mcap"), tmp_path / "smrmsg_out.out"
    words = ["import", str(sbet), "-o", recording, "--date", str(DAY), "--boresight", "0.5", "-0.3", "90", "-q"]
    assert main(words) == 0
    assert main(["export", recording, "--topic", "trajectory/smoothed", "--smrmsg", str(out)]) == 0
    assert "50 records" in capsys.readouterr().out
    np.testing.assert_allclose(
        np.fromfile(out, "<f8").reshape(-1, 10),
        np.fromfile(tmp_path / "smrmsg_x.out", "<f8").reshape(-1, 10),
        rtol=1e-6,
        atol=1e-9,
    )
    assert main(["export", recording, "--topic", "sensor/gnss", "--smrmsg", str(out)]) != 0
