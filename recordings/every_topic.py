"""Write one message of every topic into ``recordings/schemas/VERSION.mcap``: `python recordings/every_topic.py`.

Done once for a version, when it is made; the file is never written again.
`tests/nodes/recording/test_schema_versions.py` reads all of them.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))


def main() -> int:
    import sample_messages

    from triline.nodes.recording.writer import RecordingWriter

    path = HERE / "schemas" / f"{sys.argv[1] if len(sys.argv) > 1 else version('triline')}.mcap"
    if path.exists():
        print(f"{path.name} is there already", file=sys.stderr)
        return 1
    with RecordingWriter(path, "zstd") as writer:
        for topic in sample_messages.names():
            writer.write(sample_messages.message(topic, 3))
    print(f"{path.name}: {path.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
