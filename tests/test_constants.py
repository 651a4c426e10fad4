"""The page of constants is what the code says, and the program that changes a constant changes it everywhere."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[1] / "bench"


@pytest.fixture(scope="module")
def constants():
    sys.path.insert(0, str(BENCH))
    try:
        yield importlib.import_module("constants")
    finally:
        sys.path.remove(str(BENCH))


@pytest.fixture(scope="module")
def among(constants):
    """All constants, read once."""
    return tuple(constants.constants())


def test_the_page_is_up_to_date(constants, among):
    fresh = constants.page_with(constants.tables(among))
    assert constants.PAGE.read_text(encoding="utf-8") == fresh, "run: python bench/constants.py table"


def test_every_constant_is_found_by_the_name_in_the_table(constants, among):
    assert constants.chosen([constants.label(c, among) for c in among], among) == list(among)


def test_constants_of_navigation_and_matching_say_what_they_are(among):
    silent = [f"{c.path}: {c.name}" for c in among if c.room != "window" and not c.comment]
    assert not silent


def test_a_name_that_several_have_needs_its_module(constants, among):
    with pytest.raises(LookupError, match=r"KEPT_S is one of .*current_orientation\.KEPT_S"):
        constants.chosen(["KEPT_S"], among)
    with pytest.raises(LookupError, match="no constant NONE_SUCH"):
        constants.chosen(["NONE_SUCH"], among)


SOURCE = """
#: Waits so long, s. Tuned.
WAIT = 2.0
#: Half sides, px: of one and the other.
ONE, OTHER = 3, 4
TWICE = 2 * ONE
#: Probability that a good one fails.
FALSE = 1e-3

#: Names.
NAMES = ("a", "b")
EYE = np.eye(3)
TABLE = {WAIT: 0.5}
lower = 3.0
"""


def test_what_is_read_of_a_module(constants):
    found = {c.name: c for c in constants.read("window", "solver/window/x.py", SOURCE)}
    rows = {name: (c.value, c.unit, c.why) for name, c in found.items()}
    assert rows == {
        "WAIT": ("2.0", "s", "tuned"),
        "ONE": ("3", "px", "tuned"),
        "OTHER": ("4", "px", "tuned"),
        "TWICE": ("2 * ONE", "px", "derived"),
        "FALSE": ("1e-3", "", "statistical level"),
        "TABLE": ("{WAIT: 0.5}", "", "tuned"),
    }


@pytest.mark.parametrize(
    ("value", "factor", "becomes"),
    [
        ("3.0", 2.0, 6.0),
        ("5", 0.5, 2),
        ("1", 0.5, 1),
        ("(6, 10.0)", 2.0, (12, 20.0)),
        ("{1: 0.5}", 2.0, {1: 1.0}),
        ("dict(alpha=0.5)", 0.5, {"alpha": 0.25}),
    ],
)
def test_a_value_times_a_factor(constants, value, factor, becomes):
    changed = constants._times(ast.parse(value, mode="eval").body, factor)
    found = eval(ast.unparse(changed))
    assert found == becomes
    assert type(found) is type(becomes)


def test_a_change_reaches_what_is_computed_from_it_and_who_imports_it():
    """In a process of its own, since modules are imported once."""
    program = """
import sys
import constants
for module, name, factor in (("matching.prediction", "PAD", 2.0), ("adjustment.reliability", "CRITICAL_W", 0.5)):
    change = constants.Change(f"triline.solver.{module}", name, factor)
    sys.meta_path.insert(0, constants.ChangedModule(change))
from triline.solver.matching import prediction
from triline.solver.window import results
print(prediction.PAD, prediction.WIDE, results.CRITICAL_W, results.WindowOptions().critical)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=BENCH, check=True)
    assert done.stdout.split() == ["48", "336", "1.645", "1.645"]
