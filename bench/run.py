"""Run benchmarks and studies, and write what they print into ``docs/``: ``make bench``, ``make study``.

    python bench/run.py                 # benchmarks: how fast, beside what, with how much memory
    python bench/run.py --studies       # studies: how good, over how many flights; those that take up to half an hour
    python bench/run.py --studies --long  # all studies
    python bench/run.py strips latency  # these
    python bench/run.py --list          # names, questions and commands

A benchmark owns one block of a page in ``docs/``, between ``<!-- bench NAME -->`` and ``<!-- end -->``. As soon as it
is done its commands, what they printed, the day and the machine stand there. A program that fails leaves its block as
it is. Every program can be run alone; ``--help`` shows its options.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import frame

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
#: A study that takes longer runs only when it is asked for.
LONG_MIN = 30.0
#: `make bench` measures speed, all of it in less than 25 minutes on two idle cores; the others are `make study`.
SPEED = (
    "latency", "tie-latency", "demo-cores", "window-peers", "hour", "bus-load", "recordings", "messages", "poses",
    "rotations", "replay", "batch", "navigation", "matcher", "orthoimage", "rectification", "satellites",
)  # fmt: skip


@dataclass(frozen=True)
class Benchmark:
    """A question and the commands whose output answers it.

    Attributes
    ----------
    name : of the block in ``docs/``
    question : that it answers
    commands : as a reader types them, ``python bench/PROGRAM.py ...`` or ``triline ...``
    minutes : on two idle cores, about
    """

    name: str
    question: str
    commands: tuple[str, ...]
    minutes: float

    @property
    def long(self) -> bool:
        return self.minutes > LONG_MIN

    @property
    def run_by(self) -> str:
        """What runs it, for a reader."""
        if self.name in SPEED:
            return "make bench"
        return "make study"


BENCHMARKS = (
    Benchmark(
        "strips",
        "How close does the on-line answer of one strip come to a batch adjustment of the same data?",
        ("python bench/efficiency.py table --seeds 20",),
        6,
    ),
    Benchmark(
        "blocks",
        "The same for a block of six strips and two cross strips",
        ("python bench/efficiency.py blocks --seeds 20 --strip-s 24",),
        100,
    ),
    Benchmark(
        "adjust",
        "Does the window agree with the estimator of `triline adjust`?",
        ("python bench/efficiency.py adjust --seeds 3 --strip-s 24",),
        10,
    ),
    Benchmark(
        "outliers",
        "Does data snooping in the window find as many blunders as that of the batch adjustment?",
        ("python bench/outliers.py --seeds 20", "python bench/outliers.py --seeds 20 --px 2 8"),
        4,
    ),
    Benchmark(
        "sigmas",
        "Are errors as large as the sigmas say?",
        (
            "python bench/consistency.py seeds --seeds 50",
            "python bench/consistency.py seeds --seeds 50 --rough",
            "python bench/consistency.py seeds --seeds 50 --camera 0.03",
        ),
        8,
    ),
    Benchmark(
        "misspecified",
        "What happens in a world that is not as it is stated?",
        ("triline study misspecified --seeds 20 --jobs 2",),
        65,
    ),
    Benchmark(
        "misspecified-block",
        "And over three strips?",
        ("triline study misspecified --seeds 20 --strips 3 --jobs 2",),
        150,
    ),
    Benchmark(
        "misspecified-motion",
        "And with the motion of a real flight?",
        (
            "triline study misspecified --seeds 3 --motion "
            "../shared/data/avirisng/ang20170323t202244_eph_att --from 800",
        ),
        8,
    ),
    Benchmark(
        "known-orientation",
        "And how good would points be if the orientation were known exactly?",
        (
            "python bench/known_orientation.py",
            "python bench/known_orientation.py --seeds 3 --motion "
            "../shared/data/avirisng/ang20170323t202244_eph_att --from 800",
        ),
        4,
    ),
    Benchmark(
        "camera-errors",
        "And where the camera is not as calibrated?",
        ("python bench/camera_errors.py",),
        5,
    ),
    Benchmark(
        "disturbed-folders",
        "And in block folders of another program, disturbed by hand?",
        ("python bench/disturbed_folders.py",),
        7,
    ),
    Benchmark(
        "hours",
        "Do sigmas stay right over two hours?",
        ("python bench/drift.py --minutes 120",),
        18,
    ),
    Benchmark(
        "inertial",
        "Are sigmas right where the poses come from inertial data?",
        ("python bench/apriori.py --seeds 6",),
        6,
    ),
    Benchmark(
        "pose-changes",
        "Do the errors of smoothed inertial poses change as fast as the adjuster assumes?",
        ("python bench/pose_changes.py --seeds 6",),
        4,
    ),
    Benchmark(
        "camera",
        "What does it cost to estimate a camera parameter only once it is determined?",
        (
            "python bench/consistency.py held --seeds 20 --camera 0.03",
            "python bench/consistency.py held --seeds 20 --camera 0.1",
        ),
        6,
    ),
    Benchmark(
        "self-calibration",
        "Are sigmas right where many rays meet additional parameters of the camera?",
        (
            "python bench/self_calibration.py --ties 100 --seeds 12",
            "python bench/self_calibration.py --ties 8 --seeds 24",
            "python bench/self_calibration.py --ties 100 --seeds 10 --seconds 60 --px 0.6 --share 1 --exact "
            "--no-window",
        ),
        25,
    ),
    Benchmark(
        "camera-sigmas",
        "Are sigmas right with a calibrated camera, over many flights, and do batch and window agree?",
        ("python bench/self_calibration.py --parameters 12 --share 0.03 --ties 5 --seeds 150",),
        35,
    ),
    Benchmark(
        "seeds",
        "How much better than direct georeferencing is the demo's flight, over seeds?",
        ("triline study online --seeds 20",),
        8,
    ),
    Benchmark(
        "protection",
        "How often does a wrong control coordinate do more than the protection level allows?",
        ("python bench/consistency.py control --seeds 100",),
        6,
    ),
    Benchmark(
        "drifting-ties",
        "Are tie points that drift named, and what is the orientation worth then?",
        ("python bench/drifting_sources.py",),
        5,
    ),
    Benchmark(
        "constants",
        "What do half and double the value of a tuned constant of the window change?",
        (
            "python bench/constants.py effect hypotheses.CAUSE_STEADY MATTERS_PX MOVED pose_noise.NOISE_CHANGED SHARP "
            "screening.ties.TOGETHER --processes 2",
        ),
        7,
    ),
    Benchmark(
        "latency",
        "How long does an update take with 20 000 rays in the window?",
        (
            "python bench/window.py latency --selfcal --interval 0.024",
            "python bench/window.py latency --selfcal --interval 0.2",
        ),
        2,
    ),
    Benchmark(
        "tie-latency",
        "How long does it take from a tie point on the bus to the orientation that uses it?",
        (
            "python bench/tie_latency.py",
            "python bench/tie_latency.py --loops 1",
            "python bench/tie_latency.py --selfcal tls18 --computed",
        ),
        4,
    ),
    Benchmark(
        "demo-cores",
        "Does a live flight keep up on two cores, and what does each of its processes take?",
        ("python bench/demo_cores.py",),
        4,
    ),
    Benchmark(
        "window-peers",
        "How fast is an update beside GTSAM's fixed-lag smoother and Ceres?",
        ("python bench/window_peers.py",),
        2,
    ),
    Benchmark(
        "hour",
        "How long does `triline process` take for an hour of flight?",
        (
            "python bench/process_hour.py --imu --pace throughput",
            "python bench/process_hour.py --imu --share 0.1",
        ),
        3,
    ),
    Benchmark(
        "batch-speed",
        "Do two workers take forty recordings through `triline batch` in half the time of one?",
        ("python bench/batch_fleet.py speed",),
        10,
    ),
    Benchmark(
        "batch-killed",
        "Is every recording done once, and as by `process`, where workers are killed?",
        ("python bench/batch_fleet.py killed",),
        8,
    ),
    Benchmark(
        "batch-restarted",
        "Does the same command do only what was not finished when program or scheduler were killed?",
        ("python bench/batch_fleet.py restarted",),
        5,
    ),
    Benchmark(
        "batch-store",
        "How much of a recording in an object store do commands fetch?",
        ("python bench/batch_fleet.py store",),
        2,
    ),
    Benchmark(
        "memory",
        "Do memory and latency stay flat over four hours?",
        ("python bench/long_flight.py --hours 4 --pace throughput",),
        10,
    ),
    Benchmark(
        "bus-load",
        "Do bus and recorder keep up with three full CCD lines, 57.6 MB/s?",
        ("python bench/bus_load.py", "python bench/bus_load.py --secure"),
        1,
    ),
    Benchmark(
        "recordings",
        "What does own code beside the mcap library buy?",
        ("python bench/recordings.py",),
        1,
    ),
    Benchmark(
        "messages",
        "What do messages cost that share their memory in groups?",
        ("python bench/messages.py",),
        1,
    ),
    Benchmark(
        "poses",
        "What does a pose cost a node that takes several at once?",
        ("python bench/poses.py",),
        1,
    ),
    Benchmark(
        "rotations",
        "Where would SciPy's rotations be as fast as own code?",
        ("python bench/rotation.py",),
        1,
    ),
    Benchmark(
        "replay",
        "How exactly does a replay keep the time of the recording?",
        ("python bench/replay_timing.py",),
        1,
    ),
    Benchmark(
        "batch",
        "How fast is the batch adjustment, and how does it grow?",
        (
            "python bench/adjustment_job.py",
            "python bench/adjustment_scaling.py -o out/bench",
            "python bench/batch_peers.py",
        ),
        3,
    ),
    Benchmark(
        "large-blocks",
        "Do blocks in partitions have the answers of the whole, in how much time and memory?",
        ("python bench/large_blocks.py", "python bench/large_blocks.py --rays 250 --kill"),
        6,
    ),
    Benchmark(
        "navigation",
        "Is the inertial navigator fast, accurate and consistent?",
        ("python bench/navigation.py",),
        1,
    ),
    Benchmark(
        "traps",
        "Which wrong units, axes and clocks in inertial and GNSS data are named?",
        ("python bench/navigation_traps.py --seeds 2",),
        10,
    ),
    Benchmark(
        "matcher",
        "What does image matching cost at 12 000 px x 3 x 800 lines/s, and how does it compare with OpenCV?",
        ("python bench/matcher_live.py", "python bench/matcher.py"),
        3,
    ),
    Benchmark(
        "matching",
        "How accurate are matched tie points, and are their sigmas right?",
        ("triline study matching --seeds 3",),
        10,
    ),
    Benchmark(
        "starts",
        "Does matching find its way from an orientation that is wrong by 30 px?",
        ("triline study starts --seeds 2 --jobs 2",),
        40,
    ),
    Benchmark(
        "bad-imagery",
        "What is left of tie points where image lines are spoilt?",
        ("python bench/bad_imagery.py",),
        12,
    ),
    Benchmark(
        "real-pixels",
        "How good are matches of real pushbroom pixels, and does the matcher know it?",
        ("python bench/real_pixels.py", "python bench/real_pixels.py --largest-sigma 0.3"),
        1,
    ),
    Benchmark(
        "matched-ties",
        "Are matched tie points worth as much as simulated ones of the same noise?",
        (
            "triline study ties --kinds rough --seeds 4 --again 2 --jobs 2",
            'triline study ties --kinds plain "no mount" --seeds 2 --again 2 --jobs 2',
        ),
        60,
    ),
    Benchmark(
        "orthoimage",
        "How fast is rectification beside GDAL, and how straight do roads come out?",
        ("python bench/orthoimage.py",),
        2,
    ),
    Benchmark(
        "testfields",
        "Does the adjustment reach the accuracy published for real testfields?",
        ("triline study testfields --seeds 10",),
        8,
    ),
    Benchmark(
        "scenes",
        "Are errors of adjusted satellite scenes as large as their sigmas say?",
        ("triline study scenes --seeds 50",),
        2,
    ),
    Benchmark(
        "batch-sigmas",
        "Are errors of adjusted blocks as large as their sigmas say?",
        ("triline study consistency",),
        2,
    ),
    Benchmark(
        "freezes",
        "Does a node that stood still around the lease of its links hear its sensors again?",
        ("python bench/link_freezes.py --freezes 200 --least 4.4 --most 5.2 --seed 2",),
        35,
    ),
    Benchmark(
        "faults",
        "What is lost when nodes are killed or stand still, how long until all is right, what is the operator told?",
        ("python bench/faults.py --kind processes",),
        18,
    ),
    Benchmark(
        "faults-data",
        "The same of sensors that fail: clocks, NaN, frozen, silent, lost, twice, out of order, drifting",
        ("python bench/faults.py --kind data",),
        3,
    ),
    Benchmark(
        "faults-images",
        "The same of a camera that repeats image lines, or whose lines are lost",
        ("python bench/faults.py --kind images",),
        3,
    ),
    Benchmark(
        "faults-link",
        "The same of the link between the sensors and the nodes: slow, silent, closed",
        ("python bench/faults.py --kind link",),
        7,
    ),
    Benchmark(
        "faults-packets",
        "The same of single packets of that link: lost, late, in another order",
        ("python bench/faults.py --kind packets",),
        6,
    ),
    Benchmark(
        "fleet",
        "Four aircraft, three routers: what of a cut link, a slow one and forgeries comes to the ground?",
        ("python bench/fleet.py",),
        9,
    ),
    Benchmark(
        "faults-long",
        "What do live nodes lose in half an hour at ten times real time, and how does their memory grow?",
        ("python bench/faults.py --long --seconds 1655",),
        5,
    ),
    Benchmark(
        "faults-day",
        "And in a day of flight, fifteen times real time?",
        ("python bench/faults.py --long --seconds 86400 --rate 15 --attitude-rate 10 --ties 0.2 --grid 4",),
        105,
    ),
    Benchmark(
        "busy-tests",
        "Do all tests pass, run after run, beside a loop that keeps a core busy?",
        ("python bench/busy_tests.py --runs 20",),
        200,
    ),
    Benchmark(
        "fuzz",
        "Do readers and nodes stand hostile files and messages whose checksums are right?",
        ("python bench/fuzz.py --cases 1000000 --seconds 5400",),
        45,
    ),
    Benchmark(
        "rectification",
        "How fast is an image rectified beside GDAL's RPC warp, and do two looks of Ventoux lie on each other?",
        ("python bench/rectification.py",),
        2,
    ),
    Benchmark(
        "mosaic",
        "Mosaic of a block: tones across seams, recovered gains, memory against size, runs that are killed",
        ("python bench/mosaic.py",),
        5,
    ),
    Benchmark(
        "scale",
        "What does a flight cost in each stage, and what do 10, 1 000 and 100 000 of them need?",
        ("python bench/scale.py",),
        3,
    ),
    Benchmark(
        "satellites",
        "How long does location by satellite models take, beside rasterio's?",
        ("python bench/satellites.py",),
        2,
    ),
)


def main() -> int:
    parser = frame.parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run")
    parser.add_argument("--studies", action="store_true", help="studies instead of benchmarks of speed")
    parser.add_argument("--long", action="store_true", help=f"also studies of more than {LONG_MIN:g} minutes")
    parser.add_argument("--list", action="store_true", help="say what there is, and run nothing")
    args = parser.parse_args()
    if args.list:
        for b in BENCHMARKS:
            print(f"{b.name} ({b.minutes:g} min): {b.question}", *b.commands, sep="\n    ")
        return 0
    failed = [b.name for b in chosen(parser, args) if not run(b)]
    fill("list", overview())
    if failed:
        print(f"\nnot as wanted, or failed: {', '.join(failed)}")
    return 1 if failed else 0


def chosen(parser: argparse.ArgumentParser, args: argparse.Namespace) -> list[Benchmark]:
    """Those that the command line asks for."""
    if not args.names:
        if args.studies:
            return [b for b in BENCHMARKS if b.name not in SPEED and (args.long or not b.long)]
        return [b for b in BENCHMARKS if b.name in SPEED]
    known = {b.name: b for b in BENCHMARKS}
    unknown = [name for name in args.names if name not in known]
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in args.names]


def run(benchmark: Benchmark) -> bool:
    """Run the commands, print their output as it comes and put it into the page; whether all is as wanted."""
    print(f"\n=== {benchmark.name}: {benchmark.question}", flush=True)
    text, good, begun = [], True, time.monotonic()
    for command in benchmark.commands:
        print(f"$ {command}", flush=True)
        code, said = execute(command)
        if code not in (0, frame.NOT_MET):
            print(f"failed with exit code {code}: {benchmark.name} stays as it was in {DOCS.name}/", flush=True)
            return False
        good &= code == 0
        text += [f"$ {command}", *said]
    minutes = (time.monotonic() - begun) / 60.0
    fill(benchmark.name, ["```text", *text, "```", machine(minutes)])
    return good


def execute(command: str) -> tuple[int, list[str]]:
    """Exit code of a command, and the lines that it printed."""
    program, *words = shlex.split(command)
    start = [sys.executable] if program == "python" else frame.TRILINE
    lines: list[str] = []
    with subprocess.Popen([*start, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line.rstrip())
    return process.returncode, lines


def machine(minutes: float) -> str:
    """Where and when: day, processor, Python, and how long it took."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists() and (found := re.search(r"model name\s*: (.*)", cpuinfo.read_text())):
        model = found.group(1)
    day = datetime.date.today().isoformat()
    took = f"{minutes:.0f} minute{'s' * (round(minutes) != 1)}"
    return f"{day}, {os.cpu_count()} cores of {model}, Python {platform.python_version()}, {took}."


def overview() -> list[str]:
    """The table of all benchmarks."""
    rows = ["| name | question | programs | minutes | run by |", "|---|---|---|---|---|"]
    for b in BENCHMARKS:
        programs = ", ".join(dict.fromkeys(f"`{program_of(c)}`" for c in b.commands))
        rows.append(f"| {b.name} | {b.question} | {programs} | {b.minutes:g} | `{b.run_by}` |")
    return rows


def program_of(command: str) -> str:
    """`efficiency.py` or `triline study ties`."""
    words = command.split()
    return Path(words[1]).name if words[0] == "python" else " ".join(words[:3])


def block(name: str) -> re.Pattern[str]:
    """The place of a block in a page."""
    return re.compile(rf"(<!-- bench {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)


def fill(name: str, lines: list[str]) -> None:
    """Put lines into the block of a name, on whichever page it stands.

    Raises
    ------
    LookupError : no page has the block
    """
    text = "\n".join(lines) + "\n"
    for page in sorted(DOCS.glob("*.md")):
        old = page.read_text(encoding="utf-8")
        new, count = block(name).subn(lambda found: found.group(1) + text + found.group(2), old)
        if count:
            page.write_text(new, encoding="utf-8")
            return
    raise LookupError(f"no page in {DOCS.name}/ has a block for {name}")


if __name__ == "__main__":
    sys.exit(main())
