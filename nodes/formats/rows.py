"""Messages as rows of a table.

A column is named as its field with its unit (`schemas.units`), dots between the levels (``pose.position.x_m``); vectors
of fixed length become one column a value (``covariance_X_Y_m2`` ...); lists of another length become one text with
spaces; times are ns since the Unix epoch. One repeated sub-message can be spread: one row an element, the other columns
repeated. The others are counted (``parameters.count``). `ElementLayout` makes a table of the elements alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...schemas import messages as m
from ...schemas import topics, units
from ...schemas.image_lines import LineBlock
from ..node import Message

if TYPE_CHECKING:
    import pandas as pd


_ENVELOPE = {"stamp_ns": "Int64", "sequence": "Int64", "source": "string"}


def repeated_messages(type_name: str) -> tuple[str, ...]:
    """Names of the repeated sub-messages of a message type."""
    descriptor = m.message_class(type_name).DESCRIPTOR
    return tuple(f.name for f in descriptor.fields if f.is_repeated and f.message_type is not None)


@dataclass(frozen=True)
class _Leaf:
    """One column (or one vector) of a message type."""

    names: tuple[str, ...]
    path: tuple[str, ...]
    dtype: str
    kind: str = "value"  # value, vector, enum, list, count, time
    enum: Any = None


class RowLayout:
    """How messages of one topic become rows.

    Parameters
    ----------
    topic : of the topic table; with a ``*`` a column ``topic`` says which one a message came on
    spread : repeated sub-message whose elements become rows; None = none

    Raises
    ------
    KeyError : a topic that is not in the topic table
    ValueError : ``spread`` is no repeated sub-message of the topic's type
    """

    def __init__(self, topic: str, spread: str | None = None):
        row = topics.find(topic)
        names = repeated_messages(row.type_name)
        if spread is not None and spread not in names:
            known = ", ".join(names) or "there are none"
            raise ValueError(f"{topic} has no repeated field {spread!r}; repeated fields: {known}")
        self.spread = spread
        self._with_topic = "*" in topic
        self._leaves = _leaves(row.type.DESCRIPTOR, spread)
        self._elements: list[_Leaf] = []
        if spread is not None:
            self._elements = _leaves(row.type.DESCRIPTOR.fields_by_name[spread].message_type, prefix=f"{spread}.")

    @property
    def columns(self) -> dict[str, str]:
        """Names of the columns, in order, and their pandas types."""
        columns = dict(_ENVELOPE)
        if self._with_topic:
            columns["topic"] = "string"
        return columns | {name: leaf.dtype for leaf in (*self._leaves, *self._elements) for name in leaf.names}

    def rows(self, message: Message) -> Iterator[list[Any]]:
        """The rows of one message; one with empty element columns where the repeated field is empty."""
        body = _without_pixels(message.body)
        head: list[Any] = [message.stamp_ns, message.sequence, message.source]
        if self._with_topic:
            head.append(message.topic)
        for leaf in self._leaves:
            head.extend(_values(leaf, body))
        if self.spread is None:
            yield head
            return
        elements = getattr(body, self.spread)
        for element in elements:
            yield [*head, *(value for leaf in self._elements for value in _values(leaf, element))]
        if not len(elements):
            yield head + [None] * sum(len(leaf.names) for leaf in self._elements)

    def frame(self, messages: Iterable[Message]) -> pd.DataFrame:
        """The rows of many messages."""
        return _frame(self.columns, (row for message in messages for row in self.rows(message)))


class ElementLayout:
    """How the elements of a repeated sub-message become rows of a table of their own.

    A row has the envelope of its message, the message's first text (which point, node or strip it is about) unless the
    element has one of that name, and the element.

    Parameters
    ----------
    topic : of the topic table
    field : repeated sub-message
    """

    def __init__(self, topic: str, field: str) -> None:
        descriptor = topics.find(topic).type.DESCRIPTOR
        self.field = field
        found = _leaves(descriptor.fields_by_name[field].message_type)
        # a name that the envelope has, too, is told apart as in the table of messages
        own = [tuple(f"{field}.{n}" if n in _ENVELOPE else n for n in leaf.names) for leaf in found]
        self._elements = [replace(leaf, names=names) for leaf, names in zip(found, own, strict=True)]
        taken = {name for leaf in self._elements for name in leaf.names}
        texts = [leaf for leaf in _leaves(descriptor) if leaf.kind == "value" and leaf.dtype == "string"]
        self._about = [leaf for leaf in texts[:1] if leaf.names[0] not in taken]

    @property
    def columns(self) -> dict[str, str]:
        """Names of the columns, in order, and their pandas types."""
        return _ENVELOPE | {name: leaf.dtype for leaf in (*self._about, *self._elements) for name in leaf.names}

    def rows(self, message: Message) -> Iterator[list[Any]]:
        """The rows of one message, none where it has no element."""
        head: list[Any] = [message.stamp_ns, message.sequence, message.source]
        head += [value for leaf in self._about for value in _values(leaf, message.body)]
        for element in getattr(message.body, self.field):
            yield [*head, *(value for leaf in self._elements for value in _values(leaf, element))]

    def frame(self, messages: Iterable[Message]) -> pd.DataFrame:
        """The rows of many messages."""
        return _frame(self.columns, (row for message in messages for row in self.rows(message)))


def _frame(columns: dict[str, str], rows: Iterable[list[Any]]) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(list(rows), columns=list(columns), dtype=object).astype(columns)


def _leaves(
    descriptor: Any, spread: str | None = None, prefix: str = "", path: tuple[str, ...] = (), whole: Any = None
) -> list[_Leaf]:
    """Columns of a message type; ``path`` leads to it from the type ``whole``."""
    whole = whole or descriptor
    leaves: list[_Leaf] = []
    for field in descriptor.fields:
        name, here = prefix + field.name, (*path, field.name)
        if field.message_type is not None:
            if field.is_repeated:
                if field.name != spread or path:
                    leaves.append(_Leaf((f"{name}.count",), here, "Int64", "count"))
            elif field.message_type.full_name == "google.protobuf.Timestamp":
                leaves.append(_Leaf((f"{name}_ns",), here, "Int64", "time"))
            else:
                leaves += _leaves(field.message_type, None, f"{name}.", here, whole)
        elif field.enum_type is not None:
            leaves.append(_Leaf((name,), here, "string", "enum", field.enum_type))
        elif field.type != field.TYPE_BYTES:
            leaves.append(_number_or_text(field, name, here, whole.full_name))
    return leaves


def _number_or_text(field: Any, name: str, path: tuple[str, ...], whole: str) -> _Leaf:
    kind = "list" if field.is_repeated else "value"
    if field.cpp_type in (field.CPPTYPE_BOOL, field.CPPTYPE_STRING):
        return _Leaf((name,), path, "string" if field.is_repeated else _dtype(field), kind)
    at = ".".join(path)
    stated = (whole, at) if at in units.UNITS[whole] else (field.containing_type.full_name, field.name)
    columns = units.columns_of(*stated, name)
    if isinstance(columns, tuple):
        return _Leaf(columns, path, "float64", "vector")
    return _Leaf((columns,), path, "string" if field.is_repeated else _dtype(field), kind)


def _dtype(field: Any) -> str:
    kinds = {
        field.CPPTYPE_DOUBLE: "float64",
        field.CPPTYPE_FLOAT: "float64",
        field.CPPTYPE_BOOL: "boolean",
        field.CPPTYPE_STRING: "string",
        field.CPPTYPE_UINT64: "UInt64",
        field.CPPTYPE_UINT32: "UInt64",
    }
    return kinds.get(field.cpp_type, "Int64")


def _values(leaf: _Leaf, body: Any) -> list[Any]:
    value = body
    for name in leaf.path[:-1]:
        if not value.HasField(name):  # a sub-message that was not sent is not zero
            return [None] * len(leaf.names)
        value = getattr(value, name)
    if leaf.kind == "time":
        stamp = getattr(value, leaf.path[-1])
        return [stamp.seconds * 1_000_000_000 + stamp.nanos if value.HasField(leaf.path[-1]) else None]
    value = getattr(value, leaf.path[-1])
    if leaf.kind == "vector":
        return list(value) if len(value) == len(leaf.names) else [np.nan] * len(leaf.names)
    if leaf.kind == "count":
        return [len(value)]
    if leaf.kind == "list":
        return [" ".join(v if isinstance(v, str) else repr(v) for v in value)]
    if leaf.kind == "enum":
        known = leaf.enum.values_by_number.get(value)
        return [known.name.lower() if known is not None else str(value)]
    return [value]


def _without_pixels(body: Any) -> Any:
    """Image lines as a message without its pixels, other bodies as they are."""
    if not isinstance(body, LineBlock):
        return body
    height, width = body.pixels.shape
    message = m.RawImage(
        width=width,
        height=height,
        encoding="mono16" if body.pixels.itemsize == 2 else "mono8",
        step=width * body.pixels.itemsize,
        frame_id=body.ccd,
        strip=body.strip,
        first_line=body.first_line,
        line_period_ns=body.line_period_ns,
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(body.time_ns, 1_000_000_000)
    if body.line_times_ns is not None:
        message.line_times_ns.extend(np.asarray(body.line_times_ns).tolist())
    return message
