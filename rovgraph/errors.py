"""Errors and warnings for the user, one clear line each."""

import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_collecting: ContextVar[list[str] | None] = ContextVar("collecting", default=None)


class InputError(Exception):
    """Bad input: the message says what, where and what to do, in one line.

    The command line prints the message and exits with code 2.
    """


class DataWarning(UserWarning):
    """Data that look wrong but can be used; issued with `warn`."""


def warn(text: str) -> None:
    """Issue a `DataWarning` that points to the caller of the package."""
    collected = _collecting.get()
    if collected is not None:
        collected.append(text)
    level = 1
    while sys._getframe(level).f_globals.get("__name__", "").partition(".")[0] == __package__:
        if sys._getframe(level).f_back is None:
            break
        level += 1
    warnings.warn(text, DataWarning, stacklevel=level + 1)


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """A list that gets the text of every `DataWarning` that is issued within the block."""
    texts: list[str] = []
    token = _collecting.set(texts)
    try:
        yield texts
    finally:
        _collecting.reset(token)


def kind_of(value: object) -> str:
    """The kind of an argument, for "expected …, found …".

    >>> kind_of(None), kind_of(5), kind_of({})
    ('None', 'an int', 'a dict')
    """
    name = type(value).__name__
    return "None" if value is None else f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


def as_path(given: object, name: str) -> Path:
    """The path that an argument gives.

    Parameters
    ----------
    given : text or a path
    name : of the argument, for the message

    Raises
    ------
    InputError : it is neither
    """
    if not isinstance(given, str | os.PathLike):
        raise InputError(f"{name}: expected a path, found {kind_of(given)}")
    return Path(given)


def as_paths(given: object, name: str) -> list[Path]:
    """The paths that an argument gives, one or several.

    Raises
    ------
    InputError : it gives none, or something else
    """
    if isinstance(given, Iterable) and not isinstance(given, str | bytes | Mapping | os.PathLike):
        return [as_path(each, name) for each in given]
    return [as_path(given, name)]


def as_texts(given: object, name: str) -> list[str]:
    """The texts that an argument gives, one or several.

    Raises
    ------
    InputError : it gives none, or something else
    """
    texts = []
    for text in [given] if isinstance(given, str | bytes | Mapping) or not isinstance(given, Iterable) else given:
        if not isinstance(text, str):
            raise InputError(f"{name}: expected text, found {kind_of(text)}")
        texts.append(text)
    return texts


def in_one_line(error: BaseException) -> str:
    """An error as a result of many; what is no bad input is named by its kind."""
    text = (str(error).splitlines() or [""])[0][:300]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"
