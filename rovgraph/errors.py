"""What goes wrong on the user's side, as one clear line."""


class InputError(Exception):
    """Bad input: the message says what, where and what to do, in one line.

    The command line prints the message and exits with code 2.
    """


class DataWarning(UserWarning):
    """Data that look wrong but can be worked with; issued with ``warnings.warn``."""
