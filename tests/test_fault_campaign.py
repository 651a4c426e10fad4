"""Of the fault campaign (`bench/faults.py`): the link it puts between sensors and nodes, and what it counts."""

import socket
import subprocess
import sys
import threading
import time

import pytest
from places import ROOT

from triline.nodes.cli import main
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.writer import RecordingWriter
from triline.schemas import messages as m


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "bench"))


@pytest.fixture
def echo():
    """Port of a server that says what it hears."""
    server = socket.create_server(("127.0.0.1", 0))

    def say(one):
        with one:
            while data := one.recv(4096):
                one.sendall(data)

    def serve():
        while True:
            try:
                one, _ = server.accept()
            except OSError:
                return
            threading.Thread(target=say, args=(one,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    yield server.getsockname()[1]
    server.shutdown(socket.SHUT_RDWR)
    server.close()


def there_and_back(one, data):
    begun, heard = time.monotonic(), b""
    one.sendall(data)
    while len(heard) < len(data):
        heard += one.recv(65536)
    assert heard == data
    return time.monotonic() - begun


def call(link):
    return socket.create_connection(("127.0.0.1", link.port), timeout=20)


def test_a_link_delays_both_directions_and_a_silent_one_loses_nothing(bench, echo):
    from tcp_link import TcpLink

    with TcpLink(echo, delay_s=0.1) as link, call(link) as one:
        assert there_and_back(one, b"x" * 300_000) >= 0.2
        link.silent(0.5)
        assert there_and_back(one, b"after") >= 0.5


def test_a_closed_link_ends_connections_and_refuses_others_until_it_is_over(bench, echo):
    from tcp_link import TcpLink

    with TcpLink(echo) as link:
        with call(link) as one:
            there_and_back(one, b"before")
            link.closed(60.0)
            assert ended(one)
        with call(link) as one:
            assert ended(one)
        link.closed(0.0)
        with call(link) as one:
            there_and_back(one, b"after")


def ended(one):
    try:
        return one.recv(1) == b""
    except ConnectionError:
        return True


def test_a_link_between_namespaces_loses_packets_and_tcp_sends_them_again(bench, tmp_path):
    from packet_link import HERE, PacketLink

    try:
        with PacketLink(loss=0.1, delay_s=0.002, spread_s=0.004) as link:
            server = socket.create_server((HERE, 0))
            client = "import socket, sys; s = socket.create_connection((sys.argv[1], int(sys.argv[2])), 60)\n"
            client += "s.sendall(bytes(range(256)) * 200); s.shutdown(1); print(len(s.recv(99)))"
            command = [*link.prefix, sys.executable, "-c", client, HERE, str(server.getsockname()[1])]
            other = subprocess.Popen(command, stdout=subprocess.PIPE)
            server.settimeout(60)
            connection, _ = server.accept()
            heard = b""
            while data := connection.recv(65536):
                heard += data
            connection.sendall(b"seen")
            assert other.communicate(timeout=60)[0] == b"4\n" and heard == bytes(range(256)) * 200
            assert link.passed > 30 and link.lost > 0
            connection.close()
            server.close()
    except (OSError, subprocess.CalledProcessError) as error:
        if isinstance(error, TimeoutError):
            raise
        pytest.skip(f"no such link can be made here: {error}")


def test_green_lights_are_counted_in_what_a_live_recorder_writes(bench, tmp_path):
    """There messages about nodes have no platform time before the flight begins."""
    from faults import Outcome

    flight, out, live = (str(tmp_path / f"{name}.mcap") for name in ("flight", "out", "live"))
    plan = ["--seconds", "12", "--height", "300", "--control", "24", "--seed", "3", "--lead-in", "2"]
    assert main(["simulate", "-q", "-o", flight, *plan]) == 0
    assert main(["process", "-q", "--pace", "load", flight, "-o", out]) == 0
    with RecordingWriter(live) as writer:
        writer.write(Message("status/adjuster", 0, m.NodeStatus(node="adjuster", state="starting"), "adjuster", 0, 1))
        for message in RecordingReader(out).sorted_messages():
            writer.write(message)
    assert RecordingReader(live).index.stamp_ns.min() == 0
    got = Outcome.of([live])
    assert got.green > 10 and got.green == Outcome.of([out]).green
    assert 0 <= got.beyond <= got.green
