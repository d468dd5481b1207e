"""Lines of text and binary records: JSON objects and their numbers, refused lines, structured arrays.

Binary records of one kind may lie anywhere in a file; they become one structured array.
"""

import json
import math
import mmap
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray


class Refused(Exception):
    """A line that is not taken.

    Attributes
    ----------
    kind : of complaint, short and fixed
    text : one line for a person
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind
        self.text = text


def shown(line: bytes | str, longest: int = 40) -> str:
    """The beginning of a line, printable."""
    text = repr(line.decode("ascii", "replace") if isinstance(line, bytes) else line)
    return text if len(text) <= longest else f"{text[:longest]}..."


def json_object(line: bytes) -> dict[str, Any]:
    """A line's JSON object.

    Raises
    ------
    Refused : it holds none
    """
    try:
        value = _DECODER.decode(line.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise Refused("not UTF-8", f"expected a JSON object per line, got {shown(line)}") from None
    except (ValueError, RecursionError):
        raise Refused("not JSON", f"expected a JSON object per line, got {shown(line)}") from None
    if not isinstance(value, dict):
        raise Refused("no object", f"expected a JSON object per line, got {shown(line)}")
    return value


def json_number(name: str, value: object, scale: float = 1.0) -> float:
    """A number of a JSON object, times a scale.

    Raises
    ------
    Refused : not a number, or not finite
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        kind = {bool: "boolean", str: "string", type(None): "null"}.get(type(value), "nested value")
        raise Refused(kind, f"{name}: {shown(json.dumps(value))}, expected a number; the line is skipped")
    try:
        number = scale * float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise Refused("out of range", f"{name}: expected a finite number; the line is skipped")
    return number


def _no_number(token: str) -> NoReturn:
    raise Refused("NaN or Infinity", f"{token} is no JSON; write null, or leave the key out; the line is skipped")


_DECODER = json.JSONDecoder(parse_constant=_no_number)


ROWS = 8192  # records gathered at a time


def layout(*fields: tuple[str, str, int]) -> np.dtype[np.void]:
    """Fields of a record: name, type, and first byte."""
    names, formats, offsets = zip(*fields, strict=True)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets})


def gathered(
    content: bytes | mmap.mmap, fields: np.dtype[np.void], at: Sequence[int], length: Sequence[int], least: int
) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Records, shape (n,), and which of them are there; zeros stand for what they lack.

    Parameters
    ----------
    at, length : first byte of each, -1 = without one, and its bytes
    least : bytes of a record that is worth reading
    """
    raw = np.frombuffer(content, np.uint8)
    first, size = np.array(at, dtype=np.int64), np.array(length, dtype=np.int64)
    out = np.zeros(len(first), dtype=fields)
    there = (first >= 0) & (size >= least)
    place = np.arange(fields.itemsize)
    for start in range(0, len(first), ROWS):
        rows = slice(start, start + ROWS)
        inside = there[rows, None] & (place < size[rows, None])
        index = np.where(inside, first[rows, None] + place, 0)
        out[rows] = np.where(inside, raw[index], 0).astype(np.uint8).view(fields)[:, 0]
    return out, there
