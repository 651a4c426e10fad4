"""What joins mathematics and messages: the nodes, the runners that drive them, and the command line."""
