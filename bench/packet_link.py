"""A link between two network namespaces that loses, delays and reorders packets (Linux, as root).

The kernel's own means for this (``netem``) is not everywhere. Here each side has a TUN device, and this program hands
packets from one to the other.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

HERE, THERE = "10.91.0.1", "10.91.0.2"
NAMESPACE = "triline-there"
_TUNSETIFF, _TUN_WITHOUT_HEAD, _NEW_NETWORK = 0x400454CA, 0x0001 | 0x1000, 0x40000000


class PacketLink:
    """A link between this namespace (`HERE`) and one of its own (`THERE`).

    Parameters
    ----------
    loss : share of the packets that are lost, in both directions
    delay_s, spread_s : each packet comes after ``delay_s`` and a random time up to ``spread_s`` more, in which others
        may overtake it

    Raises
    ------
    OSError, subprocess.CalledProcessError : this machine has no namespaces or no TUN devices, or not for this user
    """

    def __init__(self, loss: float, delay_s: float = 0.0, spread_s: float = 0.0) -> None:
        self._loss, self._delay_s, self._spread_s = loss, delay_s, spread_s
        self.passed = self.lost = 0
        self._over = threading.Event()
        self._files: list[int] = []
        self._threads: list[threading.Thread] = []

    @property
    def prefix(self) -> list[str]:
        """Before a command that runs on the other side."""
        return ["ip", "netns", "exec", NAMESPACE]

    def __enter__(self) -> PacketLink:
        try:
            _ip("netns", "add", NAMESPACE)
            self._files.append(_tun("triline0"))
            found: list[int] = []
            thread = threading.Thread(target=lambda: found.append(_tun("triline1", NAMESPACE)))
            thread.start()
            thread.join()
            if not found:
                raise OSError("no TUN device in another namespace")
            self._files += found
            for where, device, address in ((), "triline0", HERE), (tuple(self.prefix), "triline1", THERE):
                _run(*where, "ip", "address", "add", f"{address}/24", "dev", device)
                _run(*where, "ip", "link", "set", device, "up")
            _run(*self.prefix, "ip", "link", "set", "lo", "up")
        except BaseException:
            self.__exit__()
            raise
        for number, (one, other) in enumerate((self._files, self._files[::-1])):
            thread = threading.Thread(target=self._carry, args=(one, other, random.Random(number)), daemon=True)
            thread.start()
            self._threads.append(thread)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for file in self._files:
            os.close(file)
        self._files.clear()
        subprocess.run(["ip", "netns", "delete", NAMESPACE], capture_output=True)

    def _carry(self, one: int, other: int, chance: random.Random) -> None:
        """Hand packets over when they are due."""
        under_way: list[tuple[float, int, bytes]] = []
        while not self._over.is_set():
            wait_s = min(0.1, max(0.0, under_way[0][0] - time.monotonic())) if under_way else 0.1
            if select.select([one], [], [], wait_s)[0]:
                packet = os.read(one, 65536)
                if chance.random() < self._loss:
                    self.lost += 1
                else:
                    due_s = time.monotonic() + self._delay_s + chance.uniform(0.0, self._spread_s)
                    self.passed += 1
                    heapq.heappush(under_way, (due_s, self.passed, packet))
            while under_way and under_way[0][0] <= time.monotonic():
                with suppress(OSError):  # the device is down
                    os.write(other, heapq.heappop(under_way)[2])


def _tun(name: str, namespace: str = "") -> int:
    """A new TUN device; in another namespace the thread that asks for it stays there."""
    if namespace:
        libc = ctypes.CDLL(None, use_errno=True)
        with open(Path("/run/netns") / namespace, "rb") as file:
            if libc.setns(file.fileno(), _NEW_NETWORK):
                raise OSError(ctypes.get_errno(), "the namespace cannot be entered")
    file = os.open("/dev/net/tun", os.O_RDWR)
    try:
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH", name.encode(), _TUN_WITHOUT_HEAD))
    except OSError:
        os.close(file)
        raise
    return file


def _ip(*arguments: str) -> None:
    _run("ip", *arguments)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)
