"""Where the page is served, and who may see it."""

import os
import secrets
import socket
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from rovgraph.errors import InputError

TOKEN_BYTES = 24
SHORTEST_TOKEN = 16  # characters
BACKLOG = 64


def is_loopback(host: str) -> bool:
    """Whether a host is this computer by its own number or name, which no name server decides."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Address:
    """Host and port to listen at."""

    host: str
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this computer reaches it."""
        return is_loopback(self.host)

    @property
    def url(self) -> str:
        """What a person opens, on this computer."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"


def parse_address(text: str) -> Address:
    """``HOST:PORT``, or ``PORT`` of the loopback.

    Raises
    ------
    InputError : none of both
    """
    text = str(text)
    try:
        parts = urlsplit(f"//{text}" if ":" in text else f"//127.0.0.1:{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None or not 0 <= port <= 65535 or parts.path or parts.query or parts.username:
        raise InputError(f"--http {text!r}: expected host:port, such as 127.0.0.1:8080")
    return Address(host, port)


def listening(address: Address) -> socket.socket:
    """A socket that listens there.

    Raises
    ------
    InputError : the port is in use, or the host is not this computer's
    """
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        return socket.create_server((address.host, address.port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise InputError(
            f"--http {address.host}:{address.port}: cannot listen there ({error.strerror or error}); choose another"
        ) from None


def parse_origin(text: str) -> str:
    """An origin of other pages, ``http://host[:port]``, in the form in which browsers send it.

    Raises
    ------
    InputError : it is none
    """
    try:
        parts = urlsplit(text)
        valid = parts.scheme in ("http", "https") and parts.hostname and parts.path in ("", "/")
        valid = valid and not (parts.query or parts.fragment or parts.username) and (parts.port or 1) > 0
    except ValueError:
        valid = False
    if not valid or any(c in text for c in " ;,'\"\t\r\n"):
        raise InputError(f"--http-origin {text!r}: expected an origin, such as http://192.168.2.2")
    return f"{parts.scheme}://{parts.netloc.lower()}"


def token_of(path: Path | None) -> str:
    """A new token, or that of a file, which is made if it is not there, for its owner's eyes only.

    Raises
    ------
    InputError : the file cannot be read or written, or holds no token
    """
    if path is None:
        return secrets.token_urlsafe(TOKEN_BYTES)
    try:
        if not path.exists():
            token = secrets.token_urlsafe(TOKEN_BYTES)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(token + "\n")
            return token
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--http-token {path}: cannot be used ({error}); choose another file") from None
    if len(token) < SHORTEST_TOKEN or not all(c.isalnum() or c in "-_" for c in token):
        raise InputError(
            f"--http-token {path}: expected at least {SHORTEST_TOKEN} letters, digits, - or _; delete it for a new one"
        )
    return token
