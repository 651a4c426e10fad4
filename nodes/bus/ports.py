"""Ports of this machine: where programs meet, and whether one is free."""

from __future__ import annotations

import os
import socket

from ..errors import UserError

DEFAULT_PORT = 17447


def default_port() -> int:
    """The meeting port: the environment variable TRILINE_PORT, or 17447."""
    text = os.environ.get("TRILINE_PORT", str(DEFAULT_PORT))
    if not text.isdigit() or not 0 < int(text) < 65536:
        raise UserError(f"TRILINE_PORT is {text!r}, wanted a port number")
    return int(text)


def port_is_held(port: int) -> bool:
    """Whether a program listens on a port of loopback."""
    return bool(why_not_free("127.0.0.1", port))


def why_not_free(host: str, port: int) -> str:
    """Why nobody can listen at an address now, in the words of the system; "" where it is free."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just given up is free
            probe.bind(address)
    except OSError as error:
        return (error.strerror or str(error)).lower()
    return ""
