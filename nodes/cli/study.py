"""``triline study``: studies, one module each."""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from .common_options import add_common

#: study -> (module beside this one, one line of help); a module has EXAMPLE, add_arguments(parser) and run(args),
#: and WANTS_INPUT where it needs data of the user.
STUDIES: dict[str, tuple[str, str]] = {
    "testfields": ("study_testfields", "published errors beside sigmas and simulated errors of the same networks"),
    "online": ("study_online", "the demo flight with many seeds through the on-line nodes, against truth"),
    "matching": ("study_matching", "tie points from image lines alone, held against truth"),
    "ties": ("study_ties", "what an adjustment makes of matched tie points, beside simulated ones of the same noise"),
    "starts": ("study_starts", "flights whose orientation is wrong by 30 px, in one direction after another"),
    "misspecified": ("study_misspecified", "flights whose true errors are not as stated, on line beside the batch"),
    "control": (
        "study_control",
        "a block of your own: numbers of control points and models, held against check points",
    ),
    "sensitivity": ("study_sensitivity", "which parameter a located pixel owes its error to, by four methods"),
    "scenes": ("study_scenes", "whether errors of adjusted satellite scenes are as large as their sigmas say"),
    "rectification": ("study_rectification", "transforms of the plane, RPC and the differential method, compared"),
    "regularisation": ("study_regularisation", "nine control pixels: condition and error, published table beside ours"),
    "consistency": ("study_consistency", "whether errors of adjusted blocks are as large as their sigmas say"),
}

EXAMPLE = "triline study testfields --seeds 10"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    subparsers = parser.add_subparsers(dest="study", metavar="STUDY", required=True)
    for name, (module_name, text) in STUDIES.items():
        module = _load(module_name)
        sub = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.formatter_class = argparse.RawDescriptionHelpFormatter
        sub.epilog = f"example:\n  {module.EXAMPLE}"
        module.add_arguments(sub)
        sub.set_defaults(run_study=module.run)
        add_common(sub, again=True)
    sub = subparsers.add_parser("all", help="all that need no data, one after another, with their defaults")
    sub.set_defaults(run_study=_run_all)
    add_common(sub, again=True)


def _load(module_name: str) -> Any:
    return importlib.import_module(f".{module_name}", __package__)


def run(args: argparse.Namespace) -> int:
    return args.run_study(args)


def _run_all(args: argparse.Namespace) -> int:
    """Every study with its own defaults; with ``--json`` one document after another."""
    code = 0
    for name, (module_name, text) in STUDIES.items():
        module = _load(module_name)
        if getattr(module, "WANTS_INPUT", False):
            continue
        parser = argparse.ArgumentParser()
        module.add_arguments(parser)
        if not args.json:
            print(f"== {name}: {text}", flush=True)
        common = argparse.Namespace(json=args.json, quiet=args.quiet, verbose=args.verbose)
        code = max(code, module.run(parser.parse_args([], common)))
        if not args.json:
            print()
    return code
