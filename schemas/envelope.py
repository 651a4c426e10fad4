"""What travels beside the payload of every message: platform stamp, source, sequence number, start of the publisher.

On the bus it is the attachment of a sample; in a recording it is the publish time and sequence of a message and the
metadata of its channel. The payload itself stays plain protobuf, so that other programs read it as it is.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

VERSION = 1
_HEAD = struct.Struct("<Bqqq")
MAX_SOURCE_BYTES = 64


class Envelope(NamedTuple):
    """Where a message stands among the others.

    Attributes
    ----------
    stamp_ns : platform time (UTC, ns since the Unix epoch) at which it was measured or could be known
    source : id of the publisher
    sequence : number given by the publisher, per topic, from 0
    start : tells one run of a publisher from the next, so that a restart is no duplicate; 0 in processed recordings
    """

    stamp_ns: int
    source: str
    sequence: int
    start: int = 0


class RawMessage(NamedTuple):
    """A message as it travels: envelope and payload, not decoded."""

    topic: str
    envelope: Envelope
    data: bytes | memoryview
    receive_ns: int = 0


def pack(envelope: Envelope) -> bytes:
    """The attachment of a sample."""
    source = envelope.source.encode()
    if len(source) > MAX_SOURCE_BYTES:
        raise ValueError(f"source id of {len(source)} bytes, wanted at most {MAX_SOURCE_BYTES}")
    return _HEAD.pack(VERSION, envelope.stamp_ns, envelope.sequence, envelope.start) + source


def unpack(data: bytes) -> Envelope:
    """The envelope in an attachment.

    Raises
    ------
    ValueError : too short or too long, of another version, or with values no publisher gives
    """
    if not _HEAD.size <= len(data) <= _HEAD.size + MAX_SOURCE_BYTES:
        raise ValueError(f"envelope of {len(data)} bytes, wanted {_HEAD.size} and a source id")
    version, stamp_ns, sequence, start = _HEAD.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"envelope of version {version}, wanted {VERSION}")
    if sequence < 0 or stamp_ns < 0:
        raise ValueError(f"envelope with stamp {stamp_ns} and sequence {sequence}, wanted neither below 0")
    try:
        source = data[_HEAD.size :].decode()
    except UnicodeDecodeError:
        raise ValueError("envelope with a source id that is not UTF-8") from None
    return Envelope(stamp_ns, source, sequence, start)
