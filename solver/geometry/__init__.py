"""Geometry without a camera: rotations, the Earth, reference frames, trajectories, intersection of rays."""
