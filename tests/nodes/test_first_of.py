"""Lists of names in messages."""

from triline.nodes.first_of import first_of


def test_no_more_than_so_many_are_named():
    assert first_of([], 2) == "" and first_of(["a"], 2) == "a" and first_of(["a", "b"], 2) == "a, b"
    assert (
        first_of(["a", "b", "c", "d"], 2) == "a, b and 2 more"
        and first_of(["a", "b", "c"], 2, "; ") == "a; b and 1 more"
    )
