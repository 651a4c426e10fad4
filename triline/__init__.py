"""On-line triangulation for line-scanner (pushbroom) cameras.

`triline.solver` is the pure mathematics (arrays in, arrays out), `triline.schemas` the messages, `triline.nodes` the
programs that join them. `triline.open` gives a recording as NumPy arrays and pandas tables.
"""

__version__: str


def __getattr__(name):
    """The version, looked up when somebody asks for it: that takes as long as half of a command's start."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("triline")
    except PackageNotFoundError:  # a source tree that was never installed
        found = "0"
    globals()["__version__"] = found
    return found


def open(path):
    """Open a recording for analysis; see `triline.nodes.recording.access.Recording`."""
    # the folder of triline.nodes lies beside this one, where a type checker does not look
    from .nodes.recording.access import Recording

    return Recording(path)


__all__ = ["__version__", "open"]
