"""Messages as rows of a table.

A column is named as its field, dots between the levels (``pose.position.x``); vectors of fixed length become one column
a value (``covariance_0`` ...); lists of another length become one text with spaces. One repeated sub-message can be
spread: one row an element, the other columns repeated. The others are counted (``parameters.count``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...schemas import codec, topics
from ...schemas import messages as m
from ...schemas.image_lines import LineBlock
from ..node import Message

if TYPE_CHECKING:
    import pandas as pd


#: Repeated sub-messages whose elements become rows by default; a type with only one need not be named here.
_SPREAD = {"triline.Camera": "lines"}
_ENVELOPE = {"stamp_ns": "Int64", "sequence": "Int64", "source": "string"}


def repeated_messages(type_name: str) -> tuple[str, ...]:
    """Names of the repeated sub-messages of a message type."""
    descriptor = m.message_class(type_name).DESCRIPTOR
    return tuple(f.name for f in descriptor.fields if f.is_repeated and f.message_type is not None)


def spread_by_default(type_name: str) -> str | None:
    """The repeated sub-message whose elements become rows where nothing else is asked for."""
    names = repeated_messages(type_name)
    return names[0] if len(names) == 1 else _SPREAD.get(type_name)


@dataclass(frozen=True)
class _Leaf:
    """One column (or one vector) of a message type."""

    name: str
    path: tuple[str, ...]
    dtype: str
    size: int = 0  # of a vector; 0 = a single value
    kind: str = "value"  # value, enum, list, count
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
        self._leaves = list(_leaves(row.type.DESCRIPTOR, spread))
        self._elements: list[_Leaf] = []
        if spread is not None:
            element = row.type.DESCRIPTOR.fields_by_name[spread].message_type
            self._elements = list(_leaves(element, None, prefix=f"{spread}."))

    @property
    def columns(self) -> dict[str, str]:
        """Names of the columns, in order, and their pandas types."""
        columns = dict(_ENVELOPE)
        if self._with_topic:
            columns["topic"] = "string"
        for leaf in (*self._leaves, *self._elements):
            if leaf.size:
                columns |= {f"{leaf.name}_{i}": leaf.dtype for i in range(leaf.size)}
            else:
                columns[leaf.name] = leaf.dtype
        return columns

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
            yield head + [None] * sum(leaf.size or 1 for leaf in self._elements)

    def frame(self, messages: Iterable[Message]) -> pd.DataFrame:
        """The rows of many messages."""
        import pandas as pd

        columns = self.columns
        rows = [row for message in messages for row in self.rows(message)]
        table = pd.DataFrame(rows, columns=list(columns), dtype=object)
        return table.astype(columns)


def _leaves(descriptor: Any, spread: str | None, prefix: str = "", path: tuple[str, ...] = ()) -> Iterator[_Leaf]:
    sizes = codec.vector_sizes(descriptor.full_name)
    for field in descriptor.fields:
        name, here = prefix + field.name, (*path, field.name)
        if field.message_type is not None:
            if field.is_repeated:
                if field.name != spread or path:
                    yield _Leaf(f"{name}.count", here, "Int64", kind="count")
            else:
                yield from _leaves(field.message_type, None, f"{name}.", here)
        elif field.is_repeated:
            size = sizes.get(field.name, 0)
            yield _Leaf(name, here, "float64", size) if size else _Leaf(name, here, "string", kind="list")
        elif field.enum_type is not None:
            yield _Leaf(name, here, "string", kind="enum", enum=field.enum_type)
        elif field.type != field.TYPE_BYTES:
            yield _Leaf(name, here, _dtype(field))


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
            return [None] * (leaf.size or 1)
        value = getattr(value, name)
    value = getattr(value, leaf.path[-1])
    if leaf.size:
        return list(value) if len(value) == leaf.size else [np.nan] * leaf.size
    if leaf.kind == "count":
        return [len(value)]
    if leaf.kind == "list":
        return [" ".join(repr(v) for v in value)]
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
