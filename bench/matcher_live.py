"""The matcher on the bus at full rate, on two cores: player, navigator, matcher and adjuster as processes of their own.

    python bench/matcher_live.py [--points 45] [--cores 2] [--json]

A flight of 20 s with 12 000 px x 3 CCD lines x 800 lines/s is rendered once (out/bench/full_rate.mcap, 1.2 GB) and
replayed at its pace. All processes share the cores, the player and this listener
included. The latency of a tie is wall time: from the moment its last look is imaged to its reception here; the moment
is told by the quickest message of the 200 Hz attitude sensor. What was lost or late is what the nodes' own counters say
while ties come.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame
import numpy as np
import psutil

from triline.nodes.bus.processes import ALLOCATOR, NodeGroup
from triline.nodes.bus.session import Bus
from triline.schemas import codec
from triline.schemas.envelope import RawMessage

#: The flight at full rate.
RECORDING = Path("out/bench/full_rate.mcap")
SETTINGS = {"sensor": "ads40", "height": 1500.0, "speed": 124.4, "images": True, "seconds": 20.0, "lead_in": 2.0}
SEED = 4
#: Ties of the first seconds wait for enough of them to be judged together.
SETTLE_S = 1.0


def render() -> None:
    """Write `RECORDING`, unless it is there."""
    if RECORDING.exists():
        return
    RECORDING.parent.mkdir(parents=True, exist_ok=True)
    arguments = [
        x for k, v in SETTINGS.items() for x in ([f"--{k.replace('_', '-')}"] + ([] if v is True else [str(v)]))
    ]
    frame.triline("simulate", "-q", "-o", str(RECORDING), "--seed", str(SEED), *arguments)


class Ears:
    """What arrives, with the time of its reception."""

    def __init__(self, bus: Bus) -> None:
        self.ahead_ns = 1 << 62  # reception minus stamp of the quickest sensor message
        self.ties: list[tuple[int, int, int, int]] = []  # reception, last look, stamp, rays
        self.poses: list[tuple[int, int]] = []  # reception and stamp of the filtered trajectory
        self.status: dict[str, dict] = {}
        self.lags: dict[str, float] = {}
        self.paces: dict[str, int] = {}  # highest level
        bus.subscribe("sensor/attitude", self._sensor)
        bus.subscribe("observation/tie", self._tie)
        bus.subscribe("trajectory/filtered", self._pose)
        bus.subscribe("adjustment/pace", self._paced)
        bus.subscribe("matching/pace", self._paced)
        bus.subscribe("status/*", self._told)

    def _sensor(self, raw: RawMessage) -> None:
        self.ahead_ns = min(self.ahead_ns, raw.receive_ns - raw.envelope.stamp_ns)

    def _tie(self, raw: RawMessage) -> None:
        body = codec.decode(raw.topic, raw.data)
        if len(body.images) > 1:  # a target is observed look by look
            last = max(image.time_ns for image in body.images)
            self.ties.append((raw.receive_ns, last, raw.envelope.stamp_ns, len(body.images)))

    def _pose(self, raw: RawMessage) -> None:
        self.poses.append((raw.receive_ns, raw.envelope.stamp_ns))

    def _paced(self, raw: RawMessage) -> None:
        level = codec.decode(raw.topic, raw.data).level
        self.paces[raw.topic] = max(self.paces.get(raw.topic, 0), level)

    def _told(self, raw: RawMessage) -> None:
        body = codec.decode(raw.topic, raw.data)
        self.lags[body.node] = max(self.lags.get(body.node, 0.0), body.lag_s)
        self.status[body.node] = {
            "state": body.state, "lag_s": body.lag_s, "queued": body.queued, "last_problem": body.last_problem,
            "topics": {t.topic: {k: getattr(t, k) for k in ("received", "gaps", "late", "malformed", "dropped")}
                       for t in body.topics},
            "counters": {c.name: c.value for c in body.counters},
        }  # fmt: skip

    def bad(self) -> dict[str, int]:
        """What the nodes counted as lost, late or malformed."""
        return {
            f"{node} {topic} {kind}": n
            for node, told in self.status.items()
            for topic, counts in told["topics"].items()
            for kind, n in counts.items()
            if kind != "received" and n
        }


def live(recording: Path, points_per_s: float, budget_mb: float, cores: int, port: int) -> dict:
    """Replay a recording to the nodes; rates, latencies, losses."""
    available = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, available[-cores:])  # children inherit it
    environment = {**os.environ, **ALLOCATOR}
    with (
        tempfile.TemporaryDirectory(prefix="triline-bench-") as name,
        NodeGroup(Path(name), "bench", port) as group,
        Bus("bench", source="bench", port=port) as bus,
    ):
        ears = Ears(bus)
        nodes = [
            group.start("navigator"),
            group.start("matcher", "--set", f"points_per_s={points_per_s}", "--set", f"budget_mb={budget_mb}"),
            group.start("adjuster"),
        ]
        while not bus.alive() >= {"navigator", "matcher", "adjuster"}:
            time.sleep(0.1)
        time.sleep(1.0)
        command = [*frame.TRILINE, "replay", str(recording), "-q", *group.arguments]
        player = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
        watched = {n.name: psutil.Process(n.process.pid) for n in nodes} | {"player": psutil.Process(player.pid)}
        used, before = _watch(player, watched, ears)
        bad = {name: n - before.get(name, 0) for name, n in ears.bad().items() if n > before.get(name, 0)}
        time.sleep(2.5)
        result = {**_result(ears, used), "bad": bad, "bad_before_ties": before, "bad_in_all": ears.bad()}
    os.sched_setaffinity(0, available)
    return {"points_per_s": points_per_s, "cores_given": cores, **result}


def _watch(
    player: subprocess.Popen, watched: dict, ears: Ears
) -> tuple[dict[str, list[tuple[float, float]]], dict[str, int]]:
    """Time and core time of the processes, twice a second, while ties come; and what had been lost or late before."""
    used: dict[str, list[tuple[float, float]]] = {name: [] for name in watched}
    before: dict[str, int] = {}
    while player.poll() is None:
        if not ears.ties:
            before = ears.bad()
        else:
            for name, process in watched.items():
                try:
                    times = process.cpu_times()
                except psutil.Error:
                    continue
                used[name].append((time.time(), times.user + times.system))
        time.sleep(0.5)
    return used, before


def _result(ears: Ears, used: dict[str, list[tuple[float, float]]]) -> dict:
    if not ears.ties:
        raise SystemExit("no ties came")
    received, last, stamp, rays = np.array(ears.ties, dtype=np.int64).T
    steady = received > received[0] + SETTLE_S * 1e9
    seconds = (received[-1] - received[steady][0]) * 1e-9
    latency = (received - last - ears.ahead_ns)[steady] * 1e-9
    # while it works: the last poses of all wait until nothing more comes
    end = max(stamp for _, stamp in ears.poses) - 200_000_000
    pose = np.array([p for p in ears.poses if p[0] > received[0] and p[1] < end], dtype=np.int64)
    pose_s = (pose[:, 0] - pose[:, 1] - ears.ahead_ns) * 1e-9
    # an observation is stamped with when it is to be used; by then it should be there
    spare = (stamp + ears.ahead_ns - received)[steady] * 1e-9
    return {
        "rays_per_s": float(rays[steady].sum() / seconds), "seconds": float(seconds),
        "latency_p50_s": float(np.quantile(latency, 0.5)), "latency_p95_s": float(np.quantile(latency, 0.95)),
        "latency_max_s": float(latency.max()), "least_spare_s": float(spare.min()),
        "pose_p99_s": float(np.quantile(pose_s, 0.99)), "pose_max_s": float(pose_s.max()),
        "cores": {n: (u[-1][1] - u[0][1]) / (u[-1][0] - u[0][0]) for n, u in used.items() if len(u) > 1},
        "paces": ears.paces, "largest_lag_s": ears.lags,
        "states": {n: s["state"] for n, s in ears.status.items()},
        "problems": {n: s["last_problem"] for n, s in ears.status.items() if s["last_problem"]},
        "counters": ears.status["matcher"]["counters"],
    }  # fmt: skip


def lines(result: dict) -> list[str]:
    """The result in words."""
    cores = ", ".join(f"{name} {share:.2f}" for name, share in result["cores"].items())
    bad = ", ".join(f"{name} {n}" for name, n in result["bad"].items()) or "nothing"
    paces = "; ".join(f"{topic} up to level {level}" for topic, level in result["paces"].items())
    return [
        f"over the bus, player, navigator, matcher and adjuster on {result['cores_given']} cores:",
        f"  {result['rays_per_s']:.0f} rays/s over {result['seconds']:.0f} s; cores: {cores}",
        f"  last look to tie: median {result['latency_p50_s']:.3f} s, 95 % below {result['latency_p95_s']:.3f} s, "
        f"at most {result['latency_max_s']:.3f} s",
        f"  filtered pose: 99 % within {1e3 * result['pose_p99_s']:.0f} ms, "
        f"at most {1e3 * result['pose_max_s']:.0f} ms; lost or late: {bad}",
        *([f"  the machine was too slow: {paces}"] if paces else []),
    ]


def met(result: dict) -> bool:
    """Whether the rate, the latency and the completeness are as wanted."""
    return result["rays_per_s"] >= 150 and result["latency_p95_s"] < 0.5 and not result["bad"]


def main() -> int:
    parser = frame.parser(__doc__, as_json=True)
    parser.add_argument("--points", type=float, default=45.0, help="tie points a second that are wanted (45)")
    parser.add_argument("--budget-mb", type=float, default=1024.0, help="for image lines (1024)")
    parser.add_argument("--cores", type=int, default=2, help="for all processes together (2)")
    parser.add_argument("--port", type=int, default=17651)
    args = parser.parse_args()
    render()
    result = live(RECORDING, args.points, args.budget_mb, args.cores, args.port)
    print(json.dumps(result, indent=2) if args.json else "\n".join(lines(result)))
    return frame.verdict(met(result))


if __name__ == "__main__":
    sys.exit(main())
