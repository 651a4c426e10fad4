"""The simulator: a flight over a relief, what its sensors measure, and what can be seen in its images.

Each source of chance has a random stream of its own (`streams`), so that changing one leaves the others as they were.
"""
