"""The command ``triline``: one file a sub-command, loaded when it is called."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from contextlib import nullcontext
from typing import Any

from ..errors import UserError
from ..terminal import clean_streams, plain
from .common_options import add_common
from .ending import EndedBySignal, ended_by_signals
from .outputs import refuse_empty_words, refuse_input_as_output

#: Longest reason that is printed, characters.
LONGEST_LINE = 1000

#: command -> (module, one line of help); a module has EXAMPLE, add_arguments(parser) and run(args) -> exit code.
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "the live on-line triangulation demo"),
    "fly": ("fly", "the live system on real sensors, from a flight folder"),
    "simulate": ("simulate", "a flight recording with truth, from a seed"),
    "node": ("node", "one node alone, for running across machines"),
    "monitor": ("monitor", "health of a platform, or of all aircraft of a fleet"),
    "confirm": ("confirm", "confirm or reject a signalised point in a running system"),
    "keys": ("keys", "certificates and access lists for encrypted platforms"),
    "replay": ("replay", "play a recording onto the bus with its timing"),
    "process": ("process", "the same nodes over a recording, as fast as it goes"),
    "adjust": ("adjust", "batch adjustment of a recording or a block folder"),
    "navigate": ("navigate", "GNSS/inertial filter and smoother over a recording or a sensor folder"),
    "batch": ("batch", "many recordings through process, adjust, navigate, rectify and analyze, on several workers"),
    "analyze": ("analyze", "offline analysis: one self-contained HTML report"),
    "info": ("info", "what a recording holds"),
    "new": ("new", "a commented flight folder to fill in"),
    "check": ("check", "whether a recording is whole, or what a flight folder lacks"),
    "recover": ("recover", "a valid recording from a broken one, or from the parts of a flight"),
    "export": ("export", "topics to CSV, Parquet, GeoJSON/GeoPackage, SBET"),
    "import": ("import_", "flight folder, poses, sensors, image lines and others to a recording"),
    "match": ("match", "tie points between the images of a block of satellite scenes"),
    "locate": ("locate", "pixels to the ground and back, by any sensor or RPC"),
    "rectify": ("rectify", "image lines to an orthoimage, a cloud-optimised GeoTIFF"),
    "study": ("study", "Monte Carlo and sensitivity studies"),
    "view": ("view", "open a recording in Rerun"),
}


def parse(argv: list[str]) -> argparse.Namespace:
    """Parse the words behind ``triline``; an unknown option is reported with the usage of its command."""
    command = _command(argv)
    # where a command comes first nothing lists the others, whose parsers take longest
    comes_first = command in COMMANDS and argv[0] == command
    parser, subparser = _parser(command, [command] if comes_first else list(COMMANDS))
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        (subparser or parser).error(f"unrecognized arguments: {' '.join(unknown)}")
    return args


def _command(argv: list[str]) -> str:
    return next((word for word in argv if not word.startswith("-")), "")


def _parser(command: str, names: list[str]) -> tuple[argparse.ArgumentParser, argparse.ArgumentParser | None]:
    """The parser of commands by name, and that of the one that was given, which alone has its options."""
    chosen = None
    parser = argparse.ArgumentParser(
        prog="triline",
        description="On-line triangulation for line-scanner (pushbroom) cameras.",
        epilog="'triline COMMAND --help' shows the options of a command and an example.",
    )
    if names != [command]:
        parser.add_argument("--version", action="version", version=_version())
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in names:
        module_name, text = COMMANDS[name]
        sub = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.formatter_class = argparse.RawDescriptionHelpFormatter
        if name == command:
            module = _load(module_name)
            module.add_arguments(sub)
            sub.epilog = f"example:\n  {module.EXAMPLE}"
            sub.set_defaults(run=module.run)
            add_common(sub)
            chosen = sub
    return parser, chosen


def _load(module_name: str) -> Any:
    return importlib.import_module(f".{module_name}", __package__)


def _version() -> str:
    from importlib.metadata import version

    return f"triline {version('triline')}"


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns 0, 1 (work failed: one line on standard error), 2 (usage) or 128 + a signal."""
    # One thread a process, before NumPy is loaded: sums come out the same in all nodes, and matrices are small.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    job = bool(os.environ.pop("TRILINE_JOB", ""))
    if job:
        from ..jobs.work import end_with_parent

        end_with_parent()
    with clean_streams(), nullcontext() if job else ended_by_signals():  # of a job its worker cleans up
        return _run(sys.argv[1:] if argv is None else argv, job)


def _tell_fetched() -> None:
    """Say what was fetched of recordings elsewhere."""
    remote = sys.modules.get("triline.nodes.recording.remote")
    for file in () if remote is None else remote.OPENED:
        print(file, file=sys.stderr)


def _run(argv: list[str], job: bool) -> int:
    name, verbose = f"triline {_command(argv)}", False
    try:
        args = parse(argv)
        verbose = getattr(args, "verbose", False)
        refuse_empty_words(argv)
        refuse_input_as_output(args)
        code = args.run(args)
        if job or verbose:
            _tell_fetched()
        return code
    except UserError as error:
        print(f"{name}: {plain(error, LONGEST_LINE)}", file=sys.stderr)
    except FileNotFoundError as error:
        print(f"{name}: {error.filename}: no such file or folder", file=sys.stderr)
    except IsADirectoryError as error:
        print(f"{name}: {error.filename}: is a folder, wanted a file", file=sys.stderr)
    except (PermissionError, NotADirectoryError) as error:
        print(f"{name}: {error.filename}: {(error.strerror or '').lower()}", file=sys.stderr)
    except MemoryError as error:
        print(f"{name}: not enough memory: {str(error) or 'out of memory'}", file=sys.stderr)
    except BrokenPipeError:  # the program that reads our output has ended, as in `triline info F | head`
        sys.stderr.close()
    except EndedBySignal as ended:
        print(f"{name}: ended by {signal.Signals(ended.number).name}", file=sys.stderr)
        return 128 + ended.number
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
    except OSError as error:  # a full disk, most often
        where = f"{error.filename}: " if error.filename else ""
        print(f"{name}: {where}{(error.strerror or str(error)).lower()}", file=sys.stderr)
    except Exception as error:  # a fault of the program; -v shows where
        # a place outside the area of a CRS comes from the input; who raises it has loaded the module
        frames = sys.modules.get("triline.solver.geometry.frames")
        if frames is not None and isinstance(error, frames.CrsError):
            print(f"{name}: {plain(error, LONGEST_LINE)}", file=sys.stderr)
            return 1
        if "Cannot find proj.db" in str(error):  # GDAL's PROJ takes one folder, where that of pyproj takes several
            said = os.environ.get("PROJ_DATA") or os.environ.get("PROJ_LIB") or "not set"
            print(f"{name}: no proj.db in PROJ_DATA ({said}): wanted one folder that has it, or none", file=sys.stderr)
            return 1
        if verbose:
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())
        told = f"fault in triline, please report it (-v shows where): {plain(what, 300)}"
        print(f"{name}: {told}", file=sys.stderr)
    return 1
