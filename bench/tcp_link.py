"""A TCP link that is slow, silent or closed for a while.

The kernels of many machines cannot delay packets (no `netem`), so a program stands between: it takes connections on a
port of loopback, connects each of them to another port, and hands on what comes in either direction when its time is
due.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time

#: Bytes that are on their way at most are this many pieces of `PIECE` bytes; then the sender has to wait.
PIECES, PIECE = 4096, 65536


def free_port() -> int:
    """A port of loopback on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class TcpLink:
    """Connections to ``port`` go on to ``target_port``, both on loopback; ends with `close`, or as a context manager.

    Parameters
    ----------
    target_port : where the connections go on to
    delay_s : that each byte is under way, in each direction, s
    """

    def __init__(self, target_port: int, delay_s: float = 0.0) -> None:
        self._target_port, self._delay_s = target_port, delay_s
        self._silent_until_s = self._closed_until_s = 0.0
        self._sockets: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def silent(self, seconds: float) -> None:
        """Nothing comes through for so long; connections stay, and what was sent comes afterwards, as TCP does it."""
        self._silent_until_s = time.monotonic() + seconds

    def closed(self, seconds: float) -> None:
        """Connections are closed, what was on its way is lost, and new ones are refused for so long."""
        self._closed_until_s = time.monotonic() + seconds
        self._close_all()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)  # wakes who accepts
        self._server.close()
        self._close_all()

    def __enter__(self) -> TcpLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _close_all(self) -> None:
        with self._lock:
            for one in self._sockets:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()
            self._sockets.clear()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:
                return
            try:
                if time.monotonic() < self._closed_until_s:
                    raise ConnectionRefusedError
                far = socket.create_connection(("127.0.0.1", self._target_port))
            except OSError:
                near.close()
                continue
            with self._lock:
                self._sockets |= {near, far}
            for source, target in ((near, far), (far, near)):
                source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                under_way: queue.Queue[tuple[float, bytes]] = queue.Queue(PIECES)
                threading.Thread(target=self._take, args=(source, under_way), daemon=True).start()
                threading.Thread(target=self._hand_on, args=(under_way, target), daemon=True).start()

    def _take(self, source: socket.socket, under_way: queue.Queue[tuple[float, bytes]]) -> None:
        data = b"begun"
        while data:
            try:
                data = source.recv(PIECE)
            except OSError:
                data = b""
            under_way.put((time.monotonic() + self._delay_s, data))

    def _hand_on(self, under_way: queue.Queue[tuple[float, bytes]], target: socket.socket) -> None:
        data, stands = b"begun", True
        while data:
            due_s, data = under_way.get()
            while stands and (wait_s := max(due_s, self._silent_until_s) - time.monotonic()) > 0:
                time.sleep(wait_s)
            try:
                if data and stands:
                    target.sendall(data)
                elif stands:
                    target.shutdown(socket.SHUT_WR)
            except OSError:
                stands = False  # what still comes goes nowhere
