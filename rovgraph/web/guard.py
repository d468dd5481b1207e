"""Access control of the page, for every request: who may see it, who may change anything, and where it is served.

On the loopback, another site that is open in the pilot's browser is the danger: requests have to name this computer
(against DNS rebinding), and what changes something, or streams, has to come from the page itself (against request
forgery and WebSocket hijacking). Elsewhere a token is required as well. It is sent in a header, which a foreign page
cannot set and logs of addresses do not contain; cookies are not used.
"""

import hmac
import os
import secrets
import socket
from collections.abc import Collection
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
class ListenAddress:
    """Host and port to listen at."""

    host: str
    port: int

    @property
    def loopback(self) -> bool:
        """Whether only this computer reaches it."""
        return is_loopback(self.host)

    @property
    def url(self) -> str:
        """URL for a person on this computer."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"


def parse_address(text: str) -> ListenAddress:
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
    return ListenAddress(host, port)


def listening(address: ListenAddress) -> socket.socket:
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
    InputError : it is not such an origin
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


SUBPROTOCOL = "rovgraph"  # of the page's WebSocket; its token, where there is one, is offered beside it
TOKEN_PREFIX = "token."
PUBLIC = {"/", "/register_service", "/cockpit_extras.json"}  # nothing of the dive is in them, nor in assets
ASSETS = "/assets/"
DATA_LAKE = "/cockpit"  # a WebSocket that Cockpit opens by its address alone
SAFE = {"GET", "HEAD"}
LARGEST_HEADERS = 1 << 14  # with the address [bytes]; uvicorn limits only what comes in pieces


class Guard:
    """Lets requests through to an application, or refuses them in one line.

    Parameters
    ----------
    app : behind it
    token : that is asked for; None = none, on the loopback
    origins : of other pages, such as Cockpit's, that may frame the page and read the data lake without a token
    """

    def __init__(self, app: ASGIApp, token: str | None, origins: Collection[str] = ()) -> None:
        self._app = app
        self._token = token
        self._origins = frozenset(origins)
        self._headers = _security_headers(origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if scope["type"] == "websocket":
            if refusal is None:
                await self._app(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        app = self._app if refusal is None else JSONResponse({"error": refusal[1]}, refusal[0])
        await app(scope, receive, guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and reason; None = let through."""
        size = len(scope["raw_path"]) + len(scope["query_string"]) + sum(len(k) + len(v) for k, v in scope["headers"])
        if size > LARGEST_HEADERS:
            return 431, f"expected at most {LARGEST_HEADERS} bytes of headers"
        headers, path = Headers(scope=scope), str(scope["path"])
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._token is None and not is_loopback(_hostname(host)):
            return 403, "the request names another computer; open the page by 127.0.0.1 or localhost"
        stream = scope["type"] == "websocket"
        listed = origin is not None and origin.lower() in self._origins
        own = origin is None or _same(origin, host) or listed
        if (stream or scope["method"] not in SAFE) and not own:
            return 403, "the request comes from another site; name it with --http-origin if it is yours"
        if self._token is None or (not stream and (path in PUBLIC or path.startswith(ASSETS))):
            return None
        if stream and path == DATA_LAKE and listed:
            return None
        given = _offered(headers) if stream else headers.get("authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return 401, "a token is needed: the one that was printed when the page was opened"
        return None


def _hostname(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _same(origin: str, host: str) -> bool:
    """Whether a page's origin is the host that it asks."""
    scheme, _, place = origin.lower().partition("://")
    return scheme in ("http", "https") and bool(place) and place == host.lower()


def _offered(headers: Headers) -> str:
    """The token among the subprotocols of a WebSocket, or in a header, as programs send it."""
    offered = [one.strip() for one in headers.get("sec-websocket-protocol", "").split(",")]
    token = next((one.removeprefix(TOKEN_PREFIX) for one in offered if one.startswith(TOKEN_PREFIX)), "")
    return token or headers.get("authorization", "").removeprefix("Bearer ")


def _security_headers(origins: Collection[str]) -> dict[str, str]:
    """Of every answer: everything that a page loads or runs is ours, and only listed origins may frame it."""
    framing = " ".join(["'self'", *sorted(origins)])
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        f"base-uri 'none'; form-action 'none'; frame-ancestors {framing}"
    )
    return {
        "content-security-policy": policy,
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "cross-origin-resource-policy": "same-origin",
        "cache-control": "no-store",
    }
