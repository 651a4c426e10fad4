"""The monitor: what all nodes say of themselves, on one screen."""
