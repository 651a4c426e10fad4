"""NMEA 0183 to messages: times, heights, accuracies, and what is wrong with a sentence."""

from __future__ import annotations

import os
import socket
import threading
from collections import Counter
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest
from bus_rig import free_port

from triline.nodes.convert import time_ns
from triline.nodes.errors import UserError
from triline.nodes.formats.keys import Keys
from triline.nodes.sensors.nmea import Nmea, NmeaParser, NmeaSettings

#: 2026-11-22 09:27:50 UTC.
T0 = 1795339670_000_000_000


def sentence(body: str) -> bytes:
    """A sentence with its checksum: the exclusive or of all characters between $ and *."""
    total = 0
    for character in body:
        total ^= ord(character)
    return f"${body}*{total:02X}\r\n".encode()


RMC = sentence("GNRMC,092750.00,A,5321.6802,N,00630.3372,W,120.00,090.00,221126,,,A")
GST = sentence("GNGST,092750.20,0.9,0.03,0.02,10.0,0.021,0.034,0.055")


def gga(clock: str, quality=4, lat="5321.6802000", sep="55.200", hdop="0.8", alt="61.700") -> bytes:
    lon = "00630.3372000"[: len(lat) + 1]
    return sentence(f"GNGGA,{clock},{lat},N,{lon},W,{quality},18,{hdop},{alt},M,{sep},M,1.0,0000")


def settings(tmp_path: Path, **table) -> NmeaSettings:
    return NmeaSettings.read(Keys(Path("flight.toml"), {"address": "udp://:4001", **table}, "sensor[0]"), tmp_path)


def parse(tmp_path, *data: bytes, **table):
    counts: Counter[str] = Counter()
    parser = NmeaParser(settings(tmp_path, **table), lambda kind, text: counts.update([kind]))
    return [message for part in data for message in parser.feed(part)], counts


def test_a_fix_has_time_place_and_accuracy(tmp_path):
    messages, counts = parse(tmp_path, RMC + GST + gga("092750.20"))
    (message,) = messages
    assert not counts and message.topic == "sensor/gnss"
    body = message.body
    assert time_ns(body.timestamp) == message.stamp_ns == T0 + 200_000_000
    assert body.latitude == pytest.approx(53 + 21.6802 / 60, abs=1e-10)
    assert body.longitude == pytest.approx(-(6 + 30.3372 / 60), abs=1e-10)
    assert body.altitude == pytest.approx(61.7 + 55.2)  # above the ellipsoid
    sigma = np.sqrt(np.array(body.position_covariance)[::4])
    np.testing.assert_allclose(sigma, [0.034, 0.021, 0.055], rtol=1e-4)  # east, north, up; GST has latitude first


def test_without_gst_the_quality_says_how_good_a_fix_is(tmp_path):
    messages, _ = parse(tmp_path, RMC, gga("092751.00", quality=1, hdop="2.0"), gga("092752.00", quality=4, hdop="1.0"))
    sigmas = [np.sqrt(np.array(m.body.position_covariance)[::4]) for m in messages]
    np.testing.assert_allclose(sigmas[0], [5.0, 5.0, 10.0], rtol=1e-4)
    np.testing.assert_allclose(sigmas[1], [0.02, 0.02, 0.04], rtol=1e-4)


@pytest.mark.parametrize("first", ["GGA", "GST"])
def test_a_fix_is_no_better_than_its_figures(tmp_path, first):
    """Four decimals of a minute are 0.19 m: with the 0.014 m of a GST such fixes contradicted the inertial data."""
    fix, level = gga("092750.20", lat="5321.6802", sep="55.2", alt="61.7"), gst("092750.20", 0.014)
    data = (level, fix) if first == "GST" else (fix, level, gga("092750.40", lat="5321.6802", sep="55.2", alt="61.7"))
    messages, counts = parse(tmp_path, RMC, *data)
    step = np.array([0.1852 * np.cos(np.radians(53.361)), 0.1852, 0.1 * np.sqrt(2.0)])
    wanted = np.sqrt(np.array([0.014, 0.014, 0.028]) ** 2 + step**2 / 12.0)
    np.testing.assert_allclose(np.sqrt(np.array(messages[-1].body.position_covariance)[::4]), wanted, rtol=1e-3)
    assert counts == {"few figures": 1}
    _, counts = parse(tmp_path, RMC, gga("092750.20", quality=1, lat="5321.6802", sep="55.2", alt="61.7"))
    assert not counts  # a fix to 2.5 m has figures enough


def gst(clock: str, sigma: float) -> bytes:
    return sentence(f"GNGST,{clock},0.9,{sigma},{sigma},10.0,{sigma},{sigma},{2 * sigma}")


@pytest.mark.parametrize("order", ["GGA first", "GST first", "GST of each third fix"])
def test_a_gst_says_nothing_of_fixes_of_another_quality(tmp_path, order):
    """RTK is lost at the fourth fix and back at the seventh: what a GST said of fixed ambiguities is over then."""
    fixes = []
    for i, quality in enumerate((4, 4, 4, 1, 1, 1, 4, 4)):
        clock = f"09275{i}.00"
        both = [gga(clock, quality, hdop="1.0"), gst(clock, 0.015 if quality == 4 else 1.8)]
        if order == "GST first":
            both.reverse()
        fixes.append(b"".join(both if i % 3 == 0 or "third" not in order else both[:1]))
    messages, _ = parse(tmp_path, RMC, *fixes)
    sigma = np.sqrt(np.array([m.body.position_covariance[0] for m in messages]))
    if order == "GST first":
        wanted = [0.015] * 3 + [1.8] * 3 + [0.015] * 2
    else:  # what a GST says of a fix comes after it
        wanted = [0.02, 0.015, 0.015, 2.5, 1.8, 1.8, 0.02, 0.015]
    np.testing.assert_allclose(sigma, wanted, rtol=1e-3)


def test_sentences_may_come_in_pieces(tmp_path):
    data = RMC + gga("092750.20") + gga("092750.40")
    messages, counts = parse(tmp_path, *(data[i : i + 7] for i in range(0, len(data), 7)))
    assert len(messages) == 2 and not counts


@pytest.mark.parametrize("pieces", [10_000, 100])
@pytest.mark.parametrize("before", [b"\xb5b\x01\x07$\x5c\x00$G\x12", b"$\xd3" + bytes(range(11, 256)) * 3, b"$GNVTG,,"])
def test_binary_messages_of_the_receiver_take_no_fix_along(tmp_path, before, pieces):
    """Any byte of them may be a $; the sentence behind it was lost, mostly without a word."""
    data = RMC + before + gga("092750.20") + before + gga("092750.40")
    messages, _ = parse(tmp_path, *(data[i : i + pieces] for i in range(0, len(data), pieces)))
    assert [m.stamp_ns - T0 for m in messages] == [200_000_000, 400_000_000]


def test_midnight(tmp_path):
    before = sentence("GNRMC,235959.50,A,5321.6802,N,00630.3372,W,0.0,,311226,,,A")
    messages, counts = parse(tmp_path, before + gga("235959.80") + gga("000000.00") + gga("000000.20"))
    stamps = np.array([message.stamp_ns for message in messages])
    np.testing.assert_array_equal(np.diff(stamps), [200_000_000, 200_000_000])
    assert stamps[1] == 1798761600_000_000_000 and not counts  # 2027-01-01
    late, _ = parse(tmp_path, gga("235959.80") + gga("000000.00"), date=date(2026, 12, 31))
    assert [message.stamp_ns for message in late] == stamps[:2].tolist()


def test_clock_offset_and_delay(tmp_path):
    messages, _ = parse(tmp_path, RMC + gga("092750.20"), clock_offset_s=0.05, delay_s=0.15)
    assert time_ns(messages[0].body.timestamp) == T0 + 150_000_000
    assert messages[0].stamp_ns == T0 + 300_000_000


def test_heading_and_velocity_where_they_are_wanted(tmp_path):
    data = RMC + gga("092750.00") + sentence("GPHDT,123.456,T")
    assert [m.topic for m in parse(tmp_path, data)[0]] == ["sensor/gnss"]
    fix, heading = parse(tmp_path, data, heading_sigma_deg=0.2, velocity_sigma_m_s=0.05)[0]
    assert heading.topic == "sensor/attitude" and heading.stamp_ns == T0
    assert heading.body.heading == pytest.approx(np.radians(123.456))
    np.testing.assert_allclose(np.degrees(np.sqrt(heading.body.covariance[::4])), [5.0, 5.0, 0.2])
    v = fix.body.velocity_enu  # 120 knots to the east
    np.testing.assert_allclose([v.x, v.y, v.z], [61.7333, 0.0, 0.0], atol=1e-3)
    assert np.sqrt(fix.body.velocity_covariance[8]) == 20.0  # the climb is not told


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (gga("092750.20")[:-4] + b"00\r\n", "bad checksum"),
        (gga("092750.20").split(b"*")[0] + b"\r\n", "no checksum"),
        (b"hello\r\n", "not NMEA"),
        (b"\xff" * 600, "not NMEA"),
        (gga("092750.20", quality=0), "no fix"),
        (gga("092750.20", sep=""), "no geoid separation"),
        (gga("092750.20", lat=""), "field missing"),
        (gga("092750.20", lat="9521.680200"), "field missing"),
        (gga("092750.20") * 2, "time does not go on"),
        (sentence("GNGGA,092750.20,5321.6802,,00630.3372,,4,18,0.8,61.7,M,55.2,M,1.0,0000"), "no hemisphere"),
        (sentence("GNGGA,092750.20,-3321.6802,N,00630.3372,E,4,18,0.8,61.7,M,55.2,M,1.0,0000"), "no hemisphere"),
        (sentence("GNGGA,092750.20,5321.6802,N,00630.3372,W,4,18,0.8,202.4,F,181.1,F,1.0,0000"), "not in metres"),
    ],
)
def test_what_cannot_be_used_is_counted_and_the_next_fix_comes(tmp_path, data, kind):
    messages, counts = parse(tmp_path, RMC + data + b"\r\n" + gga("092751.00"))
    assert counts == {kind: 1}
    assert messages[-1].stamp_ns == T0 + 1_000_000_000


@pytest.mark.parametrize(
    "wrong",
    [
        gga("102751.00"),  # an hour ahead
        sentence("GNRMC,092751.00,A,5321.68,N,00630.34,W,0,0,010140,,,A") + gga("092751.00") + RMC,
        sentence("GNZDA,092751.00,22,11,2027,00,00") + gga("092751.00") + RMC,
    ],
)
def test_one_wrong_time_does_not_silence_all_fixes_that_follow(tmp_path, wrong):
    """They were refused until the wrong time had come: an hour, a year."""
    hdt = sentence("GNHDT,90.0,T")
    times = [f"09275{2 + i // 5}.{2 * (i % 5)}0" for i in range(20)]
    data = RMC + gga("092750.00") + hdt + wrong + hdt + b"".join(gga(time) + hdt for time in times)
    messages, counts = parse(tmp_path, data, heading_sigma_deg=0.2)
    assert counts == {"time does not go on": 4}
    for topic in ("sensor/gnss", "sensor/attitude"):
        stamps = [message.stamp_ns for message in messages if message.topic == topic]
        assert stamps[-16:] == [T0 + 2_800_000_000 + i * 200_000_000 for i in range(16)]


def test_without_a_date_there_is_no_time(tmp_path):
    messages, counts = parse(tmp_path, gga("092750.20") + RMC + gga("092750.40"))
    assert len(messages) == 1 and counts == {"no date yet": 1}


@pytest.mark.parametrize(
    ("heading", "knots", "told"), [(95.0, 120, 0), (120.0, 120, 0), (180.0, 120, 1), (275.0, 120, 1), (275.0, 12, 0)]
)
def test_headings_of_antennas_across_the_aircraft_are_told_once(tmp_path, heading, knots, told):
    """The course is 90 deg."""
    clocks = [f"0927{10 + i}.00" for i in range(45)]
    rmc = f"GNRMC,{{}},A,5321.6802,N,00630.3372,W,{knots}.00,090.00,221126,,,A"
    data = b"".join(sentence(rmc.format(c)) + gga(c) + sentence(f"GNHDT,{heading},T") for c in clocks)
    messages, counts = parse(tmp_path, data, heading_sigma_deg=0.2)
    assert len(messages) == 90 and counts["heading off the course"] == told


def test_the_date_of_a_receiver_without_a_fix_is_not_believed(tmp_path):
    """As a real one wrote them: its first fix went out with a day in 1980."""
    before = sentence("GPRMC,235952.953,V,0000.0000,N,00000.0000,E,,0.00,050180,,,N")
    first = sentence("GPGGA,102523.342,4815.6883,N,01140.3675,E,1,03,4.1,-47.5,M,47.5,M,,0000")
    dated = sentence("GPRMC,102523.342,A,4815.6883,N,01140.3675,E,0.00,0.00,210808,,,A")
    then = sentence("GPGGA,102524.342,4815.6880,N,01140.3673,E,1,03,4.1,-47.5,M,47.5,M,,0000")
    (message,), counts = parse(tmp_path, before + first + dated + then)
    assert counts == {"no date yet": 1}
    assert datetime.fromtimestamp(message.stamp_ns * 1e-9, UTC).date() == date(2008, 8, 21)


def test_the_day_of_the_flight_tells_weeks_modulo_1024(tmp_path):
    late = sentence("GNRMC,092750.00,A,5321.6802,N,00630.3372,W,120.00,090.00,080407,,,A")  # 1024 weeks before T0
    (message,), counts = parse(tmp_path, late + late + gga("092750.20"), date=date(2026, 11, 22))
    assert message.stamp_ns == T0 + 200_000_000 and counts == {"wrong weeks": 1}
    (message,), counts = parse(tmp_path, RMC + gga("092750.20"), date=date(2026, 5, 1))
    assert message.stamp_ns == T0 + 200_000_000 and not counts  # another day: that of the receiver


def test_an_rmc_that_comes_too_late_for_its_velocity_is_counted(tmp_path):
    fixes = [gga(f"09275{i}.00") + RMC.replace(b"092750.00", b"09275%d.00" % i) for i in range(1, 4)]
    fixes = [b"".join(sentence(s[1:].split(b"*")[0].decode()) for s in fix.splitlines()) for fix in fixes]
    messages, counts = parse(tmp_path, RMC, *fixes, velocity_sigma_m_s=0.1)
    assert [len(m.body.velocity_covariance) for m in messages] == [0, 0, 0]
    assert counts == {"RMC after its GGA": 3}
    _, counts = parse(tmp_path, RMC, *fixes)  # velocities are not wanted
    assert not counts


def test_from_a_file_that_grows_and_from_a_connection_that_breaks(tmp_path):
    path = tmp_path / "gnss.nmea"
    path.write_bytes(RMC + gga("092750.20"))
    stop = threading.Event()
    sensor = Nmea(settings(tmp_path, address="file:gnss.nmea"))
    come = (message for message in sensor.messages(stop) if message is not None)
    assert next(come).stamp_ns == T0 + 200_000_000
    with path.open("ab") as file:
        file.write(gga("092750.40"))
    assert next(come).stamp_ns == T0 + 400_000_000

    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        sensor = Nmea(settings(tmp_path, address=address))
        come = (message for message in sensor.messages(stop) if message is not None)

        def serve(data: bytes) -> None:
            connection, _ = server.accept()
            connection.sendall(data)
            connection.close()

        for i, data in enumerate((RMC + gga("092750.20"), gga("092751.00"))):
            thread = threading.Thread(target=serve, args=(data,))
            thread.start()
            assert next(come).stamp_ns == T0 + (200_000_000, 1_000_000_000)[i]
            thread.join()
        assert sensor.counters["connection closed"] == 1
    stop.set()


def first_fix(sensor: Nmea, send) -> int:
    """Stamp of the first fix; ``send`` is called until there is one."""
    stop = threading.Event()
    for message in sensor.messages(stop):
        if message is not None:
            stop.set()
            return message.stamp_ns
        send()
    raise AssertionError


def test_from_a_serial_port(tmp_path):
    pytest.importorskip("serial")
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    try:
        sensor = Nmea(settings(tmp_path, address=f"serial:{os.ttyname(theirs)}", baud=9600))
        data = (RMC + gga("092750.20")).replace(b"\r", b"")  # the terminal adds it
        sent = []
        assert first_fix(sensor, lambda: sent or sent.append(os.write(ours, data))) == T0 + 200_000_000
    finally:
        os.close(ours)
        os.close(theirs)


def test_from_udp(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        address = f"127.0.0.1:{free_port()}"
        sensor = Nmea(settings(tmp_path, address=f"udp://{address}"))
        host, port = address.split(":")
        stamp = first_fix(sensor, lambda: sender.sendto(RMC + gga("092750.20"), (host, int(port))))
    assert stamp == T0 + 200_000_000


@pytest.mark.parametrize(
    ("table", "wanted"),
    [
        ({"address": "ftp://x"}, "sensor[0].address: 'ftp://x', wanted serial:PORT, tcp://HOST:PORT"),
        ({"address": "tcp://host"}, "sensor[0].address: 'tcp://host', wanted a port from 1 to 65535"),
        ({"baut": 9600}, "sensor[0].baut: not known, wanted id, kind"),
        ({"imu_noise": [1e-5, 1e-3]}, "sensor[0].imu_noise: not known, wanted id, kind"),
        ({"date": "today"}, "sensor[0].date: 'today', wanted a day as 2024-05-17"),
        ({"clock_offset_s": 1e300}, "sensor[0].clock_offset_s: 1e+300, wanted 100 years at most"),
        ({"delay_s": 60}, "sensor[0].delay_s: 60, wanted 0 to 5 seconds"),
        ({"heading_sigma_deg": 0}, "sensor[0].heading_sigma_deg: 0, wanted a number above 0"),
    ],
)
def test_settings_that_cannot_be(tmp_path, table, wanted):
    with pytest.raises(UserError) as error:
        settings(tmp_path, **table)
    assert str(error.value).startswith(f"flight.toml: {wanted}") and "\n" not in str(error.value)


def shr(clock: str, heading="312.95", flag="T", sigmas="0.029,0.024,0.059", status=",1") -> bytes:
    """Of the form of a SPAN receiver of NovAtel: roll -0.83 deg, pitch +0.42 deg."""
    return sentence(f"PASHR,{clock},{heading},{flag},-0.83,+0.42,-0.01,{sigmas},2{status}")


@pytest.mark.parametrize("status", [",1", ""], ids=["with the status of the IMU", "older, without it"])
def test_an_attitude_has_a_time_and_an_accuracy_of_its_own(tmp_path, status):
    """And is used without being asked for; a heading of HDT is not wanted beside it."""
    data = RMC + gga("092750.00") + shr("092750.02", status=status) + sentence("GPHDT,10.0,T")
    (fix, attitude), counts = parse(tmp_path, data, heading_sigma_deg=0.2)
    assert not counts and [fix.topic, attitude.topic] == ["sensor/gnss", "sensor/attitude"]
    assert attitude.body.time_ns == attitude.stamp_ns == T0 + 20_000_000
    angles = attitude.body.roll, attitude.body.pitch, attitude.body.heading
    assert np.degrees(angles) == pytest.approx([-0.83, 0.42, 312.95], abs=1e-9)
    step = 0.01 / np.sqrt(12.0)  # two decimals of a degree
    sigmas = np.degrees(np.sqrt(attitude.body.covariance[::4]))
    assert sigmas == pytest.approx(np.hypot([0.029, 0.024, 0.059], step), rel=1e-6)


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        (shr("092750.05", status=",0"), "no attitude"),  # before its alignment
        (shr("092750.05", flag=""), "no attitude"),
        (sentence("PASHR,,,,,,,,,,0,0"), "no attitude"),
        (shr("092750.05", sigmas="0.000,0.000,0.000"), "no accuracy"),
        (shr("092750.05", sigmas=",,"), "field missing"),
        (shr("092750.00"), "time does not go on"),
        (shr("092750.05", heading="812.95"), "field missing"),
    ],
)
def test_attitudes_that_cannot_be_used_are_counted(tmp_path, wrong, kind):
    messages, counts = parse(tmp_path, RMC + shr("092750.00") + wrong + shr("092750.10"))
    assert counts == {kind: 1} and [message.topic for message in messages] == ["sensor/attitude"] * 2


def test_a_heading_of_hdt_counts_while_pashr_has_no_alignment(tmp_path):
    data = RMC + gga("092750.00") + shr("092750.02", status=",0") + sentence("GPHDT,10.0,T")
    (_, heading), counts = parse(tmp_path, data, heading_sigma_deg=0.2)
    assert counts == {"no attitude": 1} and np.degrees(heading.body.heading) == pytest.approx(10.0)


def test_other_sentences_of_ashtech_pass_by(tmp_path):
    data = RMC + sentence("PASHR,ATT,304786.5,123.4,1.2,,0.01,0.02,0") + sentence("PASHR,NAK") + sentence("PASHR,XYZ,1")
    assert parse(tmp_path, data) == ([], {})


def gns(clock: str, mode: str) -> bytes:
    return sentence(f"GNGNS,{clock},5321.6802000,N,00630.3372000,W,{mode},18,0.8,61.700,55.200,1.0,0000")


def test_a_receiver_may_write_gns_in_place_of_gga(tmp_path):
    data = RMC + gns("092750.00", "RRN") + gns("092750.20", "NN") + gns("092750.40", "AD")
    (fixed, coarse), counts = parse(tmp_path, data)
    assert counts == {"no fix": 1} and time_ns(coarse.body.timestamp) == T0 + 400_000_000
    assert fixed.body.altitude == pytest.approx(61.7 + 55.2)
    fixed_m2, coarse_m2 = (message.body.position_covariance[0] for message in (fixed, coarse))
    (same,), _ = parse(tmp_path, RMC + gga("092750.00"))
    assert fixed_m2 == same.body.position_covariance[0] and np.sqrt(coarse_m2) == pytest.approx(0.8, rel=1e-3)  # DGPS


def test_with_both_gga_is_read(tmp_path):
    seconds = [f"09275{k}.00" for k in range(3)]
    data = RMC + b"".join(gns(clock, "RR") + gga(clock) for clock in seconds)
    messages, counts = parse(tmp_path, data)
    assert not counts and [time_ns(message.body.timestamp) for message in messages] == [
        T0 + k * 10**9 for k in range(3)
    ]
