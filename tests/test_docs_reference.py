"""The reference that `make docs` writes has all rooms of the mathematics; words of the literature lead somewhere."""

import re
import runpy

from places import ROOT

from triline.nodes.cli import main
from triline.nodes.cli.study import STUDIES


def test_every_room_of_the_solver_has_a_page():
    rooms = runpy.run_path(str(ROOT / "docs" / "conf.py"))["ROOMS"]
    assert sorted(rooms) == sorted(path.parent.name for path in (ROOT / "solver").glob("*/__init__.py"))


def test_options_and_studies_of_the_literature_are_there(capsys):
    text = (ROOT / "docs" / "literature.md").read_text()
    there = ""
    for command in ("adjust", "rectify", "locate", "simulate"):
        try:
            main([command, "--help"])
        except SystemExit:
            there += capsys.readouterr().out
    options, studies = set(re.findall(r"`.*?(--[a-z-]+)", text)), set(re.findall(r"`triline study ([a-z]+)`", text))
    assert len(options) > 12 and all(re.search(rf"{option}\b", there) for option in options), options
    assert len(studies) > 4 and studies <= set(STUDIES)
