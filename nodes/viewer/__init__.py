"""The viewer: the scene of a triangulation, and the canvas it is drawn on."""
