"""Lines of bytes, and decoders that work line by line."""

import json
import math
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from rovgraph.live.message import Message
from rovgraph.live.sources.source import Chunk, Notify

LONGEST = 1 << 16  # bytes of a line


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


class LineDecoder:
    """Splits bytes into lines and makes a message of each.

    Parameters
    ----------
    parse : from a line without its end, not empty, and its arrival to a message, or None where it
        says nothing of a sensor; raises `Refused`
    notify : takes warnings
    """

    def __init__(self, parse: Callable[[bytes, float], Message | None], notify: Notify) -> None:
        self._parse = parse
        self._notify = notify
        self._rest = b""
        self._skipping = False  # within a line that is too long

    def feed(self, chunk: Chunk) -> Iterator[Message]:
        if chunk.fresh:
            self._rest, self._skipping = b"", False
        *lines, rest = chunk.data.split(b"\n")
        if lines:
            lines[0] = self._rest + lines[0]
            self._rest = b""
            if self._skipping:
                self._skipping = False
                del lines[0]
        self._keep(rest)
        for line in lines:
            message = self._message(line, chunk.arrival)
            if message is not None:
                yield message

    def _keep(self, rest: bytes) -> None:
        """The beginning of a line, unless it is too long already."""
        if self._skipping:
            return
        self._rest += rest
        if len(self._rest) > LONGEST:
            self._rest, self._skipping = b"", True
            self._notify("too long", f"a line of more than {LONGEST} bytes is skipped")

    def _message(self, line: bytes, arrival: float) -> Message | None:
        line = line.strip()
        try:
            if len(line) > LONGEST:
                raise Refused("too long", f"a line of more than {LONGEST} bytes is skipped")
            return self._parse(line, arrival) if line else None
        except Refused as refused:
            self._notify(refused.kind, refused.text)
            return None


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
    Refused : it is none, or not finite
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
