"""Mosaic of a block: tones across seams, recovered gains, memory against size, and runs that are killed.

    python bench/mosaic.py [--seeds 20] [--strips 2 4 8] [--recording FILE --dem FILE]

Orthoimages of overlapping strips are made from one known ground, with gains (10 %), offsets (40 grey values), noise and
a truck that stands elsewhere in each strip, and put together by ``triline rectify --mosaic``, each run in a process of
its own. *Step of tone*: mean difference of the two strips along a seam line, RMS over lines, before and after the
balance. *NEES*: squared errors of gains and offsets over their stated variances, mean over seeds, 1 expected.
*Off the ground*: median difference of the mosaic from the ground. *Memory*: the most that the command or one of its
workers held, for blocks of more and more strips; *growth*: of the largest against the smallest. *Killed*: the command
and its workers are ended with SIGKILL while they work, again and again, and the same command is given once more.

With ``--recording`` (a processed simulated flight of several strips, and its true relief) the strips of a recording are
put together as well: offsets between the strips in overlaps, by correlation of patches, against what the sigma band
lets expect; of both the median, since some patches find a place elsewhere that looks like theirs.
``--constants`` runs one block with the costs of seams divided and multiplied by four.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))

from block_of_orthoimages import make_block  # noqa: E402

#: What is wanted: NEES within this, step after the balance below, growth of memory below, offsets over sigmas below.
NEES, STEP, GROWTH, OFFSET = (0.6, 1.6), 3.0, 1.15, 1.6
#: Median of the length of a normal vector in the plane whose length has the mean square 1.
MEDIAN = np.sqrt(np.log(2.0))
_WATCHED = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE)
print(done.stdout.decode(), end="")
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024)
sys.exit(done.returncode)
"""


def command(block, target: Path, *more: str) -> list[str]:
    files = [*map(str, block.files)]
    return [*frame.TRILINE, "rectify", *files, "--mosaic", "--json", "--tile", "256", "-o", str(target), *more]


def mosaic(block, target: Path, *more: str) -> tuple[dict, int]:
    """What the command tells, and the most megabytes that it or a worker held."""
    words = [sys.executable, "-c", _WATCHED, *command(block, target, *more)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr.strip())
    text, _, memory = done.stdout.rstrip().rpartition("\n")
    return json.loads(text), int(memory)


def one_seed(seed: int) -> dict[str, float]:
    import rasterio

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        block = make_block(folder, strips=3, seed=seed)
        told, _ = mosaic(block, folder / "block.tif", "--workers", "1")
        layers = told["bands"][0]["layers"]
        gain = [(a["gain"] - g) / a["gain_sigma"] for a, g in zip(layers, block.gain, strict=True)]
        offset = [(a["offset"] - o) / a["offset_sigma"] for a, o in zip(layers, block.offset, strict=True)]
        with rasterio.open(folder / "block.tif") as image:
            grey = image.read(1).astype(float)
        step = told["step_across_seams"]
        return {
            "gain": float(np.mean(np.square(gain))), "offset": float(np.mean(np.square(offset))),
            "before": step["raw_tone_rms"], "after": step["balanced_tone_rms"],
            "ground": float(np.median(np.abs(grey - block.ground)[grey > 0])),
        }  # fmt: skip


def digest(target: Path) -> str:
    found = hashlib.sha256()
    for end in ("tif", "source.tif", "seams.geojson"):
        found.update(target.with_suffix(f".{end}").read_bytes())
    return found.hexdigest()


def killed(folder: Path) -> tuple[bool, bool, int]:
    """Whether 2 workers and killed runs give the bytes of one worker, and how often runs were killed."""
    block = make_block(folder, strips=4, columns=1500, seed=5)
    begun = time.perf_counter()
    mosaic(block, folder / "one.tif", "--workers", "1")
    pause = 0.15 * (time.perf_counter() - begun)
    mosaic(block, folder / "two.tif", "--workers", "2")
    target, kills = folder / "killed.tif", 0
    while True:
        # a session of its own, so that its workers are killed with it and nothing else is
        run = subprocess.Popen(
            command(block, target, "--workers", "2"), stdout=subprocess.DEVNULL, start_new_session=True
        )
        try:
            code = run.wait(pause)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            kills += 1
            pause *= 1.3  # so that it comes to an end however long a start takes
            continue
        if code:
            sys.exit(f"the mosaic failed: {code}")
        break
    one = digest(folder / "one.tif")
    return digest(folder / "two.tif") == one, digest(target) == one, kills


def memory(sizes: list[int]) -> dict[int, int]:
    out = {}
    for strips in sizes:
        with tempfile.TemporaryDirectory() as name:
            block = make_block(Path(name), strips=strips, columns=2400, width=600, apart=400, seed=7)
            out[strips] = mosaic(block, Path(name) / "block.tif", "--workers", "1")[1]
    return out


def strips_of(recording: Path, dem: Path, folder: Path) -> dict[str, float]:
    """Geometric offsets between the strips of a recording, metres, beside what their sigmas let expect."""
    import rasterio
    from ventoux import matches

    from triline.nodes.recording.access import Recording

    names, paths = list(Recording(recording).last_strips()), []
    for name in names:
        paths.append(folder / f"{name}.tif")
        sigma = ["--sigma", str(folder / f"{name}.sigma.tif")]
        frame.triline(
            "rectify", str(recording), "--strip", name, "--dem", str(dem), "-o", str(paths[-1]), *sigma, "-q",
            "--crs", "EPSG:32632",
        )  # fmt: skip
    ratio, length = [], []
    for a, one in enumerate(paths):
        for other in paths[a + 1 :]:
            places, offset = matches(one, other)
            if not len(places):
                continue
            with (
                rasterio.open(one.with_suffix(".sigma.tif")) as p,
                rasterio.open(other.with_suffix(".sigma.tif")) as q,
            ):
                s = [np.array([v[0] for v in image.sample(places.tolist())]) for image in (p, q)]
            good = np.isfinite(s[0] + s[1])
            length += np.linalg.norm(offset[good], axis=1).tolist()
            ratio += (np.linalg.norm(offset[good], axis=1) / np.hypot(s[0], s[1])[good]).tolist()
    told = json.loads(
        frame.triline("rectify", str(recording), "--mosaic", "--dem", str(dem), "-o", str(folder / "m.tif"), "--json")
    )
    step = told["step_across_seams"]
    return {
        "patches in overlaps": len(ratio), "offset, m, median": float(np.median(length)),
        "offset over its sigma": float(np.median(ratio) / MEDIAN),
        "step of tone before": step["raw_tone_rms"], "step of tone after": step["balanced_tone_rms"],
        "light at the ends of the line, %": 100 * (1 + sum(told["bands"][0]["fall_off"][0][k] for k in ("s2", "s4"))),
    }  # fmt: skip


def constants(folder: Path) -> None:
    """Step across seams with the costs of `solver/orthoimage/seams.py` four times smaller and larger."""
    from triline.nodes.cli import main as triline
    from triline.solver.orthoimage import seams

    block = make_block(folder, strips=3, seed=3)
    for name in ("LENGTH_COST", "OFF_MIDDLE_COST", "EDGE_COST"):
        usual = getattr(seams, name)
        for factor in (0.25, 1.0, 4.0):
            setattr(seams, name, factor * usual)
            target = folder / f"{name}{factor}.tif"
            told = io.StringIO()
            with contextlib.redirect_stdout(told), contextlib.redirect_stderr(io.StringIO()):
                triline(command(block, target, "--workers", "1")[len(frame.TRILINE) :])
            step = json.loads(told.getvalue())["step_across_seams"]
            values = [step[k] for k in ("nodes", "balanced_tone_rms", "balanced_rms")]
            frame.show({f"{name} x {factor:g}: nodes of seam, step of tone, of nodes": values})
        setattr(seams, name, usual)


def main() -> int:
    parser = frame.parser(__doc__, seeds=20, processes=True)
    parser.add_argument("--strips", type=int, nargs="+", default=[2, 4, 8], help="sizes of blocks for the memory")
    parser.add_argument("--recording", type=Path, help="processed simulated flight")
    parser.add_argument("--dem", type=Path, help="its true relief")
    parser.add_argument("--constants", action="store_true", help="only the effect of the costs of seams")
    args = parser.parse_args()
    if args.constants:
        with tempfile.TemporaryDirectory() as folder:
            constants(Path(folder))
        return 0
    rows = list(frame.over_seeds(one_seed, args.seeds, processes=args.processes))
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    rms = {name: float(np.sqrt(np.mean([row[name] ** 2 for row in rows]))) for name in ("before", "after")}
    frame.show(
        {
            "blocks of 3 strips": args.seeds, "NEES of gains": mean["gain"], "NEES of offsets": mean["offset"],
            "step of tone before": rms["before"], "step of tone after": rms["after"], "off the ground": mean["ground"],
        }
    )  # fmt: skip
    held = memory(args.strips)
    growth = held[max(held)] / held[min(held)]
    frame.show({f"MB, {n} strips": mb for n, mb in held.items()} | {"growth": growth})
    with tempfile.TemporaryDirectory() as folder:
        same, after, kills = killed(Path(folder))
    frame.show({"2 workers, same bytes": same, f"killed {kills} times, same bytes": after})
    good = NEES[0] < mean["gain"] < NEES[1] and NEES[0] < mean["offset"] < NEES[1] and rms["after"] < STEP
    good = good and growth < GROWTH and same and after and kills > 0
    if args.recording is not None:
        with tempfile.TemporaryDirectory() as folder:
            found = strips_of(args.recording, args.dem, Path(folder))
        frame.show(found)
        good = good and found["offset over its sigma"] < OFFSET
    return frame.verdict(good)


if __name__ == "__main__":
    sys.exit(main())
