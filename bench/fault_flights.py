"""Flights over the bus that something happens to: nodes in processes of their own, fed by `triline replay`."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import frame
from packet_link import HERE, PacketLink
from tcp_link import TcpLink, free_port

from triline.nodes.bus.processes import NodeGroup
from triline.nodes.bus.session import Bus, configuration
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.schemas import codec

SECONDS, LEAD_S, FAULT_S = 36, 10.0, 26.0  # of the strip, before it, and of the fault from the start of the flight
NODES = ("recorder", "navigator", "adjuster")


@dataclass
class Flown:
    """A simulated flight of one strip."""

    path: Path
    messages: list[Message]
    start_ns: int

    @classmethod
    def simulated(cls, path: Path, *options: str) -> Flown:
        plan = ("--seconds", str(SECONDS), "--control", "9", "--seed", "1")
        frame.triline("simulate", "-o", str(path), *plan, *options, "-q")
        messages = list(RecordingReader(path).sorted_messages())
        return cls(path, messages, next(m.stamp_ns for m in messages if m.topic == "sensor/attitude"))

    @property
    def at_ns(self) -> int:
        """When the faults come."""
        return self.start_ns + round(FAULT_S * 1e9)

    @property
    def strip(self) -> tuple[int, int]:
        """Begin and end of the strip, ns."""
        return self.start_ns + round(LEAD_S * 1e9), self.start_ns + round((LEAD_S + SECONDS) * 1e9)


# ---- processes


class Rig:
    """A flight over the bus, as it is flown."""

    patience_s = 300.0  # with a replay, from the fault on
    prefix: tuple[str, ...] | list[str] = ()  # before the replay's command

    def __init__(self, flight: Path, folder: Path, rate: float, recorder_output: Path | None = None) -> None:
        self.folder, self.rate = folder, rate
        self.output = recorder_output or folder / "live.mcap"
        self.port = free_port()
        self.group = NodeGroup(folder / "log", "demo", self.port)
        self.flight = flight
        self.alarms: list[str] = []
        self.fault_ns = 0  # when it came, by the clock of this machine
        self.first_ns = self.newest_ns = 0  # stamps of the replay that were heard

    def start(self, name: str, id: str = "") -> None:
        more = ["-o", str(self.output)] if name == "recorder" else []
        self.group.start(name, *more, id=id)

    def bus(self) -> Bus:
        """The session of this program."""
        return Bus(source="campaign", port=self.port)

    def where(self) -> list[str]:
        """Options with which the replay meets the nodes."""
        return ["--port", str(self.port)]

    def fly(self, fault: Callable[[Any], None] | None, at_s: float = FAULT_S) -> list[Path]:
        with self.group, self.bus() as bus:
            bus.subscribe("sensor/attitude", self._follow)
            bus.subscribe("status/*", self._hear)
            for name in NODES:
                self.start(name)
            until = time.monotonic() + 60
            while not bus.alive() >= set(NODES) and time.monotonic() < until:
                time.sleep(0.1)
            command = [*self.prefix, *frame.TRILINE, "replay", str(self.flight), "--rate", str(self.rate), "-q"]
            command += ["--wait-for", "navigator,adjuster", *self.where()]
            replay = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                while fault is not None and replay.poll() is None:
                    if self.first_ns and (self.newest_ns - self.first_ns) * 1e-9 > at_s:
                        self.fault_ns = time.time_ns()
                        fault(self)
                        break
                    time.sleep(0.02)
                replay.wait(self.patience_s)
            finally:
                if replay.poll() is None:
                    replay.kill()
            time.sleep(3.0)
            for name in ("navigator", "adjuster", "recorder"):
                process = self.group.processes.get(name)
                if process is not None:
                    process.stop(20.0, self.output.parent if name == "recorder" else None)
        return sorted(self.output.parent.glob(f"{self.output.stem}*.mcap"))

    def _follow(self, raw: Any) -> None:
        self.first_ns = self.first_ns or raw.envelope.stamp_ns
        self.newest_ns = max(self.newest_ns, raw.envelope.stamp_ns)

    def _hear(self, raw: Any) -> None:
        alarm = codec.decode(raw.topic, raw.data).alarm
        if alarm and alarm not in self.alarms:
            self.alarms.append(alarm)

    def killed(self, name: str) -> None:
        self.group.processes[name].process.kill()
        self.group.processes[name].process.wait()
        self.start(name)

    def stopped(self, seconds: float, *names: str) -> None:
        processes = [self.group.processes[name].process for name in names]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        for process in processes:
            process.send_signal(signal.SIGCONT)
        self.fault_ns = time.time_ns()


def of_processes() -> dict[str, Callable[[Rig], None]]:
    """Faults of processes, by name."""
    out: dict[str, Callable[[Rig], None]] = {}
    for name in NODES:
        out[f"SIGKILL and restart: {name}"] = lambda rig, name=name: rig.killed(name)
    for name in NODES:
        for seconds in (1.0, 5.0):
            out[f"SIGSTOP {seconds:g} s: {name}"] = lambda rig, name=name, seconds=seconds: rig.stopped(seconds, name)
    out["SIGSTOP 15 s: navigator, adjuster, recorder"] = lambda rig: rig.stopped(15.0, *NODES)
    out["a second program in the sensors' name, 5 s"] = second_replay
    out["two navigators"] = lambda rig: rig.start("navigator", id="second")
    return out


def second_replay(rig: Rig) -> None:
    """The same flight once more from the start, in the name of the first, for 5 s."""
    command = [*frame.TRILINE, "replay", str(rig.flight), "--rate", str(rig.rate), "-q", "--port", str(rig.port)]
    second = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(5.0)
    second.kill()
    second.wait()


# ---- the link between the sensors and the nodes


class RemoteRig(Rig, ABC):
    """The same with the replay on the other side of a link. Nodes find each other as ever; the replay calls each of
    them, and this program, over the link, is called by nobody, and is told of nobody."""

    def __init__(self, flight: Path, folder: Path, rate: float) -> None:
        super().__init__(flight, folder, rate)
        self._ports = {name: free_port() for name in ("campaign", *NODES)}
        self.group = NodeGroup(folder / "log", "demo", 0, self._file("campaign"))

    @abstractmethod
    def far_ends(self) -> list[str]:
        """What the replay calls."""

    def listening(self, port: int) -> list[str]:
        """Where a program with a port listens."""
        return [f"tcp/127.0.0.1:{port}"]

    def start(self, name: str, id: str = "") -> None:
        more = ["-o", str(self.output)] if name == "recorder" else []
        self.group.start(name, *more, "--bus", str(self._file(name)), id=id)

    def bus(self) -> Bus:
        return Bus(source="campaign", file=self._file("campaign"))

    def where(self) -> list[str]:
        return ["--bus", str(self._file("replay"))]

    def _file(self, name: str) -> Path:
        """Zenoh configuration of a program: the usual one with its own port, or that of the replay."""
        config = configuration(self._ports["campaign"])
        if name in self._ports:
            config.insert_json5("listen/endpoints", json.dumps(self.listening(self._ports[name])))
        else:
            config.insert_json5("listen/endpoints", "[]")
            config.insert_json5("connect/endpoints", json.dumps(self.far_ends()))
            config.insert_json5("scouting/gossip/enabled", "false")
        path = self.folder / f"{name}.json5"
        path.write_text(str(config))
        return path


class TcpRig(RemoteRig):
    """Over a `TcpLink` to each node."""

    def __init__(self, flight: Path, folder: Path, rate: float, delay_s: float, stack: ExitStack) -> None:
        super().__init__(flight, folder, rate)
        self.links = [stack.enter_context(TcpLink(port, delay_s)) for port in self._ports.values()]

    def far_ends(self) -> list[str]:
        return [f"tcp/127.0.0.1:{link.port}" for link in self.links]

    def silent(self, seconds: float) -> None:
        for link in self.links:
            link.silent(seconds)
        self._over(seconds)

    def closed(self, seconds: float) -> None:
        for link in self.links:
            link.closed(seconds)
        self._over(seconds)

    def _over(self, seconds: float) -> None:
        time.sleep(seconds)
        self.fault_ns = time.time_ns()


class PacketRig(RemoteRig):
    """Over a `PacketLink`, the replay in a network namespace of its own."""

    def __init__(self, flight: Path, folder: Path, rate: float, link: PacketLink) -> None:
        super().__init__(flight, folder, rate)
        self.prefix = link.prefix

    def far_ends(self) -> list[str]:
        return [f"tcp/{HERE}:{port}" for port in self._ports.values()]

    def listening(self, port: int) -> list[str]:
        return [f"tcp/127.0.0.1:{port}", f"tcp/{HERE}:{port}"]


def of_the_link() -> dict[str, tuple[float, Callable[[Any], None] | None]]:
    """Delay of the link, s, and what happens to it, by name."""
    return {
        "link of 500 ms": (0.5, None),
        "link silent for 3 s": (0.0, lambda rig: rig.silent(3.0)),
        "link silent for 10 s": (0.0, lambda rig: rig.silent(10.0)),
        "link closed for 3 s": (0.0, lambda rig: rig.closed(3.0)),
        "link of 500 ms closed for 3 s": (0.5, lambda rig: rig.closed(3.0)),
    }


def of_packets() -> dict[str, tuple[float, float, float]]:
    """Share of the packets that are lost, delay and spread of the delay, s, by name."""
    return {
        "1 % of packets lost": (0.01, 0.0, 0.0),
        "5 % of packets lost": (0.05, 0.0, 0.0),
        "packets overtake each other, up to 50 ms": (0.0, 0.0, 0.05),
        "0.2 % of packets lost at 500 ms": (0.002, 0.25, 0.0),
    }


def disk_full(flight: Path, folder: Path, rate: float) -> tuple[list[Path], list[str]] | None:
    """The recorder on a disk that is too small; None where none can be mounted."""
    disk = folder / "disk"
    disk.mkdir()
    size = f"size={max(1, flight.stat().st_size // 3)}"
    if subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], capture_output=True).returncode:
        return None
    try:
        rig = Rig(flight, folder, rate, disk / "live.mcap")
        paths = rig.fly(None)
        kept = [Path(shutil.copy(path, folder / f"kept_{path.name}")) for path in paths]
        return kept, rig.alarms
    finally:
        subprocess.run(["umount", "-l", str(disk)], capture_output=True)


class SlowDiskRig(Rig):
    """The recorder on a file system of its own, whose device takes so many bytes a second."""

    group_folder = Path("/sys/fs/cgroup/blkio/triline-slow-disk")

    def __init__(self, flight: Path, folder: Path, rate: float, bytes_s: float) -> None:
        self._disk, self._image = folder / "disk", folder / "disk.img"
        self._disk.mkdir()
        super().__init__(flight, folder, rate, self._disk / "live.mcap")
        self._bytes_s = bytes_s

    def mount(self) -> None:
        """Make the file system.

        Raises
        ------
        OSError, subprocess.CalledProcessError : not on this machine, or not for this user
        """
        with open(self._image, "wb") as image:
            image.truncate(1 << 30)
        for command in (
            ["mkfs.ext4", "-q", "-O", "^has_journal", str(self._image)],
            ["mount", "-o", "loop,sync", str(self._image), str(self._disk)],
        ):
            subprocess.run(command, check=True, capture_output=True)
        self.group_folder.mkdir(exist_ok=True)
        device = self._disk.stat().st_dev
        limit = f"{os.major(device)}:{os.minor(device)} {self._bytes_s:.0f}"
        (self.group_folder / "blkio.throttle.write_bps_device").write_text(limit)

    def start(self, name: str, id: str = "") -> None:
        super().start(name, id)
        if name == "recorder":
            (self.group_folder / "cgroup.procs").write_text(str(self.group.processes[name].process.pid))

    def close(self) -> None:
        subprocess.run(["umount", "-l", str(self._disk)], capture_output=True)
        with contextlib.suppress(OSError):
            self.group_folder.rmdir()


def slow_disk(flight: Path, folder: Path, rate: float, bytes_s: float) -> tuple[list[Path], list[str]] | None:
    """The recorder on a disk that is too slow; None where none can be made."""
    rig = SlowDiskRig(flight, folder, rate, bytes_s)
    try:
        try:
            rig.mount()
        except (OSError, subprocess.CalledProcessError):
            return None
        paths = rig.fly(None)
        return [Path(shutil.copy(path, folder / f"kept_{path.name}")) for path in paths], rig.alarms
    finally:
        rig.close()


def readable(paths: Iterable[Path], folder: Path) -> list[Path]:
    """Recordings as they are, or what `recover` saves of them."""
    out = []
    for path in paths:
        whole = folder / f"whole_{path.name}"
        done = subprocess.run([*frame.TRILINE, "recover", str(path), "-o", str(whole), "-q"], capture_output=True)
        out.append(whole if done.returncode == 0 and whole.exists() else path)
    return out


# ---- a long flight


class LongRig(Rig):
    """Looks every second at the memory and the open files of its nodes, and prints them at tenths of the flight."""

    def __init__(self, flight: Path, folder: Path, rate: float, seconds: float, grid_hz: float) -> None:
        super().__init__(flight, folder, rate)
        self.grid_hz = grid_hz
        self.patience_s = 600.0 + 3.0 * seconds / rate
        self.tenth_s = seconds / 10.0
        self.seen: list[tuple[float, dict[str, tuple[float, int]]]] = []  # s of flight; MB and files of each node

    def start(self, name: str, id: str = "") -> None:
        if name == "adjuster":
            self.group.start(name, "--set", f"grid_hz={self.grid_hz:g}", id=id)
        else:
            super().start(name, id)

    def watch(self) -> None:
        threading.Thread(target=self._look, daemon=True).start()

    def _look(self) -> None:
        nodes = {name: node.process for name, node in self.group.processes.items()}
        printed = 0
        while all(process.poll() is None for process in nodes.values()):
            with contextlib.suppress(OSError):  # one that ends just now
                now = {name: (frame.resident_mb(p.pid), _open_files(p.pid)) for name, p in nodes.items()}
                flown_s = (self.newest_ns - self.first_ns) * 1e-9
                self.seen.append((flown_s, now))
                if flown_s // self.tenth_s > printed:
                    printed = int(flown_s // self.tenth_s)
                    cells = "".join(f"{now[name][0]:>7.0f} MB {now[name][1]:>3d}" for name in NODES)
                    print(f"{flown_s:<12.0f}{cells}", flush=True)
            time.sleep(1.0)


def _open_files(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))
