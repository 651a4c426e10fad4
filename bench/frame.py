"""What the programs of this folder share: command line, flights over seeds, bands, printing, the exit code.

It is imported before NumPy, because it keeps BLAS to one thread: the matrices are small, and the work is shared out to
processes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import ArrayLike

T = TypeVar("T")

#: The `triline` command of this environment.
TRILINE = [sys.executable, "-m", "triline.nodes.cli"]
#: Exit code of a program that ran to its end and found that a figure is not as wanted; 1 is a failure of the program.
NOT_MET = 3


def parser(
    text: str | None, *, seeds: int | None = None, processes: bool = False, as_json: bool = False
) -> argparse.ArgumentParser:
    """Command line of a program.

    Parameters
    ----------
    text : the program's docstring, which ``--help`` shows
    seeds : default of ``--seeds``; None has no such option
    processes, as_json : whether ``--processes`` (default: one a core) and ``--json`` exist
    """
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if seeds is not None:
        made.add_argument("--seeds", type=int, default=seeds, help=f"simulated flights ({seeds})")
    if processes:
        made.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="at a time (one a core)")
    if as_json:
        made.add_argument("--json", action="store_true", help="print JSON")
    return made


def over_seeds(work: Callable[[int], T], seeds: int, first: int = 1, processes: int | None = None) -> Iterator[T]:
    """What ``work`` returns for each seed, in order, computed by one process a core unless told otherwise."""
    with ProcessPoolExecutor(processes or os.cpu_count()) as pool:
        yield from pool.map(work, range(first, first + seeds))


def mean_and_band(values: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Mean over flights (first axis), and the half width of its 95 % band from their scatter."""
    rows = np.asarray(values, dtype=float)
    return rows.mean(axis=0), 1.96 * rows.std(axis=0, ddof=1) / np.sqrt(len(rows))


def banded(mean: float | np.ndarray, half_width: float | np.ndarray) -> str:
    """A mean that should be 1, with its band, and whether 1 lies in it."""
    return f"{mean:.3f} +- {half_width:.3f}  {'in the band' if abs(mean - 1.0) <= half_width else 'outside'}"


def show(figures: Mapping[str, Any], as_json: bool = False) -> None:
    """Print named figures, one a line, or as JSON."""
    if as_json:
        print(json.dumps(figures, indent=2, default=_plain))
        return
    width = max(map(len, figures))
    for name, value in figures.items():
        values = value if isinstance(value, list | tuple | np.ndarray) else [value]
        print(f"{name:{width}}  {', '.join(map(_short, values))}", flush=True)


def triline(*words: str) -> str:
    """What a `triline` command prints; the program ends with its message where it fails."""
    done = subprocess.run([*TRILINE, *words], capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr.strip())
    return done.stdout


def resident_mb(pid: int | str = "self") -> float:
    """Resident memory of a process, of this one if none is named, without mapped files, MB."""
    with open(f"/proc/{pid}/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("RssAnon")) / 1024.0


def verdict(good: bool) -> int:
    """Exit code of a program that says whether its figures are as wanted."""
    return 0 if good else NOT_MET


def _short(value: Any) -> str:
    if not isinstance(value, float | np.floating):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else round(float(value), 4)
