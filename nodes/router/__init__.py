"""Routers: between the nodes of an aircraft and the ground, and on the ground between aircraft and desks."""
