"""Every benchmark has its place in docs/, with the command that stands in bench/run.py, and every program is run."""

import importlib
import importlib.util
import sys

import pytest
from places import ROOT

BENCH, DOCS = ROOT / "bench", ROOT / "docs"
#: Files of bench/ that other programs import and nobody runs.
MODULES = {
    "constants_flights.py",
    "fault_flights.py",
    "frame.py",
    "packet_link.py",
    "run.py",
    "tcp_link.py",
    "tie_latency_computed.py",
}


@pytest.fixture(scope="module")
def run():
    sys.path.insert(0, str(BENCH))
    try:
        spec = importlib.util.spec_from_file_location("bench_run", BENCH / "run.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCH))
    return module


def found(run, name):
    """What stands in the blocks of a name, on all pages."""
    texts = [page.read_text(encoding="utf-8") for page in DOCS.glob("*.md")]
    return [match.group(0) for text in texts for match in run.block(name).finditer(text)]


def test_every_benchmark_has_one_block_and_its_commands_stand_in_it(run):
    for benchmark in run.BENCHMARKS:
        (block,) = found(run, benchmark.name)
        commands = [line[2:] for line in block.splitlines() if line.startswith("$ ")]
        assert commands in ([], list(benchmark.commands)), benchmark.name


def test_the_list_of_benchmarks_is_the_one_in_the_docs(run):
    (block,) = found(run, "list")
    assert block.splitlines()[1:-1] == run.overview()


def test_every_program_is_run_by_some_benchmark(run):
    programs = {run.program_of(command) for b in run.BENCHMARKS for command in b.commands}
    assert {path.name for path in BENCH.glob("*.py")} - MODULES == {p for p in programs if p.endswith(".py")}


def test_a_block_is_filled_and_the_page_around_it_stays(run, tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- bench one -->\nold\n<!-- end -->\nafter <!-- bench two -->\n")
    monkeypatch.setattr(run, "DOCS", tmp_path)
    run.fill("one", [r"new \1 line"])
    assert page.read_text() == "before\n<!-- bench one -->\nnew \\1 line\n<!-- end -->\nafter <!-- bench two -->\n"
    with pytest.raises(LookupError, match="three"):
        run.fill("three", [])


@pytest.mark.parametrize(("code", "written", "good"), [(0, True, True), (3, True, False), (1, False, False)])
def test_a_failed_program_leaves_its_block(run, tmp_path, monkeypatch, code, written, good):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench one -->\nold\n<!-- end -->\n")
    (tmp_path / "program.py").write_text(f"print('said')\nraise SystemExit({code})\n")
    monkeypatch.setattr(run, "DOCS", tmp_path)
    monkeypatch.setattr(run, "ROOT", tmp_path)
    assert run.run(run.Benchmark("one", "?", ("python program.py",), 1)) is good
    assert ("$ python program.py\nsaid\n" in page.read_text()) is written
    assert ("old" in page.read_text()) is not written


@pytest.mark.parametrize("program", sorted({path.stem for path in BENCH.glob("*.py")} - {"run"}))
def test_what_a_program_imports_exists(program, monkeypatch):
    for extra in {
        "bus_load": ["psutil"],
        "demo_cores": ["psutil"],
        "matcher_live": ["psutil"],
        "matcher": ["psutil", "cv2"],
    }.get(program, []):
        pytest.importorskip(extra, reason="of the extra `bench`")
    monkeypatch.syspath_prepend(str(BENCH))
    assert importlib.import_module(program).__doc__
