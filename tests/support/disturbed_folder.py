"""A block folder of an independent program whose trajectory is disturbed, and how far points are from truth then."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from places import BLOCKS
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
POSITION, ANGLES = ("X_m", "Y_m", "Z_m"), ("omega_deg", "phi_deg", "kappa_deg")
SIGMAS = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
#: Changes positions (n, 3), m, and angles (n, 3), deg, of one strip at times (n,); its name; returns both.
Disturbance = Callable[[Array, Array, Array, str, np.random.Generator], tuple[Array, Array]]


def _step(t: Array, X: Array, angles: Array, strip: str, rng: np.random.Generator) -> tuple[Array, Array]:
    at, sign, share = rng.choice(["S1", "S2", "C1"]), rng.choice([-1.0, 1.0], 3), rng.uniform(0.25, 0.75)
    later = (t > t[0] + share * (t[-1] - t[0])) & (strip == at)
    return X + 0.3 * sign * later[:, None], angles


def _sine(amplitude_deg: float, frequency_hz: float) -> Disturbance:
    def disturb(t: Array, X: Array, angles: Array, strip: str, rng: np.random.Generator) -> tuple[Array, Array]:
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        return X, angles + amplitude_deg * np.sin(2.0 * np.pi * frequency_hz * (t - t[0])[:, None] + phase)

    return disturb


def _clock(t: Array, X: Array, angles: Array, strip: str, rng: np.random.Generator) -> tuple[Array, Array]:
    before = t - 0.005
    unwrapped = np.unwrap(angles, axis=0, period=360.0)
    moved = [np.column_stack([np.interp(before, t, v) for v in values.T]) for values in (X, unwrapped)]
    return moved[0], moved[1]


def _lever_arm(t: Array, X: Array, angles: Array, strip: str, rng: np.random.Generator) -> tuple[Array, Array]:
    return X + Rotation.from_euler("XYZ", angles, degrees=True).apply([0.2, 0.2, 0.2]), angles


def _boresight(t: Array, X: Array, angles: Array, strip: str, rng: np.random.Generator) -> tuple[Array, Array]:
    turned = Rotation.from_euler("XYZ", angles, degrees=True) * Rotation.from_euler("XYZ", [0.05] * 3, degrees=True)
    return X, turned.as_euler("XYZ", degrees=True)


DISTURBANCES: dict[str, Disturbance] = {
    "nothing": lambda t, X, angles, strip, rng: (X, angles),
    "GNSS step 0.3 m": _step,
    "attitude 0.02 deg, 0.1 Hz": _sine(0.02, 0.1),
    "attitude 0.01 deg, 3 Hz": _sine(0.01, 3.0),
    "clock 5 ms": _clock,
    "lever arm 0.2 m": _lever_arm,
    "boresight 0.05 deg": _boresight,
    "GNSS datum + 0.5 m": lambda t, X, angles, strip, rng: (X + 0.5, angles),
}


def disturbed(name: str, seed: int, folder: Path, source: Path = BLOCKS / "dgr") -> Path:
    """Copy of a block folder with another trajectory.csv."""
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    table = folder / "trajectory.csv"
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    strips = np.array([row["strip"] for row in rows])
    t = np.array([float(row["time_s"]) for row in rows])
    X, angles = (np.array([[float(row[key]) for key in keys] for row in rows]) for keys in (POSITION, ANGLES))
    for strip in dict.fromkeys(strips.tolist()):
        mine = strips == strip
        X[mine], angles[mine] = DISTURBANCES[name](t[mine], X[mine], angles[mine], strip, np.random.default_rng(seed))
    for row, values in zip(rows, np.hstack([X, angles]), strict=True):
        row.update(zip((*POSITION, *ANGLES), (f"{v:.9f}" for v in values), strict=True))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder


def errors_of(points: Path, folder: Path) -> tuple[float, float]:
    """3D RMSE, m, and mean normalised error squared of the points in a table that are no control."""
    truth = json.loads((folder / "truth.json").read_text())["points"]
    with (folder / "ground_points.csv").open(newline="") as file:
        control = {row["point"] for row in csv.DictReader(file) if row["role"] == "control"}
    error, normalised = [], []
    with points.open(newline="") as file:
        for row in csv.DictReader(file):
            if row["point"] in truth and row["point"] not in control:
                d = np.array([float(row[key]) for key in POSITION]) - truth[row["point"]]
                error.append(d)
                normalised.append(d / [float(row[key]) for key in SIGMAS])
    assert len(error) > 50
    return float(np.sqrt(np.mean(np.sum(np.square(error), axis=1)))), float(np.mean(np.square(normalised)))
