"""Compile the protobuf files into ``triline.desc``, the descriptor set that the package loads: ``make schemas``.

The set of descriptors is committed instead of generated code, because generated code is tied to one protobuf release.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent


def compile_descriptors() -> bytes:
    """The serialised FileDescriptorSet of every ``.proto`` in this folder, imports included."""
    import tempfile

    import grpc_tools
    from grpc_tools import protoc

    sources = sorted(str(path.relative_to(FOLDER)) for path in FOLDER.rglob("*.proto"))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set.desc"
        well_known = Path(grpc_tools.__file__).parent / "_proto"
        arguments = ["protoc", f"-I{FOLDER}", f"-I{well_known}", "--include_imports", f"--descriptor_set_out={out}"]
        if protoc.main([*arguments, *sources]) != 0:
            raise ValueError("the protobuf files do not compile; protoc says where above")
        return out.read_bytes()


if __name__ == "__main__":
    (FOLDER / "triline.desc").write_bytes(compile_descriptors())
