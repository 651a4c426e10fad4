"""The sliding-window adjustment; start at ``window.py``.

``arriving.py`` makes batches of what has come, ``following.py`` keeps them linearised where the window is,
``leaving.py`` lets go. ``batch.py`` takes points with their rays to equations, ``state.py`` holds the unknowns,
``block.py`` and ``archive.py`` join strips, ``backward.py`` refines what left early, ``watch.py`` and its parts judge
how far the result holds.
"""
