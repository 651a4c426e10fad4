"""The player: recorded messages onto the bus."""
