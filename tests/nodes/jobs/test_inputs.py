"""Which recordings the words of a command line name, and what the folders of their results are called."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from triline.nodes.cli import main
from triline.nodes.errors import UserError
from triline.nodes.jobs.inputs import flown_twice, sources

OUT = Path("results")


@pytest.fixture
def season(tmp_path, monkeypatch):
    """Two days with a flight of the same name, and what is no recording."""
    monkeypatch.chdir(tmp_path)
    for name in ("s/day1/flight.mcap", "s/day2/flight.mcap", "s/first.mcap", "s/.trash/old.mcap", "s/notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path


def names(*inputs: str, out: Path = OUT) -> list[str]:
    return [source.name for source in sources(inputs, out)]


def test_a_folder_gives_all_below_it_by_their_place(season):
    assert names("s") == ["day1/flight", "day2/flight", "first"]


def test_a_pattern_names_from_its_first_wildcard_on(season):
    assert names("s/*/flight.mcap") == ["day1/flight", "day2/flight"]
    assert names("s/day?/*.mcap", "s/first.mcap") == ["day1/flight", "day2/flight", "first"]


def test_files_of_one_name_are_told_apart_by_their_folders(season):
    assert names("s/day1/flight.mcap") == ["flight"]
    assert names("s/day1/flight.mcap", "s/day2/flight.mcap", "s/first.mcap") == ["day1/flight", "day2/flight", "first"]


def test_each_recording_is_taken_once(season):
    assert names("s/first.mcap", "s", "s/*.mcap") == ["first", "day1/flight", "day2/flight"]


def test_a_list_has_one_a_line(season):
    (season / "list").write_text("# two of them\ns/first.mcap\n\n  s/day1/flight.mcap\n")
    assert names("@list") == ["first", "flight"]


def test_results_are_no_input(season):
    for name in ("s/out/first/processed.mcap", "s/earlier/first/processed.mcap", "s/mine/processed.mcap"):
        (season / name).parent.mkdir(parents=True, exist_ok=True)
        (season / name).write_bytes(b"x")
    (season / "s/earlier/first/process.done.json").write_text("{}")
    found = names("s", out=Path("s/out"))
    assert found == ["day1/flight", "day2/flight", "first", "mine/processed"]
    assert names("s/earlier/*/processed.mcap") == ["first/processed"], "what is named itself is taken"


def test_size_and_time_of_the_file_are_known(season):
    os.utime("s/first.mcap", ns=(5, 7_000_000_001))
    (source,) = sources(["s/first.mcap"], OUT)
    assert (source.path, source.size, source.modified) == (str(season / "s/first.mcap"), 12, "7000000001")


@pytest.mark.parametrize(
    ("word", "told"),
    [("none", "none: no such file or folder"), ("s/x*.mcap", "no recording"), ("empty", "no recording (.mcap) there")],
)
def test_what_names_nothing_is_refused(season, word, told):
    (season / "empty").mkdir()
    with pytest.raises(UserError, match=told.replace("(", r"\(").replace(")", r"\)")):
        sources([word], OUT)


@pytest.mark.parametrize("word", ["s", "s/*.mcap"])
def test_inputs_that_are_the_folder_of_results_are_told(season, word):
    """A folder was said to have no recording, and a pattern ended with 0 after no job."""
    with pytest.raises(UserError, match=r"no recording \(.mcap\) there; what lies in s, the folder of res"):
        sources([word], Path("s"))


def test_a_store_is_listed_by_the_same_rules(season):
    url = f"file://{season}/s"
    found = sources([url], OUT)
    assert [source.name for source in found] == [".trash/old", "day1/flight", "day2/flight", "first"]
    assert found[-1].path == f"{url}/first.mcap"
    assert found[-1].size == 12
    assert float(found[-1].modified) == pytest.approx(os.stat("s/first.mcap").st_mtime)
    assert names(f"{url}/day*/flight.mcap") == ["day1/flight", "day2/flight"]
    assert names(f"{url}/first.mcap") == ["first"]
    with pytest.raises(UserError, match="no such file in the store"):
        sources([f"{url}/none"], OUT)


def test_names_of_a_store_lead_nowhere_else(season):
    import fsspec

    store = fsspec.filesystem("memory")
    for name in ("/b/x/../../../etc/evil.mcap", "/b/a<b>.mcap", "/b/plain.mcap"):
        store.store[name] = store._open(name, "wb")
    try:
        found = [source.name for source in sources(["memory://b"], OUT)]
    finally:
        store.store.clear()
    assert found == ["a_b_", "plain", "x/__/__/__/etc/evil"]


def test_a_recording_with_its_ending_in_capitals_is_taken(season):
    """Memory cards have such names; a folder was done without it, and nothing said so."""
    Path("s/day1/LAST.MCAP").write_bytes(b"x")
    assert names("s") == ["day1/LAST", "day1/flight", "day2/flight", "first"]
    assert "day1/LAST" in names(f"file://{season}/s")


def test_names_that_are_alike_stay_and_are_apart(season):
    """Parentheses, as browsers put them behind a name, became underscores."""
    for name in ("s/a-1.mcap", "s/a_1.mcap", "s/a 1.mcap", "s/a (1).mcap"):
        Path(name).write_bytes(b"x")
    assert names("s/a*.mcap") == ["a (1)", "a 1", "a-1", "a_1"]


def test_two_that_would_share_a_folder_are_refused(season):
    for name in ("s/a?.mcap", "s/a!.mcap"):
        Path(name).write_bytes(b"x")
    with pytest.raises(UserError, match="would have the folder a_"):
        sources(["s"], OUT)


def test_a_flight_beside_what_was_processed_of_it_is_told(flown, adjustable, tmp_path, monkeypatch, capsys):
    """It counted twice in the tables over all flights, without a word."""
    monkeypatch.chdir(tmp_path)
    plan = ("--seconds", "8", "--lead-in", "1", "--lead-out", "0.5", "--seed", "3", "--attitude-rate", "50")
    assert main(["simulate", "-o", "other.mcap", *plan, "-q"]) == 0  # as many messages, at the same times
    os.link(flown, "raw.mcap")
    os.link(adjustable, "done.mcap")
    Path("empty.mcap").write_bytes(b"")
    Path("cut.mcap").write_bytes(flown.read_bytes()[:-20])
    same = "holds the same sensor data as"
    twice = [f"{Path('raw.mcap').resolve()} {same} {Path('done.mcap').resolve()}: if they are one flight, as recorded "
             "and as processed, it counts twice"]  # fmt: skip
    assert flown_twice(sources(["."], OUT)) == twice
    assert flown_twice(sources(["raw.mcap", "other.mcap"], OUT)) == []
    capsys.readouterr()
    assert main(["batch", ".", "-o", "out", "--list"]) == 0
    assert capsys.readouterr().err == f"triline batch: note: {twice[0]}\n"
    assert main(["batch", ".", "-o", "out", "--list", "-q"]) == 0
    assert capsys.readouterr().err == ""
