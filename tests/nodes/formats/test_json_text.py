"""What commands print with --json: a document that every reader of JSON takes."""

import json
import math

import numpy as np
import pytest

from triline.nodes.cli import main, study_matching
from triline.nodes.formats.json_text import json_text


def refuse(word):
    raise AssertionError(f"{word} is no JSON")


def test_numbers_that_json_does_not_have_become_null():
    value = {
        1: (math.nan, np.float64(-np.inf), np.float32(0.5)),
        "counts": np.array([[1, 2], [3, 4]]),
        "met": np.bool_(True),
        "none": None,
    }
    read = json.loads(json_text(value), parse_constant=refuse)
    assert read == {"1": [None, None, 0.5], "counts": [[1, 2], [3, 4]], "met": True, "none": None}
    assert "\n" not in json_text(value, indent=None)


def test_a_study_whose_figures_are_not_known_prints_json(monkeypatch, capsys):
    """A flight without a good tie point has a mean of nothing."""
    quality = {"ties": 3, "rays": 6, "good": 0.0, "wrong": 1.0, "sigma_px": math.nan, "normalised": [math.nan] * 2,
               "common": {}}  # fmt: skip
    monkeypatch.setattr(study_matching, "fly", lambda settings: quality)
    assert main(["study", "matching", "--plain", "--seeds", "1", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert row["sigma_px"] is None and row["ties"] == 3


@pytest.mark.parametrize("what", [object(), {1, 2}])
def test_what_is_no_value_is_a_fault(what):
    with pytest.raises(TypeError):
        json_text({"x": what})
