"""Bytes of a sensor from a serial port, a TCP connection, UDP packets or a file that grows."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from urllib.parse import urlsplit

from ..errors import UserError
from .program import LOOK_S

#: Between two attempts to open what is not there, s.
RETRY_S = 1.0
WANTED = "serial:PORT, tcp://HOST:PORT, udp://HOST:PORT or file:NAME"
_MOST = 65536

Problem = Callable[[str, str], None]


def check_address(text: str, folder: Path) -> str:
    """An address with its file named in full.

    Raises
    ------
    ValueError : what was wanted: one of serial, tcp, udp, file; a port; a file where there is a folder
    """
    kind, colon, rest = text.partition(":")
    if not colon or not rest.strip("/"):
        raise ValueError(WANTED)
    if kind == "file":
        path = (folder / rest).resolve()
        if path.is_dir():
            raise ValueError("a file, not a folder")
        return f"file:{path}"
    if kind == "serial":
        return text
    if kind in ("tcp", "udp"):
        try:
            if not urlsplit(text).port:
                raise ValueError(WANTED)
        except ValueError:
            raise ValueError(f"a port from 1 to 65535, as in {kind}://127.0.0.1:4001") from None
        return text
    raise ValueError(WANTED)


def read_bytes(address: str, stop: Event, problem: Problem, baud: int = 115200) -> Iterator[bytes]:
    """What comes, as it comes; b"" now and then where nothing does. What breaks is counted, and opened again.

    A file is read from its beginning, then followed as it grows.

    Raises
    ------
    UserError : a serial port without the library for it
    """
    kind, _, rest = address.partition(":")
    opened = {"file": _file, "tcp": _tcp, "udp": _udp, "serial": _serial}[kind]
    where = address if kind in ("tcp", "udp") else rest
    while not stop.is_set():
        try:
            yield from opened(where, stop, baud)
        except OSError as error:
            problem("not connected", f"{address}: {error.strerror.lower() if error.strerror else error}")
            for _ in range(round(RETRY_S / LOOK_S)):
                yield b""
                stop.wait(LOOK_S)
        else:
            if not stop.is_set():
                problem("connection closed", f"{address}: the other side has closed it")
                yield b""
                stop.wait(RETRY_S)


def _file(path: str, stop: Event, baud: int) -> Iterator[bytes]:
    with open(path, "rb") as file:
        while not stop.is_set():
            data = file.read(_MOST)
            if not data:
                stop.wait(LOOK_S)
            yield data


def _tcp(address: str, stop: Event, baud: int) -> Iterator[bytes]:
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname or "127.0.0.1", parts.port or 0), timeout=5.0) as connection:
        connection.settimeout(LOOK_S)
        while not stop.is_set():
            try:
                data = connection.recv(_MOST)
            except TimeoutError:
                yield b""
                continue
            if not data:
                return
            yield data


def _udp(address: str, stop: Event, baud: int) -> Iterator[bytes]:
    parts = urlsplit(address)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        receiver.bind((parts.hostname or "127.0.0.1", parts.port or 0))
        receiver.settimeout(LOOK_S)
        while not stop.is_set():
            try:
                yield receiver.recv(_MOST)
            except TimeoutError:
                yield b""


def _serial(port: str, stop: Event, baud: int) -> Iterator[bytes]:
    try:
        import serial
    except ModuleNotFoundError:
        raise UserError(f"serial:{port}: wants pyserial: pip install 'triline[serial]'") from None
    with serial.Serial(port, baud, timeout=LOOK_S) as opened:
        while not stop.is_set():
            yield opened.read(max(opened.in_waiting, 1))
