"""What a command imports before it works, which says without a clock how long people wait for help and errors."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
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
