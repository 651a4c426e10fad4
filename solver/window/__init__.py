"""The sliding-window adjustment; start at ``window.py``, whose update is one line a phase.

Rooms, each importing only from those before it: ``results.py`` (what the window takes and gives), ``state/`` (unknowns,
points and equations of the network in the window), ``datum/`` (control, tie points that drift), ``block/`` (what strips
leave behind), ``screening/`` (which looks count), ``quality/`` (how far the result holds), ``output.py``,
``leaving.py``, ``window.py``. See docs/architecture.md.
"""
