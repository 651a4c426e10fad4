"""The Rerun viewer as a process of its own that listens on the loopback interface only and reports to nobody."""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from ..errors import UserError

LOOPBACK = "127.0.0.1"
_FIRST_PORTS = {"grpc": 9876, "web": 9090}
_START_TIMEOUT_S = 20.0
_CLOSED = (0, -signal.SIGTERM, -signal.SIGINT)
_KILLED = -9
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class ViewerProcess:
    """A native or web viewer, stopped with its whole process group.

    Parameters
    ----------
    web : serve the web viewer over HTTP instead of opening a window; a window stays open when we end, a server does not
    grpc_port, web_port : 0 takes the usual port, or a free one if that is in use

    Raises
    ------
    UserError : the viewer is not installed, there is no display for a window, or it does not come up
    """

    def __init__(self, web: bool, grpc_port: int = 0, web_port: int = 0) -> None:
        binary = viewer_binary()
        if not web and sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
            raise UserError(
                "no display for the native viewer; triline view: use --web or --rrd FILE, "
                "triline node viewer: --set mode=web or --set mode=rrd:FILE"
            )
        self._home = _private_folder()
        environment = {**os.environ, "XDG_CONFIG_HOME": str(self._home)}
        subprocess.run([binary, "analytics", "disable"], env=environment, capture_output=True, timeout=20, check=False)
        with _one_at_a_time(self._home):
            self.grpc_port = grpc_port or _free_port(_FIRST_PORTS["grpc"])
            self.web_port = (web_port or _free_port(_FIRST_PORTS["web"])) if web else 0
            self._start(binary, web, environment)

    def _start(self, binary: str, web: bool, environment: dict[str, str]) -> None:
        command = [binary, "--bind", LOOPBACK, "--port", str(self.grpc_port), "--hide-welcome-screen"]
        if web:
            command += ["--serve-web", "--web-viewer-port", str(self.web_port)]
        else:
            command += ["--expect-data-soon"]
        if web and sys.platform.startswith("linux") and shutil.which("setpriv"):  # gone with us, even if we are killed
            command = ["setpriv", "--pdeathsig", "TERM", *command]
        self._log = self._home / f"viewer-{self.grpc_port}.log"
        with open(self._log, "wb") as log:
            self.process = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        if web:
            atexit.register(self.close)
        self._wait([self.grpc_port] + ([self.web_port] if web else []))

    @property
    def grpc_url(self) -> str:
        return f"rerun+http://{LOOPBACK}:{self.grpc_port}/proxy"

    @property
    def web_url(self) -> str:
        """Address to open in a browser."""
        return f"http://{LOOPBACK}:{self.web_port}/?url=rerun%2Bhttp%3A%2F%2F{LOOPBACK}%3A{self.grpc_port}%2Fproxy"

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self) -> None:
        """Wait until the viewer is closed.

        Raises
        ------
        UserError : it ended because it could not go on
        """
        self.process.wait()
        self.refuse_failure()

    def refuse_failure(self) -> None:
        """Nothing while the viewer runs, or where a user has closed it.

        Raises
        ------
        UserError : it ended because it could not go on
        """
        if self.process.poll() not in (None, *_CLOSED):
            raise UserError(f"the viewer ended: {self._why()}; triline view: --web and --rrd FILE go without it")

    def _why(self) -> str:
        if self.process.returncode == _KILLED:  # its last line tells of something else
            return "it was killed, as by the system where memory runs out"
        return self._last_line()

    def _last_line(self) -> str:
        lines = self._log.read_text(errors="replace").strip().splitlines() if self._log.exists() else []
        return _COLOUR.sub("", lines[-1]) if lines else "it said nothing"

    def close(self) -> None:
        """Stop the viewer and all its children."""
        atexit.unregister(self.close)
        for number, patience in ((signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0)):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, number)
            try:
                self.process.wait(patience)
                break
            except subprocess.TimeoutExpired:
                continue
        self._log.unlink(missing_ok=True)

    def _wait(self, ports: list[int]) -> None:
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not all(_listening(port) for port in ports):
            if not self.running or time.monotonic() > deadline:
                said = self._last_line()
                self.close()
                raise UserError(f"the viewer did not come up: {said}")
            time.sleep(0.05)


def viewer_binary() -> str:
    """Path of the viewer that comes with the Rerun package: the program itself, not its Python wrapper.

    Raises
    ------
    UserError : it is not there
    """
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        binary = Path(folder) / ("rerun.exe" if sys.platform == "win32" else "rerun")
        if binary.exists():
            return str(binary)
    raise UserError("the Rerun viewer is not installed; python -m pip install rerun-sdk")


def _private_folder() -> Path:
    """Where the viewer finds its configuration, which says that it reports to nobody."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "triline" / "viewer"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="triline-viewer-"))


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Let one program after the other choose ports and listen there: two that start at once would choose the same ones,
    and draw into one viewer. The system lets go of it when a program ends."""
    with open(folder / "starting", "wb") as file:
        with contextlib.suppress(ImportError):  # a system without such locks
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _listening(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((LOOPBACK, port)) == 0


def _free_port(preferred: int) -> int:
    for port in (preferred, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, port))
            return probe.getsockname()[1]
    raise UserError("no free port for the viewer")
