"""The recordings that somebody names: files, folders, patterns, lists, and the same in an object store."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from ..errors import UserError
from ..recording.remote import is_url, listed
from ..recording.same_flight import beginning_alike, measured
from .records import record_of
from .steps import PROCESSED

#: Ending of recordings: what is taken of a folder.
RECORDING = ".mcap"
_PATTERN = re.compile(r"[*?\[]")
_UNUSUAL = re.compile(r"[^\w.+=@ ,()-]")


@dataclass(frozen=True)
class Source:
    """A recording to work on.

    Attributes
    ----------
    name : of the folder of its results, with ``/`` where folders lie in folders
    path : absolute, or a URL
    size : bytes
    modified : what changes with the content: time of the last change, or what the store says
    """

    name: str
    path: str
    size: int
    modified: str


def sources(inputs: Iterable[str], out: Path) -> list[Source]:
    """The recordings that inputs name, in order and once each.

    What an earlier run made is no recording of a folder. A recording of a folder or pattern is named as it lies below
    the folder (the part of the pattern without wildcards), one that is named itself by its own name, with as many
    folders before it as it takes to tell all of them apart.

    Parameters
    ----------
    inputs : files, folders (with all below them), patterns, ``@FILE`` (a file with one of these a line), URLs
    out : folder of results; what lies in it is no input

    Raises
    ------
    UserError : nothing there, or no recording among it
    """
    found: dict[str, tuple[str, int, str]] = {}
    for text in _expanded(inputs):
        before = len(found)
        for path, name, size, modified in _remote(text) if is_url(text) else _local(text, Path(os.path.abspath(out))):
            found.setdefault(path, (name, size, modified))
        if len(found) == before and (not found or not _names_any(text, found)):
            whole, results = Path(os.path.abspath(text)), Path(os.path.abspath(out))
            inside = not is_url(text) and results in (whole, *whole.parents)
            hint = f"; what lies in {out}, the folder of results, is no input" if inside else ""
            raise UserError(f"{text}: no recording ({RECORDING}) there{hint}")
    names = _told_apart({path: name for path, (name, _, _) in found.items()})
    return [Source(names[path], path, size, modified) for path, (_, size, modified) in found.items()]


def flown_twice(found: Iterable[Source]) -> list[str]:
    """A line for each recording that holds the same sensor data as another one: a flight beside what was made of it.

    Recordings elsewhere are not looked at, of which much would have to be fetched, nor those without a whole end.
    """
    alike: dict[tuple[tuple[str, int], ...], list[Path]] = {}
    for path in (Path(source.path) for source in found if not is_url(source.path)):
        alike.setdefault(tuple(measured(path).items()), []).append(path)
    lines = []
    for counts, paths in alike.items():
        wanted = {topic for topic, _ in counts}
        same: dict[tuple[Path, Path], set[str]] = {}
        with suppress(UserError):  # what cannot be read its jobs say
            for path, other, topic in beginning_alike(paths if len(paths) > 1 else (), sorted(wanted)):
                same.setdefault((path, other), set()).add(topic)
        lines += [
            f"{path} holds the same sensor data as {other}: if they are one flight, as recorded and as processed, "
            "it counts twice"
            for (path, other), topics in same.items()
            if topics == wanted
        ]
    return lines


def _names_any(text: str, found: Iterable[str]) -> bool:
    """Whether something that an earlier input gave lies there."""
    start = text if is_url(text) else os.path.abspath(text)
    return any(path.startswith(start) for path in found) or bool(_PATTERN.search(text) and glob.glob(text))


def _expanded(inputs: Iterable[str]) -> Iterator[str]:
    for text in inputs:
        if not text.startswith("@"):
            yield text
            continue
        for line in Path(text[1:]).read_text(encoding="utf-8-sig").splitlines():
            if line.strip() and not line.lstrip().startswith("#"):
                yield line.strip()


def _local(text: str, out: Path) -> Iterator[tuple[str, str, int, str]]:
    path = Path(text)
    if path.is_file():
        chosen, base = [path], path.parent
    elif path.is_dir():
        below = sorted(each for each in path.rglob("*") if each.suffix.lower() == RECORDING)
        chosen, base = [p for p in below if p.name != PROCESSED or not record_of(p.parent, "process").exists()], path
    elif _PATTERN.search(text):
        chosen = [p for p in map(Path, sorted(glob.glob(text, recursive=True))) if p.is_file()]
        base = _base(text)
    else:
        raise UserError(f"{text}: no such file or folder")
    base = Path(os.path.abspath(base))  # links keep their names
    for each in chosen:
        whole = Path(os.path.abspath(each))
        hidden = any(part.startswith(".") for part in whole.relative_to(base).parts) if base in whole.parents else False
        if not whole.is_file() or (each != path and (hidden or out in whole.parents)):
            continue
        stat = whole.stat()
        below = whole.relative_to(base) if base in whole.parents else Path(whole.name)
        yield str(whole), below.with_suffix("").as_posix(), stat.st_size, str(stat.st_mtime_ns)


def _base(pattern: str) -> Path:
    """The folder of a pattern before its first wildcard."""
    fixed = list(takewhile(lambda part: not _PATTERN.search(part), Path(pattern).parts))
    return Path(*fixed)


def _remote(text: str) -> Iterator[tuple[str, str, int, str]]:
    base, rows = listed(text, RECORDING)
    for url, size, modified in rows:
        below = url[len(base) :].lstrip("/") if url.startswith(base) else url.rsplit("/", 1)[-1]
        yield url, str(PurePosixPath(below).with_suffix("")), size, modified


def _told_apart(names: dict[str, str]) -> dict[str, str]:
    """Names of folders by path, each once: folders are put before those that are there twice."""
    taken = dict(names)
    deepest = max((path.count("/") for path in names), default=0)
    for depth in range(1, deepest + 1):
        times = Counter(taken.values())
        for path, name in names.items():
            if times[taken[path]] > 1:
                above = PurePosixPath(path.split("://")[-1]).parts[: -1 - name.count("/")]
                taken[path] = "/".join([*(part for part in above[-depth:] if part != "/"), name])
    named = {path: "/".join(map(_folder_name, name.split("/"))) for path, name in taken.items()}
    by_name: dict[str, str] = {}
    for path, name in named.items():
        if by_name.setdefault(name, path) != path:
            raise UserError(f"{path}: would have the folder {name}, as {by_name[name]} has; give it another name")
    return named


def _folder_name(part: str) -> str:
    """A part of a name as the name of a folder; stores take any characters, and ``..`` among them."""
    return _UNUSUAL.sub("_", part) if part.strip(".") else "_" * max(len(part), 1)
