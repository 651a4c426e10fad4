"""Nodes on the bus: the session, the runner of one node, processes, and publishing at the pace of the stamps."""
