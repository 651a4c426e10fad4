"""Constants of window, navigation and matching: what they are and why, and what half and double the value changes.

    python bench/constants.py table
    python bench/constants.py effect NAME ... [--room window] [--processes 1]
    python bench/constants.py effect --all --room window

*table* reads the code and writes the tables of ``docs/constants.md``. A constant is a number, or several, that a module
names in capitals. The comment above it (``#:``) says what it is, its unit and why it has its value; constants in lines
that follow each other share one. A name that ends in ``_S``, ``_PX``, ``_M`` ... tells the unit, else the comment does
(", s," or ", px:"). The comment says "tuned", "derived" (also: "rounding", "definition") or "statistical level" (also:
"probability", "risk", "chi-square"); a value that is computed from other constants is derived, and whatever says
nothing counts as tuned.

*effect* flies a few short flights in a process of their own, with the constant as it is, at half and at double. The
factor is put into the source of its module before anything is imported, so that it also reaches what is computed from
the constant, default arguments, and modules that import it. *Room* chooses the flights; by default they are those of
the room that the constant belongs to. Columns: RMSE over that with the constants as they are, mean over components;
NEES of the same (1 expected); counts; processor time, over that with the constants as they are.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import multiprocessing
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any

import frame

if TYPE_CHECKING:
    from constants_flights import Outcome

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "constants.md"
#: Files of a room; those of the adjustment are the ones that the window shares with the batch.
ROOMS = {
    "window": (
        "solver/window/**/*.py",
        "solver/adjustment/drift_hypotheses.py",
        "solver/adjustment/bias_search.py",
        "solver/adjustment/frontal.py",
        "solver/adjustment/growing_normals.py",
        "solver/adjustment/pose_noise.py",
        "solver/adjustment/protection.py",
    ),
    "navigation": ("solver/navigation/*.py",),
    "matching": ("solver/matching/*.py",),
}
FACTORS = (0.5, 2.0)
CAPITALS = re.compile(r"_?[A-Z][A-Z0-9_]+")
TUNED, DERIVED, LEVEL = "tuned", "derived", "statistical level"
#: What a comment says about why, the first that is found.
REASONS = (
    (TUNED, r"\btuned\b"),
    (LEVEL, r"\bstatistical level\b|\bprobability\b|\brisk\b|\bchi-square\b"),
    (DERIVED, r"\bderived\b|\brounding\b|\bdefinition\b"),
)
SUFFIXES = {"_M_S": "m/s", "_S": "s", "_PX": "px", "_M": "m", "_DEG": "deg", "_HZ": "Hz", "_BYTES": "bytes"}
UNITS = (
    ("floating point operations", "operations"),
    ("rad, and m for each metre", "rad; m/m"),
    *((rf"[,(] {unit}\b(?=[,.:;) ]|$)", unit) for unit in ("m/s", "rad", "px", "deg", "samples", "lines", "m", "s")),
    (r"^Rays\b", "rays"),
)
#: The unit of several constants in one line, as in "half sides, px: of ...".
COMMON_UNIT = re.compile(r"^[^,:;]+, [a-z/]+: |floating point operations")


@dataclass(frozen=True)
class Constant:
    """A constant as the code has it.

    Attributes
    ----------
    room : see `ROOMS`
    path : of the module, below the root
    name, value : as they stand there
    comment : in one line; empty where there is none
    together : whether one line gives it and others their values, so that one comment is about all of them
    computed : whether the value refers to other constants
    """

    room: str
    path: str
    name: str
    value: str
    comment: str
    together: bool
    computed: bool

    @property
    def module(self) -> str:
        return "triline." + self.path.removesuffix(".py").replace("/", ".")

    @property
    def unit(self) -> str:
        """Empty for a count or a ratio."""
        ending = next((unit for end, unit in SUFFIXES.items() if self.name.endswith(end)), "")
        if ending or (self.together and not COMMON_UNIT.search(self.comment)):
            return ending
        return next((unit for pattern, unit in UNITS if re.search(pattern, self.comment)), "")

    @property
    def why(self) -> str:
        said = next((reason for reason, pattern in REASONS if re.search(pattern, self.comment, re.IGNORECASE)), "")
        return said or (DERIVED if self.computed else TUNED)


def constants() -> list[Constant]:
    """All of them, by room and file."""
    return [
        constant
        for room, patterns in ROOMS.items()
        for pattern in patterns
        for path in sorted(ROOT.glob(pattern))
        for constant in read(room, path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    ]


def read(room: str, path: str, text: str) -> Iterator[Constant]:
    """Constants of one module."""
    lines = text.splitlines()
    comment, before = "", 0
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        above = _comment_above(lines, node.lineno)
        comment = above or (comment if node.lineno == before + 1 else "")
        before = node.end_lineno or node.lineno
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        pairs = list(_assigned(target, node.value))
        for name, value in pairs:
            if CAPITALS.fullmatch(name) and _is_number(value):
                text_of = " ".join(_segment(lines, value).split())
                yield Constant(room, path, name, text_of, comment, len(pairs) > 1, _refers(value))


def _segment(lines: Sequence[str], node: ast.expr) -> str:
    """The source of an expression, as `ast.get_source_segment`, which splits the whole module anew for each."""
    last = node.end_lineno or node.lineno
    chosen = [line.encode() for line in lines[node.lineno - 1 : last]]
    chosen[-1] = chosen[-1][: node.end_col_offset]
    chosen[0] = chosen[0][node.col_offset :]
    return b"\n".join(chosen).decode()


def _comment_above(lines: Sequence[str], lineno: int) -> str:
    first = lineno - 1
    while first and lines[first - 1].startswith("#:"):
        first -= 1
    return " ".join(line.removeprefix("#:").strip() for line in lines[first : lineno - 1])


def _assigned(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Names and their values, also of ``A, B = 1, 2``."""
    if isinstance(target, ast.Name):
        yield target.id, value
    elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, its in zip(target.elts, value.elts, strict=True):
            yield from _assigned(one, its)


def _is_number(value: ast.expr) -> bool:
    """Whether a value consists of numbers: no texts, and no empty or unit matrices, which only save writing."""
    nodes = list(ast.walk(value))
    if any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in nodes):
        return False
    if any(isinstance(n, ast.Attribute) and n.attr in ("empty", "zeros", "eye") for n in nodes):
        return False
    return any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in nodes) or (
        isinstance(value, ast.BinOp | ast.Name) and _refers(value)
    )


def _refers(value: ast.expr) -> bool:
    """Whether a value is computed from other constants; keys of a table and names of classes are none."""
    keys = {id(k) for n in ast.walk(value) if isinstance(n, ast.Dict) for k in n.keys}
    names = [n.id if isinstance(n, ast.Name) else n.attr
             for n in ast.walk(value) if isinstance(n, ast.Name | ast.Attribute) and id(n) not in keys]  # fmt: skip
    return any(CAPITALS.fullmatch(name) for name in names)


def label(constant: Constant, others: Sequence[Constant]) -> str:
    """The name, with the module before it where others have the same one, with as much of its path as that needs."""
    same = [c for c in others if c.name == constant.name]
    parts = constant.module.split(".")
    for words in range(len(parts)):
        short = ".".join([*parts[len(parts) - words :], constant.name])
        if sum(f"{c.module}.{c.name}".endswith(f".{short}") for c in same) == 1:
            return short
    raise LookupError(f"{constant.name} stands twice in {constant.path}")


def chosen(names: Sequence[str], among: Sequence[Constant]) -> list[Constant]:
    """Constants by their names, with or without modules.

    Raises
    ------
    LookupError : none of this name, or several
    """
    found = []
    for name in names:
        mine = [c for c in among if f"{c.module}.{c.name}".endswith(f".{name}")]
        if len(mine) != 1:
            labels = ", ".join(label(c, among) for c in mine)
            raise LookupError(f"{name} is one of {labels}" if mine else f"there is no constant {name}")
        found += mine
    return found


def tables(among: Sequence[Constant]) -> str:
    """The tables of the page, in Markdown."""
    text = []
    for room in ROOMS:
        mine = [c for c in among if c.room == room]
        counts = ", ".join(f"{sum(c.why == why for c in mine)} {why}" for why in (TUNED, LEVEL, DERIVED))
        text += [f"### {room.capitalize()}", "", f"{len(mine)} constants: {counts}.", ""]
        text += ["| name | module | value | unit | why | what it is |", "|---|---|---|---|---|---|"]
        for c in mine:
            where = f"[{c.path.removeprefix('solver/')}](../{c.path})"
            cells = (f"`{label(c, among)}`", where, f"`{c.value}`", c.unit, c.why, _in_page(c.comment))
            text.append(f"| {' | '.join(cells)} |")
        text.append("")
    return "\n".join(text[:-1]) + "\n"


def _in_page(comment: str) -> str:
    """A comment in a cell of a table: code in single backticks, bars escaped."""
    comment = re.sub(r"`+([^`]+)`+", r"`\1`", comment).replace("|", "\\|")
    return re.sub(r"\.? \(?tuned\)?\.$", ".", comment, flags=re.IGNORECASE)


def page_with(text: str) -> str:
    """The page with these tables between its markers."""
    page = PAGE.read_text(encoding="utf-8")
    before, after = page.index("<!-- constants -->\n"), page.index("<!-- end of constants -->")
    return page[:before] + "<!-- constants -->\n" + text + page[after:]


@dataclass(frozen=True)
class Change:
    """A constant that is multiplied by a factor."""

    module: str
    name: str
    factor: float


class ChangedModule(MetaPathFinder):
    """Lets one module be imported with one of its constants changed."""

    def __init__(self, change: Change):
        self.change = change

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != self.change.module:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next((s for finder in others if (s := finder.find_spec(fullname, path, target)) is not None), None)
        if spec is None or spec.origin is None:
            raise ImportError(f"no source of {fullname}")
        spec.loader = ChangedSource(fullname, spec.origin, self.change)
        return spec


class ChangedSource(SourceFileLoader):
    """Reads the source of a module and puts the factor into it."""

    def __init__(self, fullname: str, path: str, change: Change):
        super().__init__(fullname, path)
        self.change = change

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(Path(self.path).read_text(encoding="utf-8"))
        for node in tree.body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            for name, value in _assigned(target, node.value):
                if name == self.change.name:
                    _replace(node, value, _times(value, self.change.factor))
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


def _replace(node: ast.Assign | ast.AnnAssign, old: ast.expr, new: ast.expr) -> None:
    if node.value is old:
        node.value = new
    elif isinstance(node.value, ast.Tuple):
        node.value.elts = [new if one is old else one for one in node.value.elts]


def _times(value: ast.expr, factor: float) -> ast.expr:
    """A value times a factor: each of a tuple or table; counts stay counts, of one at least."""
    if isinstance(value, ast.Tuple | ast.List):
        return type(value)([_times(one, factor) for one in value.elts], ast.Load())
    if isinstance(value, ast.Dict):
        return ast.Dict(value.keys, [_times(one, factor) for one in value.values])
    if isinstance(value, ast.Call) and value.keywords and not value.args:
        keywords = [ast.keyword(k.arg, _times(k.value, factor)) for k in value.keywords]
        return ast.Call(value.func, [], keywords)
    if isinstance(value, ast.Constant) and isinstance(value.value, int):
        return ast.Constant(max(1, round(value.value * factor)))
    return ast.BinOp(value, ast.Mult(), ast.Constant(factor))


def fly(room: str, change: Change | None) -> Outcome | str:
    """What the flights of a room give, in a process that has imported nothing yet; or why they cannot be flown."""
    if change is not None:
        sys.meta_path.insert(0, ChangedModule(change))
    try:
        return importlib.import_module("constants_flights").FLIGHTS[room]()
    except Exception as error:
        if change is None:
            raise
        return f"{type(error).__name__}: {error}"


def effect(args: argparse.Namespace, among: Sequence[Constant]) -> None:
    """Print how results change with each constant."""
    wanted = [c for c in among if c.why == TUNED and c.room == args.room] if args.all else chosen(args.names, among)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.processes, mp_context=context, max_tasks_per_child=1) as pool:
        room_of = {c: args.room or c.room for c in wanted}
        usual = {room: pool.submit(fly, room, None) for room in dict.fromkeys(room_of.values())}
        changed = {
            (c, factor): pool.submit(fly, room_of[c], Change(c.module, c.name, factor))
            for c in wanted
            for factor in FACTORS
        }
        width = max(len(label(c, among)) for c in wanted) + 8
        for room, future in usual.items():
            _print_room(room, future, [k for k in changed if room_of[k[0]] == room], changed, among, width)


def _print_room(
    room: str,
    usual: Future[Outcome | str],
    keys: Sequence[tuple[Constant, float]],
    changed: dict[tuple[Constant, float], Future[Outcome | str]],
    among: Sequence[Constant],
    width: int,
) -> None:
    before = usual.result()
    assert not isinstance(before, str)
    counts = ", ".join(before.counts)
    print(f"{room}: RMSE of {', '.join(before.rmse)} | NEES of the same | {counts} | processor time")
    print(f"{'as they are':{width}} {before.row(before)} ({before.cpu_s:.0f} s)", flush=True)
    for c, factor in keys:
        after = changed[c, factor].result()
        text = after if isinstance(after, str) else after.row(before)
        print(f"{label(c, among) + (' half' if factor < 1 else ' double'):{width}} {text}", flush=True)


def main() -> int:
    parser = frame.parser(__doc__)
    ways = parser.add_subparsers(dest="way", required=True)
    ways.add_parser("table", help="write the tables of docs/constants.md")
    one = ways.add_parser("effect", help="results at half and double the value")
    one.add_argument("names", nargs="*", metavar="NAME", help="as in the tables")
    one.add_argument("--all", action="store_true", help="all tuned constants of the room")
    one.add_argument("--room", choices=sorted(ROOMS), help="flights to be flown, and whose constants are all")
    one.add_argument("--processes", type=int, default=1, help="at a time (1, so that times can be compared)")
    args, among = parser.parse_args(), constants()
    if args.way == "table":
        PAGE.write_text(page_with(tables(among)), encoding="utf-8")
        return 0
    if bool(args.names) == args.all or (args.all and args.room is None):
        one.error("wanted: names of constants, or --all and --room")
    try:
        effect(args, among)
    except LookupError as error:
        one.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
