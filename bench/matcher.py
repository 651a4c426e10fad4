"""What the matcher costs of a core at 12 000 px x 3 CCD lines x 800 lines/s, and how it compares with OpenCV.

    python bench/matcher.py [--points 30] [--seeds 3]

1. The recording of `matcher_live.py` goes through navigator and matcher in this process: rays a second, core time of
   the matcher a second of flight, and the latency as platform time plus the core time of the step, whatever else the
   machine does.
2. The same places are measured in the same rectified images (the forward view against the nadir view) by triline, by
   OpenCV's pyramid Lucas-Kanade and by ORB matches near them, against truth.
"""

from __future__ import annotations

import json
import time

import cv2
import frame
import numpy as np
from matcher_live import RECORDING, render

from triline.nodes.matcher.matcher import Matcher
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.node import Message
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.step_driver import StepDriver
from triline.solver.matching.interest_points import interest_point
from triline.solver.matching.line_scan import LineScan, view_of
from triline.solver.matching.line_store import LineRing
from triline.solver.matching.looks import verdict
from triline.solver.matching.options import MatchingOptions
from triline.solver.matching.search import Ground, Image, find
from triline.solver.matching.tie_matcher import TieMatcher


def rate(points_per_s: float, budget_mb: float) -> dict:
    """The recording through navigator and matcher."""
    reader = RecordingReader(RECORDING)
    topics = {c.topic for c in reader.channels.values() if c.topic.startswith(("configuration", "sensor"))}
    navigator = StepDriver(Navigator())
    node = Matcher(points_per_s=points_per_s, budget_mb=budget_mb, delay_s=0.0)
    matcher = StepDriver(node)
    cpu, ties, steps = 0.0, [], []

    def give(message: Message) -> None:
        nonlocal cpu
        used = time.process_time()
        out = matcher.step(message)
        used = time.process_time() - used
        cpu += used
        steps.append((message.stamp_ns, used))
        for tie in out:
            if tie.topic == "observation/tie":
                last = max(image.time_ns for image in tie.body.images)
                ties.append((tie.stamp_ns, len(tie.body.images), (tie.stamp_ns - last) * 1e-9 + used))

    for message in reader.messages(sorted(topics)):
        if message.topic.startswith("sensor/lines/"):
            give(message)
            continue
        for pose in navigator.step(message):
            if pose.topic in Matcher.inputs:
                give(pose)
        if message.topic.startswith("configuration/"):
            give(message)
    stamp, rays, latency = np.array(ties, dtype=float).T
    # the first second of ties waits for enough of them to be judged together
    steady = stamp > stamp[0] + 1e9
    seconds = (stamp[-1] - stamp[steady][0]) * 1e-9
    step_s, used = np.array(steps, dtype=float).T
    busy = (step_s >= stamp[0]) & (step_s <= stamp[-1])
    assert isinstance(node._matcher, TieMatcher)
    store = node._matcher.store
    assert store is not None
    return {
        "points_per_s": points_per_s, "rays_per_s": float(rays[steady].sum() / seconds), "seconds": float(seconds),
        "cores": float(used[busy].sum() / ((stamp[-1] - stamp[0]) * 1e-9)),
        "latency_p50_s": float(np.quantile(latency[steady], 0.5)),
        "latency_p95_s": float(np.quantile(latency[steady], 0.95)),
        "store_mb": store.nbytes / 1e6, "cover": store.cover, "counters": dict(node.counters),
    }  # fmt: skip


# ---- beside OpenCV


def views(seed: int) -> dict:
    """Nadir and forward view of a flight, with their true geometry."""
    flight = (flown := simulated_flight({"sensor": "ads40-small", "pixels": 1600, "images": True, "seconds": 45.0,
                                         "seed": seed})).simulation.flight  # fmt: skip
    assert flown.imager is not None
    strip, camera = flight.strips[0], flight.camera
    middle = strip.lines // 2
    scans, rings = [], []
    for ccd in (1, 0):
        ring = LineRing(camera.lines[ccd].pixels, strip.lines)
        ring.add(0, flown.imager.render(0, ccd, 0, strip.lines))
        poses = flight.truth.at(strip.time_of(np.arange(strip.lines)))
        scans.append(LineScan(view_of(camera, ccd), 0, poses.position_l, poses.R_lc))
        rings.append(ring)
    return {"flight": flight, "scans": scans, "rings": rings, "middle": middle}


def compare(seeds: list[int]) -> dict[str, dict]:
    """Accuracy and time of three ways, over some flights."""
    rows: dict[str, list] = {"triline": [], "Lucas-Kanade": [], "ORB": []}
    spent = dict.fromkeys(rows, 0.0)
    for seed in seeds:
        _compare_one(views(seed), rows, spent)
    out = {}
    for name, parts in rows.items():
        error = np.concatenate(parts) if parts else np.empty(0)
        found = np.isfinite(error)
        e = error[found]
        out[name] = {
            "places": len(error), "found": float(found.mean()), "within_03_px": float((e < 0.3).mean()),
            "median_px": float(np.median(e)), "wrong_2_px": float((e > 2).mean()),
            "ms_a_place": 1e3 * spent[name] / max(len(error), 1),
        }  # fmt: skip
    return out


def _compare_one(data: dict, rows: dict[str, list], spent: dict[str, float]) -> None:
    flight, (master, other), (ring, other_ring) = data["flight"], data["scans"], data["rings"]
    terrain = flight.terrain
    middle, pixels = data["middle"], master.view.pixels
    travel = float(np.linalg.norm(master.position_l[middle + 1] - master.position_l[middle]))
    lines = np.arange(middle - 60, middle + 61)
    # places: the best of every cell
    place = []
    for first in range(lines[0], lines[-1], 24):
        for left in range(200, pixels - 248, 48):
            piece = ring.read(first - 12, first + 36, left - 12, left + 60)
            best = interest_point(piece.pixels.astype(np.float32), piece.usable, 19, 0.1)
            if best:
                place.append((first - 12 + best[0], left - 12 + best[1]))
    line, sample = np.array(place, dtype=float).T
    flat = np.zeros(len(line))
    centre, _ = master.to_plane(line, sample, flat)
    position, R = master.position_l[line.astype(int)], master.R_lc[line.astype(int)]
    direction = np.einsum("nij,nj->ni", R, master.view.rays_c(sample))
    true_point = terrain.intersect(position, direction)
    way = master.position_l[-1, :2] - master.position_l[0, :2]
    along = way / np.linalg.norm(way)
    across = np.array([-along[1], along[0]])
    across = across if master.view.sample[0] < master.view.sample[-1] else -across
    spacing = float(np.linalg.norm(np.diff(centre[:2, :2], axis=0))) or 1.0
    depth = float(np.median(position[:, 2]))
    spacing = depth * master.view.pitch_mm / master.view.focal_length_mm
    ground = Ground(centre, along, across, spacing)
    # where the other view really shows each place, on the plane of the grid
    u, v, ok = other.locate(true_point, line + (master.view.forward - other.view.forward) * depth / travel, rounds=8)
    seen = _on_plane(other, u, v)
    true_shift = ((seen - centre[:, :2]) @ np.stack([along, across]).T) / spacing
    keep = ok & np.isfinite(true_shift).all(axis=1)
    line, sample, true_shift = line[keep], sample[keep], true_shift[keep]
    ground, u = ground.select(keep), u[keep]

    # one rectified image of each view over all places, for OpenCV
    local = ((ground.centre_l[:, :2] - ground.centre_l[:, :2].mean(axis=0)) @ np.stack([along, across]).T) / spacing
    n = int(np.abs(local).max()) + 60
    big = Ground(ground.centre_l.mean(axis=0)[None], along, across, spacing)
    begin = time.process_time()
    a = Image(master, ring, travel).patches(big, np.array([line.mean()]), n, 1).values[0]
    b = Image(other, other_ring, travel).patches(big, np.array([u.mean()]), n, 1).values[0]
    warp = time.process_time() - begin
    b = (b - b.mean()) * (a.std() / b.std()) + a.mean()  # Lucas-Kanade takes light for the same
    scale = 255.0 / np.quantile(a, 0.999)
    a8, b8 = (np.clip(x * scale, 0, 255).astype(np.uint8) for x in (a, b))
    at = (local + n)[:, ::-1].astype(np.float32)

    begin = time.process_time()
    guess = np.median(true_shift, axis=0)[None].repeat(len(line), axis=0)  # the same knowledge for all
    found = find(Image(master, ring, travel), line, ground, Image(other, other_ring, travel), guess, u, 40.0)
    good = verdict(found, MatchingOptions()) == ""
    spent["triline"] += time.process_time() - begin
    rows["triline"].append(np.where(good, np.hypot(*(found.shift - true_shift).T), np.nan))

    begin = time.process_time()
    options = {"winSize": (21, 21), "maxLevel": 4, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start = (at + guess[:, ::-1]).astype(np.float32)
    there, status, _ = cv2.calcOpticalFlowPyrLK(a8, b8, at, start.copy(), **options)
    back, status2, _ = cv2.calcOpticalFlowPyrLK(b8, a8, there, at.copy(), **options)
    closed = np.hypot(*(back - at).T) < 0.3
    good = (status[:, 0] > 0) & (status2[:, 0] > 0) & closed
    spent["Lucas-Kanade"] += time.process_time() - begin + warp
    rows["Lucas-Kanade"].append(np.where(good, np.hypot(*((there - at)[:, ::-1] - true_shift).T), np.nan))

    begin = time.process_time()
    orb = cv2.ORB.create(8000)
    keys_a, d_a = orb.detectAndCompute(a8, None)
    keys_b, d_b = orb.detectAndCompute(b8, None)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(d_a, d_b)
    spent["ORB"] += time.process_time() - begin + warp
    p = np.array([keys_a[m.queryIdx].pt for m in pairs])
    q = np.array([keys_b[m.trainIdx].pt for m in pairs])
    # each place is served by the nearest ORB match within 10 px, whose shift it would share
    distance = np.hypot(*(p[None] - at[:, None]).transpose(2, 0, 1))
    nearest = distance.argmin(axis=1)
    shift = (q - p)[nearest][:, ::-1]
    error = np.hypot(*(shift - true_shift).T)
    rows["ORB"].append(np.where(distance.min(axis=1) < 10, error, np.nan))


def _on_plane(scan: LineScan, line: np.ndarray, sample: np.ndarray) -> np.ndarray:
    return scan.to_plane(line, sample, np.zeros(len(line)))[0][:, :2]


def main() -> None:
    parser = frame.parser(__doc__, seeds=3, as_json=True)
    parser.add_argument("--points", type=float, default=30.0, help="tie points a second that are wanted (30)")
    parser.add_argument("--budget-mb", type=float, default=1024.0, help="for image lines (1024)")
    args = parser.parse_args()
    beside = compare(list(range(1, args.seeds + 1)))
    render()
    full = rate(args.points, args.budget_mb)
    if args.json:
        print(json.dumps({"rate": full, "beside": beside}, indent=2))
    else:
        print(f"12 000 px x 3 x 800 lines/s, {full['points_per_s']:g} tie points a second wanted")
        print(f"  {full['rays_per_s']:.0f} rays/s over {full['seconds']:.0f} s, {full['cores']:.2f} of a core")
        print(f"  last look to tie: median {full['latency_p50_s']:.3f} s, 95 % below {full['latency_p95_s']:.3f} s")
        print(f"  line store {full['store_mb']:.0f} MB, {100 * full['cover']:.0f} % of the width")
        print("forward against nadir view:  places  found  within 0.3 px  median  over 2 px  core time a place")
        for name, r in beside.items():
            print(
                f"  {name:<26} {r['places']:6d} {100 * r['found']:5.0f} % {100 * r['within_03_px']:12.1f} %"
                f" {r['median_px']:5.3f} px {100 * r['wrong_2_px']:7.1f} % {r['ms_a_place']:8.2f} ms"
            )


if __name__ == "__main__":
    main()
