"""Who may see the page, and who may change anything: in front of every request.

On the loopback, another site that is open in the pilot's browser is the danger: requests have to name this computer
(against DNS rebinding), and what changes something, or streams, has to come from the page itself (against request
forgery and WebSocket hijacking). Elsewhere a token is asked for as well. It travels in a header, which a foreign page
cannot set and which no log of addresses holds; there are no cookies.
"""

import hmac
from collections.abc import Collection
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rovgraph.web.address import is_loopback

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
