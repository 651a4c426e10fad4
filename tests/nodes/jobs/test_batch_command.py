"""`triline batch` on workers of this machine: results, second runs, failures, and what is killed or interrupted."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bus_rig import wait_for
from recording_file import without_topics

from triline.nodes.cli import batch, main

TRILINE = [sys.executable, "-m", "triline.nodes.cli"]
#: Quick, and has no input but the recording.
ADJUST = ("--do", "adjust", "--workers", "2")


@pytest.fixture
def season(adjustable, tmp_path, monkeypatch):
    """A folder with three flights; the working folder is the one above it."""
    monkeypatch.chdir(tmp_path)
    for name in ("day1/f1", "day1/f2", "day2/f3"):
        path = tmp_path / "season" / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        os.link(adjustable, path)
    return tmp_path / "season"


def summary(out: str | Path = "out") -> dict:
    return json.loads(Path(out, "summary.json").read_text())


def records(out: str | Path = "out") -> dict[str, int]:
    # folders of jobs that end go while they are looked at: os.walk takes that, Path.rglob does not
    found = [os.path.join(folder, name) for folder, _, names in os.walk(out) for name in names]
    return {path: os.stat(path).st_mtime_ns for path in sorted(found) if path.endswith(".done.json")}


def started(*words: str) -> subprocess.Popen:
    return subprocess.Popen([*TRILINE, "batch", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def jobs_of(process: subprocess.Popen) -> list[int]:
    """The processes that a batch has started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == process.pid:
                found.append(int(stat.parent.name))
        except OSError:
            continue
    return found


def test_results_are_those_of_the_single_commands(flown, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.link(flown, "f.mcap")
    do = ("--do", "process,adjust,analyze", "--with", "process --pace throughput")
    assert main(["batch", "f.mcap", "-o", "out", *do]) == 0
    told = capsys.readouterr().out
    row = summary()["flights"][0]
    assert row["state"] == "finished"
    assert f"{row['sigma0']:.3f}" in told
    assert [step["state"] for step in row["steps"].values()] == ["finished"] * 3

    assert main(["process", "f.mcap", "-o", "alone.mcap", "--pace", "throughput"]) == 0
    assert Path("alone.mcap").read_bytes() == Path("out/f/processed.mcap").read_bytes()
    assert main(["adjust", "out/f/processed.mcap", "-o", "alone"]) == 0
    for name in ("points.csv", "residuals.csv", "trajectory_refined.csv"):
        assert Path("alone", name).read_bytes() == Path("out/f/adjustment", name).read_bytes()
    report = json.loads(Path("out/f/analyze.json").read_text())
    assert row["rmse_m"] == report["points"]["adjusted"]["rmse_m"]
    assert row["adjust"]["sigma0"] == json.loads(Path("alone/result.json").read_text())["sigma0"]

    page = Path("out/index.html").read_text()
    assert 'href="f/report.html"' in page
    assert 'href="f/processed.mcap"' in page
    assert page.count("<img") == 1, "the map; one flight gives no curve"
    track = row["tracks"][0]
    assert track["strip"] == "S1"
    assert abs(track["lat_deg"][0] - 48.93) < 0.1
    assert Path("out/summary.csv").read_text().splitlines()[1].startswith("f,finished,")

    capsys.readouterr()
    assert main(["batch", "f.mcap", "-o", "out", *do, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["jobs"] == {
        "finished": 3, "earlier": 3, "now": 0, "failed": 0, "not_begun": 0,
    }  # fmt: skip
    assert main(["batch", "f.mcap", "-o", "out", "--do", "adjust", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["to_do"] == [], "what an earlier run processed is what is adjusted"
    os.utime("f.mcap", ns=(0, 1))
    assert main(["batch", "f.mcap", "-o", "out", "--do", "adjust", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["to_do"] == ["adjust"], "but not that of another recording"


def to_do(capsys, *words: str) -> list[list[str]]:
    """What a batch would do, by flight."""
    capsys.readouterr()
    assert main(["batch", "season", "-o", "out", "--list", "--json", *words]) == 0
    return [row["to_do"] for row in json.loads(capsys.readouterr().out)]


def test_what_is_missing_or_made_of_something_else_is_done_again(season, capsys):
    assert main(["batch", "season", "-o", "out", *ADJUST, "-q"]) == 0
    assert to_do(capsys, *ADJUST) == [[], [], []]
    assert to_do(capsys, "--do", "adjust,analyze") == [["analyze"]] * 3
    assert to_do(capsys, *ADJUST, "--with", "adjust --snoop") == [["adjust"]] * 3

    shutil.rmtree("out/day1/f1/adjustment")
    os.utime("season/day2/f3.mcap", ns=(0, 1))  # the same file has three names
    assert to_do(capsys, *ADJUST) == [["adjust"]] * 3
    before = records()
    assert main(["batch", "season/day1", "-o", "out/day1", *ADJUST, "-q"]) == 0
    assert {path for path, when in records().items() if before[path] != when} == {
        "out/day1/f1/adjust.done.json", "out/day1/f2/adjust.done.json",
    }  # fmt: skip

    Path("camera.json").write_text("{}")
    options = ("--with", f"adjust --camera {Path('camera.json')}")
    Path("out/day2/f3/adjust.done.json").write_text("no record")
    assert to_do(capsys, *ADJUST)[2] == ["adjust"]
    assert to_do(capsys, *ADJUST, *options) == [["adjust"]] * 3


def test_a_failure_is_named_with_its_reason_and_log_and_stops_nothing_else(season, capsys):
    Path("season/day1/broken.mcap").write_bytes(b"no recording")  # comes first
    Path("season/day1/f2.mcap").unlink()
    Path("season/day2/f3.mcap").unlink()
    assert main(["batch", "season", "-o", "out", "--do", "adjust,navigate", "--workers", "2"]) == 1
    told = capsys.readouterr()
    assert "day1/broken: adjust failed: " in told.err
    assert "not an MCAP recording" in told.err
    result = summary()
    assert result["jobs"] == {"finished": 1, "earlier": 0, "now": 1, "failed": 3, "not_begun": 0}
    by_name = {row["flight"]: row for row in result["flights"]}
    assert by_name["day1/f1"]["steps"]["adjust"]["state"] == "finished"
    assert "no sensor/imu" in by_name["day1/f1"]["steps"]["navigate"]["reason"]
    step = by_name["day1/broken"]["steps"]["adjust"]
    assert step["reason"] in Path("out", step["log"]).read_text()
    assert 'href="day1/broken/adjust.log"' in Path("out/index.html").read_text()


@pytest.mark.parametrize("steps", ["adjust", "process,analyze"])
def test_a_recording_that_is_cut_off_is_told(season, steps, capsys):
    """It stood there as any other flight."""
    if steps != "adjust":  # what is said of a whole one is the same
        Path("season/day1/f1.mcap").unlink()
    whole = Path("season/day1/f2.mcap").read_bytes()
    Path("season/day1/f2.mcap").unlink()
    Path("season/day1/f2.mcap").write_bytes(whole[: -len(whole) // 20])
    pace = [] if steps == "adjust" else ["--with", "process --pace throughput"]
    assert main(["batch", "season/day1", "-o", "out", "--do", steps, "--workers", "2", *pace]) == 0
    told = "the file ends inside a record at byte"
    out = capsys.readouterr().out
    assert out.count("  recording: ") == 1 and told in out
    *good, cut = summary()["flights"]
    assert [row["damage"] for row in good] == [[]] * (steps == "adjust")
    assert told in cut["damage"][0] and cut["state"] == "finished"
    assert told in Path("out/summary.csv").read_text().splitlines()[-1]
    assert told in Path("out/index.html").read_text()


#: Read by every Python that is started with its folder on PYTHONPATH.
FAILING = """
from triline.nodes.navigator.navigator import Navigator

def fail(self):
    raise ValueError("by design")

Navigator.finish = fail
"""


def test_nodes_whose_work_failed_are_named(season, tmp_path, monkeypatch, capsys):
    """Their flights were finished as any other."""
    (tmp_path / "sitecustomize.py").write_text(FAILING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    process = ("--do", "process", "--with", "process --nodes navigator")
    assert main(["batch", str(Path("season/day1/f1.mcap")), "-o", "out", *process]) == 0
    why = "navigator failed once, its results are not complete; the first time at the end: ValueError: by design"
    assert capsys.readouterr().out.count(f" {why} (sitecustomize.py:5)\n") == 1
    (row,) = summary()["flights"]
    assert row["state"] == "finished" and [text.partition(" (")[0] for text in row["incomplete"]] == [why]
    assert why in Path("out/summary.csv").read_text().splitlines()[-1]
    assert why in Path("out/index.html").read_text()


def test_a_flight_without_a_trajectory_has_failed(flown, tmp_path, monkeypatch, capsys):
    """It was done like any other, with a report of nothing."""
    monkeypatch.chdir(tmp_path)
    without_topics(flown, tmp_path / "f1.mcap", "sensor/attitude")
    assert main(["batch", "f1.mcap", "-o", "out", "--do", "process,analyze", "-q"]) == 1
    assert "/f1.mcap: no trajectory came out, so nothing is oriented: no usable message on" in capsys.readouterr().err
    assert not list(Path("out").rglob("processed.mcap")) and list(Path("out").rglob("process.log"))


def test_a_step_whose_input_failed_is_not_begun(season, capsys):
    Path("none.mcap").write_bytes(b"no recording")
    assert main(["batch", "none.mcap", "-o", "out", "--do", "process,analyze,adjust"]) == 1
    assert "process failed" in capsys.readouterr().err
    steps = summary()["flights"][0]["steps"]
    assert [steps[name]["state"] for name in ("process", "adjust", "analyze")] == ["failed", "not begun", "not begun"]


def test_a_job_that_is_killed_is_done_again(season):
    process = started("season", "-o", "out", *ADJUST)
    os.kill(wait_for(lambda: jobs_of(process), 10, "a job")[0], signal.SIGKILL)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 0, told
    attempts = sorted(row["steps"]["adjust"]["attempts"] for row in summary()["flights"])
    assert attempts == [1, 1, 2]


def test_one_that_is_always_killed_ends_as_a_failure(season):
    process = started("season/day2/f3.mcap", "-o", "out", *ADJUST, "--retries", "1")
    seen: set[int] = set()
    for _ in range(2):
        pid = wait_for(lambda: set(jobs_of(process)) - seen, 10, "a job").pop()
        seen.add(pid)
        os.kill(pid, signal.SIGKILL)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "f3: adjust failed (2 attempts): ended by SIGKILL" in told


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_batch_leaves_what_is_finished_and_nothing_else(season, how):
    """The same command then does the rest; no job works on without its batch."""
    process = started("season", "-o", "out", "--do", "adjust", "--workers", "1")
    before = wait_for(records, 10, "something finished")
    jobs = wait_for(lambda: jobs_of(process), 10, "a second job")
    process.send_signal(how)
    _, told = process.communicate(timeout=60)
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in jobs), 10, "the end of a job")
    if how is not signal.SIGKILL:
        assert process.returncode == 1
        assert "interrupted; " in told
        assert "the same command goes on from there" in told
        assert not list(Path("out").rglob(".job-*"))
        assert summary()["flights"][0]["state"] == "finished"
    assert main(["batch", "season", "-o", "out", *ADJUST, "-q"]) == 0
    after = records()
    assert len(after) == 3
    assert {path: after[path] for path in before} == before, "finished jobs are not done again"
    assert summary()["jobs"]["earlier"] >= len(before)
    assert not list(Path("out").rglob(".job-*"))


@pytest.mark.parametrize("taken", [False, True])
def test_what_was_finished_and_not_looked_at_when_a_batch_is_interrupted_is_finished(
    season, taken, monkeypatch, capsys
):
    """Also where the interruption comes between taking a job that has ended and counting it."""

    def interrupted(plans, pool, *_):
        pool.submit(plans[0].jobs["adjust"], 1, 0)
        wait_for(lambda: not pool._ended.empty(), 10, "something finished")
        if taken:
            assert pool.ended(0.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "drive", interrupted)
    assert main(["batch", "season/day1", "-o", "out", *ADJUST]) == 1
    assert "interrupted; 1 of 2 jobs are finished and kept" in capsys.readouterr().err
    assert [row["state"] for row in summary()["flights"]] == ["finished", "unfinished"]


def test_two_batches_do_not_write_to_one_folder(season, capsys):
    process = started("season", "-o", "out", *ADJUST)
    wait_for(lambda: jobs_of(process), 10, "a job")
    assert main(["batch", "season", "-o", "out", *ADJUST]) == 1
    assert "another program" in capsys.readouterr().err
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--do", "proces"), "--do proces: no such step, wanted some of process, navigate, adjust, rectify, analyze"),
        (("--do", ","), "--do: wanted some of"),
        (("--workers", "0"), "--workers 0: wanted 1 at least"),
        (("--retries", "-1"), "--retries -1: wanted 0 at least"),
        (("--with", "adjust --snoop"), "wanted one of the steps first: process, analyze"),
        (("--with", "process -o x.mcap"), "-o is set by `triline batch`"),
        (("--with", "process 'x"), "no closing quotation"),
        (("--list", "--with", "process --config no.toml"), "--with 'process --config no.toml': no.toml: no such file"),
    ],
)
def test_bad_options_are_one_line(season, capsys, words, told):
    assert main(["batch", "season", "-o", "out", *words]) == 1
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not Path("out").exists()


def test_options_that_a_step_would_refuse_are_refused_before_any_work(season, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["batch", "season", "-o", "out", "--with", "process --pace quick"])
    assert ended.value.code == 2
    assert "--pace" in capsys.readouterr().err
    assert not Path("out").exists()


def test_without_dask_one_line_says_how_to_install_it(season):
    code = (
        "import sys\nsys.modules['distributed'] = None\nfrom triline.nodes.cli import main\n"
        "sys.exit(main(['batch', 'season', '-o', 'out', '--scheduler', 'tcp://127.0.0.1:1']))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1
    wanted = "--scheduler tcp://127.0.0.1:1: needs Dask: pip install 'triline[cluster]'"
    assert run.stderr.splitlines()[-1] == f"triline batch: {wanted}"
