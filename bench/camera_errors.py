"""A camera that is not as calibrated: what becomes of a strip with what is known of the camera.

    python bench/camera_errors.py [--seeds 3] [--shares 0 0.01 0.1 0.3] [--vibrating 16]

Lens and CCD lines are off by draws from the sigmas of TLS-12 times a share (1 = 0.1 mm at the edge for each parameter),
which nobody states. Compared are 3D RMSE of object points by direct georeferencing and of the whole strip by the window
with its camera held (`none`), with the focal length alone, and with what a calibration leaves open, which is
questioned; NEES of orientation and points, and how many lights are good at the end. At last: in how many strips whose
camera is as calibrated a vibration of the attitude (0.01 deg, 3 Hz), which nobody states, is taken for the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import frame
import numpy as np

from triline.solver.camera.displacement import displacements
from triline.solver.camera.line_camera import LineCamera
from triline.solver.camera.self_calibration import SelfCalibration, focal_length, left_by_calibration, tls
from triline.solver.models.platform import PlatformErrors
from triline.solver.simulation.camera_errors import drawn_parameters, simulate_with_camera_errors
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.misspecified_study import OBSERVED, ROWS, SETTINGS
from triline.solver.simulation.scenario import Simulation, simulate
from triline.solver.simulation.window_study import (
    OnlineResult,
    TimedPose,
    adjust_online,
    direct_points,
    navigate,
    orientation_errors,
    point_errors,
)
from triline.solver.window.quality.light import GOOD
from triline.solver.window.results import WindowOptions

PLAN = FlightPlan(strip_s=60.0)
CLOCK_SIGMA_S, UPDATE_S = 1e-3, 0.5
KNOWN = {"none": lambda camera: None, "focal": focal_length, "calibrated": left_by_calibration}


def rmse(error: np.ndarray) -> float:
    """3D, of errors (n, 3)."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def largest_px(camera: LineCamera, parameters: SelfCalibration, values: np.ndarray) -> float:
    """By how much a look is off at most."""
    sizes = []
    for i, line in enumerate(camera.lines):
        sample = np.linspace(0.0, line.pixels - 1.0, 41)
        ccd = np.full(len(sample), i)
        xy_mm, pitch = camera.image_coordinates(ccd, sample)
        moved = displacements(parameters, ccd, sample, xy_mm, camera.focal_length_mm[ccd]) @ values
        sizes.append(float((np.hypot(*moved) / np.linalg.norm(pitch, axis=1)).max()))
    return max(sizes)


def blamed(seed: int, setting: str) -> bool:
    """Whether a vibration is taken for the camera."""
    flown = simulate(PLAN, seed, SETTINGS[setting], OBSERVED, world=ROWS["sine-fast"].world)
    window = estimated(flown, navigate(flown), left_by_calibration(PLAN.camera)).window
    assert window is not None
    return window.network.calibration.factor > 1.0


def estimated(flown: Simulation, poses: Sequence[TimedPose], camera: SelfCalibration | None) -> OnlineResult:
    """The window over a flight, with what is known of the camera."""
    platform = PlatformErrors(CLOCK_SIGMA_S)
    return adjust_online(
        flown, poses, WindowOptions(grid_hz=4.0), camera, live=False, update_s=UPDATE_S, platform=platform
    )


def main() -> None:
    parser = frame.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--shares", type=float, nargs="*", default=[0.0, 0.003, 0.01, 0.1, 0.3])
    parser.add_argument("--vibrating", type=int, default=16)
    args = parser.parse_args()
    print("3D RMSE of points, m, worst flight in brackets; NEES of orientation / points; lights that are good")
    print(("share  off, px  stated  direct   " + "".join(f"{name:38s}" for name in KNOWN)).rstrip())
    for share in args.shares:
        stated = tls(PLAN.camera, 12).scaled(share or 1.0)
        drawn = [share and largest_px(PLAN.camera, stated, drawn_parameters(s + 1, stated)) for s in range(args.seeds)]
        for setting, errors in SETTINGS.items():
            direct, found = [], {name: [] for name in KNOWN}
            for seed in range(1, args.seeds + 1):
                if share:
                    flown = simulate_with_camera_errors(PLAN, seed, stated, errors, OBSERVED)
                else:
                    flown = simulate(PLAN, seed, errors, OBSERVED)
                poses = list(navigate(flown))
                direct.append(rmse(direct_points(flown, poses).error))
                for name, known in KNOWN.items():
                    online = estimated(flown, poses, known(PLAN.camera))
                    points = point_errors(flown, online.whole_points)
                    orientation = orientation_errors(flown, online.whole)
                    good = online.reports[-1].quality.light == GOOD
                    found[name].append((rmse(points.error), orientation.nees.mean(), points.nees.mean(), good))
            cells = []
            for rows in found.values():
                size, of_orientation, of_points, good = np.array(rows, dtype=float).T
                nees = f"{of_orientation.mean():6.2f} /{of_points.mean():6.2f}"
                cells.append(f"{rmse(size[:, None]):6.3f} ({size.max():6.3f}) {nees} {good.sum():2.0f}/{len(good)}    ")
            root = rmse(np.array(direct)[:, None])
            print(f"{share:5.3f} {max(drawn):8.1f}  {setting:6s} {root:6.2f}  {''.join(cells)}".rstrip(), flush=True)
    for setting in SETTINGS if args.vibrating else ():
        number = sum(blamed(seed, setting) for seed in range(1, args.vibrating + 1))
        print(f"a vibration is taken for the camera in {number} of {args.vibrating} strips, {setting}", flush=True)


if __name__ == "__main__":
    main()
