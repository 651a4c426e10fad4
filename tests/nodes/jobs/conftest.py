"""What tests of jobs share: one flight, which is made once a process."""

import pytest

from triline.nodes.cli import main


@pytest.fixture(scope="session")
def flown(tmp_path_factory):
    """A short flight."""
    path = tmp_path_factory.mktemp("flown") / "flown.mcap"
    plan = ("--seconds", "8", "--lead-in", "1", "--lead-out", "0.5", "--seed", "2", "--attitude-rate", "50")
    assert main(["simulate", "-o", str(path), *plan, "-q"]) == 0
    return path


@pytest.fixture(scope="session")
def adjustable(flown):
    """The same, with a trajectory."""
    path = flown.with_name("adjustable.mcap")
    assert main(["process", str(flown), "-o", str(path), "-q"]) == 0
    return path
