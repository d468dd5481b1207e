"""Errors of a configuration in plain words."""

import datetime as dt
import difflib
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

COUNTS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
KINDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    dt.date: "a date such as 2026-05-01",
}
WRONG_KIND = ("_type", "_parsing", "int_from_float", "missing", "too_long")  # ends of pydantic's error types
BOUNDS = {
    "greater_than": ("gt", "more than {:g}"),
    "greater_than_equal": ("ge", "{:g} or more"),
    "less_than": ("lt", "less than {:g}"),
    "less_than_equal": ("le", "{:g} or less"),
}
LONGEST = 60  # characters of a value that is shown


def count(n: int) -> str:
    """A number of things in words.

    >>> count(3), count(12)
    ('three', '12')
    """
    return COUNTS[n] if n < len(COUNTS) else str(n)


def complaint(error: Any, model: type[BaseModel]) -> str:
    """One of pydantic's errors as a phrase that names key, problem and remedy."""
    location: tuple[int | str, ...] = error["loc"]
    kind = error["type"]
    if kind == "extra_forbidden":
        return _unknown_key(location, model)
    if kind == "invalid_key" or location[-1:] == ("[key]",):
        location = location[: -1 if kind == "invalid_key" else -2]
        allowed = f"one of {error['ctx']['expected']}" if kind == "literal_error" else "text"
        return f"{_key(location)}expected {allowed} as a key, found {_shown(error['input'])}"
    location = _without_choices(location, model)
    location, found = _found(error, location)
    if kind in BOUNDS:
        name, text = BOUNDS[kind]
        what = "expected " + text.format(error["ctx"][name])
    elif kind == "literal_error":
        what = f"expected {error['ctx']['expected']}"
    elif kind == "finite_number":
        what = "expected a finite number"
    elif kind.endswith(WRONG_KIND):
        what = f"expected {_expected(_kind(model, location))}"
    else:
        what = f"{error['msg'][0].lower()}{error['msg'][1:]}"
        found = "" if isinstance(error["input"], dict) else found  # of a section, whose keys the message names
    return f"{_key(location)}{what}" + (f", found {found}" if found else "")


def _found(error: Any, location: tuple[int | str, ...]) -> tuple[tuple[int | str, ...], str]:
    """Where an error stands, and what was found there."""
    if error["type"] == "missing" and isinstance(location[-1], int):  # an item of a list that is too short
        return location[:-1], count(len(error["input"]))
    if error["type"] == "missing":
        return location, "nothing"
    if error["type"] == "too_long":
        return location, count(error["ctx"]["actual_length"])
    return location, _shown(error["input"])


def _key(location: tuple[int | str, ...]) -> str:
    return ".".join(map(str, location)) + ": " if location else ""


def _unknown_key(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    *parents, last = map(str, location)
    known = list(_kind(model, location[:-1]).model_fields)
    if not known:
        return f"unknown key {'.'.join([*parents, last])}: no sensor of that name is registered"
    near = difflib.get_close_matches(last, known, 1, cutoff=0.0)
    return f"unknown key {'.'.join([*parents, last])}, nearest known key is {'.'.join([*parents, near[0]])}"


def _kind(model: Any, location: tuple[int | str, ...]) -> Any:
    """The type of what stands at a location; a number in it stands for an item of a list."""
    for part in location:
        kind = _bare(model)
        arguments = get_args(kind)
        if get_origin(kind) is tuple:
            model = arguments[int(part)] if arguments[-1] is not Ellipsis else arguments[0]
        else:
            model = arguments[1] if get_origin(kind) is dict else kind.model_fields[part].annotation
    return _bare(model)


def _without_choices(location: tuple[int | str, ...], model: Any) -> tuple[int | str, ...]:
    """A location without the name of the kind, behind a key whose value may be of several."""
    before = next((k for k in range(len(location)) if _is_choice(_kind(model, location[:k]))), len(location))
    return location[:before]


def _is_choice(kind: Any) -> bool:
    return get_origin(kind) in (Union, types.UnionType)


def _bare(kind: Any) -> Any:
    """A type without its bounds, and without the null that may stand instead; of several kinds their union."""
    while get_origin(kind) is Annotated or _is_choice(kind):
        kinds = [k for k in get_args(kind) if k is not type(None)]
        if _is_choice(kind) and len(kinds) > 1:
            return Union[tuple(map(_bare, kinds))]  # noqa: UP007
        kind = kinds[0]
    return kind


def _expected(kind: Any) -> str:
    """A value of a type in words."""
    if _is_choice(kind):
        return " or ".join(map(_expected, get_args(kind)))
    if get_origin(kind) is tuple:
        items = get_args(kind)
        return (
            f"a list of {_several(items[0])}" if items[-1] is Ellipsis else f"{count(len(items))} {_several(items[0])}"
        )
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(repr, get_args(kind)))
    return KINDS.get(kind, "keys and values")


def _several(kind: Any) -> str:
    """Values of a type in words."""
    kind = _bare(kind)
    if get_origin(kind) is tuple:
        return f"rows of {_expected(kind)}"
    return {float: "numbers", int: "whole numbers", str: "texts"}.get(kind, "values" if kind in KINDS else "entries")


def _shown(value: Any) -> str:
    """A value as it stands in the file, or the beginning of it."""
    if value is None:
        return "nothing"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
