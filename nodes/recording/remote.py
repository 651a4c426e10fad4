"""Recordings in an object store or on another machine: whatever fsspec can open, read by ranges of bytes.

What is fetched goes into a temporary file of the same size, which is empty where nothing was fetched, so that the rest
of the program reads it as it reads a file of its own.
"""

from __future__ import annotations

import mmap
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import UserError

#: Ranges begin and end at multiples of it, bytes.
PAGE = 4096
#: Two ranges with less than so many pages between them are fetched as one: a request costs as much as some 64 kB.
_BETWEEN = 16
#: Of a file that is wanted whole so much is fetched in one request, and so many requests are made at a time.
_BLOCK, _AT_A_TIME = 8 << 20, 4
#: A store that does not answer is given up after so long, s, where it can be told.
_PATIENCE_S = 10
_URL = re.compile(r"([a-z][a-z0-9+.-]+):/+", re.IGNORECASE)
#: How it begins what may be over the next time: a store that is away or fails.
AWAY = "for now the store"
#: What carries a protocol into an installation, by protocol.
_PACKAGES = {
    "sftp": "paramiko",
    "ssh": "paramiko",
    "webdav": "'webdav4[fsspec]'",
    "dav": "'webdav4[fsspec]'",
    "gs": "gcsfs",
    "az": "adlfs",
}
#: What a store takes for who one is, for the message that it refuses.
_CREDENTIALS = {"s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile; AWS_ENDPOINT_URL names another store"}


class RemotePath(type(Path())):
    """A URL in the place of a path: commands and readers of recordings take it as a path that is never a folder."""

    _url = ""

    def __new__(cls, *parts: str | Path) -> RemotePath:
        made = super().__new__(cls, *parts)
        if len(parts) == 1 and "://" in str(parts[0]):
            made._url = str(parts[0])  # a path would leave out what stands twice
        return made

    def __str__(self) -> str:
        return self._url or _URL.sub(r"\1://", super().__str__().replace("\\", "/"), count=1)

    def exists(self, *_: Any, **__: Any) -> bool:
        return True  # the reader says it if it is not: a question for each look would cost a request each

    def is_file(self, *_: Any, **__: Any) -> bool:
        return True

    def is_dir(self, *_: Any, **__: Any) -> bool:
        return False

    def resolve(self, strict: bool = False) -> RemotePath:
        return self

    def samefile(self, other_path: str | os.PathLike[str]) -> bool:
        return str(self) == str(other_path)


def is_url(text: str) -> bool:
    """Whether it names a file elsewhere."""
    return "://" in text and _URL.match(text) is not None


def path_of(text: str | Path) -> Path:
    """The path that a word of a command line names, or the URL."""
    if isinstance(text, RemotePath):
        return text
    return RemotePath(text) if isinstance(text, str) and is_url(text) else Path(text)


def listed(url: str, ending: str) -> tuple[str, list[tuple[str, int, str]]]:
    """The files that a URL names: itself, what lies below it, or what its wildcards match.

    Returns
    -------
    the part of the URL before the names of the files; URL, bytes and what changes with the content, for each file

    Raises
    ------
    UserError : the store is not there, refuses, or has no such thing
    """
    with _one_line(url):
        fs, key = _store(url)
        if re.search(r"[*?\[]", key):
            base = re.split(r"[*?\[]", key)[0].rpartition("/")[0]
            rows = fs.glob(key, detail=True)
        elif (found := fs.info(key))["type"] == "directory":
            base, rows = key.rstrip("/"), fs.find(key, detail=True)
            rows = {name: row for name, row in rows.items() if name.lower().endswith(ending)}
        else:
            base, rows = key.rpartition("/")[0], {found["name"]: found}
        protocol, _, rest = url.partition("://")
        whole = f"{protocol}://{rest.rstrip('/')}"
        # names of files have no protocol, and of most stores no host either
        before = whole[: len(whole) - len(key)] if whole.endswith(key) else fs.unstrip_protocol("")
        files = [
            (before + name, int(row["size"]), _modified(row))
            for name, row in sorted(rows.items())
            if row["type"] == "file"
        ]
        return before + base, files


class RemoteFile:
    """A file elsewhere, of which that is here what was fetched.

    Parameters
    ----------
    path : its URL

    Attributes
    ----------
    size : bytes of the file
    buffer : its bytes, zeros where nothing was fetched
    fetched, requests : bytes, and ranges that were asked for

    Raises
    ------
    UserError : the store is not there, refuses, or has no such file
    """

    def __init__(self, path: RemotePath) -> None:
        self._url = str(path)
        with _one_line(self._url):
            self._fs, self._key = _store(self._url)
            found = self._fs.info(self._key)
            if found["type"] != "file":
                raise UserError(f"{self._url}: is a folder, wanted a recording")
            self.size = int(found["size"])
        if not self.size:
            raise UserError(f"{self._url}: empty, wanted an MCAP recording")
        with tempfile.TemporaryFile(prefix="triline-") as file:
            file.truncate(self.size)
            self._bytes = mmap.mmap(file.fileno(), self.size)
        self.buffer = memoryview(self._bytes).toreadonly()
        self._there = np.zeros(-(-self.size // PAGE), dtype=bool)
        self.fetched = self.requests = 0
        OPENED.append(self)

    def __str__(self) -> str:
        return f"{self._url}: {self.fetched / 1e6:.3f} MB of {self.size / 1e6:.3f} MB read, {self.requests} ranges"

    def fetch(self, begin: ArrayLike, end: ArrayLike) -> None:
        """Have ranges of bytes here: first bytes (n,), and those behind the last ones (n,)."""
        first, behind = np.atleast_1d(begin) // PAGE, -(-np.atleast_1d(end) // PAGE)
        steps = np.zeros(len(self._there) + 1, dtype=np.int64)
        np.add.at(steps, np.clip(first, 0, len(self._there)), 1)
        np.add.at(steps, np.clip(behind, 0, len(self._there)), -1)
        missing = (np.cumsum(steps[:-1]) > 0) & ~self._there
        self._get(_runs(missing, self._there))

    def fetch_all(self) -> None:
        """Have the whole file here."""
        for begin in range(0, self.size, _BLOCK * _AT_A_TIME):
            self.fetch(begin, min(begin + _BLOCK * _AT_A_TIME, self.size))

    def _get(self, runs: Sequence[tuple[int, int]]) -> None:
        ranges = [
            (begin, min(begin + _BLOCK, last * PAGE, self.size))
            for first, last in runs
            for begin in range(first * PAGE, min(last * PAGE, self.size), _BLOCK)
        ]
        together: list[tuple[int, int]] = []
        for one in [*ranges, None]:
            if together and (one is None or sum(e - b for b, e in together) + one[1] - one[0] > _BLOCK * _AT_A_TIME):
                with _one_line(self._url):
                    starts, ends = zip(*together, strict=True)
                    parts = self._fs.cat_ranges([self._key] * len(together), list(starts), list(ends))
                for (begin, end), part in zip(together, parts, strict=True):
                    if len(part) != end - begin:
                        raise UserError(f"{self._url}: {len(part)} bytes came, wanted {end - begin}; did it change?")
                    self._bytes[begin:end] = part
                    self._there[begin // PAGE : -(-end // PAGE)] = True
                    self.fetched += end - begin
                    self.requests += 1
                together = []
            if one is not None:
                together.append(one)


#: What this program has opened elsewhere.
OPENED: list[RemoteFile] = []


def _runs(missing: NDArray[np.bool_], there: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First pages, and those behind the last ones, of what is missing; short stretches between are taken along."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    runs: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2).tolist():
        if runs and first - runs[-1][1] < _BETWEEN and not there[runs[-1][1] : first].any():
            runs[-1] = runs[-1][0], last
        else:
            runs.append((first, last))
    return runs


def _store(url: str) -> tuple[Any, str]:
    """The file system of a URL, and what the file is called there."""
    protocol = url.partition("://")[0]
    if secret := re.match(r"([^:/]+://[^:/@]*):[^/@]*@", url):
        where = f"FSSPEC_{protocol.upper()}_PASSWORD"
        raise UserError(
            f"{secret[1]}:..@..: a password in a URL would stand in logs; put it into {where}, or use a key"
        )
    try:
        import fsspec
        import fsspec.utils
    except ImportError:
        raise UserError(f"{url}: needs fsspec: pip install 'triline[cluster]'") from None
    options: dict[str, Any] = {"skip_instance_cache": True}
    if protocol == "s3":
        timeouts = {"connect_timeout": _PATIENCE_S, "read_timeout": 6 * _PATIENCE_S}
        options["config_kwargs"] = {**timeouts, "retries": {"max_attempts": 3}}
    try:
        kind = fsspec.get_filesystem_class(protocol)
        fs, key = fsspec.core.url_to_fs(url, **options)
    except ImportError:
        package = _PACKAGES.get(protocol)
        wanted = f"pip install {package}" if package else "pip install 'triline[cluster]'"
        raise UserError(f"{url}: {protocol}:// needs another package: {wanted}") from None
    except ValueError as error:
        if "Protocol not known" in str(error):
            raise UserError(f"{url}: {protocol}:// is no store that fsspec knows") from None
        raise
    del kind
    return fs, key


@contextmanager
def _one_line(url: str) -> Iterator[None]:
    """Whatever a store raises becomes one line that says what it means."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{url}: no such file in the store") from None
    except Exception as error:
        # every package of fsspec has errors of its own, and those of several below it
        raise UserError(f"{url}: {_meaning(error, url.partition('://')[0])}") from None


def _meaning(error: Exception, protocol: str) -> str:
    told = " ".join(str(error).split()) or type(error).__name__
    takes = f" (it takes {_CREDENTIALS[protocol]})" if protocol in _CREDENTIALS else ""
    names = {kind.__name__ for kind in type(error).__mro__}
    if isinstance(error, PermissionError) or "authentication" in told.lower():
        return f"the store refuses: {told}{takes}"
    if names & {"NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "TokenRetrievalError"}:
        return f"no credentials for the store: {told}{takes}"
    if isinstance(error, OSError | TimeoutError) or names & {
        "EndpointConnectionError",
        "HTTPClientError",
        "SSHException",
    }:
        return f"{AWAY} cannot be reached: {told}"
    return f"{AWAY} fails: {type(error).__name__}: {told}"


def _modified(row: dict[str, Any]) -> str:
    """What changes with the content of a file in a listing."""
    names = ("ETag", "etag", "md5", "mtime", "LastModified", "last_modified", "modified", "created")
    return next((str(row[name]).strip('"') for name in names if row.get(name)), "")
