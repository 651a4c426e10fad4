"""Inertial navigation: speed of filter and smoother, cost and latency on line, accuracy and consistency over seeds.

    python bench/navigation.py [--seeds 20]

The flights are simulated: 600 s at 200 Hz, survey lines and turns, turbulence; GNSS at 1 Hz with 2/2/4 cm. Tactical:
gyro bias 0.03 deg/h, 0.003 deg/sqrt(h), accelerometer bias 15 mGal; MEMS: 20 deg/h, 0.2 deg/sqrt(h), 2000 mGal.
Times are of one core (process time), the best of three.
"""

from __future__ import annotations

import sys
import time

import frame
import numpy as np

from triline.solver.geometry.frames import LocalFrame
from triline.solver.navigation.alignment import align
from triline.solver.navigation.carried import NavigationTrajectory
from triline.solver.navigation.error_state import NavigationSettings
from triline.solver.navigation.filter_pass import run_filter
from triline.solver.navigation.inertial_data import MEMS, TACTICAL
from triline.solver.navigation.inertial_navigator import InertialNavigator
from triline.solver.navigation.smoother import smooth
from triline.solver.simulation.inertial import gnss_fixes, survey_flight, with_errors

ARM = (0.5, 0.1, -1.2)
#: forward RMS after 120 s must not exceed: north, east, down in mm; roll, pitch, heading in deg
WANTED = ((10.0, 10.0, 17.0), (0.0006, 0.0005, 0.0010))


def flight(seed: int, grade, duration_s: float = 600.0, rate_hz: int = 200):
    rng = np.random.default_rng(seed)
    motion = survey_flight(duration_s, rng)
    time_s = np.arange(int((duration_s - 1.0) * rate_hz) + 1) / rate_hz + 0.5
    inertial, _ = with_errors(motion.increments(time_s), grade, rng)
    gnss = gnss_fixes(motion, np.arange(1.0, duration_s - 0.6) + 0.0037, (0.02, 0.02, 0.04), rng, ARM)
    return motion, inertial, gnss, NavigationSettings(grade, lever_arm_b=ARM)


def errors(trajectory: NavigationTrajectory, motion, t):
    states, true = trajectory.at(t), motion.at(t)
    position = np.einsum("nij,nj->ni", states.R_ne, states.r_e - true.position_e)
    turn = (states.angles - true.angles + np.pi) % (2 * np.pi) - np.pi
    return np.hstack([position, states.velocity_n - true.velocity_n, turn])


def speed() -> bool:
    _, inertial, gnss, settings = flight(1, TACTICAL)
    start = align(inertial, gnss, settings)
    best = [np.inf, np.inf, np.inf]
    for _ in range(3):
        t = [time.process_time()]
        align(inertial, gnss, settings)
        t.append(time.process_time())
        forward = run_filter(inertial, gnss, start, settings)
        t.append(time.process_time())
        smooth(forward)
        t.append(time.process_time())
        best = [min(b, d) for b, d in zip(best, np.diff(t), strict=True)]
    total = best[1] + best[2]
    print(f"recording, 600 s at 200 Hz: filter {best[1]:.2f} s, smoother {best[2]:.2f} s, alignment {best[0]:.2f} s")
    print(f"  filter and smoother {total:.2f} s (wanted below 2 s)")
    return total < 2.0


def online(duration_s: float) -> bool:
    _, inertial, gnss, settings = flight(3, TACTICAL, duration_s, 500)
    frame = LocalFrame(47.5, 9.2, 0.0)
    position = frame.from_geodetic(np.degrees(gnss.lat), np.degrees(gnss.lon), gnss.height_m)
    covariance = np.diag([0.02, 0.02, 0.04]) ** 2
    navigator = InertialNavigator(frame, settings)
    rows = list(zip(inertial.time_s.tolist(), inertial.dt_s.tolist(), inertial.dv, inertial.dtheta, strict=True))
    arrival = (gnss.time_s + 0.1).tolist()
    spent, latency, next_fix, due = 0.0, [], 0, None
    for t, dt, dv, dtheta in rows:
        while next_fix < len(arrival) and arrival[next_fix] <= t:
            began = _clocks()
            poses = navigator.add_gnss(float(gnss.time_s[next_fix]), position[next_fix], covariance)
            taken = _clocks() - began
            aligned = navigator.aligned and next_fix > 30
            if any(not p.smoothed for p in poses):
                latency += [taken] if aligned else []
                due = None
            else:
                due = taken if aligned else None
            next_fix += 1
        began = _clocks()
        poses = navigator.add_increments(t, dt, dv, dtheta)
        taken = _clocks() - began
        spent += taken[0]
        if due is not None and poses:
            latency.append(due + taken)
            due = None
    cost = spent / len(rows) * 1e6
    median, p99 = np.percentile(latency, [50, 99], axis=0) * 1e3
    print(f"on line, 500 Hz, poses at 50 Hz: {cost:.0f} us a sample (wanted below 100)")
    print(
        f"  from GNSS message to filtered pose, {len(latency)} fixes: median {median[0]:.2f} ms, 99th percentile "
        f"{p99[0]:.2f} ms (wanted below 5)"
    )
    print(f"  by the wall clock, beside whatever else runs: median {median[1]:.2f} ms, 99th percentile {p99[1]:.2f} ms")
    return bool(cost < 100.0 and p99[0] < 5.0)


def _clocks() -> np.ndarray:
    """Time of this process and of the wall clock, s."""
    return np.array([time.process_time(), time.perf_counter()])


def accuracy(grade, name: str, seeds: int, wanted=None) -> bool:
    square, ratio, nis = ([], []), ([], []), []
    for seed in range(seeds):
        motion, inertial, gnss, settings = flight(100 + seed, grade)
        forward = run_filter(inertial, gnss, align(inertial, gnss, settings), settings)
        both = NavigationTrajectory.filtered(forward), NavigationTrajectory.smoothed(forward, smooth(forward))
        t = np.arange(120.0, 599.0, 0.5) + 0.123
        for i, trajectory in enumerate(both):
            e = errors(trajectory, motion, t)
            square[i].append(np.mean(e**2, axis=0))
            ratio[i].append(np.mean((e / trajectory.sigmas(t)) ** 2, axis=0))
        nis.append(np.mean([x.nis for x in forward.innovations[20:]]) / 3.0)
    print(
        f"{name} grade, {seeds} seeds, after 120 s: RMS north, east, down, mm | roll, pitch, heading, deg | over sigma"
    )
    good, rms = True, []
    for i, what in enumerate(("forward ", "smoothed")):
        r, z = np.sqrt(np.mean(square[i], axis=0)), np.sqrt(np.mean(ratio[i], axis=0))
        rms.append(r)
        angles = np.degrees(r[6:])
        columns = (" ".join(f"{x * 1e3:5.1f}" for x in r[:3]), " ".join(f"{x:.5f}" for x in angles))
        print(f"  {what} {columns[0]} | {columns[1]} | {' '.join(f'{x:.2f}' for x in z)}")
        spread = 3.0 * 0.5 / np.sqrt(seeds)  # a slow error is one or two values a flight
        good &= bool((np.abs(z - 1.0) < spread).all())
    gain = rms[0] / rms[1]
    print(
        f"  smoothed better by {gain[0]:.1f}, {gain[1]:.1f}, {gain[2]:.1f} in position, {gain[8]:.1f} in heading;",
        end=" ",
    )
    print(f"squares of innovations over sigma {np.mean(nis):.3f}")
    if wanted is not None:
        good &= bool((rms[0][:3] * 1e3 <= wanted[0]).all() and (np.degrees(rms[0][6:]) <= wanted[1]).all())
        good &= bool((gain[:3] >= 1.5).all() and gain[8] >= 1.5)
    return good and bool(abs(np.mean(nis) - 1.0) < 0.1)


def outage() -> bool:
    motion, inertial, gnss, settings = flight(7, TACTICAL)
    lost = (gnss.time_s > 300.0) & (gnss.time_s < 360.0)
    kept = gnss[~lost]
    forward = run_filter(inertial, kept, align(inertial, kept, settings), settings)
    filtered, smoothed = NavigationTrajectory.filtered(forward), NavigationTrajectory.smoothed(forward, smooth(forward))
    t = np.array([359.9])
    drift, sigma = np.abs(errors(filtered, motion, t))[0, :3], filtered.sigmas(t)[0, :3]
    near = np.arange(355.0, 366.0, 0.02)
    jump = np.abs(np.diff(errors(smoothed, motion, near)[:, :3], axis=0)) / smoothed.sigmas(near)[1:, :3]
    worst = float(np.abs(errors(smoothed, motion, near)[:, :3] / smoothed.sigmas(near)[:, :3]).max())
    print(f"60 s without GNSS: drift {np.round(drift * 1e3)} mm, sigma {np.round(sigma * 1e3)} mm;", end=" ")
    print(f"smoothed: largest step {jump.max():.2f} sigma in 20 ms, largest error {worst:.1f} sigma")
    return bool((drift < 3.5 * sigma).all() and jump.max() < 3.0 and worst < 4.0)


def main() -> int:
    args = frame.parser(__doc__, seeds=20).parse_args()
    done = [
        speed(),
        online(300.0),
        outage(),
        accuracy(TACTICAL, "tactical", args.seeds, WANTED),
        accuracy(MEMS, "MEMS", args.seeds),
    ]
    print("all as wanted" if all(done) else "not all as wanted")
    return frame.verdict(all(done))


if __name__ == "__main__":
    sys.exit(main())
