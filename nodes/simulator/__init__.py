"""The simulator: a simulated flight as messages."""
