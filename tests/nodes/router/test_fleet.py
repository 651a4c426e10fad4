"""An aircraft, routers and the ground: who is heard, and that a link which is gone for a while loses nothing."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import sample_messages as sample
from bus_rig import Rig, free_port, wait_for
from places import ROOT

from triline.nodes.bus.authority import AIRCRAFT, DESK, GROUND_LINK, ROUTER, Authority
from triline.nodes.bus.bundle import load_bundle
from triline.nodes.bus.downlink import share_of
from triline.nodes.bus.session import Bus, routing, why_no_listening
from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.summary import topic_summaries
from triline.schemas import codec
from triline.schemas.envelope import Envelope, RawMessage, pack


@pytest.fixture
def authority(tmp_path) -> Authority:
    return Authority.create(tmp_path / "survey")


def certify(authority: Authority, port: int, link_port: int, mesh_port: int = 7447) -> None:
    authority.certify("ground", ROUTER, ["127.0.0.1"], port)
    authority.certify("ann", DESK, [], routers=[f"127.0.0.1:{port}"])
    for name in ("a1", "a2"):
        authority.certify(name, AIRCRAFT, [], mesh_port, routers=[f"127.0.0.1:{link_port}"])


def said(topic: str, number: int) -> RawMessage:
    return RawMessage(
        topic, Envelope(10**18 + number * 50_000_000, "adjuster", number, 7), codec.encode(sample.body(topic))
    )


def test_at_a_router_aircraft_speak_for_themselves_and_desks_read(authority):
    port = free_port()
    certify(authority, port, port)
    link = {name: authority.folder / name / GROUND_LINK for name in ("a1", "a2")}
    desk, heard, by_others = authority.folder / "ann", [], []
    with (
        routing(authority.folder / "ground" / "zenoh.json5"),
        Bus("a1", source="router", file=link["a1"], keep=False) as aircraft,
        Bus("a1", source="router", file=link["a2"], keep=False) as other,  # listens to a1 with the certificate of a2
        Bus("fleet", source="ground", secure=load_bundle(desk)) as ground,
        Bus("a1", source="forger", file=desk / "zenoh.json5") as forger,  # past the refusal of our own programs
    ):
        for topic in ("event/log", "observation/verdict"):
            ground.hear(topic, lambda platform, raw: heard.append((platform, raw.topic, raw.envelope.source)))
        other.subscribe("event/log", by_others.append)
        aircraft.subscribe("observation/verdict", by_others.append)
        aircraft.answer_messages("inventory", lambda parameters: [said("event/log", 5)])
        aircraft.announce("router")
        forged = codec.encode(sample.body("event/log"))
        wait_for(lambda: min(bus.peers() for bus in (aircraft, other, ground, forger)) > 0, 20, "links")

        def answered() -> bool:
            return [raw.envelope.sequence for raw in ground.ask("inventory", 2.0, "a1")] == [5]

        wait_for(answered, 20, "an answer over the router")
        for _ in range(20):
            aircraft._session.put("triline/a2/event/log", forged, attachment=pack(Envelope(1, "a1 as a2", 0, 1)))
            forger.publish(sample.message("event/log", source="desk"))
        forger.publish(sample.message("observation/verdict", source="desk"))
        wait_for(lambda: ("a1", "observation/verdict", "desk") in heard, 20, "the verdict of a desk")
        wait_for(lambda: len(by_others) == 1, 20, "the verdict in the aircraft")
        aircraft.publish_raw(said("event/log", 0))
        wait_for(lambda: ("a1", "event/log", "adjuster") in heard, 20, "what the aircraft says of itself")
        # sessions send in order: what was forged before would have been heard before
        assert {row for row in heard if row[2] != "adjuster"} == {("a1", "observation/verdict", "desk")}
        assert len(by_others) == 1  # no aircraft hears another one


@pytest.mark.parametrize("last", ["ground", "a1", "ann"])
def test_who_is_let_in_does_not_depend_on_who_was_certified_last(authority, last):
    """Desks behind a router hear routers; the nodes of an aircraft do not: its router takes what comes from below."""
    kinds = {
        "ground": (ROUTER, ["127.0.0.1"], []),
        "a1": (AIRCRAFT, [], ["127.0.0.1"]),
        "ann": (DESK, [], ["127.0.0.1"]),
    }
    for name in sorted(kinds, key=lambda name: name == last):
        kind, hosts, routers = kinds[name]
        authority.certify(name, kind, hosts, routers=routers)
    let_in = {}
    for name in kinds:
        settings = json.loads((authority.folder / name / "zenoh.json5").read_text().partition("\n")[2])
        let_in[name] = {subject["id"] for subject in settings["access_control"]["subjects"]}
    assert ["routers" in let_in[name] for name in ("ground", "ann", "a1")] == [True, True, False]
    assert all({"aircraft-a1", "desks"} <= subjects for subjects in let_in.values())


def test_a_router_says_that_its_port_is_taken_and_who_is_linked(authority):
    port = free_port()
    certify(authority, port, port)
    file = authority.folder / "ground" / "zenoh.json5"
    assert why_no_listening(file) == []
    with routing(file) as linked, Bus("a1", source="router", file=authority.folder / "a1" / GROUND_LINK, keep=False):
        wait_for(lambda: linked() == 1, 20, "an aircraft that is counted")
        assert why_no_listening(file) == [f"127.0.0.1:{port}: address already in use"]
        with routing(file) as waiting:  # and its end is no fault
            assert waiting() == 0


def test_bundles_of_a_fleet_listen_nowhere_else_and_say_what_is_wrong(authority, tmp_path, capsys):
    certify(authority, 7447, 7447)
    for name, mode in (("ground", "router"), ("ann", "client"), ("a1", "peer")):
        settings = json.loads((authority.folder / name / "zenoh.json5").read_text().partition("\n")[2])
        assert settings["mode"] == mode and settings["access_control"]["default_permission"] == "deny"
        assert all(end.startswith("tls/127.0.0.1:") for end in settings["listen"]["endpoints"])
        assert settings["scouting"]["gossip"]["enabled"] is (mode == "peer")
    link = json.loads((authority.folder / "a1" / GROUND_LINK).read_text().partition("\n")[2])
    assert link["mode"] == "client" and link["listen"]["endpoints"] == []
    assert "router 'ground' cannot publish" in load_bundle(authority.folder / "ground").refuses("a1", "event/log")
    folder = str(authority.folder)
    for arguments, wanted in (
        (("keys", "router", "r2", "--authority", folder), "wanted --host"),
        (("keys", "aircraft", "a9", "--authority", folder, "--router", "a b"), "wanted HOST or HOST:PORT"),
        (("keys", "aircraft", "a9", "--authority", folder, "--router", "h:99999"), "wanted HOST or HOST:PORT"),
        (("keys", "desk", "bob", "--authority", folder, "--router", "h", "--host", "g"), "wanted one of them"),
        (("node", "router"), "wanted --secure BUNDLE"),
        (("node", "router", "--secure", f"{folder}/ann"), "is of a desk"),
        (("monitor", "--fleet", "--platform", "a1"), "wanted one of them"),
        (("monitor", "--fleet", "--secure", f"{folder}/ann", "--seconds", "0"), "wanted more than 0"),
        (("view",), "0 recordings, wanted one"),
        (("view", "a.mcap", "b.mcap"), "2 recordings, wanted one"),
    ):
        assert main(list(arguments)) == 1
        error = capsys.readouterr().err
        assert wanted in error and len(error.splitlines()) == 1, error
    authority.certify("a3", AIRCRAFT, ["127.0.0.1"])
    assert main(["node", "router", "--secure", f"{folder}/a3"]) == 1
    assert "calls no router" in capsys.readouterr().err
    authority.certify("bob", DESK, [], routers=[f"127.0.0.1:{free_port()}"])
    with pytest.raises(UserError, match=r"nobody can be met: .*nobody listens there"):
        Bus("fleet", secure=load_bundle(authority.folder / "bob"))


def test_a_link_that_is_cut_loses_nothing(authority, tmp_path, monkeypatch):
    """One aircraft and one router on the ground; a program between them stands for the radio link."""
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    from tcp_link import TcpLink

    for name in ("air", "earth"):
        (tmp_path / name).mkdir()
    with Rig(tmp_path / "air") as air, Rig(tmp_path / "earth") as earth, TcpLink(earth.port) as link:
        certify(authority, earth.port, link.port, air.port)
        secure = {name: ["--secure", authority.folder / name] for name in ("ground", "a1", "ann")}
        programs = [
            earth.start("node", "router", *secure["ground"]),
            air.start("node", "recorder", "-o", tmp_path / "board.mcap", *secure["a1"]),
            air.start("node", "router", *secure["a1"], "--set", "bytes_s=2e6"),
        ]
        recording = ("--set", f"output={tmp_path / 'fleet'}", "--set", "ask_s=0.5")
        wait_for(lambda: "router ground on port" in earth.log("router"), 40, "the router on the ground")
        programs.append(earth.start("node", "ground", *secure["ann"], *recording))
        desk, aircraft = load_bundle(authority.folder / "ann"), load_bundle(authority.folder / "a1")
        told: dict[str, object] = {}

        def hear(raw: RawMessage) -> None:
            told[raw.topic] = codec.decode(raw.topic, raw.data)

        def counted(name: str) -> int:
            status = told.get("status/ground")
            return next((c.value for c in getattr(status, "counters", ()) if c.name == name), -1)

        with (
            Bus("a1", source="test", port=air.port, secure=aircraft) as board,
            Bus("fleet", source="desk", port=earth.port, secure=desk) as office,
        ):
            board.subscribe("status/router", hear)
            office.subscribe("status/ground", hear)

            def linked(wanted: bool) -> bool:
                return getattr(told.get("status/router"), "state", "").startswith("linked" if wanted else "no link")

            def say(first: int, last: int) -> None:
                for number in range(first, last):
                    for topic in ("orientation/final", "adjustment/report", "sensor/attitude"):
                        board.publish_raw(said(topic, number))

            wait_for(lambda: linked(True) and "ground" in office.alive(), 40, "the link")
            wait_for(lambda: board.alive() >= {"recorder", "router"}, 40, "the nodes on board")
            board.publish(sample.message("configuration/camera"))
            looked = codec.encode(sample.body("status/monitor"))  # of a desk that looks for one that is not there
            office._session.put("triline/nobody/status/monitor", looked, attachment=pack(Envelope(1, "monitor", 0, 1)))
            verdicts: dict[str, list[str]] = {"board": [], "office": []}
            board.subscribe("observation/verdict", lambda raw: verdicts["board"].append(raw.envelope.source))
            office.hear("observation/verdict", lambda _, raw: verdicts["office"].append(raw.envelope.source))
            with Bus("a1", source="ann", port=earth.port, secure=desk) as surveyor:
                wait_for(lambda: surveyor.alive() >= {"router"}, 40, "the aircraft, from a desk")
                surveyor.publish(sample.message("observation/verdict", source="ann"))
                wait_for(lambda: "ann" in verdicts["board"], 40, "a verdict on board")
            board.publish(sample.message("observation/verdict", source="pilot"))
            wait_for(lambda: "pilot" in verdicts["office"], 40, "a verdict on the ground")
            say(0, 100)
            wait_for(lambda: counted("a1 missing") == 0 and (tmp_path / "fleet" / "a1.mcap").exists(), 40, "the first")
            link.closed(3600.0)
            wait_for(lambda: linked(False), 40, "the cut")
            before = counted("a1 filled")
            say(100, 200)
            time.sleep(0.5)
            link.closed(0.0)
            wait_for(lambda: linked(True), 40, "the link again")
            say(200, 250)
            wait_for(lambda: counted("a1 filled") >= before + 100 and counted("a1 missing") == 0, 60, "what was missed")
        # none goes round between the two sessions of the router on board
        assert {name: sorted(said) for name, said in verdicts.items()} == {name: ["ann", "pilot"] for name in verdicts}
        assert [
            earth.stop(program) if program in earth.processes else air.stop(program) for program in programs[1:]
        ] == [0, 0, 0]
        assert earth.stop(programs[0]) == 0
    assert [path.name for path in (tmp_path / "fleet").glob("*.mcap")] == ["a1.mcap"]
    board_file, ground_file = RecordingReader(tmp_path / "board.mcap"), RecordingReader(tmp_path / "fleet" / "a1.mcap")

    def messages(reader: RecordingReader) -> dict[object, bytes]:
        return {(raw.topic, raw.envelope): bytes(raw.data) for raw in reader.raws(reader.select())}

    def wanted(topic: str, envelope: Envelope) -> bool:
        share = share_of(topic)
        return share is not None and share.filled and envelope.sequence % share.every == 0

    there, here = messages(board_file), messages(ground_file)
    mine = {key: data for key, data in there.items() if wanted(*key)}
    for all_of in (mine, here):  # a verdict of a desk has another stamp on board
        said_by = sorted(key[1].source for key in list(all_of) if key[0] == "observation/verdict" and all_of.pop(key))
        assert said_by == ["ann", "pilot"]
    assert mine.items() <= here.items()
    numbers = sorted(envelope.sequence for topic, envelope in here if topic == "orientation/final")
    assert numbers == list(range(250)) and not any(topic == "sensor/attitude" for topic, _ in here)
    # what the ground does not ask for, statuses, may be missing after a cut
    lost = {row.topic for row in topic_summaries(ground_file) if row.gaps}
    assert all((share := share_of(topic)) is not None and not share.filled for topic in lost), lost
    assert ground_file.complete and not ground_file.damage


@pytest.mark.study
def test_four_aircraft_and_three_routers_in_namespaces(tmp_path):
    sys.path.insert(0, str(ROOT / "bench"))
    from fleet import allowed

    why = allowed()
    if why:
        pytest.skip(why)
    command = [sys.executable, str(Path(ROOT) / "bench" / "fleet.py"), "--seconds", "60", "--cut", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout + done.stderr
