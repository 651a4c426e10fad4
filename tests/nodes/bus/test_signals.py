"""Programs end when they are asked to, whatever they are doing at that moment."""

import subprocess
import sys
import time

import pytest

ASKED_WHILE_IT_HOLDS_THE_LOCK = """
import os, signal, threading, time
from triline.nodes.bus.program import end_by_signal, stop_on_signals

stop = threading.Event()
{install}
with stop._cond:  # as inside stop.wait(), between two steps of it
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)
assert stop.wait(60)
print("ended")
"""

TERMINAL_IS_CLOSED = """
import os, signal, threading
from triline.nodes.bus.program import stop_on_signals
from triline.nodes.cli.live_flight import _interruptible

signal.signal(signal.SIGHUP, signal.{before})
stop = threading.Event()
{install}
    os.kill(os.getpid(), signal.SIGHUP)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        assert stop.wait(60)
    print("ends" if stop.is_set() else "goes on")
"""

WAITS_OFTEN = """
import signal, threading
from triline.nodes.bus.program import stop_on_signals

stop = threading.Event()
stop_on_signals(stop)
print("ready", flush=True)
while not stop.is_set():
    stop.wait(1e-6)
"""


@pytest.mark.parametrize(
    "install", ["stop_on_signals(stop)", "signal.signal(signal.SIGINT, end_by_signal(stop))"], ids=["node", "flight"]
)
def test_a_signal_that_comes_while_the_program_waits_for_it(install):
    code = ASKED_WHILE_IT_HOLDS_THE_LOCK.format(install=install)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "ended\n"), done.stderr


@pytest.mark.parametrize(
    "install", ["if not stop_on_signals(stop):", "with _interruptible(stop):"], ids=["node", "flight"]
)
@pytest.mark.parametrize("before, then", [("SIG_DFL", "ends"), ("SIG_IGN", "goes on")], ids=["alone", "nohup"])
def test_a_closed_terminal_asks_for_a_clean_end_unless_that_is_ignored(install, before, then):
    """A recorder left a file without an end; a flight under nohup ended with its terminal."""
    code = TERMINAL_IS_CLOSED.format(install=install, before=before)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, f"{then}\n"), done.stderr


def test_the_third_signal_ends_at_once():
    code = WAITS_OFTEN.replace("while not stop.is_set()", "while True")
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None and program.stdout.readline() == "ready\n"
        for _ in range(3):
            program.terminate()
            time.sleep(0.3)  # two that come together are one
        while program.poll() is None:
            time.sleep(5.0)
            program.terminate()
        assert program.returncode == 1
