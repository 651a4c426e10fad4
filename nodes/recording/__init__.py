"""Recordings: writing, reading, what they hold, and the runner that drives nodes over one."""
