"""The recorder: messages of the bus into a recording."""
