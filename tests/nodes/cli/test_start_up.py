"""What a command imports before it works, which says without a clock how long people wait for help and errors."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
from bus_rig import simulated_flight, wait_for
from places import ROOT

#: Packages that take 0.1 s and more to import each.
HEAVY = (
    "pandas",
    "scipy.stats",
    "scipy.signal",
    "scipy.interpolate",
    "rasterio",
    "matplotlib",
    "rerun",
    "rosbags",
    "h5py",
    "dask",
    "distributed",
    "fsspec",
)


#: What a look into a recording does without, besides.
NOT_FOR_INFO = ("cryptography", "scipy.special")


def imported(*words: str, packages: tuple[str, ...] = HEAVY) -> set[str]:
    """Which of these packages a command has imported when it ends."""
    code = (
        "import json, sys\nfrom triline.nodes.cli import main\n"
        f"try:\n    main({list(words)!r})\nexcept SystemExit:\n    pass\n"
        f"print('\\n' + json.dumps([m for m in {packages!r} if m in sys.modules]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(json.loads(run.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "words",
    [
        ("info", "recordings/strip.mcap"),
        ("adjust", "none.mcap"),
        ("rectify", "none.mcap", "-o", "none.tif"),
        ("navigate", "none"),
        ("import", "none", "-o", "none.mcap"),
        ("export", "none.mcap", "--topic", "event/log", "--csv", "none.csv"),
        ("analyze", "none.mcap"),
        ("view", "none.mcap"),
        ("fly", "none"),
        ("batch", "recordings/strip.mcap", "-o", "none", "--list"),
        ("batch", "none", "-o", "none"),
    ],
    ids=lambda words: words[0],
)
def test_help_pages_errors_and_info_import_nothing_heavy(words):
    assert imported(*words) == set()


def test_a_heavy_package_would_be_seen(tmp_path):
    words = ("export", "recordings/strip.mcap", "--topic", "sensor/gnss", "--csv", str(tmp_path / "gnss.csv"))
    assert "pandas" in imported(*words)


def test_a_look_into_a_recording_imports_hardly_anything():
    assert imported("info", "recordings/strip.mcap", packages=NOT_FOR_INFO) == set()
    assert "cryptography" in imported("check", "none", packages=NOT_FOR_INFO)


def test_nodes_on_an_open_bus_import_no_certificates():
    code = (
        "import sys\nimport triline.nodes.bus.live, triline.nodes.bus.program, triline.nodes.recorder.recorder\n"
        "import triline.nodes.cli.demo\nassert 'zenoh' in sys.modules\n"
        "print({'cryptography', 'ssl'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout == "set()\n"


def test_processing_a_flight_imports_no_statistics_and_who_wants_them_has_them(tmp_path):
    """filterpy imports `scipy.stats`, which took a third of the time before `process` works."""
    code = (
        "import sys\nfrom triline.nodes.cli import main\n"
        f"assert main(['process', 'recordings/strip.mcap', '-o', {str(tmp_path / 'out.mcap')!r}, '-q']"
        " + ['--nodes', 'navigator', '--processes', '1']) == 0\n"
        "assert 'filterpy' in sys.modules and not {'scipy.stats', 'scipy.ndimage'} & set(sys.modules)\n"
        "import filterpy.discrete_bayes, filterpy.stats\n"
        "found = filterpy.stats.logpdf(1.0, 0.0, 4.0), *filterpy.discrete_bayes.predict([0.0, 1.0, 0.0], 1, [1.0])\n"
        "import scipy.stats\n"
        "print(found[0] - scipy.stats.norm(0.0, 2.0).logpdf(1.0), *found[1:], filterpy.stats.norm(1.0, 2.0).cdf(1.0))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    difference, *moved, half = map(float, run.stdout.splitlines()[-1].split())
    assert abs(difference) < 1e-12 and half == 0.5 and moved == [0.0, 0.0, 1.0]


def ended(tmp_path, number: int, module: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A command to which a signal comes as it imports a module."""
    code = (
        "import os, signal, sys\nfrom triline.nodes.cli import main\n"
        # where the tests run in the background of a shell, signals are ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "signal.signal(signal.SIGTERM, signal.SIG_DFL)\nsignal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "class Watch:\n"
        "    def find_spec(self, name, *_):\n"
        f"        if name == {module!r}:\n            os.kill(os.getpid(), {number})\n"
        f"sys.meta_path.insert(0, Watch())\nsys.exit(main({list(words)!r}))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        (signal.SIGINT, 1, "interrupted"),
        (signal.SIGTERM, 143, "ended by SIGTERM"),
        (signal.SIGHUP, 129, "ended by SIGHUP"),
    ],
)
def test_a_signal_while_a_command_is_loaded_ends_it_in_one_line(tmp_path, number, code, words):
    run = ended(tmp_path, number, "numpy", "process", "none.mcap", "-o", "out.mcap")
    assert (run.returncode, run.stdout, run.stderr) == (code, "", f"triline process: {words}\n")


def test_a_command_that_is_told_to_end_leaves_nothing(tmp_path):
    """The module is imported with the table half written."""
    words = ("export", str(ROOT / "recordings/strip.mcap"), "--topic", "sensor/gnss", "--csv", "gnss.csv")
    run = ended(tmp_path, signal.SIGTERM, "pandas", *words)
    assert (run.returncode, run.stdout, run.stderr) == (143, "", "triline export: ended by SIGTERM\n")
    assert not list(tmp_path.iterdir())


#: `triline` whose nodes are never through: the second process stays at work, and the first one waits for it.
NEVER_THROUGH = """import os, signal, sys, time
from multiprocessing.popen_fork import Popen
from triline.nodes.cli import main
from triline.nodes.recording import runner
runner._Line.finish = lambda line: time.sleep(3600)
launch = Popen._launch
def told_to_end_then(self, process):
    launch(self, process)
    os.kill(os.getpid(), signal.SIGTERM)
if sys.argv.pop(1) == "as it begins":
    Popen._launch = told_to_end_then
sys.exit(main())"""


@pytest.mark.parametrize("when", ["as it begins", "at work"])
def test_process_that_is_told_to_end_takes_its_second_process_along(tmp_path, when):
    flight = simulated_flight(60)
    words = ["process", str(flight), "-o", "out.mcap", "--processes", "2"]
    command = [sys.executable, "-c", NEVER_THROUGH, when, *words]
    program = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    if when == "at work":
        wait_for(lambda: len(list(tmp_path.glob("*.part"))) == 1, 20, "the beginning of the output")
        program.send_signal(signal.SIGTERM)
    _, err = program.communicate(timeout=20)
    assert program.returncode == 143 and err.splitlines()[-1] == "triline process: ended by SIGTERM"
    assert not list(tmp_path.iterdir())
    with pytest.raises(ProcessLookupError):
        os.killpg(program.pid, 0)


@pytest.mark.parametrize(
    ("words", "closed", "code"),
    [("info FILE", ">&-", 1), ("info FILE --json", ">&-", 1), ("info FILE", "2>&-", 0), ("info none", "2>&-", 1)],
)
def test_streams_that_the_shell_has_closed(words, closed, code):
    command = words.replace("FILE", "recordings/strip.mcap")
    line = f"{sys.executable} -m triline.nodes.cli {command} {closed}"
    run = subprocess.run(["sh", "-c", line], capture_output=True, text=True, cwd=ROOT)
    assert (run.returncode, run.stderr) == (code, "") and bool(run.stdout) == (code == 0)
