"""Written recordings against the MCAP library's own writer: the same bytes."""

from __future__ import annotations

import io

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from triline.nodes.mcap_write import McapWriter

KINDS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@pytest.mark.parametrize("compression", KINDS)
@pytest.mark.parametrize("messages", [0, 1, 400])
def test_the_bytes_are_those_of_the_library(compression, messages):
    theirs, ours = io.BytesIO(), io.BytesIO()
    library = Writer(theirs, chunk_size=4096, compression=KINDS[compression], enable_data_crcs=True)
    writer = McapWriter(ours, compression, 4096)
    library.start("", "triline")
    writer.start("triline")
    rng = np.random.default_rng(3)
    for topic in ("sensor/imu", "observation/tie"):
        schema = library.register_schema(f"of {topic}", "protobuf", b"\x0a\x0b")
        assert writer.register_schema(f"of {topic}", "protobuf", b"\x0a\x0b") == schema
        metadata = {"source": "ä", "platform": "demo"}
        channel = library.register_channel(topic, "protobuf", schema, metadata)
        assert writer.register_channel(topic, "protobuf", schema, metadata) == channel
        library.add_metadata("note", {"id": str(channel), "topic": topic})
        writer.add_metadata("note", {"id": str(channel), "topic": topic})
    for i in range(messages):
        data = rng.bytes(int(rng.integers(0, 300)))
        channel, log_ns = int(rng.integers(1, 3)), int(rng.integers(5, 10**18))  # log times go back and forth
        library.add_message(channel, log_ns, data, publish_time=log_ns + i, sequence=i)
        writer.add_message(channel, log_ns, log_ns + i, i, memoryview(data))
        if i == 100:
            library.flush()
            writer.flush()
    library.finish()
    writer.finish()
    assert ours.getvalue() == theirs.getvalue()
