"""Before NumPy is loaded: matrices are small and tests run side by side, so BLAS threads only get in the way."""

import gc
import os
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests start some two hundred programs. Where the environment forbids byte code (images of containers do), each of
# them would compile the package anew, and each worker of pytest-xdist would rewrite the assertions of all tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Modules and tests are some 360 000 objects that stay: the garbage collector need not look for them again and again.
gc.disable()


def pytest_collection_finish():
    gc.collect()
    gc.freeze()
    gc.enable()
