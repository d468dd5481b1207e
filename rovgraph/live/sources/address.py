"""The URL of a source, taken apart, and what is wrong with one."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from rovgraph.errors import InputError
from rovgraph.log.units import nearest

LOOPBACK = "127.0.0.1"
_OPTIONS = re.compile(r"\?(?=\w+=)")  # a question mark in a file's name is none


@dataclass(frozen=True)
class Address:
    """A URL: ``scheme:place?option=value&...``.

    Attributes
    ----------
    url : as a person gave it
    scheme : in front of the first colon
    place : what stands between
    options : as text
    """

    url: str
    scheme: str
    place: str
    options: Mapping[str, str]

    def inner(self) -> "Address":
        """The place, as an address of its own: of ``nmea:tcp://host:1`` that of ``tcp://host:1``."""
        scheme, _, place = self.place.partition(":")
        return Address(self.url, scheme, place, self.options)

    def host_port(self, default_host: str | None = None, default_port: int | None = None) -> tuple[str, int]:
        """Host and port of ``//host:port``.

        Raises
        ------
        InputError : one of them is missing without a default, or wrong
        """
        try:
            parts = urlsplit(f"//{self.place.removeprefix('//')}")
            host, port = parts.hostname or default_host, parts.port or default_port
        except ValueError:
            host = port = None
        else:
            if parts.path not in ("", "/") or parts.username is not None:
                host = port = None
        if host is None or port is None:
            raise InputError(f"{self.url}: expected {self.scheme}://host:port with a port from 1 to 65535")
        return host, port

    def take(self, readers: Mapping[str, Callable[[str], Any]]) -> dict[str, Any]:
        """Options that were given, read.

        Parameters
        ----------
        readers : name -> from text to value; raises ValueError, whose message says what was expected

        Raises
        ------
        InputError : unknown option, or a value that cannot be read
        """
        out = {}
        for name, text in self.options.items():
            if name not in readers:
                known = f"nearest is {nearest(name, readers)!r} of {', '.join(readers)}" if readers else "it has none"
                raise InputError(f"{self.url}: unknown option {name!r}; {known}")
            try:
                out[name] = readers[name](text)
            except ValueError as error:
                raise InputError(f"{self.url}: option {name}: {text!r}, {error}") from None
        return out


def parse_address(url: str) -> Address:
    """A URL taken apart; what has no colon has an empty scheme.

    Raises
    ------
    InputError : an option given twice
    """
    head, *tail = _OPTIONS.split(url, maxsplit=1)
    pairs = parse_qsl(tail[0], keep_blank_values=True) if tail else []
    if len(pairs) > len(dict(pairs)):
        raise InputError(f"{url}: an option is given twice")
    scheme, colon, place = head.partition(":")
    return Address(url, scheme if colon else "", place if colon else head, dict(pairs))


def positive(text: str) -> float:
    """A number above 0, from an option's text."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 < value < float("inf"):
        raise ValueError("expected a number above 0")
    return value


def whole(lowest: int, highest: int) -> Callable[[str], int]:
    """Reader of a whole number within bounds."""

    def read(text: str) -> int:
        if not (text.isdecimal() and lowest <= int(text) <= highest):
            raise ValueError(f"expected a whole number from {lowest} to {highest}")
        return int(text)

    return read


def one_of(*known: str) -> Callable[[str], str]:
    """Reader of one of some words."""

    def read(text: str) -> str:
        if text not in known:
            raise ValueError(f"expected one of {', '.join(known)}")
        return text

    return read
