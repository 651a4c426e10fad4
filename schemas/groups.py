"""Messages that come and go by the thousand, made in groups that share their memory.

The protobuf library gives each message memory of its own, and once for every 10 000 pieces of it that are let go it
asks the C library to hand all memory that is free back to the system, whoever it belonged to; the arrays of an
adjustment then get theirs again page by page. In `triline process` that was a seventh of the processor time;
``bench/messages.py`` shows what it costs each message. The messages of a group let go of their memory together, when
the last of them is gone.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2

from . import messages as m

#: Messages of a group, and bytes of the longest payload that is read into one: for the sake of a message that is kept
#: long no more than 100 KiB stay.
TOGETHER, LONG = 100, 1024
_FIELD = descriptor_pb2.FieldDescriptorProto
_makers: dict[Any, Grouped] = {}


class Grouped:
    """Makes messages of a type, like the type itself.

    Parameters
    ----------
    of : the message type
    """

    def __init__(self, of: Any) -> None:
        self._of, self._group = of, _group_of(of)
        self._add, self._left = None, 0

    def __call__(self, **fields: Any) -> Any:
        """A message with these fields."""
        if self._left <= 0 or self._add is None:
            self._add, self._left = self._group().messages.add, TOGETHER
        self._left -= 1
        return self._add(**fields)

    def from_bytes(self, data: bytes | memoryview) -> Any:
        """The message of a payload.

        Raises
        ------
        google.protobuf.message.DecodeError : the payload is not one of the type
        """
        if len(data) > LONG:
            return self._of.FromString(data)
        message = self()
        message.MergeFromString(data)
        return message


def grouped(of: Any) -> Grouped:
    """The maker of a message type."""
    maker = _makers.get(of)
    if maker is None:
        maker = _makers[of] = Grouped(of)
    return maker


def _group_of(of: Any) -> Any:
    """A message type that holds a list of messages of another."""
    wanted, name = of.DESCRIPTOR, of.DESCRIPTOR.full_name.replace(".", "_")
    file = descriptor_pb2.FileDescriptorProto(name=f"group/{name}", package="group", syntax="proto3")
    file.dependency.append(wanted.file.name)
    file.message_type.add(name=name).field.add(
        name="messages", number=1, label=_FIELD.LABEL_REPEATED, type=_FIELD.TYPE_MESSAGE,
        type_name=f".{wanted.full_name}",
    )  # fmt: skip
    return m.new_class(file)
