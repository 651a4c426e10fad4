"""The reference that `make docs` writes leaves out no room of the mathematics."""

import runpy

from places import ROOT


def test_every_room_of_the_solver_has_a_page():
    rooms = runpy.run_path(str(ROOT / "docs" / "conf.py"))["ROOMS"]
    assert sorted(rooms) == sorted(path.parent.name for path in (ROOT / "solver").glob("*/__init__.py"))
