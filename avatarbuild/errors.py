"""The one exception that a user sees as a line, not as a traceback."""


class InputError(Exception):
    """Bad input or use: one line that says what was found, what is needed and what to do; exit code 2."""
