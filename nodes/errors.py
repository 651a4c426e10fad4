"""What goes wrong in a way that a user can mend."""


class UserError(Exception):
    """Work failed for a reason outside the program: one line, what and where and what was wanted. Exit code 1."""


def flag(name: str) -> str:
    """An option as it is written on a command line, by its name as an attribute."""
    return f"--{name.replace('_', '-')}"
