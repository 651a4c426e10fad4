"""CSV files with named columns: read fast, and with the line and column of whatever is wrong."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import UserError
from .new_file import new_file

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_DECIMAL_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
#: The search for problems of a file ends after so many.
MOST_PROBLEMS = 10


@dataclass(frozen=True)
class Column:
    """A column that a file may or must have.

    Attributes
    ----------
    name : as in the header
    kind : "text", "number" or "integer"
    optional : the column may be absent
    blank : single values may be empty (read as NaN or "")
    low : smallest value allowed
    above : values must be larger than this
    choices : allowed words of a text column; empty = any
    other_names : under which a header may have it instead; the table has it under ``name``
    """

    name: str
    kind: str = "number"
    optional: bool = False
    blank: bool = False
    low: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    other_names: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name, *self.other_names)

    @property
    def wanted(self) -> str:
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.kind == "text":
            return "a name"
        noun = "an integer" if self.kind == "integer" else "a number"
        if self.low is not None:
            return f"{noun} of at least {self.low:g}"
        return noun if self.above is None else f"{noun} above {self.above:g}"

    def problem(self, text: str) -> str | None:
        """What is wrong with one value, None if nothing."""
        if not text:
            return None if self.blank else f"missing, wanted {self.wanted}"
        if self.kind == "text":
            return f"{text!r}, wanted {self.wanted}" if self.choices and text not in self.choices else None
        try:
            value = float(text)
        except ValueError:
            more = "" if self.wanted == "a number" else f", wanted {self.wanted}"
            return f"{text!r} is not a number{more}"
        bad = not np.isfinite(value) or (self.kind == "integer" and value != int(value))
        bad = bad or (self.low is not None and value < self.low) or (self.above is not None and value <= self.above)
        return f"{text}, wanted {self.wanted}" if bad else None

    def fits(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """The same check for a whole column that was read as numbers or words."""
        if self.kind == "text":
            good = np.isin(values, self.choices) if self.choices else values != ""
            return good | (values == "") if self.blank else good
        good = np.isfinite(values)
        if self.kind == "integer":
            good &= values == np.floor(values)
        if self.low is not None:
            good &= values >= self.low
        if self.above is not None:
            good &= values > self.above
        return good | np.isnan(values) if self.blank else good


@dataclass(frozen=True)
class Table:
    """Columns of a file: numbers as float64 (NaN where blank), words as objects; absent optional ones are not there.

    Attributes
    ----------
    path : file
    values : by name of the `Column`
    headed : what the file calls a column that has another name there
    rows : number of each row in the file, from 0; None for all in their order
    skip : lines above the header
    """

    path: Path
    values: Mapping[str, NDArray[Any]] = field(repr=False)
    headed: Mapping[str, str] = field(default_factory=dict)
    rows: NDArray[np.intp] | None = field(default=None, repr=False)
    skip: int = 0

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.values[name]

    def stack(self, *names: str) -> NDArray[np.float64]:
        """Number columns side by side, (rows, len(names))."""
        return np.column_stack([self.values[name] for name in names]).astype(float)

    def part(self, which: NDArray[np.bool_]) -> Table:
        """Some of the rows."""
        rows = np.flatnonzero(which) if self.rows is None else self.rows[which]
        return replace(self, values={name: column[which] for name, column in self.values.items()}, rows=rows)

    def line_of(self, row: int) -> int:
        """Line number in the file (from 1) of a row (from 0)."""
        row = row if self.rows is None else int(self.rows[row])
        with _open(self.path, self.skip) as file:
            for place, (line, _) in enumerate(_rows(file, separator_of(self.path, self.skip)[0])):
                if place == row + 1:
                    return line + self.skip
        return row + 2 + self.skip

    def refuse(self, bad: ArrayLike, column: str, what: Callable[[int], str]) -> None:
        """Raise UserError for the first row where ``bad`` holds, with the count of the others."""
        rows = np.flatnonzero(np.asarray(bad))
        column = self.headed.get(column, column)
        if len(rows):
            row = int(rows[0])
            raise UserError(one_line([f"{self.path}:{self.line_of(row)}: {column}: {what(row)}"], len(rows) - 1))


def one_line(problems: Sequence[str], others: int = 0) -> str:
    """The first problem, and how many more there are: at least so many, where the search for them ended before."""
    more = others + len(problems) - 1
    least = "at least " if len(problems) >= MOST_PROBLEMS else ""
    return problems[0] + (f" (and {least}{more} more like it)" if more > 0 else "")


def read_table(
    path: Path, columns: Sequence[Column], notes: list[str], *, may_be_empty: bool = False, skip: int = 0
) -> Table:
    """Read a CSV file with a header; columns in any order, unknown ones ignored with a note.

    Values stand between commas, or between semicolons (then with decimal commas or points).

    Parameters
    ----------
    path : file
    columns : what it may have
    notes : remarks are appended here
    may_be_empty : whether a file with a header and no rows is all right
    skip : lines above the header that do not count

    Raises
    ------
    UserError : ``file:line: column: what is wrong``, and how many more problems there are
    """
    import pandas as pd  # takes longer to import than all the rest

    # numbers to the last bit, which is the default only since pandas 3
    exact: dict[str, Any] = {} if int(pd.__version__.split(".")[0]) >= 3 else {"float_precision": "round_trip"}
    header = _header(path, columns, notes, skip)
    separator, decimal = separator_of(path, skip)
    known = {name: column for column in columns for name in column.names if name in header}
    text: dict[str, Any] = {
        "skiprows": skip, "skipinitialspace": True, "encoding": "utf-8-sig", "index_col": False,
        "sep": separator, "decimal": decimal,
    }  # fmt: skip
    try:
        # pandas keeps blanks before a separator
        label = {str(found).strip(): found for found in pd.read_csv(path, nrows=0, **text).columns}
        label = {name: label.get(name, name) for name in known}
        frame = pd.read_csv(
            path,
            usecols=list(label.values()),
            dtype={label[name]: str if column.kind == "text" else float for name, column in known.items()},
            keep_default_na=False,
            na_values={label[name]: [""] for name, column in known.items() if column.kind != "text"},
            **text,
            **exact,
        )
    except ValueError:  # pandas does not say where, so every line is checked
        raise UserError(
            one_line(_problems(path, known, skip) or [_not_utf8(path) or f"{path}: cannot be read as CSV"])
        ) from None
    # pandas ignores surplus fields of a row
    below = path.read_bytes().split(b"\n", skip)[-1]
    if below.count(separator.encode()) != (len(header) - 1) * (len(frame) + 1):
        problems = _problems(path, known, skip)
        if problems:
            raise UserError(one_line(problems))
    blank = _blank_rows(frame)
    if blank.any():
        whole = pd.read_csv(path, dtype=str, keep_default_na=False, **text)
        blank &= _blank_rows(whole)  # a column that is not known may have something there
        frame = frame[~blank]
    values: dict[str, NDArray[Any]] = {}
    for name, column in known.items():
        if column.kind == "text":
            # few different names in many rows: each name is cleaned once
            codes, names = pd.factorize(frame[label[name]], use_na_sentinel=False)
            clean = np.array([str(word).strip() if isinstance(word, str) else "" for word in names], dtype=object)
            read: NDArray[Any] = clean[codes] if len(clean) else np.empty(0, dtype=object)
        else:
            read = frame[label[name]].to_numpy(dtype=float)
        values[column.name] = read
        if not column.fits(read).all():
            raise UserError(one_line(_problems(path, known, skip) or [f"{path}: {name}: unreadable value"]))
    if not len(frame) and not may_be_empty:
        raise UserError(f"{path}: no rows below the header, wanted at least one")
    headed = {column.name: name for name, column in known.items() if name != column.name}
    return Table(path, values, headed, skip=skip)


def _blank_rows(frame: Any) -> NDArray[np.bool_]:
    """Rows of pandas (n,) in which all columns are empty, as spreadsheets leave them below the last one."""
    blank = np.ones(len(frame), dtype=bool)
    for name in sorted(frame, key=lambda name: frame[name].dtype != float):  # numbers are looked through faster
        if blank.any():
            blank &= (frame[name].isna() | (frame[name] == "")).to_numpy()
    return blank


def write_table(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]], formats: Mapping[str, str]) -> None:
    """Write columns as CSV; ``formats`` gives the format (``".6f"``) of number columns, ``""`` keeps all digits.

    The file gets its name when it is whole.
    """
    cells = [_cells(values, formats.get(name)) for name, values in columns.items()]
    with new_file(path) as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*cells, strict=True))


def _cells(values: Sequence[Any] | NDArray[Any], spec: str | None) -> list[Any]:
    if spec is None:
        return [str(v) for v in values]
    if isinstance(values, np.ndarray) and values.dtype in (np.float64, np.int64):
        values = values.tolist()  # numbers of Python are formatted in two thirds of the time
        if spec == "":
            return ["" if v != v else v for v in values]  # `csv` writes all digits, in half the time
    return ["" if v != v else format(v, spec) for v in values]


def csv_field(text: str) -> str:
    """A text as it stands in a CSV file: between quotes, with those in it doubled, where it would end the field."""
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


def _open(path: Path, skip: int = 0):
    """The text from its header on, below ``skip`` lines."""
    file = open(path, newline="", encoding="utf-8-sig", errors="replace")  # noqa: SIM115  # closed by the caller
    for _ in range(skip):
        file.readline()
    return file


def column_names_of(path: Path, skip: int = 0) -> list[str]:
    """The names of the columns, below ``skip`` lines; empty where the file is empty or no table. Between quotes or not,
    as values are."""
    delimiter = separator_of(path, skip)[0]
    with _open(path, skip) as file:
        first = next((line for line in iter(lambda: file.readline(65536), "") if line.strip()), "")
    try:
        return [name.strip() for name in next(csv.reader([first], skipinitialspace=True, delimiter=delimiter), [])]
    except csv.Error:
        return []


def separator_of(path: Path, skip: int = 0) -> tuple[str, str]:
    """What stands between the values, a comma or a semicolon, and the decimal sign.

    A semicolon separates where the header has one and no comma. The decimal sign is then that of the first row with a
    number that is not whole: spreadsheets write whole numbers without one.
    """
    with _open(path, skip) as file:
        head = next((line for line in (file.readline(65536) for _ in range(8)) if line.strip()), "")
        if ";" not in head or "," in head:
            return ",", "."
        for line in iter(lambda: file.readline(65536), ""):
            fields = [text.strip().strip('"') for text in line.split(";")]
            commas, points = (
                sum(bool(sign.fullmatch(text)) for text in fields) for sign in (_DECIMAL_COMMA, _DECIMAL_POINT)
            )
            if commas or points:  # a name of a point may look like a number too
                return ";", "," if commas >= points else "."
    return ";", "."


def _rows(file: Any, delimiter: str):
    """(line number, fields) of all lines that are not blank."""
    reader = csv.reader(file, skipinitialspace=True, delimiter=delimiter)
    while True:
        try:
            fields = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise UserError(f"{file.name}:{max(reader.line_num, 1)}: not a text table ({error})") from None
        if fields and any(text.strip() for text in fields):
            yield reader.line_num, [text.strip() for text in fields]


def _header(path: Path, columns: Sequence[Column], notes: list[str], skip: int) -> list[str]:
    line = skip + 1
    with _open(path, skip) as file:
        _, header = next(_rows(file, separator_of(path, skip)[0]), (0, []))
    if not header:
        raise UserError(f"{path}: empty, wanted a header with {_names(columns)}")
    if any("\0" in name or "\ufffd" in name for name in header):
        there = all(column.optional or set(column.names) & set(header) for column in columns)
        raise UserError(
            (there and _not_utf8(path)) or f"{path}:{line}: not a text table, wanted a header with {_names(columns)}"
        )
    known = {name for column in columns for name in column.names}
    repeated = {name for name in header if name in known and header.count(name) > 1}
    if repeated:
        raise UserError(f"{path}:{line}: {sorted(repeated)[0]}: this column comes twice")
    for column in columns:
        if len(twice := [name for name in column.names if name in header]) > 1:
            raise UserError(f"{path}:{line}: {twice[1]}: this column comes twice, also as {twice[0]}")
    missing = [column.name for column in columns if not column.optional and not set(column.names) & set(header)]
    if missing:
        raise UserError(
            f"{path}:{line}: {missing[0]}: column missing, wanted {_names(columns)}{separator_hint(header, missing[0])}"
        )
    ignored = dict.fromkeys(name for name in header if name not in known)
    notes.extend(f"{path.name}: column {name!r} is not known and was ignored" for name in ignored)
    return header


def separator_hint(header: Sequence[str], missing: str) -> str:
    """What may be wrong with a header in which a column is missing; "" where that is nothing else."""
    if sum(_is_number(name) for name in header) > 1:
        return "; values stand there, wanted a row of names above them"
    if len(header) < 2:
        return "; is the separator a comma?" if any(c in name for name in header for c in "\t ") else ""
    same = next((name for name in header if name != missing and name.lower() == missing.lower()), None)
    return f"; capital letters count: {same} stands there" if same else ""


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _names(columns: Sequence[Column]) -> str:
    return ",".join(column.name for column in columns if not column.optional)


def _not_utf8(path: Path) -> str | None:
    """Where a text is in another encoding, as spreadsheets write it; None of one that is UTF-8."""
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                shown = line[error.start : error.start + 1].decode("cp1252", "replace")
                return f"{path}:{number}: a letter that is not UTF-8 ({shown!r} in Windows-1252?), wanted UTF-8 text"
    return None


def _problems(path: Path, known: Mapping[str, Column], skip: int) -> list[str]:
    """Look at every value; used once something is known to be wrong."""
    found: list[str] = []
    delimiter, decimal = separator_of(path, skip)
    with _open(path, skip) as file:
        rows = _rows(file, delimiter)
        _, header = next(rows)
        place = {name: header.index(name) for name in known}
        for line, fields in ((number + skip, fields) for number, fields in rows):
            if len(fields) > len(header) and any(fields[len(header) :]):
                found.append(f"{path}:{line}: {header[-1]}: {len(fields)} values, wanted {len(header)}")
            for name, column in known.items():
                text = fields[place[name]] if place[name] < len(fields) else ""
                if decimal == "," and column.kind != "text":
                    if _DECIMAL_POINT.fullmatch(text):
                        found.append(f"{path}:{line}: {name}: {text}, wanted a decimal comma as other values have")
                        continue
                    text = text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text
                what = column.problem(text)
                if what:
                    found.append(f"{path}:{line}: {name}: {what}")
            if len(found) >= MOST_PROBLEMS:
                break
    return found
