"""Before NumPy is loaded: matrices are small and tests run side by side, so BLAS threads only get in the way."""

import gc
import os
import random
import sys

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# glibc gives arrays of 128 kB and more back to the kernel as they go, which hands out zeroed pages for the next ones: a
# twentieth of all time. Workers of pytest-xdist and programs that tests start keep them.
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(32 << 20))
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(256 << 20))

# Tests start some two hundred programs. Where the environment forbids byte code (images of containers do), each of
# them would compile the package anew, and each worker of pytest-xdist would rewrite the assertions of all tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Modules and tests are some 360 000 objects that stay: the garbage collector need not look for them again and again.
gc.disable()

#: Tests that start programs and wait for them. They come first, so that one worker waits while the others compute, and
#: not all at the end for one flight.
WAITING = ("tests/test_demo.py", "tests/nodes/sensors/test_fly.py", "tests/test_users_day.py", "tests/nodes/bus/",
           "tests/test_bad_input.py", "tests/nodes/router/", "tests/nodes/recording/test_slow_disk.py",
           "tests/nodes/jobs/")  # fmt: skip


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector):
    """Each worker of pytest-xdist imports the tests in another order, so that in a fresh clone each file is compiled by
    one of them, and not by all at the same time."""
    report = (yield).get_result()
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and isinstance(collector, pytest.Session | pytest.Directory):
        random.Random(worker).shuffle(report.result)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    def place(item):
        return next((i for i, path in enumerate(WAITING) if item.nodeid.startswith(path)), len(WAITING))

    items.sort(key=lambda item: (place(item), item.path.parts))


def pytest_collection_finish():
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)  # with the default of 700 it takes a twentieth of all time
    gc.enable()
