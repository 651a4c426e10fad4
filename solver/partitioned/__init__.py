"""Blocks of any size: object points are eliminated partition by partition, wherever that runs.

A *partition* is a part of the object points with all their rays: an ordinary problem of `solver.adjustment` without
a-priori knowledge, whose unknowns are the few of the block that its rays touch. What partitions say of the unknowns is
added up in a tree, and solved with its sparsity (`adjustment.nested_dissection`); steps and cofactors go back to the
partitions. The functions that work on one partition are the same wherever they run: `tasks`. Who runs them, and where
their files lie, is the business of a `runner.Runner`.
"""
