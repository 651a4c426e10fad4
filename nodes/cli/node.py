"""``triline node``: one node alone."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path
from typing import Any

from .. import registry
from ..bus.live import BusRunner
from ..bus.program import ProgramOptions, stop_on_signals, stop_with_parent
from ..config import Tables, build, load
from ..errors import UserError
from ..formats.json_text import json_text
from ..garbage_collection import RareCollections
from ..last_problems import in_words
from ..node import Node
from ..terminal import plain
from .bus_options import add_bus_arguments, bus_of, reporter

EXAMPLE = "triline node adjuster --config adjuster.toml --platform aircraft1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=registry.names(), metavar="NAME", help=", ".join(registry.names()))
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file with one table a node")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one key of the node's table (repeatable)"
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="what the recorder writes; short for --set output=FILE")
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    if args.json and args.name == "monitor":
        raise UserError("node monitor --json: its screen is for people, wanted `triline monitor --json --seconds N`")
    tables = _tables(args)
    said: list[str] = []
    show = reporter(args.quiet or args.json)

    def report(text: str) -> None:
        said.append(plain(text))
        show(text)

    options = ProgramOptions(args.name, bus_file=args.bus, tables=tables, report=report, **bus_of(args))
    stop_on_signals(options.stop)
    stop_with_parent(options.stop)
    if args.name in registry.PROGRAMS:
        code = registry.program(args.name)(options)
    else:
        code = run_on_bus(build(registry.node_class(args.name), tables, args.name), options)
    if args.json:
        print(json_text({"node": args.name, "platform": options.platform, "said": said}))
    return code


def run_on_bus(node: Node, options: ProgramOptions) -> int:
    """Run a step node until it is told to stop."""
    with options.open_bus() as bus:
        runner = BusRunner(node, bus, options.report, stop=options.stop, collections=RareCollections())
        options.report(f"{node.name} on platform {options.platform}")
        url = getattr(node, "url", None)
        if url:
            options.report(f"{node.name} at {url}")
        runner.run()
    counted = ", ".join(f"{n} {kind}" for kind, n in sorted(node.counters.items()))
    last = in_words(node.counters, node.last_problems)
    options.report("; ".join(filter(None, (f"{node.name} stopped", counted, last))))
    return 0


def _tables(args: argparse.Namespace) -> Tables:
    tables = load(args.config, registry.names())
    settings = list(args.set)
    table: dict[str, Any] = dict(tables.get(args.name, {}))
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise UserError(f"--set {setting}: wanted KEY=VALUE")
        table[key.strip()] = _value(text)
    if args.output:
        table["output"] = args.output
    return {**tables, args.name: table} if table else tables


def _value(text: str) -> Any:
    """A TOML value, or the text as it is."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # no TOML, or more of it than can be read
        return text
