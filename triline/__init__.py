"""On-line triangulation for line-scanner (pushbroom) cameras.

`triline.solver` is the pure mathematics (arrays in, arrays out), `triline.schemas` the messages, `triline.nodes` the
programs that join them. `triline.open` gives a recording as NumPy arrays and pandas tables.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("triline")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0"


def open(path):
    """Open a recording for analysis; see `triline.nodes.recording.access.Recording`."""
    # the folder of triline.nodes lies beside this one, where a type checker does not look
    from .nodes.recording.access import Recording  # pyright: ignore[reportMissingImports]

    return Recording(path)


__all__ = ["__version__", "open"]
