"""Certificates and access lists: who is let in, who may say what, and what those are told who are not."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import shutil
import socket
import ssl
import stat
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import sample_messages as sample
from bus_rig import Rig, free_port, triline, wait_for
from command_line import run
from cryptography import x509

from triline.nodes.bus.authority import AIRCRAFT, CERTIFICATE, DESK, KEY, USES, Authority
from triline.nodes.bus.bundle import ExpiryWatch, load_bundle
from triline.nodes.bus.program import ProgramOptions
from triline.nodes.bus.session import Bus
from triline.nodes.cli.live_flight import LiveFlight
from triline.nodes.errors import UserError
from triline.nodes.node import Message


@pytest.fixture
def authority(tmp_path) -> Authority:
    made = Authority.create(tmp_path / "survey")
    made.certify("aircraft1", AIRCRAFT, [])
    made.certify("ann", DESK, [])
    return made


def keys(capsys, *arguments) -> tuple[int, str, str]:
    return run(capsys, "keys", *arguments)


def test_keys_makes_bundles_lists_and_revokes(tmp_path, capsys):
    folder = tmp_path / "survey"
    assert keys(capsys, "new", folder)[0] == 0
    assert "survey" in keys(capsys, "aircraft", "aircraft1", "--authority", folder, "--host", "10.77.0.1")[1]
    code, out, _ = keys(capsys, "desk", "ann", "--authority", folder, "--host", "10.77.0.1")
    assert code == 0 and f"copy again {folder / 'aircraft1'}" in out
    code, out, _ = keys(capsys, "list", "--authority", folder)
    assert [line.split()[:2] for line in out.splitlines()[1:]] == [["aircraft1", "aircraft"], ["ann", "desk"]]
    listed = json.loads(keys(capsys, "list", "--authority", folder, "--json")[1])
    assert [member["name"] for member in listed["members"]] == ["aircraft1", "ann"]
    assert json.loads(keys(capsys, "--json", "list", "--authority", folder)[1]) == listed
    assert keys(capsys, "revoke", "ann", "--authority", folder)[0] == 0
    assert "revoked" in keys(capsys, "list", "--authority", folder)[1]
    for arguments, wanted in (
        (("new", folder), "is an authority already"),
        (("aircraft", "aircraft1", "--authority", folder), "this name is taken"),
        (("aircraft", "a/b", "--authority", folder), "wanted a name"),
        (("aircraft", "a2", "--authority", folder, "--host", "not a host"), "--host 'not a host': wanted an address"),
        (("router", "r2", "--authority", folder, "--host", "10.77.0.1:7450"), "wanted an address"),
        (("aircraft", "a2", "--authority", folder, "--port", "99999"), "--port 99999: wanted 1 to 65535"),
        (("aircraft", "a2", "--authority", folder, "--days", "0"), "--days 0: wanted 1 to 36500"),
        (("aircraft", "a2", "--authority", folder, "--days", "99999999"), "wanted 1 to 36500"),
        (("revoke", "bob", "--authority", folder), "is not certified"),
        (("list", "--authority", tmp_path), "no authority"),
    ):
        code, _, err = keys(capsys, *arguments)
        assert code == 1 and wanted in err and len(err.splitlines()) == 1
    (folder / "authority.json").write_text("{")
    assert "damaged" in keys(capsys, "list", "--authority", folder)[2]


def test_certificates_have_names_and_uses_and_private_files_are_private(tmp_path):
    authority = Authority.create(tmp_path / "survey")
    bundle = authority.certify("aircraft1", AIRCRAFT, ["10.77.0.1", "aircraft1.local"])
    certificate = x509.load_pem_x509_certificate((bundle / CERTIFICATE).read_bytes())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(ip) for ip in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "10.77.0.1"]
    assert names.get_values_for_type(x509.DNSName) == ["localhost", "aircraft1.local"]
    assert list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == USES
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    for path in (bundle / KEY, bundle / "zenoh.json5", authority.folder / KEY, authority.folder / "authority.json"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
    text = (bundle / "zenoh.json5").read_text()
    configuration = json.loads(text.partition("\n")[2])
    endpoints = configuration["listen"]["endpoints"] + configuration["connect"]["endpoints"]
    assert all(endpoint.startswith("tls/") and "0.0.0.0" not in endpoint for endpoint in endpoints)
    assert configuration["access_control"]["default_permission"] == "deny"


def test_a_program_that_goes_on_for_months_tells_ahead_that_its_certificate_expires(authority):
    """It was told when a program began, to a router on the ground that had begun long before to nobody."""
    bundle = load_bundle(authority.folder / "ann")
    watch, hour = ExpiryWatch(bundle), datetime.timedelta(hours=1)
    told = {
        hours: watch.look(bundle.until - hours * hour) for hours in (9000, 721, 719, 700, 169, 167, 23, 2, 0.9, -1, -2)
    }
    assert [hours for hours, line in told.items() if line] == [719, 167, 23, 0.9, -1]
    assert "'ann' expires on 20" in told[0.9] and "'ann' expired on 20" in told[-1]
    assert ExpiryWatch(bundle).look() == ""

    ends = replace(bundle, until=datetime.datetime.now(datetime.UTC) + 10 * hour)
    said: list[str] = []
    program = ProgramOptions("router", secure=ends, report=said.append)
    watch = ExpiryWatch(ends)
    program.tell_expiry(watch)
    program.tell_expiry(watch)
    assert [line[:35] for line in said] == ["router: the certificate of 'ann' ex"]


def test_a_flight_tells_on_its_screen_that_its_certificate_expires(authority, monkeypatch):
    bundle = load_bundle(authority.folder / "ann")
    said: list[str] = []
    flight = SimpleNamespace(expiry=ExpiryWatch(bundle), watch=SimpleNamespace(tell=said.append))
    LiveFlight._tell_expiry(flight)
    assert not said
    flight.expiry.bundle = replace(bundle, until=datetime.datetime.now(datetime.UTC) + datetime.timedelta(minutes=50))
    LiveFlight._tell_expiry(flight)
    LiveFlight._tell_expiry(flight)
    assert len(said) == 1 and "'ann' expires on 20" in said[0]


def test_a_bundle_that_cannot_be_used_is_refused_with_its_reason(authority, tmp_path):
    good = authority.folder / "ann"
    assert load_bundle(good).kind == DESK
    other = Authority.create(tmp_path / "others")
    foreign = other.certify("ann", DESK, [])
    years = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=800)
    with pytest.raises(UserError, match=r"the certificate expired on 20\d\d-"):
        load_bundle(good, years)
    with pytest.raises(UserError, match="is the clock of this machine right"):
        load_bundle(good, datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC))

    weeks = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=705)
    assert load_bundle(good).ends_soon() == ""
    assert re.fullmatch(
        r"the certificate of 'ann' expires on 20\d\d-\d\d-\d\d \d\d:\d\d UTC: from then on no program hears .*",
        load_bundle(good).ends_soon(weeks),
    )
    assert "'ann' expired on 20" in load_bundle(good).ends_soon(years)

    def spoilt(name: str, spoil) -> Path:
        folder = tmp_path / name
        shutil.copytree(good, folder)
        spoil(folder)
        return folder

    def rename(folder: Path) -> None:
        facts = json.loads((folder / "bundle.json").read_text()) | {"name": "bob"}
        (folder / "bundle.json").write_text(json.dumps(facts))

    def list_as_revoked(folder: Path) -> None:
        facts = json.loads((folder / "bundle.json").read_text())
        facts["revoked_serials"] = {facts["serial"]: "ann"}
        (folder / "bundle.json").write_text(json.dumps(facts))

    for name, spoil, wanted in (
        ("a", lambda f: (f / CERTIFICATE).unlink(), "no certificate"),
        ("b", lambda f: (f / KEY).unlink(), "no private key"),
        ("c", lambda f: shutil.copy(foreign / CERTIFICATE, f), "of another authority"),
        ("d", lambda f: shutil.copy(foreign / KEY, f), "does not go with the certificate"),
        ("e", rename, "the certificate is of 'ann', the bundle of desk 'bob'"),
        ("f", list_as_revoked, "was revoked by 'survey'"),
        ("g", lambda f: (f / CERTIFICATE).write_text("rubbish"), "damaged"),
        ("h", lambda f: (f / "bundle.json").write_text("[" * 100_000), "damaged"),
        ("i", lambda f: os.chmod(f / KEY, 0o644), "wanted mode 600"),
    ):
        with pytest.raises(UserError, match=wanted):
            load_bundle(spoilt(name, spoil))
    with pytest.raises(UserError, match="no such bundle"):
        load_bundle(tmp_path / "nowhere")


def test_an_aircraft_is_heard_a_desk_reads_and_what_it_forges_is_dropped(authority):
    port = free_port()
    aircraft, desk = load_bundle(authority.folder / "aircraft1"), load_bundle(authority.folder / "ann")
    heard: list[tuple[str, str]] = []
    with (
        Bus("aircraft1", source="sensors", port=port, secure=aircraft) as one,
        Bus("aircraft1", source="navigator", port=port, secure=aircraft) as two,
        Bus("aircraft1", source="surveyor", port=port, secure=desk) as office,
    ):
        for name, bus in (("node", two), ("desk", office)):
            for topic in ("configuration/camera", "sensor/gnss", "observation/verdict", "status/*"):
                bus.subscribe(topic, lambda raw, name=name: heard.append((name, raw.topic)))
        two.announce("navigator")
        wait_for(lambda: [bus.peers() for bus in (one, two, office)] == [2, 2, 2], 20, "encrypted links")
        wait_for(lambda: office.alive() == {"navigator"}, 10, "the token")
        one.publish(sample.message("configuration/camera"))
        wait_for(
            lambda: {("node", "configuration/camera"), ("desk", "configuration/camera")} <= set(heard), 10, "camera"
        )
        one.publish(sample.message("sensor/gnss"))
        office.publish(sample.message("observation/verdict"))
        wait_for(lambda: {("desk", "sensor/gnss"), ("node", "observation/verdict")} <= set(heard), 10, "both ways")
        with pytest.raises(UserError, match="desk 'ann' cannot publish sensor/gnss: a desk reads"):
            office.publish(sample.message("sensor/gnss"))
        heard.clear()
        office._secure = None  # as a program would that is not ours
        for topic in ("sensor/gnss", "configuration/camera", "orientation/final", "status/navigator"):
            office.publish(sample.message(topic, 1))
        office.publish(sample.message("observation/verdict", 1))  # comes after all of them
        wait_for(lambda: ("node", "observation/verdict") in heard, 10, "the verdict")
        assert [entry for entry in heard if entry[0] == "node"] == [("node", "observation/verdict")]
        assert "answers in TLS alone, wanted --secure" in _alone(port)


def _alone(port: int) -> str:
    with Bus("aircraft1", source="plain", port=port) as plain:
        plain._held = True
        return plain.why_alone(1.0)


def test_another_aircraft_and_a_revoked_desk_are_not_heard(authority):
    port = free_port()
    authority.certify("aircraft2", AIRCRAFT, [])
    revoked = authority.folder.parent / "kept"
    shutil.copytree(authority.folder / "ann", revoked)  # what somebody has who was revoked later
    authority.revoke("ann")
    bundles = [load_bundle(path) for path in (authority.folder / "aircraft1", authority.folder / "aircraft2", revoked)]
    heard: list[str] = []
    with (
        Bus("aircraft1", source="node", port=port, secure=bundles[0]) as node,
        Bus("aircraft1", source="other", port=port, secure=bundles[1]) as other,
        Bus("aircraft1", source="surveyor", port=port, secure=bundles[2]) as desk,
    ):
        node.subscribe("sensor/gnss", lambda raw: heard.append(raw.envelope.source))
        node.subscribe("observation/verdict", lambda raw: heard.append(raw.envelope.source))
        with pytest.raises(UserError, match="aircraft 'aircraft2' cannot publish for platform 'aircraft1'"):
            other.publish(sample.message("sensor/gnss"))
        other._secure = desk._secure = None
        wait_for(lambda: node.peers() == 2, 20, "links")
        other.publish(sample.message("sensor/gnss", 1, "other"))
        desk.publish(Message("observation/verdict", sample.EPOCH_NS, sample.body("observation/verdict"), "surveyor"))
        time.sleep(1.0)
        assert heard == []


def test_why_nobody_answers_is_told_in_a_line(authority, tmp_path):
    port, plain_port = free_port(), free_port()
    other = Authority.create(tmp_path / "others")
    aircraft = load_bundle(authority.folder / "aircraft1")
    desk, stranger = load_bundle(authority.folder / "ann"), load_bundle(other.certify("eve", DESK, []))
    here = [f"tls/127.0.0.1:{port}"]
    assert desk.why_nobody(here) == f"127.0.0.1:{port}: nobody listens there"
    with Bus("aircraft1", source="a", port=port, secure=aircraft), Bus("demo", source="b", port=plain_port):
        assert desk.why_nobody(here) == ""
        assert "the certificate there is of another authority than 'others'" in stranger.why_nobody(here)
        assert "does not answer in TLS" in desk.why_nobody([f"tls/127.0.0.1:{plain_port}"])
        with Bus("aircraft1", source="eve", port=port, secure=stranger) as bus:
            assert "nobody can be met: " in bus.why_alone(1.0) and "another authority" in bus.why_alone(0.0)
    assert stranger.refuses("aircraft1", "sensor/gnss")


@contextlib.contextmanager
def _server(host: str, bundle: Path, wants: Path | None = None):
    """A TLS server with the certificate of a bundle; gives its endpoint. ``wants``: whose certificates it lets in."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(bundle / CERTIFICATE, bundle / KEY)
    if wants is not None:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(wants)
    listener = socket.create_server((host, 0))

    def serve() -> None:
        with contextlib.suppress(OSError):
            plain, _ = listener.accept()
            with context.wrap_socket(plain, server_side=True) as link:
                link.recv(1)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"tls/{host}:{listener.getsockname()[1]}"
    finally:
        listener.close()
        thread.join(60)


def test_names_revoked_expired_and_refused_certificates_at_the_other_end_are_told_apart(
    authority, tmp_path, monkeypatch
):
    desk = load_bundle(authority.folder / "ann")
    with _server("127.0.0.2", authority.folder / "aircraft1") as endpoint:
        assert "the certificate there is of another name than this address" in desk.why_nobody([endpoint])
    old = tmp_path / "old"
    shutil.copytree(authority.folder / "aircraft1", old)
    authority.revoke("aircraft1")
    desk = load_bundle(authority.folder / "ann")
    with _server("127.0.0.1", old) as endpoint:
        assert "the certificate of 'aircraft1' there was revoked" in desk.why_nobody([endpoint])
    days_ago = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=3)
    expired = authority.certify("aircraft3", AIRCRAFT, [], days=1, now=days_ago)
    with _server("127.0.0.1", expired) as endpoint:
        assert "the certificate there has expired" in desk.why_nobody([endpoint])
    other = Authority.create(tmp_path / "others")
    with _server("127.0.0.1", authority.folder / "ann", other.folder / CERTIFICATE) as endpoint:
        assert "refuses this certificate: of another authority" in desk.why_nobody([endpoint])


def test_nodes_run_with_bundles_and_the_wrong_ones_are_refused_in_a_line(authority, tmp_path):
    bundle = authority.folder / "aircraft1"
    with Rig(tmp_path) as rig:
        rig.start("node", "navigator", "--secure", bundle)
        with Bus("aircraft1", source="desk", port=rig.port, secure=load_bundle(authority.folder / "ann")) as bus:
            wait_for(lambda: "navigator" in bus.alive(), 30, "the encrypted navigator")
        told = triline("node", "navigator", "--secure", bundle, "--platform", "aircraft2", "--port", rig.port)
        assert told.returncode == 1 and "is of aircraft 'aircraft1', not of 'aircraft2'" in told.stderr


def test_who_is_certified_anew_does_not_let_in_what_was_revoked_under_that_name(authority):
    """Access lists know the name in a certificate alone: a stolen one must not have that of the one in its place."""
    stolen = authority.folder.parent / "stolen"
    shutil.copytree(authority.folder / "ann", stolen)
    names = []
    for _ in range(2):
        authority.revoke("ann")
        names.append(x509.load_pem_x509_certificate((authority.certify("ann", DESK, []) / CERTIFICATE).read_bytes()))
    assert [name.subject.rfc4514_string() for name in names] == ["CN=ann.2", "CN=ann.3"]
    assert load_bundle(authority.folder / "ann").name == "ann"
    settings = json.loads((authority.folder / "aircraft1" / "zenoh.json5").read_text().partition("\n")[2])
    let_in = {entry["id"]: entry.get("cert_common_names") for entry in settings["access_control"]["subjects"]}
    assert let_in["desks"] == ["ann.3"] and let_in["aircraft-aircraft1"] == ["aircraft1"]
    port, heard = free_port(), []
    aircraft = load_bundle(authority.folder / "aircraft1")
    with (
        Bus("aircraft1", source="node", port=port, secure=aircraft) as node,
        Bus("aircraft1", source="thief", port=port, secure=load_bundle(stolen)) as thief,
        Bus("aircraft1", source="ann", port=port, secure=load_bundle(authority.folder / "ann")) as desk,
    ):
        node.subscribe("observation/verdict", lambda raw: heard.append(raw.envelope.source))
        wait_for(lambda: node.peers() == 2, 20, "links")

        def told() -> bool:
            for bus, source in ((thief, "thief"), (desk, "ann")):
                bus.publish(Message("observation/verdict", sample.EPOCH_NS, sample.body("observation/verdict"), source))
            return "ann" in heard

        wait_for(told, 20, "the verdict of the desk")
        time.sleep(0.5)
        assert set(heard) == {"ann"}
