"""Before NumPy is loaded: matrices are small and tests run side by side, so BLAS threads only get in the way."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
