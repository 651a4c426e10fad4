"""New files that get their name only when they are complete, alone or together."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import UserError

#: What only writing meets, which names no file: a full disk, a quota, a file as large as may be.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def refuse_unless_file(target: Path) -> None:
    """Raise UserError where a folder or a device such as /dev/null has the name of a new file."""
    if target.is_dir():
        raise UserError(f"{target}: is a folder, wanted a file")
    if target.exists() and not target.is_file():
        raise UserError(f"{target}: is a device, wanted a file")


def refuse_unless_writable(target: Path) -> None:
    """Raise UserError where `new_file` could not write ``target``; called before the work begins."""
    refuse_unless_file(target)
    if not target.parent.is_dir():
        raise UserError(f"{target}: no folder {target.parent}")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise UserError(f"{target}: cannot be written: no permission in {target.parent}")


def refuse_unless_folder(target: Path) -> None:
    """Raise UserError where a folder of results cannot be made; called before the work begins, and makes nothing."""
    place = target
    while not (place.exists() or place.is_symlink()) and place != place.parent:
        place = place.parent
    if not place.is_dir():
        what = "is a file, wanted a folder for the result" if place == target else f"{place} is not a folder"
        raise UserError(f"{target}: {what}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise UserError(f"{target}: cannot be written: no permission in {place}")


def refuse_unless_free(target: Path) -> None:
    """Raise UserError as `refuse_unless_folder`, and where the folder is there and has something in it."""
    refuse_unless_folder(target)
    if target.is_dir() and any(target.iterdir()):
        raise UserError(f"{target}: is there already and is not empty, wanted a new folder")


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """A path to write to, which is renamed to ``target`` at the end, or deleted if something fails before.

    Raises
    ------
    UserError : the folder of ``target`` is not there or not to be written to, or ``target`` is not a file
    """
    refuse_unless_file(target)
    if not target.parent.is_dir():
        raise UserError(f"{target}: no folder {target.parent}")
    part = target.with_name(f".{target.name}.part")
    try:
        yield part
        os.replace(part, target)
    except UserError as error:
        raise UserError(str(error).replace(os.fspath(part), os.fspath(target))) from None
    except OSError as error:
        of_part = error.errno in _FULL if error.filename is None else error.filename == os.fspath(part)
        if not of_part:
            raise
        why = os.strerror(error.errno) if error.errno in _FULL else error.strerror or str(error)
        raise UserError(f"{target}: cannot be written: {why.lower()}") from None
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def new_files(folder: Path, last: str, old: Iterable[str] = ()) -> Iterator[Path]:
    """A folder to write a result of several files to, which are moved into ``folder`` when all are complete.

    If something fails before, ``folder`` keeps what it had: the whole result of an earlier run.

    Parameters
    ----------
    last : the file that is taken away first and comes last, so that where it is, all is there
    old : names, or patterns as of `Path.glob`, of files of an earlier result, which are deleted when the new one comes

    Raises
    ------
    UserError : a file cannot be written, or its name in ``folder`` is that of a folder or a device
    """
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / ".result.part"
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    part.mkdir()
    try:
        yield part
        found = [path.relative_to(part) for path in sorted(part.rglob("*")) if path.is_file()]
        for name in found:
            refuse_unless_file(folder / name)
        for path in [folder / last, *(path for pattern in old for path in folder.glob(pattern))]:
            path.unlink(missing_ok=True)
        for name in sorted(found, key=lambda name: name == Path(last)):
            (folder / name).parent.mkdir(exist_ok=True)
            os.replace(part / name, folder / name)
    except UserError as error:
        raise UserError(str(error).replace(os.fspath(part), os.fspath(folder))) from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
