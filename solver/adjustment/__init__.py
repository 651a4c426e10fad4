"""The batch bundle adjustment: a block as arrays, normal equations, snooping, statistics; start at ``batch.py``.

The sliding window works with the same equations, weights and statistics.
"""
