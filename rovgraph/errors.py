"""What goes wrong on the user's side, as one clear line."""


class InputError(Exception):
    """Bad input: the message says what, where and what to do, in one line.

    The command line prints the message and exits with code 2.
    """


class DataWarning(UserWarning):
    """Data that look wrong but can be worked with; issued with ``warnings.warn``."""


def in_one_line(error: BaseException) -> str:
    """An error as a result of many; what is no bad input is named by its kind."""
    text = (str(error).splitlines() or [""])[0][:300]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"
