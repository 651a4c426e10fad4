"""Sensors onto the bus: one small program each, started by ``triline fly`` from the flight folder."""
