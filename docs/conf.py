"""The documentation as a site: `make docs`. Nothing is fetched; references of commands and of Python are made here."""

from __future__ import annotations

import argparse
import io
import pkgutil
from contextlib import redirect_stdout
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).resolve().parent
MADE = HERE / "reference"

project = "triline"
author = "the authors of triline"
release = version = installed("triline")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
napoleon_google_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
default_role = "literal"
exclude_patterns = ["recordings.ipynb"]
# links to files of the repository, and anchors that only the source page has
suppress_warnings = ["myst.xref_missing", "ref.python", "docutils", "autodoc", "myst.header"]
html_theme = "pydata_sphinx_theme"
html_title = "triline"
html_theme_options = {"show_prev_next": False, "navigation_with_keys": False, "secondary_sidebar_items": ["page-toc"]}
html_show_sourcelink = False
html_copy_source = False
#: Rooms of the mathematics, as the reference lists them.
ROOMS = ("geometry", "orbit", "location", "sensitivity", "estimation", "camera", "models", "adjustment", "partitioned")
ROOMS += ("scene_adjustment", "window", "navigation", "matching", "orthoimage", "rectification", "simulation")


def commands_page() -> str:
    """One section a command: its help text, as the parser prints it."""
    from triline.nodes import cli

    parts = ["# Commands", "", "What `triline COMMAND --help` prints; generated from the parsers.", ""]
    for name in cli.COMMANDS:
        _, parser = cli._parser(name)
        assert parser is not None
        parts += [f"## triline {name}", "", "```text", _help(parser), "```", ""]
        for action in parser._actions:  # studies and keys have commands of their own
            if isinstance(action, argparse._SubParsersAction):
                for word, inner in action.choices.items():
                    parts += [f"### triline {name} {word}", "", "```text", _help(inner), "```", ""]
    return "\n".join(parts)


def _help(parser: argparse.ArgumentParser) -> str:
    out = io.StringIO()
    with redirect_stdout(out):
        parser.print_help()
    return out.getvalue().rstrip()


def python_pages() -> dict[str, str]:
    """Name of a page -> its text: one page a room of the solver, and one for recordings."""
    import triline.solver

    head = "Recordings\n==========\n\n.. autofunction:: triline.open\n\n"
    pages = {"recordings": head + _module("triline.nodes.recording.access", "")}
    base = Path(triline.solver.__path__[0])
    for room in ROOMS:
        name = f"triline.solver.{room}"
        modules = [m.name for m in pkgutil.walk_packages([str(base / room)], f"{name}.") if not m.ispkg]
        title = f"triline.solver.{room}"
        text = f"{title}\n{'=' * len(title)}\n\n.. automodule:: {name}\n\n"
        pages[room] = text + "".join(_module(m, "-") for m in modules)
    return pages


def _module(name: str, line: str) -> str:
    head = f"{name}\n{line * len(name)}\n\n" if line else ""
    return f"{head}.. automodule:: {name}\n   :members:\n\n"


def write_reference() -> None:
    (MADE / "python").mkdir(parents=True, exist_ok=True)
    texts = {MADE / "commands.md": commands_page()}
    pages = python_pages()
    texts |= {MADE / "python" / f"{name}.rst": text for name, text in pages.items()}
    toc = "".join(f"   {name}\n" for name in pages)
    title = "Python interface\n================\n\nFrom the docstrings. Conventions: ``triline.solver``.\n\n"
    conventions = ".. automodule:: triline.solver\n\n"
    texts[MADE / "python" / "index.rst"] = f"{title}{conventions}.. toctree::\n\n{toc}"
    for path, text in texts.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: object) -> None:
    write_reference()
