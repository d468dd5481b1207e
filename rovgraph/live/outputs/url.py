"""URLs of outputs: ``scheme:place?option=value``."""

from typing import NamedTuple
from urllib.parse import parse_qsl, urlsplit

from rovgraph.errors import InputError


class Url(NamedTuple):
    """A URL in its parts.

    Attributes
    ----------
    text : as a person gave it
    scheme, place : before and after the first colon
    options : what stands behind the question mark
    """

    text: str
    scheme: str
    place: str
    options: dict[str, str]

    def host_port(self, default_host: str | None = None) -> tuple[str, int]:
        """Host and port of ``scheme://host:port``.

        Raises
        ------
        InputError : one of them is missing or out of range
        """
        try:
            parts = urlsplit(f"{self.scheme}:{self.place}")
            host, port = parts.hostname or default_host, parts.port
        except ValueError:
            host = port = None
        if not host or not port or parts.path not in ("", "/"):
            wanted = "host:port" if default_host is None else "[host]:port"
            raise InputError(f"output {self.text!r}: expected {self.scheme}://{wanted}, the port from 1 to 65535")
        return host, port

    def number(self, option: str, default: float | None, low: float, high: float) -> float | None:
        """A number among the options.

        Raises
        ------
        InputError : it is none, or not from ``low`` to ``high``
        """
        if option not in self.options:
            return default
        try:
            value = float(self.options[option])
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise InputError(f"output {self.text!r}: {option}: expected a number from {low:g} to {high:g}")
        return value


def parsed(text: str) -> Url:
    """The parts of an output's URL."""
    before, _, query = text.partition("?")
    scheme, _, place = before.partition(":")
    return Url(text, scheme, place, dict(parse_qsl(query, keep_blank_values=True)))
