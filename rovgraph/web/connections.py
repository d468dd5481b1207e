"""Connections of clients that may be slow, silent or hostile: none is held for longer than its deadline.

uvicorn by itself waits for a request as long as its client likes, and keeps a closed connection until all is read.
"""

import asyncio
import logging
from typing import Any

from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

REQUEST_S = 10.0  # for a whole request, from the connection or the answer before it on
ANSWER_S = 60.0  # for the client to read the answer
PING_S, PONG_S = 5.0, 10.0  # between pings to a page, and for it to answer one
FAREWELL_S = 5.0  # for a WebSocket to end after its page was dropped
UNANSWERED = 1011  # a WebSocket's code of a ping without an answer

_faults = logging.getLogger(__name__)  # of ours: what clients do wrong is not the pilot's to read
_faults.setLevel(logging.ERROR)


class Connection(H11Protocol):
    """HTTP that ends a connection at its deadline."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.logger = _faults
        self._deadline: asyncio.TimerHandle | None = None
        self._answered: RequestResponseCycle | None = None  # the newest request that came in full

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect(REQUEST_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self._expect(None)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        super().handle_events()
        if self.cycle is not None and self.cycle is not self._answered and not self.cycle.more_body:
            self._answered = self.cycle
            self._expect(ANSWER_S)

    def on_response_complete(self) -> None:
        self._expect(REQUEST_S)
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._expect(None)
        super().handle_websocket_upgrade(event)

    def _expect(self, seconds: float | None) -> None:
        """Set the deadline again; None = there is none."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)


class PageSocket(WebSocketsSansIOProtocol):
    """A WebSocket that tells when its page answers no ping, and waits for nobody to read what is left."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.logger = _faults

    def keepalive_timeout(self) -> None:
        self.queue.put_nowait({"type": "websocket.disconnect", "code": UNANSWERED})
        super().keepalive_timeout()
        self.transport.abort()

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        super().on_task_complete(task)
        self.loop.call_later(FAREWELL_S, self.transport.abort)


def unanswered(gone: WebSocketDisconnect) -> bool:
    """Whether a page was lost because it answered no ping."""
    return gone.code == UNANSWERED
