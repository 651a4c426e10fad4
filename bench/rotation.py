"""What own code for rotations costs beside SciPy's Rotation (and NumPy's cross product), call by call: why it is kept.

    python bench/rotation.py

Microseconds a call (the fastest of several) for one rotation, four and a thousand, and the largest difference.
"""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from triline.solver.geometry import rotation as own
from triline.solver.navigation.strapdown import rotation_matrix

SIZES = ((), (4,), (1000,))
REPEATS = 15


def cases(shape: tuple[int, ...]) -> dict[str, tuple[Callable[[], Any], Callable[[], Any]]]:
    """Functions that are own code, by name, and what SciPy has for them, over the same rotations."""
    rng = np.random.default_rng(5)
    a = rng.uniform(-0.5, 0.5, (*shape, 3))
    o, p, k = np.moveaxis(a, -1, 0)
    q, R = (f(Rotation.from_euler("XYZ", a.reshape(-1, 3))) for f in (Rotation.as_quat, Rotation.as_matrix))
    q, R = q.reshape(*shape, 4), R.reshape(*shape, 3, 3)
    one = {
        "strapdown.rotation_matrix": (lambda: rotation_matrix(a), lambda: Rotation.from_rotvec(a).as_matrix()),
    }
    return (one if shape == () else {}) | {
        "matrix_from_angles": (
            lambda: own.matrix_from_angles(o, p, k),
            lambda: Rotation.from_euler("XYZ", np.stack([o, p, k], axis=-1)).as_matrix(),
        ),
        "angles_from_matrix": (
            lambda: own.angles_from_matrix(R),
            lambda: Rotation.from_matrix(R).as_euler("XYZ"),
        ),
        "matrix_from_navigation": (
            lambda: own.matrix_from_navigation(o, p, k),
            lambda: Rotation.from_euler("ZYX", np.stack([k, p, o], axis=-1)).as_matrix(),
        ),
        "navigation_from_matrix": (
            lambda: own.navigation_from_matrix(R),
            lambda: _navigation(Rotation.from_matrix(R).as_euler("ZYX")),
        ),
        "quaternion_multiply": (
            lambda: own.quaternion_multiply(q, q),
            lambda: (Rotation.from_quat(q) * Rotation.from_quat(q)).as_quat(),
        ),
        "quaternion_conjugate": (lambda: own.quaternion_conjugate(q), lambda: Rotation.from_quat(q).inv().as_quat()),
        "cross, beside NumPy's": (lambda: own.cross(a, q[..., :3]), lambda: np.cross(a, q[..., :3])),
        "vector_from_quaternion": (lambda: own.vector_from_quaternion(q), lambda: Rotation.from_quat(q).as_rotvec()),
    }


def _navigation(ypr: np.ndarray) -> np.ndarray:
    """Roll, pitch and heading from 0 to 2 pi."""
    rpy = ypr[..., ::-1].copy()
    rpy[..., 2] %= 2 * np.pi
    return rpy


def microseconds(call: Callable[[], Any]) -> float:
    """CPU time of a call, the fastest of several."""
    number = max(1, int(2e-3 / max(timeit.timeit(call, number=3) / 3, 1e-7)))
    return 1e6 * min(timeit.repeat(call, timer=time.process_time, number=number, repeat=REPEATS)) / number


def main() -> None:
    """Print the table."""
    sizes = [cases(shape) for shape in SIZES]
    print(" " * 26 + "".join(f"{'n = ' + str(shape[0] if shape else 1):>18}" for shape in SIZES))
    print(f"{'us a call':26}{'own    SciPy'.rjust(18) * len(SIZES)}{'difference':>14}")
    for name in sizes[0]:
        text, difference = f"{name:26}", 0.0
        for case in sizes:
            if name not in case:
                continue
            mine, scipys = case[name]
            text += f"{microseconds(mine):9.1f}{microseconds(scipys):9.1f}"
            difference = max(difference, float(np.abs(np.asarray(mine()) - scipys()).max()))
        print(f"{text:80}{difference:14.1e}")


if __name__ == "__main__":
    main()
