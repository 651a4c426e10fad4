"""A node of `triline process` whose work fails at a message: what came out is not told as whole."""

import json

import pytest
from places import ROOT

from triline.nodes.cli import main
from triline.nodes.navigator.navigator import Navigator


@pytest.fixture
def failing(monkeypatch):
    """A navigator that fails at two fixes, and has another problem after them."""
    step, seen = Navigator.step, []

    def fail(self, message):
        if message.topic == "sensor/gnss":
            seen.append(message)
            if len(seen) in (20, 30):
                raise IndexError("by design")
            if len(seen) == 40:
                self.problem("malformed", "another problem")
        return step(self, message)

    monkeypatch.setattr(Navigator, "step", fail)


@pytest.mark.parametrize("options", [[], ["-q"], ["--json"]])
def test_it_is_told_at_what_and_how_often(failing, options, tmp_path, capsys):
    strip, out = ROOT / "recordings" / "strip.mcap", tmp_path / "out.mcap"
    assert main(["process", str(strip), "-o", str(out), "--nodes", "navigator", *options]) == 0
    told = capsys.readouterr()
    line = (
        "navigator failed twice, its results are not complete; the first time at sensor/gnss 19: IndexError: by design"
    )
    (said,) = (text for text in told.err.splitlines() if not text.startswith("processing: "))  # on a busy machine
    assert said.startswith(f"triline process: {strip}: {line} (test_process_failed.py:")
    assert out.is_file()
    if "--json" in options:
        result = json.loads(told.out)
        assert list(result["failed"]) == ["navigator"] and result["counters"]["navigator"]["failed"] == 2
        assert result["problems"]["navigator"] == "another problem"
